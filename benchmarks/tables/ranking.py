"""Fits every method for motion on every set, scores it on the test windows, and ranks them.

Methods have the options and the training of their presets, which the tuning protocol chose (docs/results/tuning.md);
runs lie in `RUNS/SET/METHOD-seedN`, each with evaluation.json in it. The script goes on where it was stopped, and
without `--data` fits nothing: tables are of the runs that are there.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import dvae
from dvae import Evaluation, Training, motion
from dvae.inference.checkpoints import Run
from dvae.inference.comparison import Crossed, Estimate
from dvae.models import registry
from dvae.motion.dataset import MotionData
from dvae.runs.directory import load
from dvae.runs.sweep import sweep

from .pages import same, table, write

FUTURES: dict[str, dict[str, Any]] = {
    "hit-dvae": {},
    "gsps": {},
    "cvae": {},
    "gmvae": {"method": "cvae", "components": 50},
    "bom": {},
    "bom-parts": {},
    "pose-knows": {},
    "mt-vae": {},
    "rhp": {},
    "dlow": {},
    "dsf": {},
    "erd": {},
    "aclstm": {},
    "moglow": {},
    "srnn": {"self_feeding": 1.0},
}
"""Methods by what rows are called, with what their options are beside the presets."""
PATHS: dict[str, dict[str, Any]] = {"trajevae": {}, "cvae-rnn": {}, "motion-infilling": {"keep": 0.15, "gap": 0.0}}


@dataclass(frozen=True)
class Set:
    """A protocol, the file of its clips below the folder of data, and what is fitted."""

    file: str
    methods: Mapping[str, Mapping[str, Any]]
    given: tuple[int, ...] = ()
    """Numbers of joints whose paths are known, of `JOINTS`; none where methods take no paths."""

    @property
    def counts(self) -> tuple[int, ...]:
        """The evaluations of a run."""
        return self.given or (0,)

    def told(self, windows: motion.Windows, count: int) -> motion.Windows:
        """Windows with so many paths."""
        return windows.given(JOINTS[:count]) if self.given else windows


BANDAI, CMU = "bandai/bandai2.npz", "cmu/cmu8.npz"
SETS = {
    "bandai2-by-style": Set(BANDAI, FUTURES),
    "bandai2-by-take": Set(BANDAI, FUTURES),
    "cmu8": Set(CMU, FUTURES),
    "bandai2-trajectories": Set(BANDAI, PATHS, (0, 1, 2, 3, 4)),
    "cmu8-trajectories": Set(CMU, PATHS, (0, 1, 2, 3, 4)),
}
JOINTS = ("RToe", "LToe", "LWrist", "RWrist")
"""Whose paths are given, the first none to four of them, as in TrajeVAE's tables."""
JUDGES: dict[str, tuple[str, dict[str, Any], Training]] = {
    "prior": ("pose-prior", {"heading": True}, Training(steps=1000, learning_rate=0.01, decay=0.8)),
    "content": ("action-classifier", {}, Training(steps=3000, learning_rate=3e-3, decay=0.5, validate_every=250)),
}
COLUMNS = ("energy score", "ADE", "FDE", "ADEm", "MMADE", "APD", "APDE", "CMD", "limb stretch", "limb jitter")
JUDGED = ("ACC content", "FID content", "pose NLL")
RANKED = "energy score"
"""By which rows stand in order; it is proper, and the lowest is best."""
NEIGHBOURS = "nearest neighbours"


def fitted_judges(data: MotionData, runs: Path) -> dict[str, Path]:
    """Run directories of the pose prior and the classifier of contents, of the training clips; fitted once."""
    for name, (method, options, training) in JUDGES.items():
        sweep({name: registry.judges()[method](**options)}, data, runs / "judges", (0,), training, jobs=1)
    return {name: runs / "judges" / f"{name}-seed0" for name in JUDGES}


def judging(judged: Mapping[str, Path]) -> Any:
    """The scores of motion, with those of judges where there are some."""
    models = {name: load(path).model for name, path in judged.items()}
    prior = models.pop("prior", None)
    return partial(motion.scores, pose_prior=prior, classifiers=models)


def fit(data: MotionData, name: str, options: Mapping[str, Any], seed: int, runs: Path, prior: Path | None) -> Path:
    """The run directory of a method, fitted once; second stages stand on the first of the same seed.

    Raises:
        RuntimeError: the run failed.
    """
    told, training = parted(options)
    method = told.pop("method", name)
    if method in ("gsps", "hit-dvae") and prior is not None:
        told["pose_prior_run"] = str(prior.absolute())
    if method in ("dlow", "dsf"):
        told["cvae_run"] = str(fit(data, "cvae", FUTURES["cvae"], seed, runs, prior).absolute())
    (outcome,) = sweep({name: dvae.method(method, **told)}, data, runs, (seed,), training, jobs=1)
    if outcome.status == "failed":
        raise RuntimeError(str(outcome))
    return runs / f"{name}-seed{seed}"


