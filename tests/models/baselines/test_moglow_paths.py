"""MoGlow with paths: its contract, the origin of its poses, and motions in the orientation of the batch."""

from dataclasses import replace

import pytest
import torch

import dvae
from dvae import motion
from dvae.models.baselines.moglow_paths import Offsets
from dvae.motion import PROTOCOLS
from dvae.motion.geometry.skeleton import rotate_about_up
from dvae.testing import FactorizationContract

PROTOCOL = replace(
    PROTOCOLS["bandai2-trajectories"], name="walks", split_by="split", train=("train",), test=("test",), predicted=20
)


@pytest.fixture(scope="module")
def windows():
    return motion.windows(motion.simulate(clips=6, frames=40, test=0.3), PROTOCOL, "train")


def small(**options):
    return dvae.method("moglow-paths", **{"width": 6, "flow_steps": 2, "hidden": (6,), "heading": False, **options})


def some_batch(windows, count=3):
    return {name: value[:count].double() for name, value in windows.given(["LWrist", "RFoot"]).all().items()}


class TestMoGlowPaths(FactorizationContract):
    def build(self, size):
        return small(frame_dropout=0.5).build({"x": size})


def test_poses_count_from_the_first_pose(windows):
    model, batch = small().build(windows).double(), some_batch(windows)
    x, data = batch["x"], model.read(batch)
    torch.testing.assert_close(data["x"], x[:, 1:] - x[:, :1])
    torch.testing.assert_close(data["s"], x[:, 0])
    assert torch.equal(Offsets()(data)["x"], data["x"])
    torch.testing.assert_close(model.to_data_space({"x": data["x"]}, data)["x"], x[:, 1:])


def test_initialisation_maps_changes_of_all_sizes_to_noise_of_variance_near_1(windows):
    torch.manual_seed(0)
    model = small().build(windows).double()
    recipe = small().train(windows)
    recipe.prepare(model)
    batch = recipe.batches.sample(200, torch.Generator().manual_seed(1))
    data = model.read({name: value.double() for name, value in batch.items()})
    changes = data["x"].diff(dim=1).var((0, 1))
    assert changes.max() > 100 * changes.min()
    noise, _ = model.rollout(data).evaluate("x", data["x"]).flow.to_noise(data["x"])
    variance = noise.var((0, 1))  # not exactly 1, because couplings follow the normalisations
    assert 0.1 < variance.min() < variance.max() < 5


def test_with_a_heading_rotated_windows_have_rotated_motions(windows):
    torch.manual_seed(0)
    model, batch = small(heading=True).build(windows).double().eval(), some_batch(windows)
    angle = torch.tensor(2.0, dtype=torch.float64)

    def rotated(values):
        return rotate_about_up(values.unflatten(-1, (-1, 3)), angle, windows.skeleton.up).flatten(-2)

    futures = []
    for turned in (batch, {name: rotated(value) for name, value in batch.items()}):
        torch.manual_seed(1)
        futures.append(model.forecast({"x": turned["x"][:, :1], "y": turned["y"]}, 20, 2)["x"])
    assert (futures[0][0] - futures[0][1]).abs().max() > 1e-3  # draws differ
    torch.testing.assert_close(futures[1], rotated(futures[0]))
