"""Comparison: bounds against the oracle, standard errors against their formulas and against simulation, latents against
closed forms."""

import dataclasses
import io
import json
import math
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rich.console import Console
from torch import nn

import dvae
from dvae import Comparison, DynamicalVAE, Oracle, motion, twin
from dvae.cli import main
from dvae.data.sequences import ArrayWindows
from dvae.inference.evaluation.compare import compare
from dvae.inference.evaluation.comparison import Contender
from dvae.inference.evaluation.estimates import Estimate
from dvae.inference.evaluation.evaluate import evaluate
from dvae.tables import Column, Columns, Cut, PanelData

T = 5
DKF = ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})")
MEAN_FIELD = (DKF[0], "q(z_t | x_{1:T})")
STATIC = ("p(w) p(x_t | w)", "q(w | x_{1:T})")


def build(pair=DKF, seed=0, fitted=True, scale=0.3, **sizes):
    sizes = {"w" if pair is STATIC else "z": 1, "x": 2} | sizes
    model = twin(*pair, sizes, T, seed, scale=scale)
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
    """The estimates of a model, with None for what is unknown."""
    return json.loads(result.to_json())["rows"][name]["scores"]


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
    assert bound < result["a"]["importance bound"].mean < evidence
    exact = oracle.bound(x).detach().numpy()
    noise = (result.rows["a"].bounds["ELBO"] - exact).std() / math.sqrt(300) / T
    assert result["a"]["ELBO"].mean == pytest.approx(bound, abs=4 * noise)


def test_the_model_that_made_the_data_ranks_first_by_its_advantage_in_evidence():
    models = {f"seed {seed}": build(seed=seed) for seed in (2, 0, 1)}
    x = draws(models["seed 0"], 200)
    result = run(models, x, particles=16, contrasts=0)
    evidence = {name: Oracle(model, T).evidence(x).detach() / T for name, model in models.items()}
    assert result.ranking == sorted(evidence, key=lambda name: -evidence[name].mean())
    assert result.ranking[0] == "seed 0"
    for name in ("seed 1", "seed 2"):
        difference, exact = result.difference("seed 0", name), evidence["seed 0"] - evidence[name]
        assert difference.mean == pytest.approx(exact.mean().item(), abs=1e-3)
        assert difference.sequences == pytest.approx(exact.std().item() / math.sqrt(200), rel=1e-2)


def test_scores_are_those_of_an_evaluation_on_the_same_windows():
    model = build()
    windows = ArrayWindows(draws(model, 12), 3, clips=[f"clip {i // 3}" for i in range(12)])
    result = run({"a": model}, windows, samples=4, seed=3, particles=32)
    same = {"samples": 4, "seed": 3, "bound_particles": 32, "references": False, "progress": False}
    expected = evaluate({"a": model}, windows, scores=motion.displacements, **same)["a"]
    for metric in ("ELBO", "importance bound", "KL z", "ADE", "FDE", "MMADE", "MMFDE", "energy score"):
        ours = result["a"][metric]
        assert (ours.mean, ours.sequences) == pytest.approx((expected[metric].mean, expected[metric].standard_error))
    khat = result.rows["a"].bounds["k-hat"]
    assert khat.mean() == pytest.approx(expected["k-hat"].mean)
    assert result.rows["a"].unreliable == (khat > 0.7).mean()


def test_scores_depend_on_the_seed_and_not_on_the_company(fitted):
    models, x = fitted
    alone, together = run({"b": models["mean field"]}, x), run(models | {"b": models["mean field"]}, x)
    assert scores(alone, "b") == scores(together, "b")
    assert np.array_equal(alone.rows["b"].information["z"], together.rows["b"].information["z"])
    assert scores(run({"b": models["mean field"]}, x, seed=1), "b") != scores(alone, "b")


def test_independent_estimates_average_to_the_bound():
    model = build(MEAN_FIELD, fitted=False)
    row = run({"a": model}, draws(model, 20), estimates=5, particles=4).rows["a"]
    assert row.estimates.shape == (5, 20)
    assert (row.estimates.std(0) > 0).all()
    np.testing.assert_allclose(row.estimates.mean(0), row.bounds["importance bound"][0])


def test_the_particle_bound_is_that_of_the_filter_and_models_without_one_say_why(tmp_path):
    """Below the evidence on average, the same as without the others, and nothing else depends on it."""
    models = {
        "filters": build(MEAN_FIELD, fitted=False),
        "backward": build((DKF[0], "q(z_t | z_{>t}, x_{1:T})")),
        "nothing latent": twin("p(x_t | x_{t-1})", "", {"x": 2}, T),
    }
    x = draws(models["filters"], 60)
    result, without = run(models, x, filter_particles=16), run(models, x)
    own, evidence = result.rows["filters"].bounds["particle bound"][0], Oracle(models["filters"], T).evidence(x)
    above = own - evidence.detach().numpy()
    assert -2 < above.mean() < 4 * above.std() / math.sqrt(60)
    none = result.rows["nothing latent"].bounds
    np.testing.assert_allclose(none["particle bound"], none["importance bound"])
    assert "particle bound" not in result.rows["backward"].bounds
    assert ["backward" in note for note in result.rows["backward"].notes] == [True]
    assert "particle bound" not in str(without)
    for name in models:
        assert scores(without, name).items() <= scores(result, name).items()
        assert scores(run({name: models[name]}, x, filter_particles=16), name) == scores(result, name)
    assert "particle bound ↑" in str(result)
    assert "backward: no particle bound: particles move forward" in str(result)
    with pytest.raises(KeyError, match="'backward' has no score 'particle bound'"):
        result.pairs("particle bound")
    result.save(tmp_path / "c.json")
    again = Comparison.load(tmp_path / "c.json")
    assert str(again) == str(result)
    assert again.difference("filters", "nothing latent", "particle bound").sequences > 0
    assert len(result.plot().axes[0].lines) > len(without.plot().axes[0].lines)
    document = json.loads(without.to_json())
    for change in ({"filter_particles": "16"}, {"rows": {"a": {**document["rows"]["backward"], "notes": "text"}}}):
        with pytest.raises(ValueError, match="not a comparison"):
            Comparison.from_json(json.dumps({**document, **change}))


