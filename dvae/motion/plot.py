"""Figures of skeletons: a pose, and observed motion with its possible futures."""

from __future__ import annotations

from math import pi
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from .skeleton import Skeleton, rotate_about_up

PAST, TRUTH = "black", "#1a7f37"

SPACING = 1.15
"""Metres between the skeletons of a figure."""


def pose(
    ax: Axes,
    positions: Any,
    skeleton: Skeleton,
    *,
    at: tuple[float, float] = (0.0, 0.0),
    azimuth: float = 0.0,
    **line: Any,
) -> None:
    """Draw poses, (J, 3) or several at once (..., J, 3), seen from the front of a person with heading zero.

    Args:
        ax: where to draw; metres on both axes.
        positions: metres, numpy or torch.
        skeleton: the tree.
        at: added to the horizontal and vertical coordinates of the drawing.
        azimuth: radians by which the people are turned about the up axis before they are drawn.
        **line: passed on to matplotlib's LineCollection, such as colors, linewidths, alpha.
    """
    poses = torch.as_tensor(np.asarray(positions), dtype=torch.float64).reshape(-1, skeleton.joints, 3)
    turned = rotate_about_up(poses, torch.tensor(azimuth, dtype=torch.float64), skeleton.up).numpy()
    drawing = np.stack([turned[..., 0] + at[0], turned[..., skeleton.vertical] + at[1]], axis=-1)
    bones = list(drawing[:, skeleton.edges].reshape(-1, 2, 2))
    ax.add_collection(LineCollection(bones, **{"capstyle": "round", **line}))


def futures(
    skeleton: Skeleton,
    observed: Any,
    samples: Any,
    truth: Any = None,
    frames: int = 6,
    ax: Axes | None = None,
    view: float = pi / 5,
) -> Axes:
    """Observed motion and sampled futures, as skeletons from left to right over time.

    The past is black, the truth green, each sample has a colour of its own through time. Every pose is drawn
    relative to its pelvis, all from the same side: the last observed pose is seen from the front, turned by
    `view`.

    Args:
        skeleton: the tree.
        observed: (O, J, 3) in metres, numpy or torch.
        samples: (K, H, J, 3) in metres.
        truth: (H, J, 3) in metres, where it is known.
        frames: how many future frames are drawn, the last always among them.
        ax: where to draw; a new figure without it.
        view: radians between the last observed heading and the viewer.

    Returns:
        The axes; `ax.figure.savefig(...)` saves them.

    Raises:
        ValueError: the shapes do not fit each other or the skeleton, or there is nothing to draw.
    """
    past, future = np.asarray(observed, np.float64), np.asarray(samples, np.float64)
    real = None if truth is None else np.asarray(truth, np.float64)
    joint = (skeleton.joints, 3)
    fits = past.ndim == 3 and past.shape[1:] == joint and future.ndim == 4 and future.shape[2:] == joint
    if not fits or not past.size or not future.size or (real is not None and real.shape != future.shape[1:]):
        raise ValueError(
            f"expected observed (O, J, 3), samples (K, H, J, 3) and truth (H, J, 3) with J = {joint[0]}, "
            f"got {past.shape}, {future.shape} and {None if real is None else real.shape}"
        )
    sided = bool(skeleton.left and skeleton.right)
    azimuth = view - (float(skeleton.heading(torch.from_numpy(past[-1]))) if sided else 0.0)
    now, horizon = len(past) - 1, future.shape[1]
    ahead = np.unique(np.linspace(0, horizon, frames + 1)[1:].round().clip(1)).astype(int)
    shown = [*sorted({0, now}), *(now + ahead)]
    if ax is None:
        ax = plt.subplots(figsize=(1.15 * len(shown), 2.3), layout="constrained")[1]

    def draw(poses: np.ndarray, column: int, **line: Any) -> None:
        pelvic = poses - poses[..., skeleton.root : skeleton.root + 1, :]
        pose(ax, pelvic, skeleton, at=(column * SPACING, 0.0), azimuth=azimuth, **line)

    colours = plt.get_cmap("turbo")(np.linspace(0.05, 0.95, len(future))).repeat(len(skeleton.edges), axis=0)
    opacity = float(np.clip(6 / len(future), 0.15, 0.9))
    for column, frame in enumerate(shown):
        if frame <= now:
            draw(past[frame], column, colors=PAST, linewidths=1.8)
            continue
        draw(future[:, frame - now - 1], column, colors=colours, linewidths=1.2, alpha=opacity)
        if real is not None:
            draw(real[frame - now - 1], column, colors=TRUTH, linewidths=1.8)

    ax.autoscale_view()
    ax.set_aspect("equal")
    seconds = [(frame - now) / skeleton.fps for frame in shown]
    ax.set_xticks(SPACING * np.arange(len(shown)), [f"{s:+.1f} s" if s else "0 s" for s in seconds])
    ax.set_yticks([])
    ax.tick_params(length=0)
    for spine in ax.spines.values():
        spine.set_visible(False)
    return ax
