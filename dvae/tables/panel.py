"""Panel: sequences of several columns in memory, made of whatever holds them.

| from | how |
|---|---|
| pandas, long | one row for each sequence and step: `Panel.of(frame, columns)`, with `id` and `time`, or in its index |
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
from .parsing import is_number, numeric, tabular, texts, times
from .proposing import LARGEST, TIMES, Told, is_date

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

    def moments(self, start: int, steps: int) -> np.ndarray | None:
        """Times (steps,) from a step on; behind the end as far apart as the median of them all."""
        if self.times is None:
            return None
        own = self.times[start : start + steps]
        apart = np.median(np.diff(self.times)) if len(self) > 1 else 1.0
        return np.concatenate([own, self.times[-1] + apart * np.arange(1, steps - len(own) + 1)])


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
        for place, column in enumerate(self.columns.columns):
            self._check(np.concatenate([one.values[:, place] for one in self.series]), column)

    def _check(self, values: np.ndarray, column: Column) -> None:
        """Refuses what the family of a column does not have."""
        tests = {
            "category": (lambda v: _counts(v) & (v < len(column.classes)), "the places of its classes"),
            "binary": (lambda v: (v == 0) | (v == 1), "0 or 1"),
            **dict.fromkeys(COUNTS, (_counts, "whole numbers from 0")),
            **dict.fromkeys(("positive", "log-normal"), (lambda v: v > 0, "numbers above 0")),
            "power": (lambda v: v >= 0, "numbers from 0"),
            "share": (lambda v: (v > 0) & (v < 1), "numbers above 0 and below 1"),
            "angle": (lambda v: np.abs(v) <= np.pi + 1e-6, "radians from -pi to pi"),
        }
        right, said = tests.get(column.family, (lambda v: ~np.isnan(v), "numbers"))
        with np.errstate(invalid="ignore", over="ignore"):
            seen = right(values.astype(np.float32))  # as models compute
        wrong = ~(seen & (np.abs(values) < LARGEST)) & ~np.isnan(values)
        if wrong.any():
            row = first = int(np.argmax(wrong))
            for one in self.series:
                if row < len(one):
                    break
                row -= len(one)
            size = f", below {LARGEST:g} in size" if seen[first] else ""
            raise ValueError(
                f"sequence {one.name!r} of {self.name} has {values[first]:g} in row {row} of column {column.name!r}, "
                f"and the family {column.family!r} is of {said}{size}; give it another family"
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

    def present(self, one: Series) -> int:
        """Steps of a sequence up to the last one that has a target; rows behind it are of the future."""
        places = [place for place, column in enumerate(self.columns.columns) if column.role == "target"]
        return int(np.flatnonzero(~np.isnan(one.values[:, places]).all(1)).max(initial=-1)) + 1

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
    def of(cls, data: Any, columns: Columns | Told | Sequence[str] | None = None, name: str = "panel") -> Panel:
        """A table of whatever holds one; see the file.

        Args:
            data: a pandas frame in the long form, arrays, a list of arrays, or an xarray `Dataset`.
            columns: what the columns are: a schema, or targets in words, see `Told`, and the rest as it is proposed; of
                arrays a schema; names, of real targets; or nothing, for names x0, x1, …
            name: for titles.

        Raises:
            TypeError: data of another kind.
            ValueError: columns that the data do not have, or values that are none.
        """
        if isinstance(data, Panel):
            if isinstance(columns, Columns) and columns != data.columns:
                raise ValueError(
                    f"{data.name} is a panel of {', '.join(data.columns.names)}, whose columns are another thing than "
                    f"{', '.join(columns.names)}; give what it was made of, or none of these"
                )
            return data
        kind = type(data).__module__.partition(".")[0]
        if kind in ("pandas", "xarray"):
            if not isinstance(columns, Columns | Told):
                columns = Told(columns=tuple(columns or ()))
            if kind == "xarray":
                data, columns = _of_grid(data, columns)
            frame = tabular(data)
            columns = columns.of(frame) if isinstance(columns, Told) else columns
            series = list(_of_frame(frame, columns))
            return cls(series, columns, name, columns.time is not None and not is_number(frame[columns.time]))
        arrays = [data] if hasattr(data, "ndim") and data.ndim == 2 else data
        if not isinstance(arrays, np.ndarray | torch.Tensor | list | tuple):
            raise TypeError(
                f"a table is made of a pandas frame, an xarray Dataset, arrays (N, T, D) or a list of arrays (T, D), "
                f"not of {type(data).__name__}"
            )
        plain = [each.detach().cpu().double().numpy() if isinstance(each, torch.Tensor) else each for each in arrays]
        found = [np.asarray(each, np.float64).copy() for each in plain]
        if not found or any(each.ndim != 2 for each in found):
            whole = [data] if getattr(data, "ndim", 0) == 1 else found
            shapes = ", ".join(str(tuple(each.shape)) for each in whole[:3])
            advice = "; one sequence of one column is (T, 1), as of x[:, None]" if shapes else ""
            raise ValueError(f"sequences are (T, D); got {shapes or 'none'}{advice}")
        if not isinstance(columns, Columns):
            named = columns.columns if isinstance(columns, Told) else columns
            columns = Columns(tuple(map(Column, named or [f"x{place}" for place in range(found[0].shape[1])])))
        return cls([Series(str(place), each) for place, each in enumerate(found)], columns, name)

    @classmethod
    def wide(cls, data: Any, column: Column | None = None, name: str = "panel") -> Panel:
        """A table of a pandas frame with one row for each step and one column for each sequence of one variable.

        Args:
            data: whose index is the time, where it is of numbers or dates.
            column: what all of them hold; a real target named "value", if not given.
            name: for titles.
        """
        index, when = data.index.to_series(), None
        if is_number(index) or is_date(index):
            when = times(index)
            data, when = data.iloc[np.argsort(when, kind="stable")], np.sort(when)
        own = column or Column("value")
        series = []
        for each, held in data.items():
            values = numeric(held, own)
            known = np.flatnonzero(~np.isnan(values))  # columns may begin and end at different times
            if len(known):
                part = slice(known[0], known[-1] + 1)
                series.append(Series(str(each), values[part, None], None if when is None else when[part]))
        return cls(series, Columns((own,)), name, when is not None and not is_number(index))


def _counts(values: np.ndarray) -> np.ndarray:
    found: np.ndarray = (values >= 0) & (values % 1 == 0)
    return found


def _of_grid(data: Any, columns: Columns | Told) -> tuple[Any, Columns | Told]:
    """An xarray as a frame; where nothing is told of them, its dimensions are time, and what parts sequences."""
    data = data if hasattr(data, "data_vars") else data.to_dataset(name=data.name or "x")
    frame, dims = data.to_dataframe().reset_index(), [str(name) for name in data.dims]
    if isinstance(columns, Told) and dims:
        dated = [name for name in dims if frame[name].dtype.kind == "M" or TIMES.search(name.lower())]
        time = columns.time or (dated or dims)[-1]
        columns = replace(columns, time=time, id=columns.id or tuple(name for name in dims if name != time))
    return frame, columns


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
    values = np.stack([numeric(frame[column.name], column) for column in columns.columns], 1)
    when = None if columns.time is None else times(frame[columns.time])
    told = {name: own for name in ("group", "split") if (own := getattr(columns, name))}
    labels = {name: texts(frame[own]).fillna("").to_numpy() for name, own in told.items()}
    rows, names = [np.arange(len(frame))], ["0"]
    if columns.id:
        found = frame.groupby(list(columns.id), sort=True, observed=True, dropna=False).indices
        rows = [np.sort(places) for places in found.values()]
        firsts = frame.iloc[[places[0] for places in rows]]
        names = ["/".join(key) for key in zip(*(texts(firsts[own]).fillna("") for own in columns.id), strict=True)]
    for name, places in zip(names, rows, strict=True):
        if when is not None:
            places = places[np.argsort(when[places], kind="stable")]
            if (twice := np.diff(when[places]) == 0).any():
                moment = frame[columns.time].iloc[places[np.argmax(twice)]]
                raise ValueError(
                    f"sequence {name!r} has two rows at {columns.time} {moment}; name the id columns that part them"
                )
        own = {}
        for what, all_labels in labels.items():
            if len(said := set(all_labels[places])) > 1:
                raise ValueError(
                    f"sequence {name!r} has several values of {told[what]}: {', '.join(sorted(said)[:3])}; it has one"
                )
            own[what] = said.pop()
        if own.get("split") and own["split"] not in SPLITS:
            raise ValueError(f"sequence {name!r} is of split {own['split']!r}; expected one of {', '.join(SPLITS)}")
        yield Series(name, values[places], None if when is None else when[places], **own)
