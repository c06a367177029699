"""Windows of a panel: training batches, and held-out windows to be judged on; or whole sequences of any length."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..program.groups import GROUP
from .encoding import COVARIATES, GAPS, STATICS, PanelSchema, whole
from .panel import Panel
from .protocol import Cut

GROUPED = 8
"""Windows of a group in a batch for training."""


class PanelWindows:
    """The windows of one split; a `Source`, and `HeldOutWindows` where forecasts have a horizon.

    Args:
        panel: the sequences.
        schema: what models see of them.
        split: "train", "validation", "test" or "train+validation".

    Raises:
        ValueError: a split without windows.
    """

    def __init__(self, panel: Panel, schema: PanelSchema, split: str):
        self.panel, self.schema, self.split = panel, schema, split
        self._ranges = schema.cut.starts(panel, split)
        self.skipped = (
            [] if schema.cut.length is None else [one.name for one in panel.series if len(one) < schema.cut.length]
        )
        if not self._ranges:
            raise ValueError(
                f"{panel.name} has no {split} window of {schema.cut.name}; its {len(panel)} sequences have "
                f"{min(map(len, panel.series))} to {max(map(len, panel.series))} steps"
            )
        used = sorted({place for place, _, _ in self._ranges})
        lengths = torch.tensor([len(panel.series[place]) for place in used])
        self._lengths = dict(zip(used, lengths.tolist(), strict=True))
        self._first = dict(zip(used, (lengths.cumsum(0) - lengths).tolist(), strict=True))
        some = [panel.series[place] for place in used]
        self._x = _joined([schema.targets(one) for one in some])
        self._mask = self._x.isfinite()
        if whole(schema.columns):
            self._mask = self._mask.all(-1, keepdim=True).expand_as(self._x)
        self._missing = not bool(self._mask.all())
        self._x = self._x.nan_to_num(0.0)
        self._context = {}
        for name, make in ((COVARIATES, schema.context), (GAPS, schema.gaps)):
            if name in schema.sizes:
                self._context[name] = _joined([make(one) for one in some])
        self._static = None
        if STATICS in schema.sizes:
            self._static = dict(zip(used, (torch.as_tensor(schema.static(one)).float() for one in some), strict=True))
        if schema.columns.group:
            self._ranges.sort(key=lambda each: panel.series[each[0]].group)
        counts = torch.tensor([last - low + 1 for _, low, last in self._ranges], dtype=torch.float64)
        self._weights = counts.cumsum(0)

    @property
    def length(self) -> int | None:
        """T, steps of a window; None of whole sequences."""
        return self.schema.cut.length

    @property
    def protocol(self) -> Cut:
        """How they are cut."""
        return self.schema.cut

    def __len__(self) -> int:
        return len(self._listed())

    def __repr__(self) -> str:
        return f"PanelWindows({self.panel.name} {self.split}: {len(self)} of {self.protocol.name})"

    @property
    def keys(self) -> list[tuple[str, str, int]]:
        """(split, sequence, first step) of the listed windows."""
        return [(self.split, self.panel.series[place].name, start) for place, start in self._listed()]

    @property
    def description(self) -> dict[str, Any]:
        """Columns with their units, for the record."""
        columns = {name: column.unit for column in self.schema.columns.targets for name in column.coordinates}
        return {"columns": columns, "title": [self.panel.name, self.split]}

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the data, how they are cut, and which part these windows are."""
        said = repr((self.schema.config(), self.split, self.keys))
        return hashlib.sha256((self.panel.fingerprint() + said).encode()).hexdigest()

    def sample(self, batch_size: int, generator: torch.Generator) -> dict[str, Any]:
        """Windows drawn with replacement, every start alike; of whole sequences, different ones.

        In a panel with groups they are of so few groups that each has several.
        """
        if self.schema.columns.group:
            return self._cut(self._of_groups(batch_size, generator))
        if self.length is None:
            chosen = torch.randperm(len(self._ranges), generator=generator)[:batch_size].tolist()
            return self._cut([(self._ranges[n][0], 0) for n in chosen])
        which, where = torch.rand(2, batch_size, dtype=torch.float64, generator=generator)
        found = torch.searchsorted(self._weights, which * self._weights[-1], right=True).tolist()
        drawn = zip(found, where.tolist(), strict=True)
        starts = [self._ranges[n][1] + int(w * (self._ranges[n][2] - self._ranges[n][1] + 1)) for n, w in drawn]
        return self._cut([(self._ranges[n][0], start) for n, start in zip(found, starts, strict=True)])

    def _of_groups(self, batch_size: int, generator: torch.Generator) -> list[tuple[int, int]]:
        """Windows of some groups, drawn as often as they have windows."""
        names = [self.panel.series[place].group for place, _, _ in self._ranges]
        below = torch.cat([self._weights.new_zeros(1), self._weights])
        first = torch.tensor([n for n, name in enumerate(names) if n == 0 or names[n - 1] != name])
        bounds = torch.stack([below[first], below[torch.cat([first[1:], torch.tensor([len(names)])])]], 1)
        count = -(-batch_size // GROUPED)
        which, where, start = torch.rand(3, batch_size, dtype=torch.float64, generator=generator)
        drawn = torch.searchsorted(bounds[:, 1].contiguous(), which[:count] * below[-1], right=True)
        low, high = bounds[drawn.repeat_interleave(GROUPED)[:batch_size]].unbind(1)
        found = torch.searchsorted(self._weights, low + where * (high - low), right=True).tolist()
        ranges = [self._ranges[n] for n in found]
        starts = (int(low + s * (last - low + 1)) for (_, low, last), s in zip(ranges, start.tolist(), strict=True))
        return [(place, each) for (place, _, _), each in zip(ranges, starts, strict=True)]

    def all(self) -> dict[str, Any]:
        """The listed windows, as `keys` has them."""
        return self._cut(self._listed())

    def times(self, horizon: int) -> tuple[np.ndarray, bool] | None:
        """Times (N, O + horizon) of the listed windows, and whether they are dates; None where rows have none.

        Behind the end of a sequence they are as far apart as the last two.
        """
        observed = self.protocol.observed or 0
        found = []
        for place, start in self._listed():
            one = self.panel.series[place]
            if one.times is None:
                return None
            own = one.times[start : start + observed + horizon]
            step = own[-1] - own[-2] if len(own) > 1 else 1.0
            found.append(np.concatenate([own, own[-1] + step * np.arange(1, observed + horizon - len(own) + 1)]))
        return np.stack(found), self.panel.dates

    def _listed(self) -> list[tuple[int, int]]:
        """(sequence, first step): test windows so far apart as the protocol says, all others by half a horizon."""
        cut = self.schema.cut
        if cut.length is None:
            return [(place, 0) for place, _, _ in self._ranges]
        assert cut.horizon is not None
        stride = cut.stride or cut.horizon if self.split == "test" else max(cut.horizon // 2, 1)
        return [(place, start) for place, low, last in self._ranges for start in range(low, last + 1, stride)]

    def _cut(self, windows: list[tuple[int, int]]) -> dict[str, Any]:
        sizes = [self._lengths[place] if self.length is None else self.length for place, _ in windows]
        longest = max(sizes)
        first = torch.tensor([self._first[place] + start for place, start in windows])
        lengths = torch.tensor(sizes)
        steps = torch.minimum(torch.arange(longest), lengths[:, None] - 1)  # padding repeats the last step
        rows = first[:, None] + steps
        batch: dict[str, Any] = {"x": self._x[rows]}
        if len(set(sizes)) > 1:
            batch["lengths"] = lengths
        if self._missing:
            batch["mask"] = self._mask[rows]
        for name, values in self._context.items():
            batch[name] = values[rows]
        if GAPS in batch:
            begins = torch.tensor([start == 0 for _, start in windows])
            batch[GAPS][begins, 0] = 1.0
        if COVARIATES in batch and (observed := self.schema.cut.observed) is not None:
            batch[COVARIATES] = held(batch[COVARIATES], observed, self.schema)
        if self.schema.columns.group:
            batch[GROUP] = torch.tensor(self._grouped(windows))
        if self._static is not None:
            batch[STATICS] = torch.stack([self._static[place] for place, _ in windows])
        return batch

    def _grouped(self, windows: list[tuple[int, int]]) -> list[int]:
        """The group of each window: with those that have the same present, or one would tell another's future."""
        observed, found, known = self.schema.cut.observed, [], dict[Any, int]()
        for place, start in windows:
            one = self.panel.series[place]
            present: Any = None
            if observed is not None and self.split != "train":
                last = start + observed - 1
                present = last if one.times is None else one.times[last]
            found.append(known.setdefault((one.group, present), len(known)))
        return found


def held(context: Tensor, observed: int, schema: PanelSchema) -> Tensor:
    """Covariates (B, T, C) as they are known at the present: those that end with it keep their last value."""
    values, indicators = schema.ending
    if values:
        context[:, observed:, values] = context[:, observed - 1 : observed, values]
        context[:, observed:, indicators] = 0.0
    return context


def _joined(parts: list[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.concatenate(parts)).float()
