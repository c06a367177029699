"""The density of `rslds` is that of its equations, its bound is a bound, and it finds the states of simulated data."""

import copy
import itertools
import math
from types import SimpleNamespace

import matplotlib.pyplot as plt
import nascar
import numpy as np
import pytest
import torch
from matplotlib import colors
from scipy import stats
from scipy.optimize import linear_sum_assignment

import dvae
from dvae.data.schema import Schema
from dvae.distributions import FAMILIES
from dvae.inference.training.recipe import fit_factor
from dvae.models.family.rslds import RSLDS, SwitchingLinear, cluster, draw_flow, principal_path, start_regimes
from dvae.networks import Dense


def build(recurrent=False, states=2, latent=2, size=3):
    torch.manual_seed(0)
    options = {"recurrent": recurrent, "states": states, "latent": latent, "width": 4, "hidden": (4,)}
    model = dvae.method("rslds", **options).build({"x": size}).double().eval()
    dynamics = model.generator["z"].network
    with torch.no_grad():
        for parameter in (dynamics.transition, dynamics.offset, dynamics.first, dynamics.whitening):
            parameter.add_(0.4 * torch.randn_like(parameter))
    return model


def moments(model):
    """Return arrays A, b, Q, m, S of the states, the emission's C, d and R, and logits r and P of the states."""
    dynamics, emission, states = (model.generator[name] for name in ("z", "x", "k"))
    raw = dynamics.network.whitening.detach()
    whitening = raw.tril(-1) + raw.diagonal(dim1=-2, dim2=-1).exp().diag_embed()
    first, noise = torch.linalg.inv(whitening.mT @ whitening).numpy()
    network = dynamics.network
    parts = network.transition, network.offset, network.first, emission.head.out.weight, emission.head.out.bias
    transition, offset, start, weight, bias = (part.detach().numpy() for part in parts)
    scale = np.diag(emission.head.log_scale.detach().exp().numpy() ** 2)
    logits = states.head.out.bias.detach().numpy(), states.head.out.weight.detach().numpy()
    return transition, offset, noise, start, first, weight, bias, scale, *logits


def joint_normal(model, path, steps):
    """Return mean and covariance of (z_{1:T}, x_{1:T}) given a path of states, and the log probability of the path."""
    transition, offset, noise, first, spread, weight, bias, scale, free, after = moments(model)
    size, logs = len(first[0]), 0.0
    mean, factor = np.zeros((steps, size)), np.zeros((steps, size, steps * size))
    for t, k in enumerate(path):
        columns = slice(t * size, (t + 1) * size)
        if t:
            mean[t], factor[t] = transition[k] @ mean[t - 1] + offset[k], transition[k] @ factor[t - 1]
        else:
            mean[t] = first[k]
        factor[t, :, columns] = np.linalg.cholesky(noise[k] if t else spread[k])
        logits = free + (after[:, path[t - 1]] if t else 0)
        logs += logits[k] - np.logaddexp.reduce(logits)
    mean, factor = mean.ravel(), factor.reshape(steps * size, -1)
    emission = np.kron(np.eye(steps), weight)
    covariance = factor @ factor.T
    cross = emission @ covariance
    data = cross @ emission.T + np.kron(np.eye(steps), scale)
    whole = np.block([[covariance, cross.T], [cross, data]])
    return np.concatenate([mean, emission @ mean + np.tile(bias, steps)]), whole, logs


def mixture_log_density(model, values, steps, part):
    """Return log p of (z, x) or of x, (N,), as a mixture over all paths of states."""
    logs = []
    for path in itertools.product(range(model.sizes["k"]), repeat=steps):
        mean, covariance, weight = joint_normal(model, path, steps)
        normal = stats.multivariate_normal(mean[part], covariance[part, part])
        logs.append(weight + np.atleast_1d(normal.logpdf(values)))
    return np.logaddexp.reduce(logs)


def log_joint(model, x, z):
    return torch.stack(list(model.log_joint(x, {"z": z}).values())).sum(0).numpy()


