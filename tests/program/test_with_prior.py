"""Second stages: new distributions of the latents of a fitted model, whose other parameters stay."""

import math

import pytest
import torch

import dvae
from dvae.distributions import Diffusion, FixedNormal, Flow, FlowMatching, Mixture
from dvae.inference.training.checkpoints import load_weights
from dvae.networks import Attention, Denoiser, Dense, Recurrent


def two_levels(n):
    """Return draws (n, 6, 1) with a level around -2 in three of ten sequences, and around 2 in the others."""
    level = torch.where(torch.rand(n, 1, 1) < 0.3, -2.0, 2.0) + 0.2 * torch.randn(n, 1, 1)
    return level + 0.5 * torch.randn(n, 6, 1)


@pytest.fixture(scope="module")
def fitted():
    torch.manual_seed(0)
    networks = {"p(x)": Dense(()), "q(w)": Recurrent(8)}
    model = dvae.DynamicalVAE(
        "p(w) p(x_t | w)", "q(w | x_{1:T})", {"w": 1, "x": 1}, networks, {"p(x)": FixedNormal(learned=True)}
    )
    dvae.fit(model, two_levels(500), steps=300, learning_rate=0.02, decay=0.5, progress=False)
    return model


@pytest.mark.parametrize("spec", [Diffusion(hidden=(32, 32)), Mixture(3)])
def test_the_second_stage_improves_the_bound_and_changes_nothing_else(fitted, spec, tmp_path):
    before = {name: value.clone() for name, value in fitted.state_dict().items()}
    model = fitted.with_prior({"p(w)": spec})
    options = {"steps": 500, "learning_rate": 0.01, "decay": 0.5, "batch_size": 200, "progress": False}
    dvae.fit(model, two_levels(1000), two_levels(300), out=tmp_path / "run", **options)
    assert {name for name, value in model.named_parameters() if value.requires_grad} == {
        name for name, _ in model.named_parameters() if name.startswith("generator.w.")
    }
    for name, value in before.items():
        assert torch.equal(value, fitted.state_dict()[name])
        assert torch.equal(value, model.state_dict()[name])
    torch.manual_seed(1)
    x, elbo = two_levels(1000), dvae.SequenceELBO(num_particles=10)
    gain = elbo.terms(model, x).bound - elbo.terms(fitted, x).bound
    assert gain.mean() > 0.1 + 3 * gain.std() / math.sqrt(len(gain))
    levels = model.sample(2000, length=6)["x"].mean((1, 2))
    assert (levels < 0).float().mean() == pytest.approx(0.3, abs=0.1)
    old_levels = fitted.sample(2000, length=6)["x"].mean((1, 2))
    near, old_near = (((each.abs() - 2).abs() < 0.8).float().mean() for each in (levels, old_levels))
    assert near > 0.9 > old_near
    loaded = fitted.with_prior({"p(w)": spec})
    load_weights(loaded, tmp_path / "run")
    assert all(torch.equal(value, loaded.state_dict()[name]) for name, value in model.state_dict().items())


def test_draws_and_forecasts_follow_the_new_prior_and_its_bound_is_labelled(fitted):
    model = fitted.with_prior({"p(w)": Diffusion(steps=2)})
    assert not fitted.bounded
    assert dvae.SequenceELBO().terms(model, two_levels(3)).bounded == ("w",)
    chain = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 1})
    second = chain.with_prior({"p(z)": Diffusion(steps=2)})
    for head in (model.generator["w"].head, second.generator["z"].head):
        head.out.bias.data[0] = 50.0  # the location
    assert model.sample(5, length=6)["w"].min() > 30
    z = second.forecast(two_levels(3), 2, samples=4)["z"]
    assert z[:, :, :6].abs().max() < 30 < z[:, :, 6:].min()
    networks, view = {"default": Recurrent(8)}, dvae.data.views.Past("h", frames=4)
    pair, sizes = ("p(z_{1:T} | h) p(x_t | z_t)", "q(z_t | x_{1:T}, h)"), {"z": 1, "x": 1, "h": 4}
    joint = Diffusion(denoiser=Denoiser(Recurrent(8)), steps=2)
    third = dvae.DynamicalVAE(*pair, sizes, networks, view=view).with_prior({"p(z)": joint})
    assert third.forecast(two_levels(3)[:, :4], 2, samples=4)["x"].shape == (4, 3, 2, 1)
    assert model.requires_grad_().generator["x"].head.out.weight.requires_grad


