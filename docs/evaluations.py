"""Tables of evaluations for the pages under docs/results, between two marks in a page whose text is written by hand."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from family import BEGIN, END, table

import dvae


def joined(files: Sequence[str]) -> dvae.Evaluation:
    """Evaluations of single runs on the same windows as one, named by their files, beside the first's references."""
    found = {Path(file).stem: dvae.Evaluation.load(file) for file in files}
    first = next(iter(found.values()))
    if any(_same(each) != _same(first) for each in found.values()):
        sys.exit("these evaluations differ in windows, samples, seed, emission, multimodal threshold or judges")
    rows = {name: row for name, row in first.rows.items() if not row.config}
    for name, each in found.items():
        (own,) = (row for row in each.rows.values() if row.config)
        rows[name.replace("-", " ")] = own
    return replace(first, rows=rows, metrics={name: m for each in found.values() for name, m in each.metrics.items()})


def _same(evaluation: dvae.Evaluation) -> tuple[object, ...]:
    drawn = evaluation.samples, evaluation.seed, evaluation.emission, evaluation.bound_particles
    return evaluation.data, *drawn, evaluation.basis


def scores(evaluation: dvae.Evaluation, metrics: Sequence[str]) -> str:
    """Methods down, metrics across."""
    rows = [[name, *(str(evaluation[name].get(metric, "–")) for metric in metrics)] for name in evaluation.rows]
    return table(["", *metrics], rows)


def differences(evaluation: dvae.Evaluation, first: str, metrics: Sequence[str]) -> str:
    """What each other row of several samples has more than the first, paired."""

    def cell(name: str, metric: str) -> str:
        both = metric in evaluation[name] and metric in evaluation[first]
        return str(evaluation.difference(name, first, metric)) if both else "–"

    others = [name for name, row in evaluation.rows.items() if name != first and row.samples > 1]
    return table([f"minus {first}", *metrics], [[name, *(cell(name, m) for m in metrics)] for name in others])


def write(page: Path, *tables: str) -> None:
    """Puts tables between the marks of a page."""
    before, rest = page.read_text(encoding="utf-8").split(BEGIN)
    page.write_text(before + BEGIN + "\n" + "\n".join(tables) + "\n" + END + rest.split(END)[1], encoding="utf-8")
