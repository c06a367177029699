"""Panel: sequences of several columns in memory, made of whatever holds them.

| from | how |
|---|---|
| pandas, long | one row for each sequence and step: `Panel.of(frame, columns)`, with `id` and `time` |
| pandas, wide | one row for each step, one column for each sequence: `Panel.wide(frame)` |
| numpy, torch | (N, T, D), or (T, D) of one sequence |
| a list of such | sequences of different lengths (T_n, D) |
| xarray | a `Dataset` whose variables share a dimension of time, and perhaps one of sequences |
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from ..options import nearest
from .columns import Column, Columns

SPLITS = ("train", "validation", "test")
COUNTS = ("count", "overdispersed", "sparse", "sparse-overdispersed")
"""Families of whole numbers."""


@dataclass(frozen=True, eq=False)
class Series:
    """One sequence.

    Args:
        name: that tells it from the others.
        values: (T, C) of the columns, float64; a category as the index of its class; NaN where missing.
        times: (T,) of the steps, increasing, dates in seconds since 1970; None for steps 0, 1, …
        group: that it belongs to.
        split: "train", "validation" or "test", where the data say it.
    """

    name: str
    values: np.ndarray
    times: np.ndarray | None = None
    group: str = ""
    split: str = ""

    def __len__(self) -> int:
        return len(self.values)


@dataclass(frozen=True, eq=False)
class Panel:
    """Sequences of the same columns.

    Args:
        series: the sequences.
        columns: what their columns are.
        name: for titles.
        dates: whether times are dates, in seconds since 1970.

    Raises:
        ValueError: sequences that are empty, of other columns, of one name, out of order, or with values that their
            column cannot have.
    """

    series: Sequence[Series]
    columns: Columns
    name: str = "panel"
    dates: bool = False

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
                raise ValueError(f"{who} has times that do not increase, or two rows of one time")
            if np.isinf(one.values).any():
                raise ValueError(f"{who} has infinite values in {self._first(np.isinf(one.values))}")
        for place, column in enumerate(self.columns.columns):
            self._check(place, column)

    def _first(self, wrong: np.ndarray) -> str:
        row, place = np.argwhere(wrong)[0]
        return f"row {row} of column {self.columns.names[place]!r}"

    def _check(self, place: int, column: Column) -> None:
        """Refuses what the family of a column does not have."""
        tests = {
            "category": (lambda v: _counts(v) & (v < len(column.classes)), "the places of its classes"),
            "binary": (lambda v: (v == 0) | (v == 1), "0 or 1"),
            **dict.fromkeys(COUNTS, (_counts, "whole numbers from 0")),
            **dict.fromkeys(("positive", "log-normal"), (lambda v: v > 0, "numbers above 0")),
            "power": (lambda v: v >= 0, "numbers from 0"),
            "share": (lambda v: (v > 0) & (v < 1), "numbers above 0 and below 1"),
            "angle": (lambda v: np.abs(v) <= np.pi + 1e-9, "radians from -pi to pi"),
        }
        if column.family not in tests:
            return
        right, said = tests[column.family]
        for one in self.series:
            values = one.values[:, place]
            wrong = ~right(values) & ~np.isnan(values)
            if wrong.any():
                raise ValueError(
                    f"sequence {one.name!r} of {self.name} has {values[wrong][0]:g} in row {np.argmax(wrong)} of "
                    f"column {column.name!r}, and the family {column.family!r} is of {said}; give it another family"
                )

    def __len__(self) -> int:
        return len(self.series)

    def __iter__(self) -> Iterator[Series]:
        return iter(self.series)

    def __repr__(self) -> str:
        lengths = [len(one) for one in self.series]
        steps = f"{min(lengths)}" if min(lengths) == max(lengths) else f"{min(lengths)} to {max(lengths)}"
        return f"Panel({self.name}: {len(self)} sequences of {steps} steps; {', '.join(self.columns.names)})"

    def fingerprint(self) -> str:
        """SHA-256 of what the columns are and what the sequences hold."""
        digest = hashlib.sha256(repr(self.columns).encode())
        for one in self.series:
            digest.update(repr((one.name, one.group, one.split, one.values.shape)).encode())
            for values in (one.values, one.times):
                digest.update(b"" if values is None else np.ascontiguousarray(values, "<f8").tobytes())
        return digest.hexdigest()

    @property
    def missing(self) -> bool:
        """Whether some value of a target is."""
        places = [place for place, column in enumerate(self.columns.columns) if column.role == "target"]
        return any(bool(np.isnan(one.values[:, places]).any()) for one in self.series)

    @property
    def groups(self) -> list[str]:
        """Names of the groups, in order."""
        return sorted({one.group for one in self.series})

    def only(self, names: Iterable[str]) -> Panel:
        """Some of the sequences.

        Raises:
            ValueError: one that is not there.
        """
        own, names = {one.name: one for one in self.series}, list(names)
        for name in names:
            if name not in own:
                raise ValueError(f"{self.name} has no sequence {name!r}{nearest(name, own)}")
        return replace(self, series=[own[name] for name in names])

    @classmethod
    def of(cls, data: Any, columns: Columns | Sequence[str] | None = None, name: str = "panel") -> Panel:
        """A table of whatever holds one; see the file.

        Args:
            data: a pandas frame in the long form, arrays, a list of arrays, or an xarray `Dataset`.
            columns: what the columns are: a schema; names, of real targets; or nothing, for names x0, x1, …
            name: for titles.

        Raises:
            TypeError: data of another kind.
            ValueError: columns that the data do not have, or values that are none.
        """
        if isinstance(data, Panel):
            return data
        kind = type(data).__module__.partition(".")[0]
        if kind == "xarray":
            data, kind = data.to_dataframe().reset_index(), "pandas"
        if kind == "pandas":
            if not isinstance(columns, Columns):
                from .proposing import Told

                columns = Told(columns=tuple(columns or ())).of(data)
            dates = columns.time is not None and not _is_number(data[columns.time])
            return cls(list(_of_frame(data, columns)), columns, name, dates)
        arrays = [data] if hasattr(data, "ndim") and data.ndim == 2 else data
        if not isinstance(arrays, np.ndarray | torch.Tensor | list | tuple):
            raise TypeError(
                f"a table is made of a pandas frame, an xarray Dataset, arrays (N, T, D) or a list of arrays (T, D), "
                f"not of {type(data).__name__}"
            )
        found = [np.asarray(each, np.float64) for each in arrays]
        if not found or any(each.ndim != 2 for each in found):
            raise ValueError(f"sequences are (T, D); got {', '.join(str(each.shape) for each in found[:3]) or 'none'}")
        if not isinstance(columns, Columns):
            names = columns or [f"x{place}" for place in range(found[0].shape[1])]
            columns = Columns(tuple(map(Column, names)))
        return cls([Series(str(place), each) for place, each in enumerate(found)], columns, name)

    @classmethod
    def wide(cls, data: Any, column: Column | None = None, name: str = "panel") -> Panel:
        """A table of a pandas frame with one row for each step and one column for each sequence of one variable.

        Args:
            data: whose index is the time, where it is of numbers or dates.
            column: what all of them hold; a real target named "value", if not given.
            name: for titles.
        """
        times = None if data.index.dtype == object else _times(data.index.to_series())
        own = column or Column("value")
        series = []
        for each in data.columns:
            values = _numbers(data[each], own)
            known = np.flatnonzero(~np.isnan(values))  # columns may begin and end at different times
            if len(known):
                part = slice(known[0], known[-1] + 1)
                series.append(Series(str(each), values[part, None], None if times is None else times[part]))
        return cls(series, Columns((own,)), name, times is not None and not _is_number(data.index.to_series()))


def _counts(values: np.ndarray) -> np.ndarray:
    found: np.ndarray = (values >= 0) & (values % 1 == 0)
    return found


def _of_frame(frame: Any, columns: Columns) -> Iterator[Series]:
    """The sequences of a frame in the long form."""
    if lacking := [name for name in columns.needed if name not in frame.columns]:
        known = [str(name) for name in frame.columns]
        raise ValueError(
            f"no column {lacking[0]!r}{nearest(lacking[0], known)}; there are {', '.join(known[:20])}"
            f"{' …' if len(known) > 20 else ''}"
        )
    if not len(frame):
        raise ValueError("the table has no rows")
    values = np.stack([_numbers(frame[column.name], column) for column in columns.columns], 1)
    times = None if columns.time is None else _times(frame[columns.time])
    labels = {name: frame[own].astype(str).to_numpy() for name in ("group", "split") if (own := getattr(columns, name))}
    rows = [(("0",), np.arange(len(frame)))]
    if columns.id:
        found = frame.groupby(list(columns.id), sort=False, observed=True, dropna=False).indices
        rows = [(key if isinstance(key, tuple) else (key,), np.sort(places)) for key, places in found.items()]
    for key, places in rows:
        name = "/".join(map(str, key))
        if times is not None:
            places = places[np.argsort(times[places], kind="stable")]
            if (twice := np.diff(times[places]) == 0).any():
                when = frame[columns.time].iloc[places[np.argmax(twice)]]
                raise ValueError(
                    f"sequence {name!r} has two rows at {columns.time} {when}; name the id columns that part them"
                )
        own = {}
        for what, all_labels in labels.items():
            if len(said := set(all_labels[places])) > 1:
                raise ValueError(
                    f"sequence {name!r} has several values of {what}: {', '.join(sorted(said)[:3])}; it has one"
                )
            own[what] = said.pop()
        if own.get("split") and own["split"] not in SPLITS:
            raise ValueError(f"sequence {name!r} is of split {own['split']!r}; expected one of {', '.join(SPLITS)}")
        yield Series(name, values[places], None if times is None else times[places], **own)


def _is_number(column: Any) -> bool:
    import pandas as pd

    return bool(pd.api.types.is_numeric_dtype(column))


def _times(column: Any) -> np.ndarray:
    """Seconds since 1970 of dates, or the numbers that they are."""
    import pandas as pd

    if _is_number(column):
        found = column.to_numpy(np.float64)
    else:
        try:
            found = pd.to_datetime(column, utc=True).to_numpy("datetime64[ns]").astype("int64") / 1e9
        except (TypeError, ValueError) as error:
            raise ValueError(f"the times of column {column.name!r} are neither numbers nor dates: {error}") from error
    if (bad := ~np.isfinite(found) | (found < -9e9)).any():
        raise ValueError(f"row {int(np.argmax(bad))} of column {column.name!r} has no time")
    return found  # type: ignore[no-any-return]


def _numbers(column: Any, told: Column) -> np.ndarray:
    """The values of a pandas column as numbers, of a category as the place of its class."""
    import pandas as pd

    if told.family == "category":
        places = {each: place for place, each in enumerate(told.classes)}
        texts = column.astype(str).where(column.notna())
        unknown = texts.notna() & ~texts.isin(list(places))
        if unknown.any():
            value = texts[unknown].iloc[0]
            raise ValueError(
                f"column {told.name!r} has {value!r}{nearest(value, places)}, which is none of its classes: "
                f"{', '.join(told.classes[:10])}"
            )
        return texts.map(places).to_numpy(np.float64)  # type: ignore[no-any-return]
    if pd.api.types.is_bool_dtype(column):
        column = column.astype(float)
    try:
        return pd.to_numeric(column).to_numpy(np.float64, na_value=np.nan)  # type: ignore[no-any-return]
    except (TypeError, ValueError) as error:
        texts = column.astype(str)
        wrong = pd.to_numeric(texts, errors="coerce").isna() & column.notna()
        value = texts[wrong].iloc[0] if wrong.any() else "?"
        raise ValueError(
            f"column {told.name!r} holds {value!r}, which is no number; leave it out, or give it the family 'category'"
        ) from error
