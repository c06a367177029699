"""Mix-and-Match: futures of a moving body, by noise that perturbs random indices of the code of its past.

h are the observed poses, x the poses that follow, and i indices that are drawn once for a batch:

    p(z) p(x_t | x_{<t}, h, z, i)        q(z | x_{1:T}, h, i)

Recurrent networks summarise past and future. The code of the past, perturbed by z at the drawn indices, is the initial
state of a recurrent decoder. The decoder starts at the last observed pose and predicts quaternions of all joints. The
option `noise` selects other ways to add the noise (`dvae.networks.noise`), with the same recurrent networks, losses and
representation:

    concatenate   p(z) p(x_t | x_{<t}, h, z)          q(z | x_{1:T}, h)
    add           p(z) p(x_t | x_{<t}, h, z)          q(z), the prior
    step          p(z_t) p(x_t | x_{<t}, h, z_t)      q(z_t | x_{<=t}, h)

Aliakbarian, Saleh, Salzmann, Petersson and Gould, 2020, arXiv 1908.00733, which cites the sources of the other ways.
There is no public code for motion. The paper's loss has means of squared errors and a KL of weight 1 (`kl`). Our
default is the ELBO at `scale` .01, where the KL weighs 2 scale^2 / (T D), 5e-8 for 60 frames of 16 quaternions. Our
choices where the paper gives no detail:

* The layers of the blocks and of the decoder of the code, whose output has the range of a state.
* The lengths of the schedules.

Quaternions are normalised to unit length when poses are returned, and fed back without normalisation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor, nn
from typing_extensions import override

from ...constants import constant
from ...data.batch import WHOLE, Batch
from ...data.schema import Schema
from ...data.views import Past, Views
from ...distributions import DistributionSpec, FixedNormal
from ...factorization.notation import Factorization
from ...inference.training.objectives import Evidence
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe
from ...inference.training.schedules import Logistic, Ramp
from ...motion.data.protocols import Poses
from ...motion.geometry.views import LENGTHS, Rotations
from ...networks import Input, Network, NetworkSpec
from ...networks.base import share_modules
from ...networks.cells import GRU
from ...networks.noise import AddProjected, Concatenate, MixAndMatch, Noise, Residual, half
from ...networks.recurrent import gru_cell
from ...options import Amount, Positive, Share, Size
from ...program.model import DynamicalVAE
from ...program.rollout import Rollout, ScheduledSampling
from ..baselines.pose_knows import FutureFilter
from .futures import HISTORY, LastState
from .poses import PoseMethod

INDICES = MixAndMatch.indices_name
EQUATIONS = {
    "concatenate": ("p(z) p(x_t | x_{<t}, h, z)", "q(z | x_{1:T}, h)"),
    "add": ("p(z) p(x_t | x_{<t}, h, z)", "q(z)"),
    "step": ("p(z_t) p(x_t | x_{<t}, h, z_t)", "q(z_t | x_{<=t}, h)"),
}
"""Equations of the ways to add noise other than "mix", by value of the option `noise`."""


@dataclass(frozen=True)
class MixAndMatchMotion(PoseMethod):
    """The Mix-and-Match model of human motion.

    Args:
        noise: way to add the noise: "mix" (Mix-and-Match), "concatenate" (MT-VAE), "add" (HP-GAN) or "step"
            (Pose-Knows).
        alpha: share of the code that "mix" perturbs; 0 for a deterministic model.
        width: L, units of recurrent networks and of the code; by default 1024 for Human3.6M's skeletons, as in the
            paper, and 128 for others.
        latent: size of z; by default floor((1 - alpha) L) with "mix", as in the paper, and L / 2 otherwise.
        scale: standard deviation of each coordinate of the quaternions, which sets the relative weight of the KL.
        kl: lambda of the paper's loss, L_rot + L_skl + lambda KL, with means of squared errors and the KL of a window;
            the paper has 1. Training then minimises this loss, in place of `scale`.
        skeleton: weight of the squared error of positions without the root's rotation, relative to the error of
            quaternions; both are means over coordinates.
        velocity: whether to predict the difference from the previous pose instead of the pose.
        curriculum: share of training over which the drawn indices change from the first ones to random ones; 0 for
            random indices from the start.
        annealing: share of training over which the weight of the KL rises to 1, by a logistic curve.
        feeding: final probability that a pose of the past is the model's own mean; it rises from 0 over nine tenths of
            training. The paper has 1.
    """

    name = "mix-and-match"
    source = "Aliakbarian, Saleh, Salzmann, Petersson and Gould, 2020, arXiv 1908.00733"
    generative = "p(z) p(x_t | x_{<t}, h, z, i)"
    inference = "q(z | x_{1:T}, h, i)"
    representation: ClassVar[str] = "quaternion"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "human36m": {"width": 1024},
        "human36m-angles": {"width": 1024},
        "": {"width": 128},
    }
    trainings: ClassVar[Mapping[str, Training]] = {
        **dict.fromkeys(("human36m", "human36m-angles"), Training(100_000, 64, 1e-3)),
        "": Training(1000, 32, 2e-3, 0.5),
    }

    noise: Literal["mix", "concatenate", "add", "step"] = "mix"
    alpha: Share = 0.5
    width: Size | None = None
    latent: Size | None = None
    scale: Positive = 0.01
    kl: Positive | None = None
    skeleton: Amount = 1.0
    velocity: bool = False
    curriculum: Share = 0.5
    annealing: Share = 0.5
    feeding: Share = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, default in (("alpha", 0.5), ("curriculum", 0.5)):
            if self.noise != "mix" and (value := getattr(self, name)) != default:
                raise ValueError(
                    f"{name} is {value}, but noise={self.noise!r} draws no indices; leave {name} at its default or use "
                    "noise='mix'"
                )
        if self.kl is not None and self.scale != 0.01:
            raise ValueError(
                f"scale is {self.scale} and kl is {self.kl}, but both set the weight of the KL; give only one of them"
            )

    def _with_scale(self, size: int) -> Self:
        """Return the method with scale = sqrt(D / 2) if `kl` is set: the log-likelihood then has the mean error."""
        return self if self.kl is None else replace(self, kl=None, scale=math.sqrt(size / 2))

    @override
    def equations(self) -> tuple[Factorization, Factorization]:
        generative, inference = map(Factorization.parse, EQUATIONS.get(self.noise, (self.generative, self.inference)))
        return generative, inference

    def entering(self) -> Noise | None:
        """Return how the noise enters the code; None if each step has its own noise."""
        kinds: dict[str, Noise] = {"mix": MixAndMatch(self.alpha), "concatenate": Concatenate(), "add": AddProjected()}
        return kinds.get(self.noise)

    @override
    def sizes(self) -> dict[str, int]:
        width, noise = self.width or 0, self.entering()
        latent = self.latent or (half(width) if noise is None else noise.latent(width))
        return {"z": latent, **({INDICES: width} if self.noise == "mix" else {})}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        noise, width = self.entering(), self.width or 0
        guide = {} if self.noise == "add" else {"q(z)": FutureEncoder(width, noise)}
        return {**guide, "p(x)": FutureDecoder(width, noise, self.velocity)}

    @override
    def distributions(self) -> Mapping[str, DistributionSpec]:
        return {"p(x)": FixedNormal(self.scale, project=False, error_weight=True)}

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """Return the model for windows of quaternions.

        If `data` only gives sizes, the batches of the model contain x and two observed frames h, which have the size of
        x.

        Raises:
            SchemaError: if the windows have another representation.
        """
        schema = Schema.of(data)
        if not isinstance(schema, Poses):
            return self.with_presets(self.presets[""])._build_model(DynamicalVAE, schema.size(WHOLE), 2)
        schema = Poses.of(schema, self.name, self.representation)
        method = self.resolve_defaults(schema)._with_scale(schema.size(WHOLE))
        return method._build_model(MixAndMatchModel, schema.size(WHOLE), schema.protocol.observed, method, schema)

    def _build_model(self, kind: Any, size: int, frames: int, *arguments: Any) -> Any:
        model_arguments = self.model_arguments({WHOLE: size, HISTORY: frames * size})
        shared = {INDICES: MixAndMatch(self.alpha).indices} if self.noise == "mix" else {}
        model_arguments |= {"inference": None} if self.noise == "add" else {}
        model = kind(*arguments, **model_arguments, shared=shared)
        if self.noise != "add":
            share_modules([model.encoder["z"].network, model.generator[WHOLE].network], "past")
        model.feeding = ScheduledSampling(0.0)
        return model

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Return one stage on squared errors of quaternions and positions and the KL, with scheduled sampling."""
        size = Schema.of(train).size(WHOLE)
        scale, weight = self._with_scale(size).scale, 1.0
        if self.kl is not None:  # of the KL per frame
            schema = Poses.of(train, self.name, self.representation)
            weight = self.kl * (schema.frames - schema.protocol.observed)
        objective = Evidence(
            kl_weight=Logistic(0.0, weight, steps=max(int(self.annealing * steps), 1)) if self.annealing else weight,
            energy_weights={"skeleton": self.skeleton * size / (2 * scale**2)} if self.skeleton else {},
            select="loss",
        )
        gradual = self.noise == "mix" and self.curriculum
        swaps = Ramp(0.0, 1.0, steps=max(int(self.curriculum * steps), 1)) if gradual else None
        feeding = Ramp(0.0, self.feeding, steps=max(9 * steps // 10, 1)) if self.feeding else 0.0
        return Recipe(train, validation, [Stage(steps, objective, curriculum=swaps)], feeding)


class MixAndMatchModel(DynamicalVAE):
    """A model of quaternions that also learns from positions.

    Args:
        method: method whose options are all resolved.
        schema: schema of the windows.
        **options: arguments of `DynamicalVAE`.
    """

    def __init__(self, method: MixAndMatchMotion, schema: Poses, **options: Any) -> None:
        assert isinstance(schema.view, Rotations)
        super().__init__(view=Views(schema.view, Past(HISTORY, schema.protocol.observed)), **options)
        self.method, self.rotations = method, schema.view

    @override
    def penalties(self, rollout: Rollout, data: Mapping[str, Any], draws: Mapping[str, int]) -> dict[str, Tensor]:
        """Return the squared error of positions, mean over their numbers, if the data contain the future."""
        if not self.method.skeleton or WHOLE not in data or LENGTHS not in data:
            return {}
        value = rollout.values[WHOLE]
        predicted = rollout.parameters(WHOLE, value)[0]
        with torch.no_grad():
            target = _unrotated_positions(value, data[LENGTHS], self.rotations)
        positions = _unrotated_positions(predicted, data[LENGTHS], self.rotations)
        return {"skeleton": (positions - target).square().mean(-1).sum(-1)}


def _unrotated_positions(quaternions: Tensor, lengths: Tensor, view: Rotations) -> Tensor:
    """Return positions (B, T, 3 J') of poses, with the root at the origin and without the root's rotation.

    Args:
        quaternions: poses (B, T, D), quaternions of the joints after the root's position, if there is one.
        lengths: bone lengths of the bodies, as in batches.
        view: conversion between quaternions and positions.
    """
    root, start = view.turning.index(view.skeleton.root), 3 * view.root
    identity = constant((1.0, 0.0, 0.0, 0.0), quaternions).expand(*quaternions.shape[:-1], 4)
    first = torch.zeros_like(quaternions[..., :start])
    rotations = quaternions[..., start:].unflatten(-1, (-1, 4))
    rotations = torch.cat([rotations[..., :root, :], identity[..., None, :], rotations[..., root + 1 :, :]], -2)
    x = torch.cat([first, rotations.flatten(-2)], -1)
    positions: Tensor = view.inverse(Batch({WHOLE: x, LENGTHS: lengths}))[WHOLE]
    return positions


@dataclass(frozen=True)
class FutureEncoder:
    """Features of z from the codes of past and future, or of z_t from a network that starts at the code of the past.

    Args:
        width: L, number of units.
        noise: how the noise enters; None if each step has its own noise.
    """

    width: int
    noise: Noise | None

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> Network:
        """Return the network for a child of dimension `size`, local or static, with the parents `inputs`."""
        return FutureFilter(self.width).build(inputs, local, size) if local else FutureEncoderNetwork(self, inputs)


class FutureEncoderNetwork(Network):
    """Network of `FutureEncoder` for one latent for all steps."""

    def __init__(self, spec: FutureEncoder, inputs: Sequence[Input]) -> None:
        super().__init__(inputs, False, spec.width)
        size = next(parent.size for parent in inputs if parent.name == WHOLE)
        self.past = LastState(size, spec.width)
        self.future = LastState(size, spec.width)
        assert spec.noise is not None
        self.noise: Any = spec.noise.encoder(spec.width)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        future = self.future(parents[WHOLE], lengths)
        features: Tensor = self.noise(self.past(parents[HISTORY]), future, parents.get(INDICES))
        return features


@dataclass(frozen=True)
class FutureDecoder:
    """Poses after the past, from states of a recurrent network that reads the previous pose.

    Args:
        width: L, number of units.
        noise: how the noise enters the first state; None if each step has its own noise, which joins the state.
        velocity: whether to add the output to the previous pose.
    """

    width: int
    noise: Noise | None
    velocity: bool

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> FutureDecoderNetwork:
        """Return the network for a child of dimension `size`, local or static, with the parents `inputs`."""
        return FutureDecoderNetwork(self, inputs, size)


class FutureDecoderNetwork(Network):
    """Network of `FutureDecoder`."""

    def __init__(self, spec: FutureDecoder, inputs: Sequence[Input], size: int) -> None:
        super().__init__(inputs, True, size)
        latent = next(parent.size for parent in inputs if parent.name == "z")
        self.velocity = spec.velocity
        self.past = LastState(size, spec.width)
        self.noise = None if spec.noise is None else spec.noise.decoder(spec.width, latent)
        self.cell: Any = GRU(size, spec.width, batch_first=True)
        self.join = Residual(spec.width + latent, spec.width) if spec.noise is None else None
        self.out = nn.Linear(spec.width, size)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        before = torch.cat([self._last(parents)[:, None], parents[WHOLE][:, : length - 1]], 1)
        states = self.cell(before, self.code(parents)[None].contiguous())[0]
        return self._pose(states, parents["z"], before)

    @property
    def entrance(self) -> nn.Module:
        """The module through which the noise enters, with output (B, L).

        Its output is the first state, or the features of each step that poses are computed from.
        """
        module: Any = self.noise if self.join is None else self.join
        return module

    def code(self, parents: Mapping[str, Tensor]) -> Tensor:
        """Return the first state (B, L)."""
        code = self.past(parents[HISTORY])
        if self.noise is None:
            return code
        state: Tensor = self.noise(code, parents["z"], parents.get(INDICES))
        return state

    def _last(self, parents: Mapping[str, Tensor]) -> Tensor:
        """Return the last pose of the past (B, D)."""
        return parents[HISTORY][:, -self.features :]

    def _pose(self, state: Tensor, z: Tensor, before: Tensor) -> Tensor:
        if self.join is not None:
            state = self.join(torch.cat([state, z], -1))
        output: Tensor = self.out(state)
        return output + before if self.velocity else output

    @override
    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        return self.code(parents), parents["z"], parents.get(WHOLE), self._last(parents)

    @override
    def step(self, state: Any, t: int, samples: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        hidden, z, observed, first = state
        before = first if t == 0 else samples[WHOLE][t - 1] if observed is None else observed[:, t - 1]
        gates = torch.nn.functional.linear(before, self.cell.weight_ih_l0, self.cell.bias_ih_l0)
        hidden = gru_cell(gates, (hidden, hidden), self.cell)[0]
        return self._pose(hidden, z if z.dim() == 2 else z[:, t], before), (hidden, z, observed, first)
