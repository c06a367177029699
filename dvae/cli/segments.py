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
from ..motion.segments.completion import Deviations, glimpsed
from ..motion.segments.dataset import thinned
from ..motion.segments.embodied import SHAPE
from ..motion.segments.frames import resting_offsets
from ..motion.segments.recovery import Recovered, read_seen
from ..motion.segments.recovery import recover as recover_segments
from ..options import Positive, Range, check
from ..runs import directory as runs
from . import opening
from .console import ERROR, OUT, UsageError, check_files, note
from .help import Expert

MOST_DRAWS = 100

MOST_KNOWN = 500
"""Segments for training, of whose latents the prior is, and where a search may start."""

APART, FARTHER = 3.0, 1.3
"""Nats by which a search may still fall, and deviations that segments may be from what was seen, without a note."""


def _save_page(out: Path, made: motion.MotionSet, names: Sequence[str], truth: motion.MotionSet | None = None) -> None:
    """Clips that move side by side; who is done stays as it ends."""
    from ..motion.drawing.player import animate

    clips = [*made, *(truth or ())]
    frames = max(clip.frames for clip in clips)
    still = np.stack([np.pad(c.positions, ((0, frames - c.frames), (0, 0), (0, 0)), mode="edge") for c in clips])
    samples, real = still[: len(made), 1:], None if truth is None else still[-1, 1:]
    animate(made.skeleton, still[0, :1], samples, real, names=names).save(out)


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

    def of(self, model: Any, truth: Mapping[str, torch.Tensor], seed: int) -> dict[str, torch.Tensor]:
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


@dataclass(frozen=True)
class Recovery:
    """How segments of a motion-latent are recovered.

    Args:
        glimpse: what is seen of known segments.
        deviations: standard deviations of what was seen from what the model makes.
        descent: how the most probable segments are looked for.
        source: names of segments; or of takes, whose first segment is taken; or split/name.
        file: observations of your own, instead.
        aggregate: the prior of z is a normal fitted to the latents of known segments, in place of N(0, I).
    """

    glimpse: Glimpse = Glimpse()
    deviations: Expert[Deviations] = field(default_factory=Deviations)
    descent: Expert[Descent] = field(default_factory=Descent)
    source: Annotated[tuple[str, ...], tyro.conf.arg(name="from")] = ()
    file: Path | None = None
    aggregate: Expert[bool] = True

    def run(self, run: Path, out: Path | None, draws: int, seed: int, data: str | None, failed: bool) -> None:
        """Recover segments, print what was found and how sure it is, and write them."""
        if draws > MOST_DRAWS:
            raise UsageError(f"--samples is {draws}; it must be at most {MOST_DRAWS}")
        check_files(out, None, ".npz", ".html", ".htm", ".bvh", "")
        if bool(self.source) == (self.file is not None):
            raise UsageError("give what was seen: --from NAME --seen KIND of the run's segments, or a --file")
        if self.file is not None and self.glimpse != Glimpse():
            raise UsageError("--file says all that was seen; --seen and its options are about segments of --from")
        loaded = opening.load_run(run, data, ("segments",), failed)
        model, truth, takes = loaded.model, None, set()
        if self.file is None:
            opened = opening.data_of(data, loaded)
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
            raise UsageError(f"--out {out} shows one segment, of {len(keys)}; end its name in .npz, or in nothing")
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
    """The data of a run, or other data; None where its own are gone."""
    try:
        return opening.data_of(data, loaded)
    except CheckpointError as error:
        note(f"no segments are known, so that N(0, I) is the prior, and the search starts from it alone: {error}")
        return None


def _known(opened: Any, takes: Collection[str]) -> Mapping[str, Any] | None:
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
