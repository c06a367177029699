"""Inference of columns, roles and families for tables without a schema."""

import re
from decimal import Decimal

import numpy as np
import pytest

from dvae.tables import Column, Columns, Panel, PanelData
from dvae.tables.column_inference import ColumnHints, infer_columns
from dvae.tables.reading import read_frame, read_panel

pd = pytest.importorskip("pandas")


def families(frame):
    return {column.name: (column.role, column.family) for column in infer_columns(frame).columns}


def test_families_are_inferred_from_the_values():
    rng = np.random.default_rng(0)
    frame = pd.DataFrame(
        {
            "real": rng.normal(size=200),
            "few": rng.poisson(2, 200),
            "many": rng.negative_binomial(1, 0.1, 200),
            "people": np.round(np.exp(rng.normal(12, 1, 200))),
            "open": rng.integers(0, 2, 200),
            "flag": np.where(np.arange(200) % 7, rng.integers(0, 2, 200).astype(bool), None),
            "kind": rng.choice(["u", "v"], 200),
            "skewed": rng.gamma(1, size=200),
            "narrow": 100 + rng.normal(size=200),
            "text": [f"text {n}" for n in range(200)],
            "one": ["same"] * 200,
            "level": [3.5, None] * 100,
            "empty": [None] * 200,
            "nan": np.nan,
        }
    )
    with pytest.warns(UserWarning, match="columns left out of the proposed schema") as warnings:
        inferred = {name: family for name, (_, family) in families(frame).items()}
    (warning,) = warnings
    assert str(warning.message).endswith(
        "'text' (neither numbers nor 2 to 20 classes, such as 'text 0'), 'one' (constant: 'same'), "
        "'level' (constant: '3.5'), 'empty' (empty: all its values are missing), "
        "'nan' (empty: all its values are missing)"
    )
    assert inferred == {
        "real": "real",
        "few": "count",
        "many": "overdispersed",
        "people": "log-normal",
        "open": "binary",
        "flag": "binary",
        "kind": "category",
        "skewed": "positive",
        "narrow": "real",
    }
    Panel.of(frame[[*inferred]])  # all proposed columns can be read


def panel(**more):
    """Three stations, seven days."""
    days = pd.date_range("2024-01-01", periods=7).strftime("%Y-%m-%d")
    rng = np.random.default_rng(0)
    frame = pd.DataFrame({"day": np.tile(days, 3), "riders": rng.poisson(3, 21), **more})
    return frame


@pytest.mark.parametrize("ids", [[7, 8, 9], ["a", "b", "c"], [7.0, 8.0, 9.0]])
def test_ids_leave_one_row_for_each_time(ids):
    columns = infer_columns(panel(station=np.repeat(ids, 7), height=np.repeat([1.5, 2.5, 3.5], 7)))
    assert (columns.id, columns.time) == (("station",), "day")
    assert [target_or_static.role for target_or_static in columns.columns] == ["target", "static"]


def test_a_repeating_column_that_is_not_needed_is_no_id():
    weather = np.random.default_rng(1).choice(["rain", "sun", "fog"], 21)
    frame = panel(weather=weather, place=np.repeat(["a", "b", "c"], 7))
    assert frame.duplicated(["day", "weather"]).any()
    columns = infer_columns(frame)
    assert columns.id == ("place",)
    assert [column.name for column in columns.columns] == ["riders", "weather"]


def test_two_columns_are_the_id_if_one_is_not_enough():
    frame = panel(region=np.repeat(["n", "n", "s"], 7), line=np.repeat(["a", "b", "a"], 7))
    assert set(infer_columns(frame).id) == {"region", "line"}


def test_a_table_of_one_sequence_has_an_id():
    frame = panel(station_id=5).iloc[:7]
    columns = infer_columns(frame)
    assert columns.id == ("station_id",)
    assert [column.name for column in columns.columns] == ["riders"]
    assert Panel.of(frame).series[0].name == "5"


def shops(days, format):
    """Daily sales of shops in two cities."""
    frame = pd.DataFrame({"date": np.tile(days.strftime(format), 6), "shop": np.repeat(list("abcdef"), len(days))})
    return frame.assign(
        city=np.repeat(["n", "s"], 3 * len(days)), sold=np.random.default_rng(0).normal(size=len(frame))
    )


