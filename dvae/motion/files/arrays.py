"""Read and write archives of positions: `positions_3d`, plain npz, and tables.

The `positions_3d` archive is VideoPose3D's (Pavllo et al. 2019; `data_3d_h36m.npz`): an npz whose only member is a
pickled dictionary split -> clip -> (F, J, 3). A pickle is a program, and numpy's `allow_pickle=True` runs it. Here it
is parsed as data only (`archive`).
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from ... import files
from ...data.npy import is_mapped
from ..data.clips import Clip, MotionSet
from ..geometry.skeleton import HUMAN36M, HUMAN36M_KEPT, HUMANEVA, Skeleton, brief, is_name, text_of
from .archive import LARGEST, archive, write_arrays
from .recording import MOST_PLACES, MOST_TEXT, Recording, check_joints
from .world import check_unit, orientation_warning

ROTATIONS = ".rotations"
"""Ending of the names of members that contain the rotations of a clip."""

SKELETON, LABELS = "skeleton.json", "labels.csv"

WHICH = (
    "which skeleton? Put a skeleton.json into its folder "
    '({"joint_names": [...], "parents": [-1, 0, ...], "joints_left": [...], "joints_right": [...], '
    '"up_axis": "y", "fps": 30}) or pass skeleton=, such as dvae.motion.HUMAN36M'
)

MOST_NUMBERS = 2**23
"""Maximum number of values in a csv file of paths, including blank rows: a hundred thousand frames of twenty joints."""

_ARCHIVES = (
    ({f"S{i}" for i in (1, 5, 6, 7, 8, 9, 11)}, 32, HUMAN36M, HUMAN36M_KEPT),
    ({f"{part}/S{i}" for part in ("Train", "Validate") for i in (1, 2, 3)}, 15, HUMANEVA, None),
)
"""VideoPose3D's archives: subjects, number of joints, skeleton, and indices of its joints."""


def read_archive(
    path: Path,
    skeleton: Skeleton | None,
    labels: str | Path | None,
    skip_bad: bool,
    joints: Sequence[int] | None,
    metres: float | None = None,
    up: str | None = None,
    fps: float | None = None,
    missing: bool = False,
) -> MotionSet:
    """Read an npz of positions; the other arguments are the same as in `read_motion`.

    Args:
        joints: indices of the skeleton's joints in a file with more joints, such as `HUMAN36M_KEPT`.
    """
    check_unit(metres)
    unread = _read_clips(path)
    if skeleton is None:
        skeleton, indices = _skeleton_of(path, unread, joints)
        joints = indices if joints is None else joints
    skeleton = replace(skeleton, up=up or skeleton.up, fps=fps or skeleton.fps)
    file = Path(labels) if labels else companion(path, LABELS)
    labels_of = read_labels(file, labels)
    if labels_of and not any((split, name) in labels_of or (None, name) in labels_of for split, name, _, _ in unread):
        raise ValueError(f"{file}: no row has the split and clip of a clip of {path}")
    unread.reverse()

    def clips() -> Iterator[Clip]:
        size = 0
        while unread:  # frees each array as soon as its clip is taken over
            split, name, positions, rotations = unread.pop()
            if joints is not None and positions.ndim == 3 and positions.shape[1] > max(joints):
                positions, rotations = positions[:, list(joints)], None
            if metres is not None and positions.dtype.kind in "fiu":
                positions = metres * positions
            size += 0 if is_mapped(positions) else positions.nbytes
            if size > LARGEST:  # in a large mapped file, some arrays may have to be copied
                raise ValueError(
                    f"it has more than {LARGEST:,} bytes of motion that cannot be memory-mapped; save it as "
                    "an npz of uncompressed float32 arrays"
                )
            labelled = labels_of.get((split, name), labels_of.get((None, name), {}))
            yield Clip(split, name, positions, labelled, rotations=rotations if skeleton.rest else None)
            del positions, rotations

    try:
        motion = MotionSet(clips(), skeleton, path.stem, copy=False, skip_bad=skip_bad, missing=missing)
    except ValueError as error:
        raise error if str(path) in str(error) else ValueError(f"{path}: {error}") from error
    doubts = Counter(orientation_warning(skeleton.names, clip.positions, skeleton.up) for clip in motion)
    doubt, count = doubts.most_common(1)[0]
    return replace(motion, interpretation=f"{doubt} in {count} of {len(motion)} clips") if doubt else motion


