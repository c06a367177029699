"""Reference forecasts for any sequences, without a model."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import torch
from torch import Tensor

from ...data.batch import Batch
from ...data.sequences import (
    HeldOutWindows,
    interpolate_missing,
    mean_of_known,
    sequences,
    take_split,
)
from ...options import nearest
from .baselines import FEWEST, MOST, Baselines, Forecaster, Part, Scale
from .evaluation_windows import EvaluationWindows
from .regressions import fill_missing

USUAL = ("last value", "seasonal", "mean", "climatology", "nearest neighbours")
"""Default reference rows of windows that name none."""
OF_TABLES = ("last value", "drift", "seasonal", "climatology", "climatology by series", "AR", "ETS", "GLM")
"""Default reference rows of tables, before nearest neighbours."""

_EXACT = "donot_use_mm_for_euclid_dist"


def last_places(batch: Batch, observed: int) -> tuple[Tensor, Tensor | None]:
    """Return the last observed step `(B, D)`, and a mask of the coordinates that were observed at all (None: all).

    A coordinate that is missing in the last step has its last observed value, or 0 if it was never observed.

    Args:
        batch: batch with x `(B, T, D)`, and optionally its mask.
        observed: O, number of observed steps.
    """
    x, mask = batch["x"][:, :observed], batch.mask()
    if mask is None:
        return x[:, -1], None
    mask = mask[:, :observed]
    return interpolate_missing(x, mask)[:, -1], mask.any(1)


def distances(
    first: Tensor, second: Tensor, first_mask: Tensor | None = None, second_mask: Tensor | None = None
) -> Tensor:
    """Return Euclidean distances `(N, M)` between `(N, D)` and `(M, D)`.

    If coordinates are missing, the mean squared difference over the coordinates that both points have is multiplied by
    D. Points without a common coordinate are infinitely far apart.

    Args:
        first, second: points, with any value at a missing coordinate.
        first_mask, second_mask: masks `(N, D)` of `first` and `(M, D)` of `second`, True where observed; None for all.
    """
    if first_mask is None and second_mask is None:
        # Matrix-product distances would be too inexact for poses far from the origin, or at a threshold.
        return torch.cdist(first, second, compute_mode=_EXACT)
    first_mask = torch.ones_like(first, dtype=torch.bool) if first_mask is None else first_mask
    second_mask = torch.ones_like(second, dtype=torch.bool) if second_mask is None else second_mask
    first_weights, second_weights = first_mask.to(first), second_mask.to(second)
    # Far from 0, differences of squares would lose digits.
    centre = (torch.where(second_mask, second, 0.0).sum(0) / second_weights.sum(0).clamp(min=1)).double()
    a, b = (torch.where(m, x.double() - centre, 0.0) for m, x in ((first_mask, first), (second_mask, second)))
    first_weights, second_weights = first_weights.double(), second_weights.double()
    shared = first_weights @ second_weights.T
    squares = a.square() @ second_weights.T + first_weights @ b.square().T - 2 * a @ b.T
    result = (squares.clamp(min=0) * (first.shape[-1] / shared)).sqrt()
    return torch.where(shared > 0, result, torch.inf).to(first)


def last_value(observed: Tensor, horizon: int, mask: Tensor | None = None) -> Tensor:
    """Repeat the last observed step, a forecast that any method should beat.

    Args:
        observed: observed steps `(B, O, D)`.
        horizon: H, number of steps to predict.
        mask: `(B, O, D)`, True where a coordinate was observed; one that is missing in the last step has its last
            observed value.

    Returns:
        One forecast, `(1, B, H, D)`, laid out like forecasts of a model.
    """
    return interpolate_missing(observed, mask)[None, :, -1:].expand(-1, -1, horizon, -1)


def seasonal(observed: Tensor, horizon: int, season: int, mask: Tensor | None = None) -> Tensor:
    """Repeat the last observed period.

    Args:
        observed: observed steps `(B, O, D)`.
        horizon: H, number of steps to predict.
        season: number of steps in a period, at most O; 1 repeats the last value.
        mask: `(B, O, D)`, True where a coordinate was observed. A value that is missing in the last period is taken
            from the latest period that has it, or else from linear interpolation in time.

    Returns:
        One forecast, `(1, B, H, D)`.

    Raises:
        ValueError: when the season is not between 1 and O.
    """
    frames = observed.shape[1]
    if not 1 <= season <= frames:
        raise ValueError(f"season must be between 1 and the {frames} observed steps, got {season}")
    last = interpolate_missing(observed, mask)[:, -season:]
    if mask is not None:
        periods = frames // season * season
        x, observed_mask = (each[:, -periods:].unflatten(1, (-1, season)).movedim(1, 2) for each in (observed, mask))
        last = torch.where(observed_mask.any(2), interpolate_missing(x, observed_mask)[:, :, -1], last)
    return last[None, :, torch.arange(horizon) % season]


def climatology(futures: Tensor, count: int, samples: int, seed: int = 0) -> Callable[[slice], Tensor]:
    """Return a forecaster that draws futures of training windows at random and ignores the past.

    Args:
        futures: futures `(N, H, D)` of training windows.
        count: number of windows to forecast.
        samples: K, number of independent draws per window, with replacement.
        seed: seed of the draws.

    Returns:
        Function from a slice of the windows to `(K, B, H, D)`.
    """
    indices = torch.randint(len(futures), (samples, count), generator=torch.Generator().manual_seed(seed))
    return lambda part: futures[indices[:, part]]


def nearest_neighbours(
    observed: Tensor,
    training: Tensor,
    samples: int = 50,
    mask: Tensor | None = None,
    training_mask: Tensor | None = None,
) -> Tensor:
    """Return the futures of the training windows whose last observed poses are closest.

    Args:
        observed: observed steps `(B, O, D)`.
        training: training windows `(N, O + H, D)` with as many observed steps.
        samples: K, number of neighbours.
        mask, training_mask: masks of `observed` and `training`, True where a coordinate was observed. Poses are from
            `last_places`, and missing values of futures are interpolated.

    Returns:
        `(K, B, H, D)`, the closest neighbour first.

    Raises:
        ValueError: when training windows have another size or no future, or are fewer than K.
    """
    frames, size = observed.shape[1:]
    if training.ndim != 3 or training.shape[2] != size or training.shape[1] <= frames:
        raise ValueError(
            f"training windows must be (N, T, {size}) with T above the {frames} observed steps, got shape "
            f"{tuple(training.shape)}"
        )
    if len(training) < samples:
        raise ValueError(f"{samples} neighbours need as many training windows, got {len(training)}; use fewer samples")
    poses = last_places(Batch(x=observed) | ({} if mask is None else {"mask": mask}), frames)
    training_poses = last_places(Batch(x=training) | ({} if training_mask is None else {"mask": training_mask}), frames)
    indices = distances(poses[0], training_poses[0], poses[1], training_poses[1]).topk(samples, largest=False).indices
    return interpolate_missing(training, training_mask)[indices.T, frames:]


@dataclass(frozen=True)
class References:
    """Forecasters without a model. Indexing by name returns the number of forecasts per window, and the `Forecaster`.

    | name | forecasts | needs |
    |---|---|---|
    | last value | the last observed values repeated | |
    | seasonal | the last period repeated | a season that was observed |
    | mean | the mean of every column in the training windows, at all steps | training windows |
    | climatology | K futures of training windows, drawn at random for each window | training windows |
    | nearest neighbours | the futures of the K training windows with the closest last steps | training windows |
    | drift, climatology by series, AR, ETS, GLM | K draws, as in `baselines` | training windows |

    Windows may rename some references by `windows.references`, {new name: name}. The renamed ones are then the default
    rows.

    For tables, last value and seasonal are draws too, and training windows are by default those of the table.
    For others they are point forecasts, as is the mean: their energy score is a distance, their CRPS an absolute error,
    and they have no intervals. Climatology is the distribution of futures without knowledge of the past.

    Args:
        held: windows to forecast.
        samples: K, number of forecasts.
        seed: seed of the draws.
        training: training windows.
        season: number of steps in a period; by default from the windows' description.

    Raises:
        ValueError: on indexing, when the reference does not exist or is not available.
    """

    held: EvaluationWindows
    samples: int
    seed: int = 0
    training: HeldOutWindows | None = None
    season: int | None = None

    def missing_requirement(self, name: str) -> str:
        """Return what a reference still requires; empty if it is available.

        Raises:
            ValueError: when the reference does not exist.
        """
        name = self._names.get(name, name)
        if name not in self._makers:
            raise ValueError(
                f"no reference row {name!r}{nearest(name, [*self._names, *self._makers])}; there are "
                f"{', '.join({**self._names, **self._makers})}"
            )
        needs_training = name not in ("last value", "seasonal")
        if needs_training and self._source is None:
            return "training windows"
        if name == "seasonal" and not 1 <= (self._period or 0) <= self.held.observed:
            got = f", got {self._period}" if self._period else ""
            return f"a season between 1 and the {self.held.observed} observed steps{got}"
        return self._baselines.missing_requirement(name) if name in OF_TABLES and needs_training else ""

    def __getitem__(self, name: str) -> tuple[int, Forecaster]:
        if requirement := self.missing_requirement(name):
            raise ValueError(f"the reference row {name!r} needs {requirement}")
        return self._makers[self._names.get(name, name)]()

    @property
    def usual(self) -> list[str]:
        """Available default rows of an evaluation: from `windows.references`, or else `OF_TABLES` or `USUAL`."""
        return [name for name in self._defaults if not self.missing_requirement(name)]

    @property
    def notes(self) -> Iterator[str]:
        """Notes on exponential smoothing and the seasonal reference of a table, if they are left out."""
        usual = getattr(self.held.windows, "usual_season", 0)
        if "seasonal" in self._defaults and self._period is None and 0 < usual <= self.held.observed:
            yield f"seasonal was left out: it needs a season, which is often {usual} for such steps (--season {usual})"
        if "ETS" in self._defaults and self._source is not None and (needed := self.missing_requirement("ETS")):
            yield f"ETS was left out: it needs {needed}"

    @property
    def _defaults(self) -> tuple[str, ...]:
        return tuple(self._names) or ((*OF_TABLES, "nearest neighbours") if self._is_table else USUAL)

    @property
    def _is_table(self) -> bool:
        return hasattr(self.held.windows, "families")

    @cached_property
    def _source(self) -> Any:
        """Training windows: the given ones, or else the training part of the same table."""
        if self.training is None:
            return getattr(self.held.windows, "training", None)
        return take_split(self.training, "train")

    @property
    def _names(self) -> Mapping[str, str]:
        """Names that the windows give to references."""
        return getattr(self.held.windows, "references", {})

    @property
    def _makers(self) -> dict[str, Callable[[], tuple[int, Forecaster]]]:
        drawn = {"climatology by series", "drift", "AR", "ETS", "GLM"}
        drawn |= {"last value", "seasonal"} if self._is_table and self._source is not None else set()
        return {
            "last value": self._last,
            "seasonal": self._seasonal,
            "mean": self._mean,
            "climatology": self._climatology,
            "nearest neighbours": self._neighbours,
        } | {name: partial(self._drawn, name) for name in sorted(drawn)}

    def _drawn(self, name: str) -> tuple[int, Forecaster]:
        make = cache(lambda: self._baselines[name])  # on the first forecast, when the progress bar is shown
        return self.samples, lambda part: make()(part)

    @cached_property
    def _baselines(self) -> Baselines:
        held, frames = self.held, self.held.x.shape[1]
        scale = Scale(getattr(held.windows, "families", ["real"] * held.x.shape[-1]))
        batch = self._training_batch.map(lambda values: values[:, :frames] if values.ndim == 3 else values)
        if (steps := batch["x"].shape[1]) < frames:
            raise ValueError(f"training windows have {steps} steps, expected the {frames} of the windows to forecast")
        training = Part.of(self._source, batch, held.observed, scale)
        training = training.thinned(max(MOST // batch["x"][0].numel(), FEWEST))
        season = self._period if 1 < (self._period or 0) <= held.observed else None
        options = (held.observed, self.samples, self.seed, season)
        return Baselines(Part.of(held.windows, held.batch, held.observed, scale), training, scale, *options)

    def _last(self) -> tuple[int, Forecaster]:
        return 1, lambda part: last_value(*self._past(part))

    def _seasonal(self) -> tuple[int, Forecaster]:
        def forecast(part: slice) -> Tensor:
            x, horizon, mask = self._past(part)
            return seasonal(x, horizon, self._period or 1, mask)

        return 1, forecast

    def _mean(self) -> tuple[int, Forecaster]:
        mean = mean_of_known(self._training_batch.mask_to_nan(), (0, 1))
        return 1, lambda part: mean.expand(1, len(self.held.x[part]), self._horizon, -1)

    def _climatology(self) -> tuple[int, Forecaster]:
        training, gaps = self._training
        futures = interpolate_missing(training, gaps)[:, self.held.observed :]
        if gaps is not None and self._is_table:  # an interpolated value may be invalid, such as half a count
            given = torch.where(gaps, training, torch.nan)[:, self.held.observed :]
            futures = torch.where((filled := fill_missing(given)).isnan(), futures, filled)
        return self.samples, climatology(futures, len(self.held.x), self.samples, self.seed)

    def _neighbours(self) -> tuple[int, Forecaster]:
        training, gaps = self._training
        count = min(self.samples, len(training))

        def forecast(part: slice) -> Tensor:
            x, _, mask = self._past(part)
            return nearest_neighbours(x, training, count, mask, gaps)

        return count, forecast

    @property
    def _horizon(self) -> int:
        return self.held.x.shape[1] - self.held.observed

    @property
    def _period(self) -> int | None:
        return self.held.windows.description.get("season") if self.season is None else self.season

    def _past(self, part: slice) -> tuple[Tensor, int, Tensor | None]:
        past = self.held.past(part)
        return past["x"], self._horizon, past.mask()

    @cached_property
    def _training_batch(self) -> Batch:
        return sequences(self._source).batch

    @cached_property
    def _training(self) -> tuple[Tensor, Tensor | None]:
        """Training windows, cut to the length of those to forecast, and their mask."""
        batch, frames = self._training_batch, self.held.x.shape[1]
        mask = batch.mask()
        return batch["x"][:, :frames], None if mask is None else mask[:, :frames]
