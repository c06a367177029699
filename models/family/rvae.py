"""Recurrent VAE, causal and non-causal: frames read the whole sequence of independent latents or its past.

    p(z_t) p(x_t | z_{<=t})        q(z_t | z_{<t}, x_{t:T})        causal
    p(z_t) p(x_t | z_{1:T})        q(z_t | z_{<t}, x_{1:T})        non-causal

Leglaive et al., 2020, arXiv 1910.10942. The layers are from the public implementation of Girin et al., 2021, arXiv
2008.12595. "Causal" refers to the generative model; its guide reads the future. All layers are recurrent and none is
shared. The decoder has a forward network over z and, if non-causal, a backward one. The guide has one network over
z_{<t} and one or two over x.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from typing_extensions import override

from ...networks import NetworkSpec, Recurrent
from ...options import Size
from ..method import LatentMethod


@dataclass(frozen=True)
class CausalRVAE(LatentMethod):
    """A causal recurrent VAE.

    Args:
        width: width of the recurrent states.
        hidden: widths of a perceptron between the states and each distribution.
    """

    name = "rvae-causal"
    source = "Leglaive et al., 2020, arXiv 1910.10942"
    generative = "p(z_t) p(x_t | z_{<=t})"
    inference = "q(z_t | z_{<t}, x_{t:T})"

    width: Size = 64
    hidden: tuple[Size, ...] = ()

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return recurrent networks with one state for each variable and direction."""
        return {"default": Recurrent(self.width, hidden=self.hidden, separate=True)}


@dataclass(frozen=True)
class NonCausalRVAE(CausalRVAE):
    """A non-causal recurrent VAE.

    Args:
        width: width of the recurrent states.
        hidden: widths of a perceptron between the states and each distribution.
    """

    name = "rvae-noncausal"
    generative = "p(z_t) p(x_t | z_{1:T})"
    inference = "q(z_t | z_{<t}, x_{1:T})"
