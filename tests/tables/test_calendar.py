"""Future times follow the calendar step and the time zone of a table, in every form of its times."""

from dataclasses import replace

import numpy as np
import pytest

from dvae.tables import ColumnHints, Cut, Panel, PanelData, Series
from dvae.tables.ahead import ahead
from dvae.tables.calendar import FEATURES, Calendar, functions_of_time, seconds
from dvae.tables.columns import Column, Columns
from dvae.tables.encoding import PanelSchema

pd = pytest.importorskip("pandas")

ZONES = [None, "Europe/Berlin", "America/New_York", "UTC+02:00"]

STEPS = ["MS", "ME", "QS", "QE", "YS-JUL", "YE", "BMS", "BME", "WOM-3FRI", "W-SUN", "2W-WED", "B", "D", "h", "15min"]


def frame_of(index, **columns):
    values = np.random.default_rng(0).normal(size=len(index))
    return pd.DataFrame({"time": index, "y": values, **columns})


def future(frame, steps=8, **hints):
    """The times after the end of a table."""
    data = PanelData.of(frame, ColumnHints(("y",), time="time", **hints), Cut(2, 1, split="time"))
    windows = data.ahead(steps)
    times, calendar = windows.times(2 + steps)
    return calendar.to_pandas(times[0, 2:])


@pytest.mark.parametrize(
    ("step", "zone"), [(step, ZONES[(n + k) % 4]) for n, step in enumerate(STEPS) for k in (n % 2,)]
)
def test_times_continue_by_the_calendar(step, zone):
    """Across both clock changes, from timestamps and from their texts."""
    index = pd.date_range("2023-08-01 00:00", periods=40, freq=step, tz=zone)
    assert future(frame_of(index[:-8])).equals(index[-8:].as_unit("us"))
    texts = index.astype(str)
    assert future(frame_of(texts[:-8]), zone=zone).equals(index[-8:].as_unit("us"))


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        (pd.period_range("2023-01", periods=12, freq="M"), "2024-01-01"),
        (pd.date_range("2023-01-01", periods=12, freq="MS") + pd.Timedelta("14D 12h"), "2024-01-15 12:00"),
        (["2023-01-30", "2023-02-28", "2023-04-30", "2023-05-30", "2023-07-30", "2023-08-30"], "2023-09-30"),
        ([*pd.bdate_range("2023-01-02", "2023-01-27").delete([5, 11])], "2023-01-30"),
        ([day for day in pd.date_range("2023-01-02", "2023-03-04") if day.weekday() != 6], "2023-03-06"),
        ([day for day in pd.date_range("2023-01-02", "2023-03-03") if day.weekday() in (0, 2, 4)], "2023-03-06"),
        (["2023-01-02", "2023-01-05", "2023-01-07", "2023-01-10", "2023-01-16"], "2023-01-19"),
        (pd.DatetimeIndex(["2024-10-19", "2024-10-22", "2024-10-24", "2024-10-26"], tz="Europe/Berlin"),
            pd.Timestamp("2024-10-28", tz="Europe/Berlin")),
    ],
    ids=["periods", "15th", "30th with a gap", "holidays", "no Sundays", "three days", "irregular", "new clocks"],
)  # fmt: skip
def test_steps_are_inferred_from_any_day_and_with_missing_rows(times, expected):
    assert future(frame_of(times))[0] == pd.Timestamp(expected)


def test_a_week_without_some_days_is_a_season():
    days = pd.date_range("2023-01-02", periods=60)
    for skipped, step, season in ((6, "MON-TUE-WED-THU-FRI-SAT", 6), (0, "TUE-WED-THU-FRI-SAT-SUN", 6), (7, "1D", 7)):
        calendar = Panel.of(frame_of(days[days.day_of_week != skipped])).calendar
        assert (calendar.step, calendar.usual_season, calendar.skips_days) == (step, season, season < 7)
    with pytest.raises(ValueError, match="step is 'MON-'; expected a calendar step such as"):
        Calendar("dates", step="MON-")


