"""The one contract of laws: a description, built for a shape, is a module that turns features into a distribution.

    LawSpec.build(Shape) -> Law        Law(features) -> parameters        Law.distribution(parameters) -> of Pyro

The parameters are plain tensors, so that a loop over time handles no distribution objects. A law without features, of a
variable without parents, has parameters of its own: priors are laws like any other.
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
    """What a law is built for.

    Args:
        size: D, of the variable.
        features: H, of what the network gives; 0 of a model's variable without parents.
        local: one value per step, not per sequence.
        name: of the variable.
        data: names of the data variables.
        guide: of a static latent without parents its q(w | ...), a `Conditional`, for priors that are made of it.
    """

    size: int
    features: int = 0
    local: bool = True
    name: str = "w"
    data: tuple[str, ...] = ()
    guide: Any = None


class Law(nn.Module):
    """Features to the distribution of one variable.

    A new law gives `forward` and `distribution`. It declares `support`, `event_dim`, `discrete` and `reparameterised`
    where they differ from those of independent normals.

    Args:
        residual: share of the variable's own previous value that its location keeps, so that features give the rest:
            1 (True) for an offset. Below 1 a free run forgets where it was, and cannot drift without bound. A
            residual law starts near that share, with weights a hundredth of the usual.

    Raises:
        ValueError: a share that is not between 0 and 1.
    """

    support: Any = constraints.real
    """Constraint of torch on the values of a step; None if it depends on the parameters."""
    event_dim: int = 0
    """1 if all coordinates of a step are one event, 0 if each has its own density."""
    discrete: bool = False
    """Whether values are discrete."""
    reparameterised: bool = True
    """Whether draws have a gradient."""
    deterministic: ClassVar[bool] = False
    """Whether the variable is a function of its parents, without a density."""
    error_weight: bool = False
    """Whether the scale is the weight of a squared error and no spread of the data, so that forecasts show the mean."""
    location_scale: bool = False
    """Whether `in_units` can put the parameters into another unit: a location and a scale, or a scale alone, as a rate.
    Probabilities cannot be."""
    centred: bool | Sequence[bool] = False
    """Whether `in_units` adds the mean, so that it can do without one on values less their mean; or of each coordinate
    whether it does."""
    events: Sequence[Sequence[int]] = ()
    """Coordinates that are one event each, so that they are observed together or not at all, where a value has several
    such events."""

    def __init__(self, residual: float = False):
        super().__init__()
        if not 0 <= residual <= 1:
            raise ValueError(f"residual is {residual}; it is a share of the previous value, from 0 to 1")
        self.residual = float(residual)

    @property
    def called(self) -> str:
        """Name of the distribution, in messages."""
        return type(self).__name__.removesuffix("Law")

    def inside(self, size: int) -> Tensor | None:
        """Return a value (D,) with a positive density, for entries that were not observed; None if 0 has one."""
        if self.support is None or is_real(self.support):
            return None
        if not self.support.is_discrete:
            return torch.as_tensor(transform_to(self.support)(torch.zeros(size)))
        zero = torch.zeros(size)
        return None if self.support.check(zero).all() else functional.one_hot(torch.tensor(0), size).to(zero)

    def projection(self, features: int, out: int, locations: int) -> Any:
        """Features to `out` parameters, of which the first so many are locations; without features, learned ones."""
        if not features:
            return Unconditional(out)
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
        """Parameters, (..., P) each, from features and the variable's own previous value, where it is residual.

        Args:
            features: (B, T, H) at all steps or at T steps from `t` on, or (B, H) of a static variable or at step `t`.
            previous: (B, T, D) or (B, D).
            t: the step, in a loop over time, or the first of several.
        """
        raise NotImplementedError

    def distribution(self, parameters: Parameters) -> TorchDistribution:
        """The distribution of a value (..., D).

        Either with a density for each coordinate (batch (..., D), no event), or with one for all that a step has
        (batch (...), event (D,)).
        """
        raise NotImplementedError

    def mean(self, parameters: Parameters) -> Tensor:
        """The mean (..., D), which the model reads where data are missing, and shows where they are not drawn.

        Of a categorical variable it is the probabilities; here, the first of the parameters.
        """
        return parameters[0]

    def joint(self, parameters: Parameters) -> TorchDistribution:
        """The distribution with all coordinates as one event: batch (...), event (D,)."""
        law = self.distribution(parameters)
        return law.to_event(1 - len(law.event_shape))

    def in_units(self, parameters: Parameters, mean: Tensor, scale: Tensor) -> Parameters:
        """The parameters of mean + scale * variable, from those of the variable, of a location-scale family."""
        loc, *rest = parameters
        return torch.addcmul(mean, loc, scale), *(rest[:1] and [rest[0] * scale]), *rest[1:]

    def noise(self, shape: Sequence[int], like: Tensor) -> Tensor:
        """Noise for all steps at once; `draw` turns it into values."""
        return torch.randn(*shape, dtype=like.dtype, device=like.device)

    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        """Values (..., D), reparameterised where they can be; of the noise, unless the distribution makes its own."""
        law = self.distribution(parameters)
        return law.rsample() if law.has_rsample else law.sample()


def is_real(support: Any) -> bool:
    """Whether a constraint allows all real numbers."""
    while hasattr(support, "base_constraint"):
        support = support.base_constraint
    parts = getattr(support, "parts", ())  # of a product
    return all(is_real(own) for _, own in parts) if parts else support is constraints.real


class LawSpec(Protocol):
    """A description of a law: a frozen dataclass that `build`s one."""

    def build(self, shape: Shape) -> Law:
        """The law of a variable; ValueError where it is none for that shape."""
        ...


class Unconditional(nn.Module):
    """Parameters (..., P) that are the same whatever the features; 0 at first."""

    def __init__(self, out: int):
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(out))

    def forward(self, features: Tensor) -> Tensor:
        """Only the shape of the features is read."""
        return self.bias.expand(*features.shape[:-1], -1)
