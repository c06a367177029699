"""Priors of static latents without parents, as alternatives to N(0, I)."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pyro.distributions as dist
import torch
from pyro.distributions import transforms
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor, nn
from typing_extensions import override

from .base import ConditionalDistribution, Parameters, Shape


class Prior(ConditionalDistribution):
    """Base class of modules for the distribution of a static latent without parents, the same for every sequence.

    All D coordinates are one event. Subclasses implement `prior`.

    Args:
        spec: specification of the prior, named in errors.
        shape: the variable.

    Raises:
        ValueError: the variable is not a static latent without parents.
    """

    event_dim = 1

    def __init__(self, spec: Any, shape: Shape):
        super().__init__()
        wrong = ["has parents"] * bool(shape.features) + ["has a value at every step"] * shape.local
        wrong += ["is data"] * (shape.name in shape.data)
        if wrong:
            raise ValueError(
                f"{spec} is a distribution of static latents without parents, such as w in p(w), but {shape.name} "
                f"{' and '.join(wrong)}; give {shape.name} another distribution"
            )

    def prior(self) -> Any:
        """Return the Pyro distribution: batch shape (), event shape (D,)."""
        raise NotImplementedError

    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        """Return the features (B, 0) as the only parameter; `distribution` reads the number of sequences B from it."""
        return (features,)

    @override
    def distribution(self, parameters: Parameters) -> TorchDistribution:
        return self.prior().expand(parameters[0].shape[:-1])


@dataclass(frozen=True)
class Mixture:
    """Mixture of diagonal normals with learned weights, locations and scales, for a static latent without parents.

    Args:
        components: number of normals.
    """

    components: int = 8

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a static latent without parents.

        Args:
            shape: the variable and its features.

        Raises:
            ValueError: the variable is not a static latent without parents.
        """
        return MixtureModule(self, shape)


class MixtureModule(Prior):
    """Distribution module of `Mixture`."""

    reparameterised = False

    def __init__(self, spec: Mixture, shape: Shape):
        super().__init__(spec, shape)
        self.logits = nn.Parameter(torch.zeros(spec.components))
        self.loc = nn.Parameter(torch.randn(spec.components, shape.size) / math.sqrt(shape.size))
        self.log_scale = nn.Parameter(torch.zeros(spec.components, shape.size))

    @override
    def prior(self) -> Any:
        parts = dist.Normal(self.loc, self.log_scale.exp(), validate_args=False).to_event(1)
        weights = dist.Categorical(logits=self.logits, validate_args=False)
        return dist.MixtureSameFamily(weights, parts, validate_args=False)


