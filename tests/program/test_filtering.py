"""Online filtering: exact where the model is linear-Gaussian or discrete, and the same numbers however steps arrive."""

import re
from copy import deepcopy

import pytest
import torch
from scipy import stats

import dvae
from dvae import Discrete, DynamicalVAE, Oracle, SequenceELBO, fivo_bound, linear_gaussian_surrogate
from dvae.data.series_units import SeriesPrior, SeriesUnits
from dvae.data.views import Parts, View
from dvae.distributions import Delta, Family, FixedNormal, Product, StudentT
from dvae.distributions.family import FAMILIES, NormalMixture
from dvae.factorization.notation import Factorization
from dvae.networks import Attention, Dense, Linear, Recurrent

T = 6
DOUBLE = torch.float64


def build(pair, sizes, network=None, distributions=None, **options):
    network = network or Recurrent(4, hidden=(5,))
    return DynamicalVAE(*pair, sizes, network, distributions, **options).double().eval()


def steps(batch, part):
    """Return some steps of a batch, in which only x and its mask have steps."""
    if not isinstance(batch, dict):
        return batch[:, part]
    return {name: value[:, part] if value.dim() == 3 else value for name, value in batch.items()}


def masked(x, share=0.3):
    return {"x": x, "mask": torch.rand(x.shape) > share}


def test_a_long_fixed_lag_evaluates_no_more_steps(monkeypatch):
    pair = "p(z_t | z_{t-2:t-1}) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-2:t-1}, x_t)"
    model = build(pair, {"z": 2, "x": 2}, Attention(4, heads=1))
    x, lengths = torch.randn(2, 12, 2, dtype=DOUBLE), list[int]()
    for part in (*model.generator.values(), *model.encoder.values()):

        def counting(parents, length, *rest, forward=part.network.forward):
            lengths.append(length)
            return forward(parents, length, *rest)

        monkeypatch.setattr(part.network, "forward", counting)
    short, long = (model.filter(x, 8, seed=0, lag=lag).filtered for lag in (1, 9))
    assert max(lengths) == 3
    torch.testing.assert_close(short.log_evidence, long.log_evidence, rtol=0, atol=1e-12)


# ------------------------------------------------------------------------------------------------------ exact filters

LINEAR = {
    "chain": ("p(z_t | z_{t-1}) p(x_t | z_t)", {"z": 2, "x": 3}),
    "all": ("p(w) p(z_t | z_{<t}, w) p(x_t | x_{<t}, z_{<=t}, w)", {"w": 2, "z": 1, "x": 2}),
    "two layers": (
        "p(w) p(v | w) p(u_t | u_{t-1}, w) p(z_t | z_{<t}, u_t, v) p(x_t | x_{t-1}, z_t)",
        {"w": 1, "v": 2, "u": 1, "z": 2, "x": 2},
    ),
}


def oracle_moments(model, batch, t, batch_size):
    """Return mean and variance (B, T, D) of each latent given a batch of t steps."""
    mean, covariance = Oracle(model, t).posterior(batch)
    variance = covariance.expand(batch_size, -1, -1).diagonal(dim1=1, dim2=2)
    sizes = [model.sizes[n] * (t if model.generative.local(n) else 1) for n in model.latents]
    moments = {}
    for name, *parts in zip(model.latents, mean.split(sizes, 1), variance.split(sizes, 1), strict=True):
        moments[name] = [part.unflatten(1, (-1, model.sizes[name])) for part in parts]
    return moments


@torch.no_grad()
@pytest.mark.parametrize("has_mask", [False, True])
@pytest.mark.parametrize("name", LINEAR)
def test_a_linear_gaussian_model_has_the_filter_of_the_oracle(name, has_mask):
    text, sizes = LINEAR[name]
    model = linear_gaussian_surrogate(text, None, sizes, T)
    x = torch.randn(4, T, sizes["x"], dtype=DOUBLE)
    batch = masked(x) if has_mask else x
    filtered = model.filter(batch, lag=2).filtered
    assert set(filtered.proposal.values()) == {"exact"}
    for t in range(1, T + 1):
        evidence = Oracle(model, t).evidence(steps(batch, slice(t)))
        torch.testing.assert_close(filtered.log_evidence[:, :t].sum(1), evidence, rtol=0, atol=1e-8)
        for latent, moments in oracle_moments(model, steps(batch, slice(t)), t, 4).items():
            for kind, expected in zip(("mean", "variance"), moments, strict=True):
                at = getattr(filtered, kind)[latent][:, t - 1]
                torch.testing.assert_close(at, expected[:, -1], rtol=0, atol=1e-8)
                lagged = getattr(filtered, f"lagged_{kind}")[latent][:, t - 1]
                if model.generative.local(latent) and t > 2:
                    torch.testing.assert_close(lagged, expected[:, -3], rtol=0, atol=1e-8)
                else:
                    assert lagged.isnan().all() == (t <= 2)


