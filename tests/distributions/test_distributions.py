"""Distributions: draws match their moments, scales stay positive, and declarations are checked."""

from dataclasses import dataclass, replace

import pyro.distributions as dist
import pytest
import torch
from torch import nn

import dvae
from dvae import distributions
from dvae.data.views import View
from dvae.distributions import Shape
from dvae.distributions.family import FAMILIES
from dvae.networks import Recurrent

DISTRIBUTIONS = {
    "normal": distributions.Normal(),
    "normal, residual": distributions.Normal(residual=True),
    "fixed": distributions.FixedNormal(scale=0.5),
    "fixed, learned": distributions.FixedNormal(scale=0.5, learned=True, residual=True),
    "fixed, by step": distributions.FixedNormal(scale=2.0, learned=True, steps=3),
    "fixed, unprojected": distributions.FixedNormal(project=False),
    "student": distributions.StudentT(df=9.0),
    "student, residual": distributions.StudentT(df=9.0, residual=True),
}
B, T, D = 2, 3, 2
SHAPE = Shape(D, D)


def build(name):
    distribution = DISTRIBUTIONS[name].build(SHAPE).double()
    with torch.no_grad():
        for parameter in distribution.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return distribution


def previous(distribution, *shape):
    return torch.randn(*shape, D, dtype=torch.float64) if distribution.residual else None


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_draws_have_the_mean_and_the_variance_of_the_distribution(name):
    distribution = build(name)
    parameters = distribution(torch.randn(B, T, D, dtype=torch.float64), previous(distribution, B, T))
    expected = distribution.distribution(parameters)
    n = 20_000
    draws = distribution.draw(
        tuple(p.expand(n, B, T, D) for p in parameters), distribution.noise((n, B, T, D), parameters[0])
    )
    z_mean = (draws.mean(0) - expected.mean) / (expected.stddev / n**0.5)
    # The variance of a sample variance needs the fourth moment, which is finite here (df is 9 or so).
    squares = (draws - expected.mean).square()
    z_variance = (squares.mean(0) - expected.variance) / (squares.std(0) / n**0.5)
    assert z_mean.abs().max() < 5
    assert z_variance.abs().max() < 5


@pytest.mark.parametrize("name", [name for name in DISTRIBUTIONS if "residual" in name or name == "fixed, learned"])
@pytest.mark.parametrize("share", [1.0, 0.3])
def test_a_residual_location_keeps_its_share_of_the_previous_value(name, share):
    distribution = replace(DISTRIBUTIONS[name], residual=share).build(SHAPE).double()
    features, before = torch.randn(B, T, D, dtype=torch.float64), previous(distribution, B, T)
    with_previous, without_previous = distribution(features, before), distribution(features, torch.zeros_like(before))
    torch.testing.assert_close(with_previous[0] - without_previous[0], share * before)
    torch.testing.assert_close(with_previous[1:], without_previous[1:])


@pytest.mark.parametrize("spec", [distributions.Normal(min_scale=0.2), distributions.StudentT(min_scale=0.2)])
def test_scales_stay_above_their_minimum(spec):
    distribution = spec.build(SHAPE)
    with torch.no_grad():
        distribution.out.bias.fill_(-1e4)
    scale = distribution(torch.zeros(1, D))[1]
    assert scale.min() >= 0.2
    assert torch.isfinite(
        distribution.distribution(distribution(torch.zeros(1, D))).log_prob(torch.full((1, D), 1e3))
    ).all()


# ---------------------------------------------------------------------------------------------------- custom families


@dataclass(frozen=True)
class Custom:
    """A distribution of a custom class."""

    kind: type

    def build(self, shape):
        return self.kind(shape)


class Bernoulli(distributions.ConditionalDistribution):
    """A Bernoulli distribution of each coordinate."""

    support, discrete = dist.constraints.boolean, True

    def __init__(self, shape):
        super().__init__()
        self.out = nn.Linear(shape.features, shape.size)

    def forward(self, features, previous=None, t=None):
        return (torch.sigmoid(self.out(features)),)

    def distribution(self, parameters):
        return dist.Bernoulli(parameters[0], validate_args=False)

    def draw(self, parameters, noise):
        return torch.bernoulli(parameters[0])


class NoGradient(Bernoulli):
    """A continuous family whose draws have no gradient."""

    support, discrete, reparameterised = dist.constraints.real, False, False

    def distribution(self, parameters):
        return dist.Normal(parameters[0], 1.0)

    def draw(self, parameters, noise):
        return (parameters[0] + noise).detach()


