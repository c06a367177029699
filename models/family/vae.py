"""VAE applied to each frame independently: a dynamical VAE without dynamics.

    p(z_t) p(x_t | z_t)        q(z_t | x_t)

Kingma and Welling, 2014, arXiv 1312.6114. Girin et al., "Dynamical variational autoencoders: a comprehensive review",
2021, arXiv 2008.12595, treat it as a member of the family. The layer sizes are from their public implementation for
motion. Guide and model share no parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from typing_extensions import override

from ...networks import Dense, NetworkSpec
from ...options import Size
from ..method import LatentMethod


@dataclass(frozen=True)
class VAE(LatentMethod):
    """A VAE of single frames.

    Args:
        hidden: widths of the encoder; the decoder has them in reverse order.
    """

    name = "vae"
    source = "Kingma and Welling, 2014, arXiv 1312.6114"
    generative = "p(z_t) p(x_t | z_t)"
    inference = "q(z_t | x_t)"

    hidden: tuple[Size, ...] = (32,)

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return perceptrons that act on single frames."""
        return {"q(z)": Dense(self.hidden), "p(x)": Dense(self.hidden[::-1])}
