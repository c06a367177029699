"""Forecasts of simple methods for tables: calibrated by simulation, blind to the future, and valid for every family."""

import numpy as np
import pytest
import torch

import dvae
from dvae.inference.evaluation import baselines
from dvae.inference.evaluation.evaluation_windows import prepare_windows
from dvae.inference.evaluation.references import References
from dvae.inference.evaluation.scores import calibrated
from dvae.tables import Column, Columns, Cut, Panel, PanelData

METHODS = ("last value", "drift", "seasonal", "climatology", "climatology by series", "AR", "ETS", "GLM")


def table(series, *families, **cut):
    columns = Columns(tuple(Column(f"y{n}", family=family) for n, family in enumerate(families or ("real",))))
    cut = {"observed": 20, "horizon": 5, "split": "time"} | cut
    return PanelData.of([np.asarray(one).reshape(len(one), -1) for one in series], columns, Cut(**cut))


def references(data, samples=60, **options):
    return References(prepare_windows(data), samples, **options)


def draws(data, name, samples=60, **options):
    rows = references(data, samples, **options)
    count, forecaster = rows[name]
    assert count == samples
    return forecaster(slice(0, len(rows.held.x)))


def random_walks(rng, count=60, steps=100):
    scales = np.exp(rng.normal(0, 1, count))
    return [s * (rng.normal(0, 9) + rng.normal(size=steps).cumsum()) for s in scales]


def autoregressive(rng, count=60, steps=100, coefficient=0.8, lag=1):
    y = rng.normal(size=(count, steps + 200))
    for t in range(lag, steps + 200):
        y[:, t] += coefficient * y[:, t - lag]
    return list(y[:, 200:] + rng.normal(0, 5, (count, 1)))


def seasonal_series(rng, count=60, steps=100):
    phase = 2 * np.pi * np.arange(steps) / 4
    return [rng.normal(0, 5) + 3 * np.sin(phase + rng.uniform(0, 6)) + rng.normal(size=steps) for _ in range(count)]


def geometric(rng, count=60, steps=100):
    return [np.exp(rng.normal(0, 3) + 0.1 * rng.normal(size=steps).cumsum()) for _ in range(count)]


SIMULATED = {
    "random walk": (random_walks, "real", None, ("last value", "drift", "AR", "ETS")),
    "AR(1)": (autoregressive, "real", None, ("last value", "AR", "climatology by series")),
    "seasonal": (seasonal_series, "real", 4, ("last value", "seasonal", "AR")),
    "geometric random walk": (geometric, "positive", None, ("last value", "drift", "AR")),
}


@pytest.mark.parametrize("split", ["time", "sequence"])
@pytest.mark.parametrize("kind", SIMULATED)
def test_intervals_cover_at_their_level(kind, split):
    simulate, family, season, names = SIMULATED[kind]
    if "ETS" in names:
        pytest.importorskip("statsmodels")
    if split == "sequence":  # 20 steps are few for the second, and the first is slow
        names = [name for name in names if name not in ("ETS", "climatology by series")]
    data = table(simulate(np.random.default_rng(1), count=90), family, split=split, season=season, test=0.3)
    options = {"references": names, "samples": 99, "scores": calibrated, "progress": False}
    scores = dvae.evaluate({}, data, **options)
    for name in names:
        covered = scores[name]["coverage 90 %"]
        assert abs(covered.mean - 0.9) < 0.02 + 2.5 * covered.standard_error, (name, covered)


def test_errors_of_a_long_series_are_its_own():
    rng = np.random.default_rng(0)
    heavy = (rng.random(600) < 0.05) * rng.choice([-1.0, 1.0], 600)  # at most single changes by 1
    data = table([heavy.cumsum(), *random_walks(rng, 3, 600)])
    rows = references(data)
    first = [key[1] == "0" for key in rows.held.keys]
    changes = (rows["last value"][1](slice(0, len(first))) - rows.held.x[:, 19:20])[:, first]
    torch.testing.assert_close(changes, changes.round())


