"""The oracle against the joint density, and every bound of the library against the oracle."""

import math

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from dense import library_bound, masked
from hypothesis import given, settings
from hypothesis import strategies as st
from pyro.infer import Trace_ELBO
from torch.distributions.transforms import ReshapeTransform

from dvae import DynamicalVAE, Oracle, SequenceELBO, audit, model_arrow_prices, model_price, price, twin
from dvae.distributions import FixedNormal, StandardNormal
from dvae.factorization.notation import Factorization
from dvae.networks import Linear
from dvae.testing.strategies import factorizations

T = 4
DKF = "p(z_t | z_{t-1}) p(x_t | z_t)"
TWO_LAYERS = "p(w) p(u_t | u_{t-1}, w) p(z_t | z_{t-1}, u_t) p(x_t | x_{<t}, z_t)"
PAIRS = {
    "dkf": (DKF, "q(z_t | z_{t-1}, x_{t:T})"),
    "dkf, backward": (DKF, "q(z_t | z_{t+1}, x_{<=t})"),
    # w tells of the u_{>t} through which later data tell of z_t.
    "two layers": (
        TWO_LAYERS,
        "q(w | x_{1:T}) q(u_t | u_{t-1}, z_{t-1}, x_{1:T}, w) q(z_t | z_{t-1}, u_t, x_{1:T}, w)",
    ),
    "two layers, mean field": (TWO_LAYERS, "q(w | x_{1:T}) q(u_t | x_{1:T}) q(z_t | x_{1:T})"),
    "statics": ("p(v) p(w | v) p(x_t | x_{t-1}, w)", "q(v | x_{1:T}) q(w | v, x_{1:T})"),
}


def build(pair, size=1, seed=0, steps=T, scale=0.4):
    pair = PAIRS[pair] if isinstance(pair, str) else pair
    generative, inference = (Factorization.parse(f) if isinstance(f, str) else f for f in pair)
    sizes = dict.fromkeys(generative.variables, size)
    return twin(generative, inference, sizes, steps, seed, scale=scale)


def data(model, n, steps=T):
    return model.sample(n, steps)["x"]


def z_score(draws, expected):
    """How many standard errors the mean of draws (N, ...) lies from what is expected."""
    error = draws.std(0) / len(draws) ** 0.5
    return ((draws.mean(0) - expected).abs() / (error + 1e-9)).max().item()


# -------------------------------------------------------------------- the oracle against the joint that it knows


def partly_observed(model, x):
    """The data with missing entries and lengths, of a model with units for all variables."""
    for name, size in model.sizes.items():
        model.standardise(name).double().fit(1 + 2 * torch.randn(50, size, dtype=torch.float64))
    mask = torch.rand_like(x) < 0.6
    return {"x": x, "mask": mask, "lengths": torch.tensor([T, T - 1, 1, T])}


@settings(max_examples=25)
@given(factorizations(), st.integers(0, 999))
def test_log_joint_is_evidence_plus_log_posterior(pair, seed):
    model = build(pair, size=2, seed=seed)
    torch.manual_seed(seed)
    x = data(model, 4)
    batch = partly_observed(model, x)
    latents = {name: value.detach() for name, value in model.guide(batch).items()}
    oracle = Oracle(model, T)
    means, covariances = (part.detach() for part in oracle.posterior(batch))
    values, log_posterior = oracle._stack(latents, model.latents), []
    for mean, covariance, value in zip(means, covariances.expand(4, -1, -1), values, strict=True):
        there = covariance.diagonal() > 0
        assert (value[~there] == 0).all()
        posterior = dist.MultivariateNormal(mean[there], covariance[there][:, there])
        log_posterior.append(posterior.log_prob(value[there]))
    joint = sum(model.log_joint(batch, latents).values())
    torch.testing.assert_close(joint, oracle.evidence(batch).detach() + torch.stack(log_posterior), rtol=0, atol=1e-8)


