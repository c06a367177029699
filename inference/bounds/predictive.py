"""Log score: the log density of the observed future under the model's forecast, as a bound per sequence.

A forecast draws the latents of the past from the guide, given the past alone, and then runs the model freely. Its
density of the future x_{O+1:T} is therefore

    F = E_{q(w, z_{1:O} | x_{1:O})} p(x_{O+1:T} | w, z_{1:O}, x_{1:O})

which is p(x_{O+1:T} | x_{1:O}) if the guide is the posterior. Its logarithm is a proper score (Gneiting and Raftery,
2007). Draws from F estimate it badly, because few of them come near a given future. Latents are therefore proposed by
the guide given past and future, and weighted:

    F = E_q [ q(w, z_{1:O} | x_{1:O}) prod_{t > O} p(z_t | .) p(x_t | .) / q ],    q = q(w, z_{1:T} | x_{1:T})

The mean of K weights is unbiased for F, so its logarithm is on average at most log F. The bound underestimates the
score, less so with more particles, and not at all if both guides are posteriors.

With missing entries, it is the density of the observed entries of x_{O+1:T}, given the observed ones of x_{1:O}. A
model that reads its own past reads its means at missing entries, as in the bounds.

If the model is one factor with a `distributions.Diffusion` or `FlowMatching`, the score is its density by the
probability-flow ODE, and not a bound.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from pyro import poutine
from torch import Tensor, nn

from ...capture import Captured
from ...data.batch import Batch
from ...distributions.diffusion import DenoisingModule
from ...program.batch import AnyBatch, repeat
from ...program.model import DynamicalVAE
from ...program.rollout import Sequence
from .elbo import IWAEBound, importance_mean, log_densities, replayed_weights, require_densities, sites_of, total


@torch.no_grad()
def predictive_bound(
    model: DynamicalVAE,
    batch: AnyBatch,
    observed: int,
    particles: int = 100,
    *,
    chunk: int = 4096,
    graphs: Captured | None = None,
) -> IWAEBound:
    """Return a lower bound on the log density of the future under the model's forecast; see the module.

    Args:
        model: model with its guide.
        batch: whole sequences (B, T, D), or a mapping with context over all T steps.
        observed: O, number of observed steps.
        particles: K, number of particles.
        chunk: largest number of sequences times particles in memory.
        graphs: CUDA graphs that replay the weights; the batch must then be a `Batch` on the GPU.

    Returns:
        The bound in nats per sequence, and the tail shape of the weights, (B,) each; NaN for a density by the ODE.

    Raises:
        ValueError: when the model has no likelihood or a custom forecast method, the batch is ragged, or no step is
            left to observe or to predict.
    """
    if not (integrates := has_ode(model)):
        if guidance := [g for each in model.generator.values() if (g := getattr(each.head, "guidance", 1)) != 1]:
            raise ValueError(f"forecasts with guidance={guidance[0]} do not follow a known density; omit the log score")
        require_densities(model)
    if type(model).forecast is not DynamicalVAE.forecast or model.view.history is not None:
        raise ValueError(
            f"{type(model).__name__} has a custom forecast, whose density is not known; omit the log score"
        )
    with model.running():
        data = model.read(batch)
        size, length = data[model.observed[0]].shape[:2]
        observed -= model.view.past  # the view's past steps are context, which is always given
        if model.grouped and data.group is not None:
            raise ValueError(
                f"groups share {', '.join(model.grouped)}, but a log score is of one sequence; remove 'group' from the "
                "batch, or omit the log score"
            )
        if data.lengths is not None:
            raise ValueError("a log score needs sequences of equal length; remove 'lengths' from the batch")
        first = 0 if model.view.past else 1
        if particles < 1 or not first <= observed < length:
            context_frames = model.view.past
            raise ValueError(
                f"`particles` must be at least 1, and `observed` must be from {context_frames + first} to "
                f"{context_frames + length - 1}; got particles={particles} and observed={context_frames + observed}"
            )
        log_det = torch.zeros(size, length) if data.log_det is None else data.log_det
        if log_det.dim() == 1:
            raise ValueError(
                "the view has one log-determinant for a whole sequence, so the part of the future is unknown; "
                "omit the log score, or return log_det by entry, (B, T, D), from the view"
            )

        def log_weights(data: Batch, count: int) -> Tensor:
            past = data.map(lambda value: value[:, :observed] if value.dim() == 3 else value)
            repeated = repeat(data, count)
            proposed = poutine.trace(model.guide).get_trace(repeated)
            joint = poutine.trace(poutine.replay(model.model, trace=proposed)).get_trace(repeated)
            if not observed:  # latents are then from the prior
                return total(log_densities(joint)) - total(log_densities(proposed))
            latents = {n: s["value"] for n, s in sites_of(proposed).items()}
            past_latents = {n: v[:, :observed] if model.generative.local(n) else v for n, v in latents.items()}
            past_guide = poutine.trace(poutine.condition(model.guide, data=past_latents)).get_trace(repeat(past, count))
            local = [n for n in model.generative.variables if model.generative.local(n)]
            future = {n: log[:, observed:] for n, log in log_densities(joint).items() if n in local}
            return total(future) + total(log_densities(past_guide)) - total(log_densities(proposed))

        if integrates:
            density = _ode_density(model, data, observed)
            result = IWAEBound(density, torch.full_like(density, math.nan), particles)
        else:
            weights = replayed_weights(graphs, ("log score", observed), model, batch, data, log_weights)
            result = importance_mean(weights, size, particles, chunk)
        return replace(result, bound=result.bound + log_det[:, observed:].sum(1).to(result.bound))


def has_ode(model: nn.Module) -> bool:
    """Return whether the model is one local factor with a `Diffusion` or `FlowMatching` whose draws follow its ODE."""
    if not isinstance(model, DynamicalVAE):
        return False
    first, *others = model.generator.values()
    is_alone = not others and first.factor.local and first.offset is None
    return is_alone and isinstance(first.head, DenoisingModule) and first.head.guidance == 1


def _ode_density(model: DynamicalVAE, data: Batch, observed: int) -> Tensor:
    """Return the log density of the steps after `observed`, (B,)."""
    (name,), run = model.observed, model.rollout(data)
    if model.generator[name].joint and observed:
        raise ValueError(
            f"{model.generator[name].factor} has one density of all steps, not of the future given the past; make the "
            "past context (dvae.data.views.Past), or omit the log score"
        )
    value = run.values[name]
    density: Tensor = run.evaluate(name, value).exact_log_prob(value).log_prob
    return density if density.dim() == 1 else Sequence(run, name).counted(density)[:, observed:].sum(1)
