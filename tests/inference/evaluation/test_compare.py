"""Comparison: bounds against the oracle, standard errors against formulas and simulation, latents in closed form."""

import json
import math
import shutil

import numpy as np
import pytest
import torch

import dvae
from dvae import Comparison, DynamicalVAE, Oracle, linear_gaussian_surrogate, motion
from dvae.cli import main
from dvae.data.sequences import ArrayWindows
from dvae.data.views import Past
from dvae.inference.evaluation.compare import compare
from dvae.inference.evaluation.comparison import ModelResult
from dvae.inference.evaluation.evaluate import evaluate
from dvae.inference.evaluation.scores import Measure

T = 5
DKF = ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})")
MEAN_FIELD = (DKF[0], "q(z_t | x_{1:T})")


def build(pair=DKF, seed=0, fitted=True, scale=0.3):
    model = linear_gaussian_surrogate(*pair, {"z": 1, "x": 2}, T, seed, scale=scale)
    if fitted:
        Oracle(model, T).fit_guide(200)
    return model


def draws(model, n, seed=1):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return model.sample(n, T)["x"]


def run(models, data, **options):
    usual = {"scores": motion.displacements, "particles": 32, "contrasts": 16, "samples": 0, "progress": False}
    return compare(models, data, **(usual | options))


def scores(result, name):
    """Return the estimates of a model, with None for missing ones."""
    return json.loads(result.to_json())["summary"]["models"][name]["scores"]


@pytest.fixture(scope="module")
def fitted():
    """Two seeds each of two models, and data from the first."""
    models = {"dkf": [build(seed=s) for s in (0, 1)], "mean field": [build(MEAN_FIELD, seed=s) for s in (0, 1)]}
    return models, draws(models["dkf"][0], 24)


# ------------------------------------------------------------------------------------------- bounds and the oracle


def test_the_bounds_lie_in_order_below_the_evidence():
    model = build(MEAN_FIELD, fitted=False)
    x, oracle = draws(model, 300), Oracle(model, T)
    result = run({"a": model}, x, particles=64, contrasts=0)
    evidence, bound = (value.mean().item() / T for value in (oracle.evidence(x), oracle.bound(x)))
    assert bound < result["a"]["IWAE bound"].mean < evidence
    exact = oracle.bound(x).detach().numpy()
    noise = (result.rows["a"].bounds["ELBO"] - exact).std() / math.sqrt(300) / T
    assert result["a"]["ELBO"].mean == pytest.approx(bound, abs=4 * noise)


def test_scores_are_those_of_an_evaluation_on_the_same_windows():
    model = build()
    windows = ArrayWindows(draws(model, 12), 3, groups=[f"clip {i // 3}" for i in range(12)])
    result = run({"a": model}, windows, samples=4, seed=3, particles=32)
    same = {"samples": 4, "seed": 3, "bound_particles": 32, "references": False, "progress": False}
    expected = evaluate({"a": model}, windows, scores=motion.displacements, **same)["a"]
    for metric in ("ELBO", "IWAE bound", "KL z", "ADE", "FDE", "MMADE", "MMFDE", "energy score"):
        estimates = result["a"][metric]
        assert (estimates.mean, estimates.sequences) == pytest.approx(
            (expected[metric].mean, expected[metric].standard_error)
        )
    khat = result.rows["a"].bounds["k-hat"]
    assert khat.mean() == pytest.approx(expected["k-hat"].mean)
    assert result.rows["a"].unreliable == (khat > 0.7).mean()