def save(path: str | Path, motion: MotionSet) -> None:
    """Write a plain npz with its skeleton and labels, for `read_motion`.

    The skeleton of people.npz is in people.npz.skeleton.json, and its labels, if any, are in people.npz.labels.csv, so
    several archives fit into one folder. Each file replaces an older file or link only after a complete write.
    Rotations are separate members, "split/clip.rotations".

    Args:
        path: path of the npz.
        motion: clips to write.

    Raises:
        OSError: a file cannot be written; the message names it.
        ValueError: the name of a clip contains a slash, which would be read as part of the split, or `read_motion`
            would refuse the file.
    """
    save_clips(path, iter(motion), lambda: motion.skeleton)


def save_clips(path: str | Path, clips: Iterator[Clip], skeleton: Callable[[], Skeleton]) -> None:
    """Do the same as `save`, with only one clip in memory at a time.

    Args:
        path: npz file.
        clips: clips, iterated once.
        skeleton: function that returns the skeleton; called after the last clip.
    """
    path = Path(path)
    labelled = []

    def members() -> Iterator[tuple[str, np.ndarray]]:
        for clip in clips:
            check_key(clip.key)
            if "/" in clip.name or clip.name.endswith(ROTATIONS):
                raise ValueError(
                    f"clip name {clip.name!r} has a slash, which separates split and clip in the file, or ends in "
                    f"{ROTATIONS}, the ending of rotations; rename the clip"
                )
            labelled.append(replace(clip, positions=np.empty((0, 0, 3)), rotations=None, truth={}))
            yield f"{clip.split}/{clip.name}", clip.positions
            if clip.rotations is not None:
                yield f"{clip.split}/{clip.name}{ROTATIONS}", clip.rotations

    with files.atomic_write(path) as file:
        write_arrays(file, members())
    skeleton().to_json(own_companion(path, SKELETON))
    label_file = own_companion(path, LABELS)
    # labels.csv of the folder belongs to other clips
    if not write_labels(label_file, labelled, always=path.with_name(LABELS).is_file()):
        label_file.unlink(missing_ok=True)


def own_companion(path: Path, name: str) -> Path:
    """Return the path of a file that belongs to one motion file only, such as people.npz.skeleton.json."""
    return path.with_name(f"{path.name}.{name}")


def companion(path: Path, name: str) -> Path:
    """Return the path of the skeleton or labels of a motion file: its own file if it exists, else the folder's."""
    path_of_own = own_companion(path, name)
    return path_of_own if path_of_own.is_file() else path.with_name(name)


def write_labels(path: Path, clips: Iterable[Clip], older: Path | None = None, always: bool = False) -> bool:
    """Write the labels of clips in the format of `read_labels`, and return whether there was anything to write.

    Args:
        path: file.
        clips: clips with their labels.
        older: an earlier file, whose rows of other clips are kept.
        always: write the names of clips without labels too.

    Raises:
        ValueError: a row of the earlier file does not name the split of its clip.
    """
    rows = [{**clip.labels, "split": clip.split, "clip": clip.name} for clip in clips]
    if not always and not any(row.keys() - {"split", "clip"} for row in rows):
        return False
    if older is not None:
        new = {key for row in rows for key in ((row["split"], row["clip"]), (None, row["clip"]))}
        kept_rows = {key: row for key, row in read_labels(older, None).items() if key not in new}
        if any(split is None for split, _ in kept_rows):
            raise ValueError(f"{older}: it labels other clips by name alone; add a column named split")
        rows = [*kept_rows.values(), *rows]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    table = io.StringIO(newline="")
    writer = csv.DictWriter(table, ["split", "clip", *(c for c in columns if c not in ("split", "clip"))])
    writer.writeheader()
    writer.writerows(rows)
    with files.atomic_write(path) as file:
        file.write(table.getvalue().encode())
    return True


def check_key(key: tuple[str, str], path: Path | None = None) -> None:
    """Raise an error if a split or a clip name is not printable."""
    if not all(map(is_name, key)):
        raise ValueError(
            f"{brief(str(path or '/'.join(key)))} is not a valid name of a split and a clip: expected at "
            "most 1000 printable characters"
        )


