"""Groups: static latents that the sequences of a group share, in addition to latents of each sequence.

    p(g) p(w | g) p(z_t | z_{t-1}, w) p(x_t | z_t)        q(g | x_{1:T}) q(w | x_{1:T}, g) ...

The latent g has one value for all sequences with the same "group" in a batch. Its guide reads all of them: their
features are averaged before the distribution, as in neural processes (Garnelo et al. 2018, arXiv 1807.01622) and deep
sets. Every sequence stores the value of its group and an equal share of the group's log density. Shapes and sums are
therefore the same as without groups.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor
from torch.distributions import constraints, kl_divergence, register_kl

from ..capture import is_deferring


@dataclass(frozen=True)
class Groups:
    """The groups of the sequences of a batch.

    Args:
        place: (B,), index of the group of each sequence, from 0.
        first: (G,), first sequence of each group.
        count: (B,), size of the group of each sequence.
    """

    place: Tensor
    first: Tensor
    count: Tensor

    @classmethod
    def of(cls, index: Tensor) -> Groups:
        """Build groups from integer labels (B,); equal labels form a group.

        Raises:
            ValueError: if the labels are not integers of shape (B,).
        """
        if index.dim() != 1 or index.is_floating_point():
            raise ValueError(f"'group' of the batch is {index.dtype} {tuple(index.shape)}; expected integers (B,)")
        if is_deferring():  # `unique` reads the number of groups; here, each sequence has a place for one
            equal = index[:, None] == index
            place = equal.int().argmax(1)
            return cls(place, torch.arange(len(place), device=place.device), equal.sum(1))
        _, place, count = torch.unique(index, return_inverse=True, return_counts=True)
        rows = torch.arange(len(place), device=place.device)
        # the smallest row: with several writes to one place, the last one is undefined on a GPU
        first = rows.new_full((len(count),), len(place)).scatter_reduce(0, place, rows, "amin")
        return cls(place, first, count[place])

    def repeat(self, n: int) -> Groups:
        """Return the groups of the batch repeated n times; each copy has its own groups."""
        groups = len(self.first)
        copies = torch.arange(n, device=self.place.device)[:, None]
        place, first = (self.place + groups * copies).flatten(), (self.first + len(self.place) * copies).flatten()
        return Groups(place, first, self.count.repeat(n))

    def pool(self, features: Tensor) -> Tensor:
        """Return the mean of features (B, H) over the group of each sequence, (B, H)."""
        total = features.new_zeros(len(self.first), features.shape[-1]).index_add(0, self.place, features)
        return total[self.place] / self.count[:, None].to(features)

    def shared(self, values: Tensor) -> Tensor:
        """Return values (..., B, D) with every sequence set to the value of the first sequence of its group."""
        return values[..., self.first[self.place], :]

    def summed(self, values: Tensor) -> Tensor:
        """Return sums (..., G) of values (..., B) over the groups."""
        return values.new_zeros(*values.shape[:-1], len(self.first)).index_add(-1, self.place, values)

    def split_evenly(self, values: Tensor) -> Tensor:
        """Return an equal share of values (..., G) for each sequence of a group, (..., B)."""
        return values[..., self.place] / self.count.to(values)


class Grouped(TorchDistribution):
    """The distribution of a static latent that groups share, with batch shape (B,) and event shape (D,).

    Args:
        base: distribution of each sequence's value, equal within a group.
        groups: groups of sequences.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    def __init__(self, base: Any, groups: Groups):
        self.base, self.groups = base, groups
        self.has_rsample = base.has_rsample
        super().__init__(base.batch_shape, base.event_shape, validate_args=False)

    @property
    def support(self) -> Any:
        """Support of the base distribution."""
        return self.base.support

    @property
    def mean(self) -> Tensor:
        """Mean, (B, D)."""
        return self.base.mean

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Draw one value for each group, (B, D)."""
        return self.groups.shared(self.base.rsample(torch.Size(sample_shape)))

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Draw as `rsample`, without a gradient."""
        with torch.no_grad():
            return self.groups.shared(self.base.sample(torch.Size(sample_shape)))

    def expand(self, batch_shape: Any, _instance: object = None) -> Grouped:
        """Return the distribution itself; any other batch shape raises an error."""
        if torch.Size(batch_shape) != self.batch_shape:
            raise NotImplementedError(
                f"a grouped latent of batch {tuple(self.batch_shape)} cannot be expanded to {tuple(batch_shape)}"
            )
        return self

    def log_prob(self, value: Tensor) -> Tensor:
        """Return each sequence's share of the log density of its group's value, (B,)."""
        return self.base.log_prob(value) / self.groups.count


@register_kl(Grouped, Grouped)
def _kl(q: Grouped, p: Grouped) -> Tensor:
    return kl_divergence(q.base, p.base) / q.groups.count
