"""Long arrays, in memory or mapped from a disk: gone through in blocks, and cut into windows where these are drawn.

What is made of a mapped array (`dvae.data.npy`) is made of a block or of some windows of it, so that memory does not
grow with its length. Arrays in memory are treated alike: nothing is copied that is not used.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from math import prod
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

NUMBERS = 2**17
"""Of a block: copies of it in double precision, a megabyte each, stay in a processor's cache."""


def ranges(values: np.ndarray | Tensor) -> Iterator[slice]:
    """Rows of values (N, ...) in order, as many at a time as have about `NUMBERS` numbers."""
    rows = max(NUMBERS // max(prod(values.shape[1:]), 1), 1)
    for start in range(0, len(values), rows):
        yield slice(start, start + rows)


def blocks(values: np.ndarray | Tensor) -> Iterator[Any]:
    """Values (N, ...) in order, so many rows at a time."""
    return (values[rows] for rows in ranges(values))


def row_blocks(arrays: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """Rows of arrays (N, C) one after the other in such blocks, in which short arrays are together."""
    held, size = list[np.ndarray](), 0
    for block in chain.from_iterable(map(blocks, arrays)):
        held.append(block)
        size += block.size
        if size >= NUMBERS:
            yield np.concatenate(held)
            held, size = [], 0
    if held:
        yield np.concatenate(held)


def cut(arrays: Sequence[np.ndarray], which: Tensor, starts: Tensor, lengths: Tensor | int) -> Tensor:
    """Windows (B, T, ...) of arrays (N, ...), copied in a floating type that holds all their values.

    Args:
        arrays: with rows of one shape.
        which: (B,) places of arrays.
        starts: (B,) first rows.
        lengths: (B,) rows of each window, or of all; behind a shorter one its last row is repeated.
    """
    steps = [lengths] * len(which) if isinstance(lengths, int) else lengths.tolist()
    dtype = np.result_type(np.float32, *{values.dtype for values in arrays})
    found = np.empty((len(which), max(steps, default=0), *arrays[0].shape[1:]), dtype)
    for window, place, start, length in zip(found, which.tolist(), starts.tolist(), steps, strict=True):
        window[:length] = arrays[place][start : start + length]
        window[length:] = window[length - 1]
    return torch.from_numpy(found)


@dataclass(frozen=True, eq=False)
class ColumnSummary:
    """What is known of columns, (C,) each, NaN left aside.

    Args:
        count: of values.
        mean, variance: of them, as of a population; 0 where there is none.
        least, largest: of them; infinite where there is none.
    """

    count: np.ndarray
    mean: np.ndarray
    variance: np.ndarray
    least: np.ndarray
    largest: np.ndarray

    @classmethod
    def of(cls, parts: Iterable[np.ndarray | Tensor]) -> ColumnSummary:
        """That of all rows of parts (n, C), each of which is read once, in double precision.

        Raises:
            ValueError: there is no part.
        """
        found: ColumnSummary | None = None
        for part in parts:
            values = part.detach().double().cpu().numpy() if isinstance(part, Tensor) else part
            own = cls.of_block(np.array(values, np.float64))
            found = own if found is None else found.joined(own)
        if found is None:
            raise ValueError("there are no values to summarise")
        return found

    @classmethod
    def of_block(cls, values: np.ndarray) -> ColumnSummary:
        """That of rows (n, C) in double precision, which are used up."""
        there = ~np.isnan(values)
        count = there.sum(0)
        known: Any = True if there.all() else there
        ends = values.min(0, initial=np.inf, where=known), values.max(0, initial=-np.inf, where=known)
        mean = values.sum(0, where=known) / count.clip(1)
        values -= mean
        values[~there] = 0
        return cls(count, mean, np.einsum("nc,nc->c", values, values) / count.clip(1), *ends)

    def joined(self, other: ColumnSummary) -> ColumnSummary:
        """That of the rows of both (Chan, Golub and LeVeque 1983, "Algorithms for computing the sample variance")."""
        count = self.count + other.count
        share, apart = other.count / count.clip(1), other.mean - self.mean
        variance = (1 - share) * self.variance + share * other.variance + share * (1 - share) * apart**2
        ends = np.minimum(self.least, other.least), np.maximum(self.largest, other.largest)
        return ColumnSummary(count, self.mean + share * apart, variance, *ends)


class Digest(Protocol):
    """A hash in the making, as of `hashlib`."""

    def update(self, data: Any, /) -> None:
        """Goes on with these bytes."""


def hash_values(digest: Digest, values: np.ndarray, dtype: str | np.dtype) -> None:
    """Goes on with the bytes of an array in C order, as numbers of such a type."""
    for block in blocks(values):
        digest.update(np.ascontiguousarray(block, dtype))


def hash_list(digest: Digest, items: Iterable[Any]) -> None:
    """Goes on with what `repr` says of a list of these, which need not be held at once."""
    said, before = map(repr, items), b"["
    while some := list(islice(said, 4096)):
        digest.update(before + ", ".join(some).encode())
        before = b", "
    digest.update(b"]" if before == b", " else b"[]")
