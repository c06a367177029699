"""The Pyro program: one declaration of a factorization, and every way of running it agrees with every other."""

import copy
import itertools
from functools import partial

import pyro
import pyro.distributions as dist
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pyro import poutine
from pyro.infer import Predictive, Trace_ELBO

from dvae import DynamicalVAE, distributions
from dvae.data import views
from dvae.inference.bounds.elbo import SequenceELBO
from dvae.networks import Attention, Dense, Linear, Recurrent
from dvae.program.batch import Reader, in_chunks, rows
from dvae.program.reference import reference
from dvae.program.rollout import SelfFeeding
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
    "hit-dvae": (
        "p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)",
        "q(w | x_{1:T}) q(z_t | x_{1:T}, w)",
    ),
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


def build(pair, network="recurrent", **options):
    generative, inference = PAIRS.get(pair, pair) if isinstance(pair, str) else pair
    names = [name for name in SIZES if f"({name}" in generative + inference or f" {name}" in generative + inference]
    observed = ("x", "y") if "p(y" in generative else ("x",)
    network = NETWORKS.get(network, network) if isinstance(network, str) else network
    sizes = {name: SIZES[name] for name in names}
    return DynamicalVAE(generative, inference, sizes, network, observed=observed, **options).double()


def draw(model, batch=B, steps=T):
    """Data and context at random."""
    local = {
        n: model.generative.local(n) if n in model.observed else n != "pose" for n in (*model.observed, *model.context)
    }
    return {
        name: torch.randn(batch, *([steps] if in_time else []), model.sizes[name], dtype=torch.float64)
        for name, in_time in local.items()
    }


def log_probs(program, *args, **kwargs):
    """Site to log density (B,)."""
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


@pytest.mark.parametrize(
    ("pair", "network", "batch", "steps"),
    [
        (pair, network, *((B, T), (1, 1))[(m + n) % 2])
        for m, pair in enumerate(PAIRS)
        for n, network in enumerate(NETWORKS)
    ],
)
def test_there_is_one_site_per_variable(pair, network, batch, steps):
    model = build(pair, network)
    data = draw(model, batch, steps)
    for program, names in ((model.model, model.generative.variables), (model.guide, model.latents)):
        values, logs = log_probs(program, data)
        assert set(values) == set(names)
        for name in names:
            local = model.generative.local(name)
            assert values[name].shape == (batch, *([steps] if local else []), model.sizes[name])
            assert logs[name].shape == (batch,)
            assert torch.isfinite(logs[name]).all()


@pytest.mark.parametrize("pair", PAIRS)
def test_the_program_is_an_ordinary_pyro_program(pair):
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


def test_a_latent_may_be_conditioned_on_and_the_rest_is_drawn_from_it():
    model = build("srnn")
    z = torch.randn(B, T, 2, dtype=torch.float64)
    conditioned = poutine.condition(model.model, data={"z": z})
    out = conditioned(length=T, size=B)
    assert torch.equal(out["z"], z)
    again = poutine.trace(conditioned).get_trace({"x": out["x"]})
    again.compute_log_prob()
    close({"z": again.nodes["z"]["log_prob"]}, {"z": model.log_joint(out["x"], {"z": z})["z"]})


def test_conditioning_data_of_an_interleaved_loop_is_refused_after_the_fact():
    model = build("srnn")
    x = torch.randn(B, T, 3, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"x was set to a value after z had been drawn .* pass x to the model as data"):
        poutine.condition(model.model, data={"x": x})(length=T, size=B)


