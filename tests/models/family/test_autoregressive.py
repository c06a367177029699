"""The model without latents: its bound is its likelihood, whatever the bound."""

import math

import pytest
import torch

import dvae
from dvae.networks import Recurrent
from dvae.testing import FactorizationContract

X = torch.randn(6, 7, 2)


class TestAutoregressive(FactorizationContract):
    waits = 1
    missing = {}  # noqa: RUF012

    def build(self, size):
        return dvae.method("autoregressive", width=4, embed=3, hidden=(4,)).build({"x": size})


class TestTwoVariables(FactorizationContract):
    missing = {}  # noqa: RUF012

    def build(self, size):
        laws = {"p(n)": dvae.distributions.Family("Poisson")}
        sizes, equations = {"n": size, "y": size}, "p(n_t | n_{<t}, y_{t-1}) p(y_t | n_t, y_{<t})"
        return dvae.DynamicalVAE(equations, None, sizes, Recurrent(4), laws, observed=("n", "y"))


def test_every_bound_is_the_likelihood():
    model = dvae.method("autoregressive", width=4).build({"x": 2}).eval()
    likelihood = model.log_joint(X, {})["x"]
    terms, weighted = dvae.SequenceELBO().terms(model, X), dvae.importance_bound(model, X, particles=50)
    torch.testing.assert_close(terms.bound, likelihood)
    torch.testing.assert_close(weighted.bound, likelihood)
    assert not weighted.khat.any()
    torch.testing.assert_close(dvae.particle_bound(model, X, particles=3).bound, likelihood, rtol=1e-5, atol=1e-5)


def test_its_forecasts_are_draws():
    model = dvae.method("autoregressive", width=4).build({"x": 2})
    assert model.forecast(X, 2, samples=5)["x"].std(0).min() > 0
    assert not model.forecast(X, 2, samples=5, draw_emission=False)["x"].std(0).any()


@pytest.mark.parametrize("guide", ["", None])
def test_a_model_without_a_method_is_the_same(guide):
    model = dvae.DynamicalVAE("p(x_t | x_{<t})", guide, {"x": 2})
    assert model.latents == ()
    likelihood = model.eval().log_joint(X, {})["x"]
    torch.testing.assert_close(dvae.SequenceELBO().terms(model, X).bound, likelihood)


def test_there_is_no_guide_to_calibrate():
    model = dvae.method("equations", generative="p(x_t | x_{<t})", inference="", width=4).build({"x": 2})
    with pytest.raises(ValueError, match="has no latents, so that its likelihood is exact and no guide"):
        dvae.calibrate(model, 4, 10, 9, progress=False)


@pytest.mark.parametrize(
    ("generative", "inference", "said"),
    [
        ("p(z_t) p(x_t | z_t)", "", r"the latent z has no factor in the guide; add q\(z_t \| ...\)"),
        ("p(x_t | x_{<t})", "q(z_t | x_{1:T})", r"no latent z in 'p\(x_t \| x_\{<t\}\)'; remove this factor"),
    ],
)
def test_a_guide_is_of_the_latents(generative, inference, said):
    with pytest.raises(ValueError, match=said):
        dvae.method("equations", generative=generative, inference=inference).build({"x": 2})


def test_it_beats_a_latent_model_where_there_is_nothing_latent():
    """On draws of an autoregression its likelihood is nearer to the truth than the bound of a chain of latents."""
    noise = torch.randn(256, 6, 1)
    x = noise.clone()
    for t in range(1, 6):
        x[:, t] = 0.9 * x[:, t - 1] + noise[:, t]
    bounds = []
    for name, options in (("autoregressive", {}), ("dkf", {"latent": 1, "warm_up": None})):
        model = dvae.method(name, emission="normal", width=8, **options).build({"x": 1})
        dvae.fit(model, x, steps=100, batch_size=64, learning_rate=3e-2, progress=False)
        bounds.append(dvae.importance_bound(model, x, particles=20).bound.mean() / 6)
    assert bounds[0] > bounds[1]
    assert float(bounds[0]) == pytest.approx(-0.5 * math.log(2 * math.pi * math.e), abs=0.1)
