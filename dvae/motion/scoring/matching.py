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
    """Map parts to joints, as in {"pelvis": 0, "l hip": 1}; joints that match no part are left out."""
    words: dict[tuple[str, str], int] = {}
    for joint, name in enumerate(names):
        for meant in readings(name):
            words.setdefault(meant, joint)
    for side in ("l", "r"):
        if (side, "radius") in words:  # in Acclaim files, the wrist is the second half of the forearm
            words.pop((side, "wrist"), None)
    found: dict[str, int] = {}

    def take(part: str, side: str, meaning: Sequence[str]) -> None:
        key = f"{side} {part}".strip()
        for word in meaning:
            joint = words.get((side, word))
            if key not in found and joint is not None and joint not in found.values():
                found[key] = joint

    for part, meaning in PARTS.items():
        for side in ("",) if part in _MIDDLE else ("l", "r"):
            take(part, side, meaning.split())
    for part, next_one in _FURTHER.items():  # files do not name the ends of chains; our readers do
        for side in ("",) if part in _MIDDLE else ("l", "r"):
            if f"{side} {part}".strip() in found:
                own = readings(names[found[f"{side} {part}".strip()]])
                take(next_one, side, [f"{word}end" for _, word in own])
    return found


def match(names: Sequence[str], skeleton: Skeleton, said: Mapping[str, str] | None = None) -> list[int]:
    """Return the index of the joint that matches each joint of a skeleton.

    Args:
        names: names of a file's joints.
        skeleton: skeleton whose joints are matched.
        said: mapping from names in the file to names in the skeleton, if names alone are not sufficient.

    Raises:
        ValueError: some joints have no match.
    """
    told = {new: find(names, old) for old, new in (said or {}).items()}
    if unknown := told.keys() - set(skeleton.names):
        raise ValueError(
            f"skeleton {skeleton.name!r} has no joint {min(unknown)!r}; it has {', '.join(skeleton.names)}"
        )
    if set(skeleton.names) - told.keys() <= set(names):
        told = {name: list(names).index(name) for name in skeleton.names if name not in told} | told
    there, meant = parts(names), {joint: part for part, joint in parts(skeleton.names).items()}
    alike = {letters(name): joint for joint, name in enumerate(names)}
    found, lacking = [], []
    for joint, name in enumerate(skeleton.names):
        place = there.get(meant[joint]) if joint in meant else alike.get(letters(name))
        place = told.get(name, place)
        found.append(place)
        if place is None:
            lacking.append(name)
    if lacking:
        raise ValueError(
            f"no joint matches {', '.join(lacking)} of skeleton {skeleton.name!r}; there are {', '.join(names)[:600]}. "
            'Match them with joints={"name there": "name here", ...}'
        )
    return [place for place in found if place is not None]


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
class Kept:
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
    def of(cls, names: Sequence[str], parents: Sequence[int], joints: Sequence[int | str] | Mapping[str, str]) -> Kept:
        """Select joints by index or name, or by a mapping from names to new names.

        The parent of each joint is its nearest kept ancestor.

        Raises:
            ValueError: a joint is unknown or repeated, or the joints do not form one tree.
        """
        renamed = list(joints.values()) if isinstance(joints, Mapping) else None
        chosen = []
        for joint in joints:
            place = find(names, joint) if isinstance(joint, str) else joint
            if not 0 <= place < len(names) or place in chosen:
                raise ValueError(f"joint {joint!r} is not one of {len(names)}, or occurs twice")
            chosen.append(place)
        above = []
        for place in chosen:
            parent = parents[place]
            while parent >= 0 and parent not in chosen:
                parent = parents[parent]
            above.append(chosen.index(parent) if parent >= 0 else -1)
        if len(roots := [names[joint] for joint, parent in zip(chosen, above, strict=True) if parent < 0]) != 1:
            raise ValueError(
                f"the joints that are kept need one common ancestor among them, such as the pelvis; their roots are "
                f"{', '.join(roots)[:600] or 'none'}"
            )
        return cls(tuple(chosen), tuple(renamed or (names[joint] for joint in chosen)), tuple(above))

    @classmethod
    def onto(cls, names: Sequence[str], skeleton: Skeleton, said: Mapping[str, str] | None = None) -> Kept:
        """Select the joints of a known skeleton, which `match` finds by the meaning of their names."""
        return cls(tuple(match(names, skeleton, said)), skeleton.names, skeleton.parents)

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
        places = positions[:, list(self.joints)]
        if rotations is None:
            return places, None, None
        local = to_matrix(torch.from_numpy(rotations).double(), "quaternion")
        world = against_world(parents, local)[:, list(self.joints)]
        above = [joint if parent < 0 else parent for joint, parent in enumerate(self.parents)]
        seen = torch.from_numpy(places).double()
        bones = (world[:, above].mT @ (seen - seen[:, above])[..., None]).squeeze(-1)  # in the frame of the parent
        offsets, loose = offsets_of(self.parents, bones)
        if loose > RIGID:
            return places, None, None
        turns = world[:, above].mT @ world
        root = self.parents.index(-1)
        turns[:, root] = world[:, root]
        return places, continuous(from_matrix(turns, "quaternion")).numpy(), offsets.numpy()
