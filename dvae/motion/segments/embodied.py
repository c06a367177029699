"""Segments of motion on a body with a surface: the training data of a latent space of 4D motion.

Marsot, Wuhrer, Franco and Durocher (2021), arXiv 2106.04387: a segment consists of chi, time-stamped frames
(`segments.TimedFrames`), and beta, the shape of the moving body.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from ...data.batch import WHOLE, Batch
from ...data.schema import Schema
from ...data.views import Parts
from ...options import tuples
from ..bodies import Body, BodySource, human, shapes_of
from ..bodies.fitting import MOST, standing_heights
from ..data.clips import MotionSet
from ..files.smpl import JOINTS, PARENTS
from ..geometry.skeleton import Skeleton, brief
from ..geometry.views import HEADING
from .frames import OFFSETS, ORIGIN, TimedFrames
from .gait import Reference

SHAPE = "beta"
"""Name in batches of the shape parameters, (B, S)."""


@dataclass(frozen=True)
class BodySchema(Schema):
    """The schema of shape parameters beta (B, S) of a body.

    Args:
        body: record of the body; default: the bundled person.
    """

    body: BodySource = field(default=BodySource(), kw_only=True)


@dataclass(frozen=True)
class SegmentSchema(BodySchema):
    """The schema of segments on a body: frames x (B, N, D) and shape parameters beta (B, S).

    A run stores the path and the fingerprint of a body's file, but not the body (`bodies.reopen_body`).

    Args:
        timed: conversion between segments of motion and frames.
    """

    kind: ClassVar[str] = "segments"
    per: ClassVar[str] = "frame"

    timed: TimedFrames = field(kw_only=True)

    @classmethod
    def from_data(cls, timed: TimedFrames, body: Body) -> Self:
        """Return the schema for these frames and for the shape parameters of a body.

        Raises:
            ValueError: the body was made in Python, so that a run could not reopen it.
        """
        if body.source is None:
            raise ValueError(
                "the body was made in Python, and a run could not reopen it; save its arrays with numpy.savez as "
                "v_template, shapedirs, J_regressor, weights, kintree_table and f, and use bodies.read_body"
            )
        sizes = {name: len(places) for name, places in timed.parts.items()}
        return cls({**sizes, SHAPE: body.parameters_of_shape}, timed.frames, timed=timed, body=body.source)

    @property
    @override
    def view(self) -> Parts:
        return Parts(self.timed.parts)

    @property
    @override
    def windows(self) -> Schema:
        """Schema without the representation of frames; runs can share evaluation data if it is equal."""
        return BodySchema({SHAPE: self.size(SHAPE)}, body=replace(self.body, path=""))

    @override
    def config(self) -> dict[str, Any]:
        fields = asdict(replace(self.timed, references=()))
        references = [{**vars(reference), "hips": reference.hips.tolist()} for reference in self.timed.references]
        return {"sizes": dict(self.sizes), "timed": {**fields, "references": references}, "body": asdict(self.body)}

    @classmethod
    @override
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        timed, body = dict(config["timed"]), BodySource(**config.get("body", {}))  # older runs have the bundled person
        references = tuple(map(_reference, timed.pop("references")))
        skeleton = Skeleton(**tuples(timed.pop("skeleton")))
        if (skeleton.names, skeleton.parents, skeleton.up) != (JOINTS, PARENTS, "y"):
            raise ValueError(f"timed.skeleton must be the skeleton of bodies, {', '.join(JOINTS)} with y up")
        frames = TimedFrames(skeleton, references=references, **tuples(timed))
        sizes = {name: len(places) for name, places in frames.parts.items()} | {SHAPE: body.shapes}
        if config["sizes"] != sizes:
            raise ValueError(f"sizes are {brief(config['sizes'])}, expected {sizes} for the frames in `timed`")
        return cls(sizes, frames.frames, timed=frames, body=body)


def _reference(config: Mapping[str, Any]) -> Reference:
    """Return the reference cycle that is stored in a config."""
    hips = np.array(config["hips"], dtype=np.float64)
    if hips.ndim != 3 or hips.shape[1:] != (2, 4) or len(hips) < 2 or not np.isfinite(hips).all():
        raise ValueError(f"hips of a reference are {hips.shape}, expected finite quaternions (at least 2, 2, 4)")
    return Reference(**{**config, "hips": hips, "source": tuple(config["source"])})


class Segments:
    """Segments as inputs of a model: training data, from which batches are drawn, or test data.

    Args:
        motion: segments on the joints of the body, each a clip, e.g. from `bodies.fit_to_body` and `gait_cycles`.
        timed: conversion to frames; for test data, the conversion of the training data. Default: estimated from
            `motion`.
        body: body with these joints, such as one from `bodies.read_body`; default: the bundled person.
        frames: result of `timed.to(motion)`, if it was computed already.
        bodies: standard deviation of the shape parameters that `sample` draws in place of the segments' own; 0 keeps
            their own. Root positions scale with the length of the legs, as in `bodies.retarget`. A model trained on
            few bodies does not generalise to others.

    Raises:
        ValueError: the motion has other joints.
    """

    def __init__(
        self,
        motion: MotionSet,
        timed: TimedFrames | None = None,
        body: Body | None = None,
        frames: Mapping[str, Any] | None = None,
        bodies: float = 0.0,
    ):
        self.motion, self.body, self.bodies = motion, body or human(), bodies
        if timed is None:
            timed, frames = TimedFrames.seeing(motion)
        self.timed, frames = timed, frames or timed.to(motion)
        self._batch = {WHOLE: frames[WHOLE], SHAPE: shapes_of(motion, self.body).float()}
        self._start = {name: frames[name] for name in (HEADING, ORIGIN)}

    def __len__(self) -> int:
        return len(self.motion)

    def all(self) -> Mapping[str, Any]:
        """Return all segments: x (B, N, D) and beta (B, S)."""
        return self._batch

    def sample(self, batch_size: int, generator: torch.Generator) -> Mapping[str, Any]:
        """Return `batch_size` distinct random segments, or all in random order if there are fewer.

        Args:
            batch_size: number of segments B.
            generator: source of random numbers.

        Returns:
            x (B, N, D) and beta (B, S), on random bodies unless `bodies` is 0.
        """
        rows = torch.randperm(len(self), generator=generator)[:batch_size]
        batch = Batch(self._batch).rows(rows)
        if not self.bodies:
            return batch
        shapes = self.bodies * torch.randn(batch[SHAPE].shape, generator=generator)
        return self.on_bodies(batch, shapes.clamp(-MOST, MOST))

    def on_bodies(self, batch: Mapping[str, Any], shape: Tensor) -> Mapping[str, Any]:
        """Return a batch with the same rotations and times on other bodies.

        Root positions scale with the length of the legs.

        Args:
            batch: x (B, N, D) and beta (B, S).
            shape: (B, S), shape parameters of the other bodies.
        """
        legs = [standing_heights(self.body, shapes).to(shape) for shapes in (batch[SHAPE], shape)]
        x = batch[WHOLE].clone()
        x[..., self.timed.parts["translation"]] *= (legs[1] / legs[0])[:, None, None]
        return {WHOLE: x, SHAPE: shape}

    @property
    def labels(self) -> Sequence[Mapping[str, str]]:
        """Labels of each segment."""
        return [clip.labels for clip in self.motion]

    @property
    def schema(self) -> SegmentSchema:
        """Schema of the segments for models."""
        return SegmentSchema.from_data(self.timed, self.body)

    @property
    def fingerprint(self) -> str:
        """SHA-256 of x and beta of all segments."""
        content = b"".join(self._batch[name].numpy().tobytes() for name in (WHOLE, SHAPE))
        return hashlib.sha256(content).hexdigest()

    def back(self, x: Tensor, shape: Tensor | None = None, fps: float | None = None) -> MotionSet:
        """Convert frames to motion that starts at the position and heading of these segments.

        Args:
            x: frames (B, N, D), one for each segment.
            shape: (B, S), shape parameters; default: the parameters of the segments.
            fps: frames per second; default: the rate of the skeleton.

        Returns:
            Clips, one for each segment, at the original positions and headings.
        """
        offsets = self.body.offsets(self._batch[SHAPE] if shape is None else shape)
        return self.timed.back({**self._start, OFFSETS: offsets, WHOLE: x}, fps)


def surfaces_of(timed: TimedFrames, body: Body, x: Tensor, shape: Tensor) -> Tensor:
    """Return surfaces (..., N, V, 3) in metres of frames (..., N, D) on bodies (..., S), with gradients.

    Every segment starts at the origin with heading zero.
    """
    rotations, translation, _ = timed.unpack(x)
    surfaces: Tensor = body(shape, rotations, translation)[0]
    return surfaces
