"""Parse the columns of a pandas frame as numbers, texts or times."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from reprlib import repr as brief
from typing import Any

import numpy as np

from ..options import nearest
from .calendar import NUMBERS, Calendar, seconds
from .columns import Column
from .numerals import read_numbers

LONGEST = 64
"""Maximum characters of a date; longer text is not matched."""
MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
DATE_EXAMPLE = "2024-12-31"
_DAY = r"(?P<day>\d{1,2})(?:st|nd|rd|th)?"
_WEEKDAY = r"(?:(?:mon|tue|wed|thu|fri|sat|sun)[a-z]*[.,]{0,2}\s+)?"
_WORD = rf"(?P<word>{'|'.join(MONTHS)})[a-z]*\.?"
_CLOCK = (
    r"(?:(?:[T,]\s?|\s+)(?P<hour>\d{1,2})(?=:|\s?[ap])(?P<rest>(?::\d\d){1,2}(?:\.\d{1,9})?)?"
    r"\s?(?:(?P<half>[ap])\.?m\.?)?\s?(?P<zone>z|utc|gmt|[-+]\d\d:?\d\d)?)?"
)
WRITTEN = [
    re.compile(pattern + _CLOCK, re.IGNORECASE | re.ASCII)
    for pattern in (
        r"(?P<first>\d{1,2})(?P<sign>[-/. ])\s?(?P<second>\d{1,2})(?P=sign)\s?(?P<year>\d{4}|\d\d)",
        r"(?P<year>\d{4})[-/. ](?P<month>\d{1,2})[-/. ](?P<day>\d{1,2})",
        r"(?P<month>\d{1,2})[-/.](?P<year>\d{4})",
        r"(?P<year>\d{4})\.(?P<month>\d\d)",
        r"(?P<year>\d{4})[-/ ]?Q(?P<quarter>[1-4])",
        r"Q(?P<quarter>[1-4])[-/ ]?(?P<year>\d{4})",
        r"(?P<year>\d{4})-?W(?P<week>\d\d)(?:-?(?P<day>[1-7]))?",
        rf"{_WEEKDAY}{_DAY}[-/.\s]{{0,2}}{_WORD}[-/.,\s]{{0,2}}(?P<year>\d{{4}}|\d\d)",
        rf"{_WEEKDAY}{_WORD}[-/.\s]{{0,2}}{_DAY}[-/.,\s]{{1,2}}(?P<year>\d{{4}})",
        rf"{_WORD}[-/.,\s]{{0,2}}(?P<year>\d{{4}})",
    )
]
"""Date formats other than ISO 8601; a column has one of these formats."""
COMPACT = {14: "%Y%m%d%H%M%S", 12: "%Y%m%d%H%M", 10: "%Y%m%d%H", 8: "%Y%m%d", 6: "%Y%m"}
"""Formats of dates that are integers, by number of digits."""
DOTTED = re.compile(r"(?:1[89]|2[01])\d\d\.(?:0[1-9]|1[0-2])|(?:0[1-9]|1[0-2])\.(?:1[89]|2[01])\d\d", re.ASCII)
"""Months with a dot."""
_OFFSET = re.compile(r"[T :]\d\d[\d:.]*\s?(z|utc|gmt|[-+]\d[\d:]{1,4})$", re.IGNORECASE | re.ASCII)
"""Offset from UTC at the end of a date."""
_DURATION = re.compile(r"[-+]?(?:\d{1,6} days?,? ?)?[-+]?\d{1,6}:\d\d:\d\d(?:\.\d{1,9})?|[-+]?\d{1,6} days?", re.ASCII)


class UnparsedDates(ValueError):
    """Some texts of a column are not dates like the others.

    Args:
        cells: cells of the column.
        wrong: (N,) True where a cell is not a date.
    """

    def __init__(self, cells: Any, wrong: np.ndarray):
        self.wrong = wrong
        row = int(np.argmax(wrong))
        super().__init__(f"{brief(cells.iloc[row])} in row {row}; write dates as {DATE_EXAMPLE}, durations as 02:30:00")


class AmbiguousDates(ValueError):
    """Dates are ambiguous, such as between day first and month first."""


def is_number(column: Any) -> bool:
    """Return whether a column contains numbers or Booleans."""
    import pandas as pd

    return bool(pd.api.types.is_numeric_dtype(column))


def tabular(data: Any) -> Any:
    """Return a frame whose columns have names; an index with a name or with dates becomes a column.

    Raises:
        ValueError: if two columns share a name.
    """
    import pandas as pd

    frame = data.to_frame() if data.ndim == 1 else data
    frame = frame.set_axis([str(name) for name in frame.columns], axis=1)
    columns, levels = [*frame.columns], []
    for name, level in index_levels(data):
        is_column = columns.count(name) == 1 and level.equals(pd.Index(frame[name]))  # from set_index(drop=False)
        if not is_column:
            levels.append((name, level))
    names = [*(name for name, _ in levels), *columns]
    if len(set(names)) < len(names):
        repeated = next(name for name in names if names.count(name) > 1)
        hint = " or an index with the name of a column" if repeated in dict(levels) else ""
        raise ValueError(f"the table has two columns {repeated!r}{hint}; rename one")
    if levels:
        frame = frame.reset_index(drop=True)
    for index, (name, level) in enumerate(levels):
        frame.insert(index, name, level)
    return frame


def index_levels(data: Any) -> list[tuple[str, Any]]:
    """Return names and values of index levels that become columns: several levels, or one with a name or dates."""
    import pandas as pd

    levels = []
    for number in range(data.index.nlevels):
        level = data.index.get_level_values(number)
        dated = isinstance(level, pd.DatetimeIndex | pd.PeriodIndex | pd.TimedeltaIndex)
        if level.name is not None or dated or data.index.nlevels > 1:
            unnamed = "time" if dated and "time" not in map(str, getattr(data, "columns", ())) else f"level_{number}"
            levels.append((unnamed if level.name is None else str(level.name), level))
    return levels


def texts(column: Any) -> Any:
    """Return the values as text and keep missing values; whole numbers have no decimal part, as in 7, not 7.0."""
    if column.dtype.kind == "f" and (numbers := column.dropna()).abs().lt(2**53).all() and (numbers % 1 == 0).all():
        column = column.astype("Int64")
    return column.astype(str).where(column.notna())


def dates(column: Any) -> Any:
    """Parse dates, in their time zone if they have one.

    Accepted formats are ISO 8601, dates with English month names, and numeric dates if some values determine the order
    of day and month. Dates with several offsets from UTC are converted to UTC.

    Raises:
        AmbiguousDates: if the order of day, month and year is not determined, or only some dates have an offset.
        TypeError, ValueError: if the column contains other values, or dates in several formats.
    """
    import pandas as pd

    if isinstance(column.dtype, pd.PeriodDtype):
        return column.dt.to_timestamp()
    if pd.api.types.is_datetime64_any_dtype(column):
        return column
    codes, unique = pd.factorize(column)  # sequences share their dates
    try:
        strings = pd.Series(unique, dtype=object)
        parsed = pd.to_datetime(strings, utc=True, format="ISO8601")
    except (TypeError, ValueError):
        cells = column.astype(str).str.strip().where(column.notna())
        codes, unique = pd.factorize(cells)
        strings = _as_iso(pd.Series(unique, dtype=object))
        parsed = pd.to_datetime(strings, utc=True, format="ISO8601", errors="coerce")
        if (wrong := parsed.isna()).any():
            raise UnparsedDates(cells, np.append(wrong, False)[codes]) from None
    offsets = _offsets(strings)
    zones = offsets.dropna().unique()
    if len(zones) and (naive := offsets.isna()).any():
        raise AmbiguousDates(
            f"some dates have an offset from UTC, and others, such as {brief(str(unique[naive.argmax()]))}, have none; "
            "write it for all, or for none"
        )
    if not len(zones):
        parsed = parsed.dt.tz_localize(None)
    elif len(zones) == 1 and zones[0] != "Z":
        parsed = parsed.dt.tz_convert(pd.Timestamp(strings[0]).tz)
    return parsed.reindex(codes).set_axis(column.index)


def _offsets(strings: Any) -> Any:
    """Return offsets from UTC in dates as text, missing where a date has none."""
    return strings.astype(str).str.extract(_OFFSET)[0].str.upper().replace({"UTC": "Z", "GMT": "Z"})


def n_offsets(column: Any) -> int:
    """Return the number of different offsets from UTC in dates; 0 if they are not texts."""
    offsets = _offsets(column).replace({"Z": "+0000"}) if column.dtype.kind == "O" else column[:0]
    return int(offsets.str.replace(":", "").nunique()) if len(offsets) else 0


def compact(numbers: np.ndarray, name: Any = "") -> Any:
    """Parse integers such as 20241231, 202412 or 2024123123 (with the hour) as dates; None if some are not dates.

    Args:
        numbers: integers (N,).
        name: name of the column; six digits are a year and an ISO week if it is "week", and a month otherwise.
    """
    import pandas as pd

    least, most = (numbers.min(), numbers.max()) if len(numbers) and (numbers % 1 == 0).all() else (0, 0)
    for digits, pattern in COMPACT.items():
        if least // 10 ** (digits - 4) >= 1800 and most // 10 ** (digits - 4) <= 2200:
            cells = pd.Series(numbers.astype(int).astype(str))
            if digits == 6 and re.search(r"(^|_)(iso_?|year_?)?week(_|$)", str(name).lower()):
                cells, pattern = cells + "1", "%G%V%u"
            parsed = pd.to_datetime(cells, format=pattern, errors="coerce")
            return None if parsed.isna().any() else parsed
    return None


def is_dotted(column: Any) -> bool:
    """Return whether a column contains texts of months, such as 2024.01 or 01.2024, that could also be numbers."""
    cells = column.dropna()
    return column.dtype.kind == "O" and bool(len(cells)) and all(DOTTED.fullmatch(str(cell)) for cell in cells.unique())


def is_duration(column: Any) -> bool:
    """Return whether a column contains durations, or text such as "1 days 02:00:00" or "02:00:00"."""
    cells = column.dropna()
    return column.dtype.kind == "m" or bool(
        len(cells) and not is_number(column) and cells.astype(str).str.strip().str.fullmatch(_DURATION).all()
    )


def _as_iso(strings: Any) -> Any:
    """Convert texts to ISO 8601 if the first is a date in another format; otherwise return them unchanged."""
    import pandas as pd

    fitting = (
        date_format
        for first in strings[:1]
        if len(first) <= LONGEST
        for date_format in WRITTEN
        if date_format.fullmatch(first)
    )
    date_format = next(fitting, None)
    if date_format is None:
        return strings
    parts = strings.str.slice(0, LONGEST + 1).str.extract(f"^{date_format.pattern}$", flags=date_format.flags)
    parts = parts[parts.year.notna()]
    if "first" in parts:
        parts = parts.rename(columns=_order(parts, strings[0]))
    if "word" in parts:
        parts["month"] = parts.word.str.lower().map({name: str(number) for number, name in enumerate(MONTHS, 1)})
        century = parts.year.lt("69").map({True: "20", False: "19"})  # the POSIX rule
        parts["year"] = parts.year.where(parts.year.str.len() != 2, century + parts.year)
    if "quarter" in parts:
        parts["month"] = (3 * parts.quarter.astype(int) - 2).astype(str)
    if "week" in parts:
        weeks = pd.to_datetime(parts.year + parts.week + parts.day.fillna("1"), format="%G%V%u", errors="coerce")
        parts[["year", "month", "day"]] = weeks.astype(str).str.extract(r"(\d+)-(\d+)-(\d+)").fillna("0").to_numpy()
    if "day" not in parts:
        parts["day"] = "1"
    offset = parts.half.str.lower().map({"a": 0, "p": 12})
    hour = parts.hour.fillna("0").astype(int)
    hour = (hour % 12 + offset).where(offset.notna(), hour).astype(int).astype(str)
    date = parts.year + "-" + parts.month + "-" + parts.day
    zone = parts.zone.str.upper().replace({"UTC": "Z", "GMT": "Z"}).fillna("")
    return (date + "T" + hour + parts.rest.fillna(":00") + zone).reindex(strings.index).fillna("")  # no date


def _order(parts: Any, example: str) -> dict[str, str]:
    """Return which of the first two numbers of dates is the day, the one with a value above 12."""
    first, second = (parts[name].astype(int).max() > 12 for name in ("first", "second"))
    if first and second:
        raise ValueError(f"some dates begin with the day and others with the month; write dates as {DATE_EXAMPLE}")
    if not (first or second) or (parts.year.str.len() == 2).any():
        raise AmbiguousDates(
            f"dates such as {example!r} are ambiguous: the order of day, month and year is not known; "
            f"write them as {DATE_EXAMPLE}"
        )
    return {"first": "day", "second": "month"} if first else {"first": "month", "second": "day"}


def times(
    column: Any, zone: str | None = None, sequences: Iterable[np.ndarray] | None = None
) -> tuple[np.ndarray, Calendar]:
    """Return the times (N,) of rows and their calendar.

    Args:
        column: numbers, dates or durations.
        zone: time zone of dates without an offset from UTC.
        sequences: rows of each sequence; their order distinguishes the two hours when clocks are set back. By default,
            all rows are one sequence.

    Raises:
        ValueError: if the values have another type, or a row has no time.
    """
    import pandas as pd

    if is_number(column):
        values, calendar = column.to_numpy(np.float64, na_value=np.nan), NUMBERS
        valid = np.isfinite(values)
        if valid.all() and (parsed := compact(values, column.name)) is not None:
            return times(parsed.rename(column.name), zone, sequences)
    elif is_duration(column):
        spans = pd.to_timedelta(column if column.dtype.kind == "m" else column.astype(str).where(column.notna()))
        values, valid, calendar = seconds(pd.TimedeltaIndex(spans)), spans.notna().to_numpy(), Calendar("durations")
    else:
        try:
            parsed = dates(column)
        except AmbiguousDates as error:
            raise ValueError(f"column {column.name!r}: {error}") from error
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"the times of column {column.name!r} are neither numbers, dates nor durations: {str(error)[:200]}"
            ) from error
        valid = parsed.notna().to_numpy()
        moments = pd.DatetimeIndex(parsed)
        if zone is not None:
            moments = moments.tz_convert(zone) if moments.tz else _localize(moments, zone, sequences, column)
        values = seconds(moments)
        calendar = Calendar("dates", None if moments.tz is None else str(moments.tz))
    if zone is not None and calendar.kind != "dates":
        raise ValueError(f"zone is {zone!r}, and column {column.name!r} holds {calendar.kind}; leave the zone out")
    if not valid.all():
        raise ValueError(f"row {int(np.argmin(valid))} of column {column.name!r} has no time")
    return np.asarray(values), calendar


def _localize(local: Any, zone: str, sequences: Iterable[np.ndarray] | None, column: Any) -> Any:
    """Return local times as moments in a zone.

    Raises:
        ValueError: if a local time is skipped by a clock change, or occurs twice and the neighbouring times do not show
            which is meant.
    """
    is_repeated = local.tz_localize(zone, ambiguous="NaT", nonexistent="shift_forward").isna() & local.notna()
    moments = local.tz_localize(zone, ambiguous=np.ones(len(local), bool), nonexistent="NaT")
    if (skipped := moments.isna() & local.notna()).any():
        row = int(skipped.argmax())
        raise ValueError(
            f"row {row} of column {column.name!r} is {local[row]}, which the clocks of {zone} skip; write its offset "
            "from UTC, or leave the zone out"
        )
    moments = moments.to_series().reset_index(drop=True)
    for rows in [np.arange(len(local))] if sequences is None else sequences:
        if is_repeated[rows].any():
            try:
                moments.iloc[rows] = local[rows].tz_localize(zone, ambiguous="infer")
            except ValueError:
                row = rows[is_repeated[rows].argmax()]
                raise ValueError(
                    f"row {row} of column {column.name!r} is {local[row]}, which the clocks of {zone} show twice, "
                    "but its sequence does not contain both times in order; write its offset from UTC, as in "
                    f"{moments.iloc[row].isoformat()}, or leave the zone out"
                ) from None
    return type(local)(moments)


def numeric(column: Any, schema: Column, na_values: Sequence[str] = (), decimal: str | None = None) -> np.ndarray:
    """Return the values as numbers, NaN if missing; a category is the index of its class.

    Args:
        column: (N,) of any type.
        schema: schema of the column, with its family and classes.
        na_values: further texts or numbers that mark missing values; a listed class remains a class.
        decimal: "." or ",", the decimal sign of texts.

    Raises:
        ValueError: if values are invalid for the column.
    """
    if schema.family == "category":
        indices = {label: index for index, label in enumerate(schema.classes)}
        labels = texts(column)
        labels = labels.mask(labels.isin([label for label in na_values if label not in indices]))
        unknown = labels.notna() & ~labels.isin(list(indices))
        if schema.other:
            labels = labels.mask(unknown, schema.other)
        elif unknown.any():
            value = labels[unknown].iloc[0]
            raise ValueError(
                f"column {schema.name!r} has {brief(value)}{nearest(value, indices)}, which is not one of its classes: "
                f"{', '.join(schema.classes[:10])}; to read all other values as one, set other = {schema.classes[-1]!r}"
            )
        return labels.map(indices).to_numpy(np.float64)  # type: ignore[no-any-return]
    if column.dtype.kind in "mMc":
        raise ValueError(
            f"column {schema.name!r} has type {column.dtype}, not numbers; leave it out, or give it the family "
            "'category'"
        )
    numbers = read_numbers(column, na_values, decimal, column.attrs.get("decimal"))
    numbers.check(column, "or give the column the family 'category'")
    if numbers.marks:
        warnings.warn(f"column {schema.name!r} {describe_marks(numbers.marks)}", stacklevel=2)
    return numbers.values


def describe_marks(marks: Mapping[str, tuple[int, int]]) -> str:
    """Describe the cells of a column of numbers that are read as missing."""
    cells = ", ".join(f"{brief(mark)} (row {row}, {count} in all)" for mark, (row, count) in marks.items())
    quoted = ", ".join(f'"{mark}"' for mark in marks)
    return f"holds {cells} among numbers, read as missing; set na_values = [{quoted}] to omit this warning"
