"""The Kalman part is exact: filter, smoother, draws and gradients against one dense normal of all z and a."""

import math
from dataclasses import replace

import pytest
import torch
from pyro.distributions import Normal
from torch.autograd import gradcheck
from torch.distributions import MultivariateNormal, kl_divergence

import dvae
from dvae.distributions import Shape
from dvae.distributions.kalman import LinearGaussianChain
from dvae.distributions.triangular import InverseCholesky, Triangular, TriangularNormal
from dvae.factorization.relations import Relation
from dvae.inference.training.fit import Callback
from dvae.models.family.kvae import KVAE, Kalman, KalmanNetwork, smooth
from dvae.networks import Input


def chain(steps=5, batch=2, size=3, data=2):
    """A chain with random matrices, and C, R and a that its weights come from."""
    options = {"dtype": torch.float64}
    transition, offset = 0.6 * torch.randn(steps - 1, batch, size, size), torch.randn(steps - 1, batch, size)
    emission, a, scale = torch.randn(steps, batch, data, size), torch.randn(steps, batch, data), torch.rand(data) + 0.2
    factor, first = torch.randn(size, size), torch.randn(size, size)
    transition, offset, emission, a, scale, factor, first = (
        v.to(**options) for v in (transition, offset, emission, a, scale, factor, first)
    )
    noise, covariance = factor @ factor.mT + torch.eye(size), first @ first.mT + torch.eye(size)
    weighted = emission.mT / scale
    built = LinearGaussianChain(
        transition=transition,
        offset=offset,
        noise=noise,
        mean=torch.randn(batch, size, **options),
        covariance=covariance.expand(batch, -1, -1),
        information=weighted @ emission,
        potential=(weighted @ a[..., None])[..., 0],
    )
    return built, emission, scale, a


def dense(built, emission, scale, b=0):
    """Mean and covariance of (z_{1:T}, a_{1:T}) of sequence b, stacked by step."""
    steps, _, size = built.potential.shape
    data = emission.shape[2]
    n = steps * size
    rest, offset, noise = torch.eye(n), torch.zeros(n), torch.zeros(n, n)
    rest, offset, noise = (v.double() for v in (rest, offset, noise))
    noise[:size, :size], offset[:size] = built.covariance[b], built.mean[b]
    for t in range(1, steps):
        here, before = slice(t * size, (t + 1) * size), slice((t - 1) * size, t * size)
        rest[here, before] = -built.transition[t - 1, b]
        noise[here, here], offset[here] = built.noise, built.offset[t - 1, b]
    root = torch.linalg.inv(rest)
    mean, covariance = root @ offset, root @ noise @ root.mT
    seen = torch.block_diag(*emission[:, b])
    joint = torch.cat([torch.eye(n).double(), seen])
    spread = joint @ covariance @ joint.mT
    spread[n:, n:] += torch.diag(scale.repeat(steps))
    assert seen.shape == (steps * data, n)
    return joint @ mean, spread


def conditional(mean, spread, n, value):
    """Mean and covariance of the first n coordinates given the others."""
    gain = torch.linalg.solve(spread[n:, n:], spread[n:, :n]).mT
    return mean[:n] + gain @ (value - mean[n:]), spread[:n, :n] - gain @ spread[n:, :n]


def evidence(built, emission, scale, a):
    """log p(a), (B,), of the filter's predictions."""
    mean, covariance = built.predicted
    loc = (emission @ mean[..., None])[..., 0]
    return MultivariateNormal(loc, emission @ covariance @ emission.mT + scale.diag()).log_prob(a).sum(0)


SHAPES = [(5, 2, 3, 2), (5, 2, 2, 3), (1, 2, 3, 2), (4, 1, 1, 1), (3, 1, 1, 2), (3, 1, 2, 1)]


