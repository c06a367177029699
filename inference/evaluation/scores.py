"""Scores of forecasts as small objects, for any sequences; an application adds its own.

A `Measure` is a function of forecasts and truth with a name, a unit and the direction that is better. A set of scores
is a function of the evaluated windows:

    speed = Measure("speed error", lambda forecasts, truth, past, index: ..., unit="m/s")
    dvae.evaluate(model, windows, scores=lambda windows: [*proper(windows), speed])

`proper` returns proper scoring rules, and `calibrated` adds coverage, sharpness, PIT and TARP, for data of any kind.
`by_column` scores each column separately, in its own unit, `by_step` scores single steps, and `over_horizon` assesses
calibration at single steps. Bounds, k-hat, KL and the log score need the model instead of forecasts; `dvae.evaluate`
has options for them.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...data.batch import Batch
from ...data.sequences import HeldOutWindows, axis_names, columns_of, interpolate_missing, scales_of
from . import metrics


@dataclass(frozen=True)
class Metric:
    """Description of how to read a score.

    Args:
        unit: unit of the score.
        program: "free-running" or "teacher-forced".
        better: "lower", "higher", or "" for neither.
        partial: whether the score may be NaN for some clusters; its mean then omits them.
    """

    unit: str = ""
    program: str = "free-running"
    better: str = "lower"
    partial: bool = False


LOG_SCORE = Metric("nats/step", "free-running", "higher")
TEACHER_FORCED = {
    "ELBO": Metric("nats/step", "teacher-forced", "higher"),
    "IWAE bound": Metric("nats/step", "teacher-forced", "higher"),
    "k-hat": Metric("", "teacher-forced"),
}
KL = Metric("nats/step", "teacher-forced", "")


def cluster_means(values: Tensor, clusters: Tensor) -> Sequence[Any]:
    """Return means over the windows of each cluster.

    Args:
        values: score of every window, `(N, ...)`.
        clusters: cluster of every window, from 0 to C - 1, `(N,)`.
    """
    places = clusters.numpy()
    means: list[Any] = (_sums(values.double().numpy(), places).T / np.bincount(places)).T.tolist()
    return means


def means_of_those_that_count(values: Tensor, clusters: Tensor) -> Sequence[Any]:
    """Return `pseudo_values` of a score that is NaN for some windows, whose mean is that over the other windows."""
    places, valid = clusters.numpy(), ~values.isnan().numpy()
    sums = _sums(values.nan_to_num().double().numpy(), places)
    means: list[Any] = pseudo_values(sums, _sums(valid, places), np.bincount(places)).tolist()
    return means


def pseudo_values(sums: np.ndarray, counts: np.ndarray, windows: np.ndarray) -> np.ndarray:
    """Return values (C, ...) of clusters whose mean, weighted by their windows, is the mean of those that count.

    The value of a cluster is R + N / M (s_c - R m_c) / n_c. Here m_c of its n_c windows have a score, with the sum s_c.
    M and N are the sums of m_c and n_c over the clusters with such windows, and R is the mean over these M windows.
    This is a linearised ratio of sums, which gives the errors of a ratio (Cochran 1977). Other clusters are NaN.

    Args:
        sums: sums s_c of scores (C, ...).
        counts: numbers m_c of windows with a score (C, ...).
        windows: numbers n_c of windows (C,).
    """
    windows = windows.reshape(-1, *[1] * (sums.ndim - 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio, share = sums.sum(0) / counts.sum(0), (windows * (counts > 0)).sum(0) / counts.sum(0)
        values: np.ndarray = np.where(counts > 0, ratio + share * (sums - ratio * counts) / windows, np.nan)
    return values


def _sums(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return sums (C, ...) of values (N, ...) over the windows of each cluster."""
    columns = values.reshape(len(values), -1).T
    return np.stack([np.bincount(places, weights=each) for each in columns], -1).reshape(-1, *values.shape[1:])


