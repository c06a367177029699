"""Estimates of models on the same sequences, with errors over sequences and over training seeds.

A fitted model differs from the next for two reasons, and an estimate here shows both apart: other sequences might have
been held out, and another seed might have trained it. Sequences and seeds are crossed. Take y_sc, the mean of seed s
over clip c, as mean + seed_s + clip_c + rest_sc (a two-way random-effects model). Then the mean over S seeds and C
clips has

    V_sequences   of the mean over seeds, by clips (linearised, as in `evaluate`):  (var clip + var rest / S) / C
    V_seeds       of the seeds' means, over S:                                      (var seed + var rest / C) / S
    V_rest        from the interaction's residuals:                                 var rest / (S C)
    V_total = V_sequences + V_seeds - V_rest,   where the sum would count the rest twice, and at least either of the two

(Cameron, Gelbach and Miller, 2011, have this as two-way clustering.) A difference of two models is paired over
sequences, and its seeds are independent: V_seeds and V_rest are sums of both models'. With one seed V_seeds and V_total
are unknown, and what is left speaks of these weights only.

Intervals and p-values are Student's, since few seeds tell little of V_seeds. V_sequences has C - 1 degrees of freedom,
V_seeds of a row S - 1, and sums of independent variances V_i with f_i have (sum V_i)^2 / sum (V_i^2 / f_i), as in the
tests of Satterthwaite (1946) and Welch (1947): V_seeds of a difference between S - 1 and 2 (S - 1), and

    f_total = V_total^2 / (V_sequences^2 / (C - 1) + sum over rows V_seeds^2 / (S - 1))
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy

from .uncertainty import clustered_variance, decimals, linearised, student_interval

_ERRORS = ("sequences", "seeds", "total")


@dataclass(frozen=True)
class Estimate:
    """A mean over sequences and seeds, and its standard errors; NaN where one is unknown (one clip, one seed).

    Args:
        mean: the weighted mean.
        sequences: standard error over sequences, clustered by clip.
        seeds: standard error over training seeds.
        total: standard error from both.
        freedom: degrees of freedom of each of the three, in this order.
    """

    mean: float
    sequences: float
    seeds: float
    total: float
    freedom: tuple[float, float, float] = (math.nan, math.nan, math.nan)

    def interval(self, level: float = 0.95, error: str = "total") -> tuple[float, float]:
        """Where the mean lies at this level by Student's t, from one of the errors; NaN where that is unknown.

        Raises:
            ValueError: a level that is not between 0 and 1, or an error that is none of the three.
        """
        return student_interval(self.mean, *self._error(error), level)

    def p_value(self, error: str = "total") -> float:
        """Of a mean of zero, two-sided, by Student's t from one of the errors; NaN where that is unknown.

        Raises:
            ValueError: an error that is none of the three.
        """
        scale, freedom = self._error(error)
        if scale == 0:
            return float(self.mean == 0)
        return float(2 * scipy.special.stdtr(freedom, -abs(self.mean) / scale))

    def _error(self, name: str) -> tuple[float, float]:
        if name not in _ERRORS:
            raise ValueError(f"errors are over {', '.join(_ERRORS)}, not {name!r}")
        place = _ERRORS.index(name)
        return (self.sequences, self.seeds, self.total)[place], self.freedom[place]

    def __str__(self) -> str:
        places = decimals(self.mean, self.sequences, self.seeds)
        return " ± ".join(number(value, places) for value in (self.mean, self.sequences, self.seeds))


def number(value: float, places: int = 3) -> str:
    """In print; a dash where it is unknown."""
    return "–" if math.isnan(value) else f"{round(value, places) + 0.0:.{places}f}"  # no minus before a zero


def _freedom(total: float, *parts: tuple[float, float]) -> float:
    """Satterthwaite's degrees of freedom of a variance made of parts, each with its own; NaN where one is unknown."""
    uncertainty = sum(part**2 / freedom if freedom else math.nan for part, freedom in parts)
    least = min(freedom for _, freedom in parts)  # the total is at most the sum of the parts
    return max(total**2 / uncertainty, least) if uncertainty else math.nan


@dataclass(frozen=True)
class Crossed:
    """A model's mean, what each clip adds to its error (C,), the variances of its seeds and of the rest, and S."""

    mean: float
    deviations: np.ndarray
    seeds: float
    rest: float
    count: int

    @classmethod
    def of(cls, means: np.ndarray, weights: np.ndarray) -> Crossed:
        """From means by seed and clip (S, C) and the clips' weights (C,)."""
        by_seed, deviations = linearised(means, weights)
        common = deviations.mean(0)
        count = len(means)
        if count < 2:
            return cls(float(by_seed.mean()), common, math.nan, math.nan, count)
        # As `clustered_variance`, of the seeds' own deviations from what they have in common.
        rest = sum(clustered_variance(own) for own in deviations - common) / (count * (count - 1))
        return cls(float(by_seed.mean()), common, float(by_seed.var(ddof=1)) / count, rest, count)

    @classmethod
    def by_clip(cls, values: np.ndarray, weights: np.ndarray, places: np.ndarray) -> Crossed:
        """From values by seed and sequence (S, N), their weights (N,) and the clip (N,) that each sequence is of.

        A value is of its whole sequence: the mean is the sum of values over that of weights.
        """
        whole = np.bincount(places, weights=weights)
        return cls.of(np.stack([np.bincount(places, weights=seed) for seed in values]) / whole, whole)

    def estimate(self, other: Crossed | None = None) -> Estimate:
        """The mean, or its paired difference to that of another model, with the errors of the module's docstring."""
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
