"""Recursions in blocks have the same values and gradients as one step after another, with fewer calls."""

from dataclasses import fields, replace

import pytest
import torch
from torch.autograd import gradcheck

from dvae.distributions import scan
from dvae.distributions.kalman import LinearGaussianChain
from dvae.distributions.scan import Covariances, States


def chain(steps, batch=2, size=2, dtype=torch.float64):
    """Return a chain with matrices near the identity, some unobserved frames and a sequence with an unobserved end."""
    transition = 0.9 * torch.eye(size) + 0.2 * torch.randn(steps - 1, batch, size, size)
    root, emission = torch.randn(steps - 1, batch, size, size), torch.randn(steps, batch, size, size)
    observed = (torch.rand(steps, batch) < 0.7).to(dtype)
    observed[steps * 2 // 3 :, -1] = 0
    chain = LinearGaussianChain(
        transition=transition.to(dtype),
        offset=torch.randn(steps - 1, batch, size, dtype=dtype),
        noise=(root @ root.mT + 0.1 * torch.eye(size)).to(dtype),
        mean=torch.randn(batch, size, dtype=dtype),
        covariance=20 * torch.eye(size, dtype=dtype).expand(batch, -1, -1),
        information=(emission @ emission.mT / 0.03).to(dtype) * observed[..., None, None],
        potential=torch.randn(steps, batch, size, dtype=dtype) / 0.03 * observed[..., None],
    )
    return chain


def results(model, noise):
    return [*model.predicted, *model.filtered, *model.smoothed, model.lag_one, model.draw(noise)]


def with_gradients(model, noise, seed=1):
    """Return all results, and gradients of a random linear combination of them."""
    leaves = {f.name: getattr(model, f.name).detach().clone().requires_grad_() for f in fields(model)}
    values = results(replace(model, **leaves), noise)
    generator = torch.Generator().manual_seed(seed)
    total = sum((torch.randn(v.shape, generator=generator, dtype=v.dtype) * v).sum() for v in values)
    gradients = torch.autograd.grad(total, list(leaves.values()), allow_unused=True, materialize_grads=True)
    return [v.detach() for v in values] + [*gradients]


@pytest.fixture
def one_by_one(monkeypatch):
    """Return a function that runs an action without blocks."""

    def run(action, *inputs):
        with monkeypatch.context() as patch:
            patch.setattr(scan, "WIDE", 0)
            return action(*inputs)

    return run


@pytest.mark.parametrize(
    ("steps", "batch", "size", "block"), [(1, 2, 2, 2), (66, 1, 3, 16), (97, 2, 4, 16), (300, 3, 1, 2)]
)
def test_blocks_change_neither_values_nor_gradients(steps, batch, size, block, monkeypatch, one_by_one):
    """300 steps have seven levels, 16 does not divide 65, and 96 are six blocks."""
    monkeypatch.setattr(scan, "BLOCK", block)
    model = chain(steps, batch, size)
    assert scan.use_blocks(model.transition) == (steps > 2)
    inputs = model, torch.randn_like(model.potential)
    for one, other in zip(with_gradients(*inputs), one_by_one(with_gradients, *inputs), strict=True):
        scale = other.abs().max().item() if other.numel() else 1.0
        torch.testing.assert_close(one, other, rtol=0, atol=1e-10 * scale)


@pytest.mark.parametrize("call", [States, Covariances])
def test_the_gradient_of_a_recursion_equals_finite_differences(call, monkeypatch):
    monkeypatch.setattr(scan, "BLOCK", 2)
    shape = (13, 1, 2, 2)
    matrix, offset, start = (torch.randn(s, dtype=torch.float64) for s in (shape, shape, shape[1:]))
    assert scan.use_blocks(matrix)

    def run(matrix, offset, start):
        if call is Covariances:
            return call.apply(matrix, offset @ offset.mT, start @ start.mT)
        return call.apply(matrix, offset[..., 0], start[..., 0])

    assert gradcheck(run, [v.requires_grad_() for v in (0.5 * matrix, offset, start)])
