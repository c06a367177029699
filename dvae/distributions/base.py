"""The interface of conditional distributions: a specification, built for a shape, maps features to a distribution.

    DistributionSpec.build(Shape) -> Distribution        Distribution(features) -> parameters
    Distribution.distribution(parameters) -> Pyro's

The parameters are plain tensors, so a loop over time creates no distribution objects. For a variable without parents,
the module has no features and learns the parameters itself; priors therefore use the same interface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor, nn
from torch.distributions import constraints, transform_to
from torch.nn import functional

Parameters = tuple[Tensor, ...]


@dataclass(frozen=True)
class Shape:
    """The variable and features that a conditional distribution is built for.

    Args:
        size: D, dimension of the variable.
        features: H, number of features from the network; 0 for a model variable without parents.
        local: True for one value per step, False for one per sequence.
        name: name of the variable.
        data: names of the data variables.
        guide: the `Conditional` q(w | ...) of a static latent without parents, for priors that are defined by it.
    """

    size: int
    features: int = 0
    local: bool = True
    name: str = "w"
    data: tuple[str, ...] = ()
    guide: Any = None


class ConditionalDistribution(nn.Module):
    """A module that maps features to the conditional distribution of one variable.

    Subclasses implement `forward` and `distribution`. They declare `support`, `event_dim`, `discrete` and
    `reparameterised` if these differ from independent normals.

    Args:
        residual: share of the variable's previous value that is added to the location; the features provide the rest.
            With 1 (True) the features are an offset. Below 1, a free-running forecast forgets its start and cannot
            drift without bound. The initial weights of a residual location are a hundredth of their usual size.

    Raises:
        ValueError: `residual` is not between 0 and 1.
    """

    support: Any = constraints.real
    """torch's constraint on the values of a step; None if it depends on the parameters."""
    event_dim: int = 0
    """1 if all coordinates of a step are one event, 0 if each coordinate has its own density."""
    discrete: bool = False
    """Whether values are discrete."""
    reparameterised: bool = True
    """Whether gradients flow through draws."""
    deterministic: ClassVar[bool] = False
    """Whether the variable is a function of its parents and has no density."""
    error_weight: bool = False
    """Whether the scale is the weight of a squared error, not the spread of the data; forecasts then show the mean."""
    location_scale: bool = False
    """Whether `rescale` can convert the parameters to another unit.

    This requires a location and a scale, or a scale alone such as a rate; probabilities cannot be converted.
    """
    centred: bool | Sequence[bool] = False
    """Whether `rescale` adds the mean, so that the network can work with values minus their mean; or a flag for each
    coordinate.
    """
    events: Sequence[Sequence[int]] = ()
    """Groups of coordinates that are one event each, if there are several; observed completely or not at all."""

    def __init__(self, residual: float = False):
        super().__init__()
        if not 0 <= residual <= 1:
            raise ValueError(f"residual must be a share of the previous value, from 0 to 1, got {residual}")
        self.residual = float(residual)

    @property
    def label(self) -> str:
        """Name of the distribution in messages."""
        return type(self).__name__.removesuffix("Distribution")

    def interior_point(self, size: int) -> Tensor | None:
        """Return a value (D,) with positive density to fill unobserved entries; None if 0 has positive density."""
        if self.support is None or is_real(self.support):
            return None
        if not self.support.is_discrete:
            return torch.as_tensor(transform_to(self.support)(torch.zeros(size)))
        zero = torch.zeros(size)
        return None if self.support.check(zero).all() else functional.one_hot(torch.tensor(0), size).to(zero)

    def projection(self, features: int, out: int, locations: int) -> Any:
        """Return a layer from features to `out` parameters, the first `locations` of them locations.

        Without features, the parameters are learned.
        """
        if not features:
            return Unconditional(out)
        layer = nn.Linear(features, out)
        if self.residual:
            with torch.no_grad():
                layer.weight[:locations] *= 0.01
                layer.bias[:locations] *= 0.01
        return layer

    def add_residual(self, loc: Tensor, previous: Tensor | None) -> Tensor:
        """Return the location: the output of the features plus `residual` times the previous value."""
        return loc if previous is None else torch.add(loc, previous, alpha=self.residual)

    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        """Return the parameters, (..., P) each, from features and, if residual, the variable's previous value.

        Args:
            features: (B, T, H) at all steps or at T steps from `t` on; (B, H) for a static variable or at step `t`.
            previous: (B, T, D) or (B, D).
            t: the step in a loop over time, or the first of several steps.
        """
        raise NotImplementedError

    def distribution(self, parameters: Parameters) -> TorchDistribution:
        """Return the distribution of a value (..., D).

        It has either one density per coordinate (batch (..., D), no event) or one density per step (batch (...), event
        (D,)).
        """
        raise NotImplementedError

    def mean(self, parameters: Parameters) -> Tensor:
        """Return the mean (..., D). The model uses it for missing data and for forecasts that are not drawn.

        For a categorical variable it contains the probabilities. The default is the first parameter.
        """
        return parameters[0]

    def joint(self, parameters: Parameters) -> TorchDistribution:
        """Return the distribution with all coordinates as one event: batch (...), event (D,)."""
        distribution = self.distribution(parameters)
        return distribution.to_event(1 - len(distribution.event_shape))

    def rescale(self, parameters: Parameters, mean: Tensor, scale: Tensor) -> Parameters:
        """Convert parameters of a variable to parameters of mean + scale * variable, for a location-scale family."""
        loc, *rest = parameters
        return torch.addcmul(mean, loc, scale), *(rest[:1] and [rest[0] * scale]), *rest[1:]

    def noise(self, shape: Sequence[int], like: Tensor) -> Tensor:
        """Return noise for all steps at once; `draw` transforms it into values."""
        return torch.randn(*shape, dtype=like.dtype, device=like.device)

    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        """Return values (..., D), reparameterised if possible; `noise` is ignored if the distribution draws its own."""
        distribution = self.distribution(parameters)
        return distribution.rsample() if distribution.has_rsample else distribution.sample()


def is_real(support: Any) -> bool:
    """Return whether a constraint allows all real numbers."""
    while hasattr(support, "base_constraint"):
        support = support.base_constraint
    parts = getattr(support, "parts", ())  # only a ProductSupport has parts
    return all(is_real(part) for _, part in parts) if parts else support is constraints.real


class DistributionSpec(Protocol):
    """Specification of a conditional distribution: a frozen dataclass with a `build` method."""

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable; raise ValueError if the distribution does not support its shape."""
        ...


class Unconditional(nn.Module):
    """Learned parameters (..., P) that do not depend on the features; initially 0."""

    def __init__(self, out: int):
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(out))

    def forward(self, features: Tensor) -> Tensor:
        """Expand the parameters to the batch shape of the features."""
        return self.bias.expand(*features.shape[:-1], -1)
