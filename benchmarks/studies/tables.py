"""Fit and score methods on public tables, next to simple forecasts, and write their tables.

Each run has a directory under `--runs` with a file of scores for each scored part. An interrupted script continues and
skips existing files. Options are chosen with `--part validation`, seed 0; `--part test` scores the runs of three seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro

import dvae
from dvae.inference.evaluation.estimates import decimals
from dvae.inference.evaluation.scores import Measure, calibrated
from dvae.tables.dataset import PanelData

from .engine import OURS, Row, fit_or_load, measure, read, scores_of, settings
from .results import Table, ordered, tabled, write

FORECASTS = 100
REFERENCES = "autoregressive"
"""Case whose first seed also scores the simple forecasts."""
COVERAGE = "coverage 90 %"
SECTIONS = settings(__file__)


@cache
def load(name: str) -> PanelData:
    """Return a table with its default cut."""
    return PanelData.open(name)


def scores(windows: Any) -> list[Measure]:
    """Return the scores of the tables; with several columns, each is divided by its scale in the training data."""
    return [each for each in calibrated(windows) if each.name in ("CRPS", COVERAGE)]


def run(name: str, part: str, case: str, seed: int, out: Path) -> dict[str, Any]:
    """Fit and score a case."""
    data, section = load(name), SECTIONS[name]
    options = section["cases"][case]
    train = data.windows("train")
    method = dvae.method(options.get("method", case), **options.get("options", {})).resolve_defaults(train)
    training = {**section["training"], **options.get("training", {})}
    fit = fit_or_load(method, data, train, data.windows("validation"), out=out, seed=seed, **training)
    evaluation = dvae.evaluate(
        {OURS: fit.model.eval()},
        data.windows(part),
        scores=scores,
        samples=FORECASTS,
        seed=seed,
        training_windows=train,
        references=case == REFERENCES and seed == 0,
        progress=False,
    )
    rows = {row: each.cluster_means for row, each in evaluation.rows.items()}
    return {"seconds": fit.processor_seconds, **scores_of(evaluation.clusters, rows)}


def rows_of(cases: Mapping[str, Row]) -> tuple[dict[str, Row], dict[str, Row]]:
    """Return the rows of fitted methods and of simple forecasts, best CRPS first."""
    first = [one for row in cases.values() for one in row.runs if len(one["rows"]) > 1]
    simple = {name: Row(first, name, trained=False) for one in first for name in one["rows"] if name != OURS}
    return ordered(cases, crps), ordered(simple, crps)


def cell(row: Row, score: str = "CRPS", other: Row | None = None) -> str:
    """Return a score, or its paired difference from another row, with the error over sequences and seeds."""
    estimate = row.estimate(score, other)
    if estimate is None:
        return "–"
    error = estimate.sequences if np.isnan(estimate.total) else estimate.total
    places = decimals(estimate.mean, error)
    return f"{estimate.mean:.{places}f} ± {error:.{places}f}"


def crps(row: Row) -> float:
    """Return the mean CRPS of a row."""
    estimate = row.estimate("CRPS")
    assert estimate is not None
    return estimate.mean


def detail(cases: Mapping[str, Row], note: str) -> Table:
    """Return a table of all rows, best first, with paired differences from the best simple forecast."""
    methods, simple = rows_of(cases)
    columns: dict[str, Callable[[Row], str]] = {"CRPS": cell, COVERAGE: lambda row: cell(row, COVERAGE)}
    if simple:
        best, least = next(iter(simple.items()))
        columns[f"minus {best}"] = lambda row: "–" if row is least else cell(row, "CRPS", least)
    return tabled(ordered({**methods, **simple}, crps), columns, note=note)


def summary(available: Mapping[str, Mapping[str, Row]]) -> Table:
    """Return a line for each table: the best simple forecast, and skill and coverage of the DVAE that was chosen.

    Skill is 1 - CRPS / CRPS of the best simple forecast; its error is from the paired difference.
    """
    lines = []
    for name, cases in available.items():
        _, simple = rows_of(cases)
        best, chosen = next(iter(simple)), SECTIONS[name]["chosen"]
        row = cases[chosen]
        least, difference = crps(simple[best]), row.estimate("CRPS", simple[best])
        assert difference is not None
        error = difference.sequences if np.isnan(difference.total) else difference.total
        skill = f"{-difference.mean / least:.3f} ± {error / least:.3f}"
        lines.append([name, best, chosen, skill, cell(row, COVERAGE)])
    return Table(["", "best simple forecast", "DVAE", "skill ↑", COVERAGE], lines)


def tables(runs: Path, part: str) -> dict[str, Table]:
    """Return the tables of the scores on a part."""
    found, complete = {}, {}
    for name, section in SECTIONS.items():
        cases = read(runs / name, section["cases"], f"{part}.json")
        if not cases:
            continue
        first = max((row.runs for row in cases.values()), key=len)
        minutes = sum(one["seconds"] for row in cases.values() for one in row.runs) / 60
        note = f"{part.capitalize()}: {sum(first[0]['weights'])} windows of {len(first[0]['clips'])} sequences; "
        note += f"{len(first)} seeds; all fits took {minutes:.0f} minutes of processor time."
        found[f"tables/{name}"] = detail(cases, note)
        if rows_of(cases)[1] and section["chosen"] in cases:
            complete[name] = cases
    return found | ({"tables/summary": summary(complete)} if complete else {})


def main(
    names: tuple[str, ...] = tuple(SECTIONS),
    runs: Path = Path("runs/tables"),
    results: Path | None = None,
    part: Literal["validation", "test"] = "validation",
    cases: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (0,),
) -> None:
    """Fit, score, and write the tables.

    Args:
        names: names of the tables to fit; empty to write the results only.
        runs: folder of the runs.
        results: folder of the results, such as benchmarks/results; None prints them.
        part: split to score and to show.
        cases: names of cases to fit; all cases of a table if empty.
        seeds: seeds of the runs to fit.
    """
    torch.set_num_threads(1)
    for name in names:
        chosen = [case for case in SECTIONS[name]["cases"] if not cases or case in cases]
        measure(runs / name, chosen, seeds, partial(run, name, part), f"{part}.json")
    write(results, tables(runs, part))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
