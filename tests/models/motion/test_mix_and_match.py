"""Mix-and-Match and the three ways it compares with: their contract, and how noise enters each."""

from typing import ClassVar

import numpy as np
import pytest
import torch
from pyro import poutine

import dvae
from dvae import motion
from dvae.data.schema import SchemaError
from dvae.distributions import Subset
from dvae.inference.bounds.predictive import predictive_bound
from dvae.models.motion.mix_and_match import _aligned
from dvae.motion.geometry.views import TURNS
from dvae.networks.noise import CodeDecoder, MixAndMatch, Residual
from dvae.testing import FactorizationContract


def small(**options):
    return dvae.method("mix-and-match", **{"width": 24, **options})


class Contract(FactorizationContract):
    options: ClassVar = {}
    missing: ClassVar = {}

    def build(self, size):
        return small(**self.options).build({"x": size})


class TestMixAndMatch(Contract):
    pass


class TestMixAndMatchWithALatentOfAnotherSize(Contract):
    options: ClassVar = {"latent": 3, "velocity": True, "alpha": 0.3}


class TestConcatenated(Contract):
    options: ClassVar = {"noise": "concatenate"}


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
    return {"x": batch["x"][:rows, :5], "beside": {TURNS: batch["beside"][TURNS][:rows, :5]}}


# -------------------------------------------------------------------------------------------------- the drawn indices


@pytest.mark.parametrize(("share", "size", "chosen"), [(0, 7, 0), (0.3, 10, 3), (0.5, 7, 4), (1, 5, 5)])
def test_a_subset_has_its_share_of_indices_all_alike_often(share, size, chosen):
    torch.manual_seed(0)
    law = Subset(share).distribution(size)
    drawn = law.sample((4000,))
    assert (drawn.sum(-1) == chosen).all()
    np.testing.assert_allclose(drawn.mean(0), chosen / size, atol=0.04)
    different = np.unique(drawn.numpy(), axis=0)
    np.testing.assert_allclose(law.log_prob(drawn).exp() * len(different), 1, rtol=1e-5)
    assert law.log_prob(1 - drawn[0]) == -torch.inf or 2 * chosen == size


def test_a_curriculum_swaps_more_and_more_of_the_first_indices():
    torch.manual_seed(0)
    swapped = [int(Subset(0.5).distribution(40, c).sample()[20:].sum()) for c in (0, 0.25, 0.5, 0.99)]
    assert swapped == [0, 2, 5, 9]
    law = Subset(0.5).distribution(6, 0.8)  # one of three
    sets = np.unique(law.sample((500,)).numpy(), axis=0)
    assert len(sets) == 9
    assert law.log_prob(torch.as_tensor(sets)).exp().sum() == pytest.approx(1)


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
    assert dvae.importance_bound(model, batch, particles=3).bound.shape == (6,)


def test_a_replayed_trace_gives_the_same_futures(windows):
    model, data = made(windows), past(windows)
    trace = poutine.trace(model.model).get_trace(data, length=7, mean_emission=True)
    again = poutine.replay(model.model, trace)(data, length=7, mean_emission=True)
    assert torch.equal(trace.nodes["x"]["value"], again["x"])
    other = model.model(data, length=7, mean_emission=True)
    assert not torch.equal(other["x"], again["x"])


def test_every_sample_of_a_forecast_has_indices_of_its_own_and_every_row_the_same(windows, monkeypatch):
    model, seen = made(windows), []
    run = model.model
    monkeypatch.setattr(model, "model", lambda batch, **options: seen.append(batch["i"]) or run(batch, **options))
    model.forecast(past(windows), 3, samples=5)
    (indices,) = seen
    sets = indices.unflatten(0, (5, 4))
    assert (sets == sets[:, :1]).all()
    assert len(np.unique(sets[:, 0].numpy(), axis=0)) == 5
    model.forecast({**past(windows), "i": indices[:4]}, 3, samples=5)  # as they were given
    assert (seen[1].unflatten(0, (5, 4)) == indices[:4]).all()


def test_what_is_shared_does_not_tell_how_many_sequences_there_are():
    sizes, shared = {"z": 2, "x": 3, "i": 4}, {"i": Subset(0.5)}
    model = dvae.DynamicalVAE("p(z) p(x_t | x_{t-1}, z, i)", "q(z | x_{1:T}, i)", sizes, shared=shared)
    drawn = model.sample(5, length=6)
    assert (drawn["x"].shape, drawn["z"].shape, drawn["i"].shape) == ((5, 6, 3), (5, 2), (5, 4))
    assert (drawn["i"] == drawn["i"][0]).all()
    assert drawn["i"][0].sum() == 2


