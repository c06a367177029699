"""Laws with one density for all that a step has: normals with full covariance, and classes."""

import math
from dataclasses import dataclass

import pyro.distributions as dist
import pytest
import torch
from pyro import poutine
from torch import nn

import dvae
from dvae import DynamicalVAE, SequenceELBO, importance_bound, particle_bound
from dvae.distributions import FixedNormal, Law, Vamp
from dvae.inference.bounds.particles import Filter
from dvae.networks import Linear, Recurrent
from dvae.program.reference import reference

B, T = 3, 5
PAIR = "p(w) p(z_t | z_{t-1}, w) p(x_t | x_{t-1}, z_t, w)", "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{1:T}, w)"
SIZES = {"w": 2, "z": 2, "x": 3}


@dataclass(frozen=True)
class Own:
    """A law of the user's own, of any class."""

    kind: type

    def build(self, shape):
        return self.kind(shape)


class Full(Law):
    """A normal with full covariance, the same everywhere."""

    def __init__(self, shape):
        super().__init__()
        self.out = nn.Linear(shape.features, shape.size)
        self.root = nn.Parameter(torch.eye(shape.size) + 0.3 * torch.randn(shape.size, shape.size))

    def forward(self, features, previous=None, t=None):
        loc = self.out(features)
        root = self.root.tril(-1) + self.root.diagonal().exp().diag()
        return loc, root.expand(*loc.shape, -1)

    def distribution(self, parameters):
        return dist.MultivariateNormal(parameters[0], scale_tril=parameters[1], validate_args=False)


class Classes(Law):
    """One class of so many, as its indicator."""

    def __init__(self, shape):
        super().__init__()
        self.out = nn.Linear(shape.features, shape.size)

    def forward(self, features, previous=None, t=None):
        return (self.out(features).softmax(-1),)

    def distribution(self, parameters):
        return dist.OneHotCategorical(parameters[0], validate_args=False)


FULL = {key: Own(Full) for key in ("p(z)", "p(x)", "q(w)", "q(z)")}
LAWS = {
    "all": FULL,
    "latents": {**FULL, "p(x)": FixedNormal(learned=True)},
    "guide": {"q": Own(Full)},
    "classes": {"p(x)": Own(Classes)},
    "vamp": {**FULL, "p(w)": Vamp(3, 4)},
}


def build(kind, network=None):
    return DynamicalVAE(*PAIR, SIZES, network or Recurrent(4), LAWS[kind]).double()


def data(kind, **rest):
    x = torch.randn(B, T, 3, dtype=torch.float64)
    return {"x": dist.OneHotCategorical(logits=x).sample() if kind == "classes" else x, **rest}


def whole_steps():
    return (torch.rand(B, T, 1) < 0.6).expand(-1, -1, 3)


BATCHES = {
    "plain": dict,
    "ragged": lambda: {"lengths": torch.tensor([T, 2, 1])},
    "missing": lambda: {"mask": whole_steps()},
    "both": lambda: {"mask": whole_steps(), "lengths": torch.tensor([T, 2, 1])},
}


@pytest.mark.parametrize("kind", LAWS)
def test_the_log_joint_is_that_of_the_program_step_by_step(kind):
    model, batch = build(kind), data(kind)
    latents = model.guide(batch)
    sites = {"w": latents["w"]} | {f"z_{t + 1}": latents["z"][:, t] for t in range(T)}
    trace = poutine.trace(poutine.condition(lambda: reference(model, batch), data=sites)).get_trace()
    trace.compute_log_prob()
    found = model.log_joint(batch, latents)
    for name in ("w", "z", "x"):
        steps = [site for key, site in trace.nodes.items() if key.split("_")[0] == name and "log_prob" in site]
        torch.testing.assert_close(found[name], sum(site["log_prob"] for site in steps))


