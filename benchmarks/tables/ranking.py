"""Fits every method for motion on every set, scores it on the test windows, and ranks them.

Methods have the options and the training of their presets, which the tuning protocol chose (docs/results/tuning.md);
runs lie in `RUNS/SET/METHOD-seedN`, each with evaluation.json in it. The script goes on where it was stopped, and
without `--data` fits nothing: tables are of the runs that are there.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

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
    "moglow": {"decay": 0.5},
    "srnn": {"self_feeding": 1.0, "steps": 3000, "decay": 0.5},
}
"""Methods by what rows are called, with what their options are beside the presets."""
STEPS = {
    "hit-dvae": 380,
    "gsps": 920,
    "cvae": 2300,
    "gmvae": 2300,
    "bom": 570,
    "bom-parts": 470,
    "pose-knows": 1900,
    "mt-vae": 2300,
    "rhp": 2800,
    "dlow": 730,
    "dsf": 730,
    "erd": 1800,
    "aclstm": 730,
    "moglow": 1900,
    "srnn": 4300,
}
"""Of about four minutes on one processor; those of `dlow` and `dsf` are beside the ones of the CVAE below them."""
ALIKE = {row: {**options, "steps": STEPS[row]} for row, options in FUTURES.items()}
"""The same methods, equally long."""
PATHS: dict[str, dict[str, Any]] = {"trajevae": {}, "cvae-rnn": {}, "motion-infilling": {"keep": 0.15, "gap": 0.0}}


@dataclass(frozen=True)
class View:
    """What of the test windows is predicted, and how.

    Args:
        given: joints whose paths are known, those of `JOINTS` first; None where methods take no paths.
        single: one motion, at the mean of the prior, in place of draws.
        exchanged: metres within which the given joints are in another window's pose, from which motions begin; 0 for
            the window's own.
        own: of the windows that have such another one, with their own poses.
        truth: see `motion.Exchanged`.
        observed: frames, in place of the protocol's.
    """

    given: int | None = None
    single: bool = False
    exchanged: float = 0.0
    own: bool = False
    truth: Literal["path", "pose"] = "path"
    observed: int | None = None

    def windows(self, data: MotionData, split: str) -> Any:
        """Windows of a part of the data, and what is told of them."""
        observed = self.observed or data.protocol.observed
        windows = motion.windows(data.motion, replace(data.protocol, observed=observed), split)
        if self.given is None:
            return windows
        others = [name for name in windows.joints if name not in JOINTS]
        told = windows.given([*JOINTS, *others][: self.given])
        if not self.exchanged or split != "test":
            return told
        return motion.Exchanged(told, self.exchanged, own=self.own, truth=self.truth)

    def evaluate(self, samples: int) -> dict[str, Any]:
        """Arguments of `dvae.evaluate`."""
        return {"samples": 1, "options": {"temperature": 0}} if self.single else {"samples": samples}

    def __str__(self) -> str:
        """The end of the names of its evaluations."""
        told = (f"{name}-{value}" for name, value in vars(self).items() if value != getattr(View, name))
        return "-".join(["", *told])


@dataclass(frozen=True)
class Set:
    """A protocol, the file of its clips below the folder of data, and what is fitted and scored."""

    file: str
    methods: Mapping[str, Mapping[str, Any]]
    views: tuple[View, ...] = (View(),)
    judges: tuple[str, ...] = ()


BANDAI, CMU = "bandai/bandai2.npz", "cmu/cmu8.npz"
GIVEN = tuple(View(count) for count in range(5))
SETS = {
    "bandai2-by-style": Set(BANDAI, FUTURES, judges=("prior", "content", "style")),
    "bandai2-by-take": Set(BANDAI, ALIKE, judges=("prior", "content")),
    "cmu8": Set(CMU, ALIKE, judges=("prior", "content")),
    "bandai2-trajectories": Set(BANDAI, PATHS, GIVEN),
    "cmu8-trajectories": Set(CMU, PATHS, GIVEN),
}
JOINTS = ("RToe", "LToe", "LWrist", "RWrist")
"""Whose paths are given first, as in TrajeVAE's tables."""
JUDGES: dict[str, tuple[str, dict[str, Any], Training]] = {
    "prior": ("pose-prior", {"heading": True}, Training(steps=1000, learning_rate=0.01, decay=0.8)),
    "content": ("action-classifier", {}, Training(steps=3000, learning_rate=3e-3, decay=0.5, validate_every=250)),
    "style": (
        "action-classifier",
        {"label": "style"},
        Training(steps=1500, learning_rate=3e-3, decay=0.5, validate_every=250),
    ),
}
"""Methods that judge, their options and their training."""
COLUMNS = ("energy score", "ADE", "FDE", "ADEm", "MMADE", "APD", "APDE", "CMD", "limb stretch", "limb jitter")
JUDGED = ("ACC content", "FID content", "pose NLL")
RANKED = "energy score"
"""By which rows stand in order; it is proper, and the lowest is best."""
NEIGHBOURS = "nearest neighbours"


