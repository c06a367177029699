"""Joint angles: cosines between vectors of a pose, defined for each skeleton, and their limits in real poses.

Source: the angle loss of GSPS (Mao, Liu and Salzmann 2021, arXiv:2108.08422) and, for Human3.6M and HumanEva-I, the
angles of its public code. A vector is the position of a joint relative to the root, `"LHip"`, a difference of joints,
`("LKnee", "-", "LHip")`, or a cross product of vectors, `(first, "x", second)`. The angle between a vector and a plane
is the cosine with the plane's normal, so knees that bend forwards differ from knees that bend backwards. Cosines do not
change when a pose is rotated, scaled, or mirrored with its sides exchanged.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from .parts import known_name
from .skeleton import Skeleton, differences, inverse_lengths

Vector: TypeAlias = "str | tuple[Vector, str, Vector]"

BLOCK = 4096
"""Number of poses whose cosines are computed at once, so that their vectors stay in the processor's cache."""


@dataclass(frozen=True)
class Angle:
    """The cosine of the angle between two vectors.

    Args:
        name: name of the angle; angles of the same name (left and right) share their limits.
        first, second: the two vectors.
        when: condition (u, v, sign) on a pose to have this angle: the inner product of the vectors u and v is negative
            (sign -1), or not negative (sign 1). None if every pose has the angle.
    """

    name: str
    first: Vector
    second: Vector
    when: tuple[Vector, Vector, Literal[-1, 1]] | None = None

    def mirrored(self) -> Angle:
        """Return the same angle on the other side of the body."""
        when = self.when and (_mirrored(self.when[0]), _mirrored(self.when[1]), self.when[2])
        return Angle(self.name, _mirrored(self.first), _mirrored(self.second), when)


def _mirrored(vector: Vector) -> Vector:
    """Return the vector with left and right exchanged; a reflection reverses cross products."""
    if isinstance(vector, str):
        return {"L": "R", "R": "L"}.get(vector[0], vector[0]) + vector[1:]
    a, operation, b = vector
    return (_mirrored(b), "x", _mirrored(a)) if operation == "x" else (_mirrored(a), "-", _mirrored(b))


def _sides(*left: Angle) -> Iterator[Angle]:
    for angle in left:
        yield from (angle, angle.mirrored())


_L_THIGH, _R_THIGH = ("LKnee", "-", "LHip"), ("RKnee", "-", "RHip")
_L_UPPER_ARM, _R_UPPER_ARM = ("LElbow", "-", "LShoulder"), ("RElbow", "-", "RShoulder")


def _human36m() -> Iterator[Angle]:
    hips = (("Thorax", "-", "RHip"), "x", ("Thorax", "-", "LHip"))
    head_top, head, chest = ("Head", "-", "Neck"), ("Neck", "-", "Thorax"), ("Thorax", "-", "Spine")
    shoulder, leg_plane = ("LShoulder", "-", "Thorax"), (_L_THIGH, "x", "LHip")
    forwards = ("LHip", ("Spine", "x", leg_plane))
    yield from _sides(
        Angle("Spine2Hip", "LHip", "Spine"),
        Angle("Leg2HipPlane", ("LHip", "x", _L_THIGH), ("LFoot", "-", "LKnee")),
        Angle("Shoulder2Hip", shoulder, "LHip"),
        Angle("Leg2ShoulderPlane", ("RShoulder", "x", "LShoulder"), "LKnee"),
        Angle("Spine2HipPlane1", leg_plane, "Spine", (*forwards, -1)),
        Angle("Spine2HipPlane2", leg_plane, "Spine", (*forwards, 1)),
        Angle("Shoulder2Neck", shoulder, ("Spine", "-", "Thorax")),
    )
    yield Angle("Shoulder2Shoulder", ("RShoulder", "-", "Thorax"), shoulder)
    yield Angle("Neck2Spine", chest, "Spine")
    yield Angle("ShoulderPlane2HipPlane", hips, ("LShoulder", "x", "RShoulder"))
    yield Angle("Head2Neck", chest, head)
    yield Angle("Head2HeadTop", head_top, head)
    yield Angle("HeadVerticalPlane2HipPlane", ((head_top, "x", head), "x", ("Head", "-", "Thorax")), hips)


