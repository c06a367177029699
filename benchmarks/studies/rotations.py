"""Write a table of the errors of joints that are rebuilt from rotations.

Joint rotations are estimated in every frame. Forward kinematics then places joints with the bones of the rest pose.
"""

from pathlib import Path

import torch
import tyro
from torch import Tensor

from dvae import motion
from dvae.motion.geometry import kinematics, rotations

from .results import Table, write


def errors(people: motion.MotionSet) -> Tensor:
    """Return the distances between rebuilt and recorded joints, (frames, joints), in metres."""
    rotated, distances = people.with_rotations(), []
    skeleton = rotated.skeleton
    for clip in rotated:
        positions, quaternions = torch.from_numpy(clip.positions).double(), torch.from_numpy(clip.rotations).double()
        local = rotations.to_matrix(quaternions, "quaternion")
        rebuilt, _ = kinematics.forward(skeleton.parents, local, skeleton.offsets, positions[:, skeleton.root])
        distances.append((rebuilt - positions).norm(dim=-1))
    return torch.cat(distances)


def main(data: Path, results: Path | None = None) -> None:
    """Write the table.

    Args:
        data: motion file with joint positions of one body.
        results: folder of the tables, such as benchmarks/results; None prints them.
    """
    people = motion.read_motion(data)
    millimetres = 1000 * errors(people)
    columns = zip(people.skeleton.names, millimetres.mean(0).tolist(), millimetres.amax(0).tolist(), strict=True)
    rows = [[name, f"{mean:.2f}", f"{most:.2f}"] for name, mean, most in columns]
    total = ["all", f"{millimetres.mean():.2f}", f"{millimetres.max():.2f}"]
    note = f"{people.skeleton.name}, {len(millimetres):,} frames."
    write(results, {"rotations/errors": Table(["mm", "mean", "largest"], [*rows, total], note)})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
