"""Structured latent space of 4D motion: one static latent generates a motion segment with its timing.

    p(z) p(rotations_t | z, beta) p(translation_t | z, beta) p(time_t | z, beta)
    q(z | rotations_{1:T}, translation_{1:T}, time_{1:T})

Chi = rotations of the joints, translation of the root and time are T = 100 time-stamped frames of a segment
(`dvae.motion.TimedFrames`); beta is the shape of the body. Perceptrons read and predict all frames at once. The
published guide ignores beta, although the exact posterior depends on it. With `shaped`, our guide reads it:
q(z | rotations_{1:T}, translation_{1:T}, time_{1:T}, beta).

Training has two phases. The first minimises squared errors of rotations, translation and time. The second minimises
squared errors of the vertices of the surface and of time. In both, the weights of the errors adapt (`dvae.GradNorm`),
and the KL has its own weight.

Marsot, Wuhrer, Franco and Durocher, 2021, arXiv 2106.04387; there is no public code. Our choices where the paper gives
no detail:

* The widths of the layers, and one batch size for both phases.
* Likelihoods are normal; their scale replaces the unknown reduction of the squared errors relative to the KL.
* Weights adapt by the gradients of the last layer that all tasks share.
* GradNorm makes these gradients equal (asymmetry 0), because log-likelihoods have no zero as a reference for their
  decrease.

The learning rate of the second phase and its share of the steps suit short runs
(benchmarks/results/motion_latent_4d); the paper has 1e-4 and 200 of 5200 epochs.
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
from ...distributions import DistributionSpec, FixedNormal
from ...factorization.notation import Factorization
from ...inference.training.gradnorm import GradNorm
from ...inference.training.objectives import Evidence
from ...inference.training.options import Stage
from ...inference.training.recipe import Recipe
from ...motion.bodies import Body, reopen_body
from ...motion.segments.embodied import SHAPE, SegmentSchema, surfaces_of
from ...networks import NetworkSpec, WholeDecoder, WholeEncoder
from ...networks.base import share_modules
from ...options import Amount, Positive, Share, Size
from ...program.model import DynamicalVAE
from ...program.rollout import Rollout
from ..method import Method

ROTATIONS, TRANSLATION, TIME, SURFACE = "rotations", "translation", "time", "surface"
PARTS = (ROTATIONS, TRANSLATION, TIME)


@dataclass(frozen=True)
class MotionLatent(Method):
    """A structured latent space of 4D motion.

    Args:
        latent: size of z.
        widths: widths of the encoder's layers; the decoder has them in reverse order.
        shaped: whether the guide reads beta.
        kl: weight of the KL.
        scale: standard deviation of all numbers of chi.
        deviation: standard deviation of a vertex, in metres.
        finish: share of training in the second phase; 0 for the first phase alone, 1 for the second alone.
        finish_rate: learning rate of the second phase.
        pace: learning rate of the adaptive weights; 0 to keep them at 1.
    """

    name = "motion-latent"
    source = "Marsot, Wuhrer, Franco and Durocher, 2021, arXiv 2106.04387"
    generative = "p(z) p(rotations_t | z, beta) p(translation_t | z, beta) p(time_t | z, beta)"
    inference = "q(z | rotations_{1:T}, translation_{1:T}, time_{1:T})"
    fitted_on = "segments"
    exact: ClassVar[str] = "q(z | rotations_{1:T}, translation_{1:T}, time_{1:T}, beta)"

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
    def distributions(self) -> Mapping[str, DistributionSpec]:
        return {f"p({name})": FixedNormal(self.scale, project=False, error_weight=True) for name in PARTS}

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """Return the model for segments (`dvae.motion.Segments`).

        If the schema has only the sizes of its variables and a length, the model has no surface.
        """
        schema = Schema.of(data)
        sizes, length = {name: schema.size(name) for name in (*PARTS, SHAPE)}, schema.length or 100
        part_sizes = {name: sizes[name] for name in PARTS}
        networks: dict[str, NetworkSpec] = {"q(z)": WholeEncoder(length, self.widths)}
        for name in PARTS:
            networks[f"p({name})"] = WholeDecoder(length, self.widths[::-1], sizes=part_sizes, name=name)
        generative, inference = self.equations()
        model_arguments: dict[str, Any] = {
            "generative": generative,
            "inference": inference,
            "sizes": {**self.sizes(), **sizes},
        }
        model_arguments |= {"network": networks, "distributions": self.distributions()}
        model = (
            MotionLatentModel(self, schema, reopen_body(schema.body), **model_arguments)
            if isinstance(schema, SegmentSchema)
            else DynamicalVAE(**model_arguments, observed=PARTS)
        )
        share_modules([model.generator[name].network for name in PARTS], "trunk")
        return model

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Return two stages with adaptive weights: errors of chi, then of surface and time; omit empty stages."""
        second = round(self.finish * steps) if isinstance(Schema.of(train), SegmentSchema) else 0
        first = Evidence(kl_weight=self.kl, select="loss")
        others = replace(first, likelihood_weight=0.0, draws={"z": 1})
        phases = [(steps - second, PARTS, first, None), (second, (SURFACE, TIME), others, self.finish_rate)]
        stages = [
            Stage(n_steps, self._balance(tasks, objective), rate)
            for n_steps, tasks, objective, rate in phases
            if n_steps
        ]
        return Recipe(train, validation, stages)

    def _balance(self, tasks: tuple[str, ...], others: Evidence) -> GradNorm:
        last = 2 * len(self.widths) - 2  # each row of the next layer belongs to one task
        shared = f"generator.{ROTATIONS}.network.trunk.hidden.{last}."
        return GradNorm(tasks, shared, others, asymmetry=0.0, learning_rate=self.pace)


