"""Results of segment completion: the segments, their distance from the observations, and their uncertainty; file input.

`completion.complete` searches for the segments; this module evaluates the results.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Group
from torch import Tensor

from ...data.batch import WHOLE
from ...data.npy import NpyError
from ...inference.diagnostics.posteriors import Descent
from ...inference.evaluation.evaluation_windows import on_device_of
from ...inference.evaluation.result import Table
from ...options import nearest
from ..bodies import vertex_error
from ..data.clips import MotionSet
from ..files.archive import archive
from .completion import (
    FRAMES,
    LATENT,
    POINTS,
    SPOTS,
    SURFACES,
    TIMES,
    TO_POINTS,
    Completed,
    Deviations,
    SegmentCompletion,
    complete,
)
from .embodied import SHAPE
from .frames import OFFSETS

LARGEST = 2**25
"""Maximum total size in bytes of a file of observations: nearly two thousand surfaces, or two million points."""

MOST, MOST_POINTS = 1000, 2**17
"""Maximum number of segments and of moments per segment; and of points per segment."""

FARTHEST, LATEST = 30.0, 60.0
"""Metres from the origin and seconds from the first frame; larger values mean that the units are wrong."""

DRAWS, LEVEL = 200, 0.95
"""Number of draws for intervals, and their probability."""

AT_ONCE = 512
"""Number of draws in memory at once."""

UNRELIABLE = 0.7
"""k-hat above which intervals are unreliable."""


@dataclass(frozen=True, eq=False)
class Recovered:
    """Completed segments, with draws from the posterior and distances from the observations.

    Args:
        completed: most probable segments.
        keys: (split, name) of each segment.
        draws: frames (n, B, N, D) and shape parameters (n, B, S) drawn from the posterior.
        khat: (B,), k-hat from `Posterior.evidence`; above 0.7, intervals are unreliable.
        distances: mean distances (B,) in metres from the observations, by name of the observations, from
            `SegmentCompletion.distances`.
        truth: true x (B, N, D) and beta (B, S), if known.
    """

    completed: Completed
    keys: Sequence[tuple[str, str]]
    draws: tuple[Tensor, Tensor]
    khat: Tensor
    distances: Mapping[str, Tensor]
    truth: Mapping[str, Any] | None = None

    @property
    def errors(self) -> dict[str, Tensor]:
        """Errors (B,) of the most probable segments by name; empty if the truth is unknown.

        "vertex error" is in metres and compares frames of chi with the same index. "duration error" is in seconds.
        """
        if self.truth is None:
            return {}
        model, (x, shape), truth = self.completed.model, (self.completed.x, self.completed.shape), self.truth
        rows = [slice(row, row + 1) for row in range(len(x))]  # one segment at a time: surfaces are large
        vertices = [
            vertex_error(model.vertices(x[row], shape[row]), model.vertices(truth[WHOLE][row], truth[SHAPE][row]))
            for row in rows
        ]
        lasts = model.timed.lasts(x) - model.timed.lasts(truth[WHOLE])
        return {"vertex error": torch.cat(vertices), "duration error": lasts.abs()}

    def table(self) -> Group:
        """Return two tables, one below the other: results with intervals, and diagnostics; both by segment."""
        timed, draws = self.completed.model.timed, len(self.draws[0])
        measures = {"duration\ns": timed.lasts, "displacement\nm": timed.travels}
        errors = {f"from\n{name}\nmm": value for name, value in self.distances.items()}
        if TO_POINTS in self.distances:
            errors["surface to\npoints\nmm"] = errors.pop(f"from\n{TO_POINTS}\nmm")
        titles = {"vertex error": "vertex\nerror\nmm", "duration error": "duration\nerror\nms"}
        errors |= {titles[name]: value for name, value in self.errors.items()}
        caption = f"[ ]: {100 * LEVEL:g} % of {draws} draws; too narrow if errors are correlated or exceed deviations"
        results = _table((*measures, *errors), caption)
        diagnostics = _table(
            ("left\nnats", "behind\nnats", "bent", "k-hat"),
            "left: remaining reduction of the energy, about 0 if the search has converged\n"
            "behind: energy of the other starts minus the energy of the best\n"
            "bent: number of directions with less curvature than the prior, where a normal does not fit\n"
            f"k-hat: above {UNRELIABLE}, draws and intervals are unreliable",
        )
        posterior = self.completed.posterior
        measured = [(measure(self.completed.x), measure(self.draws[0])) for measure in measures.values()]
        for row, key in enumerate(self.keys):
            others = posterior.behind[1:, row].tolist()
            results.add_row(
                "/".join(key),
                *(_with_interval(value[row], draws_of_measure[:, row]) for value, draws_of_measure in measured),
                *(f"{1000 * float(value[row]):.1f}" for value in errors.values()),
            )
            diagnostics.add_row(
                "/".join(key),
                _brief(float(posterior.left[row])),
                " to ".join(dict.fromkeys(map(_brief, others[:1] + others[-1:]))),
                str(int(posterior.bent[row])),
                f"{float(self.khat[row]):.2f}",
            )
        return Group(results, diagnostics)

    def motion(self, draws: int = 0) -> MotionSet:
        """Return the most probable segments as clips, each followed by some of its draws.

        All clips start at the origin with heading zero.

        Args:
            draws: number of draws per segment.
        """
        pairs = zip((self.completed.x, self.completed.shape), self.draws, strict=True)
        x, shape = (torch.cat([mode[None], samples[:draws]]).transpose(0, 1).flatten(0, 1) for mode, samples in pairs)
        ends = ["found", *(f"draw-{n:02d}" for n in range(1, draws + 1))]
        return self._motion(x, shape, [(split, f"{name}-{end}") for split, name in self.keys for end in ends])

    def true_motion(self) -> MotionSet | None:
        """Return the true segments as clips from the origin with heading zero, or None if they are unknown."""
        return None if self.truth is None else self._motion(self.truth[WHOLE], self.truth[SHAPE], self.keys)

    def _motion(self, x: Tensor, shape: Tensor, keys: Sequence[tuple[str, str]]) -> MotionSet:
        model = self.completed.model
        motion: MotionSet = model.timed.back({WHOLE: x, OFFSETS: model.body.offsets(shape)})
        clips = zip(motion, keys, strict=True)
        return replace(motion, clips=[replace(clip, split=split, name=name) for clip, (split, name) in clips])


def recover(
    model: Any,
    observations: Mapping[str, Any],
    keys: Sequence[tuple[str, str]],
    *,
    truth: Mapping[str, Any] | None = None,
    deviations: Deviations | None = None,
    markers: Sequence[int] | None = None,
    known: Mapping[str, Any] | None = None,
    aggregate: bool = True,
    two_way: bool = False,
    descent: Descent | None = None,
    seed: int = 0,
    progress: bool = False,
) -> Recovered:
    """Complete segments, and evaluate the results.

    Args:
        model, observations, deviations, markers, known, aggregate, two_way, descent, seed, progress: as in `complete`.
        keys: (split, name) of each segment.
        truth: true x (B, N, D) and beta (B, S), if known.

    Returns:
        The completed segments with 200 draws, k-hat, distances from the observations and, if the truth is known,
        errors.

    Raises:
        ValueError: same as `complete`; or a segment has no observations.
    """
    _check_nonempty(_completion(model, markers).read(observations))
    options: dict[str, Any] = {"deviations": deviations, "known": known, "aggregate": aggregate, "descent": descent}
    options |= {"two_way": two_way, "markers": markers}
    completed = complete(model, observations, **options, seed=seed, progress=progress)
    bound = completed.evidence(DRAWS, seed=seed, chunk=AT_ONCE)
    distances = completed.program.distances(completed.observations, completed.posterior.mode[LATENT], completed.shape)
    true = None if truth is None else on_device_of(model, truth)
    return Recovered(completed, keys, completed.draw(DRAWS, seed), bound.khat, distances, true)


def _completion(model: Any, markers: Sequence[int] | None) -> SegmentCompletion:
    return SegmentCompletion(model, markers=tuple(markers)) if markers else SegmentCompletion(model)


def read_seen(path: str | Path, model: Any, markers: Sequence[int] | None = None) -> dict[str, Tensor]:
    """Read observations of segments from a file.

    Args:
        path: npz file with arrays that have the names and shapes in `completion`: times or frames; some of surfaces,
            points and markers; and beta if known. Arrays of a single segment may omit the first axis.
        model, markers: as in `SegmentCompletion`.

    Returns:
        Observations for `recover`, in double precision.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged, too large, or not as described; or a segment has no observations.
    """
    arrays = _read(Path(path))
    try:
        for name, array in arrays.items():
            if array.dtype.kind not in "fiu" or not array.size:
                raise ValueError(f"{name} is {array.dtype} {array.shape}, expected numbers")
        observations = {name: torch.from_numpy(array.astype(np.float64)) for name, array in arrays.items()}
        if all(observations[name].dim() == 1 for name in (TIMES, FRAMES) if name in observations):
            observations = {name: value[None] for name, value in observations.items()}
        for name, value in observations.items():
            _check_numbers(name, value)
        _check_nonempty(_completion(model, markers).read(observations))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return observations


def _read(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of an npz file, and raise an error if a name is unknown or the file is too large."""
    names = (TIMES, FRAMES, SURFACES, POINTS, SPOTS, SHAPE)
    with archive(path) as members:
        if unknown := [name for name in members if name not in names]:
            hint = nearest(unknown[0], names)
            raise NpyError(f"{unknown[0]!r} is not an observation{hint}; expected some of {', '.join(names)}")
        if (size := sum(member.size for member in members.values())) > LARGEST:
            raise NpyError(
                f"it unpacks to {size:,} bytes, at most {LARGEST:,} are read; give fewer moments or segments"
            )
        return {name: member.array() for name, member in members.items()}


