"""Four ways to combine a latent with the code of the observed past.

A sequence model that starts from a code h of its past generates different futures if a latent z changes that code. The
model may learn to ignore z if h and z are always combined in the same way. Mix-and-Match (Aliakbarian et al., 2020,
arXiv 1908.00733) therefore perturbs the code at random indices, which are drawn for every batch.

| | code | from (arXiv) |
|---|---|---|
| `MixAndMatch` | h; at random indices, a network's output instead, which reads h there and z elsewhere | 1908.00733 |
| `Concatenate` | a network of [h, z] | MT-VAE: Yan et al. 2018, 1808.04545 |
| `AddProjected` | h + W z; z has no encoder and is drawn from its prior | HP-GAN: Barsoum et al. 2018, 1711.09561 |

Each specification builds two modules. The `encoder` maps the codes of past and future to the guide's features; the
`decoder` maps the code of the past and z to the decoder's code. The fourth way, a latent for each step (Pose-Knows:
Walker et al. 2017, arXiv 1705.00053), is a different factorization: `p(z_t) p(x_t | x_{<t}, h, z_t)`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from ..distributions.subset import Subset


class Residual(nn.Module):
    """The sum of a linear layer and of a perceptron with two hidden layers of half the width and ReLUs.

    Args:
        size: number of inputs.
        features: number of outputs.
    """

    def __init__(self, size: int, features: int) -> None:
        super().__init__()
        half = max(features // 2, 1)
        self.short = nn.Linear(size, features)
        self.long = nn.Sequential(
            *(nn.Linear(size, half), nn.ReLU(), nn.Linear(half, half), nn.ReLU(), nn.Linear(half, features))
        )

    def forward(self, values: Tensor) -> Tensor:
        """Return (B, features) for (B, size)."""
        features: Tensor = self.short(values) + self.long(values)
        return features


class CodeDecoder(nn.Module):
    """Two layers on a code (B, L) with batch normalisation between them, and outputs in (-1, 1) like recurrent states.

    In evaluation, and for a single row, it normalises by the running averages of training. Rows then do not depend on
    each other.

    Args:
        width: L, size of the code.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.norm, self.last = nn.Linear(width, width), nn.BatchNorm1d(width), nn.Linear(width, width)

    def forward(self, code: Tensor) -> Tensor:
        """Return (B, L) for (B, L), between -1 and 1 like recurrent states."""
        norm, learning = self.norm, self.training and len(code) > 1
        mean, var = norm.running_mean, norm.running_var
        hidden = functional.batch_norm(self.first(code), mean, var, norm.weight, norm.bias, learning, eps=norm.eps)
        return torch.tanh(self.last(functional.relu(hidden)))


@dataclass(frozen=True)
class MixAndMatch:
    """Replace the code at random indices by the output of a network that reads the code there and z elsewhere.

    A share alpha of the code is perturbed and the rest is unchanged. For a code of L numbers, z has L - ceil(alpha L)
    numbers, which fill the indices that are not drawn. If z has another size, a linear layer maps it to L numbers. With
    alpha 0 or 1, the code does not depend on z: no index is perturbed, or no index is left for z.

    The guide reads the code of the past at the drawn indices and the code of the future at the others. All modules use
    the same indices, which are drawn once per batch: `DynamicalVAE(shared={"i": noise.indices})`.

    Args:
        alpha: share of perturbed indices, from 0 to 1.
    """

    indices_name: ClassVar[str] = "i"

    alpha: float = 0.5

    def __post_init__(self) -> None:
        Subset(self.alpha)  # validates alpha

    @property
    def indices(self) -> Subset:
        """The distribution of the mask (L,), 1 at the perturbed indices and 0 elsewhere."""
        return Subset(self.alpha)

    def latent(self, width: int) -> int:
        """Return the paper's size of z for a code of L = `width` numbers: L - ceil(alpha L), at least 1."""
        return max(width - self.indices.chosen(width), 1)

    def encoder(self, width: int) -> nn.Module:
        """Return the module from past code, future code (B, L) and indices (B, L) to the guide's features (B, L)."""
        return _MixedEncoder(width)

    def decoder(self, width: int, latent: int) -> nn.Module:
        """Return the module from past code, z (B, `latent`) and indices to the decoder's initial code (B, L)."""
        return _MixedDecoder(width, latent, self.indices.chosen(width))


