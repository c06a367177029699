"""Base of all networks: inputs, the join of pointwise parts, and shifts in time.

A network maps the parents of one factor to features, under the masks that the factor declares. It has two forms that
must agree. `forward` evaluates all steps at once (teacher-forced). `start` and `step` evaluate one step at a time;
`start` computes once everything that does not depend on a variable being drawn.
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
        relation: steps of the parent that are visible at t; None for a static parent.
    """

    name: str
    size: int
    relation: Relation | None = None

    @property
    def lags(self) -> tuple[int, ...] | None:
        """The visible offsets s - t if there are finitely many, otherwise None."""
        if self.relation is None or self.relation.intervals is None:
            return None
        if any(math.isinf(end) for interval in self.relation.intervals for end in interval):
            return None
        return tuple(lag for low, high in self.relation.intervals for lag in range(int(low), int(high) + 1))


class Network(nn.Module):
    """A module from parents to features under masks; its contract is described in `docs/reference/networks.md`.

    Args:
        inputs: the parents.
        local: whether the child is a local variable. A static child has features (B, H) instead of (B, T, H).
        features: H, number of features.
    """

    head: ClassVar[Any] = None
    """Specification class of the distribution that the features parameterise, if no other can read them."""

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
            lengths: (B,) numbers of valid steps in a ragged batch; later steps are padding, which the network ignores.

        Returns:
            (B, T, H), or (B, H) for a static child.
        """
        raise NotImplementedError

    def start(self, given: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        """Return the state before the first step of a loop, with all computations on the `given` parents done."""
        raise NotImplementedError

    def step(self, state: Any, t: int, drawn: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        """Return the features (B, H) at step t (counted from 0) and the next state.

        Args:
            state: state from `start` or the previous `step`. Steps are taken once each, in the order of the loop.
            t: the step.
            drawn: {name: values (B, D) by step} of the parents that the loop draws.
        """
        raise NotImplementedError

    def forward_chunk(
        self, state: Any, t: int, count: int, drawn: Mapping[str, Sequence[Tensor]]
    ) -> tuple[Tensor, Any]:
        """Return the features (B, N, H) at N steps from t on, whose parents are already known, and the next state.

        The default calls `step` N times; networks override it if they can evaluate the steps at once.

        Args:
            state, t, drawn: as in `step`; `drawn` may already contain the draws of these steps.
            count: N, number of steps.
        """
        features = []
        for s in range(t, t + count):
            output, state = self.step(state, s, drawn)
            features.append(output)
        return torch.stack(features, dim=1), state

    def forward_last(self, state: Any, t: int, count: int, drawn: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        """Return only the features (B, H) at the last of N steps, and the next state, with arguments as in
        `forward_chunk`.

        Networks override it if they can skip the earlier features.
        """
        features, state = self.forward_chunk(state, t, count, drawn)
        return features[:, -1], state

    def refuse_ragged(self, lengths: Tensor | None) -> None:
        """Raise an error for padded batches, in a network whose steps all read the whole sequence."""
        if lengths is not None:
            name = type(self).__name__.removesuffix("Network")
            raise ValueError(f"{name} outputs sequences of one length, but this batch is ragged; split it by length")

    def select(self, state: Any, rows: Tensor) -> Any:
        """Return the state with these rows (N,) of its batch; rows may repeat, as in `loop.select`."""
        return select(state, rows)

    def chain(self, state: Any) -> Chain | None:
        """Return the loop after `start` as a `Chain` for the fused function, or None if it has another form."""
        return None


class FixedLengthNetwork(Network):
    """A network that evaluates all steps together, for sequences of equal length."""

    @override
    def start(self, given: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        if missing := [parent.name for parent in self.inputs if parent.name not in given]:
            name = type(self).__name__.removesuffix("Network")
            raise ValueError(f"{name} outputs all steps at once; it cannot be in a loop with {', '.join(missing)}")
        return self(given, length, lengths).unbind(1)

    @override
    def step(self, state: Any, t: int, drawn: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        return state[t], state


def presence(name: str) -> str:
    """Return the name of the mask (B, T) of the steps at which a latent exists.

    A network finds it among its parents, unless the latent exists at all steps. At other steps the latent is integrated
    out (`Rollout.present`), and its values must not be read.
    """
    return f"{name} is there"


def indicator(name: str) -> str:
    """Return the name of the mask of observed data entries, which a guide's factor reads if any are missing."""
    return f"{name} was observed"


def share_modules(networks: Sequence[Any], *names: str) -> None:
    """Assign the named modules of the first network to the other networks."""
    for network in networks[1:]:
        for name in names:
            setattr(network, name, getattr(networks[0], name))


class NetworkSpec(Protocol):
    """Specification of a network: a frozen dataclass with a `build` method."""

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> Network:
        """Return the network of a factor with these parents, for a child of dimension `size`."""
        ...


def part(values: Tensor, lag: int | None) -> Tensor:
    """Return a parent's values at every step: shifted by the lag, or unchanged if static."""
    return values if lag is None else shift(values, lag)


