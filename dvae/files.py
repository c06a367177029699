"""Files that somebody else may have laid: only plain ones are opened, up to a bound, and ours are written whole.

A folder that was copied from elsewhere may hold links to files of ours, FIFOs and devices, whose content never ends or
never comes, and files that are larger than memory. So what lies in a run directory is opened here and nowhere else. The
path of the folder itself is what the user typed, and may be a link.
"""

from __future__ import annotations

import errno
import os
import platform
import re
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import BinaryIO
from uuid import uuid4

# neither follows a link at the end of the path nor waits for the other end of a FIFO; Windows has no such flags
_PLAIN = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


_HOST = re.sub(r"\W", "", platform.node())
_TEMPORARY = re.compile(rf"\.new-{_HOST}-(\d{{1,9}})-\w+")


class FileRefused(ValueError):
    """A path that is no plain file, or one that is larger than it can rightly be."""


def open_plain(path: str | os.PathLike[str], flags: int = os.O_RDONLY, links: bool = False) -> BinaryIO:
    """Open a plain file, unbuffered, without ever cutting it short.

    Args:
        path: the file.
        flags: of `os.open`.
        links: follow a link, for a path that the user typed.

    Raises:
        FileRefused: a link, a directory, a FIFO, a socket or a device.
        OSError: there is no such file, or it cannot be opened.
    """
    path = Path(path)
    if not links and path.is_symlink():
        raise FileRefused(f"{path} is a link, which could lead to any file; put the file itself in its place")
    try:
        number = os.open(path, flags | (_PLAIN & ~getattr(os, "O_NOFOLLOW", 0) if links else _PLAIN), 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO, errno.ENODEV):
            raise FileRefused(f"{path} is no file but a link, a directory, a FIFO, a socket or a device") from error
        raise
    if not stat.S_ISREG(os.fstat(number).st_mode):
        os.close(number)
        raise FileRefused(f"{path} is no file but a directory, a FIFO, a socket or a device")
    return os.fdopen(number, "r+b" if flags & os.O_RDWR else "wb" if flags & os.O_WRONLY else "rb", buffering=0)


def read(path: str | os.PathLike[str], most: int, links: bool = False) -> bytes:
    """The content of a plain file of at most `most` bytes.

    Raises:
        FileRefused: no plain file, or a larger one.
        OSError: there is no such file, or it cannot be read.
    """
    with open_plain(path, links=links) as file, naming(path):
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise FileRefused(f"{path} has {size} bytes, and can rightly have {most} at most")
        parts, left = [], most + 1
        while left and (part := file.read(min(left, 1 << 24))):  # what it holds now, which may differ from its size
            parts.append(part)
            left -= len(part)
    if not left:
        raise FileRefused(f"{path} grows while it is read, beyond {most} bytes")
    return b"".join(parts)


def write(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a new file in place of whatever has this name, and force it to the disk.

    Raises:
        OSError: it cannot be written; the error names it, and nothing of it is left.
    """
    path = Path(path)
    path.unlink(missing_ok=True)  # a link, not where it leads
    with open_plain(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL) as file, naming(path):
        try:
            put(file, content)
            os.fsync(file.fileno())
        except OSError:
            path.unlink(missing_ok=True)
            raise


def put(file: BinaryIO, content: bytes) -> None:
    """Write everything to an unbuffered file, which may take it piece by piece."""
    left = memoryview(content)
    while left:
        left = left[file.write(left) :]


@contextmanager
def written(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """A file to write to, which takes the place of an older one, or of a link, once it is whole; its folder is made.

    Raises:
        FileRefused: the path is a directory, a FIFO or a device.
        OSError: it cannot be written; the error names it.
    """
    path = Path(path)
    if os.path.lexists(path) and not (path.is_symlink() or path.is_file()):
        raise FileRefused(f"{path} is no file but a directory, a FIFO, a socket or a device; choose another name")
    with made(path.parent):
        _remove_leftovers(path.parent)
        new = path.with_name(f"{temporary()}{uuid4().hex}")
        try:
            with naming(path, new):
                number = os.open(new, os.O_RDWR | os.O_CREAT | os.O_EXCL | _PLAIN, 0o666)
                with os.fdopen(number, "w+b") as file:
                    yield file
                os.replace(new, path)
        finally:
            with suppress(OSError):
                new.unlink()


@contextmanager
def made(folder: Path) -> Iterator[None]:
    """Make a folder and those above it; if what follows fails, remove those that were made and are empty."""
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        for each in missing:
            with suppress(OSError):
                each.rmdir()
        raise


def temporary() -> str:
    """Return the start of the names of this process's temporary files, which names the process."""
    return f".new-{_HOST}-{os.getpid()}-"


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files and folders that processes of this machine left in a folder when they were killed."""
    with suppress(OSError):
        for path in [Path(entry) for entry in os.scandir(folder) if entry.name.startswith(".")]:
            if (found := _TEMPORARY.fullmatch(path.name)) and not _is_running(int(found[1])):
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink(missing_ok=True)


_remove_leftovers = cache(remove_leftovers)  # once per folder, which may receive many thousands of files


def _is_running(process: int) -> bool:
    if os.name == "nt":  # there, os.kill(process, 0) sends a signal
        return True
    try:
        os.kill(process, 0)
    except OSError as error:
        return error.errno != errno.ESRCH
    return True


@contextmanager
def naming(path: str | os.PathLike[str], temporary: Path | None = None) -> Iterator[None]:
    """What fails within it for want of space, rights or a sound disk says which file it was about.

    Args:
        path: the file, or a folder of files.
        temporary: what it is called until it is whole.
    """
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            if temporary is None or not Path(os.fsdecode(error.filename)).is_relative_to(temporary):
                raise
            path = Path(path) / Path(os.fsdecode(error.filename)).relative_to(temporary)
        if error.errno is None:  # of a library
            raise OSError(f"{path}: {error}") from error
        raise OSError(error.errno, error.strerror, os.fspath(path)) from error
