"""Errors of forecast motion, as pure functions on arrays.

The errors follow the evaluation code of DLow (Yuan and Kitani 2020, arXiv:2003.08386) and GSPS (Mao, Liu and Salzmann
2021, arXiv:2108.08422); the median versions follow HiT-DVAE (Bie et al. 2022, arXiv:2204.01565). They reward the best
(or the median) of K samples and are not proper: a forecaster gains by spreading its samples. APDE and CMD follow
BeLFusion (Barquero, Escalera and Palmero 2023, arXiv:2211.14304); they require as much diversity and motion as real
futures have.

Shapes are the same as in `dvae.inference.evaluation.metrics`; truths are `(..., M, T, D)` if M futures are admissible.
A displacement is the Euclidean norm over *all* D coordinates of a frame, in the unit of the data (metres). It is not a
mean over joints. If the last frame of a truth was not observed, the final error uses the last observed frame.
"""

import torch
from torch import Tensor

from ...data.batch import Batch
from ...data.sequences import HeldOutWindows, mean_of_known
from ...inference.evaluation.metrics import (
    Array,
    as_pair,
    as_same_type,
    as_samples,
    displacement,
    jackknife_pseudo_values,
    mean_pairwise_distance,
    over_observed,
    per_window,
    shape_of,
)
from ...inference.evaluation.references import distances, last_places
from ..data.protocols import Windows


def average_displacement_error(samples: Array, truth: Array) -> Tensor:
    """Return the ADE: the displacement averaged over the T frames, of the best of the K samples.

    Args:
        samples: `(..., K, T, D)`.
        truth: `(..., T, D)`.

    Returns:
        `(...)`, in the unit of the data.
    """
    return per_window(over_observed(lambda x, y: displacement(x, y).mean(-1).amin()), *as_pair(samples, truth))


def final_displacement_error(samples: Array, truth: Array) -> Tensor:
    """Return the FDE: the displacement at the last frame, of the sample that is best there. Shapes as in ADE."""
    return per_window(over_observed(lambda x, y: displacement(x[:, -1], y[-1]).amin()), *as_pair(samples, truth))


def median_average_displacement_error(samples: Array, truth: Array) -> Tensor:
    """Return the ADEm: the median over the K samples of the mean displacement (even K: mean of the middle two)."""
    return per_window(over_observed(lambda x, y: _median(displacement(x, y).mean(-1))), *as_pair(samples, truth))


def median_final_displacement_error(samples: Array, truth: Array) -> Tensor:
    """Return the FDEm: the median over the K samples of the final displacement (even K: mean of the middle two)."""
    return per_window(over_observed(lambda x, y: _median(displacement(x[:, -1], y[-1]))), *as_pair(samples, truth))


def multimodal_truths(windows: HeldOutWindows, threshold: float = 0.5, itself: bool = True) -> list[Tensor]:
    """Return the multimodal ground truth: for every window, the windows with almost the same last observed pose.

    Two windows belong together if the Euclidean distance of their last observed poses, relative to the root, is *below*
    the threshold, over all coordinates; `distances` handles missing values. The default follows the evaluation of DLow
    (Yuan and Kitani 2020): a window belongs to itself. A window without others keeps its single truth and is scored
    like all windows.
    GSPS leaves such windows out of every metric (`several_futures`), so its published numbers are on a subset.

    Args:
        windows: N windows; their protocol defines the observed frames.
        threshold: largest distance (exclusive), in the unit of the data; 0.5 m in the papers.
        itself: whether a window is among its own truths. If not, it may have no truth, and its multimodal errors are
            undefined.

    Returns:
        N index tensors `(M_n,)`, ascending; `futures[truths[n]]` are the truths `(M_n, T, D)` of window n.

    Raises:
        ValueError: the threshold is not positive.
    """
    observed = windows.protocol.observed
    if not threshold > 0:
        raise ValueError(f"the multimodal threshold must be a positive distance, got {threshold}")
    poses, known = last_places(Batch(windows.all()), observed)
    poses, skeleton = poses.double(), getattr(windows, "skeleton", None)
    if skeleton is not None and poses.shape[-1] == 3 * skeleton.joints:
        joints = poses.unflatten(-1, (-1, 3))
        poses = (joints - joints[:, skeleton.root, None]).flatten(1)
        if known is not None:
            places = known.unflatten(-1, (-1, 3))
            known = (places & places[:, skeleton.root, None]).flatten(1)
    truths: list[Tensor] = []
    for rows in torch.arange(len(poses)).split(512):
        close = distances(poses[rows], poses, None if known is None else known[rows], known) < threshold
        close[torch.arange(len(rows)), rows] = itself
        truths += [row.nonzero()[:, 0] for row in close]
    return truths


