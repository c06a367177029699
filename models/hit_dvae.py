"""HiT-DVAE, the hierarchical transformer dynamical VAE: a static latent for what lasts, local ones for what moves.

    p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)        q(w | x_{1:T}) q(z_t | x_{1:T}, w)

Bie et al., 2022, arXiv 2204.01565. There is no public code. This is the paper's pair of factorizations with the generic
attention network, one layer a factor, and the plain evidence bound. The guide does not read z_{<t}, on which the exact
posterior depends. Ours where the paper is silent: the decoder predicts poses, not offsets; the scale of x is one
learned number per coordinate; and scheduled sampling is scaled to the length of training.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from ..networks import Attention, NetworkSpec
from .method import Method


@dataclass(frozen=True)
class HiTDVAE(Method):
    """See the file.

    Args:
        static: size of w.
        width: of the attention of guide and prior.
        heads_count: number of attention heads.
        decoder: width of the attention of x.
        layers: of each factor.
    """

    name: ClassVar[str] = "hit-dvae"
    source: ClassVar[str] = "Bie et al., 2022, arXiv 2204.01565"
    generative: ClassVar[str] = "p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)"
    inference: ClassVar[str] = "q(w | x_{1:T}) q(z_t | x_{1:T}, w)"

    self_feeding: float = 1.0
    static: int = 32
    width: int = 64
    heads_count: int = 4
    decoder: int = 128
    layers: int = 1

    def sizes(self) -> dict[str, int]:
        """Sizes of w and z."""
        return {"w": self.static, "z": self.latent}

    def networks(self) -> Mapping[str, NetworkSpec]:
        """Attention for every factor, wider for x."""
        return {
            "default": Attention(self.width, self.heads_count, self.layers),
            "p(x)": Attention(self.decoder, self.heads_count, self.layers),
        }
