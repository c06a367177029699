"""Any pair of equations, as a method: the factorization is the user's, the networks are of one kind throughout."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from typing_extensions import override

from ...data.schema import Schema, SchemaError
from ...factorization.inversion import guide
from ...factorization.notation import Factorization
from ...networks import Attention, Dense, Linear, NetworkSpec, Recurrent
from ...options import Range, Size, nearest
from ...program.model import DynamicalVAE
from ...program.summed import LARGEST, Discrete
from ..method import LatentMethod


@dataclass(frozen=True)
class Equations(LatentMethod):
    """A model of its own equations.

    Args:
        generative: the model's factorization.
        inference: the guide's; "" of a model without latents.
        network: "recurrent", "attention", "dense" or "linear", for every factor.
        width: of the networks.
        latents: sizes of the latents, where they differ from `latent`.
        states: of discrete latents, which are summed out and have no factor in the guide: their numbers of states.
        grouped: static latents that the sequences of a group share, see `dvae.program.groups`.
    """

    name = "equations"
    source = "your own"

    # options here, where other methods have constants
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
                    f"{name} reads {lag[0][:20]} steps away; a lag is at most 999, or write {{<t}} for any"
                )

    @override
    def equations(self) -> tuple[Factorization, Factorization]:
        """The model and its guide, to which states are unknown."""
        generative = Factorization.parse(self.generative)
        return generative, guide(generative, self.inference, summed=self.states)

    @override
    def sizes(self) -> dict[str, int]:
        """Sizes of all variables; the data tell their own."""
        sizes = {name: self.latents.get(name, self.latent) for name in self.equations()[0].variables}
        return {**sizes, **{name: Discrete(states) for name, states in self.states.items()}}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """One kind for every factor."""
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
    def described(self, sizes: Mapping[str, int]) -> dict[str, Any]:
        """With what groups share."""
        return {**super().described(sizes), "grouped": self.grouped}

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """The model of these equations and no others; gradients flow through fed means.

        Raises:
            SchemaError: data without context that the equations read.
        """
        schema = Schema.of(data)
        if missing := [name for name in self._given() if name not in schema.sizes]:
            raise SchemaError(
                f"the equations read {', '.join(missing)}, which has no factor and comes from the data, but these have "
                f"{', '.join(schema.sizes)}; a table has covariates as c, attributes as s, and uneven steps as d"
            )
        return self.suited_to(schema, extended=False)

    @override
    def check(self) -> None:
        """Refuses options that do not fit together, whatever the sizes of the context will be."""
        self.build(Schema({"x": 1, **dict.fromkeys(self._given(), 1)}))

    def _given(self) -> list[str]:
        """Names of the context of both equations."""
        generative, inference = self.equations()
        return [
            n
            for n in {**dict.fromkeys(generative.context), **dict.fromkeys(inference.context)}
            if n not in generative.variables
        ]