def test_comparison_leaves_mode_and_random_state_alone():
    model = build().train()
    state = torch.get_rng_state()
    run({"a": model}, draws(model, 4))
    assert model.training
    assert torch.equal(torch.get_rng_state(), state)


# --------------------------------------------------------------------------------------------------- standard errors


def record(values, clips=None, frames=None):
    """A comparison of importance-weighted bounds (S, N) by name, in nats a sequence."""
    count = next(iter(values.values())).shape[1]
    clips = range(count) if clips is None else clips
    rows = {
        name: Contender(
            {},
            {},
            {"ELBO": bound, "importance bound": bound, "k-hat": bound * math.nan},
            *[{}] * 3,
            bound.mean(0)[None],
            {},
        )
        for name, bound in values.items()
    }
    return Comparison(
        rows=rows,
        keys=[("test", str(clip), 0) for clip in clips],
        frames=np.ones(count) if frames is None else np.array(frames, dtype=float),
        data={},
        protocol={},
        particles=1,
        contrasts=0,
        samples=0,
        emission="mean",
        seed=0,
    )


def test_the_same_model_twice_differs_by_exactly_nothing(fitted):
    models, x = fitted
    result = run({"a": models["dkf"][0], "b": models["dkf"][0]}, x)
    difference = result.difference("a", "b")
    assert (difference.mean, difference.sequences) == (0, 0)
    assert math.isnan(difference.seeds)
    assert math.isnan(difference.total)
    assert result.difference("a", "a") == Estimate(0, 0, 0, 0)


def test_errors_over_sequences_are_clustered_by_clip_and_weigh_frames():
    clips, frames = ["a", "a", "b", "c", "c", "c"], [3, 5, 4, 2, 2, 6]
    first, second = (np.random.default_rng(seed).normal(size=(1, 6)) for seed in (0, 1))
    result = record({"a": first, "b": second}, clips, frames)
    total = sum(frames)
    for values, estimate in (
        (first, result["a"]["importance bound"]),
        (first - second, result.difference("a", "b")),
    ):
        mean = values.sum() / total
        clip_sums = [sum(values[0, i] - frames[i] * mean for i in range(6) if clips[i] == clip) for clip in "abc"]
        assert estimate.mean == pytest.approx(mean)
        assert estimate.sequences == pytest.approx(math.sqrt(3 / 2 * sum(s**2 for s in clip_sums)) / total)


def test_errors_over_seeds_are_those_of_the_seeds_means():
    random = np.random.default_rng(0)
    first, second = random.normal(size=(3, 8)), random.normal(size=(4, 8))
    result = record({"a": first, "b": second})
    of_first, of_second = (np.std(v.mean(1), ddof=1) / math.sqrt(len(v)) for v in (first, second))
    assert result["a"]["importance bound"].seeds == pytest.approx(of_first)
    assert result.difference("a", "b").seeds == pytest.approx(math.hypot(of_first, of_second))


def test_the_total_is_the_two_way_random_effects_variance_by_hand():
    values = np.random.default_rng(0).normal(size=(3, 8)) + 3 * np.arange(3)[:, None] + np.arange(8)
    estimate = record({"a": values})["a"]["importance bound"]
    rest = values - values.mean(0) - values.mean(1, keepdims=True) + values.mean()
    interaction = (rest**2).sum() / (2 * 7) / (3 * 8)
    sequences, seeds = values.mean(0).var(ddof=1) / 8, values.mean(1).var(ddof=1) / 3
    assert estimate.total == pytest.approx(math.sqrt(sequences + seeds - interaction))


@pytest.mark.parametrize(("of_seeds", "of_clips"), [(1.0, 3.0), (0.3, 6.0), (2.0, 0.5)])
def test_the_total_is_the_spread_of_a_difference_over_new_seeds_and_new_sequences(of_seeds, of_clips):
    """What clips have in common for both models cancels; seeds do not."""
    random = np.random.default_rng(0)
    means, errors = [], []
    for _ in range(1500):
        shared = 20 * random.normal(size=30)
        values = {
            name: of_seeds * random.normal(size=(seeds, 1))
            + shared
            + of_clips * random.normal(size=30)
            + 2 * random.normal(size=(seeds, 30))
            for name, seeds in (("a", 4), ("b", 6))
        }
        estimate = record(values).difference("a", "b")
        means.append(estimate.mean)
        errors.append(estimate.total**2)
    # The relative error of a variance from 1500 draws is sqrt(2 / 1500) = .037.
    assert np.mean(errors) == pytest.approx(np.var(means), rel=0.15)


