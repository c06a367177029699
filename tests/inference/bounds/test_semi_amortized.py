"""Semi-amortized guides: on linear-Gaussian surrogates the optimum, and so each part of the gap, is known."""

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


def best_guide(pair):
    """Return a model with the best guide of its factorization, its oracle, and the cost of that guide in nats."""
    sizes = dict.fromkeys(dvae.Factorization.parse(PAIRS[pair][0]).variables, 1)
    model = linear_gaussian_surrogate(*PAIRS[pair], sizes, T, scale=0.6)
    oracle = Oracle(model, T)
    cost = oracle.fit_guide(300)
    model.requires_grad_(False)
    return model, oracle, cost


def perturb(model, seed=1):
    """Perturb the parameters of the guide by about a fifth."""
    torch.manual_seed(seed)
    for parameter in model.encoder.parameters():
        parameter.data += 0.2 * torch.randn_like(parameter)


def elbo(model, x, draws=400):
    """Return the mean and standard error, (B,), of log p(x, z) - log q(z | x)."""
    rows = repeat({"x": x}, draws)
    with torch.no_grad():
        joint, log_q = joint_and_guide(model, rows, model.guide(rows))
    weights = (joint - log_q).unflatten(0, (draws, -1))
    return weights.mean(0), weights.std(0) / math.sqrt(draws)


@pytest.mark.parametrize("pair", PAIRS)
def test_refining_regains_the_amortization_gap_and_missing_edges_the_rest(pair):
    """A perturbed guide regains its loss; with all edges, the bound of every sequence is its evidence.

    The learning rate falls to 0, which leaves an error of less than 0.01 nats.
    """
    model, oracle, cost = best_guide(pair)
    assert cost > 0.02
    x = model.sample(3, T)["x"]
    evidence = oracle.evidence(x)
    best = evidence - oracle.bound(x)
    perturb(model)
    assert (evidence - oracle.bound(x) - best).min() > 0.02
    refined = semi_amortized_guide(model, x, steps=100, rate=0.5)
    bound, error = elbo(refined, x)
    torch.testing.assert_close((evidence - bound).mean(), best.mean(), rtol=0, atol=float(4 * error.max()) + 0.01)
    everything = semi_amortized_guide(refined, x, missing=True, steps=100, rate=0.5)
    bound, error = elbo(everything, x)
    assert ((evidence - bound).abs() < 4 * error + 0.01).all()


def test_at_rate_zero_the_refined_guide_is_the_guide_for_repeated_sequences_too():
    """At a rate of 0, draws and densities are the guide's, also for ragged sequences with context."""
    pair = "p(w | c) p(z_t | z_{t-1}, w) p(x_t | z_t, c)", "q(w | x_{1:T}) q(z_t | z_{>t}, x_{1:T}, w)"
    model = dvae.DynamicalVAE(*pair, {"w": 2, "z": 3, "x": 2, "c": 1}).double()
    batch = {"x": torch.randn(3, 5, 2), "c": torch.randn(3, 1), "lengths": torch.tensor([5, 1, 3])}
    local = semi_amortized_guide(model, batch, steps=1, rate=1e-12, missing=True)
    rows = repeat(model.read(batch), 2)
    torch.manual_seed(0)
    traced = local.guide(rows)
    torch.manual_seed(0)
    expected = model.guide(rows)
    for name in model.latents:
        torch.testing.assert_close(traced[name], expected[name], rtol=0, atol=1e-9)
    for one, other in zip(joint_and_guide(local, rows, traced), joint_and_guide(model, rows, traced), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-8)
