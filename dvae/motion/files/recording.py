"""What a motion file holds, before units, axes and names are settled; and text files of numbers, bounded."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from torch import Tensor

from ... import files
from ..geometry.kinematics import forward
from ..geometry.rotations import continuous, from_matrix
from ..geometry.skeleton import MOST_JOINTS, Skeleton
from ..scoring.matching import offsets_of

MOST_TEXT = 2**28
"""Bytes of a text file of motion: an hour of sixty joints at 60 Hz."""

MOST_PLACES = 2**24
"""Frames times joints of a recording: as long."""


END = "End"
"""Of the name of a joint at which a last bone ends."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One recording as its file has it.

    Args:
        names: of the joints.
        parents: index of each joint's parent, -1 for the root; before its children.
        positions: (F, J, 3) in the file's unit and axes.
        rotations: (F, J, 4), local quaternions w x y z, continuous; where the file has them.
        offsets: (J, 3) of the rest pose in the file's unit; with rotations.
        loose: how far a joint goes from its offset, in the file's unit.
        fps: frames per second, where the file says.
        metres: of a unit, where the file says.
        up: the axis that is, where the file says.
        skeleton: of these joints, where it stands beside the file.
        labels: what the file says about it.
        notes: what of the file was left out or renamed, in a sentence each.
    """

    names: Sequence[str]
    parents: Sequence[int]
    positions: np.ndarray
    rotations: np.ndarray | None = None
    offsets: np.ndarray | None = None
    loose: float = 0.0
    fps: float | None = None
    metres: float | None = None
    up: str | None = None
    skeleton: Skeleton | None = None
    labels: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()

    @classmethod
    def turned(
        cls,
        names: Sequence[str],
        parents: Sequence[int],
        places: Tensor,
        rotations: Tensor,
        fps: float | None = None,
        metres: float | None = None,
        up: str | None = None,
    ) -> Recording:
        """Of rotations (F, J, 3, 3) and of places against the parent (F, J, 3), the root's against the world."""
        offsets, loose = offsets_of(parents, places)
        positions, _ = forward(parents, rotations, places, places[..., 0, :].expand(len(rotations), 3))
        quaternions = continuous(from_matrix(rotations, "quaternion"))
        return cls(names, parents, positions.numpy(), quaternions.numpy(), offsets.numpy(), loose, fps, metres, up)


def read_lines(path: Path) -> list[str]:
    """The lines of a text file, in any of the encodings that motion files come in.

    Raises:
        OSError: there is no such file.
        ValueError: it is larger than any of this kind.
    """
    return files.read(path, MOST_TEXT, links=True).decode("utf-8-sig", errors="replace").splitlines()


def numbers(text: str, where: str) -> np.ndarray:
    """All numbers of a text, separated by white space.

    Raises:
        ValueError: something else stands there; or a number is not finite.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # it stopped at something else
        try:
            found = np.fromstring(text, sep=" ")
        except (DeprecationWarning, ValueError):
            found = np.array([np.nan])
    if not np.isfinite(found).all():
        wrong = next((word for word in text.split() if not _is_finite(word)), "")
        raise ValueError(f"{where}: {wrong[:40]!r} is no number")
    return found


def _is_finite(word: str) -> bool:
    try:
        return bool(np.isfinite(float(word)))
    except ValueError:
        return False


def check_joints(path: Path, joints: int) -> None:
    """Refuses more joints than any skeleton has."""
    if joints > MOST_JOINTS:
        raise ValueError(f"{path}: it has more than {MOST_JOINTS:,} joints")


def check_size(path: Path, frames: int, joints: int) -> None:
    """Refuses what would not be held in memory, though its file is small."""
    if frames * joints > MOST_PLACES:
        raise ValueError(
            f"{path}: {frames * joints:,} places of joints are more than {MOST_PLACES:,}; cut the recording"
        )
