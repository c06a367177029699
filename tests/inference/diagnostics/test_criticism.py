"""Criticism: exact guides pass, wrong guides fail as described, p-values and statistics have known values."""

import itertools
import json
import math
from dataclasses import dataclass

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from scipy import stats

import dvae
from dvae import DynamicalVAE, Oracle, linear_gaussian_surrogate, motion
from dvae.data.sequences import ArrayWindows
from dvae.inference.diagnostics.calibration import Calibration, calibrate
from dvae.inference.diagnostics.checks import STATISTICS, Check, predictive_checks
from dvae.inference.diagnostics.traversal import traverse
from dvae.motion import Skeleton

T = 4
DKF = "p(z_t | z_{t-1}) p(x_t | z_t)"
STATIC = "p(w) p(x_t | w)"
CHAIN = Skeleton(("Pelvis", "Knee", "Foot"), (-1, 0, 1), up="y", fps=10.0, name="chain")


def linear(generative, inference, scale=0.9, seed=0, **sizes):
    """A surrogate whose guide is the best of its factorization."""
    model = linear_gaussian_surrogate(generative, inference, sizes, T, seed, scale=scale)
    Oracle(model, T).fit_guide()
    return model


def run(model, simulations=1000, length=T, **options):
    return calibrate(model, length, simulations, progress=False, **options)


def from_ranks(ranks, draws):
    names = tuple(f"z_{q + 1}[0]" for q in range(ranks.shape[1]))
    return Calibration(np.asarray(ranks), names, draws, T, 0, {})


def posterior_guide(model, factor=1.0, shift=0.0):
    """Return the marginals of the exact posterior as a guide, scaled by a factor and shifted by deviations."""
    oracle = Oracle(model, T)

    def guide(batch):
        mean, covariance = (m.detach() for m in oracle.posterior(batch))
        scale = covariance.diagonal().sqrt()
        mean = mean + shift * scale
        start = 0
        with pyro.plate("sequences", len(mean), dim=-1):
            for name in model.latents:
                shape = (*([T] if model.generative.local(name) else []), model.sizes[name])
                here = slice(start, start := start + math.prod(shape))
                loc, wide = mean[:, here].unflatten(1, shape), factor * scale[here].unflatten(0, shape)
                pyro.sample(name, dist.Normal(loc, wide.expand_as(loc)).to_event(len(shape)))

    return guide


# Simulation-based calibration


def test_ranks_of_the_exact_guide_are_uniform_and_of_the_mean_field_guide_are_not():
    right, wrong = (
        run(linear(DKF, inference, z=1, x=1)) for inference in ("q(z_t | z_{t+1}, x_{<=t})", "q(z_t | x_{1:T})")
    )
    assert right.p_value > 1e-3
    assert not any(right.readings)
    assert right.verdict.startswith("no evidence against")
    assert wrong.p_value < 1e-6
    assert wrong.readings[np.argmin(wrong.p_values[:-2])] == "is too narrow"
    assert "is not the posterior" in wrong.verdict


@pytest.mark.parametrize(
    ("options", "reading"),
    [
        ({"factor": 1.6}, "is too wide"),
        ({"factor": 0.6, "shift": 0.8}, "is too narrow, draws too high"),
    ],
)
def test_the_shape_of_the_histogram_names_the_error(options, reading):
    model = linear(STATIC, "q(w | x_{1:T})", w=1, x=2)
    right, wrong = (run(model, guide=posterior_guide(model, **o)) for o in ({}, options))
    assert right.names == ("w[0]", "TARP", "log joint")
    assert right.p_value > 1e-3
    assert wrong.p_values[0] < 1e-6
    assert wrong.readings[0] == reading
    factor, shift = options.get("factor", 1.0), options.get("shift", 0.0)
    assert wrong.spread[0] == pytest.approx(1 / factor, rel=5 / math.sqrt(2000))
    assert wrong.bias[0] == pytest.approx(-shift / factor, abs=5 / factor / math.sqrt(1000))
    assert right.spread[0] == pytest.approx(1, rel=5 / math.sqrt(2000))


def test_p_values_equal_those_by_enumeration():
    count, draws = 5, 2
    outcomes = np.array(list(itertools.product(range(draws + 1), repeat=count))).T
    result = from_ranks(outcomes, draws)
    below = np.stack([(outcomes < k).sum(0) for k in (1, 2)])
    points = np.array([[1], [2]]) / 3
    tails = np.minimum(stats.binom.cdf(below, count, points), stats.binom.sf(below - 1, count, points)).min(0)
    expected = (tails[:, None] * (1 + 1e-9) >= tails).mean(1)
    np.testing.assert_allclose(result.p_values, expected, atol=1e-12)
    ecdf = result.counts.cumsum(1)[:, :-1] / len(result.ranks)
    for alpha in (0.01, 0.05, 0.3):
        _, low, high = result.envelope(alpha)
        outside = ((ecdf < low - 1e-12) | (ecdf > high + 1e-12)).any(1)
        assert outside.mean() <= alpha
        assert (outside == (expected <= alpha)).all()


