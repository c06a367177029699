"""Recurrent: forward and backward GRUs or LSTMs for parents over time, and a perceptron for the rest."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional
from typing_extensions import override

from ..factorization.relations import ALL
from .base import Chain, Hoisted, Input, Join, Network, part, perceptron
from .cells import GRU, LSTM
from .extract import Extract, Extractors
from .loop import Rows, at, each_at, memoize, reverse, select, shift, stack_steps, store_result

CELLS: dict[str, type[GRU] | type[LSTM]] = {"gru": GRU, "lstm": LSTM}


@dataclass(frozen=True)
class Recurrent:
    """A recurrent network forward in time for parents read over the past, and one backward for parents of the future.

    A parent read over {1:T} enters both, each frame once: frames before t enter the forward network, the others the
    backward network. A guide can therefore share its forward network with the generative model (`tie`).

    A perceptron then reads the states, the parents at single steps and the static parents. All parents with a past
    share one forward state, as in VRNN, where h_t summarises x and z together.

    Args:
        width: width of the recurrent states.
        cell: "lstm" or "gru"; on a CPU, torch trains an LSTM 2.4 times as fast as a GRU.
        layers: layers of each recurrent network.
        embed: width of a dense layer on the input of the recurrent networks; 0 for none.
        hidden: widths of the perceptron on the states, the parents at single steps and the static parents; with () the
            features are the concatenation of these.
        activation: "tanh", "relu", "gelu" or "elu".
        extract: extractors by parent, applied first: widths of a perceptron, or the specification of another module,
            such as `NodeGraph()`. Their output is 0 outside the sequence.
        separate: whether each parent has its own forward and backward state.
        join_current: whether, of a parent read over {<=t}, the forward network reads only steps up to t-1, and the
            perceptron reads the value at t.
        stack: whether the backward network also reads the forward states, and the perceptron reads only the backward
            states; every parent with a past must then be read over {1:T}.
        mean: whether to average the inputs of the perceptron instead of concatenating them; they need equal sizes.
    """

    width: int = 64
    cell: str = "lstm"
    layers: int = 1
    embed: int = 0
    hidden: tuple[int, ...] = (64,)
    activation: str = "tanh"
    extract: Extract = field(default_factory=dict)
    separate: bool = False
    join_current: bool = False
    stack: bool = False
    mean: bool = False

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> RecurrentNetwork:
        """Return the network of a factor, as in `NetworkSpec.build`.

        Args:
            inputs: the parents of the factor.
            local: whether the child has a value at every step; otherwise it is static.
            size: D, dimension of the child.

        Raises:
            ValueError: an option is invalid, the parents do not match `stack` or `mean`, or a parent has a custom mask.
        """
        if self.cell not in CELLS:
            raise ValueError(f"unknown cell {self.cell!r}; known: {', '.join(CELLS)}")
        if self.width < 1 or self.layers < 1:
            raise ValueError(
                f"`width` and `layers` of a recurrent network must be at least 1, got {self.width} and {self.layers}"
            )
        return RecurrentNetwork(self, inputs, local)


class Memory(nn.Module):
    """A recurrent network over one direction of time, evaluated at all steps at once or step by step.

    Args:
        spec: sizes and cell of the network.
        entries: pairs (parent, lag); at step t the network reads the parent at t + lag.
        direction: +1 forward, -1 backward in time.
        under: memory whose states are also inputs, concatenated before the parents; None for no such inputs.
    """

    def __init__(
        self, spec: Recurrent, entries: Sequence[tuple[Input, int]], direction: int, under: Memory | None = None
    ):
        super().__init__()
        self.entries = tuple(entries)
        self.direction = direction
        self.under = under
        size = sum(parent.size for parent, _ in entries) + (spec.width if under else 0)
        self.reads = [(parent.name, lag) for parent, lag in entries]
        self.embed: Any = perceptron((size, spec.embed), spec.activation) if spec.embed else None
        kind = CELLS[spec.cell]
        sizes = [spec.embed or size] + [spec.width] * (spec.layers - 1)
        self.layers: Any = nn.ModuleList(kind(a, spec.width, batch_first=True) for a in sizes)
        self.cell = gru_cell if spec.cell == "gru" else lstm_cell

    def forward(self, values: Mapping[str, Tensor], keys: Mapping[str, Tensor], lengths: Tensor | None) -> Tensor:
        """Return the states (B, T, W) at every step.

        Args:
            values: {name: features of the parent}.
            keys: {name: the parent itself}, which identifies states that have already been computed.
            lengths: (B,) numbers of valid steps in a ragged batch.
        """
        return memoize(self, self.key(keys, lengths), lambda: self._states(values, keys, lengths))

    def key(self, keys: Mapping[str, Tensor], lengths: Tensor | None) -> list[Tensor | None]:
        """Return the tensors that determine the states; `memoize` uses them as the key of the stored states."""
        return [*(keys[parent.name] for parent, _ in self.entries), lengths]

    def _states(self, values: Mapping[str, Tensor], keys: Mapping[str, Tensor], lengths: Tensor | None) -> Tensor:
        parts = [shift(values[parent.name], lag) for parent, lag in self.entries]
        if self.under is not None:
            parts = [self.under(values, keys, lengths), *parts]
        states = torch.cat(parts, dim=-1) if len(parts) > 1 else parts[0]
        if self.embed is not None:
            states = self.embed(states)
        if self.direction < 0:
            states = reverse(states, lengths)
        for layer in self.layers:
            states = layer(states)[0]
        return reverse(states, lengths) if self.direction < 0 else states

    def start(self, parents: Mapping[str, Tensor], batch: int, lengths: Tensor | None) -> MemoryState:
        """Return the state before the first step, with the first layer already applied to the given parents.

        Args:
            parents: {name: features (B, T, D)} of the parents that the loop does not draw.
            batch: B, number of sequences.
            lengths: (B,) number of valid steps of each sequence, or None.
        """
        first = self.embed[0] if self.embed is not None else self.layers[0]
        weight, bias = (first.weight, first.bias) if self.embed is not None else (first.weight_ih_l0, first.bias_ih_l0)
        columns = weight.split([parent.size for parent, _ in self.entries], dim=1)
        known_entries = [i for i, (parent, _) in enumerate(self.entries) if parent.name in parents]
        live = [i for i in range(len(self.entries)) if i not in known_entries]
        base = bias.expand(batch, 1, -1)
        if known_entries:
            values = torch.cat(
                [shift(parents[self.entries[i][0].name], self.entries[i][1]) for i in known_entries], dim=-1
            )
            base = functional.linear(values, torch.cat([columns[i] for i in known_entries], dim=1), bias)
        zero = weight.new_zeros(batch, self.layers[0].hidden_size)
        return MemoryState(
            base=base,
            live=[(*self.entries[i], columns[i].t()) for i in live],
            lengths=lengths,
            hidden=[(zero, zero)] * len(self.layers),
        )

    def step(self, state: MemoryState, t: int, samples: Mapping[str, Sequence[Tensor]]) -> Tensor:
        """Return the state (B, W) at step t; `state` is advanced in place.

        Args:
            state: state from `start`, after the steps before t in the order of the loop.
            t: the step, counted from 0.
            samples: {name: list with the features (B, D) of each step} of the parents that the loop draws.
        """
        value = state.steps[t if len(state.steps) > 1 else 0]
        for parent, lag, weight in state.live:
            value = torch.addmm(value, at(samples[parent.name], t + lag, value, parent.size), weight)
        if self.embed is not None:
            value = self.embed[1](value)
        valid = None if state.lengths is None or self.direction > 0 else (t < state.lengths)[:, None]
        for i, layer in enumerate(self.layers):
            if i or self.embed is not None:
                value = functional.linear(value, layer.weight_ih_l0, layer.bias_ih_l0)
            new = self.cell(value, state.hidden[i], layer)
            if valid is not None:  # a backward network must start at the last valid step of each sequence
                new = (torch.where(valid, new[0], state.hidden[i][0]), torch.where(valid, new[1], state.hidden[i][1]))
            state.hidden[i] = new
            value = new[0]
        return value

    def forward_chunk(self, state: MemoryState, t: int, count: int, samples: Mapping[str, Sequence[Tensor]]) -> Tensor:
        """Return the states (B, N, W) of a forward memory at N steps from t on; `state` is advanced in place."""
        if self.embed is None and len(state.live) < len(self.entries):  # part of its gates is known
            return torch.stack([self.step(state, s, samples) for s in range(t, t + count)], dim=1)
        like = state.hidden[0][0]
        parts = [stack_steps(samples[parent.name], t + lag, count, like, parent.size) for parent, lag, _ in state.live]
        if self.embed is None:
            value = torch.cat(parts, dim=-1)
        else:
            value = torch.stack([state.steps[s if len(state.steps) > 1 else 0] for s in range(t, t + count)], dim=1)
            for part, (_, _, weight) in zip(parts, state.live, strict=True):
                value = value + part @ weight
            value = self.embed[1](value)
        for i, layer in enumerate(self.layers):
            before = tuple(each[None].contiguous() for each in state.hidden[i])
            value, after = layer(value, before if self.cell is lstm_cell else before[0])
            state.hidden[i] = (after[0][0], after[1][0]) if self.cell is lstm_cell else (after[0], after[0])
        return value

    def gates(self, state: MemoryState, length: int) -> tuple[Tensor, Tensor] | None:
        """Return the arguments `cell` of `distributions.chain`, or None if the memory is not a single LSTM layer.

        They are the contribution (B, T, 4 W) of the given inputs to the gates, and the weight of all other inputs.
        """
        if self.embed is not None or len(self.layers) > 1 or self.cell is not lstm_cell:
            return None
        (layer,) = self.layers
        live = torch.cat([*(weight.t() for _, _, weight in state.live), layer.weight_hh_l0], dim=1)
        return (state.base + layer.bias_hh_l0).expand(-1, length, -1), live


@dataclass
class MemoryState:
    """The state of a `Memory` between steps of a loop.

    Args:
        base: (B, T, H), or (B, 1, H) for all steps, contribution of the given parents to the first layer.
        live: parents that the loop draws, their lags and their weights (D, H) in the first layer.
        lengths: (B,) number of valid steps of each sequence, or None.
        hidden: states (B, W) of each layer: h and the cell for an LSTM, h twice for a GRU.
    """

    base: Tensor
    live: list[tuple[Input, int, Tensor]]
    lengths: Tensor | None
    hidden: list[tuple[Tensor, Tensor]]

    @cached_property
    def steps(self) -> Sequence[Tensor]:
        """The base (B, H) of each step, or a single base for all steps."""
        return self.base.unbind(1)

    def select(self, rows: Tensor | None) -> MemoryState:
        """Return the state of the batch rows with indices (N,), without a copy of the base."""
        selected = MemoryState(self.base, self.live, select(self.lengths, rows), select(self.hidden, rows))
        selected.steps = select(self.steps, rows)
        return selected


def gru_cell(gates: Tensor, hidden: tuple[Tensor, Tensor], layer: Any) -> tuple[Tensor, Tensor]:
    """Run one step of torch.nn.GRU and return the new state h (B, W), twice.

    Args:
        gates: (B, 3 W) contribution of the input, with bias, to the gates.
        hidden: the last state h, twice.
        layer: `torch.nn.GRU` with one layer, which has the recurrent weights.
    """
    h = hidden[0]
    width = h.shape[1]
    recurrent = functional.linear(h, layer.weight_hh_l0, layer.bias_hh_l0)
    reset, update = torch.sigmoid(gates[:, : 2 * width] + recurrent[:, : 2 * width]).chunk(2, 1)
    candidate = torch.tanh(torch.addcmul(gates[:, 2 * width :], reset, recurrent[:, 2 * width :]))
    new = torch.lerp(candidate.to(h.dtype), h, update.to(h.dtype))  # under autocast the gates have half precision
    return new, new


def lstm_cell(gates: Tensor, hidden: tuple[Tensor, Tensor], layer: Any) -> tuple[Tensor, Tensor]:
    """Run one step of torch.nn.LSTM and return the new state h and the new cell, (B, W) each.

    Args:
        gates: (B, 4 W) contribution of the input, with bias, to the gates.
        hidden: the last state h and the last cell.
        layer: `torch.nn.LSTM` with one layer, which has the recurrent weights.
    """
    h, cell = hidden
    entry, forget, candidate, output = torch.addmm(gates + layer.bias_hh_l0, h, layer.weight_hh_l0.t()).chunk(4, 1)
    cell = torch.sigmoid(forget) * cell + torch.sigmoid(entry) * torch.tanh(candidate)
    return torch.sigmoid(output) * torch.tanh(cell), cell


class RecurrentNetwork(Network):
    """Network of `Recurrent`."""

    stationary = streams = True

    def __init__(self, spec: Recurrent, inputs: Sequence[Input], local: bool):
        super().__init__(inputs, local, 0)
        self.extractors = Extractors(self.inputs, spec.extract, spec.activation)
        past: list[tuple[Input, int]] = []
        future: list[tuple[Input, int]] = []
        self.points: list[tuple[Input, int | None]] = []
        for parent in map(self.extractors.seen, self.inputs):
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
                # A memory covers one side of t; steps on the other side are joined as single steps.
                if math.isinf(low):
                    past.append((parent, min(last, -1 if spec.join_current and local else 0)))
                    first = past[-1][1] + 1 if last >= 0 else 1
                if math.isinf(high):
                    future.append((parent, max(0 if math.isinf(low) else int(low), 0)))
                    last = -1
                self.points += [(parent, lag) for lag in range(first, last + 1)]
        if spec.stack and (not past or spec.separate or any(parent.relation != ALL for parent, _ in past + future)):
            raise ValueError(
                "Recurrent(stack=True) needs separate=False, and every parent with a past or future must be read over "
                "{1:T}; change these, or use stack=False"
            )
        pasts = [Memory(spec, entries, +1) for entries in _groups(past, spec.separate)]
        under = pasts[0] if spec.stack else None
        futures = [Memory(spec, entries, -1, under) for entries in _groups(future, spec.separate)]
        self.memories: Any = nn.ModuleList(futures if spec.stack else pasts + futures)
        sizes = [spec.width] * len(self.memories) + [parent.size for parent, _ in self.points]
        self.join = Join(sizes, spec.hidden, spec.activation, spec.mean)
        self.features = self.join.features

    @property
    def past(self) -> Memory | None:
        """The forward memory if all parents share one, otherwise None."""
        memories = [memory.under or memory for memory in self.memories]
        forward = [memory for memory in memories if memory.direction > 0]
        return forward[0] if len(forward) == 1 else None

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        values = self.extractors.of(parents, lengths)
        states = [memory(values, parents, lengths) for memory in self.memories]
        if not self.local:
            states = [summary(s, memory.direction, lengths) for s, memory in zip(states, self.memories, strict=True)]
        features: Tensor = self.join([*states, *(part(values[parent.name], lag) for parent, lag in self.points)])
        return features[:, None].expand(-1, length, -1) if self.local and features.dim() == 2 else features

    @override
    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        values = self.extractors.of(parents, lengths)
        known_parts: dict[int, Tensor] = {}
        memories: list[tuple[Memory, MemoryState]] = []
        for i, memory in enumerate(self.memories):
            if all(parent.name in parents for parent, _ in memory.entries):
                known_parts[i] = memory(values, parents, lengths)
            else:
                memories.append((memory, memory.start(values, batch, lengths)))
        live: list[tuple[Input, int]] = []
        for i, (parent, lag) in enumerate(self.points, len(self.memories)):
            if parent.name in parents:
                known_parts[i] = part(values[parent.name], lag)
            elif lag is not None:
                live.append((parent, lag))
        hoisted = self.join.hoist(known_parts, batch, length)
        return RecurrentState(hoisted, memories, live, self.extractors.start(length), dict(parents), lengths)

    @override
    def step(self, state: RecurrentState, t: int, samples: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        values = self.extractors.drawn(state.extracted, samples, state.lengths) if self.extractors else samples
        parts = [memory.step(memory_state, t, values) for memory, memory_state in state.memories]
        like = parts[0] if parts else state.hoisted.like
        parts += each_at(values, state.live, t, like) if state.live else []
        return self.join.add(state.hoisted, t, parts), state

    @override
    def forward_chunk(self, state: RecurrentState, t: int, count: int, samples: Any) -> tuple[Tensor, Any]:
        values = self.extractors.drawn(state.extracted, samples, state.lengths) if self.extractors else samples
        parts = [memory.forward_chunk(memory_state, t, count, values) for memory, memory_state in state.memories]
        like = parts[0] if parts else state.hoisted.like
        parts += [stack_steps(values[parent.name], t + lag, count, like, parent.size) for parent, lag in state.live]
        return self.join.add(state.hoisted, slice(t, t + count), parts), state

    @override
    def chain(self, state: RecurrentState) -> Chain | None:
        plain = all(isinstance(extractor, nn.Sequential) for extractor in self.extractors.values())
        if len(state.memories) + len(state.live) != 1 or not plain:
            return None
        if not state.memories:
            ((parent, lag),) = state.live
            return Chain(lag, self.join, state.hoisted, self._layers(parent.name))
        ((memory, memory_state),) = state.memories
        cell = memory.gates(memory_state, state.hoisted.base.shape[1])
        if cell is None or len(memory_state.live) != 1:
            return None
        ((parent, lag, _),) = memory_state.live

        def remember(child: Tensor, states: Tensor) -> None:
            store_result(memory, memory.key({**state.given, parent.name: child}, memory_state.lengths), states)

        return Chain(lag, self.join, state.hoisted, self._layers(parent.name), cell, remember)

    def _layers(self, name: str) -> tuple[tuple[Tensor, Tensor], ...]:
        if name not in self.extractors:
            return ()
        layers: Any = self.extractors[name]
        return tuple((layer.weight, layer.bias) for layer in layers if isinstance(layer, nn.Linear))


@dataclass
class RecurrentState:
    """The state of a `RecurrentNetwork` between steps.

    Args:
        hoisted: contribution of the given parents to the perceptron.
        memories: memories that read drawn variables, and their states.
        live: parents at single steps that the loop draws, and their lags.
        extracted: {name: (extractor, its output for the draws so far)}.
        given: {name: values} of the parents that the loop does not draw.
        lengths: (B,) number of valid steps of each sequence, or None.
    """

    hoisted: Hoisted
    memories: list[tuple[Memory, MemoryState]]
    live: list[tuple[Input, int]]
    extracted: dict[str, tuple[Any, Rows]]
    given: dict[str, Tensor]
    lengths: Tensor | None

    def select(self, rows: Tensor | None) -> RecurrentState:
        """Return the state of the batch rows with indices (N,); the given parents are unchanged."""
        memories, extracted, lengths = (select(each, rows) for each in (self.memories, self.extracted, self.lengths))
        return RecurrentState(self.hoisted.select(rows), memories, self.live, extracted, self.given, lengths)


def tie(first: Any, *others: Any) -> None:
    """Make other recurrent networks use the forward memory of the first network, including its extractors.

    All forward memories must read the same parents at the same lags. Within `loop.memoizing`, their states are computed
    once for all networks.

    Args:
        first: network whose forward memory is shared.
        others: networks that use it from now on.

    Raises:
        ValueError: a network has no single forward memory, or the memories differ in parents, lags or parameter shapes.
    """
    shape = _shape(first)
    for other in others:
        if (other_shape := _shape(other)) != shape:
            raise ValueError(
                f"cannot tie forward memories that differ in parents, lags or parameter shapes: the first has {shape}, "
                f"another has {other_shape}"
            )
        replaced = other.past
        for memory in other.memories:
            if memory.under is replaced:
                memory.under = first.past
        other.memories = nn.ModuleList(first.past if memory is replaced else memory for memory in other.memories)
        for name, _ in first.past.reads:
            if name in first.extractors:
                other.extractors[name] = first.extractors[name]


def _shape(network: Any) -> dict[str, Any]:
    """Return the properties that tied forward memories must share: parents, lags and parameter shapes."""
    if not isinstance(network, RecurrentNetwork):
        raise ValueError(
            f"only recurrent networks can be tied, got a {type(network).__name__}; give both networks as `Recurrent`"
        )
    if network.past is None:
        raise ValueError(
            "only networks with exactly one forward memory can be tied, but this one reads no past, or has one memory "
            "for each parent; set separate=False, and let it read the past"
        )
    parts = {name: network.extractors[name] for name, _ in network.past.reads if name in network.extractors}
    shapes = {name: [tuple(p.shape) for p in part.parameters()] for name, part in parts.items()}
    return {"reads": network.past.reads, "memory": [tuple(p.shape) for p in network.past.parameters()], **shapes}


def _groups(entries: list[tuple[Input, int]], separate: bool) -> list[list[tuple[Input, int]]]:
    """Return the entries (parent, lag) of each memory: one memory per parent if `separate`, otherwise one for all."""
    if not separate:
        return [entries] if entries else []
    names = dict.fromkeys(parent.name for parent, _ in entries)
    return [[entry for entry in entries if entry[0].name == name] for name in names]


def summary(states: Tensor, direction: int, lengths: Tensor | None) -> Tensor:
    """Return the state (B, W) after reading the whole sequence, from states (B, T, W)."""
    if direction < 0:
        return states[:, 0]
    if lengths is None:
        return states[:, -1]
    return states[torch.arange(states.shape[0], device=states.device), lengths - 1]


@dataclass(frozen=True)
class Dense:
    """A multilayer perceptron on static parents and parents at single steps, such as w, z_{t-1} and x_{t-3:t-1}.

    Args:
        widths: widths of the layers; with () the features are the concatenated parents.
        activation: "tanh", "relu", "gelu" or "elu".
    """

    widths: tuple[int, ...] = (64,)
    activation: str = "tanh"

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> DenseNetwork:
        """Return the network of a factor, as in `NetworkSpec.build`.

        Args:
            inputs: the parents of the factor.
            local: whether the child has a value at every step; otherwise it is static.
            size: D, dimension of the child.

        Raises:
            ValueError: a parent is read over a range without end, or the activation or a width is invalid.
        """
        return DenseNetwork(self, inputs, local)


class DenseNetwork(RecurrentNetwork):
    """Network of `Dense`: a recurrent network without a memory."""

    def __init__(self, spec: Dense, inputs: Sequence[Input], local: bool):
        for parent in inputs:
            if parent.relation is not None and not (local and parent.lags is not None):
                raise ValueError(
                    f"Dense reads single steps of its parents, but {parent.name} is read at {parent.relation.name}; "
                    "use networks.Recurrent or networks.Attention for this factor"
                )
        super().__init__(Recurrent(hidden=spec.widths, activation=spec.activation), inputs, local)
