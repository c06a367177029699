"""Evaluation on held-out windows: what a model forecasts, and how well it explains.

Two programs are scored and never mixed. *Free-running*: the model sees the observed frames, forecasts K
futures on its own, and the futures are compared with the true one (`dvae.inference.metrics`).
*Teacher-forced*: the model reads every frame of the window, and its bound on log p(x_{1:T}) is reported in
nats per frame. The errors of the motion papers are energies, not likelihoods; the bound is one.

Every evaluation carries two reference rows that any method should beat: zero velocity (the last pose
repeated) and nearest neighbours (the futures of the K training windows with the closest last poses). With
classifiers of actions there is a third, real motion: the true futures, which no method should be expected to beat.
All rows score the same windows, and windows of one clip overlap, so standard errors are clustered by clip and
`Evaluation.difference` is paired.

Where windows move through space (a protocol with root="relative"), these scores are of poses relative to their own
root, as in TrajeVAE's evaluation; "global ADE" and "global FDE" are of all joints where they are in the world. Where
the same joints' paths are given in all windows, "path error" is the mean distance of these joints from their paths,
over all K futures.

A classifier adds two scores under its name (Bie et al. 2022, arXiv:2204.01565). *ACC* is the share of the K futures
that it gives the window's true class. *FID* is the Fréchet distance between its features of the true futures and of
all K generated ones of all windows together. It is a number of the whole set, so that its standard error is
a jackknife over clips: each clip stands with its pseudo-value d + (1/w - 1) (d - d'), d' the distance without the clip
and w the clip's share of the windows (Busing, Meijer and van der Leeden 1999). Of a mean over windows, pseudo-values
are the means of the clips, and from there on both kinds of scores are treated alike.
"""

import dataclasses
import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import matplotlib.figure
import numpy as np
import torch
from rich.text import Text
from scipy import special
from torch import Tensor, nn

from ..motion.energies import pose_prior_energy
from ..options import nearest
from ..turns import alone
from . import metrics
from .batches import each
from .bounds import SequenceELBO, importance_bound
from .result import Result, Table, progress_bar

__all__ = [
    "METRICS",
    "ArrayWindows",
    "Evaluation",
    "Metric",
    "Row",
    "Score",
    "evaluate",
    "multimodal_truths",
    "nearest_neighbours",
    "zero_velocity",
]

Batch = dict[str, Tensor]
Forecaster = Callable[[slice], Tensor]  # which windows -> (K, B, H, D)


@dataclass(frozen=True)
class Metric:
    """How a score is to be read: unit, program, and the direction that is better ("" for neither)."""

    unit: str
    program: str
    better: str = "lower"


ARROWS = {"lower": " ↓", "higher": " ↑", "": ""}
"""By the direction that is better."""

METRICS: dict[str, Metric] = {
    "APD": Metric("m", "free-running", "higher"),
    **{
        name: Metric("m", "free-running")
        for name in ("ADE", "FDE", "MMADE", "MMFDE", "ADEm", "FDEm", "MMADEm", "MMFDEm", "energy score")
    },
    "variogram score": Metric("m", "free-running"),
    **{name: Metric("m", "free-running") for name in ("global ADE", "global FDE", "path error")},
    "bone-length error": Metric("relative", "free-running"),
    "pose NLL": Metric("nats", "free-running"),
    "ACC": Metric("share", "free-running", "higher"),
    "FID": Metric("", "free-running"),
    "ELBO": Metric("nats/frame", "teacher-forced", "higher"),
    "importance bound": Metric("nats/frame", "teacher-forced", "higher"),
    "k-hat": Metric("", "teacher-forced"),
    "KL": Metric("nats/frame", "teacher-forced", ""),
}
"""By name; ACC and FID stand before the name of a classifier, KL before that of a latent."""

_PAIRED = {
    "ADE": metrics.average_displacement_error,
    "FDE": metrics.final_displacement_error,
    "ADEm": metrics.median_average_displacement_error,
    "FDEm": metrics.median_final_displacement_error,
    "energy score": metrics.energy_score,
    "variogram score": metrics.variogram_score,
}
_MULTIMODAL = {
    "MMADE": metrics.multimodal_average_displacement_error,
    "MMFDE": metrics.multimodal_final_displacement_error,
    "MMADEm": metrics.median_multimodal_average_displacement_error,
    "MMFDEm": metrics.median_multimodal_final_displacement_error,
}


@dataclass(frozen=True)
class Score:
    """Mean over windows, or FID, and its standard error, clustered by clip (NaN where there is a single clip).

    Args:
        mean: the mean.
        standard_error: its standard error.
        freedom: degrees of freedom of that, one less than there are clips.
    """

    mean: float
    standard_error: float
    freedom: float = field(default=math.nan, compare=False)

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Where the mean lies at this level, by Student's t; NaN where the error is unknown."""
        return student_interval(self.mean, self.standard_error, self.freedom, level)

    def __str__(self) -> str:
        # Three decimals as in the papers, a fourth where the error needs it.
        if math.isnan(self.mean):
            return "–"
        if not self.standard_error > 0:
            return f"{self.mean:.3f}"
        decimals = 4 if self.standard_error < 0.001 else 3
        return f"{self.mean:.{decimals}f} ± {self.standard_error:.{decimals}f}"


