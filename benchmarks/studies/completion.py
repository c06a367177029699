"""Measure prediction and completion by fitted runs of motion-latent, and write the tables and pictures.

Each measurement has a file under `--out`. An interrupted script continues there and skips existing files, and two
processes may work on other parts or runs at once. Tables show the available files, over all runs, the seeds of one fit:

    prediction    of the rest from the first quarter of a second, with residual-sup and the last frame as baselines
    completion    from M points a frame in all of 100 frames, and from few of them, with and without 16 markers
    uncertainty   coverage of intervals for surfaces and durations, k-hat, and convergence of descents
    tuning        deviations and descents, by the first run fitted on file group A only (`--tuned`), evaluated on B
    claim         prediction by all of these runs, as in the paper

Residual-sup (Martinez et al. 2017, arXiv 1705.02445) is the network of mix-and-match without noise that adds velocities
to poses, on quaternions and places, fitted to the takes of the same training segments on the same body. The part
"claim" predicts as in the paper, with runs fitted on file group A only (`--tuned`) and residual-sup at 100 frames per
second; as in the paper, residual-sup knows the true body, and ours infers it. The takes have 2 % more frames than the
segments of group A, so the data are nearly equal.
"""

from __future__ import annotations

import itertools
import json
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor

import dvae
from dvae import motion
from dvae.data.batch import WHOLE
from dvae.inference.evaluation.result import new_figure, styled
from dvae.motion import bodies
from dvae.motion.geometry.rotations import to_matrix
from dvae.motion.geometry.skeleton import rotate_about_up
from dvae.motion.segments.completion import (
    Completed,
    Deviations,
    chamfer,
    complete,
    error_by_time,
    sample_surfaces,
    simulate_observations,
    surfaces_at,
)
from dvae.motion.segments.dataset import SegmentData, subsample_clips
from dvae.motion.segments.embodied import SHAPE, Segments

from .engine import OURS, Row, fit_or_load, folder, interval, read_all, read_or_measure, spread
from .results import DOCS, Table, read, refuse_unknown, tabled, write

PARTS = ("prediction", "completion", "uncertainty", "tuning", "claim")
TUNING, CLAIM = "tuning", "claim"
SUBJECT = "motion_latent_4d"
DEVIATIONS, DESCENT = Deviations(), dvae.Descent()
"""Defaults that the part "tuning" selected."""
SECONDS, HORIZON = 0.25, 1.2
RESIDUAL: dict[str, Any] = {"alpha": 0.0, "velocity": True, "width": 256}
TRAINING: dict[str, Any] = {"batch_size": 32, "learning_rate": 2e-3, "decay": 0.5}
BODY_UNKNOWN, SUP, STILL, NEAR = "ours, body unknown", "residual-sup", "last frame held", "reconstruction"
POINTS, FRAMES = (10, 50, 100), (5, 10, 20, 50, 100)
PUBLISHED_FPS = 100.0
"""Frame rate of residual-sup in the paper."""
FEW, ALL = 50, FRAMES[-1]
"""Fixed number of points a frame in the series over frames, and of frames in the series over points."""
LEVELS = (0.5, 0.8, 0.95)
DRAWS = 200
ENDS = ("left", "behind", "bent")
THIN = 16
"""Stride over vertices and frames for intervals, because neighbours have similar errors."""
AT_ONCE = 512
"""Number of draws in memory at the same time."""
CONVERGED = 0.1
"""Largest gain of a further Newton step, and largest difference of two starts that agree, in nats."""


@dataclass(frozen=True)
class Budget:
    """Size of the study.

    Args:
        every: step between test segments that are predicted.
        some: number of test segments to complete for each kind of observation.
        known: number of training segments for the starts of descents and for the prior.
        steps: training steps of residual-sup.
        dense: points of the true surface in each frame, for the distance to completed surfaces.
    """

    every: int = 1
    some: int = 40
    known: int = 500
    steps: int = 3000
    dense: int = 500


