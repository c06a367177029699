"""Model criticism for motion: statistics for `dvae.predictive_checks`, and figures of a `dvae.traverse`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from ...data.sequences import mean_of_known
from ...inference.diagnostics.checks import Statistic, variance
from ...inference.diagnostics.traversal import Traversal
from ...inference.evaluation.result import new_figure, styled
from ..data.exchange import ExchangedWindows
from ..data.protocols import Windows

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def statistics(windows: Windows | ExchangedWindows) -> dict[str, Statistic]:
    """Return the statistics of motion for predictive checks.

    * speed: mean over frames and joints, by first differences.
    * acceleration: the same by second differences.
    * bone length: mean over frames and bones.
    * bone stretch: standard deviation of a bone's length over time, divided by its mean, averaged over bones; 0 for
      real bones.
    * foot height: height of the feet above the lowest joint in the same frame, averaged over frames and feet. If one
      foot is on the ground, it is the height above the ground. It does not depend on global motion. Feet are the ends
      of chains whose names contain foot, toe, ankle or heel; a skeleton without such names has no foot height.

    If joints are missing, means are over the known differences, bones and feet, and the lowest joint is the lowest
    known one.

    Args:
        windows: windows with a skeleton, for joint names and the frame rate.
    """
    skeleton = windows.skeleton
    up, fps = skeleton.vertical, skeleton.fps
    ends = set(range(skeleton.joints)) - set(skeleton.parents)
    feet = [j for j in sorted(ends) if re.search("foot|toe|ankle|heel", skeleton.names[j], re.IGNORECASE)]

    def bone_stretch(positions: Tensor) -> Tensor:
        lengths = skeleton.bone_lengths(positions)
        return 100 * mean_of_known(variance(lengths).sqrt() / mean_of_known(lengths, -2), -1)

    def foot_height(positions: Tensor) -> Tensor:
        heights = positions[..., up]
        lowest = heights.nan_to_num(math.inf).amin(-1, keepdim=True)
        return mean_of_known(heights[..., feet] - lowest, (-2, -1))

    def statistic(unit: str, function: Callable[[Tensor], Tensor]) -> Statistic:
        return Statistic(lambda x: function(windows.positions(x)), unit)

    return {
        "speed": statistic("m/s", lambda points: fps * mean_of_known(points.diff(dim=-3).norm(dim=-1), (-2, -1))),
        "acceleration": statistic(
            "m/s²", lambda points: fps**2 * mean_of_known(points.diff(n=2, dim=-3).norm(dim=-1), (-2, -1))
        ),
        "bone length": statistic("m", lambda points: mean_of_known(skeleton.bone_lengths(points), (-2, -1))),
        "bone stretch": statistic("%", bone_stretch),
        **({"foot height": statistic("m", foot_height)} if feet else {}),
    }


@styled
def draw_traversal(
    traversal: Traversal, windows: Windows | ExchangedWindows, frame: int = -1, sequence: int = 0, rows: int = 6
) -> Figure:
    """Draw poses of one sequence at one frame, one row per latent coordinate, the one with the largest effect first.

    Args:
        traversal: traversal of the latent coordinates, returned by `dvae.traverse`.
        windows: windows of the skeleton; `positions` converts x to poses.
        frame: index of the frame, the last by default.
        sequence: index of the sequence in the batch.
        rows: number of coordinates to draw.

    Returns:
        A matplotlib figure.
    """
    from ..drawing.plot import SPACING, final_heading, hide_axes, pose

    order = traversal.effect.argsort(descending=True, stable=True)[:rows]
    skeleton = windows.skeleton
    poses = windows.positions(traversal.decoded[order, :, sequence])[:, :, frame].double().cpu()
    poses = poses - poses[..., skeleton.root : skeleton.root + 1, :]
    middle = int(traversal.offsets.abs().argmin())
    azimuth = math.pi / 5 - final_heading(skeleton, poses[0, middle : middle + 1])
    figure = new_figure(0.5 + 0.8 * len(traversal.offsets), 0.6 + 1.6 * len(order))
    panels = figure.subplots(len(order), 1, squeeze=False, sharex=True, sharey=True)[:, 0]
    for panel, coordinate, row in zip(panels, order.tolist(), poses, strict=True):
        for column, shifted in enumerate(row):
            offset = (column * SPACING, 0.0)
            pose(panel, row[middle], skeleton, offset=offset, azimuth=azimuth, colors="0.8", linewidths=1.6)
            pose(panel, shifted, skeleton, offset=offset, azimuth=azimuth, colors="C0", linewidths=1.4)
        hide_axes(panel)
        effect = float(traversal.effect[coordinate])
        panel.set_title(
            f"{traversal.latent}[{traversal.coordinates[coordinate]}], which moves x by {effect:.2g} m", loc="left"
        )
    panels[-1].set_xticks(
        SPACING * np.arange(len(traversal.offsets)), [f"{o:+.2g}" if o else "0" for o in traversal.offsets.tolist()]
    )
    panels[-1].set_xlabel(f"offset of {traversal.latent}, {traversal.unit} standard deviations")
    return figure
