"""The linear SDE: its transitions solve the equation, over the shortest and the longest gaps."""

import math
from itertools import pairwise
from typing import ClassVar

import numpy as np
import pytest
import torch
from scipy import integrate, linalg
from torch.autograd import gradcheck
from torch.distributions import MultivariateNormal

from dvae import DynamicalVAE, distributions
from dvae.factorization.relations import Relation
from dvae.networks import Dense, Input, Linear, LinearSDE, LinearSDEGuide, Recurrent
from dvae.networks.base import share_modules
from dvae.networks.sde import transition
from dvae.testing import FactorizationContract

PAIR = "p(z_t | z_{t-1}, d_t) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T}, d_{1:T})"
GAPS = [1e-6, 1e-3, 0.04, 0.7, 3.0, 40.0, 1e5]


def double(*shape):
    return torch.randn(*shape, dtype=torch.float64)


def stable(size=4):
    """Return a random stable A and the factor L of its noise."""
    skew, root = double(size, size), double(size, size)
    return skew - skew.mT - 0.2 * root @ root.mT - 0.05 * torch.eye(size), double(size, size - 1)


def network(size=3, dtype=torch.float64):
    inputs = [Input("z", size, Relation.parse("t-1")), Input("d", 1, Relation.parse("t"))]
    return LinearSDE((0.5, 8.0)).build(inputs, True, size).to(dtype)


def model(guide=PAIR[1], scale=0.3):
    networks = {"p(z)": LinearSDE((0.5, 8.0)), "p(x)": Dense(()), "q": Recurrent(4)}
    heads = {"p(z)": distributions.Triangular(), "p(x)": distributions.FixedNormal(scale)}
    return DynamicalVAE(PAIR[0], guide, {"z": 2, "x": 3, "d": 1}, networks, heads).double()


# ------------------------------------------------------------------------------------------------- the transition


def test_a_transition_is_the_matrix_exponential_and_the_noise_integral():
    drift, root = stable()
    noise, gaps = root @ root.mT, torch.tensor(GAPS[:-1], dtype=torch.float64)
    matrix = drift.numpy()
    size = len(matrix)
    for gap, decay, spread in zip(GAPS[:-1], *transition(drift, noise, gaps), strict=True):
        np.testing.assert_allclose(decay, linalg.expm(matrix * gap), rtol=1e-8, atol=1e-12)

        def rate(s):
            decay = linalg.expm(matrix * s)
            return decay @ noise.numpy() @ decay.T

        pieces = np.linspace(0, gap, 1 + math.ceil(gap))
        integral = sum(integrate.quad_vec(rate, a, b, epsabs=1e-13)[0] for a, b in pairwise(pieces))
        np.testing.assert_allclose(spread, integral, rtol=1e-8, atol=1e-8 * spread.abs().max().item())
        if gap <= 3:  # Van Loan's exponential contains e^{-A d}, which overflows over long gaps
            exponential = linalg.expm(np.block([[-matrix, noise.numpy()], [np.zeros((size, size)), matrix.T]]) * gap)
            van_loan = exponential[size:, size:].T @ exponential[:size, size:]
            np.testing.assert_allclose(spread, van_loan, rtol=1e-8, atol=1e-8 * spread.abs().max().item())


def test_its_gradient_equals_finite_differences():
    gaps = torch.tensor([1e-4, 0.3, 2.0, 30.0], dtype=torch.float64)
    drift, root = stable(3)
    assert gradcheck(lambda a, r: transition(a, r @ r.mT, gaps), [drift.requires_grad_(), root.requires_grad_()])
    sde = network()
    d, z = torch.rand(2, 4, 1, dtype=torch.float64) + 0.1, double(2, 4, 3)
    assert gradcheck(lambda *_: sde({"z": z, "d": d}, 4), [*sde.parameters()])
    assert gradcheck(lambda value: sde({"z": value, "d": d}, 4), [z.requires_grad_()])


