"""Motion clips and sets of clips, validated when they are created.

A clip is (frames, joints, 3) float32 in metres. Two splits may contain clips of the same name (the CMU benchmark has a
`walking_1` in both), so the key of a clip is (split, name).
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
from ...inference.evaluation.result import Table  # does not interpret markup in file contents
from ..geometry.kinematics import inverse, rest
from ..geometry.rotations import continuous, from_matrix
from ..geometry.skeleton import Skeleton

SMALLEST, TALLEST = 0.3, 3.0
"""Range of plausible body extents in metres: wide enough for a child, too narrow for another unit."""


MOST_FRAMES = 20_000
"""Maximum number of frames used to estimate a rest pose or the size of a body."""

STIFF = 1e-3
"""Standard deviation in metres below which the distance of two joints in a clip counts as constant."""


@dataclass(frozen=True, eq=False)
class Clip:
    """One recording.

    Args:
        split: split in the archive: "train", "test", or a subject.
        name: name, unique within the split.
        positions: (F, J, 3) in metres, global; NaN where a joint was not observed.
        labels: text labels, from name to value.
        truth: true values of a simulator's variables, as arrays; empty for real clips.
        rotations: (F, J, 4), rotation of each joint relative to its parent, as quaternions w x y z; from the file or
            from `MotionSet.with_rotations`. The rotation of a joint without children is not observable.
    """

    split: str
    name: str
    positions: np.ndarray
    labels: Mapping[str, str] = field(default_factory=dict)
    truth: Mapping[str, np.ndarray] = field(default_factory=dict)
    rotations: np.ndarray | None = None

    @override
    def __repr__(self) -> str:
        suffix = "" if self.rotations is None else ", with rotations"
        return f"Clip({self.split}/{self.name}: {self.frames} frames of {self.positions.shape[1]} joints{suffix})"

    @property
    def key(self) -> tuple[str, str]:
        """(split, name)."""
        return self.split, self.name

    @property
    def frames(self) -> int:
        """Number of frames F."""
        return len(self.positions)

    def between(self, start: int, end: int) -> Clip:
        """Return the clip of the frames from `start` (inclusive) to `end` (exclusive).

        Args:
            start: first frame, from 0.
            end: frame after the last one.
        """
        rotations = None if self.rotations is None else self.rotations[start:end]
        truth = {k: v[start:end] if v.shape[:1] == (self.frames,) else v for k, v in self.truth.items()}
        return replace(self, positions=self.positions[start:end], rotations=rotations, truth=truth)

    def resample(self, ratio: float) -> Clip:
        """Return the clip with one frame for every `ratio` frames; `ratio` may be fractional.

        A whole ratio keeps every `ratio`-th frame. Otherwise, positions are interpolated linearly and rotations along
        the shortest arc. Simulator variables (`truth`) are dropped.

        Args:
            ratio: number of present frames per new frame; may be fractional.
        """
        if abs(ratio - round(ratio)) < 1e-6 and ratio >= 1:
            step = round(ratio)
            rotations = None if self.rotations is None else self.rotations[::step]
            return replace(self, positions=self.positions[::step], rotations=rotations, truth={})
        times = np.arange(int((self.frames - 1) / ratio + 1e-6) + 1) * ratio
        before = np.minimum(times.astype(int), max(self.frames - 2, 0))
        after = np.minimum(before + 1, self.frames - 1)
        part = (times - before)[:, None, None]
        first, second = np.where(part < 1, self.positions[before], 0), np.where(part > 0, self.positions[after], 0)
        positions = (1 - part) * first + part * second  # a frame of weight 0 may be missing
        rotations = self.rotations
        if rotations is not None:
            rotations = _interpolate_quaternions(rotations[before], rotations[after], part)
        return replace(self, positions=positions.astype(self.positions.dtype), rotations=rotations, truth={})


def _interpolate_quaternions(first: np.ndarray, second: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Interpolate quaternions (..., 4) along the shortest arc (Shoemake 1985)."""
    cosine = (first * second).sum(-1, keepdims=True)
    second, cosine = np.where(cosine < 0, -second, second), np.abs(cosine).clip(max=1)
    angle = np.maximum(np.arccos(cosine), 1e-6)  # below this, sines and angles agree
    quaternions = (np.sin((1 - part) * angle) * first + np.sin(part * angle) * second) / np.sin(angle)
    return np.asarray(quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True), first.dtype)