@pytest.mark.parametrize("format", ["%d/%m/%Y", "%d.%m.%Y", "%m/%d/%Y", "%d-%m-%Y"])
def test_one_day_above_12_distinguishes_days_from_months(format):
    for first in ("2024-01-01", "2024-01-15"):
        days = pd.date_range(first, periods=13)
        panel = Panel.of(shops(days, format))
        assert (panel.columns.id, panel.columns.time) == (("shop",), "date")
        for one in panel:
            np.testing.assert_array_equal(one.times, days.astype("datetime64[s]").astype(int))


@pytest.mark.parametrize("format", ["%d/%m/%Y", "%m.%d.%Y", "%d/%m/%y"])
@pytest.mark.parametrize("freq", ["D", "MS"])
def test_ambiguous_days_and_months_cause_a_warning_or_an_error(format, freq):
    frame = shops(pd.date_range("2024-01-01", periods=12, freq=freq), format)
    with pytest.warns(UserWarning, match=r"'date' \(perhaps the time: dates such as '01.01.(20)?24' .* as 2024-12-31"):
        columns = infer_columns(frame)
    assert (columns.id, columns.time) == (("shop",), None)  # the dates distinguish rows
    assert "date" not in columns.names
    with pytest.warns(UserWarning, match="perhaps the time"):
        ColumnHints(columns=("sold",)).of(frame)
    with pytest.raises(ValueError, match=r"column 'date': dates such as '01.01.(20)?24'"):
        Panel.of(frame, ColumnHints(time="date"))
    with pytest.raises(ValueError, match=r"dates such as '01.01.(20)?24'"):
        Panel.wide(frame.pivot(index="date", columns="shop", values="sold"))
    ColumnHints(columns=("sold",), past=("date:category",), id=("shop",)).of(frame)  # a named column is not left out


def test_a_constant_column_is_a_target_only_if_named():
    frame = pd.DataFrame({"y": [1.5, 2.5, -1.0], "rate": [3.5, 3.5, 3.5]})
    with pytest.warns(UserWarning, match=r"columns left out of the proposed schema: 'rate' \(constant: '3.5'\)"):
        assert infer_columns(frame).names == ["y"]
    with pytest.warns(UserWarning, match="column 'rate' is constant, '3.5', but was named as a target"):
        assert ColumnHints(columns=("y", "rate")).of(frame).names == ["y", "rate"]


@pytest.mark.parametrize("freq", ["W", "2W", "Q", "D"])
def test_periods_are_the_time(freq):
    frame = pd.DataFrame({"y": [1.5, 2.5, -1.0]}, pd.period_range("2000-01-03", periods=3, freq=freq))
    assert Panel.of(frame).calendar.kind == "dates"


def test_row_numbers_of_pandas_are_left_out():
    frame = panel(station=np.repeat(["a", "b", "c"], 7))
    numbered = frame.reset_index(names="Unnamed: 0")
    with pytest.warns(UserWarning, match=r"'Unnamed: 0' \(row numbers without a name\)"):
        assert infer_columns(numbered) == infer_columns(frame)
    measured = numbered.assign(**{"Unnamed: 0": frame.riders})
    assert "Unnamed: 0" in infer_columns(measured).names
    assert ColumnHints(columns=("riders",), past=("Unnamed: 0",)).of(numbered).names == ["riders", "Unnamed: 0"]


def test_numbers_with_a_unit_sign_are_named():
    prices = [f"{n},234.50 €" for n in range(10, 31)]
    with pytest.warns(
        UserWarning, match="columns left out of the proposed schema: 'price' .*, such as '10,234.50 €'; remove '€'"
    ):
        assert "price" not in infer_columns(panel(price=prices)).names


def test_texts_with_a_single_date_are_no_dates():
    frame = panel(said=["1/2/2024", *(f"{n}th of them" for n in range(20))])
    with pytest.warns(UserWarning, match=r"'said' \(neither numbers nor 2 to 20 classes, such as '1/2/2024'\)"):
        infer_columns(frame.drop(columns="day"))


