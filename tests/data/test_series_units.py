"""Units of each sequence: a bijection, its log-determinant, its prior, and models that use it."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import norm

import dvae
from dvae.data.batch import Batch
from dvae.data.series_units import LOCATION, SCALE, SeriesPrior, SeriesUnits
from dvae.distributions import FixedNormal
from dvae.inference.bounds.predictive import predictive_bound

REAL = SeriesPrior(0.3, 0.05, 0.5, 4.0, 1.0, 2.0)
POSITIVE = SeriesPrior(0.1, 0.2, 0.1, 3.0, 0.2, 1.5, True)
PRIORS = (REAL, None, POSITIVE)
CASES = [(lag, observed, missing) for lag in (0, 1, 3) for observed in (None, 5, 20) for missing in (False, True)]


@pytest.fixture(params=CASES, ids=str)
def case(request):
    lag, observed, missing = request.param
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(4, 12, 3, dtype=torch.float64, generator=generator).cumsum(1)
    x[..., 2] = (x[..., 2] / 3).exp()
    batch = Batch(x=x)
    if missing:
        batch["mask"] = torch.rand(x.shape, generator=generator) > 0.3
    return SeriesUnits(PRIORS, lag, observed), batch


def observed_entries(batch):
    return torch.ones_like(batch["x"], dtype=torch.bool) if batch.mask() is None else batch.mask()


def with_x(batch, x):
    return Batch(batch | {"x": x})


def test_the_inverse_undoes_the_view_and_a_second_call_changes_nothing(case):
    view, batch = case
    viewed, mask = view(batch), observed_entries(batch)
    torch.testing.assert_close(view.inverse(viewed)["x"][mask], batch["x"][mask])
    assert torch.equal(view(viewed)["x"], viewed["x"])
    assert torch.equal(viewed["x"][..., 1][mask[..., 1]], batch["x"][..., 1][mask[..., 1]])  # it has no prior


def test_the_jacobian_is_triangular_and_has_the_log_determinant(case):
    view, batch = case
    one = batch.rows(slice(1))
    mask = observed_entries(one).flatten()
    size = 12 * 3
    jacobian = torch.autograd.functional.jacobian(lambda x: view(with_x(one, x))["x"], one["x"]).reshape(size, size)
    step = 1e-6 * torch.eye(size, dtype=torch.float64).view(size, 1, 12, 3)
    differences = [view(with_x(one, one["x"] + h))["x"] - view(with_x(one, one["x"] - h))["x"] for h in step]
    torch.testing.assert_close(torch.stack(differences, -1).reshape(size, size) / 2e-6, jacobian, atol=1e-6, rtol=1e-6)
    jacobian = jacobian[mask][:, mask]
    by_time = torch.arange(size)[mask] // 3
    assert (jacobian[by_time[:, None] < by_time[None]] == 0).all()
    entries = view.log_det(one).flatten()[mask]
    torch.testing.assert_close(torch.linalg.slogdet(jacobian).logabsdet, entries.sum())


@pytest.mark.parametrize("steps", [7, 9])
def test_the_future_continues_the_past(case, steps):
    view, batch = case
    if view.observed != 5:
        pytest.skip("only after the observed steps do level and scale stay the same")
    mask = observed_entries(batch).clone()
    mask[:, steps:] = True
    whole = Batch(x=batch["x"], mask=mask)
    past = view(whole.past(steps))
    future = view(whole)["x"][:, steps:]
    following = view.following(Batch(past))
    assert not {LOCATION, SCALE} & following.keys()
    added = Batch({name: following[name] for name in view.names if name in following})
    draws = view.inverse(Batch(added | {"x": torch.stack([future, future])}))["x"]
    torch.testing.assert_close(draws, batch["x"][:, steps:].expand(2, -1, -1, -1))
    torch.testing.assert_close(view(Batch(x=batch["x"][:, steps:]), past)["x"], future)


def test_sequences_from_their_first_step_on_are_inverted_without_entries(case):
    view, batch = case
    if batch.mask() is None:
        torch.testing.assert_close(view.inverse(Batch(x=view(batch)["x"]))["x"], batch["x"])


def test_location_and_scale_are_the_predictive_moments_of_a_normal_with_a_conjugate_prior():
    """The recursive update of the posterior (Gelman et al., 2013, equation 3.3), observation by observation."""
    u = np.random.default_rng(0).normal(3, 2, 9)
    viewed = SeriesUnits((REAL,))(Batch(x=torch.from_numpy(u)[None, :, None]))
    mean, weight, freedom, squares = REAL.mean, REAL.weight, REAL.freedom, REAL.freedom * REAL.variance
    for t, value in enumerate(u):
        assert viewed[LOCATION][0, t, 0].item() == pytest.approx(mean)
        assert viewed[SCALE][0, t, 0].item() == pytest.approx(math.sqrt(squares / freedom * (1 + 1 / weight)))
        squares += weight / (weight + 1) * (value - mean) ** 2
        mean, weight, freedom = (weight * mean + value) / (weight + 1), weight + 1, freedom + 1


def test_a_lag_above_the_observed_steps_is_refused():
    with pytest.raises(ValueError, match="lag is 7 and observed 5; lag must be at most observed"):
        SeriesUnits((REAL,), 7, 5)


@pytest.mark.parametrize("lag", [0, 1])
def test_the_prior_is_recovered_from_simulated_sequences(lag):
    random = np.random.default_rng(1)
    freedom, variance, weight, mean = 8.0, 0.25, 0.1, 1.5
    sequences = []
    for _ in range(1500):
        v = freedom * variance / random.chisquare(freedom)
        u = random.normal(random.normal(mean, math.sqrt(variance / weight)), math.sqrt(v), 40)
        x = u.copy()
        for t in range(lag, len(u)) if lag else ():
            x[t] = x[t - lag] + u[t]
        sequences.append(x)
    prior = SeriesPrior.estimate(np.array(sequences), lag)
    assert prior.mean == pytest.approx(mean, abs=4 * math.sqrt(variance / weight / 1500))
    assert prior.freedom == pytest.approx(freedom, rel=0.2)
    assert prior.variance == pytest.approx(variance, rel=0.1)
    expected = variance * freedom / (freedom - 2)  # the mean of the variances
    assert prior.weight == pytest.approx(expected / (variance / weight), rel=0.2)


def test_equal_variances_give_the_largest_weight_and_constant_sequences_a_finite_prior():
    random = np.random.default_rng(2)
    assert SeriesPrior.estimate(random.normal(0, 3, (200, 30))).freedom == 100
    half = np.where(np.arange(9) % 2, np.nan, np.arange(9.0))
    for windows in (np.zeros((3, 9)), np.arange(2.0)[None], np.stack([np.arange(9.0), half, half])):
        for lag in (0, 1, 4):
            assert np.isfinite(SeriesPrior.estimate(windows, lag)).all()


def white_noise(view):
    """A model whose x is standard normal noise in the view."""
    model = dvae.DynamicalVAE(
        "p(x_t | x_{t-1})", "", {"x": 1}, dvae.networks.Dense((4,)), FixedNormal(scale=1.0), view=view
    ).double()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.zero_()
    return model


@pytest.mark.parametrize("lag", [0, 1, 3])
@pytest.mark.parametrize("logarithm", [False, True])
def test_the_bound_is_the_density_of_the_data_of_an_equal_model_without_the_view(lag, logarithm):
    """White noise in the view is a product of normals in x, whose moments are computed here step by step."""
    prior = SeriesPrior(0.2, 0.3, 0.4, 5.0, 0.7, 1.3, logarithm)
    view = SeriesUnits((prior,), lag, 6)
    random = np.random.default_rng(3)
    z = random.normal(0, 1, 10).cumsum()
    x = torch.from_numpy(np.exp(z) if logarithm else z)[None, :, None]
    density, future = -z.sum() if logarithm else 0.0, -z[6:].sum() if logarithm else 0.0
    for t in range(10):
        bases = [z[s - 1] if lag == 1 else z[s % lag : min(s, 6) : lag].mean() if lag else 0.0 for s in range(lag, 10)]
        u = [z[s] - bases[s - lag] for s in range(lag, min(t, 6))]
        n, k = len(u), prior.weight
        mean = (k * prior.mean + sum(u)) / (k + n)
        spread = n * np.var(u) + k * n / (k + n) * (np.mean(u) - prior.mean) ** 2 if n else 0.0
        scale = math.sqrt((prior.freedom * prior.variance + spread) / (prior.freedom + n) * (1 + 1 / (k + n)))
        log_prob = (
            norm.logpdf(z[t], prior.level, prior.spread) if t < lag else norm.logpdf(z[t], mean + bases[t - lag], scale)
        )
        density, future = density + log_prob, future + (log_prob if t >= 6 else 0.0)
    model = white_noise(view)
    bound = dvae.iwae_bound(model, x, particles=1).bound
    assert bound.item() == pytest.approx(density)
    assert predictive_bound(model, x, 6, 1).bound.item() == pytest.approx(future)


@pytest.mark.parametrize("lag", [0, 1, 3])
def test_forecasts_have_the_moments_of_the_predictive_distribution(lag):
    prior = SeriesPrior(0.2, 0.3, 0.4, 5.0, 0.7, 1.3)
    model = white_noise(SeriesUnits((prior,), lag, 6))
    x = torch.randn(2, 8, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).cumsum(1)
    torch.manual_seed(0)
    draws = model.forecast(x, 5, 4000)["x"]
    viewed = model.read(x)
    for h in range(5):
        steps = h + 1 if lag == 1 else 1  # increments since the last value
        last = x[:, -1, 0] if lag == 1 else x[:, (8 + h) % lag : 6 : lag, 0].mean(1) if lag else 0.0
        state = viewed["x_state"][:, :3, 0].unbind(1)
        weight = prior.weight + state[0]
        mean = prior.mean + state[1] / weight
        variance = (prior.freedom * prior.variance + state[2] - state[1] ** 2 / weight) / (prior.freedom + state[0])
        scale = (steps * variance * (1 + 1 / weight)).sqrt()
        error = (draws[:, :, h, 0].mean(0) - (last + steps * mean)) / scale * math.sqrt(4000)
        assert error.abs().max() < 4.5
        torch.testing.assert_close(draws[:, :, h, 0].std(0) / scale, torch.ones_like(scale), atol=0.05, rtol=0)


def test_float32_models_forecast_series_far_from_zero():
    """Location and scale stay in float64, so a series of small changes around a large level is forecast exactly."""
    prior = SeriesPrior(0.0, 1.0, 1e-4, 5.0, 1e6, 1e3)
    model = white_noise(SeriesUnits((prior,), 1, 6)).float()
    x = 1e6 + torch.arange(8, dtype=torch.float64)[None, :, None] * 1e-3
    mean = model.forecast(x, 3, 1, draw_emission=False)["x"][0]
    assert (mean - x[:, -1:]).abs().max() < 0.1


def test_a_view_for_other_sizes_is_refused():
    with pytest.raises(ValueError, match="priors of 2 coordinates, but x has 1"):
        white_noise(SeriesUnits((REAL, REAL)))
