"""Bounds: agreement with Pyro's own, terms that add up, weights that are diagnosed, misuse that is refused."""

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from dense import exact_bound, library_bound
from pyro import poutine
from pyro.infer import Trace_ELBO, TraceMeanField_ELBO
from pyro.infer.autoguide.initialization import InitMessenger, init_to_value

from dvae import DynamicalVAE, Oracle, SequenceELBO, distributions, importance_bound, twin
from dvae.inference.bounds.elbo import _closed_forms, _khat, _traces, sites_of
from dvae.networks import Attention, Linear, Recurrent
from dvae.program.rollout import SelfFeeding, Sequence

B, T = 3, 5
EQUATIONS = (
    "p(w) p(z_t | z_{t-1}, w) p(x_t | x_{<t}, z_t, w)",
    "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{1:T}, w)",
)
SIZES = {"w": 2, "z": 2, "x": 3}
NETWORKS = {"recurrent": Recurrent(4, hidden=(5,)), "attention": Attention(8, heads=2)}


def build(network="recurrent", **options):
    return DynamicalVAE(*EQUATIONS, SIZES, NETWORKS[network], **options).double()


def data(**more):
    return {"x": torch.randn(B, T, 3, dtype=torch.float64), **more}


def mean_field_loss(model, batch):
    """Pyro's own: TraceMeanField_ELBO, for which a Sequence's conditionals at its value are plain normals."""
    guide_trace = poutine.trace(model.guide).get_trace(batch)
    model_trace = poutine.trace(poutine.replay(model.model, trace=guide_trace)).get_trace(batch)
    for trace in (guide_trace, model_trace):
        trace.remove_node("sequences")
        for site in trace.nodes.values():
            if isinstance(site.get("fn"), Sequence):
                site["fn"] = site["fn"].given(site["value"])
        trace.compute_log_prob()
        trace.compute_score_parts()
    return TraceMeanField_ELBO()._differentiable_loss_particle(model_trace, guide_trace)[1]


def at(values):
    """A handler that gives latents these values and leaves them latents."""
    return InitMessenger(init_to_value(values=values))


# ----------------------------------------------------------------------------------------------- agreement with Pyro


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("extra", [{}, {"lengths": torch.tensor([5, 2, 1])}])
def test_the_bound_is_trace_mean_fields(network, extra):
    model, batch = build(network), data(**extra)
    pyro.set_rng_seed(4)
    theirs = mean_field_loss(model, batch)
    pyro.set_rng_seed(4)
    ours = SequenceELBO().differentiable_loss(model.model, model.guide, batch)
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-9)
    for a, b in zip(
        torch.autograd.grad(ours, list(model.parameters()), retain_graph=True),
        torch.autograd.grad(theirs, list(model.parameters())),
        strict=True,
    ):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-8)


def test_it_is_a_pyro_elbo():
    model, batch = build(), data()

    def seeded(run):
        pyro.set_rng_seed(4)
        return run()

    loss = seeded(lambda: SequenceELBO().loss(model.model, model.guide, batch))
    assert loss == pytest.approx(-seeded(lambda: SequenceELBO().terms(model, batch)).bound.sum().item())
    assert loss == pytest.approx(seeded(lambda: SequenceELBO()(model, model.guide)(batch)).item())
    assert loss == pytest.approx(seeded(lambda: SequenceELBO().loss_and_grads(model.model, model.guide, batch)))
    assert all(p.grad is not None for p in model.parameters())


@pytest.mark.parametrize("law", [distributions.Normal(), distributions.StudentT()])
def test_particles_average_to_pyros_trace_elbo(law):
    # A Student t prior has no closed form, and its KL is a log-ratio then.
    model, batch = build(laws={"p(x)": distributions.Normal(), "p(z)": law}), data()
    n = 150
    with torch.no_grad():
        ours = torch.stack([SequenceELBO().terms(model, batch).bound.sum() for _ in range(n)])
        theirs = -torch.tensor([Trace_ELBO().loss(model.model, model.guide, batch) for _ in range(n)])
        error = ((ours.var() + theirs.var()) / n).sqrt()
        many = SequenceELBO(num_particles=n).terms(model, batch).bound.sum()
    assert abs(ours.mean() - theirs.mean()) < 5 * error
    assert abs(many - ours.mean()) < 5 * (2 * ours.var() / n).sqrt()


# ------------------------------------------------------------------------------------------------------------- terms


