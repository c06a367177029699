"""Groups: static latents that the sequences of a group share, above those that each has.

    p(g) p(w | g) p(z_t | z_{t-1}, w) p(x_t | z_t)        q(g | x_{1:T}) q(w | x_{1:T}, g) ...

g has one value for all sequences that have the same "group" in a batch. Its guide reads them all: features of the
sequences are averaged before its law (as in neural processes, Garnelo et al. 2018, arXiv 1807.01622, and deep sets).
Every sequence holds the value of its group, and an equal share of its density, so that shapes and sums are what they
are without groups.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor
from torch.distributions import constraints, kl_divergence, register_kl


@dataclass(frozen=True)
class Groups:
    """Which sequences of a batch belong together.

    Args:
        place: (B,), the group of every sequence, from 0.
        first: (G,), the first sequence of every group.
        count: (B,), how many sequences the group of each one has.
    """

    place: Tensor
    first: Tensor
    count: Tensor

    @classmethod
    def of(cls, index: Tensor) -> Groups:
        """Of whatever numbers tell groups apart, (B,).

        Raises:
            ValueError: no whole numbers (B,).
        """
        if index.dim() != 1 or index.is_floating_point():
            raise ValueError(f"group is {index.dtype} {tuple(index.shape)}; expected whole numbers (B,)")
        _, place, count = torch.unique(index, return_inverse=True, return_counts=True)
        rows = torch.arange(len(place), device=place.device)
        # by the least row: of several writes to one place a GPU leaves open which is the last
        first = rows.new_full((len(count),), len(place)).scatter_reduce(0, place, rows, "amin")
        return cls(place, first, count[place])

    def again(self, n: int) -> Groups:
        """Of the batch n times over, in which each copy has groups of its own."""
        groups = len(self.first)
        copies = torch.arange(n, device=self.place.device)[:, None]
        place, first = (self.place + groups * copies).flatten(), (self.first + len(self.place) * copies).flatten()
        return Groups(place, first, self.count.repeat(n))

    def pooled(self, features: Tensor) -> Tensor:
        """(B, H): the mean over the group of each sequence."""
        total = features.new_zeros(len(self.first), features.shape[-1]).index_add(0, self.place, features)
        return total[self.place] / self.count[:, None].to(features)

    def shared(self, values: Tensor) -> Tensor:
        """(..., B, D): that of the first sequence of each group, for all of them."""
        return values[..., self.first[self.place], :]

    def summed(self, values: Tensor) -> Tensor:
        """(..., G): sums of (..., B) over the groups."""
        return values.new_zeros(*values.shape[:-1], len(self.first)).index_add(-1, self.place, values)

    def dealt(self, values: Tensor) -> Tensor:
        """(..., B): an equal share of (..., G) for each sequence of a group."""
        return values[..., self.place] / self.count.to(values)


class Grouped(TorchDistribution):
    """The law of a static latent that groups share: batch (B,), event (D,).

    Args:
        base: the law of each sequence's value, the same within a group.
        groups: which sequences share a value.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    def __init__(self, base: Any, groups: Groups):
        self.base, self.groups = base, groups
        self.has_rsample = base.has_rsample
        super().__init__(base.batch_shape, base.event_shape, validate_args=False)

    @property
    def support(self) -> Any:
        """That of the law."""
        return self.base.support

    @property
    def mean(self) -> Tensor:
        """(B, D)."""
        return self.base.mean

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """One draw for each group, (B, D)."""
        return self.groups.shared(self.base.rsample(torch.Size(sample_shape)))

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """`rsample` without its gradient."""
        with torch.no_grad():
            return self.groups.shared(self.base.sample(torch.Size(sample_shape)))

    def expand(self, batch_shape: Any, _instance: object = None) -> Grouped:
        """Itself: it has one batch shape."""
        if torch.Size(batch_shape) != self.batch_shape:
            raise NotImplementedError(f"{self.batch_shape} is the batch of its groups, which is not {batch_shape}")
        return self

    def log_prob(self, value: Tensor) -> Tensor:
        """(B,): a sequence's share of the density of its group's value."""
        return self.base.log_prob(value) / self.groups.count


@register_kl(Grouped, Grouped)
def _kl(q: Grouped, p: Grouped) -> Tensor:
    return kl_divergence(q.base, p.base) / q.groups.count
