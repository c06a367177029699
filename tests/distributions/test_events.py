"""Distributions with one event for each step: normals with full covariance, and categories."""

import math

import pyro.distributions as dist
import pytest
import torch
from pyro import poutine

import dvae
from dvae import DynamicalVAE, SequenceELBO, fivo_bound, iwae_bound
from dvae.distributions import Family, FixedNormal, Vamp
from dvae.networks import Recurrent
from dvae.program.particles import Particles

B, T = 3, 5
PAIR = "p(w) p(z_t | z_{t-1}, w) p(x_t | x_{t-1}, z_t, w)", "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{1:T}, w)"
SIZES = {"w": 2, "z": 2, "x": 3}


NORMAL = Family("MultivariateNormal")
FULL = dict.fromkeys(("p(z)", "p(x)", "q(w)", "q(z)"), NORMAL)
DISTRIBUTIONS = {
    "all": FULL,
    "latents": {**FULL, "p(x)": FixedNormal(learned=True)},
    "guide": {"q": NORMAL},
    "classes": {"p(x)": Family("OneHotCategorical")},
    "vamp": {**FULL, "p(w)": Vamp(3, 4)},
}


def build(kind, network=None):
    return DynamicalVAE(*PAIR, SIZES, network or Recurrent(4), DISTRIBUTIONS[kind]).double()


def data(kind, **entries):
    x = torch.randn(B, T, 3, dtype=torch.float64)
    return {"x": dist.OneHotCategorical(logits=x).sample() if kind == "classes" else x, **entries}


def whole_steps():
    return (torch.rand(B, T, 1) < 0.6).expand(-1, -1, 3)


BATCHES = {
    "plain": dict,
    "ragged": lambda: {"lengths": torch.tensor([T, 2, 1])},
    "missing": lambda: {"mask": whole_steps()},
    "both": lambda: {"mask": whole_steps(), "lengths": torch.tensor([T, 2, 1])},
}


def test_partly_missing_events_are_an_error():
    model, mask = build("all"), torch.ones(B, T, 3, dtype=torch.bool)
    mask[1, 2, 0] = False
    with pytest.raises(ValueError, match="entries"):
        SequenceELBO().terms(model, data("all", mask=mask))
    assert torch.isfinite(SequenceELBO().terms(build("latents"), data("all", mask=mask)).bound).all()


@torch.no_grad()
@pytest.mark.parametrize(("kind", "batch"), [*zip(DISTRIBUTIONS, [*BATCHES, "both"], strict=True)])
def test_particle_weights_equal_the_densities_of_the_program(kind, batch):
    """Without resampling, the particle filter is importance sampling; with resampling, its bound is finite."""
    model, observations = build(kind), data(kind, **BATCHES[batch]())
    run = Particles(model, model.rollout(observations), 4)
    bound = run.run(0.0)[0]
    latents = {name: value for name, value in run.drawn.items() if name in model.latents}
    many = dvae.program.batch.repeat(observations, 4)
    trace = poutine.trace(poutine.condition(model.guide, data=latents)).get_trace(many)
    trace.compute_log_prob()
    log_q = sum(trace.nodes[name]["log_prob"] for name in model.latents)
    expected = sum(model.log_joint(many, latents).values()) - log_q
    torch.testing.assert_close(bound, expected.unflatten(0, (4, -1)).logsumexp(0) - math.log(4))
    assert torch.isfinite(fivo_bound(model, observations, 8, resample_below=1.0).bound).all()
    assert torch.isfinite(iwae_bound(model, observations, 30).bound).all()
