"""Distributions with one density for all that a step has: normals with full covariance, and classes."""

import math

import pyro.distributions as dist
import pytest
import torch
from pyro import poutine

import dvae
from dvae import DynamicalVAE, SequenceELBO, fivo_bound, iwae_bound
from dvae.distributions import Family, FixedNormal, Vamp
from dvae.inference.bounds.particles import Filter
from dvae.networks import Recurrent

B, T = 3, 5
PAIR = "p(w) p(z_t | z_{t-1}, w) p(x_t | x_{t-1}, z_t, w)", "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{1:T}, w)"
SIZES = {"w": 2, "z": 2, "x": 3}


NORMAL = Family("MultivariateNormal")
FULL = dict.fromkeys(("p(z)", "p(x)", "q(w)", "q(z)"), NORMAL)
LAWS = {
    "all": FULL,
    "latents": {**FULL, "p(x)": FixedNormal(learned=True)},
    "guide": {"q": NORMAL},
    "classes": {"p(x)": Family("OneHotCategorical")},
    "vamp": {**FULL, "p(w)": Vamp(3, 4)},
}


def build(kind, network=None):
    return DynamicalVAE(*PAIR, SIZES, network or Recurrent(4), LAWS[kind]).double()


def data(kind, **rest):
    x = torch.randn(B, T, 3, dtype=torch.float64)
    return {"x": dist.OneHotCategorical(logits=x).sample() if kind == "classes" else x, **rest}


def whole_steps():
    return (torch.rand(B, T, 1) < 0.6).expand(-1, -1, 3)


BATCHES = {
    "plain": dict,
    "ragged": lambda: {"lengths": torch.tensor([T, 2, 1])},
    "missing": lambda: {"mask": whole_steps()},
    "both": lambda: {"mask": whole_steps(), "lengths": torch.tensor([T, 2, 1])},
}


def test_a_step_is_missing_as_a_whole_or_not_at_all():
    model, mask = build("all"), torch.ones(B, T, 3, dtype=torch.bool)
    mask[1, 2, 0] = False
    with pytest.raises(ValueError, match="entries"):
        SequenceELBO().terms(model, data("all", mask=mask))
    assert torch.isfinite(SequenceELBO().terms(build("latents"), data("all", mask=mask)).bound).all()


@torch.no_grad()
@pytest.mark.parametrize(("kind", "batch"), [*zip(LAWS, [*BATCHES, "both"], strict=True)])
def test_particles_weigh_what_the_program_scores(kind, batch):
    """Without resampling, the particle filter is importance sampling; with it, it runs."""
    model, given = build(kind), data(kind, **BATCHES[batch]())
    run = Filter(model, given, 4)
    bound = run.run(0.0).bound
    latents = {name: value for name, value in run.drawn.items() if name in model.latents}
    many = dvae.program.batch.repeat(given, 4)
    trace = poutine.trace(poutine.condition(model.guide, data=latents)).get_trace(many)
    trace.compute_log_prob()
    log_q = sum(trace.nodes[name]["log_prob"] for name in model.latents)
    expected = sum(model.log_joint(many, latents).values()) - log_q
    torch.testing.assert_close(bound, expected.unflatten(0, (4, -1)).logsumexp(0) - math.log(4))
    assert torch.isfinite(fivo_bound(model, given, 8, resample_below=1.0).bound).all()
    assert torch.isfinite(iwae_bound(model, given, 30).bound).all()
