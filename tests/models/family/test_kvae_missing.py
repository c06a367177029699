"""A KVAE integrates missing frames out: compared with one dense normal of all z and a."""

import pytest
import torch
from torch.distributions import MultivariateNormal

import dvae
from dvae.models.family.kvae import KVAE, smooth
from dvae.networks.base import presence

B, T, D = 3, 6, 2
PRESENT = torch.tensor([[1, 1, 0, 0, 1, 1], [0, 1, 0, 1, 1, 0], [1, 0, 1, 1, 1, 1]], dtype=torch.bool)


def build(**options):
    """Return a small perturbed model with a linear decoder, various noises, and a that changes z."""
    defaults = {"latent": 3, "auxiliary": D, "width": 4, "hidden": (), "emission": "unit", "learn_noise": True}
    model = KVAE(**{**defaults, **options}).build({"x": 3}).double().eval()
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
    """Return a batch with missing frames and missing entries, which are NaN."""
    x = torch.randn(*present.shape, size, dtype=torch.float64)
    mask = (torch.rand(x.shape) < 0.8).index_fill(-1, torch.tensor([0]), True) & present[..., None]
    return {"x": x.masked_fill(~mask, torch.nan), "mask": mask}


def dense(network, alpha):
    """Return the covariance of (z_1, a_1, z_2, ...) under weights alpha (T, K), by one linear system; the mean is 0."""
    steps, (n, d) = len(alpha), network.B.shape[1:]
    noises = [part.detach().exp() for part in (network.log_noise, network.log_emission)]
    a, b, c = (torch.einsum("tk,kij->tij", alpha, part.detach()) for part in (network.A, network.B, network.C))
    size = steps * (n + d)
    system, spread = torch.eye(size).double(), torch.zeros(size).double()
    for t in range(steps):
        z = slice(t * (n + d), t * (n + d) + n)
        a_slice = slice(z.stop, z.stop + d)
        system[a_slice, z] = -c[t]
        spread[z], spread[a_slice] = noises[0] if t else 20.0, noises[1]
        if t:
            system[z, z.start - n - d : z.start - d], system[z, z.start - d : z.start] = -a[t], -b[t]
    root = torch.linalg.inv(system)
    return (root * spread) @ root.mT


def indices_of(network, present, steps, name):
    """Return the indices in `dense` of z or a at the steps that are `present` (T,)."""
    n, d = network.B.shape[1:]
    inside = torch.arange(n) if name == "z" else torch.arange(n, n + d)
    return (torch.arange(steps)[present[:steps], None] * (n + d) + inside).flatten()


def conditional(network, alpha, present, a, indices):
    """Return the mean and covariance at `indices` given the present steps of a (T, D)."""
    covariance = dense(network, alpha)
    observed = indices_of(network, present, len(alpha), "a")
    gain = torch.linalg.solve(covariance[observed][:, observed], covariance[observed][:, indices]).mT
    spread = covariance[indices][:, indices] - gain @ covariance[observed][:, indices]
    return gain @ a[: len(alpha)][present[: len(alpha)]].flatten(), spread


def weights(network, present, a):
    """Return alpha (T, K) of one sequence, by a loop that replaces a missing a by its mean in the dense normal."""
    inputs, alphas, state = [network.first], [], None
    for t in range(len(a)):
        out, state = network.memory(inputs[-1][None, None], state)
        alphas.append(network.weights(out[0, 0]).softmax(-1))
        if not present[t]:
            before = present & (torch.arange(len(a)) < t)
            here = indices_of(network, torch.arange(len(a)) == t, t + 1, "a")
            inputs.append(conditional(network, torch.stack(alphas), before, a, here)[0])
        else:
            inputs.append(a[t])
    return torch.stack(alphas)


def evidence(network, present, a):
    """Return log p(a) of the present steps, by the dense normal."""
    covariance = dense(network, weights(network, present, a))
    observed = indices_of(network, present, len(a), "a")
    return MultivariateNormal(torch.zeros(len(observed)).double(), covariance[observed][:, observed]).log_prob(
        a[present].flatten()
    )


@pytest.fixture(autouse=True)
def _without_gradients():
    with torch.no_grad():
        yield


@pytest.mark.parametrize("components", [1, 3])
def test_the_prior_of_present_steps_is_the_marginal_of_the_dense_normal(components):
    model, data = build(components=components), batch()
    a = torch.randn(B, T, D, dtype=torch.float64)
    log_prior = model.log_joint(data, {"a": a})["a"]
    for b in range(B):
        expected = evidence(model.generator["a"].network, PRESENT[b], a[b])
        assert log_prior[b].item() == pytest.approx(expected.item(), abs=1e-8)


