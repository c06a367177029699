"""Splits of sequences: parts are disjoint and complete, and no earlier part contains steps of a later one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvae.tables import Column, Columns, Panel, Series
from dvae.tables.calendar import Calendar
from dvae.tables.dataset import PanelData, default_cut
from dvae.tables.encoding import PanelSchema
from dvae.tables.protocol import Cut, begin_of

COLUMNS = Columns((Column("y"),))
PARTS = ("train", "validation", "test")


def panel(lengths, groups=1, splits=()):
    rng = np.random.default_rng(0)
    series = [
        Series(f"s{n}", rng.normal(size=(length, 1)), None, f"g{n % groups}", splits[n] if splits else "")
        for n, length in enumerate(lengths)
    ]
    return Panel(series, COLUMNS)


def places(cut, table, split):
    return {index for index, _, _ in cut.starts(table, split)}


@given(
    st.integers(3, 40),
    st.floats(0, 0.45),
    st.floats(0, 0.45),
    st.integers(0, 5),
    st.sampled_from(["sequence", "group"]),
)
def test_each_sequence_is_in_one_part(count, validation, test, seed, split):
    groups = max(3, count // 2)
    table, cut = panel([5] * count, groups), Cut(3, 2, split=split, validation=validation, test=test, seed=seed)
    parts = [places(cut, table, part) for part in PARTS]
    assert set.union(*parts) == set(range(count)) == places(cut, table, "all")
    assert sum(map(len, parts)) == count
    assert places(cut, table, "train+validation") == parts[0] | parts[1]
    reversed_table = Panel(table.series[::-1], COLUMNS)  # the order of sequences does not matter
    names = [
        {each_table.series[place].name for place in places(cut, each_table, "test")}
        for each_table in (table, reversed_table)
    ]
    assert names[0] == names[1]
    if split == "group":
        groups_of_parts = [{table.series[place].group for place in part} for part in parts]
        assert sum(map(len, groups_of_parts)) == len(set.union(*groups_of_parts))
    units = groups if split == "group" else count
    tested = {table.series[place].group if split == "group" else place for place in parts[2]}
    assert len(tested) == min(int(np.ceil(test * units)), units)


def test_sequences_with_a_declared_split_are_in_that_part():
    splits = ["train", "test", "validation", "train"]
    table = panel([5] * 4, splits=splits)
    for part in PARTS:
        assert places(Cut(3, 2), table, part) == {n for n, split in enumerate(splits) if split == part}
    with pytest.raises(
        ValueError, match=r"some sequences of panel state their split .test, train., but others, such as 's1', do not"
    ):
        Cut(3, 2).starts(panel([5] * 4, splits=["train", "", "", "test"]), "train")


@given(st.integers(1, 120), st.integers(1, 9), st.integers(1, 9), st.floats(0, 0.45), st.floats(0, 0.45))
def test_a_split_by_time_forecasts_no_step_of_an_earlier_part(total, observed, horizon, validation, test):
    table = panel([total])
    cut = Cut(observed, horizon, split="time", validation=validation, test=test)
    ends, begins = {}, {}
    for part in (*PARTS, "train+validation"):
        for _, low, last in cut.starts(table, part):
            assert 0 <= low <= last
            assert last + observed + horizon <= total
            ends[part], begins[part] = last + observed + horizon, low + observed
    if "validation" in ends:
        assert ends.get("train", 0) <= begins["validation"]
    if "test" in ends:
        assert ends["test"] == total
        assert max(ends.get(part, 0) for part in ("train", "validation", "train+validation")) <= begins["test"]


def test_windows_start_wherever_they_fit():
    table, cut = panel([4, 5, 9]), Cut(3, 2)
    assert cut.starts(table, "all") == [(1, 0, 0), (2, 0, 4)]
    assert cut.starts(table, "last") == [(1, 0, 0), (2, 4, 4)]
    assert Cut().starts(table, "all") == [(0, 0, 0), (1, 0, 0), (2, 0, 0)]
    assert Cut(6, 2, split="time").starts(panel([100]), "train") == [(0, 0, 62)]
    assert Cut(6, 2, split="time").starts(panel([100]), "validation") == [(0, 64, 72)]
    assert Cut(6, 2, split="time").starts(panel([100]), "test") == [(0, 74, 92)]


@given(st.integers(1, 120), st.integers(1, 9), st.integers(1, 9), st.floats(0, 0.9), st.integers(1, 130))
def test_a_number_of_test_steps_is_counted_from_the_end(total, observed, horizon, validation, test):
    table, cut = panel([total]), Cut(observed, horizon, split="time", validation=validation, test=test)
    spans = {part: cut.spans(table, part)[0][1:] for part in (*PARTS, "train+validation")}
    begin = total - test
    assert spans["test"] == (max(begin - observed, 0), total)
    assert spans["train+validation"] == (0, begin)
    assert spans["train"][1] == round((1 - validation) * begin)
    assert spans["validation"] == (max(spans["train"][1] - observed, 0), begin)


def test_sequences_with_dates_share_the_time_of_the_cutoff():
    days = 86400.0 * np.arange(30)
    parts = {"whole": slice(0, 30), "early": slice(0, 24), "late": slice(12, 30), "gaps": slice(0, 30, 2)}
    for kind, shares in (("dates", True), ("numbers", False)):
        series = [Series(name, np.zeros((len(days[part]), 1)), days[part]) for name, part in parts.items()]
        table = Panel(series, COLUMNS, calendar=Calendar(kind))
        cut = Cut(2, 1, split="time", test=10)
        for (_, _, end), sequence in zip(cut.spans(table, "train+validation"), series, strict=True):
            begin = np.searchsorted(sequence.times, days[20]) if shares else len(sequence) - 10
            assert end == begin
        data = PanelData("a", table, PanelSchema.from_data(table, cut))
        assert data.cutoff == ("1970-01-21" if shares else "10 steps to the end")
        assert data.before(4).cutoff == ("1970-01-27" if shares else "4 steps to the end")
    clocks = [Series(str(n), np.zeros((30, 1)), days + 3600 * n) for n in range(3)]  # no common times
    assert begin_of(Panel(clocks, COLUMNS, calendar=Calendar("dates")), 10) is None


def test_windows_after_successive_cutoffs_are_those_of_the_whole_test_part():
    table = panel([60, 47, 21])
    data = PanelData("a", table, PanelSchema.from_data(table, Cut(5, 3, split="time", stride=2)))
    whole = data.before(24).windows("test").keys
    parts = [data.before(steps).following(6).keys for steps in (24, 18, 12, 6)]
    assert sorted(key for part in parts for key in part) == sorted(whole)
    for steps, part in zip((24, 18, 12, 6), parts, strict=True):
        lengths = {sequence.name: len(sequence) for sequence in table}
        assert {lengths[name] - start - 5 - steps for _, name, start in part} <= {0, -2, -4}
    with pytest.raises(ValueError, match="has no test window that begins within 0 steps of 20 steps to the end"):
        data.before(20).following(0)
    with pytest.raises(ValueError, match=r"test is the share 0\.2, which has no cutoff"):
        data.following(6)


def test_units_are_from_the_steps_before_a_cutoff():
    values = np.concatenate([np.random.default_rng(0).normal(size=40), np.full(20, 1e3)])[:, None]
    data = PanelData.of([values], cut=Cut(4, 2, split="time", test=0.1, validation=0))
    assert data.before(20).schema.means["x0"] == pytest.approx(values[:40].mean())
    assert data.schema.means["x0"] > 100


def test_too_few_sequences_or_groups_to_split_are_an_error():
    with pytest.raises(ValueError, match=r'has 2 sequences, too few .* split="time"'):
        Cut(3, 2).starts(panel([50, 50]), "train")
    with pytest.raises(ValueError, match="has 1 groups, too few"):
        Cut(3, 2, split="group").starts(panel([50] * 5), "train")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observed": 3}, "give both, or neither"),
        ({"split": "time"}, "give the numbers of steps as observed and horizon"),
        ({"validation": 0.5, "test": 0.5}, "their sum must be below 1"),
        ({"observed": 0, "horizon": 1}, "observed is 0; it must be at least 1"),
        ({"test": 1.5}, "test is 1.5; it must be between 0 and 1"),
        ({"observed": 3, "horizon": 1, "test": 12}, "test is 12 steps and split 'sequence'; give a share below 1"),
    ],
)
def test_contradictory_cuts_are_an_error(options, message):
    with pytest.raises(ValueError, match=message):
        Cut(**options)


@pytest.mark.parametrize("count", [1, 9, 12])
def test_the_default_cut_leaves_windows_in_every_part(count):
    assert default_cut(panel([50] * 3, splits=PARTS)).split == "sequence"  # the panel declares its splits
    for length in (*range(9, 60, 5), 95, 500):
        table = panel([length] * count)
        cut = default_cut(table)
        assert cut.split == ("time" if count < 10 else "sequence")
        assert all(cut.starts(table, part) for part in PARTS)
