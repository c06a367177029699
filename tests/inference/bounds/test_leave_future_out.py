"""Leave-future-out densities: differences of exact evidences, errors that cover, and no look at the future."""

import math

import pyro
import pytest
import scipy
import torch

from dvae import Discrete, DynamicalVAE, Oracle, iwae_bound, linear_gaussian_surrogate
from dvae.data.views import View
from dvae.distributions import FixedNormal
from dvae.inference.bounds import leave_future_out as module
from dvae.inference.bounds.leave_future_out import REPLICATES, leave_future_out, mixture
from dvae.networks import Dense, Linear, Recurrent

T = 6
P = "p(z_t | z_{t-1}) p(x_t | z_t)"
SMOOTHING = (P, "q(z_t | z_{t-1}, x_{t:T})", {"z": 1, "x": 2})
BACKWARD = (P, "q(z_t | z_{t+1}, x_{1:T})", {"z": 1, "x": 2})
STATIC = (
    "p(w) p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t, w)",
    "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{t-1:T}, w)",
    {"w": 1, "z": 1, "x": 2},
)


def wide(pair, steps=T):
    """Return a surrogate whose guide is a little wider than the posterior, so that weights have light tails."""
    model = linear_gaussian_surrogate(*pair, steps, scale=0.5)
    Oracle(model, steps).fit_guide(30)
    with torch.no_grad():
        for conditional in model.encoder.values():
            conditional.head.log_scale.add_(0.2)
    return model


def brute_force(model, batch, observed, horizon):
    """Return the sum over origins of log p(x_{t+1:t+M} | x_{1:t}), each from two exact evidences."""
    lengths = batch.get("lengths", torch.full((len(batch["x"]),), batch["x"].shape[1]))

    def evidence(row, steps):
        prefix = {n: batch[n][row : row + 1, :steps] for n in ("x", "mask") if n in batch}
        return Oracle(model, steps).evidence(prefix)[0]

    return torch.stack(
        [
            sum(evidence(row, t + horizon) - evidence(row, t) for t in range(observed, int(lengths[row]) - horizon + 1))
            for row in range(len(lengths))
        ]
    ).detach()


def without_exact_filter(monkeypatch):
    monkeypatch.setattr(module, "is_linear_gaussian", lambda _: False)


@pytest.mark.parametrize(("observed", "horizon"), [(1, 1), (2, 2), (2, 4), (1, 4), (5, 1)])
@pytest.mark.parametrize("kind", ["whole", "ragged", "missing"])
def test_linear_gaussian_densities_are_exact(kind, observed, horizon):
    model = linear_gaussian_surrogate(*STATIC, T, scale=0.5)
    pyro.set_rng_seed(0)
    batch = {"x": model.sample(3, T)["x"]}
    if kind == "ragged":
        batch["lengths"] = torch.tensor([T, observed + horizon, T])
    if kind == "missing":
        batch["mask"] = torch.rand(batch["x"].shape) > 0.3
    out = leave_future_out(model, batch, observed, horizon)
    torch.testing.assert_close(out.elpd, brute_force(model, batch, observed, horizon), rtol=0, atol=1e-8)
    assert not out.error.any()
    origins = batch.get("lengths", torch.full((3,), T)) - observed - horizon + 1
    assert out.n_steps.tolist() == (horizon * origins).tolist()


def test_dense_networks_without_layers_and_with_context_are_linear():
    pair = "p(z_t | z_{t-1}) p(x_t | z_t, u_t)", "q(z_t | z_{t-1}, x_t)"
    torch.manual_seed(0)
    model = DynamicalVAE(
        *pair, {"z": 2, "x": 1, "u": 1}, Dense(()), {"p(z)": FixedNormal(), "p(x)": FixedNormal()}
    ).double()
    x, u = torch.randn(3, T, 1).double(), torch.randn(3, T, 1).double()
    out = leave_future_out(model, {"x": x, "u": u}, 2)
    assert not out.error.any()
    increments = model.filter({"x": x, "u": u}).filtered.log_evidence
    torch.testing.assert_close(out.elpd, increments[:, 2:].sum(1), rtol=0, atol=1e-10)


def test_densities_of_summed_out_chains_are_exact():
    model = linear_gaussian_surrogate("p(k_t | k_{t-1}) p(x_t | k_t)", "", {"k": Discrete(3), "x": 2}, T, scale=1.0)
    x = model.sample(4, T)["x"]
    out = leave_future_out(model, x, 2, 2)
    torch.testing.assert_close(out.elpd, brute_force(model, {"x": x}, 2, 2), rtol=0, atol=1e-8)


