"""Fill the tables of docs/results from benchmarks/results, as specified in cards.toml.

    [hit_dvae.main]                       # table between the marks "main" in docs/results/hit_dvae.md
    source = "hit_dvae/scores"            # or a list: the first with the row and the column counts
    rows = ["hit-dvae", "gsps"]           # first cells of the rows; all rows by default
    columns = { "ADE (m) ↓" = "ADE" }     # header in the card = header in the source without ↓ and ↑

Rows may have names: { "4 paths" = ["trajevae", "4"] } is the row that begins with these cells. A column may have
its own source: { "CMU" = ["index/cmu8", "ADE"] }. Cells show the total error: `score ± a ± b` becomes
`score ± sqrt(a² + b²)`. All cells of a column have the fewest decimals that one of them has.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import tyro

from .engine import settings
from .results import DOCS, RESULTS, Table, read

CARDS = settings(__file__)


def with_total(cell: str, decimals: int) -> str:
    """Return a cell with at most so many decimals and the total of its errors; unknown if one of them is."""
    score, *errors = cell.split(" ± ")
    number = score.removesuffix("%")
    unit = "%" * (number != score)
    if len(number.partition(".")[2]) > decimals:
        score = f"{float(number):.{decimals}f}{unit}"
    if not errors or "–" in errors:
        return " ± ".join([score, *errors[-1:]])
    return f"{score} ± {math.hypot(*(float(error.removesuffix('%')) for error in errors)):.{decimals}f}{unit}"


def aligned(cells: Sequence[str]) -> list[str]:
    """Return the cells of a column with the decimals that all numbers have."""
    numbers = [re.fullmatch(r"-?\d*\.(\d+)%?", cell.partition(" ± ")[0]) for cell in cells]
    decimals = min((len(number[1]) for number in numbers if number), default=0)
    return [with_total(cell, decimals) if number else cell for cell, number in zip(cells, numbers, strict=True)]


def find_cell(source: str, row: Sequence[str], column: str) -> str | None:
    """Return the cell of a source; None if it has no such row or no such column.

    Raises:
        ValueError: several rows begin with these cells.
    """
    table = read(source)
    names = [name.rstrip(" ↓↑") for name in table.header]
    rows = [cells for cells in table.rows if cells[: len(row)] == [*row]]
    if len(rows) > 1:
        raise ValueError(f"{source} has {len(rows)} rows {', '.join(row)}; add their next cells")
    return rows[0][names.index(column)] if rows and column in names else None


def card(
    columns: Mapping[str, str | Sequence[str]],
    rows: Sequence[str] | Mapping[str, str | Sequence[str]] = (),
    source: str | Sequence[str] = (),
    absent: str = "",
) -> Table:
    """Return a table of a card; with `absent`, rows may have no cells.

    Raises:
        ValueError: no source has a row or a column.
    """
    sources = [source] if isinstance(source, str) else source
    rows = rows or [line[0] for line in read(sources[0]).rows]
    names = rows if isinstance(rows, Mapping) else {row: row for row in rows}
    columns_of_cells = []
    for location in columns.values():
        tables, column = (sources, location) if isinstance(location, str) else ([location[0]], location[1])
        cells = [
            [find_cell(table, [row] if isinstance(row, str) else row, column) for table in tables]
            for row in names.values()
        ]
        columns_of_cells.append([next((cell for cell in each if cell is not None), "") for each in cells])
    lines = dict(zip(names, zip(*columns_of_cells, strict=True), strict=True))
    for kind, lists in ("row", lines), ("column", dict(zip(columns, columns_of_cells, strict=True))):
        if not absent and (missing := [name for name, cells in lists.items() if not any(cells)]):
            raise ValueError(f"no source has the {kind} {', '.join(missing)}")
    printed = zip(*([cell or "–" for cell in aligned(cells)] for cells in columns_of_cells), strict=True)
    return Table(["", *columns], [[name, *cells] for name, cells in zip(names, printed, strict=True)])


def fill_page(page: str, tables: Mapping[str, Any]) -> str:
    """Return the text of a page with its tables between their marks.

    Raises:
        ValueError: a table has no marks, or marks have no table.
    """
    text = (DOCS / "results" / f"{page}.md").read_text(encoding="utf-8")
    marked = re.findall(r"<!-- table: (.*) -->", text)
    if sorted(marked) != sorted(tables):
        raise ValueError(f"{page}.md has marks for {marked}, cards.toml tables for {[*tables]}")
    for name, options in tables.items():
        absent = options.get("absent", "")
        is_absent = absent and not (RESULTS / f"{options['source']}.csv").exists()
        content = f"{absent}\n" if is_absent else card(**options).markdown()
        block = f"<!-- table: {name} -->\n\n{content}\n<!-- end of table -->"
        marks = f"<!-- table: {re.escape(name)} -->.*?<!-- end of table -->"
        text = re.sub(marks, lambda _, block=block: block, text, flags=re.DOTALL)
    return text


def main() -> None:
    """Fill all tables."""
    for page, tables in CARDS.items():
        try:
            text = fill_page(page, tables)
        except (ValueError, OSError) as error:
            sys.exit(str(error))
        (DOCS / "results" / f"{page}.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