@dataclass(frozen=True)
class Row:
    """One method: its number of samples, what it is, and each metric's mean over each clip's windows.

    Of FID it is each clip's pseudo-value (see the file), of ACC NaN where the classifier does not know a clip's class.
    """

    samples: int
    clip_means: dict[str, tuple[float, ...]]
    equations: dict[str, str] = field(default_factory=dict)
    config: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, repr=False)
class Evaluation(Result):
    """Scores of several methods on the same windows, with all that is needed to say what was measured.

    Indexing gives the scores of a method: `evaluation["srnn"]["ADE"].mean`.

    Attributes:
        rows: `{method: Row}`.
        clips: `{"split/clip": number of its windows}`, in the order of `Row.clip_means`.
        data: fingerprint, windows, frames and coordinates of a window, joints where there is a skeleton, those whose
            paths were given, and how poses were exchanged.
        protocol: the fields of the windows' protocol.
        multimodal: the ground truth of the multimodal errors: threshold of last poses, whether a window's own future
            is among its truths, and how many windows have no other (the public code of GSPS scores none of these).
        samples: K, the number of forecasts asked of every method.
        emission: "mean" or "drawn": whether forecasts were means of p(x_t | ...) or draws from it.
        bound_particles: particles of the importance bound, 0 where it was not computed.
        seed: the seed of every method's draws.
        pose_prior: SHA-256 of the weights of the pose prior that scored the poses, if one did.
        classifiers: by name, those that scored actions: label, classes, SHA-256 of the weights, and how many windows
            are of no class that it knows; ACC is over the others.
        options: further arguments of the models' `forecast`.
    """

    rows: dict[str, Row]
    clips: dict[str, int]
    data: dict[str, Any]
    protocol: dict[str, Any]
    multimodal: dict[str, Any]
    samples: int
    emission: str
    bound_particles: int
    seed: int
    pose_prior: str | None = None
    classifiers: dict[str, dict[str, Any]] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)

    def __getitem__(self, method: str) -> dict[str, Score]:
        return {name: self._score(name, np.array(means)) for name, means in self._row(method).clip_means.items()}

    def difference(self, first: str, second: str, metric: str) -> Score:
        """Paired difference of two methods in a metric, first minus second, with its standard error.

        Raises:
            KeyError: a method that was not evaluated, or a metric that one of the two lacks.
        """
        means = []
        for method in (first, second):
            row = self._row(method)
            if metric not in row.clip_means:
                meant = nearest(metric, row.clip_means)
                raise KeyError(f"{method!r} has no score {metric!r}{meant}; it has {', '.join(row.clip_means)}")
            means.append(np.array(row.clip_means[metric]))
        return self._score(metric, means[0] - means[1])

    def table(self) -> Table:
        """Metrics down, methods across: mean ± standard error, the two programs apart."""
        table = Table(title=self._title(), caption=self._caption())
        table.add_column("", no_wrap=True)  # on a narrow terminal the numbers wrap, never the names
        for method, row in self.rows.items():
            table.add_column(f"{method}\nK = {row.samples}", justify="right")
        scores = {method: self[method] for method in self.rows}
        for program in ("free-running", "teacher-forced"):
            names = [name for name in self.metrics if _reading(name).program == program]
            if names:
                table.add_section()
                table.add_row(Text(program, "bold"))
            for name in names:
                reading = _reading(name)
                unit = f" ({reading.unit})" if reading.unit else ""
                values = (str(row[name]) if name in row else "–" for row in scores.values())
                table.add_row(Text.assemble(name + ARROWS[reading.better], (unit, "dim")), *values)
        return table

    @property
    def metrics(self) -> list[str]:
        """Names of all metrics that at least one method has, in the order of the table."""
        found = {name for row in self.rows.values() for name in row.clip_means}
        order = list(METRICS)
        return sorted(found, key=lambda name: (order.index(_kind(name)), name))

    def plot(self, metrics: Sequence[str] | None = None) -> matplotlib.figure.Figure:
        """One panel per metric, with an arrow for what is better; a dot per method with a bar of one standard error."""
        names = self.metrics if metrics is None else list(metrics)
        columns = min(4, len(names))
        rows = math.ceil(len(names) / columns)
        height = 0.7 + 0.22 * len(self.rows)
        figure = matplotlib.figure.Figure(figsize=(2 + 2.2 * columns, height * rows), layout="constrained")
        panels = list(figure.subplots(rows, columns, sharey=True, squeeze=False).flat)
        scores = {method: self[method] for method in self.rows}
        for panel, name in zip(panels, names, strict=False):
            for place, row in enumerate(scores.values()):
                if name in row:
                    error = np.nan_to_num(row[name].standard_error)
                    panel.errorbar(row[name].mean, place, xerr=error, fmt="o", markersize=4, color=f"C{place}")
            reading = _reading(name)
            unit = f" ({reading.unit})" if reading.unit else ""
            panel.set_title(name + ARROWS[reading.better] + unit, fontsize=9, parse_math=False)
            panel.set_yticks(range(len(scores)), list(scores), parse_math=False)
            panel.set_ylim(len(scores) - 0.5, -0.5)
            panel.tick_params(labelsize=8)
            panel.locator_params(axis="x", nbins=4)  # more would overlap where values agree in many digits
            panel.grid(axis="x", alpha=0.3)
        for panel in panels[len(names) :]:
            panel.set_axis_off()
        return figure

    def to_json(self) -> str:
        """Everything, with means and standard errors written out; numbers that are not finite become null."""
        document = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        document["rows"] = {method: self._document(method) for method in self.rows}
        return json.dumps(document, indent=1, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> "Evaluation":
        """The evaluation that `to_json` wrote.

        Raises:
            ValueError: text that is not such a document.
        """
        try:
            document = json.loads(text)
            rows = {method: _row(row) for method, row in document.pop("rows").items()}
            return cls(rows=rows, **document)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"this is not an evaluation written by Evaluation.to_json: {error!r}") from error

    @classmethod
    def load(cls, path: str | Path) -> "Evaluation":
        """Read the file that `save` wrote; errors as in `from_json`."""
        return cls.from_json(cls.read(path))

    def _row(self, method: str) -> Row:
        if method not in self.rows:
            raise KeyError(
                f"no method {method!r} in this evaluation{nearest(method, self.rows)}; it has {', '.join(self.rows)}"
            )
        return self.rows[method]

    def _score(self, metric: str, clip_means: np.ndarray) -> Score:
        scored = ~np.isnan(clip_means) if _kind(metric) == "ACC" else slice(None)
        mean, deviations = linearised(clip_means[scored], np.array(list(self.clips.values()))[scored])
        return Score(float(mean), math.sqrt(clustered_variance(deviations)), len(deviations) - 1)

    def _document(self, method: str) -> dict[str, Any]:
        row = dataclasses.asdict(self.rows[method])
        clip_means = row.pop("clip_means")
        row["scores"] = {
            name: {
                **dataclasses.asdict(_reading(name)),
                **dataclasses.asdict(score),
                "clip_means": clip_means[name],
            }
            for name, score in self[method].items()
        }
        return plain(row)

    def _caption(self) -> str:
        closer = f"all windows whose last poses are closer than {self.multimodal['threshold']:g} m, itself included"
        alone = f"{self.multimodal['alone']} of {self.data['windows']} have no other"
        freedom = f"{len(self.clips) - 1} degrees of freedom"
        lines = [
            f"mean ± standard error over windows, clustered by clip ({freedom})",
            f"MM: over the futures of {closer}; {alone}",
        ]
        for name, used in self.classifiers.items():
            unknown = f"; {used['unknown']} of {self.data['windows']} windows are of no class it knows"
            lines.append(f"ACC, FID {name}: classifier {used['weights'][:12]}" + (unknown if used["unknown"] else ""))
        return "\n".join(lines)

    def _title(self) -> str:
        name = str(self.protocol.get("name", ""))
        parts = [name, f"{self.data['windows']} windows of {len(self.clips)} clips"]
        if (given := self.data.get("given")) is not None:
            parts.append(f"given {', '.join(given) or 'no paths'}")
        if exchanged := self.data.get("exchanged"):
            parts.append(f"first poses of {exchanged['partners']} other windows")
        parts += [f"{name} {value}" for name, value in self.options.items()]
        parts += [f"{self.emission} emission", f"seed {self.seed}", f"data {self.data['fingerprint'][:12]}"]
        return " · ".join(part for part in parts if part)


