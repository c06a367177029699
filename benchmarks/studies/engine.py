"""Shared code of the studies: settings, fits and measurements without repetition, and results over seeds with errors.

A measurement is a dictionary, stored as JSON in the directory of its run. The measurement, or each of its named parts,
contains scores by row and sequence, the clip of each sequence, and the weight of each sequence:

    {"clips": ["walk 1", "walk 2"], "weights": [3, 1], "rows": {"ours": {"ADE": [0.31, 0.28]}}}

A `Row` combines the measurements of several seeds. Scripts define the columns of a table of rows in a dictionary.
"""

from __future__ import annotations

import fcntl
import itertools
import json
import os
import sys
import time
import tomllib
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

import dvae
from dvae import files
from dvae.inference.evaluation.estimates import Estimate, TwoWayErrors
from dvae.inference.evaluation.record import plain
from dvae.inference.training.checkpoints import Run
from dvae.inference.training.fit import Fit
from dvae.runs.directory import Config
from dvae.runs.sweep import sweep

OURS, MEASURED = "ours", "measured.json"


def settings(script: str) -> dict[str, Any]:
    """Return the settings of a script from the TOML file with the same name; lists become tuples."""

    def fixed(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: fixed(each) for name, each in value.items()}
        return tuple(map(fixed, value)) if isinstance(value, list) else value

    return {
        name: fixed(each)
        for name, each in tomllib.loads(Path(script).with_suffix(".toml").read_text(encoding="utf-8")).items()
    }


def folder(name: Any) -> str:
    """Return the directory name of a section, case or row."""
    return str(name).replace(", ", "-").replace(",", "").replace(" ", "-")


def read_or_measure(file: Path, measure: Callable[[], Mapping[str, Any]]) -> dict[str, Any]:
    """Read a measurement from a file. If the file is missing, measure, and write the result with its processor time."""
    if not file.exists():
        start = time.process_time()
        measurement = measure()
        elapsed = time.process_time() - start
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(plain({"seconds": elapsed, **measurement})))
        print(f"{file}: {elapsed:.0f} s of processor time", flush=True)
    stored: dict[str, Any] = json.loads(file.read_text())
    return stored


def measure(
    path: Path, cases: Iterable[str], seeds: Iterable[int], run: Callable[[str, int, Path], Any], file: str = MEASURED
) -> None:
    """Fit and measure all missing cases, seed by seed, by calling `run(case, seed, directory)`."""
    for seed, case in itertools.product(seeds, cases):
        out = path / f"{folder(case)}-{seed}"
        read_or_measure(out / file, partial(run, case, seed, out))


def fit_or_load(
    method: Any, data: Any, train: Any, validation: Any = None, *, out: Path, seed: int, steps: int, **options: Any
) -> Fit:
    """Fit a method, resume its run, or load the finished run.

    Args:
        method: method with its options.
        data: data set that the run records.
        train: training windows.
        validation: windows that select the best weights; None uses the last weights.
        out: directory of the run.
        seed: seed of weights and batches.
        steps: number of training steps.
        options: further options of training or of `dvae.fit`.
    """
    torch.manual_seed(seed)
    model, recipe = method.build(data.schema), method.train(train, validation, steps)
    config = Config(method, data.schema, data.kind, data.recorded(), dvae.Training()).written()
    run_options = {"resume": Run(out).exists, "config": config, "seed": seed, "steps": steps, "progress": False}
    return dvae.fit(model, recipe, out=out, **run_options, **options)


def sweep_seeds(
    row: str, method: Any, data: Any, runs: Path, seeds: Sequence[int], training: Any, jobs: int = 1
) -> list[Path]:
    """Return the run directories of a method, one per seed; missing runs are fitted.

    Raises:
        RuntimeError: a run failed.
    """
    outcomes = sweep({folder(row): method}, data, runs, seeds, training, jobs)
    for outcome in outcomes:
        if outcome.status == "failed":
            raise RuntimeError(str(outcome))
    return [outcome.path for outcome in outcomes]


def scores_of(clips: Mapping[str, float], rows: Mapping[str, Any]) -> dict[str, Any]:
    """Return a measurement from scores by clip and the number of windows of each clip."""
    return {"clips": [*clips], "weights": [*clips.values()], "rows": rows}


