"""Segments of motion files on a body, in a form that runs can record and reopen."""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, Self

import numpy as np

from ...options import Amount, check, nearest
from ..bodies import Body, fit_to_body, human, read_body, reopen_body
from ..bodies.fitting import is_from_file
from ..data.clips import Clip, MotionSet
from ..data.dataset import SIMULATED
from ..data.protocols import held_out
from ..data.simulator import simulate
from ..files import read_motion
from ..files.smpl import has_smpl_rest
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
        hold_out: names of the sources whose takes are all for testing, as in `SegmentData.open`.
    """

    path: str
    fingerprint: str
    cut: Segmentation = "gait"
    skip_bad: bool = False
    bodies: Amount = 1.0
    hold_out: Sequence[str] = ()

    def __post_init__(self) -> None:
        check(self)


def _read(path: str, skip_bad: bool) -> MotionSet:
    return simulate() if path == SIMULATED else read_motion(path, skip_bad=skip_bad)


def _divide(motion: MotionSet) -> MotionSet:
    """Return takes in the splits "train" and "test"; takes in other splits are divided."""
    if {"train", "test"} & {*motion.splits}:
        return motion
    longest = max(clip.frames for clip in motion)
    return motion.assign_splits(shortest=1 if len(motion) == 1 else longest + 1)


def _sources(motion: MotionSet) -> set[str]:
    """Return the names of sources: splits, and the folders that contain them, such as "SFU" for "SFU/0005"."""
    folders = [split.split("/") for split in motion.splits]
    return {"/".join(names[:n]) for names in folders for n in range(1, len(names) + 1)}


def hold_out_sources(motion: MotionSet, sources: Sequence[str]) -> MotionSet:
    """Return takes from the named sources in the split "test", and all others in the split "train".

    Marsot et al. hold out the data sets MPI mosh, SFU and TotalCapture of AMASS, as its authors recommend.

    Args:
        motion: takes whose splits name their sources, as in "SFU/0005" for a file in this folder. The split becomes a
            prefix of the take's name.
        sources: names of splits, or of folders that contain them, such as ("MPI_mosh", "SFU", "TotalCapture").

    Raises:
        ValueError: a name is not a source, or no take is left for training.
    """
    known = _sources(motion)
    if missing := [source for source in sources if source not in known]:
        raise ValueError(
            f"hold_out has {missing[0]!r}{nearest(missing[0], sorted(known))}, which is no source; the sources are "
            f"{', '.join(sorted({split.partition('/')[0] for split in motion.splits}))[:600]}"
        )

    def split_of(clip: Clip) -> str:
        return "test" if any(f"{clip.split}/".startswith(f"{source}/") for source in sources) else "train"

    clips = [replace(clip, split=split_of(clip), name=f"{clip.split}-{clip.name}".replace("/", "-")) for clip in motion]
    if all(clip.split == "test" for clip in clips):
        raise ValueError(f"hold_out has all sources, {', '.join(sources)[:600]}; leave some for training")
    return replace(motion, clips=clips)


@dataclass(frozen=True, eq=False)
class SegmentData:
    """Segments of motion data on a body.

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
        body: body to which motion is fitted; default: the bundled person.
        hold_out: sources that were held out for testing, as in `open`.
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
    body: Body = field(default_factory=human)
    hold_out: Sequence[str] = ()

    def __post_init__(self) -> None:
        check(self)

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str] = SIMULATED,
        skip_bad: bool = False,
        body: str | os.PathLike[str] | Body | None = None,
        betas: int = 8,
        hold_out: Sequence[str] = (),
        **options: Any,
    ) -> Self:
        """Read a motion file, or simulate motion.

        Args:
            path: file or folder that `read_motion` reads, or "simulated" for `simulate()`. Takes whose split is neither
                "train" nor "test" are divided: the last fifth is for testing. A single take is divided in time.
            skip_bad: leave out unusable clips instead of raising an error.
            body: model file of SMPL, SMPL-H or SMPL-X, as in `bodies.read_body`, or a body; default: the bundled
                person. Motion of AMASS keeps its rotations and shape parameters on a body from a file.
            betas: number of shape parameters of a body in a file.
            hold_out: names of the sources whose takes are all for testing, such as the folders of AMASS
                ("MPI_mosh", "SFU", "TotalCapture"); all other takes are for training.
            **options: cut, scaling, warped, bodies and seen, as in the class.

        Returns:
            Takes, divided into splits, and their segments.

        Raises:
            FileNotFoundError: a file does not exist.
            ValueError: a file cannot be read, or an option is invalid.
        """
        name = os.fspath(path)
        if betas != 8 and (body is None or isinstance(body, Body)):
            raise ValueError(f"betas is {betas}, but only a body in a file has a choice; give its path as body")
        if not isinstance(body, Body):
            body = human() if body is None else read_body(body, betas)
        motion = _read(name, skip_bad)
        motion = hold_out_sources(motion, hold_out) if hold_out else _divide(motion)
        return cls(name, motion, skip_bad=skip_bad, body=body, hold_out=tuple(hold_out), **options)

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
        return SegmentSchema.from_data(self.timed, self.body)

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
        return fit_to_body(replace(self.motion, clips=marked), self.body)

    @cached_property
    def timed(self) -> TimedFrames:
        """Conversion of the segments to frames: `seen`, or estimated from the training segments."""
        return self.seen or self._training.timed

    def parts(self) -> dict[str, str]:
        """Return one sentence for each split, and one for the frames, with the joints whose rotations they omit."""
        sentences = {}
        for split in ("train", "validation", "test"):
            sources = [clip.labels["source"] for clip in self.segments if self._split_of(clip) == split]
            sentences[split] = f"{len(sources)} {split} segments of {len({*sources})} takes"
        timed = self.timed
        sentences["frames"] = (
            f"{timed.frames} frames of {timed.size} numbers: rotations of {len(timed.turning)} joints, translation and "
            f"time; rotations of {', '.join(timed.still) or 'no joint'} are constant or unknown, and left out"
        )
        genders = Counter(clip.labels.get("gender", "unknown") for clip in self.motion)
        if is_from_file(self.body) and has_smpl_rest(self.motion.skeleton) and len(genders) > 1:
            counts = ", ".join(f"{count} {gender}" for gender, count in genders.items())
            sentences["body"] = (
                f"the betas of all takes ({counts}) are used on one body, although AMASS fits them to a body per gender"
            )
        return sentences

    def windows(self, split: str) -> Segments:
        """Return the segments of "train", "validation" or "test".

        Args:
            split: "train", "validation" or "test".

        Raises:
            ValueError: the split is unknown or empty.
        """
        return self._training if split == "train" else self.of_clips(self._of(split).clips)

    def of_clips(self, clips: Sequence[Clip]) -> Segments:
        """Return some of the segments, with the conversion to frames of these data.

        Args:
            clips: clips of `segments`.
        """
        return Segments(replace(self.segments, clips=clips), self.timed, self.body)

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
        return self.of_clips(clips)

    def recorded(self) -> SegmentSource:
        """Return the record of these data that `reopen` reads."""
        return SegmentSource(self.path, self.fingerprint, self.cut, self.skip_bad, self.bodies, self.hold_out)

    @classmethod
    def reopen(cls, source: SegmentSource, schema: SegmentSchema, path: str | os.PathLike[str] | None = None) -> Self:
        """Open the data of a run again, with the run's conversion to frames.

        The fingerprint is not compared, so the content of the file may have changed. Of the sources that the run held
        out, those in the file are held out; a file with none of them is divided as in `open`.

        Args:
            source: result of `recorded`.
            schema: schema of the run.
            path: path of the data now, or of other data; default: the recorded path.

        Returns:
            Segments of the file, with the conversion to frames of the schema.

        Raises:
            FileNotFoundError, ValueError: same as `open`.
        """
        body, name = reopen_body(schema.body), os.fspath(path or source.path)
        motion = _read(name, source.skip_bad)
        known = _sources(motion)
        sources = tuple(name for name in source.hold_out if name in known)
        motion = hold_out_sources(motion, sources) if sources else _divide(motion)
        return cls(
            *(name, motion, source.cut, source.skip_bad),
            bodies=source.bodies,
            seen=schema.timed,
            body=body,
            hold_out=sources,
        )

    @cached_property
    def _training(self) -> Segments:
        """The training segments; unless `seen` was given, the units of frames are estimated from them."""
        motion = self._of("train")
        if self.seen is not None:
            return Segments(motion, self.seen, self.body, bodies=self.bodies)
        references = reference_cycles(self._embodied) if self.warped else ()
        timed, batch = TimedFrames.seeing(motion, scaling=self.scaling, references=references)
        return Segments(motion, timed, self.body, batch, self.bodies)

    @cached_property
    def _embodied(self) -> MotionSet:
        return fit_to_body(self.motion, self.body)

    @cached_property
    def _aside(self) -> set[str]:
        """Names of the training takes whose segments are for validation."""
        takes = list(dict.fromkeys(clip.labels["source"] for clip in self.segments if clip.split == "train"))
        return {takes[index] for index in held_out(len(takes), VALIDATION)}

    def _split_of(self, clip: Clip) -> str:
        return "validation" if clip.split == "train" and clip.labels["source"] in self._aside else clip.split

    def _of(self, split: str) -> MotionSet:
        if split not in ("train", "validation", "test"):
            raise ValueError(f"no split {split!r}: expected train, validation or test")
        clips = [clip for clip in self.segments if self._split_of(clip) == split]
        if not clips:
            raise ValueError(
                f"{self.path} has no segments for {split}: its {len(self.segments)} segments are in "
                f"{', '.join(self.segments.splits)}, and a tenth of the training takes is for validation"
            )
        return replace(self.segments, clips=clips)