@pytest.mark.parametrize("shape", SHAPES)
def test_the_filter_gives_the_density_of_the_dense_joint(shape):
    built, emission, scale, a = chain(*shape)
    n = shape[0] * shape[2]
    for b in range(shape[1]):
        mean, spread = dense(built, emission, scale, b)
        expected = MultivariateNormal(mean[n:], spread[n:, n:]).log_prob(a[:, b].flatten())
        assert evidence(built, emission, scale, a)[b].item() == pytest.approx(expected.item(), abs=1e-9, rel=1e-11)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_smoother_is_the_dense_conditional(shape):
    built, emission, scale, a = chain(*shape)
    steps, _, size, data = shape
    n = steps * size
    for b in range(shape[1]):
        mean, covariance = conditional(*dense(built, emission, scale, b), n, a[:, b].flatten())
        blocks = covariance.view(steps, size, steps, size)
        torch.testing.assert_close(built.smoothed.mean[:, b], mean.view(steps, size), rtol=1e-9, atol=1e-9)
        for t in range(steps):
            torch.testing.assert_close(built.smoothed.covariance[t, b], blocks[t, :, t], rtol=1e-9, atol=1e-9)
            upto = slice((t + 1) * data)
            picked = torch.cat([torch.arange(n), n + torch.arange(n + data * steps)[upto]])
            joint_mean, spread = dense(built, emission, scale, b)
            m, c = conditional(joint_mean[picked], spread[picked][:, picked], n, a[: t + 1, b].flatten())
            here = slice(t * size, (t + 1) * size)
            torch.testing.assert_close(built.filtered.mean[t, b], m[here], rtol=1e-9, atol=1e-9)
            torch.testing.assert_close(built.filtered.covariance[t, b], c[here, here], rtol=1e-9, atol=1e-9)
        for t in range(steps - 1):
            torch.testing.assert_close(built.lag_one[t, b], blocks[t + 1, :, t], rtol=1e-9, atol=1e-9)


