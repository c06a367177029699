"""Draws of the future of a panel and of its missing values, as tables and figures; scores of forecasts."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import files
from ..data.sequences import HeldOutWindows, columns_of
from ..inference.evaluation.result import new_figure, styled
from ..inference.evaluation.scores import CRPS, Measure, by_column, calibrated, samples_needed
from ..options import nearest
from .calendar import NUMBERS, Calendar

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

QUANTILES = (0.025, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.975)
"""Quantiles of the 50, 80, 90 and 95 % intervals, and the median."""
BANDS = {0.95: 0.15, 0.8: 0.3, 0.5: 0.5}
"""Opacity of the prediction bands in figures, by level."""
FORMATS = (".csv", ".parquet", ".npz")
FEW = 12
"""Maximum number of columns that are also scored separately."""


@dataclass(frozen=True, eq=False)
class PanelForecasts:
    """Draws of the future of windows.

    Args:
        draws: (K, N, H, D) of the coordinates.
        past: (N, O, D), observed values, NaN where missing.
        truth: (N, H, D), true futures, NaN where unknown.
        columns: dictionary from coordinate to unit; a category has one coordinate per class, with its share.
        keys: (sequence, first step of the future) of each window.
        times: (N, O + H) of the steps, as in `Calendar`; None for step numbers.
        calendar: kind, time zone and calendar step of the times.
    """

    draws: np.ndarray
    past: np.ndarray
    truth: np.ndarray
    columns: Mapping[str, str]
    keys: Sequence[tuple[str, int]]
    times: np.ndarray | None = None
    calendar: Calendar = NUMBERS

    def table(self) -> Any:
        """Return a pandas frame with a row for each window, step and coordinate: mean, quantiles and truth.

        It includes only quantiles that the number of draws supports (`needed`).
        """
        import pandas as pd

        count, horizon, size = self.draws.shape[1:]
        window, step, place = (index.ravel() for index in np.indices((count, horizon, size)))
        entries = _rows(self.keys, window, step)
        if self.times is not None:
            entries["time"] = self.calendar.to_pandas(self.times[:, -horizon:].reshape(-1).repeat(size))
        entries["ahead"] = step + 1
        entries |= _columns(self.columns, place) | _quantiles(self.draws.reshape(len(self.draws), -1))
        return pd.DataFrame({**entries, "truth": self.truth.ravel()})

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the table as CSV or Parquet, or all arrays as npz, by the extension of the path.

        Args:
            path: path that ends in .csv, .parquet or .npz.

        Raises:
            ValueError: if the extension is unknown, or pyarrow is missing for Parquet.
        """
        _save(self, path, draws=self.draws, past=self.past, truth=self.truth)

    @styled
    def plot(self, window: int = 0, columns: Sequence[str] | None = None, most: int = 8) -> Figure:
        """Plot prediction bands (50, 80, 95 %) and the median of each coordinate, with the past and the truth.

        If all values of a coordinate are 0 or 1, the plot shows the share of the draws that are 1. Intervals that need
        more draws are omitted (`needed`).

        Args:
            window: index of the window.
            columns: names of the coordinates; by default the first ones.
            most: maximum number of panels.

        Returns:
            A matplotlib figure.

        Raises:
            ValueError: if a coordinate does not exist.
        """
        names = list(self.columns)
        for name in columns or ():
            if name not in names:
                raise ValueError(f"no column {name!r}{nearest(name, names)}; there are {', '.join(names[:20])}")
        selected = list(columns or names)[:most]
        n_columns = min(2, len(selected))
        n_rows = -(-len(selected) // n_columns)
        figure = new_figure(7, 1.6 * n_rows + 0.7)
        panels = figure.subplots(n_rows, n_columns, squeeze=False, sharex=True).ravel()
        for axis, name in zip(panels, selected, strict=False):
            self.fan(axis, window, name)
            unit = self.columns[name]
            axis.set_title(name + (f" ({unit})" if unit else ""), parse_math=False)
        for axis in panels[len(selected) :]:
            axis.set_axis_off()
        for axis in panels[max(len(selected) - n_columns, 0) : len(selected)]:  # the lowest panel of each column
            axis.tick_params(labelbottom=True)
        legends = [axis.get_legend_handles_labels() for axis in panels[: len(selected)]]
        entries = {label: handle for legend in legends for handle, label in zip(*legend, strict=True)}
        figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=len(entries))
        figure.suptitle(f"{self.keys[window][0]} from step {self.keys[window][1]}", parse_math=False)
        return figure

    def fan(self, axis: Axes, window: int, column: str) -> None:
        """Plot one coordinate of a window on given axes, as `plot` does.

        Args:
            axis: matplotlib axes to draw on.
            window: index of the window.
            column: name of the coordinate.
        """
        index = list(self.columns).index(column)
        observed, horizon = self.past.shape[1], self.draws.shape[2]
        steps: Any = np.arange(observed + horizon) if self.times is None else self.times[window]
        if is_dated := self.times is not None and self.calendar.kind == "dates":
            steps = self.calendar.to_pandas(steps)
        past_steps, future_steps, draws = steps[:observed], steps[observed:], self.draws[:, window, :, index]
        values = np.concatenate([each[..., index].ravel() for each in (self.draws, self.past, self.truth)])
        if np.isin(values[np.isfinite(values)], (0, 1)).all():  # binary: a share instead of bands
            axis.plot(future_steps, draws.mean(0), "C0", label="share of draws")
            axis.set_ylabel("share")
            axis.set_ylim(-0.05, 1.05)
        else:
            for level, opacity in BANDS.items():
                if samples_needed(level) > len(draws):
                    continue
                low, high = _quantile(draws, [(1 - level) / 2, (1 + level) / 2])
                style: dict[str, Any] = {"color": "C0", "alpha": opacity, "label": f"{level:.0%}"}
                if horizon == 1:  # a band over one step has no area
                    axis.vlines(future_steps, low, high, linewidth=6, **style)
                else:
                    axis.fill_between(future_steps, low, high, linewidth=0, **style)
            axis.plot(future_steps, np.median(draws, 0), "C0", marker="_" if horizon == 1 else None, label="median")
        axis.plot(past_steps, self.past[window, :, index], color="0.3", linewidth=1, marker=".", markersize=3)
        axis.plot(future_steps, self.truth[window, :, index], "k.", markersize=4, label="truth")
        if is_dated:
            from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

            axis.xaxis.set_major_locator(locator := AutoDateLocator(tz=steps.tz, maxticks=6))
            axis.xaxis.set_major_formatter(ConciseDateFormatter(locator, tz=steps.tz))
        else:
            axis.set_xlabel("time" if self.times is not None else "step")


