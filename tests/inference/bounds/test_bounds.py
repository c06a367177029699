"""Bounds: agreement with Pyro, sums of terms, importance weights and missing entries."""

import pyro
import pytest
import torch
from dense import exact_bound, library_bound
from pyro import poutine
from pyro.infer import Trace_ELBO, TraceMeanField_ELBO

from dvae import DynamicalVAE, SequenceELBO, distributions, iwae_bound, linear_gaussian_surrogate
from dvae.inference.bounds.elbo import _khat
from dvae.networks import Attention, Recurrent
from dvae.program.rollout import ScheduledSampling, Sequence

B, T = 3, 5
EQUATIONS = ("p(w) p(z_t | z_{t-1}, w) p(x_t | x_{<t}, z_t, w)", "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{1:T}, w)")
SIZES = {"w": 2, "z": 2, "x": 3}
NETWORKS = {"recurrent": Recurrent(4, hidden=(5,)), "attention": Attention(8, heads=2)}


def build(network="recurrent", **options):
    return DynamicalVAE(*EQUATIONS, SIZES, NETWORKS[network], **options).double()


def data(**more):
    return {"x": torch.randn(B, T, 3, dtype=torch.float64), **more}


def mean_field_loss(model, batch):
    """Return the loss of Pyro's TraceMeanField_ELBO, with normals for the conditionals of a sequence."""
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


# ----------------------------------------------------------------------------------------------- agreement with Pyro


@pytest.mark.parametrize(("network", "extra"), [("attention", {}), ("recurrent", {"lengths": torch.tensor([5, 2, 1])})])
def test_the_bound_equals_trace_mean_field(network, extra):
    model, batch = build(network), data(**extra)
    pyro.set_rng_seed(4)
    expected = mean_field_loss(model, batch)
    pyro.set_rng_seed(4)
    loss = SequenceELBO().differentiable_loss(model.model, model.guide, batch)
    torch.testing.assert_close(loss, expected, rtol=0, atol=1e-9)
    for a, b in zip(
        torch.autograd.grad(loss, list(model.parameters()), retain_graph=True),
        torch.autograd.grad(expected, list(model.parameters())),
        strict=True,
    ):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-8)


def test_pyro_accepts_the_bound_as_an_elbo():
    model, batch = build(), data()

    def seeded(run):
        pyro.set_rng_seed(4)
        return run()

    loss = seeded(lambda: SequenceELBO().loss(model.model, model.guide, batch))
    assert loss == pytest.approx(-seeded(lambda: SequenceELBO().terms(model, batch)).bound.sum().item())
    assert loss == pytest.approx(seeded(lambda: SequenceELBO()(model, model.guide)(batch)).item())
    assert loss == pytest.approx(seeded(lambda: SequenceELBO().loss_and_grads(model.model, model.guide, batch)))
    assert all(p.grad is not None for p in model.parameters())


def test_the_mean_over_particles_is_pyros_trace_elbo():
    """A Student t prior has no analytic KL, so its KL is a log-ratio."""
    model, batch = build(distributions={"p(x)": distributions.Normal(), "p(z)": distributions.StudentT()}), data()
    n = 150
    with torch.no_grad():
        bounds = torch.stack([SequenceELBO().terms(model, batch).bound.sum() for _ in range(n)])
        expected = -torch.tensor([Trace_ELBO().loss(model.model, model.guide, batch) for _ in range(n)])
        error = ((bounds.var() + expected.var()) / n).sqrt()
        many = SequenceELBO(num_particles=n).terms(model, batch).bound.sum()
    assert abs(bounds.mean() - expected.mean()) < 5 * error
    assert abs(many - bounds.mean()) < 5 * (2 * bounds.var() / n).sqrt()


# ------------------------------------------------------------------------------------------------------------- terms


def test_steps_sum_to_terms_and_terms_to_the_bound():
    lengths = torch.tensor([5, 2, 1])
    terms = SequenceELBO().terms(build(), data(lengths=lengths))
    assert set(terms.log_likelihood) == {"x"}
    assert set(terms.kl) == {"w", "z"}
    assert set(terms.steps) == {"x", "z"}
    assert not terms.energies
    torch.testing.assert_close(terms.steps["x"].sum(1), terms.log_likelihood["x"])
    torch.testing.assert_close(terms.steps["z"].sum(1), terms.kl["z"])
    torch.testing.assert_close(terms.bound, terms.log_likelihood["x"] - terms.kl["z"] - terms.kl["w"])
    assert terms.n_steps.tolist() == lengths.tolist()
    torch.testing.assert_close(terms.per_step, terms.bound / terms.n_steps)
    assert all((kl >= 0).all() for kl in terms.kl.values())
    pad = torch.arange(T) >= lengths[:, None]
    assert all((steps[pad] == 0).all() for steps in terms.steps.values())


def test_penalties_of_a_wrapping_model_are_energies_outside_the_bound():
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


# ------------------------------------------------------------------------------------------------ importance weights


def test_khat_is_the_shape_of_a_pareto_tail_from_25_particles():
    exponential = -torch.rand(20_000, 20, dtype=torch.float64).log()
    for shape in (0.3, 0.9):
        assert abs(_khat(shape * exponential).mean() - shape) < 0.1
    model, batch = build(), data()
    assert iwae_bound(model, batch, particles=24).khat.isnan().all()
    assert iwae_bound(model, batch, particles=25).khat.isfinite().all()


# ------------------------------------------------------------------------------------------------- missing entries


def hide_entries(steps, *hidden):
    mask = torch.ones(1, steps, 1, dtype=torch.bool)
    mask[:, list(hidden)] = False
    return mask


@pytest.mark.parametrize(
    "run",
    [
        {"seen": hide_entries(4, 1, 2)},
        {"fed": torch.tensor([[False, True, True, False]]), "feeding": ScheduledSampling(0.5)},
    ],
)
def test_a_backward_guide_has_no_analytic_kl_where_the_model_reads_its_own_means(run):
    """p(z_t | x_{t-1}) then reads a function of z_{t-1}, and the guide draws z_{t-1} from z_t."""
    model = linear_gaussian_surrogate(
        "p(z_t | x_{t-1}) p(x_t | z_t)", "q(z_t | z_{t+1}, x_{1:T})", {"z": 1, "x": 1}, 4, scale=1.5
    )
    x = torch.randn(1, 4, 1, dtype=torch.float64)
    exact = exact_bound(model, x[0], **{name: value[0] for name, value in run.items() if name != "feeding"})
    torch.testing.assert_close(library_bound(model, x, **run)[0], exact, rtol=0, atol=1e-9)