def test_the_fivo_bound_is_the_filters_and_unsupported_models_get_a_note():
    """It is at most the evidence on average, and computing it changes no other bound."""
    models = {
        "filters": build(MEAN_FIELD, fitted=False),
        "backward": build((DKF[0], "q(z_t | z_{>t}, x_{1:T})")),
        "nothing latent": linear_gaussian_surrogate("p(x_t | x_{t-1})", "", {"x": 2}, T),
    }
    x = draws(models["filters"], 60)
    result, without = run(models, x, filter_particles=16), run(models, x)
    bounds, evidence = result.rows["filters"].bounds["FIVO bound"][0], Oracle(models["filters"], T).evidence(x)
    above = bounds - evidence.detach().numpy()
    assert -2 < above.mean() < 4 * above.std() / math.sqrt(60)
    none = result.rows["nothing latent"].bounds
    np.testing.assert_allclose(none["FIVO bound"], none["IWAE bound"])
    assert "FIVO bound" not in result.rows["backward"].bounds
    assert ["backward" in note for note in result.rows["backward"].notes] == [True]
    assert "FIVO bound" not in str(without)
    assert all(scores(without, name).items() <= scores(result, name).items() for name in models)
    assert str(Comparison.from_json(result.to_json())) == str(result)


@pytest.mark.filterwarnings("ignore:The inplace keyword in DataFrame.sort_values:DeprecationWarning")  # arviz_stats 0.8
def test_leave_future_out_is_compared_next_to_the_evidence(fitted):
    import arviz_stats

    models, x = fitted
    result = run(models, x, leave_future_out=(2, 1))
    for name, seeds in models.items():
        exact = np.stack([(Oracle(m, T).evidence(x) - Oracle(m, 2).evidence(x[:, :2])).detach().numpy() for m in seeds])
        np.testing.assert_allclose(result.rows[name].bounds["LFO"], exact, atol=1e-8)
        assert result[name]["LFO"].mean == pytest.approx(exact.mean() / (T - 2))
        assert result.monte_carlo_error(name) == 0
    first, second = (result.rows[name].bounds["LFO"] for name in models)
    assert result.difference("dkf", "mean field", "LFO").mean == pytest.approx((first - second).mean() / (T - 2))
    assert result.n_forecast.tolist() == [T - 2] * 24
    elpd = result.to_elpd()
    assert elpd["dkf"].elpd == pytest.approx(24 * (T - 2) * result["dkf"]["LFO"].mean)
    np.testing.assert_allclose(elpd["dkf"].elpd_i, result.rows["dkf"].bounds["LFO"].mean(0))
    assert elpd["dkf"].se == pytest.approx(24**0.5 * elpd["dkf"].elpd_i.std(ddof=1).item())
    assert not elpd["dkf"].warning
    assert arviz_stats.compare(elpd).index[0] == max(elpd, key=lambda name: elpd[name].elpd)
    text = str(result)
    assert ("L = 2, M = 1" in text, "95 % (df)" in text) == (True, False)
    assert str(Comparison.from_json(result.to_json())) == text
    assert "FIVO bound" in str(run(models, x, leave_future_out=(2, 1), filter_particles=5))
    parts = [run({name: seeds}, x, leave_future_out=(2, 1)) for name, seeds in models.items()]
    assert parts[0].join(parts[1]).to_json() == result.to_json()
    without = run(models, x)
    assert all(scores(without, name).items() <= scores(result, name).items() for name in models)
    for missing in (without.to_elpd, lambda: without.monte_carlo_error("dkf")):
        with pytest.raises(ValueError, match="leave_future_out="):
            missing()
    result.rows["dkf"].bounds["LFO particles"][0, 3] = 1
    assert result.to_elpd()["dkf"].warning


# --------------------------------------------------------------------------------------------------- standard errors


def record(values, clips=None, frames=None):
    """Return a comparison of IWAE bounds (S, N) by model name, in nats per sequence."""
    count = next(iter(values.values())).shape[1]
    clips = range(count) if clips is None else clips
    rows = {}
    for name, bound in values.items():
        bounds = {"ELBO": bound, "IWAE bound": bound, "k-hat": bound * math.nan}
        rows[name] = ModelResult({}, {}, bounds, {}, {}, {}, bound.mean(0)[None], {})
    keys = [("test", str(clip), 0) for clip in clips]
    frames = np.ones(count) if frames is None else np.array(frames, dtype=float)
    counts = {"particles": 1, "contrasts": 0, "samples": 0, "seed": 0}
    return Comparison(rows=rows, keys=keys, n_steps=frames, data={}, protocol={}, emission="mean", **counts)


