"""Priors of static latents: densities integrate to one, draws follow them, and some KLs are Monte Carlo."""

import copy
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

import dvae
from dvae import DynamicalVAE, SequenceELBO, distributions
from dvae.motion.data.dataset import MotionData
from dvae.networks import Recurrent
from dvae.runs import directory as runs

B, T = 3, 5
PRIORS = {
    "normal": distributions.FixedNormal(learned=True),
    "mixture": distributions.Mixture(components=3),
    "vamp": distributions.Vamp(components=3, steps=4),
    "flow": distributions.Flow(),
}
PAIR = "p(w) p(z_t | z_{t-1}, w) p(x_t | x_{t-1}, z_t, w)", "q(w | x_{1:T}) q(z_t | x_{1:T}, w)"


def build(kind, size=2):
    """Return a model with a prior and perturbed parameters."""
    sizes, network = {"w": size, "z": 2, "x": 2}, Recurrent(4, hidden=(4,))
    model = DynamicalVAE(*PAIR, sizes, network, distributions={"p(w)": PRIORS[kind]}).double()
    with torch.no_grad():
        for name, parameter in (*model.generator["w"].named_parameters(), *model.encoder["w"].named_parameters()):
            parameter.add_(
                (0.05 if ".nn." in name else 0.2) * torch.randn_like(parameter)
            )  # .nn.: networks of couplings
    return model


def distribution(model, batch=1):
    conditional = model.generator["w"]
    return conditional.head.joint(conditional({}, batch, T))


def data():
    return torch.randn(B, T, 2, dtype=torch.float64)


def grid(model):
    """Return the axis of a grid and the density of the prior on it."""
    axis = torch.linspace(-12, 12, 361 if model.sizes["w"] == 2 else 4_801, dtype=torch.float64)
    points = torch.cartesian_prod(*[axis] * model.sizes["w"]).reshape(-1, model.sizes["w"])
    density = distribution(model, len(points)).log_prob(points).exp()
    return axis, density.detach().reshape([len(axis)] * model.sizes["w"])


@pytest.mark.parametrize("size", [1, 2])
@pytest.mark.parametrize("kind", PRIORS)
def test_a_prior_is_a_density_and_draws_follow_it(kind, size):
    model = build(kind, size)
    axis, density = grid(model)
    step = axis[1] - axis[0]
    # the tolerance covers the error of the grid at the kinks of a spline
    assert (density.sum() * step**size).item() == pytest.approx(1, abs=3e-3)
    draws = model.sample(20_000, 1)["w"]
    for d in range(size):
        marginal = density.sum(1 - d) * step if size == 2 else density
        cumulative = (marginal.cumsum(0) - marginal / 2) * step
        assert stats.kstest(draws[:, d], lambda points, cdf=cumulative: np.interp(points, axis, cdf)).pvalue > 1e-4
    if size == 2:
        product = (density * axis[:, None] * axis).sum() * step**2
        products = draws.prod(1)
        assert abs(products.mean() - product) < 5 * products.std() / len(products) ** 0.5


@pytest.mark.parametrize("kind", [kind for kind in PRIORS if kind != "normal"])
def test_without_a_closed_form_the_kl_is_the_log_ratio_at_the_draw(kind):
    model, x = build(kind), data()
    torch.manual_seed(1)
    kl = SequenceELBO().terms(model, x).kl["w"]
    torch.manual_seed(1)
    w = model.guide(x)["w"]
    posterior = model.encoder["w"].head.distribution(model.encoder["w"]({"x": x}, B, T)).to_event(1)
    torch.testing.assert_close(kl, posterior.log_prob(w) - distribution(model, B).log_prob(w))


def test_the_vamp_prior_averages_the_guide_at_its_pseudo_sequences():
    model, points = build("vamp"), torch.randn(6, 2, dtype=torch.float64)
    pseudo = model.generator["w"].head.pseudo["x"]
    loc, scale = model.encoder["w"]({"x": pseudo}, 3, 4)
    each = torch.distributions.Normal(loc, scale).log_prob(points[:, None]).sum(-1)
    torch.testing.assert_close(distribution(model, 6).log_prob(points), each.logsumexp(1) - math.log(3))
    names = [name for name, _ in model.generator["w"].named_parameters()]
    assert names == ["head.pseudo.x"]  # the parameters of the guide are not among them
    surrogate = copy.deepcopy(model)
    assert surrogate.generator["w"].head.guide is surrogate.encoder["w"]


# ------------------------------------------------------------------------------------------------------- in a run

OPTIONS = {
    "latent": 2,
    "static": 2,
    "width": 4,
    "heads_count": 1,
    "decoder": 4,
    "warm_up": 0,
    "scheduled_sampling": 0.0,
}
VAMP = {**OPTIONS, "prior": "vamp", "prior_components": 3, "prior_steps": 6, "heading": False, "pose_prior": 0.0}


def test_pseudo_sequences_need_as_many_sequences():
    head = build("vamp", 2).generator["w"].head
    with pytest.raises(ValueError, match="has 3 components, but only 2 sequences of x are given"):
        head.start_at({"x": torch.randn(2, 4, 2)})
    with pytest.raises(ValueError, match="have 4 steps, but the given sequences of x have only 3"):
        head.start_at({"x": torch.randn(3, 3, 2)})


def weights(run: Path):
    return (run / "last.safetensors").read_bytes()


def test_pseudo_sequences_start_at_training_windows_and_survive_a_resume(people, tmp_path):
    """The seed of the run selects the windows, and a resumed run keeps their current values."""
    data, method = MotionData.open(people), dvae.method("hit-dvae", **VAMP)
    frozen = dvae.Training(steps=1, batch_size=2, learning_rate=0.0, progress=False, validate_every=2)
    starts = []
    for seed, name in ((0, "a"), (0, "b"), (1, "c")):
        dvae.fit(method, data, out=tmp_path / name, **vars(replace(frozen, seed=seed)))
        starts.append(dvae.load(tmp_path / name).model.generator["w"].head.pseudo["x"])
    assert torch.equal(starts[0], starts[1])
    assert not torch.equal(starts[0], starts[2])
    windows = data.windows("train").all(stride=1)["x"][:, :6]
    for pseudo in starts[0]:
        assert (windows == pseudo).flatten(1).all(1).any()

    training = replace(frozen, learning_rate=0.01)
    dvae.fit(method, data, out=tmp_path / "whole", **vars(replace(training, steps=2)))
    dvae.fit(method, data, out=tmp_path / "parts", **vars(training))
    runs.resume(tmp_path / "parts", steps=2)
    assert weights(tmp_path / "parts") == weights(tmp_path / "whole")
