"""Guides of single sequences: on linear-Gaussian surrogates the best ones, and so the parts of the gap, are known."""

import math

import pytest
import torch

import dvae
from dvae import Oracle, linear_gaussian_surrogate, semi_amortized_guide
from dvae.inference.bounds.elbo import joint_and_guide
from dvae.program.batch import repeat

DKF = "p(z_t | z_{t-1}) p(x_t | z_t)"
HIT = "p(w) p(z_t | z_{t-1}, w) p(x_t | x_{t-1}, z_t, w)"
PAIRS = {
    "mean-field": (DKF, "q(z_t | x_{1:T})"),
    "static first": (HIT, "q(w | x_{1:T}) q(z_t | x_{1:T}, w)"),
}
T = 3


def fitted(pair):
    """A model with the best guide of its factorization, its oracle, and what that guide costs."""
    sizes = dict.fromkeys(dvae.Factorization.parse(PAIRS[pair][0]).variables, 1)
    model = linear_gaussian_surrogate(*PAIRS[pair], sizes, T, scale=0.6)
    oracle = Oracle(model, T)
    cost = oracle.fit_guide(300)
    model.requires_grad_(False)
    return model, oracle, cost


def moved(model, seed=1):
    """Parameters of the guide off by a fifth or so."""
    torch.manual_seed(seed)
    for parameter in model.encoder.parameters():
        parameter.data += 0.2 * torch.randn_like(parameter)


def elbo(model, x, draws=400):
    """Mean and standard error, (B,), of log p(x, z) - log q(z | x)."""
    rows = repeat({"x": x}, draws)
    with torch.no_grad():
        joint, own = joint_and_guide(model, rows, model.guide(rows))
    weights = (joint - own).unflatten(0, (draws, -1))
    return weights.mean(0), weights.std(0) / math.sqrt(draws)


@pytest.mark.parametrize("pair", PAIRS)
def test_the_best_guide_of_a_factorization_has_nothing_to_gain_but_its_missing_edges(pair):
    """One that is off gets back what that cost, and with all edges the bound of every sequence is its evidence.

    What the search has left, at a rate that falls to 0, is held below a hundredth of a nat.
    """
    model, oracle, cost = fitted(pair)
    assert cost > 0.02
    x = model.sample(3, T)["x"]
    evidence = oracle.evidence(x)
    best = evidence - oracle.bound(x)
    moved(model)
    assert (evidence - oracle.bound(x) - best).min() > 0.02
    own = semi_amortized_guide(model, x, steps=100, rate=0.5)
    bound, error = elbo(own, x)
    torch.testing.assert_close((evidence - bound).mean(), best.mean(), rtol=0, atol=float(4 * error.max()) + 0.01)
    everything = semi_amortized_guide(own, x, missing=True, steps=100, rate=0.5)
    bound, error = elbo(everything, x)
    assert ((evidence - bound).abs() < 4 * error + 0.01).all()


def test_without_a_step_it_is_the_guide_and_programs_take_the_sequences_any_number_of_times():
    """A rate of nothing moves nothing: draws and densities are the guide's, of ragged sequences with context too."""
    pair = "p(w | c) p(z_t | z_{t-1}, w) p(x_t | z_t, c)", "q(w | x_{1:T}) q(z_t | z_{>t}, x_{1:T}, w)"
    model = dvae.DynamicalVAE(*pair, {"w": 2, "z": 3, "x": 2, "c": 1}).double()
    batch = {"x": torch.randn(3, 5, 2), "c": torch.randn(3, 1), "lengths": torch.tensor([5, 1, 3])}
    local = semi_amortized_guide(model, batch, steps=1, rate=1e-12, missing=True)
    rows = repeat(model.read(batch), 2)
    torch.manual_seed(0)
    ours = local.guide(rows)
    torch.manual_seed(0)
    theirs = model.guide(rows)
    for name in model.latents:
        torch.testing.assert_close(ours[name], theirs[name], rtol=0, atol=1e-9)
    for one, other in zip(joint_and_guide(local, rows, ours), joint_and_guide(model, rows, ours), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-8)
