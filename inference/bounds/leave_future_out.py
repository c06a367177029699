"""Leave-future-out log predictive density: how well a model forecasts held-out sequences, in nats.

    elpd = sum over t = L, ..., T - M of log p(x_{t+1:t+M} | x_{1:t})

Bürkner, Gabry and Vehtari (2020, Journal of Statistical Computation and Simulation, arXiv 1902.06281) refit the model
for every t. Here the weights were fitted to other sequences and do not change, so that each term is a difference of two
log evidences, log p(x_{1:t+M}) - log p(x_{1:t}). The latents are integrated out. The sum telescopes: only the evidences
of the M first and the M last prefixes remain.

The evidence of a prefix is exact where `DynamicalVAE.filter` is: for a linear-Gaussian model, whose networks are
`networks.Linear` or `networks.Dense(())`, and for a model whose latents are all summed out. Otherwise, R independent
estimates of it are averaged, each by K particles (`fivo_bound`) or, for a guide that particles cannot follow, by K
importance weights. The guide reads the prefix alone, so no proposal depends on the future. The Monte Carlo standard
error is the jackknife's over the R estimates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...data.batch import Batch
from ...networks.loop import valid_steps
from ...program.batch import AnyBatch, repeat
from ...program.gaussian import is_linear_gaussian
from ...program.model import DynamicalVAE
from ...program.particles import normalise, reads_ahead
from .elbo import importance_weights, require_data, require_densities
from .particles import fivo_bound, obstacle

REPLICATES = 5
"""R, number of independent estimates of each evidence."""

EFFECTIVE = 20
"""Effective sample size below which an estimate is unreliable; a step then has a bias of about 1 / 40 nats or more."""


@dataclass(frozen=True)
class LeaveFutureOut:
    """Leave-future-out densities of B sequences.

    Args:
        logs: R estimates of the log evidences of the first and the last prefixes, (2, min(M, origins), R, B); R is 1 if
            they are exact.
        effective: effective sample size of the K particles, (B,), the smallest over steps, as a mean over estimates;
            infinite if the evidences are exact.
        n_steps: number of forecast steps of all origins, (B,).
    """

    logs: Tensor
    effective: Tensor
    n_steps: Tensor

    @property
    def elpd(self) -> Tensor:
        """The sum over origins, in nats per sequence, (B,)."""
        return _difference(self.logs)

    @property
    def error(self) -> Tensor:
        """Monte Carlo standard error of `elpd`, with R - 1 degrees of freedom, (B,); 0 if it is exact."""
        count = self.logs.shape[2]
        if count == 1:
            return torch.zeros_like(self.effective)
        others = [_difference(self.logs[:, :, torch.arange(count) != r]) for r in range(count)]
        return math.sqrt(count - 1) * torch.stack(others).std(0, correction=0)


def _difference(logs: Tensor) -> Tensor:
    """Return the sum of the last log evidences minus the first ones, (B,), each the log of a mean over estimates."""
    first, last = logs.logsumexp(2).sum(1)
    return last - first


def mixture(parts: Sequence[LeaveFutureOut]) -> LeaveFutureOut:
    """Return the densities of an equal-weight mixture of models, whose evidence of a prefix is the mean of theirs.

    It is a mixture of whole sequences: given the past, each model has the weight of its evidence of this past.
    """
    logs = torch.stack([part.logs for part in parts]).logsumexp(0) - math.log(len(parts))
    return LeaveFutureOut(logs, torch.stack([part.effective for part in parts]).amin(0), parts[0].n_steps)


@torch.no_grad()
def leave_future_out(
    model: DynamicalVAE, batch: AnyBatch, observed: int, horizon: int = 1, particles: int = 100, *, chunk: int = 4096
) -> LeaveFutureOut:
    """Return the leave-future-out log predictive density of every sequence; see the module.

    With M = 1, the sum is log p(x_{L+1:T} | x_{1:L}). Missing entries have no density, in the past or in the future.

    Args:
        model: model with its guide.
        batch: batch as in `DynamicalVAE.model`, which may be ragged or have missing entries.
        observed: L, number of steps before the first forecast.
        horizon: M, number of steps of each forecast.
        particles: K, number of particles of each of the R estimates. Double it until the Monte Carlo error is small
            compared with the differences between models and the smallest effective sample size is above 20.
        chunk: largest number of sequences times particles in memory.

    Raises:
        ValueError: when a sequence has fewer than L + M steps, the model has no likelihood or reads ahead, so that the
            density of a prefix depends on later steps, or groups of sequences share latents.
    """
    require_densities(model)
    with model.running():
        data = model.read(batch)
        size, length, past = require_data(model, data), model.rollout(data).length, model.view.past
        lengths = torch.full((size,), length) if data.lengths is None else data.lengths.cpu()
        observed -= past  # these steps are context
        if min(observed, horizon, particles) < 1 or observed + horizon > int(lengths.min()):
            raise ValueError(
                f"leave-future-out needs at least {past + 1} observed steps and at least 1 forecast step, together at "
                f"most the {past + int(lengths.min())} of the shortest sequence, and at least 1 particle; got "
                f"{past + observed}, {horizon} and {particles}"
            )
        _require_causal(model, data, length)
        origins = lengths - observed - horizon + 1  # of each sequence
        logs, effective = [], []
        for j in range(min(horizon, int(origins.max()))):
            for ends in (torch.full_like(lengths, observed + j), lengths - j):
                prefix = _prefix(data, torch.where(j < origins, ends, 1))
                estimates, sizes = _evidences(model, prefix, particles, chunk)
                counted = (j < origins).to(sizes.device)
                logs.append(estimates.where(counted, 0.0))
                effective.append(sizes.where(counted, math.inf))
        by_end = torch.stack(logs).unflatten(0, (-1, 2)).transpose(0, 1)
        return LeaveFutureOut(by_end, torch.stack(effective).amin(0), horizon * origins)


def _require_causal(model: DynamicalVAE, data: Batch, length: int) -> None:
    if model.grouped and data.group is not None:
        names = ", ".join(model.grouped)
        raise ValueError(f"groups share {names}, but densities are of one sequence; remove 'group' from the batch")
    if model.view.history is not None or (data.log_det is not None and data.log_det.dim() == 1):
        raise ValueError(f"leave-future-out needs a density of each step, which {model.view} does not have")
    for factor in model.generative.factors:
        for parent in factor.parents:
            if parent.local and (not factor.local or reads_ahead(parent, length)):
                raise ValueError(
                    f"{factor} reads {parent}, so the density of x_{{1:t}} depends on later steps and leave-future-out "
                    "is not defined; compare such models by their bounds"
                )


def _prefix(data: Batch, ends: Tensor) -> Batch:
    """Return the first steps (B,) of each sequence, in the model's representation."""
    longest = int(ends.max())
    cut = data.map(lambda value: value[:, :longest] if value.dim() == 3 else value)
    if data.log_det is not None:
        cut["log_det"] = data.log_det[:, :longest] * valid_steps(ends.to(data.log_det.device), longest)
    if data.lengths is not None:
        cut["lengths"] = ends.to(data.lengths)
    return cut


def _evidences(model: DynamicalVAE, data: Batch, particles: int, chunk: int) -> tuple[Tensor, Tensor]:
    """Return R estimates of the log evidence, (R, B), and the effective sample size of the particles, (B,)."""
    size, exact = require_data(model, data), None
    if not model.latents:
        exact = importance_weights(model, data, size, 1, chunk)[0]
    elif is_linear_gaussian(model):
        exact = model.filter(data).filtered.log_evidence.sum(1)
    if exact is not None:
        return exact[None], torch.full_like(exact, math.inf)
    if obstacle(model, data):
        weights = importance_weights(model, data, size, REPLICATES * particles, chunk)
        log_weights = weights.unflatten(0, (REPLICATES, -1)).transpose(0, 1)
        _, total, effective = normalise(log_weights)
        return total - math.log(particles), effective.mean(0)
    bound = fivo_bound(model, repeat(data, REPLICATES), particles, chunk=chunk)
    least = bound.effective.nan_to_num(math.inf).amin(0)
    return bound.bound.unflatten(0, (REPLICATES, -1)), least.unflatten(0, (REPLICATES, -1)).mean(0)
