"""The recurrent network without latents: the likelihood that every latent must beat.

    p(x_t | x_{<t})        no guide: the likelihood is exact

Its layers are those of the other methods of the family (Girin et al., 2021, arXiv 2008.12595), which have latents
beside them.
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
    """See the file.

    Args:
        latent: there is none.
        width: of the recurrent state.
        embed: of the dense layer before it; 0 for none.
        hidden: widths of the perceptron after it.
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
        """No latents."""
        return {}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """One recurrent network."""
        return {"default": Recurrent(self.width, embed=self.embed, hidden=self.hidden)}
