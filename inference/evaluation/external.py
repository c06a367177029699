"""Forecasts of other software: samples in memory or in a file, aligned with the windows of an evaluation.

`evaluate` accepts them in place of a model. Only the T steps to predict are given, in the units of the data.

| file | content |
|---|---|
| npz | `samples` (K, N, T, D); keys `sequence`, `start`, optionally `split` (N,); optionally `columns` (D,) |
| npy | samples (K, N, T, D), with the windows in the order of the evaluation; also npz without keys |
| CSV | columns `sequence`, `start`, optionally `split`; `sample`, `ahead` from 1 to T; and a column for each of D |

`start` is the first step of the window, which is observed. The npz files that `dvae forecast` writes are also read.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from reprlib import repr as brief
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ... import files
from ...data.blocks import hash_values
from ...data.npy import mapped, npz_arrays
from ...data.sequences import HeldOutWindows, columns_of, tensor_of
from ...distributions.family import FAMILIES, Family
from ...program.batch import describe_support
from .baselines import Forecaster
from .evaluation_windows import EvaluationWindows, prepare_windows

Key = tuple[str, str, int]

SUFFIXES = (".npz", ".npy", ".csv")
LARGEST, LARGEST_CSV = 2**32, 2**28
"""Maximum bytes of an unpacked npz file, and of a CSV file; an npy file is mapped and may be larger."""
NAMES = {"samples": ("samples", "forecasts", "draws"), "sequence": ("sequence", "clip")}
"""Names of members of an npz file; the further ones are those of `dvae forecast`."""
READ = (*NAMES["samples"], *NAMES["sequence"], "split", "start", "step", "columns", "joint_names", "emission", "blend")
UNREAD = (
    *("observed", "past", "truth", "future", "horizon", "time", "times", "largest_steps"),
    *("name", "parents", "joints_left", "joints_right", "up_axis", "fps"),
)
"""Members of an npz file that are read, and those that `dvae` writes and that are ignored here."""
AXES = ("sequence", "start", "sample", "ahead")
"""Columns of a CSV file that place its rows."""
ORDERS = ("kntd", "kntjc")
"""Axes of samples: k samples, n windows, t steps, and d columns or j groups of c columns."""
FEW = 3
"""Number of windows that an error names."""
MOST = 20
"""Number of columns or sequences that an error names."""


@dataclass(frozen=True, eq=False)
class ForecastSamples:
    """Samples of the futures of windows, in the units of the data.

    Args:
        values: (K, N, T, D), K samples of N windows.
        keys: (split, sequence, first step) of each window, with "" for an unknown split; None if the windows are in the
            order of the evaluation.
        columns: names of the D columns; empty if unknown.
        sequences: name of the sequence of each window, "" if unknown, to check the order; empty if all are unknown.
        starts: time of the first step of each future, None if unknown, to check the order; empty if all are unknown.
        emission: "mean" if samples are known to be means of an emission distribution given draws of latents.
    """

    values: Any
    keys: Sequence[Key] | None = None
    columns: Sequence[str] = ()
    sequences: Sequence[str] = ()
    starts: Sequence[Any] = ()
    emission: str = ""

    @classmethod
    def of(cls, given: Any, name: str = "forecasts", observed: int | None = None) -> ForecastSamples:
        """Return samples from an array, a mapping, a list or a file.

        Args:
            given: (K, N, T, D); a mapping from the key of a window to (K, T, D); a list with one item for each window,
                each (K, T, D), a `SampleForecast` of gluonts or a `TimeSeries` of darts; or the path of a file.
            name: name of the row, for errors.
            observed: number of observed steps of a window, as in `read_samples`.

        Raises:
            TypeError: the forecasts have another type, or contain no samples.
            ValueError: items have different shapes or columns, or the file is invalid.
        """
        if isinstance(given, ForecastSamples):
            return given
        if isinstance(given, str | os.PathLike):
            return read_samples(given, observed)
        if isinstance(given, Tensor | np.ndarray):
            return cls(_on_cpu(given))
        if not isinstance(given, Mapping | list | tuple) or not given:
            kind = f"an empty {type(given).__name__}" if isinstance(given, Mapping | list | tuple) else brief(given)
            raise TypeError(
                f"{name!r} is {kind}; expected a model that forecasts, such as a DynamicalVAE (see "
                "dvae.program.protocols.Forecasting for the methods that it needs), or samples (K, N, T, D): an array "
                "or the path of a file, such as `save` of the forecasts of a run writes"
            )
        keys = [_key(key, name) for key in given] if isinstance(given, Mapping) else None
        listed = given.values() if isinstance(given, Mapping) else given
        items = [_item(item, f"{name}[{n}]") for n, item in enumerate(listed)]
        values, columns, sequences, starts = zip(*items, strict=True)
        kinds = [(tuple(window.shape), *names) for window, names in zip(values, columns, strict=True)]
        if len({*kinds}) > 1 or values[0].ndim != 3:
            other = [f", and item {n} has {kind!r:.300}" for n, kind in enumerate(kinds) if kind != kinds[0]]
            raise ValueError(
                f"{name!r} must have samples (K, T, D) of each window, with one shape and one order of columns; item 0 "
                f"has {kinds[0]!r:.300}{''.join(other[:1])}"
            )
        sequences, starts = (sequences, starts) if keys is None else ((), ())
        return cls(torch.stack(values, 1), keys, columns[0], sequences, starts)

    def arranged(self, axes: str) -> ForecastSamples:
        """Return the samples with their axes in the order (K, N, T, D).

        Args:
            axes: a letter for each axis of the values: k samples, n windows, t steps, d columns, or j and c for groups
                of columns, such as points and their coordinates; 1 for an axis of size 1.

        Raises:
            ValueError: the letters do not match the values.
        """
        values, order = self.values, next((o for o in ORDERS if sorted(o) == sorted(axes.replace("1", ""))), None)
        ones = [place for place, letter in enumerate(axes) if letter == "1"]
        if order is None or len(axes) != values.ndim or any(values.shape[place] > 1 for place in ones):
            raise ValueError(
                f"axes are {axes!r} for an array {tuple(values.shape)}; expected a letter for each axis: k (samples), "
                "n (windows), t (steps), d (columns) or j and c (groups of columns), and 1 for an axis of size 1"
            )
        ordered = tensor_of(values).permute([*ones, *map(axes.index, order)])
        return replace(self, values=ordered.flatten(0, len(ones)).flatten(3))

    def within(self, every: Sequence[Key], chosen: Sequence[Key]) -> ForecastSamples:
        """Return the samples without the windows that are in `every` and not in `chosen`.

        Args:
            every: keys of all windows; without keys, samples of this number of windows are in this order.
            chosen: keys of the windows to keep.
        """
        keys = every if self.keys is None and self.values.shape[1] == len(every) else self.keys
        dropped = {*every} - {*chosen}
        if keys is None or not dropped:
            return self
        dropped |= {("", *key[1:]) for key in dropped}
        places = [place for place, key in enumerate(keys) if key not in dropped]
        return replace(self, values=tensor_of(self.values)[:, places], keys=[keys[place] for place in places])

    def aligned(self, windows: EvaluationWindows, name: str) -> tuple[int, Forecaster]:
        """Return K, and a function from a slice of the windows to their futures (K, B, T, D).

        Args:
            windows: windows of the evaluation.
            name: name of the row, for errors.

        Raises:
            ValueError: a window is missing, unknown or given twice, or shapes, columns or sequences do not match.
        """
        count, horizon, size = windows.futures.shape
        shape, n_given = tuple(self.values.shape), count if self.keys is None else len(self.keys)
        names = column_names(windows.windows)
        if len(shape) != 4 or shape[1:] != (n_given, horizon, size) or not shape[0]:
            hint = ""
            if len(shape) == 4 and shape[2] == windows.x.shape[1]:
                hint = "; give only the steps to predict, without the observed ones"
            elif len(shape) == 4 and any(sorted(shape) == sorted((k, n_given, horizon, size)) for k in shape):
                hint = "; change the order of the axes"
            elif self.columns and len(self.columns) != size:
                hint = f"; its columns are {[*self.columns][:MOST]!r:.500}, not {names[:MOST]!r:.500}"
            raise ValueError(
                f"{name!r} has shape {shape}, expected samples (K, N, T, D) = (K, {n_given}, {horizon}, {size}){hint}"
            )
        for kind, found, expected in (
            ("columns", self.columns, names),
            ("sequences", self.sequences, [sequence for _, sequence, _ in windows.keys]),
        ):
            same = len(found) == len(expected) and all(a in ("", b) for a, b in zip(found, expected, strict=True))
            if found and expected and not same:
                raise ValueError(
                    f"{name!r} has the {kind} {[*found][:MOST]!r:.500}; expected, in this order, "
                    f"{[*expected][:MOST]!r:.500}"
                )
        for ((_, sequence, start), when), ((_, following, later), then) in pairwise(
            zip(windows.keys, () if self.keys else self.starts, strict=False)
        ):
            if sequence != following or None in (when, then) or when == then:
                continue
            if (when < then) != (start < later):
                raise ValueError(
                    f"{name!r} has a forecast from {when} before one from {then} of sequence {sequence!r}; expected "
                    f"the order of the windows, whose first steps are {start} and {later}"
                )
        values = tensor_of(self.values)
        is_real = values.is_floating_point()
        order = torch.arange(count) if self.keys is None else self._order(windows.keys, name)

        def futures(part: slice) -> Tensor:
            chosen = values[:, order[part]]
            return chosen if is_real else chosen.double()  # float32 would round large counts

        return shape[0], futures

    def _order(self, keys: Sequence[Key], name: str) -> Tensor:
        """Return the place in these samples of each window of the evaluation."""
        if len(dict.fromkeys(keys)) < len(keys):
            raise ValueError(
                f"several windows have the same key, such as {keys[0]}, so {name!r} must be an array (K, N, T, D) in "
                "their order"
            )
        given = [*(self.keys or ())]
        if not all(split for split, *_ in given):  # unknown splits
            short = {key[1:]: key for key in keys} if len({key[1:] for key in keys}) == len(keys) else {}
            given = [key if key[0] else short.get(key[1:], key) for key in given]
        missing, other = ([*(Counter(a) - Counter(b))] for a, b in ((keys, given), (given, keys)))
        if missing or other:
            wrong = [("missing", missing), ("unknown or repeated", other)]
            raise ValueError(
                f"{name!r} has forecasts of {len(given)} windows, expected each of the {len(keys)} windows of the "
                "evaluation once, by its key (split, sequence, first step)"
                + "".join(f"; {len(k)} are {kind}, such as {k[:FEW]}" for kind, k in wrong if k)
            )
        places = {key: place for place, key in enumerate(given)}
        return torch.tensor([places[key] for key in keys])

    def outside(self, windows: HeldOutWindows) -> Iterator[str]:
        """Yield a description of the first sample of each column that its family excludes, such as a negative count."""
        values, names = tensor_of(self.values), column_names(windows)
        for place, family in enumerate(getattr(windows, "families", ())):
            spec = FAMILIES[family]
            if not isinstance(spec, Family) or family == "category":  # a category has several columns
                continue
            support: Any = spec.kind.support
            if len(wrong := values[..., place][~support.check(values[..., place])]):
                yield f"{names[place]} has {wrong[0]:g}, but its values are {describe_support(support)}"

    def record(self) -> dict[str, Any]:
        """Return shape and SHA-256 of the samples, for the record of an evaluation."""
        digest = hashlib.sha256()
        values = np.asarray(self.values)
        hash_values(digest, values, values.dtype)
        return {"forecasts": {"shape": [*values.shape], "sha256": digest.hexdigest()}}


def _on_cpu(values: Tensor | np.ndarray) -> Tensor:
    """Return values as a tensor that NumPy can read, without a copy if possible."""
    tensor = tensor_of(values).detach().cpu()
    return tensor.float() if tensor.dtype == torch.bfloat16 else tensor


def _item(item: Any, name: str) -> tuple[Tensor, tuple[str, ...], str, Any]:
    """Return samples (K, T, D) of one window, names of columns, name of the sequence, and first time, if known."""
    if isinstance(item, Tensor | np.ndarray):
        return _on_cpu(item), (), "", None
    if hasattr(item, "all_values"):  # a TimeSeries of darts: (T, D, K)
        columns = tuple(map(str, item.components))
        named = columns != tuple(map(str, range(len(columns))))  # darts' own numbers
        return torch.tensor(np.moveaxis(item.all_values(), -1, 0)), columns if named else (), "", item.start_time()
    if hasattr(item, "samples"):  # a SampleForecast of gluonts: (K, T), or (K, T, D)
        values = torch.tensor(np.asarray(item.samples))
        return (values if values.ndim == 3 else values[..., None]), (), str(item.item_id or ""), item.start_date
    raise TypeError(
        f"{name} is a {type(item).__name__} without samples; give samples (K, T, D), a SampleForecast of gluonts or a "
        "TimeSeries of darts, since means and quantiles do not determine the scores"
    )


def _key(key: Any, name: str) -> Key:
    parts = key if isinstance(key, tuple) else ()
    if len(parts) not in (2, 3) or float(parts[-1]) % 1:
        raise ValueError(f"{name!r} has the key {key!r}; expected (split, sequence, first step) of a window")
    return (str(parts[0]) if len(parts) == 3 else "", str(parts[-2]), int(parts[-1]))


def column_names(windows: HeldOutWindows) -> list[str]:
    """Return the names of the columns of x; empty if they have none."""
    return list(columns_of(windows) or getattr(windows, "columns", None) or ())


def windows_to_forecast(windows: Any, whole: bool = False) -> dict[str, np.ndarray]:
    """Return what other software needs to forecast windows, as arrays for an npz file.

    Args:
        windows: windows of an evaluation, or data with a test split.
        whole: also return the `future` (N, T, D), as for training windows.

    Returns:
        `split`, `sequence` and `start` (N,), the keys of the windows, which a file of forecasts contains too;
        `observed` (N, O, D), NaN where missing; `horizon`, the number of steps T to predict; `columns` (D,), if they
        have names; and `time` (N, O + T) of all steps as text, if they have times.
    """
    held = prepare_windows(windows)
    x, (split, sequence, start) = held.batch.mask_to_nan().numpy(), zip(*held.keys, strict=True)
    arrays: dict[str, Any] = {"split": split, "sequence": sequence, "start": start, "observed": x[:, : held.observed]}
    arrays |= {"horizon": x.shape[1] - held.observed} | (
        {"columns": names} if (names := column_names(held.windows)) else {}
    )
    arrays |= {"future": x[:, held.observed :]} if whole else {}
    if hasattr(held.windows, "times"):
        times, calendar = held.windows.times(x.shape[1])
        if times is not None:
            moments, places = np.unique(times, return_inverse=True)
            arrays["time"] = np.array([calendar.text(moment) for moment in moments])[places.reshape(times.shape)]
    return {name: np.array(value) for name, value in arrays.items()}


def read_samples(path: str | os.PathLike[str], observed: int | None = None, axes: str = "") -> ForecastSamples:
    """Read samples from a file, without unpickling.

    Args:
        path: npz, npy or CSV file.
        observed: number of observed steps of a window, for npz files of tables that `dvae forecast` wrote, which name
            the first step of the future.
        axes: order of the axes in an npz or npy file, as in `ForecastSamples.arranged`; by default kntd or kntjc.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged or too large, or contains no samples.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{file} must end in one of {', '.join(SUFFIXES)}")
    if suffix == ".npy":
        samples = ForecastSamples(mapped(file, links=True))
    with files.open_plain(file, links=True) as content:
        try:
            if suffix == ".npz":
                samples = _of_arrays(npz_arrays(content, LARGEST), observed)
            elif suffix == ".csv":
                samples = _of_table(files.read(file, LARGEST_CSV, links=True))
            if not axes and np.ndim(samples.values) not in map(len, ORDERS):
                raise ValueError(f"samples have shape {np.shape(samples.values)}, expected (K, N, T, D); K may be 1")
            return samples.arranged(axes or ORDERS[np.ndim(samples.values) == 5])
        except (OverflowError, TypeError, ValueError) as error:
            raise ValueError(f"{file}: {str(error)[:500]}") from error