@dataclass(frozen=True)
class Sight:
    """Observed points and markers of a segment.

    Args:
        points: number of points in a frame, M.
        frames: number of observed frames of 100, evenly spaced.
        markers: whether the 16 markers are observed too.
    """

    points: int
    frames: int
    markers: bool = False

    def __str__(self) -> str:
        return f"{self.points} points, {self.frames} frames{', markers' * self.markers}"

    def of(self, model: Any, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Simulate observations at known times in evenly spaced frames; body shapes are not observed."""
        x, last = batch[WHOLE], model.timed.frames - 1
        frames = torch.linspace(0, last, self.frames).round().long()
        kinds = ["points"] * bool(self.points) + ["markers"] * self.markers
        observations = {"times": model.timed.times(x)[:, frames]}
        for kind in kinds:
            observations |= simulate_observations(
                model, x, batch[SHAPE], kind, frames=frames.tolist(), points=self.points
            )
        return observations


@dataclass(frozen=True)
class Beginning:
    """Observation of the whole surface in the first quarter of a second.

    Args:
        with_shape: whether body shapes are given.
    """

    with_shape: bool = True

    def __str__(self) -> str:
        return f"first {SECONDS} s{'' if self.with_shape else ', body unknown'}"

    def of(self, model: Any, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Simulate observations of the surface at the frame rate of the data."""
        fps = model.timed.skeleton.fps
        observations = simulate_observations(model, batch[WHOLE], batch[SHAPE], "surfaces", fps=fps, seconds=SECONDS)
        return {**observations, SHAPE: batch[SHAPE]} if self.with_shape else observations


SIGHTS = {
    "points": [Sight(points, ALL, markers) for points in POINTS for markers in (False, True)],
    "frames": [Sight(FEW, frames, markers) for frames in FRAMES for markers in (False, True)],
    "markers": [Sight(0, frames, True) for frames in FRAMES],
}
UNCERTAINTY_CASES = [Beginning(), Sight(0, 10, True), Sight(FEW, 20)]
"""Observations for the coverage of intervals and for the tuning of deviations, one of each kind."""
TUNED_DEVIATIONS = {"surface": (0.005, 0.01, 0.02, 0.05, 0.1), "marker": (0.005, 0.01, 0.02, 0.05, 0.1)}
TUNED_DEVIATIONS |= {"point": (0.05, 0.1, 0.2)}
KINDS = dict(zip(map(str, UNCERTAINTY_CASES), ("surface", "marker", "point"), strict=True))
PRIORS = {"aggregate": True, "standard": False}
"""Whether the prior is the aggregate posterior of training segments, by name; otherwise it is N(0, I)."""
DESCENTS = [dvae.Descent(100, 0.05, 1), dvae.Descent(100, 0.05), dvae.Descent(100, 0.1), dvae.Descent(200, 0.05)]
DESCENTS += [dvae.Descent(200, 0.1), dvae.Descent(400, 0.05), dvae.Descent(200, 0.05, 8), dvae.Descent(400, 0.1)]


@cache
def open_segments(path: Path | None) -> SegmentData:
    """Open a file of segments; end the script if there is none."""
    if path is None:
        sys.exit("some measurements are missing; pass the data and a run")
    return SegmentData.open(path)


def split_by_group(people: motion.MotionSet) -> motion.MotionSet:
    """Split segments: file group A for training, group B for test."""
    splits = {"A": "train", "B": "test"}
    clips = [replace(clip, split=splits.get(clip.labels["file_group"], "unseen")) for clip in people]
    return replace(people, clips=clips)


@dataclass(frozen=True, eq=False)
class EvaluatedRun:
    """A run and its test segments, read on first use.

    Args:
        path: directory of the run.
        data: file of segments.
        budget: size of the study.
        some: whether to use the segments to complete instead of those to predict.
        grouped: whether the run was fitted on file group A and is evaluated on B.
    """

    path: Path
    data: Path | None
    budget: Budget
    some: bool = False
    grouped: bool = False

    @cached_property
    def model(self) -> Any:
        """The fitted model."""
        return dvae.load(self.path).model

    def split(self, name: str) -> list[Any]:
        """Return the segments of a split."""
        people = open_segments(self.data).segments
        return [clip for clip in (split_by_group(people) if self.grouped else people) if clip.split == name]

    def seen(self, clips: Sequence[Any]) -> Segments:
        """Return segments with the time frames of the model."""
        return Segments(replace(open_segments(self.data).segments, clips=clips), self.model.timed)

    @cached_property
    def segments(self) -> Segments:
        """Test segments, evenly spaced."""
        clips = self.split("test")[:: self.budget.every]
        return self.seen(subsample_clips(clips, self.budget.some) if self.some else clips)

    @cached_property
    def batch(self) -> Mapping[str, Tensor]:
        """All test segments."""
        return self.segments.all()

    def complete(
        self, observations: Mapping[str, Tensor], deviations: Deviations, descent: dvae.Descent, aggregate: bool = True
    ) -> Completed:
        """Complete segments from observations; training segments give the prior and the starts."""
        training = self.seen(subsample_clips(self.split("train"), self.budget.known)).all()
        options: dict[str, Any] = {"deviations": deviations, "descent": descent, "aggregate": aggregate}
        return complete(self.model, observations, **options, known=training)


def scores_by_take(run: EvaluatedRun, rows: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """Return a measurement with scores by segment, grouped by take."""
    takes = [clip.labels["source"] for clip in run.segments.motion]
    return {"clips": takes, "weights": [1] * len(takes), "rows": rows, **more}


def millimetres(values: Tensor) -> list[Any]:
    """Convert metres to millimetres, rounded to two decimals."""
    return (1000 * values.double()).round(decimals=2).tolist()  # type: ignore[no-any-return]


# Prediction


def observed_times(fps: float) -> tuple[list[float], int]:
    """Return the times of the frames up to the horizon, and the number of observed frames."""
    return [n / fps for n in range(int(HORIZON * fps + 1e-3) + 1)], int(SECONDS * fps + 1e-3) + 1


def at(time: float) -> str:
    """Return the name of the errors at a time."""
    return f"{time:.3f} s"


def errors_by_time(times: Sequence[float], segment_errors: Sequence[Tensor]) -> dict[str, list[Any]]:
    """Arrange errors (T,) of each segment by time and segment; NaN marks times after the end."""
    return dict(zip(map(at, times), millimetres(torch.stack([*segment_errors], 1)), strict=True))


def errors_of(run: EvaluatedRun, predicted: tuple[Tensor, Tensor], times: Sequence[float]) -> dict[str, list[Any]]:
    """Return errors by time and segment of predicted frames and body shapes."""
    truth = run.batch[WHOLE], run.batch[SHAPE]
    pairs = [[tuple(each[n : n + 1] for each in side) for side in (predicted, truth)] for n in range(len(predicted[0]))]
    return errors_by_time(times, [error_by_time(run.model, *pair, times)[0] for pair in pairs])


def measure_prediction(run: EvaluatedRun) -> dict[str, Any]:
    """Return errors by time of predictions and of reconstructions of whole segments."""
    model, batch = run.model, run.batch
    times, _ = observed_times(run.segments.motion.skeleton.fps)
    rows = {}
    for name, sight in ((OURS, Beginning()), (BODY_UNKNOWN, Beginning(with_shape=False))):
        completed = run.complete(sight.of(model, batch), DEVIATIONS, DESCENT)
        rows[name] = errors_of(run, (completed.x, completed.shape), times)
    with torch.no_grad():
        near = model.decode(model.encode(batch), batch[SHAPE])
    rows[NEAR] = errors_of(run, (near, batch[SHAPE]), times)
    return scores_by_take(run, rows, times=times)


def fit_residual(run: EvaluatedRun, seed: int, out: Path, fps: float) -> Any:
    """Fit residual-sup to the takes of the training segments of a run at a frame rate, or resume its fit."""
    data, steps = open_segments(run.data), run.budget.steps
    sources = {segment.labels["source"] for segment in run.split("train")}
    takes = bodies.fit_to_body(data.motion, bodies.human())
    takes = replace(takes, clips=[replace(clip, split="train") for clip in takes if clip.name in sources])
    takes = takes if fps == takes.skeleton.fps else takes.resample(fps)
    takes_data = motion.MotionData(str(data.path), takes, protocol(fps))
    training = {"steps": steps, "validate_every": max(steps // 3, 1), **TRAINING}
    method = dvae.method("mix-and-match", **RESIDUAL)
    return fit_or_load(method, takes_data, takes_data.windows("train"), out=out, seed=seed, **training).model.eval()


def protocol(fps: float) -> motion.Protocol:
    """Return the protocol of windows up to the horizon, rotated to face ahead in the last observed frame."""
    times, observed = observed_times(fps)
    options: dict[str, Any] = {"root": "relative", "heading": True, "representation": "quaternion", "validation": 0.0}
    return motion.Protocol(SUP, observed, len(times) - observed, fps, train_stride=1, test_stride=100_000, **options)


def residual_poses(model: Any, people: motion.MotionSet) -> tuple[Tensor, Tensor]:
    """Predict poses with residual-sup from the first frames of segments.

    Poses have the coordinates of chi: they start at the origin, with heading zero.

    Returns:
        Rotations (N, H, J, 3, 3) and root positions (N, H, 3).
    """
    skeleton = people.skeleton
    cut = protocol(skeleton.fps)
    windows = motion.windows(people, cut, "test", cut.observed)
    with torch.no_grad():
        x = model.model(model.read(windows.all()), length=cut.predicted, mean_emission=True)[WHOLE]
    places, turning = x[..., :3], model.rotations.turning
    rotations = torch.eye(3).repeat(*x.shape[:-1], skeleton.joints, 1, 1)
    rotations[..., turning, :, :] = to_matrix(x[..., 3:].unflatten(-1, (-1, 4)), "quaternion")
    first, last = (
        skeleton.heading(torch.from_numpy(np.stack([clip.positions[n] for clip in people])).double())
        for n in (0, cut.observed - 1)
    )
    angle = (last - first).float()[:, None]
    axes = rotate_about_up(torch.eye(3).expand(len(x), 1, 3, 3), angle[..., None], skeleton.up).mT
    rotations[..., skeleton.root, :, :] = axes @ rotations[..., skeleton.root, :, :]
    return rotations, rotate_about_up(places, angle, skeleton.up)


def reference_errors(run: EvaluatedRun, model: Any, fps: float) -> dict[str, Any]:
    """Return errors by time of residual-sup and of the repeated last observed frame."""
    batch, people = run.batch, run.segments.motion
    people = people if fps == people.skeleton.fps else people.resample(fps)
    times, observed = observed_times(fps)
    errors: dict[str, list[Any]] = {SUP: [], STILL: []}
    rotations, places = residual_poses(model, people)
    for n in range(len(people)):
        x, shape = (batch[name][n : n + 1] for name in (WHOLE, SHAPE))
        truth = surfaces_at(run.model, x, shape, torch.tensor(times)[None])[0]
        predicted = run.model.body(shape, rotations[n : n + 1], places[n : n + 1])[0][0]
        still = truth[observed - 1 : observed].expand(len(times) - observed, -1, -1)
        for name, ahead in ((SUP, predicted), (STILL, still)):
            surfaces = torch.cat([truth[:observed], ahead])
            errors[name].append(bodies.vertex_error(surfaces[:, None], truth[:, None]))
    return scores_by_take(run, {name: errors_by_time(times, rows) for name, rows in errors.items()}, times=times)


def measure_references(run: EvaluatedRun, seed: int, out: Path, fps: float | None = None) -> dict[str, Any]:
    """Fit residual-sup, by default at the rate of the data, and measure the references."""
    fps = fps or open_segments(run.data).motion.skeleton.fps
    return reference_errors(run, fit_residual(run, seed, out, fps), fps)


# Completion


def measure_completion(run: EvaluatedRun, sight: Sight) -> dict[str, Any]:
    """Return distances of completed from true surfaces by segment, in millimetres, and the convergence of descents.

    "chamfer" is the mean distance of a dense scan from the completed surface, and "back" that of the surface from the
    scan; half their sum is a two-way Chamfer distance. "floor" and "back floor" are those of the true surface.
    """
    model, batch = run.model, run.batch
    observations = sight.of(model, batch)
    completed = run.complete(observations, DEVIATIONS, DESCENT)
    names = ("chamfer", "floor", "back", "back floor", "vertices", "seen")
    distances: dict[str, list[Tensor]] = {name: [] for name in names}
    generator = torch.Generator().manual_seed(0)
    frames = observations["frames"][0].long()
    for n in range(len(batch[WHOLE])):
        one = slice(n, n + 1)
        predicted = model.vertices(completed.x[one], completed.shape[one])
        truth = model.vertices(batch[WHOLE][one], batch[SHAPE][one])
        points = sample_surfaces(truth, model.body.faces, run.budget.dense, generator)
        distances["chamfer"].append(chamfer(points, predicted).mean(-1))
        distances["floor"].append(chamfer(points, truth).mean(-1))
        distances["back"].append(chamfer(predicted, points).mean(-1))
        distances["back floor"].append(chamfer(truth, points).mean(-1))
        distances["vertices"].append(bodies.vertex_error(predicted, truth))
        if sight.points:
            distances["seen"].append(chamfer(observations["points"][one], predicted[:, frames]).mean(-1))
    lasts = model.timed.lasts(completed.x) - model.timed.lasts(batch[WHOLE])
    scores = {name: millimetres(torch.cat(each)) for name, each in distances.items() if each}
    return scores_by_take(run, {OURS: {**scores, "duration": millimetres(lasts.abs()), **convergence(completed)}})


def convergence(completed: Completed) -> dict[str, Any]:
    """Return three measures of convergence: nats to gain by a Newton step, nats between two starts, and `bent`."""
    posterior = completed.posterior
    behind = posterior.behind[1] if len(posterior.behind) > 1 else torch.full_like(posterior.energy, torch.nan)
    return dict(zip(ENDS, (each.tolist() for each in (posterior.left, behind, posterior.bent)), strict=True))


def measure_coverage(
    run: EvaluatedRun, sight: Any, deviations: Deviations, descent: dvae.Descent, aggregate: bool = True
) -> dict[str, Any]:
    """Return, by segment, the coverage of intervals for vertices and durations, and the errors.

    Intervals are normal, with the mean and variance of draws. They are for the surface, the surface with its noise,
    and, if the end is not observed, the duration with the deviation of times.
    """
    model, batch = run.model, run.batch
    completed = run.complete(sight.of(model, batch), deviations, descent, aggregate)
    khat = completed.evidence(DRAWS, chunk=AT_ONCE).khat
    x, shapes = completed.draw(DRAWS)
    vertices_used, noise = torch.arange(0, len(model.body.template), THIN), getattr(deviations, KINDS[str(sight)])
    reach = torch.distributions.Normal(0.0, 1.0).icdf((1 + torch.tensor(LEVELS)) / 2)[:, None]

    def places(frames: Tensor, shape: Tensor) -> Tensor:
        """Return the coordinates (..., P) of every `THIN`-th vertex in every `THIN`-th frame."""
        rotations, translation = model.timed.poses(frames[..., ::THIN, :])
        deviations_mm: Tensor = model.body.select_vertices(shape, rotations, translation, vertices_used)
        return deviations_mm.flatten(-3)

    def within(samples: Tensor, truth: Tensor, noise: float = 0.0) -> Tensor:
        """Return the share of true values (P,) inside the intervals of draws (n, P), by level."""
        spread = (samples.var(0) + noise**2).sqrt()
        return ((truth - samples.mean(0)).abs() <= reach * spread).float().mean(-1)

    deviations_mm: dict[str, list[Any]] = {"spread": [], "error": []}
    quantities = ("surface", "seen", *(() if isinstance(sight, Sight) else ("duration",)))
    shares: dict[str, list[Tensor]] = {quantity: [] for quantity in quantities}
    for n in range(len(x[0])):
        samples, truth = places(x[:, n], shapes[:, n]), places(batch[WHOLE][n], batch[SHAPE][n])
        if "duration" in shares:
            lasts, last = (model.timed.lasts(frames)[..., None] for frames in (x[:, n], batch[WHOLE][n]))
            shares["duration"].append(within(lasts, last, deviations.time))
        shares["surface"].append(within(samples, truth))
        shares["seen"].append(within(samples, truth, noise))
        deviations_mm["spread"].append(1000 * float(samples.var(0).mean().sqrt()))
        deviations_mm["error"].append(1000 * float((samples.mean(0) - truth).square().mean().sqrt()))
    predicted, true_surfaces = model.vertices(completed.x, completed.shape), model.vertices(batch[WHOLE], batch[SHAPE])
    coverages = {
        coverage_name(quantity, level): (100 * share).tolist()
        for quantity, each in shares.items()
        for level, share in zip(LEVELS, torch.stack(each, 1), strict=True)
    }
    vertices = millimetres(bodies.vertex_error(predicted, true_surfaces))
    return scores_by_take(
        run,
        {OURS: {"khat": khat.tolist(), "vertices": vertices, **deviations_mm, **coverages, **convergence(completed)}},
    )


def coverage_name(quantity: str, level: float) -> str:
    """Return the name of the coverage of intervals of a level, in per cent."""
    return f"{quantity}, {100 * level:.0f} % (%)"


# Tables


def error_rows(out: Path) -> dict[str, Row]:
    """Return the rows with errors by time."""
    ours, others = (read_all(out, name) for name in ("prediction", "references"))
    rows = {OURS: ours, BODY_UNKNOWN: ours, NEAR: ours, SUP: others, STILL: others}
    return {name: replace(row, name=name) for name, row in rows.items() if row is not None}


def claim_rows(out: Path) -> dict[str, Row]:
    """Return the rows of the part "claim": all predictions and reconstructions by case, and the references."""
    measured = {path.name: path for path in sorted((out / CLAIM).glob("*")) if path.is_dir()}
    cases = dict.fromkeys(name.rpartition("-")[0] for name in measured if (measured[name] / "prediction.json").exists())
    rows: dict[str, Row] = {}
    for case, shown in itertools.product(cases, (BODY_UNKNOWN, OURS, NEAR)):
        files = [measured[name] / "prediction.json" for name in measured if name.rpartition("-")[0] == case]
        label = {OURS: f"{case}, body given", BODY_UNKNOWN: case}.get(shown, f"{case}, {NEAR}")
        rows[label] = Row([json.loads(file.read_text()) for file in files if file.exists()], shown)
    references = read_all(out / CLAIM, "references")
    return rows | ({} if references is None else {name: replace(references, name=name) for name in (SUP, STILL)})


def time_table(rows: Mapping[str, Row]) -> Table:
    """Return a table of errors by row and tenth of a second, with the difference to residual-sup."""
    first = next(iter(rows.values()))
    times = [time for time in first.runs[0]["times"] if time > SECONDS and abs(10 * time - round(10 * time)) < 1e-3]
    lines = [[name, *(row.format_score(at(time)) for time in times)] for name, row in rows.items()]
    ours = [OURS] if OURS in rows else [name for name in rows if f"{name}, {NEAR}" in rows]
    for name in ours if SUP in rows else ():
        less = [rows[name].estimate(at(time), rows[SUP]) for time in times]
        lines.append([f"{name} minus {SUP}, 95 %", *(interval(each, allow_one_seed=True) for each in less)])
    lines.append(["segments", *(str(int(np.isfinite(first.values(at(time))[0]).sum())) for time in times)])
    return Table(["mm", *(f"{time:.1f} s" for time in times)], lines)


def of_sights(out: Path, sights: Iterable[Any], name: str = "{}") -> dict[Any, Row]:
    """Return the measured rows by observation."""
    rows = {sight: read_all(out, folder(name.format(sight))) for sight in sights}
    return {sight: row for sight, row in rows.items() if row is not None}


def completions(rows: Mapping[Sight, Row]) -> Table:
    """Return a table of errors, one row for each observation."""

    def more(sight: Sight) -> str:
        all_frames = rows.get(replace(sight, frames=ALL))
        if all_frames is None:
            return "–"
        return spread(100 * (rows[sight].by_seed("chamfer") / all_frames.by_seed("chamfer") - 1), 1)

    columns: dict[str, Callable[[Sight], str]] = {
        "Chamfer (mm)": lambda sight: rows[sight].format_score("chamfer"),
        "95 %": lambda sight: interval(rows[sight].estimate("chamfer"), allow_one_seed=True),
        "more than all frames (%)": more,
        "floor (mm)": lambda sight: rows[sight].format_score("floor"),
        "surface to scan (mm)": lambda sight: rows[sight].format_score("back"),
        "its floor (mm)": lambda sight: rows[sight].format_score("back floor"),
        "to points seen (mm)": lambda sight: rows[sight].format_score("seen"),
        "vertices (mm)": lambda sight: rows[sight].format_score("vertices"),
        "duration (ms)": lambda sight: rows[sight].format_score("duration"),
        "left (nats)": lambda sight: f"{np.median(rows[sight].values('left')):.2g}",
    }
    return tabled({str(sight): sight for sight in rows}, columns, "seen")


def coverage_table(rows: Mapping[Any, Row], levels: Sequence[float] = LEVELS) -> Table:
    """Return a table of interval coverage and convergence, one row for each observation or setting."""

    def share(row: Row, name: str, off: Callable[[np.ndarray], np.ndarray]) -> str:
        return f"{100 * off(row.values(name)).mean():.0f}"

    names = [coverage_name(quantity, level) for quantity in ("surface", "seen", "duration") for level in levels]
    columns: dict[str, Callable[[Row], str]] = {
        "vertices (mm)": lambda row: row.format_score("vertices"),
        "off (mm)": lambda row: row.format_score("error"),
        "sure to (mm)": lambda row: row.format_score("spread"),
        **{name: partial(Row.format_score, score=name, digits=0) for name in names},
        "k-hat above 0.7 (%)": lambda row: share(row, "khat", lambda khat: khat > 0.7),
        "converged (%)": lambda row: share(row, "left", lambda gain: np.abs(gain) < CONVERGED),
        "starts agree (%)": lambda row: share(row, "behind", lambda behind: np.abs(behind) < CONVERGED),
        "bent": lambda row: f"{row.values('bent').mean():.1f}",
        "seconds": lambda row: f"{np.mean([run['seconds'] for run in row.runs]):.0f}",
    }
    return tabled({str(name): row for name, row in rows.items()}, columns)


def tables(out: Path) -> dict[str, Table]:
    """Return all available tables."""
    available = {}
    if error_curves := error_rows(out):
        available["prediction"] = time_table(error_curves)
    if claimed := claim_rows(out):
        available["prediction-claim"] = time_table(claimed)
    for across, sights in SIGHTS.items():
        if completed := of_sights(out, sights):
            available[f"completion-{across}"] = completions(completed)
    if sure := of_sights(out, UNCERTAINTY_CASES, "sure of {}"):
        available["completion-uncertainty"] = coverage_table(sure)
    if tuning := of_sights(out, tuning_settings()):
        available["completion-tuning"] = coverage_table(tuning, levels=LEVELS[1:2])
    return {f"{SUBJECT}/{name}": table for name, table in available.items()}


@styled
def draw(results: Path, file: Path) -> None:
    """Draw errors over time, and Chamfer distances by points and by frames, from the tables in a folder.

    Bands and bars are standard errors over takes and seeds (figures 6 and 7 of the paper).
    """

    def estimate(cell: str) -> tuple[float, float]:
        mean, *errors = (float(part) for part in cell.split(" ± ") if part != "–")
        return mean, float(np.hypot.reduce(errors)) if errors else 0.0

    stored = {file.stem: read(f"{SUBJECT}/{file.stem}", results) for file in results.glob(f"{SUBJECT}/*.csv")}
    figure = new_figure(7, 2.9)
    first, by_points, by_frames = figure.subplots(1, 3)
    if "prediction" in stored:
        header, curves, _ = stored["prediction"]
        times = [float(head.removesuffix(" s")) for head in header[1:]]
        curves = [row for row in curves if row[0] != STILL and " minus " not in row[0] and row[0] != "segments"]
        for name, *cells in curves:
            known = [(time, *estimate(cell)) for time, cell in zip(times, cells, strict=True) if cell != "–"]
            x, mean, error = np.array(known).T
            (line,) = first.plot(x, mean, label=name)
            first.fill_between(x, mean - error, mean + error, color=line.get_color(), alpha=0.15, lw=0)
        first.set(xlabel="time (s)", title="vertex error (mm)", ylim=(0, None))
        if curves:
            first.legend()
    completed = {}
    for table in stored.values():
        for row in table.rows if "Chamfer (mm)" in table.header else ():
            if match := re.fullmatch(r"(\d+) points, (\d+) frames(, markers)?", row[0]):
                completed[int(match[1]), int(match[2]), bool(match[3])] = estimate(row[1])
    ways = {"points": (FEW, False), "points and markers": (FEW, True), "markers alone": (0, True)}
    for place, (way, (few, markers)) in enumerate(ways.items()):
        panels = {by_points: {k: e for (k, n, m), e in completed.items() if n == ALL and m == markers and k and few}}
        panels[by_frames] = {n: e for (k, n, m), e in completed.items() if k == few and m == markers}
        for panel, values in panels.items():
            if values:
                numbers = sorted(values)
                means, errors = zip(*(values[number] for number in numbers), strict=True)
                panel.errorbar(numbers, means, errors, marker=".", color=f"C{place}", label=way)
    for panel, label in ((by_points, f"points in each of {ALL} frames"), (by_frames, f"frames, {FEW} points in each")):
        panel.set(xlabel=label, title="Chamfer distance (mm)", ylim=(0, None))
    if completed:
        by_frames.legend()
    figure.savefig(file, dpi=200)


def tuning_settings() -> dict[str, tuple[Any, Deviations, dvae.Descent, bool]]:
    """Return the tuning settings by name: observation, deviations, descent, and whether the prior uses segments."""
    settings: dict[str, tuple[Any, Deviations, dvae.Descent, bool]] = {}
    for sight in UNCERTAINTY_CASES:
        kind = KINDS[str(sight)]
        for value, (prior, aggregate) in itertools.product(TUNED_DEVIATIONS[kind], PRIORS.items()):
            options = replace(DEVIATIONS, **{kind: value}), DESCENT, aggregate
            settings[f"{sight}, {prior} prior, {kind} {value:g}"] = sight, *options
        for descent in DESCENTS:
            label = f"{descent.steps} steps, rate {descent.rate:g}, {descent.starts} starts"
            settings[f"{sight}, {label}"] = sight, DEVIATIONS, descent, True
    return settings


def main(
    data: Path | None = None,
    runs: tuple[Path, ...] = (),
    tuned: tuple[Path, ...] = (),
    out: Path = Path("runs/completion"),
    results: Path | None = None,
    picture: Path = DOCS / "img" / "motion_latent_completion.png",
    parts: tuple[str, ...] = ("prediction", "completion", "uncertainty"),
    budget: Budget = Budget(),
) -> None:
    """Measure, and write the tables.

    Args:
        data: motion file (bandai2.npz), required for new measurements.
        runs: directories of fitted runs, one per seed; the study fits as many of residual-sup.
        tuned: directories of runs fitted on file group A by `benchmarks.studies.motion_latent`: SECTION/CASE-SEED.
        out: directory of the measurements, in a folder per run.
        results: folder of the tables, such as benchmarks/results; None prints them.
        picture: file of the picture of errors over time and completions, drawn if `results` is given.
        parts: prediction, completion, uncertainty, tuning, claim.
        budget: limits of computation.
    """
    torch.set_num_threads(1)
    refuse_unknown("part", parts, PARTS)
    for seed, path in enumerate(runs):
        here, sup, predicted = out / path.name, out / f"{SUP}-{seed}", EvaluatedRun(path, data, budget)
        if "prediction" in parts:
            read_or_measure(here / "prediction.json", partial(measure_prediction, predicted))
            read_or_measure(sup / "references.json", partial(measure_references, predicted, seed, sup))
        completed = replace(predicted, some=True)
        for sight in dict.fromkeys(itertools.chain(*SIGHTS.values())) if "completion" in parts else ():
            read_or_measure(here / f"{folder(sight)}.json", partial(measure_completion, completed, sight))
        for sight in UNCERTAINTY_CASES if "uncertainty" in parts else ():
            read_or_measure(
                here / f"{folder(f'sure of {sight}')}.json",
                partial(measure_coverage, completed, sight, DEVIATIONS, DESCENT),
            )
    for path in tuned if CLAIM in parts else ():
        run, seed = EvaluatedRun(path, data, budget, grouped=True), int(path.name.rpartition("-")[2])
        here = out / CLAIM / f"{path.parent.name}-{path.name}"
        read_or_measure(here / "prediction.json", partial(measure_prediction, run))
        sup = out / CLAIM / f"{SUP}-{seed}"
        read_or_measure(sup / "references.json", partial(measure_references, run, seed, sup, PUBLISHED_FPS))
    if tuned and "tuning" in parts:
        run = EvaluatedRun(tuned[0], data, budget, some=True, grouped=True)
        for name, choice in tuning_settings().items():
            read_or_measure(out / TUNING / f"{folder(name)}.json", partial(measure_coverage, run, *choice))
    write(results, tables(out))
    if results is not None:
        draw(results, picture)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
