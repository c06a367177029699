"""Sweeps: methods x seeds fitted in parallel by joblib, one process and one torch thread per run.

Every run has its own directory, as `dvae.fit` writes it, with bit-for-bit the same weights. Calling `sweep` again
continues a sweep: finished runs are skipped, others continue from their last checkpoint.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import threading
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
from joblib import Parallel, delayed
from rich.live import Live
from typing_extensions import override

from .. import files
from ..data.schema import Schema
from ..inference.evaluation.result import PlainConsole, Table, error_message
from ..inference.training.checkpoints import ENDED, Run
from ..inference.training.fit import Callback, Fit, fit
from ..inference.training.options import Training
from ..inference.training.processes import is_torchrun
from ..inference.training.recipe import Trainable
from ..inference.training.schedules import clamp
from ..inference.training.svi import State
from ..inference.training.trackers import LARGEST_LOG, JSONLines, row_of
from ..models.method import Method
from ..options import flat, require
from .directory import read_config, resume, training_of
from .kinds import Dataset


@dataclass(frozen=True)
class Outcome:
    """Result of a run of a sweep.

    Args:
        path: run directory.
        method: method with its options.
        seed: seed of initial weights, batches and draws.
        status: "finished", "stopped early", "interrupted" or "failed".
        step: last step.
        best_bound: best validation bound, in nats per frame, as in `Fit`.
        best: text of the best validation value and its step.
        seconds: time that this sweep spent on the run; 0 if an earlier sweep finished it.
        error: message of the error, if the run failed.
    """

    path: Path
    method: Method
    seed: int
    status: str
    step: int = 0
    best_bound: float | None = None
    best: str = ""
    seconds: float = 0.0
    error: str = ""

    def __str__(self) -> str:
        if self.status == "failed":
            return f"{self.path.name} failed: {self.error}"
        duration = f"in {_clock(self.seconds)}" if self.seconds else "by an earlier sweep"
        return ", ".join(filter(None, [f"{self.path.name} {self.status} at step {self.step} {duration}", self.best]))


class SweepInterrupted(KeyboardInterrupt):
    """Error for a sweep stopped by Ctrl-C or SIGTERM; the same sweep, started again, continues.

    Args:
        results: results of the runs that have ended.
        total: number of runs in the sweep.
        signal: number of the signal; a command line exits with 128 + signal.
    """

    def __init__(self, results: Sequence[Outcome], total: int, signal: int) -> None:
        ended = sum(result.status in ENDED for result in results)
        super().__init__(f"interrupted with {ended} of {total} runs finished; start the same sweep again to continue")
        self.results = results
        self.signal = signal


def sweep(
    methods: Mapping[str, Method] | Sequence[Method],
    data: Dataset,
    out: str | os.PathLike[str],
    seeds: Sequence[int] = (0, 1, 2),
    training: Training | Mapping[str, Any] | None = None,
    jobs: int = 2,
) -> list[Outcome]:
    """Fit each method with each seed, several runs in parallel.

    A run directory is named after the method, the options that differ among methods of this name, and the seed, such
    as srnn-z8-seed0. Runs use processes of this machine, or the backend of the caller's `joblib.parallel_config`.
    Workers on other machines need access to the file system of `out`. Ctrl-C stops all runs; the same sweep continues
    them from their last checkpoints.

    Args:
        methods: methods with their options; a mapping also gives their names.
        data: data with training and validation windows.
        out: directory for the run directories.
        seeds: seeds of the runs of each method, which replace the seed in `training`.
        training: all training options, or those that replace each method's defaults. `progress` shows the runs: a table
            on a terminal, otherwise a line when each starts and ends.
        jobs: number of runs in parallel; on a joblib cluster, the number of workers replaces it.

    Returns:
        A result for each run, ordered by seed and then by method, including failed runs.

    Raises:
        ValueError: there is nothing to fit, a run is given twice, its directory contains a run with other options, or
            `jobs` is 0.
        CheckpointError: a run is damaged.
        SweepInterrupted: after Ctrl-C or SIGTERM.

    Example:
        methods = [dvae.method("srnn", latent=latent) for latent in (8, 16)]
        results = sweep(methods, MotionData.open("people.npz"), "runs", training=dvae.Training(steps=4000), jobs=4)
    """
    if is_torchrun():
        raise ValueError("a sweep starts its own processes; start it without torchrun")
    out = Path(out)
    source = data.location
    runs = [
        _Run(
            out.absolute() / f"{name}-seed{seed}",
            method,
            data,
            source,
            replace(training_of(method, data, training), seed=seed),
        )
        for seed in seeds
        for name, method in _by_name(methods).items()
    ]
    if not runs or len({run.path for run in runs}) < len(runs):
        raise ValueError(f"a sweep needs at least one method and one seed, without duplicates, got seeds {list(seeds)}")
    require(int, jobs=jobs)
    if not jobs:
        raise ValueError("jobs is 0; it must be the number of runs at a time, or -1 for one per core")
    if devices := [run.training.devices for run in runs if run.training.devices != 1]:
        raise ValueError(f"devices is {devices[0]}, but a run of a sweep uses one device; call dvae.fit for more")
    if any(run.training.scheduled_sampling != 0 for run in runs):
        raise ValueError(
            "scheduled_sampling is an option of methods, which set its schedule; pass it to dvae.method(…), not as an "
            "option of training"
        )
    results = {run.path: result for run in runs if (result := _earlier_outcome(run)) is not None}
    pending = [run for run in runs if run.path not in results]
    notes: list[str] = []
    stopped: KeyboardInterrupt | None = None
    out.mkdir(parents=True, exist_ok=True)
    files.remove_leftovers(out)
    with _Progress(pending, runs[0].training.progress) as progress:
        for result in results.values():
            progress.end(result)
        try:
            with _interrupt_on_sigterm():
                for result, messages in _parallel(pending, jobs):
                    results[result.path] = result
                    notes += messages
                    progress.end(result)
        except KeyboardInterrupt as interrupt:
            stopped = interrupt
    for note in dict.fromkeys(notes):
        warnings.warn(note)
    outcomes = [replace(results[run.path], path=out / run.path.name) for run in runs if run.path in results]
    if stopped is not None:
        raise SweepInterrupted(outcomes, len(runs), getattr(stopped, "signal", signal.SIGINT))
    if misplaced := [result.path for result in outcomes if result.status in ENDED and not Run(result.path).exists]:
        raise RuntimeError(
            f"{misplaced[0]} is missing: its worker wrote to another disk; give a directory that all workers share"
        )
    return outcomes


def require_ended(outcomes: Sequence[Outcome]) -> None:
    """Raise an error if a run of a sweep failed.

    Raises:
        RuntimeError: a run failed; the message lists all of these.
    """
    if failed := [str(outcome) for outcome in outcomes if outcome.status not in ENDED]:
        summary = f"{len(failed)} of {len(outcomes)} runs failed; the same call retries them"
        raise RuntimeError("\n".join([summary, *failed]))


@dataclass(frozen=True)
class _Run:
    """Arguments of a worker; paths are absolute, because a worker may have another working directory."""

    path: Path
    method: Method
    data: Dataset
    source: str
    training: Training


def _parallel(runs: Sequence[_Run], jobs: int) -> Iterator[tuple[Outcome, list[str]]]:
    """Yield results with their warnings as runs end, from the joblib backend that the caller has chosen."""
    with _ignore_signals():  # for the workers, which joblib ends
        outcomes: Iterator[Any] = Parallel(n_jobs=jobs, batch_size=1, return_as="generator_unordered")(
            delayed(_fit)(run) for run in runs
        )
    yield from outcomes


_RUN_LOCK = threading.Lock()
"""Lock held during a run: threads of one process share the caught warnings and torch's number of threads."""


