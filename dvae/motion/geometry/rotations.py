"""Conversions between rotation matrices and the forms that files and models use.

All rotations are right-handed, act on column vectors, are batched over leading dimensions and differentiable. The
conversions use roma (Brégier 2021, arXiv 2103.16317), which is imported only when needed because its import is as slow
as the import of torch.

Derivatives of conversions to matrices are always correct. Derivatives of conversions from matrices are correct except
where a form is discontinuous:

* A quaternion may change its sign where another of its components becomes the largest.
* A vector changes its sign at half a turn.
* Euler angles jump at half a turn, and where the second angle aligns the axes of the other two.

| form | numbers | |
|---|---|---|
| `matrix` | 9 | row after row |
| `quaternion` | 4 | w x y z; `in_time` chooses one of the two for a rotation |
| `vector` | 3 | axis times angle in radians, the exponential map; `in_time` chooses one of many |
| `6d` | 6 | the matrix's first column, then its second (Zhou et al. 2019, arXiv 1812.07035) |
| `euler-zyx`, ... | 3 | radians, about moving (intrinsic) axes, in this order; reading accepts any number of axes |
"""

import re

import torch
from torch import Tensor

from ...capture import is_deferring
from ...constants import constant
from ...lazy import optional

SIZES = {"matrix": 9, "quaternion": 4, "vector": 3, "6d": 6}
_EULER = re.compile(r"euler-[xyz]+")
_WHOLE = re.compile(r"euler-([xyz])(?!\1)([xyz])(?!\2)([xyz])")


def size(form: str) -> int:
    """Return the number of values that represent one rotation in a form, such as 6 for "6d".

    Raises:
        ValueError: the form is unknown.
    """
    if form not in SIZES and not _EULER.fullmatch(form):
        raise ValueError(
            f"unknown form of rotations {form!r}; known: {', '.join(SIZES)}, or euler- with axes, such as euler-zyx"
        )
    return SIZES.get(form, len(form) - len("euler-"))


def to_matrix(values: Tensor, form: str) -> Tensor:
    """Return matrices (..., 3, 3) of rotations (..., `size(form)`); quaternions and 6d need not be normalised.

    Degenerate values have defaults. A quaternion shorter than `finfo.eps` is the identity. In 6d, a first vector of
    such length is replaced by the x axis; a second vector of such length, or parallel to the first, by a perpendicular
    one.

    Raises:
        ValueError: the form is unknown, or the number of values does not match it.

    Example:
        >>> to_matrix(torch.tensor([0.0, 0.0, torch.pi / 2]), "vector").round()[0]
        tensor([ 0., -1.,  0.])
    """
    if values.shape[-1] != size(form):
        raise ValueError(
            f"a rotation in the form {form} has {size(form)} numbers in the last dimension, got the shape "
            f"{tuple(values.shape)}"
        )
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
        # the condition avoids a `where` in the usual case, which would double the cost of gradients
        short = first.norm(dim=-1, keepdim=True) < shortest
        if is_deferring() or short.any():
            first = torch.where(short, constant((1.0, 0.0, 0.0), values), first)
        with torch.no_grad():
            axis = torch.nn.functional.normalize(first, dim=-1)
            distance = (second - (axis * second).sum(-1, keepdim=True) * axis).norm(dim=-1, keepdim=True)
            is_parallel = distance <= (shortest**0.5 * second.norm(dim=-1, keepdim=True)).clamp(shortest)
        if is_deferring() or is_parallel.any():
            second = torch.where(is_parallel, perpendicular(torch.nn.functional.normalize(first, dim=-1)), second)
        return roma.special_gramschmidt(torch.stack([first, second], -1))
    return roma.euler_to_rotmat(form.removeprefix("euler-").upper(), values)


