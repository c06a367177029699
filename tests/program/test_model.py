"""The Pyro program of a factorization: all ways of running it agree."""

import itertools
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pyro import poutine
from pyro.infer import Predictive, Trace_ELBO

from dvae import DynamicalVAE, distributions
from dvae.networks import Attention, Dense, Linear, Recurrent
from dvae.program.batch import in_chunks
from dvae.program.reference import reference
from dvae.program.rollout import ScheduledSampling
from dvae.testing.strategies import factorizations

B, T = 3, 5
SIZES = {"w": 2, "v": 1, "u": 1, "z": 2, "x": 3, "y": 2, "c": 1, "pose": 2}
PAIRS = {
    "vae": ("p(z_t) p(x_t | z_t)", "q(z_t | x_t)"),
    "dkf": ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})"),
    "storn": ("p(z_t) p(x_t | x_{<t}, z_{<=t})", "q(z_t | x_{<=t})"),
    "vrnn": ("p(z_t | x_{<t}, z_{<t}) p(x_t | x_{<t}, z_{<=t})", "q(z_t | x_{<=t}, z_{<t})"),
    "srnn": ("p(z_t | x_{<t}, z_{t-1}) p(x_t | x_{<t}, z_t)", "q(z_t | z_{t-1}, x_{1:T})"),
    "rvae": ("p(z_t) p(x_t | z_{1:T})", "q(z_t | z_{<t}, x_{1:T})"),
    "dsae": ("p(w) p(z_t | z_{<t}) p(x_t | w, z_t)", "q(w | x_{1:T}) q(z_t | w, x_{1:T})"),
    "hit-dvae": ("p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)", "q(w | x_{1:T}) q(z_t | x_{1:T}, w)"),
    "two layers": (
        "p(w) p(u_t | u_{t-1}, w) p(z_t | z_{t-1}, u_t) p(x_t | x_{<t}, z_t)",
        "q(w | x_{1:T}) q(u_t | u_{t-1}, z_{1:T}, w) q(z_t | z_{t-1}, x_{1:T}, w)",
    ),
    "backward guide": ("p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{>t}, x_{1:T})"),
    "statics": (
        "p(v) p(w | v) p(z_t | z_{t-1}, v) p(x_t | x_{t-1}, z_t, w)",
        "q(z_t | x_{1:T}) q(w | z_{1:T}, x_{1:T}) q(v | w, x_{1:T})",
    ),
    "body parts": (
        "p(z_t | z_{t-1}, y_{t-1}) p(x_t | x_{t-1}, z_t) p(y_t | y_{<t}, x_t, z_t)",
        "q(z_t | z_{t-1}, x_{1:T}, y_{<=t})",
    ),
    "context": (
        "p(w | pose) p(z_t | z_{t-1}, c_t, w) p(x_t | x_{t-1}, z_t, c_{1:T}, pose)",
        "q(w | x_{1:T}, c_{1:T}) q(z_t | z_{t-1}, x_{1:T}, c_{>=t}, pose, w)",
    ),
}
NETWORKS = {"recurrent": Recurrent(4, hidden=(5,)), "attention": Attention(8, heads=2)}
CASES = [(pair, list(NETWORKS)[n % 2]) for n, pair in enumerate(PAIRS)]


def build(pair, network="recurrent", **options):
    generative, inference = PAIRS.get(pair, pair) if isinstance(pair, str) else pair
    names = [name for name in SIZES if f"({name}" in generative + inference or f" {name}" in generative + inference]
    observed = ("x", "y") if "p(y" in generative else ("x",)
    network = NETWORKS.get(network, network) if isinstance(network, str) else network
    sizes = {name: SIZES[name] for name in names}
    return DynamicalVAE(generative, inference, sizes, network, observed=observed, **options).double()


def draw(model, batch=B, steps=T):
    """Return random data and context."""
    local = {
        n: model.generative.local(n) if n in model.observed else n != "pose" for n in (*model.observed, *model.context)
    }
    return {
        name: torch.randn(batch, *([steps] if in_time else []), model.sizes[name], dtype=torch.float64)
        for name, in_time in local.items()
    }


def log_probs(program, *args, **kwargs):
    """Return the values and log densities (B,) of all sites."""
    trace = poutine.trace(program).get_trace(*args, **kwargs)
    trace.compute_log_prob()
    sites = {n: s for n, s in trace.nodes.items() if s["type"] == "sample" and n != "sequences"}
    return {n: s["value"].detach() for n, s in sites.items()}, {n: s["log_prob"].detach() for n, s in sites.items()}


def log_guide(model, batch, latents):
    return log_probs(poutine.condition(model.guide, data=latents), batch)[1]


def close(got, expected, tolerance=1e-9):
    assert got.keys() == expected.keys()
    for name, value in expected.items():
        torch.testing.assert_close(got[name], value, rtol=0, atol=tolerance, msg=lambda m, name=name: f"{name}: {m}")


# ------------------------------------------------------------------------------------------- sites and shapes


