"""Mix-and-Match and three alternatives: their contract, the use of noise, and the diversity of codes."""

from typing import ClassVar

import numpy as np
import pytest
import torch
from pyro import poutine

import dvae
from dvae import motion
from dvae.distributions import Subset
from dvae.models.motion.codes import CodeDiversity, CodeScores, code_scores, codes
from dvae.models.motion.mix_and_match import _unrotated_positions
from dvae.motion.geometry.views import ROTATIONS
from dvae.networks.noise import MixAndMatch
from dvae.testing import FactorizationContract


def small(**options):
    return dvae.method("mix-and-match", **{"width": 24, **options})


class Contract(FactorizationContract):
    options: ClassVar = {}
    missing: ClassVar = {}

    def build(self, size):
        return small(**self.options).build({"x": size})


class TestMixAndMatchWithAnotherLatentSize(Contract):
    options: ClassVar = {"latent": 3, "velocity": True, "alpha": 0.3}


class TestAdded(Contract):
    options: ClassVar = {"noise": "add"}
    missing: ClassVar = {"z": ("h", "x_{1:T}")}


class TestLatentForEachStep(Contract):
    options: ClassVar = {"noise": "step", "latent": 3, "velocity": True}


@pytest.fixture
def windows(quaternions):
    return quaternions


def build_model(windows, **options):
    torch.manual_seed(0)
    return small(**options).build(windows["train"]).eval()


def past(windows, rows=4):
    batch = windows["test"].all()
    return {"x": batch["x"][:rows, :5], "view_inputs": {ROTATIONS: batch["view_inputs"][ROTATIONS][:rows, :5]}}


# -------------------------------------------------------------------------------------------------- the drawn indices


@pytest.mark.parametrize(("share", "size", "count"), [(0, 7, 0), (0.3, 10, 3)])
def test_all_subsets_of_a_share_are_equally_probable(share, size, count):
    distribution = Subset(share).distribution(size)
    draws = distribution.sample((4000,))
    assert (draws.sum(-1) == count).all()
    np.testing.assert_allclose(draws.mean(0), count / size, atol=0.04)
    different = np.unique(draws.numpy(), axis=0)
    np.testing.assert_allclose(distribution.log_prob(draws).exp() * len(different), 1, rtol=1e-5)
    assert distribution.log_prob(1 - draws[0]) == -torch.inf


def test_model_and_guide_share_indices_without_a_kl_term(windows):
    model, batch = build_model(windows), windows["train"].sample(6, torch.Generator().manual_seed(0))
    guide = poutine.trace(model.guide).get_trace(batch)
    trace = poutine.trace(poutine.replay(model.model, guide)).get_trace(batch)
    indices = trace.nodes["i"]["value"]
    assert indices is guide.nodes["i"]["value"]
    assert indices.shape == (24,)  # no batch dimension, and outside the plate
    assert [frame.name for frame in trace.nodes["i"]["cond_indep_stack"]] == []
    trace.compute_log_prob()
    guide.compute_log_prob()
    assert trace.nodes["i"]["log_prob"] == guide.nodes["i"]["log_prob"]
    torch.manual_seed(0)
    terms = dvae.SequenceELBO(num_particles=2).terms(model, batch)
    assert set(terms.kl) == {"z"}
    assert dvae.iwae_bound(model, batch, particles=3).bound.shape == (6,)


# ---------------------------------------------------------------------------------------------------------- noise


def test_alpha_0_and_alpha_1_make_the_model_deterministic(windows):
    for alpha in (0.0, 1.0):
        futures = build_model(windows, alpha=alpha).forecast(past(windows), 6, samples=3)["x"]
        torch.testing.assert_close(futures, futures[:1].expand_as(futures))
    futures = build_model(windows, alpha=0.5).forecast(past(windows), 6, samples=3)["x"]
    assert futures.std(0).min() > 0


