"""Base of the methods that predict futures of a body from its observed poses.

    h_{1:O} the observed poses, x_{1:T} the poses that follow

The programs model only the future, given the past (`dvae.data.views.Past`): a forecast, which knows no future, draws
its latents from the prior. Poses are positions relative to the pelvis, in metres. The likelihood is the squared error
of the papers, and the KL has the weight beta. Decoders read their own output, in training too.

Our addition: windows may be rotated so that the last observed pose faces one way, which helps on small data sets.
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

from ...data.batch import WHOLE, Batch
from ...data.schema import Schema
from ...data.views import Past, Views
from ...distributions import DistributionSpec, FixedNormal
from ...inference.training.objectives import Evidence, Objective
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe
from ...motion import HUMAN36M, HUMANEVA, Heading, Skeleton
from ...motion.data.protocols import Poses
from ...motion.scoring import energies
from ...networks import Input, Network
from ...networks.base import perceptron, share_modules
from ...networks.cells import GRU
from ...networks.loop import memoize
from ...networks.recurrent import gru_cell
from ...options import Amount, Size
from ...program.batch import AnyBatch
from ...program.model import DynamicalVAE
from ...program.rollout import Rollout, ScheduledSampling
from .poses import PoseMethod, table, without_gaps

HISTORY = "h"


@dataclass(frozen=True)
class FutureMethod(PoseMethod):
    """A method that predicts futures.

    Args:
        latent: size of the latent.
        beta: weight of the KL, relative to squared errors in square metres. By default the papers' value for
            Human3.6M or HumanEva; other poses use that for Human3.6M.
        join: weight of the squared distance between the last observed pose and the first predicted one.
        heading: whether to rotate every window so that its last observed pose faces one way, and rotate the futures
            back. By default off for Human3.6M and HumanEva, and on for other skeletons with known left and right.
    """

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = table(
        "beta heading", {HUMAN36M.name: (0.1, False), HUMANEVA.name: (0.01, False), "": (0.1, True)}
    )

    trainings: ClassVar[Mapping[str, Training]] = {
        HUMAN36M.name: Training(39_063, 64, 1e-3, 0.8, gradient_clip=None),
        HUMANEVA.name: Training(7813, 64, 1e-3, 0.8, gradient_clip=None),
        "": Training(learning_rate=3e-3, decay=0.5),
    }

    latent: Size | None = 128
    beta: Amount | None = None
    join: Amount = 0.0
    heading: bool | None = None

    @override
    def distributions(self) -> Mapping[str, DistributionSpec]:
        """Return a normal distribution of x with variance 1/2, whose negative log-density is the squared error."""
        return {"p(x)": FixedNormal(scale=sqrt(0.5), error_weight=True)}

    @override
    def build(self, data: Any) -> FutureModel:
        """Return the model for windows of poses relative to the pelvis.

        If `data` only gives sizes, the batches of the model contain x and two observed frames h, which have the size of
        x.

        Raises:
            ValueError: if the poses have a root.
        """
        schema = Schema.of(data)
        if not isinstance(schema, Poses):
            return self.with_presets(self.presets[HUMAN36M.name])._build_model(schema.size(WHOLE), 2)
        schema = self.poses(schema)
        method, observed = self.resolve_defaults(schema), schema.protocol.observed
        return method._build_model(schema.size(WHOLE), observed, schema.skeleton)

    def kind(self) -> type[FutureModel]:
        """Return the class of the model."""
        return FutureModel

    def _build_model(self, size: int, frames: int, skeleton: Skeleton | None = None) -> FutureModel:
        views = [Heading(skeleton, frames)] if skeleton and self.heading else []
        arguments = self.model_arguments({WHOLE: size, HISTORY: frames * size})
        model = self.kind()(self, frames, skeleton, view=Views(*views, Past(HISTORY, frames)), **arguments)
        networks = [side[name].network for side in (model.encoder, model.generator) for name in side]
        share_modules([network for network in networks if hasattr(network, "past")], "past")
        model.feeding = ScheduledSampling(1.0, gradient=True)
        return model

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Return one stage that minimises squared errors and the weighted KL; the best weights have the lowest loss."""
        return Recipe(train, validation, [Stage(steps, self.resolve_defaults(train).objective())], 1.0)

    def objective(self) -> Objective:
        """Return the objective of training."""
        assert self.beta is not None  # set by resolve_defaults
        return Evidence(kl_weight=self.beta, energy_weights={"join": self.join} if self.join else {}, select="loss")


