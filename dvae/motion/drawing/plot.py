"""Figures of skeletons and bodies: poses, observed motion with its possible futures, surfaces."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, pi
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D
from torch import Tensor

from ..geometry.skeleton import Skeleton, rotate_about_up

PAST, TRUTH, FIXED, GIVEN, SKIN = "black", "#1a7f37", "#4a4f57", "#cf222e", "#c3b2a1"

SPACING = 1.15
"""Metres between the skeletons of a figure."""

LIGHT = np.array([-0.5, -0.6, 0.63])
"""Direction of the light on surfaces: from the left, the front and above."""


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


def bare(ax: Axes) -> None:
    """As wide as it is high, without a frame and marks."""
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_yticks([])
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)


def futures(
    skeleton: Skeleton,
    observed: Any,
    samples: Any,
    truth: Any = None,
    frames: int = 6,
    ax: Axes | None = None,
    view: float = pi / 5,
    paths: Mapping[str, Any] | None = None,
) -> Axes:
    """Observed motion and sampled futures, as skeletons from left to right over time.

    (Longer than other functions by what is drawn, one thing after the other.)

    The past is black, the truth green, each sample has a colour of its own through time. Every pose is drawn
    relative to its pelvis, all from the same side: the last observed pose is seen from the front, turned by
    `view`. Where joints were given paths, these are crosses, and all of a frame is drawn relative to one place, the
    mean of the samples' pelvises.

    Args:
        skeleton: the tree.
        observed: (O, J, 3) in metres, numpy or torch; NaN where a joint is missing, as in the truth.
        samples: (K, H, J, 3) in metres.
        truth: (F, J, 3) in metres, where it is known; F is at most H.
        frames: how many future frames are drawn, the last always among them.
        ax: where to draw; a new figure without it.
        view: radians between the last observed heading and the viewer.
        paths: joint to the path (H, 3) that it was given, metres; NaN where that is not known.

    Returns:
        The axes; `ax.figure.savefig(...)` saves them.

    Raises:
        ValueError: the shapes do not fit each other or the skeleton, or there is nothing to draw.
    """
    past, future, real = _checked(skeleton, observed, samples, truth)
    crosses = _given(paths or {}, skeleton, future.shape[1])
    azimuth = view - facing(skeleton, torch.from_numpy(past))
    now, horizon = len(past) - 1, future.shape[1]
    ahead = np.unique(np.linspace(0, horizon, frames + 1)[1:].round().clip(1)).astype(int)
    shown = [*sorted({0, now}), *(now + ahead)]
    if ax is None:
        ax = plt.subplots(figsize=(max(1.15 * len(shown), 4.6), 2.3), layout="constrained")[1]

    middle = future[:, :, skeleton.root].mean(0)

    def draw(poses: np.ndarray, column: int, **line: Any) -> None:
        shared = len(crosses) and shown[column] > now
        origin = middle[shown[column] - now - 1] if shared else poses[..., skeleton.root : skeleton.root + 1, :]
        pose(ax, poses - origin, skeleton, at=(column * SPACING, 0.0), azimuth=azimuth, **line)

    colours = _colours(len(future)).repeat(len(skeleton.edges), axis=0)
    opacity = float(np.clip(6 / len(future), 0.15, 0.9))
    for column, frame in enumerate(shown):
        if frame <= now:
            draw(past[frame], column, colors=PAST, linewidths=1.8)
            continue
        draw(future[:, frame - now - 1], column, colors=colours, linewidths=1.2, alpha=opacity)
        if real is not None and frame - now <= len(real):
            draw(real[frame - now - 1], column, colors=TRUTH, linewidths=1.8)
        if len(crosses):
            places = torch.from_numpy(crosses[:, frame - now - 1] - middle[frame - now - 1])
            seen = rotate_about_up(places, torch.tensor(azimuth, dtype=torch.float64), skeleton.up).numpy()
            ax.plot(column * SPACING + seen[:, 0], seen[:, skeleton.vertical], "x", color=GIVEN, zorder=3)

    bare(ax)
    seconds = [(frame - now) / skeleton.fps for frame in shown]
    ax.set_xticks(SPACING * np.arange(len(shown)), [f"{s:+.1f} s" if s else "0 s" for s in seconds])
    _key(ax, len(future), real is not None, len(crosses) > 0)
    return ax


@dataclass(frozen=True, eq=False)
class Scene:
    """People who move side by side, in metres as the viewer sees them: x to the right, y away from the viewer, z up.

    Attributes:
        skeleton: the tree.
        names: of the P people; a truth is the first of them.
        colours: of each, from `now` on.
        motion: (P, O + H, J, 3), each about a place of their own; NaN after the end of a truth that ends early.
        now: the last observed frame.
        shown: the frames to show, `now` among them.
        fixed: joints that move alike in all samples.
        truth: whether there is one.
    """

    skeleton: Skeleton
    names: list[str]
    colours: list[str]
    motion: np.ndarray
    now: int
    shown: range
    fixed: frozenset[int]
    truth: bool

    @property
    def low(self) -> np.ndarray:
        """(3,), the least coordinates of anybody."""
        return np.nanmin(self.motion, (0, 1, 2))  # type: ignore[no-any-return]

    @property
    def high(self) -> np.ndarray:
        """(3,), the largest coordinates of anybody."""
        return np.nanmax(self.motion, (0, 1, 2))  # type: ignore[no-any-return]

    @property
    def places(self) -> np.ndarray:
        """(P, 3), where to stand so that nobody is in another's way."""
        return _places(len(self.motion), np.maximum(self.high - self.low + 0.4, SPACING))

    @property
    def milliseconds(self) -> float:
        """From one shown frame to the next, at the motion's own speed."""
        return 1000 * self.shown.step / self.skeleton.fps

    def seconds(self, frame: int) -> float:
        """From the last observed frame to another."""
        return (frame - self.now) / self.skeleton.fps

    def shared(self, person: int) -> frozenset[int]:
        """The joints of a person that move as in all other samples."""
        return frozenset() if self.truth and person == 0 else self.fixed