class HeldOutWindows(Protocol):
    """What an evaluation needs of its windows; those of `dvae.motion` and `ArrayWindows` have it."""

    @property
    def protocol(self) -> Any:
        """A dataclass with `observed` (frames) and `multimodal_threshold` (distance of last poses)."""

    @property
    def keys(self) -> Sequence[tuple[str, str, int]]:
        """(split, clip, first frame) of every window."""

    @property
    def fingerprint(self) -> str:
        """Hash of the windows and their data."""

    def all(self) -> Batch:
        """All windows: x `(N, T, D)` and context variables."""


@dataclass(frozen=True)
class ArrayProtocol:
    """How plain arrays are split into observed and predicted frames."""

    observed: int
    multimodal_threshold: float


@dataclass(frozen=True, eq=False)
class ArrayWindows:
    """Plain arrays as windows to evaluate on.

    Args:
        x: `(N, T, D)`, tensor or numpy array.
        observed: frames the model sees; the other T - observed are predicted.
        multimodal_threshold: distance below which two last observed poses are alike, in the unit of x.
        clips: name of the clip each window was cut from; without it the windows count as independent.

    Raises:
        ValueError: x that is not `(N, T, D)`, or as many clip names as windows are not given.
    """

    x: Tensor | np.ndarray
    observed: int
    multimodal_threshold: float = 0.5
    clips: Sequence[str] | None = None

    def __post_init__(self) -> None:
        if self.x.ndim != 3:
            raise ValueError(f"windows must be (N, T, D), but x has shape {tuple(self.x.shape)}")
        if self.clips is not None and len(self.clips) != len(self.x):
            raise ValueError(f"{len(self.x)} windows need as many clip names, not {len(self.clips)}")

    @property
    def protocol(self) -> ArrayProtocol:
        """Observed frames and multimodal threshold."""
        return ArrayProtocol(self.observed, self.multimodal_threshold)

    @property
    def keys(self) -> list[tuple[str, str, int]]:
        """(split, clip, first frame) of every window; the first frame is unknown here and 0."""
        clips = self.clips if self.clips is not None else range(len(self.x))
        return [("array", str(clip), 0) for clip in clips]

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the values, their shape and type."""
        values = np.ascontiguousarray(np.asarray(self.x))
        return hashlib.sha256(f"{values.shape} {values.dtype}".encode() + values.tobytes()).hexdigest()

    def all(self) -> Batch:
        """All windows, x `(N, T, D)`."""
        return {"x": torch.as_tensor(self.x)}


def linearised(clip_means: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The weighted mean of clip means (..., C), a ratio of sums over clips, and what each clip adds to its error."""
    shares = weights / weights.sum()
    mean = (shares * clip_means).sum(-1)
    return mean, shares * (clip_means - mean[..., None])


