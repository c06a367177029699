"""AMASS's layout (Mahmood et al. 2019, arXiv 1904.03278): rotations of SMPL's joints, without the SMPL body.

The files contain no bone lengths. These depend on the SMPL body, which has its own licence, and on the shape parameters
`betas`, which each clip stores as a label (`bodies.betas` reads it). Without the SMPL body, all people have one average
body with a height of 1.7 m. Its segment lengths are from Drillis and Contini (1966), in figure 4.1 of Winter,
Biomechanics and Motor Control of Human Movement. The pelvis position is correct up to a constant, because SMPL adds the
position of its template to `trans`. `bodies.fit_to_body` puts such motion on an SMPL body exactly. Files written here
also contain `offsets`, which are used when they are read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ... import files
from ...data.npy import NpyError
from ..data.clips import Clip, MotionSet
from ..geometry.kinematics import inverse
from ..geometry.rotations import from_matrix, to_matrix
from ..geometry.skeleton import Skeleton, brief, is_name
from ..naming import sides
from ..scoring.matching import JointSubset, against_world, parts
from .archive import archive, write_arrays
from .recording import Recording, check_size

_HEIGHT = 1.7
_BODY = {  # joint, parent, offset relative to the height: left is +x, y up, facing +z
    "Pelvis": ("", 0, 0, 0),
    "L_Hip": ("Pelvis", 0.0955, 0, 0),
    "R_Hip": ("Pelvis", -0.0955, 0, 0),
    "Spine1": ("Pelvis", 0, 0.072, 0),
    "L_Knee": ("L_Hip", 0, -0.245, 0),
    "R_Knee": ("R_Hip", 0, -0.245, 0),
    "Spine2": ("Spine1", 0, 0.072, 0),
    "L_Ankle": ("L_Knee", 0, -0.246, 0),
    "R_Ankle": ("R_Knee", 0, -0.246, 0),
    "Spine3": ("Spine2", 0, 0.072, 0),
    "L_Foot": ("L_Ankle", 0, -0.039, 0.076),
    "R_Foot": ("R_Ankle", 0, -0.039, 0.076),
    "Neck": ("Spine3", 0, 0.072, 0),
    "L_Collar": ("Spine3", 0.043, 0.072, 0),
    "R_Collar": ("Spine3", -0.043, 0.072, 0),
    "Head": ("Neck", 0, 0.052, 0),
    "L_Shoulder": ("L_Collar", 0.0865, 0, 0),
    "R_Shoulder": ("R_Collar", -0.0865, 0, 0),
    "L_Elbow": ("L_Shoulder", 0.186, 0, 0),
    "R_Elbow": ("R_Shoulder", -0.186, 0, 0),
    "L_Wrist": ("L_Elbow", 0.146, 0, 0),
    "R_Wrist": ("R_Elbow", -0.146, 0, 0),
}
JOINTS = tuple(_BODY)
PARENTS = tuple(JOINTS.index(parent) if parent else -1 for parent, *_ in _BODY.values())
OFFSETS = _HEIGHT * np.array([place for _, *place in _BODY.values()], float)
"""Offsets (22, 3) in metres of the average body, standing with arms at its sides."""

MOST_BETAS = 16
"""Maximum number of shape parameters in AMASS's files."""

_FPS = ("mocap_framerate", "mocap_frame_rate")


def read_amass(path: str | Path) -> Recording:
    """Read an npz of AMASS: the 22 joints of the body, z up.

    `betas` becomes a label of space-separated numbers, and `gender` a label. Hands and soft tissue are left out.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file has another layout, or is damaged.
    """
    path = Path(path)
    with archive(path) as members:
        if not {"poses", "trans"} <= members.keys():
            raise NpyError(
                f"it contains {', '.join(sorted(members)[:6]) or 'nothing'}, expected AMASS's poses and trans; "
                "npz files of another layout are read one by one, not as a folder; "
                f"`dvae data convert {path.parent}/*.npz --out ALL.npz` joins npz files that dvae wrote"
            )
        names = ("poses", "trans", "offsets", "betas", *_FPS)
        arrays = {name: members[name].array() for name in names if name in members}
        has_gender = "gender" in members and members["gender"].kind in "US"  # pickled in some files
        gender = members["gender"].array() if has_gender else np.zeros(0)
    poses, places = arrays["poses"], arrays["trans"]
    frames, numbers = len(places) if places.ndim else 0, 3 * len(JOINTS)
    if not (poses.ndim == 2 and len(poses) == frames > 0 and poses.shape[1] >= numbers and places.shape == (frames, 3)):
        raise ValueError(
            f"{path}: poses have shape {poses.shape} and trans {places.shape}, expected "
            f"(frames, {numbers} or more) and (frames, 3)"
        )
    check_size(path, frames, len(JOINTS))
    if "offsets" in arrays and arrays["offsets"].shape != (len(JOINTS), 3):
        raise ValueError(f"{path}: offsets have shape {arrays['offsets'].shape}, expected {(len(JOINTS), 3)}")
    for name, values in arrays.items():
        if values.dtype.kind not in "fiu" or not np.isfinite(values).all():
            raise ValueError(
                f"{path}: {name} has dtype {values.dtype}, or NaN or infinite values; expected finite numbers"
            )
        if (np.abs(values.astype(np.float64)) > 1e6).any():
            raise ValueError(
                f"{path}: {name} has the value {np.abs(values).max():g}; expected metres, radians or a rate up to 1e6"
            )
    rate = next((arrays[name] for name in _FPS if name in arrays), np.zeros(0))
    fps = float(rate.reshape(-1)[0]) if rate.size == 1 else 0.0
    if not fps > 0:
        raise ValueError(f"{path}: mocap_framerate must be a positive number of frames per second")
    offsets = arrays.get("offsets", OFFSETS).astype(np.float64)
    vectors = torch.from_numpy(poses[:, :numbers].astype(np.float64)).unflatten(-1, (-1, 3))
    rest = torch.from_numpy(offsets).repeat(frames, 1, 1)
    rest[:, 0] = torch.from_numpy(places.astype(np.float64))
    recording = Recording.turned(JOINTS, PARENTS, rest, to_matrix(vectors, "vector"), fps, metres=1.0, up="z")
    betas = arrays.get("betas", np.zeros(0)).reshape(-1)[:MOST_BETAS]
    labels = {"betas": " ".join(map(str, betas.tolist()))} if betas.size else {}
    if gender.size == 1:
        word: Any = gender.item()
        name = word if isinstance(word, str) else word.decode("ascii", "replace")
        if not is_name(name):
            raise ValueError(f"{path}: gender is {brief(name)}, expected a word")
        labels["gender"] = name
    return replace(recording, labels=labels)


