"""Semi-amortized guides: the best guide per sequence that the guide's family and edges allow, without amortization.

    q_n(v | parents) = N(m + s_0 (b_n + sum_u W_nu (u - c_u) / d_u),  s exp(a_n))

m and s are the output of the guide's own conditional, given the data and the latents that it reads. b_n, a_n and W_nu
are free parameters for every sequence n, every step of v and every step u of the latents that v may read. They start at
0, where q_n is the guide, and maximise the evidence lower bound of their sequence. s_0, c_u and d_u are units computed
from draws of the guide: mean conditional deviations of v, and means and deviations of u.

The corrections can represent any function of the data that a network could compute, including the guide itself. The
dependence on latents can change only by a linear function. A guide that reads no latents becomes the best product of
normals for the sequence, as in Cremer, Li and Duvenaud (2018, arXiv 1801.03558); a linear one becomes the best linear
one.

Gradients are path derivatives (Roeder, Wu and Duvenaud, 2017, arXiv 1703.09194), which have no noise if the guide is
the posterior.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from pyro import poutine
from torch import Tensor, nn

from ...distributions.base import Parameters
from ...distributions.families import Gaussian
from ...factorization.graph import audit
from ...factorization.notation import Factor, Factorization, Parent
from ...networks.loop import memoizing
from ...program.batch import AnyBatch, repeat
from ...program.conditional import Conditional
from ...program.model import DynamicalVAE
from ..evaluation.evaluation_windows import seeded_evaluation
from .elbo import joint_and_guide, require_data, require_densities, require_latents, sites_of

UNITS = 32
"""Number of draws from the guide for the units."""
NAT = 1.0
"""Epsilon of Adam, in nats per deviation: steps are proportional to much smaller gradients, constant for larger ones.

With the usual tiny epsilon, steps have a constant size even where the gradient is only noise, as for many edges.
"""


@dataclass(frozen=True)
class Link:
    """Linear dependence of the location of a latent at S steps on another latent, for B sequences.

    Args:
        parent: name of the latent that is read.
        to, of: steps (P,) of P pairs: step `to[p]` of the latent reads step `of[p]` of the parent. `to` increases, and
            indexes the S steps; `of` is 0 for a static parent.
        weight: weights (B, P, E, D) of a parent of dimension E and a latent of dimension D, for standardised values.
        centre, deviation: mean and standard deviation (B, P, E) that standardise the values of the parent.
    """

    parent: str
    to: np.ndarray
    of: np.ndarray
    weight: Tensor
    centre: Tensor
    deviation: Tensor

    def moves(self, values: Sequence[Tensor], steps: int) -> Tensor:
        """Return shifts (k, B, S, D) of the latent's location in its units, from values (k B, E) per parent step."""
        inputs = torch.stack([values[s] for s in self.of.tolist()], 1).unflatten(0, (-1, len(self.weight)))
        inputs = (inputs - self.centre) / self.deviation
        if steps == 1:
            return (inputs.flatten(2).transpose(0, 1) @ self.weight.flatten(1, 2)).transpose(0, 1).unsqueeze(2)
        shifts = torch.einsum("kbpe,bped->kbpd", inputs, self.weight)
        targets = torch.as_tensor(self.to, device=shifts.device)
        return shifts.new_zeros(*shifts.shape[:2], steps, shifts.shape[3]).index_add(2, targets, shifts)

    def by_step(self, steps: int) -> list[Link | None]:
        """Return one link for each step, None for a step without a link."""
        counts = np.bincount(self.to, minlength=steps)
        sources_by_step = np.split(self.of, counts.cumsum()[:-1])
        # split rather than slice: the gradient of a slice is as large as the whole tensor
        tensors = (tensor.split(counts.tolist(), 1) for tensor in (self.weight, self.centre, self.deviation))
        parts = zip(sources_by_step, *tensors, strict=True)
        return [Link(self.parent, sources * 0, sources, *rest) if len(sources) else None for sources, *rest in parts]


