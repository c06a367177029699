"""How noise enters a code: four ways for a latent to meet the code of what was observed.

A sequence model that starts from a code h of its past makes many futures by having a latent z change that code. It may
learn to ignore z where both come in the same way every time; Mix-and-Match (Aliakbarian et al. 2020, arXiv 1908.00733)
therefore perturbs the code at indices that are drawn anew for every batch.

| | code | from (arXiv) |
|---|---|---|
| `MixAndMatch` | at random indices what a network makes of h there and z elsewhere; h at the others | 1908.00733 |
| `Concatenate` | a network on [h, z] | MT-VAE: Yan et al. 2018, 1808.04545 |
| `AddProjected` | h + W z; nothing encodes z, which is drawn from its prior | HP-GAN: Barsoum et al. 2018, 1711.09561 |

Each is a description with two modules: what the guide makes of the codes of past and future (`encoder`), and what the
decoder makes of the code of the past and z (`decoder`). A fourth way, a latent for each step (Pose-Knows: Walker et al.
2017, arXiv 1705.00053), is another factorization: `p(z_t) p(x_t | x_{<t}, h, z_t)`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from ..distributions.subset import Subset


class Residual(nn.Module):
    """A linear layer past three others, of which two have half the width and are followed by ReLUs.

    Args:
        size, features: numbers in and out.
    """

    def __init__(self, size: int, features: int) -> None:
        super().__init__()
        half = max(features // 2, 1)
        self.short = nn.Linear(size, features)
        self.long = nn.Sequential(
            *(nn.Linear(size, half), nn.ReLU(), nn.Linear(half, half), nn.ReLU(), nn.Linear(half, features))
        )

    def forward(self, values: Tensor) -> Tensor:
        """(B, features) of (B, size)."""
        made: Tensor = self.short(values) + self.long(values)
        return made


class CodeDecoder(nn.Module):
    """Two layers on a code (B, L), normalised over the batch between them; the code it makes is that of a state.

    In evaluation, and of a single row, the statistics are those of training, so that rows know nothing of each other.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.norm, self.last = nn.Linear(width, width), nn.BatchNorm1d(width), nn.Linear(width, width)

    def forward(self, code: Tensor) -> Tensor:
        """(B, L) of (B, L), between -1 and 1 as states are."""
        norm, learning = self.norm, self.training and len(code) > 1
        mean, var = norm.running_mean, norm.running_var
        made = functional.batch_norm(self.first(code), mean, var, norm.weight, norm.bias, learning, eps=norm.eps)
        return torch.tanh(self.last(functional.relu(made)))


@dataclass(frozen=True)
class MixAndMatch:
    """A share of the code's indices is drawn; a network reads the code there and z at the others.

    What it makes takes the code's place at the drawn indices. So a share alpha of the code is perturbed, and the rest
    goes on as it is: with 0 the code is that of the past alone. Of a code of L numbers z has the L - ceil(alpha L)
    that the network reads at the other indices; another size is brought there by a layer. With alpha = 1 no place is
    left for z.

    The guide reads the code of the past at the drawn indices and that of the future at the others. All of it is by the
    same indices, which the programs draw once for a batch: `DynamicalVAE(shared={"i": noise.indices})`.

    Args:
        alpha: the share, from 0 to 1.
    """

    indices_name: ClassVar[str] = "i"

    alpha: float = 0.5

    def __post_init__(self) -> None:
        Subset(self.alpha)  # which refuses what is no share

    @property
    def indices(self) -> Subset:
        """The law of the drawn indices, as (L,) of ones and zeros."""
        return Subset(self.alpha)

    def latent(self, width: int) -> int:
        """Size of z that the paper has."""
        return max(width - self.indices.chosen(width), 1)

    def encoder(self, width: int) -> nn.Module:
        """The guide's features."""
        return _MixedEncoder(width)

    def decoder(self, width: int, latent: int) -> nn.Module:
        """The code that the future starts from."""
        return _MixedDecoder(width, latent, self.indices.chosen(width))


