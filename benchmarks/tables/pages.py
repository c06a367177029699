"""Tables of evaluations for the pages, put between two marks in a page whose text is written by hand."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import torch

import dvae

DOCS = Path(__file__).parents[2] / "docs"
BEGIN, END = "<!-- tables -->\n", "<!-- end of tables -->\n"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, numbers to the right."""
    lines = [header, ["---"] + ["---:"] * (len(header) - 1), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def code(text: str) -> str:
    """Text as Markdown code within a table."""
    return "`" + text.replace("|", "\\|") + "`"


def write(page: Path | None, *tables: str, name: str = "tables") -> None:
    """Puts tables between the marks of a page, or between those that have another name; without a page, prints them."""
    if page is None:
        print(*tables, sep="\n")
        return
    begin, end = (mark.replace("tables", name) for mark in (BEGIN, END))
    before, rest = page.read_text(encoding="utf-8").split(begin)
    page.write_text(before + begin + "\n" + "\n".join(tables) + "\n" + end + rest.split(end)[1], encoding="utf-8")


def refuse_unknown(what: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Ends the script where something is asked for that is not there."""
    known = [*known]
    for name in names:
        if name not in known:
            sys.exit(f"unknown {what} {name!r}; known: {', '.join(known)}")


def require_gpu(option: str) -> None:
    """Ends the script where an option asks for a GPU and there is none."""
    if not torch.cuda.is_available():
        built = "" if torch.version.cuda else ", as it is built without CUDA"
        sys.exit(f"torch {torch.__version__} finds no GPU{built}; leave the {option} out, or take a machine with one")


def joined(files: Sequence[Path]) -> tuple[dvae.Evaluation, str]:
    """Evaluations of single runs on the same windows as one, named by their files, beside the first's references.

    And the name of the first run.
    """
    found = {file.stem.replace("-", " "): dvae.Evaluation.load(file) for file in files}
    first = next(iter(found.values()))
    if any(same(each) != same(first) for each in found.values()):
        sys.exit("these evaluations differ in windows, samples, seed, emission, multimodal threshold or judges")
    rows = {name: row for name, row in first.rows.items() if not row.config}
    for name, each in found.items():
        (rows[name],) = (row for row in each.rows.values() if row.config)
    metrics = {name: metric for each in found.values() for name, metric in each.metrics.items()}
    return replace(first, rows=rows, metrics=metrics), next(iter(found))


def same(evaluation: dvae.Evaluation) -> tuple[object, ...]:
    """What evaluations have in common whose scores stand in one table."""
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
