"""Proposals: what the columns of a table that nobody described probably are, to be read and corrected by a person."""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection
from dataclasses import dataclass, replace
from reprlib import repr as brief
from typing import Any

import numpy as np

from ..options import nearest
from .columns import Column, Columns, Role
from .parsing import Undecided, dates, is_duration, is_number, tabular, texts

CLASSES = 20
"""Most different texts of a category; more are an id, or a text."""
SPREAD = 1.5
"""Variance over mean above which counts vary more than Poisson's."""
LARGEST = 1e30
"""Of all values; models compute in float32."""
TIMES = re.compile(
    r"(^|_)(time|date|datetime|timestamp|day|week|month|quarter|year|hour|minute|second|step|frame|t|ds)(_|$)"
)
IDS = re.compile(r"(^|_)(id|unique_id|series|sequence|subject|station|store|item|patient|name|key)(_|$)")


@dataclass(frozen=True)
class Told:
    """What a person says of columns in words; a column is "name", "name:family" or "name:family:unit".

    Args:
        columns: targets; all that are nothing else, if none is named.
        covariates: known in the future too, as a plan or a calendar.
        past: covariates that end with the present.
        static: covariates with one value a sequence.
        id: columns that tell sequences apart.
        time: column of dates or numbers.
        group: column that is the same within a sequence.
        zone: time zone of dates, such as "Europe/Berlin".
    """

    columns: tuple[str, ...] = ()
    covariates: tuple[str, ...] = ()
    past: tuple[str, ...] = ()
    static: tuple[str, ...] = ()
    id: tuple[str, ...] = ()
    time: str | None = None
    group: str | None = None
    zone: str | None = None

    def of(self, frame: Any) -> Columns:
        """The columns of a frame, with what is not told as it is proposed.

        Raises:
            ValueError: columns that the frame does not have, or families that there are not.
        """
        frame = tabular(frame)
        known = list(frame.columns)
        roles: dict[str, tuple[Role, str]] = {}
        said: dict[Role, tuple[str, ...]]
        said = {"target": self.columns, "known": self.covariates, "past": self.past, "static": self.static}
        for role, words in said.items():
            for word in words:
                name = word if word in known else word.partition(":")[0]
                if name in roles:
                    raise ValueError(f"column {name!r} is named twice")
                roles[name] = (role, word[len(name) + 1 :])
        for name in (*roles, *self.id, *filter(None, (self.time, self.group))):
            if name not in known:
                raise ValueError(f"no column {name!r}{nearest(name, known)}; there are {', '.join(known[:20])}")
        found, undecided = _proposed(frame, self.time, self.id, roles)
        layout: dict[str, Any] = {"id": found.id, "time": found.time, "group": self.group, "zone": self.zone}
        aside = {*layout["id"], *filter(None, (found.time, self.group))}
        own = {column.name: column for column in found.columns if column.name not in aside}
        names = list(roles) if self.columns else [*(name for name in own if name not in roles), *roles]
        columns = []
        for name in names:
            role, said_of_it = roles.get(name, (own[name].role, "")) if name in own else roles[name]
            family, _, unit = said_of_it.partition(":")
            columns.append(_told(name, role, family, unit, frame[name], own.get(name)))
        return _with_notes(frame, Columns(tuple(columns), **layout), undecided, all_named=not self.columns)


def _told(name: str, role: Role, family: str, unit: str, values: Any, guess: Column | None) -> Column:
    """A column of which a role, and perhaps family and unit, are told."""
    family = family or (guess.family if guess else "real")
    if role != "target" and family != "category":
        family = "real"
    classes = tuple(sorted(texts(values).dropna().unique())) if family == "category" else ()
    return Column(name, role, family, unit, classes)


def proposed(frame: Any, time: str | None = None, id: tuple[str, ...] = (), others: Collection[str] = ()) -> Columns:
    """What a pandas frame in the long form probably is.

    The first column of dates, or with the name of a time, is that. Columns of texts that repeat, and of whole numbers
    with the name of an id, tell sequences apart where that leaves no two rows at one time. What is the same within each
    of several sequences is static. All other columns are targets: whole numbers from 0 are counts, two values a binary,
    few texts a category, numbers above 0 that vary by more than half their mean positive. What is none of these is left
    out, and a warning says so.

    Args:
        frame: whose columns are looked at.
        time: the column of the times, if it is known.
        id: the columns that tell sequences apart, if they are known.
        others: columns that are neither.

    Raises:
        ValueError: no column that could be a target.
    """
    frame = tabular(frame)
    found, undecided = _proposed(frame, time, id, others)
    return _with_notes(frame, found, undecided)