def _check_numbers(name: str, value: Tensor) -> None:
    """Raise an error if there are too many observations, or if they are in the wrong units."""
    if value.dim() > 1 and name != SHAPE and (len(value) > MOST or value.shape[1] > MOST):
        raise ValueError(
            f"{name} has shape {tuple(value.shape)}; expected at most {MOST} segments, with at most {MOST} moments each"
        )
    if name == POINTS and value.shape[1:3].numel() > MOST_POINTS:
        raise ValueError(f"{name} has shape {tuple(value.shape)}; expected at most {MOST_POINTS:,} points per segment")
    far = float(value.abs().nan_to_num(0.0, torch.inf).max())
    if name in (SURFACES, POINTS, SPOTS) and far > FARTHEST:
        raise ValueError(
            f"{name} has a coordinate of {far:g}; expected metres, relative to the root in the segment's first frame"
        )
    if name == TIMES and (far > LATEST or (value < 0).any()):
        low, high = value.nan_to_num(0.0).aminmax()
        raise ValueError(f"times go from {low:g} to {high:g}; expected seconds from the first frame of the segment")
    if name == SHAPE and far > FARTHEST:
        raise ValueError(f"{name} has a value of {far:g}; expected shape parameters, which are about N(0, 1)")


def _check_nonempty(observations: Mapping[str, Any]) -> None:
    """Raise an error if a segment has no observations."""
    kinds = [
        observations[name].isfinite().flatten(2).any(-1) for name in (SURFACES, POINTS, SPOTS) if name in observations
    ]
    timed = [observations[name].isfinite() for name in (TIMES, FRAMES) if name in observations]
    moments = torch.stack(kinds).any(0) if kinds else torch.stack(timed).all(0)
    if not (has_observations := moments.any(-1)).all():
        row = int(has_observations.logical_not().nonzero()[0])
        raise ValueError(
            f"segment {row} of {len(has_observations)}, counted from 0, has only NaN instead of observations; remove it"
        )


def _table(columns: Sequence[str], caption: str) -> Table:
    """Return a table with a column for segments; narrow terminals wrap cells, so that numbers are never truncated."""
    table = Table(caption=caption)
    table.add_column("segment", overflow="fold")
    for column in columns:
        table.add_column(column, justify="right", overflow="fold")
    return table


def _with_interval(value: Tensor, samples: Tensor) -> str:
    low, high = samples.quantile(samples.new_tensor([(1 - LEVEL) / 2, (1 + LEVEL) / 2])).tolist()
    return f"{float(value):.2f} [{low:.2f}, {high:.2f}]"


def _brief(nats: float) -> str:
    return f"{nats:.1f}" if nats < 10 else f"{nats:,.0f}"
