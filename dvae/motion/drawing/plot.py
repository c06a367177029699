"""Figures of skeletons: a pose, observed motion with its possible futures, and both in motion."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from math import ceil, pi
from os import PathLike
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D
from torch import Tensor

from ... import files
from ...lazy import optional
from ..geometry.skeleton import Skeleton, rotate_about_up

if TYPE_CHECKING:
    import plotly.graph_objects as go
else:
    go = optional("plotly.graph_objects", "motion")

PAST, TRUTH, FIXED, GIVEN, SKIN = "black", "#1a7f37", "#4a4f57", "#cf222e", "#c3b2a1"

SPACING = 1.15
"""Metres between the skeletons of a figure."""

MARGIN = 0.15
"""Metres around all skeletons of an animation."""

ELEVATION = 0.2
"""Radians by which the viewer of an animation looks down."""

_PLAYER = """
const figure = document.getElementById('{plot_id}'), scene = figure._fullLayout.scene._scene;
const [place, update] = [scene.setViewport, scene.updateFx];
const {w, h} = figure._fullLayout._size, {x, y, z} = scene.fullSceneLayout.aspectratio, {high} = figure.layout.meta;
const height = Math.min(h, w * high / x), fit = 1.9 * Math.min(w / height / x, 1 / high);
document.body.style.margin = 0;
Plotly.relayout(figure, {
  'height': figure._fullLayout.height - h + height,
  'scene.aspectratio': {x: x * fit, y: y * fit, z: z * fit},
});
let turning = false, drag = scene.fullSceneLayout.dragmode, due = 0;
figure.addEventListener('pointerdown', () => { turning = true; }, true);
for (const end of ['pointerup', 'pointercancel']) window.addEventListener(end, () => { turning = false; }, true);
scene.setViewport = layout => { if (!turning) place.call(scene, layout); };
scene.updateFx = (mode, hover) => { if (mode !== drag) update.call(scene, drag = mode, hover); };
figure.on('plotly_animating', () => { due = performance.now(); });
figure.on('plotly_animatingframe', () => {
  const spacing = figure.layout.meta.milliseconds, queue = figure._transitionData._frameQueue;
  const late = Math.max(0, Math.floor((performance.now() - due) / spacing));
  queue.splice(0, Math.min(late, queue.length - 1));
  due += (late + 1) * spacing;
});
"""
"""What plotly lacks: the scene fills the window, or is as high as the window's width lets it be; it can be turned while
it plays, and keeps its speed on a slow machine by leaving frames out."""


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
    """People for an animation; see `animate` for its arguments and what it refuses."""
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


def animate(
    skeleton: Skeleton,
    observed: Any,
    samples: Any = None,
    truth: Any = None,
    *,
    names: Sequence[str] = (),
    fixed: Collection[int] = (),
    every: int | None = None,
    view: float = pi / 5,
    title: str = "",
) -> go.Figure:
    """Skeletons that move side by side, to play, scrub and turn: what happened, and sampled futures.

    (Longer than other functions by what is drawn, one thing after the other.)

    Everybody repeats the observed motion in black and goes on in the colours of `futures`, seen from the same side.
    Time zero is the last observed pose.

    A notebook shows the figure; `save_html` writes it to a file.

    Args:
        skeleton: the tree.
        observed: (O, J, 3) in metres, numpy or torch; NaN where a joint is missing, as in the truth.
        samples: (K, H, J, 3) in metres; without them the observed motion is played alone, from time zero.
        truth: (F, J, 3) in metres, where it is known; F is at most H.
        names: what to call the K samples; by default they are numbered.
        fixed: joints that move alike in all samples; bones that end in them are drawn dark and thick.
        every: frames from one that is shown to the next, the last observed always among them; by default so that
            about 25 a second are shown. The speed is the motion's own.
        view: radians between the last observed heading and the viewer, before the scene is turned.
        title: above the figure.

    Returns:
        A plotly figure in metres: x to the viewer's right, y away from the viewer, z up. A skeleton is a trace of
        polylines with gaps between them; with fixed joints, one trace for the other bones and one for these.

    Raises:
        ValueError: the shapes do not fit each other or the skeleton, there is nothing to draw, a position is not
            finite, or names, fixed or every do not fit the motion.
    """
    stage = staged(skeleton, observed, samples, truth, names=names, fixed=fixed, every=every, view=view)
    low, high, places = stage.low, stage.high, stage.places
    gap = np.full((*stage.motion.shape[:2], 1, 3), np.nan)
    motion = np.concatenate([stage.motion + places[:, None, None], gap], axis=2).astype(np.float32)

    drawn = []
    for k, colour in enumerate(stage.colours):
        drawn.append((k, colour, _polylines(skeleton, set(range(skeleton.joints)) - stage.shared(k)), 6))
        if stage.shared(k):
            drawn.append((k, FIXED, _polylines(skeleton, stage.shared(k)), 9))
    now, shown = stage.now, stage.shown

    def traces(frame: int) -> list[dict[str, Any]]:
        """What changes from frame to frame."""
        return [
            {
                "type": "scatter3d",
                **dict(zip("xyz", motion[k, frame, path].T, strict=True)),
                "line": {"color": PAST if frame <= now else colour},
            }
            for k, colour, path, _ in drawn
        ]

    first = traces(shown[0])
    for trace, (k, _, _, width) in zip(first, drawn, strict=True):
        trace |= {"mode": "lines", "name": _literal(stage.names[k]), "hoverinfo": "skip"}
        trace["line"]["width"] = width
    return _figure(
        first,
        (low, high),
        places,
        stage.names,
        title,
        margin=110,
        milliseconds=stage.milliseconds,
        frames=[go.Frame(name=str(f), data=traces(f), traces=list(range(len(drawn)))) for f in shown],
        **_player({str(f): stage.seconds(f) for f in shown}, stage.milliseconds),
    )


def surfaces(faces: Any, vertices: Any, *, names: Sequence[str] = (), up: str = "y", title: str = "") -> go.Figure:
    """Bodies that stand side by side, to turn.

    Args:
        faces: triangles, (F, 3).
        vertices: of one pose (V, 3) or of P bodies or poses (P, V, 3), metres, numpy or torch without gradients.
        names: what to call them; by default they are not named.
        up: the vertical axis, "y" or "z".
        title: above the figure.

    Returns:
        A plotly figure in metres as that of `animate`: a mesh for each, seen from the front of who faces heading zero.

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
    middle = (people.min(1, keepdims=True) + people.max(1, keepdims=True)) / 2
    people = people - middle * [1, 1, 0]
    low, high = people.min((0, 1)), people.max((0, 1))
    places = _places(len(people), high - low + 0.2)
    people = people + places[:, None]
    meshes = [
        {
            **{"type": "mesh3d", "name": _literal(name), "color": SKIN, "hoverinfo": "skip"},
            **dict(zip("xyz", body.T.astype(np.float32), strict=True)),
            **dict(zip("ijk", corners.T, strict=True)),
            # normals of triangles of a square centimetre are else taken for rounding
            "lighting": {"facenormalsepsilon": 0, "vertexnormalsepsilon": 0, "ambient": 0.4, "specular": 0.05},
            "lightposition": {"x": -5e4, "y": 7e4, "z": -7e4},  # as the viewer has it: left, above, in front
        }
        for name, body in zip(names, people, strict=True)
    ]
    return _figure(meshes, (low, high), places, names, title)


