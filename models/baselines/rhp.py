"""RHP: futures of a moving body from the code of the past plus a random hidden perturbation.

    p(w) p(x_t | x_{<t}, h, w)        q(w), the prior

The decoder is the one of the CVAE of Yuan and Kitani, 2020, arXiv 2003.08386. It reads the sum of the code of h and W
w, with W learned; there is no encoder of w. Training minimises the squared error of draws from the prior. Its minimum
has W = 0, where all draws predict the mean. Futures therefore differ only before training reaches this minimum.

It is the generator of HP-GAN (Barsoum, Kender and Liu, 2018, arXiv 1711.09561) without its adversary, as a baseline of
Mix-and-Match (Aliakbarian et al., 2020, arXiv 1908.00733). HP-GAN's own generator has two layers of 1024 units,
perturbs all of their states, and draws w uniformly from -.1 to .1. Here w is normal, because W learns the scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor
from typing_extensions import override

from ...networks import Input, NetworkSpec
from ...networks.base import perceptron
from ...networks.noise import AddProjected
from ...options import Amount, Size
from ..motion.futures import HISTORY, FedBackNetwork, FutureMethod, LastState


@dataclass(frozen=True)
class RHP(FutureMethod):
    """A model with a random hidden perturbation.

    Args:
        beta: always 0: the guide is the prior, so that the KL is 0.
        width: units of the recurrent networks.
        hidden: widths of the perceptrons.
    """

    name = "rhp"
    source = "Barsoum, Kender and Liu, 2018, arXiv 1711.09561"
    generative = "p(w) p(x_t | x_{<t}, h, w)"
    inference = "q(w)"

    beta: Amount = 0.0
    width: Size = 128
    hidden: tuple[Size, ...] = (300, 200)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.beta:
            raise ValueError(
                f"beta is {self.beta}, but rhp's guide is its prior, so that the KL is 0; leave `beta` at 0"
            )

    @override
    def sizes(self) -> dict[str, int]:
        return {"w": self.latent or 0}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        return {"p(x)": PerturbedDecoder(self.width, self.hidden)}

    @override
    def model_arguments(self, sizes: Mapping[str, int]) -> dict[str, Any]:
        return {**super().model_arguments(sizes), "inference": None}


@dataclass(frozen=True)
class PerturbedDecoder:
    """Features of x_t: states of a recurrent network over [perturbed code of h, x_{t-1}], and a perceptron.

    Args:
        width: width of the states and of the code.
        hidden: widths of the perceptrons from the code to the first state and after the states.
    """

    width: int
    hidden: tuple[int, ...]

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> PerturbedDecoderNetwork:
        """Return the network for a child of dimension `size`, local or static, with the parents `inputs`."""
        return PerturbedDecoderNetwork(self, inputs, size)


class PerturbedDecoderNetwork(FedBackNetwork):
    """Network of `PerturbedDecoder`."""

    def __init__(self, spec: PerturbedDecoder, inputs: Sequence[Input], size: int) -> None:
        super().__init__(inputs, spec.width, size, spec.width, spec.hidden)
        latent = next(parent.size for parent in inputs if parent.name == "w")
        self.past = LastState(size, spec.width)
        self.noise = AddProjected().decoder(spec.width, latent)
        self.first = perceptron((spec.width, *spec.hidden, spec.width), "tanh")

    @override
    def known(self, parents: Mapping[str, Tensor], length: int) -> tuple[Tensor, Tensor, Tensor]:
        code = self.noise(self.past(parents[HISTORY]), parents["w"])
        return code[:, None].expand(-1, length, -1), parents[HISTORY][:, -self.past.size :], self.first(code)
