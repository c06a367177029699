"""From what files hold to metres, an up axis and sides: found in the recordings, said, and checked."""

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
"""Metres of what is taken for a person where a file does not say its unit."""

UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254, "1 / .45 inches": 0.0254 / 0.45}
WITHIN = 1.35
"""Factor within which a person of `HEIGHT` must be, so that no recording fits two units."""

STANDING = 0.8
"""Cosine between an axis and the way from feet to head from which people stand along it."""

_TOP = re.compile(r"head|neck|skull|face", re.IGNORECASE)
_BOTTOM = re.compile(r"foot|toe|ankle|heel", re.IGNORECASE)


def upright(recording: Recording) -> tuple[str, bool]:
    """The axis along which the person stands, and whether it points up; by heads and feet, or by the longest extent.

    Axes of files are right-handed; most have y or z upwards.
    """
    if recording.up:
        return recording.up, True
    bodies = _from_feet_to_head(recording.names, recording.positions)
    along = np.median(extents(recording.positions), axis=0) if bodies is None else bodies.mean(0)
    axis = int(np.abs(along).argmax())
    return "xyz"[axis], bool(along[axis] > 0)


def doubt(names: Sequence[str], positions: np.ndarray, up: str) -> str:
    """What speaks against this axis being up: heads that are above feet along another one; nothing, as a rule.

    Args:
        names: of the joints.
        positions: (F, J, 3).
        up: the axis.
    """
    bodies = _from_feet_to_head(names, positions)
    if bodies is None or not len(bodies):
        return ""
    along = np.median(bodies, axis=0) / max(float(np.median(np.linalg.norm(bodies, axis=1))), 1e-9)
    axis = int(np.abs(along).argmax())
    if np.abs(along[axis]) < STANDING or ("xyz"[axis] == up and along[axis] > 0):
        return ""
    return f"heads are above feet along {'' if along[axis] > 0 else '-'}{'xyz'[axis]}, not {up}, which was taken for up"


def _from_feet_to_head(names: Sequence[str], positions: np.ndarray) -> np.ndarray | None:
    """(frames that have both, 3), of a thousand or two, where names tell heads and feet."""
    ends = [[place for place, name in enumerate(names) if kind.search(name)] for kind in (_TOP, _BOTTOM)]
    if not all(ends):
        return None
    positions = positions[:: max(len(positions) // 1000, 1)]
    head, foot = (np.ma.masked_invalid(positions[:, places]).mean(1) for places in ends)
    bodies = head - foot
    found: np.ndarray = bodies.data[~np.ma.getmaskarray(bodies).any(1)].astype(np.float64)
    return found


def height_of(recording: Recording) -> float:
    """About the body's height, in the recording's unit, however it crouches: along its bones from head to foot.

    The median over all that names tell are heads and feet, and over frames; else the body's largest extent.
    """
    parents, places = recording.parents, fullest(recording.positions)
    chains: list[set[int]] = []  # of each joint those up to the root
    for joint, parent in enumerate(parents):
        chains.append({joint} | (chains[parent] if parent >= 0 else set()))
    bones = np.median(np.linalg.norm(places - places[:, [max(parent, 0) for parent in parents]], axis=2), axis=0)
    ends = [[chains[joint] for joint, name in enumerate(recording.names) if of.search(name)] for of in (_TOP, _BOTTOM)]
    ways = [sum(bones[joint] for joint in head ^ foot) for head in ends[0] for foot in ends[1]]
    return float(np.median(ways or extents(places).max(1)))


def unit(recording: Recording) -> tuple[str, float]:
    """Name of the file's unit and its metres: what the file says, or that in which a person has a person's size.

    Raises:
        ValueError: there is none.
    """
    if recording.metres is not None:
        return "as the file says", recording.metres
    height = height_of(recording)
    fitting = {name: abs(log(max(height, 1e-12) * metres / HEIGHT)) for name, metres in UNITS.items()}
    name = min(fitting, key=fitting.__getitem__)
    if not fitting[name] <= log(WITHIN):
        raise ValueError(
            f"the body is about {height:.4g} tall (median over frames), which is a person's height in none of "
            f"{', '.join(UNITS)}; give the metres of the file's unit"
        )
    return name, UNITS[name]


@dataclass(frozen=True)
class World:
    """How the units and axes of recordings that belong together are understood.

    Args:
        unit: name of the files' unit.
        metres: of one.
        axis: along which people stand.
        upwards: whether it points up.
    """

    unit: str
    metres: float
    axis: str
    upwards: bool

    @property
    def up(self) -> str:
        """The axis once settled: y or z. People who stand along x, or upside down, are turned to y."""
        return self.axis if self.upwards and self.axis != "x" else "y"

    def __str__(self) -> str:
        turned = "" if self.up == self.axis and self.upwards else f", turned from {'' if self.upwards else '-'}"
        return f"unit {self.unit} ({self.metres:.4g} m), {self.up} up{turned}{self.axis if turned else ''}"


def understand(recordings: Mapping[str, Recording], metres: float | None = None, up: str | None = None) -> World:
    """Unit and axes of recordings that belong together: what files say, or what most people in them show.

    Args:
        recordings: some of them, by what to call them.
        metres: of the files' unit, instead.
        up: "y" or "z", instead.

    Raises:
        ValueError: no unit fits, or another one to each; or what is given is no unit or axis.
    """
    if up not in (None, "y", "z"):
        raise ValueError(f"the up axis is {up!r}, expected 'y' or 'z'")
    if metres is not None and not 1e-6 < metres < 1e6:
        raise ValueError(f"a unit of {metres} m, expected such as 0.01 for centimetres")
    found: dict[tuple[str, float], str] = {} if metres is None else {("as given", metres): ""}
    unknown = []
    for name, recording in recordings.items() if metres is None else ():
        try:
            found.setdefault(unit(recording), name)
        except ValueError as error:
            unknown.append(f"{name}: {error}")
    if not found:
        raise ValueError(unknown[0])
    if len({known for _, known in found}) > 1:
        ((first, _), here), ((other, _), there), *_ = found.items()
        raise ValueError(f"{here} looks as if in {first}, {there} in {other}; give the metres of the unit of all")
    axis, upwards = (up, True) if up else Counter(map(upright, recordings.values())).most_common(1)[0][0]
    return World(*next(iter(found)), axis, upwards)


def settle(recording: Recording, world: World) -> Recording:
    """A recording in metres, with y or z upwards."""
    turn = np.eye(3)
    if world.axis == "x" or not world.upwards:  # a rotation that takes the person's axis to y
        turn = np.roll(np.eye(3), "yzx".index(world.axis), axis=1)
        turn = turn if world.upwards else np.diag([1.0, -1.0, -1.0]) @ turn
    return replace(
        turned(recording, turn),
        positions=world.metres * (recording.positions @ turn.T),
        offsets=None if recording.offsets is None else world.metres * recording.offsets,
        loose=world.metres * recording.loose,
        metres=1.0,
        up=world.up,
    )


def turned(recording: Recording, turn: np.ndarray) -> Recording:
    """A recording whose world is turned by a matrix (3, 3)."""
    rotations = recording.rotations
    if rotations is not None and (turn != np.eye(3)).any():
        root = torch.from_numpy(turn) @ to_matrix(torch.from_numpy(rotations[:, 0]).double(), "quaternion")
        rotations = np.concatenate([from_matrix(root, "quaternion").numpy()[:, None], rotations[:, 1:]], 1)
        rotations = continuous(torch.from_numpy(rotations)).numpy()
    return replace(recording, positions=recording.positions @ turn.T, rotations=rotations)
