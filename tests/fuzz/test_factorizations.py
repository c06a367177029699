"""Random pairs of equations, with every option that changes the inputs of the model.

With missing entries, padding, scheduled sampling and custom masks, bound and gradient equal those of the dense
Gaussian.
"""

import numpy as np
import torch
from dense import exact_bound, library_bound, masked
from hypothesis import strategies as st

from dvae.program.oracle import linear_gaussian_surrogate
from dvae.program.rollout import ScheduledSampling
from dvae.testing.strategies import factorizations

from .engine import fuzz, limited

SIZES = {"z": 2, "u": 1, "w": 2, "x": 2}
B = 2


def check(example):
    pair, steps, seed, share, probability, gradient = example
    rng = np.random.default_rng(seed)
    pair = [masked(text, rng, share) for text in pair]
    names = {name for equations in pair for name in equations.variables}
    model = linear_gaussian_surrogate(*pair, {name: size for name, size in SIZES.items() if name in names}, steps, seed)
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(B, steps, SIZES["x"], generator=generator, dtype=torch.float64)
    lengths = [steps, int(rng.integers(1, steps + 1))]
    mask = torch.rand(x.shape, generator=generator) < rng.choice([0.5, 1.0])
    is_fed = torch.rand(B, steps, generator=generator) < probability
    schedule = ScheduledSampling(probability, gradient=gradient)
    bounds = library_bound(model, x, lengths=lengths, seen=mask, fed=is_fed, feeding=schedule)
    expected = torch.stack(
        [
            exact_bound(model, x[b], length=lengths[b], seen=mask[b], fed=is_fed[b], detach=not gradient)
            for b in range(B)
        ]
    )
    torch.testing.assert_close(bounds, expected, rtol=1e-9, atol=1e-9)
    parameters = list(model.parameters())
    gradients = [
        torch.autograd.grad(bound.sum(), parameters, allow_unused=True, materialize_grads=True)
        for bound in (bounds, expected)
    ]
    torch.testing.assert_close(*gradients, rtol=1e-8, atol=1e-8)


@limited(15)
def test_the_bound_and_its_gradient_equal_the_dense_gaussian():
    examples = st.tuples(
        factorizations(),
        st.integers(1, 5),
        st.integers(0, 2**31),
        st.sampled_from([0.0, 0.4]),
        st.sampled_from([0.0, 0.5, 1.0]),
        st.booleans(),
    )
    fuzz(check, examples, seconds=15)
