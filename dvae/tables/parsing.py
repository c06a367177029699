"""What the columns of a pandas frame hold: numbers, texts or times."""

from __future__ import annotations

import warnings
from reprlib import repr as brief
from typing import Any

import numpy as np

from ..options import nearest
from .columns import Column


def is_number(column: Any) -> bool:
    """Whether a column is of numbers, or of true and false."""
    import pandas as pd

    return bool(pd.api.types.is_numeric_dtype(column))


def texts(column: Any) -> Any:
    """The values as texts, missing ones missing: whole numbers are written alike in columns that lack some and not."""
    if column.dtype.kind == "f" and (known := column.dropna()).abs().lt(2**53).all() and (known % 1 == 0).all():
        column = column.astype("Int64")
    return column.astype(str).where(column.notna())


def dates(column: Any) -> Any:
    """Dates, in UTC.

    Raises:
        TypeError, ValueError: a column that holds something else, or dates that are written in several ways.
    """
    import pandas as pd

    if isinstance(column.dtype, pd.PeriodDtype):
        column = column.dt.to_timestamp()
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a guess by row, in which 1/2 is February's, and 13/2 too
        try:
            return pd.to_datetime(column, utc=True, format="ISO8601")
        except (TypeError, ValueError):
            try:
                return pd.to_datetime(column, utc=True)
            except UserWarning as error:
                raise ValueError("write them as 2024-12-31") from error


def times(column: Any) -> np.ndarray:
    """Seconds since 1970 of dates, or the numbers that they are.

    Raises:
        ValueError: neither, or rows without.
    """
    if is_number(column):
        found = column.to_numpy(np.float64, na_value=np.nan)
        known = np.isfinite(found)
    else:
        try:
            when = dates(column)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"the times of column {column.name!r} are neither numbers nor dates: {str(error)[:200]}"
            ) from error
        known = when.notna().to_numpy()
        found = when.to_numpy("datetime64[us]").astype("int64") / 1e6
    if not known.all():
        raise ValueError(f"row {int(np.argmin(known))} of column {column.name!r} has no time")
    return np.asarray(found)


def numeric(column: Any, told: Column) -> np.ndarray:
    """The values as numbers, NaN where missing, of a category as the place of its class.

    Raises:
        ValueError: values that are none.
    """
    import pandas as pd

    if told.family == "category":
        places = {each: place for place, each in enumerate(told.classes)}
        said = texts(column)
        unknown = said.notna() & ~said.isin(list(places))
        if unknown.any():
            value = said[unknown].iloc[0]
            raise ValueError(
                f"column {told.name!r} has {brief(value)}{nearest(value, places)}, which is none of its classes: "
                f"{', '.join(told.classes[:10])}"
            )
        return said.map(places).to_numpy(np.float64)  # type: ignore[no-any-return]
    advice = "leave it out, or give it the family 'category'"
    if column.dtype.kind in "mMc":
        raise ValueError(f"column {told.name!r} holds {column.dtype}, which are no numbers; {advice}")
    if pd.api.types.is_bool_dtype(column):
        column = column.astype(float)
    try:
        return pd.to_numeric(column).to_numpy(np.float64, na_value=np.nan)  # type: ignore[no-any-return]
    except (TypeError, ValueError, OverflowError) as error:
        said = column.astype(str)
        wrong = pd.to_numeric(said, errors="coerce").isna() & column.notna()
        value = brief(said[wrong].iloc[0]) if wrong.any() else "something"
        raise ValueError(f"column {told.name!r} holds {value}, which is no number; {advice}") from error
