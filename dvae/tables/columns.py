"""Columns: type and role of each column of a table, as a small schema file next to the table.

id = ["station"]                      # identify sequences
time = "date"                         # or ["date", "hour"], which are joined
zone = "Europe/Berlin"                # time zone, if the times do not name it
na_values = ["?"]                     # mark missing values
calendar = ["weekday", "month"]       # covariates computed from the time: hour, weekday, month, day_of_year
lags = [28, 365]                      # covariates: earlier values of the targets, at or above the horizon
group = "region"                      # group of each sequence, for panels
split = "part"                        # train, validation or test, if the data define it

[columns.riders]                      # a target, by default
family = "count"                      # one of dvae.distributions.FAMILIES
unit = "people"

[columns.temperature]
role = "known"                        # a covariate that is also known in the future, such as a plan
unit = "°C"

[columns.level]
rounding = 0.5                        # values are rounded to multiples of this, or "auto"

[columns.weather]
role = "past"                         # a covariate that is known up to the present
family = "category"
classes = ["clear", "rain", "else"]
other = "else"                        # the class of every other value

[columns.height]
role = "static"                       # one value for each sequence
"""

from __future__ import annotations

import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from reprlib import repr as brief
from typing import Any, Literal, Self

from ..distributions.family import FAMILIES
from ..options import Amount, check, nearest, tuples
from .calendar import FEATURES, check_zone

Role = Literal["target", "known", "past", "static"]
WHOLE_STEPS = ("correlated",)
"""Families with one joint distribution over all their columns, whose values are observed or missing together."""
ROUNDED = ("real", "fixed", "robust", "laplace", "mixture", "correlated", "positive", "log-normal", "share")
"""Families that allow rounding noise."""
MOST = 4096
"""Maximum number of columns of a table, and of classes of a column."""
_CHAIN = re.compile(r"""(?<![\w-])(?:(?:[\w-]++|"(?:\\.|[^"\\\n])*+"|'[^'\n]*+')\s*\.\s*){64}""")
"""A dotted key deeper than in any schema; `tomllib` takes quadratic time to parse it."""


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Args:
        name: name of the column.
        role: "target" for modelled data, "known" for covariates known in the future, "past" for covariates known up to
            the present, "static" for one value per sequence.
        family: family of the values, one of `dvae.distributions.FAMILIES`; for covariates "category" or "real".
        unit: unit of the values, for tables and figures.
        classes: classes of a category, in the order of its coordinates.
        other: class that represents every unlisted value; "" raises an error for such values.
        rounding: unit to which the values of a continuous target are rounded; models add uniform noise of this width
            (`dvae.data.views.Dequantised`). 0 for none; "auto" for the largest unit, 1 or 5 times a power of 10, of
            which all values are multiples. `Panel` replaces "auto".

    Raises:
        ValueError: if the family is unknown, a category has no classes, `other` is not one of them, or rounding does
            not apply to the family.
    """

    name: str
    role: Role = "target"
    family: str = "real"
    unit: str = ""
    classes: tuple[str, ...] = ()
    other: str = field(default="", repr=False)  # fingerprints of panels include the fields above
    rounding: Amount | Literal["auto"] = field(default=0.0, repr=False)

    def __post_init__(self) -> None:
        check(self)
        families = FAMILIES if self.role == "target" else ("real", "category")
        if self.family not in families:
            raise ValueError(
                f"column {self.name!r} has family {self.family!r}{nearest(self.family, families)}; a {self.role} has "
                f"one of {', '.join(families)}"
            )
        if (self.family == "category") != bool(self.classes):
            raise ValueError(
                f"column {self.name!r} has family {self.family!r} and {len(self.classes)} classes; a category "
                'needs classes = ["…", "…"], and no other family has them'
            )
        if len(set(self.classes)) < len(self.classes) or len(self.classes) == 1 or len(self.classes) > MOST:
            raise ValueError(
                f"column {self.name!r} has {len(self.classes)} classes, {brief(self.classes)}; expected 2 to {MOST}, "
                "all different"
            )
        if self.other and self.other not in self.classes:
            raise ValueError(
                f"column {self.name!r} has other = {self.other!r}{nearest(self.other, self.classes)}, which is not one "
                f"of its classes, {brief(self.classes)}; add it to them"
            )
        if self.rounding and (self.role != "target" or self.family not in ROUNDED):
            raise ValueError(
                f"column {self.name!r} has rounding = {self.rounding}, but is a {self.role} of family "
                f"{self.family!r}; rounding is for targets of a continuous family: {', '.join(ROUNDED)}"
            )

    @property
    def coordinates(self) -> list[str]:
        """Names of the column's coordinates in x; a category has one for each class."""
        return [f"{self.name}={label}" for label in self.classes] or [self.name]


