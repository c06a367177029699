"""Units: the mean and the spread of a variable, in which networks read it and make it.

A network that must find them out first learns much more slowly where what varies is a tenth of what is always there.
Densities and all that a program returns stay in the variable's own unit.

A variable of the data, or context, may lie far from 0 for its spread, as pressures in pascals do. Its mean stays in
float64, its values are read in float64, and only their difference becomes the model's float32.

Units are no view of the data (`dvae.data.views`). Latents and context have them too, of which nothing is handed out in
another unit. A law is put into the data's unit where it is made (`Law.in_units`, the push-forward), so that given
scales and every density are in that. And positive data that go over orders of magnitude are read as logarithms, though
made as a multiple of their mean: of the powers of a spectrum as they are, a network sees the peaks alone.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor, nn
from typing_extensions import override

from .blocks import ColumnSummary, blocks

ROUNDING = 2e-15
"""Standard deviation over the mean up to which values in float64 are a constant with rounding errors."""
RESOLVED = 6e-6
"""Standard deviation over the mean below which float32 loses more than a hundredth of it."""
SMALLEST = 1e-18
"""Least standard deviation: the inverse of its square is a float32."""
TOO_SMALL = f"models compute in float32, which needs at least {SMALLEST:g}; multiply the values by a constant"


LEVELS = "subtract from each sequence its own mean, or fit in float64"
"""What to do if sequences have levels so far apart that float32 resolves nothing around one mean."""


def is_lost(known: ColumnSummary, center: Any) -> np.ndarray:
    """Whether columns vary, but by less than float32 resolves at their distance from a center."""
    spread = np.sqrt(known.variance)
    return (spread > ROUNDING * abs(known.mean)) & (spread < RESOLVED * abs(known.mean - center))  # type: ignore[no-any-return]


def lost_sequences(values: Tensor | np.ndarray, center: Any) -> np.ndarray:
    """Return `is_lost` (N, D) for the coordinates of each sequence (N, T, D), read in blocks."""
    found = []
    for block in blocks(values):
        count, _, size = block.shape
        columns = block.swapaxes(0, 1).reshape(-1, count * size)
        found.append(is_lost(ColumnSummary.of([columns]), np.tile(center, count)).reshape(count, size))
    return np.concatenate(found)


def exceeds_float32(dtype: torch.dtype | np.dtype) -> bool:
    """Whether float32 rounds some values of a type."""
    name = getattr(dtype, "name", str(dtype)).removeprefix("torch.")
    return name in ("float64", "int32", "int64", "uint32", "uint64")


class Coordinate(NamedTuple):
    """How networks read a coordinate, such as a column of a table, and make it.

    Args:
        mean, scale: of the unit.
        typical: what stands for a missing value.
        floor: least value whose logarithm is read; 0 where values are read and not their logarithms.
        level, spread: mean and standard deviation of the logarithms.
    """

    mean: float = 0.0
    scale: float = 1.0
    typical: float = 0.0
    floor: float = 0.0
    level: float = 0.0
    spread: float = 1.0


EXACT = ("mean", "typical")
"""Buffers that may be in float64 whatever the precision of the model."""


class Units(nn.Module):
    """A mean for every coordinate and one scale for all, which keeps angles; 0 and 1 until `fit`.

    Args:
        size: D.
        coordinates: those of a table, each with units of its own; nothing of them is fitted.
        exact: keep means in float64 where they are given, or fitted to values in float64.
    """

    mean: Tensor
    scale: Tensor
    typical: Tensor
    floor: Tensor
    level: Tensor
    spread: Tensor

    def __init__(self, size: int, coordinates: Sequence[Coordinate] = (), exact: bool = False):
        super().__init__()
        self.exact = exact
        given = torch.tensor(coordinates, dtype=torch.float64).reshape(-1, len(Coordinate._fields))
        found = dict(zip(Coordinate._fields, given.T, strict=True)) if coordinates else {}
        for name, value in (found or {"mean": torch.zeros(size), "scale": torch.ones(())}).items():
            kept = exact and name in EXACT and value.dtype is torch.float64
            self.register_buffer(name, value if kept else value.to(torch.get_default_dtype()))
        self.logarithms = any(each.floor for each in coordinates)

    @torch.no_grad()
    def fit(self, values: Tensor | np.ndarray) -> None:
        """Takes mean and root mean variance of values (..., D), in memory or mapped, which are read in blocks.

        Warns if float32 does not resolve how sequences (N, T, D) vary after their common mean is subtracted.

        Raises:
            ValueError: values that do not vary, or are of another size; coordinates that have their units.
        """
        if self.scale.dim():
            raise ValueError("these coordinates have units of their own, which were given; there is nothing to fit")
        size, variance = len(self.mean), 0.0
        if alike := values.shape[-1] == size:
            known = ColumnSummary.of(block.reshape(-1, size) for block in blocks(values))
            variance = float((known.variance * known.count / (known.count - 1).clip(1)).mean())
        if not variance > 0:
            raise ValueError(
                f"units come from values (..., {size}) that vary, not from {tuple(values.shape)}"
                f"{' without variance' if alike else ''}"
            )
        if (scale := math.sqrt(variance)) < SMALLEST:
            raise ValueError(f"the standard deviation of these values is {scale:g}; {TOO_SMALL}")
        mean = torch.from_numpy(known.mean).to(self.mean.device)
        self.mean = mean if self.exact and exceeds_float32(values.dtype) else mean.to(self.scale.dtype)
        self.scale.fill_(scale)
        if values.ndim == 3 and exceeds_float32(values.dtype) and self.scale.dtype is torch.float32:
            lost = lost_sequences(values, known.mean)
            if lost.any():
                warnings.warn(
                    f"in {lost.any(1).sum()} of {len(lost)} sequences, such as {lost.any(1).argmax()}, coordinate "
                    f"{lost.any(0).argmax()} varies by less than float32 resolves at its distance from the mean of "
                    f"all sequences, {known.mean[lost.any(0).argmax()]:.9g}; {LEVELS}",
                    stacklevel=3,  # `no_grad` is between
                )

    @property
    def wide(self) -> bool:
        """Whether values are in float64 and the model is not."""
        return self.mean.dtype is torch.float64 is not self.scale.dtype

    @override
    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Keeps float64 where the model changes its precision."""
        kept = {n: v for n, v in self.named_buffers() if self.exact and n in EXACT and v.dtype is torch.float64}
        super()._apply(fn, recurse)
        for name, value in kept.items():
            setattr(self, name, value.to(getattr(self, name).device))
        return self

    @override
    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *rest: Any) -> None:
        """Keeps float64 where the state has it, and only there."""
        for name in self._buffers.keys() & {*EXACT} if self.exact else ():
            kept = prefix + name in state_dict and state_dict[prefix + name].dtype is torch.float64
            setattr(self, name, getattr(self, name).to(torch.float64 if kept else self.scale.dtype))
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def relative(self, values: Tensor) -> Tensor:
        """Values (..., D) less the mean where they are in float64, as float32 resolves them; else as they are."""
        return (values - self.mean).to(self.scale.dtype) if self.wide else values

    def absolute(self, values: Tensor) -> Tensor:
        """The inverse of `relative`."""
        return values + self.mean if self.wide else values

    @property
    def filling(self) -> Tensor:
        """(D,) what stands for missing values."""
        return self.typical if self.scale.dim() else self.mean

    def forward(self, values: Tensor) -> Tensor:
        """Values (..., D) without unit."""
        plain: Tensor = (values - self.mean).to(self.scale.dtype) / self.scale
        if not self.logarithms:
            return plain
        read = self.floor > 0
        logarithms = values.clamp(min=torch.where(read, self.floor, 1.0)).log()  # finite where it is not read, too
        return torch.where(read, (logarithms.to(self.level.dtype) - self.level) / self.spread, plain)
