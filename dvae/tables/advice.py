"""Find what makes models of a table worse or their bounds dishonest, and name the option that settles it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from .calendar import EVEN, FEATURES, FLAG, Calendar, functions_of_time
from .columns import ROUNDED, Column
from .numerals import resolution
from .panel import Panel, Series
from .protocol import Cut, begin_of

SPIKE, REPEATS = 0.05, 20
"""Share and number of equal values that are a spike; REPEATS is also the minimum number of compared rows."""
HURDLE = 0.3
"""Share of equal values above which a family or a column of its own for them is proposed too."""
ALIGNED = 0.5
"""Share of the pairs of a sequence and a date that have a row, above which sequences share their dates."""
YEARS = (1500, 2500)
"""Range of whole numbers that are read as years."""
SAME, SAME_CHANGE = 0.999, 0.95
"""Rank correlations of values and of changes above which one column is a function of another.

Both are required, since all columns with a trend have similar ranks.
"""
MINORITY = 0.5
"""Share of longer steps below which rows may be absent, and above which the steps are uneven by nature."""
CONTRAST = 10.0
"""Ratio of scales or levels of sequences above which they differ."""
LONG = 8
"""Minimum number of values that determine the scale of a sequence."""
SERIAL = (20_000, 80_000)
"""Range of days since 1899-12-30, the first date of spreadsheets, that are read as dates."""
NEAR = 7
"""Largest lag of copies in which no number is unique."""
ROWS, COMPARED, COLUMNS = 200_000, 5000, 30
"""Maximum numbers of rows that are read, and of rows and columns that are compared with each other."""


def findings(panel: Panel, cut: Cut, guessed: bool) -> list[str]:
    """Return sentences about a table, each with the option that settles it.

    Args:
        panel: the sequences; the first 200,000 rows are read, and 5000 rows of 30 columns compared with each other.
        cut: how sequences are split and cut.
        guessed: whether columns and cut are guesses.
    """
    count = 1 + int(np.searchsorted(np.cumsum([len(sequence) for sequence in panel]), ROWS))
    sequences, columns = panel.series[:count], panel.columns.columns
    values = np.concatenate([np.asarray(sequence.values[:ROWS], np.float64) for sequence in sequences])
    owners = np.repeat(np.arange(len(sequences)), [len(sequence.values[:ROWS]) for sequence in sequences])
    times = [sequence.times[:ROWS] for sequence in sequences if sequence.times is not None]
    dated = _untimed(columns, values, owners)
    if times:
        dated = _dated(columns, values, np.concatenate(times), panel.calendar, owners, guessed)
    compared = columns[:COLUMNS], values[:COMPARED, :COLUMNS], owners[:COMPARED]
    return [
        *_spikes(columns, values),
        *_marks(columns, values),
        *_serial(panel, times),
        *_split(panel, cut, guessed),
        *_season(panel, cut),
        *(() if panel.columns.lags or panel.calendar.skips_days else _absent(times)),  # with lags, the schema warns
        *dated,
        *_leaks(*compared),
        *_scales(columns, sequences),
    ]


def is_aligned(panel: Panel) -> bool:
    """Return whether several sequences have nearly the same dates or years."""
    times = [sequence.times for sequence in panel if sequence.times is not None]
    if len(times) < max(len(panel), 2):
        return False
    joined = np.concatenate(times)
    is_year = (joined % 1 == 0).all() and YEARS[0] <= joined.min() and joined.max() <= YEARS[1]
    is_dated = panel.calendar.kind == "dates" or (panel.calendar.kind == "numbers" and is_year)
    return bool(is_dated and len(joined) > ALIGNED * len(times) * len(np.unique(joined)))


def _spikes(columns: Sequence[Column], values: np.ndarray) -> Iterator[str]:
    spikes = []
    for column, cells in zip(columns, values.T, strict=True):
        levels, counts = np.unique(cells[~np.isnan(cells)], return_counts=True)
        if column.role != "target" or column.family not in ROUNDED or column.rounding or not len(levels):
            continue
        if len(levels) > 2 and _is_mark(levels, counts, int(counts.argmax())):
            continue
        share, level, unit = counts.max() / counts.sum(), levels[counts.argmax()], resolution(levels)
        remedies = [f"rounding = {unit:g}"] if unit else []
        remedies += ["the family sparse-overdispersed"] if unit == 1 and levels[0] == level == 0 else []
        if not unit or share >= HURDLE:
            is_hurdle = levels[0] == level == 0 and unit != 1  # positive whole numbers repeat, too
            remedies += [
                "the family hurdle" if is_hurdle else "one binary column for it, and another that is empty there"
            ]
        if share > SPIKE and counts.max() >= REPEATS:
            spikes.append(f"{share:.0%} of {column.name!r} are {level:g} ({' or '.join(remedies)})")
    if spikes:
        yield (
            "a continuous density has no bound at a value that occurs often, so bounds can grow without limit; declare "
            f"what the brackets propose: {', '.join(spikes)}"
        )


def _marks(columns: Sequence[Column], values: np.ndarray) -> Iterator[str]:
    """Yield repeated values that may mark missing values."""
    for column, cells in zip(columns, values.T, strict=True):
        levels, counts = np.unique(cells[~np.isnan(cells)], return_counts=True)
        for place in {0, len(levels) - 1} if len(levels) > 2 and column.family != "category" else ():
            if _is_mark(levels, counts, place):
                mark = f"{levels[place]:g}"
                yield (
                    f"{counts[place]} values of {column.name!r} are {mark}, far from all others; if it marks missing "
                    f'values, set na_values = ["{mark}"] (--na-values {mark})'
                )


def _is_mark(levels: np.ndarray, counts: np.ndarray, place: int) -> bool:
    """Return whether a repeated level is a number of nines, such as -999 or 99.9, and far from all others."""
    digits, others = f"{abs(levels[place]):g}".replace(".", ""), np.delete(levels, place)
    least = 2 if len(digits) > 2 else REPEATS
    is_far = abs(levels[place]) > 2 * abs(others).max()
    return len(digits) > 1 and {*digits} == {"9"} and bool(is_far and counts[place] >= least)


def _serial(panel: Panel, times: Sequence[np.ndarray]) -> Iterator[str]:
    """Yield a sentence for times that may be the days of a spreadsheet."""
    name = str(panel.columns.time)
    if times and panel.calendar.kind == "numbers" and re.search("date|day|datum", name.lower()):
        joined = np.concatenate(times)
        if (joined % 1 == 0).all() and SERIAL[0] <= joined.min() and joined.max() <= SERIAL[1]:
            yield (
                f"the times {name!r}, such as {joined[0]:g}, are numbers; if they are days, convert them by "
                "pandas.to_datetime(column, unit='D', origin='1899-12-30'), or origin='unix' if they are since 1970"
            )


def _split(panel: Panel, cut: Cut, guessed: bool) -> Iterator[str]:
    reason = "a split by sequence would reveal events of the test dates, since the sequences share their dates"
    if is_aligned(panel) and not any(sequence.split for sequence in panel):
        if cut.split == "sequence":
            yield f'{reason}; set split = "time" in [cut], with observed and horizon (--split time)'
        elif cut.split == "time" and guessed:
            yield f'the proposed split is by time: {reason}; split = "sequence" tests new sequences instead'
        if cut.split == "time" and not cut.test_steps:
            yield from _shared_dates(panel, cut)


def _shared_dates(panel: Panel, cut: Cut) -> Iterator[str]:
    """Yield a sentence if dates of test futures of some sequences are dates of the training part of others."""
    steps = max(round(cut.test * max(map(len, panel.series))), 1)
    if begin_of(panel, steps) is None:
        return

    def ends(split: str, skipped: int, last: bool) -> list[tuple[float, str]]:
        """Return the time of the first or last step of each sequence in a split, after skipped steps."""
        spans = [(panel.series[index], low + skipped, high) for index, low, high in cut.spans(panel, split)]
        places = [(sequence, high - 1 if last else low) for sequence, low, high in spans if low < high]
        return [(float(one.times[place]), one.name) for one, place in places if one.times is not None]

    begin, early = min(ends("test", cut.observed or 0, last=False), default=(np.inf, ""))
    end, late = max(ends("train", 0, last=True), default=(-np.inf, ""))
    if begin <= end:
        yield (
            f"each sequence is divided at its own date: the test steps of {early!r} begin on "
            f"{panel.calendar.text(begin)}, and the training steps of {late!r} end on {panel.calendar.text(end)}; "
            f"test = {steps} (--test {steps}) divides all at one date"
        )


def _season(panel: Panel, cut: Cut) -> Iterator[str]:
    usual = panel.usual_season
    if cut.season is None and 0 < usual <= (cut.observed or 0):
        yield (
            "models are not compared with a seasonal forecast, because no season is given; with such dates it is often "
            f"{usual}: season = {usual} in [cut] (--season {usual})"
        )


def _absent(times: Sequence[np.ndarray]) -> Iterator[str]:
    """Yield a sentence if the minority of the steps are longer than all others, so that rows may be absent."""
    gaps = np.concatenate([np.empty(0), *map(np.diff, times)])
    is_long = gaps > EVEN * np.median(gaps) if len(gaps) else np.zeros(1, bool)
    if 0 < is_long.mean() < MINORITY and gaps[~is_long].max() <= EVEN * gaps.min():
        yield (
            f"{is_long.sum()} steps are longer than the others, so the table counts as uneven, a horizon counts rows, "
            "and forecasts have even times; if rows are absent, insert them with empty cells, for example by pandas' "
            "asfreq"
        )


def _dated(
    columns: Sequence[Column],
    values: np.ndarray,
    times: np.ndarray,
    calendar: Calendar,
    owners: np.ndarray,
    guessed: bool,
) -> Iterator[str]:
    roles = {column.name: column.role for column in columns if column.role != "static"}
    cells = {column.name: values[:, index] for index, column in enumerate(columns) if column.name in roles}
    for name, argument in functions_of_time(cells, times, calendar, owners).items():
        what = "has one value for each date" if argument == "date" else f"is a function of the {argument}"
        if roles[name] != "known":
            yield f"{name!r} {what}; if its future is known, make it known (--covariates {name})"
        elif argument in FEATURES:
            yield f'{name!r} {what}; calendar = ["{argument}"] (--calendar {argument}) computes it for any date'
        elif guessed:
            yield f"{name!r} {what}, and is guessed as known; if its future is unknown, make it past (--past {name})"


def _untimed(columns: Sequence[Column], values: np.ndarray, owners: np.ndarray) -> Iterator[str]:
    """Yield targets that increase at every step of every sequence."""
    changes = np.diff(values, axis=0)[np.diff(owners) == 0]
    for column, rises in zip(columns, (changes > 0).all(0), strict=True):
        if rises and column.role == "target" and len(changes) >= REPEATS:
            yield (
                f"{column.name!r} increases at every step, and no column is the time; if it is the time, declare it "
                f"(--time {column.name})"
            )


def _leaks(columns: Sequence[Column], values: np.ndarray, owners: np.ndarray) -> Iterator[str]:
    """Yield columns that follow from a target."""
    import pandas as pd

    table = pd.DataFrame(values)
    joined = pd.concat([table, table.groupby(owners).diff()], axis=1)
    ranked, size = joined.corr(method="spearman", min_periods=REPEATS).to_numpy(), len(columns)
    for a, target in enumerate(columns):
        for b, other in enumerate(columns):
            if a == b or target.role != "target" or other.role == "static":
                continue
            is_first, text, remedy = b > a or other.role != "target", "", f", or make it past (--past {other.name})"
            lag = _lag(values[:, a], values[:, b], owners) if is_first else 0
            if lag < 0:
                text, remedy = f"equals {target.name!r} {_steps(-lag)} later", ""
            elif other.role == "past":
                continue
            elif is_first and abs(ranked[a, b]) > SAME and abs(ranked[size + a, size + b]) > SAME_CHANGE:
                text = f"is a function of {target.name!r} at the same step"
            elif _is_step(values[:, b], values[:, a]):
                text = f"is a step function of {target.name!r} at the same step"
            elif ranked[a, size + b] > SAME:
                text = f"is a running total of {target.name!r}"
            elif lag:
                text = f"equals {target.name!r} {_steps(lag)} before"
            if text:
                which = "one of them" if remedy or other.role == "target" else "it"
                yield f"{other.name!r} {text}; leave {which} out (--columns){remedy}"


def _steps(number: int) -> str:
    return f"{number} step{'s' * (number > 1)}"


def _is_step(values: np.ndarray, source: np.ndarray) -> bool:
    """Return whether each of few values occupies an interval of its own of a source with many."""
    known = ~(np.isnan(values) | np.isnan(source))
    order = np.argsort(source[known], kind="stable")
    values, source = values[known][order], source[known][order]
    levels, counts = np.unique(values, return_counts=True)
    if not 2 <= len(levels) <= FLAG or 4 * counts.min() < REPEATS or len(np.unique(source)) <= FLAG:
        return False
    changes = values[1:] != values[:-1]
    return bool(changes.sum() == len(levels) - 1 and (source[1:] > source[:-1])[changes].all())


def _lag(source: np.ndarray, values: np.ndarray, owners: np.ndarray) -> int:
    """Return by how many steps values repeat a source; 0 if they do not.

    Numbers that occur once in the source show any lag, and numbers that differ from their predecessor a small one.
    """
    levels, first, counts = np.unique(source, return_index=True, return_counts=True)
    place = np.searchsorted(levels, values).clip(max=len(levels) - 1)
    rows = np.flatnonzero((levels[place] == values) & (counts[place] == 1) & (owners == owners[first[place]]))
    lags, counts = np.unique(rows - first[place[rows]], return_counts=True)
    is_copy = len(rows) >= REPEATS and counts.max() > (1 - SPIKE) * len(rows)
    if is_copy:
        return int(lags[counts.argmax()])
    rows = 1 + np.flatnonzero((np.diff(source) != 0) & ~np.isnan(np.diff(source)) & (np.diff(owners) == 0))
    for lag in sorted(set(range(-NEAR, NEAR + 1)) - {0}, key=abs):
        inside = rows[(rows + lag >= 1) & (rows + lag < len(values))]
        pairs = np.stack([inside + lag - 1, inside + lag])
        known = inside[((owners[pairs] == owners[inside]) & ~np.isnan(values[pairs])).all(0)]
        same = (values[known + lag] == source[known]) & (values[known + lag - 1] == source[known - 1])
        if len(known) >= REPEATS and same.mean() > 1 - SPIKE:
            return lag
    return 0


def _scales(columns: Sequence[Column], sequences: Sequence[Series]) -> Iterator[str]:
    ratios = []
    for index, column in enumerate(columns):
        if column.role != "target" or column.family in ("binary", "category", "share", "angle"):
            continue
        parts = (np.asarray(one.values[:ROWS, index], np.float64) for one in sequences)
        cells = [each[~np.isnan(each)] for each in parts]
        cells = [each for each in cells if len(each) >= LONG]
        scale = min(_contrast(map(np.std, cells)), _contrast(np.diff(each).std() for each in cells))
        level = _contrast(map(np.median, cells)) if all((each >= 0).all() for each in cells) else 1.0
        if (ratio := max(scale, level)) > CONTRAST:
            fixed = "; the family 'fixed' has one scale for all, so take 'real'" if column.family == "fixed" else ""
            ratios.append(f"{column.name!r} by a factor of {ratio:.3g}{fixed}")
    if ratios:
        yield (
            f"the scale or level differs between sequences, of {', '.join(ratios)}; methods use units of each "
            "sequence if these are much closer to the data (--units series, changes, seasonal or columns)"
        )


def _contrast(sizes: Iterable[Any]) -> float:
    """Return the ratio of the 95 % and 5 % quantiles of the positive sizes."""
    positive = [size for size in sizes if size > 0]
    low, high = np.quantile(positive, (0.05, 0.95)) if positive else (1.0, 1.0)
    return float(high / low)
