"""Discrete latents are summed out over all state sequences; bounds, forecasts, oracle and audits follow."""

import math
from typing import ClassVar
from unittest import mock

import pyro
import pytest
import torch
from pyro import poutine
from pyro.infer import Trace_ELBO

import dvae
from dvae import Discrete
from dvae.networks import Dense, Recurrent
from dvae.program import enumeration
from dvae.program.reference import reference
from dvae.testing import FactorizationContract

HMM = ("p(k_t | k_{t-1}) p(x_t | k_t)", "")
SWITCHING = ("p(k_t | k_{t-1}) p(z_t | z_{t-1}, k_t) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T})")
CASES = [
    (("p(k_t | k_{t-2}, x_{t-1}) p(x_t | k_{t-1:t}, x_{<t})", ""), {"k": 2}),
    (("p(m) p(w | m) p(n | w) p(x_t | n, m, w)", "q(w | x_{1:T})"), {"m": 3, "n": 2}),
    (("p(k_t | k_{t-1}, z_{t-1}) p(z_t | z_{t-1}, k_t) p(x_t | z_t)", "q(z_t | x_{1:T})"), {"k": 3}),
    (("p(m) p(k_t | k_{t-1}, m) p(z_t | z_{<t}, k_{t-1}) p(x_t | z_t, k_t)", "faithful"), {"m": 2, "k": 2}),
    (
        ("p(k_t | k_{t-1}) p(s_t | s_{t-1}, k_t) p(z_t | s_t) p(x_t | z_t, k_{t-2}, c_t)", "q(z_t | x_{1:T}, c_{1:T})"),
        {"k": 2, "s": 2},
    ),
]
STEPS, BATCH = 3, 2


def build(equations, states, **more):
    sizes = {"w": 2, "z": 2, "x": 2, "c": 1}
    sizes = {name: size for name, size in sizes.items() if name in "".join(equations)}
    sizes |= {name: Discrete(size) for name, size in states.items()}
    model = dvae.DynamicalVAE(*equations, sizes, more.pop("network", Recurrent(4)), **more)
    return model.double().eval()


def data_of(model, batch=BATCH, steps=STEPS):
    return {n: torch.randn(batch, steps, model.sizes[n]).double() for n in (*model.observed, *model.context)}


def joints(model, data, latents):
    """Return the log joint (C, B) of every state sequence, by the per-step program."""
    state_sequences = model.sums.state_sequences(STEPS)
    log_joints = []
    for index in range(len(next(iter(state_sequences.values())))):
        states = {name: value[index].expand(BATCH, *value[index].shape) for name, value in state_sequences.items()}
        sites = {}
        for name, value in (latents | states).items():
            steps = {f"{name}_{t + 1}": v for t, v in enumerate(value.unbind(1))}
            sites |= {name: value} if value.dim() == 2 else steps
        with torch.no_grad():
            trace = poutine.trace(poutine.condition(reference, data=sites)).get_trace(model, data)
            trace.compute_log_prob(site_filter=lambda name, site: name != "sequences")
        log_joints.append(sum(s["log_prob"] for s in trace.nodes.values() if "log_prob" in s))
    return torch.stack(log_joints)


class TestSwitching(FactorizationContract):
    """A chain of states that chooses the dynamics of a continuous latent."""

    missing: ClassVar = {"z": ("z_{<=t-2}",)}

    def build(self, size):
        sizes = {"k": Discrete(max(size, 2)), "z": size, "x": size}
        return dvae.DynamicalVAE(*SWITCHING, sizes, Recurrent(4, hidden=(4,)))


class TestMixture(FactorizationContract):
    """A state of the sequence, read by a static latent and the data."""

    def build(self, size):
        equations = "p(m) p(w | m) p(x_t | m, w)", "q(w | x_{1:T})"
        return dvae.DynamicalVAE(*equations, {"m": Discrete(3), "w": size, "x": size}, Recurrent(4, hidden=(4,)))


