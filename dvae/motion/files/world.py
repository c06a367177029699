"""Normalise recordings to metres and an up axis, inferred from the recordings, reported and checked."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import log

import numpy as np
import torch

from ..data.clips import extents, fullest
from ..geometry.rotations import continuous, from_matrix, to_matrix
from .recording import Recording

HEIGHT = 1.65
"""Assumed height of a person in metres if a file does not contain its unit."""

UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254, "1 / .45 inches": 0.0254 / 0.45}
WITHIN = 1.35
"""Maximum ratio to `HEIGHT` of a person's height; small enough that no recording fits two units."""

STANDING = 0.8
"""Minimum cosine between an axis and the direction from feet to head for people to stand along the axis."""

_TOP = re.compile(r"head|neck|skull|face", re.IGNORECASE)
_BOTTOM = re.compile(r"foot|toe|ankle|heel", re.IGNORECASE)


def upright(recording: Recording) -> tuple[str, bool]:
    """Return the axis along which the person stands, and whether it points up.

    The axis is the one from feet to head. If no joint names match these, it is the axis of the longest extent.

    Axes of files are right-handed; in most files y or z is up.
    """
    if recording.up:
        return recording.up, True
    bodies = _from_feet_to_head(recording.names, recording.positions)
    along = np.median(extents(recording.positions), axis=0) if bodies is None else bodies.mean(0)
    axis = int(np.abs(along).argmax())
    return "xyz"[axis], bool(along[axis] > 0)


def orientation_warning(names: Sequence[str], positions: np.ndarray, up: str) -> str:
    """Return a warning if heads are above feet along another axis than `up`, otherwise an empty string.

    Args:
        names: joint names.
        positions: (F, J, 3).
        up: assumed up axis.
    """
    bodies = _from_feet_to_head(names, positions)
    if bodies is None or not len(bodies):
        return ""
    along = np.median(bodies, axis=0) / max(float(np.median(np.linalg.norm(bodies, axis=1))), 1e-9)
    axis = int(np.abs(along).argmax())
    if np.abs(along[axis]) < STANDING or ("xyz"[axis] == up and along[axis] > 0):
        return ""
    return f"heads are above feet along {'' if along[axis] > 0 else '-'}{'xyz'[axis]}, but {up} is assumed to be up"