@pytest.mark.filterwarnings("ignore:.*varies by less than float32 resolves:UserWarning")
def test_scales_of_unseen_series_may_differ_by_orders_of_magnitude():
    rng = np.random.default_rng(3)
    data = table([10.0 ** (n % 7) * one for n, one in enumerate(random_walks(rng, 120))], split="sequence", test=0.4)
    rows = references(data, 99)
    forecast = rows["last value"][1](slice(0, len(rows.held.x)))
    lower, upper = (forecast.quantile(level, 0) for level in (0.05, 0.95))
    covered = ((lower <= rows.held.futures) & (rows.held.futures <= upper)).double().mean((1, 2))
    large = torch.tensor([int(key[1]) % 7 > 3 for key in rows.held.keys])
    assert abs(covered[large].mean() - 0.9) < 0.06
    assert abs(covered[~large].mean() - 0.9) < 0.06


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("split", ["time", "sequence"])
def test_forecasts_ignore_the_future_and_the_unseen_past(name, split):
    if name == "ETS":
        pytest.importorskip("statsmodels")
    rng = np.random.default_rng(2)
    counts = [rng.poisson(4, 60).astype(float) for _ in range(10)]
    data = table(counts, "overdispersed", split=split, season=5)
    training = data.windows("train")
    rows = references(data.windows("test"), training=training)
    row = len(rows.held.keys) - 1
    _, series, start = rows.held.keys[row]
    changed = [one.copy() for one in counts]
    changed[int(series)][start + 20 :] += 50
    if split == "sequence":
        changed[int(series)][:start] += 50
    changed_rows = References(
        prepare_windows(data.with_data([x[:, None] for x in changed]).windows("test")), 60, 0, training
    )
    part = slice(row, row + 1)
    torch.testing.assert_close(changed_rows[name][1](part), rows[name][1](part), rtol=0, atol=0)


def test_drift_adds_the_mean_change_of_the_whole_series():
    y = np.random.default_rng(0).normal(size=100).cumsum()
    rows = references(table([y]))
    means = rows._baselines._drift(rows._baselines.held)
    assert len(means) > 2
    for mean, (_, _, start) in zip(means[..., 0], rows.held.keys, strict=True):
        end = start + 20
        np.testing.assert_allclose(mean, y[end - 1] + np.arange(1, 6) * (y[end - 1] - y[0]) / (end - 1))
    lines = draws(table([3.0 * np.arange(100), 7 - np.arange(100.0)]), "drift")
    truth = prepare_windows(table([3.0 * np.arange(100), 7 - np.arange(100.0)])).futures
    torch.testing.assert_close(lines, truth.expand_as(lines))


def test_own_past_draws_only_values_before_the_forecast():
    data = table([np.arange(100.0), 1000 + np.arange(100.0)])
    forecast, keys = draws(data, "climatology by series"), prepare_windows(data).keys
    for row, (_, series, start) in enumerate(keys):
        values = forecast[:, row] - 1000 * int(series)
        assert 0 <= values.min() <= values.max() < start + 20
        steps = values[:, 1:] - values[:, :-1]
        assert ((steps == 1) | (steps == 1 - (start + 20))).all()  # consecutive, or from the end to the start


FAMILIES = ("real", "positive", "overdispersed", "share", "angle", "power")


