"""Join columns of a table to one time: a date and a time of day, or year, month, day and hour."""

from __future__ import annotations

import re
from collections.abc import Collection
from itertools import pairwise, takewhile
from typing import Any

import numpy as np

from .numerals import read_numbers
from .parsing import MONTHS, compact, dates, is_dotted, is_number

CLOCK = re.compile(r"(\d{1,2}):(\d\d)(?::(\d\d(?:\.\d{1,9})?))?\s?(?:([ap])\.?m\.?)?", re.IGNORECASE | re.ASCII)
PERIOD = re.compile(
    rf"[ap]\.?m\.?|q[1-4]|({'|'.join(MONTHS)})[a-z]*|(mon|tue|wed|thu|fri|sat|sun)[a-z]*", re.IGNORECASE
)
"""A part of a time in words."""
UNITS = ("year", "quarter", "week", "month", "day", "hour", "minute", "second")
NAMES = dict(
    zip(
        UNITS,
        (
            r"years?|yr|yyyy",
            r"quarters?|qtr|q",
            r"(iso)?weeks?|wk|kw",
            r"months?|mon?|mm|mth",
            r"days?|dom|dd?|dy|mday|doy",
            r"hours?|hr?s?|hh|time|hhmm",
            r"minutes?|mins?|mi",
            r"seconds?|secs?|ss?",
        ),
        strict=True,
    )
)
SECONDS = {"day": 86400, "hour": 3600, "minute": 60, "second": 1}
_MOST = {"year": 9999, "quarter": 4, "week": 53, "month": 12, "day": 366, "hour": 24, "minute": 59, "second": 60}


def is_clock(values: Any) -> bool:
    """Return whether a column contains times of day, such as 13:05."""
    cells = values.dropna()
    if values.dtype.kind != "O":
        return False
    return bool(len(cells)) and all(CLOCK.fullmatch(str(cell).strip()) for cell in cells.unique())


def unit_of(name: str, values: Any) -> str | None:
    """Return the unit, such as "month", of a column that is one part of a time, by its name and values."""
    word = re.sub(r"^[\W\d_]+|[\W\d_]+$|\W.*", "", name.strip().lower())
    unit = next((unit for unit, pattern in NAMES.items() if re.fullmatch(pattern, word)), None)
    if unit is None:
        return None
    try:
        part = _part(values, unit)
    except ValueError:
        return None
    return unit if not np.isnan(part).any() else None


def parts_of(frame: Any, names: Collection[str]) -> tuple[str, ...]:
    """Return the columns that are the parts of one time, from the largest unit to the smallest."""
    units: dict[str, str] = {}
    for name in names:
        unit = unit_of(name, frame[name])
        if unit is not None:
            units.setdefault(unit, name)
    if "year" not in units:
        return tuple(units[unit] for unit in takewhile(units.__contains__, SECONDS))
    coarse = next((unit for unit in ("month", "week", "quarter") if unit in units), "year")
    fine = takewhile(units.__contains__, SECONDS) if coarse in ("year", "month") else ()
    return tuple(units[unit] for unit in dict.fromkeys(("year", coarse, *fine)))


def time_of(frame: Any, time: str | tuple[str, ...], decimal: str | None = None) -> Any:
    """Return the time of each row, from one column or several; numbers in text are converted."""
    if isinstance(time, tuple):
        return join_times(frame, time)
    column = frame[time]
    if is_dotted(column):
        return column
    numbers = read_numbers(column, (), decimal, column.attrs.get("decimal"))
    if is_number(column) or not numbers.is_numeric:
        return column
    if numbers.ambiguous:
        numbers.check(column, "")
    return type(column)(numbers.values, column.index, name=time)