def test_errors_over_sequences_are_clustered_by_clip_and_weighted_by_frames():
    clips, frames = ["a", "a", "b", "c", "c", "c"], [3, 5, 4, 2, 2, 6]
    first, second = (np.random.default_rng(seed).normal(size=(1, 6)) for seed in (0, 1))
    result = record({"a": first, "b": second}, clips, frames)
    total = sum(frames)
    for values, estimate in ((first, result["a"]["IWAE bound"]), (first - second, result.difference("a", "b"))):
        mean = values.sum() / total
        clip_sums = [sum(values[0, i] - frames[i] * mean for i in range(6) if clips[i] == clip) for clip in "abc"]
        assert estimate.mean == pytest.approx(mean)
        assert estimate.sequences == pytest.approx(math.sqrt(3 / 2 * sum(s**2 for s in clip_sums)) / total)


def test_errors_over_seeds_and_in_total_match_two_way_random_effects():
    random = np.random.default_rng(0)
    first, second = random.normal(size=(3, 8)), random.normal(size=(4, 8))
    of_both = [np.std(v.mean(1), ddof=1) / math.sqrt(len(v)) for v in (first, second)]
    assert record({"a": first, "b": second}).difference("a", "b").seeds == pytest.approx(math.hypot(*of_both))

    values = np.random.default_rng(0).normal(size=(3, 8)) + 3 * np.arange(3)[:, None] + np.arange(8)
    estimate = record({"a": values})["a"]["IWAE bound"]
    rest = values - values.mean(0) - values.mean(1, keepdims=True) + values.mean()
    interaction = (rest**2).sum() / (2 * 7) / (3 * 8)
    sequences, seeds = values.mean(0).var(ddof=1) / 8, values.mean(1).var(ddof=1) / 3
    assert estimate.seeds == pytest.approx(math.sqrt(seeds))
    assert estimate.total == pytest.approx(math.sqrt(sequences + seeds - interaction))


# ----------------------------------------------------------------------------------------------------------- latents


def distribution(model):
    """Return the gain and covariance of q(latents | x), and the covariance of x, of a linear-Gaussian model."""
    oracle = Oracle(model, T)
    gain, _, root = (part[0] for part in oracle._guide())
    covariance = torch.linalg.inv(oracle._joint()[1])[len(gain) :, len(gain) :]
    return gain.detach(), (root @ root.t()).detach(), covariance.detach()


def test_information_is_the_mutual_information_of_a_linear_guide():
    model, n = build(MEAN_FIELD, scale=0.8), 600
    gain, noise, covariance = distribution(model)
    signal_to_noise = (gain @ covariance * gain).sum(1) / noise.diagonal()  # of each scalar latent
    information = run({"a": model}, draws(model, n), particles=1, contrasts=n).rows["a"].information["z"][0]
    exact = 0.5 * torch.log1p(signal_to_noise)
    # The log-ratio of two jointly normal numbers of correlation r has variance r^2 (1 - r^2 = exp(-2 information)).
    error = torch.sqrt((1 - torch.exp(-2 * exact)) / n)
    assert information.shape == exact.shape
    assert (exact > 0.1).all()
    assert (np.abs(information - exact.numpy()) < 4 * error.numpy()).all()


# -------------------------------------------------------------------------------------------------------------- data


