"""Motion clips and sets of clips, checked when they are made.

A clip is (frames, joints, 3) float32 in metres. Clip names may repeat between splits (the CMU benchmark has a
`walking_1` in both), so whatever points at a clip does so by (split, name).
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import networkx as nx
import numpy as np
import torch
from rich.console import Group, RenderableType
from typing_extensions import override

from ...data.blocks import blocks, hash_values, ranges
from ...data.npy import is_mapped
from ...data.sequences import tensor_of
from ...inference.evaluation.result import Table  # which shows what files say as it is
from ..geometry.kinematics import inverse, rest
from ..geometry.rotations import continuous, from_matrix
from ..geometry.skeleton import Skeleton

SMALLEST, TALLEST = 0.3, 3.0
"""Metres between which a body's largest extent must lie: room for a child, too narrow for another unit."""


MOST_FRAMES = 20_000
"""From which a rest pose is found, and the size of a body in a clip."""

STIFF = 1e-3
"""Metres of deviation, in a clip, below which a distance between joints is taken for constant."""


@dataclass(frozen=True, eq=False)
class Clip:
    """One recording.

    Args:
        split: what the archive files it under: "train" and "test", or a subject.
        name: its name, unique within the split.
        positions: (F, J, 3) in metres, global; NaN where a joint was not observed (see `MotionSet`).
        labels: what is known about it, as text.
        truth: what a simulator knows about it, as arrays; real clips have none.
        rotations: (F, J, 4), of every joint against its parent, as quaternions w x y z; of files that have them, and
            of `MotionSet.with_rotations`. An end, from which nothing hangs, has no turn that could be seen.
    """

    split: str
    name: str
    positions: np.ndarray
    labels: Mapping[str, str] = field(default_factory=dict)
    truth: Mapping[str, np.ndarray] = field(default_factory=dict)
    rotations: np.ndarray | None = None

    @override
    def __repr__(self) -> str:
        turns = "" if self.rotations is None else ", with rotations"
        return f"Clip({self.split}/{self.name}: {self.frames} frames of {self.positions.shape[1]} joints{turns})"

    @property
    def key(self) -> tuple[str, str]:
        """(split, name)."""
        return self.split, self.name

    @property
    def frames(self) -> int:
        """Number of frames F."""
        return len(self.positions)

    def between(self, start: int, end: int) -> Clip:
        """Frames from one to before another."""
        turns = None if self.rotations is None else self.rotations[start:end]
        truth = {k: v[start:end] if v.shape[:1] == (self.frames,) else v for k, v in self.truth.items()}
        return replace(self, positions=self.positions[start:end], rotations=turns, truth=truth)

    def resampled(self, ratio: float) -> Clip:
        """One frame for every so many: these frames where that is whole, else between them.

        Positions are interpolated linearly and rotations along the shortest arc; what a simulator knows is left out.
        """
        if abs(ratio - round(ratio)) < 1e-6 and ratio >= 1:
            every = round(ratio)
            turns = None if self.rotations is None else self.rotations[::every]
            return replace(self, positions=self.positions[::every], rotations=turns, truth={})
        at = np.arange(int((self.frames - 1) / ratio + 1e-6) + 1) * ratio
        before = np.minimum(at.astype(int), max(self.frames - 2, 0))
        after = np.minimum(before + 1, self.frames - 1)
        part = (at - before)[:, None, None]
        first, second = np.where(part < 1, self.positions[before], 0), np.where(part > 0, self.positions[after], 0)
        positions = (1 - part) * first + part * second  # what has no share may be missing
        turns = None if self.rotations is None else _between(self.rotations[before], self.rotations[after], part)
        return replace(self, positions=positions.astype(self.positions.dtype), rotations=turns, truth={})


