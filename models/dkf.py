"""The deep Kalman filter, or deep Markov model: a Markov chain of latents behind independent frames.

    p(z_t | z_{t-1}) p(x_t | z_t)        q(z_t | z_{t-1}, x_{t:T})

Krishnan, Shalit and Sontag, 2015 and 2017, arXiv 1511.05121 and 1609.09869. The guide has the dependencies of the
exact posterior. Its backward network reads the present and the future; the past reaches z_t through z_{t-1}.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from ..networks import Dense, NetworkSpec, Recurrent
from .method import Method


@dataclass(frozen=True)
class DKF(Method):
    """See the file.

    Args:
        width: of the guide's recurrent state.
        hidden: widths of the transition.
        decoder: widths of the decoder.
    """

    name: ClassVar[str] = "dkf"
    source: ClassVar[str] = "Krishnan, Shalit and Sontag, 2015, arXiv 1511.05121"
    generative: ClassVar[str] = "p(z_t | z_{t-1}) p(x_t | z_t)"
    inference: ClassVar[str] = "q(z_t | z_{t-1}, x_{t:T})"

    width: int = 64
    hidden: tuple[int, ...] = (32,)
    decoder: tuple[int, ...] = (32, 64)

    def networks(self) -> Mapping[str, NetworkSpec]:
        """A perceptron for the transition and the emission, a backward network for the guide."""
        return {
            "p(z)": Dense(self.hidden),
            "p(x)": Dense(self.decoder),
            "q(z)": Recurrent(self.width, embed=self.width, hidden=(32,)),
        }
