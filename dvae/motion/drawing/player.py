"""Moving skeletons within a page of HTML, small and without a library: to play, to scrub, to turn.

A scene is stored as whole numbers of a millimetre: the observed frames, which all people share, then each one's future,
as steps from frame to frame; a joint that lacks is at `MISSING`. Of these numbers of 16 bits first all low bytes and
then all high ones are deflated and written in base64: 50 futures of a window take about 100 kB, a fifteenth of what
plotly's frames take.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from .plot import PAST, Scene

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
            {"name": name, "colour": colour, "frames": len(ahead)}
            for name, colour, ahead in zip(stage.names, stage.colours, futures, strict=True)
        ],
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