@dataclass(frozen=True)
class Correction:
    """Correction of a conditional of the guide at S steps (1 for a static latent), for B sequences.

    Args:
        unit: standard deviations (B, S, D) of the guide before the correction.
        shift: shift (B, S, D) of the location, in units.
        stretch: shift (B, S, D) of the logarithm of the scale.
        links: linear functions of draws of other latents, one for each latent, which are added to the location.
    """

    unit: Tensor
    shift: Tensor
    stretch: Tensor
    links: tuple[Link, ...]

    def __call__(self, parameters: Parameters, values: Mapping[str, Sequence[Tensor]]) -> Parameters:
        """Return corrected location and scale (k B, S, D), from the guide's parameters and the latents by step."""
        if len(parameters[0]) % len(self.unit):
            raise ValueError(
                f"this guide was fitted to {len(self.unit)} sequences, but the batch has {len(parameters[0])} rows; "
                "pass the sequences that it was fitted to, in the same order"
            )
        loc, scale = (each.unflatten(0, (-1, len(self.unit))) for each in parameters)
        shift = self.shift
        for link in self.links:
            shift = shift + link.moves(values[link.parent], loc.shape[2])
        loc, scale = loc + self.unit * shift, scale * self.stretch.exp()
        return loc.flatten(0, 1), scale.flatten(0, 1)

    def by_step(self) -> list[Correction]:
        """Return one correction for each step."""
        steps = self.unit.shape[1]
        links = zip(*(link.by_step(steps) for link in self.links), strict=True) if self.links else [()] * steps
        tensors = (tensor.split(1, 1) for tensor in (self.unit, self.shift, self.stretch))
        parts = zip(*tensors, links, strict=True)
        return [
            Correction(unit, shift, stretch, tuple(filter(None, step_links)))
            for unit, shift, stretch, step_links in parts
        ]

    @property
    def free(self) -> list[tuple[Tensor, int]]:
        """Free parameters, each with the number of its entries that affect one location or scale."""
        linked = [(link.weight, np.bincount(link.to).max() * link.weight.shape[2]) for link in self.links]
        return [(self.shift, 1), (self.stretch, 1), *linked]

    def freed(self, change: Callable[[Tensor], Tensor]) -> Correction:
        """Return a copy in which `change` has been applied to each free parameter."""
        links = tuple(replace(link, weight=change(link.weight)) for link in self.links)
        return replace(self, shift=change(self.shift), stretch=change(self.stretch), links=links)


class CorrectedConditional(nn.Module):
    """Corrected conditional of the guide, which replaces the original one.

    Args:
        conditional: conditional of the guide.
        factor: factor with all parents that the corrected conditional reads.
        correction: correction of the conditional.
    """

    def __init__(self, conditional: Conditional, factor: Factor, correction: Correction):
        super().__init__()
        self.conditional, self.factor, self.correction = conditional, factor, correction
        self.parents = [parent.name for parent in factor.parents]

    def __getattr__(self, name: str) -> Any:
        """Return the attribute of the guide's conditional."""
        return super().__getattr__(name) if name == "conditional" else getattr(self.conditional, name)

    def forward(self, parents: Mapping[str, Tensor], *arguments: Any) -> Parameters:
        """Return the corrected parameters at all steps, (B, T, D), or (B, D) for a static latent.

        Args:
            parents: values of the parents by name, (B, T, D) or (B, D), of the guide and of the links.
            arguments: batch size B, number of steps T, valid steps (B,) and groups of `Conditional.forward`.

        Raises:
            ValueError: the batch has other sequences than those that the correction was fitted to.
        """
        values = {link.parent: _by_step(parents[link.parent]) for link in self.correction.links}
        parameters = self.conditional(parents, *arguments)
        if self.factor.local:
            return self.correction(parameters, values)
        return _without_step(self.correction(_with_step(parameters), values))

    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        """Return the state of the guide's loop, or its parameters by step if it reads no drawn variable."""
        values = {
            link.parent: _by_step(parents[link.parent]) for link in self.correction.links if link.parent in parents
        }
        steps = self.correction.by_step()
        if all(name in parents for name in self.conditional.parents):
            return tuple(p.unbind(1) for p in self.conditional(parents, batch, length, lengths)), None, values, steps
        return None, self.conditional.start(parents, batch, length, lengths), values, steps

    def step(
        self, state: Any, t: int, samples: Mapping[str, Sequence[Tensor]], count: int = 1
    ) -> tuple[Parameters, Any]:
        """Return the corrected parameters (B, D) at step t, and the next state of a loop over time.

        Args:
            state: result of `start` or of the previous step.
            t: index of the step, from 0.
            samples: values (B, D) by step of the variables that the loop draws, by name.
            count: number of steps that are evaluated at once; t is the last of them.

        Raises:
            ValueError: the batch has other sequences than those that the correction was fitted to.
        """
        fixed, inner, values, steps = state
        if fixed is None:
            parameters, inner = self.conditional.step(inner, t, samples, count)
        else:
            parameters = tuple(p[t] for p in fixed)
        return _without_step(steps[t](_with_step(parameters), {**samples, **values})), (fixed, inner, values, steps)

    def chain(self, *_: Any) -> None:
        """Return None, as no fused loop exists."""


