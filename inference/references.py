"""References for forecasts of any sequences: what needs no model, and which other futures were possible."""

import torch
from torch import Tensor

from ..data import Batch, HeldOutWindows, bridged, mask_of

_EXACT = "donot_use_mm_for_euclid_dist"


def multimodal_truths(windows: HeldOutWindows, threshold: float | None = None, itself: bool = True) -> list[Tensor]:
    """Multimodal ground truth: for every window, those that were in almost the same pose when their future began.

    Two windows belong together when their last observed poses are at a Euclidean distance *below* the threshold, over
    all coordinates; where some are missing, see `distances`. By default as in the evaluation of DLow (Yuan and Kitani
    2020): a window belongs to itself, and one that nobody joins keeps its single truth and is scored like the others,
    as every evaluation here does. (GSPS leaves such windows out of every metric, so that its published numbers are on a
    subset.)

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
    poses, seen = last_places(windows.all(), observed)
    poses = poses.double()
    found: list[Tensor] = []
    for rows in torch.arange(len(poses)).split(512):
        close = distances(poses[rows], poses, None if seen is None else seen[rows], seen) < threshold
        close[torch.arange(len(rows)), rows] = itself
        found += [row.nonzero()[:, 0] for row in close]
    return found


def multimodal_note(threshold: float, itself: bool, alone: int, windows: int) -> str:
    """How multimodal errors are to be read, for the caption of a table."""
    closer = f"all windows whose last poses are closer than {threshold:g} m{', itself included' if itself else ''}"
    return f"MM: over the futures of {closer}; {alone} of {windows} have no other"


def last_places(batch: Batch, observed: int) -> tuple[Tensor, Tensor | None]:
    """The last observed pose `(B, D)`, and which of its coordinates were observed at all, None for all of them.

    Where a coordinate is missing in the last frame it is where it was last, and 0 if it was nowhere.

    Args:
        batch: x `(B, T, D)`, with or without a mask of it.
        observed: O.
    """
    x, mask = batch["x"][:, :observed], mask_of(batch)
    if mask is None:
        return x[:, -1], None
    mask = mask[:, :observed]
    return bridged(x, mask)[:, -1], mask.any(1)


def distances(first: Tensor, second: Tensor, seen: Tensor | None = None, also: Tensor | None = None) -> Tensor:
    """Euclidean distances `(N, M)` of `(N, D)` and `(M, D)`.

    Where coordinates are missing, the mean square over those that both have stands for all of them; two that share none
    are infinitely far apart.

    Args:
        first, second: the points, anything where a coordinate is missing.
        seen, also: `(N, D)` and `(M, D)`, True where the coordinates of each were observed; None for all.
    """
    if seen is None and also is None:
        # Matrix-product distances would lose what tells poses apart that lie far from the origin, or at a threshold.
        return torch.cdist(first, second, compute_mode=_EXACT)
    here = torch.ones_like(first, dtype=torch.bool) if seen is None else seen
    there = torch.ones_like(second, dtype=torch.bool) if also is None else also
    ours, theirs = here.to(first), there.to(second)
    centre = (torch.where(there, second, 0.0).sum(0) / theirs.sum(0).clamp(min=1)).double()  # or digits cancel
    a, b = (torch.where(m, x.double() - centre, 0.0) for m, x in ((here, first), (there, second)))
    ours, theirs = ours.double(), theirs.double()
    shared = ours @ theirs.T
    squares = a.square() @ theirs.T + ours @ b.square().T - 2 * a @ b.T
    found = (squares.clamp(min=0) * (first.shape[-1] / shared)).sqrt()
    return torch.where(shared > 0, found, torch.inf).to(first)


def zero_velocity(observed: Tensor, horizon: int, mask: Tensor | None = None) -> Tensor:
    """The last pose repeated: the forecast that any method should beat.

    Args:
        observed: `(B, O, D)`.
        horizon: frames H to predict.
        mask: `(B, O, D)`, True where a coordinate was observed; one that is missing in the last frame is where it was
            last.

    Returns:
        One forecast, `(1, B, H, D)`, laid out like those of a model.
    """
    return bridged(observed, mask)[None, :, -1:].expand(-1, -1, horizon, -1)


def nearest_neighbours(
    observed: Tensor,
    training: Tensor,
    samples: int = 50,
    mask: Tensor | None = None,
    training_mask: Tensor | None = None,
) -> Tensor:
    """The futures of the training windows whose last observed poses are closest: memory without a model.

    Args:
        observed: `(B, O, D)`.
        training: `(N, O + H, D)`, training windows observed for as many frames.
        samples: K, the number of neighbours.
        mask, training_mask: of both, True where a coordinate was observed. Poses are those of `last_places`, and the
            gaps of futures are bridged.

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
    here = last_places({"x": observed} | ({} if mask is None else {"mask": mask}), frames)
    there = last_places({"x": training} | ({} if training_mask is None else {"mask": training_mask}), frames)
    nearest = distances(here[0], there[0], here[1], there[1]).topk(samples, largest=False).indices
    return bridged(training, training_mask)[nearest.T, frames:]
