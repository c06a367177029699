"""Segments of motion as time-stamped frames, the chi of a latent space of 4D motion.

Marsot, Wuhrer, Franco and Durocher (2021), arXiv 2106.04387, section 3:

    chi = [Theta, Gamma, Phi]     N frames of joint rotations, root position, and time

* Theta: rotations of joints as six numbers each, minus the identity, 1 0 0 0 1 0. A joint without children is left out
  if its rotation is constant in the training segments. Positions do not determine it, and the feet of AMASS do not
  rotate. It returns as the identity. SMPL's 22 joints without the feet have 120 numbers, as in the paper.
* Gamma: the position of the root relative to the first frame, scaled to lie between -1 and 1.
* Phi: the time since the previous frame; 0 in the first frame. The sum of Phi is the duration of a segment from its
  first to its last frame: (F - 1) / fps for F frames.

Segments are rotated to heading zero in their first frame. Only the heading of the root rotation is removed, so the
vertical direction is preserved.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np
import scipy
import torch
from torch import Tensor
from torch.nn.functional import pad

from ...constants import constant, indices
from ...data.batch import WHOLE
from ...options import Positive, Size, check
from ..data.clips import Clip, MotionSet
from ..geometry import kinematics
from ..geometry.rotations import continuous, from_matrix, normalised, to_matrix
from ..geometry.skeleton import Skeleton, brief, rotate_about_up
from ..geometry.views import HEADING
from .gait import Reference, stamps

OFFSETS = "offsets"
"""Name in batches of rest poses (B, J, 3) in metres: mean offsets of joints in the coordinates of their parents."""

ORIGIN = "origin"
"""Name in batches of the root positions in first frames, (B, 3) in metres."""

ROUNDS = 4
"""Number of iterations that correct the loss of interpolation to N frames and back; each at least halves the loss.

For segments of 91 frames of bandai2 and cmu8 at 30 frames a second, the largest errors fall from 4 and 13 mm to .2
and .7 mm."""

STEADY = 1e-3
"""Smallest standard deviation of a rotation component; smaller values are replaced by it."""

BRIEFEST = 0.01
"""Minimum time increment of a decoded frame, relative to the even increment of the longest segment."""

CONSTANT = 1e-2
"""Largest angle in radians between rotations of a joint that counts as constant."""

AT_ONCE = 4096
"""Number of frames of equally long clips that are processed at once, so that they fit into a processor's cache."""


