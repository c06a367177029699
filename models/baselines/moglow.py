"""MoGlow: a recurrent network whose distribution of x_t is a normalising flow conditioned on the past.

    p(x_t | x_{<t})        no guide: the likelihood is exact

    x_t = r x_{t-1} + m(h_t) + s(h_t) f_1^-1(... f_K^-1(e_t; h_t) ...; h_t),    e_t ~ N(0, I),    h_t = LSTM(x_{<t})

Each f_k is a step of Glow: a normalisation, a mixing by triangular matrices, and an affine coupling that reads half of
its input and h_t (`dvae.distributions.glow`). In training the density of all frames is computed at once; only draws
loop over time. With `frame_dropout`, the network reads random frames of the past as 0 in training, which keeps
it from merely repeating them.

Henter, Alexanderson and Beskow, 2020, arXiv 1905.06598. `PAPER` has its sizes. Our differences, where the paper's
choices were not applicable or worked less well:

* One recurrent network serves all couplings, which are perceptrons. In the paper each coupling has its own LSTM, and
  also reads the last ten frames. The states of these LSTMs depend on the coupling's input at every frame, even a
  dropped one; in our network a dropped frame is lost. Dropout rates of .95 (locomotion in the paper) and .7 (the
  baseline in TrajeVAE's tables: Kania et al., 2021) would therefore leave little of the past. The default is no
  dropout.
* There is no control signal; covariates of a table are read as in other methods.
* Location and scale before the flow also read h_t, and the location keeps a share of x_{t-1} (`residual`). In the paper
  only couplings read the past, and the flow returns the pose, not its change. The baseline of TrajeVAE adds its draw
  to the last pose.
* A coupling multiplies by a factor between exp(-`bound`) and exp(`bound`), in the paper by sigmoid(k + 2) + 1e-6. Draws
  divide by this factor. With a bound of 2, one in nine draws left the range of the data and never returned (bandai2's
  tuning split, benchmarks/results/tuning).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from typing_extensions import override

from ...data.batch import WHOLE
from ...data.schema import Schema
from ...data.sequences import as_source, interpolate_missing
from ...distributions import FAMILIES, ConditionalFlow, DistributionSpec, Product
from ...distributions.conditional_flow import ConditionalFlowModule
from ...distributions.product import ProductModule
from ...inference.training.options import Training
from ...inference.training.recipe import Recipe
from ...networks import NetworkSpec, Recurrent
from ...options import Layers, Positive, Share, Size
from ...program.model import DynamicalVAE
from ..method import LikelihoodMethod

PAPER: Mapping[str, Any] = {"flow_steps": 16, "width": 512, "layers": 2, "hidden": (512,)}
"""The paper's number of steps, and the width and the layers of its recurrent networks."""


