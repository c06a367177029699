"""Conditional distributions from any distribution of Pyro, and named families for observations.

A distribution declares the constraints of its parameters (`arg_constraints`). A linear layer computes unconstrained
numbers, and torch's `biject_to` maps them to parameters that satisfy the constraints. For example, a rate is the
exponential of the output, and a scale matrix has a positive diagonal.

| family | observations | distribution |
|---|---|---|
| real | numbers | `Normal` |
| fixed | numbers; the scale of each coordinate does not depend on the parents | `FixedNormal` |
| robust, laplace | numbers with outliers | `StudentT`, Laplace |
| mixture | numbers with several modes | `NormalMixture` |
| correlated | correlated numbers | `LowRankNormal` |
| angle | radians from -pi to pi | von Mises |
| positive, log-normal | positive numbers; positive numbers that span orders of magnitude | Gamma, LogNormal |
| hurdle | positive numbers and exact zeros | `HurdleLogNormal` |
| power | squared magnitudes of a spectrum | Exponential |
| share | above 0 and below 1 | Beta |
| binary | 0 or 1 | Bernoulli |
| category | one of D classes, one-hot encoded in D coordinates | OneHotCategorical |
| count, overdispersed | non-negative integers; the same with a larger variance | Poisson, negative binomial |
| sparse, sparse-overdispersed | like the previous two, with excess zeros | zero-inflated Poisson, negative binomial |

For a power spectrum, the negative log density equals the Itakura-Saito divergence from the mean, up to terms that
depend only on the data. It is the likelihood of complex normals with this mean as variance (Févotte, Bertin and
Durrieu, 2009). The speech models in the review of Girin et al. (2021, arXiv 2008.12595) use it.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import pyro.distributions as dist
import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor, nn
from torch import distributions as plain
from torch.distributions import Distribution, biject_to, constraints, transform_to
from typing_extensions import override

from ..constants import constant
from ..options import nearest
from .base import ConditionalDistribution, DistributionSpec, Parameters, Shape
from .families import FixedNormal, Normal, StudentT
from .hurdle import HurdleLogNormal
from .precise import BoundedDistribution, DoublePrecision

ALTERNATIVES = (("logits", "probs"), ("gate_logits", "gate"), ("scale_tril", "covariance_matrix", "precision_matrix"))
"""Groups of equivalent parameters; of each group, a distribution uses only the first that it has."""

Affine = Callable[[Tensor, Tensor, Tensor], Tensor]  # (parameter, mean, scale) -> parameter of mean + scale * variable


def _location(value: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    return torch.addcmul(mean, value, scale)


def _scale(value: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    return value * scale


def _rate(value: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    return value / scale


def _logarithm(value: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    return value + scale.log()


def _square(value: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    return value * scale.square()


def _rows(value: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    scale = scale.expand_as(mean)
    return (value.unflatten(-1, (len(scale), -1)) * scale[:, None]).flatten(-2)


UNITS: Mapping[str, Mapping[str, Affine]] = {
    name: moves
    for names, moves in (
        ("Cauchy Gumbel Laplace Logistic Normal SoftLaplace StudentT", {"loc": _location, "scale": _scale}),
        ("HalfCauchy HalfNormal Weibull", {"scale": _scale}),
        ("Exponential Gamma GammaPoisson", {"rate": _rate}),
        ("InverseGamma Poisson ZeroInflatedPoisson", {"rate": _scale}),
        ("NegativeBinomial ZeroInflatedNegativeBinomial", {"logits": _logarithm}),
        ("HurdleLogNormal LogNormal", {"loc": _logarithm}),
        ("LowRankMultivariateNormal", {"loc": _location, "cov_factor": _rows, "cov_diag": _square}),
        ("MultivariateNormal", {"loc": _location, "scale_tril": _rows}),
    )
    for name in names.split()
}
"""Functions that convert parameters to another unit of the variable, by distribution and parameter.

