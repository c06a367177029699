"""Occlusion: motion that lacks joints, as where a camera does not see them, to learn how well gaps are filled."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .clips import MotionSet


def occlude(motion: MotionSet, share: float = 0.2, length: float = 15.0, seed: int = 0) -> MotionSet:
    """The same motion without some of its joints, in bursts.

    Every joint of every clip but the root is missing or there by a Markov chain of its own (the law of Gilbert, 1960):
    a burst goes on with probability 1 - 1 / length from one frame to the next, so that its length is geometric, and
    begins so often that a joint is missing in this share of the frames, the first one included. The root is there: what
    is relative to it would be missing with it.

    Args:
        motion: the clips.
        share: of the frames, in which a joint is missing in expectation.
        length: frames of a burst, in expectation.
        seed: of the draws; a clip's are of its place in the set.

    Raises:
        ValueError: a share that is not in [0, 1), or a length below 1 or so short that the bursts cannot make it up.
    """
    begin = share / (1 - share) / length if 0 <= share < 1 <= length else np.nan
    if not 0 <= begin <= 1:
        raise ValueError(
            "expected a share from 0 to below 1 and bursts of at least max(1, share / (1 - share)) frames, got "
            f"{share} and {length}"
        )

    clips, root = [], motion.skeleton.root
    for place, clip in enumerate(motion):
        draws = np.random.default_rng((seed, place)).random((clip.frames, motion.skeleton.joints))
        hidden = np.empty(draws.shape, dtype=bool)
        hidden[0] = draws[0] < share
        for t in range(1, clip.frames):
            hidden[t] = draws[t] < np.where(hidden[t - 1], 1 - 1 / length, begin)
        hidden[:, root] = False
        clips.append(replace(clip, positions=np.where(hidden[..., None], np.float32(np.nan), clip.positions)))
    return replace(motion, clips=clips, missing=True)
