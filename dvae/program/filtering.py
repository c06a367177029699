"""Online filtering of a fitted model: `DynamicalVAE.filter`.

    p(z_t | x_{1:t})        p(x_{t+1} | x_{1:t})        log p(x_t | x_{1:t-1})

A linear-Gaussian model has an exact filter (`gaussian`), discrete latents are summed out, and other latents are
represented by particles (`particles`).
"""

from __future__ import annotations

import json
import math
import os
import zlib
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, is_dataclass, replace
from functools import cached_property, reduce
from typing import Annotated, Any, Self

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from .. import files
from ..data.batch import WHOLE, Batch
from ..data.sequences import refuse_table
from ..distributions.base import Parameters
from ..distributions.cdf import cdf
from ..locking import seeded
from ..networks.loop import Rows, pick, valid_steps
from ..options import Count, Range, require
from .batch import AnyBatch
from .conditional import Conditional, like
from .gaussian import GaussianFilter, is_linear_gaussian
from .particles import (
    Particles,
    hidden_data,
    is_windowed,
    moments_of_mixture,
    reads_ahead,
    reads_now,
)
from .rollout import Rollout

PARTICLES = 100
"""Default number of particles."""


@dataclass(frozen=True)
class Filtered:
    """Distributions of the latents given the data so far, and of each step given the steps before it.

    T is the number of steps of one call. Data are in the model's representation (`DynamicalVAE.view`). Values are NaN
    at padding, where a log evidence is 0.

    Args:
        proposal: how each latent is inferred: "exact", or by particles whose proposal is its "guide" or its "prior",
            the generative distribution. A guide that reads later data cannot be used.
        log_evidence: log p(x_t | x_{1:t-1}), in nats of the data's own unit, (B, T). Particles estimate it: the
            exponential of the sum is unbiased.
        effective: effective sample size of the weights after each step, (B, T); 1 for an exact filter.
        resampled: whether particles were resampled before each step, (B, T).
        predicted_mean, predicted_variance: moments of each data variable given the steps before it, (B, T, D).
        pit: probability integral transform of each entry given the steps before it, (B, T, D), randomised for discrete
            data: uniform if the model is right. NaN at missing entries and for distributions without a CDF.
        mean, variance: moments of each latent given the data up to t, (B, T, D).
        states: probabilities of each summed-out latent given the data up to t, (B, T, C).
        lagged_mean, lagged_variance, lagged_states: the same of z_{t-L} given the data up to t, for a fixed lag L; NaN
            at the first L steps.
        particles: draws of each latent, (K, B, T, D); none if the filter is exact.
        log_weights: their normalised log weights (K, B, T).
    """

    proposal: Mapping[str, str]
    log_evidence: Tensor
    effective: Tensor
    resampled: Tensor
    predicted_mean: Mapping[str, Tensor] = field(default_factory=dict)
    predicted_variance: Mapping[str, Tensor] = field(default_factory=dict)
    pit: Mapping[str, Tensor] = field(default_factory=dict)
    mean: Mapping[str, Tensor] = field(default_factory=dict)
    variance: Mapping[str, Tensor] = field(default_factory=dict)
    states: Mapping[str, Tensor] = field(default_factory=dict)
    lagged_mean: Mapping[str, Tensor] = field(default_factory=dict)
    lagged_variance: Mapping[str, Tensor] = field(default_factory=dict)
    lagged_states: Mapping[str, Tensor] = field(default_factory=dict)
    particles: Mapping[str, Tensor] = field(default_factory=dict)
    log_weights: Tensor | None = None

    @classmethod
    def join(
        cls, steps: list[dict[str, Any]], valid: Tensor | None, early: int, proposal: Mapping[str, str]
    ) -> Filtered:
        """Return the results of all steps together.

        Args:
            steps: fields of each step, without the dimension of time.
            valid: (B, T), False at padding.
            early: number of these steps that are among the first L of the sequences.
            proposal: as in `Filtered`.
        """

        def stack(values: list[Tensor], time: int, fill: float = math.nan) -> Tensor:
            stacked = torch.stack(values, time)
            if valid is None:
                return stacked
            ended = ~valid[..., None] if stacked.dim() > time + 1 else ~valid
            return stacked.masked_fill(ended, 0 if stacked.dtype is torch.bool else fill)

        first, joined = steps[0], dict[str, Any]()
        for name, value in first.items():
            time = 2 if name in ("particles", "log_weights") else 1
            each = [step[name] for step in steps]
            if isinstance(value, dict):
                joined[name] = {key: stack([part[key] for part in each], time) for key in value}
                for stacked in joined[name].values() if name.startswith("lagged") else ():
                    stacked[:, :early] = math.nan
            else:
                joined[name] = stack(each, time, 0.0 if name == "log_evidence" else math.nan)
        return cls(proposal, **joined)


