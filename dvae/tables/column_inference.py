"""Guess each column's type and role, as a schema that you can edit."""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from reprlib import repr as brief
from typing import Any

import numpy as np

from ..data.units import RESOLVED
from ..options import nearest
from .calendar import functions_of_time
from .clocks import PERIOD, is_clock, join_times, parts_of, time_of, unit_of
from .columns import Column, Columns, Role
from .numerals import NEARLY_ALL, read_numbers
from .parsing import (
    MONTHS,
    AmbiguousDates,
    UnparsedDates,
    compact,
    dates,
    describe_marks,
    index_levels,
    is_dotted,
    is_duration,
    is_number,
    tabular,
    texts,
    times,
)

CLASSES = 20
"""Maximum number of distinct texts of a category; columns with more are ids or free text."""
SPREAD = 1.5
"""Ratio of variance to mean above which counts are overdispersed."""
LARGE_COUNT = 1000
"""Smallest value of whole numbers that are like continuous data: a step of 1 is at most a thousandth of each value."""
LARGEST = 1e30
"""Bound on absolute values, since models compute in float32."""
TIMES = re.compile(
    r"(^|_)(time|date|datetime|timestamp|datum|day|week|month|quarter|year|hour|minute|second|step|frame|t|ds)(_|$)"
)
IDS = re.compile(r"(^|_)(id|unique_id|series|sequence|subject|station|store|item|patient|name|key)(_|$)")
ROWS = re.compile(r"no\.?|nr\.?|num|number|row|row_?(id|no|nr|num|number)|index|idx|obs|#", re.IGNORECASE)
"""Names of columns that only number the rows."""
COVERAGE = 0.6
"""Minimum share of steps between its first and last at which a sequence has a row, if its id is text."""
MOST_HEADERS = 4
"""Maximum number of header rows in a file."""
DATE = r"\d{4}|\d\W{1,2}\d|\d[-/. ]?[A-Za-z]{3}"
"""Pattern that every date contains."""
PART_OF_TIME = re.compile(r"\d{1,3}:\d\d([:.]\d+)*\s?([ap]\.?m\.?)?", re.IGNORECASE)
"""Times of day, and minutes with seconds, which contain no date."""
QUANTITY = re.compile(r"([^\w\s.,+-]{0,3})\s?[-+−]?[.,]?\d[\d.,'’\s]*([^\d\s]\D{0,11})?")
"""A number, optionally with a unit before or after it."""
NUMBERED = 5
"""Minimum number of numbered columns, such as x1 to x5, that suggest a table with one column per step."""
DATED_NAME = re.compile(
    r"\d{4}([-/.]\d{1,2}){0,2}([T ]\d.*)?|\d{1,2}[-/.]\d{1,2}[-/.]\d{2,4}|\d{4}[-_ ]?[QM]\d{1,2}|"
    rf"({'|'.join(MONTHS)})[a-z]*[-/ .]?\d{{2,4}}",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class ColumnHints:
    """Roles of columns given by the user; a column is "name", "name:family" or "name:family:unit".

    Args:
        columns: targets; by default all columns without another role.
        covariates: covariates known in the future, such as a plan or a calendar.
        past: covariates known up to the present.
        static: covariates with one value per sequence.
        id: columns that identify sequences.
        time: column of dates or numbers, or columns that are joined to one time.
        group: column that is constant within a sequence.
        split: column with values "train", "validation" or "test".
        zone: time zone of dates, such as "Europe/Berlin".
        na_values: texts or numbers that mark missing values, in addition to empty cells and NaN.
        decimal: "." or ",", the decimal sign of numbers in text; None to infer it.
        calendar: covariates computed from the time, of `dvae.tables.calendar.FEATURES`.
        lags: numbers of steps back to earlier values of the targets, which are covariates too.
    """

    columns: tuple[str, ...] = ()
    covariates: tuple[str, ...] = ()
    past: tuple[str, ...] = ()
    static: tuple[str, ...] = ()
    id: tuple[str, ...] = ()
    time: str | tuple[str, ...] | None = None
    group: str | None = None
    split: str | None = None
    zone: str | None = None
    na_values: tuple[str, ...] = ()
    decimal: str | None = None
    calendar: tuple[str, ...] = ()
    lags: tuple[int, ...] = ()

    def of(self, frame: Any) -> Columns:
        """Return the schema of a frame; entries that are not given are inferred, as in `infer_columns`.

        Args:
            frame: pandas frame in the long form.

        Raises:
            ValueError: if columns do not exist, families are unknown, or cells are ambiguous.
        """
        levels, frame = [name for name, _ in index_levels(frame)], tabular(frame)
        if not len(frame):
            raise ValueError("the table has a header but no rows; give a table with observations")
        available = list(frame.columns)
        roles: dict[str, tuple[Role, str]] = {}
        entries_by_role: dict[Role, tuple[str, ...]]
        entries_by_role = {"target": self.columns, "known": self.covariates, "past": self.past, "static": self.static}
        for role, entries in entries_by_role.items():
            for entry in entries:
                name = entry if entry in available else entry.partition(":")[0]
                if name in roles:
                    raise ValueError(f"column {name!r} is named twice")
                roles[name] = (role, entry[len(name) + 1 :])
        times = (self.time,) if isinstance(self.time, str) else tuple(self.time or ())
        key_columns = (*self.id, *times, *filter(None, (self.group, self.split)))
        for name in (*roles, *key_columns):
            if name not in available:
                raise ValueError(f"no column {name!r}{nearest(name, available)}; there are {', '.join(available[:20])}")
        families = {name: words.partition(":")[0] for name, (_, words) in roles.items()}
        inference = _Inference(self, frame, levels, times, key_columns, families)
        guesses = {name: column for name, column in inference.columns.items() if name not in key_columns}
        names = list(roles) if self.columns else [*(name for name in guesses if name not in roles), *roles]
        columns = []
        for name in names:
            role, words = roles.get(name, (guesses[name].role, "")) if name in guesses else roles[name]
            family, _, unit = words.partition(":")
            columns.append(_given_column(name, role, family, unit, frame[name], guesses.get(name), self.na_values))
        if not any(column.role == "target" for column in columns):
            static = ", ".join(
                column.name for column in columns if column.role == "static" and column.name not in roles
            )
            reason = f"; constant within each sequence: {static}" if static else ""
            candidates = ", ".join(names[:20]) or "none"
            raise ValueError(f"no column is a target among {candidates}{reason}; name the columns to model (--columns)")
        numbers = [column for column in columns if column.family != "category"]
        marks = [mark for column in numbers for mark in inference.numbers[column.name].marks]
        schema = Columns(
            tuple(columns),
            inference.id,
            inference.time,
            self.group,
            self.split,
            self.zone,
            tuple(dict.fromkeys((*self.na_values, *marks))),
            self.decimal,
            self.calendar,
            self.lags,
        )
        for column in numbers:
            if column_marks := inference.numbers[column.name].marks:
                warnings.warn(f"column {column.name!r} {describe_marks(column_marks)}", stacklevel=3)
        for name in (column.name for column in numbers if column.role == "target" and column.name in roles):
            if inference.is_constant(name):
                warnings.warn(
                    f"column {name!r} is constant, {_first(frame[name])}, but was named as a target; its forecasts are "
                    "trivial, and scores over all columns include it",
                    stacklevel=3,
                )
        inference.warn(schema, all_named=not self.columns)
        return schema


def _given_column(
    name: str, role: Role, family: str, unit: str, values: Any, guess: Column | None, na_values: Collection[str]
) -> Column:
    """Return a column with a given role, and possibly a given family and unit."""
    family = family or (guess.family if guess else "real")
    if role != "target" and family != "category":
        family = "real"
    return Column(name, role, family, unit, _classes(values, na_values) if family == "category" else ())


def _classes(values: Any, na_values: Collection[str]) -> tuple[str, ...]:
    return tuple(sorted({*texts(values).dropna()} - {*na_values}))


def infer_columns(frame: Any) -> Columns:
    """Propose a schema for a pandas frame in the long form, with one row per sequence and step.

    The rules are:

    - Time: the first column with dates or with the name of a time. A date and a clock, or year, month, day and hour,
      are joined if one column alone leaves several rows at the same time.
    - Ids: repeated texts, and integers with the name of an id, if they distinguish rows with the same time.
    - Static: columns that are constant within each of several sequences.
    - Known: functions of the date, such as weekdays, and flags that are equal in all sequences at each date.
    - Targets: all other columns. Integers from 0 are counts, two values are binary, few texts are a category, and
      numbers above 0 whose standard deviation exceeds half their mean are positive.

    The remaining columns, such as constant ones, are omitted, and a warning names them.

    Args:
        frame: table.

    Returns:
        The schema.

    Raises:
        ValueError: if no column can be a target, cells are ambiguous, or the table is not in the long form.
    """
    return ColumnHints().of(frame)


class _Inference:
    """Inference of the id, time and column families of a frame that the user does not give.

    Args:
        hints: roles given by the user.
        frame: table in the long form.
        levels: names of columns that are levels of its index.
        times: columns of the time, if given.
        key_columns: columns of the given id, time, group and split.
        families: dictionary from given column to its family, "" if the family is not given.
    """

    def __init__(
        self,
        hints: ColumnHints,
        frame: Any,
        levels: list[str],
        times: tuple[str, ...],
        key_columns: tuple[str, ...],
        families: Mapping[str, str],
    ):
        self.frame, self.index, self.levels = frame, levels, levels if len(levels) > 1 else []
        self.na_values, hint = hints.na_values, frame.attrs.get("decimal")
        self.numbers = {name: read_numbers(frame[name], hints.na_values, hints.decimal, hint) for name in frame}
        numerals = {
            name: parsed.values
            for name, parsed in self.numbers.items()
            if parsed.is_numeric and not is_number(frame[name]) and not self._holds_codes(name)
        }
        self.plain = frame.assign(**numerals)
        """The frame with numeric texts converted to numbers."""
        self.undecided: dict[str, str] = {}
        """Columns that could be the time, but with ambiguous dates, and a description of their content."""
        if not hints.columns:
            self._refuse_layout(key_columns)
        unassigned = [
            name for name in frame if name not in families and name not in key_columns and not self._numbers_rows(name)
        ]
        unassigned += [name for name in self.levels if name not in unassigned and name not in key_columns]
        self.id: tuple[str, ...] = hints.id
        self.time = times
        self._find_id_and_time(unassigned)
        assigned = {*key_columns, *self.id, *self.time, *self.undecided}
        if not self.id:  # a panel of one sequence
            id_like = (name for name in unassigned if name not in assigned and IDS.search(name.lower()))
            self.id = tuple(name for name in id_like if frame[name].nunique(dropna=False) == 1)
        assigned = ({*assigned, *self.id} | {*self.levels}) - {*families}
        candidates = (name for name in frame if name in families or (name in unassigned and not hints.columns))
        guesses = (self._column(name, families.get(name, "")) for name in candidates if name not in assigned)
        columns = {column.name: column for column in guesses if column is not None}
        if (
            columns
            and self.id
            and len(groups := self.plain.groupby(self._keys(self.id), observed=True, dropna=False)) > 1
        ):
            changing = groups[[*columns]].nunique().max() > 1
            columns = {
                name: guess if changing[name] else _covariate(guess, "static") for name, guess in columns.items()
            }
        known = self._known([name for name, guess in columns.items() if guess.role == "target"], hints)
        if any(guess.role == "target" and name not in known for name, guess in columns.items()):
            columns |= {name: _covariate(columns[name], "known") for name in known if name not in families}
        if not columns and not families:
            reasons = ", ".join(f"{name!r} ({self.reason(name)})" for name in [*frame][:20])
            single = "; separators are , ; tab and |, others are named by a first line such as sep=:"
            raise ValueError(f"no column can be a target: {reasons}{single if frame.shape[1] == 1 else ''}")
        self.columns = columns

    def _known(self, names: list[str], hints: ColumnHints) -> list[str]:
        """Return columns that are functions of the time."""
        if not self.time:
            return []
        groups = self.frame.groupby(self._keys(self.id), observed=True, dropna=False) if self.id else None
        owners = np.zeros(len(self.frame), int) if groups is None else groups.ngroup().to_numpy()
        cells = {}
        for name in names:
            parsed, codes = self.numbers[name], self.frame[name].astype("category").cat.codes.to_numpy(float)
            is_class = parsed.wrong.any() or self._holds_codes(name)
            cells[name] = np.where(codes < 0, np.nan, codes) if is_class else parsed.values
        with warnings.catch_warnings(), suppress(ValueError, TypeError):  # reading the table repeats both
            warnings.simplefilter("ignore")
            time = self.time if len(self.time) > 1 else self.time[0]
            rows = None if groups is None else [np.sort(indices) for indices in groups.indices.values()]
            moments, calendar = times(time_of(self.frame, time, hints.decimal), hints.zone, rows)
            return [*functions_of_time(cells, moments, calendar, owners)]
        return []

    def _holds_codes(self, name: str) -> bool:
        """Return whether texts are classes or codes, such as 007, although they could be parsed as numbers."""
        values = self.frame[name]
        if str(values.dtype) == "category":
            return True
        return not TIMES.search(name.lower()) and bool(texts(values).str.fullmatch(r"0\d+").any())

    def _find_id_and_time(self, unassigned: list[str]) -> None:
        """Choose the time column that gives the fewest duplicate times within a sequence; the first if several tie."""
        candidates = []
        for time in [self.time] if self.time else self._times(unassigned):
            try:
                step = join_times(self.frame, time) if len(time) > 1 else self.plain[time[0]]
            except ValueError:
                if self.time:
                    raise
                continue
            id, n_repeated = self._find_id(unassigned, time, step)
            candidates.append((n_repeated, id, time))
            if not n_repeated:
                break
        if candidates:
            _, self.id, self.time = min(candidates, key=lambda candidate: candidate[0])
        elif self.undecided:  # ambiguous dates still distinguish rows
            self.id, _ = self._find_id(unassigned, (*self.undecided,), self.frame[next(iter(self.undecided))])
        elif not self.id:
            self.id = tuple(self.levels) or self._ids_in_runs(unassigned)

    def _times(self, unassigned: list[str]) -> list[tuple[str, ...]]:
        """Return columns that may be the time, the most likely first."""
        frame = self.frame
        clocks = [name for name in unassigned if is_clock(frame[name])]
        date_columns = [
            name for name in unassigned if name not in clocks and (self._is_time(name) or self._is_compact(name))
        ]
        date_columns.sort(key=lambda name: name not in self.levels)
        remaining = [name for name in unassigned if name not in self.undecided]
        numbers = [name for name in remaining if is_number(self.plain[name])]
        if date_columns:
            units = {unit_of(name, frame[name]): name for name in reversed(remaining) if name != date_columns[0]}
            fine = clocks[:1] or [units[unit] for unit in ("hour", "minute", "second") if unit in units]
            return [(date_columns[0],), *([(date_columns[0], *fine)] if fine else [])]
        spans = [] if self.undecided else [name for name in (*self.levels, *remaining) if is_duration(frame[name])]
        levels = [name for name in self.levels if name in numbers]
        time_like = [name for name in (*levels, *numbers) if TIMES.search(name.lower())]
        parts = parts_of(frame, [name for name in remaining if name not in clocks])
        joint = [parts] if len(parts) > 1 else []
        return [*joint, *((name,) for name in dict.fromkeys((*spans, *time_like, *levels[-1:])))]

    def _find_id(self, unassigned: list[str], time: tuple[str, ...], step: Any) -> tuple[tuple[str, ...], int]:
        """Return the columns that identify sequences, and the number of rows that repeat a time within a sequence."""
        steps = step.to_numpy()
        rows = self.frame.assign(**{" step": steps})

        def count_repeated(ids: Collection[str]) -> int:
            return int(rows.duplicated([*ids, " step"]).sum())

        if self.id:
            return self.id, count_repeated(self.id)
        others = [name for name in self.levels if name not in time]
        if others:
            if len(others) > 1 and others[-1].startswith("level_") and is_number(self.plain[others[-1]]):
                others = others[:-1] if not count_repeated(others[:-1]) else others
            return tuple(others), count_repeated(others)
        remaining = [name for name in unassigned if name not in time and name not in self.undecided]
        if not count_repeated(()):
            return self._ids_in_runs(remaining), 0
        id_like = [name for name in remaining if self._is_named_id(name) and is_number(self.plain[name])]
        ids: list[str] = []
        for name in (*id_like, *(name for name in remaining if self._may_be_id(name))):
            if not (n_before := count_repeated(ids)):
                break
            if count_repeated([*ids, name]) < n_before:
                ids.append(name)
        for name in tuple(ids):  # drops ids that a later one makes redundant
            fewer = [other for other in ids if other != name]
            ids = ids if count_repeated(fewer) else fewer
        if not all(map(self._is_named_id, ids)) and not self._in_runs(ids) and self._coverage(ids, steps) < COVERAGE:
            return (), count_repeated(())
        return tuple(ids), count_repeated(ids)

    def _keys(self, ids: Collection[str]) -> list[Any]:
        """Return the original id columns, as keys for grouping."""
        return [self.frame[name].rename(None) for name in ids]

    def _is_named_id(self, name: str) -> bool:
        """Return whether a column contains integers or texts and has the name of an id."""
        values = self.plain[name]
        is_named = IDS.search(name.lower()) is not None or name in self.index
        return is_named and (not is_number(values) or _is_whole(values))

    def _may_be_id(self, name: str) -> bool:
        """Return whether a column contains repeated texts, or codes such as 007, and no parts of a time."""
        values = self.frame[name]
        different = values.dropna().unique()
        if is_number(self.plain[name]) or len(different) == len(values):
            return False
        if all(PERIOD.fullmatch(str(value).strip()) for value in different):
            return False
        return IDS.search(name.lower()) is not None or not (TIMES.search(name.lower()) or is_clock(values))

    def _ids_in_runs(self, names: Collection[str]) -> tuple[str, ...]:
        """Return columns with the name of an id where the rows of each value are adjacent."""
        return tuple(name for name in names if self._is_named_id(name) and self._in_runs([name]))

    def _in_runs(self, ids: list[str]) -> bool:
        """Return whether the rows of each sequence are adjacent, and some sequence has several."""
        codes = self.frame.groupby(self._keys(ids), sort=False, dropna=False, observed=True).ngroup().to_numpy()
        runs = 1 + int((np.diff(codes) != 0).sum())
        return 1 < runs == len(np.unique(codes)) < len(codes)

    def _coverage(self, ids: list[str], steps: np.ndarray) -> float:
        """Return the share of steps, from the first to the last of each sequence, that have a row."""
        import pandas as pd

        moments = pd.Series(steps)
        with suppress(TypeError, ValueError):
            moments = moments if is_number(moments) else dates(moments)
        place = pd.Series(pd.factorize(moments, sort=True)[0], self.frame.index)
        spans = place.groupby(self._keys(ids), dropna=False, observed=True).agg(["min", "max"])
        return len(place) / float((spans["max"] - spans["min"] + 1).sum())

    def _is_time(self, name: str) -> bool:
        """Return whether a column contains dates; records ambiguous ones in `undecided`."""
        try:
            if is_date(self.plain[name]):
                return True
            cells = self.frame[name]
            if 2 * (~np.isnan(self.numbers[name].values)).sum() >= cells.count():
                return False
            date_mask = (cells.notna() & texts(cells).str.contains(DATE, na=False)).to_numpy(bool, copy=True)
            if date_mask.sum() < NEARLY_ALL * cells.count():
                return False
            try:
                dates(cells[date_mask])
            except UnparsedDates as error:
                date_mask[date_mask] = ~error.wrong
            except AmbiguousDates:
                raise
            except (TypeError, ValueError):
                return False
            if NEARLY_ALL * cells.count() <= date_mask.sum() < cells.count():
                row = int(np.argmax(cells.notna().to_numpy() & ~date_mask))
                raise ValueError(
                    f"column {name!r}: {date_mask.sum()} of {cells.count()} values are dates; row {row} is "
                    f"{brief(cells.iloc[row])}; correct it, or leave the row out"
                )
        except AmbiguousDates as error:
            self.undecided[name] = str(error)
        return False

    def _is_compact(self, name: str) -> bool:
        """Return whether numbers with the name of a time are dates such as 20241231, or months such as 2024.12."""
        values = self.plain[name]
        if TIMES.search(name.lower()) and is_dotted(self.frame[name]):
            return True
        if not TIMES.search(name.lower()) or not _is_whole(values) or values.isna().any():
            return False
        return compact(values.to_numpy(np.float64), name) is not None

    def _numbers_rows(self, name: str) -> bool:
        """Return whether a column numbers the rows, such as an unnamed index that pandas wrote to a CSV."""
        values = self.plain[name]
        if name == "Unnamed: 0":
            return _is_whole(values) and bool(values.is_unique)
        if ROWS.fullmatch(name.strip()) is None or not _is_whole(values):
            return False
        return bool((np.diff(values.to_numpy(np.float64, na_value=np.nan)) == 1).all())

    def _refuse_layout(self, key_columns: Collection[str]) -> None:
        """Raise an error for a table with dates as column names, or with several header rows."""
        names = [name for name in self.frame if name not in key_columns]
        date_columns = [name for name in names if DATED_NAME.fullmatch(name) and is_number(self.plain[name])]
        if len(date_columns) > 2 and 2 * len(date_columns) >= len(names):
            others = [name for name in self.frame if name not in date_columns]
            raise ValueError(
                f"{len(date_columns)} columns are named by dates, {date_columns[0]!r} to {date_columns[-1]!r}, so each "
                f"row is a sequence; write a row for each step, as frame.melt({others}, var_name='time', "
                "value_name='value') does"
            )
        firsts, has_text = [len(self.frame)], False
        for parsed in (self.numbers[name] for name in names):
            if (valid := ~np.isnan(parsed.values)).any():
                firsts.append(int(np.argmax(valid)))
                has_text |= bool(parsed.wrong[: firsts[-1]].any())
        count, top = min(firsts), self.frame.iloc[: min(*firsts, MOST_HEADERS)][names].astype(object)
        if (
            has_text
            and 0 < count < MOST_HEADERS
            and not any(re.match(r"\s*\d", str(cell)) for cell in top.to_numpy().ravel())
        ):
            headers = [str(value) for value in self.frame.iloc[:count].to_numpy().ravel() if value == value]
            raise ValueError(
                f"the table has {count + 1} header rows, with texts such as {', '.join(map(brief, headers[:6]))}; "
                "write one row of names, such as 'power MW', or read the table with pandas.read_csv("
                f"…, header={[*range(count + 1)]}) and join them"
            )

    def _column(self, name: str, family: str) -> Column | None:
        """Guess the family of a column; None if it cannot be a target, such as texts that are all different."""
        parsed, values = self.numbers[name], self.plain[name]
        if values.dtype.kind == "c":
            raise ValueError(
                f"column {name!r} holds complex numbers; give their real and imaginary parts as two columns"
            )
        if family:
            return None  # the family is given
        if not is_number(values):
            cells = self.frame[name].dropna()
            count = int((~np.isnan(parsed.values)).sum())
            if not self._holds_codes(name) and count and count >= NEARLY_ALL * (count + parsed.wrong.sum()):
                parsed.check(values, "or declare the column as an id or a category, or leave it out (--columns)")
            classes = _classes(cells, self.na_values)
            return Column(name, family="category", classes=classes) if 2 <= len(classes) <= CLASSES else None
        if parsed.ambiguous:
            parsed.check(self.frame[name], "")
        numbers = parsed.values[~np.isnan(parsed.values)]
        if not len(numbers) or self.is_constant(name):
            return None
        if set(np.unique(numbers)) == {0.0, 1.0}:
            return Column(name, family="binary")
        if not (np.abs(numbers) < LARGEST).all():
            return Column(name)  # reading raises an error
        is_count = (numbers >= 0).all() and (numbers % 1 == 0).all() and len(np.unique(numbers)) > 2
        if is_count and numbers.min() >= LARGE_COUNT and numbers.std() > 0.5 * numbers.mean():
            return Column(name, family="log-normal")
        if is_count and numbers.std() > RESOLVED * numbers.mean():
            return Column(name, family="overdispersed" if numbers.var() > SPREAD * numbers.mean() else "count")
        if (numbers.astype(np.float32) > 0).all() and numbers.std() > 0.5 * numbers.mean():
            return Column(name, family="positive")
        return Column(name)

    def is_constant(self, name: str) -> bool:
        """Return whether all values except missing ones are equal, in at least two rows."""
        parsed, cells = self.numbers[name], self.frame[name].dropna()
        values = cells if parsed.wrong.any() or self._holds_codes(name) else parsed.values[~np.isnan(parsed.values)]
        return len(values) > 1 and len(set(values)) == 1

    def reason(self, name: str) -> str:
        """Return why a column is not proposed."""
        parsed, values = self.numbers[name], self.frame[name].dropna()
        if name in self.undecided:
            return f"perhaps the time: {self.undecided[name]}"
        if name in (*self.time, *self.id):
            return "the time" if name in self.time else "an id"
        if self._numbers_rows(name):
            return "row numbers without a name" if name == "Unnamed: 0" else "row numbers"
        if name in self.levels:
            return "a level of the index that does not distinguish sequences"
        if not parsed.wrong.any() and np.isnan(parsed.values).all():
            return "empty: all its values are missing"
        if self.is_constant(name):
            return f"constant: {_first(values)}"
        unparsed = self.frame[name][parsed.wrong] if parsed.wrong.any() else values
        if values.astype(str).str.strip().str.fullmatch(PART_OF_TIME).all():
            return (
                f"perhaps a time, such as {_first(unparsed)}; write it with its date, or as a duration such as 02:30:00"
            )
        sign = f"; remove {unit!r}" if (unit := _unit(str(unparsed.iloc[0]))) else ""
        return f"neither numbers nor 2 to {CLASSES} classes, such as {_first(unparsed)}{sign}"

    def warn(self, columns: Columns, all_named: bool) -> None:
        """Warn about columns of the frame that the schema omits."""
        ambiguous = () if columns.time else self.undecided
        omitted = [name for name in self.frame if name not in columns.needed and (all_named or name in ambiguous)]
        descriptions = [f"{name!r} ({self.reason(name)})" for name in omitted]
        if descriptions:
            warnings.warn(f"columns left out of the proposed schema: {', '.join(descriptions)}", stacklevel=4)
        for column in columns.columns:
            self._warn_of_classes(column.name)
        if all_named and not columns.time and not self.undecided:
            self._warn_of_steps_in_columns(columns)

    def _warn_of_classes(self, name: str) -> None:
        """Warn of a proposed category whose classes may be numbers with a unit, or marks."""
        if name not in self.columns or self._holds_codes(name):
            return
        classes = self.columns[name].classes
        units = [unit for label in classes if (unit := _unit(label)) is not None]
        if "" in units or len(units) > len(classes) / 2:
            signs = "".join(f", remove {unit!r}" for unit in dict.fromkeys(filter(None, units)))
            warnings.warn(
                f"column {name!r} is proposed as a category, and some of its classes may be numbers: "
                f"{', '.join(map(brief, classes[:5]))}; correct them{signs}, list those that mark missing values in "
                f"na_values (--na-values), or declare {name}:category (--columns)",
                stacklevel=5,
            )

    def _warn_of_steps_in_columns(self, columns: Columns) -> None:
        """Warn of a table without a time whose rows may be sequences with one column per step."""
        stems = Counter(re.sub(r"\d+$", "", name) for name in columns.names if re.search(r"\d$", name))
        stem, count = max(stems.items(), key=lambda item: item[1], default=("", 0))
        labels = [name for name in self.frame if self._labels_rows(name)]
        if count >= NUMBERED and (count > len(self.frame) or labels):
            numbered = [name for name in columns.names if re.fullmatch(re.escape(stem) + r"\d+", name)]
            others = [name for name in self.frame if name not in numbered]
            warnings.warn(
                f"no column is a time, and {count} columns, {numbered[0]!r} to {numbered[-1]!r}, are numbered; if each "
                f"row is a sequence, write a row for each step, as frame.melt({others}, var_name='time', "
                "value_name='value') does",
                stacklevel=5,
            )

    def _labels_rows(self, name: str) -> bool:
        """Return whether a column contains a different text in each row."""
        values = self.frame[name]
        if is_number(self.plain[name]) or values.isna().any() or not values.is_unique:
            return False
        return not values.astype(str).str.strip().str.fullmatch(PART_OF_TIME).all()


def _first(values: Any) -> str:
    """Return the first value that is not missing, abbreviated."""
    return brief(str(values.dropna().iloc[0]))


def _covariate(column: Column, role: Role) -> Column:
    family = "category" if column.family == "category" else "real"
    return replace(column, role=role, family=family)


def _unit(cell: str) -> str | None:
    """Return the unit of a number in text, "" if it has none, or None for other texts."""
    match = QUANTITY.fullmatch(cell.strip())
    return None if match is None else (match[1] + (match[2] or "")).strip()


def _is_whole(values: Any) -> bool:
    return is_number(values) and bool((values.dropna() % 1 == 0).all())


def is_date(values: Any) -> bool:
    """Return whether a column contains dates, or texts of them.

    Raises:
        AmbiguousDates: if dates are ambiguous.
    """
    import pandas as pd

    if pd.api.types.is_datetime64_any_dtype(values) or isinstance(values.dtype, pd.PeriodDtype):
        return True
    cells = values.dropna()
    if is_number(values) or not len(cells):
        return False
    sample = cells.iloc[:: max(len(cells) // 50, 1)].astype(str)
    if not sample.str.contains(DATE).all():
        return False
    for part in (sample, cells):
        try:
            return bool(dates(part).notna().all())
        except AmbiguousDates as error:  # other cells may resolve it
            undecided = error
        except (TypeError, ValueError):
            return False
    raise undecided