def test_a_calibration_is_printed_drawn_and_stored():
    result = run(linear(DKF, "q(z_t | x_{1:T})", z=1, x=1), 300)
    text = str(result)
    assert "z_2[0]" in text
    assert "is too narrow" in text
    assert text.index("z_2[0]") < text.index("z_1[0]")  # worst first
    assert json.loads(result.to_json())["summary"]["quantities"]["z_2[0]"]["p"] == result.p_values[1]
    assert dict(result.dataset.sizes) == {"simulation": 300, "quantity": 6}
    titles = [axes.get_title().split(",")[0] for axes in result.plot(worst=3).axes if axes.get_title()]
    assert titles == [result.names[q] for q in np.argsort(result.p_values, kind="stable")[:3]]


# Predictive checks


@dataclass(frozen=True, eq=False)
class Motions(ArrayWindows):
    """Arrays as motions of a skeleton."""

    skeleton: Skeleton = CHAIN

    def positions(self, x):
        return x.unflatten(-1, (-1, 3))


def test_a_stored_calibration_is_read_unchanged():
    result = from_ranks(np.random.default_rng(0).binomial(9, 0.6, (40, 3)), 9)
    loaded = Calibration.from_json(result.to_json())
    assert loaded.to_json() == result.to_json()
    assert str(loaded) == str(result)
    document = result.document()
    for damage in ({"names": ["z"]}, {"draws": 7}, {"draws": 10**9}, {"ranks": [41, 3]}):
        with pytest.raises(ValueError, match="not written by Calibration"):
            Calibration.of({**document, "attributes": document["attributes"] | damage})


def test_statistics_have_known_values():
    t = torch.arange(64, dtype=torch.float64)
    wave = torch.stack([2 + 3 * (2 * math.pi * t / 32).sin(), 0 * t], 1)
    values = {name: float(statistic.function(wave)) for name, statistic in STATISTICS.items()}
    assert values["mean"] == pytest.approx(1)
    assert values["scale"] == pytest.approx(math.sqrt(3**2 / 2 / 2))
    assert values["roughness"] == pytest.approx(2 * math.sin(math.pi / 32) * values["scale"], rel=0.02)
    centred = wave[:, 0].numpy() - 2
    correlation = np.correlate(centred, centred, "full")[63:] / (centred @ centred)
    assert values["correlation length"] == np.flatnonzero(correlation < math.exp(-1))[0]
    assert values["lag-1 correlation"] == pytest.approx(correlation[1] * 64 / 63)
    assert values["zeros"] == pytest.approx(0.5)
    assert (values["smallest"], values["largest"]) == (pytest.approx(-1), pytest.approx(5))
    still = torch.full((5, 4, 2), 0.1)
    assert (STATISTICS["correlation length"].function(still[:, :3]) == 3).all()
    assert (STATISTICS["correlation length"].function(still) == 4).all()
    assert (STATISTICS["lag-1 correlation"].function(still) == 1).all()
    assert all(statistic.function(torch.randn(2, 5, 4, 3)).shape == (2, 5) for statistic in STATISTICS.values())
    gaps = torch.tensor([0.0, torch.nan, 3.0, torch.nan, -2.0, 0.0])[:, None]
    observed_values = [float(STATISTICS[name].function(gaps)) for name in ("zeros", "smallest", "largest")]
    assert observed_values == [0.5, -2, 3]


@pytest.fixture(scope="module")
def true_checks():
    """Return checks of windows that the model drew; x_{t-1} alone predicts the future, so the guide is irrelevant."""
    model = linear_gaussian_surrogate("p(z_t) p(x_t | x_{t-1}, z_t)", "q(z_t | x_t, x_{t-1})", {"z": 1, "x": 9}, T)
    Oracle(model, T).fit_guide()
    with torch.random.fork_rng():
        torch.manual_seed(0)
        windows = Motions(model.sample(1500, T)["x"], observed=2)
    options = {"samples": 50, "batch_size": 500, "seed": 1, "progress": False, "draw_emission": True}
    return predictive_checks(model, windows, motion.statistics(windows), **options)


@pytest.mark.parametrize(("name", "samples"), [("speed", 5), ("bone length", 20), ("foot height", 19)])
def test_tail_areas_of_the_true_model_are_uniform(true_checks, name, samples):
    forecast, posterior = (true_checks["model", program, name] for program in ("forecast", "posterior"))
    assert forecast.replicated.shape == (50, 1500)
    real, replicated = forecast.real, forecast.replicated[:samples]
    ties = (replicated == real).sum(0)  # the height of a foot that is always the lowest joint is 0
    ranks = (replicated < real).sum(0) + np.random.default_rng(0).integers(0, ties + 1)
    assert stats.chisquare(np.bincount(ranks, minlength=samples + 1)).pvalue > 1e-3
    # The 1 + S windows are exchangeable, so the expected share is known, also with ties.
    alike = np.concatenate([real[None], replicated])
    leave_one_out = [Check(alike[s], np.delete(alike, s, 0), "") for s in range(samples + 1)]
    expected = np.mean([check.outside for check in leave_one_out])
    assert leave_one_out[0].outside == pytest.approx(expected, abs=4 * math.sqrt(expected * (1 - expected) / 1500))
    if name == "foot height":
        assert expected < leave_one_out[0].expected_outside
    else:
        assert not ties.any()
        assert expected == pytest.approx(leave_one_out[0].expected_outside, abs=1e-12)
    # Posterior replicates depend on the window, so tail areas vary less than uniform ones (Meng, 1994).
    areas = Check(posterior.real, posterior.replicated[:samples], "").tail_areas
    assert areas.mean() == pytest.approx(0.5, abs=4 * 0.3 / math.sqrt(1500))
    assert areas.var() < (1 + 2 / samples) / 12 * (1 + 4 * math.sqrt(0.8 / 1500))


