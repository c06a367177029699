"""Recurrent: forward and backward GRUs or LSTMs for what a factor reads over time, a perceptron for the rest."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from .base import ACTIVATIONS, Chain, Input, Join, Network, at, once, reverse, shift
from .dense import part

CELLS: dict[str, type[nn.GRU] | type[nn.LSTM]] = {"gru": nn.GRU, "lstm": nn.LSTM}


@dataclass(frozen=True)
class Recurrent:
    """Parents read over the past enter a forward network, those over the future a backward one.

    One that is read over {1:T} enters both, each frame once: those before t the forward one, the others the backward
    one (so that a guide's forward states can be the generative model's).

    Parents at single steps (and static ones) join after them. All parents with a past share one forward state, as
    VRNN's h_t summarises x and z together.

    Args:
        width: of the recurrent states.
        cell: "lstm" or "gru"; torch trains the first 2.4 times as fast on a CPU.
        layers: of each recurrent network.
        embed: width of a dense layer on what enters the recurrent networks; 0 for none.
        hidden: widths of the perceptron that joins the states and the pointwise parents.
        activation: "tanh", "relu", "gelu" or "elu".
    """

    width: int = 64
    cell: str = "lstm"
    layers: int = 1
    embed: int = 0
    hidden: tuple[int, ...] = (64,)
    activation: str = "tanh"

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> RecurrentNetwork:
        """The network of a factor with these parents."""
        if self.cell not in CELLS:
            raise ValueError(f"unknown cell {self.cell!r}; known: {', '.join(CELLS)}")
        return RecurrentNetwork(self, inputs, local)


class Memory(nn.Module):
    """The state of a recurrent network over one direction of time, at every step or step by step.

    Args:
        entries: (parent, lag): the network reads the parent at t + lag when it arrives at t.
        direction: +1 forward, -1 backward in time.
    """

    def __init__(self, spec: Recurrent, entries: Sequence[tuple[Input, int]], direction: int):
        super().__init__()
        self.layers: list[Any]
        self.embed: Any
        self.entries = tuple(entries)
        self.direction = direction
        size = sum(parent.size for parent, _ in entries)
        self.reads = [(parent.name, lag) for parent, lag in entries]
        self.embed = nn.Sequential(nn.Linear(size, spec.embed), ACTIVATIONS[spec.activation]()) if spec.embed else None
        kind = CELLS[spec.cell]
        sizes = [spec.embed or size] + [spec.width] * (spec.layers - 1)
        self.layers = nn.ModuleList(kind(a, spec.width, batch_first=True) for a in sizes)  # type: ignore[assignment]
        self.cell = gru_cell if spec.cell == "gru" else lstm_cell

    def forward(self, parents: Mapping[str, Tensor], lengths: Tensor | None) -> Tensor:
        """States (B, T, W) at every step."""
        inputs = [parents[parent.name] for parent, _ in self.entries]
        return once(self, [*inputs, lengths], lambda: self._states(parents, lengths))

    def _states(self, parents: Mapping[str, Tensor], lengths: Tensor | None) -> Tensor:
        states = torch.cat([shift(parents[parent.name], lag) for parent, lag in self.entries], dim=-1)
        if self.embed is not None:
            states = self.embed(states)
        if self.direction < 0:
            states = reverse(states, lengths)
        for layer in self.layers:
            states = layer(states)[0]
        return reverse(states, lengths) if self.direction < 0 else states

    def start(self, given: Mapping[str, Tensor], batch: int, lengths: Tensor | None) -> MemoryState:
        """The state before the first step, with the given parents' products with the first weights done."""
        first = self.embed[0] if self.embed is not None else self.layers[0]
        weight, bias = (first.weight, first.bias) if self.embed is not None else (first.weight_ih_l0, first.bias_ih_l0)
        columns = weight.split([parent.size for parent, _ in self.entries], dim=1)
        known = [i for i, (parent, _) in enumerate(self.entries) if parent.name in given]
        live = [i for i in range(len(self.entries)) if i not in known]
        if known:
            values = torch.cat([shift(given[self.entries[i][0].name], self.entries[i][1]) for i in known], dim=-1)
            base = functional.linear(values, torch.cat([columns[i] for i in known], dim=1), bias).unbind(1)
        else:
            base = bias.expand(batch, -1)
        zero = weight.new_zeros(batch, self.layers[0].hidden_size)
        return MemoryState(
            base=base,
            live=[(*self.entries[i], columns[i].t()) for i in live],
            lengths=lengths,
            hidden=[(zero, zero)] * len(self.layers),
        )

    def step(self, state: MemoryState, t: int, drawn: Mapping[str, Sequence[Tensor]]) -> Tensor:
        """The state (B, W) at t; `state` is advanced."""
        value = state.base if isinstance(state.base, Tensor) else state.base[t]
        for parent, lag, weight in state.live:
            value = torch.addmm(value, at(drawn[parent.name], t + lag, value, parent.size), weight)
        if self.embed is not None:
            value = self.embed[1](value)
        valid = None if state.lengths is None or self.direction > 0 else (t < state.lengths)[:, None]
        for i, layer in enumerate(self.layers):
            if i or self.embed is not None:
                value = functional.linear(value, layer.weight_ih_l0, layer.bias_ih_l0)
            new = self.cell(value, state.hidden[i], layer)
            if valid is not None:  # a backward network starts at a sequence's last valid step
                new = (torch.where(valid, new[0], state.hidden[i][0]), torch.where(valid, new[1], state.hidden[i][1]))
            state.hidden[i] = new
            value = new[0]
        return value


@dataclass
class MemoryState:
    """What a `Memory` keeps between steps: hoisted products, live parents, hidden states by layer."""

    base: Tensor | tuple[Tensor, ...]
    live: list[tuple[Input, int, Tensor]]
    lengths: Tensor | None
    hidden: list[tuple[Tensor, Tensor]]