@pytest.mark.parametrize(("equations", "states"), CASES, ids=[equations[0] for equations, _ in CASES])
def test_the_sum_is_over_all_state_sequences(equations, states):
    model = build(equations, states)
    data = data_of(model)
    latents = model.guide(data)
    log_joints = joints(model, data, latents)
    summed = torch.stack(list(model.log_joint(data, latents).values())).sum(0)
    torch.testing.assert_close(summed, log_joints.logsumexp(0), rtol=0, atol=1e-10)
    posterior = log_joints.softmax(0)
    state_sequences, run = model.sums.state_sequences(STEPS), model.rollout(data)
    run.values.update(latents)
    for name, probabilities in run.summation.probabilities().items():
        torch.testing.assert_close(
            probabilities, torch.einsum("cb,c...->b...", posterior, state_sequences[name]), rtol=0, atol=1e-10, msg=name
        )
        assert probabilities.shape == (BATCH, *([STEPS] * model.generative.local(name)), states[name])


def test_every_bound_agrees():
    """Pyro's bound equals the one of terms. The terms of a step are conditional on the past."""
    model = build(SWITCHING, {"k": 3})
    data = data_of(model)
    pyro.set_rng_seed(1)
    terms = dvae.SequenceELBO().terms(model, data)
    pyro.set_rng_seed(1)
    assert Trace_ELBO().loss(model.model, model.guide, data) == pytest.approx(-terms.bound.sum().item(), abs=1e-10)
    assert set(terms.kl) == {"z"}
    assert terms.steps["x"].shape == terms.steps["z"].shape == (BATCH, STEPS)
    hmm = build(HMM, {"k": 3})
    data = data_of(hmm)
    all_steps = dvae.SequenceELBO().terms(hmm, data).steps["x"]
    past = dvae.SequenceELBO().terms(hmm, {"x": data["x"][:, :2]}).steps["x"]
    torch.testing.assert_close(all_steps[:, :2], past)
    assert torch.equal(dvae.iwae_bound(hmm, data, 3).bound, dvae.iwae_bound(hmm, data, 3).bound)


def test_a_forecast_continues_from_the_states_of_the_past():
    """The states of the chain are constant, and the data determine them."""
    model = build(HMM, {"k": 2}, network=Dense(()))
    with torch.no_grad():
        for name, parameter in model.generator.named_parameters():
            parameter.zero_()
            if name == "k.head.out.weight":
                parameter.copy_(40 * torch.eye(2))
            if name == "x.head.out.weight":
                parameter[0] = torch.tensor([-8.0, 8.0])
    past = torch.tensor([[-8.0], [8.0]])[:, None].expand(-1, 4, 2).double()
    forecast = model.forecast(past, 5, 50)
    assert (forecast["k"][:, 0, :, 0] == 1).all()
    assert (forecast["k"][:, 1, :, 1] == 1).all()
    assert (forecast["x"][..., 0].sign() == torch.tensor([-1.0, 1.0])[:, None]).all()
    assert model.states(past)["k"][0, 0, :, 0] == pytest.approx(torch.ones(4).double())
    assert (model.reconstruct(past)["x"][0, :, :, 0].sign() == torch.tensor([-1.0, 1.0])[:, None]).all()
    static = build(("p(m) p(x_t | m)", ""), {"m": 2}, network=Dense(()))
    assert (static.forecast(past, 2, 7)["m"].sum(-1) == 1).all()


