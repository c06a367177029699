"""Interface of conditional distributions: a specification builds a module, which maps features to a distribution.

    DistributionSpec.build(Shape)                                 returns a ConditionalDistribution
    ConditionalDistribution.forward(features)                     returns parameters
    ConditionalDistribution.distribution(parameters)              returns a Pyro distribution

The parameters are plain tensors, so a loop over time creates no distribution objects. For a model variable without
parents, the module has no features and learns the parameters itself. Priors therefore have the same interface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Protocol

import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor, nn
from torch.distributions import constraints, transform_to
from torch.nn import functional

from ..factorization.relations import Relation

Parameters = tuple[Tensor, ...]


@dataclass(frozen=True)
class Shape:
    """Properties of a variable and its features, for the construction of a conditional distribution.

    Args:
        size: D, dimension of the variable.
        features: H, number of features that the network returns; 0 for a model variable without parents.
        local: True for one value per time step, False for one value per sequence (static).
        name: name of the variable.
        data: names of the data variables of the model.
        guide: the `Conditional` q(w | ...) if the variable is a static latent w without parents, for priors that
            evaluate it, such as `Vamp`; otherwise None.
        relation: steps of the variable that its value at step t may depend on, for a distribution of all steps jointly;
            None for a distribution of single steps.
    """

    size: int
    features: int = 0
    local: bool = True
    name: str = "w"
    data: tuple[str, ...] = ()
    guide: Any = None
    relation: Relation | None = None


class ConditionalDistribution(nn.Module):
    """A module that maps features to the conditional distribution of one variable.

    Subclasses implement `forward` and `distribution`. They also declare `support`, `event_dim`, `discrete` and
    `reparameterised` if the defaults, which describe independent normals, do not hold.

    Args:
        residual: share of the variable's previous value that is added to the location, from 0 to 1; the features
            provide the rest. With 1 (or True), the features provide the change from one step to the next. Below 1, a
            free-running forecast forgets its start and cannot drift without bound. The initial weights of a residual
            location are a hundredth of their usual size.

    Raises:
        ValueError: `residual` is not between 0 and 1.
    """

    support: Any = constraints.real
    """Constraint of torch on the values (D,) of a step; None if it depends on the parameters."""
    event_dim: int = 0
    """1 if all D coordinates of a step are one event with one density, 0 if each coordinate has its own density."""
    discrete: bool = False
    """Whether the values are discrete, such as counts or classes."""
    reparameterised: bool = True
    """Whether draws are differentiable with respect to the parameters."""
    deterministic: ClassVar[bool] = False
    """Whether the variable is a function of its parents, so that it has no density."""
    density: Literal["exact", "bound", "loss"] = "exact"
    """What `log_prob` returns: the log density, a stochastic lower bound of it, or minus a loss without a density."""
    trained_as_loss: bool = False
    """Whether `log_prob` is minus a loss in training mode; `density` describes evaluation mode."""
    error_weight: bool = False
    """Whether the scale only weights a squared error and does not describe the spread of the data.

    Forecasts then return the mean instead of draws.
    """
    location_scale: bool = False
    """Whether `rescale` can convert the parameters to another unit of the variable.

    This requires a location and a scale, or a scale alone, such as a rate. Probabilities cannot be converted.
    """
    centred: bool | Sequence[bool] = False
    """Whether `rescale` adds the mean of the variable to the location, for all coordinates or for each of them.

    If it does, the parameters can describe values minus their mean.
    """
    events: Sequence[Sequence[int]] = ()
    """Indices of the coordinates of each event if a step has several events, as in a `Product`.

    An event has one density, so its coordinates are either all observed or all missing.
    """

    def __init__(self, residual: float = False):
        super().__init__()
        if not 0 <= residual <= 1:
            raise ValueError(
                f"`residual` must be from 0 to 1 (share of the previous value that is added), got {residual}"
            )
        self.residual = float(residual)

    @property
    def present_density(self) -> str:
        """What `log_prob` returns in the present mode, training or evaluation, as in `density`."""
        return "loss" if self.training and self.trained_as_loss else self.density

    @property
    def label(self) -> str:
        """Name of the distribution in error messages."""
        return type(self).__name__.removesuffix("Distribution")

    def interior_point(self, size: int) -> Tensor | None:
        """Return a value (D,) with positive density that replaces unobserved entries; None if 0 can replace them.

        Args:
            size: D, dimension of the variable.
        """
        if self.support is None or is_real(self.support):
            return None
        if not self.support.is_discrete:
            return torch.as_tensor(transform_to(self.support)(torch.zeros(size)))
        zero = torch.zeros(size)
        return None if self.support.check(zero).all() else functional.one_hot(torch.tensor(0), size).to(zero)

    def projection(self, features: int, out: int, locations: int) -> Any:
        """Return a linear layer from features to parameters; without features, a module with learned parameters.

        Args:
            features: H, number of features.
            out: P, number of parameters.
            locations: number of locations, which come first among the parameters. With `residual`, their initial
                weights are small.
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
        """Return the location (..., D) of a residual distribution.

        Args:
            loc: location (..., D) computed from the features.
            previous: previous values (..., D), which are multiplied by `residual` and added; None to add nothing.
        """
        return loc if previous is None else torch.add(loc, previous, alpha=self.residual)

    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        """Return the parameters of the distribution, a tuple of tensors (..., P); P may differ between parameters.

        Args:
            features: (B, T, H) at all steps, or at T steps from step `t` on; (B, H) for a static variable, or for a
                local variable at step `t`.
            previous: values of the variable one step earlier, (B, T, D) or (B, D), for a residual distribution;
                otherwise None.
            t: step in a loop over time, or the first of several steps, counted from 0; None for all steps.

        Raises:
            NotImplementedError: a subclass does not implement the method.
        """
        raise NotImplementedError

    def distribution(self, parameters: Parameters) -> TorchDistribution:
        """Return the Pyro distribution of values (..., D).

        It has one density per coordinate (batch shape (..., D), event shape ()) if `event_dim` is 0, or one density per
        step (batch shape (...), event shape (D,)) if it is 1.

        Args:
            parameters: result of `forward`.

        Raises:
            NotImplementedError: a subclass does not implement the method.
        """
        raise NotImplementedError

    def mean(self, parameters: Parameters) -> Tensor:
        """Return the mean (..., D), by default the first parameter.

        The model uses the mean for missing data and for forecasts that are not drawn. The mean of a categorical
        variable consists of the probabilities of its classes.

        Args:
            parameters: result of `forward`.
        """
        return parameters[0]

    def joint(self, parameters: Parameters) -> TorchDistribution:
        """Return the distribution with all coordinates as one event: batch shape (...), event shape (D,).

        Args:
            parameters: result of `forward`.
        """
        distribution = self.distribution(parameters)
        return distribution.to_event(1 - len(distribution.event_shape))

    def rescale(self, parameters: Parameters, mean: Tensor, scale: Tensor) -> Parameters:
        """Convert the parameters of a variable to the parameters of mean + scale * variable.

        This default converts a location and a scale, and leaves any further parameters unchanged. The model calls it
        only if `location_scale` is True.

        Args:
            parameters: result of `forward`.
            mean: mean of the variable in its own unit, (D,).
            scale: scale of the variable in its own unit, (D,) or a single number.

        Returns:
            Parameters with the same shapes, in the variable's own unit.
        """
        loc, *rest = parameters
        scales = [(unexpanded(each) * scale).expand_as(loc) for each in rest[:1]]
        return torch.addcmul(mean, loc, scale), *scales, *rest[1:]

    def noise(self, shape: Sequence[int], like: Tensor) -> Tensor:
        """Return noise for all steps at once, by default standard normal; `draw` transforms it into values.

        Args:
            shape: shape of the noise, such as (B, T, D).
            like: tensor that defines dtype and device.
        """
        return torch.randn(*shape, dtype=like.dtype, device=like.device)

    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        """Return a draw (..., D), differentiable with respect to the parameters if possible.

        This default ignores the noise and lets the Pyro distribution draw.

        Args:
            parameters: result of `forward`.
            noise: noise (..., D) from `noise`.
        """
        distribution = self.distribution(parameters)
        return distribution.rsample() if distribution.has_rsample else distribution.sample()