def parted(options: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Options of a method, and those of its training."""
    # methods have options of that name, which make the schedule of training's
    training = Training.__dataclass_fields__.keys() - {"self_feeding"}
    return (
        {name: value for name, value in options.items() if name not in training},
        {name: value for name, value in options.items() if name in training},
    )


def score(
    file: Path, models: Mapping[str, Any], windows: motion.Windows, training: Any, scores: Any, samples: int
) -> None:
    """Evaluates once; without a model the reference rows."""
    if not file.exists():
        options: dict[str, Any] = {} if models else {"references": True, "training_windows": training}
        dvae.evaluate(
            models, windows, scores=scores, samples=samples, batch_size=64, **{"references": False, **options}
        ).save(file)


def work(data: Path, runs: Path, name: str, methods: Sequence[str], seeds: Sequence[int], samples: int) -> None:
    """Fits and scores what is not there yet, seed by seed, so that every method has one before any has two."""
    chosen = SETS[name]
    opened = MotionData.open(data / chosen.file, motion.PROTOCOLS[name])
    judged = fitted_judges(opened, runs / name) if opened.protocol.root == "drop" else {}
    windows, training = opened.windows("test"), opened.windows("train+validation")
    scores = judging(judged)
    for count in chosen.counts:
        given = chosen.told(windows, count)
        score(runs / name / f"references{stored(count)}", {}, given, training, scores, samples)
    for seed in seeds:
        for method, options in chosen.methods.items():
            if not methods or method in methods:
                path = fit(opened, method, options, seed, runs / name, judged.get("prior"))
                for count in chosen.counts:
                    file = path / f"evaluation{stored(count)}"
                    found = {} if file.exists() else {method: load(path).model}
                    score(file, found, chosen.told(windows, count), None, scores, samples)


def stored(count: int) -> str:
    """The end of the name of the file of an evaluation with so many paths given."""
    return f"-{count}.json" if count else ".json"


@dataclass(frozen=True)
class Entry:
    """A row of a ranking: the evaluations of its seeds, and the minutes of processor time that each fit took."""

    seeds: Sequence[Evaluation]
    minutes: Sequence[float]

    def crossed(self, metric: str) -> Crossed | None:
        """Means by seed and clip, where all have the score."""
        (name,) = {name for each in self.seeds for name in each.rows}
        rows = [each.rows[name].clip_means for each in self.seeds]
        if not all(metric in row for row in rows):
            return None
        means, weights = np.array([row[metric] for row in rows]), np.array([*self.seeds[0].clips.values()])
        known = ~np.isnan(means).any(0)
        crossed = Crossed.of(means[:, known], weights[known])
        # a reference is not trained: no seed of it differs from another
        return crossed if self.minutes else replace(crossed, seeds=0.0, rest=0.0, count=sys.maxsize)


def entries(runs: Path, name: str, count: int) -> dict[str, Entry]:
    """What has been scored on a set: the reference rows, and every method with its seeds.

    Raises:
        ValueError: evaluations of other windows, samples, or judges.
    """
    file = runs / name / f"references{stored(count)}"
    if not file.exists():
        return {}
    references = Evaluation.load(file)
    found = {row: Entry([replace(references, rows={row: value})], []) for row, value in references.rows.items()}
    for method in SETS[name].methods:
        paths = sorted(path.parent for path in (runs / name).glob(f"{method}-seed*/evaluation{stored(count)}"))
        scored = [Evaluation.load(path / f"evaluation{stored(count)}") for path in paths]
        if any(same(each) != same(references) for each in scored):
            raise ValueError(
                f"evaluations of {method} below {runs / name} are of other windows, samples, seed or judges"
            )
        if scored:
            found[method] = Entry(scored, [Run(path).state.get("processor_seconds", 0.0) / 60 for path in paths])
    return found


def cell(estimate: Estimate | None) -> str:
    """A mean with its standard error over clips, and over seeds of what is trained."""
    if estimate is None:
        return "–"
    return str(estimate) if estimate.seeds else str(estimate).rpartition(" ± ")[0]


def ranking(found: Mapping[str, Entry], columns: Sequence[str]) -> str:
    """Rows in order of the energy score, each with what it has more than the neighbours and than the next better."""

    def score_of(name: str) -> Crossed:
        crossed = found[name].crossed(RANKED)
        assert crossed is not None  # of all motion
        return crossed

    order = sorted((name for name in found if name != "real motion"), key=lambda name: score_of(name).mean)
    header = ["", "seeds", "CPU minutes", f"{RANKED} minus neighbours'", "minus the one above", *columns]
    lines = []
    for place, name in enumerate(order):
        own = found[name]
        minus = [None if name == NEIGHBOURS else NEIGHBOURS, order[place - 1] if place else None]
        behind = [None if other is None else score_of(name).estimate(score_of(other)) for other in minus]
        took = f"{statistics.fmean(own.minutes):.1f}" if own.minutes else "–"
        means = [None if crossed is None else crossed.estimate() for crossed in map(own.crossed, columns)]
        lines.append([name, str(len(own.seeds)) if own.minutes else "–", took, *map(cell, [*behind, *means])])
    return table(header, lines)


def main(
    runs: tyro.conf.Positional[Path],
    data: Path | None = None,
    sets: tuple[str, ...] = tuple(SETS),
    methods: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (0, 1, 2),
    samples: int = 50,
    page: Path | None = None,
) -> None:
    """Fit and score what is missing, and write the tables.

    Args:
        runs: where run directories lie.
        data: the folder with bandai/ and cmu/; without it nothing is fitted.
        sets: which.
        methods: of these alone; all of a set where none is named.
        seeds: of every method.
        samples: futures of a window.
        page: whose tables; without one they are printed.
    """
    for name in sets:
        if data is not None:
            work(data, runs, name, methods, seeds, samples)
        tables = []
        for count in SETS[name].counts:
            if found := entries(runs, name, count):
                judged = JUDGED if motion.PROTOCOLS[name].root == "drop" else ()
                heading = f"With {count} paths given:\n\n" if SETS[name].given else ""
                tables.append(heading + ranking(found, [*COLUMNS, *judged]))
        if tables:
            write(page, *tables, name=name)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
