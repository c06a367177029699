"""Units: the mean and the spread of a variable, in which networks read it and make it.

A network that must find them out first learns much more slowly where what varies is a tenth of what is always there.
Densities and all that a program returns stay in the variable's own unit.

Units are no view of the data (`dvae.views`), though they are a bijection with the same way back and its determinant.
Latents and context have them too, of which nothing is handed out in another unit. And a law is put into the data's
unit where it is made (`Law.in_units`, the push-forward), so that given scales and every density are in that.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class Units(nn.Module):
    """A mean for every coordinate and one scale for all, which keeps angles; 0 and 1 until `fit`.

    Args:
        size: D.
        columns: a scale for every coordinate, as of columns of a table, and a typical value that stands for a missing
            one, where that is not the mean.
    """

    mean: Tensor
    scale: Tensor
    typical: Tensor

    def __init__(self, size: int, columns: bool = False):
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size if columns else ()))
        if columns:
            self.register_buffer("typical", torch.zeros(size))

    @torch.no_grad()
    def set(self, mean: Sequence[float], scale: Sequence[float], typical: Sequence[float]) -> None:
        """Takes a mean, a scale and a typical value for each coordinate; it must have been made for `columns`."""
        for buffer, values in ((self.mean, mean), (self.scale, scale), (self.typical, typical)):
            buffer.copy_(buffer.new_tensor(values))

    @torch.no_grad()
    def fit(self, values: Tensor) -> None:
        """Takes mean and root mean variance of values (..., D).

        Raises:
            ValueError: values that do not vary, or are of another size.
        """
        rows = values.flatten(0, -2)
        if rows.shape[1:] != self.mean.shape or not rows.var(0).mean() > 0:
            raise ValueError(
                f"units come from values (..., {len(self.mean)}) that vary, not from {tuple(values.shape)}"
                f"{'' if rows.shape[1:] != self.mean.shape else ' without variance'}"
            )
        self.mean.copy_(rows.mean(0))
        self.filling.copy_(self.mean)
        variance = rows.var(0)
        self.scale.copy_((variance if self.scale.dim() else variance.mean()).sqrt())

    @property
    def filling(self) -> Tensor:
        """(D,) what stands for missing values."""
        return self.typical if self.scale.dim() else self.mean

    def forward(self, values: Tensor) -> Tensor:
        """Values (..., D) without unit."""
        return (values - self.mean) / self.scale

    def inverse(self, values: Tensor) -> Tensor:
        """Values (..., D) in their unit again."""
        return values * self.scale + self.mean

    def log_det(self, values: Tensor) -> Tensor:
        """(B,) log of the determinant of the Jacobian of `forward` at values (B, ..., D)."""
        each: Tensor = -self.scale.log().mean() * values[0].numel()
        return each.expand(len(values))
