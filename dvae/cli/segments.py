"""Recovery of whole segments of motion, for `dvae impute`."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import pi
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro

from .. import motion
from ..data.batch import WHOLE
from ..inference.diagnostics.posteriors import Descent
from ..inference.training.checkpoints import CheckpointError
from ..motion.segments.completion import Deviations, simulate_observations
from ..motion.segments.dataset import subsample_clips
from ..motion.segments.embodied import SHAPE
from ..motion.segments.frames import resting_offsets
from ..motion.segments.recovery import Recovered, read_seen
from ..motion.segments.recovery import recover as recover_segments
from ..options import Positive, Range, check
from ..runs import directory as runs
from . import loading
from .console import ERROR, OUT, UsageError, check_files, note
from .help import Expert

MOST_DRAWS = 100

MOST_KNOWN = 500
"""Maximum number of training segments whose latents define the prior and give starting points of the search."""

APART, FARTHER = 3.0, 1.3
"""Thresholds of the notes: nats that a search may still improve, and standard deviations from the observations."""


def _save_page(out: Path, made: motion.MotionSet, names: Sequence[str], truth: motion.MotionSet | None = None) -> None:
    """Write a page with clips that move side by side; a shorter clip keeps its last pose."""
    from ..motion.drawing.player import animate

    clips = [*made, *(truth or ())]
    frames = max(clip.frames for clip in clips)
    still = np.stack([np.pad(c.positions, ((0, frames - c.frames), (0, 0), (0, 0)), mode="edge") for c in clips])
    samples, real = still[: len(made), 1:], None if truth is None else still[-1, 1:]
    animate(made.skeleton, still[0, :1], samples, real, names=names).save(out)


def _alone(made: motion.MotionSet, clip: motion.Clip) -> motion.MotionSet:
    """Return one of the clips, with the rest pose of its own body."""
    alone = replace(made, clips=[clip])
    rest = tuple(resting_offsets(alone).flatten().tolist())
    return replace(alone, skeleton=replace(made.skeleton, rest=rest))


@dataclass(frozen=True)
class Glimpse:
    """Simulated observations of known segments.

    Args:
        seen: kind of observations of the segments in --from.
        seconds: observed duration from the start, in seconds; the whole segment by default.
        fps: observations per second; 30 by default.
        frames: number of evenly spaced frames, of the 100 of a segment, to observe at unknown times; replaces --seconds
            and --fps.
        points: number of surface points observed at each time.
        gaps: share of missing points or markers.
        known_body: the shape of the body is given, and not inferred.
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
            raise ValueError("--frames is for unknown times, --seconds and --fps are for known times; give only one")

    def of(self, model: Any, truth: Mapping[str, torch.Tensor], seed: int) -> dict[str, torch.Tensor]:
        """Return the observations of x (B, N, D) and beta (B, S)."""
        if self.seen is None:
            raise UsageError("--from requires --seen surfaces, points or markers")
        if self.seen != "points" and self.points != Glimpse.points:
            raise UsageError(f"--points is for --seen points; --seen is {self.seen}")
        if self.seen == "surfaces" and self.gaps:
            raise UsageError("--gaps is for points or markers; surfaces have no gaps")
        x, shape = truth[WHOLE], truth[SHAPE]
        chosen = None
        if self.frames is not None:
            if self.frames > model.timed.frames:
                raise UsageError(f"--frames is {self.frames}; segments of this run have {model.timed.frames}")
            chosen = np.linspace(0, model.timed.frames - 1, self.frames).round().tolist()
        how: dict[str, Any] = {"seconds": self.seconds, "frames": chosen, "points": self.points, "gaps": self.gaps}
        found = simulate_observations(model, x, shape, self.seen, fps=self.fps or 30.0, seed=seed, **how)
        return found | ({SHAPE: shape} if self.known_body else {})


