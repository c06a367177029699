"""Particles: weighted draws of the latents, moved forward step by step, for any factorization.

    w_t = p(z_t | .) p(x_t | .) / q(z_t | .)

The proposal q of a latent is its guide, or its generative distribution (a bootstrap filter), and then it leaves the
weight. `DynamicalVAE.filter` and `fivo_bound` run the same steps. Discrete latents are summed out for each particle by
the forward algorithm (`enumeration`). A model whose latents are all discrete therefore has an exact filter, with one
particle.

A bound knows all data before the first step. A stream does not. Its particles keep a window of recent values, as long
as the largest lag in the equations, and networks read the values in this window at a fixed position.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import nullcontext
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import one_hot

from ..distributions.base import Parameters
from ..factorization.notation import Factor, Parent
from ..locking import seeded
from ..networks.base import indicator, presence
from ..networks.loop import Rows, histories, memoizing, pick, select, valid_steps
from .conditional import Conditional, like
from .rollout import Rollout


class Particles:
    """K particles of every sequence; row k B + b of their N = K B rows is particle k of sequence b.

    Args:
        model: model with its guide.
        known: run with the values that are known before the first step.
        particles: K, number of particles.
        proposal: "guide" or "prior" for each latent; by default the guide for all.
        live: whether data and local context are added step by step (`feed`); `known` then has static values only, and
            its length is the number of steps in the window.
        lag: largest lag of `state_probabilities`; the window must be longer.
    """

    def __init__(
        self,
        model: Any,
        known: Rollout,
        particles: int,
        proposal: Mapping[str, str] | None = None,
        live: bool = False,
        lag: int = 0,
    ):
        self.model, self.known, self.particles, self.live, self.lag = model, known, particles, live, lag
        sums = model.sums
        self.shape = (sums.n_static_states, sums.width**sums.lag, sums.width) if sums else (1, 1, 1)
        """M, K^L and K: numbers of joint discrete states, of the static ones, a window of L steps, and a step."""
        self.proposal = dict(dict.fromkeys(model.latents, "guide") if proposal is None else proposal)
        self.order = [name for block in model.generative.blocks for name in block.names]
        self.data_names = self._local(model.observed)
        drawn = {*model.latents, *model.summed, *self.data_names}
        self.instant = {
            factor.child: {p.name for p in factor.parents if p.name in drawn and reads_now(p)}
            for factor in model.generative.factors
        }
        """Variables of the same step that each variable reads."""
        self.drawn_names = self._local(model.latents)
        self.read_now = {name for names in self.instant.values() for name in names}
        missing = hidden_data(known)
        self.hidden = [
            n for n in self.data_names if live or n in missing or (proposal is not None and n in self.read_now)
        ]
        self.shared = {name: value for name, value in known.values.items() if name not in self.hidden}
        self.late = late_statics(model) if proposal is None else set()
        self.log_weights = like(model).new_zeros(particles, known.batch)
        self.sequence = torch.arange(known.batch, device=self.log_weights.device).repeat(particles)
        self.statics: dict[str, Rows] = {}
        self.paths = self._slots([*self.drawn_names, *self.hidden])
        if live:
            local = [*self.data_names, *(name for name in model.context if model.reader.local[name])]
            names = [*local, *map(indicator, local), *map(presence, self.drawn_names)]
            self.data: dict[str, Any] = {name: [None] * known.length for name in names}
            self.masks: dict[str, Any] = {name: [None] * known.length for name in self._local(self.order)}
        else:
            self.data = {name: self._by_step(known.values[name]) for name in self.data_names}
            masks = {name: known.mask(name) for name in self._local(self.order)}
            self.masks = {name: None if mask is None else self._by_step(mask) for name, mask in masks.items()}
            empty = self._slots(self.hidden)
            self.data |= {presence(name): self._by_step(present) for name, present in known.present.items()}
            self.data |= {
                indicator(n): self._by_step(known.observed[n]) if n in missing else empty[n] for n in self.hidden
            }
        self.position = -1
        self.noise: dict[str, Tensor] = {}
        self.ahead: dict[str, Parameters] = {}

    def _local(self, names: Any) -> list[str]:
        return [name for name in names if self.model.generative.local(name)]

    def _slots(self, names: list[str]) -> dict[str, Rows]:
        return {name: Rows([None] * self.known.length) for name in names}

    def _by_step(self, values: Tensor) -> Rows:
        return Rows(values.unbind(1)).select(self.sequence)

    # The steps ----------------------------------------------------------------------------------------------------

    def start(self) -> Tensor:
        """Draw the static latents that precede the steps, prepare the networks of all steps, and `normalise`."""
        model = self.model
        self.log_weights = self._draw_statics(late=False).view(self.particles, -1) - math.log(self.particles)
        with memoizing():
            self.guide = {
                name: self._stepwise(model.encoder[name], self.known.values)
                for name in self._local(model.latents)
                if self.proposal[name] == "guide"
            }
            self.prior = {name: self._stepwise(model.generator[name], self.shared) for name in self._local(self.order)}
        self.states = self._start_states()
        self.joint = self._joint()
        self.past_states = self._slots(["joint", "logs"] if self.lag and model.summed else [])
        self.adopts = not self.guide and not self.read_now & {*self.data_names}
        """Whether predictions and weights need the same draws and network evaluations, as in a bootstrap filter."""
        return self.normalise()

    def normalise(self) -> Tensor:
        """Normalise the weights, and return the log of their sum (B,): the log evidence since the last call."""
        self.log_weights, total, self.effective = normalise(self.log_weights)
        return total

    def begin(self, resample_below: float, valid: Tensor | None = None) -> Tensor:
        """Move to the next step: resample, and draw the noise of the step; return where particles were resampled.

        Args:
            resample_below: share of the particles; the effective sample size below which they are resampled.
            valid: (B,), False for sequences that have ended; None if none has.
        """
        low = self.effective < resample_below * self.particles
        low = low if valid is None else low & valid
        if self.position < 0 and not self.statics:
            low = torch.zeros_like(low)
        if self.particles > 1 and low.any():
            self._select(ancestors(self.log_weights, low))
            self.log_weights = self.log_weights.masked_fill(low, -math.log(self.particles))
        if self.position == self.known.length - 1:
            for values in (*self.data.values(), *self.masks.values()):
                del values[0]
                values.append(None)
            states = [each.state for each in (*self.guide.values(), *self.prior.values()) if each.has_history]
            for rows in (*self.paths.values(), *self.past_states.values(), *histories(states)):
                rows.slide()
        self.position = min(self.position + 1, self.known.length - 1)
        self.noise = {name: self._noise(self.model.encoder[name]) for name in self.drawn_names}
        self.ahead = {}
        return low

    def _select(self, rows: Tensor | None) -> None:
        """Replace particles by those with these rows (N,), or by copies."""
        names = "statics", "paths", "guide", "prior", *(("states", "past_states") if self.model.summed else ())
        vars(self).update(zip(names, select([getattr(self, name) for name in names], rows), strict=True))

    def fork(self) -> Particles:
        """Return a copy whose steps do not change these particles."""
        forked = copy(self)
        forked._select(None)
        forked.data, forked.masks = ({n: [*v] for n, v in values.items()} for values in (self.data, self.masks))
        return forked

    def feed(self, run: Rollout, t: int, names: list[str]) -> None:
        """Add values of local variables at a step, and their masks, to the window of a stream.

        Args:
            run: run with these values.
            t: step of the run.
            names: names of data or context.
        """
        for name in names:
            observed: Tensor | None = None
            self.data[name][self.position] = pick(run.values[name][:, t], self.sequence)
            if name in run.observed and not run.observed[name][:, t].all():
                observed = pick(run.observed[name][:, t], self.sequence)
            self.data[indicator(name)][self.position] = observed
        for name, present in run.present.items():
            self.data[presence(name)][self.position] = pick(present[:, t], self.sequence)
        for name, masks in self.masks.items():
            mask = run.mask(name)
            masks[self.position] = None if mask is None else pick(mask[:, t], self.sequence)

    def weigh(self) -> Tensor:
        """Draw the latents at the step from their proposals, and update and `normalise` the weights."""
        t, total = self.position, self.log_weights.new_zeros(len(self.sequence))
        reads = {**self.paths, **self.data}  # the guide reads data as given, and the model its means where they miss
        for name, each in self.guide.items():
            parameters = each.step(t, reads)
            self.paths[name][t] = each.conditional.draw(parameters, self.noise[name])
            total = total - _log_prob(each.conditional, parameters, self.paths[name][t], _at(self.masks[name], t))
        history, start = {**self.data, **self.paths}, self._joint()
        logs = torch.zeros_like(start)
        for name, each in self.prior.items():
            parameters = self.ahead[name] if name in self.ahead else each.step(t, history)
            if name in self.model.summed:
                logs = logs + each.logits(parameters, t)
                continue
            is_drawn = self.proposal.get(name) == "prior"
            if is_drawn and not (self.adopts and self.ahead):
                self.paths[name][t] = self._draw(each, parameters, name, start + logs)
            value, mask = self.data[name][t] if name in self.data else self.paths[name][t], _at(self.masks[name], t)
            if each.places is None:
                share = 0.0 if is_drawn else _log_prob(each.conditional, parameters, value, mask)
            else:
                before, logs = (start + logs).logsumexp(1), logs + each.densities(parameters, value, mask, t)
                share = 0.0 if is_drawn else (start + logs).logsumexp(1) - before
            total = total + share
            if name in self.hidden:  # the model reads its own mean where x is missing
                observed = self.data[indicator(name)][t]
                if observed is not None and each.places is None:
                    value = torch.where(observed, value, each.conditional.mean(parameters))
                self.paths[name][t] = value
        self.log_weights = self.log_weights + total.view_as(self.log_weights)
        if self.model.summed:
            self.joint = (start + logs).log_softmax(1)
            for name in self.past_states:
                self.past_states[name][t] = self.joint if name == "joint" else logs
            windows = self.joint.unflatten(1, self.shape)
            if self.shape[1] > 1:  # forget the oldest step of the window
                windows = windows.flatten(-2).unflatten(-1, (self.shape[2], -1)).movedim(-2, -1)
            self.states = windows.logsumexp(-1)
        return self.normalise()

    def predict(self) -> dict[str, tuple[Conditional, Parameters, Tensor]]:
        """Return the distribution of each local data variable at the step, before its data are used.

        Each is a mixture of C components per sequence: its conditional, its parameters (C B, ...) and the log weights
        (C, B). Latents are drawn from the model, with the noise of the step.
        """
        t, joint, result, history = self.position, self._joint(), {}, {**self.data, **self.paths}
        with nullcontext() if self.adopts else seeded(None, joint.device):  # later draws stay the same
            for name, each in self.prior.items():
                if self.adopts or not (self.instant[name] or each.places is not None):
                    parameters = self.ahead[name] = each.step(t, history)
                else:
                    parameters = each.select(None).step(t, history)
                if name in self.model.summed:
                    joint = joint + each.logits(parameters, t)
                    continue
                if name in self.data_names:
                    result[name] = each.conditional, parameters, self._component_weights(each, joint, t)
                    if name not in self.read_now:
                        continue
                value = self._draw(each, parameters, name, joint)
                if each.places is not None:
                    joint = joint + each.densities(parameters, value, None, t)
                if self.adopts:
                    self.paths[name][t] = value
                else:
                    history[name] = history[name].replaced(t, value)
        return result

    def _draw(self, each: Stepwise, parameters: Parameters, name: str, joint: Tensor) -> Tensor:
        """Draw values (N, D) of a variable from the model, given the joint weights of discrete states."""
        if each.places is not None:
            place = each.place(self.position)[torch.multinomial(joint.softmax(1), 1)[:, 0]]
            rows = place * len(place) + torch.arange(len(place), device=place.device)
            parameters = tuple(pick(p, rows) for p in parameters)
        return each.conditional.draw(
            parameters, self.noise[name] if name in self.noise else self._noise(each.conditional)
        )

    def _component_weights(self, each: Stepwise, joint: Tensor, t: int) -> Tensor:
        """Return normalised log weights (C, B) of the components of a mixture."""
        weights = self.log_weights
        if each.places is None:
            return weights
        place = each.place(t).expand(len(joint), -1)
        shares = joint.new_zeros(len(joint), each.patterns).scatter_add(1, place, joint.softmax(1))
        return (shares.t().log().unflatten(1, weights.shape) + weights).flatten(0, 1)

    def run(self, resample_below: float) -> tuple[Tensor, Tensor, Tensor]:
        """Run all steps; afterwards `drawn` contains the draws of the surviving particles.

        Args:
            resample_below: share of the particles; the effective sample size below which they are resampled.

        Returns:
            The log of the estimated evidence (B,), the effective sample sizes (T, B), NaN at padding, and the number of
            resamplings (B,).
        """
        bound, effective, length = self.start(), [], self.known.length
        resamplings = torch.zeros_like(bound, dtype=torch.long)
        valid = None if self.known.lengths is None else valid_steps(self.known.lengths, length).t()
        for t in range(length):
            resamplings += self.begin(resample_below, None if valid is None else valid[t])
            bound = bound + self.weigh()
            effective.append(self.effective if valid is None else self.effective.masked_fill(~valid[t], math.nan))
        late = self._draw_statics(late=True).view_as(self.log_weights)
        return bound + (self.log_weights + late).logsumexp(0), torch.stack(effective), resamplings

    @property
    def drawn(self) -> dict[str, Tensor]:
        """Latents (N, T, D) by name, or (N, D) if static, of the particles and their ancestors.

        Data with missing entries are included, because the model reads its own means there.
        """
        stacked = {name: torch.stack(list(path), 1) for name, path in self.paths.items() if path[-1] is not None}
        if self.known.lengths is not None:
            valid = valid_steps(self.known.lengths[self.sequence], self.known.length)[..., None]
            stacked = {name: value * valid for name, value in stacked.items()}
        return {**{name: rows[0] for name, rows in self.statics.items()}, **stacked}

    def summary(self, lag: int) -> dict[str, dict[str, Tensor]]:
        """Return moments (B, D) of each latent, and of states their probabilities, `lag` steps ago given all data."""
        weights, values = self.log_weights.exp()[..., None], self.latents(lag)
        moments = {
            name: moments_of_mixture(value.reshape(*weights.shape[:2], -1), 0.0, weights)
            for name, value in values.items()
        }
        mean, variance = ({name: pair[i] for name, pair in moments.items()} for i in range(2))
        return {"mean": mean, "variance": variance, "states": self.state_probabilities(lag)}

    def latents(self, lag: int = 0) -> dict[str, Tensor]:
        """Return the draws (N, D) of each latent `lag` steps ago, of the ancestors; NaN where it is integrated out."""
        t, draws = max(self.position - lag, 0), dict[str, Tensor]()
        for name in self.model.latents:
            draws[name] = self.paths[name][t] if name in self.paths else self.statics[name][0]
            present = self.data[presence(name)][t] if presence(name) in self.data else None
            if present is not None:
                draws[name] = torch.where(present[:, None], draws[name], torch.nan)
        return draws

    # Discrete states ----------------------------------------------------------------------------------------------

    def _start_states(self) -> Tensor:
        """Return log weights (N, M, K^L) of the discrete states before the first step."""
        total = self.log_weights.new_zeros(len(self.sequence), *self.shape).flatten(1)
        for name in self.model.sums.windows if self.model.sums else ():
            if not self.model.generative.local(name):
                each = self._stepwise(self.model.generator[name], self.shared)
                if name in self.model.summed:
                    total = total + each.logits(each.state, 0)
                else:
                    total = total + each.densities(each.state, pick(self.shared[name], self.sequence), None, 0)
        static = total.unflatten(1, self.shape)[..., :1, 0]
        self.log_weights = self.log_weights + static.logsumexp((1, 2)).view_as(self.log_weights)
        return static.expand(-1, *self.shape[:2])

    def state_probabilities(self, lag: int) -> dict[str, Tensor]:
        """Return probabilities (B, C) of the discrete latents `lag` steps ago, given the data so far."""
        t, sums = self.position, self.model.sums
        if sums is None:
            return {}
        joint, later = self.joint, torch.zeros_like(self.states)
        for s in range(t, max(t - lag, 0), -1):  # `later` is the log density of later data given the states so far
            later = (self.past_states["logs"][s].unflatten(1, self.shape) + self._following(later)).logsumexp(-1)
            joint = self.past_states["joint"][s - 1] + self._following(later).flatten(1)
        weights = self.log_weights.exp()[..., None]
        total = (joint.softmax(1).unflatten(0, weights.shape[:2]) * weights).sum(0)
        names = [*sums.statics, *(f"{name} {i}" for i in range(sums.lag, -1, -1) for name in sums.chain)]
        total = total.unflatten(1, [sums.sizes[name.split(" ")[0]] for name in names])
        axes = {n: names.index(n if n in sums.statics else f"{n} 0") + 1 for n in sums.sizes}
        return {n: total.movedim(axis, 1).flatten(2).sum(2) if len(names) > 1 else total for n, axis in axes.items()}

    def _following(self, values: Tensor) -> Tensor:
        """Return values (N, M, K^L) of the windows after a step, for the windows and states at it, (N, M, K^L, K)."""
        _, windows, width = self.shape
        if windows == 1:
            return values[..., None].expand(*values.shape, width)
        return values[:, :, None].expand(-1, -1, width, -1).flatten(2).unflatten(2, (-1, width))

    def _joint(self) -> Tensor:
        """Return log weights (N, J) of the joint discrete states, before any variable of the step."""
        if not self.model.summed:
            return self.states[..., 0]
        return self.states[..., None].expand(*self.states.shape, self.shape[2]).flatten(1)

    # Static variables, and networks -------------------------------------------------------------------------------

    def _draw_statics(self, late: bool) -> Tensor:
        """Draw the static latents that precede the steps, or follow them if `late`, and return log weights (N,)."""
        model, total = self.model, self.log_weights.new_zeros(len(self.sequence))
        for name in model.latents:
            if not model.generative.local(name) and (name in self.late) == late and self.proposal[name] == "guide":
                conditional = model.encoder[name]
                parameters = self._parameters(conditional, self.known.values)
                self.statics[name] = Rows([conditional.draw(parameters, self._noise(conditional))])
                total = total - _log_prob(conditional, parameters, self.statics[name][0])
        for name in self.order:
            factor, conditional = model.generative.factor(name), model.generator[name]
            summed = model.sums is not None and name in model.sums.windows
            if factor.local or summed or _involves(factor, {*self.late, *self.paths}) != late:
                continue
            parameters = self._parameters(conditional, self.shared)
            if self.proposal.get(name) == "prior":
                self.statics[name] = Rows([conditional.draw(parameters, self._noise(conditional))])
                continue
            value = self.statics[name][0] if name in self.statics else pick(self.shared[name], self.sequence)
            total = total + _log_prob(conditional, parameters, value)
        return total

    def _noise(self, conditional: Conditional) -> Tensor:
        noise: Tensor = conditional.head.noise((len(self.sequence), conditional.size), self.log_weights)
        return noise

    def _parameters(self, conditional: Conditional, shared: Mapping[str, Tensor]) -> Parameters:
        """Return the parameters (N, D) of a static variable for all particles.

        Args:
            conditional: conditional of the variable.
            shared: values by name that all particles of a sequence share, (B, ...).
        """
        parents, size, lengths, rows = self._known_parents(conditional, shared)
        return tuple(pick(p, rows) for p in conditional(parents, size, self.known.length, lengths))

    def _stepwise(self, conditional: Conditional, shared: Mapping[str, Tensor]) -> Stepwise:
        parents, size, lengths, rows = self._known_parents(conditional, shared)
        name, sums, places, patterns = conditional.factor.child, self.model.sums, None, 1
        if sums is not None and name in sums.windows and conditional is self.model.generator[name]:
            states, places = sums.placed(sums.windows[name], self.known.length, self.sequence.device)
            patterns = max(len(next(iter(states.values()), ())), 1)
            parents = {n: pick(v, rows.repeat(patterns)) for n, v in parents.items()}
            parents |= {
                n: one_hot(v, sums.sizes[n]).to(like(conditional)).repeat_interleave(len(rows), 0)
                for n, v in states.items()
            }
            lengths = None if lengths is None else lengths[rows.repeat(patterns)]
            size = patterns * len(rows)
            rows = torch.arange(size, device=rows.device)
        reads = [name for name in conditional.parents if name not in parents]
        if not reads and not conditional.factor.local:
            return Stepwise(conditional, conditional(parents, size, self.known.length, lengths), [], places, patterns)
        if not reads:
            parameters = conditional(parents, size, self.known.length, lengths)
            return Stepwise(
                conditional, select([p.unbind(1) for p in parameters], rows), [], places, patterns, len(rows)
            )
        if conditional.head.residual:
            reads.append(conditional.factor.child)
        if self.live:
            added = [*map(presence, reads), *map(indicator, conditional.indicators)]
            reads += [name for name in added if name in self.data]
            if is_windowed(conditional):
                parents = {n: pick(value, rows) for n, value in parents.items()}
                return Stepwise(conditional, None, reads, places, patterns, len(rows), parents)
        state = conditional.start(parents, size, self.known.length, lengths)
        state, has_history = conditional.select(state, rows), any(True for _ in histories(state))
        return Stepwise(conditional, state, reads, places, patterns, len(rows), has_history=has_history)

    def _known_parents(
        self, conditional: Conditional, shared: Mapping[str, Tensor]
    ) -> tuple[dict[str, Tensor], int, Tensor | None, Tensor]:
        """Return the parents known before the steps, their number of rows, their lengths, and each particle's row.

        Parents shared by all particles of a sequence have one row per sequence.
        """
        lengths, observed = self.known.lengths, self.known.observed
        indicators = {
            presence(name): steps for name, steps in self.known.present.items() if name in conditional.parents
        }
        indicators |= {indicator(name): observed[name] for name in conditional.indicators if name in observed}
        parents = {**{name: shared[name] for name in conditional.parents if name in shared}, **indicators}
        particle_parents = {
            name: value for name, value in self.drawn.items() if name in conditional.parents and name not in shared
        }
        if not particle_parents:
            return parents, self.known.batch, lengths, self.sequence
        parents = {name: pick(value, self.sequence) for name, value in parents.items()} | particle_parents
        rows = torch.arange(len(self.sequence), device=self.sequence.device)
        return parents, len(rows), None if lengths is None else lengths[self.sequence], rows


@dataclass
class Stepwise:
    """Conditional of a local variable for all particles, evaluated step by step.

    Args:
        conditional: conditional of the variable.
        state: state of its network; its parameters by step if `reads` is empty; None if it is evaluated anew over the
            window at each step.
        reads: names of the parents drawn in the steps.
        places: index (T or 1, J) of the pattern that contains each joint state of the discrete latents (`enumeration`);
            None if the variable does not read them.
        patterns: n, number of patterns; row p N + i of the parameters is pattern p of particle i.
        rows: n N, number of rows.
        given: parents that do not change, for a conditional without a state.
        has_history: whether the state contains draws of earlier steps.
    """

    conditional: Conditional
    state: Any
    reads: list[str]
    places: Tensor | None = None
    patterns: int = 1
    rows: int = 0
    given: Mapping[str, Tensor] | None = None
    has_history: bool = False

    def step(self, t: int, history: Mapping[str, Any]) -> Parameters:
        """Return the distribution's parameters (n N, D) at step t."""
        if not self.reads:
            return tuple(parameter[t] for parameter in self.state)
        samples = {name: history[name] for name in self.reads}
        if self.patterns > 1:
            samples = {name: [_tile(value, self.patterns) for value in rows] for name, rows in samples.items()}
        if self.given is None:
            parameters, self.state = self.conditional.step(self.state, t, samples)
            return parameters
        relations = [parent.relation for parent in self.conditional.factor.parents if parent.relation is not None]
        lags = [int(bool(self.conditional.head.residual)), *(relation.lag for relation in relations)]
        first = max(t - max(lags), 0)  # step t reads no earlier ones
        values = {n: value if value.dim() == 2 else value[:, first : t + 1] for n, value in self.given.items()}
        empty = {**self.conditional.sizes, self.conditional.factor.child: self.conditional.size}
        for name, rows in samples.items():
            steps = [rows[s] for s in range(first, t + 1)]
            some = next((step for step in steps if step is not None), None)
            if some is None and name in empty:
                some = like(self.conditional).new_zeros(self.rows, empty[name])
            if some is not None:  # a value that is not drawn yet, or a mask of a complete step
                fill = torch.full_like(some, some.dtype is torch.bool)
                values[name] = torch.stack([fill if step is None else step for step in steps], 1)
        return tuple(p[:, -1] for p in self.conditional(values, self.rows, t + 1 - first))

    def logits(self, parameters: Parameters, t: int) -> Tensor:
        """Return log probabilities (N, J) of a summed-out variable in the joint states."""
        return self._placed(self.conditional.distribution(parameters).logits, t)  # type: ignore[attr-defined]

    def densities(self, parameters: Parameters, value: Tensor, mask: Tensor | None, t: int) -> Tensor:
        """Return the log densities (N, J) of values (N, D) in the joint states of the discrete latents."""
        value, mask = _tile(value, self.patterns), _tile(mask, self.patterns)
        return self._placed(_log_prob(self.conditional, parameters, value, mask)[..., None], t)

    def place(self, t: int) -> Tensor:
        """Return the row of `places` at step t."""
        assert self.places is not None
        return self.places[t % len(self.places)]

    def _placed(self, logs: Tensor, t: int) -> Tensor:
        return logs.unflatten(0, (self.patterns, -1)).transpose(0, 1).flatten(1).index_select(1, self.place(t))

    def select(self, rows: Tensor | None) -> Stepwise:
        """Return the conditional for these particles, or a copy for None."""
        if self.patterns > 1 and rows is not None:
            first = torch.arange(self.patterns, device=rows.device)[:, None]
            rows = (first * (self.rows // self.patterns) + rows).flatten()
        state = (
            self.conditional.select(self.state, rows) if self.reads and self.given is None else select(self.state, rows)
        )
        given = None if self.given is None else select(dict(self.given), rows)
        return Stepwise(
            self.conditional, state, self.reads, self.places, self.patterns, self.rows, given, self.has_history
        )


def _tile(value: Any, count: int) -> Any:
    return None if value is None else value.repeat(count, *[1] * (value.dim() - 1))


def is_windowed(conditional: Conditional) -> bool:
    """Return whether a stream evaluates a conditional anew at each step, over the steps of the window."""
    return conditional.network is not None and not conditional.network.streams


def normalise(log_weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return normalised log weights (K, B), the log of the sum of the weights (B,), and the effective sample size (B,).

    The effective sample size is (sum w)^2 / sum w^2. If all weights of a sequence are 0, they become equal.
    """
    largest = log_weights.amax(0)
    relative = torch.where(largest > -math.inf, log_weights - largest, 0.0)
    weights = relative.exp()
    total = weights.sum(0)
    log_total = total.log()
    return relative - log_total, largest + log_total, total.square() / weights.square().sum(0)


def ancestors(log_weights: Tensor, mask: Tensor) -> Tensor:
    """Return the rows (K B,) of ancestors under systematic resampling with weights (K, B).

    Particle k has floor(K w_k) descendants or one more, and K w_k on average. Particles of sequences
    where `mask` (B,) is False are their own ancestors.
    """
    count, batch = log_weights.shape
    identity = torch.arange(count * batch, device=log_weights.device).view(count, batch)
    cumulative = log_weights.t().double().softmax(1).cumsum(1).contiguous()
    uniform = torch.rand(batch, 1, dtype=torch.double, device=log_weights.device)
    points = (torch.arange(count, device=log_weights.device) + uniform) / count * cumulative[:, -1:]
    particle = torch.searchsorted(cumulative, points, right=True).clamp_(max=count - 1)
    return torch.where(mask, particle.t() * batch + identity[0], identity).flatten()


def moments_of_mixture(means: Tensor, variances: Tensor | float, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and variance (B, D) of a mixture.

    Args:
        means, variances: moments (C, B, D) of the components.
        weights: their weights (C, B, 1).
    """
    mean = (weights * means).sum(0)
    return mean, (weights * (variances + (means - mean).square())).sum(0)


def _log_prob(conditional: Conditional, parameters: Parameters, value: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the log probability (N,) of values (N, D), of the entries that `mask` includes."""
    entries = conditional.distribution(parameters).log_prob(conditional.scored(value, mask))
    if mask is not None and mask.dim() != entries.dim():  # only guide or model scores whole events
        mask = mask.all(-1) if conditional.whole else mask[:, None]
    # where rather than a product: an excluded entry may be infinite
    entries = entries if mask is None else torch.where(mask, entries, 0.0)
    return entries if conditional.whole else entries.sum(-1)


def _at(values: Rows | None, t: int) -> Tensor | None:
    return None if values is None else values[t]


def hidden_data(run: Rollout) -> list[str]:
    """Return the data variables with missing entries, where the model reads its own means."""
    return [name for name, observed in run.observed.items() if not observed.all()]


def late_statics(model: Any) -> set[str]:
    """Return the static latents that the guide draws after the steps, because they read variables of the steps."""
    late: set[str] = set()
    for name in model.latents:
        factor = model.inference.factor(name)
        if not factor.local and _involves(factor, late | {n for n in model.latents if model.generative.local(n)}):
            late.add(name)
    return late


def _involves(factor: Factor, names: set[str]) -> bool:
    return factor.child in names or any(parent.name in names for parent in factor.parents)


def reads_ahead(parent: Parent, length: int) -> bool:
    """Return whether a factor reads steps after t of a local parent, in sequences of T = `length` steps."""
    assert parent.relation is not None
    if parent.relation.intervals is None:
        return bool(np.triu(parent.relation.mask(length), 1).any())
    return 1 in parent.relation.directions


def reads_now(parent: Parent) -> bool:
    """Return whether a factor reads the same step of a local parent."""
    return parent.relation is not None and 0 in parent.relation.directions