def test_dates_with_changing_utc_offsets_are_a_time():
    frame = pd.DataFrame({"when": ["2020-03-28T00:00+01:00", "2020-03-30T00:00+02:00"], "y": [1.5, 2.5]})
    assert infer_columns(frame).time == "when"


def test_numbers_named_as_a_time_are_a_time():
    frame = pd.DataFrame({"y": [0.5, 1.5, 2.5], "year": [2001, 2002, 2003]})
    assert infer_columns(frame).time == "year"
    assert infer_columns(frame.rename(columns={"year": "yearly"})).time is None


def test_hints_override_inference():
    frame = panel(
        station=np.repeat([7, 8, 9], 7), plan=np.arange(21.0), temp=np.arange(21) % 5, mood=["u", "v", "w"] * 7
    )
    columns = ColumnHints(covariates=("plan",), past=("temp", "mood:category")).of(frame)
    assert [(c.name, c.role, c.family) for c in columns.columns] == [
        ("riders", "target", "count"),
        ("plan", "known", "real"),
        ("temp", "past", "real"),
        ("mood", "past", "category"),
    ]
    hinted = ColumnHints(columns=("riders:overdispersed:people",), static=("station",)).of(
        frame.assign(a=np.repeat([1, 2, 3], 7))
    )
    assert next((c.name, c.family, c.unit) for c in hinted.columns) == ("riders", "overdispersed", "people")
    assert [c.name for c in hinted.targets] == ["riders"]


def test_a_name_may_have_colons():
    frame = pd.DataFrame({"a:b": [0.5, 1.5], "c": [0.5, 1.0]})
    assert ColumnHints(columns=("a:b", "c:positive:m:s")).of(frame).columns[1].unit == "m:s"
    (only,) = ColumnHints(columns=("a:laplace:b",)).of(frame.set_axis(["a", "c"], axis=1)).columns
    assert (only.name, only.family, only.unit) == ("a", "laplace", "b")


@pytest.mark.parametrize(
    ("hints", "message"),
    [
        ({"columns": ("ridrs",)}, r"no column 'ridrs' \(did you mean 'riders'\?\)"),
        ({"id": ("dy",)}, r"no column 'dy' \(did you mean 'day'\?\)"),
        ({"time": "dya"}, r"no column 'dya' \(did you mean 'day'\?\)"),
        ({"group": "x"}, "no column 'x'; there are day, riders"),
        ({"columns": ("riders",), "past": ("riders",)}, "column 'riders' is named twice"),
        ({"columns": ("riders:cout",)}, r"family 'cout' \(did you mean 'count'\?\)"),
        ({"columns": ("riders",), "time": "riders"}, "'riders' has two roles"),
        ({"covariates": ("riders",)}, "no column is a target"),
    ],
)
def test_wrong_hints_are_an_error(hints, message):
    with pytest.raises(ValueError, match=message):
        ColumnHints(**hints).of(panel().iloc[:7])


def hourly(days=14):
    """An hourly load."""
    return pd.DataFrame(
        {"when": pd.date_range("2024-01-01", periods=24 * days, freq="h"), "load": np.arange(24.0 * days)}
    )


SPLIT_TIMES = {
    "date and clock": lambda times: {"Date": times.dt.strftime("%Y-%m-%d"), "Time": times.dt.strftime("%H:%M:%S")},
    "clock first": lambda times: {"Time": times.dt.strftime("%H:%M"), "Date": times.dt.strftime("%d.%m.%Y")},
    "half days": lambda times: {"Date": times.dt.strftime("%Y-%m-%d"), "Time": times.dt.strftime("%I:%M %p")},
    "objects": lambda times: {"Date": times.dt.normalize(), "Time": times.dt.time},
    "hour": lambda times: {"date": times.dt.strftime("%Y-%m-%d"), "hour": times.dt.hour},
    "compact": lambda times: {"date": times.dt.strftime("%Y%m%d").astype(int), "time": times.dt.hour * 100},
    "hundreds": lambda times: {"date": times.dt.strftime("%Y-%m-%d"), "time": times.dt.strftime("%H%M")},
    "parts": lambda times: {name: getattr(times.dt, name) for name in ("year", "month", "day", "hour")},
    "parts in text": lambda times: (
        {"DAY": times.dt.strftime("%d"), "MONTH": times.dt.strftime("%b"), "YEAR": "2024"}
        | {"HOUR": times.dt.strftime("%H")}
    ),
    "day of the year": lambda times: {"Year": times.dt.year, "doy": times.dt.day_of_year, "Hour": times.dt.hour},
}


