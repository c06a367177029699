"""Methods: two equations, a model built for data, and a training recipe."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, Self

import torch
from typing_extensions import override

from ..data.batch import WHOLE
from ..data.schema import Schema, SchemaError
from ..data.sequences import RandomMasking, as_source, interpolate_missing
from ..data.views import View
from ..distributions import (
    FAMILIES,
    Diffusion,
    DistributionSpec,
    Family,
    FixedNormal,
    Flow,
    Mixture,
    Normal,
    Product,
    StudentT,
    Vamp,
)
from ..distributions.base import Shape, is_real
from ..distributions.priors import VampModule
from ..factorization.inversion import guide
from ..factorization.notation import Factorization
from ..inference.training.objectives import Evidence, Objective
from ..inference.training.options import Stage, Training
from ..inference.training.recipe import Recipe, Trainable
from ..inference.training.schedules import Cosine, Logistic, Ramp, Schedule
from ..networks import NetworkSpec
from ..options import Amount, Delay, Range, Share, Size
from ..program.enumeration import Discrete
from ..program.model import DynamicalVAE
from ..program.rollout import ScheduledSampling

SHAPES: dict[str, type[Ramp | Cosine | Logistic]] = {"linear": Ramp, "cosine": Cosine, "logistic": Logistic}


@dataclass(frozen=True)
class Method(Trainable):
    """A method of the literature. Each subclass is one file of this package, and its fields are its options.

    A method has four hooks: `equations`, `resolve_defaults` (chooses unset options for the data), `build` (returns the
    model) and `train` (returns the recipe). Most models follow from their equations, `sizes`, `networks` and
    `distributions`.

    Args:
        latent: size of z.
    """

    generative: ClassVar[str]
    inference: ClassVar[str]

    latent: Size | None = 16

    def equations(self) -> tuple[Factorization, Factorization]:
        """Return the generative model and the guide; the guide of a model without latents has no factors."""
        generative = Factorization.parse(self.generative)
        return generative, guide(generative, self.inference)

    def sizes(self) -> dict[str, int]:
        """Return the sizes of the latents by name, such as {"z": 16}."""
        return {"z": self.latent or 0}

    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return the network specifications by factor, such as {"default": Recurrent(64)}."""
        raise NotImplementedError(
            f"{type(self).__name__} defines no networks; define `networks(self)`, which returns them by factor, such "
            'as {"default": Recurrent(64)}, or override `build`'
        )

    def distributions(self) -> Mapping[str, DistributionSpec]:
        """Return the distributions by factor; factors without an entry are normal."""
        return {}

    def model_arguments(self, sizes: Mapping[str, int]) -> dict[str, Any]:
        """Return the arguments of `DynamicalVAE` for data of these sizes."""
        generative, inference = self.equations()
        arguments = {"generative": generative, "inference": inference, "sizes": {**self.sizes(), **sizes}}
        return {**arguments, "network": self.networks(), "distributions": dict(self.distributions())}