The conversion multiplies the mean of a count distribution by the scale. Distributions without a location ignore the
mean of the unit.
"""


class Interior(constraints.Constraint):
    """Constraint to the interior of the unit interval or of the simplex.

    Args:
        closed: torch's constraint to the same set with its boundary.
    """

    def __init__(self, closed: Any):
        self.closed, self.event_dim = closed, closed.event_dim

    def check(self, value: Tensor) -> Tensor:
        """Return whether each value (unit interval) or vector (simplex) is in the interior."""
        inside = self.closed.check(value)
        return inside & (value > 0).all(-1) if self.event_dim else inside & (value > 0) & (value < 1)

    def __repr__(self) -> str:
        return f"Inside({self.closed})"


transform_to.register(Interior, lambda constraint: transform_to(constraint.closed))


class VonMises(dist.VonMises):  # type: ignore[misc]
    """Von Mises distribution for any concentration.

    In float32, the gradients of torch's distribution require a concentration between 3e-6 and 4e4.
    """

    @override
    def log_prob(self, value: Tensor) -> Tensor:
        concentration, difference = self.concentration.double(), value.double() - self.loc.double()
        kernel = -2 * concentration * (difference / 2).sin().square()  # cos - 1 without cancellation
        return (kernel - (2 * math.pi * torch.special.i0e(concentration)).log()).to(value.dtype)

    @override
    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Return draws (*sample_shape, ...).

        The concentration is limited to 1e12, because torch's rejection sampling does not terminate near 1e16.
        """
        narrow = dist.VonMises(self.loc, self.concentration.clamp(max=1e12), validate_args=False)
        return narrow.sample(torch.Size(sample_shape))  # type: ignore[no-any-return]


class OneHotCategorical(dist.OneHotCategorical):  # type: ignore[misc]
    """Torch's distribution, without the validation of its logits, which waits for the device."""

    def __init__(self, probs: Any = None, logits: Any = None, validate_args: bool | None = None):
        self._categorical = plain.Categorical(probs, logits, validate_args=False)
        shapes = self._categorical.batch_shape, self._categorical.param_shape[-1:]
        Distribution.__init__(self, *shapes, validate_args=validate_args)

    def expand(self, batch_shape: Any, _instance: object = None) -> OneHotCategorical:
        """Return the distribution with another batch shape."""
        return OneHotCategorical(logits=self.logits.expand(*batch_shape, -1), validate_args=False)


REPLACED = {dist.VonMises: VonMises, dist.OneHotCategorical: OneHotCategorical}
"""Our versions of distributions."""
OPEN: Mapping[type[Distribution], Any] = {
    plain.Gamma: constraints.positive,
    **dict.fromkeys((plain.Beta, plain.Kumaraswamy, plain.RelaxedBernoulli), Interior(constraints.unit_interval)),
    **dict.fromkeys((plain.Dirichlet, plain.RelaxedOneHotCategorical), Interior(constraints.simplex)),
}
"""Supports without boundary, for distributions whose density at the boundary is 0 or infinite.

Torch declares these supports with their boundary.
"""

PLAIN = {"Bernoulli", "Categorical", "Cauchy", "Delta", "Exponential", "HalfCauchy", "HalfNormal", "HurdleLogNormal"}
PLAIN |= {"Laplace", "LogNormal", "Normal", "OneHotCategorical", "Uniform", "VonMises"}
"""Names of the distributions whose log density is accurate in float32, because no large terms cancel.

The log densities of all other distributions are computed in float64.
"""


