"""Families of observations satisfy the contract of models, with correct densities, means and draws."""

import re
from pathlib import Path

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from scipy import special, stats

import dvae
from dvae import distributions
from dvae.distributions import Family, Shape
from dvae.distributions.hurdle import HurdleLogNormal
from dvae.inference.training.svi import NonFiniteError
from dvae.networks import Dense, Recurrent
from dvae.program.model import DynamicalVAE
from dvae.testing import FactorizationContract

PAIR = "p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-1}, x_{1:T})"
MIXED = distributions.Product((((1,), Family("Poisson")), ((0, 3), distributions.Normal()), ((2,), Family("Gamma"))))
ONE_OF_TWO = distributions.Product((((1,), Family("Poisson")), ((0, 2), Family("OneHotCategorical"))))
ALL = {
    **distributions.FAMILIES,
    "multivariate": Family("MultivariateNormal"),
    "simplex": Family("Dirichlet"),
    "of twelve": Family("Binomial", given={"total_count": 12}),
    "learned count": Family("NegativeBinomial", learned=("total_count",)),
    "cauchy": Family("Cauchy"),
}


def built(distribution, size=2):
    return dvae.DynamicalVAE(*PAIR, {"z": 2, "x": size}, Recurrent(4), {"p(x)": distribution})


class Contract(dvae.testing.FactorizationContract):
    """The contract, for one family of each class."""

    missing = None
    distribution = None

    def build(self, size):
        return built(self.distribution, size)


class TestCategorical(Contract):
    distribution = Family("OneHotCategorical")


# with one class, or each class observed once, there is no signal to learn


class TestNormalMixture(Contract):
    distribution = distributions.NormalMixture(3)


class TestLowRankNormal(Contract):
    distribution = distributions.LowRankNormal(1)


class TestMixed(Contract):
    """Coordinates of three families."""

    def build(self, size):
        half = (size + 1) // 2
        parts = [
            (tuple(range(half)), Family("Poisson")),
            (tuple(range(half, size)), distributions.Normal(residual=True)),
        ]
        return built(distributions.Product(tuple(part for part in parts if part[0])), size)


class TestSeveralVariables(dvae.testing.FactorizationContract):
    """Several data variables that have different families and read each other."""

    missing = None

    def build(self, size):
        return dvae.DynamicalVAE(
            "p(z_t | z_{t-1}) p(n_t | n_{t-1}, z_t) p(c_t | n_t, z_t) p(x_t | x_{t-1}, c_t, z_t)",
            "q(z_t | z_{t-1}, n_{1:T}, c_{1:T}, x_{1:T})",
            {"z": 2, "n": size, "c": 3, "x": size},
            Recurrent(4),
            {"p(n)": Family("Poisson"), "p(c)": Family("OneHotCategorical"), "p(x)": distributions.Normal()},
            observed=("n", "c", "x"),
        )


# ------------------------------------------------------------------------------------------- means and densities


@pytest.mark.parametrize("name", ALL)
def test_draws_have_the_mean_of_their_distribution(name):
    distribution = ALL[name].build(Shape(3, 4)).double()
    parameters = distribution(0.3 * torch.randn(2, 4, dtype=torch.float64))  # moderate tails
    n = 20_000
    many = tuple(p.expand(n, *p.shape) for p in parameters)
    draws = distribution.draw(many, distribution.noise((n, 2, 3), parameters[0]))
    if name == "cauchy":
        assert torch.equal(distribution.mean(parameters), parameters[0])
    elif name == "angle":
        middle = torch.atan2(draws.sin().mean(0), draws.cos().mean(0))
        torch.testing.assert_close(middle, distribution.mean(parameters), atol=0.1, rtol=0)
    else:
        z = (draws.mean(0) - distribution.mean(parameters)) / (draws.std(0) / n**0.5 + 1e-12)
        assert z.abs().max() < 5


