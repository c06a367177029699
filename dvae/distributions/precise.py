"""Distributions whose values or densities require more precision than the float32 of the networks.

`OffsetDistribution` subtracts the mean in float64, because float32 cannot represent the noise in 1e9 + N(0, 1).
`DoublePrecision` evaluates a density in float64 if its terms cancel: a Poisson log density at mean 1e7 is a difference
of terms near 1e8. `BoundedDistribution` sets the density to 0 outside the support, such as below the scale of a Pareto,
where torch extrapolates.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor
from torch.distributions import constraints
from typing_extensions import override


class _Wrapped(TorchDistribution):
    """Base class of distributions with the shapes, moments and support of another distribution.

    Args:
        base: the other distribution.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    def __init__(self, base: Any):
        self.base = base
        self.has_rsample = base.has_rsample
        super().__init__(base.batch_shape, base.event_shape, validate_args=False)

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Return reparameterised draws of the base distribution, (*sample_shape, *batch_shape, *event_shape)."""
        return self.base.rsample(torch.Size(sample_shape))  # type: ignore[no-any-return]

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Return draws of the base distribution, (*sample_shape, *batch_shape, *event_shape)."""
        return self.base.sample(torch.Size(sample_shape))  # type: ignore[no-any-return]

    @property
    def mean(self) -> Tensor:
        """Mean of the base distribution."""
        return self.base.mean  # type: ignore[no-any-return]

    @property
    def variance(self) -> Tensor:
        """Variance of the base distribution."""
        return self.base.variance  # type: ignore[no-any-return]

    @property
    def support(self) -> constraints.Constraint:  # type: ignore[override]
        """Support of the base distribution."""
        return self.base.support


class OffsetDistribution(_Wrapped):
    """Distribution of offset + u, where u follows the base distribution; its values are in float64.

    Args:
        base: distribution of u, with values (..., D).
        offset: offset (D,) in float64.
        dtype: dtype of the parameters of the base distribution.
    """

    def __init__(self, base: Any, offset: Tensor, dtype: torch.dtype):
        super().__init__(base)
        self.offset, self.dtype = offset, dtype

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density of float64 values in nats; the result has the precision of the base distribution."""
        return self.base.log_prob((value - self.offset).to(self.dtype))  # type: ignore[no-any-return]

    @override
    def rsample(self, sample_shape: Any = ()) -> Tensor:
        return super().rsample(sample_shape) + self.offset

    @override
    def sample(self, sample_shape: Any = ()) -> Tensor:
        return super().sample(sample_shape) + self.offset

    @property
    @override
    def mean(self) -> Tensor:
        return super().mean + self.offset

    def expand(self, batch_shape: Any, _instance: object = None) -> OffsetDistribution:
        """Return the distribution with another batch shape."""
        return OffsetDistribution(self.base.expand(batch_shape), self.offset, self.dtype)


class BoundedDistribution(_Wrapped):
    """Distribution with density 0 outside its support, for a support that depends on parameters.

    Torch may return a positive density outside such a support.

    Args:
        base: distribution whose support is enforced.
    """

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density or log probability in nats."""
        inside = self.support.check(value)  # type: ignore[no-untyped-call]
        return torch.where(inside, self.base.log_prob(value), -torch.inf)

    def expand(self, batch_shape: Any, _instance: object = None) -> BoundedDistribution:
        """Return the distribution with another batch shape."""
        return BoundedDistribution(self.base.expand(batch_shape))


class DoublePrecision(_Wrapped):
    """Distribution whose log density is computed in float64 and returned in the precision of the value.

    Args:
        base: distribution that provides draws, moments and support.
        double: function that returns the base distribution with parameters in float64.
    """

    def __init__(self, base: Any, double: Callable[[], Any]):
        super().__init__(base)
        self.double = double

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density or log probability in nats."""
        return self.double().log_prob(value.double()).to(value.dtype)  # type: ignore[no-any-return]

    def expand(self, batch_shape: Any, _instance: object = None) -> DoublePrecision:
        """Return the distribution with another batch shape."""
        return DoublePrecision(self.base.expand(batch_shape), lambda: self.double().expand(batch_shape))
