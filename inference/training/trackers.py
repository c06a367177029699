"""Trackers: where the numbers of a run go, row by row. A history, a file of JSON lines, TensorBoard, the
terminal.

A row maps names to numbers: `bound`, `log_likelihood/x`, `kl/z` are those of a training batch, the same names
under `validation/` those of the validation data, in nats per frame; `loss`, `gradient_norm`, `learning_rate`,
`self_feeding` are of the step, and so is `weight/x` where an objective's weights adapt.
"""

import io
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from ... import files
from ...lazy import optional
from ..evaluation.result import Plain, progress_bar
from .checkpoints import CheckpointError

LARGEST_LOG = 2**25
"""Bytes of a file of JSON lines."""
MOST_ROWS = 200_000
"""In a file of JSON lines; in memory, a row takes many times its bytes."""


class Tracker(Protocol):
    """Receives the rows of a run."""

    def start(self, step: int) -> None:
        """Begin at a step; stored rows of later steps belong to an abandoned run and are dropped."""

    def log(self, step: int, row: Mapping[str, float]) -> None:
        """Store a row."""

    def close(self) -> None:
        """Release files and screen; called once, also when the run fails."""


class InMemory:
    """Keeps the rows in `rows`, a list of dicts with the key "step".

    Args:
        rows: rows of an earlier part of the run.
    """

    def __init__(self, rows: list[dict[str, Any]] | None = None) -> None:
        self.rows = list(rows or [])

    def start(self, step: int) -> None:
        """Drop rows after `step`."""
        self.rows = [row for row in self.rows if row["step"] <= step]

    def log(self, step: int, row: Mapping[str, float]) -> None:
        """Append a row."""
        self.rows.append({"step": step, **row})

    def close(self) -> None:
        """Keep the rows."""