def null(seeds, clips, of_seeds, of_clips, rest, random):
    """Two models that are equally good, each with seeds of its own, on the same clips."""
    shared = random.normal(size=clips)
    return {
        name: of_seeds * random.normal(size=(seeds, 1))
        + shared
        + of_clips * random.normal(size=clips)
        + rest * random.normal(size=(seeds, clips))
        for name in "ab"
    }


@pytest.mark.parametrize(
    ("seeds", "kind"), [(2, (1.0, 0.1, 0.1)), (3, (0.1, 1.0, 0.1)), (10, (0.2, 0.7, 0.3)), (3, (0.3, 0.7, 1.0))]
)
def test_a_true_null_is_rejected_about_as_often_as_the_level_says(seeds, kind):
    """At .05, whether seeds, clips, or both rule; Welch's test of two seeds a side is known to keep below."""
    random, runs = np.random.default_rng(0), 1500
    estimates = [record(null(seeds, 30, *kind, random)).difference("a", "b") for _ in range(runs)]
    rejected = np.array([estimate.p_value() < 0.05 for estimate in estimates])
    outside = [not low < 0 < high for low, high in (estimate.interval() for estimate in estimates)]
    assert rejected.tolist() == outside
    error = math.sqrt(0.05 * 0.95 / runs)
    assert (0 if seeds == 2 else 0.03 - 3 * error) < rejected.mean() < 0.06 + 3 * error
    if seeds == 3 and kind[0] == 1:  # the normal law, which takes the error for known, is not
        assert np.mean([abs(e.mean) > 1.96 * e.total for e in estimates]) > 0.09


def test_degrees_of_freedom_are_those_of_what_rules_the_error():
    random = np.random.default_rng(0)
    clips = np.arange(8.0)

    def freedom(first, second):
        return record({"a": first, "b": second}).difference("a", "b").freedom

    steady = np.zeros((4, 8)) + clips
    seeds = 5 * random.normal(size=(3, 1)) + np.zeros((3, 8))
    alike = np.concatenate([seeds, seeds]).reshape(2, 3, 8)
    assert freedom(steady, -steady) == pytest.approx((7, math.nan, 7), nan_ok=True)  # no spread over seeds at all
    assert freedom(steady - clips, seeds)[1:] == pytest.approx((2, 2))  # one row's seeds alone
    assert freedom(*alike)[1:] == pytest.approx((4, 4))  # Welch's, of equal variances
    between = freedom(steady, seeds + clips**2)
    assert between[0] == pytest.approx(7)
    assert 2 < between[2] < 9
    one = record({"a": random.normal(size=(1, 8))})["a"]["ELBO"]
    assert one.freedom[0] == pytest.approx(7)
    assert math.isnan(one.p_value())
    low, high = one.interval(error="sequences")
    assert (high - low) / 2 == pytest.approx(2.3646 * one.sequences, rel=1e-4)  # t of 7 degrees, from a table
    assert Estimate(0, 0, 0, 0).p_value() == 1
    assert Estimate(0, 0, 0, 0).interval() == (0, 0)
    with pytest.raises(ValueError, match="the level of an interval is between 0 and 1, got 95"):
        one.interval(95)
    with pytest.raises(ValueError, match="errors are over sequences, seeds, total, not 'clips'"):
        one.interval(error="clips")


def test_tables_and_plots_say_the_degrees_of_freedom():
    comparison = record(null(3, 8, 1.0, 0.1, 0.1, np.random.default_rng(0)))
    difference = comparison.difference(*reversed(comparison.ranking))
    low, high = difference.interval()
    console = Console(file=io.StringIO(), width=200)
    console.print(comparison.table())
    assert f"{low:.3f} to {high:.3f} ({difference.freedom[2]:.3g})" in console.file.getvalue()
    texts = [text.get_text() for axes in comparison.plot().axes for text in axes.texts]
    assert f"{difference.freedom[2]:.2g} df" in texts
    best, last = (json.loads(comparison.to_json())["rows"][name] for name in comparison.ranking)
    assert last["difference_to_best"]["interval"] == [low, high]
    assert last["difference_to_best"]["p_value"] == difference.p_value()
    assert best["difference_to_best"]["p_value"] == 1


def test_what_is_unknown_is_not_a_number_and_shown_as_a_dash():
    random = np.random.default_rng(0)
    one_seed, one_clip = record({"a": random.normal(size=(1, 4))}), record({"a": random.normal(size=(2, 4))}, ["c"] * 4)
    assert str(one_seed["a"]["importance bound"]).endswith("± –")
    estimate = one_clip["a"]["importance bound"]
    assert math.isnan(estimate.sequences)
    assert estimate.seeds > 0
    assert math.isnan(estimate.total)


# ----------------------------------------------------------------------------------------------------------- latents


