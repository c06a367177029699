"""Reconstruction errors of a latent space of segments, for surfaces and time, compared with principal components.

As in Marsot et al. (2021), arXiv 2106.04387, the mean of the guide is decoded on the segment's own body. The error of a
segment is the mean distance over frames and vertices. The baseline is a principal component analysis of [chi, beta],
with as many components as z and beta have dimensions together. It is also decoded on the segment's own body.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Self

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from ...data.batch import WHOLE, Batch
from ...inference.bounds.elbo import SequenceELBO, iwae_bound
from ...inference.evaluation.estimates import clustered_variance, linearised
from ...inference.evaluation.evaluation import ARROWS, Score
from ...inference.evaluation.evaluation_windows import cluster_index, on_device_of, seeded_evaluation
from ...inference.evaluation.record import MODELS, Dims
from ...inference.evaluation.result import Result, Table, new_figure, progress_bar, styled
from ...inference.evaluation.scores import TEACHER_FORCED, Metric, cluster_means
from ...options import nearest
from ..bodies import vertex_error
from .embodied import SHAPE, Segments, SegmentSchema, surfaces_of
from .frames import TimedFrames

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ERROR, DURATION = "vertex error", "duration error"
POSTERIOR = "KL", "latent norm", "latent deviation"
"""Scores that compare the posterior of a segment with N(0, I): KL, norm of the mean, and mean standard deviation."""
METRICS = {
    **{ERROR: Metric("mm"), DURATION: Metric("ms"), **TEACHER_FORCED},
    **{name: Metric("nats" if name == "KL" else "", "teacher-forced", "") for name in POSTERIOR},
}


@dataclass(frozen=True, eq=False, repr=False)
class Reconstruction(Result):
    """Reconstruction errors of each segment, with one row per model and per principal component analysis.

    Indexing by the name of a row returns its scores: `found["motion-latent"]["vertex error"].mean`.

    Attributes:
        rows: dictionary from row name to score name to the values (N,) of the segments.
        segments: split, name and take of each segment.
        fingerprint: SHA-256 of the motion.
        notes: lines below the table.
        configs: dictionary from row name to the configuration of the model's run.
    """

    rows: Annotated[Mapping[str, Annotated[Mapping[str, np.ndarray], Dims("sequence", name="{}")]], MODELS]
    segments: list[tuple[str, str, str]]
    fingerprint: str
    notes: list[str] = field(default_factory=list)
    configs: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def __getitem__(self, row: str) -> dict[str, Score]:
        return {name: self._score(values) for name, values in self._row(row).items()}

    def difference(self, first: str, second: str, score: str = ERROR) -> Score:
        """Return the mean paired difference of two rows, first minus second, with a standard error clustered by take.

        Args:
            first, second: names of the rows.
            score: name of the score, such as "vertex error" (mm) or "duration error" (ms).

        Raises:
            KeyError: a row or score does not exist.
        """
        first_values, second_values = (self._row(row)[score] for row in (first, second))
        return self._score(first_values - second_values)

    @override
    def table(self) -> Table:
        """Return a table with one row per model: means over segments with 95 % intervals, and median vertex errors."""
        takes = len({take for _, _, take in self.segments})
        title = f"{len(self.segments)} segments of {takes} takes · data {self.fingerprint[:12]}"
        caption = "mean over segments, with its 95 % interval where there are several takes, by which it is clustered"
        table = Table(title=title, caption="\n".join([caption, *self.notes]))
        table.add_column("", no_wrap=True)
        names = [name for name in METRICS if any(name in row for row in self.rows.values())]
        for name in names:
            metric = METRICS[name]
            table.add_column(f"{name}{ARROWS[metric.better]}\n{metric.unit}", justify="right")
        table.add_column("median\nmm", justify="right")
        for row, values in self.rows.items():
            scores = self[row]
            cells = [_cell(scores[name], METRICS[name]) if name in scores else "–" for name in names]
            table.add_row(row, *cells, f"{np.median(values[ERROR]):.1f}")
        return table

    @styled
    def plot(self) -> Figure:
        """Draw Tukey's box plots of vertex errors: quartiles, whiskers to 1.5 interquartile ranges, and outliers."""
        figure = new_figure(7, 0.8 + 0.3 * len(self.rows))
        axes = figure.subplots()
        axes.boxplot(
            [row[ERROR] for row in self.rows.values()],
            orientation="horizontal",
            widths=0.6,
            flierprops={"markersize": 2},
        )
        axes.set_yticks(range(1, len(self.rows) + 1), list(self.rows), parse_math=False)
        axes.invert_yaxis()
        axes.set_xlim(left=0)
        axes.set_xlabel("vertex error (mm)")
        axes.set_title(f"{len(self.segments)} segments")
        axes.grid(axis="x", alpha=0.3)
        return figure

    @override
    def summary(self) -> dict[str, Any]:
        """Return means and standard errors by row and score."""
        return {row: {name: vars(score) for name, score in self[row].items()} for row in self.rows}

    @override
    def labels(self) -> dict[str, Sequence[str]]:
        return {"sequence": ["/".join(segment) for segment in self.segments]}

    @override
    def check(self) -> None:
        if self.extents.get("sequence") != {len(self.segments)}:
            raise ValueError(f"each score in `rows` must have one value for each of {len(self.segments)} segments")
        self.table()

    def _row(self, row: str) -> Mapping[str, np.ndarray]:
        if row not in self.rows:
            raise KeyError(f"no row {row!r}{nearest(row, self.rows)}; there are {', '.join(self.rows)}")
        return self.rows[row]

    def _score(self, values: np.ndarray) -> Score:
        takes = cluster_index([(split, take, 0) for split, _, take in self.segments])
        mean, deviations = linearised(
            np.array(cluster_means(torch.from_numpy(values), takes)), takes.bincount().numpy()
        )
        return Score(float(mean), math.sqrt(clustered_variance(deviations)), len(deviations) - 1)


