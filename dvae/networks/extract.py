"""Extractors: features of a parent at single steps, before a network reads it over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

from torch import Tensor, nn

from .base import Input, perceptron
from .loop import Rows, follow, once_valid


class ExtractorSpec(Protocol):
    """A description of an extractor: a frozen dataclass that `build`s one for a parent of dimension `size`."""

    def build(self, size: int) -> Any:
        """A module from (..., size) to (..., F), with F as its attribute `features`."""
        ...


Extract = Mapping[str, "tuple[int, ...] | ExtractorSpec"]
"""Name of a parent to the widths of a perceptron on it, or to the description of another module; () for none."""


class Extractors(nn.ModuleDict):
    """The extractors of a network by parent. Outside the sequence what they give is 0.

    Args:
        inputs: the network's parents.
        extract: see `Extract`.
        activation: of perceptrons.
    """

    def __init__(self, inputs: Sequence[Input], extract: Extract, activation: str):
        super().__init__()
        self.sizes: dict[str, int] = {}
        for parent in inputs:
            spec = extract.get(parent.name)
            if isinstance(spec, tuple) and spec:
                self[parent.name], self.sizes[parent.name] = perceptron((parent.size, *spec), activation), spec[-1]
            elif spec:
                module = spec.build(parent.size)  # type: ignore[union-attr]
                self[parent.name], self.sizes[parent.name] = module, module.features

    def seen(self, parent: Input) -> Input:
        """The parent as the network reads it."""
        return replace(parent, size=self.sizes[parent.name]) if parent.name in self else parent

    def of(self, parents: Mapping[str, Tensor], lengths: Tensor | None) -> dict[str, Tensor]:
        """What the network reads of its parents (B, T, D) or (B, D)."""
        return {**parents, **{n: once_valid(self[n], parents[n], lengths) for n in self.keys() & parents}}

    def start(self, length: int) -> dict[str, tuple[Any, Rows]]:
        """What `drawn` evaluates in a loop, with what can be done before it done, and where it keeps what it finds."""
        return {n: (getattr(m, "hoisted", lambda m=m: m)(), Rows([None] * length)) for n, m in self.items()}

    def drawn(
        self, kept: Mapping[str, tuple[Any, Rows]], drawn: Mapping[str, Sequence[Tensor]], lengths: Tensor | None
    ) -> dict[str, Sequence[Tensor]]:
        """The draws of a loop so far as the network reads them; each passes through its extractor once."""
        found = {n: follow(kept[n][1], drawn[n], self[n], lengths, kept[n][0]) for n in self.keys() & drawn}
        return {**drawn, **found}


def share(name: str, *networks: Any) -> None:
    """Gives networks one extractor of a parent, that of the first which has one.

    What it finds is evaluated once for all of them (see `once`).
    """
    held = [network.extractors for network in networks if name in network.extractors]
    for extractors in held[1:]:
        extractors[name] = held[0][name]