def test_ragged_sequences_are_weighted_by_their_frames():
    pair = "p(w) p(z_t | z_{t-1}, w) p(x_t | x_{t-1}, z_t)", "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{1:T}, w)"
    model = DynamicalVAE(*pair, {"w": 2, "z": 2, "x": 3}, dvae.networks.Recurrent(4)).double()
    lengths = torch.tensor([7, 2, 4, 7, 1, 3])
    x = torch.randn(6, 7, 3, dtype=torch.float64)
    result = run({"a": model}, {"x": x, "lengths": lengths}, contrasts=6)
    row = result.rows["a"]
    assert result.n_steps.tolist() == lengths.tolist()
    assert result["a"]["ELBO"].mean == pytest.approx(row.bounds["ELBO"].sum() / lengths.sum().item())
    alive = np.array([(lengths > t).sum() for t in range(7)])
    assert (row.kl_steps["z"][0] * alive).sum() == pytest.approx(row.bounds["KL z"].sum())
    information = row.information["z"][0]
    assert (information <= np.log(alive) + 1e-9).all()
    assert np.isfinite(row.variances["z"]).all()
    hidden = torch.where(torch.arange(7)[:, None] < lengths[:, None, None], x, 1e3)
    again = run({"a": model}, {"x": hidden, "lengths": lengths}, contrasts=6)
    assert scores(again, "a") == scores(result, "a")
    assert np.array_equal(again.rows["a"].information["z"], row.information["z"])


def test_a_bound_that_is_not_finite_names_model_and_sequence():
    model = build(fitted=False)
    x = draws(model, 4)
    x[2] *= 1e200
    with pytest.raises(FloatingPointError, match="finite"):
        run({"wild": model}, x)


# ----------------------------------------------------------------------------------------------------------- records


def test_a_comparison_is_read_back_from_json_unchanged(fitted, tmp_path):
    models, x = fitted
    windows = ArrayWindows(x, 3, groups=["a"] * 12 + ["b"] * 12)
    result = run(models, windows, samples=2, particles=4, configs={"dkf": {"latent": 1}})
    result.save(tmp_path / "comparison.json")
    again = Comparison.load(tmp_path / "comparison.json")
    assert again.to_json() == result.to_json()
    assert str(again) == str(result)
    assert again.difference("dkf", "mean field") == result.difference("dkf", "mean field")
    summary = json.loads(result.to_json())["summary"]
    assert summary["ranking"] == result.ranking
    assert again.data["fingerprint"] == windows.fingerprint
    assert again.protocol["observed"] == 3
    assert again.rows["dkf"].config == {"latent": 1}
    assert again.rows["dkf"].equations["generative"] == models["dkf"][0].generative.text
    assert summary["models"]["dkf"]["khat_above_0.7"] is None  # four particles have no tail
    for damage in (
        lambda attributes: attributes["keys"].pop(),
        lambda attributes: attributes["rows"]["dkf"]["bounds"]["ELBO"].__setitem__(0, 1),
        lambda attributes: attributes["rows"]["dkf"]["bounds"].pop("k-hat"),
    ):
        document = json.loads(result.to_json())
        damage(document["attributes"])
        with pytest.raises(ValueError, match="not written by Comparison"):
            Comparison.from_json(json.dumps(document))


def test_joined_comparisons_equal_one_comparison(fitted):
    models, x = fitted
    dkf, other = (run({name: model}, x) for name, model in models.items())
    assert Comparison.from_json(dkf.to_json()).join(other).to_json() == run(models, x).to_json()
    for option, data, options in (("seed", x, {"seed": 1}), ("data", x + 1, {}), ("contrasts", x, {"contrasts": 8})):
        with pytest.raises(ValueError, match=f"differ in {option}"):
            dkf.join(run({"b": models["dkf"]}, data, **options))
    with pytest.raises(ValueError, match="comparisons have"):
        dkf.join(dkf)


# With only 100 draws the diagnostic warns without cause; `Comparison.to_arviz` explains why.
@pytest.mark.filterwarnings("ignore:Estimated shape parameter of Pareto:UserWarning")
@pytest.mark.filterwarnings("ignore:The inplace keyword in DataFrame.sort_values:DeprecationWarning")  # arviz_stats 0.8
def test_arviz_reads_the_comparison(fitted):
    import arviz_stats

    models, x = fitted
    other = {"dkf": models["dkf"], "seed 1": models["dkf"][1]}
    result = run(other, x, estimates=100, particles=8)
    trees = result.to_arviz()
    table = arviz_stats.compare(trees)
    assert list(table.index) == result.ranking
    for name, tree in trees.items():
        loo = arviz_stats.loo(tree, pointwise=True)
        assert loo.n_data_points == 24
        bound = result[name]["IWAE bound"].mean * result.n_steps.sum()
        # p is Monte Carlo error only; it is 0 for an exact guide, up to rounding
        rounding = 24 * 100 * np.finfo(float).eps * abs(bound)
        assert loo.elpd == pytest.approx(bound, abs=3 * loo.p + rounding)
        assert loo.p < 0.5
        assert tree["constant_data"]["khat"].dims == ("seed", "sequence")
    with pytest.raises(ValueError, match="comparison"):
        run(other, x).to_arviz()