class MotionLatentModel(DynamicalVAE):
    """A model of segments on a body.

    Args:
        method: method with its options.
        schema: schema of the segments.
        body: body whose surface is compared.
        **options: arguments of `DynamicalVAE`.
    """

    def __init__(self, method: MotionLatent, schema: SegmentSchema, body: Body, **options: Any) -> None:
        super().__init__(view=schema.view, **options)
        self.method, self.timed, self.body = method, schema.timed, body

    def posterior(self, batch: Mapping[str, Any]) -> Any:
        """Return the guide's distribution of z (B, Z) given x (B, N, D) on bodies beta (B, S), with gradients."""
        return poutine.trace(self.guide).get_trace(batch).nodes["z"]["fn"]

    def encode(self, batch: Mapping[str, Any]) -> Tensor:
        """Return the mean (B, Z) of the posterior, with gradients."""
        return self.posterior(batch).mean  # type: ignore[no-any-return]

    def decode(self, latent: Tensor, shape: Tensor, frames: Tensor | None = None) -> Tensor:
        """Return decoded frames x (..., N, D), which are the means of chi, with gradients.

        Args:
            latent: z, (..., Z).
            shape: beta, shape parameters of the bodies, (..., S).
            frames: (K,), indices of the frames to compute; the result is then (..., K, D). Default: all.
        """
        return self.decoder(latent, shape)(frames)

    def decoder(self, latent: Tensor, shape: Tensor) -> Callable[..., Tensor]:
        """Return a function that decodes some frames; the computation that all frames share runs only once.

        Args:
            latent: z, (..., Z).
            shape: beta, shape parameters of the bodies, (..., S).

        Returns:
            Function of frame indices (K,), None for all, and optionally a slice of the coordinates. It returns frames
            as `decode` does.
        """
        network = self.generator[ROTATIONS].network
        parents = {"z": latent.flatten(0, -2), SHAPE: shape.flatten(0, -2)}
        # for all parts at once; the features of each part are its means (`MotionLatent.distributions`)
        features = network.trunk.features([parents[parent.name] for parent in network.inputs])

        def decode_frames(frames: Tensor | None = None, coordinates: slice = slice(None)) -> Tensor:
            values: Tensor = network.trunk.made(features, frames, coordinates)
            return values.unflatten(0, latent.shape[:-1])

        return decode_frames

    def vertices(self, x: Tensor, shape: Tensor) -> Tensor:
        """Return surfaces (..., N, V, 3) in metres, with gradients.

        Args:
            x: frames (..., N, D).
            shape: beta, shape parameters of the bodies, (..., S).
        """
        return surfaces_of(self.timed, self.body, x, shape)

    @override
    def penalties(self, rollout: Rollout, data: Mapping[str, Any], draws: Mapping[str, int]) -> dict[str, Tensor]:
        """Return the squared error of the surface, mean over vertices, / (2 deviation^2); empty without `draws`."""
        if not draws or not set(PARTS) <= data.keys():
            return {}
        predicted = self._unpack({name: rollout.parameters(name, rollout.values[name])[0] for name in PARTS})
        with torch.no_grad():
            target = self._unpack(data)
        error = self.body.squared_error(data[SHAPE], predicted, target).sum(-1)
        return {SURFACE: error / (2 * self.method.deviation**2)}

    def _unpack(self, parts: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return rotations (B, N, J, 3, 3) and translation (B, N, 3)."""
        x = self.view.inverse(Batch({name: parts[name] for name in PARTS}))[WHOLE]
        rotations, translation, _ = self.timed.unpack(x)
        return rotations, translation
