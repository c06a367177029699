"""The oracle equals brute force, and every bound of the library agrees with the oracle."""

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

from dvae import (
    DynamicalVAE,
    Oracle,
    SequenceELBO,
    audit,
    kl_gap,
    linear_gaussian_surrogate,
    model_edge_costs,
    model_kl_gap,
)
from dvae.distributions import FixedNormal, StandardNormal
from dvae.factorization.notation import Factorization
from dvae.networks import Linear
from dvae.testing.strategies import factorizations

T = 4
DKF = "p(z_t | z_{t-1}) p(x_t | z_t)"
TWO_LAYERS = "p(w) p(u_t | u_{t-1}, w) p(z_t | z_{t-1}, u_t) p(x_t | x_{<t}, z_t)"
HIT_DVAE = "p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)"
PAIRS = {
    "dkf": (DKF, "q(z_t | z_{t-1}, x_{t:T})"),
    "dkf, mean field": (DKF, "q(z_t | x_{1:T})"),
    "dkf, backward": (DKF, "q(z_t | z_{t+1}, x_{<=t})"),
    "srnn": ("p(z_t | x_{<t}, z_{t-1}) p(x_t | x_{<t}, z_t)", "q(z_t | z_{t-1}, x_{1:T})"),
    "vrnn": ("p(z_t | x_{<t}, z_{<t}) p(x_t | x_{<t}, z_{<=t})", "q(z_t | x_{<=t}, z_{<t})"),
    "storn": ("p(z_t) p(x_t | x_{<t}, z_{<=t})", "q(z_t | x_{1:T})"),
    "rvae": ("p(z_t) p(x_t | z_{<=t})", "q(z_t | z_{<t}, x_{t:T})"),
    "dsae": ("p(w) p(z_t | z_{<t}) p(x_t | w, z_t)", "q(w | x_{1:T}) q(z_t | w, x_{1:T})"),
    "dsae, with z": ("p(w) p(z_t | z_{<t}) p(x_t | w, z_t)", "q(w | x_{1:T}) q(z_t | z_{<t}, w, x_{1:T})"),
    "hit-dvae": (HIT_DVAE, "q(w | x_{1:T}) q(z_t | x_{1:T}, w)"),
    "hit-dvae, with z": (HIT_DVAE, "q(w | x_{1:T}) q(z_t | z_{<t}, x_{1:T}, w)"),
    # w depends on the u_{>t} that connect later data with z_t.
    "two layers": (
        TWO_LAYERS,
        "q(w | x_{1:T}) q(u_t | u_{t-1}, z_{t-1}, x_{1:T}, w) q(z_t | z_{t-1}, u_t, x_{1:T}, w)",
    ),
    "two layers, mean field": (TWO_LAYERS, "q(w | x_{1:T}) q(u_t | x_{1:T}) q(z_t | x_{1:T})"),
    "statics": ("p(v) p(w | v) p(x_t | x_{t-1}, w)", "q(v | x_{1:T}) q(w | v, x_{1:T})"),
}
EXACT = {"dkf", "dkf, backward", "srnn", "rvae", "dsae, with z", "hit-dvae, with z", "two layers", "statics"}


def build(pair, size=1, seed=0, steps=T, scale=0.4):
    pair = PAIRS[pair] if isinstance(pair, str) else pair
    generative, inference = (Factorization.parse(f) if isinstance(f, str) else f for f in pair)
    sizes = dict.fromkeys(generative.variables, size)
    return linear_gaussian_surrogate(generative, inference, sizes, steps, seed, scale=scale)


def data(model, n, steps=T):
    return model.sample(n, steps)["x"]


def z_score(draws, expected):
    """Return the distance of the mean of draws (N, ...) from its expectation, in standard errors."""
    error = draws.std(0) / len(draws) ** 0.5
    return ((draws.mean(0) - expected).abs() / (error + 1e-9)).max().item()


# ------------------------------------------------------------------------------- the oracle against brute force


