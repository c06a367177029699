"""Figures of skeletons and bodies: poses, observed motion with possible futures, and surfaces."""

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

from ...inference.evaluation.picture import WIDTH, Picture
from ...inference.evaluation.result import new_figure, styled
from ..geometry.skeleton import Skeleton, rotate_about_up

PAST, TRUTH, FIXED, GIVEN, SKIN = "black", "#1a7f37", "#4a4f57", "#cf222e", "#c3b2a1"

SPACING = 1.15
"""Distance in metres between the skeletons of a figure."""

LIGHT = np.array([-0.5, -0.6, 0.63])
"""Direction of the light on surfaces: from the left, the front and above."""


def pose(
    ax: Axes,
    positions: Any,
    skeleton: Skeleton,
    *,
    offset: tuple[float, float] = (0.0, 0.0),
    azimuth: float = 0.0,
    **line: Any,
) -> None:
    """Draw poses, (J, 3) or several at once (..., J, 3), seen from the front of a person with heading zero.

    Args:
        ax: axes to draw on; their units are metres.
        positions: (..., J, 3) in metres, numpy or torch.
        skeleton: skeleton of the poses.
        offset: horizontal and vertical offset of the drawing in metres.
        azimuth: rotation of the people about the up axis in radians.
        **line: options of matplotlib's LineCollection, such as colors, linewidths, alpha.
    """
    poses = torch.as_tensor(np.asarray(positions), dtype=torch.float64).reshape(-1, skeleton.joints, 3)
    rotated = rotate_about_up(poses, torch.tensor(azimuth, dtype=torch.float64), skeleton.up).numpy()
    drawing = np.stack([rotated[..., 0] + offset[0], rotated[..., skeleton.vertical] + offset[1]], axis=-1)
    bones = list(drawing[:, skeleton.edges].reshape(-1, 2, 2))
    ax.add_collection(LineCollection(bones, **{"capstyle": "round", **line}))


def hide_axes(ax: Axes) -> None:
    """Set an equal aspect ratio, and remove frame and ticks."""
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_yticks([])
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)


@styled
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
    """Draw observed motion and sampled futures, as skeletons from left to right over time.

    The past is black, the truth green, and each sample keeps its own colour over time. Every pose is drawn relative to
    its pelvis. All poses are seen from the same side: the last observed pose is seen from the front, rotated by `view`.
    With `paths`, poses after the last observed one are not centred one by one: all poses of a frame are drawn relative
    to the mean pelvis position of the samples, and the paths are drawn as crosses.

    Args:
        skeleton: skeleton of the poses.
        observed: (O, J, 3) in metres, numpy or torch; NaN where a joint is missing, as in the truth.
        samples: (K, H, J, 3) in metres.
        truth: (F, J, 3) in metres, if known; F is at most H.
        frames: number of future frames to draw; the last one is always included.
        ax: axes; default: a new figure.
        view: angle in radians between the last observed heading and the viewer.
        paths: dictionary from joint name to a path (H, 3) in metres that the samples were conditioned on; NaN where
            unknown.

    Returns:
        The axes; `ax.figure.savefig(...)` saves them.

    Raises:
        ValueError: the shapes do not match each other or the skeleton, or are empty.
    """
    past, future, real = _as_arrays(skeleton, observed, samples, truth)
    if not len(past):
        raise ValueError("observed has no frame; `futures` draws at least one")
    crosses = _path_array(paths or {}, skeleton, future.shape[1])
    azimuth = view - final_heading(skeleton, torch.from_numpy(past))
    now, horizon = len(past) - 1, future.shape[1]
    ahead = np.unique(np.linspace(0, horizon, frames + 1)[1:].round().clip(1)).astype(int)
    columns = [*sorted({0, now}), *(now + ahead)]
    if ax is None:
        figure = plt.figure(
            figsize=(WIDTH, min(2.3, 0.6 + 11 / len(columns))), layout="constrained", FigureClass=Picture
        )
        ax = figure.subplots()

    middle = future[:, :, skeleton.root].mean(0)
    digits = 1 if horizon >= frames * skeleton.fps / 10 else 2

    def draw(poses: np.ndarray, column: int, **line: Any) -> None:
        is_shared = len(crosses) and columns[column] > now
        origin = middle[columns[column] - now - 1] if is_shared else centres(skeleton, poses)
        pose(ax, poses - origin, skeleton, offset=(column * SPACING, 0.0), azimuth=azimuth, **line)

    colours = _colours(len(future)).repeat(len(skeleton.edges), axis=0)
    opacity = float(np.clip(6 / len(future), 0.15, 0.9))
    for column, frame in enumerate(columns):
        if frame <= now:
            draw(past[frame], column, colors=PAST, linewidths=1.8)
            continue
        draw(future[:, frame - now - 1], column, colors=colours, linewidths=1.2, alpha=opacity)
        if real is not None and frame - now <= len(real):
            draw(real[frame - now - 1], column, colors=TRUTH, linewidths=1.8)
        if len(crosses):
            offsets = torch.from_numpy(crosses[:, frame - now - 1] - middle[frame - now - 1])
            rotated = rotate_about_up(offsets, torch.tensor(azimuth, dtype=torch.float64), skeleton.up).numpy()
            ax.plot(column * SPACING + rotated[:, 0], rotated[:, skeleton.vertical], "x", color=GIVEN, zorder=3)

    hide_axes(ax)
    seconds = [(frame - now) / skeleton.fps for frame in columns]
    ax.set_xticks(SPACING * np.arange(len(columns)), [f"{s:+.{digits}f} s" if s else "0 s" for s in seconds])
    _add_legend(ax, len(future), real is not None, len(crosses) > 0)
    return ax


