"""Stochastic variational inference (Hoffman et al. 2013, arXiv 1206.7051), one step at a time.

`SVI` draws from the guide, computes the terms of the bound and the loss of the objective, and takes a step of a torch
optimiser. lightning-fabric runs the same code on a CPU, on a GPU, in bfloat16, or in several processes. Everything that
varies over time is a schedule of the global step. The run has its own random state: draws of the caller between steps
do not affect it, nor the reverse.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from traceback import walk_tb
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from ...data.batch import Batch
from ...data.sequences import Batched, as_batches, refuse_table, tensor_of
from ...locking import no_fork, seeded, serialized
from ...options import kind_of
from ...program.batch import AnyBatch
from ...program.model import DynamicalVAE
from ...program.protocols import Program
from ..bounds.elbo import SequenceELBO, Terms
from ..evaluation.result import error_message
from . import processes
from .checkpoints import weights
from .objectives import AdaptiveObjective, Objective, RequiresDraws, StatefulObjective
from .options import Stage, plan_stages, stage_at
from .schedules import schedule

if TYPE_CHECKING:
    from lightning_fabric import Fabric

# only optimisers with a fused implementation
OPTIMISERS = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW, "sgd": torch.optim.SGD}


class NonFiniteError(FloatingPointError):
    """A loss or its gradient is NaN or infinite; the step was not taken."""


@dataclass
class State:
    """State of a run. Callbacks of `fit` read it, and set `stop` to end the run after the step."""

    model: nn.Module
    step: int = 0
    terms: Terms | None = None
    row: dict[str, float] = field(default_factory=dict)
    best: dict[str, Tensor] | None = None
    best_step: int | None = None
    best_bound: float | None = None
    last_value: float | None = None
    waited: int = 0
    processor_seconds: float = 0.0
    status: str = "running"
    stop: bool = False

    @property
    def per(self) -> str:
        """Unit that bounds are divided by: a frame, unless the model names another."""
        return self.model.per if isinstance(self.model, Program) else "frame"


class SVI:
    """Stochastic variational inference step by step, for a training loop of your own; `fit` is written with it.

    On a CPU, steps on the batches that `fit` draws, `train.sample(batch_size, svi.generator)`, repeat its numbers bit
    for bit. `resuming` stores and restores a run.

    Args:
        model: a `DynamicalVAE`, or any module that `SequenceELBO` accepts.
        objective: objective to minimise; `Evidence()` by default.
        stages: consecutive stages with their own objectives, instead of `objective`, for all steps of the run.
        **options: fields of `Training`. Schedules and a decay end by `steps`; the caller decides when to log, validate
            and stop.

    Raises:
        TypeError, ValueError: when an option does not exist or is out of range, or the model has no trained parameters.

    Example:
        >>> import torch, dvae
        >>> model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)", {"z": 2, "x": 3})
        >>> x = torch.randn(32, 10, 3)
        >>> svi = dvae.SVI(model, steps=20, learning_rate=0.01)
        >>> state = svi.init()
        >>> for batch in x[:24].split(8):
        ...     terms = svi.step(batch)
        >>> state.step, sorted(svi.evaluate(x[24:]))
        (3, ['bound', 'kl/z', 'log_likelihood/x'])
    """

    def __init__(
        self, model: nn.Module, objective: Objective | None = None, stages: Sequence[Stage] = (), **options: Any
    ) -> None:
        if not isinstance(model, nn.Module):
            raise TypeError(
                f"the model is {kind_of(model)}; expected a module such as a DynamicalVAE, or `method.build(data)`"
            )
        self.model = model
        self.training, self.plan = plan_stages(options, objective, stages)
        trained = {name: parameter for name, parameter in model.named_parameters() if parameter.requires_grad}
        if not trained:
            raise ValueError(f"{type(model).__name__} has no parameters that require gradients, so it cannot be fitted")
        for name, tensor in model.state_dict(keep_vars=True).items():
            if tensor.is_meta or tensor.is_inference():
                where = "on the meta device" if tensor.is_meta else "in `torch.inference_mode()`"
                raise ValueError(f"{name} was made {where} and cannot be fitted; build the model outside of it")
        for stage in self.plan:
            if missing := [start for start in stage.frozen if not any(name.startswith(start) for name in trained)]:
                raise ValueError(f"no parameter's name starts with {', '.join(missing)}; they are {', '.join(trained)}")
            if all(name.startswith(stage.frozen) for name in trained):
                raise ValueError(f"every parameter is frozen in a stage of {stage.steps} steps; free at least one")
            if stage.curriculum is not None and not getattr(model, "has_curriculum", False):
                raise ValueError(
                    f"a stage of {stage.steps} steps has a curriculum, but {type(model).__name__} "
                    "does not support one; a model with shared context does (DynamicalVAE(shared=...))"
                )
            if isinstance(stage.objective, AdaptiveObjective):
                stage.objective.begin(model)  # refuse it now rather than when its stage begins
        self.parameters = list(trained.values())
        self.final_feeding = self.rates(self.training.steps - 1)["scheduled_sampling"]
        self._state: State | None = None
        self._begun: dict[int, Objective] = {}

    @property
    def state(self) -> State:
        """State of the run, after `init`."""
        if self._state is None:
            raise RuntimeError("the run has not begun; call init() first, which creates its optimiser")
        return self._state

    @property
    def objective(self) -> Objective:
        """Objective of the next step; its state, if any, starts anew in each stage."""
        first, stage = stage_at(self.plan, self.state.step)
        if first not in self._begun:
            described = stage.objective
            self._begun = {
                first: described.begin(self.model) if isinstance(described, AdaptiveObjective) else described
            }
        return self._begun[first]

    @torch.inference_mode(False)
    def init(self) -> State:
        """Start at step 0 with a new optimiser and the random numbers of the seed; the weights do not change."""
        training = self.training
        with no_fork:  # imports lightning-fabric, and the first optimiser imports parts of torch
            self.fabric: Fabric = processes.launch(training)
            torch.optim.SGD([torch.zeros(1)])
        with seeded(None, self.fabric.device):
            own: dict[str, Any] = {"momentum": training.momentum} if training.optimizer == "sgd" else {}
            optimizer = OPTIMISERS[training.optimizer](
                self.parameters, lr=training.rate(0), weight_decay=training.weight_decay, fused=True, **own
            )
            bound = _Bound(self.model, SequenceELBO(training.particles))
            self.module, self.optimizer = self.fabric.setup(bound, optimizer)
            processes.broadcast_values(self.fabric, self.model.state_dict().values())
            self.generator = torch.Generator().manual_seed(self._seed)
            # Not the generator's own seed: equal seeds would tie the latent draws to the choice of the batch.
            torch.manual_seed(int(torch.randint(2**62, (), generator=self.generator)))
            self.random = self._random_state()
        self._state, self._begun = State(self.model), {}
        return self._state

    @serialized
    @torch.inference_mode(False)
    def step(self, batch: AnyBatch) -> Terms:
        """Take one optimiser step, in training mode, and return the terms of the bound before it.

        Args:
            batch: x as a tensor (B, T, D), or a batch.

        Raises:
            NonFiniteError: when the loss or a gradient is NaN or infinite; the weights do not change.
        """
        state, training = self.state, self.training
        (_, stage), rates, objective = stage_at(self.plan, state.step), self.rates(state.step), self.objective
        for group in self.optimizer.param_groups:
            group["lr"] = rates["learning_rate"]
        if not self.model.training:
            self.module.train()
        where = f"step {state.step + 1}"
        with self.drawing():
            terms = self._terms(batch, stage.objective, where, rates["scheduled_sampling"], rates.get("curriculum"))
            loss = objective(terms, state.step)
            self.optimizer.zero_grad()
            self.fabric.backward(loss)
        for name, parameter in self.model.named_parameters() if stage.frozen else ():
            if name.startswith(stage.frozen):
                parameter.grad = None  # the optimiser skips a parameter without a gradient, and keeps its state
        whole, self._share = processes.average_gradients(self.fabric, self.parameters, loss, terms.frames.sum())
        gradients = [parameter.grad for parameter in self.parameters if parameter.grad is not None]
        norm = torch.linalg.vector_norm(torch.stack([torch.linalg.vector_norm(gradient) for gradient in gradients]))
        # the only place where a step synchronises with the device; everything up to the optimiser's step is queued
        *self._numbers, of_all = torch.stack([loss.detach(), norm, whole + norm]).tolist()
        if not math.isfinite(of_all):
            impossible = any((value == -math.inf).any() for value in terms.log_likelihood.values())
            advice = "a lower learning rate, a smaller gradient_clip or a longer warm-up"
            if impossible and not state.step:
                advice = "a distribution that can have these values; where it ends may depend on its parameters"
            raise NonFiniteError(f"{where}: {_culprit(self.model, terms, loss)}; no step was taken. Try {advice}")
        if training.gradient_clip is not None and self._numbers[1] > training.gradient_clip:
            for gradient in gradients:
                gradient.mul_(training.gradient_clip / norm)
        self._weights = dict[str, float]()
        if isinstance(objective, StatefulObjective):
            self._weights |= objective.row
            objective.adapt(self.mean)
        self.optimizer.step()
        state.step += 1
        state.terms = terms
        return terms

    def row(self) -> dict[str, float]:
        """Return the numbers of the last step, in nats per frame (see `trackers`)."""
        if self.state.terms is None:
            raise RuntimeError("no step has been taken since init(), so its numbers do not exist; call step() first")
        loss, norm = self._numbers
        rates = self.rates(self.state.step - 1)
        return {"loss": loss, "gradient_norm": norm, **rates, **self._weights, **_per_frame(_sums(self.state.terms))}

    def evaluate(self, data: Any) -> dict[str, float]:
        """Return the terms of the unweighted bound on data, in nats per frame; the model is left in evaluation mode.

        The draws from the guide are the same at each call, so bounds differ only by the weights. Processes divide the
        data among them, and each returns the terms of all data. The row of a model without a likelihood has a "loss"
        instead of a bound. An objective that selects by "loss" adds it to the row. A run with scheduled sampling adds
        "self_fed/bound", the bound with the feeding at the end of the run.

        Args:
            data: x as a tensor (N, T, D), a batch, or an object whose `all()` returns a batch or whose `batches(size)`
                yields batches in order.
        """
        held_out = as_batches(data)
        row = self._score(held_out, 0.0)
        if self.final_feeding:
            what = "loss" if "loss" in row else "bound"
            row[f"self_fed/{what}"] = self._score(held_out, self.final_feeding)[what]
        return row

    def validate(self, data: Any) -> dict[str, float]:
        """Return the row of `evaluate` with the prefix "validation/"; store the weights if they are the best so far.

        Scheduled sampling trains a model to run on its own output, which lowers the bound on the true past. Its best
        weights are therefore selected by "self_fed/bound", once the schedule has reached its last value.

        Without a likelihood, or if the objective selects by "loss", the best weights have the lowest loss. A stage with
        another objective starts this comparison anew.
        """
        state, row = self.state, self.evaluate(data)
        fed = "self_fed/" if self.final_feeding else ""
        score = -row[f"{fed}loss"] if "loss" in row else row[f"{fed}bound"]
        if not fed or self.rates(state.step - 1)["scheduled_sampling"] == self.final_feeding:
            state.waited += 1
            if "loss" in row and state.best_step is not None and not self._alike(state.best_step, state.step):
                state.best_bound = None  # the best loss so far is of another objective
            if score > (-math.inf if state.best_bound is None else state.best_bound):  # never true of NaN
                state.best_step, state.best_bound, state.waited = state.step, score, 0
                state.best = weights(self.model)
        return {f"validation/{name}": value for name, value in row.items()}

    def _alike(self, first: int, second: int) -> bool:
        """Return whether losses at two steps are of the same objective."""
        before, now = (stage_at(self.plan, step)[1].objective for step in (first, second))
        return before is now or before == now

    def rates(self, step: int) -> dict[str, float]:
        """Return learning rate, probability of scheduled sampling and curriculum, if there is one, at a global step."""
        _, stage = stage_at(self.plan, step)
        given = {"learning_rate": self.training.rate, "scheduled_sampling": self.training.scheduled_sampling}
        own = {name: getattr(stage, name) for name in given}
        rates = {name: given[name] if own[name] is None else own[name] for name in given}
        rates |= {} if stage.curriculum is None else {"curriculum": stage.curriculum}
        return {name: schedule(rate)(step) for name, rate in rates.items()}

    @contextmanager
    def drawing(self) -> Iterator[None]:
        """Use the run's random state inside the context, and restore the caller's afterwards."""
        with self._drawing(self.random):
            yield

    def total(self, value: Tensor) -> Tensor:
        """Return the sum over the processes."""
        return processes.sum_over_processes(self.fabric, value)

    def mean(self, value: Tensor) -> Tensor:
        """Return the mean over the processes of a rate per frame of the last step, weighted by their frames."""
        return self.total(value * self._share)

    def settle(self) -> None:
        """Copy buffers that training changes, such as running means, from the first process to all."""
        parameters = dict(self.model.named_parameters())
        moved = [value for name, value in self.model.state_dict().items() if name not in parameters]
        processes.broadcast_values(self.fabric, moved)

    @property
    def _seed(self) -> int:
        return processes.seed_of(self.training.seed, self.fabric.global_rank)

    @contextmanager
    def _drawing(self, random: dict[str, Tensor]) -> Iterator[None]:
        """Use a random state inside the context, store what it becomes, and restore the caller's afterwards."""
        with seeded(None, self.fabric.device):
            torch.set_rng_state(random["torch"])
            if "cuda" in random:
                torch.cuda.set_rng_state(random["cuda"], self.fabric.device)
            yield
            random.update(self._random_state())

    def _random_state(self) -> dict[str, Tensor]:
        on_cuda = self.fabric.device.type == "cuda"
        cuda = {"cuda": torch.cuda.get_rng_state(self.fabric.device)} if on_cuda else {}
        return {"torch": torch.get_rng_state(), **cuda}

    def _score(self, data: Batched, feeding: float) -> dict[str, float]:
        """Return the unweighted terms on held-out data, per frame, with the same draws at each call."""
        objective = stage_at(self.plan, self.state.step)[1].objective
        last = self.training.steps  # the last weights of the schedules, so that losses can be compared
        self.settle()
        sums, fabric = dict[str, Tensor](), self.fabric
        size = min(self.training.batch_size, math.ceil(len(data) / fabric.world_size))
        shares = fabric.global_rank * size < len(data)
        # a process without a batch of its own scores the first one, only for the names of the terms
        first, end = (fabric.global_rank, None) if shares else (0, 1)
        own = islice(data.batches(size), first, end, fabric.world_size)
        self.module.eval()
        with seeded(self._seed, self.fabric.device):
            random = self._random_state()
        while True:
            with self._drawing(random), torch.no_grad():  # other threads may run between two batches
                if (batch := next(own, None)) is None:
                    break
                terms = self._terms(batch, objective, f"validation after step {self.state.step}", feeding)
                found = _sums(terms)
                if not terms.likelihood or (isinstance(objective, RequiresDraws) and objective.select == "loss"):
                    found["loss"] = objective(terms, last).double() * found["frames"]
                for name, value in found.items():
                    sums[name] = sums[name] + value if name in sums else value
        totals = self.total(torch.stack(list(sums.values())) * shares)
        return _per_frame(dict(zip(sums, totals, strict=True)))

    def _terms(
        self, batch: AnyBatch, objective: Objective, where: str, feeding: float, curriculum: float | None = None
    ) -> Terms:
        """Return the terms of a batch that the objective needs, on the device of the model."""
        refuse_table(batch)
        placed = Batch(batch if isinstance(batch, Mapping) else {"x": batch}).map(tensor_of)
        if not isinstance(self.model, DynamicalVAE):  # a DynamicalVAE converts to its own precision
            dtype = self.parameters[0].dtype
            placed = placed.map(lambda v: v.to(dtype) if v.is_floating_point() else v)
        program: dict[str, Any] = {"scheduled_sampling": feeding} if feeding else {}
        program |= {} if curriculum is None else {"curriculum": curriculum}
        if isinstance(objective, RequiresDraws) and objective.draws:
            program["draws"] = objective.draws
        try:
            measure = self.objective.measure if isinstance(self.objective, StatefulObjective) else None
            on_device = self.fabric.to_device(placed)
            return Terms(**self.module(lambda: on_device, program, measure))  # fabric rounds tensor arguments
        except ValueError as error:
            if not _by_distribution(error):
                raise
            raise NonFiniteError(f"{where}: {error_message(error).partition(chr(10))[0]}") from error