@dataclass(frozen=True)
class Columns:
    """The schema of a table's columns.

    Args:
        columns: the columns to read, in order.
        id: names of the columns that identify sequences; empty for a single sequence.
        time: name of the column that orders rows, with dates or numbers, or names of columns that are joined to one
            time (`dvae.tables.clocks`); None keeps the order of the rows.
        group: name of a column that is constant within each sequence, for panels.
        split: name of a column with values "train", "validation" or "test".
        zone: time zone, such as "Europe/Berlin", of dates without an offset from UTC.
        na_values: texts or numbers that mark missing values, in addition to empty cells and NaN.
        decimal: "." or ",", the decimal sign of numbers in text; None to infer it.
        calendar: covariates that are computed from the time, of `dvae.tables.calendar.FEATURES`. They are known in the
            future. Any other calendar, such as holidays, is a column with the role "known".
        lags: numbers of steps back to earlier values of the targets, which models read as covariates. At or above the
            horizon, they are known in the future.

    Raises:
        ValueError: if two columns share a name, no column is a target, the zone is unknown or given without a time, or
            the decimal sign, a calendar feature or a lag is invalid.
    """

    columns: tuple[Column, ...]
    id: tuple[str, ...] = ()
    time: str | tuple[str, ...] | None = None
    group: str | None = None
    split: str | None = None
    zone: str | None = field(default=None, repr=False)  # fingerprints of panels include times and values
    na_values: tuple[str, ...] = field(default=(), repr=False)
    decimal: str | None = field(default=None, repr=False)
    calendar: tuple[str, ...] = field(default=(), repr=False)
    lags: tuple[int, ...] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        for name in self.calendar:
            if name not in FEATURES or self.calendar.count(name) > 1:
                raise ValueError(
                    f"calendar is {', '.join(self.calendar)}; expected some of {', '.join(FEATURES)}, each at most once"
                    f"{nearest(name, FEATURES)}"
                )
        if len({*self.lags}) < len(self.lags) or any(lag < 1 for lag in self.lags):
            raise ValueError(f"lags are {', '.join(map(str, self.lags))}; expected different numbers of steps, from 1")
        if not isinstance(self.time, str | None):
            time = tuple(self.time)
            object.__setattr__(self, "time", time if len(time) > 1 else (*time, None)[0])
        if self.decimal not in (None, ".", ","):
            raise ValueError(f'decimal is {self.decimal!r}; expected "." or ","')
        names = [*self.names, *self.id, *self.times, *(each for each in (self.split,) if each is not None)]
        if "" in (*names, self.group):
            raise ValueError("a column has no name; give it one")
        if len(names) > MOST:
            raise ValueError(f"the schema names {len(names)} columns; at most {MOST} are read, so leave some out")
        if not self.targets:
            raise ValueError(f"no column is a target among {', '.join(self.names[:20]) or 'none'}")
        if repeated := [name for name, count in Counter(names).items() if count > 1]:
            raise ValueError(f"column {repeated[0]!r} has two roles; every column must have one")
        if self.zone is not None:
            check_zone(self.zone)
            if self.time is None:
                raise ValueError(f"zone is {self.zone!r}, but no column is the time; name the column")

    def of(self, *roles: Role) -> list[Column]:
        """Return the columns with one of these roles.

        Args:
            roles: roles: "target", "known", "past" or "static".
        """
        return [column for column in self.columns if column.role in roles]

    @property
    def times(self) -> tuple[str, ...]:
        """Names of the time columns."""
        return (self.time,) if isinstance(self.time, str) else self.time or ()

    @property
    def targets(self) -> list[Column]:
        """Columns that are modelled."""
        return self.of("target")

    @property
    def names(self) -> list[str]:
        """Names of the columns that are read."""
        return [column.name for column in self.columns]

    @property
    def needed(self) -> list[str]:
        """Names of all columns that a table must have."""
        return [*self.id, *self.times, *filter(None, (self.group, self.split)), *self.names]

    def but(self, name: str, **changes: Any) -> Self:
        """Return the schema with one column changed, to correct a proposal.

        Args:
            name: name of the column.
            **changes: fields to change, such as family="count"; a new category also needs its classes.

        Raises:
            ValueError: if the column does not exist or the fields do not fit together.
        """
        column = self._column(name)
        if changes.get("family", "category") != "category":
            changes = {"classes": (), "other": "", **changes}
        return replace(
            self, columns=tuple(replace(other, **changes) if other == column else other for other in self.columns)
        )

    def without(self, *names: str) -> Self:
        """Return the schema without some columns.

        Args:
            names: names of the columns to leave out.

        Raises:
            ValueError: if a column does not exist or no target remains.
        """
        omitted = [self._column(name) for name in names]
        return replace(self, columns=tuple(column for column in self.columns if column not in omitted))

    def _column(self, name: str) -> Column:
        """Return a column by name."""
        if name not in self.names:
            raise ValueError(f"no column {name!r}{nearest(name, self.names)}; there are {', '.join(self.names[:20])}")
        return self.columns[self.names.index(name)]

    def config(self) -> dict[str, Any]:
        """Return the schema as JSON types, for `from_config`."""
        time = list(self.time) if isinstance(self.time, tuple) else self.time
        entries: dict[str, Any] = {"id": list(self.id), "time": time, "group": self.group, "split": self.split}
        # fingerprints of windows hash these entries: default values stay out
        entries |= {name: value for name in ("zone", "decimal") if (value := getattr(self, name))}
        entries |= {name: list(value) for name in ("na_values", "calendar", "lags") if (value := getattr(self, name))}
        columns = {}
        for column in self.columns:
            values = {entry.name: getattr(column, entry.name) for entry in fields(Column) if entry.name != "name"}
            values = {name: value for name, value in values.items() if value or name not in ("other", "rounding")}
            columns[column.name] = {**values, "classes": list(column.classes)}
        return {**entries, "columns": columns}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Return the schema from `config` or a TOML file; columns are real targets by default.

        Args:
            config: dictionary of the fields, with columns by name.

        Raises:
            ValueError: if an entry is unknown; the message names the nearest known one.
        """
        entries = {**config}
        columns = entries.pop("columns", {})
        if not isinstance(columns, Mapping):
            raise ValueError(f"columns is {brief(columns)}; expected a table for each column, such as [columns.riders]")
        schema_columns = []
        for name, description in columns.items():
            if not isinstance(description, Mapping):
                raise ValueError(f"column {name!r} is {brief(description)}; expected a table, [columns.{name}]")
            _refuse_others(description, (entry.name for entry in fields(Column)[1:]), f"column {name!r}")
            schema_columns.append(Column(name, **tuples(description)))
        return cls(tuple(schema_columns), **layout(entries))

    def to_toml(self) -> str:
        """Return the schema as an editable TOML file."""
        lines = [
            f"{name} = {_quote(value) if isinstance(value, str) else _quote_all(value)}"
            for name in ("id", "time", "zone", "group", "split", "na_values", "decimal", "calendar")
            if (value := getattr(self, name))
        ]
        lines += [f"lags = [{', '.join(map(str, self.lags))}]"] if self.lags else []
        for column in self.columns:
            bare = re.fullmatch(r"[A-Za-z0-9_-]+", column.name)
            lines += ["", f"[columns.{column.name if bare else _quote(column.name)}]"]
            lines += [f'role = "{column.role}"'] if column.role != "target" else []
            lines += [f'family = "{column.family}"']
            lines += [f"unit = {_quote(column.unit)}"] if column.unit else []
            lines += [f"classes = {_quote_all(column.classes)}"] if column.classes else []
            lines += [f"other = {_quote(column.other)}"] if column.other else []
            lines += [f"rounding = {column.rounding!r}"] if column.rounding else []
        return "\n".join(lines).strip() + "\n"

    @classmethod
    def from_toml(cls, text: str) -> Self:
        """Return the schema of a TOML file.

        Args:
            text: content of the file.

        Raises:
            ValueError: if the text is not TOML or an entry is unknown.
        """
        return cls.from_config(parsed(text))


def parsed(text: str) -> dict[str, Any]:
    """Return the content of an untrusted TOML file.

    Raises:
        ValueError: if the text is not TOML or is nested too deeply.
    """
    try:
        if _CHAIN.search(text):
            raise RecursionError
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("its tables are nested too deeply; expected two levels, such as [columns.riders]") from None


def layout(schema: Mapping[str, Any]) -> dict[str, Any]:
    """Check and return the entries of a schema that describe the whole table.

    Raises:
        ValueError: if an entry is unknown or has another type.
    """
    _refuse_others(schema, (item.name for item in fields(Columns)), "the schema")
    entries: dict[str, Any] = {}
    for name, value in schema.items():
        many = isinstance(value, list | tuple)
        items = tuple(value) if many else (value,)
        lists = ("id", "na_values", "calendar")
        if name == "lags":
            if not (many and all(isinstance(item, int) and not isinstance(item, bool) for item in items)):
                raise ValueError(f"lags is {brief(value)}; expected numbers of steps, such as [7, 14]")
            entries[name] = items
        elif (name == "time" and many) or name in lists:
            if not all(isinstance(item, str) for item in items):
                expected = {"na_values": 'texts, such as ["?"]', "calendar": 'features, such as ["weekday"]'}.get(
                    name, "names of columns"
                )
                raise ValueError(f"{name} is {brief(value)}; expected {expected}")
            entries[name] = items
        elif isinstance(value, str | None):
            entries[name] = value
        else:
            expected = {"zone": "a time zone", "decimal": '"." or ","'}.get(name, "the name of a column")
            raise ValueError(f"{name} is {brief(value)}; expected {expected}")
    return entries


def _refuse_others(entries: Mapping[str, Any], allowed: Iterable[str], owner: str) -> None:
    names: Sequence[str] = list(allowed)
    for name in entries:
        if name not in names:
            raise ValueError(f"{owner} has an entry {name!r}{nearest(name, names)}; known entries: {', '.join(names)}")


def _quote_all(words: Iterable[str]) -> str:
    return f"[{', '.join(map(_quote, words))}]"


def _quote(text: str) -> str:
    """Return text as a TOML string."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    characters = (each if each >= " " and each != "\x7f" else f"\\u{ord(each):04x}" for each in escaped)
    return '"' + "".join(characters) + '"'
