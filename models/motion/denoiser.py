"""Denoiser: futures of a moving body by diffusion of all frames at once, in the frequency domain.

    p(x_{1:T} | h),  no latents and no guide

x are the poses after the last observed one, relative to it, and h the observed poses. A transformer denoises the lowest
sine coefficients of x over time, given h. `log_prob` is a bound (`distributions.Diffusion`), and forecasts are draws.

HumanMAC (Chen et al., 2023, arXiv 2302.03665) has the transformer on cosine coefficients with h as a condition. It
completes one sequence of past and future, omits high coefficients, and sets a cosine schedule. SkeletonDiffusion
(Curreli et al., 2025, arXiv 2501.06035) has noise with the covariance of the joints, in the latents of an autoencoder.
There are no layers or weights of either paper here. Ours:

* The location and scale of x are trained by the normal density: the location is a forecast from h, and the denoiser
  draws deviations from it. A shifted schedule has more times with little noise. High coefficients are normal, so that x
  has a density.
* Each coefficient is denoised in units of its own learned scale (`networks.Denoiser`).
* Sines in place of cosines (DST-VII), because x continues from 0.
* h enters by its code, by curves with coefficients from the code, and by the pose t steps before the last one.
* Drawn bones have their observed lengths.
* Windows are rotated so that the last observed pose faces one way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import torch
from torch import Tensor, nn
from typing_extensions import override

from ...data.batch import WHOLE
from ...data.schema import Schema
from ...data.views import Past, View, Views
from ...distributions import Diffusion, DistributionSpec
from ...inference.training.objectives import Evidence, Objective
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe
from ...motion import Heading, Skeleton
from ...motion.data.protocols import Poses
from ...motion.geometry.views import Bones
from ...networks import Denoiser, Input, NetworkSpec, SelfAttention
from ...networks.base import FixedLengthNetwork, perceptron
from ...networks.denoising import ragged_sine_basis
from ...networks.loop import memoize
from ...options import Amount, Count, Extra, Layers, Positive, Range, Size
from ...program.batch import AnyBatch
from ..baselines.moglow_paths import Offsets
from ..method import fit_units
from .futures import HISTORY, FutureMethod, FutureModel, LastState
from .poses import table

CURVE = 20
"""Number of sine coefficients of a curve in the features."""


@dataclass(frozen=True)
class MotionDenoiser(FutureMethod):
    """A diffusion model of futures.

    Args:
        latent, beta: always None; the method has no latents.
        join: always 0; a forecast is a draw, which has no mean pose.
        width: width of the transformer and of the code of h.
        heads_count, layers: attention heads and layers of the transformer.
        coefficients: number of sine coefficients that the transformer reads; 0 to denoise frames instead.
        sampler: "heun", "dpm", "ddim" or "ancestral", as in `Diffusion`.
        sampler_steps: number of steps of the sampler.
        drop: probability that training hides h, for guidance.
        guidance: weight of h in forecasts; above 1 needs `drop`, and forecasts no longer follow the density.
        min_scale: lower bound of the scale of x without a denoiser, for standardised poses.
        loss: "velocity", or "bound" with a learned schedule, as in `Diffusion`.
        shift: number added to the log signal-to-noise ratio of the cosine schedule of "velocity".
        code_dropout: probability that training sets an entry of the code of h to 0.
        bones: whether each bone of a drawn pose is scaled to its mean length in the observed poses. The bound is that
            of the draws without this step.
    """

    name = "denoiser"
    source = "Chen, Zhang, Li, Zhang, Zhang, Qiao, Zhang, Lu and Guo, 2023, arXiv 2302.03665"
    generative = "p(x_{1:T} | h)"
    inference = ""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = table(
        "heading", {"human36m": (False,), "humaneva": (False,), "": (True,)}
    )
    trainings: ClassVar[Mapping[str, Training]] = {"": Training(2000, 64, 3e-3, 0.5, gradient_clip=1.0)}

    latent: None = None
    beta: None = None
    width: Size = 128
    heads_count: Size = 4
    layers: Layers = 3
    coefficients: Extra = 20
    sampler: Literal["heun", "dpm", "ddim", "ancestral"] = "heun"
    sampler_steps: Count = 6
    drop: Annotated[float, Range(0, 1, below=True)] = 0.0
    guidance: Amount = 1.0
    min_scale: Positive = 0.001
    loss: Literal["velocity", "bound"] = "velocity"
    shift: float = 2.0
    code_dropout: Annotated[float, Range(0, 1, below=True)] = 0.1
    bones: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.join:
            raise ValueError(
                f"join is {self.join}, but {self.name} draws forecasts and has no means; leave `join` at 0"
            )
        if self.width % self.heads_count:
            raise ValueError(
                f"width must be a multiple of heads_count, got width={self.width} and heads_count={self.heads_count}"
            )

    @override
    def sizes(self) -> dict[str, int]:
        """Return no sizes: the method has no latents."""
        return {}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        return {"p(x)": MirroredPast(self.width, self.code_dropout)}

    @override
    def distributions(self) -> Mapping[str, DistributionSpec]:
        network = SelfAttention(self.width, self.heads_count, self.layers, positions="sinusoids")
        basis: Literal["sine"] | None = "sine" if self.coefficients else None
        return {
            "p(x)": Diffusion(
                denoiser=Denoiser(network, basis, self.coefficients or None),
                schedule="cosine" if self.loss == "velocity" else "learned",
                shift=self.shift if self.loss == "velocity" else 0.0,
                loss=self.loss,
                steps=self.sampler_steps,
                sampler=self.sampler,
                drop=self.drop,
                guidance=self.guidance,
                min_scale=self.min_scale,
            )
        }

    @override
    def build(self, data: Any) -> FutureModel:
        model: Any = super().build(data)
        if isinstance(schema := Schema.of(data), Poses):
            model.horizon = schema.frames - schema.protocol.observed
        return model  # type: ignore[no-any-return]

    @override
    def kind(self) -> type[FutureModel]:
        return MotionDenoiserModel

    @override
    def _build_model(self, size: int, frames: int, skeleton: Skeleton | None = None) -> FutureModel:
        views: list[View] = [Heading(skeleton, frames)] if skeleton and self.heading else []
        views += [Past(HISTORY, frames), *([Offsets(HISTORY)] if skeleton else [])]
        arguments = self.model_arguments({WHOLE: size, HISTORY: frames * size})
        model = self.kind()(self, frames, skeleton, view=Views(*views), **arguments)
        model.standardise(WHOLE)
        return model

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Return one stage that maximises the bound."""
        return Recipe(train, validation, [Stage(steps, self.objective())], prepare=partial(fit_units, train=train))

    @override
    def objective(self) -> Objective:
        return Evidence()


