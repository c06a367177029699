"""CVAE: futures of a moving body by one latent and a recurrent decoder; the first stage of DLow.

    p(w) p(x_t | x_{<t}, h, w)        q(w | x_{1:T}, h)

One recurrent network sums up the observed poses h, for the guide and the decoder, and another the future x, for the
guide. The decoder reads the summary of h, w and its own mean at t-1 (the last observed pose at first) in place of
x_{t-1}; gradients flow through these means. Poses are absolute.

Yuan and Kitani, 2020, arXiv 2003.08386: 725,292 numbers for Human3.6M. Its latent of a mixture of normals is that of
GMVAE (Dilokthanakul et al., 2016, arXiv 1611.02648), in the tables of motion prediction without its further latents.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from ...data.batch import WHOLE
from ...distributions import LawSpec, Mixture
from ...networks import Input, Network, NetworkSpec
from ...networks.base import perceptron
from ...options import Count, Size
from ..motion.futures import HISTORY, FedBackNetwork, FutureMethod, LastState


@dataclass(frozen=True)
class CVAE(FutureMethod):
    """See the file.

    Args:
        width: units of the recurrent networks.
        hidden: widths of perceptrons.
        components: normals of the prior of w; 1 for N(0, I).
    """

    name = "cvae"
    source = "Yuan and Kitani, 2020, arXiv 2003.08386"
    generative = "p(w) p(x_t | x_{<t}, h, w)"
    inference = "q(w | x_{1:T}, h)"

    join: float = 1000.0
    width: Size = 128
    hidden: tuple[Size, ...] = (300, 200)
    components: Count = 1

    @override
    def sizes(self) -> dict[str, int]:
        return {"w": self.latent or 0}

    @override
    def laws(self) -> Mapping[str, LawSpec]:
        return {**super().laws(), **({"p(w)": Mixture(self.components)} if self.components > 1 else {})}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        return {"q(w)": SummaryEncoder(self.width, self.hidden), "p(x)": SummaryDecoder(self.width, self.hidden)}


@dataclass(frozen=True)
class SummaryEncoder:
    """Features of w from the last states of recurrent networks over past and future.

    Args:
        width: of the states.
        hidden: widths of the perceptron on both.
    """

    width: int
    hidden: tuple[int, ...]

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> SummaryEncoderNetwork:
        """The network of a factor with these parents."""
        return SummaryEncoderNetwork(self, inputs)


class SummaryEncoderNetwork(Network):
    """What `SummaryEncoder` describes."""

    def __init__(self, spec: SummaryEncoder, inputs: Sequence[Input]) -> None:
        super().__init__(inputs, False, (2 * spec.width, *spec.hidden)[-1])
        size = next(parent.size for parent in inputs if parent.name == WHOLE)
        self.past, self.future = LastState(size, spec.width), LastState(size, spec.width)
        self.join = perceptron((2 * spec.width, *spec.hidden), "tanh")

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        """Padding at the end is not read."""
        made: Tensor = self.join(torch.cat([self.past(parents[HISTORY]), self.future(parents[WHOLE], lengths)], -1))
        return made


@dataclass(frozen=True)
class SummaryDecoder:
    """Features of x_t: states of a recurrent network over [summary of h, w, x_{t-1}], and a perceptron.

    A latent of each step is read by the perceptron, beside the state.

    Args:
        width: of the states.
        hidden: widths of the perceptrons, on the summary to the first state and behind the states.
    """

    width: int
    hidden: tuple[int, ...]

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> SummaryDecoderNetwork:
        """The network of a factor with these parents."""
        return SummaryDecoderNetwork(self, inputs, size)


class SummaryDecoderNetwork(FedBackNetwork):
    """What `SummaryDecoder` describes."""

    def __init__(self, spec: SummaryDecoder, inputs: Sequence[Input], size: int) -> None:
        (latent,) = (parent for parent in inputs if parent.name not in (WHOLE, HISTORY))
        own = (latent.name, latent.size) if latent.relation else None
        super().__init__(inputs, spec.width + (0 if own else latent.size), size, spec.width, spec.hidden, own)
        self.latent = latent.name
        self.past = LastState(size, spec.width)
        self.first = perceptron((spec.width, *spec.hidden, spec.width), "tanh")

    @override
    def known(self, parents: Mapping[str, Tensor], length: int) -> tuple[Tensor, Tensor, Tensor]:
        code = self.past(parents[HISTORY])
        static = code if self.own else torch.cat([code, parents[self.latent]], -1)
        return static[:, None], parents[HISTORY][:, -self.past.size :], self.first(code)
