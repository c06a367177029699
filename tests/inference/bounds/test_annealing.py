"""Annealed importance sampling: weights and inverse weights are unbiased for the evidence and its inverse."""

import doctest
import math

import pytest
import torch

import dvae
from dvae import Oracle, annealed_bound, linear_gaussian_surrogate
from dvae.inference.bounds import annealing

T = 4


@pytest.mark.parametrize("temperatures", [1, 3])
def test_weights_and_inverse_weights_are_unbiased(temperatures):
    """Use a nearly exact guide, so that the weights have a small variance."""
    model = linear_gaussian_surrogate("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 1}, T)
    x, oracle = model.sample(1, T)["x"], Oracle(model, T)
    oracle.fit_guide(100)
    model.requires_grad_(False)
    evidence = oracle.evidence(x)
    many = x.expand(600, -1, -1)
    bound = annealed_bound(model, many, temperatures, chains=1).bound - evidence
    weights = bound.exp()
    assert abs(weights.mean() - 1) < 4 * weights.std() / math.sqrt(len(weights))

    mean, covariance = oracle.posterior(x)
    exact = torch.distributions.MultivariateNormal(mean[0], covariance).sample((600,))
    back = annealed_bound(model, many, temperatures, chains=1, chunk=250, latents={"z": exact.unflatten(1, (T, 1))})
    weights = (evidence - back.bound).exp()
    assert abs(weights.mean() - 1) < 4 * weights.std() / math.sqrt(len(weights))


def test_padding_and_missing_entries_change_nothing():
    pair = "p(z_t | z_{t-1}, c) p(x_t | z_t)", "q(z_t | x_{1:T}, c)"
    model = dvae.DynamicalVAE(*pair, {"z": 1, "x": 2, "c": 1}).double()
    x, c = torch.randn(3, T, 2).double(), torch.randn(3, 1).double()
    lengths, mask = torch.tensor([T, 2, 3]), torch.rand(3, T, 2) > 0.3
    annealed = annealed_bound(model, {"x": x, "c": c, "lengths": lengths, "mask": mask}, 20)
    for n, length in enumerate(lengths.tolist()):
        unpadded = {"x": x[n : n + 1, :length], "c": c[n : n + 1], "mask": mask[n : n + 1, :length]}
        other = annealed_bound(model, unpadded, 20, seed=1)
        spread = 5 * math.hypot(float(annealed.error[n]), float(other.error))
        assert abs(annealed.bound[n] - other.bound) < spread + 1e-6


def test_docstrings():
    assert doctest.testmod(annealing, extraglobs={"dvae": dvae, "torch": torch}).failed == 0
