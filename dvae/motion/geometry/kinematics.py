"""Kinematics: from joint rotations to positions, and back.

A rest pose is the offset (J, 3) in metres of each joint from its parent in an unrotated pose. Rotations are local:
joints relative to their parents, and the root relative to the world. The rotation of a joint moves all its descendants.

Positions do not determine the rotation of a bone about itself if its joint has only one child. Such a joint is rotated
as little as possible relative to its parent.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from ...constants import indices
from .rotations import perpendicular, procrustes
from .skeleton import Skeleton, inverse_lengths, rotate_about_up

TIE = 1e-6
"""Weight of the parent's rotation relative to unit vectors; it decides where the vectors fit several rotations."""


def forward(parents: Sequence[int], rotations: Tensor, offsets: Tensor, root: Tensor) -> tuple[Tensor, Tensor]:
    """Return joint positions by forward kinematics, with one matrix product per generation of the tree.

    Args:
        parents: index of each joint's parent, -1 for the root.
        rotations: (..., J, 3, 3), local rotations.
        offsets: (J, 3) rest pose in metres, or any shape that broadcasts against (..., J, 3).
        root: (..., 3) position of the root; the root's offset in the rest pose is ignored.

    Returns:
        Positions (..., J, 3) in metres, and rotations relative to the world (..., J, 3, 3).
    """
    generations = [[list(parents).index(-1)]]
    while below := [joint for joint, parent in enumerate(parents) if parent in generations[-1]]:
        generations.append(below)
    order = [joint for joints in generations for joint in joints]
    first_to_last = indices(order, rotations)
    counts = [len(joints) for joints in generations]
    # index_select has a cheaper gradient than indexing by a list
    first, *local_rotations = rotations.index_select(-3, first_to_last).split(counts, -3)
    _, *bones = offsets.index_select(-2, first_to_last)[..., None].split(counts, -3)
    world_rotations, positions = [first], [root[..., None, :]]
    for (before, joints), local, bone in zip(pairwise(generations), local_rotations, bones, strict=True):
        above = indices([before.index(parents[joint]) for joint in joints], rotations)
        turn = world_rotations[-1].index_select(-3, above)
        positions.append(positions[-1].index_select(-2, above) + (turn @ bone).squeeze(-1))
        world_rotations.append(turn @ local)
    back = indices([order.index(joint) for joint in range(len(order))], rotations)
    return torch.cat(positions, -2).index_select(-2, back), torch.cat(world_rotations, -3).index_select(-3, back)


def resting(parents: Sequence[int], offsets: Tensor) -> Tensor:
    """Return joint positions (..., J, 3) in the rest pose, with the root at 0.

    Args:
        parents: index of each joint's parent, -1 for the root.
        offsets: (..., J, 3) offset of each joint from its parent, in the unit of the result.
    """
    unturned = torch.eye(3).to(offsets).expand(len(parents), 3, 3)
    return forward(parents, unturned, offsets, offsets.new_zeros(*offsets.shape[:-2], 3))[0]


def inverse(skeleton: Skeleton, positions: Tensor, offsets: Tensor) -> Tensor:
    """Return local rotations that make `forward` approximate the directions of a pose's bones.

    Each joint with several children is rotated by Procrustes analysis of the unit vectors to its children. A joint with
    one child gets the smallest rotation relative to its parent that aligns the bone to the child exactly. A joint
    without children is not rotated relative to its parent.

    Args:
        skeleton: skeleton of the poses.
        positions: (..., J, 3), in metres.
        offsets: (J, 3) rest pose, in metres.

    Returns:
        Rotations (..., J, 3, 3).
    """
    shape = (*positions.shape[:-2], 3, 3)
    unturned = torch.eye(3, dtype=positions.dtype, device=positions.device).expand(shape)
    world: dict[int, Tensor] = {-1: unturned}
    local: dict[int, Tensor] = {}
    for joint in skeleton.order:
        above = world[skeleton.parents[joint]]
        below = [child for child, parent in enumerate(skeleton.parents) if parent == joint]
        below = [child for child in below if offsets[child].norm() > 0]
        world[joint] = above
        if below:
            rest = torch.nn.functional.normalize(offsets[below], dim=-1)
            directions = positions[..., below, :] - positions[..., joint, None, :]
            directions = directions * inverse_lengths(directions)[..., None]
            if len(below) == 1:
                world[joint] = orthogonal(swing(above @ rest[0], directions[..., 0, :]) @ above)
            else:
                world[joint] = procrustes(directions.transpose(-1, -2) @ rest + TIE * above)
        local[joint] = above.transpose(-1, -2) @ world[joint]
    return torch.stack([local[joint] for joint in range(skeleton.joints)], -3)


def swing(start: Tensor, end: Tensor) -> Tensor:
    """Return the smallest rotation (..., 3, 3) from one unit vector to another.

    It is half a turn about `start`, then half a turn about the middle of both. If `end` is opposite to `start`, one of
    the many rotations is returned; if `end` is zero, the identity.
    """
    start = torch.nn.functional.normalize(start, dim=-1)  # otherwise rounding errors grow from joint to joint
    middle = start + end
    # below this, rounding dominates
    opposite = middle.norm(dim=-1, keepdim=True) < torch.finfo(middle.dtype).eps ** 0.5
    middle = torch.nn.functional.normalize(torch.where(opposite, perpendicular(start), middle), dim=-1)
    return _half_turn(middle) @ _half_turn(start)


def orthogonal(turn: Tensor) -> Tensor:
    """Remove rounding errors from a rotation (..., 3, 3), which would grow along a chain of products.

    The function makes one step of Newton's iteration for the polar factor (Higham 1986).
    """
    return turn @ (1.5 * torch.eye(3, dtype=turn.dtype, device=turn.device) - 0.5 * turn.transpose(-1, -2) @ turn)


def _half_turn(axis: Tensor) -> Tensor:
    """Return the rotation (..., 3, 3) by half a turn about a unit vector."""
    return 2 * axis[..., :, None] * axis[..., None, :] - torch.eye(3, dtype=axis.dtype, device=axis.device)


def rest(skeleton: Skeleton, positions: Tensor, rounds: int = 10) -> Tensor:
    """Return a rest pose for poses of one body: their mean, facing forward, with bones of mean length.

    If a joint has several children, the angles between them are taken from the poses, by generalised Procrustes
    analysis (Gower 1975).

    Args:
        skeleton: skeleton of the poses.
        positions: (N, J, 3) in metres.
        rounds: iterations of the Procrustes analysis.

    Returns:
        Offsets (J, 3) in metres of each joint from its parent, zero for the root.
    """
    joints = [joint for joint, parent in enumerate(skeleton.parents) if parent >= 0]
    parents = [skeleton.parents[joint] for joint in joints]
    facing = positions
    if skeleton.left and skeleton.right:
        facing = rotate_about_up(positions, -skeleton.heading(positions)[..., None], skeleton.up)
    offsets = torch.zeros_like(positions[0])
    offsets[joints] = (facing[:, joints] - facing[:, parents]).mean(0)
    for joint in range(skeleton.joints):
        below = [child for child, parent in enumerate(skeleton.parents) if parent == joint]
        if len(below) > 1:
            bones = positions[:, below] - positions[:, joint, None]
            for _ in range(rounds):
                rotations = procrustes(bones.transpose(-1, -2) @ offsets[below])
                offsets[below] = (bones @ rotations).mean(0)
    lengths = positions.new_zeros(skeleton.joints)
    lengths[joints] = skeleton.bone_lengths(positions).mean(0)
    return torch.nn.functional.normalize(offsets, dim=-1) * lengths[:, None]