DENSITIES = {
    "laplace": lambda p, v: stats.laplace(p[0], p[1]).logpdf(v),
    "positive": lambda p, v: stats.gamma(p[0], scale=1 / p[1]).logpdf(v),
    "log-normal": lambda p, v: stats.lognorm(p[1], scale=np.exp(p[0])).logpdf(v),
    "hurdle": lambda p, v: np.where(
        v == 0,
        stats.logistic.logcdf(p[0]),
        stats.logistic.logsf(p[0]) + stats.lognorm(p[2], scale=np.exp(p[1])).logpdf(np.where(v == 0, 1, v)),
    ),
    "power": lambda p, v: stats.expon(scale=1 / p[0]).logpdf(v),
    "share": lambda p, v: stats.beta(p[0], p[1]).logpdf(v),
    "angle": lambda p, v: stats.vonmises(p[1], p[0]).logpdf(v),
    "count": lambda p, v: stats.poisson(p[0]).logpmf(v),
    "overdispersed": lambda p, v: stats.nbinom(p[0], 1 / (1 + np.exp(p[1]))).logpmf(v),
    "binary": lambda p, v: stats.bernoulli(1 / (1 + np.exp(-p[0]))).logpmf(v),
}


@pytest.mark.parametrize("name", DENSITIES)
def test_densities_equal_those_of_scipy(name):
    distribution = ALL[name].build(Shape(3, 4)).double()
    with torch.no_grad():
        parameters = distribution(torch.randn(2, 4, dtype=torch.float64))
        value = distribution.draw(parameters, distribution.noise((2, 3), parameters[0]))
        log_densities = distribution.distribution(parameters).log_prob(value)
    expected = DENSITIES[name]([p.numpy() for p in parameters], value.numpy())
    np.testing.assert_allclose(log_densities.numpy(), expected, atol=1e-6 if name == "angle" else 1e-10)


def test_angles_have_densities_and_gradients_at_every_float32_concentration():
    distribution, logs = Family("VonMises", project=False).build(Shape(1, 2)), torch.linspace(-80.0, 80.0, 33)
    features = torch.stack([torch.full_like(logs, 0.25), logs], -1).requires_grad_()
    concentration = logs.exp().double().numpy()
    value = (0.25 + torch.exp(-logs / 2).clamp(max=2.0))[:, None]
    distance = (value.double() - 0.25).numpy()[:, 0]
    kernel = -2 * np.sin(distance / 2) ** 2
    density = distribution.distribution(distribution(features)).log_prob(value)[:, 0]
    expected = concentration * kernel - np.log(2 * np.pi * special.i0e(concentration))
    np.testing.assert_allclose(density.detach().numpy(), expected, rtol=1e-5, atol=1e-5)
    (gradient,) = torch.autograd.grad(density.sum(), features)
    np.testing.assert_allclose(gradient[:, 0].numpy(), concentration * np.sin(distance), rtol=1e-5)
    moderate = logs < 25  # at higher concentrations even scipy's 1 - I_1 / I_0 is 0
    slope = concentration * (kernel + 1 - special.i1e(concentration) / special.i0e(concentration))
    np.testing.assert_allclose(gradient[moderate, 1].numpy(), slope[moderate], rtol=1e-3, atol=1e-5)
    assert gradient.isfinite().all()
    draws = distribution.draw(distribution(features), distribution.noise((33, 1), features))
    assert draws.isfinite().all()


@pytest.mark.parametrize("name", [name for name in ALL if ALL[name].build(Shape(3, 4)).location_scale])
def test_rescaling_a_distribution_is_a_change_of_variables(name):
    distribution = ALL[name].build(Shape(3, 4)).double()
    parameters = distribution(torch.randn(2, 4, dtype=torch.float64))
    if name == "fixed":
        assert distribution.learned  # a given scale is in the unit of the variable
    scale = torch.tensor([0.5, 2.0, 30.0], dtype=torch.float64)
    mean = torch.arange(3.0).double() * (name in REAL)
    rescaled = distribution.rescale(parameters, mean, scale)
    torch.testing.assert_close(distribution.mean(rescaled), mean + scale * distribution.mean(parameters))
    if not distribution.distribution(parameters).support.is_discrete:
        value = distribution.draw(parameters, distribution.noise((2, 3), parameters[0])).detach()
        volume = scale.log() if not distribution.distribution(parameters).event_shape else scale.log().sum()
        volume = torch.where(value == 0, 0.0, volume) if name == "hurdle" else volume  # the mass at 0 has no volume
        log_density = distribution.distribution(parameters).log_prob(value)
        torch.testing.assert_close(
            distribution.distribution(rescaled).log_prob(mean + scale * value), log_density - volume
        )


REAL = ("real", "fixed", "robust", "laplace", "mixture", "correlated", "multivariate", "cauchy")