def has_smpl_rest(skeleton: Skeleton) -> bool:
    """Return whether rotations of a skeleton refer to SMPL's own rest pose, as in a file of AMASS without `offsets`."""
    if (skeleton.names, skeleton.parents) != (JOINTS, PARENTS) or not skeleton.rest:
        return False
    return bool(np.abs(np.array(skeleton.rest).reshape(OFFSETS.shape) - OFFSETS).max() < 1e-5)


def write_amass(path: str | Path, clip: Clip, skeleton: Skeleton) -> None:
    """Write a clip in AMASS's layout: poses (F, 156), trans, mocap_framerate, offsets, betas and gender.

    Betas and gender are labels of the clip, by default zeros and neutral.

    Joints are matched by name; SMPL joints that the skeleton does not have keep the identity rotation. If a bone
    between two matched joints is not rigid, all rotations are estimated from positions, as in
    `MotionSet.with_rotations`.

    Args:
        path: npz file.
        clip: clip with rotations.
        skeleton: skeleton with their rest pose.

    Raises:
        ValueError: no joint is the pelvis.
    """
    joint_of_part = parts(skeleton.names)
    joint_of_name = {name: joint_of_part[part] for part, name in _part_names().items() if part in joint_of_part}
    if "Pelvis" not in joint_of_name:
        raise ValueError(
            f"{path}: no joint is the pelvis, which AMASS requires; the joints are {', '.join(skeleton.names)[:600]}"
        )
    names = [name for name in JOINTS if name in joint_of_name]
    parents_of_names = [_above(name, names) for name in names]
    parents = [names.index(parent) if parent else -1 for parent in parents_of_names]
    subset = JointSubset(tuple(joint_of_name[name] for name in names), tuple(names), tuple(parents))
    positions, rotations, offsets = subset.motion(skeleton.parents, clip.positions.astype(np.float64), clip.rotations)
    if rotations is None or offsets is None:  # a bone between these joints is not rigid, usually in the back
        tree = Skeleton(subset.names, subset.parents, *sides(names), skeleton.up, skeleton.fps)
        single = MotionSet([Clip("", "", positions)], tree).with_rotations()
        rotations, offsets = np.asarray(single.clips[0].rotations, np.float64), single.skeleton.offsets.numpy()
    offsets[0] = 0
    stood = _standing(names, parents)
    tree = Skeleton(tuple(names), tuple(parents))
    raised = inverse(tree, torch.from_numpy(stood)[None], torch.from_numpy(offsets))
    raised = against_world(parents, raised)  # of each joint, from the rest pose to arms at the sides
    world = against_world(parents, to_matrix(torch.from_numpy(rotations), "quaternion"))
    places = torch.from_numpy(clip.positions[:, joint_of_name["Pelvis"]].astype(np.float64))
    if skeleton.up == "y":
        up = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
        world, places = up @ world, places @ up.T
    world = world @ raised.mT
    bones = (raised[:, [max(parent, 0) for parent in parents]] @ torch.from_numpy(offsets)[..., None])[0, ..., 0]
    smpl_rotations = torch.eye(3, dtype=torch.float64).repeat(len(world), len(JOINTS), 1, 1)
    all_offsets = np.zeros_like(OFFSETS)
    for index, (name, parent) in enumerate(zip(names, parents, strict=True)):
        smpl_rotations[:, JOINTS.index(name)] = world[:, index] if parent < 0 else world[:, parent].mT @ world[:, index]
        all_offsets[JOINTS.index(name)] = bones[index]
    poses = np.zeros((len(world), 156))
    poses[:, : 3 * len(JOINTS)] = from_matrix(smpl_rotations, "vector").flatten(1).numpy()
    betas = np.array([float(value) for value in clip.labels.get("betas", "").split()] or [0.0] * 16)
    arrays = {"poses": poses, "trans": places.numpy(), "betas": betas, "offsets": all_offsets}
    arrays |= {"mocap_framerate": np.array(skeleton.fps), "gender": np.array(clip.labels.get("gender", "neutral"))}
    with files.atomic_write(path) as file:
        write_arrays(file, arrays.items())


def _part_names() -> dict[str, str]:
    return {part: JOINTS[joint] for part, joint in parts(JOINTS).items()}


def _above(name: str, names: Sequence[str]) -> str:
    """Return the nearest ancestor among these names."""
    parent = _BODY[name][0]
    while parent and parent not in names:
        parent = _BODY[parent][0]
    return parent


def _standing(names: Sequence[str], parents: Sequence[int]) -> np.ndarray:
    """Return positions of the named joints of the average body."""
    places: dict[str, np.ndarray] = {"": np.zeros(3)}
    for (name, (parent, *_)), offset in zip(_BODY.items(), OFFSETS, strict=True):
        places[name] = places[parent] + offset
    return np.stack([places[name] for name in names])
