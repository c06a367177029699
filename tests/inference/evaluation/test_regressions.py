"""Regressions behind simple forecasts: coefficients that simulations were made with, and published software."""

import numpy as np
import pytest
import torch

from dvae.inference.evaluation.evaluation_windows import prepare_windows
from dvae.inference.evaluation.references import References
from dvae.inference.evaluation.regressions import (
    autoregression,
    autoregressive_means,
    carried,
    fill_missing,
    negative_binomial,
    smoothed,
)
from dvae.tables import Column, Columns, Cut, PanelData


def simulate(coefficients, count=400, steps=60, seed=0):
    """Return autoregressive series (N, T, 1) with unit errors, from {lag: coefficient}."""
    y = torch.randn(count, steps + 300, 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    for t in range(max(coefficients), steps + 300):
        for lag, coefficient in coefficients.items():
            y[:, t] += coefficient * y[:, t - lag]
    return y[:, 300:]


@pytest.mark.parametrize(
    ("coefficients", "season"), [({1: 0.7}, None), ({1: 0.7}, 7), ({1: 0.4, 2: 0.3}, None), ({1: 0.3, 7: 0.5}, 7)]
)
def test_autoregression_recovers_its_coefficients(coefficients, season):
    z = simulate(coefficients)
    lags, estimates = autoregression(z, torch.zeros(len(z), 1).double(), 40, season)
    for lag, estimate in zip(lags, estimates[:, 0].tolist(), strict=False):
        assert estimate == pytest.approx(coefficients.get(lag, 0.0), abs=0.05), lag
    assert coefficients.keys() <= {*lags}
    assert max(lags) <= (2 * season if season in coefficients else len(coefficients) + 1)


def test_means_follow_the_recursion():
    lags, coefficients = (1, 3), torch.tensor([[0.5], [0.25], [1.0], [2.0]]).double()
    z, slope = torch.arange(5.0)[None, :, None].double(), torch.tensor([[0.1]]).double()
    x = [0.0, 1, 2, 3, 4]
    for _ in range(4):
        x.append(0.5 * x[-1] + 0.25 * x[-3] + 1 + 2 * 0.1)
    torch.testing.assert_close(autoregressive_means(lags, coefficients, z, slope, 4).flatten().tolist(), x[5:])


def test_draws_of_an_autoregression_have_the_analytic_deviation():
    z = simulate({1: 0.8}, count=60, steps=200)[..., 0].numpy()
    data = PanelData.of(list(z[..., None]), Columns((Column("y"),)), Cut(50, 6, split="time"))
    rows = References(prepare_windows(data), 400)
    means = rows._baselines
    forecast = rows["AR"][1](slice(0, len(means.held.x)))
    deviations = forecast.var(0).mean((0, 2)).sqrt()
    expected = ((1 - 0.64 ** torch.arange(1, 7)) / (1 - 0.64)).sqrt().double()
    torch.testing.assert_close(deviations, expected, rtol=0.08, atol=0)


@pytest.mark.parametrize("dispersion", [0.0, 0.5])
def test_count_regression_recovers_its_coefficients(dispersion):
    rng, truth = np.random.default_rng(0), np.array([0.5, 0.8, -0.4])
    x = np.stack([np.ones(20_000), rng.normal(size=20_000), rng.integers(0, 2, 20_000)], 1)
    mean = np.exp(x @ truth)
    y = rng.poisson(mean * (rng.gamma(1 / dispersion, dispersion, mean.shape) if dispersion else 1.0))
    coefficients, estimate = negative_binomial(torch.from_numpy(x), torch.from_numpy(y).double())
    np.testing.assert_allclose(coefficients, truth, atol=0.04)
    assert estimate == pytest.approx(dispersion, abs=0.03)


def test_count_regression_agrees_with_statsmodels():
    statsmodels = pytest.importorskip("statsmodels.api")
    rng = np.random.default_rng(1)
    x = np.stack([np.ones(500), rng.normal(size=500)], 1)
    y = rng.poisson(np.exp(x @ [1.0, 0.5]) * rng.gamma(2, 0.5, 500))
    coefficients, dispersion = negative_binomial(torch.from_numpy(x), torch.from_numpy(y).double())
    family = statsmodels.families.NegativeBinomial(alpha=dispersion)
    fit = statsmodels.GLM(y, x, family=family).fit()
    np.testing.assert_allclose(coefficients, fit.params, atol=1e-5)
    assert fit.pearson_chi2 / fit.df_resid == pytest.approx(1, abs=1e-4)


def test_rare_counts_do_not_break_the_regression():
    x = torch.ones(200, 1).double()
    coefficients, dispersion = negative_binomial(x, torch.zeros(200).double())
    assert coefficients.isfinite().all()
    assert dispersion >= 0
    assert coefficients.exp() < 1e-3


@pytest.mark.filterwarnings("ignore:.*failed to converge")
@pytest.mark.parametrize(("season", "steps"), [(None, 60), (4, 60), (4, 7), (30, 35)])
def test_smoothing_agrees_with_statsmodels(season, steps):
    ets = pytest.importorskip("statsmodels.tsa.exponential_smoothing.ets")
    steps = max(steps, 10)
    y = np.random.default_rng(0).normal(size=steps).cumsum() + np.sin(np.arange(steps) * np.pi / 2)
    means, fitted = smoothed(y, season, 5)
    period = season if season and steps >= max(2 * season, season + 10) else None
    options = {"seasonal": "add", "seasonal_periods": period} if period else {}
    model = ets.ETSModel((y - y.mean()) / y.std(), error="add", trend="add", damped_trend=True, **options)
    np.testing.assert_allclose(means, y.mean() + y.std() * model.fit(disp=False).forecast(5), rtol=1e-6)
    longer = np.concatenate([y, y[:3]])
    scaled = ets.ETSModel((longer - fitted[0]) / fitted[1], error="add", trend="add", damped_trend=True, **options)
    expected = fitted[0] + fitted[1] * scaled.smooth(fitted[3]).forecast(5)
    np.testing.assert_allclose(smoothed(longer, season, 5, fitted)[0], expected)
    assert smoothed(np.full(12, 3.0), season, 4)[0].tolist() == [3.0] * 4


def test_missing_entries_are_carried_forward_or_completed_from_other_rows():
    nan = torch.nan
    x = torch.tensor([[nan, 1.0, nan, nan, 4.0]])[..., None]
    assert carried(x).flatten().tolist()[1:] == [1, 1, 1, 4]
    assert carried(x)[0, 0].isnan()
    errors = torch.randn(50, 4, generator=torch.Generator().manual_seed(0))
    missing = torch.rand(50, 4, generator=torch.Generator().manual_seed(1)) < 0.5
    filled = fill_missing(torch.where(missing, nan, errors))
    assert torch.equal(filled[~missing], errors[~missing])
    for column in range(4):
        assert {*filled[:, column].tolist()} == {*errors[~missing[:, column], column].tolist()}
    assert fill_missing(torch.full((3, 2), nan)).isnan().all()
