"""MoGlow with paths: motion from one pose along joint trajectories, with a normalising flow for each frame.

    p(x_t | x_{<t}, y_{<=t}, s)        no guide: the likelihood is exact

s is the first pose and y are the given trajectories, as in TrajeVAE, whose tables have this method as a baseline. A
frame reads the trajectories up to itself, not the future. The network predicts poses as offsets from s, and the flow
generates the change since the last frame. `dvae.models.baselines.moglow` describes the flow and our differences from
the paper.

Henter, Alexanderson and Beskow, 2020, arXiv 1905.06598, with the control signal of the port in TrajeVAE's public
implementation (Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351). That port gives every coupling an LSTM of its
own, and reads ten frames of poses and eleven of trajectories; here, one LSTM reads all of both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

from torch import Tensor
from typing_extensions import override

from ...data.batch import WHOLE, Batch
from ...data.views import View, Views
from ...distributions import ConditionalFlow, DistributionSpec
from ...inference.training.options import Training
from ...inference.training.recipe import Recipe
from ...motion import Windows
from ...networks import NetworkSpec, Recurrent
from ...options import Layers, Positive, Share, Size
from ..motion.trajectories import FIRST, TrajectoryMethod
from .moglow import FrameDropout, start_flow

ORIGIN = "origin"
"""Name that the view adds to a batch: the pose (B, D) from which x counts."""


@dataclass(frozen=True)
class MoGlowPaths(TrajectoryMethod):
    """A recurrent network with a normalising flow, conditioned on trajectories.

    Args:
        latent: always None; the method has no latents.
        width: width of the recurrent state.
        layers: layers of the recurrent network.
        flow_steps: number of steps of the flow.
        hidden: widths of the perceptron in each coupling.
        bound: bound of the logarithm of a coupling's factor.
        frame_dropout: probability that the network reads a pose of the past as 0, in training.
    """

    name = "moglow-paths"
    source = "Henter, Alexanderson and Beskow, 2020, arXiv 1905.06598"
    generative = "p(x_t | x_{<t}, y_{<=t}, s)"
    inference = ""
    trainings: ClassVar[Mapping[str, Training]] = {
        "human36m": Training(80_000, 64, 1e-4, gradient_clip=None),  # from the port in TrajeVAE's code
        "": Training(6000, 16, 1e-3, 0.5),
    }

    latent: None = None
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
    def extra_inputs(self) -> View:
        return Views(super().extra_inputs(), Offsets())

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return one recurrent network."""
        dropped = {WHOLE: FrameDropout(self.frame_dropout)} if self.frame_dropout else {}
        return {"p(x)": Recurrent(self.width, layers=self.layers, hidden=(), extract=dropped)}

    @override
    def distributions(self) -> Mapping[str, DistributionSpec]:
        """Return the flow of the change since the last frame."""
        return {"p(x)": ConditionalFlow(self.flow_steps, self.hidden, self.bound, residual=1.0)}

    @override
    def train(self, train: Windows, validation: Windows | None = None, steps: int = 2000) -> Recipe:
        """Return one stage on the likelihood; normalisations of the flow are initialised from training windows."""
        recipe = super().train(train, validation, steps)
        return replace(recipe, prepare=partial(start_flow, windows=recipe.batches))


@dataclass(frozen=True)
class Offsets(View):
    """A view that counts the poses x (B, T, D) from the last pose of a context variable.

    Args:
        source: name of the variable, (B, D), or (B, O D) for several poses.
    """

    source: str = FIRST
    names = (ORIGIN,)

    @override
    def __call__(self, data: Batch, view_inputs: Batch | None = None) -> Batch:
        origin = data.get(self.source) if view_inputs is None else view_inputs.get(ORIGIN)
        if ORIGIN in data or origin is None:
            return data
        moved = {WHOLE: data[WHOLE] - _last(origin, data[WHOLE])} if WHOLE in data else {}
        return data | moved | {ORIGIN: origin}

    @override
    def inverse(self, model_values: Batch) -> Batch:
        data = Batch(model_values)
        origin = data.pop(ORIGIN, None)
        if origin is None or WHOLE not in data:
            return data
        return data | {WHOLE: data[WHOLE] + _last(origin, data[WHOLE])}


def _last(poses: Tensor, like: Tensor) -> Tensor:
    """Return the last of poses (B, O D) as (B, 1, D), for values `like` (..., D)."""
    return poses[:, None, -like.shape[-1] :]