# ------------------------------------------------------------------------------------------------------ command line


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    motion.save(folder / "people.npz", motion.simulate(clips=14, frames=90, seed=1))
    small = ["--steps", "4", "--batch-size", "4", "--warm-up", "2", "--validate-every", "4"]
    for name, method, latent, seed in (
        ("a0", "vae", 2, 0),
        ("a1", "vae", 2, 1),
        ("b", "vae", 3, 0),
        ("c", "dkf", 2, 0),
    ):
        out = ["--out", str(folder / name), "--latent", str(latent), "--seed", str(seed)]
        assert main(["fit", method, "--data", str(folder / "people.npz"), *out, *small]) == 0
    return folder


LFO = ["--leave-future-out", "30", "1"]
CHEAP = ["--particles", "25", "--contrasts", "4"]


def test_runs_that_differ_only_in_the_seed_share_a_row(runs, capsys, tmp_path):
    paths = [str(runs / name) for name in ("a0", "b", "a1", "c")]
    out, figure = tmp_path / "comparison.json", tmp_path / "comparison.png"
    arguments = [*paths, *CHEAP, *LFO, "--ensembles", "--samples", "2", "--out", str(out), "--figure", str(figure)]
    assert main(["compare", *arguments]) == 0
    output = capsys.readouterr().out
    for part in ("vae (latent 2)", "vae (latent 3)", "dkf", "K = 25", "free-running", "ADE", "LFO"):
        assert part in output
    result = Comparison.load(out)
    seeds = {name: row.seeds for name, row in result.rows.items()}
    mixture = "vae (latent 2), mixture of 2 seeds"
    assert seeds == {"vae (latent 2)": 2, "vae (latent 3)": 1, "dkf": 1, mixture: 1}
    assert result.mixtures == {mixture: 2}
    assert main(["compare", paths[1], "--ensembles"]) == 2
    assert result.rows["dkf"].config["method"]["latent"] == 2
    assert figure.read_bytes().startswith(b"\x89PNG")


REFUSING = {"evaluate": ".json", "compare": ".json", "forecast": ".npz"}


@pytest.mark.parametrize("command", REFUSING)
def test_a_failed_run_is_refused(runs, capsys, tmp_path, command):
    path, out = tmp_path / "failed", tmp_path / f"out{REFUSING[command]}"
    shutil.copytree(runs / "a1", path)
    state = json.loads((path / "state.json").read_text())
    (path / "state.json").write_text(json.dumps({**state, "status": "failed", "step": 0}))
    arguments = [command, str(path), "--out", str(out)]
    assert main(arguments) == 1
    error = capsys.readouterr().err.replace("\n", " ")
    if command != "compare":
        assert f"{path} has not ended (failed at step 0 of 4); its weights are the initial ones" in error
    assert f"at a lower learning rate with: dvae resume {path} --learning-rate 0.0001" in error
    assert not out.exists()
    if command == "forecast":
        assert main([*arguments, "--failed", "--samples", "1"]) == 0
        assert "note: " in capsys.readouterr().err
        assert np.load(out)["emission"] == "drawn"
        with pytest.warns(UserWarning, match="failed at step 0 of 4"):
            dvae.load(path)


