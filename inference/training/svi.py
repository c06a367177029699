"""Stochastic variational inference (Hoffman et al. 2013, arXiv 1206.7051), one step at a time.

`SVI` draws from the guide, computes the terms of the bound and the loss of the objective, and takes a step of a torch
optimiser. lightning-fabric runs the same code on a CPU, on a GPU, in bfloat16, or in several processes. Everything that
varies over time is a schedule of the global step. The run has its own random state, which is independent of the
caller's: draws of one do not affect the other.
"""

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from traceback import walk_tb
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from ...capture import Captured, any_failed, deferring, replayed
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
from .forecast_score import NAME, forecast_score
from .objectives import AdaptiveObjective, Objective, RequiresDraws, StatefulObjective, WeightedObjective
from .options import Stage, plan_stages, stage_at
from .schedules import schedule

if TYPE_CHECKING:
    from lightning_fabric import Fabric

# only optimisers with a fused implementation
OPTIMISERS = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW, "sgd": torch.optim.SGD}


_TABLES = "log_likelihood", "kl", "energies", "steps"
"""Tables of tensors in `Terms`."""
ONLY_WITHIN = "a check of the batch failed only within a CUDA graph; set cuda_graph=False"


class NonFiniteError(FloatingPointError):
    """Error if a loss or its gradient is NaN or infinite; the step was not taken."""


@dataclass
class State:
    """State of a run. Callbacks of `fit` read it, and set `stop` to end the run after the step.

    With several processes, the run ends after the next step, which tells the others.
    """

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
        """Unit that bounds are divided by: a step, unless the model names another."""
        return self.model.per if isinstance(self.model, Program) else "step"


