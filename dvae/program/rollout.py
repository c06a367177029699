"""One run of a factorization: its given values, and draws of the others.

Teacher forcing, free running, forecasting, scheduled sampling and scoring run the same factors with different values
given. A `Rollout` stores the values of one run; every site of the Pyro program gets its draws and distributions from
it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from math import inf
from typing import Any, ClassVar

import numpy as np
import pyro
import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from ..capture import is_deferring
from ..distributions.base import Parameters
from ..factorization.notation import Block, Factorization
from ..networks.base import indicator, presence
from ..networks.loop import memoizing, repeat_batch, steps_of, valid_steps
from .conditional import Conditional, like
from .enumeration import Enumeration, EnumerationPlan
from .groups import Grouped, Groups


@dataclass(frozen=True)
class ScheduledSampling:
    """Scheduled sampling: the model's own means replace frames of the data's history (Bengio et al., 2015).

    Args:
        probability: probability of each frame, independently; within a CUDA graph, a scalar tensor.
        passes: None computes the means step by step, which is exact. A number of passes approximates this in parallel:
            each pass computes the means of all steps at once from the history of the previous pass (T passes are
            exact). If the model has several data variables, each reads the means of earlier variables from the same
            pass.
        gradient: whether gradients flow through the means, and so back in time. Without it, as in Bengio et al., a step
            takes half the time or less, but the gradient differs from the gradient of the bound with scheduled
            sampling. Means at missing entries always have a gradient.
        start: number of first frames that are never replaced, such as those that a forecast observes.
        blocks: a pair of numbers of frames. After `start`, the first number of frames is kept, the second number may be
            replaced, and so on in turns (Zhou et al., 2018, arXiv 1707.05363, use (5, 5)). With None, any frame may be
            replaced.

    Raises:
        ValueError: an option is out of range.

    Example:
        >>> model = dvae.DynamicalVAE("p(z_t | x_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2})
        >>> own = dvae.ScheduledSampling(0.5)
        >>> terms = dvae.SequenceELBO().terms(model, torch.randn(3, 4, 2), scheduled_sampling=own)
    """

    probability: float | Tensor
    passes: int | None = None
    gradient: bool = True
    start: int = 0
    blocks: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        is_share = isinstance(self.probability, Tensor) or 0 <= self.probability <= 1
        if not is_share or (self.passes is not None and self.passes < 1) or self.start < 0:
            raise ValueError(
                f"expected a probability in [0, 1], at least one pass and a start of at least 0, got {self}"
            )
        if self.blocks is not None and (len(self.blocks) != 2 or min(self.blocks) < 1):
            raise ValueError(f"blocks must be numbers of kept and of replaced steps, at least 1, got {self.blocks}")

    def at(self, level: float | Tensor) -> ScheduledSampling:
        """Return a copy with this probability, for schedules.

        Args:
            level: probability, from 0 to 1.
        """
        return replace(self, probability=level)

    @property
    def active(self) -> bool:
        """Whether any frame may be replaced."""
        return isinstance(self.probability, Tensor) or self.probability > 0

    def frames(self, batch: int, length: int, device: torch.device) -> Tensor:
        """Draw a mask (B, T, 1), True at frames that the model's own means replace, for B sequences of T frames.

        Args:
            batch: B, number of sequences.
            length: T, number of frames.
            device: device of the mask.

        Returns:
            The mask, as booleans.
        """
        mask = torch.rand(batch, length, 1, device=device) < self.probability
        mask[:, : self.start] = False
        if self.blocks is not None:
            n_kept, n_replaced = self.blocks
            phase = (torch.arange(length, device=device) - self.start) % (n_kept + n_replaced)
            mask &= (phase >= n_kept)[:, None]
        return mask

    def fixed_frames(self, length: int) -> list[bool] | None:
        """Return whether each of T frames stays unchanged, as T booleans; None if this is random.

        Args:
            length: T, number of frames.
        """
        if isinstance(self.probability, Tensor) or self.probability < 1:
            return None
        n_kept, n_replaced = self.blocks or (0, 1)
        return [t < self.start or (t - self.start) % (n_kept + n_replaced) < n_kept for t in range(length)]


@dataclass(frozen=True)
class InputNoise:
    """Normal noise on the data's history, which trains a model to continue from inexact inputs such as its own output.

    The scored data have no noise. Source: Fragkiadaki et al., 2015, arXiv 1508.00271.

    Args:
        scale: standard deviation, in the unit of the networks' inputs (`dvae.data.units`); within a CUDA graph, a
            scalar tensor.

    Raises:
        ValueError: `scale` is negative or not finite.

    Example:
        >>> model = dvae.DynamicalVAE("p(x_t | x_{<t})", "", {"x": 2})
        >>> terms = dvae.SequenceELBO().terms(model, torch.randn(3, 4, 2), scheduled_sampling=dvae.InputNoise(0.5))
    """

    scale: float | Tensor

    def __post_init__(self) -> None:
        if not isinstance(self.scale, Tensor) and not 0 <= self.scale < inf:
            raise ValueError(f"the scale of noise must be finite and at least 0, got {self.scale}")

    def at(self, level: float | Tensor) -> InputNoise:
        """Return a copy with this share of the scale, for schedules.

        Args:
            level: share of the scale.
        """
        return InputNoise(level * self.scale)

    @property
    def active(self) -> bool:
        """Whether there is noise."""
        return isinstance(self.scale, Tensor) or self.scale > 0


@dataclass(frozen=True)
class Hidden:
    """Entries of a data variable that the model may not read; the model reads its own mean instead.

    Args:
        entries: (B, T, 1 or D), or (B, D) of a static variable.
        detached: subset of the entries whose mean has no gradient, or None.
        fixed_frames: for each step, whether no sequence has such entries; None if this is not known without reading a
            tensor, which would synchronise a GPU.
    """

    entries: Tensor
    detached: Tensor | None = None
    fixed_frames: list[bool] | None = None

    def fill(self, value: Tensor, mean: Tensor, steps: int | slice = slice(None)) -> Tensor:
        """Return the value with the mean at these entries.

        Args:
            value: values of the variable, (B, T, D), or (B, D) for a single step.
            mean: the model's means, of the same shape.
            steps: steps of `value`, as an index or a slice of the T steps.
        """
        if self.detached is not None:
            mean = torch.where(self.detached[:, steps], mean.detach(), mean)
        return torch.where(self.entries[:, steps], mean, value)


@dataclass
class Rollout:
    """A run of a factorization over a batch: known values, and distributions and draws of the other variables.

    Args:
        factorization: factorization to run, generative or of the guide.
        conditionals: dictionary from child to `Conditional`.
        batch, length: B and T.
        values: known values: data, context, statics (B, D) and, once they are known, latents (B, T, D).
        data: names of the observed variables.
        lengths: (B,) valid steps of a ragged batch.
        observed: dictionary from data variable to (B, T, D), True where an entry was observed. At other entries, the
            model reads its own mean and the guide reads 0.
        present: dictionary from local latent to (B, T), False at steps where it is integrated out. Its density does not
            count there, and networks that read it also read this mask (`networks.base.presence`).
        prefix: dictionary from variables that the run continues to their first values (B, O, D).
        mean_emission: names of data variables that are set to their means instead of drawn.
        feeding: replacement for the data's history, a `ScheduledSampling` or `InputNoise`; None keeps the history.
        draws: current number of rows per sequence of the data (`fork`).
        drawing: draw the entries that the model may not read, instead of using its means.
        groups: groups of sequences that share the `grouped` variables; None if each sequence is its own group.
        grouped: names of static latents that groups share.
        sums: structure of the sum over discrete latents, if there are any.
        states: dictionary from discrete latent to drawn values, which draws of its readers use and densities ignore.
        given: name of the context of given entries (`views.Given`), if there is one.
    """

    factorization: Factorization
    conditionals: Mapping[str, Conditional]
    batch: int
    length: int
    values: dict[str, Tensor]
    data: frozenset[str] = frozenset()
    lengths: Tensor | None = None
    observed: Mapping[str, Tensor] = field(default_factory=dict)
    present: Mapping[str, Tensor] = field(default_factory=dict)
    prefix: Mapping[str, Tensor] = field(default_factory=dict)
    mean_emission: Collection[str] = ()
    feeding: ScheduledSampling | InputNoise | None = None
    draws: int = 1
    drawing: bool = False
    groups: Groups | None = None
    grouped: Collection[str] = ()
    sums: EnumerationPlan | None = None
    states: dict[str, Tensor] = field(default_factory=dict)
    given: str | None = None

    def __post_init__(self) -> None:
        _check_custom_masks(self.factorization, self.length)
        for conditional in self.conditionals.values():
            conditional.check(self.length)
        self._block = {name: block for block in self.factorization.blocks for name in block.names}
        self._draws: dict[str, Tensor] = {}
        self._evaluated: dict[str, tuple[Tensor, Parameters]] = {}
        self._pending = list(self.factorization.blocks)
        self._summation: Enumeration | None = None
        self._valid = None if self.lengths is None else valid_steps(self.lengths, self.length)[..., None]

    @cached_property
    def plate(self) -> Any:
        """Pyro's plate over the rows."""
        return pyro.plate("sequences" if self.draws == 1 else f"sequences x {self.draws}", self.batch, dim=-1)

    def fork(self, n: int) -> Rollout:
        """Return the run with every row repeated n times, draw by draw; itself for n = 1.

        Copies share all known values.
        """
        return self if n == 1 else self.repeat(n)

    def repeat(self, n: int) -> Rollout:
        """Return a new run with every row repeated n times, draw by draw."""

        def each(tensors: Any) -> Any:
            return {name: repeat_batch(value, n) for name, value in tensors.items()}

        return replace(
            self,
            batch=n * self.batch,
            draws=n * self.draws,
            values=each(self.values),
            states=each(self.states),
            lengths=None if self.lengths is None else self.lengths.repeat(n),
            observed=each(self.observed),
            present=each(self.present),
            prefix=each(self.prefix),
            groups=None if self.groups is None else self.groups.repeat(n),
        )

    def distribution(self, name: str, draws: int = 1) -> TorchDistribution:
        """Return the distribution of a variable, for its Pyro site.

        Args:
            name: name of the variable.
            draws: number of draws of a static variable, over the rows of `fork(draws)`. The network runs once for all
                draws. If it is random in training, such as a summary of a random window, all draws of a sequence share
                the result, as in a forecast.
        """
        if self.sums is not None and name in self.sums.readers:
            return Marginal(self, name)
        return self.conditional_distribution(name, draws)

    def conditional_distribution(self, name: str, draws: int = 1) -> TorchDistribution:
        """Return the distribution of a variable given drawn states of the summed-out latents; see `distribution`."""
        conditional = self.conditionals[name]
        if conditional.factor.local:
            return Sequence(self, name)
        parents, groups = {**self.known, **self.history(name)}, self.groups if name in self.grouped else None
        parameters = conditional(parents, self.batch, self.length, self.lengths, groups)
        distribution = conditional.distribution(tuple(p.repeat(draws, *[1] * (p.dim() - 1)) for p in parameters))
        mask = self.mask(name)
        distribution = (distribution if mask is None else distribution.mask(mask)).to_event(
            1 - len(distribution.event_shape)
        )
        return distribution if groups is None else Grouped(distribution, groups.repeat(draws))

    @property
    def known(self) -> dict[str, Tensor]:
        """Known values, with the presence masks of latents and the indicators of observed entries."""
        presences = {presence(name): steps for name, steps in self.present.items()}
        return {
            **self.states,
            **self.values,
            **presences,
            **{indicator(name): mask for name, mask in self.observed.items()},
        }

    def know(self, name: str, value: Tensor) -> None:
        """Record the value of a site, which later sites read.

        Args:
            name: name of the variable.
            value: (B, T, D), or (B, D) of a static variable.

        Raises:
            ValueError: if variables in the same loop were drawn with another value.
        """
        if name in self._draws and not _same(value, self._draws[name]):
            handed_out = self.values.keys() & self._draws.keys() & set(self._block[name].names)
            dependants = sorted(handed_out - {name})
            if dependants:
                raise ValueError(
                    f"{name} was set to a value after {', '.join(dependants)} had been drawn with another value "
                    f"of it; pass {name} to the model as data instead of conditioning on it"
                )
        self.values[name] = value

    def mask(self, name: str) -> Tensor | None:
        """Return True where a density of the variable counts, (B, T, D), or (B, T) for whole events; None if all count.

        For a static variable, the mask has no T.
        """
        conditional = self.conditionals[name]
        mask = self.observed.get(name)
        if name in self.present:
            mask = self.present[name][..., None].expand(-1, -1, conditional.size)
        if mask is not None and conditional.whole:
            mask = mask.all(-1)
        if self._valid is None or not conditional.factor.local:
            return mask
        valid = self._valid[..., 0] if conditional.whole else self._valid.expand(-1, -1, conditional.size)
        return valid if mask is None else mask & valid

    def evaluate(self, name: str, value: Tensor) -> TorchDistribution:
        """Return the conditional distributions of a local variable at all steps, batch shape (B, T, D) or (B, T).

        Args:
            name: name of the variable.
            value: (B, T, D), values of the variable, whose past the factor may read.
        """
        return self.conditionals[name].distribution(self.parameters(name, value))

    def parameters(self, name: str, value: Tensor) -> Parameters:
        """Return the parameters (B, T, ...) of `evaluate`; the result for the last value is kept."""
        if not self._is_evaluated(name, value):
            history = self.history(name)  # this may run a loop that evaluates the variable
            if not self._is_evaluated(name, value):
                parents = {**self.known, name: value, **history}
                self._evaluated[name] = (
                    value,
                    self.conditionals[name](parents, self.batch, self.length, self.lengths),
                )
        return self._evaluated[name][1]

    def _is_evaluated(self, name: str, value: Tensor) -> bool:
        return name in self._evaluated and self._evaluated[name][0] is value

    def draw(self, name: str) -> Tensor:
        """Draw (B, T, D) of a local variable, together with all variables in its loop over time."""
        if name not in self._draws or any(
            not _same(self.values.get(other, value), value)
            for other, value in self._draws.items()
            if other in self._block[name].names
        ):
            if self.sums is not None:
                self._draw_states(self._block[name])
            self._draws.update(self._run(self._block[name]))
            self.states |= {n: v for n, v in self._draws.items() if self.sums is not None and n in self.sums.sizes}
        return self._draws[name]

    def state(self, name: str) -> Tensor:
        """Draw a summed-out latent, (B, T, C) or (B, C), given the earlier draws."""
        if name not in self.states:
            local = self.conditionals[name].factor.local
            self.states[name] = self.draw(name) if local else self.conditional_distribution(name).sample()
        return self.states[name]

    def _draw_states(self, block: Block) -> None:
        """Draw the summed-out latents that a block reads, except those within the block."""
        for name in block.names:
            for parent in self.conditionals[name].parents:
                if self.sums is not None and parent in self.sums.sizes and parent not in block.names:
                    self.state(parent)

    @property
    def summation(self) -> Enumeration:
        """The sum over discrete latents, given all other variables."""
        assert self.sums is not None
        summation = self._summation
        if summation is None or any(summation.values.get(name) is not value for name, value in self.values.items()):
            self._summation = summation = Enumeration(self.sums, self)
        return summation

    @property
    def noisy(self) -> Collection[str]:
        """Names of the data variables with noise on their history."""
        return () if not isinstance(self.feeding, InputNoise) or not self.feeding.active else self.data

    def history(self, name: str) -> dict[str, Tensor]:
        """Return replacements for data that a variable may not read: the model's own means, or noisy data.

        Means are functions of parameters and latents. Their gradient is part of the gradient of the bound, unless
        scheduled sampling disables it.
        """
        if not self.hidden:
            return self._replacements
        with torch.set_grad_enabled(self._has_gradient and torch.is_grad_enabled()):
            while self._block[name] in self._pending:  # blocks read themselves and earlier ones
                self._replacements.update(self._replace_hidden(self._pending.pop(0)))
        return self._replacements

    @cached_property
    def _replacements(self) -> dict[str, Tensor]:
        """Dictionary from data variable to noisy data (B, T, D); `history` adds the model's means block by block."""
        noisy: dict[str, Tensor] = {}
        if not isinstance(self.feeding, InputNoise) or not self.feeding.active:
            return noisy
        for name in self.factorization.variables:  # a fixed order for the random draws
            if name in self.data and name in self.values and self.factorization.local(name):
                value, units = self.values[name], self.conditionals[name].units.get(name)
                noise = self.feeding.scale * torch.randn_like(value) * (1.0 if units is None else units.scale)
                noisy[name] = self._hide(value + noise)
        return noisy

    @cached_property
    def _has_gradient(self) -> bool:
        return any(hidden.detached is not hidden.entries for hidden in self.hidden.values())

    @cached_property
    def hidden(self) -> dict[str, Hidden]:
        """Data entries that the model may not read: missing ones, and frames that scheduled sampling replaces.

        Without variables whose steps are drawn jointly and that no variable reads, since they need no means.
        """
        read = {parent for each in self.conditionals.values() for parent in each.parents}
        unread = {name for name, each in self.conditionals.items() if each.joint} - read
        masks = {name: mask for name, mask in self.observed.items() if name in self.values and name not in unread}
        missing = {name: ~mask for name, mask in masks.items() if is_deferring() or not mask.all()}
        hidden = {name: Hidden(entries) for name, entries in missing.items()}
        if not isinstance(self.feeding, ScheduledSampling) or not self.feeding.active:
            return hidden
        replaced = self.feeding.frames(self.batch, self.length, next(iter(self.values.values())).device)
        for name in self.data & self.values.keys():
            if self.factorization.local(name):
                absent = missing.get(name)
                entries = replaced if absent is None else replaced | absent
                detached = None if self.feeding.gradient else replaced if absent is None else replaced & ~absent
                hidden[name] = Hidden(
                    entries, detached, self.feeding.fixed_frames(self.length) if absent is None else None
                )
        return hidden

    def _replace_hidden(self, block: Block) -> dict[str, Tensor]:
        """Return the data of a block with the model's means at the hidden entries."""
        names = [name for name in block.names if name in self.hidden]
        if not names:
            return {}
        feeding = self.feeding
        if not isinstance(feeding, ScheduledSampling) or feeding.passes is None or not feeding.active:
            return self._run(block, self._replacements, self.hidden)
        values = {**self.known, **self._replacements}
        for _ in range(feeding.passes):
            for name in names:
                conditional = self.conditionals[name]
                mean = conditional.mean(conditional(values, self.batch, self.length, self.lengths))
                values[name] = self._hide(self.hidden[name].fill(self.values[name], mean))
        return {name: values[name] for name in names}

    def _run(
        self, block: Block, replacements: Mapping[str, Tensor] | None = None, hidden: Mapping[str, Hidden] | None = None
    ) -> dict[str, Tensor]:
        """Draw the unknown variables of a block, or fill in hidden entries of its data, (B, T, D) by name.

        Args:
            block: variables that are computed in one loop over time.
            replacements: values that the block reads in place of known ones.
            hidden: entries of the block's data to replace by the model's means; None to draw the unknown variables.
        """
        known = self.values.keys() | self.states.keys()
        live = [name for name in block.names if (name not in known if hidden is None else name in hidden)]
        values = {**self.known, **(replacements or {})}
        inputs = {name: value for name, value in values.items() if name not in live}
        loop = any(parent in live for name in live for parent in self.conditionals[name].parents)
        noise = {
            name: self.conditionals[name].head.noise(
                (self.batch, self.length, self.conditionals[name].size), like(self.conditionals[name])
            )
            for name in live
            if (hidden is None or self.drawing) and name not in self.mean_emission
        }
        if loop:
            return self._loop(block, live, inputs, noise, hidden, self.prefix if hidden is None else values)
        draws = {}
        for name in live:
            conditional = self.conditionals[name]
            if conditional.joint and name in self.prefix:
                raise ValueError(
                    f"{conditional.factor} draws all steps of {name} jointly, and not given some of them; make the "
                    "past context (dvae.data.views.Past), or use a distribution of single steps"
                )
            parameters = conditional(inputs, self.batch, self.length, self.lengths)
            drawing = name in noise
            value = conditional.draw(parameters, noise[name]) if drawing else conditional.mean(parameters)
            if hidden is not None:
                value = hidden[name].fill(values[name], value)
            elif name in self.prefix:
                n_known = self.prefix[name].shape[1]
                value = torch.cat([self._continue(name, slice(n_known), value[:, :n_known]), value[:, n_known:]], dim=1)
            draws[name] = self._hide(value)
            if hidden is None:
                self._evaluated[name] = (draws[name], parameters)
        return draws

    @memoizing()
    def _loop(
        self,
        block: Block,
        live: list[str],
        inputs: Mapping[str, Tensor],
        noise: Mapping[str, Tensor],
        hidden: Mapping[str, Hidden] | None,
        targets: Mapping[str, Tensor],
    ) -> dict[str, Tensor]:
        draw = {name: self.conditionals[name].drawing for name in live}
        states = {name: self.conditionals[name].start(inputs, self.batch, self.length, self.lengths) for name in live}
        padded = self._valid is not None and block.direction < 0  # a backward loop starts in the padding
        if len(live) == 1 and hidden is None and not padded and live[0] in noise and live[0] not in self.prefix:
            name = live[0]
            chain = self.conditionals[name].chain(states[name], block.direction, noise[name])
            if chain is not None:
                value = self._hide(chain[0])
                self._evaluated[name] = (value, chain[1])
                return {name: value}
        draws: dict[str, list[Tensor]] = {name: [None] * self.length for name in live}  # type: ignore[list-item]
        evaluated: dict[str, list[Parameters]] = {name: [] for name in live}
        steps = {name: values.unbind(1) for name, values in noise.items()}
        is_known = self._known_steps(live, hidden, targets)
        # keep parameters only for scoring: neither for a future nor for replacements of the data
        keep = not self.prefix if hidden is None else self._has_gradient
        for first, count in _runs(is_known, block.direction):
            t = first + count - 1
            end = t + is_known[t]
            for name in live if end > first else ():
                chunk = targets[name] if end - first == targets[name].shape[1] else targets[name][:, first:end]
                draws[name][first:end] = steps_of(chunk)
            for name in live:
                conditional = self.conditionals[name]
                if count > 1 and keep:
                    at_all, states[name] = conditional.forward_chunk(states[name], first, count, draws)
                    parameters = tuple(p[:, -1] for p in at_all)
                else:
                    parameters, states[name] = conditional.step(states[name], t, draws, count)
                    at_all = tuple(p[:, None] for p in parameters)
                evaluated[name] += [at_all] if keep else []
                if is_known[t]:
                    continue
                drawing = name in steps
                value = draw[name](parameters, steps[name][t]) if drawing else conditional.mean(parameters)
                if hidden is not None:
                    value = hidden[name].fill(targets[name][:, t], value, t)
                elif name in self.prefix and t < self.prefix[name].shape[1]:
                    value = self._continue(name, t, value)
                if padded:
                    value = value * self._valid[:, t]  # type: ignore[index]
                draws[name][t] = value
        values = {name: self._hide(torch.stack(draws[name], dim=1)) for name in live}
        if keep:
            for name in live:
                in_time = evaluated[name] if block.direction >= 0 else evaluated[name][::-1]
                stacked = tuple(torch.cat(p, dim=1) for p in zip(*in_time, strict=True))
                self._evaluated[name] = (values[name] if hidden is None else self.values[name], stacked)
        return values

    def _known_steps(
        self, live: list[str], hidden: Mapping[str, Hidden] | None, values: Mapping[str, Tensor]
    ) -> list[bool]:
        """Return for each step whether all values of a loop are known for every sequence.

        Args:
            live: names of the variables that the loop computes.
            hidden: hidden entries of data by name, as in `_run`.
            values: known values by name, (B, T, D).
        """
        if any(name not in values for name in live):
            return [False] * self.length
        end = min(values[name].shape[1] for name in live)
        is_known, masks = [True] * end, []
        for name in live:
            if hidden is not None and (fixed := hidden[name].fixed_frames) is not None:
                is_known = [a and b for a, b in zip(is_known, fixed, strict=False)]
            elif (mask := self.observed.get(name) if hidden is None else ~hidden[name].entries) is not None:
                masks.append(mask[:, :end].all(-1).all(0))
        if masks and is_deferring():  # computes all steps, and `fill` keeps the known values
            is_known = [False] * end
        elif masks:
            is_known = [a and b for a, b in zip(is_known, torch.stack(masks).all(0).tolist(), strict=True)]
        return is_known + [False] * (self.length - end)

    def _continue(self, name: str, steps: int | slice, value: Tensor) -> Tensor:
        """Return the known first values of a variable at some steps, with `value` at missing entries."""
        values = self.prefix[name][:, steps]
        return torch.where(self.observed[name][:, steps], values, value) if name in self.observed else values

    def _hide(self, value: Tensor) -> Tensor:
        return value if self._valid is None or value.dim() == 2 else value * self._valid


class Sequence(TorchDistribution):
    """The distribution of a local variable in one run, with batch shape (B,) and event shape (T, D).

    `rsample` draws step by step if the factorization requires it. `log_prob` evaluates all steps at once, given the
    other values of the run.

    Args:
        rollout: the run.
        name: name of the variable.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    def __init__(self, rollout: Rollout, name: str):
        self.rollout = rollout
        self.name = name
        self.has_rsample = rollout.conditionals[name].reparameterised
        size = rollout.conditionals[name].size
        super().__init__(torch.Size([rollout.batch]), torch.Size([rollout.length, size]), validate_args=False)

    @constraints.dependent_property(is_discrete=False, event_dim=2)
    def support(self) -> constraints.Constraint:
        """Real sequences."""
        return constraints.independent(constraints.real, 2)

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Draw (B, T, D), together with the variables in the same loop over time."""
        if sample_shape:
            raise NotImplementedError(
                f"a Sequence draws one batch at a time, got sample_shape {tuple(sample_shape)}; repeat the "
                "batch, as forecast(samples=...) and iwae_bound(particles=...) do"
            )
        return self.rollout.draw(self.name)

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Draw as `rsample`, without a gradient; variables drawn in the same loop keep their gradients."""
        return self.rsample(sample_shape).detach()

    def steps(self, value: Tensor) -> TorchDistribution:
        """Return the conditionals at all steps, given `value` and the other values of the run (`Rollout.evaluate`)."""
        return self.rollout.evaluate(self.name, value)

    def given(self, value: Tensor) -> TorchDistribution:
        """Return `steps` with padding and missing entries masked out: batch shape (B,), event shape (T, D)."""
        base, mask = self.steps(value), self.rollout.mask(self.name)
        return (base if mask is None else base.mask(mask)).to_event(2 - len(base.event_shape))

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density of each sequence, (B,)."""
        return self.given(value).log_prob(self.scored(value))

    def by_step(self, value: Tensor) -> Tensor:
        """Return `log_prob` of each step, (B, T)."""
        return self.counted(self.steps(value).log_prob(self.scored(value)))

    def counted(self, entries: Tensor) -> Tensor:
        """Sum entries (B, T, D), or steps (B, T), over D without those that do not count; returns (B, T)."""
        mask = self.rollout.mask(self.name)
        # `where` instead of a product: an uncounted entry may be infinite
        entries = entries if mask is None else torch.where(mask, entries, 0.0)
        return entries.sum(-1) if entries.dim() == 3 else entries

    def scored(self, value: Tensor) -> Tensor:
        """Return the value whose density is evaluated (`Conditional.scored`)."""
        return self.rollout.conditionals[self.name].scored(value, self.rollout.mask(self.name))

    def expand(self, batch_shape: Any, _instance: object = None) -> Sequence:
        """Return the distribution itself; any other batch shape raises an error."""
        if torch.Size(batch_shape) != self.batch_shape:
            raise NotImplementedError(
                f"a Sequence of batch {tuple(self.batch_shape)} cannot be expanded to {tuple(batch_shape)}; "
                "repeat the batch for vectorised particles (iwae_bound(particles=...))"
            )
        return self


class Marginal(Sequence):
    """The distribution of a variable that reads summed-out latents; event shape (T, D), or (D,) if static.

    Its density is conditional on all earlier variables and marginal over the states. Its draws read drawn states.
    """

    def __init__(self, rollout: Rollout, name: str):
        super().__init__(rollout, name)
        if not rollout.conditionals[name].factor.local:
            self._event_shape = self._event_shape[1:]

    @constraints.dependent_property(is_discrete=False)
    def support(self) -> constraints.Constraint:
        """Real values."""
        return constraints.independent(constraints.real, len(self._event_shape))

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Draw (B, T, D) or (B, D)."""
        if len(self._event_shape) == 2:
            return super().rsample(sample_shape)
        for parent in self.rollout.conditionals[self.name].parents:
            if parent in self.rollout.sums.sizes:  # type: ignore[union-attr]
                self.rollout.state(parent)
        distribution = self.rollout.conditional_distribution(self.name)
        return distribution.rsample() if distribution.has_rsample else distribution.sample()  # type: ignore[no-any-return]

    def steps(self, value: Tensor) -> TorchDistribution:
        """Raise an error: with states summed out, steps depend on one another."""
        raise NotImplementedError(
            f"{self.name} reads latents that are summed out, so its steps depend on one another and have no separate "
            "distributions; use log_prob or by_step"
        )

    def by_step(self, value: Tensor) -> Tensor:
        """Return the log density of each step given all earlier ones, (B, T), or (B,) if static."""
        run = self.rollout
        if run.values.get(self.name) is not value:
            run = replace(run, values={**run.values, self.name: value})
        return run.summation.shares[self.name]

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density of each sequence, (B,)."""
        return self.by_step(value).flatten(1).sum(-1) if len(self._event_shape) == 2 else self.by_step(value)


def _runs(is_known: list[bool], direction: int) -> Iterator[tuple[int, int]]:
    """Yield the first step and the number of steps of each evaluation in a loop.

    Forward in time, consecutive steps with known values are evaluated together with the step after them. The parameters
    of that step read only known values and earlier draws at the same step. Backward in time, each step is evaluated
    alone.

    Args:
        is_known: for each step, whether its values are known.
        direction: 1 if the loop runs forward in time, -1 if it runs backward.
    """
    if direction < 0:
        yield from ((t, 1) for t in reversed(range(len(is_known))))
        return
    t = 0
    while t < len(is_known):
        end = next((s for s in range(t, len(is_known)) if not is_known[s]), len(is_known))
        count = max(min(end + 1, len(is_known)) - t, 1)
        yield t, count
        t += count


@lru_cache(maxsize=1024)
def _check_custom_masks(factorization: Factorization, length: int) -> None:
    """Check that no custom mask reads values that its loop has not drawn yet, at this length."""
    for block in factorization.blocks:
        for i, name in enumerate(block.names if block.direction else ()):
            for parent in factorization.factor(name).parents:
                if parent.name not in block.names or parent.relation is None or parent.relation.intervals is not None:
                    continue
                available = np.tri(length, k=0 if parent.name in block.names[:i] else -1, dtype=bool)
                ahead = parent.relation.mask(length) & ~(available if block.direction > 0 else available.T)
                if ahead.any():
                    t, s = np.argwhere(ahead)[0] + 1
                    raise ValueError(
                        f"the mask {parent.relation} of {factorization.factor(name)} reads {parent.name}_{s} at t={t} "
                        f"of {length} steps, but {parent.name}_{s} is drawn after {name}_{t}; the mask must have the "
                        "same direction in time at every length"
                    )


def _same(value: Tensor, draw: Tensor) -> bool:
    """Return whether a site's value equals the draw; tensors may differ, since Pyro may detach the draw."""
    return value is draw or torch.equal(value, draw)
