"""Dense: a multilayer perceptron on the parents at single steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from .base import Input
from .recurrent import Recurrent, RecurrentNetwork


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
        return DenseNetwork(self, inputs, local)


class DenseNetwork(RecurrentNetwork):
    """What `Dense` describes: a recurrent network without a memory."""

    def __init__(self, spec: Dense, inputs: Sequence[Input], local: bool):
        for parent in inputs:
            if parent.relation is not None and not (local and parent.lags is not None):
                raise ValueError(
                    f"Dense reads single steps of its parents, but {parent.name} is read at {parent.relation.name}; "
                    "use networks.Recurrent or networks.Attention for this factor"
                )
        super().__init__(Recurrent(hidden=spec.widths, activation=spec.activation), inputs, local)
