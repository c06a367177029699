"""Splits of sequences, and how they are cut into windows."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..options import Delay, Frames, Share, check
from .panel import Panel


@dataclass(frozen=True)
class Cut:
    """How sequences are split and cut into windows for training, validation and test.

    Args:
        observed: O, observed steps of a forecast; None for whole sequences, which have bounds but no forecasts.
        horizon: H, steps to forecast.
        stride: steps between the starts of test windows; None for the horizon, which forecasts no step twice.
        split: unit of the split: "sequence" for whole sequences, "time" for the last steps of every sequence, "group"
            for all sequences of a group. If the data define the split of each sequence, it is used instead.
        validation: share for validation.
        test: share for test; or, for a split by time, the number of last steps, at least 1. Sequences with dates then
            share the time at which the test begins, if they share most of their times; otherwise the steps are counted
            from the end of each sequence. `validation` is a share of the steps before.
        seed: random seed of the split by sequence or group.
        season: period of the data in steps, such as 7 for daily data with a weekly period; the reference forecast
            "seasonal" repeats it.

    Raises:
        ValueError: if only one of `observed` and `horizon` is given, `split` is "time" without them, the season exceeds
            `observed`, or no share remains for training.
    """

    observed: Frames | None = None
    horizon: Frames | None = None
    stride: Frames | None = None
    split: Literal["sequence", "time", "group"] = "sequence"
    validation: Share = 0.1
    test: Share | Frames = 0.2
    seed: Delay = 0
    season: Frames | None = None

    def __post_init__(self) -> None:
        check(self)
        if (self.observed is None) != (self.horizon is None):
            raise ValueError(f"observed is {self.observed} and horizon {self.horizon}; give both, or neither")
        if self.split == "time" and self.observed is None:
            raise ValueError('split="time" needs windows; give the numbers of steps as observed and horizon')
        if self.season is not None and self.season > (self.observed or 0):
            raise ValueError(
                f"season is {self.season} and observed {self.observed}; season must be at most observed; shorten the "
                "season, or observe more steps"
            )
        if self.test_steps and self.split != "time":
            raise ValueError(
                f"test is {self.test} steps and split {self.split!r}; give a share below 1, or split by time: "
                'split="time"'
            )
        if self.validation + (0 if self.test_steps else self.test) >= 1:
            raise ValueError(
                f"validation is {self.validation} and test {self.test}; their sum must be below 1, so that data remain "
                "for training"
            )

    @property
    def length(self) -> int | None:
        """T, steps of a window."""
        return None if self.observed is None or self.horizon is None else self.observed + self.horizon

    @property
    def test_steps(self) -> int:
        """Number of test steps at the end of the data; 0 if `test` is a share."""
        return int(self.test) if isinstance(self.test, int) else 0

    @property
    def name(self) -> str:
        """Name for titles."""
        return "whole sequences" if self.length is None else f"{self.observed} + {self.horizon} steps"

    def starts(self, panel: Panel, split: str) -> list[tuple[int, int, int]]:
        """Return (sequence, first start, last start) of the windows of a split, or (sequence, 0, 0) of whole sequences.

        With a split by time, a window belongs to the split of its future; its observed steps may lie earlier. "all"
        includes all sequences regardless of their split. "last" is the end of each sequence, including rows without
        targets.

        Args:
            panel: the sequences.
            split: "train", "validation" or "test", several joined by "+", or "all" or "last".

        Raises:
            ValueError: only some sequences state their split, groups are missing, or there are too few sequences to
                split.
        """
        windows = []
        for index, low, high in self.spans(panel, split):
            if self.length is None:
                windows += [(index, 0, 0)] if high else []
            elif high - low >= self.length:
                windows.append((index, high - self.length if split == "last" else low, high - self.length))
        return windows

    def spans(self, panel: Panel, split: str) -> list[tuple[int, int, int]]:
        """Return (sequence, first step, end) of the steps of a split, even if they are too short for a window.

        Args:
            panel: the sequences.
            split: "train", "validation" or "test", several joined by "+", or "all" or "last".

        Raises:
            ValueError: only some sequences state their split, groups are missing, or there are too few sequences to
                split.
        """
        spans = []
        everywhere = split in ("all", "last")
        begin = begin_of(panel, self.test_steps) if self.test_steps and not everywhere else None
        parts = None if self.split == "time" or everywhere else self._parts(panel)
        for index, sequence in enumerate(panel.series):
            low, high = 0, len(sequence) if split == "last" else panel.present(sequence)
            if parts is not None and parts[index] not in split.split("+"):
                continue
            if parts is None and not everywhere:
                second = high - self.test_steps if self.test_steps else round(high * (1 - self.test))
                if begin is not None and sequence.times is not None:
                    second = int(np.searchsorted(sequence.times[:high], begin))
                low, high = self._between(high, second, split)
            spans.append((index, low, high))
        return spans

    def _between(self, total: int, second: int, split: str) -> tuple[int, int]:
        """Return first step and end of a split by time, for a sequence of this length and first test step."""
        assert self.observed is not None
        share = (1 - self.validation) * second if self.test_steps else total * (1 - (self.validation + self.test))
        first = round(share)
        bounds = {"train": (0, first), "validation": (first - self.observed, second)}
        bounds |= {"test": (second - self.observed, total), "train+validation": (0, second)}
        low, high = bounds[split]
        return max(low, 0), high

    def _parts(self, panel: Panel) -> list[str]:
        """Return the split of every sequence."""
        units = [sequence.group if self.split == "group" else sequence.name for sequence in panel.series]
        splits = {unit: sequence.split for unit, sequence in zip(units, panel.series, strict=True) if sequence.split}
        if splits and len({sequence.split == "" for sequence in panel.series}) > 1:
            unassigned = next(sequence.name for sequence in panel.series if not sequence.split)
            raise ValueError(
                f"some sequences of {panel.name} state their split ({', '.join(sorted(set(splits.values())))}), but "
                f"others, such as {unassigned!r}, do not; give it for all, or for none"
            )
        if splits:
            return [sequence.split for sequence in panel.series]
        if self.split == "group" and not any(units):
            raise ValueError(
                f'split="group" needs groups, but no column of {panel.name} has the role group; name one, such as '
                'group="region", or --group region'
            )
        names = sorted(dict.fromkeys(units), key=lambda name: hashlib.sha256(f"{self.seed} {name}".encode()).digest())
        test, validation = (int(np.ceil(share * len(names))) for share in (self.test, self.validation))
        if len(names) < 3:
            raise ValueError(
                f"{panel.name} has {len(names)} {self.split}s, too few for separate training, validation and test "
                "sets; "
                'divide them by time: split="time", with observed and horizon'
            )
        parts = ["test"] * test + ["validation"] * validation + ["train"] * len(names)
        part_of = dict(zip(names, parts, strict=False))
        return [part_of[unit] for unit in units]


def begin_of(panel: Panel, steps: int) -> float | None:
    """Return the time at which the last steps of a panel begin; None if its sequences share no calendar.

    They share one if they have dates, and all their different dates are at most twice as many as those of one sequence.

    Args:
        panel: the sequences.
        steps: number of steps at the end, counted in the sequence that ends last.
    """
    times = [sequence.times[: panel.present(sequence)] for sequence in panel if sequence.times is not None]
    if panel.calendar.kind != "dates" or len(times) < len(panel):
        return None
    if len(np.unique(np.concatenate(times))) > 2 * max(map(len, times)):
        return None
    last = max((one for one in times if len(one)), key=lambda one: (one[-1], len(one)))
    return float(last[max(len(last) - steps, 0)])
