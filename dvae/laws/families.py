"""Heads: features to the distribution of one variable.

A head turns features (..., H) into the parameters of an elementwise distribution over (..., D). The parameters are
plain tensors, so that a loop over time handles no distribution objects.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol

import pyro.distributions as dist
import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor, nn
from torch.nn import functional

Parameters = tuple[Tensor, ...]


class Head(nn.Module):
    """Features to the parameters of a distribution whose first parameter is its location.

    A head of one's own gives `forward`, `distribution` and `draw`, and where the distribution is a location and a scale
    says so. As it stands, it is one of normals.

    Args:
        residual: share of the variable's own previous value that its location keeps, so that features give the rest:
            1 (True) for an offset. Below 1 a free run forgets where it was, and cannot drift without bound. A
            residual head starts near that share, with weights a hundredth of the usual.

    Raises:
        ValueError: a share that is not between 0 and 1.
    """

    deterministic: ClassVar[bool] = False
    """Whether the variable is a function of its parents, without a density."""
    location_scale: ClassVar[bool] = False
    """Whether the first two parameters (or the one) are a location and a scale, which `in_units` can put into another
    unit. Probabilities and rates cannot be."""

    def __init__(self, residual: float = False):
        super().__init__()
        if not 0 <= residual <= 1:
            raise ValueError(f"residual is {residual}; it is a share of the previous value, from 0 to 1")
        self.residual = float(residual)

    def projection(self, features: int, out: int, locations: int) -> nn.Linear:
        """The linear layer to `out` parameters, of which the first so many are locations."""
        layer = nn.Linear(features, out)
        if self.residual:
            with torch.no_grad():
                layer.weight[:locations] *= 0.01
                layer.bias[:locations] *= 0.01
        return layer

    def moved(self, loc: Tensor, previous: Tensor | None) -> Tensor:
        """The location from what the features give and the variable's own previous value."""
        return loc if previous is None else torch.add(loc, previous, alpha=self.residual)

    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        """Parameters (..., D) from features and the variable's own previous value, where the head is residual.

        Args:
            features: (B, T, H) at all steps, or (B, H) of a static variable or at step `t`.
            previous: (B, T, D) or (B, D).
            t: the step, in a loop over time.
        """
        raise NotImplementedError

    def distribution(self, parameters: Parameters) -> TorchDistribution:
        """The elementwise distribution over (..., D): a density for each coordinate, without event dimensions."""
        loc, scale = parameters
        return dist.Normal(loc, scale, validate_args=False)

    def in_units(self, parameters: Parameters, mean: Tensor, scale: Tensor) -> Parameters:
        """The parameters of mean + scale * variable, from those of the variable, of a location-scale family."""
        loc, *rest = parameters
        return torch.addcmul(mean, loc, scale), *(rest[:1] and [rest[0] * scale]), *rest[1:]

    def noise(self, shape: Sequence[int], like: Tensor) -> Tensor:
        """Noise for all steps at once; `draw` turns it into values."""
        return torch.randn(*shape, dtype=like.dtype, device=like.device)

    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        """Reparameterised values (..., D)."""
        loc, scale = parameters
        return torch.addcmul(loc, scale, noise)


class HeadSpec(Protocol):
    """A description of a head: a frozen dataclass that `build`s one."""

    def build(self, features: int, size: int, local: bool = True) -> Head:
        """The head from features H to a variable of dimension D; `local`: one value per step, not per sequence."""
        ...


@dataclass(frozen=True)
class Normal:
    """A diagonal normal whose location and scale are both read from the features.

    Args:
        min_scale: the scale stays above it; a likelihood whose scale can vanish has no maximum.
        residual: see `Head`.
    """

    min_scale: float = 1e-3
    residual: float = False

    def build(self, features: int, size: int, local: bool = True) -> Head:
        """The head from features H to a variable of dimension D; `local`: one value per step, not per sequence."""
        return NormalHead(self, features, size)


class NormalHead(Head):
    """See `Normal`."""

    location_scale = True

    def __init__(self, spec: Normal, features: int, size: int):
        super().__init__(spec.residual)
        self.min_scale = spec.min_scale
        self.out = self.projection(features, 2 * size, size)

    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        """See `Head.forward`."""
        loc, raw = self.out(features).chunk(2, dim=-1)
        # contiguous: on a slice, softplus is not vectorised and takes nine times as long
        scale = functional.softplus(raw.contiguous()) + self.min_scale
        return self.moved(loc, previous), scale


@dataclass(frozen=True)
class FixedNormal:
    """A normal whose scale does not depend on the parents.

    Args:
        scale: standard deviation, the initial one where it is learned.
        learned: one learned scale per dimension.
        project: a linear layer from features to location; False takes the features themselves.
        steps: with `learned`, one scale per time step too, for up to so many steps. For a local variable only.
        residual: see `Head`.
        fitted: what the density's gradient reaches: "both", or the "scale" alone, where the location learns from
            energies in its place.
    """

    scale: float = 1.0
    learned: bool = False
    project: bool = True
    steps: int = 0
    residual: float = False
    fitted: Literal["both", "scale"] = "both"

    def build(self, features: int, size: int, local: bool = True) -> Head:
        """The head from features H to a variable of dimension D; `local`: one value per step, not per sequence."""
        if self.scale <= 0:
            raise ValueError(f"FixedNormal's scale is positive, got {self.scale}")
        if self.steps and not local:
            raise ValueError(
                f"FixedNormal(steps={self.steps}) has one scale per time step, but its variable is static, with one "
                "value per sequence; give static variables a head of their own, with steps=0"
            )
        if not self.project and features != size:
            raise ValueError(f"a head without projection takes {size} features, but the network gives {features}")
        return FixedNormalHead(self, features, size)


