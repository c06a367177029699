"""The FIVO bound: unbiased for the evidence, equal to a textbook filter, with resampled network states."""

import math

import pyro
import pytest
import torch

from dvae import DynamicalVAE, Oracle, fivo_bound, linear_gaussian_surrogate
from dvae.factorization.notation import Factorization
from dvae.networks import Attention, Dense, Linear, Recurrent
from dvae.program.batch import repeat
from dvae.program.particles import ancestors, normalise

T = 5
PAIRS = {
    "dkf": ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T})"),
    "srnn": ("p(z_t | x_{<t}, z_{t-1}) p(x_t | x_{<t}, z_t)", "q(z_t | z_{t-1}, x_{1:T})"),
    "vrnn": ("p(z_t | x_{<t}, z_{<t}) p(x_t | x_{<t}, z_{<=t})", "q(z_t | x_{<=t}, z_{<t})"),
    "static": ("p(w) p(z_t | z_{<t}) p(x_t | z_t, w)", "q(w | x_{1:T}) q(z_t | x_{1:T}, w)"),
    "two layers": (
        "p(w) p(u_t | u_{t-1}, w) p(z_t | z_{t-1}, u_t) p(x_t | x_{<t}, z_t)",
        "q(w | x_{1:T}) q(u_t | u_{t-1}, z_{t-1}, x_{1:T}, w) q(z_t | z_{t-1}, u_t, x_{1:T}, w)",
    ),
    "static drawn last": (
        "p(w) p(z_t | z_{<t}, w) p(v | z_{1:T}, w) p(x_t | z_t)",
        "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{1:T}) q(v | z_{1:T}, x_{1:T}, w)",
    ),
    "context": ("p(z_t | z_{t-1}, c_t, b) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-1}, x_{1:T}, c_t)"),
}
SIZES = {"w": 2, "v": 1, "u": 1, "z": 2, "x": 3, "c": 2, "b": 1}
NETWORKS = {
    "linear": Linear(T),
    "lstm": Recurrent(4, hidden=(5,)),
    "gru": Recurrent(3, cell="gru", layers=2, embed=3, hidden=(4,)),
    "attention": Attention(8, heads=2, layers=2),
    "dense": Dense((5,)),
}


def names(equations):
    factorization = Factorization.parse(equations)
    return [*factorization.variables, *factorization.context]


def build(pair, kind, **options):
    p, q = PAIRS[pair]
    if kind == "dense":
        q = q.replace("x_{1:T}", "x_t")
    return DynamicalVAE(p, q, {name: SIZES[name] for name in names(p)}, NETWORKS[kind], **options).double()


def data(model, batch=3, **more):
    locals_ = {"x": SIZES["x"], "c": SIZES["c"]}
    sizes = {name: SIZES[name] for name in (*model.observed, *model.context)}
    shapes = {n: (batch, T, d) if n in locals_ else (batch, d) for n, d in sizes.items()}
    return {**{name: torch.randn(shape, dtype=torch.float64) for name, shape in shapes.items()}, **more}


def gaps(batch=3):
    mask = torch.rand(batch, T, SIZES["x"]) > 0.3
    mask[0, 1] = False
    return {"mask": mask}


BATCHES = {"whole": dict, "ragged": lambda: {"lengths": torch.tensor([T, 1, 3])}, "gaps": gaps}
CASES = [
    ("dkf", "dense", "gaps"),  # which reads single steps only
    ("srnn", "linear", "whole"),
    ("vrnn", "gru", "gaps"),
    ("static", "attention", "ragged"),
    ("two layers", "lstm", "gaps"),
    ("static drawn last", "attention", "gaps"),
    ("static drawn last", "gru", "ragged"),
    ("context", "lstm", "ragged"),
]


def light_tailed_surrogate(pair, seed=1):
    """Return a surrogate whose guide is the best of its factorization, slightly wider for light-tailed weights."""
    model = linear_gaussian_surrogate(*PAIRS[pair], dict.fromkeys(names(PAIRS[pair][0]), 1), T, seed, scale=0.5)
    Oracle(model, T).fit_guide(100)
    with torch.no_grad():
        for conditional in model.encoder.values():
            conditional.head.log_scale.add_(0.2)
    return model


# ------------------------------------------------------------------------------------------------------------ oracle


@pytest.mark.parametrize("pair", ["vrnn", "static drawn last"])
def test_the_bound_is_unbiased_for_the_evidence(pair):
    model = light_tailed_surrogate(pair)
    x = model.sample(500, T)["x"].mean(
        0, keepdim=True
    )  # improbable data give heavy-tailed weights, whose standard errors mean nothing
    with torch.no_grad():
        evidence = Oracle(model, T).evidence(x)
    n = 3000
    for resample_below in (0.0, 0.7, 1.0):
        out = fivo_bound(model, x.repeat(n, 1, 1), 4, resample_below=resample_below, chunk=4 * n)
        ratio = (out.bound - evidence).exp()
        assert abs(ratio.mean() - 1) < 4 * ratio.std() / n**0.5 < 0.25
        assert (out.resamplings > 0).any() == (resample_below > 0)