@dataclass(frozen=True)
class Prediction:
    """The distribution of the data at one step given all steps before it, a mixture over particles and states.

    Args:
        model: the model.
        parts: conditional, parameters (C B, ...) and log weights (C, B) of C components, by data variable.
    """

    model: Any
    parts: Mapping[str, tuple[Conditional, Parameters, Tensor]]

    @property
    def mean(self) -> dict[str, Tensor]:
        """Mean (B, D) of each data variable, in the model's representation."""
        return {name: mean for name, (mean, _) in self.moments.items()}

    @property
    def variance(self) -> dict[str, Tensor]:
        """Variance (B, D) of each data variable, in the model's representation; NaN if a component has no formula."""
        return {name: variance for name, (_, variance) in self.moments.items()}

    @cached_property
    def components(self) -> dict[str, tuple[Any, Tensor]]:
        """Distribution (C B, D) and weights (C, B, 1) of the components of each data variable."""
        return {
            name: (conditional.distribution(parameters), log_weights.exp()[..., None])
            for name, (conditional, parameters, log_weights) in self.parts.items()
        }

    @cached_property
    def moments(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Mean and variance (B, D) of each data variable."""
        moments = {}
        for name, (distribution, weights) in self.components.items():
            conditional, parameters, _ = self.parts[name]
            means = conditional.mean(parameters)
            try:
                variances = distribution.variance
            except (NotImplementedError, AttributeError):  # some distributions have no formula
                variances = torch.full_like(means, math.nan)
            shape = *weights.shape[:2], -1
            moments[name] = moments_of_mixture(means.reshape(shape), variances.reshape(shape), weights)
        return moments

    def pit(self, name: str, value: Tensor, uniform: Tensor) -> Tensor:
        """Return the probability integral transform (B, D) of values (B, D).

        Args:
            name: name of the data variable.
            value: (B, D), in the model's representation.
            uniform: uniform numbers (B, D), which randomise between P(X < x) and P(X <= x).
        """
        distribution, weights = self.components[name]
        count, batch = weights.shape[:2]
        below, upto = cdf(distribution, value.expand(count, -1, -1).reshape(count * batch, -1))
        shares = upto.reshape(count, batch, -1)
        if below is not upto:
            below = below.reshape(count, batch, -1)
            shares = below + uniform * (shares - below)
        return (weights * shares).sum(0)

    def sample(self, samples: int) -> dict[str, Tensor]:
        """Return draws (S, B, D) of each data variable, in the unit of the data.

        Each variable has its marginal distribution: its draws do not depend on those of another variable, or part of x,
        that it reads at this step.
        """
        require(Count, samples=samples)
        draws, rows = {}, dict[int, Tensor]()
        with torch.no_grad():
            for name, (conditional, parameters, log_weights) in self.parts.items():
                count, batch = log_weights.shape
                if count not in rows:
                    component = torch.multinomial(log_weights.t().exp(), samples, replacement=True).t()
                    rows[count] = (component * batch + torch.arange(batch, device=component.device)).flatten()
                noise = conditional.head.noise((samples * batch, conditional.size), parameters[0])
                draw = conditional.draw(tuple(pick(p, rows[count]) for p in parameters), noise)
                draws[name] = draw.unflatten(0, (samples, batch))[:, :, None]
            return {name: value[:, :, 0] for name, value in self.model.to_data_space(draws).items()}

    def quantile(self, levels: float | Tensor, samples: int = 1000) -> dict[str, Tensor]:
        """Return quantiles (B, D), or (Q, B, D) for Q levels, of `samples` draws, in the unit of the data."""
        levels = torch.as_tensor(levels)
        if levels.dim() > 1 or not ((levels >= 0) & (levels <= 1)).all():
            raise ValueError(f"levels must be one number or a list of numbers from 0 to 1, got {levels.tolist()}")
        return {name: draws.quantile(levels.to(draws), 0) for name, draws in self.sample(samples).items()}


class Filter:
    """The state of a filter after some steps; `DynamicalVAE.filter` builds it.

    The weights of the model must not change between steps.

    Attributes:
        filtered: results of the steps of the last call; there are none after `load`.
        proposal: as in `Filtered`.
    """

    def __init__(
        self, model: Any, batch: AnyBatch, particles: int | None, lag: int, resample_below: float, seed: int | None
    ):
        require(Annotated[int, Range(1)], particles=PARTICLES if particles is None else particles)
        require(Annotated[int, Range(0)], lag=lag, seed=seed or 0)
        if not 0 <= resample_below <= 1:
            raise ValueError(f"resample_below must be a share of the particles, from 0 to 1, got {resample_below}")
        self.model, self.lag, self.resample_below, self.steps = model, lag, resample_below, 0
        seed = int(torch.randint(2**62, ())) if seed is None else seed
        self.device = like(model).device
        self.module: Any = torch.cuda if self.device.type == "cuda" else torch
        with seeded(seed, self.device):
            self.random = self.module.get_rng_state()
        self.uniform = torch.Generator().manual_seed(seed)
        with self._running():
            data = model.read(batch)
            _require_names(data, model.observed)
            run = model.rollout(data)
            self.proposal = choose_proposal(model, run.length)
            if reason := _obstacle(model, run, self.proposal):
                raise ValueError(reason)
            exact = particles is None and is_linear_gaussian(model)
            if exact:
                self.proposal = dict.fromkeys(model.latents, "exact")
            self.proposal |= dict.fromkeys(model.summed, "exact")
            self.endless = why_not_endless(model, run, self.proposal)
            # without latents, particles still draw the data that other data of the same step depend on
            is_drawn = model.latents or any(
                parent.name in model.observed and reads_now(parent)
                for factor in model.generative.factors
                for parent in factor.parents
            )
            self.count = 1 if exact or not is_drawn else particles or PARTICLES
            self.filtered = self._advance(run, data, self._build(run, exact))

    def __repr__(self) -> str:
        proposal = ", ".join(f"{name}: {how}" for name, how in self.proposal.items())
        return f"Filter({self.engine.known.batch} sequences, {self.steps} steps, {self.count} particles, {proposal})"

    def _build(self, run: Rollout, exact: bool) -> Tensor:
        """Build and start the engine; return the log evidence (B,) of static data."""
        model = self.model
        if not self.endless:
            parents = [p for f in (*model.generative.factors, *model.inference.factors) for p in f.parents]
            lags = [p.relation.lag for p in parents if p.relation is not None and p.relation.intervals is not None]
            window = max(1, self.lag, *lags)
            statics = {name: value for name, value in run.values.items() if value.dim() == 2}
            run = replace(run, length=window + 1, values=statics, observed={}, present={}, lengths=None)
        if exact:
            self.engine: Any = GaussianFilter(model, run, live=not self.endless)
        else:
            self.engine = Particles(model, run, self.count, self.proposal, live=not self.endless, lag=self.lag)
        carried: Tensor = self.engine.start()
        return carried

    @contextmanager
    def _running(self) -> Iterator[None]:
        """Run programs of the model with the random numbers of the filter, which other draws do not change."""
        with self.model.running(), torch.no_grad():
            outside = self.module.get_rng_state()
            try:
                self.module.set_rng_state(self.random)
                yield
                self.random = self.module.get_rng_state()
            finally:
                self.module.set_rng_state(outside)

    def update(self, batch: AnyBatch) -> Filtered:
        """Continue with new steps, in constant time and memory per step.

        Args:
            batch: data (B, D) of one step or (B, T, D) of several, or a mapping with "mask" and local context, as in
                `DynamicalVAE.model`. Static variables keep their values.

        Returns:
            Results of these steps, also in `filtered`.

        Raises:
            ValueError: the model cannot continue, for a reason that the message states, or the batch is invalid.
        """
        if self.endless:
            raise ValueError(f"this filter cannot continue: {self.endless}; filter the whole sequences again")
        with self._running():
            self.filtered = self._advance(*self._read(batch, [*self.model.observed, *self._context_names]))
        return self.filtered

    def predict(self, context: Mapping[str, Any] | None = None) -> Prediction:
        """Return the distribution of the next step given all steps so far; the filter stays at its step.

        Args:
            context: local context of the next step by name, (B, D).
        """
        if self.endless:
            raise ValueError(f"this filter cannot predict: {self.endless}")
        names, context = self._context_names, {} if context is None else context
        if not isinstance(context, Mapping):
            raise TypeError(f"context is a {type(context).__name__}, expected a mapping from names to values (B, D)")
        if other := [name for name in context if name not in names]:
            raise ValueError(f"a prediction reads {', '.join(names) or 'no context'}; leave out {', '.join(other)}")
        with self._running(), seeded(None, self.device):
            engine = self.engine.fork()
            engine.begin(self.resample_below)
            if names:
                run, _ = self._read(context, names)
                if run.length > 1:
                    raise ValueError(f"a prediction reads context (B, D) of one step, got {run.length} steps")
                engine.feed(run, 0, names)
            return Prediction(self.model, engine.predict())

    @property
    def _context_names(self) -> list[str]:
        return [n for n in self.model.context if self.model.reader.local[n]]

    def _read(self, batch: AnyBatch, names: list[str]) -> tuple[Rollout, Batch]:
        """Return a run and the data of new steps, which must contain these variables, with the static variables."""
        model = self.model
        refuse_table(batch)
        batch = batch if isinstance(batch, Mapping) else {WHOLE if model.view.parts else model.observed[0]: batch}
        if "lengths" in batch or "group" in batch:
            raise ValueError("an update continues all sequences by the same steps; leave out 'lengths' and 'group'")
        if absent := [name for name, value in batch.items() if value is None]:
            raise ValueError(f"{', '.join(absent)} is None; give the values of the new steps")
        if static := [name for name in batch if not model.reader.local.get(name, True)]:
            raise ValueError(f"static variables were given with the first steps; leave out {', '.join(static)}")
        tensors = Batch(batch).map(lambda value: torch.as_tensor(value).clone())  # the caller may reuse its tensors
        new = tensors.map(lambda value: value[:, None] if value.dim() == 2 else value)
        data: Batch = model.read({**self.engine.known.values, **new})
        _require_names(data, names)
        run = model.rollout(data)
        if run.batch != self.engine.known.batch:
            raise ValueError(f"the filter has {self.engine.known.batch} sequences, but the new steps have {run.batch}")
        return run, data

    def _advance(self, run: Rollout, data: Batch, carried: Tensor | float = 0.0) -> Filtered:
        """Filter the steps of a run; `carried` is the log evidence (B,) of the static data before the first step."""
        engine, model, steps = self.engine, self.model, []
        valid = None if run.lengths is None else valid_steps(run.lengths, run.length)
        volume = data.log_det
        if volume is not None and volume.dim() == 1:
            if run.length > 1:
                raise ValueError(f"{model.view} has one log-determinant for all steps, which the filter cannot divide")
            volume = volume[:, None]
        names = [name for name in model.observed if model.generative.local(name)]
        if model.summed:
            model.sums.require_data(hidden_data(run))
        for t in range(run.length):
            low = engine.begin(self.resample_below, None if valid is None else valid[:, t])
            if not self.endless:
                engine.feed(run, t, self._context_names)
            predicted = Prediction(model, engine.predict())
            if not self.endless:
                engine.feed(run, t, names)
            evidence = engine.weigh() + carried
            carried = 0.0
            step: dict[str, Any] = {
                "log_evidence": evidence if volume is None else evidence + volume[:, t],
                "effective": engine.effective,
                "resampled": low,
            }
            moments = predicted.moments
            step["predicted_mean"] = {name: moments[name][0] for name in names}
            step["predicted_variance"] = {name: moments[name][1] for name in names}
            step["pit"] = {}
            for name in names:
                value = run.values[name][:, t]
                uniform = torch.rand(value.shape, generator=self.uniform, dtype=torch.float64).to(value.device)
                pit = predicted.pit(name, value, uniform)
                observed = run.observed.get(name)
                step["pit"][name] = pit if observed is None else pit.masked_fill(~observed[:, t], math.nan)
            step |= engine.summary(0)
            if self.lag:
                lagged = engine.summary(self.lag)
                step |= {f"lagged_{field}": values for field, values in lagged.items()}
            if not isinstance(engine, GaussianFilter) and model.latents:
                shape = self.count, run.batch, -1
                step["particles"] = {name: value.reshape(shape) for name, value in engine.latents().items()}
                step["log_weights"] = engine.log_weights
            self.steps += 1
            steps.append(step)
        return Filtered.join(steps, valid, max(self.lag - self.steps + run.length, 0), self.proposal)

    # Files --------------------------------------------------------------------------------------------------------

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the state to a safetensors file, from which `model.filter(resume=path)` continues with equal results.

        Raises:
            ValueError: the filter cannot continue.
        """
        if self.endless:
            raise ValueError(f"this filter cannot continue, so its state is of no use: {self.endless}")
        tensors = {f"static/{name}": value for name, value in self.engine.known.values.items()}
        _exchange(vars(self.engine), "engine", tensors, load=False)
        tensors |= {"random": self.random, "uniform": self.uniform.get_state()}
        settings = {name: getattr(self, name) for name in SETTINGS} | {"position": self.engine.position}
        settings |= {"batch": self.engine.known.batch, "exact": isinstance(self.engine, GaussianFilter)}
        settings["weights"] = _checksum(self.model)
        packed = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
        with files.atomic_write(path) as file:
            files.write_all(file, save_tensors(packed, {"filter": json.dumps(settings)}))

    @classmethod
    def load(cls, model: Any, path: str | os.PathLike[str]) -> Self:
        """Return the filter that `save` wrote, for the same model."""
        content = files.read(path, LARGEST, links=True)
        settings = _settings(content, path)
        try:
            tensors = load_tensors(content)
        except SafetensorError as error:
            raise ValueError(f"{path} is damaged ({error}); write it again with `Filter.save`") from error
        if settings["weights"] != _checksum(model):
            raise ValueError(
                f"{path} is the state of a filter for other weights; resume it with the model that wrote it"
            )
        loaded = cls.__new__(cls)
        loaded.model, loaded.endless = model, ""
        for name in SETTINGS:
            setattr(loaded, name, settings[name])
        loaded.device = like(model).device
        loaded.module = torch.cuda if loaded.device.type == "cuda" else torch
        loaded.random, loaded.uniform = tensors.pop("random"), torch.Generator()
        loaded.uniform.set_state(tensors.pop("uniform"))
        # copies, because the tensors of a file are not aligned in memory
        tensors = {name: value.to(loaded.device, copy=True) for name, value in tensors.items()}
        statics = {name.removeprefix("static/"): v for name, v in tensors.items() if name.startswith("static/")}
        empty = {
            n: torch.zeros(settings["batch"], 1, model.sizes[n])
            for n in (*model.observed, *model.context)
            if model.reader.local[n] and n not in statics
        }
        masks = {name: torch.zeros_like(empty[name], dtype=torch.bool) for name in empty.keys() & {*model.observed}}
        with model.running(), torch.no_grad(), seeded(0):
            loaded._build(model.rollout(model.read({**statics, **empty, "mask": masks})), settings["exact"])
        _exchange(vars(loaded.engine), "engine", tensors, load=True)
        loaded.engine.position = settings["position"]
        return loaded


SETTINGS = ("proposal", "lag", "resample_below", "steps", "count")
"""Attributes of a filter that are stored as JSON."""
LARGEST = 2**33
"""Largest size of a stored state, in bytes."""


def _require_names(data: Batch, names: Collection[str]) -> None:
    if missing := [name for name in names if name not in data]:
        raise ValueError(
            f"a filter needs {', '.join(names)} at each step; missing in the batch are {', '.join(missing)}"
        )


def _checksum(model: Any) -> int:
    """Return a checksum of all parameters and buffers."""
    layout = torch.contiguous_format  # the bytes of a column of a matrix, for example, are not adjacent
    copies = (value.cpu().clone(memory_format=layout).reshape(-1) for value in model.state_dict().values())
    values = (value.view(torch.uint8).numpy() for value in copies)
    return reduce(lambda checksum, value: zlib.crc32(value, checksum), values, 0)


def _settings(content: bytes, path: Any) -> dict[str, Any]:
    """Return the settings in the header of a safetensors file."""
    try:
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        settings: dict[str, Any] = json.loads(header["__metadata__"]["filter"])
    except (ValueError, KeyError) as error:
        raise ValueError(f"{path} is not a stored filter; write one with `Filter.save`") from error
    return settings


def _exchange(state: Any, path: str, tensors: dict[str, Tensor], load: bool) -> Any:
    """Store the tensors of a state by path, or replace them if `load`, in place where possible; return the state."""
    if load and (path in tensors or isinstance(state, Tensor)):
        # equal tensors keep their layout in memory, on which the last bits of sums depend
        is_equal = isinstance(state, Tensor) and torch.equal(state, tensors[path])
        return state if is_equal else tensors[path]
    if isinstance(state, Tensor):
        return tensors.setdefault(path, state)
    if isinstance(state, Rows):
        parts = {str(t): state[t] for t in range(len(state))}
    elif isinstance(state, list | tuple):
        parts = {str(index): value for index, value in enumerate(state)}
    elif isinstance(state, dict):
        parts = dict(state)
    elif is_dataclass(state) and not isinstance(state, type | Rollout) and not state.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        parts = vars(state)
    else:
        return state
    parts = {name: _exchange(value, f"{path}/{name}", tensors, load) for name, value in parts.items()}
    if isinstance(state, Rows):
        state.values, state.written, state.moves, state.origin = list(parts.values()), [0] * len(parts), [], None
    elif isinstance(state, list | tuple):
        return type(state)(parts.values())
    else:
        (state if isinstance(state, dict) else vars(state)).update(parts)
    return state


# Which filters exist --------------------------------------------------------------------------------------------------


def choose_proposal(model: Any, length: int) -> dict[str, str]:
    """Return "guide" or "prior" for each latent: the guide, unless it reads data or latents that come later.

    Args:
        model: the model.
        length: T, number of steps.
    """
    unknown = {*model.observed, *model.latents}
    online = {True: True, False: True}  # by whether latents are local
    for block in model.inference.blocks:
        for name in block.names:
            factor = model.inference.factor(name)
            reads = [p for p in factor.parents if p.local]
            ahead = [p for p in reads if not factor.local or (p.name in unknown and reads_ahead(p, length))]
            if ahead or block.direction < 0 or model.encoder[name] is model.generator[name]:
                online[factor.local] = False
    return {name: "guide" if online[model.generative.local(name)] else "prior" for name in model.latents}


def _obstacle(model: Any, run: Rollout, proposal: Mapping[str, str]) -> str:
    """Return the reason why a model cannot be filtered; "" if it can."""
    if not model.likelihood:
        return f"{model.generative} has no likelihood, so data do not weight its latents"
    if model.bounded:
        return f"{', '.join(model.bounded)} has a bound in place of a density, which does not weight draws"
    if run.groups is not None:
        return f"groups share {', '.join(model.grouped)}, but a filter has one sequence at a time; leave out 'group'"
    unknown = {*model.observed, *model.latents, *model.summed}
    for block in model.generative.blocks:
        for name in block.names:
            factor = model.generative.factor(name)
            for parent in factor.parents:
                if parent.name in unknown and parent.local and (not factor.local or reads_ahead(parent, run.length)):
                    return f"{factor} reads {parent}, which is not known yet when the filter is at t"
            if block.direction < 0:
                return f"{factor} runs backward in time, and a filter forward"
    if static := [name for name in hidden_data(run) if not model.generative.local(name)]:
        return f"a static variable has no missing entries in a filter, but {', '.join(static)} has"
    if model.summed and (mixed := [n for n in model.sums.readers if n in proposal and not model.generative.local(n)]):
        return (
            f"{model.generative.factor(mixed[0])} reads a static class that is summed out; draw one of them, not both"
        )
    return ""


def why_not_endless(model: Any, run: Rollout, proposal: Mapping[str, str]) -> str:
    """Return the reason why the filter cannot continue after the given steps; "" if it can."""
    if run.lengths is not None:
        return "sequences of a ragged batch have ended"
    if not model.view.by_step:
        return f"the view {type(model.view).__name__} does not transform each step alone"
    guides = [model.encoder[name] for name, kind in proposal.items() if kind == "guide"]
    for conditional in (*model.generator.values(), *guides):
        factor, network = conditional.factor, conditional.network
        if not factor.local:
            continue
        if getattr(conditional.head, "steps", 0):
            return f"the distribution of {factor} has a scale of its own at each of {conditional.head.steps} steps"
        kind = type(network).__name__.removesuffix("Network")
        if network is not None and not network.stationary:
            return f"the network {kind} of {factor} depends on the number of the step"
        for parent in factor.parents:
            if parent.relation is None:
                continue
            if parent.relation.intervals is None or reads_ahead(parent, run.length):
                return f"{factor} reads {parent}, which may be later than t or depends on T"
            if is_windowed(conditional) and not parent.relation.pointwise:
                return (
                    f"{factor} reads {parent} with {kind}, whose state grows with every step; bound it, as {{t-8:t-1}}"
                )
    return ""
