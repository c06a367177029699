"""Gait cycles: cut motion where the legs swing as in one of two references, one per starting foot.

Marsot, Wuhrer, Franco and Durocher (2021), arXiv 2106.04387, section 5: the hip rotations of every subsequence are
compared with two reference cycles by dynamic time warping. Subsequences that cost less than a threshold are kept, if
they last between .3 and 3 seconds. The paper does not specify the references, the threshold, or the treatment of
overlapping subsequences. Our choices:

* **References are the most typical cycles of regular walks.** The signal is the forward angle of the left thigh minus
  the angle of the right one. It repeats after a cycle and changes its sign after half a cycle. Its autocorrelation at a
  cycle minus its autocorrelation at half a cycle is therefore 2 if all steps are equal. Clips near this value are cut
  between the times where a thigh is furthest forward (just before the foot is put down). The reference is the cycle
  with the smallest mean distance from the others. Labels are not used.
* **The rotation of a hip is the rotation of the thigh relative to the pelvis.** The distance of two poses is the root
  mean square angle between the rotations of both hips. The cost of a subsequence is the mean distance along its warping
  path to the reference, in radians.
* **Of overlapping subsequences, the cheapest is kept**, separately for each reference: a walk is cut into consecutive
  cycles of the left foot, and into cycles of the right foot half a cycle later.
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
"""Maximum number of cycles among which the most typical one is chosen."""


@dataclass(frozen=True)
class Cycles:
    """Definition of a gait cycle.

    Args:
        threshold: maximum mean angle in radians between the hip rotations of a cycle and of the reference, after time
            warping. It also bounds the distance between first and last pose. This excludes half cycles, which end with
            the other foot in front.
        shortest, longest: minimum and maximum duration in seconds.
        overlap: maximum overlap of two cycles with the same starting foot, as a fraction of the shorter one.
        rate: frames per second of the comparison.
        swing: minimum standard deviation of the angle between the thighs in radians; motion below it is no gait.
        regular: minimum regularity of a clip that provides references, from 0 to 2 (periodic). Regularity is the
            autocorrelation of the angle between the thighs at a lag of one cycle, minus the autocorrelation at half a
            cycle.

    Raises:
        ValueError: an option is out of range, or `shortest` exceeds `longest`.
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
            raise ValueError(f"`shortest` must be at most `longest` ({self.longest} seconds), got {self.shortest}")


@dataclass(frozen=True, eq=False)
class Reference:
    """A reference cycle for comparison with motion.

    Args:
        side: side of the starting foot.
        hips: (M, 2, 4), rotations of the left and the right thigh relative to the pelvis, as quaternions.
        rate: frames per second.
        source: split and name of the clip that contains the cycle.
    """

    side: Literal["left", "right"]
    hips: np.ndarray = field(repr=False)
    rate: float = 30.0
    source: tuple[str, str] = ("", "")

    @property
    def seconds(self) -> float:
        """Duration in seconds."""
        return (len(self.hips) - 1) / self.rate


class FoundCycle(NamedTuple):
    """A cycle in a clip: its starting foot, its first and last frame, and its cost in radians."""

    side: str
    first: int
    last: int
    cost: float


def gait_cycles(
    motion: MotionSet, references: Sequence[Reference] | None = None, cycles: Cycles | None = None
) -> MotionSet:
    """Return the gait cycles of motion, each as a clip.

    Args:
        motion: clips with rotations (`MotionSet.with_rotations`).
        references: reference cycles; default: the result of `reference_cycles`.
        cycles: definition of a cycle.

    Returns:
        Clips in the splits of their source clips. They have the labels of their source clips, and the labels `cycle`
        (starting foot, left or right), `source` (name of the source clip), `start` (first frame in it) and `cost` (in
        radians).

    Raises:
        ValueError: no cycles were found, or `reference_cycles` raises it.
    """
    cycles = cycles or Cycles()
    references = reference_cycles(motion, cycles) if references is None else references
    clips = []
    for clip in motion:
        for side, first, last, cost in find_cycles(clip, motion.skeleton, references, cycles):
            labels = {"cycle": side, "source": clip.name, "start": str(first), "cost": f"{cost:.3f}"}
            part = clip.between(first, last + 1)
            clips.append(replace(part, name=f"{clip.name}-{side}-{first}", labels={**clip.labels, **labels}))
    if not clips:
        raise ValueError(
            f"{motion.name or 'this motion'} has no gait cycle of {cycles.shortest:g} to {cycles.longest:g} s whose "
            f"hips are within {cycles.threshold:g} rad of the references; if people walk in it, raise `threshold`"
        )
    return MotionSet(
        clips, motion.skeleton, f"{motion.name} cycles".strip(), copy=False, interpretation=motion.interpretation
    )


