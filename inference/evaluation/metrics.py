"""Scores of stochastic forecasts, as pure functions on arrays.

The motion errors follow the evaluation code of DLow (Yuan and Kitani 2020, arXiv:2003.08386) and GSPS (Mao,
Liu and Salzmann 2021, arXiv:2108.08422); the median versions are those of HiT-DVAE (Bie et al. 2022,
arXiv:2204.01565). They reward the best (or the median) of K samples and are not proper: a forecaster gains by
spreading its samples. The energy score (Gneiting and Raftery 2007, section 4.3), the variogram score
(Scheuerer and Hamill 2015) and the CRPS stand beside them; and what asks for as much diversity and motion as there
really is, the APDE and CMD of BeLFusion (Barquero, Escalera and Palmero 2023, arXiv:2211.14304). The Fréchet distance
compares two sets of motions by features of them, and has shapes of its own.

Calibration (coverage, PIT) rests on where each number of the truth lies among the K numbers of the samples. Of
calibrated forecasts the truth is exchangeable with the samples, so that its rank, at random among ties, is uniform on
0, ..., K. With L samples below it and E equal to it, its PIT is (L + V (E + 1)) / (K + 1), V uniform on 0 to 1: uniform
on 0 to 1 for every K, of discrete data too (Czado, Gneiting and Held 2009). Shares and moments are expectations over
V, so that nothing is drawn, and what they are of calibrated forecasts is exact for every K.

Shapes everywhere: samples `(..., K, T, D)`, K forecasts of T frames with D coordinates; truth `(..., T, D)`,
or `(..., M, T, D)` where M futures are admissible; the result has the leading shape `(...)`. Torch tensors
and numpy arrays are accepted, a tensor comes back. A displacement is the Euclidean norm over *all* D
coordinates of a frame, in the unit of the data (metres); it is not a mean over joints. What is NaN in a truth
was not observed: it counts nowhere, nor does a frame of which nothing was observed (the final one is then the
last of which something was). The value for a data set is the plain mean over its windows. Every function
raises ValueError for shapes that do not fit. Windows are scored one after another, so that memory does not grow
with their number.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ...data.sequences import mean_of_known

Array = Tensor | np.ndarray


def average_pairwise_distance(samples: Array) -> Tensor:
    """APD, the diversity of the samples: mean of ||vec(X_j) - vec(X_k)|| over the K (K - 1) / 2 pairs.

    The norm runs over all T * D numbers and is not divided by time. A single sample has diversity 0.

    Args:
        samples: `(..., K, T, D)`.

    Returns:
        `(...)`, in the unit of the data.
    """
    samples = _samples(samples)
    return _per_window(_pairwise, samples)


def average_displacement_error(samples: Array, truth: Array) -> Tensor:
    """ADE: displacement averaged over the T frames, of the best of the K samples.

    Args:
        samples: `(..., K, T, D)`.
        truth: `(..., T, D)`.

    Returns:
        `(...)`, in the unit of the data.
    """
    return _per_window(_observed(lambda x, y: _displacement(x, y).mean(-1).amin()), *_paired(samples, truth))


def final_displacement_error(samples: Array, truth: Array) -> Tensor:
    """FDE: displacement at the last frame, of the sample that is best there. Shapes as in ADE."""
    return _per_window(_observed(lambda x, y: _displacement(x[:, -1], y[-1]).amin()), *_paired(samples, truth))


def median_average_displacement_error(samples: Array, truth: Array) -> Tensor:
    """ADEm: median over the K samples of the mean displacement (even K: mean of the middle two)."""
    return _per_window(_observed(lambda x, y: _median(_displacement(x, y).mean(-1))), *_paired(samples, truth))


def median_final_displacement_error(samples: Array, truth: Array) -> Tensor:
    """FDEm: median over the K samples of the final displacement (even K: mean of the middle two)."""
    return _per_window(_observed(lambda x, y: _median(_displacement(x[:, -1], y[-1]))), *_paired(samples, truth))


def multimodal_errors(samples: Array, truths: Array) -> Tensor:
    """MMADE, MMFDE, MMADEm and MMFDEm at once: errors to each of M admissible futures, averaged over them.

    Args:
        samples: `(..., K, T, D)`.
        truths: `(..., M, T, D)`, the futures that `references.multimodal_truths` finds, the true one among them.

    Returns:
        `(..., 4)`, in the unit of the data.
    """

    def errors(x: Tensor, y: Tensor) -> Tensor:
        apart = _cross(x, y)
        return torch.cat([apart.amin(1), _median(apart, 1)]).mean(-1)

    samples, truths = _multimodal(samples, truths)
    return _per_window(errors, samples, truths)


def multimodal_average_displacement_error(samples: Array, truths: Array) -> Tensor:
    """MMADE: the ADE to each of the admissible futures, averaged over them: `(...)`, see `multimodal_errors`."""
    return multimodal_errors(samples, truths)[..., 0]


def multimodal_final_displacement_error(samples: Array, truths: Array) -> Tensor:
    """MMFDE: the FDE to each of the admissible futures, averaged over them. Shapes as in MMADE."""
    return multimodal_errors(samples, truths)[..., 1]


def median_multimodal_average_displacement_error(samples: Array, truths: Array) -> Tensor:
    """MMADEm: the ADEm to each of the admissible futures, averaged over them. Shapes as in MMADE."""
    return multimodal_errors(samples, truths)[..., 2]


def median_multimodal_final_displacement_error(samples: Array, truths: Array) -> Tensor:
    """MMFDEm: the FDEm to each of the admissible futures, averaged over them. Shapes as in MMADE."""
    return multimodal_errors(samples, truths)[..., 3]


def average_pairwise_distance_error(samples: Array, truths: Array) -> Tensor:
    """APDE: |APD of the samples - APD of the M admissible futures| (BeLFusion).

    Where the true future alone is admissible there is no diversity to compare with; paper and public code leave such
    windows out of the mean, and the value is NaN.

    Args:
        samples: `(..., K, T, D)`.
        truths: `(..., M, T, D)`, as for MMADE.

    Returns:
        `(...)`, in the unit of the data; NaN for M = 1, and where no two truths have a number in common.
    """

    def score(x: Tensor, y: Tensor) -> Tensor:
        return (_pairwise(x) - _pairwise(y)).abs() if len(y) > 1 else x.new_tensor(torch.nan)

    return _per_window(score, *_multimodal(samples, truths))


def cumulative_motion_distance(motion: Array, real: Array) -> Tensor:
    """CMD, the area between cumulative motion as forecast and at its real pace: sum_{t=1}^{T-1} (T - t) |M_t - M|.

    M_t is what joints move by from frame t to t + 1 of the T predicted ones, the mean over joints, samples and windows,
    and M the mean of true motion over frames too. It is sum_i sum_{t<=i} |M_t - M| (BeLFusion): what goes wrong early
    counts in all later frames. True motion itself, which has no steady pace, is not at 0.

    Args:
        motion: `(..., T - 1)`, M_1 to M_{T-1}.
        real: `(...)`, M.

    Returns:
        `(...)`, in the unit of the data.
    """
    motion, real = torch.as_tensor(motion), torch.as_tensor(real)
    if motion.ndim != real.ndim + 1 or motion.shape[:-1] != real.shape or not motion.numel():
        raise ValueError(
            "motion (..., T - 1), T at least 2, needs a pace (...) of true motion, not "
            f"{_shape(motion)} and {_shape(real)}"
        )
    frames = torch.arange(motion.shape[-1], 0, -1, device=motion.device)
    return (frames * (motion - real[..., None]).abs()).sum(-1)


def energy_score(samples: Array, truth: Array, diversity: Array | None = None) -> Tensor:
    """Energy score of the future as one vector; proper, lower is better (Gneiting and Raftery 2007).

    ES = mean_k ||vec(X_k) - vec(y)|| - 1/2 mean_{j<k} ||vec(X_j) - vec(X_k)||, the unbiased ("fair")
    estimate, whose expectation does not depend on K. The second mean is the APD. With K = 1 the forecast is a
    point mass and the score is the distance itself, which is fair to a deterministic forecast but not to one
    draw of a stochastic one.

    Args:
        samples: `(..., K, T, D)`.
        truth: `(..., T, D)`.
        diversity: `(...)`, the APD of the samples where it is known and nothing is missing; None to find it.

    Returns:
        `(...)`, in the unit of the data.
    """

    def score(x: Tensor, y: Tensor) -> Tensor:
        distance = _displacement(x.flatten(1), y.flatten()).mean()
        return distance - _pairwise(x) / 2 if diversity is None else distance

    found = _per_window(_observed(score), *_paired(samples, truth))
    return found if diversity is None else found - torch.as_tensor(diversity) / 2


def continuous_ranked_probability_score(samples: Array, truth: Array) -> Tensor:
    """CRPS of each number alone, averaged over frames and coordinates; proper, lower is better (Gneiting and Raftery).

    CRPS = mean_k |X_k - y| - 1/2 mean_{j<k} |X_j - X_k|, the unbiased ("fair") estimate, whose expectation does not
    depend on K: integral of (P(X <= u) - 1[y <= u])^2 du. It is the energy score of one number, blind to dependence
    between numbers. With K = 1 the forecast is a point mass and the score is the absolute error.

    Args:
        samples: `(..., K, T, D)`.
        truth: `(..., T, D)`.

    Returns:
        `(...)`, in the unit of the data.
    """

    def score(x: Tensor, y: Tensor) -> Tensor:
        errors, count = (x - y).flatten(1), len(x)
        errors = errors[:, ~y.flatten().isnan()] if y.isnan().any() else errors
        # Sorted, number i is the larger one in i pairs and the smaller one in K - 1 - i.
        signs = 2 * torch.arange(count, dtype=x.dtype, device=x.device) - (count - 1)
        apart = (signs @ errors.sort(0).values).mean() / max(1, count * (count - 1) / 2)
        return errors.abs().mean() - apart / 2

    return _per_window(score, *_paired(samples, truth))


def probability_integral_transform(samples: Array, truth: Array, uniform: Array) -> Tensor:
    """PIT of every number of the truth; uniform on 0 to 1 where forecasts are calibrated, whatever K and the ties.

    Args:
        samples: `(..., K, T, D)`.
        truth: `(..., T, D)`.
        uniform: `(..., T, D)`, independent draws from 0 to 1, by which a truth has its place among equal samples and in
            the gap between two. The same draws give the same transform.

    Returns:
        `(..., T, D)`, in double precision; NaN where the truth was not observed. Its rank among the K samples is
        floor((K + 1) PIT).

    Raises:
        ValueError: draws of another shape than the truth, or beyond 0 and 1.
    """
    samples, truth = _paired(samples, truth)
    uniform = torch.as_tensor(uniform, device=truth.device).double()
    if uniform.shape != truth.shape or not ((uniform >= 0) & (uniform <= 1)).all():
        raise ValueError(
            f"a truth of shape {_shape(truth)} needs as many uniform draws, from 0 to 1; given are {_shape(uniform)} "
            f"from {uniform.min():g} to {uniform.max():g}"
        )
    low, ties = _places(samples, truth)
    return (low + uniform * ties) / (samples.shape[-3] + 1)


def pit_mean(samples: Array, truth: Array) -> Tensor:
    """Mean PIT over frames and coordinates: 1/2 of calibrated forecasts, below it of those that are too high.

    Args:
        samples: `(..., K, T, D)`.
        truth: `(..., T, D)`.

    Returns:
        `(...)`, in double precision.
    """
    samples, truth = _paired(samples, truth)
    low, ties = _places(samples, truth)
    return mean_of_known(low + ties / 2, (-2, -1)) / (samples.shape[-3] + 1)


def pit_variance(samples: Array, truth: Array) -> Tensor:
    """Mean square of PIT - 1/2, in twelfths: 1 of calibrated forecasts, above it of those that are too narrow.

    It is about 1/2, and not about its own mean: of forecasts that are too high or too low it is above 1, too. With
    K = 1 it is 1 whatever is forecast; at its largest, the truth always beyond all samples, it is
    3 - 6 / (K + 1) + 4 / (K + 1)^2. Shapes as in `pit_mean`.
    """
    samples, truth = _paired(samples, truth)
    low, ties = _places(samples, truth)
    count = samples.shape[-3] + 1
    return mean_of_known(12 * (low + ties / 2 - count / 2).square() + ties.square(), (-2, -1)) / count**2


def pit_histogram(samples: Array, truth: Array, bins: int = 20) -> Tensor:
    """Shares of the PIT of all numbers in bins of equal width: 1 / bins each of calibrated forecasts.

    Args:
        samples: `(..., K, T, D)`; K below `bins` - 1 cannot tell bins apart.
        truth: `(..., T, D)`.
        bins: their number.

    Returns:
        `(..., bins)`, in double precision, which add up to 1.
    """
    samples, truth = _paired(samples, truth)
    if bins < 1:
        raise ValueError(f"a histogram has at least 1 bin, not {bins}")
    low, ties = _places(samples, truth)
    edges = [edge * (samples.shape[-3] + 1) / bins for edge in range(1, bins)]
    inner = [mean_of_known(((edge - low) / ties).clamp(0, 1), (-2, -1)) for edge in edges]
    whole = torch.where(low.isnan().all(-1).all(-1), torch.nan, 1.0).to(low)
    return torch.stack([*inner, whole], -1).diff(dim=-1, prepend=whole[..., None] * 0)


def tarp_histogram(samples: Array, truth: Array, reference: Array, bins: int = 20) -> Tensor:
    """TARP (Lemos et al. 2023, arXiv 2302.03026): the PIT of the truth's distance from a point, as shares in bins.

    The share of the samples in the ball around the point with the truth on its surface: uniform where they are of the
    truth's law, wherever the point is, for every K and with ties, as in `pit_histogram`. Unlike the PIT of each number
    it is of all of them together. Where it is uniform for all points that depend on what a forecast is told, the law of
    the samples is that of the truth; points that do not depend on it pass samples that ignore it.

    Args:
        samples: `(..., K, T, D)`.
        truth: `(..., T, D)`; what was not observed counts in no distance.
        reference: `(..., T, D)`, the point; distances are Euclidean, over all numbers, in their units.
        bins: their number.

    Returns:
        `(..., bins)`, in double precision, which add up to 1.
    """
    samples, truth = _paired(samples, truth)
    reference, missing = torch.as_tensor(reference).to(truth), truth.isnan()

    def distance(values: Tensor, point: Tensor, gaps: Tensor) -> Tensor:
        return torch.where(gaps, 0.0, values - point).flatten(-2).norm(dim=-1)[..., None, None]

    there = distance(truth, reference, missing).masked_fill(missing.all(-1, True).all(-2, True), torch.nan)
    return pit_histogram(distance(samples, reference.unsqueeze(-3), missing.unsqueeze(-3)), there, bins)


def coverage(samples: Array, truth: Array, level: float) -> Tensor:
    """Share of the numbers of the truth that lie in the central interval of K samples: `level` if calibrated.

    That is where the PIT is between (1 - level) / 2 and (1 + level) / 2. With h = (K + 1) (1 - level) / 2, the interval
    of a whole h runs from the h-th smallest sample to the h-th largest one, which hold a truth that is exchangeable
    with them with probability 1 - 2 h / (K + 1), exactly. Otherwise a truth in the gap of samples that h falls into
    counts as the part of the gap, by its rank, that lies inside: as with an interval whose ends are drawn from the two
    samples so that their mean ranks are h. A truth with ties counts as the part of its ranks that lies inside, so that
    coverage is `level` of discrete data, too. (Intervals with all their ties hold more.)

    Below h = 1, which is K < 2 / (1 - level) - 1, the interval reaches beyond all samples for a part 1 - h of the time:
    its mean is still `level` of calibrated forecasts, but it says less of others, and with K = 1 nothing.

    Args:
        samples: `(..., K, T, D)`.
        truth: `(..., T, D)`.
        level: between 0 and 1.

    Returns:
        `(...)`, in double precision.

    Raises:
        ValueError: a level that is not between 0 and 1.
    """
    samples, truth = _paired(samples, truth)
    end, count = _beyond(samples, level), samples.shape[-3] + 1
    low, ties = _places(samples, truth)
    inside = ((low + ties).clamp(max=count - end) - low.clamp(min=end)).clamp(min=0) / ties
    return mean_of_known(inside, (-2, -1))


def interval_width(samples: Array, level: float) -> Tensor:
    """Width of the central interval of `coverage`, averaged over frames and coordinates: sharpness.

    From the h-th smallest to the h-th largest of K samples, linear between them where h is not whole, and from the
    smallest to the largest one below h = 1.

    Args:
        samples: `(..., K, T, D)`; places where they are NaN do not count.
        level: between 0 and 1.

    Returns:
        `(...)`, in the unit of the data.

    Raises:
        ValueError: a level that is not between 0 and 1.
    """
    samples = _samples(samples)
    end = max(_beyond(samples, level), 1.0) - 1  # from 0
    first, ordered = int(end), samples.sort(-3).values
    spread = ordered.flip(-3) - ordered
    widths = spread[..., first, :, :]
    if end > first:
        widths = torch.lerp(widths, spread[..., first + 1, :, :], end - first)
    return mean_of_known(widths, (-2, -1))


def variogram_score(samples: Array, truth: Array, order: float = 0.5) -> Tensor:
    """Variogram score of the coordinates of each frame; proper, lower is better (Scheuerer and Hamill 2015).

    VS = mean over frames and coordinate pairs i < j of (|y_i - y_j|^p - mean_k v_k)^2 - var_k v_k / K, where
    v_k = |X_ki - X_kj|^p. Subtracting the variance of the mean gives the unbiased ("fair") estimate, whose expectation
    does not depend on K, and which may be negative. With K = 1 the forecast is a point mass and nothing is subtracted.
    The score sees wrong dependence between coordinates (limbs that do not move together), which moves the energy score
    little, and it does not see an offset common to all coordinates. A single coordinate has no pairs and scores 0.

    Args:
        samples: `(..., K, T, D)`.
        truth: `(..., T, D)`.
        order: the exponent p.

    Returns:
        `(...)`, in the unit of the data to the power 2 p.

    Raises:
        ValueError: an order that is not positive.
    """
    if not order > 0:
        raise ValueError(f"the order of a variogram must be positive, but is {order}")

    samples, truth = _paired(samples, truth)
    *lead, steps, size = truth.shape
    count, scores = samples.shape[-3], []
    windows = samples.reshape(-1, count, steps, size), truth.reshape(-1, steps, size)
    for x, y in zip(*(part.split(max(1, CACHED // (count * steps * size))) for part in windows), strict=True):
        seen, total = (~y.isnan()).sum(-1), y.new_zeros(len(y))  # seen by frame
        missing = bool((seen < size).any())
        # Coordinates first, so that what is subtracted lies side by side. Pairs with one of them stay in the cache,
        # where all D * D at once would not.
        x, y = (part.movedim(-1, 0).contiguous() for part in (x, y))
        for i in range(size - 1):
            forecast = (x[i + 1 :] - x[i]).abs_().pow_(order)
            actual = (y[i + 1 :] - y[i]).abs_().pow_(order)
            mean = forecast.mean(2)
            errors = (actual - mean).square_()
            if count > 1:  # `Tensor.var` takes nine times as long as all else
                errors -= forecast.sub_(mean.unsqueeze(2)).square_().sum(2) / (count * (count - 1))
            total = total + (torch.where(actual.isnan(), 0.0, errors) if missing else errors).sum((0, 2))
        scores.append(total / ((seen * (seen - 1)).sum(-1) // 2).clamp(min=1))
    return torch.cat(scores).reshape(lead)


def frechet_distance(features: Array, other: Array) -> Tensor:
    """Fréchet distance between normal fits to two sets of features: FID (Heusel et al. 2017, arXiv:1706.08500).

    See `gaussian_frechet_distance`; covariances are unbiased (divided by N - 1), in double precision. It is biased
    upward in small sets, and compares distributions: it does not see which features belong to which window.

    Args:
        features: `(N, F)`, N at least 2.
        other: `(M, F)`, M at least 2.

    Returns:
        A scalar, in the square of the features' unit.
    """
    sets = [torch.as_tensor(each).double() for each in (features, other)]
    if any(each.ndim != 2 or len(each) < 2 for each in sets) or sets[0].shape[1] != sets[1].shape[1]:
        raise ValueError(
            "the Fréchet distance needs features (N, F) and (M, F), N and M at least 2, not "
            f"{_shape(sets[0])} and {_shape(sets[1])}"
        )
    moments = [moment for each in sets for moment in (each.mean(0), each.T.cov().reshape(2 * [each.shape[1]]))]
    return gaussian_frechet_distance(*moments)


def gaussian_frechet_distance(mean: Tensor, covariance: Tensor, other_mean: Tensor, other_covariance: Tensor) -> Tensor:
    """Squared Fréchet (2-Wasserstein) distance between two normal distributions (Dowson and Landau 1982).

    |m - n|^2 + tr(C + D - 2 (C D)^1/2), where tr (C D)^1/2 is the sum of the singular values of C^1/2 D^1/2. What is
    below the rounding error of the traces is 0.

    Args:
        mean: `(..., F)`.
        covariance: `(..., F, F)`, symmetric and positive semidefinite.
        other_mean: like `mean`.
        other_covariance: like `covariance`.

    Returns:
        `(...)`, in the square of the unit of the means.
    """

    # A root of the eigenvalues of C^1/2 D C^1/2 would turn their rounding errors of 1e-16 into 1e-8.
    def root(matrix: Tensor) -> Tensor:
        values, vectors = torch.linalg.eigh(matrix)
        return vectors * values.clamp(min=0).sqrt()[..., None, :] @ vectors.mT

    traces = sum(matrix.diagonal(dim1=-2, dim2=-1).sum(-1) for matrix in (covariance, other_covariance))
    shared = torch.linalg.svdvals(root(covariance) @ root(other_covariance)).sum(-1)
    distance = (mean - other_mean).square().sum(-1) + traces - 2 * shared
    rounding = 4 * mean.shape[-1] * torch.finfo(mean.dtype).eps * traces
    return torch.where(distance > rounding, distance, 0.0)


def frechet_pseudo_values(real: Tensor, generated: Tensor, places: Tensor) -> tuple[float, ...]:
    """The Fréchet distance between features of true and generated windows, as a jackknife pseudo-value of each clip.

    See `_pseudo_values`.

    Args:
        real: `(N, F)`, of the true futures.
        generated: `(N, K, F)`, of the generated ones.
        places: `(N,)`, the clip of every window, from 0 to C - 1.
    """
    centre = real.mean(0)  # far from 0, second moments would cancel
    sets = _moments_without_clips(real[:, None] - centre, places), _moments_without_clips(generated - centre, places)
    distance = gaussian_frechet_distance(*sets[0], *sets[1])
    return _pseudo_values(distance[0], distance[1:], places)


def motion_pseudo_values(motion: Tensor, real: Tensor, classes: Tensor, places: Tensor) -> tuple[float, ...]:
    """The CMD of a set of windows, as a jackknife pseudo-value of each clip (see `_pseudo_values`).

    It is computed for each class of motion, and averaged with the classes' shares of the windows.

    Args:
        motion: `(N, T - 1)`, what joints move by in the forecasts of each window; NaN where that cannot be compared. A
            step of which no window tells counts as one at the true pace.
        real: `(N,)`, and in its true future, over all frames.
        classes: `(N,)`, whole numbers.
        places: `(N,)`, the clip of every window, from 0 to C - 1.
    """

    def distance(kept: Tensor) -> Tensor:
        groups = [kept & (classes == number) for number in classes[kept].unique()]
        paces = [(rows.sum(), mean_of_known(motion[rows], 0), mean_of_known(real[rows], 0)) for rows in groups]
        found = [n * cumulative_motion_distance(steps.where(~steps.isnan(), pace), pace) for n, steps, pace in paces]
        return torch.stack(found).sum() / kept.sum()

    clips = range(int(places.max()) + 1)
    without = [distance(places != clip) for clip in clips] if len(clips) > 1 else []
    return _pseudo_values(distance(places >= 0), torch.stack(without) if without else places.new_empty(0), places)


def _pseudo_values(whole: Tensor, without: Tensor, places: Tensor) -> tuple[float, ...]:
    """A distance of a whole set of windows as a jackknife pseudo-value of each clip.

    d + (1/w - 1) (d - d'), d' the distance without the clip and w the clip's share of the windows (Busing, Meijer and
    van der Leeden 1999), moved by one constant so that their mean over windows is the distance as it is defined: the
    mean of plain pseudo-values is one that is corrected for bias. Of a mean over windows, pseudo-values are the means
    of the clips, so that the errors of both kinds of scores come from these alike.

    Args:
        whole: d.
        without: `(C,)`, d' of each of C > 1 clips.
        places: `(N,)`, the clip of every window.
    """
    shares = places.bincount().double() / len(places)
    pseudo = whole + (1 / shares - 1) * (whole - (without if len(shares) > 1 else whole))
    return tuple((pseudo - (shares * pseudo).sum() + whole).tolist())


def _moments_without_clips(features: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
    """Means (1 + C, F) and covariances (1 + C, F, F) of (N, K, F), of all windows and without each of C > 1 clips."""

    def sums(values: Tensor) -> Tensor:
        by_clip = values.new_zeros(int(places.max()) + 1, *values.shape[1:]).index_add_(0, places, values)
        whole = by_clip.sum(0, keepdim=True)
        return torch.cat([whole, whole - by_clip]) if len(by_clip) > 1 else whole

    count = sums(features.new_full((len(features), 1), features.shape[1]))
    mean = sums(features.sum(1)) / count
    squares = sums(features.mT @ features)
    return mean, (squares - count[..., None] * mean[:, :, None] * mean[:, None]) / (count[..., None] - 1)


CACHED = 2**17
"""Numbers that a processor's cache holds."""


