"""Kalman variational autoencoder: a linear-Gaussian chain z behind encoded frames a, integrated out exactly.

In the paper's model, a_0 is learned, and the matrices are mixtures A_t = sum_k alpha_{t,k} A^(k), likewise B_t and C_t:

    p(z_t | z_{t-1}, a_{<t}) = N(A_t z_{t-1} + B_t a_{t-1}, Q)        p(a_t | z_t, a_{<t}) = N(C_t z_t, R)
    p(x_t | a_t)        alpha_t = softmax(linear(LSTM(a_0, ..., a_{t-1})))        p(z_1) = N(0, 20 I)

    q(a_t | x_t)        q(z_{1:T} | a_{1:T}) = p(z_{1:T} | a_{1:T})

The guide of z is the exact posterior given a. The bound is therefore unchanged if z is integrated out, and the program
is the resulting pair:

    p(a_t | a_{<t}) p(x_t | a_t)        q(a_t | x_t)

p(a_t | a_{<t}) is the prediction of the Kalman filter. Its KL divergence is analytic, and forecasts propagate the whole
distribution of z_t; the paper draws z. `smooth` returns the posterior of z. The guide reads only x_t,
whereas the posterior of a_t also depends on the past a_{<t} and on later frames.

A frame without any observed entry is not encoded: its a_t is integrated out like z, and contributes nothing to filter
and bound. As in the paper's imputation, the network that mixes the matrices reads the prediction C_t E(z_t | a_{<t}) in
its place. The guide draws such an a_t from p(a_t | all other a), so that past and future frames inform the imputation.

Fraccaro, Kamronn, Paquet and Winther, 2017, arXiv 1710.05741. The term B_t a_{t-1} and the default layer sizes are from
the public implementation of Girin et al., 2021, arXiv 2008.12595.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Annotated, Any

import torch
from torch import Tensor, nn
from torch.nn import functional
from typing_extensions import override

from ...data.batch import WHOLE
from ...data.schema import Schema
from ...distributions.base import DistributionSpec
from ...distributions.kalman import LinearGaussianChain, update
from ...distributions.triangular import InverseCholesky, Triangular, refuse_half
from ...inference.training.options import Stage
from ...inference.training.recipe import Recipe
from ...networks import Dense, Input, Network, NetworkSpec
from ...networks.base import presence
from ...networks.cells import LSTM
from ...networks.loop import valid_steps
from ...networks.recurrent import lstm_cell
from ...options import Range, Size
from ...program.batch import AnyBatch, repeat
from ...program.model import DynamicalVAE
from ...program.rollout import Rollout
from ..method import LatentMethod


@dataclass(frozen=True)
class KVAE(LatentMethod):
    """A Kalman variational autoencoder. `latent` is the size of z.

    Args:
        auxiliary: size of a.
        components: K, number of matrices that are mixed.
        width: width of the recurrent state that mixes the matrices.
        hidden: widths of the encoder; the decoder has them in reverse order.
        learn_noise: whether to learn diagonal Q and R; otherwise they are .08 I and .03 I.
        phases: whether to train in the paper's three phases: first encoder and decoder alone, after a tenth of the run
            also the matrices, after a third also the network that mixes them. (On simulated people, 1500 steps, three
            seeds, the validation bound is .9 nats a frame higher than when training all parts at once, standard error
            .25.)
    """

    name = "kvae"
    source = "Fraccaro et al., 2017, arXiv 1710.05741"
    generative = "p(a_t | a_{<t}) p(x_t | a_t)"
    inference = "q(a_t | x_t)"
    without_covariates = ("p(a)",)

    latent: Annotated[int, Range(1, 256)] = 8
    auxiliary: Annotated[int, Range(1, 256)] = 16
    components: Annotated[int, Range(1, 64)] = 3
    width: Size = 50
    hidden: tuple[Size, ...] = (256, 128)
    learn_noise: bool = False
    phases: bool = True

    @override
    def sizes(self) -> dict[str, int]:
        """Return the size of a, the only latent that is drawn."""
        return {"a": self.auxiliary}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return the Kalman filter, and perceptrons that act on single frames."""
        return {
            "p(a)": Kalman(self.latent, self.components, self.width, self.learn_noise),
            "p(x)": Dense(self.hidden[::-1]),
            "q(a)": Dense(self.hidden),
        }

    @override
    def distributions(self) -> Mapping[str, DistributionSpec]:
        """Return the distributions by factor; the prediction of the filter has a full covariance."""
        return {**super().distributions(), "p(a)": Triangular()}

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """Return the model of these equations, which integrates out missing frames."""
        return self.build_for_data(Schema.of(data), extended=True, kind=KalmanVAE)

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Return a recipe with the stages of `phases`; a run of fewer than three steps has one stage."""
        recipe = super().train(train, validation, steps)
        if not self.phases or steps < 3:
            return recipe
        ends = [0, max(steps // 10, 1), max(steps // 3, 2), steps]
        network = "generator.a.network."
        frozen = [(network,), tuple(network + name for name in ("memory.", "weights.", "first")), ()]
        stages = [Stage(b - a, self.objective(), frozen=f) for (a, b), f in zip(pairwise(ends), frozen, strict=True)]
        return replace(recipe, stages=stages)


class KalmanVAE(DynamicalVAE):
    """The model of `KVAE`: a_t is present at frames with at least one observed entry."""

    @override
    def rollout(
        self, batch: AnyBatch | None, length: int | None = None, size: int = 1, *, guide: bool = False
    ) -> Rollout:
        run = super().rollout(batch, length, size, guide=guide)
        if WHOLE not in run.observed:
            return run
        observed = run.observed[WHOLE].any(-1)
        # forecast frames are present
        present = functional.pad(observed, (0, run.length - observed.shape[1]), value=True)
        valid = None if run.lengths is None else valid_steps(run.lengths, run.length)
        present = present if valid is None else present | ~valid
        if not present.all():
            run.present = {"a": present}
        if guide and run.present:
            return Encoding(**{f.name: getattr(run, f.name) for f in fields(run)}, network=self.generator["a"].network)
        return run


@dataclass
class Encoding(Rollout):
    """A rollout of the guide that draws a_t from p(a_t | all other a) where the frame is not encoded.

    With gradients enabled, it does not draw them: a bound ignores these frames, and the draws would double its run
    time.

    Args:
        network: network of p(a).
    """

    network: Any = None

    @override
    def draw(self, name: str) -> Tensor:
        draws = super().draw(name)
        if torch.is_grad_enabled():
            return draws
        value: Tensor = self.network.completed(draws, self.present[name], self.lengths)
        self._evaluated[name] = (value, self._evaluated[name][1])  # the guide's conditionals read no a
        return value


@dataclass(frozen=True)
class Kalman:
    """The prediction of a_t from a_{<t} under a linear-Gaussian chain with mixed matrices.

    Args:
        latent: size of z.
        components: K, number of matrices that are mixed.
        width: width of the recurrent state.
        learn_noise: whether to learn Q and R, starting from their default values.
    """

    latent: int = 4
    components: int = 3
    width: int = 50
    learn_noise: bool = False

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> KalmanNetwork:
        """Return the network of a factor p(a_t | a_{<t}), for a of dimension `size`."""
        past = inputs[0] if len(inputs) == 1 and local else None
        if past is None or past.relation is None or past.relation.intervals != ((-math.inf, -1),) or past.size != size:
            raise ValueError(
                "a Kalman network predicts a variable from all of its own past, p(a_t | a_{<t}), but the parents are "
                f"{', '.join(f'{p.name} at {p.relation and p.relation.name}' for p in inputs)}"
            )
        return KalmanNetwork(self, past)


class KalmanNetwork(Network):
    """Network of `Kalman`; the features are location and whitening matrix of the prediction, (..., D + D * D)."""

    head = Triangular
    stationary = streams = True
    log_noise: Tensor
    log_emission: Tensor

    def __init__(self, spec: Kalman, parent: Input):
        size, latent, count = parent.size, spec.latent, spec.components
        super().__init__([parent], True, size + size**2)
        self.spec = spec
        self.first = nn.Parameter(torch.zeros(size))  # a_0
        self.memory: Any = LSTM(size, spec.width)
        self.weights = nn.Linear(spec.width, count)
        self.A = nn.Parameter(torch.eye(latent).repeat(count, 1, 1))
        self.B = nn.Parameter(0.05 * torch.randn(count, latent, size))
        self.C = nn.Parameter(0.05 * torch.randn(count, size, latent))
        for name, start, n in (("log_noise", 0.08, latent), ("log_emission", 0.03, size)):
            value = torch.full((n,), math.log(start))
            if spec.learn_noise:
                setattr(self, name, nn.Parameter(value))
            else:
                self.register_buffer(name, value)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        name = self.inputs[0].name
        a, present = parents[name].to(self.A.dtype).transpose(0, 1), parents.get(presence(name))
        with torch.autocast(a.device.type, enabled=False):
            chain, emission, _ = self.chain_of(a, None if present is None else present.t())
            parts = self.parts_of(*chain.predicted, emission)
        return torch.cat([part.transpose(0, 1) for part in parts], dim=-1).to(a.dtype)

    def chain_of(
        self, a: Tensor, present: Tensor | None = None, valid: Tensor | None = None
    ) -> tuple[LinearGaussianChain, Tensor, Tensor]:
        """Return the chain of z given a, its C (T, B, D, N) and the weights alpha (T, B, K).

        Args:
            a: encoded frames, (T, B, D).
            present: (T, B), False at frames that are not encoded, whose a is integrated out.
            valid: (T, B), False at padding.
        """
        before = torch.cat([self.first.expand(1, a.shape[1], -1), self.fill_missing(a, present)[:-1]])
        alpha = self.weights(self.memory(before)[0]).softmax(-1)
        transition, control, emission = self.mixed(alpha)
        mean, covariance, noise = self.start_of(a.shape[1])
        transition, control = transition[1:], control[1:]
        information, potential = self.seen(emission, a)
        for mask in (present, valid):
            if mask is not None:
                information, potential = information * mask[..., None, None], potential * mask[..., None]
        if present is not None:
            transition, noise = self.past(transition, control, emission[:-1], present[:-1])
            a = a * present[..., None]
        offset = (control @ a[:-1, ..., None].double())[..., 0]
        chain = LinearGaussianChain(transition, offset, noise, mean, covariance, information, potential)
        return chain, emission, alpha

    def fill_missing(self, a: Tensor, present: Tensor | None) -> Tensor:
        """Return a (T, B, D) with predictions at missing frames, the input of the network that mixes the matrices.

        With one component no mixing is needed, and a is unchanged. The loop is necessary, because the matrices of each
        prediction depend on the predictions before it.
        """
        if present is None or self.spec.components == 1:
            return a
        name = self.inputs[0].name
        state = self.start({name: a.transpose(0, 1), presence(name): present.t()}, a.shape[1], len(a))
        rows = []
        for t, row_present in enumerate(present):
            state = self.ahead(state, t, {})
            rows.append(
                torch.where(row_present[:, None], a[t], (state.emission @ state.mean[..., None])[..., 0].to(a.dtype))
            )
        return torch.stack(rows)

    def past(self, transition: Tensor, control: Tensor, emission: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
        """Return A_t and Q, (..., N, N) each, with a_{t-1} = C_{t-1} z_{t-1} + N(0, R) integrated out where missing.

        Args:
            transition, control: A_t and B_t, (..., N, N) and (..., N, D).
            emission, present: C_{t-1} and whether a_{t-1} is present, (..., D, N) and (...).
        """
        absent = control * ~present[..., None, None]
        noise = self.log_noise.exp().diag() + (absent * self.log_emission.exp()) @ absent.mT
        return transition + absent @ emission, noise

    @torch.no_grad()
    def completed(self, a: Tensor, present: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Return a (B, T, D) with draws of p(a_t | all present a) at frames that are not encoded.

        Args:
            a: encoded frames (B, T, D).
            present: (B, T), False at frames that are not encoded.
            lengths: (B,) valid steps of a ragged batch.
        """
        valid = None if lengths is None else valid_steps(lengths, a.shape[1]).t()
        chain, _, alpha = self.chain_of(a.transpose(0, 1), present.t(), valid)
        draws = self.emitted(chain.draw(torch.randn_like(chain.potential)), alpha).transpose(0, 1)
        return torch.where(present[..., None], a, draws.to(a.dtype))

    def emitted(self, z: Tensor, alpha: Tensor) -> Tensor:
        """Return draws of a (T, B, D) given z_{1:T}, for missing frames.

        a_t is C_t z_t + N(0, R) and enters the mean of z_{t+1}. Matheron's rule corrects the unconditional draw by the
        residual of z_{t+1}.

        Args:
            z: (T, B, N).
            alpha: weights of the matrices, (T, B, K).
        """
        transition, control, emission = self.mixed(alpha)
        noise, emission_noise = self.log_noise.exp(), self.log_emission.exp()
        a = (emission @ z[..., None])[..., 0]
        a = a + emission_noise.sqrt() * torch.randn_like(a)
        transition, control = transition[1:], control[1:]
        predicted = (transition @ z[:-1, ..., None] + control @ a[:-1, ..., None])[..., 0]
        residual = z[1:] - predicted - noise.sqrt() * torch.randn_like(predicted)
        covariance = (control * emission_noise) @ control.mT + noise.diag()
        correction = emission_noise * (control.mT @ torch.linalg.solve(covariance, residual[..., None]))[..., 0]
        return torch.cat([a[:-1] + correction, a[-1:]])

    def start_of(self, batch: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return mean (B, N) and covariance (B, N, N) of z_1, and Q (N, N).

        Raises:
            ValueError: if the parameters have half precision.
        """
        refuse_half(self.A.dtype)
        noise = self.log_noise.exp().diag()
        covariance = 20.0 * torch.eye(len(noise), dtype=torch.float64, device=noise.device)
        return covariance.new_zeros(batch, len(noise)), covariance.expand(batch, -1, -1), noise

    def mixed(self, alpha: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return A (..., N, N), B (..., N, D) and C (..., D, N) for weights (..., K), in float64."""
        parts = (self.A, self.B, self.C)
        matrices = (alpha @ torch.cat([part.flatten(1) for part in parts], dim=1)).double()
        pieces = matrices.split([part[0].numel() for part in parts], dim=-1)
        a, b, c = (piece.unflatten(-1, part.shape[1:]) for piece, part in zip(pieces, parts, strict=True))
        return a, b, c

    def seen(self, emission: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        """Return the information about z in a: a Gaussian likelihood exp(g'z - z'Gz / 2) as G and g.

        Args:
            emission: C, (..., D, N).
            a: (..., D).

        Returns:
            Information matrix G (..., N, N) and potential g (..., N).
        """
        weighted = (emission * torch.exp(-self.log_emission)[:, None]).mT
        return weighted @ emission, (weighted @ a[..., None].double())[..., 0]

    def parts_of(self, mean: Tensor, covariance: Tensor, emission: Tensor) -> tuple[Tensor, Tensor]:
        """Return location (..., D) and flat whitening matrix (..., D * D) of a_t.

        Args:
            mean, covariance: moments of z_t, (..., N) and (..., N, N).
            emission: C_t, (..., D, N).
        """
        loc = (emission @ mean[..., None])[..., 0]
        spread = emission @ covariance @ emission.mT + self.log_emission.exp().diag()
        return loc, InverseCholesky.apply(spread).flatten(-2)

    @override
    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        name, zero = self.inputs[0].name, self.first.new_zeros(batch, self.spec.width)
        values, present = (parents[key].unbind(1) if key in parents else None for key in (name, presence(name)))
        return Predicted(values, present, (zero, zero), *self.start_of(batch)[:2], None)

    @override
    def step(self, state: Any, t: int, samples: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        with torch.autocast(self.A.device.type, enabled=False):
            state = self.ahead(state, t, samples)
            features = torch.cat(self.parts_of(state.mean, state.covariance, state.emission), dim=-1)
        return features.to(self.A.dtype), state

    def ahead(self, state: Predicted, t: int, samples: Mapping[str, Sequence[Tensor]]) -> Predicted:
        """Return the prediction of step t from the prediction of step t-1 and from a_{t-1}.

        Args:
            state: prediction of step t-1.
            t: index of the step, from 0.
            samples: values (B, D) by step of the variables that a loop draws, by name; read if `state` has no given a.
        """
        mean, covariance, emission = state.mean, state.covariance, state.emission
        values = samples[self.inputs[0].name] if state.known is None else state.known
        before = values[t - 1].to(self.A.dtype) if t else self.first.expand(len(mean), -1)
        masks = samples.get(presence(self.inputs[0].name)) if state.present is None else state.present
        present = None if masks is None or not t else masks[t - 1]
        if present is not None:
            before = torch.where(present[:, None], before, (emission @ mean[..., None])[..., 0].to(before.dtype))
        gates = functional.linear(before, self.memory.weight_ih_l0, self.memory.bias_ih_l0)
        hidden = lstm_cell(gates, state.hidden, self.memory)
        transition, control, next_emission = self.mixed(self.weights(hidden[0]).softmax(-1))
        if t:
            information, potential = self.seen(emission, before)
            noise = self.log_noise.exp().diag()
            if present is not None:
                information, potential = information * present[:, None, None], potential * present[:, None]
            mean, covariance = update(mean, covariance, information, potential)
            mean = (transition @ mean[..., None] + control @ before[..., None].double())[..., 0]
            if present is not None:
                transition, noise = self.past(transition, control, emission, present)
            covariance = transition @ covariance @ transition.mT + noise
        return Predicted(state.known, state.present, hidden, mean, covariance, next_emission)


@dataclass
class Predicted:
    """The state of a `KalmanNetwork`: the given a, and the distribution of z_t given a_{<t}.

    Args:
        known: given a, one value per step; None if the loop over steps draws a.
        present: whether a is present, (B,) for each step; None if it is present at all steps.
        hidden: hidden state of the LSTM.
        mean, covariance: moments of z_t.
        emission: C_t; None before the first step.
    """

    known: Sequence[Tensor] | None
    present: Sequence[Tensor] | None
    hidden: tuple[Tensor, Tensor]
    mean: Tensor
    covariance: Tensor
    emission: Any


@dataclass(frozen=True)
class SmoothedLatents:
    """The posterior of the latents of a `kvae` model given a sequence, at S draws of a.

    Args:
        a: draws from the guide, (S, B, T, D); at frames that are not encoded, draws of a_t given the other a and z.
        z: one draw of z_{1:T} given the encoded a of each draw, (S, B, T, N).
        mean, covariance: moments of z_t given the encoded a, (S, B, T, N) and (S, B, T, N, N).
        lag_one: Cov(z_{t+1}, z_t) given the encoded a, (S, B, T - 1, N, N).
        weights: alpha_t, (S, B, T, K).
    """

    a: Tensor
    z: Tensor
    mean: Tensor
    covariance: Tensor
    lag_one: Tensor
    weights: Tensor


def smooth(model: DynamicalVAE, batch: AnyBatch, samples: int = 1) -> SmoothedLatents:
    """Return the exact posterior of z given draws of a; draws are reparameterised, so that gradients flow.

    Padded steps of a ragged batch are 0 and do not affect the other steps.

    Args:
        model: model built by `KVAE`.
        batch: batch as in `DynamicalVAE.model`.
        samples: S, number of samples.

    Raises:
        ValueError: if the model has no Kalman network, or `samples` is less than 1.
    """
    network = model.generator["a"].network if "a" in model.generator else None
    if not isinstance(network, KalmanNetwork):
        raise ValueError(f"smoothing needs the chain of a kvae model, but this model is {model.generative.text}")
    if samples < 1:
        raise ValueError(f"`samples` must be at least 1, got {samples}")
    data = {name: repeat(value, samples) for name, value in model.read(batch).items()}
    run = model.rollout(data, guide=True)
    present, valid = run.present.get("a"), None if run.lengths is None else valid_steps(run.lengths, run.length).t()
    a = model.guide(data)["a"].transpose(0, 1)
    chain, _, alpha = network.chain_of(a, None if present is None else present.t(), valid)
    mean, covariance = chain.smoothed
    z = chain.draw(torch.randn_like(mean))
    if present is not None:
        a = torch.where(present.t()[..., None], a, network.emitted(z, alpha))
    results = [a, z, mean, covariance, chain.lag_one, alpha]
    if valid is not None:
        results = [r * valid[-len(r) :].view(*valid[-len(r) :].shape, *[1] * (r.dim() - 2)) for r in results]
    return SmoothedLatents(*(r.to(network.A.dtype).transpose(0, 1).unflatten(0, (samples, -1)) for r in results))
