"""Base classes of all networks, and the perceptron that joins parents at single steps.

A network maps the parents of one factor to features, under the masks that the factor declares. It has two forms that
must give the same features. `forward` evaluates all steps at once, from known values of all parents (teacher-forced).
`start` and `step` evaluate one step at a time, in a loop that draws some of the parents; `start` computes once
everything that does not depend on these draws.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional
from typing_extensions import override

from ..factorization.relations import Relation
from .loop import select, shift

ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU, "gelu": nn.GELU, "elu": nn.ELU}


@dataclass(frozen=True)
class Input:
    """One parent of a factor, as seen by a network.

    Args:
        name: name of the parent.
        size: D, dimension of the parent.
        relation: steps of the parent that the factor may read at step t; None for a static parent.
    """

    name: str
    size: int
    relation: Relation | None = None

    @property
    def lags(self) -> tuple[int, ...] | None:
        """Offsets s - t of the steps s read at t; None for a static parent, a custom mask or an unbounded range."""
        if self.relation is None or self.relation.intervals is None:
            return None
        if any(math.isinf(end) for interval in self.relation.intervals for end in interval):
            return None
        return tuple(lag for low, high in self.relation.intervals for lag in range(int(low), int(high) + 1))


class Network(nn.Module):
    """A module from parents to features under masks; its contract is described in `docs/reference/networks.md`.

    Args:
        inputs: the parents of the factor.
        local: whether the child has a value at every step. A static child has features (B, H) instead of (B, T, H).
        features: H, number of features.
    """

    head: ClassVar[Any] = None
    """Class of the factor's distribution specification, if only this class can use the features; otherwise None."""
    stationary: bool = False
    """Whether features depend on values at fixed lags alone, not on the step itself."""
    streams: bool = False
    """Whether a loop may run without end: `stationary`, and the state of `step` does not grow with the steps."""

    def __init__(self, inputs: Sequence[Input], local: bool, features: int):
        super().__init__()
        self.inputs = tuple(inputs)
        self.local = local
        self.features = features

    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        """Return the features at all steps from the parents at all steps.

        Args:
            parents: {name: values (B, T, D), or (B, D) for a static parent}, zero at padded steps.
            length: T, number of steps.
            lengths: (B,) number of valid steps of each sequence in a ragged batch; later steps are padding, which the
                network ignores. None if all steps are valid.

        Returns:
            (B, T, H), or (B, H) for a static child.

        Raises:
            NotImplementedError: a subclass does not implement the method.
        """
        raise NotImplementedError

    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        """Return the state before the first step of a loop, with all computations on the known `parents` done.

        Args:
            parents: {name: values (B, T, D) or (B, D)} of the parents that the loop does not draw.
            batch, length: B and T.
            lengths: as in `forward`.

        Raises:
            NotImplementedError: a subclass does not implement the method.
        """
        raise NotImplementedError

    def step(self, state: Any, t: int, samples: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        """Return the features (B, H) at step t (counted from 0) and the next state.

        Args:
            state: state from `start` or the previous `step`. A loop calls `step` once for each step.
            t: the step.
            samples: {name: list with the values (B, D) of each step} of the parents that the loop draws.

        Raises:
            NotImplementedError: a subclass does not implement the method.
        """
        raise NotImplementedError

    def forward_chunk(
        self, state: Any, t: int, count: int, samples: Mapping[str, Sequence[Tensor]]
    ) -> tuple[Tensor, Any]:
        """Return the features (B, N, H) at the steps t to t + N - 1, and the next state.

        All values that these steps read must be known. The default calls `step` N times; networks override it if they
        can evaluate the steps at once.

        Args:
            state, t, samples: as in `step`; `samples` may already contain the draws of these steps.
            count: N, number of steps.
        """
        features = []
        for s in range(t, t + count):
            output, state = self.step(state, s, samples)
            features.append(output)
        return torch.stack(features, dim=1), state

    def forward_last(
        self, state: Any, t: int, count: int, samples: Mapping[str, Sequence[Tensor]]
    ) -> tuple[Tensor, Any]:
        """Return the features (B, H) at the last of N steps, and the next state.

        Networks override the method if they can skip the earlier features.

        Args:
            state: state from `start` or the previous `step`.
            t: first of the N steps, from 0.
            count: N, number of steps.
            samples: {name: list with the values (B, D) of each step} of the parents that the loop draws.
        """
        features, state = self.forward_chunk(state, t, count, samples)
        return features[:, -1], state

    def refuse_ragged(self, lengths: Tensor | None) -> None:
        """Refuse a ragged batch, for networks that read the whole sequence at every step.

        Args:
            lengths: (B,) number of valid steps of each sequence; None if the batch is not ragged.

        Raises:
            ValueError: the batch is ragged.
        """
        if lengths is not None:
            name = type(self).__name__.removesuffix("Network")
            raise ValueError(f"{name} needs sequences of equal length, but this batch is ragged; split it by length")

    def select(self, state: Any, rows: Tensor | None) -> Any:
        """Return the state for some batch rows, which may repeat.

        Args:
            state: state from `start` or `step`.
            rows: indices (N,) of the rows; None for a copy of the state, whose steps do not change the state.
        """
        return select(state, rows)

    def chain(self, state: Any) -> Chain | None:
        """Return the loop from a state of `start` as a `Chain`, or None if `distributions.chain` cannot run it.

        Args:
            state: result of `start`.
        """
        return None


class FixedLengthNetwork(Network):
    """A network that computes the features of all steps at once; a loop must not draw any of its parents."""

    @override
    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        if missing := [parent.name for parent in self.inputs if parent.name not in parents]:
            name = type(self).__name__.removesuffix("Network")
            raise ValueError(
                f"{name} computes all steps at once, but {', '.join(missing)} would be drawn step by step; use "
                "another network for this factor"
            )
        return self(parents, length, lengths).unbind(1)

    @override
    def step(self, state: Any, t: int, samples: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        return state[t], state


def presence(name: str) -> str:
    """Return the name of a latent's presence mask (B, T) among the inputs of a network.

    The mask is True at steps where the latent exists. A latent that exists at all steps has no mask. At the other steps
    the latent is integrated out (`Rollout.present`), and the network must not read its values.

    Args:
        name: name of the latent.
    """
    return f"{name} is there"


def indicator(name: str) -> str:
    """Return the name of the mask of a variable's observed entries; guides read this mask if entries are missing."""
    return f"{name} was observed"


def share_modules(networks: Sequence[Any], *names: str) -> None:
    """Replace the named modules of all other networks by those of the first network.

    Args:
        networks: networks that have these modules, with equal shapes.
        names: names of their attributes.
    """
    for network in networks[1:]:
        for name in names:
            setattr(network, name, getattr(networks[0], name))


class NetworkSpec(Protocol):
    """Specification of a network: a frozen dataclass with a `build` method."""

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> Network:
        """Return the network of a factor.

        Args:
            inputs: the parents of the factor.
            local: whether the child has a value at every step; otherwise it is static.
            size: dimension of the child.

        Raises:
            ValueError: the network does not support such a factor.
        """
        ...


def part(values: Tensor, lag: int | None) -> Tensor:
    """Return values (B, T, D) of a parent at t + lag for every t; for a static parent (lag None), unchanged."""
    return values if lag is None else shift(values, lag)


@dataclass
class Hoisted:
    """The part of a `Join` that is computed before a loop.

    Args:
        base: (B, T, H) contribution of the known parts to the first layer, bias included; for a join without layers,
            the concatenated known parts.
        weights: weights (H, D) of the first layer for each live part, which is a part that the loop draws.
        known: {index of a part: values} of the known parts.
        rows: indices (N,) of the batch rows that are still in the loop; None for all rows.
    """

    base: Tensor
    weights: list[Tensor]
    known: Mapping[int, Tensor]
    rows: Tensor | None = None

    @property
    def like(self) -> Tensor:
        """A tensor with the current batch size, dtype and device of the loop; `select` may change the batch size."""
        return self.base if self.rows is None else self.base.new_empty(()).expand(len(self.rows), 1)

    def select(self, rows: Tensor | None) -> Hoisted:
        """Return the results for the batch rows with indices (N,), without a copy of the base."""
        if rows is None:
            return self
        selected = Hoisted(self.base, self.weights, self.known, rows)
        selected.steps = select(self.steps, rows)
        return selected

    @cached_property
    def steps(self) -> Sequence[Tensor]:
        """The base (B, H) of each step.

        The property uses unbind, because the backward pass of T index operations would write T gradients (B, T, H).
        """
        return self.base.unbind(1)


@dataclass
class Chain:
    """A loop in the form that `distributions.chain` runs: each step depends only on the child's value one step away.

    Args:
        lag: offset of the child's value that a step reads: -1 in a forward loop, 1 in a backward loop.
        join: join of the parts.
        hoisted: contribution of the known parts to the join.
        before: weight and bias of the layers on the child's value, each followed by the activation.
        cell: if an LSTM reads the child's value, the contribution (B, T, 4 W) of known inputs to its gates, and the
            weight of all other inputs; otherwise None.
        keep: function that stores the LSTM's states for other factors; it is called with the drawn child (B, T, D) and
            the states (B, T, W).
    """

    lag: int
    join: Join
    hoisted: Hoisted
    before: Sequence[tuple[Tensor, Tensor]] = ()
    cell: tuple[Tensor, Tensor] | None = None
    keep: Callable[[Tensor, Tensor], None] | None = None


class Join(nn.Module):
    """A multilayer perceptron on the concatenation of parts, some of them available only step by step.

    A part is the values of a parent or the states of a recurrent network.

    Args:
        sizes: dimension of every part.
        widths: widths of the layers, each followed by the activation. If empty, the features are the concatenation.
        activation: "tanh", "relu", "gelu" or "elu".
        mean: whether to average the parts instead of concatenating them.

    Raises:
        ValueError: the activation is unknown, or `mean` is set and the parts differ in size.
    """

    like: Tensor

    def __init__(self, sizes: Sequence[int], widths: Sequence[int], activation: str, mean: bool = False):
        super().__init__()
        if mean and len(set(sizes)) > 1:
            raise ValueError(f"mean=True needs parts of equal size, got sizes {', '.join(map(str, sizes))}")
        self.sizes = tuple(sizes)
        self.mean = mean
        self.kind = activation
        widths = [sizes[0] if mean else sum(sizes), *widths]
        self.features = widths[-1]
        layers = perceptron(widths, activation)
        self.first: Any = layers[0] if len(layers) else None
        self.rest: Any = layers[1:]
        self.register_buffer("like", torch.empty(0), persistent=False)

    def forward(self, parts: Sequence[Tensor]) -> Tensor:
        """Return (B, T, H) for parts (B, T, D) or (B, D); return (B, H) if every part is (B, D)."""
        values = self._join(parts)
        return values if self.first is None else self.rest(self.first(values))

    def _join(self, parts: Sequence[Tensor]) -> Tensor:
        if len(parts) == 1:
            return parts[0]
        parts = aligned(parts)
        return torch.stack(parts).mean(0) if self.mean else torch.cat(parts, dim=-1)

    def hoist(
        self, known_parts: Mapping[int, Tensor], batch: int, length: int, through: nn.Linear | None = None
    ) -> Hoisted:
        """Return the known parts' contribution to the first layer at every step, and the weights of the live parts.

        Args:
            known_parts: {index of a part: values (B, T, D), or (B, D) for a static part}.
            batch, length: B and T.
            through: linear layer that serves as the first layer if the join has no layers.
        """
        layer = self.first or through
        if layer is None:
            empty = self.like.new_empty(batch, length, 0)
            return Hoisted(torch.cat(aligned([empty, *known_parts.values()]), dim=-1), [], known_parts)
        if self.mean:
            weights = [layer.weight / len(self.sizes)] * len(self.sizes)
        else:
            weights = list(layer.weight.split(self.sizes, dim=1))
        base = layer.bias.expand(batch, length, -1)
        if known_parts:
            matrix = torch.cat([weights[i] for i in known_parts], dim=1)
            base = functional.linear(torch.cat(aligned(list(known_parts.values())), dim=-1), matrix, layer.bias)
            base = base if base.dim() == 3 else base[:, None].expand(-1, length, -1)
        return Hoisted(base, [weight for i, weight in enumerate(weights) if i not in known_parts], known_parts)

    def add(self, hoisted: Hoisted, t: int | slice, live: Sequence[Tensor]) -> Tensor:
        """Return the features (B, H) at step t, or (B, N, H) at several steps, from hoisted and live parts.

        Args:
            hoisted: result of `hoist`.
            t: the step, or a slice of N steps.
            live: values (B, D) or (B, N, D) of the parts that were not known in `hoist`, in the order of all parts.
        """
        if isinstance(t, int):
            first = hoisted.steps[t]
        elif hoisted.rows is None:
            first = hoisted.base[:, t]
        else:
            first = torch.stack([hoisted.steps[s] for s in range(t.start, t.stop)], dim=1)
        if self.first is None:
            known = dict(zip(hoisted.known, first.split([self.sizes[i] for i in hoisted.known], dim=-1), strict=True))
            remaining = iter(live)
            return self._join([known[i] if i in known else next(remaining) for i in range(len(self.sizes))])
        for part, weight in zip(live, hoisted.weights, strict=True):
            first = torch.addmm(first, part, weight.t()) if part.dim() == 2 else first + part @ weight.t()
        features: Tensor = self.rest(first)
        return features


def perceptron(widths: Sequence[int], activation: str) -> nn.Sequential:
    """Return linear layers from widths[0] to widths[-1], each followed by the activation.

    Raises:
        ValueError: the activation is unknown, or a width is below 1.
    """
    if activation not in ACTIVATIONS:
        raise ValueError(f"unknown activation {activation!r}; known: {', '.join(ACTIVATIONS)}")
    if min(widths) < 1:
        raise ValueError(f"the widths of a perceptron must be at least 1, got {', '.join(map(str, widths[1:]))}")
    layers: list[nn.Module] = []
    for a, b in pairwise(widths):
        layers += [nn.Linear(a, b), ACTIVATIONS[activation]()]
    return nn.Sequential(*layers)


def aligned(parts: Sequence[Tensor]) -> list[Tensor]:
    """Return all parts as (B, T, D), with static parts (B, D) repeated at every step; unchanged if all are static."""
    steps = max((part.shape[1] for part in parts if part.dim() == 3), default=None)
    if steps is None:
        return list(parts)
    return [part if part.dim() == 3 else part[:, None].expand(-1, steps, -1) for part in parts]