def unexpanded(parameter: Tensor) -> Tensor:
    """Return a parameter (..., D) without the first dimensions if it has been expanded to them, such as (D,)."""
    while parameter.dim() > 1 and len(parameter) and (len(parameter) == 1 or not parameter.stride(0)):
        parameter = parameter[0]
    return parameter


def is_real(support: Any) -> bool:
    """Return whether a constraint of torch allows all real numbers in every coordinate."""
    while hasattr(support, "base_constraint"):
        support = support.base_constraint
    parts = getattr(support, "parts", ())  # only a ProductSupport has parts
    return all(is_real(part) for _, part in parts) if parts else support is constraints.real


class DistributionSpec(Protocol):
    """Specification of a conditional distribution: a frozen dataclass with a `build` method."""

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable.

        Args:
            shape: the variable and its features.

        Raises:
            ValueError: the distribution does not support this variable.
        """
        ...


class Unconditional(nn.Module):
    """Learned parameters that do not depend on the features; initially 0.

    Args:
        out: P, number of parameters.
    """

    def __init__(self, out: int):
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(out))

    def forward(self, features: Tensor) -> Tensor:
        """Return the parameters, expanded to (..., P), for features (..., H) whose values are ignored."""
        return self.bias.expand(*features.shape[:-1], -1)
