"""Noise of a known scale: the likelihood is that of the scale that is given, whatever the networks."""

import pytest
import torch

import dvae
from dvae.distributions import FixedNormal, KnownNoise
from dvae.networks import Dense, Linear, Recurrent, WithNoise
from dvae.testing import FactorizationContract

PAIR = "p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t, s_t)", "q(z_t | z_{t-1}, x_{1:T}, s_{1:T})"


class TestKnownNoise(FactorizationContract):
    def build(self, size):
        networks = {"default": Recurrent(4, hidden=(4,)), "p(x)": WithNoise("s", Recurrent(4, hidden=(4,)))}
        return dvae.DynamicalVAE(*PAIR, dict.fromkeys("zxs", size), networks, {"p(x)": KnownNoise()})

    def _data(self, *args, **kwargs):
        found = super()._data(*args, **kwargs)
        return found | ({"s": found["s"].abs() + 0.1} if "s" in found else {})


def built(**more):
    networks = {"default": Recurrent(4), "p(x)": WithNoise("s", Dense((4,)))}
    pair = "p(z_t | z_{t-1}) p(x_t | z_t, s_t)", "q(z_t | z_{t-1}, x_{1:T})"
    return dvae.DynamicalVAE(*pair, {"z": 2, "x": 3, "s": 3}, networks, {"p(x)": KnownNoise()}, **more).double()


def test_the_evidence_has_the_given_noise():
    """That of a linear-Gaussian model is known."""
    networks = {"default": Linear(steps=1), "p(x)": WithNoise("s", Linear(steps=1))}
    sizes = {"w": 1, "x": 1, "s": 1}
    laws = {"p(x)": KnownNoise(), "q(w)": FixedNormal(1.0, project=False)}
    model = dvae.DynamicalVAE("p(w) p(x_t | w, s_t)", "q(w | x_{1:T})", sizes, networks, laws).double()
    x, part = torch.full((1, 1, 1), 2.0).double(), model.generator["x"]

    def mean(w):
        with torch.no_grad():
            return part.law(part.network({"w": torch.full((1, 1), w).double(), "s": x}, 1))[0].flatten()

    centre, slope = mean(0.0), mean(1.0) - mean(0.0)
    for s in (0.5, 2.0):
        exact = torch.distributions.Normal(centre, (slope**2 + s**2).sqrt()).log_prob(x.flatten())
        bound = dvae.importance_bound(model, {"x": x, "s": torch.full_like(x, s)}, particles=50_000).bound
        torch.testing.assert_close(bound, exact, atol=0.02, rtol=0)


def test_scales_are_above_zero_where_there_is_a_step():
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
