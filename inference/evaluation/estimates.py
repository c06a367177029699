"""Estimates of models on the same sequences, with errors over sequences and over training seeds.

An estimate separates two sources of uncertainty: other held-out sequences, and another training seed. Sequences and
seeds are crossed. Let y_sc, the mean of seed s over cluster c, be mean + seed_s + cluster_c + rest_sc (a two-way
random-effects model). Then the mean over S seeds and C clusters has

    V_sequences   of the mean over seeds, by clusters (linearised, as in `evaluate`):  (var cluster + var rest / S) / C
    V_seeds       of the seeds' means, over S:                                      (var seed + var rest / C) / S
    V_rest        from the interaction's residuals:                                 var rest / (S C)
    V_total = V_sequences + V_seeds - V_rest, at least the larger of the first two; the sum would count the rest twice

(Cameron, Gelbach and Miller, 2011, call this two-way clustering.) A difference of two models is paired over sequences,
and its seeds are independent: V_seeds and V_rest are sums over both models. With one seed, V_seeds and V_total are
unknown, and the estimate is about these weights only.

Intervals and p-values use Student's t, since V_seeds is uncertain with few seeds. V_sequences has C - 1 degrees of
freedom, and V_seeds of one model has S - 1. Sums of independent variances V_i with f_i have (sum V_i)^2 / sum (V_i^2 /
f_i), as in the tests of Satterthwaite (1946) and Welch (1947). V_seeds of a difference therefore has between S - 1 and
2 (S - 1), and

    f_total = V_total^2 / (V_sequences^2 / (C - 1) + sum over rows V_seeds^2 / (S - 1))

Windows of one cluster overlap, so errors over windows are clustered.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy

_ERRORS = ("sequences", "seeds", "total")


def linearised(cluster_means: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted mean (...,) of cluster means, and each cluster's contribution (..., C) to its error.

    The mean is a ratio of sums over clusters, and its error is linearised.

    Args:
        cluster_means: means (..., C) of C clusters.
        weights: weight (C,) of each cluster, such as its number of windows.
    """
    shares = weights / weights.sum()
    mean = (shares * cluster_means).sum(-1)
    return mean, shares * (cluster_means - mean[..., None])


def clustered_variance(deviations: np.ndarray) -> float:
    """Return the variance of a mean over windows from each cluster's share of its error (C,); NaN for one cluster."""
    clusters = len(deviations)
    return clusters / (clusters - 1) * float((deviations**2).sum()) if clusters > 1 else math.nan


def effective_number(shares: np.ndarray, deviations: np.ndarray, most: float) -> int:
    """Return how many independent draws would give a histogram as uncertain as these draws, which depend within
    clusters.

    The number is one over the root mean square of v / (p (1 - p)) over shares p, with v the clustered variance of the
    observed share. For N independent draws this ratio is 1 / N. With the mean instead of the root mean square, this is
    the correction of Rao and Scott (1981) for design effects. The root mean square is larger if the effects differ, as
    in their second-order correction (1984). With few clusters the variances are uncertain, so the number is reduced by
    the squared ratio of Student's interval to the normal one.

    Args:
        shares: expected shares `(G,)`, between 0 and 1.
        deviations: contribution of each of C > 1 clusters to the error of the observed share, `(G, C)` (`linearised`).
        most: total number of draws.
    """
    clusters = deviations.shape[-1]
    if most <= clusters:  # one draw per cluster, and clusters are independent
        return int(most)
    effects = clusters / (clusters - 1) * (deviations**2).sum(-1) / (shares * (1 - shares))
    wider = (scipy.special.stdtrit(clusters - 1, 0.975) / scipy.special.ndtri(0.975)) ** 2
    size = wider * math.sqrt((effects**2).mean())
    return int(max(1.0, min(most, 1 / size if size else math.inf)))


def decimals(mean: float, *errors: float) -> int:
    """Return the number of decimals for printing a mean and its errors.

    It is three, and four if an error is below 0.001. From a mean of 1000 or an error of 10 on, it is one less for each
    further digit before the point.
    """
    finite = [error for error in errors if 0 < error < math.inf]
    largest = max([abs(mean) / 100, *finite, 1.0] if math.isfinite(mean) else [1.0])
    return max((4 if finite and min(finite) < 0.001 else 3) - math.floor(math.log10(largest)), 0)


