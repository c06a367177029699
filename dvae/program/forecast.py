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
from ..data.sequences import refuse_table, tensor_of
from ..data.views import GIVEN
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
    """Infer the latents of the past with the guide, then continue with draws from the model.

    If the view makes the whole past context (`views.Past`), the guide has no data to read, and latents come from the
    prior.
    """
    require(Count, horizon=horizon, samples=samples)
    require(Annotated[int, Range(1)], chunk=chunk)
    require_forecasts(model)
    if model.view.given:
        return _forecast_given(model, batch, horizon, samples, draw_emission, fix, chunk)
    data = model.read(batch)
    names: Any = batch if isinstance(batch, Mapping) else ()
    redrawn = [name for name in model.shared if name not in names]  # drawn for each sample
    if data.lengths is not None:
        raise ValueError(
            "forecast continues sequences of one length, but the batch has 'lengths'; forecast each length separately"
        )
    first = data.get(model.view.history or model.observed[0])
    size, past = (len(next(v for v in data.values() if isinstance(v, Tensor))), 0) if first is None else first.shape[:2]
    fixed_data = {
        name: torch.as_tensor(value).to(like(model).device, None if name in model.wide else like(model).dtype)
        for name, value in (fix or {}).items()
    }
    fixed = _fixed_values(model, fixed_data, data, size, horizon)
    draw_data = model.is_drawn() if draw_emission is None else draw_emission
    local = {name for name in data if name in model.context and data[name].dim() == 3}
    past_data = data | {name: data[name][:, :past] for name in local}
    if past:
        model.rollout(past_data, guide=True)  # validates all sequences before the loop over chunks
    # the guide's features of the past, computed once for all samples
    share_latents = model.forks and not redrawn and not model.grouped and model.latents[:1] == model.prior_order[:1]
    forked = model.latents[:1] if share_latents else ()

    @memoizing()
    def futures(part: slice, count: int) -> dict[str, Tensor]:
        inputs, fixed_part = (repeat(rows(each, part), count) for each in (data, fixed))
        observed = rows(past_data, part) if forked else repeat(rows(past_data, part), count)
        for name in redrawn:
            some, device = len(inputs[name]) // count, like(model).device
            draws = model.shared[name].distribution(model.sizes[name], device=device).sample((count,))
            inputs[name] = observed[name] = draws.to(inputs[name]).repeat_interleave(some, 0)
        latents = {name: value for name, value in fixed_part.items() if name in model.latents}
        if past:
            latents = poutine.condition(model.guide, latents)(observed, draws=dict.fromkeys(forked, count))
        statics = {name: value for name, value in latents.items() if not model.generative.local(name)}
        if past and model.summed:
            latents |= _with_latents(model, repeat(rows(past_data, part), count), latents).summation.draw()
        program = poutine.condition(model.model, data=statics) if statics else model.model
        prefix = {name: value for name, value in latents.items() if name not in statics}
        inputs |= {name: value for name, value in fixed_part.items() if name in model.observed}
        out = program(inputs, length=past + horizon, prefix=prefix, mean_emission=not draw_data)
        values = {
            name: out[name].unflatten(0, (count, -1)) for name in (*model.observed, *model.latents, *model.summed)
        }
        values |= {name: values[name][:, :, past:] for name in model.observed}
        past_inputs = model.view.following(rows(data, part))
        values = model.to_data_space(values, past_inputs)
        originals = {n: rows(v, part).expand_as(values[n]) for n, v in fixed_data.items() if n in model.observed}
        # fixed values are returned as given, since mapping them to the view and back rounds
        return model.to_data_space({**values, **originals}) if originals else values

    # Identical samples are computed once: rows of one matrix product may differ in their last bits.
    distinct = samples if model.latents or model.summed or redrawn or draw_data else 1
    out = in_chunks(futures, size, distinct, _chunk_size(model, data, size, chunk))
    return out if distinct == samples else {name: value.repeat(samples, 1, 1, 1) for name, value in out.items()}


def require_forecasts(model: Any) -> None:
    """Refuse a model that draws all steps of a variable jointly, without their past as context.

    Raises:
        ValueError: when the model cannot forecast.
    """
    if not model.can_forecast:
        name = next(name for name, each in model.generator.items() if each.joint)
        raise ValueError(
            f"{model.generator[name].factor} draws all steps of {name} jointly, and not given some of them, so "
            "the model cannot forecast. Make the past context (dvae.data.views.Past), or use a distribution of single "
            'steps. Bounds need no forecasts: select="bound" (--select bound), dvae compare --no-forecasts'
        )


