"""Imputed draws follow the distribution of missing entries given all observed ones, a dense normal.

Draws are whitened by the exact mean and covariance. By the central limit theorem, their means are N(0, 1 / S), their
mean products N(0, 1 / S) and their mean squares N(1, 2 / S). The tests compare z-scores.
"""

import networkx as nx
import numpy as np
import pytest
import torch

import dvae
from dvae.distributions import FixedNormal
from dvae.networks import Linear

T = 5
OBSERVED = torch.tensor([[1, 1], [0, 0], [1, 0], [0, 0], [0, 1]]).bool()
MOST = 4.0


def dense(model, sizes):
    """Return the mean (N,) and covariance (N, N) of all variables and the indices of each (name, t), by unrolling."""
    nodes = [n for n in nx.topological_sort(model.generative.dag(T)) if n[0] in model.generative.variables]
    ends = np.cumsum([0, *(sizes[name] for name, _ in nodes)])
    slices = {node: slice(low, high) for node, low, high in zip(nodes, ends[:-1], ends[1:], strict=True)}
    mean, root = torch.zeros(ends[-1]).double(), torch.zeros(ends[-1], ends[-1]).double()
    for name, t in nodes:
        conditional, row, rows = model.generator[name], 0 if t is None else t - 1, slices[name, t]
        if conditional.network is None:
            root[rows, rows] = torch.eye(sizes[name]).double()
            continue
        mean[rows] = conditional.network.bias[row]
        for parent in conditional.factor.parents:
            for column in np.flatnonzero(model.generative.mask(name, parent.name, T)[row]):
                weight = conditional.network.weights[parent.name][row, column]
                columns = slices[parent.name, column + 1 if parent.local else None]
                mean[rows] += weight @ mean[columns]
                root[rows] += weight @ root[columns]
        root[rows, rows] += conditional.head.log_scale.exp().diag()
    return mean, root @ root.T, slices


def conditional(mean, covariance, observed, values, missing):
    """Return the mean, covariance and gain of the missing entries given values of the observed ones."""
    gain = torch.linalg.solve(covariance[observed][:, observed], covariance[observed][:, missing]).T
    conditional_covariance = covariance[missing][:, missing] - gain @ covariance[observed][:, missing]
    return mean[missing] + gain @ (values - mean[observed]), conditional_covariance, gain


def scores(draws, mean, covariance):
    """Return z-scores of the first and second moments of draws (S, N)."""
    count, size = draws.shape
    white = torch.linalg.solve_triangular(torch.linalg.cholesky(covariance), (draws - mean).T, upper=False)
    second = white @ white.T / count - torch.eye(size).double()
    spread = (torch.ones(size, size) + torch.eye(size)).double().sqrt()
    return torch.cat([white.mean(1), (second / spread).flatten()]) * count**0.5


def built(generative, inference, scale=0.7, grouped=(), **sizes):
    constant = FixedNormal(scale, learned=True, project=False)
    per_step = FixedNormal(scale, learned=True, project=False, steps=T)
    distributions = {"p": constant, **({"q(z)": per_step} if inference and "z" in sizes else {"q": constant})}
    return dvae.DynamicalVAE(generative, inference, sizes, Linear(T, 0.3), distributions, grouped=grouped).double()


@torch.no_grad()
def exact(model, mask, sizes):
    """Set the guide q(z_t | z_{t-1}, x_{1:T}) of a chain to its posterior given the observed entries (T, D)."""
    mean, covariance, slices = dense(model, sizes)
    network, distribution = model.encoder["z"].network, model.encoder["z"].head
    observed = [(t, d) for t in range(T) for d in range(sizes["x"]) if mask[t, d]]
    data = [slices["x", t + 1].start + d for t, d in observed]
    for weight in network.weights.values():
        weight.zero_()
    for t in range(T):
        before = [slices["z", t].start] if t else []
        given_indices, nothing = [*before, *data], torch.zeros(len(before) + len(data)).double()
        offset, rest, gain = conditional(mean, covariance, given_indices, nothing, [slices["z", t + 1].start])
        network.bias[t], distribution.log_scale[t] = offset, rest[0].sqrt().log()
        if t:
            network.weights["z"][t, t - 1] = gain[:, :1]
        for (s, d), slope in zip(observed, gain[0, len(before) :], strict=True):
            network.weights["x"][t, s, 0, d] = slope


def imputation_scores(model, sizes, samples, particles):
    """Return z-scores of draws of the missing entries of a sequence that the model has generated."""
    x = model.sample(1, T)["x"]
    draws = model.impute({"x": x, "mask": OBSERVED[None]}, samples, draw=True, particles=particles, chunk=2**17)["x"][
        :, 0
    ]
    assert torch.equal(draws[:, OBSERVED], x[0][OBSERVED].expand(samples, -1))
    mean, covariance, slices = dense(model, sizes)
    data, observed = torch.cat([torch.arange(mean.numel())[slices["x", t + 1]] for t in range(T)]), OBSERVED.flatten()
    expected, rest, _ = conditional(mean, covariance, data[observed], x.flatten()[observed], data[~observed])
    return scores(draws.flatten(1)[:, ~observed], expected, rest)


@pytest.mark.parametrize("particles", [1, 3])
def test_draws_with_the_exact_guide_follow_the_conditional(particles):
    """Whole steps and single entries are missing. All weights of an exact guide are one."""
    sizes = {"z": 1, "x": 2}
    for _ in range(5):
        model = built("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T})", **sizes)
        exact(model, OBSERVED, sizes)
        assert imputation_scores(model, sizes, 4000, particles).abs().max() < MOST


@pytest.mark.parametrize(
    ("generative", "sizes"),
    [
        ("p(x_t | x_{t-1})", {"x": 2}),
        ("p(z_t | z_{t-1}, x_{t-1}) p(x_t | x_{t-1}, z_t)", {"z": 1, "x": 2}),
        ("p(w) p(x_t | x_{<t}, w)", {"w": 1, "x": 2}),
    ],
)
def test_particles_correct_a_wrong_guide(generative, sizes):
    """The guide is the prior, also in a model without latents that connect the steps around a gap."""
    models = [built(generative, None, 1.5, **sizes) for _ in range(3)]
    single, weighted = (
        [imputation_scores(model, sizes, 200, count).abs().max() for model in models] for count in (1, 500)
    )
    assert max(single) > MOST
    assert max(weighted) < MOST
