"""The conditional flow: normal noise, transformed by a bijection, a scale and a location that depend on features.

    x = m(h) + s(h) f^-1(e; h),  e ~ N(0, I):        log p(x | h) = log N(f(u; h)) + log |det f'| - sum_d log s_d

with u = (x - m) / s. f consists of the steps of `dvae.distributions.glow`. If f is the identity, the distribution is
`Normal`.
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
    """Normalizing flow of all coordinates of a step, conditioned on the features.

    For a model variable without parents, the flow is unconditional. The density is exact, with one value per time step.
    Densities and draws take one pass each. The mean has no closed form; `mean` returns the value at zero noise instead.

    Args:
        steps: number of steps of the flow (normalisation, mixing and coupling), at least 1; not time steps.
        hidden: widths of the hidden layers of the perceptron in each coupling.
        bound: upper bound of the absolute log scale of a coupling, above 0. Smaller values keep free-running forecasts
            from diverging.
        min_scale: lower bound of the scale s.
        residual: share of the previous value, as in `ConditionalDistribution`.
    """

    steps: int = 8
    hidden: tuple[int, ...] = (64,)
    bound: float = 2.0
    min_scale: float = 1e-3
    residual: float = False

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape.

        Args:
            shape: the variable and its features.

        Raises:
            ValueError: `steps` is less than 1, or the bound is not positive.
            ImportError: zuko is not installed.
        """
        if self.steps < 1 or self.bound <= 0:
            raise ValueError(
                "a ConditionalFlow needs `steps` of at least 1 and a `bound` above 0, got "
                f"steps={self.steps} and bound={self.bound}"
            )
        return ConditionalFlowModule(self, shape)


class ConditionalFlowModule(ConditionalDistribution):
    """Distribution module of `ConditionalFlow`.

    Its parameters are the location m (..., D), the scale s (..., D) and the features h (..., H).
    """

    event_dim = 1
    location_scale = True
    centred = True

    def __init__(self, spec: ConditionalFlow, shape: Shape):
        super().__init__(spec.residual)
        try:
            from .glow import Glow
        except ImportError as error:
            raise ImportError(
                "a ConditionalFlow requires the package zuko; install it with pip install 'pyro-dvae[flows]'",
                name="zuko",
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
        """Initialise every normalisation so that it maps the given values to mean 0 and variance 1, as in Glow.

        Args:
            parameters: result of `forward` for N features: m (N, D), s (N, D) and h (N, H).
            values: values of the variable, (N, D) with N of at least 2.

        Raises:
            ValueError: there are fewer than two values.
        """
        if len(values) < 2:
            raise ValueError(
                f"`values` must contain at least 2 values, whose variance initialises the flow, got {len(values)}"
            )
        loc, scale, features = parameters
        self.flow.start_at((values - loc) / scale, _optional_features(features))


class ConditionedBijection:
    """Bijection of a conditional flow for given parameters, computed in the precision of the flow's weights.

    Args:
        flow: the Glow f.
        parameters: m (..., D), s (..., D) and h (..., H), as `ConditionalFlowModule.forward` returns them.

    Raises:
        ValueError: the weights of the flow have half precision.
    """

    def __init__(self, flow: Any, parameters: Parameters):
        dtype = next(flow.parameters()).dtype
        if torch.finfo(dtype).bits < 32:
            raise ValueError(
                f"a ConditionalFlow does not support half precision, but its weights are {dtype}; keep float32 weights "
                "and fit with precision='bf16-mixed' or '32-true'"
            )
        self.loc, self.scale, features = (each.to(dtype) for each in parameters)
        with torch.autocast(self.loc.device.type, enabled=False):
            self.move = flow(_optional_features(features))

    def to_noise(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Map values x (..., D) to noise z (..., D) and log |det dz/dx| (...)."""
        with torch.autocast(x.device.type, enabled=False):
            z, log_det = self.move.call_and_ladj((x.to(self.loc.dtype) - self.loc) / self.scale)
        return z, log_det - self.scale.log().sum(-1)

    def from_noise(self, z: Tensor) -> Tensor:
        """Map noise (..., D) to values (..., D), the inverse of `to_noise`."""
        with torch.autocast(z.device.type, enabled=False):
            return torch.addcmul(self.loc, self.scale, self.move.inv(z.to(self.loc.dtype)))


def _optional_features(features: Tensor) -> Tensor | None:
    """Return the features (..., H), or None if H = 0, as zuko expects for an unconditional flow."""
    return features if features.shape[-1] else None