def fitted_judges(data: MotionData, runs: Path, names: Sequence[str] = ("prior", "content")) -> dict[str, Path]:
    """Run directories of judges of the training clips, fitted once."""
    for name in names:
        method, options, training = JUDGES[name]
        sweep({name: registry.judges()[method](**options)}, data, runs / "judges", (0,), training, jobs=1)
    return {name: runs / "judges" / f"{name}-seed0" for name in names}


def judging(judged: Mapping[str, Path]) -> Any:
    """The scores of motion, with those of judges where there are some."""
    models = {name: load(path).model for name, path in judged.items()}
    prior = models.pop("prior", None)
    return partial(motion.scores, pose_prior=prior, classifiers=models)


def fit(
    data: MotionData, row: str, methods: Mapping[str, Mapping[str, Any]], seed: int, runs: Path, prior: Path | None
) -> Path:
    """The run directory of a method, fitted once; second stages stand on the first of the same seed.

    Raises:
        RuntimeError: the run failed.
    """
    told, training = parted(methods[row])
    method = told.pop("method", row)
    if method in ("gsps", "hit-dvae") and prior is not None and told.get("pose_prior") != 0:
        told["pose_prior_run"] = str(prior.absolute())
    if method in ("dlow", "dsf"):
        told["cvae_run"] = str(fit(data, "cvae", {**FUTURES, **methods}, seed, runs, prior).absolute())
    (outcome,) = sweep({folder(row): dvae.method(method, **told)}, data, runs, (seed,), training, jobs=1)
    if outcome.status == "failed":
        raise RuntimeError(str(outcome))
    return runs / f"{folder(row)}-seed{seed}"