@dataclass(frozen=True)
class TimedFrames:
    """Conversion of segments of motion to time-stamped frames and back.

    Args:
        skeleton: skeleton of the segments, with a rest pose, left and right.
        frames: number of frames N.
        metres: unit of positions in metres.
        seconds: unit of durations in seconds: if N frames are spaced evenly over this duration, their time increments
            are 1.
        mean, deviation: means and standard deviations (6 K,) that standardise the six numbers of each of the K joints
            in `joints`; default: the identity rotation, and 1.
        references: reference cycles for time warping. Frame n of chi is the point in the segment that is aligned with
            frame n of the nearest reference, resampled to N frames (`gait.stamps`). Default: N frames evenly in time.
        joints: names of the K joints whose rotations a frame contains; the others have the identity rotation. Default:
            the joints with children.

    Raises:
        ValueError: the skeleton has no rest pose or sides, `mean` or `deviation` have a wrong number of values, or
            `joints` are not joints of the skeleton with all its joints with children.

    Example:
        >>> people = dvae.motion.simulate(clips=2, frames=60).with_rotations()
        >>> view = dvae.motion.TimedFrames.of(people)
        >>> view.to(people)["x"].shape, view.back(view.to(people), fps=60).clips[0].frames
        (torch.Size([2, 100, 76]), 119)
    """

    skeleton: Skeleton
    frames: Size = 100
    metres: Positive = 1.0
    seconds: Positive = 3.0
    mean: Sequence[float] = ()
    deviation: Sequence[float] = ()
    references: Sequence[Reference] = ()
    joints: Sequence[str] = ()

    def __post_init__(self) -> None:
        check(self)
        for attribute in ("offsets", "sides"):
            getattr(self.skeleton, attribute)  # these properties raise errors that explain what to do
        if self.frames < 2:
            raise ValueError(f"frames must be at least 2, got {self.frames}")
        parents = {self.skeleton.names[parent] for parent, _ in self.skeleton.edges}
        if self.joints and not parents <= {*self.joints} <= {*self.skeleton.names}:
            raise ValueError(
                f"`joints` are {brief(self.joints)}; expected names of joints of the skeleton {self.skeleton.name!r}, "
                f"among them all with children: {', '.join(parents)}"
            )
        for name in ("mean", "deviation"):
            if (numbers := len(getattr(self, name))) not in (0, 6 * len(self.turning)):
                raise ValueError(f"{name} has {numbers} numbers, expected 6 for each of {len(self.turning)} joints")
        if not np.isfinite([*self.mean, *self.deviation]).all():
            raise ValueError("`mean` and `deviation` must be finite, got NaN or infinite numbers")
        if any(value <= 0 for value in self.deviation):
            raise ValueError(f"all values of `deviation` must be above 0, got {min(self.deviation)}")

    @classmethod
    def of(
        cls,
        motion: MotionSet,
        frames: int = 100,
        scaling: Literal["identity", "deviation"] = "identity",
        references: Sequence[Reference] = (),
    ) -> Self:
        """Return the conversion with units estimated from training segments.

        Frames contain the rotations of joints with children, and of joints without children that rotate in the
        segments.

        Args:
            motion: segments with rotations.
            frames: number of frames N.
            scaling: scaling of rotations: "identity" subtracts the identity rotation, "deviation" standardises by mean
                and standard deviation, which the paper found unstable.
            references: reference cycles for time warping, as in `TimedFrames`.

        Raises:
            ValueError: the scaling is unknown, or `to` raises it.
        """
        return cls.seeing(motion, frames, scaling, references)[0]

    @classmethod
    def seeing(
        cls,
        motion: MotionSet,
        frames: int = 100,
        scaling: Literal["identity", "deviation"] = "identity",
        references: Sequence[Reference] = (),
    ) -> tuple[Self, dict[str, Any]]:
        """Return the conversion from `of` and the result of its `to` for the same segments, computed together.

        This is faster than two calls.

        Args:
            motion: segments with rotations.
            frames: number of frames N.
            scaling: scaling of rotations: "identity" subtracts the identity rotation, "deviation" standardises them.
            references: reference cycles for time warping, as in `TimedFrames`.

        Raises:
            ValueError: the scaling is unknown, or `to` cannot convert the segments.
        """
        if scaling not in ("identity", "deviation"):
            raise ValueError(f"scaling is {scaling!r}; expected 'identity' or 'deviation'")
        view = cls(motion.skeleton, frames, references=references, joints=_rotating(motion))
        unscaled = view._unscaled(motion)
        # in single precision, so that units do not depend on the last digits of a double
        x = view._scaled(unscaled)[WHOLE]
        metres = max(float(x[..., view.parts["translation"]].abs().max()), 1e-3)
        view = replace(view, metres=metres, seconds=float(view.lasts(x[..., -1:].double()).max()))
        if scaling == "deviation":
            rotations = view._six_numbers(x.double()).flatten(-2).flatten(0, 1)
            deviation = rotations.std(0, correction=0).clamp(STEADY)
            view = replace(view, mean=tuple(rotations.mean(0).tolist()), deviation=tuple(deviation.tolist()))
        return view, view._scaled(unscaled)

    @property
    def turning(self) -> list[int]:
        """Indices of the K joints whose rotations a frame contains."""
        if self.joints:
            return sorted(self.skeleton.names.index(name) for name in {*self.joints})
        return sorted({parent for parent, _ in self.skeleton.edges})

    @property
    def still(self) -> list[str]:
        """Names of the other joints, which have the identity rotation."""
        return [name for n, name in enumerate(self.skeleton.names) if n not in self.turning]

    @property
    def size(self) -> int:
        """Number of values per frame, 6 K + 4."""
        return 6 * len(self.turning) + 4

    @property
    def parts(self) -> Mapping[str, list[int]]:
        """Coordinates of a frame by part: rotations (Theta), translation of the root (Gamma), time (Phi)."""
        end = 6 * len(self.turning)
        return {"rotations": [*range(end)], "translation": [*range(end, end + 3)], "time": [end + 3]}

    def to(self, motion: MotionSet) -> dict[str, Any]:
        """Convert segments, each a clip, to time-stamped frames.

        Args:
            motion: clips with rotations, at any frame rate.

        Returns:
            A batch of x (B, N, D) and the information that `back` needs: "heading" (B,) in radians and "origin" (B, 3)
            in metres of the first frames, and "offsets" (B, J, 3) in metres of joints from their parents at rest.

        Raises:
            ValueError: a clip has no rotations, only one frame, or another skeleton.

        Warns:
            UserWarning: a joint rotates that frames do not contain.
        """
        return self._scaled(self._unscaled(motion))

    def back(self, frames: Mapping[str, Any], fps: float | None = None) -> MotionSet:
        """Convert time-stamped frames, from `to` or from a decoder, to motion.

        Args:
            frames: x (B, N, D); optionally "heading", "origin" and "offsets" as returned by `to`. Defaults: heading
                zero, origin 0, and the offsets of the skeleton's rest pose.
            fps: frames per second; default: the rate of the skeleton.

        Returns:
            One clip per segment with positions and rotations, from time 0 to its last full frame.

        Raises:
            ValueError: x has another shape, or values that are NaN or infinite.
        """
        skeleton, x = replace(self.skeleton, fps=fps or self.skeleton.fps), frames[WHOLE].detach().cpu().double()
        if not x.isfinite().all():
            raise ValueError(f"x has {int((~x.isfinite()).sum())} NaN or infinite values; all must be finite")
        rotations, places, times = self.unpack(x)
        clips = []
        for b in range(len(x)):
            values = _join(continuous(from_matrix(rotations[b][:, self.turning], "quaternion")), places[b])
            moments = np.arange(int(float(times[b, -1]) * skeleton.fps + 1e-3) + 1) / skeleton.fps
            interpolation = _cubic(times[b].numpy(), moments.clip(max=float(times[b, -1])))
            turned_quaternions, root_positions = _split_joined(_normalise(interpolation @ values))
            local = torch.eye(3).to(x).repeat(len(turned_quaternions), skeleton.joints, 1, 1)
            local[:, self.turning] = to_matrix(turned_quaternions, "quaternion")
            if HEADING in frames:
                turn, root_positions = self._rotate_root(
                    local[:, skeleton.root], root_positions, frames[HEADING][b].cpu().double()
                )
                local[:, skeleton.root] = turn
            if ORIGIN in frames:
                root_positions = root_positions + frames[ORIGIN][b].cpu().double()
            offsets = frames[OFFSETS][b].cpu().double() if OFFSETS in frames else skeleton.offsets
            positions, _ = kinematics.forward(skeleton.parents, local, offsets, root_positions)
            quaternions = continuous(from_matrix(local, "quaternion"))
            clips.append(Clip("all", f"{b:04d}", positions.numpy(), rotations=quaternions.numpy()))
        return MotionSet(clips, skeleton, "segments")

    def unpack(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return rotations, root positions and times of frames (..., N, D), with gradients.

        Args:
            x: frames (..., N, D).

        Returns:
            local rotations of all joints (..., N, J, 3, 3), which are the identity for the joints in `still`; root
            positions relative to the first frame (..., N, 3) in metres; and times since the first frame (..., N) in
            seconds.

        Raises:
            ValueError: x has another shape.
        """
        if x.shape[-2:] != (self.frames, self.size):
            raise ValueError(
                f"segments have shape {tuple(x.shape)}, expected (..., {self.frames}, {self.size}) for the skeleton "
                f"{self.skeleton.name!r}"
            )
        return *self.poses(x), self.times(x)

    def poses(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return rotations (..., J, 3, 3) and root positions (..., 3) of any frames (..., D), with gradients.

        Args:
            x: frames (..., D).
        """
        turning = self.turning
        ends = [joint for joint in range(self.skeleton.joints) if joint not in turning]
        unturned = torch.eye(3, dtype=x.dtype, device=x.device).expand(*x.shape[:-1], len(ends), 3, 3)
        back = indices([[*turning, *ends].index(joint) for joint in range(self.skeleton.joints)], x)
        rotations = torch.cat([to_matrix(self._six_numbers(x), "6d"), unturned], -3).index_select(-3, back)
        return rotations, x[..., -4:-1] * self.metres

    def times(self, x: Tensor) -> Tensor:
        """Return the times of frames (..., N, D) since the first frame, (..., N) in seconds, with gradients.

        Args:
            x: frames (..., N, D).
        """
        even = self.seconds / (self.frames - 1)
        later = x[..., -1][..., 1:].clamp(BRIEFEST) * even
        return pad(later.cumsum(-1), (1, 0))

    def lasts(self, x: Tensor) -> Tensor:
        """Return the durations (...,) in seconds of segments (..., N, D), which are the sums of time increments.

        Args:
            x: segments (..., N, D).
        """
        return self.times(x)[..., -1]

    def travels(self, x: Tensor) -> Tensor:
        """Return the distances (...,) in metres between first and last root position of segments (..., N, D).

        Args:
            x: segments (..., N, D).
        """
        first, last = self.poses(x[..., [0, -1], :])[1].unbind(-2)
        distance: Tensor = (last - first).norm(dim=-1)
        return distance

    def _unscaled(self, motion: MotionSet) -> dict[str, Tensor]:
        """Return the result of `to` with x before scaling: six numbers per rotation, metres, seconds."""
        skeleton = motion.skeleton
        if (skeleton.names, skeleton.parents, skeleton.up) != tuple(
            getattr(self.skeleton, name) for name in ("names", "parents", "up")
        ):
            raise ValueError(
                f"{motion.name or 'these segments'} have the joint tree of {skeleton.name!r}, expected the tree of "
                f"{self.skeleton.name!r}; dvae.motion.segments.gait.on_common_joints maps two sources to one tree"
            )
        for clip in motion:
            segment = f"segment {'/'.join(clip.key)}"
            if clip.rotations is None:
                raise ValueError(f"{segment} has no rotations of joints; MotionSet.with_rotations() computes them")
            if clip.frames < 2:
                raise ValueError(f"{segment} has {clip.frames} frame, expected at least 2")
        first = torch.from_numpy(np.stack([clip.positions[0] for clip in motion])).double()
        heading = skeleton.heading(first)
        x = first.new_empty(len(motion), self.frames, self.size)
        still = [skeleton.names.index(name) for name in self.still]
        left_out = first.new_zeros(len(still))
        for rows, quaternions, positions in _of_one_length(motion):
            angles = 2 * quaternions[:, :, still, 0].abs().clamp(max=1).acos()
            left_out = torch.maximum(left_out, angles.flatten(0, 1).amax(0))
            frames = np.linspace(0, quaternions.shape[1] - 1, self.frames)[None]
            if self.references:
                clips = (motion.clips[n] for n in rows)
                frames = np.stack([stamps(clip, self.skeleton, self.references, self.frames) for clip in clips])
            x[rows] = self._resampled(
                quaternions, positions[:, :, skeleton.root], frames, skeleton.fps, -heading[rows, None]
            )
        degrees = zip(self.still, left_out.rad2deg().tolist(), strict=True)
        if rotated := [f"{name} (up to {angle:.0f}°)" for name, angle in degrees if np.deg2rad(angle) > CONSTANT]:
            warnings.warn(
                f"frames do not contain the rotations of {', '.join(rotated)}, which return as the identity",
                stacklevel=3,
            )
        origin, offsets = first[:, skeleton.root], resting_offsets(motion)
        return {WHOLE: x, HEADING: heading, ORIGIN: origin, OFFSETS: offsets}

    def _resampled(
        self, quaternions: Tensor, root_positions: Tensor, frames: np.ndarray, fps: float, angle: Tensor
    ) -> Tensor:
        """Return unscaled x (B, N, D) of quaternions (B, F, J, 4) and positions (B, F, 3), rotated by angles (B, 1).

        `frames` are the frame numbers of the clips at which x is evaluated, (B, N), or (1, N) for all clips.
        """
        root, times = self.skeleton.root, np.arange(quaternions.shape[1])
        first, root_positions = self._rotate_root(
            to_matrix(quaternions[:, :, root], "quaternion"), root_positions - root_positions[:, :1], angle
        )
        quaternions[:, :, root] = from_matrix(first, "quaternion")
        original = _join(continuous(normalised(quaternions[:, :, self.turning])), root_positions)
        to_frames = torch.stack([_cubic(times, row) for row in frames])
        from_frames = torch.stack([_cubic(row, times) for row in frames])
        values = _normalise(to_frames @ original)
        for _ in range(ROUNDS):  # add the error of the round trip to the values
            values = _normalise(values + to_frames @ (original - _normalise(from_frames @ values)))
        quaternions, root_positions = _split_joined(values)
        rotations = from_matrix(to_matrix(quaternions, "quaternion"), "6d").flatten(-2)
        increments = torch.from_numpy(np.diff(frames, prepend=0.0) / fps).expand(len(quaternions), -1)
        return torch.cat([rotations, root_positions, increments[..., None]], -1)

    def _scaled(self, unscaled: Mapping[str, Any]) -> dict[str, Any]:
        """Return the result of `_unscaled` with x in the units of this conversion, in single precision."""
        mean, deviation = self._scaling(unscaled[WHOLE])
        others = mean.new_tensor([self.metres] * 3 + [self.seconds / (self.frames - 1)])
        mean, deviation = pad(mean, (0, 4)), torch.cat([deviation, others])
        # in parts, because a second array in double precision would be the largest one of all
        x = torch.cat([((part - mean) / deviation).float() for part in unscaled[WHOLE].split(AT_ONCE // 16)])
        return {name: value.float() for name, value in {**unscaled, WHOLE: x}.items()}

    def _rotate_root(self, turn: Tensor, positions: Tensor, angle: Tensor) -> tuple[Tensor, Tensor]:
        """Rotate the root's rotations (..., 3, 3) and positions (..., 3) about the up axis by angles (...)."""
        up = self.skeleton.up
        return rotate_about_up(turn.mT, angle[..., None], up).mT, rotate_about_up(positions, angle, up)

    def _six_numbers(self, x: Tensor) -> Tensor:
        """Return the six numbers (..., K, 6) of each joint in a frame from frames (..., D), without scaling."""
        mean, deviation = self._scaling(x)
        numbers: Tensor = (x[..., :-4] * deviation + mean).unflatten(-1, (-1, 6))
        return numbers

    def _scaling(self, like: Tensor) -> tuple[Tensor, Tensor]:
        unturned = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0) * len(self.turning)
        return constant(self.mean or unturned, like), constant(self.deviation or (1.0,) * len(unturned), like)


def _rotating(motion: MotionSet) -> tuple[str, ...]:
    """Return the names of joints whose rotations frames need; empty for the joints with children."""
    skeleton = motion.skeleton
    parents = {parent for parent, _ in skeleton.edges}
    leaves = [joint for joint in range(skeleton.joints) if joint not in parents]
    first = next((clip.rotations[0, leaves] for clip in motion if clip.rotations is not None), None)
    if first is None:
        return ()
    cosines = np.ones(len(leaves))
    for clip in motion:
        if clip.rotations is not None:
            cosines = np.minimum(cosines, np.abs((clip.rotations[:, leaves] * first).sum(-1)).min(0))
    rotating = {leaf for leaf, cosine in zip(leaves, cosines, strict=True) if cosine < np.cos(CONSTANT / 2)}
    return tuple(skeleton.names[joint] for joint in sorted(parents | rotating)) if rotating else ()


def resting_offsets(motion: MotionSet) -> Tensor:
    """Return mean offsets of joints from their parents, in the coordinates of the parents, (B, J, 3) in metres."""
    skeleton = motion.skeleton
    parents, children = ([edge[end] for edge in skeleton.edges] for end in (0, 1))
    offsets = torch.zeros(len(motion), skeleton.joints, 3, dtype=torch.float64)
    for rows, quaternions, positions in _of_one_length(motion):
        local = to_matrix(quaternions, "quaternion")
        # rotations only; the offsets do not matter here
        _, world = kinematics.forward(skeleton.parents, local, positions, positions[..., 0, :])
        limbs = (positions[..., children, :] - positions[..., parents, :])[..., None]
        offsets[rows[:, None], children] = (world[..., parents, :, :].mT @ limbs).squeeze(-1).mean(1)
    return offsets


def _of_one_length(motion: MotionSet) -> Iterator[tuple[np.ndarray, Tensor, Tensor]]:
    """Yield batches of equally long clips: indices in the set, quaternions (B, F, J, 4) and positions (B, F, J, 3)."""
    lengths = np.array([clip.frames for clip in motion])
    for frames in np.unique(lengths):
        same_length = np.flatnonzero(lengths == frames)
        for rows in np.array_split(same_length, -(-len(same_length) * frames // AT_ONCE)):
            arrays = zip(*((motion.clips[n].rotations, motion.clips[n].positions) for n in rows), strict=True)
            quaternions, positions = (torch.from_numpy(np.stack(array)).double() for array in arrays)
            yield rows, quaternions, positions


def _join(quaternions: Tensor, root: Tensor) -> Tensor:
    """Concatenate quaternions (..., K, 4) and root positions (..., 3) to joined values (..., 4 K + 3)."""
    return torch.cat([quaternions.flatten(-2), root], -1)


def _split_joined(values: Tensor) -> tuple[Tensor, Tensor]:
    """Split joined values into quaternions (..., K, 4) and positions (..., 3)."""
    return values[..., :-3].unflatten(-1, (-1, 4)), values[..., -3:]


def _normalise(values: Tensor) -> Tensor:
    """Normalise the quaternions of joined values in place."""
    quaternions, _ = _split_joined(values)
    quaternions /= quaternions.norm(dim=-1, keepdim=True)
    return values


def _cubic(times: np.ndarray, targets: np.ndarray) -> Tensor:
    """Return the matrix (N, F) that interpolates values at F times to N target times by a not-a-knot cubic spline."""
    degree = min(3, len(times) - 1)
    knots = np.concatenate([times[:1].repeat(degree + 1), times[2:-2], times[-1:].repeat(degree + 1)])
    splines = scipy.interpolate.BSpline
    source_matrix, target_matrix = (
        splines.design_matrix(points, knots, degree, extrapolate=True) for points in (times, targets)
    )
    return torch.from_numpy(scipy.sparse.linalg.splu(source_matrix.T.tocsc()).solve(target_matrix.T.toarray()).T)
