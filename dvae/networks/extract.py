"""Extractors: modules that map each step of a parent to features, before a network reads the parent over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

from torch import Tensor, nn

from .base import Input, perceptron
from .loop import Rows, extend_features, memoize_valid


class ExtractorSpec(Protocol):
    """Specification of an extractor: a frozen dataclass with a `build` method."""

    def build(self, size: int) -> Any:
        """Return a module from (..., size) to (..., F) with the attribute `features` = F."""
        ...


Extract = Mapping[str, "tuple[int, ...] | ExtractorSpec"]
"""{name of a parent: widths of a perceptron, or the specification of another module}; () for no extractor."""


class Extractors(nn.ModuleDict):
    """The extractors of a network, by name of the parent. Their output is 0 outside the sequence.

    Args:
        inputs: the network's parents.
        extract: specifications, as in `Extract`.
        activation: activation of the perceptrons.
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
        """Return the parent with the size of its extracted features."""
        return replace(parent, size=self.sizes[parent.name]) if parent.name in self else parent

    def of(self, parents: Mapping[str, Tensor], lengths: Tensor | None) -> dict[str, Tensor]:
        """Return the parents, (B, T, D) or (B, D), with extracted features in place of values."""
        return {**parents, **{n: memoize_valid(self[n], parents[n], lengths) for n in self.keys() & parents}}

    def start(self, length: int) -> dict[str, tuple[Any, Rows]]:
        """Return {name: (extractor prepared for a loop, storage for its features at each of `length` steps)}."""
        return {n: (getattr(m, "hoisted", lambda m=m: m)(), Rows([None] * length)) for n, m in self.items()}

    def drawn(
        self, state: Mapping[str, tuple[Any, Rows]], samples: Mapping[str, Sequence[Tensor]], lengths: Tensor | None
    ) -> dict[str, Sequence[Tensor]]:
        """Return the draws of a loop so far with extracted features in place of values; each draw is evaluated once.

        Args:
            state: result of `start`.
            samples: {name: list with the values (B, D) of each step} of the parents that the loop draws.
            lengths: (B,) number of valid steps of each sequence, or None.
        """
        features = {
            n: extend_features(state[n][1], samples[n], self[n], lengths, state[n][0]) for n in self.keys() & samples
        }
        return {**samples, **features}


def share(name: str, *networks: Any) -> None:
    """Share the extractor of a parent among networks.

    All networks use the extractor of the first network that has one. Within `memoizing`, its output is computed once
    for all networks.

    Args:
        name: name of the parent.
        networks: networks with the attribute `extractors`.
    """
    sharing = [network.extractors for network in networks if name in network.extractors]
    for extractors in sharing[1:]:
        extractors[name] = sharing[0][name]