def test_a_causal_prior_of_all_steps_reads_no_later_steps():
    pair = "p(z_t | z_{<t}, u_{<=t}) p(x_t | z_t)", "q(z_t | x_{1:T})"
    first = dvae.DynamicalVAE(*pair, {"z": 2, "x": 3, "u": 1}, Recurrent(width=8)).double()
    first.standardise("u").fit(torch.randn(40, 5, 1).double() + 3)
    model = first.with_prior({"p(z)": Diffusion(denoiser=Denoiser(Attention(8, 2)), steps=3)})
    prior, noise, u = model.generator["z"], torch.randn(1, 5, 2).double(), torch.randn(1, 5, 1).double()
    jacobian = torch.autograd.functional.jacobian(lambda u: prior.draw(prior({"u": u}, 1, 5), noise), u)
    depends = (jacobian != 0).any(-1).any(2)[0, :, 0]
    assert torch.equal(depends, torch.ones(5, 5).bool().tril())
    assert prior.units["u"] is model.units["u"] is not first.units["u"]
    batch = {"x": torch.randn(4, 5, 3).double(), "u": torch.randn(4, 5, 1).double()}
    dvae.fit(model, batch, steps=2, progress=False)
    assert torch.equal(model.generator["x"].head.out.weight, first.generator["x"].head.out.weight)


def test_a_joint_prior_of_all_steps_replaces_independent_steps():
    torch.manual_seed(0)
    networks = {"p(x)": Dense(()), "q(z)": Recurrent(8)}
    pair = "p(z_t) p(x_t | z_t)", "q(z_t | x_{1:T})"
    first = dvae.DynamicalVAE(*pair, {"z": 1, "x": 1}, networks, {"p(x)": FixedNormal(0.5)})
    options = {"learning_rate": 0.01, "decay": 0.5, "batch_size": 100, "progress": False}
    dvae.fit(first, two_levels(500), steps=150, **options)
    joint = Diffusion(denoiser=Denoiser(Attention(8, 2)), steps=4)
    second = first.with_prior({"p(z_{1:T})": joint})
    assert str(first.generative) == "p(x_{1:T}, z_{1:T}) = ∏_t p(z_t) p(x_t | z_t)"
    assert second.generative.factor("z").parent("z").relation.reads(-5, 6)
    dvae.fit(second, two_levels(1000), steps=300, **options)
    x, elbo = two_levels(1000), dvae.SequenceELBO(num_particles=10)
    gain = elbo.terms(second, x).bound - elbo.terms(first, x).bound
    assert gain.mean() > 1 + 3 * gain.std() / math.sqrt(len(gain))
    levels, old_levels = (each.sample(500, length=6)["x"].mean((1, 2)) for each in (second, first))
    near, old_near = (((each.abs() - 2).abs() < 0.8).float().mean() for each in (levels, old_levels))
    assert near > 0.7 > 0.4 > old_near
    assert first.can_forecast
    assert not second.can_forecast
    with pytest.raises(ValueError, match=r"all steps of z jointly, .* so the model cannot forecast"):
        second.forecast(x[:2], 2)


@pytest.mark.parametrize(
    ("distributions", "message"),
    [
        ({}, "got distributions of nothing"),
        ({"p(w)": Diffusion(), "p(w | u)": Diffusion()}, "expected factors of latents"),
        ({"p(w | u)": Diffusion()}, "sizes missing for u"),
        ({"q(w | x_{1:T})": Diffusion()}, "expected factors of latents"),
        ({"p(w) p(v)": Diffusion(), "p(w)": Diffusion()}, "expected factors of latents"),
        ({"p(w)": Diffusion}, "is the class Diffusion"),
        ({"p(w_t)": Diffusion()}, r"got distributions of p\(w_t\); expected factors of latents, which are p\(w\)"),
        ({"p(x)": Flow()}, r"factors of latents, which are p\(w\)"),
        ({"p(w)": FlowMatching()}, "has a loss in place of a density"),
    ],
)
def test_mistakes_name_the_factors(fitted, distributions, message):
    with pytest.raises(ValueError, match=message):
        fitted.with_prior(distributions)


def test_a_guide_that_is_the_prior_is_refused():
    model = dvae.DynamicalVAE("p(w) p(x_t | w)", None, {"w": 1, "x": 1})
    with pytest.raises(ValueError, match="the guide is the prior"):
        model.with_prior({"p(w)": Flow()})
