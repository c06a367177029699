"""Posteriors given part of the data: exact for normal posteriors, calibrated for nearly normal ones."""

import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro.infer import Trace_ELBO
from pyro.infer.autoguide import AutoLaplaceApproximation
from pyro.infer.autoguide.initialization import init_to_value

import dvae

QUICK = dvae.Descent(steps=60, newton=3)
BRIEF = dvae.Descent(steps=10, starts=2, candidates=2)
"""Enough where one step of Newton's arrives."""
_SIZES = {"w": 2, "z": 1, "x": 3}


def joined(values):
    return torch.cat([value.flatten(1) for value in values.values()], -1)


def covariance(posterior):
    return posterior.factor @ posterior.factor.mT


def test_a_normal_posterior_equals_the_oracles():
    """Test static and local latents, with missing values."""
    model = dvae.linear_gaussian_surrogate(
        "p(w) p(z_t | z_{t-1}, w) p(x_t | z_t)", "q(w | x_{1:T}) q(z_t | x_{1:T}, w)", _SIZES, 4
    )
    oracle, x = dvae.Oracle(model, 4), model.sample(5, 4)["x"]
    result = dvae.posterior(model.model, {"x": x}, guide=model.guide, descent=BRIEF)
    mean, spread = oracle.posterior(x)
    torch.testing.assert_close(joined(result.mode), mean, rtol=0, atol=1e-9)
    torch.testing.assert_close(covariance(result), spread.expand(5, -1, -1), rtol=0, atol=1e-9)
    for chunk in (4096, 15):
        evidence = result.evidence(model.model, {"x": x}, 20, chunk=chunk).bound
        torch.testing.assert_close(evidence, oracle.evidence(x), rtol=0, atol=1e-8)
    loss = Trace_ELBO().loss(model.model, result.guide, {"x": x})  # the normal is a guide, and exact
    assert -loss == pytest.approx(oracle.evidence(x).sum().item(), abs=1e-8)
    assert result.left.max() < 1e-9
    assert not result.bent.any()

    mask = torch.rand(x.shape) < 0.5
    part = dvae.posterior(model.model, {"x": x, "mask": mask}, descent=BRIEF)
    mean, precision = oracle._joint()
    everything, latents = torch.linalg.inv(precision), len(mean) - x[0].numel()
    for row in range(5):
        given = latents + mask[row].flatten().nonzero()[:, 0]
        gain = torch.linalg.solve(everything[given][:, given], everything[given][:, :latents]).T
        expected = mean[:latents] + gain @ (x[row].flatten()[given - latents] - mean[given])
        torch.testing.assert_close(joined(part.mode)[row], expected, rtol=0, atol=1e-9)
        conditional = everything[:latents, :latents] - gain @ everything[given][:, :latents]
        torch.testing.assert_close(covariance(part)[row], conditional, rtol=0, atol=1e-9)


def bowed(batch):
    """Draw data on a curved sheet."""
    with pyro.plate("sequences", len(batch["x"])):
        w = pyro.sample("w", dist.Normal(torch.zeros(len(batch["x"]), 2, dtype=torch.float64), 1.0).to_event(1))
        sheet = torch.cat([w, 0.1 * w.square(), 0.3 * w[..., :1].sin()], -1)
        pyro.sample("x", dist.Normal(sheet, 0.3).to_event(1), obs=batch["x"])


def test_the_posterior_equals_pyros_laplace_approximation():
    """Pyro's approximation has one matrix for all sequences, whose off-diagonal blocks are 0 here."""
    batch = {"x": torch.randn(3, 5, dtype=torch.float64)}
    result = dvae.posterior(bowed, batch, descent=QUICK)
    guide = AutoLaplaceApproximation(bowed, init_loc_fn=init_to_value(values={"w": result.mode["w"] + 0.01}))
    guide(batch)
    adam = torch.optim.Adam(guide.parameters(), 0.01)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(adam, 200)
    for _ in range(200):
        adam.zero_grad()
        Trace_ELBO().differentiable_loss(bowed, guide, batch).backward()
        adam.step()
        falling.step()
    torch.testing.assert_close(guide(batch)["w"], result.mode["w"], rtol=0, atol=1e-3)
    expected = guide.laplace_approximation(batch).get_posterior()
    torch.testing.assert_close(expected.covariance_matrix, torch.block_diag(*covariance(result)), rtol=0, atol=1e-3)
    torch.testing.assert_close(result.draw(2000)["w"].std(0), result.deviation["w"], rtol=0.1, atol=0)