class Pairs(Bernoulli):
    """A normal distribution whose events are pairs of coordinates."""

    support, discrete = dist.constraints.real, False

    def distribution(self, parameters):
        return dist.Normal(parameters[0].unflatten(-1, (-1, 2)), 1.0).to_event(1)


PAIR = "p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-1}, x_{1:T})"


def model(**kinds):
    return dvae.DynamicalVAE(
        *PAIR, {"z": 2, "x": 2}, Recurrent(4), {f"{k[0]}({k[1]})": Custom(h) for k, h in kinds.items()}
    )


@pytest.mark.parametrize(("key", "factor"), [("qz", r"q\(z_t \|"), ("pz", r"p\(z_t \|")])
def test_discrete_latents_are_an_error(key, factor):
    with pytest.raises(
        ValueError, match=rf"the latent z from the distribution of {factor}.* are discrete.*no gradient"
    ):
        model(**{key: Bernoulli})


def test_a_view_that_changes_the_volume_of_discrete_data_is_an_error():
    class Halved(View):
        def log_det(self, data):
            return torch.full_like(data["x"], 0.5).log()

    arguments = {"z": 2, "x": 2}, Recurrent(4), {"p(x)": Custom(Bernoulli)}
    with pytest.raises(ValueError, match="discrete"):
        dvae.DynamicalVAE(*PAIR, *arguments, view=Halved())


def test_latents_whose_draws_have_no_gradient_are_an_error():
    with pytest.raises(ValueError, match="reparameterised"):
        model(qz=NoGradient)
    with torch.no_grad():  # the grad mode at construction does not matter
        model(pz=NoGradient)
    with pytest.raises(ValueError, match="reparameterised"):  # the prior is the guide
        dvae.DynamicalVAE(
            "p(z_t | c_t) p(x_t | z_t)", None, {"z": 1, "x": 1, "c": 1}, distributions={"p(z)": Custom(NoGradient)}
        )


@pytest.mark.parametrize("key", ["px", "qz"])
def test_events_of_some_coordinates_are_an_error(key):
    x = torch.randn(2, 3, 2)
    with pytest.raises(ValueError, match=r"event shape \(2,\); its event_dim = 0 requires the event shape \(\)"):
        dvae.SequenceELBO().terms(model(**{key: Pairs}), x)


@pytest.mark.parametrize("kind", [dist.Bernoulli, dist.Exponential])
def test_a_distribution_with_an_undeclared_support_is_an_error(kind):
    class Undeclared(Bernoulli):
        support, discrete = dist.constraints.real, False

        def distribution(self, parameters):
            return kind(parameters[0], validate_args=False)

    with pytest.raises(ValueError, match=f"declare it .* discrete = {kind is dist.Bernoulli}"):
        dvae.SequenceELBO().terms(model(px=Undeclared), torch.zeros(2, 3, 2))


DECLARED = {
    **FAMILIES,
    "normals": distributions.StandardNormal(),
    "cauchy": distributions.Family("Cauchy"),
    "simplex": distributions.Family("Dirichlet"),
    "binomial": distributions.Family("Binomial", {"total_count": 10}),
    "heavy": distributions.Family("Pareto"),
    "parts": distributions.Product(
        (((0,), FAMILIES["positive"]), ((1, 2), FAMILIES["category"]), ((3,), FAMILIES["real"]))
    ),
    "mixture prior": distributions.Mixture(),
    "flow prior": distributions.Flow(),
}


@pytest.mark.parametrize("name", DECLARED)
def test_declarations_match_the_distributions(name):
    """The declarations are event_dim, discreteness, gradients of draws, and a value with a density."""
    prior = "prior" in name
    distribution = DECLARED[name].build(Shape(4, 0 if prior else 5, not prior)).eval()
    features = torch.randn(1, 0 if prior else 5, requires_grad=True)
    parameters = distribution(features)
    conditional = distribution.distribution(parameters)
    draw = distribution.draw(parameters, distribution.noise((1, 4), features))
    assert len(conditional.event_shape) == distribution.event_dim
    assert conditional.support.is_discrete == distribution.discrete
    assert distribution.reparameterised == (draw.requires_grad and not distribution.discrete) or name == "normals"
    inside = distribution.interior_point(4)
    value = torch.zeros(1, 4) if inside is None else inside[None]
    assert distribution.support is None or torch.isfinite(conditional.log_prob(value)).all()