@pytest.mark.parametrize("size", [1, 8])
def test_float32_is_accurate_from_the_shortest_to_the_longest_gaps(size):
    """Coordinates decay at once or hardly at all; in both cases covariances have accurate Cholesky factors."""
    inputs = [Input("z", size, Relation.parse("t-1")), Input("d", 1, Relation.parse("t"))]
    exact = LinearSDE((0.1, 1000.0)).build(inputs, True, size).equation.double()
    with torch.no_grad():
        exact.turning.mul_(3)
    single = LinearSDE().build(inputs, True, size).equation
    single.load_state_dict(exact.state_dict())
    gaps = 10.0 ** torch.arange(-8, 9)
    is_present = torch.ones(len(gaps), dtype=torch.bool)
    decay, whitening = (part[0] for part in single.over(gaps[None], is_present[None], "d"))
    expected, root = (part[0] for part in exact.over(gaps[None].double(), is_present[None], "d"))
    torch.testing.assert_close(decay.double(), expected, rtol=0, atol=2e-6)
    # compared after whitening by the exact distribution, so directions of little noise count equally
    white = whitening.double() @ torch.linalg.inv(root)
    torch.testing.assert_close(white, torch.eye(size).double().expand_as(white), rtol=0, atol=1e-5)
    assert decay[-1].abs().max() < 1e-6
    torch.testing.assert_close(whitening[-1], torch.eye(size), rtol=0, atol=1e-5)
    whitening.log1p().sum().backward()
    assert all(p.grad.isfinite().all() for p in single.parameters())


# ---------------------------------------------------------------------------------------------------- as a network


def test_steps_without_a_positive_gap_are_an_error():
    d = torch.rand(2, 5, 1, dtype=torch.float64) + 0.1
    d[1, 2:] = 0
    with pytest.raises(ValueError, match="sequence"):
        network()({"z": double(2, 5, 3), "d": d}, 5)


# --------------------------------------------------------------------------------------------------- in the engine


class TestModel(FactorizationContract):
    """The contract. Gaps are positive, and no transition reads the first one."""

    missing: ClassVar = {}
    networks: ClassVar = {"p(z)": LinearSDE((0.5, 8.0)), "p(x)": Dense((4,)), "q": Recurrent(4)}
    given: ClassVar = {"p(z)": distributions.Triangular()}

    def build(self, size):
        return DynamicalVAE(*PAIR, {"z": size, "x": size, "d": 1}, self.networks, self.given)

    def _data(self, *args, **kwargs):
        data = super()._data(*args, **kwargs)
        return {**data, "d": data["d"].exp()}

    def _reads(self, conditional, values, name):
        mask = super()._reads(conditional, values, name)
        if name == "d" and conditional.factor.kind == "p":
            assert not mask[0].any()
            mask[0, 0] = True
        return mask


class TestShared(TestModel):
    """The guide shares the transition of the prior."""

    networks: ClassVar = {**TestModel.networks, "q": LinearSDEGuide(Recurrent(4), (0.5, 8.0))}
    given: ClassVar = {"p(z)": distributions.Triangular(), "q": distributions.Triangular()}

    def build(self, size):
        shared_model = super().build(size)
        share_modules([shared_model.generator["z"].network, shared_model.encoder["z"].network], "equation")
        return shared_model


def kernel(sde_model, times):
    """Return the covariance (T D, T D) of the stationary solution at some times (T,)."""
    sde = sde_model.generator["z"].network.equation
    size, steps = len(sde.drift), len(times)
    covariance = torch.zeros(steps, size, steps, size, dtype=torch.float64)
    for t in range(steps):
        for s in range(t + 1):
            decay = torch.as_tensor(linalg.expm((sde.drift.detach() * (times[t] - times[s])).numpy()))
            covariance[t, :, s], covariance[s, :, t] = decay, decay.mT
    return covariance.view(steps * size, -1)


def gaps_of(times, n=1):
    """Return the gaps (n, T, 1) between times (T,)."""
    return times.diff(prepend=times[:1])[None, :, None].expand(n, -1, -1)


def irregular(steps=7):
    return torch.cumsum(torch.rand(steps, dtype=torch.float64) * 10.0 ** torch.randint(-2, 2, (steps,)), 0)


def test_the_log_joint_is_the_density_of_the_stationary_kernel():
    sde_model, times, z, x = model(), irregular(), double(1, 7, 2), double(1, 7, 3)
    log_density = sde_model.log_joint({"x": x, "d": gaps_of(times)}, {"z": z})["z"]
    distribution = MultivariateNormal(torch.zeros(14).double(), kernel(sde_model, times))
    assert log_density.item() == pytest.approx(distribution.log_prob(z.flatten()).item(), abs=1e-8)


