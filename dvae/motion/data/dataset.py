"""Motion data with a protocol, in a form that runs can record and reopen."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import ClassVar, Self

from ...options import check
from ..files import read_motion
from ..files.reading import select_joints
from .clips import MotionSet
from .protocols import (
    PROTOCOLS,
    Poses,
    Protocol,
    Representation,
    RootMotion,
    Windows,
    check_rate,
    named_protocol,
    windows,
)
from .simulator import simulate

SIMULATED = "simulated"
DEFAULT_PROTOCOLS = {
    "bandai21": "bandai2-by-style",
    "cmu21": "cmu8",
    "human36m": "h36m",
    "human36m-angles": "h36m-angles",
    "humaneva": "humaneva",
    "walker": "simulated",
}
"""Default protocol for each skeleton name; used if the splits and the frame rate match."""


def default_protocol(motion: MotionSet) -> Protocol:
    """Return the default protocol of the skeleton, or a generic one.

    The generic protocol observes half a second, predicts two seconds and uses the splits "train" and "test". Training
    windows start every sixth of a second, test windows every half second.
    """
    fps, splits = motion.skeleton.fps, set(motion.splits)
    preset = PROTOCOLS.get(DEFAULT_PROTOCOLS.get(motion.skeleton.name, ""))
    if preset and preset.fps == fps and (preset.split_by != "split" or splits & {*preset.train, *preset.test}):
        return preset

    def frames(seconds: float) -> int:
        return max(round(seconds * fps), 1)

    return Protocol(f"{fps:g} Hz", frames(0.5), frames(2), fps, train_stride=frames(1 / 6), test_stride=frames(0.5))


def apply_splits(motion: MotionSet, protocol: Protocol) -> MotionSet:
    """Return motion divided into "train" and "test" if the protocol needs these splits and the motion has neither."""
    needs_splits = (protocol.split_by, protocol.train, protocol.test) == ("split", ("train",), ("test",))
    if needs_splits and not {"train", "test"} & {*motion.splits}:
        return motion.assign_splits(shortest=protocol.length)
    return motion


@dataclass(frozen=True)
class Recordings:
    """Record of the file that contains motion data.

    Args:
        path: file as it was given, or "simulated".
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
    """Motion data with a protocol.

    Args:
        path: file as it was given, or "simulated".
        motion: clips.
        protocol: protocol that cuts the clips into windows.
        skip_bad: whether unusable clips were left out.
        onto: whether the clips were mapped to the skeleton of a run.
        undivided: names of clips too short to be divided; none of their frames are in the test split.
    """

    kind: ClassVar[str] = "motion"
    schema_kind: ClassVar[str] = Poses.kind
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
        root: RootMotion | None = None,
    ) -> Self:
        """Read a motion file, or simulate motion.

        Args:
            path: file or folder that `read_motion` reads, or "simulated" for `simulate()`.
            protocol: one of `dvae.motion.PROTOCOLS` or its name; default: `default_protocol` of the clips. If the
                protocol needs the splits "train" and "test" and no clip has either, `MotionSet.assign_splits` creates
                them.
            skip_bad: leave out unusable clips instead of raising an error.
            missing: keep clips in which joints are missing (NaN) in some frames.
            representation, root: input of the models, and treatment of the root, in place of the protocol's.

        Returns:
            Clips, divided into splits, with their protocol.

        Raises:
            FileNotFoundError: the file does not exist.
            ValueError: the file cannot be read, or the protocol is unknown.
        """
        name = os.fspath(path)
        clips = simulate() if name == SIMULATED else read_motion(name, skip_bad=skip_bad, missing=missing)
        if isinstance(protocol, str):
            protocol = named_protocol(protocol)
        protocol = protocol or default_protocol(clips)
        representation = representation or protocol.representation
        protocol = replace(protocol, representation=representation, root=root or protocol.root)
        split = apply_splits(clips, protocol)
        tested = {clip.name for clip in split if clip.split == "test"}
        partly = len(split) > len(clips) > 1  # otherwise whole clips form the test split
        undivided = tuple(clip.name for clip in split if partly and clip.name not in tested)
        return cls(name, split, protocol, skip_bad, undivided=undivided)

    def windows(self, split: str) -> Windows:
        """Return the windows of "train", "validation", "test" or "train+validation".

        Args:
            split: "train", "validation", "test" or "train+validation".

        Raises:
            ValueError: the split is unknown, or it has no window.
        """
        return windows(self.motion, self.protocol, split)

    def parts(self) -> dict[str, str]:
        """Return one sentence for each split: its number of windows, and the clips that are too short.

        Raises:
            ValueError: motion and protocol have different frame rates.
        """
        check_rate(self.motion, self.protocol)
        sentences, protocol = {}, self.protocol
        for split in ("train", "validation", "test"):
            try:
                split_windows = self.windows(split)
            except ValueError as error:
                sentences[split] = str(error)
                continue
            short = [name for _, name, _ in split_windows.skipped] + [*(self.undivided if split == "test" else ())]
            more = f" and {len(short) - 3} more" if len(short) > 3 else ""
            sentences[split] = (
                f"{len(split_windows)} {split} windows of {protocol.observed} + {protocol.predicted} frames, "
                f"one every {split_windows.stride} frames of {len(split_windows.clips)} clips"
                + (f"; too short for one: {', '.join(short[:3])}{more}" if short else "")
            )
        return sentences

    @property
    def location(self) -> str:
        """Absolute path of the clips, or "simulated"."""
        return self.path if self.path == SIMULATED else os.path.abspath(self.path)

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the clips."""
        return self.motion.fingerprint()

    @property
    def schema(self) -> Poses:
        """Schema of the windows."""
        uses_rotations = self.protocol.representation != "positions"
        motion = self.motion.with_rotations() if uses_rotations else self.motion
        return Poses.from_data(self.protocol, motion.skeleton)

    def recorded(self) -> Recordings:
        """Return the record of these data that `reopen` reads."""
        return Recordings(self.path, self.fingerprint, self.skip_bad, self.motion.missing)

    @classmethod
    def reopen(cls, source: Recordings, schema: Poses, path: str | os.PathLike[str] | None = None) -> Self:
        """Open recorded data again, from the recorded path or from another one.

        The content of the file may have changed since it was recorded. Data with another skeleton are mapped to the
        skeleton of the schema if they have all its joints, which are matched by name. Their rotations are then
        estimated again.

        Args:
            source: result of `recorded`.
            schema: schema of the windows.
            path: current path, if the data have moved.

        Returns:
            Clips of the file, with the protocol of the schema.

        Raises:
            FileNotFoundError, ValueError: same as `open`.
        """
        data = cls.open(path or source.path, schema.protocol, source.skip_bad, source.missing)
        if data.schema.skeleton == schema.skeleton:
            return data
        skeleton, motion = schema.skeleton, data.motion
        if data.fingerprint == source.fingerprint:
            return data
        if motion.skeleton.fps != skeleton.fps:
            raise ValueError(
                f"{data.path} has {motion.skeleton.fps:g} frames per second, but the recorded windows have "
                f"{skeleton.fps:g}; `dvae data convert {data.path} --fps {skeleton.fps:g} --out FILE` resamples it"
            )
        try:
            mapped = select_joints(motion, onto=skeleton)
        except ValueError:  # the caller compares the schemas and reports the difference
            return data
        clips = [replace(clip, rotations=None) for clip in mapped]
        mapped = MotionSet(
            clips,
            skeleton,
            motion.name,
            skipped=motion.skipped,
            interpretation=motion.interpretation,
            missing=motion.missing,
        )
        return replace(data, motion=mapped, onto=True)
