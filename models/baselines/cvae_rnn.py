"""CVAE-RNN: motion from one pose and any number of joint trajectories, by one latent and a recurrent decoder.

    p(w) p(x_t | x_{<t}, y_{1:T}, w, s)        q(w | r_{1:T}, y_{1:T}, s)

The stochastic baseline of TrajeVAE, with the same variables: y are the given trajectories, r the remaining joints, s
the first pose. Bidirectional recurrent networks summarise y and r; their states are averaged over time. The decoder
reads the summary of y, w, y_t and, in place of x_{t-1}, its own mean at t-1, in training too. At the first step it
reads s instead. Gradients flow through these means. Poses are absolute.

Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351, after the CVAE of Yuan and Kitani, 2020, arXiv 2003.08386. The
positions of the perceptrons are our choice, which reproduces the paper's sizes and number of parameters (913,883 for
Human3.6M). One perceptron is on the summary of y before the decoder reads it, one leads to the decoder's first state,
and one follows its states.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from typing_extensions import override

from ...data.batch import WHOLE
from ...inference.training.options import Training
from ...inference.training.recipe import Recipe
from ...motion import Windows
from ...networks import Input, Network, NetworkSpec
from ...networks.base import perceptron, share_modules
from ...networks.cells import GRU
from ...networks.loop import memoize
from ...options import Size
from ...program.rollout import ScheduledSampling
from ..motion.futures import FedBackNetwork
from ..motion.trajectories import FIRST, GIVEN, REST, LatentTrajectoryMethod


@dataclass(frozen=True)
class CVAERNN(LatentTrajectoryMethod):
    """A CVAE with recurrent summaries and a recurrent decoder.

    Args:
        latent: size of w.
        summary: units of the recurrent summaries, for each direction.
        width: units of the decoder's state.
        hidden: widths of the perceptrons; the last is the width of a summary in the decoder.
    """

    name = "cvae-rnn"
    source = "Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351"
    generative = "p(w) p(x_t | x_{<t}, y_{1:T}, w, s)"
    inference = "q(w | r_{1:T}, y_{1:T}, s)"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        skeleton: {**preset, "beta": 0.1 if skeleton else 1e-4}
        for skeleton, preset in LatentTrajectoryMethod.presets.items()
    }
    """The KL weight has the paper's value for the paper's skeletons; others are tuned (benchmarks/results/tuning)."""
    trainings: ClassVar[Mapping[str, Training]] = {
        **LatentTrajectoryMethod.trainings,
        "": Training(12_000, 16, 1e-3, 0.5),
    }

    latent: Size | None = 256
    summary: Size = 64
    width: Size = 128
    hidden: tuple[Size, ...] = (300, 200, 128)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.hidden:
            raise ValueError("hidden is empty; a perceptron has at least one layer, so give at least one width")

    @override
    def sizes(self) -> dict[str, int]:
        return {"w": self.latent or 0}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return the summaries and the decoder; guide and decoder share the summary of y."""
        return {"q(w)": Summaries(self.summary, self.hidden), "p(x)": Decoder(self.summary, self.hidden, self.width)}

    @override
    def _build_model(self, kind: Any, size: int, *arguments: Any) -> Any:
        model = super()._build_model(kind, size, *arguments)
        share_modules([model.encoder["w"].network.summaries, model.generator["x"].network.summaries], GIVEN)
        model.feeding = ScheduledSampling(1.0, gradient=True)
        return model

    @override
    def train(self, train: Windows, validation: Windows | None = None, steps: int = 2000) -> Recipe:
        """Return the recipe with scheduled sampling at 1: the model only reads its own output."""
        return replace(super().train(train, validation, steps), feeding=1.0)


@dataclass(frozen=True)
class Summaries:
    """Features of a static variable from sequences that start with s.

    Args:
        width: units for each direction.
        hidden: widths of the perceptron on all summaries.
    """

    width: int
    hidden: tuple[int, ...]

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> SummariesNetwork:
        """Return the network for a child of dimension `size`, local or static, with the parents `inputs`."""
        return SummariesNetwork(self, inputs)


class SummariesNetwork(Network):
    """Network of `Summaries`."""

    def __init__(self, spec: Summaries, inputs: Sequence[Input]):
        super().__init__(inputs, False, spec.hidden[-1])
        sizes = {parent.name: parent.size for parent in inputs if parent.name in (GIVEN, REST)}
        self.summaries = nn.ModuleDict({name: Summary(size, spec.width) for name, size in sizes.items()})
        self.join = perceptron((2 * spec.width * len(sizes), *spec.hidden), "tanh")

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        """Return the features; sequences must not be padded."""
        self.refuse_ragged(lengths)
        return self.join(
            torch.cat([summary(parents[FIRST], parents[n]) for n, summary in self.summaries.items()], dim=-1)
        )


class Summary(nn.Module):
    """Mean over time (B, 2 W) of the states of a bidirectional recurrent network over s and a sequence."""

    def __init__(self, size: int, width: int):
        super().__init__()
        self.network = GRU(size, width, batch_first=True, bidirectional=True)

    def forward(self, first: Tensor, sequence: Tensor) -> Tensor:
        """Return the summary of s (B, D) and a sequence (B, T, D)."""
        return memoize(
            self, [first, sequence], lambda: self.network(torch.cat([first[:, None], sequence], 1))[0].mean(1)
        )


@dataclass(frozen=True)
class Decoder:
    """Features of x_t: states of a recurrent network over [summary of y, w, x_{t-1}, y_t], and a perceptron.

    Args:
        summary: units of the summary, for each direction.
        hidden: widths of the perceptrons; the perceptron after the states has no layer of the last width.
        width: units of the state.
    """

    summary: int
    hidden: tuple[int, ...]
    width: int

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> DecoderNetwork:
        """Return the network for a child of dimension `size`, local or static, with the parents `inputs`."""
        return DecoderNetwork(self, inputs, size)


class DecoderNetwork(FedBackNetwork):
    """Network of `Decoder`."""

    def __init__(self, spec: Decoder, inputs: Sequence[Input], size: int):
        sizes = {parent.name: parent.size for parent in inputs}
        (latent,) = sizes.keys() - {WHOLE, GIVEN, FIRST}
        input_size = spec.hidden[-1] + sizes[latent] + sizes[GIVEN]
        super().__init__(inputs, input_size, size, spec.width, spec.hidden[:-1])
        self.latent = latent
        self.summaries = nn.ModuleDict({GIVEN: Summary(sizes[GIVEN], spec.summary)})
        self.before = perceptron((2 * spec.summary, *spec.hidden), "tanh")
        self.first = perceptron((2 * spec.summary, *spec.hidden[:-1], spec.width), "tanh")

    @override
    def known(self, parents: Mapping[str, Tensor], length: int) -> tuple[Tensor, Tensor, Tensor]:
        trajectories = parents[GIVEN]
        summary = self.summaries[GIVEN](parents[FIRST], trajectories)
        static = torch.cat([self.before(summary), parents[self.latent]], -1)
        steps = torch.cat([static[:, None].expand(-1, trajectories.shape[1], -1), trajectories], -1)
        return steps, parents[FIRST], self.first(summary)
