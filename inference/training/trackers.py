"""Trackers, which receive the log of a run: a list, a file of JSON lines, TensorBoard or the terminal.

A row maps names to numbers, in nats per step. `bound`, `log_likelihood/x` and `kl/z` are of a training batch, and with
the prefix `validation/` of the validation data. `loss`, `gradient_norm`, `learning_rate` and `scheduled_sampling`
describe the step, as does `weight/x` for an objective with adaptive weights. `validation/CRPS`, without a unit, is of
forecasts, if they select the weights (`forecast_score`).
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
from ..evaluation.result import PlainConsole, progress_bar
from .checkpoints import CheckpointError
from .forecast_score import NAME

LARGEST_LOG = 2**25
"""Largest size of a file of JSON lines, in bytes."""
MOST_ROWS = 200_000
"""Largest number of rows in a file of JSON lines; in memory, a row takes many times its bytes."""


class Tracker(Protocol):
    """Interface of a tracker, which receives each row of a run's training log."""

    def start(self, step: int) -> None:
        """Prepare for rows after a step, and drop stored rows of later steps, which the resumed run repeats."""

    def log(self, step: int, row: Mapping[str, float]) -> None:
        """Store a row."""

    def close(self) -> None:
        """Release files and terminal; called once, even if the run fails."""


class InMemory:
    """List of rows in `rows`: dicts with the key "step".

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
        """Do nothing; the rows remain."""


class JSONLines:
    """File with one line of JSON for each row.

    Args:
        path: the file; `start` creates it.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)

    def start(self, step: int) -> None:
        """Drop rows after `step`, and an incomplete last line, then open the file for appending."""
        lines = [json.dumps(row) + "\n" for row in self.read() if row["step"] <= step]
        with files.atomic_write(self.path) as new:  # a new file, so that no link to it exists
            new.write("".join(lines).encode())
        self._file = files.open_plain(self.path, os.O_WRONLY | os.O_APPEND)

    def log(self, step: int, row: Mapping[str, float]) -> None:
        """Append a row."""
        with files.with_path(self.path):
            files.write_all(self._file, (json.dumps({"step": step, **row}) + "\n").encode())

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self) -> list[dict[str, Any]]:
        """Return the rows of the file, without an incomplete last line; an empty list without a file.

        Raises:
            CheckpointError: when a line is not a row of numbers, there are too many rows or bytes, or the path is not a
                plain file.
        """
        try:
            content = files.read(self.path, LARGEST_LOG)
        except FileNotFoundError:
            return []
        except files.FileRefused as error:
            raise CheckpointError(f"{error}; move it away to continue without the history of the run") from error
        rows: list[dict[str, Any]] = []
        for number, line in enumerate(io.BytesIO(content), 1):
            if not line.endswith(b"\n"):
                break
            if number > MOST_ROWS:
                raise CheckpointError(
                    f"{self.path} has more than {MOST_ROWS:,} rows; remove some, or move the file away to continue "
                    "without the history of the run"
                )
            if (row := row_of(line)) is None:
                raise CheckpointError(
                    f"{self.path} is damaged: line {number} is not a row of numbers with a step; remove the line, or "
                    "move the file away to continue without the history of the run"
                )
            rows.append(row)
        return rows


def row_of(line: bytes) -> dict[str, Any] | None:
    """Return the row of a line if it maps "step" to a count and every name to a number, otherwise None."""
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(row, dict) or type(row.get("step")) is not int or not 0 <= row["step"] <= 10**9:
        return None
    numbers = all(isinstance(value, float) or (isinstance(value, int) and abs(value) < 2**63) for value in row.values())
    return row if numbers else None


class TensorBoard:
    """Writer of scalars that `tensorboard --logdir DIRECTORY` displays.

    Args:
        directory: folder of the event files.
    """

    def __init__(self, directory: str | os.PathLike[str]) -> None:
        self.directory = str(directory)

    def start(self, step: int) -> None:
        """Open an event file that hides rows after `step`."""
        optional("tensorboard", "tensorboard")
        from torch.utils.tensorboard import SummaryWriter  # slow to import, so imported only on use

        with files.with_path(self.directory):
            self._writer = SummaryWriter(self.directory, purge_step=step + 1)

    def log(self, step: int, row: Mapping[str, float]) -> None:
        """Write each number of a row as a scalar."""
        with files.with_path(self.directory):
            for name, value in row.items():
                self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        """Close the event file."""
        with files.with_path(self.directory):
            self._writer.close()


