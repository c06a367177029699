"""Commands on tables and on runs fitted on them: windows, forecasts, filling of missing entries, and schemas."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from .. import files
from ..data.blocks import ColumnSummary, row_blocks
from ..inference.evaluation.result import Table
from ..inference.evaluation.scores import samples_needed
from ..runs import directory as runs
from ..tables.advice import findings
from ..tables.dataset import PanelData
from ..tables.forecasts import BANDS, FORMATS, QUANTILES, column_of, needed
from ..tables.reading import SUFFIXES, is_domain, schema_beside, written_schema
from ..tables.windows import PanelWindows
from .console import ERROR, OUT, UsageError, arguments, check_files, note, save_figure
from .help import Expert

OF_MOTION = {".amc", ".bvh", ".c3d", ".npz"}
"""Suffixes of motion files: a folder with one of them is a folder of motion."""
SAMPLES = 100
"""Default number of draws for a table: quantiles from 2.5 to 97.5 % need at least 39, which give rough values."""


@dataclass(frozen=True)
class ColumnOptions:
    """Roles of the columns of a table.

    Args:
        columns: for a table: columns to model, each as NAME, NAME:FAMILY or NAME:FAMILY:UNIT, such as
            riders:count:people; by default all columns without another role. A schema next to the file can give the
            same.
        covariates: for a table: columns that are known for the future too, such as a calendar.
        past: for a table: columns that are known up to the present.
        attributes: for a table: columns with one value per sequence.
        id: for a table: columns that identify a sequence.
        time: for a table: column of dates or numbers, or columns to join, such as a date and a clock time.
        group: for a table: column of groups of sequences, constant within a sequence.
        zone: for a table: time zone of its dates, such as Europe/Berlin.
        na_values: for a table: texts or numbers that mark missing values, in addition to empty cells and NaN.
        decimal: for a table: decimal sign of its numbers, if it cannot be detected.
        calendar: for a table: covariates computed from its dates, also beyond its last row.
        lags: for a table: covariates that are earlier values of the targets, so many steps back.
    """

    columns: tuple[str, ...] = ()
    covariates: tuple[str, ...] = ()
    past: Expert[tuple[str, ...]] = ()
    attributes: Expert[tuple[str, ...]] = ()
    id: tuple[str, ...] = ()
    time: tuple[str, ...] = ()
    group: Expert[str | None] = None
    zone: Expert[str | None] = None
    na_values: Expert[tuple[str, ...]] = ()
    decimal: Expert[Literal[".", ","] | None] = None
    calendar: tuple[Literal["hour", "weekday", "month", "day_of_year"], ...] = ()
    lags: tuple[int, ...] = ()

    def given(self) -> dict[str, Any]:
        """Return the options that differ from their defaults, under their names in `PanelData.open`."""
        options = {option.name: getattr(self, option.name) for option in fields(ColumnOptions)}
        options["static"] = options.pop("attributes")  # a method may have an option `static`
        return {name: value for name, value in options.items() if value}


def is_table(path: str) -> bool:
    """Return whether a path is a table rather than motion."""
    if is_domain(path):
        return True
    place = Path(path)
    suffix = place.suffix.lower()
    if place.is_dir():
        ends = {Path(name).suffix.lower() for _, _, names in os.walk(place) for name in names}
        return ".npy" in ends and not ends & OF_MOTION
    if suffix not in SUFFIXES or not place.is_file():
        return suffix in (".npy", ".parquet", ".tsv")
    if schema_beside(path) != (None, None) or suffix in (".parquet", ".tsv"):
        return True
    if suffix == ".csv":
        with files.open_plain(place, links=True) as file:
            head = file.read(4096).decode("utf-8", "replace").splitlines()[:1]
        names = {name.strip().strip('"') for name in (head or [""])[0].split(",")}
        return not any({f"{name[:-2]}_{axis}" for axis in "xyz"} <= names for name in names if name.endswith("_x"))
    try:
        with files.open_plain(place, links=True) as file, zipfile.ZipFile(file) as archive:
            entries = [entry.removesuffix(".npy") for entry in archive.namelist()]
    except zipfile.BadZipFile:
        return False
    skeletons = (place.with_name(name) for name in (f"{place.name}.skeleton.json", "skeleton.json"))
    of_motion = "positions_3d" in entries or any(skeleton.is_file() for skeleton in skeletons)
    return not of_motion and ("x" in entries or len(entries) == 1)


def windows(run: runs.Loaded, data_set: PanelData, split: str = "test", **cut: int | None) -> PanelWindows:
    """Return windows to forecast, cut as in the run.

    Args:
        run: fitted run.
        data_set: data of the run, or other data.
        split: split of the windows.
        **cut: options of `Cut` that replace the values of the run, if not None.

    Raises:
        UsageError: the run was fitted on whole sequences, which have no forecasts.
    """
    if data_set.schema.cut.length is None:
        raise UsageError(
            f"{run.path} was fitted on whole sequences; fit with --observed and --horizon to forecast, or compare "
            "bounds with `dvae compare`"
        )
    return data_set.recut(**{name: steps for name, steps in cut.items() if steps is not None}).windows(split)


def forecast(
    run: runs.Loaded,
    data_set: PanelData,
    out: Path,
    sequence: str | None,
    horizon: int | None,
    samples: int | None,
    seed: int,
    figure: Path | None,
    beyond: bool,
) -> None:
    """Forecast the test windows, the windows of one sequence, or the steps after the end of the table."""
    check_files(out, figure, *FORMATS)
    data_set = data_set if sequence is None else data_set.only([sequence])
    samples = samples or SAMPLES
    split = "test" if sequence is None else "all"
    selected = data_set.ahead(horizon) if beyond else windows(run, data_set, split, horizon=horizon)
    forecasts = selected.forecast(run.model, samples, seed)
    forecasts.save(out)
    ERROR.print(
        f"wrote {out}: {samples} futures of {forecasts.draws.shape[2]} steps for each of {len(forecasts.keys)} windows"
    )
    _note_omitted(samples, out, figure)
    if figure is not None:
        save_figure(forecasts.plot(), figure)


def impute(run: runs.Loaded, data_set: PanelData, out: Path, samples: int | None, particles: int, seed: int) -> None:
    """Draw the missing entries of a table, and write them."""
    check_files(out, None, *FORMATS)
    samples, sequences = samples or SAMPLES, data_set.whole()
    with arguments():
        imputed = sequences.impute(run.model, samples, seed, particles)
    imputed.save(out)
    ERROR.print(f"wrote {out}: {samples} fillings of {imputed.missing.sum()} missing entries of {sequences.panel.name}")
    _note_omitted(samples, out)


def _note_omitted(samples: int, out: Path, figure: Path | None = None) -> None:
    """Note the quantiles and intervals that need more draws."""
    n_needed = {} if out.suffix.lower() == ".npz" else {column_of(level): needed(level) for level in QUANTILES}
    n_needed |= (
        {} if figure is None else {f"the interval of {100 * level:g} %": samples_needed(level) for level in BANDS}
    )
    if omitted := [f"{name} ({draws})" for name, draws in n_needed.items() if draws > samples]:
        note(f"left out at --samples {samples} (draws needed in brackets): {', '.join(omitted)}")


def info(paths: Sequence[str], out: Path | None, options: ColumnOptions) -> None:
    """Print a summary of each table and a schema to edit; columns without a given role are guessed."""
    if out is not None and len(paths) > 1:
        raise UsageError(f"--out writes the schema of one table, got {len(paths)} tables; name one")
    if out is not None and out.exists():
        raise UsageError(f"{out} exists and may have been edited; edit it, remove it, or choose another file")
    for path in paths:
        data_set = PanelData.open(path, **options.given())
        panel = data_set.panel
        table = Table(title=f"{path}: {panel!r}")
        for name in ("column", "role", "family", "unit", "known", "smallest", "mean", "largest"):
            table.add_column(name, justify="right" if name in ("known", "smallest", "mean", "largest") else "left")
        summary, steps = ColumnSummary.of(row_blocks(one.values for one in panel)), sum(map(len, panel))
        for index, column in enumerate(panel.columns.columns):
            share = f"{summary.count[index] / steps:.1%}"
            if column.classes:
                cells = ["", ", ".join(column.classes[:4]) + (" …" if len(column.classes) > 4 else ""), ""]
            else:
                numbers = (summary.least[index], summary.mean[index], summary.largest[index])
                cells = [f"{number:.4g}" if summary.count[index] else "–" for number in numbers]
            table.add_row(column.name, column.role, column.family, column.unit, share, *cells)
        OUT.print(table)
        if panel.columns.id and not options.given().get("id") and schema_beside(path) == (None, None):
            OUT.print(
                f"note: each value of {', '.join(panel.columns.id)} is read as a separate sequence, as its name or its "
                "repeated times suggest; if all rows are one sequence, make it part of the time",
                markup=False,
                soft_wrap=True,
            )
        for finding in findings(panel, data_set.schema.cut, schema_beside(path) == (None, None)):
            OUT.print(f"note: {finding}", markup=False, soft_wrap=True)
        for description in data_set.parts().values():
            OUT.print(description, markup=False, soft_wrap=True)
        text = written_schema(panel.columns, data_set.schema.cut)
        if out is None:
            if schema_beside(path) == (None, None):
                schema_path = Path(path).with_suffix(".toml")
                OUT.print(f"schema to edit and save as {schema_path} (--out {schema_path} writes it):\n", markup=False)
            OUT.print(text, markup=False, highlight=False)
        else:
            with files.atomic_write(out) as file:
                file.write(text.encode())
            ERROR.print(f"wrote {out}: edit it; `dvae fit METHOD --data {path} --out RUN` reads it")
