"""FIVO bound: importance weighting with resampling at each step, for any factorization with a forward guide.

    sum_t log 1/K sum_k w_t^k,    w_t = p(z_t | .) p(x_t | .) / q(z_t | .)

K particles of each sequence draw their latents from the guide step by step (`dvae.program.particles`). When their
weights have become too unequal, likely particles replace unlikely ones, and the weights are reset. The product of the
mean weights is an unbiased estimate of the evidence, so the mean of its log is a lower bound. It is the bound of
Maddison et al. (2017, FIVO, arXiv 1705.09279), Le et al. (2018, arXiv 1705.10306) and Naesseth et al. (2018, arXiv
1705.11140).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ...program.batch import AnyBatch
from ...program.model import DynamicalVAE
from ...program.particles import Particles, hidden_data, late_statics, reads_ahead
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
            parts.append(Particles(model, model.rollout(sequences), particles).run(resample_below))
        bound, effective, resamplings = (torch.cat(values, dim=-1) for values in zip(*parts, strict=True))
        return FIVOBound(bound + (0 if data.log_det is None else data.volume), effective, resamplings, particles)


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
    hidden, late = hidden_data(run), late_statics(model)
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
                if parent.name in step_names and reads_ahead(parent, run.length):
                    missing = " where entries are missing" if parent.name in hidden else ""
                    return (
                        f"{factor} reads {parent}, and {parent.name} after t is not drawn yet{missing} when the "
                        f"particles are at t; {instead}"
                    )
    return ""