def defect(clip: Clip, skeleton: Skeleton, missing: bool = False) -> str | None:
    """Return one sentence on why the skeleton cannot use a clip, or None if it can.

    Args:
        clip: clip.
        skeleton: skeleton that the clip should match.
        missing: whether joints may be NaN in some frames.
    """
    label, positions = f"clip {clip.split}/{clip.name}", clip.positions
    if positions.dtype.kind not in "fiu":
        return f"{label} has dtype {positions.dtype}, expected numbers"
    if positions.ndim != 3 or positions.shape[2] != 3:
        return f"{label} has shape {positions.shape}, expected (frames, joints, 3)"
    if positions.shape[1] != skeleton.joints:
        return f"{label} has {positions.shape[1]} joints, but the skeleton {skeleton.name!r} has {skeleton.joints}"
    if not len(positions):
        return f"{label} has no frames"
    count = frames = 0
    first, any_observed = (0, 0), False
    for rows in ranges(positions):
        with np.errstate(over="ignore"):
            values = positions[rows].astype(np.float32, copy=False)
        is_missing = ~np.isfinite(values).all(axis=2)
        any_observed |= not is_missing.all()
        is_invalid = np.asarray(np.isinf(values).any(axis=2) if missing else is_missing)
        if is_invalid.any():
            frame, joint = np.argwhere(is_invalid)[0]
            first = first if count else (rows.start + frame, joint)
            count, frames = count + is_invalid.sum(), frames + is_invalid.any(axis=1).sum()
    if count:
        kind = "infinite" if missing else "NaN or infinite"
        can_keep = not missing and not defect(clip, skeleton, missing=True)
        hint = "; missing=True (--missing) keeps the clip, with these joints missing" if can_keep else ""
        return (
            f"{label} has {kind} positions, or positions beyond float32: {count} joint positions in "
            f"{frames} of {clip.frames} frames, first {skeleton.names[first[1]]} at frame {first[0]}{hint}"
        )
    if not any_observed:
        return f"{label} has no joint that is observed in any of its {clip.frames} frames"
    if clip.rotations is not None:
        if clip.rotations.shape != (*positions.shape[:2], 4) or clip.rotations.dtype.kind != "f":
            return f"{label} has rotations {clip.rotations.shape}, expected quaternions {(*positions.shape[:2], 4)}"
        if not all((np.abs(np.square(values).sum(-1) - 1) < 1e-3).all() for values in blocks(clip.rotations)):
            return f"{label} has rotations that are not unit quaternions"
    extent = float(np.median(extents(some_frames(positions)).max(axis=1)))
    if not SMALLEST <= extent <= TALLEST:
        unit = "millimetres" if extent >= 300 else "centimetres" if extent >= 30 else "another unit"
        return (
            f"{label} shows a person of {extent:.4g} m (median over frames of the body's largest extent, "
            f"expected {SMALLEST} to {TALLEST} m): it looks like {unit}; convert the positions to "
            "metres, or give the unit of the file (`metres=`, `--metres`, `--units`)"
        )
    return None


