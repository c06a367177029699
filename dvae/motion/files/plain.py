"""Reading and writing motion files: the `positions_3d` archive and plain npz.

The `positions_3d` archive is VideoPose3D's (Pavllo et al. 2019; `data_3d_h36m.npz`): an npz whose one member
is a pickled dictionary split -> clip -> (F, J, 3). A pickle is a program, and numpy's `allow_pickle=True`
runs it. Here it is read as data (`archive`).
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ... import files
from ..data import Clip, MotionSet
from ..skeleton import HUMAN36M, HUMAN36M_KEPT, HUMANEVA, Skeleton, brief, is_name, read_text
from .archive import archive, write_arrays

MOST_NUMBERS = 2**23
"""In a csv file of paths, blank rows included: a hundred thousand frames of twenty joints."""

_ARCHIVES = (
    ({f"S{i}" for i in (1, 5, 6, 7, 8, 9, 11)}, 32, HUMAN36M, HUMAN36M_KEPT),
    ({f"{part}/S{i}" for part in ("Train", "Validate") for i in (1, 2, 3)}, 15, HUMANEVA, None),
)
"""VideoPose3D's archives: subjects, joints, skeleton, and which of the joints make it up."""


def read_motion(
    path: str | Path,
    skeleton: Skeleton | None = None,
    labels: str | Path | None = None,
    skip_bad: bool = False,
    joints: Sequence[int] | None = None,
) -> MotionSet:
    """Read a motion file.

    An npz with the member `positions_3d` is VideoPose3D's archive; any other npz holds one (F, J, 3) array
    per clip under the key "split/clip" (a key without a slash belongs to the split "all"). `skeleton.json`
    and `labels.csv` (one row per clip with the columns split, clip and whatever is known) beside the file are
    read too. VideoPose3D's archives of Human3.6M and HumanEva-I have no skeleton.json; they are known by their
    subjects and joints.

    Args:
        path: the npz file.
        skeleton: overrides skeleton.json.
        labels: a csv file, instead of labels.csv.
        skip_bad: leave out clips with NaN, wrong joints or units instead of raising; they are listed in
            `skipped`.
        joints: which of the file's joints make up the skeleton, when it has more, such as `HUMAN36M_KEPT`.

    Returns:
        The clips in file order, in metres.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, its pickle asks for anything but data, a clip is unusable, or no
            skeleton is known; the message says which.
    """
    path = Path(path)
    found = _read_clips(path)
    if skeleton is None:
        skeleton, kept = _skeleton_of(path, found)
        joints = kept if joints is None else joints
    known = _read_labels(path, labels)
    if known and not any((split, name) in known or (None, name) in known for split, name, _ in found):
        raise ValueError(f"{_labels_of(path, labels)}: no row names a clip of {path} by (split, clip)")
    found.reverse()

    def clips() -> Iterator[Clip]:
        while found:  # what was read is let go as soon as it is taken over
            split, name, positions = found.pop()
            if joints is not None and positions.ndim == 3 and positions.shape[1] > max(joints):
                positions = positions[:, list(joints)]
            yield Clip(split, name, positions, known.get((split, name), known.get((None, name), {})))
            del positions

    return MotionSet(clips(), skeleton, path.stem, copy=False, skip_bad=skip_bad)  # type: ignore[arg-type]


def save(path: str | Path, motion: MotionSet) -> None:
    """Write a plain npz, and beside it skeleton.json and (where there are labels) labels.csv, for `read_motion`.

    Each takes the place of an older file, or of a link, once it is whole.

    Raises:
        OSError: one cannot be written; the error names it.
        ValueError: a clip's name has a slash, which would be read as part of the split, or is one that `read_motion`
            refuses.
    """
    path = Path(path)
    if unnamed := [name for clip in motion for name in (clip.split, clip.name) if not is_name(name)]:
        raise ValueError(f"{brief(unnamed[0])} is no name for a split and a clip: expected text that can be printed")
    slashed = [clip.name for clip in motion if "/" in clip.name]
    if slashed:
        raise ValueError(f"clip name {slashed[0]!r} has a slash, which separates split and clip in the file")
    arrays: dict[str, Any] = {f"{clip.split}/{clip.name}": clip.positions for clip in motion}
    with files.written(path) as file:
        write_arrays(file, arrays)
    motion.skeleton.to_json(path.with_name("skeleton.json"))
    columns = list(dict.fromkeys(name for clip in motion for name in clip.labels))
    if columns:
        table = io.StringIO(newline="")
        writer = csv.DictWriter(table, ["split", "clip", *(c for c in columns if c not in ("split", "clip"))])
        writer.writeheader()
        writer.writerows({**clip.labels, "split": clip.split, "clip": clip.name} for clip in motion)
        with files.written(path.with_name("labels.csv")) as file:
            file.write(table.getvalue().encode())


def _skeleton_of(path: Path, clips: Sequence[tuple[str, str, np.ndarray]]) -> tuple[Skeleton, tuple[int, ...] | None]:
    """The skeleton beside a file or of a known archive, and which of the file's joints make it up."""
    beside = path.with_name("skeleton.json")
    if beside.is_file():
        return Skeleton.from_json(beside), None
    splits = {split for split, _, _ in clips}
    counts = {positions.shape[1] for _, _, positions in clips if positions.ndim == 3}
    for subjects, joints, skeleton, kept in _ARCHIVES:
        if splits and splits <= subjects and joints in counts:
            return skeleton, kept
    raise ValueError(
        f"{path}: which skeleton? Put a skeleton.json beside it "
        '({"joint_names": [...], "parents": [-1, 0, ...], "joints_left": [...], "joints_right": [...], '
        '"up_axis": "y", "fps": 30}) or pass skeleton=, such as dvae.motion.HUMAN36M'
    )