def test_the_exact_prediction_is_the_conditional_normal():
    model = linear_gaussian_surrogate(*LINEAR["chain"][:1], None, LINEAR["chain"][1], T)
    x = torch.randn(2, T, 3, dtype=DOUBLE)
    filtered = model.filter(x).filtered
    predicted = stats.norm(filtered.predicted_mean["x"], filtered.predicted_variance["x"].sqrt())
    torch.testing.assert_close(filtered.pit["x"].numpy(), predicted.cdf(x))
    # the last coordinate given nothing but the past: its evidence, with all other entries of the step missing
    mask = torch.ones_like(x, dtype=torch.bool)
    mask[:, -1, :2] = False
    last = model.filter({"x": x, "mask": mask}).filtered.log_evidence[:, -1]
    torch.testing.assert_close(last.numpy(), predicted.logpdf(x)[:, -1, 2])


@torch.no_grad()
def test_particles_agree_with_the_exact_filter_within_monte_carlo_error():
    text, sizes = LINEAR["all"]
    for inference in (None, "q(w | x_{1:T}) q(z_t | z_{<t}, x_{<=t}, w)"):
        model = linear_gaussian_surrogate(text, inference, sizes, T, scale=0.2)
        x = model.sample(2, T)["x"]
        exact = model.filter(x).filtered
        runs = [model.filter(x, 500, seed=seed).filtered for seed in range(40)]
        assert runs[0].proposal == {"w": "prior", "z": "prior" if inference is None else "guide"}
        for get in (
            lambda f: f.mean["z"],
            lambda f: f.predicted_mean["x"],
            lambda f: f.pit["x"],
            lambda f: f.mean["w"],
        ):
            draws = torch.stack([get(run) for run in runs])
            error = (draws.mean(0) - get(exact)).abs()
            assert (error < 5 * draws.std(0) / len(runs) ** 0.5 + 2e-3).all()  # a ratio has a bias of order 1 / K


DISCRETE = {
    "hmm": ("p(k_t | k_{t-1}) p(x_t | k_t)", {"k": Discrete(3), "x": 2}),
    "second order": ("p(k_t | k_{t-2:t-1}) p(x_t | k_{t-1:t}, x_{t-1})", {"k": Discrete(2), "x": 2}),
    "static": ("p(c) p(k_t | k_{t-1}, c) p(x_t | k_t, x_{<t})", {"c": Discrete(2), "k": Discrete(3), "x": 2}),
    "mixture": ("p(k_t) p(x_t | k_t)", {"k": Discrete(3), "x": 2}),
    "class": ("p(c) p(x_t | c, x_{t-1})", {"c": Discrete(2), "x": 2}),
    "two chains": (
        "p(j_t | j_{t-1}) p(k_t | k_{t-1}, j_t) p(x_t | k_t, j_t)",
        {"j": Discrete(2), "k": Discrete(3), "x": 2},
    ),
}


@torch.no_grad()
@pytest.mark.parametrize("ragged", [False, True])
@pytest.mark.parametrize("name", DISCRETE)
def test_discrete_latents_have_the_filter_of_the_forward_algorithm(name, ragged):
    text, sizes = DISCRETE[name]
    model = build((text, ""), sizes)
    batch = {"x": torch.randn(3, T, 2, dtype=DOUBLE)} | ({"lengths": torch.tensor([T, 4, T])} if ragged else {})
    filtered = model.filter(batch, lag=2).filtered
    bound = SequenceELBO().terms(model, batch).bound
    torch.testing.assert_close(filtered.log_evidence.sum(1), bound, rtol=0, atol=1e-8)
    for t in range(1, T + 1):
        for latent, smoothed in model.states(batch["x"][:, :t]).items():
            at_t = smoothed[0] if smoothed.dim() == 3 else smoothed[0, :, -1]
            states = filtered.states[latent][:, t - 1]
            valid = ~states.isnan().any(1)
            assert valid.tolist() == [True, t <= 4 or not ragged, True]
            torch.testing.assert_close(states[valid], at_t[valid], rtol=0, atol=1e-8)
            if t > 2 and smoothed.dim() == 4:
                lagged = filtered.lagged_states[latent][:, t - 1]
                torch.testing.assert_close(lagged[valid], smoothed[0, valid, -3], rtol=0, atol=1e-8)


