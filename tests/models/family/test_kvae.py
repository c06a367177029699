"""The Kalman part of a KVAE, with missing frames integrated out, against one dense normal of all z and a."""

import pytest
import torch
from pyro.distributions import Normal
from torch.autograd import gradcheck
from torch.distributions import MultivariateNormal, kl_divergence

import dvae
from dvae.distributions import Shape
from dvae.distributions.triangular import InverseCholesky, Triangular, TriangularNormal
from dvae.inference.training.fit import Callback
from dvae.models.family.kvae import KVAE, smooth

B, T, D = 3, 6, 2
PRESENT = torch.tensor([[1, 1, 1, 1, 1, 1], [0, 1, 0, 1, 1, 0], [1, 1, 0, 0, 1, 1]], dtype=torch.bool)


def build(**options):
    """A small model far from its start, whose decoder is linear; noises of all sizes, and a that moves z."""
    given = {"latent": 3, "auxiliary": D, "width": 4, "hidden": (), "emission": "unit", "learn_noise": True}
    model = KVAE(**{**given, **options}).build({"x": 3}).double().eval()
    network = model.generator["a"].network
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
        network.A.mul_(0.7)
        network.B.add_(0.4 * torch.randn_like(network.B))
        network.C.add_(0.6 * torch.randn_like(network.C))
        network.log_noise.copy_(torch.tensor([-2.0, -1.0, 0.0]))
        network.log_emission.copy_(torch.tensor([-0.5, -2.0]))
    return model


def batch(present=PRESENT, size=3):
    """Whole frames that are missing, with NaN in their places, and entries of others."""
    x = torch.randn(*present.shape, size, dtype=torch.float64)
    mask = (torch.rand(x.shape) < 0.8).index_fill(-1, torch.tensor([0]), True) & present[..., None]
    return {"x": x.masked_fill(~mask, torch.nan), "mask": mask}


def dense(network, alpha):
    """Covariance of (z_1, a_1, z_2, ...), whose mean is 0, under weights alpha (T, K): one linear system."""
    steps, (n, d) = len(alpha), network.B.shape[1:]
    noises = [part.detach().exp() for part in (network.log_noise, network.log_emission)]
    a, b, c = (torch.einsum("tk,kij->tij", alpha, part.detach()) for part in (network.A, network.B, network.C))
    size = steps * (n + d)
    rest, spread = torch.eye(size).double(), torch.zeros(size).double()
    for t in range(steps):
        z = slice(t * (n + d), t * (n + d) + n)
        seen = slice(z.stop, z.stop + d)
        rest[seen, z] = -c[t]
        spread[z], spread[seen] = noises[0] if t else 20.0, noises[1]
        if t:
            rest[z, z.start - n - d : z.start - d], rest[z, z.start - d : z.start] = -a[t], -b[t]
    root = torch.linalg.inv(rest)
    return (root * spread) @ root.mT


def places(network, present, steps, what):
    """Where z or a of the steps that are `present` (T,) stand in `dense`."""
    n, d = network.B.shape[1:]
    inside = torch.arange(n) if what == "z" else torch.arange(n, n + d)
    return (torch.arange(steps)[present[:steps], None] * (n + d) + inside).flatten()


def given(network, alpha, present, a, wanted):
    """Mean and covariance of the places `wanted` given a (T, D) where it is present."""
    covariance = dense(network, alpha)
    seen = places(network, present, len(alpha), "a")
    gain = torch.linalg.solve(covariance[seen][:, seen], covariance[seen][:, wanted]).mT
    spread = covariance[wanted][:, wanted] - gain @ covariance[seen][:, wanted]
    return gain @ a[: len(alpha)][present[: len(alpha)]].flatten(), spread


def weights(network, present, a):
    """alpha (T, K) of one sequence, by a plain loop that reads a missing a as its mean in the dense normal."""
    read, found, state = [network.first], [], None
    for t in range(len(a)):
        out, state = network.memory(read[-1][None, None], state)
        found.append(network.weights(out[0, 0]).softmax(-1))
        if not present[t]:
            before = present & (torch.arange(len(a)) < t)
            here = places(network, torch.arange(len(a)) == t, t + 1, "a")
            read.append(given(network, torch.stack(found), before, a, here)[0])
        else:
            read.append(a[t])
    return torch.stack(found)


def evidence(network, present, a):
    """log p(a) of what is present, by the dense normal."""
    covariance = dense(network, weights(network, present, a))
    seen = places(network, present, len(a), "a")
    return MultivariateNormal(torch.zeros(len(seen)).double(), covariance[seen][:, seen]).log_prob(a[present].flatten())


@torch.no_grad()
@pytest.mark.parametrize("components", [1, 3])
def test_the_prior_of_what_is_there_is_the_marginal_of_the_dense_normal(components):
    model, data = build(components=components), batch()
    a = torch.randn(B, T, D, dtype=torch.float64)
    found = model.log_joint(data, {"a": a})["a"]
    for b in range(B):
        expected = evidence(model.generator["a"].network, PRESENT[b], a[b])
        assert found[b].item() == pytest.approx(expected.item(), abs=1e-8)


