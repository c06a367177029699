"""Scores of forecasts as small objects, for any sequences; an application adds its own to those here.

A `Measure` is a function of forecasts and truth with a name, a unit and the direction that is better. A set of them is
a function of the windows that are evaluated on:

    speed = Measure("speed error", lambda forecasts, truth, past, index: ..., unit="m/s")
    dvae.evaluate(model, windows, scores=lambda windows: [*proper(windows), speed])

`proper` are proper scoring rules. What a model explains (bound, importance bound, k-hat, KL, log score) needs the model
and no forecasts; `dvae.evaluate` has options for it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from torch import Tensor

from ..data import Batch, HeldOutWindows
from . import metrics


@dataclass(frozen=True)
class Metric:
    """How a score is to be read.

    Args:
        unit: of the score.
        program: "free-running" or "teacher-forced".
        better: "lower", "higher", or "" for neither.
        partial: it is NaN of clips of which it says nothing, and they are left out.
    """

    unit: str = ""
    program: str = "free-running"
    better: str = "lower"
    partial: bool = False


LOG_SCORE = Metric("nats/frame", "free-running", "higher")
TEACHER_FORCED = {
    "ELBO": Metric("nats/frame", "teacher-forced", "higher"),
    "importance bound": Metric("nats/frame", "teacher-forced", "higher"),
    "k-hat": Metric("", "teacher-forced"),
}
KL = Metric("nats/frame", "teacher-forced", "")


def clip_means(values: Tensor, clips: Tensor) -> Sequence[float]:
    """Means over the windows of each clip.

    Args:
        values: `(N,)`, the score of every window.
        clips: `(N,)`, the clip of every window, from 0 to C - 1.
    """
    places = clips.numpy()
    return (np.bincount(places, weights=values.double().numpy()) / np.bincount(places)).tolist()


def means_of_those_that_count(values: Tensor, clips: Tensor) -> Sequence[float]:
    """Of scores that are NaN of windows that do not count: the mean over windows is that over those that do.

    R + N / M (s_c - R m_c) / n_c for each clip, s_c the sum over those m_c of its n_c windows that count, M of all N,
    and R the mean over these M: a ratio of sums, linearised, so that errors are those of a ratio (Cochran 1977).
    """
    places, known = clips.numpy(), ~values.isnan().numpy()
    windows, counted = np.bincount(places), np.bincount(places, weights=known)
    sums = np.bincount(places, weights=values.nan_to_num().double().numpy())
    ratio = sums.sum() / counted.sum()
    found: list[float] = (ratio + (sums - ratio * counted) / windows * (len(places) / counted.sum())).tolist()
    return found


@dataclass(frozen=True)
class Measure:
    """A score of free-running forecasts.

    Args:
        name: of the score.
        function: of forecasts `(B, K, H, D)`, true futures `(B, H, D)`, NaN where they were not observed, the past (x
            `(B, O, D)`, its mask if there is one, and context) and the places `(B,)` of these windows among all, to the
            score `(B,)`, on the CPU.
        unit, better, partial: see `Metric`.
        pool: from what `function` gave of all windows, `(N, ...)`, and the clip of each, to a value for each clip, of
            which the score is the mean weighted by windows. A score of the whole set gives pseudo-values.
        headline: whether a comparison shows it in its table.
        truth: name of a reference row that forecasts the true futures, where these are needed to read the score.
        note: a line below the table.
        basis: what the score rests on, by name, for the record, in JSON's types.
    """

    name: str
    function: Callable[[Tensor, Tensor, Batch, Tensor], Tensor]
    unit: str = ""
    better: str = "lower"
    partial: bool = False
    pool: Callable[[Tensor, Tensor], Sequence[float]] = clip_means
    headline: bool = False
    truth: str = ""
    note: str = ""
    basis: Mapping[str, Any] = field(default_factory=dict)

    @property
    def metric(self) -> Metric:
        """How it is to be read."""
        return Metric(self.unit, "free-running", self.better, self.partial)


def paired(score: Callable[[Tensor, Tensor], Tensor]) -> Callable[[Tensor, Tensor, Batch, Tensor], Tensor]:
    """The function of a measure from a score of samples `(..., K, T, D)` and truth `(..., T, D)`, as in `metrics`."""
    return lambda forecasts, truth, past, index: score(forecasts, truth)


ENERGY = Measure("energy score", paired(metrics.energy_score), headline=True)
VARIOGRAM = Measure("variogram score", paired(metrics.variogram_score))
CRPS = Measure("CRPS", paired(metrics.continuous_ranked_probability_score), headline=True)


def proper(windows: HeldOutWindows) -> list[Measure]:
    """Proper scoring rules: of the future as one vector, of dependence between coordinates, of each number alone."""
    return [ENERGY, VARIOGRAM, CRPS]


Scores = Callable[[HeldOutWindows], Sequence[Measure]]
"""A set of scores: from the windows that are evaluated on, whose order its measures may know, to the measures."""
