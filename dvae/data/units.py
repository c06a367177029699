"""Units: mean and spread that standardise a variable for networks.

A network learns much more slowly on raw values if their variation is a tenth of their mean. Densities and all outputs
of a program stay in the variable's own unit.

A variable of the data or the context may lie far from 0 relative to its spread, such as pressures in pascals. Its mean
stays in float64, its values are read in float64, and only the difference becomes the model's float32.

Units are different from views of the data (`dvae.data.views`). Latents and context also have units, and outputs keep
the original unit. A distribution is transformed to the data's unit where it is built
(`ConditionalDistribution.rescale`, the push-forward), so given scales and all densities are in this unit. Networks read
positive data that span orders of magnitude as logarithms, since the peaks of a raw power spectrum would hide everything
else. They still produce such data as a multiple of their mean.
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

from ..networks.loop import valid_steps
from .batch import WHOLE, Batch
from .blocks import ColumnSummary, blocks

ROUNDING = 2e-15
"""Largest ratio of standard deviation to mean at which float64 values count as a constant with rounding errors."""
RESOLVED = 6e-6
"""Ratio of standard deviation to mean below which float32 loses more than a hundredth of the deviation."""
SMALLEST = 1e-18
"""Smallest supported standard deviation; the inverse of its square is still a finite float32."""
TOO_SMALL = f"models compute in float32, which needs at least {SMALLEST:g}; multiply the values by a constant"


LEVELS = "subtract from each sequence its own mean, or fit in float64"
"""Advice for sequences whose levels differ too much for float32 to resolve their variation around one mean."""


def is_imprecise(summary: ColumnSummary, center: Any) -> np.ndarray:
    """Return whether each column varies by less than float32 resolves at its distance from a center, (C,).

    The result is False for constant columns.

    Args:
        summary: statistics of the C columns.
        center: value (C,) that is subtracted from each column in float64.
    """
    spread = np.sqrt(summary.variance)
    return (spread > ROUNDING * abs(summary.mean)) & (spread < RESOLVED * abs(summary.mean - center))  # type: ignore[no-any-return]


def imprecise_sequences(values: Tensor | np.ndarray, center: Any) -> np.ndarray:
    """Return `is_imprecise` (N, D) for each coordinate of each sequence.

    Args:
        values: (N, T, D), in memory or mapped; read in blocks.
        center: value (D,) that is subtracted from each coordinate in float64.
    """
    masks = []
    for block in blocks(values):
        count, _, size = block.shape
        columns = block.swapaxes(0, 1).reshape(-1, count * size)
        masks.append(is_imprecise(ColumnSummary.of([columns]), np.tile(center, count)).reshape(count, size))
    return np.concatenate(masks)


def exceeds_float32(dtype: torch.dtype | np.dtype) -> bool:
    """Return whether float32 rounds some values of a type."""
    name = getattr(dtype, "name", str(dtype)).removeprefix("torch.")
    return name in ("float64", "int32", "int64", "uint32", "uint64")


class Coordinate(NamedTuple):
    """Units of one coordinate, such as a column of a table.

    Args:
        mean, scale: mean and scale that standardise the values.
        typical: replacement for a missing value.
        floor: lower limit for clipping values before networks read their logarithms; 0 if networks read values.
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


def known_values(batch: Batch, name: str) -> Tensor:
    """Return values (..., D) of a variable, with NaN at missing entries and padding.

    Args:
        batch: batch with the variable; integers are converted to float64.
        name: name of the variable.

    Raises:
        ValueError: the batch does not contain the variable, or its mask is not boolean or has another shape.
    """
    if name not in batch:
        raise ValueError(f"the batch has no {name!r}; it has {', '.join(batch) or 'nothing'}")
    values = torch.as_tensor(batch[name])
    values = values if values.is_floating_point() else values.double()
    mask, lengths = batch.masks().get(name), batch.lengths
    if mask is not None:
        mask = torch.as_tensor(mask, device=values.device)
        if mask.dtype is not torch.bool or mask.shape != values.shape:
            raise ValueError(
                f"the mask of {name} is {mask.dtype} {tuple(mask.shape)}; expected bool {tuple(values.shape)}, True "
                "where an entry was observed"
            )
        values = torch.where(mask, values, torch.nan)
    if lengths is not None and values.dim() == 3:
        valid = valid_steps(torch.as_tensor(lengths, device=values.device), values.shape[1])
        values = torch.where(valid[..., None], values, torch.nan)
    return values


