"""Models on held-out windows: windows prepared once for all models, and each model run under the same conditions."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from ...data.batch import Batch
from ...data.sequences import HeldOutWindows, axis_names, clusters, held_out_windows
from ...locking import seeded
from ...program.conditional import evaluating
from ...program.model import DynamicalVAE


@dataclass(frozen=True)
class EvaluationWindows:
    """Windows of one evaluation.

    Args:
        windows: source of the windows.
        batch: batch of all windows.
        observed: O, number of observed frames.
        keys: (split, clip, first frame) of each window.
    """

    windows: HeldOutWindows
    batch: Batch
    observed: int
    keys: list[tuple[str, str, int]]

    @property
    def x(self) -> Tensor:
        """Whole windows `(N, T, D)`."""
        return self.batch["x"]

    @property
    def futures(self) -> Tensor:
        """Frames to predict `(N, H, D)`, NaN where they were not observed."""
        return self.batch.mask_to_nan()[:, self.observed :]

    @property
    def mask(self) -> Tensor | None:
        """Mask `(N, T, D)`, True where x was observed; None if all of it was."""
        return self.batch.mask()

    def part(self, part: slice) -> Batch:
        """Return some windows, past and future."""
        return self.batch.rows(part)

    def past(self, part: slice) -> Batch:
        """Return the input of forecasts for some windows: x `(B, O, D)`, as in `Batch.past`."""
        return self.part(part).past(self.observed)

    @property
    def clips(self) -> dict[str, int]:
        """Number of windows by clip, `{"split/clip": number}`."""
        return dict(Counter(f"{split}/{clip}" for split, clip, _ in clusters(self.windows)))

    @property
    def places(self) -> Tensor:
        """Index of the clip of every window in `clips`, `(N,)`."""
        return clip_index(clusters(self.windows))

    def description(self) -> dict[str, Any]:
        """Return the description of the data, for the result."""
        count, frames, coordinates = self.x.shape
        found = {"fingerprint": self.windows.fingerprint, "windows": count, "frames": frames}
        return {**found, "coordinates": coordinates, **self._shares, **self.windows.description}

    @property
    def notes(self) -> list[str]:
        """Note on missing values, if there are any."""
        return [
            f"observed are {seen['past']:.1%} of the numbers before the present and {seen['future']:.1%} of those "
            "after it; scores compare with these alone"
            for seen in self._shares.values()
        ]

    @property
    def _shares(self) -> dict[str, dict[str, float]]:
        if self.mask is None:
            return {}
        past, future = self.mask[:, : self.observed], self.mask[:, self.observed :]
        return {"seen": {"past": past.double().mean().item(), "future": future.double().mean().item()}}


def prepare_windows(data: Any) -> EvaluationWindows:
    """Prepare windows for evaluation; for data with parts, use the test split.

    Raises:
        TypeError: when the data do not define which steps are observed.
        ValueError: when the data are whole sequences, or windows are ragged or have no step to observe or to predict.
    """
    windows = held_out_windows(data)
    batch = Batch(windows.all())
    observed = windows.protocol.observed
    if observed is None:
        raise ValueError(
            "whole sequences have no future; cut them, with observed and horizon steps, to forecast; compare() "
            "compares bounds of whole ones"
        )
    if batch.lengths is not None:
        raise ValueError("evaluation needs windows of one length, but these have lengths")
    if not 1 <= observed < batch["x"].shape[1]:
        raise ValueError(
            f"windows of {batch['x'].shape[1]} frames, {observed} of them observed, have no frame to "
            "observe or no frame to predict"
        )
    held = EvaluationWindows(windows, batch, observed, list(windows.keys))
    if held.mask is not None:
        for what, mask in (("past", held.mask[:, :observed]), ("future", held.mask[:, observed:])):
            if (empty := ~mask.flatten(1).any(1)).any():
                split, name, start = held.keys[int(empty.nonzero()[0])]
                _, frame = axis_names(windows.description)
                raise ValueError(
                    f"the {what} of the window at {frame} {start} of {name!r} has no observation "
                    f"({split}); leave it out"
                )
    return held


def clip_index(keys: Sequence[tuple[str, str, int]]) -> Tensor:
    """Return the clip of every window as an index `(N,)`; clips are numbered in order of appearance."""
    order: dict[str, int] = {}
    return torch.tensor([order.setdefault(f"{split}/{clip}", len(order)) for split, clip, _ in keys])


@contextmanager
def seeded_evaluation(model: nn.Module, seed: int) -> Iterator[None]:
    """Use evaluation mode, no gradients and draws from `seed`; restore mode and random state afterwards."""
    with seeded(seed, next(model.parameters()).device), evaluating(model), torch.no_grad():
        yield


def on_device_of(model: nn.Module, batch: Mapping[str, Any]) -> Batch:
    """Return the batch on the device of the model; a model that does not read batches also gets its floating type."""
    parameter = next(model.parameters())
    reads = isinstance(model, DynamicalVAE)  # a DynamicalVAE subtracts means before it rounds

    def moved(value: Tensor) -> Tensor:
        return value.to(parameter.device) if reads or not value.is_floating_point() else value.to(parameter)

    return Batch(batch).map(moved)


def refuse_non_finite(name: str, what: str, finite: Tensor, keys: Sequence[tuple[str, str, int]]) -> None:
    """Raise FloatingPointError for the first window whose entry in `finite` (B,) is False."""
    if not finite.all():
        split, clip, start = keys[int(finite.logical_not().nonzero()[0])]
        raise FloatingPointError(
            f"the {what} of {name} is not finite for the window at frame {start} of clip {clip!r} ({split}); "
            "it cannot be left out, since all methods are scored on the same ones"
        )
