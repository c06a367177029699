"""Objectives: functions from the terms of a bound to the loss that training minimises.

An objective is a function of `Terms` and the global step. `Evidence` is the negative evidence lower bound with a weight
on each KL term (warm-up; Bowman et al. 2016, arXiv 1511.06349; beta-VAE, Higgins et al. 2017) and free bits (Kingma et
al. 2016, arXiv 1606.04934). The weights never change the recorded bound: model selection reads `Terms.bound`.

An objective with adaptive weights (`gradnorm`) is described by an `AdaptiveObjective` without state. Each stage of a
run creates a `StatefulObjective` from it. The state belongs to the run and its checkpoints, so two runs may share one
description.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from torch import Tensor, nn
from typing_extensions import Protocol, runtime_checkable

from .schedules import Schedule, schedule, to_config

if TYPE_CHECKING:
    from ..bounds.elbo import Terms


class Objective(Protocol):
    """Function that returns the loss of a batch, in nats per step, from its terms."""

    def __call__(self, terms: "Terms", step: int) -> Tensor:
        """Return the loss of a batch at a global step."""


@runtime_checkable
class RequiresDraws(Protocol):
    """Objective that declares the draws it needs and the score that selects the best weights, such as `Evidence`."""

    @property
    def draws(self) -> Mapping[str, int]:
        """Number of draws of each latent for each sequence, by name."""

    @property
    def select(self) -> Literal["bound", "loss"]:
        """Score that selects the best weights."""


@runtime_checkable
class WeightedObjective(Objective, Protocol):
    """Objective whose loss depends on the step only through numbers, which a CUDA graph receives as tensors."""

    def weights(self, step: int) -> Mapping[str, float]:
        """Return the weights at a global step, by name; their names do not depend on the step."""

    def loss(self, terms: "Terms", weights: Mapping[str, Any]) -> Tensor:
        """Return the loss at given weights, numbers or scalar tensors."""


@runtime_checkable
class StatefulObjective(Objective, Protocol):
    """Objective with a state within a stage of a run, such as `gradnorm.Balance`.

    Each step calls `measure`, the objective itself for the loss, and `adapt`, in this order.
    """

    @property
    def state(self) -> Mapping[str, Tensor]:
        """All values that later calls depend on, by name; finite, with constant names, shapes and types."""

    @property
    def row(self) -> Mapping[str, float]:
        """Current values for the log, by name."""

    def measure(self, terms: "Terms") -> Mapping[str, Tensor]:
        """Return quantities of a batch by name, before the backward pass; the autograd graph must be retained."""

    def adapt(self, measured: Mapping[str, Tensor], mean: Callable[[Tensor], Tensor]) -> None:
        """Update the state after the backward pass and its checks; before the optimiser's step, except in CUDA graphs.

        Args:
            measured: result of `measure`.
            mean: function that averages a tensor over the processes; every process must call it.
        """

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Continue from a checkpoint's state with the same names, shapes and types, or raise ValueError."""


@runtime_checkable
class AdaptiveObjective(Protocol):
    """Objective whose state is reset at each stage; called directly, it uses constant weights."""

    def begin(self, model: nn.Module) -> StatefulObjective:
        """Return the objective with its state for a stage; raise ValueError if the model does not fit."""


@dataclass(frozen=True)
class Evidence:
    """Negative weighted evidence lower bound, in nats per step.

    Division by the number of steps F makes learning rates independent of sequence length. With sums over the sequences
    of the batch,

        loss = - weight * sum log p / F + sum_latents weight * max(KL / F, free bits)
               + sum_energies weight * energy / F.

    Args:
        kl_weight: weight of the KL terms, a number or a schedule; or one for each latent by name (default 1).
        free_bits: nats per step, averaged over the batch, below which a latent's KL is not penalised; a number for all
            latents, or one for each latent by name (default 0).
        energy_weights: weight of each energy by name (default 1).
        likelihood_weight: weight of the log-likelihood. If energies train the locations and the likelihood only the
            scales, use a small weight so that energies dominate the loss; an adaptive optimiser fits the scales at any
            weight.
        draws: number of draws of a latent for each sequence, by name. Energies that compare samples, such as best of
            many, need several (see `DynamicalVAE.model`). The terms of the bound are means over the draws.
        select: score that selects the best weights: the unweighted "bound", or the "loss" if energies are trained.

    Raises:
        ValueError: on the first call, when a name is not among the terms.

    Example:
        >>> warm_up = dvae.Evidence(kl_weight=dvae.schedules.Ramp(0.0, 1.0, steps=500), free_bits={"z": 0.1})
    """

    kl_weight: float | Schedule | Mapping[str, float | Schedule] = 1.0
    free_bits: float | Mapping[str, float] = 0.0
    energy_weights: Mapping[str, float | Schedule] = field(default_factory=dict)
    likelihood_weight: float = 1.0
    draws: Mapping[str, int] = field(default_factory=dict)
    select: Literal["bound", "loss"] = "bound"

    def __post_init__(self) -> None:
        if self.select not in ("bound", "loss"):
            raise ValueError(f"select must be 'bound' or 'loss', got {self.select!r}")

    def __call__(self, terms: "Terms", step: int) -> Tensor:
        """Return the loss, a scalar."""
        return self.loss(terms, self.weights(step))

    def weights(self, step: int) -> dict[str, float]:
        """Return the scheduled weights at a global step, as "kl_weight" for all latents or "kl_weight/z" for one."""
        values: dict[str, float] = {}
        for option in ("kl_weight", "energy_weights"):
            given = getattr(self, option)
            by_name = isinstance(given, Mapping)
            weights = {f"{option}/{name}": value for name, value in given.items()} if by_name else {option: given}
            values |= {name: schedule(weight)(step) for name, weight in weights.items()}
        return values

    def loss(self, terms: "Terms", weights: Mapping[str, Any]) -> Tensor:
        """Return the loss, a scalar.

        Args:
            terms: terms of the bound.
            weights: result of `weights`, as numbers or scalar tensors.
        """
        for option, names in (("kl_weight", terms.kl), ("energy_weights", terms.energies)):
            _by_name(option, getattr(self, option), names, default=1.0)
        free_bits = _by_name("free_bits", self.free_bits, terms.kl, default=0.0)
        frames = terms.n_steps.sum()
        likelihood = sum((value.sum() for value in terms.log_likelihood.values()), frames.new_zeros(()))
        loss = -self.likelihood_weight * likelihood / frames
        for latent, kl in terms.kl.items():
            rate = kl.sum() / frames
            if free_bits[latent] > 0:  # without free bits no clamp: an unbiased estimate of a KL may be negative
                rate = rate.clamp(min=free_bits[latent])
            loss = loss + weights.get(f"kl_weight/{latent}", weights.get("kl_weight", 1.0)) * rate
        for name, energy in terms.energies.items():
            loss = loss + weights.get(f"energy_weights/{name}", 1.0) * energy.sum() / frames
        return loss

    def to_config(self) -> dict[str, Any]:
        """Return the objective as a JSON object."""
        return {"objective": "Evidence"} | {name: to_config(value) for name, value in vars(self).items()}


def _by_name(option: str, value: Any, names: Iterable[str], default: float) -> dict[str, Any]:
    """Return one value for each name, from a single value or a mapping of some names."""
    names = list(names)
    if not isinstance(value, Mapping):
        return dict.fromkeys(names, value)
    if unknown := set(value) - set(names):
        raise ValueError(
            f"{option} names {', '.join(sorted(map(repr, unknown)))}, but the terms are {', '.join(names) or 'none'}"
        )
    return {name: value.get(name, default) for name in names}
