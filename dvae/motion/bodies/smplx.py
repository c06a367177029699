"""Bodies in files as `smplx` reads them (Pavlakos et al. 2019, arXiv 1904.05866): SMPL, SMPL-H and SMPL-X as npz.

The files are their users', under licences of their own; none comes with this. What is read are six plain arrays: the
template, its changes by shape, the regressor of joints, weights, the tree and faces. Pickled members are never opened,
and corrections by pose, expressions and soft tissue are left out.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from ..files.archive import archive
from ..files.smpl import JOINTS, PARENTS
from .skinning import Body

LARGEST = 2**27
"""Bytes of an array that is read; the largest of SMPL-X has three quarters of it."""

MOST_VERTICES = 2**17
"""SMPL-X has a twelfth of them."""

FURTHEST = 1e3
"""Of a body's numbers, none of which is more in metres or shares."""

_MEMBERS: dict[str, tuple[str | int, ...]] = {  # and their axes: vertices, shape parameters, joints, faces
    "v_template": ("V", 3),
    "shapedirs": ("V", 3, "S"),
    "J_regressor": ("J", "V"),
    "weights": ("V", "J"),
    "kintree_table": (2, "J"),
    "f": ("F", 3),
}


def read_body(path: str | Path, shapes: int = 8) -> Body:
    """Read a model file, npz, of SMPL, SMPL-H or SMPL-X.

    The body has the 22 joints of trunk and limbs that these share. Fingers, jaw and eyes are not turned, and what is
    not turned moves with the joint that it hangs from: their weights are that one's.

    Args:
        path: the file.
        shapes: how many parameters of shape to keep, the first of the file's.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged, larger than any body, or no body.
    """
    path = Path(path)
    with archive(path) as members:
        if missing := [name for name in _MEMBERS if name not in members]:
            raise ValueError(f"{path}: no body, which has {', '.join(_MEMBERS)}; it lacks {', '.join(missing)}")
        for name in _MEMBERS:
            if members[name].size > LARGEST:
                raise ValueError(f"{path}: {name} has {members[name].size:,} bytes, of a body at most {LARGEST:,}")
        found = {name: members[name].array() for name in _MEMBERS}
    if reason := _defect(found, shapes):
        raise ValueError(f"{path}: {reason}")
    tensors = [torch.from_numpy(found[name].astype(np.float32)) for name in ("v_template", "J_regressor", "weights")]
    template, regressor, weights = tensors
    changes = torch.from_numpy(found["shapedirs"][..., :shapes].astype(np.float32))
    faces = torch.from_numpy(found["f"].astype(np.int64))
    goes_with = list(range(len(JOINTS)))
    for parent in found["kintree_table"][0, len(JOINTS) :]:
        goes_with.append(goes_with[int(parent)])
    kept = torch.zeros(len(template), len(JOINTS)).index_add(1, torch.tensor(goes_with), weights)
    return Body(JOINTS, PARENTS, template, changes, regressor[: len(JOINTS)], kept, faces)


def _defect(found: dict[str, np.ndarray], shapes: int) -> str:
    """Why arrays are no body; nothing if they are one."""
    sizes: dict[str | int, int] = {2: 2, 3: 3}
    for name, axes in _MEMBERS.items():
        array, whole = found[name], name in ("kintree_table", "f")
        for axis, size in zip(axes, array.shape, strict=False):
            sizes.setdefault(axis, size)
        expected = tuple(sizes.get(axis, 0) for axis in axes)
        if array.shape != expected or not array.size or array.dtype.kind not in ("iu" if whole else "fiu"):
            kind = "whole numbers" if whole else "numbers"
            return f"{name} holds {array.dtype} {array.shape}, expected {kind} ({', '.join(map(str, axes))})"
        if not whole and not (np.abs(array) <= FURTHEST).all():
            return f"{name} holds numbers that are NaN or beyond {FURTHEST:g}"
    if sizes["V"] > MOST_VERTICES:
        return f"it has {sizes['V']:,} vertices, of a body at most {MOST_VERTICES:,}"
    if not 1 <= shapes <= sizes["S"]:
        return f"it has {sizes['S']} parameters of shape, not {shapes}; say how many with shapes="
    parents = found["kintree_table"][0].astype(np.int64)
    if tuple(parents[1 : len(JOINTS)]) != PARENTS[1:] or not (parents[1:] < np.arange(1, len(parents))).all():
        return f"its tree is not SMPL's, of whose joints the first are {', '.join(JOINTS)}"
    if (parents[1:] < 0).any() or found["f"].min() < 0 or found["f"].max() >= sizes["V"]:
        return f"a face or a joint hangs on what is not there; it has {sizes['V']} vertices"
    for name in ("weights", "J_regressor"):
        if not np.allclose(found[name].astype(np.float64).sum(1), 1, atol=1e-3):
            return f"{name} are shares, and do not add up to 1"
    return ""