@dataclass(frozen=True)
class Measure:
    """Score of free-running forecasts.

    Args:
        name: name of the score.
        function: function of forecasts `(B, K, H, D)`, true futures `(B, H, D)`, past, and indices `(B,)` of these
            windows among all; it returns the score `(B,)`, on the CPU. Futures are NaN where they were not observed.
            The past has x `(B, O, D)`, its mask if there is one, and context.
        unit, better, partial: see `Metric`.
        pool: function of the scores of all windows, `(N, ...)`, and their clusters; it returns a value for each
            cluster. The mean of these values, weighted by numbers of windows, is the score. The values are
            pseudo-values for a score of the whole set, and lists of shares for a histogram; a partial score is NaN for
            clusters that do not count.
        headline: whether the table of a comparison contains it.
        truth: name of a reference row that forecasts the true futures, if the score needs it as a comparison.
        note: line printed below the table.
        basis: inputs of the score by name, as JSON types, such as a seed or the weights of a metric model; the result
            contains them.
        bins: number of bins of a histogram, 0 for a score. A histogram is in `Row.histograms` and in no table, and
            `function` returns shares `(B, bins)`.
        least: smallest number of forecasts of a window for this score; rows with fewer, such as point forecasts, omit
            it.
        of_draws: whether the score assesses the distribution of the data; a note warns if forecasts are means.
        of_means: whether the score is published for means of the emission. Forecasts are then means by default;
            otherwise they are draws.
    """

    name: str
    function: Callable[[Tensor, Tensor, Batch, Tensor], Tensor]
    unit: str = ""
    better: str = "lower"
    partial: bool = False
    pool: Callable[[Tensor, Tensor], Sequence[Any]] = cluster_means
    headline: bool = False
    truth: str = ""
    note: str = ""
    basis: Mapping[str, Any] = field(default_factory=dict)
    bins: int = 0
    least: int = 1
    of_draws: bool = False
    of_means: bool = False

    @property
    def metric(self) -> Metric:
        """Description of how to read the score."""
        return Metric(self.unit, "free-running", self.better, self.partial)


def paired(score: Callable[[Tensor, Tensor], Tensor]) -> Callable[[Tensor, Tensor, Batch, Tensor], Tensor]:
    """Return a measure's function from a score of samples `(..., K, T, D)` and truth `(..., T, D)`, as in `metrics`."""
    return lambda forecasts, truth, past, index: score(forecasts, truth)


ENERGY = Measure("energy score", paired(metrics.energy_score), headline=True, of_draws=True)
VARIOGRAM = Measure("variogram score", paired(metrics.variogram_score), of_draws=True)
CRPS = Measure("CRPS", paired(metrics.continuous_ranked_probability_score), headline=True, of_draws=True)


def proper(windows: HeldOutWindows) -> list[Measure]:
    """Return proper scoring rules for the whole future, for dependence between coordinates, and for single numbers.

    If the windows name columns that share a unit, scores are in this unit. If the windows define the scales of columns,
    scores are of scaled numbers without a unit. A single column has no dependence to score.
    """
    columns = columns_of(windows)
    is_single = (len(columns) or windows.all()["x"].shape[-1]) == 1
    return [
        _of_all(measure, windows) for measure in (ENERGY, VARIOGRAM, CRPS) if not (is_single and measure is VARIOGRAM)
    ]


def _of_all(measure: Measure, windows: HeldOutWindows) -> Measure:
    """Return the score of all columns together, in the unit of the data."""
    units = dict.fromkeys(columns_of(windows).values())
    if scales := scales_of(windows):
        note = "scales: scores over all columns divide each column by its scale in the training data, the standard "
        note += "deviation, or the mean of counts and positive columns"
        means = windows.description.get("means", [0.0] * len(scales))
        return replace(measure, function=_in_scales(measure.function, means, scales), unit="scales", note=note)
    mixed_note = (
        f"scores without a unit mix numbers in {', '.join(unit or '1' for unit in units)}; by_column separates them"
    )
    shared: dict[str, Any] = {"note": mixed_note} if len(units) > 1 else {"unit": next(iter(units), "")}
    return replace(measure, **shared)


def _in_scales(
    function: Callable[..., Tensor], means: Sequence[float], scales: Sequence[float]
) -> Callable[..., Tensor]:
    def scaled(forecasts: Tensor, truth: Tensor, past: Batch, index: Tensor) -> Tensor:
        offset, scale = torch.tensor([means, scales], dtype=torch.float64).to(truth)
        forecasts, truth, x = ((values - offset) / scale for values in (forecasts, truth, past["x"]))
        return function(forecasts, truth, {**past, "x": x}, index)

    return scaled


