"""Regressions of simple forecasts: autoregression, exponential smoothing and counts; and arrays with missing values."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import torch
from torch import Tensor

LAGS = 8
"""Largest order of an autoregression."""
RIDGE = 0.1
"""Ridge of standardised regressors."""
LEAST = 10
"""Smallest number of steps for exponential smoothing."""


def carried(x: Tensor) -> Tensor:
    """Return `(N, T, ...)` with missing entries (NaN) replaced by the last observed one, NaN before the first."""
    steps = torch.arange(x.shape[1]).reshape(1, -1, *[1] * (x.ndim - 2))
    return x.gather(1, torch.where(x.isnan(), 0, steps).cummax(1).values)


def fill_missing(errors: Tensor, seed: int = 0) -> Tensor:
    """Return errors `(M, ...)` with missing entries (NaN) replaced by an entry of another row at the same place."""
    if not errors.isnan().any():
        return errors
    order = torch.randperm(len(errors), generator=torch.Generator().manual_seed(seed))
    return carried(carried(torch.cat([errors[order]] * 2)[None]))[0, len(errors) :][order.argsort()]


def autoregression(
    z: Tensor, slope: Tensor, observed: int, season: int | None = None
) -> tuple[tuple[int, ...], Tensor]:
    """Fit linear autoregressions of D columns to the future steps of training windows, with the lags of smallest BIC.

    BIC selects the order, and whether to add one season, one more step, and two seasons.

    Args:
        z: windows `(N, O + H, D)`, standardised, NaN where missing.
        slope: mean change per step `(N, D)` of the windows' past.
        observed: O, number of observed steps.
        season: number of steps in a period, if known.

    Returns:
        The L lags, and coefficients `(L + 2, D)` of the lags, an intercept and the slope.
    """
    y, steps = z[:, observed:], range(observed, z.shape[1])
    seen = ~y.isnan()
    seasonal = {lag for lag in (season, season + 1, 2 * season) if lag <= observed} if season else set()
    orders = [set(range(1, order + 1)) for order in range(1, min(LAGS, observed) + 1)]
    number, fits = seen.sum((0, 1)).clamp(min=1), []
    for lags in dict.fromkeys(tuple(sorted(order | more)) for more in (set(), seasonal) for order in orders):
        x = _design(z, slope, lags, steps)
        gram = torch.einsum("nhpd,nhqd,nhd->dpq", x, x, seen.to(x)) + RIDGE * torch.eye(len(lags) + 2)
        coefficients = torch.linalg.solve(gram, torch.einsum("nhpd,nhd->dp", x, y.nan_to_num())).T
        squares = ((y - torch.einsum("nhpd,pd->nhd", x, coefficients)) ** 2).nansum((0, 1)) / number
        criterion = (number * squares.clamp(min=1e-300).log() + len(lags) * number.log()).sum()
        fits.append((float(criterion), lags, coefficients))
    return min(fits, key=lambda fit: fit[0])[1:]


def autoregressive_means(lags: tuple[int, ...], coefficients: Tensor, z: Tensor, slope: Tensor, horizon: int) -> Tensor:
    """Return the means `(N, H, D)` of the futures of windows `(N, O, D)`, for the result of `autoregression`."""
    state, level = list(carried(z).nan_to_num().unbind(1)), coefficients[-2] + coefficients[-1] * slope
    for _ in range(horizon):
        terms = [coefficient * state[-lag] for lag, coefficient in zip(lags, coefficients[:-2], strict=True)]
        state.append(torch.stack([level, *terms]).sum(0))
    return torch.stack(state[-horizon:], 1)


def _design(z: Tensor, slope: Tensor, lags: tuple[int, ...], steps: range) -> Tensor:
    """Return regressors `(N, H, L + 2, D)` of some steps; a missing lag is the last observed value before it."""
    filled = carried(z).nan_to_num()
    constant = torch.ones_like(filled[:, steps.start : steps.stop])
    columns = [filled[:, steps.start - lag : steps.stop - lag] for lag in lags]
    return torch.stack([*columns, constant, slope[:, None].expand_as(constant)], 2)


def smoothed(y: np.ndarray, season: int | None, horizon: int, fitted: Any = None) -> tuple[Tensor, Any]:
    """Return the means `(H,)` of the future by exponential smoothing ETS(A, Ad, N) or ETS(A, Ad, A), and the fit.

    Args:
        y: past `(T,)`.
        season: number of steps in a period; used if the past has two periods.
        horizon: H, number of steps.
        fitted: fit to a start of this series; None to fit.
    """
    from statsmodels.tsa.exponential_smoothing.ets import ETSModel

    if np.ptp(y) == 0:
        return torch.full((horizon,), float(y[-1]), dtype=torch.float64), fitted
    centre, scale, period, parameters = fitted or (y.mean(), y.std(), 0, None)
    if parameters is None and season and len(y) >= max(2 * season, season + LEAST):
        period = season
    options = {"seasonal": "add", "seasonal_periods": period} if period else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of convergence; parameters are admissible at every iteration
        model = ETSModel((y - centre) / scale, error="add", trend="add", damped_trend=True, **options)
        result = model.fit(disp=False) if parameters is None else model.smooth(parameters)
    return torch.from_numpy(centre + scale * result.forecast(horizon)), (centre, scale, period, result.params)


def negative_binomial(x: Tensor, y: Tensor) -> tuple[Tensor, float]:
    """Return coefficients `(P,)` and dispersion of a regression of counts with mean exp(x b).

    The variance is mean + dispersion mean². Iteratively reweighted least squares estimates b, and the dispersion, at
    least 0, makes Pearson's statistic equal to its degrees of freedom (Breslow 1984).

    Args:
        x: regressors `(R, P)`.
        y: counts `(R,)`.
    """
    mean, dispersion, ridge = (y + y.mean()) / 2 + 1e-9, 1.0, 1e-6 * torch.eye(x.shape[1])
    eta, coefficients = mean.log(), torch.zeros(x.shape[1]).to(x)
    for _ in range(100):
        weight, previous = mean / (1 + dispersion * mean), coefficients
        target = x.T @ (weight * (eta + (y - mean) / mean))
        coefficients = torch.linalg.solve(x.T @ (weight[:, None] * x) + ridge, target)
        eta = (x @ coefficients).clamp(-30, 30)
        mean = eta.exp()
        pearson = ((y - mean) ** 2 / (mean + dispersion * mean**2)).sum() / max(len(y) - x.shape[1], 1)
        dispersion *= min(max(float(pearson), 0.1), 10.0)
        if torch.allclose(coefficients, previous, atol=1e-8) and (abs(pearson - 1) < 1e-6 or dispersion < 1e-8):
            break
    return coefficients, dispersion if dispersion > 1e-6 else 0.0
