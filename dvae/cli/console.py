"""What commands share: two consoles, what is refused before any work, and how figures are written."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from .. import files
from ..inference.evaluation.result import Plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

for stream in ("stdout", "stderr"):
    if getattr(sys, stream) is None:  # it is closed, as in `dvae list >&-`, and the next file would take its number
        setattr(sys, stream, open(os.devnull, "w"))  # noqa: SIM115
# Both keep to the width of the terminal; a file or a pipe gets lines as long as they need to be.
OUT = Plain(width=None if sys.stdout.isatty() else 200)
ERROR = Plain(stderr=True, soft_wrap=True, highlight=False)

Missing = Annotated[
    bool,
    tyro.conf.arg(help="keep clips that lack joints, which are NaN where they were not observed"),
]
"""The option of every command that reads motion."""

Failed = Annotated[
    bool,
    tyro.conf.arg(help="use the weights of a run that failed, or has made no step, as they are"),
]
"""The option of every command that uses runs."""


def speaks() -> bool:
    """Whether this process is the first of a run's, which it is where there is one; known before torch is imported."""
    return os.environ.get("RANK" if "TORCHELASTIC_RUN_ID" in os.environ else "LOCAL_RANK", "0") == "0"


class UsageError(ValueError):
    """Arguments that do not fit together."""


def note(message: Warning | str, *_: object, **__: object) -> None:
    """A warning as a user of the command line reads it, without the place in the code."""
    ERROR.print(f"note: {message}", markup=False)


@contextmanager
def arguments() -> Iterator[None]:
    """What is refused within it is an argument."""
    try:
        yield
    except ValueError as error:
        raise UsageError(str(error)) from error


def at_least(smallest: int, **options: int | None) -> None:
    """Refuse options below what makes sense."""
    for name, value in options.items():
        if value is not None and value < smallest:
            raise UsageError(f"--{name.replace('_', '-')} is {value}; it must be at least {smallest}")


def _check_file(path: Path | None, option: str, *suffixes: str) -> None:
    """Refuse, before any work, a path that cannot become a file, or whose name ends as that of another kind of file."""
    if path is not None and path.is_dir():
        raise UsageError(f"--{option} {path} is a directory; name a file")
    if path is not None and path.suffix.lower() not in (suffixes or (path.suffix.lower(),)):
        kinds = " or ".join(filter(None, suffixes)) + (", or in nothing for a folder" if "" in suffixes else "")
        raise UsageError(f"--{option} {path}: the end of a name says what is written; end its name in {kinds}")


def check_figure(path: Path | None, option: str) -> None:
    """Refuse, before any work, a path that cannot become a figure."""
    _check_file(path, option)
    if path is not None:
        from matplotlib.backend_bases import FigureCanvasBase

        known = FigureCanvasBase.get_supported_filetypes()
        if path.suffix.lower().removeprefix(".") not in known:
            raise UsageError(f"--{option} {path}: the end of the name is the format, one of {', '.join(sorted(known))}")


def check_files(out: Path | None, figure: Path | None, *suffixes: str) -> None:
    """Refuse, before any work, what cannot be written."""
    _check_file(out, "out", *suffixes)
    check_figure(figure, "figure")


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure, and say so."""
    with files.written(path) as file:
        figure.savefig(file, format=path.suffix.lower().removeprefix("."), dpi=150)
    ERROR.print(f"wrote {path}")
