"""Separate conditional distributions for parts of a variable, such as the columns of a table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, ClassVar

import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor, nn
from torch.distributions import constraints
from torch.nn import functional
from typing_extensions import override

from ..constants import indices
from .base import ConditionalDistribution, DistributionSpec, Parameters, Shape, is_real


@dataclass(frozen=True)
class Product:
    """Separate distributions of parts of a variable, which are independent given the parents.

    The log density has one value per coordinate. If a part is a multivariate event (`ConditionalDistribution`), its
    density is assigned to its first coordinate. Single coordinates may be missing, but the coordinates of an event must
    be all observed or all missing.

    Args:
        parts: pairs of the indices of a part's coordinates and the specification of its distribution. Each coordinate
            must be in exactly one part.

    Example:
        >>> count = dvae.distributions.Family("Poisson")
        >>> distribution = Product((((0, 2), dvae.distributions.Normal()), ((1,), count)))
        >>> pair = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})"
        >>> model = dvae.DynamicalVAE(*pair, {"z": 2, "x": 3}, distributions={"p(x)": distribution})
        >>> model.sample(1, length=4)["x"][..., 1].frac().any()
        tensor(False)
    """

    parts: Sequence[tuple[Sequence[int], DistributionSpec]]

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape.

        Args:
            shape: the variable and its features.

        Raises:
            ValueError: a coordinate is in no part, or in more than one; a part has no density.
        """
        coordinates = sorted(place for places, _ in self.parts for place in places)
        if coordinates != list(range(shape.size)):
            raise ValueError(
                f"the parts of a Product must contain each coordinate 0 to {shape.size - 1} of {shape.name} exactly "
                f"once; got {coordinates}"
            )
        return ProductModule(self, shape)


class ProductModule(ConditionalDistribution):
    """Distribution module of `Product`; its parameters are the concatenated parameters of the parts."""

    order: Tensor

    def __init__(self, spec: Product, shape: Shape):
        parts = [
            distribution.build(Shape(len(places), shape.features, *_shape_options(shape)))
            for places, distribution in spec.parts
        ]
        super().__init__(max(part.residual for part in parts))
        self.parts = nn.ModuleList(parts)
        self.places = [list(places) for places, _ in spec.parts]
        for index, part in enumerate(parts):
            if part.deterministic or part.density == "loss" or part.trained_as_loss:
                raise ValueError(
                    f"the distribution {spec.parts[index][1]} of the coordinates {self.places[index]} of {shape.name} "
                    "has no density, which a Product requires; use a distribution with a density, such as Normal()"
                )
        self.register_buffer("order", _order(self.places), persistent=False)
        self.location_scale = any(part.location_scale for part in parts)
        centred = {index: bool(parts[n].centred) for n, places in enumerate(self.places) for index in places}
        self.centred = any(centred.values()) and tuple(centred[index] for index in range(shape.size))
        with torch.no_grad():
            probe, before = torch.ones(1, shape.features), torch.zeros(1, shape.size)
            self.counts = [len(self._part(n, probe, before, None)) for n in range(len(parts))]
        self.discrete = any(part.discrete for part in parts)
        self.reparameterised = all(part.reparameterised for part in parts)
        self.density = "bound" if any(part.density == "bound" for part in parts) else "exact"
        supports = [part.support for part in parts]
        if None in supports:
            self.support = None
        elif not all(map(is_real, supports)):
            self.support = ProductSupport(list(zip(self.places, supports, strict=True)))
        self.events = [
            *(places for part, places in zip(parts, self.places, strict=True) if part.event_dim),
            *(
                [part[n] for n in event]
                for distribution, part in zip(parts, self.places, strict=True)
                for event in distribution.events
            ),
        ]

    @override
    def interior_point(self, size: int) -> Tensor | None:
        points = [part.interior_point(len(places)) for part, places in zip(self.parts, self.places, strict=True)]  # type: ignore[operator]
        if all(each is None for each in points):
            return None
        sizes = map(len, self.places)
        return self._concatenate(
            [torch.zeros(n) if point is None else point for point, n in zip(points, sizes, strict=True)]
        )

    def _part(self, n: int, features: Tensor, previous: Tensor | None, t: int | None) -> Parameters:
        distribution: Any = self.parts[n]
        part_previous = None
        if distribution.residual and previous is not None:
            part_previous = previous.index_select(-1, indices(self.places[n], previous))
        return distribution(features, part_previous, t)  # type: ignore[no-any-return]

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        return sum((self._part(n, features, previous, t) for n in range(len(self.parts))), ())

    def split(self, parameters: Parameters) -> list[tuple[Any, list[int], Parameters]]:
        """Return for each part its module, the indices of its coordinates, and its parameters.

        Args:
            parameters: result of `forward`.
        """
        parts, start = [], 0
        for count in self.counts:
            parts.append(parameters[start : start + count])
            start += count
        return list(zip(self.parts, self.places, parts, strict=True))

    def _concatenate(self, parts: list[Tensor]) -> Tensor:
        return torch.cat(parts, -1)[..., self.order]

    @override
    def distribution(self, parameters: Parameters) -> TorchDistribution:
        return ProductDistribution(
            [(places, distribution.distribution(values)) for distribution, places, values in self.split(parameters)]
        )

    @override
    def mean(self, parameters: Parameters) -> Tensor:
        return self._concatenate([distribution.mean(values) for distribution, _, values in self.split(parameters)])

    @override
    def rescale(self, parameters: Parameters, mean: Tensor, scale: Tensor) -> Parameters:
        scale, rescaled = scale.expand(*scale.shape[:-1], len(mean)), ()
        for distribution, places, values in self.split(parameters):
            part = scale[..., places]
            if part.dim() > 1 and not distribution.discrete:
                part = part.flatten(0, -2)[0]  # an exposure multiplies counts alone
            rescaled += distribution.rescale(values, mean[places], part) if distribution.location_scale else values
        return rescaled

    @override
    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        return self._concatenate(
            [distribution.draw(values, noise[..., places]) for distribution, places, values in self.split(parameters)]
        )


