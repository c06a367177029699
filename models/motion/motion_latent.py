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

Marsot, Wuhrer, Franco and Durocher, 2021, arXiv 2106.04387; there is no public code. The option `published` trains as
the paper: 5,000 epochs of the first phase with batches of 256 and a learning rate of 1e-3, then 200 epochs with 16 and
1e-4; squared errors are summed over joints, vertices and frames, and their weights adapt to the decrease of each error.
The paper does not give, and we choose:

* The widths of the layers, here one layer of 256.
* The reduction over a batch, here the mean. Within a segment, the paper's squared norms are sums.
* The asymmetry of GradNorm, here 0.12 as in its own paper, the learning rate of the weights, and the layer whose
  gradients they balance, here the last one that all tasks share.

Two choices differ from the paper: it calls its term the squared KL divergence, and we use the KL; and the weights of
the errors change by the update of `dvae.GradNorm` in log w.

Without `published`, training suits short runs (benchmarks/results/motion_latent_4d): normal likelihoods, whose scales
replace the reduction; weights that equalise gradients (asymmetry 0); and one batch size for both phases.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import log, pi, sqrt
from typing import Annotated, Any, ClassVar, Self

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
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe
from ...motion.bodies import Body, reopen_body
from ...motion.segments.embodied import SHAPE, SegmentSchema, surfaces_of
from ...networks import NetworkSpec, WholeDecoder, WholeEncoder
from ...networks.base import share_modules
from ...options import Amount, Positive, Range, Share, Size
from ...program.model import DynamicalVAE
from ...program.rollout import Rollout
from ..method import Method

ROTATIONS, TRANSLATION, TIME, SURFACE = "rotations", "translation", "time", "surface"
PARTS = (ROTATIONS, TRANSLATION, TIME)

EPOCHS = 5000 * 52, 200 * 821
"""Steps of the two phases in the paper: epochs times batches of 256 and 16 that its 13,121 segments take."""
PRESETS: dict[str, dict[str, Any]] = {
    "published": {
        **{"scale": 0.5**0.5, "deviation": (2 * 6890) ** -0.5, "asymmetry": 0.12},
        **{"finish": EPOCHS[1] / sum(EPOCHS), "finish_rate": 1e-4, "finish_batch": 16},
    },
    "": {"scale": 0.1, "deviation": 0.05, "asymmetry": 0.0, "finish": 0.4, "finish_rate": 3e-4},
}
"""Defaults as in the paper, and for short runs."""


