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
from .calendar import NUMBERS, Calendar
from .clocks import time_of
from .column_inference import LARGEST, TIMES, ColumnHints, is_date
from .columns import Column, Columns
from .numerals import read_numbers
from .parsing import is_duration, is_number, numeric, tabular, texts, times

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
        """Return the times of `steps` steps from `start` on, continued after the end by `Calendar.after`."""
        if self.times is None:
            return None
        own = self.times[start : start + steps]
        return np.concatenate([own, calendar.after(self.times, steps - len(own))])


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
            invalid for their column.
    """

    series: Sequence[Series]
    columns: Columns
    name: str = "panel"
    calendar: Calendar = NUMBERS
    complete: frozenset[str] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.series:
            raise ValueError(f"{self.name} has no sequences")
        seen: set[str] = set()
        for one in self.series:
            who = f"sequence {one.name!r} of {self.name}"
            if one.name in seen:
                raise ValueError(
                    f"{self.name} has two sequences {one.name!r}; name the columns that tell them apart (id)"
                )
            seen.add(one.name)
            if one.values.ndim != 2 or one.values.shape[1] != len(self.columns.columns) or not len(one):
                raise ValueError(
                    f"{who} has shape {one.values.shape}; expected rows of {len(self.columns.columns)} columns"
                )
            if one.times is not None and (one.times.shape != (len(one),) or not (np.diff(one.times) > 0).all()):
                raise ValueError(f"{who} has times that do not increase, or two rows with one time")
        object.__setattr__(self, "complete", self._checked())

    def _checked(self) -> frozenset[str]:
        """Check that values are valid for the family of their column; return the names of complete mapped sequences."""
        kinds: dict[tuple[str, int], list[int]] = {}
        for place, column in enumerate(self.columns.columns):
            kinds.setdefault((column.family, len(column.classes)), []).append(place)
        ends, start, gapped = np.cumsum([len(one) for one in self.series]), 0, set[int]()
        for block in row_blocks(one.values for one in self.series):
            block = block.astype(np.float64, copy=False)
            absent = np.isnan(block)
            for places in kinds.values():
                own, (right, said) = block[:, places], _admitted(self.columns.columns[places[0]])
                with np.errstate(invalid="ignore", over="ignore"):
                    seen = right(own.astype(np.float32))  # in the precision of models
                wrong = ~(seen & (np.abs(own) < LARGEST)) & ~absent[:, places]
                if wrong.any():
                    row, nth = np.argwhere(wrong)[0]
                    of, column = np.searchsorted(ends, start + row, "right"), self.columns.columns[places[nth]]
                    one, size = self.series[of], f", below {LARGEST:g} in size" if seen[row, nth] else ""
                    advice = (
                        "give it another family" if np.isfinite(own[row, nth]) else "where none is known, write NaN"
                    )
                    raise ValueError(
                        f"sequence {one.name!r} of {self.name} has {own[row, nth]:g} in row "
                        f"{start + row - ends[of] + len(one)} of column {column.name!r}, and the family "
                        f"{column.family!r} is of {said}{size}; {advice}"
                    )
            rows = start + np.flatnonzero(absent[:, self._targets].any(1))
            gapped |= {*np.searchsorted(ends, rows, "right").tolist()}
            start += len(block)
        mapped = (place for place, one in enumerate(self.series) if is_mapped(one.values))
        return frozenset(self.series[place].name for place in mapped if place not in gapped)

    @cached_property
    def _targets(self) -> list[int]:
        """Indices of the target columns."""
        return [place for place, column in enumerate(self.columns.columns) if column.role == "target"]

    def __len__(self) -> int:
        return len(self.series)

    def __iter__(self) -> Iterator[Series]:
        return iter(self.series)

    def __repr__(self) -> str:
        lengths = [len(one) for one in self.series]
        steps = f"{min(lengths)}" if min(lengths) == max(lengths) else f"{min(lengths)} to {max(lengths)}"
        times = "" if all(one.times is None for one in self) else f"; {self.calendar}"
        return f"Panel({self.name}: {len(self)} sequences of {steps} steps{times}; {', '.join(self.columns.names)})"

    def fingerprint(self) -> str:
        """Return the SHA-256 of the columns and the sequences."""
        digest = hashlib.sha256(repr(self.columns).encode())
        for one in self.series:
            digest.update(repr((one.name, one.group, one.split, one.values.shape)).encode())
            for values in (one.values, one.times):
                if values is not None:
                    hash_values(digest, values, "<f8")
        return digest.hexdigest()

    @property
    def missing(self) -> bool:
        """Whether a value of a target is missing."""
        some = (one.values for one in self.series if one.name not in self.complete)
        return any(bool(np.isnan(block[:, self._targets]).any()) for block in row_blocks(some))

    def present(self, one: Series) -> int:
        """Return the number of steps up to the last one with a target; later rows belong to the future."""
        if one.name in self.complete:
            return len(one)
        for rows in reversed([*ranges(one.values)]):
            known = ~np.isnan(one.values[rows][:, self._targets]).all(1)
            if known.any():
                return int(rows.start + np.flatnonzero(known)[-1]) + 1
        return 0

    @property
    def groups(self) -> list[str]:
        """Sorted names of the groups."""
        return sorted({one.group for one in self.series})

    def only(self, names: Iterable[str]) -> Panel:
        """Return some of the sequences.

        Raises:
            ValueError: if a sequence does not exist.
        """
        own, names = {one.name: one for one in self.series}, list(names)
        for name in names:
            if name not in own:
                raise ValueError(f"{self.name} has no sequence {name!r}{nearest(name, own)}")
        return replace(self, series=[own[name] for name in names])

    @classmethod
    def of(cls, data: Any, columns: Columns | ColumnHints | Sequence[str] | None = None, name: str = "panel") -> Panel:
        """Build a panel from a common data structure.

        Args:
            data: a pandas frame in the long form, arrays, a list of arrays, or an xarray `Dataset`.
            columns: a schema, or targets as in `ColumnHints`, with the rest inferred. For arrays, a schema, or names of
                real targets; by default x0, x1, …
            name: name for titles.

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
                data, columns = _of_grid(data, columns)
            columns = columns.of(data) if isinstance(columns, ColumnHints) else columns
            frame = tabular(data)
            series, calendar = _of_frame(frame, columns)
            return cls(series, columns, name, calendar)
        check_real(data, "the table")
        arrays = [data] if hasattr(data, "ndim") and data.ndim == 2 else data
        if not isinstance(arrays, np.ndarray | torch.Tensor | list | tuple):
            raise TypeError(
                f"a table is built from a pandas frame, an xarray Dataset, arrays (N, T, D) or a list of arrays (T, "
                f"D), not of {type(data).__name__}"
            )
        for each in arrays:
            check_real(each, "the table")
            if (dtype := getattr(each, "dtype", None)) is not None and getattr(dtype, "kind", "") in ("m", "M"):
                raise TypeError(
                    f"the table is an array of {dtype}, which are times and not values; give a pandas frame with the "
                    'times in one column and the values in others, as pandas.DataFrame({"time": times, "x": x})'
                )
        plain = [each.detach().cpu().double().numpy() if isinstance(each, torch.Tensor) else each for each in arrays]
        found = [
            each.view(np.ndarray)
            if is_mapped(each) and each.dtype.kind in "fiu" and not np.ma.is_masked(each)
            else np.ma.filled(np.ma.array(each, np.float64, copy=True), np.nan)
            for each in plain
        ]
        if not found or any(each.ndim != 2 for each in found):
            whole = [data] if getattr(data, "ndim", 0) == 1 else found
            shapes = ", ".join(str(tuple(each.shape)) for each in whole[:3])
            advice = "; one sequence of one column is (T, 1), as of x[:, None]" if shapes else ""
            raise ValueError(f"sequences are (T, D); got {shapes or 'none'}{advice}")
        columns = plain_columns(columns, found[0].shape[1])
        return cls([Series(str(place), each) for place, each in enumerate(found)], columns, name)

    @classmethod
    def wide(cls, data: Any, column: Column | None = None, name: str = "panel", zone: str | None = None) -> Panel:
        """Build a panel from a pandas frame with one row per step and one column per sequence of a single variable.

        Args:
            data: the frame; an index of numbers, dates or durations is the time.
            column: description of the variable; by default a real target named "value".
            name: name for titles.
            zone: time zone of dates in the index, as in `Columns`.
        """
        index, when, calendar = data.index.to_series(name=data.index.name or "index"), None, Calendar()
        if is_number(index) or is_date(index) or is_duration(index):
            when, calendar = times(index, zone)
            order = _ordered(when, np.arange(len(when)), f"the table {name}", calendar, index.name)
            data, when = data.iloc[order], when[order]
        own = column or Column("value")
        series = []
        for each, held in data.items():
            values = numeric(held, own)
            known = np.flatnonzero(~np.isnan(values))  # columns may start and end at different times
            if len(known):
                part = slice(known[0], known[-1] + 1)
                series.append(Series(str(each), values[part, None], None if when is None else when[part]))
        return cls(series, Columns((own,)), name, calendar.stepping(one.times for one in series))