def student_interval(mean: float, error: float, freedom: float, level: float = 0.95) -> tuple[float, float]:
    """Return the two-sided Student's t interval of a mean, for a standard error with `freedom` degrees of freedom.

    Raises:
        ValueError: when the level is not between 0 and 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval must be between 0 and 1, got {level}")
    reach = error * float(scipy.special.stdtrit(freedom, (1 + level) / 2)) if error else 0.0
    return mean - reach, mean + reach


@dataclass(frozen=True)
class Estimate:
    """Mean over sequences and seeds with standard errors; an error is NaN if unknown (one cluster, one seed).

    Args:
        mean: weighted mean.
        sequences: standard error over sequences, clustered.
        seeds: standard error over training seeds.
        total: standard error from both.
        freedom: degrees of freedom of `sequences`, `seeds` and `total`, in this order.
    """

    mean: float
    sequences: float
    seeds: float
    total: float
    freedom: tuple[float, float, float] = (math.nan, math.nan, math.nan)

    def interval(self, level: float = 0.95, error: str = "total") -> tuple[float, float]:
        """Return the confidence interval of the mean by Student's t, from one of the errors; NaN if it is unknown.

        Args:
            level: probability of the interval.
            error: name of the error: "sequences", "seeds" or "total".

        Raises:
            ValueError: when the level is not between 0 and 1, or `error` is not one of the three.
        """
        return student_interval(self.mean, *self._error(error), level)

    def p_value(self, error: str = "total") -> float:
        """Return the two-sided p-value of a zero mean by Student's t, from one of the errors; NaN if it is unknown.

        Args:
            error: name of the error: "sequences", "seeds" or "total".

        Raises:
            ValueError: when `error` is not one of the three.
        """
        scale, freedom = self._error(error)
        if scale == 0:
            return float(self.mean == 0)
        return float(2 * scipy.special.stdtr(freedom, -abs(self.mean) / scale))

    def _error(self, name: str) -> tuple[float, float]:
        if name not in _ERRORS:
            raise ValueError(f"error must be one of {', '.join(_ERRORS)}, got {name!r}")
        place = _ERRORS.index(name)
        return (self.sequences, self.seeds, self.total)[place], self.freedom[place]

    def __str__(self) -> str:
        places = decimals(self.mean, self.sequences, self.seeds)
        return " ± ".join(number(value, places) for value in (self.mean, self.sequences, self.seeds))


def number(value: float, places: int = 3) -> str:
    """Return a number as text, with a dash for NaN."""
    return "–" if math.isnan(value) else f"{round(value, places) + 0.0:.{places}f}"  # no minus sign before zero


def _freedom(total: float, *parts: tuple[float, float]) -> float:
    """Return Satterthwaite's degrees of freedom of a sum of (variance, freedom) pairs; NaN if one is unknown."""
    uncertainty = sum(part**2 / freedom if freedom else math.nan for part, freedom in parts)
    least = min(freedom for _, freedom in parts)  # the total is at most the sum of the parts
    return max(total**2 / uncertainty, least) if uncertainty else math.nan


@dataclass(frozen=True)
class TwoWayErrors:
    """Mean of a model, error contributions of clusters (C,), variances V_seeds and V_rest, and number of seeds S."""

    mean: float
    deviations: np.ndarray
    seeds: float
    rest: float
    count: int

    @classmethod
    def of(cls, means: np.ndarray, weights: np.ndarray) -> TwoWayErrors:
        """Return the statistics of means by seed and cluster (S, C) with the clusters' weights (C,)."""
        by_seed, deviations = linearised(means, weights)
        common = deviations.mean(0)
        count = len(means)
        if count < 2:
            return cls(float(by_seed.mean()), common, math.nan, math.nan, count)
        # As in `clustered_variance`, for the seeds' deviations from their common part.
        rest = sum(clustered_variance(seed_deviations) for seed_deviations in deviations - common) / (
            count * (count - 1)
        )
        return cls(float(by_seed.mean()), common, float(by_seed.var(ddof=1)) / count, rest, count)

    @classmethod
    def by_cluster(cls, values: np.ndarray, weights: np.ndarray, places: np.ndarray) -> TwoWayErrors:
        """Return the statistics of values (S, N) by seed and sequence, with weights (N,) and clusters (N,) of
        sequences.

        A value is a sum over its sequence, so the mean is the sum of values divided by the sum of weights.
        """
        totals = np.bincount(places, weights=weights)
        return cls.of(np.stack([np.bincount(places, weights=seed) for seed in values]) / totals, totals)

    def estimate(self, other: TwoWayErrors | None = None) -> Estimate:
        """Return the weighted mean over seeds and clusters, or its paired difference to another model's mean.

        The error over sequences is clustered. The error over seeds uses the variance of the seeds' means. The
        total is V_sequences + V_seeds - V_rest, but at least the larger of the first two variances. With one seed, the
        error over seeds and the total are NaN; with one cluster, the error over sequences and the total are NaN.

        Args:
            other: statistics of the model to subtract, on the same sequences; None for the mean itself.
        """
        mean, deviations, between, rest = self.mean, self.deviations, self.seeds, self.rest
        of_seeds = [(self.seeds, self.count - 1)]
        if other is not None:
            mean, deviations = mean - other.mean, deviations - other.deviations
            between, rest = between + other.seeds, rest + other.rest
            of_seeds.append((other.seeds, other.count - 1))
        over = clustered_variance(deviations)
        total = max(over + between - rest, over, between) if not math.isnan(over + between) else math.nan
        of_sequences = (over, len(deviations) - 1)
        freedom = (
            _freedom(over, of_sequences),
            _freedom(between, *of_seeds),
            _freedom(total, of_sequences, *of_seeds),
        )
        return Estimate(mean, math.sqrt(over), math.sqrt(between), math.sqrt(total), freedom)
