"""Write paired differences of two methods for motion on every set without given paths, from the stored scores."""

import csv
import sys
from pathlib import Path

import tyro

from .engine import cell
from .ranking import COLUMNS, JUDGED, SCORES, SETS, View, entries


def differences(first: str, second: str, scores: Path) -> list[list[str]]:
    """Return a header, and for each set a line of the first method's scores minus the second's."""
    columns = [*COLUMNS, *JUDGED]
    lines = [["", *columns]]
    for name, selected in SETS.items():
        if View() in selected.views:
            rows = entries(scores, name, View(), (first, second))
            lines.append([name, *(cell(rows[first].estimate(column, rows[second])) for column in columns)])
    return lines


def main(
    first: tyro.conf.Positional[str] = "hit-dvae",
    second: tyro.conf.Positional[str] = "gsps",
    results: Path | None = None,
    scores: Path = SCORES,
) -> None:
    """Write the table.

    Args:
        first: a method.
        second: the method whose scores are subtracted.
        results: folder of the tables, such as benchmarks/results; None prints the table.
        scores: folder of the stored scores.
    """
    lines = differences(first, second, scores)
    if results is None:
        csv.writer(sys.stdout, lineterminator="\n").writerows(lines)
        return
    file = results / "index" / f"{first}-minus-{second}.csv"
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", encoding="utf-8", newline="") as out:
        csv.writer(out, lineterminator="\n").writerows(lines)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
