"""A structured latent space of 4D motion: whole segments of moving bodies, with their timing, from one static latent.

    p(z) p(turns_t | z, beta) p(place_t | z, beta) p(time_t | z, beta)
    q(z | turns_{1:T}, place_{1:T}, time_{1:T})

Chi = turns, place and time are T = 100 time-stamped frames of a segment (`dvae.motion.TimedFrames`), beta the shape of
the body. Perceptrons read and make all of it at once. The published guide does not see beta, which the exact posterior
does: with `shaped` ours does, q(z | turns_{1:T}, place_{1:T}, time_{1:T}, beta).

Training has two phases. The first minimises squared errors of turns, place and time, and the second those of the
surface's vertices and of time, each with weights that adapt (`dvae.GradNorm`), beside a KL with a weight of its own.

Marsot, Wuhrer, Franco and Durocher, 2021, arXiv 2106.04387; there is no public code. Ours, where the paper is silent:
widths of the layers, normal likelihoods whose scale stands for how squared errors are reduced beside the KL, one batch
size for both phases, the layer by whose gradients weights adapt, the last that all tasks share, and that all of these
become equal (asymmetry 0), as log-likelihoods have no zero against which their fall could be held. The second phase's
rate and share of the steps are chosen for short runs (docs/decisions.md): the paper has 1e-4, and 200 of 5200 epochs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from pyro import poutine
from torch import Tensor
from typing_extensions import override

from ...data.batch import WHOLE, Batch
from ...data.schema import Schema
from ...distributions import FixedNormal, LawSpec
from ...factorization.notation import Factorization
from ...inference.training.gradnorm import GradNorm
from ...inference.training.objectives import Evidence
from ...inference.training.options import Stage
from ...inference.training.recipe import Recipe
from ...motion.bodies import Body, human
from ...motion.segments.embodied import SHAPE, SegmentSchema, surfaces_of
from ...networks import NetworkSpec, WholeDecoder, WholeEncoder
from ...networks.base import share_modules
from ...options import Amount, Positive, Share, Size
from ...program.model import DynamicalVAE
from ...program.rollout import Rollout
from ..method import Method

TURNS, PLACE, TIME, SURFACE = "turns", "place", "time", "surface"
PARTS = (TURNS, PLACE, TIME)


@dataclass(frozen=True)
class MotionLatent(Method):
    """See the file.

    Args:
        latent: size of z.
        widths: of the encoder's layers; the decoder has them the other way round.
        shaped: the guide reads beta.
        kl: weight of the KL.
        scale: standard deviation of all numbers of chi.
        deviation: metres, that of a vertex.
        finish: share of training that is the second phase; 0 for the first alone, 1 for the second.
        finish_rate: its learning rate.
        pace: how fast adaptive weights move; 0 to leave them 1.
    """

    name = "motion-latent"
    source = "Marsot, Wuhrer, Franco and Durocher, 2021, arXiv 2106.04387"
    generative = "p(z) p(turns_t | z, beta) p(place_t | z, beta) p(time_t | z, beta)"
    inference = "q(z | turns_{1:T}, place_{1:T}, time_{1:T})"
    fitted_on = "segments"
    exact: ClassVar[str] = "q(z | turns_{1:T}, place_{1:T}, time_{1:T}, beta)"

    latent: Size = 64
    widths: tuple[Size, ...] = (256,)
    shaped: bool = False
    kl: Amount = 0.01
    scale: Positive = 0.1
    deviation: Positive = 0.05
    finish: Share = 0.4
    finish_rate: Positive = 3e-4
    pace: Share = 0.025

    @override
    def equations(self) -> tuple[Factorization, Factorization]:
        inference = self.exact if self.shaped else self.inference
        return Factorization.parse(self.generative), Factorization.parse(inference)

    @override
    def laws(self) -> Mapping[str, LawSpec]:
        return {f"p({name})": FixedNormal(self.scale, project=False, error_weight=True) for name in PARTS}

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """The model for segments (`dvae.motion.Segments`).

        Of a schema with the sizes of turns, place, time and beta, and a length, it is one without a surface.
        """
        schema = Schema.of(data)
        sizes, length = {name: schema.size(name) for name in (*PARTS, SHAPE)}, schema.length or 100
        made = {name: sizes[name] for name in PARTS}
        networks: dict[str, NetworkSpec] = {"q(z)": WholeEncoder(length, self.widths)}
        for name in PARTS:
            networks[f"p({name})"] = WholeDecoder(length, self.widths[::-1], sizes=made, name=name)
        generative, inference = self.equations()
        described: dict[str, Any] = {
            "generative": generative,
            "inference": inference,
            "sizes": {**self.sizes(), **sizes},
        }
        described |= {"network": networks, "laws": self.laws()}
        model = (
            MotionLatentModel(self, schema, human(), **described)
            if isinstance(schema, SegmentSchema)
            else DynamicalVAE(**described, observed=PARTS)
        )
        share_modules([model.generator[name].network for name in PARTS], "trunk")
        return model

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Two stages of adaptive weights: errors of chi, then of the surface and of time; those that have steps."""
        second = round(self.finish * steps) if isinstance(Schema.of(train), SegmentSchema) else 0
        first = Evidence(kl_weight=self.kl, select="loss")
        others = replace(first, likelihood_weight=0.0, draws={"z": 1})
        phases = [(steps - second, PARTS, first, None), (second, (SURFACE, TIME), others, self.finish_rate)]
        stages = [Stage(many, self._weighing(tasks, rest), rate) for many, tasks, rest, rate in phases if many]
        return Recipe(train, validation, stages)

    def _weighing(self, tasks: tuple[str, ...], others: Evidence) -> GradNorm:
        last = 2 * len(self.widths) - 2  # of the layer behind it every row is of one task
        shared = f"generator.{TURNS}.network.trunk.hidden.{last}."
        return GradNorm(tasks, shared, others, asymmetry=0.0, learning_rate=self.pace)


