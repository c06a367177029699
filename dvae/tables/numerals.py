"""Parse a column of a table as float64 numbers, and report the cells that are not numbers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from reprlib import repr as brief
from typing import Any

import numpy as np

NA = {"", "na", "n/a", "<na>", "#n/a", "#na", "#n/a n/a", "nan", "-nan", "null", "none"}
"""Texts, in lower case, that pandas reads as missing in a column of numbers."""
MARKS = {"?", "-", "--", "---", ".", "..", "...", "*", ":", "–", "—", "…", "n.a.", "n.a", "n/d", "nd", "missing"}
MARKS |= {"#div/0!", "#value!", "#ref!", "#num!", "#name?", "#null!", "nat"}
"""Texts that often mark a missing number; a warning names them."""
NEARLY_ALL = 0.8
"""Share of numbers above which the other cells of a column are probably errors."""
_GROUP = {".": ",", ",": r"\."}
_TEXTS = {
    decimal: re.compile(
        rf"([-+]?)(\d+|[1-9]\d{{0,2}}(?:(?P<group>[{group} \u00a0\u202f'’])\d{{3}}(?:(?P=group)\d{{3}})*)|)"
        rf"(?:{re.escape(decimal)}(\d*))?((?:e[-+]?\d+)?)",
        re.IGNORECASE,
    )
    for decimal, group in _GROUP.items()
}
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}\.\d{3}", re.ASCII)


@dataclass(frozen=True)
class Numbers:
    """A column as numbers.

    Args:
        values: (N,) float64, NaN where a cell is missing or not a number.
        wrong: (N,) True where a cell is neither a number nor missing.
        marks: cells in `MARKS` that are read as missing, with their first row and their count.
        ambiguous: a cell whose value depends on the decimal sign, if the column does not determine it.
    """

    values: np.ndarray
    wrong: np.ndarray
    marks: dict[str, tuple[int, int]]
    ambiguous: str | None = None

    @property
    def is_numeric(self) -> bool:
        """Whether every cell is a number or missing, and some cell is a number."""
        return not self.wrong.any() and bool((~np.isnan(self.values)).any())

    def check(self, column: Any, remedy: str) -> None:
        """Raise an error that names a cell that is not a number, and a remedy.

        Args:
            column: the column that was read.
            remedy: end of the message, with a further remedy.

        Raises:
            ValueError: if cells are not numbers, or depend on the decimal sign.
        """
        if self.ambiguous is not None:
            plain = self.ambiguous.replace(",", "").replace(".", "")
            raise ValueError(
                f"column {column.name!r} holds {self.ambiguous!r}, which may be {plain} or a fraction; give the "
                'decimal sign, decimal = "," or decimal = "." (--decimal)'
            )
        if not self.wrong.any():
            return
        row = int(np.argmax(self.wrong))
        n_wrong, n_values = int(self.wrong.sum()), int((self.wrong | ~np.isnan(self.values)).sum())
        cell = brief(column.iloc[row])
        share = f"{n_values - n_wrong} of {n_values} values are numbers; " if n_values > n_wrong else ""
        raise ValueError(
            f"column {column.name!r}: {share}row {row} is {cell}, which is not a number; correct it, list it in "
            f"na_values (--na-values) if it marks a missing value, {remedy}"
        )


def read_numbers(
    column: Any, na_values: Sequence[str] = (), decimal: str | None = None, hint: str | None = None
) -> Numbers:
    """Parse a pandas column as numbers, from numbers, Booleans, decimals and text.

    Args:
        column: (N,) of any type.
        na_values: texts or numbers that mark missing values.
        decimal: "." or ",", the decimal sign of texts; None to infer it from the column.
        hint: decimal sign of the rest of the file; "" if unknown, so that 1.234 may be 1234; None if dots are decimal
            signs.
    """
    import pandas as pd

    nothing, sentinels = np.full(len(column), np.nan), [float(mark) for mark in na_values if _is_float(mark)]
    if pd.api.types.is_numeric_dtype(column) and column.dtype.kind != "c":
        values = column.to_numpy(np.float64, na_value=np.nan, copy=True)
        values[np.isin(values, sentinels)] = np.nan
        return Numbers(values, np.zeros(len(column), bool), {})
    if column.dtype.kind in "mMc" or isinstance(column.dtype, pd.PeriodDtype | pd.IntervalDtype):
        return Numbers(nothing, column.notna().to_numpy(), {})
    if decimal == "." or (decimal is None and hint in (None, ".")):
        plain = _plain(column.to_numpy(object, na_value=np.nan))
        if plain is not None and (decimal or hint is None or not _has_large_whole(plain)):
            plain[np.isin(plain, sentinels)] = np.nan
            return Numbers(plain, np.zeros(len(column), bool), {})
    try:
        codes, cells = pd.factorize(column.astype(object))  # parses each distinct cell once
    except TypeError:  # cells that are lists
        return Numbers(nothing, column.notna().to_numpy(), {})
    cells = [cell.strip() if isinstance(cell, str) else cell for cell in cells]
    is_missing = np.array([isinstance(cell, str) and (cell.lower() in NA or cell in na_values) for cell in cells], bool)
    is_mark = np.array([isinstance(cell, str) and cell.lower() in MARKS for cell in cells], bool) & ~is_missing
    others = [cell for cell, skip in zip(cells, is_missing | is_mark, strict=True) if not skip]
    numbers, ambiguous = _numbers(others, decimal, hint)
    cell_values = np.full(len(cells), np.nan)
    cell_values[~(is_missing | is_mark)] = numbers
    wrong = np.isnan(cell_values) & ~is_missing
    if not np.isnan(numbers).all():
        wrong &= ~is_mark  # a mark is text in a column without numbers
    cell_values[np.isin(cell_values, sentinels)] = np.nan
    marks = {}
    for code in np.flatnonzero(is_mark & ~wrong):
        rows = np.flatnonzero(codes == code)
        marks[str(cells[code])] = (int(rows[0]), len(rows))
    return Numbers(np.append(cell_values, np.nan)[codes], np.append(wrong, False)[codes], marks, ambiguous)


def decimal_sign(frame: Any) -> str:
    """Return the decimal sign in the first rows of a frame of texts; "" if they determine none or both.

    A column determines it if only one of the signs can parse all its numbers.
    """
    signs, rows = set(), max(20, 50_000 // max(frame.shape[1], 1))
    for name in frame:
        cells = frame[name].iloc[:rows].dropna().drop_duplicates()
        dot, comma = (read_numbers(cells, decimal=sign).is_numeric for sign in ".,")
        if dot != comma and not cells.str.match(r"\s*0\d").any():  # 01.2024 is a month
            signs.add("." if dot else ",")
    return signs.pop() if len(signs) == 1 else ""


def _numbers(cells: list[Any], decimal: str | None, hint: str | None) -> tuple[np.ndarray, str | None]:
    """Return the numbers of distinct cells, NaN for others, and a cell that is ambiguous between the decimal signs."""
    words = [cell for cell in cells if isinstance(cell, str)]
    if words and len(words) == len(cells) and {word.lower() for word in words} <= {"true", "false"}:
        return np.array([word.lower() == "true" for word in words], float), None
    commas = any("," in word for word in words)
    if decimal is not None or (hint is None and not commas):
        return _parse(cells, decimal or "."), None
    dot, comma = _parse(cells, "."), _parse(cells, ",")
    differ = ~np.isnan(dot) & (dot != comma)
    if (excess := int(np.isnan(dot).sum() - np.isnan(comma).sum())) or not differ.any():
        return (comma if excess > 0 else dot), None
    sign = "," if commas else "."
    if not commas or not any("." in word for word in words):
        if hint == "." and sign == ",":
            return dot, None
        if hint == sign and not _has_large_whole(dot[~differ]):
            return (dot if sign == "." else comma), None
    return dot, str(cells[int(np.argmax(differ))])


def _has_large_whole(values: np.ndarray) -> bool:
    """Return whether some number is an integer of three digits or more; 1.000 next to it means 1000."""
    return bool(((np.abs(values) >= 100) & (values == np.trunc(values))).any())


LOOKED_AT = 200_000
"""Maximum number of rows that show whether a dot separates thousands."""


def may_be_thousands(column: Any) -> bool:
    """Return whether dots may separate thousands: three digits follow each, and integers of three digits occur."""
    cells = column.iloc[:LOOKED_AT].dropna().to_numpy(object)
    values = _plain(cells)
    if values is None:
        return False
    whole = values == np.trunc(values)
    integers = np.abs(values[whole])
    if whole.all() or not ((integers >= 100) & (integers < 1000)).any():
        return False
    return bool((integers < 1000).all()) and all(_THOUSANDS.fullmatch(str(cell)) for cell in cells if "." in str(cell))


def _parse(cells: list[Any], decimal: str) -> np.ndarray:
    """Parse each cell as float64, exactly as Python does; NaN if it is not a number."""
    return np.array([_number(cell, decimal) for cell in cells], np.float64)


def _plain(cells: np.ndarray) -> np.ndarray | None:
    """Return cells as Python parses them, or None if some are not numbers or contain an underscore, as in 1_000."""
    try:
        values = cells.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return None if "_" in "".join(map(str, cells)) else values


def _number(cell: Any, decimal: str) -> float:
    if not isinstance(cell, str):
        try:
            return float(cell)
        except (TypeError, ValueError, OverflowError):
            return float("nan")
    text = cell.replace("−", "-")
    match = _TEXTS[decimal].fullmatch(text)
    if match and (match[2] or match[4]):
        digits = re.sub(r"\D", "", match[2])
        return float(f"{match[1]}{digits or 0}.{match[4] or 0}{match[5]}")
    return float(text) if text.lower().lstrip("+-") in ("inf", "infinity") else float("nan")


def _is_float(text: str) -> bool:
    return not np.isnan(_number(text, "."))


def is_multiple(values: np.ndarray, unit: float) -> np.ndarray:
    """Return whether values are multiples of a unit, up to rounding errors of float32."""
    multiples = np.asarray(values, np.float64) / unit
    difference: np.ndarray = np.abs(multiples - np.rint(multiples))
    return difference <= (1e-6 * np.abs(multiples)).clip(max=0.1)


def resolution(values: np.ndarray) -> float:
    """Return the largest unit that divides all values, 0 if there is none; units are 1 or 5 times a power of 10."""
    for unit in (float(f"{digit}e{exponent}") for exponent in range(6, -5, -1) for digit in (5, 1)):
        if is_multiple(values, unit).all():
            return unit
    return 0.0
