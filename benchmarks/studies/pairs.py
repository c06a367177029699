"""Write paired differences of two methods for motion on every set without given paths, from the stored scores."""

from pathlib import Path

import tyro

from .engine import cell
from .ranking import COLUMNS, METRIC_MODEL_COLUMNS, SCORES, SETS, View, entries
from .results import Table, write


def differences(first: str, second: str, scores: Path) -> Table:
    """Return a table with a row of the first method's scores minus the second's for each set."""
    columns, lines = [*COLUMNS, *METRIC_MODEL_COLUMNS], []
    for name, selected in SETS.items():
        if View() in selected.views and {first, second} <= selected.methods.keys():
            rows = entries(scores, name, View(), (first, second))
            lines.append([name, *(cell(rows[first].estimate(column, rows[second])) for column in columns)])
    return Table(["", *columns], lines, f"{first} minus {second}, paired.")


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
        results: folder of the tables, such as benchmarks/results; None prints them.
        scores: folder of the stored scores.
    """
    write(results, {f"index/{first}-minus-{second}": differences(first, second, scores)})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