class MotionLatentModel(DynamicalVAE):
    """A model of segments on a body.

    Args:
        method: its options.
        schema: of the segments.
        body: whose surface they move.
        **options: of `DynamicalVAE`.
    """

    def __init__(self, method: MotionLatent, schema: SegmentSchema, body: Body, **options: Any) -> None:
        super().__init__(view=schema.view, **options)
        self.method, self.timed, self.body = method, schema.timed, body

    def posterior(self, batch: Mapping[str, Any]) -> Any:
        """The guide's law of z (B, Z), of x (B, N, D) on bodies beta (B, S), with gradients."""
        return poutine.trace(self.guide).get_trace(batch).nodes["z"]["fn"]

    def encode(self, batch: Mapping[str, Any]) -> Tensor:
        """The mean (B, Z) of that law, with gradients."""
        return self.posterior(batch).mean  # type: ignore[no-any-return]

    def decode(self, latent: Tensor, shape: Tensor, frames: Tensor | None = None) -> Tensor:
        """Frames x (..., N, D), the means of chi, of latents (..., Z) on bodies (..., S), with gradients.

        Where some frames (K,) are asked for, these alone are made, (..., K, D).
        """
        return self.decoder(latent, shape)(frames)

    def decoder(self, latent: Tensor, shape: Tensor) -> Callable[..., Tensor]:
        """What makes frames of latents (..., Z) on bodies (..., S), of which what frames share is computed once.

        Returns:
            A function of frames (K,), or None for all, and a slice of coordinates, all by default: see `decode`.
        """
        network = self.generator[TURNS].network
        given = {"z": latent.flatten(0, -2), SHAPE: shape.flatten(0, -2)}
        # of all parts at once, each of which has its features for means (`MotionLatent.laws`)
        features = network.trunk.features([given[parent.name] for parent in network.inputs])

        def made(frames: Tensor | None = None, coordinates: slice = slice(None)) -> Tensor:
            found: Tensor = network.trunk.made(features, frames, coordinates)
            return found.unflatten(0, latent.shape[:-1])

        return made

    def vertices(self, x: Tensor, shape: Tensor) -> Tensor:
        """Surfaces (..., N, V, 3) in metres of frames (..., N, D) on bodies (..., S), with gradients."""
        return surfaces_of(self.timed, self.body, x, shape)

    @override
    def penalties(self, rollout: Rollout, data: Mapping[str, Any], draws: Mapping[str, int]) -> dict[str, Tensor]:
        """The squared error of the surface, mean over vertices, in deviations; where an objective asks for draws."""
        if not draws or not set(PARTS) <= data.keys():
            return {}
        made = self._moved({name: rollout.parameters(name, rollout.values[name])[0] for name in PARTS})
        with torch.no_grad():
            theirs = self._moved(data)
        away = self.body.squared_error(data[SHAPE], made, theirs).sum(-1)
        return {SURFACE: away / (2 * self.method.deviation**2)}

    def _moved(self, parts: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Rotations (B, N, J, 3, 3) and translation (B, N, 3)."""
        whole = self.view.inverse(Batch({name: parts[name] for name in PARTS}))[WHOLE]
        rotations, place, _ = self.timed.unpack(whole)
        return rotations, place
