"""The denoiser: its contract, representation of the future, two-mode futures, and runs."""

from dataclasses import replace
from typing import ClassVar

import pytest
import torch

import dvae
from dvae import motion
from dvae.testing import FactorizationContract

SMALL = {"width": 8, "heads_count": 2, "layers": 1, "coefficients": 4, "sampler_steps": 3}


@pytest.fixture(scope="module")
def windows():
    protocol = replace(motion.PROTOCOLS["simulated"], observed=5, predicted=7, train_stride=3, test_stride=6)
    return motion.windows(motion.simulate(clips=8, frames=40, test=0.3), protocol, "train")


def small(**options):
    return dvae.method("denoiser", **{**SMALL, **options})


def built(windows, **options):
    torch.manual_seed(0)
    return small(**options).build(windows).double().eval()


def batch_of(windows, size=3):
    batch = windows.sample(size, torch.Generator().manual_seed(0))
    return {**batch, "x": batch["x"].double()}


def past_of(batch):
    return {**batch, "x": batch["x"][:, :5]}


class TestDenoiser(FactorizationContract):
    missing: ClassVar = {}

    def build(self, size):
        model = small().build({"x": size})
        model.generator["x"].head.perturb = lambda u: (torch.full_like(u[..., :1, :1], 0.4), (3 * u).sin())
        return model

    def test_the_log_joint_is_that_of_the_per_step_program(self):
        pytest.skip("the shares of the steps in a joint bound are not conditional densities")

    def test_every_size_may_be_one(self):
        model = small().build({"x": 1}).double()
        one = {"x": torch.randn(1, 1, 1), "h": torch.randn(1, 2)}
        assert dvae.SequenceELBO().terms(model, one).bound.isfinite()
        assert model.forecast({"h": one["h"]}, 1)["x"].isfinite().all()

    def test_a_bound_stays_on_its_device(self):
        pytest.skip("this test forecasts given past steps; tests/testing/test_device.py covers the method")

    def test_training_stays_finite(self):
        pytest.skip("this test forecasts given past steps; the test of two modes covers training")


@pytest.mark.parametrize("heading", [True, False])
def test_the_future_is_relative_to_the_last_pose_and_the_view_keeps_its_volume(windows, heading):
    model, batch = built(windows, heading=heading), batch_of(windows)
    data = model.read(batch)
    restored = model.to_data_space({"x": data["x"][None]}, data)["x"][0]
    torch.testing.assert_close(restored, batch["x"][:, 5:])
    torch.testing.assert_close(data["x"].norm(dim=-1), (batch["x"][:, 5:] - batch["x"][:, 4:5]).norm(dim=-1))
    assert model.view.keeps_volume
    assert torch.equal(model.read(past_of(batch))["h"], data["h"])


def test_its_score_is_labelled_a_bound_and_its_loss_an_energy(windows):
    model, batch = built(windows), batch_of(windows)
    assert model.bounded == ("x",)
    assert dvae.SequenceELBO().terms(model, batch).bounded == ("x",)
    terms = dvae.SequenceELBO().terms(model.train(), batch)
    assert set(terms.energies) == {"x"}
    assert not terms.log_likelihood
    bounds = []
    for trains in (True, False):  # functions that evaluate a model switch to evaluation mode
        torch.manual_seed(1)
        bounds.append(dvae.iwae_bound(model.train(trains), batch, particles=1).bound)
    torch.testing.assert_close(*bounds)


def test_bones_keep_their_observed_lengths(windows):
    batch = batch_of(windows)
    torch.manual_seed(1)
    free = built(windows, bones=False).forecast(past_of(batch), 7, 2)["x"]
    torch.manual_seed(1)
    kept = built(windows).forecast(past_of(batch), 7, 2)["x"]
    skeleton = windows.skeleton
    lengths = skeleton.limbs(past_of(batch)["x"]).norm(dim=-1).mean(1, keepdim=True)
    torch.testing.assert_close(skeleton.limbs(kept).norm(dim=-1), lengths.expand(2, 3, 7, -1))
    assert (skeleton.limbs(free).norm(dim=-1) - lengths).abs().max() > 0.001
    directions = [torch.nn.functional.normalize(skeleton.limbs(each), dim=-1) for each in (free, kept)]
    torch.testing.assert_close(*directions)


