"""Segments of motion files on the bundled body, in a form that runs can record and reopen."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, Self

import numpy as np

from ...options import Amount, check, nearest
from ..bodies import fit_to_body, human
from ..data.clips import Clip, MotionSet
from ..data.dataset import SIMULATED
from ..data.protocols import held_out
from ..data.simulator import simulate
from ..files import read_motion
from .embodied import Segments, SegmentSchema
from .frames import TimedFrames
from .gait import Cycles, gait_cycles, reference_cycles

Segmentation = Literal["gait", "clips"]
"""How motion is cut into segments: gait cycles, or whole clips whose duration is plausible for a cycle."""

VALIDATION = 0.1
"""Fraction of the training takes that are used for validation instead."""


def subsample_clips(clips: Sequence[Clip], many: int) -> list[Clip]:
    """Return at most `many` evenly spaced clips."""
    return [clips[n] for n in np.linspace(0, len(clips) - 1, min(many, len(clips))).round().astype(int)]


@dataclass(frozen=True)
class SegmentSource:
    """Record of the file of the segments, and of the options for reading it.

    Args:
        path: path of the file as the user gave it, or "simulated".
        fingerprint: SHA-256 of the clips and of `cut`.
        cut: how clips were cut into segments, "gait" or "clips".
        skip_bad: whether unusable clips were left out.
        bodies: standard deviation of the shape parameters drawn for training segments, as in `Segments`.
    """

    path: str
    fingerprint: str
    cut: Segmentation = "gait"
    skip_bad: bool = False
    bodies: Amount = 1.0

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, eq=False)
class SegmentData:
    """Segments of motion data on the bundled body.

    Splits are by take: all segments of a clip are in its split, and the validation takes are chosen from the training
    takes. Motion is fitted to the body only when it is needed.

    Args:
        path: path of the file as the user gave it, or "simulated".
        motion: clips as they were read.
        cut: how clips are cut into segments: "gait" finds gait cycles, "clips" uses whole clips.
        skip_bad: whether unusable clips were left out.
        scaling: scaling of rotations, as in `TimedFrames.of`.
        warped: whether frames are aligned with the most typical gait cycles of these data, as in `TimedFrames`.
        bodies: standard deviation of the shape parameters drawn for training segments, as in `Segments`; 0 keeps their
            own shapes.
        seen: conversion to frames of an existing run; default: estimated from the training segments.
    """

    kind: ClassVar[str] = "segments"
    schema_kind: ClassVar[str] = SegmentSchema.kind
    source: ClassVar[type[SegmentSource]] = SegmentSource
    onto: ClassVar[bool] = False
    """Always False: all motion is fitted to the body, never mapped to the skeleton of a run."""

    path: str
    motion: MotionSet
    cut: Segmentation = "gait"
    skip_bad: bool = False
    scaling: Literal["identity", "deviation"] = "identity"
    warped: bool = False
    bodies: Amount = 1.0
    seen: TimedFrames | None = None

    def __post_init__(self) -> None:
        check(self)

    @classmethod
    def open(cls, path: str | os.PathLike[str] = SIMULATED, skip_bad: bool = False, **options: Any) -> Self:
        """Read a motion file, or simulate motion.

        Args:
            path: file or folder that `read_motion` reads, or "simulated" for `simulate()`. Takes whose split is neither
                "train" nor "test" are divided: the last fifth is for testing. A single take is divided in time.
            skip_bad: leave out unusable clips instead of raising an error.
            **options: cut, scaling, warped, bodies and seen, as in the class.

        Returns:
            Takes, divided into splits, and their segments.

        Raises:
            FileNotFoundError: the file does not exist.
            ValueError: the file cannot be read, or an option is invalid.
        """
        name = os.fspath(path)
        motion = simulate() if name == SIMULATED else read_motion(name, skip_bad=skip_bad)
        if not {"train", "test"} & {*motion.splits}:
            longest = max(clip.frames for clip in motion)
            motion = motion.assign_splits(shortest=1 if len(motion) == 1 else longest + 1)
        return cls(name, motion, skip_bad=skip_bad, **options)

    @property
    def location(self) -> str:
        """Absolute path of the clips, or "simulated"."""
        return self.path if self.path == SIMULATED else os.path.abspath(self.path)

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of the clips as they were read, and of `cut`."""
        return hashlib.sha256(f"{self.motion.fingerprint()} {self.cut}".encode()).hexdigest()

    @property
    def schema(self) -> SegmentSchema:
        """Schema of the segments for models."""
        return SegmentSchema.from_data(self.timed, human())

    @cached_property
    def segments(self) -> MotionSet:
        """All segments, each a clip on the joints of the body; the label `source` names its take.

        Raises:
            ValueError: no segments were found.
        """
        if self.cut == "gait":
            return gait_cycles(self._embodied)
        cycles, fps = Cycles(), self.motion.skeleton.fps
        clips = [clip for clip in self.motion if cycles.shortest <= (clip.frames - 1) / fps <= cycles.longest]
        if not clips:
            raise ValueError(
                f"cut='clips' uses clips of {cycles.shortest:g} to {cycles.longest:g} s as segments, but {self.path} "
                "has none; cut='gait' finds the gait cycles in longer clips"
            )
        marked = [replace(clip, labels={**clip.labels, "source": clip.name}) for clip in clips]
        return fit_to_body(replace(self.motion, clips=marked), human())

    @cached_property
    def timed(self) -> TimedFrames:
        """Conversion of the segments to frames: `seen`, or estimated from the training segments."""
        return self.seen or self._training.timed

    def windows(self, split: str) -> Segments:
        """Return the segments of "train", "validation" or "test".

        Args:
            split: "train", "validation" or "test".

        Raises:
            ValueError: the split is unknown or empty.
        """
        return self._training if split == "train" else Segments(self._of(split), self.timed)

    def segments_of(self, name: str) -> Segments:
        """Return one segment by its name, or the first segment of a take.

        Args:
            name: name of a segment or take, or split/name if the name is not unique.

        Raises:
            ValueError: no segment or several segments match.
        """

        def among(names: Mapping[str, Clip]) -> list[Clip]:
            """Return the clips with this name, with or without their split."""
            return [clip for key, clip in names.items() if name in (key, key.partition("/")[2])]

        segments = {f"{clip.split}/{clip.name}": clip for clip in self.segments}
        takes = {f"{clip.split}/{clip.labels['source']}": clip for clip in reversed([*self.segments])}
        clips = among(segments) or among(takes)
        if len(clips) != 1:
            names = [key.partition("/")[2] for key in (*takes, *segments)]
            raise ValueError(
                f"no segment or take {name!r}{nearest(name, names)} in {self.path}; the first segment is "
                f"{next(iter(segments))}"
                if not clips
                else f"several segments or takes are named {name!r}; choose "
                f"{' or '.join('/'.join(clip.key) for clip in clips)}"
            )
        return Segments(replace(self.segments, clips=clips), self.timed)

    def recorded(self) -> SegmentSource:
        """Return the record of these data that `reopen` reads."""
        return SegmentSource(self.path, self.fingerprint, self.cut, self.skip_bad, self.bodies)

    @classmethod
    def reopen(cls, source: SegmentSource, schema: SegmentSchema, path: str | os.PathLike[str] | None = None) -> Self:
        """Open the data of a run again, with the run's conversion to frames.

        The fingerprint is not compared, so the content of the file may have changed.

        Args:
            source: result of `recorded`.
            schema: schema of the run.
            path: path of the data now, or of other data; default: the recorded path.

        Returns:
            Segments of the file, with the conversion to frames of the schema.

        Raises:
            FileNotFoundError, ValueError: same as `open`.
        """
        options = {"cut": source.cut, "bodies": source.bodies}
        return cls.open(path or source.path, source.skip_bad, **options, seen=schema.timed)

    @cached_property
    def _training(self) -> Segments:
        """The training segments; unless `seen` was given, the units of frames are estimated from them."""
        motion = self._of("train")
        if self.seen is not None:
            return Segments(motion, self.seen, bodies=self.bodies)
        references = reference_cycles(self._embodied) if self.warped else ()
        timed, batch = TimedFrames.seeing(motion, scaling=self.scaling, references=references)
        return Segments(motion, timed, frames=batch, bodies=self.bodies)

    @cached_property
    def _embodied(self) -> MotionSet:
        return fit_to_body(self.motion, human())

    def _of(self, split: str) -> MotionSet:
        if split not in ("train", "validation", "test"):
            raise ValueError(f"no split {split!r}: expected train, validation or test")
        takes = list(dict.fromkeys(clip.labels["source"] for clip in self.segments if clip.split == "train"))
        aside = {takes[index] for index in held_out(len(takes), VALIDATION)}

        def split_of(clip: Clip) -> str:
            return "validation" if clip.split == "train" and clip.labels["source"] in aside else clip.split

        clips = [clip for clip in self.segments if split_of(clip) == split]
        if not clips:
            raise ValueError(
                f"{self.path} has no segments for {split}: its {len(self.segments)} segments are in "
                f"{', '.join(self.segments.splits)}, and a tenth of the training takes is for validation"
            )
        return replace(self.segments, clips=clips)
