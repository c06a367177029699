"""Units: the mean and the spread of a variable, in which networks read it and make it.

A network that must find them out first learns much more slowly where what varies is a tenth of what is always there.
Densities and all that a program returns stay in the variable's own unit.

Units are no view of the data (`dvae.views`). Latents and context have them too, of which nothing is handed out in
another unit. A law is put into the data's unit where it is made (`Law.in_units`, the push-forward), so that given
scales and every density are in that. And positive data that go over orders of magnitude are read as logarithms, though
made as a multiple of their mean: of the powers of a spectrum as they are, a network sees the peaks alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from .blocks import ColumnSummary, blocks


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


class Units(nn.Module):
    """A mean for every coordinate and one scale for all, which keeps angles; 0 and 1 until `fit`.

    Args:
        size: D.
        coordinates: those of a table, each with units of its own; nothing of them is fitted.
    """

    mean: Tensor
    scale: Tensor
    typical: Tensor
    floor: Tensor
    level: Tensor
    spread: Tensor

    def __init__(self, size: int, coordinates: Sequence[Coordinate] = ()):
        super().__init__()
        found = dict(zip(Coordinate._fields, torch.tensor(coordinates).T, strict=True)) if coordinates else {}
        for name, value in (found or {"mean": torch.zeros(size), "scale": torch.ones(())}).items():
            self.register_buffer(name, value)
        self.logarithms = any(each.floor for each in coordinates)

    @torch.no_grad()
    def fit(self, values: Tensor | np.ndarray) -> None:
        """Takes mean and root mean variance of values (..., D), in memory or mapped, which are read in blocks.

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
        self.mean.copy_(torch.from_numpy(known.mean))
        self.scale.fill_(math.sqrt(variance))

    @property
    def filling(self) -> Tensor:
        """(D,) what stands for missing values."""
        return self.typical if self.scale.dim() else self.mean

    def forward(self, values: Tensor) -> Tensor:
        """Values (..., D) without unit."""
        plain: Tensor = (values - self.mean) / self.scale
        if not self.logarithms:
            return plain
        read = self.floor > 0
        logarithms = values.clamp(min=torch.where(read, self.floor, 1.0)).log()  # finite where it is not read, too
        return torch.where(read, (logarithms - self.level) / self.spread, plain)
