"""Panel: sequences of several columns, built from common data structures.

| from | how |
|---|---|
| pandas, long | one row per sequence and step: `Panel.of(frame, columns)`, with `id` and `time`, or in its index |
| pandas, wide | one row per step, one column per sequence: `Panel.wide(frame)` |
| numpy, torch | (N, T, D), or (T, D) for one sequence |
| a list of arrays | sequences of different lengths (T_n, D) |
| xarray | a `Dataset` whose variables share a time dimension, and optionally a sequence dimension |

All data are copied, except arrays mapped from disk (`numpy.memmap`), which may be larger than memory. These are read in
blocks and windows.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

from ..data.blocks import hash_values, ranges, row_blocks
from ..data.npy import is_mapped
from ..data.sequences import check_real
from ..options import nearest
from .calendar import NUMBERS, SERIES, Calendar
from .clocks import time_of
from .column_inference import LARGEST, TIMES, ColumnHints, is_date
from .columns import Column, Columns
from .numerals import is_multiple, read_numbers, resolution
from .parsing import is_duration, is_number, n_offsets, numeric, tabular, texts, times

SPLITS = ("train", "validation", "test")
COUNTS = ("count", "overdispersed", "sparse", "sparse-overdispersed")
"""Families of counts."""
RUN, CHANGES = 4, 5
"""Thresholds for rows out of time order.