@dataclass(frozen=True)
class Family:
    """Any distribution of `pyro.distributions`, with parameters that are fixed, learned or functions of the features.

    Each parameter that is neither in `given` nor in `learned` is a function of the features. Of equivalent parameters,
    such as logits and probs, only the first in `ALTERNATIVES` is used. Integer parameters, such as a total count, must
    be given.

    Args:
        distribution: "HurdleLogNormal", name of a class in `pyro.distributions`, such as "Poisson", or a distribution
            class. A model with a class cannot be stored in a run directory.
        given: values of fixed parameters by name, such as {"total_count": 12}.
        learned: names of parameters that are learned and do not depend on the features.
        shapes: shapes of parameters by name, for parameters of a vector distribution whose shape is not (D,) or (D, D);
            -1 stands for D, such as {"cov_factor": (-1, 2)}.
        min_scale: lower bound of `scale` and of the square root of `cov_diag`. With a bound of 0, the likelihood may be
            unbounded.
        residual: share of the previous value, as in `ConditionalDistribution`; requires a location.
        project: whether a linear layer maps features to parameters. If False, the features are the parameters before
            they are mapped to their constraints: the location first, the others in the distribution's order.
        error_weight: whether the scale only weights a squared error, as in `ConditionalDistribution`.

    Example:
        >>> pair, sizes = ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})"), {"z": 2, "x": 3}
        >>> model = dvae.DynamicalVAE(*pair, sizes, distributions={"p(x)": dvae.distributions.Family("Poisson")})
        >>> model.sample(1, length=4)["x"].frac().any()
        tensor(False)
    """

    distribution: str | type[Distribution]
    given: Mapping[str, float] = field(default_factory=dict)
    learned: tuple[str, ...] = ()
    shapes: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    min_scale: float = 1e-3
    residual: float = False
    project: bool = True
    error_weight: bool = False

    @property
    def kind(self) -> type[Distribution]:
        """Class of the distribution.

        Raises:
            ValueError: Pyro has no distribution with this name.
        """
        if not isinstance(self.distribution, str):
            return self.distribution
        known = {**vars(dist), HurdleLogNormal.__name__: HurdleLogNormal}
        kind = known.get(self.distribution)
        if isinstance(kind, type) and issubclass(kind, Distribution):
            return kind
        names = [name for name, value in known.items() if isinstance(value, type)]
        raise ValueError(f"Pyro has no distribution {self.distribution!r}{nearest(self.distribution, names)}")

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape.

        Args:
            shape: the variable and its features.

        Raises:
            ValueError: Pyro has no such distribution, or the distribution does not declare constraints. Also if a
                parameter is unknown, a parameter that must be given is missing, or all parameters are given. Also if
                the distribution does not support `residual` or the number of features.
        """
        return FamilyModule(self, shape)


class FamilyModule(ConditionalDistribution):
    """Distribution module of `Family`; it returns each parameter of the distribution flattened to (..., P)."""

    def __init__(self, spec: Family, shape: Shape):
        super().__init__(spec.residual)
        self.error_weight = spec.error_weight
        self.kind: Any = REPLACED.get(spec.kind, spec.kind)
        self.given: dict[str, Any] = dict(spec.given)
        self.floors = {"scale": spec.min_scale, "cov_diag": spec.min_scale**2}
        if "validate_args" in inspect.signature(self.kind.__init__).parameters:
            self.given["validate_args"] = False
        self.forms = _forms(spec, shape)
        self.moves = UNITS.get(self.kind.__name__, {})
        self.location_scale = bool(self.moves.keys() & self.forms.keys())
        self.centred = "loc" in self.forms and self.moves.get("loc") is _location
        if self.residual and "loc" not in self.forms:
            raise ValueError(
                f"{self.kind.__name__} has no location, so no previous value can be added to it; use residual=0"
            )
        widths = {name: math.prod(free) for name, (free, _, _) in self.forms.items()}
        names = [name for name in widths if name not in spec.learned]
        self.read = sorted(names, key=lambda name: name != "loc")  # `projection` expects the location first
        self.widths = [widths[name] for name in self.read]
        self.learned = nn.ParameterDict({name: torch.zeros(widths[name]) for name in spec.learned})
        self.out: Any = nn.Identity()
        if spec.project:
            self.out = self.projection(shape.features, sum(self.widths), widths.get("loc", 0)) if self.read else None
        elif shape.features != sum(self.widths):
            raise ValueError(
                f"a {self.kind.__name__} with project=False requires {sum(self.widths)} features for its parameters "
                f"({', '.join(self.read) or 'none'}), but the network returns {shape.features}; use a network with "
                f"{sum(self.widths)} outputs, or project=True"
            )
        with torch.no_grad():
            probe = torch.ones(1, shape.features), torch.zeros(1, shape.size) if self.residual else None
            with _explain_errors(spec, AttributeError, TypeError):
                probe_distribution = self.distribution(self(*probe))
                self.centre = _centre(probe_distribution)
        support = getattr(probe_distribution, "support", None)
        self.event_dim, self.discrete = len(probe_distribution.event_shape), support is not None and support.is_discrete
        # torch.bernoulli has a gradient that is zero
        self.reparameterised = probe_distribution.has_rsample and not self.discrete
        self.support = support if support is not None and _is_fixed(support) else None

    @property
    @override
    def label(self) -> str:
        return str(self.kind.__name__)

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        raw: dict[str, Tensor] = {name: p.expand(*features.shape[:-1], -1) for name, p in self.learned.items()}
        if self.out is not None:
            raw |= dict(zip(self.read, self.out(features).split(self.widths, -1), strict=True))
        parameters = []
        for name, (free, to, shape) in self.forms.items():
            value = to(raw[name].unflatten(-1, free)).flatten(-len(shape)) if shape else to(raw[name])  # (..., P)
            value = value + self.floors.get(name, 0)
            parameters.append(self.add_residual(value, previous) if name == "loc" else value)
        return tuple(parameters)

    @override
    def distribution(self, parameters: Parameters) -> TorchDistribution:
        if not parameters or parameters[0].dtype is torch.float64 or self.kind.__name__ in PLAIN:
            return self._bounded(parameters)
        return DoublePrecision(
            self._unbounded(parameters), lambda: self._bounded(tuple(p.double() for p in parameters))
        )

    def _bounded(self, parameters: Parameters) -> TorchDistribution:
        distribution = self._unbounded(parameters)
        return BoundedDistribution(distribution) if constraints.is_dependent(self.kind.support) else distribution

    def _unbounded(self, parameters: Parameters) -> TorchDistribution:
        shaped = {
            name: value.unflatten(-1, shape) if len(shape) > 1 else value if shape else value[..., 0]
            for (name, (_, _, shape)), value in zip(self.forms.items(), parameters, strict=True)
        }
        fixed = self.given
        if parameters:  # cached tensors, because torch would copy numbers to the device at every call
            numbers = {name: value for name, value in fixed.items() if isinstance(value, float)}
            fixed = fixed | {name: constant(value, parameters[0]) for name, value in numbers.items()}
        distribution = self.kind(**shaped, **fixed)
        for kind, support in OPEN.items():
            if isinstance(distribution, kind):
                distribution.support = support  # type: ignore[misc]
        return distribution  # type: ignore[no-any-return]

    @override
    def mean(self, parameters: Parameters) -> Tensor:
        if not self.centre:
            raise ValueError(
                f"{self.kind.__name__} has neither a mean nor a mode, but missing data and forecasts without draws "
                "require one; choose another distribution, or use complete data and drawn forecasts"
            )
        return getattr(self.distribution(parameters), self.centre)  # type: ignore[no-any-return]

    @override
    def rescale(self, parameters: Parameters, mean: Tensor, scale: Tensor) -> Parameters:
        pairs = zip(self.forms, parameters, strict=True)
        return tuple(self.moves[name](value, mean, scale) if name in self.moves else value for name, value in pairs)


def _is_fixed(support: Any) -> bool:
    """Return whether a support does not depend on the parameters."""
    if hasattr(support, "base_constraint"):
        return _is_fixed(support.base_constraint)
    return not any(isinstance(value, Tensor) for value in vars(support).values())


Form = tuple[tuple[int, ...], Any, tuple[int, ...]]
"""Triple of a parameter: its unconstrained shape, the map to its constraint, and its constrained shape."""


def _forms(spec: Family, shape: Shape) -> dict[str, Form]:
    """Return the `Form` of every parameter that is read or learned, by name.

    Raises:
        ValueError: the distribution does not declare constraints of its parameters, the name of a parameter is unknown,
            an integer parameter is not given, or all parameters are given.
    """
    kind, name = spec.kind, spec.kind.__name__
    constraints = kind.arg_constraints
    if not isinstance(constraints, Mapping):
        raise ValueError(
            f"{name} does not declare constraints of its parameters (`arg_constraints`), which a Family requires; "
            "write a ConditionalDistribution for it"
        )
    parameters = inspect.signature(kind.__init__).parameters
    if unknown := [key for key in (*spec.given, *spec.learned, *spec.shapes) if key not in parameters]:
        raise ValueError(
            f"{name} has no parameter {unknown[0]!r}{nearest(unknown[0], parameters)}; it has {', '.join(constraints)}"
        )
    remaining = {
        key: constraint for key, constraint in constraints.items() if key in parameters and key not in spec.given
    }
    for group in ALTERNATIVES:
        for key in [key for key in group if key in remaining or key in spec.given][1:]:
            remaining.pop(key, None)
    forms: dict[str, Form] = {}
    for key, constraint in remaining.items():
        with _explain_errors(spec, NotImplementedError):
            is_integer = constraint.is_discrete
        if is_integer:
            raise ValueError(
                f"the parameter {key} of {name} is a whole number and must be given, such as given={{{key!r}: 10}}"
            )
        if key in spec.shapes:
            size: tuple[int, ...] = tuple(shape.size if n == -1 else n for n in spec.shapes[key])
        else:  # a univariate distribution has one parameter per coordinate
            size = (shape.size,) * (constraint.event_dim if kind.support.event_dim else 1)  # type: ignore[union-attr]
        to = _transform(constraint)
        forms[key] = tuple(to.inverse_shape(torch.Size(size))), to, size
    if not forms:
        raise ValueError(
            f"all parameters of {name} are given, so no parameter is left to be read or learned; remove one of "
            f"{', '.join(constraints)} from `given`"
        )
    return forms


@contextmanager
def _explain_errors(spec: Family, *errors: type[Exception]) -> Iterator[None]:
    """Convert errors that occur while a distribution is built into a ValueError with an explanation.

    Args:
        spec: specification of the distribution, named in the message.
        errors: types of the errors to convert.
    """
    try:
        yield
    except errors as error:
        raise ValueError(
            f"{spec.kind.__name__} with given={dict(spec.given)} cannot be built from the output of a network "
            f"({error}); give further parameters in `given`, or write a ConditionalDistribution for it"
        ) from error


def _transform(constraint: Any) -> Any:
    try:
        return biject_to(constraint)
    except NotImplementedError:  # torch has a surjective map, but no bijection, to scale matrices
        return transform_to(constraint)


def _centre(distribution: Any) -> str:
    """Return "mean" if the distribution has a finite mean, otherwise "mode", or "" if it has no finite mode either."""
    for name in ("mean", "mode"):
        with suppress(NotImplementedError, AttributeError):
            if torch.isfinite(getattr(distribution, name)).all():
                return name
    return ""


@dataclass(frozen=True)
class NormalMixture:
    """Separate mixture of normals for each coordinate; weights, locations and scales are functions of the features.

    Args:
        components: K, number of components of each mixture, at least 1.
        min_scale: lower bound of the scales.
    """

    components: int = 5
    min_scale: float = 1e-3

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape.

        Args:
            shape: the variable and its features.

        Raises:
            ValueError: `components` is less than 1.
        """
        if self.components < 1:
            raise ValueError(f"`components` of NormalMixture must be at least 1, got {self.components}")
        return NormalMixtureModule(self, shape)


