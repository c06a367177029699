"""Match the joints of two skeletons by the meaning of their names, and reduce motion to a subset of joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..geometry.kinematics import forward
from ..geometry.rotations import continuous, from_matrix, to_matrix
from ..geometry.skeleton import Skeleton
from ..naming import letters, readings

RIGID = 1e-3
"""Tolerance in metres within which a bone between kept joints counts as rigid."""

PARTS = {
    "pelvis": "hips hip pelvis root midhip",
    "knee": "knee shin tibia calf lowerleg lowleg leg",
    "hip": "upleg upperleg thigh femur hip",
    "ankle": "ankle foot",
    "toe": "toe toes toebase ball foot",
    "spine": "spine abdomen ab spine1 upperback lowerback torso back",
    "chest": "chest thorax spine3 spine2 upperchest spine1 upperback",
    "neck": "neck lowerneck neck1",
    "upperneck": "upperneck neck1 neck2",
    "head": "head skull",
    "headtop": "headtop topofhead headtopend headend vertex",
    "shoulder": "humerus upperarm uparm arm shldr shoulder",
    "clavicle": "clavicle collar collarbone shoulder",
    "elbow": "elbow forearm lowerarm lowarm radius",
    "wrist": "fingerbase wrist hand",
    "hand": "hand fingers",
}
"""Parts of the body and their names in files, the most specific first.

