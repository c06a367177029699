"""Write tables that compare runs with and without `bones` on a subset of their test windows.

Results of a run are stored in its directory.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
import tyro

import dvae
from dvae import motion

from .results import Table, loaded, same, write

METRICS = ("bone-length error", "limb stretch", "limb jitter", "ADE", "FDE", "APD", "MMADE", "limb-angle error", "CMD")
COMPARED = ("ADE", "FDE", "APD", "limb-angle error")


def evaluated(path: Path, every: int, samples: int) -> Path:
    """Score a run on every `every`-th test window, unless its file exists, and return the file."""
    file = path / f"{path.name}.json"
    if not file.exists():
        run = loaded(path)
        test = run.data.windows("test")
        some = test.with_protocol(replace(test.protocol, test_stride=every * test.protocol.test_stride))
        options = {"samples": samples, "batch_size": 64, "training_windows": run.data.windows("train+validation")}
        configs = {path.name: {"bones": run.method.bones}}
        dvae.evaluate({path.name: run.model}, some, scores=motion.scores, configs=configs, **options).save(file)
    return file


def joined(files: Sequence[Path]) -> dvae.Evaluation:
    """Join evaluations of single runs on the same windows, named by file, with the references of the first."""
    evaluations = {file.stem.replace("-", " "): dvae.Evaluation.load(file) for file in files}
    first = next(iter(evaluations.values()))
    if any(same(each) != same(first) for each in evaluations.values()):
        sys.exit("these evaluations differ in windows, samples, seed, emission, multimodal threshold or metric models")
    if len(evaluations) < len(files):
        sys.exit("two of these runs have the same name; rows are named after run directories, so rename one")
    rows = {name: row for name, row in first.rows.items() if not row.config}
    for name, each in evaluations.items():
        (rows[name],) = (row for row in each.rows.values() if row.config)
    return replace(first, rows=rows)


def main(
    runs: tyro.conf.Positional[tuple[Path, ...]],
    results: Path | None = None,
    every: int = 4,
    samples: int = 50,
) -> None:
    """Write the tables.

    Args:
        runs: run directories in pairs: without bones, then with bones.
        results: folder of the tables, such as benchmarks/results; None prints them.
        every: stride over the test windows.
        samples: number of futures of each window.
    """
    torch.set_num_threads(1)
    evaluation = joined([evaluated(path, every, samples) for path in runs])
    names = [name for name, row in evaluation.rows.items() if row.config]
    bones = [bool(evaluation.rows[name].config["bones"]) for name in names]
    if not names or bones != [False, True] * (len(names) // 2):
        sys.exit("name each run without bones, followed by the same run with bones")
    pairs = list(zip(names[::2], names[1::2], strict=True))
    rows = [
        [
            f"{ours} minus {theirs}",
            *(str(evaluation.difference(ours, theirs, metric)) for metric in COMPARED),
            f"{100 * (evaluation[ours]['ADE'].mean / evaluation[theirs]['ADE'].mean - 1):+.1f} %",
        ]
        for theirs, ours in pairs
    ]
    scores = [[name, *(str(evaluation[name].get(metric, "–")) for metric in METRICS)] for name in evaluation.rows]
    differences = Table(["", *COMPARED, "ADE, relative"], rows)
    write(results, {"bones/scores": Table(["", *METRICS], scores), "bones/differences": differences})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