@dataclass(frozen=True, eq=False)
class Scene:
    """People who move next to each other, in metres in the viewer's coordinates: x to the right, y away, z up.

    Attributes:
        skeleton: skeleton of all people.
        names: names of the P people; the truth, if any, is the first.
        colours: colour of each person after frame `now`.
        motion: (P, O + H, J, 3) in metres, without the offsets of `places`; NaN after the end of a motion that ends
            early.
        now: index of the last observed frame; -1 if people share no past.
        frames: indices of the frames to show, including `now`.
        fixed: joints that move in the same way in all samples.
        truth: whether the truth is included.
    """

    skeleton: Skeleton
    names: list[str]
    colours: list[str]
    motion: np.ndarray
    now: int
    frames: range
    fixed: frozenset[int]
    truth: bool

    @property
    def low(self) -> np.ndarray:
        """(3,), minimum coordinates over all people, frames and joints, in metres."""
        return np.nanmin(self.motion, (0, 1, 2))  # type: ignore[no-any-return]

    @property
    def high(self) -> np.ndarray:
        """(3,), maximum coordinates over all people, frames and joints, in metres."""
        return np.nanmax(self.motion, (0, 1, 2))  # type: ignore[no-any-return]

    @property
    def places(self) -> np.ndarray:
        """(P, 3), offset of each person in metres, so that people do not overlap."""
        return _places(len(self.motion), np.maximum(self.high - self.low + 0.4, SPACING))

    @property
    def milliseconds(self) -> float:
        """Time between shown frames in milliseconds, at original speed."""
        return 1000 * self.frames.step / self.skeleton.fps

    def seconds(self, frame: int) -> float:
        """Return the time in seconds of a frame relative to the last observed frame, or else to the first."""
        return (frame - max(self.now, 0)) / self.skeleton.fps

    def shared(self, person: int) -> frozenset[int]:
        """Return the joints of a person that move in the same way in all samples; none for the truth."""
        return frozenset() if self.truth and person == 0 else self.fixed


