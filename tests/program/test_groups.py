"""Latents of groups: one value and one density for each group, and the evidence of the group."""

import pyro
import torch
from pyro import poutine
from pyro.infer import Trace_ELBO

import dvae
from dvae.distributions import FixedNormal
from dvae.networks import Linear, Recurrent
from dvae.program.groups import Groups
from dvae.testing import FactorizationContract

EQUATIONS = (
    "p(g) p(w | g) p(z_t | z_{t-1}, w) p(x_t | z_t, g)",
    "q(g | x_{1:T}) q(w | x_{1:T}, g) q(z_t | z_{t-1}, x_{1:T}, w)",
)
SIZES = {"g": 2, "w": 2, "z": 2, "x": 3}
INDEX = torch.tensor([7, 3, 7, 7, 3, 9])


def build(**more):
    return dvae.DynamicalVAE(*EQUATIONS, SIZES, Recurrent(4), grouped=("g",), **more).double()


def data(**more):
    return {"x": torch.randn(6, 4, 3).double(), "group": INDEX, **more}


class TestGrouped(FactorizationContract):
    """The contract, where each sequence is a group because the batch has no groups."""

    def build(self, size):
        sizes = dict.fromkeys(SIZES, size)
        return dvae.DynamicalVAE(*EQUATIONS, sizes, Recurrent(4, hidden=(4,)), grouped=("g",))


def test_a_group_has_one_value_whose_density_counts_once():
    model, batch = build(), data()
    trace = poutine.trace(model.guide).get_trace(batch)
    g = trace.nodes["g"]["value"]
    assert len(g.unique(dim=0)) == 3
    assert torch.equal(g, Groups.of(INDEX).shared(g))
    trace.compute_log_prob()
    fn = trace.nodes["g"]["fn"]
    one = fn.base.log_prob(g)[Groups.of(INDEX).first].sum()
    torch.testing.assert_close(trace.nodes["g"]["log_prob"].sum(), one)
    assert not torch.equal(model.guide(batch)["w"][0], model.guide(batch)["w"][2])


def test_a_group_of_one_equals_a_sequence():
    model, batch = build(), data()
    torch.manual_seed(0)
    single_groups = dvae.SequenceELBO().terms(model, {**batch, "group": torch.arange(6)})
    torch.manual_seed(0)
    without = dvae.SequenceELBO().terms(model, {"x": batch["x"]})
    torch.testing.assert_close(single_groups.bound, without.bound)


def test_the_bound_equals_pyros():
    model, batch = build(), data()
    torch.manual_seed(0)
    bound = dvae.SequenceELBO(num_particles=300).terms(model, batch).bound.sum()
    pyro_bounds = -torch.tensor([Trace_ELBO().loss(model.model, model.guide, batch) for _ in range(100)])
    assert abs(pyro_bounds.mean() - bound) < 5 * pyro_bounds.std() / 100**0.5 + 0.2
    pyro.clear_param_store()


def linear(count, steps, exact=True):
    """Return a linear-Gaussian model, data of one group, and their evidence by a dense normal."""
    distributions = {
        "default": FixedNormal(0.7, project=False),
        "p(g)": dvae.distributions.StandardNormal(),
        "q": FixedNormal(1.0, learned=True, project=False),
    }
    pair = "p(g) p(w | g) p(x_t | w)", "q(g | x_{1:T}) q(w | x_{1:T}, g)"
    model = dvae.DynamicalVAE(
        *pair, dict.fromkeys("gwx", 1), Linear(steps=steps), distributions, grouped=("g",)
    ).double()
    with torch.no_grad():
        for parameter in model.generator.parameters():
            parameter.copy_(torch.randn_like(parameter) * 0.3 + 0.6)
    x = torch.randn(count, steps, 1).double()

    def mean(g, w_noise):
        w = model.generator["w"]({"g": g}, len(g), steps)[0] + w_noise
        return model.generator["x"]({"w": w}, len(g), steps)[0]

    zero, one = torch.zeros(1, 1).double(), torch.ones(1, 1).double()
    bias = mean(zero, zero).flatten()
    effect_of_g, effect_of_w = mean(one, zero).flatten() - bias, mean(zero, one).flatten() - bias
    sequence_covariance = 0.49 * torch.outer(effect_of_w, effect_of_w) + 0.49 * torch.eye(steps).double()
    covariance = torch.block_diag(*[sequence_covariance] * count) + torch.outer(
        effect_of_g.repeat(count), effect_of_g.repeat(count)
    )
    evidence = torch.distributions.MultivariateNormal(bias.repeat(count), covariance.detach()).log_prob(x.flatten())
    return model, x, evidence.detach()


def test_the_bound_of_a_group_reaches_its_evidence():
    """The guide reads the mean of a group's sequences, a sufficient statistic of g."""
    model, x, evidence = linear(3, 4)
    batch = {"x": x, "group": torch.zeros(3, dtype=torch.long)}
    optimiser = torch.optim.LBFGS(
        list(model.encoder.parameters()), max_iter=500, line_search_fn="strong_wolfe", tolerance_grad=1e-9
    )

    def closure():
        optimiser.zero_grad()
        torch.manual_seed(0)
        loss = -dvae.SequenceELBO(num_particles=16).terms(model, batch).bound.sum()
        loss.backward()
        return loss

    assert -closure() < evidence - 0.1
    for _ in range(3):
        optimiser.step(closure)
    bounds = torch.stack(
        [dvae.SequenceELBO(num_particles=16).terms(model, batch).bound.sum() for _ in range(50)]
    ).detach()
    assert abs(bounds.mean() - evidence) < 5 * bounds.std() / 50**0.5 + 1e-2
    weighted = dvae.iwae_bound(model, batch, particles=2000).bound
    torch.testing.assert_close(weighted.sum(), evidence, atol=2e-2, rtol=0)
    torch.testing.assert_close(weighted, (weighted.sum() / 3).expand(3))


def test_forecasts_of_a_group_share_one_draw_for_each_sample():
    model, batch = build(), data()
    out = model.forecast(batch, 2, samples=5, chunk=2)
    g = out["g"]
    assert g.shape == (5, 6, 2)
    assert torch.equal(g[:, 0], g[:, 2])
    assert len(g[:, 0].unique(dim=0)) == 5
    assert model.reconstruct(batch, 3)["x"].shape == (3, 6, 4, 3)
