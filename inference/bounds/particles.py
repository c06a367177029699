"""FIVO bound: importance weighting with resampling at each step, for any factorization with a forward guide.

    sum_t log 1/K sum_k w_t^k,    w_t = p(z_t | .) p(x_t | .) / q(z_t | .)

K particles of each sequence draw their latents from the guide step by step. When their weights have become too unequal,
likely particles replace unlikely ones, and the weights are reset. The product of the mean weights is an unbiased
estimate of the evidence, so the mean of its log is a lower bound. It is the bound of Maddison et al. (2017, FIVO, arXiv
1705.09279), Le et al. (2018, arXiv 1705.10306) and Naesseth et al. (2018, arXiv 1705.11140).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...distributions.base import Parameters
from ...factorization.notation import Factor, Parent
from ...networks.base import indicator, presence
from ...networks.loop import Rows, memoizing, pick, select, valid_steps
from ...program.batch import AnyBatch
from ...program.conditional import Conditional, like
from ...program.model import DynamicalVAE
from ...program.rollout import Rollout
from .elbo import require_data, require_densities


@dataclass(frozen=True)
class FIVOBound:
    """FIVO bound of every sequence, with statistics of its particles.

    Args:
        bound: log of the estimated evidence, in nats, (B,).
        effective: effective sample size of the weights after each step, between 1 and K, (T, B); NaN at padding.
        resamplings: number of resamplings, (B,).
        particles: K, number of particles.
    """

    bound: Tensor
    effective: Tensor
    resamplings: Tensor
    particles: int


@torch.no_grad()
def fivo_bound(
    model: DynamicalVAE, batch: AnyBatch, particles: int = 16, *, resample_below: float = 0.5, chunk: int = 4096
) -> FIVOBound:
    """Return the FIVO bound: the log of a particle filter's estimate of p(x) per sequence, with the guide as proposal.

    exp(bound) is unbiased for p(x) with any number of particles, so on average the bound rises with their number to the
    log evidence. With one particle it is the evidence lower bound at one draw. Without resampling it is the IWAE bound,
    which it exceeds on long sequences unless the guide is nearly exact (docs/explanation/bounds.md).

    Resampling is systematic. Static latents are drawn first and resampled with their particle. Several local latents
    are drawn in the guide's order within each step.

    Args:
        model: model with its guide.
        batch: batch as in `DynamicalVAE.model`, which may be ragged or have missing entries.
        particles: K, number of particles.
        resample_below: share of K; particles are resampled before a step if the effective sample size is below it. 0
            never resamples, 1 whenever weights differ.
        chunk: largest number of sequences times particles in memory.

    Returns:
        Bound (B,), effective sample size (T, B), number of resamplings (B,).

    Raises:
        ValueError: when the guide runs backward in time, a factor reads latents after t, such as p(x_t | z_{1:T}), or
            data or context are missing in the batch.

    Example:
        >>> model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)", {"z": 1, "x": 2})
        >>> dvae.fivo_bound(model, torch.randn(3, 4, 2), particles=16).bound.shape
        torch.Size([3])
    """
    if not isinstance(particles, int) or particles < 1:
        raise ValueError(f"particles must be a whole number, at least 1, got {particles!r}")
    if not 0 <= resample_below <= 1:
        raise ValueError(f"resample_below must be a share of the particles, between 0 and 1, got {resample_below}")
    require_densities(model)
    with model.running():
        data = model.read(batch)
        size = require_data(model, data)
        at_once = max(1, chunk // particles)
        if reason := obstacle(model, data):
            raise ValueError(reason)
        parts = []
        for first in range(0, size, at_once):
            sequences = data.rows(slice(first, first + at_once))
            part = Filter(model, sequences, particles).run(resample_below)
            parts.append((part.bound, part.effective, part.resamplings))
        bound, effective, resamplings = (torch.cat(values, dim=-1) for values in zip(*parts, strict=True))
        return FIVOBound(bound + (0 if data.log_det is None else data.volume), effective, resamplings, particles)


class Filter:
    """K particles of every sequence; row k B + b of their N = K B rows is particle k of sequence b.

    Args:
        model: model with its guide.
        batch: batch with data and context.
        particles: K, number of particles.
    """

    def __init__(self, model: DynamicalVAE, batch: AnyBatch, particles: int):
        self.model = model
        self.particles = particles
        self.known = model.rollout(batch)
        self.hidden = _hidden(self.known)
        self.shared = {name: value for name, value in self.known.values.items() if name not in self.hidden}
        self.late = _late(model)
        self.sequence = torch.arange(self.known.batch, device=like(model).device).repeat(particles)
        self.statics: dict[str, Rows] = {}
        self.paths = {name: Rows([None] * self.known.length) for name in (*self._local(model.latents), *self.hidden)}

    def run(self, resample_below: float) -> FIVOBound:
        """Run all steps and return the bound; afterwards `drawn` contains the draws of the surviving particles.

        Args:
            resample_below: share of the particles; the effective sample size below which they are resampled.
        """
        model, length, batch = self.model, self.known.length, self.known.batch
        shape = self.particles, batch
        log_weights = self._draw_statics(late=False).view(shape)
        bound = log_weights.new_zeros(batch)
        resamplings = torch.zeros(batch, dtype=torch.long, device=bound.device)
        valid = None if self.known.lengths is None else valid_steps(self.known.lengths, length).t()
        effective: list[Tensor] = []
        with memoizing():
            guide = {
                name: self._stepwise(model.encoder[name], self.known.values) for name in self._local(model.latents)
            }
            order = [name for block in model.generative.blocks for name in block.names]
            prior = {name: self._stepwise(model.generator[name], self.shared) for name in self._local(order)}
        noise = {
            name: distribution.conditional.head.noise(
                (len(self.sequence), length, distribution.conditional.size), bound
            ).unbind(1)
            for name, distribution in guide.items()
        }
        data = {name: self._by_step(self.known.values[name]) for name in self._local(model.observed)}
        masks = {name: None if (mask := self.known.mask(name)) is None else self._by_step(mask) for name in prior}
        for t in range(length):
            if t or self.statics:
                low = effective_size(log_weights) < resample_below * self.particles
                low = low if valid is None else low & valid[t]
                if low.any():
                    bound = torch.where(low, bound + _log_mean(log_weights), bound)
                    rows = ancestors(log_weights, low)
                    self.statics, self.paths, guide, prior = select([self.statics, self.paths, guide, prior], rows)
                    log_weights = log_weights.masked_fill(low, 0)
                    resamplings += low
            log_weights = log_weights + self._step(t, guide, prior, noise, data, masks).view(shape)
            size = effective_size(log_weights)
            effective.append(size if valid is None else size.masked_fill(~valid[t], math.nan))
        log_weights = log_weights + self._draw_statics(late=True).view(shape)
        return FIVOBound(bound + _log_mean(log_weights), torch.stack(effective), resamplings, self.particles)

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

    def _local(self, names: Any) -> list[str]:
        return [name for name in names if self.model.generative.local(name)]

    def _by_step(self, values: Tensor) -> Rows:
        return Rows(values.unbind(1)).select(self.sequence)

    def _step(
        self,
        t: int,
        guide: Mapping[str, Stepwise],
        prior: Mapping[str, Stepwise],
        noise: Mapping[str, tuple[Tensor, ...]],
        data: Mapping[str, Rows],
        masks: Mapping[str, Rows | None],
    ) -> Tensor:
        """Draw the latents at a step from the guide, and return the log weights (N,) of the step.

        Args:
            t: index of the step, from 0.
            guide: conditionals of the guide by local latent.
            prior: conditionals of the model by local variable.
            noise: noise (N, D) by step for each local latent.
            data: data by name and step.
            masks: masks of observed entries by name and step; None if all were observed.
        """
        total = like(self.model).new_zeros(len(self.sequence))
        history = {**data, **self.paths}
        for name, distribution in guide.items():
            parameters = distribution.step(t, history)
            self.paths[name][t] = distribution.conditional.draw(parameters, noise[name][t])
            total = total - _log_prob(distribution.conditional, parameters, self.paths[name][t], _at(masks[name], t))
        for name, distribution in prior.items():
            parameters = distribution.step(t, history)
            value = data[name][t] if name in data else self.paths[name][t]
            total = total + _log_prob(distribution.conditional, parameters, value, _at(masks[name], t))
            if name in self.hidden:  # the model reads its own mean where x is missing
                observed = self.known.observed[name][:, t].index_select(0, self.sequence)
                self.paths[name][t] = torch.where(observed, value, distribution.conditional.mean(parameters))
        return total

    def _draw_statics(self, late: bool) -> Tensor:
        """Draw the static latents that precede the steps, or follow them if `late`, and return log weights (N,)."""
        model, total = self.model, like(self.model).new_zeros(len(self.sequence))
        for name in model.latents:
            if not model.generative.local(name) and (name in self.late) == late:
                conditional = model.encoder[name]
                parameters = self._parameters(conditional, self.known.values)
                noise = conditional.head.noise((len(self.sequence), conditional.size), total)
                self.statics[name] = Rows([conditional.draw(parameters, noise)])
                total = total - _log_prob(conditional, parameters, self.statics[name][0])
        values = {**self.shared, **self.drawn}
        for factor in model.generative.factors:
            if factor.local or _involves(factor, {*self.late, *self.paths}) != late:
                continue
            name = factor.child
            value = values[name] if name in self.statics else pick(values[name], self.sequence)
            conditional = model.generator[name]
            total = total + _log_prob(conditional, self._parameters(conditional, self.shared), value)
        return total

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
        later_parents = [name for name in conditional.parents if name not in parents]
        if not later_parents:
            parameters = conditional(parents, size, self.known.length, lengths)
            return Stepwise(conditional, select([p.unbind(1) for p in parameters], rows), [])
        state = conditional.start(parents, size, self.known.length, lengths)
        reads = [*later_parents, conditional.factor.child] if conditional.head.residual else later_parents
        return Stepwise(conditional, conditional.select(state, rows), reads)

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
        state: state of its network; its parameters by step if `reads` is empty.
        reads: names of the parents drawn in the steps.
    """

    conditional: Conditional
    state: Any
    reads: list[str]

    def step(self, t: int, history: Mapping[str, Rows]) -> Parameters:
        """Return the distribution's parameters (N, D) at step t."""
        if not self.reads:
            return tuple(parameter[t] for parameter in self.state)
        parameters, self.state = self.conditional.step(self.state, t, {name: history[name] for name in self.reads})
        return parameters

    def select(self, rows: Tensor) -> Stepwise:
        """Return the conditional for these particles."""
        state = self.conditional.select(self.state, rows) if self.reads else select(self.state, rows)
        return Stepwise(self.conditional, state, self.reads)


