"""A panel is the same from every container of its numbers, and unsuitable data are an error."""

import re
from dataclasses import replace
from decimal import Decimal

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvae.distributions.family import FAMILIES
from dvae.tables import Column, ColumnHints, Columns, Cut, Panel, PanelData, Series, infer_columns

pd = pytest.importorskip("pandas")
xr = pytest.importorskip("xarray")

XY = (Column("x0"), Column("x1"))
LONG = Columns(XY, id=("s",), time="t")


def values(panel):
    return {one.name: one.values for one in panel}


def same(one, other):
    assert one.keys() == other.keys()
    for name in one:
        np.testing.assert_array_equal(one[name], other[name])


def grid(n=3, t=5, seed=0):
    numbers = np.random.default_rng(seed).normal(size=(n, t, 2))
    numbers[1, 2, 0] = np.nan
    return numbers


def long(numbers):
    n, t, _ = numbers.shape
    frame = pd.DataFrame(numbers.reshape(-1, 2), columns=["x0", "x1"])
    return frame.assign(s=np.repeat(np.arange(n), t), t=np.tile(np.arange(t), n))


def test_every_container_of_the_same_numbers_makes_the_same_panel():
    numbers = grid()
    expected = {str(n): each.copy() for n, each in enumerate(numbers)}
    tensors = torch.from_numpy(numbers).requires_grad_()
    for data in (numbers, list(numbers), tensors, [*tensors]):
        same(values(Panel.of(data)), expected)
    frame = long(numbers)
    for index in ("s", "t", ["s", "t"], ["t", "s"]):
        indexed = frame.set_index(index)
        same(values(Panel.of(indexed, LONG)), expected)
        pd.testing.assert_frame_equal(indexed, frame.set_index(index))
    same(values(Panel.of(frame.set_index("t", drop=False), LONG)), expected)
    dataset = xr.Dataset({name: (("s", "t"), numbers[..., n]) for n, name in enumerate(("x0", "x1"))})
    for each in (Panel.of(dataset, LONG), Panel.of(dataset), Panel.of(dataset.transpose("t", "s"), ["x0", "x1"])):
        same(values(each), expected)
    first = {name: each[:, :1] for name, each in expected.items()}
    same(values(Panel.of(dataset["x0"])), first)
    wide = pd.DataFrame(numbers[..., 0].T, columns=list("012"))
    same(values(Panel.wide(wide)), first)
    same(values(Panel.wide(wide.set_axis(pd.date_range("2024", periods=5, tz="Asia/Tokyo")))), first)
    panel = Panel.of(numbers)
    numbers[:] = 0
    same(values(panel), expected)


DAYS = pd.to_datetime(["2024-01-01", "2024-01-02", "2024-01-05", "2024-01-06"])


@pytest.mark.parametrize(
    ("name", "days"), [(None, DAYS), ("day", DAYS.tz_localize("Asia/Tokyo")), ("y", DAYS.to_period("D"))]
)
def test_dates_in_an_index_are_times(days, name):
    frame = pd.DataFrame({"x": [1.0, 2.0, 3.0, 4.0], "time": [0.5, 0.5, 0.25, 0.5]}, index=days.rename(name))[::-1]
    hints = ColumnHints(columns=("x",))
    panel = Panel.of(frame[["x"]], hints)
    assert panel.columns.time == (name or "time")
    assert panel.calendar.kind == "dates"
    np.testing.assert_array_equal(panel.series[0].values[:, 0], [1, 2, 3, 4])
    np.testing.assert_array_equal(np.diff(panel.series[0].times) / 86400, [1, 3, 1])
    assert Panel.of(frame, hints).series[0].times.tolist() == panel.series[0].times.tolist()
    assert infer_columns(frame[["x"]]) == hints.of(frame[["x"]]) == panel.columns
    assert Panel.of(frame["x"]).fingerprint() == panel.fingerprint()


