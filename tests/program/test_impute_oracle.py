"""Imputed draws are draws from the conditional of what is missing given all that was observed: one dense normal.

Draws are made white by the exact mean and covariance. Then their means are N(0, 1 / S), their mean products N(0, 1 / S)
and their mean squares N(1, 2 / S), up to the central limit: what is compared are z-scores.
"""

import networkx as nx
import numpy as np
import pytest
import torch

import dvae
from dvae.distributions import FixedNormal
from dvae.networks import Linear

T = 5
SEEN = torch.tensor([[1, 1], [0, 0], [1, 0], [0, 0], [0, 1]]).bool()
MOST = 4.0


def dense(model, sizes):
    """Mean (N,) and covariance (N, N) of all variables, and where each (name, t) stands, by the unrolled graph."""
    nodes = [n for n in nx.topological_sort(model.generative.dag(T)) if n[0] in model.generative.variables]
    ends = np.cumsum([0, *(sizes[name] for name, _ in nodes)])
    places = {node: slice(low, high) for node, low, high in zip(nodes, ends[:-1], ends[1:], strict=True)}
    mean, root = torch.zeros(ends[-1]).double(), torch.zeros(ends[-1], ends[-1]).double()
    for name, t in nodes:
        conditional, row, own = model.generator[name], 0 if t is None else t - 1, places[name, t]
        if conditional.network is None:
            root[own, own] = torch.eye(sizes[name]).double()
            continue
        mean[own] = conditional.network.bias[row]
        for parent in conditional.factor.parents:
            for column in np.flatnonzero(model.generative.mask(name, parent.name, T)[row]):
                weight = conditional.network.weights[parent.name][row, column]
                at = places[parent.name, column + 1 if parent.local else None]
                mean[own] += weight @ mean[at]
                root[own] += weight @ root[at]
        root[own, own] += conditional.head.log_scale.exp().diag()
    return mean, root @ root.T, places


def conditional(mean, covariance, known, values, wanted):
    """Mean and covariance of the wanted entries given values of the known ones."""
    gain = torch.linalg.solve(covariance[known][:, known], covariance[known][:, wanted]).T
    rest = covariance[wanted][:, wanted] - gain @ covariance[known][:, wanted]
    return mean[wanted] + gain @ (values - mean[known]), rest, gain


def scores(draws, mean, covariance):
    """z-scores of first and second moments of draws (S, N)."""
    count, size = draws.shape
    white = torch.linalg.solve_triangular(torch.linalg.cholesky(covariance), (draws - mean).T, upper=False)
    second = white @ white.T / count - torch.eye(size).double()
    spread = (torch.ones(size, size) + torch.eye(size)).double().sqrt()
    return torch.cat([white.mean(1), (second / spread).flatten()]) * count**0.5


def built(generative, inference, scale=0.7, grouped=(), **sizes):
    own = FixedNormal(scale, learned=True, project=False)
    each = FixedNormal(scale, learned=True, project=False, steps=T)
    distributions = {"p": own, **({"q(z)": each} if inference and "z" in sizes else {"q": own})}
    return dvae.DynamicalVAE(generative, inference, sizes, Linear(T, 0.3), distributions, grouped=grouped).double()


@torch.no_grad()
def exact(model, seen, sizes):
    """Sets the guide q(z_t | z_{t-1}, x_{1:T}) of a chain to its posterior given what is seen (T, D)."""
    mean, covariance, places = dense(model, sizes)
    network, distribution = model.encoder["z"].network, model.encoder["z"].head
    observed = [(t, d) for t in range(T) for d in range(sizes["x"]) if seen[t, d]]
    data = [places["x", t + 1].start + d for t, d in observed]
    for weight in network.weights.values():
        weight.zero_()
    for t in range(T):
        before = [places["z", t].start] if t else []
        known, nothing = [*before, *data], torch.zeros(len(before) + len(data)).double()
        offset, rest, gain = conditional(mean, covariance, known, nothing, [places["z", t + 1].start])
        network.bias[t], distribution.log_scale[t] = offset, rest[0].sqrt().log()
        if t:
            network.weights["z"][t, t - 1] = gain[:, :1]
        for (s, d), slope in zip(observed, gain[0, len(before) :], strict=True):
            network.weights["x"][t, s, 0, d] = slope


def judged(model, sizes, samples, particles):
    """z-scores of draws of what is hidden of a sequence that the model makes."""
    x = model.sample(1, T)["x"]
    draws = model.impute({"x": x, "mask": SEEN[None]}, samples, draw=True, particles=particles, chunk=2**17)["x"][:, 0]
    assert torch.equal(draws[:, SEEN], x[0][SEEN].expand(samples, -1))
    mean, covariance, places = dense(model, sizes)
    data, shown = torch.cat([torch.arange(mean.numel())[places["x", t + 1]] for t in range(T)]), SEEN.flatten()
    expected, rest, _ = conditional(mean, covariance, data[shown], x.flatten()[shown], data[~shown])
    return scores(draws.flatten(1)[:, ~shown], expected, rest)


@pytest.mark.parametrize("particles", [1, 3])
def test_draws_given_the_exact_guide_are_of_the_conditional(particles):
    """Of a state-space model whole steps are missing, and single entries. The weights of an exact guide are all one."""
    sizes = {"z": 1, "x": 2}
    for _ in range(5):
        model = built("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T})", **sizes)
        exact(model, SEEN, sizes)
        assert judged(model, sizes, 4000, particles).abs().max() < MOST


@pytest.mark.parametrize(
    ("generative", "sizes"),
    [
        ("p(x_t | x_{t-1})", {"x": 2}),
        ("p(z_t | z_{t-1}, x_{t-1}) p(x_t | x_{t-1}, z_t)", {"z": 1, "x": 2}),
        ("p(w) p(x_t | x_{<t}, w)", {"w": 1, "x": 2}),
    ],
)
def test_particles_make_up_for_what_a_guide_gets_wrong(generative, sizes):
    """Here a guide that is the prior; also where no latent could tell what comes after a gap."""
    models = [built(generative, None, 1.5, **sizes) for _ in range(3)]
    alone, chosen = ([judged(model, sizes, 200, count).abs().max() for model in models] for count in (1, 500))
    assert max(alone) > MOST
    assert max(chosen) < MOST
