"""Log density of a forecast that repeats the last value: a reference for bounds on validation windows.

    x_t ~ N(x_s, v_{t-s}),    s: the last step before t with an observed value of the coordinate

v_h is the mean square of x_{t+h} - x_t over training windows, for each coordinate. For a model that reads the true
past, the reference is this density given all steps before t.

A model trained with scheduled sampling reads its own means. Its reference uses the mean and variance over training
windows for observed steps, and the last observed value as x_s for all future steps. A discrete value has the
probability of the interval around it. The class of the last value has the probability of no change, and all other
classes share the rest equally.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import constraints

from ...data.batch import WHOLE, Batch
from ...data.sequences import Batched, Source
from ...networks.loop import valid_steps
from ...program.model import DynamicalVAE

WINDOWS = 128
"""Number of training windows used to estimate variances."""
_FLOOR = 1e-3
"""Smallest standard deviation of a difference, in standard deviations of the coordinate."""
_ONE_HOT = type(constraints.one_hot)


def last_value_bound(
    model: DynamicalVAE, train: Source, validation: Batched, observed: int, *, fed: bool, batch_size: int
) -> float:
    """Return the log density of validation windows under the last-value forecast, in nats per step.

    Args:
        model: model. Its view defines the number of first steps without a score, and its distributions define which
            coordinates are discrete.
        train: training windows, for the variances of differences.
        validation: windows to score.
        observed: O, number of steps before the horizon.
        fed: whether the model reads its own means instead of the true past.
        batch_size: number of windows in a batch.
    """
    classes, discrete = _discrete(model)
    mean, spreads = _spreads(*_values(train.sample(WINDOWS, torch.Generator().manual_seed(0))), classes, discrete)
    total, frames = 0.0, 0
    for batch in validation.batches(batch_size):
        x, mask = _values(batch)
        steps = torch.arange(x.shape[1])
        last_observed = torch.where(mask, steps[:, None], -1).cummax(1).values  # last observed step up to each step
        before = torch.where(steps < observed, -1, observed - 1) if fed else steps - 1
        source = torch.where(before[:, None] < 0, -1, last_observed[:, before.clamp(min=0)])
        lag = torch.where(source < 0, 0, steps[:, None] - source).clamp(max=len(spreads) - 1)
        errors = x - torch.where(source < 0, mean, x.gather(1, source.clamp(min=0)))
        spread = spreads.gather(0, lag.flatten(0, 1)).view_as(x)
        entries = _log_density(errors, spread, discrete)
        for columns in classes:
            unchanged, same = spread[..., columns[0]], (errors[..., columns] == 0).all(-1)
            entries[..., columns] = 0.0
            entries[..., columns[0]] = torch.where(same, unchanged, (1 - unchanged) / (len(columns) - 1)).log()
        total += float(entries.masked_fill(~mask, 0.0)[:, model.view.past :].sum())
        lengths = Batch(batch).lengths
        frames += len(x) * (x.shape[1] - model.view.past) if lengths is None else int(lengths.sum())
    return total / frames


def _discrete(model: DynamicalVAE) -> tuple[list[list[int]], Tensor]:
    """Return the coordinates of x grouped by the class they encode, and a mask (D,) of other discrete coordinates."""
    if WHOLE not in model.observed:  # the model observes only parts of x
        return [], torch.tensor(False)
    conditional = model.generator[WHOLE]
    parts = getattr(conditional.support, "parts", [(range(conditional.size), conditional.support)])
    groups = [(list(columns), support) for columns, support in parts if support is not None and support.is_discrete]
    discrete = torch.zeros(conditional.size, dtype=torch.bool)
    for columns, support in groups:
        discrete[columns] = not isinstance(support, _ONE_HOT)
    return [columns for columns, support in groups if isinstance(support, _ONE_HOT)], discrete


def _spreads(x: Tensor, mask: Tensor, classes: Sequence[list[int]], discrete: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean (D,) of training windows, and the standard deviations (T, D) of their differences.

    Row 0 has the standard deviations from the mean, and row h those of differences over h steps. For a class variable,
    only the first coordinate is used: row 0 has 1 / number of classes, later rows the probability of no change.

    Args:
        x: training windows (N, T, D).
        mask: (N, T, D), True where an entry was observed.
        classes: coordinates of each class variable.
        discrete: (D,), True at other discrete coordinates.
    """
    count = mask.sum((0, 1)).clamp(min=1)
    mean = x.sum((0, 1)) / count
    scale = (torch.where(mask, x - mean, 0.0).square().sum((0, 1)) / count).sqrt().clamp(min=1e-6)
    rows = [scale]
    for lag in range(1, x.shape[1]):
        both = mask[:, lag:] & mask[:, :-lag]
        differences = torch.where(both, x[:, lag:] - x[:, :-lag], 0.0)
        pairs = both.sum((0, 1))
        row = torch.where(pairs > 0, (differences.square().sum((0, 1)) / pairs.clamp(min=1)).sqrt(), rows[-1])
        row = torch.maximum(row, _FLOOR * scale)
        for columns in classes:
            same = ((differences[..., columns] == 0).all(-1) & both[..., columns[0]]).sum()
            row[columns[0]] = (same + 1) / (pairs[columns[0]] + 2)
        rows.append(row)
    for columns in classes:
        rows[0][columns[0]] = 1 / len(columns)
    return mean, torch.stack([torch.where(discrete, row.clamp(min=0.1), row) for row in rows])


def _log_density(errors: Tensor, spread: Tensor, discrete: Tensor) -> Tensor:
    """Return the normal log density of errors (..., D); for a discrete coordinate, the log probability of its interval.

    Args:
        errors: values minus their forecast, (..., D).
        spread: standard deviations, which broadcast to the errors.
        discrete: (D,), True at discrete coordinates, which stand for the interval of length 1 around them.
    """
    density = -0.5 * (errors / spread).square() - spread.log() - 0.5 * math.log(2 * math.pi)
    if not discrete.any():
        return density
    ends = [torch.special.ndtr((errors + end) / spread) for end in (-0.5, 0.5)]
    return torch.where(discrete, (ends[1] - ends[0]).clamp(min=1e-12).log(), density)


def _values(data: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
    """Return x (B, T, D) in double precision and the mask of its observed entries."""
    batch = Batch(data)
    x, mask = torch.as_tensor(batch[WHOLE]).double().cpu(), batch.mask()
    observed = torch.ones_like(x, dtype=torch.bool) if mask is None else torch.as_tensor(mask).cpu()
    if batch.lengths is not None:
        observed = observed & valid_steps(torch.as_tensor(batch.lengths).cpu(), x.shape[1])[..., None]
    return torch.where(observed, x, 0.0), observed
