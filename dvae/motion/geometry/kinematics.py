"""Kinematics: from rotations of joints to positions, and back.

A rest pose is where each joint is from its parent while nothing is turned, (J, 3) in metres. Rotations are local: of a
joint against its parent, and of the root against the world; the turn of a joint moves what hangs from it.

What positions do not say is how a bone is turned about itself where one joint alone hangs from it; it is turned as
little as possible against its parent.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from ...constants import indices
from .rotations import across, procrustes
from .skeleton import Skeleton, inverse_lengths, rotate_about_up

TIE = 1e-6
"""Weight of the parent's turn beside unit vectors, where these leave the turn about themselves open."""


def forward(parents: Sequence[int], rotations: Tensor, offsets: Tensor, root: Tensor) -> tuple[Tensor, Tensor]:
    """Where joints are: one product of matrices for each generation of the tree, over all poses at once.

    Args:
        parents: index of each joint's parent, -1 for the root.
        rotations: (..., J, 3, 3), local.
        offsets: of a rest pose in metres, (J, 3); or any that broadcast against (..., J, 3).
        root: place of the root (..., 3); that of the rest pose is not read.

    Returns:
        positions (..., J, 3), and turns against the world (..., J, 3, 3).
    """
    generations = [[list(parents).index(-1)]]
    while below := [joint for joint, parent in enumerate(parents) if parent in generations[-1]]:
        generations.append(below)
    order = [joint for joints in generations for joint in joints]
    first_to_last = indices(order, rotations)
    many = [len(joints) for joints in generations]
    # by index_select, whose gradient costs less than that of a list of indices
    first, *turns = rotations.index_select(-3, first_to_last).split(many, -3)
    _, *bones = offsets.index_select(-2, first_to_last)[..., None].split(many, -3)
    turned, placed = [first], [root[..., None, :]]
    for (before, joints), local, bone in zip(pairwise(generations), turns, bones, strict=True):
        above = indices([before.index(parents[joint]) for joint in joints], rotations)
        turn = turned[-1].index_select(-3, above)
        placed.append(placed[-1].index_select(-2, above) + (turn @ bone).squeeze(-1))
        turned.append(turn @ local)
    back = indices([order.index(joint) for joint in range(len(order))], rotations)
    return torch.cat(placed, -2).index_select(-2, back), torch.cat(turned, -3).index_select(-3, back)


def resting(parents: Sequence[int], offsets: Tensor) -> Tensor:
    """Joints (..., J, 3) with nothing turned and the root at 0, of offsets from their parents (..., J, 3)."""
    unturned = torch.eye(3).to(offsets).expand(len(parents), 3, 3)
    return forward(parents, unturned, offsets, offsets.new_zeros(*offsets.shape[:-2], 3))[0]


def inverse(skeleton: Skeleton, positions: Tensor, offsets: Tensor) -> Tensor:
    """Local rotations of which `forward` makes poses as near as bones of these lengths allow.

    Each joint is turned by Procrustes' rotation of the unit vectors to the joints that hang from it; exactly onto
    one that hangs from it alone, and then as little as possible against its parent. An end has its parent's turn.

    Args:
        positions: (..., J, 3).
        offsets: of a rest pose, (J, 3).

    Returns:
        (..., J, 3, 3).
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
            seen = positions[..., below, :] - positions[..., joint, None, :]
            seen = seen * inverse_lengths(seen)[..., None]
            if len(below) == 1:
                world[joint] = orthogonal(swing(above @ rest[0], seen[..., 0, :]) @ above)
            else:
                world[joint] = procrustes(seen.transpose(-1, -2) @ rest + TIE * above)
        local[joint] = above.transpose(-1, -2) @ world[joint]
    return torch.stack([local[joint] for joint in range(skeleton.joints)], -3)


def swing(start: Tensor, end: Tensor) -> Tensor:
    """The smallest rotation (..., 3, 3) from one unit vector to another: half a turn about it, then about their middle.

    Of the many onto a vector's opposite, one; none, where the end is zero.
    """
    start = torch.nn.functional.normalize(start, dim=-1)  # or rounding would grow from joint to joint
    middle = start + end
    opposite = middle.norm(dim=-1, keepdim=True) < torch.finfo(middle.dtype).eps ** 0.5  # below, rounding rules
    middle = torch.nn.functional.normalize(torch.where(opposite, across(start), middle), dim=-1)
    return _half_turn(middle) @ _half_turn(start)


def orthogonal(turn: Tensor) -> Tensor:
    """A rotation (..., 3, 3) without the rounding of the products that it came from, or it would grow along a chain.

    One step of Newton's iteration for the polar factor (Higham 1986).
    """
    return turn @ (1.5 * torch.eye(3, dtype=turn.dtype, device=turn.device) - 0.5 * turn.transpose(-1, -2) @ turn)


def _half_turn(axis: Tensor) -> Tensor:
    """(..., 3, 3) about a unit vector."""
    return 2 * axis[..., :, None] * axis[..., None, :] - torch.eye(3, dtype=axis.dtype, device=axis.device)


def rest(skeleton: Skeleton, positions: Tensor, rounds: int = 10) -> Tensor:
    """A rest pose for poses of one body: the mean of them all, seen from the front, with bones of their mean lengths.

    Where several joints hang from one, they are as far from each other as in the poses (generalised Procrustes
    analysis, Gower 1975).

    Args:
        positions: (N, J, 3).

    Returns:
        (J, 3), the root's 0.
    """
    joints = [joint for joint, parent in enumerate(skeleton.parents) if parent >= 0]
    parents = [skeleton.parents[joint] for joint in joints]
    facing = positions
    if skeleton.left and skeleton.right:
        facing = rotate_about_up(positions, -skeleton.heading(positions)[..., None], skeleton.up)
    found = torch.zeros_like(positions[0])
    found[joints] = (facing[:, joints] - facing[:, parents]).mean(0)
    for joint in range(skeleton.joints):
        below = [child for child, parent in enumerate(skeleton.parents) if parent == joint]
        if len(below) > 1:
            seen = positions[:, below] - positions[:, joint, None]
            for _ in range(rounds):
                turn = procrustes(seen.transpose(-1, -2) @ found[below])
                found[below] = (seen @ turn).mean(0)
    lengths = positions.new_zeros(skeleton.joints)
    lengths[joints] = skeleton.bone_lengths(positions).mean(0)
    return torch.nn.functional.normalize(found, dim=-1) * lengths[:, None]
