"""Write a table of the real test poses beyond the angle limits that `gsps` estimates from its training poses.

GSPS penalises angles outside the range of the training poses. If real test poses are outside too, the penalty moves
forecasts away from the truth. Nothing is trained.
"""

from pathlib import Path

import torch
import tyro
from torch import Tensor

from dvae import motion
from dvae.motion.geometry.angles import AngleLimits, angle_names, cosines

from .ranking import SETS
from .results import Table, write
from .tuning import TUNING

PROTOCOLS = {"by style": "bandai2-by-style", "by take": "bandai2-by-take", "tuning": TUNING.name}
"""Protocols of bandai2 by column."""
INACTIVE = 0.98
"""GSPS ignores limits whose cosines are beyond this value."""
ANY = "any angle"


def beyond(poses: Tensor, limits: AngleLimits, skeleton: motion.Skeleton) -> dict[str, tuple[float, float]]:
    """Return the share of poses beyond the active limits, and their largest excess in degrees, by angle and of any.

    Args:
        poses: (N, D) in metres.
        limits: limits of the angles.
        skeleton: skeleton of the poses.
    """
    cos = torch.cat([cosines(block, skeleton) for block in poses.split(2**16)]).double()
    low = limits.low.double().where(limits.low >= -INACTIVE, torch.tensor(-1.0))
    high = limits.high.double().where(limits.high <= INACTIVE, torch.tensor(1.0))
    angle, smallest, largest = (values.clamp(-1, 1).arccos().rad2deg() for values in (cos, high, low))
    is_beyond = (cos < low) | (cos > high)
    excess = torch.maximum(smallest - angle, angle - largest).where(is_beyond, torch.tensor(0.0))
    names = angle_names(skeleton)
    columns = {name: [n for n, other in enumerate(names) if other == name] for name in names}
    columns[ANY] = [*range(len(names))]
    shares = {name: is_beyond[:, same].any(1).double().mean().item() for name, same in columns.items()}
    return {name: (shares[name], excess[:, same].max().item()) for name, same in columns.items()}


def main(data: Path, results: Path | None = None) -> None:
    """Write the table.

    Args:
        data: the folder of files, with bandai/.
        results: folder of the tables, such as benchmarks/results; None prints them.
    """
    people = motion.read_motion(data / SETS[PROTOCOLS["by style"]].file)
    columns: dict[str, dict[str, tuple[float, float]]] = {}
    for column, protocol in PROTOCOLS.items():
        train, test = (motion.windows(people, protocol, split).poses() for split in ("train", "test"))
        columns[column] = beyond(test, motion.estimate_angle_limits(train, people.skeleton), people.skeleton)
    rows = sorted(columns["by style"], key=lambda name: [-shares[name][0] for shares in columns.values()])
    cells = {name: [f"{each[name][0]:.2%}, {each[name][1]:.1f}°" for each in columns.values()] for name in rows}
    lines = [[name, *cells[name]] for name in rows]
    note = "Share of test poses beyond a limit, left or right, and the largest excess."
    write(results, {"gsps/angles": Table(["", *columns], lines, note)})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
