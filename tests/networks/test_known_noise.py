"""Noise of a known scale: the likelihood has the given scale for any network."""

import pytest
import torch

import dvae
from dvae.distributions import KnownNoise
from dvae.networks import Dense, Recurrent, WithNoise
from dvae.testing import FactorizationContract

PAIR = "p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t, s_t)", "q(z_t | z_{t-1}, x_{1:T}, s_{1:T})"


class TestKnownNoise(FactorizationContract):
    def build(self, size):
        networks = {"default": Recurrent(4, hidden=(4,)), "p(x)": WithNoise("s", Recurrent(4, hidden=(4,)))}
        return dvae.DynamicalVAE(*PAIR, dict.fromkeys("zxs", size), networks, {"p(x)": KnownNoise()})

    def _data(self, *args, **kwargs):
        values = super()._data(*args, **kwargs)
        return values | ({"s": values["s"].abs() + 0.1} if "s" in values else {})


def built():
    networks = {"default": Recurrent(4), "p(x)": WithNoise("s", Dense((4,)))}
    pair = "p(z_t | z_{t-1}) p(x_t | z_t, s_t)", "q(z_t | z_{t-1}, x_{1:T})"
    return dvae.DynamicalVAE(*pair, {"z": 2, "x": 3, "s": 3}, networks, {"p(x)": KnownNoise()}).double()


def test_the_likelihood_has_the_given_noise():
    model, (x, z, s) = built(), (torch.randn(2, 4, size).double() for size in (3, 2, 3))
    s = s.abs() + 0.1
    loc, scale = model.generator["x"]({"z": z, "s": s}, 2, 4)
    torch.testing.assert_close(scale, s)
    expected = torch.distributions.Normal(loc, s).log_prob(x).sum((1, 2))
    torch.testing.assert_close(model.log_joint({"x": x, "s": s}, {"z": z})["x"], expected)


def test_scales_of_observed_steps_must_be_positive():
    model = built()
    x, s = torch.randn(2, 4, 3).double(), torch.ones(2, 4, 3).double()
    s[1, 2:] = 0
    with pytest.raises(ValueError, match="sequence"):
        dvae.SequenceELBO().terms(model, {"x": x, "s": s})
    loss = dvae.SequenceELBO().differentiable_loss(
        model, model.guide, {"x": x, "s": s, "lengths": torch.tensor([4, 2])}
    )
    loss.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
