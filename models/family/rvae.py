"""The recurrent VAE, causal and non-causal: independent latents, all of which a frame may read.

    p(z_t) p(x_t | z_{<=t})        q(z_t | z_{<t}, x_{t:T})        causal
    p(z_t) p(x_t | z_{1:T})        q(z_t | z_{<t}, x_{1:T})        non-causal

Leglaive et al., 2020, arXiv 1910.10942; layers of the public implementation of Girin et al., 2021, arXiv 2008.12595.
"Causal" is the generative model; its guide reads the future. Recurrent states and nothing else: one over z for the
decoder (and a backward one, non-causal), one over z_{<t} and one or two over x for the guide, none shared.
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
    """See the file.

    Args:
        width: of the recurrent states.
        hidden: widths of a perceptron between these and each distribution.
    """

    name = "rvae-causal"
    source = "Leglaive et al., 2020, arXiv 1910.10942"
    generative = "p(z_t) p(x_t | z_{<=t})"
    inference = "q(z_t | z_{<t}, x_{t:T})"

    width: Size = 64
    hidden: tuple[Size, ...] = ()

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """A recurrent state for each variable and direction."""
        return {"default": Recurrent(self.width, hidden=self.hidden, separate=True)}


@dataclass(frozen=True)
class NonCausalRVAE(CausalRVAE):
    """See the file.

    Args:
        width: of the recurrent states.
        hidden: widths of a perceptron between these and each distribution.
    """

    name = "rvae-noncausal"
    generative = "p(z_t) p(x_t | z_{1:T})"
    inference = "q(z_t | z_{<t}, x_{1:T})"