class SVI:
    """Stochastic variational inference step by step, for custom training loops; `fit` uses it.

    On a CPU, steps on the batches that `fit` draws, `train.sample(svi.batch_size, svi.generator)`, repeat its numbers
    bit for bit. `resuming` stores and restores a run.

    Args:
        model: a `DynamicalVAE`, or any module that `SequenceELBO` accepts.
        objective: objective to minimise; `Evidence()` by default.
        stages: consecutive stages with their own objectives, instead of `objective`, for all steps of the run.
        **options: fields of `Training`. Schedules and a decay end by `steps`; the caller decides when to log, validate
            and stop.

    Attributes:
        flags: whether this process is interrupted, and whether it is to stop; the next step sends them to the others.
        any_flags: whether these flags of any process were set in the last step.

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
                origin = "on the meta device" if tensor.is_meta else "in `torch.inference_mode()`"
                raise ValueError(f"{name} was created {origin} and cannot be fitted; build the model outside of it")
        for stage in self.plan:
            if missing := [start for start in stage.frozen if not any(name.startswith(start) for name in trained)]:
                raise ValueError(
                    f"frozen has {', '.join(missing)}, but no parameter's name starts with it; the parameters are "
                    f"{', '.join(trained)}"
                )
            if all(name.startswith(stage.frozen) for name in trained):
                raise ValueError(f"every parameter is frozen in a stage of {stage.steps} steps; train at least one")
            if stage.curriculum is not None and not getattr(model, "has_curriculum", False):
                raise ValueError(
                    f"a stage of {stage.steps} steps has a curriculum, but {type(model).__name__} "
                    "does not support one; a model with shared context does (DynamicalVAE(shared=...))"
                )
            if isinstance(stage.objective, AdaptiveObjective):
                stage.objective.begin(model)  # raises now rather than when its stage begins
        self.parameters = list(trained.values())
        self.final_feeding = self.rates(self.training.steps - 1)["scheduled_sampling"]
        self.flags = self.any_flags = (False, False)
        self._state: State | None = None
        self._stage_objective: dict[int, Objective] = {}

    @property
    def state(self) -> State:
        """State of the run, after `init`.

        Raises:
            RuntimeError: `init` has not been called.
        """
        if self._state is None:
            raise RuntimeError("the run has not begun; call init() first")
        return self._state

    @property
    def objective(self) -> Objective:
        """Objective of the next step; its state, if any, is reset at each stage."""
        first, stage = stage_at(self.plan, self.state.step)
        if first not in self._stage_objective:
            described = stage.objective
            self._stage_objective = {
                first: described.begin(self.model) if isinstance(described, AdaptiveObjective) else described
            }
        return self._stage_objective[first]

    @property
    def batch_size(self) -> int:
        """Number of sequences in the batch of the next step, in each process."""
        return stage_at(self.plan, self.state.step)[1].batch_size or self.training.batch_size

    @torch.inference_mode(False)
    def init(self) -> State:
        """Start at step 0 with a new optimiser and the random numbers of the seed; the weights do not change.

        Returns:
            State at step 0.
        """
        training = self.training
        with no_fork:  # imports lightning-fabric, and the first optimiser imports parts of torch
            self.fabric: Fabric = processes.launch(training)
            torch.optim.SGD([torch.zeros(1)])
        with seeded(None, self.fabric.device):
            sgd_options: dict[str, Any] = {"momentum": training.momentum} if training.optimizer == "sgd" else {}
            optimizer = OPTIMISERS[training.optimizer](
                self.parameters, lr=training.rate(0), weight_decay=training.weight_decay, fused=True, **sgd_options
            )
            bound = _Bound(self.model, SequenceELBO(training.particles))
            self.module, self.optimizer = self.fabric.setup(bound, optimizer)
            processes.broadcast_values(self.fabric, self.model.state_dict().values())
            self.generator = torch.Generator().manual_seed(self._seed)
            # A different seed from the generator's, because latent draws and batches would be dependent otherwise.
            torch.manual_seed(int(torch.randint(2**62, (), generator=self.generator)))
            self.random = self._random_state()
        self._state, self._stage_objective = State(self.model), {}
        self.reset_graphs()
        return self._state

    def reset_graphs(self) -> None:
        """Drop all CUDA graphs, so that later steps record new ones: after the optimiser's state has got other tensors.

        If the option is set and there can be none, a warning says why.
        """
        self._graphs_of = 0
        self.captured: Captured | None = None
        self.captured_validation: Captured | None = None
        if not self.training.cuda_graph:
            return
        kind, optimizer = self.fabric.device.type, self.optimizer.optimizer
        obstacles = [] if kind == "cuda" else [f"the device is {kind}, not cuda"]
        obstacles += ["processes exchange their gradients"] if self.fabric.world_size > 1 else []
        for objective in {id(stage.objective): stage.objective for stage in self.plan}.values():
            begun = objective.begin(self.model) if isinstance(objective, AdaptiveObjective) else objective
            if not _is_weighted(begun):
                name = getattr(objective, "__name__", type(objective).__name__)
                obstacles.append(f"{name} has no weights as `WeightedObjective` does")
        if obstacles:
            warnings.warn(f"the training step runs without a CUDA graph: {'; '.join(obstacles)}", stacklevel=3)
            return
        self.captured = Captured("the training step", self.fabric.device)
        self.captured_validation = Captured("validation", self.fabric.device)
        for parameter in self.parameters if self.training.momentum else ():
            # torch would leave it uninitialised if the first step is refused
            optimizer.state[parameter].setdefault("momentum_buffer", torch.zeros_like(parameter))

    @serialized
    @torch.inference_mode(False)
    def step(self, batch: AnyBatch) -> Terms:
        """Take one optimiser step, in training mode, and return the terms of the bound before it.

        Args:
            batch: x as a tensor (B, T, D), or a batch.

        Returns:
            Terms of the bound of each sequence, in nats.

        Raises:
            NonFiniteError: when the loss or a gradient is NaN or infinite; the weights do not change.
        """
        state, rates = self.state, self.rates(self.state.step)
        stage = self._enter_stage()
        if not self.model.training:
            self.module.train()
        converted = self._convert(batch)
        take = self._step if self.captured is None else self._replay
        state.terms = take(converted, stage, rates)
        state.step += 1
        return state.terms

    def _enter_stage(self) -> Stage:
        """Return the stage of the next step; if it is a new one, drop the graphs of the last one."""
        first, stage = stage_at(self.plan, self.state.step)
        if first != self._graphs_of:
            self._graphs_of = first
            for captured in (self.captured, self.captured_validation):
                if captured is not None:
                    captured.clear()
        return stage

    def _step(self, batch: Batch, stage: Stage, rates: Mapping[str, float]) -> Terms:
        """Take a step, and return the terms before it."""
        objective, training, step = self.objective, self.training, self.state.step
        with self.drawing():
            terms, measured = self._terms(
                batch, stage.objective, f"step {step + 1}", rates["scheduled_sampling"], rates.get("curriculum")
            )
            gradients, numbers = self._differentiate(objective(terms, step), terms, stage)
            terms = terms.map(Tensor.detach)  # frees the autograd graph
        # The only synchronisation with the device in a step; all other work is queued.
        *verdict, interrupted, stopped = numbers.tolist()
        self.any_flags = interrupted > 0, stopped > 0
        self._verdict(verdict, terms)
        if training.gradient_clip is not None and self._numbers[1] > training.gradient_clip:
            factor = training.gradient_clip / numbers[1]
            for gradient in gradients:
                gradient.mul_(factor)
        self._adapt(measured)
        for group in self.optimizer.param_groups:
            group["lr"] = rates["learning_rate"]
        self.optimizer.step()
        return terms

    def _adapt(self, measured: Mapping[str, Tensor]) -> None:
        """Store the weights of a stateful objective for the log, and update its state."""
        self._weights = dict[str, float]()
        if isinstance(self.objective, StatefulObjective):
            self._weights |= self.objective.row
            self.objective.adapt(measured, self.mean)

    def _differentiate(self, loss: Tensor, terms: Terms, stage: Stage) -> tuple[list[Tensor], Tensor]:
        """Compute the gradients of the loss, averaged over the processes.

        Returns:
            Gradients of the parameters that are trained in the stage, and five numbers: loss, norm of the gradient, a
            number that is finite if both are in all processes, and for each flag one above 0 if it is set anywhere.
        """
        self.optimizer.zero_grad()
        self.fabric.backward(loss)
        for name, parameter in self.model.named_parameters() if stage.frozen else ():
            if name.startswith(stage.frozen):
                parameter.grad = None  # the optimiser skips a parameter without a gradient, and keeps its state
        total_loss, self._share, any_flags = processes.average_gradients(
            self.fabric, self.parameters, loss, terms.n_steps.sum(), self.flags
        )
        gradients = [parameter.grad for parameter in self.parameters if parameter.grad is not None]
        norm = torch.linalg.vector_norm(torch.stack(torch._foreach_norm(gradients)))
        return gradients, torch.cat([torch.stack([loss.detach(), norm, total_loss + norm]), any_flags])

    def _verdict(self, numbers: list[float], terms: Terms) -> None:
        """Store loss and norm of the gradient, and raise `NonFiniteError` if the loss or a gradient is not finite."""
        *self._numbers, of_all = numbers
        if math.isfinite(of_all):
            return
        step = self.state.step
        impossible = any((value == -math.inf).any() for value in terms.log_likelihood.values())
        advice = "a lower learning rate, a smaller gradient_clip or a longer warm-up"
        if impossible and not step:
            advice = "a distribution whose support includes these values; the support may depend on its parameters"
        problem = _describe_non_finite(self.model, terms, self._numbers[0])
        raise NonFiniteError(f"step {step + 1}: {problem}; no step was taken. Try {advice}")

    def _replay(self, batch: Batch, stage: Stage, rates: Mapping[str, float]) -> Terms:
        """Take a step as `_step` does, by a CUDA graph if there is one for this kind of batch and stage."""
        assert self.captured is not None
        assert isinstance(self.objective, WeightedObjective)
        weights = self.objective.weights(self.state.step)
        sampling, curriculum = rates["scheduled_sampling"], rates.get("curriculum")
        constant = {"scheduled_sampling": sampling} if sampling in (0.0, 1.0) else {}
        constant |= {} if curriculum is None else {"curriculum": curriculum}
        numbers = [rates["learning_rate"], sampling, *weights.values()]
        inputs = {"numbers": torch.tensor(numbers, dtype=torch.float64), **batch.leaves()}
        before = dict(self.random)
        with self.drawing():
            function = partial(self._record, stage, constant, list(weights))
            results = self.captured(tuple(constant.items()), function, inputs)
        *verdict, _, _, is_invalid = results["numbers"].tolist()
        if is_invalid:
            self.random |= before
            with self.drawing(), torch.no_grad():  # the program itself raises the error of its check
                self._terms(batch, stage.objective, f"step {self.state.step + 1}", sampling, curriculum)
            raise RuntimeError(ONLY_WITHIN)
        parts: dict[str, dict[str, Tensor]] = {}
        for path, value in results.items():
            part, _, name = path.partition("/")
            parts.setdefault(part, {})[name] = value
        for name, parameter in self.model.named_parameters():
            parameter.grad = parts["gradient"].get(name)
        tables = {table: parts.get(table, {}) for table in _TABLES}
        bounded = getattr(self.model, "bounded", ())
        terms = Terms(**tables, n_steps=results["n_steps"], bounded=bounded).map(torch.clone)
        self._verdict(verdict, terms)
        self._adapt(parts.get("measured", {}))
        return terms

    def _record(
        self, stage: Stage, constant: Mapping[str, float], names: Sequence[str], inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Take a step without reading a value of the GPU; a step whose loss or gradient is not finite changes nothing.

        Args:
            stage: stage of the step.
            constant: probability of scheduled sampling and curriculum, if they do not vary.
            names: names of the objective's weights.
            inputs: "numbers" (2 + W,): learning rate, probability of scheduled sampling and weights of the objective;
                and the tensors of the batch by path.

        Returns:
            "numbers" (6,) as from `_differentiate`, and whether a check of the batch failed; terms, gradients and
            measured quantities by path.
        """
        assert isinstance(self.objective, WeightedObjective)
        buffers = [(buffer, buffer.clone()) for buffer in self.model.buffers()]
        numbers, objective = inputs["numbers"], self.objective
        sampling = constant.get("scheduled_sampling", numbers[1])
        batch = Batch.from_leaves({path: value for path, value in inputs.items() if path != "numbers"})
        with deferring() as checks:
            terms, measured = self._terms(batch, stage.objective, "", sampling, constant.get("curriculum"))
        weights = numbers[2:].to(terms.n_steps.dtype).unbind()
        loss = objective.loss(terms, dict(zip(names, weights, strict=True)))
        gradients, verdict = self._differentiate(loss, terms, stage)
        is_invalid = any_failed(checks, verdict.device)
        is_refused = is_invalid | ~torch.isfinite(verdict[2])
        if self.training.gradient_clip is not None:
            share = (self.training.gradient_clip / verdict[1]).clamp(max=1)
            torch._foreach_mul_(gradients, torch.where(is_refused, 1.0, share))
        for buffer, before in buffers:
            buffer.copy_(torch.where(is_refused, before, buffer))
        optimizer = self.optimizer.optimizer
        optimizer.found_inf = is_refused.float()
        earlier = [dict(group) for group in optimizer.param_groups]
        try:
            for group in optimizer.param_groups:
                group["lr"] = numbers[0].float()
                if "capturable" in group:  # torch asks for it, although fused optimisers do not differ
                    group["capturable"] = self.captured is not None and self.captured.recording
            optimizer.step()
        finally:
            del optimizer.found_inf
            for group, options in zip(optimizer.param_groups, earlier, strict=True):
                group.update(options)
        tables = {
            f"{field}/{name}": value.detach() for field in _TABLES for name, value in getattr(terms, field).items()
        }
        gradient = {f"gradient/{n}": p.grad for n, p in self.model.named_parameters() if p.grad is not None}
        extra = {f"measured/{name}": value for name, value in measured.items()}
        verdict = torch.cat([verdict, is_invalid.to(verdict)[None]])
        return {"numbers": verdict, "n_steps": terms.n_steps, **tables, **gradient, **extra}

    def row(self) -> dict[str, float]:
        """Return the numbers of the last step, in nats per step (see `trackers`).

        Raises:
            RuntimeError: no step has been taken since `init`.
        """
        if self.state.terms is None:
            raise RuntimeError("no step has been taken since init(); call step() first")
        loss, norm = self._numbers
        rates = self.rates(self.state.step - 1)
        return {"loss": loss, "gradient_norm": norm, **rates, **self._weights, **_per_step(_sums(self.state.terms))}

    def evaluate(self, data: Any) -> dict[str, float]:
        """Return the terms of the unweighted bound on data, in nats per step; the model stays in evaluation mode.

        The draws from the guide are the same at each call, so bounds differ only by the weights. Processes share the
        data, and each returns the terms of all data. The row of a model without a likelihood has a "loss" instead of a
        bound. An objective that selects by "loss" adds it to the row. A run with scheduled sampling adds
        "scheduled_sampling/bound", the bound with the scheduled-sampling probability at the end of the run.

        Args:
            data: x as a tensor (N, T, D), a batch, an object whose `all()` returns a batch, or one whose
                `batches(size)` yields batches in order.
        """
        held_out = as_batches(data)
        row = self._score(held_out, 0.0)
        if self.final_feeding:
            score = "loss" if "loss" in row else "bound"
            row[f"scheduled_sampling/{score}"] = self._score(held_out, self.final_feeding)[score]
        return row

    def validate(self, data: Any) -> dict[str, float]:
        """Return the row of `evaluate` with the prefix "validation/"; store the weights if they are the best so far.

        Scheduled sampling trains a model to run on its own output, which lowers the bound on the true past. Its best
        weights are therefore selected by "scheduled_sampling/bound", once the schedule has reached its last value.

        Without a likelihood, or if the objective selects by "loss", the best weights have the lowest loss. At a stage
        with another objective, this comparison starts again.

        With the option `select="forecast"`, the best weights have the lowest "CRPS" (`forecast_score`) at any step.

        Args:
            data: validation data, as in `evaluate`; windows with `protocol.observed`, to select by forecasts.
        """
        state, row = self.state, self.evaluate(data)
        prefix = "scheduled_sampling/" if self.final_feeding else ""
        if by_forecast := self.training.select == "forecast":
            row[NAME], prefix = self._forecast_score(data), ""
        by_loss = "loss" in row and not by_forecast
        score = -row[NAME] if by_forecast else -row[f"{prefix}loss"] if by_loss else row[f"{prefix}bound"]
        if not prefix or self.rates(state.step - 1)["scheduled_sampling"] == self.final_feeding:
            state.waited += 1
            before = None if by_forecast else state.best_step
            if before is not None and not self._are_comparable(before, state.step, by_loss):
                state.best_bound = None
            if math.isfinite(score) and (state.best_bound is None or score > state.best_bound):
                state.best_step, state.best_bound, state.waited = state.step, score, 0
                state.best = weights(self.model)
        return {f"validation/{name}": value for name, value in row.items()}

    def _forecast_score(self, windows: Any) -> float:
        """Return the score of forecasts, the same in all processes; infinite if they leave the range of numbers."""
        try:
            score = forecast_score(
                self.model, windows, self.training.batch_size, self.training.seed, self.captured_validation
            )
        except (ValueError, RuntimeError) as error:
            if not _is_from_distribution(error) or isinstance(error, torch.cuda.OutOfMemoryError):
                raise
            score = math.inf  # forecasts may diverge although the bound, given the true past, is finite
        return float(self.total(torch.tensor(score, dtype=torch.float64))) / self.fabric.world_size

    def _are_comparable(self, first: int, second: int, by_loss: bool) -> bool:
        """Return whether the scores after two steps are comparable: bounds, or losses of the same objective.

        Args:
            first: the earlier step.
            second: the later step.
            by_loss: whether the score after the later step is a loss.
        """
        before, now = (stage_at(self.plan, step)[1].objective for step in (first, second))
        return before is now or before == now or not (by_loss or _selects_by_loss(before))

    def rates(self, step: int) -> dict[str, float]:
        """Return learning rate, probability of scheduled sampling and, if any, curriculum at a global step.

        Args:
            step: global step, from 0.
        """
        _, stage = stage_at(self.plan, step)
        defaults = {"learning_rate": self.training.rate, "scheduled_sampling": self.training.scheduled_sampling}
        stage_rates = {name: getattr(stage, name) for name in defaults}
        rates = {name: defaults[name] if stage_rates[name] is None else stage_rates[name] for name in defaults}
        rates |= {} if stage.curriculum is None else {"curriculum": stage.curriculum}
        return {name: schedule(rate)(step) for name, rate in rates.items()}

    @contextmanager
    def drawing(self) -> Iterator[None]:
        """Use the run's random state inside the context, and restore the caller's afterwards."""
        with self._drawing(self.random):
            yield

    def total(self, value: Tensor) -> Tensor:
        """Return the sum over the processes.

        Args:
            value: value of this process.
        """
        return processes.sum_over_processes(self.fabric, value)

    def mean(self, value: Tensor) -> Tensor:
        """Return the mean over processes of a value per step, weighted by their numbers of steps in the last step.

        Args:
            value: value per step of this process.
        """
        return self.total(value * self._share)

    def settle(self) -> None:
        """Copy buffers that training changes, such as running means, from the first process to all."""
        parameters = dict(self.model.named_parameters())
        buffers = [value for name, value in self.model.state_dict().items() if name not in parameters]
        processes.broadcast_values(self.fabric, buffers)

    @property
    def _seed(self) -> int:
        return processes.seed_of(self.training.seed, self.fabric.global_rank)

    @contextmanager
    def _drawing(self, random: dict[str, Tensor]) -> Iterator[None]:
        """Use and update a random state inside the context, and restore the caller's afterwards."""
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

    @torch.inference_mode(False)
    def _score(self, data: Batched, feeding: float) -> dict[str, float]:
        """Return the unweighted terms on held-out data, per step, with the same draws at each call.

        Args:
            data: held-out data.
            feeding: probability of scheduled sampling; 0 to read the true past.
        """
        stage = self._enter_stage()
        self.settle()
        sums, fabric = dict[str, Tensor](), self.fabric
        size = min(self.training.batch_size, math.ceil(len(data) / fabric.world_size))
        shares = fabric.global_rank * size < len(data)
        # a process without a batch scores the first one, only for the names of the terms
        first, end = (fabric.global_rank, None) if shares else (0, 1)
        batches = islice(data.batches(size), first, end, fabric.world_size)
        self.module.eval()
        with seeded(self._seed, self.fabric.device):
            random = self._random_state()
        while True:
            with self._drawing(random), torch.no_grad():  # other threads may run between two batches
                if (batch := next(batches, None)) is None:
                    break
                for name, value in self._held_out_sums(self._convert(batch), stage, feeding).items():
                    sums[name] = sums[name] + value if name in sums else value.clone()
        totals = self.total(torch.stack(list(sums.values())) * shares)
        return _per_step(dict(zip(sums, totals, strict=True)))

    def _held_out_sums(self, batch: Batch, stage: Stage, feeding: float) -> Mapping[str, Tensor]:
        """Return the sums of a held-out batch in a stage, by a CUDA graph if there is one for its kind."""
        objective, location = stage.objective, f"validation after step {self.state.step}"

        def sums(batch: Batch) -> dict[str, Tensor]:
            terms, _ = self._terms(batch, objective, location, feeding)
            values = _sums(terms)
            if not terms.likelihood or _selects_by_loss(objective):
                # the last weights of the schedules, so that losses can be compared
                values["loss"] = objective(terms, self.training.steps).double() * values["steps"]
            return values

        return replayed(self.captured_validation, feeding, sums)(batch)

    def _convert(self, batch: AnyBatch) -> Batch:
        """Return a batch as tensors, in the precision of the model unless it is a `DynamicalVAE`, which converts."""
        refuse_table(batch)
        converted = Batch(batch if isinstance(batch, Mapping) else {"x": batch}).map(tensor_of)
        if isinstance(self.model, DynamicalVAE):
            return converted
        dtype = self.parameters[0].dtype
        return converted.map(lambda v: v.to(dtype) if v.is_floating_point() else v)

    def _terms(
        self,
        batch: Batch,
        objective: Objective,
        location: str,
        feeding: float | Tensor,
        curriculum: float | None = None,
    ) -> tuple[Terms, Mapping[str, Tensor]]:
        """Return the terms of a batch that the objective needs, and what it measures, on the device of the model.

        Args:
            batch: result of `_convert`.
            objective: objective that determines the numbers of draws.
            location: place in the run, for errors, such as "step 3".
            feeding: probability of scheduled sampling.
            curriculum: progress of the curriculum, from 0 to 1; None for a model without one.
        """
        program: dict[str, Any] = {"scheduled_sampling": feeding} if isinstance(feeding, Tensor) or feeding else {}
        program |= {} if curriculum is None else {"curriculum": curriculum}
        if isinstance(objective, RequiresDraws) and objective.draws:
            program["draws"] = objective.draws
        try:
            measure = self.objective.measure if isinstance(self.objective, StatefulObjective) else None
            on_device = self.fabric.to_device(batch)
            terms, measured = self.module(lambda: (on_device, program), measure)  # fabric rounds tensor arguments
            return Terms(**terms), measured
        except ValueError as error:
            if not _is_from_distribution(error):
                raise
            raise NonFiniteError(f"{location}: {error_message(error).partition(chr(10))[0]}") from error