@dataclass(frozen=True)
class LikelihoodMethod(Method):
    """A method with a likelihood, trained on the evidence; its model follows from its networks and distributions.

    A subclass defines `networks`, and overrides `sizes` and `distributions` where it differs.

    Args:
        emission: distribution of x: "fixed" (normal, one learned scale per coordinate), "unit" (normal, variance 1),
            "normal" (scale read from the parents), "student" (Student t) or "diffusion" (with a bound in place of its
            density). By default the distributions of a table's columns, or "fixed".
        residual: share of x_{t-1} that the mean of x_t keeps; the factor must read x_{t-1}. With 1 the network predicts
            an offset: one-step forecasts are sharp, but long forecasts can drift without limit. A smaller share limits
            the drift.
        units: units of a table's targets in the model; see `dvae.tables.encoding.TargetUnits`. None: the units that
            the training windows prefer (`PanelSchema.preferred`).
        scheduled_sampling: final probability that a step of x's history is the model's own mean. It rises from 0 over
            a third of training, after the first tenth. No gradient flows through these means. Models that read no x
            ignore it. None: 1 for data with a horizon that are not a table, and 0 for others.
    """

    trainings: ClassVar[Mapping[str, Training]] = {
        **Method.trainings,
        "table": Training(1000, 64, 3e-3, decay=0.3, validate_every=50, select="forecast", patience=8),
    }
    """The options for tables were chosen on validation windows of public tables (docs/results/tables.md)."""
    without_covariates: ClassVar[tuple[str, ...]] = ()
    """Factors that read no covariates, such as "p(z)"."""

    emission: Literal["fixed", "unit", "normal", "student", "diffusion"] | None = None
    residual: Share = 0.0
    units: Literal["columns", "logs", "series", "changes", "seasonal"] | None = None
    scheduled_sampling: Share | None = 0.0

    @override
    def resolve_defaults(self, data: Any) -> Self:
        """Return the method with unset `units` and `scheduled_sampling` chosen for the data."""
        schema, options = Schema.of(data), dict[str, Any]()
        if self.units is None:
            options["units"] = getattr(schema, "preferred", "columns")
        if self.scheduled_sampling is None:
            options["scheduled_sampling"] = float(schema.observed is not None and schema.emission is None)
        return replace(self, **options)

    @override
    def distributions(self) -> Mapping[str, DistributionSpec]:
        """Return the distribution of x by factor; the data may replace it."""
        emissions: dict[str, DistributionSpec] = {
            "normal": Normal(residual=self.residual),
            "fixed": FixedNormal(scale=0.1, learned=True, residual=self.residual),
            "unit": FixedNormal(residual=self.residual),
            "student": StudentT(residual=self.residual),
            "diffusion": Diffusion(residual=self.residual),
        }
        return {"p(x)": emissions[self.emission or "fixed"]}

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """Return the model of these equations, whose factors also read the covariates of the data."""
        model = self.build_for_data(Schema.of(data), extended=True)
        model.feeding = ScheduledSampling(0.0, gradient=False)
        return model

    def build_for_data(
        self, schema: Schema, extended: bool, kind: type[DynamicalVAE] = DynamicalVAE, view: View | None = None
    ) -> DynamicalVAE:
        """Return the model for data, with their distribution and their units.

        Args:
            schema: schema of the data.
            extended: whether factors also read the covariates of the data, in addition to their parents.
            kind: class of the model.
            view: view of the model, in place of the data's own.
        """
        if self.units not in (None, "columns"):
            schema = self._in_units(schema)
        generative, inference = self.equations()
        names = {name for part in (generative, inference) for name in (*part.variables, *part.context)}
        if extended:
            generative, inference = (
                part.given(*schema.covariates, self.without_covariates) for part in (generative, inference)
            )
            names |= {name for part in schema.covariates for name in part}
        model_arguments = self.model_arguments({name: size for name, size in schema.sizes.items() if name in names})
        model_arguments |= {"generative": generative, "inference": inference}
        if schema.emission is not None and self.emission is None:
            model_arguments["distributions"]["p(x)"] = self.of_columns(schema.emission)
        elif schema.emission is not None and (replaced := columns_not_real(schema)):
            real = ", ".join(f"{name} ({family})" for name, family in replaced.items())
            warnings.warn(
                f"emission={self.emission!r} treats {real} as real numbers; leave emission out to keep the families",
                stacklevel=3,
            )
        model = kind(**{"indicators": schema.indicators, **model_arguments}, view=view or schema.view)
        model.per = schema.per
        for name, coordinates in schema.units.items():
            model.standardise(name, coordinates, exposure=schema.exposure if name == WHOLE else None)
        return model

    def _in_units(self, schema: Schema) -> Schema:
        """Return the schema with the units of `units`.

        Raises:
            SchemaError: if the data are not a table, or its columns do not support these units.
        """
        if not hasattr(schema, "in_units"):
            raise SchemaError(
                f"units is {self.units!r}, which needs a table, but the data are {schema.kind}; use "
                'units="columns", or wrap the data by dvae.tables.PanelData.of'
            )
        result: Schema = schema.in_units(self.units or "columns")
        return result

    def of_columns(self, distribution: DistributionSpec) -> DistributionSpec:
        """Return the distribution of x for a table whose columns define one, with the `residual` of this method.

        Raises:
            ValueError: if `residual` is not 0 and a distribution has no location to which it can add.
        """
        return with_residual(distribution, self.residual) if self.residual else distribution

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Return one stage that minimises the negative evidence, with the scheduled sampling of the options."""
        return Recipe(train, validation, [Stage(steps, self.objective())], self._feeding(steps))

    def objective(self) -> Objective:
        """Return the objective of training."""
        return Evidence()

    def _feeding(self, steps: int) -> Schedule | float:
        """Return the probability of scheduled sampling over a run of `steps`; 0 for a model that reads no data."""
        p, q = self.equations()
        reads = {parent.name for factor in p.factors for parent in factor.parents}
        discrete = {name for name, size in self.sizes().items() if isinstance(size, Discrete)}
        if not self.scheduled_sampling or not reads & (set(p.variables) - set(q.variables) - discrete):
            return 0.0
        return rising(self.scheduled_sampling, steps)


@dataclass(frozen=True)
class LatentMethod(LikelihoodMethod):
    """A `LikelihoodMethod` with latents.

    Args:
        prior: distribution of the static latents without parents: "standard" (normal, nothing learned), "mixture" (of
            normals), "vamp" (mixture of the guide's posteriors of learned pseudo-sequences), "flow" or "diffusion"
            (with a bound in place of its density). `DynamicalVAE.with_prior` trains it in a second stage instead.
        prior_components: number of components of "mixture" and "vamp".
        prior_steps: length of the pseudo-sequences of "vamp"; at most the length of the training windows.
        warm_up: steps over which the KL weight rises from 0 to 1.
        warm_up_shape: shape of the rise.
        free_bits: nats per step below which the KL of a latent, averaged over the batch, is not penalised.
        hide: share of the entries of training windows to hide from the guide and the likelihood, drawn anew for every
            batch. The guide learns to handle missing entries, and reads indicators of the observed ones.
    """

    latent: Size = 16
    prior: Literal["standard", "mixture", "vamp", "flow", "diffusion"] = "standard"
    prior_components: Annotated[int, Range(1, 1024)] = 16
    prior_steps: Annotated[int, Range(1, 1024)] = 16
    warm_up: Delay | None = 500
    warm_up_shape: Literal["linear", "cosine", "logistic"] = "linear"
    free_bits: Amount = 0.0
    hide: Annotated[float, Range(0, 1, below=True)] = 0.0

    @override
    def model_arguments(self, sizes: Mapping[str, int]) -> dict[str, Any]:
        """Return the arguments, with indicators of x if entries are hidden."""
        return {**super().model_arguments(sizes), **({"indicators": ("x",)} if self.hide else {})}

    @override
    def distributions(self) -> Mapping[str, DistributionSpec]:
        """Return the distributions of x and, unless `prior` is "standard", of static latents without parents.

        Raises:
            ValueError: if `prior` is given but no latent is static and without parents.
        """
        distributions = super().distributions()
        if self.prior == "standard":
            return distributions
        priors: dict[str, DistributionSpec] = {
            "mixture": Mixture(self.prior_components),
            "vamp": Vamp(self.prior_components, self.prior_steps),
            "flow": Flow(),
            "diffusion": Diffusion(),
        }
        p, q = self.equations()
        latents = [f.child for f in p.factors if f.child in q.variables and not (f.local or f.parents)]
        if not latents:
            raise ValueError(
                f"prior={self.prior!r} needs a static latent without parents, such as p(w), but {p.text} does not "
                'have one; use prior="standard"'
            )
        return {**distributions, **{f"p({name})": priors[self.prior] for name in latents}}

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Return one stage that minimises the negative evidence.

        The options set its warm-up, free bits and scheduled sampling.

        Raises:
            ValueError: when the recipe prepares the model, if pseudo-sequences of the prior are longer than the
                windows.
            SchemaError: if `hide` is set and the schema does not define which entries are observed together.
        """
        batches = train
        if self.hide:
            schema = Schema.of(train, self.name)
            together = [0] * schema.size(WHOLE) if self.emission == "diffusion" else schema.together
            batches = RandomMasking(as_source(train), self.hide, together)
        return replace(super().train(batches, validation, steps), prepare=partial(start_priors, train=train))

    @override
    def objective(self) -> Objective:
        """Return the objective of training."""
        steps = self.warm_up if self.equations()[1].factors else None
        weight = SHAPES[self.warm_up_shape](0.0, 1.0, steps=steps) if steps else 1.0
        return Evidence(kl_weight=weight, free_bits=self.free_bits)


def columns_not_real(schema: Any) -> dict[str, str]:
    """Return the families, by name, of target columns that are not real numbers in the units of a table's schema."""
    columns = [column for column in schema.columns.targets for _ in column.coordinates]
    single = [(range(len(columns)), schema.emission)]
    parts = schema.emission.parts if isinstance(schema.emission, Product) else single
    places = [n for some, part in parts if not is_real(part.build(Shape(len(some), 1)).support) for n in some]
    return {columns[place].name: columns[place].family for place in sorted(places)}


def with_residual(distribution: Any, residual: float) -> Any:
    """Return the distribution of a table's columns with a share of the previous value in its location.

    Raises:
        ValueError: if a part has no location.
    """
    if isinstance(distribution, Product):
        parts = tuple((places, with_residual(part, residual)) for places, part in distribution.parts)
        return replace(distribution, parts=parts)
    kind = distribution.kind.__name__ if isinstance(distribution, Family) else type(distribution).__name__
    if not hasattr(distribution, "residual") or (isinstance(distribution, Family) and kind != "Laplace"):
        family = next((name for name, spec in FAMILIES.items() if spec == distribution), kind)
        raise ValueError(
            f"residual is {residual}, but the family {family!r} has no location to which the previous value can be "
            'added; leave residual at 0, or give these columns the family "real", or positive columns units="changes"'
        )
    return replace(distribution, residual=residual)


def rising(level: float, steps: int) -> Ramp:
    """Return a ramp from 0 to `level` over a third of a run of `steps`, after its first tenth."""
    return Ramp(0.0, level, steps=max(steps // 3, 1), delay=steps // 10)


def fit_units(model: DynamicalVAE, train: Any) -> None:
    """Fit the units of x in a model to 1024 windows of the training data, in the model's view."""
    data = model.read(as_source(train).sample(1024, torch.default_generator), precise=True)
    model.units[WHOLE].fit(interpolate_missing(data[WHOLE], data.mask()))


def start_priors(model: DynamicalVAE, train: Any) -> None:
    """Initialise the pseudo-sequences of a model's Vamp priors with windows of the training data, in its view."""
    for distribution in model.modules():
        if isinstance(distribution, VampModule):
            distribution.start_at(model.read(as_source(train).sample(distribution.components, torch.default_generator)))
