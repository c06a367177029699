"""Learnable priors of static latents, in place of N(0, I)."""

from __future__ import annotations

import math

import pyro.distributions as dist
import torch
from torch import nn


class Prior(nn.Module):
    """A distribution over (D,) with parameters of its own."""

    def forward(self, batch: int) -> dist.Distribution:
        """The prior of `batch` sequences: batch (B,), event (D,)."""
        raise NotImplementedError


class NormalPrior(Prior):
    """A diagonal normal with learned location and scale.

    Args:
        size: D.
    """

    def __init__(self, size: int):
        super().__init__()
        self.loc = nn.Parameter(torch.zeros(size))
        self.log_scale = nn.Parameter(torch.zeros(size))

    def forward(self, batch: int) -> dist.Distribution:
        """See `Prior.forward`."""
        return dist.Normal(self.loc, self.log_scale.exp()).expand((batch, self.loc.shape[0])).to_event(1)


class MixturePrior(Prior):
    """A mixture of diagonal normals with learned weights, locations and scales.

    Args:
        size: D.
        components: number of normals.
    """

    def __init__(self, size: int, components: int = 8):
        super().__init__()
        self.logits = nn.Parameter(torch.zeros(components))
        self.loc = nn.Parameter(torch.randn(components, size) / math.sqrt(size))
        self.log_scale = nn.Parameter(torch.zeros(components, size))

    def forward(self, batch: int) -> dist.Distribution:
        """See `Prior.forward`."""
        parts = dist.Normal(self.loc, self.log_scale.exp()).to_event(1)
        return dist.MixtureSameFamily(dist.Categorical(logits=self.logits), parts).expand((batch,))