def from_matrix(rotations: Tensor, form: str) -> Tensor:
    """Convert rotation matrices (..., 3, 3) to a form, (..., `size(form)`).

    Raises:
        ValueError: the form is unknown, has Euler axes that cannot represent every rotation, or the shape is not
            (..., 3, 3).
    """
    if rotations.shape[-2:] != (3, 3):
        raise ValueError(f"expected matrices (..., 3, 3), got {tuple(rotations.shape)}")
    if form not in SIZES and not _WHOLE.fullmatch(form):
        size(form)
        raise ValueError(f"{form} cannot represent every rotation; use three axes, none twice in a row, as in zyx")
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
    """Return quaternions (..., 4) of unit length; those shorter than `finfo.eps` become the identity."""
    none = quaternions.norm(dim=-1, keepdim=True) < torch.finfo(quaternions.dtype).eps
    quaternions = torch.where(none, constant((1.0, 0.0, 0.0, 0.0), quaternions), quaternions)
    return torch.nn.functional.normalize(quaternions, dim=-1)


def continuous(quaternions: Tensor, dim: int = -3) -> Tensor:
    """Return quaternions of the same rotations, with signs such that each is nearest to the quaternion before it.

    Args:
        quaternions: (..., 4), of unit length.
        dim: dimension of time; the default is the first dimension of (F, J, 4).
    """
    with torch.no_grad():
        opposite = (quaternions * quaternions.roll(1, dim)).sum(-1, keepdim=True) < 0
        opposite = opposite.movedim(dim, 0)
        opposite[:1] = False  # the first has no predecessor
        signs = 1 - 2 * (opposite.cumsum(0) % 2).movedim(0, dim).to(quaternions.dtype)
    return quaternions * signs


def in_time(rotations: Tensor, form: str, source_form: str = "matrix") -> Tensor:
    """Convert rotations of J joints over T frames to a form, without the jumps of `from_matrix` between frames.

    If a rotation has several quaternions or vectors, each frame uses the one nearest to the previous frame. The first
    frame uses the quaternion with w >= 0, or the vector of at most half a turn. A frame therefore never depends on
    later frames.

    Args:
        rotations: (..., T, J, 3, 3), or (..., T, J, 4) for quaternions.
        form: form of the result.
        source_form: form of `rotations`, "matrix" or "quaternion".

    Returns:
        (..., T, J, `size(form)`).

    Raises:
        ValueError: as in `from_matrix`.
    """
    if source_form == form == "quaternion":
        values = normalised(rotations)
    else:
        values = from_matrix(rotations if source_form == "matrix" else to_matrix(rotations, source_form), form)
    if form == "quaternion":
        return continuous(torch.where(values[..., :1, :, :1] < 0, -values, values))
    return _unwrap(values) if form == "vector" else values


def _unwrap(vectors: Tensor) -> Tensor:
    """Add whole turns about the axis to vectors (..., T, J, 3), so that each is nearest to its predecessor.

    The loop is sequential, because the choice for a vector depends on the choice for its predecessor.
    """
    first, *others = vectors.unbind(-3)
    unwrapped = [first]
    for vector in others:
        angle = vector.norm(dim=-1, keepdim=True)
        is_zero = angle < 100 * torch.finfo(angle.dtype).eps  # any axis would do: the vector is only rounding error
        axis = torch.nn.functional.normalize(torch.where(is_zero, unwrapped[-1], vector), dim=-1)
        n_turns = ((unwrapped[-1] * axis).sum(-1, keepdim=True) - angle) / (2 * torch.pi)
        unwrapped.append(vector + 2 * torch.pi * n_turns.round() * axis)
    return torch.stack(unwrapped, -3)


def perpendicular(vectors: Tensor) -> Tensor:
    """Return unit vectors perpendicular to unit vectors (..., 3), near the axis of the vector's smallest component."""
    axis = torch.nn.functional.one_hot(vectors.abs().argmin(-1), 3).to(vectors)
    return torch.nn.functional.normalize(axis - (axis * vectors).sum(-1, keepdim=True) * vectors, dim=-1)


def procrustes(products: Tensor) -> Tensor:
    """Return the rotations (..., 3, 3) nearest to matrices.

    Args:
        products: (..., 3, 3). If it is B A', with source vectors A (..., 3, n) and target vectors B (..., 3, n) as
            columns, the result R minimises |R A - B|.
    """
    roma = optional("roma", "motion")

    rotations: Tensor = roma.special_procrustes(products)
    return rotations
