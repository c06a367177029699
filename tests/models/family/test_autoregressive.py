"""The model without latents: every bound is its likelihood."""

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
        distributions = {"p(n)": dvae.distributions.Family("Poisson")}
        sizes, equations = {"n": size, "y": size}, "p(n_t | n_{<t}, y_{t-1}) p(y_t | n_t, y_{<t})"
        return dvae.DynamicalVAE(equations, None, sizes, Recurrent(4), distributions, observed=("n", "y"))


def test_every_bound_is_the_likelihood():
    model = dvae.method("autoregressive", width=4).build({"x": 2}).eval()
    likelihood = model.log_joint(X, {})["x"]
    terms, weighted = dvae.SequenceELBO().terms(model, X), dvae.iwae_bound(model, X, particles=50)
    torch.testing.assert_close(terms.bound, likelihood)
    torch.testing.assert_close(weighted.bound, likelihood)
    assert not weighted.khat.any()
    torch.testing.assert_close(dvae.fivo_bound(model, X, particles=3).bound, likelihood, rtol=1e-5, atol=1e-5)