LEVELS = (0.5, 0.8, 0.9, 0.95)
"""Levels of the intervals whose coverage is scored."""
_CALIBRATED: dict[str, Any] = {
    "better": "",
    "of_draws": True,
    "note": "for calibrated forecasts, coverage equals the level, and the PIT has mean ½ and variance 1 (in twelfths); "
    "a larger variance means too narrow or biased forecasts, a smaller one too wide ones",
}


def coverage_at(level: float) -> Measure:
    """Return the coverage of the central interval of a level (`metrics.coverage`)."""
    function = paired(partial(metrics.coverage, level=level))
    return Measure(f"coverage {100 * level:g} %", function, "share", **_CALIBRATED, least=samples_needed(level))


def width_at(level: float) -> Measure:
    """Return the width of the central interval of a level (`metrics.interval_width`), at observed numbers."""

    def function(forecasts: Tensor, truth: Tensor, past: Batch, index: Tensor) -> Tensor:
        return metrics.interval_width(forecasts.masked_fill(truth[:, None].isnan(), torch.nan), level)

    return Measure(f"width {100 * level:g} %", function, better="", least=samples_needed(level), of_draws=True)


def samples_needed(level: float) -> int:
    """Return the smallest number of samples whose central interval of this level has samples outside."""
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval must be between 0 and 1, got {level}")
    return math.ceil(round(2 / (1 - level) - 1, 9))


BINS = 20
PIT = Measure(
    "PIT", paired(partial(metrics.pit_histogram, bins=BINS)), "share", **_CALIBRATED, bins=BINS, least=BINS - 1
)
PIT_MEAN = Measure("PIT mean", paired(metrics.pit_mean), "share", **_CALIBRATED, least=BINS - 1)
PIT_VARIANCE = Measure("PIT variance", paired(metrics.pit_variance), "1/12", **_CALIBRATED, least=BINS - 1)


def calibrated(windows: HeldOutWindows) -> list[Measure]:
    """Return proper scores, and scores of calibration and sharpness, for data of any kind.

    They are coverage at 50, 80, 90 and 95 %, width of the 90 % intervals, mean and variance of the PIT, and the
    histograms of PIT and TARP, for `Evaluation.plot_calibration`. Coverage at 95 % needs 39 forecasts of a window.
    """
    width = _of_all(width_at(0.9), windows)
    return [*proper(windows), *map(coverage_at, LEVELS), width, PIT_MEAN, PIT_VARIANCE, PIT, tarp(windows)]


def tarp(windows: HeldOutWindows, seed: int = 0) -> Measure:
    """Return TARP of whole futures (`metrics.tarp_histogram`), one number per window, as a histogram.

    The reference point of a window repeats its last observed step (or last observed values), with a normal step added
    at every step and number, drawn from `seed`. It depends on the past and on no forecast, so the score also detects
    forecasts that ignore the past. Steps and distances are in standard deviations of each column's observed steps.
    """
    batch, observed = Batch(windows.all()), windows.protocol.observed
    past = batch.mask_to_nan()[:, :observed].double()
    scale = torch.from_numpy(np.nanstd(past.numpy(), (0, 1)))
    scale = torch.where(scale > 0, scale, 1.0)
    last = interpolate_missing(past, ~past.isnan())[:, -1:]
    steps = torch.randn(
        len(last), batch["x"].shape[1] - observed, len(scale), generator=torch.Generator().manual_seed(seed)
    )
    points = last / scale + steps

    def function(forecasts: Tensor, truth: Tensor, past: Batch, index: Tensor) -> Tensor:
        return metrics.tarp_histogram(forecasts / scale, truth / scale, points[index], BINS)

    basis = {"TARP": {"numbers": 1, "seed": seed}}  # numbers per window
    return Measure("TARP", function, "share", **_CALIBRATED, bins=BINS, least=BINS - 1, basis=basis)