@torch.no_grad()
@pytest.mark.parametrize("components", [1, 3])
def test_the_smoothed_are_the_dense_conditionals(components):
    model = build(components=components)
    network, found = model.generator["a"].network, smooth(model, batch(), samples=2)
    for s in range(2):
        for b in range(B):
            a = found.a[s, b]
            alpha = weights(network, PRESENT[b], a)
            wanted = places(network, torch.ones(T, dtype=torch.bool), T, "z")
            mean, covariance = given(network, alpha, PRESENT[b], a, wanted)
            blocks = covariance.view(T, 3, T, 3)
            torch.testing.assert_close(found.weights[s, b], alpha, rtol=1e-9, atol=1e-9)
            torch.testing.assert_close(found.mean[s, b], mean.view(T, 3), rtol=1e-8, atol=1e-8)
            for t in range(T):
                torch.testing.assert_close(found.covariance[s, b, t], blocks[t, :, t], rtol=1e-8, atol=1e-8)
            for t in range(T - 1):
                torch.testing.assert_close(found.lag_one[s, b, t], blocks[t + 1, :, t], rtol=1e-8, atol=1e-8)


@torch.no_grad()
def test_padding_changes_nothing():
    model, data, lengths = build(), batch(), [6, 3, 4]
    a = torch.randn(B, T, D, dtype=torch.float64)
    found = model.log_joint({**data, "lengths": torch.tensor(lengths)}, {"a": a})
    smoothed = smooth(model, {**data, "lengths": torch.tensor(lengths)})
    for b, n in enumerate(lengths):
        alone = {name: value[b : b + 1, :n] for name, value in data.items()}
        for name, value in model.log_joint(alone, {"a": a[b : b + 1, :n]}).items():
            assert found[name][b].item() == pytest.approx(value.item(), abs=1e-10)
        alpha = weights(model.generator["a"].network, PRESENT[b, :n], smoothed.a[0, b, :n])
        wanted = places(model.generator["a"].network, torch.ones(n, dtype=torch.bool), n, "z")
        mean, _ = given(model.generator["a"].network, alpha, PRESENT[b, :n], smoothed.a[0, b, :n], wanted)
        torch.testing.assert_close(smoothed.mean[0, b, :n], mean.view(n, 3), rtol=1e-8, atol=1e-8)
        assert not smoothed.mean[0, b, n:].any()


# ----------------------------------------------------------------------------------------------- what is drawn of it


def linear(model, data):
    """log p(x) (B,) of what was observed, of a model with one component whose decoder is linear: one dense normal."""
    network, law = model.generator["a"].network, model.generator["x"].law
    steps = data["x"].shape[1]
    covariance = dense(network, torch.ones(steps, 1).double())
    here = places(network, torch.ones(steps, dtype=torch.bool), steps, "a")
    out = torch.block_diag(*[law.out.weight] * steps)
    spread = out @ covariance[here][:, here] @ out.mT + torch.eye(3 * steps)
    total = []
    for x, mask in zip(data["x"].flatten(1), data["mask"].flatten(1), strict=True):
        loc = law.out.bias.repeat(steps)[mask]
        total.append(MultivariateNormal(loc, spread[mask][:, mask]).log_prob(x[mask]))
    return torch.stack(total)


@torch.no_grad()
@pytest.mark.parametrize("bound", ["particles", "importance"])
def test_bounds_estimate_the_evidence_of_what_was_observed(bound):
    model, data, n = build(components=1), batch(), 75
    into, out = model.encoder["a"].law.out, model.generator["x"].law.out
    for layer in (into, out):
        layer.weight.zero_()
    out.weight[:D] = 2 * torch.eye(D)  # x_t tells a_t, but for its last coordinate, which may be missing
    into.weight[:D, :D], into.bias[:D] = torch.eye(D) / 2, -out.bias[:D] / 2
    into.bias[D:] = -0.3
    data["mask"][..., :D] = PRESENT[..., None]
    data["x"] = model.sample(B, T)["x"].masked_fill(~data["mask"], torch.nan)
    expected = linear(model, data)
    many = {name: value.repeat(n, 1, 1) for name, value in data.items()}
    if bound == "particles":
        found = dvae.particle_bound(model, many, 100, resample_below=0.9)
        assert found.resamplings.any()
    else:
        found = dvae.importance_bound(model, many, 100)
    ratio = (found.bound.unflatten(0, (n, B)) - expected).exp()
    assert ratio.std(0).max() < 1
    assert ((ratio.mean(0) - 1).abs() < 4 * ratio.std(0) / n**0.5).all()


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


def test_phases_free_the_matrices_and_then_what_mixes_them():
    method = KVAE(latent=2, auxiliary=3, width=4, hidden=(5, 4), warm_up=20, phases=True)
    model = method.build({"x": 4})
    network = model.generator["a"].network
    noises = network.log_noise.exp(), network.log_emission.exp()
    for noise, published in zip(noises, (0.08, 0.03), strict=True):
        torch.testing.assert_close(noise, torch.full_like(noise, published))
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
