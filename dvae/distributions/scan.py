"""Recursions over T steps in blocks: run all blocks in parallel from zero, then add the effect of their initial states.

Consider a linear recursion with known matrices, x_{t+1} = F_t x_t + c_t, or a recursion of covariances,
X_{t+1} = F_t X_t F_t' + C_t. A block of steps is again one step of the same kind. Its matrix is the product D of the F,
and its offset is the result from a zero initial state. The same holds for a block of the Riccati recursion

    P_{t+1} = Q_t + F_t P_t A_t'        F_t = A_t W_t        W_t = (I + P_t G_t)^-1

If C, W and D are computed for the solution with P_1 = 0, the solution for any P_1 is

    P_{t+1} = C_{t+1} + D_t (I + P_1 J_t)^-1 P_1 D_t'        J_t = D_0' G_1 W_1 D_0 + ... + D_{t-1}' G_t W_t D_{t-1}

Särkkä and García-Fernández (2021, arXiv 1905.13002) combine the same D, C and J, which they call A, C and J, in pairs.
The initial states of the blocks follow the same recursion with one step per block. Instead of T sequential steps, there
are 16 or 32 at each of log T / log 16 levels. This doubles the work; memory stays linear in T.
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
"""Maximum number of rows per step (sequences times N) with which blocks are used.

With more rows, a single step already keeps a core busy, and blocks would only double the work.
"""


def use_blocks(matrix: Tensor) -> bool:
    """Return whether a recursion with these matrices (T, B, N, N) is faster in blocks than in sequential steps."""
    steps, batch, size, _ = matrix.shape
    return steps >= 4 * BLOCK and batch * size <= min(WIDE, steps // 6)


class Recursion:
    """Linear recursions with the same matrices.

    Args:
        matrix: F_1 to F_T, (T, B, N, N).
    """

    def __init__(self, matrix: Tensor):
        self.matrix = matrix

    @cached_property
    def _blocks(self) -> tuple[Recursion, Tensor, Recursion]:
        """The recursion within all blocks at once, the products within blocks, and the recursion between blocks."""
        matrix = _to_blocks(self.matrix)
        passed = products(matrix)
        return Recursion(matrix), passed, Recursion(_last(passed, self.matrix))

    def states(self, offset: Tensor, start: Tensor) -> Tensor:
        """Return the states x_1 to x_{T+1} of x_{t+1} = F_t x_t + c_t, (T + 1, B, N, M).

        Args:
            offset: c_1 to c_T, (T, B, N, M).
            start: x_1, (B, N, M).
        """
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
        """Return the covariances X_1 to X_{T+1} of X_{t+1} = F_t X_t F_t' + C_t, (T + 1, B, N, N).

        Args:
            offset: C_1 to C_T, (T, B, N, N).
            start: X_1, (B, N, N).
        """
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
    """Run the Riccati recursion of this module.

    Args:
        transition: A_1 to A_T, (T, B, N, N).
        noise: Q_1 to Q_T, (T, B, N, N).
        information: G_1 to G_T, (T, B, N, N).
        start: P_1, (B, N, N).

    Returns:
        P_1 to P_{T+1}, (T + 1, B, N, N), and W_1 to W_T and F_1 to F_T, (T, B, N, N) each.
    """
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
    """Return the products D_t = F_t ... F_1 for all t, (T, B, N, N), of matrices F (T, B, N, N)."""
    results, steps = _allocate(matrix[0], len(matrix) - 1)
    for f, last, new in zip(matrix.unbind(0)[1:], steps, steps[1:], strict=False):
        torch.bmm(f, last, out=new)
    return results


def symmetric(matrix: Tensor) -> Tensor:
    """Return the symmetric part (M + M') / 2 of matrices M (..., N, N)."""
    return 0.5 * (matrix + matrix.mT)


def _allocate(start: Tensor, steps: int) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Return memory (steps + 1, ...) for the states of a recursion, and views of its steps.

    The first state is set to `start`. Matrix products are slower with other memory layouts.
    """
    memory = start.new_empty(steps + 1, *start.shape)
    memory[0] = start
    return memory, memory.unbind(0)


def _to_blocks(values: Tensor) -> Tensor:
    """Rearrange values (T, B, ...) into blocks, (BLOCK, number of blocks * B, ...); zeros pad the last block."""
    values = torch.cat([values, values.new_zeros(-len(values) % BLOCK, *values.shape[1:])])
    return values.unflatten(0, (-1, BLOCK)).transpose(0, 1).flatten(1, 2).contiguous()


def _from_blocks(values: Tensor, like: Tensor) -> Tensor:
    """Invert `_to_blocks`, with the number of steps T and of sequences B of a tensor `like` (T, B, ...)."""
    return values.unflatten(1, (-1, like.shape[1])).transpose(0, 1).flatten(0, 1)[: len(like)]


def _last(values: Tensor, like: Tensor) -> Tensor:
    """Return the last step of each block, (number of blocks, B, ...), for a tensor `like` (T, B, ...)."""
    return values[-1].unflatten(0, (-1, like.shape[1]))


class States(torch.autograd.Function):
    """Autograd function from F (T, B, N, N), c (T, B, N) and x_1 (B, N) to the states x (T + 1, B, N)."""

    @staticmethod
    def forward(ctx: Any, matrix: Tensor, offset: Tensor, start: Tensor) -> Tensor:
        """Return the states."""
        states = Recursion(matrix).states(offset[..., None], start[..., None])[..., 0]
        ctx.save_for_backward(matrix, states)
        return states

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the gradients of F, c and x_1, given the gradient of the states."""
        matrix, states = ctx.saved_tensors
        total = backward(matrix).states(*from_last(gradient[..., None])).flip(0)
        return total[1:] @ states[:-1, ..., None].mT, total[1:, ..., 0], total[0, ..., 0]


class Covariances(torch.autograd.Function):
    """Autograd function from F, C (T, B, N, N) and X_1 (B, N, N) to the covariances X (T + 1, B, N, N).

    C, X_1 and X are symmetric.
    """

    @staticmethod
    def forward(ctx: Any, matrix: Tensor, offset: Tensor, start: Tensor) -> Tensor:
        """Return the covariances."""
        covariances = symmetric(Recursion(matrix).covariances(offset, start))
        ctx.save_for_backward(matrix, covariances)
        return covariances

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the gradients of F, C and X_1, given the gradient of the covariances."""
        matrix, covariances = ctx.saved_tensors
        total = symmetric(backward(matrix).covariances(*from_last(symmetric(gradient))).flip(0))
        return 2 * total[1:] @ matrix @ covariances[:-1], total[1:], total[0]


def backward(matrix: Tensor) -> Recursion:
    """Return the recursion of the gradients of the states, from the last state to the first, for F (T, B, N, N)."""
    return Recursion(matrix.mT.flip(0))


def from_last(values: Tensor) -> tuple[Tensor, Tensor]:
    """Return the offsets (T, ...) and the initial state (...) of a backward recursion from values (T + 1, ...).

    The initial state is the last value; the offsets are the other values in reverse order.
    """
    return values[:-1].flip(0), values[-1]
