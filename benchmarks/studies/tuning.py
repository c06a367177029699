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

from .engine import settings, sweep_seeds
from .ranking import JOINTS, METRIC_MODELS, SCORES, SETS, entries, fitted_metric_models, motion_scores, split_options
from .results import Table, refuse_unknown, tabled, write

TUNING = motion.PROTOCOLS["bandai2-tuning"]
EVERY, SAMPLES = 4, 50
REFERENCES = ("zero velocity", "nearest neighbours")
COLUMNS_OF_METRIC_MODELS = ("log density", "pose NLL", "ACC content")
COLUMNS = ("ADE", "FDE", "ADEm", "APD", "energy score", "ACC content", "FID content", "pose NLL", "KL w", "KL z")
"""Scores in the tables, if they are available."""
SEEDS, TESTED = "seeds", ("bandai2-by-style", "bandai2-trajectories")
"""Name of the table of the spread over seeds, and the sets that provide its rows."""
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
        uses_pose_prior: whether methods with a pose prior use the one of the metric models.
        seeds: seeds of each case.
    """

    method: str
    training: Training
    cases: Mapping[str, Mapping[str, Any]]
    options: Mapping[str, Any] = field(default_factory=dict)
    protocol: motion.Protocol = TUNING
    uses_pose_prior: bool = False
    seeds: tuple[int, ...] = (0,)

    @property
    def columns(self) -> Sequence[str]:
        """Columns of the section's table."""
        return COLUMNS if self.protocol.root == "drop" else PATH_COLUMNS

    def of(self, case: str, prior: Path) -> tuple[Any, Training]:
        """Return the method and the training of a case."""
        options, training_options = split_options({**self.options, **self.cases[case]})
        method = options.pop("method", self.method)
        applies = self.uses_pose_prior and hasattr(dvae.methods()[method], "pose_prior_run")
        # the pose prior of the metric models reads poses that are rotated to one heading
        if applies and options.get("pose_prior") != 0 and options.get("heading", True):
            options["pose_prior_run"] = str(prior)
        return dvae.method(method, **options), replace(self.training, **training_options)


PATHS = replace(motion.PROTOCOLS["bandai2-trajectories"], name="bandai2-paths-tuning", train=("A",), test=("B",))


def read_section(options: Mapping[str, Any]) -> Section:
    """Return the section that one table of the TOML file describes."""
    fields = {name: value for name, value in options.items() if name not in ("training", "paths", "judged")}
    return Section(
        training=Training(**options["training"]),
        protocol=PATHS if options.get("paths", False) else TUNING,
        uses_pose_prior=options.get("judged", False),
        **fields,
    )


SECTIONS = {name: read_section(options) for name, options in settings(__file__).items()}


STEPS = {"prior": (500, 1000, 2000, 4000), "content": (750, 1500, 3000, 6000)}
"""Numbers of training steps of metric models, which must generalise to unseen styles."""
SEEDS_OF = {"prior": (0, 1, 2), "content": (0,)}
OF_METRIC_MODELS = [f"{metric_model} {steps} steps" for metric_model, tried in STEPS.items() for steps in tried]


ScoresByCase = dict[str, dict[str, dict[str, float]]]
"""Means of scores, by case and seed."""


class Store:
    """Scores of a section; one JSON file contains all sections."""

    def __init__(self, file: Path, section: str) -> None:
        self.file, self.section = file, section
        self.all: dict[str, ScoresByCase] = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}

    @property
    def scores(self) -> ScoresByCase:
        """Scores by case and seed; empty before the first."""
        return self.all.get(self.section, {})

    def add(self, case: str, seed: int, scores: Mapping[str, float]) -> None:
        """Add the scores of one seed of a case to the stored ones."""
        self.all = Store(self.file, self.section).all
        cases = self.all.setdefault(self.section, {})
        cases.setdefault(case, {})[str(seed)] = {name: round(value, 4) for name, value in scores.items()}
        self.file.parent.mkdir(parents=True, exist_ok=True)
        self.file.write_text(json.dumps(self.all, indent=1) + "\n", encoding="utf-8")

    def is_missing(self, case: str, seed: int) -> bool:
        """Return whether a case has no scores for a seed."""
        return str(seed) not in self.scores.get(case, {})