def _of_arrays(arrays: Mapping[str, np.ndarray], observed: int | None) -> ForecastSamples:
    """Return samples from the members of an npz file."""
    if (blend := arrays.get("blend")) is not None and blend.any():
        raise ValueError(
            f"its first {blend} steps are blended with the observed ones, so they are not the model's own forecasts; "
            "write the file without `dvae forecast --blend` to score it"
        )
    values, sequence = (next((arrays[n] for n in names if n in arrays), None) for names in NAMES.values())
    if values is None or values.dtype.kind not in "fiu":
        raise ValueError(
            f"it contains {[*arrays][:MOST]!r:.500}; expected numbers `samples` (K, N, T, D), and the keys of "
            "the windows in `sequence`, `start` and `split`"
        )
    if unknown := sorted(arrays.keys() - {*READ, *UNREAD}):
        raise ValueError(f"it contains {unknown[:MOST]!r:.500}; expected only {', '.join(READ)}")
    start = arrays.get("start")
    if start is None and "step" in arrays:  # the first step of the future
        if observed is None:
            raise ValueError("it names the first step of each future; pass `observed`, or give the first of the window")
        start = arrays["step"] - observed
    keys = None
    given = [name for name in (*NAMES["sequence"], "start", "step", "split") if name in arrays]
    if given and (sequence is None or start is None):
        raise ValueError(
            f"it has the keys {given}; expected both `sequence` and `start`, or no keys if the samples are in the "
            "order of the windows"
        )
    if sequence is not None and start is not None:
        split = arrays.get("split", np.full(len(sequence), ""))
        if start.dtype.kind not in "iu" or not sequence.shape == start.shape == split.shape == (len(sequence),):
            raise ValueError("the keys `sequence`, `start` and `split` must have one entry for each window")
        keys = [(str(a), str(b), int(c)) for a, b, c in zip(split, sequence, start, strict=True)]
    columns = [str(name) for name in arrays.get("columns", ())]
    columns = columns or [f"{joint}_{axis}" for joint in arrays.get("joint_names", ()) for axis in "xyz"]
    return ForecastSamples(values, keys, columns, emission=str(arrays.get("emission", "")))


