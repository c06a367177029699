"""Fill the tables of docs/results from benchmarks/results, as the file cards.toml says.

    [hit_dvae.main]                     # between the marks of the table "main" in docs/results/hit_dvae.md
    source = "index/bandai2-by-style"
    rows = ["hit-dvae", "bom"]          # by the first column, in this order; without it, all rows;
                                        # or { "HiT-DVAE" = "hit-dvae" }: name in the card = name in the source
    where = { given = "2" }             # optional: only rows with these cells
    columns = { "ADE (m) ↓" = "ADE" }   # header in the card = header in the source

A cell has one error, the total: of `score ± a ± b` it is the root of a² + b².
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import tyro

from .engine import settings
from .results import DOCS, Table, read

CARDS = settings(__file__)


def with_total(cell: str) -> str:
    """Return a cell with the total of its errors, in the decimals of the score; unknown if one of them is."""
    score, *errors = cell.split(" ± ")
    if not errors:
        return cell
    unit = "%" * score.endswith("%")
    if "–" in errors:
        return f"{score} ± –"
    total = math.hypot(*(float(error.removesuffix("%")) for error in errors))
    decimals = len(score.removesuffix("%").partition(".")[2])
    return f"{float(score.removesuffix('%')):.{decimals}f}{unit} ± {total:.{decimals}f}{unit}"


def card(
    source: str,
    columns: Mapping[str, str],
    rows: Sequence[str] | Mapping[str, str] = (),
    where: Mapping[str, str] = MappingProxyType({}),
) -> Table:
    """Return a table of a card.

    Raises:
        ValueError: the source has no such row or column, or several such rows.
    """
    table = read(source)
    if missing := {*columns.values(), *where} - {*table.header}:
        raise ValueError(f"{source} has no columns {sorted(missing)}; columns: {', '.join(table.header[1:])}")
    lines = [dict(zip(table.header, row, strict=True)) for row in table.rows]
    lines = [line for line in lines if all(line[name] == value for name, value in where.items())]
    names = [line[table.header[0]] for line in lines]
    cells = []
    labels = rows if isinstance(rows, Mapping) else {row: row for row in rows or names}
    for label, row in labels.items():
        if names.count(row) != 1:
            raise ValueError(f"{source} has {names.count(row)} rows {row!r}, expected one; rows: {', '.join(names)}")
        line = lines[names.index(row)]
        cells.append([label, *(with_total(line[name]) for name in columns.values())])
    return Table(["", *columns], cells)


def filled(page: str, tables: Mapping[str, Any]) -> str:
    """Return the text of a page with its tables between their marks.

    Raises:
        ValueError: a table has no marks, or marks have no table.
    """
    text = (DOCS / "results" / f"{page}.md").read_text(encoding="utf-8")
    marked = re.findall(r"<!-- table: (.*) -->", text)
    if sorted(marked) != sorted(tables):
        raise ValueError(f"{page}.md has marks for {marked}, cards.toml tables for {[*tables]}")
    for name, told in tables.items():
        block = f"<!-- table: {name} -->\n\n{card(**told).markdown()}\n<!-- end of table -->"
        marks = f"<!-- table: {re.escape(name)} -->.*?<!-- end of table -->"
        text = re.sub(marks, lambda _, block=block: block, text, flags=re.DOTALL)
    return text


def main() -> None:
    """Fill all tables."""
    for page, tables in CARDS.items():
        try:
            text = filled(page, tables)
        except (ValueError, OSError) as error:
            sys.exit(str(error))
        (DOCS / "results" / f"{page}.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
