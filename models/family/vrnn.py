"""Variational recurrent neural network: one recurrent state summarises data and latents of the past.

    p(z_t | x_{<t}, z_{<t}) p(x_t | x_{<t}, z_{<=t})        q(z_t | x_{<=t}, z_{<t})

Chung et al., 2015, arXiv 1506.02216. The layer sizes are from the public implementation of Girin et al., 2021, arXiv
2008.12595. All three factors share the state h_t of x_{<t} and z_{<t}, and the dense features of x and z. The prior
reads h_t, the guide reads h_t and features of x_t, and the decoder reads h_t and features of z_t. The guide is a
filter: it ignores x_{>t}, although the exact posterior depends on x_{>t}.
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
    """A variational recurrent neural network.

    Args:
        width: width of the recurrent state.
        embed: widths of the dense features of x.
        embed_latent: widths of the dense features of z.
        hidden: widths of a perceptron between the state and features and each distribution.
    """

    name = "vrnn"
    source = "Chung et al., 2015, arXiv 1506.02216"
    generative = "p(z_t | x_{<t}, z_{<t}) p(x_t | x_{<t}, z_{<=t})"
    inference = "q(z_t | x_{<=t}, z_{<t})"

    width: Size = 64
    embed: tuple[Size, ...] = (64,)
    embed_latent: tuple[Size, ...] = (16, 32)
    hidden: tuple[Size, ...] = ()
    scheduled_sampling: Share | None = None

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return one kind of network for every factor; `build` ties them."""
        extract = {"x": self.embed, "z": self.embed_latent}
        return {"default": Recurrent(self.width, extract=extract, hidden=self.hidden, join_current=True)}

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """Return the model, whose factors share h_t; a guide that reads indicators of missing data has its own."""
        model = super().build(data)
        sides = model.generator["x"], *(() if model.indicators else (model.encoder["z"],))
        tie(model.generator["z"].network, *(conditional.network for conditional in sides))
        return model
