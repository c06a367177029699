"""The variational recurrent neural network: one recurrent state summarises data and latents of the past.

    p(z_t | x_{<t}, z_{<t}) p(x_t | x_{<t}, z_{<=t})        q(z_t | x_{<=t}, z_{<t})

Chung et al., 2015, arXiv 1506.02216; layer sizes of the public implementation of Girin et al., 2021, arXiv 2008.12595.
All three factors share the state h_t of x_{<t} and z_{<t}, and the dense features of x and of z: the prior reads h_t,
the guide h_t and features of x_t, the decoder h_t and features of z_t. The guide filters: it does not read x_{>t}, on
which the exact posterior depends.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from typing_extensions import override

from ...networks import NetworkSpec, Recurrent
from ...networks.recurrent import tie
from ...options import Share, Size
from ...program.model import DynamicalVAE
from ..method import LatentMethod


@dataclass(frozen=True)
class VRNN(LatentMethod):
    """See the file.

    Args:
        width: of the recurrent state.
        embed: widths of the dense features of x.
        embed_latent: widths of those of z.
        hidden: widths of a perceptron between these and each distribution.
    """

    name = "vrnn"
    source = "Chung et al., 2015, arXiv 1506.02216"
    generative = "p(z_t | x_{<t}, z_{<t}) p(x_t | x_{<t}, z_{<=t})"
    inference = "q(z_t | x_{<=t}, z_{<t})"

    width: Size = 64
    embed: tuple[Size, ...] = (64,)
    embed_latent: tuple[Size, ...] = (16, 32)
    hidden: tuple[Size, ...] = ()
    self_feeding: Share | None = None

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """One kind for each factor; `build` ties them."""
        extract = {"x": self.embed, "z": self.embed_latent}
        return {"default": Recurrent(self.width, extract=extract, hidden=self.hidden, apart=True)}

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """The model, with one h_t for its three factors; a guide that reads indicators has one of its own."""
        model = super().build(data)
        sides = model.generator["x"], *(() if model.indicators else (model.encoder["z"],))
        tie(model.generator["z"].network, *(conditional.network for conditional in sides))
        return model
