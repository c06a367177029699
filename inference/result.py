"""What every result is: a table on a terminal, in print and in a notebook, and a file. And the bar while one waits."""

import io
from pathlib import Path

from rich.console import Console, RenderableType
from rich.progress import Progress

from .. import files

LARGEST = 2**28
"""Bytes of a result."""


class Result:
    """A result with a `table` and a `to_json`; it shows itself as the one and is kept as the other."""

    def table(self) -> RenderableType:
        """Everything that matters, with its uncertainty."""
        raise NotImplementedError

    def to_json(self) -> str:
        """Everything, as text."""
        raise NotImplementedError

    def save(self, path: str | Path) -> None:
        """Write `to_json()` to a file, which takes the place of an older one once it is whole.

        Raises:
            OSError, ValueError: it cannot be written.
        """
        with files.written(path) as file:
            file.write((self.to_json() + "\n").encode())

    @staticmethod
    def read(path: str | Path) -> str:
        """What `save` wrote, as text.

        Raises:
            OSError, ValueError: there is no such file, or it is no plain one, or no text.
        """
        return files.read(path, LARGEST, links=True).decode()

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


def progress_bar(shown: bool) -> Progress:
    """A bar that goes when the work is done; hidden where nobody would see it move."""
    console = Console()
    return Progress(
        transient=True, console=console, disable=not (shown and (console.is_terminal or console.is_jupyter))
    )