def _fit(run: _Run) -> tuple[Outcome, list[str]]:
    """Fit or resume a run in a worker; return its result and the warnings."""
    with _RUN_LOCK, _one_thread(), warnings.catch_warnings(record=True) as recorded:
        begin, error = time.monotonic(), ""
        try:
            if Run(run.path).exists:
                accelerator = run.training.accelerator
                result = resume(
                    run.path, run.source, callbacks=[_EndsWithParent()], progress=False, accelerator=accelerator
                )
            else:
                training = replace(run.training, progress=False)
                result = fit(run.method, run.data, out=run.path, callbacks=[_EndsWithParent()], **vars(training))
        except Exception as failure:  # of any type, perhaps one that cannot be pickled
            result = Fit([], 0, None, None, "failed", run.path)
            error = f"{type(failure).__name__}: {error_message(failure)}"
        seconds = time.monotonic() - begin
    return _outcome(run, result, seconds=seconds, error=error), [str(warning.message) for warning in recorded]


def _outcome(run: _Run, fit: Fit, **more: Any) -> Outcome:
    values = fit.status, fit.step, fit.best_bound, fit.best
    return Outcome(run.path, run.method, run.training.seed, *values, **more)


class _EndsWithParent(Callback):
    """Callback that ends a worker if its sweep was killed."""

    def __init__(self) -> None:
        self.is_main, self.parent, self.next = multiprocessing.parent_process() is None, os.getppid(), 0.0

    @override
    def on_step(self, state: State) -> None:
        if not self.is_main and time.monotonic() > self.next:
            self.next = time.monotonic() + 0.5
            if os.getppid() != self.parent:
                os._exit(1)  # a worker that returns would wait for more work


