"""A schema of columns survives writing and reading, and an invalid one is an error of one sentence."""

import json
import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvae.distributions.family import FAMILIES
from dvae.tables import Column, Columns
from dvae.tables.calendar import FEATURES
from dvae.tables.columns import MOST, ROUNDED, parsed
from dvae.tables.protocol import Cut
from dvae.tables.reading import read_schema, written_schema

ODD = ("", "a.b", 'say "x"', "\\", "\n\r\t\0\x7f\x85", "'''", '"""', "[columns.x]", "columns", "🚲", "# no", "id")
NAMES = st.text(st.characters(exclude_categories=["Cs"]), max_size=12) | st.sampled_from(ODD)


@st.composite
def column(draw, name, role):
    families = list(FAMILIES) if role == "target" else ["real", "category"]
    family = draw(st.sampled_from(families))
    classes = draw(st.lists(NAMES, min_size=2, max_size=4, unique=True)) if family == "category" else ()
    rounding = draw(st.sampled_from([0.0, 0.1, 2.5])) if role == "target" and family in ROUNDED else 0.0
    return Column(name, role, family, draw(NAMES), tuple(classes), draw(st.sampled_from(["", *classes])), rounding)


@st.composite
def schemas(draw):
    names = iter(draw(st.lists(NAMES.filter(bool), min_size=7, max_size=9, unique=True)))
    special = {"id": (next(names), next(names))[: draw(st.integers(0, 2))]}
    special |= {name: draw(st.none() | st.just(next(names))) for name in ("time", "group", "split")}
    special |= {"zone": draw(st.sampled_from([None, "Europe/Berlin", "+02:00"]))} if special["time"] else {}
    special |= {"calendar": tuple(draw(st.lists(st.sampled_from([*FEATURES]), unique=True)))}
    special |= {"lags": tuple(draw(st.lists(st.integers(1, 400), unique=True, max_size=3)))}
    roles = ["target", *draw(st.lists(st.sampled_from(["target", "known", "past", "static"]), max_size=3))]
    return Columns(tuple(draw(column(name, role)) for name, role in zip(names, roles, strict=False)), **special)


@given(
    schemas(),
    st.builds(
        Cut,
        observed=st.just(7),
        horizon=st.integers(1, 9),
        stride=st.none() | st.integers(1, 9),
        split=st.sampled_from(["sequence", "time", "group"]),
        validation=st.floats(0, 0.4),
        test=st.floats(0, 0.5),
        seed=st.integers(0, 9),
    )
    | st.just(Cut()),
)
def test_a_schema_survives_toml_with_its_cut_and_json(columns, cut):
    assert Columns.from_toml(columns.to_toml()) == columns
    assert read_schema(written_schema(columns, cut)) == (columns, cut)
    assert Columns.from_config(json.loads(json.dumps(columns.config()))) == columns


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tme = 'x'\n[columns.a]", r"entry 'tme' \(did you mean 'time'\?\)"),
        ("[columns.a]\nfamly = 'count'", r"column 'a' has an entry 'famly' \(did you mean 'family'\?\)"),
        ("[columns.a]\nfamily = 'cont'", r"family 'cont' \(did you mean 'count'\?\); a target has one of real"),
        ("[columns.a]\n[columns.b]\nrole = 'past'\nfamily = 'count'", "a past has one of real, category"),
        ("[columns.a]\nfamily = 'category'", "0 classes; a category needs classes"),
        ("[columns.a]\nfamily = 'category'\nclasses = ['u', 'u']", "has 2 classes, .* all different"),
        ("[columns.a]\nrole = 'known'", "no column is a target among a"),
        ("id = 5\n[columns.a]", "id is 5; expected names of columns"),
        ("time = 5\n[columns.a]", "time is 5; expected the name of a column"),
        ("time = 'a'\n[columns.a]", "column 'a' has two roles"),
        ("time = ''\n[columns.a]", "a column has no name"),
        ("time = 'a'\nzone = 'Berlin'\n[columns.b]", "zone is 'Berlin'; expected a name such as 'Europe/Berlin'"),
        ("zone = 'UTC'\n[columns.b]", "zone is 'UTC', but no column is the time"),
        ("[columns.a]\nfamily = 'category'\nclasses = ['b', 'c']\nother = 'd'", "other = 'd'.* not one of its classes"),
        ("calendar = ['weekdy']\n[columns.a]", r"weekdy; expected some of hour, .*did you mean 'weekday'"),
        ("calendar = ['hour', 'hour']\n[columns.a]", "hour, hour; expected some of hour, .* at most once"),
        ("calendar = [3]\n[columns.a]", r"calendar is \[3\]; expected features, such as"),
        ("lags = [7, 7]\n[columns.a]", "lags are 7, 7; expected different numbers of steps, from 1"),
        ("lags = [0]\n[columns.a]", "lags are 0; expected different numbers of steps, from 1"),
        ("lags = 7\n[columns.a]", r"lags is 7; expected numbers of steps, such as \[7, 14\]"),
        ("lags = ['7']\n[columns.a]", r"lags is \['7'\]; expected numbers of steps"),
        ("[columns.a]\nfamily = 'count'\nrounding = 1", "rounding = 1, but is a target of family 'count'; rounding is"),
        (
            "[columns.a]\n[columns.b]\nrole = 'past'\nrounding = 1",
            "is a past of family 'real'; rounding is for targets",
        ),
        ("[columns.a]\nrounding = -1", "rounding is -1"),
        ("[columns]\na = 3", "column 'a' is 3; expected a table"),
        ("[cut]\nobservd = 3", r"entry 'observd' \(did you mean 'observed'\?\)"),
        ("[cut]\nobserved = 3", "give both, or neither"),
        ("\n".join(f"[columns.a{n}]" for n in range(MOST + 1)), f"at most {MOST} are read"),
    ],
)
def test_an_invalid_schema_is_an_error_of_one_sentence(text, message):
    with pytest.raises(ValueError, match=message):
        read_schema(text)


