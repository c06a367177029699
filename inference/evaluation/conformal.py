"""Prediction bands with guaranteed coverage of the future for any model: split conformal prediction.

The distance of a window's future y from the mean m of its K forecasts, in their standard deviations v, is known for
calibration windows. A band m ± q v, with q a quantile of these distances, contains the future of a new window with the
given level, if both are exchangeable (Vovk, Gammerman and Shafer 2005; Lei et al. 2018, arXiv 1604.04173). A band
simultaneously contains

    a single number         s = |y_td - m_td| / v_td         a factor for each step t and coordinate d
    a step                  s = max over d                   a factor for each step
    the whole future        s = max over t and d             one factor

Windows of a cluster depend on each other; clusters are exchangeable. The quantile is from hierarchical conformal
prediction (Lee, Barber and Willett 2023, arXiv 2306.06342; groups as in Dunn, Wasserman and Ramdas 2018, arXiv
1809.07441). Each of C clusters has the weight 1 / (C + 1), which its windows share, and the same weight is at infinity.
The band contains the future of a window drawn from a new cluster with probability `level` at least. For clusters of one
window each, q is the ⌈(C + 1) level⌉-th smallest distance, and without ties the probability is level + 1 / (C + 1) at
most.

Later steps of a sequence are not exchangeable with earlier ones. For windows of a split by time, q therefore adapts,
as in adaptive conformal inference (Gibbs and Candès 2021, arXiv 2106.00170). It is corrected by quantile tracking
(Angelopoulos, Candès and Tibshirani 2023, arXiv 2307.16895) of log s, whose bands stay finite:

    q_t = Q_t exp(θ_t)                          Q_t: the quantile of the earlier errors, with origins as clusters
    θ_t = η sum over s (m_s - (1 - level))      m_s: share of the windows of origin s outside their bands

Both use the origins s whose futures are complete at origin t. At most d origins are incomplete at a time, t included,
and η = γ / √d: a larger step would make θ oscillate. For any data with s_t <= b Q_t and b >= 1, θ stays below
log b + d η. The mean of m over T origins is therefore at most 1 - level + (log b + d η) / (η T). If s_t > a Q_t and
a <= 1, it is at least 1 - level - (d η - log a) / (η T).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from torch import Tensor, nn
from typing_extensions import override

from ...data.sequences import HeldOutWindows, axis_names, cluster_keys, columns_of, mean_of_known, scales_of
from ...options import Amount, Positive, nearest, require
from .evaluate import evaluate, forecaster_of, forecasts_of
from .evaluation import Evaluation
from .evaluation_windows import EvaluationWindows, cluster_index, prepare_windows, seeded_evaluation
from .record import Dims
from .references import References
from .result import Result, Table, new_figure, progress_bar, styled
from .scores import Measure, cluster_means

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REGIONS: Mapping[str, tuple[int, ...]] = {"number": (), "step": (-1,), "future": (-2, -1)}
"""Regions that a band contains simultaneously, with the dimensions of (..., H, D) that are maximised over."""


@dataclass(frozen=True, eq=False, repr=False)
class PredictionBands(Result):
    """Prediction bands: factors on the spread of forecasts that give the bands their nominal coverage.

    Attributes:
        level: share of windows whose future the bands contain.
        factors: half the width of the band, divided by the spread, by region: "number" (H, D), "step" (H, 1) or
            "future" (1, 1).
        spread: spread (H, D), in the unit of the data; None for the standard deviation of a window's forecasts.
        samples: K, number of forecasts of a window.
        seed: seed of their draws.
        options: further arguments of the model's `forecast`.
        clusters: C, number of exchangeable clusters among the calibration windows.
        data: description of these windows; "until" has the time of the last step of each sequence if the
            bands adapt.
        rate: γ of bands that adapt over time; 0 for fixed ones.

    Example:
        >>> model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2})
        >>> kept, new = (dvae.ArrayWindows(torch.randn(40, 8, 2), observed=4) for _ in range(2))
        >>> bands = dvae.conformal_bands(model, kept, level=0.9, samples=20, progress=False)
        >>> lower, upper = bands.apply(model.forecast(new.all()["x"][:, :4], 4, 20, draw_emission=True)["x"])
        >>> lower.shape, bands.coverage(model, new)["model"]["calibrated 90 %, future"].mean > 0.7
        (torch.Size([40, 4, 2]), True)
    """

    level: float
    factors: Annotated[Mapping[str, np.ndarray], Dims("step", "column", name="factor of a {}")]
    spread: Annotated[np.ndarray, Dims("step", "column")] | None
    samples: int
    seed: int
    options: Mapping[str, Any]
    clusters: int
    data: Mapping[str, Any]
    rate: float = 0.0

    def apply(self, forecasts: Tensor, region: str = "future") -> tuple[Tensor, Tensor]:
        """Return the bands of forecasts that were made as in the calibration.

        Args:
            forecasts: forecasts `(K, B, H, D)` of a model or reference.
            region: region that a band contains with probability `level`: "number" for each number separately, "step"
                for all numbers of a step, or "future" for the whole future.

        Returns:
            Lower and upper end, `(B, H, D)` each.

        Raises:
            ValueError: when the region is unknown, or forecasts have another shape.
        """
        if region not in REGIONS:
            raise ValueError(
                f"no prediction bands for the region {region!r}{nearest(region, REGIONS)}; "
                f"the regions are {', '.join(REGIONS)}"
            )
        shape = self.factors["number"].shape
        if forecasts.ndim != 4 or forecasts.shape[2:] != shape or len(forecasts) != self.samples:
            expected = f"(K, B, H, D) = ({self.samples}, B, {shape[0]}, {shape[1]})"
            raise ValueError(f"these prediction bands need forecasts {expected}, got {tuple(forecasts.shape)}")
        reach = self._factor(region, forecasts) * self._spread(forecasts.movedim(1, 0))
        return forecasts.mean(0) - reach, forecasts.mean(0) + reach

    def scores(self, windows: HeldOutWindows) -> list[Measure]:
        """Return scores for `evaluate`: coverage of the future and width of bands, before and after recalibration.

        Before recalibration, the band is m ± q v, with q the quantile of the distances of each forecast from the
        others. Clips have equal weight in the scores, as in the calibration. Bands that adapt continue over the origins
        of the windows, in the order of time, and windows have equal weight.

        Args:
            windows: windows to evaluate.

        Raises:
            ValueError: if bands adapt, and the windows have no times, or a calibration future of the same sequence
                ends after the origin of a window.
        """
        if until := self.data.get("until"):
            now = _origins_of(windows)[:, 0].tolist()
            early = sum(time < until.get(key[1], time) for key, time in zip(windows.keys, now, strict=True))
            if early:
                raise ValueError(
                    f"the futures of {early} of {len(now)} windows begin before the last calibration step of their "
                    "sequence, so these prediction bands have seen their values; leave these windows out, or calibrate "
                    "on earlier ones"
                )
        scales, units = torch.tensor(scales_of(windows) or 1.0), {*columns_of(windows).values()}
        unit = "scales" if scales.ndim else units.pop() if len(units) == 1 else ""
        percent, least = f"{100 * self.level:g} %", {"raw": max(3, _min_count(self.level)), "calibrated": 1}

        @lru_cache(maxsize=1)  # shared by all scores of a batch
        def coverage_and_width(forecasts: Tensor, truth: Tensor) -> dict[tuple[str, str], tuple[Tensor, Tensor]]:
            gaps = truth.isnan()
            spread = self._spread(forecasts)
            distances, own_distances = standardised(forecasts, truth, spread), None
            if forecasts.shape[1] >= least["raw"]:
                own_distances = _own_distances(forecasts, None if self.spread is None else spread).masked_fill(
                    gaps[:, None], torch.nan
                )
            result = {}
            for region in REGIONS:
                far, factors = largest_by_region(distances, region), {"calibrated": self._factor(region, forecasts)}
                if own_distances is not None:
                    factors["raw"] = _smallest(largest_by_region(own_distances, region), self.level)
                for kind, factor in factors.items():
                    inside = (far <= factor).double().masked_fill(far.isnan(), torch.nan)
                    width = (2 * factor * spread / scales).masked_fill(gaps, torch.nan)
                    result[kind, region] = mean_of_known(inside, (-2, -1)), mean_of_known(width, (-2, -1))
            return result

        def distances_and_spread(region: str, forecasts: Tensor, truth: Tensor, *_: Any) -> Tensor:
            """Return the inputs of `adapted` (B, 2, H, D), because a band depends on the errors of other batches."""
            spread = self._spread(forecasts).expand(truth.shape)
            far = largest_by_region(standardised(forecasts, truth, spread), region)
            return torch.stack([far.expand(truth.shape), (spread / scales).masked_fill(truth.isnan(), torch.nan)], 1)

        def adapted(region: str, place: int, values: Tensor, clusters: Tensor) -> Sequence[Any]:
            far, spread = values.unbind(1)
            start = self._factor(region, far).expand(far[0].shape)
            factor, _ = adaptive_factors(far, _origins_of(windows), self.level, self.rate, start)
            inside = (far <= factor).double().masked_fill(far.isnan(), torch.nan)
            return cluster_means(mean_of_known((inside, 2 * factor * spread)[place], (-2, -1)), clusters)

        def measure(kind: str, region: str, place: int) -> Measure:
            name, in_unit = (("", "share"), ("width ", unit))[place]
            result = Measure(
                f"{name}{kind} {percent}, {region}",
                lambda forecasts, truth, past, index: coverage_and_width(forecasts, truth)[kind, region][place],
                in_unit,
                better="",
                pool=cluster_means if self.rate else equally_weighted_clusters,
                least=least[kind],
                of_draws=True,
                note="raw: quantiles of the forecasts; calibrated: conformal bands"
                + (", which adapt over the origins" if self.rate else ". Sequences have equal weight"),
            )
            if self.rate and kind == "calibrated":
                functions = partial(distances_and_spread, region), partial(adapted, region, place)
                return replace(result, function=functions[0], pool=functions[1])
            return result

        return [measure(kind, region, place) for place in (0, 1) for region in REGIONS for kind in least]

    def coverage(
        self,
        model: nn.Module | Mapping[str, nn.Module] | str,
        windows: HeldOutWindows,
        *,
        training_windows: HeldOutWindows | None = None,
        progress: bool = True,
    ) -> Evaluation:
        """Return how often bands contain the future of other windows, before and after recalibration.

        Errors are clustered.

        Args:
            model: model whose forecasts were calibrated, or the name of a reference.
            windows: windows to evaluate on.
            training_windows: training data of some references.
            progress: whether to show a progress bar.

        Returns:
            `scores` of these forecasts. Names with "raw" are before recalibration, names with "calibrated" after it.
        """
        models, references = ({}, [model]) if isinstance(model, str) else (model, [])
        return evaluate(
            models,
            windows,
            scores=self.scores,
            draw_emission=True,
            samples=self.samples,
            seed=self.seed,
            references=references,
            training_windows=training_windows,
            options=self.options,
            progress=progress,
        )

    def table(self) -> Table:
        """Return a table of factors: mean over steps and coordinates, smallest and largest."""
        cluster, step = axis_names(self.data)
        unit = "origin" if self.rate else cluster
        title = f"bands of {100 * self.level:g} % · {self.data['windows']} windows of {self.clusters} {unit}s"
        table = Table(
            title=title,
            caption=f"factor: half the width of a band divided by the spread of forecasts, K = {self.samples}",
        )
        for column in ("region", "factor", "smallest", "largest"):
            table.add_column(column, justify="left" if column == "region" else "right")
        region_labels = {"number": "each number", "step": f"each {step}", "future": "the whole future"}
        for region, factor in self.factors.items():
            table.add_row(
                region_labels[region], *(f"{value:.2f}" for value in (factor.mean(), factor.min(), factor.max()))
            )
        return table

    @styled
    def plot(self) -> Figure:
        """Draw factors over the horizon, for single numbers as mean and range over coordinates.

        Returns:
            A matplotlib figure.
        """
        figure = new_figure(4.5, 3)
        axes = figure.subplots()
        numbers = self.factors["number"]
        frames = np.arange(1, len(numbers) + 1)
        axes.fill_between(frames, numbers.min(1), numbers.max(1), color="0.88", linewidth=0)
        for place, (region, factor) in enumerate(self.factors.items()):
            axes.plot(frames, np.broadcast_to(factor, numbers.shape).mean(1), color=f"C{place}", label=region)
        axes.set_ylim(bottom=0)
        axes.set_xlabel(f"{axis_names(self.data)[1]} of the future")
        axes.set_ylabel("half width / spread")
        axes.legend()
        return figure

    @override
    def check(self) -> None:
        _check_level(self.level)
        require(Amount, rate=self.rate)
        shape = self.factors["number"].shape
        arrays = [self.factors[region] for region in REGIONS] + ([] if self.spread is None else [self.spread])
        if [each.shape for each in arrays] != [shape, (shape[0], 1), (1, 1), shape][: len(arrays)]:
            raise ValueError("expected factors (H, D), (H, 1) and (1, 1), and a spread (H, D)")
        if not all(np.isfinite(each).all() and (each >= 0).all() for each in arrays):
            raise ValueError("factors and spreads must be finite and at least 0")

    def _spread(self, forecasts: Tensor) -> Tensor:
        """Return the spread of forecasts (B, K, H, D): (B, H, D), or the common one (H, D)."""
        return _deviations(forecasts) if self.spread is None else torch.as_tensor(self.spread).to(forecasts)

    def _factor(self, region: str, like: Tensor) -> Tensor:
        return torch.as_tensor(self.factors[region]).to(like)


def conformal_bands(
    model: nn.Module | str | Sequence[nn.Module],
    windows: HeldOutWindows | Sequence[HeldOutWindows],
    level: float = 0.9,
    *,
    groups: Sequence[str] | None = None,
    residuals: HeldOutWindows | None = None,
    samples: int = 50,
    training_windows: HeldOutWindows | None = None,
    seed: int = 0,
    batch_size: int = 32,
    rate: float = 0.2,
    options: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> PredictionBands:
    """Calibrate prediction bands around forecasts on windows that the model was not fitted to.

    The bands contain the future of new windows with probability `level` if their clusters are exchangeable with the
    calibration clusters, for example if both are of the same people and styles. Calibration on clusters of one person
    or style gives no guarantee for another.

    Later steps of the same sequences are not exchangeable with earlier ones. For windows divided by time, bands
    therefore adapt from origin to origin (`rate`). The share of windows inside, averaged over many origins, then tends
    to `level`, whatever the data. The share at a single origin, or of a single sequence, has no guarantee.

    Args:
        model: a model (`Forecasting`), or the name of a reference row (`References`); or one model for each of several
            `windows`.
        windows: calibration windows; or several, such as those after successive cutoffs.
        level: share of windows to contain, between 0 and 1.
        groups: name of the exchangeable group of each window, if groups are larger than clusters, such as its style. A
            level of 0.9 needs at least 9 groups.
        residuals: windows, such as training windows, on which the errors of the mean forecast are computed. The root
            mean square of these errors, for each step and coordinate, replaces the standard deviation of the forecasts
            as spread. Use it for point forecasts, or if the standard deviation is a bad measure of the errors.
        samples: K, number of drawn forecasts of a window.
        training_windows: training data of "climatology" and "nearest neighbours".
        seed: seed of the draws.
        batch_size: number of windows in a batch.
        rate: step size of bands for windows divided by time. If no window of an origin lies in its band, the next bands
            are wider by almost this share. A larger rate follows changes faster, and its bands fluctuate more.
        options: further arguments of the model's `forecast`.
        progress: whether to show a progress bar.

    Returns:
        Factors on the spread of forecasts by region, and the spread (H, D) if `residuals` is given;
        `PredictionBands.scores` evaluates the coverage on other windows.

    Raises:
        ValueError: when the level is invalid or needs more clusters or origins, forecasts have no spread, or `groups`
            and windows differ in number. Also when windows cannot be forecast, or are divided by time but have no
            times, or `groups`.

    Example:
        >>> model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2})
        >>> windows = dvae.ArrayWindows(torch.randn(40, 8, 2), observed=4)
        >>> bands = dvae.conformal_bands(model, windows, level=0.9, samples=20, progress=False)
        >>> {region: factor.shape for region, factor in bands.factors.items()}
        {'number': (4, 2), 'step': (4, 1), 'future': (1, 1)}
    """
    require(Positive, rate=rate)
    sources = [prepare_windows(each) for each in (windows if isinstance(windows, list | tuple) else [windows])]
    models: list[Any] = list(model) if isinstance(model, list | tuple) else [model] * len(sources)
    if len(models) != len(sources) or not sources:
        raise ValueError(f"expected one model for each of {len(sources)} windows, got {len(models)}")
    cluster, _ = axis_names(sources[0].windows.description)
    by_time = {_is_split_by_time(source) for source in sources}
    if len(by_time) > 1 or (by_time == {True} and groups is not None):
        raise ValueError(
            f"windows divided by time calibrate bands over time, and other windows over {cluster}s or `groups`; give "
            "windows of one kind, and `groups` only if they are not divided by time"
        )
    origins = torch.cat([_origins_of(source.windows) for source in sources]) if by_time == {True} else None
    count = sum(len(source.keys) for source in sources)
    keys = [key for source in sources for key in cluster_keys(source.windows)]
    keys = keys if groups is None else [("", group, 0) for group in groups]
    if len(keys) != count:
        raise ValueError(f"groups must have one name for each of {count} windows, got {len(keys)}")
    places, required = cluster_index(keys), _min_count(_check_level(level))
    clusters = int(places.max()) + 1 if origins is None else len(origins[:, 0].unique())
    if clusters < required:
        unit, highest = f"{cluster}s" if groups is None else "groups", math.floor(100 * clusters / (clusters + 1))
        unit, more = (unit, "more") if origins is None else ("origins", "more, such as those of several cutoffs")
        raise ValueError(
            f"prediction bands of {100 * level:g} % need at least {required} {unit} of calibration windows, got "
            f"{clusters}; use {more}, or a level of at most {highest} %"
        )
    with progress_bar(progress) as bar:

        def futures(model: Any, source: EvaluationWindows, label: str) -> Iterator[tuple[Tensor, Tensor]]:
            """Yield forecasts (B, K, H, D) and true futures by batch."""
            if isinstance(model, str):
                name = model
                n_forecasts, forecaster = References(source, samples, seed, training_windows)[model]
            else:
                name, n_forecasts = type(model).__name__, samples
                forecaster = forecaster_of(model, source, samples, {"draw_emission": True, **(options or {})})
            with nullcontext() if isinstance(model, str) else seeded_evaluation(model, seed):
                for start in bar.track(range(0, len(source.keys), batch_size), description=label):
                    part = slice(start, start + batch_size)
                    yield forecasts_of(name, forecaster, n_forecasts, source, part), source.futures[part]

        spread = None
        if residuals is not None:
            errors = [
                truth - forecasts.mean(1)
                for forecasts, truth in futures(models[0], prepare_windows(residuals), "residuals")
            ]
            spread = mean_of_known(torch.cat(errors).square(), 0).sqrt()
        batches, count = [], 0
        for each, source in zip(models, sources, strict=True):
            for forecasts, truth in futures(each, source, "calibration"):
                count = forecasts.shape[1]
                batches.append(standardised(forecasts, truth, _deviations(forecasts) if spread is None else spread))
    by_region = {region: largest_by_region(torch.cat(batches), region) for region in REGIONS}
    factors = {
        region: quantile(far, places, level) if origins is None else adaptive_factors(far, origins, level, rate)[1]
        for region, far in by_region.items()
    }
    if not all(factor.isfinite().all() for factor in factors.values()):
        raise ValueError(
            "these prediction bands would be infinite. Either forecasts have no spread, such as point forecasts: pass "
            f"`residuals`, windows to estimate a spread. Or a value was observed in too few {cluster}s: use "
            "more windows"
        )
    fingerprint = "+".join(source.windows.fingerprint for source in sources)
    return PredictionBands(
        level=level,
        factors={region: factor.numpy() for region, factor in factors.items()},
        spread=None if spread is None else spread.numpy(),
        samples=count,
        seed=seed,
        options=dict(options or {}),
        clusters=clusters,
        data={
            **sources[-1].description(),
            **{"windows": len(keys), "fingerprint": fingerprint},
            **({} if origins is None else {"until": _last_steps(sources)}),
        },
        rate=0.0 if origins is None else rate,
    )


def _is_split_by_time(source: EvaluationWindows) -> bool:
    """Return whether windows are a part of sequences divided by time."""
    is_part = any(split not in ("all", "last") for split, _, _ in source.keys)
    return is_part and getattr(source.windows.protocol, "split", None) == "time"


def _origins_of(windows: HeldOutWindows) -> Tensor:
    """Return the times (N, 2) of the last observed and of the last step of each window."""
    origins: Tensor | None = getattr(windows, "origins", None)
    if origins is None:
        raise ValueError(
            f"bands that adapt over time need windows with times, such as those of dvae.tables.PanelData, got "
            f"{type(windows).__name__}, which have no `origins`"
        )
    return origins


def _last_steps(sources: Sequence[EvaluationWindows]) -> dict[str, float]:
    """Return the time of the last step of each sequence."""
    last: dict[str, float] = {}
    for source in sources:
        for (_, sequence, _), end in zip(source.keys, _origins_of(source.windows)[:, 1].tolist(), strict=True):
            last[sequence] = max(end, last.get(sequence, end))
    return last


def equally_weighted_clusters(values: Tensor, clusters: Tensor) -> list[float]:
    """Return values by cluster whose mean, weighted by numbers of windows, is the plain mean over clusters.

    The standard error also equals the standard error of the plain mean.

    Args:
        values: score of every window, `(N,)`.
        clusters: cluster of every window, from 0 to C - 1, `(N,)`.
    """
    means, windows = np.array(cluster_means(values, clusters)), np.bincount(clusters.numpy())
    result: list[float] = (means.mean() + (means - means.mean()) * windows.mean() / windows).tolist()
    return result


def _deviations(forecasts: Tensor) -> Tensor:
    """Return standard deviations (B, H, D) of forecasts (B, K, H, D); 0 for a single one."""
    return forecasts.std(1, correction=min(1, forecasts.shape[1] - 1))


def standardised(forecasts: Tensor, truth: Tensor, spread: Tensor) -> Tensor:
    """Return the distance of a future (B, H, D) from the mean of forecasts (B, K, H, D), in units of their spread.

    It is NaN where the future was not observed, and infinite where forecasts without a spread miss it.
    """
    return _ratio((truth - forecasts.mean(1)).abs(), spread)


def _own_distances(forecasts: Tensor, spread: Tensor | None) -> Tensor:
    """Return distances (B, K, H, D) of each forecast from the mean of the others, in units of their spread."""
    count, deviations = forecasts.shape[1], forecasts - forecasts.mean(1, keepdim=True)
    if spread is None:
        squares = deviations.square()
        squares_of_others = squares.sum(1, keepdim=True) - count / (count - 1) * squares  # sum of the others, centred
        spread = (squares_of_others.clamp(min=0) / (count - 2)).sqrt()
    return _ratio(count / (count - 1) * deviations.abs(), spread)


def _ratio(distance: Tensor, spread: Tensor) -> Tensor:
    return torch.where(distance == 0, 0.0, distance / spread)


def largest_by_region(distances: Tensor, region: str) -> Tensor:
    """Return the largest known distance in each region of distances (..., H, D); NaN if none is known."""
    if not REGIONS[region]:
        return distances
    largest = distances.nan_to_num(nan=-1.0, posinf=math.inf).amax(REGIONS[region], keepdim=True)
    return largest.masked_fill(largest < 0, torch.nan)


def _smallest(distances: Tensor, level: float) -> Tensor:
    """Return the ⌈(K + 1) level⌉-th smallest (B, ...) of K exchangeable distances (B, K, ...)."""
    return distances.kthvalue(math.ceil(round((distances.shape[1] + 1) * level, 9)), 1).values


def quantile(distances: Tensor, places: Tensor, level: float) -> Tensor:
    """Return the quantile (...) of known distances (N, ...) with the weights of hierarchical conformal prediction.

    It is infinite if too few clusters have a known distance.

    Args:
        distances: distances of windows, NaN if unknown.
        places: cluster of every window, (N,).
        level: level of the quantile.
    """
    is_known = (~distances.isnan()).flatten(1).double()
    windows = is_known.new_zeros(int(places.max()) + 1, is_known.shape[1]).index_add_(0, places, is_known)  # by cluster
    clusters = (windows > 0).sum(0)
    ordered, order = distances.flatten(1).nan_to_num(nan=math.inf, posinf=math.inf).sort(0)
    weights = (is_known / windows[places].clamp(min=1)).gather(0, order)
    reached = weights.cumsum(0) >= level * (clusters + 1) - 1e-9
    result = ordered.gather(0, reached.byte().argmax(0, keepdim=True))[0]
    return result.masked_fill(~reached.any(0), math.inf).reshape(distances.shape[1:])


def adaptive_factors(
    distances: Tensor, origins: Tensor, level: float, rate: float, start: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return the factor of each window's band (N, ...) under a split by time, and the factor (...) after all of them.

    The module docstring has the equations. The factor of a window depends only on windows whose future is complete at
    its origin. It is infinite while they have too few origins for a quantile.

    Args:
        distances: largest distances in a region (N, ...), NaN if unknown.
        origins: times (N, 2) of the last observed and of the last step of each window.
        level: share of windows to contain.
        rate: γ, step size of the correction without overlapping futures.
        start: factor (...) before the first window, if it was calibrated on earlier windows; it replaces Q_t.
    """
    presents, places = origins[:, 0].unique(return_inverse=True)
    ends = torch.full_like(presents, -math.inf).scatter_reduce(0, places, origins[:, 1], "amax")
    windows = places.argsort().split(places.bincount().tolist())
    started = torch.arange(1, len(presents) + 1)
    overlap = (started - torch.searchsorted(ends.sort().values, presents, right=True)).max().item()
    shift = distances.new_zeros(distances.shape[1:])
    base = torch.full_like(shift, math.inf) if start is None else start.to(distances)
    in_force: list[Tensor] = []
    is_complete, used = torch.zeros(len(presents), dtype=torch.bool), 0
    for now in [*presents.tolist(), math.inf]:
        newly = (ends <= now) & ~is_complete & (started <= len(in_force))
        for origin in newly.nonzero().flatten().tolist():
            far = distances[windows[origin]]
            outside = mean_of_known((far > in_force[origin]).to(far).masked_fill(far.isnan(), torch.nan), 0)
            change = rate / math.sqrt(overlap) * (outside - (1 - level))
            shift = shift + change.nan_to_num(0.0) * in_force[origin].isfinite()
        is_complete |= newly
        count = int(is_complete.sum())
        if start is None and count >= _min_count(level) and (count >= 1.1 * used or now == math.inf):
            earlier, used = is_complete[places], count  # sorting all errors at each origin would be slow
            base = quantile(distances[earlier], places[earlier].unique(return_inverse=True)[1], level)
        in_force.append(base * shift.exp())
    return torch.stack(in_force[:-1])[places], in_force[-1]


def _min_count(level: float) -> int:
    """Return the smallest number of exchangeable values with a quantile that bounds a new value at this level."""
    return math.ceil(round(level / (1 - level), 9))


def _check_level(level: float) -> float:
    if not 0 < level < 1:
        raise ValueError(f"the level of a prediction band must be between 0 and 1, got {level}")
    return level
