"""Missing entries are drawn from what the model says of them, one after the other."""

import torch

import dvae
from dvae.distributions import Family
from dvae.networks import Recurrent


def test_missing_counts_are_filled_with_counts():
    pair = "p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-1}, x_{1:T})"
    model = dvae.DynamicalVAE(*pair, {"z": 2, "x": 3}, Recurrent(4), {"p(x)": Family("Poisson")})
    x = model.sample(3, 5)["x"]
    mask = torch.rand_like(x) < 0.5
    filled = model.impute({"x": x, "mask": mask}, samples=7)["x"]
    assert not filled.frac().any()
    assert torch.equal(filled[:, mask], x[mask].expand(7, -1))
    assert filled[:, ~mask].std(0).max() > 0
    assert model.impute({"x": x, "mask": mask}, draw=False)["x"].frac().any()
