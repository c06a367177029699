"""From what a file holds to metres, an up axis and sides: found in the recording, said, and checked."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log

import numpy as np
import torch

from ..rotations import continuous, from_matrix, to_matrix
from .recording import Recording

HEIGHT = 1.65
"""Metres of what is taken for a person where a file does not say its unit."""

UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254, "1 / .45 inches": 0.0254 / 0.45}
WITHIN = 1.35
"""Factor within which a person of `HEIGHT` must be, so that no recording fits two units."""

_TOP = re.compile(r"head|neck|skull|face", re.IGNORECASE)
_BOTTOM = re.compile(r"foot|toe|ankle|heel", re.IGNORECASE)
_SIDES = {
    "left": (r"left", r"^l(?=.)|(?<=[:_.\-])l(?=$|[:_.\-A-Z])"),
    "right": (r"right", r"^r(?=.)|(?<=[:_.\-])r(?=$|[:_.\-A-Z])"),
}
"""How names tell a side: by the word, or by its letter at the beginning or the end."""


def sides(names: Sequence[str]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Joints on the left and on the right, by names that differ in these words or letters alone."""
    found: dict[str, set[int]] = {"left": set(), "right": set()}
    for way in range(2):
        plain = {
            side: {
                re.sub(ways[way], "", name, count=1, flags=re.I).lower(): place
                for place, name in enumerate(names)
                if re.search(ways[way], name, re.I)
            }
            for side, ways in _SIDES.items()
        }
        for name in plain["left"].keys() & plain["right"].keys():
            for side, places in plain.items():
                found[side].add(places[name])
    left, right = (tuple(sorted(places)) for places in found.values())
    return left, right


def upright(recording: Recording) -> tuple[str, bool]:
    """The axis along which the person stands, and whether it points up; by heads and feet, or by the longest extent.

    Axes of files are right-handed; most have y or z upwards.
    """
    tops = [place for place, name in enumerate(recording.names) if _TOP.search(name)]
    bottoms = [place for place, name in enumerate(recording.names) if _BOTTOM.search(name)]
    if tops and bottoms:
        along = (recording.positions[:, tops].mean(1) - recording.positions[:, bottoms].mean(1)).mean(0)
    else:
        along = np.median(np.ptp(recording.positions, axis=1), axis=0)
    axis = int(np.abs(along).argmax())
    return "xyz"[axis], bool(along[axis] > 0)


def unit(recording: Recording) -> tuple[str, float]:
    """Name of the file's unit and its metres: what the file says, or that in which a person has a person's size.

    Raises:
        ValueError: there is none.
    """
    extent = float(np.median(np.ptp(recording.positions, axis=1).max(1)))
    if recording.metres is not None:
        return "as the file says", recording.metres
    fitting = {name: abs(log(max(extent, 1e-12) * metres / HEIGHT)) for name, metres in UNITS.items()}
    name = min(fitting, key=fitting.__getitem__)
    if fitting[name] > log(WITHIN):
        raise ValueError(
            f"the body's largest extent is {extent:.4g} (median over frames), which is a person's in none of "
            f"{', '.join(UNITS)}; give the metres of the file's unit"
        )
    return name, UNITS[name]


@dataclass(frozen=True, eq=False)
class Settled:
    """A recording in metres, with y or z upwards.

    Args:
        recording: in these.
        left, right: places of the joints on either side.
        said: how the file's unit and axes were understood, for people to check.
    """

    recording: Recording
    left: tuple[int, ...]
    right: tuple[int, ...]
    said: str


def settle(recording: Recording, metres: float | None = None, up: str | None = None) -> Settled:
    """A recording in metres with y or z upwards.

    Args:
        recording: as a file has it.
        metres: of the file's unit; by default as the file says, or as its person's size tells.
        up: "y" or "z"; by default as the file says, or as its person stands. One who stands along x, or upside down,
            is turned to y.

    Raises:
        ValueError: no unit fits.
    """
    name, found = ("as given", metres) if metres is not None else unit(recording)
    said = up or recording.up
    axis, upwards = (said, True) if said else upright(recording)
    turn, turned = np.eye(3), ""
    if axis == "x" or not upwards:  # a rotation that takes the person's axis to y
        turn = np.roll(np.eye(3), "yzx".index(axis), axis=1)[[0, 1, 2]]
        turn = turn if upwards else np.diag([1.0, -1.0, -1.0]) @ turn
        turned = f", turned from {'' if upwards else '-'}{axis}"
        axis = "y"
    rotations, offsets = recording.rotations, recording.offsets
    if rotations is not None and turned:
        root = to_matrix(torch.from_numpy(rotations[:, 0]), "quaternion")
        rotations = rotations.copy()
        rotations[:, 0] = from_matrix(torch.from_numpy(turn) @ root, "quaternion").numpy()
        rotations = continuous(torch.from_numpy(rotations)).numpy()
    positions = found * (recording.positions @ turn.T)
    settled = replace(
        recording,
        positions=positions,
        rotations=rotations,
        offsets=None if offsets is None else found * offsets,
        metres=1.0,
        up=axis,
    )
    extent = float(np.median(np.ptp(positions, axis=1).max(1)))
    left, right = sides(recording.names)
    return Settled(settled, left, right, f"unit {name} ({found:.4g} m), {axis} up{turned}, a person of {extent:.2f} m")