def _of_table(content: bytes) -> ForecastSamples:
    """Return samples from a CSV file."""
    import pandas as pd

    frame = pd.read_csv(io.BytesIO(content), dtype=str, keep_default_na=False)  # NumPy parses numbers exactly
    if missing := [name for name in AXES if name not in frame]:
        summary = any(name == "mean" or re.fullmatch(r"q\d+", name) for name in frame)
        raise ValueError(
            "it contains means and quantiles, which do not determine the scores; `dvae forecast RUN --out FILE.npz` "
            "writes samples"
            if summary
            else f"it has no column {missing[0]!r}; expected {', '.join(AXES)}, and the columns to score"
        )
    frame = (frame if "split" in frame else frame.assign(split="")).astype(dict.fromkeys(AXES[1:], int))
    if frame.empty:
        raise ValueError("it has no rows; expected one for each window, sample and step")
    window, windows = pd.factorize(pd.MultiIndex.from_frame(frame[["split", "sequence", "start"]]))
    index = [window, frame["sample"], frame["ahead"]]
    table = frame.drop(columns=[*AXES, "split"]).set_index([*map(pd.Index, index)]).sort_index()
    levels = [np.unique(values) for values in index]
    count, k, steps = map(len, levels)
    if not table.index.equals(pd.MultiIndex.from_product([*levels[:2], range(1, steps + 1)])):
        raise ValueError(
            f"it has {len(frame)} rows; expected one for each of {count} windows, {k} samples and {steps} steps, with "
            "`ahead` from 1"
        )
    values = table.replace("", "nan").to_numpy(float).reshape(count, k, steps, -1).swapaxes(0, 1)
    return ForecastSamples(values, [*windows], [*table.columns])