def _humaneva() -> Iterator[Angle]:
    hips = ("LHip", "x", "RHip")
    shoulder, other_shoulder = ("LShoulder", "-", "Thorax"), ("RShoulder", "-", "Thorax")
    leg_plane = (_L_THIGH, "x", ("RHip", "-", "LHip"))
    yield Angle("LHip2RHip", "LHip", "RHip")
    yield Angle("Neck2HipPlane", hips, "Thorax")
    yield Angle("Head2Neck", ("Head", "-", "Thorax"), "Thorax")
    yield Angle("Shoulder2Shoulder", shoulder, other_shoulder)
    yield Angle(
        "ShoulderPlane2HipPlane",
        (("LHip", "-", "Thorax"), "x", ("RHip", "-", "Thorax")),
        ("LShoulder", "x", "RShoulder"),
    )
    yield from _sides(
        Angle("Shoulder2Neck", shoulder, "Thorax"),
        Angle("Leg2HipPlane", hips, _L_THIGH),
        Angle("Foot2LegPlane", leg_plane, ("LAnkle", "-", "LKnee")),
        Angle("ForeArm2ShoulderPlane", (_L_UPPER_ARM, "x", shoulder), ("LWrist", "-", "LElbow")),
    )


def _trunk_and_limbs(head: Vector) -> Iterator[Angle]:
    """Yield the angles of a skeleton that has ankles, toes, Spine, Chest and Neck.

    Args:
        head: vector along the head.
    """
    trunk, across_hips = ("Neck", "-", "Spine"), ("LHip", "-", "RHip")
    hips, shoulders = (across_hips, "x", "Spine"), ("LShoulder", "-", "RShoulder")
    chest = (shoulders, "x", ("Neck", "-", "Chest"))  # normals point to the front
    shank, foot = ("LAnkle", "-", "LKnee"), ("LToe", "-", "LAnkle")
    yield Angle("Trunk2Pelvis", trunk, "Spine")
    yield Angle("Trunk2HipPlane", trunk, hips)
    yield Angle("Chest2Spine", ("Neck", "-", "Chest"), ("Chest", "-", "Spine"))
    yield Angle("Shoulders2Hips", shoulders, across_hips)
    yield Angle("Head2Trunk", head, trunk)
    yield Angle("Head2ChestPlane", head, chest)
    yield from _sides(
        Angle("Trunk2Hip", trunk, across_hips),
        Angle("Thigh2Spine", _L_THIGH, "Spine"),
        Angle("Thigh2HipPlane", _L_THIGH, hips),
        Angle("Thigh2Hips", _L_THIGH, across_hips),
        Angle("Shank2Thigh", shank, _L_THIGH),
        Angle("Shank2ThighPlane", shank, (across_hips, "x", _L_THIGH)),
        Angle("Foot2Shank", foot, shank),
        Angle("Foot2ThighPlane", foot, (across_hips, "x", _L_THIGH)),
        Angle("Head2Shoulder", head, shoulders),
        Angle("Arm2Trunk", _L_UPPER_ARM, ("Neck", "-", "Chest")),
        Angle("Arm2Shoulders", _L_UPPER_ARM, shoulders),
        Angle("Arm2ChestPlane", _L_UPPER_ARM, chest),
        Angle("Forearm2Arm", ("LWrist", "-", "LElbow"), _L_UPPER_ARM),
    )


ANGLES: dict[str, tuple[Angle, ...]] = {
    "human36m": tuple(_human36m()),
    "walker": tuple(_human36m()),
    "humaneva": tuple(_humaneva()),
    "cmu21": tuple(_trunk_and_limbs(("Head", "-", "UpperNeck"))),
    "bandai21": (
        *_trunk_and_limbs(("Head", "-", "Neck")),
        *_sides(Angle("Shoulder2Chest", ("LShoulder", "-", "LClavicle"), ("Neck", "-", "Chest"))),
    ),
}
"""The angles of each skeleton. Human3.6M and HumanEva-I: from GSPS; cmu21 and bandai21: our own definitions."""


