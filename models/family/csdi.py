"""CSDI: missing entries and forecasts of a table by a diffusion model, given the other entries.

    p(x_{1:T} | g_{1:T}),  no latents and no guide

g_t contains the given values and their indicators, and x the other entries, the targets. The denoiser reads g, the
noise level and the targets' noisy values. In training, a random share of the observed entries is given and the rest
are targets; with a horizon, half of the windows are given the observed steps only. Tashiro, Song, Song and Ermon, 2021,
arXiv 2107.03502: sections 3.2 (conditional diffusion), 4.2 (training) and 4.3 (choice of targets). Ours:

* The likelihood: a bound of the density of the targets, with a learned schedule, in place of the weighted loss.
* Location and scale of the diffusion are linear functions of g interpolated in time, and of a code of g by a second
  transformer; both also enter the denoiser. The paper's diffusion starts from noise of variance 1.
* Attention over time only. A frame of all columns is one token, so the layers between frames mix the columns. The paper
  has a token for each column and step, and also attention over columns.
* Level and scale of each series, estimated from its given entries (`units="series"`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, Self

import torch
from torch import Tensor
from typing_extensions import override

from ...data.batch import WHOLE, Batch
from ...data.schema import Schema, SchemaError
from ...data.sequences import RandomGiven, interpolate_missing, tensor_of
from ...data.series_units import GivenUnits, SeriesUnits
from ...data.units import Coordinate
from ...data.views import Given, View, Views
from ...distributions import Diffusion, DistributionSpec
from ...factorization.notation import Factorization
from ...factorization.relations import ALL
from ...inference.training.options import Training
from ...inference.training.recipe import Recipe
from ...networks import Denoiser, Input, NetworkSpec, SelfAttention
from ...networks.base import FixedLengthNetwork, aligned
from ...options import Count, Layers, Range, Size
from ...program.batch import AnyBatch
from ...program.conditional import like
from ...program.model import DynamicalVAE
from ..method import LikelihoodMethod, columns_not_real

CONTEXT = "g"
LOGARITHMS = ("positive", "log-normal")
"""Families of positive columns, which become real in the units "logs" and "series"."""


@dataclass(frozen=True)
class CSDI(LikelihoodMethod):
    """A diffusion model of the missing entries and the future of a table.

    Columns are real numbers, or positive ones as logarithms. Without covariates, any sequences of numbers are valid.

    Args:
        latent: always None; the method has no latents.
        emission: always None; x has a `Diffusion`.
        residual: always 0.
        units: "columns", "logs" or "series", as in `LikelihoodMethod`. None: "series" if the training windows prefer
            units of the sequence, "logs" if a column is positive, else "columns".
        width: width of the transformers.
        heads_count: number of attention heads.
        layers: number of layers of each transformer.
        scheduled_sampling: always None.
        schedule: "learned" or "cosine", as in `Diffusion`.
        sampler_steps: number of steps of the sampler.
    """

    name = "csdi"
    source = "Tashiro, Song, Song and Ermon, 2021, arXiv 2107.03502"
    generative = "p(x_{1:T} | g_{1:T})"
    inference = ""

    trainings: ClassVar[Mapping[str, Training]] = {
        **LikelihoodMethod.trainings,
        "table": Training(1000, 64, 3e-3, decay=0.3, validate_every=100, select="forecast", patience=3),
    }

    latent: None = None
    emission: None = None
    scheduled_sampling: None = None
    residual: Annotated[float, Range(0, 0)] = 0.0
    units: Literal["columns", "logs", "series"] | None = None
    width: Size = 64
    heads_count: Size = 4
    layers: Layers = 2
    schedule: Literal["learned", "cosine"] = "learned"
    sampler_steps: Count = 30

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.width % self.heads_count:
            raise ValueError(
                f"width must be a multiple of heads_count, got width={self.width} and heads_count={self.heads_count}"
            )

    @override
    def resolve_defaults(self, data: Any) -> Self:
        """Return the method with unset `units` chosen for the data."""
        schema = Schema.of(data)
        if self.units is not None:
            return self
        if getattr(schema, "preferred", "columns") != "columns":
            return replace(self, units="series")
        families = [column.family for column in schema.columns.targets] if hasattr(schema, "columns") else []
        return replace(self, units="logs" if {*families} & {*LOGARITHMS} else "columns")

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        return {"default": GivenFeatures(self._transformer())}

    @override
    def distributions(self) -> Mapping[str, DistributionSpec]:
        """Return the diffusion of x."""
        options: dict[str, Any] = {"schedule": self.schedule, "steps": self.sampler_steps}
        return {"p(x)": Diffusion(denoiser=Denoiser(self._transformer()), **options)}

    def _transformer(self) -> SelfAttention:
        return SelfAttention(self.width, self.heads_count, self.layers, positions="sinusoids")

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """Return the model, whose factor also reads all covariates.

        Raises:
            SchemaError: if a column is not real in these units, or the table has lags.
        """
        schema = Schema.of(data)
        method = self.resolve_defaults(schema)
        schema = schema if method.units == "columns" else method._in_units(schema)
        _check_columns(schema)
        local, static = schema.covariates
        parents = [f"{name}_{{1:T}}" for name in (CONTEXT, *local)]
        generative = Factorization.parse(f"p(x_{{1:T}} | {', '.join([*parents, *static])})")
        size = schema.size(WHOLE)
        sizes = {WHOLE: size, CONTEXT: 2 * size, **{name: schema.size(name) for name in (*local, *static)}}
        view = Views(*_views(schema.view), Given(CONTEXT, schema.observed))
        model = CSDIModel(generative, "", sizes, method.networks(), method.distributions(), view=view)
        model.window, model.per = schema.length, schema.per
        for coordinates in schema.units.values():
            model.standardise(WHOLE, coordinates)
            model.standardise(CONTEXT, [*coordinates, *[Coordinate()] * size])
        return model

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Return one stage that maximises the bound of random targets."""
        schema = Schema.of(train, self.name)
        return super().train(RandomGiven(train, schema.observed), validation, steps)