def test_an_index_of_stations_and_days_equals_the_two_columns():
    days = pd.date_range("2024-01-01", periods=40)
    index = pd.MultiIndex.from_product([list("abcd"), days], names=["station", "day"])
    frame = pd.DataFrame({"y": np.random.default_rng(0).normal(size=160)}, index=index)
    panel = Panel.of(frame.sample(frac=1, random_state=0))
    assert [len(one) for one in panel] == [40] * 4
    hints = ColumnHints(id=("station",), time="day")
    for other in (Panel.of(frame.reset_index(), hints), Panel.of(frame, hints), Panel.of(frame.reset_index("day"))):
        assert other.fingerprint() == panel.fingerprint()
    data = PanelData.of(frame, hints, Cut(6, 2, split="time"))
    assert data.with_data(frame.reset_index()).fingerprint == data.fingerprint == panel.fingerprint()
    concatenated = pd.concat({key: part.droplevel("station") for key, part in frame.groupby("station")})
    concatenated.index.names = [None, None]
    same(values(Panel.of(concatenated)), values(panel))


def test_an_uninformative_index_is_no_column():
    frame = pd.DataFrame({"y": [1.5, 0.5, 2.5]})
    expected = Panel.of(frame).fingerprint()
    for index in ([2, 0, 5], list("abc"), [0, 0, 0]):
        assert Panel.of(frame.set_axis(index)).fingerprint() == expected
    with pytest.raises(ValueError, match="two columns 'y' or an index with the name of a column; rename one"):
        Panel.of(frame.set_axis(pd.Index([7, 8, 9], name="y")))


@settings(max_examples=20)
@given(st.permutations(range(15)))
def test_the_order_of_rows_does_not_matter(order):
    frame = long(grid())
    panel, other = Panel.of(frame, LONG), Panel.of(frame.iloc[list(order)], LONG)
    assert [one.name for one in panel] == [one.name for one in other]
    same(values(panel), values(other))
    assert panel.fingerprint() == other.fingerprint()
    wide = pd.DataFrame(grid()[..., 0].T)
    rows = [place for place in order if place < 5]
    assert Panel.wide(wide.iloc[rows]).fingerprint() == Panel.wide(wide).fingerprint()


def test_wide_rows_without_times_keep_their_order_and_columns_are_trimmed():
    frame = pd.DataFrame({"a": [np.nan, 1.0, np.nan, 3.0], "b": [5.0, 6.0, np.nan, np.nan]}, index=list("zyxw"))
    panel = Panel.wide(frame)
    same(values(panel), {"a": np.array([[1.0], [np.nan], [3.0]]), "b": np.array([[5.0], [6.0]])})
    assert panel.series[0].times is None
    with_times = Panel.wide(frame.set_axis([0.0, 1.0, 2.5, 3.0]))
    np.testing.assert_array_equal(with_times.series[0].times, [1.0, 2.5, 3.0])


def of(column, family="real", classes=()):
    """The values of a column of a frame."""
    frame = pd.DataFrame({"y": column})
    return Panel.of(frame, Columns((Column("y", family=family, classes=classes),))).series[0].values[:, 0]


@pytest.mark.parametrize(
    ("column", "classes", "expected"),
    [
        (np.array([1, pd.NA, 0], object), (), [1, np.nan, 0]),
        (np.array([True, None, False], object), (), [1, np.nan, 0]),
        (np.array([Decimal(1), None, Decimal(0)], object), (), [1, np.nan, 0]),
        (pd.array([1, None, 0], "Int64"), (), [1, np.nan, 0]),
        (pd.array([True, None, False], "boolean"), (), [1, np.nan, 0]),
        (["1", None, "0"], (), [1, np.nan, 0]),
        (["v", None, "u"], ("u", "v"), [1, np.nan, 0]),
        ([2, None, 1], ("1", "2"), [1, np.nan, 0]),
        (pd.Categorical(["b", None]), ("a", "b"), [1, np.nan]),
        ([1.5, None], ("1.5", "2"), [0, np.nan]),
        ([None, None], ("1", "2"), [np.nan, np.nan]),
    ],
    ids=str,
)
def test_every_type_of_a_column_has_the_same_values_and_classes(column, classes, expected):
    np.testing.assert_array_equal(of(column, "category" if classes else "real", classes), expected)


