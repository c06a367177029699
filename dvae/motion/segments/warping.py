"""Dynamic time warping of frames onto a reference, from the local cost of each pair of frames.

Sakoe and Chiba (1978), *Dynamic programming algorithm optimization for spoken word recognition*. For the search for a
reference in a longer sequence: Müller (2007), *Information Retrieval for Music and Motion*, chapter 4. Both are
vectorised over whole rows or diagonals of all subsequences.
"""

from __future__ import annotations

import numpy as np


def subsequence_costs(local: np.ndarray, longest: int) -> np.ndarray:
    """Return the cost of warping each subsequence onto the whole reference.

    A path goes from the first frames of both to their last frames. Each step advances by one frame in one or in both;
    advancing in both counts twice (Sakoe and Chiba's symmetric form). The weights of any path therefore add up to the
    number of frames of both, and the sum is divided by this number. The cost is a weighted mean of local costs in their
    unit, so short and long subsequences are comparable.

    Args:
        local: (M, F), cost of each frame of the reference at each frame of the sequence.
        longest: K, maximum number of frames in a subsequence.

    Returns:
        (F, K): at [s, k], the cost of the subsequence of k + 1 frames that starts at frame s; infinite if the sequence
        ends earlier.

    Raises:
        ValueError: the costs are empty or NaN, or `longest` is below 1.
    """
    if local.ndim != 2 or not local.size or longest < 1:
        raise ValueError(
            f"`local` has shape {local.shape} and `longest` is {longest}; expected (M, F) without empty axes, and at "
            "least 1"
        )
    if np.isnan(local).any():
        raise ValueError(f"{np.isnan(local).sum()} of the local costs are NaN; remove frames with missing joints")
    (rows, frames), steps = local.shape, local.shape[0] + longest - 1
    # Cell (i, k) of start s is on diagonal d = i + k, where local[i, s + k] is ahead[i, s + d].
    ahead = np.full((rows, frames + steps), np.inf)
    for i in range(rows):
        ahead[i, i : i + frames] = local[i]
    costs = np.full((frames, longest), np.inf)
    before, last, now = (np.full((rows + 1, frames), np.inf) for _ in range(3))  # row 0 precedes the reference
    for d in range(steps):
        lo, hi = max(0, d - longest + 1), min(rows, d + 1)
        cost = ahead[lo:hi, d : d + frames]
        if d == 0:
            now[1] = 2 * cost[0]
        else:
            either = np.minimum(last[lo:hi], last[lo + 1 : hi + 1])
            now[lo + 1 : hi + 1] = np.minimum(either, before[lo:hi] + cost) + cost
        if d >= rows - 1:
            costs[:, d - rows + 1] = now[rows]
        before, last, now = last, now, before
    costs /= rows + 1 + np.arange(longest)
    return costs


def alignment(local: np.ndarray) -> tuple[np.ndarray, float]:
    """Align a sequence with a reference, at a pace from half to twice the pace of the reference.

    A step of the path advances by one frame in both, or by one frame in one and by two in the other. First frames are
    matched, and so are last frames.

    Args:
        local: (M, F), cost of each frame of the reference at each frame of the sequence; (M - 1) / 2 <= F - 1 <=
            2 (M - 1).

    Returns:
        Frame numbers (M,) of the sequence that are aligned with the frames of the reference, increasing; and the mean
        local cost on the path.

    Raises:
        ValueError: sequence or reference is more than twice as long as the other.
    """
    rows, frames = local.shape
    if not (rows - 1) / 2 <= frames - 1 <= 2 * (rows - 1):
        raise ValueError(
            f"a sequence of {frames} frames cannot be aligned with a reference of {rows} frames: one would have to be "
            "more than twice as fast as the other; resample the sequence"
        )
    steps = ((1, 1), (1, 2), (2, 1))
    total = np.full((rows + 2, frames + 2), np.inf)  # two rows and columns before the first
    total[2, 2] = local[0, 0]
    best_steps = np.zeros((rows, frames), int)
    for i in range(1, rows):
        totals = [total[i + 2 - di, 2 - dj : frames + 2 - dj] + local[i] * max(di, dj) for di, dj in steps]
        best_steps[i] = np.argmin(totals, axis=0)
        total[i + 2, 2:] = np.min(totals, axis=0)
    path = [(rows - 1, frames - 1)]
    while path[-1] != (0, 0):
        (i, j), (di, dj) = path[-1], steps[best_steps[path[-1]]]
        path.append((i - di, j - dj))
    rows_on_path, columns = np.array(path[::-1]).T
    return np.interp(np.arange(rows), rows_on_path, columns), float(local[rows_on_path, columns].mean())
