"""Distributions whose values or densities need more than the float32 of the networks.

`Offset` takes the mean off values in float64, of which 1e9 + N(0, 1) leaves nothing in float32. `InDouble` evaluates
in float64 a density whose terms cancel: that of a Poisson of mean 1e7 is the difference of terms near 1e8. `Bounded`
has no density below the scale of a Pareto, where torch extrapolates.
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
    """A distribution with the shapes and the support of another one."""

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    def __init__(self, base: Any):
        self.base = base
        self.has_rsample = base.has_rsample
        super().__init__(base.batch_shape, base.event_shape, validate_args=False)

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """A reparameterised draw."""
        return self.base.rsample(torch.Size(sample_shape))  # type: ignore[no-any-return]

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """A draw."""
        return self.base.sample(torch.Size(sample_shape))  # type: ignore[no-any-return]

    @property
    def mean(self) -> Tensor:
        """That of the base."""
        return self.base.mean  # type: ignore[no-any-return]

    @property
    def variance(self) -> Tensor:
        """That of the base."""
        return self.base.variance  # type: ignore[no-any-return]

    @property
    def support(self) -> constraints.Constraint:  # type: ignore[override]
        """That of the base."""
        return self.base.support


class Offset(_Wrapped):
    """The distribution of offset + value, which is in float64.

    Args:
        base: of the value.
        offset: (D,) float64.
        dtype: of the parameters of the base.
    """

    def __init__(self, base: Any, offset: Tensor, dtype: torch.dtype):
        super().__init__(base)
        self.offset, self.dtype = offset, dtype

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density, in the precision of the base."""
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

    def expand(self, batch_shape: Any, _instance: object = None) -> Offset:
        """With another batch shape."""
        return Offset(self.base.expand(batch_shape), self.offset, self.dtype)


class Bounded(_Wrapped):
    """A distribution whose density is 0 outside a support that depends on its parameters; torch's may not be.

    Args:
        base: the distribution.
    """

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density or probability."""
        inside = self.support.check(value)  # type: ignore[no-untyped-call]
        return torch.where(inside, self.base.log_prob(value), -torch.inf)

    def expand(self, batch_shape: Any, _instance: object = None) -> Bounded:
        """With another batch shape."""
        return Bounded(self.base.expand(batch_shape))


class InDouble(_Wrapped):
    """A distribution whose log density is evaluated in float64, and returned in the precision of the value.

    Args:
        base: the distribution.
        double: returns the same with parameters in float64.
    """

    def __init__(self, base: Any, double: Callable[[], Any]):
        super().__init__(base)
        self.double = double

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density or probability."""
        return self.double().log_prob(value.double()).to(value.dtype)  # type: ignore[no-any-return]

    def expand(self, batch_shape: Any, _instance: object = None) -> InDouble:
        """With another batch shape."""
        return InDouble(self.base.expand(batch_shape), lambda: self.double().expand(batch_shape))