def on_common_joints(first: MotionSet, second: MotionSet) -> tuple[MotionSet, MotionSet]:
    """Return the motion of two sources on their common joints, to train on one and test on the other.

    Both results have the same joint tree: the tree of the first source without the joints that the second does not
    have. `MotionSet.with_extra_joints` adds joints where bones move relative to each other in either source.

    Args:
        first, second: motion with some joint names in common.

    Returns:
        The motion of both sources, each with rotations that are estimated for its own rest pose.

    Raises:
        ValueError: the common joints do not form a tree.
    """
    from ..files.reading import select_joints

    shared = [name for name in first.skeleton.names if name in second.skeleton.names]
    selected = select_joints(first, shared)
    both = selected, select_joints(second, onto=replace(selected.skeleton, fps=second.skeleton.fps))
    marked = [
        replace(clip, split=f"{n}{clip.split}", rotations=None) for n, motion in enumerate(both) for clip in motion
    ]
    loose = MotionSet(marked, replace(selected.skeleton, rest=(), lengths=()), copy=False).with_extra_joints()
    motions = []
    for n, motion in enumerate(both):
        clips = [replace(clip, split=clip.split[1:]) for clip in loose if clip.split[0] == str(n)]
        skeleton = replace(loose.skeleton, fps=motion.skeleton.fps, name=motion.skeleton.name)
        motions.append(
            MotionSet(
                clips, skeleton, motion.name, copy=False, skipped=motion.skipped, interpretation=motion.interpretation
            )
        )
    return motions[0].with_rotations(), motions[1].with_rotations()


def find_cycles(clip: Clip, skeleton: Skeleton, references: Iterable[Reference], cycles: Cycles) -> list[FoundCycle]:
    """Return the gait cycles of a clip, ordered by their first frames.

    Args:
        clip: clip with rotations.
        skeleton: skeleton of the clip.
        references: reference cycles, e.g. from `reference_cycles`.
        cycles: definition of a cycle.

    Raises:
        ValueError: the clip has no rotations, or the rate of a reference differs from `cycles.rate`.
    """
    compared, ratio = _at_rate(clip, skeleton.fps, cycles.rate)
    thighs = _thigh_rotations(compared, skeleton)
    hips, angles = _hip_quaternions(thighs), _thigh_angles(thighs, skeleton)
    longest = min(int(cycles.longest * cycles.rate + 1e-6) + 1, len(hips))
    shortest = int(np.ceil(cycles.shortest * cycles.rate - 1e-6)) + 1
    swings = _deviations(angles[:, 0] - angles[:, 1], longest) >= cycles.swing
    possible = swings & (_end_distances(hips, longest) <= cycles.threshold)
    possible[:, : shortest - 1] = False
    found_cycles = []
    for reference in references:
        if reference.rate != cycles.rate:
            raise ValueError(
                f"a reference has {reference.rate:g} frames a second, but `cycles` compares at {cycles.rate:g}; "
                "compute references with reference_cycles(motion, cycles)"
            )
        if not possible.any():
            continue  # true for most clips; skips the expensive costs
        costs = subsequence_costs(_distances(reference.hips, hips), longest)
        costs[~possible] = np.inf
        for first, frames in _select_cheapest(costs, cycles.threshold, cycles.overlap):
            start, end = (min(round(frame * ratio), clip.frames - 1) for frame in (first, first + frames))
            found_cycles.append(FoundCycle(reference.side, start, end, float(costs[first, frames])))
    return sorted(found_cycles, key=lambda each: (each.first, each.side))


