"""Motion data under a protocol, as runs keep and reopen them."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import ClassVar, Self

from ...options import check
from ..files import read_motion
from ..files.reading import chosen
from .clips import MotionSet
from .protocols import PROTOCOLS, Poses, Protocol, Representation, Windows, named_protocol, windows
from .simulator import simulate

SIMULATED = "simulated"
DEFAULT_PROTOCOLS = {
    "bandai21": "bandai2-by-style",
    "cmu21": "cmu8",
    "human36m": "h36m",
    "humaneva": "humaneva",
    "walker": "simulated",
}
"""Protocols by the name of the skeleton, where none is named, and its clips have their splits and frame rate."""


def default_protocol(motion: MotionSet) -> Protocol:
    """The protocol of the skeleton; or half a second observed and two predicted, of splits "train" and "test".

    Windows for training start every sixth of a second, those of the test every half.
    """
    fps, splits = motion.skeleton.fps, set(motion.splits)
    known = PROTOCOLS.get(DEFAULT_PROTOCOLS.get(motion.skeleton.name, ""))
    if known and known.fps == fps and (known.split_by != "split" or splits & {*known.train, *known.test}):
        return known

    def frames(seconds: float) -> int:
        return max(round(seconds * fps), 1)

    return Protocol(f"{fps:g} Hz", frames(0.5), frames(2), fps, train_stride=frames(1 / 6), test_stride=frames(0.5))


def divided(motion: MotionSet, protocol: Protocol) -> MotionSet:
    """Motion in "train" and "test", where a protocol asks for these and nobody has divided it; see `MotionSet`."""
    asks = (protocol.split_by, protocol.train, protocol.test) == ("split", ("train",), ("test",))
    return motion.divided(shortest=protocol.length) if asks and not {"train", "test"} & {*motion.splits} else motion


@dataclass(frozen=True)
class Recordings:
    """Where motion data were, as a run keeps it.

    Args:
        path: the file as it was given, or "simulated".
        fingerprint: SHA-256 of the clips.
        skip_bad: whether unusable clips were left out.
        missing: whether joints may be missing.
    """

    path: str
    fingerprint: str
    skip_bad: bool = False
    missing: bool = False

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
        onto: whether they were put onto the skeleton of a run.
        undivided: names of clips that are too short to be divided, so that none of their frames are for test.
    """

    kind: ClassVar[str] = "motion"
    described: ClassVar[str] = Poses.kind
    source: ClassVar[type[Recordings]] = Recordings

    path: str
    motion: MotionSet
    protocol: Protocol
    skip_bad: bool = False
    onto: bool = False
    undivided: tuple[str, ...] = ()

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str] = SIMULATED,
        protocol: str | Protocol | None = None,
        skip_bad: bool = False,
        missing: bool = False,
        representation: Representation | None = None,
    ) -> Self:
        """Reads a motion file, or simulates.

        Args:
            path: of a file or folder that `read_motion` reads, or "simulated" for `simulate()`.
            protocol: one of `dvae.motion.PROTOCOLS` or its name; by default the one of the skeleton, or half a second
                observed and two predicted, see `default_protocol`. Clips that are in neither split "train" nor "test"
                are divided, see `MotionSet.divided`.
            skip_bad: leave out unusable clips instead of refusing the file.
            missing: keep clips that lack joints (NaN) in some frames.
            representation: what models see, in place of what the protocol says.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: a file that cannot be read, or an unknown protocol.
        """
        name = os.fspath(path)
        clips = simulate() if name == SIMULATED else read_motion(name, skip_bad=skip_bad, missing=missing)
        if isinstance(protocol, str):
            protocol = named_protocol(protocol)
        protocol = protocol or default_protocol(clips)
        protocol = replace(protocol, representation=representation or protocol.representation)
        split = divided(clips, protocol)
        tested = {clip.name for clip in split if clip.split == "test"}
        partly = len(split) > len(clips) > 1  # otherwise whole clips are for test
        whole = tuple(clip.name for clip in split if partly and clip.name not in tested)
        return cls(name, split, protocol, skip_bad, undivided=whole)

    def windows(self, split: str) -> Windows:
        """The windows of "train", "validation", "test" or "train+validation"."""
        return windows(self.motion, self.protocol, split)

    def parts(self) -> dict[str, str]:
        """Return for training, validation and test a sentence: the windows, and the clips that have none."""
        found, protocol = {}, self.protocol
        for split in ("train", "validation", "test"):
            try:
                cut = self.windows(split)
            except ValueError as error:
                found[split] = str(error)
                continue
            short = [name for _, name, _ in cut.skipped] + [*(self.undivided if split == "test" else ())]
            more = f" and {len(short) - 3} more" if len(short) > 3 else ""
            found[split] = (
                f"{len(cut)} {split} windows of {protocol.observed} + {protocol.predicted} frames, "
                f"one every {cut.stride} frames of {len(cut.clips)} clips"
                + (f"; too short for one: {', '.join(short[:3])}{more}" if short else "")
            )
        return found

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
        return Recordings(self.path, self.fingerprint, self.skip_bad, self.motion.missing)

    @classmethod
    def reopened(cls, source: Recordings, schema: Poses, path: str | os.PathLike[str] | None = None) -> Self:
        """The data that were recorded, from there or from another path, whatever they are now.

        Others that have another skeleton are put onto that of the schema, where its joints are among theirs by what
        names mean; turns are then found anew.

        Args:
            source: as `recorded` gave it.
            schema: of the windows.
            path: where they lie now.

        Raises:
            FileNotFoundError, ValueError: see `open`.
        """
        found = cls.open(path or source.path, schema.protocol, source.skip_bad, source.missing)
        if found.schema.skeleton == schema.skeleton:
            return found
        known, motion = schema.skeleton, found.motion
        if found.fingerprint == source.fingerprint:
            return found
        if motion.skeleton.fps != known.fps:
            raise ValueError(
                f"{found.path} has {motion.skeleton.fps:g} frames per second, and windows here have {known.fps:g}; "
                f"`dvae data convert {found.path} --fps {known.fps:g} --out FILE` resamples it"
            )
        try:
            put = chosen(motion, onto=known)
        except ValueError:  # whoever compares the schemas says what differs
            return found
        clips = [replace(clip, rotations=None) for clip in put]
        put = MotionSet(clips, known, motion.name, skipped=motion.skipped, said=motion.said, missing=motion.missing)
        return replace(found, motion=put, onto=True)
