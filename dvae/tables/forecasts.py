"""Forecasts of a panel: draws of the future, their quantiles by column in a table, and fans of them in a picture."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import files
from ..inference.result import canvas
from ..options import nearest

if TYPE_CHECKING:
    from matplotlib.figure import Figure

QUANTILES = (0.025, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.975)
"""Of the intervals of 50, 80, 90 and 95 %, and the median."""
FORMATS = (".csv", ".parquet", ".npz")


@dataclass(frozen=True, eq=False)
class PanelForecasts:
    """Draws of the future of windows.

    Args:
        draws: (K, N, H, D) of the coordinates.
        past: (N, O, D) that was observed, NaN where missing.
        truth: (N, H, D) that happened, NaN where nobody knows.
        columns: coordinate to its unit; of a category, its shares are forecast, in a coordinate for each class.
        keys: (sequence, first step of the future) of each window.
        times: (N, O + H) of the steps, as in the table; None for steps.
        dates: whether times are seconds since 1970.
    """

    draws: np.ndarray
    past: np.ndarray
    truth: np.ndarray
    columns: Mapping[str, str]
    keys: Sequence[tuple[str, int]]
    times: np.ndarray | None = None
    dates: bool = False

    def table(self) -> Any:
        """A pandas frame with a row for each window, step and coordinate: mean, quantiles, and what happened."""
        import pandas as pd

        count, horizon, size = self.draws.shape[1:]
        window, step, place = (index.ravel() for index in np.indices((count, horizon, size)))
        found: dict[str, Any] = {
            "sequence": np.array([name for name, _ in self.keys], object)[window],
            "step": np.array([first for _, first in self.keys])[window] + step,
        }
        if self.times is not None:
            found["time"] = self._shown(self.times[:, -horizon:].reshape(-1).repeat(size))
        found["ahead"] = step + 1
        found["column"] = np.array(list(self.columns), object)[place]
        found["unit"] = np.array(list(self.columns.values()), object)[place]
        found["mean"] = self.draws.mean(0, dtype=np.float64).ravel()
        quantiles = np.quantile(self.draws, QUANTILES, axis=0).reshape(len(QUANTILES), -1)
        found |= {f"q{1000 * level:03.0f}": values for level, values in zip(QUANTILES, quantiles, strict=True)}
        return pd.DataFrame({**found, "truth": self.truth.ravel()})

    def _shown(self, times: np.ndarray) -> Any:
        import pandas as pd

        return pd.to_datetime(times, unit="s") if self.dates else times

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the table as CSV or Parquet, or the draws and all beside them as npz, whichever the name ends in.

        Raises:
            ValueError: another ending, or Parquet without pyarrow.
        """
        suffix = Path(path).suffix.lower()
        if suffix not in FORMATS:
            raise ValueError(f"{path} ends in none of {', '.join(FORMATS)}")
        with files.written(path) as file:
            if suffix == ".csv":
                table = self.table()
                if "time" in table and not self.dates:
                    table["time"] = table["time"].map("{:.15g}".format)
                table.to_csv(file, index=False, float_format="%.9g")
            elif suffix == ".parquet":
                try:
                    self.table().to_parquet(file)
                except ImportError as error:
                    raise ValueError(f"{path} needs pyarrow: pip install 'pyro-dvae[parquet]'") from error
            else:
                names, first = zip(*self.keys, strict=True)
                arrays: dict[str, Any] = {"draws": self.draws, "past": self.past, "truth": self.truth}
                arrays |= {
                    "sequence": np.array(names),
                    "step": np.array(first),
                    "columns": np.array(list(self.columns)),
                }
                arrays |= {} if self.times is None else {"times": self.times}
                np.savez_compressed(file, allow_pickle=False, **arrays)

    def plot(self, window: int = 0, columns: Sequence[str] | None = None, most: int = 8) -> Figure:
        """A fan for each coordinate: intervals of 50, 80 and 95 % and the median, after the past and beside the truth.

        Of what is 0 or 1 there is the share of the draws.

        Args:
            window: which.
            columns: which coordinates; the first ones, if not given.
            most: panels.

        Raises:
            ValueError: coordinates that there are not.
        """
        names = list(self.columns)
        for name in columns or ():
            if name not in names:
                raise ValueError(f"no column {name!r}{nearest(name, names)}; there are {', '.join(names[:20])}")
        chosen = [names.index(name) for name in columns or names][:most]
        across = min(2, len(chosen))
        down = -(-len(chosen) // across)
        from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

        figure = canvas(5 * across, 1.9 * down + 0.4)
        panels = figure.subplots(down, across, squeeze=False, sharex=True).ravel()
        observed, horizon = self.past.shape[1], self.draws.shape[2]
        steps: Any = np.arange(observed + horizon) if self.times is None else self._shown(self.times[window])
        before, after = steps[:observed], steps[observed:]
        for axis, place in zip(panels, chosen, strict=False):
            draws = self.draws[:, window, :, place]
            if np.isin(self.draws[..., place], (0, 1)).all():  # no fan, but how many
                axis.plot(after, draws.mean(0), "C0", linewidth=1.2)
                axis.set_ylabel("share", fontsize=8)
                axis.set_ylim(-0.05, 1.05)
            else:
                self._fan(axis, after, draws)
            axis.plot(before, self.past[window, :, place], color="0.3", linewidth=1, marker=".", markersize=3)
            axis.plot(after, self.truth[window, :, place], "k.", markersize=4, label="truth")
            unit = self.columns[names[place]]
            axis.set_title(names[place] + (f" ({unit})" if unit else ""), fontsize=9, parse_math=False)
            axis.tick_params(labelsize=7)
            if self.dates:
                axis.xaxis.set_major_locator(locator := AutoDateLocator(maxticks=6))
                axis.xaxis.set_major_formatter(ConciseDateFormatter(locator))
        for axis in panels[len(chosen) :]:
            axis.set_axis_off()
        for axis in panels[max(len(chosen) - across, 0) : len(chosen)]:  # below which there is none
            axis.tick_params(labelbottom=True)
        known = [axis.get_legend_handles_labels() for axis in panels[: len(chosen)]]
        handles, labels = max(known, key=lambda entry: len(entry[1]))
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8)
        figure.suptitle(f"{self.keys[window][0]} from step {self.keys[window][1]}", fontsize=9, parse_math=False)
        return figure

    def _fan(self, axis: Any, steps: Any, draws: np.ndarray) -> None:
        for level, shade in ((0.95, 0.15), (0.8, 0.3), (0.5, 0.5)):
            low, high = np.quantile(draws, [(1 - level) / 2, (1 + level) / 2], axis=0)
            axis.fill_between(steps, low, high, color="C0", alpha=shade, linewidth=0, label=f"{level:.0%}")
        axis.plot(steps, np.median(draws, 0), "C0", linewidth=1.2, label="median")
