"""The exact filter of a linear-Gaussian model, for any factorization (Kalman, 1960).

The state is the joint normal of the static latents and of all variables in a window of steps. A new variable is an
affine function of them plus noise; its coefficients are the network's locations at 0 and at every unit vector. An
observed value has variance 0. At a missing entry the model reads its own mean, an affine function of the latents.
"""

from __future__ import annotations

import math
from copy import copy, deepcopy
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from ..distributions.base import Parameters
from ..distributions.families import FixedNormalModule, Gaussian
from ..networks.linear import LinearNetwork
from ..networks.loop import Rows
from ..networks.recurrent import RecurrentNetwork
from .conditional import Conditional, like
from .rollout import Rollout


def is_linear_gaussian(model: Any) -> bool:
    """Return whether all generative distributions are normals with affine locations and constant scales."""
    for parent in (parent for factor in model.generative.factors for parent in factor.parents if parent.local):
        ahead = parent.relation.intervals is None or 1 in parent.relation.directions
        if ahead or (parent.name in model.observed and 0 in parent.relation.directions):
            return False
    has_static_data = any(not model.generative.local(name) for name in model.observed)
    return not (model.summed or has_static_data) and all(map(_is_linear, model.generator.values()))


def _is_linear(conditional: Conditional) -> bool:
    units = conditional.units
    has_logarithms = any(units[name].logarithms for name in conditional.parents if name in units)
    is_standard = conditional.exposure is None and conditional.offset is None
    return is_standard and not has_logarithms and is_affine_normal(conditional)


def is_affine_normal(conditional: Conditional) -> bool:
    """Return whether a conditional is a normal with an affine network and a scale that does not depend on parents."""
    network, head = conditional.network, conditional.head
    if network is None:
        return isinstance(head, Gaussian)
    is_affine = isinstance(network, LinearNetwork)
    if isinstance(network, RecurrentNetwork):
        is_affine = not (network.memories or network.extractors or network.join.first)
    return is_affine and isinstance(head, FixedNormalModule)


