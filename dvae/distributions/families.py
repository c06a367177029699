"""Conditional distributions with parameters from features: normals, Student t and point masses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import pyro.distributions as dist
import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor, nn
from torch.distributions import register_kl
from torch.nn import functional
from typing_extensions import override

from .base import ConditionalDistribution, Parameters, Shape

HALF_LOG_2_PI = 0.5 * math.log(2 * math.pi)


class NormalDistribution(dist.Normal):
    """Normals with locations and scales (..., D) and a faster log density and KL divergence than torch's.

    They compute each quotient once and reuse it, in place of squared scales. This saves 1 to 5 % of a training step of
    STORN (docs/results/speed.md).
    """

    @override
    def log_prob(self, value: Tensor) -> Tensor:
        distance = (value - self.loc) / self.scale
        return torch.addcmul(-HALF_LOG_2_PI - self.scale.log(), distance, distance, value=-0.5)


@register_kl(NormalDistribution, NormalDistribution)
def _divergence(q: NormalDistribution, p: NormalDistribution) -> Tensor:
    ratio, distance = q.scale / p.scale, (q.loc - p.loc) / p.scale
    return torch.addcmul(torch.addcmul(-0.5 - ratio.log(), ratio, ratio, value=0.5), distance, distance, value=0.5)


class Gaussian(ConditionalDistribution):
    """Base of distribution modules for independent normals; the parameters are locations and scales, (..., D) each."""

    location_scale = True
    centred = True

    def distribution(self, parameters: Parameters) -> TorchDistribution:
        """Return the normals."""
        loc, scale = parameters
        return NormalDistribution(loc, scale, validate_args=False)

    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        """Return reparameterised values (..., D)."""
        loc, scale = parameters
        return torch.addcmul(loc, scale, noise)


@dataclass(frozen=True)
class Normal:
    """A diagonal normal with location and scale from the features, or learned without features.

    Args:
        min_scale: lower bound of the scale; without one, the likelihood may be unbounded.
        residual: share of the previous value, as in `ConditionalDistribution`.
    """

    min_scale: float = 1e-3
    residual: float = False

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape."""
        return NormalModule(self, shape)


class NormalModule(Gaussian):
    """Distribution module of `Normal`."""

    def __init__(self, spec: Normal, shape: Shape):
        super().__init__(spec.residual)
        self.min_scale = spec.min_scale
        self.out = self.projection(shape.features, 2 * shape.size, shape.size)

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        loc, raw = self.out(features).chunk(2, dim=-1)
        # contiguous, because softplus of a slice is not vectorised and takes nine times as long
        scale = functional.softplus(raw.contiguous()) + self.min_scale
        return loc if previous is None else self.add_residual(loc, previous), scale


