"""Calendar: kind, time zone and calendar step of the times of a table, and the times that follow them.

Times are float64: plain numbers, or seconds. A day, a week, a business day or a month is not a fixed number of seconds.
Dates with such steps are therefore continued on the calendar, in their own time zone.
"""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from reprlib import repr as brief
from typing import Any, Literal, Self
from zoneinfo import ZoneInfo

import numpy as np

from ..options import Amount, check

HOUR, DAY = 3600, 86400
"""Seconds."""
MONTH = 30.4369
"""Mean days of a month."""
SERIES = 50
"""Maximum number of sequences used to infer the calendar step of a panel."""
FEATURES = {"hour": 4, "weekday": 7, "month": 4, "day_of_year": 4}
"""Number of coordinates of each calendar feature.

A weekday is one-hot, since weekends and Fridays follow no smooth curve. Hour, month and day of the year are two
harmonics of their cycle: 4 coordinates, in which 23 h is near 0 h and December near January. One-hot hours, months or
days would need 24, 12 or 366 coefficients, more than short tables determine.
"""
HARMONICS = 2
FLAG = 20
"""Maximum number of distinct values of a flag or category."""
EVEN = 1.3
"""Maximum ratio of longest gap to median, and of median to shortest gap, of evenly spaced steps; months are even."""
USUAL_SEASONS = {"1D": 7, "1B": 5, "1MS": 12, "1ME": 12, "1BMS": 12, "1BME": 12}
"""Steps in a week of daily data, and in a year of monthly data."""
LINEAR = 1e-5
"""Distance from 1 of the correlation with time, below which a column is a linear function of it."""
_OFFSET = re.compile(r"(?:UTC)?[-+](?:[01]\d|2[0-3]):[0-5]\d", re.ASCII)
_DAYS = ("MON", "TUE", "WED", "THU", "FRI", "SAT", "SUN")
_DAY = f"(?:{'|'.join(_DAYS)})"
_STEP = re.compile(rf"[1-9]\d{{0,3}}(?:D|B|MS|ME|BMS|BME|WOM-[1-4]{_DAY})|{_DAY}(?:-{_DAY}){{1,5}}", re.ASCII)
ENOUGH = 3
"""Minimum number of days that show which hours, and of weeks that show which days of the week, have rows."""


