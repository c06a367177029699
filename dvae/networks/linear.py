"""Linear: an affine network for linear-Gaussian models, whose exact evidence `dvae.program.oracle` computes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from typing_extensions import override

from ..constants import visible
from .base import Input, Network
from .loop import at, select


@dataclass(frozen=True)
class Linear:
    """An affine network: features_t = b_t + sum over parents and their visible steps s of W_ts v_s.

    The features have the child's dimension. The weights depend on t and s, so a guide with this network can represent
    the exact posterior of a linear-Gaussian model.

    Args:
        steps: maximum sequence length.
        scale: standard deviation of the initial weights.
    """

    steps: int = 16
    scale: float = 0.3

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> LinearNetwork:
        """Return the network of a factor, as in `NetworkSpec.build`.

        Args:
            inputs: the parents of the factor.
            local: whether the child has a value at every step; otherwise it is static.
            size: D, dimension of the child.
        """
        return LinearNetwork(self, inputs, local, size)


class LinearNetwork(Network):
    """Network of `Linear` with weights (T, S, H, D); T is 1 for a static child, S is 1 for a static parent."""

    def __init__(self, spec: Linear, inputs: Sequence[Input], local: bool, size: int):
        super().__init__(inputs, local, size)
        self.steps = spec.steps
        rows = spec.steps if local else 1
        self.bias = nn.Parameter(spec.scale * torch.randn(rows, size))
        self.weights = nn.ParameterDict()
        for parent in self.inputs:
            columns = 1 if parent.relation is None else spec.steps
            self.weights[parent.name] = nn.Parameter(spec.scale * torch.randn(rows, columns, size, parent.size))

    def mask(self, name: str, length: int) -> Tensor:
        """Return the mask (T, S), True where the child at step t reads the parent at step s.

        T is 1 for a static child, S is 1 for a static parent. The mask of a custom relation may depend on the length.
        """
        relation = next(parent.relation for parent in self.inputs if parent.name == name)
        if relation is None:
            return torch.ones(1, 1, dtype=torch.bool)
        return torch.as_tensor(relation.mask(length)[: length if self.local else 1])

    def weight(self, name: str, length: int) -> Tensor:
        """Return the masked weights (T or 1, S or 1, H, D) for sequences of `length` steps.

        Raises:
            ValueError: `length` is above the maximum number of steps.
        """
        if length > self.steps:
            raise ValueError(f"Linear(steps={self.steps}) was given {length} steps; build it with steps={length}")
        weight: Tensor = self.weights[name][:length, :length]
        relation = next(parent.relation for parent in self.inputs if parent.name == name)
        if relation is None:
            return weight
        return weight * visible(relation, length, weight.device)[: len(weight), :, None, None]

    def known(self, parents: Mapping[str, Tensor], length: int) -> Tensor:
        """Return the bias plus the contribution of the given parents, (B, T, H), or (T, H) if no parent is given."""
        features: Tensor = self.bias[:length]
        for parent in self.inputs:
            if parent.name in parents:
                values = parents[parent.name]
                values = values[:, None] if parent.relation is None else values
                features = features + torch.einsum("tshd,bsd->bth", self.weight(parent.name, length), values)
        return features

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        if not self.inputs:
            raise ValueError("Linear needs at least one parent, but this factor has none; do not give it a network")
        features = self.known(parents, length)
        return features if self.local else features[:, 0]

    @override
    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        base = self.known(parents, length).expand(batch, -1, -1)
        live = [parent.name for parent in self.inputs if parent.name not in parents]
        return base.unbind(1), {n: (self.weight(n, length), self.mask(n, length).tolist()) for n in live}

    @override
    def step(self, state: Any, t: int, samples: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        base, live = state
        features = base[t]
        for name, (weight, mask) in live.items():
            for s, is_visible in enumerate(mask[t]):
                if is_visible:
                    features = features + at(samples[name], s, features, weight.shape[-1]) @ weight[t, s].t()
        return features, state

    @override
    def select(self, state: Any, rows: Tensor | None) -> Any:
        base, live = state
        return select(base, rows), live