class CSDIModel(DynamicalVAE):
    """A model that draws the entries of windows that are at most as long as in training."""

    window: int | None = None
    """Steps of a training window; None if they differ."""

    @override
    def forecast(self, batch: AnyBatch, horizon: int, samples: int = 1, **options: Any) -> dict[str, Tensor]:
        """Forecast from the last steps of the past, so that past and future are at most as long as a training window.

        Raises:
            ValueError: if the horizon is not shorter than a training window.
        """
        values = Batch(batch if isinstance(batch, Mapping) else {WHOLE: batch})
        window = self.window or values[WHOLE].shape[1] + horizon
        if horizon >= window:
            raise ValueError(f"horizon is {horizon}, but training windows have {window} steps; give a shorter horizon")
        past = _steps(values, slice(max(values[WHOLE].shape[1] + horizon - window, 0), None))
        return super().forecast(past, horizon, samples, **options)

    @torch.no_grad()
    @override
    def impute(self, batch: AnyBatch, samples: int = 1, **options: Any) -> dict[str, Tensor]:
        """Fill in missing entries, in windows that overlap by half if a sequence is longer than a training window.

        A window is filled in given the draws of the windows before it, so that its draws continue theirs.
        """
        values = Batch(batch if isinstance(batch, Mapping) else {WHOLE: batch})
        length, window = values[WHOLE].shape[1], self.window
        if samples < 1 or window is None or length <= window or values.mask() is None:
            return super().impute(values, samples, **options)
        count = len(values[WHOLE])
        filled = values.map(tensor_of).map(lambda value: value.repeat(samples, *[1] * (value.ndim - 1)))
        if not filled[WHOLE].is_floating_point():
            filled[WHOLE] = filled[WHOLE].to(like(self))
        starts = [*range(0, length - window, -(-window // 2)), length - window]
        ends = [*(start + window // 4 for start in starts[1:]), length]  # a window contributes its middle
        for start, end in zip(starts, ends, strict=True):
            part = super().impute(_steps(filled, slice(start, start + window)), 1, **options)[WHOLE][0]
            filled[WHOLE][:, start:end] = part[:, : end - start]
            filled.mask()[:, start:end] = True
        return {WHOLE: filled[WHOLE].to(part).unflatten(0, (samples, count))}


def _steps(values: Batch, steps: slice) -> Batch:
    """Return some steps of a batch; the lengths of sequences that end before them are 1."""
    part = values.map(lambda value: value[:, steps] if value.ndim == 3 else value)
    if values.lengths is None:
        return part
    return part | {"lengths": (values.lengths - (steps.start or 0)).clip(1, part[WHOLE].shape[1])}


def _views(view: View) -> list[View]:
    """Return the parts of a view, with units of the sequence that are estimated from given entries."""
    views = view.views if isinstance(view, Views) else [view]
    return [GivenUnits(v.priors, 0, v.observed) if isinstance(v, SeriesUnits) else v for v in views]


def _check_columns(schema: Any) -> None:
    """Check that all columns are real, and no covariate contains targets.

    Raises:
        SchemaError: if a column is not real in the units of the schema, or the table has lags.
    """
    if schema.emission is None:
        return
    for name, family in columns_not_real(schema).items():
        raise SchemaError(
            f"csdi draws real numbers, but column {name!r} has the family {family!r}; give it the family real, or take "
            "a method for any family, such as srnn"
        )
    if schema.columns.lags:
        raise SchemaError(
            "csdi hides entries at random, but lags repeat them at later steps; leave lags out (csdi reads all given "
            "entries of a window), or take another method, such as srnn"
        )


@dataclass(frozen=True)
class GivenFeatures:
    """Features of the given entries: their interpolation in time, and a code of them by a network.

    Args:
        network: network that reads the interpolated entries, their indicators and the other parents.
    """

    network: NetworkSpec

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> GivenFeaturesNetwork:
        """Return the network for a child of dimension `size`, with the parents `inputs`, the given entries first."""
        return GivenFeaturesNetwork(self, inputs, size)


class GivenFeaturesNetwork(FixedLengthNetwork):
    """Network of `GivenFeatures`."""

    def __init__(self, spec: GivenFeatures, inputs: Sequence[Input], size: int) -> None:
        frame = Input("frame", sum(parent.size for parent in inputs), ALL)
        network = spec.network.build([frame], True, size)
        super().__init__(inputs, True, size + network.features)
        self.network = network

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        values, indicators = parents[CONTEXT].chunk(2, -1)
        interpolated = interpolate_missing(values, indicators > 0)
        others = [value for name, value in parents.items() if name != CONTEXT]
        frames = torch.cat(aligned([interpolated, indicators, *others]), -1)
        return torch.cat([interpolated, self.network({"frame": frames}, length, lengths)], -1)
