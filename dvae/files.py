"""Safe file access: open only plain files of bounded size, and replace files atomically.

A folder copied from elsewhere may contain links to the user's files, FIFOs and devices that block or never end, and
files larger than memory. All files in a run directory are therefore opened through this module. The path of the
folder itself is given by the user and may be a link.
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

# do not follow a link at the end of the path, and do not wait for the other end of a FIFO; not available on Windows
_PLAIN = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


_HOST = re.sub(r"\W", "", platform.node())
_TEMPORARY = re.compile(rf"\.new-{_HOST}-(\d{{1,9}})-\w+")


class FileRefused(ValueError):
    """Error for a path that is not a plain file, or for a file larger than the allowed size."""


def open_plain(path: str | os.PathLike[str], flags: int = os.O_RDONLY, links: bool = False) -> BinaryIO:
    """Open a plain file, unbuffered and without truncating it.

    Args:
        path: path of the file.
        flags: flags of `os.open`, such as `os.O_RDONLY`.
        links: whether to follow a link, for a path given by the user.

    Returns:
        The open file, which the caller must close.

    Raises:
        FileRefused: the path is a link, a directory, a FIFO, a socket or a device.
        OSError: the file does not exist or cannot be opened.
    """
    path = Path(path)
    if not links and path.is_symlink():
        raise FileRefused(f"{path} is a link, which could lead to any file; replace it by the file itself")
    try:
        number = os.open(path, flags | (_PLAIN & ~getattr(os, "O_NOFOLLOW", 0) if links else _PLAIN), 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO, errno.ENODEV):
            raise FileRefused(
                f"{path} must be a plain file, not a link, a directory, a FIFO, a socket or a device"
            ) from error
        raise
    if not stat.S_ISREG(os.fstat(number).st_mode):
        os.close(number)
        raise FileRefused(f"{path} must be a plain file, not a directory, a FIFO, a socket or a device")
    return os.fdopen(number, "r+b" if flags & os.O_RDWR else "wb" if flags & os.O_WRONLY else "rb", buffering=0)


def read(path: str | os.PathLike[str], most: int, links: bool = False) -> bytes:
    """Return the content of a plain file of at most `most` bytes.

    Args:
        path: path of the file.
        most: maximum size in bytes.
        links: whether to follow a link, for a path given by the user.

    Raises:
        FileRefused: the path is not a plain file, or the file is larger.
        OSError: the file does not exist or cannot be read.
    """
    with open_plain(path, links=links) as file, with_path(path):
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise FileRefused(f"{path} has {size} bytes, but at most {most} are allowed")
        parts, remaining = [], most + 1
        while remaining and (
            part := file.read(min(remaining, 1 << 24))
        ):  # the file may have grown or shrunk since fstat
            parts.append(part)
            remaining -= len(part)
    if not remaining:
        raise FileRefused(f"{path} grew beyond {most} bytes while it was read; wait until it is complete")
    return b"".join(parts)


def write(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a new file, replacing any existing one, and flush it to disk.

    Raises:
        OSError: the file cannot be written; the error names the path, and no partial file remains.
    """
    path = Path(path)
    path.unlink(missing_ok=True)  # removes a link itself, not its target
    with open_plain(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL) as file, with_path(path):
        try:
            write_all(file, content)
            os.fsync(file.fileno())
        except OSError:
            path.unlink(missing_ok=True)
            raise


def write_all(file: BinaryIO, content: bytes) -> None:
    """Write all content to an unbuffered file, whose `write` may write only a part at a time."""
    remaining = memoryview(content)
    while remaining:
        remaining = remaining[file.write(remaining) :]


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a temporary file that replaces the file or link at `path` on success; create the folder if needed.

    Raises:
        FileRefused: the path is a directory, a FIFO or a device.
        OSError: the file cannot be written; the error names the path.
    """
    path = Path(path)
    if os.path.lexists(path) and not (path.is_symlink() or path.is_file()):
        raise FileRefused(
            f"{path} is a directory, a FIFO, a socket or a device, which is not replaced; choose another name"
        )
    with create_folder(path.parent):
        _remove_leftovers(path.parent)
        new = path.with_name(f"{temporary()}{uuid4().hex}")
        try:
            with with_path(path, new):
                number = os.open(new, os.O_RDWR | os.O_CREAT | os.O_EXCL | _PLAIN, 0o666)
                with os.fdopen(number, "w+b") as file:
                    yield file
                os.replace(new, path)
        finally:
            with suppress(OSError):
                new.unlink()


@contextmanager
def create_folder(folder: Path) -> Iterator[None]:
    """Create a folder and its parents; if the block fails, remove the created folders that are empty."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        for path in missing:
            with suppress(OSError):
                path.rmdir()
        raise


def temporary() -> str:
    """Return the prefix of this process's temporary files, which contains the host name and the process id."""
    return f".new-{_HOST}-{os.getpid()}-"


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files and folders that killed processes of this machine left in a folder."""
    with suppress(OSError):
        for path in [Path(entry) for entry in os.scandir(folder) if entry.name.startswith(".")]:
            if (match := _TEMPORARY.fullmatch(path.name)) and not _is_running(int(match[1])):
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink(missing_ok=True)


_remove_leftovers = cache(remove_leftovers)  # once per folder, since many thousands of files may be written to it


def _is_running(process: int) -> bool:
    if os.name == "nt":  # on Windows, os.kill(process, 0) sends a signal
        return True
    try:
        os.kill(process, 0)
    except OSError as error:
        return error.errno != errno.ESRCH
    return True


@contextmanager
def with_path(path: str | os.PathLike[str], temporary: Path | None = None) -> Iterator[None]:
    """Add the path to an OSError raised in the block, such as for a full disk, missing permissions or a disk error.

    Args:
        path: a file, or a folder of files.
        temporary: path that is written first and then renamed to `path`. Errors about this path, or about files in it,
            are raised with the final path instead.
    """
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            if temporary is None or not Path(os.fsdecode(error.filename)).is_relative_to(temporary):
                raise
            path = Path(path) / Path(os.fsdecode(error.filename)).relative_to(temporary)
        if error.errno is None:  # raised by a library
            raise OSError(f"{path}: {error}") from error
        raise OSError(error.errno, error.strerror, os.fspath(path)) from error