def staged(
    skeleton: Skeleton,
    observed: Any,
    samples: Any = None,
    truth: Any = None,
    *,
    names: Sequence[str] = (),
    fixed: Collection[int] = (),
    every: int | None = None,
    view: float = pi / 5,
) -> Scene:
    """Return people for an animation; see `player.animate` for the arguments and the errors."""
    alone = samples is None
    if alone:
        motion = np.asarray(observed)
        observed, samples, names = motion[:1], motion[None, 1:], names or [""]
    past, future, real = _checked(skeleton, observed, samples, truth)
    alike = frozenset(map(int, fixed))
    names = names or [f"sample {k + 1}" for k in range(len(future))]
    every = max(1, round(skeleton.fps / 25)) if every is None else every
    if len(names) != len(future):
        raise ValueError(f"{len(names)} names for {len(future)} samples; give each its own")
    if strangers := alike - set(range(skeleton.joints)):
        raise ValueError(f"fixed names joints {sorted(strangers)}; they go from 0 to {skeleton.joints - 1}")
    if every < 1:
        raise ValueError(f"every is {every}; show each frame with 1, each second one with 2")
    known = [each for each in (past, real, future if alone else None) if each is not None]
    if not (alone or np.isfinite(future).all()) or any(np.isinf(positions).any() for positions in known):
        raise ValueError("observed, samples or truth have NaN or infinite positions, which cannot be drawn")
    people = list(zip(names, map(to_hex, _colours(len(future))), future, strict=True))
    if real is not None:
        people.insert(0, ("truth", TRUTH, real))
    called, colours, aheads = map(list, zip(*people, strict=True))
    motion = _seen(skeleton, past, aheads, future.shape[1], view)
    now = len(past) - 1
    shown = range(now % every, motion.shape[1], every)
    return Scene(skeleton, called, colours, motion, now, shown, alike, real is not None)


def _key(ax: Axes, samples: int, truth: bool, paths: bool) -> None:
    """What the colours of `futures` mean, below the times."""
    sampled = tuple(Line2D([], [], color=colour) for colour in _colours(min(samples, 5)))
    key: dict[str, Any] = {"observed": Line2D([], [], color=PAST)}
    if truth:
        key["what happened"] = Line2D([], [], color=TRUTH)
    key[f"{samples} sample{'s' * (samples > 1)}"] = sampled
    if paths:
        key["given paths"] = Line2D([], [], color=GIVEN, marker="x", linestyle="")
    ax.legend(
        key.values(),
        key.keys(),
        handler_map={tuple: HandlerTuple(ndivide=None, pad=0)},
        loc="upper center",
        bbox_to_anchor=(0.5, 0),
        borderaxespad=2,  # the height of the times
        ncols=len(key),
        frameon=False,
        fontsize="small",
    )


def _seen(skeleton: Skeleton, past: np.ndarray, futures: Sequence[np.ndarray], horizon: int, view: float) -> np.ndarray:
    """Motions (P, O + H, J, 3) as the viewer of an animation sees them, with z up."""
    motion = np.full((len(futures), len(past) + horizon, skeleton.joints, 3), np.nan)
    for k, ahead in enumerate(futures):  # a truth that ends early leaves NaN, which is not drawn
        motion[k, : len(past) + len(ahead)] = np.concatenate([past, ahead])
    turn = torch.tensor(view - facing(skeleton, torch.from_numpy(past)), dtype=torch.float64)
    motion = rotate_about_up(torch.from_numpy(motion), turn, skeleton.up).numpy()
    return motion if skeleton.up == "z" else motion[..., [0, 2, 1]] * [1, -1, 1]


def _places(people: int, step: np.ndarray) -> np.ndarray:
    """Where to stand (P, 3), `step` apart, so that all are as large as can be in a window of 2:1."""
    wide = step[0] / step[2]
    rows = min(range(1, people + 1), key=lambda rows: max(rows, ceil(people / rows) * wide / 2))
    row, column = np.divmod(np.arange(people), ceil(people / rows))
    return np.stack([column * step[0], 0.0 * row, -row * step[2]], axis=-1)  # rows one above the other


def _colours(samples: int) -> np.ndarray:
    """(K, 4): a colour for each sample."""
    return plt.get_cmap("turbo")(np.linspace(0.05, 0.95, samples))


