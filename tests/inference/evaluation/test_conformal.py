"""Conformal prediction bands with dependent windows and few clips, TARP, and calibration by horizon."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import dvae
from dvae import ArrayWindows
from dvae.inference.evaluation.conformal import PredictionBands, adaptive_factors, conformal_bands, quantile
from dvae.inference.evaluation.evaluate import evaluate
from dvae.inference.evaluation.metrics import pit_histogram, tarp_histogram
from dvae.inference.evaluation.scores import PIT, by_step, calibrated, over_horizon, tarp


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def rate(hits):
    """Return the mean and four standard errors."""
    return hits.mean(), 4 * hits.std() / math.sqrt(len(hits))


# ------------------------------------------------------------------------------------------------ hierarchical quantile


@pytest.mark.parametrize(("clips", "level"), [(9, 0.9), (19, 0.9), (7, 0.5)])
def test_with_one_window_per_clip_the_quantile_is_split_conformal(clips, level):
    values = draw(clips, 3, 2).abs()
    place = math.ceil(round((clips + 1) * level, 9))
    factor = quantile(values, torch.arange(clips), level)
    torch.testing.assert_close(factor, values.sort(0).values[place - 1])


def test_with_too_few_clips_the_quantile_is_infinite():
    assert quantile(draw(8, 1), torch.arange(8), 0.9).isinf().all()
    gaps = draw(9, 2).abs()
    gaps[0, 1] = torch.nan
    assert quantile(gaps, torch.arange(9), 0.9).isinf().tolist() == [False, True]


@pytest.mark.parametrize("most", [1, 6])
def test_windows_of_new_clips_are_covered_at_the_level(most):
    """Simulate 4000 sets of clips with 1 to `most` windows, whose scale grows with their number."""
    random, clips, level = np.random.default_rng(0), 12, 0.8
    sizes = random.integers(1, most + 1, (4000, clips + 1))
    scale = random.gamma(2.0, size=sizes.shape) * sizes
    values = scale[..., None] * np.abs(random.standard_normal((*sizes.shape, most)))
    mask = np.arange(most) < sizes[..., None]
    scores = np.where(mask, values, np.nan)[:, :clips].reshape(4000, -1).T
    factor = quantile(torch.from_numpy(scores), torch.arange(clips).repeat_interleave(most), level).numpy()
    covered = values[:, -1, 0] <= factor  # windows of a clip are alike
    mean, error = rate(covered)
    assert level - error <= mean
    if most == 1:
        exact = math.ceil(round((clips + 1) * level, 9)) / (clips + 1)
        assert mean == pytest.approx(exact, abs=error)


# ----------------------------------------------------------------------------------------------------------------
# prediction bands


@pytest.fixture(scope="module")
def fitted():
    """Return a model with exact forecasts, and windows with missing values that it drew: for calibration, and new."""
    model = dvae.linear_gaussian_surrogate(
        "p(z_t) p(x_t | x_{t-1}, z_t)", "q(z_t | x_t)", {"z": 1, "x": 2}, 6, scale=0.9
    )
    with torch.random.fork_rng():
        torch.manual_seed(0)
        x = model.sample(1000, 6)["x"]
    mask = torch.rand(x.shape, generator=torch.Generator().manual_seed(1)) < 0.8
    mask[:, :2], mask[:, 5, 0] = True, True
    clips = [str(n // 2) for n in range(500)]
    return model, *(ArrayWindows(x[start::2], 2, mask=mask[start::2], groups=clips) for start in (0, 1))


class Narrow(torch.nn.Module):
    """A model whose forecasts are half as wide about the mean, from a frame on."""

    likelihood = False

    def __init__(self, model, start=0):
        super().__init__()
        self.model, self.start = model, start
        self.generative, self.inference = model.generative, model.inference

    def forecast(self, batch, horizon, samples, **options):
        x = self.model.forecast(batch, horizon, samples, **options)["x"]
        narrow = x.mean(0) + 0.5 * (x - x.mean(0))
        return {"x": torch.cat([x[:, :, : self.start], narrow[:, :, self.start :]], 2)}


def test_bands_of_exact_forecasts_have_their_coverage_and_narrow_ones_less(fitted):
    model, calibration, new = fitted
    for each, right in ((model, True), (Narrow(model), False)):
        bands = conformal_bands(each, calibration, samples=30, progress=False)
        coverage = bands.coverage(each, new, progress=False)["model"]
        for region in ("number", "step", "future"):
            held_share, expected_share = (coverage[f"{word} 90 %, {region}"] for word in ("calibrated", "raw"))
            # calibration and evaluation have equally many clips, and so equally large errors
            assert abs(held_share.mean - 0.9) < 4 * math.sqrt(2) * held_share.standard_error, region
            assert (abs(expected_share.mean - 0.9) < 5 * expected_share.standard_error) == right, region
        widths = [coverage[f"width calibrated 90 %, {region}"].mean for region in ("number", "step", "future")]
        assert widths == sorted(widths)


def test_stored_bands_are_put_around_forecasts(fitted, tmp_path):
    model, calibration, new = fitted
    bands = conformal_bands(model, calibration, 0.8, samples=20, progress=False)
    bands.save(tmp_path / "coverage.json")
    again = PredictionBands.load(tmp_path / "coverage.json")
    assert again.to_json() == bands.to_json()
    x = new.all()["x"]
    forecasts = model.forecast({"x": x[:, :2]}, 4, 20, draw_emission=True)["x"]
    for region, factor in bands.factors.items():
        lower, upper = again.apply(forecasts, region)
        torch.testing.assert_close((upper - lower) / 2, torch.from_numpy(factor) * forecasts.std(0))
        torch.testing.assert_close((upper + lower) / 2, forecasts.mean(0))
    assert "bands of 80 % · 500 windows of 250 groups" in str(again)
    assert again.plot()._repr_png_().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match="bands"):
        bands.apply(forecasts, "futures")
    with pytest.raises(ValueError, match=r"\(20, B, 4, 2\), got \(19, 500, 4, 2\)"):
        bands.apply(forecasts[:19])
    document = bands.document()
    shapes = document["attributes"]
    for change in ({"level": 2}, {"factors": {**shapes["factors"], "step": [1, 1]}}):
        with pytest.raises(ValueError, match="written"):
            PredictionBands.of({**document, "attributes": shapes | change})


# ----------------------------------------------------------------------------------------------------------------- TARP


def test_tarp_shares_equal_the_definition():
    samples, truth, point = draw(6, 9, 3, 2), draw(6, 3, 2, seed=1), draw(6, 3, 2, seed=2)
    truth[2, 0, 1], truth[3] = torch.nan, torch.nan
    histogram = tarp_histogram(samples, truth, point, 10)
    assert histogram[3].isnan().all()
    for n in (0, 1, 2, 4, 5):
        observed = ~truth[n].isnan()
        distances = [float((each[observed] - point[n][observed]).norm()) for each in (*samples[n], truth[n])]
        rank = sum(each < distances[-1] for each in distances[:-1])
        assert histogram[n].argmax() == rank
        assert histogram[n, rank] == pytest.approx(1)
    one, line, far = samples[..., :1, :1], truth[..., :1, :1], torch.full((6, 1, 1), -99.0).double()
    torch.testing.assert_close(tarp_histogram(one, line, far), pit_histogram(one, line), equal_nan=True)


def leaves(result, name, histogram):
    """Return whether a curve leaves its 99.9 % band."""
    _, departs, low, high = result.departure(name, histogram, 1e-3)
    return bool(((departs < low) | (departs > high)).any())


def test_narrow_forecasts_leave_the_bands_and_exact_ones_do_not(fitted):
    model, calibration, _ = fitted
    models, windows = {"exact": model, "narrow": Narrow(model)}, replace(calibration, mask=None)
    result = evaluate(models, windows, scores=lambda windows: [tarp(windows)], references=False, progress=False)
    assert [leaves(result, name, "TARP") for name in models] == [False, True]
    assert dvae.Evaluation.from_json(result.to_json()).to_json() == result.to_json()
    first, again = (tarp(windows).function(draw(5, 19, 4, 2), draw(5, 4, 2), {}, torch.arange(5)) for _ in range(2))
    assert torch.equal(first, again)


# -------------------------------------------------------------------------------------------------------------- horizon


def test_calibration_is_computed_and_drawn_for_every_frame_of_the_horizon(fitted):
    """The first half of each forecast is exact and the last frame is not."""
    model, calibration, _ = fitted
    windows = replace(calibration, mask=None)

    result = evaluate({"late": Narrow(model, 3)}, windows, scores=over_horizon, references=False, progress=False)
    row = result["late"]
    assert {*row} >= {measure.name for measure in calibrated(windows) if not measure.bins}
    outside = []
    for frame in (1, 2, 3, 4):
        covered = row[f"coverage 90 %, step {frame}"]
        assert (abs(covered.mean - 0.9) < 4 * covered.standard_error) == (frame < 4)
        outside.append(leaves(result, "late", f"PIT, step {frame}"))
    assert outside == [False, False, False, True]
    figure = result.plot_horizon()
    assert [axes.get_title() for axes in figure.axes][:4] == ["step 1", "step 2", "step 3", "step 4"]
    with pytest.raises(ValueError, match="steps must be between 1 and 4"):
        by_step(PIT, [6])[0].function(draw(8, 19, 4, 2), draw(8, 4, 2), {}, torch.arange(8))
    with pytest.raises(KeyError, match="evaluate with"):
        replace(result, rows={}).plot_horizon()


# ------------------------------------------------------------------------------------------------------- split by time

LEVEL, RATE = 0.9, 0.2


def origins_of(count, series=1, delay=1):
    """Return times (N, 2) of windows of several series at each origin, and the origin of every window."""
    origin = torch.arange(count).repeat_interleave(series)
    return torch.stack([origin, origin + delay], 1).double(), origin


@given(st.integers(0, 10**6), st.integers(1, 6), st.integers(1, 3), st.floats(0.02, 1.0))
def test_the_mean_outside_is_bounded_for_any_data(seed, delay, series, rate):
    """The scores have jumps, and some are larger because the earlier ones were small."""
    random, count, (least, most) = np.random.default_rng(seed), 60, (0.2, 5.0)
    jumps = np.repeat(random.uniform(np.log(least), np.log(most), 12), 5)
    scores = np.exp(jumps + random.uniform(-1, 1, (series, count)).cumsum(1) * random.integers(0, 2)).clip(least, most)
    origins, _ = origins_of(count, series, delay)
    distances = torch.from_numpy(scores.T.reshape(-1, 1))
    factor, _ = adaptive_factors(distances, origins, LEVEL, rate, torch.ones(1, dtype=torch.float64))
    mean = float((distances > factor).double().mean())
    # at an origin, the futures of `delay` origins are incomplete, its own included
    step = rate / math.sqrt(delay)
    assert mean <= 1 - LEVEL + (math.log(most) + delay * step) / (step * count) + 1e-9
    assert mean >= 1 - LEVEL - (delay * step - math.log(least)) / (step * count) - 1e-9


@given(st.integers(0, 10**6), st.integers(1, 5))
def test_a_band_depends_only_on_futures_that_are_complete_at_its_origin(seed, delay):
    random, (origins, origin) = np.random.default_rng(seed), origins_of(30, 2, delay)
    order = torch.from_numpy(random.permutation(60))  # windows may be listed in any order
    distances = torch.from_numpy(random.exponential(size=(60, 2)))
    now = int(random.integers(30))
    changed = torch.where(
        (origin + delay > now)[:, None], torch.from_numpy(random.exponential(size=(60, 2))), distances
    )
    first, again = (adaptive_factors(each[order], origins[order], 0.5, RATE)[0] for each in (distances, changed))
    known = origin[order] <= now
    assert torch.equal(first[known], again[known])
    assert first[origin[order] >= delay].isfinite().all()  # a level of 0.5 needs one origin
    assert first[origin[order] < delay].isinf().all()


def scores_of(kind, count, series, seed):
    """Return absolute errors (count, series), whose distribution changes over time."""
    random, time = np.random.default_rng(seed), np.arange(count)[:, None] / count
    errors = random.standard_normal((count, series))
    if kind == "correlated":
        errors = np.sqrt(0.7) * random.standard_normal((count, 1)) + np.sqrt(0.3) * errors
    scale = 1 + 3 * time if kind == "drift" else 1.0
    return np.abs(scale * errors + 3 * (time > 0.5) * (kind == "shift"))


@pytest.mark.parametrize(("kind", "fixed_holds"), [("exchangeable", 1), ("correlated", 1), ("drift", 0), ("shift", 0)])
@pytest.mark.parametrize("delay", [1, 4])
def test_adaptive_bands_hold_their_level_where_fixed_ones_fail(kind, fixed_holds, delay):
    count, series, first, shares, fixed_shares = 600, 5, 50, [], []
    origins, origin = origins_of(count, series, delay)
    later = origin >= first
    for seed in range(8):
        scores = torch.from_numpy(scores_of(kind, count, series, seed).reshape(-1, 1))
        factor, _ = adaptive_factors(scores, origins, LEVEL, RATE)
        fixed = quantile(scores[~later], origin[~later], LEVEL)
        for parts, each in ((shares, factor), (fixed_shares, fixed.expand(factor.shape))):
            parts.append(float((scores <= each)[later].double().mean()))
    mean, error = rate(np.array(shares))
    ratio = {"drift": 4, "shift": 3}.get(kind, 1)  # of the largest quantile to the first
    step = RATE / math.sqrt(delay)
    assert abs(mean - LEVEL) <= error + (math.log(ratio) + delay * step) / (step * (count - first))
    fixed_mean, fixed_error = rate(np.array(fixed_shares))
    assert (abs(fixed_mean - LEVEL) <= fixed_error + 0.03) == bool(fixed_holds)


@pytest.fixture(scope="module")
def panel():
    """Return a panel whose scale grows threefold, divided by time, and a model with the first scale."""
    random, time = np.random.default_rng(0), np.linspace(0, 1, 420)[:, None]
    arrays = [(1 + 2 * time) * random.standard_normal((420, 2)) for _ in range(4)]
    arrays[0][::7, 1] = np.nan
    cut = dvae.tables.Cut(4, 3, split="time", validation=0.3, test=0.6)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = dvae.linear_gaussian_surrogate("p(z_t) p(x_t | z_t)", "q(z_t | x_t)", {"z": 1, "x": 2}, 7)
    return model, dvae.tables.PanelData.of(arrays, cut=cut)


def test_bands_of_a_split_by_time_continue_over_the_test_windows(panel, tmp_path):
    model, data = panel
    bands = conformal_bands(model, data.windows("validation"), samples=30, progress=False)
    assert bands.rate == RATE
    assert "origins" in str(bands)
    bands.save(tmp_path / "bands.json")
    again = PredictionBands.load(tmp_path / "bands.json")
    test = data.windows("test")
    coverage = again.coverage(model, test, progress=False)["model"]
    fixed = replace(bands, rate=0.0).coverage(model, test, progress=False)["model"]
    count = len(test.origins[:, 0].unique())
    for region in ("number", "step", "future"):
        name = f"calibrated 90 %, {region}"
        assert abs(coverage[name].mean - LEVEL) < (math.log(3) + RATE) / (RATE * count) + 0.01, region
        assert fixed[name].mean < coverage[name].mean - 0.03, region
    widths = [coverage[f"width calibrated 90 %, {region}"].mean for region in ("number", "step", "future")]
    assert widths == sorted(widths)
    (_, name, _), count = test.keys[0], len(test) // 4
    end = test.origins[:, 1].max().item()
    with pytest.raises(ValueError, match=rf"^the futures of {count} of {len(test)} windows begin before the last"):
        replace(bands, data={**bands.data, "until": {name: end}}).coverage(model, test, progress=False)
    document = bands.document()
    del document["attributes"]["rate"]  # a file of an older version
    assert PredictionBands.of(document).rate == 0


def test_successive_windows_calibrate_as_one(panel):
    _, data = panel
    windows, train = data.windows("validation"), data.windows("train")
    early = [n for n, (_, _, start) in enumerate(windows.keys) if start < 100]
    late = [n for n in range(len(windows)) if n not in early]
    parts = [windows.subset(early), windows.subset(late)]
    options = {"residuals": train, "training_windows": train, "progress": False}
    whole, pooled = (conformal_bands("mean", each, **options) for each in (windows, parts))
    for region, factor in whole.factors.items():
        np.testing.assert_allclose(pooled.factors[region], factor)
    with pytest.raises(ValueError, match="expected one model for each of 2 windows, got 1"):
        conformal_bands([panel[0]], parts)


def test_bands_of_a_split_by_time_state_what_they_need(panel):
    model, data = panel
    windows = data.windows("validation")
    few = windows.subset([n for n, (_, _, start) in enumerate(windows.keys) if start < windows.keys[0][2] + 3])
    count = len(few.origins[:, 0].unique())
    with pytest.raises(ValueError, match=f"need at least 9 origins .* got {count}; use more, such as .*, or a level"):
        conformal_bands(model, few, samples=5, progress=False)
    with pytest.raises(ValueError, match="`groups` only if they are not divided by time"):
        conformal_bands(model, windows, groups=["a"] * len(windows))
    with pytest.raises(ValueError, match="windows of one kind"):
        conformal_bands(model, [windows, data.windows("all")])
    with pytest.raises(ValueError, match="rate is 0; it must be"):
        conformal_bands(model, windows, rate=0)
    bands = conformal_bands(model, windows, samples=5, progress=False)
    with pytest.raises(ValueError, match="ArrayWindows, which have no `origins`"):
        bands.coverage(model, ArrayWindows(torch.zeros(3, 7, 2), 4), progress=False)