class FixedNormalHead(Head):
    """See `FixedNormal`."""

    location_scale = True

    def __init__(self, spec: FixedNormal, features: int, size: int):
        super().__init__(spec.residual)
        self.out: nn.Module = self.projection(features, size, size) if spec.project else nn.Identity()
        shape = (spec.steps, size) if spec.steps else (size,)
        log_scale = torch.full(shape, math.log(spec.scale))
        if spec.learned:
            self.log_scale = nn.Parameter(log_scale)
        else:
            self.register_buffer("log_scale", log_scale)
        self.steps = spec.steps
        self.fitted, self.learned = spec.fitted, spec.learned

    def in_units(self, parameters: Parameters, mean: Tensor, scale: Tensor) -> Parameters:
        """See `Head.in_units`; a scale that is given is in the variable's own unit."""
        loc, own = super().in_units(parameters, mean, scale)
        return loc, own if self.learned else parameters[1]

    def distribution(self, parameters: Parameters) -> TorchDistribution:
        """See `Head.distribution`."""
        loc, scale = parameters
        return super().distribution((loc.detach() if self.fitted == "scale" else loc, scale))

    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        """See `Head.forward`."""
        loc = self.out(features)
        scale = self.log_scale.exp()
        if self.steps:
            needed = loc.shape[1] if t is None else t + 1
            if needed > self.steps:
                raise ValueError(
                    f"FixedNormal(steps={self.steps}) was given {needed} steps; build it with steps={needed}"
                )
            scale = scale[: loc.shape[1]] if t is None else scale[t]
        return self.moved(loc, previous), scale.expand_as(loc)


@dataclass(frozen=True)
class StudentT:
    """A Student t, for observations with outliers.

    Args:
        df: degrees of freedom, the initial ones; learned, one per dimension, and kept above 2.
        min_scale: the scale stays above it.
        residual: see `Head`.
    """

    df: float = 5.0
    min_scale: float = 1e-3
    residual: float = False

    def build(self, features: int, size: int, local: bool = True) -> Head:
        """The head from features H to a variable of dimension D; `local`: one value per step, not per sequence."""
        if self.df <= 2:
            raise ValueError(f"StudentT needs df > 2, where the variance is finite; got {self.df}")
        return StudentTHead(self, features, size)


class StudentTHead(Head):
    """See `StudentT`."""

    location_scale = True

    def __init__(self, spec: StudentT, features: int, size: int):
        super().__init__(spec.residual)
        self.min_scale = spec.min_scale
        self.out = self.projection(features, 2 * size, size)
        self.raw_df = nn.Parameter(torch.full((size,), math.log(math.expm1(spec.df - 2))))

    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        """See `Head.forward`."""
        loc, raw = self.out(features).chunk(2, dim=-1)
        loc = self.moved(loc, previous)
        df = functional.softplus(self.raw_df) + 2
        return loc, functional.softplus(raw.contiguous()) + self.min_scale, df.expand_as(loc)

    def distribution(self, parameters: Parameters) -> TorchDistribution:
        """See `Head.distribution`."""
        loc, scale, df = parameters
        return dist.StudentT(df, loc, scale, validate_args=False)

    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        """Reparameterised values (..., D): the normal noise over the root of a gamma draw."""
        loc, scale, df = parameters
        gamma = torch._standard_gamma(0.5 * df)
        return loc + scale * noise * torch.rsqrt(2 * gamma / df)


@dataclass(frozen=True)
class Delta:
    """A point mass: a data variable that is a function of its parents, the features themselves.

    It has no density, so that there is no likelihood and no bound: data enter such a model as its history, and through
    energies.
    """

    def build(self, features: int, size: int, local: bool = True) -> Head:
        """The head from features H to a variable of dimension D; `local`: one value per step, not per sequence."""
        if features != size:
            raise ValueError(f"a Delta of size {size} takes so many features, but the network gives {features}")
        return DeltaHead()


class DeltaHead(Head):
    """See `Delta`."""

    deterministic = True
    location_scale = True

    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        """See `Head.forward`."""
        return (features,)

    def distribution(self, parameters: Parameters) -> TorchDistribution:
        """See `Head.distribution`."""
        return dist.Delta(parameters[0])

    def noise(self, shape: Sequence[int], like: Tensor) -> Tensor:
        """See `Head.noise`; there is none."""
        return like.new_empty(()).expand(*shape)

    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        """See `Head.draw`."""
        return parameters[0]


class StandardNormal(Head):
    """N(0, I), the prior of a variable without parents; it reads no features."""

    location_scale = True
    zero: Tensor

    def __init__(self, size: int):
        super().__init__()
        self.size = size
        self.register_buffer("zero", torch.zeros(size), persistent=False)

    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        """See `Head.forward`; only the shape of the features is read."""
        loc = self.zero.expand(*features.shape[:-1], self.size)
        return loc, torch.ones_like(loc)


__all__ = ["Delta", "FixedNormal", "Head", "HeadSpec", "Normal", "StandardNormal", "StudentT"]
