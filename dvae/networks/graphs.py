"""NodeGraph and FrameGraph: graph convolutions over the coordinates of a frame, and over the frames of a window.

    H' = act(A H W + b)

A is a free adjacency matrix over the nodes, learned separately for each layer (Mao et al., 2019, arXiv 1908.05436).
HiT-DVAE (Bie et al., 2022, arXiv 2204.01565) applies NodeGraph to the inputs of all its factors, and summarises a
sequence with FrameGraph. Unlike in the paper, FrameGraph has no batch normalisation, since the features of a sequence
would then depend on the other sequences of the batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional
from typing_extensions import override

from ..factorization.relations import ALL
from .base import Input, Network
from .extract import Extract, Extractors


@dataclass(frozen=True)
class NodeGraph:
    """Graph convolutions on each frame: an extractor for `Attention`, `SelfAttention`, `FrameGraph` and `Recurrent`.

    Args:
        width: number of features of a node.
        blocks: number of residual blocks with two convolutions each.
        coordinates: number of consecutive entries of a frame that form a node, such as 3 for x, y and z. If the size of
            a frame is not a multiple of it, each entry is a node.
    """

    width: int = 8
    blocks: int = 1
    coordinates: int = 1

    def build(self, size: int) -> NodeFeatures:
        """Return the module that maps frames (..., size) to features (..., nodes * width).

        Args:
            size: D, dimension of a frame.
        """
        return NodeFeatures(self, size)


class NodeFeatures(nn.Module):
    """Module of `NodeGraph`: (..., D) to (..., nodes * width)."""

    def __init__(self, spec: NodeGraph, size: int):
        super().__init__()
        coordinates = 1 if size % spec.coordinates else spec.coordinates
        nodes = size // coordinates
        self.features = nodes * spec.width
        self.first = NodeConvolution(nodes, coordinates, spec.width)
        self.blocks: Any = nn.ModuleList(
            nn.ModuleList(NodeConvolution(nodes, spec.width, spec.width) for _ in range(2)) for _ in range(spec.blocks)
        )

    def forward(self, frames: Tensor) -> Tensor:
        """Return the features of each frame."""
        return self.hoisted()(frames)

    def hoisted(self) -> Callable[[Tensor], Tensor]:
        """Return a faster `forward` for loops, with the products of weights computed in advance."""
        first, *others = (layer.product() for layer in (self.first, *(layer for b in self.blocks for layer in b)))

        def features(frames: Tensor) -> Tensor:
            hidden = torch.tanh(functional.linear(frames, *first))
            for inner, outer in zip(others[::2], others[1::2], strict=True):
                hidden = hidden + torch.tanh(functional.linear(torch.tanh(functional.linear(hidden, *inner)), *outer))
            return hidden

        return features


class NodeConvolution(nn.Module):
    """Weights of A H W + b on frames (..., nodes * features), as one Kronecker product of A and W.

    With few features, this is faster than separate products with A and W for every frame.
    """

    def __init__(self, nodes: int, features: int, out: int):
        super().__init__()
        self.adjacency = nn.Parameter(torch.eye(nodes) + _uniform(nodes, nodes) / math.sqrt(nodes))
        self.weight = nn.Parameter(_uniform(out, features) * math.sqrt(3 / features))
        self.bias = nn.Parameter(_uniform(out) / math.sqrt(features))

    def product(self) -> tuple[Tensor, Tensor]:
        """Return the weight and bias of the equivalent linear layer on whole frames."""
        return torch.kron(self.adjacency, self.weight), self.bias.repeat(len(self.adjacency))


@dataclass(frozen=True)
class FrameGraph:
    """A network that summarises a sequence for a static child, by graph convolutions over a window of its frames.

    A parent is read over {1:T}, but the graph has a fixed number of frames. In training, the window starts at a random
    step, drawn for every sequence at every evaluation; otherwise it contains the first frames. A shorter sequence
    repeats its last frame.

    Args:
        frames: number of frames in the window. Outside training, later frames are ignored.
        width: number of features of a frame.
        blocks: number of residual blocks with two convolutions each.
        extract: extractors by parent, as in `Attention`.
    """

    frames: int
    width: int = 64
    blocks: int = 4
    extract: Extract = field(default_factory=dict)

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> FrameGraphNetwork:
        """Return the network of a factor, as in `NetworkSpec.build`.

        Args:
            inputs: the parents of the factor.
            local: whether the child has a value at every step; otherwise it is static.
            size: D, dimension of the child.

        Raises:
            ValueError: the child is local, or a parent is not read over {1:T}.
        """
        if local or any(p.relation != ALL for p in inputs):
            parents = ", ".join(f"{p.name} ({p.relation.name if p.relation else 'static'})" for p in inputs)
            raise ValueError(
                "FrameGraph needs a static child with parents read over {1:T}, but the child is "
                f"{'local' if local else 'static'} and the parents are {parents}; use networks.SelfAttention or "
                "networks.Attention for this factor"
            )
        return FrameGraphNetwork(self, inputs, size)


class FrameGraphNetwork(Network):
    """Network of `FrameGraph`; its features are the concatenated features of all frames."""

    def __init__(self, spec: FrameGraph, inputs: Sequence[Input], size: int):
        super().__init__(inputs, False, spec.frames * spec.width)
        self.frames = spec.frames
        self.extractors = Extractors(self.inputs, spec.extract, "tanh")
        into = sum(self.extractors.seen(parent).size for parent in self.inputs)
        self.first = FrameConvolution(spec.frames, into, spec.width)
        self.blocks: Any = nn.ModuleList(
            nn.Sequential(*(FrameConvolution(spec.frames, spec.width, spec.width) for _ in range(2)))
            for _ in range(spec.blocks)
        )

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        """Return (B, frames * width)."""
        extracted = self.extractors.of(parents, lengths)
        values = torch.cat([extracted[parent.name] for parent in self.inputs], dim=-1)
        last = values.new_full((len(values),), length - 1, dtype=torch.long) if lengths is None else lengths - 1
        first = torch.zeros_like(last)
        if self.training:
            n_starts = (last + 2 - self.frames).clamp_min(1)  # number of possible starts of the window
            first = (torch.rand(len(values), device=values.device) * n_starts).long()
        window = (first[:, None] + torch.arange(self.frames, device=values.device)).minimum(last[:, None])
        features: Tensor = self.first(values.gather(1, window[..., None].expand(-1, -1, values.shape[-1])))
        for block in self.blocks:
            features = features + block(features)
        return features.flatten(1)


class FrameConvolution(nn.Module):
    """The layer tanh(LN(A H W + b)) on (B, frames, features)."""

    def __init__(self, frames: int, features: int, out: int):
        super().__init__()
        self.adjacency = nn.Parameter(torch.eye(frames) + _uniform(frames, frames) / math.sqrt(frames))
        self.linear = nn.Linear(features, out)
        self.norm = nn.LayerNorm(out)

    def forward(self, values: Tensor) -> Tensor:
        """Return (B, frames, out)."""
        return torch.tanh(self.norm(self.adjacency @ self.linear(values)))


def _uniform(*shape: int) -> Tensor:
    return 2 * torch.rand(shape) - 1