def effective_size(log_weights: Tensor) -> Tensor:
    """Return the effective sample size (B,) of weights (K, B): (sum w)^2 / sum w^2."""
    weights = (log_weights - log_weights.amax(0)).exp()  # the difference of two large logs would lose all digits
    return weights.sum(0).square() / weights.square().sum(0)


def ancestors(log_weights: Tensor, mask: Tensor) -> Tensor:
    """Return the rows (K B,) of ancestors under systematic resampling with weights (K, B).

    Particle k has floor(K w_k) descendants or one more, and K w_k on average. Particles of sequences
    where `mask` (B,) is False are their own ancestors.
    """
    count, batch = log_weights.shape
    identity = torch.arange(count, device=log_weights.device)[:, None]
    cumulative = log_weights.double().softmax(0).cumsum(0)
    points = (identity + torch.rand(batch, dtype=torch.double, device=identity.device)) / count * cumulative[-1]
    resampled = torch.searchsorted(cumulative.t().contiguous(), points.t().contiguous(), right=True).t()
    particle = torch.where(mask, resampled.clamp_(max=count - 1), identity)
    return (particle * batch + torch.arange(batch, device=identity.device)).flatten()


def _log_mean(log_weights: Tensor) -> Tensor:
    return log_weights.logsumexp(0) - math.log(len(log_weights))


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


