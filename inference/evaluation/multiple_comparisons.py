"""Comparison of many models: all paired differences, the model confidence set, and sample sizes.

With many pairs, some 95 % intervals exclude 0 by chance alone. `pairs` has p-values adjusted by Holm's step-down
procedure (1979), which are valid for all pairs at once under any dependence. `confidence_set` is the model confidence
set (Hansen, Lunde and Nason, 2011): models that are not significantly worse than one another. It repeatedly drops the
model that is most clearly worse, and contains the best model with a probability of at least its level. The less
informative the data, the more models it contains. `required` computes the power of a paired difference for other
numbers of seeds and clusters.

Errors are computed as in `estimates`: over clusters, which models share, and over training seeds, which they do not.
Variances over few seeds are uncertain. A variance that is small by chance makes a difference look significant when it
is not. The null distribution of the confidence set therefore draws variances first: each is the measured one times f
divided by a chi-squared draw with its f degrees of freedom. For a single difference this is Student's t (the fiducial
distribution of Behrens and Fisher). The paper's block bootstrap is not possible with two or three seeds. Each pair has
its own null distribution, and the smallest of these p-values is compared with its null distribution (Westfall and
Young, 1993); the paper uses the largest t of all pairs.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np
import scipy

from .estimates import Estimate, TwoWayErrors, number
from .result import Displayed, Table


def holm(p_values: Sequence[float]) -> np.ndarray:
    """Return p-values adjusted for all hypotheses by Holm's step-down procedure; NaN stays NaN and is not counted.

    Args:
        p_values: unadjusted p-values (N,).

    Returns:
        Adjusted p-values (N,) in the same order, each at least the unadjusted one.

    >>> holm([0.01, 0.04, 0.03]).round(2).tolist()
    [0.03, 0.06, 0.06]
    """
    adjusted = np.array(p_values, dtype=float)
    indices = np.flatnonzero(~np.isnan(adjusted))
    ascending = indices[np.argsort(adjusted[indices], kind="stable")]
    factors = np.arange(len(ascending), 0, -1)
    adjusted[ascending] = np.minimum(np.maximum.accumulate(factors * adjusted[ascending]), 1.0)
    return adjusted


@dataclass(frozen=True, repr=False)
class Pairs(Displayed):
    """All paired differences of some models, first minus second.

    Attributes:
        differences: estimate for each (first, second).
        p_values: p-value of no difference for each (first, second), adjusted for all pairs (`holm`).
    """

    differences: dict[tuple[str, str], Estimate]
    p_values: dict[tuple[str, str], float]

    def table(self) -> Table:
        """Return a table with a row for each pair, in the order of p-values."""
        table = Table(
            title="paired differences",
            caption="mean ± standard error over sequences ± over seeds; p: for all pairs at once, by Holm's procedure",
        )
        for name in ("first", "minus second", "difference", "95 %", "p"):
            table.add_column(name, justify="left" if name in ("first", "minus second") else "right")
        for pair in sorted(self.differences, key=lambda pair: (math.isnan(self.p_values[pair]), self.p_values[pair])):
            low, high = map(number, self.differences[pair].interval())
            reach = low if low == "–" else f"{low} to {high}"
            table.add_row(*pair, str(self.differences[pair]), reach, number(self.p_values[pair]))
        return table


def pairs(contenders: Mapping[str, TwoWayErrors]) -> Pairs:
    """Return all paired differences, with p-values adjusted for their number.

    Args:
        contenders: score on the same clusters for each name.

    Returns:
        Differences of each model with all later ones; p-values are NaN if a model has one seed.
    """
    differences = {
        (first, second): contenders[first].estimate(contenders[second]) for first, second in combinations(contenders, 2)
    }
    adjusted = holm([estimate.p_value() for estimate in differences.values()])
    return Pairs(differences, dict(zip(differences, map(float, adjusted), strict=True)))


@dataclass(frozen=True, repr=False)
class ConfidenceSet(Displayed):
    """Models that may be the best.

    Attributes:
        p_values: p-value of each model by name, in the order of elimination: a model is in the set of level L if p >= 1
            - L. The last remaining model has 1.
        level: level of `members`.
    """

    p_values: dict[str, float]
    level: float

    @property
    def members(self) -> list[str]:
        """Names of the models that may be the best, the likeliest first."""
        return [name for name, p in reversed(self.p_values.items()) if p >= 1 - self.level]

    def table(self) -> Table:
        """Return a table with a row for each model, those that may be the best first."""
        table = Table(
            title=f"models that may be the best, at {100 * self.level:g} %",
            caption=f"p: of no difference between the models left when this one is dropped; in the set if p ≥ "
            f"{1 - self.level:.3g}",
        )
        for name in ("model", "p", "in the set"):
            table.add_column(name, justify="right" if name == "p" else "left")
        for name, p in reversed(self.p_values.items()):
            table.add_row(name, number(p), "yes" if name in self.members else "no")
        return table


def confidence_set(
    contenders: Mapping[str, TwoWayErrors],
    better: str = "lower",
    level: float = 0.9,
    *,
    over_seeds: bool = True,
    draws: int = 10_000,
    seed: int = 0,
) -> ConfidenceSet:
    """Return the model confidence set, based on the differences of all remaining pairs.

    Args:
        contenders: score on the same clusters for each name.
        better: "lower" or "higher".
        level: probability that the best model is in the set.
        over_seeds: whether to account for other training seeds; if False, the set is for these weights only.
        draws: number of draws of the null distribution.
        seed: seed of the draws.

    Raises:
        ValueError: when `contenders` is empty, `level` is not between 0 and 1, or `better` is neither "lower" nor
            "higher". Also when scores are on one cluster, on different clusters or not finite, or a model has one seed
            with `over_seeds`.
    """
    if not contenders or not 0 < level < 1 or draws < 1:
        raise ValueError(
            f"a confidence set needs at least one model and draw and a level between 0 and 1, got {len(contenders)} "
            f"models, {draws} draws and a level of {level}"
        )
    if better not in ("lower", "higher"):
        raise ValueError(f"better must be 'lower' or 'higher', got {better!r}")
    names, rows = list(contenders), list(contenders.values())
    if over_seeds and (single := [name for name in names if math.isnan(contenders[name].seeds)]):
        raise ValueError(
            f"{', '.join(single)} has one training seed, so no error over seeds exists; pass more seeds, or "
            "over_seeds=False to compare only these weights"
        )
    clusters = _check(contenders)
    if clusters < 2:
        raise ValueError(
            "all windows belong to one cluster, so no error over clusters exists; evaluate on more sequences"
        )
    means = np.array([row.mean for row in rows]) * (1 if better == "lower" else -1)
    deviations = np.stack([row.deviations for row in rows]) * math.sqrt(clusters / (clusters - 1))
    between, rest = (
        np.array([getattr(row, part) if over_seeds else 0.0 for row in rows]) for part in ("seeds", "rest")
    )
    freedom = np.array([min(row.count - 1, 10**9) if over_seeds else 10**9 for row in rows])

    random = np.random.default_rng(seed)
    wider = np.sqrt((clusters - 1) / random.chisquare(clusters - 1, (draws, 1)))
    common_errors = wider * (random.standard_normal((draws, clusters)) @ deviations.T)
    variances = np.maximum(between * freedom / random.chisquare(freedom, (draws, len(rows))) - rest, 0)
    errors = common_errors + np.sqrt(variances) * random.standard_normal((draws, len(rows)))

    worse, other = (index.ravel() for index in np.indices((len(rows), len(rows))))  # all ordered pairs of models
    null = errors[:, worse] - errors[:, other]
    single = (null >= means[worse] - means[other]).mean(0)
    null = scipy.stats.rankdata(-null, "max", axis=0) / draws
    remaining, p_values, running = np.ones(len(rows), bool), {}, 0.0
    while remaining.sum() > 1:
        (remaining_pairs,) = np.nonzero(remaining[worse] & remaining[other] & (worse != other))
        worst = remaining_pairs[
            np.lexsort(((means[other] - means[worse])[remaining_pairs], single[remaining_pairs]))[0]
        ]
        running = max(running, float((null[:, remaining_pairs].min(1) <= single[worst]).mean()))
        p_values[names[worse[worst]]] = running
        remaining[worse[worst]] = False
    p_values[names[int(remaining.argmax())]] = 1.0
    return ConfidenceSet(p_values, level)


def _check(rows: Mapping[str, TwoWayErrors]) -> int:
    """Return the number of clusters of comparable scores.

    Raises:
        ValueError: when scores are on different clusters, or not finite.
    """
    counts = {name: len(row.deviations) for name, row in rows.items()}
    if len(set(counts.values())) > 1:
        raise ValueError(f"scores to compare must be on the same windows, but their numbers of clusters are {counts}")
    for name, row in rows.items():
        if not (math.isfinite(row.mean) and np.isfinite(row.deviations).all()):
            raise ValueError(f"the score of {name} is not finite: its mean is {row.mean}")
    return next(iter(counts.values()))


@dataclass(frozen=True, repr=False)
class Requirement(Displayed):
    """Numbers of seeds and clusters needed to distinguish two models.

    Attributes:
        difference: difference to detect.
        power: probability of detecting it.
        level: level of the two-sided interval that must exclude 0.
        clusters: number of clusters of windows (clips, groups or sequences) for each number of training seeds per
            model; infinite if no number is enough.
        now: present numbers of clusters and of each model's seeds.
        achieved: power with the present numbers. For the measured difference it follows from the p-value and adds no
            information.
    """

    difference: float
    power: float
    level: float
    clusters: dict[int, float]
    now: tuple[int, int, int]
    achieved: float

    def table(self) -> Table:
        """Return a table with a row for each number of seeds."""
        clusters, *seeds = self.now
        table = Table(
            title=f"to detect a difference of {number(self.difference, 4)} with a power of {100 * self.power:g} %",
            caption=f"power with {clusters} clusters and {' and '.join(map(_seeds, seeds))}: "
            f"{100 * self.achieved:.0f} %, at a level of {100 * self.level:g} %",
        )
        for name in ("seeds per model", "clusters"):
            table.add_column(name, justify="right")
        for count, n_clusters in self.clusters.items():
            table.add_row(str(count), f"{n_clusters:.0f}" if math.isfinite(n_clusters) else "no number is enough")
        return table


def _seeds(count: int) -> str:
    return "no training" if count == sys.maxsize else f"{count} seeds"


def required(
    first: TwoWayErrors,
    second: TwoWayErrors,
    *,
    difference: float | None = None,
    power: float = 0.8,
    level: float = 0.95,
    seeds: Sequence[int] = (2, 3, 4, 5, 7, 10, 15, 20),
) -> Requirement:
    """Return how many training seeds and clusters would distinguish two models, from their measured variances.

    The variances are estimates themselves: with three seeds, a variance may well be off by a factor of two. New
    clusters are assumed to be as long as the present ones.

    Args:
        first, second: scores of two models on the same clusters, with at least two seeds each.
        difference: difference to detect; the measured one by default.
        power: probability of detecting it.
        level: level of the interval that must exclude 0.
        seeds: numbers of seeds per model in the result.

    Raises:
        ValueError: when a model has one seed, or scores are on different clusters or not finite. Also when the
            difference is 0 or not finite, seeds are below 2, or power or level is not between 0 and 1.
    """
    if not (0 < power < 1 and 0 < level < 1) or min(seeds, default=0) < 2 or any(int(each) != each for each in seeds):
        raise ValueError(
            f"power and level must be between 0 and 1 and seeds whole numbers of at least 2, got {power}, {level} and "
            f"{[*seeds]}"
        )
    count = _check({"the first": first, "the second": second})
    measured = first.estimate(second)
    sought = abs(measured.mean if difference is None else difference)
    if math.isnan(measured.total) or not 0 < sought < math.inf:
        raise ValueError(
            "both models need at least two seeds and two clusters, and a finite, nonzero difference to detect; "
            f"got a difference of {sought} with a standard error of {measured.total}"
        )
    rows = (first, second)
    rest = [row.rest * row.count * count for row in rows]  # variances of single seeds and clusters
    seed_variances = [max(row.count * row.seeds - r / count, 0.0) for row, r in zip(rows, rest, strict=True)]
    common = max(count * measured.sequences**2 - sum(row.rest * count for row in rows), 0.0)

    def reached(clusters: int, *numbers: int) -> float:
        """Return the power, averaged over errors and degrees of freedom that `TwoWayErrors.estimate` may return."""
        both = [*zip(rest, seed_variances, numbers, strict=True)]
        over = (common + sum(r / n for r, _, n in both)) / clusters
        between = [(o + r / clusters) / n for r, o, n in both]
        shared = sum(r / n for r, _, n in both) / clusters
        of_clusters, *others = _ranks()
        cluster_variance = over * scipy.special.chdtri(clusters - 1, of_clusters) / (clusters - 1)
        of_seeds = [
            v * scipy.special.chdtri(n - 1, ranks) / (n - 1)
            for v, (*_, n), ranks in zip(between, both, others, strict=True)
        ]
        total = np.maximum(cluster_variance + sum(of_seeds) - shared, np.maximum(cluster_variance, sum(of_seeds)))
        uncertain = cluster_variance**2 / (clusters - 1) + sum(
            v**2 / (n - 1) for v, n in zip(of_seeds, numbers, strict=True)
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            freedom = np.maximum(np.nan_to_num(total**2 / uncertain, nan=1e9), min(clusters, *numbers) - 1)
        beyond = scipy.special.stdtrit(np.minimum(freedom, 1e9), (1 + level) / 2) * np.sqrt(total)
        scale = math.sqrt(over + sum(o / n for _, o, n in both))
        if not scale:
            return 1.0
        tails = scipy.special.ndtr((np.array([[sought], [-sought]]) - beyond) / scale)
        return float(tails.sum(0).mean())

    def least(number: int) -> float:
        low = high = FEWEST
        while reached(high, number, number) < power:
            if high > MOST_CLIPS:
                return math.inf
            low, high = high + 1, 2 * high
        while low < high:
            middle = (low + high) // 2
            low, high = (low, middle) if reached(middle, number, number) >= power else (middle + 1, high)
        return float(high)

    now = (count, first.count, second.count)
    return Requirement(sought, power, level, {number: least(number) for number in seeds}, now, reached(*now))


FEWEST, MOST_CLIPS = 5, 10**7
"""Smallest number of clusters with an estimate of errors, and the number above which the search for more stops."""


@cache
def _ranks() -> np.ndarray:
    """Return quasi-random ranks of the variances over clusters and over two models' seeds, to average over."""
    return scipy.stats.qmc.Halton(3, seed=0).random(2000).T