def test_noise_changes_only_the_selected_units():
    torch.manual_seed(0)
    noise = MixAndMatch(0.25)
    decoder = noise.decoder(8, noise.latent(8)).eval()
    decoder.last = torch.nn.Identity()
    code, z, is_selected = torch.randn(3, 8), torch.randn(3, 6), noise.indices.distribution(8).sample()
    perturbed = decoder(code, z, is_selected.expand(3, -1))
    same = perturbed == code
    assert (same == (is_selected == 0)).all()
    jacobian = torch.autograd.functional.jacobian(lambda z: decoder(code, z, is_selected.expand(3, -1)).sum(0), z)
    assert (jacobian[is_selected == 0] == 0).all()
    assert (jacobian[is_selected == 1].abs().sum((1, 2)) > 0).all()


def test_the_loss_adds_errors_of_quaternions_and_positions_and_the_annealed_kl(windows):
    """L_rot + L_skl, each the mean over its numbers, in units of D / 2 scale^2."""
    method = small(skeleton=0.5)
    model = method.build(windows["train"]).eval()
    batch = windows["train"].sample(5, torch.Generator().manual_seed(0))
    objective = method.train(windows["train"], steps=40).objective
    torch.manual_seed(0)
    terms = dvae.SequenceELBO().terms(model, batch)
    torch.manual_seed(0)
    guide = poutine.trace(model.guide).get_trace(batch)
    trace = poutine.trace(poutine.replay(model.model, guide)).get_trace(batch)
    sequence, data = trace.nodes["x"]["fn"], model.read(batch)
    means = sequence.rollout.parameters("x", data["x"])[0]
    size, lengths = model.sizes["x"], data["bone_lengths"]
    rotations = (means - data["x"]).square().mean()
    positions = (
        (
            _unrotated_positions(means, lengths, model.rotations)
            - _unrotated_positions(data["x"], lengths, model.rotations)
        )
        .square()
        .mean()
    )
    errors = size / (2 * 0.01**2) * (rotations + 0.5 * positions)
    constant = size * (np.log(0.01) + 0.5 * np.log(2 * np.pi))
    kl = (terms.kl["z"].sum() / terms.n_steps.sum()).detach()
    for step, weight in ((0, 0.0), (10, 0.5), (39, 1.0)):
        expected = errors + constant + weight * kl
        torch.testing.assert_close(objective(terms, step), expected, rtol=1e-5, atol=0.02 * float(kl))


def test_the_loss_of_the_paper_has_means_of_squared_errors_and_the_kl_of_a_window(windows):
    """L_rot + L_skl + lambda KL; the constant of the likelihood does not depend on the parameters."""
    method = small(kl=0.7)
    torch.manual_seed(0)
    model = method.build(windows["train"]).eval()
    batch = windows["train"].sample(5, torch.Generator().manual_seed(0))
    objective = method.train(windows["train"], steps=40).objective
    torch.manual_seed(0)
    terms = dvae.SequenceELBO().terms(model, batch)
    torch.manual_seed(0)
    guide = poutine.trace(model.guide).get_trace(batch)
    trace = poutine.trace(poutine.replay(model.model, guide)).get_trace(batch)
    data = model.read(batch)
    means = trace.nodes["x"]["fn"].rollout.parameters("x", data["x"])[0]
    places = [_unrotated_positions(x, data["bone_lengths"], model.rotations) for x in (means, data["x"])]
    errors = (means - data["x"]).square().mean() + (places[0] - places[1]).square().mean()
    size = model.sizes["x"]
    constant = 0.5 * size * np.log(np.pi * size)
    for step, weight in ((0, 0.0), (10, 0.35), (39, 0.7)):
        expected = errors + weight * terms.kl["z"].mean()
        torch.testing.assert_close(objective(terms, step) - constant, expected, rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match="both set the weight of the KL"):
        small(kl=1.0, scale=0.1)