class MotionDenoiserModel(FutureModel):
    """A diffusion model of as many future frames as in training; shorter forecasts are the first frames of these."""

    method: MotionDenoiser
    horizon: int | None = None
    """T, number of future frames; None if unknown."""

    @torch.no_grad()
    @override
    def forecast(self, batch: AnyBatch, horizon: int, samples: int = 1, **options: Any) -> dict[str, Tensor]:
        """Forecast up to T frames.

        Raises:
            ValueError: if the batch has another number of observed frames, or the horizon is too long.
        """
        data, most = self.read(batch), horizon if self.horizon is None else self.horizon
        if WHOLE in data or not 1 <= horizon <= most:
            given = self.frames + (data[WHOLE].shape[1] if WHOLE in data else 0)
            raise ValueError(
                f"this model reads {self.frames} frames and predicts up to {most} more; got {given} frames and a "
                f"horizon of {horizon}"
            )
        draws = super().forecast(data, most, samples, **options)
        if self.method.bones and self.skeleton:
            observed = data[HISTORY].unflatten(-1, (self.frames, -1))
            draws[WHOLE] = Bones(self.skeleton).with_lengths(draws[WHOLE], observed)
        return {name: value[:, :, :horizon] for name, value in draws.items()}


@dataclass(frozen=True)
class MirroredPast:
    """Features of x_t: the pose t steps before the last one, relative to it, a code of the past, and curves of it.

    The curves are functions of t whose sine coefficients a perceptron reads from the code. The location of x, which is
    linear in the features, can therefore be a motion.

    Args:
        width: width of the code; there are half as many curves.
        dropout: probability that training sets an entry of the code to 0.
    """

    width: int
    dropout: float = 0.0

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> MirroredPastNetwork:
        """Return the network for a child of dimension `size`, local or static, with the parents `inputs`."""
        return MirroredPastNetwork(self, inputs, size)


class MirroredPastNetwork(FixedLengthNetwork):
    """Network of `MirroredPast`."""

    def __init__(self, spec: MirroredPast, inputs: Sequence[Input], size: int) -> None:
        curves = max(spec.width // 2, 1)
        super().__init__(inputs, True, size + spec.width + curves)
        self.past = LastState(size, spec.width)
        self.code = nn.Sequential(perceptron((spec.width + size, spec.width), "gelu"), nn.Dropout(spec.dropout))
        hidden = perceptron((spec.width, 2 * spec.width), "gelu")
        self.curves = nn.Sequential(hidden, nn.Linear(2 * spec.width, CURVE * curves), nn.Unflatten(-1, (CURVE, -1)))

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        poses = parents[HISTORY].unflatten(-1, (-1, self.past.size))
        last = poses[:, -1]
        before = (poses[:, :-1] - last[:, None]).flip(1)[:, :length]
        before = torch.nn.functional.pad(before, (0, 0, 0, length - before.shape[1]))
        code = memoize(self, [parents[HISTORY]], lambda: self.code(torch.cat([self.past(parents[HISTORY]), last], -1)))
        valid = code.new_full(code.shape[:1], length) if lengths is None else lengths
        basis = ragged_sine_basis(valid, length, code.dtype)[:, :CURVE]
        curves = basis.mT @ self.curves(code)[:, : basis.shape[1]]
        return torch.cat([before, code[:, None].expand(-1, length, -1), curves], -1)