def join_times(frame: Any, names: tuple[str, ...]) -> Any:
    """Return the time of each row from several columns.

    Without a year, times are numbers in the unit of the last column.

    Args:
        frame: table.
        names: columns of dates and of clocks or hours; or integers named year, month, day, hour, minute and second, or
            in this order; or named year and quarter, or year and (ISO) week.

    Raises:
        ValueError: if the columns are not parts of a time.
    """
    import pandas as pd

    label, first = " ".join(names), read_numbers(frame[names[0]])
    if len(names) > 6:
        raise ValueError(
            f"{label} are {len(names)} columns of one time; expected year, month, day, hour, minute, second"
        )
    timestamps = compact(first.values) if first.is_numeric else dates(frame[names[0]])
    if timestamps is not None:
        if len(names) > 4:
            raise ValueError(
                f"{label} are a date and {len(names) - 1} columns; expected a time of day, or hour, minute, second"
            )
        timestamps = timestamps.set_axis(frame.index)
        for name, unit in zip(names[1:], ("hour", "minute", "second"), strict=False):
            timestamps = timestamps + pd.to_timedelta(_part(frame[name], unit), unit="s")
        return timestamps.rename(label)
    order = iter(unit for unit in UNITS if unit not in ("quarter", "week"))
    units = [unit_of(name, frame[name]) for name in names]
    if None in units or len(set(units)) < len(units):
        units = [next(order) for _ in names]
    if skipped := [fine for coarse, fine in pairwise(SECONDS) if fine in units and coarse not in units]:
        raise ValueError(
            f"{label} have a column of {skipped[0]}s but no column of the next larger unit; name a column "
            "for each unit, from the year or day on"
        )
    parts = {str(unit): _part(frame[name], str(unit)) for unit, name in zip(units, names, strict=True)}
    seconds = sum(
        (parts[unit] * (SECONDS[unit] if unit == "day" else 1) for unit in SECONDS if unit in parts),
        start=np.zeros(len(frame)),
    )
    if "year" not in parts:
        return pd.Series(seconds / SECONDS[str(units[-1])], frame.index, name=label)
    month = parts.get("month", 3 * parts["quarter"] - 2 if "quarter" in parts else np.ones(len(frame)))
    months = (12 * (parts["year"] - 1970) + month - 1).astype(int).astype("datetime64[M]")
    if "week" in parts:  # ISO week 1 contains January 4
        fourth = months.astype("datetime64[D]") + np.timedelta64(3, "D")
        weekday = (fourth.astype(int) + 3) % 7  # 1970 began on a Thursday
        months = fourth + (7 * (parts["week"].astype(int) - 1) - weekday).astype("timedelta64[D]")
    elif "day" in parts:
        if "month" in parts:
            _refuse_late_days(parts["day"], months, label)
        seconds = seconds - SECONDS["day"]
    moments = months.astype("datetime64[us]") + np.round(1e6 * seconds).astype("timedelta64[us]")
    return pd.Series(moments, frame.index, name=label)


def _refuse_late_days(days: np.ndarray, months: np.ndarray, label: str) -> None:
    following = months + np.timedelta64(1, "M")
    lengths = (following.astype("datetime64[D]") - months.astype("datetime64[D]")).astype(int)
    if (days > lengths).any():
        row = int(np.argmax(days > lengths))
        raise ValueError(f"row {row} of {label} is not a date: {months[row]} has no day {days[row]:g}")


def _part(column: Any, unit: str) -> Any:
    """Return one part (N,) of each time: years, months and days as numbers, hours and smaller units in seconds."""
    if column.dtype.kind == "m":
        return column.dt.total_seconds().to_numpy(np.float64)
    if unit == "hour" and is_clock(column):
        fields = column.astype(str).str.strip().str.extract(f"^{CLOCK.pattern}$", flags=CLOCK.flags)
        hour, minute, second = (fields[number].astype(np.float64).fillna(0).to_numpy() for number in range(3))
        half = fields[3].str.lower()
        hour = np.where(half.notna(), hour % 12 + np.where(half == "p", 12, 0), hour)
        return np.where(column.notna(), 3600 * hour + 60 * minute + second, np.nan)
    texts = column.astype(str).str.strip().str.lower()
    if unit == "month" and texts.str[:3].isin(MONTHS).all():
        return texts.str[:3].map({name: number for number, name in enumerate(MONTHS, 1)}).to_numpy(np.float64)
    if unit == "quarter" and texts.str.fullmatch(r"q[1-4]").all():
        return texts.str[1:].to_numpy(np.float64)
    numbers = read_numbers(column)
    numbers.check(column, f"or write {unit}s as whole numbers")
    values = numbers.values
    least, most = {"year": 1000, "hour": 0, "minute": 0, "second": 0}.get(unit, 1), _MOST[unit]
    if unit == "hour" and values.max() > 99 and (values % 100 < 60).all():  # 1330 is 13:30
        values = np.floor(values / 100) + values % 100 / 60
    invalid = ~((values >= least) & (values <= most) & ((values % 1 == 0) | (unit in ("hour", "second"))))
    if invalid.any():
        row = int(np.argmax(invalid))
        cell = str(column.iloc[row])[:40]
        raise ValueError(f"row {row} of column {column.name!r} is {cell}; expected {unit}s from {least} to {most}")
    return values * (SECONDS[unit] if least == 0 else 1)
