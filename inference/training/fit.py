"""The training loop of every method: batches, validations, checkpoints and a log.

`fit` uses the steps of `SVI`; no other code changes the weights. A checkpoint contains everything that a step depends
on. On a CPU, a resumed run therefore repeats the uninterrupted run bit for bit.
"""

import os
import signal
import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from ...data.batch import WHOLE
from ...data.schema import Schema
from ...data.sequences import Batched, Fingerprinted, Source, as_batches, as_source, has_splits, take_split
from ...distributions.family import FamilyModule
from ...distributions.product import ProductModule
from ...locking import seeded
from ...program.batch import check_scale
from ...program.conditional import like
from ...program.model import DynamicalVAE
from ...program.rollout import ScheduledSampling
from ..evaluation.result import literal_text, styled
from . import processes
from .checkpoints import CONFIG, CheckpointError, Run
from .forecast_score import NAME, observed_steps
from .last_value import last_value_bound
from .objectives import Objective
from .options import Stage, Training, recorded
from .recipe import Recipe, Trainable, run_config
from .resuming import mark_failure, restore, store
from .signals import Signals
from .svi import SVI, State
from .trackers import InMemory, JSONLines, Terminal, Tracker

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Callback:
    """Hooks of `fit`. Subclass it and define those you need; a returned dict of numbers becomes a row of the log."""

    def on_step(self, state: State) -> Mapping[str, float] | None:
        """Run after each step; `state.terms` contains the terms of its batch."""
        return None

    def on_validation(self, state: State) -> Mapping[str, float] | None:
        """Run after each validation; `state.row` contains its numbers."""
        return None

    def on_end(self, state: State) -> Mapping[str, float] | None:
        """Run once after the last step, even after an interruption, before the best weights are restored."""
        return None


@dataclass(frozen=True)
class Fit:
    """Result of a run.

    Args:
        history: rows of the log, in nats per step (see `trackers`).
        step: last step.
        best_step: step of the best validation score (`Training.select`); None without validation data.
        best_bound: best validation bound, in nats per step. With scheduled sampling, it is the bound of the model that
            reads its own output. For a model without a likelihood, or an objective that selects by "loss", it is minus
            the validation loss; with select="forecast", minus the CRPS.
        status: "finished", "stopped early" or "interrupted".
        run: run directory, or None.
        per: unit that bounds are divided by: a step, unless the model's `per` names another.
        model: fitted model with the best weights; None if only the log of a run was read.
        processor_seconds: processor time of all threads of the first process, including validation and checkpoints, in
            seconds; for a resumed run, the total over all its parts.
        last_value: bound of a forecast that repeats the last value, on the validation windows (see `last_value`), for
            comparison with `best_bound`. None if the windows have no horizon, or the model's likelihood is not of the
            original data.

    Example:
        >>> model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2})
        >>> result = dvae.fit(model, torch.randn(6, 4, 2), steps=3, log_every=1, progress=False)
        >>> result.status, result.series("bound")[0]
        ('finished', [1, 2, 3])
    """

    history: list[dict[str, Any]] = field(repr=False)
    step: int
    best_step: int | None
    best_bound: float | None
    status: str
    run: Path | None
    per: str = "step"
    model: Any = field(default=None, repr=False)
    processor_seconds: float = 0.0
    last_value: float | None = None

    @property
    def best(self) -> str:
        """Best value and its step as text, with advice if repeating the last value is better; "" without validation."""
        if self.best_bound is None:
            return ""
        if any(f"validation/{NAME}" in row for row in self.history):
            return f"lowest validation {NAME} {-self.best_bound:.4f} at step {self.best_step}"
        if any("validation/loss" in row for row in self.history):
            return f"lowest validation loss {-self.best_bound:.4f} at step {self.best_step}"
        scheduled = any("validation/scheduled_sampling/bound" in row for row in self.history)
        name = "best bound with scheduled sampling" if scheduled else "best bound"
        best = f"{name} {self.best_bound:.3f} nats a {self.per} at training step {self.best_step}"
        if self.last_value is None or self.best_bound >= self.last_value:
            return best
        advice, model = ["train for more steps"], self.model
        if isinstance(model, DynamicalVAE) and _reads_past_data(model):
            heads = [model.generator[name].head for name in model.observed]
            joint = any(model.generator[name].joint for name in model.observed)
            if not joint and not any(head.residual or isinstance(head, FamilyModule | ProductModule) for head in heads):
                advice.append("try residual=1, which adds the output to the last value")
            if not (joint or scheduled):
                advice.append("try scheduled_sampling=1, which trains on the model's own output")
        return f"{best}, worse than repeating the last value ({self.last_value:.3f}): {', or '.join(advice)}"

    def series(self, name: str) -> tuple[list[int], list[float]]:
        """Return the steps and values of one number of the log, such as "kl/z" or "validation/bound".

        Args:
            name: key of the rows of `history`.
        """
        rows = [row for row in self.history if name in row]
        return [row["step"] for row in rows], [row[name] for row in rows]

    @styled
    def plot(self) -> "Figure":
        """Draw the learning curves: the bound, and the KL of each latent, in nats per step.

        For a model without a likelihood, draw the loss and its energies, per step.

        Returns:
            A matplotlib figure.
        """
        from matplotlib import pyplot as plt

        from ..evaluation.picture import Picture

        names = sorted({name for row in self.history for name in row})
        likelihood = any(name.startswith("log_likelihood/") for name in names)
        score, start = ("bound", "kl/") if likelihood else ("loss", "energy/")
        unit = f"nats per {self.per}" if likelihood else f"per {self.per}"
        figure = plt.figure(figsize=(7, 2.5), layout="constrained", FigureClass=Picture)
        score_panel, term_panel = figure.subplots(1, 2)
        score_panel.plot(*self.series(score), color="0.7", label="training batch")
        if self.best_step is not None:
            score_panel.plot(*self.series(f"validation/{score}"), marker=".", label="validation")
            score_panel.axvline(self.best_step, color="0.3", linestyle=":", label=f"best: step {self.best_step}")
        score_panel.set(xlabel="step", ylabel=f"{score} ({unit})")
        score_panel.legend()
        for name in names:
            if name.startswith(start):
                term_panel.plot(*self.series(name), label=name.removeprefix(start))
                literal_text(term_panel.legend().get_texts())
        term_panel.set(xlabel="step", ylabel=f"KL ({unit})" if likelihood else f"energies ({unit})")
        if not likelihood:
            term_panel.set_yscale("log")  # scales of energies differ by orders of magnitude, which weights compensate
        return figure