@pytest.mark.parametrize("pair", ["dkf", "hit-dvae", "body parts", "context"])
@pytest.mark.parametrize("network", NETWORKS)
def test_every_parameter_learns(pair, network):
    model = build(pair, network)
    Trace_ELBO()(model, model.guide)(draw(model)).backward()
    still = [name for name, p in model.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert not still


# --------------------------------------------------------------------------------- one joint, many ways to it


def per_step(model, data, latents):
    """The log joint of the reference program, by variable."""
    locals_ = {n: v for n, v in latents.items() if v.dim() == 3}
    given_values = {n: v for n, v in latents.items() if v.dim() == 2}
    given_values |= {f"{n}_{t + 1}": v[:, t] for n, v in locals_.items() for t in range(v.shape[1])}
    _, logs = log_probs(poutine.condition(partial(reference, model), data=given_values), data)
    out = {}
    for name in model.generative.variables:
        parts = [value for site, value in logs.items() if site == name or site.rsplit("_", 1)[0] == name]
        out[name] = sum(parts)
    return out


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("pair", PAIRS)
def test_the_vectorised_joint_is_that_of_the_per_step_program(pair, network):
    model = build(pair, network, laws={"p(w)": distributions.FixedNormal(learned=True)} if pair == "dsae" else None)
    data = draw(model)
    latents = {name: value.detach() for name, value in model.guide(data).items()}
    close(per_step(model, data, latents), model.log_joint(data, latents))


@settings(max_examples=25)
@given(factorizations(), st.sampled_from(["linear", *NETWORKS]), st.integers(0, 99))
def test_random_factorizations_run_alike_in_every_way(pair, network, seed):
    torch.manual_seed(seed)
    model = build(pair, Linear(steps=T) if network == "linear" else network)
    free, logs = log_probs(model.model, length=T, size=2)
    data, latents = {"x": free["x"]}, {name: free[name] for name in model.latents}
    close(logs, model.log_joint(data, latents))
    close(logs, per_step(model, data, latents))
    drawn, guide_logs = log_probs(model.guide, data)
    close(guide_logs, log_guide(model, data, drawn))


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("pair", PAIRS)
def test_draws_of_a_loop_have_the_density_that_scoring_gives_them(pair, network):
    model = build(pair, network)
    data = draw(model)
    context = {name: data[name] for name in model.context}
    free, logs = log_probs(model.model, context, length=T, size=B)
    scored = {**context, **{name: free[name] for name in model.observed}}
    close(logs, model.log_joint(scored, {name: free[name] for name in model.latents}))
    drawn, guide_logs = log_probs(model.guide, data)
    close(guide_logs, log_guide(model, data, drawn))


# -------------------------------------------------------------------------- ragged batches and missing entries


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("pair", PAIRS)
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

        alone, drawn = cut(clean), cut(latents)
        close({k: v[i : i + 1] for k, v in logs.items()}, model.log_joint(alone, drawn))
        close({k: v[i : i + 1] for k, v in guide_logs.items()}, log_guide(model, alone, drawn))


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("pair", ["dkf", "srnn", "hit-dvae", "body parts"])
def test_the_value_of_a_missing_entry_changes_nothing(pair, network):
    model = build(pair, network)
    data = draw(model)
    seen = {name: torch.rand_like(data[name]) < 0.7 for name in model.observed}
    holes = {name: data[name].masked_fill(~seen[name], float("nan")) for name in model.observed}
    zeros = {name: data[name].masked_fill(~seen[name], 0.0) for name in model.observed}
    latents = {name: value.detach() for name, value in model.guide({**holes, "mask": seen}).items()}
    missing = {**holes, "mask": seen}
    close(log_guide(model, missing, latents), log_guide(model, zeros, latents))
    others = {name: data[name].masked_fill(~seen[name], 17.0) for name in model.observed}
    close(model.log_joint(missing, latents), model.log_joint({**others, "mask": seen}, latents))
    everything = {name: torch.ones_like(mask) for name, mask in seen.items()}
    close(model.log_joint({**data, "mask": everything}, latents), model.log_joint(data, latents))
    nothing = {name: torch.zeros_like(mask) for name, mask in seen.items()}
    assert all((model.log_joint({**data, "mask": nothing}, latents)[name] == 0).all() for name in model.observed)


def test_the_likelihood_is_that_of_the_observed_entries():
    model = build("dkf", laws={"p(x)": distributions.FixedNormal(scale=1.0)})
    x, seen = draw(model)["x"], torch.rand(B, T, 3) < 0.5
    z = torch.randn(B, T, 2, dtype=torch.float64)
    mean = model.generator["x"]({"z": z}, B, T)[0]
    expected = torch.where(seen, torch.distributions.Normal(mean, 1.0).log_prob(x), 0.0).sum((1, 2))
    torch.testing.assert_close(model.log_joint({"x": x, "mask": seen}, {"z": z})["x"], expected.detach())


# --------------------------------------------------------------------------------------------------- forecasts


def means(model, values):
    """The means of all data variables at every step, teacher-forced."""
    return {
        n: model.generator[n](values, next(iter(values.values())).shape[0], values["x"].shape[1])[0]
        for n in model.observed
    }


@pytest.mark.parametrize(
    ("pair", "network", "chunk"),  # chunks are less than the sequences, or more than all there is
    [
        (pair, network, (2, 2048)[(m + n) % 2])
        for m, pair in enumerate(PAIRS)
        for n, network in enumerate(NETWORKS)
        if pair != "rvae"
    ],
)
def test_a_forecast_continues_the_past_by_the_models_own_means(pair, network, chunk):
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


@pytest.mark.parametrize("pair", ["srnn", "hit-dvae", "backward guide", "dkf"])
def test_latents_of_the_past_of_a_forecast_are_the_guides(pair):
    model = build(pair)
    x = draw(model)["x"]
    torch.manual_seed(1)
    guided = model.guide(x.repeat(2, 1, 1))
    torch.manual_seed(1)
    out = model.forecast(x, horizon=2, samples=2)
    for name, value in guided.items():
        there = out[name].flatten(0, 1)
        torch.testing.assert_close(there[:, :T] if value.dim() == 3 else there, value.detach())


@pytest.mark.parametrize(
    ("law", "drawn"),
    [
        (distributions.Normal(), True),
        (distributions.FixedNormal(1.0), True),
        (distributions.FixedNormal(1.0, error_weight=True), False),
    ],
)
def test_a_seed_repeats_a_forecast_which_draws_the_emission_but_the_weight_of_an_error(law, drawn):
    model = build("srnn", laws={"p(x)": law})
    x = draw(model)["x"]

    def run(seed, **options):
        pyro.set_rng_seed(seed)
        return model.forecast(x, 3, 4, **options)["x"]

    assert torch.equal(run(1), run(1))
    assert not torch.equal(run(1), run(2))
    assert torch.equal(run(1), run(1, draw_emission=drawn))
    assert not torch.equal(run(1), run(1, draw_emission=not drawn))


def test_forecasts_cover_the_future_as_often_as_their_levels_say():
    model = DynamicalVAE("p(w) p(x_t | w)", None, {"w": 1, "x": 1}, Linear(), distributions.FixedNormal(1.0))
    truth = model.sample(400, length=2)["x"]
    futures = model.forecast({"x": truth[:, :1]}, 1, 199)["x"]
    low, high = futures.quantile(0.05, 0), futures.quantile(0.95, 0)
    assert abs(((low < truth[:, 1:]) & (truth[:, 1:] < high)).double().mean() - 0.9) < 0.06


class Bits(distributions.Law):
    """A law of binary data, as one writes it."""

    def __init__(self, features, size):
        super().__init__()
        self.out = torch.nn.Linear(features, size)

    def forward(self, features, previous=None, t=None):
        return (self.out(features).sigmoid(),)

    def distribution(self, parameters):
        return dist.Bernoulli(parameters[0])

    def noise(self, shape, like):
        return torch.rand(*shape, dtype=like.dtype)

    def draw(self, parameters, noise):
        return (noise < parameters[0]).to(noise)


class BitsSpec:
    def build(self, shape):
        return Bits(shape.features, shape.size)


@pytest.mark.parametrize("pair", ["srnn", "dkf", "rvae"])  # x in a loop, and at once
def test_a_forecast_draws_discrete_data_unless_their_means_are_asked_for(pair):
    model = build(pair, laws={"p(x)": BitsSpec()})
    x = (torch.rand(B, T, 3, dtype=torch.float64) < 0.5).double()
    forecast = partial(model.forecast, x, 4, 6)
    assert forecast()["x"].unique().tolist() == [0, 1]
    assert forecast(draw_emission=True)["x"].unique().tolist() == [0, 1]
    shares = forecast(draw_emission=False)["x"]
    assert ((shares > 0) & (shares < 1)).all()


def test_discrete_and_other_data_are_forecast_side_by_side():
    model = build("body parts", laws={"p(y)": BitsSpec()})
    data = draw(model)
    data["y"] = (data["y"] > 0).double()
    out = model.forecast(data, 3, 4)
    assert out["y"].unique().tolist() == [0, 1]
    assert len(out["x"].unique()) == out["x"].numel()


def test_a_batch_without_the_context_that_a_factor_reads_is_refused():
    model = build("context")
    data = draw(model)
    for name, shape in (("c", r"c \(B, T, 1\)"), ("pose", r"pose \(B, 2\)")):
        rest = {n: value for n, value in data.items() if n != name}
        for run in (model.guide, model.model, partial(model.forecast, horizon=1), model.reconstruct):
            with pytest.raises(ValueError, match=rf"\) reads {shape}, context that the batch has to give; it holds x"):
                run(rest)


def test_a_drawn_forecast_has_the_density_of_the_model():
    model = build("srnn")
    x = draw(model)["x"]
    out = model.forecast(x, 3, 1, draw_emission=True)
    whole, z = torch.cat([x, out["x"][0]], 1), out["z"][0]
    z_score = (whole - (m := means(model, {"x": whole, "z": z})["x"])) / model.generator["x"](
        {"x": whole, "z": z}, B, T + 3
    )[1]
    assert m.shape == whole.shape
    assert z_score[:, T:].abs().max() < 6


def test_reconstruction_is_the_mean_given_the_guides_latents():
    model = build("hit-dvae")
    x = draw(model)["x"]
    torch.manual_seed(3)
    latents = model.guide(x.repeat(2, 1, 1))
    torch.manual_seed(3)
    out = model.reconstruct(x, samples=2)
    expected = means(model, {**latents, "x": x.repeat(2, 1, 1)})["x"].detach()
    torch.testing.assert_close(out["x"].flatten(0, 1), expected)
    holes = {"x": x.clone().fill_(float("nan")), "mask": torch.zeros_like(x, dtype=torch.bool)}
    assert torch.isfinite(model.reconstruct(holes)["x"]).all()


@given(size=st.integers(1, 7), samples=st.integers(1, 7), chunk=st.integers(1, 50))
def test_chunks_make_every_sample_of_every_sequence_once_and_no_more_at_once(size, samples, chunk):
    made = itertools.count()

    def make(part, count):
        sequences = torch.arange(size)[part].expand(count, -1)
        assert 1 <= sequences.numel() <= chunk
        calls = torch.tensor([next(made) for _ in range(count)])[:, None].expand_as(sequences)
        return {"sequence": sequences, "draw": torch.stack([calls, -calls], -1)}

    found = in_chunks(make, size, samples, chunk)
    assert torch.equal(found["sequence"], torch.arange(size).expand(samples, -1))
    assert torch.equal(found["draw"][..., 0], -found["draw"][..., 1])
    assert all(len(set(draws.tolist())) == samples for draws in found["draw"][..., 0].T)


@pytest.mark.parametrize("what", ["forecast", "reconstruct"])
@pytest.mark.parametrize("pair", PAIRS)
def test_a_chunk_is_a_run_of_its_own(pair, what):
    """Of these sequences and samples alone, with the draws that come next: so chunks have the law of the whole."""
    model, past = build(pair), 3
    data = draw(model)
    mask = {n: torch.rand_like(data[n]) < 0.8 for n in model.observed}
    fix = {n: torch.randn(B, model.sizes[n]) for n in model.latents if not model.generative.local(n)}

    def run(part, samples, **options):
        some = rows(data, part)
        if what == "reconstruct":
            return model.reconstruct({**some, "mask": rows(mask, part)}, samples, **options)
        some |= {n: some[n][:, :past] for n in model.observed}
        return model.forecast(some, T - past, samples, fix=rows(fix, part), draw_emission=True, **options)

    torch.manual_seed(0)
    whole = run(slice(None), 2, chunk=2)
    torch.manual_seed(0)
    first, again, last = run(slice(2), 1), run(slice(2), 1), run(slice(2, None), 2)
    for name, value in whole.items():
        torch.testing.assert_close(value, torch.cat([torch.cat([first[name], again[name]]), last[name]], 1))


@pytest.mark.parametrize("pair", PAIRS)
def test_sampling_draws_every_variable_and_leaves_the_training_mode(pair):
    model = build(pair).train()
    context = {name: value for name, value in draw(model).items() if name in model.context}
    out = model.sample(B, T, context or None)
    assert {name: value.shape[0] for name, value in out.items()} == dict.fromkeys(out, B)
    assert not any(value.requires_grad for value in out.values())
    assert model.training


# ------------------------------------------------------------------------------------------------ self-feeding


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("pair", ["storn", "srnn", "hit-dvae", "body parts", "context"])
@pytest.mark.parametrize("residual", [False, True])
def test_feeding_on_ones_own_means(pair, network, residual):
    model = build(pair, network, laws={"p(x)": distributions.Normal(residual=residual)})
    data = draw(model)
    latents = {name: value.detach() for name, value in model.guide(data).items()}
    program = poutine.condition(model.model, data=latents)

    def logs(feeding):
        torch.manual_seed(5)
        return log_probs(program, data, self_feeding=feeding)[1]

    close(logs(0.0), model.log_joint(data, latents))
    exact = logs(1.0)
    # By hand: means one step after another, each from the means before it.
    fed = {name: torch.zeros_like(data[name]) for name in model.observed}
    for t in range(T):
        for name in model.observed:
            fed[name][:, t] = means(model, {**data, **latents, **fed})[name][:, t].detach()
    expected = {}
    for name in model.generative.variables:
        conditional = model.generator[name]
        if not model.generative.local(name):
            expected[name] = exact[name]
            continue
        law = conditional.law.distribution(conditional({**data, **latents, **fed}, B, T))
        expected[name] = law.log_prob({**data, **latents}[name]).sum((1, 2)).detach()
    close(exact, expected)
    close(logs(SelfFeeding(1.0, passes=T)), exact)
    some = logs(0.5)
    close(logs(SelfFeeding(0.5, passes=T)), some)
    assert not torch.allclose(some["x"], exact["x"])


@pytest.mark.parametrize("passes", [None, 2])
def test_the_first_frames_may_stay_as_they_are(passes):
    model = build("srnn")
    x = draw(model)["x"]
    trace = poutine.trace(model.model).get_trace(x, self_feeding=SelfFeeding(1.0, passes, start=2))
    history = trace.nodes["x"]["fn"].rollout.history("x")["x"]
    assert torch.equal(history[:, :2], x[:, :2])
    assert (history[:, 2:] != x[:, 2:]).all()


def test_gradients_flow_back_in_time_through_fed_means():
    """The exact loop and T parallel passes have one gradient; without, that of the fed history as data."""
    model = build("srnn").double()
    x = torch.randn(2, T, model.sizes["x"], dtype=torch.float64)

    def gradients(feeding):
        torch.manual_seed(0)
        loss = SequenceELBO().differentiable_loss(model, model.guide, x, self_feeding=feeding)
        return torch.autograd.grad(loss, list(model.generator.parameters()), allow_unused=True)

    loop, passes = (gradients(SelfFeeding(1.0, passes)) for passes in (None, T))
    detached = gradients(SelfFeeding(1.0, gradient=False))
    torch.testing.assert_close(loop, passes, rtol=1e-9, atol=1e-9)
    assert any(not torch.allclose(a, b) for a, b in zip(loop, detached, strict=True) if a is not None)


@pytest.mark.parametrize("pair", ["srnn", ("p(w) p(x_t | x_{<t}, w)", "q(w | x_{1:T})")], ids=["local", "static"])
def test_a_loop_on_own_means_is_what_the_data_are_scored_by(pair, monkeypatch):
    """Their network runs through time once, and not a second time over what that made."""
    model = build(pair)
    x = draw(model)["x"]
    expected = SequenceELBO().terms(model, x, self_feeding=SelfFeeding(1.0, passes=T)).log_likelihood["x"].shape
    monkeypatch.setattr(model.generator["x"].network, "forward", None)
    assert SequenceELBO().terms(model, x, self_feeding=1.0).log_likelihood["x"].shape == expected


def test_guide_and_model_read_a_batch_once(monkeypatch):
    model, read, seen = build("srnn"), Reader.read, []
    x = draw(model)["x"]
    monkeypatch.setattr(Reader, "read", lambda self, batch, *rest: seen.append(batch is x) or read(self, batch, *rest))
    SequenceELBO().terms(model, x)
    assert sum(seen) == 1


@pytest.mark.parametrize(
    "feeding", [SelfFeeding(p, passes, gradient=False) for p, passes in ((0.5, None), (0.5, 2), (1.0, None))]
)
def test_self_feeding_passes_no_gradient_where_none_is_asked_for(feeding):
    model = build("srnn")
    data = draw(model)
    values = {**data, **model.guide(data)}  # the fed means depend on these draws, and so on the guide's parameters
    trace = poutine.trace(poutine.condition(model.model, data=values)).get_trace(data, self_feeding=feeding)
    history = trace.nodes["x"]["fn"].rollout.history("x")
    assert history.keys() == {"x"}
    assert not torch.equal(history["x"], data["x"])
    assert not history["x"].requires_grad

    as_data = {**values, "x": history["x"].clone()}
    expected = torch.tensor(0.0, dtype=torch.float64)
    for name in model.generative.variables:
        conditional = model.generator[name]
        law = conditional.law.distribution(conditional(as_data, B, T))
        expected = expected + law.log_prob(values[name]).sum()
    parameters = list(model.parameters())
    both = trace.log_prob_sum(), expected
    got, wanted = (torch.autograd.grad(log_joint, parameters, retain_graph=True) for log_joint in both)
    torch.testing.assert_close(got, wanted, rtol=0, atol=1e-9)


# ------------------------------------------------------------------------------------------ parameters of one's own


def test_two_models_do_not_share_parameters():
    first, second = build("dkf"), build("dkf")
    data = draw(first)
    for model in (first, second):
        Trace_ELBO()(model, model.guide)(data).backward()
    assert not {id(p) for p in first.parameters()} & {id(p) for p in second.parameters()}
    assert not torch.equal(first.generator["z"].law.out.weight, second.generator["z"].law.out.weight)
    assert not len(pyro.get_param_store())


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("pair", PAIRS)
def test_loaded_weights_give_the_same_seeded_samples(pair, network, tmp_path):
    model, other = build(pair, network), build(pair, network)
    torch.save(model.state_dict(), tmp_path / "weights.pt")
    other.load_state_dict(torch.load(tmp_path / "weights.pt", weights_only=True))
    data = draw(model)
    context = {name: data[name] for name in model.context} or None
    for run in (lambda m: m.sample(B, T, context), lambda m: m.guide(data)):
        torch.manual_seed(2)
        expected = run(model)
        torch.manual_seed(2)
        for name, value in run(other).items():
            assert torch.equal(value, expected[name])


def test_a_copied_model_runs_on_its_own():
    model = build("hit-dvae", "attention")
    other = copy.deepcopy(model)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.zero_()
    assert other.sample(2, T)["x"].std() > 0


def test_networks_and_laws_are_chosen_by_factor():
    model = build(
        "dkf",
        {"p": Dense((3,)), "q(z)": Attention(8, heads=2), "default": Recurrent(4)},
        laws={"p(x)": distributions.StudentT(), "q": distributions.FixedNormal(scale=0.5)},
    )
    assert type(model.generator["z"].network).__name__ == "DenseNetwork"
    assert type(model.encoder["z"].network).__name__ == "AttentionNetwork"
    assert type(model.generator["x"].law).__name__ == "StudentTLaw"
    assert type(model.generator["z"].law).__name__ == "NormalLaw"
    assert type(model.encoder["z"].law).__name__ == "FixedNormalLaw"


def test_a_guides_factor_without_parents_has_a_law_of_its_own():
    model = build(("p(w) p(x_t | w)", "q(w)"), laws={"q": distributions.FixedNormal(scale=0.25)})
    values = model.encoder["w"]({}, B, T)
    assert torch.allclose(values[1], torch.tensor(0.25, dtype=torch.float64))
    Trace_ELBO()(model, model.guide)(draw(model)).backward()
    assert all(p.grad is not None for p in model.encoder.parameters())


def test_a_mask_of_ones_own_stands_where_a_relation_does():
    model = build(
        ("p(z_t | z_{odd}) p(x_t | z_t)", "q(z_t | x_{1:T})"),
        "attention",
        masks={
            "odd": lambda length: (
                torch.ones(length, length).tril(-1).bool().numpy() & (torch.arange(length) % 2 == 1).numpy()
            )
        },
    )
    free, logs = log_probs(model.model, length=T, size=2)
    close(logs, model.log_joint({"x": free["x"]}, {"z": free["z"]}))
    close(logs, per_step(model, {"x": free["x"]}, {"z": free["z"]}))


# ------------------------------------------------------------------------------------------------------ errors

X = torch.zeros(B, T, 3, dtype=torch.float64)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sizes": {"z": 2}}, "sizes missing for x; needed are z, x"),
        ({"sizes": {"z": 2, "x": 3, "y": 1}}, "sizes given for y; the equations have z, x"),
        ({"sizes": {"z": 0, "x": 3}}, "the size of z is 0; it must be at least 1"),
        ({"sizes": {"z": 10**9, "x": 3}}, "the size of z is 1000000000; it must be at least 1 and at most 1048576"),
        ({"sizes": {"z": "2", "x": 3}}, "the size of z is '2'; it must be a whole number"),
        ({"sizes": {"z": 2, "x": 3.0}}, "the size of x is 3.0; it must be a whole number"),
        ({"sizes": {"z": 2, "x": None}}, "the size of x is None; it must be a whole number"),
        ({"sizes": 3}, "sizes is 3; expected the size of every variable by name"),
        ({"network": Dense}, "the network of 'default' is the class Dense; expected a description such as Recurrent"),
        ({"network": {"p(z)": Dense}}, r"the network of 'p\(z\)' is the class Dense; expected a description"),
        (
            {"laws": distributions.StudentT},
            "the law of 'default' is the class StudentT; expected a description such as Normal",
        ),
        ({"view": views.View}, r"the view is the class View; expected an instance such as dvae.data.views.View\(\)"),
        (
            {"network": {"p(y)": Dense()}},
            r"no factor 'p\(y\)'; keys are p\(x\), p\(z\), q\(z\), 'p', 'q' and 'default'",
        ),
        ({"laws": {"p(y)": distributions.Normal()}}, r"no factor 'p\(y\)'"),
        ({"network": "gru"}, "the network of 'default' is 'gru'; expected a description such as Recurrent"),
        (
            {"laws": {"p(x)": torch.nn.Linear(2, 2)}},
            r"the law of 'p\(x\)' is Linear.*; expected a description such as Normal",
        ),
        (
            {"laws": {"p(z)": distributions.Mixture()}},
            r"static latents .* but z has parents and has a value at every step",
        ),
        (
            {"inference": "q(z_t | x_t) q(y_t | x_t)"},
            r"q\(y_t \| x_t\): no latent y in .*; remove this factor, or add p\(y_t \| \.\.\.\) to the generative",
        ),
        ({"inference": "q(u_t | x_t)"}, r"q\(u_t \| x_t\): no latent u in .*; remove this factor"),
    ],
)
def test_models_that_cannot_be(change, message):
    base = {"generative": PAIRS["dkf"][0], "inference": PAIRS["dkf"][1], "sizes": {"z": 2, "x": 3}}
    with pytest.raises((TypeError, ValueError), match=message):
        DynamicalVAE(**{**base, **change})


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (lambda m: m.model(X[..., :2]), r"x has shape \(3, 5, 2\), expected \(B, T, 3\)"),
        (lambda m: m.model(X[0]), r"x has shape \(5, 3\), expected \(B, T, 3\)"),
        (lambda m: m.model(X[:, :0]), r"x has no steps: shape \(3, 0, 3\)"),
        (lambda m: m.model({"x": X, "label": X}), "the batch holds label; expected some of z, x, 'lengths', 'mask'"),
        (
            lambda m: m.model({"x": X, "z": X[:2, :, :2]}),
            r"different numbers of sequences: x \(3, 5, 3\), z \(2, 5, 2\)",
        ),
        (lambda m: m.model(), "neither a batch nor length= tells how many steps to run; pass length="),
        (lambda m: m.model(length=0), "length is at least 1, got 0"),
        (lambda m: m.model(X, length=4), r"expected 4 steps .* the batch holds x \(3, 5, 3\)"),
        (
            lambda m: m.model({"x": X[:, :4], "z": X[..., :2]}),
            r"different numbers of steps: x \(3, 4, 3\), z",
        ),
        (
            lambda m: m.model({"x": X, "mask": X}),
            r"the mask of x is torch.float64 \(3, 5, 3\); expected bool \(3, 5, 3\)",
        ),
        (lambda m: m.model({"x": X, "mask": X[:, 0] == 0}), r"the mask of x is torch.bool \(3, 3\); expected bool"),
        (lambda m: m.model({"x": X, "mask": {"y": X == 0}}), "a mask of y, but the batch holds no data of that name"),
        (
            lambda m: m.model({"x": X, "lengths": torch.tensor([5, 6, 1])}),
            r"lengths must be \(B,\) whole numbers between 1 and 5",
        ),
        (lambda m: m.model({"x": X, "lengths": torch.tensor([5, 0, 1])}), "lengths must be"),
        (lambda m: m.model({"x": X, "lengths": torch.tensor([5, 1])}), "lengths must be"),
        (lambda m: m.model(X / 0), "x holds values that are not finite; where entries are missing, set 'mask' False"),
        (lambda m: m.guide(None), "neither a batch nor length="),
        (lambda m: m.guide({"z": X[..., :2]}), "the guide reads x, the batch holds z"),
        (
            lambda m: m.forecast({"x": X, "lengths": torch.tensor([5, 5, 5])}, 2),
            "forecast continues sequences of one length",
        ),
        (lambda m: m.forecast(X, "3"), "horizon is '3'; it must be a whole number"),
        (lambda m: m.forecast(X, 0), "horizon is 0; it must be at least 1"),
        (lambda m: m.forecast(X, 1, 0), "samples is 0; it must be at least 1"),
    ],
)
def test_batches_and_calls_that_cannot_be(run, message):
    with pytest.raises((TypeError, ValueError), match=message):
        run(build("dkf"))


def test_errors_of_special_models():
    with pytest.raises(ValueError, match="a batch of x, y is a mapping of these names, not one tensor"):
        build("body parts").model(X)
    context = build("context")
    data = draw(context)
    with pytest.raises(ValueError, match=r"expected 7 steps .* the batch holds x \(3, 5, 3\), c \(3, 5, 1\)"):
        context.forecast(data, 2)
    with pytest.raises(ValueError, match="different numbers of steps"):
        context.model({**data, "x": data["x"][:, :4]})


def test_a_sequence_refuses_vectorised_particles():
    trace = poutine.trace(build("dkf").model).get_trace(X)
    law = trace.nodes["z"]["fn"]
    assert (law.batch_shape, law.event_shape) == ((B,), (T, 2))
    with pytest.raises(NotImplementedError, match=r"draws one batch at a time.*repeat the batch"):
        law.sample(torch.Size([2]))
    with pytest.raises(NotImplementedError, match=r"cannot be expanded to .*repeating the batch"):
        law.expand((2, B))