def by_column(measure: Measure, columns: Mapping[str, str]) -> list[Measure]:
    """Return a score for each column separately, named like "CRPS, speed".

    Args:
        measure: score for any number of columns, such as `CRPS` or `width_at(0.9)`. If its unit is "", the column's
            unit replaces it; another unit, such as a share, stays.
        columns: {name: unit} of all columns, in the order of the data, "" for no unit; windows with named columns have
            them as `description["columns"]`.

    Raises:
        ValueError: when the number of columns differs from the forecasts.

    Example:
        >>> [each.name for each in by_column(CRPS, {"speed": "m/s", "load": "kN"})]
        ['CRPS, speed', 'CRPS, load']
    """

    def column_measure(place: int) -> Measure:
        column = slice(place, place + 1)

        def function(forecasts: Tensor, truth: Tensor, past: Batch, index: Tensor) -> Tensor:
            if truth.shape[-1] != len(columns):
                raise ValueError(
                    f"expected a name for each of {truth.shape[-1]} columns, got {len(columns)} ({', '.join(columns)})"
                )
            past = Batch(past)
            mask = past.mask()
            column_past = {"x": past["x"][..., column]} | ({} if mask is None else {"mask": mask[..., column]})
            return measure.function(forecasts[..., column], truth[..., column], past | column_past, index)

        return _part(measure, function, lambda truth: truth[..., column])

    return [
        replace(column_measure(place), name=f"{measure.name}, {name}", unit=measure.unit or unit)
        for place, (name, unit) in enumerate(columns.items())
    ]


def by_step(measure: Measure, steps: Sequence[int], step: str = "step") -> list[Measure]:
    """Return a score for single steps of the future, named like "PIT, step 30", for `Evaluation.plot_horizon`.

    Args:
        measure: score for any number of steps.
        steps: steps to score; the first of the future is 1.
        step: word for a step.

    Raises:
        ValueError: when a step is beyond the future.

    Example:
        >>> [each.name for each in by_step(CRPS, (1, 30))]
        ['CRPS, step 1', 'CRPS, step 30']
    """

    def step_measure(place: int) -> Measure:
        def function(forecasts: Tensor, truth: Tensor, past: Batch, index: Tensor) -> Tensor:
            if not 1 <= place <= truth.shape[-2]:
                raise ValueError(
                    f"{step}s must be between 1 and {truth.shape[-2]}, the length of the future; got {place}"
                )
            return measure.function(forecasts[..., place - 1 : place, :], truth[..., place - 1 : place, :], past, index)

        return _part(measure, function, lambda truth: truth[..., place - 1 : place, :])

    return [replace(step_measure(place), name=f"{measure.name}, {step} {place}") for place in steps]


def _part(
    measure: Measure, function: Callable[[Tensor, Tensor, Batch, Tensor], Tensor], part: Callable[[Tensor], Tensor]
) -> Measure:
    """Return a score of a part of the future; it is NaN for windows that have no observed value in this part."""

    def part_score(forecasts: Tensor, truth: Tensor, past: Batch, index: Tensor) -> Tensor:
        scores = function(forecasts, truth, past, index)
        unobserved = part(truth).isnan().all(-1).all(-1)
        return scores.masked_fill(unobserved.reshape(-1, *[1] * (scores.ndim - 1)), torch.nan)

    pool = means_of_those_that_count if measure.pool is cluster_means else measure.pool
    return replace(measure, function=part_score, pool=pool, partial=True)


def over_horizon(windows: HeldOutWindows, steps: Sequence[int] | None = None) -> list[Measure]:
    """Return scores of calibration of the whole future and of single steps, as in `calibrated`.

    Args:
        windows: evaluated windows.
        steps: steps of the future, from 1; by default six, evenly spread from the first to the last.
    """
    horizon = windows.all()["x"].shape[1] - windows.protocol.observed
    steps = steps or sorted({round(place) for place in np.linspace(1, horizon, 6)})
    _, step = axis_names(windows.description)
    measures = [*map(coverage_at, (0.5, 0.8, 0.9)), PIT]
    return [*calibrated(windows), *(each for measure in measures for each in by_step(measure, steps, step))]


Scores = Callable[[HeldOutWindows], Sequence[Measure]]
"""Function from the evaluated windows to the measures, which may depend on the windows and their order."""