def parted(options: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Options of a method, and those of its training."""
    # methods have options of that name, which make the schedule of training's
    training = Training.__dataclass_fields__.keys() - {"self_feeding"}
    return (
        {name: value for name, value in options.items() if name not in training},
        {name: value for name, value in options.items() if name in training},
    )


def folder(row: str) -> str:
    """What the runs of a row are called, before their seed."""
    return row.replace(", ", "-").replace(" ", "-")


def work(
    data: Path,
    runs: Path,
    name: str,
    methods: Mapping[str, Mapping[str, Any]],
    views: Mapping[str, Sequence[View]],
    seeds: Sequence[int],
    samples: int,
) -> None:
    """Fits and scores what is not there yet, seed by seed, so that every method has one before any has two.

    Args:
        data: the folder of files.
        runs: of all sets.
        name: of the set.
        methods: by the rows that they are.
        views: in which each is scored; the reference rows in all of them.
        seeds: of every method.
        samples: futures of a window.
    """
    opened = MotionData.open(data / SETS[name].file, motion.PROTOCOLS[name])
    judged = fitted_judges(opened, runs / name, SETS[name].judges)
    scores = judging(judged)

    def score(path: Path, row: str | None, view: View) -> None:
        file = evaluation(path, view)
        if not file.exists():
            models = {} if row is None else {row: load(path).model}
            known: dict[str, Any] = {"training_windows": view.windows(opened, "train+validation")}
            options = {"references": False} if models else known
            windows, told = view.windows(opened, "test"), view.evaluate(samples)
            dvae.evaluate(models, windows, scores=scores, batch_size=64, **options, **told).save(file)

    for view in dict.fromkeys(view for each in views.values() for view in each):
        if not (view.single or view.exchanged):
            score(runs / name, None, view)
    for seed in seeds:
        for row in methods:
            path = fit(opened, row, methods, seed, runs / name, judged.get("prior"))
            for view in views[row]:
                score(path, row, view)


def evaluation(path: Path, view: View) -> Path:
    """The file of scores of a run, or of the reference rows of a set."""
    return path / f"evaluation{view}.json"


@dataclass(frozen=True)
class Entry:
    """A row of a ranking: the evaluations of its seeds, and the minutes of processor time that each fit took."""

    seeds: Sequence[Evaluation]
    minutes: Sequence[float]

    def means(self, metric: str) -> np.ndarray | None:
        """(S, C), by seed and clip, where all have the score."""
        (name,) = {name for each in self.seeds for name in each.rows}
        rows = [each.rows[name].clip_means for each in self.seeds]
        return np.array([row[metric] for row in rows]) if all(metric in row for row in rows) else None

    def crossed(self, metric: str, minus: Entry | None = None) -> Crossed | None:
        """A score, or what it is more than that of the same runs in another view of the same windows."""
        means, others = self.means(metric), 0.0 if minus is None else minus.means(metric)
        if means is None or others is None:
            return None
        means, weights = means - others, np.array([*self.seeds[0].clips.values()])
        known = ~np.isnan(means).any(0)
        crossed = Crossed.of(means[:, known], weights[known])
        # a reference is not trained: no seed of it differs from another
        return crossed if self.minutes else replace(crossed, seeds=0.0, rest=0.0, count=sys.maxsize)


def entries(runs: Path, name: str, view: View, methods: Iterable[str]) -> dict[str, Entry]:
    """What has been scored on a set: the reference rows, and methods with their seeds.

    Raises:
        ValueError: evaluations of other windows, samples, or judges.
    """
    found, basis = {}, None
    file = evaluation(runs / name, view)
    if file.exists():
        references = Evaluation.load(file)
        basis = same(references)
        found = {row: Entry([replace(references, rows={row: value})], []) for row, value in references.rows.items()}
    for row in methods:
        files = sorted((runs / name).glob(f"{folder(row)}-seed*/evaluation{view}.json"))
        scored = [Evaluation.load(file) for file in files]
        for each in scored:
            basis = basis or same(each)
            if same(each) != basis:
                raise ValueError(
                    f"evaluations of {row} below {runs / name} are of other windows, samples, seed or judges"
                )
        if scored:
            times = [Run(file.parent).state.get("processor_seconds", 0.0) / 60 for file in files]
            found[row] = Entry(scored, times)
    return found


def cell(estimate: Estimate | None) -> str:
    """A mean with its standard error over clips, and over seeds of what is trained."""
    if estimate is None:
        return "–"
    return str(estimate) if estimate.seeds else str(estimate).rpartition(" ± ")[0]


TRAINED = ("seeds", "CPU minutes")


def trained(entry: Entry) -> tuple[str, str]:
    """How many seeds were trained, and how long each took."""
    return (str(len(entry.seeds)), f"{statistics.fmean(entry.minutes):.1f}") if entry.minutes else ("–", "–")


def ranking(found: Mapping[str, Entry], columns: Sequence[str]) -> str:
    """Rows in order of the energy score, each with what it has more than the neighbours and than the next better."""

    def score_of(name: str) -> Crossed:
        crossed = found[name].crossed(RANKED)
        assert crossed is not None  # of all motion
        return crossed

    order = sorted((name for name in found if name != "real motion"), key=lambda name: score_of(name).mean)
    header = ["", *TRAINED, f"{RANKED} minus neighbours'", "minus the one above", *columns]
    lines = []
    for place, name in enumerate(order):
        own = found[name]
        minus = [None if name == NEIGHBOURS else NEIGHBOURS, order[place - 1] if place else None]
        behind = [None if other is None else score_of(name).estimate(score_of(other)) for other in minus]
        means = [None if crossed is None else crossed.estimate() for crossed in map(own.crossed, columns)]
        lines.append([name, *trained(own), *map(cell, [*behind, *means])])
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
        chosen = SETS[name]
        if data is not None:
            named = {row: options for row, options in chosen.methods.items() if not methods or row in methods}
            work(data, runs, name, named, dict.fromkeys(named, chosen.views), seeds, samples)
        tables = []
        for view in chosen.views:
            if found := entries(runs, name, view, chosen.methods):
                heading = "" if view.given is None else f"With {view.given} paths given:\n\n"
                tables.append(heading + ranking(found, [*COLUMNS, *(JUDGED if chosen.judges else ())]))
        if tables:
            write(page, *tables, name=name)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
