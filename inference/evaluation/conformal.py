"""Tubes around forecasts that hold the future as often as they say, whatever the model: split conformal prediction.

How far the future y of a window is from the mean m of its K forecasts, in their standard deviations v, is known of
windows that were kept for calibration. A tube m ± q v, q a quantile of these distances, holds the future of a new
window with the level asked for, if both are exchangeable (Vovk, Gammerman and Shafer 2005; Lei et al. 2018, arXiv
1604.04173). At once it holds

    every number alone      s = |y_td - m_td| / v_td         a factor for each frame t and coordinate d
    a frame                 s = max over d                   a factor for each frame
    the whole future        s = max over t and d             one factor

Windows of a clip depend on each other: what is exchangeable is clips. The quantile is that of hierarchical conformal
prediction (Lee, Barber and Willett 2023, arXiv 2306.06342; groups as in Dunn, Wasserman and Ramdas 2018, arXiv
1809.07441): each of C clips has the weight 1 / (C + 1), which its windows share, and as much lies at infinity. A window
drawn from a new clip is held with probability `level` at least. Of clips of one window each, q is the
⌈(C + 1) level⌉-th smallest distance, and the probability is level + 1 / (C + 1) at most where there are no ties.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from torch import Tensor, nn
from typing_extensions import override

from ...data.sequences import HeldOutWindows, called, clusters, columns_of, mean_of_known, scales_of
from ...options import nearest
from .evaluate import evaluate, forecaster_of, forecasts_of
from .evaluation import Evaluation
from .held import Held, clip_places, hold, reproducibly
from .record import Dims
from .references import References
from .result import Result, Table, canvas, progress_bar
from .scores import Measure, clip_means

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REGIONS: Mapping[str, tuple[int, ...]] = {"number": (), "frame": (-1,), "future": (-2, -1)}
"""What a tube holds at once, and over which dimensions of (..., H, D) its distance is the largest."""


@dataclass(frozen=True, eq=False, repr=False)
class Tubes(Result):
    """How many times their spread forecasts are to be widened, so that tubes hold the future as often as they say.

    Attributes:
        level: the share of windows whose future tubes hold.
        factors: by what is held at once, "number" (H, D), "frame" (H, 1) or "future" (1, 1): half the width of the
            tube over the spread.
        spread: (H, D), in the unit of the data, where it is not the standard deviation of a window's forecasts.
        samples: K, the forecasts of a window.
        seed: of their draws.
        options: further arguments of the model's `forecast`.
        clips: C, what is exchangeable, of the calibration windows.
        data: of these windows.

    Example:
        >>> model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2})
        >>> kept, new = (dvae.ArrayWindows(torch.randn(40, 8, 2), observed=4) for _ in range(2))
        >>> tubes = dvae.conformal(model, kept, level=0.9, samples=20, progress=False)
        >>> lower, upper = tubes.tube(model.forecast(new.all()["x"][:, :4], 4, 20, draw_emission=True)["x"])
        >>> lower.shape, tubes.coverage(model, new)["model"]["held 90 %, future"].mean > 0.7
        (torch.Size([40, 4, 2]), True)
    """

    level: float
    factors: Annotated[Mapping[str, np.ndarray], Dims("step", "column", name="factor of a {}")]
    spread: Annotated[np.ndarray, Dims("step", "column")] | None
    samples: int
    seed: int
    options: Mapping[str, Any]
    clips: int
    data: Mapping[str, Any]

    def tube(self, forecasts: Tensor, region: str = "future") -> tuple[Tensor, Tensor]:
        """The tubes of some forecasts, which are made as those of the calibration were.

        Args:
            forecasts: `(K, B, H, D)`, of a model or reference.
            region: what a tube holds with the level: "number", each number alone; "frame", all numbers of a frame; or
                the whole "future".

        Returns:
            Lower and upper end, `(B, H, D)` each.

        Raises:
            ValueError: an unknown region, or forecasts of another shape.
        """
        if region not in REGIONS:
            raise ValueError(f"no tubes of a {region!r}{nearest(region, REGIONS)}; there are {', '.join(REGIONS)}")
        shape = self.factors["number"].shape
        if forecasts.ndim != 4 or forecasts.shape[2:] != shape or len(forecasts) != self.samples:
            expected = f"(K, B, H, D) = ({self.samples}, B, {shape[0]}, {shape[1]})"
            raise ValueError(f"these tubes are of forecasts {expected}, not {tuple(forecasts.shape)}")
        reach = self._factor(region, forecasts) * self._spread(forecasts.movedim(1, 0))
        return forecasts.mean(0) - reach, forecasts.mean(0) + reach

    def scores(self, windows: HeldOutWindows) -> list[Measure]:
        """For `evaluate`: how often the future is held and how wide tubes are, as forecasts say and recalibrated.

        What forecasts say themselves is a tube m ± q v, too, whose q is the quantile of how far each of them is from
        the others. Shares are of windows of a clip drawn at random: clips count alike, as in the calibration.
        """
        scales, units = torch.tensor(scales_of(windows) or 1.0), {*columns_of(windows).values()}
        unit = "scales" if scales.ndim else units.pop() if len(units) == 1 else ""
        percent, least = f"{100 * self.level:g} %", {"said": max(3, _fewest(self.level)), "held": 1}

        @lru_cache(maxsize=1)  # for all scores of a batch
        def judged(forecasts: Tensor, truth: Tensor) -> dict[tuple[str, str], tuple[Tensor, Tensor]]:
            gaps = truth.isnan()
            spread = self._spread(forecasts)
            away, own = standardised(forecasts, truth, spread), None
            if forecasts.shape[1] >= least["said"]:
                own = _own_distances(forecasts, None if self.spread is None else spread).masked_fill(
                    gaps[:, None], torch.nan
                )
            found = {}
            for region in REGIONS:
                far, factors = worst(away, region), {"held": self._factor(region, forecasts)}
                if own is not None:
                    factors["said"] = _smallest(worst(own, region), self.level)
                for how, factor in factors.items():
                    inside = (far <= factor).double().masked_fill(far.isnan(), torch.nan)
                    width = (2 * factor * spread / scales).masked_fill(gaps, torch.nan)
                    found[how, region] = mean_of_known(inside, (-2, -1)), mean_of_known(width, (-2, -1))
            return found

        def measure(how: str, region: str, place: int) -> Measure:
            name, in_unit = (("", "share"), ("width ", unit))[place]
            return Measure(
                f"{name}{how} {percent}, {region}",
                lambda forecasts, truth, past, index: judged(forecasts, truth)[how, region][place],
                in_unit,
                better="",
                pool=clips_alike,
                least=least[how],
                of_draws=True,
                note="said: tubes as wide as forecasts say; held: recalibrated. Of a window of a clip drawn at random",
            )

        return [measure(how, region, place) for place in (0, 1) for region in REGIONS for how in least]

    def coverage(
        self,
        model: nn.Module | Mapping[str, nn.Module] | str,
        windows: HeldOutWindows,
        *,
        training_windows: HeldOutWindows | None = None,
        progress: bool = True,
    ) -> Evaluation:
        """How often tubes hold the future of other windows, with errors clustered by clip, before and after.

        Args:
            model: whose forecasts the tubes are of; or a reference's name.
            windows: to judge on.
            training_windows: what some references know.
            progress: whether to show a progress bar.

        Returns:
            `scores` of these forecasts; "said" is before, "held" after.
        """
        models, references = ({}, [model]) if isinstance(model, str) else (model, [])
        return evaluate(
            models,
            windows,
            scores=self.scores,
            draw_emission=True,
            samples=self.samples,
            seed=self.seed,
            references=references,
            training_windows=training_windows,
            options=self.options,
            progress=progress,
        )

    def table(self) -> Table:
        """Factors: their mean over frames and coordinates, the least and the largest."""
        clip, frame = called(self.data)
        title = f"tubes of {100 * self.level:g} % · {self.data['windows']} windows of {self.clips} {clip}s"
        table = Table(title=title, caption=f"half the width of a tube over the forecasts’ spread, K = {self.samples}")
        for column in ("holds", "factor", "least", "largest"):
            table.add_column(column, justify="left" if column == "holds" else "right")
        shown = {"number": "each number", "frame": f"each {frame}", "future": "the whole future"}
        for region, factor in self.factors.items():
            table.add_row(shown[region], *(f"{value:.2f}" for value in (factor.mean(), factor.min(), factor.max())))
        return table

    def plot(self) -> Figure:
        """Factors over the horizon; of single numbers their mean over coordinates, and where they all are."""
        figure = canvas(4.5, 3)
        axes = figure.subplots()
        numbers = self.factors["number"]
        frames = np.arange(1, len(numbers) + 1)
        axes.fill_between(frames, numbers.min(1), numbers.max(1), color="0.88", linewidth=0)
        for place, (region, factor) in enumerate(self.factors.items()):
            axes.plot(frames, np.broadcast_to(factor, numbers.shape).mean(1), color=f"C{place}", label=region)
        axes.set_ylim(bottom=0)
        axes.set_xlabel(f"{called(self.data)[1]} of the future", fontsize=8)
        axes.set_ylabel("half width over spread", fontsize=8)
        axes.legend(fontsize=8)
        return figure

    @override
    def check(self) -> None:
        _checked(self.level)
        shape = self.factors["number"].shape
        given = [self.factors[region] for region in REGIONS] + ([] if self.spread is None else [self.spread])
        if [each.shape for each in given] != [shape, (shape[0], 1), (1, 1), shape][: len(given)]:
            raise ValueError("expected factors (H, D), (H, 1) and (1, 1), and a spread (H, D)")
        if not all(np.isfinite(each).all() and (each >= 0).all() for each in given):
            raise ValueError("factors and spreads are numbers from 0 on")

    def _spread(self, forecasts: Tensor) -> Tensor:
        """Of forecasts (B, K, H, D): (B, H, D), or the one (H, D) of all."""
        return _deviations(forecasts) if self.spread is None else torch.as_tensor(self.spread).to(forecasts)

    def _factor(self, region: str, like: Tensor) -> Tensor:
        return torch.as_tensor(self.factors[region]).to(like)


def conformal(
    model: nn.Module | str,
    windows: HeldOutWindows,
    level: float = 0.9,
    *,
    groups: Sequence[str] | None = None,
    residuals: HeldOutWindows | None = None,
    samples: int = 50,
    training_windows: HeldOutWindows | None = None,
    seed: int = 0,
    batch_size: int = 32,
    options: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> Tubes:
    """Tubes around forecasts, calibrated on windows that the model has not been fitted to.

    They hold the future of new windows as often as the level says if the clips of these are exchangeable with those of
    calibration: of the same people and styles. Of one person's or style's clips they say nothing of another's. Later
    steps of the same sequences are not exchangeable with earlier ones, so that windows divided by time are refused.

    Args:
        model: a model (`Forecasting`), or the name of a reference row, see `References`.
        windows: of calibration.
        level: share of windows to be held, between 0 and 1.
        groups: of each window, the name of what is exchangeable, where it is more than a clip, such as its style. A
            level of 0.9 needs 9 of them.
        residuals: windows, such as those of training, on which errors of the mean forecast are measured, whose root
            mean square at each frame and coordinate is the spread in place of the forecasts' standard deviation: for
            forecasts that are points, or spread in the wrong places.
        samples: K, forecasts of a window, which are drawn.
        training_windows: what "climatology" and "nearest neighbours" know.
        seed: of the draws.
        batch_size: windows forecast at once.
        options: further arguments of the model's `forecast`.
        progress: whether to show a progress bar.

    Raises:
        ValueError: a level that is none, too few clips for it, forecasts without a spread, windows that cannot be
            forecast or are one part of sequences divided by time, or as many groups as windows are not given.

    Example:
        >>> model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2})
        >>> windows = dvae.ArrayWindows(torch.randn(40, 8, 2), observed=4)
        >>> tubes = dvae.conformal(model, windows, level=0.9, samples=20, progress=False)
        >>> {region: factor.shape for region, factor in tubes.factors.items()}
        {'number': (4, 2), 'frame': (4, 1), 'future': (1, 1)}
    """
    held = hold(windows)
    windows, (clip, _) = held.windows, called(held.windows.description)
    parts = {split for split, _, _ in held.keys} - {"all", "last"}
    if parts and getattr(windows.protocol, "split", None) == "time":
        raise ValueError(
            f"these windows are the {' and '.join(sorted(parts))} part of {clip}s divided by time (split='time'); "
            f"bands hold the future of other {clip}s as often as they say, and less often that of later steps of the "
            f"same ones; divide whole {clip}s by split='sequence' or 'group', or calibrate on all windows of other "
            f"{clip}s, data.windows('all')"
        )
    keys = clusters(windows) if groups is None else [("", group, 0) for group in groups]
    if len(keys) != len(held.keys):
        raise ValueError(f"{len(held.keys)} windows need as many groups, not {len(keys)}")
    places, needed = clip_places(keys), _fewest(_checked(level))
    clips = int(places.max()) + 1
    if clips < needed:
        what, most = f"{clip}s" if groups is None else "groups", math.floor(100 * clips / (clips + 1))
        raise ValueError(
            f"tubes of {100 * level:g} % need {needed} {what} of calibration windows, given are {clips}: of fewer, the "
            f"next one lies beyond all of them too often; take more, or {most} % at most"
        )
    with progress_bar(progress) as bar:

        def futures(of: Held, label: str) -> Iterator[tuple[Tensor, Tensor]]:
            """Forecasts (B, K, H, D) and true futures, batch by batch."""
            if isinstance(model, str):
                name = model
                drawn, forecaster = References(of, samples, seed, training_windows)[model]
            else:
                name, drawn = type(model).__name__, samples
                forecaster = forecaster_of(model, of, samples, {"draw_emission": True, **(options or {})})
            with nullcontext() if isinstance(model, str) else reproducibly(model, seed):
                for start in bar.track(range(0, len(of.keys), batch_size), description=label):
                    part = slice(start, start + batch_size)
                    yield forecasts_of(name, forecaster, drawn, of, part), of.futures[part]

        spread = None
        if residuals is not None:
            errors = [truth - forecasts.mean(1) for forecasts, truth in futures(hold(residuals), "residuals")]
            spread = mean_of_known(torch.cat(errors).square(), 0).sqrt()
        found, count = [], 0
        for forecasts, truth in futures(held, "calibration"):
            count = forecasts.shape[1]
            found.append(standardised(forecasts, truth, _deviations(forecasts) if spread is None else spread))
    far = torch.cat(found)
    factors = {region: quantile(worst(far, region), places, level) for region in REGIONS}
    if not all(factor.isfinite().all() for factor in factors.values()):
        raise ValueError(
            "these tubes would be of no end: forecasts have no spread where they miss the future, as points have none "
            f"(residuals= takes windows on which one is measured), or too few {clip}s were observed at some place"
        )
    return Tubes(
        level=level,
        factors={region: factor.numpy() for region, factor in factors.items()},
        spread=None if spread is None else spread.numpy(),
        samples=count,
        seed=seed,
        options=dict(options or {}),
        clips=clips,
        data=held.description(),
    )


def clips_alike(values: Tensor, clips: Tensor) -> list[float]:
    """A value for each clip, whose mean weighted by windows is the mean over clips, and errors are of that.

    Args:
        values: `(N,)`, the score of every window.
        clips: `(N,)`, the clip of every window, from 0 to C - 1.
    """
    means, windows = np.array(clip_means(values, clips)), np.bincount(clips.numpy())
    found: list[float] = (means.mean() + (means - means.mean()) * windows.mean() / windows).tolist()
    return found


def _deviations(forecasts: Tensor) -> Tensor:
    """Standard deviations (B, H, D) of forecasts (B, K, H, D); of a single one 0."""
    return forecasts.std(1, correction=min(1, forecasts.shape[1] - 1))


def standardised(forecasts: Tensor, truth: Tensor, spread: Tensor) -> Tensor:
    """How far a future (B, H, D) is from the mean of forecasts (B, K, H, D), in units of their spread.

    NaN where it was not observed, and infinite where it is missed by forecasts without a spread.
    """
    return _over((truth - forecasts.mean(1)).abs(), spread)


def _own_distances(forecasts: Tensor, spread: Tensor | None) -> Tensor:
    """How far each of forecasts (B, K, H, D) is from the mean of the others, in units of their spread."""
    count, apart = forecasts.shape[1], forecasts - forecasts.mean(1, keepdim=True)
    if spread is None:
        squares = apart.square()
        left = squares.sum(1, keepdim=True) - count / (count - 1) * squares  # of the others, about their mean
        spread = (left.clamp(min=0) / (count - 2)).sqrt()
    return _over(count / (count - 1) * apart.abs(), spread)


def _over(distance: Tensor, spread: Tensor) -> Tensor:
    return torch.where(distance == 0, 0.0, distance / spread)


def worst(distances: Tensor, region: str) -> Tensor:
    """The largest of known distances (..., H, D) in each region; NaN where none is known."""
    if not REGIONS[region]:
        return distances
    largest = distances.nan_to_num(nan=-1.0, posinf=math.inf).amax(REGIONS[region], keepdim=True)
    return largest.masked_fill(largest < 0, torch.nan)


def _smallest(distances: Tensor, level: float) -> Tensor:
    """The ⌈(K + 1) level⌉-th smallest of K distances (B, K, ...), which are exchangeable with another: (B, ...)."""
    return distances.kthvalue(math.ceil(round((distances.shape[1] + 1) * level, 9)), 1).values


def quantile(distances: Tensor, places: Tensor, level: float) -> Tensor:
    """Of known distances (N, ...) with the weights of hierarchical conformal prediction: (...), where it is finite.

    Args:
        distances: of windows, NaN where nothing is known.
        places: (N,), the clip of every window.
        level: of the quantile.
    """
    known = (~distances.isnan()).flatten(1).double()
    windows = known.new_zeros(int(places.max()) + 1, known.shape[1]).index_add_(0, places, known)  # by clip
    clips = (windows > 0).sum(0)
    ordered, order = distances.flatten(1).nan_to_num(nan=math.inf, posinf=math.inf).sort(0)
    weights = (known / windows[places].clamp(min=1)).gather(0, order)
    reached = weights.cumsum(0) >= level * (clips + 1) - 1e-9
    found = ordered.gather(0, reached.byte().argmax(0, keepdim=True))[0]
    return found.masked_fill(~reached.any(0), math.inf).reshape(distances.shape[1:])


def _fewest(level: float) -> int:
    """Exchangeable numbers of which some quantile is at this level of another one."""
    return math.ceil(round(level / (1 - level), 9))


def _checked(level: float) -> float:
    if not 0 < level < 1:
        raise ValueError(f"the level of a tube is between 0 and 1, got {level}")
    return level
