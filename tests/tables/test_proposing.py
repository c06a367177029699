"""What a table that nobody described is taken for."""

import numpy as np
import pytest

from dvae.tables import Panel
from dvae.tables.proposing import Told, proposed

pd = pytest.importorskip("pandas")


def families(frame):
    return {column.name: (column.role, column.family) for column in proposed(frame).columns}


def test_families_are_those_that_the_values_have():
    rng = np.random.default_rng(0)
    frame = pd.DataFrame(
        {
            "real": rng.normal(size=200),
            "few": rng.poisson(2, 200),
            "many": rng.negative_binomial(1, 0.1, 200),
            "open": rng.integers(0, 2, 200),
            "flag": np.where(np.arange(200) % 7, rng.integers(0, 2, 200).astype(bool), None),
            "kind": rng.choice(["u", "v"], 200),
            "skewed": rng.gamma(1, size=200),
            "narrow": 100 + rng.normal(size=200),
            "text": [f"text {n}" for n in range(200)],
            "one": ["same"] * 200,
            "empty": [None] * 200,
        }
    )
    with pytest.warns(UserWarning, match="left out of what is proposed") as said:
        found = {name: family for name, (_, family) in families(frame).items()}
    (left_out,) = said
    for name in ("text", "one", "empty"):
        assert f"'{name}' (neither numbers nor 2 to 20 classes" in str(left_out.message)
    assert "such as 'text 0'" in str(left_out.message)
    assert found == {
        "real": "real",
        "few": "count",
        "many": "overdispersed",
        "open": "binary",
        "flag": "binary",
        "kind": "category",
        "skewed": "positive",
        "narrow": "real",
    }
    Panel.of(frame[[*found]])  # and all that is proposed can be read


def panel(**more):
    """Three stations, seven days."""
    days = pd.date_range("2024-01-01", periods=7).strftime("%Y-%m-%d")
    rng = np.random.default_rng(0)
    frame = pd.DataFrame({"day": np.tile(days, 3), "riders": rng.poisson(3, 21), **more})
    return frame


@pytest.mark.parametrize("ids", [[7, 8, 9], ["a", "b", "c"], [7.0, 8.0, 9.0]])
def test_ids_are_what_leaves_one_row_at_a_time(ids):
    found = proposed(panel(station=np.repeat(ids, 7), height=np.repeat([1.5, 2.5, 3.5], 7)))
    assert (found.id, found.time) == (("station",), "day")
    assert [column.role for column in found.columns] == ["target", "static"]


def test_what_repeats_but_is_not_needed_to_tell_rows_apart_is_no_id():
    weather = np.random.default_rng(1).choice(["rain", "sun", "fog"], 21)
    frame = panel(weather=weather, place=np.repeat(["a", "b", "c"], 7))
    assert frame.duplicated(["day", "weather"]).any()
    found = proposed(frame)
    assert found.id == ("place",)
    assert [column.name for column in found.columns] == ["riders", "weather"]


def test_two_columns_are_the_id_where_one_is_not_enough():
    frame = panel(region=np.repeat(["n", "n", "s"], 7), line=np.repeat(["a", "b", "a"], 7))
    assert set(proposed(frame).id) == {"region", "line"}


def test_a_table_of_one_sequence_has_its_id_too():
    frame = panel(station_id=5).iloc[:7]
    found = proposed(frame)
    assert found.id == ("station_id",)
    assert [column.name for column in found.columns] == ["riders"]
    assert Panel.of(frame).series[0].name == "5"


def shops(days, format):
    """Shops and their cities, a row for each day."""
    frame = pd.DataFrame({"date": np.tile(days.strftime(format), 6), "shop": np.repeat(list("abcdef"), len(days))})
    return frame.assign(
        city=np.repeat(["n", "s"], 3 * len(days)), sold=np.random.default_rng(0).normal(size=len(frame))
    )


@pytest.mark.parametrize("format", ["%d/%m/%Y", "%d.%m.%Y", "%m/%d/%Y", "%d-%m-%Y"])
def test_one_day_above_12_tells_days_from_months(format):
    for first in ("2024-01-01", "2024-01-15"):
        days = pd.date_range(first, periods=13)
        panel = Panel.of(shops(days, format))
        assert (panel.columns.id, panel.columns.time) == (("shop",), "date")
        for one in panel:
            np.testing.assert_array_equal(one.times, days.astype("datetime64[s]").astype(int))


