"""Random subsets of fixed size from a set of indices.

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
    """Random subset of the indices of a variable: a fixed share of them, drawn uniformly without replacement.

    With a curriculum, the subset initially consists of the first indices. As training progresses, an increasing number
    of them is replaced by other random indices, up to the expected number in a uniform draw. If training uses several
    processes, each process draws a subset for its own part of a batch.

    Args:
        share: share of the indices, from 0 to 1; the number of chosen indices is rounded up.

    Raises:
        ValueError: `share` is not from 0 to 1.
    """

    share: Share

    def __post_init__(self) -> None:
        check(self)

    def chosen(self, size: int) -> int:
        """Return how many of `size` indices are chosen.

        Args:
            size: number of indices.
        """
        return ceil(self.share * size - 1e-9)  # rounding error must not turn 0.3 * 10 into 4

    def distribution(
        self, size: int, curriculum: float = 1.0, device: torch.device | None = None
    ) -> SubsetDistribution:
        """Return the distribution of vectors (L,) that are 1 at chosen indices and 0 elsewhere.

        Args:
            size: L, number of indices.
            curriculum: progress of the curriculum, from 0 (the first indices) to 1 (a uniform draw).
            device: device of the draws.
        """
        n_chosen = self.chosen(size)
        most = round(n_chosen * (size - n_chosen) / size)
        swapped = int(curriculum * most)
        return SubsetDistribution(size, n_chosen, None if curriculum >= 1 else swapped, device)


class SubsetDistribution(TorchDistribution):
    """Uniform distribution over vectors (L,) of zeros and ones with a fixed number of ones.

    Args:
        size: L, number of indices.
        ones: number of ones.
        swapped: number of ones that are not among the first `ones` indices; None for any number.
        device: device of the draws.

    Raises:
        ValueError: there are no vectors with these numbers of ones.
    """

    arg_constraints: ClassVar[dict[str, Any]] = {}
    support = constraints.independent(constraints.boolean, 1)

    def __init__(self, size: int, ones: int, swapped: int | None = None, device: torch.device | None = None) -> None:
        if not 0 <= ones <= size or not 0 <= (swapped or 0) <= min(ones, size - ones):
            raise ValueError(
                "`ones` must be from 0 to `size`, and `swapped` from 0 to min(ones, size - ones); "
                f"got size={size}, ones={ones}, swapped={swapped}"
            )
        self.size, self.ones, self.swapped, self.device = size, ones, swapped, device
        super().__init__(torch.Size(), torch.Size([size]), validate_args=False)

    @lazy_property
    def _log_number(self) -> float:
        """Natural logarithm of the number of possible subsets."""
        if self.swapped is None:
            return _log_choose(self.size, self.ones)
        return _log_choose(self.ones, self.swapped) + _log_choose(self.size - self.ones, self.swapped)

    @override
    def sample(self, sample_shape: Any = ()) -> Tensor:
        shape = torch.Size(sample_shape)
        if self.swapped is None:
            return self._draw(shape, self.size, self.ones)
        first = 1 - self._draw(shape, self.ones, self.swapped)
        return torch.cat([first, self._draw(shape, self.size - self.ones, self.swapped)], -1)

    def _draw(self, shape: torch.Size, size: int, count: int) -> Tensor:
        """Return a tensor (*shape, size) of zeros with ones at `count` random indices of the last dimension."""
        positions = torch.rand(*shape, size, device=self.device).argsort(-1)[..., :count]
        return torch.zeros(*shape, size, device=self.device).scatter(-1, positions, 1.0)

    @override
    def log_prob(self, value: Tensor) -> Tensor:
        valid = ((value == 0) | (value == 1)).all(-1) & (value.sum(-1) == self.ones)
        if self.swapped is not None:
            valid &= value[..., self.ones :].sum(-1) == self.swapped
        return torch.where(valid, -self._log_number, -torch.inf).to(value.dtype)


def _log_choose(size: int, count: int) -> float:
    return lgamma(size + 1) - lgamma(count + 1) - lgamma(size - count + 1)
