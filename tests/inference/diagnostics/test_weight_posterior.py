"""Posterior of the weights: exact for linear regression, calibrated, and the density of the Pyro program."""

import math

import pytest
import scipy
import torch
from torch.func import functional_call

import dvae
from dvae import DynamicalVAE, Oracle, linear_gaussian_surrogate, weight_posterior
from dvae.distributions import Family, FixedNormal
from dvae.inference.diagnostics import weight_posterior as module
from dvae.networks import Attention, Dense

NOISE, SCALE = 0.5, 0.8
QUIET = {"progress": False, "scale": SCALE}
NAMES = ("generator.x.head.out.weight", "generator.x.head.out.bias")


def regression():
    """Return x_t = w x_{t-1} + b + noise, with known noise; x_0 is 0."""
    return DynamicalVAE("p(x_t | x_{t-1})", "", {"x": 1}, Dense(()), FixedNormal(scale=NOISE)).double()


def exact(x):
    """Return mean and covariance of (w, b) under a normal prior."""
    previous = torch.cat([torch.zeros_like(x[:, :1]), x[:, :-1]], 1).flatten()
    design = torch.stack([previous, torch.ones_like(previous)], 1)
    precision = design.T @ design / NOISE**2 + torch.eye(2, dtype=x.dtype) / SCALE**2
    return torch.linalg.solve(precision, design.T @ x.flatten() / NOISE**2), torch.linalg.inv(precision)


def flat(draws):
    return torch.stack([draws[name].flatten() for name in NAMES])


@pytest.fixture
def captured(monkeypatch):
    """Results of `laplace`: mode and Cholesky root of the Hessian."""
    results, original = [], module.laplace
    monkeypatch.setattr(module, "laplace", lambda *a: results.append(original(*a)) or results[-1])
    return results


def test_laplace_is_exact_for_linear_regression(captured):
    torch.manual_seed(0)
    model = regression()
    x = model.sample(6, 5)["x"]
    before = {name: value.clone() for name, value in model.state_dict().items()}
    posterior = weight_posterior(model, x, "laplace", draws=5000, members=3, **QUIET)
    (mode, root), (mean, covariance) = captured[0], exact(x)
    torch.testing.assert_close(mode, mean, rtol=0, atol=1e-7)
    torch.testing.assert_close(torch.cholesky_inverse(root), covariance, rtol=1e-8, atol=0)
    draws = flat(posterior.draws)
    assert ((draws.mean(1) - mean).abs() < 4 * covariance.diagonal().sqrt() / math.sqrt(20_000)).all()
    torch.testing.assert_close(
        draws.cov(), covariance, rtol=0, atol=4 * covariance.max().item() * math.sqrt(2 / 20_000)
    )
    assert repr(posterior).startswith("WeightPosterior(20000 draws of 2 weights, 3 models")
    weights = [each.generator["x"].head.out.weight.item() for each in posterior.ensemble.models]
    assert weights == [posterior.draws[NAMES[0]][n].item() for n in (0, 10_000, 19_999)]
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


def test_draws_of_nuts_have_the_moments_of_the_posterior():
    torch.manual_seed(0)
    model = regression()
    x = model.sample(4, 4)["x"]
    posterior = weight_posterior(model, x, chains=2, draws=150, warmup=60, members=5, **QUIET)
    mean, covariance = exact(x)
    draws, deviation = flat(posterior.draws), covariance.diagonal().sqrt()
    assert posterior.sampling.rhat.max() < 1.1
    assert posterior.sampling.effective.min() > 40
    error = 4 / math.sqrt(posterior.sampling.effective.min())
    assert ((draws.mean(1) - mean).abs() < error * deviation).all()
    assert ((draws.std(1) / deviation - 1).abs() < error).all()
    assert len(posterior.ensemble.models) == 5