@pytest.mark.parametrize("pair", [SMOOTHING, BACKWARD, STATIC])
@pytest.mark.parametrize("horizon", [1, 2])
def test_intervals_of_estimates_cover_the_exact_density(monkeypatch, pair, horizon):
    model, count = wide(pair), 400
    pyro.set_rng_seed(0)
    x = model.sample(count, T)["x"]
    exact = leave_future_out(model, x, 3, horizon).elpd
    without_exact_filter(monkeypatch)
    out = leave_future_out(model, x, 3, horizon, 50)
    inside = (out.elpd - exact).abs() < scipy.special.stdtrit(REPLICATES - 1, 0.95) * out.error
    assert abs(inside.double().mean() - 0.9) < 4 * math.sqrt(0.09 / count)
    assert abs((out.elpd - exact).mean()) < 4 * out.error.square().sum().sqrt() / count < 0.05


def test_estimates_of_a_nonlinear_model_equal_many_importance_weights():
    torch.manual_seed(0)
    model = DynamicalVAE(*SMOOTHING, Recurrent(8)).double()
    x = 0.5 * torch.randn(4, T, 2, dtype=torch.float64)
    out = leave_future_out(model, x, 2, 3, 400)
    expected = sum(
        iwae_bound(model, x[:, : t + 3], 40_000).bound - iwae_bound(model, x[:, :t], 40_000).bound for t in (2, 3)
    )
    assert ((out.elpd - expected).abs() < 6 * out.error + 0.02).all()
    assert (out.error < 0.1).all()


@pytest.mark.parametrize("pair", [SMOOTHING, BACKWARD, STATIC])
def test_the_evidence_of_a_prefix_does_not_depend_on_the_future(pair):
    torch.manual_seed(0)
    model = DynamicalVAE(*pair, Recurrent(4)).double()
    x = torch.randn(3, T, 2, dtype=torch.float64)
    changed = torch.cat([x[:, :3], torch.randn(3, T - 3, 2, dtype=torch.float64)], 1)
    results = []
    for each in (x, changed):
        pyro.set_rng_seed(1)
        results.append(leave_future_out(model, each, 3, 1, 8).logs[0])
    assert torch.equal(*results)


class Doubled(View):
    """The model's x is twice the data."""

    names = ("x", "doubled")

    def __call__(self, data, view_inputs=None):
        return data if "doubled" in data else data | {"x": 2 * data["x"], "doubled": data["x"][:, 0] * 0}

    def inverse(self, model_values):
        return {"x": model_values["x"] / 2}

    def log_det(self, data):
        return torch.full_like(data["x"], math.log(2))


def test_densities_are_in_units_of_the_data():
    torch.manual_seed(0)
    viewed = DynamicalVAE("p(x_t | x_{t-1})", "", {"x": 2}, Linear(T), view=Doubled()).double()
    plain = DynamicalVAE("p(x_t | x_{t-1})", "", {"x": 2}, Linear(T)).double()
    plain.load_state_dict(viewed.state_dict())
    x = torch.randn(3, T, 2, dtype=torch.float64)
    for observed, horizon in ((2, 1), (2, 2)):
        out, expected = (leave_future_out(m, v, observed, horizon) for m, v in ((viewed, x), (plain, 2 * x)))
        torch.testing.assert_close(out.elpd, expected.elpd + 2 * math.log(2) * out.n_steps)


def test_a_mixture_is_the_conditional_density_of_mixed_evidences():
    models = [linear_gaussian_surrogate(*STATIC, T, seed, scale=0.5) for seed in range(3)]
    x = models[0].sample(4, T)["x"]
    out = mixture([leave_future_out(model, x, 2) for model in models])
    whole, past = (
        torch.stack([Oracle(model, steps).evidence(x[:, :steps]) for model in models]).logsumexp(0) for steps in (T, 2)
    )
    torch.testing.assert_close(out.elpd, (whole - past).detach(), rtol=0, atol=1e-8)


def test_models_without_a_density_of_the_future_are_refused():
    x = torch.randn(4, T, 2)
    model = DynamicalVAE(P, "q(z_t | x_t)", {"z": 1, "x": 2})
    for observed, horizon in ((0, 1), (2, 0), (T, 1), (3, 4)):
        with pytest.raises(ValueError, match="at least 1 observed step"):
            leave_future_out(model, x, observed, horizon)
    ahead = DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_{1:T})", "q(z_t | x_t)", {"z": 1, "x": 2})
    with pytest.raises(ValueError, match="depends on later steps"):
        leave_future_out(ahead, x, 3)
    shared = DynamicalVAE("p(w) p(x_t | w)", "q(w | x_{1:T})", {"w": 1, "x": 2}, grouped=("w",))
    with pytest.raises(ValueError, match="remove 'group'"):
        leave_future_out(shared, {"x": x, "group": torch.tensor([0, 0, 1, 1])}, 3)