def test_the_oracle_sums_over_all_state_sequences():
    """Evidence and moments of a mixture of normals equal quadrature."""
    sizes = {"m": Discrete(2), "k": Discrete(3), "x": 1}
    pair = dvae.linear_gaussian_surrogate("p(m) p(k_t | k_{t-1}, m) p(x_t | k_t, m, x_{t-1})", "", sizes, 3, scale=1.0)
    x = pair.sample(4, 3)["x"]
    oracle = dvae.Oracle(pair, 3)
    torch.testing.assert_close(oracle.evidence(x), sum(pair.log_joint(x, {}).values()), rtol=0, atol=1e-10)
    torch.testing.assert_close(oracle.bound(x), oracle.evidence(x))
    mask = torch.rand_like(x) < 0.6
    with pytest.raises(ValueError, match="cannot be summed out"):
        oracle.evidence({"x": x, "mask": mask})
    hidden = dvae.linear_gaussian_surrogate(*HMM, {"k": Discrete(3), "x": 1}, 3)
    for each, batch in ((pair, {"x": x}), (hidden, {"x": x, "mask": mask})):
        each.standardise("x").double().fit(1 + 2 * x)
        batch["lengths"] = torch.tensor([3, 2, 1, 3])
        joint = sum(each.log_joint(batch, {}).values())
        torch.testing.assert_close(dvae.Oracle(each, 3).evidence(batch), joint, rtol=0, atol=1e-10)
    pair = dvae.linear_gaussian_surrogate(SWITCHING[0], "faithful", {"k": Discrete(3), "z": 1, "x": 1}, 1, scale=1.5)
    oracle, x = dvae.Oracle(pair, 1), pair.sample(4, 1)["x"]
    grid = torch.linspace(-15, 15, 601, dtype=torch.float64)
    joint = [sum(pair.log_joint(x, {"z": z.expand(4, 1, 1)}).values()) for z in grid]
    weights = torch.stack(joint).softmax(0)
    torch.testing.assert_close(oracle.evidence(x), torch.stack(joint).logsumexp(0) + math.log(0.05), rtol=0, atol=1e-8)
    mean, covariance = oracle.posterior(x)
    torch.testing.assert_close(mean[:, 0], (weights * grid[:, None]).sum(0), rtol=0, atol=1e-8)
    square = (weights * grid[:, None] ** 2).sum(0)
    torch.testing.assert_close(covariance[:, 0, 0], square - mean[:, 0] ** 2, rtol=0, atol=1e-8)
    with pytest.raises(ValueError, match="posterior"):
        oracle.fit_guide()
    wild = dvae.linear_gaussian_surrogate("p(k_t | x_{t-1}) p(x_t | k_t)", "", {"k": Discrete(2), "x": 1}, 3)
    with pytest.raises(ValueError, match="no exact result exists"):
        dvae.Oracle(wild, 3)
    with pytest.raises(ValueError, match="state sequences"):
        build(HMM, {"k": 2}).sums.state_sequences(40)


def test_summing_out_a_chain_adds_dependencies_to_the_exact_guide():
    """A summed chain connects all steps, so the posterior of z_t reads the whole past, not only the last step."""
    audit = dvae.audit(*SWITCHING, summed=("k",))
    assert audit.missing == {"z": ("z_{<=t-2}",)}
    assert audit.repaired.text == "q(z_t | z_{<t}, x_{>=t})"
    assert dvae.audit(SWITCHING[0], audit.repaired, summed=("k",)).exact
    single = dvae.faithful_inverse("p(k_t) p(z_t | z_{t-1}, k_t) p(x_t | z_t)", summed=("k",))
    assert single.text == "q(z_t | z_{t-1}, x_{>=t})"
    assert [each.sampled for each in dvae.alternatives(SWITCHING[0], summed=("k",)).guides] == [("z",), ("z",)]
    assert build((SWITCHING[0], "faithful"), {"k": 2}).inference.text == "q(z_t | z_{<t}, x_{>=t})"


@pytest.mark.parametrize(("steps", "n_kept", "states", "lag"), [(64, 2, 3, 1), (99, 1, 2, 3), (1100, 1, 2, 1)])
def test_blocks_of_a_long_chain_change_neither_its_sums_nor_their_gradients(steps, n_kept, states, lag, monkeypatch):
    """Some transitions are impossible, and 1,100 steps take two levels. The tolerance grows with the sums."""
    logs = torch.randn(2, steps, n_kept, states**lag, states, dtype=torch.float64).log_softmax(-1) - 0.5
    logs[..., 0, -1] = -math.inf
    start = torch.randn(2, n_kept, states**lag, dtype=torch.float64)
    results, forward_sums = [], enumeration.forward_sums
    for widest in (enumeration.WIDE, 0):
        recursion = mock.Mock(wraps=forward_sums)
        monkeypatch.setattr(enumeration, "forward_sums", recursion)
        monkeypatch.setattr(enumeration, "WIDE", widest)
        leaves = [v.clone().requires_grad_() for v in (start, logs)]
        values = forward_sums(*leaves)
        assert recursion.called == (steps >= 64 and widest > 0)
        results.append([values, *torch.autograd.grad(values[:, -1].flatten(1).logsumexp(1).sum(), leaves)])
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12 * steps)