def _reads_past_data(model: DynamicalVAE) -> bool:
    """Return whether a data variable is generated from data of earlier steps."""
    parents = {parent.name for name in model.observed for parent in model.generative.factor(name).parents}
    return bool(parents.intersection(model.observed))


class Interrupted(KeyboardInterrupt):
    """Error of a run that Ctrl-C or SIGTERM stopped, after a complete step and a checkpoint.

    Args:
        fit: result of the run.
        signal: number of the signal; a command line exits with 128 + signal.
    """

    def __init__(self, fit: Fit, signal: int) -> None:
        advice = (
            f"resume with fit(…, out={str(fit.run)!r}, resume=True)"
            if fit.run
            else "it cannot be resumed; pass out=… to store a run"
        )
        super().__init__(f"interrupted after step {fit.step}; {advice}")
        self.fit = fit
        self.signal = signal


@torch.inference_mode(False)  # also enables gradients
def fit(
    model: nn.Module | Trainable,
    data: Any,
    validation: Any = None,
    *,
    objective: Objective | None = None,
    stages: Sequence[Stage] = (),
    out: str | os.PathLike[str] | None = None,
    resume: bool = False,
    config: Mapping[str, Any] | None = None,
    trackers: Sequence[Tracker] = (),
    callbacks: Sequence[Callback] = (),
    **options: Any,
) -> Fit:
    """Fit a model and its guide, or build and fit a method.

    Afterwards the model is in evaluation mode. It has the weights of the best unweighted validation bound, or of the
    best forecasts (`Training.select`), or the last weights without validation data. The caller's random state is
    restored. Threads share Pyro's handlers and torch's random state, so another fit or forecast waits for the end of
    the current step.

    Args:
        model: a `DynamicalVAE`, or any module that `SequenceELBO` accepts; or a method, such as `dvae.method("srnn")`.
            The model of a method is built for the data and trained by its recipe, with the method's own defaults of
            `Training`.
        data: x as a tensor (N, T, D), a batch of N sequences, an object with `sample(batch_size, generator)`, or data
            with parts, such as `dvae.tables.PanelData`, whose validation windows are used too; or a `Recipe`, which
            includes its data.
        validation: x as a tensor, a batch, an object whose `all()` returns a batch, or one whose `batches(size)` yields
            batches in order.
        objective: objective to minimise; `Evidence()` by default.
        stages: consecutive stages with their own objectives, instead of `objective`, for all steps of the run.
        out: run directory for checkpoints and `log.jsonl` (see `checkpoints`). If a method is fitted to data that can
            be opened again, `dvae.load` and the command `dvae resume` read the run.
        resume: whether to continue the run in `out` from its last checkpoint up to `steps`.
        config: description of the run in JSON types, for `config.json`; training options are added to it. If None, a
            resumed run keeps its stored description.
        trackers: additional trackers, which receive each row of the log.
        callbacks: hooks after steps, after validations and at the end.
        **options: fields of `Training`, such as steps=2000, batch_size=32, learning_rate=1e-3. For a method, the seed
            also determines its initial weights.

    Returns:
        The history, the best bound and its step, and the `model`.

    Raises:
        NonFiniteError: when a loss or gradient is NaN or infinite, naming step, site and term; the last checkpoint
            stays.
        Interrupted: after Ctrl-C or SIGTERM; the step is complete and the checkpoint written.
        CheckpointError: when `out` contains a run and `resume` is False, or a run that cannot be resumed, such as one
            fitted on training or validation data with another `fingerprint`.
        TypeError: when the model or the data are of another kind, such as a table, whose columns need roles.
        ValueError: when the first batch varies by less than float32 resolves, an option is set by the method or recipe
            itself, or a part of the data has no windows.
        LostProcess: when another process of the run has ended or does not answer; the last checkpoint stays.

    Example:
        >>> import torch, dvae
        >>> model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)", {"z": 2, "x": 3})
        >>> warm_up = dvae.Evidence(kl_weight=dvae.schedules.Ramp(0.0, 1.0, steps=10))
        >>> x = torch.randn(32, 10, 3)
        >>> result = dvae.fit(model, x[:24], validation=x[24:], objective=warm_up, steps=20, progress=False)
        >>> result.status, result.best_step
        ('finished', 20)
    """
    loop_options: dict[str, Any] = {"out": out, "resume": resume, "config": config, "trackers": trackers}
    loop_options["callbacks"] = callbacks
    if not isinstance(model, Trainable) and not isinstance(data, Recipe):
        return _fit(model, data, validation, objective=objective, stages=stages, **loop_options, **options)
    if objective is not None or stages:
        raise ValueError("a method or a recipe has its own objective; remove objective and stages")
    if not isinstance(model, Trainable):
        if validation is not None:
            raise ValueError("a recipe has its own validation data; remove validation")
        return _fit(model, data.batches, data.validation, **_prepare_options(data, model, loop_options | options))
    if resume:
        run = os.fspath(out or "RUN")
        raise ValueError(f"fit cannot resume the run of a method; use the command `dvae resume {run}`")
    if validation is None and has_splits(data):
        validation = data
    train = as_source(take_split(data, "train"))
    schema = Schema.of(data if has_splits(data) else train)
    if too_short := getattr(train, "too_short", ""):
        warnings.warn(f"training leaves out {too_short}", stacklevel=4)
    names = Training.__dataclass_fields__.keys() & options
    defaults = model.training(schema)
    if validation is None:
        defaults = replace(defaults, select="bound", patience=None)  # both need validation data
    training = replace(defaults, **{name: options.pop(name) for name in names})
    method = model.resolve_defaults(train)
    if out is not None and config is None and hasattr(data, "recorded"):
        loop_options["config"] = run_config(method, schema, data.kind, data.recorded())
    recipe = method.train(train, take_split(validation, "validation"), training.steps)
    options = vars(training) | options
    with seeded(training.seed):
        module = method.build(schema)
        fit_options = _prepare_options(recipe, module, loop_options | options)
    return _fit(module, recipe.batches, recipe.validation, **fit_options)


