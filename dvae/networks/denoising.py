"""Denoiser: any network over time, as the denoiser of a joint distribution of all steps (`distributions.Diffusion`).

The network reads noisy frames under the masks of the factor. With cosine coefficients, it denoises in the frequency
domain, as HumanMAC does (Chen et al., 2023, arXiv 2302.03665). The transform is orthonormal, so the noise is the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from typing_extensions import override

from ..distributions.base import Shape
from ..distributions.diffusion import LEVEL_SIZE, DenoiserSpec, embed_level, small_linear
from ..factorization.relations import ALL
from .attention import SelfAttention
from .base import Input, NetworkSpec


@dataclass(frozen=True)
class Denoiser(DenoiserSpec):
    """A denoiser of all steps of a variable.

    Args:
        network: network over time, which also reads the noise level.
        cosine: whether the network reads and returns cosine coefficients over time instead of steps.
    """

    network: NetworkSpec = field(default_factory=SelfAttention)
    cosine: bool = False

    @override
    def build(self, shape: Shape) -> SequenceDenoiser:
        """Return the module for a variable of this shape.

        Args:
            shape: the variable, its features, and the steps that its value at t may depend on.

        Raises:
            ValueError: `cosine` is set, but steps may not depend on all others.
        """
        if self.cosine and shape.relation != ALL:
            raise ValueError(
                f"cosine coefficients contain all steps, but {shape.name} has a parent that is restricted to the past; "
                "use cosine=False"
            )
        return SequenceDenoiser(self.network, shape, self.cosine)


class SequenceDenoiser(nn.Module):
    """A network over time from noisy values, the level and features to estimates of v at all steps.

    A frame of its input consists of the noisy value, the features, and an indicator of an observed step.

    Args:
        network: description of the network.
        shape: the variable and its features; its `relation` contains the frames that step t reads.
        cosine: whether the network reads and returns cosine coefficients over time instead of steps.
    """

    def __init__(self, network: NetworkSpec, shape: Shape, cosine: bool):
        super().__init__()
        self.cosine = cosine
        frame = Input("frame", shape.size + shape.features + 1, shape.relation)
        self.network = network.build([frame, Input("level", LEVEL_SIZE)], True, shape.size)
        self.out = small_linear(self.network.features, shape.size)

    def forward(self, z: Tensor, angle: Tensor, features: Tensor, steps: Tensor) -> Tensor:
        """Return v (..., T, D) for z (..., T, D), angles (..., 1, 1), features (..., T, H) and steps (..., T, 1)."""
        frames = torch.cat([torch.where(steps > 0, z, 0.0), features, (steps > 0).to(z.dtype)], -1)
        frames = torch.where(steps < 0, 0.0, frames)
        lengths, frames = (steps >= 0).sum((-2, -1)).flatten(), frames.flatten(0, -3)
        basis = ragged_cosine_basis(lengths, z.shape[-2], z.dtype) if self.cosine else None
        frames = frames if basis is None else basis @ frames
        parents = {"frame": frames, "level": embed_level(angle[..., 0, :]).flatten(0, -2)}
        v: Tensor = self.out(self.network(parents, z.shape[-2], lengths)).to(z.dtype)
        v = v if basis is None else basis.mT @ v
        reshaped: Tensor = v.unflatten(0, z.shape[:-2])
        return reshaped


def ragged_cosine_basis(lengths: Tensor, length: int, dtype: torch.dtype) -> Tensor:
    """Return the orthonormal DCT-II matrix (B, T, T) of the valid steps of each sequence, 0 elsewhere."""
    steps = torch.arange(length, dtype=dtype, device=lengths.device)
    n, k = lengths.to(dtype)[:, None, None], steps[:, None]
    basis = (math.pi * (steps + 0.5) * k / n).cos() * ((k > 0) + 1.0).sqrt() / n.sqrt()
    return basis * ((k < n) & (steps < n))
