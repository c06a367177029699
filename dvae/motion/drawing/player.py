"""Interactive animations of skeletons in HTML pages and notebooks, small and without a library: play, seek, rotate.

A scene is stored as integers in millimetres: the observed frames, which all people share, then the future of each
person. Frames are stored as differences from the previous frame, if any, and a missing joint has the coordinate
`MISSING`.
First all low bytes and then all high bytes of these 16-bit integers are deflated and encoded in base64. In this form,
50 futures of a window take about 100 kB.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import zlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import ceil, pi
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

from ... import files
from ..geometry.skeleton import Skeleton
from .plot import FIXED, PAST, SPACING, Scene, centres, make_scene

SCRIPT = Path(__file__).with_name("player.js").read_text(encoding="utf-8")
"""Script of a page with players: controls, and stages that they move together."""

STYLE = Path(__file__).with_name("player.css").read_text(encoding="utf-8")
"""Style of players."""

MILLIMETRE = 1e-3

MISSING = -32768
"""Integer that stands for an unknown coordinate."""

FRAMES, COLOURS = 40, 32
"""Largest numbers of pictures and colours of a GIF."""

WIDTH, PIXELS, ACROSS = 600.0, 95.0, 6
"""Largest width of a GIF in pixels, its pixels per metre, and its number of people in a row."""

_CONTROLS = Markup(
    '<div class="controls"><button type="button">Play</button>'
    '<input type="range" min="0" max="1" value="0" step="any" aria-label="time">'
    '<output></output><select aria-label="window"{}>{}</select></div>'
)
_OPTION = Markup('<option value="{}">{}</option>')
_STAGE = Markup(
    '<canvas class="stage" data-motion="{}" tabindex="0" role="img" '
    'aria-label="moving skeletons; drag, or press the arrow keys, to turn them"></canvas><p class="note">{}</p>'
)


def controls(titles: Collection[str]) -> Markup:
    """Return the HTML of the controls of all stages in the same element; the page must contain `SCRIPT` once.

    Args:
        titles: titles of the scenes, the same for all stages; one scene is shown at a time.
    """
    windows = Markup().join(_OPTION.format(index, title) for index, title in enumerate(titles))
    return _CONTROLS.format(Markup(" hidden") if len(titles) == 1 else "", windows)


def stage(scenes: Sequence[Scene]) -> Markup:
    """Return the HTML of scenes, shown one at a time as the `controls` select."""
    motion = [_scene(scene) for scene in scenes]
    rounding, fps = max(1000 * scene["unit"] for scene in motion), scenes[0].skeleton.fps
    note = (
        f"Positions are rounded to {rounding:.2g} mm; {fps / scenes[0].frames.step:.3g} of {fps:.3g} frames per second "
        "are stored. Drag a skeleton, or press the arrow keys, to turn it."
    )
    return _STAGE.format(json.dumps(motion, separators=(",", ":"), allow_nan=False), note)


def _scene(scene: Scene) -> dict[str, Any]:
    """Return a scene in the format of the script, with packed coordinates."""
    motion = scene.motion[:, scene.frames]
    observed = sum(frame <= scene.now for frame in scene.frames)
    low, high = scene.low, scene.high
    unit = max(MILLIMETRE, np.abs([low, high]).max() / 32767)
    past, future = np.split(np.nan_to_num(np.round(motion / unit), nan=MISSING), [observed], axis=1)
    ends = [np.flatnonzero((ahead != MISSING).any((1, 2))).max(initial=-1) + 1 for ahead in future]
    futures = [ahead[:end] for ahead, end in zip(future, ends, strict=True)]
    pieces = [np.diff(past[0], axis=0, prepend=0)]
    pieces += [np.diff(ahead, axis=0, prepend=past[0, -1:] if observed else 0) for ahead in futures]
    middle = (low + high) / 2
    return {
        "joints": scene.skeleton.joints,
        "bones": scene.skeleton.edges,
        "observed": observed,
        "frames": len(scene.frames),
        "milliseconds": scene.milliseconds,
        "people": [
            {"name": name, "colour": colour, "frames": len(ahead), "fixed": sorted(scene.shared(k))}
            for k, (name, colour, ahead) in enumerate(zip(scene.names, scene.colours, futures, strict=True))
        ],
        "dark": FIXED,
        "past": PAST,
        "unit": unit,
        "middle": middle[:2].tolist(),
        "reach": float(np.nanmax(np.linalg.norm(motion[..., :2] - middle[:2], axis=-1))),
        "low": float(low[2]),
        "high": float(high[2]),
        "packed": _pack(np.concatenate([piece.ravel() for piece in pieces])),
    }


def _pack(steps: np.ndarray) -> str:
    """Encode integers modulo 2^16 in base64.

    Differences between frames may exceed 16 bits, but their sums modulo 2^16 are the original coordinates.
    """
    planes = steps.astype(np.int64).astype("<u2").view(np.uint8).reshape(-1, 2).T
    return base64.b64encode(zlib.compress(planes.tobytes(), 9)).decode()


@dataclass(frozen=True, eq=False)
class Animation:
    """Skeletons that move next to each other.

    Notebooks display a GIF. `save` writes an interactive page that any browser plays offline.

    Args:
        scene: scene with the people.
        title: title above the scene.
    """

    scene: Scene
    title: str = ""

    def to_html(self) -> str:
        """Return an HTML page that loads no other files and runs only the player's script."""
        allowed = base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode()
        heading = Markup("<h1>{}</h1>").format(self.title) if self.title else ""
        moving = heading + controls(["motion"]) + stage([self.scene])
        return str(
            _PAGE.format(title=self.title, policy=allowed, style=Markup(STYLE), player=moving, script=Markup(SCRIPT))
        )

    def save(self, path: str | PathLike[str]) -> None:
        """Write the HTML page of `to_html` to a file."""
        with files.atomic_write(path) as file:
            file.write(self.to_html().encode())

    def to_gif(self) -> bytes:
        """Return a GIF that repeats the motion at original speed, in at most `FRAMES` pictures of at least 20 ms.

        All people stay in their places: every pose is drawn relative to its pelvis, seen from the front.
        """
        scene = self.scene
        every = ceil(len(scene.frames) / FRAMES)
        motion = scene.motion[:, scene.frames][:, ::every][..., [0, 2]]
        motion = motion - centres(scene.skeleton, motion) * [1, 0]
        low, high = (find(motion, axis=(0, 1, 2)) for find in (np.nanmin, np.nanmax))
        step = [max(SPACING, high[0] - low[0] + 0.2), high[1] - low[1] + 0.4]
        rows = ceil(len(motion) / ACROSS)
        row, column = np.divmod(np.arange(len(motion)), ceil(len(motion) / rows))
        places = np.stack([column * step[0], -row * step[1]], -1)
        corner, top = (1.0 * column.max() + 1) * step[0], high[1] + 0.35
        width = min(WIDTH, PIXELS * corner)
        figure = Figure(figsize=(width / 72, width * rows * step[1] / corner / 72), dpi=72)
        ax = figure.add_axes((0, 0, 1, 1), xlim=(low[0] - 0.1, low[0] - 0.1 + corner), ylim=(top - rows * step[1], top))
        ax.set_axis_off()
        edges = np.array(scene.skeleton.edges, int).reshape(-1, 2)
        people = [LineCollection([], capstyle="round") for _ in places]
        for lines, name, place in zip(people, scene.names, places, strict=True):
            ax.add_collection(lines)
            ax.text(place[0], place[1] + high[1] + 0.08, name, ha="center", fontsize=8, parse_math=False)
        clock = ax.text(0.01, 0.98, "", transform=ax.transAxes, va="top", fontsize=8)
        canvas, pictures = FigureCanvasAgg(figure), []
        for frame, poses in zip(scene.frames[::every], motion.swapaxes(0, 1), strict=True):
            for n, (lines, pose, place) in enumerate(zip(people, poses, places, strict=True)):
                is_past, fixed = frame <= scene.now, [end in scene.shared(n) for end in edges[:, 1]]
                lines.set_segments(list((pose + place)[edges]))
                lines.set_color([PAST if is_past else FIXED if each else scene.colours[n] for each in fixed])
                lines.set_linewidth([3.0 if each and not is_past else 1.8 for each in fixed])
            clock.set_text(f"{scene.seconds(frame):+.1f} s")
            canvas.draw()
            pixels = np.asarray(canvas.buffer_rgba())[..., :3]
            pictures.append((pixels / 17.0).round().astype(np.uint8) * 17)  # few colours, and white remains white
        palette = Image.fromarray(np.concatenate(pictures[::5])).quantize(COLOURS)
        first, *others = (
            Image.fromarray(each).quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures
        )
        file = io.BytesIO()
        ends = np.round(np.arange(len(pictures) + 1) * every * scene.milliseconds, -1)  # a GIF counts 10 ms
        durations = np.diff(ends).clip(20).astype(int).tolist()  # browsers slow down faster ones
        first.save(file, "gif", save_all=True, append_images=others, duration=durations, loop=0)
        return file.getvalue()

    def _repr_mimebundle_(self, **_: Any) -> dict[str, Any]:
        """Return a GIF for notebooks, as HTML, which also moves where no kernel or script runs."""
        gif = base64.b64encode(self.to_gif()).decode()
        return {
            "text/html": str(
                Markup('<img alt="{}" src="data:image/gif;base64,{}">').format(self.title or "motion", gif)
            ),
            "text/plain": f"animation of {', '.join(self.scene.names)}",
        }