@dataclass(frozen=True)
class Recovery:
    """Recovery of segments with a run of motion-latent.

    Args:
        glimpse: simulated observations of known segments.
        deviations: standard deviations of the observations from the output of the model.
        descent: optimisation of the most probable segments.
        source: names of segments, or of takes, whose first segment is used; or split/name.
        file: your own observations, instead.
        aggregate: use a normal distribution fitted to the latents of known segments as prior of z, instead of N(0, I).
    """

    glimpse: Glimpse = Glimpse()
    deviations: Expert[Deviations] = field(default_factory=Deviations)
    descent: Expert[Descent] = field(default_factory=Descent)
    source: Annotated[tuple[str, ...], tyro.conf.arg(name="from")] = ()
    file: Path | None = None
    aggregate: Expert[bool] = True

    def run(self, run: Path, out: Path | None, draws: int, seed: int, data: str | None, failed: bool) -> None:
        """Recover segments, print the estimates with their uncertainty, and write them."""
        if draws > MOST_DRAWS:
            raise UsageError(f"--samples is {draws}; it must be at most {MOST_DRAWS}")
        check_files(out, None, ".npz", ".html", ".htm", ".bvh", "")
        if bool(self.source) == (self.file is not None):
            raise UsageError("give observations: --from NAME --seen KIND for segments of the run, or --file")
        if self.file is not None and self.glimpse != Glimpse():
            raise UsageError("--file contains all observations; --seen and its options are for segments in --from")
        loaded = loading.load_run(run, data, ("segments",), failed)
        model, truth, takes = loaded.model, None, set()
        if self.file is None:
            opened = loading.data_of(data, loaded)
            chosen = [opened.found(name) for name in self.source]
            clips = [clip for each in chosen for clip in each.motion]
            keys, takes = [clip.key for clip in clips], {clip.labels["source"] for clip in clips}
            if len({*keys}) < len(keys):
                raise UsageError(f"--from {' '.join(self.source)} names a segment twice")
            truth = {name: torch.cat([each.all()[name] for each in chosen]) for name in (WHOLE, SHAPE)}
            seen = self.glimpse.of(model, truth, seed)
        else:
            seen, opened = read_seen(self.file, model), _known_data(loaded, data)
            keys = [("seen", f"segment-{n:02d}") for n in range(len(next(iter(seen.values()))))]
        if out is not None and out.suffix.lower() not in (".npz", "") and len(keys) > 1:
            raise UsageError(
                f"--out {out} can show one of {len(keys)} segments; end its name in .npz, or use no suffix"
            )
        known = None if opened is None else _known(opened, takes)
        how: dict[str, Any] = {"truth": truth, "deviations": self.deviations, "known": known}
        how |= {"descent": self.descent, "aggregate": self.aggregate}
        found = recover_segments(model, seen, keys, **how, seed=seed, progress=True)
        for doubt in _doubts(found, self.deviations):
            note(doubt)
        if out is not None:
            drawn = 0 if out.suffix.lower() == ".bvh" else draws
            _write_recovered(out, found, drawn)
            names = ", ".join(map("/".join, keys))
            ERROR.print(f"wrote {out}: {names}, the most probable" + f" and {drawn} draws of each" * (drawn > 0))
        OUT.print(found.table())


def _known_data(loaded: runs.Loaded, data: str | None) -> Any:
    """Return the data of a run, or other data; None if the data are no longer available."""
    try:
        return loading.data_of(data, loaded)
    except CheckpointError as error:
        note(f"no known segments: the prior is N(0, I), and the search starts from this prior only: {error}")
        return None


def _known(opened: Any, takes: Collection[str]) -> Mapping[str, Any] | None:
    """Return training segments from takes other than `takes`; None without such segments."""
    others = [clip for clip in opened.segments if clip.split == "train" and clip.labels["source"] not in takes]
    clips = subsample_clips(others, MOST_KNOWN)
    return motion.Segments(replace(opened.segments, clips=clips), opened.timed).all() if clips else None


def _doubts(found: Recovered, deviations: Deviations) -> Iterator[str]:
    """Yield warnings for readers of the table."""
    left = found.found.posterior.left
    if many := int((left > APART).sum()):
        yield (
            f"{many} of {len(left)} segments not converged, with up to {float(left.max()):,.0f} nats left; give more "
            "--steps or --starts, or allow larger deviations"
        )
    for name, away in found.away.items():
        option, allowed = name.removesuffix("s"), deviations.of(name)
        apart = float(away.max()) / (8 / pi) ** 0.5  # the mean length of three normal coordinates
        if apart > FARTHER * allowed:
            yield (
                f"the {name} are up to {1000 * float(away.max()):.0f} mm from the output of this run, and --{option} "
                f"{allowed:g} allows {1000 * allowed:g} mm in each coordinate: intervals are too narrow; try "
                f"--{option} {apart:.2g}"
            )


def _write_recovered(out: Path, found: Recovered, draws: int) -> None:
    """Write the most probable segments and draws as a motion file, an html page, a BVH file, or a folder of these."""
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
