"""Motion data under a protocol, as runs keep and reopen them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from ..options import check, tuples
from .data import MotionSet
from .files import read_motion
from .protocols import PROTOCOLS, Poses, Protocol, Windows, named_protocol, windows
from .simulator import simulate

SIMULATED = "simulated"
DEFAULT_PROTOCOLS = {
    "bandai21": "bandai2-by-style",
    "cmu21": "cmu8",
    "human36m": "h36m",
    "humaneva": "humaneva",
    "walker": "simulated",
}
"""Protocols by the name of the skeleton, where none is named."""


@dataclass(frozen=True)
class Recordings:
    """Where motion data were, as a run keeps it.

    Args:
        path: the file as it was given, or "simulated".
        fingerprint: SHA-256 of the clips.
        skip_bad: whether unusable clips were left out.
    """

    path: str
    fingerprint: str
    skip_bad: bool = False

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class MotionData:
    """Motion data under a protocol.

    Args:
        path: the file as it was given, or "simulated".
        motion: its clips.
        protocol: how windows are cut from them.
        skip_bad: whether unusable clips were left out.
    """

    kind: ClassVar[str] = "motion"
    described: ClassVar[str] = Poses.kind
    source: ClassVar[type[Recordings]] = Recordings

    path: str
    motion: MotionSet
    protocol: Protocol
    skip_bad: bool = False

    @classmethod
    def open(
        cls, path: str | os.PathLike[str] = SIMULATED, protocol: str | Protocol | None = None, skip_bad: bool = False
    ) -> Self:
        """Reads a motion file, or simulates.

        Args:
            path: of a file that `read_motion` reads, or "simulated" for `simulate()`.
            protocol: one of `dvae.motion.PROTOCOLS` or its name; by default the one of the skeleton.
            skip_bad: leave out unusable clips instead of refusing the file.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: a file that cannot be read, an unknown protocol, or none for the skeleton.
        """
        name = os.fspath(path)
        clips = simulate() if name == SIMULATED else read_motion(name, skip_bad=skip_bad)
        if protocol is None:
            if clips.skeleton.name not in DEFAULT_PROTOCOLS:
                raise ValueError(
                    f"{name}: which protocol? The skeleton {clips.skeleton.name!r} has none of its own; "
                    f"choose one of {', '.join(PROTOCOLS)}"
                )
            protocol = DEFAULT_PROTOCOLS[clips.skeleton.name]
        return cls(name, clips, named_protocol(protocol) if isinstance(protocol, str) else protocol, skip_bad)

    def windows(self, split: str) -> Windows:
        """The windows of "train", "validation", "test" or "train+validation"."""
        return windows(self.motion, self.protocol, split)

    @property
    def location(self) -> str:
        """Where the clips are, as any process finds them."""
        return self.path if self.path == SIMULATED else os.path.abspath(self.path)

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the clips."""
        return self.motion.fingerprint()

    @property
    def schema(self) -> Poses:
        """What is known of the windows without the clips."""
        turned = self.protocol.representation != "positions"
        return Poses.under(self.protocol, (self.motion.with_rotations() if turned else self.motion).skeleton)

    def recorded(self) -> Recordings:
        """Where the clips are; `reopened` reads it."""
        return Recordings(self.path, self.fingerprint, self.skip_bad)

    @classmethod
    def reopened(
        cls, source: Recordings, schema: Poses | Mapping[str, Any], path: str | os.PathLike[str] | None = None
    ) -> Self:
        """The data that were recorded, from there or from another path, whatever they are now.

        Args:
            source: as `recorded` gave it.
            schema: of the windows; of runs of format 1, the fields of the protocol.
            path: where they lie now.

        Raises:
            FileNotFoundError, ValueError: see `open`.
        """
        protocol = Protocol(**tuples(schema)) if isinstance(schema, Mapping) else schema.protocol
        return cls.open(path or source.path, protocol, source.skip_bad)