@pytest.mark.parametrize("form", SPLIT_TIMES)
@pytest.mark.parametrize("shops", [1, 2])
def test_columns_of_one_time_are_joined(form, shops):
    frame = hourly()
    parts = pd.DataFrame({**SPLIT_TIMES[form](frame.when), "sky": np.where(frame.load % 5, "sun", "rain")})
    parts = parts.assign(No=np.arange(1, len(frame) + 1), load=frame.load)
    if shops > 1:
        parts = pd.concat([parts.assign(shop="b"), parts.assign(shop="a")]).sort_index(kind="stable").drop(columns="No")
    else:
        with pytest.warns(UserWarning, match=r"'No' \(row numbers\)"):
            infer_columns(parts)
    columns = infer_columns(parts.drop(columns="No", errors="ignore"))
    assert len(columns.times) > 1
    assert columns.id == (("shop",) if shops > 1 else ())
    assert columns.names == ["sky", "load"]
    assert Columns.from_toml(columns.to_toml()) == Columns.from_config(columns.config()) == columns
    panel = Panel.of(parts, columns)
    assert panel.calendar.kind == "dates"
    for one in panel:
        np.testing.assert_array_equal(one.times, frame.when.astype("datetime64[s]").astype(int))
        np.testing.assert_array_equal(one.values[:, 1], frame.load)


def test_a_clock_is_not_joined_if_the_date_suffices():
    frame = panel(station=np.repeat(["a", "b", "c"], 7), opened=["09:30"] * 20 + ["10:00"])
    columns = infer_columns(frame)
    assert (columns.id, columns.time) == (("station",), "day")
    days = pd.DataFrame({"day": np.repeat([1, 2], 24), "hour": np.tile(np.arange(24), 2), "y": np.arange(48) / 8})
    assert infer_columns(days).time == ("day", "hour")
    np.testing.assert_array_equal(Panel.of(days).series[0].times, np.arange(24, 72))
    weeks = pd.DataFrame({"year": np.repeat([2020, 2021], 52), "week": [*range(1, 53)] * 2, "y": np.arange(104) / 8})
    moments = Panel.of(weeks).series[0].times
    assert infer_columns(weeks).time == ("year", "week")
    assert (moments[0], moments[52]) == (pd.Timestamp("2019-12-30").timestamp(), pd.Timestamp("2021-01-04").timestamp())
    quarters = pd.DataFrame({"year": np.repeat([2020, 2021], 4), "quarter": [f"Q{n}" for n in (1, 2, 3, 4)] * 2})
    quarters["y"] = np.arange(8) / 8
    assert infer_columns(quarters).time == ("year", "quarter")
    assert Panel.of(quarters).series[0].times[4] == pd.Timestamp("2021").timestamp()


def test_invalid_parts_of_a_time_are_named():
    frame = pd.DataFrame({"year": [2023, 2023], "month": [2, 2], "day": [28, 29], "hour": [0, 25], "y": [0.5, 1.5]})
    frame["minute"] = [0, 30]
    for parts, message in [
        (("year", "month", "day"), "row 1 of year month day is not a date: 2023-02 has no day 29"),
        (("year", "month", "hour"), "row 0 of column 'hour' is 0; expected days from 1"),
        (("year", "month", "minute"), "a column of minutes but no column of the next larger unit"),
        (("year", "y"), "row 0 of column 'y' is 0.5; expected months from 1 to 12"),
    ]:
        with pytest.raises(ValueError, match=message):
            Panel.of(frame, ColumnHints(columns=("y",) if "y" not in parts else ("hour",), time=parts))


