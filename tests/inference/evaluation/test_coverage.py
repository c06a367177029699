"""Coverage, PIT and sharpness: exact for any number of samples, ties and missing values, clustered by sequence."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import dvae
from dvae.data.batch import Batch
from dvae.data.sequences import ArrayWindows
from dvae.inference.diagnostics.calibration import envelope
from dvae.inference.evaluation.evaluate import evaluate
from dvae.inference.evaluation.evaluation import Evaluation, Row
from dvae.inference.evaluation.metrics import coverage, pit_histogram, pit_mean, pit_variance
from dvae.inference.evaluation.metrics import probability_integral_transform as pit
from dvae.inference.evaluation.scores import CRPS, LEVELS, by_column, calibrated, coverage_at


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def uniform(*shape, seed=9):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


# ------------------------------------------------------------------------------------------------------ by enumeration


@given(st.lists(st.integers(0, 4), min_size=2, max_size=9), st.floats(0.01, 0.99), st.integers(1, 12))
def test_coverage_has_the_level_on_average_over_exchangeable_numbers_with_ties(numbers, level, bins):
    """By exchangeability, each of K + 1 numbers in turn is the truth and the others are the samples."""
    values = torch.tensor(numbers).double()
    truth = values[:, None, None]
    samples = torch.stack([values[torch.arange(len(values)) != n] for n in range(len(values))])[..., None, None]
    assert coverage(samples, truth, level).mean() == pytest.approx(level, abs=1e-12)
    assert pit_mean(samples, truth).mean() == pytest.approx(0.5, abs=1e-12)
    assert pit_variance(samples, truth).mean() == pytest.approx(1, abs=1e-12)
    torch.testing.assert_close(pit_histogram(samples, truth, bins).mean(0), torch.full((bins,), 1 / bins).double())


# -------------------------------------------------------------------------------------------------------- invariance


CALIBRATION = {
    "coverage": lambda x, y: coverage(x, y, 0.8),
    "mean": pit_mean,
    "variance": pit_variance,
    "histogram": pit_histogram,
}


@pytest.mark.parametrize("score", CALIBRATION)
def test_calibration_depends_on_ranks_of_observed_values_only(score):
    function = CALIBRATION[score]
    samples, truth = draw(3, 2, 25, 6, 4), draw(3, 2, 6, 4, seed=1)
    score_values = function(samples, truth)
    assert score_values.shape[:2] == (3, 2)
    shuffled = samples[:, :, torch.randperm(25, generator=torch.Generator().manual_seed(0))]
    torch.testing.assert_close(function(shuffled, truth), score_values)
    torch.testing.assert_close(function(samples.exp(), truth.exp()), score_values)
    torch.testing.assert_close(function(samples.numpy(), truth.numpy()), score_values)
    torch.testing.assert_close(function(samples[1, 0], truth[1, 0]), score_values[1, 0])
    mirrored = {"mean": 1 - score_values, "histogram": score_values.flip(-1)}.get(score, score_values)
    torch.testing.assert_close(function(-samples, -truth), mirrored)
    gaps = truth.clone()
    gaps[..., 2, :], gaps[..., 3] = torch.nan, torch.nan
    frames, columns = [0, 1, 3, 4, 5], [0, 1, 2]
    observed = samples[..., frames, :][..., columns], truth[..., frames, :][..., columns]
    torch.testing.assert_close(function(samples, gaps), function(*observed))
    gaps[0, 0] = torch.nan
    assert function(samples, gaps)[0, 0].isnan().all()
    missing = pit(samples, gaps, uniform(*truth.shape))
    assert torch.equal(missing.isnan(), gaps.isnan())


# -------------------------------------------------------------------------------------------------------- evaluation


@pytest.fixture(scope="module")
def truth():
    """Return a model and windows of sequences that it drew; three windows of each clip share a past."""
    model = dvae.linear_gaussian_surrogate(
        "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})", {"z": 1, "x": 2}, 6, scale=0.9
    )
    dvae.Oracle(model, 6).fit_guide()
    with torch.random.fork_rng():
        torch.manual_seed(0)
        x = model.sample(300, 6)["x"]
    return model, ArrayWindows(x, 1, groups=[str(n // 3) for n in range(300)], columns={"speed": "m/s", "load": "m/s"})


@pytest.fixture(scope="module")
def scored(truth):
    model, windows = truth
    return evaluate({"exact": model}, windows, scores=calibrated, progress=False, training_windows=windows)


def test_forecasts_of_the_true_model_are_calibrated(scored):
    row = scored["exact"]
    expected = {coverage_at(level).name: level for level in LEVELS} | {"PIT mean": 0.5, "PIT variance": 1}
    assert {*expected, "energy score", "variogram score", "CRPS", "width 90 %"} <= row.keys()
    for name, value in expected.items():
        assert abs(row[name].mean - value) < 4 * row[name].standard_error, name
    assert scored.emission == "drawn"  # means were not requested
    _, departs, low, high = scored.departure("exact")
    assert ((low <= departs) & (departs <= high)).all()


def test_rows_with_too_few_forecasts_have_no_intervals_and_a_note(truth, scored):
    model, windows = truth
    assert not {"coverage 50 %", "PIT mean"} & scored["last value"].keys()
    assert not scored.rows["last value"].histograms
    assert {"coverage 95 %", "PIT mean"} <= scored["climatology"].keys()
    few = evaluate(model, windows, scores=calibrated, samples=10, references=False, progress=False)
    assert {"coverage 50 %", "coverage 80 %"} <= few["model"].keys()
    assert not {"coverage 90 %", "coverage 95 %", "PIT mean"} & few["model"].keys()
    note = "left out, with the number of forecasts that they need, more than 10: coverage 90 % (19), coverage 95 % (39)"
    assert note in " ".join(few.notes)
    with pytest.raises(KeyError, match="histogram"):
        few.departure("model")


def test_histograms_are_stored_and_drawn(scored):
    again = Evaluation.from_json(scored.to_json())
    assert again.to_json() == scored.to_json()
    for counts, loaded_counts in zip(scored.departure("exact"), again.departure("exact"), strict=True):
        np.testing.assert_allclose(counts, loaded_counts)
    figure = again.plot_calibration()
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert titles == ["climatology, K = 50", "nearest neighbours, K = 50", "exact, K = 50"]
    assert "PIT mean (share)" in str(scored)
    assert "0–5" not in str(scored)
    single = replace(scored, clusters={"one": 300}, rows={"a": Row(50, {}, histograms={"PIT": np.full((1, 20), 0.05)})})
    assert np.isnan(single.departure("a")[2]).all()
    single.plot_calibration()


COLUMNS = {"a": "m", "b": "s"}


def test_a_score_by_column_equals_the_score_of_that_column_alone(truth):
    measure, (_, windows) = CRPS, truth
    mask = torch.ones_like(windows.x, dtype=torch.bool)
    mask[::2, 3:, 1] = False
    both = replace(windows, mask=mask, columns=None)

    def run(windows, scores):
        options = {"samples": 30, "references": ["climatology"], "training_windows": windows}
        return evaluate({}, windows, scores=lambda _: scores, progress=False, **options)["climatology"]

    result = run(both, by_column(measure, COLUMNS))
    for place, name in enumerate(COLUMNS):
        column = slice(place, place + 1)
        expected = run(replace(both, x=windows.x[..., column], mask=mask[..., column]), [measure])[measure.name]
        score = result[f"{measure.name}, {name}"]
        assert score.mean == pytest.approx(expected.mean, rel=1e-9)
        assert score.standard_error == pytest.approx(expected.standard_error, rel=1e-9)
    (one,) = by_column(measure, {"a": "m"})
    arguments = draw(6, 4, 5, 1), draw(6, 5, 1), Batch(x=draw(6, 2, 1)), torch.arange(6)
    assert torch.equal(one.function(*arguments), measure.function(*arguments))


# ------------------------------------------------------------------------------------------------------------ clusters


def histogram(ranks, clips):
    """Return an evaluation with these PIT values (N, numbers)."""
    places = list(dict.fromkeys(clips))
    shares = (np.minimum(20 * ranks, 19).astype(int)[..., None] == np.arange(20)).mean(1)
    cluster_index = np.array([places.index(clip) for clip in clips])
    means = tuple(tuple(shares[cluster_index == place].mean(0)) for place in range(len(places)))
    data = {"windows": len(ranks), "steps": 1 + ranks.shape[1], "coordinates": 1, "fingerprint": "f" * 64}
    counts = {str(place): int((cluster_index == place).sum()) for place in range(len(places))}
    rows = {"a": Row(50, {}, histograms={"PIT": np.array(means)})}
    return Evaluation(rows, {}, counts, data, {"observed": 1}, 50, "drawn", 0, 0)


def test_with_one_number_per_clip_the_band_is_the_exact_envelope():
    random = np.random.default_rng(0)
    points, departs, low, high = histogram(random.random((40, 1)), range(40)).departure("a")
    exact = envelope(40, 19)
    np.testing.assert_allclose(points, exact[0])
    np.testing.assert_allclose([low + points, high + points], exact[1:])
    assert departs.shape == (19,)
