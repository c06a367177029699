"""What methods share that make futures of a body from the poses observed of it.

    h_{1:O} the observed poses, x_{1:T} those that follow

Their programs are of the future alone, given the past (`dvae.views.Past`): a forecast, which knows no future, has its
latents from the prior. Poses are positions relative to the pelvis, in metres. The likelihood is the squared error of
the papers, beside which the KL has the weight beta, and decoders read what they have made, in training too.

Ours: windows may be turned so that the last observed pose faces one way, which helps on small sets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional
from typing_extensions import override

from ..inference.objectives import Evidence, Objective
from ..inference.recipe import Recipe
from ..inference.training import Stage
from ..laws import FixedNormal, LawSpec
from ..motion import HUMAN36M, Heading, Skeleton, energies
from ..motion.protocols import Poses
from ..networks import Input, Network
from ..networks.base import once, perceptron
from ..networks.recurrent import gru_cell
from ..options import Amount, Size
from ..program.model import DynamicalVAE
from ..program.rollout import Rollout, SelfFeeding
from ..schema import Schema
from ..views import WHOLE, Past, View, Views
from .poses import PoseMethod

HISTORY = "h"


@dataclass(frozen=True)
class FutureMethod(PoseMethod):
    """A method that makes futures.

    Args:
        latent: size of the latent.
        beta: weight of the KL, beside squared errors in square metres.
        join: weight of the squared distance from the last observed pose to the first one that is made.
        heading: turn every window so that its last observed pose faces one way, and the futures back. None for not with
            Human3.6M's poses, as in the papers, and for so with others whose left and right are known.
    """

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {HUMAN36M.name: {"heading": False}, "": {"heading": True}}

    latent: Size | None = 128
    beta: Amount = 0.1
    join: Amount = 0.0
    heading: bool | None = None

    @override
    def preset(self, skeleton: Skeleton) -> Mapping[str, Any]:
        """Where left and right are unknown, so are headings."""
        found = super().preset(skeleton)
        return found if skeleton.left and skeleton.right else {**found, "heading": False}

    @override
    def laws(self) -> Mapping[str, LawSpec]:
        """x is normal with variance 1/2, minus whose log-density is the squared error."""
        return {"p(x)": FixedNormal(scale=sqrt(0.5))}

    @override
    def build(self, data: Any) -> FutureModel:
        """The model for windows of poses relative to the pelvis.

        Of sizes alone it is one whose batches hold h, two frames of the size of x, beside x.

        Raises:
            ValueError: poses with a root.
        """
        schema = Schema.of(data)
        method, size, frames = self.filled(self.presets[HUMAN36M.name]), schema.size(WHOLE), 2
        views: list[View] = []
        if isinstance(schema, Poses):
            schema = self.poses(schema)
            method, frames = self.suited(schema), schema.protocol.observed
            views = [Heading(schema.skeleton, frames)] if method.heading else []
            views += [Past(HISTORY, frames)]
        return method._built(size, frames, Views(*views))

    def _built(self, size: int, frames: int, view: View) -> FutureModel:
        model = FutureModel(self, view=view, **self.described({WHOLE: size, HISTORY: frames * size}))
        model.feeding = SelfFeeding(1.0, gradient=True)
        return model

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Minimises squared errors and the weighted KL; the best weights are those of the lowest loss."""
        return Recipe(train, validation, [Stage(steps, self.objective())], 1.0)

    def objective(self) -> Objective:
        """What training minimises."""
        return Evidence(kl_weight=self.beta, energy_weights={"join": self.join} if self.join else {}, select="loss")


class FutureModel(DynamicalVAE):
    """A model of futures given the past.

    Args:
        method: with no option left open.
        **options: of `DynamicalVAE`.
    """

    def __init__(self, method: FutureMethod, **options: Any) -> None:
        super().__init__(**options)
        self.method = method

    @override
    def penalties(self, rollout: Rollout, data: Mapping[str, Any], draws: Mapping[str, int]) -> dict[str, Tensor]:
        """How far the first pose is from the last observed one; and the best of several draws from what happened."""
        if WHOLE not in data or not (self.method.join or draws):
            return {}
        x, size = rollout.values[WHOLE], rollout.batch // rollout.draws
        made = rollout.parameters(WHOLE, x)[0].unflatten(0, (-1, size))
        found = {"reconstruction": energies.best_of_many(made, x[:size])} if draws else {}
        if self.method.join:
            steps = made[:, :, 0] - data[HISTORY][:size, -x.shape[-1] :]
            found["join"] = steps.square().sum(-1).mean(0)
        return found


class FedBackNetwork(Network):
    """Features of x_t: states of a recurrent network over what is known at t and x_{t-1}, and a perceptron on them.

    Args:
        inputs: parents of x.
        known: numbers that are known at each step, beside x_{t-1}.
        size: D.
        width: of the states.
        hidden: widths of the perceptron.
    """

    def __init__(self, inputs: Sequence[Input], known: int, size: int, width: int, hidden: Sequence[int]) -> None:
        super().__init__(inputs, True, (width, *hidden)[-1])
        self.share = known
        self.cell: Any = nn.GRU(known + size, width, batch_first=True)
        self.behind = perceptron((width, *hidden), "tanh")

    def known(self, parents: Mapping[str, Tensor], length: int) -> tuple[Tensor, Tensor, Tensor]:
        """What is known at each step (B, T, known), the pose before the first (B, D), and the first state (B, W)."""
        raise NotImplementedError

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        """No sequence is padded."""
        self.refuse_ragged(lengths)
        known, first, state = self.known(parents, length)
        before = torch.cat([first[:, None], parents[WHOLE][:, : length - 1]], 1)
        made: Tensor = self.behind(self.cell(torch.cat([known, before], -1), state[None].contiguous())[0])
        return made

    @override
    def start(self, given: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        self.refuse_ragged(lengths)
        known, first, state = self.known(given, length)
        weight, bias = self.cell.weight_ih_l0[:, : self.share], self.cell.bias_ih_l0
        return functional.linear(known, weight, bias).unbind(1), first, given.get(WHOLE), state

    @override
    def step(self, state: Any, t: int, drawn: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        shares, first, given, hidden = state
        before = first if t == 0 else drawn[WHOLE][t - 1] if given is None else given[:, t - 1]
        gates = torch.addmm(shares[t], before, self.cell.weight_ih_l0[:, self.share :].t())
        hidden = gru_cell(gates, (hidden, hidden), self.cell)[0]
        return self.behind(hidden), (shares, first, given, hidden)


class LastState(nn.Module):
    """The last state (B, W) of a recurrent network over poses.

    Args:
        size: D.
        width: W.
    """

    def __init__(self, size: int, width: int) -> None:
        super().__init__()
        self.size = size
        self.network = nn.GRU(size, width, batch_first=True)

    def forward(self, poses: Tensor) -> Tensor:
        """Of (B, T, D), or of (B, T D), frame after frame."""
        return once(self, [poses], lambda: self.network(poses.reshape(len(poses), -1, self.size))[1][0])