def _labels_of(path: Path, labels: str | Path | None) -> Path:
    """The file of labels that is given, or that stands beside the clips."""
    return Path(labels) if labels else path.with_name("labels.csv")


def _read_labels(path: Path, labels: str | Path | None) -> dict[tuple[str | None, str], dict[str, str]]:
    """Rows by (split, clip); by (None, clip) where the file has no split column."""
    file = _labels_of(path, labels)
    if not file.is_file():
        if labels:
            raise FileNotFoundError(f"{labels}: no such labels file")
        return {}
    found = {}
    with _table(file) as (header, rows):
        if "clip" not in header:
            raise ValueError(f"{file}: expected a column named clip, found {', '.join(header)[:200] or 'nothing'}")
        if twice := [name for name, count in Counter(header).items() if count > 1 and name]:
            raise ValueError(f"{file}: column {twice[0]!r} is there twice")
        for _, cells in rows:
            if cells:
                row = {name: cell for name, cell in zip(header, cells, strict=True) if name}
                found[row.get("split"), row["clip"]] = row
    return found


@contextmanager
def _table(path: Path) -> Iterator[tuple[list[str], Iterator[tuple[int, list[str]]]]]:
    """The header of a csv file, and its rows with their numbers: each as long as the header, or empty.

    Raises:
        ValueError: the file is no text or too large, or a row has another length; or is so at a later row.
    """

    def numbered() -> Iterator[tuple[int, list[str]]]:
        for number, row in enumerate(reader, 2):
            if row and len(row) != len(header):
                raise ValueError(f"{path}: row {number} has {len(row)} cells, the header {len(header)}")
            yield number, row

    reader = csv.reader(io.StringIO(read_text(path)), strict=True)
    try:
        header = next(reader, [])
        if unnamed := [place for place, name in enumerate(header, 1) if not is_name(name)]:
            raise ValueError(f"{path}: column {unnamed[0]} is {brief(header[unnamed[0] - 1])}, expected a name")
        yield header, numbered()
    except csv.Error as error:
        raise ValueError(f"{path}: row {reader.line_num} is no row of a csv file ({error})") from error


def read_arrays(path: str | Path) -> dict[str, np.ndarray]:
    """The arrays of an npz file by name, none of them pickled.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged or no npz, or holds pickled objects.
    """
    with archive(path) as members:
        return {name: member.array() for name, member in members.items()}


def read_paths(path: str | Path) -> dict[str, np.ndarray]:
    """Paths of joints, each (frames, 3), NaN where it is not known.

    Args:
        path: an npz file of one array for each joint; or a csv file whose header names three columns for each joint,
            as in `LWrist_x,LWrist_y,LWrist_z`, with one row for each frame and an empty cell where nothing is known.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, or is not as described.
    """
    path = Path(path)
    if path.suffix.lower() not in (".npz", ".csv"):
        raise ValueError(f"{path}: paths of joints are in an npz or a csv file")
    found = read_arrays(path) if path.suffix.lower() == ".npz" else _read_columns(path)
    if not found:
        raise ValueError(f"{path}: there is no path in it")
    for joint, values in found.items():
        if values.ndim != 2 or values.shape[1] != 3 or values.dtype.kind not in "fiu":
            raise ValueError(
                f"{path}: the path of {joint} is {values.dtype} {values.shape}, expected numbers (frames, 3)"
            )
        far = np.abs(values) > np.finfo(np.float32).max  # what models compute with; NaN is not known and not far
        if far.any():
            raise ValueError(
                f"{path}: the path of {joint} has {values[far][0]} in frame {np.argwhere(far)[0][0]}; expected metres, "
                "or nan where it is not known"
            )
    return found


def _read_columns(path: Path) -> dict[str, np.ndarray]:
    """Three columns of a csv file for each joint."""
    with _table(path) as (header, rows):
        columns: dict[str, list[int]] = {}
        for place, name in enumerate(header):
            joint, _, axis = name.strip().rpartition("_")
            places = columns.setdefault(joint, [-1, -1, -1])
            if axis not in ("x", "y", "z") or not joint or places["xyz".index(axis)] >= 0:
                raise ValueError(
                    f"{path}: column {place + 1} is {name[:100]!r}; expected a header of columns such as LWrist_x, "
                    "LWrist_y and LWrist_z, each once"
                )
            places["xyz".index(axis)] = place
        if short := [joint for joint, places in columns.items() if min(places) < 0]:
            raise ValueError(f"{path}: {short[0]} lacks a column")
        values: list[np.ndarray] = []
        blank = 0
        for number, cells in rows:
            if not cells:  # frames of which nothing is known, if others follow
                blank += 1
                continue
            if len(header) * (len(values) + blank) > MOST_NUMBERS:
                raise ValueError(f"{path}: it has more than {MOST_NUMBERS:,} numbers")
            values += [np.full(len(header), np.nan)] * blank
            blank = 0
            row = np.full(len(header), np.nan)
            for place, cell in enumerate(cells):
                try:
                    row[place] = float(cell if cell.strip() else "nan")
                except ValueError:
                    raise ValueError(f"{path}: row {number}, {header[place]}: {cell[:100]!r} is no number") from None
            values.append(row)
    if not columns or not values:
        raise ValueError(f"{path}: expected a header and one row for each frame")
    table = np.stack(values)
    return {joint: table[:, places] for joint, places in columns.items()}


def _read_clips(path: Path) -> list[tuple[str, str, np.ndarray]]:
    with archive(path) as members:
        if list(members) == ["positions_3d"]:
            return members["positions_3d"].clips()
        clips = []
        for name, member in members.items():
            split, slash, clip = name.rpartition("/")
            clips.append((split if slash else "all", clip, member.array()))
        return clips
