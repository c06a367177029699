"""Tables of evaluations: `benchmarks/results/SUBJECT/NAME.csv`, with the note of a table in `NAME.txt`."""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

import dvae
from dvae.inference.training.checkpoints import CheckpointError

DOCS = Path(__file__).parents[2] / "docs"
RESULTS = Path(__file__).parents[1] / "results"


class Table(NamedTuple):
    """Cells of a table, with a note that is needed to read it."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""

    def markdown(self) -> str:
        """Return the table in Markdown, numbers to the right."""
        rule = ["---", *["---:"] * (len(self.header) - 1)]
        lines = [[cell.replace("|", "\\|") for cell in line] for line in (self.header, rule, *self.rows)]
        return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def tabled(
    rows: Mapping[str, Any], columns: Mapping[str, Callable[[Any], str]], head: str = "", note: str = ""
) -> Table:
    """Return a table with one line for each row and one column for each function of `columns`."""
    lines = [[name, *(cell(row) for cell in columns.values())] for name, row in rows.items()]
    return Table([head, *columns], lines, note)


def ordered(rows: Mapping[str, Any], key: Callable[[Any], float]) -> dict[str, Any]:
    """Sort rows by a key, smallest first."""
    return dict(sorted(rows.items(), key=lambda item: key(item[1])))


def write(folder: Path | None, tables: Mapping[str, Table]) -> None:
    """Write tables below a folder by their names, such as "bounds/sides"; without a folder, print them."""
    for name, table in tables.items():
        if folder is None:
            print(f"{name}\n", *([f"{table.note}\n"] if table.note else []), table.markdown(), sep="\n")
            continue
        file = folder / f"{name}.csv"
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("w", encoding="utf-8", newline="") as out:
            csv.writer(out, lineterminator="\n").writerows([table.header, *table.rows])
        file.with_suffix(".txt").unlink(missing_ok=True)
        if table.note:
            file.with_suffix(".txt").write_text(f"{table.note}\n", encoding="utf-8")


def read(name: str, folder: Path = RESULTS) -> Table:
    """Read a table and its note."""
    file = folder / f"{name}.csv"
    with file.open(encoding="utf-8", newline="") as lines:
        header, *rows = csv.reader(lines)
    note = file.with_suffix(".txt")
    return Table(header, rows, note.read_text(encoding="utf-8").strip() if note.exists() else "")


def refuse_unknown(what: str, names: Iterable[str], known: Iterable[str]) -> None:
    """End the script if a name is unknown."""
    known = [*known]
    for name in names:
        if name not in known:
            sys.exit(f"unknown {what} {name!r}; known: {', '.join(known)}")


def require_gpu(option: str) -> None:
    """End the script if an option asks for a GPU and torch finds none."""
    if not torch.cuda.is_available():
        built = "" if torch.version.cuda else ", as it is built without CUDA"
        sys.exit(f"torch {torch.__version__} finds no GPU{built}; leave the {option} out, or use a machine with a GPU")


def loaded(run: Path) -> Any:
    """Load a run; end the script with a message if that fails."""
    try:
        return dvae.load(run)
    except CheckpointError as error:
        sys.exit(str(error))


def same(evaluation: dvae.Evaluation) -> tuple[object, ...]:
    """Return the settings that evaluations must share to be compared in one table."""
    settings = evaluation.samples, evaluation.seed, evaluation.emission, evaluation.bound_particles
    return evaluation.data, *settings, evaluation.basis