def test_the_joint_is_the_mixture_over_all_paths_and_the_bound_is_below_the_evidence():
    model, steps, count = build(), 4, 3
    drawn = model.sample(count, steps)
    x, z = drawn["x"], drawn["z"]
    values = torch.cat([z.flatten(1), x.flatten(1)], 1).numpy()
    np.testing.assert_allclose(
        log_joint(model, x, z), mixture_log_density(model, values, steps, slice(None)), atol=1e-9
    )
    evidence = mixture_log_density(model, x.flatten(1).numpy(), steps, slice(z[0].numel(), None))
    bounds = torch.stack([dvae.SequenceELBO().terms(model, x).bound.detach() for _ in range(200)]).numpy()
    assert (bounds.mean(0) <= evidence + 4 * bounds.std(0) / math.sqrt(200)).all()
    assert (bounds.mean(0) < evidence).all()


def test_equal_states_are_a_kalman_filter():
    """log p(x, z) - log p(z | x), with the exact smoother, is the Kalman evidence for any z."""
    model, steps = build(), 5
    with torch.no_grad():
        network = model.generator["z"].network
        for parameter in (
            network.transition,
            network.offset,
            network.first,
            network.whitening[0],
            network.whitening[1],
        ):
            parameter.copy_(parameter[:1].expand_as(parameter))
    x, z = torch.randn(4, steps, 3).double(), torch.randn(4, steps, 2).double()
    transition, offset, noise, first, spread, weight, bias, scale, *_ = moments(model)
    evidence, (mean, covariance) = np.zeros(4), (np.tile(first[0], (4, 1)), spread[0])
    for t in range(steps):
        if t:
            mean, covariance = (
                mean @ transition[0].T + offset[0],
                transition[0] @ covariance @ transition[0].T + noise[0],
            )
        predicted = weight @ covariance @ weight.T + scale
        innovation = x[:, t].numpy() - mean @ weight.T - bias
        evidence += stats.multivariate_normal(np.zeros(3), predicted).logpdf(innovation)
        gain = covariance @ weight.T @ np.linalg.inv(predicted)
        mean, covariance = mean + innovation @ gain.T, covariance - gain @ weight @ covariance
    whole_mean, whole, _ = joint_normal(model, [0] * steps, steps)
    n = steps * 2
    gain = whole[:n, n:] @ np.linalg.inv(whole[n:, n:])
    smoothed = whole_mean[:n] + (x.flatten(1).numpy() - whole_mean[n:]) @ gain.T
    rest = stats.multivariate_normal(np.zeros(n), whole[:n, :n] - gain @ whole[n:, :n])
    posterior = rest.logpdf(z.flatten(1).numpy() - smoothed)
    np.testing.assert_allclose(log_joint(model, x, z) - posterior, evidence, atol=1e-8)


def test_the_bounds_of_the_recurrent_model_are_below_the_evidence_by_quadrature():
    model, steps = build(recurrent=True, latent=1, size=1), 3
    with torch.no_grad():
        model.generator["k"].head.out.weight[:, 2:] *= 5
    x = model.sample(2, steps)["x"]
    line = torch.linspace(-9, 9, 61, dtype=torch.float64)
    grid = torch.cartesian_prod(line, line, line)[..., None]
    evidence = []
    for sequence in x:
        logs = [log_joint(model, sequence.expand(len(z), -1, -1), z) for z in grid.split(200_000)]
        evidence.append(np.logaddexp.reduce(np.concatenate(logs)) + 3 * math.log(0.3))
    evidence = torch.tensor(evidence)
    bounds = torch.stack([dvae.SequenceELBO().terms(model, x).bound.detach() for _ in range(50)])
    assert (bounds.mean(0) < evidence).all()
    dvae.fit(model, x, stages=[dvae.Stage(300, frozen=("generator.",))], learning_rate=1e-2, progress=False)
    torch.testing.assert_close(dvae.iwae_bound(model, x, 10_000).bound, evidence, atol=0.1, rtol=0)


def test_dynamics_fitted_to_a_path_without_noise_are_exact():
    dynamics, truth = (build(states=3).generator["z"].network for _ in range(2))
    states = torch.nn.functional.one_hot(torch.randint(3, (400, 2)), 3).double()
    before = 100 * torch.randn(400, 2).double()
    after = truth.features_at(states[:, 1], before)[:, :2].detach()
    with torch.no_grad():
        for parameter in dynamics.parameters():
            parameter.normal_()
    dynamics.fit(torch.stack([before, after], 1), states)
    torch.testing.assert_close(dynamics.transition, truth.transition, atol=1e-3, rtol=0)
    torch.testing.assert_close(dynamics.offset, truth.offset, atol=0.05, rtol=0)


