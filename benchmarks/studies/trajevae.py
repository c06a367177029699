"""Write a table of exact paths: motions of a run along the paths of test windows."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
import torch
import tyro

from dvae.inference.evaluation.estimates import TwoWayErrors
from dvae.inference.evaluation.evaluation_windows import cluster_index
from dvae.models.motion.trajectories import Completion, TrajectoryModel

from .ranking import JOINTS
from .results import Table, loaded, write

METRICS = {
    "path error, m": ".3f",
    "within 1 cm": ".1%",
    "bone-length error": ".1%",
    "bones within 10 %": ".1%",
    "corrected by, m": ".3f",
}
"""Measures of motions, with their formats."""


def measure_completion(completion: Completion, true: np.ndarray) -> tuple[float, ...]:
    """Return the means of the measures over motions, frames, and joints or bones, given true bone lengths."""
    off = np.stack([*completion.errors.values()])
    bones = np.abs(completion.skeleton.bone_lengths(completion.positions) / true - 1)
    corrected = np.nan if completion.corrections is None else completion.corrections.mean()
    return off.mean(), (off < 0.01).mean(), bones.mean(), (bones < 0.1).mean(), corrected


def exact_paths(folder: Path, joints: Sequence[str], count: int, samples: int) -> Table:
    """Return a table by number of given joints, with and without exact paths; ± is one standard error over clips."""
    run = loaded(folder)
    if not isinstance(run.model, TrajectoryModel):
        sys.exit(f"{folder} is a run of {run.method.name}, which follows no paths; give one of trajevae or cvae-rnn")
    windows = run.data.windows("test")
    try:
        [windows.skeleton.find(joint) for joint in joints]
    except ValueError as error:
        sys.exit(str(error))
    indices = torch.linspace(0, len(windows) - 1, min(count, len(windows))).long()
    motions = windows.positions(windows.all()["x"][indices]).numpy()
    _, clips = np.unique(cluster_index(windows.keys)[indices].numpy(), return_inverse=True)
    rows = []
    for number, exact in product(range(1, len(joints) + 1), (False, True)):
        torch.manual_seed(0)
        values = []
        start = time.perf_counter()
        for motion in motions:
            paths = {joint: motion[1:, windows.skeleton.find(joint)] for joint in joints[:number]}
            completion = run.model.complete(motion[0], paths, samples=samples, exact=exact)
            values.append(measure_completion(completion, windows.skeleton.bone_lengths(motion[:1])))
        elapsed = (time.perf_counter() - start) / (len(motions) * samples)
        means = [
            TwoWayErrors.by_cluster(each[None], np.ones(len(motions)), clips).estimate()
            for each in np.transpose(values)
        ]
        formatted = [
            "–" if np.isnan(mean.mean) else f"{mean.mean:{form}} ± {mean.sequences:{form}}"
            for mean, form in zip(means, METRICS.values(), strict=True)
        ]
        rows.append([", ".join(joints[:number]), "exact" if exact else "", *formatted, f"{elapsed:.2f}"])
    return Table(["given", "exact", *METRICS, "seconds a motion"], rows)


def main(
    run: tyro.conf.Positional[Path],
    results: Path | None = None,
    joints: tuple[str, ...] = JOINTS,
    count: int = 40,
    samples: int = 3,
) -> None:
    """Write the table.

    Args:
        run: a run directory.
        results: folder of the tables, such as benchmarks/results; None prints them.
        joints: joints with given paths, one more in each row.
        count: number of test windows, evenly spaced.
        samples: number of motions of each window.
    """
    torch.set_num_threads(1)
    write(results, {"trajevae/exact-paths": exact_paths(run, joints, count, samples)})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
