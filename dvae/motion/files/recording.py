"""Content of a motion file before units, axes and names are normalised; and bounded reading of numeric text files."""

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
"""Maximum size of a motion text file in bytes: an hour of sixty joints at 60 Hz."""

MOST_PLACES = 2**24
"""Maximum number of frames times joints in a recording: an hour of sixty joints, as for `MOST_TEXT`."""


END = "End"
"""Suffix of the name of a joint at the end of a bone without children."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One recording with the units and names of its file.

    Args:
        names: joint names.
        parents: index of each joint's parent, -1 for the root; parents precede their children.
        positions: (F, J, 3) in the unit and axes of the file.
        rotations: (F, J, 4), local quaternions w x y z without sign changes; None if the file has none.
        offsets: (J, 3), rest pose in the unit of the file; only with rotations.
        loose: largest distance between a joint's position relative to its parent and its offset, in the unit of the
            file.
        fps: frames per second, if the file contains it.
        metres: length of the unit in metres, if the file contains it.
        up: up axis, if the file contains it.
        skeleton: skeleton of these joints, if there is one next to the file.
        labels: labels from the file.
        notes: one sentence on each part of the file that was left out or renamed.
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
        """Create a recording from rotations (F, J, 3, 3) and positions relative to the parent (F, J, 3).

        For the root, both are relative to the world.
        """
        offsets, loose = offsets_of(parents, places)
        positions, _ = forward(parents, rotations, places, places[..., 0, :].expand(len(rotations), 3))
        quaternions = continuous(from_matrix(rotations, "quaternion"))
        return cls(names, parents, positions.numpy(), quaternions.numpy(), offsets.numpy(), loose, fps, metres, up)


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file, in any of the encodings of motion files.

    Raises:
        OSError: the file does not exist.
        ValueError: it is too large.
    """
    return files.read(path, MOST_TEXT, links=True).decode("utf-8-sig", errors="replace").splitlines()


def numbers(text: str, location: str) -> np.ndarray:
    """Return all numbers of a text, separated by white space.

    Raises:
        ValueError: the text contains anything else, or a number that is not finite.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # raised if the text contains anything else
        try:
            values = np.fromstring(text, sep=" ")
        except (DeprecationWarning, ValueError):
            values = np.array([np.nan])
    if not np.isfinite(values).all():
        invalid = next((word for word in text.split() if not _is_finite(word)), "")
        raise ValueError(f"{location}: {invalid[:40]!r} is not a number")
    return values


def _is_finite(word: str) -> bool:
    try:
        return bool(np.isfinite(float(word)))
    except ValueError:
        return False


def check_joints(path: Path, joints: int) -> None:
    """Raise an error if there are more joints than the limit."""
    if joints > MOST_JOINTS:
        raise ValueError(f"{path}: it has more than {MOST_JOINTS:,} joints")


def check_size(path: Path, frames: int, joints: int) -> None:
    """Raise an error if a recording would be too large for memory, even if its file is small."""
    if frames * joints > MOST_PLACES:
        raise ValueError(
            f"{path}: it has {frames * joints:,} joint positions, at most {MOST_PLACES:,} are read; cut the recording"
        )
