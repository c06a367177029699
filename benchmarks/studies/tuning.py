"""Fit and score the options that are tuned for motion methods, and write their tables.

All runs use one protocol, bandai2-tuning. Training uses clips of group A. Tests use every fourth window of group B,
whose styles differ from the training styles; no clip of the test group C is used. Scores are stored by section in
`benchmarks/scores/tuning`. An interrupted script continues, and tables show the available scores.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import isnan, nan, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

import dvae
from dvae import Training, motion
from dvae.models import registry
from dvae.motion.data.dataset import MotionData
from dvae.motion.scoring.energies import pose_prior_energy
from dvae.runs.directory import load

from .engine import settings, swept
from .ranking import JOINTS, METRIC_MODELS, SCORES, SETS, entries, fitted_metric_models, judging, parted
from .results import Table, refuse_unknown, tabled, write

TUNING = motion.PROTOCOLS["bandai2-tuning"]
EVERY, SAMPLES = 4, 50
REFERENCES = ("zero velocity", "nearest neighbours")
COLUMNS_OF_METRIC_MODELS = ("log density", "pose NLL", "ACC content")
COLUMNS = ("ADE", "FDE", "ADEm", "APD", "energy score", "ACC content", "FID content", "pose NLL", "KL w", "KL z")
"""Scores that tables show, where there are."""
SEEDS, TESTED = "seeds", ("bandai2-by-style", "bandai2-trajectories")
"""The table of what another seed does, and the sets whose rows tell it."""
PATH_COLUMNS = tuple(f"{score}, {count} given" for score in ("ADE", "APD", "energy score") for count in range(5))


@dataclass(frozen=True)
class Section:
    """Cases of one method that are compared with one another.

    Args:
        method: name of the method.
        training: training options of all runs, unless a case overrides them.
        cases: options by name of the case, including those of `Training`.
        options: options of all cases, unless a case overrides them; later changes of a preset do not apply.
        protocol: window protocol.
        judged: whether the method uses the pose prior.
        seeds: seeds of each case.
    """

    method: str
    training: Training
    cases: Mapping[str, Mapping[str, Any]]
    options: Mapping[str, Any] = field(default_factory=dict)
    protocol: motion.Protocol = TUNING
    judged: bool = False
    seeds: tuple[int, ...] = (0,)

    @property
    def columns(self) -> Sequence[str]:
        """Of its table."""
        return COLUMNS if self.protocol.root == "drop" else PATH_COLUMNS

    def of(self, case: str, prior: Path) -> tuple[Any, Training]:
        """The method of a case, and its training."""
        options, told = parted({**self.options, **self.cases[case]})
        method = options.pop("method", self.method)
        if (
            self.judged and options.get("pose_prior") != 0 and options.get("heading", True)
        ):  # as the metric model has it
            options["pose_prior_run"] = str(prior)
        return dvae.method(method, **options), replace(self.training, **told)


PATHS = replace(motion.PROTOCOLS["bandai2-trajectories"], name="bandai2-paths-tuning", train=("A",), test=("B",))


SECTIONS = {
    name: Section(
        training=Training(**told.pop("training")), protocol=PATHS if told.pop("paths", False) else TUNING, **told
    )
    for name, told in settings(__file__).items()
}


STEPS = {"prior": (500, 1000, 2000, 4000), "content": (750, 1500, 3000, 6000)}
"""Of metric models, which are to know poses and contents of styles that they have not seen."""
SEEDS_OF = {"prior": (0, 1, 2), "content": (0,)}
OF_METRIC_MODELS = [f"{metric_model} {steps} steps" for metric_model, tried in STEPS.items() for steps in tried]


Kept = dict[str, dict[str, dict[str, float]]]
"""Means of scores, by case and seed."""


class Store:
    """The scores of a section, in a file of JSON that holds all sections."""

    def __init__(self, file: Path, section: str) -> None:
        self.file, self.section = file, section
        self.all: dict[str, Kept] = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}

    @property
    def found(self) -> Kept:
        """By case and seed; none before the first."""
        return self.all.get(self.section, {})

    def add(self, case: str, seed: int, scores: Mapping[str, float]) -> None:
        """Add the scores of one seed of a case to the stored ones."""
        self.all = Store(self.file, self.section).all
        cases = self.all.setdefault(self.section, {})
        cases.setdefault(case, {})[str(seed)] = {name: round(value, 4) for name, value in scores.items()}
        self.file.parent.mkdir(parents=True, exist_ok=True)
        self.file.write_text(json.dumps(self.all, indent=1) + "\n", encoding="utf-8")

    def lacks(self, case: str, seed: int) -> bool:
        """Whether it has not been scored."""
        return str(seed) not in self.found.get(case, {})


def of_metric_models(data: MotionData, runs: Path, store: Store) -> None:
    """Fits metric models for other numbers of steps, and scores real motion of the judging group by each."""
    for row in OF_METRIC_MODELS:
        name, steps, _ = row.split()
        method, options, training = METRIC_MODELS[name]
        for seed in [seed for seed in SEEDS_OF[name] if store.lacks(row, seed)]:
            told = replace(training, steps=int(steps))
            (path,) = swept(row, registry.metric_models()[method](**options), data, runs, (seed,), told)
            store.add(row, seed, of_metric_model(name, path, seen(data)))


def of_metric_model(name: str, run: Path, windows: motion.Windows) -> dict[str, float]:
    """Return the scores of a metric model on the predicted frames of real windows."""
    if name == "prior":
        prior, motions = load(run).model, windows.all()["x"]
        poses = prior.facing(motions)[:, windows.protocol.observed :]
        with torch.no_grad():
            energy = pose_prior_energy(poses[None], prior, prior.skeleton).mean()
            return {"log density": prior.log_prob(poses).mean().item(), "pose NLL": energy.item()}
    found = dvae.evaluate(
        {}, windows, scores=judging({name: run}), samples=1, references=["zero velocity"], progress=False
    )
    return {f"ACC {name}": found["real motion"][f"ACC {name}"].mean}


def of_references(data: MotionData, store: Store, judged: Mapping[str, Path]) -> None:
    """Score the missing references, which use no given paths."""
    drop, name = data.protocol.root == "drop", data.protocol.name
    rows = [row for row in REFERENCES if store.lacks(f"{name}: {row}", 0)]
    if not rows:
        return
    train = motion.windows(data.motion, data.protocol, "train+validation")
    options = {"scores": judging(judged) if drop else motion.scores, "references": rows, "training_windows": train}
    found = dvae.evaluate({}, seen(data), samples=SAMPLES, progress=False, **options)
    for row in rows:
        means = {score: each.mean for score, each in found[row].items()}
        ways = [""] if drop else [f", {count} given" for count in range(len(JOINTS) + 1)]
        store.add(f"{name}: {row}", 0, {f"{score}{way}": mean for score, mean in means.items() for way in ways})


def seen(data: MotionData) -> motion.Windows:
    """Every fourth window of each clip of the judging group, the first one among them."""
    protocol = replace(data.protocol, test_stride=EVERY * data.protocol.test_stride)
    return motion.windows(data.motion, protocol, "test")


def score(path: Path, data: MotionData, judged: Mapping[str, Path]) -> dict[str, float]:
    """Means over these windows."""
    model, windows, found = load(path).model, seen(data), {}
    if data.protocol.root == "drop":
        return evaluated(model, windows, judging(judged))
    for count in range(len(JOINTS) + 1):
        one = evaluated(model, windows.given(JOINTS[:count]), motion.scores)
        found |= {f"{name}, {count} given": value for name, value in one.items()}
    return found


def evaluated(model: Any, windows: Any, scores: Any, **told: Any) -> dict[str, float]:
    """Means of scores over windows; the last arguments are of `dvae.evaluate`."""
    found = dvae.evaluate(model, windows, scores=scores, samples=SAMPLES, references=False, progress=False, **told)
    return {name: each.mean for name, each in found["model"].items()}


def shown(name: str, scores: Sequence[Mapping[str, float]]) -> str:
    """Return the mean over seeds, followed by the value of each seed if there are several."""
    values = [each.get(name, nan) for each in scores]
    if any(map(isnan, values)):
        return "–"
    each = ", ".join(f"{value:.3f}" for value in values)
    return f"{sum(values) / len(values):.3f}" + (f" ({each})" if len(values) > 1 else "")


def spread() -> Table:
    """What another seed does to the energy score of methods with the steps of their presets, by their test windows.

    With paths to its mean over none to four. A difference of two runs has a standard deviation of sqrt(2) as much.
    """
    lines = []
    for name in TESTED:
        views = [entries(SCORES, name, view, SETS[name].methods) for view in SETS[name].views]
        for row in SETS[name].methods:
            seeds = [found[row].by_seed("energy score") for found in views if row in found]
            if (count := min(map(len, seeds), default=0)) > 1:
                deviation = np.mean([means[:count] for means in seeds], 0).std(ddof=1)
                lines.append([row, str(count), f"{deviation:.3f}", f"{2 * sqrt(2) * deviation:.2f}"])
    return Table(["", "seeds", "standard deviation", "decided from"], lines)


def work(data: Path, runs: Path, stored: Path, sections: Sequence[str], jobs: int) -> None:
    """Fit and score missing results."""
    opened = {each.protocol.name: MotionData.open(data, each.protocol) for each in SECTIONS.values()}
    asked = [SECTIONS[name].protocol for name in sections if name != "metric_models"]
    judged = fitted_metric_models(opened[TUNING.name], runs) if any(each.root == "drop" for each in asked) else {}
    prior = judged.get("prior", Path()).absolute()
    for name in sections:
        store = Store(stored, name)
        if name == "metric_models":
            of_metric_models(opened[TUNING.name], runs / name, store)
            continue
        section = SECTIONS[name]
        own = opened[section.protocol.name]
        of_references(own, Store(stored, "references"), judged)
        for case in section.cases:
            if seeds := [seed for seed in section.seeds if store.lacks(case, seed)]:
                method, training = section.of(case, prior)
                paths = swept(case, method, own, runs / name, seeds, training, jobs)
                for seed, path in zip(seeds, paths, strict=True):
                    store.add(case, seed, score(path, own, judged))


def main(
    runs: tyro.conf.Positional[Path],
    data: Path | None = None,
    sections: tuple[str, ...] = ("metric_models", SEEDS, *SECTIONS),
    jobs: int = 1,
    stored: Path = SCORES / "tuning.json",
    results: Path | None = None,
) -> None:
    """Fit and score missing results, and write the tables.

    Args:
        runs: folder of the run directories.
        data: bandai2.npz; without it nothing is fitted.
        sections: names of sections.
        jobs: number of runs at a time.
        stored: the file of scores.
        results: folder of the tables, such as benchmarks/results; None prints them.
    """
    refuse_unknown("section", sections, ("metric_models", SEEDS, *SECTIONS))
    tried = [name for name in sections if name != SEEDS]
    if data is not None:
        work(data, runs, stored, tried, jobs)
    if SEEDS in sections:
        write(results, {"tuning/seeds": spread()})
    known = Store(stored, "references").found
    for name in tried:
        columns, cases, beside = COLUMNS_OF_METRIC_MODELS, OF_METRIC_MODELS, {}
        if name != "metric_models":
            section = SECTIONS[name]
            columns, cases = section.columns, [*section.cases]
            beside = {row: known.get(f"{section.protocol.name}: {row}") for row in REFERENCES}
        found = Store(stored, name).found
        scored = {
            row: [*seeds.values()] for row, seeds in {**beside, **{c: found.get(c) for c in cases}}.items() if seeds
        }
        head = name.replace("_", " ")
        made = tabled(scored, {column: partial(shown, column) for column in columns}, head)
        write(results, {f"tuning/{name}": made})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