def test_a_column_that_only_makes_rows_unique_is_no_id():
    days = pd.date_range("2024-01-01", periods=40).strftime("%Y-%m-%d")
    frame = pd.DataFrame({"day": [*days, days[5], days[20]], "sky": ["sun", "rain"] * 20 + ["sun", "rain"]})
    frame = frame.assign(
        sky=frame.sky.where(frame.index != 5, "rain").where(frame.index != 20, "sun"), y=np.arange(42.0)
    )
    assert not frame.duplicated(["day", "sky"]).any()
    assert infer_columns(frame).id == ()
    with pytest.raises(ValueError, match="two rows at day 2024-01-06 00:00:00, 5 and 40; name the id columns"):
        Panel.of(frame)


@pytest.mark.parametrize("names", [("entity", "year"), (None, None), ("firm", "t")])
def test_levels_of_an_index_are_ids_and_time(names):
    index = pd.MultiIndex.from_product([[11, 12, 13], [2000, 2001, 2002, 2003]], names=names)
    frame = pd.DataFrame({"y": np.arange(12) / 8}, index=index)
    panel = Panel.of(frame)
    assert [one.name for one in panel] == ["11", "12", "13"]
    assert panel.columns.names == ["y"]
    np.testing.assert_array_equal(panel.series[1].times, [2000, 2001, 2002, 2003])
    stacked = pd.concat({1: frame.iloc[:4].reset_index(drop=True), 2: frame.iloc[4:8].reset_index(drop=True)})
    assert [len(one) for one in Panel.of(stacked)] == [4, 4]


@pytest.mark.parametrize("ids", [["07", "7"], ["1E5", "100000"], ["NA", "None"], ["0x10", "16"]])
def test_ids_and_classes_are_text(tmp_path, ids):
    rows = [f"{sequence},{t},{t}.5,{ids[t % 2]}" for sequence in ids for t in range(4)]
    (tmp_path / "a.csv").write_text("\n".join(["station,t,y,sky", *rows]) + "\n")
    panel = read_panel(tmp_path / "a.csv", ColumnHints(columns=("y", "sky:category")))
    assert {sequence.name for sequence in panel} == {*ids}
    assert panel.columns.columns[1].classes == tuple(sorted(ids))
    for sequence in panel:
        np.testing.assert_array_equal(sequence.values[:, 1], [sorted(ids).index(ids[t % 2]) for t in range(4)])


@pytest.mark.parametrize(
    ("cells", "values"),
    [
        (["1.234,5", "-12", "0,25"], [1234.5, -12, 0.25]),
        (["1,234,567", "-12.5", "1e3"], [1234567, -12.5, 1000]),
        (["1 234,5", "2\u202f000", "7"], [1234.5, 2000, 7]),
        (["1'234.5", "−2", "+3."], [1234.5, -2, 3]),
        ([Decimal("0.1"), Decimal("1e9"), None], [0.1, 1e9, np.nan]),
        (["TRUE", "false", None], [1, 0, np.nan]),
        (["0.1", "123456789.123456789", "5e-324"], [0.1, 123456789.123456789, 5e-324]),
    ],
    ids=["comma", "point", "spaces", "signs", "decimals", "booleans", "digits"],
)
def test_numbers_are_read_in_every_notation(cells, values):
    panel = Panel.of(pd.DataFrame({"t": [1, 2, 3], "y": cells}))
    assert panel.columns.columns[0].family != "category"
    np.testing.assert_array_equal(panel.series[0].values[:, 0], values)


def texted(*odd, count=60):
    """A column of numbers as text, with some other cells."""
    cells = [f"{n}.25" for n in range(count)]
    cells[20 : 20 + len(odd)] = odd
    return pd.DataFrame({"day": pd.date_range("2024-01-01", periods=count), "power": cells})


@pytest.mark.parametrize("mark", ["?", "-", ".", "n.a.", "—", "#DIV/0!"])
def test_marks_among_numbers_are_missing_and_named(mark):
    with pytest.warns(
        UserWarning, match=f"'power' holds {re.escape(repr(mark))} .row 20, 2 in all. among numbers"
    ) as warnings:
        panel = Panel.of(texted(mark, mark))
    assert len(warnings) == 1
    assert panel.columns.na_values == (mark,)
    assert np.isnan(panel.series[0].values[20:22, 0]).all()
    np.testing.assert_array_equal(np.delete(panel.series[0].values[:, 0], [20, 21]) % 1, 0.25)
    Panel.of(texted(mark), panel.columns)  # the second read does not warn
    with pytest.warns(UserWarning, match="read as missing"):
        Panel.of(texted(mark), Columns((Column("power"),), time="day"))


