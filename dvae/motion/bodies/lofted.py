"""A person defined by code: closed parts lofted along the bones of SMPL's 22 joints, and eight shape parameters.

A part is a chain of rings of vertices. Triangles to the centre of its first and last ring close it. The position and
width of a ring are linear in bone lengths and girths, which are linear in the parameters. The vertices are therefore
linear in the parameters, and their changes per parameter are the blend shapes. Around each joint is a ring with two
opposite vertices whose midpoint is the joint; the regressor averages these two vertices.

A parameter value of 1 is roughly one standard deviation: about one person in six differs as much. The numbers are our
own choice for a body that looks human; they are not fitted to people. If all parameters are between -3 and 3, no part
turns inside out.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from math import pi
from typing import NamedTuple

import torch
from torch import Tensor

from ..files.smpl import JOINTS, PARENTS
from .measures import enclosed_volume
from .skinning import Body, BodySource

SHAPE = ("size", "girth", "legs", "arms", "torso", "shoulders", "hips", "head")
"""The shape parameters, in order.

Size scales everything, head scales the head, and girth scales the widths and depths of trunk, legs and arms. Legs, arms
and torso are lengths; shoulders and hips are widths."""

MARKERS = {
    **{"forehead": 381, "breastbone": 184, "back": 193, "sacrum": 67},
    **{"L_shoulder": 1057, "L_elbow": 1108, "L_wrist": 1153, "L_knee": 529, "L_heel": 918, "L_toes": 919},
    **{"R_shoulder": 1251, "R_elbow": 1302, "R_wrist": 1347, "R_knee": 713, "R_heel": 1028, "R_toes": 1029},
}
"""Vertices of `human()` at typical marker positions.

