"""Recursions over T steps in blocks: all blocks at once from nothing, then each from the state that it starts from.

A block of steps of a linear recursion with known matrices, x_{t+1} = F_t x_t + c_t, or of covariances,
X_{t+1} = F_t X_t F_t' + C_t, is one step of the same kind: its matrix is the product D of its F, its offset what it
makes of nothing. So is a block of the Riccati recursion

    P_{t+1} = Q_t + F_t P_t A_t'        F_t = A_t W_t        W_t = (I + P_t G_t)^-1

for with C, W and D those of the solution from P_1 = 0 it is, from any P_1,

    P_{t+1} = C_{t+1} + D_t (I + P_1 J_t)^-1 P_1 D_t'        J_t = D_0' G_1 W_1 D_0 + ... + D_{t-1}' G_t W_t D_{t-1}

(these are the A, C and J of the elements that Särkkä and García-Fernández, 2021, arXiv 1905.13002, combine by pairs).
What the blocks start from is the same recursion again, over as many steps as there are blocks: in place of T steps
one after the other there are 16 or 32 at each of log T / log 16 levels, with twice the work and memory linear in T.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

BLOCK = 16
"""Steps of a block. With 8 or 32 times differ by less than from run to run."""
WIDE = 32
"""Most rows of a step, sequences times N: with more a step keeps a core busy, and blocks double the work."""


def in_blocks(matrix: Tensor) -> bool:
    """Whether blocks are faster than one step after the other, for matrices (T, B, N, N)."""
    steps, batch, size, _ = matrix.shape
    return steps >= 4 * BLOCK and batch * size <= min(WIDE, steps // 6)


class Recursion:
    """The linear recursions that share their matrices F (T, B, N, N)."""

    def __init__(self, matrix: Tensor):
        self.matrix = matrix

    @cached_property
    def _blocks(self) -> tuple[Recursion, Tensor, Recursion]:
        """Within all blocks at once, the products there, and from block to block."""
        matrix = _apart(self.matrix)
        passed = products(matrix)
        return Recursion(matrix), passed, Recursion(_last(passed, self.matrix))

    def states(self, offset: Tensor, start: Tensor) -> Tensor:
        """All x (T + 1, B, N, M), of c (T, B, N, M) and x_1 (B, N, M)."""
        if in_blocks(self.matrix):
            within, passed, between = self._blocks
            own = within.states(offset := _apart(offset), torch.zeros_like(offset[0]))[1:]
            starts = between.states(_last(own, self.matrix), start)[:-1].flatten(0, 1)
            return torch.cat([start[None], _joined(own + passed @ starts, self.matrix)])
        found, steps = _room(start, len(offset))
        for f, c, last, new in zip(self.matrix.unbind(0), offset.unbind(0), steps, steps[1:], strict=False):
            torch.baddbmm(c, f, last, out=new)
        return found

    def covariances(self, offset: Tensor, start: Tensor) -> Tensor:
        """All X (T + 1, B, N, N), of C (T, B, N, N) and X_1 (B, N, N)."""
        if in_blocks(self.matrix):
            within, passed, between = self._blocks
            own = within.covariances(offset := _apart(offset), torch.zeros_like(offset[0]))[1:]
            starts = between.covariances(_last(own, self.matrix), start)[:-1].flatten(0, 1)
            return torch.cat([start[None], _joined(own + passed @ starts @ passed.mT, self.matrix)])
        found, steps = _room(start, len(offset))
        right = torch.empty_like(found[0])
        for f, c, last, new in zip(self.matrix.unbind(0), offset.unbind(0), steps, steps[1:], strict=False):
            torch.bmm(last, f.mT, out=right)
            torch.baddbmm(c, f, right, out=new)
        return found


def riccati(transition: Tensor, noise: Tensor, information: Tensor, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """All P (T + 1, B, N, N), W and F (T, B, N, N), of A, Q and G (T, B, N, N) and P_1 (B, N, N)."""
    if in_blocks(transition):
        a, q, g = (_apart(values) for values in (transition, noise, information))
        own, shrink, carry = riccati(a, q, g, torch.zeros_like(a[0]))
        passed, told = products(carry), g @ shrink
        told[1:] = passed[:-1].mT @ told[1:] @ passed[:-1]
        whole = (passed, symmetric(own), symmetric(told.sum(0, keepdim=True)))
        d, c, j = (_last(values, transition) for values in whole)
        starts = symmetric(riccati(d, c, j, start)[0][:-1])
        found, shrink, carry = riccati(a, q, g, starts.flatten(0, 1))
        found, shrink, carry = (_joined(values, transition) for values in (found[1:], shrink, carry))
        return torch.cat([start[None], found]), shrink, carry
    found, steps = _room(start, len(transition))
    identity = torch.eye(start.shape[-1], dtype=start.dtype, device=start.device).expand_as(start)
    shrink = torch.empty_like(found[1:]).mT  # W; transposed, since the inverse is computed by columns
    carry = torch.empty_like(found[1:])  # F
    inside, right = (torch.empty_like(found[0]) for _ in range(2))
    info = torch.empty(len(start), dtype=torch.int32, device=start.device)
    sequences = (values.unbind(0) for values in (transition, noise, information, shrink, carry))
    for a, q, g, w, f, last, new in zip(*sequences, steps, steps[1:], strict=False):
        torch.baddbmm(identity, last, g, out=inside)
        torch.linalg.inv_ex(inside, out=(w, info))
        torch.bmm(a, w, out=f)
        torch.bmm(last, a.mT, out=right)
        torch.baddbmm(q, f, right, out=new)
    return found, shrink, carry


def products(matrix: Tensor) -> Tensor:
    """D_t = F_t ... F_1 of F (T, B, N, N), for all t."""
    found, steps = _room(matrix[0], len(matrix) - 1)
    for f, last, new in zip(matrix.unbind(0)[1:], steps, steps[1:], strict=False):
        torch.bmm(f, last, out=new)
    return found


def symmetric(matrix: Tensor) -> Tensor:
    """The symmetric part."""
    return 0.5 * (matrix + matrix.mT)


def _room(start: Tensor, steps: int) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Room for so many steps after the first, as a whole and one by one; products into other layouts take long."""
    found = start.new_empty(steps + 1, *start.shape)
    found[0] = start
    return found, found.unbind(0)


