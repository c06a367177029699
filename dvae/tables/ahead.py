"""Windows at the end of a table: the last observed steps, and the steps after them."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

from .encoding import PanelSchema
from .panel import Panel, Series
from .windows import NAMED, PanelWindows


def ahead(panel: Panel, schema: PanelSchema, horizon: int | None = None) -> PanelWindows:
    """Return one window for each sequence; its future follows the last row with a target.

    Later rows contain known covariates of the future and empty targets.

    Args:
        panel: the sequences.
        schema: schema of the run.
        horizon: steps of the future; the horizon of the schema by default.

    Raises:
        ValueError: if sequences are not cut into windows, or none is long enough and has the covariates of its future.

    Warns:
        UserWarning: if some sequences have no window; the message names them and the reason.
    """
    observed, steps = schema.cut.observed, horizon or schema.cut.horizon
    if observed is None or steps is None:
        raise ValueError("whole sequences have no horizon; fit with observed and horizon steps to forecast")
    known_columns = schema.columns.of("known")
    calendar, trained = panel.calendar, schema.calendar
    if calendar.kind == trained.kind:  # these sequences may be too short to infer a step
        calendar = replace(calendar, step=calendar.step or trained.step, gap=calendar.gap or trained.gap)
    sequences, reasons = [], []  # with the complete past, for the last values of covariates
    for sequence in panel:
        n_present = panel.present(sequence)
        if n_present < observed:
            reasons.append(
                f"sequence {sequence.name!r} has {n_present} steps up to its last target; a forecast "
                f"observes {observed}"
            )
            continue
        future = sequence.values[n_present : n_present + steps]
        missing = [
            c.name for c in known_columns if np.isnan(future[:, schema.places[c.name]]).any() or len(future) < steps
        ]
        if missing:
            reasons.append(
                f"a forecast of {steps} steps needs future values of {', '.join(missing)}, but sequence "
                f"{sequence.name!r} has {len(future)} rows after its last target at row {n_present - 1}; append rows "
                f"with {'these' if len(missing) > 1 else 'it'} to the table, and leave their targets empty"
            )
            continue
        if len(future) < steps:
            future = np.concatenate([future, np.full((steps - len(future), future.shape[1]), np.nan)])
        values = np.concatenate([sequence.values[:n_present], future])
        sequences.append(Series(sequence.name, values, sequence.moments(0, len(values), calendar), sequence.group))
    if not sequences:
        raise ValueError(reasons[0])
    if reasons:
        more = f"; and {len(reasons) - NAMED} more" if len(reasons) > NAMED else ""
        names = "; ".join(reasons[:NAMED])
        warnings.warn(f"{len(reasons)} of {len(panel)} sequences have no forecast: {names}{more}", stacklevel=3)
    cut = replace(schema.cut, horizon=steps, split="sequence")
    return PanelWindows(replace(panel, series=sequences, calendar=calendar), replace(schema, cut=cut), "last")
