"""Tables of evaluations for the pages, put between two marks in a page whose text is written by hand."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

import dvae
from dvae.inference.training.checkpoints import CheckpointError

DOCS = Path(__file__).parents[2] / "docs"
BEGIN, END = "<!-- tables -->\n", "<!-- end of tables -->\n"


def table(header: Sequence[str], rows: Iterable[Sequence[str]], rule: str = "") -> str:
    """A Markdown table, numbers to the right, or by another rule below its head."""
    head, *lines = [f"| {' | '.join(line)} |" for line in (header, *rows)]
    head = head.replace("|  |", "| |") if rule else head
    return "\n".join([head, rule or f"| --- |{' ---: |' * (len(header) - 1)}", *lines]) + "\n"


def words(*header: str, rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table of words, to the left."""
    return table(header, rows, "|---" * len(header) + "|")


def tabled(rows: Mapping[str, Any], columns: Mapping[str, Callable[[Any], str]], head: str = "") -> str:
    """Return a table with one line for each row and one column for each function of `columns`."""
    return table([head, *columns], [[name, *(cell(row) for cell in columns.values())] for name, row in rows.items()])


def ordered(rows: Mapping[str, Any], key: Callable[[Any], float]) -> dict[str, Any]:
    """Rows in the order of a number of theirs, the least first."""
    return dict(sorted(rows.items(), key=lambda item: key(item[1])))


def code(text: str) -> str:
    """Text as Markdown code within a table."""
    return "`" + text.replace("|", "\\|") + "`"


def write(page: Path | None, *tables: str, name: str = "tables") -> None:
    """Puts tables between the marks of a page, or between those that have another name; without a page, prints them."""
    if page is None:
        print(*tables, sep="\n")
        return
    begin, end = (mark.replace("tables", name) for mark in (BEGIN, END))
    if not page.is_file():
        sys.exit(f"no page {page}; without one, tables are printed")
    before, opened, rest = page.read_text(encoding="utf-8").partition(begin)
    _, closed, after = rest.partition(end)
    if not (opened and closed):
        sys.exit(f"no marks for the table in {page}; expected the lines {begin.strip()} and {end.strip()}")
    page.write_text(before + begin + "\n" + "\n".join(tables) + "\n" + end + after, encoding="utf-8")


def refuse_unknown(what: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Ends the script where something is asked for that is not there."""
    known = [*known]
    for name in names:
        if name not in known:
            sys.exit(f"unknown {what} {name!r}; known: {', '.join(known)}")


def require_gpu(option: str) -> None:
    """End the script if an option asks for a GPU and torch finds none."""
    if not torch.cuda.is_available():
        built = "" if torch.version.cuda else ", as it is built without CUDA"
        sys.exit(f"torch {torch.__version__} finds no GPU{built}; leave the {option} out, or take a machine with one")


def loaded(run: Path) -> Any:
    """Load a run; end the script with a message if that fails."""
    try:
        return dvae.load(run)
    except CheckpointError as error:
        sys.exit(str(error))


def same(evaluation: dvae.Evaluation) -> tuple[object, ...]:
    """Return the settings that evaluations must share to be compared in one table."""
    drawn = evaluation.samples, evaluation.seed, evaluation.emission, evaluation.bound_particles
    return evaluation.data, *drawn, evaluation.basis