class NormalMixtureModule(ConditionalDistribution):
    """Distribution module of `NormalMixture`; its parameters are logits, locations and scales, (..., D K) each."""

    reparameterised = False
    location_scale = True
    centred = True

    def __init__(self, spec: NormalMixture, shape: Shape):
        super().__init__()
        self.components, self.min_scale = spec.components, spec.min_scale
        self.out = self.projection(shape.features, 3 * shape.size * spec.components, 0)
        spread = torch.linspace(-1.0, 1.0, spec.components) if spec.components > 1 else torch.zeros(1)
        with torch.no_grad():  # without features, identical components would remain identical
            self.out.bias.unflatten(0, (3, shape.size, -1))[1] += spread

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        logits, loc, raw = self.out(features).chunk(3, dim=-1)
        return logits, loc, nn.functional.softplus(raw.contiguous()) + self.min_scale

    @override
    def distribution(self, parameters: Parameters) -> TorchDistribution:
        logits, loc, scale = (value.unflatten(-1, (-1, self.components)) for value in parameters)
        parts = dist.Normal(loc, scale, validate_args=False)
        return dist.MixtureSameFamily(dist.Categorical(logits=logits, validate_args=False), parts, validate_args=False)

    @override
    def mean(self, parameters: Parameters) -> Tensor:
        return self.distribution(parameters).mean

    @override
    def rescale(self, parameters: Parameters, mean: Tensor, scale: Tensor) -> Parameters:
        logits, loc, spread = (value.unflatten(-1, (-1, self.components)) for value in parameters)
        mean, scale = mean[:, None], scale.expand_as(mean)[:, None]
        return logits.flatten(-2), torch.addcmul(mean, loc, scale).flatten(-2), (spread * scale).flatten(-2)