def law(model):
    """Gain, covariance of q(latents | x), and covariance of x, of a linear-Gaussian model."""
    oracle = Oracle(model, T)
    gain, _, root = (part[0] for part in oracle._guide())
    covariance = torch.linalg.inv(oracle._joint()[1])[len(gain) :, len(gain) :]
    return gain.detach(), (root @ root.t()).detach(), covariance.detach()


@pytest.mark.parametrize(("pair", "latent"), [(STATIC, "w"), (MEAN_FIELD, "z")])
def test_information_is_the_mutual_information_of_a_linear_guide(pair, latent):
    model, n = build(pair, scale=0.8), 600
    gain, noise, covariance = law(model)
    told = (gain @ covariance * gain).sum(1) / noise.diagonal()  # signal to noise of each scalar latent
    found = run({"a": model}, draws(model, n), particles=1, contrasts=n).rows["a"].information[latent][0]
    exact = 0.5 * torch.log1p(told)
    # The log-ratio of two jointly normal numbers of correlation r has variance r^2 (1 - r^2 = exp(-2 information)).
    error = torch.sqrt((1 - torch.exp(-2 * exact)) / n)
    assert found.shape == exact.shape
    assert (exact > 0.1).all()
    assert (np.abs(found - exact.numpy()) < 4 * error.numpy()).all()


def test_information_is_at_most_the_log_of_the_contrasts():
    model = build(STATIC, x=3)
    with torch.no_grad():
        model.encoder["w"].law.log_scale.fill_(-9.0)  # the latent tells every sequence apart
    x = draws(model, 40)
    assert run({"a": model}, x, contrasts=10).rows["a"].information["w"][0] == pytest.approx(math.log(10))
    assert run({"a": model}, x, contrasts=1).rows["a"].information["w"][0] == pytest.approx(0)
    assert run({"a": model}, x, contrasts=0).rows["a"].information == {}


def collapsed():
    """A model whose guide is its prior."""
    model = build(fitted=False, z=2)
    with torch.no_grad():
        prior, guide = model.generator["z"], model.encoder["z"]
        guide.network.weights["x"].zero_()
        guide.network.weights["z"].copy_(prior.network.weights["z"])
        guide.network.bias.copy_(prior.network.bias)
        guide.law.log_scale.copy_(prior.law.log_scale)
    return model


def test_a_collapsed_latent_tells_nothing_and_has_no_active_unit():
    model = collapsed()
    result = run({"a": model}, draws(model, 300))
    row = result.rows["a"]
    assert np.abs(row.information["z"]).max() < 1e-9
    assert np.abs(row.bounds["KL z"]).max() < 1e-9
    assert row.active_units["z"].tolist() == [0]
    assert "0 of 2" in str(result)


def test_variance_of_the_posterior_mean_is_that_of_the_exact_one():
    """The guide's conditional means also vary with its own draws, by more; that is taken out."""
    model, n = build(z=2), 400
    x = draws(model, n)
    gain, noise, _ = law(model)
    exact = (x.flatten(1) @ gain.t()).unflatten(1, (T, 2)).var(0).mean(0)
    found = run({"a": model}, x, particles=1).rows["a"].variances["z"][0]
    # What is left of the draws: N T means over 8, each with no more than the guide's variance.
    spread = noise.diagonal().max() / 8
    error = 4 * torch.sqrt((4 * exact * spread + 2 * spread**2) / n)
    assert (np.abs(found - exact.numpy()) < error.numpy()).all()


def test_a_clock_that_all_sequences_share_is_no_activity():
    model = collapsed()
    with torch.no_grad():
        for side in (model.generator, model.encoder):
            side["z"].network.bias.copy_(10.0 * torch.arange(T, dtype=torch.float64)[:, None].expand(T, 2))
    assert run({"a": model}, draws(model, 200)).rows["a"].active_units["z"].tolist() == [0]


def test_a_model_without_use_of_its_latents_is_compared_all_the_same():
    model = collapsed()
    with torch.no_grad():
        model.generator["x"].network.weights["z"].zero_()  # all importance weights are then the same
    x = draws(model, 8)
    evidence = Oracle(model, T).evidence(x).mean().item() / T
    assert run({"a": model}, x)["a"]["importance bound"].mean == pytest.approx(evidence)


# -------------------------------------------------------------------------------------------------------------- data


def recurrent(**options):
    return DynamicalVAE(
        "p(w) p(z_t | z_{t-1}, w) p(x_t | x_{t-1}, z_t)",
        "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{1:T}, w)",
        {"w": 2, "z": 2, "x": 3},
        dvae.networks.Recurrent(4),
        **options,
    ).double()


def test_ragged_sequences_are_weighed_by_their_frames():
    model, lengths = recurrent(), torch.tensor([7, 2, 4, 7, 1, 3])
    x = torch.randn(6, 7, 3, dtype=torch.float64)
    result = run({"a": model}, {"x": x, "lengths": lengths}, contrasts=6)
    row = result.rows["a"]
    assert result.frames.tolist() == lengths.tolist()
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