@pytest.mark.parametrize("lengths", [None, torch.tensor([5, 2, 1])])
def test_steps_sum_to_terms_and_terms_to_the_bound(lengths):
    model = build()
    batch = data() if lengths is None else data(lengths=lengths)
    terms = SequenceELBO().terms(model, batch)
    assert set(terms.log_likelihood) == {"x"}
    assert set(terms.kl) == {"w", "z"}
    assert set(terms.steps) == {"x", "z"}
    assert not terms.energies
    torch.testing.assert_close(terms.steps["x"].sum(1), terms.log_likelihood["x"])
    torch.testing.assert_close(terms.steps["z"].sum(1), terms.kl["z"])
    torch.testing.assert_close(terms.bound, terms.log_likelihood["x"] - terms.kl["z"] - terms.kl["w"])
    assert terms.frames.tolist() == ([T] * B if lengths is None else lengths.tolist())
    torch.testing.assert_close(terms.per_frame, terms.bound / terms.frames)
    assert all((kl >= 0).all() for kl in terms.kl.values())
    if lengths is not None:
        pad = torch.arange(T) >= lengths[:, None]
        assert all((steps[pad] == 0).all() for steps in terms.steps.values())


@pytest.mark.parametrize("analytic", [True, False])
def test_terms_of_a_ragged_batch_are_those_of_its_sequences(analytic):
    model = build(laws=None if analytic else {"p(z)": distributions.StudentT()})
    lengths = torch.tensor([5, 2, 1])
    batch = data(lengths=lengths)
    latents = {name: value.detach() for name, value in model.guide(batch).items()}
    together = SequenceELBO().terms(model, batch, at(latents)(model.guide))
    for i, n in enumerate(lengths.tolist()):
        values = {name: v[i : i + 1, :n] if v.dim() == 3 else v[i : i + 1] for name, v in latents.items()}
        alone = SequenceELBO().terms(model, batch["x"][i : i + 1, :n], at(values)(model.guide))
        torch.testing.assert_close(together.bound[i : i + 1], alone.bound)


def test_penalties_of_a_wrapping_model_are_energies_and_no_part_of_the_bound():
    model, batch = build(), data()
    penalty = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)

    def penalised(batch, **options):
        out = model.model(batch, **options)
        with pyro.plate("penalties", B, dim=-1):
            pyro.factor("smoothness", -penalty)
        return out

    def terms(program):
        pyro.set_rng_seed(4)
        return SequenceELBO().terms(program, batch, model.guide)

    plain, with_energy = terms(model.model), terms(penalised)
    torch.testing.assert_close(with_energy.energies["smoothness"], penalty)
    torch.testing.assert_close(plain.bound, with_energy.bound)
    pyro.set_rng_seed(4)
    loss = SequenceELBO().loss(penalised, model.guide, batch)
    assert loss == pytest.approx((penalty - plain.bound).sum().item())


def test_a_hand_written_guide_is_scored_by_its_log_ratio():
    model = twin("p(z_t) p(x_t | z_t)", "q(z_t | x_t)", {"z": 1, "x": 1}, T)
    x = model.sample(B, T)["x"]

    def guide(batch):
        with pyro.plate("sequences", len(batch), dim=-1):
            pyro.sample("z", dist.Normal(torch.zeros_like(batch), 1.0).to_event(2))

    pyro.set_rng_seed(4)
    guide_trace = poutine.trace(guide).get_trace(x)
    pyro.set_rng_seed(4)
    ours = SequenceELBO().terms(model, x, guide)
    joint = model.log_joint(x, {"z": guide_trace.nodes["z"]["value"]})
    guide_trace.compute_log_prob()
    torch.testing.assert_close(ours.bound.detach(), sum(joint.values()) - guide_trace.nodes["z"]["log_prob"])


# ------------------------------------------------------------------------------------------------ importance weights


def test_importance_bounds_rise_with_particles_to_the_evidence():
    model = twin("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_t)", {"z": 1, "x": 1}, 3, scale=0.5)
    oracle = Oracle(model, 3)
    x = model.sample(1, 3)["x"]
    with torch.no_grad():
        exact, evidence = oracle.bound(x), oracle.evidence(x)
    n = 1500
    means, errors = [exact.item()], [0.0]
    for particles in (1, 4, 16, 64):
        bounds = importance_bound(model, x.repeat(n, 1, 1), particles, chunk=50_000).bound
        means.append(bounds.mean().item())
        errors.append(bounds.std().item() / n**0.5)
    assert abs(means[1] - exact.item()) < 5 * errors[1]
    for before, after, error in zip(means[1:], means[2:], errors[1:], strict=False):
        assert after > before - 5 * error
    assert means[4] > means[1] + 5 * errors[1]
    assert means[4] <= evidence.item() + 5 * errors[4]
    assert abs(means[4] - evidence.item()) < 0.5 * abs(means[1] - evidence.item())


