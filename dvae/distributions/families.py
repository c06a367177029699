"""Conditional distributions whose parameters are functions of features: normals, Student t and point masses."""

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

from .base import ConditionalDistribution, Parameters, Shape, unexpanded

HALF_LOG_2_PI = 0.5 * math.log(2 * math.pi)


class NormalDistribution(dist.Normal):
    """Independent normals with locations and scales (..., D), with a faster log density and KL divergence than torch.

    Both functions compute a quotient such as (value - loc) / scale once and reuse it, instead of squaring the scale.
    This saves 1 to 5 % of a training step of STORN (docs/results/speed.md). A scale that is the same at all steps
    enters the log density once, which halves the time of the density and its gradient.
    """

    @override
    def log_prob(self, value: Tensor) -> Tensor:
        scale = unexpanded(self.scale)
        distance = (value - self.loc) * scale.reciprocal()  # the gradient of a quotient requires more operations
        return torch.addcmul(-HALF_LOG_2_PI - scale.log(), distance, distance, value=-0.5)


@register_kl(NormalDistribution, NormalDistribution)
def _divergence(q: NormalDistribution, p: NormalDistribution) -> Tensor:
    ratio, distance = q.scale / p.scale, (q.loc - p.loc) / p.scale
    return torch.addcmul(torch.addcmul(-0.5 - ratio.log(), ratio, ratio, value=0.5), distance, distance, value=0.5)


class Gaussian(ConditionalDistribution):
    """Base class of modules for independent normals, with parameters location (..., D) and scale (..., D)."""

    location_scale = True
    centred = True

    def distribution(self, parameters: Parameters) -> TorchDistribution:
        """Return independent normals: batch shape (..., D), event shape ().

        Args:
            parameters: location and scale, (..., D) each.
        """
        loc, scale = parameters
        return NormalDistribution(loc, scale, validate_args=False)

    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        """Return the reparameterised draw loc + scale * noise, (..., D).

        Args:
            parameters: location and scale, (..., D) each.
            noise: standard normal noise (..., D).
        """
        loc, scale = parameters
        return torch.addcmul(loc, scale, noise)


@dataclass(frozen=True)
class Normal:
    """Independent normals whose locations and scales are functions of the features.

    For a model variable without parents, locations and scales are learned.

    Args:
        min_scale: lower bound of the scale; with a bound of 0, the likelihood may be unbounded.
        residual: share of the previous value, as in `ConditionalDistribution`.
    """

    min_scale: float = 1e-3
    residual: float = False

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape.

        Args:
            shape: the variable and its features.
        """
        return NormalModule(self, shape)


class NormalModule(Gaussian):
    """Distribution module of `Normal`; its parameters are location (..., D) and scale (..., D)."""

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
    """Independent normals whose scales do not depend on the parents.

    The location is a function of the features, or learned for a model variable without parents.

    Args:
        scale: standard deviation, above 0; the initial value if it is learned.
        learned: whether to learn the scale, with one value per dimension.
        project: whether a linear layer maps features to the location; if False, the features are the location.
        steps: maximum number of time steps, each with a scale of its own (useful with `learned`); 0 for the same scale
            at all steps. A static variable requires 0.
        residual: share of the previous value, as in `ConditionalDistribution`.
        fitted: parameters that receive the gradient of the log density: "both", or "scale" for the scale alone. With
            "scale", the location learns only from other terms of the loss, such as energies.
        error_weight: whether the scale only weights a squared error and does not describe the spread of the data;
            forecasts then return the location instead of draws.
    """

    scale: float = 1.0
    learned: bool = False
    project: bool = True
    steps: int = 0
    residual: float = False
    fitted: Literal["both", "scale"] = "both"
    error_weight: bool = False

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape.

        Args:
            shape: the variable and its features.

        Raises:
            ValueError: `scale` is not positive, `steps` is given for a static variable, or the number of features is
                not D although `project` is False.
        """
        if self.scale <= 0:
            raise ValueError(f"`scale` of FixedNormal must be positive, got {self.scale}")
        if self.steps and not shape.local:
            raise ValueError(
                f"FixedNormal(steps={self.steps}) has one scale per time step, but {shape.name} is static, with one "
                f"value per sequence; use FixedNormal(steps=0) for {shape.name}"
            )
        if not self.project and shape.features != shape.size:
            raise ValueError(
                f"FixedNormal(project=False) requires {shape.size} features, the location of {shape.name}, but the "
                f"network returns {shape.features}; use a network with {shape.size} outputs, or project=True"
            )
        return FixedNormalModule(self, shape)


class FixedNormalModule(Gaussian):
    """Distribution module of `FixedNormal`; its parameters are location (..., D) and scale (..., D)."""

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
        """Convert the location and a learned scale; a scale that is not learned is already in the variable's unit."""
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
                raise ValueError(
                    f"FixedNormal(steps={self.steps}) has no scales for {end} steps; build it with steps={end} or more"
                )
            scale = scale[first:end] if loc.dim() == 3 else scale[first]
        return loc if previous is None else self.add_residual(loc, previous), scale.expand_as(loc)


