"""Rotations in the forms that files and models use, to and from matrices.

Everything is right-handed, acts on columns, is batched over leading dimensions and differentiable; the conversions are
roma's (Brégier 2021, arXiv 2103.16317). It takes as long to import as torch does, so that it is imported where
something is turned.

Derivatives to a rotation are right everywhere, those from one but where a form jumps: a quaternion to its opposite,
where another of its numbers becomes the largest; a vector at half a turn, to the other end of its axis; Euler angles
where one is half a turn, or the second one brings the axes of the others together.

| form | numbers | |
|---|---|---|
| `matrix` | 9 | row after row |
| `quaternion` | 4 | w x y z; of the two for one rotation, see `in_time` |
| `vector` | 3 | axis times angle in radians, the exponential map; of the many, see `in_time` |
| `6d` | 6 | the matrix's first column, then its second (Zhou et al. 2019, arXiv 1812.07035) |
| `euler-zyx`, ... | 3 | radians, about axes that turn along, the first of them first; read with any number of axes |
"""

import re

import torch
from torch import Tensor

from ...constants import constant
from ...lazy import optional

SIZES = {"matrix": 9, "quaternion": 4, "vector": 3, "6d": 6}
_EULER = re.compile(r"euler-[xyz]+")
_WHOLE = re.compile(r"euler-([xyz])(?!\1)([xyz])(?!\2)([xyz])")


def size(form: str) -> int:
    """Numbers of a rotation in a form.

    Raises:
        ValueError: an unknown form.
    """
    if form not in SIZES and not _EULER.fullmatch(form):
        raise ValueError(f"rotations have no form {form!r}; expected {', '.join(SIZES)}, or euler- and axes as in zyx")
    return SIZES.get(form, len(form) - len("euler-"))


def to_matrix(values: Tensor, form: str) -> Tensor:
    """Matrices (..., 3, 3) of rotations (..., `size(form)`); quaternions and 6d of any length are taken.

    What says nothing leaves unturned: a quaternion shorter than rounding (`finfo.eps`), and of 6d a first vector so
    short, which is read as x; a second one so short, or along the first, as one across that.

    Raises:
        ValueError: an unknown form, or another number of numbers.

    Example:
        >>> to_matrix(torch.tensor([0.0, 0.0, torch.pi / 2]), "vector").round()[0]
        tensor([ 0., -1.,  0.])
    """
    if values.shape[-1] != size(form):
        raise ValueError(f"a rotation as {form} has {size(form)} numbers, got {tuple(values.shape)}")
    if form == "matrix":
        return values.unflatten(-1, (3, 3))
    roma = optional("roma", "motion")

    if form == "quaternion":
        return roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(normalised(values)))
    if form == "vector":
        return roma.rotvec_to_rotmat(values)
    if form == "6d":
        shortest = torch.finfo(values.dtype).eps
        first, second = values.unflatten(-1, (2, 3)).unbind(-2)
        # asked first, for gradients of what is not chosen cost as much as those of what is
        if (short := first.norm(dim=-1, keepdim=True) < shortest).any():
            first = torch.where(short, constant((1.0, 0.0, 0.0), values), first)
        with torch.no_grad():
            axis = torch.nn.functional.normalize(first, dim=-1)
            apart = (second - (axis * second).sum(-1, keepdim=True) * axis).norm(dim=-1, keepdim=True)
            along = apart <= (shortest**0.5 * second.norm(dim=-1, keepdim=True)).clamp(shortest)
        if along.any():
            second = torch.where(along, across(torch.nn.functional.normalize(first, dim=-1)), second)
        return roma.special_gramschmidt(torch.stack([first, second], -1))
    return roma.euler_to_rotmat(form.removeprefix("euler-").upper(), values)