def test_chunks_change_nothing_but_memory():
    model, batch = build(), data()
    pyro.set_rng_seed(1)
    first = importance_bound(model, batch, particles=30, chunk=3)
    pyro.set_rng_seed(1)
    again = importance_bound(model, batch, particles=30, chunk=5)  # 1 particle at a time, too
    torch.testing.assert_close(first.bound, again.bound)
    assert first.bound.shape == first.khat.shape == (B,)
    assert first.particles == 30


def test_an_exact_guide_has_equal_weights_and_a_poor_one_a_heavy_tail():
    exact = twin("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})", {"z": 1, "x": 1}, T)
    oracle = Oracle(exact, T)
    assert oracle.fit_guide() < 1e-6
    x = exact.sample(4, T)["x"]
    assert oracle.evidence(x).detach() == pytest.approx(importance_bound(exact, x, 50).bound, abs=0.05)
    with torch.no_grad():
        for conditional in exact.encoder.values():
            conditional.law.log_scale.sub_(2.0)
    assert importance_bound(exact, x, 400).khat.mean() > 0.7


def test_khat_is_the_shape_of_a_pareto_tail_and_needs_25_particles():
    exponential = -torch.rand(20_000, 20, dtype=torch.float64).log()
    for shape in (0.3, 0.9):
        assert abs(_khat(shape * exponential).mean() - shape) < 0.1
    model, batch = build(), data()
    assert importance_bound(model, batch, particles=24).khat.isnan().all()
    assert importance_bound(model, batch, particles=25).khat.isfinite().all()


def test_khat_of_weights_that_are_the_same_is_zero_and_of_one_that_outweighs_all_large():
    same, alone = torch.zeros(64, 1), -1000.0 * torch.arange(64.0)[:, None]
    infinite = torch.where(torch.arange(64)[:, None] == 3, torch.inf, same)
    assert _khat(torch.cat([same, infinite], dim=1)).tolist() == [0, math.inf]
    assert 1e3 < _khat(alone) < 1e4
    coarse = 1e4 + 1e-3 * torch.randint(0, 2, (64, 5))  # what float32 resolves of a sum of so many nats
    assert (_khat(coarse) < 0.01).all()


def test_importance_weights_of_a_ragged_batch_are_those_of_its_sequences():
    model = twin("p(z_t) p(x_t | z_t)", "q(z_t | x_t)", {"z": 1, "x": 1}, T)
    x = model.sample(2, T)["x"]
    padded = importance_bound(model, {"x": x, "lengths": torch.tensor([2, T])}, particles=3000)
    alone = importance_bound(model, x[:1, :2], particles=3000)
    assert abs(padded.bound[0] - alone.bound[0]) < 0.1


# ------------------------------------------------------------------------------------------------------------ errors


@pytest.mark.parametrize("handler", [lambda f: poutine.scale(f, scale=0.5), lambda f: poutine.mask(f, mask=False)])
def test_scaled_or_masked_sites_are_refused(handler):
    model = build()
    with pytest.raises(ValueError, match="scaled or masked by a handler; weights belong to the objective"):
        SequenceELBO().terms(handler(model.model), data(), model.guide)


def test_latents_of_one_side_only_are_refused():
    model = build()
    with pytest.raises(ValueError, match="the latent w is in the model but not in the guide"):
        SequenceELBO().terms(model, data(), poutine.block(model.guide, hide=["w"]))
    with pytest.raises(ValueError, match="the latent w is in the guide but not in the model"):
        SequenceELBO().terms(poutine.block(model.model, hide=["w"]), data(), model.guide)


@pytest.mark.parametrize("particles", [0, -3])
def test_particles_are_at_least_one(particles):
    with pytest.raises(ValueError, match=f"particles is at least 1, got {particles}"):
        importance_bound(build(), data(), particles)


def test_evaluation_leaves_the_mode_and_takes_no_gradient():
    model = build().train()
    assert not importance_bound(model, data(), 2).bound.requires_grad
    assert model.training
    assert math.isfinite(importance_bound(model.eval(), data(), 2).bound.sum())
    assert not model.training


# ------------------------------------------------------------------------------------------------- missing entries


def hiding(steps, *hidden):
    seen = torch.ones(1, steps, 1, dtype=torch.bool)
    seen[:, list(hidden)] = False
    return seen


