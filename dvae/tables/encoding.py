"""Encoding of a panel for models: targets as coordinates of x, covariates as context, with units from training data.

| variable | content | shape |
|---|---|---|
| x | targets; a category has one coordinate per class | (B, T, D) |
| c | standardised covariates known in the future or up to the present; indicators | (B, T, C) |
| s | standardised covariates with one value per sequence; indicators | (B, S) |
| d | time since the previous step in median steps, if steps are not evenly spaced | (B, T, 1) |
| r | logarithm of the level of each count: its mean over earlier observed steps, shrunk to the panel's | (B, T, R) |

c ends with the calendar features of the schema (`Calendar.features`), computed from the times, and the values of the
targets at each lag with their indicators. A lagged value is relative to the mean and standard deviation of the O steps
up to it, so sequences of any level and scale are comparable; O is the number of observed steps. It is the logarithm of
positive data, and of 1 + a count.

A missing entry of a covariate repeats the last value, and its indicator is 0. Before any value, the entry is the mean
of the training data, or no class for a category. A covariate known up to the present repeats its last value after that.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from torch import Tensor
from typing_extensions import override

from ..data.batch import Batch
from ..data.blocks import NUMBERS as BLOCK
from ..data.blocks import ColumnSummary, blocks, row_blocks
from ..data.npy import is_mapped
from ..data.schema import Schema, SchemaError
from ..data.series_units import LOCATION, SeriesPrior, SeriesUnits
from ..data.units import LEVELS, RESOLVED, ROUNDING, SMALLEST, TOO_SMALL, Coordinate, is_imprecise
from ..data.views import ContextView, Dequantised, View, Views
from ..distributions.base import DistributionSpec
from ..distributions.family import FAMILIES
from ..distributions.product import Product
from ..options import Amount, Positive, Range, require, tuples
from .calendar import EVEN, FEATURES, NUMBERS, Calendar
from .columns import WHOLE_STEPS, Column, Columns
from .panel import COUNTS, Panel, Series
from .protocol import Cut

COVARIATES, STATICS, GAPS, LEVELS_OF_COUNTS = "c", "s", "d", "r"
"""Names of context in batches."""
LEAST = 1e-7
"""Standard deviation of logarithms below which values count as constant up to rounding errors."""
CENTRED = ("real", "fixed", "robust", "laplace", "mixture", "correlated")
POSITIVE = ("positive", "log-normal")
LOGARITHMIC = (*POSITIVE, "hurdle", "power")
"""Families whose logarithms networks read."""
SCALED = (*LOGARITHMIC, *COUNTS)
TargetUnits = Literal["columns", "logs", "series", "changes", "seasonal"]
"""Units of the targets in a model.

"columns": mean and scale of each column. "logs": the same, for logarithms of positive data. "series": level and scale
of each sequence. "changes": changes since the last value. "seasonal": differences from the mean of the same step in
earlier seasons. Both are relative to their mean and scale in the sequence (`dvae.data.series_units`). The last three
use logarithms of positive data, and the level of a sequence as a known factor of its counts.
"""
UNITS_OF_SERIES = (*CENTRED, *POSITIVE, *COUNTS)
"""Families whose targets can be relative to their sequence."""
LONGEST = 1024
"""Maximum number of steps of a training window for the choice of units if sequences are not cut."""
CLOSER = 2
"""Smallest ratio of errors for which methods prefer other units than "columns".

Networks infer moderate differences of level themselves. On validation windows of public tables, units of the sequence
improved forecasts where the ratio was above 3, and had mixed effects below 1.8.
"""
SEASONS = 6
"""Number of observed seasons from which on networks are expected to learn a season.