def test_forecasts_over_closing_hours_cause_a_warning():
    hours = pd.date_range("2023-01-02", periods=24 * 40, freq="h")
    opening, weekdays = hours[(hours.hour >= 9) & (hours.hour < 17)], hours[hours.day_of_week < 5]
    for times in (opening, weekdays):
        with pytest.warns(UserWarning, match="all rows are at some hours of the day or some days of the week"):
            assert future(frame_of(times))[0] == times[-1] + pd.Timedelta("1h")
        assert Panel.of(frame_of(times)).usual_season == 0
    random = np.random.default_rng(0)
    for times in (hours, hours[np.sort(random.permutation(len(hours))[:800])], hours[9:17]):  # all, some, a few hours
        future(frame_of(times))
        assert Panel.of(frame_of(times)).usual_season == 24


def test_a_short_sequence_keeps_the_days_of_the_others():
    days = pd.date_range("2024-01-01", periods=90)
    for keeps, length, following in (((0, 2, 4), 3, "2024-01-08"), ((0, 1, 2, 3, 4, 5), 5, "2024-01-06")):
        long = days[np.isin(days.day_of_week, keeps)]
        data = PanelData.of(
            pd.concat([frame_of(long, shop="a"), frame_of(long[:length], shop="b")]),
            ColumnHints(("y",), id=("shop",), time="time"),
            Cut(2, 1, split="time"),
        )
        times, calendar = data.ahead(1).times(3)
        assert calendar.to_pandas(times[1, 2:])[0] == pd.Timestamp(following)


WORKDAYS = [seconds(pd.bdate_range("2024-01-01", periods=count)) for count in (12, 12, 1)]


@pytest.mark.parametrize(
    ("times", "calendar", "following"),
    [
        (WORKDAYS, Calendar("dates"), WORKDAYS[0][1:3]),
        ([np.arange(9) * 0.5, np.ones(1)], Calendar(), [1.5, 2]),
    ],
    ids=["dates", "numbers"],
)
def test_a_short_sequence_takes_its_step_from_the_others_or_the_training_data(times, calendar, following):
    series = [Series(f"s{n}", np.zeros((len(steps), 1)), steps) for n, steps in enumerate(times)]
    panel = Panel(series, Columns((Column("y"),)), calendar=calendar.stepping(times))
    schema = PanelSchema.from_data(panel, Cut(1, 1, split="time"))
    for table in (panel, Panel(series[-1:], panel.columns, calendar=calendar)):
        np.testing.assert_array_equal(ahead(table, schema, 2).times(3)[0][-1, 1:], following)


BERLIN = pd.date_range("2024-10-26", periods=60, freq="h", tz="Europe/Berlin")


@pytest.mark.parametrize("order", [slice(None), slice(None, None, -1)])
def test_the_repeated_hour_of_a_clock_change_is_two_hours(order):
    local = BERLIN.tz_localize(None)
    two = frame_of([*BERLIN.astype(str)[order]] * 2, s=np.repeat(["a", "b"], 60))
    hints = {"id": ("s",), "time": "time"}
    panel = Panel.of(two, ColumnHints(("y",), **hints))
    naive = Panel.of(two.assign(time=[*local[order]] * 2), ColumnHints(("y",), zone="Europe/Berlin", **hints))
    for one, other in zip(panel, naive, strict=True):
        np.testing.assert_array_equal(one.times, seconds(BERLIN))
        np.testing.assert_array_equal(other.times, one.times)
    assert (panel.calendar.zone, naive.calendar.zone) == ("UTC", "Europe/Berlin")  # offsets that change name no zone


@pytest.mark.parametrize(
    ("local", "zone", "message"),
    [
        (BERLIN.tz_localize(None), None, "two rows at time 2024-10-27 02:00:00, 26 and 27; .* clocks were set back"),
        (BERLIN.tz_localize(None).delete(26), "Europe/Berlin", r"row 26 of column 'time' is 2024-10-27 02:00:00, .* "
            r"clocks of Europe/Berlin show twice, .* as in 2024-10-27T02:00:00\+02:00, or leave the zone out"),
        (pd.date_range("2024-03-31", periods=9, freq="h"), "Europe/Berlin", "row 2 .* 02:00:00, .* clocks .* skip"),
        (range(9), "Europe/Berlin", "holds numbers; leave the zone out"),
        (range(9), "Europe/Berln", "zone is 'Europe/Berln'; expected a name such as"),
    ],
)  # fmt: skip
def test_ambiguous_and_nonexistent_times_are_named(local, zone, message):
    with pytest.raises(ValueError, match=message):
        future(frame_of(local), zone=zone)


