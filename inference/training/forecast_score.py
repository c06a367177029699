"""Score of forecasts on validation windows, which selects the best weights with `Training(select="forecast")`.

A bound scores one step at a time, given the true past. A model with a better bound can have worse forecasts.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from ...capture import Captured, replayed
from ...data.batch import Batch
from ...data.sequences import as_batches, mean_of_known, tensor_of
from ...program.forecast import require_forecasts
from ...program.model import DynamicalVAE
from ...program.protocols import Emitting, Forecasting
from ..evaluation.evaluation_windows import on_device_of, seeded_evaluation
from ..evaluation.metrics import continuous_ranked_probability_score

NAME = "CRPS"
"""Name of the score in the log, where it has the prefix `validation/`."""
SAMPLES = 20
"""Number of forecasts of a window."""
WINDOWS = 256
"""Largest number of windows, evenly spaced among the validation windows."""


def observed_steps(model: Any, windows: Any) -> int:
    """Return the number of observed steps of validation windows.

    Raises:
        ValueError: when the model does not forecast, or the windows do not define which steps are observed.
    """
    observed: int | None = getattr(getattr(windows, "protocol", None), "observed", None)
    if observed is None or not isinstance(model, Forecasting):
        problem = "validation data without a horizon" if observed is None else f"{type(model).__name__}, no forecaster"
        raise ValueError(
            f'select is "forecast", but got {problem}; give a model that forecasts, and validation windows such as '
            'dvae.ArrayWindows(x, observed=…), or set select="bound"'
        )
    if isinstance(model, DynamicalVAE):
        require_forecasts(model)
    return observed


def forecast_score(model: Any, windows: Any, batch_size: int, seed: int, captured: Captured | None = None) -> float:
    """Return the mean CRPS of forecasts, without a unit; lower is better, infinite if a forecast is not finite.

    Each column is divided by its mean absolute change from one step to the next, over the observed part of the windows.
    A column without changes is divided by its mean absolute deviation from its mean, or by 1. The score averages over
    windows, and in each over columns and steps. Draws are the same at each call.

    Args:
        model: model that forecasts.
        windows: validation windows, with `protocol.observed`.
        batch_size: number of windows to read at a time.
        seed: seed of the draws.
        captured: CUDA graphs by which to replay the forecasts.
    """
    observed, data = observed_steps(model, windows), as_batches(windows)
    every, start, parts = math.ceil(len(data) / WINDOWS), 0, list[dict[str, Tensor]]()
    for batch in data.batches(batch_size):
        rows = Batch(batch).map(tensor_of).rows(slice(-start % every, None, every))
        start += len(batch["x"])
        parts += [rows.leaves()] if len(rows["x"]) else []
    selected = Batch.from_leaves({path: torch.cat([part[path] for part in parts]) for path in parts[0]})
    values = selected.mask_to_nan().double().cpu()
    past, truth = values[:, :observed], values[:, observed:]
    is_drawn = model.is_drawn() if isinstance(model, Emitting) else True

    def forecast(batch: Batch) -> dict[str, Tensor]:
        return {"x": model.forecast(batch, truth.shape[1], SAMPLES, draw_emission=is_drawn)["x"]}

    with seeded_evaluation(model, seed):
        futures = replayed(captured, NAME, forecast)(on_device_of(model, selected.past(observed)))["x"]
    draws = futures.double().cpu()
    scale = scales(past)
    if not draws.isfinite().all():
        return math.inf
    scores = continuous_ranked_probability_score(draws.movedim(0, 1) / scale, truth / scale)
    if scores.isnan().all():
        raise ValueError('no validation window has an observed future; select by the bound, select="bound"')
    return float(mean_of_known(scores, 0))  # some futures may have no observed value


def scales(past: Tensor) -> Tensor:
    """Return the mean absolute change (D,) of columns over windows (N, O, D), NaN where missing."""
    changes = mean_of_known(past.diff(dim=1).abs(), (0, 1))
    spread = mean_of_known((past - mean_of_known(past, (0, 1))).abs(), (0, 1))
    scale = torch.where(changes > 0, changes, spread)  # false of NaN
    return torch.where(scale > 0, scale, 1.0)