def _forecast_given(
    model: Any,
    batch: AnyBatch,
    horizon: int,
    samples: int,
    draw_emission: bool | None,
    fix: Mapping[str, Tensor] | None,
    chunk: int,
) -> dict[str, Tensor]:
    """Impute the steps after a batch, given its observed entries (`views.Given`)."""
    refuse_table(batch)
    values = Batch(batch if isinstance(batch, Mapping) else {WHOLE: batch})
    if fix or values.lengths is not None:
        raise ValueError(
            f"{model.generative} forecasts sequences of one length, without fixed values; remove "
            f"{'`fix`' if fix else 'lengths'}"
        )
    x = tensor_of(values[WHOLE])
    mask = torch.ones_like(x, dtype=torch.bool) if values.mask() is None else tensor_of(values.mask())
    future = x.new_zeros(len(x), horizon, x.shape[2])
    whole = values | {WHOLE: torch.cat([x, future], 1), "mask": torch.cat([mask, future.bool()], 1)}
    return {WHOLE: model.impute(whole, samples, draw=draw_emission, chunk=chunk)[WHOLE][:, :, x.shape[1] :]}


def _fixed_values(model: Any, values: Mapping[str, Tensor], data: Batch, size: int, horizon: int) -> dict[str, Tensor]:
    """Return the fixed values in the model's representation; values of data variables start with the past.

    Args:
        model: model that forecasts.
        values: fixed values by name, futures (B, H, D) of data variables or values (B, D) of static latents.
        data: batch of the past, as returned by `read`.
        size: B.
        horizon: H.

    Raises:
        ValueError: if a variable cannot be fixed, or a value has the wrong shape.
    """
    free = {*model.observed, *(name for name in model.latents if not model.generative.local(name))}
    for name, value in values.items():
        if name not in free or free & set(model.observed) <= set(values):
            raise ValueError(
                f"cannot fix {', '.join(values)}; fix some of {', '.join(sorted(free))}, but not all data variables"
            )
        shape = (size, horizon, model.sizes[name]) if name in model.observed else (size, model.sizes[name])
        if value.shape != shape:
            raise ValueError(f"the fixed {name} has shape {tuple(value.shape)}, expected {shape}")
    fixed: dict[str, Tensor] = {
        name: value for name, value in model.view(Batch(values), data).items() if name in values
    }
    for name in fixed.keys() & {*model.observed}:
        past = data[name] if name in data else data[model.view.history][..., list(model.view.parts[name])]
        fixed[name] = torch.cat([past, fixed[name]], dim=1)
    return fixed


def reconstruct(model: Any, batch: AnyBatch, samples: int, chunk: int) -> dict[str, Tensor]:
    """Return means of the data given latents from the guide, teacher-forced."""
    data = model.read(batch)
    run = model.rollout(data, guide=True)  # validates all sequences

    def means(part: slice, count: int) -> dict[str, Tensor]:
        part_batch = repeat(rows(data, part), count)
        latents = model.guide(part_batch)
        rollout = _with_latents(model, part_batch, latents)
        if model.summed:
            rollout.states = rollout.summation.draw()
        means_by_name = {}
        for name in model.generative.variables:
            if name in model.observed and name not in rollout.values:  # deterministic given its parents
                rollout.know(name, rollout.draw(name))
            if name in model.observed:
                means_by_name[name] = model.generator[name].mean(rollout.parameters(name, rollout.values[name]))
        values = {name: mean.unflatten(0, (count, -1)) for name, mean in means_by_name.items()}
        return model.to_data_space(values, rows(data, part))

    return in_chunks(means, run.batch, samples, _chunk_size(model, data, run.batch, chunk))


def states(model: Any, batch: AnyBatch, samples: int, chunk: int) -> dict[str, Tensor]:
    """Return probabilities of the states that are summed out, given the data and latents from the guide."""
    if not model.summed:
        raise ValueError(
            f"{model.generative} sums out no latent; set the size of a discrete latent to dvae.Discrete(states)"
        )
    data = model.read(batch)
    run = model.rollout(data, guide=True)  # validates all sequences

    def probabilities(part: slice, count: int) -> dict[str, Tensor]:
        part_batch = repeat(rows(data, part), count)
        values = _with_latents(model, part_batch, model.guide(part_batch)).summation.probabilities()
        return {name: value.unflatten(0, (count, -1)) for name, value in values.items()}

    return in_chunks(probabilities, run.batch, samples, _chunk_size(model, data, run.batch, chunk))


def _with_latents(model: Any, batch: AnyBatch, latents: Mapping[str, Tensor]) -> Any:
    """Return a run of the generative model with the values of data and latents."""
    rollout = model.rollout(batch)
    rollout.values.update(latents)
    return rollout


