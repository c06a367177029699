"""Segments of motion as time-stamped frames, chi of a latent space of 4D motion.

Marsot, Wuhrer, Franco and Durocher (2021), arXiv 2106.04387, section 3:

    chi = [Theta, Gamma, Phi]     N frames of turns of joints, place of the root, and time

* Theta: the turn of every joint from which others hang as six numbers, less those of no turn, 1 0 0 0 1 0. Ends, whose
  turns move nothing, are left out, and come back unturned.
* Gamma: where the root is from where it was in the first frame, in units that leave it between -1 and 1.
* Phi: how long after the frame before a frame is; 0 in the first. So all of them add up to how long a segment lasts,
  from its first frame to its last: (F - 1) / fps of F frames.

A segment starts facing one way: the heading of its first frame is taken from it, and nothing else of how its root is
turned, so that down stays down.
"""

from __future__ import annotations

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
from ..geometry.skeleton import Skeleton, rotate_about_up
from ..geometry.views import HEADING
from .gait import Reference, stamps

OFFSETS = "offsets"
"""Name in batches of rest poses (B, J, 3) in metres: where joints are, on average, from their parents as these turn."""

ORIGIN = "origin"
"""Name in batches of where roots are in first frames, (B, 3) in metres."""

ROUNDS = 4
"""Of correcting what interpolation there and back loses, each of which leaves half of it or less: of 91 frames of
bandai2 and cmu8 at 30 a second, of the largest errors of 4 and 13 mm, .2 and .7."""

STEADY = 1e-3
"""Deviation, of numbers of turns, below which one is taken for so much."""

BRIEFEST = 0.01
"""Share of an even increment of the longest segment that an increment has at least, whatever a decoder makes of it."""

AT_ONCE = 4096
"""Frames of clips of one length that are read at once, for which there is room in a processor's cache."""


