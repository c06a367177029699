"""The command that looks into motion files, converts them and gets some."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from .. import motion
from ..motion.data.dataset import SIMULATED
from ..motion.files import reading, writing
from . import tables
from .console import ERROR, OUT, Missing, UsageError

ONTO = {skeleton.name: skeleton for skeleton in (motion.WALKER, motion.HUMAN36M, motion.HUMANEVA)}
"""Skeletons by name; others come from a skeleton.json."""


def data(
    action: Annotated[Literal["info", "convert", "get"], tyro.conf.Positional],
    table: tables.ColumnOptions,
    files: Annotated[tuple[str, ...], tyro.conf.Positional] = (SIMULATED,),
    out: Path | None = None,
    format: Literal["npz", "bvh", "csv", "amass"] | None = None,
    fps: float | None = None,
    onto: str | None = None,
    jobs: int = -1,
    metres: float | None = None,
    up: Literal["y", "z"] | None = None,
    recorded: float | None = None,
    url: str | None = None,
    skip_bad: bool = False,
    missing: Missing = False,
) -> None:
    """Inspect motion files and tables, convert motion, or download it.

    info describes motion files: splits, clips, skeleton, units, axes, bone lengths and labels.
    info guesses the columns of a table and prints a schema; --out riders.toml writes it to a file that you can edit.
    convert writes all clips to one file (--out motion.npz), or one file per clip to a folder (--out and --format).
    get cmu downloads recordings of the CMU Graphics Lab to the folder --out and verifies them.

    Args:
        action: what to do.
        table: for info: columns of the tables.
        files: motion files or folders (npz, bvh, amc, c3d, csv, exponential maps), or "simulated"; for get: cmu.
        out: file or folder to write.
        format: for convert: format to write, by default from the name of --out.
        fps: for convert: frames per second to write.
        onto: for convert: target skeleton: walker, human36m, humaneva, or the path of a skeleton.json.
        jobs: for convert: number of processes; -1 for one per core.
        metres: metres per unit of the files, instead of the detected value.
        up: vertical axis of the files, instead of the detected one.
        recorded: frames per second of the files, if they state a wrong rate.
        url: for get: address to download from, instead of the original site.
        skip_bad: leave out and list clips that cannot be used, instead of refusing the file.
    """
    if table != tables.ColumnOptions() and (action != "info" or not all(map(tables.is_table, files))):
        raise UsageError("options of columns are about tables, and of info")
    if action == "info":
        if format or fps or onto or url:
            raise UsageError("--format, --fps, --onto and --url are of convert and get")
        found = [file for file in files if tables.is_table(file)]
        if out and len(found) < len(files):
            raise UsageError("--out takes the schema that info proposes for a table; of motion info writes nothing")
        if found:
            tables.info(found, out, table)
        for file in files if not found else [file for file in files if file not in found]:
            OUT.print(_read(file, metres, up, recorded, skip_bad, missing).info())
        return
    if out is None:
        raise UsageError(f"data {action} writes files; say where, by --out")
    if action == "get":
        from ..motion.files.getting import COLLECTIONS, get

        if len(files) != 1 or files[0] not in COLLECTIONS:
            raise UsageError(f"get what? Known is {', '.join(COLLECTIONS)}")
        got = get(files[0], out, url)
        ERROR.print(f"{len(got)} files of {files[0]} in {out}; dvae data info {out}", markup=False)
        return
    if url:
        raise UsageError("--url is of get")
    known = _skeleton(onto)
    if files == (SIMULATED,):
        if metres or up or recorded:
            raise UsageError("--metres, --up and --recorded are of files, which may be wrong about them")
        people = motion.simulate() if fps is None else motion.simulate().resampled(fps)
        people = people if known is None else reading.chosen(people, onto=known)
        said = f"{len(writing.write_motion(out, people, format))} files"
    else:
        told = {"metres": metres, "up": up, "recorded": recorded, "skip_bad": skip_bad, "missing": missing}
        paths = [Path(file) for file in files]
        said = writing.convert(paths, out, format, fps, known, jobs, **told)  # type: ignore[arg-type]
    ERROR.print(f"wrote {out}: {said}", markup=False)


def _read(
    file: str, metres: float | None, up: str | None, recorded: float | None, skip_bad: bool, missing: bool
) -> motion.MotionSet:
    if file == SIMULATED:
        return motion.simulate()
    return motion.read_motion(file, skip_bad=skip_bad, metres=metres, up=up, fps=recorded, missing=missing)


def _skeleton(name: str | None) -> motion.Skeleton | None:
    """A skeleton by its name or file."""
    if name is None or name in ONTO:
        return ONTO.get(name or "")
    if not name.endswith(".json"):
        raise UsageError(f"--onto {name}: expected {', '.join(ONTO)}, or the path of a skeleton.json")
    return motion.Skeleton.from_json(name)