def _prepare_options(recipe: Recipe, model: nn.Module, options: Mapping[str, Any]) -> dict[str, Any]:
    """Prepare a model for a recipe, unless a run is resumed, and return the options of its fit."""
    steps = sum(stage.steps for stage in recipe.stages)
    if options.get("steps", steps) != steps:
        raise ValueError(
            f"steps is {options['steps']}, but this recipe has {steps} steps; create the recipe with other steps"
        )
    if options.get("scheduled_sampling", 0.0) != 0.0:
        raise ValueError(
            f"scheduled_sampling={options['scheduled_sampling']} conflicts with the recipe, which sets it; pass it to "
            "the method: dvae.method(…, scheduled_sampling=…)"
        )
    if not options["resume"]:
        run_directory(options["out"], False, {})  # refuses an invalid directory before a long preparation
        with seeded(None):
            recipe.prepare(model)
    recipe_options = {"steps": steps, "scheduled_sampling": recipe.feeding, "stages": recipe.stages, "objective": None}
    return {**options, **recipe_options}


CPU_LIMIT = Path("/sys/fs/cgroup/cpu.max")
"""Where Linux states how many cores a container may use."""


def _thread_advice() -> str:
    """Return a warning if torch has more threads than free cores, which makes small networks many times slower."""
    threads, cores = torch.get_num_threads(), os.cpu_count() or 1
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    with suppress(OSError, ValueError):  # a container's limit: "max 100000" or "200000 100000"
        quota, period = CPU_LIMIT.read_text(encoding="ascii").split()
        cores = min(cores, max(round(int(quota) / int(period)), 1))
    busy = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    if threads == 1 or (threads <= cores and busy <= 1.25 * cores):  # a fit before this one counts as busy, too
        return ""
    return (
        f"torch uses {threads} threads on {cores} cores, where {busy:.1f} threads run; training can be many times "
        "slower than on one thread; set OMP_NUM_THREADS=1 or call torch.set_num_threads(1)"
    )


