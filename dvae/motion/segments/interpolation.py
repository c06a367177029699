"""Operations in a latent space of segments: interpolation, transfer to another body, and a map of the space.

As in Marsot et al. (2021), arXiv 2106.04387, segments are interpolated linearly in z and beta together, and their
motion is transferred by exchanging beta. From a walk to a run, durations should decrease along the interpolation,
because cycles of running are shorter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from ...data.batch import WHOLE
from ...inference.evaluation.evaluation_windows import on_device_of, seeded_evaluation
from ...inference.evaluation.result import Table, literal_text, new_figure, styled
from ..bodies import Body
from ..data.clips import MotionSet
from .embodied import SHAPE, surfaces_of
from .frames import OFFSETS, TimedFrames

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MARKERS = "osD^v<>"
"""Markers of labels; each is used for ten colours."""


@dataclass(frozen=True, eq=False)
class Interpolation:
    """Interpolated segments of B pairs in M steps, including the ends, which are reconstructions.

    Attributes:
        timed: conversion of frames to motion.
        body: moving body.
        shares: (M,), weight of the second end in each step, from 0 to 1.
        latent: interpolated z, (B, M, Z).
        shape: interpolated beta, (B, M, S).
        x: decoded frames, (B, M, N, D).
    """

    timed: TimedFrames
    body: Body
    shares: Tensor
    latent: Tensor
    shape: Tensor
    x: Tensor

    @property
    def durations(self) -> Tensor:
        """Durations (B, M) in seconds."""
        return self.timed.lasts(self.x)

    @property
    def displacements(self) -> Tensor:
        """Distance of the root between first and last frame, (B, M) in metres."""
        return self.timed.travels(self.x)

    @property
    def global_pose(self) -> Tensor:
        """Angle of the root rotation relative to the first step, (B, M) in degrees, averaged over frames."""
        return self._mean_angle(self._unpacked[0][..., [self.timed.skeleton.root], :, :])

    @property
    def local_pose(self) -> Tensor:
        """Mean angle (B, M) in degrees of joint rotations relative to the first step.

        The mean is over frames and over all joints in them except the root. Rotations are relative to the parent.
        """
        others = [joint for joint in self.timed.turning if joint != self.timed.skeleton.root]
        return self._mean_angle(self._unpacked[0][..., others, :, :])

    @property
    def measures(self) -> Mapping[str, Tensor]:
        """All four measures by name and unit, (B, M) each."""
        return {
            "duration (s)": self.durations,
            "displacement (m)": self.displacements,
            "global pose (°)": self.global_pose,
            "local pose (°)": self.local_pose,
        }

    def table(self, pair: int = 0) -> Table:
        """Return a table of the four measures, with one row per step.

        Args:
            pair: index of the pair.
        """
        table = Table(caption="poses: mean angle from those of the first step")
        for column in ("step", *self.measures):
            table.add_column(column, justify="right")
        for share, *values in zip(self.shares, *(value[pair] for value in self.measures.values()), strict=True):
            table.add_row(f"{float(share):.2f}", *(f"{float(value):.2f}" for value in values))
        return table

    def motion(self, pair: int = 0, fps: float | None = None) -> MotionSet:
        """Return the steps of a pair as clips, each on its interpolated body, from the origin with heading zero.

        Args:
            pair: index of the pair.
            fps: frames per second; default: the rate of the training data.
        """
        motion = self.timed.back({WHOLE: self.x[pair], OFFSETS: self.body.offsets(self.shape[pair])}, fps)
        names = [f"step-{n:02d}" for n in range(len(motion))]
        clips = [replace(clip, name=name) for clip, name in zip(motion, names, strict=True)]
        return replace(motion, clips=clips, name="interpolation")

    def vertices(self, pair: int = 0) -> Tensor:
        """Return surfaces (M, N, V, 3) in metres of all steps of the pair with this index.

        Args:
            pair: index of the pair.
        """
        return surfaces_of(self.timed, self.body, self.x[pair], self.shape[pair])

    @cached_property
    def _unpacked(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.timed.unpack(self.x)

    def _mean_angle(self, rotations: Tensor) -> Tensor:
        """Return the mean angle (B, M) in degrees of rotations (B, M, N, K, 3, 3) relative to the first step."""
        distances = (
            (rotations - rotations[:, :1]).flatten(-2).norm(dim=-1)
        )  # 2 sqrt(2) sin(angle / 2), accurate for small angles
        angle = 2 * torch.asin((distances / 8**0.5).clamp(max=1))
        return angle.mean((-2, -1)).rad2deg()


@torch.no_grad()
def interpolate(model: Any, first: Mapping[str, Any], second: Mapping[str, Any], steps: int = 9) -> Interpolation:
    """Interpolate linearly in z and beta between pairs of segments, all pairs and steps at once.

    Args:
        model: model of segments, such as a `motion-latent` model.
        first, second: batches of the same size with x (B, N, D) and beta (B, S) in the model's representation.
        steps: number of steps M, including the ends.

    Returns:
        Latents (B, M, Z), shapes (B, M, S) and frames (B, M, N, D) of all B pairs.

    Raises:
        ValueError: fewer than 2 steps, or batches of different sizes.
    """
    if steps < 2 or len(first[WHOLE]) != len(second[WHOLE]):
        raise ValueError(
            f"expected at least 2 steps and two batches of the same size, got {steps} steps, and "
            f"{len(first[WHOLE])} and {len(second[WHOLE])} segments"
        )
    with seeded_evaluation(model, 0):
        ends = [on_device_of(model, batch) for batch in (first, second)]
        latents = [model.encode(batch) for batch in ends]
        shares = torch.linspace(0, 1, steps).to(latents[0])
        latent, shape = (
            torch.lerp(start[:, None], end[:, None], shares[:, None])
            for start, end in (latents, [batch[SHAPE] for batch in ends])
        )
        return Interpolation(model.timed, model.body, shares, latent, shape, model.decode(latent, shape))


@torch.no_grad()
def transfer(model: Any, batch: Mapping[str, Any], shape: Tensor) -> Tensor:
    """Return the motion of segments on other bodies: their z with another beta.

    Args:
        model: model of segments.
        batch: segments, x (B, N, D) and beta (B, S).
        shape: (B, S), beta of the other bodies.

    Returns:
        Decoded frames x (B, N, D) for the other bodies.
    """
    with seeded_evaluation(model, 0):
        data = on_device_of(model, batch)
        x: Tensor = model.decode(model.encode(data), shape.to(data[SHAPE]))
        return x


def falls(values: Tensor) -> Tensor:
    """Return whether values (..., M) decrease in every step, as booleans (...,).

    In an interpolation from a walk to a run, durations should decrease in every step.

    Args:
        values: values (..., M) by step.
    """
    return (values.diff(dim=-1) < 0).all(-1)


@torch.no_grad()
@styled
def latent_map(model: Any, batch: Mapping[str, Any], labels: Sequence[str]) -> Figure:
    """Draw a map of the latent space: means of the guide on their first two principal axes, coloured by a label.

    Args:
        model: model of segments.
        batch: x (B, N, D) and beta (B, S), at least three segments.
        labels: label of each segment.

    Returns:
        A matplotlib figure.

    Raises:
        ValueError: there are too few segments, the number of labels is wrong, there are too many distinct labels, or z
            has one number.
    """
    with seeded_evaluation(model, 0):
        means = model.encode(on_device_of(model, batch)).double().cpu()
    if len(means) < 3 or len(labels) != len(means):
        raise ValueError(
            f"expected at least 3 segments and a label for each, got {len(means)} segments and {len(labels)} labels"
        )
    if means.shape[1] < 2:
        raise ValueError("z has one number; a map needs at least two")
    names = list(dict.fromkeys(labels))
    if len(names) > 10 * len(MARKERS):
        raise ValueError(
            f"`labels` has {len(names)} distinct labels, but markers distinguish at most {10 * len(MARKERS)}; use a "
            "label with fewer values"
        )
    centred = means - means.mean(0)
    _, spread, axes = torch.linalg.svd(centred, full_matrices=False)
    coordinates, shares = (centred @ axes.T).numpy(), (spread.square() / spread.square().sum()).numpy()
    columns = -(-len(names) // 20)
    figure = new_figure(4.5 + 1.3 * columns, 4.0)
    panel = figure.subplots()
    for n, name in enumerate(names):
        first, second = coordinates[np.array([label == name for label in labels]), :2].T
        colour, marker = f"C{n % 10}", MARKERS[n // 10]
        panel.scatter(first, second, s=9, alpha=0.7, label=name or "none", color=colour, marker=marker)
    panel.set_xlabel(f"first axis of z, {shares[0]:.0%} of variance")
    panel.set_ylabel(f"second axis, {shares[1]:.0%}")
    panel.set_aspect("equal", "datalim")
    literal_text(figure.legend(loc="outside right upper", ncols=columns).get_texts())
    return figure