def test_arrays_masks_and_context_are_data_too():
    model = DynamicalVAE(
        "p(z_t | z_{t-1}, c_t) p(x_t | z_t)",
        "q(z_t | z_{t-1}, x_{1:T}, c_t)",
        {"z": 2, "x": 3, "c": 1},
        dvae.networks.Recurrent(4),
    )
    random = np.random.default_rng(0)
    batch = {
        "x": random.normal(size=(5, 6, 3)).astype(np.float32),
        "c": random.normal(size=(5, 6, 1)).astype(np.float32),
        "mask": random.random((5, 6, 3)) < 0.8,
    }
    assert math.isfinite(run({"a": model}, batch)["a"]["importance bound"].mean)
    x = batch["x"]
    plain = recurrent().float()
    assert scores(run({"a": plain}, x), "a") == scores(run({"a": plain}, torch.from_numpy(x)), "a")


def test_the_fingerprint_is_of_all_that_a_batch_holds():
    x = torch.randn(4, T, 2, dtype=torch.float64)
    lengths, mask = torch.tensor([T, T, 3, T]), torch.ones(4, T, 2, dtype=torch.bool)
    mask[0, 0] = False
    batches = [
        {"x": x},
        {"x": x + 1},
        {"x": x, "lengths": lengths},
        {"x": x, "lengths": lengths.flip(0)},
        {"x": x, "mask": mask},
        {"x": x, "c": x},
        {"x": x, "c": -x},
    ]
    plain = build(fitted=False)
    driven = DynamicalVAE(
        "p(z_t | c_t) p(x_t | z_t)", "q(z_t | x_t, c_t)", {"z": 1, "x": 2, "c": 2}, dvae.networks.Dense(())
    ).double()
    found = [
        run({"a": driven if "c" in batch else plain}, batch, particles=1, contrasts=0).data["fingerprint"]
        for batch in batches
    ]
    assert len(set(found)) == len(batches)
    assert run({"a": plain}, x, particles=1, contrasts=0).data["fingerprint"] == found[0]


def test_of_a_single_sequence_no_unit_is_known_to_be_active():
    model = build(fitted=False, z=2)
    result = run({"a": model}, draws(model, 1))
    assert np.isnan(result.rows["a"].active_units["z"]).all()
    assert "of 2" not in str(result)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m, x: run({}, x), "no models"),
        (lambda m, x: run({"a": []}, x), "'a' has no model"),
        (lambda m, x: run({"a": m}, x, particles=0), "at least 1"),
        (lambda m, x: run({"a": m}, x, contrasts=-1), "at least 0"),
        (lambda m, x: run({"a": m}, x[0]), "expected .sequences, frames, features"),
        (lambda m, x: run({"a": [m, build(z=2, fitted=False)]}, x), "differ in their seed only"),
        (lambda m, x: run({"a": m}, x[..., :1]), r"x has shape .* expected"),
        (lambda m, x: run({"a": m}, x[:0]), "at least one"),
    ],
)
def test_what_cannot_be_compared_is_refused(call, message):
    model = build(fitted=False)
    with pytest.raises(ValueError, match=message):
        call(model, draws(model, 4))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m, x: run(m, x), "a mapping such as"),
        (lambda m, x: run({"a": nn.Linear(2, 2)}, x), "holds a Linear"),
        (lambda m, x: run({"a": 3}, x), "'a' is a int; expected a DynamicalVAE, or a list of them"),
        (lambda m, x: run({"a": m}, "x"), "got str"),
    ],
)
def test_other_kinds_are_refused(call, message):
    model = build(fitted=False)
    with pytest.raises(TypeError, match=message):
        call(model, draws(model, 4))


def test_a_bound_that_is_not_finite_names_model_and_sequence():
    model = build(fitted=False)
    x = draws(model, 4)
    x[2] *= 1e200
    with pytest.raises(FloatingPointError, match=r"bound of wild is not finite .* clip '2'"):
        run({"wild": model}, x)


def test_ragged_windows_are_refused_before_any_bound_is_computed():
    windows = ArrayWindows(torch.zeros(4, T, 2), 2)
    ragged = SimpleNamespace(
        protocol=windows.protocol,
        keys=windows.keys,
        fingerprint="",
        description={},
        all=lambda: {**windows.all(), "lengths": torch.full((4,), T)},
    )
    with pytest.raises(ValueError, match="windows of one length, but these have lengths"):
        run({"a": recurrent()}, ragged, samples=2)


def test_whole_sequences_have_bounds_and_no_forecasts():
    values = np.random.default_rng(0).normal(size=(8, 9, 3))
    ragged = [own[: 5 + n % 3] for n, own in enumerate(values)]
    columns = Columns(tuple(Column(name) for name in "abc"))
    whole = PanelData.of(ragged, columns, Cut()).windows("test")
    even = PanelData.of(values, columns, Cut()).windows("test")
    models = {name: recurrent().float() for name in "ab"}
    found, bare = run(models, whole, samples=5, contrasts=2), run(models, whole.all(), contrasts=2)
    assert found.samples == 0
    assert found.ranking == bare.ranking
    for name in models:
        for metric in ("importance bound", "ELBO", "KL z"):
            assert found[name][metric].mean == bare[name][metric].mean
        np.testing.assert_array_equal(found.rows[name].bounds["k-hat"], bare.rows[name].bounds["k-hat"])
    for text in (str(found), str(type(found).from_json(found.to_json()))):
        assert "no forecasts: whole sequences have no future" in text
        assert "2 whole sequences · seed 0" in text
    for windows in (whole, even):
        with pytest.raises(ValueError, match=r"whole sequences have no future; .* compare compares bounds"):
            evaluate(models, windows, progress=False)


