"""Load, check and name the runs given to a command."""

from __future__ import annotations

import json
import re
import warnings
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch

from .. import motion
from ..data.views import View
from ..inference.evaluation.scores import Scores
from ..inference.training.checkpoints import Run
from ..models.family.equations import Equations
from ..models.registry import metric_models
from ..options import flat
from ..runs import directory as runs
from ..tables.forecasts import panel_scores
from . import tables
from .console import UsageError, note
from .help import Expert

USES = {
    "motion": "forecasts and has no segments; use dvae forecast, animate, evaluate, compare or check",
    "panel": "is of a table; use dvae forecast, impute, evaluate, compare, check or report",
    "segments": "generates whole segments and has no forecasts; use dvae evaluate or impute",
}
"""Commands for runs, by kind of data."""
FORECASTING = ("motion", "panel")
"""Kinds of data with forecasts."""
SCORES: Mapping[str, Scores] = {"motion": motion.scores, "panel": panel_scores}
"""Scores of forecasts, by kind of data."""
Device = Literal["auto", "cpu", "gpu", "cuda"]


@dataclass(frozen=True)
class Use:
    """Options of commands that score runs or draw from them.

    Args:
        failed: use the current weights of a run that failed or has made no step.
        accelerator: device that computes: cpu, cuda or gpu, or auto for a GPU if there is one.
    """

    failed: Expert[bool] = False
    accelerator: Expert[Device] = "cpu"


ON_CPU = Use()


def device_of(use: Use) -> Literal["cpu", "cuda"]:
    """Return torch's name of the device.

    Raises:
        UsageError: torch finds no GPU.
    """
    if use.accelerator == "cpu" or torch.cuda.is_available():
        return "cpu" if use.accelerator == "cpu" else "cuda"
    if use.accelerator == "auto":
        return "cpu"
    raise UsageError(f"--accelerator {use.accelerator}: torch finds no GPU; leave the option out")


def load_run(path: Path, data: str | None, kinds: Collection[str] = ("motion",), use: Use = ON_CPU) -> runs.Loaded:
    """Load a run that was fitted on data of one of the given kinds.

    Raises:
        ValueError: the run was fitted on another kind, or it failed and `use.failed` is False.
    """
    loaded = load(path, data, use)
    if loaded.config.kind not in kinds and (others := USES.get(loaded.config.kind)):
        raise ValueError(f"{path} is a fitted {loaded.method.name}, which {others}")
    if loaded.method.name in metric_models():
        raise ValueError(
            f"{path} is a fitted {loaded.method.name}, which has no forecasts; its bounds are in {path / 'log.jsonl'}"
        )
    return loaded


def load(path: Path, data: str | None, use: Use = ON_CPU) -> runs.Loaded:
    """Load a run of any kind on a device, with a note if it has not finished.

    Raises:
        ValueError: `use.failed` is False, and the run failed or has no optimiser step yet.
        UsageError: torch finds no GPU.
    """
    device = device_of(use)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the note below covers more cases than the warning of `runs.load`
        loaded = runs.load(path, data)
    if loaded.failed and not use.failed:
        raise ValueError(f"{loaded.unfinished}; or use its current weights with --failed")
    if loaded.unfinished:
        note(loaded.unfinished)
    if device != "cpu":
        loaded.model.to(device)
    return loaded


def kind_of(paths: Sequence[Path], data: str | None) -> str:
    """Return the kind of data that runs were fitted on.

    Raises:
        UsageError: the kinds differ.
    """
    kinds = {runs.read_config(path).kind: path for path in paths}
    if len(kinds) > 1:
        descriptions = " and ".join(f"{path} on {kind}" for kind, path in kinds.items())
        raise UsageError(f"these runs were fitted on several kinds of data, {descriptions}; give runs of one kind")
    return next(iter(kinds), "motion")


