"""The conditional flow: normal noise through a bijection, a scale and a location that depend on features.

    x = m(h) + s(h) f^-1(e; h),  e ~ N(0, I):        log p(x | h) = log N(f(u; h)) + log |det f'| - sum_d log s_d

with u = (x - m) / s. f consists of the steps of `dvae.distributions.glow`; if f is the identity, it is `Normal`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional
from typing_extensions import override

from .base import ConditionalDistribution, Parameters, Shape
from .flow import FlowDistribution


@dataclass(frozen=True)
class ConditionalFlow:
    """A flow of all coordinates of a step, conditioned on the features; unconditional for a variable without parents.

    The density is exact, with one value per step. Densities and draws take one pass each. The mean has no closed form;
    `mean` returns the value at zero noise instead.

    Args:
        steps: number of steps of the flow.
        hidden: widths of the perceptron in each step.
        bound: bound on the log scale of a step; smaller values keep free-running forecasts from diverging.
        min_scale: lower bound of s.
        residual: share of the previous value, as in `ConditionalDistribution`.
    """

    steps: int = 8
    hidden: tuple[int, ...] = (64,)
    bound: float = 2.0
    min_scale: float = 1e-3
    residual: float = False

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape.

        Raises:
            ValueError: `steps` is less than 1, or the bound is not positive.
            ImportError: zuko is not installed.
        """
        if self.steps < 1 or self.bound <= 0:
            raise ValueError(
                f"a ConditionalFlow needs at least one step and a positive bound, got {self.steps} and {self.bound}"
            )
        return ConditionalFlowModule(self, shape)


class ConditionalFlowModule(ConditionalDistribution):
    """Distribution module of `ConditionalFlow`; its parameters are m, s and h: (..., D), (..., D) and (..., H)."""

    event_dim = 1
    location_scale = True
    centred = True

    def __init__(self, spec: ConditionalFlow, shape: Shape):
        super().__init__(spec.residual)
        try:
            from .glow import Glow
        except ImportError as error:
            raise ImportError(
                "a ConditionalFlow requires the package zuko: pip install 'pyro-dvae[flows]'", name="zuko"
            ) from error
        self.min_scale = spec.min_scale
        self.out = self.projection(shape.features, 2 * shape.size, shape.size)
        self.flow = Glow(shape.size, shape.features, spec.steps, spec.hidden, spec.bound)

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        loc, raw = self.out(features).chunk(2, dim=-1)
        scale = functional.softplus(raw.contiguous()) + self.min_scale
        return self.add_residual(loc, previous), scale, features

    @override
    def distribution(self, parameters: Parameters) -> FlowDistribution:
        loc = parameters[0]
        return FlowDistribution(ConditionedBijection(self.flow, parameters), loc, loc.shape[:-1])

    @override
    def mean(self, parameters: Parameters) -> Tensor:
        return self.draw(parameters, torch.zeros_like(parameters[0]))

    @override
    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        return ConditionedBijection(self.flow, parameters).from_noise(noise)

    def start_at(self, parameters: Parameters, values: Tensor) -> None:
        """Initialise the flow so that values enter every coupling with mean 0 and variance 1, as in Glow.

        Args:
            parameters: parameters of N values, (N, ...) each.
            values: (N, D), at least two.
        """
        if len(values) < 2:
            raise ValueError(f"a flow needs at least two values to start from, got {len(values)}")
        loc, scale, features = parameters
        self.flow.start_at((values - loc) / scale, _optional_features(features))


class ConditionedBijection:
    """The bijection of a flow for given parameters, in the precision of the flow."""

    def __init__(self, flow: Any, parameters: Parameters):
        dtype = next(flow.parameters()).dtype
        if torch.finfo(dtype).bits < 32:
            raise ValueError(
                f"a ConditionalFlow has no half precision, but its parameters are {dtype}; use mixed precision"
            )
        self.loc, self.scale, features = (each.to(dtype) for each in parameters)
        with torch.autocast(self.loc.device.type, enabled=False):
            self.move = flow(_optional_features(features))

    def to_noise(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Map values (..., D) to noise (..., D) and the log-determinant (...)."""
        with torch.autocast(x.device.type, enabled=False):
            z, log_det = self.move.call_and_ladj((x.to(self.loc.dtype) - self.loc) / self.scale)
        return z, log_det - self.scale.log().sum(-1)

    def from_noise(self, z: Tensor) -> Tensor:
        """Map noise (..., D) to values (..., D)."""
        with torch.autocast(z.device.type, enabled=False):
            return torch.addcmul(self.loc, self.scale, self.move.inv(z.to(self.loc.dtype)))


def _optional_features(features: Tensor) -> Tensor | None:
    """Return the features as zuko expects them: None for zero features."""
    return features if features.shape[-1] else None
