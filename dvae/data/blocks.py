"""Long arrays, in memory or mapped from disk, processed in blocks and cut into windows on demand.

Functions read a mapped array (`dvae.data.npy`) block by block or window by window, and memory does not grow with its
length. Arrays in memory are processed in the same way, and no unused part is copied.
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
"""Number of values in a block: in double precision they take one megabyte, which fits into a processor's cache."""


def ranges(values: np.ndarray | Tensor) -> Iterator[slice]:
    """Yield slices of the rows of values (N, ...) in order, with about `NUMBERS` numbers each."""
    rows = max(NUMBERS // max(prod(values.shape[1:]), 1), 1)
    for start in range(0, len(values), rows):
        yield slice(start, start + rows)


def blocks(values: np.ndarray | Tensor) -> Iterator[Any]:
    """Yield blocks of the rows of values (N, ...) in order."""
    return (values[rows] for rows in ranges(values))


def row_blocks(arrays: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield blocks of the rows of several arrays (N, C) in order; short arrays share a block."""
    parts, size = list[np.ndarray](), 0
    for block in chain.from_iterable(map(blocks, arrays)):
        parts.append(block)
        size += block.size
        if size >= NUMBERS:
            yield np.concatenate(parts)
            parts, size = [], 0
    if parts:
        yield np.concatenate(parts)


def cut_windows(arrays: Sequence[np.ndarray], indices: Tensor, starts: Tensor, lengths: Tensor | int) -> Tensor:
    """Return windows (B, T, ...) of arrays (N, ...), copied to a floating type that represents all their values.

    Args:
        arrays: arrays with rows of one shape.
        indices: (B,) index of each window's array.
        starts: (B,) first row of each window in its array.
        lengths: (B,) number of rows of each window, or one number for all; shorter windows repeat their last row.
    """
    steps = [lengths] * len(indices) if isinstance(lengths, int) else lengths.tolist()
    dtype = np.result_type(np.float32, *{values.dtype for values in arrays})
    windows = np.empty((len(indices), max(steps, default=0), *arrays[0].shape[1:]), dtype)
    for window, index, start, length in zip(windows, indices.tolist(), starts.tolist(), steps, strict=True):
        window[:length] = arrays[index][start : start + length]
        window[length:] = window[length - 1]
    return torch.from_numpy(windows)


@dataclass(frozen=True, eq=False)
class ColumnSummary:
    """Statistics of each column of an array, (C,) each, which ignore NaN.

    Args:
        count: number of values.
        mean, variance: population mean and variance; 0 for empty columns.
        least, largest: minimum and maximum; infinite for empty columns.
    """

    count: np.ndarray
    mean: np.ndarray
    variance: np.ndarray
    least: np.ndarray
    largest: np.ndarray

    @classmethod
    def of(cls, parts: Iterable[np.ndarray | Tensor]) -> ColumnSummary:
        """Summarise all rows of parts (n, C), each read once, in double precision.

        Raises:
            ValueError: if there are no parts.
        """
        total: ColumnSummary | None = None
        for part in parts:
            values = part.detach().double().cpu().numpy() if isinstance(part, Tensor) else part
            summary = cls.of_block(np.array(values, np.float64))
            total = summary if total is None else total.joined(summary)
        if total is None:
            raise ValueError("expected at least one value to summarise, got none")
        return total

    @classmethod
    def of_block(cls, values: np.ndarray) -> ColumnSummary:
        """Summarise rows (n, C) in double precision; the array is overwritten."""
        present = ~np.isnan(values)
        count = present.sum(0)
        where: Any = True if present.all() else present
        ends = values.min(0, initial=np.inf, where=where), values.max(0, initial=-np.inf, where=where)
        mean = values.sum(0, where=where) / count.clip(1)
        values -= mean
        values[~present] = 0
        return cls(count, mean, np.einsum("nc,nc->c", values, values) / count.clip(1), *ends)

    def joined(self, other: ColumnSummary) -> ColumnSummary:
        """Combine two summaries (Chan, Golub and LeVeque 1983, "Algorithms for computing the sample variance")."""
        count = self.count + other.count
        share, difference = other.count / count.clip(1), other.mean - self.mean
        variance = (1 - share) * self.variance + share * other.variance + share * (1 - share) * difference**2
        ends = np.minimum(self.least, other.least), np.maximum(self.largest, other.largest)
        return ColumnSummary(count, self.mean + share * difference, variance, *ends)


class Digest(Protocol):
    """A hash object, as in `hashlib`."""

    def update(self, data: Any, /) -> None:
        """Add bytes to the hash."""


def hash_values(digest: Digest, values: np.ndarray, dtype: str | np.dtype) -> None:
    """Add the bytes of an array to a hash, in C order and converted to a dtype."""
    for block in blocks(values):
        digest.update(np.ascontiguousarray(block, dtype))


def hash_list(digest: Digest, items: Iterable[Any]) -> None:
    """Add the `repr` of a list of items to a hash; the items need not fit in memory at once."""
    texts, separator = map(repr, items), b"["
    while chunk := list(islice(texts, 4096)):
        digest.update(separator + ", ".join(chunk).encode())
        separator = b", "
    digest.update(b"]" if separator == b", " else b"[]")
