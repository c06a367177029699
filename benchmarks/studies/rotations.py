"""Write a table of how far joints are from where they were recorded, by their rotations.

Of every frame the turns are found, and joints are put back by them on bones of the rest pose.
"""

from pathlib import Path

import torch
import tyro
from torch import Tensor

from dvae import motion
from dvae.motion.geometry import kinematics, rotations

from .results import Table, write


def errors(people: motion.MotionSet) -> Tensor:
    """(frames, joints), in metres."""
    turned, found = people.with_rotations(), []
    skeleton = turned.skeleton
    for clip in turned:
        positions, turns = torch.from_numpy(clip.positions).double(), torch.from_numpy(clip.rotations).double()
        local = rotations.to_matrix(turns, "quaternion")
        again, _ = kinematics.forward(skeleton.parents, local, skeleton.offsets, positions[:, skeleton.root])
        found.append((again - positions).norm(dim=-1))
    return torch.cat(found)


def main(data: Path, results: Path | None = None) -> None:
    """Write the table.

    Args:
        data: motion file of positions, of one body.
        results: folder of the tables, such as benchmarks/results; None prints them.
    """
    people = motion.read_motion(data)
    found = 1000 * errors(people)
    columns = zip(people.skeleton.names, found.mean(0).tolist(), found.amax(0).tolist(), strict=True)
    rows = [[name, f"{mean:.2f}", f"{most:.2f}"] for name, mean, most in columns]
    whole = ["all", f"{found.mean():.2f}", f"{found.max():.2f}"]
    note = f"{people.skeleton.name}, {len(found):,} frames."
    write(results, {"rotations/errors": Table(["mm", "mean", "largest"], [*rows, whole], note)})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
