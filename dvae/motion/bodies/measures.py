"""Measures of surfaces: how far one is from another, and what it holds."""

from __future__ import annotations

from torch import Tensor


def vertex_error(vertices: Tensor, truth: Tensor) -> Tensor:
    """Mean distance between the vertices of two surfaces, over vertices and frames, in metres.

    Args:
        vertices: (..., T, V, 3), of the same body as the truth's.
        truth: (..., T, V, 3).

    Returns:
        (...,).
    """
    if vertices.shape != truth.shape:
        raise ValueError(f"vertices {tuple(vertices.shape)} and truth {tuple(truth.shape)} are not of one shape")
    distances: Tensor = (vertices - truth).contiguous().norm(dim=-1)  # across strides, as surfaces come, it is slow
    return distances.mean((-2, -1))


def enclosed_volume(vertices: Tensor, faces: Tensor) -> Tensor:
    """What a closed surface holds, in cubic metres; of several, the sum, where they overlap counted for each.

    Args:
        vertices: (..., V, 3).
        faces: (F, 3), counterclockwise from outside.

    Returns:
        (...,): the sum of the tetrahedra between the origin and the triangles, for a closed surface the same from any
        origin.
    """
    first, second, third = (vertices[..., corner, :] for corner in faces.unbind(-1))
    return (first * second.cross(third, dim=-1)).sum((-2, -1)) / 6
