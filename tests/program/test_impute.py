"""Missing entries are drawn from what the model says of them, one after the other."""

import torch

import dvae
from dvae.distributions import Family
from dvae.networks import Linear, Recurrent


def test_draws_of_a_gap_are_of_the_model_that_goes_on():
    """Of an autoregression x_t = a x_{t-1} + b + noise, a gap of two has the moments of two steps."""
    model = dvae.DynamicalVAE(
        "p(x_t | x_{t-1})", None, {"x": 1}, Linear(), dvae.distributions.FixedNormal(0.5, project=False)
    )
    model = model.double()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(torch.randn_like(parameter) * 0.5)
    x = torch.full((1, 4, 1), 2.0).double()
    mask = torch.tensor([True, False, False, True])[None, :, None]
    draws = model.impute({"x": x, "mask": mask}, samples=20_000, chunk=10**6)["x"][:, 0, :, 0]
    means = model.impute({"x": x, "mask": mask}, draw=False)["x"][0, 0, :, 0]
    assert (draws[:, [0, 3]] == 2.0).all()
    torch.testing.assert_close(draws.mean(0), means, atol=5 * 0.6 / 20_000**0.5, rtol=0)
    seen = torch.tensor([True, True, False, True])[None, :, None]
    moved = [x, x + torch.tensor([0.0, 1.0, 0.0, 0.0])[:, None]]
    low, high = (model.impute({"x": each, "mask": seen}, draw=False)["x"][0, 0, 2, 0] for each in moved)
    slope = high - low
    variance = torch.stack([torch.tensor(0.25).double(), 0.25 * (1 + slope**2)])
    torch.testing.assert_close(draws.var(0)[1:3], variance, rtol=0.06, atol=0)


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
