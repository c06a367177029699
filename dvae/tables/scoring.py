"""How forecasts of a panel are scored."""

from __future__ import annotations

from dataclasses import replace

from ..data.sequences import HeldOutWindows, columns_of
from ..inference.evaluation.scores import CRPS, Measure, by_column, calibrated

FEW = 12
"""Columns up to which each has a score of its own."""


def panel_scores(windows: HeldOutWindows) -> list[Measure]:
    """Proper scores and calibration, and the CRPS of each column in its unit where there are a few.

    What the command line prints: `dvae.evaluate(model, windows, scores=dvae.tables.panel_scores)`.
    """
    columns = columns_of(windows)
    found = [*calibrated(windows), *(by_column(CRPS, columns) if 1 < len(columns) <= FEW else [])]
    return [replace(measure, headline=True) for measure in found]
