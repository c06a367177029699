"""Reading and writing motion files: the `positions_3d` archive and plain npz.

The `positions_3d` archive is VideoPose3D's (Pavllo et al. 2019; `data_3d_h36m.npz`): an npz whose one member
is a pickled dictionary split -> clip -> (F, J, 3). A pickle is a program, and numpy's `allow_pickle=True`
runs it. Here it is read by an unpickler that can build dictionaries, lists, tuples, strings, numbers and
numpy arrays, and nothing else.
"""

from __future__ import annotations

import csv
import io
import pickle
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib import format as npy

from .data import Clip, MotionSet
from .skeleton import HUMAN36M, HUMAN36M_KEPT, HUMANEVA, Skeleton

LARGEST = 4 * 2**30
"""Bytes that a file may unpack to: a small zip can declare, and hold, far more than any machine has."""

_ARCHIVES = (
    ({f"S{i}" for i in (1, 5, 6, 7, 8, 9, 11)}, 32, HUMAN36M, HUMAN36M_KEPT),
    ({f"{part}/S{i}" for part in ("Train", "Validate") for i in (1, 2, 3)}, 15, HUMANEVA, None),
)
"""VideoPose3D's archives: subjects, joints, skeleton, and which of the joints make it up."""


def load(
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
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    found = _read_clips(path)
    if skeleton is None:
        skeleton, kept = _skeleton_of(path, found)
        joints = kept if joints is None else joints
    known = _read_labels(path, Path(labels) if labels else None)
    clips = []
    for split, name, positions in found:
        if joints is not None and positions.ndim == 3 and positions.shape[1] > max(joints):
            positions = positions[:, list(joints)]
        clips.append(Clip(split, name, positions, known.get((split, name), known.get((None, name), {}))))
    if known and not any(clip.labels for clip in clips):
        raise ValueError(f"{path}: no row of its labels file names a clip of the archive by (split, clip)")
    if skip_bad:
        return MotionSet.usable(clips, skeleton, path.stem)
    return MotionSet(clips, skeleton, path.stem)


def save(path: str | Path, motion: MotionSet) -> None:
    """Write a plain npz, and beside it skeleton.json and (where there are labels) labels.csv, for `load`.

    Raises:
        ValueError: a clip's name has a slash, which would be read as part of the split.
    """
    path = Path(path)
    slashed = [clip.name for clip in motion if "/" in clip.name]
    if slashed:
        raise ValueError(f"clip name {slashed[0]!r} has a slash, which separates split and clip in the file")
    arrays: dict[str, Any] = {f"{clip.split}/{clip.name}": clip.positions for clip in motion}
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:  # an open file: savez would append .npz to a name
        np.savez_compressed(file, **arrays)
    motion.skeleton.to_json(path.with_name("skeleton.json"))
    columns = list(dict.fromkeys(name for clip in motion for name in clip.labels))
    if columns:
        with path.with_name("labels.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, ["split", "clip", *(c for c in columns if c not in ("split", "clip"))])
            writer.writeheader()
            writer.writerows({**clip.labels, "split": clip.split, "clip": clip.name} for clip in motion)


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


def _read_labels(path: Path, labels: Path | None) -> dict[tuple[str | None, str], dict[str, str]]:
    """Rows by (split, clip); by (None, clip) where the file has no split column."""
    file = labels or path.with_name("labels.csv")
    if not file.is_file():
        if labels:
            raise FileNotFoundError(f"{labels}: no such labels file")
        return {}
    with file.open(newline="", encoding="utf-8") as lines:
        reader = csv.DictReader(lines)
        if "clip" not in (reader.fieldnames or ()):
            raise ValueError(f"{file}: expected a column named clip, found {', '.join(reader.fieldnames or ())}")
        return {(row.get("split"), row["clip"]): {k: v or "" for k, v in row.items() if k} for row in reader}


class _Member(NamedTuple):
    """One npy file inside an npz: its header, and the bytes after it."""

    name: str
    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype
    content: bytes

    def array(self) -> np.ndarray:
        if self.dtype.hasobject:
            raise ValueError(f"{self.name} holds pickled objects, which only a member called positions_3d may")
        if prod(self.shape) * self.dtype.itemsize != len(self.content):
            raise ValueError(
                f"{self.name} declares shape {self.shape} of {self.dtype}, holds {len(self.content)} bytes"
            )
        return np.frombuffer(self.content, self.dtype).reshape(self.shape, order="F" if self.fortran_order else "C")


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> _Member:
    file = io.BytesIO(archive.read(info))  # whole, so that the zip's checksum is verified before anything is believed
    version = npy.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"{info.filename} has npy version {version}, expected (1, 0) or (2, 0)")
    read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, fortran_order, dtype = read_header(file)
    return _Member(info.filename.removesuffix(".npy"), shape, fortran_order, dtype, file.read())


def read_arrays(path: str | Path) -> dict[str, np.ndarray]:
    """The arrays of an npz file by name, none of them pickled.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged or no npz, or holds pickled objects.
    """
    with _reading(path):
        return {member.name: member.array() for member in _members(path)}


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
    if path.suffix.lower() == ".npz":
        found = read_arrays(path)
        for joint, values in found.items():
            if values.ndim != 2 or values.shape[1] != 3 or values.dtype.kind not in "fiu":
                raise ValueError(
                    f"{path}: the path of {joint} is {values.dtype} {values.shape}, expected numbers (frames, 3)"
                )
    else:
        if path.suffix.lower() != ".csv":
            raise ValueError(f"{path}: paths of joints are in an npz or a csv file")
        try:
            lines = list(csv.reader(path.read_text(encoding="utf-8-sig").splitlines()))
        except UnicodeDecodeError as error:
            raise ValueError(f"{path}: is no text ({error})") from error
        while lines and not lines[-1]:
            lines.pop()
        header, *rows = lines or [[]]
        columns: dict[str, list[str]] = {}
        for place, name in enumerate(header):
            joint, _, axis = name.strip().rpartition("_")
            columns.setdefault(joint, ["", "", ""])
            if axis not in ("x", "y", "z") or not joint or columns[joint]["xyz".index(axis)]:
                raise ValueError(
                    f"{path}: column {place + 1} is {name!r}; expected a header of columns such as LWrist_x, LWrist_y "
                    "and LWrist_z, each once"
                )
            columns[joint]["xyz".index(axis)] = name
        short = [joint for joint, names in columns.items() if not all(names)]
        if short or not columns or not rows:
            raise ValueError(
                f"{path}: "
                + (f"{short[0]} lacks a column" if short else "expected a header and one row for each frame")
            )
        values = np.full((len(rows), len(header)), np.nan)
        for number, row in enumerate(rows):
            if row and len(row) != len(header):
                raise ValueError(f"{path}: row {number + 2} has {len(row)} cells, the header {len(header)}")
            for place, cell in enumerate(row):
                try:
                    values[number, place] = float(cell) if cell.strip() else np.nan
                except ValueError:
                    raise ValueError(f"{path}: row {number + 2}, {header[place]}: {cell!r} is no number") from None
        found = {joint: values[:, [header.index(name) for name in names]] for joint, names in columns.items()}
    if not found:
        raise ValueError(f"{path}: there is no path in it")
    return found


def _read_clips(path: Path) -> list[tuple[str, str, np.ndarray]]:
    with _reading(path):
        members = _members(path)
        if [member.name for member in members] == ["positions_3d"]:
            return _nested_clips(members[0])
        clips = []
        for member in members:
            split, slash, name = member.name.rpartition("/")
            clips.append((split if slash else "all", name, member.array()))
        return clips


def _members(path: str | Path) -> list[_Member]:
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(info.file_size for info in archive.infolist())
        if unpacked > LARGEST:
            raise ValueError(f"it would unpack to {unpacked:,} bytes, at most {LARGEST:,} are read")
        return [_read_member(archive, info) for info in archive.infolist() if not info.is_dir()]


@contextmanager
def _reading(path: str | Path) -> Iterator[None]:
    """Whatever fails within it names the file."""
    try:
        yield
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(f"{path}: damaged, truncated or not an npz archive ({error})") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _nested_clips(member: _Member) -> list[tuple[str, str, np.ndarray]]:
    """split -> clip -> array, from a pickled 0-dimensional object array."""
    if member.dtype != np.dtype(object) or member.shape != ():
        raise ValueError(
            f"positions_3d has shape {member.shape} and dtype {member.dtype}, expected one pickled "
            "dictionary (shape () and dtype object)"
        )
    nested = _DataUnpickler(io.BytesIO(member.content), encoding="latin1").load_data()
    if isinstance(nested, np.ndarray) and nested.shape == ():  # numpy pickles the 0-dimensional array, not its item
        nested = nested.item()
    if not isinstance(nested, dict) or not all(isinstance(clips, dict) for clips in nested.values()):
        raise ValueError("positions_3d is no dictionary of dictionaries (split -> clip -> positions)")
    found = []
    for split, clips in nested.items():
        for name, positions in clips.items():
            if not isinstance(positions, np.ndarray):
                raise ValueError(f"clip {split}/{name} is a {type(positions).__name__}, expected a numpy array")
            found.append((str(split), str(name), positions))
    return found


class _Refused(ValueError):
    """A pickle asked for something that is not data."""


class _DataUnpickler(pickle.Unpickler):
    """Builds dict, list, tuple, str, numbers and numpy arrays; refuses every other global by name.

    numpy's own reconstruction functions are replaced by narrower ones: the originals would allocate whatever
    shape a pickle names.
    """

    _array_type = object()

    def find_class(self, module: str, name: str) -> Any:
        home = module.replace("numpy._core.", "numpy.core.")  # numpy 2 moved its core
        allowed = {
            "numpy.ndarray": self._array_type,
            "numpy.dtype": self._dtype,
            "numpy.core.multiarray._reconstruct": self._reconstruct,
            "numpy.core.multiarray.scalar": self._scalar,
            "numpy.core.numeric._frombuffer": self._from_buffer,
            "_codecs.encode": self._encode,
        }
        if f"{home}.{name}" not in allowed:
            raise _Refused(
                f"refused {module}.{name}: a motion archive may hold only dict, list, tuple, str, numbers "
                "and numpy arrays; this one would run something else, do not trust it"
            )
        return allowed[f"{home}.{name}"]

    def load_data(self) -> Any:
        try:
            return self.load()
        except _Refused:
            raise
        except Exception as error:  # a damaged pickle can raise almost anything
            raise ValueError(f"damaged pickle ({type(error).__name__}: {error})") from error

    def _reconstruct(self, subtype: object, shape: tuple[int, ...], code: str | bytes) -> np.ndarray:
        if subtype is not self._array_type or shape != (0,):  # numpy starts every array empty and fills it afterwards
            raise _Refused(f"refused an array declared with shape {shape} before its content")
        return np.ndarray((0,), self._dtype(code if isinstance(code, str) else code.decode("latin1")))

    def _dtype(self, code: str, align: bool = False, copy: bool = True) -> np.dtype:
        dtype = np.dtype(code, align=align, copy=copy)
        if dtype.kind not in "biufOSU":
            raise _Refused(f"refused an array of {dtype}: expected numbers")
        return dtype

    def _scalar(self, dtype: np.dtype, content: bytes) -> Any:
        if len(content) != dtype.itemsize or dtype.hasobject:
            raise ValueError(f"a {dtype} of {len(content)} bytes")
        return np.frombuffer(content, dtype)[0]

    def _from_buffer(
        self, content: bytes, dtype: np.dtype, shape: tuple[int, ...], order: str, axes: Any = None
    ) -> Any:
        flat = np.frombuffer(content, dtype)
        if order == "K" and axes is not None:
            return flat.reshape(shape).transpose(axes)
        return flat.reshape(shape, order="F" if order == "F" else "C")

    def _encode(self, text: str, encoding: str) -> bytes:  # how protocols 0 to 2 spell bytes
        if encoding != "latin1":
            raise _Refused(f"refused the codec {encoding}: expected latin1")
        return text.encode("latin1")