def test_a_forecast_uses_the_given_gaps():
    sde_model, x, d = model(), double(3, 5, 3), torch.ones(3, 7, 1).double()
    d[:, 5], d[:, 6] = 1e-8, 1e6
    z = sde_model.forecast({"x": x, "d": d}, horizon=2, samples=2000)["z"]
    torch.testing.assert_close(z[:, :, 5], z[:, :, 4], rtol=0, atol=2e-3)  # nothing changes over a gap of almost zero
    assert z[:, :, 6].mean(0).abs().max() < 5 / 2000**0.5
    assert (z[:, :, 6].var(0) - 1).abs().max() < 5 * (2 / 2000) ** 0.5
    with pytest.raises(ValueError, match="expected 7 steps"):
        sde_model.forecast({"x": x, "d": d[:, :5]}, horizon=2)


# -------------------------------------------------------------------------------------------------------- the guide


def guide(**options):
    inputs = [
        Input("z", 3, Relation.parse("t-1")),
        Input("x", 2, Relation.parse("1:T")),
        Input("y", 2, Relation.parse("<=t")),
        Input("d", 1, Relation.parse("<=t")),
    ]
    network = LinearSDEGuide(Recurrent(4, hidden=(5,)), (0.5, 8.0), **options).build(inputs, True, 3).double()
    with torch.no_grad():
        network.out.weight.add_(0.2 * torch.randn_like(network.out.weight))
    return network


@pytest.mark.parametrize("given_names", ["xyd", "x"])
def test_single_steps_of_the_guide_equal_all_steps_at_once(given_names):
    sde = guide()
    values = {name: double(4, 6, parent.size) for name, parent in zip("zxyd", sde.inputs, strict=True)}
    values["d"] = values["d"].exp()
    expected, rows = sde(values, 6), torch.tensor([2, 2, 0])
    given_values = {name: values[name] for name in given_names}
    state, selected = sde.start(given_values, 4, 6), sde.select(sde.start(given_values, 4, 6), rows)
    draws = {name: values[name].unbind(1) for name in values if name not in given_names}
    for t in range(6):
        features, state = sde.step(state, t, draws)
        torch.testing.assert_close(features, expected[:, t], rtol=1e-10, atol=1e-10)
        selected_features, selected = sde.step(
            selected, t, {name: [v[rows] for v in value] for name, value in draws.items()}
        )
        torch.testing.assert_close(selected_features, features[rows])


def test_gaps_that_a_loop_draws_may_be_ragged():
    """The gaps of padding are 0, and no transition reads them."""
    sde, lengths, rows = guide(), torch.tensor([6, 1, 3, 4]), torch.tensor([2, 2, 0])
    is_step = (torch.arange(6) < lengths[:, None])[..., None]
    values = {name: double(4, 6, parent.size) for name, parent in zip("zxyd", sde.inputs, strict=True)}
    values = {name: (value.exp() if name == "d" else value) * is_step for name, value in values.items()}
    expected, state = sde(values, 6, lengths), sde.start({"x": values["x"]}, 4, 6, lengths)
    selected, draws = sde.select(state, rows), {name: values[name].unbind(1) for name in "zyd"}
    for t in range(6):
        features, state = sde.step(state, t, draws)
        chosen, selected = sde.step(selected, t, {name: [v[rows] for v in value] for name, value in draws.items()})
        torch.testing.assert_close(features * is_step[:, t], expected[:, t] * is_step[:, t], rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(chosen, features[rows])


def test_a_potential_that_depends_on_the_step_number_is_not_streamed():
    pair = "p(z_t | z_{t-1}, d_t) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t, d_t)"
    potentials = {"dense": Dense((4,)), "linear": Linear(4)}
    models = {
        name: DynamicalVAE(
            *pair, {"z": 2, "x": 3, "d": 1}, {"p(z)": LinearSDE(), "q(z)": LinearSDEGuide(potential=potential)},
            dict.fromkeys(("p(z)", "q(z)"), distributions.Triangular()),
        )
        for name, potential in potentials.items()
    }  # fmt: skip
    batch = {"x": torch.randn(2, 9, 3), "d": torch.rand(2, 9, 1) + 0.1}
    assert models["dense"].filter(batch, particles=10).filtered.log_evidence.isfinite().all()
    with pytest.raises(ValueError, match="9 steps"):
        models["linear"].filter(batch, particles=10)
