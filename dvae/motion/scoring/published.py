"""Forecasts in the layouts of public evaluation scripts, and the windows that these scripts score.

Sources: DLow (Yuan and Kitani 2020, arXiv:2003.08386), GSPS (Mao, Liu and Salzmann 2021, arXiv:2108.08422), BeLFusion
(Barquero, Escalera and Palmero 2023, arXiv:2211.14304) and HumanMAC (Chen et al. 2023, arXiv:2302.03665). Their APD,
ADE, FDE, MMADE and MMFDE are defined as in `metrics`: norms over all coordinates of a frame without the root, and the
window among its own multimodal truths. They differ from `dvae.motion.scores` in two ways:

| script | windows | CMD |
|---|---|---|
| DLow, HumanMAC | no window that ends with its clip (`published_windows`) | |
| GSPS | also no window with a single future | |
| BeLFusion | a list in its repository: use `Windows.at` | by action, with constant paces (`scores(paces=)`) |
"""

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

from ...inference.evaluation.external import ForecastSamples
from ...options import require
from ..data.protocols import Windows
from .metrics import several_futures

UNITS: Mapping[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Metres per unit."""
FAR = 30.0
"""Ratio of the mean positions in forecasts and data, or its inverse, above which a unit is doubtful."""

Paper = Literal["dlow", "gsps", "humanmac"]
Unit = Literal["m", "cm", "mm"]
Root = Literal["subtract", "ignore"]


def published_windows(windows: Windows, paper: Paper) -> Windows:
    """Return the windows that a paper's public code scores; the title of a table names the paper.

    Args:
        windows: test windows of the paper's protocol, such as "h36m".
        paper: "dlow", "gsps" or "humanmac".

    Raises:
        ValueError: the paper is unknown, or no window is left.
    """
    require(Paper, paper=paper)
    frames = {clip.key: clip.frames for clip in windows.clips}
    keys = [key for key in windows.keys if key[2] + windows.length < frames[key[:2]]]
    scored = windows.at(keys, f"windows of {paper}")
    return several_futures(scored) if paper == "gsps" else scored


def frames_of(
    forecasts: Any,
    windows: Windows,
    axes: str = "kntd",
    unit: Unit = "m",
    root: Root | None = None,
) -> ForecastSamples:
    """Return forecasts of joints as samples (K, N, T, D) in metres, as `dvae.evaluate` scores them.

    Args:
        forecasts: forecasts in any form that `ForecastSamples.of` accepts; joints in the order of the skeleton, with or
            without the root.
        windows: windows that were forecast.
        axes: a letter for each axis of the forecasts: k samples, n windows, t frames, d all coordinates of a frame, or
            j joints and c coordinates; 1 for an axis of size 1. HumanMAC has kntd, BeLFusion nkt1jc.
        unit: unit of the forecasts.
        root: for forecasts with a moving root, under a protocol that removes it. "subtract": all joints are in one
            coordinate system. "ignore": the other joints are relative to the root, as in the public code of DLow.

    Raises:
        ValueError: axes do not match the forecasts, or the root moves and `root` does not say how to remove it.

    Example:
        >>> windows = dvae.motion.windows(dvae.motion.simulate(clips=4, frames=90), "simulated", "test")
        >>> forecasts = torch.zeros(len(windows), 5, 60, 1, 16, 3)  # as BeLFusion's script holds them
        >>> dvae.motion.frames_of(forecasts, windows, axes="nkt1jc", unit="mm").values.shape[2:]
        torch.Size([60, 48])
    """
    require(Unit, unit=unit)
    require(Root | None, root=root)
    samples = ForecastSamples.of(forecasts, observed=windows.protocol.observed).arranged(axes)
    values = samples.values if unit == "m" else samples.values * UNITS[unit]
    columns, skeleton = list(samples.columns), windows.skeleton
    if windows.protocol.root == "drop" and values.shape[-1] == 3 * skeleton.joints:
        joints = values.unflatten(-1, (-1, 3))
        path = joints[..., skeleton.root, :]
        if root is None and path.any():
            raise ValueError(
                f"the root, {skeleton.names[skeleton.root]}, moves in these forecasts, and the protocol removes it; "
                "give root='subtract' (`dvae evaluate --given-root`) if all joints are in one coordinate system, or "
                "root='ignore' if the others are relative to the root"
            )
        joints = joints - path[..., None, :] if root == "subtract" else joints
        values = skeleton.without_root(joints).flatten(-2)
        columns = columns[: 3 * skeleton.root] + columns[3 * skeleton.root + 3 :]
    elif root is not None:
        raise ValueError(f"root is {root!r}, but frames of {values.shape[-1]} numbers have no root to remove")
    ratio = float(values[:1].abs().mean() / windows.all()["x"].abs().mean())
    if ratio >= FAR or 0 < ratio <= 1 / FAR:
        warnings.warn(f"positions are {ratio:.2g} times those of the data; is their unit {unit!r}?", stacklevel=2)
    return replace(samples, values=values, columns=columns)
