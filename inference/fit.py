"""The shared loop: stochastic variational inference (Hoffman et al. 2013, arXiv 1206.7051) for every method.

`fit` draws a batch, asks the bound for its terms and the objective for a number, and takes a step of a torch
optimiser. lightning-fabric runs the same code on a CPU, a GPU, in bfloat16, or in several processes. Whatever
varies over time is a schedule of the global step, and every random number comes from generators that a
checkpoint stores: a resumed run repeats, bit for bit on a CPU, what the uninterrupted run would have done.
"""

import io
import math
import os
import re
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol

import torch
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

from ..options import Amount, Count, Range, Share, check, nearest
from ..turns import alone
from .batches import Batch, Sequences, Source, each, sequences
from .bounds import SequenceELBO, Terms
from .checkpoints import (
    BEST,
    CONFIG,
    LAST,
    OPTIMISER,
    CheckpointError,
    Run,
    read_weights,
    state_bytes,
    weights,
)
from .objectives import Evidence, Objective
from .result import as_they_are
from .schedules import Piecewise, Schedule, clamp, levels, schedule, to_config
from .trackers import JSONLines, Memory, Terminal, Tracker

if TYPE_CHECKING:
    from lightning_fabric import Fabric
    from matplotlib.figure import Figure

# each of them can be fused
OPTIMISERS = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW, "sgd": torch.optim.SGD}


@dataclass(frozen=True)
class Training:
    """Options of `fit`.

    Args:
        steps: optimiser steps in all.
        batch_size: sequences in a batch, in each process.
        learning_rate: a number or a schedule.
        decay: last share of the run over which a learning rate that is a number falls linearly to 0; a resumed run
            with more steps falls later.
        optimizer: "adam", "adamw" or "sgd".
        weight_decay: the optimiser's weight decay.
        gradient_clip: largest norm of the gradient of the loss (nats per frame); None for no limit.
        self_feeding: probability that a frame of x's history is replaced by the program's own mean (scheduled
            sampling, Bengio et al. 2015, arXiv 1506.03099); a number or a schedule. The best weights are then
            by the self-fed bound, from when the schedule has reached its last value.
        particles: draws from the guide for each sequence and step.
        validate_every: steps from one validation and checkpoint to the next.
        patience: validations without a better bound after which the run stops; None to run all steps.
        log_every: steps from one row of the log to the next.
        seed: seed of batches and latent draws; each process adds its rank.
        accelerator: where to run: "auto", "cpu", "gpu", "cuda" or "mps".
        devices: number of devices, with one process each.
        precision: precision of the computation; "32-true" leaves the model's own.
        progress: whether to show the terms on the terminal.

    Raises:
        ValueError: when an option is out of range.
    """

    steps: Count = 2000
    batch_size: Annotated[int, Range(1, 16384)] = 32
    learning_rate: Amount | Schedule = 1e-3
    decay: Share = 0.0
    optimizer: Literal["adam", "adamw", "sgd"] = "adam"
    weight_decay: Amount = 0.0
    gradient_clip: Annotated[float, Range(0, above=True)] | None = 10.0
    self_feeding: Share | Schedule = 0.0
    particles: Annotated[int, Range(1, 4096)] = 1
    validate_every: Count = 100
    patience: Count | None = None
    log_every: Count = 10
    seed: int = 0
    accelerator: Literal["auto", "cpu", "gpu", "cuda", "mps"] = "auto"
    devices: Annotated[int, Range(1, 32)] = 1
    precision: Literal["32-true", "64-true", "bf16-mixed", "bf16-true"] = "32-true"
    progress: bool = True

    def __post_init__(self) -> None:
        if self.gradient_clip == math.inf:
            object.__setattr__(self, "gradient_clip", None)
        check(self)
        for name, allowed in (("learning_rate", Range(0)), ("self_feeding", Range(0, 1))):
            for value in levels(getattr(self, name)):
                if value not in allowed:
                    raise ValueError(f"{name} is {value}; it must be {allowed}")
        if self.decay and isinstance(self.learning_rate, Schedule):
            raise ValueError(
                "decay is for a learning rate that is a number; a schedule falls by itself, so leave decay 0"
            )

    @property
    def rate(self) -> Schedule:
        """The learning rate with its decay laid out over `steps`."""
        rate = schedule(self.learning_rate)
        if not self.decay:
            return rate
        return Piecewise(((0, rate(0)), (round((1 - self.decay) * self.steps), rate(0)), (self.steps, 0.0)))


