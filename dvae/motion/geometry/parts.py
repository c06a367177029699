"""Parts of the body: legs, arms and torso of the skeletons known by name, and unions of them."""

from __future__ import annotations

from collections.abc import Iterable

from .skeleton import Skeleton

_HUMAN36M = {
    "right_leg": ("RHip", "RKnee", "RFoot"),
    "left_leg": ("LHip", "LKnee", "LFoot"),
    "torso": ("Spine", "Thorax", "Neck", "Head"),
    "left_arm": ("LShoulder", "LElbow", "LWrist"),
    "right_arm": ("RShoulder", "RElbow", "RWrist"),
}
_LEGS = {f"{side}_leg": tuple(f"{side[0].upper()}{j}" for j in ("Hip", "Knee", "Ankle")) for side in ("right", "left")}
_FEET = {leg: (*joints, f"{joints[0][0]}Toe") for leg, joints in _LEGS.items()}
_ARMS = {
    f"{side}_arm": tuple(f"{side[0].upper()}{j}" for j in ("Shoulder", "Elbow", "Wrist")) for side in ("left", "right")
}

LIMBS: dict[str, dict[str, tuple[str, ...]]] = {
    "human36m": _HUMAN36M,
    "walker": _HUMAN36M,
    "humaneva": {**_LEGS, "torso": ("Thorax", "Head"), **_ARMS},
    "cmu21": {**_FEET, "torso": ("Spine", "Chest", "Neck", "UpperNeck", "Head", "HeadTop"), **_ARMS},
    "bandai21": {
        **_FEET,
        "torso": ("Spine", "Chest", "Neck", "Head"),
        **{arm: (f"{joints[0][0]}Clavicle", *joints) for arm, joints in _ARMS.items()},
    },
}
"""The five parts of each skeleton; every joint except the root is in exactly one of them."""

UNIONS = {"lower": ("right_leg", "left_leg"), "upper": ("torso", "left_arm", "right_arm")}


def known_name(skeleton: Skeleton) -> str:
    """Return the name of the skeleton in `LIMBS` that has the same name, or else the same joints; "" without one."""
    joints = {name for joint, name in enumerate(skeleton.names) if joint != skeleton.root}
    same = (name for name, limbs in LIMBS.items() if joints == {joint for limb in limbs.values() for joint in limb})
    return skeleton.name if skeleton.name in LIMBS else next(same, "")


def body_parts(skeleton: Skeleton, parts: tuple[str, ...]) -> dict[str, tuple[int, ...]]:
    """Return the joints of each part.

    Args:
        skeleton: skeleton.
        parts: names of parts, such as "lower", "upper", "torso", "left_arm", or definitions "name=member+member", where
            a member is a part or a joint.

    Returns:
        Mapping from part to its joints, as ascending indices among all joints except the root.

    Raises:
        ValueError: a part is unknown, or a joint is in no part or in several.
    """
    joints_of: dict[str, tuple[int, ...]] = {}
    for text in parts:
        name, _, members = text.partition("=")
        if not name.isidentifier() or name in joints_of:
            raise ValueError(
                "parts must have different names of letters and digits, such as lower and legs=left_leg+right_leg; "
                f"got {', '.join(parts)}"
            )
        joints_of[name] = places_of(skeleton, (members or name).split("+"))
    joints = [name for j, name in enumerate(skeleton.names) if j != skeleton.root]
    everything = sorted(index for indices in joints_of.values() for index in indices)
    if everything != list(range(len(joints))):
        invalid = [name for index, name in enumerate(joints) if everything.count(index) != 1]
        raise ValueError(
            "every joint except the root must be in exactly one part, but these are in none or in several: "
            f"{', '.join(invalid)}"
        )
    return joints_of


def places_of(skeleton: Skeleton, members: Iterable[str]) -> tuple[int, ...]:
    """Return the indices of joints that are named singly or as parts.

    Args:
        skeleton: skeleton.
        members: names of parts, as in `body_parts`, or of joints.

    Returns:
        Ascending indices among all joints except the root. A joint that is named several times occurs several times.

    Raises:
        ValueError: a name is unknown.
    """
    limbs = LIMBS.get(known_name(skeleton), {})
    joints = [name for j, name in enumerate(skeleton.names) if j != skeleton.root]
    names: list[str] = []
    for member in members:
        for part in UNIONS.get(member, (member,)):
            if part not in limbs and part not in joints:
                choices = ", ".join([*(UNIONS if limbs else ()), *limbs, *joints])
                raise ValueError(
                    f"skeleton {skeleton.name!r} has no part or joint {part!r}; it has {choices}; define "
                    "a part by its joints, as in 'lower=LHip+RHip'"
                )
            names += limbs.get(part, (part,))
    return tuple(sorted(joints.index(part) for part in names))