def test_a_missing_observation_is_one_of_weight_zero():
    built, emission, scale, a = chain()
    steps, batch, size = built.potential.shape
    seen = torch.ones(steps, batch, dtype=torch.float64)
    seen[2, 0] = 0
    information, potential = built.information * seen[..., None, None], built.potential * seen[..., None]
    holed = replace(built, information=information, potential=potential)
    n = steps * size
    kept = torch.tensor([*range(n), *(n + i for i in range(2 * steps) if i // 2 != 2)])
    mean, spread = dense(built, emission, scale)
    value = a[[0, 1, 3, 4], 0].flatten()
    expected, _ = conditional(mean[kept], spread[kept][:, kept], n, value)
    torch.testing.assert_close(holed.smoothed.mean[:, 0], expected.view(steps, size), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(holed.smoothed.mean[:, 1], built.smoothed.mean[:, 1])


def test_evidence_is_the_joint_over_the_posterior_at_every_z():
    """log p(a) = log p(a, z) - log p(z | a), the latter from the smoother's moments as a backward chain."""
    built, emission, scale, a = chain()
    steps = len(built.potential)
    (mean, covariance), lag_one = built.smoothed, built.lag_one
    for z in (built.draw(torch.randn_like(mean)), torch.randn_like(mean)):
        posterior = MultivariateNormal(mean[-1], covariance[-1]).log_prob(z[-1])
        for t in range(steps - 1):
            gain = torch.linalg.solve(covariance[t + 1], lag_one[t]).mT
            loc = mean[t] + (gain @ (z[t + 1] - mean[t + 1])[..., None])[..., 0]
            posterior += MultivariateNormal(loc, covariance[t] - gain @ lag_one[t]).log_prob(z[t])
        for b in range(z.shape[1]):
            joint = MultivariateNormal(*dense(built, emission, scale, b))
            total = joint.log_prob(torch.cat([z[:, b].flatten(), a[:, b].flatten()]))
            assert (total - posterior[b]).item() == pytest.approx(
                evidence(built, emission, scale, a)[b].item(), abs=1e-8
            )


def test_draws_have_the_posterior_s_moments_and_its_gradient():
    built, *_ = chain(steps=4, batch=1, size=2)
    count, steps, size = 20_000, 4, 2
    mean, covariance, lag_one = (v[:, 0] for v in (*built.smoothed, built.lag_one))
    once = {"mean": built.mean, "covariance": built.covariance}
    local = {name: getattr(built, name) for name in ("transition", "offset", "information", "potential")}
    many = replace(
        built,
        **{name: value.expand(count, *value.shape[1:]) for name, value in once.items()},
        **{name: value.expand(len(value), count, *value.shape[2:]) for name, value in local.items()},
    )
    draws = many.draw(torch.randn(steps, count, size, dtype=torch.float64))
    error = covariance.diagonal(dim1=-2, dim2=-1).div(count).sqrt()
    assert ((draws.mean(1) - mean).abs() < 5 * error).all()
    centred = draws - mean[:, None]
    within = torch.einsum("tbi,tbj->tij", centred, centred) / count
    across = torch.einsum("tbi,tbj->tij", centred[1:], centred[:-1]) / count
    largest = covariance.diagonal(dim1=-2, dim2=-1).max()
    assert (within - covariance).abs().max() < 5 * largest * (2 / count) ** 0.5
    assert (across - lag_one).abs().max() < 5 * largest * (2 / count) ** 0.5
    # without noise a draw is the posterior's mean, and so is its gradient
    noiseless, inputs = chain(steps=4)[0], ["offset", "potential", "mean"]
    leaves = [getattr(noiseless, name).requires_grad_() for name in inputs]
    drawn = noiseless.draw(torch.zeros_like(noiseless.potential))
    torch.testing.assert_close(drawn, noiseless.smoothed.mean, rtol=1e-9, atol=1e-9)
    weights = torch.randn_like(drawn)
    first, second = (
        torch.autograd.grad((weights * v).sum(), leaves, retain_graph=True) for v in (drawn, noiseless.smoothed.mean)
    )
    torch.testing.assert_close(first, second, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("shape", [(4, 2, 2, 3), (1, 2, 2, 1), (3, 1, 1, 1)])
def test_the_fused_backward_pass_has_the_gradient_of_the_dense_density(shape):
    built, emission, scale, a = chain(*shape)
    n = shape[0] * shape[2]
    leaves = [v.detach().clone().requires_grad_() for v in (built.transition, built.offset, built.noise, built.mean)]
    leaves += [v.detach().clone().requires_grad_() for v in (emission, scale, a)]

    def rebuilt(transition, offset, noise, mean, emission, scale, a):
        weighted = emission.mT / scale
        given = (weighted @ emission, (weighted @ a[..., None])[..., 0])
        return LinearGaussianChain(transition, offset, noise, mean, built.covariance, *given)

    emission, scale, a = leaves[-3:]
    ours = evidence(rebuilt(*leaves), emission, scale, a).sum()
    theirs = 0.0
    for b in range(shape[1]):
        mean, spread = dense(rebuilt(*leaves), emission, scale, b)
        theirs = theirs + MultivariateNormal(mean[n:], spread[n:, n:]).log_prob(a[:, b].flatten())
    got, expected = (torch.autograd.grad(v, leaves, allow_unused=True, materialize_grads=True) for v in (ours, theirs))
    for one, other in zip(got, expected, strict=True):
        if one.shape == built.noise.shape:
            one, other = one + one.mT, other + other.mT
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-8)


def test_gradients_of_every_argument_are_those_of_finite_differences():
    built, *_ = chain(steps=3, batch=2, size=2)
    roots = [torch.linalg.cholesky(v) for v in (built.noise, built.covariance)]
    root = torch.randn(3, 2, 2, 2, dtype=torch.float64)

    def run(transition, offset, noise, mean, covariance, information, potential):
        squares = (v @ v.mT for v in (noise, covariance, information))
        noise, covariance, information = squares
        return LinearGaussianChain(transition, offset, noise, mean, covariance, information, potential).predicted

    inputs = [built.transition, built.offset, roots[0], built.mean, roots[1], root, built.potential]
    assert gradcheck(run, [v.detach().clone().requires_grad_() for v in inputs])


# ------------------------------------------------------------------------------------- a normal with full covariance


def triangular(*shape):
    root = torch.randn(*shape, shape[-1], dtype=torch.float64).tril(-1)
    root += torch.diag_embed(torch.rand(shape, dtype=torch.float64) + 0.3)
    loc = torch.randn(shape, dtype=torch.float64)
    return TriangularNormal(loc, root), MultivariateNormal(loc, precision_matrix=root.mT @ root)


@pytest.mark.parametrize("shape", [(4, 3), (2, 3, 1)])
def test_its_density_is_that_of_the_normal(shape):
    ours, whole = triangular(*shape)
    value = torch.randn(shape, dtype=torch.float64)
    torch.testing.assert_close(ours.log_prob(value), whole.log_prob(value))


def test_the_divergence_of_a_diagonal_normal_is_exact():
    ours, whole = triangular(5, 3)
    q = Normal(torch.randn(5, 3, dtype=torch.float64), torch.rand(5, 3, dtype=torch.float64) + 0.2)
    expected = kl_divergence(MultivariateNormal(q.loc, torch.diag_embed(q.scale**2)), whole)
    torch.testing.assert_close(kl_divergence(q, ours), expected)


def test_draws_of_it_have_its_covariance():
    ours, whole = triangular(3)
    draws = ours.rsample([50_000])
    largest = whole.covariance_matrix.diagonal().max()
    assert (torch.cov(draws.T) - whole.covariance_matrix).abs().max() < 5 * largest * (2 / 50_000) ** 0.5
    value = ours.rsample()
    torch.testing.assert_close(ours.color(ours.whiten(value)), value)


def test_the_inverse_root_and_its_gradient():
    root = torch.randn(4, 3, 3, dtype=torch.float64, requires_grad=True)

    def run(root):
        return InverseCholesky.apply(root @ root.mT + torch.eye(3, dtype=torch.float64))

    inverse = run(root)
    torch.testing.assert_close(inverse, inverse.tril())
    square = root @ root.mT + torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(inverse.mT @ inverse @ square, torch.eye(3, dtype=torch.float64).expand(4, 3, 3))
    assert gradcheck(run, root)
    indefinite = torch.stack([torch.eye(2), -torch.eye(2)])
    assert InverseCholesky.apply(indefinite).isnan().flatten(1).all(1).tolist() == [False, True]


# --------------------------------------------------------------------------------------------------------- the method


def small(**options):
    method = KVAE(**{"latent": 2, "auxiliary": 3, "width": 4, "hidden": (5, 4), **options})
    model = method.build({"x": 4}).double()
    with torch.no_grad():
        for parameter in model.generator["a"].parameters():  # away from the start, where all A are the identity
            parameter.add_(0.3 * torch.randn_like(parameter))
    return model


def paper(model, x, a):
    """log p(a) (B,) of the paper's model with z, one dense normal for each sequence; alpha by a plain loop."""
    network: KalmanNetwork = model.generator["a"].network
    total = []
    for values in a:
        before = torch.cat([network.first[None], values[:-1]])
        alpha = torch.softmax(network.weights(network.memory(before[:, None])[0][:, 0]), -1)
        mixed = [torch.einsum("tk,kij->tij", alpha, part) for part in (network.A, network.B, network.C)]
        steps, n = len(values), network.A.shape[-1]
        rest, offset = torch.eye(steps * n).double(), torch.zeros(steps * n).double()
        noise = torch.block_diag(20 * torch.eye(n).double(), *[0.08 * torch.eye(n).double()] * (steps - 1))
        for t in range(1, steps):
            rest[t * n : (t + 1) * n, (t - 1) * n : t * n] = -mixed[0][t]
            offset[t * n : (t + 1) * n] = mixed[1][t] @ values[t - 1]
        root, seen = torch.linalg.inv(rest), torch.block_diag(*mixed[2])
        covariance = seen @ root @ noise @ root.mT @ seen.mT + 0.03 * torch.eye(values.numel()).double()
        # offsets read a: given a_{<t} they are numbers, and log p(a) is the density of this normal at a
        total.append(MultivariateNormal(seen @ root @ offset, covariance).log_prob(values.flatten()))
    return torch.stack(total)


def test_the_prior_of_a_is_the_paper_s_with_z_integrated_out():
    model, x = small().eval(), torch.randn(3, 5, 4, dtype=torch.float64)
    model.generator["a"].network.log_noise.fill_(torch.tensor(0.08, dtype=torch.float64).log())
    model.generator["a"].network.log_emission.fill_(torch.tensor(0.03, dtype=torch.float64).log())
    with torch.no_grad():
        a = model.guide(x)["a"]
        torch.testing.assert_close(model.log_joint(x, {"a": a})["a"], paper(model, x, a), rtol=1e-9, atol=1e-9)


def test_the_bound_is_that_of_the_paper():
    """E_q(a, z) log p(x, a, z) - log q(a) - log p(z | a): the terms of z cancel but for log p(a), draw by draw."""
    model, x = small().eval(), torch.randn(1, 4, 4, dtype=torch.float64).repeat(4000, 1, 1)
    terms = dvae.SequenceELBO().terms(model, x)
    with torch.no_grad():
        trace = model.encoder["a"]({"x": x}, len(x), 4)
        q = Normal(*trace)
        a = q.sample()
        ratio = q.log_prob(a).sum((1, 2)) - model.log_joint(x, {"a": a})["a"]
    error = (ratio.std() ** 2 + terms.kl["a"].std() ** 2).sqrt() / 4000**0.5
    assert (ratio.mean() - terms.kl["a"].mean()).abs() < 5 * error
    assert terms.kl["a"].std() < ratio.std()


def test_smoothing_gives_z_back():
    model, x = small().eval(), torch.randn(3, 5, 4, dtype=torch.float64)
    torch.manual_seed(1)
    together = smooth(model, x, samples=4)
    assert together.z.shape == together.mean.shape == (4, 3, 5, 2)
    assert together.covariance.shape == (4, 3, 5, 2, 2)
    assert together.lag_one.shape == (4, 3, 4, 2, 2)
    torch.testing.assert_close(together.weights.sum(-1), torch.ones(4, 3, 5, dtype=torch.float64))
    assert smooth(model, x[:1, :1]).z.shape == (1, 1, 1, 2)
    together.z.sum().backward()
    for part in (model.generator["a"], model.encoder["a"]):
        assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in part.parameters())


def test_precise_observations_leave_single_precision_its_digits():
    """Two of four directions of z are observed at each step, with a deviation of .001."""
    exact = small(latent=4, auxiliary=2).eval().requires_grad_(requires_grad=False)
    exact.generator["a"].network.log_emission.fill_(math.log(1e-6))
    exact.float()
    x = torch.randn(1, 80, 4)
    a = exact.guide(x)["a"].transpose(0, 1)
    single = exact.generator["a"].network.chain_of(a)[0].smoothed
    network = exact.double().generator["a"].network
    double = network.chain_of(a.double())[0].smoothed
    deviation = double.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert ((single.mean - double.mean).abs() / deviation).max() < 0.05
    torch.testing.assert_close(single.covariance, double.covariance, rtol=1e-3, atol=1e-4)
    assert single.mean.dtype is torch.float64
    assert smooth(exact.float(), x).z.dtype is torch.float32


def test_padding_does_not_change_the_smoothed():
    model, x = small().eval(), torch.randn(2, 5, 4, dtype=torch.float64)
    torch.manual_seed(1)
    ragged = smooth(model, {"x": x, "lengths": torch.tensor([5, 3])})
    network = model.generator["a"].network
    alone = network.chain_of(ragged.a[0, 1:, :3].transpose(0, 1))[0]
    pairs = zip((ragged.mean, ragged.covariance, ragged.lag_one), (*alone.smoothed, alone.lag_one), strict=True)
    for ours, theirs in pairs:
        steps = len(theirs)
        torch.testing.assert_close(ours[0, 1, :steps], theirs[:, 0], rtol=1e-9, atol=1e-9)
        assert not ours[0, 1, steps:].any()


def test_one_component_is_a_plain_kalman_filter_with_learned_noise():
    model = small(components=1, learn_noise=True)
    data = torch.randn(2, 4, 4, dtype=torch.float64)
    dvae.SequenceELBO().differentiable_loss(model.model, model.guide, data).backward()
    network = model.generator["a"].network
    assert network.log_noise.grad.abs().min() > 0
    assert network.log_emission.grad.abs().min() > 0
    assert "log_noise" not in dict(small().generator["a"].network.named_parameters())


def test_phases_free_the_matrices_and_then_what_mixes_them():
    method = KVAE(latent=2, auxiliary=3, width=4, hidden=(5, 4), warm_up=20, phases=True)
    model = method.build({"x": 4})
    start = {name: value.clone() for name, value in model.state_dict().items()}
    seen = {}

    class Watch(Callback):
        def on_step(self, state):
            now = state.model.state_dict()
            moved = {name.removeprefix("generator.a.network.") for name in now if not now[name].equal(start[name])}
            seen[state.step] = {name.split(".")[0] for name in moved}

    dvae.fit(model, torch.randn(8, 5, 4), stages=method.train({}, steps=30).stages, callbacks=[Watch()], progress=False)
    assert seen[3] == {"encoder", "generator"}
    assert seen[4] == seen[10] == {"encoder", "generator", "A", "B", "C"}
    assert seen[11] == {"encoder", "generator", "A", "B", "C", "first", "memory", "weights"}
    assert [stage.steps for stage in method.train({}, steps=3).stages] == [1, 1, 1]
    assert [stage.steps for stage in method.train({}, steps=2).stages] == [2]


def test_half_precision_is_left_at_the_filter():
    model, x = KVAE(latent=2, auxiliary=3, width=4, hidden=(5, 4)).build({"x": 4}), torch.randn(8, 5, 4)
    options = {"steps": 3, "accelerator": "cpu", "progress": False}
    assert dvae.fit(model, x, precision="bf16-mixed", **options).history
    assert all(p.dtype == torch.float32 and p.isfinite().all() for p in model.parameters())
    with pytest.raises(
        ValueError, match=r"covariances are inverted, which torch\.bfloat16 cannot hold; fit with precision="
    ):
        dvae.fit(model, x, precision="bf16-true", **options)


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (lambda: KVAE(auxiliary=0), "auxiliary is 0; it must be at least 1"),
        (lambda: KVAE(components=0), "components is 0; it must be at least 1"),
        (lambda: smooth(dvae.method("vae").build({"x": 2}), torch.zeros(1, 2, 2)), "needs the chain of a kvae model"),
        (lambda: smooth(small(), torch.zeros(1, 2, 4), samples=0), "samples is at least 1, got 0"),
        (lambda: Triangular().build(Shape(2, 5)), "a Triangular law takes 6 features, but the network gives 5"),
        (
            lambda: Kalman().build([Input("a", 2, Relation.parse("t-1"))], True, 2),
            r"from all of its own past, p\(a_t \| a_\{<t\}\), but the parents here are a at \{t-1\}",
        ),
    ],
)
def test_what_does_not_fit_is_refused(run, message):
    with pytest.raises(ValueError, match=message):
        run()