def _skeleton_of(
    path: Path, clips: Sequence[_ClipArrays], selected: Sequence[int] | None
) -> tuple[Skeleton, tuple[int, ...] | None]:
    """Return the skeleton of a file, and the indices of its joints in the file.

    The skeleton is read from a file next to it, or known from the names of the subjects.

    Raises:
        ValueError: the numbers of joints in skeleton and file differ, or no skeleton is known.
    """
    counts = {positions.shape[1] for _, _, positions, _ in clips if positions.ndim == 3}
    file = companion(path, SKELETON)
    if file.is_file():
        skeleton = Skeleton.from_json(file)
        if selected is None and counts and skeleton.joints not in counts:
            raise ValueError(
                f"{path} has {max(counts)} joints and {file} has {skeleton.joints}, so they do not belong together; "
                f"put the archive's own skeleton into {own_companion(path, SKELETON).name}, or pass skeleton="
            )
        return skeleton, None
    splits = {split for split, *_ in clips}
    for subjects, joints, skeleton, indices in _ARCHIVES:
        if splits and splits <= subjects and joints in counts:
            return skeleton, indices
    raise ValueError(f"{path}: {WHICH}")


def read_labels(default: Path, labels: str | Path | None) -> dict[tuple[str | None, str], dict[str, str]]:
    """Return the rows of a file of labels by (split, clip), or by (None, clip) if it has no column split.

    The file is `labels`, or `default` if `labels` is None; without a default file there are no rows.
    """
    file = Path(labels) if labels else default
    if not file.is_file():
        if labels:
            raise FileNotFoundError(f"{labels}: no such labels file")
        return {}
    rows_by_key = {}
    with _table(file) as (header, rows):
        if "clip" not in header:
            raise ValueError(f"{file}: expected a column named clip, found {', '.join(header)[:200] or 'nothing'}")
        if repeated := [name for name, count in Counter(header).items() if count > 1 and name]:
            raise ValueError(f"{file}: column {repeated[0]!r} occurs twice")
        for _, cells in rows:
            if cells:
                row = {name: cell for name, cell in zip(header, cells, strict=True) if name}
                rows_by_key[row.get("split"), row["clip"]] = row
    return rows_by_key


@contextmanager
def _table(path: Path, *most: int) -> Iterator[tuple[list[str], Iterator[tuple[int, list[str]]]]]:
    """Open a csv file, and yield its header and its numbered rows, each as long as the header or empty.

    Raises:
        ValueError: the file is not text or too large, or a row has another length (raised when that row is read).
    """

    def numbered() -> Iterator[tuple[int, list[str]]]:
        for number, row in enumerate(reader, 2):
            if row and len(row) != len(header):
                raise ValueError(f"{path}: row {number} has {len(row)} cells, expected {len(header)} as in the header")
            yield number, row

    with text_of(path, *most) as text:
        reader = csv.reader(text, strict=True)
        try:
            header = next(reader, [])
            if unnamed := [position for position, name in enumerate(header, 1) if not is_name(name)]:
                raise ValueError(f"{path}: column {unnamed[0]} is {brief(header[unnamed[0] - 1])}, expected a name")
            yield header, numbered()
        except csv.Error as error:
            raise ValueError(f"{path}: row {reader.line_num} is not a row of a csv file ({error})") from error


def read_arrays(path: str | Path) -> dict[str, np.ndarray]:
    """Return the arrays of an npz file by name, without unpickling.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged, is not an npz, or contains pickled objects.
    """
    with archive(path) as members:
        return {name: member.array() for name, member in members.items()}


def read_paths(path: str | Path) -> dict[str, np.ndarray]:
    """Read paths of joints, each (frames, 3), NaN where unknown.

    Args:
        path: an npz file with one array per joint; or a csv file whose header names three columns per joint, as in
            `LWrist_x,LWrist_y,LWrist_z`, with one row per frame and empty cells for unknown values.

    Returns:
        Paths (frames, 3) in metres, by name of the joint.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged, or is not as described.
    """
    path = Path(path)
    if path.suffix.lower() not in (".npz", ".csv"):
        raise ValueError(f"{path}: paths of joints must be in an npz or a csv file")
    paths = read_arrays(path) if path.suffix.lower() == ".npz" else _read_columns(path)
    if not paths:
        raise ValueError(f"{path}: the file has no path of a joint")
    for joint, values in paths.items():
        if values.ndim != 2 or values.shape[1] != 3 or values.dtype.kind not in "fiu":
            raise ValueError(
                f"{path}: the path of {joint} has dtype {values.dtype} and shape {values.shape}, expected numbers "
                "(frames, 3)"
            )
        far = np.abs(values) > np.finfo(np.float32).max  # the limit of float32, which models use; NaN passes
        if far.any():
            raise ValueError(
                f"{path}: the path of {joint} has {values[far][0]} in frame {np.argwhere(far)[0][0]}; expected metres, "
                "or nan where it is not known"
            )
    return paths