def plain_columns(columns: Columns | ColumnHints | Sequence[str] | None, size: int) -> Columns:
    """Return columns of arrays: as given, or real targets x0, x1, …

    Raises:
        ValueError: if a given entry does not apply to arrays, such as a time.
    """
    if isinstance(columns, ColumnHints):
        if strange := [name for name, value in vars(columns).items() if value and name != "columns"]:
            raise ValueError(
                f"arrays have no column names, so {', '.join(strange)} cannot be found; give a schema, in Python as "
                "columns=Columns(...), or as FILE.toml next to the file"
            )
        words = (f"{word}::".split(":")[:3] for word in columns.columns)
        told = tuple(Column(name, "target", family or "real", unit) for name, family, unit in words)
        columns = Columns(told) if told else None
    if isinstance(columns, Columns):
        if strange := [name for name in ("id", "time", "group", "split") if getattr(columns, name)]:
            raise ValueError(f"the schema names a column of {strange[0]}, but arrays have only numbers; leave it out")
        return columns
    return Columns(tuple(map(Column, columns or [f"x{place}" for place in range(size)])))


def _admitted(column: Column) -> tuple[Callable[[np.ndarray], np.ndarray], str]:
    """Return a test for the values of a column's family, except NaN, and its description."""
    tests: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
        "category": (lambda v: _counts(v) & (v < len(column.classes)), "the places of its classes"),
        "binary": (lambda v: (v == 0) | (v == 1), "0 or 1"),
        **dict.fromkeys(COUNTS, (_counts, "whole numbers from 0")),
        **dict.fromkeys(("positive", "log-normal"), (lambda v: v > 0, "numbers above 0")),
        "power": (lambda v: v >= 0, "numbers from 0"),
        "share": (lambda v: (v > 0) & (v < 1), "numbers above 0 and below 1"),
        "angle": (lambda v: np.abs(v) <= np.pi + 1e-6, "radians from -pi to pi"),
    }
    return tests.get(column.family, (lambda v: ~np.isnan(v), "numbers"))


