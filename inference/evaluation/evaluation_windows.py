"""Held-out windows, prepared once for all models, and evaluation mode with a fixed seed."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from ...data.batch import WHOLE, Batch
from ...data.sequences import HeldOutWindows, axis_names, cluster_keys, held_out_windows
from ...locking import seeded
from ...program.conditional import evaluating
from ...program.model import DynamicalVAE


@dataclass(frozen=True)
class EvaluationWindows:
    """Windows of one evaluation.

    Args:
        windows: source of the windows.
        batch: batch of all windows.
        observed: O, number of observed steps.
        keys: (split, sequence, first step) of each window.
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
        """Return past and future of some windows."""
        return self.batch.rows(part)

    def past(self, part: slice) -> Batch:
        """Return the input of forecasts for some windows: x `(B, O, D)`, as in `Batch.past`."""
        return self.part(part).past(self.observed)

    @property
    def clusters(self) -> dict[str, int]:
        """Number of windows by cluster, `{"split/cluster": number}`."""
        return dict(Counter(f"{split}/{cluster}" for split, cluster, _ in cluster_keys(self.windows)))

    @property
    def places(self) -> Tensor:
        """Index of the cluster of every window in `clusters`, `(N,)`."""
        return cluster_index(cluster_keys(self.windows))

    def description(self) -> dict[str, Any]:
        """Return the description of the data that a result contains."""
        count, steps, coordinates = self.x.shape
        description = {"fingerprint": self.windows.fingerprint, "windows": count, "steps": steps}
        return {**description, "coordinates": coordinates, **self._shares, **self.windows.description}

    @property
    def notes(self) -> list[str]:
        """Notes on missing values; empty if all values were observed."""
        return [
            f"{shares['past']:.1%} of the past values and {shares['future']:.1%} of the future values were observed; "
            "scores use only these"
            for shares in self._shares.values()
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
            "whole sequences have no future; cut them, with observed and horizon steps, to forecast, or use compare() "
            "for the bounds of whole sequences"
        )
    if batch.lengths is not None:
        raise ValueError(
            "evaluation needs windows of equal length; remove 'lengths' from the batch, or cut the windows"
        )
    if not 1 <= observed < batch["x"].shape[1]:
        raise ValueError(
            f"windows must have at least 1 observed step and 1 step to predict, but {observed} of "
            f"{batch['x'].shape[1]} steps are observed"
        )
    eval_windows = EvaluationWindows(windows, batch, observed, list(windows.keys))
    if eval_windows.mask is not None:
        for part, mask in (("past", eval_windows.mask[:, :observed]), ("future", eval_windows.mask[:, observed:])):
            if (empty := ~mask.flatten(1).any(1)).any():
                split, name, start = eval_windows.keys[int(empty.nonzero()[0])]
                _, step = axis_names(windows.description)
                raise ValueError(
                    f"the {part} of the window at {step} {start} of {name!r} has no observation ({split}); remove it"
                )
    return eval_windows


def cluster_index(keys: Sequence[tuple[str, str, int]]) -> Tensor:
    """Return the cluster of every window as an index `(N,)`; clusters are numbered in order of appearance."""
    order: dict[str, int] = {}
    return torch.tensor([order.setdefault(f"{split}/{cluster}", len(order)) for split, cluster, _ in keys])


@contextmanager
def seeded_evaluation(model: nn.Module, seed: int) -> Iterator[None]:
    """Set evaluation mode, disable gradients and seed the draws; restore mode and random state on exit."""
    with seeded(seed, next(model.parameters()).device), evaluating(model), torch.no_grad():
        yield


def require_readable(name: str, model: Any, batch: Batch) -> None:
    """Raise an error that names the model if it cannot read sequences of a batch.

    Args:
        name: name of the model.
        model: any model; only a `DynamicalVAE` is checked.
        batch: the sequences; only the first is read.
    """
    if isinstance(model, DynamicalVAE):
        if WHOLE not in (*model.observed, *model.context, *model.view.names) and WHOLE in batch:
            own = ", ".join(model.observed)
            raise ValueError(
                f"{name} has no data variable x, as windows have, but {own}; pass a batch of these to dvae.compare, "
                "which compares bounds, and score their forecasts by your own code"
            )
        try:
            with seeded_evaluation(model, 0):
                model.rollout(on_device_of(model, batch.rows(slice(0, 1))), guide=True)
        except ValueError as error:
            raise ValueError(f"{name} cannot read the data: {error}") from None


def on_device_of(model: nn.Module, batch: Mapping[str, Any]) -> Batch:
    """Return the batch on the device of the model; a model that does not read batches also gets its floating type."""
    parameter = next(model.parameters())
    reads = isinstance(model, DynamicalVAE)  # a DynamicalVAE subtracts means before it rounds

    def to_device(value: Tensor) -> Tensor:
        return value.to(parameter.device) if reads or not value.is_floating_point() else value.to(parameter)

    return Batch(batch).map(to_device)


def refuse_non_finite(name: str, quantity: str, finite: Tensor, keys: Sequence[tuple[str, str, int]]) -> None:
    """Raise an error if a result is not finite, which names the first such window.

    Args:
        name: name of the method.
        quantity: name of the result, such as "bound".
        finite: (B,), whether the result of each window is finite.
        keys: (split, sequence, first step) of each window.

    Raises:
        FloatingPointError: when an entry of `finite` is False.
    """
    if not finite.all():
        split, sequence, start = keys[int(finite.logical_not().nonzero()[0])]
        raise FloatingPointError(
            f"the {quantity} of {name} is not finite for the window at step {start} of {sequence!r} ({split}); "
            "it cannot be omitted, because all methods are scored on the same windows"
        )
