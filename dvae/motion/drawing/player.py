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
from collections.abc import Collection, Mapping, Sequence
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
"""Script that animates all players of a page."""

MILLIMETRE = 1e-3

MISSING = -32768
"""Integer that stands for an unknown coordinate."""

_PLAYER = Markup(
    '<div class="player" data-motion="{motion}">'
    '<p class="controls"><button type="button">Play</button>'
    '<input type="range" min="0" max="1" value="0" step="any" aria-label="time">'
    '<output></output><select aria-label="window">{windows}</select></p>'
    '<canvas tabindex="0" aria-label="moving skeletons; drag, or press the arrow keys, to turn them"></canvas></div>'
)
_OPTION = Markup('<option value="{}">{}</option>')


def player(scenes: Mapping[str, Scene]) -> Markup:
    """Return the HTML of scenes by title, shown one at a time; the page must contain `SCRIPT` once."""
    motion = json.dumps(list(map(_scene, scenes.values())), separators=(",", ":"), allow_nan=False)
    windows = Markup().join(_OPTION.format(index, title) for index, title in enumerate(scenes))
    return _PLAYER.format(motion=motion, windows=windows)


def _scene(stage: Scene) -> dict[str, Any]:
    """Return a scene in the format of the script, with packed coordinates."""
    motion = stage.motion[:, stage.frames]
    observed = sum(frame <= stage.now for frame in stage.frames)
    low, high = stage.low, stage.high
    unit = max(MILLIMETRE, np.abs([low, high]).max() / 32767)
    past, future = np.split(np.nan_to_num(np.round(motion / unit), nan=MISSING), [observed], axis=1)
    ends = [np.flatnonzero((ahead != MISSING).any((1, 2))).max(initial=-1) + 1 for ahead in future]
    futures = [ahead[:end] for ahead, end in zip(future, ends, strict=True)]
    pieces = [np.diff(past[0], axis=0, prepend=0)]
    pieces += [np.diff(ahead, axis=0, prepend=past[0, -1:]) for ahead in futures]
    middle = (low + high) / 2
    return {
        "joints": stage.skeleton.joints,
        "bones": stage.skeleton.edges,
        "observed": observed,
        "frames": len(stage.frames),
        "milliseconds": stage.milliseconds,
        "people": [
            {"name": name, "colour": colour, "frames": len(ahead), "fixed": sorted(stage.shared(k))}
            for k, (name, colour, ahead) in enumerate(zip(stage.names, stage.colours, futures, strict=True))
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
        moving = player({self.title or "motion": self.scene})
        return str(_PAGE.format(title=self.title, policy=allowed, player=moving, script=Markup(SCRIPT)))

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
<title>{title}</title>
<style>
body {{font: 14px system-ui, sans-serif; margin: 1em}}
.controls {{display: flex; gap: 1em}} .controls input {{flex: 1}} canvas {{width: 100%}}
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

    All people repeat the observed motion in black and continue in the colours of `plot.futures`, seen from the same
    side. Time zero is the last observed pose.

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
