"""MT-VAE: its contract, size and loss, and its latent of a change of style."""

from dataclasses import replace

import pytest
import torch

import dvae
from dvae import motion
from dvae.testing import FactorizationContract

SMALL = {"latent": 4, "width": 16}


def small(**options):
    return dvae.method("mt-vae", **{**SMALL, **options})


class TestMTVAE(FactorizationContract):
    missing = {}  # noqa: RUF012

    def build(self, size):
        return small().build({"x": size})


@pytest.fixture(scope="module")
def windows():
    protocol = replace(motion.PROTOCOLS["simulated"], observed=5, predicted=12, train_stride=3, test_stride=6)
    return motion.windows(motion.simulate(clips=8, frames=40, test=0.3), protocol, "train")


def built(windows, **options):
    torch.manual_seed(0)
    return small(**options).build(windows).double()


def batch_of(windows, size=3):
    batch = windows.sample(size, torch.Generator().manual_seed(0))
    return {**batch, "x": batch["x"].double()}


def future(model, batch, w):
    """Return the future (B, T, D) of w."""
    with torch.no_grad():
        return model.forecast({"x": batch["x"][:, :5]}, 12, fix={"w": w})["x"][0]


def test_the_model_of_human36m_has_the_layers_of_the_public_code():
    """1024 units, half of an embedding for style, and poses of 48 numbers instead of 64."""
    model = dvae.method("mt-vae").build({"x": 48})

    def linear(size, out):
        return (size + 1) * out

    def block(size, out):
        return linear(size, out) + linear(size, out // 2) + linear(out // 2, out // 2) + linear(out // 2, out)

    def lstm(size):  # four gates and a cell, with gains and shifts
        return 4 * 1024 * (size + 1024) + 2 * 5 * 1024

    encoder = lstm(48) + linear(1024, 1024)
    guide = block(512, 1024) + 2 * linear(1024, 512)
    change = linear(512, 512) + block(1024, 512) + linear(512, 512)
    decoder = block(1024, 1024) + 2 * linear(1024, 1024) + lstm(512) + linear(1024, 48)
    assert sum(parameter.numel() for parameter in model.parameters()) == encoder + guide + change + decoder


def test_all_unchanging_motions_have_the_same_code(windows):
    """The guide reads only the change of style."""
    network, poses = built(windows).encoder["w"].network, batch_of(windows)["x"][:, :5]
    same = network({"x": poses, "h": poses.flatten(1)}, 5)
    torch.testing.assert_close(same, same[:1].expand(3, -1), rtol=0, atol=0)
    other = network({"x": poses.flip(1), "h": poses.flatten(1)}, 5)
    assert (other - other[:1])[1:].abs().max() > 1e-3


def test_the_loss_equals_the_one_of_the_paper(windows):
    """The terms are absolute errors, velocities of two futures, the KL divergence and the cycle of a latent."""
    model, batch = built(windows, heading=False, join=2.0), batch_of(windows)
    objective = small(heading=False, join=2.0).train(windows, steps=100).objective
    torch.manual_seed(1)
    terms = dvae.SequenceELBO().terms(model, batch)
    torch.manual_seed(1)
    w, other = model.guide(batch)["w"], torch.randn(3, 4, dtype=torch.float64)
    truth, last = batch["x"][:, 5:], batch["x"][:, 4:5]

    def velocity(poses):
        return torch.cat([last, poses], 1).diff(dim=1)[:, :8]

    reconstruction, sample = future(model, batch, w), future(model, batch, other)
    network, guide = model.generator["x"].network, model.encoder["w"]
    _, style = network.past(batch["x"][:, :5])
    loc, scale = guide.head(guide.network.coded(network.changed(style, other) - style))
    recovered = loc + scale * torch.randn(3, 4, dtype=torch.float64)
    joints, a = 16, 1 - torch.exp(torch.tensor(-3.0, dtype=torch.float64))
    paper = (reconstruction - truth).abs().sum() / joints
    paper = paper + 5 * a * sum(
        (velocity(each) - velocity(truth)).abs().sum() / joints for each in (reconstruction, sample)
    )
    paper = paper + a * terms.kl["w"].sum() / 4 + 5 * (other - recovered).abs().sum() / 4
    scale = joints / 4  # scale of the Laplace distribution
    constant = 3 * truth[0].numel() * torch.tensor(2 * scale).log()
    join = 2 * (reconstruction[:, 0] - last[:, 0]).square().sum()
    torch.testing.assert_close(objective(terms, 100), (4 * paper + constant + join) / (3 * 12))
