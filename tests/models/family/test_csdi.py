"""CSDI: inputs of the model, density of the targets, imputation of normal data, and tables."""

import math
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
import torch
from torch.distributions import MultivariateNormal

import dvae
from dvae.data.schema import SchemaError
from dvae.data.sequences import RandomGiven, sequences
from dvae.data.views import Given
from dvae.distributions import Diffusion
from dvae.networks import Denoiser, Recurrent, SelfAttention
from dvae.tables import Column, Columns
from dvae.tables.dataset import PanelData
from dvae.tables.protocol import Cut
from dvae.testing import FactorizationContract

pd = pytest.importorskip("pandas")

SMALL = {"width": 8, "heads_count": 2, "layers": 1, "sampler_steps": 2}


def small(**options):
    return dvae.method("csdi", **{**SMALL, **options})


def frozen(model):
    """Return the model with a fixed noise level, and noise that is a function of the value."""
    model.generator["x"].head.perturb = lambda u: (torch.full_like(u[..., :1, :1], 0.4), (3 * u).sin())
    return model


def frame(count=8, t=16, scale=1.0):
    """Return a table with missing targets and covariates, and uneven steps; levels differ between sequences."""
    rng, parts = np.random.default_rng(0), []
    for n in range(count):
        columns = {"flow": rng.lognormal(3 * (n % 2), 0.3, t), "temp": scale * (20 + 5 * n + rng.normal(0, 1, t))}
        columns |= {"plan": rng.normal(size=t), "rain": rng.normal(size=t)}
        part = pd.DataFrame(columns)
        part = part.mask(rng.random(part.shape) < 0.15)
        parts.append(part.assign(site=f"s{n}", day=np.cumsum(rng.choice([1, 1, 3], t)), height=rng.normal()))
    return pd.concat(parts, ignore_index=True)


COLUMNS = Columns(
    (
        Column("flow", family="log-normal"),
        Column("temp"),
        Column("plan", "known"),
        Column("rain", "past"),
        Column("height", "static"),
    ),
    ("site",),
    "day",
)


@pytest.fixture(scope="module")
def data():
    return PanelData.of(frame(), COLUMNS, Cut(6, 3))


@pytest.fixture
def batch(data):
    return data.windows("train").sample(4, torch.Generator().manual_seed(0))


def built(data, **options):
    torch.manual_seed(0)
    return small(**options).build(data.schema).double().eval()


class TestCSDI(FactorizationContract):
    missing: ClassVar = {}

    def build(self, size):
        return frozen(small().build({"x": size}))

    def test_the_log_joint_is_that_of_the_per_step_program(self):
        pytest.skip("the shares of the steps in a joint bound are not conditional densities")

    def test_every_size_may_be_one(self):
        model, x = small().build({"x": 1}), torch.randn(1, 1, 1)
        assert dvae.SequenceELBO().terms(model, x).bound.isfinite()
        assert model.forecast(x, 1)["x"].isfinite().all()

    def test_a_bound_stays_on_its_device(self):
        pytest.skip("this test gives the context; tests/testing/test_device.py covers the method")

    def test_training_stays_finite(self):
        pytest.skip("this test gives the context; the test on normal data covers training")


@pytest.mark.parametrize("units", ["columns", "logs", "series"])
def test_given_entries_and_units_do_not_depend_on_targets(data, batch, units):
    """The Jacobian of all parameters with respect to targets is exactly zero, and not with respect to given entries."""
    if units == "columns":
        columns = tuple(replace(each, family="real") for each in COLUMNS.columns)
        data = PanelData.of(frame(), replace(COLUMNS, columns=columns), Cut(6, 3))
    model = built(data, units=units)
    given = torch.rand(batch["x"].shape, generator=torch.Generator().manual_seed(1)) < 0.5

    def parameters(x):
        read = model.read({**batch, "x": x, "given": given})
        loc, scale, features, _ = model.rollout(read).parameters("x", torch.zeros_like(x))
        units = [read[name] for name in ("x_location", "x_scale") if name in read]
        return torch.cat([loc, scale, features, *units], -1).sum((0, 1))

    jacobian = torch.autograd.functional.jacobian(parameters, batch["x"].double())
    depends = (jacobian != 0).any(0)
    assert not depends[~(given & batch["mask"])].any()
    assert depends[given & batch["mask"]].all()