def of_metric_models(data: MotionData, runs: Path, store: Store) -> None:
    """Fit metric models with other numbers of steps, and score real motion of group B with each."""
    for row in OF_METRIC_MODELS:
        name, steps, _ = row.split()
        method, options, training = METRIC_MODELS[name]
        for seed in [seed for seed in SEEDS_OF[name] if store.is_missing(row, seed)]:
            training_options = replace(training, steps=int(steps))
            (path,) = sweep_seeds(
                row, registry.metric_models()[method](**options), data, runs, (seed,), training_options
            )
            store.add(row, seed, of_metric_model(name, path, selection_windows(data)))


def of_metric_model(name: str, run: Path, windows: motion.Windows) -> dict[str, float]:
    """Return the scores of a metric model on the predicted frames of real windows."""
    if name == "prior":
        prior, motions = load(run).model, windows.all()["x"]
        poses = prior.facing(motions)[:, windows.protocol.observed :]
        with torch.no_grad():
            energy = pose_prior_energy(poses[None], prior, prior.skeleton).mean()
            return {"log density": prior.log_prob(poses).mean().item(), "pose NLL": energy.item()}
    evaluation = dvae.evaluate(
        {}, windows, scores=motion_scores({name: run}), samples=1, references=["zero velocity"], progress=False
    )
    return {f"ACC {name}": evaluation["real motion"][f"ACC {name}"].mean}


def of_references(data: MotionData, store: Store, metric_models: Mapping[str, Path]) -> None:
    """Score the missing references, which use no given paths."""
    drop, name = data.protocol.root == "drop", data.protocol.name
    rows = [row for row in REFERENCES if store.is_missing(f"{name}: {row}", 0)]
    if not rows:
        return
    train = motion.windows(data.motion, data.protocol, "train+validation")
    options = {
        "scores": motion_scores(metric_models) if drop else motion.scores,
        "references": rows,
        "training_windows": train,
    }
    evaluation = dvae.evaluate({}, selection_windows(data), samples=SAMPLES, progress=False, **options)
    for row in rows:
        means = {score: each.mean for score, each in evaluation[row].items()}
        ways = [""] if drop else [f", {count} given" for count in range(len(JOINTS) + 1)]
        store.add(f"{name}: {row}", 0, {f"{score}{way}": mean for score, mean in means.items() for way in ways})


def selection_windows(data: MotionData) -> motion.Windows:
    """Return every fourth test window of each clip of group B, including the first."""
    protocol = replace(data.protocol, test_stride=EVERY * data.protocol.test_stride)
    return motion.windows(data.motion, protocol, "test")


def score(path: Path, data: MotionData, metric_models: Mapping[str, Path]) -> dict[str, float]:
    """Return the mean scores of a run on the selection windows."""
    model, windows, means = load(path).model, selection_windows(data), {}
    if data.protocol.root == "drop":
        return mean_scores(model, windows, motion_scores(metric_models))
    for count in range(len(JOINTS) + 1):
        one = mean_scores(model, windows.given(JOINTS[:count]), motion.scores)
        means |= {f"{name}, {count} given": value for name, value in one.items()}
    return means


def mean_scores(model: Any, windows: Any, scores: Any, **options: Any) -> dict[str, float]:
    """Return mean scores over windows; further options are arguments of `dvae.evaluate`."""
    evaluation = dvae.evaluate(
        model, windows, scores=scores, samples=SAMPLES, references=False, progress=False, **options
    )
    return {name: each.mean for name, each in evaluation["model"].items()}


def score_cell(name: str, scores: Sequence[Mapping[str, float]]) -> str:
    """Return the mean over seeds, followed by the value of each seed if there are several."""
    values = [each.get(name, nan) for each in scores]
    if any(map(isnan, values)):
        return "–"
    each = ", ".join(f"{value:.3f}" for value in values)
    return f"{sum(values) / len(values):.3f}" + (f" ({each})" if len(values) > 1 else "")