def data_of(path: str | None, *shared: runs.Loaded, missing: bool = False) -> Any:
    """Return the data of runs with one schema, or the data at a path under the protocol of the runs.

    The view of the data contains what any of the runs reads.

    Raises:
        UsageError: `missing` does not apply to these data.
    """
    widest = next((run for run in shared if type(run.schema.view) is not View), shared[0])
    if missing and widest.config.kind == "panel":
        raise UsageError(f"--missing is for motion, and {widest.path} was fitted on a table; leave it out")
    if path is None:
        if missing and not widest.data.motion.missing:
            raise UsageError(
                "--missing is for other data, because the data of the run have no missing joints; give other data with "
                "--data, or leave --missing out"
            )
        return widest.data
    other_data = widest.with_data(path, **({"missing": True} if missing else {}))
    if other_data.onto:
        note(f"{path} has another skeleton; its joints are matched with those of {widest.path} by their names")
    for run in shared:
        if not is_training_data(run, other_data):
            note(f"{path} is not the data that {run.path} was fitted on")
    return other_data


def windows_to_test(run: runs.Loaded, data_set: Any, stride: int | None = None, whole_sequences: bool = True) -> Any:
    """Return the test windows of data, cut as in a run.

    Args:
        run: fitted run.
        data_set: data of the run, or other data.
        stride: steps between the starts of windows, in place of the run's.
        whole_sequences: whether to return whole sequences of a table, which have no forecasts, if the run was fitted
            on them.
    """
    if run.config.kind == "panel":
        if not whole_sequences or data_set.schema.cut.length is not None:
            return tables.windows(run, data_set, stride=stride)
        if stride is not None:
            raise UsageError(f"--stride is for windows, and {run.path} was fitted on whole sequences; leave it out")
        return data_set.windows("test")
    protocol = data_set.protocol if stride is None else replace(data_set.protocol, test_stride=stride)
    return motion.windows(data_set.motion, protocol, "test")


def forecaster(path: Path, data: str | None, missing: bool = False, use: Use = ON_CPU) -> tuple[runs.Loaded, Any]:
    """Load a run that forecasts, and its data or other data, as in `load_run` and `data_of`."""
    loaded = load_run(path, data, FORECASTING, use)
    return loaded, data_of(data, loaded, missing=missing)


def with_equal_windows(
    paths: Sequence[Path], path: str | None, kinds: Collection[str] = FORECASTING, use: Use = ON_CPU
) -> list[runs.Loaded]:
    """Load runs that have the same test windows, in the data they were fitted on or in the data at `path`.

    Raises:
        UsageError: no run, or a run twice.
        ValueError: test windows differ.
    """
    if not paths:
        raise UsageError("give at least one run directory")
    path_repeated, count = Counter(map(str, paths)).most_common(1)[0]
    if count > 1:
        raise UsageError(f"a run is named twice: {path_repeated}; name it once")
    loaded = [load_run(each, path, kinds, use) for each in paths]
    first = loaded[0]
    for other in loaded[1:]:
        if not (other.alike(first) if path is None else other.schema.windows == first.schema.windows):
            source, first_source = (f"{run.config.data.path}, {_cut(run)}" for run in (other, first))
            raise ValueError(
                f"{other.path} has other test windows ({source}) than {first.path} ({first_source}); give runs of the "
                "same data and protocol"
            )
    return loaded


def _cut(run: runs.Loaded) -> str:
    """Return the name of the protocol, or the description of how segments are cut."""
    return str(run.config.data.cut if run.config.kind == "segments" else run.schema.protocol.name)


def is_training_data(run: runs.Loaded, data_set: Any) -> bool:
    """Return whether a run was fitted on these data."""
    return bool(data_set.fingerprint == run.config.data.fingerprint)


def record(kind: str, run: runs.Loaded, data_set: Any) -> str:
    """Return the file name of a record of a run, without suffix; it contains the name of other data."""
    return kind if is_training_data(run, data_set) else f"{kind}-{Path(data_set.location).stem}"


