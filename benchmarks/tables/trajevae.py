"""Writes the table of exact paths of docs/results/trajevae.md, of a run: test windows from their own paths."""

from __future__ import annotations

import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

import dvae
from dvae.inference.estimates import Crossed
from dvae.inference.held import clip_places

from .pages import DOCS, table, write
from .ranking import JOINTS

METRICS = {
    "path error, m": ".3f",
    "within 1 cm": ".1%",
    "bone-length error": ".1%",
    "bones within 10 %": ".1%",
    "corrected by, m": ".3f",
}


def figures(made: Any, true: np.ndarray) -> dict[str, float]:
    """Means over motions (S, T, J, 3), frames, and joints or bones, which should have these lengths."""
    off, bones = np.stack([*made.errors.values()]), np.abs(made.skeleton.bone_lengths(made.positions) / true - 1)
    moved = 0.0 if made.corrections is None else made.corrections.mean()
    return dict(zip(METRICS, (off.mean(), (off < 0.01).mean(), bones.mean(), (bones < 0.1).mean(), moved), strict=True))


def exact_paths(path: Path, joints: Sequence[str], count: int, samples: int) -> str:
    """By the number of given joints, and whether motions are to be exact; ± one standard error over clips."""
    run = dvae.load(path)
    windows = run.data.windows("test")
    chosen = torch.linspace(0, len(windows) - 1, count).long()
    motions = windows.positions(windows.all()["x"])[chosen].numpy()
    _, clips = np.unique(clip_places(windows.keys)[chosen].numpy(), return_inverse=True)
    rows = []
    for number, exact in product(range(1, len(joints) + 1), (False, True)):
        torch.manual_seed(0)
        begun, found = time.perf_counter(), []
        for motion in motions:
            paths = {joint: motion[1:, windows.skeleton.find(joint)] for joint in joints[:number]}
            made = run.model.complete(motion[0], paths, samples=samples, exact=exact)
            found.append(figures(made, windows.skeleton.bone_lengths(motion[:1])))
        spent = (time.perf_counter() - begun) / (count * samples)
        cells = []
        for name, unit in METRICS.items():
            mean = Crossed.by_clip(np.array([[each[name] for each in found]]), np.ones(count), clips).estimate()
            cells.append(f"{mean.mean:{unit}} ± {mean.sequences:{unit}}")
        rows.append([", ".join(joints[:number]), "exact" if exact else "", *cells, f"{spent:.2f}"])
    return table(["given", "", *METRICS, "seconds a motion"], rows)


def main(
    run: tyro.conf.Positional[Path],
    page: Path | None = DOCS / "results" / "trajevae.md",
    joints: tuple[str, ...] = JOINTS,
    count: int = 40,
    samples: int = 3,
) -> None:
    """Write the table.

    Args:
        run: a run directory.
        page: where; with None it is printed.
        joints: whose paths are given, one more in each row.
        count: windows, spread evenly over those of the test set.
        samples: motions of each.
    """
    write(page, exact_paths(run, joints, count, samples), name="exact paths")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