@dataclass(frozen=True)
class FixedNormal:
    """A normal with a scale that does not depend on the parents. Without parents, its location is learned too.

    Args:
        scale: standard deviation; the initial value if it is learned.
        learned: whether to learn one scale per dimension.
        project: whether a linear layer maps features to the location; if False, the features are the location.
        steps: with `learned`, the maximum number of time steps, with one scale per step; for a local variable only.
        residual: share of the previous value, as in `ConditionalDistribution`.
        fitted: what receives the gradient of the density: "both", or "scale" if the location learns from energies only.
        error_weight: whether the scale is the weight of a squared error, not the spread of the data; forecasts then
            show the location.
    """

    scale: float = 1.0
    learned: bool = False
    project: bool = True
    steps: int = 0
    residual: float = False
    fitted: Literal["both", "scale"] = "both"
    error_weight: bool = False

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape."""
        if self.scale <= 0:
            raise ValueError(f"FixedNormal's scale must be positive, got {self.scale}")
        if self.steps and not shape.local:
            raise ValueError(
                f"FixedNormal(steps={self.steps}) has one scale per time step, but its variable is static, with one "
                "value per sequence; give static variables a distribution of their own, with steps=0"
            )
        if not self.project and shape.features != shape.size:
            raise ValueError(
                f"a FixedNormal without projection takes {shape.size} features, but the network gives {shape.features}"
            )
        return FixedNormalModule(self, shape)


class FixedNormalModule(Gaussian):
    """Distribution module of `FixedNormal`."""

    def __init__(self, spec: FixedNormal, shape: Shape):
        super().__init__(spec.residual)
        size = shape.size
        self.out = self.projection(shape.features, size, size) if spec.project else nn.Identity()
        log_scale = torch.full((spec.steps, size) if spec.steps else (size,), math.log(spec.scale))
        if spec.learned:
            self.log_scale = nn.Parameter(log_scale)
        else:
            self.register_buffer("log_scale", log_scale)
        self.steps = spec.steps
        self.fitted, self.learned, self.error_weight = spec.fitted, spec.learned, spec.error_weight

    @override
    def rescale(self, parameters: Parameters, mean: Tensor, scale: Tensor) -> Parameters:
        """Convert the parameters; a scale that is not learned already has the unit of the variable."""
        loc, rescaled = super().rescale(parameters, mean, scale)
        return loc, rescaled if self.learned else parameters[1]

    @override
    def distribution(self, parameters: Parameters) -> TorchDistribution:
        loc, scale = parameters
        return super().distribution((loc.detach() if self.fitted == "scale" else loc, scale))

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        loc = self.out(features)
        scale = self.log_scale.exp()
        if self.steps:
            first, end = t or 0, (t or 0) + (loc.shape[1] if loc.dim() == 3 else 1)
            if end > self.steps:
                raise ValueError(f"FixedNormal(steps={self.steps}) was given {end} steps; build it with steps={end}")
            scale = scale[first:end] if loc.dim() == 3 else scale[first]
        return loc if previous is None else self.add_residual(loc, previous), scale.expand_as(loc)


@dataclass(frozen=True)
class KnownNoise:
    """A normal with a given scale: the last D features, after the features of the network in `networks.WithNoise`.

    Args:
        residual: share of the previous value, as in `ConditionalDistribution`.
    """

    residual: float = False

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape."""
        if shape.features <= shape.size:
            raise ValueError(
                f"KnownNoise needs its scale from networks.WithNoise, as a network of p({shape.name} | ...)"
            )
        return KnownNoiseModule(self, shape)


class KnownNoiseModule(Gaussian):
    """Distribution module of `KnownNoise`."""

    def __init__(self, spec: KnownNoise, shape: Shape):
        super().__init__(spec.residual)
        self.size = shape.size
        self.out = self.projection(shape.features - shape.size, shape.size, shape.size)

    @override
    def rescale(self, parameters: Parameters, mean: Tensor, scale: Tensor) -> Parameters:
        """Convert the location; the scale already has the unit of the variable."""
        return torch.addcmul(mean, parameters[0], scale), parameters[1]

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        features, scale = features[..., : -self.size], features[..., -self.size :]
        return self.add_residual(self.out(features), previous), scale