def facing(skeleton: Skeleton, positions: Tensor) -> float:
    """Where the person of motion (F, J, 3) faces in the end; zero where the skeleton does not tell left from right."""
    return float(skeleton.heading_near(positions, len(positions) - 1)) if skeleton.left and skeleton.right else 0.0


def _given(paths: Mapping[str, Any], skeleton: Skeleton, horizon: int) -> np.ndarray:
    """The paths of some joints (paths, H, 3)."""
    found = {joint: np.asarray(path, np.float64) for joint, path in paths.items()}
    for joint, path in found.items():
        skeleton.find(joint)  # which refuses an unknown one
        if path.shape != (horizon, 3):
            raise ValueError(f"expected a path ({horizon}, 3) of {joint}, as long as the samples; got {path.shape}")
    return np.array([*found.values()]).reshape(-1, horizon, 3)


def _checked(
    skeleton: Skeleton, observed: Any, samples: Any, truth: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Observed motion, samples and truth as arrays that fit each other."""
    past, future = np.asarray(observed, np.float64), np.asarray(samples, np.float64)
    real = None if truth is None else np.asarray(truth, np.float64)
    joint = (skeleton.joints, 3)
    fits = past.ndim == 3 and past.shape[1:] == joint and future.ndim == 4 and future.shape[2:] == joint
    knows = real is None or (real.ndim == 3 and real.shape[1:] == joint and len(real) <= future.shape[1])
    if not (fits and knows and past.size and future.size):
        raise ValueError(
            f"expected observed (O, J, 3), samples (K, H, J, 3) and truth (up to H, J, 3) with J = {joint[0]}, "
            f"got {past.shape}, {future.shape} and {None if real is None else real.shape}"
        )
    return past, future, real


def surfaces(faces: Any, vertices: Any, *, names: Sequence[str] = (), up: str = "y", title: str = "") -> Figure:
    """Draw bodies that stand side by side, seen from the front of a person with heading zero.

    Args:
        faces: triangles, (F, 3).
        vertices: of one pose (V, 3) or of P bodies or poses (P, V, 3), metres, numpy or torch without gradients.
        names: what to call them; by default they are not named.
        up: the vertical axis, "y" or "z".
        title: above the figure.

    Returns:
        A figure in metres.

    Raises:
        ValueError: the shapes do not fit each other, a place is not finite, or there are too few names.
    """
    corners, people = np.asarray(faces), np.asarray(vertices, np.float64)
    people = people[None] if people.ndim == 2 else people
    names = names or [""] * len(people)
    if corners.shape[1:] != (3,) or people.ndim != 3 or people.shape[2] != 3 or not (people.size and corners.size):
        raise ValueError(f"expected faces (F, 3) and vertices (P, V, 3), got {corners.shape} and {people.shape}")
    if not (0 <= corners.min() <= corners.max() < people.shape[1]):
        raise ValueError(f"a face has corner {corners.max()} of {people.shape[1]} vertices")
    if not np.isfinite(people).all():
        raise ValueError("vertices have NaN or infinite places, which cannot be drawn")
    if len(names) != len(people):
        raise ValueError(f"{len(names)} names for {len(people)} bodies; give each its own")
    people = people if up == "z" else people[..., [0, 2, 1]] * [1, -1, 1]
    people = people - (people.min(1, keepdims=True) + people.max(1, keepdims=True)) / 2 * [1, 1, 0]
    size = np.ptp(people, axis=(0, 1)) + 0.2
    places = _places(len(people), size)
    columns, rows = len({*places[:, 0]}), len({*places[:, 2]})
    width = min(9.0, 4.5 * columns)
    figure = Figure(figsize=(width, min(9.0, width * rows * size[2] / (columns * size[0]))), layout="constrained")
    ax = figure.subplots()
    for name, body, place in zip(names, people, places, strict=True):
        ax.add_collection(_shaded(corners, body + place))
        ax.text(place[0], place[2] + people[..., 2].max() + 0.05, name, ha="center", parse_math=False)
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()
    figure.suptitle(title, parse_math=False)
    return figure


def _shaded(faces: np.ndarray, places: np.ndarray) -> PolyCollection:
    """The triangles of a mesh (V, 3) that face the viewer, the nearest last, by how the light falls on them."""
    first, second, third = places[faces].swapaxes(0, 1)
    normals = np.cross(second - first, third - first)
    smooth = np.zeros_like(places)
    np.add.at(smooth, faces, normals[:, None])
    smooth /= np.linalg.norm(smooth, axis=-1, keepdims=True).clip(1e-12)
    seen = np.flatnonzero(normals[:, 1] < 0)  # y goes away from the viewer
    seen = seen[np.argsort(-places[faces[seen], 1].mean(-1))]
    bright = 0.6 + 0.4 * (smooth[faces[seen]].mean(1) @ LIGHT).clip(0)
    colours = bright.round(2)[:, None] * to_rgb(SKIN)
    return PolyCollection(places[faces[seen]][..., [0, 2]], facecolors=colours, edgecolors=colours, linewidths=0.4)