def test_an_unknown_class_is_an_error_unless_a_class_replaces_all_others():
    with pytest.raises(ValueError, match=r"'y' has 'rian' \(did you mean 'rain'\?\), .*; to read all other"):
        of(["rian"], "category", ("rain", "sun"))
    columns = Columns((Column("y", family="category", classes=("rain", "else", "sun"), other="else"),))
    panel = Panel.of(pd.DataFrame({"y": ["rain", "hail", None, "sun"]}), columns)
    np.testing.assert_array_equal(panel.series[0].values[:, 0], [0, 1, np.nan, 2])


@pytest.mark.parametrize(
    ("column", "message"),
    [
        ([1.0, "a few", 2], "column 'y': 2 of 3 .* are numbers; row 1 is 'a few', which is not a number; .* na_values"),
        (pd.to_datetime(["2024", None]), r"column 'y' has type datetime64\[.s\], not numbers"),
        ([10**400, 1], "column 'y': 1 of 2 values are numbers; row 0 is 1000"),
        (["1,234", "5,678"], "column 'y' holds '1,234', which may be 1234 or a fraction; give the decimal sign"),
    ],
    ids=["mixed", "dates", "huge", "sign"],
)
def test_a_column_without_numbers_is_an_error(column, message):
    with pytest.raises(ValueError, match=message):
        of(column)


COUNTS = ([0, 70], [0.5, -1])
VALUES = {
    "binary": ([0, 1], [0.5, 2, -1]),
    "category": ([0, 1], [2, -1, 0.5]),
    "share": ([0.25, 0.75], [0, 1, 1 - 1e-12, 1e-50]),
    "angle": ([-np.pi, np.pi], [3.2, -4]),
    "positive": ([0.5, 3], [0, -1, 1e-50]),
    "log-normal": ([0.5, 3], [0, -1]),
    "hurdle": ([0, 2.5], [-0.1, 1e-50]),
    "power": ([0, 2.5], [-0.1]),
    **dict.fromkeys(("count", "overdispersed", "sparse", "sparse-overdispersed"), COUNTS),
}
"""Values inside and outside the support of a family. Other families have all values."""


@pytest.mark.parametrize("family", FAMILIES)
def test_values_outside_the_support_of_their_family_are_an_error(family):
    columns = Columns((Column("a"), Column("y", family=family, classes=("u", "v") if family == "category" else ())))
    good, bad = VALUES.get(family, ([-3.5, 0.0], []))
    for value in [*good, *bad, np.inf, 1e31]:
        series = [Series("p", np.array([[0.0, np.nan]])), Series("q", np.array([[0.0, np.nan], [0.0, value]]))]
        if value in good:
            Panel(series, columns, "riders")
            continue
        advice = "give it another family" if np.isfinite(value) else "write NaN for missing values"
        message = rf"'q' of riders has .* in row 1 of column 'y', but the family '\S+' requires .*; {advice}"
        with pytest.raises(ValueError, match=message) as error:
            Panel(series, columns, "riders")
        assert len(re.findall("below", str(error.value))) <= 1


@pytest.mark.parametrize(
    ("column", "gaps"),
    [
        (["2020-01-01", "2020-01-01 12:00", "2020-01-02"], [43200, 43200]),
        (["1500-01-01", "1500-01-02", "1500-01-03"], [86400, 86400]),
    ],
    ids=["of several lengths", "before 1970"],
)
def test_dates_of_mixed_lengths_and_before_1970_are_read(column, gaps):
    times = Panel.of(pd.DataFrame({"t": column, "y": [1.0, 2, 3]}), Columns((Column("y"),), time="t")).series[0].times
    np.testing.assert_array_equal(np.diff(times), gaps)