@pytest.mark.parametrize("components", [1, 3])
def test_smoothed_moments_equal_the_dense_conditionals(components):
    model = build(components=components)
    network, smoothed = model.generator["a"].network, smooth(model, batch(), samples=2)
    for s in range(2):
        for b in range(B):
            a = smoothed.a[s, b]
            alpha = weights(network, PRESENT[b], a)
            indices = indices_of(network, torch.ones(T, dtype=torch.bool), T, "z")
            mean, covariance = conditional(network, alpha, PRESENT[b], a, indices)
            blocks = covariance.view(T, 3, T, 3)
            torch.testing.assert_close(smoothed.weights[s, b], alpha, rtol=1e-9, atol=1e-9)
            torch.testing.assert_close(smoothed.mean[s, b], mean.view(T, 3), rtol=1e-8, atol=1e-8)
            for t in range(T):
                torch.testing.assert_close(smoothed.covariance[s, b, t], blocks[t, :, t], rtol=1e-8, atol=1e-8)
            for t in range(T - 1):
                torch.testing.assert_close(smoothed.lag_one[s, b, t], blocks[t + 1, :, t], rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("components", [1, 3])
def test_values_of_a_missing_frame_are_not_read(components):
    model, data = build(components=components), batch()
    a, other = torch.randn(2, B, T, D, dtype=torch.float64)
    other = torch.where(PRESENT[..., None], a, other)
    first, second = (model.log_joint(data, {"a": values}) for values in (a, other))
    for name, value in first.items():
        torch.testing.assert_close(second[name], value, rtol=0, atol=1e-12)
    terms = dvae.SequenceELBO().terms(model, data)
    for name, steps in terms.steps.items():
        assert not steps[~PRESENT].any(), name
        assert steps[PRESENT].all(), name


@pytest.mark.parametrize("components", [1, 3])
def test_padding_changes_nothing(components):
    model, data, lengths = build(components=components), batch(), [6, 3, 4]
    a = torch.randn(B, T, D, dtype=torch.float64)
    log_joint = model.log_joint({**data, "lengths": torch.tensor(lengths)}, {"a": a})
    smoothed = smooth(model, {**data, "lengths": torch.tensor(lengths)})
    for b, n in enumerate(lengths):
        single = {name: value[b : b + 1, :n] for name, value in data.items()}
        for name, value in model.log_joint(single, {"a": a[b : b + 1, :n]}).items():
            assert log_joint[name][b].item() == pytest.approx(value.item(), abs=1e-10)
        alpha = weights(model.generator["a"].network, PRESENT[b, :n], smoothed.a[0, b, :n])
        indices = indices_of(model.generator["a"].network, torch.ones(n, dtype=torch.bool), n, "z")
        mean, _ = conditional(model.generator["a"].network, alpha, PRESENT[b, :n], smoothed.a[0, b, :n], indices)
        torch.testing.assert_close(smoothed.mean[0, b, :n], mean.view(n, 3), rtol=1e-8, atol=1e-8)
        assert not smoothed.mean[0, b, n:].any()


@pytest.mark.parametrize("is_known", [True, False])
def test_single_steps_equal_all_steps_at_once(is_known):
    network, a = build().generator["a"].network, torch.randn(B, T, D, dtype=torch.float64)
    context, rows = {presence("a"): PRESENT}, torch.tensor([2, 0, 0])
    expected = network({"a": a, **context}, T)
    start = {"a": a, **context} if is_known else context
    state, selected = network.start(start, B, T), network.select(network.start(start, B, T), rows)
    for t in range(T):
        features, state = network.step(state, t, {"a": a.unbind(1)})
        torch.testing.assert_close(features, expected[:, t], rtol=1e-9, atol=1e-9)
        selected_features, selected = network.step(selected, t, {"a": a[rows].unbind(1)})
        torch.testing.assert_close(selected_features, features[rows])


# ------------------------------------------------------------------------------------------------------------ bounds


def exact_evidence(model, data):
    """Return log p(x) (B,) of the observed entries, by a dense normal; the model is linear, with one component."""
    network, distribution = model.generator["a"].network, model.generator["x"].head
    steps = data["x"].shape[1]
    covariance = dense(network, torch.ones(steps, 1).double())
    here = indices_of(network, torch.ones(steps, dtype=torch.bool), steps, "a")
    out = torch.block_diag(*[distribution.out.weight] * steps)
    spread = out @ covariance[here][:, here] @ out.mT + torch.eye(3 * steps)
    total = []
    for x, mask in zip(data["x"].flatten(1), data["mask"].flatten(1), strict=True):
        loc = distribution.out.bias.repeat(steps)[mask]
        total.append(MultivariateNormal(loc, spread[mask][:, mask]).log_prob(x[mask]))
    return torch.stack(total)


@pytest.mark.parametrize("bound", ["particles", "importance"])
def test_bounds_estimate_the_evidence_of_observed_entries(bound):
    model, data, n = build(components=1), batch(), 75
    into, out = model.encoder["a"].head.out, model.generator["x"].head.out
    for layer in (into, out):
        layer.weight.zero_()
    out.weight[:D] = 2 * torch.eye(D)  # x_t determines a_t; its last coordinate, which may be missing, does not matter
    into.weight[:D, :D], into.bias[:D] = torch.eye(D) / 2, -out.bias[:D] / 2
    into.bias[D:] = -0.3
    data["mask"][..., :D] = PRESENT[..., None]
    data["x"] = model.sample(B, T)["x"].masked_fill(~data["mask"], torch.nan)
    expected = exact_evidence(model, data)
    many = {name: value.repeat(n, 1, 1) for name, value in data.items()}
    if bound == "particles":
        estimate = dvae.fivo_bound(model, many, 100, resample_below=0.9)
        assert estimate.resamplings.any()
    else:
        estimate = dvae.iwae_bound(model, many, 100)
    ratio = (estimate.bound.unflatten(0, (n, B)) - expected).exp()
    assert ratio.std(0).max() < 1
    assert ((ratio.mean(0) - 1).abs() < 4 * ratio.std(0) / n**0.5).all()
