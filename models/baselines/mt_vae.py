"""MT-VAE: futures of a moving body by a latent that encodes how the style of the motion changes.

    p(w) p(x_t | h, w)        q(w | x_{1:T}, h)

One recurrent network with layer norms embeds the observed poses h and the future x. An embedding has two halves,
content and style. LN is layer normalisation without gain:

    guide      w from LN(style of x - style of h)
    decoder    new style = LN(LN(T(LN(W w), style of h)) + style of h); the first state from [content of h, new style]

The decoder reads the new style at every step, and no pose. For J joints and D numbers of w, the loss is

    sum_t |x_t - mean_t| / J  +  a 5 sum_{t <= 8} |velocity_t - generated velocity_t| / J  +  a max(KL / D, .01)
      +  5 |w' - w''| / D,                                                              a = 1 - .99995^step

w' is a draw from the prior, and w'' a draw from the guide given the style that results from w'. The velocity term also
covers the future of w'. The first term is the density of a Laplace distribution of scale J / D metres. Relative to it,
the other terms have D times these weights, so that the weight of the KL is a.

Yan et al., 2018, arXiv 1808.04545, with the layers, weights and sizes of its public code. In that code, the decoder
reads no pose, the cycle compares styles instead of re-encoded poses, and velocities of both futures count. Our choices:

* Positions are in metres instead of the image plane, and a linear layer predicts them.
* The scale of w is parametrised as in other guides.
* a rises over a run as over the 60,000 steps of the code, and ends at .95.
* Sizes are smaller for other skeletons than Human3.6M's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import expm1
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional
from typing_extensions import override

from ...data.batch import WHOLE, Batch
from ...distributions import Family
from ...inference.training.objectives import Evidence
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe
from ...inference.training.schedules import Saturating
from ...networks import Input, Network, NetworkSpec
from ...networks.base import FixedLengthNetwork
from ...networks.loop import memoize
from ...networks.noise import Residual, half
from ...networks.recurrent import summary
from ...options import Amount, Size
from ...program.rollout import Rollout
from ..motion.futures import HISTORY, FutureMethod, FutureModel
from ..motion.poses import table

PRESETS = table(
    "latent width heading", {**dict.fromkeys(("human36m", "humaneva"), (512, 1024, False)), "": (64, 128, True)}
)
"""Options by skeleton: the values of the public code, and smaller values for other skeletons."""
FIRST = 8
"""Number of frames whose velocities enter the loss."""
STEEPNESS = 3.0
"""Steepness of the weights' rise: after 60,000 steps, 1 - .99995^step differs from 1 by e^{-3}."""