RUN is the mean number of rows in an increasing run; CHANGES is the number of changes between runs in time order, for
each step back in time. Above both, the runs are recordings with overlapping times; otherwise, one unsorted sequence.
"""


@dataclass(frozen=True, eq=False)
class Series:
    """One sequence.

    Args:
        name: unique name.
        values: (T, C) of the columns, in float64, or mapped values of any real type; a category is the index of its
            class, NaN a missing value.
        times: (T,) of the steps, increasing, as in `Calendar`; None for steps 0, 1, …
        group: name of its group.
        split: "train", "validation" or "test", if the data define it.
    """

    name: str
    values: np.ndarray
    times: np.ndarray | None = None
    group: str = ""
    split: str = ""

    def __len__(self) -> int:
        return len(self.values)

    def moments(self, start: int, steps: int, calendar: Calendar) -> np.ndarray | None:
        """Return the times of `steps` steps from `start` on, continued after the end by `Calendar.after`.

        Args:
            start: first step, from 0.
            steps: number of steps.
            calendar: calendar of the panel.
        """
        if self.times is None:
            return None
        times = self.times[start : start + steps]
        return np.concatenate([times, calendar.after(self.times, steps - len(times))])


@dataclass(frozen=True, eq=False)
class Panel:
    """Sequences with the same columns.

    Args:
        series: the sequences.
        columns: schema of the columns.
        name: name for titles.
        calendar: kind, time zone and calendar step of the times.
        complete: names of mapped sequences without missing targets, computed once since mapped data are read-only.

    Raises:
        ValueError: if sequences are empty, have other columns, share a name, are out of order, or have values that are
            invalid for their column, or if calendar features lack dates.
    """

    series: Sequence[Series]
    columns: Columns
    name: str = "panel"
    calendar: Calendar = NUMBERS
    complete: frozenset[str] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.series:
            raise ValueError(f"{self.name} has no sequences")
        if self.columns.calendar and (
            self.calendar.kind != "dates" or any(sequence.times is None for sequence in self.series)
        ):
            times = "missing" if any(sequence.times is None for sequence in self.series) else self.calendar.kind
            raise ValueError(
                f"calendar is {', '.join(self.columns.calendar)}, but the times of {self.name} are {times}; calendar "
                "features need dates: name their column as the time, or leave `calendar` out"
            )
        names: set[str] = set()
        for sequence in self.series:
            label = f"sequence {sequence.name!r} of {self.name}"
            if sequence.name in names:
                raise ValueError(
                    f"{self.name} has two sequences {sequence.name!r}; name the id columns that distinguish them"
                )
            names.add(sequence.name)
            if sequence.values.ndim != 2 or sequence.values.shape[1] != len(self.columns.columns) or not len(sequence):
                raise ValueError(
                    f"{label} has shape {sequence.values.shape}; expected rows of {len(self.columns.columns)} columns"
                )
            if sequence.times is not None and (
                sequence.times.shape != (len(sequence),) or not (np.diff(sequence.times) > 0).all()
            ):
                raise ValueError(f"{label} has times that are not strictly increasing")
        if any(column.rounding == "auto" for column in self.columns.columns):
            object.__setattr__(self, "columns", self._with_rounding())
        object.__setattr__(self, "complete", self._check())

    @property
    def usual_season(self) -> int:
        """Usual season of the calendar; 0 if most sequences have breaks, as with opening hours."""
        times = [sequence.times for sequence in self.series[:SERIES] if sequence.times is not None]
        season = self.calendar.usual_season
        return 0 if season and 2 * sum(map(self.calendar.has_breaks, times)) > len(times) else season

    def _with_rounding(self) -> Columns:
        """Return the columns with the unit of their values in place of "auto"."""
        columns = self.columns
        for index, column in enumerate(columns.columns):
            if column.rounding == "auto":
                blocks = (block[:, index] for block in row_blocks(sequence.values for sequence in self.series))
                unit = min(resolution(block[~np.isnan(block)]) for block in blocks)  # each unit divides the larger ones
                if not unit:
                    raise ValueError(
                        f'column {column.name!r} has rounding = "auto", but its values in {self.name} are no '
                        "multiples of a unit from 0.0001 on; give the unit as a number, or leave rounding out"
                    )
                columns = columns.but(column.name, rounding=unit)
        return columns

    def _check(self) -> frozenset[str]:
        """Check that values are valid for the family of their column; return the names of complete mapped sequences."""
        kinds: dict[tuple[str, int, float | str], list[int]] = {}
        for index, column in enumerate(self.columns.columns):
            kinds.setdefault((column.family, len(column.classes), column.rounding), []).append(index)
        ends, start, incomplete = np.cumsum([len(sequence) for sequence in self.series]), 0, set[int]()
        for block in row_blocks(sequence.values for sequence in self.series):
            block = block.astype(np.float64, copy=False)
            absent = np.isnan(block)
            for indices in kinds.values():
                cells, (is_valid, domain) = block[:, indices], _validity_test(self.columns.columns[indices[0]])
                with np.errstate(invalid="ignore", over="ignore"):
                    precise = cells.astype(np.float32)  # as models
                    valid = is_valid(precise)
                    if (first := self.columns.columns[indices[0]]).family == "hurdle":  # tiny values are not zeros
                        valid &= (cells == 0) == (precise == 0)
                    if first.rounding:
                        valid &= is_multiple(cells, float(first.rounding))
                invalid = ~(valid & (np.abs(cells) < LARGEST)) & ~absent[:, indices]
                if invalid.any():
                    row, offset = np.argwhere(invalid)[0]
                    owner, column = np.searchsorted(ends, start + row, "right"), self.columns.columns[indices[offset]]
                    sequence, size = self.series[owner], f", below {LARGEST:g} in size" if valid[row, offset] else ""
                    other = f"give it another family{' or rounding' if column.rounding else ''}"
                    advice = other if np.isfinite(cells[row, offset]) else "write NaN for missing values"
                    raise ValueError(
                        f"sequence {sequence.name!r} of {self.name} has {cells[row, offset]:.9g} in row "
                        f"{start + row - ends[owner] + len(sequence)} of column {column.name!r}, but the family "
                        f"{column.family!r} requires {domain}{size}; {advice}"
                    )
            rows = start + np.flatnonzero(absent[:, self._targets].any(1))
            incomplete |= {*np.searchsorted(ends, rows, "right").tolist()}
            start += len(block)
        mapped = (index for index, sequence in enumerate(self.series) if is_mapped(sequence.values))
        return frozenset(self.series[index].name for index in mapped if index not in incomplete)

    @cached_property
    def _targets(self) -> list[int]:
        """Indices of the target columns."""
        return [index for index, column in enumerate(self.columns.columns) if column.role == "target"]

    def __len__(self) -> int:
        return len(self.series)

    def __iter__(self) -> Iterator[Series]:
        return iter(self.series)

    def __repr__(self) -> str:
        lengths = [len(sequence) for sequence in self.series]
        steps = f"{min(lengths)}" if min(lengths) == max(lengths) else f"{min(lengths)} to {max(lengths)}"
        times = "" if all(sequence.times is None for sequence in self) else f"; {self.calendar}"
        return f"Panel({self.name}: {len(self)} sequences of {steps} steps{times}; {', '.join(self.columns.names)})"

    def fingerprint(self) -> str:
        """Return the SHA-256 of the columns and the sequences."""
        digest = hashlib.sha256(repr(self.columns).encode())
        for sequence in self.series:
            digest.update(repr((sequence.name, sequence.group, sequence.split, sequence.values.shape)).encode())
            for values in (sequence.values, sequence.times):
                if values is not None:
                    hash_values(digest, values, "<f8")
        return digest.hexdigest()

    @property
    def missing(self) -> bool:
        """Whether a value of a target is missing."""
        incomplete = (sequence.values for sequence in self.series if sequence.name not in self.complete)
        return any(bool(np.isnan(block[:, self._targets]).any()) for block in row_blocks(incomplete))

    def present(self, one: Series) -> int:
        """Return the number of steps up to the last one with a target; later rows belong to the future.

        Args:
            one: a sequence of this panel.
        """
        if one.name in self.complete:
            return len(one)
        for rows in reversed([*ranges(one.values)]):
            has_target = ~np.isnan(one.values[rows][:, self._targets]).all(1)
            if has_target.any():
                return int(rows.start + np.flatnonzero(has_target)[-1]) + 1
        return 0

    @property
    def groups(self) -> list[str]:
        """Sorted names of the groups."""
        return sorted({sequence.group for sequence in self.series})

    def only(self, names: Iterable[str]) -> Panel:
        """Return some of the sequences.

        Args:
            names: names of the sequences to keep.

        Raises:
            ValueError: if a sequence does not exist.
        """
        by_name, names = {sequence.name: sequence for sequence in self.series}, list(names)
        for name in names:
            if name not in by_name:
                raise ValueError(f"{self.name} has no sequence {name!r}{nearest(name, by_name)}")
        return replace(self, series=[by_name[name] for name in names])

    @classmethod
    def of(cls, data: Any, columns: Columns | ColumnHints | Sequence[str] | None = None, name: str = "panel") -> Panel:
        """Build a panel from a common data structure.

        Args:
            data: a pandas frame in the long form, arrays, a list of arrays, or an xarray `Dataset`.
            columns: a schema, or targets as in `ColumnHints`, with the rest inferred. For arrays, a schema, or names of
                real targets; by default x0, x1, …
            name: name for titles.

        Returns:
            The panel; a given panel is returned unchanged.

        Raises:
            TypeError: if the data have another type.
            ValueError: if the data have no such columns, or values are invalid.
        """
        if isinstance(data, Panel):
            if isinstance(columns, Columns) and columns != data.columns:
                raise ValueError(
                    f"{data.name} is a panel with the columns {', '.join(data.columns.names)}, which differ from the "
                    f"given {', '.join(columns.names)}; give the original data, or no columns"
                )
            return data
        kind = type(data).__module__.partition(".")[0]
        if kind in ("pandas", "xarray"):
            if not isinstance(columns, Columns | ColumnHints):
                columns = ColumnHints(columns=tuple(columns or ()))
            if kind == "xarray":
                data, columns = _xarray_to_frame(data, columns)
            columns = columns.of(data) if isinstance(columns, ColumnHints) else columns
            frame = tabular(data)
            series, calendar = _split_frame(frame, columns)
            return cls(series, columns, name, calendar)
        check_real(data, "the table")
        arrays = [data] if hasattr(data, "ndim") and data.ndim == 2 else data
        if not isinstance(arrays, np.ndarray | torch.Tensor | list | tuple):
            raise TypeError(
                "expected a pandas frame, an xarray Dataset, an array (N, T, D) or a list of arrays (T, D), got "
                f"{type(data).__name__}"
            )
        for array in arrays:
            check_real(array, "the table")
            if (dtype := getattr(array, "dtype", None)) is not None and getattr(dtype, "kind", "") in ("m", "M"):
                raise TypeError(
                    f"the table is an array of {dtype}, which are times and not values; give a pandas frame with the "
                    'times in one column and the values in others, as pandas.DataFrame({"time": times, "x": x})'
                )
        converted = [
            array.detach().cpu().double().numpy() if isinstance(array, torch.Tensor) else array for array in arrays
        ]
        sequences = [
            array.view(np.ndarray)
            if is_mapped(array) and array.dtype.kind in "fiu" and not np.ma.is_masked(array)
            else np.ma.filled(np.ma.array(array, np.float64, copy=True), np.nan)
            for array in converted
        ]
        if not sequences or any(array.ndim != 2 for array in sequences):
            inputs = [data] if getattr(data, "ndim", 0) == 1 else sequences
            shapes = ", ".join(str(tuple(array.shape)) for array in inputs[:3])
            advice = "; for a single column, give (T, 1), such as x[:, None]" if shapes else ""
            raise ValueError(f"sequences are (T, D); got {shapes or 'none'}{advice}")
        columns = plain_columns(columns, sequences[0].shape[1])
        return cls([Series(str(number), array) for number, array in enumerate(sequences)], columns, name)

    @classmethod
    def wide(cls, data: Any, column: Column | None = None, name: str = "panel", zone: str | None = None) -> Panel:
        """Build a panel from a pandas frame with one row per step and one column per sequence of a single variable.

        Args:
            data: the frame; an index of numbers, dates or durations is the time.
            column: description of the variable; by default a real target named "value".
            name: name for titles.
            zone: time zone of dates in the index, as in `Columns`.

        Returns:
            The panel, with one sequence per column that has a value.

        Raises:
            ValueError: times are not unique, or a cell is not a number.
        """
        index, moments, calendar = data.index.to_series(name=data.index.name or "index"), None, Calendar()
        if is_number(index) or is_date(index) or is_duration(index):
            moments, calendar = times(index, zone)
            order = _sort_rows(moments, np.arange(len(moments)), f"the table {name}", calendar, index.name)
            data, moments = data.iloc[order], moments[order]
        target = column or Column("value")
        series = []
        for label, cells in data.items():
            values = numeric(cells, target)
            valid = np.flatnonzero(~np.isnan(values))  # columns may start and end at different times
            if len(valid):
                part = slice(valid[0], valid[-1] + 1)
                series.append(Series(str(label), values[part, None], None if moments is None else moments[part]))
        return cls(series, Columns((target,)), name, calendar.stepping(sequence.times for sequence in series))


def plain_columns(columns: Columns | ColumnHints | Sequence[str] | None, size: int) -> Columns:
    """Return columns of arrays: as given, or real targets x0, x1, …

    Raises:
        ValueError: if a given entry does not apply to arrays, such as a time.
    """
    if isinstance(columns, ColumnHints):
        if inapplicable := [name for name, value in vars(columns).items() if value and name != "columns"]:
            raise ValueError(
                f"arrays have no column names, so {', '.join(inapplicable)} do not apply; give a schema, in Python "
                "as columns=Columns(...), or as FILE.toml next to the file"
            )
        words = (f"{word}::".split(":")[:3] for word in columns.columns)
        targets = tuple(Column(name, "target", family or "real", unit) for name, family, unit in words)
        columns = Columns(targets) if targets else None
    if isinstance(columns, Columns):
        if inapplicable := [name for name in ("id", "time", "group", "split") if getattr(columns, name)]:
            raise ValueError(
                f"the schema names a {inapplicable[0]} column, but arrays have no column names; leave it out"
            )
        return columns
    return Columns(tuple(map(Column, columns or [f"x{number}" for number in range(size)])))


def _validity_test(column: Column) -> tuple[Callable[[np.ndarray], np.ndarray], str]:
    """Return a test for the values of a column's family, except NaN, and its description."""
    tests: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
        "category": (lambda v: _counts(v) & (v < len(column.classes)), "indices of its classes"),
        "binary": (lambda v: (v == 0) | (v == 1), "0 or 1"),
        **dict.fromkeys(COUNTS, (_counts, "whole numbers from 0")),
        **dict.fromkeys(("positive", "log-normal"), (lambda v: v > 0, "numbers above 0")),
        "hurdle": (lambda v: v >= 0, "0, or numbers above 0 that float32 resolves"),
        "power": (lambda v: v >= 0, "numbers from 0"),
        "share": (lambda v: (v > 0) & (v < 1), "numbers above 0 and below 1"),
        "angle": (lambda v: np.abs(v) <= np.pi + 1e-6, "radians from -pi to pi"),
    }
    is_valid, domain = tests.get(column.family, (lambda v: ~np.isnan(v), "numbers"))
    return is_valid, domain + (f" that are multiples of its rounding, {column.rounding:g}" if column.rounding else "")


