"""Training options, and stages with their own objectives."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Literal

from ...options import Amount, Count, Range, Share, check, kind_of, nearest
from .objectives import Evidence, Objective
from .schedules import Piecewise, Schedule, clamp, levels, schedule, to_config

Accelerator = Literal["auto", "cpu", "gpu", "cuda", "mps"]


@dataclass(frozen=True)
class Training:
    """Options of `fit`.

    Args:
        steps: total number of optimiser steps.
        batch_size: number of sequences in a batch, in each process.
        learning_rate: step size of the optimiser, a number or a schedule.
        decay: last share of the run, over which a constant learning rate falls linearly to 0. In a resumed run with
            more steps, the fall begins later.
        optimizer: "adam", "adamw" or "sgd".
        momentum: momentum of "sgd", the share of the last step that is added to the next one.
        weight_decay: the optimiser's weight decay.
        gradient_clip: largest norm of the gradient of the loss (nats per step); None for no limit.
        scheduled_sampling: probability that a step of x's history is replaced by the model's own mean (scheduled
            sampling, Bengio et al. 2015, arXiv 1506.03099); a number or a schedule. For a model trained on noisy inputs
            (`InputNoise`), the share of that noise. Validation then uses the last value of the schedule, and the best
            weights are selected once the schedule has reached it.
        particles: number of draws from the guide for each sequence and step.
        validate_every: number of steps between validations and checkpoints.
        select: score that selects the best weights: "bound", or "forecast", the CRPS of 20 forecasts of at most 256
            validation windows (`forecast_score`).
        patience: number of validations without a better score before the run stops; None to run all steps.
        log_every: number of steps between rows of the log.
        seed: seed of batches and latent draws; each of several processes derives its own seed from it.
        accelerator: kind of device: "auto", "cpu", "gpu", "cuda" or "mps".
        devices: number of devices, with one process each; under torchrun, the number of processes on this host.
        precision: precision of the computation; "32-true" keeps the model's own.
        progress: whether to show a progress bar with the terms of the bound on the terminal.
        cuda_graph: on a CUDA GPU, whether to replay steps and validations as CUDA graphs (`dvae.capture`), one
            for each shape of batch and each value of a curriculum; not with several devices. Attributes of the model,
            such as `feeding` or the mode of a part, must not change within a stage. It has only been tested on a
            simulated GPU.

    Raises:
        ValueError: when an option is out of range.

    Example:
        >>> dvae.Training(steps=100, learning_rate=1e-3, decay=0.5).rate(75)
        0.0005
    """

    steps: Count = 2000
    batch_size: Annotated[int, Range(1, 16384)] = 32
    learning_rate: Amount | Schedule = 1e-3
    decay: Share = 0.0
    optimizer: Literal["adam", "adamw", "sgd"] = "adam"
    momentum: Annotated[float, Range(0, 1, below=True)] = 0.0
    weight_decay: Amount = 0.0
    gradient_clip: Annotated[float, Range(0, above=True)] | None = 10.0
    scheduled_sampling: Share | Schedule = 0.0
    particles: Annotated[int, Range(1, 4096)] = 1
    validate_every: Count = 100
    select: Literal["bound", "forecast"] = "bound"
    patience: Count | None = None
    log_every: Count = 10
    seed: int = 0
    accelerator: Accelerator = "auto"
    devices: Annotated[int, Range(1, 32)] = 1
    precision: Literal["32-true", "64-true", "bf16-mixed", "bf16-true"] = "32-true"
    progress: bool = True
    cuda_graph: bool = False

    def __post_init__(self) -> None:
        if self.gradient_clip == math.inf:
            object.__setattr__(self, "gradient_clip", None)
        check(self)
        for name, allowed in (("learning_rate", Range(0)), ("scheduled_sampling", Range(0, 1))):
            for value in levels(getattr(self, name)):
                if value not in allowed:
                    raise ValueError(f"{name} is {value}; it must be {allowed}")
        if self.momentum and self.optimizer != "sgd":
            raise ValueError(f"momentum is an option of sgd, but the optimizer is {self.optimizer}; set momentum to 0")
        if self.decay and isinstance(self.learning_rate, Schedule):
            raise ValueError("decay needs a constant learning rate, but learning_rate is a schedule; set decay to 0")

    @property
    def rate(self) -> Schedule:
        """Learning rate as a schedule over `steps`, with its decay."""
        rate = schedule(self.learning_rate)
        if not self.decay:
            return rate
        return Piecewise(((0, rate(0)), (round((1 - self.decay) * self.steps), rate(0)), (self.steps, 0.0)))


@dataclass(frozen=True)
class Stage:
    """Part of a run with its own objective, for training in phases. Schedules use the global step.

    Args:
        steps: number of steps in the stage.
        objective: objective to minimise.
        learning_rate: learning rate; None for the value in `Training`.
        scheduled_sampling: probability of scheduled sampling; None for the value in `Training`.
        curriculum: progress, from 0 to 1, of parts that are introduced gradually, such as draws of variables that
            sequences share (`distributions.Subset`); None for 1.
        frozen: prefixes of names of parameters that are not trained.
        batch_size: number of sequences in a batch, in each process; None for the value in `Training`, which also
            applies to validation.

    Raises:
        TypeError: `objective` is a class instead of an instance.
        ValueError: `steps` or `batch_size` is less than 1, or the curriculum leaves the range from 0 to 1.

    Example:
        >>> import dvae
        >>> stages = [dvae.Stage(500, dvae.Evidence(kl_weight=0.1)), dvae.Stage(1500, frozen=("generator.z.",))]
    """

    steps: int
    objective: Objective = field(default_factory=Evidence)
    learning_rate: float | Schedule | None = None
    scheduled_sampling: float | Schedule | None = None
    curriculum: float | Schedule | None = None
    frozen: tuple[str, ...] = ()
    batch_size: int | None = None

    def __post_init__(self) -> None:
        if isinstance(self.objective, type):
            raise TypeError(f"objective must be an instance such as dvae.Evidence(), got {kind_of(self.objective)}")
        if self.steps < 1:
            raise ValueError(f"a stage needs at least 1 step, got {self.steps}")
        if self.batch_size is not None and self.batch_size < 1:
            raise ValueError(f"the batch_size of a stage must be at least 1, got {self.batch_size}")
        for value in () if self.curriculum is None else levels(self.curriculum):
            if value not in Range(0, 1):
                raise ValueError(f"the curriculum of a stage must be between 0 and 1, got {value}")


def plan_stages(
    options: Mapping[str, Any], objective: Objective | None, stages: Sequence[Stage]
) -> tuple[Training, list[Stage]]:
    """Return the training options and the stages, with schedules that end within the run.

    Raises:
        TypeError: when `Training` has no such option.
        ValueError: when both an objective and stages are given, or `steps` differs from the total of the stages.
    """
    names = [option.name for option in fields(Training)]
    for name in options:
        if name not in names:
            raise TypeError(f"fit has no option {name!r}{nearest(name, names)}; the options are {', '.join(names)}")
    training = Training(**options)
    if not stages:
        stages = [Stage(training.steps, Evidence() if objective is None else objective)]
    elif objective is not None:
        raise ValueError("pass either objective or stages, because each stage has its own objective")
    total = sum(stage.steps for stage in stages)
    if "steps" in options and training.steps != total:
        raise ValueError(f"steps is {training.steps}, but the stages take {total} steps; remove steps")
    plan: list[Stage] = []
    end = last = total
    for stage, following in zip(reversed(stages), [None, *reversed(stages[1:])], strict=True):
        # schedules continue into a next stage that differs only in length and frozen parameters
        if following is None or replace(following, steps=stage.steps, frozen=stage.frozen) != stage:
            last = end
        plan.insert(0, clamp(stage, last))
        end -= stage.steps
    return clamp(replace(training, steps=total), total), plan


def stage_at(plan: Sequence[Stage], step: int) -> tuple[int, Stage]:
    """Return the first step and the stage of a global step; the last stage after the last step."""
    first = 0
    for stage in plan[:-1]:
        if step < first + stage.steps:
            return first, stage
        first += stage.steps
    return first, plan[-1]


def recorded(training: Training, plan: Sequence[Stage]) -> dict[str, Any]:
    """Return the options and the stages as JSON types."""

    def config(stage: Stage) -> dict[str, Any]:
        objective = stage.objective
        description = getattr(objective, "to_config", objective.__repr__)()
        return to_config(vars(stage) | {"objective": description})

    return {"training": to_config(vars(training)), "stages": [config(stage) for stage in plan]}