def reference_cycles(motion: MotionSet, cycles: Cycles | None = None) -> tuple[Reference, Reference]:
    """Return the most typical cycles of regular walks, one that starts with the left foot and one with the right.

    Args:
        motion: clips with rotations. If there is a split "train", only its clips are used.
        cycles: definition of a cycle.

    Raises:
        ValueError: no walk is regular enough for two cycles.
    """
    cycles = cycles or Cycles()
    candidates: tuple[list[tuple[np.ndarray, Clip]], ...] = ([], [])
    most_regular = -np.inf
    for clip in [clip for clip in motion if clip.split == "train"] or motion:
        compared, _ = _at_rate(clip, motion.skeleton.fps, cycles.rate)
        thighs = _thigh_rotations(compared, motion.skeleton)
        angles = _thigh_angles(thighs, motion.skeleton)
        regular, period = _regularity(angles[:, 0] - angles[:, 1], cycles)
        most_regular = max(most_regular, regular)
        if regular >= cycles.regular:
            hips = _hip_quaternions(thighs)
            for cycles_of_side, angle in zip(candidates, angles.T, strict=True):
                cycles_of_side += [(hips[first : last + 1], clip) for first, last in _between_peaks(angle, period)]
    if not all(candidates):
        raise ValueError(
            f"no clip of {motion.name or 'this motion'} is a regular walk, with thighs that swing by at least "
            f"{cycles.swing:g} rad, a period of {cycles.shortest:g} to {cycles.longest:g} s and a regularity from "
            f"{cycles.regular:g} (best: {max(most_regular, 0):.2f}); give references= of walking people, or lower "
            "`regular` or `swing`"
        )
    left, right = (_most_typical(cycles_of_side) for cycles_of_side in candidates)
    return (
        Reference("left", left[0], cycles.rate, left[1].key),
        Reference("right", right[0], cycles.rate, right[1].key),
    )


def stamps(clip: Clip, skeleton: Skeleton, references: Sequence[Reference], frames: int) -> np.ndarray:
    """Return the increasing frame numbers (frames,) of a clip that are aligned with even frames of a reference.

    Clip and references are resampled to `frames` evenly spaced frames. The pace on the path is then from half to twice
    the pace of the reference.

    Args:
        clip: clip with rotations.
        skeleton: skeleton of the clip.
        references: reference cycles; the one with the smallest cost is used.
        frames: number of frames of the result.
    """

    def even(hips: np.ndarray) -> np.ndarray:
        positions = np.linspace(0, len(hips) - 1, frames)
        values = continuous(torch.from_numpy(hips)).numpy()
        before = np.minimum(positions.astype(int), len(hips) - 2)
        part = (positions - before)[:, None, None]
        between = (1 - part) * values[before] + part * values[before + 1]
        quaternions: np.ndarray = between / np.linalg.norm(between, axis=-1, keepdims=True)
        return quaternions

    hips_of_clip = even(_hip_quaternions(_thigh_rotations(clip, skeleton)))
    warped = [alignment(_distances(even(reference.hips), hips_of_clip)) for reference in references]
    aligned, _ = min(warped, key=lambda each: each[1])
    return aligned * ((clip.frames - 1) / (frames - 1))


def _at_rate(clip: Clip, fps: float, rate: float) -> tuple[Clip, float]:
    """Return a clip of `fps` frames per second at another rate, and the number of original frames per new frame."""
    if clip.rotations is None:
        raise ValueError(
            f"clip {'/'.join(clip.key)} has no rotations of joints; MotionSet.with_rotations() computes them"
        )
    return (clip, 1.0) if fps == rate else (clip.resample(fps / rate), fps / rate)


@lru_cache(maxsize=8)
def _resting(skeleton: Skeleton) -> torch.Tensor:
    """Return joints (J, 3) of the rest pose, with the root at 0."""
    return resting(skeleton.parents, skeleton.offsets)