@contextmanager
def _interrupt_on_sigterm() -> Iterator[None]:
    """Make SIGTERM raise KeyboardInterrupt in the block, as Ctrl-C does."""

    def stop(number: int, _: Any) -> None:
        interrupt = KeyboardInterrupt()
        interrupt.signal = number  # type: ignore[attr-defined]
        raise interrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before or signal.SIG_DFL)


@contextmanager
def _ignore_signals() -> Iterator[None]:
    """Make processes started in the block ignore Ctrl-C, because an interrupted idle worker would break the pool."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, signal.SIG_IGN) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)


@contextmanager
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _by_name(methods: Mapping[str, Method] | Sequence[Method]) -> dict[str, Method]:
    """Return methods by the names of their run directories, without the seed."""
    if isinstance(methods, Mapping):
        by_name = dict(methods)
    else:
        by_name = {}
        for method in methods:
            same_name = [other for other in methods if other.name == method.name]
            varied = {n: v for n, v in vars(method).items() if len({repr(vars(other)[n]) for other in same_name}) > 1}
            labels = (f"z{v}" if n == "latent" else f"{n.replace('_', '-')}={v}" for n, v in varied.items())
            name = "-".join([method.name, *labels])
            if name in by_name:
                raise ValueError(f"{name} is given twice; remove one, or change its options")
            by_name[name] = method
    for name in by_name:
        if not re.fullmatch(r"[\w.=+-]+", name):
            raise ValueError(f"{name!r} cannot name a directory; name the methods: sweep({{'a': …, 'b': …}}, …)")
    return by_name


def _earlier_outcome(run: _Run) -> Outcome | None:
    """Return the result of a run that an earlier sweep has finished; None for other runs.

    Raises:
        ValueError: the directory contains a run with other options, or is a link or a file.
    """
    earlier = Run(run.path)
    if run.path.is_symlink():
        raise ValueError(f"{run.path} is a link, which could lead anywhere; put the run's own directory in its place")
    if not earlier.exists:
        if run.path.is_file():
            raise ValueError(f"{run.path} is a file, not a run directory; choose another directory for the sweep")
        return None
    config, state = read_config(run.path), earlier.state
    stored = _options(config.method, config.schema, config.training, config.data.fingerprint)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the run itself warns about shortened schedules
        training = clamp(run.training, run.training.steps)
    expected = _options(
        run.method.resolve_defaults(run.data.windows("train")), run.data.schema, training, run.data.fingerprint
    )
    if differing := [name for name in {**stored, **expected} if stored.get(name) != expected.get(name)]:
        name = differing[0]
        others = f" (and {len(differing) - 1} more)" if len(differing) > 1 else ""
        raise ValueError(
            f"{run.path} contains a run with other options: its {name} is {stored.get(name)!r}, the sweep's "
            f"{expected.get(name)!r}{others}; use the same options or another directory, or delete this run to fit it "
            "again"
        )
    return _outcome(run, _stored_fit(run)) if state["status"] in ENDED else None


def _stored_fit(run: _Run) -> Fit:
    """Return the result stored in a run's directory."""
    if not (earlier := Run(run.path)).exists:
        return Fit([], 0, None, None, "failed", run.path)
    state = earlier.state
    values = {name: state[name] for name in ("status", "step", "best_step", "best_bound")}
    values |= {"per": state.get("per", Fit.per), "processor_seconds": state.get("processor_seconds", 0.0)}
    values["last_value"] = state.get("last_value")
    return Fit(JSONLines(run.path / "log.jsonl").read(), run=run.path, **values)