def _apart(values: Tensor) -> Tensor:
    """(T, B, ...) to the steps of all blocks, (BLOCK, blocks * B, ...); zeros fill up the last one."""
    values = torch.cat([values, values.new_zeros(-len(values) % BLOCK, *values.shape[1:])])
    return values.unflatten(0, (-1, BLOCK)).transpose(0, 1).flatten(1, 2).contiguous()


def _joined(values: Tensor, like: Tensor) -> Tensor:
    """Back from `_apart`, to as many steps and sequences as another has."""
    return values.unflatten(1, (-1, like.shape[1])).transpose(0, 1).flatten(0, 1)[: len(like)]


def _last(values: Tensor, like: Tensor) -> Tensor:
    """Of the steps of all blocks the last, (blocks, B, ...) for as many sequences as another has."""
    return values[-1].unflatten(0, (-1, like.shape[1]))


class States(torch.autograd.Function):
    """F (T, B, N, N), c (T, B, N) and x_1 (B, N) to x (T + 1, B, N)."""

    @staticmethod
    def forward(ctx: Any, matrix: Tensor, offset: Tensor, start: Tensor) -> Tensor:
        """Run the recursion."""
        found = Recursion(matrix).states(offset[..., None], start[..., None])[..., 0]
        ctx.save_for_backward(matrix, found)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """It runs the other way."""
        matrix, found = ctx.saved_tensors
        total = backward(matrix).states(*from_last(gradient[..., None])).flip(0)
        return total[1:] @ found[:-1, ..., None].mT, total[1:, ..., 0], total[0, ..., 0]


class Covariances(torch.autograd.Function):
    """F and C (T, B, N, N) and X_1 (B, N, N) to X (T + 1, B, N, N), the latter three symmetric."""

    @staticmethod
    def forward(ctx: Any, matrix: Tensor, offset: Tensor, start: Tensor) -> Tensor:
        """Run the recursion."""
        found = symmetric(Recursion(matrix).covariances(offset, start))
        ctx.save_for_backward(matrix, found)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """It runs the other way."""
        matrix, found = ctx.saved_tensors
        total = symmetric(backward(matrix).covariances(*from_last(symmetric(gradient))).flip(0))
        return 2 * total[1:] @ matrix @ found[:-1], total[1:], total[0]


def backward(matrix: Tensor) -> Recursion:
    """Of gradients, from those of the last state to those of the first."""
    return Recursion(matrix.mT.flip(0))


def from_last(values: Tensor) -> tuple[Tensor, Tensor]:
    """What a recursion from the last of them to the first adds at every step, and starts from."""
    return values[:-1].flip(0), values[-1]
