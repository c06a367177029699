"""The log score: an unbiased estimate of the model's forecast density, exact for exact guides."""

import math

import pytest
import torch

from dvae import Oracle, linear_gaussian_surrogate
from dvae.data.sequences import ArrayWindows
from dvae.inference.bounds.predictive import predictive_bound
from dvae.inference.evaluation.evaluate import evaluate

T, SEEN = 5, 3
DKF = ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})", {"z": 1, "x": 2})
DRIVEN = (
    "p(w) p(z_t | z_{t-1}, w) p(x_t | x_{t-1}, z_t, w)",
    "q(w | x_{1:T}) q(z_t | x_{t-1:t}, w)",
    {"w": 1, "z": 2, "x": 2},
)
EXACT = ("p(z_t) p(x_t | x_{t-1}, z_t)", "q(z_t | x_t, x_{t-1})", {"z": 1, "x": 3})


def wide(pair):
    """Return a model whose guide is slightly wider than the posterior, so that weights are bounded."""
    model = linear_gaussian_surrogate(*pair, T)
    Oracle(model, T).fit_guide(15)
    with torch.no_grad():
        for conditional in model.encoder.values():
            conditional.head.log_scale += 0.25
    return model


def draws(model, n):
    with torch.random.fork_rng():
        torch.manual_seed(1)
        return model.sample(n, T)["x"]


def distribution(model, x):
    """Return the mean (B, H D) and covariance of forecasts of x (B, T, D), with latents of the past from the guide."""
    oracle, past = Oracle(model, T), Oracle(model, SEEN)
    names = (*model.latents, *model.observed)
    steps = [T if model.generative.local(name) else 1 for name in names]
    counts = [s * model.sizes[n] for n, s in zip(names, steps)]
    blocks = torch.arange(sum(counts)).split(counts)
    given = torch.cat([block[: min(s, SEEN) * model.sizes[n]] for n, s, block in zip(names, steps, blocks)])
    future = blocks[-1][SEEN * model.sizes["x"] :]
    mean, precision = (value.detach() for value in oracle._joint())
    covariance = torch.linalg.inv(precision)
    gain = torch.linalg.solve(covariance[given][:, given], covariance[given][:, future]).T
    rest = covariance[future][:, future] - gain @ covariance[given][:, future]
    weights, offset, root = (value[0].detach() for value in past._guide())
    observed = x[:, :SEEN].flatten(1)
    latents = observed @ weights.T + offset
    spread = gain[:, : latents.shape[1]] @ root
    return mean[future] + (torch.cat([latents, observed], 1) - mean[given]) @ gain.T, rest + spread @ spread.T


def log_density(model, x):
    mean, covariance = distribution(model, x)
    return torch.distributions.MultivariateNormal(mean, covariance).log_prob(x[:, SEEN:].flatten(1))


@pytest.mark.parametrize("pair", [DKF, DRIVEN])
def test_weights_are_unbiased_for_the_forecast_density_and_their_log_is_a_lower_bound(pair):
    model = wide(pair)
    x = draws(model, 1)
    exact = log_density(model, x)
    log_weights = torch.stack(
        [predictive_bound(model, x.expand(2000, -1, -1), SEEN, particles).bound - exact for particles in (1, 8)]
    )
    ratios, error = log_weights.exp().mean(1), log_weights.exp().std(1) / math.sqrt(2000)
    assert ((ratios - 1).abs() < 4 * error).all()
    assert (error < 0.1).all()
    bias, noise = log_weights.mean(1), log_weights.std(1) / math.sqrt(2000)
    assert (bias < 4 * noise).all()
    assert bias[0] + 4 * noise[0] < bias[1]  # more particles, less bias


def test_with_exact_guides_one_particle_gives_the_exact_predictive_density():
    model = linear_gaussian_surrogate(*EXACT, T)
    Oracle(model, T).fit_guide(100)
    x = draws(model, 20)
    exact = (Oracle(model, T).evidence(x) - Oracle(model, SEEN).evidence(x[:, :SEEN])).detach()
    torch.testing.assert_close(predictive_bound(model, x, SEEN, 1).bound, exact, rtol=0, atol=1e-4)


@pytest.mark.parametrize(("pair", "last"), [(DKF, False), (DRIVEN, True)])
def test_a_log_score_with_missing_values_scores_observed_values(pair, last):
    """The score is a marginal of the forecast density. It is exact if no x reads a missing value."""
    model = wide(pair)
    x, mask = draws(model, 1), torch.ones(1, T, 2).bool()
    mask[0, -1, 0] = False
    if not last:
        mask[0, 1, 0] = mask[0, 2, 1] = mask[0, 3, 1] = False
    mean, covariance = distribution(model, torch.where(mask, x, 0.0))
    observed = mask[0, SEEN:].flatten()
    marginal = torch.distributions.MultivariateNormal(mean[:, observed], covariance[observed][:, observed])
    exact = marginal.log_prob(x[:, SEEN:].flatten(1)[:, observed])
    batch = {"x": torch.where(mask, x, torch.nan).expand(2000, -1, -1), "mask": mask.expand(2000, -1, -1)}
    ratios = (predictive_bound(model, batch, SEEN, 8).bound - exact).exp()
    error = ratios.std() / math.sqrt(2000)
    assert abs(ratios.mean() - 1) < 4 * error
    assert error < 0.05


def test_an_evaluation_reports_the_log_score_in_nats_per_predicted_frame():
    model = linear_gaussian_surrogate(*DKF, T)
    x = draws(model, 6)
    windows = ArrayWindows(x, SEEN)
    options = {"samples": 2, "batch_size": 6, "progress": False}
    result = evaluate({"dkf": model}, windows, log_score_particles=7, seed=2, **options)
    with torch.random.fork_rng():
        torch.manual_seed(2)
        expected = predictive_bound(model, x, SEEN, 7).bound.mean() / (T - SEEN)
    assert result["dkf"]["log score"].mean == pytest.approx(expected.item())
    assert list(result.metrics) == ["energy score", "variogram score", "CRPS", "log score", "ELBO", "KL z"]
    assert (result.metrics["log score"].unit, result.metrics["log score"].better) == ("nats/step", "higher")
    assert result.log_score_particles == 7
    assert "log score" not in result["last value"]
    assert "log score" not in evaluate({"dkf": model}, windows, **options).metrics
