"""Method for any pair of equations: the user gives the factorization, and all factors use one kind of network."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from typing_extensions import override

from ...data.schema import Schema, SchemaError
from ...distributions import Diffusion, DistributionSpec
from ...factorization.inversion import guide
from ...factorization.notation import Factorization
from ...factorization.relations import ALL
from ...networks import Attention, Denoiser, Dense, Linear, NetworkSpec, Recurrent, SelfAttention
from ...options import Range, Size, nearest
from ...program.enumeration import LARGEST, Discrete
from ...program.model import DynamicalVAE
from ..method import LatentMethod


@dataclass(frozen=True)
class Equations(LatentMethod):
    """A model of user-defined equations.

    Args:
        generative: factorization of the model.
        inference: factorization of the guide; "" for a model without latents.
        network: "recurrent", "attention", "dense" or "linear", for every factor.
        width: width of the networks.
        latents: sizes of the latents, where they differ from `latent`.
        states: numbers of states of discrete latents, which are summed out and have no factor in the guide.
        grouped: static latents that the sequences of a group share; see `dvae.program.groups`.
        emission: as in `LikelihoodMethod`. With "diffusion", a factor written as p(x_{1:T}) or p(x_{1:T} | w) denoises
            all steps at once: a transformer reads their cosine coefficients.
    """

    name = "equations"
    source = "your own"

    # options in this method, constants in the others
    generative: str = "p(z_t | z_{t-1}) p(x_t | z_t)"  # type: ignore[misc]
    inference: str = "q(z_t | z_{t-1}, x_{1:T})"  # type: ignore[misc]
    network: str = "recurrent"
    width: Size = 64
    latents: dict[str, Size] = field(default_factory=dict)
    states: dict[str, Annotated[int, Range(2, LARGEST)]] = field(default_factory=dict)
    grouped: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("generative", "inference"):
            if lag := re.search(r"\d{4,}", getattr(self, name)):
                raise ValueError(
                    f"{name} has a lag of {lag[0][:20]} steps; a lag is at most 999; for all past steps write {{<t}}"
                )

    @override
    def equations(self) -> tuple[Factorization, Factorization]:
        """Return the model and its guide, which has no factors of discrete latents."""
        generative = Factorization.parse(self.generative)
        return generative, guide(generative, self.inference, summed=self.states)

    @override
    def sizes(self) -> dict[str, int]:
        """Return the sizes of all variables; the data override the sizes of observed ones."""
        variables = self.equations()[0].variables
        if unknown := self.latents.keys() - {*variables}:
            names = ", ".join(sorted(unknown))
            raise ValueError(f"latents gives sizes of {names}, but the equations have only {', '.join(variables)}")
        sizes = {name: self.latents.get(name, self.latent) for name in variables}
        return {**sizes, **{name: Discrete(states) for name, states in self.states.items()}}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return one kind of network for every factor."""
        kinds: dict[str, NetworkSpec] = {
            "recurrent": Recurrent(self.width, hidden=(self.width,)),
            "attention": Attention(self.width),
            "dense": Dense((self.width,)),
            "linear": Linear(steps=512),
        }
        if self.network not in kinds:
            raise ValueError(
                f"unknown network {self.network!r}{nearest(self.network, kinds)}; known: {', '.join(kinds)}"
            )
        return {"default": kinds[self.network]}

    @override
    def distributions(self) -> Mapping[str, DistributionSpec]:
        """Return the distributions of x and of static latents."""
        distributions = super().distributions()
        if self.emission != "diffusion" or "p(x_{1:T}" not in "".join(self.generative.split()):
            return distributions
        if self.residual:
            raise ValueError(
                f"residual is {self.residual}, but a diffusion of all steps has no previous value; leave it at 0"
            )
        x = self.equations()[0].factor("x")
        frequencies = all(parent.relation in (None, ALL) for parent in x.parents if parent.name != "x")
        denoiser = Denoiser(SelfAttention(self.width, positions="sinusoids"), "cosine" if frequencies else None)
        return {**distributions, "p(x)": Diffusion(denoiser=denoiser)}

    @override
    def model_arguments(self, sizes: Mapping[str, int]) -> dict[str, Any]:
        """Return the arguments, with the latents that groups share."""
        return {**super().model_arguments(sizes), "grouped": self.grouped}

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """Return the model of exactly these equations; in scheduled sampling, gradients flow through the means.

        Raises:
            SchemaError: if the data have no context that the equations read.
        """
        schema = Schema.of(data)
        if missing := [name for name in self._context() if name not in schema.sizes]:
            raise SchemaError(
                f"the equations read {', '.join(missing)}, which has no factor and must be in the data, but the data "
                f"have {', '.join(schema.sizes)}; a table gives covariates as c, attributes as s, and uneven time "
                "steps as d"
            )
        return self.build_for_data(schema, extended=False)

    @override
    def check(self) -> None:
        """Raise an error if the options do not fit together, for any size of the context."""
        self.build(Schema({"x": 1, **dict.fromkeys(self._context(), 1)}))

    def _context(self) -> list[str]:
        """Return the names of the context of both equations."""
        generative, inference = self.equations()
        return [
            n
            for n in {**dict.fromkeys(generative.context), **dict.fromkeys(inference.context)}
            if n not in generative.variables
        ]
