"""Models on held-out windows: windows prepared once for all models, and each model run under the same conditions."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from ...data.batch import Batch
from ...data.sequences import HeldOutWindows, called, clusters, held_out_windows
from ...program.conditional import evaluating
from ...program.model import DynamicalVAE
from ...turns import seeded


@dataclass(frozen=True)
class Held:
    """The windows of one evaluation.

    Args:
        windows: where they come from.
        batch: all of them.
        observed: frames that are seen, O.
        keys: (split, clip, first frame) of each.
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
        """The frames to predict `(N, H, D)`, NaN where they were not observed."""
        return self.batch.mask_to_nan()[:, self.observed :]

    @property
    def mask(self) -> Tensor | None:
        """`(N, T, D)`, True where x was observed; None where all of it was."""
        return self.batch.mask()

    def part(self, part: slice) -> Batch:
        """Some windows, whole."""
        return self.batch.rows(part)

    def past(self, part: slice) -> Batch:
        """Some windows as forecasts see them: x `(B, O, D)`, see `Batch.past`."""
        return self.part(part).past(self.observed)

    @property
    def clips(self) -> dict[str, int]:
        """{"split/clip": number of its windows}."""
        return dict(Counter(f"{split}/{clip}" for split, clip, _ in clusters(self.windows)))

    @property
    def places(self) -> Tensor:
        """`(N,)`, the clip of every window, as its place in `clips`."""
        return clip_places(clusters(self.windows))

    def description(self) -> dict[str, Any]:
        """Of the data, for the record."""
        count, frames, coordinates = self.x.shape
        found = {"fingerprint": self.windows.fingerprint, "windows": count, "frames": frames}
        return {**found, "coordinates": coordinates, **self._shares, **self.windows.description}

    @property
    def notes(self) -> list[str]:
        """A line on what is missing, if something is."""
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


def hold(data: Any) -> Held:
    """Prepare windows; of data with parts, those of the test split.

    Raises:
        TypeError: data that do not say which steps are observed.
        ValueError: whole sequences; windows that are ragged, or leave nothing to observe or to predict.
    """
    windows = held_out_windows(data)
    batch = Batch(windows.all())
    observed = windows.protocol.observed
    if observed is None:
        raise ValueError(
            "whole sequences have no future; cut them, with observed and horizon steps, to forecast; compare compares "
            "bounds of whole ones"
        )
    if batch.lengths is not None:
        raise ValueError("evaluation needs windows of one length, but these have lengths")
    if not 1 <= observed < batch["x"].shape[1]:
        raise ValueError(
            f"windows of {batch['x'].shape[1]} frames, {observed} of them observed, leave nothing to "
            "observe or nothing to predict"
        )
    held = Held(windows, batch, observed, list(windows.keys))
    if held.mask is not None:
        for what, mask in (("past", held.mask[:, :observed]), ("future", held.mask[:, observed:])):
            if (empty := ~mask.flatten(1).any(1)).any():
                split, name, start = held.keys[int(empty.nonzero()[0])]
                _, frame = called(windows.description)
                raise ValueError(
                    f"nothing was observed in the {what} of the window at {frame} {start} of {name!r} "
                    f"({split}); leave it out"
                )
    return held


def clip_places(keys: Sequence[tuple[str, str, int]]) -> Tensor:
    """`(N,)`, the clip of every window, clips numbered as they come."""
    order: dict[str, int] = {}
    return torch.tensor([order.setdefault(f"{split}/{clip}", len(order)) for split, clip, _ in keys])


@contextmanager
def reproducibly(model: nn.Module, seed: int) -> Iterator[None]:
    """Evaluation mode, no gradients and draws from `seed`; mode and random state are restored."""
    with seeded(seed, next(model.parameters()).device), evaluating(model), torch.no_grad():
        yield


def on_device_of(model: nn.Module, batch: Mapping[str, Any]) -> Batch:
    """The batch on the device of the model, and in its floating type where it does not read batches by itself."""
    parameter = next(model.parameters())
    reads = isinstance(model, DynamicalVAE)  # and takes means off before it rounds

    def moved(value: Tensor) -> Tensor:
        return value.to(parameter.device) if reads or not value.is_floating_point() else value.to(parameter)

    return Batch(batch).map(moved)


def refuse_non_finite(name: str, what: str, finite: Tensor, keys: Sequence[tuple[str, str, int]]) -> None:
    """Raise for the first window whose entry in `finite` (B,) is False."""
    if not finite.all():
        split, clip, start = keys[int(finite.logical_not().nonzero()[0])]
        raise FloatingPointError(
            f"the {what} of {name} is not finite for the window at frame {start} of clip {clip!r} ({split}); "
            "it cannot be left out, since all methods are scored on the same ones"
        )