def spread() -> Table:
    """Return a table of the deviation over seeds of the energy score on test windows, with the presets' steps.

    For methods with paths, scores are means over zero to four paths. A difference of two runs has sqrt(2) times the
    standard deviation.
    """
    lines = []
    for name in TESTED:
        views = [entries(SCORES, name, view, SETS[name].methods) for view in SETS[name].views]
        for row in SETS[name].methods:
            seeds = [rows[row].by_seed("energy score") for rows in views if row in rows]
            if (count := min(map(len, seeds), default=0)) > 1:
                deviation = np.mean([means[:count] for means in seeds], 0).std(ddof=1)
                lines.append([row, str(count), f"{deviation:.3f}", f"{2 * sqrt(2) * deviation:.2f}"])
    return Table(["", "seeds", "standard deviation", "decided from"], lines)


def work(
    data: Path, runs: Path, stored: Path, sections: Sequence[str], cases: Sequence[str], seeds: Sequence[int], jobs: int
) -> None:
    """Fit and score missing results."""
    datasets = {each.protocol.name: MotionData.open(data, each.protocol) for each in SECTIONS.values()}
    protocols = [SECTIONS[name].protocol for name in sections if name != "metric_models"]
    needs_metric_models = any(each.root == "drop" for each in protocols)
    metric_models = fitted_metric_models(datasets[TUNING.name], runs) if needs_metric_models else {}
    prior = metric_models.get("prior", Path()).absolute()
    for name in sections:
        store = Store(stored, name)
        if name == "metric_models":
            of_metric_models(datasets[TUNING.name], runs / name, store)
            continue
        section = SECTIONS[name]
        data_set = datasets[section.protocol.name]
        of_references(data_set, Store(stored, "references"), metric_models)
        for case in [case for case in section.cases if not cases or case in cases]:
            if missing := [seed for seed in seeds or section.seeds if store.is_missing(case, seed)]:
                method, training = section.of(case, prior)
                paths = sweep_seeds(case, method, data_set, runs / name, missing, training, jobs)
                for seed, path in zip(missing, paths, strict=True):
                    store.add(case, seed, score(path, data_set, metric_models))


def main(
    runs: tyro.conf.Positional[Path],
    data: Path | None = None,
    sections: tuple[str, ...] = ("metric_models", SEEDS, *SECTIONS),
    cases: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (),
    jobs: int = 1,
    stored: Path = SCORES / "tuning.json",
    results: Path | None = None,
) -> None:
    """Fit and score missing results, and write the tables.

    Args:
        runs: folder of the run directories.
        data: bandai2.npz; without it nothing is fitted.
        sections: names of sections.
        cases: names of cases to fit; all cases of a section if empty. Metric models have none.
        seeds: seeds to fit, in place of the section's.
        jobs: number of runs at a time.
        stored: the file of scores.
        results: folder of the tables, such as benchmarks/results; None prints them.
    """
    refuse_unknown("section", sections, ("metric_models", SEEDS, *SECTIONS))
    refuse_unknown("case", cases, (case for name in sections if name in SECTIONS for case in SECTIONS[name].cases))
    names = [name for name in sections if name != SEEDS]
    if data is not None:
        work(data, runs, stored, names, cases, seeds, jobs)
    if SEEDS in sections:
        write(results, {"tuning/seeds": spread()})
    references = Store(stored, "references").scores
    for name in names:
        columns, shown, reference_rows = COLUMNS_OF_METRIC_MODELS, OF_METRIC_MODELS, {}
        if name != "metric_models":
            section = SECTIONS[name]
            columns, shown = section.columns, [*section.cases]
            reference_rows = {row: references.get(f"{section.protocol.name}: {row}") for row in REFERENCES}
        stored_scores = Store(stored, name).scores
        rows = {
            row: [*seeds.values()]
            for row, seeds in {**reference_rows, **{c: stored_scores.get(c) for c in shown}}.items()
            if seeds
        }
        head = name.replace("_", " ")
        table = tabled(rows, {column: partial(score_cell, column) for column in columns}, head)
        write(results, {f"tuning/{name}": table})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
