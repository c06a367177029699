"""Gait cycles: motion cut where legs swing as in one of two references, one for either foot that starts.

Marsot, Wuhrer, Franco and Durocher (2021), arXiv 2106.04387, section 5: the turns of the hips of every subsequence are
compared by dynamic time warping with two reference cycles, and those that cost less than a threshold are kept, if they
last between .3 and 3 seconds. Which cycles, which threshold, and what of subsequences that overlap, it leaves open:

* **References are the most typical cycles of regular walks.** How far the left thigh is bent forward, less the right
  one, repeats itself after a cycle and is its own opposite after half of one: its correlation with itself a cycle
  later, less that half a cycle later, is 2 where all steps are alike. Clips where it comes near are cut from where a
  thigh is furthest forward (just before that foot is put down) to where it is so again; of these cycles the reference
  is the one from which the others are least far. No label is read.
* **A hip's turn is the thigh's against the pelvis**, and how far poses are from each other the root mean square of the
  angles between both of their hips' turns; a subsequence's cost is the mean of it along the path, in radians.
* **Of subsequences that overlap the cheapest is kept**, of either reference for itself: a walk gives cycles of the left
  foot end to end, and those of the right half a cycle later.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, reduce
from itertools import pairwise
from typing import Annotated, Literal, NamedTuple

import numpy as np
import torch

from ...data.sequences import tensor_of
from ...options import Amount, Positive, Range, Share, check
from ..data.clips import Clip, MotionSet
from ..geometry.kinematics import resting
from ..geometry.rotations import continuous, from_matrix, to_matrix
from ..geometry.skeleton import Skeleton, rotate_about_up
from .warping import alignment, subsequence_costs

MOST_CYCLES = 400
"""Of which the most typical is found."""


@dataclass(frozen=True)
class Cycles:
    """What is a gait cycle.

    Args:
        threshold: most that its hips cost, in radians: the mean angle along the path to a reference; and most that its
            last pose is from its first, as half a cycle ends with the other foot in front.
        shortest, longest: seconds that it lasts.
        overlap: share of the shorter of two cycles that start with one foot, that they may share.
        rate: frames a second at which motion is compared.
        swing: least deviation of the angle between the thighs in it, in radians; less is no step, whatever it costs.
        regular: least that a clip for references repeats itself, of 2.
    """

    threshold: Amount = 0.25
    shortest: Positive = 0.3
    longest: Positive = 3.0
    overlap: Annotated[Share, Range(0, 1, below=True)] = 0.1
    rate: Positive = 30.0
    swing: Amount = 0.2
    regular: Annotated[float, Range(0, 2)] = 1.0

    def __post_init__(self) -> None:
        check(self)
        if self.shortest > self.longest:
            raise ValueError(f"cycles last from {self.shortest} to {self.longest} seconds; expected the shorter first")


@dataclass(frozen=True, eq=False)
class Reference:
    """A cycle with which motion is compared.

    Args:
        side: of the foot that starts.
        hips: turns against the pelvis, quaternions (M, 2, 4) of the left and the right hip.
        rate: frames a second.
        source: split and name of the clip that it is from.
    """

    side: Literal["left", "right"]
    hips: np.ndarray = field(repr=False)
    rate: float = 30.0
    source: tuple[str, str] = ("", "")

    @property
    def seconds(self) -> float:
        """That it lasts."""
        return (len(self.hips) - 1) / self.rate


class Found(NamedTuple):
    """A cycle in a clip: of which foot, its first and last frame, and what it costs, in radians."""

    side: str
    first: int
    last: int
    cost: float


def gait_cycles(
    motion: MotionSet, references: Sequence[Reference] | None = None, cycles: Cycles | None = None
) -> MotionSet:
    """The gait cycles of motion, a clip each.

    Args:
        motion: with rotations (`MotionSet.with_rotations`).
        references: with which it is compared; those of `reference_cycles` by default.
        cycles: what is one.

    Returns:
        Clips in the splits of those that they are from, with their labels and `cycle` (left or right, the foot that
        starts), `source` (the name of the clip), `start` (its frame) and `cost` (radians).

    Raises:
        ValueError: there is none, or see `reference_cycles`.
    """
    cycles = cycles or Cycles()
    references = reference_cycles(motion, cycles) if references is None else references
    found = []
    for clip in motion:
        for side, first, last, cost in find_cycles(clip, motion.skeleton, references, cycles):
            beside = {"cycle": side, "source": clip.name, "start": str(first), "cost": f"{cost:.3f}"}
            part = clip.between(first, last + 1)
            found.append(replace(part, name=f"{clip.name}-{side}-{first}", labels={**clip.labels, **beside}))
    if not found:
        raise ValueError(
            f"{motion.name or 'this motion'} has no gait cycle of {cycles.shortest:g} to {cycles.longest:g} s whose "
            f"hips are within {cycles.threshold:g} rad of the references; raise the threshold, if people walk in it"
        )
    return MotionSet(found, motion.skeleton, f"{motion.name} cycles".strip(), copy=False, said=motion.said)


def alike(first: MotionSet, second: MotionSet) -> tuple[MotionSet, MotionSet]:
    """Motion of two sources on the joints that both have, so that who learns from the one can be tested on the other.

    Both get one tree, that of the first without the joints that the second lacks, loosened where bones move against
    each other in either (`MotionSet.loosened`). Each has rotations, found for a rest pose of its own.

    Raises:
        ValueError: what they share is no tree.
    """
    from ..files.reading import chosen

    shared = [name for name in first.skeleton.names if name in second.skeleton.names]
    kept = chosen(first, shared)
    both = kept, chosen(second, onto=replace(kept.skeleton, fps=second.skeleton.fps))
    marked = [
        replace(clip, split=f"{n}{clip.split}", rotations=None) for n, motion in enumerate(both) for clip in motion
    ]
    loose = MotionSet(marked, replace(kept.skeleton, rest=(), lengths=()), copy=False).loosened()
    found = []
    for n, motion in enumerate(both):
        clips = [replace(clip, split=clip.split[1:]) for clip in loose if clip.split[0] == str(n)]
        own = replace(loose.skeleton, fps=motion.skeleton.fps, name=motion.skeleton.name)
        found.append(MotionSet(clips, own, motion.name, copy=False, skipped=motion.skipped, said=motion.said))
    return found[0].with_rotations(), found[1].with_rotations()


def find_cycles(clip: Clip, skeleton: Skeleton, references: Iterable[Reference], cycles: Cycles) -> list[Found]:
    """The gait cycles of a clip, in the order of their first frames.

    Raises:
        ValueError: a clip without rotations, or references of another rate than that of `cycles`.
    """
    compared, ratio = _at_rate(clip, skeleton.fps, cycles.rate)
    turned = _turned(compared, skeleton)
    hips, bent = _hips(turned), _bent(turned, skeleton)
    longest = min(int(cycles.longest * cycles.rate + 1e-6) + 1, len(hips))
    shortest = int(np.ceil(cycles.shortest * cycles.rate - 1e-6)) + 1
    swings = _deviations(bent[:, 0] - bent[:, 1], longest) >= cycles.swing
    possible = swings & (_open(hips, longest) <= cycles.threshold)
    possible[:, : shortest - 1] = False
    found = []
    for reference in references:
        if reference.rate != cycles.rate:
            raise ValueError(f"a reference has {reference.rate:g} frames a second, and cycles {cycles.rate:g}")
        if not possible.any():
            continue  # as in most clips, and costs are what takes long
        costs = subsequence_costs(_apart(reference.hips, hips), longest)
        costs[~possible] = np.inf
        for first, frames in _cheapest(costs, cycles.threshold, cycles.overlap):
            start, end = (min(round(place * ratio), clip.frames - 1) for place in (first, first + frames))
            found.append(Found(reference.side, start, end, float(costs[first, frames])))
    return sorted(found, key=lambda each: (each.first, each.side))


def reference_cycles(motion: MotionSet, cycles: Cycles | None = None) -> tuple[Reference, Reference]:
    """A cycle that starts with the left foot and one that starts with the right, the most typical of regular walks.

    Args:
        motion: with rotations. Clips of the split "train" alone, if there are any.
        cycles: what is one.

    Raises:
        ValueError: nobody walks regularly enough for two cycles.
    """
    cycles = cycles or Cycles()
    walked: tuple[list[tuple[np.ndarray, Clip]], ...] = ([], [])
    best = -np.inf
    for clip in [clip for clip in motion if clip.split == "train"] or motion:
        compared, _ = _at_rate(clip, motion.skeleton.fps, cycles.rate)
        turned = _turned(compared, motion.skeleton)
        bent = _bent(turned, motion.skeleton)
        regular, period = _regularity(bent[:, 0] - bent[:, 1], cycles)
        best = max(best, regular)
        if regular >= cycles.regular:
            hips = _hips(turned)
            for own, angle in zip(walked, bent.T, strict=True):
                own += [(hips[first : last + 1], clip) for first, last in _between_peaks(angle, period)]
    if not all(walked):
        raise ValueError(
            f"in no clip of {motion.name or 'this motion'} legs swing by {cycles.swing:g} rad and more, twice and "
            f"alike (at best {max(best, 0):.2f}, expected {cycles.regular:g} of 2), {cycles.shortest:g} to "
            f"{cycles.longest:g} s each; give references= of motion in which people walk, or lower `regular` or `swing`"
        )
    left, right = (_typical(own) for own in walked)
    return (
        Reference("left", left[0], cycles.rate, left[1].key),
        Reference("right", right[0], cycles.rate, right[1].key),
    )


def stamps(clip: Clip, skeleton: Skeleton, references: Sequence[Reference], frames: int) -> np.ndarray:
    """Where a clip is as the nearest of some cycles is in so many even frames: (frames,) frames of the clip, rising.

    The pace is from half to twice that of the reference brought to the length of the clip.
    """

    def even(hips: np.ndarray) -> np.ndarray:
        at = np.linspace(0, len(hips) - 1, frames)
        values = continuous(torch.from_numpy(hips)).numpy()
        before = np.minimum(at.astype(int), len(hips) - 2)
        part = (at - before)[:, None, None]
        between = (1 - part) * values[before] + part * values[before + 1]
        found: np.ndarray = between / np.linalg.norm(between, axis=-1, keepdims=True)
        return found

    own = even(_hips(_turned(clip, skeleton)))
    warped = [alignment(_apart(even(reference.hips), own)) for reference in references]
    places, _ = min(warped, key=lambda each: each[1])
    return places * ((clip.frames - 1) / (frames - 1))


def _at_rate(clip: Clip, fps: float, rate: float) -> tuple[Clip, float]:
    """A clip at another rate, and how many of its frames one of these is."""
    if clip.rotations is None:
        raise ValueError(f"clip {'/'.join(clip.key)} has no turns of joints; MotionSet.with_rotations() finds them")
    return (clip, 1.0) if fps == rate else (clip.resampled(fps / rate), fps / rate)


@lru_cache(maxsize=8)
def _resting(skeleton: Skeleton) -> torch.Tensor:
    """Joints (J, 3) with nothing turned, and the root at 0."""
    return resting(skeleton.parents, skeleton.offsets)


@lru_cache(maxsize=8)
def _legs(skeleton: Skeleton) -> list[list[int]]:
    """For either side the joints from below the root down to the hip, and to the knee: of those where left and right
    leave the trunk, the lowest at rest."""
    rest, legs = _resting(skeleton), []
    for leaving in skeleton.sides:
        hip = min(leaving, key=lambda joint: float(rest[joint, skeleton.vertical]))
        below = [child for parent, child in skeleton.edges if parent == hip]
        while below and hip in skeleton.left + skeleton.right and float(skeleton.offsets[below[0]].norm()) == 0:
            hip, below = below[0], [child for parent, child in skeleton.edges if parent == below[0]]
        if not below:
            raise ValueError(
                f"skeleton {skeleton.name!r} has no joint below {skeleton.names[hip]}, so nobody sees legs swing"
            )
        path = [below[0], hip]
        while (above := skeleton.parents[path[-1]]) not in (skeleton.root, -1):
            path.append(above)
        legs.append(path[::-1])
    return legs


def _turned(clip: Clip, skeleton: Skeleton) -> torch.Tensor:
    """Of both thighs against the pelvis, (F, 2, 3, 3)."""
    found = []
    for *hips, _ in _legs(skeleton):
        turns = to_matrix(tensor_of(clip.rotations)[:, hips].double(), "quaternion")
        found.append(reduce(torch.matmul, turns.unbind(1)))
    return torch.stack(found, 1)


def _hips(turned: torch.Tensor) -> np.ndarray:
    """The same as quaternions (F, 2, 4)."""
    found: np.ndarray = from_matrix(turned, "quaternion").numpy()
    return found


def _bent(turned: torch.Tensor, skeleton: Skeleton) -> np.ndarray:
    """How far the left and the right thigh are bent forward in the pelvis, (F, 2) in radians."""
    up = torch.eye(3, dtype=torch.float64)[skeleton.vertical]
    ahead = torch.tensor([0.0, 0.0, 1.0] if skeleton.up == "y" else [0.0, -1.0, 0.0], dtype=torch.float64)
    ahead = rotate_about_up(ahead, skeleton.heading(_resting(skeleton)), skeleton.up)
    knees = skeleton.offsets[[leg[-1] for leg in _legs(skeleton)]]
    thighs = (turned @ knees[..., None]).squeeze(-1)
    found: np.ndarray = torch.atan2(thighs @ ahead, -thighs @ up).numpy()
    return found


def _apart(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(M, F) root mean square over both hips of the angles between quaternions (M, 2, 4) and (F, 2, 4), in radians."""
    cosine = np.abs(np.einsum("mhq,fhq->hmf", first, second)).clip(max=1)
    found: np.ndarray = np.sqrt(np.square(2 * np.arccos(cosine)).mean(0))
    return found