def _by_step(value: Tensor) -> Sequence[Tensor]:
    return value.unbind(1) if value.dim() == 3 else (value,)


def _with_step(parameters: Parameters) -> Parameters:
    return tuple(p[:, None] for p in parameters)


def _without_step(parameters: Parameters) -> Parameters:
    return tuple(p[:, 0] for p in parameters)


@torch.inference_mode(False)
def semi_amortized_guide(
    model: DynamicalVAE,
    batch: AnyBatch,
    *,
    missing: bool = False,
    steps: int = 300,
    rate: float = 0.2,
    draws: int = 4,
    reach: int | None = None,
    seed: int = 0,
    progress: Callable[[], object] = lambda: None,
) -> DynamicalVAE:
    """Return the model with a semi-amortized guide, fitted to the bound of each of these sequences (see the module).

    Args:
        model: model with its guide, or a result of this function, whose search continues.
        batch: sequences to fit. The returned model accepts only these sequences in this order, or whole repetitions of
            them (`iwae_bound` and `annealed_bound` with a `chunk` that covers all).
        missing: whether the guide also reads, in its order of drawing, the latents that it ignores although the
            posterior depends on them (`audit`).
        steps: number of steps of Adam, with a learning rate that falls to 0.
        rate: learning rate of the first step, in standard deviations of the guide. Weights that affect the same
            location divide it equally among them.
        draws: number of draws of every sequence in each step.
        reach: largest distance in steps of linear dependencies between local latents; None for no limit.
        seed: seed of the draws.
        progress: function called after each step.

    Raises:
        ValueError: when the model has no latents or likelihood, a latent is not normal or shared by sequences, a number
            is below 1, or data are missing in the batch.

    Example:
        >>> pair = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})"
        >>> model = dvae.linear_gaussian_surrogate(*pair, {"z": 1, "x": 2}, 4)
        >>> x, oracle = model.sample(3, 4)["x"], dvae.Oracle(model, 4)
        >>> fitted = dvae.semi_amortized_guide(model, x, missing=True, rate=0.5)
        >>> (oracle.evidence(x) - dvae.iwae_bound(fitted, x, 16).bound).abs().max() < 0.05
        tensor(True)
    """
    if min(steps, draws) < 1 or (reach is not None and reach < 0) or not rate > 0:
        raise ValueError(
            f"steps and draws must be at least 1, reach at least 0 and rate above 0, got {steps}, {draws}, {reach} "
            f"and {rate}"
        )
    require_local(model)
    data = model.read(batch)
    if model.grouped and data.group is not None:
        raise ValueError("sequences of a group share latents and have no separate guide; remove 'group'")
    require_data(model, data)
    with seeded_evaluation(model, seed):
        fitted, corrections = _start(model, data, missing, reach)
        rows, free = repeat(data, draws), [each for c in corrections.values() for each in c.free]
        frozen = _with_guide(fitted, {name: each.freed(Tensor.detach) for name, each in corrections.items()})
        optimiser = torch.optim.Adam([{"params": [each], "lr": rate / width} for each, width in free], eps=NAT)
        scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
        for _ in range(steps):
            with torch.enable_grad(), torch.backends.cudnn.flags(enabled=False), memoizing():
                joint, guide = joint_and_guide(frozen, rows, fitted.guide(rows))
                gradients = torch.autograd.grad((guide - joint).sum() / draws, [each for each, _ in free])
            for (each, _), gradient in zip(free, gradients, strict=True):
                each.grad = gradient.nan_to_num(0.0, 0.0, 0.0)
            optimiser.step()
            scheduler.step()
            progress()
    return frozen


def require_local(model: DynamicalVAE) -> None:
    """Refuse a model whose latents do not allow semi-amortized guides.

    Raises:
        ValueError: when the model has no latents or no likelihood, or a latent is not normal in the guide.
    """
    require_densities(model)
    require_latents(model)
    for name in model.latents:
        if not isinstance(model.encoder[name].head, Gaussian):
            raise ValueError(
                "semi-amortized guides are normals with a location and a scale, but the distribution of "
                f"{model.inference.factor(name)} "
                f"is a {type(model.encoder[name].head).__name__}"
            )


def missing_latents(model: DynamicalVAE) -> dict[str, tuple[Parent, ...]]:
    """Return for each latent the latents that its posterior depends on and the guide ignores, in the guide's order."""
    missing = audit(model.generative, model.inference, observed=model.observed, summed=model.summed).missing_parents
    latents = {name: tuple(p for p in parents if p.name in model.latents) for name, parents in missing.items()}
    return {name: parents for name, parents in latents.items() if parents}