def test_default_features_and_rounding_change_no_stored_schema_or_fingerprint():
    columns = Columns((Column("a"),), time="day")
    assert columns.config().keys() == {"id", "time", "group", "split", "columns"}
    assert columns.config()["columns"]["a"].keys() == {"role", "family", "unit", "classes"}
    other = Columns((Column("a", rounding=0.5),), time="day", calendar=("hour",))
    assert repr(other) == repr(columns)
    assert other.config() != columns.config()


def test_a_category_has_a_maximal_number_of_classes_and_they_may_contain_dots():
    classes = tuple(f"A{n}.{n}" for n in range(300))
    columns = Columns((Column("a.b.c", family="category", classes=classes),))
    assert Columns.from_toml(columns.to_toml()) == columns
    with pytest.raises(ValueError, match=f"2 to {MOST}") as error:
        Column("a", family="category", classes=tuple(map(str, range(MOST + 1))))
    assert len(str(error.value)) < 300


@pytest.mark.parametrize(
    "text",
    [
        "a = " + "[" * 100_000,
        ".".join("a" * 400_000) + " = 1",
        ".".join(['"a.b"'] * 100_000) + " = 1",
        'x = {"a" = "\\"", ' + ".".join("a" * 300_000) + " = 1}",
    ],
    ids=["lists", "key", "quoted", "within"],
)
def test_deeply_nested_tables_are_an_error(text, monkeypatch):
    if "." in text:  # tomllib takes quadratic time for dotted keys
        monkeypatch.setattr(tomllib, "loads", None)
    with pytest.raises(ValueError, match="nested too deeply"):
        parsed(text)


def test_correcting_a_column_keeps_its_place_and_the_others():
    sky = Column("sky", family="category", classes=("clear", "rain"))
    columns = Columns((sky, Column("riders"), Column("plan", "known")), ("station",), "day")
    corrected = columns.but("riders", family="count", unit="people").but("sky", role="known")
    assert corrected.columns[1:] == (Column("riders", family="count", unit="people"), Column("plan", "known"))
    assert corrected.columns[0].classes == sky.classes
    assert (corrected.id, corrected.time) == (columns.id, columns.time)
    assert columns.but("sky", family="binary").columns[0] == Column("sky", family="binary")
    assert columns.without("plan", "sky").names == ["riders"]
    for call, message in [
        (lambda: columns.but("ridrs", unit="people"), r"no column 'ridrs' \(did you mean 'riders'\?\)"),
        (lambda: columns.without("sky", "riders"), "no column is a target"),
        (lambda: columns.without("pln"), r"no column 'pln' \(did you mean 'plan'\?\)"),
    ]:
        with pytest.raises(ValueError, match=message):
            call()