@pytest.mark.parametrize("missing", [0.0, 0.4])
@pytest.mark.parametrize("split", ["time", "sequence"])
def test_draws_are_valid_for_every_family(missing, split):
    rng = np.random.default_rng(5)
    series = []
    for _ in range(12):
        normal = rng.normal(size=60)
        columns = [normal, np.exp(normal), rng.poisson(3, 60), 1 / (1 + np.exp(normal)), np.tanh(normal) * 3]
        columns += [normal.clip(0), rng.integers(0, 2, 60), rng.integers(0, 3, 60)]
        values = np.stack(columns, 1).astype(float)
        values[rng.random(values.shape) < missing] = np.nan
        series.append(values)
    specs = [Column(family, family=family) for family in (*FAMILIES, "binary")]
    category = Column("kind", family="category", classes=("a", "b", "c"))
    data = PanelData.of(Panel.of(series, Columns((*specs, category))), cut=Cut(20, 5, split=split, season=4))
    rows = references(data, 30)
    assert {*METHODS} - {"ETS"} < {*rows.usual}
    for name in rows.usual:
        if name == "nearest neighbours":  # it interpolates missing values
            continue
        forecast = rows[name][1](slice(0, len(rows.held.x)))
        assert forecast.isfinite().all()
        real, positive, counts, share, angle, power, binary, *kinds = forecast.unbind(-1)
        assert (positive > 0).all()
        assert ((counts >= 0) & (counts == counts.round())).all()
        assert ((share > 0) & (share < 1) & (angle.abs() <= torch.pi) & (power >= 0)).all()
        assert ((binary == 0) | (binary == 1)).all()
        assert (torch.stack(kinds).sum(0) == 1).all()
        if name in ("last value", "drift", "seasonal", "AR", "climatology by series"):
            assert real.std(0).min() > 0


def test_the_last_value_is_the_last_observed_one():
    y = np.arange(100.0)
    y[[77, 78, 79]] = np.nan
    rows = references(table([y, *random_walks(np.random.default_rng(0), 3)]))
    row = rows.held.keys.index(("test", "0", 60))
    assert rows._baselines._last(rows._baselines.held)[row] == 76
    assert rows._baselines._drift(rows._baselines.held)[row, :, 0].tolist() == [80, 81, 82, 83, 84]


def test_smoothing_is_left_out_with_a_note(monkeypatch):
    walks = random_walks(np.random.default_rng(0), 12, 60)
    options = {"progress": False, "samples": 5}
    monkeypatch.setattr(baselines, "find_spec", lambda name: name)  # as if statsmodels were installed
    short = dvae.evaluate({}, table(walks, split="sequence", observed=6), **options)
    assert "ETS" not in short.rows
    assert any("ETS was left out: it needs at least 10 steps before each forecast" in note for note in short.notes)
    monkeypatch.setattr(baselines, "find_spec", lambda name: None)
    scores = dvae.evaluate({}, table(walks), **options)
    assert list(scores.rows) == [
        "last value",
        "drift",
        "climatology",
        "climatology by series",
        "AR",
        "nearest neighbours",
    ]
    assert any("statsmodels (pip install" in note for note in scores.notes)
    assert not any("ETS" in note for note in dvae.evaluate({}, table(walks), references=["drift"], **options).notes)
    with pytest.raises(ValueError, match=r"'ETS' needs statsmodels"):
        dvae.evaluate({}, table(walks), references=["ETS"], **options)
    with pytest.raises(ValueError, match="'GLM' needs a column of counts"):
        dvae.evaluate({}, table(walks), references=["GLM"], **options)


def test_arrays_have_point_forecasts_by_default_and_draws_by_name():
    x = torch.from_numpy(np.stack(random_walks(np.random.default_rng(0), 40, 12))[..., None])
    test, train = dvae.ArrayWindows(x[:20], 8), dvae.ArrayWindows(x[20:], 8)
    options = {"training_windows": train, "samples": 7, "progress": False}
    rows = dvae.evaluate({}, test, **options).rows
    expected = {"last value": 1, "mean": 1, "climatology": 7, "nearest neighbours": 7}
    assert {name: row.samples for name, row in rows.items()} == expected
    named = dvae.evaluate({}, test, references=["drift", "AR", "climatology by series"], **options)
    assert all(row.samples == 7 for row in named.rows.values())
    with pytest.raises(ValueError, match="training windows have 10 steps, expected the 12"):
        dvae.evaluate({}, test, references=["drift"], training_windows=x[20:, :10], progress=False)
