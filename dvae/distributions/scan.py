"""Recursions over T steps in blocks: run all blocks at once from zero, then correct each block for its initial state.

Consider a linear recursion with known matrices, x_{t+1} = F_t x_t + c_t, or a recursion of covariances,
X_{t+1} = F_t X_t F_t' + C_t. A block of steps is again one step of the same kind. Its matrix is the product D of the F,
and its offset is the result from a zero initial state. The same holds for a block of the Riccati recursion

    P_{t+1} = Q_t + F_t P_t A_t'        F_t = A_t W_t        W_t = (I + P_t G_t)^-1

If C, W and D are computed for the solution with P_1 = 0, the solution for any P_1 is

    P_{t+1} = C_{t+1} + D_t (I + P_1 J_t)^-1 P_1 D_t'        J_t = D_0' G_1 W_1 D_0 + ... + D_{t-1}' G_t W_t D_{t-1}

These are the A, C and J of the elements that Särkkä and García-Fernández (2021, arXiv 1905.13002) combine in pairs. The
initial states of the blocks follow the same recursion with one step per block. Instead of T sequential steps there are
16 or 32 at each of log T / log 16 levels, with twice the work and memory linear in T.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

BLOCK = 16
"""Number of steps in a block. Run times with 8 or 32 differ by less than the variation between runs."""
WIDE = 32
"""Maximum rows per step (sequences times N). With more, a step keeps a core busy and blocks double the work."""


def use_blocks(matrix: Tensor) -> bool:
    """Return whether blocks are faster than sequential steps for matrices (T, B, N, N)."""
    steps, batch, size, _ = matrix.shape
    return steps >= 4 * BLOCK and batch * size <= min(WIDE, steps // 6)


class Recursion:
    """Linear recursions that share their matrices F (T, B, N, N)."""

    def __init__(self, matrix: Tensor):
        self.matrix = matrix

    @cached_property
    def _blocks(self) -> tuple[Recursion, Tensor, Recursion]:
        """The recursion within all blocks at once, the products within blocks, and the recursion between blocks."""
        matrix = _to_blocks(self.matrix)
        passed = products(matrix)
        return Recursion(matrix), passed, Recursion(_last(passed, self.matrix))

    def states(self, offset: Tensor, start: Tensor) -> Tensor:
        """Return all x (T + 1, B, N, M) for c (T, B, N, M) and x_1 (B, N, M)."""
        if use_blocks(self.matrix):
            within, passed, between = self._blocks
            from_zero = within.states(offset := _to_blocks(offset), torch.zeros_like(offset[0]))[1:]
            starts = between.states(_last(from_zero, self.matrix), start)[:-1].flatten(0, 1)
            return torch.cat([start[None], _from_blocks(from_zero + passed @ starts, self.matrix)])
        states, steps = _allocate(start, len(offset))
        for f, c, last, new in zip(self.matrix.unbind(0), offset.unbind(0), steps, steps[1:], strict=False):
            torch.baddbmm(c, f, last, out=new)
        return states

    def covariances(self, offset: Tensor, start: Tensor) -> Tensor:
        """Return all X (T + 1, B, N, N) for C (T, B, N, N) and X_1 (B, N, N)."""
        if use_blocks(self.matrix):
            within, passed, between = self._blocks
            from_zero = within.covariances(offset := _to_blocks(offset), torch.zeros_like(offset[0]))[1:]
            starts = between.covariances(_last(from_zero, self.matrix), start)[:-1].flatten(0, 1)
            return torch.cat([start[None], _from_blocks(from_zero + passed @ starts @ passed.mT, self.matrix)])
        covariances, steps = _allocate(start, len(offset))
        right = torch.empty_like(covariances[0])
        for f, c, last, new in zip(self.matrix.unbind(0), offset.unbind(0), steps, steps[1:], strict=False):
            torch.bmm(last, f.mT, out=right)
            torch.baddbmm(c, f, right, out=new)
        return covariances


def riccati(transition: Tensor, noise: Tensor, information: Tensor, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return all P (T + 1, B, N, N), W and F (T, B, N, N) for A, Q and G (T, B, N, N) and P_1 (B, N, N)."""
    if use_blocks(transition):
        a, q, g = (_to_blocks(values) for values in (transition, noise, information))
        from_zero, shrink, carry = riccati(a, q, g, torch.zeros_like(a[0]))
        passed, gained = products(carry), g @ shrink
        gained[1:] = passed[:-1].mT @ gained[1:] @ passed[:-1]
        elements = (passed, symmetric(from_zero), symmetric(gained.sum(0, keepdim=True)))
        d, c, j = (_last(values, transition) for values in elements)
        starts = symmetric(riccati(d, c, j, start)[0][:-1])
        covariances, shrink, carry = riccati(a, q, g, starts.flatten(0, 1))
        covariances, shrink, carry = (_from_blocks(values, transition) for values in (covariances[1:], shrink, carry))
        return torch.cat([start[None], covariances]), shrink, carry
    covariances, steps = _allocate(start, len(transition))
    identity = torch.eye(start.shape[-1], dtype=start.dtype, device=start.device).expand_as(start)
    shrink = torch.empty_like(covariances[1:]).mT  # W; transposed, since the inverse is computed by columns
    carry = torch.empty_like(covariances[1:])  # F
    inside, right = (torch.empty_like(covariances[0]) for _ in range(2))
    info = torch.empty(len(start), dtype=torch.int32, device=start.device)
    sequences = (values.unbind(0) for values in (transition, noise, information, shrink, carry))
    for a, q, g, w, f, last, new in zip(*sequences, steps, steps[1:], strict=False):
        torch.baddbmm(identity, last, g, out=inside)
        torch.linalg.inv_ex(inside, out=(w, info))
        torch.bmm(a, w, out=f)
        torch.bmm(last, a.mT, out=right)
        torch.baddbmm(q, f, right, out=new)
    return covariances, shrink, carry


