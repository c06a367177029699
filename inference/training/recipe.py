"""Recipes: how a model is trained on some data, and what builds and trains one."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import nn

from ...data.schema import Schema, SchemaError
from ...data.sequences import Source, as_source, is_divided, take_split
from ...options import check
from ...turns import alone
from .fit import Fit, fit, run_directory
from .objectives import Objective
from .options import Stage, Training
from .schedules import Schedule


def _as_it_is(model: nn.Module) -> None:
    """Nothing is taken from the data beforehand."""


@dataclass(frozen=True)
class Recipe:
    """How a model is trained: what `fit` is told beside the options of a run.

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

    def fit(self, model: nn.Module, *, resume: bool = False, **options: Any) -> Fit:
        """Fits a model so, prepared first unless a run is resumed.

        Args:
            model: as the method has built it.
            resume: continue the run in `out`.
            **options: of `dvae.inference.training.fit.fit`: out, config, trackers, callbacks, and those of `Training`;
                steps and self-feeding are the recipe's.

        Raises:
            ValueError: other steps than the recipe's, which are laid out over its own, or a self-feeding.
            CheckpointError: when `out` holds a run and `resume` is False.
        """
        steps = sum(stage.steps for stage in self.stages)
        if options.get("steps", steps) != steps:
            raise ValueError(f"this recipe is of {steps} steps, not {options['steps']}; ask the method for another")
        if options.get("self_feeding", 0.0) != 0.0:
            raise ValueError(
                f"self-feeding is an option of the method, which tells its recipe; instead of self_feeding="
                f"{options['self_feeding']} here write dvae.method(…, self_feeding=…)"
            )
        if not resume:
            run_directory(options.get("out"), False, {})  # which is refused before what may take long
            with torch.random.fork_rng():
                self.prepare(model)
        options |= {"steps": steps, "self_feeding": self.feeding}
        return fit(model, self.batches, self.validation, stages=self.stages, resume=resume, **options)


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

    @alone
    @torch.inference_mode(False)
    def fit(self, data: Any, validation: Any = None, **options: Any) -> Fit:
        """Builds the model for data and fits it to them: in one call, in memory.

        `dvae.runs.directory.fit_run` keeps a run that can be loaded and resumed.

        Args:
            data: with a `schema`, and `windows` to train and to validate on, such as `dvae.tables.PanelData`;
                or training windows; or x as a tensor or array (N, T, D), or a batch, whose
                values are fitted in their own unit.
            validation: windows, x or a batch to validate on; of data with parts their own, where it is None.
            **options: of `Recipe.fit`; those of `Training` that are not given are the method's own (`training`). Its
                seed is that of the initial weights too.

        Returns:
            The fit; its `model` has the best weights.

        Raises:
            TypeError: a table, whose columns need roles, or data of another kind.
            ValueError: see `Recipe.fit`, or data without windows of these parts.
        """
        if validation is None and is_divided(data):
            validation = data
        train = as_source(take_split(data, "train"))
        schema = Schema.of(data if is_divided(data) else train)
        if too_short := getattr(train, "too_short", ""):
            warnings.warn(f"training leaves out {too_short}", stacklevel=2)
        names = Training.__dataclass_fields__.keys() & options
        training = replace(self.training(schema), **{name: options.pop(name) for name in names})
        method = self.suited(train)
        recipe = method.train(train, take_split(validation, "validation"), training.steps)
        with torch.random.fork_rng():
            torch.manual_seed(training.seed)
            return recipe.fit(method.build(schema), **vars(training), **options)

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