def _counts(values: np.ndarray) -> np.ndarray:
    valid: np.ndarray = (values >= 0) & (values % 1 == 0)
    return valid


def _xarray_to_frame(data: Any, columns: Columns | ColumnHints) -> tuple[Any, Columns | ColumnHints]:
    """Return an xarray as a frame; by default one dimension is the time and the others identify sequences."""
    data = data if hasattr(data, "data_vars") else data.to_dataset(name=data.name or "x")
    frame, dims = data.to_dataframe().reset_index(), [str(name) for name in data.dims]
    if isinstance(columns, ColumnHints) and dims:
        time_like = [name for name in dims if frame[name].dtype.kind in "mM" or TIMES.search(name.lower())]
        time = columns.time or (time_like or dims)[-1]
        columns = replace(columns, time=time, id=columns.id or tuple(name for name in dims if name != time))
    return frame, columns


def _split_frame(frame: Any, columns: Columns) -> tuple[list[Series], Calendar]:
    """Return the sequences of a frame in the long form, and their calendar."""
    if missing := [name for name in columns.needed if name not in frame.columns]:
        available = [str(name) for name in frame.columns]
        raise ValueError(
            f"no column {missing[0]!r}{nearest(missing[0], available)}; there are {', '.join(available[:20])}"
            f"{' …' if len(available) > 20 else ''}"
        )
    if not len(frame):
        raise ValueError("the table has a header but no rows; give a table with observations")
    options = (columns.na_values, columns.decimal)
    values = np.stack([numeric(frame[column.name], column, *options) for column in columns.columns], 1)
    label_columns = {role: name for role in ("group", "split") if (name := getattr(columns, role))}
    labels = {role: texts(frame[name]).fillna("").to_numpy() for role, name in label_columns.items()}
    rows, names = [np.arange(len(frame))], ["0"]
    if columns.id:
        if (is_unnamed := frame[list(columns.id)].isna().all(axis=1)).any():
            raise ValueError(
                f"{int(is_unnamed.sum())} of {len(frame)} rows have no {' and no '.join(columns.id)}, first in row "
                f"{int(np.argmax(is_unnamed))}; fill in the id of their sequence, or remove them"
            )
        groups = frame.groupby(list(columns.id), sort=False, observed=True, dropna=False).indices
        rows = [np.sort(indices) for indices in groups.values()]
        keys = frame.iloc[[indices[0] for indices in rows]][list(columns.id)]
        order = _id_order(keys)
        rows, keys = [rows[index] for index in order], keys.iloc[order]
        names = ["/".join(key) for key in zip(*(texts(keys[name]).fillna("") for name in columns.id), strict=True)]
        spaced = {name.strip(): name for name in names if name != name.strip()}
        if doubled := spaced.keys() & {*names}:
            name = min(doubled)
            warnings.warn(
                f"{len(doubled)} sequences have the names of others with spaces around them, such as {spaced[name]!r} "
                f"and {name!r}; if they are the same, strip the spaces",
                stacklevel=3,
            )
    row_times, calendar, series = None, Calendar(), []
    if columns.time is not None:
        moments = time_of(frame, columns.time, columns.decimal)
        row_times, calendar = times(moments, columns.zone, rows)
        if columns.calendar and columns.zone is None and calendar.zone == "UTC" and n_offsets(moments) > 1:
            warnings.warn(
                f"the dates of column {moments.name!r} have several offsets from UTC, so {', '.join(columns.calendar)} "
                'are those of UTC; name the time zone, such as zone = "Europe/Berlin"',
                stacklevel=3,
            )
    for name, indices in zip(names, rows, strict=True):
        if row_times is not None:
            indices = _sort_rows(row_times, indices, f"sequence {name!r}", calendar, moments.name)
        series_labels = {}
        for role, row_labels in labels.items():
            if len(unique := set(row_labels[indices])) > 1:
                raise ValueError(
                    f"sequence {name!r} has several values of {label_columns[role]}: "
                    f"{', '.join(sorted(unique)[:3])}; expected one"
                )
            series_labels[role] = unique.pop()
        if series_labels.get("split") and series_labels["split"] not in SPLITS:
            raise ValueError(
                f"sequence {name!r} has split {series_labels['split']!r}; expected one of {', '.join(SPLITS)}"
            )
        series_times = None if row_times is None else row_times[indices]
        series.append(Series(name, values[indices], series_times, **series_labels))
    return series, calendar.stepping(sequence.times for sequence in series)


