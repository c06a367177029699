"""Recurrent network without latents: the baseline likelihood that a model with latents should exceed.

    p(x_t | x_{<t})        no guide: the likelihood is exact

It has the same layers as the other methods of the family (Girin et al., 2021, arXiv 2008.12595), but no latents.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from typing_extensions import override

from ...networks import NetworkSpec, Recurrent
from ...options import Extra, Size
from ..method import LikelihoodMethod


@dataclass(frozen=True)
class Autoregressive(LikelihoodMethod):
    """A recurrent network without latents.

    Args:
        latent: always None; the method has no latents.
        width: width of the recurrent state.
        embed: width of the dense layer before the recurrent network; 0 for none.
        hidden: widths of the perceptron after the recurrent network.
    """

    name = "autoregressive"
    source = "Hochreiter and Schmidhuber, 1997; the baseline without latents"
    generative = "p(x_t | x_{<t})"
    inference = ""

    latent: None = None
    width: Size = 128
    embed: Extra = 0
    hidden: tuple[Size, ...] = (64,)

    @override
    def sizes(self) -> dict[str, int]:
        """Return no sizes: the method has no latents."""
        return {}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return one recurrent network."""
        return {"default": Recurrent(self.width, embed=self.embed, hidden=self.hidden)}
