"""Coverage, PIT and sharpness: exact for every number of samples, with ties and gaps, and clustered by sequence."""

import json
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pyro import distributions as dist
from scipy import stats

import dvae
from dvae import distributions
from dvae.data.sequences import ArrayWindows
from dvae.inference.diagnostics.calibration import envelope
from dvae.inference.evaluation import metrics
from dvae.inference.evaluation.evaluate import evaluate
from dvae.inference.evaluation.evaluation import Evaluation, Row
from dvae.inference.evaluation.metrics import coverage, interval_width, pit_histogram, pit_mean, pit_variance
from dvae.inference.evaluation.metrics import probability_integral_transform as pit
from dvae.inference.evaluation.scores import (
    CRPS,
    ENERGY,
    LEVELS,
    PIT,
    by_column,
    calibrated,
    coverage_at,
    proper,
    width_at,
)
from dvae.inference.evaluation.uncertainty import effective_number, linearised

LAWS = {
    "normal": dist.Normal(torch.tensor(1.0).double(), 2.0),
    "Poisson": dist.Poisson(torch.tensor(1.5).double()),
    "Bernoulli": dist.Bernoulli(torch.tensor(0.1).double()),
}


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def exchangeable(law, count, windows, size=1, seed=0):
    """Samples (N, K, 1, D) and truths (N, 1, D) of one law."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        both = law.sample((windows, count + 1, 1, size))
    return both[:, 1:], both[:, 0]


def uniform(*shape, seed=9):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


# ------------------------------------------------------------------------------------------------------ by enumeration


@given(st.lists(st.integers(0, 4), min_size=2, max_size=9), st.floats(0.01, 0.99), st.integers(1, 12))
def test_whoever_is_the_truth_among_numbers_with_ties_coverage_is_the_level_on_the_mean(numbers, level, bins):
    """Exchangeability, enumerated: each of K + 1 numbers in turn is the truth of the others."""
    values = torch.tensor(numbers).double()
    truth = values[:, None, None]
    samples = torch.stack([values[torch.arange(len(values)) != n] for n in range(len(values))])[..., None, None]
    assert coverage(samples, truth, level).mean() == pytest.approx(level, abs=1e-12)
    assert pit_mean(samples, truth).mean() == pytest.approx(0.5, abs=1e-12)
    assert pit_variance(samples, truth).mean() == pytest.approx(1, abs=1e-12)
    torch.testing.assert_close(pit_histogram(samples, truth, bins).mean(0), torch.full((bins,), 1 / bins).double())


@pytest.mark.parametrize(
    ("count", "level", "place"), [(19, 0.9, 1), (19, 0.8, 2), (19, 0.5, 5), (3, 0.5, 1), (39, 0.95, 1)]
)
def test_intervals_run_between_order_statistics(count, level, place):
    samples, truth = draw(200, count, 1, 1), draw(200, 1, 1, seed=1)
    ordered = samples[:, :, 0, 0].sort(1).values
    low, high = ordered[:, place - 1], ordered[:, -place]
    inside = (low < truth[:, 0, 0]) & (truth[:, 0, 0] < high)
    torch.testing.assert_close(coverage(samples, truth, level), inside.double())
    torch.testing.assert_close(interval_width(samples, level), high - low)


@pytest.mark.parametrize(("count", "level"), [(20, 0.9), (7, 0.5), (50, 0.95), (2, 0.1), (4, 0.3)])
def test_widths_between_order_statistics_are_those_of_weibull_quantiles(count, level):
    samples = draw(5, count, 3, 2)
    ends = [np.quantile(samples, (1 + sign * level) / 2, axis=1, method="weibull") for sign in (-1, 1)]
    np.testing.assert_allclose(interval_width(samples, level), (ends[1] - ends[0]).mean((1, 2)))
    torch.testing.assert_close(interval_width(3 * samples - 1, level), 3 * interval_width(samples, level))


def test_beyond_all_samples_an_interval_is_the_range_of_them_and_covers_in_part():
    samples = torch.arange(9.0).double().reshape(1, 9, 1, 1)  # h = 10 * .05 / 2 = 1/4
    covered = [coverage(samples, torch.full((1, 1, 1), y).double(), 0.95).item() for y in (-1.0, 0.5, 7.5, 9.0)]
    assert covered == pytest.approx([0.75, 1, 1, 0.75])
    assert interval_width(samples, 0.95).item() == 8
    assert coverage(samples[:, :1], torch.full((1, 1, 1), 99.0).double(), 0.9).item() == pytest.approx(0.9)  # K = 1


# --------------------------------------------------------------------------------------------- draws of the same law


@pytest.mark.parametrize(
    ("law", "count", "level"),
    [
        (law, count, level)
        for m, law in enumerate(LAWS)
        for n, level in enumerate(LEVELS)
        for count in [(5, 19, 50)[(m + n) % 3]]
    ],
)
def test_truths_of_the_samples_law_are_covered_as_the_level_says(law, count, level):
    covered = coverage(*exchangeable(LAWS[law], count, 20_000), level)
    assert covered.mean().item() == pytest.approx(level, abs=4 * covered.std().item() / math.sqrt(20_000))


@pytest.mark.parametrize("law", LAWS)
def test_transforms_of_truths_of_the_samples_law_are_uniform(law):
    """Kolmogorov-Smirnov, at a level of 1e-3; without the draws those of discrete data are not."""
    samples, truth = exchangeable(LAWS[law], 7, 5000)
    random, middle = uniform(5000, 1, 1), torch.full((5000, 1, 1), 0.5).double()
    found = pit(samples, truth, random).flatten()
    assert stats.kstest(found, "uniform").pvalue > 1e-3
    assert stats.kstest(pit(samples, truth, middle).flatten(), "uniform").pvalue < 1e-6
    assert torch.equal(found, pit(samples, truth, random).flatten())
    ranks = (8 * found).floor().int()
    low, ties = ((each(samples, truth[:, None])).sum(1).flatten() for each in (torch.lt, torch.eq))
    assert ((low <= ranks) & (ranks <= low + ties)).all()


@pytest.mark.parametrize("law", LAWS)
def test_shares_and_moments_are_expectations_over_the_draws(law):
    samples, truth = exchangeable(LAWS[law], 7, 40)
    found = torch.stack([pit(samples, truth, uniform(40, 1, 1, seed=seed)).flatten() for seed in range(4000)])
    error = 4 * 0.5 / math.sqrt(4000)
    for level in (0.5, 0.9):
        inside = ((found - 0.5).abs() < level / 2).double().mean(0)
        torch.testing.assert_close(inside, coverage(samples, truth, level), atol=error, rtol=0)
    torch.testing.assert_close(found.mean(0), pit_mean(samples, truth), atol=error, rtol=0)
    variance = 12 * (found - 0.5).square().mean(0)
    torch.testing.assert_close(variance, pit_variance(samples, truth), atol=12 / 4 * error, rtol=0)
    shares = torch.stack([((4 * found).floor() == b).double().mean(0) for b in range(4)], -1)
    torch.testing.assert_close(shares, pit_histogram(samples, truth, 4), atol=error, rtol=0)


def test_forecasts_that_are_narrow_wide_or_off_are_told():
    samples, truth = draw(2000, 50, 1, 1), draw(2000, 1, 1, seed=1)
    narrow, wide, high = 0.5 * samples, 2 * samples, samples + 1
    covered = [coverage(each, truth, 0.8).mean() for each in (narrow, samples, wide)]
    assert covered[0] < 0.6 < covered[1] < 0.9 < covered[2]
    assert pit_variance(narrow, truth).mean() > 1.5
    assert pit_variance(wide, truth).mean() < 0.5
    assert pit_mean(high, truth).mean() < 0.3
    always = torch.full((1, 1, 1), 99.0).double()
    assert pit_variance(samples[:1], always).item() == pytest.approx(3 - 6 / 51 + 4 / 51**2)


# -------------------------------------------------------------------------------------------------------- invariance


CALIBRATION = {
    "coverage": lambda x, y: coverage(x, y, 0.8),
    "mean": pit_mean,
    "variance": pit_variance,
    "histogram": pit_histogram,
}


@pytest.mark.parametrize("score", CALIBRATION)
def test_calibration_is_a_matter_of_ranks_of_which_missing_ones_do_not_count(score):
    of = CALIBRATION[score]
    samples, truth = draw(3, 2, 25, 6, 4), draw(3, 2, 6, 4, seed=1)
    found = of(samples, truth)
    assert found.shape[:2] == (3, 2)
    shuffled = samples[:, :, torch.randperm(25, generator=torch.Generator().manual_seed(0))]
    torch.testing.assert_close(of(shuffled, truth), found)
    torch.testing.assert_close(of(samples.exp(), truth.exp()), found)
    torch.testing.assert_close(of(samples.numpy(), truth.numpy()), found)
    torch.testing.assert_close(of(samples[1, 0], truth[1, 0]), found[1, 0])
    mirrored = {"mean": 1 - found, "histogram": found.flip(-1)}.get(score, found)
    torch.testing.assert_close(of(-samples, -truth), mirrored)
    gaps = truth.clone()
    gaps[..., 2, :], gaps[..., 3] = torch.nan, torch.nan
    frames, columns = [0, 1, 3, 4, 5], [0, 1, 2]
    seen = samples[..., frames, :][..., columns], truth[..., frames, :][..., columns]
    torch.testing.assert_close(of(samples, gaps), of(*seen))
    gaps[0, 0] = torch.nan
    assert of(samples, gaps)[0, 0].isnan().all()
    missing = pit(samples, gaps, uniform(*truth.shape))
    assert torch.equal(missing.isnan(), gaps.isnan())


def test_bins_add_up_to_intervals_and_moments():
    samples, truth = draw(4, 19, 5, 3), draw(4, 5, 3, seed=1)
    bins = pit_histogram(samples, truth, 20)
    torch.testing.assert_close(bins.sum(-1), torch.ones(4).double())
    for level, cut in ((0.5, 5), (0.8, 2), (0.9, 1)):
        torch.testing.assert_close(bins[:, cut:-cut].sum(-1), coverage(samples, truth, level))
    middles = (torch.arange(20) + 0.5) / 20  # K + 1 = 20, so that the PIT is uniform within a bin
    torch.testing.assert_close(bins @ middles.double(), pit_mean(samples, truth))


@pytest.mark.parametrize("count", [1, 2, 30])
def test_the_energy_score_of_one_number_is_its_crps(count):
    samples, truth = draw(8, count, 1, 1), draw(8, 1, 1, seed=1)
    crps = metrics.continuous_ranked_probability_score(samples, truth)
    torch.testing.assert_close(metrics.energy_score(samples, truth), crps)


def test_scores_are_those_of_scoringrules():
    oracle = pytest.importorskip("scoringrules", reason="scoringrules, an optional oracle, is not installed")
    samples, truth = draw(4, 7, 5, 3).numpy(), draw(4, 5, 3, seed=1).numpy()
    crps = oracle.crps_ensemble(truth, samples, m_axis=1, estimator="fair").mean((1, 2))
    np.testing.assert_allclose(metrics.continuous_ranked_probability_score(samples, truth), crps)
    energy = oracle.es_ensemble(truth.reshape(4, -1), samples.reshape(4, 7, -1), estimator="fair")
    np.testing.assert_allclose(metrics.energy_score(samples, truth), energy)
    variogram = oracle.vs_ensemble(truth, samples.swapaxes(1, 2), p=0.5).mean(1) / (3 * 2)  # of ordered pairs
    apart = abs(samples[..., :, None] - samples[..., None, :]) ** 0.5
    variogram -= apart.var(1, ddof=1).mean(1).sum((1, 2)) / (3 * 2) / 7  # that estimate is not the fair one
    np.testing.assert_allclose(metrics.variogram_score(samples, truth), variogram)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: coverage(draw(5, 4, 3), draw(4, 3), 1), "between 0 and 1, got 1"),
        (lambda: interval_width(draw(5, 4, 3), 0), "between 0 and 1, got 0"),
        (lambda: coverage_at(1), "between 0 and 1, got 1"),
        (lambda: pit_histogram(draw(5, 4, 3), draw(4, 3), 0), "at least 1 bin, not 0"),
        (lambda: pit(draw(5, 4, 3), draw(4, 3), uniform(4)), r"shape \(4, 3\) needs as many uniform draws"),
        (lambda: pit(draw(5, 4, 3), draw(4, 3), 2 * uniform(4, 3)), "from 0 to 1; given are"),
        (lambda: coverage(draw(5, 4, 3), draw(3, 3), 0.5), r"of shape \(4, 3\), not \(3, 3\)"),
    ],
)
def test_what_calibration_cannot_be_of(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# -------------------------------------------------------------------------------------------------------- evaluation


@pytest.fixture(scope="module")
def truth():
    """A model, and windows of sequences that it drew, three of each clip with the same past."""
    model = dvae.twin("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})", {"z": 1, "x": 2}, 6, scale=0.9)
    dvae.Oracle(model, 6).fit_guide()
    with torch.random.fork_rng():
        torch.manual_seed(0)
        x = model.sample(300, 6)["x"]
    return model, ArrayWindows(x, 1, clips=[str(n // 3) for n in range(300)], columns={"speed": "m/s", "load": "m/s"})


@pytest.fixture(scope="module")
def scored(truth):
    model, windows = truth
    return evaluate({"exact": model}, windows, scores=calibrated, progress=False, training_windows=windows)


class Narrow(torch.nn.Module):
    """Half as wide as another model, about its mean."""

    likelihood = False

    def __init__(self, model):
        super().__init__()
        self.model = model
        self.generative, self.inference = model.generative, model.inference

    def forecast(self, batch, horizon, samples, **options):
        x = self.model.forecast(batch, horizon, samples, **options)["x"]
        return {"x": x.mean(0) + 0.5 * (x - x.mean(0))}


def test_forecasts_of_the_model_that_made_the_data_are_calibrated(scored):
    row = scored["exact"]
    names = [*map(coverage_at, LEVELS)]
    assert list(row)[:10] == [
        *("energy score", "variogram score", "CRPS"),
        *(measure.name for measure in names),
        *("width 90 %", "PIT mean", "PIT variance"),
    ]
    expected = dict(zip((measure.name for measure in names), LEVELS, strict=True)) | {
        "PIT mean": 0.5,
        "PIT variance": 1,
    }
    for name, value in expected.items():
        assert abs(row[name].mean - value) < 4 * row[name].standard_error, name
    assert scored.emission == "drawn"  # nobody asked for means, of which coverage says little
    _, departs, low, high = scored.departure("exact")
    assert ((low <= departs) & (departs <= high)).all()


def test_means_and_narrow_forecasts_are_told_from_calibrated_ones(truth):
    model, windows = truth
    result = evaluate(
        {"exact": model, "narrow": Narrow(model)}, windows, scores=calibrated, references=False, progress=False
    )
    assert result["narrow"]["coverage 90 %"].mean < 0.75
    assert result["narrow"]["PIT variance"].mean > 1.5
    assert result.difference("exact", "narrow", "coverage 90 %").mean > 0.15
    assert result.difference("exact", "narrow", "CRPS").interval()[1] < 0
    _, departs, low, high = result.departure("narrow")
    assert (departs < low).any()
    assert (departs > high).any()
    means = evaluate(model, windows, scores=calibrated, references=False, draw_emission=False, progress=False)
    assert means["model"]["coverage 90 %"].mean < 0.8
    assert (
        "forecasts of model are means, which lack the emission's noise and are too narrow for energy score"
        in " ".join(means.notes)
    )
    assert not any("noise" in note for note in result.notes)


def test_rows_of_too_few_forecasts_have_no_intervals_and_the_table_says_so(truth, scored):
    model, windows = truth
    assert not {"coverage 50 %", "PIT mean"} & scored["last value"].keys()
    assert not scored.rows["last value"].histograms
    assert {"coverage 95 %", "PIT mean"} <= scored["climatology"].keys()
    few = evaluate(model, windows, scores=calibrated, samples=10, references=False, progress=False)
    assert {"coverage 50 %", "coverage 80 %"} <= few["model"].keys()
    assert not {"coverage 90 %", "coverage 95 %", "PIT mean"} & few["model"].keys()
    assert "left out, as they need more than 10 forecasts: coverage 90 % (19), coverage 95 % (39)" in " ".join(
        few.notes
    )
    with pytest.raises(KeyError, match="no method has a histogram 'PIT'; evaluate with scores=calibrated"):
        few.plot_calibration()
    with pytest.raises(KeyError, match="'model' has no histogram 'PIT'"):
        few.departure("model")


def test_histograms_are_kept_and_drawn(scored):
    again = Evaluation.from_json(scored.to_json())
    assert again.to_json() == scored.to_json()
    for ours, theirs in zip(scored.departure("exact"), again.departure("exact"), strict=True):
        np.testing.assert_allclose(ours, theirs)
    figure = again.plot_calibration()
    shown = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert shown == ["climatology, K = 50", "nearest neighbours, K = 50", "exact, K = 50"]
    assert "PIT mean (share)" in str(scored)
    assert "0–5" not in str(scored)
    assert "histograms" not in json.loads(replace(scored, rows={"a": Row(1, {})}).to_json())["rows"]["a"]
    alone = replace(scored, clips={"one": 300}, rows={"a": Row(50, {}, histograms={"PIT": ((0.05,) * 20,)})})
    assert np.isnan(alone.departure("a")[2]).all()
    alone.plot_calibration()


def test_tables_print_the_units_of_columns(truth):
    model, windows = truth
    result = evaluate(
        model,
        windows,
        scores=lambda windows: [*calibrated(windows), *by_column(CRPS, {"speed": "m/s", "load": "kN"})],
        samples=39,
        references=False,
        progress=False,
    )
    units = {name: metric.unit for name, metric in result.metrics.items()}
    assert (units["CRPS"], units["energy score"], units["width 90 %"]) == ("m/s", "m/s", "m/s")
    assert (units["CRPS, speed"], units["CRPS, load"], units["coverage 50 %"]) == ("m/s", "kN", "share")
    assert "CRPS, load ↓ (kN)" in str(result)
    mixed = proper(replace(windows, columns={"speed": "m/s", "load": ""}))
    assert {measure.unit for measure in mixed} == {""}
    assert "mix numbers in m/s, 1" in mixed[0].note
    assert [measure.unit for measure in proper(replace(windows, columns=None))] == ["", "", ""]
    assert not any(measure.note for measure in proper(replace(windows, columns=None)))


COLUMNS = {"a": "m", "b": "s"}


@pytest.mark.parametrize("measure", [CRPS, ENERGY, width_at(0.5), coverage_at(0.5)], ids=lambda measure: measure.name)
def test_a_score_by_column_is_that_of_windows_of_the_column_alone(truth, measure):
    _, windows = truth
    mask = torch.ones_like(windows.x, dtype=torch.bool)
    mask[::2, 3:, 1] = False
    both = replace(windows, mask=mask, columns=None)

    def run(windows, scores):
        known = {"samples": 30, "references": ["climatology"], "training_windows": windows}
        return evaluate({}, windows, scores=lambda _: scores, progress=False, **known)["climatology"]

    found = run(both, by_column(measure, COLUMNS))
    for place, name in enumerate(COLUMNS):
        column = slice(place, place + 1)
        expected = run(replace(both, x=windows.x[..., column], mask=mask[..., column]), [measure])[measure.name]
        score = found[f"{measure.name}, {name}"]
        assert score.mean == pytest.approx(expected.mean, rel=1e-9)
        assert score.standard_error == pytest.approx(expected.standard_error, rel=1e-9)
    (one,) = by_column(measure, {"a": "m"})
    given = draw(6, 4, 5, 1), draw(6, 5, 1), {"x": draw(6, 2, 1)}, torch.arange(6)
    assert torch.equal(one.function(*given), measure.function(*given))


@pytest.mark.parametrize("measure", [CRPS, ENERGY, width_at(0.5), PIT], ids=lambda measure: measure.name)
def test_windows_without_a_column_do_not_count_in_it(measure):
    forecasts, truth = draw(6, 25, 5, 2), draw(6, 5, 2, seed=1)
    truth[2, :, 1] = torch.nan
    past, index = {"x": draw(6, 2, 2), "mask": torch.ones(6, 2, 2, dtype=torch.bool)}, torch.arange(6)
    first, second = by_column(measure, COLUMNS)
    assert first.function(forecasts, truth, past, index).isfinite().all()
    found, seen = second.function(forecasts, truth, past, index), index != 2
    assert found[2].isnan().all()
    expected = measure.function(forecasts[..., 1:], truth[..., 1:], past, index)[seen]
    torch.testing.assert_close(found[seen], expected)
    clips = torch.tensor([0, 0, 0, 1, 1, 1])
    of_clips = torch.tensor(second.pool(found, clips), dtype=torch.float64)
    torch.testing.assert_close(of_clips.mean(0), expected.mean(0))
    assert torch.tensor(second.pool(0 * found + torch.nan, clips)).isnan().all()


def test_columns_are_those_of_the_data():
    (one,) = by_column(CRPS, {"a": "m"})
    with pytest.raises(ValueError, match=r"1 columns \(a\) are not the 2 of x"):
        one.function(draw(3, 4, 5, 2), draw(3, 5, 2), {"x": draw(3, 1, 2)}, torch.arange(3))


# ------------------------------------------------------------------------------------------------------------ clusters


def histogram(ranks, clips):
    """An evaluation of what has these PIT, (N, numbers)."""
    places = list(dict.fromkeys(clips))
    shares = (np.minimum(20 * ranks, 19).astype(int)[..., None] == np.arange(20)).mean(1)
    of = np.array([places.index(clip) for clip in clips])
    means = tuple(tuple(shares[of == place].mean(0)) for place in range(len(places)))
    data = {"windows": len(ranks), "frames": 1 + ranks.shape[1], "coordinates": 1, "fingerprint": "f" * 64}
    counts = {str(place): int((of == place).sum()) for place in range(len(places))}
    rows = {"a": Row(50, {}, histograms={"PIT": means})}
    return Evaluation(rows, {}, counts, data, {"observed": 1}, 50, "drawn", 0, 0)


def test_of_clips_of_one_number_the_band_is_the_exact_envelope():
    random = np.random.default_rng(0)
    points, departs, low, high = histogram(random.random((40, 1)), range(40)).departure("a")
    exact = envelope(40, 19)
    np.testing.assert_allclose(points, exact[0])
    np.testing.assert_allclose([low + points, high + points], exact[1:])
    assert departs.shape == (19,)


def test_copies_of_windows_in_a_clip_narrow_no_band():
    ranks = np.random.default_rng(0).random((40, 5))
    once = histogram(ranks, range(40)).departure("a")
    thrice = histogram(ranks.repeat(3, 0), np.arange(40).repeat(3)).departure("a")
    for ours, theirs in zip(once, thrice, strict=True):
        np.testing.assert_allclose(ours, theirs)


@pytest.mark.parametrize("shared", [0.0, 0.9])
def test_bands_hold_the_curves_of_dependent_ranks_that_are_uniform(shared):
    """Of 200 sets of 20 clips of 20 numbers that have a normal effect in common: at most .05 + 4 standard errors."""
    random, outside = np.random.default_rng(1), 0
    for _ in range(200):
        effects = random.standard_normal((20, 1)).repeat(20, 0)
        values = math.sqrt(shared) * effects + math.sqrt(1 - shared) * random.standard_normal((400, 1))
        _, departs, low, high = histogram(stats.norm.cdf(values), np.arange(20).repeat(20)).departure("a")
        outside += bool(((departs < low) | (departs > high)).any())
    assert outside / 200 <= 0.05 + 4 * math.sqrt(0.05 * 0.95 / 200)


def test_independent_draws_are_worth_their_number():
    """Clips of ten draws each, 5 % fewer for what is not known of 500 clips' variances and for their spread."""
    random, points = np.random.default_rng(0), np.arange(1, 20) / 20
    below = (random.random((500, 10, 1)) < points).mean(1)
    _, deviations = linearised(below.T, np.ones(500))
    assert effective_number(points, deviations, 1e9) == pytest.approx(5000, rel=0.15)
    assert effective_number(points, deviations, 3000) == 3000
    _, deviations = linearised(below.repeat(2, 0).T, np.ones(1000))
    assert effective_number(points, 0 * deviations, 1e4) == 1e4