def test_days_of_an_unnamed_time_zone_cause_a_warning():
    days = pd.date_range("2024-10-20", periods=20, tz="Europe/Berlin")
    for times in (days.astype(str), days.tz_convert("UTC"), days.tz_convert("UTC").tz_localize(None)):
        with pytest.warns(UserWarning, match="seem to be days of a time zone whose clocks change, .* name the zone"):
            assert future(frame_of(times))[0].time() == pd.Timestamp("23:00").time()


SPANS = pd.timedelta_range("0h", periods=30, freq="90min")


@pytest.mark.parametrize(
    "spans", [SPANS, SPANS.astype(str), [f"{n * 3 // 2:02d}:{n % 2 * 30:02d}:00" for n in range(30)]]
)
def test_durations_are_times(spans, tmp_path):
    following = future(frame_of(spans))
    assert following.equals((SPANS[-1] + SPANS[1:9]).as_unit("us"))
    for panel in (Panel.of(frame_of(spans)), Panel.of(frame_of(spans).set_index("time"))):
        assert panel.columns.time == "time"
        np.testing.assert_array_equal(panel.series[0].times, SPANS.total_seconds())
    wide = Panel.wide(frame_of(spans).set_index("time"))
    np.testing.assert_array_equal(wide.series[0].times, SPANS.total_seconds())


@pytest.mark.parametrize(("first", "second", "ends"), [(1, 1, "0.5 in row 20"), (1, -1, "18.5 in row 21"), (-1, 1, "")])
def test_recordings_with_overlapping_times_are_an_error(first, second, ends):
    clock = np.concatenate([np.arange(20.0)[::first], 0.5 + np.arange(20)[::second]])
    message = (
        f"goes back from time .* to {ends}.*; name the id columns that distinguish sequences, or, .* sort its rows"
    )
    with pytest.raises(ValueError, match=message):
        Panel.of(frame_of(clock))
    with pytest.raises(ValueError, match="the table panel goes back from time"):
        Panel.wide(frame_of(clock).set_index("time"))
    assert len(Panel.of(frame_of(clock, s=np.repeat(["a", "b"], 20)), ColumnHints(id=("s",)))) == 2


@pytest.mark.parametrize(
    "order",
    [np.arange(40)[::-1], np.random.default_rng(0).permutation(40), np.r_[0:9, 12:40, 9:12]],
    ids=["reversed", "shuffled", "late"],
)
def test_rows_are_sorted_by_time(order):
    panel = Panel.of(frame_of(np.arange(40.0)).iloc[order])
    np.testing.assert_array_equal(panel.series[0].times, np.arange(40))


def test_a_calendar_is_saved_with_a_run_and_validated():
    data = PanelData.of(
        frame_of(pd.date_range("2020", periods=40, freq="MS", tz="Europe/Berlin")), cut=Cut(4, 3, split="time")
    )
    assert repr(data.panel) == "Panel(panel: 1 sequences of 40 steps; dates by 1MS, Europe/Berlin; y)"
    assert PanelSchema.from_config(data.schema.config()) == data.schema
    assert replace(data.schema.calendar, gap=0) == Calendar("dates", "Europe/Berlin", "1MS")
    for zone, step in (("../../etc/passwd", "1D"), ("dateutil//etc/x", "1D"), ("UTC", "99999D"), ("UTC", "x")):
        with pytest.raises(ValueError, match="expected"):
            PanelSchema.from_config({**data.schema.config(), "calendar": {"kind": "dates", "zone": zone, "step": step}})


@pytest.mark.parametrize("zone", ZONES)
def test_calendar_features_are_local(zone):
    dates = pd.date_range("2023-01-01", "2024-12-31 23:00", freq="h", tz=zone)
    features = Calendar("dates", zone).features(seconds(dates), FEATURES)
    ends = np.cumsum([*FEATURES.values()])
    hour, weekday, month, day = np.split(features, ends[:-1], axis=1)
    assert day.shape[1] == FEATURES["day_of_year"]
    np.testing.assert_array_equal(weekday.argmax(1), dates.day_of_week)
    np.testing.assert_array_equal(weekday.sum(1), 1)
    for part, cycle, expected in [(hour, 24, dates.hour), (month, 12, dates.month - 1)]:
        angle = np.arctan2(part[:, 0], part[:, 2]) % (2 * np.pi)
        np.testing.assert_allclose(angle, 2 * np.pi * np.asarray(expected) / cycle, atol=1e-9)
        second = np.arctan2(part[:, 1], part[:, 3])
        np.testing.assert_allclose(np.exp(1j * second), np.exp(2j * angle), atol=1e-9)
    steps = np.linalg.norm(np.diff(day[:: 24 * 7], axis=0), axis=1)  # weeks are evenly spaced, also over the new year
    assert steps.max() < 1.3 * steps.min()