@dataclass(frozen=True)
class Stage:
    """A part of a run with its own objective, for training in phases. Schedules still see the global step.

    Args:
        steps: length of the stage.
        objective: what it minimises.
        learning_rate: that of `Training` if None.
        self_feeding: that of `Training` if None.
        frozen: parameters whose names start with one of these stay as they are.
    """

    steps: int
    objective: Objective = field(default_factory=Evidence)
    learning_rate: float | Schedule | None = None
    self_feeding: float | Schedule | None = None
    frozen: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"a stage has {self.steps} steps; it needs at least 1")


@dataclass
class State:
    """Where a run stands. Callbacks read it, and set `stop` to end the run after the step."""

    model: nn.Module
    step: int = 0
    terms: Terms | None = None
    row: dict[str, float] = field(default_factory=dict)
    best_step: int | None = None
    best_bound: float | None = None
    waited: int = 0
    status: str = "running"
    stop: bool = False


class Callback(Protocol):
    """Hooks of the loop. Subclass it and define those you need."""

    def on_step(self, state: State) -> None:
        """Run after each step; `state.terms` holds the terms of its batch."""

    def on_validation(self, state: State) -> None:
        """Run after each validation; `state.row` holds its numbers."""

    def on_end(self, state: State) -> None:
        """Run once after the last step, also of an interrupted run, before the best weights are put back."""


@dataclass(frozen=True)
class Fit:
    """What a run leaves.

    Args:
        history: the rows of the log, in nats per frame (see `trackers`).
        step: the last step.
        best_step: the step of the best unweighted validation bound; None without validation data.
        best_bound: that bound, in nats per frame; of the self-fed program in a run with self-feeding. A model without a
            likelihood has no bound: minus its objective stands here.
        status: "finished", "stopped early" or "interrupted".
        run: the run directory, if there is one.
        per: what bounds are per: a frame, unless the model has another word in `per`.
    """

    history: list[dict[str, Any]]
    step: int
    best_step: int | None
    best_bound: float | None
    status: str
    run: Path | None
    per: str = "frame"

    @property
    def best(self) -> str:
        """What is best, where, in words; empty without validation data."""
        if self.best_bound is None:
            return ""
        if any("validation/loss" in row for row in self.history):
            return f"lowest validation loss {-self.best_bound:.4f} at step {self.best_step}"
        return f"best bound {self.best_bound:.3f} nats a {self.per} at step {self.best_step}"

    def series(self, name: str) -> tuple[list[int], list[float]]:
        """Return the steps and values of one number of the log, such as "kl/z" or "validation/bound"."""
        rows = [row for row in self.history if name in row]
        return [row["step"] for row in rows], [row[name] for row in rows]

    def plot(self) -> "Figure":
        """Draw the learning curves: the bound, and the KL of each latent, in nats per frame.

        Of a model without a likelihood, the loss and its energies, per frame.
        """
        from matplotlib import pyplot as plt

        names = sorted({name for row in self.history for name in row})
        likelihood = any(name.startswith("log_likelihood/") for name in names)
        score, start = ("bound", "kl/") if likelihood else ("loss", "energy/")
        unit = f"nats per {self.per}" if likelihood else f"per {self.per}"
        figure, (whole, terms) = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
        whole.plot(*self.series(score), color="0.7", label="training batch")
        if self.best_step is not None:
            whole.plot(*self.series(f"validation/{score}"), marker=".", label="validation")
            whole.axvline(self.best_step, color="0.3", linestyle=":", label=f"best: step {self.best_step}")
        whole.set(xlabel="step", ylabel=f"{score} ({unit})")
        whole.legend()
        for name in names:
            if name.startswith(start):
                terms.plot(*self.series(name), label=name.removeprefix(start))
                as_they_are(terms.legend().get_texts())
        terms.set(xlabel="step", ylabel="KL (nats per frame)" if likelihood else "energies (per frame)")
        if not likelihood:
            terms.set_yscale("log")  # their scales differ by orders of magnitude; weights make up for it
        return figure


def reason(error: BaseException) -> str:
    """What an error says, without the table of shapes that Pyro appends where it passes a program."""
    return re.split(r"\n\s*Trace Shapes:", str(error))[0]