@lru_cache(maxsize=8)
def _legs(skeleton: Skeleton) -> list[list[int]]:
    """Return the indices of joints of the left and the right leg, from the child of the root to the hip and the knee.

    Arm and leg of a side both begin at the trunk; the hip is the lowest of these first joints in the rest pose.
    """
    rest, legs = _resting(skeleton), []
    for leaving in skeleton.sides:
        hip = min(leaving, key=lambda joint: float(rest[joint, skeleton.vertical]))
        below = [child for parent, child in skeleton.edges if parent == hip]
        while below and hip in skeleton.left + skeleton.right and float(skeleton.offsets[below[0]].norm()) == 0:
            hip, below = below[0], [child for parent, child in skeleton.edges if parent == below[0]]
        if not below:
            raise ValueError(
                f"skeleton {skeleton.name!r} has no joint below {skeleton.names[hip]}, so leg swings cannot be measured"
            )
        path = [below[0], hip]
        while (above := skeleton.parents[path[-1]]) not in (skeleton.root, -1):
            path.append(above)
        legs.append(path[::-1])
    return legs


def _thigh_rotations(clip: Clip, skeleton: Skeleton) -> torch.Tensor:
    """Return the rotations of both thighs relative to the pelvis, (F, 2, 3, 3)."""
    rotations_by_side = []
    for *hips, _ in _legs(skeleton):
        rotations = to_matrix(tensor_of(clip.rotations)[:, hips].double(), "quaternion")
        rotations_by_side.append(reduce(torch.matmul, rotations.unbind(1)))
    return torch.stack(rotations_by_side, 1)


def _hip_quaternions(thighs: torch.Tensor) -> np.ndarray:
    """Convert rotations of the thighs (F, 2, 3, 3) to quaternions (F, 2, 4)."""
    quaternions: np.ndarray = from_matrix(thighs, "quaternion").numpy()
    return quaternions


def _thigh_angles(rotations: torch.Tensor, skeleton: Skeleton) -> np.ndarray:
    """Return the forward angles of the left and the right thigh relative to the pelvis, (F, 2) in radians."""
    up = torch.eye(3, dtype=torch.float64)[skeleton.vertical]
    ahead = torch.tensor([0.0, 0.0, 1.0] if skeleton.up == "y" else [0.0, -1.0, 0.0], dtype=torch.float64)
    ahead = rotate_about_up(ahead, skeleton.heading(_resting(skeleton)), skeleton.up)
    knees = skeleton.offsets[[leg[-1] for leg in _legs(skeleton)]]
    directions = (rotations @ knees[..., None]).squeeze(-1)
    angles: np.ndarray = torch.atan2(directions @ ahead, -directions @ up).numpy()
    return angles


