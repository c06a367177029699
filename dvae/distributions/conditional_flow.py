"""The conditional flow: a location, a scale and a bijection that read features, of normal noise.

    x = m(h) + s(h) f^-1(e; h),  e ~ N(0, I):        log p(x | h) = log N(f(u; h)) + log |det f'| - sum_d log s_d

with u = (x - m) / s. f are the steps of `dvae.distributions.glow`; with f the identity it is `Normal`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional
from typing_extensions import override

from .base import Law, Parameters, Shape
from .flow import FlowDistribution


@dataclass(frozen=True)
class ConditionalFlow:
    """A flow of all coordinates of a step, which reads the features; without any, of a variable without parents.

    Its density is exact, and one for all that a step has. Densities and draws take one pass each. Where a mean is asked
    for, there is none in closed form: for it stands the value of the noise 0.

    Args:
        steps: of the flow.
        hidden: widths of the perceptron in each step.
        bound: of the logarithm of what a step multiplies by; the smaller, the less can a free run go astray.
        min_scale: s stays above it.
        residual: see `Law`.
    """

    steps: int = 8
    hidden: tuple[int, ...] = (64,)
    bound: float = 2.0
    min_scale: float = 1e-3
    residual: float = False

    def build(self, shape: Shape) -> Law:
        """The law of a variable of this shape.

        Raises:
            ValueError: no step, or a bound that is not positive.
            ImportError: zuko is not installed.
        """
        if self.steps < 1 or self.bound <= 0:
            raise ValueError(
                f"a ConditionalFlow has at least one step and a positive bound, got {self.steps} and {self.bound}"
            )
        return ConditionalFlowLaw(self, shape)


class ConditionalFlowLaw(Law):
    """What `ConditionalFlow` describes; its parameters are m, s and h: (..., D), (..., D) and (..., H)."""

    event_dim = 1
    location_scale = True
    centred = True

    def __init__(self, spec: ConditionalFlow, shape: Shape):
        super().__init__(spec.residual)
        try:
            from .glow import Glow
        except ImportError as error:
            raise ImportError(
                "a ConditionalFlow is made of the package zuko: pip install 'pyro-dvae[flows]'", name="zuko"
            ) from error
        self.min_scale = spec.min_scale
        self.out = self.projection(shape.features, 2 * shape.size, shape.size)
        self.flow = Glow(shape.size, shape.features, spec.steps, spec.hidden, spec.bound)

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        loc, raw = self.out(features).chunk(2, dim=-1)
        scale = functional.softplus(raw.contiguous()) + self.min_scale
        return self.moved(loc, previous), scale, features

    @override
    def distribution(self, parameters: Parameters) -> FlowDistribution:
        loc = parameters[0]
        return FlowDistribution(Conditioned(self.flow, parameters), loc, loc.shape[:-1])

    @override
    def mean(self, parameters: Parameters) -> Tensor:
        return self.draw(parameters, torch.zeros_like(parameters[0]))

    @override
    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        return Conditioned(self.flow, parameters).from_noise(noise)

    def start_at(self, parameters: Parameters, values: Tensor) -> None:
        """Has values enter every coupling with mean 0 and variance 1: the data-dependent start of Glow.

        Args:
            parameters: of N values, (N, ...) each.
            values: (N, D), two at least.
        """
        if len(values) < 2:
            raise ValueError(f"a flow starts at two values or more, got {len(values)}")
        loc, scale, features = parameters
        self.flow.start_at((values - loc) / scale, _read(features))


class Conditioned:
    """The bijection that parameters make of a flow, in its own precision."""

    def __init__(self, flow: Any, parameters: Parameters):
        dtype = next(flow.parameters()).dtype
        if torch.finfo(dtype).bits < 32:
            raise ValueError(
                f"a ConditionalFlow has no half precision, but its parameters are {dtype}; use mixed precision"
            )
        self.loc, self.scale, features = (each.to(dtype) for each in parameters)
        with torch.autocast(self.loc.device.type, enabled=False):
            self.move = flow(_read(features))

    def to_noise(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The noise (..., D) that stands for values (..., D), and the log-determinant (...)."""
        with torch.autocast(x.device.type, enabled=False):
            z, log_det = self.move.call_and_ladj((x.to(self.loc.dtype) - self.loc) / self.scale)
        return z, log_det - self.scale.log().sum(-1)

    def from_noise(self, z: Tensor) -> Tensor:
        """The values (..., D) for which noise (..., D) stands."""
        with torch.autocast(z.device.type, enabled=False):
            return torch.addcmul(self.loc, self.scale, self.move.inv(z.to(self.loc.dtype)))


def _read(features: Tensor) -> Tensor | None:
    """Features as flows take them: None for none."""
    return features if features.shape[-1] else None
