"""Base class of results, with tables, JSON and netCDF files; progress bars."""

import functools
import io
import json
import os
import reprlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, ParamSpec, Self, TypeVar

import numpy as np
import rich.table
from rich.console import Console, RenderableType
from rich.progress import Progress, TextColumn
from rich.text import Text
from typing_extensions import override

from ... import files
from ...locking import SHAPES
from .record import MODELS, Flat, Variable, flatten, plain, unflatten

if TYPE_CHECKING:
    import matplotlib.text
    import xarray as xr
    from matplotlib.figure import Figure

P = ParamSpec("P")
R = TypeVar("R")

LARGEST = 2**28
"""Largest size of a result file, in bytes."""


class Table(rich.table.Table):
    """Rich table that prints text literally: names of clusters, labels and models contain no markup and no emoji."""

    def __init__(self, *, title: str = "", caption: str = "", **options: Any) -> None:
        super().__init__(**options)
        self.title = Text(_escaped(title), "table.title") if title else None
        self.caption = Text(_escaped(caption), "table.caption") if caption else None

    @override
    def add_column(self, header: RenderableType = "", *arguments: Any, **options: Any) -> None:
        super().add_column(_literal(header), *arguments, **options)

    @override
    def add_row(self, *cells: RenderableType | None, **options: Any) -> None:
        super().add_row(*map(_literal, cells), **options)


class PlainConsole(Console):
    """Console that prints text literally: paths, names and messages contain no markup and no emoji.

    It stops printing if the reader closes the pipe, as in `dvae evaluate RUN | head`; the command continues.
    """

    unread: ClassVar[bool] = False
    """Whether the reader of a console's output has closed the pipe."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, **options)

    @override
    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(_escaped(text), **options)

    @override
    def on_broken_pipe(self) -> None:
        PlainConsole.unread = self.quiet = True
        self.print()  # a quiet console empties its buffer
        with suppress(OSError), open(os.devnull, "wb") as nowhere:  # receives the rest of Python's buffer
            os.dup2(nowhere.fileno(), self.file.fileno())


def _literal(cell: Any) -> Any:
    return Text(_escaped(cell)) if isinstance(cell, str) else cell


def _escaped(text: str) -> str:
    """Return the text with escape characters made visible, so that it cannot control the terminal.

    Rich drops other control characters.
    """
    return text.replace("\x1b", r"\x1b")


def error_message(error: BaseException) -> str:
    """Return the message of an error, without the table of shapes that Pyro appends."""
    return SHAPES.sub("", str(error))


def new_figure(width: float, height: float) -> "Figure":
    """Return an empty figure with a size in inches, at most as wide as a page; matplotlib is imported only on use."""
    from .picture import WIDTH, Picture

    return Picture(figsize=(min(width, WIDTH), height), layout="constrained")


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Make a function draw in the house style, `picture.STYLE`; matplotlib's global settings stay as they are."""

    @functools.wraps(draw)
    def in_style(*args: P.args, **kwargs: P.kwargs) -> R:
        from matplotlib import rc_context

        from .picture import STYLE

        with rc_context(STYLE):
            return draw(*args, **kwargs)

    return in_style


def literal_text(texts: "Iterable[matplotlib.text.Text]") -> None:
    """Make matplotlib draw texts literally, so that dollar signs in a name do not start a formula."""
    for text in texts:
        text.set_parse_math(False)


class Displayed:
    """Base class that displays its `table` in a terminal and in a notebook."""

    def table(self) -> RenderableType:
        """Return a table of the main values with their uncertainty."""
        raise NotImplementedError

    def __rich__(self) -> RenderableType:
        return self.table()

    def __str__(self) -> str:
        console = Console(file=io.StringIO(), width=400, force_jupyter=False)
        console.print(self.table())
        return console.file.getvalue().rstrip()  # type: ignore[attr-defined]

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        console = Console(file=io.StringIO(), width=400, force_jupyter=False, record=True)
        console.print(self.table())
        lines = "\n".join(
            line.rstrip() for line in console.export_html(inline_styles=True, code_format="{code}").split("\n")
        )
        return f'<pre style="line-height:normal; font-family:monospace">{lines}</pre>'


