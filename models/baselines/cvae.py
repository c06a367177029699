"""CVAE: futures of a moving body by one latent and a recurrent decoder; the first stage of DLow.

    p(w) p(x_t | x_{<t}, h, w)        q(w | x_{1:T}, h)

One recurrent network summarises the observed poses h for guide and decoder, and another the future x for the guide. The
decoder reads the summary of h, w and, in place of x_{t-1}, its own mean at t-1. At the first step it reads the last
observed pose instead. Gradients flow through these means. Poses are absolute.

Yuan and Kitani, 2020, arXiv 2003.08386, with 725,292 parameters for Human3.6M. With a mixture of normals as the prior,
it is GMVAE (Dilokthanakul et al., 2016, arXiv 1611.02648) without its further latents, as in published comparisons of
motion prediction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from ...data.batch import WHOLE
from ...distributions import DistributionSpec, Mixture
from ...networks import Input, Network, NetworkSpec
from ...networks.base import perceptron
from ...options import Count, Size
from ..motion.futures import HISTORY, FedBackNetwork, FutureMethod, LastState


@dataclass(frozen=True)
class CVAE(FutureMethod):
    """A CVAE with one static latent and a recurrent decoder.

    Args:
        width: units of the recurrent networks.
        hidden: widths of the perceptrons.
        components: number of normals in the prior of w; 1 for N(0, I).
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
    def distributions(self) -> Mapping[str, DistributionSpec]:
        return {**super().distributions(), **({"p(w)": Mixture(self.components)} if self.components > 1 else {})}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        return {"q(w)": SummaryEncoder(self.width, self.hidden), "p(x)": SummaryDecoder(self.width, self.hidden)}


@dataclass(frozen=True)
class SummaryEncoder:
    """Features of w from the last states of recurrent networks over past and future.

    Args:
        width: width of the states.
        hidden: widths of the perceptron that reads both states.
    """

    width: int
    hidden: tuple[int, ...]

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> SummaryEncoderNetwork:
        """Return the network for a child of dimension `size`, local or static, with the parents `inputs`."""
        return SummaryEncoderNetwork(self, inputs)


class SummaryEncoderNetwork(Network):
    """Network of `SummaryEncoder`."""

    def __init__(self, spec: SummaryEncoder, inputs: Sequence[Input]) -> None:
        super().__init__(inputs, False, (2 * spec.width, *spec.hidden)[-1])
        size = next(parent.size for parent in inputs if parent.name == WHOLE)
        self.past, self.future = LastState(size, spec.width), LastState(size, spec.width)
        self.join = perceptron((2 * spec.width, *spec.hidden), "tanh")

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        """Return the features; padding at the end is not read."""
        features: Tensor = self.join(torch.cat([self.past(parents[HISTORY]), self.future(parents[WHOLE], lengths)], -1))
        return features


@dataclass(frozen=True)
class SummaryDecoder:
    """Features of x_t: states of a recurrent network over [summary of h, w, x_{t-1}], and a perceptron.

    The perceptron reads a local latent together with the state.

    Args:
        width: width of the states.
        hidden: widths of the perceptrons from the summary to the first state and after the states.
    """

    width: int
    hidden: tuple[int, ...]

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> SummaryDecoderNetwork:
        """Return the network for a child of dimension `size`, local or static, with the parents `inputs`."""
        return SummaryDecoderNetwork(self, inputs, size)


class SummaryDecoderNetwork(FedBackNetwork):
    """Network of `SummaryDecoder`."""

    def __init__(self, spec: SummaryDecoder, inputs: Sequence[Input], size: int) -> None:
        (latent,) = (parent for parent in inputs if parent.name not in (WHOLE, HISTORY))
        local_latent = (latent.name, latent.size) if latent.relation else None
        super().__init__(
            inputs, spec.width + (0 if local_latent else latent.size), size, spec.width, spec.hidden, local_latent
        )
        self.latent = latent.name
        self.past = LastState(size, spec.width)
        self.first = perceptron((spec.width, *spec.hidden, spec.width), "tanh")

    @override
    def known(self, parents: Mapping[str, Tensor], length: int) -> tuple[Tensor, Tensor, Tensor]:
        code = self.past(parents[HISTORY])
        static = code if self.local_latent else torch.cat([code, parents[self.latent]], -1)
        return static[:, None], parents[HISTORY][:, -self.past.size :], self.first(code)
