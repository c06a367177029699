"""Disentangled sequential autoencoder: a static latent for constant content, a chain of latents for the dynamics.

    p(w) p(z_t | z_{<t}) p(x_t | z_t, w)        q(w | x_{1:T}) q(z_t | x_{1:T}, w)

Li and Mandt, 2018, arXiv 1803.02991, with their "full" guide. Our w is v in the public implementation and f in the
paper. The layers are from the public implementation of Girin et al., 2021, arXiv 2008.12595. q(w) reads the two final
states of a bidirectional network. q(z_t) reads a recurrent network on top of a bidirectional one over x_t and w. No
parameters are shared. The guide ignores z_{<t}.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional
from typing_extensions import override

from ...factorization.relations import ALL
from ...networks import Dense, Input, NetworkSpec, Recurrent
from ...networks.base import Network
from ...networks.cells import RNN
from ...networks.recurrent import Memory
from ...options import Size
from ..method import LatentMethod


@dataclass(frozen=True)
class Layered:
    """A forward recurrent network (tanh) on the states of a forward and a backward LSTM over all parents.

    Args:
        width: width of the states.
    """

    width: int = 64

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> LayeredNetwork:
        """Return the network of a factor whose local parents are all read over {1:T}."""
        return LayeredNetwork(self, inputs, local)


class LayeredNetwork(Network):
    """Network of `Layered`."""

    def __init__(self, spec: Layered, inputs: Sequence[Input], local: bool):
        super().__init__(inputs, local, spec.width)
        for parent in inputs:
            if parent.relation not in (None, ALL):
                raise ValueError(
                    f"a Layered network reads local parents over {{1:T}}, but {parent.name} has {parent.relation}; use "
                    "another network, such as Recurrent"
                )
        recurrent = Recurrent(spec.width)
        self.past = Memory(recurrent, [(p, 0 if p.relation is None else -1) for p in inputs], +1)
        self.future = Memory(recurrent, [(p, 0) for p in inputs], -1)
        self.top: Any = RNN(2 * spec.width, spec.width, batch_first=True)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        values = {n: v if v.dim() == 3 else v[:, None].expand(-1, length, -1) for n, v in parents.items()}
        states = [memory(values, parents, lengths).transpose(0, 1) for memory in (self.past, self.future)]
        top = self.top
        base = functional.linear(torch.cat(states, dim=-1), top.weight_ih_l0, top.bias_ih_l0 + top.bias_hh_l0)
        return Recurrence.apply(base.to(top.weight_hh_l0.dtype), top.weight_hh_l0).transpose(0, 1)

    @override
    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        """Return the features of all steps, because a parent over {1:T} is never drawn in the same loop."""
        return self(parents, length, lengths).unbind(1)

    @override
    def step(self, state: Any, t: int, samples: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        return state[t], state


class Recurrence(torch.autograd.Function):
    """The recurrence h_t = tanh(base_t + W h_{t-1}), (T, B, W).

    torch.nn.RNN records every step for the gradient, which takes far longer.
    """

    @staticmethod
    def forward(ctx: Any, base: Tensor, weight: Tensor) -> Tensor:
        """Return the states from base (T, B, W) and weight (W, W)."""
        states = base.clone()
        state, matrix = torch.zeros_like(base[0]), weight.t()
        for target in states.unbind(0):
            state = target.addmm_(state, matrix).tanh_()
        ctx.save_for_backward(states, weight)
        return states

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_states: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gradients of base and weight."""
        states, weight = ctx.saved_tensors
        to_base = to_states.clone(memory_format=torch.contiguous_format)
        targets, slopes = to_base.unbind(0), (1 - states * states).unbind(0)
        for t in range(len(states) - 1, -1, -1):
            targets[t].mul_(slopes[t])
            if t:
                targets[t - 1].addmm_(targets[t], weight)
        return to_base, to_base[1:].flatten(0, 1).t() @ states[:-1].flatten(0, 1)


@dataclass(frozen=True)
class DSAE(LatentMethod):
    """A disentangled sequential autoencoder.

    Args:
        static: size of w.
        width: width of the recurrent states.
        decoder: widths of the decoder.
    """

    name = "dsae"
    source = "Li and Mandt, 2018, arXiv 1803.02991"
    generative = "p(w) p(z_t | z_{<t}) p(x_t | z_t, w)"
    inference = "q(w | x_{1:T}) q(z_t | x_{1:T}, w)"
    without_covariates = ("q(z)", "q(w)")

    static: Size = 16
    width: Size = 64
    decoder: tuple[Size, ...] = (32, 64)

    @override
    def sizes(self) -> dict[str, int]:
        return {"w": self.static, "z": self.latent}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return recurrent networks for the latents and a perceptron for the data."""
        return {
            "q(w)": Recurrent(self.width, hidden=()),
            "q(z)": Layered(self.width),
            "p(z)": Recurrent(self.width, hidden=()),
            "p(x)": Dense(self.decoder),
        }