@torch.no_grad()
@pytest.mark.parametrize("inference", ["q(z_t | z_{t-1}, x_t)", "q(z_t | z_{t-1}, x_{t:T})"])
def test_the_evidence_of_a_switching_model_is_unbiased(inference):
    text = "p(k_t | k_{t-1}) p(z_t | z_{t-1}, k_t) p(x_t | z_t, k_t)"
    model = linear_gaussian_surrogate(text, inference, {"k": Discrete(2), "z": 1, "x": 1}, 4)
    x = model.sample(200, 4)["x"].mean(0, keepdim=True)
    evidence = Oracle(model, 4).evidence(x)
    n = 2000
    stream = model.filter(x.repeat(n, 1, 1), 6, resample_below=1.0, seed=0)
    assert stream.proposal == {"z": "guide" if "x_t)" in inference else "prior", "k": "exact"}
    ratio = (stream.filtered.log_evidence.sum(1) - evidence).exp()
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / n**0.5 < 0.2
    mean, covariance = Oracle(model, 4).posterior(x)
    filtered = model.filter(x, 20_000, seed=0).filtered
    assert abs(filtered.mean["z"][0, -1, 0] - mean[0, -1]) < 0.04
    assert abs(filtered.variance["z"][0, -1, 0] - covariance[0, -1, -1]) < 0.04


# ------------------------------------------------------------------------------------------- the FIVO bound and steps

PAIRS = {
    "dkf": ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})"),
    "vrnn": ("p(z_t | x_{<t}, z_{<t}) p(x_t | x_{<t}, z_{<=t})", "q(z_t | x_{<=t}, z_{<t})"),
    "static": ("p(w) p(z_t | z_{<t}) p(x_t | z_t, w)", "q(w | x_{1:T}) q(z_t | x_t, w)"),
    "two layers": (
        "p(w) p(u_t | u_{t-1}, w) p(z_t | z_{t-1}, u_t) p(x_t | x_{<t}, z_t)",
        "q(w | x_{1:T}) q(u_t | u_{t-1}, z_{t-1}, x_t, w) q(z_t | z_{t-1}, u_t, x_{<=t}, w)",
    ),
    "context": ("p(z_t | z_{t-1}, c_t, b) p(x_t | x_{t-1}, z_t, c_{t-1})", "q(z_t | z_{t-1}, x_t, c_t)"),
    "switching": ("p(k_t | k_{t-1}) p(z_t | z_{t-1}, k_t) p(x_t | z_t, k_t)", "q(z_t | z_{t-1}, x_t)"),
    "switching ar": ("p(k_t | k_{t-1}) p(x_t | x_{t-1}, k_t)", ""),
    "static last": ("p(w) p(z_t | z_{t-1}, w) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t) q(w | z_{1:T})"),
    "static data": ("p(w) p(y | w) p(z_t | z_{t-1}, w) p(x_t | z_t, y)", "q(w | y) q(z_t | z_{t-1}, x_t, w)"),
    "autoregressive": ("p(x_t | x_{<t})", ""),
}
SIZES = {"w": 2, "u": 1, "z": 2, "x": 3, "c": 2, "b": 1, "k": Discrete(2), "y": 2}
SIZES_2 = {"z": 2, "x": 3}


def pair_model(name, network=None, **options):
    parsed = Factorization.parse(PAIRS[name][0])
    sizes = {each: SIZES[each] for each in (*parsed.variables, *parsed.context)}
    observed = tuple(each for each in "xy" if each in sizes)
    return build(PAIRS[name], sizes, network, observed=observed, **options)


def pair_batch(name, batch=3, length=T):
    x = torch.randn(batch, length, 3, dtype=DOUBLE)
    if name == "context":
        return {"x": x, "c": torch.randn(batch, length, 2, dtype=DOUBLE), "b": torch.randn(batch, 1, dtype=DOUBLE)}
    return {"x": x} | ({"y": torch.randn(batch, 2, dtype=DOUBLE)} if name == "static data" else {})


@torch.no_grad()
@pytest.mark.parametrize("extra", ["complete", "mask", "lengths", "indicators", "units", "static data"])
def test_log_evidences_sum_to_the_fivo_bound_if_the_guide_proposes(extra):
    name = extra if extra in PAIRS else "vrnn"
    model = pair_model(name, indicators=("x",) if extra == "indicators" else ())
    if extra == "units":
        for name in "zx":
            model.standardise(name).double().fit(2 + 3 * torch.randn(9, SIZES[name], dtype=DOUBLE))
    batch = pair_batch(name)
    batch |= masked(batch["x"]) if extra in ("mask", "indicators") else {}
    batch |= {"lengths": torch.tensor([T, 1, 3])} if extra == "lengths" else {}
    stream = model.filter(batch, 8, seed=5, resample_below=0.8)
    assert set(stream.proposal.values()) == {"guide"}
    torch.manual_seed(5)
    expected = fivo_bound(model, batch, 8, resample_below=0.8)
    filtered = stream.filtered
    torch.testing.assert_close(filtered.log_evidence.sum(1), expected.bound, rtol=0, atol=1e-9)
    torch.testing.assert_close(filtered.effective.t(), expected.effective, rtol=0, atol=1e-9, equal_nan=True)
    assert torch.equal(filtered.resampled.sum(1), expected.resamplings)