def test_the_density_counts_targets_only_and_changes_with_the_unit_by_the_jacobian(data, batch):
    """Values of missing entries change nothing; log p(a x) = log p(x) - log a for each target of a column."""
    given = torch.rand(batch["x"].shape, generator=torch.Generator().manual_seed(1)) < 0.5
    counted, bounds = batch["mask"] & ~given, []
    for scale in (1.0, 1000.0):
        model = frozen(built(PanelData.of(frame(scale=scale), COLUMNS, Cut(6, 3)), units="series"))
        x = batch["x"] * torch.tensor([1.0, scale])
        for fill in (1.0, math.nan):
            hidden = torch.where(batch["mask"], x, fill)
            terms = dvae.SequenceELBO().terms(model, {**batch, "x": hidden, "given": given})
            bounds.append(terms.bound.detach())
        assert (terms.steps["x"][~counted.any(-1)] == 0).all()
        assert torch.equal(terms.n_steps, counted.any(-1).sum(1).clamp(min=1).double())
    expected = bounds[0] - math.log(1000.0) * counted[..., 1].sum(1)
    torch.testing.assert_close(bounds[0], bounds[1], rtol=0, atol=0)
    torch.testing.assert_close(bounds[2], expected, rtol=0, atol=1e-5)


def test_the_exact_density_is_that_of_observed_entries():
    """A denoiser that returns 0 has a normal density in each entry."""
    distributions = {"p(x)": Diffusion(denoiser=Denoiser(SelfAttention(8, 2)), log_snr=(-16.0, 16.0))}
    model = dvae.DynamicalVAE("p(x_{1:T} | s)", "", {"x": 2, "s": 1}, distributions=distributions).double()
    for parameter in model.generator["x"].head.denoiser.out.parameters():
        torch.nn.init.zeros_(parameter)
    x, s, mask = torch.randn(3, 5, 2).double(), torch.randn(3, 1).double(), torch.rand(3, 5, 2) < 0.6
    run = model.rollout({"x": x, "s": s, "mask": mask})
    loc, scale, *_ = run.parameters("x", run.values["x"])
    expected = torch.where(mask, torch.distributions.Normal(loc, scale).log_prob(x), 0.0).sum((1, 2)).detach()
    exact = run.evaluate("x", run.values["x"]).exact_log_prob(run.values["x"]).log_prob
    torch.testing.assert_close(exact, expected, rtol=0, atol=1e-4)
    bound = torch.stack([dvae.SequenceELBO().terms(model, {"x": x, "s": s, "mask": mask}).bound for _ in range(2)])
    torch.testing.assert_close(bound, expected.expand(2, -1), rtol=0, atol=1e-3)


def test_random_targets_are_futures_steps_or_entries():
    source = RandomGiven(sequences(torch.zeros(400, 6, 3)), 4)
    given = source.sample(400, torch.Generator().manual_seed(0))["given"]
    assert torch.equal(given, source.sample(400, torch.Generator().manual_seed(0))["given"])
    is_future = (given == (torch.arange(6) < 4)[:, None]).all((1, 2))
    by_step = (given == given[..., :1]).all((1, 2)) & ~is_future
    assert is_future.float().mean() == pytest.approx(0.5, abs=0.1)
    assert by_step.float().mean() > 0.2
    shares = given[~is_future].float().mean((1, 2))
    assert shares.mean() == pytest.approx(0.5, abs=0.1)
    assert shares.std() > 0.2
    none = ~RandomGiven(sequences(torch.zeros(400, 6, 3))).sample(400, torch.Generator())["given"].any((1, 2))
    assert none.float().mean() > 0.05