def test_a_product_has_the_densities_and_means_of_its_parts():
    distribution = MIXED.build(Shape(4, 5)).double()
    parameters = distribution(torch.randn(2, 3, 5, dtype=torch.float64))
    value = distribution.draw(parameters, distribution.noise((2, 3, 4), parameters[0]))
    product, parts = distribution.distribution(parameters), distribution.split(parameters)
    for part, indices, part_parameters in parts:
        expected = part.distribution(part_parameters).log_prob(value[..., indices])
        torch.testing.assert_close(product.log_prob(value)[..., indices], expected)
        torch.testing.assert_close(distribution.mean(parameters)[..., indices], part.mean(part_parameters))
    assert product.support.check(value).all()
    assert not product.support.check(value - 100)[..., 1:3].any()
    overlapping = distributions.Product((((0, 1), distributions.Normal()), ((1,), distributions.Normal())))
    with pytest.raises(ValueError, match="each coordinate 0 to 3 of x exactly once"):
        overlapping.build(Shape(4, 5, name="x"))
    with pytest.raises(ValueError, match="density"):
        distributions.Product((((0, 1), distributions.Delta()),)).build(Shape(2, 2, name="x"))


def test_an_event_in_a_product_counts_once_and_cannot_be_partly_missing():
    model = built(ONE_OF_TWO, 3).double()
    data = model.sample(4, 5)
    mask = torch.ones_like(data["x"], dtype=torch.bool)
    mask[0, :, [0, 2]] = False
    with pytest.raises(ValueError, match="one joint density for 2 of them"):
        model.log_joint({"x": data["x"], "mask": mask.index_fill(2, torch.tensor([2]), True)}, {"z": data["z"]})
    complete = model.log_joint({"x": data["x"]}, {"z": data["z"]})["x"]
    masked = model.log_joint({"x": data["x"], "mask": mask}, {"z": data["z"]})["x"]
    torch.testing.assert_close(complete[1:], masked[1:], rtol=1e-12, atol=0)
    assert complete[0] < masked[0]


def test_a_hurdle_is_a_point_mass_at_zero_and_a_log_normal():
    gate, loc, scale = (torch.tensor([each], dtype=torch.float64) for each in (0.4, 0.2, 0.7))
    hurdle = HurdleLogNormal(gate, loc, scale)
    torch.manual_seed(0)
    draws = hurdle.sample((100_000,))
    assert (draws == 0).double().mean().item() == pytest.approx(
        gate.sigmoid().item(), abs=5 * (0.25 / len(draws)) ** 0.5
    )
    assert draws.var().item() == pytest.approx(hurdle.variance.item(), rel=0.1)
    grid = torch.linspace(1e-4, 60, 200_001, dtype=torch.float64)[:, None]
    mass = torch.trapezoid(hurdle.log_prob(grid).exp(), grid, dim=0) + hurdle.log_prob(torch.zeros(1)).exp()
    torch.testing.assert_close(mass, torch.ones(1, dtype=torch.float64), atol=1e-6, rtol=0)
    for value in (-1.0, 0.0, 0.5, 2.0):
        assert (draws <= value).double().mean().item() == pytest.approx(
            hurdle.cdf(torch.tensor([value])).item(), abs=0.01
        )


# ------------------------------------------------------------- draws against densities, by a posterior on a grid

T, SIZE, DRAWS = 5, 3, 9
EDGES = torch.linspace(-5, 5, 402, dtype=torch.float64)


def latent_model(distribution):
    """Return a model whose latent w changes every parameter of the distribution."""
    torch.manual_seed(0)
    networks = {"p(x)": Dense((4,)), "default": Dense((2,))}
    model = dvae.DynamicalVAE("p(w) p(x_t | w)", "q(w)", {"w": 1, "x": SIZE}, networks, {"p(x)": distribution}).double()
    for name, parameter in model.generator["x"].named_parameters():
        parameter.data *= 2 if name.endswith("weight") else 1
    return model


def posterior(model):
    """Return a guide that draws w given x from its density, constant on each of 401 intervals."""

    def guide(batch):
        x, middles = batch["x"].unflatten(0, (DRAWS, -1))[0], (EDGES[1:] + EDGES[:-1]) / 2  # the other rows are copies
        w = middles[:, None]
        parameters = model.generator["x"]({"w": w}, len(w), T)
        distribution = model.generator["x"].head.distribution(tuple(p[:, None] for p in parameters))  # (G, 1, T, ...)
        log_likelihood = distribution.log_prob(x).flatten(2).sum(-1)
        logits = log_likelihood + dist.Normal(0.0, 1.0).log_prob(w)
        interval = dist.Categorical(logits=logits.T).sample((DRAWS,)).flatten()
        value = middles[interval] + (torch.rand(len(interval)) - 0.5).double() * (EDGES[1] - EDGES[0])
        with pyro.plate("sequences", len(value)):
            pyro.sample("w", dist.Delta(value[:, None]).to_event(1))

    return guide