@torch.no_grad()
@pytest.mark.parametrize("network", ["recurrent", "extract", "dense"])
@pytest.mark.parametrize("name", PAIRS)
def test_steps_one_by_one_resumed_and_predicted_give_the_same_numbers(name, network, tmp_path):
    if network == "dense":  # which reads single steps
        if "w" in PAIRS[name][0]:
            pytest.skip("a static latent of Dense cannot read a sequence")
        texts = PAIRS[name]
        for old, new in {"{<t}": "{t-2:t-1}", "{<=t}": "{t-1:t}", "{t:T}": "t"}.items():
            texts = [text.replace(old, new) for text in texts]
        sizes = pair_model(name).sizes
        model = build(texts, sizes, Dense((4,)))
    else:
        extract = {"x": (4,), "z": (3,)} if network == "extract" else {}
        model = pair_model(name, Recurrent(3, extract=extract))
    batch = pair_batch(name)
    if "switching" not in name:
        batch |= {"mask": torch.rand(3, T, 3) > 0.2}
    whole = model.filter(batch, 8, seed=2, lag=2, resample_below=0.9)
    stream = model.filter(steps(batch, slice(2)), 8, seed=2, lag=2, resample_below=0.9)
    results = [stream.filtered]
    for part in (2, 3, slice(4, T)):
        torch.rand(3)  # other draws do not matter
        context = {n: batch[n][:, 2] for n in ("c",) if n in batch}
        stream.predict(context).sample(2)
        results.append(stream.update(steps({n: v for n, v in batch.items() if n not in "by"}, part)))
        stream.save(tmp_path / "state.safetensors")
        stream = model.filter(resume=tmp_path / "state.safetensors")
    for field in ("log_evidence", "effective", "resampled", "log_weights"):
        expected = getattr(whole.filtered, field)
        if expected is not None:
            joined = torch.cat([getattr(result, field) for result in results], -1)
            torch.testing.assert_close(joined, expected, rtol=0, atol=1e-12)
    for field in ("mean", "variance", "pit", "predicted_mean", "lagged_mean", "states", "lagged_states"):
        for key, expected in getattr(whole.filtered, field).items():
            joined = torch.cat([getattr(r, field)[key] for r in results], 1)
            torch.testing.assert_close(joined, expected, rtol=0, atol=1e-12, equal_nan=True)


@torch.no_grad()
def test_a_stream_of_an_exact_filter_continues_and_resumes(tmp_path):
    model = build(
        ("p(w) p(z_t | z_{t-1}, w, c_t) p(x_t | z_{t-1:t}, x_{t-1})", None),
        {"w": 1, "z": 2, "x": 2, "c": 1},
        Dense(()),
        FixedNormal(0.5),
    )
    batch = {**masked(torch.randn(3, T, 2, dtype=DOUBLE)), "c": torch.randn(3, T, 1, dtype=DOUBLE)}
    whole = model.filter(batch, lag=3)
    stream = model.filter(steps(batch, slice(1)), lag=3)
    parts = [stream.filtered]
    for t in range(1, T):
        predicted = stream.predict({"c": batch["c"][:, t]})
        parts.append(stream.update(steps(batch, t)))
        torch.testing.assert_close(predicted.mean["x"][:, None], parts[-1].predicted_mean["x"])
        stream.save(tmp_path / "state")
        stream = model.filter(resume=tmp_path / "state")
    assert stream.proposal == {"w": "exact", "z": "exact"}
    for name in ("mean", "lagged_variance"):
        joined = torch.cat([getattr(part, name)["z"] for part in parts], 1)
        torch.testing.assert_close(joined, getattr(whole.filtered, name)["z"], rtol=0, atol=1e-12, equal_nan=True)
    # particles of the same model agree
    draws = model.filter(batch, 20_000, seed=0).filtered
    torch.testing.assert_close(draws.mean["z"], whole.filtered.mean["z"], rtol=0, atol=0.05)