@dataclass(frozen=True)
class TimedFrames:
    """Segments of motion, and back to motion.

    Args:
        skeleton: of the segments, with a rest pose, left and right.
        frames: N.
        metres: by which places are divided.
        seconds: how long the segment lasts whose even increments are 1.
        mean, deviation: of the six numbers of each turning joint; empty for those of no turn, and 1.
        references: cycles along which time is warped: a frame of chi is where the same frame of the nearest of them,
            brought to N frames, is found in the segment (`gait.stamps`). None: N frames evenly in time.

    Raises:
        ValueError: a skeleton without rest pose or sides, or as many numbers as no turns have.

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

    def __post_init__(self) -> None:
        check(self)
        for needed in ("offsets", "sides"):
            getattr(self.skeleton, needed)  # which say what to do where there are none
        if self.frames < 2:
            raise ValueError(f"{self.frames} frame has no time between frames; expected at least 2")
        for name in ("mean", "deviation"):
            if (numbers := len(getattr(self, name))) not in (0, 6 * len(self.turning)):
                raise ValueError(
                    f"{name} has {numbers} numbers, expected 6 for each of {len(self.turning)} joints that turn"
                )
        if not np.isfinite([*self.mean, *self.deviation]).all():
            raise ValueError("mean or deviation have NaN or infinite numbers")
        if any(value <= 0 for value in self.deviation):
            raise ValueError(f"a deviation is {min(self.deviation)}, by which nothing can be divided")

    @classmethod
    def of(
        cls,
        motion: MotionSet,
        frames: int = 100,
        scaling: Literal["identity", "deviation"] = "identity",
        references: Sequence[Reference] = (),
    ) -> Self:
        """In units of these segments, which are those for training.

        Args:
            motion: segments, with rotations.
            frames: N.
            scaling: of turns: "identity" takes no turn from them, "deviation" their mean, and divides by their
                deviation, which the paper found unstable.
            references: see the class.

        Raises:
            ValueError: another scaling; or see `to`.
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
        """`of` segments, and these segments so (`to`), where both are needed: frames are made once."""
        if scaling not in ("identity", "deviation"):
            raise ValueError(f"scaling is {scaling!r}; expected 'identity' or 'deviation'")
        made = cls(motion.skeleton, frames, references=references)
        found = made._found(motion)
        x = made._scaled(found)[WHOLE]  # of single precision, as units do not hang on a double's last digits
        metres = max(float(x[..., made.parts["place"]].abs().max()), 1e-3)
        made = replace(made, metres=metres, seconds=float(made.lasts(x[..., -1:].double()).max()))
        if scaling == "deviation":
            turns = made._turns(x.double()).flatten(-2).flatten(0, 1)
            deviation = turns.std(0, correction=0).clamp(STEADY)
            made = replace(made, mean=tuple(turns.mean(0).tolist()), deviation=tuple(deviation.tolist()))
        return made, made._scaled(found)

    @property
    def turning(self) -> list[int]:
        """The K joints from which others hang."""
        return sorted({parent for parent, _ in self.skeleton.edges})

    @property
    def size(self) -> int:
        """Numbers of a frame, 6 K + 4."""
        return 6 * len(self.turning) + 4

    @property
    def parts(self) -> Mapping[str, list[int]]:
        """Coordinates of a frame by what they are of: turns (Theta), place (Gamma), time (Phi)."""
        turns = 6 * len(self.turning)
        return {"turns": [*range(turns)], "place": [*range(turns, turns + 3)], "time": [turns + 3]}

    def to(self, motion: MotionSet) -> dict[str, Any]:
        """Segments, each a clip, as time-stamped frames.

        Args:
            motion: at any rate, with rotations.

        Returns:
            A batch: x (B, N, D), and what the way back needs: the heading (B,) in radians and the origin (B, 3) in
            metres of first frames, and the body, as offsets (B, J, 3) of its rest pose.

        Raises:
            ValueError: clips without rotations, of one frame, or of another skeleton.
        """
        return self._scaled(self._found(motion))

    def back(self, seen: Mapping[str, Any], fps: float | None = None) -> MotionSet:
        """Motion of time-stamped frames: what `to` made, or a decoder.

        Args:
            seen: x (B, N, D). Without a heading, everybody starts facing heading zero; without an origin, at 0; without
                offsets, with the body of the skeleton's rest pose.
            fps: of the motion; that of the skeleton by default.

        Returns:
            A clip for each, with positions and rotations, from time 0 to the last that is not after its end.

        Raises:
            ValueError: x of another shape, or with what is no number.
        """
        skeleton, x = replace(self.skeleton, fps=fps or self.skeleton.fps), seen[WHOLE].detach().cpu().double()
        if not x.isfinite().all():
            raise ValueError(f"{int((~x.isfinite()).sum())} of the numbers of frames are NaN or infinite")
        turns, places, times = self.unpack(x)
        clips = []
        for b in range(len(x)):
            values = _joined(continuous(from_matrix(turns[b][:, self.turning], "quaternion")), places[b])
            at = np.arange(int(float(times[b, -1]) * skeleton.fps + 1e-3) + 1) / skeleton.fps
            through = _cubic(times[b].numpy(), at.clip(max=float(times[b, -1])))
            own, place = _parted(_normed(through @ values))
            local = torch.eye(3).to(x).repeat(len(own), skeleton.joints, 1, 1)
            local[:, self.turning] = to_matrix(own, "quaternion")
            if HEADING in seen:
                turn, place = self._faced(local[:, skeleton.root], place, seen[HEADING][b].cpu().double())
                local[:, skeleton.root] = turn
            if ORIGIN in seen:
                place = place + seen[ORIGIN][b].cpu().double()
            offsets = seen[OFFSETS][b].cpu().double() if OFFSETS in seen else skeleton.offsets
            positions, _ = kinematics.forward(skeleton.parents, local, offsets, place)
            quaternions = continuous(from_matrix(local, "quaternion"))
            clips.append(Clip("all", f"{b:04d}", positions.numpy(), rotations=quaternions.numpy()))
        return MotionSet(clips, skeleton, "segments")

    def unpack(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What frames (..., N, D) say, with gradients.

        Returns:
            local rotations of all joints (..., N, J, 3, 3), of ends none; places of the root from where it was at
            first (..., N, 3) in metres; and times from the first frame (..., N) in seconds.

        Raises:
            ValueError: another shape.
        """
        if x.shape[-2:] != (self.frames, self.size):
            raise ValueError(
                f"segments have shape {tuple(x.shape)}, expected (..., {self.frames}, {self.size}) for the skeleton "
                f"{self.skeleton.name!r}"
            )
        return *self.poses(x), self.times(x)

    def poses(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """What any frames (..., D) say of poses, with gradients: rotations (..., J, 3, 3) and places (..., 3)."""
        turning = self.turning
        ends = [joint for joint in range(self.skeleton.joints) if joint not in turning]
        unturned = torch.eye(3, dtype=x.dtype, device=x.device).expand(*x.shape[:-1], len(ends), 3, 3)
        back = indices([[*turning, *ends].index(joint) for joint in range(self.skeleton.joints)], x)
        rotations = torch.cat([to_matrix(self._turns(x), "6d"), unturned], -3).index_select(-3, back)
        return rotations, x[..., -4:-1] * self.metres

    def times(self, x: Tensor) -> Tensor:
        """When frames (..., N, D) are, from the first on, (..., N) in seconds, with gradients."""
        even = self.seconds / (self.frames - 1)
        later = x[..., -1][..., 1:].clamp(BRIEFEST) * even
        return pad(later.cumsum(-1), (1, 0))

    def lasts(self, x: Tensor) -> Tensor:
        """How long segments (..., N, D) last, (...,) in seconds: the sum of their increments."""
        return self.times(x)[..., -1]

    def travels(self, x: Tensor) -> Tensor:
        """How far roots get from the first of frames (..., N, D) to the last, (...,) in metres."""
        first, last = self.poses(x[..., [0, -1], :])[1].unbind(-2)
        found: Tensor = (last - first).norm(dim=-1)
        return found

    def _found(self, motion: MotionSet) -> dict[str, Tensor]:
        """What `to` gives, with x as it is: six numbers of each turn, metres, seconds."""
        skeleton = motion.skeleton
        if (skeleton.names, skeleton.parents, skeleton.up) != tuple(
            getattr(self.skeleton, name) for name in ("names", "parents", "up")
        ):
            raise ValueError(
                f"{motion.name or 'these segments'} have the tree of joints {skeleton.name!r}, and frames here are of "
                f"{self.skeleton.name!r}; dvae.motion.segments.gait.alike brings two sources onto one tree"
            )
        for clip in motion:
            where = f"segment {'/'.join(clip.key)}"
            if clip.rotations is None:
                raise ValueError(f"{where} has no turns of joints; MotionSet.with_rotations() finds them")
            if clip.frames < 2:
                raise ValueError(f"{where} has {clip.frames} frame, expected at least 2, between which time passes")
        first = torch.from_numpy(np.stack([clip.positions[0] for clip in motion])).double()
        heading = skeleton.heading(first)
        x = first.new_empty(len(motion), self.frames, self.size)
        for places, turns, positions in _of_one_length(motion):
            at = np.linspace(0, turns.shape[1] - 1, self.frames)[None]
            if self.references:
                some = (motion.clips[n] for n in places)
                at = np.stack([stamps(clip, self.skeleton, self.references, self.frames) for clip in some])
            x[places] = self._seen(turns, positions[:, :, skeleton.root], at, skeleton.fps, -heading[places, None])
        origin, offsets = first[:, skeleton.root], resting_offsets(motion)
        return {WHOLE: x, HEADING: heading, ORIGIN: origin, OFFSETS: offsets}

    def _seen(self, turns: Tensor, place: Tensor, at: np.ndarray, fps: float, angle: Tensor) -> Tensor:
        """x as it is (B, N, D) of quaternions (B, F, J, 4) and places (B, F, 3), turned by angles (B, 1).

        Its frames are at frames (B, N) of the clips, or (1, N) of all of them.
        """
        root, times = self.skeleton.root, np.arange(turns.shape[1])
        first, place = self._faced(to_matrix(turns[:, :, root], "quaternion"), place - place[:, :1], angle)
        turns[:, :, root] = from_matrix(first, "quaternion")
        given = _joined(continuous(normalised(turns[:, :, self.turning])), place)
        there = torch.stack([_cubic(times, each) for each in at])
        again = torch.stack([_cubic(each, times) for each in at])
        values = _normed(there @ given)
        for _ in range(ROUNDS):  # what comes back less or more than it was, goes in more or less
            values = _normed(values + there @ (given - _normed(again @ values)))
        turns, place = _parted(values)
        six = from_matrix(to_matrix(turns, "quaternion"), "6d").flatten(-2)
        increments = torch.from_numpy(np.diff(at, prepend=0.0) / fps).expand(len(turns), -1)
        return torch.cat([six, place, increments[..., None]], -1)

    def _scaled(self, found: Mapping[str, Any]) -> dict[str, Any]:
        """What was found in these units, single precision."""
        mean, deviation = self._scaling(found[WHOLE])
        others = mean.new_tensor([self.metres] * 3 + [self.seconds / (self.frames - 1)])
        x = (found[WHOLE] - pad(mean, (0, 4))).div_(torch.cat([deviation, others]))
        return {name: value.float() for name, value in {**found, WHOLE: x}.items()}

    def _faced(self, turn: Tensor, place: Tensor, angle: Tensor) -> tuple[Tensor, Tensor]:
        """The root's rotations (..., 3, 3) and places (..., 3), turned about the up axis by angles (...)."""
        up = self.skeleton.up
        return rotate_about_up(turn.mT, angle[..., None], up).mT, rotate_about_up(place, angle, up)

    def _turns(self, x: Tensor) -> Tensor:
        """Six numbers of each turning joint (..., K, 6)."""
        mean, deviation = self._scaling(x)
        found: Tensor = (x[..., :-4] * deviation + mean).unflatten(-1, (-1, 6))
        return found

    def _scaling(self, like: Tensor) -> tuple[Tensor, Tensor]:
        unturned = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0) * len(self.turning)
        return constant(self.mean or unturned, like), constant(self.deviation or (1.0,) * len(unturned), like)


