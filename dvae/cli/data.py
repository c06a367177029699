"""Commands on files: data info, convert and get."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from .. import motion
from ..motion.data.dataset import SIMULATED
from ..motion.files import reading, writing
from . import tables
from .console import ERROR, OUT, Missing, UsageError

ONTO = {skeleton.name: skeleton for skeleton in (motion.WALKER, motion.HUMAN36M, motion.HUMANEVA)}
"""Skeletons by name; others come from a skeleton.json."""


def info(
    files: Annotated[tuple[str, ...], tyro.conf.Positional],
    table: tables.ColumnOptions,
    out: Path | None = None,
    metres: float | None = None,
    up: Literal["y", "z"] | None = None,
    recorded: float | None = None,
    skip_bad: bool = False,
    missing: Missing = False,
) -> None:
    """Describe motion files or tables.

    For motion, prints splits, clips, skeleton, units, axes, bone lengths and labels. For a table, guesses the type of
    each column, names what harms a model, and prints a schema; --out riders.toml writes it to a file that you can edit.

    Args:
        files: motion files or folders (npz, bvh, amc, c3d, csv, exponential maps), "simulated", or tables.
        table: columns of the tables.
        out: file to write the schema of a table to.
        metres: metres per unit of the files, instead of the detected value.
        up: vertical axis of the files, instead of the detected one.
        recorded: frames per second of the files, if they state a wrong rate.
        skip_bad: leave out and list clips that cannot be used, instead of refusing the file.
    """
    files = files or (SIMULATED,)
    table_files = [file for file in files if tables.is_table(file)]
    if table != tables.ColumnOptions() and len(table_files) < len(files):
        raise UsageError("options of columns are for tables; leave them out for motion files")
    if out and len(table_files) < len(files):
        raise UsageError("--out writes the schema of a table; for motion files, leave it out")
    if table_files:
        tables.info(table_files, out, table)
    for file in files:
        if file not in table_files:
            OUT.print(_read_motion(file, metres, up, recorded, skip_bad, missing).info())


def convert(
    files: Annotated[tuple[str, ...], tyro.conf.Positional],
    out: Path,
    format: Literal["npz", "bvh", "csv", "amass"] | None = None,
    fps: float | None = None,
    onto: str | None = None,
    jobs: int = -1,
    metres: float | None = None,
    up: Literal["y", "z"] | None = None,
    recorded: float | None = None,
    skip_bad: bool = False,
    missing: Missing = False,
    units: tuple[str, ...] = (),
    prefix: bool = False,
) -> None:
    """Convert motion files: all clips to one file (--out motion.npz), or one file per clip to a folder.

    Several files or folders are merged. They need the same joints and frames per second, which --onto and --fps give
    them. Splits keep their names; clips of a folder without splits get its name as their split.

    Args:
        files: motion files or folders (npz, bvh, amc, c3d, csv, exponential maps), or "simulated".
        out: file or folder to write.
        format: format to write, by default from the name of --out.
        fps: frames per second to write.
        onto: target skeleton: walker, human36m, humaneva, or the path of a skeleton.json.
        jobs: number of processes; -1 for one per core.
        metres: metres per unit of the files, instead of the detected value.
        up: vertical axis of the files, instead of the detected one.
        recorded: frames per second of the files, if they state a wrong rate.
        skip_bad: leave out and list clips that cannot be used, instead of refusing the file.
        units: units of some of the files, such as a.bvh=cm b.npz=m, in m, cm, mm, in, or metres per unit.
        prefix: start the names of clips with the name of their archive or folder; for recordings, and for sources with
            equal names, with the name of the folder that contains them.
    """
    target = _skeleton(onto)
    if files in ((), (SIMULATED,)):
        if metres or up or recorded or units or prefix:
            raise UsageError("--metres, --units, --up, --recorded and --prefix are for files, not simulated motion")
        people = motion.simulate() if fps is None else motion.simulate().resample(fps)
        people = people if target is None else reading.select_joints(people, onto=target)
        description = f"{len(writing.write_motion(out, people, format))} files"
    else:
        corrections: Any = {"units": _units(units, files), "prefix": prefix}
        corrections |= {"metres": metres, "up": up, "recorded": recorded, "skip_bad": skip_bad, "missing": missing}
        paths = [Path(file) for file in files]
        description = writing.convert(paths, out, format, fps, target, jobs, **corrections)
    ERROR.print(f"wrote {out}: {description}", markup=False)


def get(
    collection: Annotated[Literal["cmu"], tyro.conf.Positional],
    out: Path,
    url: str | None = None,
) -> None:
    """Download public recordings to a folder and verify them.

    Args:
        collection: cmu, recordings of the CMU Graphics Lab.
        out: folder to write.
        url: address to download from, instead of the original site.
    """
    from ..motion.files.download import get as downloaded

    paths = downloaded(collection, out, url)
    ERROR.print(f"{len(paths)} files of {collection} in {out}; dvae data info {out}", markup=False)


def _read_motion(
    file: str, metres: float | None, up: str | None, recorded: float | None, skip_bad: bool, missing: bool
) -> motion.MotionSet:
    if file == SIMULATED:
        return motion.simulate()
    return motion.read_motion(file, skip_bad=skip_bad, metres=metres, up=up, fps=recorded, missing=missing)


def _units(texts: Sequence[str], files: Sequence[str]) -> dict[Path, float]:
    """Return metres per unit of the files in texts such as a.bvh=cm.

    Raises:
        UsageError: a text names none of the files, or no unit.
    """
    lengths = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
    units = {}
    for text in texts:
        file, _, unit = text.rpartition("=")
        try:
            units[Path(file)] = lengths[unit] if unit in lengths else float(unit)
        except ValueError:
            raise UsageError(f"--units {text}: expected FILE={', FILE='.join(lengths)} or FILE=METRES") from None
        if Path(file) not in map(Path, files):
            raise UsageError(f"--units {text}: {file or 'no file'} is not among the files: {', '.join(files)}")
    if len(units) < len(texts):
        raise UsageError(f"--units {' '.join(texts)}: give each file one unit")
    return units


def _skeleton(name: str | None) -> motion.Skeleton | None:
    """Return a skeleton by its name or file."""
    if name is None or name in ONTO:
        return ONTO.get(name or "")
    if not name.endswith(".json"):
        raise UsageError(f"--onto {name}: expected {', '.join(ONTO)}, or the path of a skeleton.json")
    return motion.Skeleton.from_json(name)
