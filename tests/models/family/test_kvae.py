"""The Kalman part is exact: filter, smoother, draws and gradients against one dense normal of all z and a."""

import pytest
import torch
from pyro.distributions import Normal
from torch.autograd import gradcheck
from torch.distributions import MultivariateNormal, kl_divergence

import dvae
from dvae.distributions import Shape
from dvae.distributions.kalman import LinearGaussianChain
from dvae.distributions.triangular import InverseCholesky, Triangular, TriangularNormal
from dvae.inference.training.fit import Callback
from dvae.models.family.kvae import KVAE, KalmanNetwork, smooth


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


SHAPES = [(5, 2, 3, 2), (1, 2, 3, 2), (4, 1, 1, 1), (3, 1, 2, 1)]


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


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (lambda: KVAE(auxiliary=0), "auxiliary"),
        (lambda: smooth(dvae.method("vae").build({"x": 2}), torch.zeros(1, 2, 2)), "needs"),
        (lambda: Triangular().build(Shape(2, 5)), "Triangular"),
    ],
)
def test_what_does_not_fit_is_refused(run, message):
    with pytest.raises(ValueError, match=message):
        run()
