"""MoGlow: the likelihood of a recurrent network whose law of x_t is a normalising flow that reads the past.

    p(x_t | x_{<t})        no guide: the likelihood is exact

    x_t = r x_{t-1} + m(h_t) + s(h_t) f_1^-1(... f_K^-1(e_t; h_t) ...; h_t),    e_t ~ N(0, I),    h_t = LSTM(x_{<t})

Each f_k is a step of Glow: a normalisation, a mixing by triangular matrices, and an affine coupling that reads half of
its input and h_t (`dvae.distributions.glow`). In training the density of all frames is computed at once; only draws
loop over time. In training the network reads whole frames of the past as 0 (`frame_dropout`), lest it merely repeats
them.

Henter, Alexanderson and Beskow, 2020, arXiv 1905.06598. `PAPER` has its sizes. Ours where it could not be followed, or
not as well:

* One recurrent network for all couplings, which are perceptrons. In the paper each coupling has an LSTM of its own,
  beside the last ten frames. Its states follow what the coupling reads of every frame, also of one that is dropped: a
  dropped frame is lost to ours, and the rates of .95 (the paper's locomotion) and .7 (with paths, as a baseline of
  TrajeVAE: Kania et al., 2021) leave ours little of the past. The default is none.
* There is no control signal; covariates of a table are read as by other methods.
* Location and scale before the flow read h_t too, and the location keeps a share of x_{t-1} (`residual`). In the paper
  couplings alone read the past, and a frame is a pose; the baseline of TrajeVAE adds what it draws to the last pose.
* A coupling multiplies by no more than exp(`bound`) and no less than exp(-bound), in the paper by
  sigmoid(k + 2) + 1e-6. Draws divide by it: with a bound of 2 one in nine left the data and never returned
  (bandai2's tuning split, docs/results/tuning.md).
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
from ...data.sequences import bridged
from ...distributions import FAMILIES, ConditionalFlow, LawSpec, Product
from ...distributions.conditional_flow import ConditionalFlowLaw
from ...distributions.product import ProductLaw
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
    """See the file.

    Args:
        latent: there is none.
        emission: there is none but the flow; of a table it makes the columns of the family "real".
        residual: share of x_{t-1} that the location of x_t keeps.
        width: of the recurrent state.
        layers: of the recurrent network.
        flow_steps: K.
        hidden: widths of the perceptron in each coupling.
        bound: of the logarithm of what a coupling multiplies by.
        frame_dropout: probability with which the network reads a frame of the past as 0, in training.
    """

    name = "moglow"
    source = "Henter, Alexanderson and Beskow, 2020, arXiv 1905.06598"
    generative = "p(x_t | x_{<t})"
    inference = ""
    trainings: ClassVar[Mapping[str, Training]] = {
        "human36m": Training(80_000, 64, 1e-4),  # of the port in TrajeVAE's code
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
        """No latents."""
        return {}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """One recurrent network."""
        dropped = {WHOLE: FrameDropout(self.frame_dropout)} if self.frame_dropout else {}
        return {"default": Recurrent(self.width, layers=self.layers, hidden=(), extract=dropped)}

    @override
    def laws(self) -> Mapping[str, LawSpec]:
        """The flow."""
        return {"p(x)": ConditionalFlow(self.flow_steps, self.hidden, self.bound, residual=self.residual)}

    @override
    def of_columns(self, law: LawSpec) -> LawSpec:
        """The flow of all columns of the family "real", and of others their own law.

        Raises:
            ValueError: there is none of that family.
        """
        parts = law.parts if isinstance(law, Product) else [((), law)]
        if all(own != FAMILIES["real"] for _, own in parts):
            raise ValueError(
                'moglow is a flow of columns of the family "real", and there is none among the targets; fit '
                "autoregressive, which has the same factor, or tell columns another family"
            )
        flow = self.laws()["p(x)"]
        if not isinstance(law, Product):
            return flow
        return Product(tuple((places, flow if own == FAMILIES["real"] else own) for places, own in parts))

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """The model, which reads and makes x without unit."""
        model = super().build(data)
        if not Schema.of(data).units:
            model.standardise(WHOLE)
        return model

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """One stage on the likelihood; units and normalisations start at the training data."""
        return replace(super().train(train, validation, steps), prepare=partial(start_flow, windows=train))


def start_flow(model: DynamicalVAE, windows: Any) -> None:
    """Takes the unit of x from 256 windows, and starts flows at them (`ConditionalFlowLaw.start_at`)."""
    batch, units, law = windows.sample(256, torch.default_generator), model.units[WHOLE], model.generator[WHOLE].law
    if not units.scale.dim():  # those of columns are known
        exact = model.read(batch, precise=True)
        units.fit(bridged(exact[WHOLE], exact.mask()))
    data = model.read(batch)
    x = data[WHOLE]
    run = model.rollout(data)
    with torch.no_grad():
        parameters = run.parameters(WHOLE, x)
    mask, centred = run.mask(WHOLE), model.generator[WHOLE].centred(x)
    parts = law.each(parameters) if isinstance(law, ProductLaw) else [(law, list(range(x.shape[-1])), parameters)]
    for part, places, own in parts:
        if isinstance(part, ConditionalFlowLaw):
            seen = torch.ones(x.shape[:2], dtype=torch.bool) if mask is None else mask
            rows = seen[..., places].all(-1) if seen.dim() == 3 else seen
            part.start_at(tuple(p[rows] for p in own), centred[..., places][rows])


@dataclass(frozen=True)
class FrameDropout:
    """Frames that a network reads as 0 in training, each as a whole; the others stay as they are, in number too.

    Args:
        probability: of each frame.
    """

    probability: Share

    def build(self, size: int) -> DroppedFrames:
        """The module for frames of this size."""
        return DroppedFrames(self.probability, size)


class DroppedFrames(nn.Module):
    """What `FrameDropout` describes."""

    def __init__(self, probability: float, features: int):
        super().__init__()
        self.probability, self.features = probability, features

    def forward(self, frames: Tensor) -> Tensor:
        """(..., D) of (..., D)."""
        if not self.training:
            return frames
        return frames * (torch.rand_like(frames[..., :1]) >= self.probability)
