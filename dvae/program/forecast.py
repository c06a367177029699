"""Forecasts, reconstructions and imputations of a fitted model.

These functions implement `DynamicalVAE.forecast`, `reconstruct`, `impute` and `states`, which document arguments and
results.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any

import torch
from pyro import poutine
from torch import Tensor

from ..data.batch import WHOLE, Batch
from ..data.sequences import refuse_table
from ..networks.loop import memoizing
from ..options import Count, Range, require
from .batch import AnyBatch, in_chunks, repeat, rows
from .conditional import like
from .groups import Groups

WEIGHT = "log weight"
"""Key of the log importance weight p(z, x observed) / q(z) of each draw."""


def forecast(
    model: Any,
    batch: AnyBatch,
    horizon: int,
    samples: int,
    draw_emission: bool | None,
    fix: Mapping[str, Tensor] | None,
    chunk: int,
) -> dict[str, Tensor]:
    """Infer the latents of the past with the guide, then run the model free.

    If the view makes the whole past context (`views.Past`), the guide has no data to read, and latents come from the
    prior.
    """
    require(Count, horizon=horizon, samples=samples)
    require(Annotated[int, Range(1)], chunk=chunk)
    data = model.read(batch)
    told: Any = batch if isinstance(batch, Mapping) else ()
    redrawn = [name for name in model.shared if name not in told]  # drawn for each sample
    if data.lengths is not None:
        raise ValueError("forecast continues sequences of one length; cut the batch to it, or forecast them in turn")
    first = data.get(model.view.history or model.observed[0])
    size, past = (len(next(v for v in data.values() if isinstance(v, Tensor))), 0) if first is None else first.shape[:2]
    given = {
        name: torch.as_tensor(value).to(like(model).device, None if name in model.wide else like(model).dtype)
        for name, value in (fix or {}).items()
    }
    fixed = _fixed(model, given, data, size, horizon)
    drawn = model.is_drawn() if draw_emission is None else draw_emission
    local = {name for name in data if name in model.context and data[name].dim() == 3}
    seen = data | {name: data[name][:, :past] for name in local}
    if past:
        model.rollout(seen, guide=True)  # validates all sequences before the loop over chunks
    # the guide's features of the past, computed once for all samples
    alike = model.forks and not redrawn and not model.grouped and model.latents[:1] == model.prior_order[:1]
    forked = model.latents[:1] if alike else ()

    @memoizing()
    def futures(part: slice, count: int) -> dict[str, Tensor]:
        known, held = (repeat(rows(each, part), count) for each in (data, fixed))
        observed = rows(seen, part) if forked else repeat(rows(seen, part), count)
        for name in redrawn:
            distribution, some = model.shared[name].distribution(model.sizes[name]), len(known[name]) // count
            known[name] = observed[name] = distribution.sample((count,)).to(known[name]).repeat_interleave(some, 0)
        latents = {name: value for name, value in held.items() if name in model.latents}
        if past:
            latents = poutine.condition(model.guide, latents)(observed, draws=dict.fromkeys(forked, count))
        statics = {name: value for name, value in latents.items() if not model.generative.local(name)}
        if past and model.summed:
            latents |= _given(model, repeat(rows(seen, part), count), latents).summation.draw()
        program = poutine.condition(model.model, data=statics) if statics else model.model
        prefix = {name: value for name, value in latents.items() if name not in statics}
        known |= {name: value for name, value in held.items() if name in model.observed}
        out = program(known, length=past + horizon, prefix=prefix, mean_emission=not drawn)
        made = {name: out[name].unflatten(0, (count, -1)) for name in (*model.observed, *model.latents, *model.summed)}
        made |= {name: made[name][:, :, past:] for name in model.observed}
        made = model.to_data_space(made, rows(data, part))
        again = {n: rows(v, part).expand_as(made[n]) for n, v in given.items() if n in model.observed}
        return (
            model.to_data_space({**made, **again}) if again else made
        )  # the original, since the view's round trip rounds

    # Identical samples are computed once: rows of one matrix product may differ in their last bits.
    distinct = samples if model.latents or model.summed or redrawn or drawn else 1
    out = in_chunks(futures, size, distinct, _together(model, data, size, chunk))
    return out if distinct == samples else {name: value.repeat(samples, 1, 1, 1) for name, value in out.items()}


def _fixed(model: Any, given: Mapping[str, Tensor], data: Batch, size: int, horizon: int) -> dict[str, Tensor]:
    """Return the fixed values as the model sees them; data include the past."""
    free = {*model.observed, *(name for name in model.latents if not model.generative.local(name))}
    for name, value in given.items():
        if name not in free or free & set(model.observed) <= set(given):
            raise ValueError(
                f"cannot fix {', '.join(given)}; fix some of {', '.join(sorted(free))}, but not all of the data"
            )
        shape = (size, horizon, model.sizes[name]) if name in model.observed else (size, model.sizes[name])
        if value.shape != shape:
            raise ValueError(f"the fixed {name} has shape {tuple(value.shape)}, expected {shape}")
    fixed: dict[str, Tensor] = {name: value for name, value in model.view(Batch(given), data).items() if name in given}
    for name in fixed.keys() & {*model.observed}:
        past = data[name] if name in data else data[model.view.history][..., list(model.view.parts[name])]
        fixed[name] = torch.cat([past, fixed[name]], dim=1)
    return fixed


def reconstruct(model: Any, batch: AnyBatch, samples: int, chunk: int) -> dict[str, Tensor]:
    """Return means of the data given latents from the guide, teacher-forced."""
    data = model.read(batch)
    whole = model.rollout(data, guide=True)  # validates all sequences

    def means(part: slice, count: int) -> dict[str, Tensor]:
        some = repeat(rows(data, part), count)
        latents = model.guide(some)
        rollout = _given(model, some, latents)
        if model.summed:
            rollout.states = rollout.summation.draw()
        found = {}
        for name in model.generative.variables:
            if name in model.observed and name not in rollout.values:  # deterministic given its parents
                rollout.know(name, rollout.draw(name))
            if name in model.observed:
                found[name] = model.generator[name].mean(rollout.parameters(name, rollout.values[name]))
        made = {name: mean.unflatten(0, (count, -1)) for name, mean in found.items()}
        return model.to_data_space(made, rows(data, part))

    return in_chunks(means, whole.batch, samples, _together(model, data, whole.batch, chunk))


def states(model: Any, batch: AnyBatch, samples: int, chunk: int) -> dict[str, Tensor]:
    """Return probabilities of the states that are summed out, given the data and latents from the guide."""
    if not model.summed:
        raise ValueError(f"{model.generative} sums out no latent; give discrete latents sizes of dvae.Discrete")
    data = model.read(batch)
    whole = model.rollout(data, guide=True)  # validates all sequences

    def probabilities(part: slice, count: int) -> dict[str, Tensor]:
        some = repeat(rows(data, part), count)
        found = _given(model, some, model.guide(some)).summation.probabilities()
        return {name: value.unflatten(0, (count, -1)) for name, value in found.items()}

    return in_chunks(probabilities, whole.batch, samples, _together(model, data, whole.batch, chunk))


def _given(model: Any, batch: AnyBatch, latents: Mapping[str, Tensor]) -> Any:
    """Return the generative run with data and latents known."""
    rollout = model.rollout(batch)
    rollout.values.update(latents)
    return rollout


def impute(
    model: Any, batch: AnyBatch, samples: int, chunk: int, draw: bool | None, particles: int
) -> dict[str, Tensor]:
    """Return the data with missing entries replaced by means given latents from the guide, or by sequential draws."""
    refuse_table(batch)
    given = Batch(batch if isinstance(batch, Mapping) else {})
    masks = given.masks(WHOLE if model.view.parts else model.observed[0])
    if not masks:
        raise ValueError("this batch has no missing entries; give a 'mask' that is False where entries are to fill")
    drawn = model.is_drawn() if draw is None else draw
    if particles < 1 or (particles > 1 and not (drawn and model.likelihood)):
        raise ValueError(
            f"particles must be at least 1, got {particles}; more choose among draws (draw=True) by their likelihood, "
            f"which {model.generative} {'has' if model.likelihood else 'does not have'}"
        )
    made = _filled(model, batch, samples, chunk, particles) if drawn else model.reconstruct(batch, samples, chunk=chunk)
    found = {}
    for name, mask in masks.items():
        value = made[name]
        lacking = mask.shape[1] - value.shape[2]  # leading frames, which the model reads as context
        value = torch.cat([value[:, :, :1].expand(-1, -1, lacking, -1), value], 2)
        found[name] = torch.where(torch.as_tensor(mask), torch.as_tensor(given[name]).to(value), value)
    return found


def _filled(model: Any, batch: AnyBatch, samples: int, chunk: int, particles: int) -> dict[str, Tensor]:
    """Return the data with missing entries drawn, each given latents from the guide and all earlier values."""
    data = model.read(batch)
    whole = model.rollout(data, guide=True)  # validates all sequences
    groups = whole.groups if model.grouped else None

    def draws(part: slice, count: int) -> dict[str, Tensor]:
        some = repeat(rows(data, part), count)
        guide = poutine.trace(model.guide).get_trace(some)
        rollout = _given(model, some, {name: guide.nodes[name]["value"] for name in model.latents})
        if model.summed:
            rollout.states = rollout.summation.draw()
        rollout.drawing = True
        values = {name: {**rollout.values, **rollout.history(name)}[name] for name in model.observed}
        made = model.to_data_space({n: v.unflatten(0, (count, -1)) for n, v in values.items()}, rows(data, part))
        if particles > 1:
            drawn = (*model.latents, *model.observed)
            ratio = sum(rollout.distribution(name).log_prob(rollout.values[name]) for name in drawn)
            ratio = ratio - sum(guide.nodes[name]["fn"].log_prob(guide.nodes[name]["value"]) for name in model.latents)
            made[WEIGHT] = ratio.unflatten(0, (count, -1))
        return made

    if particles == 1:
        return in_chunks(draws, whole.batch, samples, _together(model, data, whole.batch, chunk))
    return _resampled(draws, whole.batch, samples, particles, chunk, groups)


def _resampled(
    draws: Callable[[slice, int], Mapping[str, Tensor]],
    size: int,
    samples: int,
    particles: int,
    chunk: int,
    groups: Groups | None,
) -> dict[str, Tensor]:
    """Choose samples among K draws each by sampling importance resampling without replacement.

    Sampling without replacement (Gelman et al., Bayesian Data Analysis, 2013, 10.4) takes the largest weights times
    exponential noise (Efraimidis and Spirakis, 2006). Samples stay distinct even if a few weights dominate.

    Args:
        draws: function that returns values (n, b, ...) and `WEIGHT` (n, b) for a slice of b sequences and n draws.
        size: B.
        samples, particles: S and K.
        chunk: maximum of sequences times draws at once.
        groups: groups of sequences that share latents; a group is resampled jointly.
    """
    pool = samples * particles
    at_once = max(1, chunk // pool) if groups is None else size
    found = []
    for first in range(0, size, at_once):

        def some(part: slice, count: int, first: int = first) -> Mapping[str, Tensor]:
            return draws(slice(first + part.start, first + part.stop), count)

        made = in_chunks(some, min(at_once, size - first), pool, chunk if groups is None else max(chunk, size))
        weight = made.pop(WEIGHT).double()
        weight = weight if groups is None else groups.summed(weight)
        chosen = (weight - torch.empty_like(weight).exponential_().log()).topk(samples, 0).indices
        chosen = (chosen if groups is None else chosen[:, groups.place])[..., None, None]
        found.append({name: torch.take_along_dim(value, chosen, 0) for name, value in made.items()})
    return {name: torch.cat([each[name] for each in found], 1) for name in found[0]}


def _together(model: Any, data: Batch, size: int, chunk: int) -> int:
    """Return the maximum of sequences times samples at once; at least all sequences if groups of them share latents."""
    return max(chunk, size) if model.grouped and data.group is not None else chunk
