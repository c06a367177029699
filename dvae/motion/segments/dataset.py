"""Segments of motion files, as runs keep and reopen them: put onto the body that ships, cut, and seen as frames."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, Self

import numpy as np

from ...options import Amount, check, nearest
from ..bodies import fitted, human
from ..data.clips import Clip, MotionSet
from ..data.dataset import SIMULATED
from ..data.protocols import held_out
from ..data.simulator import simulate
from ..files import read_motion
from .embodied import Segments, SegmentSchema
from .frames import TimedFrames
from .gait import Cycles, gait_cycles, reference_cycles

Segmentation = Literal["gait", "clips"]
"""How motion becomes segments: gait cycles, or clips as they are, where they last as long as a cycle may."""

VALIDATION = 0.1
"""Part of the takes for training that is held out."""


def thinned(clips: Sequence[Clip], many: int) -> list[Clip]:
    """So many of them, evenly, or all where there are no more."""
    return [clips[n] for n in np.linspace(0, len(clips) - 1, min(many, len(clips))).round().astype(int)]


@dataclass(frozen=True)
class Takes:
    """Where segments are from, as a run keeps it.

    Args:
        path: the file as it was given, or "simulated".
        fingerprint: SHA-256 of the clips, and of how they are cut.
        cut: how they are.
        skip_bad: whether unusable clips were left out.
        bodies: those on which training segments were learned, see `Segments`.
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
    """Segments of motion data on the body that ships.

    Splits are by take: all segments of a clip are in its split, and the takes for validation are some of those for
    training. Nothing is put onto the body before it is asked for.

    Args:
        path: the file as it was given, or "simulated".
        motion: its clips, as they were read.
        cut: how they become segments.
        skip_bad: whether unusable clips were left out.
        scaling: of turns, see `TimedFrames.of`.
        warped: time goes along the gait cycles that are most typical of these data, see `TimedFrames`.
        bodies: deviation of the shapes on which training segments are drawn, see `Segments`; 0 for their own.
        seen: as which frames, those of a run; else those that training segments give.
    """

    kind: ClassVar[str] = "segments"
    described: ClassVar[str] = SegmentSchema.kind
    source: ClassVar[type[Takes]] = Takes
    onto: ClassVar[bool] = False
    """Of all motion alike: it is put onto the body, and never onto the skeleton of a run."""

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
        """Reads a motion file, or simulates.

        Args:
            path: of a file or folder that `read_motion` reads, or "simulated" for `simulate()`. Takes that are in
                neither split "train" nor "test" are divided, the last fifth of them for test; of one alone, its end.
            skip_bad: leave out unusable clips instead of refusing the file.
            **options: cut, scaling, warped, bodies and seen, see the class.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: a file that cannot be read, or an unknown option.
        """
        name = os.fspath(path)
        motion = simulate() if name == SIMULATED else read_motion(name, skip_bad=skip_bad)
        if not {"train", "test"} & {*motion.splits}:
            longest = max(clip.frames for clip in motion)
            motion = motion.divided(shortest=1 if len(motion) == 1 else longest + 1)
        return cls(name, motion, skip_bad=skip_bad, **options)

    @property
    def location(self) -> str:
        """Where the clips are, as any process finds them."""
        return self.path if self.path == SIMULATED else os.path.abspath(self.path)

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of the clips as they were read, and of how they are cut."""
        return hashlib.sha256(f"{self.motion.fingerprint()} {self.cut}".encode()).hexdigest()

    @property
    def schema(self) -> SegmentSchema:
        """What a model must know of the segments."""
        return SegmentSchema.under(self.timed, human())

    @cached_property
    def segments(self) -> MotionSet:
        """All of them, each a clip on the joints of the body, with the label `source` that names its take.

        Raises:
            ValueError: there is none.
        """
        if self.cut == "gait":
            return gait_cycles(self._embodied)
        cycles, fps = Cycles(), self.motion.skeleton.fps
        kept = [clip for clip in self.motion if cycles.shortest <= (clip.frames - 1) / fps <= cycles.longest]
        if not kept:
            raise ValueError(
                f"{self.path} has no clip that lasts {cycles.shortest:g} to {cycles.longest:g} s, to be a segment as "
                "it is; cut='gait' finds the gait cycles of longer ones"
            )
        marked = [replace(clip, labels={**clip.labels, "source": clip.name}) for clip in kept]
        return fitted(replace(self.motion, clips=marked), human())

    @cached_property
    def timed(self) -> TimedFrames:
        """As which frames they are seen."""
        return self.seen or self._training.timed

    def windows(self, split: str) -> Segments:
        """The segments of "train", "validation" or "test".

        Raises:
            ValueError: there is none, or no such split.
        """
        return self._training if split == "train" else Segments(self._of(split), self.timed)

    def found(self, name: str) -> Segments:
        """One segment, by its name; or the first one of a take.

        Args:
            name: of either, or split/name where it is not unique.

        Raises:
            ValueError: there is none, or more than one.
        """

        def among(names: Mapping[str, Clip]) -> list[Clip]:
            """Those called so, with or without their split."""
            return [clip for key, clip in names.items() if name in (key, key.partition("/")[2])]

        segments = {f"{clip.split}/{clip.name}": clip for clip in self.segments}
        takes = {f"{clip.split}/{clip.labels['source']}": clip for clip in reversed([*self.segments])}
        clips = among(segments) or among(takes)
        if len(clips) != 1:
            few = [key.partition("/")[2] for key in (*takes, *segments)]
            raise ValueError(
                f"no segment or take {name!r}{nearest(name, few)} in {self.path}; the first is {next(iter(segments))}"
                if not clips
                else f"{name!r} is the name of several; say {' or '.join('/'.join(clip.key) for clip in clips)}"
            )
        return Segments(replace(self.segments, clips=clips), self.timed)

    def recorded(self) -> Takes:
        """Where the clips are; `reopened` reads it."""
        return Takes(self.path, self.fingerprint, self.cut, self.skip_bad, self.bodies)

    @classmethod
    def reopened(cls, source: Takes, schema: SegmentSchema, path: str | os.PathLike[str] | None = None) -> Self:
        """The data that were recorded, from there or from another path, whatever they are now, as frames of a run.

        Args:
            source: as `recorded` gave it.
            schema: of the run.
            path: where they lie now, or of others.

        Raises:
            FileNotFoundError, ValueError: see `open`.
        """
        kept = {"cut": source.cut, "bodies": source.bodies}
        return cls.open(path or source.path, source.skip_bad, **kept, seen=schema.timed)

    @cached_property
    def _training(self) -> Segments:
        """Those from which frames have their units, unless these are those of a run."""
        motion = self._of("train")
        if self.seen is not None:
            return Segments(motion, self.seen, bodies=self.bodies)
        references = reference_cycles(self._embodied) if self.warped else ()
        timed, seen = TimedFrames.seeing(motion, scaling=self.scaling, references=references)
        return Segments(motion, timed, seen=seen, bodies=self.bodies)

    @cached_property
    def _embodied(self) -> MotionSet:
        return fitted(self.motion, human())

    def _of(self, split: str) -> MotionSet:
        if split not in ("train", "validation", "test"):
            raise ValueError(f"no split {split!r}: expected train, validation or test")
        takes = list(dict.fromkeys(clip.labels["source"] for clip in self.segments if clip.split == "train"))
        aside = {takes[place] for place in held_out(len(takes), VALIDATION)}

        def where(clip: Clip) -> str:
            return "validation" if clip.split == "train" and clip.labels["source"] in aside else clip.split

        clips = [clip for clip in self.segments if where(clip) == split]
        if not clips:
            raise ValueError(
                f"{self.path} has no segments for {split}: {len(self.segments)} are of takes in "
                f"{', '.join(self.segments.splits)}, and validation takes a tenth of those in train"
            )
        return replace(self.segments, clips=clips)
