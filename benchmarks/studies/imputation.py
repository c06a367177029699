"""Fit methods to public tables, hide a fifth of the entries at random, and score draws of these entries.

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
from torch import Tensor

import dvae
from dvae.data.sequences import Sequences, interpolate_missing
from dvae.inference.evaluation.metrics import continuous_ranked_probability_score

from .engine import OURS, Row, fit_or_load, measure, read, scores_of, settings
from .results import Table, ordered, tabled, write
from .tables import COVERAGE, cell, crps, load

DRAWS = 100
HIDDEN, HIDING_SEED = 0.2, 2026
"""Share of hidden entries, and the seed that hides them, the same for all runs."""
LINEAR = "interpolation"
"""Row of linear interpolation in time, plus errors of hidden entries of training windows, of logarithms if a column is
positive."""
POSITIVE = ("positive", "log-normal")
AT_ONCE = 64
"""Number of windows that are filled in at once."""
SECTIONS = settings(__file__)


@cache
def hidden_entries(name: str, part: str) -> tuple[Any, Tensor, list[str]]:
    """Return windows with fewer observed entries, which entries (N, T, D) were hidden, and each window's sequence."""
    windows = load(name).windows(part)
    batch = windows.all()
    observed = torch.ones_like(batch["x"], dtype=torch.bool) if batch.mask() is None else batch.mask()
    hidden = observed & (torch.rand(batch["x"].shape, generator=torch.Generator().manual_seed(HIDING_SEED)) < HIDDEN)
    return batch | {"mask": observed & ~hidden}, hidden, [sequence for _, sequence, _ in windows.keys]


@cache
def units(name: str) -> tuple[Tensor, Tensor]:
    """Return which coordinates (D,) are compared as logarithms, and their standard deviations in training windows."""
    data = load(name)
    logarithm = torch.tensor([c.family in POSITIVE for c in data.schema.columns.targets for _ in c.coordinates])
    batch = data.windows("train").all()
    x, mask = transformed(batch["x"], logarithm), batch.mask()
    x = x if mask is None else torch.where(mask, x, torch.nan)
    return logarithm, torch.from_numpy(np.nanstd(x.flatten(0, 1).numpy(), 0))


def transformed(x: Tensor, logarithm: Tensor) -> Tensor:
    """Return x (..., D), with logarithms of some coordinates, in float64."""
    return torch.where(logarithm, torch.where(logarithm, x.double(), 1.0).log(), x.double())


def scores(draws: Tensor, truth: Tensor, hidden: Tensor, sequences: list[str]) -> dict[str, list[float]]:
    """Return the CRPS and the coverage of hidden entries, by sequence.

    Args:
        draws: draws `(S, N, T, D)`.
        truth: true values `(N, T, D)`.
        hidden: whether an entry is hidden, `(N, T, D)`.
        sequences: name of each window's sequence.
    """
    known = truth.masked_fill(~hidden, torch.nan)
    low, high = torch.quantile(draws, torch.tensor([0.05, 0.95], dtype=draws.dtype), 0)
    inside = ((low <= truth) & (truth <= high)).double()
    by_window = {
        "CRPS": continuous_ranked_probability_score(draws.movedim(0, 1), known),
        COVERAGE: (inside * hidden).sum((1, 2)) / hidden.sum((1, 2)),
    }
    numbers = hidden.sum((1, 2)).double()
    places = {name: [n for n, each in enumerate(sequences) if each == name] for name in hidden_by(sequences, hidden)}
    return {
        score: [float((values.nan_to_num()[rows] @ numbers[rows]) / numbers[rows].sum()) for rows in places.values()]
        for score, values in by_window.items()
    }


def hidden_by(sequences: list[str], hidden: Tensor) -> dict[str, int]:
    """Return the number of hidden entries of each sequence that has some."""
    numbers = dict.fromkeys(sequences, 0)
    for sequence, number in zip(sequences, hidden.sum((1, 2)).tolist(), strict=True):
        numbers[sequence] += number
    return {sequence: number for sequence, number in numbers.items() if number}