@dataclass
class Hoisted:
    """Results of a `Join` before a loop: base (B, T, H), weights (H, D) of live parts, and known parts."""

    base: Tensor
    weights: list[Tensor]
    known: Mapping[int, Tensor]
    rows: Tensor | None = None

    @property
    def like(self) -> Tensor:
        """A tensor with the loop's batch size, which `select` may have changed, and its dtype and device."""
        return self.base if self.rows is None else self.base.new_empty(()).expand(len(self.rows), 1)

    def select(self, rows: Tensor) -> Hoisted:
        """Return the selected rows, which are read from the same base."""
        selected = Hoisted(self.base, self.weights, self.known, rows)
        selected.steps = select(self.steps, rows)
        return selected

    @cached_property
    def steps(self) -> Sequence[Tensor]:
        """The base by step.

        It uses unbind, because the backward pass of T index operations would write T gradients (B, T, H).
        """
        return self.base.unbind(1)


@dataclass
class Chain:
    """A loop in the form that `distributions.chain` runs, with one product per step on the child's last value.

    Args:
        lag: offset at which the child's own value is read, one step away.
        join: join of the parts; `hoisted` contains the contribution of the known parts.
        before: layers on the child's value, each followed by the activation.
        cell: for a memory that reads the child's value, the contribution (B, T, 4 W) of known inputs to the gates, and
            the weight.
        keep: function to call with the drawn child and the states (B, T, W) of that memory.
    """

    lag: int
    join: Join
    hoisted: Hoisted
    before: Sequence[tuple[Tensor, Tensor]] = ()
    cell: tuple[Tensor, Tensor] | None = None
    keep: Callable[[Tensor, Tensor], None] | None = None


class Join(nn.Module):
    """A multilayer perceptron on the concatenation of parts, some of them available only step by step.

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
            raise ValueError(f"parts must have equal sizes for a mean, got {', '.join(map(str, sizes))}")
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

    def hoist(self, known: Mapping[int, Tensor], batch: int, length: int, through: nn.Linear | None = None) -> Hoisted:
        """Return the known parts' contribution to the first layer at every step, and the weights of the live parts.

        Args:
            known: {index of a part: values}.
            batch, length: B and T.
            through: layer that is applied first if the join has none of its own.
        """
        layer = self.first or through
        if layer is None:
            empty = self.like.new_empty(batch, length, 0)
            return Hoisted(torch.cat(aligned([empty, *known.values()]), dim=-1), [], known)
        if self.mean:
            weights = [layer.weight / len(self.sizes)] * len(self.sizes)
        else:
            weights = list(layer.weight.split(self.sizes, dim=1))
        base = layer.bias.expand(batch, length, -1)
        if known:
            matrix = torch.cat([weights[i] for i in known], dim=1)
            base = functional.linear(torch.cat(aligned(list(known.values())), dim=-1), matrix, layer.bias)
            base = base if base.dim() == 3 else base[:, None].expand(-1, length, -1)
        return Hoisted(base, [weight for i, weight in enumerate(weights) if i not in known], known)

    def add(self, hoisted: Hoisted, t: int | slice, live: Sequence[Tensor]) -> Tensor:
        """Return the features (B, H) at step t, or (B, N, H) at several, from hoisted and live parts."""
        first = hoisted.steps[t] if isinstance(t, int) else hoisted.base[:, t]
        if self.first is None:
            known = dict(zip(hoisted.known, first.split([self.sizes[i] for i in hoisted.known], dim=-1), strict=True))
            remaining = iter(live)
            return self._join([known[i] if i in known else next(remaining) for i in range(len(self.sizes))])
        for part, weight in zip(live, hoisted.weights, strict=True):
            first = torch.addmm(first, part, weight.t()) if part.dim() == 2 else first + part @ weight.t()
        features: Tensor = self.rest(first)
        return features


def perceptron(widths: Sequence[int], activation: str) -> nn.Sequential:
    """Return linear layers from widths[0] to widths[-1], each followed by the activation."""
    if activation not in ACTIVATIONS:
        raise ValueError(f"unknown activation {activation!r}; known: {', '.join(ACTIVATIONS)}")
    if min(widths) < 1:
        raise ValueError(f"the widths of a perceptron must be at least 1, got {', '.join(map(str, widths[1:]))}")
    layers: list[nn.Module] = []
    for a, b in pairwise(widths):
        layers += [nn.Linear(a, b), ACTIVATIONS[activation]()]
    return nn.Sequential(*layers)


def aligned(parts: Sequence[Tensor]) -> list[Tensor]:
    """Return the parts with a time axis, repeating static parts; unchanged if no part has one."""
    steps = max((part.shape[1] for part in parts if part.dim() == 3), default=None)
    if steps is None:
        return list(parts)
    return [part if part.dim() == 3 else part[:, None].expand(-1, steps, -1) for part in parts]
