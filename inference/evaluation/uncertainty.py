"""Standard errors of means over windows: windows of one clip overlap, so that clips are what is independent."""

import math

import numpy as np
import scipy


def linearised(clip_means: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The weighted mean of clip means (..., C), a ratio of sums over clips, and what each clip adds to its error."""
    shares = weights / weights.sum()
    mean = (shares * clip_means).sum(-1)
    return mean, shares * (clip_means - mean[..., None])


def clustered_variance(deviations: np.ndarray) -> float:
    """Variance of a mean over windows from what each clip adds to its error, (C,); NaN where there is one clip."""
    clips = len(deviations)
    return clips / (clips - 1) * float((deviations**2).sum()) if clips > 1 else math.nan


def effective_number(shares: np.ndarray, deviations: np.ndarray, most: float) -> int:
    """How many independent draws have histograms as uncertain as one of draws that depend on each other within clips.

    One over the root mean square over shares p of v / (p (1 - p)), v the clustered variance of what was found: for N
    independent draws that is 1 / N. The mean in its place is the correction of Rao and Scott (1981) for design effects;
    the root mean square is larger where these differ, as in their second-order correction (1984). Of few clips, whose
    variances are badly known, the number is smaller as Student's interval is wider.

    Args:
        shares: `(G,)`, between 0 and 1, what they are where nothing is wrong.
        deviations: `(G, C)`, what each of C > 1 clips adds to the error of the share that was found (`linearised`).
        most: draws that there are.
    """
    clips = deviations.shape[-1]
    if most <= clips:  # of one draw each, which are independent
        return int(most)
    effects = clips / (clips - 1) * (deviations**2).sum(-1) / (shares * (1 - shares))
    wider = (scipy.special.stdtrit(clips - 1, 0.975) / scipy.special.ndtri(0.975)) ** 2
    size = wider * math.sqrt((effects**2).mean())
    return int(max(1.0, min(most, 1 / size if size else math.inf)))


def decimals(mean: float, *errors: float) -> int:
    """Of a mean and its errors in print: three as in the papers, a fourth where an error needs it, fewer where large.

    From 1000 on, or with an error from 10 on, a decimal less for each further digit before the point.
    """
    known = [error for error in errors if 0 < error < math.inf]
    largest = max([abs(mean) / 100, *known, 1.0] if math.isfinite(mean) else [1.0])
    return max((4 if known and min(known) < 0.001 else 3) - math.floor(math.log10(largest)), 0)


def student_interval(mean: float, error: float, freedom: float, level: float = 0.95) -> tuple[float, float]:
    """Two-sided interval of Student's t for a mean with a standard error of so many degrees of freedom.

    Raises:
        ValueError: a level that is not between 0 and 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval is between 0 and 1, got {level}")
    reach = error * float(scipy.special.stdtrit(freedom, (1 + level) / 2)) if error else 0.0
    return mean - reach, mean + reach