def daily(days=120, n=3, start="2024-01-01"):
    dates = np.tile(pd.date_range(start, periods=days), n)
    frame = pd.DataFrame({"site": np.repeat([*"abcdef"][:n], days), "date": dates})
    return frame.assign(y=np.random.default_rng(0).normal(size=len(frame)))


def test_calendar_features_continue_beyond_the_table_without_further_rows():
    frame = daily().assign(z=1.5)
    hints = ColumnHints(("y",), past=("z",), id=("site",), time="date", calendar=("weekday", "month"))
    data = PanelData.of(frame, hints, Cut(14, 7, split="time"))
    assert data.schema.sizes["c"] == 2 + 7 + 4
    c = data.ahead().all()["c"]
    following = pd.date_range("2024-01-01", periods=127)[-21:]
    np.testing.assert_array_equal(c[0, :, 2:9].argmax(1), following.day_of_week)
    np.testing.assert_allclose(c[0], c[1])
    whole = PanelSchema.from_config(data.schema.config())
    assert whole == data.schema
    np.testing.assert_allclose(whole.context(data.panel.series[0])[-14:, 2:], c[0, :14, 2:], atol=1e-6)
    fewer = PanelData.of(frame, replace(data.panel.columns, calendar=("weekday",)), data.protocol)
    assert fewer.windows("test").fingerprint != data.windows("test").fingerprint
    with pytest.raises(ValueError, match="the zone UTC, but the zone of the training data is None; calendar features"):
        data.with_data(frame.assign(date=frame.date.dt.tz_localize("UTC"))).windows("test")


def test_calendar_features_require_dates():
    frame = daily().assign(day=lambda each: each.groupby("site").cumcount())
    with pytest.raises(
        ValueError, match="calendar is hour, but the times of panel are numbers; calendar features need"
    ):
        Panel.of(frame, ColumnHints(("y",), id=("site",), time="day", calendar=("hour",)))
    with pytest.raises(ValueError, match="calendar is hour, but the times of panel are missing"):
        Panel.of(np.zeros((2, 5, 1)), Columns((Column("x"),), calendar=("hour",)))


def test_functions_of_the_time_are_found_and_others_are_not():
    frame = daily(days=800, n=2)
    random, dates = np.random.default_rng(1), frame.date.dt
    on_day = lambda values: np.tile(values, 2)  # noqa: E731
    functions = {
        "weekday": dates.day_of_week,
        "weekend": dates.day_of_week > 4,
        "month": dates.month,
        "day of the month": dates.day < 10,
        "day_of_year": (dates.month == 12) & (dates.day == 25),
        "time": dates.year + dates.day_of_year / 365.25,
        "date": on_day(random.random(800) < 0.1),
    }
    others = {
        "noise": random.normal(size=1600),
        "flag": random.random(1600) < 0.5,
        "rare": np.arange(1600) == 700,
        "price": on_day(random.normal(size=800)),  # equal in all sequences, but not known in the future
        "trend": np.arange(1600) % 800 + random.normal(0, 20, 1600),
    }
    values = {name: np.asarray(each, float) for name, each in (functions | others).items()}
    values["year"] = np.asarray(dates.year, float)
    values["age"] = values["year"] - 1980
    values["weekday"][5:50] = np.nan
    owners = np.repeat([0, 1], 800)
    found = functions_of_time(values, seconds(pd.DatetimeIndex(frame.date)), Calendar("dates"), owners)
    expected = {name: name for name in functions} | {"weekend": "weekday", "year": "time", "age": "time"}
    assert found == expected
    single = {name: each[:800] for name, each in values.items()}
    found = functions_of_time(single, seconds(pd.DatetimeIndex(frame.date[:800])), Calendar("dates"), owners[:800])
    del expected["date"]  # one sequence does not show that a date determines a value
    assert found == expected
