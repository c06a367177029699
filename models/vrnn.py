"""The variational recurrent neural network: one recurrent state summarises data and latents of the past.

    p(z_t | x_{<t}, z_{<t}) p(x_t | x_{<t}, z_{<=t})        q(z_t | x_{<=t}, z_{<t})

Chung et al., 2015, arXiv 1506.02216. The guide filters: it does not read x_{>t}, on which the exact posterior depends.
Ours has one recurrent network per factor, where the original shares one among the three.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from ..networks import NetworkSpec, Recurrent
from .method import Method


@dataclass(frozen=True)
class VRNN(Method):
    """See the file.

    Args:
        width: of the recurrent states.
        embed: of the dense layer before them; 0 for none.
        hidden: widths of the perceptron after them.
    """

    name: ClassVar[str] = "vrnn"
    source: ClassVar[str] = "Chung et al., 2015, arXiv 1506.02216"
    generative: ClassVar[str] = "p(z_t | x_{<t}, z_{<t}) p(x_t | x_{<t}, z_{<=t})"
    inference: ClassVar[str] = "q(z_t | x_{<=t}, z_{<t})"

    width: int = 64
    embed: int = 64
    hidden: tuple[int, ...] = (64,)

    def networks(self) -> Mapping[str, NetworkSpec]:
        """A recurrent network for each factor."""
        return {"default": Recurrent(self.width, embed=self.embed, hidden=self.hidden)}
