"""Every method on a table of several kinds of columns, and the files of its forecasts."""

import json
import re
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
import torch

import dvae
from dvae.inference.training.checkpoints import CheckpointError
from dvae.models.registry import methods
from dvae.runs import directory as runs
from dvae.tables import Column, Columns
from dvae.tables.calendar import NUMBERS, Calendar
from dvae.tables.dataset import PanelData
from dvae.tables.forecasts import QUANTILES, PanelForecasts, PanelImputed, needed, panel_scores
from dvae.tables.protocol import Cut

pd = pytest.importorskip("pandas")

NAN = np.nan
SMALL = {"latent": 2, "warm_up": 1}
WITHOUT_LATENTS = ("autoregressive", "moglow")
METHODS = ("vae", "dkf", "storn", "vrnn", "srnn", "rvae-causal", "rvae-noncausal", "dsae", "kvae", "rslds")
METHODS += WITHOUT_LATENTS
PLAIN = ("erd", "aclstm")
"""Deterministic methods for motion that accept any data."""
COLUMNS = Columns(
    (
        Column("riders", family="overdispersed", unit="people"),
        Column("temp", unit="°C"),
        Column("kind", family="category", classes=("a", "b", "c")),
        Column("open", family="binary"),
        Column("share", family="share"),
        Column("plan", "known"),
        Column("weather", "past", "category", classes=("rain", "sun")),
        Column("height", "static"),
    ),
    ("station",),
    "day",
)