@pytest.mark.parametrize("name", [*distributions.FAMILIES, "multivariate", "simplex"])
def test_the_posterior_is_calibrated(name):
    model = latent_model(ALL[name])
    calibration = dvae.calibrate(model, T, 400, DRAWS, guide=posterior(model), progress=False)
    assert calibration.p_value > 1e-3


# ----------------------------------------------------------------------------------------------- forecasts and errors


def test_forecasts_of_discrete_data_are_draws_by_default():
    counts = built(Family("Poisson"))
    past = counts.sample(2, 4)["x"]
    assert not counts.forecast(past, 3, samples=5)["x"].frac().any()
    assert counts.forecast(past, 3, samples=5, draw_emission=False)["x"].frac().any()
    missing = built(distributions.Product((((0,), Family("Poisson")), ((1,), distributions.Normal()))))
    assert not missing.forecast(missing.sample(2, 4)["x"], 3)["x"][..., 0].frac().any()


@pytest.mark.parametrize(
    ("distribution", "value", "message"),
    [
        (Family("Poisson"), 0.5, "coordinate"),
        (Family("Bernoulli"), 2.0, "values are 0 or 1"),
        (Family("Exponential"), -1.0, "values are at least 0"),
        (Family("LogNormal"), 0.0, "values are above 0"),
        (Family("Dirichlet"), 0.0, "values"),
        (
            distributions.Product((((0,), Family("Beta")), ((1,), distributions.Normal()))),
            0.0,
            "of 0: above 0 and below 1",
        ),
        (Family("OneHotCategorical"), 1.0, "coordinate"),
    ],
)
def test_observed_values_outside_the_support_are_an_error(distribution, value, message):
    model = built(distribution)
    data = model.sample(2, 4)["x"]
    if model.generator["x"].whole:
        data[1, 2] = 1.0
    data[1, 2, 0] = value
    with pytest.raises(ValueError, match=message):
        dvae.SequenceELBO().terms(model, data)
    mask = torch.ones_like(data, dtype=torch.bool)
    mask[1, 2] = False
    assert torch.isfinite(dvae.SequenceELBO().terms(model, {"x": data, "mask": mask}).bound).all()


def test_values_outside_a_support_that_depends_on_parameters_are_an_error():
    """A binomial of 12 trials has no value 20; the first bound shows it."""
    x = torch.full((4, 3, 2), 20.0)
    with pytest.raises(NonFiniteError, match="sequences"):
        dvae.fit(built(Family("Binomial", given={"total_count": 12})), x, steps=1, progress=False)


def test_a_forecast_of_the_mean_needs_a_distribution_with_a_mean():
    shapes = {"locs": (4, -1), "coord_scale": (4, -1), "component_logits": (4,)}
    model = built(Family("MixtureOfDiagNormals", shapes=shapes))
    past = model.sample(2, 4)["x"]
    assert model.forecast(past, 2, draw_emission=True)["x"].shape == (1, 2, 2, 2)
    with pytest.raises(ValueError, match="MixtureOfDiagNormals"):
        model.forecast(past, 2, draw_emission=False)


def test_a_custom_class_is_a_valid_family():
    class Twice(dist.Poisson):
        """A custom distribution."""

    assert built(Family(Twice)).generator["x"].head.label == "Twice"


# ------------------------------------------------------------ the custom family of docs/how-to/observations.md

PAGE = (Path(__file__).parents[2] / "docs" / "how-to" / "observations.md").read_text(encoding="utf-8")
NAMESPACE: dict = {}
(example,) = re.findall(r"```python\n(.*?)```", PAGE.partition("## Your own distribution")[2], re.DOTALL)
(definitions, _) = example.split("\nmodel = ")
exec(compile("import torch, dvae\n" + definitions, "observations.md", "exec"), NAMESPACE)


class TestCustomFamilyOfThePage(FactorizationContract):
    """The family that docs/how-to/observations.md defines."""

    def build(self, size):
        return DynamicalVAE(*PAIR, {"z": size, "x": size}, distributions={"p(x)": NAMESPACE["Bursts"]()})