@dataclass(frozen=True)
class MTVAE(FutureMethod):
    """The motion transformation VAE. Options that are None are chosen for the skeleton.

    Args:
        latent: size of w.
        beta: limit of the rising weight of the KL; training ends at .95 of it.
        width: units of the recurrent networks and of embeddings; half of an embedding is style.
        velocity: weight of the error of the first velocities, relative to the error of positions; it rises like the
            weight of the KL.
        cycle: weight of the cycle from latent to style and back.
        floor: nats for each number of w, averaged over the batch, below which the KL is not penalised.
    """

    name = "mt-vae"
    source = "Yan et al., 2018, arXiv 1808.04545"
    generative = "p(w) p(x_t | h, w)"
    inference = "q(w | x_{1:T}, h)"
    presets = PRESETS
    trainings: ClassVar[Mapping[str, Training]] = {
        **dict.fromkeys(("human36m", "humaneva"), Training(60_000, 256, 1e-4, gradient_clip=None)),
        "": Training(decay=0.5),
    }

    latent: Size | None = None
    beta: Amount = 1.0
    width: Size | None = None
    velocity: Amount = 5.0
    cycle: Amount = 5.0
    floor: Amount = 0.01

    @override
    def sizes(self) -> dict[str, int]:
        return {"w": self.latent or 0}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        return {"q(w)": ChangeEncoder(self.width or 0), "p(x)": StyleDecoder(self.width or 0)}

    @override
    def model_arguments(self, sizes: Mapping[str, int]) -> dict[str, Any]:
        emission = Family("Laplace", {"scale": self.scale(sizes[WHOLE])}, error_weight=True)
        return {**super().model_arguments(sizes), "distributions": {"p(x)": emission}}

    def scale(self, size: int) -> float:
        """Return the scale, in metres, of the Laplace distribution of poses with `size` coordinates."""
        return size / 3 / (self.latent or 1)

    @override
    def kind(self) -> type[FutureModel]:
        return MTVAEModel

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Return one stage that minimises the loss of MT-VAE; the decoder does not read its own poses."""
        schema = self.poses(train)
        frames = schema.frames - schema.protocol.observed
        return Recipe(
            train,
            validation,
            [Stage(steps, self.resolve_defaults(schema).objective(steps, frames, schema.size(WHOLE)))],
        )

    @override
    def objective(self, steps: int = 60_000, frames: int = 64, size: int = 48) -> Evidence:
        """Return the objective for a number of steps, and futures of this many frames and coordinates."""

        def rise(weight: float) -> Saturating:
            return Saturating(0.0, -expm1(-STEEPNESS) * weight, steps, steepness=STEEPNESS)

        weights: dict[str, float | Saturating] = {"join": self.join, "cycle": self.cycle}
        weights["velocity"] = rise(self.velocity / self.scale(size))
        return Evidence(
            kl_weight=rise(self.beta),
            free_bits=self.floor * (self.latent or 1) / frames,
            energy_weights={name: weight for name, weight in weights.items() if getattr(self, name)},
            select="loss",
        )


class MTVAEModel(FutureModel):
    """The model of MT-VAE."""

    @override
    def penalties(self, rollout: Rollout, data: Batch, draws: Mapping[str, int]) -> dict[str, Tensor]:
        """Return errors of the first velocities for draws of guide and prior, and the cycle error of the prior."""
        penalties, method = super().penalties(rollout, data, draws), self.method
        assert isinstance(method, MTVAE)
        if WHOLE not in data or not (method.velocity or method.cycle):
            return penalties
        values, rows = rollout.values, rollout.batch
        other = torch.randn_like(values["w"])
        energies: dict[str, Tensor] = {}
        if method.velocity:
            length = min(FIRST, rollout.length)
            predicted = rollout.parameters(WHOLE, values[WHOLE])[0][:, :length]
            (from_prior,) = self.generator[WHOLE]({**rollout.known, "w": other}, rows, length)
            last, truth = values[HISTORY][:, None, -predicted.shape[-1] :], values[WHOLE][:, :length]
            velocities = [torch.cat([last, poses], 1).diff(dim=1) for poses in (predicted, from_prior, truth)]
            errors = (velocities[0] - velocities[2]).abs() + (velocities[1] - velocities[2]).abs()
            if (mask := rollout.mask(WHOLE)) is not None:
                both_observed = torch.cat([mask[:, :1], mask[:, 1:length] & mask[:, : length - 1]], 1)
                errors = torch.where(both_observed, errors, 0.0)
            energies["velocity"] = errors.sum((1, 2))
        if method.cycle:
            guide, network = self.encoder["w"], self.generator[WHOLE].network
            _, style = network.past(values[HISTORY])
            loc, scale = guide.head(guide.network.coded(network.changed(style, other) - style))
            energies["cycle"] = (other - torch.addcmul(loc, scale, torch.randn_like(loc))).abs().sum(-1)
        size = rows // rollout.draws
        return penalties | {name: energy.unflatten(0, (-1, size)).mean(0) for name, energy in energies.items()}


@dataclass(frozen=True)
class ChangeEncoder:
    """Features of w from the change of style between past and future.

    Args:
        width: width of the embeddings.
    """

    width: int

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> ChangeEncoderNetwork:
        """Return the network for a child of dimension `size`, local or static, with the parents `inputs`."""
        return ChangeEncoderNetwork(self, inputs)


class ChangeEncoderNetwork(Network):
    """Network of `ChangeEncoder`."""

    def __init__(self, spec: ChangeEncoder, inputs: Sequence[Input]) -> None:
        super().__init__(inputs, False, spec.width)
        size = next(parent.size for parent in inputs if parent.name == WHOLE)
        self.past = Embedding(size, spec.width)  # also embeds the future
        self.block = RectifiedResidual(half(spec.width), spec.width)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        """Return the features; padding at the end is not read."""
        return self.coded(self.past(parents[WHOLE], lengths)[1] - self.past(parents[HISTORY])[1])

    def coded(self, change: Tensor) -> Tensor:
        """Return features (B, W) of a change of style (B, S)."""
        return normed(self.block(normed(change)))


@dataclass(frozen=True)
class StyleDecoder:
    """Features of x_t: states of a recurrent network that starts from content and style, and reads the style.

    Args:
        width: width of the states.
    """

    width: int

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> StyleDecoderNetwork:
        """Return the network for a child of dimension `size`, local or static, with the parents `inputs`."""
        return StyleDecoderNetwork(self, inputs, size)


class StyleDecoderNetwork(FixedLengthNetwork):
    """Network of `StyleDecoder`."""

    def __init__(self, spec: StyleDecoder, inputs: Sequence[Input], size: int) -> None:
        super().__init__(inputs, True, spec.width)
        latent, style = next(parent.size for parent in inputs if parent.name == "w"), half(spec.width)
        self.past = Embedding(size, spec.width)
        self.read = nn.Linear(latent, style)
        self.block, self.out = RectifiedResidual(2 * style, style), nn.Linear(style, style)
        self.join = RectifiedResidual(spec.width, spec.width)
        self.hidden, self.cell = nn.Linear(spec.width, spec.width), nn.Linear(spec.width, spec.width)
        self.network = NormedLSTM(style, spec.width)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        content, style = self.past(parents[HISTORY])
        new_style = self.changed(style, parents["w"])
        embedding = normed(self.join(torch.cat([content, new_style], -1)))
        return self.network(
            [self.network.share(new_style)] * length, torch.tanh(self.hidden(embedding)), self.cell(embedding)
        )

    def changed(self, style: Tensor, w: Tensor) -> Tensor:
        """Return the new style (B, S), from the style of the past (B, S) and the latent w (B, D)."""
        inputs = torch.cat([normed(self.read(w)), style], -1)
        return normed(normed(self.out(normed(self.block(inputs)))) + style)


class Embedding(nn.Module):
    """Content (B, W - S) and style (B, S) of a motion, S = W / 2, from the last state of a recurrent network.

    Args:
        size: D, size of a pose.
        width: W, width of the embedding.
    """

    def __init__(self, size: int, width: int) -> None:
        super().__init__()
        self.size = size
        self.network, self.out = NormedLSTM(size, width), nn.Linear(width, width)

    def forward(self, poses: Tensor, lengths: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return content and style of poses (B, T, D), or flattened (B, T * D), up to `lengths` if given."""

        def compute() -> tuple[Tensor, Tensor]:
            shares = self.network.share(poses.reshape(len(poses), -1, self.size)).unbind(1)
            zero = poses.new_zeros(len(poses), self.out.in_features)
            last = summary(self.network(shares, zero, zero), 1, lengths)
            content, style = self.out(last).tensor_split([-half(self.out.out_features)], -1)
            return content, normed(style)

        return memoize(self, [poses, lengths], compute)