def test_draws_have_the_conditional_mean_and_variance_of_normal_data():
    """AR(1) with coefficient 0.8 and unit variance; half of the entries or the first two are given."""
    length, steps = 5, torch.arange(5)
    covariance = 0.8 ** (steps[:, None] - steps).abs().double()
    torch.manual_seed(0)
    normal = MultivariateNormal(torch.zeros(length).double(), covariance)
    options = {"steps": 400, "batch_size": 128, "learning_rate": 5e-3, "decay": 0.05}
    x = normal.sample((3000,))[..., None].float()
    fit = dvae.fit(small(width=32, sampler_steps=30), x, **options, progress=False, accelerator="cpu")
    test = normal.sample((30,))[..., None].float()
    mask = torch.rand(30, length, 1) < 0.5
    mask[:10, :, 0], mask[10:, 2] = steps < 2, False
    draws = fit.model.eval().impute({"x": test, "mask": mask}, samples=400)["x"].double()
    errors, ratios = [], []
    for row, given in enumerate(mask[..., 0]):
        weights = torch.linalg.solve(covariance[given][:, given], covariance[given][:, ~given]).mT
        conditional = covariance[~given][:, ~given] - weights @ covariance[given][:, ~given]
        deviation, values = conditional.diagonal().sqrt(), draws[:, row, ~given, 0]
        errors.append((values.mean(0) - weights @ test[row, given, 0].double()) / deviation)
        ratios.append(values.std(0) / deviation)
    assert torch.cat(errors).square().mean().sqrt() < 0.25  # 0.05 are Monte Carlo errors
    assert torch.cat(ratios).mean() == pytest.approx(1.0, abs=0.1)
    assert (torch.cat(ratios) - 1).square().mean().sqrt() < 0.2
    # draws of a long gap continue from window to window, here between steps 3 and 4, and 5 and 6
    steps = torch.arange(10)
    long = MultivariateNormal(torch.zeros(10).double(), 0.8 ** (steps[:, None] - steps).abs().double())
    gap = torch.ones(30, 10, 1, dtype=torch.bool)
    gap[:, 2:8] = False
    filled = fit.model.impute({"x": long.sample((30,))[..., None].float(), "mask": gap}, samples=200)["x"][..., 2:8, 0]
    residuals = (filled - filled.mean(0)).flatten(0, 1)
    correlations = torch.corrcoef(residuals.mT).diagonal(1)[[1, 3]]
    assert ((correlations > 0.45) & (correlations < 0.9)).all()


@pytest.mark.parametrize("units", ["logs", "series"])
def test_it_fits_forecasts_and_imputes_a_table(data, tmp_path, units):
    """Also sequences that are longer than the training windows, and a run that is loaded again."""
    options = {"steps": 4, "batch_size": 4, "validate_every": 2, "progress": False}
    dvae.fit(small(units=units), data, out=tmp_path / "run", **options)
    model, windows = dvae.load(tmp_path / "run").model, data.windows("test")
    assert {*model.context} == {"g", "c", "d", "s"}
    forecasts = windows.forecast(model, samples=3)
    assert forecasts.draws.shape == (3, len(windows), 3, 2)
    assert (forecasts.draws[..., 0] > 0).all()
    assert (forecasts.draws.std(0) > 0).all()
    whole = data.whole()
    imputed, batch = whole.impute(model, samples=3), whole.all()
    assert batch["x"].shape[1] > model.window == 9
    observed = batch["mask"].numpy()
    assert np.array_equal(
        imputed.draws[:, observed], np.broadcast_to(batch["x"].numpy()[observed], (3, observed.sum()))
    )
    assert (imputed.draws[:, imputed.missing].std(0) > 0).all()
    scores = dvae.evaluate(model, windows, samples=3, progress=False)
    assert np.isfinite(scores["model"]["CRPS"].mean)
    assert any("densities of steps after the first 6 given the first 6" in note for note in scores.notes)
    other = dvae.method("autoregressive", width=4).build(data.schema)
    with pytest.raises(ValueError, match="bounds are comparable only as densities of the same data"):
        dvae.compare({"csdi": model, "autoregressive": other}, windows, progress=False)


@pytest.mark.parametrize("units", ["logs", "series"])
def test_bounds_of_whole_sequences_are_of_all_entries_and_comparable(units):
    """Sequences of different lengths."""
    table = frame()
    data = PanelData.of(table[(table.site != "s3") | (table.groupby("site").cumcount() < 10)], COLUMNS, Cut())
    options = {"steps": 2, "batch_size": 4, "validate_every": 2, "progress": False}
    models = {
        "csdi": dvae.fit(small(units=units), data, **options).model,
        "autoregressive": dvae.fit(dvae.method("autoregressive", width=4), data, **options).model,
    }
    imputed = data.whole().impute(models["csdi"], samples=3)
    assert (imputed.draws[:, imputed.missing].std(0) > 0).all()
    result = dvae.compare(models, data.windows("test"), particles=1, contrasts=0, progress=False)
    assert any("stochastic lower bound" in note for note in result.rows["csdi"].notes)