@torch.no_grad()
def test_the_oracle_and_a_stream_of_affine_dense_networks_agree():
    text, sizes = "p(w) p(z_t | z_{t-1}, w) p(x_t | z_t, x_{t-1}) p(y_t | z_t)", {"w": 1, "z": 2, "x": 2, "y": 1}
    model = build((text, None), sizes, Dense(()), FixedNormal(0.5), observed=("x", "y"))
    batch = {"x": torch.randn(3, T, 2, dtype=DOUBLE), "y": torch.randn(3, T, 1, dtype=DOUBLE)}
    batch["mask"] = {"x": torch.rand(3, T, 2) > 0.3}
    stream = model.filter({"x": batch["x"][:, :1], "y": batch["y"][:, :1], "mask": {"x": batch["mask"]["x"][:, :1]}})
    total = stream.filtered.log_evidence[:, 0]
    for t in range(1, T):
        step = {"x": batch["x"][:, t], "y": batch["y"][:, t], "mask": {"x": batch["mask"]["x"][:, t]}}
        total = total + stream.update(step).log_evidence[:, 0]
    torch.testing.assert_close(total, Oracle(model, T).evidence(batch), rtol=0, atol=1e-9)


# -------------------------------------------------------------------------------------------------------- calibration


def uniformity(pit):
    """Return the p-value of the Kolmogorov-Smirnov test that values are uniform."""
    return stats.kstest(pit.flatten().numpy(), "uniform").pvalue


EMISSIONS = {
    "normal": (FixedNormal(0.7), 2),
    "t": (StudentT(4.0), 2),
    "counts": (Family("Poisson"), 2),
    "overdispersed": (Family("NegativeBinomial", given={"total_count": 4.0}), 2),
    "binary": (Family("Bernoulli"), 2),
    "classes": (Family("OneHotCategorical"), 3),
    "positive": (Family("Gamma"), 2),
    "share": (Family("Beta"), 2),
    "hurdle": (FAMILIES["hurdle"], 2),
    "mixture": (NormalMixture(2), 2),
    "low rank": (FAMILIES["correlated"], 2),
    "correlated": (Family("MultivariateNormal"), 2),
    "mixed": (Product((((0,), Family("Poisson")), ((1,), StudentT()))), 2),
}


@torch.no_grad()
@pytest.mark.parametrize("emission", EMISSIONS)
def test_pit_is_uniform_for_data_from_the_model(emission):
    distribution, size = EMISSIONS[emission]
    torch.manual_seed(1)
    model = build(
        ("p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-1}, x_t)"),
        {"z": 1, "x": size},
        Dense((8,)),
        {"default": FixedNormal(0.8), "p(x)": distribution},
    )
    x = model.sample(300, length=5)["x"]
    pit = model.filter(x, 100, seed=0).filtered.pit["x"]
    for column in range(size):
        assert uniformity(pit[..., column]) > 1e-3
        assert uniformity(pit[:, -1, column]) > 1e-3


@torch.no_grad()
@pytest.mark.parametrize("text", ["p(x_t | x_{t-1})", "p(k_t | k_{t-1}) p(x_t | x_{t-1}, k_t)"])
def test_data_that_read_data_of_the_same_step_have_their_marginal_prediction(text):
    sizes = {"x": 1, "y": 1} | ({"k": Discrete(2)} if "k" in text else {})
    torch.manual_seed(0)
    model = build((f"{text} p(y_t | x_t)", ""), sizes, Dense(()), FixedNormal(1.0), observed=("x", "y"))
    with torch.no_grad():
        for parameter in model.generator["y"].network.parameters():
            parameter.fill_(1.0)
        model.generator["y"].head.log_scale.fill_(-3.0)
    draws = model.sample(300, length=5)
    filtered = model.filter(draws, 200, seed=0).filtered
    for name in "xy":
        assert uniformity(filtered.pit[name]) > 1e-3
        error = draws[name] - filtered.predicted_mean[name]
        assert abs((error.square() / filtered.predicted_variance[name]).mean() - 1) < 0.2


@torch.no_grad()
def test_filtered_intervals_cover_the_latents():
    torch.manual_seed(0)
    model = build(PAIRS["vrnn"], {"z": 1, "x": 2}, Recurrent(6), FixedNormal(0.6))
    draws = model.sample(1000, length=4)
    filtered = model.filter(draws["x"], 200, seed=0, lag=1).filtered
    below = (filtered.particles["z"] < draws["z"]).double()
    rank = (below * filtered.log_weights.exp()[..., None]).sum(0)
    for t in range(4):
        assert uniformity(rank[:, t]) > 1e-3
    # E (z - m)^2 / v = 1, also for the lagged moments
    score = (draws["z"][:, :-1] - filtered.lagged_mean["z"][:, 1:]).square() / filtered.lagged_variance["z"][:, 1:]
    assert abs(score.mean() - 1) < 4 * score.mean((1, 2)).std() / 1000**0.5 + 0.02


