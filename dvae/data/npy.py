"""npy files from untrusted sources: strict parsing of headers, and memory-mapped arrays.

A mapped array may be larger than memory. The operating system caches the parts that are read, and drops them if other
programs need the memory.
"""

from __future__ import annotations

import errno
import os
import re
import zipfile
from collections.abc import Callable, Collection
from math import prod
from mmap import mmap
from typing import Any, BinaryIO

import numpy as np

from .. import files

HEADER = re.compile(
    r"\{(?:\s*(?:'descr'\s*:\s*'(?P<descr>[^'\\]*)'|'fortran_order'\s*:\s*(?P<order>True|False)"
    r"|'shape'\s*:\s*\((?P<shape>[\dL,\s]*)\))\s*(?:,|(?=\}))){3}\s*\}\s*"
)
CODE = re.compile(r"[<>|=]?(?:[biufcSUOMmV]\d{0,9}|\?)")
LONGEST = 4096
"""Maximum bytes of a header."""
NOTHING = 2**20
"""Maximum bytes of an empty array if dimensions of size 0 count as 1."""


class NpyError(ValueError):
    """Error for a file that is damaged or contains something other than plain data."""


def header(read_bytes: Callable[[int], bytes]) -> tuple[np.dtype, tuple[int, ...], Any]:
    """Return dtype, shape and order of an npy file, without evaluating its header as code.

    Args:
        read_bytes: function that returns the next n bytes of the file, or the remaining ones.

    Raises:
        NpyError: if this is not an npy file, or its header differs from those that NumPy writes for plain arrays.
    """
    magic = read_bytes(8)
    if magic[:6] != b"\x93NUMPY" or magic[6:] not in (b"\x01\x00", b"\x02\x00"):
        raise NpyError(f"not an npy file of version 1 or 2 (it begins with {magic!r}); write it with numpy")
    size = int.from_bytes(read_bytes(2 if magic[6] == 1 else 4), "little")
    text = read_bytes(size).decode("latin1") if size <= LONGEST else ""
    match = HEADER.fullmatch(text)
    if not match or None in match.groups():
        raise NpyError(f"damaged, or not a plain array: the header of its npy file is {text[:100]!r}")
    lengths = [length.strip().removesuffix("L") for length in match["shape"].split(",") if length.strip()]
    if not all(re.fullmatch(r"\d{1,18}", length) for length in lengths):
        raise NpyError(f"damaged: its shape is ({match['shape'][:100]}), expected whole numbers")
    return dtype_of(match["descr"]), tuple(map(int, lengths)), "F" if match["order"] == "True" else "C"


def dtype_of(code: str) -> np.dtype:
    """Return the dtype of numbers, text or objects from its code, such as "<f4"."""
    try:
        dtype = np.dtype(code) if CODE.fullmatch(code) else None
    except (TypeError, ValueError, OverflowError):
        dtype = None
    if dtype is None or dtype.kind not in "biufOSU" or not dtype.itemsize:
        raise NpyError(f"refused an array of {str(dtype or code)[:40]}: expected numbers")
    return dtype


def check_bytes(dtype: np.dtype, shape: tuple[int, ...], size: int, verb: str = "declares") -> None:
    """Check that an array's shape matches its number of bytes.

    Args:
        dtype: type of the entries.
        shape: shape of the array.
        size: number of bytes of the entries.
        verb: verb before the shape in errors.

    Raises:
        NpyError: if the number of bytes differs, or an empty array has very large dimensions.
    """
    n_bytes, padded = prod(shape) * dtype.itemsize, prod(n or 1 for n in shape) * dtype.itemsize
    if len(shape) > 32 or n_bytes != size or padded > max(size, NOTHING):
        short = f" instead of {n_bytes:,}; it was cut short, so copy or write it again" if n_bytes > size else ""
        raise NpyError(f"{verb} shape {shape} of {dtype}, but holds {size:,} bytes{short}")