# ----------------------------------------------------------------------------------------------------------- records


def test_a_comparison_comes_back_from_json_with_all_that_it_says(fitted, tmp_path):
    models, x = fitted
    windows = ArrayWindows(x, 3, clips=["a"] * 12 + ["b"] * 12)
    result = run(models, windows, samples=2, particles=4, configs={"dkf": {"latent": 1}})
    result.save(tmp_path / "comparison.json")
    again = Comparison.load(tmp_path / "comparison.json")
    assert again.to_json() == result.to_json()
    assert str(again) == str(result)
    assert again.difference("dkf", "mean field") == result.difference("dkf", "mean field")
    document = json.loads(result.to_json())
    assert document["ranking"] == result.ranking
    assert document["data"]["fingerprint"] == windows.fingerprint
    assert document["protocol"]["observed"] == 3
    row = document["rows"]["dkf"]
    assert row["config"] == {"latent": 1}
    assert row["equations"]["generative"] == models["dkf"][0].generative.text
    assert row["khat_above_0.7"] is None  # four particles have no tail
    assert row["scores"]["importance bound"]["seeds"] == pytest.approx(result["dkf"]["importance bound"].seeds)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"ranking": [], "rows": {"a": {}}}'])
def test_other_documents_are_not_comparisons(text):
    with pytest.raises(ValueError, match="not a comparison"):
        Comparison.from_json(text)


def test_unknown_names_are_answered_with_the_known_ones(fitted):
    models, x = fitted
    result = run(models, x)
    with pytest.raises(KeyError, match="no model 'vae' in this comparison; it has dkf, mean field"):
        result.difference("dkf", "vae")
    with pytest.raises(KeyError, match="'dkf' has no score 'ADE'; it has ELBO"):
        result.difference("dkf", "mean field", "ADE")


def test_table_and_plot_show_every_model_in_the_order_of_the_ranking(fitted):
    models, x = fitted
    result = run(models, ArrayWindows(x, 3), samples=2)
    text = str(result)
    for part in (
        "K = 32",
        "difference to the best",
        "seeds",
        "teacher-forced",
        "free-running",
        "ADE",
        "at most log 16",
    ):
        assert part in text
    assert text.index(result.ranking[0]) < text.index(result.ranking[1])
    assert str(result["dkf"]["importance bound"]) in text
    assert "free-running" not in str(run(models, x))
    panels = [axes for axes in result.plot().axes if axes.axison]
    assert [label.get_text() for label in panels[0].get_yticklabels()] == result.ranking
    assert [axes.get_title() for axes in panels[2:]] == ["Pareto k-hat of the weights", "KL of z over time"]


def with_khat(result, **khats):
    """The comparison with other k-hats."""
    rows = {
        name: dataclasses.replace(row, bounds={**row.bounds, "k-hat": np.array(khats[name])[None]})
        if name in khats
        else row
        for name, row in result.rows.items()
    }
    return dataclasses.replace(result, rows=rows)


@pytest.mark.parametrize(
    ("khat", "share"),
    [
        (np.full(24, 5.0), 1),
        (np.full(24, math.inf), 1),
        (np.r_[np.full(6, 5.0), np.linspace(-2, 1, 18)], 0.25),
        (np.r_[math.nan, np.linspace(0, 0.5, 23)], 0),
    ],
)
def test_every_model_with_a_khat_has_its_curve_in_view(fitted, khat, share):
    models, x = fitted
    result = with_khat(run(models, x), dkf=khat)
    figure = result.plot()
    figure.savefig(io.BytesIO())
    panel = next(axes for axes in figure.axes if "k-hat" in axes.get_title())
    left, right = panel.get_xlim()
    assert left <= 0 < 1 <= right <= 3
    assert len(panel.lines) == 3  # two models and the threshold
    said = [text.get_text() for text in panel.get_legend().get_texts()] if panel.get_legend() else []
    assert said == ([f"{100 * share:g} % beyond 3"] if share else [])


@pytest.mark.parametrize("least", [1e-4, 0.0, -1e-6])
def test_a_large_kl_at_the_first_step_hides_no_other(fitted, least):
    models, x = fitted
    result = run(models, x)
    rows = {}
    for name, row in result.rows.items():
        steps = np.full(row.kl_steps["z"].shape, 0.01)
        steps[:, 0], steps[:, -1] = 50, least
        rows[name] = dataclasses.replace(row, kl_steps={"z": steps})
    figure = dataclasses.replace(result, rows=rows).plot()
    figure.savefig(io.BytesIO())
    panel = next(axes for axes in figure.axes if "KL" in axes.get_title())
    low, high = panel.transAxes.inverted().transform(panel.transData.transform([(1, 0.01), (1, 50)]))[:, 1]
    assert 0.02 < low < high - 0.3
    assert high < 1


def test_infinite_khats_come_back_from_json_as_unreliable(fitted):
    models, x = fitted
    khat = np.r_[np.full(6, math.inf), np.zeros(18)]
    result = with_khat(run(models, x), dkf=khat)
    again = Comparison.from_json(result.to_json())
    np.testing.assert_array_equal(again.rows["dkf"].bounds["k-hat"], khat[None])
    assert again.rows["dkf"].unreliable == result.rows["dkf"].unreliable == 0.25