class NonFiniteError(FloatingPointError):
    """A loss or its gradient is NaN or infinite; the step was not taken."""


class Interrupted(KeyboardInterrupt):
    """The run was stopped by Ctrl-C or SIGTERM, after a whole step and a checkpoint.

    Args:
        fit: what the run leaves.
        signal: number of the signal; a command line exits with 128 + signal.
    """

    def __init__(self, fit: Fit, signal: int) -> None:
        how = (
            f"resume with fit(…, out={str(fit.run)!r}, resume=True)"
            if fit.run
            else "without out=… it cannot be resumed"
        )
        super().__init__(f"interrupted after step {fit.step}; {how}")
        self.fit = fit
        self.signal = signal


@alone
def fit(
    model: nn.Module,
    train: Any,
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
    """Fit a model and its guide.

    Afterwards the model is in evaluation mode and holds the weights of the best unweighted validation bound,
    or without validation data the last ones. The caller's random state is left as it was. Threads take turns, as Pyro's
    handlers and torch's random state are the process's: another fit or forecast waits until this one is done.

    Args:
        model: a `DynamicalVAE`, or any module that `SequenceELBO` takes.
        train: x as a tensor (N, T, D), a batch of N sequences, or an object with `sample(batch_size,
            generator)`.
        validation: x as a tensor, a batch, or an object whose `all()` returns a batch.
        objective: what to minimise; `Evidence()` by default.
        stages: objectives one after the other, in place of `objective`; their steps are those of the run.
        out: run directory for checkpoints and `log.jsonl` (see `checkpoints`).
        resume: continue the run in `out` from its last checkpoint up to `steps`.
        config: what is run, in JSON's types, for `config.json`; the training options are added to it.
        trackers: further receivers of the log's rows.
        callbacks: hooks after steps, after validations and at the end.
        **options: fields of `Training`, such as steps=2000, batch_size=32, learning_rate=1e-3.

    Returns:
        The history, and the best bound and its step.

    Raises:
        NonFiniteError: when a loss or gradient is NaN or infinite, naming step, site and term; the last
            checkpoint stays.
        Interrupted: after Ctrl-C or SIGTERM; the step is complete, the checkpoint written.
        CheckpointError: when `out` holds a run and `resume` is False, or a run that cannot be resumed, such as one
            fitted on training data with another `fingerprint`.

    Example:
        warm_up = Evidence(kl_weight=Linear(0.0, 1.0, steps=500))
        result = fit(model, x, validation=y, objective=warm_up, steps=2000, out="runs/first")
    """
    training, plan = _plan(options, objective, stages)
    source = train if isinstance(train, Source) else sequences(train)
    held_out = None if validation is None else sequences(validation)
    if training.patience is not None and held_out is None:
        raise ValueError("patience counts validations; give validation data, or leave patience out")
    run = None if out is None else Run(out)
    if resume and (run is None or not run.exists):
        raise CheckpointError(
            f"there is no run to resume in {out}; give its directory as out=…, or leave out resume=True"
        )
    if run is not None and run.exists and not resume:
        raise CheckpointError(f"{out} already holds a run; continue it with resume=True, or choose another directory")
    record = {} if run is None else _record(training, plan, train)
    if resume and run is not None:
        _same_data(run, record)

    from lightning_fabric import Fabric  # over a second to import, half of what `import dvae` would take

    fabric = Fabric(accelerator=training.accelerator, devices=training.devices, precision=training.precision)
    fabric.launch()
    with ExitStack() as stack:
        stack.enter_context(_forked_random_state(fabric.device))
        stack.callback(model.eval)
        if run is not None and fabric.is_global_zero:
            stack.enter_context(run.locked())
        loop = _Loop(fabric, model, training, plan, run)
        state = loop.state
        fabric.barrier()  # every process has looked for an earlier run before the first one writes
        if resume:
            loop.restore()
            fabric.barrier()  # every process has read the checkpoint before the first one writes
        memory, receivers = Memory(), list[Tracker]()
        if fabric.is_global_zero:
            if run is not None:
                run.write_config((run.config if resume else {}) | record | dict(config or {}))
                log = JSONLines(run.path / "log.jsonl")
                memory = Memory(log.read() if resume else [])
                receivers = [log]
            receivers += [memory, *trackers, *([Terminal(training.steps)] if training.progress else [])]
        for tracker in receivers:
            tracker.start(state.step)
            stack.callback(tracker.close)
        signals = stack.enter_context(_Signals())

        def report(row: dict[str, float]) -> None:
            state.row = row
            for tracker in receivers:
                tracker.log(state.step, row)

        def call(hook: str) -> None:
            try:
                for callback in callbacks:
                    getattr(callback, hook)(state)
            except KeyboardInterrupt:  # the step is complete, so this is as good a place to stop as any
                signals.received = signal.SIGINT

        recorded, state.status = state.status, loop.status()
        if not resume or state.status not in ("running", recorded):  # a run may be interrupted at its last step
            loop.save()
        while state.status == "running":
            loop.step(source)
            if state.step % training.log_every == 0 or state.step == training.steps:
                report(loop.row())
            call("on_step")
            due = state.step % training.validate_every == 0 or state.step == training.steps or state.stop
            if due and held_out is not None:
                report(loop.validate(held_out))
                call("on_validation")
            state.status = "interrupted" if loop.any_process(signals.received) else loop.status()
            if due or state.status != "running":
                loop.save()
        call("on_end")
        if loop.best is not None:
            model.load_state_dict(loop.best)
    path, per = run.path if run else None, getattr(model, "per", Fit.per)
    result = Fit(memory.rows, state.step, state.best_step, state.best_bound, state.status, path, per)
    if state.status == "interrupted":
        raise Interrupted(result, signals.received or signal.SIGINT)
    return result


class _Bound(nn.Module):
    """The bound's terms as the output of a module, which is what synchronises gradients between processes.

    Pyro's `ELBOModule` does the same for a single number; objectives need the terms.
    """

    def __init__(self, model: nn.Module, estimator: SequenceELBO) -> None:
        super().__init__()
        self.model = model
        self.estimator = estimator

    def forward(self, batch: Batch, program: Mapping[str, Any]) -> dict[str, Any]:
        return dict(vars(self.estimator.terms(self.model, batch, **program)))


class _Loop:
    """The engine and its state: takes steps, validates, saves and restores."""

    def __init__(
        self, fabric: "Fabric", model: nn.Module, training: Training, plan: Sequence[Stage], run: Run | None
    ) -> None:
        self.fabric, self.training, self.plan, self.run = fabric, training, plan, run
        self.state = State(model)
        self.final_feeding = _value(plan[-1].self_feeding, training.self_feeding, training.steps - 1)
        self.best: dict[str, Tensor] | None = None
        parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
        if not parameters:
            raise ValueError(
                f"{type(model).__name__} has no parameters that require gradients; there is nothing to fit"
            )
        names = [name for name, parameter in model.named_parameters() if parameter.requires_grad]
        for stage in plan:
            if missing := [start for start in stage.frozen if not any(name.startswith(start) for name in names)]:
                raise ValueError(f"no parameter's name starts with {', '.join(missing)}; they are {', '.join(names)}")
            if all(name.startswith(stage.frozen) for name in names):
                raise ValueError(f"a stage of {stage.steps} steps has every parameter frozen; there is nothing to fit")
        self.parameters = parameters
        optimizer = OPTIMISERS[training.optimizer](
            parameters, lr=training.rate(0), weight_decay=training.weight_decay, fused=True
        )
        self.module, self.optimizer = fabric.setup(_Bound(model, SequenceELBO(training.particles)), optimizer)
        self.generator = torch.Generator().manual_seed(training.seed + fabric.global_rank)
        # Another seed than the generator's own: equal seeds would tie the latent draws to the choice of the
        # batch.
        torch.manual_seed(int(torch.randint(2**62, (), generator=self.generator)))
        self.module.train()

    def step(self, source: Source) -> None:
        """Take one optimiser step."""
        state, training = self.state, self.training
        stage = _stage(self.plan, state.step)
        rate = _value(stage.learning_rate, training.rate, state.step)
        feeding = _value(stage.self_feeding, training.self_feeding, state.step)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        where = f"step {state.step + 1}"
        terms = self._terms(source.sample(training.batch_size, self.generator), stage.objective, where, feeding)
        loss = stage.objective(terms, state.step)
        self.optimizer.zero_grad()
        self.fabric.backward(loss)
        for name, parameter in state.model.named_parameters() if stage.frozen else ():
            if name.startswith(stage.frozen):
                parameter.grad = None  # which the optimiser leaves out, with its state
        gradients = [parameter.grad for parameter in self.parameters if parameter.grad is not None]
        norm = torch.linalg.vector_norm(torch.stack([torch.linalg.vector_norm(gradient) for gradient in gradients]))
        numbers = torch.stack([loss.detach(), norm])
        if not torch.isfinite(self._total(numbers)).all():
            self._mark_failed()
            raise NonFiniteError(
                f"{where}: {_culprit(state.model, terms, loss)}; no step was taken. Try a lower learning "
                "rate, a smaller gradient_clip or a longer warm-up"
            )
        if training.gradient_clip is not None and norm > training.gradient_clip:
            for gradient in gradients:
                gradient.mul_(training.gradient_clip / norm)
        self.optimizer.step()
        state.step += 1
        state.terms = terms
        self._numbers, self._rates = numbers, {"learning_rate": rate, "self_feeding": feeding}

    def row(self) -> dict[str, float]:
        """Return the numbers of the last step."""
        assert self.state.terms is not None
        loss, norm = self._numbers.tolist()
        return {"loss": loss, "gradient_norm": norm, **self._rates, **_per_frame(_sums(self.state.terms))}

    def validate(self, data: Sequences) -> dict[str, float]:
        """Return the terms of the unweighted bound on held-out data; keep the weights if it is the best.

        The draws from the guide are the same each time, so that bounds differ by the weights alone; the
        random state of training is left as it was. Every process scores all the data.

        A run with self-feeding learns to run on its own output, which costs it bound on the true past. There
        the best is by the bound of the self-fed program, once the schedule has reached its last value.

        A model without a likelihood has no bound; there, and where the objective says so, the best is by the objective.
        """
        state = self.state
        row = self._score(data, 0.0)
        score, counts = -row["loss"] if "loss" in row else row["bound"], True
        if self.final_feeding:
            fed = self._score(data, self.final_feeding)
            what = "loss" if "loss" in fed else "bound"
            row[f"self_fed/{what}"] = fed[what]
            score = -fed[what] if what == "loss" else fed[what]
            counts = self._rates["self_feeding"] == self.final_feeding
        if counts:
            state.waited += 1
            best = -math.inf if state.best_bound is None else state.best_bound
            if score > best:  # never true of NaN
                state.best_step, state.best_bound, state.waited = state.step, score, 0
                self.best = weights(state.model)
        return {f"validation/{name}": value for name, value in row.items()}

    def _score(self, data: Sequences, feeding: float) -> dict[str, float]:
        """The unweighted terms on held-out data, per frame, with the same draws each time."""
        sums = dict[str, Tensor]()
        objective = _stage(self.plan, self.state.step).objective
        last = self.training.steps  # of the weights, so that losses can be compared
        self.module.eval()
        with _forked_random_state(self.fabric.device), torch.no_grad():
            torch.manual_seed(self.training.seed)
            for batch in data.split(self.training.batch_size):
                terms = self._terms(batch, objective, f"validation after step {self.state.step}", feeding)
                found = _sums(terms)
                if not terms.likelihood or getattr(objective, "select", "bound") == "loss":
                    found["loss"] = objective(terms, last).double() * found["frames"]
                for name, value in found.items():
                    sums[name] = sums[name] + value if name in sums else value
        self.module.train()
        # one verdict for every process, whatever the rounding on its device
        totals = self._total(torch.stack(list(sums.values())))
        return _per_frame(dict(zip(sums, totals, strict=True)))

    def status(self) -> str:
        """Return "finished", "stopped early" or "running"."""
        if self.state.step >= self.training.steps:
            return "finished"
        patience = self.training.patience
        impatient = patience is not None and self.state.waited >= patience
        return "stopped early" if self.state.stop or impatient else "running"

    def any_process(self, value: object) -> bool:
        """Whether the value is true in any process."""
        return self._total(torch.tensor(float(bool(value)))).item() > 0

    def save(self) -> None:
        """Write a checkpoint, if the run has a directory."""
        if self.run is None:
            return
        state = self.state
        random = {name: self._gathered(value) for name, value in self._random_state().items()}
        if not self.fabric.is_global_zero:
            return
        name, buffer = self.training.optimizer, io.BytesIO()
        torch.save({"name": name, "optimizer": self.optimizer.state_dict(), "random": random}, buffer)
        files = {LAST: save_tensors(weights(state.model)), OPTIMISER: buffer.getvalue()}
        if self.best is not None and state.waited == 0:
            files[BEST] = save_tensors(self.best)
        self.run.commit({name: getattr(state, name) for name in _STORED}, files)

    def restore(self) -> None:
        """Return to the last checkpoint.

        Raises:
            CheckpointError: when its files are damaged, of another model, another optimiser or another number
                of processes.
            ValueError: when it has taken more steps than it is to take.
        """
        assert self.run is not None
        stored, model = self.run.state, self.state.model
        if stored["step"] > self.training.steps:
            raise ValueError(
                f"steps is {self.training.steps}, but {self.run.path} has taken {stored['step']} steps already; steps "
                f"counts all of a run, so give more than {stored['step']} to go on"
            )
        content = self.run.optimiser_state(state_bytes(model, 4) + 2**20)
        held = read_weights(model, self.run.read(LAST, state_bytes(model)), self.run.path / LAST)
        model.load_state_dict(held)
        self._check_state(content, stored["step"])
        if content["name"] != self.training.optimizer:
            raise CheckpointError(
                f"{self.run.path} was fitted with optimizer={content['name']!r}, not "
                f"{self.training.optimizer!r}; resume with the same optimiser"
            )
        processes = len(content["random"]["generator"])
        if processes != self.fabric.world_size:
            raise CheckpointError(
                f"{self.run.path} was fitted by {processes} processes, not {self.fabric.world_size}; resume "
                "with as many"
            )
        # a copy: set_state reads the storage, so it takes another row's bytes for a view, or crashes
        random = {name: value[self.fabric.global_rank].clone() for name, value in content["random"].items()}
        try:
            # options such as the weight decay are those of this call
            options = self.optimizer.state_dict()["param_groups"]
            self.optimizer.load_state_dict({"state": content["optimizer"]["state"], "param_groups": options})
            self.generator.set_state(random["generator"])
            torch.set_rng_state(random["torch"])
            if "cuda" in random and self.fabric.device.type == "cuda":
                torch.cuda.set_rng_state(random["cuda"], self.fabric.device)
        except (RuntimeError, TypeError, ValueError) as error:
            raise self._damaged(str(error)) from error
        for name in _STORED:
            setattr(self.state, name, stored[name])
        if BEST in stored["fingerprints"]:
            self.best = read_weights(model, self.run.read(BEST, state_bytes(model)), self.run.path / BEST)

    def _check_state(self, content: Any, step: int) -> None:
        """Refuse a state of optimiser and random numbers that no run of this model writes at this step.

        Raises:
            CheckpointError: naming what is wrong.
        """
        parts = {"name": str, "optimizer": dict, "random": dict}
        if not isinstance(content, dict) or not all(isinstance(content.get(key), kind) for key, kind in parts.items()):
            raise self._damaged(f"it holds no {', '.join(parts)}")
        moments, own = content["optimizer"].get("state"), self._random_state()
        if not isinstance(moments, dict):
            raise self._damaged("its optimizer has no state")
        for place, kept in moments.items():
            if type(place) is not int or not 0 <= place < len(self.parameters) or not isinstance(kept, dict):
                raise self._damaged(f"optimizer.state[{place!r}] is of no parameter")
            if (missing := _KEPT[self.training.optimizer] - kept.keys()) and content["name"] == self.training.optimizer:
                raise self._damaged(f"optimizer.state[{place}] has no {' and no '.join(sorted(missing))}")
            for key, value in kept.items():
                if (key, value) != ("momentum_buffer", None) and not self._sound(
                    key, value, self.parameters[place], step
                ):
                    raise self._damaged(
                        f"optimizer.state[{place}][{key!r}] is not as the optimiser writes it, finite and of shape "
                        f"{tuple(self.parameters[place].shape)}"
                    )
        for key, value in content["random"].items():
            size = own[key].numel() if key in own else None
            known = isinstance(value, Tensor) and value.dtype == torch.uint8 and value.ndim == 2
            if not known or size not in (None, value.shape[1]) or key not in ("generator", "torch", "cuda"):
                raise self._damaged(f"random[{key!r}] is no state of a random number generator")
        rows = {key: len(value) for key, value in content["random"].items()}
        if missing := {"generator", "torch"} - rows.keys():
            raise self._damaged(f"random has no {' and no '.join(sorted(missing))}")
        if len(set(rows.values())) > 1:
            raise self._damaged(f"random has states of {' and '.join(map(str, rows.values()))} processes")

    @staticmethod
    def _sound(key: Any, value: Any, parameter: Tensor, step: int) -> bool:
        """Whether a value of the optimiser's state is one: its count of steps, or a moment of the parameter."""
        if not isinstance(value, Tensor) or not value.is_floating_point():
            return False
        if key == "step":
            return value.ndim == 0 and 0 <= value.item() <= step and value.item() % 1 == 0
        if key not in ("exp_avg", "exp_avg_sq", "momentum_buffer") or value.shape != parameter.shape:
            return False
        return bool(torch.isfinite(value).all() and (key != "exp_avg_sq" or (value >= 0).all()))

    def _damaged(self, problem: str) -> CheckpointError:
        assert self.run is not None
        return CheckpointError(
            f"{self.run.path / OPTIMISER} is damaged: {problem}; copy the run directory whole, or fit again"
        )

    def _terms(self, batch: Batch, objective: Objective, where: str, feeding: float = 0.0) -> Terms:
        """Terms of a batch that the objective needs, on the device and in the precision of the model."""
        dtype = self.parameters[0].dtype
        placed = each(batch, lambda v: v.to(dtype) if v.is_floating_point() else v)
        program: dict[str, Any] = {"self_feeding": feeding} if feeding else {}
        if draws := getattr(objective, "draws", None):
            program["draws"] = draws
        try:
            return Terms(**self.module(self.fabric.to_device(placed), program))
        except ValueError as error:
            # torch's distributions refuse NaN parameters and values before there is a term to look at
            if "invalid values" not in str(error) and "within the support" not in str(error):
                raise
            self._mark_failed()
            raise NonFiniteError(f"{where}: {reason(error).partition(chr(10))[0]}") from error

    def _total(self, value: Tensor) -> Tensor:
        """The sum over the processes."""
        total = self.fabric.all_reduce(value.clone(), reduce_op="sum")
        assert isinstance(total, Tensor)
        return total

    def _gathered(self, value: Tensor) -> Tensor:
        """The values (N,) of every process, (processes, N), on the CPU."""
        gathered = self.fabric.all_gather(value)
        assert isinstance(gathered, Tensor)
        return gathered.reshape(self.fabric.world_size, -1).cpu()  # one process gets no leading axis

    def _random_state(self) -> dict[str, Tensor]:
        states = {"generator": self.generator.get_state(), "torch": torch.get_rng_state()}
        if self.fabric.device.type == "cuda":
            states["cuda"] = torch.cuda.get_rng_state(self.fabric.device)
        return states

    def _mark_failed(self) -> None:
        """Note the failure beside the last checkpoint, whose files stay as they are."""
        if self.run is not None and self.fabric.is_global_zero:
            self.run.commit({**self.run.state, "status": "failed"}, {})


# what an optimiser needs of every parameter that it has moved
_KEPT: dict[str, set[str]] = {"adam": {"step", "exp_avg", "exp_avg_sq"}, "sgd": set()}
_KEPT["adamw"] = _KEPT["adam"]

# what state.json holds of `State`
_STORED = ("step", "best_step", "best_bound", "waited", "status")


class _Signals:
    """Remembers the first Ctrl-C or SIGTERM, for the loop to stop after its step; a second acts at once."""

    def __init__(self) -> None:
        self.received: int | None = None
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> "_Signals":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(number) != signal.SIG_IGN:
                    self._previous[number] = signal.signal(number, self._remember)
        return self

    def __exit__(self, *_: object) -> None:
        while self._previous:
            number, handler = self._previous.popitem()
            signal.signal(number, handler or signal.SIG_DFL)

    def _remember(self, number: int, _: FrameType | None) -> None:
        self.received = number
        self.__exit__()


def _plan(
    options: Mapping[str, Any], objective: Objective | None, stages: Sequence[Stage]
) -> tuple[Training, list[Stage]]:
    """The training options and the stages, with schedules that end in time."""
    known = [option.name for option in fields(Training)]
    for name in options:
        if name not in known:
            raise TypeError(f"fit has no option {name!r}{nearest(name, known)}; the options are {', '.join(known)}")
    training = Training(**options)
    if not stages:
        stages = [Stage(training.steps, Evidence() if objective is None else objective)]
    elif objective is not None:
        raise ValueError("give either objective or stages: each stage has its own objective")
    total = sum(stage.steps for stage in stages)
    if "steps" in options and training.steps != total:
        raise ValueError(f"steps is {training.steps}, but the stages take {total} steps; leave steps out")
    plan: list[Stage] = []
    end = last = total
    for stage, following in zip(reversed(stages), [None, *reversed(stages[1:])], strict=True):
        # schedules run on through a next stage that differs in length and frozen parameters alone
        if following is None or replace(following, steps=stage.steps, frozen=stage.frozen) != stage:
            last = end
        plan.insert(0, clamp(stage, last))
        end -= stage.steps
    return clamp(replace(training, steps=total), total), plan


def _stage(plan: Sequence[Stage], step: int) -> Stage:
    """The stage that a global step belongs to."""
    for stage in plan:
        if step < stage.steps:
            return stage
        step -= stage.steps
    return plan[-1]


def _value(first: float | Schedule | None, otherwise: float | Schedule, step: int) -> float:
    return schedule(otherwise if first is None else first)(step)


def _same_data(run: Run, record: Mapping[str, Any]) -> None:
    """Refuse to resume on training data that are known to be others."""
    name = "training_data"
    before, now = run.config.get(name), record.get(name)
    if before is not None and now is not None and before != now:
        raise CheckpointError(
            f"{run.path} was fitted on other training data: {CONFIG} has the fingerprint {str(before)[:12]}…, these "
            f"data {now[:12]}…; resume on the same data, or fit anew in another directory"
        )


def _record(training: Training, plan: Sequence[Stage], train: Any) -> dict[str, Any]:
    """The options, and the training data's fingerprint if they have one, in JSON's types."""
    fingerprint = getattr(train, "fingerprint", None)
    return {
        **({"training_data": fingerprint} if isinstance(fingerprint, str) else {}),
        "training": {option.name: to_config(getattr(training, option.name)) for option in fields(training)},
        "stages": [
            {
                "steps": stage.steps,
                "objective": stage.objective.to_config()
                if isinstance(stage.objective, Evidence)
                else repr(stage.objective),
                "learning_rate": to_config(stage.learning_rate),
                "self_feeding": to_config(stage.self_feeding),
                "frozen": list(stage.frozen),
            }
            for stage in plan
        ],
    }


@contextmanager
def _forked_random_state(device: torch.device) -> Iterator[None]:
    """Put the random state of torch back at the end."""
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        yield


def _sums(terms: Terms) -> dict[str, Tensor]:
    """Each term summed over the sequences of a batch, and the number of frames."""
    named = {
        **({"bound": terms.bound} if terms.likelihood else {}),
        **{f"log_likelihood/{name}": value for name, value in terms.log_likelihood.items()},
        **{f"kl/{name}": value for name, value in terms.kl.items()},
        **{f"energy/{name}": value for name, value in terms.energies.items()},
        "frames": terms.frames,
    }
    return {name: value.detach().double().sum() for name, value in named.items()}


def _per_frame(sums: Mapping[str, Tensor]) -> dict[str, float]:
    return {name: float(value / sums["frames"]) for name, value in sums.items() if name != "frames"}


def _culprit(model: nn.Module, terms: Terms, loss: Tensor) -> str:
    """The first term, or else the loss or a gradient, that is not finite."""
    groups = {"log likelihood": terms.log_likelihood, "KL": terms.kl, "energy": terms.energies}
    for group, values in groups.items():
        for name, value in values.items():
            bad = ~torch.isfinite(value)
            if bad.any():
                first = f"the {group} of {name} is {value[bad][0].item()}"
                where = f"in {int(bad.sum())} of {len(value)} sequences"
                if name in terms.steps:
                    frames = (~torch.isfinite(terms.steps[name])).any(0).nonzero().flatten().tolist()
                    where += f", frames {', '.join(map(str, frames[:3]))}{'…' if len(frames) > 3 else ''}"
                return f"{first} {where}"
    if not torch.isfinite(loss):
        return f"the loss is {loss.item()} though every term is finite, so a weight of the objective is not"
    for name, parameter in model.named_parameters():
        if parameter.grad is not None and not torch.isfinite(parameter.grad).all():
            return f"the gradient of {name} is not finite though the loss is"
    return "the norm of the gradient overflows, or the loss of another process is not finite"
