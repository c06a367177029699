"""Short windows of simulated motion for methods on quaternions."""

from dataclasses import replace

import pytest

from dvae import motion


@pytest.fixture(scope="session")
def quaternions():
    """Return windows of 5 + 7 frames of quaternions, by split ("train" and "test")."""
    changes = {"observed": 5, "predicted": 7, "train_stride": 3, "test_stride": 6, "representation": "quaternion"}
    people = motion.simulate(clips=8, frames=40, test=0.3)
    protocol = replace(motion.PROTOCOLS["simulated"], **changes)
    return {split: motion.windows(people, protocol, split) for split in ("train", "test")}