def some_frames(positions: np.ndarray) -> np.ndarray:
    """Return at most `MOST_FRAMES` evenly spaced frames of (F, J, 3).

    If every one of these frames has missing joints, return all frames.
    """
    selected = positions[:: -(-len(positions) // MOST_FRAMES)]
    return positions if np.isnan(selected).any(axis=2).all() else selected


def extents(positions: np.ndarray) -> np.ndarray:
    """Return the body's extents (frames, 3) along the axes in the frames of (F, J, 3) with the most observed joints."""
    poses = fullest(positions)
    extent: np.ndarray = np.nanmax(poses, axis=1) - np.nanmin(poses, axis=1).astype(np.float64)
    return extent


def fullest(positions: np.ndarray) -> np.ndarray:
    """Return the frames of (F, J, 3) that have the most observed joints."""
    counts = (~np.isnan(positions).any(axis=2)).sum(axis=1)
    is_full: np.ndarray = counts == counts.max()
    return positions if is_full.all() else positions[is_full]  # copy only if frames were dropped


def _as_float32(values: np.ndarray, copy: bool = True) -> np.ndarray:
    """Return values as float32 in C order.

    The result shares memory with `values` only if `copy` is False, or if the array is memory-mapped.
    """
    if is_mapped(values) and values.dtype == np.float32 and values.flags.c_contiguous:
        return values
    array = np.require(values, np.float32, ["C", "A", "W"])
    return array.copy() if copy and np.may_share_memory(array, values) else array


@dataclass(init=False, frozen=True, eq=False)
class MotionSet:
    """Clips of one skeleton.

    Iteration yields the clips. `motion["train", "walking_1"]` returns the clip with this split and name.

    Args:
        clips: clips, iterated once; copied as float32, except for memory-mapped float32 arrays.
        skeleton: skeleton of all clips.
        name: name of the set.
        copy: whether to copy float32 arrays; if False, the caller must no longer use them.
        skip_bad: leave out unusable clips, and list them in `skipped`.
        skipped: clips that were left out earlier, as (split, name, reason).
        interpretation: description of the units and axes that were assumed for the files, for the user to check.
        missing: whether joints may be missing (NaN). A joint with one NaN coordinate counts as missing. Batches of
            windows then contain a mask of observed values.

    Raises:
        ValueError: a clip has NaN although `missing` is not set, wrong joints, a wrong shape or implausible units; two
            clips have the same key; or `clips` is empty.
    """

    clips: Sequence[Clip]
    skeleton: Skeleton
    name: str
    skipped: Sequence[tuple[str, str, str]]
    interpretation: str
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
        interpretation: str = "",
        missing: bool = False,
    ) -> None:
        usable, left_out, label = [], list(skipped), name or "motion set"
        for clip in clips:  # lets an iterator free each clip after it was taken over
            if reason := defect(clip, skeleton, missing):
                if not skip_bad:
                    raise ValueError(f"{label}: {reason}")
                left_out.append((*clip.key, reason))
                del clip
                continue
            positions = _as_float32(clip.positions, copy)
            if missing and any((np.isnan(block).sum(axis=2) % 3).any() for block in blocks(positions)):
                positions = positions.copy() if is_mapped(positions) else positions
                positions[np.isnan(positions).any(axis=2)] = np.nan
            rotations = None if clip.rotations is None else _as_float32(clip.rotations)
            usable.append(Clip(clip.split, clip.name, positions, clip.labels, clip.truth, rotations))
            del clip, positions
        if not usable:
            dropped = f"; {len(left_out)} were skipped, the first: {left_out[0][2]}" if left_out else ""
            raise ValueError(f"{label}: no clips{dropped}")
        repeated = [key for key, count in Counter(clip.key for clip in usable).items() if count > 1]
        if repeated:
            raise ValueError(f"{label}: clip {'/'.join(repeated[0])} occurs twice; each split and name must be unique")
        fields = {"clips": tuple(usable), "skeleton": skeleton, "name": name, "skipped": tuple(left_out)}
        vars(self).update(
            fields, interpretation=interpretation, missing=missing, _index={clip.key: clip for clip in usable}
        )

    @override
    def __repr__(self) -> str:
        frames, skeleton = sum(clip.frames for clip in self), self.skeleton
        contents = f"{len(self)} clips, {frames} frames of {skeleton.joints} joints at {skeleton.fps:g} a second"
        return f"MotionSet({self.name or 'no name'}: {contents})"

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
        """Names of the splits, in order of appearance."""
        return list(dict.fromkeys(clip.split for clip in self.clips))

    def with_rotations(self) -> MotionSet:
        """Return the same motion with joint rotations and a rest pose.

        Rotations from files are kept. Other rotations are estimated by `kinematics.inverse`, which assumes that every
        bone has its mean length over all clips. Positions do not change.

        Raises:
            ValueError: rotations must be estimated for a clip with missing joints.
        """
        if self.skeleton.rest and all(clip.rotations is not None for clip in self):
            return self
        if incomplete := [clip for clip in self if clip.rotations is None and np.isnan(clip.positions).any()]:
            raise ValueError(
                f"clip {'/'.join(incomplete[0].key)} has missing joints, so rotations cannot be computed; leave the "
                "clip out, or fill in the missing joints first (`dvae impute RUN --filled FILE`)"
            )
        result: MotionSet | None = self.__dict__.get("_with_rotations")
        if result is None:  # cached, because all splits use it
            skeleton = self.skeleton
            if not skeleton.rest:
                step = -(-sum(clip.frames for clip in self) // MOST_FRAMES)
                poses = torch.cat([tensor_of(clip.positions[::step]) for clip in self])
                skeleton = replace(skeleton, rest=tuple(rest(skeleton, poses.double()).flatten().tolist()))

            def rotated_clips() -> Iterator[Clip]:
                for clip in self:
                    if not self.skeleton.rest or clip.rotations is None:
                        rotations = inverse(skeleton, tensor_of(clip.positions).double(), skeleton.offsets)
                        clip = replace(clip, rotations=continuous(from_matrix(rotations, "quaternion")).numpy())
                    yield clip

            result = MotionSet(
                rotated_clips(),
                skeleton,
                self.name,
                skipped=self.skipped,
                interpretation=self.interpretation,
                missing=self.missing,
            )
            object.__setattr__(self, "_with_rotations", result)
        return result

    def with_extra_joints(self) -> MotionSet:
        """Return the same positions with extra joints where bones that share a joint move relative to each other.

        A joint has one rotation, which moves all its children together. Recordings may omit joints, for example where
        the spine bends against the hips at the pelvis. No rotation then fits all children of the joint, and
        `with_rotations` returns the nearest fit. This method groups the children of a joint by rigidity: the distances
        within a group vary by less than a millimetre in every clip. The largest group stays with the joint. Each other
        group gets a new joint at the same place, named after its first child.

        Raises:
            ValueError: the motion already has rotations, or joints are missing.
        """
        skeleton = self.skeleton
        if skeleton.rest or self.missing:
            raise ValueError(
                f"{self.name or 'this motion'} has {'rotations' if skeleton.rest else 'missing joints'}; joints can "
                "only be added to complete poses, before their rotations are computed"
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
        return MotionSet(clips, loose, self.name, copy=False, skipped=self.skipped, interpretation=self.interpretation)

    def _rigid(self, joints: Sequence[int]) -> list[list[int]]:
        """Group joints whose mutual distances are constant, the largest group first."""
        varies = np.zeros((len(joints), len(joints)))
        for clip in self:
            ends = clip.positions[:, joints].astype(np.float64)
            varies = np.maximum(varies, np.linalg.norm(ends[:, :, None] - ends[:, None], axis=-1).std(0))
        groups = nx.connected_components(nx.from_numpy_array(varies < STIFF))
        return sorted(([joints[index] for index in sorted(group)] for group in groups), key=len, reverse=True)

    def resample(self, fps: float) -> MotionSet:
        """Return the same motion at another frame rate, as `Clip.resample` does.

        Args:
            fps: new frame rate, in frames per second.

        Raises:
            ValueError: `fps` is not positive.
        """
        if not 0 < fps < 1e6:
            raise ValueError(f"`fps` must be above 0 and below 1e6 frames per second, got {fps}")
        ratio, skeleton = self.skeleton.fps / fps, replace(self.skeleton, fps=float(fps))
        return replace(self, clips=[clip.resample(ratio) for clip in self], skeleton=skeleton)

    def assign_splits(self, test: float = 0.2, shortest: int = 1) -> MotionSet:
        """Return the same motion in the splits "train" and "test", for recordings without splits.

        The last part of every clip becomes a test clip if both parts have at least `shortest` frames. If no clip is
        long enough to be cut, the last clips of the set become test clips. If there is only one clip, its training part
        is cut into two clips, so that one of them is available for validation. A split other than "all" becomes a
        prefix of the clip's name.

        Args:
            test: fraction of the frames of every clip, or of the clips, that is used for testing.
            shortest: minimum number of frames of each part, usually the length of a window.

        Raises:
            ValueError: `test` is not between 0 and 1.
        """
        if not 0 < test < 1:
            raise ValueError(f"`test` must be a fraction above 0 and below 1, got {test}")
        clips: list[Clip] = []
        for clip in self:
            name = clip.name if clip.split == "all" else f"{clip.split}-{clip.name}".replace("/", "-")
            clip, n_test = replace(clip, split="train", name=name), round(test * clip.frames)
            if min(n_test, clip.frames - n_test) >= shortest:
                ends = [0, clip.frames - n_test]
                if len(self) == 1 and ends[1] - n_test >= shortest:
                    ends.insert(1, ends[1] - n_test)
                parts = [clip.between(*ends) for ends in pairwise(ends)]
                clips += [replace(part, name=f"{name}-{n}" if n else name) for n, part in enumerate(parts)]
                clips.append(replace(clip.between(clip.frames - n_test, clip.frames), split="test"))
            else:
                clips.append(clip)
        if len(clips) == len(self) > 1:
            n_test = min(max(round(test * len(self)), 1), len(self) - 1)
            clips = [*clips[:-n_test], *(replace(clip, split="test") for clip in clips[-n_test:])]
        return replace(self, clips=clips)

    def fingerprint(self) -> str:
        """Return the SHA-256 of the skeleton and of every clip's key, shape and bytes, in order."""
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
        """Return one row per split: clips, frames, minutes, shortest and longest clip in frames, clips skipped."""
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
        """Return the output of `dvae data info`: splits, skeleton, variation of bone lengths, and labels."""
        splits = Table(title=self.name, title_justify="left")
        rows = self.summary()
        for column in rows[0]:
            splits.add_column(column, justify="left" if column == "split" else "right")
        for row in rows:
            splits.add_row(*(f"{value:,}" if isinstance(value, int) else str(value) for value in row.values()))

        lengths = (self.skeleton.bone_lengths(some_frames(clip.positions).astype(np.float64)) for clip in self.clips)
        bones = map(np.ma.masked_invalid, lengths)
        variation = [(b.std(axis=0) / np.maximum(b.mean(axis=0), 1e-9)).filled(0.0) for b in bones]
        worst = int(np.argmax([v.max() for v in variation]))
        bone = self.skeleton.names[self.skeleton.edges[int(np.argmax(variation[worst]))][1]]
        extent = np.median(
            [np.median(extents(some_frames(clip.positions))[:, self.skeleton.vertical]) for clip in self]
        )
        missing_joints = [
            sum(np.isnan(block).any(axis=2).mean(axis=1).sum() for block in blocks(clip.positions)) / clip.frames
            for clip in self
        ]

        facts = Table.grid(padding=(0, 2))
        fact = facts.add_row
        fact("skeleton", f"{self.skeleton.name}: {self.skeleton.joints} joints, {self.skeleton.up} up")
        fact("frames per second", f"{self.skeleton.fps:g}")
        fact("vertical extent", f"{extent:.2f} m (median)")
        if self.interpretation:
            fact("read as", self.interpretation)
        if sum(clip.rotations is not None for clip in self):
            fact("rotations", "of every joint")
        if any(missing_joints):
            share = np.average(missing_joints, weights=[clip.frames for clip in self])
            fact("missing joints", f"{share:.2%} of all frames' joints, in {np.count_nonzero(missing_joints)} clips")
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