def kalman(A, C, b, d, Q, R, x):
    """Return log p(x) and smoothed moments of z_t = A_t z_{t-1} + b_t + N(0, Q_t), x_t = C_t z_t + d_t + N(0, R_t)."""
    steps, n = len(A), A.shape[1]
    mean, cov, log_evidence, filtered = np.zeros(n), np.zeros((n, n)), 0.0, []
    for t in range(steps):
        prior_mean, prior_cov = A[t] @ mean + b[t], A[t] @ cov @ A[t].T + Q[t]
        S = C[t] @ prior_cov @ C[t].T + R[t]
        innovation = x[t] - C[t] @ prior_mean - d[t]
        log_evidence -= 0.5 * (innovation @ np.linalg.solve(S, innovation) + np.linalg.slogdet(2 * np.pi * S)[1])
        gain = np.linalg.solve(S, C[t] @ prior_cov).T
        mean, cov = prior_mean + gain @ innovation, prior_cov - gain @ S @ gain.T
        filtered.append((mean, cov, prior_mean, prior_cov))
    means, covs = [mean], [cov]
    for t in range(steps - 2, -1, -1):
        mean, cov = filtered[t][:2]
        next_mean, next_cov = filtered[t + 1][2:]
        back = np.linalg.solve(next_cov, A[t + 1] @ cov).T
        means.insert(0, mean + back @ (means[0] - next_mean))
        covs.insert(0, cov + back @ (covs[0] - next_cov) @ back.T)
    return log_evidence, np.array(means), np.array(covs)


def test_evidence_and_posterior_equal_kalman_filter_and_smoother():
    model = linear_gaussian_surrogate(*PAIRS["dkf"], {"z": 2, "x": 3}, T)
    x = data(model, 3)
    oracle = Oracle(model, T)
    z_net, x_net = model.generator["z"], model.generator["x"]
    W, V = z_net.network.weight("z", T).detach().numpy(), x_net.network.weight("z", T).detach().numpy()
    A = np.array([W[t, t - 1] if t else np.zeros((2, 2)) for t in range(T)])
    C = np.array([V[t, t] for t in range(T)])
    b, d = z_net.network.bias.detach().numpy(), x_net.network.bias.detach().numpy()
    Q, R = (np.array([np.diag(s) for s in c.head.log_scale.exp().square().detach().numpy()]) for c in (z_net, x_net))
    evidence, (means, covariance) = oracle.evidence(x).detach(), oracle.posterior(x)
    for i in range(3):
        log_evidence, smoothed, covs = kalman(A, C, b, d, Q, R, x[i].numpy())
        assert abs(evidence[i].item() - log_evidence) < 1e-9
        np.testing.assert_allclose(means[i].detach().reshape(T, 2), smoothed, atol=1e-9)
        blocks = covariance.detach().reshape(T, 2, T, 2)
        np.testing.assert_allclose([blocks[t, :, t] for t in range(T)], covs, atol=1e-9)


def partly_observed(model, x):
    """Return the data with missing entries and lengths, and standardise all variables of the model."""
    for name, size in model.sizes.items():
        model.standardise(name).double().fit(1 + 2 * torch.randn(50, size, dtype=torch.float64))
    mask = torch.rand_like(x) < 0.6
    return {"x": x, "mask": mask, "lengths": torch.tensor([T, T - 1, 1, T])}


@pytest.mark.parametrize("partial", [True])
@pytest.mark.parametrize("pair", PAIRS)
def test_the_log_joint_is_evidence_plus_log_posterior(pair, partial):
    model = build(pair, size=2)
    x = data(model, 4)
    batch = partly_observed(model, x) if partial else x
    latents = {name: value.detach() for name, value in model.guide(batch).items()}
    oracle = Oracle(model, T)
    means, covariances = (part.detach() for part in oracle.posterior(batch))
    values, log_posterior = oracle._stack(latents, model.latents), []
    for mean, covariance, value in zip(means, covariances.expand(4, -1, -1), values, strict=True):
        is_step = covariance.diagonal() > 0
        assert (value[~is_step] == 0).all()
        posterior = dist.MultivariateNormal(mean[is_step], covariance[is_step][:, is_step])
        log_posterior.append(posterior.log_prob(value[is_step]))
    joint = sum(model.log_joint(batch, latents).values())
    torch.testing.assert_close(joint, oracle.evidence(batch).detach() + torch.stack(log_posterior), rtol=0, atol=1e-8)


@pytest.mark.parametrize("indicators", [(), ("x",)])
@pytest.mark.parametrize("pair", ["dkf, backward", "two layers", "statics"])
def test_the_exact_bound_of_partly_observed_data_equals_the_dense_one(pair, indicators):
    distributions = {"default": FixedNormal(0.7, learned=True, project=False)}
    distributions |= {f"p({name})": StandardNormal() for name in ("w", "v") if f"p({name})" in PAIRS[pair][0]}
    sizes = dict.fromkeys(Factorization.parse(PAIRS[pair][0]).variables, 1)
    model = DynamicalVAE(*PAIRS[pair], sizes, Linear(T), distributions, indicators=indicators).double()
    batch = partly_observed(model, torch.randn(4, T, 1, dtype=torch.float64))
    expected = library_bound(model, batch["x"], lengths=batch["lengths"], seen=batch["mask"])
    torch.testing.assert_close(Oracle(model, T).bound(batch), expected, rtol=0, atol=1e-8)