def products(matrix: Tensor) -> Tensor:
    """Return D_t = F_t ... F_1 for all t, from F (T, B, N, N)."""
    results, steps = _allocate(matrix[0], len(matrix) - 1)
    for f, last, new in zip(matrix.unbind(0)[1:], steps, steps[1:], strict=False):
        torch.bmm(f, last, out=new)
    return results


def symmetric(matrix: Tensor) -> Tensor:
    """Return the symmetric part."""
    return 0.5 * (matrix + matrix.mT)


def _allocate(start: Tensor, steps: int) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Allocate memory for `steps` steps after the first, as a whole and by step; other layouts slow products down."""
    memory = start.new_empty(steps + 1, *start.shape)
    memory[0] = start
    return memory, memory.unbind(0)


def _to_blocks(values: Tensor) -> Tensor:
    """Rearrange (T, B, ...) to the steps of all blocks, (BLOCK, blocks * B, ...); zeros pad the last block."""
    values = torch.cat([values, values.new_zeros(-len(values) % BLOCK, *values.shape[1:])])
    return values.unflatten(0, (-1, BLOCK)).transpose(0, 1).flatten(1, 2).contiguous()


def _from_blocks(values: Tensor, like: Tensor) -> Tensor:
    """Invert `_to_blocks`, with the numbers of steps and sequences of `like`."""
    return values.unflatten(1, (-1, like.shape[1])).transpose(0, 1).flatten(0, 1)[: len(like)]


def _last(values: Tensor, like: Tensor) -> Tensor:
    """Return the last step of all blocks, (blocks, B, ...), with the number of sequences of `like`."""
    return values[-1].unflatten(0, (-1, like.shape[1]))


class States(torch.autograd.Function):
    """The states x (T + 1, B, N) from F (T, B, N, N), c (T, B, N) and x_1 (B, N)."""

    @staticmethod
    def forward(ctx: Any, matrix: Tensor, offset: Tensor, start: Tensor) -> Tensor:
        """Run the recursion."""
        states = Recursion(matrix).states(offset[..., None], start[..., None])[..., 0]
        ctx.save_for_backward(matrix, states)
        return states

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Run the adjoint recursion, backward in time."""
        matrix, states = ctx.saved_tensors
        total = backward(matrix).states(*from_last(gradient[..., None])).flip(0)
        return total[1:] @ states[:-1, ..., None].mT, total[1:, ..., 0], total[0, ..., 0]


class Covariances(torch.autograd.Function):
    """The covariances X (T + 1, B, N, N) from F and C (T, B, N, N) and X_1 (B, N, N); C, X_1 and X are symmetric."""

    @staticmethod
    def forward(ctx: Any, matrix: Tensor, offset: Tensor, start: Tensor) -> Tensor:
        """Run the recursion."""
        covariances = symmetric(Recursion(matrix).covariances(offset, start))
        ctx.save_for_backward(matrix, covariances)
        return covariances

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Run the adjoint recursion, backward in time."""
        matrix, covariances = ctx.saved_tensors
        total = symmetric(backward(matrix).covariances(*from_last(symmetric(gradient))).flip(0))
        return 2 * total[1:] @ matrix @ covariances[:-1], total[1:], total[0]


def backward(matrix: Tensor) -> Recursion:
    """Return the recursion of gradients, from the last state to the first."""
    return Recursion(matrix.mT.flip(0))


def from_last(values: Tensor) -> tuple[Tensor, Tensor]:
    """Split values into the offsets and the initial state of a recursion from the last step to the first."""
    return values[:-1].flip(0), values[-1]
