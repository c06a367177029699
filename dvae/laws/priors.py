"""Learnable priors of static latents, in place of N(0, I)."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Any

import pyro.distributions as dist
import torch
from pyro.distributions import transforms
from torch import Tensor, nn

from ..notation import Factor


class Prior(nn.Module):
    """A distribution over (D,) with parameters of its own.

    Args:
        size: D.
    """

    def __init__(self, size: int):
        super().__init__()
        self.size = size

    def check(self, guide: Factor, sizes: Mapping[str, int], observed: tuple[str, ...]) -> None:
        """Whether it suits a latent.

        Args:
            guide: the guide's factor q(w | ...) of the latent.
            sizes: dimension of every variable.
            observed: names of the data variables.

        Raises:
            ValueError: when it does not.
        """
        if self.size != sizes[guide.child]:
            raise ValueError(f"the prior of {guide.child} has size {self.size}, but {guide.child} {sizes[guide.child]}")

    def forward(self, batch: int, guide: Any) -> dist.Distribution:
        """The prior of `batch` sequences: batch (B,), event (D,).

        Args:
            batch: B.
            guide: the guide's q(w | ...) of the same latent; the model hands it over at each call.
        """
        raise NotImplementedError


class NormalPrior(Prior):
    """A diagonal normal with learned location and scale.

    Args:
        size: D.
    """

    def __init__(self, size: int):
        super().__init__(size)
        self.loc = nn.Parameter(torch.zeros(size))
        self.log_scale = nn.Parameter(torch.zeros(size))

    def forward(self, batch: int, guide: Any) -> dist.Distribution:
        """See `Prior.forward`."""
        return dist.Normal(self.loc, self.log_scale.exp()).expand((batch, self.size)).to_event(1)


class MixturePrior(Prior):
    """A mixture of diagonal normals with learned weights, locations and scales.

    Args:
        size: D.
        components: number of normals.
    """

    def __init__(self, size: int, components: int = 8):
        super().__init__(size)
        self.logits = nn.Parameter(torch.zeros(components))
        self.loc = nn.Parameter(torch.randn(components, size) / math.sqrt(size))
        self.log_scale = nn.Parameter(torch.zeros(components, size))

    def forward(self, batch: int, guide: Any) -> dist.Distribution:
        """See `Prior.forward`."""
        parts = dist.Normal(self.loc, self.log_scale.exp()).to_event(1)
        return dist.MixtureSameFamily(dist.Categorical(logits=self.logits), parts).expand((batch,))


class VampPrior(Prior):
    """The variational mixture of posteriors, p(w) = 1/K sum_k q(w | u_k), with learned pseudo-sequences u_k.

    Tomczak and Welling, 2018, arXiv 1705.07120. The guide is the model's own, so it must read data alone.

    Args:
        size: D of the latent.
        data: dimension of every data variable that the guide reads.
        components: K.
        steps: length of the pseudo-sequences.
    """

    def __init__(self, size: int, data: Mapping[str, int], components: int = 16, steps: int = 16):
        super().__init__(size)
        self.components, self.steps = components, steps
        self.pseudo = nn.ParameterDict({name: torch.randn(components, steps, d) for name, d in data.items()})

    def check(self, guide: Factor, sizes: Mapping[str, int], observed: tuple[str, ...]) -> None:
        """See `Prior.check`."""
        super().check(guide, sizes, observed)
        if not guide.parents or any(parent.name not in observed or not parent.local for parent in guide.parents):
            raise ValueError(
                f"a VampPrior of {guide.child} needs a guide that reads the data {', '.join(observed)} over time and "
                f"nothing else, such as q({guide.child} | {observed[0]}_{{1:T}}), not {guide}"
            )
        reads = {parent.name: sizes[parent.name] for parent in guide.parents}
        given = {name: pseudo.shape[-1] for name, pseudo in self.pseudo.items()}
        if given != reads:
            raise ValueError(f"a VampPrior of {guide.child} was given data of sizes {given}, but {guide} reads {reads}")

    @torch.no_grad()
    def start_at(self, data: Mapping[str, Tensor]) -> None:
        """Sets the pseudo-sequences to the first steps of K sequences.

        Args:
            data: name to (K, T, D).

        Raises:
            ValueError: sequences that are shorter than the pseudo-sequences.
        """
        for name, pseudo in self.pseudo.items():
            if data[name].shape[1] < self.steps:
                raise ValueError(
                    f"a VampPrior has pseudo-sequences of {self.steps} steps, but those of {name} that it is to start "
                    f"at have {data[name].shape[1]}; give it at most so many steps"
                )
            pseudo.copy_(data[name][:, : self.steps])

    def forward(self, batch: int, guide: Any) -> dist.Distribution:
        """See `Prior.forward`."""
        parameters = guide(dict(self.pseudo.items()), self.components, self.steps)
        parts = guide.head.distribution(parameters).to_event(1)
        weights = dist.Categorical(logits=parameters[0].new_zeros(self.components))
        return dist.MixtureSameFamily(weights, parts).expand((batch,))


class FlowPrior(Prior):
    """A normalizing flow: N(0, I) moved by monotonic splines and affine couplings, in turn, and a location and scale.

    Dinh et al., 2017, arXiv 1605.08803 (couplings); Dolatabadi et al., 2020, arXiv 2001.05168 (linear rational
    splines). Density and draws are exact, and take one pass each. It starts near N(0, I); with Pyro's own initial
    weights it would start far from it, with heavy tails.

    Args:
        size: D. With D = 1 there is nothing to couple, and the splines alone bend the normal.
        layers: of a spline and a coupling.
        bins: pieces of each spline.
    """

    def __init__(self, size: int, layers: int = 4, bins: int = 8):
        super().__init__(size)
        self.layers: Any = nn.ModuleList()
        for _ in range(layers):
            spline = transforms.Spline(size, bins, bound=4.0)
            for parameter in spline.parameters():
                nn.init.normal_(parameter, std=0.01)
            nn.init.normal_(spline.unnormalized_derivatives, math.log(math.e - 1), 0.01)  # the softplus of this is 1
            layer = nn.ModuleList([spline])
            if size > 1:
                coupling: Any = transforms.affine_coupling(size, log_scale_min_clip=-2.0, log_scale_max_clip=2.0)
                nn.init.normal_(coupling.nn.layers[-1].weight, std=0.01)
                layer.append(coupling)
            self.layers.append(layer)
        self.loc = nn.Parameter(torch.zeros(size))
        self.log_scale = nn.Parameter(torch.zeros(size))

    def forward(self, batch: int, guide: Any) -> dist.Distribution:
        """See `Prior.forward`.

        Raises:
            ValueError: parameters in half precision, which Pyro's splines do not take.
        """
        if torch.finfo(self.loc.dtype).bits < 32:
            raise ValueError(
                f"a FlowPrior has no half precision, but its parameters are {self.loc.dtype}; use mixed precision"
            )
        # Pyro's transforms keep their last value and result. On copies these go with the distribution; else they would
        # outlive a change of the parameters, and the module could not be deep-copied.
        reverse = transforms.Permute(torch.arange(self.size - 1, -1, -1, device=self.loc.device), cache_size=0)
        moves = [part for layer in self.layers for part in (*map(copy.copy, layer), reverse)]
        moves.append(transforms.AffineTransform(self.loc, self.log_scale.exp(), event_dim=1, cache_size=1))
        noise = dist.Normal(torch.zeros_like(self.loc), 1.0).expand((batch, self.size)).to_event(1)
        return dist.TransformedDistribution(noise, moves)