def impute(
    model: Any, batch: AnyBatch, samples: int, chunk: int, draw: bool | None, particles: int
) -> dict[str, Tensor]:
    """Return the data with missing entries replaced by means given latents from the guide, or by sequential draws."""
    refuse_table(batch)
    values = Batch(batch if isinstance(batch, Mapping) else {})
    masks = values.masks(WHOLE if model.view.parts else model.observed[0])
    if not masks:
        raise ValueError("this batch has no missing entries; give a 'mask' that is False at the entries to fill")
    joint = [name for name in model.observed if model.generator[name].joint]
    if joint and not model.view.given:
        raise ValueError(
            f"all steps of {', '.join(joint)} are drawn jointly, and not given the observed ones, so they cannot be "
            "imputed; make the given entries context (dvae.data.views.Given), or use a distribution of single steps"
        )
    drawing = model.is_drawn() if draw is None else draw
    exact = model.likelihood and not model.bounded
    if particles < 1 or (particles > 1 and not (drawing and exact)):
        raise ValueError(
            f"particles must be at least 1, and more than 1 require draws (draw=True) and a likelihood, which "
            f"{model.generative} {'has' if exact else 'does not have'}; got {particles} and draw={drawing}"
        )
    if model.view.given:
        draws = _impute_given(model, values, samples, chunk, drawing)
    elif drawing:
        draws = _impute_draws(model, batch, samples, chunk, particles)
    else:
        draws = model.reconstruct(batch, samples, chunk=chunk)
    filled = {}
    for name, mask in masks.items():
        value = draws[name]
        n_context = mask.shape[1] - value.shape[2]  # leading frames, which the model reads as context
        value = torch.cat([value[:, :, :1].expand(-1, -1, n_context, -1), value], 2)
        observed, given = torch.as_tensor(mask).to(value.device), torch.as_tensor(values[name]).to(value)
        filled[name] = torch.where(observed, given, value)
    return filled


def _impute_draws(model: Any, batch: AnyBatch, samples: int, chunk: int, particles: int) -> dict[str, Tensor]:
    """Return the data with missing entries drawn, each given latents from the guide and all earlier values."""
    data = model.read(batch)
    run = model.rollout(data, guide=True)  # validates all sequences
    groups = run.groups if model.grouped else None

    def draws(part: slice, count: int) -> dict[str, Tensor]:
        part_batch = repeat(rows(data, part), count)
        guide = poutine.trace(model.guide).get_trace(part_batch)
        rollout = _with_latents(model, part_batch, {name: guide.nodes[name]["value"] for name in model.latents})
        if model.summed:
            rollout.states = rollout.summation.draw()
        rollout.drawing = True
        values = {name: {**rollout.values, **rollout.history(name)}[name] for name in model.observed}
        results = model.to_data_space({n: v.unflatten(0, (count, -1)) for n, v in values.items()}, rows(data, part))
        if particles > 1:
            names = (*model.latents, *model.observed)
            ratio = sum(rollout.distribution(name).log_prob(rollout.values[name]) for name in names)
            ratio = ratio - sum(guide.nodes[name]["fn"].log_prob(guide.nodes[name]["value"]) for name in model.latents)
            results[WEIGHT] = ratio.unflatten(0, (count, -1))
        return results

    if particles == 1:
        return in_chunks(draws, run.batch, samples, _chunk_size(model, data, run.batch, chunk))
    return _resample(draws, run.batch, samples, particles, chunk, groups)


def _impute_given(model: Any, batch: Batch, samples: int, chunk: int, drawing: bool) -> dict[str, Tensor]:
    """Return draws or means of x given all its observed entries (`views.Given`)."""
    name, mask = model.observed[0], torch.as_tensor(batch.mask())
    read = model.read(batch | {GIVEN: mask})
    missing = ~mask.to(read[name].device)
    data = Batch({n: v for n, v in read.items() if n != name} | {"mask": {name: missing}})
    data.reader = read.reader

    def draws(part: slice, count: int) -> dict[str, Tensor]:
        out = model.model(repeat(rows(data, part), count), length=mask.shape[1], mean_emission=not drawing)
        return model.to_data_space({name: out[name].unflatten(0, (count, -1))}, rows(data, part))  # type: ignore[no-any-return]

    return in_chunks(draws, len(mask), samples, chunk)


def _resample(
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
        samples, particles: S, number of samples to keep, and K, number of draws per sample.
        chunk: maximum of sequences times draws at once.
        groups: groups of sequences that share latents; a group is resampled jointly.
    """
    pool = samples * particles
    at_once = max(1, chunk // pool) if groups is None else size
    results = []
    for first in range(0, size, at_once):

        def draw_part(part: slice, count: int, first: int = first) -> Mapping[str, Tensor]:
            return draws(slice(first + part.start, first + part.stop), count)

        pool_values = in_chunks(
            draw_part, min(at_once, size - first), pool, chunk if groups is None else max(chunk, size)
        )
        weight = pool_values.pop(WEIGHT).double()
        weight = weight if groups is None else groups.summed(weight)
        indices = (weight - torch.empty_like(weight).exponential_().log()).topk(samples, 0).indices
        indices = (indices if groups is None else indices[:, groups.place])[..., None, None]
        results.append({name: torch.take_along_dim(value, indices, 0) for name, value in pool_values.items()})
    return {name: torch.cat([each[name] for each in results], 1) for name in results[0]}


def _chunk_size(model: Any, data: Batch, size: int, chunk: int) -> int:
    """Return the maximum of sequences times samples at once; at least all sequences if groups of them share latents."""
    return max(chunk, size) if model.grouped and data.group is not None else chunk