def make_scene(
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
    """Return the scene of an animation: observed motion, sampled futures and, if known, the true future.

    Args:
        skeleton: skeleton of the poses.
        observed: (O, J, 3) in metres, numpy or torch; NaN where a joint is missing. With O = 0, people share no past,
            and time zero is their first pose.
        samples: (K, H, J, 3) in metres; None to draw the observed motion without a past. Without a past, NaN marks
            missing joints, and all joints after the end of a shorter motion.
        truth: (F, J, 3) in metres with F at most H, NaN where a joint is missing; None if unknown.
        names: names of the K samples; numbers by default.
        fixed: indices of joints that move in the same way in all samples.
        every: number of frames between drawn frames; by default, about 25 frames per second are drawn.
        view: angle in radians between the last observed heading, or the first person's first one, and the viewer.

    Raises:
        ValueError: the shapes do not match each other or the skeleton, an array is empty, a position is not finite, or
            `names`, `fixed` or `every` do not match the motion.
    """
    if samples is None:
        motion = np.asarray(observed)
        observed, samples, names = motion[:0], motion[None], names or [""]
    past, future, real = _as_arrays(skeleton, observed, samples, truth)
    has_past = len(past) > 0
    fixed_joints = frozenset(map(int, fixed))
    names = names or [f"sample {k + 1}" for k in range(len(future))]
    every = max(1, round(skeleton.fps / 25)) if every is None else every
    if len(names) != len(future):
        raise ValueError(f"{len(names)} names for {len(future)} samples; give one name for each")
    if unknown := fixed_joints - set(range(skeleton.joints)):
        raise ValueError(f"fixed has joints {sorted(unknown)}; expected indices from 0 to {skeleton.joints - 1}")
    if every < 1:
        raise ValueError(f"every is {every}; expected 1 to draw each frame, 2 to draw every second one, and so on")
    arrays = [array for array in (past, real, future) if array is not None]
    if (has_past and np.isnan(future).any()) or any(np.isinf(positions).any() for positions in arrays):
        raise ValueError("observed, samples or truth have NaN or infinite positions, which cannot be drawn")
    people = list(zip(names, map(to_hex, _colours(len(future))), future, strict=True))
    if real is not None:
        people.insert(0, ("truth", TRUTH, real))
    labels, colours, aheads = map(list, zip(*people, strict=True))
    motion = _to_viewer(skeleton, past, aheads, future.shape[1], view)
    now = len(past) - 1
    shown_frames = range(max(now, 0) % every, motion.shape[1], every)
    return Scene(skeleton, labels, colours, motion, now, shown_frames, fixed_joints, real is not None)


def _add_legend(ax: Axes, samples: int, truth: bool, paths: bool) -> None:
    """Add a legend of the colours of `futures` below the labels of time.

    Args:
        ax: axes of `futures`.
        samples: number of samples.
        truth, paths: whether the truth and given paths were drawn.
    """
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
        borderaxespad=2,  # the height of the time labels
        ncols=len(key),
    )


def _to_viewer(
    skeleton: Skeleton, past: np.ndarray, futures: Sequence[np.ndarray], horizon: int, view: float
) -> np.ndarray:
    """Return motions (P, O + H, J, 3) of the observed past and P futures in the viewer's coordinates, with z up."""
    motion = np.full((len(futures), len(past) + horizon, skeleton.joints, 3), np.nan)
    for k, ahead in enumerate(futures):  # a motion that ends early leaves NaN, which is not drawn
        motion[k, : len(past) + len(ahead)] = np.concatenate([past, ahead])
    start = motion[0, : max(len(past), 1)]
    turn = torch.tensor(view - final_heading(skeleton, torch.from_numpy(start)), dtype=torch.float64)
    motion = rotate_about_up(torch.from_numpy(motion), turn, skeleton.up).numpy()
    return motion if skeleton.up == "z" else motion[..., [0, 2, 1]] * [1, -1, 1]


def centres(skeleton: Skeleton, poses: np.ndarray) -> np.ndarray:
    """Return the root of poses (..., J, C) as (..., 1, C), or the mean of the known joints where it is missing."""
    known, root = np.isfinite(poses), poses[..., skeleton.root : skeleton.root + 1, :]
    mean = np.where(known, poses, 0.0).sum(-2, keepdims=True) / known.sum(-2, keepdims=True).clip(1)
    return np.where(np.isfinite(root), root, mean)


def _places(people: int, step: np.ndarray) -> np.ndarray:
    """Return positions (P, 3), `step` apart, in rows that make all people as large as possible in a window of 2:1."""
    wide = step[0] / step[2]
    rows = min(range(1, people + 1), key=lambda rows: max(rows, ceil(people / rows) * wide / 2))
    row, column = np.divmod(np.arange(people), ceil(people / rows))
    return np.stack([column * step[0], 0.0 * row, -row * step[2]], axis=-1)  # rows one above the other


def _colours(samples: int) -> np.ndarray:
    """Return a colour (RGBA) for each sample, (K, 4), which colour-blind readers can order by brightness."""
    return plt.get_cmap("plasma")(np.linspace(0.1, 0.72, samples))


def final_heading(skeleton: Skeleton, positions: Tensor) -> float:
    """Return the heading in radians at the end of motion (F, J, 3); 0 if the skeleton has no left and right side."""
    return float(skeleton.heading_near(positions, len(positions) - 1)) if skeleton.left and skeleton.right else 0.0


def _path_array(paths: Mapping[str, Any], skeleton: Skeleton, horizon: int) -> np.ndarray:
    """Return the paths of joints as an array (paths, H, 3), or raise an error if a joint or shape is wrong."""
    arrays = {joint: np.asarray(path, np.float64) for joint, path in paths.items()}
    for joint, path in arrays.items():
        skeleton.find(joint)  # raises an error for an unknown joint
        if path.shape != (horizon, 3):
            raise ValueError(
                f"the path of {joint} has shape {path.shape}, expected ({horizon}, 3), as long as the samples"
            )
    return np.array([*arrays.values()]).reshape(-1, horizon, 3)


