"""Teacher-forced scores of one model in a comparison: bounds, active units and information of the latents.

References: Burda et al., 2016, arXiv 1509.00519 (IWAE bound, active units); Vehtari et al., 2024, arXiv 1507.02646
(k-hat); Hoffman and Johnson, 2016, "ELBO surgery", and Poole et al., 2019, arXiv 1905.06922 (information).
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from pyro import poutine
from torch import Tensor

from ...data.batch import Batch
from ...networks.loop import valid_steps
from ...program.batch import repeat
from ...program.model import DynamicalVAE
from ...program.rollout import Sequence as SequenceDistribution
from ..evaluation.evaluation_windows import on_device_of, refuse_non_finite
from .elbo import SequenceELBO, iwae_bound, site_log_prob, sites_of
from .particles import fivo_bound

_GUIDE_DRAWS = 8  # averaged for posterior means; the variance of the remaining noise is subtracted


def bounds(
    name: str,
    model: DynamicalVAE,
    batch: Batch,
    keys: Sequence[tuple[str, str, int]],
    particles: int,
    estimates: int,
    parts: Iterable[slice],
) -> dict[str, Any]:
    """Return the bounds of one model for N sequences.

    Args:
        name: name of the model, for errors.
        model: model with its guide.
        batch: batch of all sequences.
        keys: (split, cluster, first step) of each sequence, for errors.
        particles: K of the IWAE bound.
        estimates: E, number of independent IWAE estimates of every sequence.
        parts: slices of the sequences, evaluated one after another.

    Returns:
        "bounds": ELBO, IWAE bound, k-hat and KL of each latent by name, (N,) each, in nats per sequence. "kl_steps":
        mean KL by step, (T,), of each local latent. "estimates": (E, N). "steps": numbers of valid steps (N,).

    Raises:
        FloatingPointError: when a bound is not finite.
    """
    results: list[dict[str, Tensor]] = []
    steps: dict[str, Tensor] = {}
    for part in parts:
        piece = on_device_of(model, batch.rows(part))
        terms = SequenceELBO().terms(model, piece)
        draws = [iwae_bound(model, piece, particles=particles) for _ in range(estimates)]
        values = torch.stack([draw.bound for draw in draws])
        scores = {"ELBO": terms.bound, "IWAE bound": values.mean(0)}
        for bound in scores.values():
            refuse_non_finite(name, "bound", bound.isfinite(), keys[part])
        scores["k-hat"] = torch.stack([draw.khat for draw in draws]).mean(0)
        scores |= {f"KL {latent}": kl for latent, kl in terms.kl.items()}
        for latent in terms.kl.keys() & terms.steps.keys():
            steps[latent] = steps.get(latent, 0) + terms.steps[latent].double().sum(0)
        scores |= {"estimates": values, "steps": terms.n_steps}
        results.append({metric: value.double().cpu() for metric, value in scores.items()})
    merged = {metric: torch.cat([piece[metric] for piece in results], dim=-1) for metric in results[0]}
    weighted, length = merged.pop("estimates"), merged.pop("steps")
    return {
        "bounds": {metric: values.numpy() for metric, values in merged.items()},
        "kl_steps": {
            latent: (total.cpu() / _count_by_step(length, len(total)).clamp(min=1)).numpy()
            for latent, total in steps.items()
        },
        "estimates": weighted.numpy(),
        "steps": length.numpy(),
    }


def filtered(
    name: str,
    model: DynamicalVAE,
    batch: Batch,
    keys: Sequence[tuple[str, str, int]],
    particles: int,
    parts: Iterable[slice],
) -> dict[str, np.ndarray]:
    """Return the FIVO bound of each sequence, {"FIVO bound": (N,)}, in nats.

    Args:
        name: name of the model, for errors.
        model: model with its guide.
        batch: batch of all N sequences.
        keys: (split, cluster, first step) of each sequence, for errors.
        particles: K, number of particles.
        parts: slices of the sequences, evaluated one after another.

    Raises:
        FloatingPointError: when a bound is not finite.
    """
    values = []
    for part in parts:
        bound = fivo_bound(model, on_device_of(model, batch.rows(part)), particles).bound
        refuse_non_finite(name, "FIVO bound", bound.isfinite(), keys[part])
        values.append(bound.double().cpu())
    return {"FIVO bound": torch.cat(values).numpy()}


def variances(model: DynamicalVAE, batch: Batch, parts: Iterable[slice]) -> dict[str, np.ndarray]:
    """Return the variance (D,) over sequences of each latent's posterior mean, by name of the latent.

    Variances of local latents are pooled over steps. The noise of posterior means over a few draws is subtracted.

    Args:
        model: model with its guide.
        batch: batch of all sequences.
        parts: slices of the sequences, evaluated one after another.
    """
    sums: dict[str, Tensor] = {}
    for part in parts:
        piece = on_device_of(model, batch.rows(part))
        draws = [_posterior_means(model, piece) for _ in range(_GUIDE_DRAWS)]
        for name in draws[0]:
            means = torch.stack([draw[name] for draw in draws]).double()
            mean, noise = means.mean(0), means.var(0) / _GUIDE_DRAWS
            valid = torch.ones_like(mean)
            if piece.lengths is not None and mean.shape[1] > 1:
                valid = valid * valid_steps(piece.lengths, mean.shape[1])[..., None]
            moments = torch.stack([(valid * value).sum(0) for value in (torch.ones_like(mean), mean, mean**2, noise)])
            sums[name] = sums[name] + moments if name in sums else moments
    result = {}
    for name, (count, total, squares, noise) in sums.items():
        between = (squares - total**2 / count.clamp(min=1)).sum(0) / (count - 1).clamp(min=0).sum(0)
        result[name] = (between - noise.sum(0) / count.sum(0)).cpu().numpy()
    return result


def _posterior_means(model: DynamicalVAE, batch: Batch) -> dict[str, Tensor]:
    """Return the means (B, T, D), or (B, 1, D) if static, of each latent's conditional at a draw from the guide."""
    means = {}
    for name, site in sites_of(poutine.trace(model.guide).get_trace(batch)).items():
        fn, value = site["fn"], site["value"]
        local = isinstance(fn, SequenceDistribution)
        means[name] = fn.steps(value).mean if local else fn.mean[:, None]
    return means


