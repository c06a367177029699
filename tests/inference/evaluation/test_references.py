"""Reference rows of any data by hand: the last value, the last season, the mean, and the climate."""

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


def run(held, **options):
    return evaluate({}, held, **({"samples": 4, "progress": False} | options))


@pytest.mark.parametrize("season", [1, 2, 3, 5, 7])
def test_a_season_is_what_was_there_a_whole_number_of_periods_before(season):
    x = draw(3, 7, 2)
    (found,) = seasonal(x, HORIZON, season)
    for n, h, d in np.ndindex(3, HORIZON, 2):
        t = 7 + h
        while t >= 7:
            t -= season
        assert found[n, h, d] == x[n, t, d]
    if season == 1:
        assert torch.equal(found, last_value(x, HORIZON)[0])


def test_a_value_that_the_last_season_lacks_is_that_of_an_earlier_one():
    x, mask = draw(20, 11, 2), torch.rand(20, 11, 2, generator=torch.Generator().manual_seed(0)) < 0.6
    (found,) = seasonal(torch.where(mask, x, torch.nan), 6, 3, mask)
    assert torch.equal(found[:, :3], found[:, 3:])
    assert found.isfinite().all()
    earlier = 0
    for n, phase, d in np.ndindex(20, 3, 2):
        seen = [t for t in (8 + phase, 5 + phase, 2 + phase) if mask[n, t, d]]
        if seen:
            assert found[n, phase, d] == x[n, seen[0], d]
            earlier += seen[0] < 8
    assert earlier > 10
    steady = torch.arange(6.0)[None, :, None]
    lacking = torch.tensor([1, 1, 0, 1, 1, 0]).bool()[None, :, None]
    last = seasonal(steady.where(lacking, torch.nan), 3, 3, lacking).flatten()
    assert last.tolist() == [3, 4, 4]  # no third step was ever observed: it stays at the one before


def test_climatology_draws_futures_for_each_window_anew():
    futures = torch.arange(6.0)[:, None, None].expand(6, 3, 2)
    forecaster = climatology(futures, 1000, 30, seed=1)
    found = forecaster(slice(0, 1000))
    assert found.shape == (30, 1000, 3, 2)
    assert torch.equal(torch.cat([forecaster(slice(0, 300)), forecaster(slice(300, 1000))], 1), found)
    assert (found == found[:, :, :1, :1]).all()  # a future is drawn whole
    shares = found[:, :, 0, 0].flatten().int().bincount() / 30_000
    assert (shares - 1 / 6).abs().max() < 5 * (5 / 36 / 30_000) ** 0.5
    assert len({tuple(row) for row in found[:, :, 0, 0].T.tolist()}) > 990
    assert not torch.equal(climatology(futures, 1000, 30, seed=2)(slice(0, 1000)), found)


def test_the_mean_is_of_every_column_where_it_was_observed():
    training = windows(30, seed=1, gaps=True)
    count, forecaster = References(prepare_windows(windows()), 9, training=training)["mean"]
    found = forecaster(slice(2, 5))
    assert (count, found.shape) == (1, (1, 3, HORIZON, 2))
    for d in range(2):
        expected = training.x[..., d][training.mask[..., d]].mean()
        torch.testing.assert_close(found[..., d], expected.expand(1, 3, HORIZON))


@pytest.mark.parametrize("gaps", [False, True])
def test_windows_that_name_their_columns_have_the_references_of_tables(gaps):
    held, known = windows(gaps=gaps, season=4), windows(9, seed=1, gaps=gaps)
    result = run(held, training_windows=known, samples=20)
    rows = result.rows
    expected = {"last value": 1, "seasonal": 1, "mean": 1, "climatology": 20, "nearest neighbours": 9}
    assert {name: row.samples for name, row in rows.items()} == expected
    bare = replace(held, columns=None)
    assert list(run(bare, training_windows=known).rows) == ["last value", "nearest neighbours"]
    assert result["last value"] == run(bare)["last value"]
    assert list(run(held).rows) == ["last value", "seasonal"]
    assert list(run(replace(held, season=8)).rows) == ["last value"]  # of 7 observed frames
    assert list(run(replace(held, season=8), season=7).rows) == ["last value", "seasonal"]
    assert run(held, references=False).rows == {}


def test_references_are_had_by_name_or_say_what_they_need():
    held, known = windows(), windows(9, seed=1)
    asked = ["nearest neighbours", "last value", "seasonal"]
    assert list(run(held, references=asked, training_windows=known, season=3).rows) == asked
    for options, message in (
        ({"references": ["season"]}, r"no reference row 'season' \(did you mean 'seasonal'\?\); there are last"),
        ({"references": ["seasonal"]}, "'seasonal' needs a season between 1 and the 7 observed frames$"),
        ({"references": ["seasonal"], "season": 9}, "between 1 and the 7 observed frames, got 9"),
        ({"references": ["mean"]}, "'mean' needs training windows"),
    ):
        with pytest.raises(ValueError, match=message):
            run(held, **options)
