"""Linear blend skinning with blend shapes, as in SMPL (Loper et al. 2015, doi 10.1145/2816795.2818013) without its
corrections by pose.

    v(beta) = template + shapes beta,    j(beta) = regressor v(beta),    x_v = sum_j weights_vj (W_j (v_v - j_j) + p_j)

with W_j the turn of a joint against the world and p_j its place, both by forward kinematics. For one body this is a
single product of matrices over all frames: of what poses say, (3 T, 4 J), and what the body says, (4 J, V).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ...constants import indices
from ..geometry.kinematics import forward

UNTOLD = 1e-5
"""Share of what joints move by the parameters that move them most, below which they do not tell one."""


class Body(nn.Module):
    """A surface that hangs on a tree of joints, and how shape parameters change it. Metres, y up, facing +z.

    Its tensors are buffers that no state dict holds: a body's file may be somebody's under a licence of its own, and a
    model's weights would carry it along.

    Args:
        names: of the joints.
        parents: index of each joint's parent, -1 for the root.
        template: vertices of the average body at rest, (V, 3).
        shapes: what a unit of each parameter adds to them, (V, 3, S).
        regressor: joints as means of vertices, (J, V), each row with sum 1.
        weights: how much a vertex goes with each joint, (V, J), each row with sum 1.
        faces: triangles, counterclockwise from outside, (F, 3) places of vertices.

    Raises:
        ValueError: shapes that do not fit each other.
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
                known = f"{vertices} vertices and {joints} joints"
                raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected {sizes} for {known}")
            self.register_buffer(name, tensor, persistent=False)
        self.names, self.parents = tuple(names), tuple(parents)

    @property
    def parameters_of_shape(self) -> int:
        """Number of shape parameters S."""
        return self.shapes.shape[-1]

    @property
    def joints(self) -> int:
        """Number of joints J."""
        return len(self.names)

    def at_rest(self, shape: Tensor) -> tuple[Tensor, Tensor]:
        """Vertices (..., V, 3) and joints (..., J, 3) of bodies (..., S), nothing turned."""
        return _changed(self.template, self.shapes, shape), self._pivots(shape)

    def offsets(self, shape: Tensor) -> Tensor:
        """Where joints rest, from their parents: of bodies (..., S), (..., J, 3) in metres, the root's 0."""
        average, changes = self._bones()
        return (average + (changes @ shape[..., None, :, None].to(average)).squeeze(-1)).to(shape)

    def shape_of(self, offsets: Tensor) -> Tensor:
        """The parameters (..., S) of bodies whose joints rest so far from their parents, (..., J, 3) in metres.

        They are linear in each other, so that this is the way back from `offsets`: where joints tell a parameter, which
        they do of all but the person's girth. What they do not tell is 0. Of offsets that no shape has, the nearest's.
        """
        average, changes = self._bones()
        parameters = torch.linalg.pinv(changes.flatten(0, 1), rtol=UNTOLD)
        found: Tensor = parameters @ (offsets.to(average) - average).flatten(-2)[..., None]
        return found.squeeze(-1).to(offsets)

    def _bones(self) -> tuple[Tensor, Tensor]:
        """Offsets of the average body (J, 3), and what parameters add to them (J, 3, S); float64, for the way back."""
        regressor, vertices = self.regressor.double(), torch.cat([self.template[..., None], self.shapes], -1).double()
        joints = (regressor @ vertices.flatten(1)).unflatten(-1, vertices.shape[1:])
        bones = joints - joints[[joint if parent < 0 else parent for joint, parent in enumerate(self.parents)]]
        return bones[..., 0], bones[..., 1:]

    def forward(self, shape: Tensor, rotations: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
        """Surfaces and joints of moving bodies, differentiable in everything given.

        Args:
            shape: of each body, (..., S).
            rotations: matrices (..., T, J, 3, 3), of joints against their parents and of the root against the world;
                other forms by `rotations.to_matrix`.
            translation: by which a body is moved from where it rests, after it is turned about its root, metres
                (..., T, 3). The root itself is at its place at rest plus this, as in `smplx`.

        Returns:
            vertices (..., T, V, 3) and joints (..., T, J, 3), in metres.

        Raises:
            ValueError: shapes that do not fit the body or each other.
        """
        moves, joints = self._posed(shape, rotations, translation)
        vertices = (_flat(moves) @ self._hung(shape).mT).unflatten(-2, (-1, 3)).mT
        # last, as rounding would grow with how far somebody walks
        return vertices + translation[..., None, :], joints + translation[..., None, :]

    def some(self, shape: Tensor, rotations: Tensor, translation: Tensor, vertices: Tensor) -> Tensor:
        """Some vertices of moving bodies alone, differentiable as `forward` is.

        Args:
            shape, rotations, translation: see `forward`.
            vertices: which they are in each frame, (..., T, M); or (M,), the same in all.

        Returns:
            (..., T, M, 3) in metres.
        """
        moves, _ = self._posed(shape, rotations, translation)
        if vertices.dim() == 1:
            resting = _changed(self.template[vertices], self.shapes[vertices], shape).mT[..., None, None, :, :]
            # first by the weights, which all bodies share: second derivatives of the other order take twice as long
            moved = moves.movedim(-3, -1).contiguous() @ self.weights[vertices].mT  # (..., T, 3, 4, M)
            placed = (moved[..., :3, :] * resting).sum(-2) + moved[..., 3, :]
            return placed.mT + translation[..., None, :]
        frames = translation.shape[:-1]
        which = vertices.flatten(-2)[..., None].expand(*frames[:-1], -1, 3)
        resting = self.at_rest(shape)[0].gather(-2, which).unflatten(-2, vertices.shape[-2:])
        rows = torch.arange(frames.numel(), device=vertices.device).reshape(*frames, 1) * self.joints
        weights, joints = self._carried
        moved = torch.zeros_like(resting[..., None])
        for share, joint in zip(weights.unbind(-1), joints.unbind(-1), strict=True):
            going = moves.flatten(-2).flatten(0, -2)[rows + joint[vertices]].unflatten(-1, (3, 4))
            moved = moved + share[vertices][..., None, None] * going
        found: Tensor = (moved[..., :3] @ resting[..., None]).squeeze(-1) + moved[..., 3] + translation[..., None, :]
        return found

    @property
    def _carried(self) -> tuple[Tensor, Tensor]:
        """How much vertices go with the joints that they go with most (V, K), and which these are; others are 0."""
        return self.weights.topk(int((self.weights > 0).sum(-1).max()), -1)

    def squared_error(self, shape: Tensor, first: Sequence[Tensor], second: Sequence[Tensor]) -> Tensor:
        """The mean over vertices of the squared distance between two motions of the same bodies, (..., T) in m².

        Vertices are linear in what joints do, so that this is a quadratic form of 4 J numbers, and no vertex is made:
        with P and P' what two poses say and S the surface, |P S - P' S|² = tr (P - P') S S^T (P - P')^T.

        Args:
            shape: of each body, (..., S).
            first, second: rotations (..., T, J, 3, 3) and translation (..., T, 3) of each, as `forward` takes them.
        """
        for motion in (first, second):
            self._check(shape, *motion)
        surface = self._hung(shape)
        form = surface.mT @ surface / surface.shape[-2]
        pivots = self._pivots(shape)
        ours, theirs = (_flat(_posed(pivots, rotations, self.parents)[0]) for rotations, _ in (first, second))
        apart = (ours - theirs).unflatten(-1, (-1, 4))
        moved = (first[1] - second[1]).flatten(-2)[..., None]  # all joints alike, as weights have the sum 1
        apart = torch.cat([apart[..., :3], apart[..., 3:] + moved[..., None, :]], -1).flatten(-2)
        found: Tensor = ((apart @ form) * apart).sum(-1).unflatten(-1, (-1, 3)).sum(-1)
        return found

    def _hung(self, shape: Tensor) -> Tensor:
        """Vertices at rest by the joints that they hang on, (..., V, 4 J)."""
        resting = _changed(self.template, self.shapes, shape)
        surface = torch.cat([resting, torch.ones_like(resting[..., :1])], -1)
        return (self.weights[..., None] * surface[..., None, :]).flatten(-2)

    def _pivots(self, shape: Tensor) -> Tensor:
        """Joints at rest (..., J, 3): linear in the shape as vertices are, and fewer."""
        changes = (self.regressor @ self.shapes.flatten(1)).unflatten(-1, (3, -1))
        return _changed(self.regressor @ self.template, changes, shape)

    def _posed(self, shape: Tensor, rotations: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
        """What joints do to what hangs on them (..., T, J, 3, 4), and where they are (..., T, J, 3), not translated."""
        self._check(shape, rotations, translation)
        return _posed(self._pivots(shape), rotations, self.parents)

    def _check(self, shape: Tensor, rotations: Tensor, translation: Tensor) -> None:
        frames = translation.shape[:-1]
        if rotations.shape != (*frames, self.joints, 3, 3) or shape.shape[:-1] != frames[:-1] or not frames:
            raise ValueError(
                f"expected shape (..., {self.parameters_of_shape}), rotations (..., T, {self.joints}, 3, 3) and "
                f"translation (..., T, 3), got {tuple(shape.shape)}, {tuple(rotations.shape)} and "
                f"{tuple(translation.shape)}"
            )


def _posed(pivots: Tensor, rotations: Tensor, parents: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """What joints do (..., T, J, 3, 4), and where they are (..., T, J, 3), of bodies that rest with them at places."""
    pivots = pivots[..., None, :, :]
    offsets = pivots - pivots.index_select(-2, indices([max(parent, 0) for parent in parents], pivots))
    root = pivots[..., parents.index(-1), :].expand(*rotations.shape[:-3], 3)
    joints, turns = forward(parents, rotations, offsets, root)
    moved = joints - (turns @ pivots[..., None]).squeeze(-1)
    return torch.cat([turns, moved[..., None]], -1), joints


def _flat(moves: Tensor) -> Tensor:
    """(..., 3 T, 4 J) of what joints do (..., T, J, 3, 4)."""
    return moves.movedim(-2, -3).flatten(-2).flatten(-3, -2)


def _changed(average: Tensor, changes: Tensor, shape: Tensor) -> Tensor:
    """Points (..., M, 3) that are on average there (M, 3), by what parameters (..., S) add to them (M, 3, S)."""
    if shape.shape[-1:] != changes.shape[-1:]:
        raise ValueError(f"shape is {tuple(shape.shape)}, expected (..., {changes.shape[-1]})")
    found: Tensor = average + (shape @ changes.flatten(0, 1).mT).unflatten(-1, (-1, 3))
    return found
