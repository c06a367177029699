"""Writes the tables of docs/results/gsps.md from evaluations.

The page says how the runs were fitted and scored, each by `dvae evaluate RUN --out NAME.json` on the same windows; the
control that the full method has over parts is measured here.
"""

from pathlib import Path

import tyro

from .control import control, shown
from .pages import DOCS, differences, joined, scores, write

METRICS = ("APD", "ADE", "FDE", "MMADE", "MMFDE", "energy score", "pose NLL", "bone-length error")


def main(
    run: tyro.conf.Positional[Path],
    files: tyro.conf.Positional[tuple[Path, ...]],
    page: Path = DOCS / "results" / "gsps.md",
    samples: int = 50,
) -> None:
    """Write the tables.

    Args:
        run: the directory of the full method's.
        files: what `dvae evaluate RUN --out` wrote, of that run first.
        page: where.
        samples: futures of a window whose control is measured.
    """
    evaluation, first = joined(files)
    write(page, scores(evaluation, METRICS), differences(evaluation, first, METRICS[:-1]), shown(control(run, samples)))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
