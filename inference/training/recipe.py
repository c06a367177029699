"""Recipes: how a model is trained on some data; and methods, which build a model and its recipe."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Self

from torch import nn

from ...data.schema import Schema, SchemaError
from ...data.sequences import Source
from ...options import check
from .objectives import Objective
from .options import Stage, Training
from .schedules import Schedule

FORMAT = 2
"""Format of the config of a run."""


def _as_it_is(model: nn.Module) -> None:
    """Nothing is taken from the data beforehand."""


@dataclass(frozen=True)
class Recipe:
    """How a model is trained: `dvae.fit(model, recipe)` follows it.

    Args:
        batches: where training draws from: the data, and what the objective needs beside them.
        validation: what the weights are judged by, or None.
        stages: what is minimised, one after the other.
        feeding: probability of self-feeding over the run, or share of the noise (see `Training`).
        prepare: has the model take from the training data what its weights keep, before it is fitted.
    """

    batches: Source
    validation: Any
    stages: Sequence[Stage]
    feeding: Schedule | float = 0.0
    prepare: Callable[[Any], None] = _as_it_is

    @property
    def objective(self) -> Objective:
        """What the last stage minimises."""
        return self.stages[-1].objective


@dataclass(frozen=True)
class Trainable:
    """What builds a model for data and says how it is trained; its fields are its options.

    A subclass gives `build` and `train`, and `suited` where options may be left open.

    Raises:
        ValueError: when an option is out of range.
    """

    name: ClassVar[str]
    source: ClassVar[str]
    fitted_on: ClassVar[str] = "windows"
    """What it is fitted on: "windows" of any kind of data, or the name of one kind (`dvae.runs.kinds.DATA`)."""
    trainings: ClassVar[Mapping[str, Training]] = {"": Training(decay=0.5)}
    """How it is fitted where nothing else is said, by the preset of data (`Schema.preset`), and "" for all others."""

    def __post_init__(self) -> None:
        check(self)

    def suited(self, data: Any) -> Self:
        """With what its options leave open chosen for these data; itself, where nothing is open."""
        return self

    def build(self, data: Any) -> nn.Module:
        """The model for data: their windows, their `Schema`, or sizes by name such as {"x": 60}.

        Raises:
            SchemaError: more has to be known of the data.
        """
        raise NotImplementedError

    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """How the model is trained on these data, in so many steps."""
        raise NotImplementedError

    def training(self, data: Any) -> Training:
        """How the model is fitted to these data, where nothing else is said."""
        return self.trainings.get(Schema.of(data).preset, self.trainings[""])

    def check(self) -> None:
        """Refuses options that do not fit together, before any data are read.

        Raises:
            ValueError: saying which.
        """
        with suppress(SchemaError):
            self.build(Schema({"x": 1}))

    def config(self) -> dict[str, Any]:
        """Name and options in JSON's types."""
        return {"method": self.name, **asdict(self)}


def run_config(method: Trainable, schema: Schema, kind: str, source: Any) -> dict[str, Any]:
    """Return what `config.json` of a method's run says, but for the options of training, which `fit` adds.

    Args:
        method: with its options.
        schema: of the data.
        kind: of the data, by its name.
        source: a dataclass that says where the data are.
    """
    described = {"kind": schema.kind, **schema.config()}
    return {"format": FORMAT, "method": method.config(), "schema": described, "data": {"kind": kind, **asdict(source)}}