@pytest.mark.parametrize(("pair", "indicators"), [("dkf, backward", ("x",)), ("two layers", ()), ("statics", ("x",))])
def test_the_bound_of_partly_observed_data_is_the_mean_of_the_programs(pair, indicators):
    distributions = {"default": FixedNormal(0.7, learned=True, project=False)}
    distributions |= {f"p({name})": StandardNormal() for name in ("w", "v") if f"p({name})" in PAIRS[pair][0]}
    sizes = dict.fromkeys(Factorization.parse(PAIRS[pair][0]).variables, 1)
    model = DynamicalVAE(*PAIRS[pair], sizes, Linear(T), distributions, indicators=indicators).double()
    batch = partly_observed(model, torch.randn(4, T, 1, dtype=torch.float64))
    expected = library_bound(model, batch["x"], lengths=batch["lengths"], seen=batch["mask"])
    torch.testing.assert_close(Oracle(model, T).bound(batch), expected, rtol=0, atol=1e-8)


# -------------------------------------------------------------------------------- bounds against the evidence


@pytest.mark.parametrize("pair", ["dkf, backward", "two layers, mean field"])
def test_the_gap_is_the_mean_of_evidence_minus_bound(pair):
    model = build(pair)
    oracle = Oracle(model, T)
    with torch.no_grad():
        x = data(model, 4000)
        assert z_score(oracle.evidence(x) - oracle.bound(x), oracle.gap()) < 5


@settings(max_examples=25)
@given(factorizations(), st.integers(0, 999))
def test_bounds_of_random_factorizations_lie_below_the_evidence(pair, seed):
    model = build(pair, seed=seed)
    oracle = Oracle(model, T)
    torch.manual_seed(seed)
    x = data(model, 3)
    with torch.no_grad():
        assert (oracle.bound(x) <= oracle.evidence(x) + 1e-9).all()
        bounds = SequenceELBO().terms(model, x.repeat(1000, 1, 1)).bound.reshape(1000, 3)
        assert z_score(bounds, oracle.bound(x)) < 5.5
        assert oracle.gap() > -1e-9


@settings(max_examples=20)
@given(factorizations(), st.integers(0, 999))
def test_random_guides_are_tight_exactly_where_the_audit_says_so(pair, seed):
    """With masks of one's own too."""
    if seed % 2:
        rng = np.random.default_rng(seed)
        pair = [masked(text, rng, 0.6) for text in pair]
    verdict = audit(*pair, steps=T)
    gap = Oracle(build(pair, seed=seed, scale=0.6), T).fit_guide()
    assert gap > -1e-9
    assert (gap < 1e-6) == verdict.exact, gap


def exact_guide(model):
    """The posterior as a Pyro guide, one dense normal per latent given those before it."""
    oracle = Oracle(model, T)

    def guide(x):
        mean, covariance = (m.detach() for m in oracle.posterior(x))
        drawn = x.new_zeros(len(x), 0)
        with pyro.plate("sequences", len(x), dim=-1):
            for name in model.latents:
                past = slice(0, drawn.shape[1])
                shape = (*([T] if model.generative.local(name) else []), model.sizes[name])
                here = slice(past.stop, past.stop + math.prod(shape))
                gain = torch.linalg.solve(covariance[past, past], covariance[past, here])
                left = covariance[here, here] - covariance[here, past] @ gain
                law = dist.MultivariateNormal(mean[:, here] + (drawn - mean[:, past]) @ gain, (left + left.t()) / 2)
                reshape = ReshapeTransform(law.event_shape, shape)
                value = pyro.sample(name, dist.TransformedDistribution(law, [reshape]))
                drawn = torch.cat([drawn, value.flatten(1)], dim=1)

    return guide


@settings(max_examples=25)
@given(factorizations(), st.integers(0, 999))
def test_with_the_exact_posterior_as_guide_every_draw_gives_the_evidence(pair, seed):
    model = build(pair, size=2, seed=seed)
    torch.manual_seed(seed)
    x = data(model, 2)
    guide, evidence = exact_guide(model), Oracle(model, T).evidence(x).detach()
    bounds = [-Trace_ELBO().loss(model.model, guide, sequence[None]) for sequence in x]
    torch.testing.assert_close(x.new_tensor(bounds), evidence, rtol=0, atol=1e-8)
    torch.testing.assert_close(SequenceELBO().terms(model, x, guide).bound.detach(), evidence, rtol=0, atol=1e-8)


