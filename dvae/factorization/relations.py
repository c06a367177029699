"""Relations in time: which steps of a parent a child may read, as text and as masks, with set operations."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

Interval = tuple[float, float]
MaskFunction = Callable[[int], np.ndarray]

KNOWN_RELATIONS = "t, {t-1}, {t+1}, {t-k}, {t-a:t+b}, {<t}, {<=t}, {>t}, {>=t}, {1:t}, {t:T}, {1:T}"
FARTHER = (16, 32, 64)
"""Lengths T, in addition to 2 to 8, at which the directions of a custom mask are inferred.

Every run checks the mask again at its own T.
"""


class NotationError(ValueError):
    """Error for an equation that cannot be parsed; the message marks the wrong column with a caret."""


@dataclass(frozen=True)
class Relation:
    """The steps s of a parent that the child at step t may read, as a set of offsets s - t or as a custom mask.

    Relations support set operations: `a | b` (union), `a & b` (intersection), `~a` (complement).

    Args:
        name: spelling in an equation, such as `"{<t}"`.
        intervals: sorted disjoint intervals of offsets s - t, both ends included and possibly infinite:
            `{t-1}` is `((-1, -1),)`, `{<t}` is `((-inf, -1),)`. None for a custom mask.
        function: custom mask, T -> bool array (T, T) with rows t and columns s. An array (1, T) is the same row for
            every t, and the only valid shape for a static child.

    >>> str(Relation.parse("<t") | Relation.parse("t"))
    '{<=t}'
    """

    name: str
    intervals: tuple[Interval, ...] | None
    function: MaskFunction | None = None

    @classmethod
    def of(cls, intervals: Iterable[Interval]) -> Relation:
        """Return the relation with these offsets; overlapping and adjacent intervals are merged.

        Args:
            intervals: pairs (low, high) of offsets s - t in any order, both ends included and possibly infinite.
        """
        merged: list[Interval] = []
        for low, high in sorted(intervals):
            if merged and low <= merged[-1][1] + 1:
                merged[-1] = (merged[-1][0], max(merged[-1][1], high))
            else:
                merged.append((low, high))
        return cls(" | ".join(_interval_name(*i) for i in merged) or "{}", tuple(merged))

    @classmethod
    def custom(cls, name: str, function: MaskFunction) -> Relation:
        """Return a relation with a custom mask.

        Args:
            name: spelling in an equation without braces.
            function: custom mask, as in `Relation`.
        """
        return cls("{" + name + "}", None, function)

    @classmethod
    def parse(cls, text: str) -> Relation:
        """Return the relation that a subscript denotes.

        Args:
            text: subscript without braces, such as "<t" or "t-1".

        Raises:
            ValueError: the grammar of `dvae.factorization.notation` does not contain the subscript.
        """
        for sign, spelling in {"<=": r"\\leq?", ">=": r"\\geq?", "<": r"\\lt", ">": r"\\gt"}.items():
            text = re.sub(rf"(?:{spelling})(?![a-z])", sign, text)
        for sign, spelling in {"<=": "≤", ">=": "≥", "-": "\N{MINUS SIGN}"}.items():
            text = text.replace(spelling, sign)
        text = re.sub(r"\s|\\[,;:! ]", "", text)
        if single := re.fullmatch(r"t([+-]\d+)?", text):
            offset = int(single[1] or 0)
            return cls.of([(offset, offset)])
        if side := re.fullmatch(r"(<=?|>=?)t([+-]\d+)?", text):
            offset, strict = int(side[2] or 0), len(side[1]) == 1
            past = side[1][0] == "<"
            return cls.of([(-math.inf, offset - strict) if past else (offset + strict, math.inf)])
        if span := re.fullmatch(r"(?:1|t([+-]\d+)?):(?:T|t([+-]\d+)?)", text):
            low, high = text.split(":")
            interval = (
                -math.inf if low == "1" else int(span[1] or 0),
                math.inf if high == "T" else int(span[2] or 0),
            )
            if interval[0] > interval[1]:
                raise ValueError(f"the range {{{text}}} is empty; write the earlier step first: {{{high}:{low}}}")
            return cls.of([interval])
        raise ValueError(
            f"unknown relation {{{text}}}; known are {KNOWN_RELATIONS}, and the names of custom masks in `masks`"
        )

    @property
    def parts(self) -> tuple[Relation, ...]:
        """Relations whose union equals this relation; each can be written as a single subscript."""
        if self.intervals is not None:
            return tuple(Relation.of([interval]) for interval in self.intervals)
        if isinstance(self.function, _Composed) and self.function.operation is np.logical_or:
            return tuple(part for operand in self.function.operands for part in operand.parts)
        return (self,)

    @property
    def pointwise(self) -> bool:
        """True if the relation reads a fixed number of steps, as t, {t-1} and {t-2:t} do; False for custom masks."""
        ends = [end for interval in self.intervals or [(0, math.inf)] for end in interval]
        return all(map(math.isfinite, ends))

    @property
    def lag(self) -> int:
        """Largest finite bound |s - t| of the relation's intervals: 1 for {<t} and {t+1}, 3 for {t-3:t}, 0 for {1:T}.

        Raises:
            ValueError: the relation is a custom mask, whose lag may depend on T.
        """
        if self.intervals is None:
            raise ValueError(
                f"the custom mask {self} has no lag, because it may differ between lengths; use its `mask(T)`"
            )
        return max((int(abs(end)) for i in self.intervals for end in i if math.isfinite(end)), default=0)

    @property
    def directions(self) -> frozenset[int]:
        """Directions in time that the relation reads: -1 for the past, 0 for the same step, +1 for the future.

        For a custom mask, the directions of its entries at several lengths.
        """
        if self.intervals is not None:
            reads = {-1: (-math.inf, -1), 0: (0, 0), 1: (1, math.inf)}
            return frozenset(k for k, side in reads.items() if (self & Relation.of([side])).intervals)
        offsets = [np.subtract(*np.nonzero(self.mask(T).T)) for T in range(2, 9)]
        with suppress(Exception):  # a custom mask may support short sequences only
            offsets += [np.subtract(*np.nonzero(self.mask(T).T)) for T in FARTHER]
        return frozenset(int(sign) for sign in np.sign(np.concatenate(offsets)))

    def reads(self, offset: int, T: int) -> bool:
        """Return whether the child reads the parent at one offset, at all steps t with 1 <= t + offset <= T.

        Args:
            offset: s - t, such as -1 for the previous step.
            T: number of time steps.
        """
        if self.intervals is not None:
            return any(low <= offset <= high for low, high in self.intervals)
        return bool(self.mask(T).diagonal(offset).all())

    def mask(self, T: int) -> np.ndarray:
        """Return a bool array (T, T) with entry [t, s] True if the child at step t may read the parent at step s.

        The indices t and s count from 0.

        Args:
            T: number of time steps.

        Raises:
            ValueError: the function of a custom mask does not return a bool array (T, T) or (1, T).
        """
        return np.broadcast_to(self.rows(T), (T, T)).copy()

    def rows(self, T: int) -> np.ndarray:
        """Return `mask` (T, T), or a single row (1, T) if the function of a custom mask returns a single row."""
        if self.intervals is not None:
            offset = np.arange(T)[None, :] - np.arange(T)[:, None]
            allowed = [(low <= offset) & (offset <= high) for low, high in self.intervals or [(1, 0)]]
            return np.asarray(np.any(allowed, axis=0))
        assert self.function is not None
        mask = np.asarray(self.function(T))
        if mask.dtype != bool or mask.shape not in ((T, T), (1, T)):
            raise ValueError(
                f"the mask {self.name} at T={T} has dtype {mask.dtype} and shape {mask.shape}; expected a bool array "
                f"of shape ({T}, {T}), rows t and columns s, or (1, {T}) for the same row at every t"
            )
        return mask

    def __or__(self, other: Relation) -> Relation:
        if self.intervals is not None and other.intervals is not None:
            return Relation.of(self.intervals + other.intervals)
        return Relation(f"{self.name} | {other.name}", None, _Composed(np.logical_or, (self, other)))

    def __and__(self, other: Relation) -> Relation:
        if self.intervals is not None and other.intervals is not None:
            pairs = [(max(a, c), min(b, d)) for a, b in self.intervals for c, d in other.intervals]
            return Relation.of((low, high) for low, high in pairs if low <= high)
        return Relation(f"{{{self.name} & {other.name}}}", None, _Composed(np.logical_and, (self, other)))

    def __invert__(self) -> Relation:
        if self.intervals is not None:
            starts = [-math.inf, *(high + 1 for _, high in self.intervals)]
            ends = [*(low - 1 for low, _ in self.intervals), math.inf]
            gaps = zip(starts, ends, strict=True)
            return Relation.of((low, high) for low, high in gaps if low <= high and math.inf not in (low, -high))
        return Relation(f"{{~{self.name}}}", None, _Composed(np.logical_not, (self,)))

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True)
class _Composed:
    """Mask function that applies a logical operation to the masks of relations.

    It is a dataclass, so that relations built by the same operations compare equal.

    Args:
        operation: numpy function of one or two bool arrays.
        operands: relations whose masks are combined.
    """

    operation: Callable[..., np.ndarray]
    operands: tuple[Relation, ...]

    def __call__(self, T: int) -> np.ndarray:
        return self.operation(*(operand.rows(T) for operand in self.operands))


def _interval_name(low: float, high: float) -> str:
    def step(offset: float) -> str:
        return f"t{int(offset):+d}" if offset else "t"

    if low == -math.inf and high == math.inf:
        return "{1:T}"
    if low == -math.inf:
        return "{<t}" if high == -1 else "{<=" + step(high) + "}"
    if high == math.inf:
        return "{>t}" if low == 1 else "{>=" + step(low) + "}"
    return "{" + (step(low) if low == high else f"{step(low)}:{step(high)}") + "}"


PAST, NOW, FUTURE = Relation.parse("<t"), Relation.parse("t"), Relation.parse(">t")
ALL = Relation.parse("1:T")
