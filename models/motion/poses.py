"""Base of the methods for poses: unset options are chosen for the skeleton."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor
from typing_extensions import override

from ...data.sequences import interpolate_missing
from ...motion import Skeleton
from ...motion.data.protocols import Poses
from ..method import Method


def table(options: str, rows: Mapping[str, Sequence[Any]]) -> dict[str, dict[str, Any]]:
    """Return the presets of each skeleton as dictionaries from option to value.

    Args:
        options: names of the options, separated by spaces.
        rows: dictionary from skeleton to the values of these options, in the same order.
    """
    return {skeleton: dict(zip(options.split(), values, strict=True)) for skeleton, values in rows.items()}


def without_gaps(skeleton: Skeleton, poses: Tensor, mask: Tensor) -> Tensor:
    """Return poses (B, T, D) without a root, with missing joints filled in.

    Our choice: across missing frames, a joint is interpolated linearly in time. A joint that is never observed is at
    its parent's position.

    Args:
        skeleton: skeleton of the poses.
        poses: (B, T, D), with any values at missing entries.
        mask: (B, T, D), True where an entry was observed.
    """
    positions, is_observed = (
        skeleton.with_root(x.unflatten(-1, (-1, 3))) for x in (interpolate_missing(poses, mask), mask.any(1))
    )
    for joint in skeleton.order[1:]:
        parent = positions[..., skeleton.parents[joint], :]
        positions[..., joint, :] = torch.where(is_observed[:, None, joint], positions[..., joint, :], parent)
    return skeleton.without_root(positions).flatten(-2)


@dataclass(frozen=True)
class PoseMethod(Method):
    """A method for poses. Options that are None are chosen for the skeleton."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"": {}}
    """Values of options that are None, by the skeleton's name, and "" for any other skeleton."""
    representation: ClassVar[str] = "positions"
    """Representation that the protocol of the data must have."""

    def preset(self, skeleton: Skeleton) -> Mapping[str, Any]:
        """Return the values of options that are None, for poses of this skeleton; headings need left and right."""
        preset = self.presets.get(skeleton.name, self.presets[""])
        unknown = "heading" in preset and not (skeleton.left and skeleton.right)
        return {**preset, "heading": False} if unknown else preset

    @override
    def resolve_defaults(self, data: Any) -> Self:
        """Return the method with unset options chosen for the skeleton of the data."""
        return self.with_presets(self.preset(Poses.of(data, self.name, self.representation).skeleton))

    def poses(self, data: Any) -> Poses:
        """Return the schema of data that are poses without a root.

        Raises:
            ValueError: if the poses have a root, or the data are not poses.
        """
        schema = Poses.of(data, self.name)
        if schema.protocol.root != "drop":
            raise ValueError(
                f"{self.name} predicts poses relative to the pelvis, but the protocol {schema.protocol.name} has "
                f"root={schema.protocol.root!r}; use a protocol with root='drop'"
            )
        return schema

    def with_presets(self, preset: Mapping[str, Any]) -> Self:
        """Return the method with options that are None taken from a preset."""
        return replace(self, **{name: value for name, value in preset.items() if getattr(self, name) is None})
