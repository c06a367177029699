"""Attention: masked cross-attention, from the current step to what it may see (Vaswani et al., 2017, arXiv 1706.03762).

Distances enter as linear biases (Press et al., 2022, arXiv 2108.12409) rather than as absolute positions, so that a
model runs beyond the length it was trained on.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from typing_extensions import override

from ..constants import indices, visible
from ..relations import Relation
from .base import ACTIVATIONS, Hoisted, Input, Join, Network, aligned, at, part, valid_steps
from .extract import Extract, Extractors
from .rows import Rows, select


@dataclass(frozen=True)
class Attention:
    """Pointwise parents form the query; parents read over a range are keys and values under their mask.

    A learned start token is always visible, because a first step has no past.

    Args:
        width: of queries, keys and values.
        heads: number of attention heads; divides the width.
        layers: cross-attention layers over the same keys.
        feedforward: width of the perceptron after each attention; 0 for four times the width.
        activation: of the perceptrons.
        nearest: the nearest visible frame of each range joins the query, which then knows where in a sequence it is
            before it attends to more.
        extract: what comes before all else, by parent: widths of a perceptron, or the description of another module,
            such as `NodeGraph()`.
    """

    width: int = 64
    heads: int = 4
    layers: int = 1
    feedforward: int = 0
    activation: str = "gelu"
    nearest: bool = True
    extract: Extract = field(default_factory=dict)

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> AttentionNetwork:
        """The network of a factor with these parents."""
        return AttentionNetwork(self, inputs, local)


@dataclass(frozen=True)
class SelfAttention(Attention):
    """A transformer's encoder: every frame is a token, of the parents in it and of static ones, and sees the others.

    It is for a local variable that reads parents over {1:T}; over {<=t} or {>=t} it looks to one side. What else the
    factor reads, such as its own past, is attended to after the encoder, as in `Attention`, with the frame's token in
    the query. Heads take turns to look back and ahead: to the other side, distances count four times.
    """

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> SelfAttentionNetwork:  # type: ignore[override]
        """The network of a factor with these parents.

        Raises:
            ValueError: there is nothing to encode.
        """
        return SelfAttentionNetwork(self, inputs, local)


class Layer(nn.Module):
    """One cross-attention and its perceptron, both residual with normalisation before them."""

    def __init__(self, spec: Attention):
        super().__init__()
        if spec.width % spec.heads:
            raise ValueError(f"width {spec.width} is not a multiple of heads {spec.heads}")
        self.heads = spec.heads
        inner = spec.feedforward or 4 * spec.width
        self.norm_query = nn.LayerNorm(spec.width)
        self.query = nn.Linear(spec.width, spec.width)
        self.keys_values = nn.Linear(spec.width, 2 * spec.width)
        self.out = nn.Linear(spec.width, spec.width)
        self.perceptron = nn.Sequential(
            nn.LayerNorm(spec.width),
            nn.Linear(spec.width, inner),
            ACTIVATIONS[spec.activation](),
            nn.Linear(inner, spec.width),
        )

    def project(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Keys and values (B, heads, S, W / heads) of tokens (B, S, W)."""
        keys, values = self.keys_values(tokens).unflatten(-1, (2 * self.heads, -1)).transpose(1, 2).chunk(2, dim=1)
        return keys, values

    def queries(self, stream: Tensor) -> Tensor:
        """(B, heads, T, W / heads) from the stream (B, T, W)."""
        query: Tensor = self.query(self.norm_query(stream)).unflatten(-1, (self.heads, -1))
        return query.transpose(1, 2)

    def weights(self, stream: Tensor, keys: Tensor, bias: Tensor) -> Tensor:
        """The shares (B, heads, T, S) in which a query mixes the values."""
        query = self.queries(stream)
        return (query @ keys.transpose(-1, -2) / math.sqrt(query.shape[-1]) + bias).softmax(-1)

    def forward(self, stream: Tensor, keys: Tensor, values: Tensor, bias: Tensor) -> Tensor:
        """The stream (B, T, W) after attending under the additive bias, broadcastable to (B, heads, T, S)."""
        if stream.shape[1] == 1:  # a step of a loop, for which the fused kernel takes several times as long
            seen = self.weights(stream, keys, bias) @ values
        else:
            seen = functional.scaled_dot_product_attention(self.queries(stream), keys, values, attn_mask=bias)
        stream = stream + self.out(seen.transpose(1, 2).flatten(2))
        update: Tensor = self.perceptron(stream)
        return stream + update


