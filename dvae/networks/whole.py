"""WholeEncoder and WholeDecoder: perceptrons between static variables and whole sequences of fixed length.

The encoder reads the concatenation of all steps of its parents. The decoder generates all steps of a variable from
static parents, with separate weights of the last layer for each step. Variables of one program with the same parents
can share the perceptron; each then uses its own coordinates of the output.

Source: the latent space of Marsot et al. (2021, arXiv 2106.04387).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch
from torch import Tensor, nn
from torch.nn import functional
from typing_extensions import override

from ..factorization.relations import ALL
from .base import FixedLengthNetwork, Input, Network, perceptron
from .loop import memoize


@dataclass(frozen=True)
class WholeEncoder:
    """A perceptron from all steps of the parents, and from static parents, to features of a static child.

    Args:
        length: N, maximum number of steps; shorter sequences are padded with zeros at the end.
        widths: widths of the layers, each followed by the activation.
        activation: "tanh", "relu", "gelu" or "elu".
    """

    length: int
    widths: tuple[int, ...] = (512, 256)
    activation: str = "relu"

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> WholeEncoderNetwork:
        """Return the network of a factor, as in `NetworkSpec.build`.

        Args:
            inputs: the parents of the factor.
            local: whether the child has a value at every step; otherwise it is static.
            size: D, dimension of the child.

        Raises:
            ValueError: the child is local, or the factor does not read all steps of a parent.
        """
        return WholeEncoderNetwork(self, inputs, local)


@dataclass(frozen=True)
class WholeDecoder(WholeEncoder):
    """A perceptron from static parents to all steps of a local child.

    Args:
        length: N, maximum number of steps.
        widths: widths of the hidden layers, each followed by the activation; the last layer is linear.
        activation: as in `WholeEncoder`.
        sizes: {name: dimension} of the variables that share the perceptron, in the order of their coordinates in its
            output; None if the child does not share it.
        name: name of the child, which selects its coordinates.
    """

    sizes: Mapping[str, int] | None = None
    name: str = "x"

    @override
    def build(self, inputs: Sequence[Input], local: bool, size: int) -> WholeDecoderNetwork:  # type: ignore[override]
        """Return the network of a factor, as in `NetworkSpec.build`.

        Args:
            inputs: the parents of the factor.
            local: whether the child has a value at every step; otherwise it is static.
            size: D, dimension of the child.

        Raises:
            ValueError: the child is static, a parent is not static, or `sizes` has another dimension for the child.
        """
        return WholeDecoderNetwork(self, inputs, local, size)


def _check_length(steps: int, length: int) -> None:
    if steps > length:
        raise ValueError(f"this network supports at most {length} steps, got {steps}; build it with length={steps}")


class WholeEncoderNetwork(Network):
    """Network of `WholeEncoder`."""

    def __init__(self, spec: WholeEncoder, inputs: Sequence[Input], local: bool):
        partial = [parent.name for parent in inputs if parent.relation not in (None, ALL)]
        if local or partial:
            reason = "the child is local" if local else f"not all of {', '.join(partial)} may be read"
            raise ValueError(
                f"WholeEncoder needs a static child and parents read at all steps (x_{{1:T}}), but {reason}"
            )
        super().__init__(inputs, False, spec.widths[-1])
        self.length = spec.length
        sizes = [parent.size * (1 if parent.relation is None else spec.length) for parent in inputs]
        self.layers = perceptron([sum(sizes), *spec.widths], spec.activation)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        _check_length(length, self.length)
        parts = [parents[parent.name] for parent in self.inputs]
        padding = self.length - length
        flat = [part if part.dim() == 2 else functional.pad(part, (0, 0, 0, padding)).flatten(1) for part in parts]
        features: Tensor = self.layers(torch.cat(flat, -1))
        return features


class Trunk(nn.Module):
    """A perceptron with a linear last layer, from static parents (B, S) to all steps (B, N, D).

    Args:
        size: S, total dimension of the parents.
        spec: N and the widths.
        numbers: D, total dimension of the variables that share the perceptron.
    """

    def __init__(self, size: int, spec: WholeDecoder, numbers: int):
        super().__init__()
        self.hidden = perceptron([size, *spec.widths], spec.activation)
        self.out = nn.Linear((size, *spec.widths)[-1], spec.length * numbers)
        self.length = spec.length

    def forward(self, parents: Sequence[Tensor]) -> Tensor:
        """Return all steps of all variables, (B, N, D)."""
        return self.made(self.features(parents))

    def features(self, parents: Sequence[Tensor]) -> Tensor:
        """Return the features (B, H) that determine all steps."""
        features: Tensor = self.hidden(torch.cat(list(parents), -1))
        return features

    def made(self, features: Tensor, steps: Tensor | None = None, coordinates: slice = slice(None)) -> Tensor:
        """Return values (B, N, D) from features (B, H); compute only `steps` (K,) and `coordinates` if given."""
        weight, bias = (part.unflatten(0, (self.length, -1))[:, coordinates] for part in self.out.parameters())
        if steps is not None:
            weight, bias = weight[steps], bias[steps]
        values: Tensor = functional.linear(features, weight.flatten(0, 1), bias.flatten()).unflatten(-1, bias.shape)
        return values


class WholeDecoderNetwork(FixedLengthNetwork):
    """Network of `WholeDecoder`."""

    def __init__(self, spec: WholeDecoder, inputs: Sequence[Input], local: bool, size: int):
        if not local or any(parent.relation is not None for parent in inputs):
            parents = ", ".join(f"{p.name} ({p.relation.name if p.relation else 'static'})" for p in inputs)
            raise ValueError(
                "WholeDecoder needs a local child with only static parents, such as p(x_t | z), but the child is "
                f"{'local' if local else 'static'} and the parents are {parents}"
            )
        super().__init__(inputs, True, size)
        sizes = spec.sizes or {spec.name: size}
        if sizes.get(spec.name) != size:
            raise ValueError(
                f"{spec.name} has size {size}, but `sizes` of the shared perceptron is {dict(sizes)}; correct `sizes`"
            )
        ends = dict(zip(sizes, accumulate(sizes.values()), strict=True))
        self.places = slice(ends[spec.name] - size, ends[spec.name])
        self.trunk = Trunk(sum(parent.size for parent in inputs), spec, sum(sizes.values()))

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        _check_length(length, self.trunk.length)
        values = [parents[parent.name] for parent in self.inputs]
        steps: Tensor = memoize(self.trunk, values, lambda: self.trunk(values))[:, :length, self.places]
        return steps