def _distances(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the distances (M, F) in radians between all pairs of hip rotations (M, 2, 4) and (F, 2, 4).

    A distance is the root mean square over both hips of the angle between the rotations.
    """
    cosine = np.abs(np.einsum("mhq,fhq->hmf", first, second)).clip(max=1)
    distances: np.ndarray = np.sqrt(np.square(2 * np.arccos(cosine)).mean(0))
    return distances


def _regularity(swing: np.ndarray, cycles: Cycles) -> tuple[float, int]:
    """Return the regularity of an angle (F,) at its best period, and this period in frames.

    A regular angle repeats after a period, and changes its sign after half a period. The regularity is the
    autocorrelation at the period minus the autocorrelation at half the period."""
    swing = swing - swing.mean()
    shortest = max(2, round(cycles.shortest * cycles.rate))
    lags = np.arange(shortest, min(int(cycles.longest * cycles.rate), (len(swing) - 1) // 2) + 1)
    if not len(lags) or swing.std() < cycles.swing:
        return -np.inf, 0
    shifts = np.arange(lags[-1] + 1)
    pairs = [(swing[: len(swing) - lag], swing[lag:]) for lag in shifts]
    correlations = np.array([(a @ b) / max(np.sqrt((a @ a) * (b @ b)), 1e-12) for a, b in pairs])
    scores = correlations[lags] - np.interp(lags / 2, shifts, correlations)
    return float(scores.max()), int(lags[scores.argmax()])


def _between_peaks(angle: np.ndarray, period: int) -> list[tuple[int, int]]:
    """Return first and last frames of the cycles of a leg, between successive maxima of its forward angle (F,)."""
    window = np.hanning(max(period // 4, 1) + 2)
    padded = np.pad(angle, (len(window) // 2, (len(window) - 1) // 2), mode="edge")
    smooth, half = np.convolve(padded, window / window.sum(), mode="valid"), period // 2
    tops = [t for t in range(1, len(smooth) - 1) if smooth[t] == smooth[max(t - half, 0) : t + half + 1].max()]
    return [(a, b) for a, b in pairwise(tops) if abs(b - a - period) <= max(period // 8, 1)]


def _most_typical(cycles: Sequence[tuple[np.ndarray, Clip]]) -> tuple[np.ndarray, Clip]:
    """Return the cycle with the smallest mean distance from the others, at equal fractions of their durations."""
    candidates = cycles[:: -(-len(cycles) // MOST_CYCLES)]
    share = np.linspace(0, 1, 25)
    samples = np.stack([hips[np.rint(share * (len(hips) - 1)).astype(int)] for hips, _ in candidates])
    cosine = np.abs(np.einsum("athq,bthq->abth", samples, samples)).clip(max=1)
    distances = 2 * np.sqrt(np.square(np.arccos(cosine)).mean(-1)).mean(-1).mean(-1)
    return candidates[int(np.argmin(distances))]


def _deviations(angle: np.ndarray, longest: int) -> np.ndarray:
    """Return standard deviations (F, K) of an angle (F,): at [s, k], of k + 1 frames from frame s; 0 after the end."""
    frames = np.arange(len(angle))[:, None] + np.arange(longest + 1)
    sums, squares = (np.pad(np.cumsum([0.0, *values]), (0, longest), mode="edge") for values in (angle, angle**2))
    counts = np.arange(1, longest + 1)
    mean, square = ((total[frames[:, 1:]] - total[frames[:, :1]]) / counts for total in (sums, squares))
    inside = frames[:, :-1] < len(angle)
    return np.where(inside, np.sqrt(np.maximum(square - mean**2, 0)), 0.0)


def _end_distances(hips: np.ndarray, longest: int) -> np.ndarray:
    """Return distances (F, K) in radians: at [s, k], between frames s and s + k; arbitrary after the end."""
    padded = np.concatenate([hips, np.repeat(hips[-1:], longest - 1, axis=0)])
    later = np.lib.stride_tricks.sliding_window_view(padded, longest, axis=0)  # (F, 2, 4, K)
    cosine = np.abs(np.einsum("fhq,fhqk->hfk", hips, later)).clip(max=1)
    distances: np.ndarray = np.sqrt(np.square(2 * np.arccos(cosine)).mean(0))
    return distances


def _select_cheapest(costs: np.ndarray, threshold: float, overlap: float) -> list[tuple[int, int]]:
    """Select subsequences with limited overlap, the cheapest first, and return their first frames s and their k.

    Args:
        costs: (F, K), at [s, k] the cost of the subsequence of k + 1 frames from frame s.
        threshold: maximum cost.
        overlap: maximum overlap of two subsequences, as a fraction of the shorter one.
    """
    starts, lengths = np.nonzero(costs <= threshold)
    order = np.argsort(costs[starts, lengths], kind="stable")
    starts, lengths = starts[order], lengths[order]
    selected = []
    while len(starts):
        first, frames = int(starts[0]), int(lengths[0])
        selected.append((first, frames))
        shared = np.minimum(starts + lengths, first + frames) - np.maximum(starts, first)
        is_free = shared <= overlap * np.minimum(lengths, frames)
        starts, lengths = starts[is_free], lengths[is_free]
    return selected
