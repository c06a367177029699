"""Targets of tables in units of their own sequence: schema, levels of counts, methods, residual means and runs."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

import dvae
from dvae.data.batch import Batch
from dvae.data.schema import SchemaError
from dvae.distributions import FAMILIES, Family
from dvae.networks import Dense
from dvae.tables import Cut, Panel, PanelData, panel_scores
from dvae.tables.columns import Column, Columns
from dvae.tables.encoding import PanelSchema
from dvae.tables.panel import Series
from dvae.tables.windows import PanelWindows

COLUMNS = Columns(
    (
        Column("riders", family="overdispersed"),
        Column("price", family="log-normal"),
        Column("open", family="binary"),
        Column("warmth"),
        Column("plan", "past"),
    )
)
CUT = Cut(12, 4, season=4)


def panel(missing=True, counts=9, steps=30, seed=0):
    random = np.random.default_rng(seed)
    series = []
    for n in range(counts):
        level = np.exp(random.normal(2, 1.5))
        values = np.stack(
            [
                random.poisson(level, steps),
                level * np.exp(random.normal(0.01, 0.1, steps).cumsum()),
                random.integers(0, 2, steps),
                random.normal(10 * n, 1 + n, steps),
                random.normal(size=steps),
            ],
            1,
        ).astype(float)
        if missing:
            values[:, :4] = np.where(random.random((steps, 4)) < 0.15, np.nan, values[:, :4])
        series.append(Series(f"s{n}", values))
    return Panel(series, COLUMNS)


@pytest.fixture(scope="module")
def data():
    table = panel()
    return PanelData("memory", table, PanelSchema.from_data(table, CUT))


def test_priors_come_from_training_sequences_and_survive_the_configuration(data):
    schema = data.schema
    assert {name: sorted(by) for name, by in schema.priors.items()} == {
        "riders": ["0", "log"],
        "price": ["0", "1", "4"],
        "warmth": ["0", "1", "4"],
    }
    training = {data.panel.series[n].name for n, _, _ in CUT.starts(data.panel, "train")}
    factors = np.array([50, 50, 1, 50, 50])
    others = [s if s.name in training else replace(s, values=s.values * factors) for s in data.panel]
    assert PanelSchema.from_data(replace(data.panel, series=others), CUT).priors == schema.priors
    for units in ("columns", "logs", "series", "changes", "seasonal"):
        scaled = schema.in_units(units)
        assert PanelSchema.from_config(json.loads(json.dumps(scaled.config()))) == scaled
    assert "target_units" not in schema.config()
    for values in ([0.0] * 7, [1.0] * 6, [1.0, 1.0, 1.0, 1.0, float("nan"), 1.0, 0.0]):
        config = json.loads(json.dumps(schema.config()))
        config["priors"]["price"]["0"] = values
        with pytest.raises(ValueError, match="prior"):
            PanelSchema.from_config(config)
    old = {name: value for name, value in schema.config().items() if name != "priors"}
    with pytest.raises(SchemaError, match="need a column of numbers or counts"):
        PanelSchema.from_config(old).in_units("series")
    with pytest.raises(SchemaError, match=r"'seasonal' need a season \(season=7, --season 7\).*series or changes"):
        PanelSchema.from_data(data.panel, replace(CUT, season=None)).in_units("seasonal")
    hurdle = Columns((Column("rain", family="hurdle"),))
    rain = Panel([Series(str(n), np.arange(20.0)[:, None] % 3) for n in range(6)], hurdle)
    for units in ("logs", "seasonal", "changes"):
        with pytest.raises(SchemaError, match="take the units columns"):
            PanelSchema.from_data(rain, Cut(4, 3)).in_units(units)


def test_an_emission_that_replaces_families_is_warned_of(data):
    with pytest.warns(UserWarning, match=r"'normal' treats riders \(overdispersed\), price \(log-normal\), open"):
        dvae.method("vae", emission="normal").build(data)
    with pytest.warns(UserWarning, match=r"riders \(overdispersed\), open \(binary\) as real"):  # logs of prices are
        dvae.method("vae", emission="normal", units="logs").build(data)
    real = PanelData.of([np.random.default_rng(0).normal(size=(20, 2))] * 3, cut=Cut(4, 3))
    dvae.method("vae", emission="normal").build(real)


def test_levels_of_counts_use_earlier_observed_steps_alone(data):
    windows = data.windows("train")
    batch = windows.all()
    mean, weight = data.schema.priors["riders"]["0"][:2]
    x, mask, levels = batch["x"][..., 0], batch["mask"][..., 0], batch["r"][..., 0]
    for t in (0, 5, 12, 15):
        end = min(t, 12)
        total, count = torch.where(mask, x, 0.0)[:, :end].sum(1), mask[:, :end].sum(1)
        expected = ((weight * mean + total) / (weight + count)).log()
        torch.testing.assert_close(levels[:, t].double(), expected, rtol=1e-6, atol=1e-6)


def test_an_exposure_multiplies_the_mean_of_counts_alone(data):
    schema = data.schema.in_units("series")
    model = dvae.method("autoregressive", width=4, units="series").build(data.schema).double()
    batch = data.windows("test").all().map(lambda value: value.double() if value.is_floating_point() else value)
    doubled = Batch(batch | {"r": batch["r"] + np.log(2.0)})
    read, factor = model.read(batch), model.generator["x"]
    assert factor.exposure == ("r", [0])
    with torch.no_grad():
        run, other = model.rollout(read), model.rollout(model.read(doubled))
        inputs = {name: read[name] for name in factor.parents}  # the network reads the same values
        features = factor._read(inputs, len(read["x"]), None)
        head = factor.head(factor.network(features, read["x"].shape[1]))
        once, twice = (factor._rescale(head, r["r"].exp()) for r in (read, model.read(doubled)))
        means = [factor.mean(parameters) for parameters in (once, twice)]
    torch.testing.assert_close(means[1][..., 0], 2 * means[0][..., 0])
    torch.testing.assert_close(means[1][..., 1:], means[0][..., 1:])
    assert run.length == other.length
    assert schema.exposure == ("r", [0])


def test_steps_and_the_vectorised_program_agree_with_an_exposure(data):
    model = dvae.method("srnn", latent=2, width=4, warm_up=1, units="series").build(data.schema).double()
    complete = PanelData("memory", panel(missing=False), data.schema)
    batch = complete.windows("test").all()
    torch.manual_seed(0)
    with torch.no_grad():
        context = {name: value for name, value in batch.items() if name in ("c", "r")}
        run = model.model(context, length=16)  # free-running, step by step
        joint = model.rollout(model.read(context | {"x": batch["x"]}))
        joint.values.update({"x": run["x"], "z": run["z"]})
        vectorised = joint.conditionals["x"](
            {name: joint.values[name] for name in joint.conditionals["x"].parents}, len(run["x"]), 16
        )
        state = joint.conditionals["x"].start(
            {name: joint.values[name] for name in joint.conditionals["x"].parents if name != "x"}, len(run["x"]), 16
        )
        steps = []
        samples = {"x": list(run["x"].unbind(1))}
        for t in range(16):
            parameters, state = joint.conditionals["x"].step(state, t, samples)
            steps.append(parameters)
    for n, parameter in enumerate(vectorised):
        torch.testing.assert_close(torch.stack([each[n] for each in steps], 1), parameter, rtol=1e-8, atol=1e-8)


def test_an_exposure_must_be_context_of_the_factor():
    model = dvae.DynamicalVAE("p(x_t | x_{t-1})", "", {"x": 1}, Dense((4,)), Family("Poisson"))
    with pytest.raises(ValueError, match="does not read the exposure r"):
        model.standardise("x", exposure=("r", [0]))


@pytest.mark.parametrize("units", ["logs", "series", "changes", "seasonal"])
@pytest.mark.parametrize("name", ["srnn", "autoregressive", "vae"])
def test_methods_forecast_impute_and_score_tables_in_these_units(data, name, units):
    options = {"width": 4, "units": units} | ({} if name == "autoregressive" else {"latent": 2, "warm_up": 1})
    if name == "vae":
        del options["width"]
    model = dvae.fit(dvae.method(name, **options), data, steps=2, progress=False).model
    windows = data.windows("test")
    forecasts = windows.forecast(model, samples=3)
    assert np.isfinite(forecasts.draws).all()
    assert (forecasts.draws[..., 0] % 1 == 0).all()
    assert (forecasts.draws[..., :2] >= 0).all()
    assert np.isfinite(windows.impute(model, samples=2).draws).all()
    scores = dvae.evaluate(model, windows, scores=panel_scores, samples=3, references=["last value"], progress=False)
    assert np.isfinite(scores["model"]["ELBO"].mean)
    assert np.isfinite(data.ahead().forecast(model, samples=2).draws).all()


def test_runs_store_the_units(data, tmp_path):
    table = panel()
    path = tmp_path / "table.csv"
    rows = [
        ",".join([s.name, str(t), *("" if np.isnan(v) else repr(float(v)) for v in row)])
        for s in table
        for t, row in enumerate(s.values)
    ]
    path.write_text("\n".join(["id,t,riders,price,open,warmth,plan", *rows]))
    columns = replace(COLUMNS, id=("id",), time="t")
    opened = PanelData.open(path, columns, CUT)
    method = dvae.method("srnn", latent=2, width=4, warm_up=1, units="changes")
    fit = dvae.fit(method, opened, steps=2, progress=False, out=tmp_path / "run")
    loaded = dvae.load(tmp_path / "run")
    windows = opened.windows("test")
    expected, draws = (windows.forecast(model, samples=3).draws for model in (fit.model, loaded.model))
    np.testing.assert_array_equal(expected, draws)


@pytest.mark.parametrize(
    ("units", "seasons", "level", "drift", "amplitude"),
    [
        ("columns", 7, 0, 0, 4),
        ("columns", 3, 0, 0, 0),
        ("series", 3, 5, 0, 0),
        ("series", 7, 5, 0, 4),
        ("changes", 3, 5, 1, 0),
        ("seasonal", 3, 5, 0, 4),
    ],
)
def test_methods_take_the_units_that_the_training_windows_prefer(units, seasons, level, drift, amplitude):
    random, season = np.random.default_rng(0), np.tile([0, 1, 0, -1], 20)
    levels, steps = random.normal(0, level, (30, 1)), random.normal(0, drift, (30, 80)).cumsum(1)
    values = levels + steps + amplitude * season + random.normal(0, 0.3, (30, 80))
    data = PanelData.of(values[..., None], cut=Cut(4 * seasons, 4, season=4))
    assert data.schema.preferred == units
    assert dvae.method("srnn").resolve_defaults(data.windows("train")).units == units
    assert dvae.method("srnn", units="seasonal").resolve_defaults(data.schema).units == "seasonal"


def test_residual_means_of_tables_add_the_previous_value():
    method = dvae.method("autoregressive", width=4, residual=1.0)
    assert method.of_columns(FAMILIES["robust"]).residual == 1
    series = [Series(str(n), np.random.default_rng(n).normal(50 * n, 1, (20, 2))) for n in range(6)]
    numbers = Panel(series, Columns((Column("a"), Column("b", family="laplace"))))
    windows = PanelWindows(numbers, PanelSchema.from_data(numbers, Cut(8, 4)), "test")
    model = method.build(windows.schema)
    with torch.no_grad():
        for parameter in model.generator["x"].head.parameters():
            parameter.zero_()  # the network adds nothing
    batch = windows.all().past(8)
    means = model.forecast(batch, 4, draw_emission=False)["x"][0]
    torch.testing.assert_close(means, batch["x"][:, -1:].expand_as(means), rtol=1e-5, atol=1e-4)
    with pytest.raises(ValueError, match="the family 'count' has no location"):
        method.of_columns(FAMILIES["count"])


def test_units_of_sequences_need_a_table_with_numbers():
    with pytest.raises(SchemaError, match="which needs a table, but the data are sequences"):
        dvae.method("autoregressive", units="series").build({"x": 2})
    classes = Panel([Series(str(n), np.eye(9)[:, :1]) for n in range(6)], Columns((Column("a", family="binary"),)))
    schema = PanelSchema.from_data(classes, Cut(4, 2))
    with pytest.raises(SchemaError, match="need a column of numbers or counts"):
        schema.in_units("series")
