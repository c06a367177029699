"""Recurrent switching linear dynamical system: the latent selects the state, and the state the linear dynamics.

    p(k_t | k_{t-1}, z_{t-1}) = softmax(r + P k_{t-1} + R z_{t-1})        p(x_t | z_t)
    p(z_t | k_t, z_{t-1}) = N(A_k z_{t-1} + b_k, Q_k)        p(z_1 | k_1) = N(m_k, S_k)

    q(z_t | z_{t-1}, x_{1:T})

Linderman, Johnson, Miller, Adams, Blei and Paninski, 2017, arXiv 1610.08466. The paper's stick-breaking logistic
transitions, for which its Gibbs sampler has Pólya-gamma augmentations, are replaced by a softmax, which does not depend
on the order of the states. Without the recurrence, p(k_t | k_{t-1}), the model is a switching linear dynamical system.
The states are summed out exactly, and a recurrent guide infers z.

The likelihood has many local maxima, so `start_regimes` initialises the model from the data, like the public package
ssm. It sets z to the smoothed principal components, and finds their regimes by k-means and expectation maximisation.
The guide then learns alone for a fifth of the run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import torch
from torch import Tensor, nn
from torch.nn import functional
from typing_extensions import override

from ...data.batch import WHOLE, Batch
from ...data.sequences import as_source, interpolate_missing
from ...distributions.base import DistributionSpec
from ...distributions.triangular import Triangular
from ...factorization.inversion import guide
from ...factorization.notation import Factorization
from ...inference.training.options import Stage
from ...inference.training.recipe import Recipe, fit_factor
from ...networks import Dense, Input, Network, NetworkSpec, Recurrent
from ...networks.loop import valid_steps
from ...options import Delay, Range, Size
from ...program.batch import AnyBatch
from ...program.enumeration import Discrete
from ...program.model import DynamicalVAE
from ..method import LatentMethod

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WINDOWS = 64
"""Maximum number of training windows that `start_regimes` reads."""
LEAST_NOISE = 1e-4
"""Smallest variance of the initial dynamics, for a path of variance 1."""


@dataclass(frozen=True)
class RSLDS(LatentMethod):
    """A recurrent switching linear dynamical system.

    Args:
        states: K, number of discrete states.
        recurrent: whether z_{t-1} affects the next state; otherwise the states are a Markov chain of their own.
        width: width of the guide's recurrent states.
        hidden: widths of the perceptron after the guide's recurrent networks.
        smoothing: number of steps over which the path of the principal components is averaged before its regimes are
            sought. Noisy data need more, and short regimes need less.
    """

    name = "rslds"
    source = "Linderman et al., 2017, arXiv 1610.08466"
    generative = "p(k_t | k_{t-1}, z_{t-1}) p(z_t | k_t, z_{t-1}) p(x_t | z_t)"
    inference = "q(z_t | z_{t-1}, x_{1:T})"
    without_covariates = ("p(z)",)

    latent: Size = 2
    states: Annotated[int, Range(2, 64)] = 4
    recurrent: bool = True
    width: Size = 64
    hidden: tuple[Size, ...] = (64,)
    smoothing: Annotated[int, Range(1, 1024)] = 5
    warm_up: Delay | None = 0

    @override
    def equations(self) -> tuple[Factorization, Factorization]:
        """Return the model, with or without the recurrence, and its guide, which has no factor of k."""
        text = self.generative if self.recurrent else self.generative.replace("k_{t-1}, z_{t-1}", "k_{t-1}", 1)
        generative = Factorization.parse(text)
        return generative, guide(generative, self.inference, summed=("k",))

    @override
    def sizes(self) -> dict[str, int]:
        """Return the size of z and the number of states."""
        return {"z": self.latent, "k": Discrete(self.states)}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return affine networks for the model, and a recurrent network for the guide."""
        return {"p": Dense(()), "p(z)": SwitchingLinear(), "q(z)": Recurrent(self.width, hidden=self.hidden)}

    @override
    def distributions(self) -> Mapping[str, DistributionSpec]:
        """Return the distributions by factor; the noise of the dynamics has a full covariance."""
        return {**super().distributions(), "p(z)": Triangular()}

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Return a recipe that initialises the model from the data and trains the guide alone for a fifth of it."""
        recipe = super().train(train, validation, steps)
        parts = {("generator.",): steps // 5, (): steps - steps // 5}
        stages = [Stage(count, self.objective(), frozen=frozen) for frozen, count in parts.items() if count]
        return replace(recipe, stages=stages, prepare=partial(start_regimes, train=train, smoothing=self.smoothing))


@dataclass(frozen=True)
class SwitchingLinear:
    """Linear-Gaussian dynamics with matrices of their own in each discrete state; `Triangular` is the distribution."""

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> SwitchingNetwork:
        """Return the network of a factor p(z_t | k_t, z_{t-1})."""
        if [parent.lags for parent in inputs] != [(0,), (-1,)] or inputs[1].size != size:
            raise ValueError(
                f"switching dynamics need the parents k_t and z_{{t-1}} of z_t, in this order; got {inputs}"
            )
        return SwitchingNetwork(inputs, size)


class SwitchingNetwork(Network):
    """Network of `SwitchingLinear`; the features are location and whitening matrix, (..., D + D * D).

    Attributes:
        transition, offset: A_k and b_k, (K, D, D) and (K, D).
        first: m_k, (K, D).
        whitening: lower triangular whitening matrices of S_k and Q_k with the logarithms of their diagonals,
            (2, K, D, D).
    """

    head = Triangular
    stationary = True

    def __init__(self, inputs: Sequence[Input], size: int):
        super().__init__(inputs, True, size + size**2)
        states = inputs[0].size
        self.state, self.latent = (parent.name for parent in inputs)
        self.transition = nn.Parameter(torch.eye(size) + 0.1 * torch.randn(states, size, size))
        self.offset = nn.Parameter(0.1 * torch.randn(states, size))
        self.first = nn.Parameter(0.1 * torch.randn(states, size))
        self.whitening = nn.Parameter(torch.zeros(2, states, size, size))

    def features_at(self, state: Tensor, previous: Tensor | None = None) -> Tensor:
        """Return the features (..., H) for states k_t (..., K) and z_{t-1} (..., D); z_0 is None."""
        raw = self.whitening[0 if previous is None else 1]
        whitening = raw.tril(-1) + raw.diagonal(dim1=-2, dim2=-1).exp().diag_embed()
        loc = state @ (self.first if previous is None else self.offset)
        if previous is not None:
            loc = loc + torch.einsum("...k,kij,...j->...i", state, self.transition, previous)
        return torch.cat([loc, state @ whitening.flatten(1)], -1)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        state, previous = parents[self.state], parents[self.latent][:, :-1]
        return torch.cat([self.features_at(state[:, :1]), self.features_at(state[:, 1:], previous)], 1)

    @override
    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        return {name: value.unbind(1) for name, value in parents.items()}

    @override
    def step(self, state: Any, t: int, samples: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        values = {**samples, **state}
        return self.features_at(values[self.state][t], values[self.latent][t - 1] if t else None), state

    @torch.no_grad()
    def fit(self, z: Tensor, weights: Tensor) -> None:
        """Set the parameters to their maximum for a known path and known probabilities of the states.

        A prior with the weight of one step, z_t = z_{t-1} + noise, keeps the parameters of rare states finite.

        Args:
            z: path (B, T, D).
            weights: probabilities of the states (B, T, K), 0 at padding.
        """
        size, count = z.shape[-1], weights.sum(-1, keepdim=True)
        previous, following = z[:, :-1].flatten(0, 1), z[:, 1:].flatten(0, 1)
        inputs, prior = functional.pad(previous, (0, 1), value=1.0), torch.eye(size + 1).to(z)
        moves = (following - previous) * count[:, 1:].flatten(0, 1)
        spread = moves.mT @ moves / count.sum()
        for k, weight in enumerate(weights.unbind(-1)):
            initial, later = weight[:, :1], weight[:, 1:].flatten()[:, None]
            weighted = (later * inputs).mT
            solution = torch.linalg.solve(weighted @ inputs + prior, weighted @ following + prior[:, :size])
            self.transition[k], self.offset[k] = solution[:-1].mT, solution[-1]
            self.first[k] = (initial * z[:, 0]).sum(0) / (initial.sum() + 1)
            rests = z[:, 0] - self.first[k], following - inputs @ solution
            for i, (rest, w, default) in enumerate(
                zip(rests, (initial, later), (prior[:size, :size], spread), strict=True)
            ):
                covariance = ((w * rest).mT @ rest + default) / (w.sum() + 1) + LEAST_NOISE * prior[:size, :size]
                whitening = torch.linalg.inv(torch.linalg.cholesky(covariance))
                self.whitening[i, k] = whitening.tril(-1) + whitening.diagonal().log().diag()


def start_regimes(model: DynamicalVAE, train: Any, smoothing: int, iterations: int = 15) -> None:
    """Initialise the generative model of `RSLDS` from training windows.

    The path is that of the principal components. Its regimes are clusters of positions and moves, which expectation
    maximisation of p(k) and p(z) refines. Gradient steps fit p(x) to the path, whatever the distribution of x.

    Args:
        model: model built by `RSLDS`.
        train: training windows, which are sampled.
        smoothing: as in `RSLDS`.
        iterations: iterations of expectation maximisation.
    """
    data = model.read(as_source(train).sample(WINDOWS, torch.default_generator))
    path, valid = principal_path(model, data, smoothing)
    moves = functional.pad(path[:, 1:] - path[:, :-1], (0, 0, 1, 0))
    points = torch.cat([path - moves / 2, moves], -1)[valid]
    weights = path.new_zeros(*path.shape[:2], model.sizes["k"])
    weights[valid] = cluster(points / points.std(0).clamp(min=1e-6), model.sizes["k"])
    for _ in range(iterations):
        model.generator["z"].network.fit(path, weights)
        states = functional.one_hot(weights.argmax(-1), weights.shape[-1]).to(path)
        fit_factor(model, "k", data, {"z": path, "k": states}, steps=20, learning_rate=0.1)
        run = model.rollout(data)
        run.values["z"] = path
        weights = run.summation.probabilities()["k"] * valid[..., None]
    fit_factor(model, WHOLE, data, {"z": path}, steps=300, learning_rate=0.05)


@torch.no_grad()
def principal_path(model: DynamicalVAE, data: Batch, smoothing: int) -> tuple[Tensor, Tensor]:
    """Return the smoothed principal components of the data, with variance 1, and the mask of valid steps.

    If the data have fewer components than z, the others are 0. Discrete data are transformed by the inverse hyperbolic
    sine, which is a logarithm for large counts.

    Args:
        model: model, whose units of x are those of the components.
        data: batch, as the model reads it.
        smoothing: number of steps that are averaged.

    Returns:
        Path (B, T, D), 0 at padding, and mask (B, T).
    """
    x, mask, size = data[WHOLE], data.mask(), model.sizes["z"]
    valid = x.new_ones(x.shape[:2]).bool() if data.lengths is None else valid_steps(data.lengths, x.shape[1])
    seen = valid[..., None] if mask is None else mask & valid[..., None]
    mean = torch.where(seen, x, 0.0).sum((0, 1)) / seen.expand_as(x).sum((0, 1)).clamp(min=1)
    # a column that a sequence never observes is the mean
    x = mean + interpolate_missing(x - mean, seen)
    x = model.units[WHOLE](x) if WHOLE in model.units else x
    x = x.asinh() if model.generator[WHOLE].discrete else x
    rows = x[valid] - x[valid].mean(0)
    _, scale, axes = torch.linalg.svd(rows, full_matrices=False)
    path = rows @ axes[:size].mT * (len(rows) ** 0.5 / scale[:size].clamp(min=1e-6))
    columns = x.new_zeros(*x.shape[:2], size + 1)
    columns[valid] = functional.pad(functional.pad(path, (0, size - path.shape[1])), (0, 1), value=1.0)
    totals = functional.avg_pool1d(columns.mT, smoothing, 1, smoothing // 2).mT[:, : x.shape[1]]
    return torch.where(valid[..., None], totals[..., :-1] / totals[..., -1:].clamp(min=1e-6), 0.0), valid


def cluster(points: Tensor, count: int, tries: int = 10) -> Tensor:
    """Return the one-hot labels (N, K) of the best of several k-means clusterings of points (N, D).

    Args:
        points: points (N, D).
        count: K, number of clusters.
        tries: number of random starts.
    """
    best, labels = torch.inf, points
    for _ in range(tries):
        centres = points[torch.randint(len(points), (count,))]
        for _ in range(50):
            distances, nearest = torch.cdist(points, centres).min(1)
            members = functional.one_hot(nearest, count).to(points)
            centres = (members.mT @ points + 1e-6 * centres) / (members.sum(0) + 1e-6)[:, None]
        if (distortion := float(distances.square().sum())) < best:
            best, labels = distortion, members
    return labels


@torch.no_grad()
def draw_flow(
    model: DynamicalVAE, batch: AnyBatch, ax: Axes | None = None, coordinates: Sequence[int] = (0, 1)
) -> Axes:
    """Draw the expected moves of z from a grid of points in a plane, coloured by the most probable state.

    The state is the most probable one in the long run if z stayed at the point: the largest entry of the stationary
    distribution of p(k_t | k_{t-1}, z). The arrow is its mean move, A_k z + b_k - z. Dots are draws of z from the
    guide. The other coordinates of z are fixed at their mean.

    Args:
        model: model built by `RSLDS`, of data without covariates.
        batch: sequences (B, T, D), or a batch, whose latents determine the plane.
        ax: axes; a new figure if None.
        coordinates: the two coordinates of z.

    Raises:
        ValueError: if the model has other equations, networks or covariates, or z has no such coordinates.
    """
    import matplotlib.pyplot as plt

    if model.generative.text != RSLDS.generative:
        raise ValueError(f"a flow needs the model {RSLDS.generative}, but this model is {model.generative.text}")
    size, states = model.sizes["z"], model.sizes["k"]
    dynamics, transitions = model.generator["z"].network, model.generator["k"].head.out
    if not isinstance(dynamics, SwitchingNetwork) or transitions.in_features != states + size:
        raise ValueError("a flow needs a model that dvae.method('rslds') built, without covariates")
    if len(coordinates) != 2 or len(set(coordinates)) != 2 or not set(coordinates) <= set(range(size)):
        raise ValueError(f"`coordinates` must be two of the {size} coordinates of z, from 0; got {coordinates}")
    data = model.read(batch)
    z = model.guide(data)["z"]
    z = z.flatten(0, 1) if data.lengths is None else z[valid_steps(data.lengths, z.shape[1])]
    plane = z[:, list(coordinates)]
    grid = torch.cartesian_prod(
        *(torch.linspace(low, high, 21) for low, high in zip(*plane.cpu().aminmax(dim=0), strict=True))
    )
    at = z.mean(0).repeat(len(grid), 1)
    at[:, list(coordinates)] = grid.to(at)
    each = torch.eye(states).to(z)
    inputs = torch.cat([each.expand(len(at), -1, -1), at[:, None].expand(-1, states, -1)], -1)
    chains = transitions(inputs).double().softmax(-1)
    state = torch.linalg.matrix_power(chains, 2**20).mean(1).argmax(-1)
    moves = (dynamics.features_at(each[state], at)[:, :size] - at)[:, list(coordinates)].cpu()
    ax = plt.figure(layout="constrained").add_subplot() if ax is None else ax
    ax.plot(*plane.mT.cpu(), ".", color="0.8", markersize=1, zorder=0)
    ax.quiver(*grid.mT, *moves.mT, color=[f"C{k}" for k in state.tolist()], angles="xy")
    for k in state.unique().tolist():
        ax.plot([], [], color=f"C{k}", label=f"k = {k}")
    ax.set(**{f"{axis}label": f"z, coordinate {c}" for axis, c in zip("xy", coordinates, strict=True)})
    ax.legend(loc="upper left", bbox_to_anchor=(1, 1))
    return ax