def _order(parts: Iterable[Sequence[int]]) -> Tensor:
    """Return the position (D,) of each coordinate in the concatenation of the parts, given their coordinates."""
    return torch.tensor(list(chain.from_iterable(parts))).argsort()


def _shape_options(shape: Shape) -> tuple[Any, ...]:
    return shape.local, shape.name, shape.data, shape.guide


class ProductDistribution(TorchDistribution):
    """Independent distributions of parts of a value: batch shape (..., D), event shape ().

    Args:
        parts: pairs of the indices of n coordinates and their distribution. This has batch shape (..., n) without an
            event, or batch shape (...) and event shape (n,).
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    def __init__(self, parts: Sequence[tuple[list[int], Any]]):
        self.parts = parts
        self.order = _order(places for places, _ in parts).tolist()
        first = parts[0][1]
        batch = first.batch_shape if first.event_shape else first.batch_shape[:-1]
        self.has_rsample = all(distribution.has_rsample for _, distribution in parts)
        super().__init__(torch.Size([*batch, len(self.order)]), torch.Size(), validate_args=False)

    def _concatenate(self, parts: list[Tensor]) -> Tensor:
        return torch.cat(parts, -1).index_select(-1, indices(self.order, parts[0]))

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log densities (..., D) of values (..., D), in nats.

        The log density of an event is at its first coordinate; its other coordinates have 0.
        """
        densities = []
        for places, distribution in self.parts:
            density = distribution.log_prob(value.index_select(-1, indices(places, value)))
            densities.append(
                functional.pad(density[..., None], (0, len(places) - 1)) if distribution.event_shape else density
            )
        return self._concatenate(densities)

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Return reparameterised draws (*sample_shape, ..., D)."""
        return self._concatenate([distribution.rsample(torch.Size(sample_shape)) for _, distribution in self.parts])

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Return draws (*sample_shape, ..., D)."""
        return self._concatenate([distribution.sample(torch.Size(sample_shape)) for _, distribution in self.parts])

    @property
    def mean(self) -> Tensor:
        """Means (..., D) of the parts."""
        return self._concatenate([distribution.mean for _, distribution in self.parts])

    @property
    def variance(self) -> Tensor:
        """Variances (..., D) of the parts."""
        return self._concatenate([distribution.variance for _, distribution in self.parts])

    @property
    def support(self) -> constraints.Constraint:  # type: ignore[override]
        """Constraint that combines the supports of the parts."""
        return ProductSupport([(places, distribution.support) for places, distribution in self.parts])


class ProductSupport(constraints.Constraint):
    """Constraint that combines separate constraints on parts of a value.

    Args:
        parts: pairs of the indices of coordinates and torch's constraint on them.
    """

    def __init__(self, parts: Sequence[tuple[list[int], Any]]):
        self.parts = parts
        self.is_discrete = any(support.is_discrete for _, support in parts)
        self.event_dim = 0

    def check(self, value: Tensor) -> Tensor:
        """Return for each coordinate, (..., D), whether the constraint of its part holds for values (..., D)."""
        checks = []
        for places, support in self.parts:
            valid = support.check(value.index_select(-1, indices(places, value)))
            checks.append(valid[..., None].expand(*valid.shape, len(places)) if support.event_dim else valid)
        order = _order(places for places, _ in self.parts).tolist()
        return torch.cat(checks, -1).index_select(-1, indices(order, value))