def test_the_log_joint_of_a_linear_model_is_one_dense_normal():
    """v = W v + b + L e for all values v of a sequence, with a block of L for every step."""
    pair = "p(z_t | z_{t-1}) p(x_t | x_{<t}, z_t)", "q(z_t | x_{1:T})"
    model = DynamicalVAE(*pair, {"z": 2, "x": 3}, Linear(T), Own(Full)).double()

    def laws(v):
        values = {"z": v[: 2 * T].view(1, T, 2), "x": v[2 * T :].view(1, T, 3)}
        return [model.generator[name](values, 1, T) for name in ("z", "x")]

    def means(v):
        return torch.cat([loc.flatten() for loc, _ in laws(v)])

    zero = torch.zeros(5 * T, dtype=torch.float64)
    spread = (torch.eye(5 * T) - torch.autograd.functional.jacobian(means, zero)).inverse()
    roots = torch.block_diag(*(root for _, by_step in laws(zero) for root in by_step[0]))
    dense = dist.MultivariateNormal(spread @ means(zero), spread @ roots @ roots.T @ spread.T)
    z, x = (torch.randn(B, T, d, dtype=torch.float64) for d in (2, 3))
    found = model.log_joint(x, {"z": z})
    torch.testing.assert_close(found["z"] + found["x"], dense.log_prob(torch.cat([z.flatten(1), x.flatten(1)], 1)))


@pytest.mark.parametrize("kind", LAWS)
def test_padding_and_what_is_missing_change_nothing(kind):
    model, mask, lengths = build(kind), whole_steps(), torch.tensor([T, 2, 1])
    given = data(kind, mask=mask, lengths=lengths)
    shown = mask & (torch.arange(T) < lengths[:, None])[..., None]
    garbage = {**given, "x": torch.where(shown, given["x"], math.nan)}
    bounds = []
    for batch in (given, garbage):
        torch.manual_seed(2)
        bounds.append(SequenceELBO().terms(model, batch).bound)
    assert torch.equal(*bounds)
    longer = {**given, "x": nn.functional.pad(given["x"], (0, 0, 0, 2)), "mask": nn.functional.pad(mask, (0, 0, 0, 2))}
    latents = model.guide(given)
    padded = {**latents, "z": nn.functional.pad(latents["z"], (0, 0, 0, 2))}
    torch.testing.assert_close(model.log_joint(longer, padded), model.log_joint(given, latents))


def test_a_step_is_missing_as_a_whole_or_not_at_all():
    model, mask = build("all"), torch.ones(B, T, 3, dtype=torch.bool)
    mask[1, 2, 0] = False
    with pytest.raises(ValueError, match="entries"):
        SequenceELBO().terms(model, data("all", mask=mask))
    assert torch.isfinite(SequenceELBO().terms(build("latents"), data("all", mask=mask)).bound).all()


@torch.no_grad()
@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("kind", LAWS)
def test_particles_weigh_what_the_program_scores(kind, batch):
    """Without resampling, the particle filter is importance sampling; with it, it runs."""
    model, given = build(kind), data(kind, **BATCHES[batch]())
    run = Filter(model, given, 4)
    bound = run.run(0.0).bound
    latents = {name: value for name, value in run.drawn.items() if name in model.latents}
    many = dvae.program.batch.repeat(given, 4)
    trace = poutine.trace(poutine.condition(model.guide, data=latents)).get_trace(many)
    trace.compute_log_prob()
    log_q = sum(trace.nodes[name]["log_prob"] for name in model.latents)
    expected = sum(model.log_joint(many, latents).values()) - log_q
    torch.testing.assert_close(bound, expected.unflatten(0, (4, -1)).logsumexp(0) - math.log(4))
    assert torch.isfinite(particle_bound(model, given, 8, resample_below=1.0).bound).all()
    assert torch.isfinite(importance_bound(model, given, 30).bound).all()


@pytest.mark.parametrize("kind", LAWS)
def test_values_are_drawn_step_by_step_as_they_are_scored(kind):
    model, x = build(kind), data(kind)["x"]
    draws = model.forecast(x, 3, 4, draw_emission=True)["x"]
    assert draws.shape == (4, B, 3, 3)
    assert torch.isfinite(model.reconstruct(x, 2)["x"]).all()
    assert SequenceELBO(2).terms(model, x).bound.shape == (B,)
    free = poutine.trace(model.model).get_trace(length=T, size=B)
    free.compute_log_prob()
    values = {name: free.nodes[name]["value"] for name in ("w", "z", "x")}
    scored = model.log_joint(values.pop("x"), values)
    torch.testing.assert_close({name: free.nodes[name]["log_prob"] for name in scored}, scored)
    if kind == "classes":
        assert (draws.sum(-1) == 1).all()
        assert model.forecast(x, 2)["x"].unique().tolist() == [0, 1]