@dataclass(frozen=True, eq=False)
class PrincipalComponents:
    """Principal component analysis of [chi, beta], as a linear latent space with C dimensions.

    Args:
        mean: (N D + S,), mean of [chi, beta] over the training segments.
        directions: (N D + S, C), orthonormal columns.
    """

    mean: Tensor
    directions: Tensor

    @classmethod
    def of(cls, segments: Segments, components: int) -> Self:
        """Fit the components with the largest variance.

        Args:
            segments: training segments.
            components: number of components C; at most one fewer than segments are used.
        """
        values = _joined(segments.all())
        mean = values.mean(0)
        centred = values - mean  # (B, N D + S): fewer segments than dimensions
        _, shares = torch.linalg.eigh((centred @ centred.T).double())
        count = max(min(components, len(values) - 1), 1)
        directions, _ = torch.linalg.qr(centred.T @ shares[:, -count:].flip(-1).to(centred))
        return cls(mean, directions)

    def __call__(self, batch: Mapping[str, Any]) -> Tensor:
        """Return the reconstruction of x (B, N, D), by projecting x and beta (B, S) of a batch on the components."""
        values = _joined(batch) - self.mean
        projected = self.mean + values @ self.directions @ self.directions.T
        return projected[:, : -batch[SHAPE].shape[-1]].view_as(batch[WHOLE])


def _joined(batch: Mapping[str, Any]) -> Tensor:
    """Concatenate x and beta of a batch to [chi, beta], (B, N D + S)."""
    return torch.cat([batch[WHOLE].flatten(1), batch[SHAPE]], -1)


