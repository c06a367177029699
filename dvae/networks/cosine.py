"""CosineEncoder and CosineDecoder: transformers between a sequence and the cosine coefficients of a latent sequence.

Step k of the latent is coefficient k. The encoder reads a sequence y and the first step s of the output. Between its
layers, it transforms from time to coefficients:

    h_t = transformer([f(y_t); g(s)] + position)        features_k = transformer(sum_t basis_{kt} h_t)

The decoder transforms back to time and generates a sequence as offsets from the first step:

    o_t = transformer(f([sum_k basis_{kt} z_k; g(s)]) + position)        x_t = s + o_1 + ... + o_t

All steps are computed in parallel. Source: TrajeVAE (Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351), with the
layers of its public implementation. Unlike there, the initial decoder outputs an almost constant sequence.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor, nn
from torch.nn import functional
from typing_extensions import override

from ..factorization.relations import ALL
from .base import FixedLengthNetwork, Input, Network
from .loop import memoize_valid


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # a matrix created in inference mode could not be used under autograd
def cosine_basis(
    length: int, coefficients: int, dtype: torch.dtype = torch.float64, device: torch.device | None = None
) -> Tensor:
    """Return the first rows of the orthonormal DCT-II matrix, w_k cos(pi (t + 1/2) k / T).

    The weights are w_0 = sqrt(1/T), and sqrt(2/T) otherwise, as in Mao, Liu, Salzmann and Li, 2019, arXiv 1908.05436.

    Args:
        length: T, number of steps.
        coefficients: C, number of coefficients, at most T.
        dtype, device: dtype and device of the matrix, which is cached and shared.

    Returns:
        (C, T) with orthonormal rows: `basis @ v` returns the coefficients of a sequence v (T, D), and
        `basis.T @ c` returns the sequence with coefficients c (C, D).

    Raises:
        ValueError: C is not between 1 and T.
    """
    if not 1 <= coefficients <= length:
        raise ValueError(f"`coefficients` must be from 1 to the {length} steps of the sequence, got {coefficients}")
    return torch.from_numpy(scipy.fft.idct(np.eye(coefficients, length), axis=1, norm="ortho")).to(device, dtype)


@dataclass(frozen=True)
class CosineEncoder:
    """A network from one parent read at all steps, such as y_{1:T}, and a static parent, to features by coefficient.

    Args:
        width: W, number of features of each parent; the transformers have 2 W features.
        feedforward: hidden units of the transformer layers.
        heads: number of attention heads.
        layers: layers of each of the three transformers, one before and two after the transform to coefficients.
        dropout: dropout probability in training.
        cosine: whether step k of the child is coefficient k; if False, nothing is transformed, and step t of the child
            is time t.
        components: C, number of low-frequency coefficients to compute, 0 for all; features of the others are 0.
    """

    width: int = 256
    feedforward: int = 512
    heads: int = 4
    layers: int = 2
    dropout: float = 0.1
    cosine: bool = True
    components: int = 0

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> CosineEncoderNetwork:
        """Return the network of a factor, as in `NetworkSpec.build`.

        Args:
            inputs: the parents of the factor.
            local: whether the child has a value at every step; otherwise it is static.
            size: D, dimension of the child.

        Raises:
            ValueError: the child is static, or the parents are not those described above.
        """
        return CosineEncoderNetwork(self, inputs, local)


@dataclass(frozen=True)
class CosineDecoder(CosineEncoder):
    """A network from coefficients and a first step to a sequence (B, T, D).

    The coefficients are a parent over time. The first step is a static parent of size D. Further parents over time are
    concatenated after the transform back to time.

    Args:
        width: W, number of features of the static parent.
        components: C, number of coefficients to read; 0 for all.
        feedforward, heads, layers, dropout, cosine: as in `CosineEncoder`, for a single transformer.
        hidden: number of features of each time step.
        latent: name of the parent that contains the coefficients.
    """

    hidden: int = 512
    latent: str = "z"

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> CosineDecoderNetwork:  # type: ignore[override]
        """Return the network of a factor, as in `NetworkSpec.build`.

        Args:
            inputs: the parents of the factor.
            local: whether the child has a value at every step; otherwise it is static.
            size: D, dimension of the child.

        Raises:
            ValueError: the child is static, or the parents are not those described above.
        """
        return CosineDecoderNetwork(self, inputs, local, size)


def _split_inputs(network: Network, spec: Any) -> tuple[list[Input], Input]:
    """Return the parents over time and the single static parent; raise a ValueError if there are other parents."""
    over_time = [parent for parent in network.inputs if parent.relation is not None]
    static = [parent for parent in network.inputs if parent.relation is None]
    if not network.local or not over_time or len(static) != 1:
        descriptions = ", ".join(f"{p.name} ({'static' if p.relation is None else 'local'})" for p in network.inputs)
        raise ValueError(
            f"{type(spec).__name__} needs a local child, parents over time and exactly one static parent; the child is "
            f"{'local' if network.local else 'static'}, and the parents are {descriptions or 'none'}"
        )
    return over_time, static[0]


class CosineEncoderNetwork(FixedLengthNetwork):
    """Network of `CosineEncoder`; `share_modules` can share `over_time`, `static`, `before` and `between`."""

    def __init__(self, spec: CosineEncoder, inputs: Sequence[Input], local: bool):
        super().__init__(inputs, local, 2 * spec.width)
        (source, *others), static = _split_inputs(self, spec)
        if others or source.relation != ALL:
            raise ValueError(
                "CosineEncoder needs exactly one parent over time, read at all steps as in y_{1:T}; got "
                f"{', '.join(f'{p.name} at {p.relation and p.relation.name}' for p in (source, *others))}"
            )
        self.spec, self.names = spec, (source.name, static.name)
        self.over_time: Any = two_layers(source.size, spec.width)
        self.static: Any = two_layers(static.size, spec.width)
        self.before: Any = transformer(self.features, spec)
        self.between: Any = transformer(self.features, spec)
        self.after: Any = transformer(self.features, spec)
        self.dropout = Dropout(spec.dropout)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        """Return the features (B, T, 2 W); raise a ValueError for a ragged batch."""
        self.refuse_ragged(lengths)
        source, static = (parents[name] for name in self.names)
        first = memoize_valid(self.static, static, None)
        hidden = torch.cat([self.over_time(source), first[:, None].expand(-1, length, -1)], dim=-1)
        hidden = self.before(self.dropout(hidden + positions(length, self.features, hidden.dtype, hidden.device)))
        if self.spec.cosine:
            components = min(self.spec.components or length, length)
            hidden = cosine_basis(length, components, hidden.dtype, hidden.device) @ hidden
        return functional.pad(self.after(self.between(hidden)), (0, 0, 0, length - hidden.shape[1]))


class CosineDecoderNetwork(FixedLengthNetwork):
    """Network of `CosineDecoder`; `share_modules` can share `static`."""

    def __init__(self, spec: CosineDecoder, inputs: Sequence[Input], local: bool, size: int):
        super().__init__(inputs, local, size)
        over_time, static = _split_inputs(self, spec)
        sizes = {parent.name: parent.size for parent in over_time}
        if spec.latent not in sizes or static.size != size:
            raise ValueError(
                f"CosineDecoder needs the parent {spec.latent}_{{1:T}} and, as the first step, a static parent of the "
                f"child's size {size}; got {', '.join(f'{p.name} of size {p.size}' for p in self.inputs)}"
            )
        self.spec, self.first = spec, static.name
        self.others = [name for name in sizes if name != spec.latent]
        self.static: Any = two_layers(size, spec.width)
        into = sum(sizes.values()) + spec.width
        self.into = nn.Sequential(*_layer(into, spec.hidden), nn.Linear(spec.hidden, spec.hidden))
        self.transformer: Any = transformer(spec.hidden, spec)
        last = nn.Linear(spec.hidden, size)
        with torch.no_grad():  # offsets accumulate over time, so the initial ones must be small
            for parameter in last.parameters():
                parameter.mul_(0.01)
        self.offsets = nn.Sequential(*_layer(spec.hidden, spec.hidden), last)
        self.dropout = Dropout(spec.dropout)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        """Return the sequence (B, T, D); raise a ValueError for a ragged batch."""
        self.refuse_ragged(lengths)
        first, values = parents[self.first], parents[self.spec.latent]
        components = min(self.spec.components or length, length)
        values = values[:, :components]
        if self.spec.cosine:
            values = cosine_basis(length, components, values.dtype, values.device).T @ values
        start = memoize_valid(self.static, first, None)
        inputs = [start[:, None].expand(-1, length, -1), values, *(parents[name] for name in self.others)]
        hidden = self.into(torch.cat(inputs, dim=-1))
        hidden = self.transformer(
            self.dropout(hidden + positions(length, hidden.shape[-1], hidden.dtype, hidden.device))
        )
        offsets: Tensor = self.offsets(hidden)
        return first[:, None] + offsets.cumsum(1)


class Dropout(nn.Dropout):
    """Dropout that, on a CPU, uses one random number for four units.

    torch draws one number per unit, which takes a fifth of a training step. Here, the probability is rounded to a
    multiple of 2^-16.
    """

    @override
    def forward(self, input: Tensor) -> Tensor:
        threshold = round((1 - self.p) * 2**16)
        if not (self.training and 0 < threshold < 2**16 and input.device.type == "cpu"):
            return super().forward(input)
        words = torch.empty(-(-input.numel() // 4), dtype=torch.int64).random_(-(2**63), None)
        mask = words.view(torch.int16)[: input.numel()].view(input.shape) < threshold - 2**15
        return input * mask.to(input.dtype).mul_(2**16 / threshold)


class TransformerLayer(nn.TransformerEncoderLayer):
    """A transformer encoder layer with ReLU and normalisation after each part.

    It computes the same as torch's layer, but is faster in training. There, torch's layer builds the gradients of
    queries, keys and values from three zero tensors, and its attention with dropout checks for masks. Both together
    take a fifth of a training step.
    """

    def __init__(self, size: int, heads: int, feedforward: int, dropout: float, **options: Any):
        super().__init__(size, heads, feedforward, dropout, **options)
        self.dropout, self.dropout1, self.dropout2, self.unseen = (Dropout(dropout) for _ in range(4))

    @override
    def forward(self, src: Tensor, *masks: Any, **options: Any) -> Tensor:
        """Return the layer's output; masks are not supported in training."""
        if not self.training:
            return super().forward(src, *masks, **options)
        attention = self.self_attn
        query, key, value = (
            each.unflatten(-1, (attention.num_heads, -1)).transpose(1, 2)
            for each in functional.linear(src, attention.in_proj_weight, attention.in_proj_bias).chunk(3, dim=-1)
        )
        weights = (query @ key.mT / math.sqrt(query.shape[-1])).softmax(-1)
        attended = attention.out_proj((self.unseen(weights) @ value).transpose(1, 2).flatten(2))
        hidden: Tensor = self.norm1(src + self.dropout1(attended))
        hidden = self.norm2(hidden + self.dropout2(self.linear2(self.dropout(self.linear1(hidden).relu()))))
        return hidden


