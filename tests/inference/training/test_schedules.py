"""Schedules: ends, shape, JSON form, and clamping to the length of a run."""

import json
import math
import warnings
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvae.inference.training.objectives import Evidence
from dvae.inference.training.schedules import (
    Constant,
    Cosine,
    Logistic,
    Piecewise,
    Ramp,
    Saturating,
    clamp,
    from_config,
    schedule,
    to_config,
)

levels = st.floats(-10, 10).map(lambda value: round(value, 3))
ramps = st.builds(
    lambda kind, start, end, steps, delay: kind(start, end, steps, delay),
    st.sampled_from([Ramp, Cosine, Logistic, Saturating]),
    levels,
    levels,
    st.integers(1, 500),
    st.integers(0, 500),
)
points = st.lists(st.tuples(st.integers(0, 500), levels), min_size=1, max_size=5).map(
    lambda items: Piecewise(tuple(sorted(items, key=lambda item: item[0])))
)
schedules = st.one_of(st.builds(Constant, levels), ramps, points)


@given(ramps)
def test_a_ramp_reaches_both_ends_exactly_and_is_monotone(ramp):
    values = [ramp(step) for step in range(ramp.delay + ramp.steps + 2)]
    assert set(values[: ramp.delay + 1]) == {ramp.start}
    assert values[-2:] == [ramp.end, ramp.end]
    sign = 1 if ramp.end >= ramp.start else -1
    assert all(sign * (later - earlier) >= -1e-12 for earlier, later in pairwise(values))


@pytest.mark.parametrize("kind", [Ramp, Cosine, Logistic])
def test_a_ramp_is_half_way_in_the_middle(kind):
    assert kind(0.0, 2.0, steps=100, delay=10)(60) == pytest.approx(1.0)


def test_a_saturating_rise_approaches_its_end_by_a_fixed_share_per_step():
    steps, rate = 200, 0.99
    rise = Saturating(0.0, 5 * (1 - rate**steps), steps, steepness=-steps * math.log(rate))
    assert [rise(step) for step in (1, 50, 200)] == pytest.approx([5 * (1 - rate**step) for step in (1, 50, 200)])
    assert Saturating(0.0, 1.0, 100, steepness=1e-9)(25) == pytest.approx(0.25)


def test_piecewise_interpolates_its_points_and_jumps_where_two_coincide():
    cycle = Piecewise(((10, 0.0), (20, 1.0), (20, 0.0), (30, 1.0)))
    assert [cycle(step) for step in (0, 10, 15, 19, 20, 25, 30, 99)] == pytest.approx([0, 0, 0.5, 0.9, 0, 0.5, 1, 1])


@given(schedules)
def test_json_round_trip(value):
    assert from_config(json.loads(json.dumps(to_config(value)))) == value


def test_numbers_are_constant_schedules_and_other_types_are_errors():
    assert schedule(0.5)(10**9) == 0.5
    assert schedule(Ramp(0.0, 1.0, 5)) == Ramp(0.0, 1.0, 5)
    for wrong in ("0.1", True, None, lambda step: 0.1):
        with pytest.raises(TypeError, match="expected"):
            schedule(wrong)


@given(schedules, st.integers(1, 600))
def test_a_clamped_schedule_reaches_its_end_value_within_the_run(value, steps):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        clamped = clamp(value, steps)
    assert clamped(steps) == pytest.approx(value(10**6), abs=1e-9)
    assert clamped(0) == pytest.approx(value(0), abs=1e-9) or isinstance(value, Piecewise)


def test_clamping_warns_of_what_it_changes_and_changes_nothing_else():
    objective = Evidence(kl_weight={"w": 0.5, "z": Ramp(0.0, 1.0, steps=800, delay=200)})
    with pytest.warns(UserWarning, match="shortened"):
        clamped = clamp(objective, 100)
    assert clamped == Evidence(kl_weight={"w": 0.5, "z": Ramp(0.0, 1.0, steps=80, delay=20)})
    assert clamp(objective, 1000) is objective
    assert math.isinf(clamp(math.inf, 5))