@pytest.mark.parametrize("pair", PAIRS)
def test_the_program_works_with_pyros_tools(pair):
    model = build(pair)
    data = draw(model)
    posterior = Predictive(model.model, guide=model.guide, num_samples=4)(data)
    assert {name: tuple(posterior[name].shape[:2]) for name in model.latents} == dict.fromkeys(model.latents, (4, B))
    prior = Predictive(model.model, num_samples=4)({n: data[n] for n in model.context}, length=T, size=B)
    assert prior["x"].shape == (4, B, T, 3)
    latents = poutine.trace(model.guide).get_trace(data)
    replayed = poutine.trace(poutine.replay(model.model, trace=latents)).get_trace(data)
    for name in model.latents:
        assert replayed.nodes[name]["value"] is latents.nodes[name]["value"]
    for elbo in (Trace_ELBO(), Trace_ELBO(num_particles=2)):
        loss = elbo(model, model.guide)(data)
        loss.backward()
        assert torch.isfinite(loss)


# ------------------------------------------------------------------------------------------- the log joint


def per_step(model, data, latents):
    """Return the log joint of the reference program for each variable."""
    locals_ = {n: v for n, v in latents.items() if v.dim() == 3}
    given_values = {n: v for n, v in latents.items() if v.dim() == 2}
    given_values |= {f"{n}_{t + 1}": v[:, t] for n, v in locals_.items() for t in range(v.shape[1])}
    _, logs = log_probs(poutine.condition(partial(reference, model), data=given_values), data)
    out = {}
    for name in model.generative.variables:
        parts = [value for site, value in logs.items() if site == name or site.rsplit("_", 1)[0] == name]
        out[name] = sum(parts)
    return out


@pytest.mark.parametrize(("pair", "network"), CASES)
def test_the_vectorised_joint_equals_the_per_step_program(pair, network):
    model = build(
        pair, network, distributions={"p(w)": distributions.FixedNormal(learned=True)} if pair == "dsae" else None
    )
    data = draw(model)
    latents = {name: value.detach() for name, value in model.guide(data).items()}
    close(per_step(model, data, latents), model.log_joint(data, latents))


@settings(max_examples=25)
@given(factorizations(), st.sampled_from(["linear", *NETWORKS]), st.integers(0, 99))
def test_all_programs_of_random_factorizations_agree(pair, network, seed):
    torch.manual_seed(seed)
    model = build(pair, Linear(steps=T) if network == "linear" else network)
    free, logs = log_probs(model.model, length=T, size=2)
    data, latents = {"x": free["x"]}, {name: free[name] for name in model.latents}
    close(logs, model.log_joint(data, latents))
    close(logs, per_step(model, data, latents))
    latents_of_guide, guide_logs = log_probs(model.guide, data)
    close(guide_logs, log_guide(model, data, latents_of_guide))


# -------------------------------------------------------------------------- ragged batches and missing entries


@pytest.mark.parametrize(("pair", "network"), CASES)
def test_padding_changes_nothing(pair, network):
    model = build(pair, network)
    lengths = torch.tensor([3, T, 1])
    pad = (torch.arange(T) >= lengths[:, None])[..., None]
    clean = draw(model)
    padded = {n: v.masked_fill(pad, float("nan")) if v.dim() == 3 else v for n, v in clean.items()}
    padded["lengths"] = lengths
    latents, guide_logs = log_probs(model.guide, padded)
    logs = model.log_joint(padded, latents)
    for i, n in enumerate(lengths.tolist()):

        def cut(values, i=i, n=n):
            return {k: v[i : i + 1, :n] if v.dim() == 3 else v[i : i + 1] for k, v in values.items()}

        single, single_latents = cut(clean), cut(latents)
        close({k: v[i : i + 1] for k, v in logs.items()}, model.log_joint(single, single_latents))
        close({k: v[i : i + 1] for k, v in guide_logs.items()}, log_guide(model, single, single_latents))


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("pair", ["srnn", "hit-dvae", "body parts"])
def test_the_value_of_a_missing_entry_changes_nothing(pair, network):
    model = build(pair, network)
    data = draw(model)
    masks = {name: torch.rand_like(data[name]) < 0.7 for name in model.observed}
    holes = {name: data[name].masked_fill(~masks[name], float("nan")) for name in model.observed}
    zeros = {name: data[name].masked_fill(~masks[name], 0.0) for name in model.observed}
    latents = {name: value.detach() for name, value in model.guide({**holes, "mask": masks}).items()}
    missing = {**holes, "mask": masks}
    close(log_guide(model, missing, latents), log_guide(model, zeros, latents))
    others = {name: data[name].masked_fill(~masks[name], 17.0) for name in model.observed}
    close(model.log_joint(missing, latents), model.log_joint({**others, "mask": masks}, latents))
    everything = {name: torch.ones_like(mask) for name, mask in masks.items()}
    close(model.log_joint({**data, "mask": everything}, latents), model.log_joint(data, latents))
    nothing = {name: torch.zeros_like(mask) for name, mask in masks.items()}
    assert all((model.log_joint({**data, "mask": nothing}, latents)[name] == 0).all() for name in model.observed)


