"""The steps of Glow, built from zuko's transforms: normalisation, mixing, and a coupling that reads features.

    y = exp(s) x + b        v = P L U y        z_a = v_a,  z_b = exp(k(v_a, h)) v_b + m(v_a, h)

Source: Kingma and Dhariwal, 2018, arXiv 1807.03039. Couplings that read features h: Henter, Alexanderson and Beskow,
2020, arXiv 1905.06598. P is fixed, and P L U is initially a random rotation. Only this module imports zuko, an optional
dependency.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from pyro import settings
from torch import Tensor, nn
from torch.distributions import AffineTransform

# importing zuko disables torch's validation of distribution arguments for the whole process
with settings.context(validate_distributions_torch=settings.get("validate_distributions_torch")):
    from zuko.flows import GeneralCouplingTransform, UnconditionalTransform
    from zuko.lazy import LazyComposedTransform
    from zuko.transforms import LULinearTransform, MonotonicAffineTransform, PermutationTransform


class Mixing(LULinearTransform):  # type: ignore[misc]
    """The map L U x with an inverse that solves all rows at once; zuko's copies the matrices for every row."""

    def _inverse(self, y: Tensor) -> Tensor:
        y = torch.linalg.solve_triangular(self.L.mT, y, upper=True, left=False)
        return torch.linalg.solve_triangular(self.U.mT, y, upper=False, left=False, unitriangular=True)


def normalisation(shift: Tensor, log_scale: Tensor) -> AffineTransform:
    """Return the transform exp(log_scale) x + shift."""
    return AffineTransform(shift, log_scale.exp(), event_dim=1)


class Glow(LazyComposedTransform):  # type: ignore[misc]
    """A bijection of R^D conditioned on features (..., H) or None; its inverse also takes one pass.

    Args:
        size: D, number of coordinates.
        features: H, number of features; 0 for an unconditional bijection.
        steps: number of steps.
        hidden: widths of the perceptron of each coupling.
        bound: upper bound of |k|.
    """

    def __init__(self, size: int, features: int, steps: int, hidden: Sequence[int], bound: float):
        moves: list[Any] = []
        for _ in range(steps):
            order, both = _rotation(size)
            affine = partial(MonotonicAffineTransform, slope=math.exp(-bound))
            coupling = GeneralCouplingTransform(size, features, univariate=affine, hidden_features=hidden)
            with torch.no_grad():  # start near the identity
                for last in coupling.hyper[-1].parameters() if hasattr(coupling, "hyper") else coupling.phi:
                    last.mul_(0.01)
            moves += [
                UnconditionalTransform(normalisation, shift=torch.zeros(size), log_scale=torch.zeros(size)),
                UnconditionalTransform(Mixing, LU=both),
                UnconditionalTransform(PermutationTransform, order=order, buffer=True),
                coupling,
            ]
        super().__init__(*moves)

    @torch.no_grad()
    def start_at(self, x: Tensor, features: Tensor | None) -> None:
        """Initialise each normalisation in turn so that these values (N, D) leave it with mean 0 and variance 1."""
        for move in self.transforms:
            if hasattr(move, "log_scale"):
                spread, mean = torch.std_mean(x, 0)
                move.log_scale.copy_(-spread.clamp(min=torch.finfo(x.dtype).eps).log())
                move.shift.copy_(-mean * move.log_scale.exp())
            x = move(features)(x)


def _rotation(size: int) -> tuple[Tensor, Tensor]:
    """Return a random rotation as a permutation and, in one matrix, its triangular factors."""
    p, lower, upper = torch.linalg.lu(nn.init.orthogonal_(torch.empty(size, size)))
    pivots = upper.diagonal()
    return p.argmax(1), (lower * pivots).tril() + (upper / pivots[:, None]).triu(1)