def resting_offsets(motion: MotionSet) -> Tensor:
    """Where joints of clips with rotations are, on average, from their parents as these turn, (B, J, 3) in metres."""
    skeleton = motion.skeleton
    parents, children = (list(ends) for ends in zip(*skeleton.edges, strict=True))
    found = torch.zeros(len(motion), skeleton.joints, 3, dtype=torch.float64)
    for some, turns, places in _of_one_length(motion):
        local = to_matrix(turns, "quaternion")
        _, world = kinematics.forward(skeleton.parents, local, places, places[..., 0, :])  # turns, whatever hangs there
        limbs = (places[..., children, :] - places[..., parents, :])[..., None]
        found[some[:, None], children] = (world[..., parents, :, :].mT @ limbs).squeeze(-1).mean(1)
    return found


def _of_one_length(motion: MotionSet) -> Iterator[tuple[np.ndarray, Tensor, Tensor]]:
    """Places of some clips in a set, and their quaternions (B, F, J, 4) and positions (B, F, J, 3)."""
    lengths = np.array([clip.frames for clip in motion])
    for frames in np.unique(lengths):
        alike = np.flatnonzero(lengths == frames)
        for some in np.array_split(alike, -(-len(alike) * frames // AT_ONCE)):
            given = zip(*((motion.clips[n].rotations, motion.clips[n].positions) for n in some), strict=True)
            turns, positions = (torch.from_numpy(np.stack(each)).double() for each in given)
            yield some, turns, positions


def _joined(quaternions: Tensor, place: Tensor) -> Tensor:
    """(..., 4 K + 3) of (..., K, 4) and (..., 3)."""
    return torch.cat([quaternions.flatten(-2), place], -1)


def _parted(values: Tensor) -> tuple[Tensor, Tensor]:
    """Quaternions (..., K, 4) and places (..., 3) of joined ones."""
    return values[..., :-3].unflatten(-1, (-1, 4)), values[..., -3:]


def _normed(values: Tensor) -> Tensor:
    """Joined ones, whose quaternions are brought to unit length in place."""
    turns, _ = _parted(values)
    turns /= turns.norm(dim=-1, keepdim=True)
    return values


def _cubic(times: np.ndarray, at: np.ndarray) -> Tensor:
    """What takes values at F times to those at N others on a cubic through them, the not-a-knot spline: (N, F)."""
    degree = min(3, len(times) - 1)
    knots = np.concatenate([times[:1].repeat(degree + 1), times[2:-2], times[-1:].repeat(degree + 1)])
    splines = scipy.interpolate.BSpline
    given, asked = (splines.design_matrix(each, knots, degree, extrapolate=True) for each in (times, at))
    return torch.from_numpy(scipy.sparse.linalg.splu(given.T.tocsc()).solve(asked.T.toarray()).T)
