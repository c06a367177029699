"""Commands on latent spaces of segments: interpolate, recover."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from math import pi
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro

from .. import motion
from ..data.sequences import Batch
from ..data.views import WHOLE
from ..inference.diagnostics.posteriors import Descent
from ..inference.training.checkpoints import CheckpointError
from ..motion.segments.completion import Deviations, glimpsed
from ..motion.segments.dataset import thinned
from ..motion.segments.embodied import SHAPE
from ..motion.segments.frames import resting_offsets
from ..motion.segments.interpolation import Interpolation
from ..motion.segments.interpolation import interpolate as interpolate_segments
from ..motion.segments.recovery import Recovered, read_seen
from ..motion.segments.recovery import recover as recover_segments
from ..options import Positive, Range, check
from ..runs import directory as runs
from . import opening
from .console import ERROR, OUT, Failed, UsageError, at_least, check_files, note

MOST_STEPS = MOST_DRAWS = 100

MOST_KNOWN = 500
"""Segments for training, of whose latents the prior is, and where a search may start."""

APART, FARTHER = 3.0, 1.3
"""Nats by which a search may still fall, and deviations that segments may be from what was seen, without a note."""


def interpolate(
    run: Annotated[Path, tyro.conf.Positional],
    first: Annotated[str, tyro.conf.arg(name="from")],
    second: Annotated[str, tyro.conf.arg(name="to")],
    out: Path | None = None,
    steps: int = 9,
    fps: float | None = None,
    data: str | None = None,
    failed: Failed = False,
) -> None:
    """Go from one segment to another on the straight line in the latent space of a run, motion and body together.

    Prints how long each step lasts, how far it gets, and how far its poses are from those of the first.

    A name that ends in .npz gets all steps as clips of a motion file, which `dvae animate` plays, in .html a page on
    which they move side by side. BVH is of one body: .bvh gets the step in the middle, and a name without an ending is
    a new folder with a file for each step.

    Args:
        run: the run directory of a motion-latent.
        first: name of the segment to start from; or of a take, of which it is the first one; or split/name.
        second: likewise where to go.
        out: the file to write.
        steps: both ends included.
        fps: frames per second of what is written; by default those of the data that the run was fitted on.
        data: where the data lie now, if the path in the run no longer leads there; or other data.
    """
    at_least(2, steps=steps)
    if steps > MOST_STEPS:
        raise UsageError(f"--steps is {steps}; it must be at most {MOST_STEPS}")
    if fps is not None and not 1 <= fps <= 1000:
        raise UsageError(f"--fps is {fps:g}; it must be between 1 and 1000")
    check_files(out, None, ".npz", ".html", ".htm", ".bvh", "")
    loaded = opening.load_run(run, data, "segments", failed)
    opened = opening.data_of(data, loaded)
    ends = [opened.found(name) for name in (first, second)]
    found = interpolate_segments(loaded.model, ends[0].all(), ends[1].all(), steps)
    if out is not None:
        _write(out, found, fps)
        names = " to ".join(end.motion.clips[0].name for end in ends)
        ERROR.print(f"wrote {out}: {steps} steps from {names}")
    OUT.print(found.table())


def _write(out: Path, found: Interpolation, fps: float | None) -> None:
    """Steps as a motion file, a page, the middle one as BVH, or a folder of these."""
    steps, suffix = found.motion(fps=fps), out.suffix.lower()
    if suffix == ".npz":
        motion.write_motion(out, steps)
    elif suffix in (".html", ".htm"):
        told = zip(found.shares.tolist(), found.durations[0].tolist(), strict=True)
        _save_page(out, steps, [f"{share:.2f}: {seconds:.2f} s" for share, seconds in told])
    elif suffix:
        motion.write_motion(out, _alone(steps, steps.clips[len(steps) // 2]))
    else:
        for clip in steps:
            motion.write_motion(out / f"{clip.name}.bvh", _alone(steps, clip))


def _save_page(out: Path, made: motion.MotionSet, names: Sequence[str], truth: motion.MotionSet | None = None) -> None:
    """Clips that move side by side; who is done stays as it ends."""
    from ..motion.drawing.plot import animate, save_html

    clips = [*made, *(truth or ())]
    frames = max(clip.frames for clip in clips)
    still = np.stack([np.pad(c.positions, ((0, frames - c.frames), (0, 0), (0, 0)), mode="edge") for c in clips])
    samples, real = still[: len(made), 1:], None if truth is None else still[-1, 1:]
    save_html(animate(made.skeleton, still[0, :1], samples, real, names=names), out)


def _alone(made: motion.MotionSet, clip: motion.Clip) -> motion.MotionSet:
    """One of the clips, with the rest pose of its own body."""
    alone = replace(made, clips=[clip])
    rest = tuple(resting_offsets(alone).flatten().tolist())
    return replace(alone, skeleton=replace(made.skeleton, rest=rest))


@dataclass(frozen=True)
class Glimpse:
    """What is seen of known segments.

    Args:
        seen: of the segments that --from names.
        seconds: that are seen, from the start on; all by default.
        fps: moments a second that are seen; 30 by default.
        frames: that are seen in place of these, so many of the 100 of a segment, evenly, at times that nobody knows.
        points: seen of the surface at each moment.
        gaps: share of points or markers that are missing.
        known_body: the shape of the body is known, and not looked for.
    """

    seen: Literal["surfaces", "points", "markers"] | None = None
    seconds: Positive | None = None
    fps: Annotated[float, Range(1, 1000)] | None = None
    frames: Annotated[int, Range(1, 1000)] | None = None
    points: Annotated[int, Range(1, 10_000)] = 50
    gaps: Annotated[float, Range(0, 1, below=True)] = 0.0
    known_body: bool = False

    def __post_init__(self) -> None:
        check(self)
        if self.frames is not None and (self.seconds, self.fps) != (None, None):
            raise ValueError("--frames are seen at unknown times, --seconds and --fps at known ones; give either")

    def of(self, model: Any, truth: Batch, seed: int) -> dict[str, torch.Tensor]:
        """What is seen of x (B, N, D) and beta (B, S)."""
        if self.seen is None:
            raise UsageError("--from names what is looked at, and --seen what of it: surfaces, points or markers")
        if self.seen != "points" and self.points != Glimpse.points:
            raise UsageError(f"--points says how many are seen of a surface; --seen is {self.seen}")
        if self.seen == "surfaces" and self.gaps:
            raise UsageError("--gaps are of points or markers; surfaces are seen as a whole")
        x, shape = truth[WHOLE], truth[SHAPE]
        chosen = None
        if self.frames is not None:
            if self.frames > model.timed.frames:
                raise UsageError(f"--frames is {self.frames}; segments of this run have {model.timed.frames}")
            chosen = np.linspace(0, model.timed.frames - 1, self.frames).round().tolist()
        how: dict[str, Any] = {"seconds": self.seconds, "frames": chosen, "points": self.points, "gaps": self.gaps}
        found = glimpsed(model, x, shape, self.seen, fps=self.fps or 30.0, seed=seed, **how)
        return found | ({SHAPE: shape} if self.known_body else {})


def recover(
    run: Annotated[Path, tyro.conf.Positional],
    glimpse: Glimpse,
    deviations: Deviations,
    descent: Descent,
    source: Annotated[tuple[str, ...], tyro.conf.arg(name="from")] = (),
    file: Path | None = None,
    aggregate: bool = True,
    draws: int = 5,
    out: Path | None = None,
    seed: int = 0,
    data: str | None = None,
    failed: Failed = False,
) -> None:
    """Recover whole segments, with their timing and bodies, from what was seen of them.

    What was seen is a glimpse of known segments (--from NAME --seen KIND), to see how well the rest is found: their
    first quarter of a second (--seen surfaces --seconds .25), a few points of the surface, markers, or some frames at
    unknown times. Or it is a --file of somebody's own: an npz of arrays `times` (K,) in seconds or `frames` (K,) of
    100, and some of `surfaces` (K, vertices, 3), `points` (K, any, 3) and `markers` (K, 16, 3) in metres, NaN where
    nothing was seen; `beta` (S,) where the body is known; or of several segments, (B, K, ...). Somebody starts at the
    origin, facing heading zero.

    Prints what was found: how long it lasts and how far it gets, with intervals, how far it is from what was seen and,
    where that is known, from the truth, and how surely it is the most probable one.

    A name that ends in .npz gets the most probable segments and draws from the posterior as clips of a motion file. Of
    one segment, .html gets a page on which truth, the most probable and draws move side by side, .bvh the most
    probable. A name without an ending is a new folder, with a BVH file for each clip.

    Args:
        run: the run directory of a motion-latent.
        glimpse: what is seen of known segments.
        deviations: how far what was seen is from what the model makes, standard deviations.
        descent: how the most probable segments are looked for.
        source: names of segments; or of takes, of which it is the first one; or split/name.
        file: what somebody has seen, instead.
        aggregate: z has for its prior a normal of all latents of known segments, in place of N(0, I).
        draws: from the posterior, to write.
        out: the file to write.
        seed: of starts, draws and glimpses.
        data: where the data lie now, if the path in the run no longer leads there; or other data. Latents of known
            segments, of other takes, are starts of the search, and make the prior.
    """
    at_least(0, draws=draws)
    if draws > MOST_DRAWS:
        raise UsageError(f"--draws is {draws}; it must be at most {MOST_DRAWS}")
    check_files(out, None, ".npz", ".html", ".htm", ".bvh", "")
    if bool(source) == (file is not None):
        raise UsageError("give what was seen, either of the run's segments (--from NAME --seen KIND) or as a --file")
    if file is not None and glimpse != Glimpse():
        raise UsageError("a --file says all that was seen; --seen and what goes with it are about segments of --from")
    loaded = opening.load_run(run, data, "segments", failed)
    model, truth, takes = loaded.model, None, set()
    if file is None:
        opened = opening.data_of(data, loaded)
        chosen = [opened.found(name) for name in source]
        clips = [clip for each in chosen for clip in each.motion]
        keys, takes = [clip.key for clip in clips], {clip.labels["source"] for clip in clips}
        if len({*keys}) < len(keys):
            raise UsageError(f"--from {' '.join(source)} names a segment twice")
        truth = {name: torch.cat([each.all()[name] for each in chosen]) for name in (WHOLE, SHAPE)}
        seen = glimpse.of(model, truth, seed)
    else:
        seen, opened = read_seen(file, model), _known_data(loaded, data)
        keys = [("seen", f"segment-{n:02d}") for n in range(len(next(iter(seen.values()))))]
    if out is not None and out.suffix.lower() not in (".npz", "") and len(keys) > 1:
        raise UsageError(f"--out {out} shows one segment, of {len(keys)}; end its name in .npz, or in nothing")
    known = None if opened is None else _known(opened, takes)
    how: dict[str, Any] = {"truth": truth, "deviations": deviations, "known": known, "descent": descent}
    how["aggregate"] = aggregate
    found = recover_segments(model, seen, keys, **how, seed=seed, progress=True)
    for doubt in _doubts(found, deviations):
        note(doubt)
    if out is not None:
        drawn = 0 if out.suffix.lower() == ".bvh" else draws
        _write_recovered(out, found, drawn)
        names = ", ".join(map("/".join, keys))
        ERROR.print(f"wrote {out}: {names}, the most probable" + f" and {drawn} draws of each" * (drawn > 0))
    OUT.print(found.table())


def _known_data(loaded: runs.Loaded, data: str | None) -> Any:
    """The data of a run, or other data; None where its own are gone."""
    try:
        return opening.data_of(data, loaded)
    except CheckpointError as error:
        note(f"no segments are known, so that N(0, I) is the prior, and the search starts from it alone: {error}")
        return None


def _known(opened: Any, takes: Collection[str]) -> Batch | None:
    """Some segments for training, of other takes than these."""
    others = [clip for clip in opened.segments if clip.split == "train" and clip.labels["source"] not in takes]
    clips = thinned(others, MOST_KNOWN)
    return motion.Segments(replace(opened.segments, clips=clips), opened.timed).all() if clips else None


def _doubts(found: Recovered, deviations: Deviations) -> Iterator[str]:
    """What whoever reads the table should know of it."""
    left = found.found.posterior.left
    if many := int((left > APART).sum()):
        yield (
            f"{many} of {len(left)} segments not converged, with up to {float(left.max()):,.0f} nats left; give more "
            "--steps or --starts, or allow for larger deviations"
        )
    for name, away in found.away.items():
        option, allowed = name.removesuffix("s"), deviations.of(name)
        apart = float(away.max()) / (8 / pi) ** 0.5  # the mean length of three normal coordinates
        if apart > FARTHER * allowed:
            yield (
                f"the {name} are up to {1000 * float(away.max()):.0f} mm from what this run makes, and --{option} "
                f"{allowed:g} allows for {1000 * allowed:g} mm in each coordinate: intervals are too narrow; try "
                f"--{option} {apart:.2g}"
            )


def _write_recovered(out: Path, found: Recovered, draws: int) -> None:
    """The most probable segments and draws as a motion file, a page of one, its BVH, or a folder of these."""
    made, suffix = found.motion(draws), out.suffix.lower()
    if suffix == ".npz":
        motion.write_motion(out, made)
    elif suffix in (".html", ".htm"):
        names = ["most probable", *(f"draw {n}" for n in range(1, draws + 1))]
        _save_page(out, made, names, found.true_motion())
    elif suffix:
        motion.write_motion(out, _alone(made, made.clips[0]))
    else:
        for clip in made:
            motion.write_motion(out, _alone(made, clip), "bvh")