def interpolated(name: str, part: str) -> Tensor:
    """Return draws (S, N, T, D) of interpolation in time, plus errors of the same column in training windows."""
    train, train_mask, hidden, _ = truth_of(name, "train")
    errors = train - interpolate_missing(train, train_mask)
    truth, mask, *_ = truth_of(name, part)
    draws = interpolate_missing(truth, mask).repeat(DRAWS, 1, 1, 1)
    generator = torch.Generator().manual_seed(HIDING_SEED)
    for column in range(truth.shape[-1]):
        values = errors[..., column][hidden[..., column]]
        draws[..., column] += values[torch.randint(len(values), draws.shape[:-1], generator=generator)]
    return draws


def truth_of(name: str, part: str) -> tuple[Tensor, Tensor, Tensor, list[str]]:
    """Return values (N, T, D) in units of `units`, which are observed and which hidden, and sequences of windows."""
    (batch, hidden, sequences), (logarithm, scale) = hidden_entries(name, part), units(name)
    known = torch.where(hidden | batch["mask"], batch["x"], 1.0)
    return transformed(known, logarithm) / scale, batch["mask"], hidden, sequences


def run(name: str, part: str, case: str, seed: int, out: Path) -> dict[str, Any]:
    """Fit and score a case."""
    data, section = load(name), SECTIONS[name]
    options = section["cases"][case]
    train = data.windows("train")
    method = dvae.method(options.get("method", case), **options.get("options", {})).resolve_defaults(train)
    training = {**section["training"], **options.get("training", {})}
    fit = fit_or_load(method, data, train, data.windows("validation"), out=out, seed=seed, **training)
    batch, _, _ = hidden_entries(name, part)
    torch.manual_seed(seed)
    model = fit.model.eval()
    draws = torch.cat([model.impute(rows, DRAWS, draw=True)["x"] for rows in Sequences(batch).batches(AT_ONCE)], 1)
    truth, _, hidden, sequences = truth_of(name, part)
    logarithm, scale = units(name)
    by_row = {OURS: transformed(draws, logarithm) / scale, LINEAR: interpolated(name, part)}
    rows = {row: scores(each, truth, hidden, sequences) for row, each in by_row.items()}
    return {"seconds": fit.processor_seconds, **scores_of(hidden_by(sequences, hidden), rows)}


def table(measured: Mapping[str, Mapping[str, Row]], part: str) -> Table:
    """Return a table of CRPS and coverage of each case on each table, in the order of the first one's CRPS."""
    notes, columns, rows = [f"{part.capitalize()}."], dict[str, Callable[[str], str]](), dict[str, str]()
    for name, cases in measured.items():
        runs = max((row.runs for row in cases.values()), key=len)
        available = {**cases, LINEAR: Row(runs[:1], LINEAR, trained=False)}
        seconds = (f"{case} {np.mean([one['seconds'] for one in row.runs]):.0f}" for case, row in cases.items())
        notes += [
            f"{name}: {sum(runs[0]['weights']):.0f} hidden entries of {len(runs[0]['clips'])} sequences, {len(runs)} "
            f"seeds; seconds of training: {', '.join(seconds)}."
        ]
        for score in ("CRPS", COVERAGE):
            columns[f"{name}, {score}"] = partial(_cell, available, score)
        rows |= {each: each for each in ordered(available, crps)}
    return tabled(rows, columns, note=" ".join(notes))


def _cell(available: Mapping[str, Row], score: str, name: str) -> str:
    return cell(available[name], score) if name in available else "–"


def main(
    names: tuple[str, ...] = tuple(SECTIONS),
    runs: Path = Path("runs/imputation"),
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
    measured = {name: read(runs / name, section["cases"], f"{part}.json") for name, section in SECTIONS.items()}
    if available := {name: rows for name, rows in measured.items() if rows}:
        write(results, {"tables/imputation": table(available, part)})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