def test_joined_rows_are_those_of_one_comparison(fitted):
    models, x = fitted
    dkf, other = (run({name: model}, x) for name, model in models.items())
    assert dkf.join(other).to_json() == run(models, x).to_json()
    assert Comparison.from_json(dkf.to_json()).join(other).to_json() == run(models, x).to_json()
    for options in ({"seed": 1}, {"particles": 25}, {"contrasts": 8}):
        with pytest.raises(ValueError, match=f"not in {next(iter(options))}"):
            dkf.join(run({"b": models["dkf"]}, x, **options))
    with pytest.raises(ValueError, match="not in data"):
        dkf.join(run({"b": models["dkf"]}, x + 1))
    with pytest.raises(ValueError, match="both comparisons have a model dkf"):
        dkf.join(dkf)


@pytest.mark.parametrize("width", [80, 400])
def test_names_stand_in_tables_as_they_were_given_and_numbers_whole(fitted, width):
    models, x = fitted
    names = ["q(z) [full]", "srnn (" + ", ".join(f"option_{i} {i}.0" for i in range(12)) + ")"]
    result = run(dict(zip(names, models.values(), strict=True)), ArrayWindows(x, 3), samples=2)
    console = Console(file=io.StringIO(), width=width, force_jupyter=False)
    console.print(result.table())
    printed = console.file.getvalue()
    assert (names[0] if width == 400 else "[full]") in printed
    assert "…" not in printed
    for name in names:
        bound = result[name]["importance bound"]
        for part in (bound.mean, bound.sequences, bound.seeds):
            assert f"{part:.3f}" in printed
    result.plot().savefig(io.BytesIO())  # names that leave no room for the panels would warn
    evaluation = evaluate({names[0]: models["dkf"][0]}, ArrayWindows(x, 3), samples=2, references=False, progress=False)
    assert names[0] in str(evaluation)


# Of so few draws as 100 the diagnosis warns without cause; see `Comparison.to_arviz`.
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
        bound = result[name]["importance bound"].mean * result.frames.sum()
        # p is Monte Carlo error alone; of an exact guide it is 0, which leaves the rounding of sums of estimates
        rounding = 24 * 100 * np.finfo(float).eps * abs(bound)
        assert loo.elpd == pytest.approx(bound, abs=3 * loo.p + rounding)
        assert loo.p < 0.5
        assert tree["constant_data"]["khat"].dims == ("seed", "sequence")
    with pytest.raises(ValueError, match="at least 25, but this comparison has 1"):
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


CHEAP = ["--particles", "25", "--contrasts", "4"]


def test_runs_that_differ_in_the_seed_only_are_seeds_of_one_row(runs, capsys, tmp_path):
    paths = [str(runs / name) for name in ("a0", "b", "a1", "c")]
    out, figure = tmp_path / "comparison.json", tmp_path / "comparison.png"
    arguments = [*paths, *CHEAP, "--samples", "2", "--out", str(out), "--figure", str(figure)]
    assert main(["compare", *arguments]) == 0
    printed = capsys.readouterr().out
    for part in ("vae (latent 2)", "vae (latent 3)", "dkf", "K = 25", "free-running", "ADE"):
        assert part in printed
    result = Comparison.load(out)
    assert {name: row.seeds for name, row in result.rows.items()} == {
        "vae (latent 2)": 2,
        "vae (latent 3)": 1,
        "dkf": 1,
    }
    assert result.rows["dkf"].config["method"]["latent"] == 2
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_forecasts_can_be_left_out_and_wrong_arguments_are_refused(runs, capsys):
    a0, a1 = str(runs / "a0"), str(runs / "a1")
    assert main(["compare", a0, a1, *CHEAP, "--no-forecasts"]) == 0
    assert "free-running" not in capsys.readouterr().out
    for arguments, message in (
        ([], "at least one run"),
        ([a0, a0], "named twice"),
        ([a0, "--particles", "0"], "--particles is 0"),
        ([a0, "--figure", "plot.xyz"], "the end of the name is the format"),
    ):
        assert main(["compare", *arguments]) == 2
        assert message in capsys.readouterr().err
    copy = runs / "copy"
    copy.symlink_to(runs / "a0")
    assert main(["compare", a0, str(copy)]) == 2
    assert "the same fit with the same seed" in " ".join(capsys.readouterr().err.split())


def fit_small(runs, out, *options):
    base = ["--batch-size", "4", "--warm-up", "2", "--validate-every", "2", "--latent", "2"]
    assert main(["fit", "vae", "--data", str(runs / "people.npz"), "--out", str(out), *base, *options]) == 0
    return str(out)


def test_rows_of_one_method_are_named_by_the_options_that_differ(runs, capsys, tmp_path):
    fits = {steps: fit_small(runs, tmp_path / f"run{steps}", "--steps", steps) for steps in ("2", "3")}
    fed = fit_small(runs, tmp_path / "fed", "--steps", "3", "--seed", "1", "--self-feeding", "0.5")
    capsys.readouterr()
    fast = [*CHEAP, "--no-forecasts", "--stride", "60", "--out"]
    for given, names in (
        (fits.values(), ["vae (steps 2)", "vae (steps 3)"]),
        ((fits["3"], fed), ["vae (self_feeding 0.0)", "vae (self_feeding 0.5)"]),
    ):
        out = tmp_path / "comparison.json"
        assert main(["compare", *given, *fast, str(out)]) == 0
        assert list(Comparison.load(out).rows) == names


