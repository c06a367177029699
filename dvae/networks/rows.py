"""Rows: the state of a loop over time, moved to other rows of the batch.

A particle filter repeats every sequence and, in the middle of the loop, replaces unlikely particles by copies of likely
ones. The states of all networks move along. What lies at every step (hoisted work, the draws so far) is moved where it
is read and not before, so that a run costs the same per step however long it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any

from torch import Tensor


class Rows(Sequence[Any]):
    """Tensors (B, ...) by step, or None, as the rows that were chosen since they were written.

    Args:
        values: by step.
    """

    def __init__(self, values: Sequence[Any]):
        self.values = list(values)
        self.written = [0] * len(values)
        self.moves: list[Tensor] = []
        self.origin: Tensor | None = None  # the moves as one: hoisted work is moved by it in one go

    def select(self, rows: Tensor) -> Rows:
        """The same under one more choice of rows (N,)."""
        chosen = Rows(self.values)
        chosen.written = list(self.written)
        chosen.moves = [*self.moves, rows]
        chosen.origin = rows if self.origin is None else self.origin.index_select(0, rows)
        return chosen

    def __getitem__(self, t: Any) -> Any:
        value, since = self.values[t], self.written[t]
        if value is None or since == len(self.moves):
            return value
        if since == 0:
            return pick(value, self.origin)
        rows = self.moves[since]
        for later in self.moves[since + 1 :]:
            rows = rows.index_select(0, later)
        self[t] = value.index_select(0, rows)
        return self.values[t]

    def __setitem__(self, t: Any, value: Any) -> None:
        self.values[t], self.written[t] = value, len(self.moves)

    def __len__(self) -> int:
        return len(self.values)


def pick(value: Tensor, rows: Tensor | None) -> Tensor:
    """The rows (N,) of a tensor (B, ...), without a copy where all rows are one."""
    if rows is None:
        return value
    if value.shape[0] == 1 or value.stride(0) == 0:
        return value[:1].expand(len(rows), *value.shape[1:])
    return value.index_select(0, rows)


def select(state: Any, rows: Tensor) -> Any:
    """A loop's state with these rows (N,) of its batch.

    Tensors have the batch as their first dimension. Containers and dataclasses (frozen ones are descriptions) are
    entered; lists and tuples of tensors are moved step by step, when read. What has a `select` of its own moves itself:
    a state that keeps weights needs one. All else is the same for every row.
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
