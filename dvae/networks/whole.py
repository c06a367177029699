"""WholeEncoder and WholeDecoder: perceptrons between sequences of one length, seen whole, and what is static.

The encoder reads all steps of its parents side by side. The decoder makes all steps of a variable from static parents:
each step has a part of the last layer of its own. Variables of one program that are made from the same parents can
share the perceptron, so that each takes its coordinates of what that makes.

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
from .base import AtOnce, Input, Network, perceptron
from .loop import once


@dataclass(frozen=True)
class WholeEncoder:
    """Features of a static child from all steps of its parents, and from static ones.

    Args:
        length: N, steps of a sequence. Shorter ones are zero behind their end.
        widths: of the layers, each followed by the activation.
        activation: "tanh", "relu", "gelu" or "elu".
    """

    length: int
    widths: tuple[int, ...] = (512, 256)
    activation: str = "relu"

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> WholeEncoderNetwork:
        """The network of a factor with these parents.

        Raises:
            ValueError: a local child, or a parent of which it may not read all steps.
        """
        return WholeEncoderNetwork(self, inputs, local)


@dataclass(frozen=True)
class WholeDecoder(WholeEncoder):
    """All steps of a child from static parents.

    Args:
        length: N, steps that are made.
        widths: of the hidden layers, each followed by the activation; the last layer is linear.
        activation: see `WholeEncoder`.
        sizes: dimensions of the variables that share the perceptron, by name, in the order of their coordinates.
        name: which of them the child is.
    """

    sizes: Mapping[str, int] | None = None
    name: str = "x"

    @override
    def build(self, inputs: Sequence[Input], local: bool, size: int) -> WholeDecoderNetwork:  # type: ignore[override]
        """The network of a factor with these parents.

        Raises:
            ValueError: a static child, or a parent that is not static.
        """
        return WholeDecoderNetwork(self, inputs, local, size)


def _refuse(steps: int, length: int) -> None:
    if steps > length:
        raise ValueError(f"this network is for {length} steps at most, and was given {steps}")


class WholeEncoderNetwork(Network):
    """What `WholeEncoder` describes."""

    def __init__(self, spec: WholeEncoder, inputs: Sequence[Input], local: bool):
        partial = [parent.name for parent in inputs if parent.relation not in (None, ALL)]
        if local or partial:
            why = "the child is local" if local else f"not all of {', '.join(partial)} may be read"
            raise ValueError(f"WholeEncoder makes a static child of all steps of its parents (x_{{1:T}}); {why}")
        super().__init__(inputs, False, spec.widths[-1])
        self.length = spec.length
        sizes = [parent.size * (1 if parent.relation is None else spec.length) for parent in inputs]
        self.layers = perceptron([sum(sizes), *spec.widths], spec.activation)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        _refuse(length, self.length)
        parts = [parents[parent.name] for parent in self.inputs]
        behind = self.length - length
        flat = [part if part.dim() == 2 else functional.pad(part, (0, 0, 0, behind)).flatten(1) for part in parts]
        features: Tensor = self.layers(torch.cat(flat, -1))
        return features


class Trunk(nn.Module):
    """(B, N, D) of (B, S): a perceptron whose last layer is linear."""

    def __init__(self, size: int, spec: WholeDecoder, numbers: int):
        super().__init__()
        self.hidden = perceptron([size, *spec.widths], spec.activation)
        self.out = nn.Linear((size, *spec.widths)[-1], spec.length * numbers)
        self.length = spec.length

    def forward(self, given: Sequence[Tensor]) -> Tensor:
        """All steps of all variables."""
        return self.made(self.features(given))

    def features(self, given: Sequence[Tensor]) -> Tensor:
        """What all steps are made of, (B, H)."""
        found: Tensor = self.hidden(torch.cat(list(given), -1))
        return found

    def made(self, features: Tensor, steps: Tensor | None = None, coordinates: slice = slice(None)) -> Tensor:
        """Steps of features: all, or these (K,) and these coordinates alone, of which no other is computed."""
        weight, bias = (part.unflatten(0, (self.length, -1))[:, coordinates] for part in self.out.parameters())
        if steps is not None:
            weight, bias = weight[steps], bias[steps]
        made: Tensor = functional.linear(features, weight.flatten(0, 1), bias.flatten()).unflatten(-1, bias.shape)
        return made


class WholeDecoderNetwork(AtOnce):
    """What `WholeDecoder` describes."""

    def __init__(self, spec: WholeDecoder, inputs: Sequence[Input], local: bool, size: int):
        if not local or any(parent.relation is not None for parent in inputs):
            raise ValueError("WholeDecoder makes a local child of static parents alone, such as p(x_t | z)")
        super().__init__(inputs, True, size)
        sizes = spec.sizes or {spec.name: size}
        if sizes.get(spec.name) != size:
            raise ValueError(f"{spec.name} has {size} coordinates, and the sizes of those who share are {dict(sizes)}")
        ends = dict(zip(sizes, accumulate(sizes.values()), strict=True))
        self.places = slice(ends[spec.name] - size, ends[spec.name])
        self.trunk = Trunk(sum(parent.size for parent in inputs), spec, sum(sizes.values()))

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        _refuse(length, self.trunk.length)
        given = [parents[parent.name] for parent in self.inputs]
        made: Tensor = once(self.trunk, given, lambda: self.trunk(given))[:, :length, self.places]
        return made
