"""Trackers: where the numbers of a run go, row by row. Memory, a file of JSON lines, TensorBoard, the
terminal.

A row maps names to numbers: `bound`, `log_likelihood/x`, `kl/z` are those of a training batch, the same names
under `validation/` those of the validation data, in nats per frame; `loss`, `gradient_norm`, `learning_rate`,
`self_feeding` are of the step.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

Row = Mapping[str, float]


class Tracker(Protocol):
    """Receives the rows of a run."""

    def start(self, step: int) -> None:
        """Begin at a step; stored rows of later steps belong to an abandoned run and are dropped."""

    def log(self, step: int, row: Row) -> None:
        """Store a row."""

    def close(self) -> None:
        """Release files and screen; called once, also when the run fails."""


class Memory:
    """Keeps the rows in `rows`, a list of dicts with the key "step".

    Args:
        rows: rows of an earlier part of the run.
    """

    def __init__(self, rows: list[dict[str, Any]] | None = None) -> None:
        self.rows = list(rows or [])

    def start(self, step: int) -> None:
        """Drop rows after `step`."""
        self.rows = [row for row in self.rows if row["step"] <= step]

    def log(self, step: int, row: Row) -> None:
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
        self.path.parent.mkdir(parents=True, exist_ok=True)
        kept = [json.dumps(row) + "\n" for row in self.read() if row["step"] <= step]
        new = self.path.with_name(f"{self.path.name}.new")
        new.write_text("".join(kept))
        os.replace(new, self.path)
        self._file = self.path.open("a")

    def log(self, step: int, row: Row) -> None:
        """Append a row and flush it."""
        self._file.write(json.dumps({"step": step, **row}) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self) -> list[dict[str, Any]]:
        """Return the rows of the file, up to the first line that is not JSON; none if there is no file."""
        rows: list[dict[str, Any]] = []
        if self.path.exists():
            for line in self.path.read_text().splitlines():
                try:
                    rows.append(json.loads(line))
                except ValueError:
                    break
        return rows


class TensorBoard:
    """Writes scalars that `tensorboard --logdir DIRECTORY` shows.

    Args:
        directory: the folder of the event files.
    """

    def __init__(self, directory: str | os.PathLike[str]) -> None:
        self.directory = str(directory)

    def start(self, step: int) -> None:
        """Open an event file that hides rows after `step`."""
        from torch.utils.tensorboard import SummaryWriter  # slow to import, so only where it is wanted

        self._writer = SummaryWriter(self.directory, purge_step=step + 1)

    def log(self, step: int, row: Row) -> None:
        """Write each number of a row as a scalar."""
        for name, value in row.items():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        """Close the event file."""
        self._writer.close()


class Terminal:
    """A progress bar with the terms of the bound; away from a terminal, a line for each tenth of the run.

    Args:
        steps: last step of the run.
        console: a rich console; the standard error stream by default.
    """

    def __init__(self, steps: int, console: Console | None = None) -> None:
        self.steps = steps
        self.console = console or Console(stderr=True)
        self._latest: dict[str, float] = {}
        self._bar: Progress | None = None

    def start(self, step: int) -> None:
        """Show the bar, or nothing yet."""
        self._next_line = step + self.steps / 10
        if self.console.is_terminal and not self.console.is_jupyter:
            rate = TextColumn("{task.fields[rate]}")
            text = TextColumn("{task.fields[terms]}")
            columns = (BarColumn(20), MofNCompleteColumn(), rate, TimeRemainingColumn(compact=True), text)
            self._bar = Progress(*columns, console=self.console)
            self._task = self._bar.add_task("fit", total=self.steps, completed=step, terms="", rate="")
            self._bar.start()

    def log(self, step: int, row: Row) -> None:
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
        self.console.print(f"step {self._step}/{self.steps}  {self._text()}", highlight=False, soft_wrap=True)

    def _text(self) -> str:
        likelihood = not any(name.startswith("energy/") for name in self._latest) or any(
            name.startswith("log_likelihood/") for name in self._latest
        )
        terms = ("log_likelihood/", "kl/", "energy/") if likelihood else ("energy/",)
        names = [name for name in self._latest if name.startswith(terms)]
        score = "bound" if likelihood else "loss"
        names += [name for name in (score, f"validation/{score}") if name in self._latest]
        said = [n.replace("log_likelihood", "log p").removeprefix("energy/").replace("/", " ") for n in names]
        return "  ".join(f"{text} {self._latest[name]:.3f}" for text, name in zip(said, names, strict=True))
