"""Bodies in files of `smplx` (Pavlakos et al. 2019, arXiv 1904.05866): SMPL, SMPL-H and SMPL-X as npz.

Users must obtain the files themselves, under their own licences. Six plain arrays are read: template, changes by shape,
joint regressor, weights, tree and faces. Pickled members are never opened. Pose corrections, expressions and soft
tissue are ignored.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numpy as np
import torch

from ..files.archive import archive
from ..files.smpl import JOINTS, PARENTS
from .lofted import human
from .skinning import Body, BodySource

LARGEST = 2**27
"""Maximum size of an array in bytes; the largest array of SMPL-X has three quarters of this size."""

MOST_VERTICES = 2**17
"""Maximum number of vertices; SMPL-X has a twelfth of this number."""

FURTHEST = 1e3
"""Maximum absolute value in an array; positions in metres and weights are far smaller."""

SMPLX_JOINTS = 55
"""Number of joints of SMPL-X, whose expressions follow the shape parameters in `shapedirs`."""

_MEMBERS: dict[str, tuple[str | int, ...]] = {  # member -> its axes: vertices, shape parameters, joints, faces
    "v_template": ("V", 3),
    "shapedirs": ("V", 3, "S"),
    "J_regressor": ("J", "V"),
    "weights": ("V", "J"),
    "kintree_table": (2, "J"),
    "f": ("F", 3),
}


def read_body(path: str | os.PathLike[str], shapes: int = 8) -> Body:
    """Read a model file, npz, of SMPL, SMPL-H or SMPL-X.

    The body has the 22 joints of trunk and limbs that these models share. Fingers, jaw and eyes are not rotated: their
    weights are added to the nearest ancestor among the 22 joints.

    Args:
        path: npz file of the model.
        shapes: number of shape parameters S; the first S columns of `shapedirs` are used. In a file of SMPL-X, the
            first 300 of 400 columns are shape parameters, or the first 10 of fewer; the others are expressions.

    Returns:
        Body with 22 joints and S shape parameters.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged, too large, or not a body; or `shapes` is not between 1 and the file's number.
    """
    source, path = os.fspath(path), Path(path)
    if path.suffix == ".pkl":
        raise ValueError(
            f"{path}: a pickle is a program, and is not read; use the npz of SMPL-H or SMPL-X, or save these "
            f"members as plain arrays with numpy.savez: {', '.join(_MEMBERS)}"
        )
    with archive(path) as members:
        if missing := [name for name in _MEMBERS if name not in members]:
            raise ValueError(
                f"{path} is not a body file: it has no {', '.join(missing)}; expected {', '.join(_MEMBERS)}"
            )
        for name in _MEMBERS:
            if members[name].size > LARGEST:
                raise ValueError(f"{path}: {name} has {members[name].size:,} bytes; a body has at most {LARGEST:,}")
        arrays = {name: members[name].array() for name in _MEMBERS}
    if reason := _defect(arrays, shapes):
        raise ValueError(f"{path}: {reason}")
    tensors = [torch.from_numpy(arrays[name].astype(np.float32)) for name in ("v_template", "J_regressor", "weights")]
    template, regressor, weights = tensors
    changes = torch.from_numpy(arrays["shapedirs"][..., :shapes].astype(np.float32))
    faces = torch.from_numpy(arrays["f"].astype(np.int64))
    goes_with = list(range(len(JOINTS)))
    for parent in arrays["kintree_table"][0, len(JOINTS) :]:
        goes_with.append(goes_with[int(parent)])
    weights_of_joints = torch.zeros(len(template), len(JOINTS)).index_add(1, torch.tensor(goes_with), weights)
    tensors = [template, changes.contiguous(), regressor[: len(JOINTS)], weights_of_joints, faces]
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(repr(tuple(tensor.shape)).encode())
        digest.update(tensor.numpy().tobytes())
    return Body(JOINTS, PARENTS, *tensors, source=BodySource(source, digest.hexdigest(), shapes))


def reopen_body(source: BodySource) -> Body:
    """Return the body of a run, from its file or the bundled person.

    Args:
        source: record of the body.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is not a body, or another one.
    """
    if not source.path:
        body = human()
        if body.source != source:
            raise ValueError(f"{source} has no path, and is not the bundled person, {body.source}")
        return body
    advice = (
        "runs do not contain body files, because their licences forbid to distribute them; restore the file "
        f"(fingerprint {source.fingerprint[:12]}…), or correct `schema.body.path` in config.json of the run"
    )
    if not Path(source.path).is_file():
        raise FileNotFoundError(f"the run uses the body in {source.path}, which does not exist here; {advice}")
    body = read_body(source.path, source.shapes)
    assert body.source is not None
    if body.source.fingerprint != source.fingerprint:
        raise ValueError(
            f"the run uses another body than {source.path} contains (fingerprint {body.source.fingerprint[:12]}…); "
            f"{advice}"
        )
    return body


def _defect(arrays: dict[str, np.ndarray], shapes: int) -> str:
    """Return the reason why arrays are not a body, or an empty string if they are."""
    sizes: dict[str | int, int] = {2: 2, 3: 3}
    for name, axes in _MEMBERS.items():
        array, is_integer = arrays[name], name in ("kintree_table", "f")
        for axis, size in zip(axes, array.shape, strict=False):
            sizes.setdefault(axis, size)
        expected = tuple(sizes.get(axis, 0) for axis in axes)
        if array.shape != expected or not array.size or array.dtype.kind not in ("iu" if is_integer else "fiu"):
            kind = "whole numbers" if is_integer else "numbers"
            return f"{name} has {array.dtype} {array.shape}, expected {kind} ({', '.join(map(str, axes))})"
        if not is_integer and not (np.abs(array) <= FURTHEST).all():
            return f"{name} has values that are NaN or above {FURTHEST:g} in absolute value"
    if sizes["V"] > MOST_VERTICES:
        return f"it has {sizes['V']:,} vertices; a body has at most {MOST_VERTICES:,}"
    parents, most = arrays["kintree_table"][0].astype(np.int64), sizes["S"]
    if len(parents) == SMPLX_JOINTS:  # as the public package `smplx` reads them
        most = min(most, 300 if most >= 400 else 10)
    if not 1 <= shapes <= most:
        return f"it has {most} shape parameters, so `shapes` must be from 1 to {most}, got {shapes}"
    if tuple(parents[1 : len(JOINTS)]) != PARENTS[1:] or not (parents[1:] < np.arange(1, len(parents))).all():
        return f"kintree_table is not SMPL's joint tree, whose first joints are {', '.join(JOINTS)}"
    if (parents[1:] < 0).any() or arrays["f"].min() < 0 or arrays["f"].max() >= sizes["V"]:
        return f"a face or a joint refers to an index that does not exist; it has {sizes['V']} vertices"
    for name in ("weights", "J_regressor"):
        if not np.allclose(arrays[name].astype(np.float64).sum(1), 1, atol=1e-3):
            return f"each row of {name} must sum to 1, but some rows do not"
    if arrays["weights"].min() < 0:
        return f"skinning weights must be at least 0, but the smallest is {arrays['weights'].min():g}"
    return ""
