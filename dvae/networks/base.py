"""What every network shares: its inputs, the join of pointwise parts, shifting in time.

A network maps the parents of one factor to features, under the masks that the factor declares. It has two forms that
must agree: `forward` evaluates all steps at once (teacher forcing), `start` and `step` one step at a time, with
everything that does not depend on a variable being drawn computed once, in `start`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from ..notation import Relation

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


_ONCE: ContextVar[dict[Any, Any] | None] = ContextVar("once", default=None)


@contextmanager
def computing_once() -> Iterator[None]:
    """Within it, `once` results are kept: for one evaluation of guide and model, whose parameters do not change."""
    if _ONCE.get() is not None:
        yield
        return
    token = _ONCE.set({})
    try:
        yield
    finally:
        _ONCE.reset(token)


def once(module: nn.Module, inputs: Sequence[Tensor | None], compute: Callable[[], Tensor]) -> Tensor:
    """compute(), or its result for the same module and the same input tensors within `computing_once`.

    Factors that share a module (SRNN's h_t) then evaluate it once, without knowing of each other.
    """
    kept = _ONCE.get()
    if kept is None:
        return compute()
    key = (id(module), torch.is_grad_enabled(), *map(id, inputs))
    if key not in kept:
        kept[key] = (inputs, compute())  # the inputs are held, so that their ids stay theirs
    return kept[key][1]


class Network(nn.Module):
    """Parents to features under masks; see the contract in `docs/networks.md`.

    Args:
        inputs: the parents.
        local: whether the child is a local variable. A static child has features (B, H) in place of (B, T, H).
        features: H.
    """

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

    def chain(self, state: Any) -> Chain | None:
        """The loop after `start` in the form that one fused function runs, where it has that form."""
        return None


class NetworkSpec(Protocol):
    """A description of a network: a frozen dataclass that `build`s one for a factor."""

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> Network:
        """The network of a factor with these parents, for a child of dimension `size`."""
        ...


def shift(values: Tensor, lag: int) -> Tensor:
    """values[:, t + lag] at every t of (B, T, D), zero where t + lag is outside."""
    if lag == 0:
        return values
    steps = values.shape[1]
    moved = values[:, max(lag, 0) : steps + min(lag, 0)] if abs(lag) < steps else values[:, :0]
    gap = min(abs(lag), steps)
    return functional.pad(moved, (0, 0, gap, 0) if lag < 0 else (0, 0, 0, gap))


def at(values: Sequence[Tensor], t: int, like: Tensor, size: int) -> Tensor:
    """values[t] of a loop's draws, zero outside the sequence; `like` is any (B, ...) tensor."""
    return values[t] if 0 <= t < len(values) else like.new_zeros(like.shape[0], size)


def valid_steps(lengths: Tensor, length: int) -> Tensor:
    """(B, T) True at the steps of a ragged batch that exist."""
    return torch.arange(length, device=lengths.device) < lengths[:, None]


def reverse(values: Tensor, lengths: Tensor | None) -> Tensor:
    """(B, T, D) with every sequence's valid steps in reverse order, padding left behind them."""
    if lengths is None:
        return values.flip(1)
    steps = torch.arange(values.shape[1], device=values.device)
    order = torch.where(steps < lengths[:, None], lengths[:, None] - 1 - steps, steps)
    return values.gather(1, order[..., None].expand_as(values))


@dataclass
class Hoisted:
    """What a `Join` computes before a loop: base (B, T, H), and the weights (H, D) of the parts still to come."""

    base: Tensor
    weights: list[Tensor]

    @cached_property
    def steps(self) -> tuple[Tensor, ...]:
        """The base by step. (unbind, not indexing: T selections would each write a (B, T, H) gradient.)"""
        return self.base.unbind(1)


@dataclass
class Chain:
    """A loop that adds one product with the child's value a step away to a hoisted base, and then is pointwise."""

    lag: int
    hoisted: Hoisted
    join: Join


class Join(nn.Module):
    """A multilayer perceptron on the concatenation of parts, of which some may come one step at a time.

    Args:
        sizes: dimension of every part.
        widths: of the layers; each is followed by the activation.
    """

    def __init__(self, sizes: Sequence[int], widths: Sequence[int], activation: str):
        super().__init__()
        if activation not in ACTIVATIONS:
            raise ValueError(f"unknown activation {activation!r}; known: {', '.join(ACTIVATIONS)}")
        self.sizes = tuple(sizes)
        self.first = nn.Linear(sum(sizes), widths[0])
        self.kind = activation
        self.activation = ACTIVATIONS[activation]()
        rest: list[nn.Module] = []
        for a, b in pairwise(widths):
            rest += [nn.Linear(a, b), ACTIVATIONS[activation]()]
        self.rest = nn.Sequential(*rest)

    def forward(self, parts: Sequence[Tensor]) -> Tensor:
        """(B, T, H) from parts (B, T, D) or (B, D); (B, H) where every part is (B, D)."""
        return self.finish(self.first(_concatenate(parts)))

    def hoist(self, given: Mapping[int, Tensor], batch: int, length: int) -> Hoisted:
        """The first layer's share of the given parts at every step, and the weights of the live parts."""
        weights = self.first.weight.split(self.sizes, dim=1)
        base = self.first.bias.expand(batch, length, -1)
        if given:
            matrix = torch.cat([weights[i] for i in given], dim=1)
            base = functional.linear(_concatenate(list(given.values())), matrix, self.first.bias)
            base = base if base.dim() == 3 else base[:, None].expand(-1, length, -1)
        return Hoisted(base, [weight for i, weight in enumerate(weights) if i not in given])

    def add(self, hoisted: Hoisted, t: int, live: Sequence[Tensor]) -> Tensor:
        """Features (B, H) at step t from their hoisted share and the live parts."""
        first = hoisted.steps[t]
        for part, weight in zip(live, hoisted.weights, strict=True):
            first = torch.addmm(first, part, weight.t())
        return self.finish(first)

    def finish(self, first: Tensor) -> Tensor:
        """The layers after the first product."""
        return self.rest(self.activation(first))


def _concatenate(parts: Sequence[Tensor]) -> Tensor:
    steps = max((part.shape[1] for part in parts if part.dim() == 3), default=None)
    if steps is not None:
        parts = [part if part.dim() == 3 else part[:, None].expand(-1, steps, -1) for part in parts]
    return torch.cat(list(parts), dim=-1) if len(parts) > 1 else parts[0]