def _selects_by_loss(objective: object) -> bool:
    return isinstance(objective, RequiresDraws) and objective.select == "loss"


def _is_weighted(objective: object) -> bool:
    """Return whether `loss` at `weights` gives the value of the objective itself."""
    defining = {name: cls for cls in reversed(type(objective).__mro__) for name in vars(cls)}
    return isinstance(objective, WeightedObjective) and issubclass(defining["loss"], defining["__call__"])


def _is_from_distribution(error: Exception) -> bool:
    """Return whether a distribution raised the error, as torch's do for NaN parameters and values."""
    *_, (frame, _) = walk_tb(error.__traceback__)
    return str(frame.f_globals.get("__name__")).startswith(("torch.distributions", "pyro.distributions"))


class _Bound(nn.Module):
    """Module that returns the terms of the bound, because fabric sets up training for a module.

    Pyro's `ELBOModule` returns a single number, but objectives need the terms.
    """

    def __init__(self, model: nn.Module, estimator: SequenceELBO) -> None:
        super().__init__()
        self.model = model
        self.estimator = estimator

    def forward(
        self,
        arguments: Callable[[], tuple[Batch, Mapping[str, Any]]],
        measure: Callable[[Terms], Mapping[str, Tensor]] | None,
    ) -> tuple[dict[str, Any], Mapping[str, Tensor]]:
        batch, program = arguments()
        terms, measured = self.estimator.terms(self.model, batch, **program), dict[str, Tensor]()
        # measured here, because outside only fabric may compute gradients of the module's output
        if measure is not None and torch.is_grad_enabled():
            with torch.autocast(terms.n_steps.device.type, enabled=False):
                measured |= measure(terms)
        return dict(vars(terms)), measured


