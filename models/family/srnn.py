"""Stochastic recurrent neural network: a deterministic state of past data and a Markov chain of latents.

    p(z_t | x_{<t}, z_{t-1}) p(x_t | x_{<t}, z_t)        q(z_t | z_{t-1}, x_{1:T})

Fraccaro et al., 2016, arXiv 1605.07571. The layers are from the public implementation of Girin et al., 2021, arXiv
2008.12595. The three factors share the recurrent state h_t of x_{<t}. The guide's backward network reads h_t and x_t;
in the guide, only its state is joined with z_{t-1}. As in the public implementation, the paper's residual posterior
mean is omitted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from typing_extensions import override

from ...networks import NetworkSpec, Recurrent
from ...networks.recurrent import tie
from ...options import Extra, Share, Size
from ...program.model import DynamicalVAE
from ..method import LatentMethod


@dataclass(frozen=True)
class SRNN(LatentMethod):
    """A stochastic recurrent neural network.

    Args:
        width: width of the recurrent states.
        embed: width of the dense layer before the recurrent networks.
        hidden: widths of the perceptron after the recurrent networks in prior and guide.
        decoder: widths of the decoder.
    """

    name = "srnn"
    source = "Fraccaro et al., 2016, arXiv 1605.07571"
    generative = "p(z_t | x_{<t}, z_{t-1}) p(x_t | x_{<t}, z_t)"
    inference = "q(z_t | z_{t-1}, x_{1:T})"

    width: Size = 64
    embed: Extra = 64
    hidden: tuple[Size, ...] = (32,)
    decoder: tuple[Size, ...] = (64,)
    scheduled_sampling: Share | None = None

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return a recurrent network for each factor; `build` ties their forward states."""
        around = Recurrent(self.width, embed=self.embed, hidden=self.hidden)
        return {"p(z)": around, "p(x)": replace(around, hidden=self.decoder), "q(z)": replace(around, stack=True)}

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """Return the model, whose factors share h_t; a guide that reads indicators of missing data has its own."""
        model = super().build(data)
        sides = model.generator["x"], *(() if model.indicators else (model.encoder["z"],))
        tie(model.generator["z"].network, *(conditional.network for conditional in sides))
        return model
