"""TrajeVAE: complete a motion from one pose and any number of joint trajectories, by cosine coefficients.

    p(z_k | y_{1:T}, s) p(x_t | z_{1:T}, s)        q(z_k | r_{1:T}, s)

k counts coefficients of the cosine transform, and t counts frames. Both are written as steps, because x has a
coefficient for each frame; high ones can be left out (`coefficients`). The prior is learned: a transformer of the
given trajectories y and the first pose s. The guide reads the remaining joints, r. The mean of x is s plus the
cumulative sum of offsets over time. The loss is

    sum_t |x_t - mean_t|^2 + .01 KL(q | p)

Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351, with the layers of its public implementation. Prior and guide
share the perceptrons of poses and two of three transformers; the decoder shares the perceptron of s. Scales of z use
softplus, whereas the public implementation has log-variances. On other data than the paper's, the defaults are small
networks, few coefficients, a smaller weight of the KL, and windows rotated to one heading (docs/results/trajevae.md).

The paper's ablation without the learned prior ("Base") is, in the public implementation,

    p(z_k) p(x_t | z_{1:T}, s)        q(z_k | y_{1:T}, s)

The guide reads only what is given at test time, and forecasts draw z from it (`prior="base"`). With
`prior="standard"`, which is ours, forecasts draw z from N(0, I), and the decoder reads the trajectories frame by frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from math import sqrt
from typing import Annotated, Any, Literal

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from ...distributions.base import ConditionalDistribution, DistributionSpec, Parameters, Shape
from ...distributions.families import FixedNormal, Normal, NormalModule
from ...factorization.notation import Factorization
from ...motion import Skeleton
from ...networks import CosineDecoder, CosineEncoder, NetworkSpec
from ...networks.base import share_modules
from ...options import Extra, Layers, Range, Size
from .poses import table
from .trajectories import LatentTrajectoryMethod

PRESETS = table(
    "latent beta components width feedforward layers dropout heading",
    {"human36m": (512, 0.01, 0, 256, 512, 2, 0.1, False), "": (32, 0.001, 15, 32, 128, 1, 0.0, True)},
)
"""Options by skeleton: the paper's values; for other skeletons, values that train in minutes on a CPU."""


@dataclass(frozen=True)
class TrajeVAE(LatentTrajectoryMethod):
    """The TrajeVAE. Options that are None are chosen for the skeleton.

    Args:
        latent: size of z, for each coefficient.
        components: number of low-frequency coefficients of z; 0 for as many as frames.
        width: features of a pose; the transformers have twice as many.
        feedforward: hidden units in the layers of the transformers.
        heads_count: number of attention heads.
        layers: layers of each transformer.
        dropout: share of units dropped in training.
        prior: "learned" for p(z_t | y_{1:T}, s); "base" for N(0, I), with a guide of y and s that also generates
            forecasts; "standard" for N(0, I), with a decoder that reads y.
        cosine: whether to use the cosine transform; otherwise z has one value for each frame.
    """

    name = "trajevae"
    source = "Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351"
    generative = "p(z_t | y_{1:T}, s) p(x_t | z_{1:T}, s)"
    inference = "q(z_t | r_{1:T}, s)"

    presets = PRESETS

    components: Extra | None = None
    width: Size | None = None
    feedforward: Size | None = None
    heads_count: Size = 4
    layers: Layers | None = None
    dropout: Annotated[float, Range(0, 1, below=True)] | None = None
    prior: Literal["learned", "base", "standard"] = "learned"
    cosine: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.width is not None and 2 * self.width % self.heads_count:
            raise ValueError(
                f"heads_count={self.heads_count} does not divide the transformers' {2 * self.width} features; choose "
                "`width` so that 2 * width is a multiple of heads_count"
            )
        if self.components and not self.cosine:
            raise ValueError(
                f"components is {self.components}, but cosine=False has no coefficients; leave components at 0"
            )

    @override
    def preset(self, skeleton: Skeleton) -> Mapping[str, Any]:
        """Return the preset; without the cosine transform it has no coefficients."""
        return {**super().preset(skeleton), **({} if self.cosine else {"components": 0})}

    @override
    def equations(self) -> tuple[Factorization, Factorization]:
        p, q = {
            "learned": (self.generative, self.inference),
            "base": ("p(z_t) p(x_t | z_{1:T}, s)", "q(z_t | y_{1:T}, s)"),
            "standard": ("p(z_t) p(x_t | z_{1:T}, y_{1:T}, s)", self.inference),
        }[self.prior]
        masks = {}
        if self.components:
            p = p.replace("z_{1:T}", "z_{1:C}")
            masks = {"1:C": partial(_slow, components=self.components)}
        return Factorization.parse(p, masks), Factorization.parse(q)

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return the transformers; the model ties their shared parts."""
        shared = ("width", "feedforward", "layers", "dropout", "cosine", "components")
        shape: dict[str, Any] = {"heads": self.heads_count, **{name: getattr(self, name) for name in shared}}
        encoder = CosineEncoder(**shape)
        networks: dict[str, NetworkSpec] = {"q(z)": encoder}
        if self.prior == "learned":
            networks["p(z)"] = encoder
        return {**networks, "p(x)": CosineDecoder(hidden=2 * shape["width"], **shape)}

    @override
    def distributions(self) -> Mapping[str, DistributionSpec]:
        """Return a normal distribution of poses and normal latents; no factor reads latents beyond `components`."""
        latent: DistributionSpec = SlowNormal(steps=self.components) if self.components else Normal()
        emission = FixedNormal(scale=sqrt(0.5), project=False, error_weight=True)
        return {"p(x)": emission, "q(z)": latent, **({"p(z)": latent} if self.prior == "learned" else {})}

    @override
    def _build_model(self, kind: Any, size: int, *arguments: Any) -> Any:
        model = super()._build_model(kind, size, *arguments)
        guide, decoder = model.encoder["z"].network, model.generator["x"].network
        share_modules([guide, decoder], "static")
        if self.prior == "learned":
            share_modules([guide, model.generator["z"].network], "over_time", "static", "before", "between")
        return model


def _slow(length: int, components: int) -> np.ndarray:
    """Return the mask of the coefficients that each frame reads: the first ones."""
    return np.arange(length)[None] < components


@dataclass(frozen=True)
class SlowNormal(Normal):
    """A `Normal` for the first steps of a local variable; later steps are N(0, I), whatever the features.

    Args:
        steps: number of first steps.
    """

    steps: int = 0

    @override
    def build(self, shape: Shape) -> ConditionalDistribution:
        return SlowNormalModule(self, shape)


class SlowNormalModule(NormalModule):
    """Distribution of `SlowNormal`."""

    def __init__(self, spec: SlowNormal, shape: Shape):
        super().__init__(spec, shape)
        self.steps = spec.steps

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        loc, scale = super().forward(features, previous, t)
        if t is not None:
            return (loc, scale) if t < self.steps else (torch.zeros_like(loc), torch.ones_like(scale))
        late = torch.arange(loc.shape[1], device=loc.device)[:, None] >= self.steps
        return loc.masked_fill(late, 0.0), scale.masked_fill(late, 1.0)
