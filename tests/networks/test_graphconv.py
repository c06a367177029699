"""The graph convolutional generator equals its published definition, and its transform equals scipy's."""

import numpy as np
import pytest
import torch
from scipy.fft import dct

import dvae
from dvae.data.views import History, Parts, Views
from dvae.factorization.relations import Relation
from dvae.networks import GraphConv
from dvae.networks.base import Input
from dvae.networks.cosine import cosine_basis

OBSERVED, LENGTH, JOINTS = 4, 9, 5
EVERYTHING = {"h": range(JOINTS), "lower": (0, 3), "upper": (1, 2, 4)}
PARTS = Views(History("h"), Parts({"lower": [0, 1, 2, 9, 10, 11], "upper": [3, 4, 5, 6, 7, 8, 12, 13, 14]}))
FIRST = Relation.custom("1:O", lambda T: np.arange(T)[None] < OBSERVED)
ALL = Relation.parse("1:T")


def network(child="upper", **options):
    options = {"coefficients": 3, "width": 6, "blocks": 2, **options}
    inputs = [Input("h", 15, FIRST), Input("lower", 6, ALL), Input("b", 2)]
    return GraphConv(EVERYTHING, child, LENGTH, **options).build(inputs, True, 3 * len(EVERYTHING[child])).double()


def parents(batch=3):
    sizes = {"h": (batch, LENGTH, 15), "lower": (batch, LENGTH, 6), "b": (batch, 2)}
    return {name: torch.randn(shape, dtype=torch.float64) for name, shape in sizes.items()}


def test_the_basis_equals_scipys_orthonormal_transform():
    values = np.random.default_rng(0).normal(size=(7, 3))
    assert np.allclose(cosine_basis(7, 7).numpy() @ values, dct(values, axis=0, norm="ortho"), atol=1e-14, rtol=0)
    rows = cosine_basis(7, 4)
    assert torch.allclose(rows @ rows.T, torch.eye(4, dtype=torch.float64), atol=1e-14, rtol=0)


def published(net, values):
    """Return the published output, step by step: padded history, transformed, with the earlier part inserted."""
    batch, C = len(values["b"]), net.spec.coefficients
    padded = values["h"].clone()
    padded[:, OBSERVED:] = padded[:, OBSERVED - 1 : OBSERVED]

    def transformed(x):  # (B, T, 3 joints) -> (B, joints, 3 C), xyz-major
        coefficients = torch.from_numpy(dct(x.detach().numpy(), axis=1, norm="ortho")[:, :C])
        return coefficients.unflatten(-1, (-1, 3)).permute(0, 2, 3, 1).flatten(2)

    y = transformed(padded)
    y[:, list(EVERYTHING["lower"])] = transformed(values["lower"])
    y = torch.cat([y, values["b"][:, None].expand(-1, JOINTS, -1)], dim=-1)

    def convolve(layer, x):
        out = torch.stack([layer.adjacency @ (row @ layer.weight) for row in x])
        out = out if layer.bias is None else out + layer.bias
        if layer.norm is None:
            return out
        flat = out.reshape(batch, -1)
        mean, variance = flat.mean(0), flat.var(0, correction=0)
        normal = (flat - mean) / (variance + layer.norm.eps).sqrt()
        return torch.tanh((normal * layer.norm.weight + layer.norm.bias).view(out.shape))

    hidden = convolve(net.first, y)
    for first, second in net.rest:
        hidden = hidden + convolve(second, convolve(first, hidden))
    out = (convolve(net.last, hidden) + y)[:, list(EVERYTHING["upper"]), : 3 * C]
    time = cosine_basis(LENGTH, C).T @ out.unflatten(-1, (3, C)).permute(0, 3, 1, 2).flatten(2)
    return time


def test_the_network_equals_its_published_definition():
    net, values = network().train(), parents()
    assert torch.allclose(net(values, LENGTH), published(net, values), atol=1e-10, rtol=0)


def generator(**options):
    """Return GSPS's equations with a likelihood, for sequences that contain parts and history."""
    equations = "p(a) p(lower_t | h_{1:O}, a) p(upper_t | h_{1:O}, lower_{1:T}, a)"
    return dvae.DynamicalVAE(
        equations,
        None,
        {"a": 2, "h": 15, "lower": 6, "upper": 9},
        {f"p({name})": GraphConv(EVERYTHING, name, LENGTH, 3, 6, 1) for name in ("lower", "upper")},
        {f"p({name})": dvae.distributions.FixedNormal(0.1) for name in ("lower", "upper")},
        view=PARTS,
        masks={"1:O": lambda T: np.arange(T)[None] < OBSERVED},
        **options,
    ).double()


def test_missing_values_are_hidden_in_the_history_too():
    model, x = generator().eval(), torch.randn(3, LENGTH, 15, dtype=torch.float64)
    mask = torch.rand(x.shape) < 0.7
    bounds = []
    for hidden in (0.0, 77.0, torch.nan):
        torch.manual_seed(0)
        batch = {"x": torch.where(mask, x, hidden), "mask": mask}
        bounds.append(dvae.SequenceELBO().terms(model, batch).bound)
    assert torch.isfinite(bounds[0]).all()
    assert torch.equal(bounds[0], bounds[1])
    assert torch.equal(bounds[0], bounds[2])


def test_draws_of_latents_must_follow_the_order_of_the_guide():
    model = dvae.DynamicalVAE("p(a) p(b) p(x_t | a, b)", "q(b | x_{1:T}) q(a | b, x_{1:T})", {"a": 1, "b": 1, "x": 2})
    for draws in ({"a": 2, "b": 3}, {"b": 3}):
        with pytest.raises(ValueError, match="order"):
            model.guide(torch.randn(2, 3, 2), draws=draws)
    model = dvae.DynamicalVAE("p(a) p(b) p(x_t | a, b)", "q(a | x_{1:T}) q(b | a, x_{1:T})", {"a": 1, "b": 1, "x": 2})
    terms = dvae.SequenceELBO().terms(model, torch.randn(2, 3, 2), draws={"b": 3})
    assert terms.kl["a"].shape == terms.kl["b"].shape == (2,)
