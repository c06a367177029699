"""Forecasts of simple statistical methods, with draws, for tables.

All methods work on a scale on which errors are additive: logarithms of positive values, logits of shares, and values
themselves otherwise. Draws of counts are rounded and at least 0. Draws of logarithms stay in the training range,
widened by its width on both sides. Parameters come from training windows, and the state from the steps before the
forecast.

| method | draws |
|---|---|
| last value | the last value, plus errors |
| drift | the last value plus the mean change per step (Hyndman and Athanasopoulos 2021, section 5.2), plus errors |
| seasonal | the last period, plus errors |
| climatology by series | consecutive steps of the series' own past, continued at its start (Politis and Romano 1992) |
| AR | means of a linear autoregression, plus errors |
| ETS | means of exponential smoothing with damped trend and season (statsmodels), plus errors |
| GLM | negative binomial regression of counts |

Errors are whole paths of errors of the same method in training windows. They come from the same series if it has at
least `OWN` training windows. Otherwise they come from all, multiplied by the ratio of the two windows' scales of
changes. Errors of drift are also divided and multiplied by their standard deviation for a random walk,
sqrt(h (1 + h / n)) after a past of n steps. A missing error is taken from another window at the same step.

Categories and binary columns have no errors: the first three methods repeat their values, and AR, ETS and GLM draw from
the series' own past.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from ...data.batch import Batch
from ...data.sequences import HeldOutWindows, interpolate_missing
from .regressions import LEAST, autoregression, autoregressive_means, carried, fill_missing, negative_binomial, smoothed

Forecaster = Callable[[slice], Tensor]
"""Function from a slice of windows to forecasts (K, B, H, D)."""
POSITIVE = ("positive", "log-normal")
COUNTS = ("count", "overdispersed", "sparse", "sparse-overdispersed")
LABELS = ("binary", "category")
OWN = 20
"""Smallest number of training windows of a series whose errors are used alone."""
FITS, STEPS = 600, 300
"""Largest numbers of fits of exponential smoothing, and of steps before the first forecast that a fit reads."""
ERRORS = 100
"""Number of training windows that errors of exponential smoothing are from; each needs a fit."""
MOST, FEWEST = 4_000_000, 200
"""Largest number of values in the training windows that parameters are from, unless these are `FEWEST` windows."""
Rule = Callable[["Part"], Tensor]
"""Function from windows to values (N, 1 or H, D) on the additive scale."""


@dataclass(frozen=True)
class Part:
    """Windows of a table, with the steps before their forecasts, on the additive scale.

    Args:
        x: `(N, T, D)`, NaN where missing.
        names: series of each window.
        values: steps `(S, D)` of all series one after another, NaN where missing.
        begin, end: indices `(N,)` in `values` of the first step that forecasts may use, and of the first future step.
        context: known covariates `(N, T, C)`, or None.
    """

    x: Tensor
    names: Sequence[str]
    values: Tensor
    begin: Tensor
    end: Tensor
    context: Tensor | None

    @classmethod
    def of(cls, windows: Any, batch: Batch, observed: int, scale: Scale) -> Part:
        """Return windows with the `histories` that they define, or else with their observed steps."""
        x = scale.forward(batch.mask_to_nan().double())
        begin = torch.arange(len(x)) * x.shape[1]
        values, begin, end = x.flatten(0, 1), begin, begin + observed
        is_table = hasattr(windows, "histories") and windows.protocol.observed == observed
        if is_table and (histories := windows.histories()) is not None:
            values, begin, end = histories
            values = scale.forward(values)
        names = [name for _, name, _ in windows.keys] if isinstance(windows, HeldOutWindows) else [""] * len(x)
        return cls(x, names, values, begin, end, batch["c"].double() if "c" in batch else None)

    def thinned(self, most: int, rows: Tensor | None = None) -> Part:
        """Return at most `most` windows, evenly spaced among all or the given ones."""
        rows = torch.arange(len(self.x)) if rows is None else rows
        rows = rows[torch.linspace(0, len(rows) - 1, min(most, len(rows)), dtype=torch.float64).round().long()]
        names, context = (
            [self.names[row] for row in rows.tolist()],
            None if self.context is None else self.context[rows],
        )
        return Part(self.x[rows], names, self.values, self.begin[rows], self.end[rows], context)

    @cached_property
    def means(self) -> tuple[Tensor, Tensor]:
        """Number and mean `(N, D)` of the observed values before the forecasts; the mean of no values is 0."""
        seen, centre = ~self.values.isnan(), self.values.nanmean(0).nan_to_num()  # for precision; it cancels
        sums = [pad(each.cumsum(0), (0, 0, 1, 0)) for each in (seen.double(), (self.values - centre).nan_to_num())]
        number, total = (each[self.end] - each[self.begin] for each in sums)
        return number, torch.where(number > 0, centre + total / number.clamp(min=1), 0.0)

    @cached_property
    def ends(self) -> tuple[Tensor, Tensor]:
        """Indices `(N, D)` in `values` of the first and the last observed value before the forecasts.

        If no value is observed, the first index is above the last one.
        """
        index, seen = torch.arange(len(self.values))[:, None], ~self.values.isnan()
        after = torch.where(seen, index, len(index) - 1).flip(0).cummin(0).values.flip(0)[self.begin]
        before = torch.where(seen, index, -1).cummax(0).values[self.end - 1]
        return torch.where(before < self.begin[:, None], before + 1, after).clamp(min=0), before


@dataclass(frozen=True)
class Scale:
    """Scale on which errors are additive, by the family of each coordinate."""

    families: Sequence[str]

    def which(self, *families: str) -> Tensor:
        """Return the mask `(D,)` of coordinates of these families."""
        return torch.tensor([family in families for family in self.families])

    def forward(self, x: Tensor) -> Tensor:
        """Return values on the additive scale."""
        x = torch.where(self.which(*POSITIVE), x.clamp(min=1e-300).log(), x)
        return torch.where(self.which("share"), x.clamp(1e-12, 1 - 1e-12).logit(), x)

    def inverse(self, y: Tensor) -> Tensor:
        """Return valid values of each family."""
        y = torch.where(self.which(*POSITIVE), y.exp(), y)
        y = torch.where(self.which("share"), y.sigmoid(), y)
        y = torch.where(self.which("angle"), torch.remainder(y + torch.pi, 2 * torch.pi) - torch.pi, y)
        y = torch.where(self.which("hurdle", "power", *COUNTS), y.clamp(min=0), y)
        return torch.where(self.which(*COUNTS), y.round(), y)


@dataclass(frozen=True)
class Baselines:
    """Forecasters of a table by name, each with K draws; see the description of the module.

    Args:
        held, training: windows to forecast and training windows, of equal length.
        scale: scale of the columns.
        observed: O, number of observed steps.
        samples: K, number of draws.
        seed: seed of the draws.
        season: number of steps in a period, if known.
    """

    held: Part
    training: Part
    scale: Scale
    observed: int
    samples: int
    seed: int = 0
    season: int | None = None

    def missing_requirement(self, name: str) -> str:
        """Return what a method requires; empty if it is available."""
        if self._numbers.logical_not().all() and name in ("AR", "ETS"):
            return "a column of numbers"
        if name == "GLM" and not self.scale.which(*COUNTS).any():
            return "a column of counts"
        if name == "ETS":
            shortest = int((self.held.end - self.held.begin).min())
            fits = len({*zip(self.held.names, self.held.begin.tolist(), strict=True)}) + min(
                ERRORS, len(self.training.x)
            )
            fits *= int(self._numbers.sum())
            if find_spec("statsmodels") is None:
                return "statsmodels (pip install 'pyro-dvae[series]')"
            if shortest < LEAST:
                return f"at least {LEAST} steps before each forecast, and the shortest past has {shortest}"
            return f"{fits} fits, and at most {FITS} are made" if fits > FITS else ""
        return ""

    def __getitem__(self, name: str) -> Forecaster:
        makers: Mapping[str, Callable[[], Forecaster]] = {
            "last value": lambda: self._with_errors(self._last),
            "drift": lambda: self._with_errors(self._drift, self._growth),
            "seasonal": lambda: self._with_errors(self._seasonal),
            "climatology by series": lambda: self._own_past,
            "AR": self._autoregression,
            "ETS": self._smoothing,
            "GLM": self._regression,
        }
        return makers[name]()

    @property
    def _numbers(self) -> Tensor:
        return ~self.scale.which(*LABELS)

    @property
    def _horizon(self) -> int:
        return self.held.x.shape[1] - self.observed

    def _generator(self, part: slice) -> torch.Generator:
        return torch.Generator().manual_seed(self.seed + part.start)

    # ------------------------------------------------------------------------------------------ rules plus their errors

    def _last(self, part: Part) -> Tensor:
        """Return the last observed value `(N, 1, D)`; of a coordinate that was never observed, the training mean."""
        first, last = part.ends
        return torch.where(first <= last, part.values.gather(0, last.clamp(min=0)), self._typical)[:, None]

    @cached_property
    def _typical(self) -> Tensor:
        return self.training.x.nanmean((0, 1)).nan_to_num()

    def _drift(self, part: Part) -> Tensor:
        steps = self._steps + (part.end[:, None] - 1 - part.ends[1])[:, None]
        return self._last(part) + self._slope(part)[:, None] * steps

    def _slope(self, part: Part) -> Tensor:
        """Return the mean change per step `(N, D)`, 0 for labels and for fewer than two observed values."""
        first, last = part.ends
        change = self._last(part)[:, 0] - part.values.gather(0, first)
        return torch.where(self._numbers & (first < last), change / (last - first).clamp(min=1), 0.0)

    def _growth(self, part: Part) -> Tensor:
        """Return the standard deviation `(N, H, D)` of errors of drift in a random walk with unit changes."""
        first, last = part.ends
        return (self._steps * (1 + self._steps / (last - first).clamp(min=1)[:, None])).sqrt()

    @property
    def _steps(self) -> Tensor:
        return torch.arange(1.0, self._horizon + 1, dtype=torch.float64)[:, None]

    def _seasonal(self, part: Part) -> Tensor:
        season, past = self.season or 1, part.x[:, : self.observed]
        period = carried(past[:, self.observed % season :].unflatten(1, (-1, season)))[:, -1]
        period = torch.where(period.isnan(), self._last(part), period)  # (N, season, D)
        return period[:, torch.arange(self._horizon) % season]

    def _with_errors(self, rule: Rule, growth: Rule | None = None) -> Forecaster:
        """Return draws of a rule plus paths of its errors in training windows, which are proportional to the growth."""
        (held, training), past = (self._changes(part)[:, None] for part in (self.held, self.training)), self.observed
        grown, growths = (growth(part) if growth else torch.ones(1) for part in (self.training, self.held))
        errors = (self.training.x[:, past:] - rule(self.training)) / training / grown
        errors = fill_missing(torch.where(self._numbers, errors, 0.0), self.seed).nan_to_num()
        point, (order, low, count) = rule(self.held).expand(-1, self._horizon, -1), self._donors
        growths = growths.expand_as(point)

        def forecast(part: slice) -> Tensor:
            chance = torch.rand(self.samples, len(point[part]), generator=self._generator(part), dtype=torch.float64)
            donors = order[low[part] + (chance * count[part]).long()]
            size = torch.where((count < len(order))[part, None, None], training[donors], held[part])
            return self._inverse(point[part] + errors[donors] * size * growths[part])

        return forecast

    def _inverse(self, draws: Tensor) -> Tensor:
        """Return draws in units of the data, with logarithms in bounds."""
        low, high = (
            self.training.x.nan_to_num(math.inf).amin((0, 1)),
            self.training.x.nan_to_num(-math.inf).amax((0, 1)),
        )
        bounded = draws.clamp(2 * low - high, 2 * high - low)
        return self.scale.inverse(torch.where(self.scale.which(*POSITIVE), bounded, draws))

    @cached_property
    def _donors(self) -> tuple[Tensor, Tensor, Tensor]:
        """Training windows by series, and the first and the number `(N,)` of those that a window draws errors from."""
        index = {name: place for place, name in enumerate(dict.fromkeys(self.training.names))}
        series = torch.tensor([index[name] for name in self.training.names])
        counts = series.bincount()
        of_window = torch.tensor([index.get(name, -1) for name in self.held.names])
        own = (of_window >= 0) & (counts[of_window] >= OWN) & (len(index) > 1)
        first = (counts.cumsum(0) - counts)[of_window]
        return series.argsort(stable=True), torch.where(own, first, 0), torch.where(own, counts[of_window], len(series))

    def _changes(self, part: Part) -> Tensor:
        """Return the root mean square `(N, D)` of changes per step in the observed steps.

        One more change is assumed, so that few changes give a reasonable scale: the mean size of the values times a
        median over training windows. Windows of zeros have the median scale.
        """
        ratio, median = self._usual_changes
        number, squares, level = self._change_sums(part)
        scale = ((squares + (ratio * level) ** 2) / (number + 1)).sqrt()
        return torch.where(scale > 0, scale, median)

    @cached_property
    def _usual_changes(self) -> tuple[Tensor, Tensor]:
        """Median scales `(D,)` of changes over training windows that change, relative to the level and in units."""
        number, squares, level = self._change_sums(self.training)
        scale = torch.where(squares > 0, (squares / number).sqrt(), torch.nan)
        return (scale / level).nanmedian(0).values.nan_to_num(0.0), scale.nanmedian(0).values.nan_to_num(1.0)

    def _change_sums(self, part: Part) -> tuple[Tensor, Tensor, Tensor]:
        """Return the number of changes, the sum of their squares per step, and the mean size of values `(N, D)`."""
        past = part.x[:, : self.observed]
        seen = ~past.isnan()
        place = torch.where(seen, torch.arange(self.observed)[:, None], -1).cummax(1).values
        squares = (carried(past).diff(dim=1) ** 2 / place.diff(dim=1).clamp(min=1)).nansum(1)
        level = torch.where(self.scale.which(*POSITIVE, "share"), 1.0, past.abs().nansum(1) / seen.sum(1).clamp(min=1))
        return (seen.sum(1) - 1).clamp(min=0), squares, level

    # ------------------------------------------------------------------------------------------------- own past

    def _own_past(self, part: slice) -> Tensor:
        """Draw consecutive steps of a window's own past; a value of another draw replaces a missing one."""
        begin, length = self.held.begin[part, None], (self.held.end - self.held.begin)[part, None]
        chance = torch.rand(self.samples, *length.shape, generator=self._generator(part), dtype=torch.float64)
        places = begin + ((chance * length).long() + torch.arange(self._horizon)) % length
        draws = fill_missing(self.held.values[places], self.seed)
        return self.scale.inverse(torch.where(draws.isnan(), self._last(self.held)[part], draws))

    # -------------------------------------------------------------------------------------------------- autoregression

    def _autoregression(self) -> Forecaster:
        """Return draws of x_t = sum_j a_j x_{t-j} + b + c slope + e_t, after each series is centred and scaled.

        The centre and the slope are of the series' own past, and the scale is of its changes. Least squares with a
        small ridge, on the future steps of training windows, estimates a, b and c. Errors of a path are consecutive
        residuals of one training window, so a path is the mean plus a whole path of errors.
        """
        lags, coefficients = autoregression(*self._standardised(self.training)[:2], self.observed, self.season)

        def rule(part: Part) -> Tensor:
            z, slope, centre, scale = self._standardised(part)
            means = autoregressive_means(lags, coefficients, z[:, : self.observed], slope, self._horizon)
            return centre + scale * means

        draws = self._with_errors(rule)
        return lambda part: torch.where(self._numbers, draws(part), self._own_past(part))

    def _standardised(self, part: Part) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return windows and their slope in units of their changes, and the centre and unit `(N, 1, D)`."""
        (number, mean), scale = part.means, self._changes(part)
        centre = torch.where(number > 0, mean, self._typical)[:, None]
        return (part.x - centre) / scale[:, None], self._slope(part) / scale, centre, scale[:, None]

    # ------------------------------------------------------------------------------------------- exponential smoothing

    def _smoothing(self) -> Forecaster:
        """Return draws of exponential smoothing with damped trend, and with a season if there is one, plus errors.

        Each series and column is fitted once, to the steps before its first forecast, and smoothed up to the others.
        The errors are of `ERRORS` training windows among the half with the longest past, as forecasts have.
        """
        training = self.training
        longest = (training.end - training.begin).argsort(stable=True)[len(training.x) // 2 :]
        draws = replace(self, training=training.thinned(ERRORS, longest))._with_errors(self._smoothed)
        return lambda part: torch.where(self._numbers, draws(part), self._own_past(part))

    def _smoothed(self, part: Part) -> Tensor:
        means, fits = self._last(part).repeat(1, self._horizon, 1), dict[tuple[Any, ...], tuple[int, Any]]()
        windows = zip(part.names, part.begin.tolist(), part.end.tolist(), strict=True)
        for row, (name, begin, end) in enumerate(windows):
            for d in self._numbers.nonzero().flatten().tolist():
                key = (name, begin, d) if part is self.held else (row, d)
                start, fitted = fits.get(key, (max(begin, end - STEPS), None))
                past = part.values[start:end, d, None] - self._typical[d]
                filled = (interpolate_missing(past, ~past.isnan()) + self._typical[d]).flatten()
                means[row, :, d], fitted = smoothed(filled.numpy(), self.season, self._horizon, fitted)
                fits[key] = start, fitted
        return means

    # -------------------------------------------------------------------------------------------- regression of counts

    def _regression(self) -> Forecaster:
        """Return draws of a negative binomial regression of counts, independent given the past.

        Its regressors are logarithms of the mean of the series' past, of its recent mean (a season, or else a quarter
        of the observed steps) and of its last season, and the known covariates. Other columns are those of AR.
        """
        others, fits = self._autoregression(), dict[int, tuple[Tensor, float]]()
        for d in self.scale.which(*COUNTS).nonzero().flatten().tolist():
            y, x = self.training.x[:, self.observed :, d], self._regressors(self.training, d)
            y, x = y[~y.isnan()], x[~y.isnan()]
            coefficients, dispersion = negative_binomial(x, y)
            logarithm = (self._regressors(self.held, d) @ coefficients).clamp(max=math.log(10 * float(y.max()) + 1))
            fits[d] = logarithm.exp(), dispersion

        def forecast(part: slice) -> Tensor:
            draws, rng = others(part), np.random.default_rng([self.seed, part.start])
            for d, (mean, dispersion) in fits.items():
                rate = mean[part].expand(self.samples, -1, -1).numpy()
                rate = rate * rng.gamma(1 / dispersion, dispersion, rate.shape) if dispersion else rate
                draws[..., d] = torch.from_numpy(rng.poisson(rate)).to(draws)
            return draws

        return forecast

    def _regressors(self, part: Part, d: int) -> Tensor:
        """Return regressors `(N, H, P)` of a count; a training mean is added to each sum, so that it is positive."""
        pooled, (number, mean) = self._typical[d].clamp(min=1e-6), (each[:, d] for each in part.means)
        recent = part.x[:, : self.observed, d][:, -(self.season or max(self.observed // 4, 1)) :]
        sums = [(number * mean, number), (recent.nansum(1), (~recent.isnan()).sum(1))]
        terms = [((total + pooled) / (count + 1)).log()[:, None].expand(-1, self._horizon) for total, count in sums]
        terms += [((self._seasonal(part)[..., d] + pooled) / 2).log()] if self.season else []
        x = torch.stack([torch.ones_like(terms[0]), *terms], -1)
        if part.context is None or self.held.context is None or self.training.context is None:
            return x
        return torch.cat([x, part.context[:, self.observed :]], -1)