@pytest.mark.parametrize(
    ("freq", "notation"),
    [
        *(
            ("667min", form)
            for form in ("%Y%m%dT%H%M", "%d.%m.%Y %H:%M:%S", "%m/%d/%Y %I:%M %p", " %d/%m/%Y %H:%M UTC")
        ),
        *(("97h", form) for form in ("number %Y%m%d%H", "number %Y%m%d%H%M", "number %Y%m%d%H%M%S")),
        *(("MS", form) for form in ("%Y-%m", "%m/%Y", "number %Y%m", "%Y.%m", "%m.%Y")),
        *(("QS", form) for form in ("%YQq", "%Y-Qq")),
        *(("W-MON", form) for form in ("%G-W%V", "%GW%V", "number %Y%m%d")),
    ],
)
def test_times_are_read_in_every_notation(freq, notation):
    times = pd.date_range("1975-01-01", periods=300, freq=freq)
    texts = [each.strftime(notation.removeprefix("number ")).replace("q", str(each.quarter)) for each in times]
    frame = pd.DataFrame({"t": [int(each) for each in texts] if "number" in notation else texts, "y": np.arange(300.0)})
    panel = Panel.of(frame)
    assert panel.columns.time == "t"
    np.testing.assert_array_equal(panel.series[0].times, times.astype("datetime64[s]").astype(int))


def test_ids_that_differ_by_spaces_are_warned_of():
    frame = pd.DataFrame({"shop": np.repeat(["a", "a ", "b"], 3), "t": [0, 1, 2] * 3, "y": np.arange(9.0)})
    with pytest.warns(UserWarning, match="1 sequences have the names of others with spaces .*, such as 'a ' and 'a'"):
        assert len(Panel.of(frame, Columns((Column("y"),), time="t", id=("shop",)))) == 3


def test_years_with_weeks_are_read_by_the_name_of_their_column():
    monday = pd.date_range("2019-12-02", periods=60, freq="W-MON")
    weeks = [int(each.strftime("%G%V")) for each in monday]
    panel = Panel.of(pd.DataFrame({"week": weeks, "y": np.arange(60.0)}))
    np.testing.assert_array_equal(panel.calendar.to_pandas(panel.series[0].times), monday)
    panel = Panel.of(pd.DataFrame({"t": weeks, "y": np.arange(60.0)}))  # 202053 is no month
    assert panel.calendar.kind == "numbers"


def test_calendar_features_of_dates_with_several_offsets_are_warned_of():
    times = pd.date_range("2024-10-26", periods=60, freq="h", tz="Europe/Berlin").astype(str)
    frame, columns = pd.DataFrame({"t": times, "y": np.arange(60.0)}), Columns((Column("y"),), time="t")
    Panel.of(frame, columns)
    with pytest.warns(UserWarning, match="'t' have several offsets from UTC, so hour are those of UTC; name the time"):
        Panel.of(frame, replace(columns, calendar=("hour",)))
    Panel.of(frame, replace(columns, calendar=("hour",), zone="Europe/Berlin"))


@pytest.mark.parametrize(
    ("column", "message"),
    [
        (
            [0, 1, 1],
            "sequence '0' has two rows at t 1, 1 and 2; name the id .*, or remove the duplicate row$",
        ),
        (["2020-01", "2021-01", "2021-01"], "two rows at t 2021-01-01 00:00:00, 1 and 2; .* if clocks were set back"),
        (["2020-01-01T01:00+01:00", "2020-01-02", "2020-01-03"], "and others, such as '2020-01-02', have none"),
        (["2020", None, "2021"], "row 1 of column 't' has no time"),
        (["1/2/2020", "13/2/2020", "2/13/2020"], "nor durations: some dates begin with the day and others with"),
        (
            ["30/1/2020", "30/2/2020", "30/3/2020"],
            "nor durations: '30/2/2020' in row 1; write dates as 2024",
        ),
        (["1/2/2020", "2/2/2020", "12/2/2020"], "column 't': dates such as '1/2/2020' .* as 2024-12-31"),
        (["12:30", "12:40", "12:50"], "nor durations: '12:30' in row 0; .* durations as 02:30:00"),
        (["22:00:00", "23:00:00", "00:00:00"], "goes back from t 0 days 23:00:00 in row 1 to 0 days .* midnight"),
    ],
)
def test_rows_without_a_unique_time_are_an_error(column, message):
    frame = pd.DataFrame({"t": column, "y": [1.0, 2, 3]})
    with pytest.raises(ValueError, match=message):
        Panel.of(frame, Columns((Column("y"),), time="t"))