class NormedLSTM(nn.Module):
    """An LSTM whose cells and gates, each over its units, are layer-normalised (Ba et al., 2016, arXiv 1607.06450).

    Args:
        size: D, size of the input.
        width: W, width of the states.
    """

    def __init__(self, size: int, width: int) -> None:
        super().__init__()
        self.share, self.recurrent = nn.Linear(size, 4 * width, bias=False), nn.Linear(width, 4 * width, bias=False)
        self.gain, self.shift = nn.Parameter(torch.ones(4, width)), nn.Parameter(torch.zeros(4, width))
        nn.init.ones_(self.shift.data[1])  # the forget gate
        self.norm = nn.LayerNorm(width, eps=EPSILON)

    def forward(self, shares: Sequence[Tensor], hidden: Tensor, cell: Tensor) -> Tensor:
        """Return states (B, T, W).

        Args:
            shares: contribution of the input to the gates at each step, (B, 4 W).
            hidden, cell: first state, (B, W) each.
        """
        states, weight = [], self.recurrent.weight.t()
        for share in shares:
            gates = torch.addmm(share, hidden, weight).unflatten(-1, (4, -1))
            gates = torch.addcmul(self.shift, self.gain, functional.layer_norm(gates, gates.shape[-1:], eps=EPSILON))
            input_gate, forget_gate, output_gate = torch.sigmoid(gates[:, :3]).unbind(1)
            cell = forget_gate * cell + input_gate * torch.tanh(gates[:, 3])
            hidden = output_gate * torch.tanh(self.norm(cell))
            states.append(hidden)
        return torch.stack(states, 1)


EPSILON = 1e-3
"""Added to variances in `NormedLSTM`."""


class RectifiedResidual(Residual):
    """A residual block with ReLUs after both branches."""

    @override
    def forward(self, values: Tensor) -> Tensor:
        return functional.relu(self.short(values)) + functional.relu(self.long(values))


def normed(values: Tensor) -> Tensor:
    """Return (B, D) with mean 0 and variance 1 in each row."""
    return functional.layer_norm(values, values.shape[-1:])