def test_the_exact_posterior_gives_the_evidence_without_resampling():
    model = linear_gaussian_surrogate(*PAIRS["srnn"], {"z": 1, "x": 2}, T)
    assert Oracle(model, T).fit_guide() < 1e-10
    x = model.sample(5, T)["x"]
    out = fivo_bound(model, x, 8, chunk=16)
    torch.testing.assert_close(out.bound, Oracle(model, T).evidence(x).detach(), rtol=0, atol=1e-3)
    assert (out.resamplings == 0).all()
    # Before the last step weights are for x_{1:t}, but draws are for x_{1:T}: weights are equal at the end only.
    assert (out.effective[-1] > 7.9999).all()


# ---------------------------------------------------------------------------------------------- the program's weights


def textbook(model, batch, particles, resample_below):
    """Run the same filter, evaluating every conditional from scratch at every step."""
    everyone = repeat(model.read(batch), particles)
    latents, n = {}, len(everyone["x"])

    def generator(guide=False):
        rollout = model.rollout(everyone, guide=guide)
        rollout.values.update(latents)
        return rollout

    def guide():
        return generator(guide=True)

    def draw(distribution, noise):
        return distribution.loc + distribution.scale * noise

    weight = torch.zeros(n, dtype=torch.float64)
    statics = [name for name in model.latents if not model.generative.local(name)]
    last = [name for name in statics if "z" in model.encoder[name].parents]
    shape = particles, len(batch["x"])
    bound, count = torch.zeros(shape[1], dtype=torch.float64), torch.zeros(shape[1], dtype=torch.long)

    def draw_static(name):
        distribution = guide().distribution(name)
        latents[name] = draw(distribution.base_dist, torch.randn(n, model.sizes[name], dtype=torch.float64))
        return generator().distribution(name).log_prob(latents[name]) - distribution.log_prob(latents[name])

    for name in (name for name in statics if name not in last):
        weight = weight + draw_static(name)
    moving = [name for name in model.latents if name not in statics]
    latents |= {name: torch.zeros(n, T, model.sizes[name], dtype=torch.float64) for name in moving}
    lengths = batch.get("lengths", torch.full((shape[1],), T))
    for t in range(T):
        low = (normalise(weight.view(shape))[2] < resample_below * particles) & (t < lengths)
        if (t or statics) and low.any():
            bound = bound + torch.where(low, weight.view(shape).logsumexp(0) - math.log(particles), 0.0)
            rows = ancestors(weight.view(shape), low)
            latents = {name: value[rows] for name, value in latents.items()}
            weight = weight.view(shape).masked_fill(low, 0).flatten()
            count += low
        total = torch.zeros(n, dtype=torch.float64)
        noise = {name: torch.randn(n, model.sizes[name], dtype=torch.float64) for name in moving}
        for name in moving:
            distribution = guide().evaluate(name, latents[name].clone())
            latents[name][:, t] = draw(distribution, noise[name][:, None])[:, t]
            total -= distribution.log_prob(latents[name])[:, t].sum(-1)
        rollout = generator()
        for name in (*moving, *model.observed):
            value = rollout.values[name].clone()
            entries = rollout.evaluate(name, value).log_prob(value)[:, t]
            mask = rollout.mask(name)
            total += (entries if name in moving or mask is None else entries * mask[:, t]).sum(-1)
        weight = weight + total * (t < lengths).repeat(particles)
    for name in moving:
        latents[name] = latents[name] * (torch.arange(T) < lengths[:, None])[..., None].repeat(particles, 1, 1)
    for name in last:
        weight = weight + draw_static(name)
    return bound + weight.view(shape).logsumexp(0) - math.log(particles), count


@torch.no_grad()
@pytest.mark.parametrize(("pair", "kind", "extra"), CASES)
def test_the_bound_equals_the_textbook_filter(pair, kind, extra):
    model = build(pair, kind)
    batch = data(model, **BATCHES[extra]())
    for below in (0.6, 1.0):
        if below == 1.0:
            model.standardise("z").double().fit(2 + 3 * torch.randn(9, 2, dtype=torch.float64))
        pyro.set_rng_seed(3)
        bound, count = textbook(model, batch, 4, below)
        pyro.set_rng_seed(3)
        out = fivo_bound(model, batch, 4, resample_below=below)
        torch.testing.assert_close(out.bound, bound, rtol=0, atol=1e-9)
        assert torch.equal(out.resamplings, count)
    assert count.sum() > 3


# ----------------------------------------------------------------------------------------------------------- networks


def test_systematic_resampling_copies_particles_in_proportion_to_weights():
    log_weights = torch.randn(6, 4, dtype=torch.float64)
    log_weights[2, 1] = -math.inf
    share = log_weights.softmax(0)
    counts = torch.zeros(6, 4, dtype=torch.float64)
    for _ in range(1000):
        rows = ancestors(log_weights, torch.tensor([True, True, True, False])).view(6, 4)
        assert torch.equal(rows % 4, torch.arange(4).expand(6, 4))
        count = torch.stack([torch.bincount(column // 4, minlength=6) for column in rows.t()], 1)
        assert (count[:, 3] == 1).all()
        assert ((count - 6 * share).abs()[:, :3] < 1).all()
        counts += count / 1000
    torch.testing.assert_close(counts[:, :3], 6 * share[:, :3], rtol=0, atol=0.06)