def _fit(
    model: nn.Module,
    train: Any,
    validation: Any,
    *,
    objective: Objective | None,
    stages: Sequence[Stage],
    out: str | os.PathLike[str] | None,
    resume: bool,
    config: Mapping[str, Any] | None,
    trackers: Sequence[Tracker],
    callbacks: Sequence[Callback],
    **options: Any,
) -> Fit:
    """Run the loop for `fit`."""
    svi = SVI(model, objective, stages, **options)
    training = svi.training
    if validation is None and has_splits(train):
        validation = train
    train = take_split(train, "train")
    source = as_source(train)
    windows = None if validation is None else take_split(validation, "validation")
    held_out = None if windows is None else as_batches(windows)
    if training.patience is not None and held_out is None:
        raise ValueError("patience counts validations; pass validation data, or remove patience")
    observed = None if windows is None else _observed(model, windows)
    if training.select == "forecast":
        observed_steps(model, windows)  # raises now rather than at the first validation
        held_out, observed = windows, None
    # Hashing all data takes time, and only stored runs need it.
    parts = {} if out is None else {"training_data": train, "validation_data": windows}
    prints = {name: part.fingerprint for name, part in parts.items() if isinstance(part, Fingerprinted)}
    record = {name: fingerprint for name, fingerprint in prints.items() if isinstance(fingerprint, str)}
    run = run_directory(out, resume, record)
    if run is not None and resume and held_out is None and run.state["best_step"] is not None:
        raise CheckpointError(
            f"{run.path} selects its weights on validation data; pass these data to resume it, or start a new run in "
            "another directory"
        )
    record |= recorded(training, svi.plan)
    with ExitStack() as stack:
        stack.callback(model.eval)
        state, first = svi.init(), svi.fabric.is_global_zero
        if svi.fabric.device.type == "cpu" and (advice := _thread_advice()):
            warnings.warn(advice, stacklevel=3)
        if run is not None and first:
            stack.enter_context(run.locked())
            run_directory(out, resume, {})  # another process may have written a run since the first check
        processes.wait(svi.fabric)  # every process must look for an earlier run before the first one writes
        if run is not None and resume:
            restore(svi, run)
            processes.wait(svi.fabric)  # every process must read the checkpoint before the first one writes
        history, receivers = InMemory(), list[Tracker]()
        if first:
            if run is not None:
                run.write_config((run.config if resume and config is None else dict(config or {})) | record)
                log = JSONLines(run.path / "log.jsonl")
                history = InMemory(log.read() if resume else [])
                receivers = [log]
            receivers += [history, *trackers, *([Terminal(training.steps)] if training.progress else [])]
        for tracker in receivers:
            tracker.start(state.step)
            stack.callback(tracker.close)
        if run is not None:
            stack.enter_context(mark_failure(svi, run))
        signals = stack.enter_context(Signals())
        before, state.status = state.status, _status(state, training)
        if run is not None and (not resume or state.status not in ("running", before)):
            store(svi, run)  # even if the run was interrupted at its last step
        _train(svi, source, held_out, observed, run, receivers, callbacks, signals)
        processes.wait(svi.fabric)  # the caller may read the files of the first process
        if state.best is not None:
            model.load_state_dict(state.best)
    path = run.path if run else None
    outcome = state.step, state.best_step, state.best_bound, state.status
    result = Fit(history.rows, *outcome, path, state.per, model, state.processor_seconds, state.last_value)
    if state.status == "interrupted":
        raise Interrupted(result, signals.received or signal.SIGINT)
    return result


