"""Subsets: which of some indices are chosen, at random, in the same number each time.

>>> Subset(0.5).distribution(6).sample().sum()
tensor(3.)
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, lgamma
from typing import Any, ClassVar

import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor
from torch.distributions import constraints
from torch.distributions.utils import lazy_property
from typing_extensions import override

from ..options import Share, check


@dataclass(frozen=True)
class Subset:
    """Which indices of a variable are chosen: a share of them, uniformly without replacement.

    A curriculum begins with the first ones and swaps more and more of them for others: at its end as many as differ,
    in the mean, in a uniform draw. Each process of several draws for its own share of a batch.

    Args:
        share: of the indices, from 0 to 1; of L of them, that times L is rounded up.
    """

    share: Share

    def __post_init__(self) -> None:
        check(self)

    def chosen(self, size: int) -> int:
        """How many of so many indices."""
        return ceil(self.share * size - 1e-9)  # .3 of 10 is 3, and not 4

    def distribution(self, size: int, curriculum: float = 1.0) -> Subsets:
        """The distribution of (L,), 1 at chosen indices and 0 at others.

        Args:
            size: L.
            curriculum: how far it has come, from 0 to 1.
        """
        chosen = self.chosen(size)
        most = round(chosen * (size - chosen) / size)
        swapped = int(curriculum * most)
        return Subsets(size, chosen, None if curriculum >= 1 else swapped)


class Subsets(TorchDistribution):
    """Vectors (L,) of zeros and ones, with so many ones, all alike probable.

    Args:
        size: L.
        chosen: how many are 1.
        swapped: how many of those are not among the first; None for any number.
    """

    arg_constraints: ClassVar[dict[str, Any]] = {}
    support = constraints.independent(constraints.boolean, 1)

    def __init__(self, size: int, chosen: int, swapped: int | None = None) -> None:
        if not 0 <= chosen <= size or not 0 <= (swapped or 0) <= min(chosen, size - chosen):
            raise ValueError(f"cannot choose {chosen} of {size} indices, {swapped} of them not among the first")
        self.size, self.chosen, self.swapped = size, chosen, swapped
        super().__init__(torch.Size(), torch.Size([size]), validate_args=False)

    @lazy_property
    def _log_number(self) -> float:
        """Of the sets."""
        if self.swapped is None:
            return _log_choose(self.size, self.chosen)
        return _log_choose(self.chosen, self.swapped) + _log_choose(self.size - self.chosen, self.swapped)

    @override
    def sample(self, sample_shape: Any = ()) -> Tensor:
        shape = torch.Size(sample_shape)
        if self.swapped is None:
            return _some(shape, self.size, self.chosen)
        first = 1 - _some(shape, self.chosen, self.swapped)
        return torch.cat([first, _some(shape, self.size - self.chosen, self.swapped)], -1)

    @override
    def log_prob(self, value: Tensor) -> Tensor:
        right = ((value == 0) | (value == 1)).all(-1) & (value.sum(-1) == self.chosen)
        if self.swapped is not None:
            right &= value[..., self.chosen :].sum(-1) == self.swapped
        return torch.where(right, -self._log_number, -torch.inf).to(value.dtype)


def _some(shape: torch.Size, size: int, count: int) -> Tensor:
    """(*shape, size), 1 at so many places."""
    places = torch.rand(*shape, size).argsort(-1)[..., :count]
    return torch.zeros(*shape, size).scatter(-1, places, 1.0)


def _log_choose(size: int, count: int) -> float:
    return lgamma(size + 1) - lgamma(count + 1) - lgamma(size - count + 1)
