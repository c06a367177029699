"""Measures of surfaces: vertex error and enclosed volume."""

from __future__ import annotations

from torch import Tensor


def vertex_error(vertices: Tensor, truth: Tensor) -> Tensor:
    """Return the mean distance between the vertices of two surfaces, over vertices and frames, in metres.

    Args:
        vertices: (..., T, V, 3) in metres, with the same vertex order as the truth.
        truth: (..., T, V, 3) in metres.

    Returns:
        Errors (...,).

    Raises:
        ValueError: the shapes differ.
    """
    if vertices.shape != truth.shape:
        raise ValueError(
            f"expected vertices and truth of one shape, got {tuple(vertices.shape)} and {tuple(truth.shape)}"
        )
    # surfaces are strided, and the norm over strides is slow
    distances: Tensor = (vertices - truth).contiguous().norm(dim=-1)
    return distances.mean((-2, -1))


def enclosed_volume(vertices: Tensor, faces: Tensor) -> Tensor:
    """Return the volume inside closed surfaces in cubic metres; the overlap of two surfaces counts twice.

    Args:
        vertices: (..., V, 3) in metres.
        faces: (F, 3), vertex indices of triangles, counterclockwise from outside.

    Returns:
        Volumes (...,): the sum of the signed tetrahedra between the first vertex and the triangles. For a closed
        surface it does not depend on this vertex.
    """
    vertices = vertices - vertices[..., :1, :]
    first, second, third = (vertices[..., corner, :] for corner in faces.unbind(-1))
    return (first * second.cross(third, dim=-1)).sum((-2, -1)) / 6