def _places(samples: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """(..., T, D), how many samples are below the truth, and in how many ranks it may be: one, and one for each tie."""
    actual = truth.unsqueeze(-3)
    low, equal = (compared.sum(-3).double() for compared in (samples < actual, samples == actual))
    return low.masked_fill(truth.isnan(), torch.nan), equal + 1


def _beyond(samples: Tensor, level: float) -> float:
    """How many of the K + 1 ranks lie on either side of a central interval."""
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval is between 0 and 1, got {level}")
    found = (samples.shape[-3] + 1) * (1 - level) / 2  # of .9 and K = 19 not quite 1
    return float(round(found)) if math.isclose(found, round(found)) else found


def _observed(score: Callable[[Tensor, Tensor], Tensor]) -> Callable[[Tensor, Tensor], Tensor]:
    """A score of distances over what there is of a truth (T, D): frames that have something, 0 where they have not."""

    def counted(samples: Tensor, truth: Tensor) -> Tensor:
        missing = truth.isnan()
        if missing.any():
            told = ~missing.all(-1)
            samples, truth = (torch.where(missing, 0.0, values)[..., told, :] for values in (samples, truth))
        return score(samples, truth)

    return counted


def _displacement(samples: Tensor, truth: Tensor) -> Tensor:
    return torch.linalg.vector_norm(samples - truth, dim=-1)


def _pairwise(samples: Tensor) -> Tensor:
    """Mean distance over pairs of (K, T, D), each a vector of T * D numbers."""
    rows = samples.flatten(1)
    if rows.isnan().any():  # the mean square of what both have stands for all; NaN where no two share anything
        apart = [(rows[k + 1 :] - row).square().nanmean(1) for k, row in enumerate(rows[:-1])]
        return (rows.shape[1] * torch.cat(apart)).sqrt().nanmean()
    return torch.pdist(rows).mean() if len(rows) > 1 else samples.new_zeros(())


def _cross(samples: Tensor, truths: Tensor) -> Tensor:
    """Displacement of each of (K, T, D) from each of (M, T, D), averaged over frames, and at the last: (2, K, M)."""

    def both(apart: Tensor) -> Tensor:
        return torch.stack([apart.mean(0), apart[-1]])

    centre = truths.mean(0)
    if centre.isnan().any():
        each = _observed(lambda x, y: both(_displacement(x, y).T))
        return torch.stack([each(samples, truth) for truth in truths], -1)
    # |x - y|^2 as products, as cdist has it but for its copies; about the centre the cancellation is harmless.
    x, y = ((frames - centre).transpose(0, 1) for frames in (samples, truths))
    squares = x.square().sum(-1)[:, :, None] + y.square().sum(-1)[:, None]
    return both(squares.baddbmm_(x, y.mT, alpha=-2).clamp_(min=0).sqrt_())


def _median(errors: Tensor, dim: int = 0) -> Tensor:
    return errors.quantile(0.5, dim=dim)


def _per_window(score: Callable[..., Tensor], samples: Tensor, *truth: Tensor) -> Tensor:
    lead = samples.shape[:-3]
    windows = [part.reshape(-1, *part.shape[len(lead) :]) for part in (samples, *truth)]
    found = torch.stack([score(*window) for window in zip(*windows, strict=True)])
    return found.reshape((*lead, *found.shape[1:]))


def _samples(samples: Array) -> Tensor:
    samples = torch.as_tensor(samples)
    if samples.ndim < 3:
        raise ValueError(
            f"samples must be (..., K, T, D), but have shape {_shape(samples)}; "
            "one forecast (T, D) needs an axis for K = 1"
        )
    if not samples.numel():
        raise ValueError(f"there is nothing to score: samples (..., K, T, D) have shape {_shape(samples)}")
    return samples if samples.is_floating_point() else samples.double()


def _paired(samples: Array, truth: Array) -> tuple[Tensor, Tensor]:
    samples = _samples(samples)
    truth = torch.as_tensor(truth, device=samples.device)
    expected = samples.shape[:-3] + samples.shape[-2:]
    if truth.shape != expected:
        raise ValueError(
            f"samples (..., K, T, D) of shape {_shape(samples)} need a truth (..., T, D) of shape "
            f"{tuple(expected)}, not {_shape(truth)}; a model's forecasts (K, B, T, D) need "
            "samples.movedim(0, 1) first"
        )
    return _same_type(samples, truth)


def _multimodal(samples: Array, truths: Array) -> tuple[Tensor, Tensor]:
    samples = _samples(samples)
    truths = torch.as_tensor(truths, device=samples.device)
    without_count = truths.shape[:-3] + truths.shape[-2:]
    if truths.ndim < 3 or without_count != samples.shape[:-3] + samples.shape[-2:] or not truths.numel():
        raise ValueError(
            f"samples (..., K, T, D) of shape {_shape(samples)} need truths (..., M, T, D) that differ "
            f"from them in M alone, M at least 1, not {_shape(truths)}"
        )
    return _same_type(samples, truths)


def _same_type(samples: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    dtype = torch.promote_types(samples.dtype, truth.dtype)
    return samples.to(dtype), truth.to(dtype)


def _shape(array: Tensor) -> tuple[int, ...]:
    return tuple(array.shape)