@pytest.fixture(scope="module")
def race():
    return nascar.simulate(50, 100, seed=2000)


def test_the_states_of_a_race_track_are_found(race):
    _, x, states = race
    fit = dvae.fit(dvae.method("rslds"), x[:40], steps=80, learning_rate=3e-3, progress=False)
    assert nascar.accuracy(fit.model, x[40:], states[40:]) >= 0.9


def accuracy_after_start(model, batch, states, smoothing=5):
    """Return the share of correct states given the path of the initialised model, at valid steps."""
    start_regimes(model, SimpleNamespace(sample=lambda *_: batch), smoothing)
    data = model.read(batch)
    path, valid = principal_path(model, data, smoothing)
    run = model.rollout(data)
    run.values["z"] = path
    inferred = run.summation.probabilities()["k"].argmax(-1)[valid]
    counts = torch.zeros(4, 4).index_put_((inferred, states[valid]), torch.ones(len(inferred)), accumulate=True)
    return float(counts[linear_sum_assignment(-counts)].sum() / counts.sum())


def test_ragged_and_missing_data_start_at_the_states(race):
    _, x, states = race
    torch.manual_seed(0)
    lengths, mask = torch.randint(40, 101, (50,)), torch.rand(x.shape) < 0.8
    padded = torch.where((torch.arange(100) < lengths[:, None])[..., None] & mask, x, torch.nan)
    model = dvae.method("rslds").build({"x": 10})
    assert accuracy_after_start(model, {"x": padded, "mask": mask, "lengths": lengths}, states) >= 0.9


def test_a_column_that_some_sequences_never_observe_is_no_state(race):
    _, x, states = race
    mask = torch.ones_like(x, dtype=torch.bool)
    mask[:10, :, 0] = False
    torch.manual_seed(0)
    model = dvae.method("rslds").build({"x": 10})
    assert accuracy_after_start(model, {"x": x + 30, "mask": mask}, states) >= 0.9


class Counts(Schema):
    """Schema of counts."""

    emission = FAMILIES["count"]


def test_counts_start_at_the_states():
    """Counts have more noise, so their path needs more smoothing."""
    torch.manual_seed(0)
    race = nascar.track().sample(30, 228)
    counts = torch.poisson((2 * race["z"] @ torch.linalg.qr(torch.randn(40, 2))[0].mT + 1.5).exp())
    model = dvae.method("rslds").build(Counts({"x": 40}))
    assert accuracy_after_start(model, {"x": counts}, race["k"].argmax(-1), smoothing=9) >= 0.9


def test_the_flow_is_that_of_the_true_parameters(race):
    truth, x, _ = race
    truth.guide = lambda batch: {"z": torch.tensor([[[-3.5, -1.5], [3.5, 1.5]]])}
    try:
        ax = draw_flow(truth, x)
    finally:
        del truth.guide
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels == ["k = 0", "k = 1", "k = 2", "k = 3"]
    (arrows,) = ax.collections
    places = torch.tensor(np.asarray(arrows.get_offsets()), dtype=torch.float32)
    colours = np.stack([colors.to_rgba(f"C{k}") for k in range(4)])
    states = (arrows.get_facecolors()[:, None] == colours).all(-1).argmax(-1)
    right, top = places.T
    logits = torch.stack([100 * (right - 2), -100 * (right + 2), 10 * top, -10 * top], 1)
    np.testing.assert_array_equal(states, logits.argmax(1))
    moves = truth.generator["z"].network.features_at(torch.eye(4)[states], places)[:, :2] - places
    np.testing.assert_allclose(np.stack([arrows.U, arrows.V], 1), moves.detach(), atol=1e-5)
    plt.close(ax.figure)


