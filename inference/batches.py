"""Batches: dicts of tensors with one sequence in each row, and where the loop draws them from.

Local variables are (B, T, D), static ones (B, D); "lengths" (B,) counts the valid frames of right-padded
sequences, and "mask" (B, T, D) is True where an entry of the observed variable was observed (or maps several
such names to masks).
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

Batch = Mapping[str, Any]


@runtime_checkable
class Source(Protocol):
    """Training data: anything that draws batches, such as the windows of a motion data set."""

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Return a batch, drawn with the generator alone."""


@dataclass(frozen=True)
class Sequences:
    """N sequences in memory.

    Args:
        batch: the variables, each with N rows.

    Raises:
        ValueError: when rows differ in number, a shape is neither (N, T, D) nor (N, D), or an entry that is
            neither masked nor padding is NaN or infinite.
    """

    batch: Batch

    def __post_init__(self) -> None:
        rows = {name: len(value) for name, value in leaves(self.batch).items()}
        if len(set(rows.values())) != 1 or 0 in rows.values():
            raise ValueError(f"every variable needs the same number of sequences, at least one; given {rows}")
        for name, value in leaves(self.batch).items():
            if value.is_floating_point():
                self._check(name, value)

    def _check(self, name: str, value: Tensor) -> None:
        if value.ndim not in (2, 3):
            raise ValueError(
                f"{name} has shape {tuple(value.shape)}; a local variable is (sequences, frames, features), "
                "a static one (sequences, features)"
            )
        bad = ~torch.isfinite(value)
        lengths, mask = self.batch.get("lengths"), self.batch.get("mask")
        mask = mask.get(name) if isinstance(mask, Mapping) else mask
        if mask is not None and mask.shape == value.shape:
            bad &= mask
        if lengths is not None and value.ndim == 3:
            bad &= (torch.arange(value.shape[1], device=value.device) < lengths[:, None])[..., None]
        if bad.any():
            raise ValueError(
                f"{name} has {int(bad.sum())} entries that are NaN or infinite, the first in sequence "
                f'{int(bad.flatten(1).any(1).nonzero()[0])}; remove them, or give a boolean "mask" that is '
                "False there"
            )

    def __len__(self) -> int:
        return len(next(iter(leaves(self.batch).values())))

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Return `batch_size` different sequences in random order; all of them if there are no more."""
        chosen = torch.randperm(len(self), generator=generator)[:batch_size]
        return each(self.batch, itemgetter(chosen))

    def split(self, batch_size: int) -> Iterator[Batch]:
        """Yield all sequences in order, `batch_size` at a time."""
        for start in range(0, len(self), batch_size):
            yield each(self.batch, itemgetter(slice(start, start + batch_size)))


def each(batch: Mapping[str, Any], change: Callable[[Any], Tensor]) -> Batch:
    """Return the batch with every tensor changed."""
    return {n: each(v, change) if isinstance(v, Mapping) else change(v) for n, v in batch.items()}


def leaves(batch: Batch) -> dict[str, Tensor]:
    """Every tensor by name; those of a mapping under "name/key"."""
    flat = {name: value for name, value in batch.items() if not isinstance(value, Mapping)}
    for name, value in batch.items():
        if isinstance(value, Mapping):
            flat |= {f"{name}/{key}": inner for key, inner in leaves(value).items()}
    return flat


def sequences(data: Any) -> Sequences:
    """Return data as `Sequences`.

    Args:
        data: x as a tensor or array (N, T, D), a batch, or an object whose `all()` returns a batch.

    Raises:
        TypeError, ValueError: when it is none of these.
    """
    if isinstance(data, Mapping):
        return Sequences(each(data, torch.as_tensor))
    if isinstance(data, Tensor | np.ndarray):
        if data.ndim != 3:
            raise ValueError(
                f"x has shape {tuple(data.shape)}, expected (sequences, frames, features); a single sequence is x[None]"
            )
        return Sequences({"x": torch.as_tensor(data)})
    if callable(getattr(data, "all", None)):
        return Sequences(data.all())
    raise TypeError(
        "expected x as a tensor (N, T, D), a dict of tensors, or an object with sample() or all(), "
        f"got {type(data).__name__}"
    )
