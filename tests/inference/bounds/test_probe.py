"""The probe: forecasts whose latents come from another distribution show whether a model uses its latents."""

from dataclasses import replace

import pytest
import torch
from torch.distributions import Normal

import dvae
from dvae import motion
from dvae.inference.bounds.probe import RedrawnModel

PROTOCOL = replace(motion.PROTOCOLS["simulated"], observed=5, predicted=7, test_stride=6, representation="quaternion")
FAR = Normal(50.0, 50**0.5)


@pytest.fixture(scope="module")
def windows():
    return motion.windows(motion.simulate(clips=8, frames=40, test=0.3), PROTOCOL, "test")


def build(windows, **options):
    torch.manual_seed(0)
    return dvae.method("mix-and-match", **{"width": 24, **options}).build(windows).eval()


@pytest.mark.parametrize("noise", ["mix", "concatenate", "add", "step"])
def test_each_sample_draws_its_latents_from_the_other_distribution(windows, noise):
    model, past = build(windows, noise=noise), {"x": windows.all()["x"][:3, :5]}
    z = RedrawnModel(model, {"z": FAR}).forecast(past, 7, samples=300)["z"]
    assert z.shape == model.forecast(past, 7, samples=300)["z"].shape
    assert z.mean() == pytest.approx(50, abs=0.3)
    assert z.std() == pytest.approx(50**0.5, rel=0.03)
    assert z.std(0).min() > 5
    assert model.forecast(past, 7, samples=300)["z"].mean().abs() < 0.1  # the model itself is unchanged
