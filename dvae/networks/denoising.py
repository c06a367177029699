"""Denoiser: any network over time, as the denoiser of a joint distribution of all steps (`distributions.Diffusion`).

The network reads noisy frames under the masks of the factor. With a basis, it denoises coefficients in the frequency
domain, as HumanMAC does (Chen et al., 2023, arXiv 2302.03665). The transform is orthonormal, so the noise is the same.

Coefficient k of coordinate d then has a normal model with standard deviation r = exp(a_d) (k + 1)^-b_d, where a and b
are learned. The network f estimates what this model does not explain (Karras et al., 2022, arXiv 2206.00364):

    v = cos(a) sin(a) (1 - r^2) / q^2 z + r / q f(z / q),        q^2 = cos^2(a) r^2 + sin^2(a)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn
from typing_extensions import override

from ..distributions.base import Shape
from ..distributions.diffusion import LEVEL_SIZE, DenoiserSpec, embed_level, small_linear
from ..factorization.relations import ALL
from .attention import SelfAttention
from .base import Input, NetworkSpec
from .loop import memoize


@dataclass(frozen=True)
class Denoiser(DenoiserSpec):
    """A denoiser of all steps of a variable.

    Args:
        network: network over time, which also reads the noise level.
        basis: the network reads and returns coefficients over time instead of steps: of the type II discrete "cosine"
            transform; or of the type VII discrete "sine" transform, for values that continue from 0 before the first
            step. None for steps.
        coefficients: number of lowest coefficients that the network reads; the others are independent normal variables.
            None for all.
    """

    network: NetworkSpec = field(default_factory=SelfAttention)
    basis: Literal["cosine", "sine"] | None = None
    coefficients: int | None = None

    @override
    def build(self, shape: Shape) -> SequenceDenoiser:
        """Return the module for a variable of this shape.

        Args:
            shape: the variable, its features, and the steps that its value at t may depend on.

        Raises:
            ValueError: `basis` is unknown, or set although steps may not depend on all others; or `coefficients` is
                below 1, or set without `basis`.
        """
        if self.basis not in (None, *BASES):
            raise ValueError(f"`basis` must be 'cosine', 'sine' or None, got {self.basis!r}")
        if self.coefficients is not None and (self.coefficients < 1 or not self.basis):
            raise ValueError(
                f"`coefficients` is a number of at least 1 and needs a basis, got coefficients={self.coefficients} "
                f"and basis={self.basis!r}"
            )
        if self.basis and shape.relation != ALL:
            raise ValueError(
                f"{self.basis} coefficients contain all steps, but {shape.name} has a parent that is restricted to the "
                "past; use basis=None"
            )
        return SequenceDenoiser(self, shape)


class SequenceDenoiser(nn.Module):
    """A network over time from noisy values, the level and features to estimates of v at all steps.

    A frame of its input consists of the noisy value, the features, and an indicator of each observed entry.

    Args:
        spec: description of the denoiser.
        shape: the variable and its features; its `relation` contains the frames that step t reads.
    """

    def __init__(self, spec: Denoiser, shape: Shape):
        super().__init__()
        self.basis, self.coefficients = spec.basis and BASES[spec.basis], spec.coefficients
        frame = Input("frame", 2 * shape.size + shape.features, shape.relation)
        self.network = spec.network.build([frame, Input("level", LEVEL_SIZE)], True, shape.size)
        self.out = small_linear(self.network.features, shape.size)
        if self.basis:
            self.log_scale = nn.Parameter(torch.zeros(shape.size))
            self.slope = nn.Parameter(torch.ones(shape.size))

    def forward(self, z: Tensor, angle: Tensor, features: Tensor, entries: Tensor) -> Tensor:
        """Return v (..., T, D) for z (..., T, D), angles (..., 1, 1), features (..., T, H) and entries (..., T, D)."""
        others, lengths, basis = memoize(self, [features, entries], lambda: self._given(features, entries))
        observed = torch.where(entries > 0, z, 0.0).flatten(0, -3)
        level = embed_level(angle[..., 0, :]).flatten(0, -2)
        if basis is None:
            v = self._network(torch.cat([observed, others], -1), level, lengths)
        else:
            v = self._in_frequency(observed, angle.flatten(0, -3), others, basis, level, lengths)
        reshaped: Tensor = v.unflatten(0, z.shape[:-2])
        return reshaped

    def _given(self, features: Tensor, entries: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return the other inputs of the network (B, T or n, H + D), lengths (B,), and the basis (B, T, T) if any."""
        is_valid = entries[..., :1] >= 0
        others = torch.cat([features, (entries > 0).to(features.dtype)], -1)
        others, lengths = torch.where(is_valid, others, 0.0).flatten(0, -3), is_valid.sum((-2, -1)).flatten()
        if not self.basis:
            return others, lengths, None
        basis = self.basis(lengths, others.shape[1], others.dtype)
        return basis[:, : self.coefficients] @ others, lengths, basis

    def _network(self, frames: Tensor, level: Tensor, lengths: Tensor) -> Tensor:
        v: Tensor = self.out(self.network({"frame": frames, "level": level}, frames.shape[1], lengths))
        return v.to(frames.dtype)

    def _in_frequency(
        self, z: Tensor, angle: Tensor, others: Tensor, basis: Tensor, level: Tensor, lengths: Tensor
    ) -> Tensor:
        steps = torch.arange(1, z.shape[1] + 1, dtype=z.dtype, device=z.device)
        scale = (self.log_scale - self.slope * steps.log()[:, None]).exp()
        spread = (angle.cos() * scale).square() + angle.sin().square()
        z, n = basis @ z, others.shape[1]
        v = angle.cos() * angle.sin() * (1 - scale.square()) / spread * z
        whitened = (z / spread.sqrt())[:, :n]
        update = self._network(torch.cat([whitened, others], -1), level, lengths.clamp(max=n))
        update = (scale / spread.sqrt())[:, :n] * update
        return basis.mT @ torch.cat([v[:, :n] + update, v[:, n:]], 1)


def ragged_cosine_basis(lengths: Tensor, length: int, dtype: torch.dtype) -> Tensor:
    """Return the orthonormal DCT-II matrix (B, T, T) of the valid steps of each sequence, 0 elsewhere."""
    steps = torch.arange(length, dtype=dtype, device=lengths.device)
    n, k = lengths.to(dtype)[:, None, None], steps[:, None]
    basis = (math.pi * (steps + 0.5) * k / n).cos() * ((k > 0).to(dtype) + 1).sqrt() / n.sqrt()
    return basis * ((k < n) & (steps < n))


def ragged_sine_basis(lengths: Tensor, length: int, dtype: torch.dtype) -> Tensor:
    """Return the orthonormal DST-VII matrix (B, T, T) of the valid steps of each sequence, 0 elsewhere."""
    steps = torch.arange(length, dtype=dtype, device=lengths.device)
    n, k = lengths.to(dtype)[:, None, None], steps[:, None]
    basis = 2 * (math.pi * (2 * k + 1) * (steps + 1) / (2 * n + 1)).sin() / (2 * n + 1).sqrt()
    return basis * ((k < n) & (steps < n))


BASES = {"cosine": ragged_cosine_basis, "sine": ragged_sine_basis}
