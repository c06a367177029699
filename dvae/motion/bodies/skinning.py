"""Linear blend skinning with blend shapes, as in SMPL (Loper et al. 2015, doi 10.1145/2816795.2818013), without pose
corrections.

    v(beta) = template + shapes beta,    j(beta) = regressor v(beta),    x_v = sum_j weights_vj (W_j (v_v - j_j) + p_j)

W_j is the rotation of a joint relative to the world and p_j its position, both by forward kinematics. For one body, the
vertices of all T frames are a single matrix product of the joint transforms, (3 T, 4 J), and the weighted surface,
(4 J, V).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ...constants import indices
from ...options import Size, check
from ..geometry.kinematics import forward

RANK_TOLERANCE = 1e-5
"""Relative singular value below which joint offsets do not determine a shape parameter."""


MOST_PAIRS = 16
"""Maximum size of the summands of `Body.squared_error`, relative to the weighted surface of one body."""


@dataclass(frozen=True)
class BodySource:
    """Record of a body, for runs: they store which file a body is in, but never the body.

    Args:
        path: path of the model file as the user gave it; empty for the bundled person.
        fingerprint: SHA-256 of the arrays that `read_body` returned; empty for the bundled person.
        shapes: number of shape parameters S.
    """

    path: str = ""
    fingerprint: str = ""
    shapes: Size = 8

    def __post_init__(self) -> None:
        check(self)


class Body(nn.Module):
    """A surface on a tree of joints, with shape parameters.

    Coordinates are in metres with y up; at rest the body faces +z. The tensors are non-persistent buffers and never
    part of a state dict, because the licence of a body's file may forbid to distribute it with a model.

    Args:
        names: joint names.
        parents: index of each joint's parent, -1 for the root.
        template: (V, 3), vertices of the average body at rest.
        shapes: (V, 3, S), change of the vertices per unit of each parameter.
        regressor: (J, V), joints as weighted means of vertices; each row sums to 1.
        weights: (V, J), skinning weights; each row sums to 1.
        faces: (F, 3), triangles of vertex indices, counterclockwise from outside.
        source: record of the body, by which runs reopen it; None for a body that was made in Python.

    Raises:
        ValueError: the shapes of the arrays do not match.
    """

    template: Tensor
    shapes: Tensor
    regressor: Tensor
    weights: Tensor
    faces: Tensor

    def __init__(
        self,
        names: Sequence[str],
        parents: Sequence[int],
        template: Tensor,
        shapes: Tensor,
        regressor: Tensor,
        weights: Tensor,
        faces: Tensor,
        *,
        source: BodySource | None = None,
    ):
        super().__init__()
        vertices, joints = len(template), len(names)
        expected: dict[str, tuple[Tensor, tuple[int, ...]]] = {
            "template": (template, (vertices, 3)),
            "shapes": (shapes, (vertices, 3, shapes.shape[-1])),
            "regressor": (regressor, (joints, vertices)),
            "weights": (weights, (vertices, joints)),
            "faces": (faces, (len(faces), 3)),
        }
        for name, (tensor, sizes) in expected.items():
            if tensor.shape != sizes:
                sizes_of_body = f"{vertices} vertices and {joints} joints"
                raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected {sizes} for {sizes_of_body}")
            self.register_buffer(name, tensor, persistent=False)
        self.names, self.parents, self.source = tuple(names), tuple(parents), source
        self._summands: Tensor | None = None

    @property
    def parameters_of_shape(self) -> int:
        """Number of shape parameters S."""
        return self.shapes.shape[-1]

    @property
    def joints(self) -> int:
        """Number of joints J."""
        return len(self.names)

    def at_rest(self, shape: Tensor) -> tuple[Tensor, Tensor]:
        """Return vertices (..., V, 3) and joints (..., J, 3) in metres at rest, from shape parameters (..., S).

        Args:
            shape: shape parameters (..., S).
        """
        return _changed(self.template, self.shapes, shape), self.joints_at_rest(shape)

    def offsets(self, shape: Tensor) -> Tensor:
        """Return rest offsets (..., J, 3) of joints from their parents in metres, from shape parameters (..., S).

        The offset of the root is 0.

        Args:
            shape: shape parameters (..., S).
        """
        average, changes = self._bones()
        return (average + (changes @ shape[..., None, :, None].to(average)).squeeze(-1)).to(shape)

    def shape_of(self, offsets: Tensor) -> Tensor:
        """Return shape parameters (..., S) of bodies with these joint offsets at rest, (..., J, 3) in metres.

        Offsets are linear in the parameters, so this inverts `offsets` where joints determine a parameter; for the
        bundled person, these are all except girth. Undetermined parameters are 0. For offsets that no shape has, the
        result is the least-squares solution.

        Args:
            offsets: offsets (..., J, 3) of joints from their parents at rest, in metres.
        """
        average, changes = self._bones()
        parameters = torch.linalg.pinv(changes.flatten(0, 1), rtol=RANK_TOLERANCE)
        values: Tensor = parameters @ (offsets.to(average) - average).flatten(-2)[..., None]
        return values.squeeze(-1).to(offsets)

    def _bones(self) -> tuple[Tensor, Tensor]:
        """Return offsets of the average body (J, 3) and their changes per parameter (J, 3, S), both float64."""
        regressor, vertices = self.regressor.double(), torch.cat([self.template[..., None], self.shapes], -1).double()
        joints = (regressor @ vertices.flatten(1)).unflatten(-1, vertices.shape[1:])
        bones = joints - joints[[joint if parent < 0 else parent for joint, parent in enumerate(self.parents)]]
        return bones[..., 0], bones[..., 1:]

    def forward(self, shape: Tensor, rotations: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
        """Return surfaces and joints of moving bodies, differentiable with respect to all arguments.

        Args:
            shape: (..., S), shape parameters of each body.
            rotations: (..., T, J, 3, 3), matrices of joints relative to their parents and of the root relative to the
                world; `rotations.to_matrix` converts other forms.
            translation: (..., T, 3) in metres, added after the rotation about the root. The root is at its rest
                position plus the translation, as in `smplx`.

        Returns:
            vertices (..., T, V, 3) and joints (..., T, J, 3), in metres.

        Raises:
            ValueError: the shapes of the arguments do not match the body or each other.
        """
        moves, joints = self._posed(shape, rotations, translation)
        vertices = (_flat(moves) @ self._weighted(shape).mT).unflatten(-2, (-1, 3)).mT
        # added last, because rounding errors grow with the distance from the origin
        return vertices + translation[..., None, :], joints + translation[..., None, :]

    def select_vertices(self, shape: Tensor, rotations: Tensor, translation: Tensor, vertices: Tensor) -> Tensor:
        """Return some vertices of moving bodies, differentiable like `forward`.

        Args:
            shape, rotations, translation: same as in `forward`.
            vertices: indices of vertices in each frame, (..., T, M); or (M,) for all frames.

        Returns:
            Vertices (..., T, M, 3) in metres.

        Raises:
            ValueError: same as `forward`.
        """
        moves, _ = self._posed(shape, rotations, translation)
        if vertices.dim() == 1:
            resting = _changed(self.template[vertices], self.shapes[vertices], shape).mT[..., None, None, :, :]
            # weights first, because all bodies share them: in the other order, second derivatives take twice as long
            transforms = moves.movedim(-3, -1).contiguous() @ self.weights[vertices].mT  # (..., T, 3, 4, M)
            coordinates = (transforms[..., :3, :] * resting).sum(-2) + transforms[..., 3, :]
            return coordinates.mT + translation[..., None, :]
        frames = translation.shape[:-1]
        vertex_indices = vertices.flatten(-2)[..., None].expand(*frames[:-1], -1, 3)
        resting = self.at_rest(shape)[0].gather(-2, vertex_indices).unflatten(-2, vertices.shape[-2:])
        rows = torch.arange(frames.numel(), device=vertices.device).reshape(*frames, 1) * self.joints
        weights, joints = self._nonzero_weights
        transforms = torch.zeros_like(resting[..., None])
        for share, joint in zip(weights.unbind(-1), joints.unbind(-1), strict=True):
            transform = moves.flatten(-2).flatten(0, -2)[rows + joint[vertices]].unflatten(-1, (3, 4))
            transforms = transforms + share[vertices][..., None, None] * transform
        positions: Tensor = (
            (transforms[..., :3] @ resting[..., None]).squeeze(-1) + transforms[..., 3] + translation[..., None, :]
        )
        return positions

    @property
    def _nonzero_weights(self) -> tuple[Tensor, Tensor]:
        """The largest skinning weights of each vertex (V, K), and their joints; all other weights are 0."""
        return self.weights.topk(int((self.weights > 0).sum(-1).max()), -1)

    def squared_error(self, shape: Tensor, first: Sequence[Tensor], second: Sequence[Tensor]) -> Tensor:
        """Return the mean squared distance over vertices between two motions of the same bodies, (..., T) in m².

        Vertices are linear in the joint transforms, so the error is a quadratic form in 4 J numbers, and vertices are
        never computed. With P and P' the transforms of two poses and V the surface: |P V - P' V|² = tr (P - P') V V^T
        (P - P')^T.

        Args:
            shape: (..., S), shape parameters of each body.
            first, second: rotations (..., T, J, 3, 3) and translation (..., T, 3) of each motion, as in `forward`.

        Raises:
            ValueError: same as `forward`.
        """
        for motion in (first, second):
            self._check(shape, *motion)
        form = self._form(shape)
        pivots = self.joints_at_rest(shape)
        first_transforms, second_transforms = (
            _flat(_posed(pivots, rotations, self.parents)[0]) for rotations, _ in (first, second)
        )
        difference = (first_transforms - second_transforms).unflatten(-1, (-1, 4))
        translation = (first[1] - second[1]).flatten(-2)[..., None]  # the same for all joints, because weights sum to 1
        difference = torch.cat([difference[..., :3], difference[..., 3:] + translation[..., None, :]], -1).flatten(-2)
        errors: Tensor = ((difference @ form) * difference).sum(-1).unflatten(-1, (-1, 3)).sum(-1)
        return errors

    def _form(self, shape: Tensor) -> Tensor:
        """Return the matrix V V^T of `squared_error` divided by the number of vertices, (..., 4 J, 4 J).

        Surfaces are linear in (1, beta), so the matrix is a sum over pairs of these S + 1 numbers. The summands are
        computed once, and a step then does not depend on the number of vertices.
        """
        size, columns = self.parameters_of_shape + 1, 4 * self.joints
        if size**2 * columns > MOST_PAIRS * len(self.template):  # with many parameters, vertices need less memory
            surface = self._weighted(shape)
            return surface.mT @ surface / surface.shape[-2]
        if self._summands is None or (self._summands.dtype, self._summands.device) != (shape.dtype, shape.device):
            points = torch.cat([self.template[..., None], self.shapes], -1).double()
            ones = torch.eye(1, size).to(points).expand(len(points), 1, -1)
            surfaces = (self.weights.double()[:, :, None, None] * torch.cat([points, ones], 1)[:, None]).flatten(1)
            products = (surfaces.mT @ surfaces / len(points)).reshape(columns, size, columns, size)
            self._summands = products.permute(1, 3, 0, 2).flatten(2).flatten(0, 1).to(shape)
        factors = torch.cat([torch.ones_like(shape[..., :1]), shape], -1)
        pairs = (factors[..., :, None] * factors[..., None, :]).flatten(-2)
        form: Tensor = (pairs @ self._summands).unflatten(-1, (columns, columns))
        return form

    def _weighted(self, shape: Tensor) -> Tensor:
        """Return homogeneous vertices at rest times their weight for each joint, (..., V, 4 J)."""
        resting = _changed(self.template, self.shapes, shape)
        surface = torch.cat([resting, torch.ones_like(resting[..., :1])], -1)
        return (self.weights[..., None] * surface[..., None, :]).flatten(-2)

    def joints_at_rest(self, shape: Tensor) -> Tensor:
        """Return joints (..., J, 3) in metres at rest, from shape parameters (..., S), without computing vertices.

        Args:
            shape: shape parameters (..., S).
        """
        changes = (self.regressor @ self.shapes.flatten(1)).unflatten(-1, (3, -1))
        return _changed(self.regressor @ self.template, changes, shape)

    def _posed(self, shape: Tensor, rotations: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
        """Return joint transforms (..., T, J, 3, 4), and joints (..., T, J, 3), without translation."""
        self._check(shape, rotations, translation)
        return _posed(self.joints_at_rest(shape), rotations, self.parents)

    def _check(self, shape: Tensor, rotations: Tensor, translation: Tensor) -> None:
        frames = translation.shape[:-1]
        if rotations.shape != (*frames, self.joints, 3, 3) or shape.shape[:-1] != frames[:-1] or not frames:
            raise ValueError(
                f"expected shape (..., {self.parameters_of_shape}), rotations (..., T, {self.joints}, 3, 3) and "
                f"translation (..., T, 3), got {tuple(shape.shape)}, {tuple(rotations.shape)} and "
                f"{tuple(translation.shape)}"
            )


def _posed(pivots: Tensor, rotations: Tensor, parents: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Return joint transforms (..., T, J, 3, 4), and joints (..., T, J, 3), of bodies with these joints at rest."""
    pivots = pivots[..., None, :, :]
    offsets = pivots - pivots.index_select(-2, indices([max(parent, 0) for parent in parents], pivots))
    root = pivots[..., parents.index(-1), :].expand(*rotations.shape[:-3], 3)
    joints, world = forward(parents, rotations, offsets, root)
    translations = joints - (world @ pivots[..., None]).squeeze(-1)
    return torch.cat([world, translations[..., None]], -1), joints


def _flat(moves: Tensor) -> Tensor:
    """Reshape joint transforms (..., T, J, 3, 4) to (..., 3 T, 4 J)."""
    return moves.movedim(-2, -3).flatten(-2).flatten(-3, -2)


def _changed(average: Tensor, changes: Tensor, shape: Tensor) -> Tensor:
    """Return points (..., M, 3): their averages (M, 3) plus their changes (M, 3, S) by parameters (..., S)."""
    if shape.shape[-1:] != changes.shape[-1:]:
        raise ValueError(f"shape is {tuple(shape.shape)}, expected (..., {changes.shape[-1]})")
    points: Tensor = average + (shape @ changes.flatten(0, 1).mT).unflatten(-1, (-1, 3))
    return points
