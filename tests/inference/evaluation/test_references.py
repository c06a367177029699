"""Reference forecasts checked by hand: last value, last season, mean and climatology."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dvae.data.sequences import ArrayWindows
from dvae.inference.evaluation.evaluate import evaluate
from dvae.inference.evaluation.evaluation_windows import prepare_windows
from dvae.inference.evaluation.references import References, climatology, last_value, seasonal

HORIZON = 5


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def windows(count=12, seed=0, gaps=False, **options):
    x = draw(count, 7 + HORIZON, 2, seed=seed)
    mask = torch.rand(x.shape, generator=torch.Generator().manual_seed(seed)) < 0.7
    mask[:, ::3] = True
    return ArrayWindows(x, 7, columns={"a": "m", "b": ""}, mask=mask if gaps else None, **options)


def run(test_windows, **options):
    return evaluate({}, test_windows, **({"samples": 4, "progress": False} | options))


@pytest.mark.parametrize("season", [1, 2, 3, 5, 7])
def test_seasonal_forecasts_repeat_the_value_a_whole_number_of_periods_before(season):
    x = draw(3, 7, 2)
    (forecast,) = seasonal(x, HORIZON, season)
    for n, h, d in np.ndindex(3, HORIZON, 2):
        t = 7 + h
        while t >= 7:
            t -= season
        assert forecast[n, h, d] == x[n, t, d]
    if season == 1:
        assert torch.equal(forecast, last_value(x, HORIZON)[0])


def test_a_value_missing_in_the_last_season_comes_from_an_earlier_one():
    x, mask = draw(20, 11, 2), torch.rand(20, 11, 2, generator=torch.Generator().manual_seed(0)) < 0.6
    (forecast,) = seasonal(torch.where(mask, x, torch.nan), 6, 3, mask)
    assert torch.equal(forecast[:, :3], forecast[:, 3:])
    assert forecast.isfinite().all()
    earlier = 0
    for n, phase, d in np.ndindex(20, 3, 2):
        observed_steps = [t for t in (8 + phase, 5 + phase, 2 + phase) if mask[n, t, d]]
        if observed_steps:
            assert forecast[n, phase, d] == x[n, observed_steps[0], d]
            earlier += observed_steps[0] < 8
    assert earlier > 10
    steady = torch.arange(6.0)[None, :, None]
    mask_without_third = torch.tensor([1, 1, 0, 1, 1, 0]).bool()[None, :, None]
    last = seasonal(steady.where(mask_without_third, torch.nan), 3, 3, mask_without_third).flatten()
    assert last.tolist() == [3, 4, 4]  # the third step was never observed, so the one before is repeated


def test_climatology_draws_new_futures_for_each_window():
    futures = torch.arange(6.0)[:, None, None].expand(6, 3, 2)
    forecaster = climatology(futures, 1000, 30, seed=1)
    draws = forecaster(slice(0, 1000))
    assert draws.shape == (30, 1000, 3, 2)
    assert torch.equal(torch.cat([forecaster(slice(0, 300)), forecaster(slice(300, 1000))], 1), draws)
    assert (draws == draws[:, :, :1, :1]).all()  # a future is one contiguous draw
    shares = draws[:, :, 0, 0].flatten().int().bincount() / 30_000
    assert (shares - 1 / 6).abs().max() < 5 * (5 / 36 / 30_000) ** 0.5
    assert len({tuple(row) for row in draws[:, :, 0, 0].T.tolist()}) > 990
    assert not torch.equal(climatology(futures, 1000, 30, seed=2)(slice(0, 1000)), draws)


def test_the_mean_forecast_averages_observed_values_of_each_column():
    training = windows(30, seed=1, gaps=True)
    count, forecaster = References(prepare_windows(windows()), 9, training=training)["mean"]
    forecast = forecaster(slice(2, 5))
    assert (count, forecast.shape) == (1, (1, 3, HORIZON, 2))
    for d in range(2):
        expected = training.x[..., d][training.mask[..., d]].mean()
        torch.testing.assert_close(forecast[..., d], expected.expand(1, 3, HORIZON))


@pytest.mark.parametrize("gaps", [False, True])
def test_windows_have_all_references_whose_needs_are_met(gaps):
    test, train = windows(gaps=gaps, season=4), windows(9, seed=1, gaps=gaps)
    result = run(test, training_windows=train, samples=20)
    rows = result.rows
    expected = {"last value": 1, "seasonal": 1, "mean": 1, "climatology": 20, "nearest neighbours": 9}
    assert {name: row.samples for name, row in rows.items()} == expected
    assert result["last value"] == run(replace(test, columns=None))["last value"]
    assert list(run(test).rows) == ["last value", "seasonal"]
    assert list(run(replace(test, season=8)).rows) == ["last value"]  # of 7 observed frames
    assert list(run(replace(test, season=8), season=7).rows) == ["last value", "seasonal"]
    with pytest.raises(ValueError, match="expected at least one model, forecast or reference to score"):
        run(test, references=False)


def test_references_are_selected_by_name_or_are_errors():
    test, train = windows(), windows(9, seed=1)
    names = ["nearest neighbours", "last value", "seasonal"]
    assert list(run(test, references=names, training_windows=train, season=3).rows) == names
    for options, message in (
        ({"references": ["season"]}, r"no reference row 'season' \(did you mean 'seasonal'\?\); there are last"),
        ({"references": ["seasonal"]}, "'seasonal' needs a season between 1 and the 7 observed steps$"),
        ({"references": ["seasonal"], "season": 9}, "between 1 and the 7 observed steps, got 9"),
        ({"references": ["mean"]}, "'mean' needs training windows"),
    ):
        with pytest.raises(ValueError, match=message):
            run(test, **options)