def several_futures(windows: Windows) -> Windows:
    """Return the windows whose last observed pose is shared by another window, as in GSPS's evaluation.

    All scores of `dvae.evaluate` are then of these windows only. Their multimodal ground truth does not change, because
    every window that belongs to one of them is among them. The title of a table gives their number.

    Args:
        windows: windows of the evaluation; poses closer than their protocol's `multimodal_threshold` count as shared.

    Raises:
        ValueError: no window has several futures.
    """
    threshold = windows.protocol.multimodal_threshold
    truths = multimodal_truths(windows, threshold)
    keys = [key for key, futures in zip(windows.keys, truths, strict=True) if len(futures) > 1]
    if not keys:
        raise ValueError(
            f"none of the {len(windows)} windows has several futures: no two last observed poses are closer than "
            f"{threshold:g} m; raise the protocol's multimodal_threshold"
        )
    return windows.at(keys, f"{len(keys)} of {len(windows)} windows, those with several futures")


def multimodal_note(threshold: float, itself: bool, alone: int, windows: int) -> str:
    """Return the explanation of multimodal errors for the caption of a table."""
    own = "; they include the window itself" if itself else ""
    closer = f"windows whose last observed pose is closer than {threshold:g} m{own}"
    return f"MM (multimodal): true futures are those of all {closer}; {alone} of {windows} have no other"


def multimodal_errors(samples: Array, truths: Array) -> Tensor:
    """Return MMADE, MMFDE, MMADEm and MMFDEm: errors to each of M admissible futures, averaged over these futures.

    Args:
        samples: `(..., K, T, D)`.
        truths: `(..., M, T, D)`, futures from `multimodal_truths`, including the true one.

    Returns:
        `(..., 4)`, in the unit of the data.
    """

    def errors(x: Tensor, y: Tensor) -> Tensor:
        pairwise = _cross(x, y)
        return torch.cat([pairwise.amin(1), _median(pairwise, 1)]).mean(-1)

    samples, truths = _multimodal(samples, truths)
    return per_window(errors, samples, truths)


def multimodal_average_displacement_error(samples: Array, truths: Array) -> Tensor:
    """Return the MMADE `(...)`: the ADE to each admissible future, averaged over these futures."""
    return multimodal_errors(samples, truths)[..., 0]


def multimodal_final_displacement_error(samples: Array, truths: Array) -> Tensor:
    """Return the MMFDE: the FDE to each admissible future, averaged over these futures. Shapes as in MMADE."""
    return multimodal_errors(samples, truths)[..., 1]


def median_multimodal_average_displacement_error(samples: Array, truths: Array) -> Tensor:
    """Return the MMADEm: the ADEm to each admissible future, averaged over these futures. Shapes as in MMADE."""
    return multimodal_errors(samples, truths)[..., 2]


def median_multimodal_final_displacement_error(samples: Array, truths: Array) -> Tensor:
    """Return the MMFDEm: the FDEm to each admissible future, averaged over these futures. Shapes as in MMADE."""
    return multimodal_errors(samples, truths)[..., 3]


def average_pairwise_distance_error(samples: Array, truths: Array) -> Tensor:
    """Return the APDE: |APD of the samples - APD of the M admissible futures| (BeLFusion).

    If only the true future is admissible, it has no diversity, and the value is NaN. The paper and its public code
    leave such windows out of the mean.

    Args:
        samples: `(..., K, T, D)`.
        truths: `(..., M, T, D)`, as for MMADE.

    Returns:
        `(...)`, in the unit of the data; NaN if M = 1, or if no two truths have an observed value in common.
    """

    def score(x: Tensor, y: Tensor) -> Tensor:
        return (mean_pairwise_distance(x) - mean_pairwise_distance(y)).abs() if len(y) > 1 else x.new_tensor(torch.nan)

    return per_window(score, *_multimodal(samples, truths))