def save_html(figure: go.Figure, path: str | PathLike[str]) -> None:
    """Write a figure of `animate` or `surfaces` as one HTML file, which needs no network; motion has its own speed."""
    page = figure.to_html(auto_play=False, post_script=_PLAYER, config={"displaylogo": False})
    with files.written(path) as file:
        file.write(page.encode())


def _figure(
    drawn: list[Any],
    box: tuple[np.ndarray, np.ndarray],
    places: np.ndarray,
    names: Sequence[str],
    title: str,
    *,
    margin: int = 0,
    milliseconds: float = 0,
    frames: Sequence[go.Frame] = (),
    **layout: Any,
) -> go.Figure:
    """Traces on a floor, each in a box (two corners) about its place (P, 3), with names above."""
    low, high = box
    floors, labels = np.unique(places[:, 2]) + low[2], _labels(names, places, high[2])
    low, high = low + places.min(0) - MARGIN, high + places.max(0) + MARGIN
    scene, fill = _scene(low, high)
    return go.Figure(
        data=[*drawn, *(_floor(low[:2], high[:2], height) for height in floors)],
        frames=frames,
        layout={
            "title": {"text": _literal(title), "x": 0.5, "font": {"size": 16}},
            "template": "none",
            "showlegend": False,
            "margin": {"l": 0, "r": 0, "t": 40 if title else 0, "b": margin},
            "scene": {**scene, "annotations": labels},
            **layout,
            "meta": {"milliseconds": milliseconds, "high": fill},
        },
    )


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


def _player(seconds: dict[str, float], spacing: float) -> dict[str, Any]:
    """The part of a layout that plays frames, which are given by name and time, some milliseconds apart."""

    def go_to(frames: list[str | None] | None, milliseconds: float = 0) -> dict[str, Any]:
        speed = {"duration": milliseconds, "redraw": True}
        options = {"frame": speed, "transition": {"duration": 0}, "mode": "immediate", "fromcurrent": frames is None}
        return {"method": "animate", "args": [frames, options]}

    # half a refresh of a display less: a frame that waited its whole time would often miss the refresh
    play = {"label": "Play", **go_to(None, max(spacing - 8, 0))}
    corner = {"y": 0, "yanchor": "top", "xanchor": "left"}
    buttons = [play, {"label": "Pause", **go_to([None])}]
    steps = [{"label": f"{time:.2f}", **go_to([name])} for name, time in seconds.items()]
    return {
        "updatemenus": [{"type": "buttons", "showactive": False, "buttons": buttons, "x": 0.01, **corner}],
        "sliders": [{"steps": steps, "currentvalue": {"suffix": " s"}, "x": 0.12, "len": 0.86, **corner}],
    }


