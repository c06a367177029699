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
    found = {name: family for name, (_, family) in families(frame).items()}
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
    Panel.of(frame)  # and all that is proposed can be read


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