def gru_cell(gates: Tensor, hidden: tuple[Tensor, Tensor], layer: Any) -> tuple[Tensor, Tensor]:
    """torch.nn.GRU's step from the input's product W x + b (B, 3W)."""
    h = hidden[0]
    width = h.shape[1]
    recurrent = functional.linear(h, layer.weight_hh_l0, layer.bias_hh_l0)
    reset, update = torch.sigmoid(gates[:, : 2 * width] + recurrent[:, : 2 * width]).chunk(2, 1)
    candidate = torch.tanh(torch.addcmul(gates[:, 2 * width :], reset, recurrent[:, 2 * width :]))
    new = torch.lerp(candidate, h, update)
    return new, new


def lstm_cell(gates: Tensor, hidden: tuple[Tensor, Tensor], layer: Any) -> tuple[Tensor, Tensor]:
    """torch.nn.LSTM's step from the input's product W x + b (B, 4W)."""
    h, cell = hidden
    entry, forget, candidate, output = torch.addmm(gates + layer.bias_hh_l0, h, layer.weight_hh_l0.t()).chunk(4, 1)
    cell = torch.sigmoid(forget) * cell + torch.sigmoid(entry) * torch.tanh(candidate)
    return torch.sigmoid(output) * torch.tanh(cell), cell


class RecurrentNetwork(Network):
    """See `Recurrent`."""

    def __init__(self, spec: Recurrent, inputs: Sequence[Input], local: bool):
        super().__init__(inputs, local, spec.hidden[-1])
        past: list[tuple[Input, int]] = []
        future: list[tuple[Input, int]] = []
        self.points: list[tuple[Input, int | None]] = []
        for parent in self.inputs:
            if parent.relation is None:
                self.points.append((parent, None))
                continue
            if parent.relation.intervals is None:
                raise ValueError(
                    f"Recurrent cannot obey the custom mask {parent.relation.name} of {parent.name}: a recurrent state "
                    "reads all of a past or future; use networks.Attention or networks.Linear for this factor"
                )
            for low, high in parent.relation.intervals:
                first = 0 if math.isinf(low) else int(low)
                last = (-1 if local and math.isinf(low) else 0) if math.isinf(high) else int(high)
                # A memory has read its past (future) by t; what lies on the other side of t joins by single steps.
                if math.isinf(low):
                    past.append((parent, min(last, 0)))
                    first = 1
                if math.isinf(high):
                    future.append((parent, max(0 if math.isinf(low) else int(low), 0)))
                    last = -1
                self.points += [(parent, lag) for lag in range(first, last + 1)]
        self.past = Memory(spec, past, +1) if past else None
        self.future = Memory(spec, future, -1) if future else None
        sizes = [spec.width] * len(self.memories) + [parent.size for parent, _ in self.points]
        self.join = Join(sizes, spec.hidden, spec.activation)

    @property
    def memories(self) -> list[Memory]:
        """The forward and the backward memory, where there are such parents."""
        return [memory for memory in (self.past, self.future) if memory is not None]

    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        """See `Network.forward`."""
        states = [memory(parents, lengths) for memory in self.memories]
        if not self.local:
            states = [
                summary(state, memory.direction, lengths) for state, memory in zip(states, self.memories, strict=True)
            ]
        points = [part(parents[parent.name], lag) for parent, lag in self.points]
        features = self.join(states + points)
        return features[:, None].expand(-1, length, -1) if self.local and features.dim() == 2 else features

    def start(self, given: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        """See `Network.start`."""
        known: dict[int, Tensor] = {}
        memories: list[tuple[Memory, MemoryState]] = []
        for i, memory in enumerate(self.memories):
            if all(parent.name in given for parent, _ in memory.entries):
                known[i] = memory(given, lengths)
            else:
                memories.append((memory, memory.start(given, batch, lengths)))
        live: list[tuple[Input, int]] = []
        for i, (parent, lag) in enumerate(self.points, len(self.memories)):
            if parent.name in given:
                known[i] = part(given[parent.name], lag)
            elif lag is not None:
                live.append((parent, lag))
        return self.join.hoist(known, batch, length), memories, live

    def step(self, state: Any, t: int, drawn: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        """See `Network.step`."""
        hoisted, memories, live = state
        parts = [memory.step(memory_state, t, drawn) for memory, memory_state in memories]
        parts += [at(drawn[parent.name], t + lag, hoisted.base, parent.size) for parent, lag in live]
        return self.join.add(hoisted, t, parts), state

    def chain(self, state: Any) -> Chain | None:
        """See `Network.chain`."""
        hoisted, memories, live = state
        return Chain(live[0][1], hoisted, self.join) if len(live) == 1 and not memories else None


def tie_past(first: object, *others: object) -> None:
    """Gives recurrent networks one forward memory: of the same parents at the same lags, evaluated once for all.

    Raises:
        ValueError: networks whose forward memories read different things.
    """
    for other in others:
        if not (isinstance(first, RecurrentNetwork) and isinstance(other, RecurrentNetwork)):
            raise ValueError(f"only recurrent networks have a memory to tie, not {type(first).__name__}")
        if first.past is None or other.past is None or first.past.reads != other.past.reads:
            raise ValueError(f"cannot tie memories of different pasts: {first.past} and {other.past}")
        other.past = first.past


def summary(states: Tensor, direction: int, lengths: Tensor | None) -> Tensor:
    """(B, W): the state that has read the whole sequence, of states (B, T, W) over time."""
    if direction < 0:
        return states[:, 0]
    if lengths is None:
        return states[:, -1]
    return states[torch.arange(states.shape[0], device=states.device), lengths - 1]