@dataclass(frozen=True)
class MotionLatent(Method):
    """A structured latent space of 4D motion.

    Args:
        latent: size of z.
        widths: widths of the encoder's layers; the decoder has them in reverse order.
        shaped: whether the guide reads beta.
        kl: weight of the KL. At the default, the posteriors of segments fill too little of N(0, I) to generate motion
            from it. At 1, they fill it after 100,000 steps, and at 10 after 20,000, but reconstruction errors are twice
            as large (docs/results/motion_latent_4d.md).
        published: train as in the paper, with its number of steps for 13,121 segments. This changes the defaults of the
            options below.
        scale: standard deviation of all numbers of chi; None, here and below, for the default. The published value
            makes the negative log density the sum of squared errors.
        deviation: standard deviation of a vertex, in metres. The published value makes the energy the sum of squared
            errors of the 6,890 vertices of SMPL, for a body with any number of vertices.
        finish: share of training in the second phase; 0 for the first phase alone, 1 for the second alone.
        finish_rate: learning rate of the second phase.
        finish_batch: batch size of the second phase; None for the batch size of the first if not `published`.
        asymmetry: how strongly the adaptive weights favour errors that decrease slowly, as in `dvae.GradNorm`; at 0,
            gradients are equalised. Errors are then log densities, otherwise squared errors.
        pace: learning rate of the adaptive weights; 0 to keep them at 1.
    """

    name = "motion-latent"
    source = "Marsot, Wuhrer, Franco and Durocher, 2021, arXiv 2106.04387"
    generative = "p(z) p(rotations_t | z, beta) p(translation_t | z, beta) p(time_t | z, beta)"
    inference = "q(z | rotations_{1:T}, translation_{1:T}, time_{1:T})"
    fitted_on = "segments"
    presets = PRESETS
    trainings: ClassVar[Mapping[str, Training]] = {
        "published": Training(sum(EPOCHS), 256, 1e-3, gradient_clip=None),
        "": Training(decay=0.5),
    }
    exact: ClassVar[str] = "q(z | rotations_{1:T}, translation_{1:T}, time_{1:T}, beta)"

    latent: Size = 64
    widths: tuple[Size, ...] = (256,)
    shaped: bool = False
    kl: Amount = 0.01
    published: bool = False
    scale: Positive | None = None
    deviation: Positive | None = None
    finish: Share | None = None
    finish_rate: Positive | None = None
    finish_batch: Size | None = None
    asymmetry: Annotated[float, Range(0, 10)] | None = None
    pace: Share = 0.025

    @override
    def resolve_defaults(self, data: Any) -> Self:
        preset = self.presets["published" if self.published else ""]
        return replace(self, **{name: value for name, value in preset.items() if getattr(self, name) is None})

    @override
    def training(self, data: Any) -> Training:
        return self.trainings["published" if self.published else ""]

    @override
    def equations(self) -> tuple[Factorization, Factorization]:
        inference = self.exact if self.shaped else self.inference
        return Factorization.parse(self.generative), Factorization.parse(inference)

    @override
    def distributions(self) -> Mapping[str, DistributionSpec]:
        scale = self.resolve_defaults(None).scale
        assert scale is not None
        return {f"p({name})": FixedNormal(scale, project=False, error_weight=True) for name in PARTS}

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
            MotionLatentModel(self.resolve_defaults(data), schema, reopen_body(schema.body), **model_arguments)
            if isinstance(schema, SegmentSchema)
            else DynamicalVAE(**model_arguments, observed=PARTS)
        )
        share_modules([model.generator[name].network for name in PARTS], "trunk")
        return model

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Return two stages with adaptive weights: errors of chi, then of surface and time; omit empty stages."""
        method, schema = self.resolve_defaults(train), Schema.of(train)
        assert method.finish is not None
        second = round(method.finish * steps) if isinstance(schema, SegmentSchema) else 0
        first = Evidence(kl_weight=self.kl, select="loss")
        others = replace(first, likelihood_weight=0.0, draws={"z": 1})
        stages = [
            Stage(steps - second, method._balance(PARTS, schema, first)) if second < steps else None,
            Stage(
                second,
                method._balance((SURFACE, TIME), schema, others),
                method.finish_rate,
                batch_size=method.finish_batch,
            )
            if second
            else None,
        ]
        return Recipe(train, validation, [stage for stage in stages if stage is not None])

    def _balance(self, tasks: tuple[str, ...], schema: Schema, others: Evidence) -> GradNorm:
        """Return the objective with adaptive weights of these errors."""
        assert self.scale is not None
        assert self.asymmetry is not None
        last = 2 * len(self.widths) - 2  # each row of the next layer belongs to one task
        shared = f"generator.{ROTATIONS}.network.trunk.hidden.{last}."
        lowest = {name: schema.size(name) * log(self.scale * sqrt(2 * pi)) for name in tasks if name in PARTS}
        asymmetric: dict[str, Any] = {"asymmetry": self.asymmetry, "lowest": lowest if self.asymmetry else {}}
        return GradNorm(tasks, shared, others, learning_rate=self.pace, **asymmetric)


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
        assert self.method.deviation is not None
        return {SURFACE: error / (2 * self.method.deviation**2)}

    def _unpack(self, parts: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return rotations (B, N, J, 3, 3) and translation (B, N, 3)."""
        x = self.view.inverse(Batch({name: parts[name] for name in PARTS}))[WHOLE]
        rotations, translation, _ = self.timed.unpack(x)
        return rotations, translation
