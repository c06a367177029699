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
from ..inference.evaluation.evaluation_windows import on_device_of, seeded_evaluation
from ..options import Count, require
from ..program.model import DynamicalVAE
from .calendar import Calendar
from .encoding import COVARIATES, GAPS, STATICS, PanelSchema, is_whole
from .forecasts import PanelForecasts, PanelImputed
from .panel import Panel
from .protocol import Cut

GROUPED = 8
"""Windows per group in a training batch."""
AT_ONCE = 64
"""Windows that are forecast or imputed at once."""
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
            self._ranges.sort(key=lambda each: panel.series[each[0]].group)
        shortest = schema.cut.length or 1
        cut_from = schema.cut.spans(panel, split)
        self.skipped = {
            panel.series[place].name: max(high - low, 0) for place, low, high in cut_from if high - low < shortest
        }
        steps = [panel.present(one) for one in panel]
        none = (
            f"{panel.name} has no {split} window of {schema.cut.name}; up to their last targets its {len(panel)} "
            f"sequences have {min(steps)} to {max(steps)} steps"
            f"{f', and {split} has a share of 0 of them' if getattr(schema.cut, split, 1) == 0 else ''}"
        )
        if not self._ranges:
            raise ValueError(none)
        some = [panel.series[place] for place, _, _ in self._ranges]
        rows = torch.tensor([len(one) for one in some])
        self._first = rows.cumsum(0) - rows
        self._lengths = torch.tensor([panel.present(one) for one in some])
        self._low, self._last = torch.tensor([ends for _, *ends in self._ranges]).unbind(1)
        self._values = [one.values for one in some]
        last = self._lengths if schema.cut.length is None else self._last + schema.cut.length
        parts = [one.values[low:end] for one, low, end in zip(some, self._low.tolist(), last.tolist(), strict=True)]
        gapped = (part for one, part in zip(some, parts, strict=True) if one.name not in panel.complete)
        self._missing = any(np.isnan(schema.encoded(block)).any() for block in row_blocks(gapped))
        if unforeseen := schema.unforeseen(parts):
            warnings.warn(
                f"the {split} part of {panel.name} has missing values in {', '.join(unforeseen)}, where training data "
                "have none; the last value before, or the mean, replaces them, and models receive no indicator",
                stacklevel=2,
            )
        self._context = {}
        for name, make in ((COVARIATES, schema.context), (GAPS, schema.gaps)):
            if name in schema.sizes:
                self._context[name] = [make(one).astype(np.float32) for one in some]
        self._static = None
        if STATICS in schema.sizes:
            self._static = torch.from_numpy(np.stack([schema.static(one) for one in some])).float()
        if self._missing and not len(self):
            raise ValueError(f"{none}, and left out are {self.left_out}")
        self._weights = (self._last - self._low + 1).double().cumsum(0)

    @property
    def length(self) -> int | None:
        """T, steps of a window; None for whole sequences."""
        return self.schema.cut.length

    @property
    def left_out(self) -> str:
        """Description of omitted sequences and windows; empty if none are omitted."""
        parts = [self.too_short] if self.skipped else []
        if self.n_unobserved:
            parts.append(f"{self.n_unobserved} windows, in whose past or future no target was observed")
        return " and ".join(parts)

    @property
    def too_short(self) -> str:
        """Names and lengths of the sequences that are too short for a window; empty if none are."""
        named = [f"{name}: {steps}" for name, steps in islice(self.skipped.items(), NAMED)]
        more = f" and {len(self.skipped) - NAMED} more" if len(self.skipped) > NAMED else ""
        said = f"{len(self.skipped)} sequences, which have fewer than {self.length} steps there"
        return f"{said} ({', '.join(named)}{more})" if named else ""

    @property
    def n_unobserved(self) -> int:
        """Number of windows that are not listed, since no target was observed in their past or future."""
        return int(self._counts.sum()) - len(self._listed()[0])

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
        names = [self.panel.series[place].name for place, _, _ in self._ranges]
        for some in zip(*(part.split(4096) for part in self._windows), strict=True):
            yield from (
                (self.split, names[place], start) for place, start in zip(*map(Tensor.tolist, some), strict=True)
            )

    @property
    def clusters(self) -> list[tuple[str, str, int]]:
        """Keys by group instead of sequence, if the data have groups, whose sequences are not independent evidence."""
        if not self.schema.columns.group:
            return self.keys
        groups = [self.panel.series[self._ranges[place][0]].group for place in self._windows[0].tolist()]
        return [(split, group, start) for (split, _, start), group in zip(self.keys, groups, strict=True)]

    @property
    def description(self) -> dict[str, Any]:
        """Columns with their units, means and scales, stored with results."""
        columns = {name: column.unit for column in self.schema.columns.targets for name in column.coordinates}
        coordinates = self.schema.units["x"]
        said: dict[str, Any] = {
            "columns": columns,
            "means": [coordinate.mean for coordinate in coordinates],
            "scales": [coordinate.scale for coordinate in coordinates],
            "called": ["group" if self.schema.columns.group else "sequence", "step"],
        }
        said |= {} if self.protocol.season is None else {"season": self.protocol.season}
        return {**said, "title": [self.panel.name, self.split]}

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the data, their cut, and the split."""
        schema = {name: own for name, own in self.schema.config().items() if name != "calendar"}  # does not affect x
        digest = hashlib.sha256(f"{self.panel.fingerprint()}({schema!r}, {self.split!r}, ".encode())
        hash_list(digest, self._keys())
        digest.update(b")")
        return digest.hexdigest()

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Draw windows with replacement, with equal probability of each start; whole sequences without replacement.

        In a panel with groups, a batch has few groups, with several windows each.
        """
        if self.schema.columns.group:
            return self._cut(*self._of_groups(batch_size, generator))
        if self.length is None:
            chosen = torch.randperm(len(self._ranges), generator=generator)[:batch_size]
            return self._cut(chosen, torch.zeros_like(chosen))
        which, where = torch.rand(2, batch_size, dtype=torch.float64, generator=generator)
        found = torch.searchsorted(self._weights, which * self._weights[-1], right=True)
        low, last = self._low[found], self._last[found]
        return self._cut(found, low + (where * (last - low + 1)).long())

    def _of_groups(self, batch_size: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return range and first step of windows of some groups, drawn in proportion to their number of windows."""
        names = [self.panel.series[place].group for place, _, _ in self._ranges]
        below = torch.cat([self._weights.new_zeros(1), self._weights])
        first = torch.tensor([n for n, name in enumerate(names) if n == 0 or names[n - 1] != name])
        start, end = below[first], below[torch.cat([first[1:], torch.tensor([len(names)])])]
        which, among, where = torch.rand(3, batch_size, dtype=torch.float64, generator=generator)
        drawn = torch.searchsorted(end, which[: -(-batch_size // GROUPED)] * below[-1], right=True)
        group = drawn.repeat_interleave(GROUPED)[:batch_size]
        chosen = start[group] + among * (end - start)[group]
        found = torch.searchsorted(self._weights, chosen, right=True)
        low, last = self._low[found], self._last[found]
        return found, low + (where * (last - low + 1)).long()

    def some(self, places: Sequence[int]) -> Self:
        """Return some of the listed windows."""
        found = copy(self)
        which, starts = self._windows
        found._windows = which[list(places)], starts[list(places)]
        return found

    def all(self) -> Batch:
        """Return the listed windows, in the order of `keys`."""
        return self._cut(*self._windows)

    def batches(self, batch_size: int) -> Iterator[Any]:
        """Return an iterator over batches of the listed windows.

        Windows of several lengths or of groups are loaded at once.
        """
        if self.length is None or self.schema.columns.group:
            return Sequences(self.all()).batches(batch_size)
        parts = (part.split(batch_size) for part in self._windows)
        return (self._cut(which, starts) for which, starts in zip(*parts, strict=True))

    def forecast(self, model: DynamicalVAE, samples: int = 100, seed: int = 0) -> PanelForecasts:
        """Draw futures of the listed windows, given their observed steps and known covariates.

        Args:
            model: model fitted to the same schema.
            samples: K, draws of each window.
            seed: random seed of the draws.

        Raises:
            ValueError: if the windows are whole sequences, which have no future.
        """
        _require_model(model)
        require(Count, samples=samples)
        observed, horizon = self.protocol.observed, self.protocol.horizon
        if observed is None or horizon is None:
            raise ValueError("whole sequences have no future; cut them, with observed and horizon steps, to forecast")
        if self.skipped:
            warnings.warn(f"forecasts leave out {self.too_short}", stacklevel=2)
        batch = self.all()
        past, known = batch.past(observed), batch.mask_to_nan().numpy()
        with seeded_evaluation(model, seed):
            parts = [
                model.forecast(on_device_of(model, part), horizon, samples, draw_emission=True)["x"].cpu().numpy()
                for part in Sequences(past).batches(AT_ONCE)
            ]
        keys = [(name, start + observed) for _, name, start in self.keys]
        beside = known[:, :observed], known[:, observed:], columns_of(self), keys
        return PanelForecasts(np.concatenate(parts, 1, dtype=np.float64), *beside, *self.times(observed + horizon))

    def impute(self, model: DynamicalVAE, samples: int = 100, seed: int = 0, particles: int = 1) -> PanelImputed:
        """Draw the missing targets of the listed windows.

        Args:
            model: model fitted to the same schema.
            samples: K, draws of each window.
            seed: random seed of the draws.
            particles: candidates for each draw, weighted by the observed entries, as in `DynamicalVAE.impute`.

        Raises:
            ValueError: if no values are missing.
        """
        _require_model(model)
        require(Count, samples=samples, particles=particles)
        batch = self.all()
        if (mask := batch.mask()) is None:
            raise ValueError(f"nothing is missing in {self.panel.name}")
        with seeded_evaluation(model, seed):
            parts = [
                model.impute(on_device_of(model, part), samples, draw=True, particles=particles)["x"].cpu().numpy()
                for part in Sequences(batch).batches(AT_ONCE)
            ]
        count, steps = batch["x"].shape[:2]
        lengths = torch.full((count,), steps) if batch.lengths is None else batch.lengths
        lacking = ~mask.numpy() & (np.arange(steps) < lengths[:, None].numpy())[..., None]
        keys = [(name, start) for _, name, start in self.keys]
        draws = np.concatenate(parts, 1, dtype=np.float64)
        return PanelImputed(draws, lacking, columns_of(self), keys, *self.times(steps))

    def times(self, steps: int) -> tuple[np.ndarray | None, Calendar]:
        """Return times (N, steps) from the start of each listed window, None without times, and their calendar.

        After the end of a sequence they continue as `Calendar.after` describes.
        """
        calendar = self.panel.calendar
        places, starts = map(Tensor.tolist, self._windows)
        listed = [self.panel.series[self._ranges[place][0]] for place in places]
        found = [one.moments(start, steps, calendar) for one, start in zip(listed, starts, strict=True)]
        known = [own for own in found if own is not None]
        return (np.stack(known), calendar) if len(known) == len(found) else (None, calendar)

    @property
    def _stride(self) -> int:
        """Steps between listed windows: as the protocol defines for test windows, else half a horizon."""
        how = self.schema.cut
        if how.horizon is None:
            return 1
        return how.stride or how.horizon if self.split == "test" else max(how.horizon // 2, 1)

    @property
    def _counts(self) -> Tensor:
        """Number of windows in each range, at this stride."""
        return (self._last - self._low) // self._stride + 1

    @cached_property
    def _windows(self) -> tuple[Tensor, Tensor]:
        """Range and first step of the listed windows; all of them, or `some`."""
        return self._listed()

    def _listed(self) -> tuple[Tensor, Tensor]:
        counts = self._counts
        which = torch.arange(len(counts)).repeat_interleave(counts)
        place = torch.arange(len(which)) - (counts.cumsum(0) - counts)[which]
        starts = self._low[which] + self._stride * place
        if not self._missing or self.length is None or self.split in ("all", "last"):
            return which, starts
        seen = (~np.isnan(self.schema.encoded(block)) for block in row_blocks(self._values))
        some = np.concatenate([each.all(1) if is_whole(self.schema.columns) else each.any(1) for each in seen])
        known = torch.cat([torch.zeros(1).long(), torch.from_numpy(some).cumsum(0)])
        first = self._first[which] + starts
        start, now, end = known[first], known[first + (self.schema.cut.observed or 0)], known[first + self.length]
        told = (now > start) & (end > now)  # with an observed target in past and future
        return which[told], starts[told]

    def _cut(self, which: Tensor, starts: Tensor) -> Batch:
        """Return the windows that start at these steps of their ranges."""
        lengths = self._lengths[which] if self.length is None else self.length
        x = torch.from_numpy(self.schema.encoded(cut_windows(self._values, which, starts, lengths).numpy())).double()
        batch = Batch(x=x)
        if isinstance(lengths, Tensor) and (lengths != lengths[0]).any():
            batch["lengths"] = lengths
        if self._missing:
            seen = x.isfinite()
            batch["mask"] = (
                seen.all(-1, keepdim=True).repeat(1, 1, x.shape[-1]) if is_whole(self.schema.columns) else seen
            )
            x.nan_to_num_(0.0)
        for name, values in self._context.items():
            batch[name] = cut_windows(values, which, starts, lengths)
        if COVARIATES in batch and (observed := self.schema.cut.observed) is not None:
            batch[COVARIATES] = carry_forward(batch[COVARIATES], observed, self.schema)
        if self.schema.columns.group:
            batch["group"] = torch.tensor(self._grouped(which.tolist(), starts.tolist()))
        if self._static is not None:
            batch[STATICS] = self._static[which]
        return batch

    def _grouped(self, which: list[int], starts: list[int]) -> list[int]:
        """Return the group of each window.

        Outside training, only windows with the same present share a group. Otherwise one window could reveal the future
        of another.
        """
        observed, found, known = self.schema.cut.observed, [], dict[Any, int]()
        for place, start in zip(which, starts, strict=True):
            one = self.panel.series[self._ranges[place][0]]
            present: Any = None
            if observed is not None and self.split != "train":
                last = start + observed - 1
                present = last if one.times is None else one.times[last]
            found.append(known.setdefault((one.group, present), len(known)))
        return found


def carry_forward(context: Tensor, observed: int, schema: PanelSchema) -> Tensor:
    """Return covariates (B, T, C) as known at the present: those of role "past" repeat their last value."""
    values, indicators = schema.ending
    if values:
        context[:, observed:, values] = context[:, observed - 1 : observed, values]
        context[:, observed:, indicators] = 0.0
    return context