def test_what_is_shared_may_be_given_as_it_was_drawn(windows):
    model, data = made(windows), past(windows)
    drawn = poutine.trace(model.model).get_trace(data, length=7).nodes["i"]["value"]
    assert torch.equal(model.read({**data, "i": drawn})["i"], drawn.expand(4, -1))
    with pytest.raises(ValueError, match=r"i has shape \(4, 5\), expected \(B, 24\)"):
        model.forecast({**data, "i": torch.ones(5)}, 3)


def test_options_of_drawn_indices_are_refused_where_none_are_drawn():
    for options in ({"noise": "step", "curriculum": 0.9}, {"noise": "add", "alpha": 0.1}):
        with pytest.raises(ValueError, match=r"draws no indices; (alpha|curriculum) is an option of noise='mix'"):
            small(**options)


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


def test_the_guide_reads_the_past_at_drawn_indices_and_the_future_at_the_others():
    torch.manual_seed(0)
    encoder, codes = MixAndMatch(0.5).encoder(6), (torch.randn(1, 6), torch.randn(1, 6))
    chosen = torch.tensor([[1.0, 0, 1, 0, 0, 1]])
    jacobians = torch.autograd.functional.jacobian(lambda past, future: encoder(past, future, chosen), codes)
    past, future = (each.abs().sum((0, 1, 2)) > 0 for each in jacobians)
    assert torch.equal(past, chosen[0] == 1)
    assert torch.equal(future, chosen[0] == 0)


def test_what_does_not_fit_a_code_is_refused():
    decoder = MixAndMatch(0.5).decoder(8, 4)
    with pytest.raises(ValueError, match="z has 3 numbers, and this code is made for 4"):
        decoder(torch.randn(2, 8), torch.randn(2, 3), torch.ones(2, 8))
    with pytest.raises(ValueError, match="perturbs drawn indices; give them"):
        decoder(torch.randn(2, 8), torch.randn(2, 4))
    with pytest.raises(ValueError, match="share is 2; it must be between 0 and 1"):
        MixAndMatch(2)


def test_a_residual_block_has_two_paths():
    torch.manual_seed(0)
    block, value = Residual(3, 4), torch.randn(5, 3)
    torch.testing.assert_close(block(value), block.short(value) + block.long(value))
    assert (block(value) != block.short(value)).all()


def test_one_encoder_reads_the_past_for_guide_and_model(windows):
    model = made(windows)
    assert model.encoder["z"].network.past is model.generator["x"].network.past


@pytest.mark.parametrize("velocity", [True, False])
def test_a_decoder_of_velocities_that_makes_nothing_stands_still(windows, velocity):
    model, data = made(windows, velocity=velocity), past(windows)
    out = model.generator["x"].network.out
    torch.nn.init.zeros_(out.weight)
    torch.nn.init.constant_(out.bias, 0.0 if velocity else 0.5)
    futures = model.forecast(data, 4, 2)["x"]
    away = (futures - data["x"][None, :, -1:]).abs().max()
    assert (away < 1e-3) == velocity


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
    positions = (_aligned(means, lengths, model.turns) - _aligned(data["x"], lengths, model.turns)).square().mean()
    errors = size / (2 * 0.01**2) * (rotations + 0.5 * positions)
    constant = size * (np.log(0.01) + 0.5 * np.log(2 * np.pi))
    kl = (terms.kl["z"].sum() / terms.frames.sum()).detach()
    for step, weight in ((0, 0.0), (10, 0.5), (39, 1.0)):
        expected = errors + constant + weight * kl
        torch.testing.assert_close(objective(terms, step), expected, rtol=1e-5, atol=0.02 * float(kl))


def test_schedules_begin_and_end_as_they_should(windows):
    recipe = small().train(windows["train"], steps=100)
    feeding, curriculum = recipe.feeding, recipe.stages[0].curriculum
    assert [feeding(step) for step in (0, 45, 90, 99)] == pytest.approx([0, 0.5, 1, 1])
    assert [curriculum(step) for step in (0, 25, 50, 99)] == pytest.approx([0, 0.5, 1, 1])
    for option in ("annealing", "curriculum", "feeding"):  # a share that is less than a step
        assert small(**{option: 0.001}).train(windows["train"], steps=1)