@dataclass(frozen=True)
class Vamp:
    """Variational mixture of posteriors, p(w) = 1/K sum_k q(w | u_k), with learned pseudo-sequences u_k.

    This prior is for a static latent w without parents. It evaluates the model's guide q(w | ...), which must read only
    data over time. Source: Tomczak and Welling, 2018, arXiv 1705.07120.

    Args:
        components: K, number of pseudo-sequences.
        steps: number of time steps of each pseudo-sequence.
    """

    components: int = 16
    steps: int = 16

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a static latent without parents.

        Args:
            shape: the variable and its features.

        Raises:
            ValueError: the variable is not a static latent without parents, or its guide reads something other than
                data over time.
        """
        return VampModule(self, shape)


class VampModule(Prior):
    """Distribution module of `Vamp`."""

    reparameterised = False

    guide: Any

    def __init__(self, spec: Vamp, shape: Shape):
        super().__init__(spec, shape)
        guide = shape.guide and shape.guide.factor
        reads = guide.parents if guide else ()
        if not reads or any(parent.name not in shape.data or not parent.local for parent in reads):
            raise ValueError(
                f"a Vamp requires a guide of {shape.name} that reads the data {', '.join(shape.data)} over time "
                f"and nothing else, such as q({shape.name} | {shape.data[0]}_{{1:T}}), got "
                f"{guide or 'the prior as the guide'}"
            )
        self.components, self.steps = spec.components, spec.steps
        object.__setattr__(self, "guide", shape.guide)  # bypasses registration: the model already owns this module
        self.pseudo = nn.ParameterDict(
            {name: torch.randn(self.components, self.steps, size) for name, size in self.guide.sizes.items()}
        )

    @torch.no_grad()
    def start_at(self, data: Mapping[str, Tensor]) -> None:
        """Set the pseudo-sequences to the first steps of K sequences.

        Args:
            data: dictionary from each data variable that the guide reads to its values (K, T, D).

        Raises:
            ValueError: the sequences are fewer than the components, or have fewer steps than the pseudo-sequences.
        """
        for name, pseudo in self.pseudo.items():
            if len(data[name]) < len(pseudo):
                raise ValueError(
                    f"this Vamp has {len(pseudo)} components, but only {len(data[name])} sequences of {name} are given "
                    "to start them; give more sequences, or build the Vamp with fewer components (prior_components)"
                )
            if data[name].shape[1] < self.steps:
                raise ValueError(
                    f"the pseudo-sequences of this Vamp have {self.steps} steps, but the given sequences of {name} "
                    f"have only {data[name].shape[1]}; give longer sequences, or build the Vamp with fewer steps"
                )
            first = data[name][:, : self.steps]
            pseudo.copy_(self.guide.units[name].relative(first) if name in self.guide.units else first)

    @override
    def prior(self) -> Any:
        units = self.guide.units
        data = {name: units[name].absolute(p) if name in units else p for name, p in self.pseudo.items()}
        posteriors = self.guide.head.joint(self.guide(data, self.components, self.steps))
        same = next(self.pseudo.parameters()).new_zeros(self.components)
        weights = dist.Categorical(logits=same, validate_args=False)
        return dist.MixtureSameFamily(weights, posteriors, validate_args=False)


@dataclass(frozen=True)
class Flow:
    """Normalizing flow for a static latent without parents: N(0, I), transformed by splines and couplings.

    Monotonic splines and affine couplings alternate, followed by a location and a scale. In one dimension there are
    only splines. Density and draws are exact and take one pass each. The initial weights are small, so the initial
    distribution is close to N(0, I); with Pyro's initial weights it would have heavy tails.

    Sources: Dinh et al., 2017, arXiv 1605.08803 (couplings); Dolatabadi et al., 2020, arXiv 2001.05168 (linear rational
    splines).

    Args:
        layers: number of layers; each has a spline and a coupling.
        bins: number of pieces of each spline.
    """

    layers: int = 4
    bins: int = 8

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a static latent without parents.

        Args:
            shape: the variable and its features.

        Raises:
            ValueError: the variable is not a static latent without parents.
        """
        return FlowModule(self, shape)


class FlowModule(Prior):
    """Distribution module of `Flow`."""

    def __init__(self, spec: Flow, shape: Shape):
        super().__init__(spec, shape)
        size = shape.size
        self.layers: Any = nn.ModuleList()
        for _ in range(spec.layers):
            spline = transforms.Spline(size, spec.bins, bound=4.0)
            for parameter in spline.parameters():
                nn.init.normal_(parameter, std=0.01)
            nn.init.normal_(spline.unnormalized_derivatives, math.log(math.e - 1), 0.01)  # softplus of it is 1
            layer = nn.ModuleList([spline])
            if size > 1:
                coupling: Any = transforms.affine_coupling(size, log_scale_min_clip=-2.0, log_scale_max_clip=2.0)
                nn.init.normal_(coupling.nn.layers[-1].weight, std=0.01)
                layer.append(coupling)
            self.layers.append(layer)
        self.loc = nn.Parameter(torch.zeros(size))
        self.log_scale = nn.Parameter(torch.zeros(size))

    @override
    def prior(self) -> Any:
        """Return the distribution of the flow: batch shape (), event shape (D,).

        Raises:
            ValueError: the weights have half precision, which Pyro's splines do not support.
        """
        loc = self.loc
        if torch.finfo(loc.dtype).bits < 32:
            raise ValueError(
                f"a Flow does not support half precision, but its weights are {loc.dtype}; keep float32 weights and "
                "fit with precision='bf16-mixed' or '32-true'"
            )
        # Pyro's transforms cache their last input and output. Copies limit the cache to this distribution; otherwise it
        # would become stale when parameters change, and the module could not be deep-copied.
        reverse = transforms.Permute(torch.arange(len(loc) - 1, -1, -1, device=loc.device), cache_size=0)
        moves = [part for layer in self.layers for part in (*map(copy.copy, layer), reverse)]
        moves.append(transforms.AffineTransform(loc, self.log_scale.exp(), event_dim=1, cache_size=1))
        noise = dist.Normal(torch.zeros_like(loc), torch.ones_like(loc), validate_args=False).to_event(1)
        return dist.TransformedDistribution(noise, moves, validate_args=False)
