"""The Kalman part is exact: filter, smoother and gradients, compared with one dense normal of all z and a."""

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
    """Return a chain with random matrices, and the C, R and a that define its potentials."""
    options = {"dtype": torch.float64}
    transition, offset = 0.6 * torch.randn(steps - 1, batch, size, size), torch.randn(steps - 1, batch, size)
    emission, a, scale = torch.randn(steps, batch, data, size), torch.randn(steps, batch, data), torch.rand(data) + 0.2
    factor, first = torch.randn(size, size), torch.randn(size, size)
    transition, offset, emission, a, scale, factor, first = (
        v.to(**options) for v in (transition, offset, emission, a, scale, factor, first)
    )
    noise, covariance = factor @ factor.mT + torch.eye(size), first @ first.mT + torch.eye(size)
    weighted = emission.mT / scale
    kalman = LinearGaussianChain(
        transition=transition,
        offset=offset,
        noise=noise,
        mean=torch.randn(batch, size, **options),
        covariance=covariance.expand(batch, -1, -1),
        information=weighted @ emission,
        potential=(weighted @ a[..., None])[..., 0],
    )
    return kalman, emission, scale, a


def dense(kalman, emission, scale, b=0):
    """Return the mean and covariance of (z_{1:T}, a_{1:T}) of sequence b, stacked by step."""
    steps, _, size = kalman.potential.shape
    data = emission.shape[2]
    n = steps * size
    system, offset, noise = torch.eye(n), torch.zeros(n), torch.zeros(n, n)
    system, offset, noise = (v.double() for v in (system, offset, noise))
    noise[:size, :size], offset[:size] = kalman.covariance[b], kalman.mean[b]
    for t in range(1, steps):
        here, before = slice(t * size, (t + 1) * size), slice((t - 1) * size, t * size)
        system[here, before] = -kalman.transition[t - 1, b]
        noise[here, here], offset[here] = kalman.noise, kalman.offset[t - 1, b]
    root = torch.linalg.inv(system)
    mean, covariance = root @ offset, root @ noise @ root.mT
    emissions = torch.block_diag(*emission[:, b])
    joint = torch.cat([torch.eye(n).double(), emissions])
    spread = joint @ covariance @ joint.mT
    spread[n:, n:] += torch.diag(scale.repeat(steps))
    assert emissions.shape == (steps * data, n)
    return joint @ mean, spread


def conditional(mean, spread, n, value):
    """Return the mean and covariance of the first n coordinates given the others."""
    gain = torch.linalg.solve(spread[n:, n:], spread[n:, :n]).mT
    return mean[:n] + gain @ (value - mean[n:]), spread[:n, :n] - gain @ spread[n:, :n]


def evidence(kalman, emission, scale, a):
    """Return log p(a), (B,), by the filter's predictions."""
    mean, covariance = kalman.predicted
    loc = (emission @ mean[..., None])[..., 0]
    return MultivariateNormal(loc, emission @ covariance @ emission.mT + scale.diag()).log_prob(a).sum(0)


SHAPES = [(5, 2, 3, 2), (1, 2, 3, 2), (4, 1, 1, 1), (3, 1, 2, 1)]


@pytest.mark.parametrize("shape", SHAPES)
def test_the_filter_has_the_density_of_the_dense_joint(shape):
    kalman, emission, scale, a = chain(*shape)
    n = shape[0] * shape[2]
    for b in range(shape[1]):
        mean, spread = dense(kalman, emission, scale, b)
        expected = MultivariateNormal(mean[n:], spread[n:, n:]).log_prob(a[:, b].flatten())
        assert evidence(kalman, emission, scale, a)[b].item() == pytest.approx(expected.item(), abs=1e-9, rel=1e-11)


