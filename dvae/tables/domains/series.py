"""Series: panels of numbers from the packages aeon and statsmodels, whose files are read and which are not imported.

`pip install --no-deps aeon statsmodels` is enough. JapaneseVowels is Kudo, Toyama and Shimbo's (1999), BasicMotions
was recorded by students with smart watches; both are in the archive of Bagnall et al. (2018, arXiv 1811.00075), with
its parts for training and test. Macrodata are of the Federal Reserve Bank of St. Louis, as in statsmodels.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ... import files
from ..columns import Column, Columns
from ..panel import Panel, Series
from .published import folder

MOST = 2**24
"""Bytes of a file of sequences."""
RATES = {
    "gdp": "realgdp",
    "consumption": "realcons",
    "investment": "realinv",
    "government": "realgovt",
    "income": "realdpi",
}
"""Columns of growth, and of what."""
LEVELS = {"inflation": "infl", "bills": "tbilrate", "unemployment": "unemp"}
"""Columns that are in per cent as they stand."""


def japanese_vowels() -> Panel:
    """JapaneseVowels: 640 utterances of /ae/ by nine speakers, which are the groups.

    12 cepstral coefficients of linear prediction, 7 to 29 frames. 270 for training and 370 for test as published; of
    the 30 for training by each speaker every fifth is for validation.

    Raises:
        ImportError: aeon is not installed.
    """
    return _archived("JapaneseVowels", [f"cepstrum {number}" for number in range(1, 13)])


def basic_motions() -> Panel:
    """BasicMotions: 80 recordings of a wrist in four activities, which are the groups.

    Three axes each of an accelerometer and a gyroscope, 100 steps in 10 seconds. 40 for training and 40 for test as
    published; of the ten for training of each activity every fifth is for validation.

    Raises:
        ImportError: aeon is not installed.
    """
    return _archived("BasicMotions", [f"{what} {axis}" for what in ("accelerometer", "gyroscope") for axis in "xyz"])


def macrodata() -> Panel:
    """Macrodata: the economy of the United States by quarter, 1959 to 2009, as one sequence of 202 steps.

    Growth of real gross domestic product, consumption, private investment, government's expenditure and disposable
    income over the quarter before, as 100 times the difference of logarithms; inflation in per cent a year, the rate of
    three-month treasury bills and unemployment in per cent. Nothing is said of a split, which is by time.

    Raises:
        ImportError: statsmodels is not installed.
    """
    path = folder("statsmodels", "series") / "datasets" / "macrodata" / "macrodata.csv"
    rows = list(csv.DictReader(files.read(path, MOST).decode().splitlines()))
    found = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    growth = [100 * np.diff(np.log(found[of])) for of in RATES.values()]
    values = np.stack([*growth, *(found[of][1:] for of in LEVELS.values())], 1)
    months = ((found["year"] - 1970) * 12 + (found["quarter"] - 1) * 3)[1:].astype("datetime64[M]")
    times = months.astype("datetime64[s]").astype(np.float64)
    units = [*["% a quarter"] * len(RATES), "% a year", "%", "%"]
    columns = [Column(name, unit=unit) for name, unit in zip([*RATES, *LEVELS], units, strict=True)]
    return Panel([Series("United States", values, times)], Columns(tuple(columns)), "macrodata")


def _archived(name: str, columns: list[str]) -> Panel:
    """A problem of the archive; of those for training in each class every fifth is for validation."""
    place = folder("aeon", "series") / "datasets" / "data" / name
    series, seen = [], dict[str, int]()
    for split in ("train", "test"):
        for number, (values, label) in enumerate(read_ts(place / f"{name}_{split.upper()}.ts")):
            seen[label] = seen.get(label, 0) + 1
            part = "validation" if split == "train" and seen[label] % 5 == 0 else split
            series.append(Series(f"{split} {number}", values, group=label, split=part))
    return Panel(series, Columns(tuple(map(Column, columns))), name)


def read_ts(path: Path) -> Iterator[tuple[np.ndarray, str]]:
    """Sequences (T, D) and their class, from a file of the archive: dimensions between colons, the class at the end."""
    for line in files.read(path, MOST).decode().splitlines():
        if line.strip() and line[0] not in "#@":
            *dimensions, label = line.strip().split(":")
            yield np.array([each.split(",") for each in dimensions], np.float64).T, label
