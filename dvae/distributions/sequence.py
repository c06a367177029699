"""Sequence: the distribution of one local variable over all its steps, autoregressive or not."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

if TYPE_CHECKING:
    from ..rollout import Rollout


class Sequence(TorchDistribution):
    """The law of a local variable in one run of a factorization: batch (B,), event (T, D).

    `rsample` draws step by step where the factorization asks for it; `log_prob` evaluates every step at once, given
    the run's other values.

    Args:
        rollout: the run.
        name: the variable.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    def __init__(self, rollout: Rollout, name: str):
        self.rollout = rollout
        self.name = name
        self.has_rsample = rollout.conditionals[name].reparameterised
        size = rollout.conditionals[name].size
        super().__init__(torch.Size([rollout.batch]), torch.Size([rollout.length, size]), validate_args=False)

    @constraints.dependent_property(is_discrete=False, event_dim=2)
    def support(self) -> constraints.Constraint:
        """Real sequences."""
        return constraints.independent(constraints.real, 2)

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """A draw (B, T, D). Variables that are drawn in the same loop over time are drawn with it."""
        if sample_shape:
            raise NotImplementedError(
                f"a Sequence draws one batch at a time, but shape {tuple(sample_shape)} was asked for; repeat the "
                "batch, as forecast(samples=...) and importance_bound(particles=...) do"
            )
        return self.rollout.draw(self.name)

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """`rsample` without its gradient, which variables that are drawn with it keep."""
        return self.rsample(sample_shape).detach()

    def elementwise(self, value: Tensor) -> TorchDistribution:
        """All conditionals at once, over (B, T, D), given `value` and the run's other values."""
        return self.rollout.evaluate(self.name, value)

    def given(self, value: Tensor) -> TorchDistribution:
        """`elementwise` with padding and missing entries masked out: batch (B,), event (T, D)."""
        base = self.elementwise(value)
        mask = self.rollout.mask(self.name)
        return (base if mask is None else base.mask(mask)).to_event(2)

    def log_prob(self, value: Tensor) -> Tensor:
        """(B,)."""
        return self.given(value).log_prob(value)

    def expand(self, batch_shape: Any, _instance: object = None) -> Sequence:
        """Itself: a run has one batch shape."""
        if torch.Size(batch_shape) != self.batch_shape:
            raise NotImplementedError(
                f"a Sequence of batch {tuple(self.batch_shape)} cannot be expanded to {tuple(batch_shape)}; "
                "vectorised particles are had by repeating the batch (importance_bound(particles=...))"
            )
        return self
