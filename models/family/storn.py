"""Stochastic recurrent network: independent latents drive a recurrent network that generates the data.

    p(z_t) p(x_t | x_{<t}, z_{<=t})        q(z_t | x_{<=t})

Bayer and Osendorfer, 2014, arXiv 1411.7610. The layers are from the public implementation of Girin et al., 2021, arXiv
2008.12595. Its guide also reads x_t, whereas the paper's guide reads x_{<t}. Guide and model share no parameters: each
has its own recurrent state over dense features of its parents. All factors are evaluated at all steps at once. The
guide ignores z_{<t} and x_{>t}.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from typing_extensions import override

from ...networks import NetworkSpec, Recurrent
from ...options import Extra, Share, Size
from ..method import LatentMethod


@dataclass(frozen=True)
class STORN(LatentMethod):
    """A stochastic recurrent network.

    Args:
        width: width of the recurrent states.
        embed: width of the dense layer on x; 0 for none.
        embed_latent: width of the dense layer on z; 0 for none.
        hidden: widths of the perceptron after the guide's state.
    """

    name = "storn"
    source = "Bayer and Osendorfer, 2014, arXiv 1411.7610"
    generative = "p(z_t) p(x_t | x_{<t}, z_{<=t})"
    inference = "q(z_t | x_{<=t})"

    width: Size = 64
    embed: Extra = 64
    embed_latent: Extra = 32
    hidden: tuple[Size, ...] = (32,)
    scheduled_sampling: Share | None = None

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return a recurrent network for the guide and another for the data."""
        layers = {"x": self.embed, "z": self.embed_latent}
        extract = {name: (width,) for name, width in layers.items() if width}
        return {
            "q(z)": Recurrent(self.width, extract=extract, hidden=self.hidden),
            "p(x)": Recurrent(self.width, extract=extract, hidden=()),
        }