@dataclass(frozen=True)
class Row:
    """One row of a table: the measurements of all seeds.

    Args:
        runs: one measurement per seed.
        name: name of the row in the measurements.
        part: name of the part that contains the row; "" for the whole measurement.
        trained: whether results depend on the seed; False for reference methods.
    """

    runs: Sequence[Mapping[str, Any]]
    name: str = OURS
    part: str = ""
    trained: bool = True

    def of(self, part: str) -> Row:
        """Return the same row of another part."""
        return replace(self, part=part)

    @property
    def parts(self) -> list[Mapping[str, Any]]:
        """The part of the measurement of each seed."""
        return [run[self.part] if self.part else run for run in self.runs]

    def values(self, score: str) -> np.ndarray | None:
        """Return scores (S, N) by seed and sequence; None if the score is missing for a seed."""
        rows = [part["rows"].get(self.name, {}) for part in self.parts]
        return np.array([row[score] for row in rows], float) if all(score in row for row in rows) else None

    def by_seed(self, score: str) -> np.ndarray:
        """Return weighted means (S,) of a score."""
        return np.average(self.values(score), 1, self.parts[0]["weights"])

    def two_way_errors(self, score: str, minus: Row | None = None) -> TwoWayErrors | None:
        """Return a score by seed and clip, or its paired difference to another row; None if a score is missing."""
        values, others = self.values(score), 0.0 if minus is None else minus.values(score)
        if values is None or others is None:
            return None
        values, first = values - others, self.parts[0]
        valid = ~np.isnan(values).any(0)
        if not valid.any():
            return None
        values, clips, weights = values[:, valid], np.array(first["clips"])[valid], np.array(first["weights"])[valid]
        order = {clip: place for place, clip in enumerate(dict.fromkeys(clips))}
        if len(order) == len(clips):  # no sums by clip, so that equal seeds have exactly no error
            errors = TwoWayErrors.of(values, weights)
        else:
            errors = TwoWayErrors.by_cluster(values * weights, weights, np.array([order[clip] for clip in clips]))
        return errors if self.trained else replace(errors, seeds=0.0, rest=0.0, count=sys.maxsize)

    def estimate(self, score: str, other: Row | None = None) -> Estimate | None:
        """Return the mean, or its paired difference to a row of other runs; None if a score is missing."""
        errors, other_errors = self.two_way_errors(score), None if other is None else other.two_way_errors(score)
        return None if errors is None or (other is not None and other_errors is None) else errors.estimate(other_errors)

    def format_score(self, score: str, digits: int = 1) -> str:
        """Format the mean with its errors over clips and over seeds."""
        return format_mean(self.estimate(score), digits)

    def numbers(self, name: str) -> str:
        """Format one number per run by `spread`."""
        return spread([run.get(name) for run in self.runs])


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Wait until no other process holds the lock of a folder, and hold it (Linux and macOS)."""
    path.mkdir(parents=True, exist_ok=True)
    number = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(number, fcntl.LOCK_EX)
        yield
    finally:
        os.close(number)


class Archive:
    """Measurements by name in one zip file; equal measurements give equal bytes, and processes may add at once."""

    def __init__(self, file: Path) -> None:
        self.file = file

    @property
    def names(self) -> list[str]:
        """Sorted names of the measurements; empty if the file does not exist."""
        if not self.file.exists():
            return []
        with zipfile.ZipFile(self.file) as archive:
            return sorted(archive.namelist())

    def read(self, names: Iterable[str]) -> list[dict[str, Any]]:
        """Return measurements; the file stores the number of windows of each clip."""
        with zipfile.ZipFile(self.file) as archive:
            measurements = [json.loads(archive.read(name)) for name in names]
        return [each | {"clips": [*each["clips"]], "weights": [*each["clips"].values()]} for each in measurements]

    def add(self, name: str, measurement: Mapping[str, Any]) -> None:
        """Add a measurement, whose `clips` map each clip to its number of windows."""
        contents = {name: json.dumps(measurement, separators=(",", ":")).encode()}
        with locked(self.file.parent):
            if self.file.exists():
                with zipfile.ZipFile(self.file) as archive:
                    contents = {name: archive.read(name) for name in archive.namelist()} | contents
            with (
                files.atomic_write(self.file) as new,
                zipfile.ZipFile(new, "w", zipfile.ZIP_LZMA) as out,
            ):
                for name in sorted(contents):
                    out.writestr(zipfile.ZipInfo(name), contents[name], zipfile.ZIP_LZMA)


def read(path: Path, cases: Iterable[str], file: str = MEASURED) -> dict[str, Row]:
    """Return the measured cases, each with all its seeds."""
    files = {case: sorted(path.glob(f"{folder(case)}-[0-9]*/{file}")) for case in cases}
    return {case: Row([json.loads(each.read_text()) for each in paths]) for case, paths in files.items() if paths}


def read_all(path: Path, name: str) -> Row | None:
    """Return the measurements of all runs under one name, or None without any."""
    measurements = [json.loads(file.read_text()) for file in sorted(path.glob(f"*/{name}.json"))]
    return Row(measurements) if measurements else None


def budget(rows: Iterable[Row], steps: int) -> str:
    """Return a sentence about the training steps and the processor time of the fits."""
    seconds = [run["seconds"] for row in rows for run in row.runs]
    return f"{steps} steps of training, {min(seconds):.0f} to {max(seconds):.0f} s of processor time."


def format_mean(estimate: Estimate | None, digits: int = 1) -> str:
    """Format a mean and its errors over clips and over seeds; a dash marks unknown numbers."""
    values = () if estimate is None else (estimate.mean, estimate.sequences, estimate.seeds)
    return " ± ".join("–" if np.isnan(value) else f"{value:.{digits}f}" for value in values) or "–"


def cell(estimate: Estimate | None) -> str:
    """Format an estimate with digits chosen by its errors; rows without training have no error over seeds."""
    text = "–" if estimate is None else str(estimate)
    return text.rpartition(" ± ")[0] if estimate is not None and not estimate.seeds else text


def interval(estimate: Estimate | None, digits: int = 1, *, allow_one_seed: bool = False) -> str:
    """Format the 95 % interval from both errors; one seed has an interval only with `allow_one_seed`, over clips."""
    if estimate is None or (np.isnan(estimate.total) and not allow_one_seed):
        return "–"
    low, high = estimate.interval(error="sequences" if np.isnan(estimate.total) else "total")
    return "–" if np.isnan(low) else f"{low:.{digits}f} to {high:.{digits}f}"


def spread(values: Sequence[float | None], digits: int = 2) -> str:
    """Format the mean with minimum and maximum in brackets; a dash if a value is unknown."""
    known = [value for value in values if value is not None]
    if len(known) < len(values) or not known:
        return "–"
    return f"{np.mean(known):.{digits}f} ({min(known):.{digits}f}, {max(known):.{digits}f})"
