"""What commands do with runs on tables: score, criticise, compare, forecast, fill gaps, and propose a schema."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import replace
from operator import itemgetter
from pathlib import Path

import numpy as np
import torch

from .. import files
from ..data import HeldOutWindows, Sequences, columns_of, each, gapped, past_of
from ..inference.result import Table
from ..inference.scores import CRPS, Measure, by_column, calibrated
from ..runs import directory as runs
from ..tables.ahead import ahead
from ..tables.dataset import PanelData
from ..tables.encoding import PanelSchema
from ..tables.forecasts import FORMATS, PanelForecasts
from ..tables.reading import SUFFIXES, is_domain, schema_beside, written_schema
from ..tables.windows import PanelWindows
from .console import ERROR, OUT, UsageError, check_files, save_figure
from .opening import data_of, load_run


def is_table(path: str) -> bool:
    """Whether a path leads to a table rather than to motion."""
    if is_domain(path):
        return True
    place = Path(path)
    suffix = place.suffix.lower()
    if suffix not in SUFFIXES or not place.is_file():
        return suffix in (".parquet", ".tsv")
    if schema_beside(path) != (None, None) or suffix in (".parquet", ".tsv"):
        return True
    if suffix == ".csv":
        with files.open_plain(place, links=True) as file:
            head = file.read(4096).decode("utf-8", "replace").splitlines()[:1]
        names = {name.strip().strip('"') for name in (head or [""])[0].split(",")}
        return not any({f"{name[:-2]}_{axis}" for axis in "xyz"} <= names for name in names if name.endswith("_x"))
    try:
        with files.open_plain(place, links=True) as file, zipfile.ZipFile(file) as archive:
            held = [entry.removesuffix(".npy") for entry in archive.namelist()]
    except zipfile.BadZipFile:
        return False
    of_motion = "positions_3d" in held or place.with_name("skeleton.json").is_file()
    return not of_motion and ("x" in held or len(held) == 1)


def scores(windows: HeldOutWindows) -> list[Measure]:
    """Proper scores and calibration, and the CRPS of each column in its unit where there are a few."""
    found, columns = calibrated(windows), columns_of(windows) or {}
    return [*found, *(by_column(CRPS, columns) if 1 < len(columns) <= 12 else [])]


def windows(loaded: runs.Loaded, opened: PanelData, horizon: int | None = None) -> PanelWindows:
    """Test windows to forecast, so many steps if not those of the run.

    Raises:
        UsageError: whole sequences, of which nothing is forecast.
    """
    if opened.schema.cut.length is None:
        raise UsageError(f"{loaded.path} was fitted on whole sequences; fit with --observed and --horizon to forecast")
    return PanelWindows(opened.panel, _longer(opened.schema, horizon), "test")


def _longer(schema: PanelSchema, horizon: int | None) -> PanelSchema:
    """The schema with another horizon, if one is given."""
    return schema if horizon is None else replace(schema, cut=replace(schema.cut, horizon=horizon))


def forecast(
    path: Path,
    out: Path,
    sequence: str | None,
    horizon: int | None,
    samples: int,
    seed: int,
    data: str | None,
    figure: Path | None,
    beyond: bool,
) -> None:
    """Forecasts test windows, those of one sequence, or what comes after the end of the table."""
    check_files(out, figure, *FORMATS)
    loaded = load_run(path, data, "panel")
    opened = data_of(data, loaded)
    panel = opened.panel if sequence is None else opened.panel.only([sequence])
    if beyond:
        held = ahead(panel, opened.schema, horizon)
    else:
        held = windows(loaded, opened, horizon)
        held = held if sequence is None else PanelWindows(panel, held.schema, "all")
    found = drawn(loaded, held, samples, seed)
    found.save(out)
    ERROR.print(f"wrote {out}: {samples} futures of {found.draws.shape[2]} steps for each of {len(found.keys)} windows")
    if figure is not None:
        save_figure(found.plot(), figure)


def drawn(loaded: runs.Loaded, held: PanelWindows, samples: int, seed: int = 0) -> PanelForecasts:
    """Draws of the futures of windows."""
    observed, steps = held.protocol.observed, held.protocol.horizon
    assert observed is not None
    assert steps is not None
    batch = held.all()
    past = past_of(batch, observed)
    parts = []
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for some in Sequences(past).split(64):
            parts.append(loaded.model.forecast(some, steps, samples, draw_emission=True)["x"].numpy())
    known = gapped(batch).numpy()
    keys = [(name, start + observed) for _, name, start in held.keys]
    columns = columns_of(held) or {}
    whole = held.times(steps)
    times = None if whole is None else whole[0]
    dates = whole is not None and whole[1]
    return PanelForecasts(
        np.concatenate(parts, 1), known[:, :observed], known[:, observed:], columns, keys, times, dates
    )


def impute(path: Path, out: Path, samples: int, seed: int, data: str | None) -> None:
    """Fills what the sequences of a table lack, in a table of every missing entry."""
    check_files(out, None, ".csv", ".parquet", ".npz")
    loaded = load_run(path, data, "panel")
    opened = data_of(data, loaded)
    schema = replace(opened.schema, cut=replace(opened.schema.cut, observed=None, horizon=None, split="sequence"))
    held = PanelWindows(opened.panel, schema, "all")
    batch, made = held.all(), []
    if "mask" not in batch:
        raise UsageError(f"nothing is missing in {opened.path}")
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for some in torch.arange(len(held)).split(64):
            made.append(loaded.model.impute(each(batch, itemgetter(some)), samples, draw=True)["x"].numpy())
    values = np.concatenate(made, 1)
    lengths = batch.get("lengths", torch.full((len(held),), values.shape[2]))
    lacking = ~batch["mask"].numpy() & (np.arange(values.shape[2]) < lengths[:, None].numpy())[..., None]
    rows = np.argwhere(lacking)
    import pandas as pd

    names, columns = [name for _, name, _ in held.keys], list(columns_of(held) or {})
    found = values[:, rows[:, 0], rows[:, 1], rows[:, 2]]
    frame = pd.DataFrame(
        {
            "sequence": [names[n] for n in rows[:, 0]],
            "step": rows[:, 1],
            "column": [columns[n] for n in rows[:, 2]],
            "mean": found.mean(0),
            **{f"q{100 * level:02.0f}": np.quantile(found, level, axis=0) for level in (0.05, 0.5, 0.95)},
        }
    )
    with files.written(out) as file:
        if out.suffix.lower() == ".csv":
            frame.to_csv(file, index=False, float_format="%.6g")
        elif out.suffix.lower() == ".parquet":
            frame.to_parquet(file)
        else:
            np.savez_compressed(file, filled=values, observed=batch["mask"].numpy(), sequence=np.array(names))
    ERROR.print(f"wrote {out}: {samples} fillings of {len(rows)} entries that {opened.path} lacks")


def info(paths: Sequence[str], out: Path | None) -> None:
    """What tables hold, and a schema to be read and corrected."""
    if out is not None and len(paths) > 1:
        raise UsageError("--out takes the schema of one table")
    for path in paths:
        opened = PanelData.open(path)
        panel = opened.panel
        table = Table(title=f"{path}: {panel!r}")
        for name in ("column", "role", "family", "unit", "known", "smallest", "mean", "largest"):
            table.add_column(name, justify="right" if name in ("known", "smallest", "mean", "largest") else "left")
        values = np.concatenate([one.values for one in panel])
        for place, column in enumerate(panel.columns.columns):
            own = values[:, place][~np.isnan(values[:, place])]
            known = f"{len(own) / len(values):.1%}"
            if column.classes:
                shown = ["", ", ".join(column.classes[:4]) + (" …" if len(column.classes) > 4 else ""), ""]
            else:
                shown = [f"{own.min():.4g}", f"{own.mean():.4g}", f"{own.max():.4g}"] if len(own) else ["–"] * 3
            table.add_row(column.name, column.role, column.family, column.unit, known, *shown)
        OUT.print(table)
        text = written_schema(panel.columns, opened.schema.cut)
        if out is None:
            if schema_beside(path) == (None, None):
                beside = Path(path).with_suffix(".toml")
                OUT.print(f"a schema, to be corrected and kept as {beside} (--out {beside} writes it):\n", markup=False)
            OUT.print(text, markup=False, highlight=False)
        else:
            with files.written(out) as file:
                file.write(text.encode())
            ERROR.print(f"wrote {out}: correct it, and `dvae fit METHOD --data {path} --out RUN` reads it")