def _proposed(
    frame: Any, time: str | None, id: tuple[str, ...], others: Collection[str]
) -> tuple[Columns, dict[str, str]]:
    """What it is, and the columns that could be its time, were their dates decided, with what they hold."""
    names = list(frame.columns)
    free = [name for name in names if name not in (*others, *id) and not _numbers_rows(name, frame[name])]
    undecided: dict[str, str] = {}
    if time is None:
        time = next((name for name in free if _is_time(name, frame[name], undecided)), None)
    if time is None and not undecided:
        time = next((name for name in free if is_duration(frame[name])), None)
    if time is None:
        time = next((name for name in free if TIMES.search(name.lower()) and is_number(frame[name])), None)
    free = [name for name in free if name not in (time, *undecided)]
    rest = [name for name in names if name in free or (name in others and name != time)]
    step = time or next(iter(undecided), None)  # which tells rows apart, in whatever order
    ids = list(id)
    if not ids and step is not None and frame[step].duplicated().any():
        named = [n for n in free if _is_whole(frame[n]) and IDS.search(n.lower())]
        for name in (*named, *(n for n in free if not is_number(frame[n]) and frame[n].nunique() < len(frame))):
            left = frame.duplicated([*ids, step]).sum()
            if not left:
                break
            if frame.duplicated([*ids, name, step]).sum() < left:
                ids.append(name)
        for name in tuple(ids):  # those before the one that alone suffices
            fewer = [other for other in ids if other != name]
            ids = ids if frame.duplicated([*fewer, step]).any() else fewer
    found = [column for name in rest if name not in ids and (column := _column(name, frame[name])) is not None]
    if not ids:  # a panel of one sequence
        ids = [name for name in free if IDS.search(name.lower()) and frame[name].nunique(dropna=False) == 1]
        found = [column for column in found if column.name not in ids]
    if ids and len(groups := frame.groupby(ids, observed=True)) > 1:
        changing = groups[[column.name for column in found]].nunique().max() > 1
        found = [column if changing[column.name] else _static(column) for column in found]
    if not found:
        raise ValueError(f"none of the columns {', '.join(names[:20])} holds numbers or a few classes")
    return Columns(tuple(found), tuple(ids), time), undecided


def _is_time(name: str, values: Any, undecided: dict[str, str]) -> bool:
    """Whether a column holds dates; notes those whose day and month cannot be told apart."""
    try:
        return is_date(values)
    except Undecided as error:
        undecided[name] = str(error)
        return False


def _numbers_rows(name: str, values: Any) -> bool:
    """Whether a column is the index that pandas writes into a CSV, without a name."""
    return name == "Unnamed: 0" and _is_whole(values) and bool(values.is_unique)


def _with_notes(frame: Any, columns: Columns, undecided: dict[str, str], all_named: bool = True) -> Columns:
    """The columns; what of the frame is not among them is said in warnings."""
    lacking = () if columns.time else undecided
    aside = [name for name in frame.columns if name not in columns.needed and (all_named or name in lacking)]
    said = []
    for name in aside:
        values = frame[name].dropna()
        why = f"neither numbers nor 2 to {CLASSES} classes"
        if len(values):
            why += f", such as {brief(str(values.iloc[0]))}"
        if name in undecided:
            why = f"perhaps the time: {undecided[name]}"
        elif _numbers_rows(name, values):
            why = "the numbers of the rows, without a name"
        said.append(f"{name!r} ({why})")
    if said:
        warnings.warn(f"left out of what is proposed: {', '.join(said)}", stacklevel=3)
    return columns


def _column(name: str, values: Any) -> Column | None:
    """What a column probably holds; None for what is no target, as texts that are all different."""
    known = values.dropna().infer_objects()  # true and false, where some are missing
    if not len(known):
        return None
    if not is_number(known):
        classes = sorted(texts(known).unique())
        return Column(name, family="category", classes=tuple(classes)) if 2 <= len(classes) <= CLASSES else None
    numbers = known.to_numpy(np.float64)
    if set(np.unique(numbers)) == {0.0, 1.0}:
        return Column(name, family="binary")
    if not (np.abs(numbers) < LARGEST).all():
        return Column(name)  # which reading refuses
    if (numbers >= 0).all() and (numbers % 1 == 0).all() and len(np.unique(numbers)) > 2:
        return Column(name, family="overdispersed" if numbers.var() > SPREAD * numbers.mean() else "count")
    if (numbers > 0).all() and numbers.std() > 0.5 * numbers.mean():
        return Column(name, family="positive")
    return Column(name)


def _static(column: Column) -> Column:
    family = "category" if column.family == "category" else "real"
    return replace(column, role="static", family=family)


def _is_whole(values: Any) -> bool:
    return is_number(values) and bool((values.dropna() % 1 == 0).all())


def is_date(values: Any) -> bool:
    """Whether a column holds dates, or texts of them.

    Raises:
        Undecided: dates that can be read in several ways.
    """
    import pandas as pd

    if pd.api.types.is_datetime64_any_dtype(values):
        return True
    known = values.dropna()
    if is_number(values) or not len(known):
        return False
    some = known.iloc[:: max(len(known) // 50, 1)].astype(str)
    if not some.str.contains(r"\d{4}|\d\W{1,2}\d|\d[-/. ]?[A-Za-z]{3}").all():
        return False
    for part in (some, known):
        try:
            return bool(dates(part).notna().all())
        except Undecided as error:  # by some, where others may tell
            undecided = error
        except (TypeError, ValueError):
            return False
    raise undecided