def check_text(name: str, array: np.ndarray) -> None:
    """Raise an `NpyError` if an array contains text with invalid characters."""
    if array.dtype.kind == "U":
        points = array.reshape(-1).view(f"{array.dtype.str[0]}u4")
        if ((points > 0x10FFFF) | (points >> 11 == 0xD800 >> 11)).any():
            raise NpyError(f"{name}: damaged: its text has invalid characters")


def mapped(path: str | os.PathLike[str], links: bool = False) -> np.ndarray:
    """Return the numbers of an npy file as a read-only memory map; values are read from disk when they are used.

    If another process truncates the file, the program crashes. If the file is replaced, as `files.atomic_write` does,
    the map keeps the old content.

    Args:
        path: the file.
        links: whether to follow a symbolic link; set it only for paths that the user typed.

    Raises:
        ValueError: if the path is a link or not a file, or the file is truncated or not an npy file of real numbers in
            C order.
        OSError: if it cannot be opened.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     np.save(f"{folder}/walks.npy", np.zeros((1000, 48), np.float32))
        ...     mapped(f"{folder}/walks.npy").shape
        (1000, 48)
    """
    try:
        with files.open_plain(path, links=links) as file:
            dtype, shape, order = header(file.read)
            size = os.fstat(file.fileno()).st_size - file.tell()
            if dtype.kind not in "fiu":
                raise NpyError(f"holds {dtype}, expected real numbers; write it with numpy.asarray(values, float)")
            check_bytes(dtype, shape, size)
            if not size:
                raise NpyError(f"has shape {shape}, so it contains no numbers; expected at least one")
            if order == "F" and len(shape) > 1:
                raise NpyError(
                    "is in Fortran order, which stores the numbers of a step far apart; write it with "
                    "numpy.ascontiguousarray"
                )
            array = np.memmap(file, dtype, "r", file.tell(), shape)
            array.filename = os.path.abspath(path)  # for joblib, whose processes map it too
            return array.view(np.ndarray)
    except NpyError as error:
        raise ValueError(f"{os.fspath(path)} {error}") from error
    except OSError as error:
        if error.errno != errno.EMFILE:
            raise
        raise OSError(
            error.errno,
            "the limit of open files is reached, because every mapped file stays open; raise the limit (ulimit -n), or "
            "write fewer, longer files",
            path,
        ) from error


def npz_arrays(file: BinaryIO, most: int, names: Collection[str] = ()) -> dict[str, np.ndarray]:
    """Return the arrays of an npz file by name: numbers and text, without unpickling.

    Args:
        file: the open file.
        most: maximum bytes of its content.
        names: names of the arrays to read if there are several; all by default.

    Raises:
        NpyError: if the file is damaged, unpacks to more bytes, or contains objects or none of the arrays.
    """
    arrays = {}
    try:
        with zipfile.ZipFile(file) as archive:
            entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
            if (size := sum(entry.file_size for entry in entries.values())) > most:
                raise NpyError(f"it unpacks to {size:,} bytes; at most {most:,} are read")
            selected = {*entries} & {*names} if names and len(entries) > 1 else {*entries}
            if not selected:
                raise NpyError(f"it holds {[*entries][:20]!r:.200}; expected arrays {', '.join(names)}")
            for name, entry in entries.items():
                if name in selected:
                    with archive.open(entry) as member:
                        dtype, shape, order = header(member.read)
                        if dtype.hasobject:
                            raise NpyError(f"{name[:100]!r} contains Python objects, expected numbers or text")
                        check_bytes(dtype, shape, entry.file_size - member.tell())
                        values = np.frombuffer(member.read(entry.file_size), dtype)
                    arrays[name] = values.reshape(shape, order=order)
                    check_text(f"{name[:100]!r}", arrays[name])
    except Exception as error:  # the zip library raises many types for damaged bytes
        raise NpyError(f"cannot be read as npz: {str(error)[:300]}") from error
    return arrays


def is_mapped(array: Any) -> bool:
    """Return whether an array is memory-mapped, such as a `numpy.memmap` or a view of one."""
    while isinstance(array, np.ndarray):
        array = array.base
    return isinstance(array, mmap)