def test_runs_of_other_windows_are_not_compared(runs, capsys, tmp_path):
    motion.save(tmp_path / "few.npz", motion.simulate(clips=12, frames=90, seed=2))
    other = ["--data", str(tmp_path / "few.npz"), "--out", str(tmp_path / "other")]
    assert main(["fit", "vae", *other, "--steps", "2", "--batch-size", "2", "--warm-up", "1"]) == 0
    assert main(["compare", str(runs / "a0"), str(tmp_path / "other")]) == 1
    assert "other test windows" in " ".join(capsys.readouterr().err.split())


def test_the_best_of_many_models_depends_on_the_direction_of_the_metric():
    random = np.random.default_rng(0)
    values = {name: mean + 0.1 * random.standard_normal((3, 12)) for name, mean in (("a", 0.0), ("b", 1.0), ("c", 5.0))}
    result = record(values)
    assert result.confidence_set().members == ["c"]  # of bounds the higher is better
    assert result.pairs().differences["a", "c"] == result.difference("a", "c")
    assert all(p < 0.01 for p in result.pairs().p_values.values())
    assert result.required("b", "a").achieved > 0.9
    with pytest.raises(KeyError, match="no score 'ADE'"):
        result.confidence_set("ADE")
    windows = ArrayWindows(torch.randn(20, T, 2), 3)
    models = {name: [build(seed=seed, scale=scale) for seed in (0, 1)] for name, scale in (("a", 1.0), ("b", 0.1))}
    square = Measure("square", lambda f, t, p, index: f.square().mean((1, 2, 3)), better="lower", headline=False)
    result = run(models, windows, samples=3, scores=lambda _: [square])
    assert result.shown == {}  # the score is in no table
    least = min("ab", key=lambda name: result[name]["square"].mean)
    assert result.confidence_set("square", over_seeds=False).members == [least]


def test_densities_given_a_past_are_not_compared_with_densities_of_all_steps():
    past = DynamicalVAE("p(x_t | s)", "", {"x": 2, "s": 8}, view=Past("s", 4))
    models = {"past": past, "all": DynamicalVAE("p(x_t | x_{<t})", "", {"x": 2})}
    with pytest.raises(ValueError, match="steps after the first 4 given the first 4 for past, of the data for all"):
        run(models, ArrayWindows(torch.randn(8, 6, 2), 4))


def test_models_of_several_variables_are_compared_by_bounds():
    pair = "p(z_t | z_{t-1}) p(n_t | z_t) p(y_t | n_t, z_t)", "q(z_t | z_{t-1}, n_{t:T}, y_{t:T})"
    model = DynamicalVAE(*pair, {"z": 1, "n": 1, "y": 1}, observed=("n", "y"))
    batch = {"n": torch.randn(8, 6, 1), "y": torch.randn(8, 6, 1)}
    assert run({"two": model}, batch).ranking == ["two"]
    for score in (run, evaluate):
        with pytest.raises(ValueError, match="two has no data variable x, as windows have, but n, y; pass a batch"):
            score({"two": model}, ArrayWindows(batch["y"], 4))
    given_x = DynamicalVAE("p(z_t) p(y_t | z_t, x_t)", "q(z_t | y_t, x_t)", {"z": 1, "y": 1, "x": 1}, observed=("y",))
    assert run({"given x": given_x}, {"y": batch["y"], "x": batch["n"]}).ranking == ["given x"]
    with pytest.raises(TypeError, match=r'a batch of x, mask; pass batch\["x"\], and its mask'):
        ArrayWindows({"x": batch["y"], "mask": batch["y"] > 0}, 4)
    with pytest.raises(TypeError, match=r"one array x .* but this is a batch of n, y; pass it as it is to dvae.fit"):
        ArrayWindows(batch, 4)


def test_a_model_of_other_columns_is_named():
    models = {"narrow": DynamicalVAE(*DKF, {"z": 1, "x": 2}), "wide": DynamicalVAE(*DKF, {"z": 1, "x": 3})}
    windows = ArrayWindows(torch.randn(8, 6, 2), 4)
    message = r"wide cannot read the data: x has shape \(1, 6, 2\), expected \(B, T, 3\)"
    for score in (run, evaluate):
        with pytest.raises(ValueError, match=message):
            score(models, windows)