def frame(count=6, t=14):
    rng = np.random.default_rng(0)
    parts = []
    for n in range(count):
        columns = {"riders": rng.poisson(4, t), "temp": rng.normal(20, 5, t), "kind": rng.choice(["a", "b", "c"], t)}
        columns |= {"open": rng.integers(0, 2, t), "share": rng.uniform(0.1, 0.9, t), "plan": rng.normal(size=t)}
        part = pd.DataFrame({**columns, "weather": rng.choice(["rain", "sun"], t)}).astype(object)
        part = part.mask(rng.random(part.shape) < 0.15)
        parts.append(part.assign(station=f"s{n}", day=np.cumsum(rng.choice([1, 1, 3], t)), height=rng.normal()))
    return pd.concat(parts, ignore_index=True)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A table with missing targets and covariates, and uneven steps."""
    path = tmp_path_factory.mktemp("tables") / "riders.csv"
    frame().to_csv(path, index=False)
    return PanelData.open(path, COLUMNS, Cut(5, 3))


def options(name):
    return {} if name in WITHOUT_LATENTS else {"width": 4} if name in PLAIN else SMALL


def test_every_method_that_is_not_for_motion_is_tested():
    futures = {"cvae", "bom", "bom-parts", "pose-knows", "mt-vae", "rhp", "dlow", "dsf", "mix-and-match", "denoiser"}
    motion = {"hit-dvae", "gsps", "trajevae", "cvae-rnn", "moglow-paths", "motion-infilling", "motion-latent", *futures}
    other = {"equations", "csdi"}  # csdi refuses counts and categories; tests/models/family/test_csdi.py
    assert {*METHODS, *PLAIN} == {*methods()} - motion - other


@pytest.mark.parametrize("name", [*METHODS, *PLAIN])
def test_a_method_fits_and_forecasts_a_table_and_ignores_missing_values(data, name):
    windows = data.windows("train")
    assert windows.schema.sizes == {"x": 7, "c": 1 + 1 + 2 + 1, "s": 1, "d": 1, "r": 1}
    method = dvae.method(name, **options(name)).resolve_defaults(windows)
    model = method.build(data.schema)
    recipe = method.train(windows, data.windows("validation"), 2)
    dvae.fit(model, recipe, steps=2, batch_size=4, validate_every=2, progress=False)
    model.eval()
    assert {"c", "s", "d"} <= {*model.context}
    batch = data.windows("test").all()
    draws = model.forecast(batch.past(5), 3, samples=4, draw_emission=True)["x"]
    assert draws.shape == (4, len(batch["x"]), 3, 7)
    assert draws.isfinite().all()
    assert not draws[..., [0, 2, 3, 4, 5]].frac().any()  # counts, a class and a binary
    assert (draws[..., 2:5].sum(-1) == 1).all()
    assert ((draws[..., 6] > 0) & (draws[..., 6] < 1)).all()
    model.double()
    double = {key: value.double() if value.is_floating_point() else value for key, value in batch.items()}
    bounds = []
    for fill in (0.0, 1.0):  # in the support of all families but one
        x = torch.where(double["mask"], double["x"], fill)
        torch.manual_seed(0)
        bounds.append(dvae.iwae_bound(model, {**double, "x": x}, particles=3).bound)
    assert (~double["mask"]).any()
    torch.testing.assert_close(*bounds, rtol=0, atol=0)


@pytest.mark.parametrize("name", ["srnn", "erd"])
def test_the_mean_of_a_column_changes_neither_fit_nor_forecasts_nor_scores(name, tmp_path):
    """The mean of a covariate does not either. Forecasts and truth are in float64."""
    shifts, results = {"temp": 1e9, "plan": -1e9}, []
    for is_shifted in (False, True):
        table = frame()
        for column, shift in shifts.items():
            table[column] = table[column].astype(float) + is_shifted * shift
        data = PanelData.of(table, COLUMNS, Cut(5, 3))
        windows, test = data.windows("train"), data.windows("test")
        torch.manual_seed(0)
        method = dvae.method(name, **options(name)).resolve_defaults(windows)
        model = method.build(data.schema)
        dvae.fit(model, method.train(windows, None, 2), steps=2, batch_size=4, progress=False)
        forecasts = test.forecast(model, samples=4)
        forecasts.save(tmp_path / "forecasts.csv")
        table_read = pd.read_csv(tmp_path / "forecasts.csv", dtype=str).astype({"truth": float})
        np.testing.assert_array_equal(table_read["truth"], forecasts.truth.ravel())
        for values in (forecasts.draws, forecasts.past, forecasts.truth):
            assert values.dtype == np.float64
            values[..., 1] -= is_shifted * shifts["temp"]
        scores = dvae.evaluate(model, test, scores=panel_scores, samples=4, draw_emission=True, progress=False)["model"]
        means = {metric: scores[metric].mean for metric in scores}
        results.append([forecasts.draws, forecasts.past, forecasts.truth, means])
    (*arrays, first_means), (*others, second_means) = results
    for one, other in zip(arrays, others, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4)
    assert first_means == pytest.approx(second_means, rel=1e-3, abs=1e-3, nan_ok=True)


def test_equations_read_exactly_the_covariates_that_they_name(data):
    guide = "q(z_t | z_{t-1}, x_{1:T}, c_t)"
    settings = {"generative": "p(z_t | z_{t-1}, d_t, s) p(x_t | z_t, c_t)", "inference": guide, **SMALL}
    model = dvae.method("equations", **settings).build(data.schema)
    batch, plain = data.windows("test").all(), dvae.method("equations", **SMALL).build(data.schema)

    def bound(model, batch):
        torch.manual_seed(0)
        return dvae.iwae_bound(model, batch, particles=2).bound

    assert not plain.context
    for name in ("c", "d", "s"):
        other = {**batch, name: batch[name] + 1}
        assert not torch.equal(bound(model, other), bound(model, batch))
        assert torch.equal(bound(plain, other), bound(plain, batch))
    with pytest.raises(ValueError, match="the equations read e"):
        dvae.method("equations", generative="p(x_t | x_{t-1}, e_t)", inference="").build(data.schema)


def test_a_run_is_loaded_unless_it_was_changed(data, tmp_path):
    out = tmp_path / "run"
    training = dvae.Training(steps=1, batch_size=4, progress=False)
    dvae.fit(dvae.method("autoregressive", width=4), data, out=out, **vars(training))
    loaded = runs.load(out)
    assert loaded.schema == data.schema
    assert loaded.data.fingerprint == data.fingerprint
    config = json.loads((out / "config.json").read_text())
    for change in (
        {"means": {}},
        {"step": "much"},
        {"columns": {"columns": {"riders": {"family": "cout"}}}},
        {"cut": {"observed": 10**9, "horizon": 1}},
        {"kind": "sequences"},
    ):
        (out / "config.json").write_text(json.dumps({**config, "schema": {**config["schema"], **change}}))
        with pytest.raises(CheckpointError, match=r"config.json") as error:
            runs.load(out)
        assert len(str(error.value)) < 1000
    (out / "config.json").write_text(json.dumps(config))
    with open(data.path, "a") as file:
        file.write("1,2.5,a,1,.5,1,sun,s9,1,.3\n")
    with pytest.raises(CheckpointError, match=r"riders.csv has changed since"):
        runs.load(out).data.windows("test")


BERLIN = Calendar("dates", "Europe/Berlin")


def forecasts(times=None, calendar=NUMBERS, samples=50):
    rng = np.random.default_rng(0)
    draws = rng.normal(1e6, 1, size=(samples, 2, 3, 2)).astype(np.float32)
    draws[..., 1] = rng.integers(0, 2, draws.shape[:-1])
    past, truth = rng.normal(size=(2, 4, 2)), rng.normal(size=(2, 3, 2))
    past[..., 1], truth[..., 1] = past[..., 1] > 0, truth[..., 1] > 0
    truth[0, 1, 0] = past[1, 2, 0] = NAN
    return PanelForecasts(draws, past, truth, {"y": "m", "open": ""}, [("a", 4), ("b", 9)], times, calendar)


@pytest.mark.parametrize(
    ("samples", "first", "bands"), [(1, "q500", 0), (8, "q250", 1), (38, "q050", 2), (39, "q025", 3)]
)
def test_quantiles_that_need_more_draws_are_left_out(samples, first, bands):
    result = forecasts(samples=samples)
    columns = [name for name in result.table() if name.startswith("q")]
    names = [f"q{1000 * level:03.0f}" for level in QUANTILES]
    assert columns == names[names.index(first) : len(names) - names.index(first)]
    assert len(result.plot().axes[0].collections) == bands
    gaps = PanelImputed(result.draws, np.ones((2, 3, 2), bool), result.columns, result.keys)
    assert [name for name in gaps.table() if name.startswith("q")] == columns


@pytest.mark.parametrize("samples", [39, 60])
def test_intervals_cover_exchangeable_truths_at_their_level(samples):
    rng = np.random.default_rng(0)
    count = 20_000
    draws, truth = rng.uniform(size=(samples, count, 1, 1)), rng.uniform(size=(count, 1, 1))
    keys = [("a", n) for n in range(count)]
    table = PanelForecasts(draws, truth[:, :0], truth, {"y": ""}, keys).table()
    for quantile in QUANTILES:
        n_draws = 1 / min(quantile, 1 - quantile) - 1  # the smallest of K draws has mean quantile level 1 / (K + 1)
        assert needed(quantile) == pytest.approx(n_draws)
        below = (truth.ravel() < table[f"q{1000 * quantile:03.0f}"]).mean()
        assert below == pytest.approx(quantile, abs=4 * np.sqrt(quantile * (1 - quantile) / count))


DIGITS = 20240101.0 + 0.5 * np.arange(14)


@pytest.mark.parametrize(
    ("calendar", "times", "expected"),
    [
        (NUMBERS, DIGITS, [*DIGITS[4:7], *DIGITS[11:]]),
        (
            BERLIN,
            1711828800 + 3600.0 * (np.arange(14) % 7),
            ["2024-03-31 01:00:00+01:00", "2024-03-31 03:00:00+02:00", "2024-03-31 04:00:00+02:00"],
        ),
        (
            Calendar("durations"),
            3600 + 0.25 * (np.arange(14) % 7),
            [f"0 days 01:00:01.{n}0000" for n in ("00", "25", "50")],
        ),
    ],
    ids=["numbers", "zone", "durations"],
)
def test_times_are_written_with_all_digits_and_in_their_zone(tmp_path, calendar, times, expected):
    result = forecasts(times.reshape(2, 7), calendar)
    result.save(tmp_path / "a.csv")
    assert [*dict.fromkeys(pd.read_csv(tmp_path / "a.csv")["time"])] == expected
    figure = result.plot()
    figure.canvas.draw()
    labels = [label.get_text() for label in figure.axes[0].get_xticklabels()]
    assert calendar.zone is None or "04:00" in labels


def test_quantiles_of_counts_are_counts():
    result, counts = forecasts(), np.random.default_rng(0).poisson(3.0, (50, 2, 3, 1))
    draws = np.concatenate([counts, counts + 0.25], -1)
    frame = replace(result, draws=draws).table()
    names = [name for name in frame if re.fullmatch(r"q\d+", name)]
    whole, others = (frame[frame.column == name][names].to_numpy() for name in result.columns)
    assert (whole % 1 == 0).all()
    assert (others % 1 != 0.25).any()  # interpolated
    low, high = (frame[frame.column == "y"][name].to_numpy().reshape(2, 3) for name in ("q050", "q950"))
    exact = np.quantile(counts[..., 0], [0.05, 0.95], axis=0, method="weibull")
    assert ((low <= exact[0]) & (exact[1] <= high)).all()
    assert (high - low < exact[1] - exact[0] + 2).all()


def test_prediction_bands_are_the_quantiles():
    result = forecasts()
    figure = result.plot(1)
    fan, share = figure.axes[:2]
    low, high = np.quantile(result.draws[:, 1, :, 0], [0.025, 0.975], axis=0, method="weibull")
    edges = fan.collections[0].get_paths()[0].vertices
    assert {*np.float32(low), *np.float32(high)} <= {*np.float32(edges[:, 1])}
    np.testing.assert_allclose(share.lines[0].get_ydata(), result.draws[:, 1, :, 1].mean(0))
    assert [axis.get_title() for axis in figure.axes] == ["y (m)", "open"]
    assert len(result.plot(columns=["open"]).axes) == 1
    with pytest.raises(ValueError, match=r"no column 'opn' \(did you mean 'open'\?\); there are y, open"):
        result.plot(columns=["opn"])
    if not find_spec("pyarrow"):
        with pytest.raises(ValueError, match="needs pyarrow: pip install"):
            result.save("a.parquet")


def test_rare_counts_are_drawn_as_counts():
    """Draws that are 0 or 1 by chance are no shares if the past or the truth has other values."""
    result = forecasts()
    arrays = {name: getattr(result, name)[..., 1:] for name in ("draws", "past", "truth")}
    for name in ("past", "truth"):
        values = arrays[name] + 3.0
        figure = replace(result, columns={"claims": ""}, **arrays | {name: values}).plot(1)
        (axis,) = figure.axes
        assert axis.get_ylabel() == ""
        assert axis.get_ylim()[1] > values[1].max()
        assert "median" in [text.get_text() for text in figure.legends[0].get_texts()]
    labels = [text.get_text() for text in result.plot(1).legends[0].get_texts()]
    assert {"median", "share of draws", "truth"} <= {*labels}


@pytest.fixture(scope="module")
def model(data):
    return dvae.method("dkf", **SMALL).build(data.schema).eval()


def test_forecasts_are_draws_of_the_model(data, model):
    test = data.windows("test")
    result, batch = test.forecast(model, 4, seed=3), test.all()
    torch.manual_seed(3)
    draws = model.forecast(batch.past(5), 3, samples=4, draw_emission=True)["x"]
    np.testing.assert_array_equal(result.draws, draws)
    np.testing.assert_array_equal(np.isnan(result.past), ~batch["mask"][:, :5])
    assert result.keys == [(name, start + 5) for _, name, start in test.keys]
    assert (test.forecast(model, 4, seed=4).draws != result.draws).any()
    assert list(result.columns.values()) == ["people", "°C", "", "", "", "", ""]
    with pytest.raises(ValueError, match="whole sequences have no future; to forecast, cut them"):
        data.whole().forecast(model)


def test_every_missing_entry_of_a_table_is_filled(data, model, tmp_path):
    windows = data.whole()
    result, batch = windows.impute(model, 39), windows.all()
    np.testing.assert_array_equal(result.missing, ~batch["mask"])
    for draw in result.draws:
        np.testing.assert_array_equal(draw[~result.missing], batch["x"][batch["mask"]])
    table = result.table()
    assert len(table) == result.missing.sum() == sum(np.isnan(data.schema.targets(one)).sum() for one in data.panel)
    series = {one.name: one for one in data.panel}
    for _, row in table.iterrows():
        one, index = series[row["sequence"]], data.schema.coordinates.index(row["column"])
        assert np.isnan(data.schema.targets(one)[row["step"], index])
        assert row["time"] == one.times[row["step"]]
    result.save(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as arrays:
        np.testing.assert_array_equal(arrays["filled"], result.draws)
        np.testing.assert_array_equal(arrays["observed"], batch["mask"])


def test_padding_is_not_filled_and_complete_data_are_an_error(model, data):
    ragged = frame().drop(index=[10, 11, 12, 13]).reset_index(drop=True)
    result = data.with_data(ragged).whole().impute(model, 2)
    assert not result.missing[0, 10:].any()
    assert result.missing[0, :10].any()
    full = PanelData.of(np.random.default_rng(0).normal(size=(6, 12, 1)), ["y"], Cut(5, 3))
    with pytest.raises(ValueError, match="no target is missing in panel"):
        full.whole().impute(model)


def test_rounded_values_have_bounded_bounds_and_rounded_forecasts(tmp_path):
    """A model that learns the repeated value has a density of at most 1 / rounding with noise, and no limit without."""
    random = np.random.default_rng(0)
    dates = np.tile(pd.date_range("2024-01-01", periods=60), 6)
    table = pd.DataFrame({"shop": np.repeat(list("abcdef"), 60), "day": dates, "y": 2.5})
    table.loc[random.random(360) < 0.1, "y"] = np.nan
    table.loc[::37, "y"] = 3.0
    path = tmp_path / "shops.csv"
    table.to_csv(path, index=False)
    plain = Columns((Column("y"),), ("shop",), "day", calendar=("weekday",))
    bounds = {}
    for name, columns in {"plain": plain, "rounded": plain.but("y", rounding=0.5)}.items():
        data = PanelData.open(path, columns, Cut(8, 4, split="time"))
        out = tmp_path / name
        options = {"steps": 150, "batch_size": 32, "learning_rate": 0.03, "progress": False, "out": out}
        dvae.fit(dvae.method("autoregressive", width=8), data, **options)
        run = dvae.load(out)
        assert run.schema == data.schema
        test = run.data.windows("test")
        bounds[name] = dvae.SequenceELBO().terms(run.model, test.all()).bound / test.all()["mask"].sum((1, 2))
    assert bounds["plain"].mean() > 1
    assert bounds["rounded"].mean() < -np.log(0.5)
    forecasts = run.data.ahead().forecast(run.model, samples=50)
    assert (forecasts.draws % 0.5 == 0).all()
    assert len(forecasts.keys) == 6  # without appended rows: the weekday continues
    filled = run.data.whole().impute(run.model, samples=2)
    values = np.stack([sequence.values for sequence in run.data.panel])
    known = ~np.isnan(values)
    np.testing.assert_array_equal(filled.draws[0][known], values[known])