def _read_columns(path: Path, numbers: int = MOST_NUMBERS, *most: int) -> dict[str, np.ndarray]:
    """Read three columns per joint from a csv file with at most `numbers` values, and optionally a limit in bytes."""
    with _table(path, *most) as (header, rows):
        columns: dict[str, list[int]] = {}
        for column, name in enumerate(header):
            joint, _, axis = name.strip().rpartition("_")
            axes = columns.setdefault(joint, [-1, -1, -1])
            if axis not in ("x", "y", "z") or not joint or axes["xyz".index(axis)] >= 0:
                raise ValueError(
                    f"{path}: column {column + 1} is {name[:100]!r}; expected a header of columns such as LWrist_x, "
                    "LWrist_y and LWrist_z, each once"
                )
            axes["xyz".index(axis)] = column
        if short := [joint for joint, axes in columns.items() if min(axes) < 0]:
            raise ValueError(f"{path}: {short[0]} needs three columns, {short[0]}_x, {short[0]}_y and {short[0]}_z")
        values: list[np.ndarray] = []
        blank = 0
        for number, cells in rows:
            if len(header) * (len(values) + blank) > numbers:
                raise ValueError(f"{path}: it has more than {numbers:,} numbers")
            if not cells:  # a frame without known values; counts only if others follow
                blank += 1
                continue
            values += [np.full(len(header), np.nan)] * blank
            blank = 0
            row = np.full(len(header), np.nan)
            for column, cell in enumerate(cells):
                try:
                    row[column] = float(cell if cell.strip() else "nan")
                except ValueError:
                    raise ValueError(
                        f"{path}: row {number}, {header[column]}: {cell[:100]!r} is not a number"
                    ) from None
            values.append(row)
    if not columns or not values:
        raise ValueError(f"{path}: expected a header and one row for each frame")
    table = np.stack(values)
    return {joint: table[:, axes] for joint, axes in columns.items()}


def read_table(path: Path) -> Recording:
    """Read a clip and its skeleton from a csv file with columns as in `read_paths`.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged, or its joints differ from those in the skeleton.
    """
    columns = _read_columns(path, 3 * MOST_PLACES, MOST_TEXT)
    check_joints(path, len(columns))
    if not (file := companion(path, SKELETON)).is_file():
        raise ValueError(f"{path}: {WHICH}")
    skeleton = Skeleton.from_json(file)
    if set(columns) != set(skeleton.names):
        differing = ", ".join(sorted(set(columns) ^ set(skeleton.names)))
        raise ValueError(f"{path}: the joints in its columns differ from those in {file}: {differing[:600]}")
    positions = np.stack([columns[name] for name in skeleton.names], 1)
    return Recording(
        skeleton.names, skeleton.parents, positions, fps=skeleton.fps, metres=1.0, up=skeleton.up, skeleton=skeleton
    )


def write_table(path: str | Path, names: Sequence[str], positions: np.ndarray) -> None:
    """Write a clip (F, J, 3) in metres as a csv file with columns such as LWrist_x, which `read_table` reads."""
    table = io.StringIO(newline="")
    writer = csv.writer(table)
    writer.writerow(f"{name}_{axis}" for name in names for axis in "xyz")
    writer.writerows([f"{value:.6f}" for value in row] for row in positions.reshape(len(positions), -1).tolist())
    with files.atomic_write(path) as file:
        file.write(table.getvalue().encode())


_ClipArrays = tuple[str, str, np.ndarray, np.ndarray | None]
"""Split, clip, positions, and optional rotations."""


def _read_clips(path: Path) -> list[_ClipArrays]:
    with archive(path, mapping=True) as members:
        if list(members) == ["positions_3d"]:
            return [(*clip, None) for clip in members["positions_3d"].clips()]
        clips = []
        rotation_names = {
            name for name in members if name.endswith(ROTATIONS) and name.removesuffix(ROTATIONS) in members
        }
        for name, member in members.items():
            split, slash, clip = name.rpartition("/")
            if name not in rotation_names:
                rotations = members[name + ROTATIONS].array() if name + ROTATIONS in rotation_names else None
                clips.append((split if slash else "all", clip, member.array(), rotations))
        return clips