def _as_arrays(
    skeleton: Skeleton, observed: Any, samples: Any, truth: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return observed motion, samples and truth as arrays, or raise an error if their shapes do not match."""
    past, future = np.asarray(observed, np.float64), np.asarray(samples, np.float64)
    real = None if truth is None else np.asarray(truth, np.float64)
    joint = (skeleton.joints, 3)
    samples_fit = past.ndim == 3 and past.shape[1:] == joint and future.ndim == 4 and future.shape[2:] == joint
    truth_fits = real is None or (real.ndim == 3 and real.shape[1:] == joint and len(real) <= future.shape[1])
    if not (samples_fit and truth_fits and future.size):
        raise ValueError(
            f"expected observed (O, J, 3), samples (K, H, J, 3) and truth (F, J, 3) with J = {joint[0]} and F at most "
            f"H, got {past.shape}, {future.shape} and {None if real is None else real.shape}"
        )
    return past, future, real


@styled
def surfaces(faces: Any, vertices: Any, *, names: Sequence[str] = (), up: str = "y", title: str = "") -> Figure:
    """Draw bodies next to each other, seen from the front of a person with heading zero.

    Args:
        faces: (F, 3), vertex indices of triangles.
        vertices: (V, 3) for one pose, or (P, V, 3) for P bodies or poses, in metres, numpy or torch without gradients.
        names: names of the bodies; default: no names.
        up: vertical axis, "y" or "z".
        title: title of the figure.

    Returns:
        A figure whose axes are in metres.

    Raises:
        ValueError: the shapes do not match each other, a position is not finite, the number of names is wrong, or `up`
            is another axis.
    """
    if up not in ("y", "z"):
        raise ValueError(f'up is {up!r}; expected "y" or "z"')
    corners, people = np.asarray(faces), np.asarray(vertices, np.float64)
    people = people[None] if people.ndim == 2 else people
    names = names or [""] * len(people)
    if corners.shape[1:] != (3,) or people.ndim != 3 or people.shape[2] != 3 or not (people.size and corners.size):
        raise ValueError(f"expected faces (F, 3) and vertices (P, V, 3), got {corners.shape} and {people.shape}")
    if not (0 <= corners.min() <= corners.max() < people.shape[1]):
        raise ValueError(f"a face refers to vertex {corners.max()}, but there are {people.shape[1]} vertices")
    if not np.isfinite(people).all():
        raise ValueError("vertices have NaN or infinite positions, which cannot be drawn")
    if len(names) != len(people):
        raise ValueError(f"{len(names)} names for {len(people)} bodies; give one name for each")
    people = people if up == "z" else people[..., [0, 2, 1]] * [1, -1, 1]
    people = people - (people.min(1, keepdims=True) + people.max(1, keepdims=True)) / 2 * [1, 1, 0]
    size = np.ptp(people, axis=(0, 1)) + 0.2
    places = _places(len(people), size)
    columns, rows = len({*places[:, 0]}), len({*places[:, 2]})
    width = min(WIDTH, 4.5 * columns)
    figure = new_figure(width, min(9.0, width * rows * size[2] / (columns * size[0])))
    ax = figure.subplots()
    for name, body, place in zip(names, people, places, strict=True):
        ax.add_collection(_mesh(corners, body + place))
        ax.text(place[0], place[2] + people[..., 2].max() + 0.05, name, ha="center", parse_math=False)
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()
    figure.suptitle(title, parse_math=False)
    return figure


def _mesh(faces: np.ndarray, places: np.ndarray) -> PolyCollection:
    """Return the triangles that face the viewer, shaded by the light; the nearest is drawn last.

    Args:
        faces: (F, 3), vertex indices of triangles.
        places: (V, 3), vertices in the viewer's coordinates.
    """
    first, second, third = places[faces].swapaxes(0, 1)
    normals = np.cross(second - first, third - first)
    smooth = np.zeros_like(places)
    np.add.at(smooth, faces, normals[:, None])
    smooth /= np.linalg.norm(smooth, axis=-1, keepdims=True).clip(1e-12)
    visible = np.flatnonzero(normals[:, 1] < 0)  # y points away from the viewer
    visible = visible[np.argsort(-places[faces[visible], 1].mean(-1))]
    brightness = 0.6 + 0.4 * (smooth[faces[visible]].mean(1) @ LIGHT).clip(0)
    colours = brightness.round(2)[:, None] * to_rgb(SKIN)
    return PolyCollection(places[faces[visible]][..., [0, 2]], facecolors=colours, edgecolors=colours, linewidths=0.4)