@pytest.mark.parametrize("shape", SHAPES)
def test_filter_and_smoother_equal_the_dense_conditionals(shape):
    kalman, emission, scale, a = chain(*shape)
    steps, _, size, data = shape
    n = steps * size
    for b in range(shape[1]):
        mean, covariance = conditional(*dense(kalman, emission, scale, b), n, a[:, b].flatten())
        blocks = covariance.view(steps, size, steps, size)
        torch.testing.assert_close(kalman.smoothed.mean[:, b], mean.view(steps, size), rtol=1e-9, atol=1e-9)
        for t in range(steps):
            torch.testing.assert_close(kalman.smoothed.covariance[t, b], blocks[t, :, t], rtol=1e-9, atol=1e-9)
            upto = slice((t + 1) * data)
            picked = torch.cat([torch.arange(n), n + torch.arange(n + data * steps)[upto]])
            joint_mean, spread = dense(kalman, emission, scale, b)
            m, c = conditional(joint_mean[picked], spread[picked][:, picked], n, a[: t + 1, b].flatten())
            here = slice(t * size, (t + 1) * size)
            torch.testing.assert_close(kalman.filtered.mean[t, b], m[here], rtol=1e-9, atol=1e-9)
            torch.testing.assert_close(kalman.filtered.covariance[t, b], c[here, here], rtol=1e-9, atol=1e-9)
        for t in range(steps - 1):
            torch.testing.assert_close(kalman.lag_one[t, b], blocks[t + 1, :, t], rtol=1e-9, atol=1e-9)


def test_gradients_of_every_argument_equal_finite_differences():
    kalman, *_ = chain(steps=3, batch=2, size=2)
    roots = [torch.linalg.cholesky(v) for v in (kalman.noise, kalman.covariance)]
    root = torch.randn(3, 2, 2, 2, dtype=torch.float64)

    def run(transition, offset, noise, mean, covariance, information, potential):
        squares = (v @ v.mT for v in (noise, covariance, information))
        noise, covariance, information = squares
        return LinearGaussianChain(transition, offset, noise, mean, covariance, information, potential).predicted

    inputs = [kalman.transition, kalman.offset, roots[0], kalman.mean, roots[1], root, kalman.potential]
    assert gradcheck(run, [v.detach().clone().requires_grad_() for v in inputs])


# ------------------------------------------------------------------------------------- a normal with full covariance


def triangular(*shape):
    root = torch.randn(*shape, shape[-1], dtype=torch.float64).tril(-1)
    root += torch.diag_embed(torch.rand(shape, dtype=torch.float64) + 0.3)
    loc = torch.randn(shape, dtype=torch.float64)
    return TriangularNormal(loc, root), MultivariateNormal(loc, precision_matrix=root.mT @ root)


@pytest.mark.parametrize("shape", [(4, 3), (2, 3, 1)])
def test_the_triangular_normal_has_the_density_of_the_normal(shape):
    distribution, expected = triangular(*shape)
    value = torch.randn(shape, dtype=torch.float64)
    torch.testing.assert_close(distribution.log_prob(value), expected.log_prob(value))


def test_the_kl_divergence_of_a_diagonal_normal_is_exact():
    distribution, normal = triangular(5, 3)
    q = Normal(torch.randn(5, 3, dtype=torch.float64), torch.rand(5, 3, dtype=torch.float64) + 0.2)
    expected = kl_divergence(MultivariateNormal(q.loc, torch.diag_embed(q.scale**2)), normal)
    torch.testing.assert_close(kl_divergence(q, distribution), expected)


def test_the_inverse_cholesky_factor_and_its_gradient_are_exact():
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
        for parameter in model.generator["a"].parameters():  # at initialisation all A are the identity
            parameter.add_(0.3 * torch.randn_like(parameter))
    return model


