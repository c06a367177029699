"""Frames that are missing are integrated out of a KVAE: against one dense normal of all z and a without them."""

import pytest
import torch
from torch.distributions import MultivariateNormal

import dvae
from dvae.models.family.kvae import KVAE, smooth
from dvae.networks.base import presence

B, T, D = 3, 6, 2
PRESENT = torch.tensor([[1, 1, 0, 0, 1, 1], [0, 1, 0, 1, 1, 0], [1, 0, 1, 1, 1, 1]], dtype=torch.bool)


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


@pytest.fixture(autouse=True)
def _without_gradients():
    with torch.no_grad():
        yield


@pytest.mark.parametrize("components", [1, 3])
def test_the_prior_of_what_is_there_is_the_marginal_of_the_dense_normal(components):
    model, data = build(components=components), batch()
    a = torch.randn(B, T, D, dtype=torch.float64)
    found = model.log_joint(data, {"a": a})["a"]
    for b in range(B):
        expected = evidence(model.generator["a"].network, PRESENT[b], a[b])
        assert found[b].item() == pytest.approx(expected.item(), abs=1e-8)


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


@pytest.mark.parametrize("components", [1, 3])
def test_what_stands_at_a_missing_frame_is_not_read(components):
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


@pytest.mark.parametrize("known", [True, False])
def test_one_step_at_a_time_is_all_steps_at_once(known):
    network, a = build().generator["a"].network, torch.randn(B, T, D, dtype=torch.float64)
    told, rows = {presence("a"): PRESENT}, torch.tensor([2, 0, 0])
    expected = network({"a": a, **told}, T)
    start = {"a": a, **told} if known else told
    state, moved = network.start(start, B, T), network.select(network.start(start, B, T), rows)
    for t in range(T):
        features, state = network.step(state, t, {"a": a.unbind(1)})
        torch.testing.assert_close(features, expected[:, t], rtol=1e-9, atol=1e-9)
        chosen, moved = network.step(moved, t, {"a": a[rows].unbind(1)})
        torch.testing.assert_close(chosen, features[rows])


# ----------------------------------------------------------------------------------------------- what is drawn of it


def linear(model, data):
    """log p(x) (B,) of what was observed, of a model with one component whose decoder is linear: one dense normal."""
    network, distribution = model.generator["a"].network, model.generator["x"].head
    steps = data["x"].shape[1]
    covariance = dense(network, torch.ones(steps, 1).double())
    here = places(network, torch.ones(steps, dtype=torch.bool), steps, "a")
    out = torch.block_diag(*[distribution.out.weight] * steps)
    spread = out @ covariance[here][:, here] @ out.mT + torch.eye(3 * steps)
    total = []
    for x, mask in zip(data["x"].flatten(1), data["mask"].flatten(1), strict=True):
        loc = distribution.out.bias.repeat(steps)[mask]
        total.append(MultivariateNormal(loc, spread[mask][:, mask]).log_prob(x[mask]))
    return torch.stack(total)


@pytest.mark.parametrize("bound", ["particles", "importance"])
def test_bounds_estimate_the_evidence_of_what_was_observed(bound):
    model, data, n = build(components=1), batch(), 75
    into, out = model.encoder["a"].head.out, model.generator["x"].head.out
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
        found = dvae.fivo_bound(model, many, 100, resample_below=0.9)
        assert found.resamplings.any()
    else:
        found = dvae.iwae_bound(model, many, 100)
    ratio = (found.bound.unflatten(0, (n, B)) - expected).exp()
    assert ratio.std(0).max() < 1
    assert ((ratio.mean(0) - 1).abs() < 4 * ratio.std(0) / n**0.5).all()
