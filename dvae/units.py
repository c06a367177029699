"""Units: the mean and the spread of a variable, in which networks read it and make it.

A network that must find them out first learns much more slowly where what varies is a tenth of what is always there.
Densities and all that a program returns stay in the variable's own unit.

Units are no view of the data (`dvae.views`), though they are a bijection with the same way back and its determinant.
Latents and context have them too, of which nothing is handed out in another unit. And a law is put into the data's
unit where it is made (`Head.in_units`, the push-forward), so that given scales and every density are in that.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Units(nn.Module):
    """A mean for every coordinate and one scale for all, which keeps angles; 0 and 1 until `fit`.

    Args:
        size: D.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, size: int):
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("scale", torch.ones(()))

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
        self.scale.copy_(rows.var(0).mean().sqrt())

    def forward(self, values: Tensor) -> Tensor:
        """Values (..., D) without unit."""
        return (values - self.mean) / self.scale

    def inverse(self, values: Tensor) -> Tensor:
        """Values (..., D) in their unit again."""
        return values * self.scale + self.mean

    def log_det(self, values: Tensor) -> Tensor:
        """(B,) log of the determinant of the Jacobian of `forward` at values (B, ..., D)."""
        return -self.scale.log().expand(len(values)) * values[0].numel()