The markers of limbs are on top of shoulders, behind elbows, on the back of wrists, and in front of knees."""

_SIZE = 0.04
_LENGTHS = {  # parameter: factor, axes, bones (named by their ends)
    "legs": (0.045, "xyz", ("Knee", "Ankle")),
    "arms": (0.045, "xyz", ("Elbow", "Wrist", "Palm", "Fingers", "Thumb")),
    "torso": (0.045, "y", ("Spine1", "Spine2", "Spine3", "Neck", "Collar")),
    "shoulders": (0.06, "x", ("Collar", "Shoulder")),
    "hips": (0.06, "x", ("Hip",)),
    "head": (0.05, "xyz", ("Head", "Crown", "Nose")),
}
_GIRTHS = {  # parameter: factors of width and depth, parts, starts of bones
    "girth": (0.1, 0.1, ("trunk", "leg", "arm"), ()),
    "shoulders": (0.05, 0.0, ("trunk",), ("Spine2", "Spine3")),
    "hips": (0.05, 0.0, ("trunk",), ("Pelvis",)),
    "head": (0.05, 0.05, ("head", "nose"), ()),
}

_OFFSETS = {  # metres from the parent, for a person of 1.7 m; paired joints: the left one, at +x
    "Hip": (0.088, -0.085, 0.0),
    "Spine1": (0.0, 0.105, -0.01),
    "Knee": (0.008, -0.395, 0.005),
    "Spine2": (0.0, 0.12, 0.0),
    "Ankle": (0.004, -0.395, -0.03),
    "Spine3": (0.0, 0.06, 0.0),
    "Foot": (0.012, -0.045, 0.125),
    "Neck": (0.0, 0.205, -0.01),
    "Collar": (0.065, 0.135, -0.005),
    "Head": (0.0, 0.08, 0.015),
    "Shoulder": (0.115, 0.015, -0.01),
    "Elbow": (0.265, 0.0, -0.005),
    "Wrist": (0.25, 0.0, 0.005),
}
_ENDS = {  # ends of bones after the last joint: their joint, and the offset from it
    "Crown": ("Head", (0.0, 0.19, 0.01)),
    "Nose": ("Head", (0.0, 0.045, 0.110)),
    "Heel": ("Ankle", (0.0, -0.04, -0.055)),
    "Toes": ("Foot", (0.004, -0.004, 0.085)),
    "Palm": ("Wrist", (0.085, 0.0, 0.005)),
    "Fingers": ("Wrist", (0.18, -0.004, 0.008)),
    "Thumb": ("Wrist", (0.085, -0.005, 0.075)),
}

_BONES = {
    name.removeprefix("L_"): (JOINTS[parent].removeprefix("L_"), _OFFSETS[name.removeprefix("L_")])
    for name, parent in zip(JOINTS, PARENTS, strict=True)
    if parent >= 0 and not name.startswith("R_")
} | _ENDS
"""Bones in the middle and on the left: name of the end -> name of the start, and offset in metres."""


class _Ring(NamedTuple):
    """A ring of vertices around a point of a bone.

    Attributes:
        start, end: ends of the bone.
        along: position on the bone, 0 at its start and 1 at its end.
        width: half width in metres.
        front, back: depth in metres, in the positive and negative direction of the second of the part's axes.
    """

    start: str
    end: str
    along: float
    width: float
    front: float
    back: float


class _Part(NamedTuple):
    """A chain of rings.

    Attributes:
        around: number of vertices of a ring, even.
        axes: axis of the width, then axis of the depth, such as "xz".
        paired: whether the part also exists on the right; the rings are defined for the left.
        rings: rings from one end to the other.
    """

    around: int
    axes: str
    paired: bool
    rings: list[_Ring]


# fmt: off
_PARTS = {
    "trunk": _Part(18, "xz", False, [
        _Ring("Pelvis", "Spine1", -1.25, 0.110, 0.055, 0.085),
        _Ring("Pelvis", "Spine1", -0.8, 0.170, 0.085, 0.125),
        _Ring("Pelvis", "Spine1", -0.35, 0.174, 0.095, 0.132),
        _Ring("Pelvis", "Spine1", 0.0, 0.166, 0.100, 0.118),
        _Ring("Pelvis", "Spine1", 0.5, 0.150, 0.102, 0.090),
        _Ring("Spine1", "Spine2", 0.0, 0.137, 0.102, 0.078),
        _Ring("Spine1", "Spine2", 0.5, 0.133, 0.102, 0.080),
        _Ring("Spine2", "Spine3", 0.0, 0.140, 0.107, 0.087),
        _Ring("Spine3", "Neck", 0.0, 0.153, 0.116, 0.097),
        _Ring("Spine3", "Neck", 0.25, 0.164, 0.123, 0.103),
        _Ring("Spine3", "Neck", 0.5, 0.168, 0.115, 0.105),
        _Ring("Spine3", "Neck", 0.7, 0.160, 0.090, 0.098),
        _Ring("Spine3", "Neck", 0.85, 0.125, 0.066, 0.083),
        _Ring("Spine3", "Neck", 0.94, 0.080, 0.055, 0.067),
        _Ring("Neck", "Head", 0.0, 0.060, 0.054, 0.058),
        _Ring("Neck", "Head", 0.5, 0.053, 0.056, 0.054),
        _Ring("Head", "Crown", 0.0, 0.052, 0.058, 0.055),
    ]),
    "head": _Part(14, "xz", False, [
        _Ring("Head", "Crown", -0.12, 0.032, 0.082, -0.005),
        _Ring("Head", "Crown", 0.02, 0.052, 0.094, 0.050),
        _Ring("Head", "Crown", 0.2, 0.065, 0.096, 0.078),
        _Ring("Head", "Crown", 0.4, 0.072, 0.094, 0.092),
        _Ring("Head", "Crown", 0.6, 0.076, 0.092, 0.098),
        _Ring("Head", "Crown", 0.78, 0.072, 0.082, 0.094),
        _Ring("Head", "Crown", 0.91, 0.055, 0.060, 0.074),
        _Ring("Head", "Crown", 0.98, 0.030, 0.032, 0.042),
    ]),
    "nose": _Part(6, "xy", False, [
        _Ring("Head", "Nose", 0.7, 0.015, 0.045, 0.010),
        _Ring("Head", "Nose", 0.9, 0.015, 0.022, 0.012),
        _Ring("Head", "Nose", 1.0, 0.009, 0.010, 0.010),
    ]),
    "leg": _Part(14, "xz", True, [
        _Ring("Hip", "Knee", -0.07, 0.070, 0.065, 0.080),
        _Ring("Hip", "Knee", 0.0, 0.084, 0.084, 0.108),
        _Ring("Hip", "Knee", 0.14, 0.087, 0.090, 0.106),
        _Ring("Hip", "Knee", 0.32, 0.080, 0.086, 0.088),
        _Ring("Hip", "Knee", 0.6, 0.065, 0.073, 0.068),
        _Ring("Hip", "Knee", 0.85, 0.054, 0.061, 0.055),
        _Ring("Knee", "Ankle", 0.0, 0.052, 0.056, 0.050),
        _Ring("Knee", "Ankle", 0.12, 0.051, 0.050, 0.056),
        _Ring("Knee", "Ankle", 0.3, 0.052, 0.042, 0.072),
        _Ring("Knee", "Ankle", 0.5, 0.046, 0.038, 0.062),
        _Ring("Knee", "Ankle", 0.75, 0.035, 0.033, 0.044),
        _Ring("Knee", "Ankle", 0.93, 0.032, 0.034, 0.040),
        _Ring("Ankle", "Foot", 0.0, 0.034, 0.038, 0.040),
    ]),
    "foot": _Part(12, "xy", True, [
        _Ring("Heel", "Foot", -0.07, 0.016, 0.018, 0.020),
        _Ring("Heel", "Foot", 0.0, 0.028, 0.032, 0.028),
        _Ring("Heel", "Foot", 0.15, 0.034, 0.050, 0.029),
        _Ring("Heel", "Foot", 0.35, 0.036, 0.062, 0.028),
        _Ring("Heel", "Foot", 0.6, 0.038, 0.050, 0.026),
        _Ring("Foot", "Toes", 0.0, 0.045, 0.032, 0.024),
        _Ring("Foot", "Toes", 0.4, 0.047, 0.021, 0.023),
        _Ring("Foot", "Toes", 0.8, 0.038, 0.015, 0.021),
        _Ring("Foot", "Toes", 1.0, 0.022, 0.011, 0.018),
    ]),
    "arm": _Part(12, "zy", True, [
        _Ring("Collar", "Shoulder", 0.0, 0.052, 0.032, 0.060),
        _Ring("Collar", "Shoulder", 0.5, 0.060, 0.046, 0.068),
        _Ring("Shoulder", "Elbow", 0.0, 0.058, 0.046, 0.066),
        _Ring("Shoulder", "Elbow", 0.18, 0.054, 0.045, 0.056),
        _Ring("Shoulder", "Elbow", 0.45, 0.048, 0.042, 0.046),
        _Ring("Shoulder", "Elbow", 0.8, 0.040, 0.036, 0.038),
        _Ring("Elbow", "Wrist", 0.0, 0.039, 0.034, 0.036),
        _Ring("Elbow", "Wrist", 0.2, 0.042, 0.036, 0.036),
        _Ring("Elbow", "Wrist", 0.5, 0.036, 0.030, 0.030),
        _Ring("Elbow", "Wrist", 0.85, 0.029, 0.022, 0.022),
        _Ring("Wrist", "Palm", 0.0, 0.028, 0.020, 0.020),
        _Ring("Wrist", "Palm", 0.4, 0.037, 0.018, 0.018),
        _Ring("Palm", "Fingers", 0.0, 0.042, 0.015, 0.015),
        _Ring("Palm", "Fingers", 0.5, 0.038, 0.011, 0.012),
        _Ring("Palm", "Fingers", 0.85, 0.029, 0.008, 0.009),
        _Ring("Palm", "Fingers", 1.0, 0.014, 0.005, 0.006),
    ]),
    "thumb": _Part(8, "xy", True, [
        _Ring("Wrist", "Thumb", 0.2, 0.018, 0.013, 0.013),
        _Ring("Wrist", "Thumb", 0.6, 0.016, 0.011, 0.011),
        _Ring("Wrist", "Thumb", 0.9, 0.011, 0.008, 0.008),
        _Ring("Wrist", "Thumb", 1.0, 0.006, 0.004, 0.004),
    ]),
}
# fmt: on
_MOST = 4
"""Maximum number of joints that move a vertex."""

_WEIGHT_WIDTH = 0.015
"""Additional distance in metres from a bone that divides its skinning weight by e."""


def human() -> Body:
    """Return the bundled person, with SMPL's 22 joints and the parameters `SHAPE`.

    At rest, its arms point to the sides, and its pelvis is at the origin.

    Example:
        >>> tall = human().at_rest(torch.tensor([2.0, 0, 0, 0, 0, 0, 0, 0]))[0]
        >>> float(tall[:, 1].max() - tall[:, 1].min()) > 1.8
        True
    """
    return Body(JOINTS, PARENTS, *(tensor.clone() for tensor in _arrays()), source=BodySource(shapes=len(SHAPE)))


@cache
def _arrays() -> tuple[Tensor, ...]:
    """Return template, shapes, regressor, weights and faces; computed once."""
    average = _vertices(torch.zeros(len(SHAPE), dtype=torch.float64))
    changes = [_vertices(unit) - average for unit in torch.eye(len(SHAPE), dtype=torch.float64)]
    faces, weights = [], []
    regressor = torch.zeros(len(JOINTS), len(average), dtype=torch.float32)
    first = 0
    for name, side in _sided():
        around, _, _, rings = part = _PARTS[name]
        for index, ring in enumerate(rings):
            joint = _joint(ring.start, side)
            if joint is not None and ring.along == 0:
                regressor[joint, [first + index * around, first + index * around + around // 2]] = 0.5
        vertices = average[first : first + len(rings) * around + 2]
        triangles = _triangles(len(rings), around)
        faces.append(first + (triangles if enclosed_volume(vertices, triangles) > 0 else triangles.flip(-1)))
        weights.append(_weights(part, side, vertices))
        first += len(vertices)
    shapes, shares = torch.stack(changes, -1).float(), torch.cat(weights).float()
    return average.float(), shapes, regressor, shares, torch.cat(faces)


def _sided() -> list[tuple[str, str]]:
    """Return the parts by name and side, in the order of vertices."""
    return [(name, side) for name, part in _PARTS.items() for side in (("L_", "R_") if part.paired else ("",))]


def _joint(name: str, side: str) -> int | None:
    """Return the index of a joint by its name, with or without the side; None for an end that is not a joint."""
    return next((JOINTS.index(joint) for joint in (name, side + name) if joint in JOINTS), None)


def _places(parameters: Tensor) -> dict[str, Tensor]:
    """Return positions (3,) in metres, by name, of the joints and bone ends in the middle and on the left."""
    shape = dict(zip(SHAPE, parameters, strict=True))
    places = {"Pelvis": parameters.new_zeros(3)}
    for name, (parent, offset) in _BONES.items():
        scale = (1 + _SIZE * shape["size"]).repeat(3)
        for parameter, (share, axes, bones) in _LENGTHS.items():
            if name in bones:
                scale[["xyz".index(axis) for axis in axes]] += share * shape[parameter]
        places[name] = places[parent] + scale * parameters.new_tensor(offset)
    return places


def _vertices(parameters: Tensor) -> Tensor:
    """Return the vertices (V, 3) of a person with parameters (8,): each part's rings, then the centres of its ends."""
    places = _places(parameters)
    parts = []
    for name, side in _sided():
        part = _PARTS[name]
        rings = [_ring(name, ring, places, parameters) for ring in part.rings]
        vertices = torch.cat([*rings, rings[0].mean(0, keepdim=True), rings[-1].mean(0, keepdim=True)])
        parts.append(vertices * vertices.new_tensor([-1.0, 1, 1]) if side == "R_" else vertices)
    return torch.cat(parts)


