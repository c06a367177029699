"""Heads: what they draw is what they say, scales stay positive, and a description is plain data."""

import json
from dataclasses import asdict, dataclass, replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import nn

import dvae
from dvae.laws import families as heads
from dvae.networks import Dense, Recurrent
from dvae.notation import Factorization
from dvae.program.conditional import Conditional

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
    with pytest.raises(ValueError, match="residual is 2; it must be between 0 and 1"):
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


# -------------------------------------------------------------------------------------------- families of one's own


@dataclass(frozen=True)
class Own:
    """A head of the user's own, of any class."""

    kind: type

    def build(self, features, size, local=True):
        return self.kind(features, size)


class Bernoulli(heads.Head):
    """Its location is a probability."""

    def __init__(self, features, size):
        super().__init__()
        self.out = nn.Linear(features, size)

    def forward(self, features, previous=None, t=None):
        return (torch.sigmoid(self.out(features)),)

    def distribution(self, parameters):
        return dist.Bernoulli(parameters[0], validate_args=False)

    def draw(self, parameters, noise):
        return torch.bernoulli(parameters[0])


class Stuck(Bernoulli):
    """A continuous family whose draws have no gradient."""

    def distribution(self, parameters):
        return dist.Normal(parameters[0], 1.0)

    def draw(self, parameters, noise):
        return (parameters[0] + noise).detach()


class OneHot(Bernoulli):
    """All coordinates are one event."""

    def distribution(self, parameters):
        return dist.OneHotCategorical(logits=parameters[0], validate_args=False)

    def draw(self, parameters, noise):
        return self.distribution(parameters).sample()


class Correlated(Bernoulli):
    def distribution(self, parameters):
        return dist.MultivariateNormal(parameters[0], torch.eye(parameters[0].shape[-1]).to(parameters[0]))

    def draw(self, parameters, noise):
        return parameters[0] + noise


PAIR = "p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-1}, x_{1:T})"


def model(**own):
    return dvae.DynamicalVAE(*PAIR, {"z": 2, "x": 2}, Recurrent(4), {f"{k[0]}({k[1]})": Own(h) for k, h in own.items()})


@pytest.mark.parametrize(("place", "factor"), [("qz", r"q\(z_t \|"), ("pz", r"p\(z_t \|")])
def test_discrete_latents_are_refused(place, factor):
    with pytest.raises(ValueError, match=rf"the latent z are discrete by the head of {factor}.*no gradient"):
        model(**{place: Bernoulli})


def test_latents_whose_draws_have_no_gradient_are_refused():
    with pytest.raises(ValueError, match="latent z are not reparameterised"):
        model(qz=Stuck)
    with torch.no_grad():  # the family is what counts, not where the model is made
        model(pz=Stuck)
    with pytest.raises(ValueError, match="latent z are not reparameterised"):  # the prior is the guide
        dvae.DynamicalVAE("p(z_t | c_t) p(x_t | z_t)", None, {"z": 1, "x": 1, "c": 1}, heads={"p(z)": Own(Stuck)})


@pytest.mark.parametrize(
    ("place", "head"), [("px", OneHot), ("px", Correlated), ("qz", Correlated), ("pz", Correlated)]
)
def test_heads_with_events_are_refused(place, head):
    with pytest.raises(ValueError, match=r"one density for each coordinate, here batch \(1, 1, 2\) and no event"):
        model(**{place: head})


class Unsaid(dist.Normal):
    """A distribution that says nothing of its support."""

    @property
    def support(self):
        raise NotImplementedError


class Normalising(heads.NormalHead):
    """It takes statistics of a batch."""

    def __init__(self, features, size):
        super().__init__(heads.Normal(), features, size)
        self.norm = nn.BatchNorm1d(features)

    def forward(self, features, previous=None, t=None):
        return super().forward(self.norm(features.flatten(0, -2)).unflatten(0, features.shape[:-1]))

    def distribution(self, parameters):
        return Unsaid(*parameters)


def test_a_head_is_tried_without_changing_it():
    built = model(qz=Normalising)
    assert built.encoder["z"].head.training
    assert not built.encoder["z"].head.norm.num_batches_tracked
    with torch.inference_mode():
        assert model().sample(2, length=3)["x"].shape == (2, 3, 2)


def test_discrete_data_have_a_head_of_their_own():
    binary = model(px=Bernoulli)
    x = torch.bernoulli(torch.full((3, 5, 2), 0.5))
    bound = dvae.SequenceELBO().terms(binary, x).bound.sum()
    bound.backward()
    assert all(p.grad is not None for p in binary.encoder.parameters())
    drawn = binary.sample(4, length=6)
    assert set(drawn["x"].unique().tolist()) <= {0.0, 1.0}
    site = pyro.poutine.trace(binary.model).get_trace(length=3).nodes
    assert not site["x"]["fn"].has_rsample
    assert site["z"]["fn"].has_rsample
    assert site["z"]["value"].requires_grad


def test_probabilities_are_read_without_unit_and_made_as_they_are():
    """What the data's units are changes what networks read of them, and no probability by itself."""
    plain, standard = model(px=Bernoulli), model(px=Bernoulli)
    standard.load_state_dict(plain.state_dict())
    x = torch.bernoulli(torch.full((3, 5, 2), 0.3))
    units = standard.standardise("x")
    units.fit(x)
    z = torch.randn(3, 5, 2)
    law = standard.generator["x"]({"x": x, "z": z}, 3, 5)
    (expected,) = plain.generator["x"]({"x": units(x), "z": z}, 3, 5)
    # the first step reads 0 before the sequence, in whatever unit
    torch.testing.assert_close(law[0], expected)
    torch.manual_seed(0)
    assert torch.isfinite(dvae.SequenceELBO().terms(standard, x).bound).all()


class Shifted(heads.NormalHead):
    """A residual normal that cannot be put into units."""

    location_scale = False

    def __init__(self, features, size):
        super().__init__(heads.Normal(residual=0.5), features, size)


def test_a_residual_head_without_units_adds_the_value_as_it_is():
    residual = model(px=Shifted)
    x, z = 5 + torch.randn(1, 4, 2), torch.randn(1, 4, 2)
    units = residual.standardise("x")
    units.fit(x)
    conditional = residual.generator["x"]
    loc, _ = conditional({"x": x, "z": z}, 1, 4)
    head = conditional.head
    features = conditional.network({"x": units(x), "z": z}, 4)
    added = torch.cat([torch.zeros(1, 1, 2), x[:, :-1]], 1)
    torch.testing.assert_close(loc, head.out(features)[..., :2] + 0.5 * added)
    state = conditional.start({"z": z}, 1, 4)
    for t in range(4):
        (at_t, _), state = conditional.step(state, t, {"x": list(x.unbind(1))})
        torch.testing.assert_close(at_t, loc[:, t])
