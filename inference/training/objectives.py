"""Objectives: from the terms of a bound to the number that training minimises.

An objective is a function of `Terms` and the global step. `Evidence` is the negative evidence lower bound
with a weight on each KL term (warm-up; Bowman et al. 2016, arXiv 1511.06349; beta-VAE, Higgins et al. 2017)
and free bits (Kingma et al. 2016, arXiv 1606.04934). The weights never touch the bound that is recorded:
model selection reads `Terms.bound`.

An objective with a state, such as weights that adapt (`gradnorm`), is `Adaptive`: a description, which a stage of a run
begins as `Adapting`. The state is the run's own, in its checkpoints, and two runs may have one description.
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
    """A scalar to minimise, in nats per frame, from the terms of a batch."""

    def __call__(self, terms: "Terms", step: int) -> Tensor:
        """Return the loss of a batch at a global step."""


@runtime_checkable
class Asking(Protocol):
    """An objective that says what draws it needs, and what tells the best weights; see `Evidence`."""

    @property
    def draws(self) -> Mapping[str, int]:
        """Of a latent, by name, for each sequence."""

    @property
    def select(self) -> Literal["bound", "loss"]:
        """What tells the best weights."""


@runtime_checkable
class Adapting(Objective, Protocol):
    """An objective in a stage of a run, with a state of its own; see `gradnorm.Balance`.

    A step asks it to `measure`, for its loss, and to `adapt`, in this order.
    """

    @property
    def state(self) -> Mapping[str, Tensor]:
        """All that a later call depends on, by name, finite; their names, shapes and types stay as they begin."""

    @property
    def row(self) -> Mapping[str, float]:
        """Numbers for the log, by name, as they are in the step."""

    def measure(self, terms: "Terms") -> None:
        """Take what it needs of gradients of a batch, whose graph has to be kept, before the backward pass."""

    def adapt(self, mean: Callable[[Tensor], Tensor]) -> None:
        """Change the state, after the backward pass and before the optimiser's step, which is sure to be taken.

        Args:
            mean: of a tensor over the processes, for which all of them have to ask.
        """

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Go on with a checkpoint's state, which has the names, shapes and types of this one, or raise ValueError."""


@runtime_checkable
class Adaptive(Protocol):
    """An objective that each stage begins anew; called itself, it is the one whose losses validation compares."""

    def begin(self, model: nn.Module) -> Adapting:
        """The objective in a stage of a run of this model, or ValueError: it lacks what is needed."""


@dataclass(frozen=True)
class Evidence:
    """Minus the weighted evidence lower bound, in nats per frame, so that learning rates do not depend on the
    length.

    With sums over the sequences of the batch, and F their number of frames,

        loss = - weight * sum log p / F + sum_latents weight * max(KL / F, free bits) + sum_energies weight * energy /
        F.

    Args:
        kl_weight: weight of the KL terms, a number or a schedule; or one for each latent by name (others
            weigh 1).
        free_bits: nats per frame, averaged over the batch, below which a latent's KL costs nothing more; a
            number for every latent, or one for each latent by name (others have none).
        energy_weights: weight of each energy by name (others weigh 1).
        likelihood_weight: of the log-likelihood. Where energies train the locations, and it fits no more than scales,
            whose steps an adaptive optimiser takes at any weight, a small one leaves the loss to the energies.
        draws: of a latent, by name, for each sequence: energies that compare samples, such as that of the best of
            many, need several (see `DynamicalVAE.model`). The terms of the bound are means over them.
        select: what tells the best weights: the unweighted "bound", or the "loss" itself, where energies are what is
            trained.

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
            raise ValueError(f"select is {self.select!r}; it must be 'bound' or 'loss'")

    def __call__(self, terms: "Terms", step: int) -> Tensor:
        """Return the loss, a scalar."""
        kl_weight = _by_name("kl_weight", self.kl_weight, terms.kl, default=1.0)
        free_bits = _by_name("free_bits", self.free_bits, terms.kl, default=0.0)
        energy_weights = _by_name("energy_weights", self.energy_weights, terms.energies, default=1.0)
        frames = terms.frames.sum()
        likelihood = sum((value.sum() for value in terms.log_likelihood.values()), frames.new_zeros(()))
        loss = -self.likelihood_weight * likelihood / frames
        for latent, kl in terms.kl.items():
            rate = kl.sum() / frames
            if free_bits[latent] > 0:  # at zero there is no floor: an unbiased estimate of a KL may be negative
                rate = rate.clamp(min=free_bits[latent])
            loss = loss + schedule(kl_weight[latent])(step) * rate
        for name, energy in terms.energies.items():
            loss = loss + schedule(energy_weights[name])(step) * energy.sum() / frames
        return loss

    def to_config(self) -> dict[str, Any]:
        """Return the objective as a JSON object."""
        return {"objective": "Evidence"} | {name: to_config(value) for name, value in vars(self).items()}


def _by_name(option: str, value: Any, names: Iterable[str], default: float) -> dict[str, Any]:
    """One value for each name, from one value for all or from a mapping with some of the names."""
    names = list(names)
    if not isinstance(value, Mapping):
        return dict.fromkeys(names, value)
    if unknown := set(value) - set(names):
        raise ValueError(
            f"{option} names {', '.join(sorted(map(repr, unknown)))}, but the terms are {', '.join(names) or 'none'}"
        )
    return {name: value.get(name, default) for name in names}