def _ring(name: str, ring: _Ring, places: Mapping[str, Tensor], parameters: Tensor) -> Tensor:
    """Return the vertices of a ring of a part, (around, 3)."""
    around, axes, *_ = _PARTS[name]
    shape = dict(zip(SHAPE, parameters, strict=True))
    scale = (1 + _SIZE * shape["size"]).repeat(2)  # width and depth
    for parameter, (*shares, parts, bones) in _GIRTHS.items():
        if name in parts and (not bones or ring.start in bones):
            scale += shape[parameter] * parameters.new_tensor(shares)
    angle = 2 * pi / around * torch.arange(around).to(parameters)
    depth = torch.where(angle <= pi, ring.front, ring.back)
    vertices = torch.lerp(places[ring.start], places[ring.end], ring.along).repeat(around, 1)
    vertices[:, "xyz".index(axes[0])] += scale[0] * ring.width * angle.cos()
    vertices[:, "xyz".index(axes[1])] += scale[1] * depth * angle.sin()
    return vertices


def _triangles(rings: int, around: int) -> Tensor:
    """Return the triangles (F, 3) of a chain of rings with a centre at both ends."""
    index = torch.arange(rings * around).reshape(rings, around)
    after = index.roll(-1, 1)
    low, low_after, high, high_after = index[:-1], after[:-1], index[1:], after[1:]
    ends = [torch.full((around,), rings * around + end) for end in (0, 1)]
    triangles = [
        torch.stack([low, high_after, low_after], -1).flatten(0, 1),
        torch.stack([low, high, high_after], -1).flatten(0, 1),
        torch.stack([ends[0], index[0], after[0]], -1),
        torch.stack([ends[1], after[-1], index[-1]], -1),
    ]
    return torch.cat(triangles)


