"""The stochastic recurrent neural network: a deterministic state of the data's past beside a Markov chain of latents.

    p(z_t | x_{<t}, z_{t-1}) p(x_t | x_{<t}, z_t)        q(z_t | z_{t-1}, x_{1:T})

Fraccaro et al., 2016, arXiv 1605.07571; layer sizes of the public implementation of Girin et al., 2021, arXiv
2008.12595. The recurrent state h_t of x_{<t} is shared by the three factors, as in the paper. The guide's backward
network reads x_t on (the paper's reads h_t too), and h_t joins it. The paper's residual posterior mean is left out, as
in the public implementation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from ..model import DynamicalVAE
from ..networks import NetworkSpec, Recurrent
from ..networks.recurrent import tie_past
from .method import Method


@dataclass(frozen=True)
class SRNN(Method):
    """See the file.

    Args:
        width: of the recurrent states.
        embed: of the dense layer before them.
        hidden: widths of the perceptron after them in prior and guide.
        decoder: widths of the decoder.
    """

    name: ClassVar[str] = "srnn"
    source: ClassVar[str] = "Fraccaro et al., 2016, arXiv 1605.07571"
    generative: ClassVar[str] = "p(z_t | x_{<t}, z_{t-1}) p(x_t | x_{<t}, z_t)"
    inference: ClassVar[str] = "q(z_t | z_{t-1}, x_{1:T})"

    width: int = 64
    embed: int = 64
    hidden: tuple[int, ...] = (32,)
    decoder: tuple[int, ...] = (64,)

    def networks(self) -> Mapping[str, NetworkSpec]:
        """A recurrent network for each factor, of which `build` ties the forward states."""
        around = Recurrent(self.width, embed=self.embed, hidden=self.hidden)
        return {"default": around, "p(x)": Recurrent(self.width, embed=self.embed, hidden=self.decoder)}

    def build(self, data: Mapping[str, int]) -> DynamicalVAE:
        """The model, with one h_t for its three factors."""
        model = super().build(data)
        tie_past(model.generator["z"].network, model.generator["x"].network, model.encoder["z"].network)
        return model