def cumulative_motion_distance(motion: Array, real: Array) -> Tensor:
    """Return the CMD, the area between forecast and real cumulative motion: sum_{t=1}^{T-1} (T - t) |M_t - M|.

    M_t is the distance that joints move from frame t to t + 1 of the T predicted frames, averaged over joints, samples
    and windows. M is the mean of the true motion, over frames too. The sum equals sum_i sum_{t<=i} |M_t - M|
    (BeLFusion), so early errors count in all later frames. True motion does not have a CMD of 0, because its pace
    varies.

    Args:
        motion: `(..., T - 1)`, M_1 to M_{T-1}.
        real: `(...)`, M.

    Returns:
        `(...)`, in the unit of the data.
    """
    motion, real = torch.as_tensor(motion), torch.as_tensor(real)
    if motion.ndim != real.ndim + 1 or motion.shape[:-1] != real.shape or not motion.numel():
        raise ValueError(
            "`motion` must have shape (..., T - 1) with T at least 2, and `real` shape (...); got "
            f"{shape_of(motion)} and {shape_of(real)}"
        )
    frames = torch.arange(motion.shape[-1], 0, -1, device=motion.device)
    return (frames * (motion - real[..., None]).abs()).sum(-1)


def motion_pseudo_values(motion: Tensor, real: Tensor, classes: Tensor, places: Tensor) -> tuple[float, ...]:
    """Return the CMD of a set of windows as a jackknife pseudo-value for each clip (`jackknife_pseudo_values`).

    The CMD is computed for each class of motion, and averaged with weights proportional to the number of windows.

    Args:
        motion: `(N, T - 1)`, motion of the joints in the forecasts of each window; NaN where it cannot be compared. A
            step that is NaN in all windows counts as a step at the true pace.
        real: `(N,)`, mean motion in the true future of each window, over all frames.
        classes: `(N,)`, integer classes.
        places: `(N,)`, clip of every window, from 0 to C - 1.
    """

    def distance(included: Tensor) -> Tensor:
        groups = [included & (classes == number) for number in classes[included].unique()]
        paces = [(rows.sum(), mean_of_known(motion[rows], 0), mean_of_known(real[rows], 0)) for rows in groups]
        weighted = [n * cumulative_motion_distance(steps.where(~steps.isnan(), pace), pace) for n, steps, pace in paces]
        return torch.stack(weighted).sum() / included.sum()

    clips = range(int(places.max()) + 1)
    without = [distance(places != clip) for clip in clips] if len(clips) > 1 else []
    return jackknife_pseudo_values(
        distance(places >= 0), torch.stack(without) if without else places.new_empty(0), places
    )


def _cross(samples: Tensor, truths: Tensor) -> Tensor:
    """Return displacements between (K, T, D) and (M, T, D), averaged over frames and at the last frame: (2, K, M)."""

    def both(pairwise: Tensor) -> Tensor:
        return torch.stack([pairwise.mean(0), pairwise[-1]])

    centre = truths.mean(0)
    if centre.isnan().any():
        errors = over_observed(lambda x, y: both(displacement(x, y).T))
        return torch.stack([errors(samples, truth) for truth in truths], -1)
    # |x - y|^2 by matrix products, like cdist without its copies. Centring keeps the cancellation harmless.
    x, y = ((frames - centre).transpose(0, 1) for frames in (samples, truths))
    squares = x.square().sum(-1)[:, :, None] + y.square().sum(-1)[:, None]
    return both(squares.baddbmm_(x, y.mT, alpha=-2).clamp_(min=0).sqrt_())


def _median(errors: Tensor, dim: int = 0) -> Tensor:
    return errors.quantile(0.5, dim=dim)


def _multimodal(samples: Array, truths: Array) -> tuple[Tensor, Tensor]:
    samples = as_samples(samples)
    truths = torch.as_tensor(truths, device=samples.device)
    without_count = truths.shape[:-3] + truths.shape[-2:]
    if truths.ndim < 3 or without_count != samples.shape[:-3] + samples.shape[-2:] or not truths.numel():
        raise ValueError(
            f"samples (..., K, T, D) have shape {shape_of(samples)}; expected truths (..., M, T, D) with M at least 1 "
            f"and otherwise the same sizes, got {shape_of(truths)}"
        )
    return as_same_type(samples, truths)