def information(model: DynamicalVAE, batch: Batch, parts: Iterable[slice]) -> dict[str, np.ndarray]:
    """Return each latent's information about the data, by name of the latent; `compare` defines it.

    Args:
        model: model with its guide.
        batch: batch of the M sequences that are contrasted with each other.
        parts: slices of the sequences, evaluated one after another.

    Returns:
        Information in nats: by step (T,) for a local latent, (1,) for a static one; at most log M.
    """
    batch = on_device_of(model, batch)
    size = length_of(batch)
    latents = model.guide(batch) if size else {}
    totals: dict[str, Tensor] = {}
    counts: dict[str, Tensor] = {}
    for part in parts:
        rows = torch.arange(size)[part]
        values = {name: value[part].repeat_interleave(size, 0) for name, value in latents.items()}
        guide = poutine.condition(model.guide, data=values)
        trace = poutine.trace(guide).get_trace(repeat(batch, len(rows)))
        for name, site in sites_of(trace).items():
            density = site_log_prob(site["fn"], site["value"]).unflatten(0, (len(rows), size)).double()
            density = density[..., None] if density.dim() == 2 else density
            valid = torch.ones_like(density[0], dtype=torch.bool)
            if batch.lengths is not None and density.shape[2] > 1:
                valid = valid_steps(batch.lengths, density.shape[2])
            density = density.masked_fill(~valid, -math.inf)
            matched = density[torch.arange(len(rows)), rows]
            mixture = density.logsumexp(1) - valid.sum(0).clamp(min=1).double().log()
            gain = torch.where(valid[part], matched - mixture, 0.0).sum(0)
            totals[name] = totals[name] + gain if name in totals else gain
            counts[name] = valid.sum(0).clamp(min=1)
    return {name: (total / counts[name]).cpu().numpy() for name, total in totals.items()}


def length_of(batch: Batch) -> int:
    """Return N, the number of sequences."""
    return len(next(value for value in batch.values() if isinstance(value, Tensor)))


def _count_by_step(lengths: Tensor, steps: int) -> Tensor:
    """Return the number of sequences that reach each step, (T,)."""
    return (lengths[:, None] > torch.arange(steps)).sum(0)