def reconstruct_segments(
    models: Mapping[str, Any],
    segments: Segments,
    training: Segments | None = None,
    *,
    bound_particles: int = 0,
    seed: int = 0,
    batch_size: int = 32,
    configs: Mapping[str, Mapping[str, Any]] | None = None,
    progress: bool = True,
) -> Reconstruction:
    """Score the reconstructions of segments by models, and by principal components of the same dimension.

    Models may represent frames differently (`model.timed`). Each model receives and reconstructs the segments in its
    own representation. Vertex errors are in millimetres in every representation and therefore comparable.

    Args:
        models: models by name, such as `motion-latent` models, with `timed`, `encode` and `decode`.
        segments: test segments on the body of the models.
        training: segments to fit the principal components to; None leaves out their rows.
        bound_particles: number of particles of the IWAE bound and its k-hat; 0 leaves both out.
        seed: seed of the particles.
        batch_size: number of segments at once.
        configs: dictionary from model name to its configuration in JSON types, which is stored with the result.
        progress: whether to show a progress bar.

    Returns:
        Vertex errors in mm, duration errors in ms, and bounds in nats per frame, of each segment by model; also the KL
        of its posterior from N(0, I) in nats, the norm of the posterior mean, and the mean posterior deviation.

    Raises:
        ValueError: `models` is empty, or a batch size or number of particles is invalid.
        FloatingPointError: a reconstruction is NaN or infinite.
    """
    if not models or batch_size < 1 or bound_particles < 0:
        raise ValueError(
            f"expected at least one model, batch_size from 1 and bound_particles from 0, got {len(models)}, "
            f"{batch_size} and {bound_particles}"
        )
    representations, for_training = _Representations(segments), None if training is None else _Representations(training)
    rows: dict[str, dict[str, np.ndarray]] = {}
    linear: dict[tuple[str, int], str] = {}
    with progress_bar(progress) as bar:

        def score(name: str, subset: Segments, function: Callable[[Mapping[str, Any]], Mapping[str, Tensor]]) -> None:
            batches = []
            for part in bar.track(torch.arange(len(subset)).split(batch_size), description=name):
                batches.append(function(Batch(subset.all()).rows(part)))
            rows[name] = {
                key: torch.cat([batch[key].cpu() for batch in batches]).double().numpy() for key in batches[0]
            }
            if invalid := np.flatnonzero(~np.isfinite(rows[name][ERROR])).tolist():
                segment = "/".join(subset.motion.clips[invalid[0]].key)
                raise FloatingPointError(f"the output of {name} for segment {segment} is not finite")

        for name, model in models.items():
            test_segments = representations.by(model.timed)
            with seeded_evaluation(model, seed):
                score(name, test_segments, partial(_scores, model, test_segments, bound_particles))
            size = model.sizes["z"] + test_segments.schema.size(SHAPE)
            if for_training is None or (key := (_key(model.timed), size)) in linear:
                continue
            linear[key] = f"PCA of {size}" if f"PCA of {size}" not in rows else f"PCA of {size}, frames of {name}"
            components = PrincipalComponents.of(for_training.by(model.timed), size)
            score(linear[key], test_segments, partial(_linear, components, test_segments))
    keys = [(clip.split, clip.name, clip.labels.get("source", clip.name)) for clip in segments.motion]
    notes = [] if training is None else [f"PCA: components of [chi, beta] of {len(training)} training segments"]
    return Reconstruction(rows, keys, segments.motion.fingerprint(), notes, dict(configs or {}))


class _Representations:
    """The same segments in the representation of each model; models with the same representation share them."""

    def __init__(self, segments: Segments) -> None:
        self.segments = segments
        self.known = {_key(segments.timed): segments}

    def by(self, timed: TimedFrames) -> Segments:
        """Return the segments in this representation."""
        if (key := _key(timed)) not in self.known:
            self.known[key] = Segments(self.segments.motion, timed, self.segments.body)
        return self.known[key]


def _key(timed: TimedFrames) -> str:
    """Return a text that identifies a representation."""
    return json.dumps(SegmentSchema({}, timed=timed).config())


def _scores(model: Any, segments: Segments, particles: int, batch: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the errors of a model and its bounds in nats per frame for a batch, (B,) each."""
    data = on_device_of(model, batch)
    scores = _errors(segments, model.decode(model.encode(data), data[SHAPE]).cpu(), batch)
    terms = SequenceELBO().terms(model, data)
    scores["ELBO"] = terms.per_step
    posterior = model.posterior(data)
    values = terms.kl["z"], posterior.mean.norm(dim=-1), posterior.stddev.mean(-1)
    scores |= dict(zip(POSTERIOR, values, strict=True))
    if particles:
        bound = iwae_bound(model, data, particles=particles)
        scores |= {"IWAE bound": bound.bound / terms.n_steps, "k-hat": bound.khat}
    return scores


def _linear(components: PrincipalComponents, segments: Segments, batch: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the errors of principal components for a batch, (B,) each."""
    return _errors(segments, components(batch), batch)


def _errors(segments: Segments, x: Tensor, batch: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return errors (B,) of frames (B, N, D): of the surface in millimetres, of the duration in milliseconds."""
    surfaces, truth = (surfaces_of(segments.timed, segments.body, frames, batch[SHAPE]) for frames in (x, batch[WHOLE]))
    lasts = (segments.timed.lasts(x) - segments.timed.lasts(batch[WHOLE])).abs()
    return {ERROR: 1000 * vertex_error(surfaces, truth), DURATION: 1000 * lasts}


def _cell(score: Score, metric: Metric) -> str:
    decimals = 1 if metric.unit in ("mm", "ms", "nats") else 3
    low, high = score.interval()
    interval = "" if math.isnan(low) or metric.unit == "" else f" [{low:.{decimals}f}, {high:.{decimals}f}]"
    return f"{score.mean:.{decimals}f}{interval}"