def test_wrong_uses_are_an_error():
    with pytest.raises(ValueError, match="a flow needs the model"):
        draw_flow(build(), torch.zeros(1, 3, 3))
    with pytest.raises(ValueError, match="two of the 2 coordinates of z"):
        draw_flow(build(recurrent=True), torch.zeros(1, 3, 3), coordinates=(0, 2))
    with pytest.raises(ValueError, match="two of the 2 coordinates of z"):
        draw_flow(build(recurrent=True), torch.zeros(1, 3, 3), coordinates=(0, 1, 1))
    other = dvae.DynamicalVAE(RSLDS.generative, RSLDS.inference, {"k": dvae.Discrete(2), "z": 2, "x": 3})
    with pytest.raises(ValueError, match=r"dvae\.method\('rslds'\) built, without covariates"):
        draw_flow(other, torch.zeros(1, 3, 3))
    pair = "p(k_t | k_{t-1}) p(z_t | z_{t-1}, k_t) p(x_t | z_t)", "q(z_t | x_t)"
    sizes, networks = {"k": dvae.Discrete(2), "z": 2, "x": 2}, {"p(z)": SwitchingLinear(), "default": Dense()}
    with pytest.raises(ValueError, match="switching dynamics need"):
        dvae.DynamicalVAE(*pair, sizes, networks)


def test_a_fitted_factor_gains_density_and_the_others_keep_their_parameters():
    model, x, z = build(), torch.randn(3, 5, 3).double(), torch.randn(3, 5, 2).double()
    before, density = copy.deepcopy(model.state_dict()), model.log_joint(x, {"z": z})["x"].sum()
    fit_factor(model, "x", x, {"z": z}, steps=20, learning_rate=0.05)
    changed = {name for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    assert changed
    assert all(name.startswith("generator.x.") for name in changed)
    assert model.log_joint(x, {"z": z})["x"].sum() > density


def test_distinct_clusters_are_found():
    torch.manual_seed(0)
    labels = torch.arange(60) % 3
    clusters = cluster(10 * torch.eye(3)[labels] + torch.randn(60, 3), 3)
    assert ((clusters.mT @ torch.eye(3)[labels] > 0).sum(0) == 1).all()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_dynamax_has_the_same_evidence():
    """An autoregressive hidden Markov model, given z, and a linear-Gaussian model, for equal states."""
    pytest.importorskip("dynamax", reason="dynamax is not installed")
    import jax
    import jax.numpy as jnp
    from dynamax.hidden_markov_model import LinearAutoregressiveHMM
    from dynamax.linear_gaussian_ssm import LinearGaussianSSM

    jax.config.update("jax_enable_x64", True)
    model, steps = build(states=3), 6
    with torch.no_grad():  # dynamax has no moments of its own for the first step
        network = model.generator["z"].network
        network.first.copy_(network.offset)
        network.whitening[0] = network.whitening[1]
        model.generator["x"].head.log_scale.zero_()  # dynamax adds 1e-9 to variances
    transition, offset, noise, _, _, weight, bias, scale, free, after = moments(model)
    z = torch.randn(steps, 2).double()
    hmm = LinearAutoregressiveHMM(3, 2, num_lags=1)
    softmax = torch.tensor(free[:, None] + after).softmax(0).mT.numpy()
    parameters, _ = hmm.initialize(
        jax.random.PRNGKey(0),
        initial_probs=jnp.array(torch.tensor(free).softmax(0).numpy()),
        transition_matrix=jnp.array(softmax),
        emission_weights=jnp.array(transition),
        emission_biases=jnp.array(offset),
        emission_covariances=jnp.array(noise),
    )
    inputs = hmm.compute_inputs(jnp.array(z.numpy()))
    expected = float(hmm.marginal_log_prob(parameters, jnp.array(z.numpy()), inputs))
    assert model.log_joint(torch.zeros(1, steps, 3), {"z": z[None]})["z"].item() == pytest.approx(expected, abs=1e-6)

    lgssm = LinearGaussianSSM(2, 3)
    parameters, _ = lgssm.initialize(
        jax.random.PRNGKey(0),
        initial_mean=jnp.array(offset[0]),
        initial_covariance=jnp.array(noise[0]),
        dynamics_weights=jnp.array(transition[0]),
        dynamics_bias=jnp.array(offset[0]),
        dynamics_covariance=jnp.array(noise[0]),
        emission_weights=jnp.array(weight),
        emission_bias=jnp.array(bias),
        emission_covariance=jnp.array(scale),
    )
    x = torch.randn(steps, 3).double()
    mean, covariance, _ = joint_normal(model, [0] * steps, steps)
    n = steps * 2
    evidence = stats.multivariate_normal(mean[n:], covariance[n:, n:]).logpdf(x.flatten().numpy())
    assert evidence == pytest.approx(float(lgssm.marginal_log_prob(parameters, jnp.array(x.numpy()))), abs=1e-6)