class JSONLines:
    """Appends each row to a file as one line of JSON.

    Args:
        path: the file; it is made on `start`.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)

    def start(self, step: int) -> None:
        """Drop rows after `step`, and a last line that was cut off, then open the file for appending."""
        kept = [json.dumps(row) + "\n" for row in self.read() if row["step"] <= step]
        with files.written(self.path) as new:  # a file of its own, to which nothing else leads
            new.write("".join(kept).encode())
        self._file = files.open_plain(self.path, os.O_WRONLY | os.O_APPEND)

    def log(self, step: int, row: Mapping[str, float]) -> None:
        """Append a row."""
        with files.naming(self.path):
            files.put(self._file, (json.dumps({"step": step, **row}) + "\n").encode())

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self) -> list[dict[str, Any]]:
        """Return the rows of the file, without a last line that was cut off; none if there is no file.

        Raises:
            CheckpointError: a line that is no row of numbers, too many rows or bytes, or a path that is no plain file.
        """
        try:
            content = files.read(self.path, LARGEST_LOG)
        except FileNotFoundError:
            return []
        except files.FileRefused as error:
            raise CheckpointError(f"{error}; move it away to go on without the history of the run") from error
        rows: list[dict[str, Any]] = []
        for number, line in enumerate(io.BytesIO(content), 1):
            if not line.endswith(b"\n"):
                break
            if number > MOST_ROWS:
                raise CheckpointError(
                    f"{self.path} has more than {MOST_ROWS:,} rows; take some out, or move the file away to go on "
                    "without the history of the run"
                )
            if (row := row_of(line)) is None:
                raise CheckpointError(
                    f"{self.path} is damaged: line {number} is no row of numbers with a step; take the line out, or "
                    "move the file away to go on without the history of the run"
                )
            rows.append(row)
        return rows


def row_of(line: bytes) -> dict[str, Any] | None:
    """The row of a line, if that maps "step" to a count and every name to a number."""
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(row, dict) or type(row.get("step")) is not int or not 0 <= row["step"] <= 10**9:
        return None
    numbers = all(isinstance(value, float) or (isinstance(value, int) and abs(value) < 2**63) for value in row.values())
    return row if numbers else None


class TensorBoard:
    """Writes scalars that `tensorboard --logdir DIRECTORY` shows.

    Args:
        directory: the folder of the event files.
    """

    def __init__(self, directory: str | os.PathLike[str]) -> None:
        self.directory = str(directory)

    def start(self, step: int) -> None:
        """Open an event file that hides rows after `step`."""
        optional("tensorboard", "tensorboard")
        from torch.utils.tensorboard import SummaryWriter  # slow to import, so only where it is wanted

        with files.naming(self.directory):
            self._writer = SummaryWriter(self.directory, purge_step=step + 1)

    def log(self, step: int, row: Mapping[str, float]) -> None:
        """Write each number of a row as a scalar."""
        with files.naming(self.directory):
            for name, value in row.items():
                self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        """Close the event file."""
        with files.naming(self.directory):
            self._writer.close()


class Bar:
    """Shows how far a fit is, and no numbers: of one that is a part of something else.

    Args:
        name: what is fitted.
        steps: last step of the run.
        shown: whether to show it.
    """

    def __init__(self, name: str, steps: int, shown: bool) -> None:
        self._bar = progress_bar(shown)
        self._task = self._bar.add_task(name, total=steps)

    def start(self, step: int) -> None:
        """Show the bar."""
        self._bar.start()

    def log(self, step: int, row: Mapping[str, float]) -> None:
        """Move it on."""
        self._bar.update(self._task, completed=step)

    def close(self) -> None:
        """Take it away."""
        self._bar.stop()


class Terminal:
    """A progress bar with the terms of the bound; away from a terminal, a line for each tenth of the run.

    Args:
        steps: last step of the run.
        console: a rich console; the standard error stream by default.
    """

    def __init__(self, steps: int, console: Console | None = None) -> None:
        self.steps = steps
        self.console = console or Plain(stderr=True)
        self._latest: dict[str, float] = {}
        self._bar: Progress | None = None

    def start(self, step: int) -> None:
        """Show the bar, or nothing yet."""
        self._next_line = step + self.steps / 10
        if self.console.is_terminal and not self.console.is_jupyter:
            rate = TextColumn("{task.fields[rate]}")
            text = TextColumn("{task.fields[terms]}", markup=False)
            columns = (BarColumn(20), MofNCompleteColumn(), rate, TimeRemainingColumn(compact=True), text)
            self._bar = Progress(*columns, console=self.console)
            self._task = self._bar.add_task("fit", total=self.steps, completed=step, terms="", rate="")
            self._bar.start()

    def log(self, step: int, row: Mapping[str, float]) -> None:
        """Show a row."""
        self._step = step
        self._latest |= row
        if self._bar is not None:
            speed = self._bar.tasks[0].speed
            rate = f"{speed:.1f} it/s" if speed else ""
            self._bar.update(self._task, completed=step, terms=self._text(), rate=rate)
        elif step >= self._next_line and step < self.steps:
            self._next_line = step + self.steps / 10
            self._print()

    def close(self) -> None:
        """Leave the bar as it stands, or write the last line."""
        if self._bar is not None:
            self._bar.stop()
        elif self._latest:
            self._print()

    def _print(self) -> None:
        line = Text(f"step {self._step}/{self.steps}  {self._text()}")
        self.console.print(line, soft_wrap=True)

    def _text(self) -> str:
        likelihood = not any(name.startswith("energy/") for name in self._latest) or any(
            name.startswith("log_likelihood/") for name in self._latest
        )
        terms = ("log_likelihood/", "kl/", "energy/") if likelihood else ("energy/",)
        names = [name for name in self._latest if name.startswith(terms)]
        score = "bound" if likelihood else "loss"
        names += [n for n in (score, f"validation/{score}", f"validation/self_fed/{score}") if n in self._latest]
        labels = [name.replace(f"self_fed/{score}", f"{score} with scheduled sampling") for name in names]
        labels = [n.replace("log_likelihood", "log p").removeprefix("energy/").replace("/", " ") for n in labels]
        return "  ".join(f"{label} {self._latest[name]:.3f}" for label, name in zip(labels, names, strict=True))
