"""Recipes, which describe the training of a model on data, and methods, which build a model and its recipe."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from ...data.schema import Schema, SchemaError
from ...data.sequences import Source
from ...options import check
from ...program.batch import AnyBatch
from ...program.model import DynamicalVAE
from .objectives import Objective
from .options import Stage, Training
from .schedules import Schedule

FORMAT = 2
"""Format version of the config of a run."""


def _do_nothing(model: nn.Module) -> None:
    """Leave the model unchanged."""


@dataclass(frozen=True)
class Recipe:
    """Description of a model's training, which `dvae.fit(model, recipe)` follows.

    Args:
        batches: source of training batches, with everything that the objective needs.
        validation: validation data for selecting the best weights, or None.
        stages: consecutive stages, each with its objective.
        feeding: probability of scheduled sampling over the run, or share of the noise (see `Training`).
        prepare: function of the model that is called before fitting, for example to store statistics of the training
            data in it.
    """

    batches: Source
    validation: Any
    stages: Sequence[Stage]
    feeding: Schedule | float = 0.0
    prepare: Callable[[Any], None] = _do_nothing

    @property
    def objective(self) -> Objective:
        """Objective of the last stage."""
        return self.stages[-1].objective


@torch.enable_grad()
def fit_factor(
    model: DynamicalVAE, name: str, batch: AnyBatch, latents: Mapping[str, Tensor], steps: int, learning_rate: float
) -> None:
    """Fit the generative factor of a variable to a batch by Adam, before training, given values of the latents.

    Args:
        model: model of which only the parameters of this factor change.
        name: name of the variable.
        batch: as in `DynamicalVAE.model`.
        latents: values (B, T, D) of the latents that the factor reads, and of the variable if it is a latent.
        steps: number of steps.
        learning_rate: step size.
    """
    optimizer = torch.optim.Adam(model.generator[name].parameters(), learning_rate)
    for _ in range(steps):
        run = model.rollout(batch)
        run.values.update(latents)
        optimizer.zero_grad()
        (-run.distribution(name).log_prob(run.values[name]).mean()).backward()
        optimizer.step()
    optimizer.zero_grad()


@dataclass(frozen=True)
class Trainable:
    """Base class of methods, which build a model for data and describe its training. The fields are the options.

    A subclass implements `build` and `train`, and `resolve_defaults` if an option may be left open.

    Raises:
        ValueError: when an option is out of range.
    """

    name: ClassVar[str]
    source: ClassVar[str]
    fitted_on: ClassVar[str] = "windows"
    """Kind of training data: "windows" of any kind of data, or the name of one kind (`dvae.runs.kinds.DATA`)."""
    trainings: ClassVar[Mapping[str, Training]] = {"": Training(decay=0.5)}
    """Default training options for each data preset (`Schema.preset`); "" is for all other data."""

    def __post_init__(self) -> None:
        check(self)

    def resolve_defaults(self, data: Any) -> Self:
        """Return a copy whose open options are set for these data, or the method itself if no option is open."""
        return self

    def build(self, data: Any) -> nn.Module:
        """Build the model for data: windows, a `Schema`, or sizes by name such as {"x": 60}.

        Raises:
            SchemaError: when the model needs more information about the data.
        """
        raise NotImplementedError

    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Return the recipe that trains the model on these data for `steps` steps."""
        raise NotImplementedError

    def training(self, data: Any) -> Training:
        """Return the default training options for these data."""
        return self.trainings.get(Schema.of(data).preset, self.trainings[""])

    def check(self) -> None:
        """Raise an error if options conflict, before any data are read.

        Raises:
            ValueError: when options conflict; the message names them.
        """
        with suppress(SchemaError):
            self.build(Schema({"x": 1}))

    def config(self) -> dict[str, Any]:
        """Return name and options as JSON types."""
        return {"method": self.name, **asdict(self)}


def run_config(method: Trainable, schema: Schema, kind: str, source: Any) -> dict[str, Any]:
    """Return the content of `config.json` for a run of a method, without the training options, which `fit` adds.

    Args:
        method: method with its options.
        schema: schema of the data.
        kind: name of the kind of data.
        source: dataclass that describes where the data are stored.
    """
    described = {"kind": schema.kind, **schema.config()}
    return {"format": FORMAT, "method": method.config(), "schema": described, "data": {"kind": kind, **asdict(source)}}
