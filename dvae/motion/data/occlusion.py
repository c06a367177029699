"""Occlusion: remove joints from motion, as if a camera did not see them, to measure how well models impute them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .clips import MotionSet


def occlude(motion: MotionSet, share: float = 0.2, length: float = 15.0, seed: int = 0) -> MotionSet:
    """Return the same motion with some joints missing, in bursts.

    Every joint of every clip except the root is missing or observed according to its own Markov chain (Gilbert, 1960).
    A burst continues from one frame to the next with probability 1 - 1 / length, so its length is geometric. Bursts
    begin with the probability that makes `share` the expected proportion of missing frames, from the first frame on.
    The root is never missing, because all positions relative to it would then be missing too.

    Args:
        motion: clips.
        share: expected proportion of frames in which a joint is missing.
        length: expected length of a burst in frames.
        seed: seed of the draws; each clip also uses its index in the set.

    Raises:
        ValueError: `share` is not in [0, 1), `length` is below 1, or the bursts are too short to reach the share.
    """
    begin = share / (1 - share) / length if 0 <= share < 1 <= length else np.nan
    if not 0 <= begin <= 1:
        raise ValueError(
            "`share` must be at least 0 and below 1, and `length` at least max(1, share / (1 - share)) frames; got "
            f"share={share} and length={length}"
        )

    clips, root = [], motion.skeleton.root
    for index, clip in enumerate(motion):
        draws = np.random.default_rng((seed, index)).random((clip.frames, motion.skeleton.joints))
        hidden = np.empty(draws.shape, dtype=bool)
        hidden[0] = draws[0] < share
        for t in range(1, clip.frames):
            hidden[t] = draws[t] < np.where(hidden[t - 1], 1 - 1 / length, begin)
        hidden[:, root] = False
        clips.append(replace(clip, positions=np.where(hidden[..., None], np.float32(np.nan), clip.positions)))
    return replace(motion, clips=clips, missing=True)