def two_layers(size: int, width: int) -> nn.Sequential:
    """Return two linear layers, each followed by LayerNorm and LeakyReLU, from (..., size) to (..., width)."""
    return nn.Sequential(*_layer(size, width), *_layer(width, width))


def _layer(size: int, out: int) -> list[nn.Module]:
    return [nn.Linear(size, out), nn.LayerNorm(out), nn.LeakyReLU(0.1)]


def transformer(size: int, spec: CosineEncoder) -> nn.TransformerEncoder:
    """Return a transformer encoder on (B, T, size), with normalisation after each part of a layer and at the end."""
    layer = TransformerLayer(size, spec.heads, spec.feedforward, spec.dropout, batch_first=True)
    encoder = nn.TransformerEncoder(layer, spec.layers, nn.LayerNorm(size), enable_nested_tensor=False)
    for parameter in encoder.parameters():  # torch copies one layer, so all would have the same initial weights
        if parameter.dim() > 1:
            nn.init.xavier_uniform_(parameter)
    return encoder


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # as in `cosine_basis`
def positions(length: int, size: int, dtype: torch.dtype, device: torch.device | None = None) -> Tensor:
    """Return sinusoidal position encodings (T, size) (Vaswani et al., 2017)."""
    waves = torch.exp(torch.arange(0, size, 2, dtype=torch.float64) * (-math.log(10000.0) / size))
    phase = torch.arange(length, dtype=torch.float64)[:, None] * waves
    return torch.stack([phase.sin(), phase.cos()], dim=-1).flatten(1)[:, :size].to(device, dtype)