def _options(method: Trainable, schema: Schema, training: Training, fingerprint: str) -> dict[str, Any]:
    """Return the options that define a run on any machine; scheduled sampling follows from the method."""
    excluded = ("scheduled_sampling", "progress", "accelerator", "log_every")
    options = {name: value for name, value in vars(training).items() if name not in excluded}
    return {**method.config(), **options, **dict(flat(schema.config(), "data's ")), "data's fingerprint": fingerprint}


class _Log:
    """Progress of a run, read from its log while another process writes it."""

    def __init__(self, run: Path, steps: int) -> None:
        self.path = run / "log.jsonl"
        self.name, self.steps = run.name, steps
        self.begins = f"continues after step {Run(run).state['step']}" if Run(run).exists else "starts"
        self.begin: float | None = None
        self.step = 0
        self.bound: float | None = None
        self._before, self._read = self._stamp(), 0

    def look(self) -> bool:
        """Read the new rows; return whether the run has just started."""
        has_started = self.begin is None and self._stamp() != self._before  # both fit and resume start a new file
        if has_started:
            self.begin = time.monotonic()
        if self.begin is not None:
            with suppress(OSError, files.FileRefused), files.open_plain(self.path) as file:
                file.seek(self._read)
                lines, separator, _ = file.read(LARGEST_LOG).rpartition(b"\n")
                self._read += len(lines + separator)
                for row in map(row_of, lines.split(b"\n")):
                    if row is None:  # a damaged row, which `JSONLines.read` reports
                        continue
                    self.step = row["step"]
                    self.bound = row.get("validation/scheduled_sampling/bound", row.get("validation/bound", self.bound))
        return has_started

    def _stamp(self) -> tuple[int, int] | None:
        with suppress(OSError):
            status = self.path.stat()
            return status.st_ino, status.st_mtime_ns
        return None


class _Progress:
    """Progress of a sweep: a line when a run ends, and a live table; without a terminal, a line when a run starts."""

    def __init__(self, runs: Sequence[_Run], visible: bool) -> None:
        self.console = PlainConsole(stderr=True, quiet=not visible, force_jupyter=False)
        self.total = len(runs)
        self.bound = f"bound (nats a {runs[0].data.schema.per if runs else Fit.per})"
        self.logs = {run.path: _Log(run.path, run.training.steps) for run in runs}
        # without a terminal nothing is drawn, but the logs are still read
        self.live = Live(console=self.console, get_renderable=self._look, refresh_per_second=2, transient=True)

    def __enter__(self) -> _Progress:
        self.live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.live.stop()

    def end(self, result: Outcome) -> None:
        """Print a result, unless its run has not started."""
        self.live.refresh()
        log = self.logs.pop(result.path, None)
        if result.status != "interrupted" or (log is not None and log.begin is not None):
            style = "red" if result.status == "failed" else None
            self.console.print(str(result), style=style, highlight=False, soft_wrap=True)
        self.live.refresh()

    def _look(self) -> Table:
        """Read the new rows of the logs, and return the table."""
        logs = list(self.logs.values())
        for log in logs:
            if log.look() and not self.console.is_terminal:
                self.console.print(f"{log.name} {log.begins}", highlight=False, soft_wrap=True)
        running = [log for log in logs if log.begin is not None]
        ended, waiting = self.total - len(logs), len(logs) - len(running)
        table = Table(caption=f"{ended} of {self.total} runs ended, {waiting} waiting", caption_justify="left")
        table.add_column("run", overflow="fold")
        for name in ("step", self.bound, "elapsed"):
            table.add_column(name, justify="right")
        for log in running:
            assert log.begin is not None
            bound = "" if log.bound is None else f"{log.bound:.3f}"
            table.add_row(log.name, f"{log.step}/{log.steps}", bound, _clock(time.monotonic() - log.begin))
        return table


def _clock(seconds: float) -> str:
    return str(timedelta(seconds=round(seconds)))