# Latent traversals


def test_x_moves_linearly_with_the_coordinates_that_it_reads_only():
    model = linear_gaussian_surrogate(STATIC, "q(w | x_{1:T})", {"w": 3, "x": 2}, T)
    weights = model.generator["x"].network.weights["w"]
    with torch.no_grad():
        weights[..., 1] = 0
    x = model.sample(2, T)["x"]
    result = traverse(model, x, "w", span=(-2, 2), steps=5)
    assert result.decoded.shape == (3, 5, 2, T, 2)
    # The rounding of a matrix product may depend on the row and on the number of rows.
    torch.testing.assert_close(result.decoded[1], result.decoded[1, :1].expand(5, -1, -1, -1), rtol=0, atol=1e-12)
    assert result.effect[1] == pytest.approx(0, abs=1e-12)
    step = result.decoded.diff(dim=1)
    slope = result.scale[:, None, None] * weights.detach()[:, 0].permute(2, 0, 1)  # (coordinate, T, D)
    torch.testing.assert_close(step, slope[:, None, None].expand_as(step))
    assert result.scale == pytest.approx(1, abs=0.2)  # the prior is N(0, I)
    selected = traverse(model, x, "w", coordinates=[2], span=(-2, 2), steps=5)
    torch.testing.assert_close(selected.decoded[0], result.decoded[2], rtol=0, atol=1e-12)
    in_deviations = traverse(model, model.sample(3, T)["x"], "w", unit="posterior", draws=4000).scale
    scale = model.encoder["w"].head.log_scale.exp().detach().flatten()
    torch.testing.assert_close(in_deviations, scale, rtol=0.05, atol=0)


# On motion, and from the command line


@pytest.mark.parametrize("name", ["hit-dvae", "kvae", "dsae", "equations"])  # with static latents, others, any
def test_methods_can_be_criticised(name):
    model = dvae.method(name).build({"x": 9})
    x = torch.randn(3, 6, 9)
    ranks = run(model, 3, length=6, draws=2, steps=[1, 6]).ranks
    times = {latent: 2 if model.generative.local(latent) else 1 for latent in model.latents}
    assert ranks.shape[1] == 2 + sum(model.sizes[latent] * count for latent, count in times.items())
    checks = predictive_checks(model, ArrayWindows(x, 2), samples=19, progress=False)
    assert len(checks.checks) == 2 * len(STATISTICS)
    for latent in model.latents:
        assert traverse(model, x, latent, [0], steps=3, draws=2).decoded.shape == (1, 3, 3, 6, 9)


def test_checks_and_traversals_of_motion_are_printed_drawn_and_stored(people):
    clips = motion.read_motion(people)
    windows = motion.windows(clips, motion.PROTOCOLS["simulated"], "test")
    equations = "p(w) p(z_t | z_{t-1}) p(x_t | z_t, w)", "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{1:T})"
    model = DynamicalVAE(*equations, {"w": 2, "z": 2, "x": windows.size})
    statistics = motion.statistics(windows)
    checks = predictive_checks({"one": model, "two": model}, windows, statistics, samples=19, progress=False)
    assert not np.isnan([check.wasserstein for check in checks.checks.values()]).any()
    assert checks["one", "forecast", "bone stretch"].real.max() < 0.1  # real bones are rigid
    text = str(checks)
    for part in ("acceleration (m/s²)", "foot height (m)", "two", "Wasserstein", "drawn emission"):
        assert part in text
    again = type(checks).from_json(checks.to_json())
    assert str(again) == str(checks)
    assert again.data["fingerprint"] == windows.fingerprint
    for damage in ({"samples": 20}, {"models": {}}):
        with pytest.raises(ValueError, match="not written by PredictiveChecks"):
            type(checks).of({**checks.document(), "attributes": checks.document()["attributes"] | damage})
    figure = checks.plot()
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["real", "one", "two"]
    figure.canvas.draw()
    result = traverse(model, {"x": windows.all()["x"][:2]}, "w", steps=3)
    figure = motion.draw_traversal(result, windows)
    labels = [axes.get_title("left").split(",")[0] for axes in figure.axes]
    assert labels == [f"w[{c}]" for c in result.effect.argsort(descending=True).tolist()]
    figure.canvas.draw()
