"""Tools for loops over time: storage of draws, selection of batch rows, and reuse of results.

A particle filter repeats every sequence and, within the loop, replaces unlikely particles by copies of likely ones.
`select` applies the same choice of rows to the states of all networks. Tensors stored for every step, such as the draws
so far or results computed before the loop, are selected only when they are read (`Rows`). The cost per step therefore
does not depend on the length.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor, nn


class Rows(Sequence[Any]):
    """A sequence of tensors (B, ...), one per step, whose batch rows are selected only when a step is read.

    Args:
        values: the tensor of each step; None for a step without a tensor so far.
    """

    def __init__(self, values: Sequence[Any]):
        self.values = list(values)
        self.written = [0] * len(values)
        self.moves: list[Tensor] = []  # of rows since the first value was written
        self.origin: Tensor | None = None  # composition of all moves, which selects hoisted work in one step
        # a history of draws has steps without a tensor so far; work done before a loop does not
        self.is_history = any(value is None for value in self.values)

    def select(self, rows: Tensor | None) -> Rows:
        """Return the sequence for the batch rows with indices (N,), without copying any tensor; a copy for None."""
        selected = Rows(self.values)
        selected.written, selected.is_history = list(self.written), self.is_history
        selected.moves, selected.origin = list(self.moves), self.origin
        if rows is not None:
            selected.moves += [rows] if self.is_history else []
            selected.origin = rows if self.origin is None else self.origin.index_select(0, rows)
        return selected

    def slide(self) -> None:
        """Forget the first step, and the selections of rows so far; the other steps move forward."""
        self.values = [*(self[t] for t in range(1, len(self))), None]
        self.written, self.moves, self.origin = [0] * len(self), [], None

    def replaced(self, t: int, value: Any) -> Rows:
        """Return a copy with another value at step t."""
        copied = self.select(None)
        copied[t] = value
        return copied

    def __getitem__(self, t: Any) -> Any:
        value, since = self.values[t], self.written[t]
        if value is None or since == len(self.moves) > 0:
            return value
        if since == 0:
            return pick(value, self.origin)
        rows = self.moves[since]
        for later in self.moves[since + 1 :]:
            rows = rows.index_select(0, later)
        self[t] = value.index_select(0, rows)
        return self.values[t]

    def __setitem__(self, t: Any, value: Any) -> None:
        if not self.is_history:  # whose moves are not stored
            self.values, self.origin = [self[s] for s in range(len(self))], None
        self.values[t], self.written[t] = value, len(self.moves)

    def __len__(self) -> int:
        return len(self.values)


def pick(value: Tensor, rows: Tensor | None) -> Tensor:
    """Return the rows with indices (N,) of a tensor (B, ...), without a copy if the tensor is one expanded row."""
    if rows is None:
        return value
    if value.shape[0] == 1 or value.stride(0) == 0:
        return value[:1].expand(rows.shape[0], *value.shape[1:])
    return value.index_select(0, rows)


def select(state: Any, rows: Tensor | None) -> Any:
    """Return a loop's state for the batch rows with indices (N,), which may repeat; for None, a copy of the state.

    The batch is the first dimension of tensors. Containers and dataclasses are processed recursively, except frozen
    dataclasses, which are specifications. Lists and tuples of tensors are selected step by step when they are read. If
    an object has a method `select`, it is called; a state that contains weights needs one, because weights have no
    batch dimension. All other objects are returned unchanged.
    """
    if isinstance(state, Tensor):
        return pick(state, rows)
    if hasattr(state, "select"):
        return state.select(rows)
    if isinstance(state, dict):
        return {name: select(value, rows) for name, value in state.items()}
    if type(state) in (list, tuple):
        if any(isinstance(value, Tensor) for value in state) and all(
            value is None or isinstance(value, Tensor) for value in state
        ):
            return Rows(state).select(rows)
        return type(state)(select(value, rows) for value in state)
    if is_dataclass(state) and not isinstance(state, type) and not state.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        return replace(state, **{f.name: select(getattr(state, f.name), rows) for f in fields(state)})
    return state


def histories(state: Any) -> Iterator[Rows]:
    """Return the histories of draws in a loop's state.

    A loop without end keeps their last steps alone (`Rows.slide`), and calls `step` with the same position t again and
    again.
    """
    kind = type(state)
    if kind is Rows:
        yield from [state] if state.is_history else []
        return
    if kind is dict:
        state = state.values()
    elif is_dataclass(kind) and not kind.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        state = vars(state).values()
    elif kind not in (list, tuple):
        return
    for part in state:
        yield from histories(part)


Computed = TypeVar("Computed")


_CACHE: ContextVar[dict[Any, Any] | None] = ContextVar("once", default=None)


@contextmanager
def memoizing() -> Iterator[None]:
    """Cache the results of `memoize` within the block: for one evaluation of guide and model with fixed parameters."""
    if _CACHE.get() is not None:
        yield
        return
    token = _CACHE.set({})
    try:
        yield
    finally:
        _CACHE.reset(token)


def memoize(owner: object, inputs: Sequence[Any], compute: Callable[[], Computed]) -> Computed:
    """Return compute(), or its cached result for the same owner and identical input objects, within `memoizing`.

    Factors that share a module, such as h_t in SRNN, thus evaluate it once without a reference to each other.

    Args:
        owner: object to which the result belongs, such as the module.
        inputs: all objects that determine the result; they are compared by identity.
        compute: function that computes the result.
    """
    cache = _CACHE.get()
    if cache is None:
        return compute()
    key = _key(owner, inputs)
    if key not in cache:
        cache[key] = (inputs, compute())  # keep the inputs alive, so that their ids are not reused
    result: Computed = cache[key][1]
    return result


def store_result(owner: object, inputs: Sequence[Tensor | None], result: Any) -> None:
    """Store a result that was computed in another way, such as within a loop, so that `memoize` returns it.

    Args:
        owner, inputs: as in `memoize`.
        result: the result.
    """
    cache = _CACHE.get()
    if cache is not None:
        cache[_key(owner, inputs)] = (inputs, result)


def _key(owner: object, inputs: Sequence[Any]) -> tuple[Any, ...]:
    return id(owner), torch.is_grad_enabled(), *map(id, inputs)


def shift(values: Tensor, lag: int) -> Tensor:
    """Return values[:, t + lag] for every step t of values (B, T, D), zero where t + lag is outside the sequence."""
    if lag == 0:
        return values
    steps = values.shape[1]
    gap = min(abs(lag), steps)
    zeros = torch.zeros_like(values[:, :gap])
    # faster than `pad`, which also fills the other steps with zeros
    return torch.cat([zeros, values[:, : steps - gap]] if lag < 0 else [values[:, gap:], zeros], dim=1)


def at(values: Sequence[Tensor], t: int, like: Tensor, size: int) -> Tensor:
    """Return the draw (B, size) of a loop at step t, zero outside the sequence; `like` is any (B, ...) tensor."""
    return values[t] if 0 <= t < len(values) else like.new_zeros(like.shape[0], size)


def each_at(samples: Mapping[str, Sequence[Tensor]], parents: Sequence[Any], t: int, like: Tensor) -> list[Tensor]:
    """Return the draws (B, D) at step t + lag for each pair (parent, lag) of a `base.Input` and its lag.

    Static parents, whose lag is None, are skipped.
    """
    return [at(samples[parent.name], t + lag, like, parent.size) for parent, lag in parents if lag is not None]


def stack_steps(values: Sequence[Tensor], t: int, count: int, like: Tensor, size: int) -> Tensor:
    """Return the draws (B, N, D) of a loop at the N = `count` steps from t on, each as returned by `at`."""
    return torch.stack([at(values, s, like, size) for s in range(t, t + count)], dim=1)


def valid_steps(lengths: Tensor, length: int) -> Tensor:
    """Return the mask (B, T), True at the first lengths[b] steps of each sequence b of a ragged batch."""
    return torch.arange(length, device=lengths.device) < lengths[:, None]


def repeat_batch(values: Tensor, n: int) -> Tensor:
    """Repeat a batch (B, ...) n times, (n B, ...); `memoize_valid` then computes features of the B rows only."""
    repeated = values.repeat(n, *[1] * (values.dim() - 1))
    store_result(repeat_batch, [repeated], (values, n))
    return repeated


def steps_of(values: Tensor) -> Sequence[Tensor]:
    """Return the steps of values (B, T, ...); `join_steps` can restore the values without a copy."""
    steps = values.unbind(1)
    store_result(steps_of, steps, values)
    return steps


def join_steps(steps: Sequence[Tensor]) -> Tensor:
    """Return values (B, T, ...) from their steps, without a copy if `steps_of` returned them."""
    return memoize(steps_of, steps, lambda: torch.stack(list(steps), dim=1))


def memoize_valid(module: nn.Module, values: Tensor, lengths: Tensor | None) -> Tensor:
    """Return the module's features of values (B, T, D) or (B, D), 0 at padding.

    Within `memoizing`, they are computed once for the same tensor object.

    Args:
        module: module from (..., D) to (..., H).
        values: the values.
        lengths: (B,) number of valid steps of each sequence; None if there is no padding.
    """

    def compute() -> Tensor:
        first, n = memoize(repeat_batch, [values], lambda: (values, 1))
        if n > 1 and lengths is None:
            return repeat_batch(memoize_valid(module, first, None), n)
        features: Tensor = module(values)
        if lengths is None or features.dim() == 2:
            return features
        return features * valid_steps(lengths, features.shape[1])[..., None]

    return memoize(module, [values, lengths], compute)


def extend_features(
    rows: Rows,
    samples: Sequence[Any],
    module: nn.Module,
    lengths: Tensor | None,
    change: Callable[[Tensor], Tensor] | None = None,
) -> Rows:
    """Store the module's outputs for new draws (B, D) of a loop, 0 at padding, and return all outputs.

    Within `memoizing`, outputs are computed once for the same tensor objects.

    Args:
        rows: output of each step, which is extended in place; None for a step without an output.
        samples: draw of each step; None for a step that is not drawn yet.
        module, lengths: as in `memoize_valid`.
        change: version of the module for single steps, with computations shared by all steps already done; None for
            the module itself.
    """
    draws = samples.values if isinstance(samples, Rows) else samples
    fresh = [
        s for s, (feature, value) in enumerate(zip(rows.values, draws, strict=False)) if feature is None is not value
    ]
    values = [samples[s] for s in fresh]

    def compute() -> Sequence[Tensor]:
        return (
            [(change or module)(values[0])]
            if len(values) == 1
            else steps_of(memoize_valid(module, join_steps(values), None))
        )

    for s, feature in zip(fresh, memoize(module, [lengths, *values], compute) if fresh else [], strict=True):
        rows[s] = feature if lengths is None else feature * (s < lengths)[:, None]
    return rows


def reverse(values: Tensor, lengths: Tensor | None) -> Tensor:
    """Reverse the valid steps of every sequence (B, T, D); padding stays at the end."""
    if lengths is None:
        return values.flip(1)
    steps = torch.arange(values.shape[1], device=values.device)
    order = torch.where(steps < lengths[:, None], lengths[:, None] - 1 - steps, steps)
    return values.gather(1, order[..., None].expand_as(values))
