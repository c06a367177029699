"""Moving skeletons on a page of HTML or in a notebook, small and without a library: to play, to scrub, to turn.

A scene is stored as whole numbers of a millimetre: the observed frames, which all people share, then each one's future,
as steps from frame to frame; a joint that lacks is at `MISSING`. Of these numbers of 16 bits first all low bytes and
then all high ones are deflated and written in base64: 50 futures of a window take about 100 kB.
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
from .plot import FIXED, PAST, Scene, staged

SCRIPT = Path(__file__).with_name("player.js").read_text(encoding="utf-8")
"""What moves all players of a page."""

MILLIMETRE = 1e-3

MISSING = -32768
"""In place of coordinates that nobody knows."""

_PLAYER = Markup(
    '<div class="player" data-motion="{motion}">'
    '<p class="controls"><button type="button">Play</button>'
    '<input type="range" min="0" max="1" value="0" step="any" aria-label="time">'
    '<output></output><select aria-label="window">{windows}</select></p>'
    '<canvas tabindex="0" aria-label="moving skeletons; drag, or press the arrow keys, to turn them"></canvas></div>'
)
_OPTION = Markup('<option value="{}">{}</option>')


def player(scenes: Mapping[str, Scene]) -> Markup:
    """Scenes by title, one of which is shown at a time; the page needs `SCRIPT` once."""
    motion = json.dumps(list(map(_scene, scenes.values())), separators=(",", ":"), allow_nan=False)
    windows = Markup().join(_OPTION.format(place, title) for place, title in enumerate(scenes))
    return _PLAYER.format(motion=motion, windows=windows)


def _scene(stage: Scene) -> dict[str, Any]:
    """A scene as the script reads it, its coordinates packed."""
    motion = stage.motion[:, stage.shown]
    observed = sum(frame <= stage.now for frame in stage.shown)
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
        "frames": len(stage.shown),
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
        "packed": _packed(np.concatenate([piece.ravel() for piece in pieces])),
    }


def _packed(steps: np.ndarray) -> str:
    """Whole numbers modulo 2^16, in which sums of steps come out right."""
    planes = steps.astype(np.int64).astype("<u2").view(np.uint8).reshape(-1, 2).T
    return base64.b64encode(zlib.compress(planes.tobytes(), 9)).decode()


@dataclass(frozen=True, eq=False)
class Animation:
    """Skeletons that move side by side. A notebook shows it; `save` writes a page that any browser plays offline.

    Args:
        scene: the people.
        title: above them.
    """

    scene: Scene
    title: str = ""

    def to_html(self) -> str:
        """Return the page, which loads nothing and runs no script but the player's."""
        allowed = base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode()
        moving = player({self.title or "motion": self.scene})
        return str(_PAGE.format(title=self.title, policy=allowed, player=moving, script=Markup(SCRIPT)))

    def save(self, path: str | PathLike[str]) -> None:
        """Write the page to a file."""
        with files.written(path) as file:
            file.write(self.to_html().encode())

    def still(self) -> Figure:
        """Draw the last frame, seen from the front."""
        scene = self.scene
        motion = scene.motion[:, scene.shown[-1]] + scene.places[:, None]
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
        """Return the player for notebooks, and the last frame where they cannot play it."""
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
    """Return skeletons that move side by side, to play, scrub and turn: the true motion, and sampled futures.

    All repeat the observed motion in black and go on in the colours of `plot.futures`, seen from the same side. Time
    zero is the last observed pose.

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

    Raises:
        ValueError: the shapes do not fit each other or the skeleton, there is nothing to draw, a position is not
            finite, or names, fixed or every do not fit the motion.
    """
    scene = staged(skeleton, observed, samples, truth, names=names, fixed=fixed, every=every, view=view)
    return Animation(scene, title)
