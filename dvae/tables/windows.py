"""Windows of a panel: training batches, held-out windows for evaluation, or whole sequences of any length."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterator, Sequence
from copy import copy
from functools import cached_property
from itertools import islice
from reprlib import repr as brief
from typing import Any, Literal, Self

import numpy as np
import torch
from torch import Tensor

from ..data.batch import Batch
from ..data.blocks import cut_windows, hash_list, row_blocks
from ..data.sequences import Sequences, columns_of
from ..inference.evaluation.evaluation_windows import seeded_evaluation
from ..options import Count, require
from ..program.model import DynamicalVAE
from .calendar import Calendar
from .encoding import COVARIATES, GAPS, LEVELS_OF_COUNTS, STATICS, PanelSchema, is_whole
from .forecasts import PanelForecasts, PanelImputed
from .panel import Panel
from .protocol import Cut

GROUPED = 8
"""Windows per group in a training batch."""
AT_ONCE = 64
"""Windows that are forecast or imputed at once."""
LOADED = 2**28
"""Largest number of values of training windows, and of whole sequences, that reference forecasts load."""
NAMED = 10
"""Maximum number of sequences without a window that messages name."""


Split = Literal["train", "validation", "test", "train+validation", "all", "last"]


def _require_model(model: Any) -> None:
    if not isinstance(model, torch.nn.Module):
        raise TypeError(f"the model is {brief(model)}; expected a fitted model, such as dvae.load(RUN).model")


class PanelWindows:
    """The windows of one split; a `Source`, and `HeldOutWindows` if forecasts have a horizon.

    Targets are read and encoded when windows are cut; covariates are precomputed in memory.

    Args:
        panel: the sequences.
        schema: columns, cut and units.
        split: "train", "validation", "test" or "train+validation"; "all", or "last" for the end of each sequence.

    Raises:
        ValueError: if the split is unknown or has no windows.
    """

    def __init__(self, panel: Panel, schema: PanelSchema, split: str):
        require(Split, split=split)
        self.panel, self.schema, self.split = panel, schema, split
        self._ranges = schema.cut.starts(panel, split)
        if schema.columns.group:  # windows of a group are drawn together
            self._ranges.sort(key=lambda entry: panel.series[entry[0]].group)
        shortest = schema.cut.length or 1
        spans = schema.cut.spans(panel, split)
        self.skipped = {
            panel.series[index].name: max(high - low, 0) for index, low, high in spans if high - low < shortest
        }
        steps = [panel.present(sequence) for sequence in panel]
        message = (
            f"{panel.name} has no {split} window of {schema.cut.name}; its {len(panel)} sequences have {min(steps)} to "
            f"{max(steps)} steps up to their last targets"
            f"{f', and the share of {split} is 0' if getattr(schema.cut, split, 1) == 0 else ''}"
        )
        if not self._ranges:
            raise ValueError(message)
        if schema.columns.calendar and (panel.calendar.zone is None) != (schema.calendar.zone is None):
            raise ValueError(
                f"the dates of {panel.name} have the zone {panel.calendar.zone}, but the zone of the training data is "
                f"{schema.calendar.zone}; calendar features need both or neither, so name the missing one (--zone)"
            )
        sequences = [panel.series[index] for index, _, _ in self._ranges]
        lengths = torch.tensor([len(sequence) for sequence in sequences])
        self._first = lengths.cumsum(0) - lengths
        self._lengths = torch.tensor([panel.present(sequence) for sequence in sequences])
        self._low, self._last = torch.tensor([ends for _, *ends in self._ranges]).unbind(1)
        self._values = [sequence.values for sequence in sequences]
        last = self._lengths if schema.cut.length is None else self._last + schema.cut.length
        parts = [
            sequence.values[low:end]
            for sequence, low, end in zip(sequences, self._low.tolist(), last.tolist(), strict=True)
        ]
        incomplete = (
            part for sequence, part in zip(sequences, parts, strict=True) if sequence.name not in panel.complete
        )
        self._missing = any(np.isnan(schema.encoded(block)).any() for block in row_blocks(incomplete))
        if unforeseen := schema.unforeseen(parts):
            warnings.warn(
                f"the {split} part of {panel.name} has missing values in {', '.join(unforeseen)}, where training data "
                "have none; they are replaced by the previous value or the mean, and models receive no indicator",
                stacklevel=2,
            )
        self._context = {}
        for name, make in ((COVARIATES, schema.context), (GAPS, schema.gaps)):
            if name in schema.sizes:
                self._context[name] = [make(sequence).astype(np.float32) for sequence in sequences]
        self._static = None
        if STATICS in schema.sizes:
            self._static = torch.from_numpy(np.stack([schema.static(sequence) for sequence in sequences])).float()
        if self._missing and not len(self):
            raise ValueError(f"{message}; left out are {self.left_out}")
        self._weights = (self._last - self._low + 1).double().cumsum(0)

    @property
    def length(self) -> int | None:
        """T, steps of a window; None for whole sequences."""
        return self.schema.cut.length

    @property
    def left_out(self) -> str:
        """Description of omitted sequences, windows and last test steps; empty if none are omitted."""
        parts = [self.too_short] if self.skipped else []
        if self.n_unobserved:
            parts.append(f"{self.n_unobserved} windows without an observed target in their past or future")
        rest = (self._last - self._low) % self._stride
        if self.split == "test" and (count := int(rest.count_nonzero())):
            parts.append(f"up to {int(rest.max())} steps at the end of {count} sequences, fewer than a stride")
        return ", and ".join(parts)

    @property
    def too_short(self) -> str:
        """Names and lengths of the sequences that are too short for a window; empty if none are."""
        examples = [f"{name}: {steps}" for name, steps in islice(self.skipped.items(), NAMED)]
        more = f" and {len(self.skipped) - NAMED} more" if len(self.skipped) > NAMED else ""
        text = f"{len(self.skipped)} sequences with fewer than {self.length} steps in this split"
        return f"{text} ({', '.join(examples)}{more})" if examples else ""

    @property
    def n_unobserved(self) -> int:
        """Number of windows that are not listed because no target was observed in their past or future."""
        return int(self._counts.sum()) - len(self._list_windows()[0])

    @property
    def protocol(self) -> Cut:
        """How the windows are cut."""
        return self.schema.cut

    def __len__(self) -> int:
        return len(self._windows[0])

    def __repr__(self) -> str:
        return f"PanelWindows({self.panel.name} {self.split}: {len(self)} of {self.protocol.name})"

    @property
    def keys(self) -> list[tuple[str, str, int]]:
        """(split, sequence, first step) of the listed windows."""
        return list(self._keys())

    def _keys(self) -> Iterator[tuple[str, str, int]]:
        names = [self.panel.series[index].name for index, _, _ in self._ranges]
        for chunk in zip(*(part.split(4096) for part in self._windows), strict=True):
            yield from (
                (self.split, names[index], start) for index, start in zip(*map(Tensor.tolist, chunk), strict=True)
            )

    @property
    def cluster_keys(self) -> list[tuple[str, str, int]]:
        """Keys by group instead of sequence if the data have groups, since sequences of a group are dependent."""
        if not self.schema.columns.group:
            return self.keys
        groups = [self.panel.series[self._ranges[index][0]].group for index in self._windows[0].tolist()]
        return [(split, group, start) for (split, _, start), group in zip(self.keys, groups, strict=True)]

    @property
    def origins(self) -> Tensor:
        """Times (N, 2) of the last observed and of the last step of each window; numbers of steps without times."""
        observed, steps = self.protocol.observed or 0, self.length or 0
        times, _ = self.times(steps)
        moments = self._windows[1][:, None] + torch.arange(steps) if times is None else torch.from_numpy(times)
        return moments[:, [observed - 1, steps - 1]].double()

    @property
    def description(self) -> dict[str, Any]:
        """Columns with their units, means and scales, stored with results."""
        columns = {name: column.unit for column in self.schema.columns.targets for name in column.coordinates}
        coordinates = self.schema.units["x"]
        entries: dict[str, Any] = {
            "columns": columns,
            "means": [coordinate.mean for coordinate in coordinates],
            "scales": [coordinate.scale for coordinate in coordinates],
            "axis_names": ["group" if self.schema.columns.group else "sequence", "step"],
        }
        entries |= {} if self.protocol.season is None else {"season": self.protocol.season}
        return {**entries, "title": [self.panel.name, self.split]}

    @property
    def usual_season(self) -> int:
        """Usual season of tables with these steps, as `Panel.usual_season`."""
        return self.panel.usual_season

    @property
    def families(self) -> list[str]:
        """Family of each coordinate of x."""
        return [column.family for column in self.schema.columns.targets for _ in column.coordinates]

    @cached_property
    def training(self) -> PanelWindows | None:
        """Training windows of the same panel, evenly thinned if they are many; None if it has none."""
        try:
            windows = PanelWindows(self.panel, self.schema, "train")
        except ValueError:
            return None
        count = min(len(windows), max(LOADED // ((self.length or 1) * self.schema.sizes["x"]), 1))
        return windows.subset(np.linspace(0, len(windows) - 1, count).round().astype(int).tolist())

    def histories(self) -> tuple[Tensor, Tensor, Tensor] | None:
        """Return the targets (S, D) of all sequences, one after another, and the steps that a forecast may use.

        Returns:
            None if the targets are too many to load. Otherwise the targets, NaN where missing; and for each window the
            first step that its forecast may use, and its first future step (N,). With a split by time, the first one is
            the start of the sequence, which training data contain. Otherwise, it is the first observed step.
        """
        if sum(map(len, self._values)) * self.schema.sizes["x"] > LOADED:
            return None
        ranges, starts = self._windows
        values = torch.from_numpy(np.concatenate([self.schema.encoded(values) for values in self._values])).double()
        end = self._first[ranges] + starts + (self.schema.cut.observed or 0)
        by_time = self.schema.cut.split == "time"
        return values, self._first[ranges] if by_time else end - (self.schema.cut.observed or 0), end

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the data, their cut, and the split."""
        schema = {
            name: value
            for name, value in self.schema.config().items()
            if name not in ("calendar", "priors", "preferred")
        }  # these do not affect x
        digest = hashlib.sha256(f"{self.panel.fingerprint()}({schema!r}, {self.split!r}, ".encode())
        hash_list(digest, self._keys())
        digest.update(b")")
        return digest.hexdigest()

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Draw windows with replacement, with equal probability of each start; whole sequences without replacement.

        In a panel with groups, a batch has few groups, with several windows each.

        Args:
            batch_size: B, number of windows.
            generator: random generator on the CPU.

        Returns:
            A batch with "x" (B, T, D), and masks, lengths and covariates if any.
        """
        if self.schema.columns.group:
            return self._cut(*self._sample_groups(batch_size, generator))
        if self.length is None:
            selected = torch.randperm(len(self._ranges), generator=generator)[:batch_size]
            return self._cut(selected, torch.zeros_like(selected))
        u_range, u_start = torch.rand(2, batch_size, dtype=torch.float64, generator=generator)
        indices = torch.searchsorted(self._weights, u_range * self._weights[-1], right=True)
        low, last = self._low[indices], self._last[indices]
        return self._cut(indices, low + (u_start * (last - low + 1)).long())

    def _sample_groups(self, batch_size: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return range and first step of random windows; groups are drawn in proportion to their number of windows."""
        names = [self.panel.series[index].group for index, _, _ in self._ranges]
        cumulative = torch.cat([self._weights.new_zeros(1), self._weights])
        first = torch.tensor([n for n, name in enumerate(names) if n == 0 or names[n - 1] != name])
        start, end = cumulative[first], cumulative[torch.cat([first[1:], torch.tensor([len(names)])])]
        u_group, u_window, u_start = torch.rand(3, batch_size, dtype=torch.float64, generator=generator)
        sampled = torch.searchsorted(end, u_group[: -(-batch_size // GROUPED)] * cumulative[-1], right=True)
        group = sampled.repeat_interleave(GROUPED)[:batch_size]
        positions = start[group] + u_window * (end - start)[group]
        indices = torch.searchsorted(self._weights, positions, right=True)
        low, last = self._low[indices], self._last[indices]
        return indices, low + (u_start * (last - low + 1)).long()

    def subset(self, places: Sequence[int]) -> Self:
        """Return some of the listed windows.

        Args:
            places: indices of the windows to keep.
        """
        selected = copy(self)
        ranges, starts = self._windows
        selected._windows = ranges[list(places)], starts[list(places)]
        return selected

    def all(self) -> Batch:
        """Return the listed windows, in the order of `keys`."""
        return self._cut(*self._windows)

    def batches(self, batch_size: int) -> Iterator[Any]:
        """Return an iterator over batches of the listed windows.

        If sequences are whole or have groups, all windows are loaded into memory first.

        Args:
            batch_size: largest number of windows in a batch.
        """
        if self.length is None or self.schema.columns.group:
            return Sequences(self.all()).batches(batch_size)
        parts = (part.split(batch_size) for part in self._windows)
        return (self._cut(ranges, starts) for ranges, starts in zip(*parts, strict=True))

    def forecast(self, model: DynamicalVAE, samples: int = 100, seed: int = 0) -> PanelForecasts:
        """Draw futures of the listed windows, given their observed steps and known covariates.

        Args:
            model: model fitted to the same schema.
            samples: K, draws of each window.
            seed: random seed of the draws.

        Returns:
            Draws (K, N, H, D), with the past, the truth and times.

        Raises:
            ValueError: if the windows are whole sequences, which have no future.
        """
        _require_model(model)
        require(Count, samples=samples)
        observed, horizon = self.protocol.observed, self.protocol.horizon
        if observed is None or horizon is None:
            raise ValueError(
                "whole sequences have no future; to forecast, cut them into windows with `observed` and `horizon` steps"
            )
        if self.skipped:
            warnings.warn(f"forecasts leave out {self.too_short}", stacklevel=2)
        batch = self.all()
        past, targets = batch.past(observed), batch.mask_to_nan().numpy()
        with seeded_evaluation(model, seed):
            parts = [
                model.forecast(part, horizon, samples, draw_emission=True)["x"].cpu().numpy()
                for part in Sequences(past).batches(AT_ONCE)
            ]
        keys = [(name, start + observed) for _, name, start in self.keys]
        fields = targets[:, :observed], targets[:, observed:], columns_of(self), keys
        return PanelForecasts(np.concatenate(parts, 1, dtype=np.float64), *fields, *self.times(observed + horizon))

    def impute(self, model: DynamicalVAE, samples: int = 100, seed: int = 0, particles: int = 1) -> PanelImputed:
        """Draw the missing targets of the listed windows.

        Args:
            model: model fitted to the same schema.
            samples: K, draws of each window.
            seed: random seed of the draws.
            particles: candidates for each draw, weighted by the observed entries, as in `DynamicalVAE.impute`.

        Returns:
            Draws (K, N, T, D), with the positions of missing values and times.

        Raises:
            ValueError: if no values are missing.
        """
        _require_model(model)
        require(Count, samples=samples, particles=particles)
        batch = self.all()
        if (mask := batch.mask()) is None:
            raise ValueError(f"no target is missing in {self.panel.name}")
        with seeded_evaluation(model, seed):
            parts = [
                model.impute(part, samples, draw=True, particles=particles)["x"].cpu().numpy()
                for part in Sequences(batch).batches(AT_ONCE)
            ]
        count, steps = batch["x"].shape[:2]
        lengths = torch.full((count,), steps) if batch.lengths is None else batch.lengths
        missing = ~mask.numpy() & (np.arange(steps) < lengths[:, None].numpy())[..., None]
        keys = [(name, start) for _, name, start in self.keys]
        draws = np.concatenate(parts, 1, dtype=np.float64)
        return PanelImputed(draws, missing, columns_of(self), keys, *self.times(steps))

    def times(self, steps: int) -> tuple[np.ndarray | None, Calendar]:
        """Return times (N, steps) from the start of each listed window, None without times, and their calendar.

        After the end of a sequence they continue as `Calendar.after` describes.

        Args:
            steps: number of steps.
        """
        calendar = self.panel.calendar
        indices, starts = map(Tensor.tolist, self._windows)
        sequences = [self.panel.series[self._ranges[index][0]] for index in indices]
        moments = [sequence.moments(start, steps, calendar) for sequence, start in zip(sequences, starts, strict=True)]
        available = [values for values in moments if values is not None]
        return (np.stack(available), calendar) if len(available) == len(moments) else (None, calendar)

    @property
    def _stride(self) -> int:
        """Steps between starts of listed windows: the protocol's stride for test windows, otherwise half a horizon."""
        cut = self.schema.cut
        if cut.horizon is None:
            return 1
        return cut.stride or cut.horizon if self.split == "test" else max(cut.horizon // 2, 1)

    @property
    def _counts(self) -> Tensor:
        """Number of listed windows in each range of starts, at the stride `_stride`."""
        return (self._last - self._low) // self._stride + 1

    @cached_property
    def _windows(self) -> tuple[Tensor, Tensor]:
        """Range and first step of each listed window; `some` restricts the list."""
        return self._list_windows()

    def _list_windows(self) -> tuple[Tensor, Tensor]:
        counts = self._counts
        ranges = torch.arange(len(counts)).repeat_interleave(counts)
        number = torch.arange(len(ranges)) - (counts.cumsum(0) - counts)[ranges]
        starts = self._low[ranges] + self._stride * number
        if not self._missing or self.length is None or self.split in ("all", "last"):
            return ranges, starts
        observed = (~np.isnan(self.schema.encoded(block)) for block in row_blocks(self._values))
        is_observed = np.concatenate(
            [mask.all(1) if is_whole(self.schema.columns) else mask.any(1) for mask in observed]
        )
        totals = torch.cat([torch.zeros(1).long(), torch.from_numpy(is_observed).cumsum(0)])
        first = self._first[ranges] + starts
        n_start, n_present, n_end = (
            totals[first],
            totals[first + (self.schema.cut.observed or 0)],
            totals[first + self.length],
        )
        valid = (n_present > n_start) & (n_end > n_present)  # with an observed target in past and future
        return ranges[valid], starts[valid]

    def _cut(self, ranges: Tensor, starts: Tensor) -> Batch:
        """Return the windows that start at these steps of their ranges."""
        lengths = self._lengths[ranges] if self.length is None else self.length
        x = torch.from_numpy(self.schema.encoded(cut_windows(self._values, ranges, starts, lengths).numpy())).double()
        batch = Batch(x=x)
        if isinstance(lengths, Tensor) and (lengths != lengths[0]).any():
            batch["lengths"] = lengths
        if self._missing:
            finite = x.isfinite()
            batch["mask"] = (
                finite.all(-1, keepdim=True).repeat(1, 1, x.shape[-1]) if is_whole(self.schema.columns) else finite
            )
            x.nan_to_num_(0.0)
        if LEVELS_OF_COUNTS in self.schema.sizes:
            batch[LEVELS_OF_COUNTS] = self.schema.levels(batch).float()
        for name, values in self._context.items():
            batch[name] = cut_windows(values, ranges, starts, lengths)
        if COVARIATES in batch and (observed := self.schema.cut.observed) is not None:
            batch[COVARIATES] = carry_forward(batch[COVARIATES], observed, self.schema)
        if self.schema.columns.group:
            batch["group"] = torch.tensor(self._group_ids(ranges.tolist(), starts.tolist()))
        if self._static is not None:
            batch[STATICS] = self._static[ranges]
        return batch

    def _group_ids(self, ranges: list[int], starts: list[int]) -> list[int]:
        """Return the group of each window.

        Outside training, only windows whose last observed steps have the same time share a group.
        Otherwise one window could reveal the future of another.
        """
        observed, group_ids, numbers = self.schema.cut.observed, [], dict[Any, int]()
        for index, start in zip(ranges, starts, strict=True):
            sequence = self.panel.series[self._ranges[index][0]]
            present: Any = None
            if observed is not None and self.split != "train":
                last = start + observed - 1
                present = last if sequence.times is None else sequence.times[last]
            group_ids.append(numbers.setdefault((sequence.group, present), len(numbers)))
        return group_ids


def carry_forward(context: Tensor, observed: int, schema: PanelSchema) -> Tensor:
    """Replace future values of "past" covariates (B, T, C) by their last observed value, and their indicators by 0."""
    values, indicators = schema.ending
    if values:
        context[:, observed:, values] = context[:, observed - 1 : observed, values]
        context[:, observed:, indicators] = 0.0
    return context