def _weights(part: _Part, side: str, vertices: Tensor) -> Tensor:
    """Return skinning weights (V, J) of the vertices (V, 3) of a part, from their distances to the bones of each joint.

    The joints are those whose bones carry the part's rings, and the parent of the first one.
    """
    places = _places(vertices.new_zeros(len(SHAPE)))
    joints = list(dict.fromkeys(_BONES[ring.start][0] if ring.start in _ENDS else ring.start for ring in part.rings))
    if joints[0] in _BONES:
        joints.insert(0, _BONES[joints[0]][0])
    mirrored = torch.cat([vertices[:, :1].abs(), vertices[:, 1:]], -1)  # positions are defined on the left
    distances = []
    for joint in joints:
        bones = [places[end] for end, (start, _) in _BONES.items() if start == joint]
        distances.append(torch.stack([_distance(mirrored, places[joint], end) for end in bones]).amin(0))
    nearest, indices = torch.stack(distances, -1).topk(min(_MOST, len(joints)), largest=False)
    columns = torch.tensor([_joint(joint, side) for joint in joints])
    weights = vertices.new_zeros(len(vertices), len(JOINTS))
    return weights.scatter(1, columns[indices], (-nearest / _WEIGHT_WIDTH).softmax(-1))


def _distance(points: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Return the distances (V,) of points (V, 3) from the line segment between two points (3,)."""
    bone = end - start
    along = ((points - start) @ bone / bone.square().sum()).clamp(0, 1)
    distances: Tensor = (points - start - along[:, None] * bone).norm(dim=-1)
    return distances
