"""Measures prediction and completion by fitted runs of motion-latent, and writes their tables and pictures.

Everything measured has a file under `--out`: the script goes on where it was stopped, skips what is there, and two of
it may work on other parts or runs at once. Tables are of what is there, over all runs, which are seeds of one fit:

    prediction    of the rest from the first quarter of a second, beside residual-sup and the last frame held
    completion    from M points a frame in all of 100 frames, and from few of them, with and without 16 markers
    grid          all M times all numbers of frames
    uncertainty   what intervals hold of surfaces and durations, k-hat, and whether descents converge
    tuning        deviations and descents, by a run that was fitted on file group A alone (`--tuned`), judged on B

Residual-sup (Martinez et al. 2017, arXiv 1705.02445) is the network of mix-and-match without noise that adds velocities
to poses, on quaternions and places, fitted to the takes of the same training segments on the same body.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor

import dvae
from dvae import motion
from dvae.data.batch import WHOLE
from dvae.inference.evaluation.estimates import Crossed
from dvae.inference.evaluation.result import canvas
from dvae.inference.training.checkpoints import LAST, load_weights
from dvae.motion import bodies
from dvae.motion.geometry.rotations import to_matrix
from dvae.motion.geometry.skeleton import rotate_about_up
from dvae.motion.segments.completion import (
    Completed,
    Deviations,
    chamfer,
    complete,
    error_by_time,
    glimpsed,
    scanned,
    surfaces_at,
)
from dvae.motion.segments.dataset import SegmentData, thinned
from dvae.motion.segments.embodied import SHAPE, Segments

from .engine import fitted, folder, interval, kept, said
from .pages import DOCS, table, write

PARTS = ("prediction", "completion", "grid", "uncertainty", "tuning")
MARKS, TUNING = "completion", "tuning"
DEVIATIONS, DESCENT = Deviations(), dvae.Descent()
"""Chosen by the part "tuning"."""
SECONDS, HORIZON = 0.25, 1.2
RESIDUAL: dict[str, Any] = {"alpha": 0.0, "velocity": True, "width": 256}
TRAINING: dict[str, Any] = {"batch_size": 32, "learning_rate": 2e-3, "decay": 0.5}
OURS, UNTOLD, SUP, STILL, NEAR = "ours", "ours, body unknown", "residual-sup", "last frame held", "reconstruction"
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
    """What it may cost.

    Args:
        every: test segments that are predicted, each so many-th.
        some: test segments that are completed from each kind of what was seen.
        known: training segments, which are starts of descents, and of which the prior is.
        steps: of training residual-sup.
        dense: points of the true surface in each frame from which completed ones are measured.
    """

    every: int = 1
    some: int = 40
    known: int = 500
    steps: int = 3000
    dense: int = 500


@dataclass(frozen=True)
class Sight:
    """What is seen of segments, beside when.

    Args:
        points: in a frame, M.
        frames: of 100, evenly.
        markers: whether the 16 are seen too.
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
            seen |= glimpsed(model, x, batch[SHAPE], kind, frames=frames.tolist(), points=self.points)
        return seen