def _between(first: np.ndarray, second: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) on the shortest arc between others (Shoemake 1985)."""
    cosine = (first * second).sum(-1, keepdims=True)
    second, cosine = np.where(cosine < 0, -second, second), np.abs(cosine).clip(max=1)
    angle = np.maximum(np.arccos(cosine), 1e-6)  # below, sines and angles are one
    found = (np.sin((1 - part) * angle) * first + np.sin(part * angle) * second) / np.sin(angle)
    return np.asarray(found / np.linalg.norm(found, axis=-1, keepdims=True), first.dtype)


def defect(clip: Clip, skeleton: Skeleton, missing: bool = False) -> str | None:
    """Why a clip cannot be used with a skeleton, in a sentence that names the clip; None when it can.

    Args:
        clip: the clip.
        skeleton: that it is to have.
        missing: joints may be NaN in some frames.
    """
    where, positions = f"clip {clip.split}/{clip.name}", clip.positions
    if positions.dtype.kind not in "fiu":
        return f"{where} holds {positions.dtype}, expected numbers"
    if positions.ndim != 3 or positions.shape[2] != 3:
        return f"{where} has shape {positions.shape}, expected (frames, joints, 3)"
    if positions.shape[1] != skeleton.joints:
        return f"{where} has {positions.shape[1]} joints, skeleton {skeleton.name!r} has {skeleton.joints}"
    if not len(positions):
        return f"{where} has no frames"
    count = frames = 0
    first, seen = (0, 0), False
    for rows in ranges(positions):
        with np.errstate(over="ignore"):
            some = positions[rows].astype(np.float32, copy=False)
        lacking = ~np.isfinite(some).all(axis=2)
        seen |= not lacking.all()
        bad = np.asarray(np.isinf(some).any(axis=2) if missing else lacking)
        if bad.any():
            frame, joint = np.argwhere(bad)[0]
            first = first if count else (rows.start + frame, joint)
            count, frames = count + bad.sum(), frames + bad.any(axis=1).sum()
    if count:
        what = "infinite" if missing else "NaN or infinite"
        kept = not missing and not defect(clip, skeleton, missing=True)
        hint = "; missing=True (--missing) keeps the clip, with these joints missing" if kept else ""
        return (
            f"{where} has {what} positions, or none that float32 can hold: {count} joint positions in "
            f"{frames} of {clip.frames} frames, first {skeleton.names[first[1]]} at frame {first[0]}{hint}"
        )
    if not seen:
        return f"{where} has no joint that is observed in any of its {clip.frames} frames"
    if clip.rotations is not None:
        if clip.rotations.shape != (*positions.shape[:2], 4) or clip.rotations.dtype.kind != "f":
            return f"{where} has rotations {clip.rotations.shape}, expected quaternions {(*positions.shape[:2], 4)}"
        if not all((np.abs(np.square(some).sum(-1) - 1) < 1e-3).all() for some in blocks(clip.rotations)):
            return f"{where} has rotations that are no quaternions of unit length"
    extent = float(np.median(extents(some_frames(positions)).max(axis=1)))
    if not SMALLEST <= extent <= TALLEST:
        unit = "millimetres" if extent >= 300 else "centimetres" if extent >= 30 else "another unit"
        return (
            f"{where} shows a person of {extent:.4g} m (median over frames of the body's largest extent, "
            f"expected {SMALLEST} to {TALLEST} m): it looks like {unit}; convert the positions to metres"
        )
    return None


def some_frames(positions: np.ndarray) -> np.ndarray:
    """Frames of (F, J, 3), evenly spread and at most `MOST_FRAMES`, in which joints were observed."""
    some = positions[:: -(-len(positions) // MOST_FRAMES)]
    return positions if np.isnan(some).any(axis=2).all() else some


def extents(positions: np.ndarray) -> np.ndarray:
    """Of the body along each axis, (frames, 3), in those frames of (F, J, 3) that have the most joints."""
    poses = fullest(positions)
    found: np.ndarray = np.nanmax(poses, axis=1) - np.nanmin(poses, axis=1).astype(np.float64)
    return found


def fullest(positions: np.ndarray) -> np.ndarray:
    """Those frames of (F, J, 3) that have the most joints."""
    there = (~np.isnan(positions).any(axis=2)).sum(axis=1)
    full: np.ndarray = there == there.max()
    return positions if full.all() else positions[full]  # a copy only where it is another


def _taken(values: np.ndarray, copy: bool = True) -> np.ndarray:
    """As float32 in C order, which nobody else holds, if it is copied; or as it is mapped."""
    if is_mapped(values) and values.dtype == np.float32 and values.flags.c_contiguous:
        return values
    found = np.require(values, np.float32, ["C", "A", "W"])
    return found.copy() if copy and np.may_share_memory(found, values) else found


@dataclass(init=False, frozen=True, eq=False)
class MotionSet:
    """Clips of one skeleton.

    Iterating gives the clips, `motion["train", "walking_1"]` one of them.

    Args:
        clips: the clips, asked for once; copied as float32, but for arrays of that type that are mapped from a disk.
        skeleton: the tree that all of them have.
        name: what to call the set.
        copy: False takes over arrays that are float32 already, which nobody else may hold.
        skip_bad: leave out clips that cannot be used, and list them in `skipped`.
        skipped: those that were left out before, as (split, name, reason).
        said: how the files' units and axes were understood, for people to check.
        missing: joints may be NaN where they were not observed, a joint as a whole: what lacks a coordinate lacks all.
            Windows then tell by a mask what was observed.

    Raises:
        ValueError: a clip has NaN that is not allowed, wrong joints, a wrong shape or implausible units, two clips
            share a key, or there is no clip.
    """

    clips: Sequence[Clip]
    skeleton: Skeleton
    name: str
    skipped: Sequence[tuple[str, str, str]]
    said: str
    missing: bool

    def __init__(
        self,
        clips: Iterable[Clip],
        skeleton: Skeleton,
        name: str = "",
        copy: bool = True,
        skip_bad: bool = False,
        *,
        skipped: Iterable[tuple[str, str, str]] = (),
        said: str = "",
        missing: bool = False,
    ) -> None:
        single, left_out, what = [], list(skipped), name or "motion set"
        for clip in clips:  # an iterator need not hold clips that were taken over
            if reason := defect(clip, skeleton, missing):
                if not skip_bad:
                    raise ValueError(f"{what}: {reason}")
                left_out.append((*clip.key, reason))
                del clip
                continue
            positions = _taken(clip.positions, copy)
            if missing and any((np.isnan(some).sum(axis=2) % 3).any() for some in blocks(positions)):
                positions = positions.copy() if is_mapped(positions) else positions
                positions[np.isnan(positions).any(axis=2)] = np.nan
            turns = None if clip.rotations is None else _taken(clip.rotations)
            single.append(Clip(clip.split, clip.name, positions, clip.labels, clip.truth, turns))
            del clip, positions
        if not single:
            dropped = f"; {len(left_out)} were skipped, the first: {left_out[0][2]}" if left_out else ""
            raise ValueError(f"{what}: no clips{dropped}")
        twice = [key for key, count in Counter(clip.key for clip in single).items() if count > 1]
        if twice:
            raise ValueError(f"{what}: clip {'/'.join(twice[0])} is there twice")
        fields = {"clips": tuple(single), "skeleton": skeleton, "name": name, "skipped": tuple(left_out)}
        vars(self).update(fields, said=said, missing=missing, _index={clip.key: clip for clip in single})

    @override
    def __repr__(self) -> str:
        frames, skeleton = sum(clip.frames for clip in self), self.skeleton
        what = f"{len(self)} clips, {frames} frames of {skeleton.joints} joints at {skeleton.fps:g} a second"
        return f"MotionSet({self.name or 'no name'}: {what})"

    def __len__(self) -> int:
        return len(self.clips)

    def __iter__(self) -> Iterator[Clip]:
        return iter(self.clips)

    def __getitem__(self, key: tuple[str, str]) -> Clip:
        index: dict[tuple[str, str], Clip] = self.__dict__["_index"]
        try:
            return index[key]
        except (KeyError, TypeError):
            raise KeyError(f"no clip {key!r} in {self.name!r}; keys are (split, clip name)") from None

    @property
    def splits(self) -> list[str]:
        """The splits, in order of appearance."""
        return list(dict.fromkeys(clip.split for clip in self.clips))

    def with_rotations(self) -> MotionSet:
        """The same motion with the turns of joints too, and the rest pose that they turn.

        Those that files have are kept. Elsewhere they are found by `kinematics.inverse`, for bones that have the mean
        lengths of all clips; positions stay as they are.
        """
        if self.skeleton.rest and all(clip.rotations is not None for clip in self):
            return self
        if lacking := [clip for clip in self if clip.rotations is None and np.isnan(clip.positions).any()]:
            raise ValueError(
                f"clip {'/'.join(lacking[0].key)} lacks joints, without which their turns are not known; leave it out, "
                "or fill its gaps first (`dvae impute RUN --filled FILE`)"
            )
        found: MotionSet | None = self.__dict__.get("_turned")
        if found is None:  # once, for all splits
            skeleton = self.skeleton
            if not skeleton.rest:
                every = -(-sum(clip.frames for clip in self) // MOST_FRAMES)
                some = torch.cat([tensor_of(clip.positions[::every]) for clip in self])
                skeleton = replace(skeleton, rest=tuple(rest(skeleton, some.double()).flatten().tolist()))

            def turned() -> Iterator[Clip]:
                for clip in self:
                    if not self.skeleton.rest or clip.rotations is None:
                        turns = inverse(skeleton, tensor_of(clip.positions).double(), skeleton.offsets)
                        clip = replace(clip, rotations=continuous(from_matrix(turns, "quaternion")).numpy())
                    yield clip

            found = MotionSet(turned(), skeleton, self.name, skipped=self.skipped, said=self.said, missing=self.missing)
            object.__setattr__(self, "_turned", found)
        return found

    def loosened(self) -> MotionSet:
        """The same positions with a joint more wherever bones that leave from one place move against each other.

        A joint has one turn, and takes all that hangs from it along. Where recordings have left joints out, as a spine
        that bends against the hips right at the pelvis, `with_rotations` can only find turns in between. Here the
        most bones that keep their angles (distances of their ends within a millimetre, in every clip) stay with the
        joint, and each further group of them gets one of its own in the same place, by the name of the first end.

        Raises:
            ValueError: there are rotations already, or joints are missing.
        """
        skeleton = self.skeleton
        if skeleton.rest or self.missing:
            raise ValueError(
                f"{self.name or 'this motion'} has {'rotations' if skeleton.rest else 'missing joints'}; joints are "
                "added where turns are still to be found, of whole poses"
            )
        names, parents, places = list(skeleton.names), list(skeleton.parents), list(range(skeleton.joints))
        for joint in skeleton.order:
            below = [child for parent, child in skeleton.edges if parent == joint]
            if len(below) > 1:
                for group in self._rigid(below)[1:]:
                    for child in group:
                        parents[child] = len(names)
                    names.append(f"{skeleton.names[joint]}-{skeleton.names[group[0]]}")
                    parents.append(joint)
                    places.append(joint)
        loose = replace(skeleton, names=tuple(names), parents=tuple(parents), lengths=())
        clips = [replace(clip, positions=clip.positions[:, places], rotations=None) for clip in self]
        return MotionSet(clips, loose, self.name, copy=False, skipped=self.skipped, said=self.said)

    def _rigid(self, joints: Sequence[int]) -> list[list[int]]:
        """Joints in groups whose distances stay, the largest first."""
        varies = np.zeros((len(joints), len(joints)))
        for clip in self:
            ends = clip.positions[:, joints].astype(np.float64)
            varies = np.maximum(varies, np.linalg.norm(ends[:, :, None] - ends[:, None], axis=-1).std(0))
        groups = nx.connected_components(nx.from_numpy_array(varies < STIFF))
        return sorted(([joints[place] for place in sorted(group)] for group in groups), key=len, reverse=True)

    def resampled(self, fps: float) -> MotionSet:
        """The same motion at another number of frames per second; see `Clip.resampled`.

        Raises:
            ValueError: a number that is none.
        """
        if not 0 < fps < 1e6:
            raise ValueError(f"{fps} frames per second, expected more than 0")
        ratio, skeleton = self.skeleton.fps / fps, replace(self.skeleton, fps=float(fps))
        return replace(self, clips=[clip.resampled(ratio) for clip in self], skeleton=skeleton)

    def divided(self, test: float = 0.2, shortest: int = 1) -> MotionSet:
        """The same motion in splits "train" and "test", for recordings that nobody has divided.

        The last part of every clip is test, where it and the rest have `shortest` frames; where no clip has, whole
        clips are, the last ones. Of one clip alone, what is before is cut once more, so that some of it can be held out
        for validation. A clip of a split other than "all" has this before its own name.

        Args:
            test: the part, of every clip or of the clips.
            shortest: frames that make a window.

        Raises:
            ValueError: no part of the whole.
        """
        if not 0 < test < 1:
            raise ValueError(f"the part for test is {test}, expected more than 0 and less than 1")
        found: list[Clip] = []
        for clip in self:
            name = clip.name if clip.split == "all" else f"{clip.split}-{clip.name}".replace("/", "-")
            clip, held = replace(clip, split="train", name=name), round(test * clip.frames)
            if min(held, clip.frames - held) >= shortest:
                ends = [0, clip.frames - held]
                if len(self) == 1 and ends[1] - held >= shortest:
                    ends.insert(1, ends[1] - held)
                parts = [clip.between(*ends) for ends in pairwise(ends)]
                found += [replace(part, name=f"{name}-{n}" if n else name) for n, part in enumerate(parts)]
                found.append(replace(clip.between(clip.frames - held, clip.frames), split="test"))
            else:
                found.append(clip)
        if len(found) == len(self) > 1:
            held = min(max(round(test * len(self)), 1), len(self) - 1)
            found = [*found[:-held], *(replace(clip, split="test") for clip in found[-held:])]
        return replace(self, clips=found)

    def fingerprint(self) -> str:
        """SHA-256 of the content: skeleton, and every clip's key, shape and bytes, in order."""
        digest = hashlib.sha256(repr((self.skeleton.names, self.skeleton.parents, self.skeleton.up)).encode())
        if any(clip.rotations is not None for clip in self.clips):
            digest.update(repr(self.skeleton.rest).encode())
        for clip in self.clips:
            digest.update(repr((*clip.key, clip.positions.shape)).encode())
            for values in (clip.positions, clip.rotations):
                if values is not None:
                    hash_values(digest, values, "<f4")
        return digest.hexdigest()

    def summary(self) -> list[dict[str, str | int | float]]:
        """One row per split: clips, frames, minutes, shortest and longest clip in frames, clips skipped."""
        skipped = Counter(split for split, _, _ in self.skipped)
        rows: list[dict[str, str | int | float]] = []
        for split in self.splits:
            frames = [clip.frames for clip in self.clips if clip.split == split]
            rows.append(
                {
                    "split": split,
                    "clips": len(frames),
                    "frames": sum(frames),
                    "minutes": round(sum(frames) / self.skeleton.fps / 60, 1),
                    "shortest": min(frames),
                    "longest": max(frames),
                    "skipped": skipped[split],
                }
            )
        return rows

    def info(self) -> RenderableType:
        """What `dvae data info` prints: splits, skeleton, how rigid the bones are, and the labels."""
        splits = Table(title=self.name, title_justify="left")
        rows = self.summary()
        for column in rows[0]:
            splits.add_column(column, justify="left" if column == "split" else "right")
        for row in rows:
            splits.add_row(*(f"{value:,}" if isinstance(value, int) else str(value) for value in row.values()))

        found = (self.skeleton.bone_lengths(some_frames(clip.positions).astype(np.float64)) for clip in self.clips)
        bones = map(np.ma.masked_invalid, found)
        variation = [(b.std(axis=0) / np.maximum(b.mean(axis=0), 1e-9)).filled(0.0) for b in bones]
        worst = int(np.argmax([v.max() for v in variation]))
        bone = self.skeleton.names[self.skeleton.edges[int(np.argmax(variation[worst]))][1]]
        extent = np.median(
            [np.median(extents(some_frames(clip.positions))[:, self.skeleton.vertical]) for clip in self]
        )
        lacking = [
            sum(np.isnan(some).any(axis=2).mean(axis=1).sum() for some in blocks(clip.positions)) / clip.frames
            for clip in self
        ]

        facts = Table.grid(padding=(0, 2))
        fact = facts.add_row
        fact("skeleton", f"{self.skeleton.name}: {self.skeleton.joints} joints, {self.skeleton.up} up")
        fact("frames per second", f"{self.skeleton.fps:g}")
        fact("vertical extent", f"{extent:.2f} m (median)")
        if self.said:
            fact("read as", self.said)
        if sum(clip.rotations is not None for clip in self):
            fact("rotations", "of every joint")
        if any(lacking):
            share = np.average(lacking, weights=[clip.frames for clip in self])
            fact("missing joints", f"{share:.2%} of all frames' joints, in {np.count_nonzero(lacking)} clips")
        fact(
            "bone lengths",
            f"vary by at most {variation[worst].max():.2%} within a clip (sd / mean; {bone} in "
            f"{'/'.join(self.clips[worst].key)})",
        )
        fact("fingerprint", self.fingerprint()[:16])
        for label in dict.fromkeys(name for clip in self.clips for name in clip.labels):
            counts = Counter(clip.labels[label] for clip in self.clips if label in clip.labels)
            if len(counts) <= 24:
                fact(label, ", ".join(f"{value} {count}" for value, count in counts.most_common()))
        for split, name, reason in self.skipped[:10]:
            fact("skipped", f"{split}/{name}: {reason}")
        return Group(splits, facts)
