"""Measure prediction and completion by fitted runs of motion-latent, and write the tables and pictures.

Each measurement has a file under `--out`. An interrupted script continues there and skips existing files, and two
processes may work on other parts or runs at once. Tables show the available files, over all runs, the seeds of one fit:

    prediction    of the rest from the first quarter of a second, with residual-sup and the last frame as baselines
    completion    from M points a frame in all of 100 frames, and from few of them, with and without 16 markers
    uncertainty   coverage of intervals for surfaces and durations, k-hat, and convergence of descents
    tuning        deviations and descents, by a run fitted on file group A only (`--tuned`), evaluated on B

Residual-sup (Martinez et al. 2017, arXiv 1705.02445) is the network of mix-and-match without noise that adds velocities
to poses, on quaternions and places, fitted to the takes of the same training segments on the same body.
"""

from __future__ import annotations

import itertools
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

from .engine import OURS, Row, fitted, folder, interval, kept, read_all, spread
from .results import DOCS, Table, refuse_unknown, tabled, write

PARTS = ("prediction", "completion", "uncertainty", "tuning")
TUNING = "tuning"
DEVIATIONS, DESCENT = Deviations(), dvae.Descent()
"""Chosen by the part "tuning"."""
SECONDS, HORIZON = 0.25, 1.2
RESIDUAL: dict[str, Any] = {"alpha": 0.0, "velocity": True, "width": 256}
TRAINING: dict[str, Any] = {"batch_size": 32, "learning_rate": 2e-3, "decay": 0.5}
UNTOLD, SUP, STILL, NEAR = "ours, body unknown", "residual-sup", "last frame held", "reconstruction"
POINTS, FRAMES = (10, 50, 100), (5, 10, 20, 50, 100)
FEW, ALL = 50, FRAMES[-1]
"""Points a frame where the number of frames changes, and frames where that of points does."""
LEVELS = (0.5, 0.8, 0.95)
DRAWS = 200
ENDS = ("left", "behind", "bent")
THIN = 16
"""Of so many vertices one has intervals, in one frame of so many; neighbours err alike."""
AT_ONCE = 512
"""Draws to hold at once."""
CONVERGED = 0.1
"""Nats that a step of Newton's would still gain, and within which two starts are taken for arrived at one place."""


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
        """In the first, the last, and frames evenly between, at times that are known; of bodies nothing is."""
        x, last = batch[WHOLE], model.timed.frames - 1
        frames = torch.linspace(0, last, self.frames).round().long()
        kinds = ["points"] * bool(self.points) + ["markers"] * self.markers
        seen = {"times": model.timed.times(x)[:, frames]}
        for kind in kinds:
            seen |= simulate_observations(model, x, batch[SHAPE], kind, frames=frames.tolist(), points=self.points)
        return seen