@dataclass(frozen=True)
class KnownNoise:
    """Independent normals with given scales, such as known measurement errors.

    The network must be `networks.WithNoise`, which appends the given scale to its features: the last D features are the
    scale, and a linear layer maps the other features to the location.

    Args:
        residual: share of the previous value, as in `ConditionalDistribution`.
    """

    residual: float = False

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape.

        Args:
            shape: the variable and its features.

        Raises:
            ValueError: the features do not include a scale, because the network is not a `networks.WithNoise`.
        """
        if shape.features <= shape.size:
            raise ValueError(
                f"KnownNoise requires a network that appends {shape.size} scales to its features, but the network of "
                f"{shape.name} returns only {shape.features} features; use networks.WithNoise"
            )
        return KnownNoiseModule(self, shape)


class KnownNoiseModule(Gaussian):
    """Distribution module of `KnownNoise`; its parameters are location (..., D) and scale (..., D)."""

    def __init__(self, spec: KnownNoise, shape: Shape):
        super().__init__(spec.residual)
        self.size = shape.size
        self.out = self.projection(shape.features - shape.size, shape.size, shape.size)

    @override
    def rescale(self, parameters: Parameters, mean: Tensor, scale: Tensor) -> Parameters:
        """Convert the location; the given scale is already in the variable's unit."""
        return torch.addcmul(mean, parameters[0], scale), parameters[1]

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        features, scale = features[..., : -self.size], features[..., -self.size :]
        return self.add_residual(self.out(features), previous), scale


@dataclass(frozen=True)
class StudentT:
    """Independent Student t distributions, for observations with outliers.

    Location and scale are functions of the features; each dimension has learned degrees of freedom.

    Args:
        df: initial degrees of freedom, above 2. The learned values also stay above 2, where the variance is finite.
        min_scale: lower bound of the scale.
        residual: share of the previous value, as in `ConditionalDistribution`.
    """

    df: float = 5.0
    min_scale: float = 1e-3
    residual: float = False

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape.

        Args:
            shape: the variable and its features.

        Raises:
            ValueError: `df` is at most 2.
        """
        if self.df <= 2:
            raise ValueError(f"`df` of StudentT must be above 2, where the variance is finite, got {self.df}")
        return StudentTModule(self, shape)


class StudentTDistribution(dist.StudentT):  # type: ignore[misc]
    """Student t distributions with a log density that is accurate for large degrees of freedom.

    Degrees of freedom, locations and scales have shape (..., D).
    """

    @override
    def log_prob(self, value: Tensor) -> Tensor:
        df, distance = unexpanded(self.df).double(), (value - self.loc) / self.scale
        half = df / 2  # in double, because the terms and their gradients cancel for large df
        normaliser = (half + 0.5).lgamma() - half.lgamma() - 0.5 * (math.pi * df).log()
        return (normaliser - (half + 0.5) * (distance.square() / df).log1p()).to(value.dtype) - self.scale.log()


class StudentTModule(ConditionalDistribution):
    """Distribution module of `StudentT`; its parameters are location, scale and degrees of freedom, (..., D) each."""

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
        """Return the reparameterised draw loc + scale * noise / sqrt(c / df), (..., D), with a chi-squared draw c.

        Args:
            parameters: location, scale and degrees of freedom, (..., D) each.
            noise: standard normal noise (..., D).
        """
        loc, scale, df = parameters
        gamma = torch._standard_gamma(0.5 * df)
        return loc + scale * noise * torch.rsqrt(2 * gamma / df)


@dataclass(frozen=True)
class Delta:
    """Point mass at the features, for a data variable that is a function of its parents.

    It has no density, so the model has no likelihood and no bound. The loss of such a model depends on the data only
    through the past steps that the network reads, and through energies such as a squared error.
    """

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape.

        Args:
            shape: the variable and its features.

        Raises:
            ValueError: the number of features is not D.
        """
        if shape.features != shape.size:
            raise ValueError(
                f"a Delta requires {shape.size} features, the value of {shape.name}, but the network returns "
                f"{shape.features}; use a network with {shape.size} outputs"
            )
        return DeltaModule()


class DeltaModule(ConditionalDistribution):
    """Distribution module of `Delta`; its parameter is the value (..., D)."""

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
        """Return an uninitialised tensor of the given shape, because a point mass needs no noise."""
        return like.new_empty(()).expand(*shape)

    @override
    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        return parameters[0]


@dataclass(frozen=True)
class Directions:
    """Point mass at unit vectors with three coordinates each, such as directions of bones.

    The D coordinates of the variable are D / 3 vectors. Like `Delta`, the distribution has no density.

    Args:
        project: whether a linear layer maps features to vectors before normalisation; if False, the features are the
            vectors.
        residual: share of the previous value, as in `ConditionalDistribution`; it is added before normalisation.
    """

    project: bool = True
    residual: float = False

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape.

        Args:
            shape: the variable and its features.

        Raises:
            ValueError: D is not divisible by 3, or the number of features is not D although `project` is False.
        """
        if shape.size % 3 or not (self.project or shape.features == shape.size):
            raise ValueError(
                "Directions require a size that is divisible by 3 and, with project=False, one feature per coordinate; "
                f"{shape.name} has size {shape.size}, and the network returns {shape.features} features"
            )
        return DirectionsModule(self, shape)


class DirectionsModule(DeltaModule):
    """Distribution module of `Directions`; its parameter is the unit vectors (..., D)."""

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
    """The fixed distribution N(0, I), which ignores features; the default for a model variable without parents."""

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape.

        Args:
            shape: the variable and its features.
        """
        return StandardNormalModule(shape.size)


class StandardNormalModule(Gaussian):
    """Distribution module of `StandardNormal`.

    Args:
        size: D, dimension of the variable.
    """

    zero: Tensor

    def __init__(self, size: int):
        super().__init__()
        self.register_buffer("zero", torch.zeros(size), persistent=False)

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        loc = self.zero.expand(*features.shape[:-1], -1)
        return loc, torch.ones_like(loc)