# ---------------------------------------------------------------------------------- where the analytic KL is wrong


AGAINST = {
    "local": (*PAIRS["dkf, backward"], "z", "z"),
    # w is drawn first, though v is its parent.
    "static": ("p(v) p(w | v) p(x_t | w)", "q(w | x_{1:T}) q(v | w)", "w", "v"),
}


@pytest.mark.parametrize("pair", AGAINST)
def test_a_latent_that_the_guide_draws_against_the_arrows_has_no_analytic_kl(pair, monkeypatch):
    *equations, child, parent = AGAINST[pair]
    model = build(tuple(equations))
    with torch.no_grad():
        model.generator[child].network.weights[parent].fill_(1.0)  # a strong arrow between latents
    oracle = Oracle(model, T)
    assert oracle.fit_guide() < 1e-6  # so the exact bound is the evidence, and draws vary little about it
    x = data(model, 1).repeat(4000, 1, 1)
    with torch.no_grad():
        exact = oracle.bound(x[:1])
        ours = SequenceELBO().terms(model, x).bound
        assert z_score(ours, exact) < 5
        monkeypatch.setattr("dvae.inference.bounds.elbo._closed_forms", lambda *sites: set(model.latents))
        forced = SequenceELBO().terms(model, x).bound
    assert z_score(forced, exact) > 20


# ----------------------------------------------------------------------------------------------- price and errors


def test_the_price_of_a_dropped_arrow():
    sizes = {"z": 1, "x": 1}
    full = price(DKF, "q(z_t | z_{t-1}, x_{t:T})", sizes, steps=T, seeds=2)
    dropped = price(DKF, "q(z_t | x_{t:T})", sizes, steps=T, seeds=2)
    assert full.shape == (2,)
    assert full.abs().max() < 1e-6
    assert dropped.min() > 1e-3


def spread(generative, sizes, seed, steps):
    """The covariance of the data under the model that prices of a seed have."""
    oracle = Oracle(twin(generative, None, sizes, steps, seed), steps)
    n = sum(map(oracle._size, oracle.model.latents))
    return torch.linalg.inv(oracle._joint()[1].detach())[n:, n:]


def dependence(covariance, size):
    """How far blocks of so many normal coordinates are from independent, in nats: their total correlation."""
    blocks = [covariance[k : k + size, k : k + size] for k in range(0, len(covariance), size)]
    return float(sum(map(torch.logdet, blocks)) - torch.logdet(covariance)) / 2


INDEPENDENT = {
    "mutual information of two steps": ("p(x_t | x_{t-1})", "p(x_t)", {"x": 1}, 2, 1),
    "of vectors, whose coordinates become independent too": ("p(x_t | x_{t-1})", "p(x_t)", {"x": 2}, 3, 1),
    "no chain of latents": (DKF, "p(z_t) p(x_t | z_t)", {"z": 1, "x": 1}, T, 1),
    "no latents": (DKF, "p(z_t | z_{t-1}) p(x_t)", {"z": 1, "x": 1}, T, 1),
    "latents that still join the coordinates of a step": (DKF, "p(z_t) p(x_t | z_t)", {"z": 1, "x": 2}, T, 2),
}


@pytest.mark.parametrize("case", INDEPENDENT)
def test_a_model_without_dependence_loses_all_of_it(case):
    generative, reduced, sizes, steps, size = INDEPENDENT[case]
    found = model_price(generative, reduced, sizes, steps, seeds=3)
    expected = [dependence(spread(generative, sizes, seed, steps), size) for seed in range(3)]
    assert min(expected) > 1e-6
    assert found.tolist() == pytest.approx(expected, abs=1e-9)


def test_what_another_arrow_can_carry_costs_nothing():
    found = model_arrow_prices("p(z_t | z_{t-1}, x_{<t}) p(x_t | x_{<t}, z_t)", steps=3, seeds=2)
    assert {arrow for arrow, cost in found.items() if cost.max() < 1e-8} == {"z_{t-1} to z_t", "x_{<t} to z_t"}
    assert found["x_{<t} to x_t"].min() > 1e-3
