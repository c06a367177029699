"""Whole segments of motion: their recovery for `dvae impute`, and `dvae generate`."""

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
from ..motion.segments.completion import SPOTS, TO_POINTS, Deviations, simulate_observations
from ..motion.segments.dataset import subsample_clips
from ..motion.segments.embodied import SHAPE
from ..motion.segments.frames import resting_offsets
from ..motion.segments.generation import (
    KNOWN,
    REAL,
    STANDARD,
    Generated,
    aggregate_posterior,
    priors,
    summarise,
    summary_table,
)
from ..motion.segments.generation import generate as generate_segments
from ..motion.segments.recovery import Recovered, read_seen
from ..motion.segments.recovery import recover as recover_segments
from ..options import Positive, Range, check
from ..runs import directory as runs
from . import loading
from .console import ERROR, OUT, Missing, UsageError, at_least, check_files, note
from .help import Expert
from .loading import ON_CPU, Use

MOST_DRAWS = 100

MOST_KNOWN = 500
"""Maximum number of training segments whose latents define the prior and give starting points of the search."""

APART, FARTHER = 3.0, 1.3
"""Thresholds of the notes: nats that a search may still improve, and standard deviations from the observations."""


def _save_page(
    out: Path, motions: motion.MotionSet, names: Sequence[str], truth: motion.MotionSet | None = None
) -> None:
    """Write a page with clips that move side by side; a shorter clip disappears at its end."""
    from ..motion.drawing.player import animate

    clips = [*motions, *(truth or ())]
    frames = max(clip.frames for clip in clips)
    padded = np.full((len(clips), frames, *clips[0].positions.shape[1:]), np.nan)
    for row, clip in zip(padded, clips, strict=True):
        row[: clip.frames] = clip.positions
    samples, real = padded[: len(motions)], None if truth is None else padded[-1]
    animate(motions.skeleton, samples[0, :0], samples, real, names=names).save(out)


def _single_clip(motions: motion.MotionSet, clip: motion.Clip) -> motion.MotionSet:
    """Return one of the clips, with the rest pose of its own body."""
    single = replace(motions, clips=[clip])
    rest = tuple(resting_offsets(single).flatten().tolist())
    return replace(single, skeleton=replace(motions.skeleton, rest=rest))


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
        gaps: share of points or markers to remove, at least 0 and below 1.
        known_body: whether the true body shape is given instead of inferred.
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

    def of(
        self, model: Any, truth: Mapping[str, torch.Tensor], markers: Sequence[int], seed: int
    ) -> dict[str, torch.Tensor]:
        """Return simulated observations of segments, given their x (B, N, D) and beta (B, S)."""
        if self.seen is None:
            raise UsageError("--from requires --seen surfaces, points or markers")
        if self.seen != "points" and self.points != Glimpse.points:
            raise UsageError(f"--points is for --seen points; --seen is {self.seen}")
        if self.seen == "surfaces" and self.gaps:
            raise UsageError("--gaps is for points or markers; surfaces have no gaps")
        x, shape = truth[WHOLE], truth[SHAPE]
        frames = None
        if self.frames is not None:
            if self.frames > model.timed.frames:
                raise UsageError(
                    f"--frames is {self.frames}; segments of this run have {model.timed.frames} frames; give fewer"
                )
            frames = np.linspace(0, model.timed.frames - 1, self.frames).round().tolist()
        options: dict[str, Any] = {"seconds": self.seconds, "frames": frames, "points": self.points, "gaps": self.gaps}
        options["markers"] = markers
        observations = simulate_observations(model, x, shape, self.seen, fps=self.fps or 30.0, seed=seed, **options)
        return observations | ({SHAPE: shape} if self.known_body else {})