@pytest.mark.parametrize("format", ["%d/%m/%Y", "%m.%d.%Y", "%d/%m/%y"])
@pytest.mark.parametrize("freq", ["D", "MS"])
def test_dates_whose_day_and_month_cannot_be_told_apart_are_said_to_be(format, freq):
    frame = shops(pd.date_range("2024-01-01", periods=12, freq=freq), format)
    with pytest.warns(UserWarning, match=r"'date' \(perhaps the time: dates such as '01.01.(20)?24', .* as 2024-12-31"):
        found = proposed(frame)
    assert (found.id, found.time) == (("shop",), None)  # and they tell rows apart
    assert "date" not in found.names
    with pytest.warns(UserWarning, match="perhaps the time"):
        Told(columns=("sold",)).of(frame)
    with pytest.raises(ValueError, match=r"column 'date' holds dates such as '01.01.(20)?24'"):
        Panel.of(frame, Told(time="date"))
    with pytest.raises(ValueError, match=r"dates such as '01.01.(20)?24'"):
        Panel.wide(frame.pivot(index="date", columns="shop", values="sold"))
    Told(columns=("sold",), past=("date:category",), id=("shop",)).of(frame)  # what is named is not left out


def test_the_numbers_of_rows_that_pandas_writes_are_left_out():
    frame = panel(station=np.repeat(["a", "b", "c"], 7))
    written = frame.reset_index(names="Unnamed: 0")
    with pytest.warns(UserWarning, match=r"'Unnamed: 0' \(the numbers of the rows, without a name\)"):
        assert proposed(written) == proposed(frame)
    measured = written.assign(**{"Unnamed: 0": frame.riders})
    assert "Unnamed: 0" in proposed(measured).names
    assert Told(columns=("riders",), past=("Unnamed: 0",)).of(written).names == ["riders", "Unnamed: 0"]


def test_numbers_that_are_written_as_texts_are_named():
    prices = [f"{n},234.50" for n in range(10, 31)]
    with pytest.warns(UserWarning, match="left out of what is proposed: 'price' .*, such as '10,234.50'"):
        assert "price" not in proposed(panel(price=prices)).names


def test_texts_of_which_one_is_a_date_are_no_dates():
    frame = panel(said=["1/2/2024", *(f"{n}th of them" for n in range(20))])
    with pytest.warns(UserWarning, match=r"'said' \(neither numbers nor 2 to 20 classes, such as '1/2/2024'\)"):
        proposed(frame.drop(columns="day"))


def test_dates_with_offsets_that_change_are_a_time():
    frame = pd.DataFrame({"when": ["2020-03-28T00:00+01:00", "2020-03-30T00:00+02:00"], "y": [1.5, 2.5]})
    assert proposed(frame).time == "when"


def test_numbers_with_the_name_of_a_time_are_one():
    frame = pd.DataFrame({"y": [0.5, 1.5, 2.5], "year": [2001, 2002, 2003]})
    assert proposed(frame).time == "year"
    assert proposed(frame.rename(columns={"year": "yearly"})).time is None


def test_what_is_told_goes_before_what_is_proposed():
    frame = panel(
        station=np.repeat([7, 8, 9], 7), plan=np.arange(21.0), temp=np.arange(21) % 5, mood=["u", "v", "w"] * 7
    )
    found = Told(covariates=("plan",), past=("temp", "mood:category")).of(frame)
    assert [(c.name, c.role, c.family) for c in found.columns] == [
        ("riders", "target", "count"),
        ("plan", "known", "real"),
        ("temp", "past", "real"),
        ("mood", "past", "category"),
    ]
    named = Told(columns=("riders:overdispersed:people",), static=("station",)).of(
        frame.assign(a=np.repeat([1, 2, 3], 7))
    )
    assert next((c.name, c.family, c.unit) for c in named.columns) == ("riders", "overdispersed", "people")
    assert [c.name for c in named.targets] == ["riders"]


def test_a_name_may_have_colons():
    frame = pd.DataFrame({"a:b": [0.5, 1.5], "c": [0.5, 1.0]})
    assert Told(columns=("a:b", "c:positive:m:s")).of(frame).columns[1].unit == "m:s"
    (only,) = Told(columns=("a:laplace:b",)).of(frame.set_axis(["a", "c"], axis=1)).columns
    assert (only.name, only.family, only.unit) == ("a", "laplace", "b")


@pytest.mark.parametrize(
    ("told", "said"),
    [
        ({"columns": ("ridrs",)}, r"no column 'ridrs' \(did you mean 'riders'\?\)"),
        ({"id": ("dy",)}, r"no column 'dy' \(did you mean 'day'\?\)"),
        ({"time": "dya"}, r"no column 'dya' \(did you mean 'day'\?\)"),
        ({"group": "x"}, "no column 'x'; there are day, riders"),
        ({"columns": ("riders",), "past": ("riders",)}, "column 'riders' is named twice"),
        ({"columns": ("riders:cout",)}, r"family 'cout' \(did you mean 'count'\?\)"),
        ({"columns": ("riders",), "time": "riders"}, "'riders' has two parts to play"),
        ({"covariates": ("riders",)}, "no column is a target"),
    ],
)
def test_what_is_told_wrongly_is_refused(told, said):
    with pytest.raises(ValueError, match=said):
        Told(**told).of(panel().iloc[:7])