def test_cells_that_are_no_numbers_are_named_with_a_remedy():
    for columns in (None, Columns((Column("power"),), time="day"), ["power"]):
        with pytest.raises(ValueError, match=r"'power': 58 of 60 values are numbers; row 20 is 'off', .* na_values"):
            Panel.of(texted("off", "on"), columns)
    settled = Panel.of(texted("off", "on"), ColumnHints(na_values=("off", "on", "3.25")))
    assert np.flatnonzero(np.isnan(settled.series[0].values[:, 0])).tolist() == [3, 20, 21]
    assert Columns.from_toml(settled.columns.to_toml()) == settled.columns
    assert Panel.of(texted("off"), ColumnHints(columns=("power:category",))).columns.columns[0].family == "category"


def test_declared_missing_marks_and_decimal_signs_are_read(tmp_path):
    rows = [f'{3 * n},"1,234",?\n{3 * n + 1},-999,sun\n{3 * n + 2},"5,678",rain\n' for n in range(9)]
    (tmp_path / "a.csv").write_text("t,y,sky\n" + "".join(rows))
    (tmp_path / "a.toml").write_text('time = "t"\nna_values = ["-999", "?"]\ndecimal = ","\n')
    with pytest.raises(ValueError, match="'y' holds '1,234', which may be 1234 or a fraction; give the decimal sign"):
        read_panel(tmp_path / "a.csv", ColumnHints(na_values=("-999",)))
    data = PanelData.open(tmp_path / "a.csv")  # a schema without columns: they are inferred
    assert data.panel.columns.columns[1].classes == ("rain", "sun")
    np.testing.assert_array_equal(data.panel.series[0].values[:3], [[1.234, np.nan], [np.nan, 1], [5.678, 0]])
    reopened = PanelData.reopen(data.recorded(), data.schema)
    assert reopened.fingerprint == data.fingerprint


@pytest.mark.parametrize("sign", [",", "."])
@pytest.mark.parametrize("separator", [";", "\t", "|"])
def test_thousands_are_not_read_as_fractions(tmp_path, sign, separator):
    other = {",": ".", ".": ","}[sign]
    grouped = [f"{n:,}".replace(",", sign) for n in range(700, 2500, 30)]
    days = pd.date_range("2024-01-01", periods=60).strftime("%Y-%m-%d")

    def read_columns(columns_or_hints=None, **columns):
        names = ["day", *columns]
        lines = [separator.join(row) for row in zip(days, *columns.values(), strict=True)]
        (tmp_path / "a.csv").write_text("\n".join([separator.join(names), *lines]) + "\n")
        return read_panel(tmp_path / "a.csv", columns_or_hints)

    message = f"'{{}}' holds '1{sign}000', which may be 1000 or a fraction; give the decimal sign"
    for columns_or_hints in (None, ColumnHints(columns=("sales:real",))):
        with pytest.raises(ValueError, match=message.format("sales")):
            read_columns(columns_or_hints, sales=grouped)
    with pytest.raises(ValueError, match=message.format("step")):
        read_columns(Columns((Column("y"),), time="step"), step=[f"1{sign}{n:03}" for n in range(60)], y=["1"] * 60)
    prices = [f"1{sign}000{other}5", *(f"{n}{other}25" for n in range(59))]
    for columns_or_hints in (ColumnHints(decimal=other), None) if sign == "," else (ColumnHints(decimal=other),):
        panel = read_columns(columns_or_hints, sales=grouped, price=prices)
        np.testing.assert_array_equal(panel.series[0].values[:, 0], np.arange(700, 2500, 30))


