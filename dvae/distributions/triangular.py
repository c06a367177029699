"""A multivariate normal parameterised by a triangular factor of its precision matrix."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.distributions import Normal, constraints
from torch.distributions.kl import register_kl
from typing_extensions import override

from .base import ConditionalDistribution, Parameters, Shape


@dataclass(frozen=True)
class Triangular:
    """A normal with full covariance; the features are its location and whitening matrix."""

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape."""
        n_features = shape.size + shape.size**2
        if shape.features != n_features:
            raise ValueError(
                f"a Triangular distribution takes {n_features} features, but the network gives {shape.features}"
            )
        return TriangularModule(shape.size)


class TriangularModule(ConditionalDistribution):
    """Distribution module of `Triangular`; its parameters have shapes (..., D) and (..., D * D)."""

    event_dim = 1

    def __init__(self, size: int):
        super().__init__()
        self.size = size

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        return features.split([self.size, self.size**2], dim=-1)

    @override
    def distribution(self, parameters: Parameters) -> TriangularNormal:
        loc, whitening = parameters
        return TriangularNormal(loc, whitening.unflatten(-1, (self.size, self.size)), validate_args=False)

    @override
    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        return self.distribution(parameters).color(noise)


class TriangularNormal(TorchDistribution):
    """N(loc, (U'U)^-1) with a lower triangular U: batch (...), event (D,).

        log p(v) = sum_d log U_dd - e_d^2 / 2 - log(2 pi) / 2,        e = U (v - loc)

    Args:
        loc: (..., D).
        whitening: U, (..., D, D), lower triangular with a positive diagonal.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {
        "loc": constraints.real_vector,
        "whitening": constraints.lower_cholesky,
    }
    support = constraints.real_vector
    has_rsample = True

    def __init__(self, loc: Tensor, whitening: Tensor, validate_args: bool | None = None):
        self.loc, self.whitening = loc, whitening
        super().__init__(loc.shape[:-1], loc.shape[-1:], validate_args=validate_args)

    @property
    def mean(self) -> Tensor:
        """Mean (..., D)."""
        return self.loc

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Return draws (*sample_shape, ..., D)."""
        shape = self._extended_shape(torch.Size(sample_shape))
        return self.color(torch.randn(shape, dtype=self.loc.dtype, device=self.loc.device))

    def color(self, noise: Tensor) -> Tensor:
        """Return the value v with e = `noise`."""
        return self.loc + torch.linalg.solve_triangular(self.whitening, noise[..., None], upper=False)[..., 0]

    def whiten(self, value: Tensor) -> Tensor:
        """Return e, which is standard normal if the value follows this distribution."""
        return (self.whitening @ (value - self.loc)[..., None])[..., 0]

    @property
    def log_precision(self) -> Tensor:
        """The sum of log U_dd, (...)."""
        return self.whitening.diagonal(dim1=-2, dim2=-1).log().sum(-1)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density (...), in nats."""
        constant = self.event_shape[0] * math.log(2 * math.pi)
        return self.log_precision - 0.5 * ((self.whiten(value) ** 2).sum(-1) + constant)


@register_kl(Normal, TriangularNormal)
def _from_diagonal(q: Normal, p: TriangularNormal) -> Tensor:
    distance = (p.whiten(q.loc) ** 2).sum(-1)
    spread = ((p.whitening * q.scale[..., None, :]) ** 2).sum((-2, -1))
    return 0.5 * (distance + spread - p.event_shape[0]) - p.log_precision - q.scale.log().sum(-1)


@register_kl(TriangularNormal, TriangularNormal)
def _from_triangular(q: TriangularNormal, p: TriangularNormal) -> Tensor:
    between = torch.linalg.solve_triangular(q.whitening.mT, p.whitening.mT, upper=True)  # (U_p U_q^-1)'
    distance = (p.whiten(q.loc) ** 2).sum(-1) + (between**2).sum((-2, -1)) - p.event_shape[0]
    return 0.5 * distance + q.log_precision - p.log_precision


class InverseCholesky(torch.autograd.Function):
    """Map S (..., D, D) to the lower triangular U with U'U = S^-1; nan where S is not symmetric positive definite.

    The backward pass takes three matrix products, whereas torch's solves triangular systems. It returns a matrix whose
    symmetric part is the gradient.
    """

    @staticmethod
    def forward(ctx: Any, matrix: Tensor) -> Tensor:
        """Return U."""
        root, info = torch.linalg.cholesky_ex(matrix)
        identity = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
        inverse = torch.linalg.solve_triangular(root, identity, upper=False)
        inverse = inverse.masked_fill(info[..., None, None] != 0, torch.nan)
        ctx.save_for_backward(inverse)
        return inverse

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_inverse: Tensor) -> Tensor:
        """Return the gradient from dU = -Phi(U dS U') U; Phi keeps the lower triangle and half of the diagonal."""
        (inverse,) = ctx.saved_tensors
        size = inverse.shape[-1]
        lower = torch.ones(size, size, dtype=inverse.dtype, device=inverse.device).tril_()
        lower.diagonal().mul_(0.5)
        return inverse.mT @ (to_inverse @ inverse.mT).mul_(-lower) @ inverse


def refuse_half(dtype: torch.dtype) -> None:
    """Raise an error for parameters in half precision.

    Raises:
        ValueError: the dtype has half precision; the message names the supported precisions.
    """
    if dtype in (torch.bfloat16, torch.float16):
        raise ValueError(
            f"covariances are inverted, which {dtype} does not support; fit with precision='bf16-mixed' or '32-true'"
        )