def _observed(model: nn.Module, validation: Any) -> int | None:
    """Return the number of observed steps of validation windows with a horizon.

    Return None without a horizon, or if the model's bound is not of the original data.
    """
    if not isinstance(model, DynamicalVAE) or not model.likelihood or model.view.measured:
        return None
    if WHOLE not in (*model.observed, *model.view.names):
        return None
    return getattr(getattr(validation, "protocol", None), "observed", None)


def run_directory(out: str | os.PathLike[str] | None, resume: bool, record: Mapping[str, Any]) -> Run | None:
    """Return the run directory, after checking that `fit` overwrites no run and resumes one on the same data.

    Args:
        out: path of the directory; None for no directory.
        resume: whether to continue the run in the directory.
        record: description of the run, for `config.json`, with the fingerprints of its data.

    Raises:
        CheckpointError: when `out` contains a run although `resume` is False, no run although it is True, or a run on
            other data.
    """
    run = None if out is None else Run(out)
    if resume and (run is None or not run.exists):
        raise CheckpointError(f"no run to resume in {out}; pass its directory as out=…, or remove resume=True")
    if run is None or not run.exists:
        return run
    if not resume:
        lower = " and a lower learning_rate, because it failed" if run.state["status"] == "failed" else ""
        raise CheckpointError(
            f"{out} already holds a run; continue it with resume=True{lower}, or choose another directory"
        )
    for name in ("training_data", "validation_data"):
        before, now = run.config.get(name), record.get(name)
        if before is not None and now is not None and before != now:
            raise CheckpointError(
                f"{run.path} was fitted on other {name.replace('_', ' ')}: {CONFIG} has the fingerprint "
                f"{str(before)[:12]}…, these data have {now[:12]}…; resume with the same data, or start a new run in "
                "another directory"
            )
    return run


def _train(
    svi: SVI,
    source: Source,
    held_out: Batched | None,
    observed: int | None,
    run: Run | None,
    receivers: Sequence[Tracker],
    callbacks: Sequence[Callback],
    signals: Signals,
) -> None:
    """Run steps, log rows, validate and write checkpoints until the run ends."""
    state, training = svi.state, svi.training

    def log(row: Mapping[str, float]) -> None:
        for tracker in receivers:
            tracker.log(state.step, row)

    def report(row: dict[str, float]) -> None:
        state.row = row
        log(row)

    def call(hook: str) -> None:
        try:
            for callback in callbacks:
                if row := getattr(callback, hook)(state):
                    log(row)
        except KeyboardInterrupt:  # the step is complete, so the run can stop here
            signals.received = signal.SIGINT

    def is_stop_requested() -> bool:
        """Return whether a signal has reached any process, and share a callback's `stop` among all processes."""
        flags = torch.tensor([bool(signals.received), state.stop]).int()
        stopped, state.stop = (svi.total(flags) > 0).tolist()
        return bool(stopped)

    start = time.process_time() - state.processor_seconds
    model: Any = svi.model
    unchecked = isinstance(model, DynamicalVAE) and like(model).dtype is not torch.float64
    stop = False
    while state.status == "running":
        batch = source.sample(svi.batch_size, svi.generator)
        if unchecked:  # only once, as the check synchronises with the device
            check_scale(batch, {WHOLE, *model.observed})
            unchecked = False
        svi.flags = bool(signals.received), stop
        svi.step(batch)
        if state.step % training.log_every == 0 or state.step == training.steps:
            report(svi.row())
        call("on_step")
        stopped, stop = bool(signals.received), state.stop
        if svi.fabric.world_size > 1:  # the gradients have brought the flags that all processes had before the step
            stopped, state.stop = svi.any_flags
        due = state.step % training.validate_every == 0 or state.step == training.steps or state.stop
        if due and held_out is not None:
            report(svi.validate(held_out))
            if observed is not None and state.last_value is None and "validation/loss" not in state.row:
                scheduled = bool(svi.final_feeding) and isinstance(model.feeding, ScheduledSampling)
                state.last_value = last_value_bound(
                    model, source, held_out, observed, fed=scheduled, batch_size=training.batch_size
                )
            call("on_validation")
            stopped = is_stop_requested()
        state.status = "interrupted" if stopped else _status(state, training)
        state.processor_seconds = time.process_time() - start
        if run is not None and (due or state.status != "running"):
            store(svi, run)
    call("on_end")


def _status(state: State, training: Training) -> str:
    """Return "finished", "stopped early" or "running"."""
    if state.step >= training.steps:
        return "finished"
    impatient = training.patience is not None and state.waited >= training.patience
    return "stopped early" if state.stop or impatient else "running"
