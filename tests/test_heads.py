"""Heads: what they draw is what they say, scales stay positive, and a description is plain data."""

import json
from dataclasses import asdict, replace

import pytest
import torch

import dvae
from dvae import heads
from dvae.conditional import Conditional
from dvae.networks import Dense, Recurrent
from dvae.notation import Factorization

HEADS = {
    "normal": heads.Normal(),
    "normal, residual": heads.Normal(residual=True),
    "fixed": heads.FixedNormal(scale=0.5),
    "fixed, learned": heads.FixedNormal(scale=0.5, learned=True, residual=True),
    "fixed, by step": heads.FixedNormal(scale=2.0, learned=True, steps=3),
    "fixed, unprojected": heads.FixedNormal(project=False),
    "student": heads.StudentT(df=9.0),
    "student, residual": heads.StudentT(df=9.0, residual=True),
}
B, T, D = 2, 3, 2


def build(name):
    head = HEADS[name].build(D, D).double()
    with torch.no_grad():
        for parameter in head.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return head


def previous(head, *shape):
    return torch.randn(*shape, D, dtype=torch.float64) if head.residual else None


@pytest.mark.parametrize("name", HEADS)
def test_draws_have_the_mean_and_the_variance_of_the_distribution(name):
    head = build(name)
    parameters = head(torch.randn(B, T, D, dtype=torch.float64), previous(head, B, T))
    law = head.distribution(parameters)
    n = 20_000
    draws = head.draw(tuple(p.expand(n, B, T, D) for p in parameters), head.noise((n, B, T, D), parameters[0]))
    z_mean = (draws.mean(0) - law.mean) / (law.stddev / n**0.5)
    # The variance of a sample variance needs the fourth moment, which is finite here (df is 9 or so).
    squares = (draws - law.mean).square()
    z_variance = (squares.mean(0) - law.variance) / (squares.std(0) / n**0.5)
    assert z_mean.abs().max() < 5
    assert z_variance.abs().max() < 5


def test_student_t_draws_follow_its_cumulative_distribution():
    head = build("student")
    loc, scale, df = (p.detach() for p in head(torch.zeros(1, D, dtype=torch.float64)))
    shape = (20_000, D)
    draws = head.draw(tuple(p.expand(shape) for p in (loc, scale, df)), head.noise(shape, loc))
    stats = pytest.importorskip("scipy.stats")
    for d in range(D):
        law = stats.t(df[0, d].item(), loc[0, d].item(), scale[0, d].item())
        assert stats.kstest(draws[:, d].detach().numpy(), law.cdf).pvalue > 1e-4


@pytest.mark.parametrize("name", HEADS)
def test_draws_are_reparameterised(name):
    head = build(name)
    features = torch.randn(B, T, D, dtype=torch.float64, requires_grad=True)
    parameters = head(features, previous(head, B, T))
    head.draw(parameters, head.noise((B, T, D), features)).square().sum().backward()
    assert features.grad is not None
    assert features.grad.abs().min() > 0


@pytest.mark.parametrize("name", HEADS)
def test_parameters_of_one_step_are_those_of_all_steps(name):
    head = build(name)
    features, before = torch.randn(B, T, D, dtype=torch.float64), previous(head, B, T)
    together = head(features, before)
    for t in range(T):
        alone = head(features[:, t], None if before is None else before[:, t], t)
        torch.testing.assert_close(alone, tuple(p[:, t] for p in together))


@pytest.mark.parametrize("name", [name for name in HEADS if "residual" in name or name == "fixed, learned"])
@pytest.mark.parametrize("share", [1.0, 0.3])
def test_a_residual_location_keeps_its_share_of_the_previous_value(name, share):
    head = replace(HEADS[name], residual=share).build(D, D).double()
    features, before = torch.randn(B, T, D, dtype=torch.float64), previous(head, B, T)
    there, here = head(features, before), head(features, torch.zeros_like(before))
    torch.testing.assert_close(there[0] - here[0], share * before)
    torch.testing.assert_close(there[1:], here[1:])


def test_a_share_of_the_previous_value_is_one():
    for share in (-0.1, 1.1):
        with pytest.raises(ValueError, match="it is a share of the previous value, from 0 to 1"):
            heads.Normal(residual=share).build(D, D)
    with pytest.raises(ValueError, match="residual is 2; it must be a share, between 0 and 1"):
        dvae.method("srnn", residual=2)


@pytest.mark.parametrize("spec", [heads.Normal(min_scale=0.2), heads.StudentT(min_scale=0.2)])
def test_scales_stay_above_their_minimum(spec):
    head = spec.build(D, D)
    with torch.no_grad():
        head.out.bias.fill_(-1e4)
    scale = head(torch.zeros(1, D))[1]
    assert scale.min() >= 0.2
    assert torch.isfinite(head.distribution(head(torch.zeros(1, D))).log_prob(torch.full((1, D), 1e3))).all()


def test_initial_scales_and_degrees_of_freedom_are_those_asked_for():
    assert torch.allclose(
        heads.FixedNormal(scale=0.3, learned=True).build(D, D)(torch.zeros(1, D))[1], torch.tensor(0.3)
    )
    assert torch.allclose(heads.StudentT(df=7.5).build(D, D)(torch.zeros(1, D))[2], torch.tensor(7.5))


@pytest.mark.parametrize("name", HEADS)
def test_a_description_is_plain_data(name):
    spec = HEADS[name]
    assert type(spec)(**json.loads(json.dumps(asdict(spec)))) == spec


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: heads.StudentT(df=2.0).build(D, D), "df > 2, where the variance is finite; got 2.0"),
        (lambda: heads.FixedNormal(project=False).build(3, D), "takes 2 features, but the network gives 3"),
        (lambda: heads.FixedNormal(scale=0.0).build(D, D), "scale is positive, got 0.0"),
        (
            lambda: heads.FixedNormal(steps=2).build(D, D, local=False),
            r"FixedNormal\(steps=2\) has one scale per time step, but its variable is static",
        ),
        (
            lambda: heads.FixedNormal(steps=2).build(D, D)(torch.zeros(B, T, D)),
            r"FixedNormal\(steps=2\) was given 3 steps",
        ),
        (
            lambda: heads.FixedNormal(steps=2).build(D, D)(torch.zeros(B, D), t=2),
            r"FixedNormal\(steps=2\) was given 3 steps",
        ),
    ],
)
def test_refusals(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("equation", ["p(x_t | z_t)", "p(x_t | x_{t-2})", "p(x | z)"])
def test_a_residual_head_needs_the_previous_value(equation):
    factor = Factorization.parse(equation).factors[0]
    with pytest.raises(ValueError, match=r"residual head, which adds .* but it does not read that"):
        Conditional(factor, {"x": D, "z": D}, Dense(), heads.Normal(residual=True), generative=True)


@pytest.mark.parametrize("equation", ["q(w | x_{1:T})", "p(w | v)"])
def test_a_static_variable_has_no_scales_by_step(equation):
    factor = Factorization.parse(equation).factors[0]
    sizes = {"w": D, "v": 1, "x": D}
    with pytest.raises(ValueError, match=r"its variable is static, with one value per sequence; .* with steps=0"):
        Conditional(factor, sizes, Recurrent(4), heads.FixedNormal(learned=True, steps=T), generative=False)
    Conditional(factor, sizes, Recurrent(4), heads.FixedNormal(learned=True), generative=False)