@pytest.mark.parametrize("noise", ["mix", "add"])
def test_each_use_of_noise_is_trained_and_scored_in_metres(windows, noise):
    method = small(noise=noise)
    model = method.build(windows["train"])
    recipe = method.train(windows["train"], windows["test"], steps=6)
    result = dvae.fit(model, recipe, batch_size=4, validate_every=3, log_every=1, progress=False)
    rows = [row for row in result.history if "loss" in row]
    assert all(np.isfinite(row["loss"]) for row in rows)
    assert [row.get("curriculum") for row in rows][:3] == ([0.0, 1 / 3, 2 / 3] if noise == "mix" else [None] * 3)
    assert rows[0]["energy/skeleton"] > 0
    if noise == "add":
        assert rows[-1]["kl/z"] == 0
    table = dvae.evaluate(model, windows["test"], scores=motion.scores, samples=3, progress=False)
    assert np.isfinite(table["model"]["ADE"].mean)
    assert table["model"]["limb stretch"].mean < 1e-3


# -------------------------------------------------------------------------------------------- the diversity of codes


@pytest.mark.parametrize("noise", ["mix", "concatenate", "add", "step"])
def test_the_codes_are_those_of_the_forecasts(windows, noise):
    """With a latent for each step, the first pose is linear in the code; otherwise the decoder starts from the code."""
    model = build_model(windows, noise=noise)
    torch.manual_seed(1)
    code_samples = codes(model, past(windows), 3)
    torch.manual_seed(1)
    forecast = model.forecast(past(windows), 1, 3)
    assert code_samples.shape == (3, 4, 24)
    network, data = model.generator["x"].network, model.read(past(windows))
    last = data["h"][:, -model.sizes["x"] :]
    for code, x in zip(code_samples, forecast["x"], strict=True):
        state = code if noise == "step" else network.cell(last[:, None], code[None].contiguous())[0][:, 0]
        decoded = model.to_data_space({"x": network.out(state)[:, None]}, data)["x"]
        torch.testing.assert_close(decoded, x, atol=1e-6, rtol=1e-5)


def test_the_diversity_of_codes_is_a_result_that_can_be_saved(windows, tmp_path):
    models = {noise: build_model(windows, noise=noise) for noise in ("mix", "concatenate")}
    scores = code_scores(models, past(windows), samples=5, untrained={"mix": models["mix"]})
    assert scores.rows["mix"].keys() == {"codes", "same indices", "untrained"}
    assert scores.rows["concatenate"].keys() == {"codes"}  # it draws no indices
    np.testing.assert_array_equal(scores.rows["mix"]["untrained"], scores.rows["mix"]["codes"])
    assert scores.rows["mix"]["same indices"].mean() < scores.rows["mix"]["codes"].mean()
    scores.save(tmp_path / "codes.json")
    assert str(CodeScores.load(tmp_path / "codes.json")) == str(scores)
    with pytest.raises(ValueError, match="at least two observations"):
        code_scores(models, past(windows, 1))


def test_the_diversity_of_codes_is_logged_and_does_not_change_training(windows, tmp_path):
    method = small(width=8)
    recipe = method.train(windows["train"], windows["test"], steps=6)
    options = {"batch_size": 4, "validate_every": 3, "log_every": 3, "progress": False, "accelerator": "cpu"}

    def fit(**more):
        torch.manual_seed(0)
        return dvae.fit(method.build(windows["train"]), recipe, **options, **more)

    watch = CodeDiversity(past(windows), every=2, samples=5)
    plain, watched = fit(), fit(out=tmp_path / "run", callbacks=[watch])
    steps, means = watched.series("codes/diversity")
    assert steps == [2, 4, 6]
    assert min(watched.series("codes/latent")[1]) > 0
    assert [row for row in watched.history if "codes/diversity" not in row] == plain.history
    log = (tmp_path / "run" / "log.jsonl").read_text()
    assert log.count("codes/deviation") == 3
    assert np.isfinite(means).all()
    assert min(means) > 0