class _MixedEncoder(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.block = Residual(width, width)

    def forward(self, past: Tensor, future: Tensor, chosen: Tensor | None = None) -> Tensor:
        chosen = _told(chosen)
        features: Tensor = self.block(chosen * past + (1 - chosen) * future)
        return features


class _MixedDecoder(nn.Module):
    def __init__(self, width: int, latent: int, count: int) -> None:
        super().__init__()
        self.latent = latent
        self.layer = None if latent == max(width - count, 1) else nn.Linear(latent, width)
        self.block = Residual(width, count) if count else None
        self.last = CodeDecoder(width)

    def forward(self, past: Tensor, z: Tensor, chosen: Tensor | None = None) -> Tensor:
        chosen = _told(chosen)
        if z.shape[-1] != self.latent:
            raise ValueError(f"z has {z.shape[-1]} numbers, and this code is made for {self.latent}")
        placed = _laid_out(z, chosen < 0.5) if self.layer is None else functional.relu(self.layer(z))
        mixed, code = chosen * past + (1 - chosen) * placed, past
        if self.block is not None:
            code = chosen * _laid_out(self.block(mixed), chosen > 0.5) + (1 - chosen) * past
        made: Tensor = self.last(code)
        return made


def _told(chosen: Tensor | None) -> Tensor:
    if chosen is None:
        raise ValueError("Mix-and-Match perturbs drawn indices; give them, (B, L) of ones and zeros")
    return chosen


def _laid_out(values: Tensor, places: Tensor) -> Tensor:
    """(B, L) with values (B, n) one after the other at n places (B, L)."""
    order = (places.cumsum(-1) - 1).clamp(0, values.shape[-1] - 1)
    return values.gather(-1, order)


def half(width: int) -> int:
    """Of a code, at least 1."""
    return max(width // 2, 1)


@dataclass(frozen=True)
class Concatenate:
    """A network reads the code and z beside each other."""

    def latent(self, width: int) -> int:
        """Half as many as the code has."""
        return half(width)

    def encoder(self, width: int) -> nn.Module:
        """The guide's features."""
        return _Beside(2 * width, width)

    def decoder(self, width: int, latent: int) -> nn.Module:
        """The code that the future starts from."""
        return _Beside(width + latent, width, CodeDecoder(width))


class _Beside(nn.Module):
    def __init__(self, size: int, width: int, last: nn.Module | None = None) -> None:
        super().__init__()
        self.block, self.last = Residual(size, width), last or nn.Identity()

    def forward(self, past: Tensor, other: Tensor, chosen: Tensor | None = None) -> Tensor:
        made: Tensor = self.last(self.block(torch.cat([past, other], -1)))
        return made


@dataclass(frozen=True)
class AddProjected:
    """A linear layer of z is added to the code. There is no encoder: the guide is the prior."""

    def latent(self, width: int) -> int:
        """Half as many as the code has."""
        return half(width)

    def encoder(self, width: int) -> None:
        """There is none."""

    def decoder(self, width: int, latent: int) -> nn.Module:
        """The code that the future starts from."""
        return _Added(width, latent)


class _Added(nn.Module):
    def __init__(self, width: int, latent: int) -> None:
        super().__init__()
        self.layer = nn.Linear(latent, width, bias=False)

    def forward(self, past: Tensor, z: Tensor, chosen: Tensor | None = None) -> Tensor:
        made: Tensor = past + self.layer(z)
        return made


class Noise(Protocol):
    """How noise enters a code: a frozen dataclass such as these."""

    def latent(self, width: int) -> int:
        """Size of z for a code of so many numbers, unless another is given."""

    def encoder(self, width: int) -> nn.Module | None:
        """Of codes of past and future and the drawn indices, the guide's features; None where it is the prior."""

    def decoder(self, width: int, latent: int) -> nn.Module:
        """Of the code of the past, z and the drawn indices, the code that the future starts from."""