class GaussianFilter:
    """Exact moments of every sequence, in float64; the interface is the one of `Particles`.

    Args:
        model: linear-Gaussian model.
        known: run with the values that are known before the first step.
        live: whether data and local context are added step by step; the length of `known` is then that of the window.
    """

    def __init__(self, model: Any, known: Rollout, live: bool):
        self.model, self.known, self.live = model, known, live
        # float32 does not resolve affine functions of a variable far from 0
        self.exact_model = deepcopy(model).double() if like(model).dtype is not torch.float64 else model
        order = [name for block in model.generative.blocks for name in block.names]
        read = {parent.name for factor in model.generative.factors for parent in factor.parents}
        unread = [name for name in model.observed if name not in read]  # forgotten at the end of each step
        kept = [name for name in order if model.generative.local(name) and name not in unread]
        self.local = [*kept, *unread]
        self.statics = [name for name in order if not model.generative.local(name)]
        self.sizes = [model.sizes[name] for name in self.local]
        self.kept = {name: model.sizes[name] for name in kept}
        self.width = sum(self.kept.values())
        self.context = {n: Rows([None] * known.length) for n in model.context if live and model.reader.local[n]}
        self.read_context = {name for name in order if self.context.keys() & model.generator[name].parents}
        self.maps: dict[str, tuple[Tensor, Tensor, Tensor]] = {}
        """Results of `_affine` in the last step of the window of a stream, which does not move any more."""
        self.position = -1

    def start(self) -> Tensor:
        """Compute the moments of the static latents; return the log evidence 0 (B,) before any data."""
        batch = self.known.batch
        self.log_weights = torch.zeros(1, batch, dtype=torch.float64, device=like(self.model).device)
        self.effective = torch.ones_like(self.log_weights[0])
        self.mean = self.log_weights.new_zeros(batch, 0)
        self.covariance = self.log_weights.new_zeros(batch, 0, 0)
        for name in self.statics:
            self._extend(name, noisy=True)
        self.static_size = self.mean.shape[1]
        return self.log_weights[0]

    def fork(self) -> GaussianFilter:
        """Return a copy whose steps do not change this filter."""
        forked = copy(self)
        forked.context = {name: rows.replaced(0, rows[0]) for name, rows in self.context.items()}
        return forked

    def begin(self, resample_below: float, valid: Tensor | None = None) -> Tensor:
        """Move to the next step."""
        if self.live and self.position == self.known.length - 1:
            kept = slice(self.static_size), slice(self.static_size + self.width, None)
            self.mean = torch.cat([self.mean[:, part] for part in kept], 1)
            rows = torch.cat([self.covariance[:, part] for part in kept], 1)
            self.covariance = torch.cat([rows[:, :, part] for part in kept], 2)
            for values in self.context.values():
                values.slide()
        self.position = min(self.position + 1, self.known.length - 1)
        return torch.zeros(self.known.batch, dtype=torch.bool, device=self.mean.device)

    def feed(self, run: Rollout, t: int, names: list[str]) -> None:
        """Add context, or data and their masks, at a step; see `Particles.feed`."""
        self.run, self.t = run, t
        for name in names:
            if name not in self.model.observed:
                self.context[name][self.position] = run.values[name][:, t]

    def predict(self) -> dict[str, tuple[Conditional, Parameters, Tensor]]:
        """Return the normal distribution of each data variable, before its data are used; see `Particles.predict`."""
        self.noise = {name: self._extend(name, noisy=name not in self.model.observed) for name in self.local}
        result: dict[str, tuple[Conditional, Parameters, Tensor]] = {}
        for name in self.model.observed:
            part = self._part(name, self.position)
            variance = self.covariance.diagonal(dim1=1, dim2=2)[:, part] + self.noise[name].square()
            moments = self.mean[:, part], variance.sqrt()
            result[name] = self.model.generator[name], moments, torch.zeros_like(self.log_weights)
        return result

    def weigh(self) -> Tensor:
        """Condition on the data of the step, and return their log density (B,)."""
        if not self.live:
            self.run, self.t = self.known, self.position
        total = self.log_weights[0]
        for name in self.model.observed:
            part, mask = self._part(name, self.position), self.run.mask(name)
            value = self.run.values[name][:, self.t].double()
            observed = torch.ones_like(value) if mask is None else mask[:, self.t].double()
            spread = self.covariance[:, part, part] + torch.diag_embed(self.noise[name].square().expand_as(value))
            spread = spread * observed[:, :, None] * observed[:, None] + torch.diag_embed(1 - observed)
            residual = (value - self.mean[:, part]) * observed
            root = torch.linalg.cholesky(spread)
            across = self.covariance[:, part] * observed[..., None]
            solved = torch.linalg.solve_triangular(root, torch.cat([residual[..., None], across], 2), upper=False)
            white, across = solved[..., 0], solved[..., 1:]
            log_density = -0.5 * white.square().sum(1) - root.diagonal(dim1=1, dim2=2).log().sum(1)
            total = total + log_density - 0.5 * math.log(2 * math.pi) * observed.sum(1)
            self.mean = self.mean + (across.mT @ white[..., None])[..., 0]
            covariance = self.covariance - across.mT @ across
            # the model reads the value where it was observed, and its own mean elsewhere
            self.mean[:, part] = torch.where(observed > 0, value, self.mean[:, part])
            uncertain = torch.ones_like(self.mean)
            uncertain[:, part] = 1 - observed
            self.covariance = (covariance + covariance.mT) / 2 * uncertain[:, :, None] * uncertain[:, None]
        kept = self.static_size + (self.position + 1) * self.width
        self.mean, self.covariance = self.mean[:, :kept], self.covariance[:, :kept, :kept]
        return total

    def summary(self, lag: int) -> dict[str, dict[str, Tensor]]:
        """Return mean and variance (B, D) of each latent `lag` steps ago, given the data so far."""
        variance = self.covariance.diagonal(dim1=1, dim2=2)
        parts = {name: self._part(name, max(self.position - lag, 0)) for name in self.model.latents}
        return {
            "mean": {name: self.mean[:, part] for name, part in parts.items()},
            "variance": {name: variance[:, part] for name, part in parts.items()},
        }

    def _part(self, name: str, position: int) -> slice:
        """Return the coordinates of a variable at a step of the window."""
        if name in self.statics:
            first = sum(self.model.sizes[other] for other in self.statics[: self.statics.index(name)])
        else:
            index = self.local.index(name)
            first = self.static_size + position * self.width + sum(self.sizes[:index])
        return slice(first, first + self.model.sizes[name])

    def _extend(self, name: str, noisy: bool) -> Tensor:
        """Append a variable at the current step, with or without its noise, and return its noise scale (R, D)."""
        weights, offset, scale = self.maps[name] if name in self.maps else self._affine(name, self.position + 1)
        if self.live and self.position == self.known.length - 1 and name not in self.read_context:
            self.maps[name] = weights, offset, scale
        mean = (weights @ self.mean[..., None])[..., 0] + offset
        across = weights @ self.covariance
        within = across @ weights.mT + (torch.diag_embed(scale.square()) if noisy else 0.0)
        self.mean = torch.cat([self.mean, mean], 1)
        self.covariance = torch.cat([torch.cat([self.covariance, across.mT], 2), torch.cat([across, within], 2)], 1)
        return scale

    def _affine(self, name: str, steps: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return weights (R, D, S), offset and noise scale (R, D) of a variable given the S coordinates so far.

        R is 1, or B if the variable reads context. S includes variables of its own step.
        """
        conditional, (batch, size) = self.exact_model.generator[name], self.mean.shape
        probes = torch.cat([self.mean.new_zeros(1, size), torch.eye(size).to(self.mean)])
        names = [n for n in conditional.parents if n in self.model.context]
        count = batch if names else 1
        probes, values = probes.repeat(count, 1).to(like(self.exact_model)), {}
        for each in self.statics:
            if conditional.factor.parent(each) is not None:
                values[each] = probes[:, self._part(each, 0)]
        if conditional.factor.local:
            rest = functional.pad(probes[:, self.static_size :], (0, steps * self.width + self.static_size - size))
            parts = rest.view(-1, steps, self.width).split([*self.kept.values()], -1) if self.kept else ()
            values |= dict(zip(self.kept, parts, strict=True))
        for each in names:
            value = self.known.values.get(each)
            if value is None:
                value = torch.stack([self.context[each][s] for s in range(steps)], 1)
            elif value.dim() == 3:
                value = value[:, :steps]
            values[each] = value.repeat_interleave(size + 1, 0)
        values = {each: value.to(probes) for each, value in values.items()}
        location, scale = conditional(values, len(probes), max(steps, 1))
        if conditional.factor.local:
            location, scale = location[:, -1], scale[:, -1]
        location, scale = (part.double().unflatten(0, (count, size + 1)) for part in (location, scale))
        return (location[:, 1:] - location[:, :1]).mT, location[:, 0], scale[:, 0]