def test_every_window_of_a_long_sequence_is_filled():
    model = small().build(torch.randn(4, 6, 2)).eval()
    for length in (6, 7, 11, 23):
        x, mask = torch.randn(3, length, 2), torch.rand(3, length, 2) < 0.5
        lengths = torch.tensor([length, 1, length // 2])
        for ragged in ({}, {"lengths": lengths}):
            filled = model.impute({"x": x, "mask": mask, **ragged}, 2)["x"]
            assert torch.equal(filled[:, mask], x[mask].expand(2, -1))
            assert (filled[:, 0].std(0)[~mask[0]] > 0).all()
        whole = x.round().long()
        for batch in ({"x": whole, "mask": mask}, {"x": whole.numpy(), "mask": mask.numpy()}):
            filled = model.impute(batch, 2)["x"]
            assert filled.dtype == torch.float32
            assert (filled[:, ~mask] % 1 != 0).all()
        with pytest.raises(ValueError, match="samples and chunk must be at least 1"):
            model.impute({"x": x, "mask": mask}, 0)
    past, forecasts = torch.randn(2, 20, 2), []
    for start in (0, 17):  # a forecast reads as many steps as a training window has
        torch.manual_seed(0)
        forecasts.append(model.forecast(past[:, start:], 3, 2)["x"])
    torch.testing.assert_close(*forecasts)


def test_a_model_of_your_own_imputes_with_the_view():
    pair = "p(w | g_{1:T}) p(x_{1:T} | g_{1:T}, w)", "q(w | x_{1:T}, g_{1:T})"
    distributions = {"p(x)": Diffusion(denoiser=Denoiser(SelfAttention(8, 2)), steps=2)}
    sizes = {"w": 2, "x": 3, "g": 6}
    model = dvae.DynamicalVAE(*pair, sizes, Recurrent(8), distributions, view=Given("g", 4))
    x, mask = torch.randn(2, 5, 3), torch.rand(2, 5, 3) < 0.5
    filled = model.impute({"x": x, "mask": mask}, 4)["x"]
    assert torch.equal(filled[:, mask], x[mask].expand(4, -1))
    assert model.forecast(x[:, :4], 3, 2)["x"].shape == (2, 2, 3, 3)
    assert dvae.SequenceELBO().terms(model, x).n_steps.tolist() == [1.0, 1.0]
    mask = torch.arange(5)[:, None].expand(2, 5, 3) > 1  # a missing step is neither given nor a target
    assert dvae.SequenceELBO().terms(model, {"x": x, "mask": mask}).n_steps.tolist() == [1.0, 1.0]
    with pytest.raises(ValueError, match="context of size 2 x 3"):
        dvae.DynamicalVAE(*pair, {**sizes, "g": 3}, Recurrent(8), distributions, view=Given("g"))
    with pytest.raises(ValueError, match="remove `fix`"):
        model.forecast(x, 2, fix={"w": torch.zeros(2, 2)})


def test_units_are_chosen_for_the_data(data):
    assert small().resolve_defaults(replace(data.schema, preferred="columns")).units == "logs"
    assert small().resolve_defaults(replace(data.schema, preferred="seasonal")).units == "series"
    assert small().resolve_defaults({"x": 2}).units == "columns"


@pytest.mark.parametrize(
    ("options", "changes", "message"),
    [
        ({}, {"flow": {"family": "count"}}, "column 'flow' has the family 'count'; give it the family real"),
        ({}, {"temp": {"family": "category", "classes": ("a", "b")}}, "column 'temp' has the family 'category'"),
        ({}, {"temp": {"family": "binary"}}, "column 'temp' has the family 'binary'"),
        ({}, {"flow": {"family": "binary"}, "temp": {"family": "binary"}}, "column 'flow' has the family 'binary'"),
        ({"units": "columns"}, {}, "column 'flow' has the family 'log-normal'"),
        ({"units": "changes"}, {}, "known: columns, logs, series"),
        ({"residual": 0.5}, {}, "residual"),
        ({"width": 9}, {}, "multiple of heads_count"),
    ],
)
def test_columns_and_options_that_do_not_fit_are_an_error(options, changes, message):
    columns = tuple(replace(each, **changes.get(each.name, {})) for each in COLUMNS.columns)
    table = frame().assign(**dict.fromkeys(changes, "a" if "classes" in changes.get("temp", {}) else 1.0))
    with pytest.raises((ValueError, SchemaError), match=message):
        small(**options).build(PanelData.of(table, replace(COLUMNS, columns=columns), Cut(6, 3)).schema)


def test_lags_are_refused():
    table = frame()
    table["day"] = table.groupby("site").cumcount()
    data = PanelData.of(table, replace(COLUMNS, lags=(3,)), Cut(6, 3))
    with pytest.raises(SchemaError, match="leave lags out"):
        small().build(data.schema)
