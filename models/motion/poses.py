"""What methods for poses have in common: options that are left open are chosen by the skeleton."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor
from typing_extensions import override

from ...data.sequences import bridged
from ...motion import Skeleton
from ...motion.data.protocols import Poses
from ..method import Method


def table(options: str, rows: Mapping[str, Sequence[Any]]) -> dict[str, dict[str, Any]]:
    """Presets from rows of values, by skeleton, under the names of their options."""
    return {skeleton: dict(zip(options.split(), values, strict=True)) for skeleton, values in rows.items()}


def without_gaps(skeleton: Skeleton, poses: Tensor, seen: Tensor) -> Tensor:
    """Poses (B, T, D) without a root whose missing joints are where one would take them to be.

    Ours: across a gap a joint goes straight from where it was to where it is next. One that is never seen is at its
    parent's place.

    Args:
        skeleton: of the poses.
        poses: anything where entries are missing.
        seen: (B, T, D), True where an entry was observed.
    """
    found, shown = (skeleton.with_root(x.unflatten(-1, (-1, 3))) for x in (bridged(poses, seen), seen.any(1)))
    for joint in skeleton.order[1:]:
        above = found[..., skeleton.parents[joint], :]
        found[..., joint, :] = torch.where(shown[:, None, joint], found[..., joint, :], above)
    return skeleton.without_root(found).flatten(-2)


@dataclass(frozen=True)
class PoseMethod(Method):
    """A method for poses. Options that are None are chosen by the skeleton."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"": {}}
    """What they stand for, by the skeleton's name, and "" for any other."""
    representation: ClassVar[str] = "positions"
    """Of a protocol under which it can be used."""

    def preset(self, skeleton: Skeleton) -> Mapping[str, Any]:
        """What options that are None stand for, with poses of this skeleton."""
        return self.presets.get(skeleton.name, self.presets[""])

    @override
    def suited(self, data: Any) -> Self:
        """With the options that are left open chosen for the skeleton of these data."""
        return self.filled(self.preset(Poses.of(data, self.name, self.representation).skeleton))

    def poses(self, data: Any) -> Poses:
        """The schema of data, of poses without a root.

        Raises:
            ValueError: poses with a root, or no poses.
        """
        schema = Poses.of(data, self.name)
        if schema.protocol.root != "drop":
            raise ValueError(
                f"{self.name} makes poses relative to the pelvis, but the protocol {schema.protocol.name} has the "
                f"root {schema.protocol.root!r}; use one with root='drop'"
            )
        return schema

    def filled(self, preset: Mapping[str, Any]) -> Self:
        """With options that are None taken from a preset."""
        return replace(self, **{name: value for name, value in preset.items() if getattr(self, name) is None})