@dataclass(frozen=True)
class Recovery:
    """Recovery of segments with a run of motion-latent.

    Args:
        glimpse: options of simulated observations of known segments.
        deviations: standard deviations of the observations from the output of the model.
        descent: options of the optimisation that finds the most probable segments.
        source: names of segments, or of takes, whose first segment is used; split/name if a name is not unique.
        file: npz file of your own observations, instead of simulated ones.
        aggregate: use a normal distribution fitted to the latents of known segments as prior of z, instead of N(0, I).
        two_way: for points: vertices far from all points are errors, too, as in a two-way Chamfer distance.
        marker_vertices: vertices of the body on which the markers are; those of the default body if empty.
    """

    glimpse: Glimpse = Glimpse()
    deviations: Expert[Deviations] = field(default_factory=Deviations)
    descent: Expert[Descent] = field(default_factory=Descent)
    source: Annotated[tuple[str, ...], tyro.conf.arg(name="from")] = ()
    file: Path | None = None
    aggregate: Expert[bool] = True
    two_way: Expert[bool] = False
    marker_vertices: Expert[tuple[int, ...]] = ()

    def run(self, run: Path, out: Path | None, draws: int, seed: int, data: str | None, use: Use) -> None:
        """Recover segments, print the estimates with their uncertainty, and write them."""
        if draws > MOST_DRAWS:
            raise UsageError(f"--samples is {draws}; it must be at most {MOST_DRAWS}")
        check_files(out, None, ".npz", ".html", ".htm", ".bvh", "")
        if bool(self.source) == (self.file is not None):
            raise UsageError("give observations: --from NAME --seen KIND for segments of the run, or --file")
        if self.file is not None and self.glimpse != Glimpse():
            raise UsageError("--file contains all observations; --seen and its options are for segments in --from")
        device = loading.device_of(use)
        loaded = loading.load_run(run, data, ("segments",), replace(use, accelerator="cpu"))
        model, truth, takes = loaded.model, None, set()
        if self.file is None:
            data_set = loading.data_of(data, loaded)
            selected = [data_set.segments_of(name) for name in self.source]
            clips = [clip for segments in selected for clip in segments.motion]
            keys, takes = [clip.key for clip in clips], {clip.labels["source"] for clip in clips}
            if len({*keys}) < len(keys):
                raise UsageError(f"--from {' '.join(self.source)} names a segment twice")
            truth = {name: torch.cat([segments.all()[name] for segments in selected]) for name in (WHOLE, SHAPE)}
            seen = self.glimpse.of(model, truth, self.marker_vertices, seed)
        else:
            seen, data_set = read_seen(self.file, model, self.marker_vertices), _known_data(loaded, data)
            keys = [("seen", f"segment-{n:02d}") for n in range(len(next(iter(seen.values()))))]
        if self.marker_vertices and SPOTS not in seen:
            raise UsageError("--marker-vertices is for markers, but the observations have none")
        if out is not None and out.suffix.lower() not in (".npz", "") and len(keys) > 1:
            raise UsageError(
                f"--out {out} can show one of {len(keys)} segments; end its name in .npz, or use no suffix"
            )
        model.to(device)  # not before, because observations are simulated on the CPU
        training_segments = None if data_set is None else _other_segments(data_set, takes)
        options: dict[str, Any] = {"truth": truth, "deviations": self.deviations, "known": training_segments}
        options |= {"descent": self.descent, "aggregate": self.aggregate, "two_way": self.two_way}
        options["markers"] = self.marker_vertices
        recovered = recover_segments(model, seen, keys, **options, seed=seed, progress=True)
        for warning in _warnings(recovered, self.deviations):
            note(warning)
        if out is not None:
            drawn = 0 if out.suffix.lower() == ".bvh" else draws
            _write_recovered(out, recovered, drawn)
            names = ", ".join(map("/".join, keys))
            ERROR.print(f"wrote {out}: {names}, the most probable" + f" and {drawn} draws of each" * (drawn > 0))
        OUT.print(recovered.table())


