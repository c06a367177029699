"""Imputation of missing entries by draws from the model."""

import torch

import dvae
from dvae.distributions import Family
from dvae.networks import Recurrent


def test_missing_counts_are_filled_with_counts():
    pair = "p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-1}, x_{1:T})"
    model = dvae.DynamicalVAE(*pair, {"z": 2, "x": 3}, Recurrent(4), {"p(x)": Family("Poisson")})
    x = model.sample(3, 5)["x"]
    mask = torch.rand_like(x) < 0.5
    imputed = model.impute({"x": x, "mask": mask}, samples=7)["x"]
    assert not imputed.frac().any()
    assert torch.equal(imputed[:, mask], x[mask].expand(7, -1))
    assert imputed[:, ~mask].std(0).max() > 0
    assert model.impute({"x": x, "mask": mask}, draw=False)["x"].frac().any()
