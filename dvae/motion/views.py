"""Views of motion: people who face one way, and the turns of their joints in place of positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from ..data import Batch
from ..views import WHOLE, View
from . import kinematics
from .rotations import from_matrix, size, to_matrix
from .skeleton import Skeleton, rotate_about_up

HEADING = "heading"
"""Name in batches of the angles (B,) by which windows were turned, in radians."""
BONES = "bones"
"""Name in batches of the lengths (B, J - 1) of their bones, in metres, in the order of the skeleton's edges."""
TURNS = "turns"
"""Name in batches of the turns (B, T, 4 J) of all joints, quaternions w x y z one after the other."""


@dataclass(frozen=True)
class Heading(View):
    """Windows turned about the up axis so that one of their poses has heading zero.

    Given the heading, a window and its turned one are a rotation apart: volumes, lengths and angles stay. The heading
    itself nothing scores, so that bounds are those of turned windows: they compare with those of models that turn
    windows by the same pose, and with no others.

    Missing entries stay missing. The joints that tell the heading must be observed in that pose, and of every joint
    both horizontal coordinates or neither, as a turn mixes them.

    Args:
        skeleton: with left and right.
        frames: O; the pose is the last of the first O frames, or of a window that is shorter.
        pose: variable (B, D) that is the pose; None for a frame of x.
        turned: names of what turns, (..., B, T, D) with D = 3 J, or 3 (J - 1) without the root, which is the origin.
    """

    skeleton: Skeleton
    frames: int = 1
    pose: str | None = None
    turned: tuple[str, ...] = (WHOLE,)
    names = (HEADING,)

    @override
    def __call__(self, data: Batch, beside: Batch | None = None) -> dict[str, Any]:
        source = self.pose or WHOLE
        found = (beside or {}).get(HEADING)
        if HEADING in data or (source not in data if beside is None else found is None):
            return dict(data)
        seen = dict(data)
        for name in data.get("mask", {}).keys() & {*self.turned} & data.keys():
            self._check_mask(name, data["mask"][name])
            seen[name] = torch.where(data["mask"][name], data[name], 0.0)
        if found is None:
            if self.pose is None and "lengths" in data:
                shortest, needed = data["lengths"].min(), min(self.frames, data[WHOLE].shape[-2])
                if shortest < needed:
                    raise ValueError(
                        f"this model turns every window by its frame {needed}, but a sequence has {shortest}; leave it "
                        "out, or fit with heading=False"
                    )
            found = self.of(seen[source])
        return self._turn(seen, -found) | {HEADING: found}

    @override
    def inverse(self, seen: Batch) -> dict[str, Any]:
        data = dict(seen)
        heading = data.pop(HEADING, None)
        return data if heading is None else self._turn(data, heading)

    def of(self, x: Tensor) -> Tensor:
        """Headings (...) of windows (..., T, D), or of poses (..., D)."""
        return self.skeleton.heading(self._joints(x, 0.0))

    def face(self, x: Tensor) -> Tensor:
        """Windows (..., T, D) turned each by its own heading."""
        return self._rotated(x, -self.of(x), 2)

    def _turn(self, values: Batch, angle: Tensor) -> dict[str, Any]:
        found = {n: self._rotated(values[n], angle, 2 - (n == self.pose)) for n in self.turned if n in values}
        return {**values, **found}

    def _rotated(self, x: Tensor, angle: Tensor, dims: int) -> Tensor:
        return rotate_about_up(x.unflatten(-1, (-1, 3)), angle[(..., *[None] * dims)], self.skeleton.up).flatten(-2)

    def _joints(self, x: Tensor, root: float) -> Tensor:
        """The pose (..., J, 3) of windows or poses, with the root where that was dropped."""
        pose = x if self.pose else x[..., min(self.frames, x.shape[-2]) - 1, :]
        sizes = 3 * self.skeleton.joints, 3 * self.skeleton.joints - 3
        if pose.shape[-1] not in sizes:
            raise ValueError(
                f"{self.pose or WHOLE} has shape {tuple(x.shape)}; poses of the skeleton {self.skeleton.name!r} have "
                f"{sizes[0]} coordinates, or {sizes[1]} without the root"
            )
        return self.skeleton.with_root(pose.unflatten(-1, (-1, 3)), root)

    def _check_mask(self, name: str, mask: Tensor) -> None:
        """Refuses missing entries that leave the heading open, or half of what a turn mixes."""
        skeleton, joints = self.skeleton, mask.unflatten(-1, (-1, 3))
        across = [axis for axis in range(3) if axis != skeleton.vertical]
        mixed = joints[..., across[0]] != joints[..., across[1]]
        if mixed.any():
            window, *_, joint = mixed.nonzero()[0].tolist()
            held = [n for j, n in enumerate(skeleton.names) if j != skeleton.root or mixed.shape[-1] == skeleton.joints]
            raise ValueError(
                f"window {window} lacks one horizontal coordinate of {held[joint]} and has the other, but this model "
                "turns windows, which mixes them; hide both in 'mask', or fit with heading=False"
            )
        if name == (self.pose or WHOLE):
            left, right = skeleton.sides
            telling = [*left, *right]
            lacking = ~self._joints(mask, True)[..., telling, :][..., across].all(-1)
            if lacking.any():
                window, joint = lacking.nonzero()[0].tolist()
                raise ValueError(
                    f"window {window} lacks {skeleton.names[telling[joint]]} in the pose by which this model turns it: "
                    "hips and shoulders tell a heading; leave the window out, or fit with heading=False"
                )


