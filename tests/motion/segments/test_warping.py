"""Dynamic time warping compared with the recursion of the paper."""

import numpy as np
import pytest
import torch

from dvae.motion.segments.warping import alignment, subsequence_costs


def by_recursion(local):
    """Return the cost by Sakoe and Chiba's symmetric recursion, cell by cell."""
    total = np.full(local.shape, np.inf)
    total[0, 0] = 2 * local[0, 0]
    for i, j in np.ndindex(*local.shape):
        ways = [(total[i - 1, j], 1)] * (i > 0) + [(total[i, j - 1], 1)] * (j > 0)
        ways += [(total[i - 1, j - 1], 2)] * (i > 0 and j > 0)
        if ways:
            total[i, j] = min(before + weight * local[i, j] for before, weight in ways)
    return total[-1, -1] / sum(local.shape)


@pytest.mark.parametrize(("rows", "frames", "longest"), [(5, 12, 7), (1, 6, 3), (6, 3, 9)])
def test_costs_of_all_subsequences_equal_the_recursion(rows, frames, longest):
    local = torch.rand(rows, frames).double().numpy()
    costs = subsequence_costs(local, longest)
    assert costs.shape == (frames, longest)
    for start, more in np.ndindex(frames, longest):
        if start + more < frames:
            np.testing.assert_allclose(costs[start, more], by_recursion(local[:, start : start + more + 1]), rtol=1e-12)
        else:
            assert costs[start, more] == np.inf


def test_a_pace_within_the_limits_is_recovered():
    time = np.linspace(0, 1, 60)
    pace = time + 0.08 * np.sin(2 * np.pi * time)  # from .5 to 1.5
    local = np.abs(time[:, None] - pace)
    places, cost = alignment(local)
    assert (np.diff(places) > 0).all()
    assert cost < 0.01
    np.testing.assert_allclose(np.interp(places, np.arange(60), pace), time, atol=2 / 60)
    places, _ = alignment(torch.rand(40, 55).numpy())  # monotone paths from end to end with a slope of at most two
    assert (places[0], places[-1]) == (0, 54)
    assert (np.diff(places) >= 0.5).all()
    assert (np.diff(places) <= 2).all()


def test_sequences_that_cannot_be_warped_are_errors():
    with pytest.raises(ValueError, match="expected \\(M, F\\) without empty axes"):
        subsequence_costs(np.zeros((0, 4)), 3)
    with pytest.raises(ValueError, match="remove frames with missing joints"):
        subsequence_costs(np.full((2, 4), np.nan), 3)
    with pytest.raises(ValueError, match="cannot be aligned with a reference of 4 frames"):
        alignment(np.zeros((4, 20)))
