"""Dense: a multilayer perceptron on the parents at single steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor
from typing_extensions import override

from .base import Chain, Input, Join, Network, at, shift


@dataclass(frozen=True)
class Dense:
    """A multilayer perceptron on pointwise parents (z_t, z_{t-1}, x_{t-3:t-1}, w).

    Args:
        widths: of the layers; () for none, the features are then the parents.
        activation: "tanh", "relu", "gelu" or "elu".
    """

    widths: tuple[int, ...] = (64,)
    activation: str = "tanh"

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> DenseNetwork:
        """The network of a factor with these parents."""
        return DenseNetwork(inputs, local, self.widths, self.activation)


class DenseNetwork(Network):
    """What `Dense` describes."""

    def __init__(self, inputs: Sequence[Input], local: bool, widths: Sequence[int], activation: str):
        super().__init__(inputs, local, 0)
        self.parts: list[tuple[Input, int | None]] = []
        for parent in self.inputs:
            if parent.relation is None:
                self.parts.append((parent, None))
            elif local and parent.lags is not None:
                self.parts += [(parent, lag) for lag in parent.lags]
            else:
                raise ValueError(
                    f"Dense reads single steps of its parents, but {parent.name} is read at {parent.relation.name}; "
                    "use networks.Recurrent or networks.Attention for this factor"
                )
        self.join = Join([parent.size for parent, _ in self.parts], widths, activation)
        self.features = self.join.features

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        features: Tensor = self.join([part(parents[parent.name], lag) for parent, lag in self.parts])
        return features[:, None].expand(-1, length, -1) if self.local and features.dim() == 2 else features

    @override
    def start(self, given: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        known = {i: part(given[p.name], lag) for i, (p, lag) in enumerate(self.parts) if p.name in given}
        live = [entry for i, entry in enumerate(self.parts) if i not in known]
        return self.join.hoist(known, batch, length), live

    @override
    def step(self, state: Any, t: int, drawn: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        hoisted, live = state
        parts = [at(drawn[parent.name], t + lag, hoisted.like, parent.size) for parent, lag in live]
        return self.join.add(hoisted, t, parts), state

    @override
    def chain(self, state: Any) -> Chain | None:
        hoisted, live = state
        return Chain(live[0][1], self.join, hoisted) if len(live) == 1 else None


def part(values: Tensor, lag: int | None) -> Tensor:
    """A parent's contribution at every step: itself if static, else shifted by its lag."""
    return values if lag is None else shift(values, lag)