# -------------------------------------------------------------------------------- bounds against the evidence


@pytest.mark.parametrize("pair", PAIRS)
def test_the_sequence_elbo_estimates_the_exact_bound(pair):
    model = build(pair)
    x = data(model, 2)
    oracle = Oracle(model, T)
    with torch.no_grad():
        exact, evidence = oracle.bound(x), oracle.evidence(x)
        terms = SequenceELBO().terms(model, x.repeat(4000, 1, 1))
        bounds = terms.bound.reshape(4000, 2)
    assert (exact <= evidence + 1e-9).all()
    assert z_score(bounds, exact) < 5


@pytest.mark.parametrize("pair", PAIRS)
def test_the_gap_is_the_mean_of_evidence_minus_bound(pair):
    model = build(pair)
    oracle = Oracle(model, T)
    with torch.no_grad():
        x = data(model, 4000)
        assert z_score(oracle.evidence(x) - oracle.bound(x), oracle.gap()) < 5


@pytest.mark.parametrize("pair", PAIRS)
def test_the_gap_closes_if_and_only_if_the_audit_is_exact(pair):
    oracle = Oracle(build(pair), T)
    assert audit(*PAIRS[pair]).exact == (pair in EXACT)
    gap = oracle.fit_guide()
    assert gap > -1e-9
    assert (gap < 1e-6) == (pair in EXACT), gap


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


@settings(max_examples=10)
@given(factorizations(), st.integers(0, 999))
def test_random_guides_are_tight_if_and_only_if_the_audit_is_exact(pair, seed):
    verdict = audit(*pair)
    gap = Oracle(build(pair, seed=seed, scale=0.6), T).fit_guide()
    assert gap > -1e-9
    assert (gap < 1e-6) == verdict.exact, gap


@settings(max_examples=10)
@given(factorizations(), st.integers(0, 999))
def test_guides_with_custom_masks_are_tight_if_and_only_if_the_audit_is_exact(pair, seed):
    rng = np.random.default_rng(seed)
    pair = [masked(text, rng, 0.6) for text in pair]
    verdict = audit(*pair, steps=T)
    gap = Oracle(build(pair, seed=seed, scale=0.6), T).fit_guide()
    assert (gap < 1e-6) == verdict.exact, gap


def exact_guide(model):
    """Return the posterior as a Pyro guide: a dense normal of each latent given the earlier ones."""
    oracle = Oracle(model, T)

    def guide(x):
        mean, covariance = (m.detach() for m in oracle.posterior(x))
        draws = x.new_zeros(len(x), 0)
        with pyro.plate("sequences", len(x), dim=-1):
            for name in model.latents:
                past = slice(0, draws.shape[1])
                shape = (*([T] if model.generative.local(name) else []), model.sizes[name])
                columns = slice(past.stop, past.stop + math.prod(shape))
                gain = torch.linalg.solve(covariance[past, past], covariance[past, columns])
                conditional_covariance = covariance[columns, columns] - covariance[columns, past] @ gain
                distribution = dist.MultivariateNormal(
                    mean[:, columns] + (draws - mean[:, past]) @ gain,
                    (conditional_covariance + conditional_covariance.t()) / 2,
                )
                reshape = ReshapeTransform(distribution.event_shape, shape)
                value = pyro.sample(name, dist.TransformedDistribution(distribution, [reshape]))
                draws = torch.cat([draws, value.flatten(1)], dim=1)

    return guide


def assert_tight(model, x):
    """Check that every draw from the exact posterior gives the evidence, so the bound has no variance."""
    guide, evidence = exact_guide(model), Oracle(model, T).evidence(x).detach()
    for _ in range(3):
        bounds = [-Trace_ELBO().loss(model.model, guide, sequence[None]) for sequence in x]
        torch.testing.assert_close(x.new_tensor(bounds), evidence, rtol=0, atol=1e-8)
        terms = SequenceELBO().terms(model, x, guide)
        torch.testing.assert_close(terms.bound.detach(), evidence, rtol=0, atol=1e-8)


@pytest.mark.parametrize("pair", PAIRS)
def test_with_the_exact_posterior_as_guide_every_draw_gives_the_evidence(pair):
    model = build(pair, size=2)
    assert_tight(model, data(model, 3))