def _id_order(keys: Any) -> np.ndarray:
    """Return the sorted order of ids (N, K): numbers by size, also in text, then other texts; missing ones last."""
    levels: list[np.ndarray] = []
    for name in keys:
        numbers, labels = read_numbers(keys[name]), texts(keys[name])
        size = np.zeros(len(keys)) if numbers.wrong.any() or numbers.marks else numbers.values
        levels += [labels.isna().to_numpy(), size, np.unique(labels.fillna("").to_numpy(str), return_inverse=True)[1]]
    return np.lexsort(levels[::-1])


def _sort_rows(moments: np.ndarray, rows: np.ndarray, owner: str, calendar: Calendar, column: str | None) -> np.ndarray:
    """Return the rows of a sequence in time order.

    Raises:
        ValueError: if two rows have the same time, or consecutive recordings overlap in time.
    """
    if (np.diff(moments[rows]) > 0).all():
        return rows
    if (np.diff(moments[rows]) < 0).sum() >= len(rows) / 2:  # newest first
        rows = rows[::-1]
        if (np.diff(moments[rows]) > 0).all():
            return rows
    order = np.argsort(moments[rows], kind="stable")
    sorted_rows = rows[order]
    advice = "name the id columns that distinguish sequences"
    if calendar.kind == "dates" and calendar.zone is None:
        advice += ', or, if clocks were set back, their zone, such as zone = "Europe/Berlin"'
    if calendar.kind == "durations":
        advice += ", or write the date before clocks that begin again at midnight"
    if (repeated := np.diff(moments[sorted_rows]) == 0).any():
        advice += ", or remove the duplicate row"
        first, second = sorted(sorted_rows[np.argmax(repeated) :][:2])
        raise ValueError(
            f"{owner} has two rows at {column} {calendar.text(moments[first])}, {first} and {second}; {advice}"
        )
    back = np.concatenate([[False, False, False], np.diff(moments[rows]) < 0])
    ends = np.where(back[2:], ~back[1:-1], back[1:-1] & back[:-2])  # ends of increasing or decreasing runs
    run = np.cumsum(ends)  # index of the run of each row
    overlap = len(rows) >= RUN * (run[-1] + 1) and (np.diff(run[order]) != 0).sum() > CHANGES * run[-1]
    if overlap or calendar.kind == "durations":  # clocks restart at midnight
        last, row = rows[np.argmax(run) - 1 :][:2]
        raise ValueError(
            f"{owner} goes back from {column} {calendar.text(moments[last])} in row {last} to "
            f"{calendar.text(moments[row])} in row {row}; {advice}, or, if it is one sequence, "
            f"sort its rows by {column}"
        )
    return sorted_rows