def _from_feet_to_head(names: Sequence[str], positions: np.ndarray) -> np.ndarray | None:
    """Return vectors (frames, 3) from feet to head in up to about 2000 frames; None if no names match."""
    ends = [[index for index, name in enumerate(names) if kind.search(name)] for kind in (_TOP, _BOTTOM)]
    if not all(ends):
        return None
    positions = positions[:: max(len(positions) // 1000, 1)]
    head, foot = (np.ma.masked_invalid(positions[:, indices]).mean(1) for indices in ends)
    bodies = head - foot
    vectors: np.ndarray = bodies.data[~np.ma.getmaskarray(bodies).any(1)].astype(np.float64)
    return vectors


def height_of(recording: Recording) -> float:
    """Estimate the body's height in the recording's unit, whatever the pose: the length of the bones from head to foot.

    The estimate is the median over frames and over all joints whose names identify heads and feet. Without such names,
    it is the body's largest extent.
    """
    parents, places = recording.parents, fullest(recording.positions)
    chains: list[set[int]] = []  # for each joint, the joints up to the root
    for joint, parent in enumerate(parents):
        chains.append({joint} | (chains[parent] if parent >= 0 else set()))
    bones = np.median(np.linalg.norm(places - places[:, [max(parent, 0) for parent in parents]], axis=2), axis=0)
    ends = [
        [chains[joint] for joint, name in enumerate(recording.names) if pattern.search(name)]
        for pattern in (_TOP, _BOTTOM)
    ]
    lengths = [sum(bones[joint] for joint in head ^ foot) for head in ends[0] for foot in ends[1]]
    return float(np.median(lengths or extents(places).max(1)))


def unit(recording: Recording) -> tuple[str, float]:
    """Return the name of the file's unit and its length in metres: from the file, or by the size of a person.

    Raises:
        ValueError: no unit fits.
    """
    if recording.metres is not None:
        return "as the file says", recording.metres
    height = height_of(recording)
    fitting = {name: abs(log(max(height, 1e-12) * metres / HEIGHT)) for name, metres in UNITS.items()}
    name = min(fitting, key=fitting.__getitem__)
    if not fitting[name] <= log(WITHIN):
        raise ValueError(
            f"the body is about {height:.4g} tall (median over frames), which is not a person's height in any of "
            f"{', '.join(UNITS)}; pass the length of the file's unit in metres (`metres`)"
        )
    return name, UNITS[name]


@dataclass(frozen=True)
class World:
    """Units and axes of recordings that belong together.

    Args:
        unit: name of the files' unit.
        metres: length of the unit in metres.
        axis: axis along which people stand.
        upwards: whether this axis points up.
    """

    unit: str
    metres: float
    axis: str
    upwards: bool

    @property
    def up(self) -> str:
        """The up axis after normalisation: y or z. People who stand along x, or upside down, are rotated to y."""
        return self.axis if self.upwards and self.axis != "x" else "y"

    def __str__(self) -> str:
        rotation = "" if self.up == self.axis and self.upwards else f", rotated from {'' if self.upwards else '-'}"
        return f"unit {self.unit} ({self.metres:.4g} m), {self.up} up{rotation}{self.axis if rotation else ''}"


def check_unit(metres: float | None) -> None:
    """Raise an error if a number is not the length of a unit in metres."""
    if metres is not None and not 1e-6 < metres < 1e6:
        raise ValueError(f"`metres` must be the length of a unit in metres, such as 0.01 for centimetres, got {metres}")


def infer_world(recordings: Mapping[str, Recording], metres: float | None = None, up: str | None = None) -> World:
    """Return unit and axes of recordings that belong together: from the files, or from most people in them.

    Args:
        recordings: sample of the recordings, by name.
        metres: length of the files' unit in metres; overrides the inferred one.
        up: "y" or "z"; overrides the inferred axis.

    Raises:
        ValueError: no unit fits, the recordings have different units, or an argument is not a valid unit or axis.
    """
    if up not in (None, "y", "z"):
        raise ValueError(f"`up` must be 'y' or 'z', got {up!r}")
    check_unit(metres)
    units: dict[tuple[str, float], str] = {} if metres is None else {("as given", metres): ""}
    unknown = []
    for name, recording in recordings.items() if metres is None else ():
        try:
            units.setdefault(unit(recording), name)
        except ValueError as error:
            unknown.append(f"{name}: {error}")
    if not units:
        raise ValueError(unknown[0])
    if len({length for _, length in units}) > 1:
        (first, first_name), (other, other_name), *_ = units.items()
        raise ValueError(
            f"{first_name} seems to have the unit {first[0]} ({first[1]:.4g} m), {other_name} {other[0]} "
            f"({other[1]:.4g} m); if all have the same unit, pass its length in metres (`metres`); otherwise give the "
            f"unit of each file or folder (`dvae data convert --units FILE={first[1]:.4g}`)"
        )
    axis, upwards = (up, True) if up else Counter(map(upright, recordings.values())).most_common(1)[0][0]
    return World(*next(iter(units)), axis, upwards)


def to_world(recording: Recording, world: World) -> Recording:
    """Return a recording in metres, with y or z up."""
    turn = np.eye(3)
    if world.axis == "x" or not world.upwards:  # a rotation that maps the person's axis to y
        turn = np.roll(np.eye(3), "yzx".index(world.axis), axis=1)
        turn = turn if world.upwards else np.diag([1.0, -1.0, -1.0]) @ turn
    return replace(
        rotate_recording(recording, turn),
        positions=world.metres * (recording.positions @ turn.T),
        offsets=None if recording.offsets is None else world.metres * recording.offsets,
        loose=world.metres * recording.loose,
        metres=1.0,
        up=world.up,
    )


def rotate_recording(recording: Recording, turn: np.ndarray) -> Recording:
    """Return a recording whose world is rotated by a matrix (3, 3)."""
    rotations = recording.rotations
    if rotations is not None and (turn != np.eye(3)).any():
        root = torch.from_numpy(turn) @ to_matrix(torch.from_numpy(rotations[:, 0]).double(), "quaternion")
        rotations = np.concatenate([from_matrix(root, "quaternion").numpy()[:, None], rotations[:, 1:]], 1)
        rotations = continuous(torch.from_numpy(rotations)).numpy()
    return replace(recording, positions=recording.positions @ turn.T, rotations=rotations)
