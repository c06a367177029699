"""Gaps as covariates: the time since the step before, and since an entry was last observed."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dvae.data.sequences import time_since_observed, time_since_previous


@given(st.integers(1, 3), st.integers(1, 6), st.integers(0, 100))
def test_gaps_add_up_to_the_time_since_the_start(batch, steps, seed):
    generator = torch.Generator().manual_seed(seed)
    times = torch.rand(batch, steps, generator=generator, dtype=torch.float64).add(0.01).cumsum(1) + 1e6
    lengths = torch.randint(1, steps + 1, (batch,), generator=generator)
    times[torch.arange(steps) >= lengths[:, None]] = torch.nan  # padding
    gaps = time_since_previous(times, lengths)
    assert gaps.shape == (batch, steps, 1)
    assert gaps.dtype == times.dtype
    for row, n in enumerate(lengths.tolist()):
        torch.testing.assert_close(gaps[row, :n, 0].cumsum(0), times[row, :n] - times[row, 0])
        assert not gaps[row, n:].any()
        assert (gaps[row, 1:n] > 0).all()


def test_integer_arrays_are_valid_times():
    gaps = time_since_previous(np.array([[1950, 1953, 1954]]))
    assert gaps.dtype == torch.get_default_dtype()
    assert gaps.flatten().tolist() == [0, 3, 1]


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([[0.0, 1, 2], [0, 2, 2]], "times of sequence 1 are 2, 2 at steps 1 to 2, counted from 0; .* merge values"),
        ([[0.0, float("nan"), 2]], "times of sequence 0 are 0, nan at steps 0 to 1"),
        ([0.0, 1.0], r"times must be \(sequences, steps\), but have shape \(2,\)"),
    ],
)
def test_times_that_do_not_increase_are_an_error(times, message):
    with pytest.raises(ValueError, match=message):
        time_since_previous(torch.tensor(times))


@given(st.integers(1, 3), st.integers(1, 8), st.integers(1, 3), st.integers(0, 100))
def test_the_time_since_observed_follows_its_recursion(batch, steps, size, seed):
    """delta_1 = 0; delta_t = d_t if observed at t - 1, otherwise d_t + delta_{t-1} (Che et al., 2018)."""
    generator = torch.Generator().manual_seed(seed)
    mask = torch.rand(batch, steps, size, generator=generator) < 0.5
    d = torch.rand(batch, steps, 1, generator=generator, dtype=torch.float64)
    expected = [torch.zeros(batch, size, dtype=torch.float64)]
    for t in range(1, steps):
        expected.append(d[:, t] + torch.where(mask[:, t - 1], 0.0, expected[-1]))
    torch.testing.assert_close(time_since_observed(mask, d), torch.stack(expected, 1))
    ones = torch.ones(batch, steps, 1)
    torch.testing.assert_close(time_since_observed(mask), time_since_observed(mask, ones))


def test_a_short_gap_after_a_long_one_keeps_its_precision():
    d = torch.full((1, 4, 1), 1e-3)
    d[0, 1] = 1e6
    assert time_since_observed(torch.ones(1, 4, 1, dtype=torch.bool), d)[0, 3].item() == pytest.approx(1e-3, rel=1e-6)
