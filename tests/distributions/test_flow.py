"""The QR flow is a bijection with the density by its Jacobian and the published number of parameters."""

import pyro
import pyro.distributions as dist
import pytest
import torch

from dvae.distributions import QRFlow, Shape

SIZES = [(1, 1), (2, 3), (5, 3)]


def start(size=5, layers=3):
    return QRFlow(layers).build(Shape(size, local=False))


def build(size=5, layers=3, whitened=True):
    """Return a flow with perturbed parameters."""
    flow = start(size, layers).double()
    with torch.no_grad():
        for parameter in flow.parameters():
            parameter.add_(0.5 * torch.randn_like(parameter) / size**0.5)
    if whitened:
        flow.whiten(values(50, size))
    return flow


def normal(size=5):
    """Return a normal distribution with a fixed mean and fixed correlations."""
    root = torch.randn(size, size, dtype=torch.float64, generator=torch.Generator().manual_seed(size))
    return dist.MultivariateNormal(torch.full((size,), 2.0, dtype=torch.float64), root @ root.T)


def values(count, size=5):
    return normal(size).sample((count,))


@pytest.mark.parametrize(("size", "parameters"), [(48, 13_970), (42, 10_712)])
def test_it_has_the_published_number_of_parameters(size, parameters):
    """The sizes are Human3.6M and HumanEva-I, whose log reports 0.01071 million."""
    assert sum(parameter.numel() for parameter in start(size).parameters()) == parameters


@pytest.mark.parametrize("size", [1, 7])
def test_q_is_the_product_of_the_reflections_in_reverse_order(size):
    flow = build(size)
    q, r = flow.factors()
    x = torch.randn(size, dtype=torch.float64)
    for layer, vectors in enumerate(flow.reflections):
        reflected = x
        for v in vectors.flip(0):
            reflected = reflected - 2 * v * (v @ reflected) / (v @ v)
        torch.testing.assert_close(q[layer] @ x, reflected, rtol=0, atol=1e-10)
    identity = torch.eye(size, dtype=torch.float64)
    torch.testing.assert_close(q @ q.mT, identity.expand(3, -1, -1), rtol=0, atol=1e-12)
    assert torch.equal(r, r.triu())
    assert (r.diagonal(dim1=1, dim2=2) > 0).all()


@pytest.mark.parametrize("whitened", [False, True])
@pytest.mark.parametrize(("size", "layers"), SIZES)
def test_the_log_determinant_equals_the_jacobian_and_the_inverse_is_exact(size, layers, whitened):
    flow, x = build(size, layers, whitened), values(6, size).unflatten(0, (2, 3))
    z, log_det = flow.to_noise(x)
    assert (z.shape, log_det.shape) == (x.shape, x.shape[:-1])
    torch.testing.assert_close(flow.from_noise(z), x, rtol=0, atol=1e-10)
    for value, expected in zip(x.flatten(0, 1), log_det.flatten(), strict=True):
        jacobian = torch.autograd.functional.jacobian(lambda v: flow.to_noise(v)[0], value)
        torch.testing.assert_close(torch.linalg.slogdet(jacobian).logabsdet, expected, rtol=0, atol=1e-10)


def test_it_is_a_valid_pyro_distribution():
    flow = build()

    def model(x=None):
        with pyro.plate("rows", 3, dim=-2), pyro.plate("columns", 4, dim=-1):
            return pyro.sample("x", flow.prior(), obs=x)

    x = values(12).unflatten(0, (3, 4))
    trace = pyro.poutine.trace(model).get_trace(x)
    assert trace.nodes["x"]["fn"].batch_shape == (3, 4)
    torch.testing.assert_close(trace.log_prob_sum(), flow.prior().log_prob(x).sum())
    assert model().shape == (3, 4, 5)
    distribution = flow.prior().expand((4,))
    assert distribution.log_prob(x[0, 0]).shape == (4,)
    draws = distribution.rsample((2, 3))
    assert draws.shape == (2, 3, 4, 5)
    draws.sum().backward()
    assert all(parameter.grad is not None for parameter in (flow.triangular, flow.reflections, flow.bias))


def test_constant_values_can_be_whitened():
    x = values(40)
    x[:, 2] = 0.5
    flow = build()
    flow.whiten(x)
    z, log_det = flow.to_noise(x)
    assert torch.isfinite(z).all()
    assert torch.isfinite(log_det).all()
    flow.whiten(torch.zeros(10, 5))
    assert torch.isfinite(flow.to_noise(torch.zeros(5))[0]).all()