def test_all_id_columns_distinguish_sequences():
    frame = pd.DataFrame({"a": [1, 1, 2, 2], "b": ["u", "v", "u", None], "t": [0, 0, 0, 0], "y": [1.0, 2, 3, 4]})
    panel = Panel.of(frame, Columns((Column("y"),), id=("a", "b"), time="t"))
    assert {one.name: one.values.item() for one in panel} == {"1/u": 1, "1/v": 2, "2/u": 3, "2/": 4}
    numbered = frame.assign(a=[10, 10, 2, 2])
    assert next(iter(Panel.of(numbered, Columns((Column("y"),), id=("a", "b"), time="t")))).name == "2/u"
    with pytest.raises(ValueError, match="1 of 4 rows have no b, first in row 3; fill in the id"):
        Panel.of(frame.assign(t=range(4)), Columns((Column("y"),), ("b",), "t"))


def test_each_sequence_has_one_group_and_one_split():
    columns = Columns((Column("y"),), id=("s",), group="g", split="p")
    frame = pd.DataFrame({"s": list("aabb"), "g": [1, 1, 2, 2], "p": ["train"] * 3 + ["test"], "y": range(4)})
    with pytest.raises(ValueError, match="sequence 'b' has several values of p: test, train"):
        Panel.of(frame, columns)
    panel = Panel.of(frame.assign(p=["train"] * 2 + ["test"] * 2), columns)
    assert [(one.group, one.split) for one in panel] == [("1", "train"), ("2", "test")]
    assert panel.groups == ["1", "2"]
    with pytest.raises(ValueError, match="sequence 'a' has split 'tst'"):
        Panel.of(frame.assign(p="tst"), columns)
    with pytest.raises(ValueError, match="sequence 'b' has several values of g: , 2"):
        Panel.of(frame.assign(p="train", g=[1, 1, 2, None]), columns)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ([], "sequences are .T, D.; got none"),
        (torch.zeros(3), r"got \(3,\); for a single column, give \(T, 1\)"),
        ([np.zeros((3, 2)), np.zeros((4, 3))], r"sequence '1' of panel has shape \(4, 3\); expected rows of 2 columns"),
        (np.zeros((2, 0, 3)), r"shape \(0, 3\)"),
        (pd.DataFrame(np.zeros((2, 2)), columns=["a", "a"]), "two columns 'a'"),
        (pd.DataFrame({"a": [1.0]}).iloc[:0], "a header but no rows"),
        (np.zeros((6, 1), "datetime64[D]"), "array of date.*; give a pandas frame with the times in one column"),
        ({"a": [1]}, "got dict"),
    ],
)
def test_data_without_sequences_are_an_error(data, message):
    with pytest.raises((ValueError, TypeError), match=message):
        Panel.of(data)


def test_sequences_are_validated():
    values, columns = np.zeros((2, 1)), Columns((Column("y"),))
    for series, message in (
        ([Series("a", values), Series("a", values)], "two sequences 'a'"),
        ([Series("a", values, np.array([1.0, 1.0]))], "times that are not strictly increasing"),
        ([], "has no sequences"),
    ):
        with pytest.raises(ValueError, match=message):
            Panel(series, columns)
    with pytest.raises(ValueError, match=r"no column 'x00' \(did you mean 'x0'\?\); there are x0, x1, s, t"):
        Panel.of(long(grid()), Columns((Column("x00"),)))
    with pytest.raises(ValueError, match=r"no sequence '21' \(did you mean '2'\?\)"):
        Panel.of(grid()).only(["21"])
    assert [values.name for values in Panel.of(grid()).only(["2", "0"])] == ["2", "0"]


def test_the_fingerprint_depends_on_every_part_of_a_panel():
    columns = Columns((Column("y"),))
    base = Series("a", np.zeros((2, 1)), np.array([0.0, 1.0]), "g", "train")
    changes = {"name": "b", "values": base.values + 1, "times": base.times + 1, "group": "h", "split": "test"}
    variants = [replace(base, **{name: value}) for name, value in changes.items()]
    prints = {Panel([each], columns).fingerprint() for each in (base, replace(base, times=None), *variants)}
    prints.add(Panel([base], Columns((Column("z"),))).fingerprint())
    assert len(prints) == 8