@dataclass(frozen=True)
class Calendar:
    """Kind, time zone and calendar step of times.

    Args:
        kind: "numbers", "dates" (times are seconds since 1970, in UTC) or "durations" (times are seconds).
        zone: time zone of the dates, such as "Europe/Berlin" or "UTC+02:00"; None for dates without one.
        step: calendar step as a pandas alias, such as "1MS" or "1B", or the days of the week that have rows, such as
            "MON-WED-FRI"; None for steps of equal duration.
        gap: median time between two steps, used to continue a sequence of one step; 0 if unknown.

    Raises:
        ValueError: if the zone or step is unknown, the gap is negative, or times that are not dates have a zone or
            step.
    """

    kind: Literal["numbers", "dates", "durations"] = "numbers"
    zone: str | None = None
    step: str | None = None
    gap: Amount = 0.0

    def __post_init__(self) -> None:
        check(self)
        if self.zone is not None:
            check_zone(self.zone)
        if self.step is not None and not _STEP.fullmatch(self.step):
            raise ValueError(
                f"step is {brief(self.step)}; expected a calendar step such as '1MS', '1B', '7D' or 'MON-WED-FRI'"
            )
        if self.kind != "dates" and (self.zone or self.step):
            raise ValueError(f"zone is {self.zone!r} and step {self.step!r}, but times are {self.kind}, not dates")

    def __str__(self) -> str:
        unit = "" if self.kind == "numbers" else " s"
        step = f" by {self.step or f'{self.gap:g}{unit}'}" if self.step or self.gap else ""
        return self.kind + step + (f", {self.zone}" if self.zone else "")

    @property
    def usual_season(self) -> int:
        """Number of steps in a week of daily, a day of hourly, or a year of monthly dates; 0 for other times."""
        if self.kind == "dates" and self.step is None and self.gap == HOUR:
            return 24
        step = self.step or ""
        return step.count("-") + 1 if step.startswith(_DAYS) else USUAL_SEASONS.get(step, 0)

    @property
    def skips_days(self) -> bool:
        """Whether some days of the week have no rows."""
        step = self.step or ""
        return step.endswith("B") or step.startswith(_DAYS)

    def stepping(self, times: Iterable[np.ndarray | None]) -> Self:
        """Return the calendar with the most common calendar step of sequences of times, and their median gap."""
        sampled = [sequence for sequence in times if sequence is not None and len(sequence) > 1]
        sampled = sampled[:: len(sampled) // SERIES + 1]
        if not sampled:
            return self
        calendar = replace(self, gap=float(np.median(np.concatenate([np.diff(sequence) for sequence in sampled]))))
        if self.kind != "dates":
            return calendar
        steps = Counter(_step(self.local(sequence)) for sequence in sampled if len(sequence) > 2)
        return replace(calendar, step=steps.most_common(1)[0][0]) if steps else calendar

    def to_pandas(self, times: np.ndarray) -> Any:
        """Return times (N,) as pandas objects: dates in their zone, or durations; numbers are unchanged."""
        import pandas as pd

        if self.kind == "numbers":
            return times
        microseconds = np.rint(times * 1e6).astype(np.int64)
        if self.kind == "durations":
            return pd.TimedeltaIndex(microseconds.astype("timedelta64[us]"))
        dates = pd.DatetimeIndex(microseconds.astype("datetime64[us]"))
        return dates if self.zone is None else dates.tz_localize("UTC").tz_convert(self.zone)

    def text(self, time: float) -> str:
        """Return a time as text."""
        return f"{time:.15g}" if self.kind == "numbers" else str(self.to_pandas(np.array([time]))[0])

    def after(self, times: np.ndarray, count: int) -> np.ndarray:
        """Return the next `count` times.

        The step is inferred from the times. If they are too few, it is the step of the calendar. Times without a
        calendar step continue by their median gap.

        Warns:
            UserWarning: if some days last 23 or 25 hours, but the time zone has no clock changes; or if dates leave out
                some hours or days (`has_breaks`), and are not continued so.
        """
        import pandas as pd

        if self.kind == "dates" and count:
            local = self.local(times)
            inferred = _step(local)
            is_short = times[-1] - times[0] < ENOUGH * 7 * DAY  # too short to show which days have no rows
            is_daily = inferred in (None, "1D")  # business days are days too
            steps = (self.step, inferred) if is_daily or (is_short and self.skips_days) else (inferred, self.step)
            for step in filter(None, steps):
                if (following := _following(local, step, count)) is not None:
                    return self._seconds(following)
            if self.has_breaks(times):
                warnings.warn(
                    "all rows are at some hours of the day or some days of the week, as with opening hours, but "
                    "forecasts have even times; for other times, append rows with them and empty targets, or insert "
                    "the absent rows with empty cells, for example by pandas' asfreq",
                    stacklevel=2,
                )
            if len(local) > 1 and _is_daily(local):  # regardless of clock changes
                gap = (local[1:] - local[:-1]).to_series().median()
                return self._seconds(pd.DatetimeIndex([local[-1] + gap * number for number in range(1, count + 1)]))
            if self.zone in (None, "UTC") and _changes_clocks(times):
                warnings.warn(
                    f"times such as {self.text(times[0])} and {self.text(times[-1])} seem to be days of a time zone "
                    "whose clocks change, and future times ignore its changes; name the zone, such as zone = "
                    '"Europe/Berlin"',
                    stacklevel=2,
                )
        gap = np.median(np.diff(times)) if len(times) > 1 else self.gap or 1.0
        return np.asarray(times[-1] + gap * np.arange(1, count + 1))

    def has_breaks(self, times: np.ndarray) -> bool:
        """Return whether times (T,) with steps below a day leave out some times of the day or days of the week.

        Single absent rows do not: the times must span several days, or weeks.
        """
        gap = float(np.median(np.diff(times))) if self.kind == "dates" and len(times) > 2 else 0.0
        if not 0 < gap < DAY or DAY % gap:
            return False
        local, span = seconds(self.local(times)), times[-1] - times[0]
        skips_hours = span > ENOUGH * DAY and len(np.unique(local % DAY // gap)) < DAY / gap
        return skips_hours or (span > ENOUGH * 7 * DAY and len(np.unique(local // DAY % 7)) < 7)

    def features(self, times: np.ndarray, names: Iterable[str]) -> np.ndarray:
        """Return calendar features (T, C) of dates (T,), at the local time of their zone.

        Args:
            times: dates as seconds since 1970.
            names: names in `FEATURES`.
        """
        local, parts = self.local(times), []
        for name in names:
            if name == "weekday":
                parts.append(np.eye(7)[local.day_of_week])
                continue
            phase = {
                "hour": np.asarray(local - local.normalize()) / np.timedelta64(1, "D"),
                "month": np.asarray(local.month - 1) / 12,
                "day_of_year": np.asarray(local.day_of_year - 1) / np.where(local.is_leap_year, 366, 365),
            }[name]
            angles = 2 * np.pi * phase[:, None] * np.arange(1, HARMONICS + 1)
            parts.append(np.concatenate([np.sin(angles), np.cos(angles)], 1))
        return np.concatenate(parts, 1)

    def local(self, times: np.ndarray) -> Any:
        """Return dates as local times of their zone, without a zone."""
        dates = self.to_pandas(times)
        return dates if self.zone is None else dates.tz_localize(None)

    def _seconds(self, local: Any) -> np.ndarray:
        """Return seconds since 1970 of dates given as local times of their zone."""
        if self.zone is not None:  # a skipped hour starts after the clock change
            local = local.tz_localize(self.zone, ambiguous=np.ones(len(local), bool), nonexistent="shift_forward")
        return seconds(local)


NUMBERS = Calendar()
"""Calendar for times that are plain numbers."""


def functions_of_time(
    values: Mapping[str, np.ndarray], times: np.ndarray, calendar: Calendar, owners: np.ndarray
) -> dict[str, str]:
    """Return columns that are functions of the time, with the argument of the function.

    It is a part of the date, such as "weekday"; "time" for linear functions; or "date" for flags and categories with
    one value for each date in all sequences.

    Args:
        values: dictionary from column to its values (N,), NaN where missing; categories as numbers.
        times: (N,) of the rows.
        calendar: calendar of the times.
        owners: (N,), index of the sequence of each row.
    """
    keys = {}
    if calendar.kind == "dates":
        local = calendar.local(times)
        keys = {"hour": local.hour, "weekday": local.day_of_week, "day of the month": local.day, "month": local.month}
        keys |= {"day_of_year": 100 * local.month + local.day}
    arguments = {}
    for name, cells in values.items():
        known = ~np.isnan(cells)
        x, t, n_levels = cells[known], times[known], len(np.unique(cells[known]))
        if n_levels < 2:
            continue
        arguments[name] = next((key for key, part in keys.items() if _is_function(x, part[known], t)), "")
        if _is_linear(x, t, owners[known]) or (keys and len(np.unique(x - local.year[known])) == 1):
            arguments[name] = "time"
        elif not arguments[name] and n_levels <= FLAG and _is_function(x, t, owners[known]):
            arguments[name] = "date"
    return {name: argument for name, argument in arguments.items() if argument}


def _is_function(values: np.ndarray, keys: Any, repeats: np.ndarray) -> bool:
    """Return whether each key has one value, and enough keys occur with several `repeats` to show it."""
    n_repeats = n_keys = 0
    for rows in (slice(2000), slice(None)):  # few rows reject most columns
        order = np.lexsort((repeats[rows], keys[rows]))
        x, key, repeat = (np.asarray(each[rows])[order] for each in (values, keys, repeats))
        same = key[1:] == key[:-1]
        if (x[1:] != x[:-1])[same].any():
            return False
        n_repeats, n_keys = int((same & (repeat[1:] != repeat[:-1])).sum()), int((~same).sum()) + 1
    return n_repeats >= max(FLAG, n_keys)


def _is_linear(values: np.ndarray, times: np.ndarray, owners: np.ndarray) -> bool:
    """Return whether values are one linear function of time, with an intercept for each sequence."""
    _, owners, counts = np.unique(owners, return_inverse=True, return_counts=True)
    x, t = (each - (np.bincount(owners, each) / counts)[owners] for each in (values, times))
    size = float(np.linalg.norm(x) * np.linalg.norm(t))
    return size > 0 and len(np.unique(t)) >= FLAG and abs(float(x @ t)) > (1 - LINEAR) * size


def seconds(dates: Any) -> np.ndarray:
    """Return seconds since 1970 of a pandas index of dates, or seconds of durations."""
    return np.asarray(dates.as_unit("us").asi8 / 1e6)


def check_zone(zone: str) -> None:
    """Check that text names a time zone.

    Raises:
        ValueError: if it is neither an offset such as "+02:00" nor a name of the IANA database.
    """
    try:
        if not _OFFSET.fullmatch(zone):
            ZoneInfo(zone)
    except (KeyError, ValueError, OSError):
        raise ValueError(
            f"zone is {brief(zone)}; expected a name such as 'Europe/Berlin', 'UTC', or an offset such as '+02:00'"
        ) from None


def _is_daily(local: Any) -> bool:
    """Return whether all dates have the same time of day."""
    return bool((local - local.normalize()).nunique() == 1)


def _changes_clocks(times: np.ndarray) -> bool:
    """Return whether times are days apart, except for an hour twice a year."""
    gaps = np.diff(times)
    changes = gaps % DAY != 0
    few = 0 < changes.sum() <= 2 + (times[-1] - times[0]) / (180 * DAY)
    return bool(few and (gaps >= DAY - HOUR).all() and np.isin(gaps[changes] % DAY, (HOUR, DAY - HOUR)).all())


def _step(local: Any) -> str | None:
    """Return the calendar step of increasing dates; None if the dates are too few or follow no calendar step."""
    if len(local) < 3 or not _is_daily(local):
        return None
    days = float(np.median(np.diff(seconds(local)))) / DAY
    count, first = round(days / MONTH), local[0]
    if days > 27:
        candidates = [f"{count}{end}" for end in ("ME", "BME", "MS", "BMS")]
        candidates.append(f"{count}WOM-{min((first.day + 6) // 7, 4)}{_DAYS[first.weekday()]}")
    else:
        weekdays = local.day_of_week
        candidates = ["1B"] if days == 1 and (np.diff(weekdays) < 0).any() else []
        open_days = [name for number, name in enumerate(_DAYS) if (weekdays == number).any()]
        if local[-1] - local[0] >= ENOUGH * np.timedelta64(7, "D") and 1 < len(open_days) < 7:
            candidates = candidates if open_days == [*_DAYS[:5]] else ["-".join(open_days)]
    candidates.append(f"{round(days)}D")
    valid = (step for step in candidates if _STEP.fullmatch(step))
    return next((step for step in valid if _following(local, step, 1) is not None), None)


def _following(local: Any, step: str, count: int) -> Any:
    """Return the next `count` dates by a calendar step; None if most given dates are not one such step apart."""
    import pandas as pd

    days, frequency = None, step
    if step.startswith(_DAYS):
        frequency = pd.offsets.CustomBusinessDay(weekmask=step.replace("-", " ").title())
    if step.endswith("MS") and "B" not in step:  # months from any day: the 15th, or the 30th and the end of February
        days = local.day.max()
        if (local.day != np.minimum(days, local.days_in_month)).any():
            return None
        local = local - pd.to_timedelta(local.day - 1, unit="D")
    indices = pd.date_range(local[0], local[-1], freq=frequency).get_indexer(local)
    if indices[0] != 0 or (indices < 0).any() or (len(local) > 1 and np.median(np.diff(indices)) != 1):
        return None
    following = pd.date_range(local[-1], periods=count + 1, freq=frequency)[1:]
    return (
        following if days is None else following + pd.to_timedelta(np.minimum(days, following.days_in_month) - 1, "D")
    )
