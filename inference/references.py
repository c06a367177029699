"""References for forecasts of any sequences: what needs no model, and which other futures were possible."""

import torch
from torch import Tensor

from ..data import HeldOutWindows

_EXACT = "donot_use_mm_for_euclid_dist"


def multimodal_truths(windows: HeldOutWindows, threshold: float | None = None, itself: bool = True) -> list[Tensor]:
    """Multimodal ground truth: for every window, those that were in almost the same pose when their future began.

    Two windows belong together when their last observed poses are at a Euclidean distance *below* the threshold, over
    all coordinates. By default as in the evaluation of DLow (Yuan and Kitani 2020): a window belongs to itself, and one
    that nobody joins keeps its single truth and is scored like the others, as every evaluation here does. (GSPS leaves
    such windows out of every metric, so that its published numbers are on a subset.)

    Args:
        windows: N windows; the protocol says what is observed.
        threshold: largest distance (exclusive), in the unit of the data; by default the protocol's, 0.5 m in the
            papers.
        itself: whether a window is among its own truths. Without, it may have none, and its multimodal errors are
            undefined.

    Returns:
        N index tensors `(M_n,)`, ascending; `futures[truths[n]]` are the truths `(M_n, T, D)` of window n.

    Raises:
        ValueError: a threshold that is not positive.
    """
    observed = windows.protocol.observed
    threshold = windows.protocol.multimodal_threshold if threshold is None else threshold
    if not threshold > 0:
        raise ValueError(f"the multimodal threshold is a distance and must be positive, but is {threshold}")
    poses = windows.all()["x"][:, observed - 1].double()
    found: list[Tensor] = []
    for rows in torch.arange(len(poses)).split(512):
        # Matrix-product distances would cancel right at the threshold, where the comparison is strict.
        close = torch.cdist(poses[rows], poses, compute_mode=_EXACT) < threshold
        close[torch.arange(len(rows)), rows] = itself
        found += [row.nonzero()[:, 0] for row in close]
    return found


def multimodal_note(threshold: float, itself: bool, alone: int, windows: int) -> str:
    """How multimodal errors are to be read, for the caption of a table."""
    closer = f"all windows whose last poses are closer than {threshold:g} m{', itself included' if itself else ''}"
    return f"MM: over the futures of {closer}; {alone} of {windows} have no other"


def zero_velocity(observed: Tensor, horizon: int) -> Tensor:
    """The last pose repeated: the forecast that any method should beat.

    Args:
        observed: `(B, O, D)`.
        horizon: frames H to predict.

    Returns:
        One forecast, `(1, B, H, D)`, laid out like those of a model.
    """
    return observed[None, :, -1:].expand(-1, -1, horizon, -1)


def nearest_neighbours(observed: Tensor, training: Tensor, samples: int = 50) -> Tensor:
    """The futures of the training windows whose last observed poses are closest: memory without a model.

    Args:
        observed: `(B, O, D)`.
        training: `(N, O + H, D)`, training windows observed for as many frames.
        samples: K, the number of neighbours.

    Returns:
        `(K, B, H, D)`, the closest neighbour first.

    Raises:
        ValueError: training windows of another size or without a future, or fewer of them than K.
    """
    frames, size = observed.shape[1:]
    if training.ndim != 3 or training.shape[2] != size or training.shape[1] <= frames:
        raise ValueError(
            f"training windows must be (N, T, {size}) with T above the {frames} observed frames, but have "
            f"shape {tuple(training.shape)}"
        )
    if len(training) < samples:
        raise ValueError(f"{samples} neighbours were asked of {len(training)} training windows; use fewer")
    # Matrix-product distances would lose what tells poses apart that lie far from the origin.
    distances = torch.cdist(observed[:, -1], training[:, frames - 1], compute_mode=_EXACT)
    return training[distances.topk(samples, largest=False).indices.T, frames:]