def _counts(values: np.ndarray) -> np.ndarray:
    found: np.ndarray = (values >= 0) & (values % 1 == 0)
    return found


def _of_grid(data: Any, columns: Columns | ColumnHints) -> tuple[Any, Columns | ColumnHints]:
    """Return an xarray as a frame; by default one dimension is the time and the others identify sequences."""
    data = data if hasattr(data, "data_vars") else data.to_dataset(name=data.name or "x")
    frame, dims = data.to_dataframe().reset_index(), [str(name) for name in data.dims]
    if isinstance(columns, ColumnHints) and dims:
        dated = [name for name in dims if frame[name].dtype.kind in "mM" or TIMES.search(name.lower())]
        time = columns.time or (dated or dims)[-1]
        columns = replace(columns, time=time, id=columns.id or tuple(name for name in dims if name != time))
    return frame, columns


def _of_frame(frame: Any, columns: Columns) -> tuple[list[Series], Calendar]:
    """Return the sequences of a frame in the long form, and their calendar."""
    if lacking := [name for name in columns.needed if name not in frame.columns]:
        known = [str(name) for name in frame.columns]
        raise ValueError(
            f"no column {lacking[0]!r}{nearest(lacking[0], known)}; there are {', '.join(known[:20])}"
            f"{' …' if len(known) > 20 else ''}"
        )
    if not len(frame):
        raise ValueError("the table has no rows")
    settled = (columns.na_values, columns.decimal)
    values = np.stack([numeric(frame[column.name], column, *settled) for column in columns.columns], 1)
    told = {name: own for name in ("group", "split") if (own := getattr(columns, name))}
    labels = {name: texts(frame[own]).fillna("").to_numpy() for name, own in told.items()}
    rows, names = [np.arange(len(frame))], ["0"]
    if columns.id:
        if (unnamed := frame[list(columns.id)].isna().all(axis=1)).any():
            raise ValueError(
                f"{int(unnamed.sum())} of {len(frame)} rows have no {' and no '.join(columns.id)}, the first of them "
                f"row {int(np.argmax(unnamed))}; fill in which sequence they belong to, or remove them"
            )
        found = frame.groupby(list(columns.id), sort=False, observed=True, dropna=False).indices
        rows = [np.sort(places) for places in found.values()]
        keys = frame.iloc[[places[0] for places in rows]][list(columns.id)]
        order = _order(keys)
        rows, keys = [rows[place] for place in order], keys.iloc[order]
        names = ["/".join(key) for key in zip(*(texts(keys[own]).fillna("") for own in columns.id), strict=True)]
    when, calendar, found = None, Calendar(), []
    if columns.time is not None:
        moments = time_of(frame, columns.time, columns.decimal)
        when, calendar = times(moments, columns.zone, rows)
    for name, places in zip(names, rows, strict=True):
        if when is not None:
            places = _ordered(when, places, f"sequence {name!r}", calendar, moments.name)
        own = {}
        for what, all_labels in labels.items():
            if len(said := set(all_labels[places])) > 1:
                raise ValueError(
                    f"sequence {name!r} has several values of {told[what]}: {', '.join(sorted(said)[:3])}; expected one"
                )
            own[what] = said.pop()
        if own.get("split") and own["split"] not in SPLITS:
            raise ValueError(f"sequence {name!r} has split {own['split']!r}; expected one of {', '.join(SPLITS)}")
        found.append(Series(name, values[places], None if when is None else when[places], **own))
    return found, calendar.stepping(one.times for one in found)