def test_thousands_with_a_dot_are_ambiguous_between_commas(tmp_path):
    days = pd.date_range("2024-01-01", periods=60).strftime("%Y-%m-%d")

    def read_cells(cells, hints=None, header="visitors"):
        lines = [f"{day},{cell}" for day, cell in zip(days, cells, strict=False)]
        (tmp_path / "a.csv").write_text("\n".join([f"day,{header}", *lines]) + "\n")
        return read_panel(tmp_path / "a.csv", hints).series[0].values[:, 0]

    grouped = [f"{n:,}".replace(",", ".") for n in range(700, 2500, 30)]
    with pytest.raises(
        ValueError, match=r"'visitors' holds '1\.000', which may be 1000 or a fraction; give the decimal"
    ):
        read_cells(grouped)
    np.testing.assert_array_equal(read_cells(grouped, ColumnHints(decimal=",")), np.arange(700, 2500, 30))
    assert read_cells(grouped, ColumnHints(decimal="."))[10] == 1.0
    for other in ("1.5", "2500", "0.125"):  # no number of thousands
        assert read_cells([*grouped[1:], other])[9] == 1.0
    assert read_cells([f"{cell},{n}.5" for n, cell in enumerate(grouped)], header="visitors,price")[10] == 1.0


@pytest.mark.parametrize("cell", ["2024-02-30", "2024-13-01", "2024-01-xx", "soon"])
def test_a_single_cell_that_is_no_date_is_named(cell):
    days = [*pd.date_range("2024-01-01", periods=30).strftime("%Y-%m-%d"), cell]
    for order in (1, -1):
        frame = pd.DataFrame({"day": days[::order], "y": np.arange(31) / 8})
        with pytest.raises(ValueError, match=f"'day': 30 of 31 values are dates; row {days[::order].index(cell)} is"):
            Panel.of(frame)


@pytest.mark.parametrize(
    "cells",
    [
        ["1,5", "1.5", "2.5"],
        ["1.5", "2.5", "<1"],
        ["1.5", "2.5", "3.5", "off"],
        ["5 kg", "6 kg"],
        ["5%", "6%"],
        ["$5", "$6.50"],
    ],
)
def test_classes_that_may_be_numbers_are_named(cells):
    frame = pd.DataFrame({"t": range(24), "y": (cells * 24)[:24]})
    with pytest.warns(
        UserWarning, match="'y' is proposed as a category, and some of its classes may be numbers"
    ) as warnings:
        assert infer_columns(frame).columns[0].family == "category"
    unit = next((unit for unit in ("kg", "%", "$") if unit in cells[0]), None)
    assert (f"remove '{unit}'" in str(warnings[0].message)) == (unit is not None)
    Panel.of(frame, ColumnHints(columns=("y:category",)))  # a declared category does not warn


def test_classes_that_only_contain_digits_are_no_numbers():
    for cells in (["07", "12"], ["09:30", "10:00"], ["20-30", "30-40"], ["sun", "4 by 4", "rain"]):
        infer_columns(pd.DataFrame({"t": range(12), "y": (cells * 12)[:12]}))


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ([f"{n // 60:02}:{n % 60:02}" for n in range(90)], r"perhaps a time, such as '00:00'; write it with its date"),
        ([f"{n:02}:05.{n % 10}" for n in range(90)], "perhaps a time, such as '00:05.0'"),
        ([f"{n // 8 % 12 + 1}:{n % 60:02} AM" for n in range(90)], "perhaps a time, such as '1:00 AM'"),
        ([f"€ {n}.3" for n in range(90)], "such as '€ 0.3'; remove '€'"),
        ([f"{n} %" for n in range(90)], "such as '0 %'; remove '%'"),
        ([None] * 90, "empty: all its values are missing"),
    ],
)
def test_each_column_left_out_has_a_reason(cells, message):
    frame = pd.DataFrame({"t": cells, "y": np.arange(90) / 8})
    with pytest.warns(UserWarning, match=rf"left out .*'t' \(.*{message}"):
        infer_columns(frame)
    with pytest.raises(ValueError, match=rf"no column can be a target: 't' \(.*{message}.*, 'u' \(constant"):
        infer_columns(pd.DataFrame({"t": cells, "u": "same"}))


def test_an_unknown_separator_is_an_error(tmp_path):
    (tmp_path / "a.csv").write_text("day x y\n" + "".join(f"{n} {n}.5 3\n" for n in range(30)))
    with pytest.raises(
        ValueError, match=r"'day x y' \(neither .*; separators are , ; tab and [|], others are named by"
    ):
        read_panel(tmp_path / "a.csv")