def rows(loaded_runs: Sequence[runs.Loaded]) -> dict[str, list[runs.Loaded]]:
    """Group runs that differ only in the training seed.

    Returns:
        Dictionary from row name to runs. The name is the method, followed by the options that differ if several rows
        have the same method.

    Raises:
        UsageError: two runs have the same options and seed.
    """
    rows: dict[str, list[runs.Loaded]] = {}
    seeds: dict[tuple[str, int], Path] = {}
    for run in loaded_runs:
        key = json.dumps(config_without_seed(run), sort_keys=True)
        seed = run.config.training.seed
        if (key, seed) in seeds:
            raise UsageError(f"{run.path} and {seeds[key, seed]} are the same fit with the same seed; give one of them")
        seeds[key, seed] = run.path
        rows.setdefault(key, []).append(run)
    firsts = [row[0] for row in rows.values()]
    names = [first.method.name for first in firsts]
    for name in [name for name, count in Counter(names).items() if count > 1]:
        indices = [index for index, other in enumerate(names) if other == name]
        grid = [_sweep_name(list(rows.values())[index]) for index in indices]
        is_distinct = all(grid) and len({*grid}) == len(grid) and not {*grid} & {*names}
        if name == Equations.name and is_distinct:  # shorter than the differing options
            names = [grid[indices.index(index)] if index in indices else other for index, other in enumerate(names)]
            continue
        for index, label in zip(indices, _distinct_labels([firsts[index] for index in indices]), strict=True):
            names[index] = f"{name} ({label})"
    return dict(zip(names, rows.values(), strict=True))


def _sweep_name(row: Sequence[runs.Loaded]) -> str:
    """Return the common directory name of a row of several runs, without the seed, as in a sweep; "" otherwise."""
    stems = {re.sub(r"-seed\d+$", "", run.path.absolute().name) for run in row}
    return stems.pop() if len(stems) == 1 and len(row) > 1 else ""


def _distinct_labels(loaded_runs: Sequence[runs.Loaded]) -> list[str]:
    """Return labels that distinguish runs of one method: options, or directory names, or whole paths."""
    options = [_options(run) for run in loaded_runs]
    keys = dict.fromkeys(key for run_options in options for key in run_options)
    differing = [key for key in keys if len({str(run_options.get(key)) for run_options in options}) > 1]
    option_labels = [
        ", ".join(f"{key.partition('.')[2]} {run_options[key]}" for key in differing if key in run_options)
        for run_options in options
    ]
    candidates = (
        option_labels,
        [run.path.absolute().name for run in loaded_runs],
        [str(run.path) for run in loaded_runs],
    )
    return next(texts for texts in candidates if all(texts) and len(set(texts)) == len(texts))


def _options(run: runs.Loaded) -> dict[str, Any]:
    """Return the chosen options of method and training, without scheduled sampling, which the method sets."""
    config = config_without_seed(run)
    training = {key: value for key, value in config["training"].items() if key != "scheduled_sampling"}
    return dict(flat({"method": config["method"], "training": training}))


def config_without_seed(run: runs.Loaded) -> dict[str, Any]:
    """Return the configuration of a run, without the seed and the options that affect no result."""
    config = Run(run.path).config
    aside = {"seed", "progress", "log_every"}
    training = {key: value for key, value in config["training"].items() if key not in aside}
    config = {name: value for name, value in config.items() if name != "validation_data"}  # older runs have none
    return {**config, "training": training, "data": {k: v for k, v in config["data"].items() if k != "path"}}


def names(loaded_runs: Sequence[runs.Loaded]) -> list[str]:
    """Return method names; directory names if methods repeat, and whole paths if these repeat too."""
    candidates = ([run.method.name for run in loaded_runs], [run.path.name for run in loaded_runs])
    paths = [str(run.path) for run in loaded_runs]
    return next((names for names in candidates if len(set(names)) == len(names)), paths)