@dataclass(frozen=True)
class Beginning:
    """Observation of the whole surface in the first quarter of a second.

    Args:
        told: whether body shapes are given.
    """

    told: bool = True

    def __str__(self) -> str:
        return f"first {SECONDS} s{'' if self.told else ', body unknown'}"

    def of(self, model: Any, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """At the rate of the data."""
        fps = model.timed.skeleton.fps
        seen = simulate_observations(model, batch[WHOLE], batch[SHAPE], "surfaces", fps=fps, seconds=SECONDS)
        return {**seen, SHAPE: batch[SHAPE]} if self.told else seen


SIGHTS = {
    "points": [Sight(points, ALL, markers) for points in POINTS for markers in (False, True)],
    "frames": [Sight(FEW, frames, markers) for frames in FRAMES for markers in (False, True)],
    "markers": [Sight(0, frames, True) for frames in FRAMES],
}
SURE = [Beginning(), Sight(0, 10, True), Sight(FEW, 20)]
"""Of which intervals are judged, and deviations chosen, each one of a kind."""
TRIED = {"surface": (0.005, 0.01, 0.02, 0.05, 0.1), "marker": (0.005, 0.01, 0.02, 0.05, 0.1)}
TRIED |= {"point": (0.05, 0.1, 0.2)}
KINDS = dict(zip(map(str, SURE), ("surface", "marker", "point"), strict=True))
PRIORS = {"aggregate": True, "standard": False}
"""That of known segments, and N(0, I)."""
DESCENTS = [dvae.Descent(100, 0.05, 1), dvae.Descent(100, 0.05), dvae.Descent(100, 0.1), dvae.Descent(200, 0.05)]
DESCENTS += [dvae.Descent(200, 0.1), dvae.Descent(400, 0.05), dvae.Descent(200, 0.05, 8), dvae.Descent(400, 0.1)]


@cache
def opened(path: Path | None) -> SegmentData:
    """Segments of a file."""
    if path is None:
        sys.exit("something has not been measured yet; name the data and a run")
    return SegmentData.open(path)


def grouped(people: motion.MotionSet) -> motion.MotionSet:
    """Segments of file group A for training, of B for test."""
    splits = {"A": "train", "B": "test"}
    clips = [replace(clip, split=splits.get(clip.labels["file_group"], "unseen")) for clip in people]
    return replace(people, clips=clips)


@dataclass(frozen=True, eq=False)
class Held:
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
        """That was fitted."""
        return dvae.load(self.path).model

    def split(self, name: str) -> list[Any]:
        """Segments of a part."""
        people = opened(self.data).segments
        return [clip for clip in (grouped(people) if self.grouped else people) if clip.split == name]

    def seen(self, clips: Sequence[Any]) -> Segments:
        """Segments as the model sees them."""
        return Segments(replace(opened(self.data).segments, clips=clips), self.model.timed)

    @cached_property
    def segments(self) -> Segments:
        """Test segments, evenly spaced."""
        clips = self.split("test")[:: self.budget.every]
        return self.seen(subsample_clips(clips, self.budget.some) if self.some else clips)

    @cached_property
    def batch(self) -> Mapping[str, Tensor]:
        """All of them."""
        return self.segments.all()

    def complete(
        self, seen: Mapping[str, Tensor], deviations: Deviations, descent: dvae.Descent, aggregate: bool = True
    ) -> Completed:
        """Complete segments from observations, with known segments for training."""
        known = self.seen(subsample_clips(self.split("train"), self.budget.known)).all()
        how: dict[str, Any] = {"deviations": deviations, "descent": descent, "aggregate": aggregate}
        return complete(self.model, seen, **how, known=known)


def scored(held: Held, rows: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """A measurement of scores by segment, which are of takes."""
    takes = [clip.labels["source"] for clip in held.segments.motion]
    return {"clips": takes, "weights": [1] * len(takes), "rows": rows, **more}


def millimetres(values: Tensor) -> list[Any]:
    """Of metres, to a hundredth."""
    return (1000 * values.double()).round(decimals=2).tolist()  # type: ignore[no-any-return]


# Prediction


def moments(fps: float) -> tuple[list[float], int]:
    """Times of frames up to the horizon, and how many of them are seen."""
    return [n / fps for n in range(int(HORIZON * fps + 1e-3) + 1)], int(SECONDS * fps + 1e-3) + 1


def at(time: float) -> str:
    """The name of errors at a time."""
    return f"{time:.3f} s"


def by_times(times: Sequence[float], errors: Sequence[Tensor]) -> dict[str, list[Any]]:
    """Errors by time and segment, of errors (T,) of each segment, NaN behind its end."""
    return dict(zip(map(at, times), millimetres(torch.stack([*errors], 1)), strict=True))


def errors(held: Held, made: tuple[Tensor, Tensor], times: Sequence[float]) -> dict[str, list[Any]]:
    """Errors by time and segment of frames and bodies."""
    truth = held.batch[WHOLE], held.batch[SHAPE]
    pairs = [[tuple(each[n : n + 1] for each in side) for side in (made, truth)] for n in range(len(made[0]))]
    return by_times(times, [error_by_time(held.model, *pair, times)[0] for pair in pairs])


def prediction(held: Held) -> dict[str, Any]:
    """Return errors by time of predictions and of reconstructions of whole segments."""
    model, batch = held.model, held.batch
    times, _ = moments(held.segments.motion.skeleton.fps)
    found = {}
    for name, sight in ((OURS, Beginning()), (UNTOLD, Beginning(told=False))):
        done = held.complete(sight.of(model, batch), DEVIATIONS, DESCENT)
        found[name] = errors(held, (done.x, done.shape), times)
    with torch.no_grad():
        near = model.decode(model.encode(batch), batch[SHAPE])
    found[NEAR] = errors(held, (near, batch[SHAPE]), times)
    return scored(held, found, times=times)


def recurrent(data: SegmentData, seed: int, out: Path, steps: int) -> Any:
    """Residual-sup, fitted, or gone on with where it was stopped."""
    segments = data.segments
    sources = {clip.labels["source"] for clip in segments if clip.split == "train"}
    takes = bodies.fit_to_body(data.motion, bodies.human())
    takes = replace(takes, clips=[clip for clip in takes if clip.split == "train" and clip.name in sources])
    opened = motion.MotionData(str(data.path), takes, protocol(takes.skeleton.fps))
    training = {"steps": steps, "validate_every": max(steps // 3, 1), **TRAINING}
    method = dvae.method("mix-and-match", **RESIDUAL)
    return fitted(method, opened, opened.windows("train"), out=out, seed=seed, **training).model.eval()


def protocol(fps: float) -> motion.Protocol:
    """Return the protocol of windows up to the horizon, rotated to face ahead in the last observed frame."""
    times, seen = moments(fps)
    options: dict[str, Any] = {"root": "relative", "heading": True, "representation": "quaternion", "validation": 0.0}
    return motion.Protocol(SUP, seen, len(times) - seen, fps, train_stride=1, test_stride=100_000, **options)


def turned(model: Any, people: motion.MotionSet) -> tuple[Tensor, Tensor]:
    """What residual-sup makes of the first frames of segments: rotations (N, H, J, 3, 3) and places (N, H, 3).

    As frames of chi are, from where a segment starts, facing heading zero.
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


def references(held: Held, model: Any) -> dict[str, Any]:
    """Errors by time of residual-sup, and of the last frame that was seen, held."""
    batch, people = held.batch, held.segments.motion
    times, seen = moments(people.skeleton.fps)
    found: dict[str, list[Any]] = {SUP: [], STILL: []}
    rotations, places = turned(model, people)
    for n in range(len(people)):
        x, shape = (batch[name][n : n + 1] for name in (WHOLE, SHAPE))
        truth = surfaces_at(held.model, x, shape, torch.tensor(times)[None])[0]
        made = held.model.body(shape, rotations[n : n + 1], places[n : n + 1])[0][0]
        still = truth[seen - 1 : seen].expand(len(times) - seen, -1, -1)
        for name, ahead in ((SUP, made), (STILL, still)):
            whole = torch.cat([truth[:seen], ahead])
            found[name].append(bodies.vertex_error(whole[:, None], truth[:, None]))
    return scored(held, {name: by_times(times, rows) for name, rows in found.items()}, times=times)


def beside(held: Held, seed: int, out: Path) -> dict[str, Any]:
    """Fits residual-sup, and measures the references."""
    return references(held, recurrent(opened(held.data), seed, out, held.budget.steps))


# Completion


def completed(held: Held, sight: Sight) -> dict[str, Any]:
    """How near completed surfaces are to true ones, in millimetres by segment, and how descents ended."""
    model, batch = held.model, held.batch
    seen = sight.of(model, batch)
    done = held.complete(seen, DEVIATIONS, DESCENT)
    found: dict[str, list[Tensor]] = {"chamfer": [], "floor": [], "vertices": [], "seen": []}
    generator = torch.Generator().manual_seed(0)
    frames = seen["frames"][0].long()
    for n in range(len(batch[WHOLE])):
        one = slice(n, n + 1)
        made, truth = model.vertices(done.x[one], done.shape[one]), model.vertices(batch[WHOLE][one], batch[SHAPE][one])
        points = sample_surfaces(truth, model.body.faces, held.budget.dense, generator)
        found["chamfer"].append(chamfer(points, made).mean(-1))
        found["floor"].append(chamfer(points, truth).mean(-1))
        found["vertices"].append(bodies.vertex_error(made, truth))
        if sight.points:
            found["seen"].append(chamfer(seen["points"][one], made[:, frames]).mean(-1))
    lasts = model.timed.lasts(done.x) - model.timed.lasts(batch[WHOLE])
    scores = {name: millimetres(torch.cat(each)) for name, each in found.items() if each}
    return scored(held, {OURS: {**scores, "duration": millimetres(lasts.abs()), **ended(done)}})


def ended(done: Completed) -> dict[str, Any]:
    """Return three measures of convergence: nats to gain by a Newton step, nats between two starts, and `bent`."""
    posterior = done.posterior
    behind = posterior.behind[1] if len(posterior.behind) > 1 else torch.full_like(posterior.energy, torch.nan)
    return dict(zip(ENDS, (each.tolist() for each in (posterior.left, behind, posterior.bent)), strict=True))


def certain(
    held: Held, sight: Any, deviations: Deviations, descent: dvae.Descent, aggregate: bool = True
) -> dict[str, Any]:
    """Return, by segment, the coverage of intervals for vertices and durations, and the errors.

    Intervals are normal, with the mean and variance of draws. They are for the surface, the surface with its noise,
    and, if the end is not observed, the duration with the deviation of times.
    """
    model, batch = held.model, held.batch
    done = held.complete(sight.of(model, batch), deviations, descent, aggregate)
    khat = done.evidence(DRAWS, chunk=AT_ONCE).khat
    x, shapes = done.draw(DRAWS)
    which, noise = torch.arange(0, len(model.body.template), THIN), getattr(deviations, KINDS[str(sight)])
    reach = torch.distributions.Normal(0.0, 1.0).icdf((1 + torch.tensor(LEVELS)) / 2)[:, None]

    def places(frames: Tensor, shape: Tensor) -> Tensor:
        """(..., P) of some vertices in some frames."""
        rotations, translation = model.timed.poses(frames[..., ::THIN, :])
        found: Tensor = model.body.some(shape, rotations, translation, which)
        return found.flatten(-3)

    def within(drawn: Tensor, truth: Tensor, noise: float = 0.0) -> Tensor:
        """Shares of the truth (P,) that intervals of draws (n, P) hold, by level."""
        spread = (drawn.var(0) + noise**2).sqrt()
        return ((truth - drawn.mean(0)).abs() <= reach * spread).float().mean(-1)

    found: dict[str, list[Any]] = {"spread": [], "error": []}
    told = ("surface", "seen", *(() if isinstance(sight, Sight) else ("duration",)))
    shares: dict[str, list[Tensor]] = {what: [] for what in told}
    for n in range(len(x[0])):
        drawn, truth = places(x[:, n], shapes[:, n]), places(batch[WHOLE][n], batch[SHAPE][n])
        if "duration" in shares:
            lasts, last = (model.timed.lasts(frames)[..., None] for frames in (x[:, n], batch[WHOLE][n]))
            shares["duration"].append(within(lasts, last, deviations.time))
        shares["surface"].append(within(drawn, truth))
        shares["seen"].append(within(drawn, truth, noise))
        found["spread"].append(1000 * float(drawn.var(0).mean().sqrt()))
        found["error"].append(1000 * float((drawn.mean(0) - truth).square().mean().sqrt()))
    made, theirs = (model.vertices(*each) for each in ((done.x, done.shape), (batch[WHOLE], batch[SHAPE])))
    held_by = {
        holds(what, level): (100 * share).tolist()
        for what, each in shares.items()
        for level, share in zip(LEVELS, torch.stack(each, 1), strict=True)
    }
    vertices = millimetres(bodies.vertex_error(made, theirs))
    return scored(held, {OURS: {"khat": khat.tolist(), "vertices": vertices, **found, **held_by, **ended(done)}})


def holds(what: str, level: float) -> str:
    """The name of how much intervals of a level hold, in per cent."""
    return f"{what}, {100 * level:.0f} % (%)"


# Tables


def curves(out: Path) -> dict[str, Row]:
    """Return the rows with errors by time."""
    ours, others = (read_all(out, name) for name in ("prediction", "references"))
    named = {OURS: ours, UNTOLD: ours, NEAR: ours, SUP: others, STILL: others}
    return {name: replace(row, name=name) for name, row in named.items() if row is not None}


def by_time(drawn: Mapping[str, Row]) -> Table:
    """Rows down, time across in tenths of a second; and how much less is off than residual-sup's."""
    first = next(iter(drawn.values()))
    times = [time for time in first.runs[0]["times"] if time > SECONDS and abs(10 * time - round(10 * time)) < 1e-3]
    lines = [[name, *(row.said(at(time)) for time in times)] for name, row in drawn.items()]
    if {OURS, SUP} <= drawn.keys():
        less = [drawn[OURS].estimate(at(time), drawn[SUP]) for time in times]
        lines.append([f"{OURS} minus {SUP}, 95 %", *(interval(each, alone=True) for each in less)])
    lines.append(["segments", *(str(int(np.isfinite(first.values(at(time))[0]).sum())) for time in times)])
    return Table(["mm", *(f"{time:.1f} s" for time in times)], lines)


def of_sights(out: Path, sights: Iterable[Any], name: str = "{}") -> dict[Any, Row]:
    """Return the measured rows by observation."""
    found = {sight: read_all(out, folder(name.format(sight))) for sight in sights}
    return {sight: row for sight, row in found.items() if row is not None}


def completions(found: Mapping[Sight, Row]) -> Table:
    """Return a table of errors, one row for each observation."""

    def more(sight: Sight) -> str:
        whole = found.get(replace(sight, frames=ALL))
        if whole is None:
            return "–"
        return spread(100 * (found[sight].by_seed("chamfer") / whole.by_seed("chamfer") - 1), 1)

    columns: dict[str, Callable[[Sight], str]] = {
        "Chamfer (mm)": lambda sight: found[sight].said("chamfer"),
        "95 %": lambda sight: interval(found[sight].estimate("chamfer"), alone=True),
        "more than all frames (%)": more,
        "floor (mm)": lambda sight: found[sight].said("floor"),
        "to points seen (mm)": lambda sight: found[sight].said("seen"),
        "vertices (mm)": lambda sight: found[sight].said("vertices"),
        "duration (ms)": lambda sight: found[sight].said("duration"),
        "left (nats)": lambda sight: f"{np.median(found[sight].values('left')):.2g}",
    }
    return tabled({str(sight): sight for sight in found}, columns, "seen")


def sureness(found: Mapping[Any, Row], levels: Sequence[float] = LEVELS) -> Table:
    """Return a table of interval coverage and convergence, one row for each observation or setting."""

    def share(row: Row, name: str, off: Callable[[np.ndarray], np.ndarray]) -> str:
        return f"{100 * off(row.values(name)).mean():.0f}"

    held = [holds(what, level) for what in ("surface", "seen", "duration") for level in levels]
    columns: dict[str, Callable[[Row], str]] = {
        "vertices (mm)": lambda row: row.said("vertices"),
        "off (mm)": lambda row: row.said("error"),
        "sure to (mm)": lambda row: row.said("spread"),
        **{name: partial(Row.said, score=name, digits=0) for name in held},
        "k-hat above 0.7 (%)": lambda row: share(row, "khat", lambda khat: khat > 0.7),
        "converged (%)": lambda row: share(row, "left", lambda left: np.abs(left) < CONVERGED),
        "starts agree (%)": lambda row: share(row, "behind", lambda behind: np.abs(behind) < CONVERGED),
        "bent": lambda row: f"{row.values('bent').mean():.1f}",
        "seconds": lambda row: f"{np.mean([run['seconds'] for run in row.runs]):.0f}",
    }
    return tabled({str(name): row for name, row in found.items()}, columns)


def tables(out: Path) -> dict[str, Table]:
    """Return all available tables."""
    found = {}
    if drawn := curves(out):
        found["prediction"] = by_time(drawn)
    for across, sights in SIGHTS.items():
        if there := of_sights(out, sights):
            found[f"completion-{across}"] = completions(there)
    if sure := of_sights(out, SURE, "sure of {}"):
        found["completion-uncertainty"] = sureness(sure)
    if chosen := of_sights(out, tried()):
        found["completion-tuning"] = sureness(chosen, levels=LEVELS[1:2])
    return {f"motion_latent_4d/{name}": table for name, table in found.items()}


@styled
def draw(out: Path, file: Path) -> None:
    """Errors by time; and boxes over segments by points and by frames, as the paper's figures 6 and 7."""
    drawn, crossed = curves(out), of_sights(out, [sight for sights in SIGHTS.values() for sight in sights])
    if not drawn and not crossed:
        return
    figure = new_figure(7, 2.6)
    first, *panels = figure.subplots(1, 3)
    highest = 0.0  # of all but the last frame held, which leaves the picture
    for name, row in drawn.items():
        known = {time: row.estimate(at(time)) for time in row.runs[0]["times"]}
        points = {time: each for time, each in known.items() if each is not None}
        means = [each.mean for each in points.values()]
        highest = max(highest, *means) if name != STILL else highest
        (line,) = first.plot([*points], means, label=name)
        ends = zip(*(each.interval(error="sequences") for each in points.values()), strict=True)
        first.fill_between([*points], *ends, color=line.get_color(), alpha=0.15, lw=0)
    first.axvline(SECONDS, color="grey", lw=0.8, ls="--")
    first.set(xlabel="time (s)", title="vertex error (mm)", ylim=(0, 1.2 * highest or None))
    first.legend()

    def boxes(panel: Any, across: Sequence[int], label: str, ways: Mapping[str, Sequence[Sight]]) -> None:
        for place, (way, sights) in enumerate(ways.items()):
            found = {n: np.concatenate(crossed[s].values("chamfer")) for n, s in enumerate(sights) if s in crossed}
            if found:
                where = {"positions": [n + 0.25 * (place - 1) for n in found], "widths": 0.2, "manage_ticks": False}
                made = panel.boxplot(list(found.values()), flierprops={"markersize": 2}, **where)
                for line in itertools.chain(*made.values()):
                    line.set_color(f"C{place}")
                panel.plot([], [], color=f"C{place}", label=way)
        panel.set_xticks(range(len(across)), [str(value) for value in across])
        panel.set(xlabel=label, title="Chamfer distance (mm)", ylim=(0, None))

    ways = {"points": False, "points and markers": True}
    points = {way: [Sight(many, ALL, markers) for many in POINTS] for way, markers in ways.items()}
    frames = {way: [Sight(FEW, many, markers) for many in FRAMES] for way, markers in ways.items()}
    alone = [Sight(0, many, True) for many in FRAMES]
    boxes(panels[0], POINTS, f"points a frame, {ALL} frames", {**points, "markers alone": [Sight(0, ALL, True)]})
    boxes(panels[1], FRAMES, f"frames, {FEW} points in each", {**frames, "markers alone": alone})
    if panels[1].get_legend_handles_labels()[1]:
        panels[1].legend()
    figure.savefig(file, dpi=200)


def tried() -> dict[str, tuple[Any, Deviations, dvae.Descent, bool]]:
    """Return the tuning settings by name: observation, deviations, descent, and whether the prior uses segments."""
    found: dict[str, tuple[Any, Deviations, dvae.Descent, bool]] = {}
    for sight in SURE:
        kind = KINDS[str(sight)]
        for value, (prior, aggregate) in itertools.product(TRIED[kind], PRIORS.items()):
            how = replace(DEVIATIONS, **{kind: value}), DESCENT, aggregate
            found[f"{sight}, {prior} prior, {kind} {value:g}"] = sight, *how
        for descent in DESCENTS:
            told = f"{descent.steps} steps, rate {descent.rate:g}, {descent.starts} starts"
            found[f"{sight}, {told}"] = sight, DEVIATIONS, descent, True
    return found


def main(
    data: Path | None = None,
    runs: tuple[Path, ...] = (),
    tuned: Path | None = None,
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
        tuned: directory of a run fitted on file group A.
        out: directory of the measurements, in a folder per run.
        results: folder of the tables, such as benchmarks/results; None prints them.
        picture: file of the picture of errors over time and completions.
        parts: prediction, completion, uncertainty, tuning.
        budget: limits of computation.
    """
    torch.set_num_threads(1)
    refuse_unknown("part", parts, PARTS)
    for seed, path in enumerate(runs):
        here, sup, all_of_it = out / path.name, out / f"{SUP}-{seed}", Held(path, data, budget)
        if "prediction" in parts:
            kept(here / "prediction.json", partial(prediction, all_of_it))
            kept(sup / "references.json", partial(beside, all_of_it, seed, sup))
        some = replace(all_of_it, some=True)
        for sight in dict.fromkeys(itertools.chain(*SIGHTS.values())) if "completion" in parts else ():
            kept(here / f"{folder(sight)}.json", partial(completed, some, sight))
        for sight in SURE if "uncertainty" in parts else ():
            kept(here / f"{folder(f'sure of {sight}')}.json", partial(certain, some, sight, DEVIATIONS, DESCENT))
    if tuned is not None and "tuning" in parts:
        held = Held(tuned, data, budget, some=True, grouped=True)
        for name, choice in tried().items():
            kept(out / TUNING / f"{folder(name)}.json", partial(certain, held, *choice))
    write(results, tables(out))
    draw(out, picture)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
