"""Methods that forecast body motion: their contract, published size, losses and inputs."""

import math
from dataclasses import replace
from typing import ClassVar

import pytest
import torch

import dvae
from dvae import motion
from dvae.testing import FactorizationContract

SMALL = {"latent": 4, "width": 8, "hidden": (6, 5)}
NAMES = ("cvae", "bom", "pose-knows")


def small(name, **options):
    return dvae.method(name, **{**SMALL, **options})


class Contract(FactorizationContract):
    name = ""
    waits = 1
    missing: ClassVar = {}
    options: ClassVar = {}

    def build(self, size):
        return small(self.name, **self.options).build({"x": size})


class TestCVAE(Contract):
    name = "cvae"


class TestBestOfMany(Contract):
    name = "bom"


class TestPoseKnows(Contract):
    name = "pose-knows"


class TestRHP(Contract):
    name = "rhp"
    missing: ClassVar = {"w": ("h", "x_{1:T}")}


@pytest.fixture(scope="module")
def windows():
    protocol = replace(motion.PROTOCOLS["simulated"], observed=5, predicted=7, train_stride=3, test_stride=6)
    return motion.windows(motion.simulate(clips=8, frames=40, test=0.3), protocol, "train")


def built(windows, name, **options):
    torch.manual_seed(0)
    return small(name, **options).build(windows).double()


def batch_of(windows, size=3):
    batch = windows.sample(size, torch.Generator().manual_seed(0))
    return {**batch, "x": batch["x"].double()}


def test_the_model_of_human36m_has_the_published_size():
    model = dvae.method("cvae").build({"x": 48})
    assert sum(parameter.numel() for parameter in model.parameters()) == 725_292


def futures(model, batch, draws):
    """Return the future of each draw (S, B, T, D) and the truth."""
    past = {"x": batch["x"][:, :5]}
    with torch.no_grad():
        means = [model.forecast(past, 7, fix=latents)["x"][0] for latents in draws]
    return torch.stack(means), batch["x"][:, 5:]


def test_the_loss_adds_squared_errors_the_first_step_and_the_weighted_kl(windows):
    """The model rotates windows, which keeps distances."""
    model, batch = built(windows, "cvae", join=3.0), batch_of(windows)
    torch.manual_seed(1)
    terms = dvae.SequenceELBO().terms(model, batch, scheduled_sampling=1.0)
    loss = small("cvae", join=3.0).train(windows).objective(terms, 0)
    torch.manual_seed(1)
    (future,), truth = futures(model, batch, [model.guide(batch)])
    errors = (future - truth).square().sum((1, 2)) + 3 * (future[:, 0] - batch["x"][:, 4]).square().sum(1)
    constant = 0.5 * math.log(math.pi) * truth[0].numel()  # normalisation of N(0, 1/2)
    expected = (errors + constant + 0.1 * terms.kl["w"]).sum() / (3 * 7)
    assert loss.item() == pytest.approx(expected.item(), rel=1e-6)  # the scale is float32


def test_best_of_many_penalises_only_the_nearest_future(windows):
    model, batch = built(windows, "bom", samples=4), batch_of(windows)
    objective = small("bom", samples=4).train(windows).objective
    torch.manual_seed(1)
    terms = dvae.SequenceELBO().terms(model, batch, scheduled_sampling=1.0, draws=objective.draws)
    torch.manual_seed(1)
    w = model.guide(batch, draws=objective.draws)["w"].unflatten(0, (4, -1))
    means, truth = futures(model, batch, [{"w": each} for each in w])
    errors = (means - truth).square().sum((2, 3))
    steps = (means[:, :, 0] - batch["x"][:, 4]).square().sum(2).mean(0)
    expected = (errors.min(0).values + 1000 * steps + 0.1 * terms.kl["w"]).sum() / (3 * 7)
    assert objective(terms, 0).item() == pytest.approx(expected.item(), rel=1e-6)


@pytest.mark.parametrize("name", [*NAMES, "rhp"])
def test_decoders_read_their_own_means_with_gradients_in_training(windows, name):
    model, batch = built(windows, name), batch_of(windows, 2)
    latents, data = model.guide(batch), model.read(batch)
    means = []
    for shift in (0, 1):
        rollout = model.rollout({**data, "x": data["x"] + shift})
        rollout.feeding = model.feeding
        rollout.values.update(latents)
        means.append(rollout.parameters("x", data["x"] + shift)[0])
    assert torch.equal(*means)
    network = model.generator["x"].network
    (gradient,) = torch.autograd.grad(means[0][:, -1].sum(), network.first[0].weight)  # the layer of the initial state
    assert gradient.any()


def test_the_loss_of_rhp_is_the_squared_error_of_prior_draws(windows):
    model, batch = built(windows, "rhp"), batch_of(windows)
    torch.manual_seed(1)
    terms = dvae.SequenceELBO().terms(model, batch, scheduled_sampling=1.0)
    torch.manual_seed(1)
    (future,), truth = futures(model, batch, [{"w": torch.randn(3, 4, dtype=torch.float64)}])
    constant = 0.5 * math.log(math.pi) * truth[0].numel()  # normalisation of N(0, 1/2)
    expected = ((future - truth).square().sum() / 3 + constant) / 7
    loss = small("rhp").train(windows).objective(terms, 0)
    assert loss.item() == pytest.approx(expected.item(), rel=1e-6)
    assert not terms.kl["w"].any()
