"""Dynamic time warping of frames onto a reference, given how far each frame is from each of the reference's.

Sakoe and Chiba (1978), *Dynamic programming algorithm optimization for spoken word recognition*; and, for where in a
longer sequence a reference is found, Müller (2007), *Information Retrieval for Music and Motion*, chapter 4. Both here
run over whole rows or diagonals of all subsequences at once.
"""

from __future__ import annotations

import numpy as np


def subsequence_costs(local: np.ndarray, longest: int) -> np.ndarray:
    """What it costs to warp each subsequence onto the whole reference.

    A path goes from the first frames of both to their last, each step one frame on in either or in both, which counts
    twice (Sakoe and Chiba's symmetric form). So weights of any path add up to the frames of both, by which the sum is
    divided: the cost is a weighted mean of local ones, in their unit, and those of short and long subsequences compare.

    Args:
        local: (M, F), from each frame of the reference to each of the sequence.
        longest: K, frames that a subsequence has at most.

    Returns:
        (F, K): of the subsequence of k + 1 frames from frame s on at [s, k]; infinite where the sequence ends before.

    Raises:
        ValueError: nothing to compare, or what is no number.
    """
    if local.ndim != 2 or not local.size or longest < 1:
        raise ValueError(f"local costs have shape {local.shape} for at most {longest} frames; expected (M, F), none 0")
    if np.isnan(local).any():
        raise ValueError(f"{np.isnan(local).sum()} of the local costs are NaN; leave out frames that lack joints")
    (rows, frames), steps = local.shape, local.shape[0] + longest - 1
    # Cell (i, k) of start s lies on diagonal d = i + k; there, local[i, s + k] is ahead[i, s + d].
    ahead = np.full((rows, frames + steps), np.inf)
    for i in range(rows):
        ahead[i, i : i + frames] = local[i]
    found = np.full((frames, longest), np.inf)
    before, last, now = (np.full((rows + 1, frames), np.inf) for _ in range(3))  # row 0 is before the reference
    for d in range(steps):
        lo, hi = max(0, d - longest + 1), min(rows, d + 1)
        cost = ahead[lo:hi, d : d + frames]
        if d == 0:
            now[1] = 2 * cost[0]
        else:
            either = np.minimum(last[lo:hi], last[lo + 1 : hi + 1])
            now[lo + 1 : hi + 1] = np.minimum(either, before[lo:hi] + cost) + cost
        if d >= rows - 1:
            found[:, d - rows + 1] = now[rows]
        before, last, now = last, now, before
    found /= rows + 1 + np.arange(longest)
    return found


def alignment(local: np.ndarray) -> tuple[np.ndarray, float]:
    """Where in a sequence each frame of a reference is, at a pace from half to twice the reference's.

    Steps are one frame on in both, or one in one and two in the other; the ends of both meet.

    Args:
        local: (M, F), with F between M / 2 and 2 M.

    Returns:
        places (M,) in frames of the sequence, increasing, and the mean local cost on the path.

    Raises:
        ValueError: one is more than twice as long as the other.
    """
    rows, frames = local.shape
    if not (rows - 1) / 2 <= frames - 1 <= 2 * (rows - 1):
        raise ValueError(f"{frames} frames cannot be warped onto {rows} at a pace from half to twice theirs")
    steps = ((1, 1), (1, 2), (2, 1))
    total = np.full((rows + 2, frames + 2), np.inf)  # two rows and columns before the first
    total[2, 2] = local[0, 0]
    chosen = np.zeros((rows, frames), int)
    for i in range(1, rows):
        ways = [total[i + 2 - di, 2 - dj : frames + 2 - dj] + local[i] * max(di, dj) for di, dj in steps]
        chosen[i] = np.argmin(ways, axis=0)
        total[i + 2, 2:] = np.min(ways, axis=0)
    path = [(rows - 1, frames - 1)]
    while path[-1] != (0, 0):
        (i, j), (di, dj) = path[-1], steps[chosen[path[-1]]]
        path.append((i - di, j - dj))
    at, places = np.array(path[::-1]).T
    return np.interp(np.arange(rows), at, places), float(local[at, places].mean())
