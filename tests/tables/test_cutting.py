"""How sequences are divided: parts share nothing, lose nothing, and nothing of a later part is in an earlier one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvae.tables import Column, Columns, Panel, Series
from dvae.tables.dataset import default_cut
from dvae.tables.protocol import Cut

TOLD = Columns((Column("y"),))
PARTS = ("train", "validation", "test")


def panel(lengths, groups=1, splits=()):
    rng = np.random.default_rng(0)
    made = [
        Series(f"s{n}", rng.normal(size=(length, 1)), None, f"g{n % groups}", splits[n] if splits else "")
        for n, length in enumerate(lengths)
    ]
    return Panel(made, TOLD)


def places(cut, of, split):
    return {place for place, _, _ in cut.starts(of, split)}


@given(
    st.integers(3, 40),
    st.floats(0, 0.45),
    st.floats(0, 0.45),
    st.integers(0, 5),
    st.sampled_from(["sequence", "group"]),
)
def test_sequences_are_in_one_part_each(count, validation, test, seed, split):
    groups = max(3, count // 2)
    of, cut = panel([5] * count, groups), Cut(3, 2, split=split, validation=validation, test=test, seed=seed)
    found = [places(cut, of, part) for part in PARTS]
    assert set.union(*found) == set(range(count)) == places(cut, of, "all")
    assert sum(map(len, found)) == count
    assert places(cut, of, "train+validation") == found[0] | found[1]
    turned = Panel(of.series[::-1], TOLD)  # the order of sequences does not matter
    names = [{each.series[place].name for place in places(cut, each, "test")} for each in (of, turned)]
    assert names[0] == names[1]
    if split == "group":
        held = [{of.series[place].group for place in part} for part in found]
        assert sum(map(len, held)) == len(set.union(*held))
    units = groups if split == "group" else count
    tested = {of.series[place].group if split == "group" else place for place in found[2]}
    assert len(tested) == min(int(np.ceil(test * units)), units)


def test_sequences_that_say_their_part_are_there():
    said = ["train", "test", "validation", "train"]
    of = panel([5] * 4, splits=said)
    for part in PARTS:
        assert places(Cut(3, 2), of, part) == {n for n, own in enumerate(said) if own == part}
    with pytest.raises(
        ValueError, match=r"some sequences of panel state their split .test, train., but others, such as 's1', do not"
    ):
        Cut(3, 2).starts(panel([5] * 4, splits=["train", "", "", "test"]), "train")


@given(st.integers(1, 120), st.integers(1, 9), st.integers(1, 9), st.floats(0, 0.45), st.floats(0, 0.45))
def test_by_time_no_step_to_be_forecast_is_in_an_earlier_part(total, observed, horizon, validation, test):
    of = panel([total])
    cut = Cut(observed, horizon, split="time", validation=validation, test=test)
    ends, begins = {}, {}
    for part in (*PARTS, "train+validation"):
        for _, low, last in cut.starts(of, part):
            assert 0 <= low <= last
            assert last + observed + horizon <= total
            ends[part], begins[part] = last + observed + horizon, low + observed
    if "validation" in ends:
        assert ends.get("train", 0) <= begins["validation"]
    if "test" in ends:
        assert ends["test"] == total
        assert max(ends.get(part, 0) for part in ("train", "validation", "train+validation")) <= begins["test"]


def test_windows_are_where_they_fit():
    of, cut = panel([4, 5, 9]), Cut(3, 2)
    assert cut.starts(of, "all") == [(1, 0, 0), (2, 0, 4)]
    assert cut.starts(of, "last") == [(1, 0, 0), (2, 4, 4)]
    assert Cut().starts(of, "all") == [(0, 0, 0), (1, 0, 0), (2, 0, 0)]
    assert Cut(6, 2, split="time").starts(panel([100]), "train") == [(0, 0, 62)]
    assert Cut(6, 2, split="time").starts(panel([100]), "validation") == [(0, 64, 72)]
    assert Cut(6, 2, split="time").starts(panel([100]), "test") == [(0, 74, 92)]


def test_too_few_sequences_are_divided_by_time():
    with pytest.raises(ValueError, match=r'has 2 sequences, too few .* split="time"'):
        Cut(3, 2).starts(panel([50, 50]), "train")
    with pytest.raises(ValueError, match="has 1 groups, too few"):
        Cut(3, 2, split="group").starts(panel([50] * 5), "train")


@pytest.mark.parametrize(
    ("told", "said"),
    [
        ({"observed": 3}, "give both, or neither"),
        ({"split": "time"}, "give the number of observed steps, and a horizon"),
        ({"validation": 0.5, "test": 0.5}, "leave nothing to train on"),
        ({"observed": 0, "horizon": 1}, "observed is 0; it must be at least 1"),
        ({"test": 1.5}, "test is 1.5; it must be between 0 and 1"),
    ],
)
def test_cuts_that_make_no_sense_are_refused(told, said):
    with pytest.raises(ValueError, match=said):
        Cut(**told)


@pytest.mark.parametrize("count", [1, 9, 12])
def test_what_suits_a_panel_leaves_windows_in_every_part(count):
    assert default_cut(panel([50] * 3, splits=PARTS)).split == "sequence"  # which says its part
    for length in (*range(9, 60, 5), 95, 500):
        of = panel([length] * count)
        cut = default_cut(of)
        assert cut.split == ("time" if count < 10 else "sequence")
        assert all(cut.starts(of, part) for part in PARTS)
