"""Recursions in blocks are those of one step after the other: values, gradients, digits; only the calls are fewer."""

from dataclasses import fields, replace

import mpmath
import pytest
import torch
from torch.autograd import gradcheck
from torch.distributions import MultivariateNormal
from torch.utils._python_dispatch import TorchDispatchMode

from dvae.distributions import scan
from dvae.distributions.kalman import LinearGaussianChain
from dvae.distributions.scan import Covariances, States


def chain(steps, batch=2, size=2, dtype=torch.float64):
    """Matrices near the identity, a third of the frames not seen, and the end of the last sequence."""
    transition = 0.9 * torch.eye(size) + 0.2 * torch.randn(steps - 1, batch, size, size)
    root, emission = torch.randn(steps - 1, batch, size, size), torch.randn(steps, batch, size, size)
    seen = (torch.rand(steps, batch) < 0.7).to(dtype)
    seen[steps * 2 // 3 :, -1] = 0
    chain = LinearGaussianChain(
        transition=transition.to(dtype),
        offset=torch.randn(steps - 1, batch, size, dtype=dtype),
        noise=(root @ root.mT + 0.1 * torch.eye(size)).to(dtype),
        mean=torch.randn(batch, size, dtype=dtype),
        covariance=20 * torch.eye(size, dtype=dtype).expand(batch, -1, -1),
        information=(emission @ emission.mT / 0.03).to(dtype) * seen[..., None, None],
        potential=torch.randn(steps, batch, size, dtype=dtype) / 0.03 * seen[..., None],
    )
    return chain


def results(built, noise):
    return [*built.predicted, *built.filtered, *built.smoothed, built.lag_one, built.draw(noise)]


def with_gradients(built, noise, seed=1):
    """All results, and gradients of a random linear combination of them."""
    leaves = {f.name: getattr(built, f.name).detach().clone().requires_grad_() for f in fields(built)}
    found = results(replace(built, **leaves), noise)
    generator = torch.Generator().manual_seed(seed)
    total = sum((torch.randn(v.shape, generator=generator, dtype=v.dtype) * v).sum() for v in found)
    gradients = torch.autograd.grad(total, list(leaves.values()), allow_unused=True, materialize_grads=True)
    return [v.detach() for v in found] + [*gradients]


@pytest.fixture
def one_by_one(monkeypatch):
    """Runs something without blocks."""

    def run(action, *inputs):
        with monkeypatch.context() as patch:
            patch.setattr(scan, "WIDE", 0)
            return action(*inputs)

    return run


@pytest.mark.parametrize("block", [2, 16])
@pytest.mark.parametrize(("steps", "batch", "size"), [(1, 2, 2), (2, 1, 1), (66, 1, 3), (97, 2, 4), (300, 3, 1)])
def test_blocks_change_neither_values_nor_gradients(steps, batch, size, block, monkeypatch, one_by_one):
    """With 300 steps there are levels: of 2 steps seven, of 16 two. Neither divides 65, 96 is six blocks, 299 not."""
    monkeypatch.setattr(scan, "BLOCK", block)
    built = chain(steps, batch, size)
    assert scan.in_blocks(built.transition) == (steps > 2)
    inputs = built, torch.randn_like(built.potential)
    for one, other in zip(with_gradients(*inputs), one_by_one(with_gradients, *inputs), strict=True):
        scale = other.abs().max().item() if other.numel() else 1.0
        torch.testing.assert_close(one, other, rtol=0, atol=1e-10 * scale)


def test_evidence_in_blocks_is_that_of_the_dense_normal():
    """Of z_t = A_t z_{t-1} + N(0, Q) and a_t = z_t + N(0, r), of which some are not there."""
    built, (steps, batch, size), r = chain(70), (70, 2, 2), 0.5
    assert scan.in_blocks(built.transition)
    there = built.information.flatten(2).any(-1)
    a = torch.randn(steps, batch, size, dtype=torch.float64)
    noise, identity = 0.3 * torch.eye(size).double(), torch.eye(size).double()
    seen = there[..., None].double()
    built = replace(built, noise=noise, information=identity * seen[..., None] / r, potential=a * seen / r)
    mean, covariance = built.predicted
    law = MultivariateNormal(mean, covariance + r * identity)
    ours = (law.log_prob(a) * there).sum(0)
    for b in range(batch):
        rest = torch.eye(steps * size).double()
        for t in range(1, steps):
            rest[t * size : (t + 1) * size, (t - 1) * size : t * size] = -built.transition[t - 1, b]
        root = torch.linalg.inv(rest)
        spread = root @ torch.block_diag(built.covariance[b], *[noise] * (steps - 1)) @ root.mT
        spread += r * torch.eye(steps * size)
        kept = there[:, b].repeat_interleave(size)
        offset = root @ torch.cat([built.mean[b], built.offset[:, b].flatten()])
        dense = MultivariateNormal(offset[kept], spread[kept][:, kept]).log_prob(a[:, b].flatten()[kept])
        assert ours[b].item() == pytest.approx(dense.item(), rel=1e-11)


def test_gradients_are_those_of_finite_differences(monkeypatch):
    monkeypatch.setattr(scan, "BLOCK", 2)
    built = chain(9, 1, 1)
    assert scan.in_blocks(built.transition)

    def run(*values):
        again = LinearGaussianChain(*values)
        return *again.predicted, *again.smoothed, again.draw(built.offset.new_ones(9, 1, 1))

    assert gradcheck(run, [getattr(built, f.name).detach().clone().requires_grad_() for f in fields(built)])


@pytest.mark.parametrize("call", [States, Covariances])
def test_a_recursion_has_the_gradient_of_finite_differences(call, monkeypatch):
    monkeypatch.setattr(scan, "BLOCK", 2)
    shape = (13, 1, 2, 2)
    matrix, offset, start = (torch.randn(s, dtype=torch.float64) for s in (shape, shape, shape[1:]))
    assert scan.in_blocks(matrix)

    def run(matrix, offset, start):
        if call is Covariances:
            return call.apply(matrix, offset @ offset.mT, start @ start.mT)
        return call.apply(matrix, offset[..., 0], start[..., 0])

    assert gradcheck(run, [v.requires_grad_() for v in (0.5 * matrix, offset, start)])


@pytest.mark.parametrize(("information", "start"), [(1e4, 20), (1e6, 20), (1e6, 1e4), (1, 1e8)])
def test_precise_observations_and_a_diffuse_start_keep_their_digits(information, start, monkeypatch):
    """One direction of z is observed at each step; expected is the dense normal in 50 digits."""
    monkeypatch.setattr(scan, "BLOCK", 2)
    steps, size = 14, 2
    seen, z = torch.randint(1, 4, (steps, 1, size)).float(), torch.randn(steps, 1, size)
    built = LinearGaussianChain(
        transition=torch.eye(size) + 0.2 * torch.randn(steps - 1, 1, size, size),
        offset=torch.randn(steps - 1, 1, size),
        noise=torch.tensor([[0.5, 0.25], [0.25, 1.0]]),
        mean=torch.randn(1, size),
        covariance=start * torch.eye(size)[None],
        information=information * seen[..., None] * seen[..., None, :],
        potential=information * seen * (seen * z).sum(-1, keepdim=True),
    )
    assert scan.in_blocks(built.transition)
    differences = torch.eye(steps * size).double()
    for t in range(1, steps):
        differences[t * size : (t + 1) * size, (t - 1) * size : t * size] = -built.transition[t - 1, 0]
    noise = torch.block_diag(built.covariance[0], *[built.noise] * (steps - 1))
    offset = torch.cat([built.mean, built.offset[:, 0]]).flatten()
    with mpmath.workdps(50):
        parts = (differences, noise, torch.block_diag(*built.information[:, 0]))
        differences, noise, weights = (mpmath.matrix(part.tolist()) for part in parts)
        prior = differences.T * mpmath.inverse(noise)
        covariance = mpmath.inverse(prior * differences + weights)
        mean = covariance * (prior * mpmath.matrix(offset.tolist()) + mpmath.matrix(built.potential.flatten().tolist()))
        numbers = [float(v) for v in (*mean, *(mpmath.sqrt(covariance[i, i]) for i in range(steps * size)))]
    mean, deviation = torch.tensor(numbers, dtype=torch.float64).view(2, steps, size)
    found = built.smoothed
    assert ((found.mean[:, 0] - mean).abs() / deviation).max() < 1e-3
    torch.testing.assert_close(found.covariance[:, 0].diagonal(dim1=-2, dim2=-1).sqrt(), deviation, rtol=1e-4, atol=0)
    torch.testing.assert_close(built.draw(torch.zeros(steps, 1, size)), found.mean)


def test_calls_grow_with_the_logarithm_of_the_steps():
    """Sixteen times the steps are one level more: two Riccati recursions of 16 steps, and four linear ones."""

    class Count(TorchDispatchMode):
        calls = 0

        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            self.calls += func in (aten.bmm.out, aten.baddbmm.out, aten.linalg_inv_ex.inverse)
            return func(*args, **(kwargs or {}))

    aten, counts = torch.ops.aten, []
    for steps in (1_000, 16_000):
        built = chain(steps, 1, 1)
        with Count() as count:
            _ = built.smoothed
        counts.append(count.calls)
    products = 4 * 15
    assert counts[1] - counts[0] == 16 * (2 * 5 + 1 + 1 + 1 + 2) + products
