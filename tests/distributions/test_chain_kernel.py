"""Triton's kernels of a Gaussian chain give the values and gradients of torch's loops: interpreted, or on a GPU."""

from itertools import pairwise

import pytest
import torch

from dvae.distributions import chain
from dvae.distributions.chain import gaussian_chain

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
INTERPRET = {} if DEVICE == "cuda" else {"TRITON_INTERPRET": "1"}
"""Environment in which Triton is imported, kernels are decorated, and kernels run."""

with pytest.MonkeyPatch.context() as environment:
    for name, setting in INTERPRET.items():
        environment.setenv(name, setting)
    pytest.importorskip("triton")
    from dvae.distributions import chain_kernel

pytestmark = pytest.mark.gpu
LATENT = 3


@pytest.fixture(autouse=True)
def environment_of_triton(monkeypatch):
    for name, setting in INTERPRET.items():
        monkeypatch.setenv(name, setting)


def leaf(*shape, dtype=torch.float32):
    return (0.5 * torch.randn(*shape, dtype=dtype)).to(DEVICE).requires_grad_()


def inputs(before=(), cell=0, after=(), shape=(2, 3), dtype=torch.float32):
    """Return the arguments of a chain and its leaves; as in a model, T is the second dimension in memory."""

    def over_time(width):
        return leaf(*shape[::-1], width, dtype=dtype).transpose(0, 1)

    def perceptron(*sizes):
        return [(leaf(b, a, dtype=dtype), leaf(b, dtype=dtype)) for a, b in pairwise(sizes)]

    features = (LATENT, *before)[-1]
    pre, post = perceptron(LATENT, *before), perceptron(cell or features, *after, 2 * LATENT)
    base, gates, recurrent = over_time(post[0][0].shape[0]), over_time(4 * cell), leaf(4 * cell, features + cell)
    lstm = (gates, recurrent.to(dtype)) if cell else None
    leaves = [base, *(tensor for layer in (*pre, *post) for tensor in layer), *(lstm or ())]
    return (base, over_time(LATENT).detach(), post), {"before": pre, "cell": lstm}, leaves


def with_gradients(monkeypatch, kernel, args, options, leaves):
    """Return the results and the gradients of a random linear combination of them."""
    monkeypatch.setattr(chain, "KERNEL", DEVICE if kernel else None)
    results = [part for part in gaussian_chain(*args, **options) if part is not None]
    assert results[0].grad_fn.kernel is (chain_kernel if kernel else None)
    generator = torch.Generator().manual_seed(1)
    total = sum((torch.randn(part.shape, generator=generator).to(DEVICE) * part).sum() for part in results)
    return [*results, *torch.autograd.grad(total, leaves, allow_unused=True)]


@pytest.mark.parametrize(
    ("before", "cell", "after", "shape", "activation", "min_scale"),
    [
        ((), 0, (32,), (3, 17), "tanh", 1e-3),  # SRNN
        ((16, 20), 0, (32,), (3, 17), "tanh", 1e-3),  # DKF
        ((), 7, (), (3, 3), "tanh", 1e-3),  # RVAE
        ((5, 6), 7, (), (3, 17), "tanh", 1e-3),  # VRNN
        ((5,), 0, (8,), (3, 4), "relu", 0.1),
        ((17,), 20, (8,), (2, 16), "relu", 0.0),
        ((5,), 0, (), (3, 1), "tanh", 0.0),
        ((), 0, (), (3, 2), "tanh", 0.0),
        ((5, 6), 7, (8,), (1, 2), "tanh", 0.1),
        ((), 0, (8,), (1, 2), "relu", 0.0),
    ],
)
def test_the_kernels_equal_the_loops(before, cell, after, shape, activation, min_scale, monkeypatch):
    args, options, leaves = inputs(before, cell, after, shape)
    options |= {"activation": activation, "min_scale": min_scale}
    kernel, loop = (with_gradients(monkeypatch, each, args, options, leaves) for each in (True, False))
    for one, other in zip(kernel, loop, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            torch.testing.assert_close(one, other, rtol=0, atol=1e-5 * max(other.abs().max().item(), 1e-3))


def test_the_kernels_keep_nan(monkeypatch):
    args, options, leaves = inputs(after=(8,))
    with torch.no_grad():
        args[0][0, 0] = torch.nan
    values, *_ = with_gradients(monkeypatch, True, args, options | {"activation": "relu"}, leaves)
    assert values[:, 0].isnan().all()
    assert values[:, 1:].isfinite().all()


@pytest.mark.parametrize(
    "kind",
    [
        {"dtype": torch.float64},
        {"after": (4, 4)},
        {"before": (129,)},  # more registers than there are
        {"cell": 128},  # 272 KiB of weights
        {"shape": (2, 0)},
    ],
)
def test_other_chains_run_without_a_kernel(kind, monkeypatch):
    args, options, leaves = inputs(**kind)
    with_gradients(monkeypatch, False, args, options, leaves)
    monkeypatch.setattr(chain, "KERNEL", DEVICE)
    assert gaussian_chain(*args, **options)[0].grad_fn.kernel is None


@pytest.mark.parametrize("device", [None, "meta"])
def test_other_devices_run_without_a_kernel(device, monkeypatch):
    assert chain.KERNEL is None
    monkeypatch.setattr(chain, "KERNEL", device)
    args, options, _ = inputs()
    assert gaussian_chain(*args, **options)[0].grad_fn.kernel is None