class Units(nn.Module):
    """Standardisation with a mean for every coordinate and one common scale, which preserves angles.

    Means are 0 and the scale is 1 until `fit` is called.

    Args:
        size: D.
        coordinates: units of each column of a table, which replace the fitted ones.
        exact: keep means in float64 if they are given or fitted to float64 values.
        variable: name of the values in a batch.
    """

    mean: Tensor
    scale: Tensor
    typical: Tensor
    floor: Tensor
    level: Tensor
    spread: Tensor

    def __init__(self, size: int, coordinates: Sequence[Coordinate] = (), exact: bool = False, variable: str = WHOLE):
        super().__init__()
        self.exact, self.variable = exact, variable
        values = torch.tensor(coordinates, dtype=torch.float64).reshape(-1, len(Coordinate._fields))
        buffers = dict(zip(Coordinate._fields, values.T, strict=True)) if coordinates else {}
        for name, value in (buffers or {"mean": torch.zeros(size), "scale": torch.ones(())}).items():
            is_wide = exact and name in EXACT and value.dtype is torch.float64
            self.register_buffer(name, value if is_wide else value.to(torch.get_default_dtype()))
        self.logarithms = any(each.floor for each in coordinates)

    @torch.no_grad()
    def fit(self, values: Tensor | np.ndarray | Mapping[str, Any]) -> None:
        """Set mean and root mean variance from values (..., D), in memory or mapped, which are read in blocks.

        NaN is left out; of a batch, entries that its mask or lengths exclude are left out, too. Warns if float32 does
        not resolve how sequences (N, T, D) vary after their common mean is subtracted.

        Raises:
            TypeError: if the values are neither an array nor a batch.
            ValueError: if the values do not vary or have another size, or the units of the coordinates were given.
        """
        if self.scale.dim():
            raise ValueError("these coordinates have given units, which cannot be fitted; remove the call of fit")
        if isinstance(values, Mapping):
            values = known_values(Batch(values), self.variable)
        if not hasattr(values, "shape"):
            raise TypeError(
                f"units need values (..., {len(self.mean)}) or a batch, got {type(values).__name__}; a batch of all "
                "windows is windows.all()"
            )
        size, variance = len(self.mean), 0.0
        if same_size := values.shape[-1] == size:
            summary = ColumnSummary.of(block.reshape(-1, size) for block in blocks(values))
            variance = float((summary.variance * summary.count / (summary.count - 1).clip(1)).mean())
        if not variance > 0:
            raise ValueError(
                f"units need values (..., {size}) that vary, got {tuple(values.shape)}"
                f"{' without variance' if same_size else ''}"
            )
        if (scale := math.sqrt(variance)) < SMALLEST:
            raise ValueError(f"the standard deviation of these values is {scale:g}; {TOO_SMALL}")
        mean = torch.from_numpy(summary.mean).to(self.mean.device)
        self.mean = mean if self.exact and exceeds_float32(values.dtype) else mean.to(self.scale.dtype)
        self.scale.fill_(scale)
        if values.ndim == 3 and exceeds_float32(values.dtype) and self.scale.dtype is torch.float32:
            imprecise = imprecise_sequences(values, summary.mean)
            if imprecise.any():
                rows, coordinate = imprecise.any(1), imprecise.any(0).argmax()
                warnings.warn(
                    f"in {rows.sum()} of {len(imprecise)} sequences, such as {rows.argmax()}, coordinate {coordinate} "
                    "varies by less than float32 resolves at its distance from the mean of all sequences, "
                    f"{summary.mean[coordinate]:.9g}; {LEVELS}",
                    stacklevel=3,  # the decorator `no_grad` adds a frame
                )

    @property
    def wide(self) -> bool:
        """Whether values are read in float64 although the model has another precision."""
        return self.mean.dtype is torch.float64 is not self.scale.dtype

    @override
    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Keep float64 if the model changes its precision."""
        wide = {n: v for n, v in self.named_buffers() if self.exact and n in EXACT and v.dtype is torch.float64}
        super()._apply(fn, recurse)
        for name, value in wide.items():
            setattr(self, name, value.to(getattr(self, name).device))
        return self

    @override
    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *rest: Any) -> None:
        """Use float64 for the buffers that are float64 in the state."""
        for name in self._buffers.keys() & {*EXACT} if self.exact else ():
            is_wide = prefix + name in state_dict and state_dict[prefix + name].dtype is torch.float64
            setattr(self, name, getattr(self, name).to(torch.float64 if is_wide else self.scale.dtype))
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def relative(self, values: Tensor) -> Tensor:
        """Return values (..., D), minus the mean if they are in float64; float32 resolves the difference."""
        return (values - self.mean).to(self.scale.dtype) if self.wide else values

    def absolute(self, values: Tensor) -> Tensor:
        """Invert `relative`."""
        return values + self.mean if self.wide else values

    @property
    def filling(self) -> Tensor:
        """Replacements (D,) for missing values."""
        return self.typical if self.scale.dim() else self.mean

    def forward(self, values: Tensor) -> Tensor:
        """Return standardised values (..., D)."""
        plain: Tensor = (values - self.mean).to(self.scale.dtype) / self.scale
        if not self.logarithms:
            return plain
        use_log = self.floor > 0
        logarithms = values.clamp(min=torch.where(use_log, self.floor, 1.0)).log()  # finite in unused entries
        return torch.where(use_log, (logarithms.to(self.level.dtype) - self.level) / self.spread, plain)
