"""Interactive animations of skeletons in HTML pages and notebooks, small and without a library: play, seek, rotate.

A scene is stored as integers in millimetres: the observed frames, which all people share, then the future of each
person. Frames are stored as differences from the previous frame, and a missing joint has the coordinate `MISSING`.
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
from math import pi
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from ... import files
from ..geometry.skeleton import Skeleton
from .plot import FIXED, PAST, Scene, make_scene

SCRIPT = Path(__file__).with_name("player.js").read_text(encoding="utf-8")
"""Script of a page with players: controls, and stages that they move together."""

STYLE = Path(__file__).with_name("player.css").read_text(encoding="utf-8")
"""Style of players."""

MILLIMETRE = 1e-3

MISSING = -32768
"""Integer that stands for an unknown coordinate."""

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
    pieces += [np.diff(ahead, axis=0, prepend=past[0, -1:]) for ahead in futures]
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

    Notebooks display the animation; `save` writes a page that any browser plays offline.

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

    def still(self) -> Figure:
        """Draw the last frame, seen from the front."""
        scene = self.scene
        motion = scene.motion[:, scene.frames[-1]] + scene.places[:, None]
        low, high = (find(motion[..., [0, 2]], axis=(0, 1)) for find in (np.nanmin, np.nanmax))
        figure = Figure(
            figsize=(9, float(np.clip(9 * (high - low)[1] / (high - low)[0], 1.5, 6))), dpi=72, layout="constrained"
        )
        ax = figure.subplots()
        edges = np.array(scene.skeleton.edges)
        for name, colour, person in zip(scene.names, scene.colours, motion, strict=True):
            ax.add_collection(LineCollection(list(person[edges][..., [0, 2]]), colors=colour, linewidths=1.8))
            if np.isfinite(person).any():  # a truth may end early
                place = np.nanmean(person[:, 0]), np.nanmax(person[:, 2]) + 0.1
                ax.text(*place, name, ha="center", parse_math=False)
        ax.autoscale_view()
        ax.set_aspect("equal")
        ax.set_axis_off()
        return figure

    def _repr_mimebundle_(self, **_: Any) -> dict[str, Any]:
        """Return the player for notebooks, and the last frame as a fallback."""
        png = io.BytesIO()
        self.still().savefig(png, format="png")
        page = Markup('<iframe srcdoc="{}" style="width:100%;height:30em;border:0"></iframe>').format(self.to_html())
        return {
            "text/html": str(page),
            "image/png": base64.encodebytes(png.getvalue()).decode(),
            "text/plain": "a still; run the cell to play it",
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
        observed: (O, J, 3) in metres, numpy or torch; NaN where a joint is missing, as in the truth.
        samples: (K, H, J, 3) in metres. Without samples, only the observed motion is shown, and time zero is its first
            pose.
        truth: (F, J, 3) in metres, if known; F is at most H.
        names: names of the K samples; default: numbers.
        fixed: joints that move in the same way in all samples; bones that end in them are dark and thick.
        every: number of frames between shown frames, which include the last observed one; default: about 25 shown
            frames a second. The speed is not changed.
        view: angle in radians between the last observed heading and the viewer at the start.
        title: title above the figure.

    Raises:
        ValueError: the shapes do not match each other or the skeleton, an array is empty, a position is not finite, or
            names, fixed or every do not match the motion.
    """
    scene = make_scene(skeleton, observed, samples, truth, names=names, fixed=fixed, every=every, view=view)
    return Animation(scene, title)