@dataclass(frozen=True)
class Beginning:
    """What is seen of segments: all of the first quarter of a second.

    Args:
        told: whether bodies are known.
    """

    told: bool = True

    def __str__(self) -> str:
        return f"first {SECONDS} s{'' if self.told else ', body unknown'}"

    def of(self, model: Any, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """At the rate of the data."""
        fps = model.timed.skeleton.fps
        seen = glimpsed(model, batch[WHOLE], batch[SHAPE], "surfaces", fps=fps, seconds=SECONDS)
        return {**seen, SHAPE: batch[SHAPE]} if self.told else seen


SIGHTS = {
    "7a": [Sight(points, ALL, markers) for points in POINTS for markers in (False, True)],
    "7b": [Sight(FEW, frames, markers) for frames in FRAMES for markers in (False, True)],
    "markers alone": [Sight(0, frames, True) for frames in FRAMES],
}
GRID = [Sight(points, frames, markers) for markers in (False, True) for points in POINTS for frames in FRAMES]
SURE = [Beginning(), Sight(0, 10, True), Sight(FEW, 20)]
"""Of which intervals are judged, and deviations chosen, each one of a kind."""
TRIED = {"surface": (0.005, 0.01, 0.02, 0.05, 0.1), "marker": (0.005, 0.01, 0.02, 0.05, 0.1)}
TRIED |= {"point": (0.05, 0.1, 0.2)}
KINDS = dict(zip(map(str, SURE), ("surface", "marker", "point"), strict=True))
PRIORS = {"aggregate": True, "standard": False}
"""That of known segments, and N(0, I)."""
DESCENTS = [
    dvae.Descent(steps, rate, starts)
    for steps, rate, starts in (
        (100, 0.05, 1),
        (100, 0.05, 4),
        (100, 0.1, 4),
        (200, 0.05, 4),
        (200, 0.1, 4),
        (400, 0.05, 4),
        (200, 0.05, 8),
        (400, 0.1, 4),
    )
]


@dataclass(frozen=True, eq=False)
class Held:
    """Segments that a model has not seen.

    Args:
        model: of them.
        segments: as it sees them.
        known: of those for training.
    """

    model: Any
    segments: Segments
    known: Mapping[str, Tensor]

    @classmethod
    def of(cls, model: Any, people: motion.MotionSet, budget: Budget) -> Held:
        """Of segments in the splits train and test."""
        parts = {split: [clip for clip in people if clip.split == split] for split in ("train", "test")}
        known = replace(people, clips=thinned(parts["train"], budget.known))
        return cls(
            model,
            Segments(replace(people, clips=parts["test"][:: budget.every]), model.timed),
            Segments(known, model.timed).all(),
        )

    @property
    def takes(self) -> list[str]:
        """Of each."""
        return [clip.labels["source"] for clip in self.segments.motion]

    @property
    def batch(self) -> Mapping[str, Tensor]:
        """All of them."""
        return self.segments.all()

    def some(self, many: int) -> Held:
        """So many, evenly over all."""
        fewer = replace(self.segments.motion, clips=thinned(self.segments.motion.clips, many))
        return replace(self, segments=Segments(fewer, self.model.timed))

    def complete(
        self, seen: Mapping[str, Tensor], deviations: Deviations, descent: dvae.Descent, aggregate: bool = True
    ) -> Completed:
        """From what was seen."""
        how: dict[str, Any] = {"deviations": deviations, "descent": descent, "aggregate": aggregate}
        return complete(self.model, seen, **how, known=self.known)


class Source:
    """Segments of a file, cut when they are asked for."""

    def __init__(self, path: Path | str | None) -> None:
        self.path = path

    @cached_property
    def data(self) -> SegmentData:
        """Opened."""
        if self.path is None:
            sys.exit("something has not been measured yet; name the data and a run")
        return SegmentData.open(self.path)

    @cached_property
    def grouped(self) -> motion.MotionSet:
        """Those of file group A for training, of B for test."""
        found = self.data.segments
        splits = {"A": "train", "B": "test"}
        clips = [replace(clip, split=splits.get(clip.labels["file_group"], "unseen")) for clip in found]
        return replace(found, clips=clips)


@dataclass(frozen=True, eq=False)
class Run:
    """What is measured of a run.

    Args:
        path: of it.
        source: of the segments.
        budget: what it may cost.
        grouped: it was fitted on file group A, and is judged on B.
    """

    path: Path
    source: Source
    budget: Budget
    grouped: bool = False

    @cached_property
    def held(self) -> Held:
        """All segments that are predicted."""
        people = self.source.grouped if self.grouped else self.source.data.segments
        return Held.of(dvae.load(self.path).model, people, self.budget)

    @cached_property
    def some(self) -> Held:
        """Those that are completed."""
        return self.held.some(self.budget.some)

    def prediction(self) -> dict[str, Any]:
        """See `prediction`."""
        return prediction(self.held)

    def references(self, seed: int, out: Path) -> dict[str, Any]:
        """Beside which that is, for the same segments."""
        return references(self.held, recurrent(self.source.data, seed, out, self.budget))

    def completed(self, sight: Sight) -> dict[str, Any]:
        """See `completed`."""
        return completed(self.some, sight, self.budget.dense)

    def certain(self, sight: Any, *how: Any) -> dict[str, Any]:
        """See `certain`."""
        return certain(self.some, sight, *how)


def millimetres(values: Tensor) -> list[Any]:
    """Of metres, to a hundredth."""
    return (1000 * values.double()).round(decimals=2).tolist()  # type: ignore[no-any-return]


# Prediction


def moments(fps: float) -> tuple[list[float], int]:
    """Times of frames up to the horizon, and how many of them are seen."""
    return [n / fps for n in range(int(HORIZON * fps + 1e-3) + 1)], int(SECONDS * fps + 1e-3) + 1


def errors(held: Held, made: tuple[Tensor, Tensor], times: Sequence[float]) -> list[Any]:
    """Of each segment at each time, NaN behind its end."""
    batch = held.batch
    found = []
    for n in range(len(made[0])):
        ours, theirs = ((x[n : n + 1], shape[n : n + 1]) for x, shape in (made, (batch[WHOLE], batch[SHAPE])))
        found.append(error_by_time(held.model, ours, theirs, times)[0])
    return millimetres(torch.stack(found))


def prediction(held: Held) -> dict[str, Any]:
    """Errors by time of a run, and of what it makes of whole segments."""
    model, batch = held.model, held.batch
    times, _ = moments(held.segments.motion.skeleton.fps)
    found = {}
    for name, sight in ((OURS, Beginning()), (UNTOLD, Beginning(told=False))):
        done = held.complete(sight.of(model, batch), DEVIATIONS, DESCENT)
        found[name] = errors(held, (done.x, done.shape), times)
    with torch.no_grad():
        near = model.decode(model.encode(batch), batch[SHAPE])
    found[NEAR] = errors(held, (near, batch[SHAPE]), times)
    return {"takes": held.takes, "times": times, "errors": found}


def recurrent(data: SegmentData, seed: int, out: Path, budget: Budget) -> Any:
    """Residual-sup, fitted, or gone on with where it was stopped."""
    segments = data.segments
    sources = {clip.labels["source"] for clip in segments if clip.split == "train"}
    takes = bodies.fitted(data.motion, bodies.human())
    takes = replace(takes, clips=[clip for clip in takes if clip.split == "train" and clip.name in sources])
    windows = motion.windows(takes, protocol(takes.skeleton.fps), "train")
    method = dvae.method("mix-and-match", **RESIDUAL)
    torch.manual_seed(seed)
    model = method.build(windows)
    recipe = method.train(windows, None, budget.steps)
    told: dict[str, Any] = {"config": method.config(), "validate_every": max(budget.steps // 3, 1), **TRAINING}
    fitted(model, recipe, out=out, seed=seed, **told)
    load_weights(model, out / LAST)
    return model.eval()


def protocol(fps: float) -> motion.Protocol:
    """Windows of what is seen and of what is not, up to the horizon, that face ahead in the last frame seen."""
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
    places, turning = x[..., :3], model.turns.turning
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
    made_of = {name: millimetres(torch.stack(rows)) for name, rows in found.items()}
    return {"takes": held.takes, "times": times, "errors": made_of}


# Completion


def completed(held: Held, sight: Sight, dense: int) -> dict[str, Any]:
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
        points = scanned(truth, model.body.faces, dense, generator)
        found["chamfer"].append(chamfer(points, made).mean(-1))
        found["floor"].append(chamfer(points, truth).mean(-1))
        found["vertices"].append(bodies.vertex_error(made, truth))
        if sight.points:
            found["seen"].append(chamfer(seen["points"][one], made[:, frames]).mean(-1))
    lasts = model.timed.lasts(done.x) - model.timed.lasts(batch[WHOLE])
    return {
        "takes": held.takes,
        **{name: millimetres(torch.cat(each)) for name, each in found.items() if each},
        "duration": millimetres(lasts.abs()),
        **ended(done),
    }


def ended(done: Completed) -> dict[str, Any]:
    """Nats that a step of Newton's would still gain, and by which the second start ended behind the first."""
    posterior = done.posterior
    behind = posterior.behind[1] if len(posterior.behind) > 1 else torch.full_like(posterior.energy, torch.nan)
    return dict(zip(ENDS, (each.tolist() for each in (posterior.left, behind, posterior.bent)), strict=True))


def certain(
    held: Held, sight: Any, deviations: Deviations, descent: dvae.Descent, aggregate: bool = True
) -> dict[str, Any]:
    """What intervals hold, by segment: shares of vertices' coordinates, and of durations, by level; and what is off.

    Intervals are those of normals with the mean and variance of draws: of the surface alone, and with the deviation of
    what was seen beside, of what would be seen; of durations, where nobody saw the end, with that of times.
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

    found: dict[str, list[Any]] = {"surface": [], "seen": [], "spread": [], "error": []}
    found |= {} if isinstance(sight, Sight) else {"duration": []}
    for n in range(len(x[0])):
        drawn, truth = places(x[:, n], shapes[:, n]), places(batch[WHOLE][n], batch[SHAPE][n])
        if "duration" in found:
            lasts, last = (model.timed.lasts(frames)[..., None] for frames in (x[:, n], batch[WHOLE][n]))
            found["duration"].append(within(lasts, last, deviations.time).tolist())
        found["surface"].append(within(drawn, truth).tolist())
        found["seen"].append(within(drawn, truth, noise).tolist())
        found["spread"].append(1000 * float(drawn.var(0).mean().sqrt()))
        found["error"].append(1000 * float((drawn.mean(0) - truth).square().mean().sqrt()))
    made, theirs = (model.vertices(*each) for each in ((done.x, done.shape), (batch[WHOLE], batch[SHAPE])))
    vertices = millimetres(bodies.vertex_error(made, theirs))
    return {"takes": held.takes, "khat": khat.tolist(), "vertices": vertices, **found, **ended(done)}


# Tables


def over(rows: Sequence[Mapping[str, Any]], values: Sequence[Any]) -> Crossed | None:
    """Of values by segment (N,) of several runs, those that are none left out; None where no segment has one."""
    takes, place = np.unique(rows[0]["takes"], return_inverse=True)
    given = np.array(values, dtype=float)
    there = np.isfinite(given).all(0)
    weights = np.bincount(place[there], minlength=len(takes))
    some = weights > 0
    if not some.any():
        return None
    sums = np.stack([np.bincount(place[there], one[there], minlength=len(takes)) for one in given])
    return Crossed.of(sums[:, some] / weights[some], weights[some])


def mean(rows: Sequence[Mapping[str, Any]], name: str, digits: int = 1) -> str:
    """Of what runs measured by segment."""
    if not rows or any(name not in row for row in rows):
        return "–"
    found = over(rows, [row[name] for row in rows])
    return "–" if found is None else said(found.estimate(), digits)


def found_in(out: Path, name: str) -> list[dict[str, Any]]:
    """What all runs measured of a part."""
    return [json.loads(file.read_text()) for file in sorted(out.glob(f"*/{folder(name)}.json"))]


Curves = dict[str, tuple[list[Mapping[str, Any]], str]]
"""Row to the measurements that have it, and to its name in them."""


def curves(out: Path) -> Curves:
    """What has errors by time."""
    ours, others = found_in(out, "prediction"), found_in(out, "references")
    rows: Curves = {name: (ours, name) for name in (OURS, UNTOLD, NEAR)} if ours else {}
    return {**rows, **({name: (others, name) for name in (SUP, STILL)} if others else {})}


def at(rows: Sequence[Mapping[str, Any]], name: str, n: int) -> Crossed | None:
    """Errors of one time."""
    return over(rows, [[row[n] for row in one["errors"][name]] for one in rows])


def times_of(drawn: Curves) -> list[float]:
    """Of errors."""
    return next(rows[0]["times"] for rows, _ in drawn.values())  # type: ignore[no-any-return]


def by_time(drawn: Curves) -> str:
    """Rows down, time across in tenths of a second; and how much less is off than residual-sup's."""
    times = times_of(drawn)
    shown = [n for n, time in enumerate(times) if time > SECONDS and abs(10 * time - round(10 * time)) < 1e-3]
    lines = []
    for name, (rows, key) in drawn.items():
        cells = [at(rows, key, n) for n in shown]
        lines.append([name, *("–" if cell is None else said(cell.estimate()) for cell in cells)])
    if {OURS, SUP} <= drawn.keys():
        pairs = [(at(*drawn[OURS], n), at(*drawn[SUP], n)) for n in shown]
        less = [None if ours is None or theirs is None else ours.estimate(theirs) for ours, theirs in pairs]
        lines.append([f"{OURS} minus {SUP}, 95 %", *(interval(cell, alone=True) for cell in less)])
    rows = next(iter(drawn.values()))[0]
    many = [sum(row[n] is not None for row in next(iter(rows[0]["errors"].values()))) for n in shown]
    lines.append(["segments", *map(str, many)])
    return table(["mm", *(f"{times[n]:.1f} s" for n in shown)], lines)


def of_sights(out: Path, sights: Iterable[Sight]) -> dict[Sight, list[dict[str, Any]]]:
    """What was measured of completion, by what was seen."""
    return {sight: found for sight in sights if (found := found_in(out, str(sight)))}


def completions(found: Mapping[Sight, Sequence[Mapping[str, Any]]]) -> str:
    """What was seen down, errors across."""
    header = ["seen", "Chamfer (mm)", "95 %", "more than all frames (%)", "floor (mm)", "to points seen (mm)"]
    header += ["vertices (mm)", "duration (ms)", "left (nats)"]
    lines = []
    for sight, rows in found.items():
        whole = found.get(replace(sight, frames=ALL))
        chamfers = over(rows, [row["chamfer"] for row in rows])
        assert chamfers is not None
        more = [
            100 * float(np.mean(few["chamfer"]) / np.mean(every["chamfer"]) - 1)
            for few, every in zip(rows, whole or [], strict=bool(whole))
        ]
        lines.append(
            [
                str(sight),
                said(chamfers.estimate()),
                interval(chamfers.estimate(), alone=True),
                f"{np.mean(more):.1f} ({min(more):.1f}, {max(more):.1f})" if more else "–",
                *(mean(rows, name) for name in ("floor", "seen", "vertices", "duration")),
                f"{np.median(np.concatenate([row['left'] for row in rows])):.2g}",
            ]
        )
    return table(header, lines)


def grid(found: Mapping[Sight, Sequence[Mapping[str, Any]]], markers: bool, name: str) -> str:
    """Points down, frames across."""
    lines = [
        [str(points), *(mean(found.get(Sight(points, frames, markers), []), name) for frames in FRAMES)]
        for points in (*POINTS, *[0] * markers)
    ]
    return table(["points", *(f"{frames} frames" for frames in FRAMES)], lines)


def sureness(found: Mapping[str, Sequence[Mapping[str, Any]]], levels: Sequence[float] = LEVELS) -> str:
    """What was seen, or tried, down; what intervals hold and how descents end across."""
    held = [f"{what}, {100 * level:.0f} % (%)" for what in ("surface", "seen", "duration") for level in levels]
    header = ["", "vertices (mm)", "off (mm)", "sure to (mm)", *held, "k-hat above 0.7 (%)", "converged (%)"]
    header += ["starts agree (%)", "bent", "seconds"]
    lines = []
    for name, rows in found.items():
        cells = [
            over(rows, [[100 * segment[n] for segment in row[what]] for row in rows]) if what in rows[0] else None
            for what in ("surface", "seen", "duration")
            for n in map(LEVELS.index, levels)
        ]
        both = {key: np.concatenate([np.array(row[key], float) for row in rows]) for key in ("khat", *ENDS)}
        shares = [both["khat"] > 0.7, np.abs(both["left"]) < CONVERGED, np.abs(both["behind"]) < CONVERGED]
        lines.append(
            [
                name,
                *(mean(rows, key) for key in ("vertices", "error", "spread")),
                *("–" if cell is None else said(cell.estimate(), 0) for cell in cells),
                *(f"{100 * share.mean():.0f}" for share in shares),
                f"{both['bent'].mean():.1f}",
                f"{np.mean([row['seconds'] for row in rows]):.0f}",
            ]
        )
    return table(header, lines)


def sections(out: Path) -> list[str]:
    """All tables of what is there, with headings."""
    drawn, crossing = curves(out), [sight for sights in SIGHTS.values() for sight in sights]
    found = []
    if drawn:
        found += ["### Prediction\n", by_time(drawn)]
    if crossed := {name: there for name, sights in SIGHTS.items() if (there := of_sights(out, sights))}:
        found += ["### Completion\n", *(completions(there) for there in crossed.values())]
    everything = of_sights(out, [*GRID, *crossing])
    for markers in (False, True):
        if any(sight.markers == markers for sight in everything.keys() - {*crossing}):
            told = "with 16 markers" if markers else "without markers"
            for name in ("chamfer", "vertices"):
                found += [f"### All points and frames, {told}: {name} (mm)\n", grid(everything, markers, name)]
    if sure := {str(sight): rows for sight in SURE if (rows := found_in(out, f"sure of {sight}"))}:
        found += ["### Uncertainty\n", sureness(sure)]
    if chosen := {name: rows for name in tried() if (rows := found_in(out, name))}:
        found += ["### Tuning\n", sureness(chosen, levels=LEVELS[1:2])]
    return found


def draw(out: Path, file: Path) -> None:
    """Errors by time; and boxes over segments by points and by frames, as the paper's figures 6 and 7."""
    drawn, crossed = curves(out), of_sights(out, [sight for sights in SIGHTS.values() for sight in sights])
    if not drawn and not crossed:
        return
    figure = canvas(14, 3.4)
    first, *panels = figure.subplots(1, 3)
    highest = 0.0  # of all but the last frame held, which leaves the picture
    for place, (name, (rows, key)) in enumerate(drawn.items()):
        points = [(time, cell.estimate()) for n, time in enumerate(times_of(drawn)) if (cell := at(rows, key, n))]
        means = [estimate.mean for _, estimate in points]
        highest = max(highest, *means) if name != STILL else highest
        first.plot([time for time, _ in points], means, color=f"C{place}", label=name)
        lows, highs = zip(*(estimate.interval(error="sequences") for _, estimate in points), strict=True)
        first.fill_between([time for time, _ in points], lows, highs, color=f"C{place}", alpha=0.15, lw=0)
    first.axvline(SECONDS, color="grey", lw=0.8, ls="--")
    first.set(xlabel="time (s)", title="vertex error (mm)", ylim=(0, 1.2 * highest or None))
    first.legend(fontsize=7, frameon=False)
    ways = [("points", False), ("points and markers", True)]
    for panel, axis, across in ((panels[0], "points", POINTS), (panels[1], "frames", FRAMES)):
        for place, (label, markers) in enumerate([*ways, ("markers alone", True)]):
            alone = label == "markers alone"
            sights = [
                Sight(0 if alone else value, ALL, markers)
                if axis == "points"
                else Sight(0 if alone else FEW, value, markers)
                for value in (across[:1] if alone and axis == "points" else across)
            ]
            boxes = {
                n: np.concatenate([np.array(row["chamfer"], float) for row in crossed[sight]])
                for n, sight in enumerate(sights)
                if sight in crossed
            }
            if boxes:
                drawn_boxes = panel.boxplot(
                    list(boxes.values()),
                    positions=[n + 0.25 * (place - 1) for n in boxes],
                    widths=0.2,
                    flierprops={"markersize": 2},
                    manage_ticks=False,
                )
                for line in [line for lines in drawn_boxes.values() for line in lines]:
                    line.set_color(f"C{place}")
                panel.plot([], [], color=f"C{place}", label=label)
        panel.set_xticks(range(len(across)), [str(value) for value in across])
        told = f"points a frame, {ALL} frames" if axis == "points" else f"frames, {FEW} points in each"
        panel.set(xlabel=told, title="Chamfer distance (mm)", ylim=(0, None))
    if panels[1].get_legend_handles_labels()[1]:
        panels[1].legend(fontsize=7, frameon=False)
    figure.savefig(file, dpi=110)


def tried() -> dict[str, tuple[Any, Deviations, dvae.Descent, bool]]:
    """Of tuning: name to what is seen, deviations, descent, and whether the prior is of known segments."""
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
    page: Path | None = None,
    picture: Path = DOCS / "img" / "motion_latent_completion.png",
    parts: tuple[str, ...] = ("prediction", "completion", "uncertainty"),
    budget: Budget = Budget(),
) -> None:
    """Measure, and write the tables.

    Args:
        data: motion file (bandai2.npz), for what has not been measured yet.
        runs: directories of fitted runs, seeds of one fit; as many of residual-sup are fitted.
        tuned: that of a run that was fitted on file group A.
        out: where measurements are kept, under the name of each run.
        page: where the tables stand; they are printed where none is named.
        picture: of errors by time, and of completion.
        parts: prediction, completion, grid, uncertainty, tuning.
        budget: what it may cost.
    """
    torch.set_num_threads(1)
    if unknown := set(parts) - set(PARTS):
        sys.exit(f"no part {', '.join(sorted(unknown))}; parts are {', '.join(PARTS)}")
    source = Source(data)
    for seed, path in enumerate(runs):
        here, run = out / path.name, Run(path, source, budget)
        if "prediction" in parts:
            kept(here / "prediction.json", run.prediction)
            kept(out / f"{SUP}-{seed}" / "references.json", partial(run.references, seed, out / f"{SUP}-{seed}"))
        sights = [sight for some in SIGHTS.values() for sight in some] if "completion" in parts else []
        for sight in dict.fromkeys([*sights, *(GRID if "grid" in parts else [])]):
            kept(here / f"{folder(sight)}.json", partial(run.completed, sight))
        for sight in SURE if "uncertainty" in parts else []:
            kept(here / f"{folder(f'sure of {sight}')}.json", partial(run.certain, sight, DEVIATIONS, DESCENT))
    if tuned is not None:
        run = Run(tuned, source, budget, grouped=True)
        for name, choice in tried().items() if "tuning" in parts else ():
            kept(out / TUNING / f"{folder(name)}.json", partial(run.certain, *choice))
    found = sections(out)
    write(page, *found, name=MARKS)
    draw(out, picture)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