On validation windows of public tables, forecasts were better in units of the sequence with 8 observed seasons
(`ridership`), and mostly in seasonal units with 3 (`housing`). No table has a number in between with such a season.
"""
FIXED = 1e12
"""Weight of a prior that observations do not change."""


@dataclass(frozen=True)
class PanelSchema(Schema):
    """Schema of a panel; the module docstring describes the encoding.

    Args:
        columns: schema of the table.
        cut: how sequences are split and cut.
        means, scales: dictionaries from standardised column to its mean and scale over the training data.
        logarithms: dictionary from column that models read as logarithm to its smallest positive value, and the mean
            and standard deviation of its logarithms.
        with_missing: names of columns with an indicator: those with missing training values, or known only up to the
            present.
        step: median time between steps; 0 if steps are evenly spaced.
        calendar: kind, time zone and calendar step of the times.
        priors: dictionary from column to the prior of its level and scale by lag, `SeriesPrior` as a tuple.
        target_units: units of the targets in a model.
        preferred: units whose reference point is closest to the future in training windows: the mean of the column, the
            mean of the sequence, its last value or the mean of its seasons; "columns" unless another is twice as close.
            If `SEASONS` seasons are observed, their means are subtracted first, and "seasonal" is not considered. The
            default of methods.
    """

    kind: ClassVar[str] = "panel"

    sizes: Mapping[str, int] = field(default_factory=dict)
    columns: Columns = field(default_factory=lambda: Columns((Column("x"),)))
    cut: Cut = field(default_factory=Cut)
    means: Mapping[str, Annotated[float, Range()]] = field(default_factory=dict)
    scales: Mapping[str, Positive] = field(default_factory=dict)
    logarithms: Mapping[str, tuple[Positive, Annotated[float, Range()], Positive]] = field(default_factory=dict)
    with_missing: tuple[str, ...] = ()
    step: Amount = 0.0
    calendar: Calendar = NUMBERS
    priors: Mapping[str, Mapping[str, tuple[float, ...]]] = field(default_factory=dict)
    target_units: TargetUnits = "columns"
    preferred: TargetUnits = "columns"

    def __post_init__(self) -> None:
        sizes = {"x": len(self.coordinates)}
        for name, roles in ((COVARIATES, ("known", "past")), (STATICS, ("static",))):
            covariates = self.columns.of(*roles)
            if covariates:
                n_indicators = sum(column.name in self.with_missing for column in covariates)
                sizes[name] = sum(len(column.coordinates) for column in covariates) + n_indicators
        if self.columns.calendar:
            sizes[COVARIATES] = sizes.get(COVARIATES, 0) + sum(FEATURES[name] for name in self.columns.calendar)
        if self.columns.lags:
            sizes[COVARIATES] = sizes.get(COVARIATES, 0) + 2 * len(self.columns.lags) * sizes["x"]
        if self.step:
            sizes[GAPS] = 1
        if self.counts:
            sizes[LEVELS_OF_COUNTS] = len(self.counts)
        for name, value in (("sizes", sizes), ("length", self.cut.length), ("observed", self.cut.observed)):
            object.__setattr__(self, name, value)  # derived from the other fields
        super().__post_init__()
        if short := [lag for lag in self.columns.lags if lag < (self.cut.horizon or 1)]:
            raise ValueError(
                f"lag {short[0]} is below the horizon {self.cut.horizon}, so its values are unknown at later steps of "
                "a forecast; give lags at or above the horizon (models read the observed steps themselves)"
            )
        for name, by_lag in self.priors.items():
            for lag, values in by_lag.items():
                positive = values[1:2] if lag == "log" else (*values[1:4], *values[5:6])
                if len(values) != (2 if lag == "log" else 7) or not (np.isfinite(values).all() and min(positive) > 0):
                    raise ValueError(
                        f"the prior {lag} of {name} is {values}; expected finite numbers with positive scales, as "
                        "`PanelSchema.from_data` estimates them"
                    )
        covariates = self.columns.of("known", "past", "static")
        if missing := {c.name for c in covariates if c.family == "real"} - (self.means.keys() & self.scales.keys()):
            raise ValueError(
                f"no mean and scale of {', '.join(sorted(missing))}; expected both for every real "
                "covariate, as `PanelSchema.from_data` computes them"
            )
        if missing := {c.name for c in self.columns.of("past")} - {*self.with_missing}:
            raise ValueError(
                f"no indicator of {', '.join(sorted(missing))}; add these covariates, known up to the present, to "
                "`with_missing`"
            )

    @classmethod
    def from_data(cls, panel: Panel, cut: Cut) -> Self:
        """Return the schema of a panel, with units from its training sequences."""
        starts = cut.starts(panel, "train")
        ends = [panel.present(panel.series[n]) if cut.length is None else last + cut.length for n, _, last in starts]
        parts = [(panel.series[n], slice(low, end)) for (n, low, _), end in zip(starts, ends, strict=True)]
        if not parts:
            raise ValueError(
                f"{panel.name} has no training window of {cut.name}: its longest sequence has "
                f"{max(map(len, panel.series))} steps, and the split may leave fewer for training; choose fewer "
                "observed steps or a shorter horizon (--observed, --horizon)"
            )
        training = [sequence.values[part] for sequence, part in parts]
        summary, steps = ColumnSummary.of(row_blocks(training)), sum(map(len, training))
        means, scales, logarithms, with_missing = {}, {}, {}, []
        for index, column in enumerate(panel.columns.columns):
            if not summary.count[index]:
                raise ValueError(f"column {column.name!r} has no value in the training part of {panel.name}")
            mean, scale = float(summary.mean[index]), float(np.sqrt(summary.variance[index]))
            varies = scale > ROUNDING * abs(mean)
            if column.role == "target" and varies and scale < SMALLEST:
                raise ValueError(f"the standard deviation of column {column.name!r} is {scale:g}; {TOO_SMALL}")
            if column.family in CENTRED:
                means[column.name], scales[column.name] = mean, scale if varies else 1.0
            elif column.family not in ("binary", "category") and varies and scale < RESOLVED * abs(mean):
                raise ValueError(
                    f"column {column.name!r} has mean {mean:.9g} and standard deviation {scale:.3g}, which float32 "
                    f"does not resolve in the family {column.family!r}; give it the family 'real'; models subtract "
                    "the mean of real columns in float64"
                )
            if column.family in SCALED:
                means[column.name], scales[column.name] = 0.0, mean or 1.0
                if column.family in LOGARITHMIC and summary.largest[index] > 0:
                    logarithms[column.name] = _logarithms([values[:, index, None] for values in training])
            if column.family == "binary":
                means[column.name] = mean
            if column.role == "past" or summary.count[index] < steps:
                with_missing.append(column.name)
        training_values = [(sequence.name, values) for (sequence, _), values in zip(parts, training, strict=True)]
        _warn_of_levels(panel.columns, means, training_values)
        shares = np.array([means[c.name] for c in panel.columns.targets if c.family == "binary"])
        spread = float(np.sqrt((shares * (1 - shares)).mean())) if len(shares) else 0.0
        scales |= {
            c.name: spread or 1.0 for c in panel.columns.targets if c.family == "binary"
        }  # one scale, as some events are rare
        gaps = np.concatenate(
            [np.diff(sequence.times[part]) if sequence.times is not None else np.empty(0) for sequence, part in parts]
        )
        median = float(np.median(gaps)) if len(gaps) else 0.0
        step = median if len(gaps) and (gaps.max() > EVEN * median or median > EVEN * gaps.min()) else 0.0
        if step and panel.columns.lags and not panel.calendar.skips_days:  # weekends are no gaps
            warnings.warn(
                f"{panel.name} has uneven steps, and lags count rows: a lag of {panel.columns.lags[0]} rows is not "
                "always the same time; add the missing rows, with empty targets, if that matters",
                stacklevel=2,
            )
        if unseen := [lag for lag in panel.columns.lags if lag >= max(ends)]:
            warnings.warn(
                f"training never observes the value at lag {unseen[0]}: it ends after {max(ends)} rows of the longest "
                f"sequence of {panel.name}; give shorter lags",
                stacklevel=2,
            )
        units: dict[str, Any] = {"means": means, "scales": scales, "logarithms": logarithms}
        windows = _TrainingWindows(training, cut)
        units["priors"] = _estimate_priors(panel.columns, windows)
        units["preferred"] = _prefer(panel.columns, windows)
        return cls(
            columns=panel.columns,
            cut=cut,
            **units,
            with_missing=tuple(with_missing),
            step=step,
            calendar=panel.calendar,
        )

    @property
    @override
    def preset(self) -> str:
        """ "table" if forecasts have a horizon, which can select the weights."""
        return "" if self.cut.observed is None else "table"

    @property
    def protocol(self) -> Cut:
        """How sequences are split and cut."""
        return self.cut

    @property
    def coordinates(self) -> list[str]:
        """Names of the coordinates of x."""
        return [name for column in self.columns.targets for name in column.coordinates]

    def in_units(self, target_units: TargetUnits) -> Self:
        """Return the schema with other units of the targets; see `TargetUnits`.

        Raises:
            SchemaError: if no prior of level and scale is known for these units.
        """
        require(TargetUnits, target_units=target_units)
        schema = replace(self, target_units=target_units)
        is_known = target_units != "seasonal" or self.cut.season is not None
        if target_units != "columns" and not (is_known and any(map(schema._prior, self.columns.targets))):
            names = ", ".join(f"{column.name} ({column.family})" for column in self.columns.targets)
            needs = {"logs": "a column of a positive family", "seasonal": "a season (season=7, --season 7)"}
            need = needs.get(target_units, "a column of numbers or counts")
            others = target_units in needs and any(c.family in UNITS_OF_SERIES for c in self.columns.targets)
            advice = "series or changes" if others else "columns"
            raise SchemaError(f"units {target_units!r} need {need}; got {names}; take the units {advice}")
        return schema

    @property
    def counts(self) -> list[int]:
        """Indices in x of the counts with a prior of their level."""
        places, start = [], 0
        for column in self.columns.targets:
            places += [start] if column.family in COUNTS and "0" in self.priors.get(column.name, {}) else []
            start += len(column.coordinates)
        return places

    def _prior(self, column: Column) -> SeriesPrior | None:
        """Return the prior of level and scale of a column in these units; None for a column without."""
        lags = {"columns": "", "logs": "0", "series": "0", "changes": "1", "seasonal": str(self.cut.season)}
        lag = "0" if column.family in COUNTS and self.exposure else lags[self.target_units]
        values = self.priors.get(column.name, {}).get(lag)
        if values is None or (self.target_units == "logs" and column.family not in POSITIVE):
            return None
        prior = SeriesPrior._make((*values[:-1], bool(values[-1])))
        if self.target_units == "logs":
            return prior._replace(mean=prior.level, weight=FIXED, variance=prior.spread**2, freedom=FIXED)
        return prior

    def levels(self, batch: Batch) -> Tensor:
        """Return r (B, T, R): logarithms of the levels of counts, which do not change after the observed steps.

        Args:
            batch: windows with x (B, T, D), their mask and lengths.
        """
        columns = [column for column in self.columns.targets for _ in column.coordinates]
        priors = [SeriesPrior._make((*self.priors[columns[n].name]["0"][:-1], False)) for n in self.counts]
        view = SeriesUnits(tuple(priors), observed=self.cut.observed)
        parts = {"x": batch["x"][..., self.counts]}
        if (mask := batch.mask()) is not None:
            parts["mask"] = mask[..., self.counts]
        level: Tensor = view(Batch(parts))[LOCATION]
        return level.clamp(min=1e-9).log()

    @property
    @override
    def view(self) -> View:
        """View that offers the context as optional inputs, and changes x to the units of `target_units`.

        If columns declare a rounding, it first adds noise of this width to x.
        """
        columns = [column for column in self.columns.targets for _ in column.coordinates]
        views: list[View] = [ContextView(tuple(name for name in self.sizes if name != "x"))]
        priors = tuple(None if column.family in COUNTS else self._prior(column) for column in columns)
        if any(priors):
            lag = {"changes": 1, "seasonal": self.cut.season or 0}.get(self.target_units, 0)
            views.insert(0, SeriesUnits(priors, lag, self.cut.observed))
        widths = tuple(float(column.rounding) for column in columns)
        if any(widths):
            views.insert(0, Dequantised(widths))
        return Views(*views) if len(views) > 1 else views[0]

    @property
    def exposure(self) -> tuple[str, Sequence[int]] | None:
        """Name of the logarithms of the levels of counts, and the indices of these counts in x; None if not used."""
        return (LEVELS_OF_COUNTS, self.counts) if self.counts and self.target_units not in ("columns", "logs") else None

    @property
    @override
    def emission(self) -> DistributionSpec:
        """Distribution of the targets: a single one if all have the same family, else a product."""
        parts: dict[tuple[str, str], list[int]] = {}
        start = 0
        for column in self.columns.targets:
            indices = list(range(start, start + len(column.coordinates)))
            start += len(indices)
            event = column.name if column.family == "category" else ""  # each category is a separate event
            family = "real" if column.family in POSITIVE and self._prior(column) else column.family
            parts.setdefault((family, event), []).extend(indices)
        if len(parts) == 1:
            ((family, _),) = parts
            return FAMILIES[family]
        return Product(tuple((tuple(indices), FAMILIES[family]) for (family, _), indices in parts.items()))

    @property
    @override
    def covariates(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of covariates and gaps, and of static covariates."""
        local = tuple(name for name in (COVARIATES, GAPS) if name in self.sizes)
        local += (LEVELS_OF_COUNTS,) if self.exposure else ()
        return local, ((STATICS,) if STATICS in self.sizes else ())

    @property
    @override
    def indicators(self) -> tuple[str, ...]:
        """("x",) if a target has missing values, else ()."""
        return ("x",) if any(column.name in self.with_missing for column in self.columns.targets) else ()

    @property
    @override
    def together(self) -> Sequence[int]:
        """Index of the column of each coordinate; all 0 if every step is either fully observed or fully missing."""
        targets = enumerate(self.columns.targets)
        return [0 if is_whole(self.columns) else index for index, column in targets for _ in column.coordinates]

    @property
    @override
    def units(self) -> Mapping[str, Sequence[Coordinate]]:
        """Units of x; missing values are replaced by the mean, or by the mean logarithm where logarithms are read."""
        coordinates = []
        for column in self.columns.targets:
            if prior := self._prior(column):
                coordinates += [self._relative_units(column, prior)]
                continue
            mean, scale = self.means.get(column.name, 0.0), self.scales.get(column.name, 1.0)
            logarithm = self.logarithms.get(column.name, ())
            typical = float(np.exp(logarithm[1])) if logarithm else scale if column.family in SCALED else mean
            coordinate = Coordinate(mean, scale, typical, *logarithm)
            coordinates += [coordinate] * len(column.coordinates)
        if not self.exposure:
            return {"x": coordinates}
        levels = [coordinates[n] for n in self.counts]
        return {
            "x": coordinates,
            LEVELS_OF_COUNTS: [Coordinate(each.level, each.spread, each.level) for each in levels],
        }

    def _relative_units(self, column: Column, prior: SeriesPrior) -> Coordinate:
        """Return units of values that are relative to their sequence; networks read logarithms of counts."""
        if column.family not in COUNTS:
            return Coordinate()
        level, spread = self.priors[column.name]["log"]
        return Coordinate(0.0, 1.0, prior.mean, 0.5, level, spread)

    @cached_property
    def places(self) -> dict[str, int]:
        """Index of each column in `Series.values`."""
        return {name: index for index, name in enumerate(self.columns.names)}

    def targets(self, one: Series) -> np.ndarray:
        """Return x (T, D) of a sequence, NaN where missing."""
        return self.encoded(one.values)

    def encoded(self, values: np.ndarray) -> np.ndarray:
        """Return x (..., D) from values (..., C) of the columns, NaN where missing."""
        columns = self.columns.targets
        indices = [self.places[column.name] for column in columns]
        if all(column.family != "category" for column in columns):
            return values if indices == [*range(values.shape[-1])] else values[..., indices]
        return np.concatenate([_encode(values[..., n], column) for n, column in zip(indices, columns, strict=True)], -1)

    def context(self, one: Series) -> np.ndarray:
        """Return c (T, C) of a sequence, with future values of all covariates."""
        parts = [self._fill(one.values, columns)] if (columns := self.columns.of("known", "past")) else []
        if self.columns.calendar:
            assert one.times is not None  # checked by the panel
            parts.append(self.calendar.features(one.times, self.columns.calendar))
        return np.concatenate([*parts, *self._lagged(one)], 1)

    def _lagged(self, one: Series) -> list[np.ndarray]:
        """Return the relative values of the targets and their indicators (T, 2 D) at each lag."""
        if not self.columns.lags:
            return []
        import pandas as pd  # slow to import

        families = [column.family for column in self.columns.targets for _ in column.coordinates]
        x = pd.DataFrame(np.array(self.targets(one), np.float64))
        for index, family in enumerate(families):
            if family in COUNTS:
                x[index] = np.log1p(x[index])
            elif family in POSITIVE:
                x[index] = np.log(x[index])
        recent = x.rolling(self.cut.observed or len(x), min_periods=1)
        relative = ((x - recent.mean()) / recent.std(ddof=0).where(lambda scale: scale > 0, np.inf)).fillna(0.0)
        both = pd.concat([relative, x.notna().astype(float)], axis=1)
        return [both.shift(lag, fill_value=0.0).to_numpy() for lag in self.columns.lags]

    def static(self, one: Series) -> np.ndarray:
        """Return s (S,) of a sequence.

        Raises:
            ValueError: if a column changes within the sequence.
        """
        columns, values = self.columns.of("static"), one.values[:1].copy()
        for column in columns:
            index = self.places[column.name]
            observed = one.values[:, index][~np.isnan(one.values[:, index])]
            if len(observed) and (observed != observed[0]).any():
                raise ValueError(
                    f"column {column.name!r} is static, but changes within sequence {one.name!r}; make it known or past"
                )
            values[0, index] = observed[0] if len(observed) else np.nan
        (row,) = self._fill(values, columns)
        return np.asarray(row)

    def unforeseen(self, parts: Sequence[np.ndarray]) -> list[str]:
        """Return covariates that have missing values in parts (T, C), but not in the training data."""
        names = []
        for column in self.columns.of("known", "static"):
            absent = (np.isnan(part[:, self.places[column.name]]) for part in parts)
            is_missing = any(mask.all() if column.role == "static" else mask.any() for mask in absent)
            names += [column.name] if is_missing and column.name not in self.with_missing else []
        return names

    def gaps(self, one: Series) -> np.ndarray:
        """Return d (T, 1) of a sequence, 1 at its first step."""
        if one.times is None:
            return np.ones((len(one), 1))
        return np.concatenate([[1.0], np.diff(one.times) / self.step])[:, None]

    def _fill(self, values: np.ndarray, columns: Sequence[Column]) -> np.ndarray:
        """Return covariates standardised and without missing values, each followed by its indicator, if any."""
        parts = []
        for column in columns:
            cells = values[:, self.places[column.name]]
            observed = ~np.isnan(cells)
            last = np.maximum.accumulate(np.where(observed, np.arange(len(cells)), -1))
            carried = np.where(last >= 0, cells[last], np.nan)
            if column.family == "category":
                part = _encode(carried, column)
                parts.append(np.nan_to_num(part))
            else:
                mean, scale = self.means[column.name], self.scales[column.name]
                parts.append(((np.where(last >= 0, carried, mean) - mean) / scale)[:, None])
            if column.name in self.with_missing:
                parts.append(observed[:, None].astype(float))
        return np.concatenate(parts, 1)

    @cached_property
    def ending(self) -> tuple[list[int], list[int]]:
        """Indices in c of the covariates that are known up to the present, and of their indicators."""
        coordinates: list[int] = []
        indicators, start = [], 0
        for column in self.columns.of("known", "past"):
            width = len(column.coordinates)
            if column.role == "past":
                coordinates += range(start, start + width)
                indicators.append(start + width)
            start += width + (column.name in self.with_missing)
        return coordinates, indicators

    @override
    def config(self) -> dict[str, Any]:
        """Return the schema as JSON types."""
        entries: dict[str, Any] = {name: dict(getattr(self, name)) for name in ("means", "scales", "logarithms")}
        entries |= {"with_missing": list(self.with_missing), "step": self.step, "calendar": asdict(self.calendar)}
        entries["priors"] = {name: {lag: list(each) for lag, each in by.items()} for name, by in self.priors.items()}
        entries |= {n: v for n in ("target_units", "preferred") if (v := getattr(self, n)) != "columns"}
        return {"columns": self.columns.config(), "cut": asdict(self.cut), **entries}

    @classmethod
    @override
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Return the schema from its `config`."""
        options = tuples(config)
        options |= {"columns": Columns.from_config(config["columns"]), "cut": Cut(**config["cut"])}
        options["logarithms"] = tuples(config["logarithms"])
        options["priors"] = {name: tuples(by) for name, by in config.get("priors", {}).items()}
        options["calendar"] = Calendar(**config["calendar"])
        return cls(**options)


@dataclass(frozen=True)
class _TrainingWindows:
    """Evenly spaced windows of training sequences, as long as those of the cut; without a cut at most `LONGEST` steps.

    A column has at most `BLOCK` values in them, and an eighth of it if sequences are mapped from disk.

    Args:
        training: values (T, C) of training sequences.
        cut: how sequences are cut into windows.
    """

    training: Sequence[np.ndarray]
    cut: Cut

    @cached_property
    def places(self) -> list[tuple[int, slice]]:
        """Sequence and steps of each window."""
        steps, stride = self.cut.length or LONGEST, self.cut.horizon or LONGEST
        ends = [len(part) - (self.cut.length or 1) + 1 for part in self.training]
        places = [(n, slice(t, t + steps)) for n, end in enumerate(ends) for t in range(0, end, stride)]
        most = BLOCK // (8 if any(map(is_mapped, self.training)) else 1) // steps
        return places[:: -(-len(places) // max(most, 1))]

    def column(self, index: int) -> np.ndarray:
        """Return the values (N, T) of a column in each window, in float64; shorter windows end with NaN."""
        longest = max(len(self.training[n][part]) for n, part in self.places)
        values = np.full((len(self.places), longest), np.nan)
        for row, (n, part) in zip(values, self.places, strict=True):
            row[: len(self.training[n][part])] = self.training[n][part, index]
        return values


def _estimate_priors(columns: Columns, windows: _TrainingWindows) -> dict[str, dict[str, tuple[float, ...]]]:
    """Return priors of level and scale by column and lag; "log" has mean and deviation of the logarithms of counts."""
    priors: dict[str, dict[str, tuple[float, ...]]] = {}
    cut = windows.cut
    for index, column in enumerate(columns.columns):
        if column.role != "target" or column.family not in UNITS_OF_SERIES:
            continue
        values, is_count = windows.column(index), column.family in COUNTS
        if np.isnan(values).all():
            continue
        by_lag = priors.setdefault(column.name, {})
        for lag in {0} if is_count else {0, 1, cut.season or 0}:
            if cut.observed is None or lag <= cut.observed:
                by_lag[str(lag)] = tuple(map(float, SeriesPrior.estimate(values, lag, column.family in POSITIVE)))
        if is_count:
            logarithms = np.log(values.clip(0.5))
            by_lag["log"] = float(np.nanmean(logarithms)), float(np.nanstd(logarithms)) or 1.0
    return priors


def _prefer(columns: Columns, windows: _TrainingWindows) -> str:
    """Return `PanelSchema.preferred`, by mean absolute errors relative to the smallest one of each column."""
    cut, totals = windows.cut, dict[str, float]()
    if cut.observed is None or cut.horizon is None:
        return "columns"
    for index, column in enumerate(columns.columns):
        if column.role != "target" or column.family not in UNITS_OF_SERIES:
            continue
        x = windows.column(index)
        x, seasonal = np.ma.masked_invalid(np.log(x) if column.family in POSITIVE else x), dict[str, np.ndarray]()
        if cut.season:
            means = np.ma.stack([x[:, n : cut.observed : cut.season].mean(1) for n in range(cut.season)], 1)
            seasons = means[:, np.arange(x.shape[1]) % cut.season]
            if cut.observed < SEASONS * cut.season:
                seasonal["seasonal"] = seasons[:, cut.observed :]
            else:
                x = x - seasons + x[:, : cut.observed].mean(1, keepdims=True)
        past, future = x[:, : cut.observed], x[:, cut.observed :]
        present = np.maximum.accumulate(np.where(past.mask, -1, np.arange(cut.observed)), 1)[:, -1:]
        last = np.ma.array(np.take_along_axis(x, present.clip(0), 1), mask=present < 0)
        points = {"columns": past.mean(), "series": past.mean(1, keepdims=True), "changes": last, **seasonal}
        errors = {name: float(np.ma.filled(abs(future - point).mean(), np.inf)) for name, point in points.items()}
        for name, error in errors.items():
            totals[name] = totals.get(name, 0.0) + error / (min(errors.values()) or 1.0)
    best = min(totals, key=lambda name: totals[name], default="columns")
    return best if totals and totals["columns"] > CLOSER * totals[best] else "columns"


def _logarithms(parts: Sequence[np.ndarray]) -> tuple[float, float, float]:
    """Return the smallest positive value of parts (n, 1), and mean and deviation of logarithms clipped to it."""
    floor = ColumnSummary.of(np.where(block > 0, block, np.nan) for block in row_blocks(parts)).least.item()
    summary = ColumnSummary.of(np.log(block.astype(np.float64).clip(floor)) for block in row_blocks(parts))
    spread = float(np.sqrt(summary.variance.item()))
    return floor, summary.mean.item(), spread if spread > LEAST else 1.0


def _warn_of_levels(columns: Columns, means: Mapping[str, float], training: Sequence[tuple[str, np.ndarray]]) -> None:
    """Warn if a column varies within a sequence by less than float32 resolves after the mean is subtracted."""
    center = np.array([means.get(name, 0.0) for name in columns.names])
    imprecise = np.array([is_imprecise(ColumnSummary.of(blocks(values)), center) for _, values in training])
    for column, mean, sequences in zip(columns.columns, center, imprecise.T, strict=True):
        if sequences.any() and column.family not in ("binary", "category"):
            warnings.warn(
                f"column {column.name!r} varies by less than float32 resolves, because its values are far from "
                f"{mean:.9g}, in {sequences.sum()} of {len(training)} training sequences, such as "
                f"{training[sequences.argmax()][0]!r}; {LEVELS}",
                stacklevel=3,
            )


def _encode(values: np.ndarray, column: Column) -> np.ndarray:
    """Return a column (...) as coordinates (..., n), NaN where missing."""
    if column.family != "category":
        return np.asarray(values[..., None])
    one_hot = np.asarray(values[..., None] == np.arange(len(column.classes)), float)
    one_hot[np.isnan(values)] = np.nan
    return one_hot


def is_whole(columns: Columns) -> bool:
    """Return whether every step is either fully observed or fully missing."""
    return any(column.family in WHOLE_STEPS for column in columns.targets)