def _hidden(run: Rollout) -> list[str]:
    """Return the data variables with missing entries, where the model reads its own means."""
    return [name for name, observed in run.observed.items() if not observed.all()]


def _late(model: DynamicalVAE) -> set[str]:
    """Return the static latents that the guide draws after the steps, because they read variables of the steps."""
    late: set[str] = set()
    for name in model.latents:
        factor = model.inference.factor(name)
        if not factor.local and _involves(factor, late | {n for n in model.latents if model.generative.local(n)}):
            late.add(name)
    return late


def _involves(factor: Factor, names: set[str]) -> bool:
    return factor.child in names or any(parent.name in names for parent in factor.parents)


def obstacle(model: DynamicalVAE, batch: AnyBatch) -> str:
    """Return the reason why particles cannot filter a model forward in time; "" if they can.

    Raises:
        ValueError: when the batch cannot be read.
    """
    run = model.rollout(batch)
    instead = "use iwae_bound"
    if model.bounded:
        return f"{', '.join(model.bounded)} has a stochastic lower bound in place of a density"
    if model.summed:
        return f"{', '.join(model.summed)} is summed out exactly, not by particles; {instead}"
    if run.groups is not None:
        return (
            f"particles belong to one sequence each, but groups share {', '.join(model.grouped)}; {instead}, or leave "
            "'group' out of the batch, where every sequence is a group"
        )
    for block in model.inference.blocks:
        if block.direction < 0:
            return (
                f"particles move forward in time, but the guide draws {', '.join(block.names)} backward "
                f"({model.inference.factor(block.names[0])}); {instead}"
            )
    hidden, late = _hidden(run), _late(model)
    if static := [name for name in hidden if not model.generative.local(name)]:
        return f"a static variable has no missing entries in a FIVO bound, but {', '.join(static)} has"
    latents = [name for name in model.latents if model.generative.local(name)]
    for equations, step_names in ((model.inference, latents), (model.generative, [*latents, *hidden])):
        for factor in equations.factors:
            for parent in factor.parents if factor.local else ():
                if parent.name in late:
                    return (
                        f"{factor} reads {parent}, which {model.inference.factor(parent.name)} draws after all steps, "
                        f"so particles cannot be weighted at each step; {instead}"
                    )
                if parent.name in step_names and _reads_ahead(parent, run.length):
                    missing = " where entries are missing" if parent.name in hidden else ""
                    return (
                        f"{factor} reads {parent}, and {parent.name} after t is not drawn yet{missing} when the "
                        f"particles are at t; {instead}"
                    )
    return ""


def _reads_ahead(parent: Parent, length: int) -> bool:
    assert parent.relation is not None
    if parent.relation.intervals is None:
        return bool(np.triu(parent.relation.mask(length), 1).any())
    return 1 in parent.relation.directions
