"""Posteriors given part of the data: exact where they are normal, calibrated where they nearly are."""

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


def covariance(found):
    return found.factor @ found.factor.mT


def test_it_is_the_oracles_where_everything_is_normal():
    """Static latents and local ones, whatever is missing."""
    model = dvae.linear_gaussian_surrogate(
        "p(w) p(z_t | z_{t-1}, w) p(x_t | z_t)", "q(w | x_{1:T}) q(z_t | x_{1:T}, w)", _SIZES, 4
    )
    oracle, x = dvae.Oracle(model, 4), model.sample(5, 4)["x"]
    whole = dvae.posterior(model.model, {"x": x}, guide=model.guide, descent=BRIEF)
    mean, spread = oracle.posterior(x)
    torch.testing.assert_close(joined(whole.mode), mean, rtol=0, atol=1e-9)
    torch.testing.assert_close(covariance(whole), spread.expand(5, -1, -1), rtol=0, atol=1e-9)
    for chunk in (4096, 15):
        evidence = whole.evidence(model.model, {"x": x}, 20, chunk=chunk).bound
        torch.testing.assert_close(evidence, oracle.evidence(x), rtol=0, atol=1e-8)
    loss = Trace_ELBO().loss(model.model, whole.guide, {"x": x})  # the normal is a guide, and exact
    assert -loss == pytest.approx(oracle.evidence(x).sum().item(), abs=1e-8)
    assert whole.left.max() < 1e-9
    assert not whole.bent.any()

    seen = torch.rand(x.shape) < 0.5
    part = dvae.posterior(model.model, {"x": x, "mask": seen}, descent=BRIEF)
    mean, precision = oracle._joint()
    everything, latents = torch.linalg.inv(precision), len(mean) - x[0].numel()
    for row in range(5):
        known = latents + seen[row].flatten().nonzero()[:, 0]
        gain = torch.linalg.solve(everything[known][:, known], everything[known][:, :latents]).T
        expected = mean[:latents] + gain @ (x[row].flatten()[known - latents] - mean[known])
        torch.testing.assert_close(joined(part.mode)[row], expected, rtol=0, atol=1e-9)
        left = everything[:latents, :latents] - gain @ everything[known][:, :latents]
        torch.testing.assert_close(covariance(part)[row], left, rtol=0, atol=1e-9)


def bowed(batch):
    """Data on a curved sheet."""
    with pyro.plate("sequences", len(batch["x"])):
        w = pyro.sample("w", dist.Normal(torch.zeros(len(batch["x"]), 2, dtype=torch.float64), 1.0).to_event(1))
        sheet = torch.cat([w, 0.1 * w.square(), 0.3 * w[..., :1].sin()], -1)
        pyro.sample("x", dist.Normal(sheet, 0.3).to_event(1), obs=batch["x"])


def test_pyros_laplace_approximation_of_the_same_program_is_the_same():
    """That of Pyro has one matrix for all sequences, here with nothing between them."""
    batch = {"x": torch.randn(3, 5, dtype=torch.float64)}
    found = dvae.posterior(bowed, batch, descent=QUICK)
    guide = AutoLaplaceApproximation(bowed, init_loc_fn=init_to_value(values={"w": found.mode["w"] + 0.01}))
    guide(batch)
    adam = torch.optim.Adam(guide.parameters(), 0.01)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(adam, 200)
    for _ in range(200):
        adam.zero_grad()
        Trace_ELBO().differentiable_loss(bowed, guide, batch).backward()
        adam.step()
        falling.step()
    torch.testing.assert_close(guide(batch)["w"], found.mode["w"], rtol=0, atol=1e-3)
    theirs = guide.laplace_approximation(batch).get_posterior()
    torch.testing.assert_close(theirs.covariance_matrix, torch.block_diag(*covariance(found)), rtol=0, atol=1e-3)
    torch.testing.assert_close(found.draw(2000)["w"].std(0), found.deviation["w"], rtol=0.1, atol=0)


def wells(batch):
    """Two wells at about -2 and 2, of which the one on the side of the tilt is deeper."""
    with pyro.plate("sequences", len(batch["tilt"])):
        w = pyro.sample("w", dist.Normal(torch.zeros(len(batch["tilt"]), dtype=torch.float64), 2.0))
        pyro.factor("wells", -(w.square() - 4).square() + batch["tilt"] * w)


def test_of_several_starts_the_lowest_is_kept():
    tilt = torch.tensor([1.0, -1.0, 0.5, -0.5] * 10, dtype=torch.float64)
    found = dvae.posterior(wells, {"tilt": tilt}, descent=dvae.Descent(steps=60, starts=16))
    assert torch.equal(found.mode["w"].sign(), tilt.sign())
    assert not found.behind[0].any()
    assert (found.behind >= 0).all()
    assert (found.energy <= found.energies[0] + 1e-12).all()
    assert found.moved.abs().max() < 0.1
    alone = dvae.posterior(wells, {"tilt": tilt}, descent=dvae.Descent(steps=60, starts=1, candidates=1))
    assert not torch.equal(alone.mode["w"].sign(), tilt.sign())


def test_programs_that_cannot_be_searched_say_why():
    batch = {"x": torch.zeros(3, 5, dtype=torch.float64)}

    def known(batch):
        with pyro.plate("sequences", len(batch["x"])):
            pyro.sample("x", dist.Normal(torch.zeros_like(batch["x"]), 1.0).to_event(1), obs=batch["x"])

    def two_heaped(batch):
        rows = len(batch["x"])
        with pyro.plate("sequences", rows):
            heaps = dist.Normal(torch.tensor([-2.0, 2.0]).expand(rows, 2), 0.5)
            w = pyro.sample("w", dist.MixtureSameFamily(dist.Categorical(torch.ones(rows, 2)), heaps))
            pyro.factor("near 0", -50 * w.square())

    for program, message in ((known, "has no latents"), (two_heaped, "not log-concave")):
        with pytest.raises(ValueError, match=message):
            dvae.posterior(program, batch, descent=QUICK)
    with pytest.raises(ValueError, match="at least as many candidates"):
        dvae.Descent(starts=5, candidates=4)