def _sums(terms: Terms) -> dict[str, Tensor]:
    """Return the sum of each term over the sequences of a batch, and the number of steps."""
    values = {
        **({"bound": terms.bound} if terms.likelihood else {}),
        **{f"log_likelihood/{name}": value for name, value in terms.log_likelihood.items()},
        **{f"kl/{name}": value for name, value in terms.kl.items()},
        **{f"energy/{name}": value for name, value in terms.energies.items()},
        "steps": terms.n_steps,
    }
    return {name: value.detach().double().sum() for name, value in values.items()}


def _per_step(sums: Mapping[str, Tensor]) -> dict[str, float]:
    rates = (torch.stack(list(sums.values())) / sums["steps"]).tolist()
    return {name: rate for name, rate in zip(sums, rates, strict=True) if name != "steps"}


def _describe_non_finite(model: nn.Module, terms: Terms, loss: float) -> str:
    """Return a description of the first term, or else of the loss or a gradient, that is not finite."""
    groups = {"log likelihood": terms.log_likelihood, "KL": terms.kl, "energy": terms.energies}
    for group, values in groups.items():
        for name, value in values.items():
            invalid = ~torch.isfinite(value)
            if invalid.any():
                first = f"the {group} of {name} is {value[invalid][0].item()}"
                location = f"in {int(invalid.sum())} of {len(value)} sequences"
                if name in terms.steps:
                    steps = (~torch.isfinite(terms.steps[name])).any(0).nonzero().flatten().tolist()
                    location += f", time steps {', '.join(map(str, steps[:3]))}{'…' if len(steps) > 3 else ''}"
                return f"{first} {location}"
    if not math.isfinite(loss):
        return f"the loss is {loss} although every term is finite, so a weight of the objective is not finite"
    for name, parameter in model.named_parameters():
        if parameter.grad is not None and not torch.isfinite(parameter.grad).all():
            return f"the gradient of {name} is not finite although the loss is"
    return "the norm of the gradient overflows, or the loss of another process is not finite"