class Bar:
    """Progress bar without numbers, for a fit that is part of a larger computation.

    Args:
        name: name of the fit.
        steps: last step of the run.
        visible: whether to display the bar.
    """

    def __init__(self, name: str, steps: int, visible: bool) -> None:
        self._bar = progress_bar(visible)
        self._task = self._bar.add_task(name, total=steps)

    def start(self, step: int) -> None:
        """Show the bar."""
        self._bar.start()

    def log(self, step: int, row: Mapping[str, float]) -> None:
        """Advance the bar."""
        self._bar.update(self._task, completed=step)

    def close(self) -> None:
        """Remove the bar."""
        self._bar.stop()


class Terminal:
    """Progress bar with the terms of the bound; if output is not a terminal, a line for each tenth of the run.

    Args:
        steps: last step of the run.
        console: a rich console; the standard error stream by default.
    """

    def __init__(self, steps: int, console: Console | None = None) -> None:
        self.steps = steps
        self.console = console or PlainConsole(stderr=True)
        self._latest: dict[str, float] = {}
        self._step = 0
        self._bar: Progress | None = None

    def start(self, step: int) -> None:
        """Show the bar if the output is a terminal."""
        self._next_line = step + self.steps / 10
        if self.console.is_terminal and not self.console.is_jupyter:
            rate = TextColumn("{task.fields[rate]}")
            text = TextColumn("{task.fields[terms]}", markup=False)
            columns = (BarColumn(20), MofNCompleteColumn(), rate, TimeRemainingColumn(compact=True), text)
            self._bar = Progress(*columns, console=self.console)
            self._task = self._bar.add_task("fit", total=self.steps, completed=step, terms="", rate="")
            self._bar.start()

    def log(self, step: int, row: Mapping[str, float]) -> None:
        """Show a row; a line shows all rows of its step."""
        if self._bar is None and self._latest and self._next_line <= self._step < step:
            self._next_line = self._step + self.steps / 10
            self._print()
        self._step = step
        self._latest |= row
        if self._bar is not None:
            speed = self._bar.tasks[0].speed
            rate = f"{speed:.1f} it/s" if speed else ""
            self._bar.update(self._task, completed=step, terms=self._text(), rate=rate)

    def close(self) -> None:
        """Stop the bar, which stays on the screen, or print the last line."""
        if self._bar is not None:
            self._bar.stop()
        elif self._latest:
            self._print()

    def _print(self) -> None:
        line = Text(f"step {self._step}/{self.steps}  {self._text()}")
        self.console.print(line, soft_wrap=True)
        # a line shows validation scores only if they are new
        self._latest = {name: value for name, value in self._latest.items() if not name.startswith("validation/")}

    def _text(self) -> str:
        likelihood = not any(name.startswith("energy/") for name in self._latest) or any(
            name.startswith("log_likelihood/") for name in self._latest
        )
        terms = ("log_likelihood/", "kl/", "energy/") if likelihood else ("energy/",)
        names = [name for name in self._latest if name.startswith(terms)]
        score = "bound" if likelihood else "loss"
        scores = (score, f"validation/{score}", f"validation/scheduled_sampling/{score}", f"validation/{NAME}")
        names += [name for name in scores if name in self._latest]
        labels = [name.replace(f"scheduled_sampling/{score}", f"{score} with scheduled sampling") for name in names]
        labels = [name.replace(f"/{NAME}", f"/{NAME} (selects)") for name in labels]
        labels = [n.replace("log_likelihood", "log p").removeprefix("energy/").replace("/", " ") for n in labels]
        return "  ".join(f"{label} {self._latest[name]:.3f}" for label, name in zip(labels, names, strict=True))
