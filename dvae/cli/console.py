"""Shared parts of the commands: two consoles, checks of arguments before any work, and writing of figures."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from .. import files
from ..inference.evaluation.result import PlainConsole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

for stream in ("stdout", "stderr"):
    if getattr(sys, stream) is None:  # closed, as in `dvae list >&-`; the next file would reuse its descriptor
        setattr(sys, stream, open(os.devnull, "w"))  # noqa: SIM115
# Lines fit the width of a terminal; in a file or a pipe they are not wrapped.
OUT = PlainConsole(width=None if sys.stdout.isatty() else 200)
ERROR = PlainConsole(stderr=True, soft_wrap=True, highlight=False)

Missing = Annotated[
    bool,
    tyro.conf.arg(help="keep clips with missing joints; their positions are NaN"),
]
"""Option of every command that reads motion."""


def is_first_process() -> bool:
    """Return whether this is the only or the first process of a run, without importing torch."""
    return os.environ.get("RANK" if "TORCHELASTIC_RUN_ID" in os.environ else "LOCAL_RANK", "0") == "0"


class UsageError(ValueError):
    """Error for wrong or incompatible arguments."""


def note(message: Warning | str, *_: object, **__: object) -> None:
    """Print a warning for a user of the command line, without its location in the code."""
    ERROR.print(f"note: {message}", markup=False)


@contextmanager
def arguments() -> Iterator[None]:
    """Turn a ValueError in the block into a `UsageError`."""
    try:
        yield
    except ValueError as error:
        raise UsageError(str(error)) from error


def at_least(smallest: int, **options: int | None) -> None:
    """Check that each option is None or at least `smallest`.

    Raises:
        UsageError: an option is smaller than `smallest`.
    """
    for name, value in options.items():
        if value is not None and value < smallest:
            raise UsageError(f"--{name.replace('_', '-')} is {value}; it must be at least {smallest}")


def _check_file(path: Path | None, option: str, *suffixes: str) -> None:
    """Check, before any work, that a path is not a directory and that its suffix is one of `suffixes`."""
    if path is not None and path.is_dir():
        raise UsageError(f"--{option} {path} is a directory; name a file")
    if path is not None and path.suffix.lower() not in (suffixes or (path.suffix.lower(),)):
        kinds = " or ".join(filter(None, suffixes)) + (", or use no suffix for a folder" if "" in suffixes else "")
        raise UsageError(f"--{option} {path}: the suffix selects the format; end the name in {kinds}")


def check_figure(path: Path | None, option: str) -> None:
    """Check, before any work, that a path can become a figure."""
    _check_file(path, option)
    if path is not None:
        from matplotlib.backend_bases import FigureCanvasBase

        formats = FigureCanvasBase.get_supported_filetypes()
        if path.suffix.lower().removeprefix(".") not in formats:
            raise UsageError(f"--{option} {path}: the suffix selects the format, one of {', '.join(sorted(formats))}")


def check_files(out: Path | None, figure: Path | None, *suffixes: str) -> None:
    """Check, before any work, that both paths can be written; `suffixes` are the allowed suffixes of `out`."""
    _check_file(out, "out", *suffixes)
    check_figure(figure, "figure")


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure, and report its path."""
    with files.atomic_write(path) as file:
        figure.savefig(file, format=path.suffix.lower().removeprefix("."), dpi=150)
    ERROR.print(f"wrote {path}")