def dense_log_prior(model, x, a):
    """Return log p(a) (B,) of the paper's model, by one dense normal for each sequence and a loop for alpha."""
    network: KalmanNetwork = model.generator["a"].network
    total = []
    for values in a:
        before = torch.cat([network.first[None], values[:-1]])
        alpha = torch.softmax(network.weights(network.memory(before[:, None])[0][:, 0]), -1)
        matrices = [torch.einsum("tk,kij->tij", alpha, part) for part in (network.A, network.B, network.C)]
        steps, n = len(values), network.A.shape[-1]
        system, offset = torch.eye(steps * n).double(), torch.zeros(steps * n).double()
        noise = torch.block_diag(20 * torch.eye(n).double(), *[0.08 * torch.eye(n).double()] * (steps - 1))
        for t in range(1, steps):
            system[t * n : (t + 1) * n, (t - 1) * n : t * n] = -matrices[0][t]
            offset[t * n : (t + 1) * n] = matrices[1][t] @ values[t - 1]
        root, emissions = torch.linalg.inv(system), torch.block_diag(*matrices[2])
        covariance = emissions @ root @ noise @ root.mT @ emissions.mT + 0.03 * torch.eye(values.numel()).double()
        # the offsets depend on a_{<t} only, so log p(a) is the density of this normal at a
        total.append(MultivariateNormal(emissions @ root @ offset, covariance).log_prob(values.flatten()))
    return torch.stack(total)


def test_the_prior_of_a_integrates_z_out_of_the_papers_model():
    model, x = small().eval(), torch.randn(3, 5, 4, dtype=torch.float64)
    model.generator["a"].network.log_noise.fill_(torch.tensor(0.08, dtype=torch.float64).log())
    model.generator["a"].network.log_emission.fill_(torch.tensor(0.03, dtype=torch.float64).log())
    with torch.no_grad():
        a = model.guide(x)["a"]
        torch.testing.assert_close(
            model.log_joint(x, {"a": a})["a"], dense_log_prior(model, x, a), rtol=1e-9, atol=1e-9
        )


def test_padding_does_not_change_smoothing():
    model, x = small().eval(), torch.randn(2, 5, 4, dtype=torch.float64)
    torch.manual_seed(1)
    ragged = smooth(model, {"x": x, "lengths": torch.tensor([5, 3])})
    network = model.generator["a"].network
    single = network.chain_of(ragged.a[0, 1:, :3].transpose(0, 1))[0]
    pairs = zip((ragged.mean, ragged.covariance, ragged.lag_one), (*single.smoothed, single.lag_one), strict=True)
    for padded_values, expected in pairs:
        steps = len(expected)
        torch.testing.assert_close(padded_values[0, 1, :steps], expected[:, 0], rtol=1e-9, atol=1e-9)
        assert not padded_values[0, 1, steps:].any()


def test_phases_train_the_matrices_and_then_their_weights():
    method = KVAE(latent=2, auxiliary=3, width=4, hidden=(5, 4), warm_up=20, phases=True)
    model = method.build({"x": 4})
    start = {name: value.clone() for name, value in model.state_dict().items()}
    trained = {}

    class Watch(Callback):
        def on_step(self, state):
            now = state.model.state_dict()
            changed_names = {
                name.removeprefix("generator.a.network.") for name in now if not now[name].equal(start[name])
            }
            trained[state.step] = {name.split(".")[0] for name in changed_names}

    dvae.fit(model, torch.randn(8, 5, 4), stages=method.train({}, steps=30).stages, callbacks=[Watch()], progress=False)
    assert trained[3] == {"encoder", "generator"}
    assert trained[4] == trained[10] == {"encoder", "generator", "A", "B", "C"}
    assert trained[11] == {"encoder", "generator", "A", "B", "C", "first", "memory", "weights"}
    assert [stage.steps for stage in method.train({}, steps=3).stages] == [1, 1, 1]
    assert [stage.steps for stage in method.train({}, steps=2).stages] == [2]


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (lambda: KVAE(auxiliary=0), "auxiliary"),
        (lambda: smooth(dvae.method("vae").build({"x": 2}), torch.zeros(1, 2, 2)), "needs"),
        (lambda: Triangular().build(Shape(2, 5)), "Triangular"),
        (lambda: dvae.method("kvae").build({"x": 2}).with_prior({"p(a)": dvae.distributions.Normal()}), "Triangular"),
    ],
)
def test_wrong_arguments_are_an_error(run, message):
    with pytest.raises(ValueError, match=message):
        run()