def _seen(skeleton: Skeleton, past: np.ndarray, futures: Sequence[np.ndarray], horizon: int, view: float) -> np.ndarray:
    """Motions (P, O + H, J, 3) as the viewer of an animation sees them, with z up."""
    motion = np.full((len(futures), len(past) + horizon, skeleton.joints, 3), np.nan)
    for k, ahead in enumerate(futures):  # a truth that ends early leaves NaN, which plotly does not draw
        motion[k, : len(past) + len(ahead)] = np.concatenate([past, ahead])
    turn = torch.tensor(view - facing(skeleton, torch.from_numpy(past)), dtype=torch.float64)
    motion = rotate_about_up(torch.from_numpy(motion), turn, skeleton.up).numpy()
    return motion if skeleton.up == "z" else motion[..., [0, 2, 1]] * [1, -1, 1]  # plotly turns a scene about z


def _places(people: int, step: np.ndarray) -> np.ndarray:
    """Where to stand (P, 3), `step` apart, so that all are as large as can be in a window of 2:1."""
    wide = step[0] / step[2]
    rows = min(range(1, people + 1), key=lambda rows: max(rows, ceil(people / rows) * wide / 2))
    row, column = np.divmod(np.arange(people), ceil(people / rows))
    return np.stack([column * step[0], 0.0 * row, -row * step[2]], axis=-1)  # rows one above the other


def _scene(low: np.ndarray, high: np.ndarray) -> tuple[dict[str, Any], float]:
    """The part of a layout that shows what lies between two corners (3,), and how much of its height is filled."""
    size = high - low
    height = size[2] * np.cos(ELEVATION) + size[1] * np.sin(ELEVATION)
    # an orthographic scene is 2 high, and as wide as the window makes it, here taken for 2:1; what lies behind the eye
    # is not seen, from wherever it looks
    fit = max(height, size[0] / 2)
    ratio = 1.9 * size / fit
    far = float(np.linalg.norm(ratio))
    eye = {"x": 0.0, "y": -far * np.cos(ELEVATION), "z": far * np.sin(ELEVATION)}
    scene = {
        # what lies on the limits of a range would be cut away in part
        f"{axis}axis": {"visible": False, "range": [low[i] - 0.01, high[i] + 0.01]}
        for i, axis in enumerate("xyz")
    } | {
        "aspectmode": "manual",
        "aspectratio": dict(zip("xyz", ratio, strict=True)),
        "dragmode": "turntable",
        "camera": {"eye": eye, "projection": {"type": "orthographic"}},
    }
    return scene, 1.9 * height / fit


def _labels(names: Sequence[str], places: np.ndarray, top: float) -> list[dict[str, Any]]:
    """Names over the heads of those who stand at places (P, 3)."""
    return [
        {"text": _literal(name), "font": {"size": 14}, "showarrow": False, "x": x, "y": y, "z": z + top + MARGIN}
        for name, (x, y, z) in zip(names, places, strict=True)
    ]


def _literal(text: str) -> str:
    """A text for plotly, which takes tags for markup, links among them, and dollar signs for formulas."""
    return escape(text, quote=False).replace("$", "&#36;")


def _floor(low: np.ndarray, high: np.ndarray, height: float) -> dict[str, Any]:
    """A trace: a grid of half metres between two corners (2,)."""
    x, y = (np.unique([a, *np.arange(ceil(2 * a) / 2, b, 0.5), b]) for a, b in zip(low, high, strict=True))
    rows = [[(x[0], b, height), (x[-1], b, height)] for b in y]
    columns = [[(a, y[0], height), (a, y[-1], height)] for a in x]
    lines = np.array([[*ends, (np.nan,) * 3] for ends in rows + columns]).reshape(-1, 3)
    line = {"color": "#d5d8dd", "width": 1}
    return {
        **{"type": "scatter3d", "name": "floor", "mode": "lines", "line": line, "hoverinfo": "skip"},
        **dict(zip("xyz", lines.T, strict=True)),
    }


def _colours(samples: int) -> np.ndarray:
    """(K, 4): a colour for each sample."""
    return plt.get_cmap("turbo")(np.linspace(0.05, 0.95, samples))


def facing(skeleton: Skeleton, positions: Tensor) -> float:
    """Where the person of motion (F, J, 3) faces in the end; zero where the skeleton does not tell left from right."""
    return float(skeleton.heading_near(positions, len(positions) - 1)) if skeleton.left and skeleton.right else 0.0


def _polylines(skeleton: Skeleton, joints: Collection[int]) -> list[int]:
    """The bones that end in the given joints as polylines: indices of joints, J between two polylines."""
    path: list[int] = []
    for parent, joint in skeleton.edges:
        if joint in joints:
            path += [joint] if path and path[-1] == parent else [skeleton.joints, parent, joint]
    return path[1:]


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