def test_predictions_have_the_moments_of_their_draws():
    model = pair_model("switching")
    predicted = model.filter(torch.randn(2, T, 3, dtype=DOUBLE), 50, seed=0).predict()
    torch.manual_seed(0)
    draws = predicted.sample(20_000)["x"]
    torch.testing.assert_close(draws.mean(0), predicted.mean["x"], rtol=0, atol=0.05)
    torch.testing.assert_close(draws.var(0), predicted.variance["x"], rtol=0.05, atol=0.02)
    assert predicted.quantile(torch.tensor([0.1, 0.9]))["x"].shape == (2, 2, 3)


# --------------------------------------------------------------------------------------------- streams without an end


def stored(stream, path):
    stream.save(path)
    return path.stat().st_size


@torch.no_grad()
@pytest.mark.parametrize("name", ["vrnn", "switching"])
def test_the_state_does_not_grow(name, tmp_path):
    model = pair_model(name)
    stream = model.filter(torch.randn(1, 10, 3, dtype=DOUBLE), 5, lag=2, seed=0)
    size = stored(stream, tmp_path / "a")
    stream.update(torch.randn(1, 300, 3, dtype=DOUBLE))
    assert abs(stored(stream, tmp_path / "b") - size) < 100  # digits of the number of steps
    stream.update(torch.randn(1, 5, 3, dtype=DOUBLE))
    assert all(len(rows.moves) < 2 for rows in stream.engine.paths.values())


@torch.no_grad()
@pytest.mark.parametrize(
    "name", ["vae", "dkf", "storn", "vrnn", "srnn", "rvae-causal", "dsae", "kvae", "rslds", "autoregressive"]
)
def test_every_method_of_the_family_filters_streams(name, tmp_path):
    x = torch.randn(3, 8, 4)
    batch = masked(x)
    batch["mask"][:, 5] = batch["mask"][0, 2] = False  # frames without any entry
    model = dvae.method(name).build(x).eval()
    whole = model.filter(batch, 16, seed=1).filtered
    stream = model.filter(steps(batch, slice(3)), 16, seed=1)
    stream.save(tmp_path / "state")
    stream = model.filter(resume=tmp_path / "state")
    later = stream.update(steps(batch, slice(3, None)))
    torch.testing.assert_close(later.log_evidence, whole.log_evidence[:, 3:])
    online = name in ("vae", "storn", "vrnn", "kvae")
    if name not in ("vae", "storn", "vrnn"):  # where the guide proposes latents without any data
        assert (later.log_evidence[:, 2] == 0).all()
    assert {later.proposal[name] for name in model.latents} <= {"guide" if online else "prior"}
    assert {later.proposal[name] for name in model.summed} <= {"exact"}
    assert stream.predict().sample(2)["x"].isfinite().all()
    if online or not model.latents:
        torch.manual_seed(1)
        torch.testing.assert_close(whole.log_evidence.sum(1), fivo_bound(model, batch, 16).bound)
    if name == "kvae":  # a frame without entries is integrated out
        assert whole.mean["a"][:, 5].isnan().all()
        assert not whole.mean["a"][:, 6].isnan().any()


@torch.no_grad()
def test_bounded_attention_streams_and_unbounded_attention_does_not():
    x = torch.randn(2, 9, 3, dtype=DOUBLE)
    bounded = build(("p(z_t | z_{t-3:t-1}) p(x_t | z_t)", "q(z_t | x_{t-2:t})"), {"z": 2, "x": 3}, Attention(8, 2))
    stream = bounded.filter(x[:, :5], 8, seed=0)
    later = stream.update(x[:, 5:]).log_evidence
    torch.manual_seed(0)
    bound = fivo_bound(bounded, x, 8).bound
    torch.testing.assert_close(model_total(bounded, x), bound)
    torch.testing.assert_close(later, bounded.filter(x, 8, seed=0).filtered.log_evidence[:, 5:])
    growing = pair_model("vrnn", Attention(8, 2))
    stream = growing.filter(x, 8, seed=0)
    torch.manual_seed(0)
    torch.testing.assert_close(stream.filtered.log_evidence.sum(1), fivo_bound(growing, x, 8).bound)
    for call in (lambda: stream.update(x[:, 0]), lambda: stream.predict(), lambda: stream.save("state")):
        with pytest.raises(ValueError, match="with Attention, whose state grows with every step"):
            call()


def model_total(model, x):
    return model.filter(x, 8, seed=0).filtered.log_evidence.sum(1)


# -------------------------------------------------------------------------------------------------------------- views


class Doubled(View):
    """y = 2 x, step by step."""

    by_step = True

    def __call__(self, data, view_inputs=None):
        return data | {"x": 2 * data["x"], "view_inputs": {}} if "view_inputs" not in data and "x" in data else data

    def inverse(self, model_values):
        return model_values | {"x": model_values["x"] / 2}

    def log_det(self, data):
        return torch.full_like(data["x"], 2.0).log()


