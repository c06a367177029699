"""npy files that anybody may have written: their headers, read by a few rules, and arrays mapped where they lie.

A mapped array is not in memory: what is read of it is the system's to keep, which gives it up when others need the
room. So it may be larger than memory.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Callable
from math import prod
from mmap import mmap
from typing import Any

import numpy as np

from .. import files

HEADER = re.compile(
    r"\{(?:\s*(?:'descr'\s*:\s*'(?P<descr>[^'\\]*)'|'fortran_order'\s*:\s*(?P<order>True|False)"
    r"|'shape'\s*:\s*\((?P<shape>[\dL,\s]*)\))\s*(?:,|(?=\}))){3}\s*\}\s*"
)
CODE = re.compile(r"[<>|=]?(?:[biufcSUOMmV]\d{0,9}|\?)")
LONGEST = 4096
"""Bytes of a header."""
NOTHING = 2**20
"""Bytes that the places of an array may take which holds none."""


class Refused(ValueError):
    """A file is damaged, or holds what is not data."""


def header(read: Callable[[int], bytes]) -> tuple[np.dtype, tuple[int, ...], Any]:
    """Dtype, shape and order of an npy file, of which nothing is evaluated.

    Args:
        read: its next bytes, so many or those that are left.

    Raises:
        Refused: another file, or another header than numpy writes for a plain array.
    """
    magic = read(8)
    if magic[:6] != b"\x93NUMPY" or magic[6:] not in (b"\x01\x00", b"\x02\x00"):
        raise Refused(f"no npy file of version 1 or 2 (it begins with {magic!r}); write it with numpy")
    size = int.from_bytes(read(2 if magic[6] == 1 else 4), "little")
    text = read(size).decode("latin1") if size <= LONGEST else ""
    found = HEADER.fullmatch(text)
    if not found or None in found.groups():
        raise Refused(f"damaged, or no plain array: the header of its npy file is {text[:100]!r}")
    lengths = [length.strip().removesuffix("L") for length in found["shape"].split(",") if length.strip()]
    if not all(re.fullmatch(r"\d{1,18}", length) for length in lengths):
        raise Refused(f"damaged: its shape is ({found['shape'][:100]})")
    return dtype_of(found["descr"]), tuple(map(int, lengths)), "F" if found["order"] == "True" else "C"


def dtype_of(code: str) -> np.dtype:
    """Of numbers, text or objects, from its code such as "<f4"."""
    try:
        dtype = np.dtype(code) if CODE.fullmatch(code) else None
    except (TypeError, ValueError, OverflowError):
        dtype = None
    if dtype is None or dtype.kind not in "biufOSU" or not dtype.itemsize:
        raise Refused(f"refused an array of {str(dtype or code)[:40]}: expected numbers")
    return dtype


def check_bytes(dtype: np.dtype, shape: tuple[int, ...], size: int, verb: str = "declares") -> None:
    """Refuses an array that its bytes do not make, and one of a great many places that hold nothing."""
    needed, places = prod(shape) * dtype.itemsize, prod(n or 1 for n in shape) * dtype.itemsize
    if len(shape) > 32 or needed != size or places > max(size, NOTHING):
        short = f", needs {needed:,}; it was cut short, copy or write it again" if needed > size else ""
        raise Refused(f"{verb} shape {shape} of {dtype}, holds {size:,} bytes{short}")


def mapped(path: str | os.PathLike[str], links: bool = False) -> np.ndarray:
    """The numbers of an npy file, mapped: nothing is read before it is used, and nobody can write to them.

    Whoever cuts the file short meanwhile ends the program; a file that is replaced, as by `files.written`, stays as it
    was opened.

    Args:
        path: the file.
        links: follow a link, for a path that the user typed.

    Raises:
        ValueError: a link, or no file; no npy file of real numbers in C order, or one that is truncated.
        OSError: it cannot be opened.

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
                raise Refused(f"holds {dtype}, expected real numbers; write it with numpy.asarray(values, float)")
            check_bytes(dtype, shape, size)
            if not size:
                raise Refused(f"has shape {shape}, in which there is no number")
            if order == "F" and len(shape) > 1:
                raise Refused(
                    "is in Fortran order, in which the numbers of a frame lie far apart; write it with "
                    "numpy.ascontiguousarray"
                )
            found = np.memmap(file, dtype, "r", file.tell(), shape)
            found.filename = os.path.abspath(path)  # by which joblib's processes map it too
            return found.view(np.ndarray)
    except Refused as error:
        raise ValueError(f"{os.fspath(path)} {error}") from error
    except OSError as error:
        if error.errno != errno.EMFILE:
            raise
        raise OSError(
            error.errno,
            "every mapped file is kept open, and no more may be (ulimit -n); write fewer, longer ones",
            path,
        ) from error


def is_mapped(array: Any) -> bool:
    """Whether an array lies in a mapped file, as `numpy.memmap` does and all that is cut from it."""
    while isinstance(array, np.ndarray):
        array = array.base
    return isinstance(array, mmap)