@dataclass(frozen=True, eq=False)
class AngleLimits:
    """Limits of the cosines of joint angles in real poses.

    Args:
        names: names of the A angles, in the order of `ANGLES`.
        low, high: (A,) smallest and largest cosine of each angle.

    Raises:
        ValueError: the sizes differ, or a lower limit is above the upper one.
    """

    names: tuple[str, ...]
    low: Tensor
    high: Tensor

    def __post_init__(self) -> None:
        sizes = (len(self.names),)
        if self.low.shape != sizes or self.high.shape != sizes:
            raise ValueError(
                f"`low` and `high` must have shape {sizes}, one limit per angle, got {tuple(self.low.shape)} and "
                f"{tuple(self.high.shape)}"
            )
        limits = zip(self.names, self.low.tolist(), self.high.tolist(), strict=True)
        crossed = [name for name, low, high in limits if not low <= high]
        if crossed:
            raise ValueError(
                "each lower limit must be at most the upper limit, and neither may be NaN; wrong limits: "
                f"{', '.join(dict.fromkeys(crossed))}"
            )


def cosines(poses: Tensor, skeleton: Skeleton) -> Tensor:
    """Return the cosines of all angles of `ANGLES[skeleton.name]`.

    If a pose does not meet the condition `Angle.when` of an angle, the cosine is NaN. Its comparisons with limits are
    then false, and its gradient is zero. A vector shorter than 1e-6 has cosine 0 with every other vector, and gradient
    zero.

    Args:
        poses: (..., D) in metres, D = 3 J, or 3 (J - 1) without the root.
        skeleton: skeleton of the poses, in `ANGLES`.

    Returns:
        Cosines (..., A) of the A angles, in the order of `ANGLES[skeleton.name]`.

    Raises:
        ValueError: D has another value, or the skeleton has no angles.
    """
    plan = _plan(skeleton, poses.device)
    matrix = differences(skeleton, plan.differences, poses.shape[-1], poses.dtype, poses.device)
    flat = poses.reshape(-1, poses.shape[-1])
    with torch.autocast(poses.device.type, enabled=False):
        # poses are on the last axis, so that every operation works on long contiguous rows
        vectors = (matrix.T @ flat.T).unflatten(0, (-1, 3))
    for first, second in plan.crosses:
        crossed = _cross(vectors.index_select(0, first), vectors.index_select(0, second))
        vectors = torch.cat([vectors, crossed])
    units = vectors * inverse_lengths(vectors, dim=1)[:, None]
    cosines = (units.index_select(0, plan.first) * units.index_select(0, plan.second)).sum(1)
    if len(plan.partial):
        absent = ((vectors[plan.u] * vectors[plan.v]).sum(1) < 0) != plan.negative[:, None]
        is_absent = torch.zeros_like(cosines, dtype=torch.bool).index_copy(0, plan.partial, absent)
        cosines = cosines.masked_fill(is_absent, torch.nan)
    result: Tensor = cosines.T.reshape(*poses.shape[:-1], len(plan.first))
    return result


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Return the cross products (V, 3, N) of two tensors (V, 3, N)."""
    (ax, ay, az), (bx, by, bz) = a.unbind(1), b.unbind(1)
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], 1)


def estimate_angle_limits(poses: Tensor, skeleton: Skeleton, quantile: float = 0.0) -> AngleLimits:
    """Estimate the angle limits of poses, pooled over left and right.

    Args:
        poses: (..., D) in metres, as in `cosines`.
        skeleton: skeleton of the poses, in `ANGLES`.
        quantile: fraction of the poses beyond each limit. 0 gives the smallest and the largest cosine, as in the paper,
            where one outlier frame widens the limits; .001 ignores such frames.

    Returns:
        The limits; an angle that no pose has is unrestricted, from -1 to 1.

    Raises:
        ValueError: `poses` is empty or has another D, the quantile is not in [0, .5), or the skeleton has no angles.
    """
    if not 0 <= quantile < 0.5:
        raise ValueError(f"`quantile` (share of poses beyond a limit) must be at least 0 and below .5, got {quantile}")
    if not poses.numel():
        raise ValueError(f"limits need at least one pose, got none in a tensor of shape {tuple(poses.shape)}")
    with torch.no_grad():
        cos = torch.cat([cosines(block, skeleton) for block in poses.reshape(-1, poses.shape[-1]).split(BLOCK)])
    names = angle_names(skeleton)
    low, high = torch.full_like(cos[:1], -1.0)[0], torch.ones_like(cos[0])
    for name in set(names):
        same = [column for column, other in enumerate(names) if other == name]
        values = cos[:, same][~cos[:, same].isnan()]
        if len(values):
            low[same], high[same] = (float(q) for q in np.quantile(values.cpu().numpy(), [quantile, 1 - quantile]))
    return AngleLimits(names, low, high)


def angle_names(skeleton: Skeleton) -> tuple[str, ...]:
    """Return the names of a skeleton's A angles in the order of `cosines`; left and right have the same name.

    Raises:
        ValueError: the skeleton has no angles.
    """
    return tuple(angle.name for angle in _angles(skeleton))


def _angles(skeleton: Skeleton) -> tuple[Angle, ...]:
    if (name := known_name(skeleton)) not in ANGLES:
        names = ", ".join(ANGLES)
        raise ValueError(
            f"joint angles are defined for the skeletons {names} and those with the same joints, not for "
            f"{skeleton.name!r}; use angles=0 to train without angle limits"
        )
    return ANGLES[name]


class _Plan(NamedTuple):
    """Computation of all angles of a skeleton: which vectors to compute, and which pairs of them have the cosines."""

    differences: tuple[tuple[int, int], ...]
    """The basic vectors, as (from, to) joints."""
    crosses: list[tuple[Tensor, Tensor]]
    """Indices of both factors in each round of cross products, whose results are appended to the vectors."""
    first: Tensor
    second: Tensor
    partial: Tensor
    """Indices of the angles that only some poses have: u v < 0 where `negative` is True, u v >= 0 elsewhere."""
    u: Tensor
    v: Tensor
    negative: Tensor


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # for the same reason as `differences`
def _plan(skeleton: Skeleton, device: torch.device) -> _Plan:
    angles = _angles(skeleton)
    depths: dict[Vector, int] = {}  # vector -> nesting depth of its cross products
    for angle in angles:
        for vector in (angle.first, angle.second, *(angle.when or ())[:2]):
            _depth(vector, depths)
    vectors = sorted(depths, key=depths.__getitem__)
    index = {vector: i for i, vector in enumerate(vectors)}
    rounds = [[vector for vector in vectors if depths[vector] == depth] for depth in range(max(depths.values()) + 1)]

    def columns(rows: Sequence[tuple[int, ...]], count: int) -> Any:
        return torch.tensor(rows, dtype=torch.long, device=device).reshape(-1, count).T.contiguous().unbind(0)

    crosses = [
        columns([(index[v[0]], index[v[2]]) for v in vectors_of_round if not isinstance(v, str)], 2)
        for vectors_of_round in rounds[1:]
    ]
    first, second = columns([(index[angle.first], index[angle.second]) for angle in angles], 2)
    parts = [(i, index[a.when[0]], index[a.when[1]], a.when[2] < 0) for i, a in enumerate(angles) if a.when]
    partial, u, v, negative = columns(parts, 4)
    pairs = tuple(_joints(vector, skeleton) for vector in rounds[0])
    return _Plan(pairs, crosses, first, second, partial, u, v, negative.bool())


def _depth(vector: Vector, depths: dict[Vector, int]) -> int:
    if vector not in depths:
        crosses = not isinstance(vector, str) and vector[1] == "x"
        depths[vector] = 1 + max(_depth(vector[0], depths), _depth(vector[2], depths)) if crosses else 0
    return depths[vector]


def _joints(vector: Vector, skeleton: Skeleton) -> tuple[int, int]:
    """Return the indices (from, to) of the joints at the ends of a vector that is a position or a difference."""
    start, end = (skeleton.names[skeleton.root], vector) if isinstance(vector, str) else (vector[2], vector[0])
    missing = [name for name in (start, end) if name not in skeleton.names]
    if missing:
        raise ValueError(f"skeleton {skeleton.name!r} has no joint {missing[0]!r}, but the angles of this name need it")
    return skeleton.names.index(start), skeleton.names.index(end)
