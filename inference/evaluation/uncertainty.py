"""Standard errors of means over windows. Windows of one clip overlap, so errors are clustered by clip."""

import math

import numpy as np
import scipy


def linearised(clip_means: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted mean of clip means (..., C), a ratio of sums, and each clip's contribution to the error."""
    shares = weights / weights.sum()
    mean = (shares * clip_means).sum(-1)
    return mean, shares * (clip_means - mean[..., None])


def clustered_variance(deviations: np.ndarray) -> float:
    """Return the variance of a mean over windows from each clip's share of its error (C,); NaN for one clip."""
    clips = len(deviations)
    return clips / (clips - 1) * float((deviations**2).sum()) if clips > 1 else math.nan


def effective_number(shares: np.ndarray, deviations: np.ndarray, most: float) -> int:
    """Return how many independent draws give histograms as uncertain as draws that are dependent within clips.

    The number is one over the root mean square of v / (p (1 - p)) over shares p, with v the clustered variance of the
    observed share. For N independent draws this ratio is 1 / N. With the mean instead of the root mean square, this is
    the correction of Rao and Scott (1981) for design effects. The root mean square is larger if the effects differ, as
    in their second-order correction (1984). With few clips the variances are uncertain, so the number is reduced by the
    squared ratio of Student's interval to the normal one.

    Args:
        shares: expected shares `(G,)`, between 0 and 1.
        deviations: contribution of each of C > 1 clips to the error of the observed share, `(G, C)` (`linearised`).
        most: total number of draws.
    """
    clips = deviations.shape[-1]
    if most <= clips:  # one draw per clip, and clips are independent
        return int(most)
    effects = clips / (clips - 1) * (deviations**2).sum(-1) / (shares * (1 - shares))
    wider = (scipy.special.stdtrit(clips - 1, 0.975) / scipy.special.ndtri(0.975)) ** 2
    size = wider * math.sqrt((effects**2).mean())
    return int(max(1.0, min(most, 1 / size if size else math.inf)))


def decimals(mean: float, *errors: float) -> int:
    """Return the number of decimals for printing a mean and its errors.

    It is three as in the papers, and four if an error is below 0.001. From a mean of 1000 or an error of 10 on, it is
    one less for each further digit before the point.
    """
    known = [error for error in errors if 0 < error < math.inf]
    largest = max([abs(mean) / 100, *known, 1.0] if math.isfinite(mean) else [1.0])
    return max((4 if known and min(known) < 0.001 else 3) - math.floor(math.log10(largest)), 0)


def student_interval(mean: float, error: float, freedom: float, level: float = 0.95) -> tuple[float, float]:
    """Return the two-sided Student's t interval of a mean, for a standard error with `freedom` degrees of freedom.

    Raises:
        ValueError: when the level is not between 0 and 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval is between 0 and 1, got {level}")
    reach = error * float(scipy.special.stdtrit(freedom, (1 + level) / 2)) if error else 0.0
    return mean - reach, mean + reach