def generate(
    run: Annotated[Path, tyro.conf.Positional],
    out: Path | None = None,
    samples: int = 100,
    seconds: Positive | None = None,
    tolerance: Expert[Positive] = 0.05,
    beta: tuple[float, ...] | None = None,
    shown: Annotated[int, Range(1, MOST_DRAWS)] = 5,
    seed: int = 0,
    data: str | None = None,
    missing: Expert[Missing] = False,
    use: Use = ON_CPU,
) -> None:
    """Draw segments of motion from N(0, I), the prior of a run of motion-latent, and compare them with real ones.

    Prints means of statistics, such as speed, contact and sliding of the feet, for segments from the prior, from two
    distributions of the latents of training segments, and for real segments. Also prints how far these latents are
    from N(0, I); if they are far, raise --kl of the fit.

    Args:
        run: run directory.
        out: file for some segments: an npz, an html page with a real segment, or a folder of BVH files.
        samples: number of segments in the statistics.
        seconds: duration of the segments; by default the model draws it.
        tolerance: largest difference of a duration from --seconds.
        beta: shape of all bodies; by default segments have the bodies of test segments.
        shown: number of segments in --out.
        seed: seed of the draws.
        data: where the data are now, if the path in the run is no longer valid; or other data.
    """
    at_least(2, samples=samples)
    check_files(out, None, ".npz", ".html", ".htm", "")
    loaded = loading.load_run(run, data, ("segments",), use)
    model, data_set = loaded.model, loading.data_of(data, loaded, missing=missing)
    known, test = data_set.windows("train"), data_set.windows("test")
    parts = {"known": known.all(), "real": test.all()}
    if beta is not None:
        if len(beta) != (size := model.body.parameters_of_shape):
            raise UsageError(f"--beta has {len(beta)} numbers, expected {size}")
        shapes = {name: torch.tensor(beta).expand(len(part[SHAPE]), -1) for name, part in parts.items()}
        parts = {name: test.on_bodies(part, shapes[name]) for name, part in parts.items()}
    real = {name: Generated(model, part[WHOLE], part[SHAPE]) for name, part in parts.items()}
    if seconds is not None:
        for name, each in real.items():
            last = (model.timed.lasts(each.x) - seconds).abs() <= tolerance
            if (count := int(last.sum())) < 2:
                raise UsageError(
                    f"only {count} of {len(last)} real segments last {seconds:g} ± {tolerance:g} s, with which "
                    "generated ones are compared; choose another duration, or a larger --tolerance"
                )
            real[name] = replace(each, x=each.x[last], shape=each.shape[last])
    bodies = parts["real"][SHAPE].repeat(-(-samples // len(test)), 1)[:samples]
    options: dict[str, Any] = {"seconds": seconds, "tolerance": tolerance, "seed": seed}
    latents_by_name = priors(model, parts["known"])
    rows = {name: generate_segments(model, bodies, **options, prior=prior) for name, prior in latents_by_name.items()}
    rows |= {KNOWN: real["known"], REAL: real["real"]}
    if out is not None:
        _write_generated(out, rows[STANDARD], real["real"], shown)
    OUT.print(summary_table(summarise(rows, real["known"])))
    latents = aggregate_posterior(model, parts["known"])
    OUT.print(
        f"latents of {len(known)} training segments: KL {latents['KL']:.1f} nats, norm of means {latents['norm']:.2f}, "
        f"deviation {latents['deviation']:.2f}; together they have {latents['radius']:.2f} of the radius of N(0, I), "
        f"and are at least {max(latents['excess'], 0.0):.1f} nats from it",
        soft_wrap=True,
    )


def _write_generated(out: Path, generated: Generated, real: Generated, shown: int) -> None:
    """Write some generated segments; a page also shows a real one."""
    some = replace(generated, x=generated.x[:shown], shape=generated.shape[:shown]).motion()
    if out.suffix.lower() in (".html", ".htm"):
        (first,) = replace(real, x=real.x[:1], shape=real.shape[:1]).motion()
        names = [*(f"from N(0, I), {n + 1}" for n in range(len(some))), "real"]
        _save_page(out, replace(some, clips=[*some, replace(first, name="real")]), names)
    else:
        _write_clips(out, some)
    ERROR.print(f"wrote {out}: {len(some)} segments from N(0, I)")


def _known_data(run: runs.Loaded, data: str | None) -> Any:
    """Return the data of a run, or other data; None if the data are no longer available."""
    try:
        return loading.data_of(data, run)
    except CheckpointError as error:
        note(f"no known segments: the prior is N(0, I), and the search starts from this prior only: {error}")
        return None


def _other_segments(data_set: Any, takes: Collection[str]) -> Mapping[str, Any] | None:
    """Return training segments from takes other than `takes`; None without such segments."""
    others = [clip for clip in data_set.segments if clip.split == "train" and clip.labels["source"] not in takes]
    clips = subsample_clips(others, MOST_KNOWN)
    return data_set.of_clips(clips).all() if clips else None


def _warnings(recovered: Recovered, deviations: Deviations) -> Iterator[str]:
    """Yield warnings about the results, to print with the table."""
    remaining = recovered.completed.posterior.left
    if n_unconverged := int((remaining > APART).sum()):
        yield (
            f"{n_unconverged} of {len(remaining)} segments not converged, with up to {float(remaining.max()):,.0f} "
            "nats left; give more --steps or --starts, or allow larger deviations"
        )
    for name, distances in recovered.distances.items():
        if name == TO_POINTS:  # few points are far from most of the surface
            continue
        option, allowed = name.removesuffix("s"), deviations.of(name)
        deviation = float(distances.max()) / (8 / pi) ** 0.5  # the mean length of three normal coordinates
        if deviation > FARTHER * allowed:
            yield (
                f"the {name} are up to {1000 * float(distances.max()):.0f} mm from the output of this run, and "
                f"--{option} {allowed:g} allows {1000 * allowed:g} mm in each coordinate: intervals are too narrow; "
                f"try --{option} {deviation:.2g}"
            )


def _write_recovered(out: Path, recovered: Recovered, draws: int) -> None:
    """Write the most probable segments, and draws of them, as a motion file, an html page, a BVH file or a folder."""
    motions, suffix = recovered.motion(draws), out.suffix.lower()
    if suffix in (".html", ".htm"):
        names = ["most probable", *(f"draw {n}" for n in range(1, draws + 1))]
        _save_page(out, motions, names, recovered.true_motion())
    elif suffix == ".bvh":
        motion.write_motion(out, _single_clip(motions, motions.clips[0]))
    else:
        _write_clips(out, motions)


def _write_clips(out: Path, motions: motion.MotionSet) -> None:
    """Write clips as a motion file, or as a folder of BVH files."""
    if out.suffix:
        motion.write_motion(out, motions)
        return
    for clip in motions:
        motion.write_motion(out, _single_clip(motions, clip), "bvh")