_PAGE = Markup(
    """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{policy}'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{font: 15px/1.5 system-ui, sans-serif; margin: 1em}} h1 {{font-size: 20px; margin: 0; overflow-wrap: anywhere}}
{style}
</style>
</head>
<body>
{player}
<script>{script}</script>
</body>
</html>
"""
)


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
) -> Animation:
    """Return an animation of skeletons to play, seek and rotate: the true motion, and sampled futures.

    All people repeat the observed motion in black (white in dark mode) and continue in the colours of `plot.futures`,
    seen from the same side. Time zero is the last observed pose.

    Args:
        skeleton: skeleton of the poses.
        observed: (O, J, 3) in metres, numpy or torch; NaN where a joint is missing, as in the truth. With O = 0, people
            share no past, and time zero is their first pose.
        samples: (K, H, J, 3) in metres. Without samples, the observed motion is shown, without a past. Without a past,
            NaN marks missing joints, and all joints after the end of a shorter motion.
        truth: (F, J, 3) in metres, if known; F is at most H.
        names: names of the K samples; default: numbers.
        fixed: joints that move in the same way in all samples; bones that end in them are dark and thick.
        every: number of frames between shown frames, which include the last observed one; default: about 25 shown
            frames a second. The speed is not changed.
        view: angle in radians between the last observed heading, or the first person's first one, and the viewer at the
            start.
        title: title above the figure.

    Raises:
        ValueError: the shapes do not match each other or the skeleton, an array is empty, a position is not finite, or
            names, fixed or every do not match the motion.
    """
    scene = make_scene(skeleton, observed, samples, truth, names=names, fixed=fixed, every=every, view=view)
    return Animation(scene, title)