def test_intervals_of_the_weights_cover(captured):
    torch.manual_seed(0)
    model, count, inside = regression(), 100, 0
    for seed in range(count):
        weights = SCALE * torch.randn(2, dtype=torch.float64)
        with torch.no_grad():
            model.generator["x"].head.out.weight.fill_(weights[0])
            model.generator["x"].head.out.bias.fill_(weights[1])
        weight_posterior(model, model.sample(3, 4)["x"], "laplace", draws=4, members=1, seed=seed, **QUIET)
        mode, root = captured[-1]
        reach = scipy.special.ndtri(0.9) * torch.cholesky_inverse(root).diagonal().sqrt()
        inside += ((weights - mode).abs() < reach).double().mean().item()
    assert abs(inside / count - 0.8) < 4 * math.sqrt(0.16 / count)


def test_densities_are_those_of_the_program_with_other_weights():
    pair = ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_t)", {"z": 1, "x": 2})
    torch.manual_seed(0)
    for model, has_evidence in (
        (linear_gaussian_surrogate(*pair, 3), True),
        (DynamicalVAE(*pair, Dense((3,))).double(), False),
    ):
        x = torch.randn(4, 3, 2, dtype=torch.float64)
        density = module._LogDensity(model, model.read(x))
        weights = {f"model.generator.{n}": torch.randn_like(p) for n, p in model.generator.named_parameters()}
        latents = {} if has_evidence else {"z": torch.randn(4, 3, 1, dtype=torch.float64)}
        assert density.has_evidence == has_evidence
        value = functional_call(density, weights, (latents,))
        model.generator.load_state_dict(
            {n.removeprefix("model.generator."): v for n, v in weights.items()}, strict=False
        )
        expected = Oracle(model, 3).evidence(x) if has_evidence else sum(model.log_joint(x, latents).values())
        torch.testing.assert_close(value, expected.sum())


def test_latents_are_drawn_jointly_and_summed_out_latents_are_not():
    pair = ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_t)", {"z": 1, "x": 2})
    x = torch.randn(3, 4, 2)
    few = {"draws": 4, "warmup": 2, "chains": 2, "members": 2, **QUIET}
    posterior = weight_posterior(DynamicalVAE(*pair, Dense(())), x, **few)
    assert all(value.shape[0] == 8 for value in posterior.draws.values())
    assert not posterior.sampling.converged.any()
    assert posterior.sampling.rhat.shape == (1, 12 + 12)  # weights and latents
    assert not any(name.endswith("z") for name in posterior.draws)
    summed = DynamicalVAE("p(k_t | k_{t-1}) p(x_t | k_t)", "", {"k": dvae.Discrete(2), "x": 2}, Dense(()))
    assert weight_posterior(summed, x, "laplace", **few).sampling is None


def test_laplace_has_second_derivatives_of_attention():
    model, x = DynamicalVAE("p(x_t | x_{<t})", "", {"x": 1}, Attention(2, 1, 1)), torch.randn(20, 5, 1)
    dvae.fit(model, x, steps=50, learning_rate=0.01, progress=False)
    posterior = weight_posterior(model, x, "laplace", scale=0.1, members=2, progress=False)
    assert all(value.isfinite().all() for value in posterior.draws.values())


def test_unsupported_models_are_refused():
    pair = ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_t)", {"z": 1, "x": 2})
    model, x = DynamicalVAE(*pair, Dense(())), torch.randn(3, 4, 2)
    with pytest.raises(ValueError, match=r"'laplace' needs the exact evidence.* is not linear-Gaussian"):
        weight_posterior(model, x, "laplace", progress=False)
    with pytest.raises(ValueError, match="without 'lengths'"):
        weight_posterior(model, {"x": x, "lengths": torch.tensor([4, 2, 3])}, progress=False)
    with pytest.raises(ValueError, match="weights and 2,400 latent values"):
        weight_posterior(model, torch.randn(600, 4, 2), progress=False)
    positive = DynamicalVAE(*pair, Dense(()), {"p(z)": Family("LogNormal"), "q(z)": Family("LogNormal")})
    with pytest.raises(ValueError, match="latents on the whole real line"):
        weight_posterior(positive, x, progress=False)
    with pytest.raises(ValueError, match="unknown method 'vi'"):
        weight_posterior(model, x, "vi")
    with pytest.raises(ValueError, match="scale is 0"):
        weight_posterior(model, x, scale=0.0)