class AttentionNetwork(Network):
    """What `Attention` describes."""

    slopes: Tensor

    def __init__(self, spec: Attention, inputs: Sequence[Input], local: bool):
        super().__init__(inputs, local, spec.width)
        self.heads = spec.heads
        self.extractors = Extractors(self.inputs, spec.extract, spec.activation)
        self.points: list[tuple[Input, int | None]] = []
        self.ranged: list[Input] = []
        for parent in map(self.extractors.seen, self.inputs):
            lags = parent.lags
            if parent.relation is None:
                self.points.append((parent, None))
            elif local and lags is not None and len(lags) == 1:
                self.points.append((parent, lags[0]))
            else:
                self.ranged.append(parent)
                if spec.nearest and local and parent.relation.intervals is not None:
                    nearest = min(
                        (max(low, min(high, 0)) for low, high in parent.relation.intervals),
                        key=lambda lag: (abs(lag), lag),
                    )
                    self.points.append((parent, int(nearest)))
        if self.ranged:
            self.start_token = nn.Parameter(torch.randn(spec.width) / math.sqrt(spec.width))
        self.embed = nn.ModuleDict({p.name: nn.Linear(p.size, spec.width) for p in self.ranged})
        sizes = [parent.size for parent, _ in self.points]
        self.point = Join(sizes, (spec.width, spec.width), spec.activation) if sizes else None
        self.origin = nn.Parameter(torch.randn(spec.width) / math.sqrt(spec.width))
        self.layers: Any = nn.ModuleList(Layer(spec) for _ in range(spec.layers if self.ranged else 0))
        self.norm = nn.LayerNorm(spec.width)
        self.register_buffer("slopes", _slopes(spec.heads), persistent=False)

    def bias(self, parent: Input, length: int) -> Tensor:
        """(heads, T, T) or (1, 1, T) for a static child: minus slope times distance where visible, else -inf."""
        assert parent.relation is not None
        mask = visible(parent.relation, length, self.slopes.device)
        if not self.local:
            return self.slopes.new_zeros(1, 1, length).masked_fill(~mask[:1], -math.inf)
        steps = torch.arange(length, device=self.slopes.device, dtype=self.slopes.dtype)
        distance = (steps[:, None] - steps[None, :]).abs()
        return (-self.slopes[:, None, None] * distance).masked_fill(~mask, -math.inf)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        batch = next(iter(parents.values())).shape[0]
        parents = self.extractors.of(parents, lengths)
        stream = self.queries(parents, batch, length)
        if self.ranged:
            tokens, bias = self.tokens(self.ranged, parents, batch, length, lengths)
            for layer in self.layers:
                stream = layer(stream, *layer.project(tokens), bias)
        features: Tensor = self.norm(stream)
        return features if self.local else features[:, 0]

    @torch.no_grad()
    def attention(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> list[Tensor]:
        """What every layer attends to, to look at: shares (B, heads, T, 1 + T parents) that sum to one.

        The start token comes first, then the steps of each ranged parent, in the order of `ranged`.

        Args:
            parents, length, lengths: see `Network.forward`.
        """
        batch = next(iter(parents.values())).shape[0]
        parents = self.extractors.of(parents, lengths)
        stream, found = self.queries(parents, batch, length), []
        if self.ranged:
            tokens, bias = self.tokens(self.ranged, parents, batch, length, lengths)
            for layer in self.layers:
                keys, values = layer.project(tokens)
                found.append(layer.weights(stream, keys, bias))
                stream = layer(stream, keys, values, bias)
        return found

    def queries(self, parents: Mapping[str, Tensor], batch: int, length: int) -> Tensor:
        """(B, T, W), or (B, 1, W) for a static child."""
        stream = self.origin.expand(batch, length if self.local else 1, -1)
        if self.point is None:
            return stream
        joined: Tensor = self.point([part(parents[parent.name], lag) for parent, lag in self.points])
        return stream + (joined if joined.dim() == 3 else joined[:, None])

    def tokens(
        self, parents: Sequence[Input], values: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Tokens (B, 1 + T * parents, W), the start token first, and their bias to every step."""
        tokens = [self.embed[parent.name](values[parent.name]) for parent in parents]
        bias = functional.pad(self.biases(parents, length, lengths), (1, 0))
        return torch.cat([self.start_token.expand(batch, 1, -1), *tokens], dim=1), bias

    def biases(self, parents: Sequence[Input], length: int, lengths: Tensor | None) -> Tensor:
        """(B or 1, heads or 1, T or 1, T * parents), of every step to the parents' valid ones."""
        none = self.slopes.new_zeros(len(self.slopes) if self.local else 1, length if self.local else 1, 0)
        bias = torch.cat([none, *(self.bias(parent, length) for parent in parents)], dim=-1)[None]
        if lengths is None:
            return bias
        return bias.masked_fill(~valid_steps(lengths, length).repeat(1, len(parents))[:, None, None], -math.inf)

    @override
    def start(self, given: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        given = self.extractors.of(given, lengths)
        known = {i: part(given[p.name], lag) for i, (p, lag) in enumerate(self.points) if p.name in given}
        queries = self.point.hoist(known, batch, length) if self.point is not None else None
        fixed = [p for p in self.ranged if p.name in given]
        live = [p for p in self.ranged if p.name not in given]
        tokens = bias = self.origin.new_zeros(1, 1, 1)
        if self.ranged:
            tokens, bias = self.tokens(fixed, given, batch, length, lengths)
            bias = torch.cat([bias, self.biases(live, length, lengths)], dim=-1)
        return Attending(
            queries=queries,
            points=[entry for i, entry in enumerate(self.points) if i not in known],
            bias=bias,
            given=1 + length * len(fixed),
            batch=batch,
            live=live,
            length=length,
            masks=np.concatenate(
                [np.zeros((length, 0), bool), *(p.relation.mask(length) for p in live if p.relation)], 1
            ),
            caches=[Cache(layer.project(tokens), room=length * len(live)) for layer in self.layers],
            extracted=self.extractors.start(length),
            lengths=lengths,
        )

    @override
    def step(self, state: Attending, t: int, drawn: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        drawn = self.extractors.drawn(state.extracted, drawn, state.lengths)
        stream = self.origin.expand(state.batch, -1)
        parts = [at(drawn[p.name], t + lag, stream, p.size) for p, lag in state.points if lag is not None]
        if state.queries is not None and self.point is not None:
            stream = stream + self.point.add(state.queries, t, parts)
        stream = stream[:, None]
        if self.layers:
            fresh = []
            for token in state.fresh(t):
                i, s = divmod(token, state.length)
                name = state.live[i].name
                fresh.append(self.embed[name](drawn[name][s]))
            if fresh:
                tokens = torch.stack(fresh, dim=1)
                for layer, cache in zip(self.layers, state.caches, strict=True):
                    cache.append(*layer.project(tokens))
            bias = state.row(t)
            for layer, cache in zip(self.layers, state.caches, strict=True):
                stream = layer(stream, cache.keys, cache.values, bias)
        return self.norm(stream[:, 0]), state

    @override
    def reach(
        self, state: Attending, t: int, count: int, drawn: Mapping[str, Sequence[Tensor]]
    ) -> tuple[Tensor, Any]:
        return self.step(state, t + count - 1, drawn)  # what it has not seen yet enters the cache


class SelfAttentionNetwork(Network):
    """What `SelfAttention` describes."""

    slopes: Tensor

    def __init__(self, spec: SelfAttention, inputs: Sequence[Input], local: bool):
        super().__init__(inputs, local, spec.width)
        frames = [parent for parent in self.inputs if local and _closed(parent)]
        self.encoded = [p for p in frames if p.relation == frames[0].relation]
        self.statics = [parent for parent in self.inputs if parent.relation is None]
        rest = [parent for parent in self.inputs if parent not in (*self.encoded, *self.statics)]
        self.extractors = Extractors([*self.encoded, *self.statics], spec.extract, spec.activation)
        if not self.encoded:
            raise ValueError(
                "SelfAttention encodes parents of a local variable that are read at {1:T}, {<=t} or {>=t}, but the "
                f"parents are {', '.join(f'{p.name} at {p.relation.name}' for p in rest if p.relation) or 'static'}; "
                "use networks.Attention for this factor"
            )
        tokens = [self.extractors.seen(parent).size for parent in (*self.encoded, *self.statics)]
        self.embed = nn.Linear(sum(tokens), spec.width)
        self.layers: Any = nn.ModuleList(Layer(spec) for _ in range(spec.layers))
        self.norm = nn.LayerNorm(spec.width)
        self.register_buffer("slopes", _slopes(spec.heads), persistent=False)
        then = replace(spec, extract={n: e for n, e in spec.extract.items() if n in [p.name for p in rest]})
        token = Input(ENCODED, spec.width, Relation.parse("t"))
        self.after = AttentionNetwork(then, [token, *rest], local) if rest else None
        self.features = spec.width if self.after is None else self.after.features

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        encoded = self.encode(parents, length, lengths)
        return encoded if self.after is None else self.after({ENCODED: encoded, **parents}, length, lengths)

    def encode(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None) -> Tensor:
        """The frames' tokens (B, T, W) after the encoder."""
        values = self.extractors.of(parents, lengths)
        frames = torch.cat(aligned([values[p.name] for p in (*self.encoded, *self.statics)]), dim=-1)
        stream: Tensor = self.embed(frames)
        bias = self.bias(length)
        if lengths is not None:
            bias = bias.masked_fill(~valid_steps(lengths, length)[:, None, None], -math.inf)
            own = torch.eye(length, dtype=torch.bool, device=bias.device)
            bias = bias.masked_fill(own, 0.0)  # padding sees itself: softmax over nothing is NaN
        for layer in self.layers:
            stream = layer(stream, *layer.project(layer.norm_query(stream)), bias)
        stream = self.norm(stream)
        return stream

    def bias(self, length: int) -> Tensor:
        """(1, heads, T, T): minus slope times distance where visible, else -inf."""
        relation = self.encoded[0].relation
        assert relation is not None
        mask = visible(relation, length, self.slopes.device)
        steps = torch.arange(length, device=self.slopes.device, dtype=self.slopes.dtype)
        ahead = steps[None, :] - steps[:, None]
        looks_ahead = torch.arange(len(self.slopes), device=self.slopes.device)[:, None, None] % 2 == 1
        away = ((ahead < 0) == looks_ahead) & mask.T.logical_and(mask).all()  # only where both sides are seen
        distance = ahead.abs() * torch.where(away, 4, 1)
        return (-self.slopes[:, None, None] * distance).masked_fill(~mask, -math.inf)[None]

    @override
    def start(self, given: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        if missing := [p.name for p in (*self.encoded, *self.statics) if p.name not in given]:
            raise ValueError(f"SelfAttention encodes all frames at once; it cannot be in a loop with {missing[0]}")
        encoded = self.encode(given, length, lengths)
        if self.after is None:
            return encoded.unbind(1)
        return self.after.start({ENCODED: encoded, **given}, batch, length, lengths)

    @override
    def step(self, state: Any, t: int, drawn: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        return (state[t], state) if self.after is None else self.after.step(state, t, drawn)

    @override
    def reach(self, state: Any, t: int, count: int, drawn: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        return self.step(state, t + count - 1, drawn)


ENCODED = "encoded frame"
"""How an encoder's output is called among the parents of what comes after it."""


def _slopes(heads: int) -> Tensor:
    return torch.tensor([2.0 ** (-8 * (h + 1) / heads) for h in range(heads)])


def _closed(parent: Input) -> bool:
    """Whether frames that exchange what they see see no more for it, themselves included."""
    if parent.relation is None or parent.relation.intervals is None or parent.relation.pointwise:
        return False
    mask = parent.relation.mask(2 * parent.relation.lag + 6)  # two looks, as far as they go
    return bool(mask.diagonal().all() and not ((mask.astype(int) @ mask > 0) & ~mask).any())


class Cache:
    """Keys and values seen so far, (B, heads, S, W / heads). Written in place where no gradient is wanted."""

    def __init__(self, tokens: tuple[Tensor, Tensor], room: int):
        keys, values = tokens
        self.size = keys.shape[2]
        self.keys, self.values = keys, values
        self.buffers: tuple[Tensor, ...] | None = None
        if not torch.is_grad_enabled() and room:
            self.buffers = tuple(functional.pad(old, (0, 0, 0, room)) for old in (keys, values))

    def append(self, keys: Tensor, values: Tensor) -> None:
        """Add the keys and values of new tokens."""
        if self.buffers is None:
            self.keys, self.values = torch.cat([self.keys, keys], 2), torch.cat([self.values, values], 2)
            return
        end = self.size + keys.shape[2]
        for buffer, new in zip(self.buffers, (keys, values), strict=True):
            buffer[:, :, self.size : end] = new
        self.size = end
        self.keys, self.values = (buffer[:, :, :end] for buffer in self.buffers)

    def select(self, rows: Tensor) -> Cache:
        """Its rows."""
        chosen = copy.copy(self)
        if self.buffers is None:
            chosen.keys, chosen.values = (old.index_select(0, rows) for old in (self.keys, self.values))
        else:
            chosen.buffers = tuple(buffer.index_select(0, rows) for buffer in self.buffers)
            chosen.keys, chosen.values = (buffer[:, :, : self.size] for buffer in chosen.buffers)
        return chosen


@dataclass
class Attending:
    """What an `AttentionNetwork` keeps between steps."""

    queries: Hoisted | None
    points: list[tuple[Input, int | None]]
    bias: Tensor
    """Of every step to the given tokens and then to all live ones: (B or 1, heads, T, given + parents * T)."""
    given: int
    batch: int
    live: list[Input]
    length: int
    masks: np.ndarray
    """(T, parents * T): the live tokens that a step sees."""
    caches: list[Cache]
    extracted: dict[str, tuple[Any, Rows]]
    lengths: Tensor | None
    seen: list[int] = field(default_factory=list)
    """Live tokens in the order of the cache: the step, plus T times the parent's place."""
    in_order: bool = True
    rows: Tensor | None = None
    """Of the bias, which stays that of the start."""

    def select(self, rows: Tensor) -> Attending:
        """Its rows."""
        moved = {name: select(getattr(self, name), rows) for name in ("queries", "caches", "extracted", "lengths")}
        masks, seen = self.masks.copy(), list(self.seen)
        rows = rows if self.rows is None else self.rows.index_select(0, rows)
        return replace(self, **moved, batch=len(rows), masks=masks, seen=seen, rows=rows)

    def fresh(self, t: int) -> list[int]:
        """The live tokens that step t is the first to see, which enter the cache now."""
        found = np.flatnonzero(self.masks[t]).tolist()
        if found:
            self.masks[:, found] = False
            self.in_order &= found == [*range(len(self.seen), len(self.seen) + len(found))]
            self.seen += found
        return found

    def row(self, t: int) -> Tensor:
        """The bias of step t to every token in the cache, broadcastable to (B, heads, 1, S)."""
        row = self.bias[:, :, t : t + 1]
        if self.rows is not None and row.shape[0] > 1:
            row = row.index_select(0, self.rows)
        if self.in_order:
            return row[..., : self.given + len(self.seen)]
        columns = [*range(self.given), *(self.given + token for token in self.seen)]
        return row.index_select(-1, indices(columns, row))