@pytest.mark.parametrize(
    "options", [{}, {"coefficients": 0, "sampler": "ancestral"}, {"drop": 0.2, "guidance": 1.5, "sampler": "dpm"}]
)
def test_forecasts_are_seeded_draws(windows, options):
    model, past, forecasts = built(windows, **options), past_of(batch_of(windows)), []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        forecasts.append(model.forecast(past, 7, 4)["x"])
    assert forecasts[0].shape == (4, 3, 7, past["x"].shape[-1])
    assert torch.equal(forecasts[0], forecasts[1])
    assert not torch.equal(forecasts[0], forecasts[2])
    assert (forecasts[0].std(0) > 0).all()


def test_a_shorter_forecast_is_the_start_of_a_whole_one(windows):
    model, batch = built(windows), batch_of(windows)
    forecasts = []
    for horizon in (3, 7):
        torch.manual_seed(1)
        forecasts.append(model.forecast(past_of(batch), horizon, 2)["x"])
    assert torch.equal(forecasts[0], forecasts[1][:, :, :3])
    for wrong, horizon, message in ((past_of(batch), 8, "up to 7 more.*horizon of 8"), (batch, 2, "got 12 frames")):
        with pytest.raises(ValueError, match=message):
            model.forecast(wrong, horizon)


def test_a_run_is_restored_with_the_same_forecasts(windows, tmp_path):
    protocol = windows.protocol
    people = motion.MotionData("simulated", motion.simulate(clips=8, frames=40, test=0.3), protocol)
    options = {"steps": 4, "batch_size": 4, "progress": False, "accelerator": "cpu"}
    fit = dvae.fit(small(), people, out=tmp_path / "run", **options)
    restored, past = dvae.load(tmp_path / "run").model, past_of(windows.sample(2, torch.Generator().manual_seed(0)))
    draws = []
    for model in (fit.model, restored):
        torch.manual_seed(3)
        draws.append(model.eval().forecast(past, 7, 2)["x"])
    torch.testing.assert_close(*draws)


def test_futures_keep_the_mass_of_both_modes():
    """After the last pose, the body moves to one side in three of ten windows and to the other in seven."""
    generator = torch.Generator().manual_seed(0)
    signs = torch.where(torch.rand(512, 1, 1, generator=generator) < 0.3, -1.0, 1.0)
    ramp = torch.cat([torch.zeros(2), torch.arange(1.0, 7.0) / 6])[:, None]
    x = 0.3 * torch.randn(512, 1, 1, generator=generator) + signs * ramp
    x = x + 0.02 * torch.randn(x.shape, generator=generator)
    torch.manual_seed(0)
    method = small(width=32, layers=2, sampler_steps=15)
    model = method.build({"x": 1})
    recipe = method.train(dvae.data.sequences.Sequences({"x": x}), steps=1200)
    dvae.fit(model, recipe, batch_size=64, learning_rate=3e-3, decay=0.5, progress=False, accelerator="cpu")
    past = x[:50, :2]
    ends = (model.eval().forecast({"x": past}, 6, 40)["x"][:, :, -1] - past[:, -1]).flatten()
    assert (ends < 0).float().mean() == pytest.approx(0.3, abs=0.1)
    assert ((ends.abs() - 1).abs() < 0.2).float().mean() > 0.9


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"join": 1.0}, "leave `join` at 0"),
        ({"width": 9}, "multiple of heads_count"),
        ({"guidance": 2.0}, "set `drop` above 0"),
    ],
)
def test_options_that_do_not_fit_are_an_error(options, message):
    with pytest.raises(ValueError, match=message):
        small(**options).build({"x": 3})