def clustered_variance(deviations: np.ndarray) -> float:
    """Variance of a mean over windows from what each clip adds to its error, (C,); NaN where there is one clip."""
    clips = len(deviations)
    return clips / (clips - 1) * float((deviations**2).sum()) if clips > 1 else math.nan


def student_interval(mean: float, error: float, freedom: float, level: float = 0.95) -> tuple[float, float]:
    """Two-sided interval of Student's t for a mean with a standard error of so many degrees of freedom.

    Raises:
        ValueError: a level that is not between 0 and 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval is between 0 and 1, got {level}")
    reach = error * float(special.stdtrit(freedom, (1 + level) / 2)) if error else 0.0
    return mean - reach, mean + reach


_FOUND: dict[tuple[str, int, float, bool], list[Tensor]] = {}
_KEPT = 8  # sets of windows whose multimodal truths are remembered


def multimodal_truths(windows: HeldOutWindows, threshold: float | None = None, itself: bool = True) -> list[Tensor]:
    """Multimodal ground truth: for every window, those that were in almost the same pose when their future began.

    Two windows belong together when their last observed poses are at a Euclidean distance *below* the threshold, over
    all coordinates. By default as in the evaluation of DLow (Yuan and Kitani 2020): a window belongs to itself, and one
    that nobody joins keeps its single truth and is scored like the others, as every evaluation here does. (GSPS leaves
    such windows out of every metric, so that its published numbers are on a subset.) The truths of the last few sets
    are remembered, by their fingerprint.

    Args:
        windows: N windows; the protocol says what is observed.
        threshold: largest distance (exclusive), in the unit of the data; by default the protocol's, 0.5 m in the
            papers.
        itself: whether a window is among its own truths. Without, it may have none, and its multimodal errors are
            undefined.

    Returns:
        N index tensors `(M_n,)`, ascending; `futures[truths[n]]` are the truths `(M_n, T, D)` of window n.

    Raises:
        ValueError: a threshold that is not positive.
    """
    observed = windows.protocol.observed
    threshold = windows.protocol.multimodal_threshold if threshold is None else threshold
    if not threshold > 0:
        raise ValueError(f"the multimodal threshold is a distance and must be positive, but is {threshold}")
    key = windows.fingerprint, observed, threshold, itself
    if key not in _FOUND:
        poses = windows.all()["x"][:, observed - 1].double()
        found: list[Tensor] = []
        for rows in torch.arange(len(poses)).split(512):
            # Matrix-product distances would cancel right at the threshold, where the comparison is strict.
            close = torch.cdist(poses[rows], poses, compute_mode="donot_use_mm_for_euclid_dist") < threshold
            close[torch.arange(len(rows)), rows] = itself
            found += [row.nonzero()[:, 0] for row in close]
        while len(_FOUND) >= _KEPT:
            del _FOUND[next(iter(_FOUND))]  # the oldest
        _FOUND[key] = found
    return list(_FOUND[key])


def zero_velocity(observed: Tensor, horizon: int) -> Tensor:
    """The last pose repeated: the forecast that any method should beat.

    Args:
        observed: `(B, O, D)`.
        horizon: frames H to predict.

    Returns:
        One forecast, `(1, B, H, D)`, laid out like those of a model.
    """
    return observed[None, :, -1:].expand(-1, -1, horizon, -1)


def nearest_neighbours(observed: Tensor, training: Tensor, samples: int = 50) -> Tensor:
    """The futures of the training windows whose last observed poses are closest: memory without a model.

    Args:
        observed: `(B, O, D)`.
        training: `(N, O + H, D)`, training windows observed for as many frames.
        samples: K, the number of neighbours.

    Returns:
        `(K, B, H, D)`, the closest neighbour first.

    Raises:
        ValueError: training windows of another size or without a future, or fewer of them than K.
    """
    frames, size = observed.shape[1:]
    if training.ndim != 3 or training.shape[2] != size or training.shape[1] <= frames:
        raise ValueError(
            f"training windows must be (N, T, {size}) with T above the {frames} observed frames, but have "
            f"shape {tuple(training.shape)}"
        )
    if len(training) < samples:
        raise ValueError(f"{samples} neighbours were asked of {len(training)} training windows; use fewer")
    # Matrix-product distances would lose what tells poses apart that lie far from the origin.
    exact = "donot_use_mm_for_euclid_dist"
    distances = torch.cdist(observed[:, -1], training[:, frames - 1], compute_mode=exact)
    return training[distances.topk(samples, largest=False).indices.T, frames:]


@alone
def evaluate(
    model: nn.Module | Mapping[str, nn.Module],
    windows: HeldOutWindows,
    *,
    samples: int = 50,
    seed: int = 0,
    batch_size: int = 32,
    draw_emission: bool = False,
    bound_particles: int = 0,
    references: bool = True,
    training_windows: HeldOutWindows | None = None,
    pose_prior: Any = None,
    classifiers: Mapping[str, Any] | None = None,
    configs: Mapping[str, Mapping[str, Any]] | None = None,
    options: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> Evaluation:
    """Score one model or several, and the reference rows, on the same windows.

    Every method draws from the same seed, so that its scores do not depend on which others are evaluated;
    they do depend on `batch_size`, as draws come batch by batch. The models' modes and torch's random state
    are restored.

    Args:
        model: a model, or `{name: model}`.
        windows: `dvae.motion` windows or `ArrayWindows`.
        samples: K, the forecasts per window.
        seed: seed of every method's draws.
        batch_size: windows forecast at once.
        draw_emission: forecast draws of x instead of its means. The motion papers score means; the energy and
            variogram scores judge the model's predictive distribution only when x is drawn.
        bound_particles: particles of the importance-weighted bound and its k-hat; 0 leaves both out.
        references: whether to add the reference rows.
        training_windows: where the nearest neighbours are taken from; without it that row is left out.
        pose_prior: a fitted pose prior, to score single poses of the forecasts: minus the mean log density of the
            flow's z, without the log-determinant (the NLL of GSPS, arXiv:2108.08422).
        classifiers: `{name: fitted action classifier}`, to score futures by what they show: "ACC name" and "FID name",
            and a reference row of real motion. Fitted under the same protocol, they saw no test clip.
        configs: `{name: configuration}`, stored with the rows; anything that JSON can hold.
        options: further arguments of the models' `forecast`, such as {"temperature": 0} for motion at the mean of
            TrajeVAE's prior.
        progress: whether to show a progress bar.

    Returns:
        The evaluation; print it, or take its `table`, `plot` and `to_json`.

    Raises:
        ValueError: windows that are ragged, masked or leave nothing to predict; a forecast of the wrong
            shape; a model with the name of a reference row; fewer than one sample; windows whose skeleton or
            labels are not those of a classifier, or too few for normal fits to their features.
        FloatingPointError: a forecast or bound that is not finite, naming method and window.
    """
    models: dict[str, Any] = dict(model) if isinstance(model, Mapping) else {"model": model}
    if samples < 1:
        raise ValueError(f"every method needs at least 1 forecast per window, not samples={samples}")
    if batch_size < 1 or bound_particles < 0:
        raise ValueError(
            f"batch_size is at least 1 and bound_particles at least 0, not {batch_size} and {bound_particles}"
        )
    held = dataclasses.replace(hold(windows), pose_prior=pose_prior)
    held = dataclasses.replace(
        held, judges={name: _judge(name, each, held, seed, batch_size) for name, each in (classifiers or {}).items()}
    )
    baselines = _references(held, samples, training_windows) if references else {}
    if clash := models.keys() & baselines.keys():
        raise ValueError(f"a model must not have the name of a reference row: {', '.join(sorted(clash))}")

    rows: dict[str, Row] = {}
    with progress_bar(progress) as bar, ExitStack() as stack:
        for judge in held.judges.values():
            stack.enter_context(evaluating(judge.model, seed))

        def parts(label: str) -> Iterator[slice]:
            for start in bar.track(range(0, len(held.keys), batch_size), description=label):
                yield slice(start, start + batch_size)

        for name, (count, forecaster) in baselines.items():
            rows[name] = Row(count, _free_running(name, forecaster, count, held, parts(name)))
        for name, each in models.items():
            with evaluating(each, seed):
                forecaster = _forecaster(each, held, samples, {"draw_emission": draw_emission, **(options or {})})
                means = _free_running(name, forecaster, samples, held, parts(f"{name}, forecasts"))
            if getattr(each, "likelihood", True):
                with evaluating(each, seed):
                    scores = _teacher_forced(name, each, bound_particles, held, parts(f"{name}, bound"))
                    means |= held.clip_means(scores)
            equations = {"generative": each.generative.text, "inference": each.inference.text}
            rows[name] = Row(samples, means, equations, dict((configs or {}).get(name, {})))

    return Evaluation(
        rows=rows,
        clips=held.clips,
        data=held.description(),
        protocol=plain(dataclasses.asdict(windows.protocol)),
        multimodal={
            "threshold": windows.protocol.multimodal_threshold,
            "itself": True,
            "alone": sum(len(truths) == 1 for truths in held.truths),
        },
        samples=samples,
        emission="drawn" if draw_emission else "mean",
        options=dict(options or {}),
        bound_particles=bound_particles,
        seed=seed,
        pose_prior=None if pose_prior is None else _hash(pose_prior),
        classifiers={name: judge.record() for name, judge in held.judges.items()},
    )


@dataclass(frozen=True)
class _Held:
    """The windows of one evaluation, prepared once for all its rows."""

    windows: HeldOutWindows
    batch: Batch
    observed: int
    keys: list[tuple[str, str, int]]
    truths: list[Tensor]
    pose_prior: Any = None
    judges: dict[str, "_Judge"] = field(default_factory=dict)

    @property
    def x(self) -> Tensor:
        return self.batch["x"]

    @property
    def futures(self) -> Tensor:
        return self.x[:, self.observed :]

    def body(self, x: Tensor) -> Tensor:
        """Frames (..., T, D) relative to their own root, which is left out; as they are, if the protocol did that."""
        if getattr(self.windows.protocol, "root", "drop") != "relative":
            return x
        joints, root = x.unflatten(-1, (-1, 3)), self.windows.skeleton.root  # type: ignore[attr-defined]
        joints = joints - joints[..., root : root + 1, :]
        return torch.cat([joints[..., :root, :], joints[..., root + 1 :, :]], -2).flatten(-2)

    @cached_property
    def bodies(self) -> Tensor:
        """The true futures as `body` has them."""
        return self.body(self.futures)

    @property
    def given(self) -> list[int]:
        """Places of the joints whose paths are given in all windows."""
        names = getattr(self.windows, "given_joints", None) or ()
        return [self.windows.joints.index(name) for name in names]  # type: ignore[attr-defined]

    def past(self, part: slice) -> Batch:
        return {**{name: value[part] for name, value in self.batch.items()}, "x": self.x[part, : self.observed]}

    @property
    def clips(self) -> dict[str, int]:
        return dict(Counter(f"{split}/{clip}" for split, clip, _ in self.keys))

    def description(self) -> dict[str, Any]:
        count, frames, coordinates = self.x.shape
        skeleton = getattr(self.windows, "skeleton", None)
        joints = {"joints": list(skeleton.names)} if skeleton is not None else {}
        if (given := getattr(self.windows, "given_joints", None)) is not None:
            joints["given"] = list(given)
        if exchanged := getattr(self.windows, "exchanged", None):
            joints["exchanged"] = exchanged
        found = {"fingerprint": self.windows.fingerprint, "windows": count, "frames": frames}
        return {**found, "coordinates": coordinates, **joints}

    @property
    def places(self) -> list[int]:
        """The clip of every window, as its place in `clips`."""
        places = {clip: place for place, clip in enumerate(self.clips)}
        return [places[f"{split}/{clip}"] for split, clip, _ in self.keys]

    def clip_means(self, scores: dict[str, Tensor]) -> dict[str, tuple[float, ...]]:
        """Means over the windows of each clip, from scores `(N,)`."""
        clip = self.places
        counts = np.bincount(clip)
        return {
            name: tuple((np.bincount(clip, weights=values.double().numpy()) / counts).tolist())
            for name, values in scores.items()
        }


@dataclass(frozen=True)
class _Judge:
    """A classifier, the class of each window (N,), -1 where it knows none, and its features (N, F) of their futures."""

    model: Any
    classes: Tensor
    real: Tensor

    def record(self) -> dict[str, Any]:
        unknown = int((self.classes < 0).sum())
        described = {"label": self.model.label, "classes": list(self.model.classes)}
        return {**described, "weights": _hash(self.model), "unknown": unknown}


def _judge(name: str, classifier: Any, held: _Held, seed: int, batch_size: int) -> _Judge:
    skeleton, clips = getattr(held.windows, "skeleton", None), held.clips
    if skeleton != classifier.skeleton or held.x.shape[2] != classifier.size:
        given = "no skeleton" if skeleton is None else f"the skeleton {skeleton.name!r}"
        raise ValueError(
            f"the classifier {name} was fitted to the skeleton {classifier.skeleton.name!r} and frames of "
            f"{classifier.size} numbers; these windows have {given} and {held.x.shape[2]}"
        )
    fitted, asked = ((p.predicted, p.fps) for p in (classifier.protocol, held.windows.protocol))  # type: ignore[attr-defined]
    if fitted != asked:
        raise ValueError(
            f"the classifier {name} was fitted to {fitted[0]} predicted frames at {fitted[1]:g} fps; these windows "
            f"have {asked[0]} at {asked[1]:g}"
        )
    try:
        labels = held.windows.labels(classifier.label)  # type: ignore[attr-defined]
    except KeyError as error:
        raise ValueError(f"the classifier {name} tells {classifier.label}s apart, but {error.args[0]}") from error
    if len(held.keys) - (max(clips.values()) if len(clips) > 1 else 0) < 2:
        raise ValueError(
            f"FID {name} needs normal fits to the features of at least two windows, also without any one clip; these "
            f"are {len(held.keys)} windows of {len(clips)} clips"
        )
    classes = [classifier.classes.index(label) if label in classifier.classes else -1 for label in labels]
    with evaluating(classifier, seed):
        real = torch.cat([_features(classifier, futures) for futures in held.futures.split(batch_size)])
    return _Judge(classifier, torch.tensor(classes), real.double().cpu())


def _features(classifier: Any, futures: Tensor) -> Tensor:
    """(..., F) from (..., H, D), on the device of the classifier."""
    return classifier.features(on_device_of(classifier, {"x": futures})["x"])


def hold(windows: HeldOutWindows) -> _Held:
    batch = windows.all()
    observed = windows.protocol.observed
    if partial := {"lengths", "mask"} & batch.keys():
        raise ValueError(f"evaluation needs complete windows, but these have {', '.join(sorted(partial))}")
    if not 1 <= observed < batch["x"].shape[1]:
        raise ValueError(
            f"windows of {batch['x'].shape[1]} frames, {observed} of them observed, leave nothing to "
            "observe or nothing to predict"
        )
    # A pose that was exchanged has no truths: the windows that begin like it go on from other poses.
    truths = [] if getattr(windows, "exchanged", None) else multimodal_truths(windows)
    return _Held(windows, batch, observed, list(windows.keys), truths)


def _references(
    held: _Held, samples: int, training_windows: HeldOutWindows | None
) -> dict[str, tuple[int, Forecaster]]:
    """Number of forecasts and forecaster of each reference row."""
    horizon = held.futures.shape[1]
    rows: dict[str, tuple[int, Forecaster]] = {}
    if held.judges:
        rows["real motion"] = 1, lambda part: held.futures[part][None]
    rows["zero velocity"] = 1, lambda part: zero_velocity(held.past(part)["x"], horizon)
    if training_windows is not None:
        training = training_windows.all()["x"][:, : held.observed + horizon]
        neighbours = min(samples, len(training))
        rows["nearest neighbours"] = (
            neighbours,
            lambda part: nearest_neighbours(held.past(part)["x"], training, neighbours),
        )
    return rows


def _free_running(
    name: str, forecaster: Forecaster, samples: int, held: _Held, parts: Iterator[slice]
) -> dict[str, tuple[float, ...]]:
    """Scores of free-running forecasts, by clip."""
    found, features = [], []
    for part in parts:
        past, truth = held.past(part)["x"], held.futures[part]
        forecasts = forecaster(part).cpu()
        expected = (samples, *truth.shape)
        if forecasts.shape != expected:
            raise ValueError(f"forecasts of {name} must be (K, B, T, D) = {expected}, not {tuple(forecasts.shape)}")
        refuse_non_finite(name, "forecast", forecasts.isfinite().all(-1).all(-1).all(0), held.keys[part])
        forecasts = forecasts.movedim(0, 1)
        bodies, body = held.body(forecasts), held.bodies[part]
        scores = {"APD": metrics.average_pairwise_distance(bodies)}
        scores |= {metric: score(bodies, body) for metric, score in _PAIRED.items()}
        for metric, score in _MULTIMODAL.items() if held.truths else ():
            pairs = zip(bodies, held.truths[part], strict=True)
            scores[metric] = torch.stack([score(window, held.bodies[others]) for window, others in pairs])
        if bodies is not forecasts:
            scores |= {f"global {metric}": _PAIRED[metric](forecasts, truth) for metric in ("ADE", "FDE")}
        if held.given:
            distances = (forecasts - held.batch["y"][part, None, held.observed :]).unflatten(-1, (-1, 3)).norm(dim=-1)
            scores["path error"] = distances[..., held.given].mean((1, 2, 3))
        if hasattr(held.windows, "skeleton"):
            scores["bone-length error"] = _bone_length_error(held.windows, past, forecasts)
        if held.pose_prior is not None:
            scores["pose NLL"] = _pose_nll(held.pose_prior, past, forecasts)
        seen = {label: _features(judge.model, forecasts) for label, judge in held.judges.items()}
        for label, judge in held.judges.items():
            if (judge.classes >= 0).any():
                scores[f"ACC {label}"] = _accuracy(judge.model.logits(seen[label]).cpu(), judge.classes[part])
        found.append(scores)
        features.append({label: values.double().cpu() for label, values in seen.items()})
    places = torch.tensor(held.places)
    pooled = {
        f"FID {label}": frechet_pseudo_values(held.judges[label].real, values, places)
        for label, values in _concatenate(features).items()
    }
    return held.clip_means(_concatenate(found)) | pooled


def _accuracy(logits: Tensor, classes: Tensor) -> Tensor:
    """Share of right answers (B,) in (B, K, C); NaN where the class is unknown, -1."""
    right = (logits.argmax(-1) == classes[:, None]).double().mean(1)
    return right.masked_fill(classes < 0, math.nan)


def frechet_pseudo_values(real: Tensor, generated: Tensor, places: Tensor) -> tuple[float, ...]:
    """The Fréchet distance between two sets of features, as a pseudo-value of each clip (see the file).

    They are moved by one constant so that their mean over windows is the distance as it is defined: the mean of plain
    pseudo-values is one that is corrected for bias.

    Args:
        real: `(N, F)`, of the true futures.
        generated: `(N, K, F)`, of the generated ones.
        places: `(N,)`, the clip of every window, from 0 to C - 1.
    """
    centre = real.mean(0)  # far from 0, second moments would cancel
    sets = _moments_without_clips(real[:, None] - centre, places), _moments_without_clips(generated - centre, places)
    distance = metrics.gaussian_frechet_distance(*sets[0], *sets[1])
    shares = places.bincount().double() / len(places)
    without = distance[1:] if len(shares) > 1 else distance
    pseudo = distance[0] + (1 / shares - 1) * (distance[0] - without)
    return tuple((pseudo - (shares * pseudo).sum() + distance[0]).tolist())


def _moments_without_clips(features: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
    """Means (1 + C, F) and covariances (1 + C, F, F) of (N, K, F), of all windows and without each of C > 1 clips."""

    def sums(values: Tensor) -> Tensor:
        by_clip = values.new_zeros(int(places.max()) + 1, *values.shape[1:]).index_add_(0, places, values)
        whole = by_clip.sum(0, keepdim=True)
        return torch.cat([whole, whole - by_clip]) if len(by_clip) > 1 else whole

    count = sums(features.new_full((len(features), 1), features.shape[1]))
    mean = sums(features.sum(1)) / count
    squares = sums(features.mT @ features)
    return mean, (squares - count[..., None] * mean[:, :, None] * mean[:, None]) / (count[..., None] - 1)


def _teacher_forced(name: str, model: Any, particles: int, held: _Held, parts: Iterator[slice]) -> dict[str, Tensor]:
    """Bounds and KL terms `(N,)`, in nats per frame."""
    found = []
    for part in parts:
        batch = on_device_of(model, {variable: value[part] for variable, value in held.batch.items()})
        terms = SequenceELBO().terms(model, batch)
        scores = {"ELBO": terms.per_frame}
        scores |= {f"KL {latent}": kl / terms.frames for latent, kl in terms.kl.items()}
        if particles:
            weighted = importance_bound(model, batch, particles=particles)
            scores |= {"importance bound": weighted.bound / terms.frames, "k-hat": weighted.khat}
        refuse_non_finite(name, "bound", scores["ELBO"].isfinite(), held.keys[part])
        found.append({metric: values.cpu() for metric, values in scores.items()})
    return _concatenate(found)


def refuse_non_finite(name: str, what: str, finite: Tensor, keys: Sequence[tuple[str, str, int]]) -> None:
    """Raise for the first window whose entry in `finite` (B,) is False."""
    if not finite.all():
        split, clip, start = keys[int(finite.logical_not().nonzero()[0])]
        raise FloatingPointError(
            f"the {what} of {name} is not finite for the window at frame {start} of clip {clip!r} ({split}); "
            "it cannot be left out, since all methods are scored on the same ones"
        )


def _bone_length_error(windows: Any, observed: Tensor, forecasts: Tensor) -> Tensor:
    """Mean of |length / observed length - 1| over samples, frames and bones: (B,) from (B, K, T, D)."""
    lengths, reference = (windows.skeleton.bone_lengths(windows.positions(poses)) for poses in (forecasts, observed))
    return (lengths / reference.mean(1)[:, None, None] - 1).abs().mean((1, 2, 3))


def _hash(module: nn.Module) -> str:
    digest = hashlib.sha256()
    for name, value in module.state_dict().items():
        digest.update(name.encode() + value.cpu().numpy().tobytes())
    return digest.hexdigest()


@torch.no_grad()
def _pose_nll(prior: Any, observed: Tensor, forecasts: Tensor) -> Tensor:
    """(B,) from (B, O, D) and (B, K, T, D)."""
    if prior.forward_at not in (None, observed.shape[1] - 1):
        raise ValueError(
            f"the pose prior reads windows turned at their frame {prior.forward_at + 1}, but here "
            f"{observed.shape[1]} frames are observed; fit one under this protocol"
        )
    past = observed[:, None].expand(-1, forecasts.shape[1], -1, -1)
    motion = prior.facing(torch.cat([past, forecasts], 2))[:, :, observed.shape[1] :]
    return pose_prior_energy(motion.movedim(1, 0), prior, prior.skeleton)


def _forecaster(model: Any, held: _Held, samples: int, options: Mapping[str, Any]) -> Forecaster:
    horizon = held.futures.shape[1]
    return lambda part: model.forecast(on_device_of(model, held.past(part)), horizon, samples, **options)["x"]


def on_device_of(model: nn.Module, batch: Batch) -> Batch:
    """The batch on the device and in the floating type of the model's parameters."""
    parameter = next(model.parameters())

    def moved(value: Tensor) -> Tensor:
        return value.to(parameter) if value.is_floating_point() else value.to(parameter.device)

    return dict(each(batch, moved))


def _concatenate(parts: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


@contextmanager
def evaluating(model: nn.Module, seed: int) -> Iterator[None]:
    """Evaluation mode, no gradients and draws from `seed`; mode and random state are restored."""
    device = next(model.parameters()).device
    training = model.training
    model.eval()
    try:
        with torch.no_grad(), torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.manual_seed(seed)
            yield
    finally:
        model.train(training)


def _reading(name: str) -> Metric:
    return METRICS[_kind(name)]


def _kind(name: str) -> str:
    """The name of a metric in `METRICS`."""
    return name if name in METRICS else name.partition(" ")[0]


def plain(value: Any) -> Any:
    """The value as JSON holds it: tuples become lists, and numbers that are not finite None."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _row(document: dict[str, Any]) -> Row:
    scores = document.pop("scores")
    means = {
        name: tuple(math.nan if mean is None else mean for mean in score["clip_means"])
        for name, score in scores.items()
    }
    return Row(clip_means=means, **document)