@dataclass(frozen=True)
class LowRankNormal:
    """Multivariate normal for each step, with the covariance L L' + diagonal; L has shape (D, rank).

    Location, L and diagonal are functions of the features.

    Args:
        rank: number of columns of L.
        min_scale: lower bound of the square roots of the diagonal.
        residual: share of the previous value, as in `ConditionalDistribution`.
    """

    rank: int = 2
    min_scale: float = 1e-3
    residual: float = False

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape.

        Args:
            shape: the variable and its features.
        """
        family = Family(
            "LowRankMultivariateNormal", {}, (), {"cov_factor": (-1, self.rank)}, self.min_scale, self.residual
        )
        return family.build(shape)


FAMILIES: Mapping[str, DistributionSpec] = {
    "real": Normal(),
    "fixed": FixedNormal(scale=0.1, learned=True),
    "robust": StudentT(),
    "laplace": Family("Laplace"),
    "mixture": NormalMixture(),
    "correlated": LowRankNormal(),
    "angle": Family("VonMises"),
    "positive": Family("Gamma"),
    "log-normal": Family("LogNormal"),
    "hurdle": Family("HurdleLogNormal"),
    "power": Family("Exponential"),
    "share": Family("Beta"),
    "binary": Family("Bernoulli"),
    "category": Family("OneHotCategorical"),
    "count": Family("Poisson"),
    "overdispersed": Family("NegativeBinomial"),
    "sparse": Family("ZeroInflatedPoisson"),
    "sparse-overdispersed": Family("ZeroInflatedNegativeBinomial"),
}
"""Specifications of the families for observations by name, as described in the table of this module."""
