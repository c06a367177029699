"""Fit and score latent spaces of gait cycles, and write their tables.

Each run has a directory under `--runs`, with measured.json. An interrupted script continues and skips existing files,
and two processes may work on other cases or seeds at once. Tables show the available files.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

import dvae
from dvae import motion
from dvae.data import Batch
from dvae.data.batch import WHOLE
from dvae.motion.segments.dataset import SegmentData
from dvae.motion.segments.embodied import SHAPE, Segments
from dvae.motion.segments.generation import KNOWN, REAL, Generated, aggregate_posterior, generate, priors, summarise
from dvae.motion.segments.interpolation import falls, interpolate
from dvae.motion.segments.reconstruction import reconstruct_segments

from .engine import OURS, Row, budget, fit_or_load, folder, interval, measure, read, settings, spread
from .results import Table, tabled, write

TUNING, HELD_OUT, PRIOR = "tuning", "held out", "prior"
SAME, OTHER = "same source", "other source"
GROUPS = {"A": "train", "B": "test"}
"""Splits of the file groups of bandai2 for tuning, which replace the split of the file."""
TRAINING: dict[str, Any] = {"batch_size": 64, "validate_every": 250}
PAIRS, STEPS = 200, 9
"""Number of interpolated pairs of a walk and a run, and steps of each, including both ends."""
FALLS = ("falls", "falls where the run is shorter")
ERROR, DURATION = "vertex error", "duration error"
KL, NORM, SPREAD = "KL", "latent norm", "latent deviation"
DRAWN = 500
"""Number of segments from each prior, on the bodies of test segments."""
FULL, FIRST, SHAPED = "both phases", "first phase alone", "guide with beta"
CASES = settings(__file__)
SECTIONS = {TUNING: CASES["named"] | CASES["tried"], HELD_OUT: CASES["named"], PRIOR: CASES["prior"]}
LENGTHS = {TUNING: 1500, HELD_OUT: 2000, PRIOR: 1500}
"""Number of training steps by section."""


@cache
def segments(section: str, file: Path, **options: Any) -> SegmentData:
    """Read gait cycles of bandai2, split by take as in the file or, for tuning, by file group."""
    people = motion.read_motion(file)
    if section != HELD_OUT:
        groups = ((clip, GROUPS.get(clip.labels["file_group"])) for clip in people)
        people = replace(people, clips=[replace(clip, split=split) for clip, split in groups if split])
    return SegmentData(str(file), people, **options)


def other_source(file: Path, timed: motion.TimedFrames) -> Segments:
    """Return all gait cycles of a source outside the training data."""
    return Segments(SegmentData.open(file).segments, timed)


def measured(model: Any, tests: Mapping[str, Segments], training: Segments, seed: int) -> dict[str, Any]:
    """Return scores of a model by test set, row and segment, and measures of its interpolations."""
    measurement: dict[str, Any] = {}
    for name, test in tests.items():
        reconstruction = reconstruct_segments(
            {OURS: model}, test, training, bound_particles=20, seed=seed, progress=False
        )
        takes = [f"{split}/{take}" for split, _, take in reconstruction.segments]
        measurement[name] = {"clips": takes, "weights": [1] * len(takes), "rows": reconstruction.rows}
    test = next(iter(tests.values()))
    generated = {
        "posterior": aggregate_posterior(model, training.all()),
        "generated": drawn(model, test, training, seed),
    }
    return {"tests": [*tests], **measurement, **generated, "interpolation": interpolated(model, test, seed)}


def drawn(model: Any, test: Segments, training: Segments, seed: int) -> dict[str, dict[str, float]]:
    """Return means of statistics of segments from N(0, I), from distributions of latents, and of test segments."""
    known, real = (Generated(model, batch[WHOLE], batch[SHAPE]) for batch in (training.all(), test.all()))
    bodies = real.shape[np.random.default_rng(seed).integers(len(test), size=DRAWN)]
    latents = priors(model, training.all())
    rows = {name: generate(model, bodies, prior=prior, seed=seed) for name, prior in latents.items()}
    return summarise({**rows, KNOWN: known, REAL: real}, known)


def interpolated(model: Any, test: Segments, seed: int) -> dict[str, Any]:
    """Interpolate between random pairs of a walk and a run that begin with the same foot, and measure the paths."""
    kinds = [(labels["content"], labels["cycle"]) for labels in test.labels]
    generator = np.random.default_rng(seed)
    ends = []
    for side in ("left", "right"):
        segments_by_content = [
            np.flatnonzero([kind == (content, side) for kind in kinds]) for content in ("walk", "run")
        ]
        ends.append(np.stack([generator.choice(those, PAIRS // 2) for those in segments_by_content]))
    first, second = (Batch(test.all()).rows(some) for some in np.concatenate(ends, 1))
    paths = interpolate(model, first, second, STEPS)
    lasts = [test.timed.lasts(batch["x"]) for batch in (first, second)]
    falling, shorter = falls(paths.durations), (lasts[1] < lasts[0]).to(paths.durations.device)
    curves = {"durations": paths.durations, "displacements": paths.displacements, "local": paths.local_pose}
    return {
        **dict(zip(FALLS, (falling.double().mean().item(), falling[shorter].double().mean().item()), strict=True)),
        "shorter": shorter.double().mean().item(),
        **{name: values.double().mean(0).tolist() for name, values in curves.items()},
    }


def run(section: str, file: Path, other: Path | None, steps: int, case: str, seed: int, out: Path) -> dict[str, Any]:
    """Fit and measure a case."""
    options = SECTIONS[section][case]
    data = segments(section, file, **options.get("data", {}))
    train, method = data.windows("train"), dvae.method("motion-latent", **options.get("method", {}))
    training = dict(TRAINING)
    if method.published:
        training |= {name: getattr(method.training(data), name) for name in ("batch_size", "gradient_clip")}
    fit = fit_or_load(method, data, train, data.windows("validation"), out=out, seed=seed, steps=steps, **training)
    tests = {SAME: data.windows("test")}
    if other is not None and section == HELD_OUT:
        tests[OTHER] = other_source(other, data.timed)
    measurement = measured(fit.model.eval(), tests, train, seed)
    return {"seconds": fit.processor_seconds, "steps": steps, **measurement}


def rows_of(path: Path, section: str) -> dict[str, Row]:
    """Return the available cases, then the linear models of the first case of each size."""
    rows, linear = read(path, SECTIONS[section]), dict[str, Row]()
    for row in rows.values():
        (name,) = row.runs[0][SAME]["rows"].keys() - {OURS}
        linear.setdefault(name, replace(row, name=name))
    return rows | linear


def errors(row: Row) -> np.ndarray:
    """Return vertex errors of all segments and seeds, in millimetres."""
    return np.concatenate(row.values(ERROR))


def falling(name: str, row: Row) -> str:
    """Format, for each seed, the share of pairs with decreasing durations."""
    return ", ".join(f"{run['interpolation'][name]:.2f}" for run in row.runs) if row.name == OURS else "–"


SCORED: dict[str, Callable[[Row], str]] = {
    "vertex error (mm)": lambda row: row.format_score(ERROR),
    "95 %": lambda row: interval(row.estimate(ERROR)),
    "median (mm)": lambda row: f"{np.median(errors(row)):.1f}",
    "duration error (ms)": lambda row: row.format_score(DURATION),
    "ELBO (nats/frame)": lambda row: row.format_score("ELBO"),
    "KL (nats)": lambda row: row.format_score(KL),
    "norm of mean": lambda row: row.format_score(NORM, 2),
    "deviation": lambda row: row.format_score(SPREAD, 2),
}
INTERPOLATED = {name: partial(falling, name) for name in FALLS}


def difference_table(cases: Mapping[str, Row]) -> Table:
    """Return a table of paired differences of vertex errors, expected below zero, with intervals."""
    linear = next(name for name in cases if cases[name].name != OURS)
    pairs = ((FULL, FIRST), (FULL, linear), (FIRST, linear), (SHAPED, FULL))
    differences = {
        f"{first} minus {second}": cases[first].estimate(ERROR, cases[second])
        for first, second in pairs
        if {first, second} <= cases.keys()
    }
    return tabled(differences, {"vertex error (mm)": lambda each: f"{each.mean:.1f}", "95 %": interval})


def prior_table(cases: Mapping[str, Row]) -> Table:
    """Return a table of segments from the priors of each case, next to real segments; means and ranges over seeds."""
    rows: dict[str, list[Mapping[str, float]]] = {}
    for case, row in cases.items():
        runs = [run for run in row.runs if "generated" in run] if row.name == OURS else []
        for prior in runs[0]["generated"] if runs else ():
            rows[f"{case}, {prior}"] = [{**run["generated"][prior], **run["posterior"]} for run in runs]
        for name in (KNOWN, REAL) if runs else ():
            del rows[f"{case}, {name}"]
            rows[name] = [runs[0]["generated"][name]]
    rows |= {name: rows.pop(name) for name in (KNOWN, REAL)}  # the last rows
    names = dict.fromkeys(name for each in rows.values() for name in each[0])

    def cell(each: Sequence[Mapping[str, float]], name: str) -> str:
        values = [run.get(name) for run in each]
        return f"{values[0]:.2f}" if len(values) == 1 and values[0] is not None else spread(values)

    return tabled(rows, {name: partial(cell, name=name) for name in names})


def tables(title: str, cases: Mapping[str, Row]) -> dict[str, Table]:
    """Return two tables of a section for each test set; interpolations are scored on the first only."""
    first, available = next(iter(cases.values())).runs[0], {}
    for test in first["tests"]:
        takes, rows = first[test]["clips"], {name: row.of(test) for name, row in cases.items()}
        costs = budget(cases.values(), first["steps"])
        note = f"{len(takes)} segments of {len({*takes})} takes. {costs}"
        name = f"motion_latent_4d/{folder(title)}-{folder(test)}"
        available[name] = tabled(rows, SCORED | (INTERPOLATED if test == SAME else {}), note=note)
        if (differences := difference_table(rows)).rows:
            available[f"{name}-differences"] = differences
    if any("generated" in run for row in cases.values() for run in row.runs):
        available[f"motion_latent_4d/{folder(title)}-generated"] = prior_table(cases)
    return available


def main(
    data: Path | None = None,
    other: Path | None = None,
    runs: Path = Path("runs/motion-latent"),
    results: Path | None = None,
    sections: tuple[str, ...] = tuple(SECTIONS),
    cases: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (0, 1, 2),
    steps: int | None = None,
) -> None:
    """Fit, score, and write the tables.

    Args:
        data: motion file with file groups (bandai2.npz); without it, nothing is fitted.
        other: motion file of a source outside the training data (cmu8.npz).
        runs: folder of the runs.
        results: folder of the tables, such as benchmarks/results; None prints them.
        sections: sections to fit.
        cases: names of cases to fit; all cases of a section if empty.
        seeds: seeds of the runs to fit.
        steps: other number of training steps of the sections, which the names of runs and tables then contain.
    """
    torch.set_num_threads(1)
    for section, length in LENGTHS.items():
        other_length = section if steps in (None, length) else f"{section}, {steps} steps"
        if data is not None and section in sections:
            fit = partial(run, section, data, other, steps or length)
            measure(runs / folder(other_length), cases or SECTIONS[section], seeds, fit)
        for title in dict.fromkeys([section, other_length]):
            if rows := rows_of(runs / folder(title), section):
                write(results, tables(title, rows))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
