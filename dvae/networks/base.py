"""What every network shares: its inputs, the join of pointwise parts, shifting in time.

A network maps the parents of one factor to features, under the masks that the factor declares. It has two forms that
must agree: `forward` evaluates all steps at once (teacher forcing), `start` and `step` one step at a time, with
everything that does not depend on a variable being drawn computed once, in `start`.
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
    """One parent of a factor, as a network sees it.

    Args:
        name: the parent's name.
        size: its dimension D.
        relation: which of its steps are visible at t; None for a static parent.
    """

    name: str
    size: int
    relation: Relation | None = None

    @property
    def lags(self) -> tuple[int, ...] | None:
        """The offsets s - t that are visible, where they are finitely many."""
        if self.relation is None or self.relation.intervals is None:
            return None
        if any(math.isinf(end) for interval in self.relation.intervals for end in interval):
            return None
        return tuple(lag for low, high in self.relation.intervals for lag in range(int(low), int(high) + 1))


class Network(nn.Module):
    """Parents to features under masks; see the contract in `docs/networks.md`.

    Args:
        inputs: the parents.
        local: whether the child is a local variable. A static child has features (B, H) in place of (B, T, H).
        features: H.
    """

    law: ClassVar[Any] = None
    """Description of the law whose parameters the features are, where no other can read them."""

    def __init__(self, inputs: Sequence[Input], local: bool, features: int):
        super().__init__()
        self.inputs = tuple(inputs)
        self.local = local
        self.features = features

    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        """Features at all steps, from the parents at all steps.

        Args:
            parents: name to (B, T, D), or (B, D) for a static parent; zero at padded steps.
            length: T.
            lengths: (B,) numbers of valid steps in a ragged batch; later steps are padding and stay unseen.

        Returns:
            (B, T, H), or (B, H) for a static child.
        """
        raise NotImplementedError

    def start(self, given: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        """The state before the first step of a loop, with all work on the `given` parents done."""
        raise NotImplementedError

    def step(self, state: Any, t: int, drawn: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        """Features (B, H) at step t (0-based), and the next state.

        Args:
            state: from `start` or the last `step`. Steps are taken in the order of the loop, each once.
            t: the step.
            drawn: name to its values (B, D) by step, for the parents that the loop itself draws.
        """
        raise NotImplementedError

    def stretch(self, state: Any, t: int, count: int, drawn: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        """Features (B, N, H) at N steps from t on, where what they read is known already, and the next state.

        A network that can do so evaluates them at once.

        Args:
            state, t, drawn: as in `step`; the draws of these steps may be there before their features.
            count: N.
        """
        features = []
        for s in range(t, t + count):
            found, state = self.step(state, s, drawn)
            features.append(found)
        return torch.stack(features, dim=1), state

    def reach(self, state: Any, t: int, count: int, drawn: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        """Features (B, H) at the last of the N steps of a `stretch`, where nobody asks for those before, and the state.

        A network that need not find these does without.
        """
        features, state = self.stretch(state, t, count, drawn)
        return features[:, -1], state

    def refuse_ragged(self, lengths: Tensor | None) -> None:
        """Refuses padding, for a network in which every step sees all of a sequence."""
        if lengths is not None:
            name = type(self).__name__.removesuffix("Network")
            raise ValueError(f"{name} makes sequences of one length, but this is a ragged batch; split it by length")

    def select(self, state: Any, rows: Tensor) -> Any:
        """The state with these rows (N,) of its batch, each as often as it is named (see `rows.select`)."""
        return select(state, rows)

    def chain(self, state: Any) -> Chain | None:
        """The loop after `start` in the form that one fused function runs, where it has that form."""
        return None


class AtOnce(Network):
    """A network that makes all steps together, of sequences of one length."""

    @override
    def start(self, given: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        if missing := [parent.name for parent in self.inputs if parent.name not in given]:
            name = type(self).__name__.removesuffix("Network")
            raise ValueError(f"{name} makes all steps at once; it cannot be in a loop with {', '.join(missing)}")
        return self(given, length, lengths).unbind(1)

    @override
    def step(self, state: Any, t: int, drawn: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        return state[t], state


def presence(name: str) -> str:
    """Under which a network finds, among its parents, at which steps (B, T) a latent is there, if not at all of them.

    At the others it is integrated out (`Rollout.present`), and its values are not to be read.
    """
    return f"{name} is there"


def indicator(name: str) -> str:
    """Under which a guide's factor finds, among its parents, which entries of the data were observed, if not all."""
    return f"{name} was observed"


def share_modules(networks: Sequence[Any], *names: str) -> None:
    """Gives networks the modules of these names of the first of them."""
    for network in networks[1:]:
        for name in names:
            setattr(network, name, getattr(networks[0], name))


class NetworkSpec(Protocol):
    """A description of a network: a frozen dataclass that `build`s one for a factor."""

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> Network:
        """The network of a factor with these parents, for a child of dimension `size`."""
        ...


def part(values: Tensor, lag: int | None) -> Tensor:
    """A parent's contribution at every step: itself if static, else shifted by its lag."""
    return values if lag is None else shift(values, lag)