# ------------------------------------------------------------------------------------------------------- discrete data


class Counts(distributions.Law):
    """Poisson, of any rate."""

    def __init__(self, shape):
        super().__init__()
        self.out = torch.nn.Linear(shape.features, shape.size)

    def forward(self, features, previous=None, t=None):
        return (torch.nn.functional.softplus(self.out(features)),)

    def distribution(self, parameters):
        return dist.Poisson(parameters[0])

    def draw(self, parameters, noise):
        return torch.poisson(parameters[0])


@dataclass(frozen=True)
class Counted:
    def build(self, shape):
        return Counts(shape)


@pytest.fixture(scope="module")
def counted():
    """A model of counts that reads no more than the step before, so that its forecasts are exact, and its own data."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = dvae.networks.Recurrent(4)
        equations = "p(z_t) p(x_t | x_{t-1})", "q(z_t | x_t)"
        model = dvae.DynamicalVAE(*equations, {"z": 1, "x": 2}, network, {"p(x)": Counted()})
        x = model.double().sample(400, 6)["x"]
    return model, ArrayWindows(x.long(), 2, columns={"calls": "1/h", "alarms": "1/h"})


def test_forecasts_of_counts_are_draws_and_calibrated(counted):
    model, windows = counted
    assert (windows.x == 0).any()
    result = evaluate({"counts": model}, windows, scores=calibrated, training_windows=windows, progress=False)
    for name, value in {"coverage 50 %": 0.5, "coverage 90 %": 0.9, "PIT mean": 0.5, "PIT variance": 1.0}.items():
        score = result["counts"][name]
        assert abs(score.mean - value) < 4 * score.standard_error, name
    assert result.metrics["CRPS"].unit == "1/h"
    free, drawn, means = (
        evaluate({"counts": model}, windows, samples=10, draw_emission=how, references=False, progress=False)
        for how in (None, True, False)
    )
    assert (free.emission, drawn.emission, means.emission) == ("drawn", "drawn", "mean")
    assert free.rows == drawn.rows
    assert means["counts"]["CRPS"].mean > drawn["counts"]["CRPS"].mean
    normal = dvae.DynamicalVAE("p(z_t) p(x_t | z_t)", "q(z_t | x_t)", {"z": 1, "x": 2}).double()
    both = evaluate({"a": normal, "counts": model}, windows, samples=10, references=False, progress=False)
    assert both.emission == "drawn"
    mixed = [replace(measure, of_means=True) for measure in proper(windows)]
    both = evaluate(
        {"a": normal, "counts": model}, windows, scores=lambda _: mixed, samples=10, references=False, progress=False
    )
    assert both.emission == "drawn or mean"
    assert both.rows["counts"] == drawn.rows["counts"]


def test_comparisons_take_scores_of_draws(counted):
    model, windows = counted
    found = dvae.compare(
        {"counts": model}, windows, scores=calibrated, particles=2, contrasts=0, samples=19, progress=False
    )
    assert found.emission == "drawn"
    assert abs(found["counts"]["coverage 90 %"].mean - 0.9) < 0.05
    assert "coverage 95 %" not in found["counts"]
    assert found.shown == {"energy score": "1/h", "CRPS": "1/h"}
    again = dvae.Comparison.from_json(found.to_json())
    assert again["counts"]["coverage 90 %"].mean == found["counts"]["coverage 90 %"].mean


def test_counts_have_predictive_checks(counted):
    model, windows = counted
    checks = dvae.predictive_checks({"counts": model}, windows, samples=39, progress=False)
    for (_, program, name), check in checks.checks.items():
        if program == "forecast":  # of the true model's, tail areas have the mean ½, ties counting half
            error = check.tail_areas.std() / math.sqrt(400)
            assert abs(check.tail_areas.mean() - 0.5) <= 4 * error, name
    zeros = checks["counts", "forecast", "zeros"]
    assert 0.05 < zeros.real.mean() < 0.95
    checks.plot()
