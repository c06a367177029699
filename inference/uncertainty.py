"""Standard errors of means over windows: windows of one clip overlap, so that clips are what is independent."""

import math

import numpy as np
from scipy import special


def linearised(clip_means: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The weighted mean of clip means (..., C), a ratio of sums over clips, and what each clip adds to its error."""
    shares = weights / weights.sum()
    mean = (shares * clip_means).sum(-1)
    return mean, shares * (clip_means - mean[..., None])


def clustered_variance(deviations: np.ndarray) -> float:
    """Variance of a mean over windows from what each clip adds to its error, (C,); NaN where there is one clip."""
    clips = len(deviations)
    return clips / (clips - 1) * float((deviations**2).sum()) if clips > 1 else math.nan


def student_interval(mean: float, error: float, freedom: float, level: float = 0.95) -> tuple[float, float]:
    """Two-sided interval of Student's t for a mean with a standard error of so many degrees of freedom.

    Raises:
        ValueError: a level that is not between 0 and 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval is between 0 and 1, got {level}")
    reach = error * float(special.stdtrit(freedom, (1 + level) / 2)) if error else 0.0
    return mean - reach, mean + reach
