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
    """Multivariate normal with full covariance whose parameters are the features.

    The D + D^2 features are the location (D,) and the flattened whitening matrix U (D, D), which is lower triangular
    with a positive diagonal. The covariance is (U'U)^-1. Networks such as `networks.LinearSDE` return these features.
    """

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape.

        Args:
            shape: the variable and its features.

        Raises:
            ValueError: the number of features is not D + D^2.
        """
        n_features = shape.size + shape.size**2
        if shape.features != n_features:
            raise ValueError(
                f"Triangular requires {n_features} features, a location of size {shape.size} and a {shape.size} x "
                f"{shape.size} matrix, but the network returns {shape.features}; use a network for Triangular, such as "
                "networks.LinearSDE"
            )
        return TriangularModule(shape.size)


class TriangularModule(ConditionalDistribution):
    """Distribution module of `Triangular`; its parameters are the location (..., D) and the flattened U (..., D * D).

    Args:
        size: D, dimension of the variable.
    """

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
    """N(loc, (U'U)^-1) with a lower triangular U: batch shape (...), event shape (D,).

        log p(v) = sum_d log U_dd - e_d^2 / 2 - log(2 pi) / 2,        e = U (v - loc)

    Args:
        loc: location (..., D).
        whitening: U, (..., D, D), lower triangular with a positive diagonal.
        validate_args: whether torch checks the arguments; its global setting if None.
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

    @property
    def variance(self) -> Tensor:
        """Variance of each coordinate, (..., D)."""
        identity = torch.eye(self.event_shape[0], dtype=self.loc.dtype, device=self.loc.device)
        return torch.linalg.solve_triangular(self.whitening, identity, upper=False).square().sum(-1)

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Return reparameterised draws (*sample_shape, ..., D)."""
        shape = self._extended_shape(torch.Size(sample_shape))
        return self.color(torch.randn(shape, dtype=self.loc.dtype, device=self.loc.device))

    def color(self, noise: Tensor) -> Tensor:
        """Return the values v = loc + U^-1 e (..., D) for noise e (..., D)."""
        return self.loc + torch.linalg.solve_triangular(self.whitening, noise[..., None], upper=False)[..., 0]

    def whiten(self, value: Tensor) -> Tensor:
        """Return e = U (v - loc), (..., D), for values v (..., D).

        If v follows this distribution, e is standard normal.
        """
        return (self.whitening @ (value - self.loc)[..., None])[..., 0]

    @property
    def log_precision(self) -> Tensor:
        """Half the log-determinant of the precision matrix: the sum of log U_dd, (...)."""
        return self.whitening.diagonal(dim1=-2, dim2=-1).log().sum(-1)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density (...) of values (..., D), in nats."""
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
    """Autograd function from S (..., D, D) to the lower triangular U with U'U = S^-1.

    U is nan if S is not positive definite. The backward pass needs three matrix products, whereas torch's backward pass
    solves triangular systems. It returns a matrix whose symmetric part is the gradient, since S is symmetric.
    """

    @staticmethod
    def forward(ctx: Any, matrix: Tensor) -> Tensor:
        """Return U (..., D, D) for S (..., D, D)."""
        root, info = torch.linalg.cholesky_ex(matrix)
        identity = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
        inverse = torch.linalg.solve_triangular(root, identity, upper=False)
        inverse = inverse.masked_fill(info[..., None, None] != 0, torch.nan)
        ctx.save_for_backward(inverse)
        return inverse

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_inverse: Tensor) -> Tensor:
        """Return the gradient of S, given the gradient of U.

        It follows from dU = -Phi(U dS U') U, where Phi keeps the part below the diagonal and half of the diagonal.
        """
        (inverse,) = ctx.saved_tensors
        size = inverse.shape[-1]
        lower = torch.ones(size, size, dtype=inverse.dtype, device=inverse.device).tril_()
        lower.diagonal().mul_(0.5)
        return inverse.mT @ (to_inverse @ inverse.mT).mul_(-lower) @ inverse


def refuse_half(dtype: torch.dtype) -> None:
    """Raise an error if a dtype has half precision.

    Args:
        dtype: dtype of the parameters of a model that inverts covariances.

    Raises:
        ValueError: the dtype is bfloat16 or float16.
    """
    if dtype in (torch.bfloat16, torch.float16):
        raise ValueError(
            f"the model inverts covariances, which {dtype} does not support; fit with precision='bf16-mixed' or "
            "'32-true'"
        )
