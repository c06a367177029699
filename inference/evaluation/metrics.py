"""Scores of stochastic forecasts, as pure functions on arrays.

The energy score (Gneiting and Raftery 2007, section 4.3), the variogram score (Scheuerer and Hamill 2015) and the CRPS
are proper: no forecaster gains by spreading its samples. The Fréchet distance compares two sets of features and has its
own shapes. Applications add their own errors, such as the best of K samples.

Calibration (coverage, PIT) depends on the rank of each number of the truth among the K numbers of the samples. If
forecasts are calibrated, the truth is exchangeable with the samples. Its rank, random among ties, is then uniform on 0
to K. With L samples below it and E equal to it, its PIT is (L + V (E + 1)) / (K + 1), V uniform on 0 to 1. This is
uniform on 0 to 1 for every K, and also for discrete data (Czado, Gneiting and Held 2009). Shares and moments are
expectations over V, without draws. Their values for calibrated forecasts are exact for every K.

Shapes everywhere: samples `(..., K, T, D)`, K forecasts of T steps with D coordinates; truth `(..., T, D)`; the result
has the leading shape `(...)`. Functions accept torch tensors and numpy arrays and return a tensor. NaN in a truth was
not observed and is ignored. Frames without observations are ignored, too. The value for a data set is the plain mean
over its windows. Every function raises ValueError for shapes that do not fit. Windows are scored one after another, so
memory does not grow with their number.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ...data.sequences import mean_of_known

Array = Tensor | np.ndarray


def average_pairwise_distance(samples: Array) -> Tensor:
    """Return the APD, the diversity of samples: mean of ||vec(X_j) - vec(X_k)|| over the K (K - 1) / 2 pairs.

    The norm runs over all T * D numbers and is not divided by time. A single sample has diversity 0.

    Args:
        samples: samples `(..., K, T, D)`.

    Returns:
        Diversity `(...)`, in the unit of the data.
    """
    samples = as_samples(samples)
    return per_window(mean_pairwise_distance, samples)


def energy_score(samples: Array, truth: Array, diversity: Array | None = None) -> Tensor:
    """Return the energy score of the future as one vector; proper, lower is better (Gneiting and Raftery 2007).

    ES = mean_k ||vec(X_k) - vec(y)|| - 1/2 mean_{j<k} ||vec(X_j) - vec(X_k)||, the unbiased ("fair") estimate, whose
    expectation does not depend on K. The second mean is the APD. With K = 1 the forecast is a point mass and the score
    is the distance. This is fair to a deterministic forecast, but not to one draw of a stochastic one.

    Args:
        samples: samples `(..., K, T, D)`.
        truth: truth `(..., T, D)`.
        diversity: APD of the samples `(...)`, if it is known and nothing is missing; None to compute it.

    Returns:
        Score `(...)`, in the unit of the data.
    """

    def score(x: Tensor, y: Tensor) -> Tensor:
        distance = displacement(x.flatten(1), y.flatten()).mean()
        return distance - mean_pairwise_distance(x) / 2 if diversity is None else distance

    result = per_window(over_observed(score), *as_pair(samples, truth))
    return result if diversity is None else result - torch.as_tensor(diversity) / 2


def continuous_ranked_probability_score(samples: Array, truth: Array) -> Tensor:
    """Return the CRPS of each number, averaged over steps and coordinates; proper, lower is better.

    CRPS = mean_k |X_k - y| - 1/2 mean_{j<k} |X_j - X_k|, the unbiased ("fair") estimate, whose expectation does not
    depend on K: integral of (P(X <= u) - 1[y <= u])^2 du. It is the energy score of one number, and ignores dependence
    between numbers. With K = 1 the forecast is a point mass and the score is the absolute error.

    Args:
        samples: samples `(..., K, T, D)`.
        truth: truth `(..., T, D)`.

    Returns:
        Score `(...)`, in the unit of the data.
    """

    def score(x: Tensor, y: Tensor) -> Tensor:
        errors, count = (x - y).flatten(1), len(x)
        errors = errors[:, ~y.flatten().isnan()] if y.isnan().any() else errors
        # When sorted, number i is the larger one in i pairs and the smaller one in K - 1 - i.
        signs = 2 * torch.arange(count, dtype=x.dtype, device=x.device) - (count - 1)
        spread = (signs @ errors.sort(0).values).mean() / max(1, count * (count - 1) / 2)
        return errors.abs().mean() - spread / 2

    return per_window(score, *as_pair(samples, truth))


def probability_integral_transform(samples: Array, truth: Array, uniform: Array) -> Tensor:
    """Return the PIT of every number of the truth; uniform on 0 to 1 for calibrated forecasts, for any K and ties.

    Args:
        samples: samples `(..., K, T, D)`.
        truth: truth `(..., T, D)`.
        uniform: independent uniform draws on 0 to 1, `(..., T, D)`, which place a truth among equal samples and in the
            gap between two. The same draws give the same transform.

    Returns:
        PIT `(..., T, D)`, in double precision; NaN where the truth was not observed. The rank among the K samples is
        floor((K + 1) PIT).

    Raises:
        ValueError: when the draws have another shape than the truth, or are outside 0 to 1.
    """
    samples, truth = as_pair(samples, truth)
    uniform = torch.as_tensor(uniform, device=truth.device).double()
    if uniform.shape != truth.shape or not ((uniform >= 0) & (uniform <= 1)).all():
        raise ValueError(
            f"uniform draws must have the shape {shape_of(truth)} of the truth and be from 0 to 1; got "
            f"{shape_of(uniform)} from {uniform.min():g} to {uniform.max():g}"
        )
    low, ties = _ranks(samples, truth)
    return (low + uniform * ties) / (samples.shape[-3] + 1)


def pit_mean(samples: Array, truth: Array) -> Tensor:
    """Return the mean PIT over steps and coordinates: 1/2 for calibrated forecasts, less for too high ones.

    Args:
        samples: samples `(..., K, T, D)`.
        truth: truth `(..., T, D)`.

    Returns:
        Mean `(...)`, in double precision.
    """
    samples, truth = as_pair(samples, truth)
    low, ties = _ranks(samples, truth)
    return mean_of_known(low + ties / 2, (-2, -1)) / (samples.shape[-3] + 1)


def pit_variance(samples: Array, truth: Array) -> Tensor:
    """Return the mean square of PIT - 1/2, in twelfths: 1 for calibrated forecasts, more for too narrow ones.

    Deviations are from 1/2 rather than from the mean PIT, so the value is also above 1 for forecasts that are too high
    or too low. With K = 1 it is 1 for any forecast. Its largest value, if the truth is always outside all samples, is 3
    - 6 / (K + 1) + 4 / (K + 1)^2. Shapes as in `pit_mean`.
    """
    samples, truth = as_pair(samples, truth)
    low, ties = _ranks(samples, truth)
    count = samples.shape[-3] + 1
    return mean_of_known(12 * (low + ties / 2 - count / 2).square() + ties.square(), (-2, -1)) / count**2


def pit_histogram(samples: Array, truth: Array, bins: int = 20) -> Tensor:
    """Return the shares of the PIT of all numbers in bins of equal width: 1 / bins each for calibrated forecasts.

    Args:
        samples: samples `(..., K, T, D)`; with K below `bins` - 1, bins cannot be distinguished.
        truth: truth `(..., T, D)`.
        bins: number of bins.

    Returns:
        Shares `(..., bins)`, in double precision, which add up to 1.
    """
    samples, truth = as_pair(samples, truth)
    if bins < 1:
        raise ValueError(f"a histogram needs at least 1 bin, got {bins}")
    low, ties = _ranks(samples, truth)
    edges = [edge * (samples.shape[-3] + 1) / bins for edge in range(1, bins)]
    inner = [mean_of_known(((edge - low) / ties).clamp(0, 1), (-2, -1)) for edge in edges]
    total = torch.where(low.isnan().all(-1).all(-1), torch.nan, 1.0).to(low)
    return torch.stack([*inner, total], -1).diff(dim=-1, prepend=total[..., None] * 0)


def tarp_histogram(samples: Array, truth: Array, reference: Array, bins: int = 20) -> Tensor:
    """Return TARP (Lemos et al. 2023, arXiv 2302.03026): histogram of the PIT of the truth's distance from a point.

    The statistic is the share of samples in the ball around the point with the truth on its surface. It is uniform if
    samples and truth have the same distribution, for any point, any K and with ties, as in `pit_histogram`. Unlike the
    PIT of single numbers, it depends on all numbers together. If it is uniform for every choice of a point that depends
    on the forecast's input, samples and truth have the same distribution. With points that do not depend on the input,
    samples that ignore the input also pass.

    Args:
        samples: samples `(..., K, T, D)`.
        truth: truth `(..., T, D)`; numbers that were not observed do not count in distances.
        reference: point `(..., T, D)`; distances are Euclidean, over all numbers, in their units.
        bins: number of bins.

    Returns:
        Shares `(..., bins)`, in double precision, which add up to 1.
    """
    samples, truth = as_pair(samples, truth)
    reference, missing = torch.as_tensor(reference).to(truth), truth.isnan()

    def distance(values: Tensor, point: Tensor, gaps: Tensor) -> Tensor:
        return torch.where(gaps, 0.0, values - point).flatten(-2).norm(dim=-1)[..., None, None]

    true_distance = distance(truth, reference, missing).masked_fill(missing.all(-1, True).all(-2, True), torch.nan)
    return pit_histogram(distance(samples, reference.unsqueeze(-3), missing.unsqueeze(-3)), true_distance, bins)


def coverage(samples: Array, truth: Array, level: float) -> Tensor:
    """Return the share of numbers of the truth in the central interval of K samples: `level` if calibrated.

    The truth is inside if the PIT is between (1 - level) / 2 and (1 + level) / 2. Let h = (K + 1) (1 - level) / 2. If h
    is whole, the interval is from the h-th smallest sample to the h-th largest one. These contain a truth that is
    exchangeable with them with probability 1 - 2 h / (K + 1), exactly.

    Otherwise, each end is in a gap between two samples. A truth in this gap counts as the share of the gap, measured in
    ranks, that is inside the interval. This equals an interval whose ends are drawn from the two samples so that their
    mean ranks are h. A truth that equals some samples counts as the share of its possible ranks that is inside, so
    coverage is `level` for discrete data, too. (Intervals with all their ties contain more.)

    Below h = 1, for K < 2 / (1 - level) - 1, the interval extends beyond all samples with probability 1 - h. The mean
    coverage is still `level` for calibrated forecasts. It reveals less about other forecasts, and nothing with K = 1.

    Args:
        samples: samples `(..., K, T, D)`.
        truth: truth `(..., T, D)`.
        level: level between 0 and 1.

    Returns:
        Share `(...)`, in double precision.

    Raises:
        ValueError: when the level is not between 0 and 1.
    """
    samples, truth = as_pair(samples, truth)
    end, count = _ranks_outside(samples, level), samples.shape[-3] + 1
    low, ties = _ranks(samples, truth)
    inside = ((low + ties).clamp(max=count - end) - low.clamp(min=end)).clamp(min=0) / ties
    return mean_of_known(inside, (-2, -1))


def interval_width(samples: Array, level: float) -> Tensor:
    """Return the width of the central interval of `coverage`, averaged over steps and coordinates: sharpness.

    The interval is from the h-th smallest to the h-th largest of K samples. It is linear between samples if h is not
    whole, and from the smallest to the largest one below h = 1.

    Args:
        samples: samples `(..., K, T, D)`; numbers that are NaN do not count.
        level: level between 0 and 1.

    Returns:
        Width `(...)`, in the unit of the data.

    Raises:
        ValueError: when the level is not between 0 and 1.
    """
    samples = as_samples(samples)
    end = max(_ranks_outside(samples, level), 1.0) - 1  # counted from 0
    first, ordered = int(end), samples.sort(-3).values
    spread = ordered.flip(-3) - ordered
    widths = spread[..., first, :, :]
    if end > first:
        widths = torch.lerp(widths, spread[..., first + 1, :, :], end - first)
    return mean_of_known(widths, (-2, -1))


def variogram_score(samples: Array, truth: Array, order: float = 0.5) -> Tensor:
    """Return the variogram score of the coordinates of each step; proper, lower is better (Scheuerer and Hamill 2015).

    VS = mean over steps and coordinate pairs i < j of (|y_i - y_j|^p - mean_k v_k)^2 - var_k v_k / K, where v_k =
    |X_ki - X_kj|^p. Subtracting the variance of the mean gives the unbiased ("fair") estimate, whose expectation does
    not depend on K, and which may be negative. With K = 1 the forecast is a point mass and nothing is subtracted.

    The score is sensitive to wrong dependence between coordinates (limbs that do not move together), which affects the
    energy score little. It ignores an offset common to all coordinates. A single coordinate has no pairs and scores 0.

    Args:
        samples: samples `(..., K, T, D)`.
        truth: truth `(..., T, D)`.
        order: exponent p.

    Returns:
        Score `(...)`, in the unit of the data to the power 2 p.

    Raises:
        ValueError: when the order is not positive.
    """
    if not order > 0:
        raise ValueError(f"the order of a variogram must be positive, got {order}")

    samples, truth = as_pair(samples, truth)
    *lead, steps, size = truth.shape
    count, scores = samples.shape[-3], []
    windows = samples.reshape(-1, count, steps, size), truth.reshape(-1, steps, size)
    for x, y in zip(*(part.split(max(1, CACHED // (count * steps * size))) for part in windows), strict=True):
        n_observed, total = (~y.isnan()).sum(-1), y.new_zeros(len(y))  # by step
        missing = bool((n_observed < size).any())
        # Coordinates first, so that subtracted values are contiguous. The pairs of one coordinate fit in the cache; all
        # D * D pairs would not.
        x, y = (part.movedim(-1, 0).contiguous() for part in (x, y))
        for i in range(size - 1):
            forecast = (x[i + 1 :] - x[i]).abs_().pow_(order)
            actual = (y[i + 1 :] - y[i]).abs_().pow_(order)
            mean = forecast.mean(2)
            errors = (actual - mean).square_()
            if count > 1:  # `Tensor.var` takes nine times as long as everything else
                errors -= forecast.sub_(mean.unsqueeze(2)).square_().sum(2) / (count * (count - 1))
            total = total + (torch.where(actual.isnan(), 0.0, errors) if missing else errors).sum((0, 2))
        total = total.masked_fill((n_observed == 0).all(-1), math.nan)
        scores.append(total / ((n_observed * (n_observed - 1)).sum(-1) // 2).clamp(min=1))
    return torch.cat(scores).reshape(lead)


def frechet_distance(features: Array, other: Array) -> Tensor:
    """Return the Fréchet distance of normal fits to two sets of features: FID (Heusel et al. 2017, arXiv:1706.08500).

    It is `gaussian_frechet_distance` with unbiased covariances (divided by N - 1), in double precision. The distance is
    biased upward in small sets. It compares distributions, and ignores the correspondence of features to windows.

    Args:
        features: features `(N, F)`, N at least 2.
        other: features `(M, F)`, M at least 2.

    Returns:
        A scalar, in the square of the features' unit.
    """
    sets = [torch.as_tensor(each).double() for each in (features, other)]
    if any(each.ndim != 2 or len(each) < 2 for each in sets) or sets[0].shape[1] != sets[1].shape[1]:
        raise ValueError(
            "the Fréchet distance needs features (N, F) and (M, F), N and M at least 2, got "
            f"{shape_of(sets[0])} and {shape_of(sets[1])}"
        )
    moments = [moment for each in sets for moment in (each.mean(0), each.T.cov().reshape(2 * [each.shape[1]]))]
    return gaussian_frechet_distance(*moments)


def gaussian_frechet_distance(mean: Tensor, covariance: Tensor, other_mean: Tensor, other_covariance: Tensor) -> Tensor:
    """Return the squared Fréchet (2-Wasserstein) distance between two normal distributions (Dowson and Landau 1982).

    |m - n|^2 + tr(C + D - 2 (C D)^1/2), where tr (C D)^1/2 is the sum of the singular values of C^1/2 D^1/2. Values
    below the rounding error of the traces are set to 0.

    Args:
        mean: mean `(..., F)`.
        covariance: covariance `(..., F, F)`, symmetric and positive semidefinite.
        other_mean: like `mean`.
        other_covariance: like `covariance`.

    Returns:
        Distance `(...)`, in the square of the unit of the means.
    """

    # Roots of the eigenvalues of C^1/2 D C^1/2 would turn their rounding errors of 1e-16 into 1e-8.
    def root(matrix: Tensor) -> Tensor:
        values, vectors = torch.linalg.eigh(matrix)
        return vectors * values.clamp(min=0).sqrt()[..., None, :] @ vectors.mT

    traces = sum(matrix.diagonal(dim1=-2, dim2=-1).sum(-1) for matrix in (covariance, other_covariance))
    shared = torch.linalg.svdvals(root(covariance) @ root(other_covariance)).sum(-1)
    distance = (mean - other_mean).square().sum(-1) + traces - 2 * shared
    rounding = 4 * mean.shape[-1] * torch.finfo(mean.dtype).eps * traces
    return torch.where(distance > rounding, distance, 0.0)


def frechet_pseudo_values(real: Tensor, generated: Tensor, places: Tensor) -> tuple[float, ...]:
    """Return the Fréchet distance between features of true and generated windows, as jackknife pseudo-values of
    clusters.

    `jackknife_pseudo_values` defines these values.

    Args:
        real: features `(N, F)` of the true futures.
        generated: features `(N, K, F)` of the generated futures.
        places: cluster of every window, from 0 to C - 1, `(N,)`.
    """
    centre = real.mean(0)  # second moments lose digits far from 0
    sets = (
        _moments_without_clusters(real[:, None] - centre, places),
        _moments_without_clusters(generated - centre, places),
    )
    distance = gaussian_frechet_distance(*sets[0], *sets[1])
    return jackknife_pseudo_values(distance[0], distance[1:], places)


def jackknife_pseudo_values(distance: Tensor, without: Tensor, places: Tensor) -> tuple[float, ...]:
    """Return the distance of a set of windows as a jackknife pseudo-value of each cluster.

    The pseudo-value is d + (1/w - 1) (d - d') (Busing, Meijer and van der Leeden 1999). d' is the distance without the
    cluster, and w the cluster's share of the windows. A common constant is added so that the mean over windows is d,
    because the mean of plain pseudo-values is corrected for bias. For a mean over windows, pseudo-values are the means
    of the clusters, so the errors of both kinds of scores are computed alike.

    Args:
        distance: d, distance of the whole set.
        without: d' of each of C > 1 clusters, `(C,)`.
        places: cluster of every window, `(N,)`.
    """
    shares = places.bincount().double() / len(places)
    pseudo = distance + (1 / shares - 1) * (distance - (without if len(shares) > 1 else distance))
    return tuple((pseudo - (shares * pseudo).sum() + distance).tolist())


def _moments_without_clusters(features: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
    """Return means (1 + C, F) and covariances (1 + C, F, F) of features (N, K, F).

    Entry 0 is for all windows. Each other entry omits the windows of one of C > 1 clusters.
    """

    def sums(values: Tensor) -> Tensor:
        by_cluster = values.new_zeros(int(places.max()) + 1, *values.shape[1:]).index_add_(0, places, values)
        total = by_cluster.sum(0, keepdim=True)
        return torch.cat([total, total - by_cluster]) if len(by_cluster) > 1 else total

    count = sums(features.new_full((len(features), 1), features.shape[1]))
    mean = sums(features.sum(1)) / count
    squares = sums(features.mT @ features)
    return mean, (squares - count[..., None] * mean[:, :, None] * mean[:, None]) / (count[..., None] - 1)


CACHED = 2**17
"""Number of values that fit in a processor's cache."""


def _ranks(samples: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Return the number of samples below the truth, and the number of possible ranks (ties plus one), (..., T, D)."""
    actual = truth.unsqueeze(-3)
    low, equal = (compared.sum(-3).double() for compared in (samples < actual, samples == actual))
    return low.masked_fill(truth.isnan(), torch.nan), equal + 1


def _ranks_outside(samples: Tensor, level: float) -> float:
    """Return the number of the K + 1 ranks on each side of a central interval; it may be fractional."""
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval must be between 0 and 1, got {level}")
    count = (samples.shape[-3] + 1) * (1 - level) / 2  # for .9 and K = 19 not exactly 1
    return float(round(count)) if math.isclose(count, round(count)) else count


def over_observed(score: Callable[[Tensor, Tensor], Tensor]) -> Callable[[Tensor, Tensor], Tensor]:
    """Wrap a score of distances so that it ignores missing values of a truth (T, D).

    It uses steps with observations, and sets missing numbers of samples and truth to 0. Without any it is NaN.
    """

    def observed_score(samples: Tensor, truth: Tensor) -> Tensor:
        missing = truth.isnan()
        if missing.any():
            frames = ~missing.all(-1)
            samples, truth = (torch.where(missing, 0.0, values) for values in (samples, truth))
            if not frames.any():
                return score(samples, truth) * math.nan
            samples, truth = samples[..., frames, :], truth[..., frames, :]
        return score(samples, truth)

    return observed_score


def displacement(samples: Tensor, truth: Tensor) -> Tensor:
    """Return the Euclidean distance over the coordinates of each step."""
    return torch.linalg.vector_norm(samples - truth, dim=-1)


def mean_pairwise_distance(samples: Tensor) -> Tensor:
    """Return the mean distance over pairs of (K, T, D), each a vector of T * D numbers."""
    rows = samples.flatten(1)
    if rows.isnan().any():  # scale the mean square over common numbers to all; NaN if no two samples share any
        squares = [(rows[k + 1 :] - row).square().nanmean(1) for k, row in enumerate(rows[:-1])]
        return (rows.shape[1] * torch.cat(squares)).sqrt().nanmean()
    return torch.pdist(rows).mean() if len(rows) > 1 else samples.new_zeros(())


def per_window(score: Callable[..., Tensor], samples: Tensor, *truth: Tensor) -> Tensor:
    """Apply a score to each window and restore the leading shape."""
    lead = samples.shape[:-3]
    windows = [part.reshape(-1, *part.shape[len(lead) :]) for part in (samples, *truth)]
    scores = torch.stack([score(*window) for window in zip(*windows, strict=True)])
    return scores.reshape((*lead, *scores.shape[1:]))


def as_samples(samples: Array) -> Tensor:
    """Return samples as a floating-point tensor; ValueError unless they are `(..., K, T, D)`."""
    samples = torch.as_tensor(samples)
    if samples.ndim < 3:
        raise ValueError(
            f"samples must be (..., K, T, D), got shape {shape_of(samples)}; add an axis K = 1 to a single forecast "
            "(T, D)"
        )
    if not samples.numel():
        raise ValueError(f"expected samples (..., K, T, D) with no size 0, got shape {shape_of(samples)}")
    return samples if samples.is_floating_point() else samples.double()


def as_pair(samples: Array, truth: Array) -> tuple[Tensor, Tensor]:
    """Return samples and truth as tensors of one type; ValueError unless their shapes fit."""
    samples = as_samples(samples)
    truth = torch.as_tensor(truth, device=samples.device)
    expected = samples.shape[:-3] + samples.shape[-2:]
    if truth.shape != expected:
        raise ValueError(
            f"samples (..., K, T, D) of shape {shape_of(samples)} need a truth (..., T, D) of shape "
            f"{tuple(expected)}, got {shape_of(truth)}; for a model's forecasts (K, B, T, D), pass "
            "samples.movedim(0, 1)"
        )
    return as_same_type(samples, truth)


def as_same_type(samples: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Return both tensors in the wider of their types."""
    dtype = torch.promote_types(samples.dtype, truth.dtype)
    return samples.to(dtype), truth.to(dtype)


def shape_of(array: Tensor) -> tuple[int, ...]:
    """Return the shape as a plain tuple, for messages."""
    return tuple(array.shape)