# --------------------------------------------------------------------------------------------------- forecasts


def means(model, values):
    """Return the teacher-forced means of all data variables at every step."""
    return {
        n: model.generator[n](values, next(iter(values.values())).shape[0], values["x"].shape[1])[0]
        for n in model.observed
    }


@pytest.mark.parametrize(
    ("pair", "network", "chunk"),  # chunks are smaller than the batch, or larger than all samples
    [(pair, network, (2, 2048)[n % 3 // 2]) for n, (pair, network) in enumerate(CASES) if pair != "rvae"],
)
def test_a_forecast_continues_the_past_with_the_means_of_the_model(pair, network, chunk):
    model = build(pair, network)
    past, horizon, samples = 3, 4, 2
    data = draw(model, B, past + horizon)
    observed = {n: v[:, :past] if n in model.observed else v for n, v in data.items()}
    out = model.forecast(observed, horizon, samples, draw_emission=False, chunk=chunk)
    for name in model.latents:
        steps = [past + horizon] if model.generative.local(name) else []
        assert out[name].shape == (samples, B, *steps, model.sizes[name])
    for s in range(samples):
        values = {n: out[n][s] for n in model.latents} | {n: data[n] for n in model.context}
        values |= {n: torch.cat([observed[n], out[n][s]], 1) for n in model.observed}
        for name, mean in means(model, values).items():
            torch.testing.assert_close(out[name][s], mean[:, past:].detach(), rtol=0, atol=1e-9)
    assert not torch.equal(out["x"][0], out["x"][1])


@given(size=st.integers(1, 7), samples=st.integers(1, 7), chunk=st.integers(1, 50))
def test_chunks_cover_every_sample_of_every_sequence_once_within_their_size(size, samples, chunk):
    counter = itertools.count()

    def make(part, count):
        sequences = torch.arange(size)[part].expand(count, -1)
        assert 1 <= sequences.numel() <= chunk
        calls = torch.tensor([next(counter) for _ in range(count)])[:, None].expand_as(sequences)
        return {"sequence": sequences, "draw": torch.stack([calls, -calls], -1)}

    samples_made = in_chunks(make, size, samples, chunk)
    assert torch.equal(samples_made["sequence"], torch.arange(size).expand(samples, -1))
    assert torch.equal(samples_made["draw"][..., 0], -samples_made["draw"][..., 1])
    assert all(len(set(draws.tolist())) == samples for draws in samples_made["draw"][..., 0].T)


# ------------------------------------------------------------------------------------------------ scheduled sampling


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("pair", ["srnn", "body parts", "context"])
@pytest.mark.parametrize("residual", [False, True])
def test_scheduled_sampling_reads_the_means_of_the_model(pair, network, residual):
    model = build(pair, network, distributions={"p(x)": distributions.Normal(residual=residual)})
    data = draw(model)
    latents = {name: value.detach() for name, value in model.guide(data).items()}
    program = poutine.condition(model.model, data=latents)

    def logs(feeding):
        torch.manual_seed(5)
        return log_probs(program, data, scheduled_sampling=feeding)[1]

    close(logs(0.0), model.log_joint(data, latents))
    exact = logs(1.0)
    # The expected means are computed step by step, each from the previous means.
    inputs = {name: torch.zeros_like(data[name]) for name in model.observed}
    for t in range(T):
        for name in model.observed:
            inputs[name][:, t] = means(model, {**data, **latents, **inputs})[name][:, t].detach()
    expected = {}
    for name in model.generative.variables:
        conditional = model.generator[name]
        if not model.generative.local(name):
            expected[name] = exact[name]
            continue
        distribution = conditional.head.distribution(conditional({**data, **latents, **inputs}, B, T))
        expected[name] = distribution.log_prob({**data, **latents}[name]).sum((1, 2)).detach()
    close(exact, expected)
    close(logs(ScheduledSampling(1.0, passes=T)), exact)
    half = logs(0.5)
    close(logs(ScheduledSampling(0.5, passes=T)), half)
    assert not torch.allclose(half["x"], exact["x"])


# ------------------------------------------------------------------------------------------------ choice by factor


def test_networks_and_distributions_are_chosen_by_factor():
    model = build(
        "dkf",
        {"p": Dense((3,)), "q(z)": Attention(8, heads=2), "default": Recurrent(4)},
        distributions={"p(x)": distributions.StudentT(), "q": distributions.FixedNormal(scale=0.5)},
    )
    assert type(model.generator["z"].network).__name__ == "DenseNetwork"
    assert type(model.encoder["z"].network).__name__ == "AttentionNetwork"
    assert type(model.generator["x"].head).__name__ == "StudentTModule"
    assert type(model.generator["z"].head).__name__ == "NormalModule"
    assert type(model.encoder["z"].head).__name__ == "FixedNormalModule"
