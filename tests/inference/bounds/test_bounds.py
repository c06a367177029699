"""Bounds: agreement with Pyro's own, terms that add up, weights that are diagnosed, misuse that is refused."""

import pyro
import pyro.distributions as dist
import pytest
import torch
from dense import exact_bound, library_bound
from pyro import poutine
from pyro.infer import Trace_ELBO, TraceMeanField_ELBO
from pyro.infer.autoguide.initialization import InitMessenger, init_to_value

from dvae import DynamicalVAE, SequenceELBO, distributions, importance_bound, twin
from dvae.inference.bounds.elbo import _khat
from dvae.networks import Attention, Recurrent
from dvae.program.rollout import SelfFeeding, Sequence

B, T = 3, 5
EQUATIONS = ("p(w) p(z_t | z_{t-1}, w) p(x_t | x_{<t}, z_t, w)", "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{1:T}, w)")
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


def test_khat_is_the_shape_of_a_pareto_tail_and_needs_25_particles():
    exponential = -torch.rand(20_000, 20, dtype=torch.float64).log()
    for shape in (0.3, 0.9):
        assert abs(_khat(shape * exponential).mean() - shape) < 0.1
    model, batch = build(), data()
    assert importance_bound(model, batch, particles=24).khat.isnan().all()
    assert importance_bound(model, batch, particles=25).khat.isfinite().all()


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
