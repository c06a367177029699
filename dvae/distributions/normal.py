"""Independent normals, whose densities and divergences take fewer passes over memory than torch's.

They are written with quotients, which are used twice, in place of squares of scales: of a training step of STORN that
saves a hundredth to a twentieth (docs/results/speed.md).
"""

from __future__ import annotations

import math

import torch
from pyro import distributions
from torch import Tensor
from torch.distributions import register_kl
from typing_extensions import override

HALF_LOG_2_PI = 0.5 * math.log(2 * math.pi)


class Normals(distributions.Normal):
    """Normals with locations and scales (..., D)."""

    @override
    def log_prob(self, value: Tensor) -> Tensor:
        distance = (value - self.loc) / self.scale
        return torch.addcmul(-HALF_LOG_2_PI - self.scale.log(), distance, distance, value=-0.5)


@register_kl(Normals, Normals)
def _divergence(q: Normals, p: Normals) -> Tensor:
    ratio, distance = q.scale / p.scale, (q.loc - p.loc) / p.scale
    return torch.addcmul(torch.addcmul(-0.5 - ratio.log(), ratio, ratio, value=0.5), distance, distance, value=0.5)
