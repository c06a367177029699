"""The conditional flow is a bijection, and its density equals the one by its Jacobian."""

import sys

import pyro.distributions as dist
import pytest
import torch

import dvae
from dvae.distributions import ConditionalFlow, Normal, Product, Shape
from dvae.networks import Linear, Recurrent
from dvae.testing import FactorizationContract

SIZES = [(1, 0), (2, 3), (5, 3)]


def build(size=3, features=2, steps=2, **options):
    """Return a distribution with perturbed parameters."""
    distribution = ConditionalFlow(steps, (8,), **options).build(Shape(size, features)).double()
    with torch.no_grad():
        for parameter in distribution.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return distribution


def parameters_of(distribution, features=2, rows=6):
    """Return the parameters of random rows."""
    return distribution(torch.randn(rows, features, dtype=torch.float64))


@pytest.mark.parametrize(("size", "features"), SIZES)
def test_its_log_determinant_equals_the_jacobian_and_draws_invert_it(size, features):
    distribution = build(size, features, steps=4)
    parameters, noise = parameters_of(distribution, features), torch.randn(6, size, dtype=torch.float64)
    flow, x = distribution.distribution(parameters).flow, torch.randn(6, size, dtype=torch.float64)
    for i, log_det in enumerate(flow.to_noise(x)[1]):
        one = distribution.distribution(tuple(p[i] for p in parameters))
        jacobian = torch.autograd.functional.jacobian(lambda v, one=one: one.flow.to_noise(v)[0], x[i])
        torch.testing.assert_close(torch.linalg.slogdet(jacobian).logabsdet, log_det, rtol=0, atol=1e-10)
        density = dist.Normal(0, 1).log_prob(one.flow.to_noise(x[i])[0]).sum() + log_det
        torch.testing.assert_close(one.log_prob(x[i]), density)
    x = distribution.draw(parameters, noise)
    torch.testing.assert_close(flow.to_noise(x)[0], noise, rtol=0, atol=1e-10)
    torch.testing.assert_close(flow.from_noise(flow.to_noise(noise)[0]), noise, rtol=0, atol=1e-10)
    torch.testing.assert_close(
        distribution.mean(parameters), distribution.draw(parameters, torch.zeros_like(noise)), rtol=0, atol=0
    )
    x.sum().backward()
    flow_parameters = [p for p in distribution.parameters() if p.numel()]
    assert all(p.grad is not None and p.grad.any() for p in flow_parameters)


def test_a_change_of_unit_changes_the_density_by_its_jacobian():
    distribution, x = build(3), torch.randn(6, 3, dtype=torch.float64)
    mean, scale = torch.tensor([5.0, -1.0, 0.0]).double(), torch.tensor([0.1, 2.0, 30.0]).double()
    parameters = parameters_of(distribution)
    rescaled = distribution.rescale(parameters, mean, scale)
    expected = distribution.distribution(parameters).log_prob(x) - scale.log().sum()
    torch.testing.assert_close(distribution.distribution(rescaled).log_prob(mean + scale * x), expected)
    noise = torch.randn_like(x)
    torch.testing.assert_close(distribution.draw(rescaled, noise), mean + scale * distribution.draw(parameters, noise))


def test_its_location_keeps_a_share_of_the_previous_value():
    distribution, previous = build(3, residual=0.7), torch.randn(6, 3, dtype=torch.float64)
    features, x = torch.randn(6, 2, dtype=torch.float64), torch.randn(6, 3, dtype=torch.float64)
    with_previous, without_previous = (
        distribution.distribution(distribution(features, each)) for each in (previous, torch.zeros_like(previous))
    )
    torch.testing.assert_close(with_previous.log_prob(x + 0.7 * previous), without_previous.log_prob(x))


class TestAllFactorsAreFlows(FactorizationContract):
    """Prior, transition, emission and both guides."""

    missing = {}  # noqa: RUF012

    def build(self, size):
        pair = "p(w) p(z_t | z_{t-1}, w) p(x_t | z_t)", "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{t:T}, w)"
        flow = ConditionalFlow(2, (3,))
        distributions = {"p(w)": flow, "p": flow, "q": flow}
        return dvae.DynamicalVAE(*pair, {"w": size, "z": size, "x": size}, Recurrent(3, hidden=(3,)), distributions)


class TestFlowWithOtherDistributions(FactorizationContract):
    missing = {}  # noqa: RUF012

    def build(self, size):
        first, second = range(0, size, 2), range(1, size, 2)
        parts = [(tuple(first), ConditionalFlow(2, (3,), residual=0.5)), (tuple(second), Normal())]
        distribution = Product(tuple((indices, part) for indices, part in parts if indices))
        return dvae.DynamicalVAE("p(x_t | x_{t-1})", "", {"x": size}, Linear(), {"p(x)": distribution})


def test_without_zuko_an_error_names_the_package(monkeypatch):
    monkeypatch.delitem(sys.modules, "dvae.distributions.glow")
    monkeypatch.setitem(sys.modules, "zuko.flows", None)
    with pytest.raises(ImportError, match="package zuko"):
        ConditionalFlow().build(Shape(2, 1))