@dataclass(frozen=True)
class Rotations(View):
    """Turns of joints in place of positions, and bones that keep their lengths.

    x is positions (B, T, D) in metres on either side of a model; what the model sees is first the root's place, where
    x has it, then the turn of every joint from which others hang, in `form`. The turns are those that come with the
    data; of data without, as of the past of a forecast, they are found (`kinematics.inverse`). Bones have the lengths
    that they have in the data, on average, or in the rest pose, where there are none.

    Densities are of these numbers, not of positions, which have other volumes and one dimension for each bone more:
    bounds compare with those of models that see the same.

    Args:
        skeleton: with a rest pose.
        form: of the turns: "6d", "quaternion" or "vector", of which any numbers are turns; see
            `dvae.motion.rotations`.
        root: whether x has the root, D = 3 J; otherwise it is the origin, and D = 3 (J - 1).

    Raises:
        ValueError: an unknown form, or a skeleton without rest pose.
    """

    skeleton: Skeleton
    form: str = "6d"
    root: bool = False
    names = (TURNS, BONES)

    def __post_init__(self) -> None:
        size(self.form)
        assert len(self.skeleton.offsets)  # which says what to do where there are none

    @property
    def measured(self) -> str:  # type: ignore[override]
        """What densities are of."""
        return f"turns of joints ({self.form})"

    @property
    def turning(self) -> list[int]:
        """The joints from which others hang; the turns of all others cannot be seen."""
        return sorted({parent for parent, _ in self.skeleton.edges})

    @property
    def size(self) -> int:
        """Numbers of a frame that the model sees."""
        return 3 * self.root + size(self.form) * len(self.turning)

    @override
    def __call__(self, data: Batch, beside: Batch | None = None) -> dict[str, Any]:
        seen = dict(data)
        turns = seen.pop(TURNS, None)
        if WHOLE not in data or BONES in data:
            return seen
        x, skeleton = data[WHOLE], self.skeleton
        if x.shape[-1] != 3 * (skeleton.joints - (not self.root)):
            raise ValueError(
                f"x has shape {tuple(x.shape)}; positions of the skeleton {skeleton.name!r} have "
                f"{3 * (skeleton.joints - (not self.root))} numbers"
            )
        if WHOLE in data.get("mask", {}):
            raise ValueError(
                "a joint that is missing leaves the turns of others open; fit under a protocol whose representation is "
                "positions, which may be masked"
            )
        positions = skeleton.with_root(x.unflatten(-1, (-1, 3)))
        if turns is None:
            found = kinematics.inverse(skeleton, positions, skeleton.offsets.to(x))[..., self.turning, :, :]
        else:
            turns = turns[:, : x.shape[1]].unflatten(-1, (-1, 4))  # of a past, no more than that
            found = to_matrix(turns[..., self.turning, :], "quaternion").to(x)
        place = [positions[..., skeleton.root, :]] if self.root else []
        seen[WHOLE] = torch.cat([*place, from_matrix(found, self.form).flatten(-2)], -1)
        seen[BONES] = (beside or {}).get(BONES, skeleton.bone_lengths(positions).mean(-2))
        return seen

    @override
    def inverse(self, seen: Batch) -> dict[str, Any]:
        data = dict(seen)
        bones = data.pop(BONES, None)
        if WHOLE not in seen:
            return data
        x, skeleton = seen[WHOLE], self.skeleton
        offsets = skeleton.offsets.to(x)
        if bones is not None:
            children = [child for _, child in skeleton.edges]
            lengths = bones.new_zeros(*bones.shape[:-1], skeleton.joints)
            lengths[..., children] = bones
            offsets = lengths[..., None, :, None] * torch.nn.functional.normalize(offsets, dim=-1)  # (B, 1, J, 3)
        place = x[..., :3] if self.root else torch.zeros_like(x[..., :3])
        turns = torch.eye(3).to(x).repeat(*x.shape[:-1], skeleton.joints, 1, 1)
        turns[..., self.turning, :, :] = to_matrix(
            x[..., 3 * self.root :].unflatten(-1, (len(self.turning), -1)), self.form
        )
        positions, _ = kinematics.forward(skeleton.parents, turns, offsets, place)
        return {**data, WHOLE: (positions if self.root else skeleton.without_root(positions)).flatten(-2)}
