"""Views of motion: people who face one way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from ..data import Batch
from ..views import WHOLE, View
from .skeleton import Skeleton, rotate_about_up

HEADING = "heading"
"""Name in batches of the angles (B,) by which windows were turned, in radians."""


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
