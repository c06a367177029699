"""A body file and recordings in the layouts of SMPL and AMASS, made up: neither body nor motion is from there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dvae.motion.files.smpl import JOINTS, PARENTS

GIRTH = 1
"""Shape parameter that moves no joint."""

_PLACES = {  # joints at rest in metres: the left ones at +x; the pelvis is not at the origin
    "Pelvis": (0.0, -0.22, 0.03),
    "Hip": (0.07, -0.31, 0.02),
    "Spine1": (0.0, -0.11, 0.0),
    "Knee": (0.1, -0.69, 0.02),
    "Spine2": (0.0, 0.02, 0.01),
    "Ankle": (0.09, -1.09, -0.03),
    "Spine3": (0.0, 0.08, 0.0),
    "Foot": (0.12, -1.15, 0.09),
    "Neck": (0.0, 0.29, -0.02),
    "Collar": (0.08, 0.19, -0.01),
    "Head": (0.0, 0.36, 0.03),
    "Shoulder": (0.18, 0.23, -0.02),
    "Elbow": (0.44, 0.21, -0.04),
    "Wrist": (0.69, 0.22, -0.05),
}
_CORNERS = 0.04 * np.concatenate([np.eye(3), -np.eye(3)])
_FACES = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])


def write_body(path: Path, joints: int = 52, shapes: int = 16, seed: int = 0) -> None:
    """Write a body with 24 (SMPL), 52 (SMPL-H) or 55 (SMPL-X) joints, each in the middle of an octahedron."""
    random = np.random.default_rng(seed)
    mirror = [np.array([-1.0 if name.startswith("R_") else 1.0, 1, 1]) for name in JOINTS]
    places = [side * _PLACES[name.split("_")[-1]] for name, side in zip(JOINTS, mirror, strict=True)]
    parents = [*PARENTS]
    wrists = [JOINTS.index(f"{side}_Wrist") for side in "LR"]
    fingers = joints - len(JOINTS)
    for n in range(fingers):  # SMPL has one joint for each hand, and SMPL-X has jaw and eyes first
        in_head = joints == 55 and n < 3
        parents.append(JOINTS.index("Head") if in_head else wrists[2 * n // fingers])
        places.append(places[parents[-1]] + random.normal(0, 0.03, 3))
    rest, corners = np.array(places), len(_CORNERS)
    template = (rest[:, None] + _CORNERS).reshape(-1, 3)
    moves = 0.006 * random.normal(size=(joints, 3, shapes))
    moves[..., 0] = 0.04 * rest
    moves[..., GIRTH] = 0
    changes = np.repeat(moves, corners, axis=0)
    changes[..., GIRTH] = np.tile(0.2 * _CORNERS, (joints, 1))
    own = np.repeat(np.eye(joints), corners, axis=0)
    above = np.repeat(np.eye(joints)[[max(parent, 0) for parent in parents]], corners, axis=0)
    faces = np.concatenate([_FACES + corners * joint for joint in range(joints)])
    np.savez(
        path,
        v_template=template,
        shapedirs=changes,
        posedirs=np.zeros((len(template), 3, 9 * (joints - 1))),
        J_regressor=np.repeat(np.eye(joints), corners, axis=1) / corners,
        weights=0.7 * own + 0.3 * above,
        kintree_table=np.array([parents, range(joints)]).astype(np.uint32),
        f=faces.astype(np.uint32),
        bs_type=np.array("lrotmin"),
    )


def write_recordings(folder: Path, takes: dict[str, str], seconds: float = 4.0, seed: int = 0) -> None:
    """Write walks, z up; the body of each has its own betas.

    Args:
        folder: folder of the recordings.
        takes: gender by path without suffix, such as "SFU/0005/walk".
    """
    random = np.random.default_rng(seed)
    for take, gender in takes.items():
        fps, period, heading = 60.0, random.uniform(0.9, 1.2), random.uniform(-3, 3)
        times = np.arange(round(seconds * fps)) / fps
        phase = 2 * np.pi * times / period
        vectors = np.zeros((len(times), 52, 3))
        for name, axis, height, lag in (
            *(("L_Hip", 0, 0.5, 0.0), ("R_Hip", 0, 0.5, np.pi), ("L_Shoulder", 1, 0.3, np.pi)),
            *(("R_Shoulder", 1, 0.3, 0.0), ("L_Wrist", 2, 0.4, 0.3), ("R_Wrist", 0, 0.3, 0.9)),
            *(("Head", 1, 0.3, 0.2), ("Spine2", 1, 0.1, 0.0), ("L_Ankle", 0, 0.2, 1.0), ("R_Ankle", 0, 0.2, 4.1)),
        ):
            vectors[:, JOINTS.index(name), axis] = -random.uniform(0.9, 1.1) * height * np.sin(phase + lag)
        for name, lag in (("L_Knee", 0.7), ("R_Knee", 0.7 + np.pi)):
            vectors[:, JOINTS.index(name), 0] = 0.4 + 0.4 * np.sin(phase + lag)
        upright = Rotation.from_euler("x", np.pi / 2)  # from y up to z up; a person then faces -y
        vectors[:, 0] = (
            Rotation.from_rotvec(np.outer(heading + 0.05 * np.sin(phase), [0, 0, 1])) * upright
        ).as_rotvec()
        ahead = 1.2 * np.outer(times, [np.sin(heading), -np.cos(heading), 0])
        path = (folder / take).with_suffix(".npz")
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(
            path,
            poses=vectors.reshape(len(times), -1),
            trans=ahead + [0.3, -0.2, 1.1] + 0.02 * np.sin(2 * phase)[:, None] * [0, 0, 1],
            betas=random.normal(size=16),
            dmpls=np.zeros((len(times), 8)),
            gender=np.array(gender),
            mocap_framerate=np.array(fps),
        )
