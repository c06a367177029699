"""Time series from the files of the packages aeon and statsmodels, which are not imported.

`pip install --no-deps aeon statsmodels` is sufficient. JapaneseVowels is by Kudo, Toyama and Shimbo (1999), and
students recorded BasicMotions with smart watches. Both are in the archive of Bagnall et al. (2018, arXiv 1811.00075),
with its split into training and test. Macrodata is from the Federal Reserve Bank of St. Louis, as in statsmodels.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ... import files
from ..columns import Column, Columns
from ..panel import Panel, Series
from .published import package_folder

MOST = 2**24
"""Maximum bytes of a file of sequences."""
RATES = {
    "gdp": "realgdp",
    "consumption": "realcons",
    "investment": "realinv",
    "government": "realgovt",
    "income": "realdpi",
}
"""Names of growth columns and their sources in the file."""
LEVELS = {"inflation": "infl", "bills": "tbilrate", "unemployment": "unemp"}
"""Columns already in per cent, and their names in the file."""


def japanese_vowels() -> Panel:
    """Load JapaneseVowels: 640 utterances of /ae/ by nine speakers, which are the groups.

    Each utterance has 12 cepstral coefficients of linear prediction and 7 to 29 frames. The published split has 270 for
    training and 370 for test. Of the 30 training utterances of each speaker, every fifth is used for validation.

    Raises:
        ImportError: if aeon is not installed.
    """
    return _load_archive("JapaneseVowels", [f"cepstrum {number}" for number in range(1, 13)])


def basic_motions() -> Panel:
    """Load BasicMotions: 80 recordings of a wrist in four activities, which are the groups.

    Each recording has three axes each of an accelerometer and a gyroscope, and 100 steps in 10 seconds. The published
    split has 40 for training and 40 for test. Of the ten training recordings of each activity, every fifth is used for
    validation.

    Raises:
        ImportError: if aeon is not installed.
    """
    return _load_archive(
        "BasicMotions", [f"{sensor} {axis}" for sensor in ("accelerometer", "gyroscope") for axis in "xyz"]
    )


def macrodata() -> Panel:
    """Load Macrodata: the economy of the United States by quarter, 1959 to 2009, as one sequence of 202 steps.

    Growth over the previous quarter is 100 times the difference of logarithms. Its columns are real gross domestic
    product, consumption, private investment, government expenditure and disposable income. Inflation is in per cent per
    year; the rate of three-month treasury bills and unemployment are in per cent. The data define no split; split them
    by time.

    Raises:
        ImportError: if statsmodels is not installed.
    """
    path = package_folder("statsmodels", "series") / "datasets" / "macrodata" / "macrodata.csv"
    rows = list(csv.DictReader(files.read(path, MOST).decode().splitlines()))
    data = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    growth = [100 * np.diff(np.log(data[source])) for source in RATES.values()]
    values = np.stack([*growth, *(data[source][1:] for source in LEVELS.values())], 1)
    months = ((data["year"] - 1970) * 12 + (data["quarter"] - 1) * 3)[1:].astype("datetime64[M]")
    times = months.astype("datetime64[s]").astype(np.float64)
    units = [*["% a quarter"] * len(RATES), "% a year", "%", "%"]
    columns = [Column(name, unit=unit) for name, unit in zip([*RATES, *LEVELS], units, strict=True)]
    return Panel([Series("United States", values, times)], Columns(tuple(columns)), "macrodata")


def _load_archive(name: str, columns: list[str]) -> Panel:
    """Load a data set of the archive; every fifth training sequence of each class is used for validation."""
    folder = package_folder("aeon", "series") / "datasets" / "data" / name
    series, counts = [], dict[str, int]()
    for split in ("train", "test"):
        for number, (values, label) in enumerate(read_ts(folder / f"{name}_{split.upper()}.ts")):
            counts[label] = counts.get(label, 0) + 1
            part = "validation" if split == "train" and counts[label] % 5 == 0 else split
            series.append(Series(f"{split} {number}", values, group=label, split=part))
    return Panel(series, Columns(tuple(map(Column, columns))), name)


def read_ts(path: Path) -> Iterator[tuple[np.ndarray, str]]:
    """Yield sequences (T, D) and their class from a file, where colons separate dimensions and the class."""
    for line in files.read(path, MOST).decode().splitlines():
        if line.strip() and line[0] not in "#@":
            *dimensions, label = line.strip().split(":")
            yield np.array([numbers.split(",") for numbers in dimensions], np.float64).T, label