def wells(batch):
    """A density with modes at about -2 and 2; the higher one is on the side of the tilt."""
    with pyro.plate("sequences", len(batch["tilt"])):
        w = pyro.sample("w", dist.Normal(torch.zeros(len(batch["tilt"]), dtype=torch.float64), 2.0))
        pyro.factor("wells", -(w.square() - 4).square() + batch["tilt"] * w)


def test_the_best_of_several_starts_is_returned():
    tilt = torch.tensor([1.0, -1.0, 0.5, -0.5] * 10, dtype=torch.float64)
    result = dvae.posterior(wells, {"tilt": tilt}, descent=dvae.Descent(steps=60, starts=16))
    assert torch.equal(result.mode["w"].sign(), tilt.sign())
    assert not result.behind[0].any()
    assert (result.behind >= 0).all()
    assert (result.energy <= result.energies[0] + 1e-12).all()
    assert result.moved.abs().max() < 0.1
    single_start = dvae.posterior(wells, {"tilt": tilt}, descent=dvae.Descent(steps=60, starts=1, candidates=1))
    assert not torch.equal(single_start.mode["w"].sign(), tilt.sign())


def test_the_energy_of_a_network_with_attention_has_no_slope_at_its_mode():
    pair = "p(w) p(x_t | x_{<t}, w)", "q(w | x_{1:T})"
    model = dvae.DynamicalVAE(*pair, {"w": 1, "x": 2}, dvae.networks.Attention(8, 2)).double()
    batch = {"x": torch.randn(3, 4, 2, dtype=torch.float64)}
    w = dvae.posterior(model.model, batch, descent=QUICK).mode["w"].requires_grad_()
    trace = pyro.poutine.trace(pyro.poutine.condition(model.model, {"w": w})).get_trace(batch)
    slope = torch.autograd.grad(trace.log_prob_sum(), w)[0]
    torch.testing.assert_close(slope, torch.zeros_like(w), rtol=0, atol=1e-3)


def test_unsupported_programs_are_errors():
    batch = {"x": torch.zeros(3, 5, dtype=torch.float64)}

    def observed_only(batch):
        with pyro.plate("sequences", len(batch["x"])):
            pyro.sample("x", dist.Normal(torch.zeros_like(batch["x"]), 1.0).to_event(1), obs=batch["x"])

    def two_heaped(batch):
        rows = len(batch["x"])
        with pyro.plate("sequences", rows):
            heaps = dist.Normal(torch.tensor([-2.0, 2.0]).expand(rows, 2), 0.5)
            w = pyro.sample("w", dist.MixtureSameFamily(dist.Categorical(torch.ones(rows, 2)), heaps))
            pyro.factor("near 0", -50 * w.square())

    for program, message in ((observed_only, "has no latents"), (two_heaped, "not log-concave")):
        with pytest.raises(ValueError, match=message):
            dvae.posterior(program, batch, descent=QUICK)
    model = dvae.linear_gaussian_surrogate("p(z_t) p(x_t | z_t)", "q(z_t | x_t)", {"z": 1, "x": 1}, 3)
    ragged = {"x": model.sample(2, 3)["x"], "lengths": torch.tensor([3, 2])}
    with pytest.raises(ValueError, match="after the last step of a shorter sequence; use priors such as normals"):
        dvae.posterior(model.model, ragged, descent=BRIEF)
    with pytest.raises(ValueError, match="at least as many candidates"):
        dvae.Descent(starts=5, candidates=4)
