"""Joints of one skeleton by those of another: names that mean the same, and motion put onto fewer joints."""

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
"""Metres by which a bone between kept joints may change and still count as one."""

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
"""Parts of the body and how files call them, the surest first. A joint stands for one part: who has an ankle and a foot
has a toe there, and who has an arm and a shoulder a clavicle."""

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
"""What is at the end of a bone that begins at a part."""


def parts(names: Sequence[str]) -> dict[str, int]:
    """Which joint is which part, as in {"pelvis": 0, "l hip": 1}; joints that mean no part are left out."""
    words: dict[tuple[str, str], int] = {}
    for joint, name in enumerate(names):
        for meant in readings(name):
            words.setdefault(meant, joint)
    for side in ("l", "r"):
        if (side, "radius") in words:  # Acclaim's, in which the wrist is the second half of the forearm
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
    for part, next_one in _FURTHER.items():  # files do not name ends, readers do
        for side in ("",) if part in _MIDDLE else ("l", "r"):
            if f"{side} {part}".strip() in found:
                own = readings(names[found[f"{side} {part}".strip()]])
                take(next_one, side, [f"{word}end" for _, word in own])
    return found


def match(names: Sequence[str], skeleton: Skeleton, said: Mapping[str, str] | None = None) -> list[int]:
    """Which of the joints of these names each joint of a skeleton is.

    Args:
        names: of a file's joints.
        skeleton: whose joints are looked for.
        said: a file's name to the skeleton's, where names alone do not tell.

    Raises:
        ValueError: some are not found.
    """
    told = {new: find(names, old) for old, new in (said or {}).items()}
    if unknown := told.keys() - set(skeleton.names):
        raise ValueError(f"skeleton {skeleton.name!r} has no joint {min(unknown)!r}, but {', '.join(skeleton.names)}")
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
            f"no joint is {', '.join(lacking)} of skeleton {skeleton.name!r}; there are {', '.join(names)[:600]}. "
            'Say which is which by joints={"name there": "name here", ...}'
        )
    return [place for place in found if place is not None]


def against_world(parents: Sequence[int], rotations: Tensor) -> Tensor:
    """Turns (F, J, 3, 3) against the world, of those of joints against their parents."""
    nowhere = rotations.new_zeros(len(parents), 3)
    return forward(parents, rotations, nowhere, rotations.new_zeros(len(rotations), 3))[1]


def offsets_of(parents: Sequence[int], bones: Tensor) -> tuple[Tensor, float]:
    """Mean places (J, 3) of joints against their parents, the root's 0; and how far one goes from its own.

    Args:
        parents: of the joints, -1 for the root.
        bones: (F, J, 3), as parents see them.
    """
    bones = torch.where(torch.tensor(parents)[:, None] < 0, 0.0, bones)
    offsets = bones[0] + (bones - bones[0]).mean(0)  # what does not change is kept to the last bit
    return offsets, float((bones - offsets).norm(dim=-1).max())


def find(names: Sequence[str], joint: str) -> int:
    """Place of a joint by its name as a file has it.

    Raises:
        ValueError: there is none.
    """
    if joint not in names:
        raise ValueError(f"no joint {joint!r}; there are {', '.join(names)[:600]}")
    return list(names).index(joint)


@dataclass(frozen=True)
class Kept:
    """Joints that are kept of a skeleton, and what tree they make.

    Args:
        joints: their places.
        names: what they are called now.
        parents: by place among these, -1 for the root.
    """

    joints: tuple[int, ...]
    names: tuple[str, ...]
    parents: tuple[int, ...]

    @classmethod
    def of(cls, names: Sequence[str], parents: Sequence[int], joints: Sequence[int | str] | Mapping[str, str]) -> Kept:
        """Some joints, by place or name; or by name with a new one. Each hangs from its nearest ancestor that is kept.

        Raises:
            ValueError: an unknown joint, or one twice; or they do not hang together.
        """
        renamed = list(joints.values()) if isinstance(joints, Mapping) else None
        chosen = []
        for joint in joints:
            place = find(names, joint) if isinstance(joint, str) else joint
            if not 0 <= place < len(names) or place in chosen:
                raise ValueError(f"joint {joint!r} is none of {len(names)}, or there twice")
            chosen.append(place)
        above = []
        for place in chosen:
            parent = parents[place]
            while parent >= 0 and parent not in chosen:
                parent = parents[parent]
            above.append(chosen.index(parent) if parent >= 0 else -1)
        if len(roots := [names[joint] for joint, parent in zip(chosen, above, strict=True) if parent < 0]) != 1:
            raise ValueError(
                f"joints that are kept need one from which the others hang, such as the pelvis; these hang from "
                f"{', '.join(roots)[:600] or 'none'}"
            )
        return cls(tuple(chosen), tuple(renamed or (names[joint] for joint in chosen)), tuple(above))

    @classmethod
    def onto(cls, names: Sequence[str], skeleton: Skeleton, said: Mapping[str, str] | None = None) -> Kept:
        """The joints of a known skeleton, found by what their names mean; see `match`."""
        return cls(tuple(match(names, skeleton, said)), skeleton.names, skeleton.parents)

    def motion(
        self, parents: Sequence[int], positions: np.ndarray, rotations: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
        """Their positions; and their rotations and offsets, or none where a bone between two of them bends.

        Args:
            parents: of all joints.
            positions: (F, J, 3) of all joints in metres.
            rotations: (F, J, 4) of all joints against their parents, quaternions.
        """
        places = positions[:, list(self.joints)]
        if rotations is None:
            return places, None, None
        local = to_matrix(torch.from_numpy(rotations).double(), "quaternion")
        world = against_world(parents, local)[:, list(self.joints)]
        above = [joint if parent < 0 else parent for joint, parent in enumerate(self.parents)]
        seen = torch.from_numpy(places).double()
        bones = (world[:, above].mT @ (seen - seen[:, above])[..., None]).squeeze(-1)  # as the parent sees them
        offsets, loose = offsets_of(self.parents, bones)
        if loose > RIGID:
            return places, None, None
        turns = world[:, above].mT @ world
        root = self.parents.index(-1)
        turns[:, root] = world[:, root]
        return places, continuous(from_matrix(turns, "quaternion")).numpy(), offsets.numpy()
