"""Deep Kalman filter, or deep Markov model: a Markov chain of latents, and frames that are independent given z.

    p(z_t | z_{t-1}) p(x_t | z_t)        q(z_t | z_{t-1}, x_{t:T})

Krishnan, Shalit and Sontag, 2015 and 2017, arXiv 1511.05121 and 1609.09869. The layers are from the public
implementation of Girin et al., 2021, arXiv 2008.12595. The transition is gated: its mean mixes a linear and a nonlinear
proposal. The guide averages features of z_{t-1} and a backward recurrent state of x_{t:T}; it has the dependencies of
the exact posterior. Guide and model share no parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional
from typing_extensions import override

from ...distributions.base import DistributionSpec, Parameters, Shape
from ...distributions.families import Gaussian
from ...networks import Dense, Input, NetworkSpec, Recurrent
from ...networks.base import Network, aligned
from ...networks.loop import at, shift
from ...options import Extra, Size
from ..method import LatentMethod


@dataclass(frozen=True)
class Gated:
    """The transition of Krishnan et al., 2017, equation 13: gate, proposal and linear part of z_{t-1}.

        g = sigmoid(MLP(z))    h = MLP(z)    mean = (1 - g) * L(z) + g * h    variance = softplus(L(relu(h)))

    Gate and proposal also read parents at t, such as covariates and the time since t-1. The features are the mean and
    relu(h); `GatedNormal` is the matching distribution.
    """

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> GatedTransition:
        """Return the network of a factor p(z_t | z_{t-1}, ...), z_{t-1} first; other parents are static or at t."""
        fits = bool(inputs) and inputs[0].lags == (-1,) and inputs[0].size == size
        if not fits or any(parent.relation and parent.lags != (0,) for parent in inputs[1:]):
            raise ValueError(
                "a gated transition needs z_{t-1} as first parent of z_t, and other parents that are static or at t; "
                f"got {inputs}"
            )
        return GatedTransition(inputs, size)


class GatedTransition(Network):
    """Network of `Gated`."""

    stationary = True

    def __init__(self, inputs: Sequence[Input], size: int):
        super().__init__(inputs, True, 2 * size)
        previous, *others = inputs
        self.name, self.size, self.others = previous.name, size, [parent.name for parent in others]
        width = size + sum(parent.size for parent in others)
        self.gate, self.proposal = (
            nn.Sequential(nn.Linear(width, size), nn.ReLU(), nn.Linear(size, size)) for _ in range(2)
        )
        self.linear = nn.Linear(size, size)

    def _features(self, previous: Tensor, others: Tensor) -> Tensor:
        inputs = torch.cat([previous, others], -1)
        proposal = self.proposal(inputs)
        mean = torch.lerp(self.linear(previous), proposal, torch.sigmoid(self.gate(inputs)))
        return torch.cat([mean, functional.relu(proposal)], dim=-1)

    def _other_parents(self, parents: Mapping[str, Tensor], batch: int, length: int) -> Tensor:
        """Return the parents other than z_{t-1}, concatenated to (B, T, E), for `batch` sequences of `length` steps."""
        empty = self.linear.weight.new_empty(batch, length, 0)
        return torch.cat(aligned([empty, *(parents[name] for name in self.others)]), -1)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        previous = shift(parents[self.name], -1)
        return self._features(previous, self._other_parents(parents, len(previous), length))

    @override
    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        return self(parents, length).unbind(1) if self.name in parents else self._other_parents(parents, batch, length)

    @override
    def step(self, state: Any, t: int, samples: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        if isinstance(state, tuple):
            return state[t], state
        return self._features(at(samples[self.name], t - 1, state, self.size), state[:, t]), state


@dataclass(frozen=True)
class GatedNormal:
    """A normal distribution on the features of `Gated`, whose scale stays above .001."""

    def build(self, shape: Shape) -> GatedModule:
        """Return the distribution of a variable, from features (..., 2 D)."""
        return GatedModule(shape.size)


class GatedModule(Gaussian):
    """Distribution of `GatedNormal`."""

    def __init__(self, size: int):
        super().__init__()
        self.variance = nn.Linear(size, size)

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        mean, proposal = features.chunk(2, dim=-1)
        return mean, torch.sqrt(functional.softplus(self.variance(proposal)) + 1e-6)


@dataclass(frozen=True)
class DKF(LatentMethod):
    """A deep Kalman filter.

    Args:
        width: width of the guide's recurrent state and of the features of z_{t-1}.
        embed: width of the dense layer before the recurrent network.
        embed_latent: widths of the layers on z_{t-1} before the last one, whose width is `width`.
        hidden: widths of the perceptron on the mean of state and features.
        decoder: widths of the decoder.
        transition: widths of a perceptron for p(z_t | z_{t-1}) in place of the gated transition.
    """

    name = "dkf"
    source = "Krishnan, Shalit and Sontag, 2015, arXiv 1511.05121"
    generative = "p(z_t | z_{t-1}) p(x_t | z_t)"
    inference = "q(z_t | z_{t-1}, x_{t:T})"
    without_covariates = ("q(z)",)

    width: Size = 64
    embed: Extra = 64
    embed_latent: tuple[Size, ...] = (16,)
    hidden: tuple[Size, ...] = (32,)
    decoder: tuple[Size, ...] = (32, 64)
    transition: tuple[Size, ...] = ()

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return a gated transition, a perceptron for the data and a backward network for the guide."""
        extract = {"z": (*self.embed_latent, self.width)}
        return {
            "p(z)": Dense(self.transition) if self.transition else Gated(),
            "p(x)": Dense(self.decoder),
            "q(z)": Recurrent(self.width, embed=self.embed, extract=extract, hidden=self.hidden, mean=True),
        }

    @override
    def distributions(self) -> Mapping[str, DistributionSpec]:
        """Return the distributions by factor; the gated transition has its own."""
        return {**super().distributions(), **({} if self.transition else {"p(z)": GatedNormal()})}