@pytest.mark.parametrize("noise", ["mix", "concatenate"])
def test_in_evaluation_futures_know_nothing_of_each_other(windows, noise):
    model, data = made(windows, noise=noise), past(windows)
    for module in model.modules():
        if isinstance(module, CodeDecoder):  # statistics that are not those of a fresh layer
            module.norm.running_mean.normal_()
            module.norm.running_var.uniform_(0.5, 2)
    z = torch.randn(4, model.sizes["z"])
    shared = {"i": torch.ones(4, 24)} if noise == "mix" else {}
    whole = model.forecast({**data, **shared}, 5, fix={"z": z})["x"]
    for row in range(4):
        one = {"x": data["x"][row, None], "beside": {TURNS: data["beside"][TURNS][row, None]}}
        alone = model.forecast({**one, **{n: v[row, None] for n, v in shared.items()}}, 5, fix={"z": z[row, None]})
        torch.testing.assert_close(alone["x"][:, 0], whole[:, row], atol=1e-6, rtol=1e-5)


def test_futures_are_drawn_from_the_prior_and_the_guide_is_asked_where_frames_tell(windows, monkeypatch):
    model, asked = made(windows), []
    guide = model.guide
    monkeypatch.setattr(model, "guide", lambda batch, **options: asked.append(batch) or guide(batch, **options))
    torch.manual_seed(0)
    drawn = model.forecast(past(windows), 4, samples=400)["z"]
    assert not asked
    assert drawn.mean().abs() < 0.02
    assert drawn.std() == pytest.approx(1, abs=0.02)
    torch.manual_seed(0)
    other = {"x": past(windows)["x"] * 0.9}
    assert torch.equal(model.forecast(other, 4, samples=400)["z"], drawn)  # whatever the past is
    later = windows["test"].all()
    further = {"x": later["x"][:4, :9]}
    out = model.forecast(further, 3, samples=2)
    assert out["x"].shape == (2, 4, 3, 48)
    assert len(asked) == 1


def test_other_representations_are_refused(windows):
    data = motion.windows(motion.simulate(clips=6), motion.PROTOCOLS["simulated"], "train")
    with pytest.raises(SchemaError, match=r"reads turns of joints as quaternion, .* see positions of joints"):
        small().build(data)


@pytest.mark.parametrize("noise", ["mix", "concatenate", "add", "step"])
def test_every_way_is_trained_by_the_shared_loop_and_scored_in_metres(windows, noise):
    method = small(noise=noise)
    model = method.build(windows["train"])
    recipe = method.train(windows["train"], windows["test"], steps=6)
    result = recipe.fit(model, batch_size=4, validate_every=3, log_every=1, progress=False)
    rows = [row for row in result.history if "loss" in row]
    assert all(np.isfinite(row["loss"]) for row in rows)
    assert [row.get("curriculum") for row in rows][:3] == ([0.0, 1 / 3, 2 / 3] if noise == "mix" else [None] * 3)
    assert rows[0]["energy/skeleton"] > 0
    if noise == "add":
        assert rows[-1]["kl/z"] == 0
    table = dvae.evaluate(model, windows["test"], scores=motion.scores, samples=3, progress=False)
    assert np.isfinite(table["model"]["ADE"].mean)
    assert table["model"]["limb stretch"].mean < 1e-3


def test_the_skeleton_is_that_of_bodies_that_face_one_way(windows):
    """Errors of positions are the same whichever way the bodies face."""
    model, batch = made(windows), windows["train"].sample(3, torch.Generator().manual_seed(0))
    data = model.read(batch)
    value = data["x"]
    turned = value.clone()
    root = model.turns.turning.index(windows["train"].skeleton.root)
    turned[..., 4 * root : 4 * root + 4] = torch.nn.functional.normalize(torch.randn(3, 7, 4), dim=-1)
    ours, theirs = _aligned(torch.stack([value, turned]), data["bone_lengths"], model.turns)
    assert torch.equal(ours, theirs)
    positions = windows["train"].skeleton.with_root(ours.unflatten(-1, (-1, 3)))
    lengths = windows["train"].skeleton.bone_lengths(positions)
    torch.testing.assert_close(lengths, data["bone_lengths"][:, None].expand_as(lengths), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("noise", ["mix", "step"])
def test_the_log_score_of_a_model_of_futures_is_its_importance_bound(windows, noise):
    model, batch = made(windows, noise=noise, latent=3), windows["test"].all()
    found = []
    for bound in (dvae.importance_bound, lambda model, data, particles: predictive_bound(model, data, 5, particles)):
        torch.manual_seed(0)
        found.append(bound(model, batch, particles=30).bound)
    torch.testing.assert_close(found[1], found[0])
    with pytest.raises(ValueError, match="observed frames from 5 to 11; got 30 and 4"):
        predictive_bound(model, batch, 4, 30)
    assert predictive_bound(model, batch, 8, 30).bound.isfinite().all()  # where some of the future is known