@dataclass
class Hoisted:
    """What a `Join` computes before a loop: base (B, T, H), the weights (H, D) of live parts, and the known parts."""

    base: Tensor
    weights: list[Tensor]
    known: Mapping[int, Tensor]
    rows: Tensor | None = None

    @property
    def like(self) -> Tensor:
        """A tensor of the loop's batch, which `select` may have changed, and its type."""
        return self.base if self.rows is None else self.base.new_empty(()).expand(len(self.rows), 1)

    def select(self, rows: Tensor) -> Hoisted:
        """Its rows; they are read from the same base."""
        chosen = Hoisted(self.base, self.weights, self.known, rows)
        chosen.steps = select(self.steps, rows)
        return chosen

    @cached_property
    def steps(self) -> Sequence[Tensor]:
        """The base by step. (unbind, not indexing: T selections would each write a (B, T, H) gradient.)"""
        return self.base.unbind(1)


@dataclass
class Chain:
    """A loop in the form that `distributions.chain` runs: one product a step with features of the child's last value.

    Args:
        lag: where the child's value is read, a step away.
        join: of the parts; `hoisted` is the share of those that are known.
        before: layers on the child's value, each followed by the activation.
        cell: of a memory that reads it: share (B, T, 4 W) of the gates in what is known, and the weight.
        keep: to be called with the drawn child and the states (B, T, W) of that memory.
    """

    lag: int
    join: Join
    hoisted: Hoisted
    before: Sequence[tuple[Tensor, Tensor]] = ()
    cell: tuple[Tensor, Tensor] | None = None
    keep: Callable[[Tensor, Tensor], None] | None = None


class Join(nn.Module):
    """A multilayer perceptron on the concatenation of parts, of which some may come one step at a time.

    Args:
        sizes: dimension of every part.
        widths: of the layers; each is followed by the activation. Without any, the features are the concatenation.
        activation: "tanh", "relu", "gelu" or "elu".
        mean: the mean of the parts in place of their concatenation.

    Raises:
        ValueError: an unknown activation; parts of different sizes with `mean`.
    """

    like: Tensor

    def __init__(self, sizes: Sequence[int], widths: Sequence[int], activation: str, mean: bool = False):
        super().__init__()
        if mean and len(set(sizes)) > 1:
            raise ValueError(f"only parts of one size have a mean, not parts of {', '.join(map(str, sizes))}")
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
        """(B, T, H) from parts (B, T, D) or (B, D); (B, H) where every part is (B, D)."""
        joined = self._join(parts)
        return joined if self.first is None else self.rest(self.first(joined))

    def _join(self, parts: Sequence[Tensor]) -> Tensor:
        if len(parts) == 1:
            return parts[0]
        parts = aligned(parts)
        return torch.stack(parts).mean(0) if self.mean else torch.cat(parts, dim=-1)

    def hoist(self, known: Mapping[int, Tensor], batch: int, length: int, through: nn.Linear | None = None) -> Hoisted:
        """The first layer's share of the known parts at every step, and the weights of the live ones.

        Args:
            known: place of a part to its values.
            batch, length: B and T.
            through: the layer that comes first where the join has none of its own.
        """
        layer = self.first or through
        if layer is None:
            none = self.like.new_empty(batch, length, 0)
            return Hoisted(torch.cat(aligned([none, *known.values()]), dim=-1), [], known)
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
        """Features (B, H) at step t, or (B, N, H) at several, from their hoisted share and the live parts."""
        first = hoisted.steps[t] if isinstance(t, int) else hoisted.base[:, t]
        if self.first is None:
            seen = dict(zip(hoisted.known, first.split([self.sizes[i] for i in hoisted.known], dim=-1), strict=True))
            coming = iter(live)
            return self._join([seen[i] if i in seen else next(coming) for i in range(len(self.sizes))])
        for part, weight in zip(live, hoisted.weights, strict=True):
            first = torch.addmm(first, part, weight.t()) if part.dim() == 2 else first + part @ weight.t()
        features: Tensor = self.rest(first)
        return features


def perceptron(widths: Sequence[int], activation: str) -> nn.Sequential:
    """Linear layers from widths[0] to widths[-1], each followed by the activation."""
    if activation not in ACTIVATIONS:
        raise ValueError(f"unknown activation {activation!r}; known: {', '.join(ACTIVATIONS)}")
    if min(widths) < 1:
        raise ValueError(f"the widths of a perceptron are at least 1, but these are {', '.join(map(str, widths[1:]))}")
    layers: list[nn.Module] = []
    for a, b in pairwise(widths):
        layers += [nn.Linear(a, b), ACTIVATIONS[activation]()]
    return nn.Sequential(*layers)


def aligned(parts: Sequence[Tensor]) -> list[Tensor]:
    """The parts with a time axis, static ones repeated; as they are where none has one."""
    steps = max((part.shape[1] for part in parts if part.dim() == 3), default=None)
    if steps is None:
        return list(parts)
    return [part if part.dim() == 3 else part[:, None].expand(-1, steps, -1) for part in parts]