@dataclass(frozen=True)
class StudentT:
    """A Student t distribution for observations with outliers.

    Args:
        df: initial degrees of freedom; one per dimension is learned and stays above 2.
        min_scale: lower bound of the scale.
        residual: share of the previous value, as in `ConditionalDistribution`.
    """

    df: float = 5.0
    min_scale: float = 1e-3
    residual: float = False

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape."""
        if self.df <= 2:
            raise ValueError(f"StudentT needs df > 2, where the variance is finite; got {self.df}")
        return StudentTModule(self, shape)


class StudentTDistribution(dist.StudentT):  # type: ignore[misc]
    """Student t distributions with degrees of freedom, locations and scales (..., D)."""

    @override
    def log_prob(self, value: Tensor) -> Tensor:
        df, distance = self.df, (value - self.loc) / self.scale
        alike = all(size == 1 or not stride for size, stride in zip(df.shape[:-1], df.stride()[:-1], strict=True))
        df = (df[(0,) * (df.dim() - 1)] if alike else df).double()  # undo the expansion to one value per coordinate
        half = df / 2  # in double, because the terms and their gradients cancel for large df
        normaliser = (half + 0.5).lgamma() - half.lgamma() - 0.5 * (math.pi * df).log()
        return (normaliser - (half + 0.5) * (distance.square() / df).log1p()).to(value.dtype) - self.scale.log()


class StudentTModule(ConditionalDistribution):
    """Distribution module of `StudentT`."""

    location_scale = True
    centred = True

    def __init__(self, spec: StudentT, shape: Shape):
        super().__init__(spec.residual)
        self.min_scale = spec.min_scale
        self.out = self.projection(shape.features, 2 * shape.size, shape.size)
        self.raw_df = nn.Parameter(torch.full((shape.size,), math.log(math.expm1(spec.df - 2))))

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        loc, raw = self.out(features).chunk(2, dim=-1)
        loc = self.add_residual(loc, previous)
        df = functional.softplus(self.raw_df) + 2
        return loc, functional.softplus(raw.contiguous()) + self.min_scale, df.expand_as(loc)

    @override
    def distribution(self, parameters: Parameters) -> TorchDistribution:
        loc, scale, df = parameters
        return StudentTDistribution(df, loc, scale, validate_args=False)

    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        """Return reparameterised values (..., D): normal noise divided by the square root of a gamma draw."""
        loc, scale, df = parameters
        gamma = torch._standard_gamma(0.5 * df)
        return loc + scale * noise * torch.rsqrt(2 * gamma / df)


@dataclass(frozen=True)
class Delta:
    """A point mass at the features, for a data variable that is a function of its parents.

    It has no density, so there is no likelihood and no bound. Data enter such a model as history and through energies.
    """

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape."""
        if shape.features != shape.size:
            raise ValueError(f"a Delta takes {shape.size} features, its size, but the network gives {shape.features}")
        return DeltaModule()


class DeltaModule(ConditionalDistribution):
    """Distribution module of `Delta`."""

    deterministic = True
    location_scale = True
    centred = True

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        return (features,)

    @override
    def distribution(self, parameters: Parameters) -> TorchDistribution:
        return dist.Delta(parameters[0])

    @override
    def noise(self, shape: Sequence[int], like: Tensor) -> Tensor:
        """Return an empty placeholder, because no noise is needed."""
        return like.new_empty(()).expand(*shape)

    @override
    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        return parameters[0]


@dataclass(frozen=True)
class Directions:
    """A point mass at unit vectors of three coordinates each, such as directions in space.

    Like `Delta`, it has no density.

    Args:
        project: whether a linear layer maps features to vectors before normalisation; if False, the features are the
            vectors.
        residual: share of the previous value, as in `ConditionalDistribution`; it is added before normalisation.
    """

    project: bool = True
    residual: float = False

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape."""
        if shape.size % 3 or not (self.project or shape.features == shape.size):
            raise ValueError(
                f"Directions have three coordinates each and, without projection, are the features themselves; "
                f"{shape.name} has {shape.size} coordinates and the network gives {shape.features} features"
            )
        return DirectionsModule(self, shape)


class DirectionsModule(DeltaModule):
    """Distribution module of `Directions`."""

    location_scale = False
    centred = False

    def __init__(self, spec: Directions, shape: Shape):
        super().__init__(spec.residual)
        self.out = self.projection(shape.features, shape.size, shape.size) if spec.project else nn.Identity()

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        vectors = self.add_residual(self.out(features), previous).unflatten(-1, (-1, 3))
        return ((vectors * vectors.square().sum(-1, keepdim=True).clamp_min(1e-12).rsqrt()).flatten(-2),)


@dataclass(frozen=True)
class StandardNormal:
    """N(0, I) for any features: the default distribution of a model variable without parents."""

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape."""
        return StandardNormalModule(shape.size)


class StandardNormalModule(Gaussian):
    """Distribution module of `StandardNormal`."""

    zero: Tensor

    def __init__(self, size: int):
        super().__init__()
        self.register_buffer("zero", torch.zeros(size), persistent=False)

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        loc = self.zero.expand(*features.shape[:-1], -1)
        return loc, torch.ones_like(loc)