def test_steps_in_columns_cause_a_warning():
    wide = pd.DataFrame({f"d_{n}": np.arange(5) + n / 8 for n in range(60)})
    with pytest.warns(UserWarning, match=r"60 columns, 'd_0' to 'd_59', are numbered; .* frame.melt\(\[\], var_name"):
        infer_columns(wide)
    labelled = wide[[f"d_{n}" for n in range(5)]].assign(country=list("abcde"))
    with pytest.warns(UserWarning, match=r"5 columns, .* frame.melt\(\['country'\]"):
        infer_columns(labelled)
    infer_columns(wide.assign(t=range(5)))


LAYOUTS = {
    "dates as names": (
        "shop,2024-01-01,2024-01-02,2024-01-03\na,1,2,3\nb,4,5,6\n",
        r"3 columns are named by dates, .*melt",
    ),
    "years as names": ("shop,1990,1991,1992\na,1,2,3\nb,4,5,6\n", "3 columns are named by dates"),
    "two rows of names": (
        "day,power,volt\n,MW,V\n2024-01-01,1,2\n2024-01-02,2,3\n",
        "2 header rows, with texts such as 'MW', 'V'",
    ),
    "three rows of names": (
        "Price,Close,Low\nTicker,AA,BB\nDate,,\n2024-01-01,1,2\n2024-01-02,2,3\n",
        "3 header rows",
    ),
    "a total": (
        "day,y\n2024-01-01,1\n2024-01-02,2\n2024-01-03,3\n2024-01-04,4\nTotal,10\n",
        "4 of 5 .* row 4 is 'Total'",
    ),
    "a description": (
        "Station: a\n\nday,y\n2024-01-01,1\n",
        "line 3 has 2 cells and the header in line 1 has 1; .*if lines above the header describe the data, begin",
    ),
    "halves of days": ("day,half,y\n2024-01-01,AM,1\n2024-01-01,PM,2\n2024-01-02,AM,3\n", "two rows at day"),
    "constants": (
        "station,t,y\na,1,2.5\na,2,2.5\nb,1,3.5\nb,2,3.5\n",
        "no column is a target among y; constant within each sequence: y",
    ),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_another_layout_is_an_error_that_describes_it(tmp_path, layout):
    content, message = LAYOUTS[layout]
    (tmp_path / "a.csv").write_text(content)
    with pytest.raises(ValueError, match=message):
        read_panel(tmp_path / "a.csv")


def test_empty_rows_at_the_end_are_left_out_and_empty_lines_are_named(tmp_path):
    (tmp_path / "a.csv").write_text("day,y\n2024-01-01,1.5\n,\n2024-01-03,2.5\n,\n,\n")
    with pytest.warns(UserWarning, match="2 empty rows at the end are left out"):
        assert len(read_frame(tmp_path / "a.csv")) == 3
    (tmp_path / "a.csv").write_text("y\n1.5\n\n2.5\n")
    with pytest.warns(UserWarning, match="empty lines between the values of a single column are skipped"):
        assert len(read_frame(tmp_path / "a.csv")) == 2


def test_ids_separate_sequences_even_if_no_time_repeats():
    firms = pd.DataFrame({"year": [2000, 2001] * 2, "y": [0.5, 1.5, 2.5, 3.5]}, pd.Index([7, 7, 9, 9], name="firm"))
    assert [one.name for one in Panel.of(firms)] == ["7", "9"]
    frame = pd.DataFrame({"patient": [7, 7, 7, 3, 3], "t": [0.5, 2.0, 3.5, 1.0, 7.0], "y": np.arange(5) / 4})
    for table in (frame, frame.drop(columns="t")):
        assert [(one.name, len(one)) for one in Panel.of(table)] == [("3", 2), ("7", 3)]
    doubled = hourly().assign(Date=lambda x: x.when.dt.strftime("%Y-%m-%d"), Time=lambda x: x.when.dt.strftime("%H:%M"))
    with pytest.raises(ValueError, match="two rows at Date Time 2024-01-01 05:00"):
        Panel.of(pd.concat([doubled, doubled[5:6]]).drop(columns="when"))