def _regularity(swing: np.ndarray, cycles: Cycles) -> tuple[float, int]:
    """How much an angle (F,) repeats itself after some frames and is its opposite after half of them, and how many."""
    swing = swing - swing.mean()
    least = max(2, round(cycles.shortest * cycles.rate))
    lags = np.arange(least, min(int(cycles.longest * cycles.rate), (len(swing) - 1) // 2) + 1)
    if not len(lags) or swing.std() < cycles.swing:
        return -np.inf, 0
    some = np.arange(lags[-1] + 1)
    pairs = [(swing[: len(swing) - lag], swing[lag:]) for lag in some]
    alike = np.array([(a @ b) / max(np.sqrt((a @ a) * (b @ b)), 1e-12) for a, b in pairs])
    scores = alike[lags] - np.interp(lags / 2, some, alike)
    return float(scores.max()), int(lags[scores.argmax()])


def _between_peaks(angle: np.ndarray, period: int) -> list[tuple[int, int]]:
    """First and last frames of the cycles of a leg, from where it (F,) is furthest forward to where it is so again."""
    window = np.hanning(max(period // 4, 1) + 2)
    padded = np.pad(angle, (len(window) // 2, (len(window) - 1) // 2), mode="edge")
    smooth, half = np.convolve(padded, window / window.sum(), mode="valid"), period // 2
    tops = [t for t in range(1, len(smooth) - 1) if smooth[t] == smooth[max(t - half, 0) : t + half + 1].max()]
    return [(a, b) for a, b in pairwise(tops) if abs(b - a - period) <= max(period // 8, 1)]


def _typical(cycles: Sequence[tuple[np.ndarray, Clip]]) -> tuple[np.ndarray, Clip]:
    """Of cycles the one from which the others are least far on average, each at the same share of itself."""
    some = cycles[:: -(-len(cycles) // MOST_CYCLES)]
    share = np.linspace(0, 1, 25)
    seen = np.stack([hips[np.rint(share * (len(hips) - 1)).astype(int)] for hips, _ in some])
    cosine = np.abs(np.einsum("athq,bthq->abth", seen, seen)).clip(max=1)
    far = 2 * np.sqrt(np.square(np.arccos(cosine)).mean(-1)).mean(-1).mean(-1)
    return some[int(np.argmin(far))]


def _deviations(angle: np.ndarray, longest: int) -> np.ndarray:
    """(F, K) standard deviations of an angle (F,) over k + 1 frames from s on; 0 where it ends before."""
    frames = np.arange(len(angle))[:, None] + np.arange(longest + 1)
    sums, squares = (np.pad(np.cumsum(values), (1, longest), mode="edge") for values in (angle, angle**2))
    many = np.arange(1, longest + 1)
    mean, square = ((each[frames[:, 1:]] - each[frames[:, :1]]) / many for each in (sums, squares))
    inside = frames[:, :-1] < len(angle)
    return np.where(inside, np.sqrt(np.maximum(square - mean**2, 0)), 0.0)


def _open(hips: np.ndarray, longest: int) -> np.ndarray:
    """(F, K) how far the last pose of k + 1 from frame s on is from the first; of those that end before, anything."""
    padded = np.concatenate([hips, np.repeat(hips[-1:], longest - 1, axis=0)])
    later = np.lib.stride_tricks.sliding_window_view(padded, longest, axis=0)  # (F, 2, 4, K)
    cosine = np.abs(np.einsum("fhq,fhqk->hfk", hips, later)).clip(max=1)
    found: np.ndarray = np.sqrt(np.square(2 * np.arccos(cosine)).mean(0))
    return found


def _cheapest(costs: np.ndarray, threshold: float, overlap: float) -> list[tuple[int, int]]:
    """Starts and lengths of subsequences [s, k] below a threshold, the cheapest first, that overlap no more than so."""
    starts, lengths = np.nonzero(costs <= threshold)
    order = np.argsort(costs[starts, lengths], kind="stable")
    starts, lengths = starts[order], lengths[order]
    found = []
    while len(starts):
        first, frames = int(starts[0]), int(lengths[0])
        found.append((first, frames))
        shared = np.minimum(starts + lengths, first + frames) - np.maximum(starts, first)
        free = shared <= overlap * np.minimum(lengths, frames)
        starts, lengths = starts[free], lengths[free]
    return found