@settings(max_examples=25)
@given(factorizations(), st.integers(0, 999))
def test_the_exact_posterior_is_tight_for_random_factorizations(pair, seed):
    model = build(pair, seed=seed)
    torch.manual_seed(seed)
    assert_tight(model, data(model, 2))


# ---------------------------------------------------------------------------------- where the analytic KL is wrong


AGAINST = {
    "local": (*PAIRS["dkf, backward"], "z", "z"),
    # w is drawn first, though v is its parent.
    "static": ("p(v) p(w | v) p(x_t | w)", "q(w | x_{1:T}) q(v | w)", "w", "v"),
}


@pytest.mark.parametrize("pair", AGAINST)
def test_a_latent_drawn_against_the_edges_has_no_analytic_kl(pair, monkeypatch):
    *equations, child, parent = AGAINST[pair]
    model = build(tuple(equations))
    with torch.no_grad():
        model.generator[child].network.weights[parent].fill_(1.0)  # a strong edge between latents
    oracle = Oracle(model, T)
    assert oracle.fit_guide() < 1e-6  # the exact bound is the evidence, and draws vary little
    x = data(model, 1).repeat(4000, 1, 1)
    with torch.no_grad():
        exact = oracle.bound(x[:1])
        bounds = SequenceELBO().terms(model, x).bound
        assert z_score(bounds, exact) < 5
        monkeypatch.setattr("dvae.inference.bounds.elbo._closed_forms", lambda *sites: set(model.latents))
        forced = SequenceELBO().terms(model, x).bound
    assert z_score(forced, exact) > 20


# ----------------------------------------------------------------------------------------------- cost and errors


def test_a_dropped_edge_opens_a_gap():
    sizes = {"z": 1, "x": 1}
    full = kl_gap(DKF, "q(z_t | z_{t-1}, x_{t:T})", sizes, steps=T, seeds=2)
    dropped = kl_gap(DKF, "q(z_t | x_{t:T})", sizes, steps=T, seeds=2)
    assert full.shape == (2,)
    assert full.abs().max() < 1e-6
    assert dropped.min() > 1e-3


def data_covariance(generative, sizes, seed, steps):
    """Return the covariance of the data under the random model of a seed."""
    oracle = Oracle(linear_gaussian_surrogate(generative, None, sizes, steps, seed), steps)
    n = sum(map(oracle._size, oracle.model.latents))
    return torch.linalg.inv(oracle._joint()[1].detach())[n:, n:]


def dependence(covariance, size):
    """Return the total correlation of blocks of normal coordinates, in nats."""
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
def test_a_model_without_dependence_loses_the_total_correlation(case):
    generative, reduced, sizes, steps, size = INDEPENDENT[case]
    gaps = model_kl_gap(generative, reduced, sizes, steps, seeds=3)
    expected = [dependence(data_covariance(generative, sizes, seed, steps), size) for seed in range(3)]
    assert min(expected) > 1e-6
    assert gaps.tolist() == pytest.approx(expected, abs=1e-9)


def test_a_redundant_edge_costs_nothing():
    costs = model_edge_costs("p(z_t | z_{t-1}, x_{<t}) p(x_t | x_{<t}, z_t)", steps=3, seeds=2)
    assert {edge for edge, cost in costs.items() if cost.max() < 1e-8} == {"z_{t-1} to z_t", "x_{<t} to z_t"}
    assert costs["x_{<t} to x_t"].min() > 1e-3


def with_prior(distribution):
    parts = {"default": FixedNormal(project=False), "p(w)": distribution}
    return DynamicalVAE("p(w) p(x_t | w)", "q(w | x_{1:T})", {"w": 2, "x": 1}, Linear(T), parts).double()


def test_a_learned_normal_prior_is_part_of_the_evidence():
    model = with_prior(FixedNormal(scale=0.6, learned=True))
    with torch.no_grad():
        model.generator["w"].head.out.bias.copy_(torch.tensor([1.0, -2.0]))
    network, x = model.generator["x"].network, torch.randn(3, T, 1, dtype=torch.float64)
    slopes = network.weights["w"][:, 0, 0]
    mean = network.bias[:T, 0] + slopes @ torch.tensor([1.0, -2.0], dtype=torch.float64)
    covariance = 0.36 * slopes @ slopes.T + torch.eye(T, dtype=torch.float64)
    expected = dist.MultivariateNormal(mean, covariance).log_prob(x[..., 0])
    torch.testing.assert_close(Oracle(model, T).evidence(x), expected, rtol=0, atol=1e-6)