@dataclass(frozen=True)
class MoGlow(LikelihoodMethod):
    """A recurrent network with a normalising flow.

    Args:
        latent: always None; the method has no latents.
        emission: always None; x follows the flow. In a table, the flow models the columns of the family "real".
        residual: share of x_{t-1} that the location of x_t keeps.
        width: width of the recurrent state.
        layers: layers of the recurrent network.
        flow_steps: K, number of steps of the flow.
        hidden: widths of the perceptron in each coupling.
        bound: bound of the logarithm of a coupling's factor.
        frame_dropout: probability that the network reads a frame of the past as 0, in training.
    """

    name = "moglow"
    source = "Henter, Alexanderson and Beskow, 2020, arXiv 1905.06598"
    generative = "p(x_t | x_{<t})"
    inference = ""
    trainings: ClassVar[Mapping[str, Training]] = {
        "human36m": Training(80_000, 64, 1e-4, gradient_clip=None),  # from the port in TrajeVAE's code
        **LikelihoodMethod.trainings,
    }

    latent: None = None
    emission: None = None
    residual: Share = 1.0
    width: Size = 128
    layers: Layers = 1
    flow_steps: Layers = 8
    hidden: tuple[Size, ...] = (128,)
    bound: Positive = 1.0
    frame_dropout: Share = 0.0

    @override
    def sizes(self) -> dict[str, int]:
        """Return no sizes: the method has no latents."""
        return {}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return one recurrent network."""
        dropped = {WHOLE: FrameDropout(self.frame_dropout)} if self.frame_dropout else {}
        return {"default": Recurrent(self.width, layers=self.layers, hidden=(), extract=dropped)}

    @override
    def distributions(self) -> Mapping[str, DistributionSpec]:
        """Return the flow."""
        return {"p(x)": ConditionalFlow(self.flow_steps, self.hidden, self.bound, residual=self.residual)}

    @override
    def of_columns(self, distribution: DistributionSpec) -> DistributionSpec:
        """Return the flow for columns of the family "real", and the columns' own distribution for others.

        Raises:
            ValueError: if no column has the family "real".
        """
        parts = distribution.parts if isinstance(distribution, Product) else [((), distribution)]
        if all(part != FAMILIES["real"] for _, part in parts):
            raise ValueError(
                'moglow is a flow of columns of the family "real", but no target has it; give a target '
                "this family, or fit autoregressive, which takes every family"
            )
        flow = self.distributions()["p(x)"]
        if not isinstance(distribution, Product):
            return flow
        return Product(tuple((columns, flow if part == FAMILIES["real"] else part) for columns, part in parts))

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """Return the model, which reads and predicts standardised x."""
        model = super().build(data)
        if not Schema.of(data).units:
            model.standardise(WHOLE)
        return model

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Return one stage on the likelihood; units and normalisations are initialised from the training data."""
        return replace(super().train(train, validation, steps), prepare=partial(start_flow, windows=train))


def start_flow(model: DynamicalVAE, windows: Any) -> None:
    """Fit the unit of x, if any, to 256 windows, and initialise flows with them (`ConditionalFlowModule.start_at`)."""
    batch = as_source(windows).sample(256, torch.default_generator)
    distribution = model.generator[WHOLE].head
    if WHOLE in model.units and not model.units[WHOLE].scale.dim():  # units of columns are known
        exact = model.read(batch, precise=True)
        model.units[WHOLE].fit(interpolate_missing(exact[WHOLE], exact.mask()))
    data = model.read(batch)
    x = data[WHOLE]
    run = model.rollout(data)
    with torch.no_grad():
        parameters = run.parameters(WHOLE, x)
    mask, centred = run.mask(WHOLE), model.generator[WHOLE].centred(x)
    parts = (
        distribution.split(parameters)
        if isinstance(distribution, ProductModule)
        else [(distribution, list(range(x.shape[-1])), parameters)]
    )
    for part, columns, part_parameters in parts:
        if isinstance(part, ConditionalFlowModule):
            observed = torch.ones(x.shape[:2], dtype=torch.bool) if mask is None else mask
            rows = observed[..., columns].all(-1) if observed.dim() == 3 else observed
            part.start_at(tuple(p[rows] for p in part_parameters), centred[..., columns][rows])


@dataclass(frozen=True)
class FrameDropout:
    """Dropout of whole frames: a network reads them as 0 in training; other frames are unchanged and not rescaled.

    Args:
        probability: probability of dropping a frame.
    """

    probability: Share

    def build(self, size: int) -> DroppedFrames:
        """Return the module for frames of this size."""
        return DroppedFrames(self.probability, size)


class DroppedFrames(nn.Module):
    """Module of `FrameDropout`."""

    def __init__(self, probability: float, features: int):
        super().__init__()
        self.probability, self.features = probability, features

    def forward(self, frames: Tensor) -> Tensor:
        """Return frames (..., D) with dropout."""
        if not self.training:
            return frames
        return frames * (torch.rand_like(frames[..., :1]) >= self.probability)
