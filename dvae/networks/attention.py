"""Masked cross-attention from the current step to the steps it may read (Vaswani et al., 2017, arXiv 1706.03762).

By default distances enter as linear biases (Press et al., 2022, arXiv 2108.12409) instead of absolute positions, so
that a model can run on sequences longer than those in training.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from typing_extensions import override

from ..constants import constant, indices, visible
from ..factorization.relations import Relation
from .base import ACTIVATIONS, Hoisted, Input, Join, Network, aligned, part
from .cosine import positions
from .extract import Extract, Extractors
from .loop import Rows, each_at, pick, select, valid_steps


@dataclass(frozen=True)
class Attention:
    """An attention network: parents at single steps form the query, parents over ranges the keys and values.

    The keys are masked as the factor declares. The first step has no past and reads a learned start token.

    Args:
        width: width of queries, keys and values.
        heads: number of attention heads; divides the width.
        layers: number of cross-attention layers over the same tokens.
        feedforward: width of the perceptron after each attention; 0 for four times the width.
        activation: activation of the perceptrons.
        nearest: whether the query also contains the visible frame nearest to t of each parent over a range. Without
            it, the query is the same at every step if no parent is read at a single step.
        positions: how the order enters: as linear "biases" of distances, or as "sinusoids" that are added to queries
            and tokens (Vaswani et al., 2017).
        start: whether all steps read the start token; otherwise only steps without a past do.
        extract: extractors by parent, applied first: widths of a perceptron, or the specification of another module,
            such as `NodeGraph()`.
    """

    width: int = 64
    heads: int = 4
    layers: int = 1
    feedforward: int = 0
    activation: str = "gelu"
    nearest: bool = True
    positions: Literal["biases", "sinusoids"] = "biases"
    start: bool = True
    extract: Extract = field(default_factory=dict)

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> AttentionNetwork:
        """Return the network of a factor, as in `NetworkSpec.build`.

        Args:
            inputs: the parents of the factor.
            local: whether the child has a value at every step; otherwise it is static.
            size: D, dimension of the child.

        Raises:
            ValueError: `heads` does not divide `width`, or the activation is unknown.
        """
        return AttentionNetwork(self, inputs, local)


@dataclass(frozen=True)
class SelfAttention(Attention):
    """A transformer encoder with one token per frame, from the parents in the frame and the static parents.

    It is for a local variable that reads parents over {1:T}; over {<=t} or {>=t} the attention is one-sided. All other
    parents, such as the variable's own past, are read after the encoder by `Attention`, with the frame's token in the
    query. With biases, heads alternately prefer the past and the future: in the bias of a head, distances to its other
    side count four times.

    Args:
        width, heads, layers, feedforward, activation, nearest, positions, start, extract: as in `Attention`; `layers`
            is the number of layers of the encoder, and of the attention after it.
    """

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> SelfAttentionNetwork:  # type: ignore[override]
        """Return the network of a factor, as in `NetworkSpec.build`.

        Args:
            inputs: the parents of the factor.
            local: whether the child has a value at every step; otherwise it is static.
            size: D, dimension of the child.

        Raises:
            ValueError: no parent of a local child is read over {1:T}, {<=t} or {>=t}, `heads` does not divide `width`,
                or the activation is unknown.
        """
        return SelfAttentionNetwork(self, inputs, local)


class Layer(nn.Module):
    """One cross-attention and its perceptron, both with residual connections, with normalisation before them.

    The stream is the sequence of vectors (B, T, W) that the layers update: queries first, features at the end.
    """

    def __init__(self, spec: Attention):
        super().__init__()
        if spec.width % spec.heads:
            raise ValueError(f"`width` must be a multiple of `heads`, got width {spec.width} and heads {spec.heads}")
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
        """Return keys and values (B, heads, S, W / heads) of tokens (B, S, W)."""
        keys, values = self.keys_values(tokens).unflatten(-1, (2 * self.heads, -1)).transpose(1, 2).chunk(2, dim=1)
        return keys, values

    def queries(self, stream: Tensor) -> Tensor:
        """Return queries (B, heads, T, W / heads) from the stream (B, T, W)."""
        query: Tensor = self.query(self.norm_query(stream)).unflatten(-1, (self.heads, -1))
        return query.transpose(1, 2)

    def weights(self, stream: Tensor, keys: Tensor, bias: Tensor) -> Tensor:
        """Return the attention weights (B, heads, T, S) of the stream (B, T, W) on keys (B, heads, S, W / heads)."""
        query = self.queries(stream)
        return (query @ keys.transpose(-1, -2) / math.sqrt(query.shape[-1]) + bias).softmax(-1)

    def forward(self, stream: Tensor, keys: Tensor, values: Tensor, bias: Tensor) -> Tensor:
        """Return the stream (B, T, W) after attention and perceptron.

        Args:
            stream: (B, T, W).
            keys, values: (B, heads, S, W / heads) of S tokens.
            bias: bias that is added to the scores; broadcasts to (B, heads, T, S).
        """
        if stream.shape[1] == 1:  # for a single query, the fused kernel takes several times as long
            attended = self.weights(stream, keys, bias) @ values
        else:
            attended = functional.scaled_dot_product_attention(self.queries(stream), keys, values, attn_mask=bias)
        stream = stream + self.out(attended.transpose(1, 2).flatten(2))
        update: Tensor = self.perceptron(stream)
        return stream + update

    def absorbed(self, columns: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return weights for `step`, which replace the keys and values of the tokens.

        Keys and values are linear in the tokens. `step` therefore multiplies queries by the key matrix, and averages of
        tokens by the value matrix, so a loop stores only the tokens. A bias of the keys shifts all scores of a query
        equally, and the softmax cancels it. A bias of the values is added once, because attention weights sum to one.

        Args:
            columns: (C, W) matrix from stored tokens with C numbers to tokens with W numbers; None if tokens are stored
                unchanged, C = W.

        Returns:
            Three tensors. Matrices (heads, W / heads, C) map queries to vectors, whose products with stored tokens are
            the scores. Matrices (heads, C, W / heads) map averages of stored tokens to values. A bias (W,) replaces the
            bias of `out`.
        """
        keys, values = self.keys_values.weight.unflatten(0, (2 * self.heads, -1)).chunk(2)
        if columns is not None:
            keys, values = keys @ columns.mT, values @ columns.mT
        bias = functional.linear(self.keys_values.bias[self.out.in_features :], self.out.weight, self.out.bias)
        return keys / math.sqrt(keys.shape[1]), values.mT, bias

    def step(self, stream: Tensor, tokens: Tensor, bias: Tensor, absorbed: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        """Run `forward` at one step: the stream (B, W) attends to stored tokens (B, S, C) under a bias (B, heads, S).

        Args:
            absorbed: result of the method `absorbed`.
        """
        keys, values, offset = absorbed
        query = self.query(self.norm_query(stream)).unflatten(-1, (self.heads, -1)).transpose(0, 1)
        query, tokens = (query @ keys).transpose(0, 1)[:, None], tokens[:, None]
        attended = functional.scaled_dot_product_attention(query, tokens, tokens, attn_mask=bias[:, None], scale=1.0)
        attended = (attended[:, 0].transpose(0, 1) @ values).transpose(0, 1).flatten(1)
        stream = stream + functional.linear(attended, self.out.weight, offset)
        update: Tensor = self.perceptron(stream)
        return stream + update


class AttentionNetwork(Network):
    """Network of `Attention`."""

    slopes: Tensor

    def __init__(self, spec: Attention, inputs: Sequence[Input], local: bool):
        super().__init__(inputs, local, spec.width)
        self.heads, self.start_is_visible = spec.heads, spec.start
        self.sinusoids = local and spec.positions == "sinusoids"
        self.stationary = not self.sinusoids
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
        self.narrow = len(self.ranged) == 1 and self.ranged[0].size + 2 < spec.width and not self.sinusoids
        sizes = [parent.size for parent, _ in self.points]
        self.point = Join(sizes, (spec.width, spec.width), spec.activation) if sizes else None
        self.origin = nn.Parameter(torch.randn(spec.width) / math.sqrt(spec.width))
        self.layers: Any = nn.ModuleList(Layer(spec) for _ in range(spec.layers if self.ranged else 0))
        self.norm = nn.LayerNorm(spec.width)
        self.register_buffer("slopes", _slopes(spec.heads) * (not self.sinusoids), persistent=False)

    def bias(self, parent: Input, length: int) -> Tensor:
        """Return the attention bias for a parent: minus slope times distance at visible steps, -inf at others.

        With sinusoids, slopes are 0.

        It is (heads, T, T); for a static child it is (1, 1, T), without distances.
        """
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
        """Return the attention weights of every layer for inspection: (B, heads, T, 1 + T parents), with sum one.

        The start token is first, followed by the steps of each ranged parent in the order of `ranged`.

        Args:
            parents, length, lengths: as in `Network.forward`.
        """
        batch = next(iter(parents.values())).shape[0]
        parents = self.extractors.of(parents, lengths)
        stream, weights = self.queries(parents, batch, length), []
        if self.ranged:
            tokens, bias = self.tokens(self.ranged, parents, batch, length, lengths)
            for layer in self.layers:
                keys, values = layer.project(tokens)
                weights.append(layer.weights(stream, keys, bias))
                stream = layer(stream, keys, values, bias)
        return weights

    def queries(self, parents: Mapping[str, Tensor], batch: int, length: int) -> Tensor:
        """Return the first stream, computed from the parents at single steps: (B, T, W), or (B, 1, W) if static."""
        stream = self.origin.expand(batch, length if self.local else 1, -1)
        if self.sinusoids:
            stream = stream + self.waves(length)
        if self.point is None:
            return stream
        query: Tensor = self.point([part(parents[parent.name], lag) for parent, lag in self.points])
        return stream + (query if query.dim() == 3 else query[:, None])

    def tokens(
        self, parents: Sequence[Input], values: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return tokens (B, 1 + T * parents, W), the start token first, and the attention bias of every step for them.

        Args:
            parents: the parents read over ranges.
            values: {name: features (B, T, D)}.
            batch, length: B and T.
            lengths: (B,) number of valid steps of each sequence, or None.
        """
        tokens = [self.embed[parent.name](values[parent.name]) for parent in parents]
        if self.sinusoids:
            tokens = [token + self.waves(length) for token in tokens]
        return torch.cat([self.start_token.expand(batch, 1, -1), *tokens], dim=1), self.biases(parents, length, lengths)

    def waves(self, length: int) -> Tensor:
        """Return the sinusoids (T, W) of the steps."""
        return positions(length, self.features, self.origin.dtype, self.origin.device)

    def kept(self, name: str, values: Tensor) -> Tensor:
        """Return the stored form of a parent's values (..., D) in a loop: tokens (..., W), or a shorter form.

        The shorter form is used if only one parent is read over a range and W is larger than D + 2. It is (..., D + 2):
        the values, a 1 for the bias of the embedding, and an indicator of the start token.
        """
        if self.narrow:
            return torch.cat([values, constant((1.0, 0.0), values).expand(*values.shape[:-1], 2)], -1)
        tokens: Tensor = self.embed[name](values)
        return tokens

    def columns(self) -> Tensor | None:
        """Return the matrix (D + 2, W) from the stored form to tokens; None if tokens are stored."""
        if not self.narrow:
            return None
        embed: Any = self.embed[self.ranged[0].name]
        return torch.cat([embed.weight.mT, embed.bias[None], self.start_token[None]])

    def biases(self, parents: Sequence[Input], length: int, lengths: Tensor | None) -> Tensor:
        """Return the attention bias of every step for the start token and all parents, -inf at padding.

        It is (B, heads, T, 1 + T * parents); B is 1 without `lengths`, and heads and T are 1 for a static child.
        """
        empty = self.slopes.new_zeros(len(self.slopes) if self.local else 1, length if self.local else 1, 0)
        bias = torch.cat([empty, *(self.bias(parent, length) for parent in parents)], dim=-1)[None]
        if lengths is not None:
            bias = bias.masked_fill(~valid_steps(lengths, length).repeat(1, len(parents))[:, None, None], -math.inf)
        if self.start_is_visible:
            return functional.pad(bias, (1, 0))
        has_past = bias.isfinite().any(-1, keepdim=True)
        return torch.cat([torch.zeros_like(bias[..., :1]).masked_fill(has_past, -math.inf), bias], dim=-1)

    @override
    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        parents = self.extractors.of(parents, lengths)
        known_points = {i: part(parents[p.name], lag) for i, (p, lag) in enumerate(self.points) if p.name in parents}
        queries = self.point.hoist(known_points, batch, length) if self.point is not None else None
        fixed = [p for p in self.ranged if p.name in parents]
        live = [p for p in self.ranged if p.name not in parents]
        columns, tokens, bias = self.columns(), self.origin.new_zeros(batch, 1, 1), self.origin.new_zeros(1, 1, 1)
        if self.ranged:
            first = self.start_token if columns is None else functional.pad(columns.new_ones(1), (len(columns) - 1, 0))
            stored = [self.kept(parent.name, parents[parent.name]) for parent in fixed]
            if self.sinusoids:
                stored = [tokens + self.waves(length) for tokens in stored]
            tokens = torch.cat([first.expand(batch, 1, -1), *stored], dim=1)
            bias = self.biases([*fixed, *live], length, lengths)
        return Attending(
            queries=queries,
            points=[entry for i, entry in enumerate(self.points) if i not in known_points],
            bias=bias,
            given=1 + length * len(fixed),
            batch=batch,
            live=live,
            length=length,
            masks=np.concatenate(
                [np.zeros((length, 0), bool), *(p.relation.mask(length) for p in live if p.relation)], 1
            ),
            cache=Cache(tokens, room=length * len(live)),
            absorbed=[layer.absorbed(columns) for layer in self.layers],
            extracted=self.extractors.start(length),
            lengths=lengths,
        )

    @override
    def step(self, state: Attending, t: int, samples: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        samples = self.extractors.drawn(state.extracted, samples, state.lengths) if self.extractors else samples
        stream = self.origin.expand(state.batch, -1)
        waves = self.waves(state.length) if self.sinusoids else None
        if waves is not None:
            stream = stream + waves[t]
        parts = each_at(samples, state.points, t, stream)
        if state.queries is not None and self.point is not None:
            stream = stream + self.point.add(state.queries, t, parts)
        if self.layers:
            fresh = []
            for token in state.fresh(t):
                i, s = divmod(token, state.length)
                name = state.live[i].name
                token_of_step = self.kept(name, samples[name][s])
                fresh.append(token_of_step if waves is None else token_of_step + waves[s])
            if fresh:
                state.cache.append(fresh)
            bias = state.row(t)
            for layer, absorbed in zip(self.layers, state.absorbed, strict=True):
                stream = layer.step(stream, state.cache.tokens, bias, absorbed)
        return self.norm(stream), state

    @override
    def forward_last(
        self, state: Attending, t: int, count: int, samples: Mapping[str, Sequence[Tensor]]
    ) -> tuple[Tensor, Any]:
        return self.step(state, t + count - 1, samples)  # `step` also adds all skipped tokens to the cache


class SelfAttentionNetwork(Network):
    """Network of `SelfAttention`."""

    slopes: Tensor

    def __init__(self, spec: SelfAttention, inputs: Sequence[Input], local: bool):
        super().__init__(inputs, local, spec.width)
        frames = [parent for parent in self.inputs if local and _closed(parent)]
        self.encoded = [p for p in frames if p.relation == frames[0].relation]
        self.statics = [parent for parent in self.inputs if parent.relation is None]
        others = [parent for parent in self.inputs if parent not in (*self.encoded, *self.statics)]
        self.extractors = Extractors([*self.encoded, *self.statics], spec.extract, spec.activation)
        if not self.encoded:
            raise ValueError(
                "SelfAttention needs a local child with a parent read at {1:T}, {<=t} or {>=t}, but the child is "
                f"{'local' if local else 'static'} and the parents are "
                f"{', '.join(f'{p.name} at {p.relation.name}' for p in others if p.relation) or 'static'}; use "
                "networks.Attention for this factor"
            )
        tokens = [self.extractors.seen(parent).size for parent in (*self.encoded, *self.statics)]
        self.embed = nn.Linear(sum(tokens), spec.width)
        self.layers: Any = nn.ModuleList(Layer(spec) for _ in range(spec.layers))
        self.norm = nn.LayerNorm(spec.width)
        self.sinusoids = spec.positions == "sinusoids"
        self.register_buffer("slopes", _slopes(spec.heads) * (not self.sinusoids), persistent=False)
        spec_after = replace(spec, extract={n: e for n, e in spec.extract.items() if n in [p.name for p in others]})
        token = Input(ENCODED, spec.width, Relation.parse("t"))
        self.after = AttentionNetwork(spec_after, [token, *others], local) if others else None
        self.features = spec.width if self.after is None else self.after.features

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        encoded = self.encode(parents, length, lengths)
        return encoded if self.after is None else self.after({ENCODED: encoded, **parents}, length, lengths)

    def encode(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None) -> Tensor:
        """Return the tokens (B, T, W) of the frames after the encoder."""
        values = self.extractors.of(parents, lengths)
        frames = torch.cat(aligned([values[p.name] for p in (*self.encoded, *self.statics)]), dim=-1)
        stream: Tensor = self.embed(frames)
        if self.sinusoids:
            stream = stream + positions(length, stream.shape[-1], stream.dtype, stream.device)
        bias = self.bias(length)
        if lengths is not None:
            bias = bias.masked_fill(~valid_steps(lengths, length)[:, None, None], -math.inf)
            diagonal = torch.eye(length, dtype=torch.bool, device=bias.device)
            bias = bias.masked_fill(diagonal, 0.0)  # padding attends to itself, since a softmax over nothing is NaN
        for layer in self.layers:
            stream = layer(stream, *layer.project(layer.norm_query(stream)), bias)
        stream = self.norm(stream)
        return stream

    def bias(self, length: int) -> Tensor:
        """Return the attention bias (1, heads, T, T): minus slope times distance at visible frames, -inf at others."""
        relation = self.encoded[0].relation
        assert relation is not None
        mask = visible(relation, length, self.slopes.device)
        steps = torch.arange(length, device=self.slopes.device, dtype=self.slopes.dtype)
        ahead = steps[None, :] - steps[:, None]
        looks_ahead = torch.arange(len(self.slopes), device=self.slopes.device)[:, None, None] % 2 == 1
        is_other_side = ((ahead < 0) == looks_ahead) & mask.T.logical_and(mask).all()  # only if both sides are visible
        distance = ahead.abs() * torch.where(is_other_side, 4, 1)
        return (-self.slopes[:, None, None] * distance).masked_fill(~mask, -math.inf)[None]

    @override
    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        if missing := [p.name for p in (*self.encoded, *self.statics) if p.name not in parents]:
            raise ValueError(
                f"SelfAttention encodes all frames at once, but {missing[0]} would be drawn step by step; use "
                "networks.Attention for this factor"
            )
        encoded = self.encode(parents, length, lengths)
        if self.after is None:
            return encoded.unbind(1)
        return self.after.start({ENCODED: encoded, **parents}, batch, length, lengths)

    @override
    def step(self, state: Any, t: int, samples: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        return (state[t], state) if self.after is None else self.after.step(state, t, samples)

    @override
    def forward_last(
        self, state: Any, t: int, count: int, samples: Mapping[str, Sequence[Tensor]]
    ) -> tuple[Tensor, Any]:
        return self.step(state, t + count - 1, samples)


ENCODED = "encoded frame"
"""Name of the encoder's output among the parents of the following attention."""


def _slopes(heads: int) -> Tensor:
    return torch.tensor([2.0 ** (-8 * (h + 1) / heads) for h in range(heads)])


def _closed(parent: Input) -> bool:
    """Return whether the mask is reflexive and transitive, so that several layers read no frames beyond the mask."""
    if parent.relation is None or parent.relation.intervals is None or parent.relation.pointwise:
        return False
    mask = parent.relation.mask(2 * parent.relation.lag + 6)  # long enough for two rounds of attention
    return bool(mask.diagonal().all() and not ((mask.astype(int) @ mask > 0) & ~mask).any())


class Cache:
    """Tokens stored so far in a loop, (B, S, C), written in place if no gradient is needed.

    Args:
        tokens: (B, S, C) tokens known before the loop.
        room: number of tokens that the loop will append.
    """

    def __init__(self, tokens: Tensor, room: int):
        self.tokens = tokens
        self.buffer: Tensor | None = None
        if not torch.is_grad_enabled() and room:
            self.buffer = tokens.new_empty(len(tokens), tokens.shape[1] + room, tokens.shape[2])
            self.buffer[:, : tokens.shape[1]] = tokens

    def append(self, tokens: Sequence[Tensor]) -> None:
        """Append new tokens (B, C)."""
        if self.buffer is None:
            self.tokens = torch.cat([self.tokens, torch.stack(list(tokens), 1)], 1)
            return
        for index, token in enumerate(tokens, self.tokens.shape[1]):
            self.buffer[:, index] = token
        self.tokens = self.buffer[:, : self.tokens.shape[1] + len(tokens)]

    def select(self, rows: Tensor | None) -> Cache:
        """Return the cache of the batch rows with indices (N,)."""
        selected = copy.copy(self)
        if self.buffer is None:
            selected.tokens = pick(self.tokens, rows)
        else:
            selected.buffer = self.buffer.clone() if rows is None else self.buffer.index_select(0, rows)
            selected.tokens = selected.buffer[:, : self.tokens.shape[1]]
        return selected


@dataclass
class Attending:
    """The state of an `AttentionNetwork` between steps; live parents and tokens are those that the loop draws."""

    queries: Hoisted | None
    points: list[tuple[Input, int | None]]
    bias: Tensor
    """Bias of every step to the given tokens, then to all live tokens: (B or 1, heads, T, given + parents * T)."""
    given: int
    batch: int
    live: list[Input]
    length: int
    masks: np.ndarray
    """(T, parents * T), True for live tokens that are visible at a step and not yet in the cache."""
    cache: Cache
    absorbed: list[tuple[Tensor, Tensor, Tensor]]
    """Results of `Layer.absorbed` by layer, the same for all rows."""
    extracted: dict[str, tuple[Any, Rows]]
    lengths: Tensor | None
    seen: list[int] = field(default_factory=list)
    """Live tokens in the order of the cache: the step plus T times the index of the parent."""
    in_order: bool = True
    rows: Tensor | None = None
    """Rows of the bias, which is not copied when rows are selected."""

    def select(self, rows: Tensor | None) -> Attending:
        """Return the state of the batch rows with indices (N,)."""
        selected = {name: select(getattr(self, name), rows) for name in ("queries", "cache", "extracted", "lengths")}
        masks, seen = self.masks.copy(), list(self.seen)
        if rows is None:
            return replace(self, **selected, masks=masks, seen=seen)
        rows = rows if self.rows is None else self.rows.index_select(0, rows)
        return replace(self, **selected, batch=len(rows), masks=masks, seen=seen, rows=rows)

    def fresh(self, t: int) -> list[int]:
        """Return the indices of the live tokens that step t is the first to read, and mark them as cached."""
        tokens = np.flatnonzero(self.masks[t]).tolist()
        if tokens:
            self.masks[:, tokens] = False
            self.in_order &= tokens == [*range(len(self.seen), len(self.seen) + len(tokens))]
            self.seen += tokens
        return tokens

    def row(self, t: int) -> Tensor:
        """Return the bias of step t to every token in the cache, broadcastable to (B, heads, S)."""
        row = self.bias[:, :, t]
        if self.rows is not None and row.shape[0] > 1:
            row = row.index_select(0, self.rows)
        if self.in_order:
            return row[..., : self.given + len(self.seen)]
        columns = [*range(self.given), *(self.given + token for token in self.seen)]
        return row.index_select(-1, indices(columns, row))
