"""Commands on latent spaces of segments: interpolate."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from .. import motion
from ..motion.interpolation import Interpolation
from ..motion.interpolation import interpolate as interpolate_segments
from ..motion.segments import resting_offsets
from . import opening
from .console import ERROR, OUT, UsageError, at_least, check_files

MOST_STEPS = 100


def interpolate(
    run: Annotated[Path, tyro.conf.Positional],
    first: Annotated[str, tyro.conf.arg(name="from")],
    second: Annotated[str, tyro.conf.arg(name="to")],
    out: Path | None = None,
    steps: int = 9,
    fps: float | None = None,
    data: str | None = None,
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
    loaded = opening.load_run(run, data, "segments")
    opening.note_unfinished([loaded])
    opened = opening.data_of(data, loaded)
    ends = [opened.found(name) for name in (first, second)]
    found = interpolate_segments(loaded.model, ends[0].all(), ends[1].all(), steps)
    OUT.print(found.table())
    if out is not None:
        _write(out, found, fps)
        names = " to ".join(end.motion.clips[0].name for end in ends)
        ERROR.print(f"wrote {out}: {steps} steps from {names}")


def _write(out: Path, found: Interpolation, fps: float | None) -> None:
    """Steps as a motion file, a page, the middle one as BVH, or a folder of these."""
    steps, suffix = found.motion(fps=fps), out.suffix.lower()
    if suffix == ".npz":
        motion.write_motion(out, steps)
    elif suffix in (".html", ".htm"):
        from ..motion.plot import animate, save_html

        frames = max(clip.frames for clip in steps)
        still = [np.pad(c.positions, ((0, frames - c.frames), (0, 0), (0, 0)), mode="edge") for c in steps]
        told = zip(found.shares.tolist(), found.durations[0].tolist(), strict=True)
        names = [f"{share:.2f}: {seconds:.2f} s" for share, seconds in told]
        save_html(animate(steps.skeleton, still[0][:1], np.stack(still)[:, 1:], names=names), out)
    elif suffix:
        motion.write_motion(out, _alone(steps, steps.clips[len(steps) // 2]))
    else:
        for clip in steps:
            motion.write_motion(out / f"{clip.name}.bvh", _alone(steps, clip))


def _alone(steps: motion.MotionSet, clip: motion.Clip) -> motion.MotionSet:
    """One of the clips, with the rest pose of its own body."""
    alone = replace(steps, clips=[clip])
    rest = tuple(resting_offsets(alone).flatten().tolist())
    return replace(alone, skeleton=replace(steps.skeleton, rest=rest))