@dataclass(frozen=True, eq=False)
class PanelImputed:
    """Draws of the missing values of windows or sequences.

    Args:
        draws: (K, N, T, D) of the coordinates; observed values are equal in all draws.
        missing: (N, T, D), True where a coordinate is missing.
        columns: dictionary from coordinate to unit.
        keys: (sequence, first step) of each window.
        times: (N, T) of the steps, as in `Calendar`; None for step numbers.
        calendar: kind, time zone and calendar step of the times.
    """

    draws: np.ndarray
    missing: np.ndarray
    columns: Mapping[str, str]
    keys: Sequence[tuple[str, int]]
    times: np.ndarray | None = None
    calendar: Calendar = NUMBERS

    def table(self) -> Any:
        """Return a pandas frame with a row for each missing entry: mean, and quantiles as in `PanelForecasts.table`."""
        import pandas as pd

        window, step, index = np.nonzero(self.missing)
        entries = _rows(self.keys, window, step)
        if self.times is not None:
            entries["time"] = self.calendar.to_pandas(self.times[window, step])
        return pd.DataFrame(entries | _columns(self.columns, index) | _quantiles(self.draws[:, window, step, index]))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the table as CSV or Parquet, or all arrays as npz, by the extension of the path.

        Args:
            path: path that ends in .csv, .parquet or .npz.

        Raises:
            ValueError: if the extension is unknown, or pyarrow is missing for Parquet.
        """
        _save(self, path, filled=self.draws, observed=~self.missing)


def needed(quantile: float) -> int:
    """Return the smallest number of draws that determines a quantile: 39 for 2.5 %, 1 for the median.

    With fewer draws, the quantile lies beyond all of them.
    """
    return 1 if quantile == 0.5 else samples_needed(abs(1 - 2 * quantile))


def _rows(keys: Sequence[tuple[str, int]], window: np.ndarray, step: np.ndarray) -> dict[str, Any]:
    """Return table columns with the sequence and step of each window and step."""
    names, first = zip(*keys, strict=True)
    return {"sequence": np.array(names, object)[window], "step": np.array(first)[window] + step}


def _columns(columns: Mapping[str, str], index: np.ndarray) -> dict[str, np.ndarray]:
    """Return table columns with the name and unit of each coordinate."""
    names, units = (np.array(list(entries), object) for entries in (columns, columns.values()))
    return {"column": names[index], "unit": units[index]}


def column_of(quantile: float) -> str:
    """Return the name of a quantile in tables."""
    return f"q{1000 * quantile:03.0f}"


def _quantiles(draws: np.ndarray) -> dict[str, np.ndarray]:
    """Return the mean of draws (K, N), and the quantiles that K draws support."""
    levels = [level for level in QUANTILES if needed(level) <= len(draws)]
    quantiles = dict(zip(map(column_of, levels), _quantile(draws, levels), strict=True))
    return {"mean": draws.mean(0, dtype=np.float64), **quantiles}


def _quantile(draws: np.ndarray, levels: Sequence[float]) -> np.ndarray:
    """Return quantiles of draws (K, ...) at mean ranks k / (K + 1).

    With these ranks, intervals contain exchangeable values at their nominal level, as in `metrics.coverage`. NumPy's
    default ranks (k - 1) / (K - 1) span only the range of the draws, and its intervals are too narrow. Quantiles of
    whole numbers are rounded outwards (and the median down), to possible values that keep the level of intervals.
    """
    quantiles: np.ndarray = np.quantile(draws, levels, axis=0, method="weibull")
    is_upper = np.reshape(np.array(levels) > 0.5, (-1,) + (1,) * (draws.ndim - 1))
    is_whole = (draws % 1 == 0).all(0)
    return np.where(is_whole, np.where(is_upper, np.ceil(quantiles), np.floor(quantiles)), quantiles)


def _save(result: PanelForecasts | PanelImputed, path: str | os.PathLike[str], **arrays: np.ndarray) -> None:
    """Write the table of a result, or arrays with the names of their sequences, steps and columns."""
    suffix = Path(path).suffix.lower()
    if suffix not in FORMATS:
        raise ValueError(f"{path} must end in one of {', '.join(FORMATS)}")
    with files.atomic_write(path) as file:
        if suffix == ".csv":
            table = result.table()
            if "time" in table and result.calendar.kind == "numbers":
                table["time"] = table["time"].map("{:.15g}".format)
            table.to_csv(file, index=False)
        elif suffix == ".parquet":
            try:
                result.table().to_parquet(file)
            except ImportError as error:
                raise ValueError(f"{path} needs pyarrow: pip install 'pyro-dvae[parquet]'") from error
        else:
            names, first = zip(*result.keys, strict=True)
            labels: dict[str, Any] = {"sequence": names, "step": first, "columns": list(result.columns)}
            labels |= {} if result.times is None else {"times": result.times}
            np.savez_compressed(
                file, allow_pickle=False, **arrays, **{n: np.array(values) for n, values in labels.items()}
            )


def panel_scores(windows: HeldOutWindows) -> list[Measure]:
    """Return proper scores and calibration, and, for a few columns, the CRPS of each column in its unit.

    The command line prints these scores: `dvae.evaluate(model, windows, scores=dvae.tables.panel_scores)`.

    Args:
        windows: windows of a panel.
    """
    columns = columns_of(windows)
    measures = [*calibrated(windows), *(by_column(CRPS, columns) if 1 < len(columns) <= FEW else [])]
    return [replace(measure, headline=True) for measure in measures]