class FutureModel(DynamicalVAE):
    """A model of futures given the past.

    Args:
        method: method whose options are all resolved.
        frames: O, number of observed frames.
        skeleton: skeleton of the poses; None if unknown.
        **options: arguments of `DynamicalVAE`.
    """

    def __init__(self, method: FutureMethod, frames: int, skeleton: Skeleton | None, **options: Any) -> None:
        super().__init__(**options)
        self.method, self.frames, self.skeleton = method, frames, skeleton

    @override
    def read(self, batch: AnyBatch | None, **options: Any) -> Batch:
        """Return the batch, with missing entries of observed frames filled in by `without_gaps`."""
        if (
            self.skeleton
            and isinstance(batch, Mapping)
            and HISTORY not in batch
            and (mask := Batch(batch).mask()) is not None
        ):
            x, (past_mask, future_mask) = torch.as_tensor(batch[WHOLE]), mask.tensor_split([self.frames], 1)
            past = without_gaps(self.skeleton, x[:, : self.frames], past_mask)
            complete = torch.cat([past, x[:, self.frames :]], 1)
            batch = Batch(batch) | {WHOLE: complete, "mask": torch.cat([torch.ones_like(past_mask), future_mask], 1)}
        return super().read(batch, **options)

    @override
    def penalties(self, rollout: Rollout, data: Batch, draws: Mapping[str, int]) -> dict[str, Tensor]:
        """Return the distance of the first pose from the last observed one, and the error of the best draw."""
        if WHOLE not in data or not (self.method.join or draws):
            return {}
        size = rollout.batch // rollout.draws
        futures = rollout.parameters(WHOLE, rollout.values[WHOLE])[0].unflatten(0, (-1, size))
        truth = data[WHOLE][:size]
        if (mask := data.mask()) is not None:
            truth = torch.where(mask[:size], truth, torch.nan)
        penalties = {"reconstruction": energies.best_of_many(futures, truth)} if draws else {}
        if self.method.join:
            steps = futures[:, :, 0] - data[HISTORY][:size, -truth.shape[-1] :]
            penalties["join"] = steps.square().sum(-1).mean(0)
        return penalties


class FedBackNetwork(Network):
    """Features of x_t: states of a recurrent network over x_{t-1} and the inputs known at t, and a perceptron on them.

    Args:
        inputs: parents of x.
        known_size: number of inputs known at each step, without x_{t-1}.
        size: D, size of x.
        width: width of the states.
        hidden: widths of the perceptron.
        local_latent: name and size of a local latent, which the perceptron reads together with the state of its step.
    """

    def __init__(
        self,
        inputs: Sequence[Input],
        known_size: int,
        size: int,
        width: int,
        hidden: Sequence[int],
        local_latent: tuple[str, int] | None = None,
    ) -> None:
        super().__init__(inputs, True, (width, *hidden)[-1])
        self.share, (self.local_latent, latent) = known_size, local_latent or ("", 0)
        self.cell: Any = GRU(known_size + size, width, batch_first=True)
        self.behind = perceptron((width + latent, *hidden), "tanh")

    def known(self, parents: Mapping[str, Tensor], length: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return the inputs known at each step, the pose before the first (B, D), and the first state (B, W).

        The inputs are (B, T, known_size), or (B, 1, known_size) if they are the same at all steps.

        Args:
            parents: values of the parents by name.
            length: T.
        """
        raise NotImplementedError

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        """Return the features of all steps; padding at the end does not affect the steps before it."""
        inputs, first, state = self.known(parents, length)
        before = torch.cat([first[:, None], parents[WHOLE][:, : length - 1]], 1)
        states = self.cell(torch.cat([inputs.expand(-1, length, -1), before], -1), state[None].contiguous())[0]
        features: Tensor = self.behind(
            torch.cat([states, parents[self.local_latent]], -1) if self.local_latent else states
        )
        return features

    @override
    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        inputs, first, state = self.known(parents, length)
        weight, bias = self.cell.weight_ih_l0[:, : self.share], self.cell.bias_ih_l0
        latents = parents[self.local_latent].unbind(1) if self.local_latent in parents else None
        shares = functional.linear(inputs, weight, bias).expand(-1, length, -1)
        return shares.unbind(1), first, parents.get(WHOLE), latents, state

    @override
    def step(self, state: Any, t: int, samples: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        shares, first, observed, latents, hidden = state
        before = first if t == 0 else samples[WHOLE][t - 1] if observed is None else observed[:, t - 1]
        gates = torch.addmm(shares[t], before, self.cell.weight_ih_l0[:, self.share :].t())
        hidden = gru_cell(gates, (hidden, hidden), self.cell)[0]
        inputs = hidden
        if self.local_latent:
            inputs = torch.cat([hidden, samples[self.local_latent][t] if latents is None else latents[t]], -1)
        return self.behind(inputs), (shares, first, observed, latents, hidden)


class LastState(nn.Module):
    """The last state (B, W) of a recurrent network over poses.

    Args:
        size: D, size of a pose.
        width: W, width of the state.
    """

    def __init__(self, size: int, width: int) -> None:
        super().__init__()
        self.size = size
        self.network = GRU(size, width, batch_first=True)

    def forward(self, poses: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Return the last state for poses (B, T, D), or (B, T D) frame by frame, at `lengths` if given."""

        def last() -> Tensor:
            states, final = self.network(poses.reshape(len(poses), -1, self.size))
            if lengths is None:
                return final[0]
            state: Tensor = states.take_along_dim((lengths - 1)[:, None, None], 1)[:, 0]
            return state

        return memoize(self, [poses] if lengths is None else [poses, lengths], last)
