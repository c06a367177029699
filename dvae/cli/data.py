"""The command that looks into motion files."""

from __future__ import annotations

from typing import Annotated, Literal

import tyro

from .. import motion
from ..motion.dataset import SIMULATED
from .console import OUT


def data(
    action: Annotated[Literal["info"], tyro.conf.Positional],
    file: Annotated[str, tyro.conf.Positional] = SIMULATED,
    skip_bad: bool = False,
) -> None:
    """Say what a motion file holds: splits, clips, skeleton, how rigid its bones are, labels.

    Args:
        action: what to do.
        file: an npz file, or "simulated".
        skip_bad: leave out clips that cannot be used, and list them, instead of refusing the file.
    """
    clips = motion.simulate() if file == SIMULATED else motion.read_motion(file, skip_bad=skip_bad)
    OUT.print(clips.info())