A joint is matched to one part. A skeleton with an ankle and a foot uses the foot as toe; one with an arm and a
shoulder uses the shoulder as clavicle."""

_MIDDLE = ("pelvis", "spine", "chest", "neck", "upperneck", "head", "headtop")
_FURTHER = {"hip": "knee", "knee": "ankle", "ankle": "toe", "elbow": "wrist", "shoulder": "elbow", "wrist": "hand"}
_FURTHER |= {
    "pelvis": "spine",
    "spine": "chest",
    "chest": "neck",
    "neck": "head",
    "upperneck": "head",
    "head": "headtop",
}
"""The part at the far end of a bone that begins at a part."""


def parts(names: Sequence[str]) -> dict[str, int]:
    """Map body parts to indices of joints, as in {"pelvis": 0, "l hip": 1}; joints that match no part are left out."""
    words: dict[tuple[str, str], int] = {}
    for joint, name in enumerate(names):
        for reading in readings(name):
            words.setdefault(reading, joint)
    for side in ("l", "r"):
        if (side, "radius") in words:  # in Acclaim files, the wrist is the second half of the forearm
            words.pop((side, "wrist"), None)
    joint_of: dict[str, int] = {}

    def take(part: str, side: str, meaning: Sequence[str]) -> None:
        key = f"{side} {part}".strip()
        for word in meaning:
            joint = words.get((side, word))
            if key not in joint_of and joint is not None and joint not in joint_of.values():
                joint_of[key] = joint

    for part, meaning in PARTS.items():
        for side in ("",) if part in _MIDDLE else ("l", "r"):
            take(part, side, meaning.split())
    for part, next_one in _FURTHER.items():  # files do not name the ends of chains; our readers do
        for side in ("",) if part in _MIDDLE else ("l", "r"):
            if f"{side} {part}".strip() in joint_of:
                end_readings = readings(names[joint_of[f"{side} {part}".strip()]])
                take(next_one, side, [f"{word}end" for _, word in end_readings])
    return joint_of


def match(names: Sequence[str], skeleton: Skeleton, aliases: Mapping[str, str] | None = None) -> list[int]:
    """Return the index of the joint that matches each joint of a skeleton.

    Args:
        names: names of a file's joints.
        skeleton: skeleton whose joints are matched.
        aliases: mapping from names in the file to names in the skeleton, for joints whose names do not match.

    Raises:
        ValueError: some joints have no match.
    """
    assigned = {new: find(names, old) for old, new in (aliases or {}).items()}
    if unknown := assigned.keys() - set(skeleton.names):
        raise ValueError(
            f"skeleton {skeleton.name!r} has no joint {min(unknown)!r}; it has {', '.join(skeleton.names)}"
        )
    if set(skeleton.names) - assigned.keys() <= set(names):
        assigned = {name: list(names).index(name) for name in skeleton.names if name not in assigned} | assigned
    source_parts, target_parts = parts(names), {joint: part for part, joint in parts(skeleton.names).items()}
    joints_by_letters = {letters(name): joint for joint, name in enumerate(names)}
    matches, unmatched = [], []
    for joint, name in enumerate(skeleton.names):
        index = source_parts.get(target_parts[joint]) if joint in target_parts else joints_by_letters.get(letters(name))
        index = assigned.get(name, index)
        matches.append(index)
        if index is None:
            unmatched.append(name)
    if unmatched:
        raise ValueError(
            f"no joint matches {', '.join(unmatched)} of skeleton {skeleton.name!r}; there are "
            f"{', '.join(names)[:600]}. Match them with "
            'joints={"name in the file": "name in the skeleton", ...}'
        )
    return [index for index in matches if index is not None]


def against_world(parents: Sequence[int], rotations: Tensor) -> Tensor:
    """Return rotations (F, J, 3, 3) relative to the world, from rotations relative to the parents."""
    nowhere = rotations.new_zeros(len(parents), 3)
    return forward(parents, rotations, nowhere, rotations.new_zeros(len(rotations), 3))[1]


def offsets_of(parents: Sequence[int], bones: Tensor) -> tuple[Tensor, float]:
    """Return mean offsets (J, 3) of joints from their parents, zero for the root, and the largest deviation from them.

    Args:
        parents: index of each joint's parent, -1 for the root.
        bones: (F, J, 3), offsets in the frames of the parents.
    """
    bones = torch.where(torch.tensor(parents)[:, None] < 0, 0.0, bones)
    offsets = bones[0] + (bones - bones[0]).mean(0)  # exact if the offsets are constant
    return offsets, float((bones - offsets).norm(dim=-1).max())


def find(names: Sequence[str], joint: str) -> int:
    """Return the index of a joint by its exact name.

    Raises:
        ValueError: the name is unknown.
    """
    if joint not in names:
        raise ValueError(f"no joint {joint!r}; there are {', '.join(names)[:600]}")
    return list(names).index(joint)


@dataclass(frozen=True)
class JointSubset:
    """A subset of the joints of a skeleton, and its tree.

    Args:
        joints: indices of the joints.
        names: new names of the joints.
        parents: index of each joint's parent among the kept joints, -1 for the root.
    """

    joints: tuple[int, ...]
    names: tuple[str, ...]
    parents: tuple[int, ...]

    @classmethod
    def of(
        cls, names: Sequence[str], parents: Sequence[int], joints: Sequence[int | str] | Mapping[str, str]
    ) -> JointSubset:
        """Select joints by index or name, or by a mapping from names to new names.

        The parent of each joint is its nearest kept ancestor.

        Raises:
            ValueError: a joint is unknown or repeated, or the joints do not form one tree.
        """
        renamed = list(joints.values()) if isinstance(joints, Mapping) else None
        selected = []
        for joint in joints:
            index = find(names, joint) if isinstance(joint, str) else joint
            if not 0 <= index < len(names) or index in selected:
                raise ValueError(f"joint {joint!r} is not one of the {len(names)} joints, or is selected twice")
            selected.append(index)
        parents_of = []
        for index in selected:
            parent = parents[index]
            while parent >= 0 and parent not in selected:
                parent = parents[parent]
            parents_of.append(selected.index(parent) if parent >= 0 else -1)
        roots = [names[joint] for joint, parent in zip(selected, parents_of, strict=True) if parent < 0]
        if len(roots) != 1:
            raise ValueError(
                "one of the kept joints must be an ancestor of all others, such as the pelvis; now there are the roots "
                f"{', '.join(roots)[:600] or 'none'}"
            )
        return cls(tuple(selected), tuple(renamed or (names[joint] for joint in selected)), tuple(parents_of))

    @classmethod
    def onto(cls, names: Sequence[str], skeleton: Skeleton, aliases: Mapping[str, str] | None = None) -> JointSubset:
        """Select the joints of a known skeleton, which `match` finds by the meaning of their names."""
        return cls(tuple(match(names, skeleton, aliases)), skeleton.names, skeleton.parents)

    def motion(
        self, parents: Sequence[int], positions: np.ndarray, rotations: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
        """Return positions, rotations and offsets of the kept joints.

        Rotations and offsets are None if the motion has no rotations, or if a bone between two kept joints is not
        rigid.

        Args:
            parents: parents of all joints.
            positions: (F, J, 3) of all joints in metres.
            rotations: (F, J, 4) of all joints relative to their parents, as quaternions.
        """
        selected = positions[:, list(self.joints)]
        if rotations is None:
            return selected, None, None
        local = to_matrix(torch.from_numpy(rotations).double(), "quaternion")
        world = against_world(parents, local)[:, list(self.joints)]
        above = [joint if parent < 0 else parent for joint, parent in enumerate(self.parents)]
        points = torch.from_numpy(selected).double()
        bones = (world[:, above].mT @ (points - points[:, above])[..., None]).squeeze(-1)  # in the frame of the parent
        offsets, loose = offsets_of(self.parents, bones)
        if loose > RIGID:
            return selected, None, None
        rotations_kept = world[:, above].mT @ world
        root = self.parents.index(-1)
        rotations_kept[:, root] = world[:, root]
        return selected, continuous(from_matrix(rotations_kept, "quaternion")).numpy(), offsets.numpy()
