"""Hurdle distributions: exact zeros, and a continuous distribution of the positive values.

    p(x) = g [x = 0] + (1 - g) LogNormal(x; m, s) [x > 0]

Rain, expenses and delays have such values. The model is the two-part model of Cragg (1971) and Duan et al. (1983). Its
density is with respect to Lebesgue measure plus a unit mass at 0: log g is the log probability of 0.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor
from torch import distributions as plain
from torch.distributions import constraints
from torch.nn import functional
from typing_extensions import override


class HurdleLogNormal(TorchDistribution):
    """0 with probability g, else log-normal; all parameters have the same shape (..., D).

    Args:
        gate_logits: logits of g.
        loc, scale: mean and standard deviation of the logarithm of positive values.
        validate_args: whether to check the parameters.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {
        "gate_logits": constraints.real,
        "loc": constraints.real,
        "scale": constraints.positive,
    }
    support = constraints.nonnegative  # type: ignore[assignment]

    def __init__(self, gate_logits: Tensor, loc: Tensor, scale: Tensor, validate_args: bool | None = None):
        self.gate_logits, self.loc, self.scale = torch.broadcast_tensors(gate_logits, loc, scale)
        super().__init__(self.loc.shape, validate_args=validate_args)

    @property
    def positive(self) -> plain.LogNormal:
        """Distribution of the positive values."""
        return plain.LogNormal(self.loc, self.scale, validate_args=False)

    @property
    def mean(self) -> Tensor:
        """Mean (..., D)."""
        return (-self.gate_logits).sigmoid() * self.positive.mean

    @property
    def variance(self) -> Tensor:
        """Variance (..., D)."""
        positive = self.positive
        return (-self.gate_logits).sigmoid() * (positive.variance + positive.mean.square()) - self.mean.square()

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log probability of 0, and the log density of positive values, in nats."""
        is_zero = value == 0
        positive = self.positive.log_prob(torch.where(is_zero, 1.0, value))
        return torch.where(is_zero, 0.0, positive) + functional.logsigmoid(
            torch.where(is_zero, self.gate_logits, -self.gate_logits)
        )

    def cdf(self, value: Tensor) -> Tensor:
        """Return the probability of values up to `value`; it jumps by g at 0."""
        gate = self.gate_logits.sigmoid()
        above = torch.where(value > 0, self.positive.cdf(value.clamp(min=1e-30)), 0.0)
        return torch.where(value < 0, 0.0, gate + (1 - gate) * above)

    @override
    def sample(self, sample_shape: Any = ()) -> Tensor:
        with torch.no_grad():
            positive = self.positive.sample(torch.Size(sample_shape))
            is_zero = torch.rand_like(positive) < self.gate_logits.sigmoid()
            return torch.where(is_zero, 0.0, positive)

    def expand(self, batch_shape: Any, _instance: object = None) -> HurdleLogNormal:
        """Return the distribution with another batch shape."""
        gate_logits, loc, scale = (each.expand(batch_shape) for each in (self.gate_logits, self.loc, self.scale))
        return HurdleLogNormal(gate_logits, loc, scale, validate_args=False)