def from_matrix(rotations: Tensor, form: str) -> Tensor:
    """Rotations (..., 3, 3) in a form, (..., `size(form)`).

    Raises:
        ValueError: an unknown form, or no matrices.
    """
    if rotations.shape[-2:] != (3, 3):
        raise ValueError(f"expected matrices (..., 3, 3), got {tuple(rotations.shape)}")
    if form not in SIZES and not _WHOLE.fullmatch(form):
        size(form)
        raise ValueError(f"not every rotation is one as {form}; expected three axes, no two alike in a row")
    if form == "matrix":
        return rotations.flatten(-2)
    if form == "6d":
        return rotations[..., :2].transpose(-1, -2).flatten(-2)
    roma = optional("roma", "motion")

    if form == "quaternion":
        return roma.quat_xyzw_to_wxyz(roma.rotmat_to_unitquat(rotations))
    if form == "vector":
        return roma.rotmat_to_rotvec(rotations)
    return roma.rotmat_to_euler(form[-3:].upper(), rotations)


def normalised(quaternions: Tensor) -> Tensor:
    """(..., 4) of unit length; unturned where they are shorter than rounding."""
    none = quaternions.norm(dim=-1, keepdim=True) < torch.finfo(quaternions.dtype).eps
    quaternions = torch.where(none, constant((1.0, 0.0, 0.0, 0.0), quaternions), quaternions)
    return torch.nn.functional.normalize(quaternions, dim=-1)


def continuous(quaternions: Tensor, dim: int = -3) -> Tensor:
    """The same rotations by quaternions (..., 4) of which each lies nearer to the one before than its opposite does.

    Args:
        quaternions: of unit length.
        dim: of time; of (F, J, 4), the first.
    """
    with torch.no_grad():
        opposite = (quaternions * quaternions.roll(1, dim)).sum(-1, keepdim=True) < 0
        opposite = opposite.movedim(dim, 0)
        opposite[:1] = False  # the first has none before it
        signs = 1 - 2 * (opposite.cumsum(0) % 2).movedim(0, dim).to(quaternions.dtype)
    return quaternions * signs


def in_time(rotations: Tensor, form: str, given: str = "matrix") -> Tensor:
    """Rotations (..., T, J, 3, 3) in a form as `from_matrix` gives it, without its jumps from frame to frame.

    Where a rotation has several quaternions or vectors, a frame has the one nearest to that of the frame before; the
    first has the quaternion with w >= 0, or the vector of at most half a turn. So a frame depends on none after it.

    Args:
        rotations: (..., T, J, 3, 3), or (..., T, J, 4) where quaternions are given.
        form: that is asked for.
        given: "matrix" or "quaternion".
    """
    if given == form == "quaternion":
        values = normalised(rotations)
    else:
        values = from_matrix(rotations if given == "matrix" else to_matrix(rotations, given), form)
    if form == "quaternion":
        return continuous(torch.where(values[..., :1, :, :1] < 0, -values, values))
    return _unwrapped(values) if form == "vector" else values


def _unwrapped(vectors: Tensor) -> Tensor:
    """Vectors (..., T, J, 3), each with so many whole turns about its axis that it is nearest to the one before.

    One after the other, since where a vector lies says which turns are nearest for the next.
    """
    first, *others = vectors.unbind(-3)
    found = [first]
    for vector in others:
        angle = vector.norm(dim=-1, keepdim=True)
        unturned = angle < 100 * torch.finfo(angle.dtype).eps  # about any axis, as the rest is rounding
        axis = torch.nn.functional.normalize(torch.where(unturned, found[-1], vector), dim=-1)
        turns = ((found[-1] * axis).sum(-1, keepdim=True) - angle) / (2 * torch.pi)
        found.append(vector + 2 * torch.pi * turns.round() * axis)
    return torch.stack(found, -3)


def across(vectors: Tensor) -> Tensor:
    """For each of unit vectors (..., 3) another one at right angles to it, near the axis that it has least of."""
    least = torch.nn.functional.one_hot(vectors.abs().argmin(-1), 3).to(vectors)
    return torch.nn.functional.normalize(least - (least * vectors).sum(-1, keepdim=True) * vectors, dim=-1)


def procrustes(products: Tensor) -> Tensor:
    """The rotations (..., 3, 3) nearest to matrices: of targets times sources, those that turn these onto those."""
    roma = optional("roma", "motion")

    found: Tensor = roma.special_procrustes(products)
    return found