class Result(Displayed):
    """Numbers with named dimensions, and the settings of their measurement.

    A subclass is a dataclass. `record.Dims` marks its arrays; `dataset`, JSON and netCDF follow from these marks.
    """

    def summary(self) -> dict[str, Any]:
        """Return the numbers of the table as JSON types, for reading the file without this library."""
        return {}

    def labels(self) -> dict[str, Sequence[str]]:
        """Return the coordinates of dimensions by name."""
        return {}

    def check(self) -> None:
        """Raise an error if fields contradict each other, as in an altered file.

        Raises:
            ValueError: when fields contradict each other; the message names them.
        """

    @property
    def extents(self) -> Mapping[str, set[int]]:
        """Set of array sizes for each dimension, with several sizes if arrays differ."""
        return flatten(self).sizes

    @property
    def dataset(self) -> "xr.Dataset":
        """All arrays by name, with the dimensions "model", "seed", "sequence", "step", "column" and others.

        Arrays of a model with fewer seeds, steps or columns are padded with NaN. Everything else is in `attrs`.
        """
        import xarray as xr

        flat = flatten(self)
        stacked = {MODELS: flat.models} if flat.models else {}
        return xr.Dataset(
            {name: (each.dims, each.data) for name, each in flat.variables.items()},
            {name: (name, np.array(values, dtype=str)) for name, values in {**stacked, **self.labels()}.items()},
            flat.attributes,
        )

    def document(self) -> dict[str, Any]:
        """Return everything as JSON types: a summary, variables with their dimensions, and all attributes."""
        flat = flatten(self)
        return {
            "kind": type(self).__name__,
            "summary": plain(self.summary()),
            "models": flat.models,
            "variables": {
                name: {"dims": each.dims, "path": each.path, "data": plain(each.data)}
                for name, each in flat.variables.items()
            },
            "attributes": flat.attributes,
        }

    @classmethod
    def of(cls, document: Any) -> Self:
        """Return the result from its `document`.

        Raises:
            ValueError: when the document is not of this kind of result.
        """
        try:
            if document["kind"] != cls.__name__:
                raise ValueError(f"expected the kind {cls.__name__}, got {reprlib.repr(document['kind'])}")
            variables = {
                str(name): Variable(tuple(each["dims"]), np.array(each["data"], float), tuple(each["path"]))
                for name, each in document["variables"].items()
            }
            result: Self = unflatten(cls, Flat(variables, document["models"], document["attributes"]))
            result.check()
        except (AttributeError, IndexError, KeyError, OverflowError, RecursionError, TypeError, ValueError) as error:
            raise ValueError(f"the document was not written by {cls.__name__}.to_json: {error!r}") from error
        return result

    def to_json(self) -> str:
        """Return `document` as text."""
        return json.dumps(self.document(), allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return the result that `to_json` wrote.

        Raises:
            ValueError: when the text is not such a document.
        """
        try:
            document = json.loads(text)
        except (RecursionError, ValueError) as error:
            raise ValueError(f"the document was not written by {cls.__name__}.to_json: {error!r}") from error
        return cls.of(document)

    def save(self, path: str | Path) -> None:
        """Write `to_json()` to a file; an existing file is replaced only when the new one is complete.

        Raises:
            OSError, ValueError: when it cannot be written.
        """
        with files.atomic_write(path) as file:
            file.write((self.to_json() + "\n").encode())

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read the file that `save` wrote.

        Raises:
            OSError, ValueError: when the file is missing, not a plain file, or not a result of this kind.
        """
        return cls.from_json(files.read(path, LARGEST, links=True).decode())

    def to_netcdf(self, path: str | Path) -> None:
        """Write `dataset` for other tools, with its attributes as JSON.

        Raises:
            OSError, ValueError: when it cannot be written.
        """
        dataset = self.dataset
        dataset.attrs = {name: json.dumps(value) for name, value in dataset.attrs.items()}
        with files.atomic_write(path) as file:
            file.write(dataset.to_netcdf())


def progress_bar(visible: bool) -> Progress:
    """Return a progress bar that disappears at the end, hidden where it cannot be updated (as without ipywidgets)."""
    console = Console()
    moves = find_spec("ipywidgets") is not None if console.is_jupyter else console.is_terminal
    return Progress(
        TextColumn("{task.description}", "progress.description", markup=False),  # may contain the name of a model
        *Progress.get_default_columns()[1:],
        transient=True,
        console=console,
        disable=not (visible and moves),
    )