@torch.no_grad()
def test_log_evidences_are_densities_of_the_data(tmp_path):
    x = torch.randn(3, T, 3, dtype=DOUBLE)
    prior = SeriesPrior(0.1, 1.0, 1.5, 3.0, 0.0, 1.0)
    for view in (Doubled(), SeriesUnits((prior,) * 3, 1, 4), Parts({"a": [0, 2], "b": [1]})):
        is_parts = isinstance(view, Parts)
        text = "p(z_t | z_{t-1}) " + ("p(a_t | z_t) p(b_t | z_t, a_t)" if is_parts else "p(x_t | z_t, x_{t-1})")
        guide = "q(z_t | z_{t-1}, a_t)" if is_parts else "q(z_t | z_{t-1}, x_t)"
        model = build((text, guide), {"z": 2, "a": 2, "b": 1} if is_parts else {"z": 2, "x": 3}, view=view)
        stream = model.filter(x[:, :4], 8, seed=0)
        torch.manual_seed(0)
        expected = fivo_bound(model, x[:, :4], 8).bound
        torch.testing.assert_close(stream.filtered.log_evidence.sum(1), expected, rtol=0, atol=1e-9)
        if isinstance(view, SeriesUnits):
            with pytest.raises(ValueError, match="SeriesUnits does not transform each step alone"):
                stream.update(x[:, 4])
            continue
        assert stream.predict().sample(5)["x"].shape == (5, 3, 3)
        stream.save(tmp_path / "state")
        stream = model.filter(resume=tmp_path / "state")
        later = stream.update(x[:, 4:]).log_evidence
        torch.testing.assert_close(later, model.filter(x, 8, seed=0).filtered.log_evidence[:, 4:])


# ----------------------------------------------------------------------------------------------------------- refusals


ZERO = torch.zeros(2, 3, 3)


def start(batch=ZERO, *arguments, name="vrnn", network=None, **options):
    return pair_model(name, network).filter(batch, *arguments, **options)


def reads_later():
    return build(("p(z_t) p(x_t | z_{1:T})", None), SIZES_2).filter(ZERO)


def has_no_likelihood():
    return build(("p(z_t) p(x_t | z_t)", None), SIZES_2, Dense((3,)), {"p(x)": Delta()}).filter(ZERO)


REFUSALS = [
    ("particles is 0", lambda: start(ZERO, 0)),
    ("resample_below must be a share", lambda: start(resample_below=2)),
    ("lag is -1", lambda: start(lag=-1)),
    ("needs the first steps", lambda: start(None)),
    ("missing in the batch are x", lambda: start({})),
    ("leave out the other arguments", lambda: start(resume="state")),
    ("leave out the other arguments", lambda: start(None, lag=1, resume="state")),
    ("has 2 sequences, but the new steps have 3", lambda: start().update(torch.zeros(3, 3))),
    ("missing in the batch are x", lambda: start().update({})),
    ("leave out 'lengths'", lambda: start().update({"x": ZERO, "lengths": torch.tensor([1, 3])})),
    ("ragged batch have ended", lambda: start({"x": ZERO, "lengths": torch.tensor([2, 3])}).update(ZERO)),
    ("missing in the batch are c", lambda: start(pair_batch("context"), name="context").update(torch.zeros(3, 3))),
    ("missing in the batch are c", lambda: start(pair_batch("context"), name="context").predict()),
    ("x is None; give the values", lambda: start().update(None)),
    ("levels must be", lambda: start().predict().quantile(2.0)),
    ("levels must be", lambda: start().predict().quantile([0.5, -0.1])),
    ("reads no context; leave out c", lambda: start().predict({"c": ZERO})),
    ("leave out b", lambda: start(pair_batch("context"), name="context").update(pair_batch("context"))),
    ("Linear of", lambda: start(network=Linear(3)).update(ZERO)),
    ("no likelihood", has_no_likelihood),
    ("z_{1:T}, which is not known yet", reads_later),
    ("cannot be summed out", lambda: start(masked(ZERO), name="switching ar")),
]


@pytest.mark.parametrize(("text", "call"), REFUSALS, ids=[text for text, _ in REFUSALS])
def test_what_cannot_be_filtered_is_refused(text, call):
    with pytest.raises(ValueError, match=re.escape(text)):
        call()


CONTEXTS = {
    "exact": (("p(z_t | z_{t-1}, c_t) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)"), {"z": 2}, Dense(())),
    "hmm": (("p(k_t | k_{t-1}, c_t) p(x_t | k_t, c_t)", ""), {"k": Discrete(2)}, None),
    "particles": (("p(z_t | z_{t-1}, c_t) p(x_t | z_t, c_t)", "q(z_t | z_{t-1}, x_t)"), {"z": 2}, None),
}