def _order(keys: Any) -> np.ndarray:
    """Return the sorted order of ids (N, K): numbers by size, also in text, then other texts; missing ones last."""
    levels: list[np.ndarray] = []
    for name in keys:
        read, said = read_numbers(keys[name]), texts(keys[name])
        size = np.zeros(len(keys)) if read.wrong.any() or read.marks else read.values
        levels += [said.isna().to_numpy(), size, np.unique(said.fillna("").to_numpy(str), return_inverse=True)[1]]
    return np.lexsort(levels[::-1])


def _ordered(when: np.ndarray, rows: np.ndarray, who: str, calendar: Calendar, column: str | None) -> np.ndarray:
    """Return the rows of a sequence in time order.

    Raises:
        ValueError: if two rows have the same time, or consecutive recordings overlap in time.
    """
    if (np.diff(when[rows]) > 0).all():
        return rows
    if (np.diff(when[rows]) < 0).sum() >= len(rows) / 2:  # newest first
        rows = rows[::-1]
        if (np.diff(when[rows]) > 0).all():
            return rows
    order = np.argsort(when[rows], kind="stable")
    found = rows[order]
    advice = "name the id columns that distinguish sequences"
    if calendar.kind == "dates" and calendar.zone is None:
        advice += ', or, if clocks were set back, their zone, such as zone = "Europe/Berlin"'
    if calendar.kind == "durations":
        advice += ", or write the date before clocks that begin again at midnight"
    if (twice := np.diff(when[found]) == 0).any():
        advice += ", or remove the duplicate row"
        first, second = sorted(found[np.argmax(twice) :][:2])
        raise ValueError(f"{who} has two rows at {column} {calendar.text(when[first])}, {first} and {second}; {advice}")
    back = np.concatenate([[False, False, False], np.diff(when[rows]) < 0])
    ends = np.where(back[2:], ~back[1:-1], back[1:-1] & back[:-2])  # ends of increasing or decreasing runs
    run = np.cumsum(ends)  # index of the run of each row
    overlap = len(rows) >= RUN * (run[-1] + 1) and (np.diff(run[order]) != 0).sum() > CHANGES * run[-1]
    if overlap or calendar.kind == "durations":  # clocks restart at midnight
        last, row = rows[np.argmax(run) - 1 :][:2]
        raise ValueError(
            f"{who} goes back from {column} {calendar.text(when[last])} in row {last} to {calendar.text(when[row])} in "
            f"row {row}; {advice}, or, if it is one sequence, sort its rows by {column}"
        )
    return found
