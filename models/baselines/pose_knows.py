"""Pose-Knows: futures of a moving body by a latent for each step and a recurrent decoder.

    p(z_t) p(x_t | x_{<t}, h, z_t)        q(z_t | x_{<=t}, h)

Latents are independent of each other, so that futures jitter. The guide's states start from the summary of the observed
poses h. The decoder is the CVAE's, whose perceptron reads the state and z_t.

Walker, Marino, Gupta and Hebert, 2017, arXiv 1705.00053; we know of no public code. The sizes are from the CVAE of Yuan
and Kitani, 2020, arXiv 2003.08386, as in published comparisons of motion prediction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor
from typing_extensions import override

from ...data.batch import WHOLE
from ...networks import Input, NetworkSpec
from ...networks.base import FixedLengthNetwork
from ...networks.cells import GRU
from ...options import Size
from ..motion.futures import HISTORY, FutureMethod, LastState
from .cvae import SummaryDecoder


@dataclass(frozen=True)
class PoseKnows(FutureMethod):
    """A model with a latent for each step and a recurrent decoder.

    Args:
        width: units of the recurrent networks.
        hidden: widths of the perceptrons.
    """

    name = "pose-knows"
    source = "Walker, Marino, Gupta and Hebert, 2017, arXiv 1705.00053"
    generative = "p(z_t) p(x_t | x_{<t}, h, z_t)"
    inference = "q(z_t | x_{<=t}, h)"

    width: Size = 128
    hidden: tuple[Size, ...] = (300, 200)

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        return {"q(z)": FutureFilter(self.width), "p(x)": SummaryDecoder(self.width, self.hidden)}


@dataclass(frozen=True)
class FutureFilter:
    """Features of z_t: states of a recurrent network over the future up to t, which continues from the past.

    Args:
        width: width of the states.
    """

    width: int

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> FutureFilterNetwork:
        """Return the network for a child of dimension `size`, local or static, with the parents `inputs`."""
        return FutureFilterNetwork(self, inputs)


class FutureFilterNetwork(FixedLengthNetwork):
    """Network of `FutureFilter`."""

    def __init__(self, spec: FutureFilter, inputs: Sequence[Input]) -> None:
        super().__init__(inputs, True, spec.width)
        size = next(parent.size for parent in inputs if parent.name == WHOLE)
        self.past = LastState(size, spec.width)
        self.network = GRU(size, spec.width, batch_first=True)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        states: Tensor = self.network(parents[WHOLE], self.past(parents[HISTORY])[None])[0]
        return states
