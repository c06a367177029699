"""The evidence from both sides: unbiased on either, and between them where the guide is at its worst."""

import doctest
import math

import pytest
import torch

import dvae
from dvae import Oracle, annealed_bound, importance_bound, twin
from dvae.distributions import Family
from dvae.inference.bounds import annealing

PAIRS = {
    "dkf, mean-field": ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})"),
    "hit-dvae": ("p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)", "q(w | x_{1:T}) q(z_t | x_{1:T}, w)"),
}
T = 4


def simulated(pair, count, size=2, seed=0):
    sizes = dict.fromkeys(dvae.Factorization.parse(PAIRS[pair][0]).variables, size)
    model = twin(*PAIRS[pair], sizes, T, seed).requires_grad_(False)
    torch.manual_seed(seed)
    drawn = model.sample(count, T)
    return model, drawn["x"], {name: drawn[name] for name in model.latents}


def fitted(model):
    oracle = Oracle(model.requires_grad_(), T)
    oracle.fit_guide(100)
    model.requires_grad_(False)
    return oracle


@pytest.mark.parametrize("pair", PAIRS)
def test_the_evidence_lies_between_the_two(pair):
    """Within their errors on average, and near: guides are random, and their own bounds far below."""
    model, x, latents = simulated(pair, 24)
    evidence = Oracle(model, T).evidence(x)
    assert (importance_bound(model, x, 16).bound - evidence).mean() < -1
    below = annealed_bound(model, x, 50, 8).bound - evidence
    above = annealed_bound(model, x, 50, 8, latents=latents).bound - evidence
    for gap, sign in ((below, 1), (above, -1)):
        assert abs(gap.mean()) < 0.4
        assert sign * gap.mean() < 3 * gap.std() / math.sqrt(len(gap))


@pytest.mark.parametrize("temperatures", [1, 3])
def test_weights_are_unbiased_for_the_evidence_and_their_inverses_for_its_inverse(temperatures):
    """Whatever the number of temperatures; weights of a guide that is nearly right, so that they have a variance."""
    model, x, _ = simulated("dkf, mean-field", 1, size=1)
    oracle = fitted(model)
    evidence = oracle.evidence(x)
    many = x.expand(600, -1, -1)
    found = annealed_bound(model, many, temperatures, chains=1).bound - evidence
    weights = found.exp()
    assert abs(weights.mean() - 1) < 4 * weights.std() / math.sqrt(len(weights))

    mean, covariance = oracle.posterior(x)
    exact = torch.distributions.MultivariateNormal(mean[0], covariance).sample((600,))
    back = annealed_bound(model, many, temperatures, chains=1, chunk=250, latents={"z": exact.unflatten(1, (T, 1))})
    weights = (evidence - back.bound).exp()
    assert abs(weights.mean() - 1) < 4 * weights.std() / math.sqrt(len(weights))


def test_ragged_batches_masks_and_context():
    model = dvae.DynamicalVAE(
        "p(z_t | z_{t-1}, c) p(x_t | z_t)", "q(z_t | x_{1:T}, c)", {"z": 1, "x": 2, "c": 1}
    ).double()
    x, c = torch.randn(3, T, 2).double(), torch.randn(3, 1).double()
    lengths, mask = torch.tensor([T, 2, 3]), torch.rand(3, T, 2) > 0.3
    found = annealed_bound(model, {"x": x, "c": c, "lengths": lengths, "mask": mask}, 20)
    for n, length in enumerate(lengths.tolist()):
        alone = {"x": x[n : n + 1, :length], "c": c[n : n + 1], "mask": mask[n : n + 1, :length]}
        other = annealed_bound(model, alone, 20, seed=1)
        spread = 5 * math.hypot(float(found.error[n]), float(other.error))
        assert abs(found.bound[n] - other.bound) < spread + 1e-6


def test_other_likelihoods_than_normals():
    """A Poisson given one normal, whose evidence is an integral over a line."""
    model = dvae.DynamicalVAE(
        "p(w) p(x_t | w)", "q(w | x_{1:T})", {"w": 1, "x": 1}, laws={"p(x)": Family("Poisson")}
    ).double()
    x = torch.tensor([[[2.0], [0.0], [5.0]]], dtype=torch.float64)
    grid = torch.linspace(-8, 8, 4001, dtype=torch.float64)[:, None]
    with torch.no_grad():
        logs = model.log_joint({"x": x.expand(len(grid), -1, -1)}, {"w": grid})
    evidence = sum(log.sum(-1) if log.dim() == 2 else log for log in logs.values()).logsumexp(0) + math.log(16 / 4000)
    found = annealed_bound(model, x, 30, 64)
    assert abs(found.bound - evidence) < 5 * found.error


def test_docstrings():
    assert doctest.testmod(annealing, extraglobs={"dvae": dvae, "torch": torch}).failed == 0
