"""Glow, built from zuko's transforms: each step is a normalisation, a mixing, and a coupling that reads features.

    y = exp(s) x + b        v = P L U y        z_a = v_a,  z_b = exp(k(v_a, h)) v_b + m(v_a, h)

k and m are outputs of a perceptron. P is fixed, and P L U is initially a random rotation. Only this module imports
zuko, an optional dependency.

Source: Kingma and Dhariwal, 2018, arXiv 1807.03039. Couplings that read features h: Henter, Alexanderson and Beskow,
2020, arXiv 1905.06598.
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
    """The map x -> L U x with a faster inverse than zuko's, which copies the matrices for every row of x."""

    def _inverse(self, y: Tensor) -> Tensor:
        y = torch.linalg.solve_triangular(self.L.mT, y, upper=True, left=False)
        return torch.linalg.solve_triangular(self.U.mT, y, upper=False, left=False, unitriangular=True)


def normalisation(shift: Tensor, log_scale: Tensor) -> AffineTransform:
    """Return the transform x -> exp(log_scale) x + shift, with shift and log_scale (D,)."""
    return AffineTransform(shift, log_scale.exp(), event_dim=1)


class Glow(LazyComposedTransform):  # type: ignore[misc]
    """Bijection of R^D that is conditioned on features.

    Calling it with features (..., H), or None if H is 0, returns the transform. The transform and its inverse take one
    pass each.

    Args:
        size: D, number of coordinates.
        features: H, number of features; 0 for an unconditional bijection.
        steps: number of steps (normalisation, mixing and coupling).
        hidden: widths of the hidden layers of the perceptron in each coupling.
        bound: upper bound of |k|, the absolute log scale of a coupling.
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
        """Initialise every normalisation so that it maps the given values to mean 0 and variance 1.

        Args:
            x: values (N, D), with N of at least 2.
            features: features (N, H) of the values; None if H is 0.
        """
        for move in self.transforms:
            if hasattr(move, "log_scale"):
                spread, mean = torch.std_mean(x, 0)
                move.log_scale.copy_(-spread.clamp(min=torch.finfo(x.dtype).eps).log())
                move.shift.copy_(-mean * move.log_scale.exp())
            x = move(features)(x)


def _rotation(size: int) -> tuple[Tensor, Tensor]:
    """Return a random orthogonal matrix P L U as the permutation (D,) and one matrix (D, D) that contains L and U."""
    p, lower, upper = torch.linalg.lu(nn.init.orthogonal_(torch.empty(size, size)))
    pivots = upper.diagonal()
    return p.argmax(1), (lower * pivots).tril() + (upper / pivots[:, None]).triu(1)