@torch.no_grad()
@pytest.mark.parametrize("name", CONTEXTS)
def test_context_of_another_shape_is_refused(name):
    pair, sizes, network = CONTEXTS[name]
    model = build(pair, {**sizes, "x": 3, "c": 2}, network, {"p": FixedNormal()} if name == "exact" else None)
    stream = model.filter({"x": torch.zeros(3, 4, 3), "c": torch.zeros(3, 4, 2)})
    assert set(stream.proposal.values()) == {"guide" if name == "particles" else "exact"}
    for shape, message in (
        ((1, 2), "has 3 sequences, but the new steps have 1"),
        ((2, 2), "has 3 sequences, but the new steps have 2"),
        ((6, 2), "has 3 sequences, but the new steps have 6"),
        ((3, 2, 2), "of one step, got 2 steps"),
        ((3, 3), "expected"),
    ):
        with pytest.raises(ValueError, match=message):
            stream.predict({"c": torch.zeros(shape)})
    with pytest.raises(TypeError, match="context is a Tensor, expected a mapping"):
        stream.predict(torch.zeros(3, 2))
    assert stream.predict({"c": torch.zeros(3, 2)}).mean["x"].shape == (3, 3)


def test_an_update_that_is_refused_changes_nothing():
    model = pair_model("vrnn")
    stream, other = (model.filter(ZERO, 5, seed=0) for _ in range(2))
    for wrong in (torch.full((2, 3), torch.nan), {"x": ZERO, "y": ZERO}, torch.zeros(3, 3)):
        with pytest.raises(ValueError, match=r"NaN|y|sequences"):
            stream.update(wrong)
    torch.testing.assert_close(stream.update(ZERO).log_evidence, other.update(ZERO).log_evidence, rtol=0, atol=0)


@pytest.mark.parametrize("rows", [1, 3])
def test_a_model_with_a_strided_buffer_resumes(rows, tmp_path):
    model = pair_model("vrnn")
    model.register_buffer("column", torch.ones(rows, 6)[:, 0])
    stream = model.filter(ZERO, 5, seed=0)
    stream.save(tmp_path / "state")
    resumed = model.filter(resume=tmp_path / "state")
    assert repr(resumed) == repr(stream) == "Filter(2 sequences, 3 steps, 5 particles, z: guide)"
    torch.testing.assert_close(stream.update(ZERO).log_evidence, resumed.update(ZERO).log_evidence, rtol=0, atol=0)


def test_the_state_of_another_model_is_refused(tmp_path):
    start(ZERO, 5).save(tmp_path / "state")
    with pytest.raises(ValueError, match="for other weights"):
        pair_model("vrnn").filter(resume=tmp_path / "state")


def test_a_file_that_is_no_filter_is_refused(tmp_path):
    (tmp_path / "state").write_bytes(b"no safetensors")
    with pytest.raises(ValueError, match="is not a stored filter"):
        pair_model("vrnn").filter(resume=tmp_path / "state")
    start().save(tmp_path / "state")
    (tmp_path / "state").write_bytes((tmp_path / "state").read_bytes()[:-1])
    with pytest.raises(ValueError, match="state is damaged"):
        pair_model("vrnn").filter(resume=tmp_path / "state")


@torch.no_grad()
def test_a_caller_may_reuse_the_tensor_of_an_update():
    x, results, buffer = torch.randn(1, 6, 3, dtype=DOUBLE), [], torch.empty(1, 3, dtype=DOUBLE)
    model = pair_model("vrnn")
    for reuses in (True, False):
        stream = model.filter(x[:, :1], 8, seed=0)
        for t in range(1, 6):
            buffer.copy_(x[:, t])
            last = stream.update(buffer if reuses else buffer.clone())
        results.append(last.log_evidence)
    torch.testing.assert_close(*results, rtol=0, atol=0)


@torch.no_grad()
@pytest.mark.parametrize("mean", [0.0, 1000.0, 10_000.0])
def test_exact_results_of_a_single_precision_model_are_those_in_double_precision(mean):
    """Differences of locations far from 0 lose their digits in single precision."""
    x = mean + torch.randn(4, T, 1)
    pair = "p(z_t | z_{t-1}) p(x_t | z_t, x_{t-1})", "q(z_t | x_t)"
    model = build(pair, {"z": 1, "x": 1}, Dense(()), FixedNormal(0.5)).float()
    model.standardise("x").fit(x)
    expected = Oracle(deepcopy(model).double(), T).evidence(x.double())
    torch.testing.assert_close(Oracle(model, T).evidence(x), expected, rtol=0, atol=1e-8)
    torch.testing.assert_close(model.filter(x).filtered.log_evidence.sum(1), expected, rtol=0, atol=1e-8)
