"""A small model, random walks as its data, and a comparison of weights."""

import torch

from dvae.networks import Dense
from dvae.program.model import DynamicalVAE


def build(seed=0, latent=2, kind=DynamicalVAE):
    torch.manual_seed(seed)
    equations = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)"
    return kind(*equations, {"z": latent, "x": 3}, network=Dense(widths=(8,))).double()


def walks(n, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(n, 4, 3, generator=generator, dtype=torch.float64).cumsum(1)


TRAIN, HELD_OUT = walks(24), walks(7, seed=1)


def same(first, second):
    """Return whether two mappings have equal tensors."""
    assert first.keys() == second.keys()
    return all(torch.equal(first[name], second[name]) for name in first)