def test_rows_that_no_option_tells_apart_are_named_by_directory_or_path(runs, capsys, tmp_path):
    """Fits with the same options, one with clips left out, in directories of the same name or of others."""
    paths = [tmp_path / place for place in ("one/run", "other/run", "other/again")]
    for path, skip_bad in zip(paths, (False, True, False), strict=True):
        shutil.copytree(runs / "a0", path)
        config = json.loads((path / "config.json").read_text())
        config["data"]["skip_bad"] = skip_bad
        (path / "config.json").write_text(json.dumps(config))
    out = tmp_path / "comparison.json"
    fast = [*CHEAP, "--no-forecasts", "--stride", "60", "--out", str(out)]
    assert main(["compare", *map(str, paths[1:]), *fast]) == 0
    assert list(Comparison.load(out).rows) == ["vae (run)", "vae (again)"]
    assert main(["compare", *map(str, paths[:2]), *fast]) == 0
    assert list(Comparison.load(out).rows) == [f"vae ({path})" for path in paths[:2]]


def test_a_run_that_has_not_ended_is_no_seed(runs, capsys, tmp_path):
    path = tmp_path / "stopped"
    shutil.copytree(runs / "a1", path)
    state = json.loads((path / "state.json").read_text())
    (path / "state.json").write_text(json.dumps({**state, "status": "interrupted", "step": 2}))
    sentence = f"{path} has not ended (interrupted at step 2 of 4); continue it with: dvae resume {path}"
    assert main(["compare", str(runs / "a0"), str(path)]) == 1
    assert sentence in capsys.readouterr().err.replace("\n", " ")
    assert main(["evaluate", str(path), "--samples", "1"]) == 0
    assert f"note: {sentence}" in capsys.readouterr().err.replace("\n", " ")
    few = ["--simulations", "20", "--draws", "19", "--ranked-steps", "1", "--samples", "19"]
    assert main(["criticise", str(path), *few]) == 0
    assert f"note: {sentence}" in capsys.readouterr().err.replace("\n", " ")


REFUSING = {
    **dict.fromkeys(("evaluate", "criticise", "reference", "tubes", "bracket", "compare"), ".json"),
    **dict.fromkeys(("forecast", "complete", "impute"), ".npz"),
    **dict.fromkeys(("animate", "report"), ".html"),
}


@pytest.mark.parametrize("command", REFUSING)
def test_a_failed_run_is_refused(runs, capsys, tmp_path, command):
    path, out = tmp_path / "failed", tmp_path / f"out{REFUSING[command]}"
    shutil.copytree(runs / "a1", path)
    state = json.loads((path / "state.json").read_text())
    (path / "state.json").write_text(json.dumps({**state, "status": "failed", "step": 0}))
    asked = [command, str(path), "--out", str(out)]
    assert main(asked) == 1
    error = capsys.readouterr().err.replace("\n", " ")
    if command != "compare":
        assert f"{path} has not ended (failed at step 0 of 4); its weights are the initial ones" in error
    assert f"at a lower learning rate with: dvae resume {path} --learning-rate 0.0001" in error
    assert not out.exists()
    if command == "forecast":
        assert main([*asked, "--failed", "--samples", "1"]) == 0
        assert "note: " in capsys.readouterr().err
        assert np.load(out)["emission"] == "drawn"
        with pytest.warns(UserWarning, match="failed at step 0 of 4"):
            dvae.load(path)


def test_a_stray_file_is_named(runs, capsys, tmp_path):
    (tmp_path / "notes.txt").write_text("of no use")
    assert main(["compare", str(runs / "a0"), str(tmp_path / "notes.txt")]) == 1
    assert "notes.txt is a file and no run directory; leave it out" in capsys.readouterr().err


def test_runs_of_other_windows_are_not_compared(runs, capsys, tmp_path):
    motion.save(tmp_path / "few.npz", motion.simulate(clips=12, frames=90, seed=2))
    other = ["--data", str(tmp_path / "few.npz"), "--out", str(tmp_path / "other")]
    assert main(["fit", "vae", *other, "--steps", "2", "--batch-size", "2", "--warm-up", "1"]) == 0
    assert main(["compare", str(runs / "a0"), str(tmp_path / "other")]) == 1
    assert "other test windows" in " ".join(capsys.readouterr().err.split())


def test_many_models_are_compared_by_the_metric_and_its_direction():
    random = np.random.default_rng(0)
    values = {name: mean + 0.1 * random.standard_normal((3, 12)) for name, mean in (("a", 0.0), ("b", 1.0), ("c", 5.0))}
    found = record(values)
    assert found.confidence_set().members == ["c"]  # of bounds the higher is better
    assert found.pairs().differences["a", "c"] == found.difference("a", "c")
    assert all(p < 0.01 for p in found.pairs().p_values.values())
    assert found.required("b", "a").achieved > 0.9
    with pytest.raises(KeyError, match="no score 'ADE'"):
        found.confidence_set("ADE")