class _MixedEncoder(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.block = Residual(width, width)

    def forward(self, past: Tensor, future: Tensor, indices: Tensor | None = None) -> Tensor:
        indices = _require_indices(indices)
        features: Tensor = self.block(indices * past + (1 - indices) * future)
        return features


class _MixedDecoder(nn.Module):
    def __init__(self, width: int, latent: int, count: int) -> None:
        super().__init__()
        self.latent = latent
        self.layer = None if latent == max(width - count, 1) else nn.Linear(latent, width)
        self.block = Residual(width, count) if count else None
        self.last = CodeDecoder(width)

    def forward(self, past: Tensor, z: Tensor, indices: Tensor | None = None) -> Tensor:
        indices = _require_indices(indices)
        if z.shape[-1] != self.latent:
            raise ValueError(f"z must have size {self.latent} in its last dimension, got {z.shape[-1]}")
        latent_code = _scatter_in_order(z, indices < 0.5) if self.layer is None else functional.relu(self.layer(z))
        mixture, code = indices * past + (1 - indices) * latent_code, past
        if self.block is not None:
            code = indices * _scatter_in_order(self.block(mixture), indices > 0.5) + (1 - indices) * past
        decoded: Tensor = self.last(code)
        return decoded


def _require_indices(indices: Tensor | None) -> Tensor:
    if indices is None:
        raise ValueError("Mix-and-Match needs the indices to perturb, got None; pass a (B, L) mask of ones and zeros")
    return indices


def _scatter_in_order(values: Tensor, mask: Tensor) -> Tensor:
    """Return (B, L) with values (B, n) in order at the n True positions of `mask` (B, L), and any numbers elsewhere."""
    order = (mask.cumsum(-1) - 1).clamp(0, values.shape[-1] - 1)
    return values.gather(-1, order)


def half(width: int) -> int:
    """Return half the width, at least 1."""
    return max(width // 2, 1)


@dataclass(frozen=True)
class Concatenate:
    """Replace the code of the past by the output of a network that reads the concatenated code and z."""

    def latent(self, width: int) -> int:
        """Return half the size of the code."""
        return half(width)

    def encoder(self, width: int) -> nn.Module:
        """Return the module from past code and future code (B, L) to the guide's features (B, L)."""
        return _Concatenated(2 * width, width)

    def decoder(self, width: int, latent: int) -> nn.Module:
        """Return the module from past code (B, L) and z (B, `latent`) to the decoder's initial code (B, L)."""
        return _Concatenated(width + latent, width, CodeDecoder(width))


class _Concatenated(nn.Module):
    def __init__(self, size: int, width: int, last: nn.Module | None = None) -> None:
        super().__init__()
        self.block, self.last = Residual(size, width), last or nn.Identity()

    def forward(self, past: Tensor, future_or_z: Tensor, indices: Tensor | None = None) -> Tensor:
        features: Tensor = self.last(self.block(torch.cat([past, future_or_z], -1)))
        return features


@dataclass(frozen=True)
class AddProjected:
    """Add a linear map of z to the code of the past. There is no encoder, because the guide is the prior."""

    def latent(self, width: int) -> int:
        """Return half the size of the code."""
        return half(width)

    def encoder(self, width: int) -> None:
        """Return None, because the guide is the prior."""

    def decoder(self, width: int, latent: int) -> nn.Module:
        """Return the module from past code (B, L) and z (B, `latent`) to the decoder's initial code (B, L)."""
        return _ProjectedSum(width, latent)


class _ProjectedSum(nn.Module):
    def __init__(self, width: int, latent: int) -> None:
        super().__init__()
        self.layer = nn.Linear(latent, width, bias=False)

    def forward(self, past: Tensor, z: Tensor, indices: Tensor | None = None) -> Tensor:
        features: Tensor = past + self.layer(z)
        return features


class Noise(Protocol):
    """Specification of how a latent z enters a code: a frozen dataclass, such as those in this module."""

    def latent(self, width: int) -> int:
        """Return the default size of z for a code of this width."""

    def encoder(self, width: int) -> nn.Module | None:
        """Return the module from past code, future code and indices to the guide's features.

        None means that the guide is the prior.
        """

    def decoder(self, width: int, latent: int) -> nn.Module:
        """Return the module from past code (B, L), z (B, `latent`) and indices to the decoder's initial code (B, L)."""