def test_a_guide_that_can_be_exact_reaches_the_evidence_where_entries_are_missing():
    """x_1 and x_2 are missing: x_3 is all there is, and z_1 and z_2 move it through the means of x_1 and x_2."""
    steps = 3
    model = twin("p(z_t) p(x_t | z_t, x_{t-1})", "q(z_t | z_{<t}, x_{1:T})", {"z": 1, "x": 1}, steps, scale=1.0)
    x, seen = torch.randn(1, steps, 1, dtype=torch.float64), hiding(steps, 0, 1)

    @torch.no_grad()
    def mean(*z):
        batch = {"x": x, "mask": seen}
        values = {"z": x.new_tensor(z).reshape(1, steps, 1)}
        trace = poutine.trace(poutine.condition(model.model, data=values)).get_trace(batch)
        law = trace.nodes["x"]["fn"].steps(x)
        return law.mean[0, -1, 0], law.stddev[0, -1, 0]

    offset, scale = mean(0, 0, 0)
    slopes = torch.stack([mean(*row)[0] - offset for row in torch.eye(steps).tolist()])
    assert (slopes != 0).all()
    evidence = dist.Normal(offset, (scale**2 + slopes.square().sum()).sqrt()).log_prob(x[0, -1, 0])
    parameters = list(model.encoder.parameters())
    optimiser = torch.optim.LBFGS(
        parameters, max_iter=500, tolerance_grad=1e-10, tolerance_change=1e-14, line_search_fn="strong_wolfe"
    )

    def closure():
        optimiser.zero_grad()
        loss = -library_bound(model, x, seen=seen).sum()
        loss.backward(inputs=parameters)
        return loss

    optimiser.step(closure)
    reached = library_bound(model, x, seen=seen).detach()[0]
    torch.testing.assert_close(reached, evidence, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "run", [{"seen": hiding(4, 1, 2)}, {"fed": torch.tensor([[False, True, True, False]]), "feeding": SelfFeeding(0.5)}]
)
def test_a_backward_guide_has_no_analytic_kl_where_the_model_reads_its_own_means(run):
    """p(z_t | x_{t-1}) reads a function of z_{t-1} then, which the guide drew from z_t."""
    model = twin("p(z_t | x_{t-1}) p(x_t | z_t)", "q(z_t | z_{t+1}, x_{1:T})", {"z": 1, "x": 1}, 4, scale=1.5)
    x = torch.randn(1, 4, 1, dtype=torch.float64)
    exact = exact_bound(model, x[0], **{name: value[0] for name, value in run.items() if name != "feeding"})
    torch.testing.assert_close(library_bound(model, x, **run)[0], exact, rtol=0, atol=1e-9)


def test_nor_where_data_are_functions_of_latents():
    """p(z_t | x_{t-1}) reads z_{t-1} then, whatever is missing."""
    equations = "p(z_t | x_{t-1}) p(x_t | z_t)", "q(z_t | z_{t+1}, c_t)"
    own = {
        "p(x)": distributions.Delta(),
        "q(z)": distributions.FixedNormal(0.7),
        "p(z)": distributions.FixedNormal(0.7),
    }
    networks = {"p(x)": Linear(3, 1.0), "p(z)": Recurrent(4, hidden=(5,)), "q": Recurrent(4, hidden=(5,))}
    model = DynamicalVAE(*equations, {"z": 1, "x": 1, "c": 1}, networks, own).double()
    batch = {"c": torch.randn(2, 3, 1, dtype=torch.float64)}
    model_sites, guide_sites = (sites_of(t) for t in _traces(model, model.guide, (batch,), {}))
    assert _closed_forms(model_sites, guide_sites) == set()
    forward = DynamicalVAE(equations[0], "q(z_t | z_{t-1}, c_t)", {"z": 1, "x": 1, "c": 1}, networks, own).double()
    assert _closed_forms(*(sites_of(t) for t in _traces(forward, forward.guide, (batch,), {}))) == {"z"}


def test_a_static_variable_of_the_data_may_have_missing_entries():
    model = twin("p(z) p(y | z) p(x_t | z, y)", "q(z | x_{1:T}, y)", {"z": 1, "y": 2, "x": 1}, 3, observed=("x", "y"))
    batch = {"x": torch.randn(2, 3, 1).double(), "y": torch.randn(2, 2).double()}
    seen = {"y": torch.tensor([[True, False], [False, False]])}
    likelihood = SequenceELBO().terms(model, {**batch, "mask": seen}).log_likelihood["y"]
    assert likelihood[0] != 0
    assert likelihood[1] == 0
    assert torch.isfinite(SequenceELBO().terms(model, batch, self_feeding=1.0).bound).all()
