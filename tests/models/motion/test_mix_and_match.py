"""Mix-and-Match and the three ways it compares with: their contract, how noise enters, what codes differ by."""

from typing import ClassVar

import numpy as np
import pytest
import torch
from pyro import poutine

import dvae
from dvae import motion
from dvae.distributions import Subset
from dvae.models.motion.codes import CodeDiversity, codes
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


class TestMixAndMatchWithALatentOfAnotherSize(Contract):
    options: ClassVar = {"latent": 3, "velocity": True, "alpha": 0.3}


class TestAdded(Contract):
    options: ClassVar = {"noise": "add"}
    missing: ClassVar = {"z": ("h", "x_{1:T}")}


class TestALatentForEachStep(Contract):
    options: ClassVar = {"noise": "step", "latent": 3, "velocity": True}


@pytest.fixture
def windows(quaternions):
    return quaternions


def made(windows, **options):
    torch.manual_seed(0)
    return small(**options).build(windows["train"]).eval()


def past(windows, rows=4):
    batch = windows["test"].all()
    return {"x": batch["x"][:rows, :5], "view_inputs": {ROTATIONS: batch["view_inputs"][ROTATIONS][:rows, :5]}}


# -------------------------------------------------------------------------------------------------- the drawn indices


@pytest.mark.parametrize(("share", "size", "chosen"), [(0, 7, 0), (0.3, 10, 3)])
def test_a_subset_has_its_share_of_indices_all_alike_often(share, size, chosen):
    distribution = Subset(share).distribution(size)
    drawn = distribution.sample((4000,))
    assert (drawn.sum(-1) == chosen).all()
    np.testing.assert_allclose(drawn.mean(0), chosen / size, atol=0.04)
    different = np.unique(drawn.numpy(), axis=0)
    np.testing.assert_allclose(distribution.log_prob(drawn).exp() * len(different), 1, rtol=1e-5)
    assert distribution.log_prob(1 - drawn[0]) == -torch.inf


def test_model_and_guide_share_one_set_of_indices_which_costs_nothing(windows):
    model, batch = made(windows), windows["train"].sample(6, torch.Generator().manual_seed(0))
    guide = poutine.trace(model.guide).get_trace(batch)
    trace = poutine.trace(poutine.replay(model.model, guide)).get_trace(batch)
    drawn = trace.nodes["i"]["value"]
    assert drawn is guide.nodes["i"]["value"]
    assert drawn.shape == (24,)  # of no sequence, and outside the plate
    assert [frame.name for frame in trace.nodes["i"]["cond_indep_stack"]] == []
    trace.compute_log_prob()
    guide.compute_log_prob()
    assert trace.nodes["i"]["log_prob"] == guide.nodes["i"]["log_prob"]
    torch.manual_seed(0)
    terms = dvae.SequenceELBO(num_particles=2).terms(model, batch)
    assert set(terms.kl) == {"z"}
    assert dvae.iwae_bound(model, batch, particles=3).bound.shape == (6,)


# ------------------------------------------------------------------------------------------------ how noise enters


def test_with_alpha_0_the_model_is_deterministic_and_with_1_there_is_no_place_for_noise(windows):
    for alpha in (0.0, 1.0):
        futures = made(windows, alpha=alpha).forecast(past(windows), 6, samples=3)["x"]
        torch.testing.assert_close(futures, futures[:1].expand_as(futures))
    futures = made(windows, alpha=0.5).forecast(past(windows), 6, samples=3)["x"]
    assert futures.std(0).min() > 0


def test_what_was_not_drawn_goes_on_as_it_was():
    torch.manual_seed(0)
    noise = MixAndMatch(0.25)
    decoder = noise.decoder(8, noise.latent(8)).eval()
    decoder.last = torch.nn.Identity()
    code, z, chosen = torch.randn(3, 8), torch.randn(3, 6), noise.indices.distribution(8).sample()
    perturbed = decoder(code, z, chosen.expand(3, -1))
    same = perturbed == code
    assert (same == (chosen == 0)).all()
    jacobian = torch.autograd.functional.jacobian(lambda z: decoder(code, z, chosen.expand(3, -1)).sum(0), z)
    assert (jacobian[chosen == 0] == 0).all()
    assert (jacobian[chosen == 1].abs().sum((1, 2)) > 0).all()


def test_the_loss_is_of_quaternions_and_positions_and_the_annealed_kl(windows):
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
        (_unrotated_positions(means, lengths, model.turns) - _unrotated_positions(data["x"], lengths, model.turns))
        .square()
        .mean()
    )
    errors = size / (2 * 0.01**2) * (rotations + 0.5 * positions)
    constant = size * (np.log(0.01) + 0.5 * np.log(2 * np.pi))
    kl = (terms.kl["z"].sum() / terms.frames.sum()).detach()
    for step, weight in ((0, 0.0), (10, 0.5), (39, 1.0)):
        expected = errors + constant + weight * kl
        torch.testing.assert_close(objective(terms, step), expected, rtol=1e-5, atol=0.02 * float(kl))


@pytest.mark.parametrize("noise", ["mix", "add"])
def test_every_way_is_trained_by_the_shared_loop_and_scored_in_metres(windows, noise):
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
def test_codes_are_those_that_futures_are_made_of(windows, noise):
    """A first pose is linear in the code of a latent for each step; elsewhere the decoder goes on from the code."""
    model = made(windows, noise=noise)
    torch.manual_seed(1)
    found = codes(model, past(windows), 3)
    torch.manual_seed(1)
    forecast = model.forecast(past(windows), 1, 3)
    assert found.shape == (3, 4, 24)
    network, data = model.generator["x"].network, model.read(past(windows))
    last = data["h"][:, -model.sizes["x"] :]
    for code, x in zip(found, forecast["x"], strict=True):
        state = code if noise == "step" else network.cell(last[:, None], code[None].contiguous())[0][:, 0]
        shown = model.to_data_space({"x": network.out(state)[:, None]}, data)["x"]
        torch.testing.assert_close(shown, x, atol=1e-6, rtol=1e-5)


def test_it_is_written_into_the_log_as_a_model_learns_and_changes_nothing(windows, tmp_path):
    method = small(width=8)
    recipe = method.train(windows["train"], windows["test"], steps=6)
    options = {"batch_size": 4, "validate_every": 3, "log_every": 3, "progress": False, "accelerator": "cpu"}

    def fitted(**more):
        torch.manual_seed(0)
        return dvae.fit(method.build(windows["train"]), recipe, **options, **more)

    watch = CodeDiversity(past(windows), every=2, samples=5)
    plain, watched = fitted(), fitted(out=tmp_path / "run", callbacks=[watch])
    steps, means = watched.series("codes/diversity")
    assert steps == [2, 4, 6]
    assert min(watched.series("codes/latent")[1]) > 0
    assert [row for row in watched.history if "codes/diversity" not in row] == plain.history
    log = (tmp_path / "run" / "log.jsonl").read_text()
    assert log.count("codes/deviation") == 3
    assert np.isfinite(means).all()
    assert min(means) > 0