def _start(
    model: DynamicalVAE, data: Mapping[str, Any], missing: bool, reach: int | None
) -> tuple[DynamicalVAE, dict[str, Correction]]:
    """Return a copy of the model with initial corrections of its guide, and these corrections by latent.

    Args:
        model: model with its guide.
        data: sequences that the guide will be fitted to.
        missing: whether the guide also reads the latents from `missing_latents`.
        reach: largest distance in steps of links between local latents; None for no limit.
    """
    added = missing_latents(model) if missing else {}
    draws = _GuideDraws(model, data)
    corrections = {}
    for name in model.latents:
        conditional, factor = model.encoder[name], model.inference.factor(name)
        correction = (
            conditional.correction if isinstance(conditional, CorrectedConditional) else draws.correction(factor, reach)
        )
        links = draws.links(replace(factor, parents=added.get(name, ())), reach)
        corrections[name] = replace(correction, links=(*correction.links, *links)).freed(
            lambda t: t.clone().requires_grad_()
        )
    factors = tuple(replace(f, parents=_merged(f.parents, added.get(f.child, ()))) for f in model.inference.factors)
    return _with_guide(model, corrections, Factorization("q", factors)), corrections


def _merged(parents: Sequence[Parent], added: Sequence[Parent]) -> tuple[Parent, ...]:
    """Return parents with additional ones; parents of the same name are merged."""
    merged = {parent.name: parent for parent in parents}
    for parent in added:
        existing = merged.get(parent.name, parent).relation
        relation = parent.relation if existing is None or parent.relation is None else existing | parent.relation
        merged[parent.name] = replace(parent, relation=relation)
    return tuple(merged.values())


def _with_guide(
    model: DynamicalVAE, corrections: Mapping[str, Correction], inference: Factorization | None = None
) -> DynamicalVAE:
    """Return a copy of the model with a corrected guide; the model does not change."""
    corrected = copy.copy(model)
    corrected.inference = inference or model.inference
    encoder = {}
    for name, correction in corrections.items():
        conditional = model.encoder[name]
        encoder[name] = CorrectedConditional(
            conditional.conditional if isinstance(conditional, CorrectedConditional) else conditional,
            corrected.inference.factor(name),
            correction,
        )
    corrected.__dict__.pop("encoder", None)  # present if the guide is the prior
    corrected._modules = {**model._modules, "encoder": nn.ModuleDict(encoder)}
    return corrected


class _GuideDraws:
    """Draws of the guide and the units of corrections."""

    def __init__(self, model: DynamicalVAE, data: Mapping[str, Any]):
        sites = sites_of(poutine.trace(model.guide).get_trace(repeat(data, UNITS)))
        self.values: dict[str, Tensor] = {}
        self.units: dict[str, Tensor] = {}
        for name in model.latents:
            site, local = sites[name], model.inference.local(name)
            distribution = site["fn"].steps(site["value"]) if local else site["fn"]
            for table, value in ((self.values, site["value"]), (self.units, distribution.stddev)):
                table[name] = (value if local else value[:, None]).unflatten(0, (UNITS, -1))

    def correction(self, factor: Factor, reach: int | None) -> Correction:
        unit = self.units[factor.child].mean(0)
        return Correction(unit, torch.zeros_like(unit), torch.zeros_like(unit), self.links(factor, reach))

    def links(self, factor: Factor, reach: int | None) -> tuple[Link, ...]:
        """Return links with zero weights from a latent to each latent among its parents.

        Args:
            factor: factor of the guide.
            reach: largest distance in steps between the latent and a local parent; None for no limit.
        """
        _, size, _, width = self.values[factor.child].shape
        length = max(value.shape[2] for value in self.values.values())
        links = []
        for parent in factor.parents:
            if parent.name not in self.values:
                continue
            mask = factor.mask(parent.name, length)
            if factor.local and parent.local and reach is not None:
                steps = np.arange(length)
                mask = mask & (abs(steps[:, None] - steps) <= reach)
            targets, sources = np.nonzero(mask)
            if len(targets):
                values = self.values[parent.name][:, :, sources]
                weight = values.new_zeros(size, len(targets), values.shape[-1], width)
                deviation = values.std(0)
                deviation = torch.where(deviation > 0, deviation, 1.0)  # zero at padding
                links.append(Link(parent.name, targets, sources, weight, values.mean(0), deviation))
        return tuple(links)