def _by_distribution(error: ValueError) -> bool:
    """Return whether a distribution raised the error: torch's distributions refuse NaN parameters and values."""
    *_, (frame, _) = walk_tb(error.__traceback__)
    return str(frame.f_globals.get("__name__")).startswith(("torch.distributions", "pyro.distributions"))


class _Bound(nn.Module):
    """Module that returns the terms of the bound, as fabric needs a module to set up training.

    Pyro's `ELBOModule` returns a single number; objectives need the terms.
    """

    def __init__(self, model: nn.Module, estimator: SequenceELBO) -> None:
        super().__init__()
        self.model = model
        self.estimator = estimator

    def forward(
        self, batch: Callable[[], Batch], program: Mapping[str, Any], measure: Callable[[Terms], None] | None
    ) -> dict[str, Any]:
        terms = self.estimator.terms(self.model, batch(), **program)
        # here, because only fabric may compute gradients from the output of the module
        if measure is not None and torch.is_grad_enabled():
            with torch.autocast(terms.frames.device.type, enabled=False):
                measure(terms)
        return dict(vars(terms))


def _sums(terms: Terms) -> dict[str, Tensor]:
    """Return the sum of each term over the sequences of a batch, and the number of frames."""
    named = {
        **({"bound": terms.bound} if terms.likelihood else {}),
        **{f"log_likelihood/{name}": value for name, value in terms.log_likelihood.items()},
        **{f"kl/{name}": value for name, value in terms.kl.items()},
        **{f"energy/{name}": value for name, value in terms.energies.items()},
        "frames": terms.frames,
    }
    return {name: value.detach().double().sum() for name, value in named.items()}


def _per_frame(sums: Mapping[str, Tensor]) -> dict[str, float]:
    rates = (torch.stack(list(sums.values())) / sums["frames"]).tolist()
    return {name: rate for name, rate in zip(sums, rates, strict=True) if name != "frames"}


def _culprit(model: nn.Module, terms: Terms, loss: Tensor) -> str:
    """Return a description of the first term, or else of the loss or a gradient, that is not finite."""
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
