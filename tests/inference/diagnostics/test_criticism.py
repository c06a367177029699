"""Criticism: exact guides pass and wrong ones fail by name, exact p-values, statistics with known values."""

import itertools
import json
import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from scipy import stats

import dvae
from dvae import DynamicalVAE, Oracle, motion, twin
from dvae.cli import main
from dvae.data.sequences import ArrayWindows
from dvae.inference.diagnostics.calibration import Calibration, calibrate
from dvae.inference.diagnostics.checks import STATISTICS, Check, Statistic, predictive_checks
from dvae.inference.diagnostics.traversal import traverse
from dvae.models.method import LatentMethod
from dvae.motion import HUMAN36M, WALKER, Skeleton, rotate_about_up

T = 4
DKF = "p(z_t | z_{t-1}) p(x_t | z_t)"
STATIC = "p(w) p(x_t | w)"
CHAIN = Skeleton(("Pelvis", "Knee", "Foot"), (-1, 0, 1), up="y", fps=10.0, name="chain")


def linear(generative, inference, scale=0.9, seed=0, **sizes):
    """A twin whose guide is the best of its factorization."""
    model = twin(generative, inference, sizes, T, seed, scale=scale)
    Oracle(model, T).fit_guide()
    return model


def run(model, simulations=1000, length=T, **options):
    return calibrate(model, length, simulations, progress=False, **options)


def from_ranks(ranks, draws):
    names = tuple(f"z_{q + 1}[0]" for q in range(ranks.shape[1]))
    return Calibration(np.asarray(ranks), names, draws, T, 0, {})


def posterior_guide(model, factor=1.0, shift=0.0):
    """The exact posterior's marginals, independent of each other, widened and shifted by standard deviations."""
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


@pytest.mark.parametrize(
    "inference", ["q(z_t | z_{t-1}, x_{t:T})", "q(z_t | z_{t-1}, x_{1:T})", "q(z_t | z_{t+1}, x_{<=t})"]
)
def test_ranks_of_the_exact_guide_are_uniform(inference):
    result = run(linear(DKF, inference, z=1, x=1))
    assert result.p_value > 1e-3
    assert not any(result.readings)
    assert result.verdict.startswith("nothing speaks against")


@pytest.mark.parametrize("inference", ["q(z_t | x_{1:T})", "q(z_t | x_t)"])
def test_ranks_of_the_mean_field_guide_are_not(inference):
    result = run(linear(DKF, inference, z=1, x=1))
    assert result.p_value < 1e-6
    assert result.readings[np.argmin(result.p_values[:-2])] == "is too narrow"
    assert "is not the posterior" in result.verdict


@pytest.mark.parametrize(
    ("options", "reading"),
    [
        ({"factor": 1.6}, "is too wide"),
        ({"shift": -0.5}, "draws too low"),
        ({"factor": 0.6, "shift": 0.8}, "is too narrow, draws too high"),
    ],
)
def test_the_shape_says_what_is_wrong(options, reading):
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


@pytest.mark.parametrize(
    ("mean", "deviation", "reading"),
    [
        (1.5, 1.0, "draws too high"),
        (-1.5, 1.0, "draws too low"),
        (3.0, 1.0, "draws too high"),
        (2.0, 0.5, "is too narrow, draws too high"),
        (3.0, 0.3, "is too narrow, draws too high"),
        (1.0, 3.0, "is too wide, draws too high"),
    ],
)
@pytest.mark.parametrize("draws", [20, 99])
def test_truths_beyond_all_draws_do_not_hide_how_wide_a_biased_guide_is(mean, deviation, reading, draws):
    """The truth is N(0, 1): the guide's N(mean, deviation^2) has bias -mean / deviation and spread 1 / deviation."""
    generator, n = np.random.default_rng(0), 2000
    ranks = generator.binomial(draws, stats.norm.cdf((generator.normal(size=n) - mean) / deviation))
    result = from_ranks(ranks[:, None], draws)
    assert result.readings == (reading,)
    # the more of the truths lie in the tails, the less the rest tells
    inside = ((ranks > 0) & (ranks < draws)).sum()
    assert result.spread[0] * deviation == pytest.approx(1, abs=5 / math.sqrt(inside))
    assert result.bias[0] * deviation / -mean == pytest.approx(1, abs=5 / math.sqrt(inside))


@pytest.mark.parametrize(
    ("ranks", "reading"),
    [([0], "draws too high"), ([99], "draws too low"), ([0, 99], "is too narrow"), ([49, 50], "is too wide")],
)
def test_ranks_that_leave_bias_or_spread_open_say_nothing_of_it(ranks, reading):
    result = from_ranks(np.tile(ranks, 300)[:, None], 99)
    assert result.readings == (reading,)
    assert np.isfinite([*result.bias, *result.spread]).all()
    json.loads(result.to_json())


def test_quantities_of_all_latents_tell_a_guide_that_ignores_the_data_or_the_dependence_of_latents():
    model = linear(DKF, "q(z_t | z_{t-1}, x_{t:T})", z=1, x=1)

    def prior(batch):
        with pyro.poutine.block():
            drawn = model.model(size=len(batch["x"]), length=T)["z"]
        pyro.sample("z", dist.Delta(drawn).to_event(2))

    for guide in (prior, posterior_guide(model)):
        result = run(model, guide=guide)
        assert min(result.p_values[:-2]) > 1e-3
        assert result.p_values[-2] < 1e-4
        assert result.p_values[-1] < 1e-6


def test_p_values_are_those_of_all_outcomes_counted():
    count, draws = 5, 2
    outcomes = np.array(list(itertools.product(range(draws + 1), repeat=count))).T
    result = from_ranks(outcomes, draws)
    below = np.stack([(outcomes < k).sum(0) for k in (1, 2)])
    points = np.array([[1], [2]]) / 3
    tails = np.minimum(stats.binom.cdf(below, count, points), stats.binom.sf(below - 1, count, points)).min(0)
    expected = (tails[:, None] * (1 + 1e-9) >= tails).mean(1)
    np.testing.assert_allclose(result.p_values, expected, atol=1e-12)
    for alpha in (0.01, 0.05, 0.3):
        outside = leaves(result, alpha)
        assert outside.mean() <= alpha
        assert (outside == (expected <= alpha)).all()


def leaves(result, alpha):
    _, low, high = result.envelope(alpha)
    ecdf = result.counts.cumsum(1)[:, :-1] / len(result.ranks)
    return ((ecdf < low - 1e-12) | (ecdf > high + 1e-12)).any(1)


def test_p_values_of_uniform_ranks_are_uniform_and_the_envelope_holds_them():
    result = from_ranks(np.random.default_rng(0).integers(0, 20, (200, 2000)), 19)
    for alpha in (0.01, 0.05, 0.2, 0.5):
        share = (result.p_values <= alpha).mean()
        error = math.sqrt(alpha * (1 - alpha) / 2000)
        assert alpha - 0.02 - 4 * error < share < alpha + 4 * error  # ranks are discrete: at most alpha, and near it
        assert (leaves(result, alpha) == (result.p_values <= alpha)).all()


def test_tiny_p_values_are_bounded_by_the_sum_over_points():
    ranks = np.zeros((300, 2), int)
    ranks[:, 1] = np.random.default_rng(0).integers(0, 10, 300)
    result = from_ranks(ranks, 9)
    least = 0.1**300
    assert least <= result.p_values[0] <= 2 * 9 * least * 1.001
    assert result.p_values[1] > 1e-3
    assert result.adjusted[0] == 2 * result.p_values[0] == result.p_value
    assert result.readings == ("draws too high", "")


def test_ranks_are_counts_of_smaller_draws_and_names_say_which():
    model = twin(
        "p(w) p(z_t | z_{t-1}, w) p(x_t | z_t)", "q(w | x_{1:T}) q(z_t | x_{1:T}, w)", {"w": 2, "z": 3, "x": 1}, T
    )
    low, high = (run(model, 20, draws=7, steps=[1, 3], guide=posterior_guide(model, shift=s)) for s in (-1e4, 1e4))
    assert low.names == ("w[0]", "w[1]", *(f"z_{t}[{d}]" for t in (1, 3) for d in range(3)), "TARP", "log joint")
    assert low.ranks.shape == (20, 10)
    assert (low.ranks[:, :-2] == 7).all()
    assert (high.ranks[:, :-2] == 0).all()
    assert (high.ranks[:, -2] == 0).all()  # the truth is the nearer to any point among truths
    assert (low.ranks[:, -1] == 7).all()  # the truth is the more probable


def test_calibration_is_the_seeds_and_leaves_model_and_generator_alone():
    model = twin(DKF, "q(z_t | x_{1:T})", {"z": 1, "x": 1}, T).train()
    state = torch.get_rng_state()
    first, again, other = (run(model, 30, draws=9, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(state, torch.get_rng_state())
    assert model.training
    assert (first.ranks == again.ranks).all()
    assert (first.ranks != other.ranks).any()


def test_context_is_read_in_turn():
    model = DynamicalVAE("p(w | c) p(x_t | w, c)", "q(w | c, x_{1:T})", {"w": 1, "x": 1, "c": 2}).double()
    context = {"c": torch.randn(3, 2)}
    assert run(model, 10, draws=4, context=context).ranks.shape == (10, 3)
    with pytest.raises(ValueError, match="the model reads the context c"):
        run(model, 10)


def test_what_calibration_refuses():
    model = twin(DKF, "q(z_t | x_{1:T})", {"z": 1, "x": 1}, T)
    with pytest.raises(ValueError, match="at least 1, got 4, 0, 99"):
        run(model, 0)
    for steps in ([], [0], [2, 2], [T + 1]):
        with pytest.raises(ValueError, match=f"different numbers from 1 to {T}"):
            run(model, 5, steps=steps)
    with pytest.raises(ValueError, match="draws no z"):
        run(model, 5, guide=lambda batch: None)
    with pytest.raises(ValueError, match="alpha is a probability"):
        run(model, 5).envelope(1.0)
    with torch.no_grad():
        model.generator["z"].network.weights["z"].fill_(1e200)
    with pytest.raises(FloatingPointError, match=r"gave .*x that are not finite"):
        run(model, 5)


def test_calibration_prints_draws_and_writes():
    result = run(linear(DKF, "q(z_t | x_{1:T})", z=1, x=1), 300)
    text = str(result)
    assert "z_2[0]" in text
    assert "is too narrow" in text
    assert text.index("z_2[0]") < text.index("z_1[0]")  # worst first
    assert "and 5 more" in " ".join(map(str, result.table(worst=1).columns[0].cells))
    document = json.loads(result.to_json())
    assert document["quantities"]["z_2[0]"]["p"] == result.p_values[1]
    assert [sum(q["rank_counts"]) for q in document["quantities"].values()] == [300] * 6
    figure = result.plot(worst=3)
    assert [axes.get_title().split(",")[0] for axes in figure.axes if axes.get_title()] == [
        result.names[q] for q in np.argsort(result.p_values, kind="stable")[:3]
    ]
    assert len(result.plot().axes) == 16
    figure.canvas.draw()


# Predictive checks


@dataclass(frozen=True, eq=False)
class Motions(ArrayWindows):
    """Arrays as motions of a skeleton."""

    skeleton: Skeleton = CHAIN

    def positions(self, x):
        return x.unflatten(-1, (-1, 3))


def test_a_calibration_is_read_back_with_all_that_it_says():
    result = from_ranks(np.random.default_rng(0).binomial(9, 0.6, (40, 3)), 9)
    read = Calibration.from_json(result.to_json())
    assert read.to_json() == result.to_json()
    assert str(read) == str(result)
    document = json.loads(result.to_json())
    first = document["quantities"]["z_1[0]"]["rank_counts"]
    for damage in (
        {"simulations": 41},
        {"draws": 8},
        {"quantities": {}},
        {"quantities": {"z": {"rank_counts": [-1, *first[1:-1], first[-1] + first[0] + 1]}}},
        {"quantities": {"z": {"rank_counts": [10**15] + [0] * 9}}, "simulations": 10**15},  # memory is not asked for it
        {"quantities": {"z": {"rank_counts": [10**400] + [0] * 9}}, "simulations": 10**400},
    ):
        with pytest.raises(ValueError, match="not a calibration"):
            Calibration.from_json(json.dumps({**document, **damage}))
    for text in ("", "[]", "{}", "null"):
        with pytest.raises(ValueError, match="not a calibration"):
            Calibration.from_json(text)


def test_statistics_of_any_sequences_have_their_known_values():
    t = torch.arange(64, dtype=torch.float64)
    wave = torch.stack([2 + 3 * (2 * math.pi * t / 32).sin(), 0 * t], 1)
    found = {name: float(statistic.function(wave)) for name, statistic in STATISTICS.items()}
    assert found["mean"] == pytest.approx(1)
    assert found["scale"] == pytest.approx(math.sqrt(3**2 / 2 / 2))
    assert found["roughness"] == pytest.approx(2 * math.sin(math.pi / 32) * found["scale"], rel=0.02)
    centred = wave[:, 0].numpy() - 2
    correlation = np.correlate(centred, centred, "full")[63:] / (centred @ centred)
    assert found["correlation length"] == np.flatnonzero(correlation < math.exp(-1))[0]
    assert found["lag-1 correlation"] == pytest.approx(correlation[1] * 64 / 63)
    assert found["zeros"] == pytest.approx(0.5)
    assert (found["smallest"], found["largest"]) == (pytest.approx(-1), pytest.approx(5))
    still = torch.ones(5, 4, 2)
    assert (STATISTICS["correlation length"].function(still) == 4).all()
    assert (STATISTICS["lag-1 correlation"].function(still) == 1).all()
    assert all(statistic.function(torch.randn(2, 5, 4, 3)).shape == (2, 5) for statistic in STATISTICS.values())
    gaps = torch.tensor([0.0, torch.nan, 3.0, torch.nan, -2.0, 0.0])[:, None]
    known = [float(STATISTICS[name].function(gaps)) for name in ("zeros", "smallest", "largest")]
    assert known == [0.5, -2, 3]


def test_statistics_have_their_known_values():
    statistics = motion.statistics(Motions(torch.zeros(1, T, 9), 2))
    measure = {name: lambda p, of=statistic: of.function(p.flatten(-2)) for name, statistic in statistics.items()}
    t = torch.arange(6, dtype=torch.float64)
    still = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.6, 0.0], [0.0, 0.1, 0.0]], dtype=torch.float64).expand(6, 3, 3)
    assert [float(measure[name](still)) for name in measure] == pytest.approx([0, 0, 0.45, 0, 0])
    moving = still + t[:, None, None] * torch.tensor([0.3, 0.0, 0.4])
    assert measure["speed"](moving) == pytest.approx(0.5 * 10)
    assert measure["acceleration"](moving) == pytest.approx(0, abs=1e-9)
    falling = still - (t**2)[:, None, None] * torch.tensor([0.0, 0.05, 0.0])
    assert measure["acceleration"](falling) == pytest.approx(0.1 * 100)
    growing = torch.where(t[:, None, None] % 2 == 0, 0.9, 1.1) * still
    assert measure["bone stretch"](growing) == pytest.approx(10)
    assert measure["bone length"](growing) == pytest.approx(0.45)
    kneeling = still.clone()
    kneeling[3:, 1, 1] = 0.0  # the knee on the ground, the foot .1 above it, in half of the frames
    assert measure["foot height"](kneeling) == pytest.approx(0.05)


def test_statistics_do_not_depend_on_where_a_person_stands_nor_on_how_the_root_is_kept():
    people = motion.simulate(clips=3, frames=40)
    positions = torch.stack([torch.from_numpy(clip.positions).double() for clip in people])
    elsewhere = rotate_about_up(positions, torch.tensor(0.7, dtype=torch.float64), "y") + torch.tensor([3.0, 0.5, -2.0])
    pelvic = positions - positions[..., :1, :]
    statistics = motion.statistics(Motions(positions.flatten(-2), 2, skeleton=WALKER))
    assert list(statistics) == ["speed", "acceleration", "bone length", "bone stretch", "foot height"]
    for name, statistic in statistics.items():
        value = statistic.function(positions.flatten(-2))
        assert value.shape == (3,)
        torch.testing.assert_close(statistic.function(elsewhere.flatten(-2)), value, rtol=1e-9, atol=1e-9)
        if name not in ("speed", "acceleration"):
            torch.testing.assert_close(statistic.function(pelvic.flatten(-2)), value, rtol=1e-9, atol=1e-9)
    assert statistics["bone stretch"].function(positions.flatten(-2)).max() < 1e-3
    assert (statistics["foot height"].function(positions.flatten(-2)) < 0.3).all()


def test_feet_are_found_by_name_and_without_them_there_is_no_foot_height():
    high = torch.ones(2, HUMAN36M.joints, 3)
    high[:, [3, 6], 2] = 0.0  # both feet on the ground
    frames = high.flatten(-2)  # a view
    height = motion.statistics(Motions(frames[None], 1, skeleton=HUMAN36M))["foot height"]
    assert height.function(frames) == 0
    high[:, 6, 2] = 0.5
    assert height.function(frames) == 0.25
    nameless = Skeleton(("a", "b"), (-1, 0))
    assert "foot height" not in motion.statistics(Motions(torch.zeros(1, T, 6), 2, skeleton=nameless))


def model_of_motion(**options):
    """A model whose forecasts are exact whatever its guide: only x_{t-1} tells of the future. And its windows."""
    model = twin("p(z_t) p(x_t | x_{t-1}, z_t)", "q(z_t | x_t, x_{t-1})", {"z": 1, "x": 9}, T, **options)
    Oracle(model, T).fit_guide()
    return model


@pytest.fixture(scope="module")
def true_checks():
    """Of windows that the model drew itself."""
    model = model_of_motion()
    with torch.random.fork_rng():
        torch.manual_seed(0)
        windows = Motions(model.sample(1500, T)["x"], observed=2)
    options = {"samples": 50, "batch_size": 500, "seed": 1, "progress": False}
    statistics = motion.statistics(windows)
    return [predictive_checks(model, windows, statistics, draw_emission=drawn, **options) for drawn in (True, False)]


@pytest.mark.parametrize(
    ("name", "samples"),
    [("speed", 5), ("acceleration", 19), ("bone length", 20), ("bone stretch", 50), ("foot height", 19)],
)
def test_tail_areas_of_the_true_model_are_uniform(true_checks, name, samples):
    forecast, posterior = (true_checks[0]["model", program, name] for program in ("forecast", "posterior"))
    assert forecast.replicated.shape == (50, 1500)
    real, replicated = forecast.real, forecast.replicated[:samples]
    ties = (replicated == real).sum(0)  # a foot that is always the lowest joint has height 0
    ranks = (replicated < real).sum(0) + np.random.default_rng(0).integers(0, ties + 1)
    assert stats.chisquare(np.bincount(ranks, minlength=samples + 1)).pvalue > 1e-3
    # A real window is any one of 1 + S that are alike, so that the share to expect is known with ties, too.
    alike = np.concatenate([real[None], replicated])
    turns = [Check(alike[s], np.delete(alike, s, 0), "") for s in range(samples + 1)]
    expected = np.mean([check.outside for check in turns])
    assert turns[0].outside == pytest.approx(expected, abs=4 * math.sqrt(expected * (1 - expected) / 1500))
    if name == "foot height":
        assert expected < turns[0].expected_outside
    else:
        assert not ties.any()
        assert expected == pytest.approx(turns[0].expected_outside, abs=1e-12)
    # Replicates of a posterior have seen the window: tail areas vary less than uniform ones (Meng, 1994).
    areas = Check(posterior.real, posterior.replicated[:samples], "").tail_areas
    assert areas.mean() == pytest.approx(0.5, abs=4 * 0.3 / math.sqrt(1500))
    assert areas.var() < (1 + 2 / samples) / 12 * (1 + 4 * math.sqrt(0.8 / 1500))


def test_means_lack_the_noise_of_the_emission_and_the_caption_says_what_to_expect(true_checks):
    drawn, means = true_checks
    assert means["model", "posterior", "speed"].tail_areas.mean() < 0.1
    assert (drawn.emission, means.emission) == ("drawn", "mean")
    assert "forecasts of a true model have ½ and, with 50 replicates, 11.8%" in str(drawn)  # 2 ceil(2.5) / 51
    assert "even a true model's need not have ½ and 11.8%" in str(means)


@pytest.mark.parametrize("samples", [1, 10, 19, 20, 21, 39, 40, 100, 140])
def test_the_share_outside_is_that_of_uniform_ranks(samples):
    """A window for every rank among its S replicates."""
    check = Check(np.arange(samples + 1) - 0.5, np.arange(samples)[:, None].repeat(samples + 1, 1), "")
    areas = [Fraction(above, samples) for above in range(samples, -1, -1)]
    outside = sum(area < Fraction(1, 20) or area > Fraction(19, 20) for area in areas)
    assert check.outside == check.expected_outside == outside / (samples + 1)


def test_a_window_is_checked_against_its_own_forecasts():
    model = model_of_motion()
    x = model.sample(6, T)["x"]
    windows = Motions(x, observed=2)
    last = {
        "last": Statistic(lambda x: x[..., -1, 0], "m"),
        "frames": Statistic(lambda x: x[..., 0, 0] * 0 + x.shape[-2]),
    }
    options = {"samples": 19, "batch_size": 6, "seed": 3, "progress": False}
    checks = predictive_checks({"a": model}, windows, last, **options)
    with torch.random.fork_rng():
        torch.manual_seed(3)
        future = model.forecast(x[:, :2], 2, 19, draw_emission=True)["x"]
    found = checks["a", "forecast", "last"]
    np.testing.assert_allclose(found.replicated, future[:, :, -1, 0].numpy())
    np.testing.assert_allclose(found.real, x[:, -1, 0].numpy())
    assert (checks["a", "forecast", "frames"].real == 4).all()  # the last two observed frames are joined on
    again = predictive_checks({"b": model, "a": model}, windows, last, **options)
    assert (again["a", "posterior", "last"].replicated == checks["a", "posterior", "last"].replicated).all()
    with pytest.raises(KeyError, match="no check"):
        checks["c", "forecast", "last"]


def test_posterior_replicates_of_driven_models_read_their_own_past():
    model = twin("p(z_t | x_{t-1}, z_{t-1}) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-1}, x_{1:T})", {"z": 1, "x": 9}, T)
    with torch.no_grad():
        for conditional in model.encoder.values():
            conditional.law.log_scale.fill_(-40.0)  # latents are known: what is left is the mean program
    x = model.sample(3, T)["x"]
    z = model.guide({"x": x})["z"]
    statistic = {"x": Statistic(lambda x: x[..., -1, 8])}
    checks = predictive_checks(model, Motions(x, 2), statistic, draw_emission=False, progress=False)
    network, value = model.generator["x"].network, torch.zeros(3, 9).double()
    for t in range(T):
        value = (
            network.bias[t]
            + z[:, t] @ network.weights["z"][t, t].t()
            + (value @ network.weights["x"][t, t - 1].t() if t else 0)
        )
    np.testing.assert_allclose(checks["model", "posterior", "x"].replicated[0], value[:, 8].detach().numpy(), atol=1e-9)


def test_tail_area_and_distance_have_their_known_values():
    check = Check(np.array([0.0, 1.0, 5.0]), np.array([[0.0, 2.0, 0.0], [1.0, 2.0, 0.0]]), "m")
    assert check.tail_areas.tolist() == [0.75, 1.0, 0.0]
    assert check.outside == pytest.approx(2 / 3)
    assert Check(check.real, check.real[None] + 0.5, "m").wasserstein == pytest.approx(0.5)


def test_what_predictive_checks_refuse():
    model, windows = model_of_motion(), Motions(torch.randn(4, T, 9).double(), observed=2)

    def run(statistics=STATISTICS, **options):
        return predictive_checks(model, windows, statistics, progress=False, **options)

    for options in ({"samples": 18}, {"batch_size": 0}):
        with pytest.raises(ValueError, match=r"at least 19 samples.* batch_size of at least 1"):
            run(**options)
    with pytest.raises(ValueError, match="no statistic"):
        run({})
    with pytest.raises(ValueError, match=r"statistic all maps .* one number for each sequence"):
        run({"all": Statistic(lambda x: x.mean())})
    with pytest.raises(ValueError, match="gap is not finite on real windows of 4 frames"):
        run({"gap": Statistic(lambda x: x[..., 9:, 0].mean(-1))})
    with torch.no_grad():
        model.generator["x"].network.bias[-1] = math.inf
    with pytest.raises(FloatingPointError, match=r"mean is not finite on replicates of model \(forecast\)"):
        run()


# Latent traversals


def test_a_coordinate_that_x_does_not_read_moves_nothing_and_others_move_it_linearly():
    model = twin(STATIC, "q(w | x_{1:T})", {"w": 3, "x": 2}, T)
    weights = model.generator["x"].network.weights["w"]
    with torch.no_grad():
        weights[..., 1] = 0
    x = model.sample(2, T)["x"]
    found = traverse(model, x, "w", span=(-2, 2), steps=5)
    assert found.frames.shape == (3, 5, 2, T, 2)
    # Rows of one product, which may round otherwise at another place or in another number.
    torch.testing.assert_close(found.frames[1], found.frames[1, :1].expand(5, -1, -1, -1), rtol=0, atol=1e-12)
    assert found.effect[1] == pytest.approx(0, abs=1e-12)
    step = found.frames.diff(dim=1)
    slope = found.scale[:, None, None] * weights.detach()[:, 0].permute(2, 0, 1)  # (coordinate, T, D)
    torch.testing.assert_close(step, slope[:, None, None].expand_as(step))
    assert found.scale == pytest.approx(1, abs=0.2)  # the prior is N(0, I)
    chosen = traverse(model, x, "w", coordinates=[2], span=(-2, 2), steps=5)
    torch.testing.assert_close(chosen.frames[0], found.frames[2], rtol=0, atol=1e-12)


def test_a_local_latent_moves_at_all_steps_and_the_rest_stays():
    model = twin(
        "p(w) p(z_t | z_{t-1}, w) p(x_t | x_{t-1}, z_t, w)",
        "q(w | x_{1:T}) q(z_t | x_{1:T}, w)",
        {"w": 1, "z": 2, "x": 1},
        T,
    )
    found = traverse(model, model.sample(1, T)["x"], "z", [1], (0, 1), 2)
    network, change, expected = model.generator["x"].network, torch.zeros(1, dtype=torch.float64), []
    for t in range(T):
        change = found.scale * network.weights["z"][t, t, :, 1] + (network.weights["x"][t, t - 1] @ change if t else 0)
        expected.append(change)
    torch.testing.assert_close(found.frames[0, 1, 0] - found.frames[0, 0, 0], torch.stack(expected).detach())


def test_a_latent_that_acts_through_others_needs_them_free_and_they_keep_their_noise():
    model = twin("p(w) p(z_t | w) p(x_t | z_t)", "q(w | x_{1:T}) q(z_t | x_{1:T}, w)", {"w": 1, "z": 1, "x": 1}, T)
    x = model.sample(2, T)["x"]
    with pytest.raises(ValueError, match=r"x does not read w.*free=\('z',\)"):
        traverse(model, x, "w")
    found = traverse(model, x, "w", steps=4, span=(0, 3), free=["z"])
    to_z, to_x = (model.generator[name].network.weight(parent, T) for name, parent in (("z", "w"), ("x", "z")))
    slope = found.scale * to_z[:, 0, 0, 0] * torch.stack([to_x[t, t, 0, 0] for t in range(T)])
    step = found.frames[0].diff(dim=0)[..., 0]
    torch.testing.assert_close(step, slope.detach().expand_as(step))


def test_the_posteriors_unit_is_the_guides_standard_deviation():
    model = twin(STATIC, "q(w | x_{1:T})", {"w": 2, "x": 1}, T)
    found = traverse(model, model.sample(3, T)["x"], "w", unit="posterior", draws=4000)
    torch.testing.assert_close(
        found.scale, model.encoder["w"].law.log_scale.exp().detach().flatten(), rtol=0.05, atol=0
    )


def test_traversals_are_the_seeds_and_leave_model_and_generator_alone():
    model = twin(STATIC, "q(w | x_{1:T})", {"w": 2, "x": 1}, T).train()
    x = model.sample(2, T)["x"]
    state = torch.get_rng_state()
    first, again, other = (traverse(model, x, "w", seed=seed) for seed in (1, 1, 2))
    assert torch.equal(state, torch.get_rng_state())
    assert model.training
    assert torch.equal(first.frames, again.frames)
    assert not torch.equal(first.frames, other.frames)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"latent": "v"}, "the latents are w; expected one to move"),
        ({"free": ["w"]}, "others to be free"),
        ({"coordinates": [2]}, "go from 0 to 1"),
        ({"coordinates": []}, "go from 0 to 1"),
        ({"steps": 1}, "steps is at least 2"),
        ({"steps": 6}, "6 offsets from -3 to 3 leave out 0, the latent as inferred"),
        ({"steps": 3, "span": (-1.0, 2.0)}, "take an odd number of steps, and a span about 0"),
        ({"unit": "metre"}, "'prior' or 'posterior'"),
    ],
)
def test_what_traversals_refuse(options, message):
    model = twin(STATIC, "q(w | x_{1:T})", {"w": 2, "x": 1}, T)
    with pytest.raises(ValueError, match=message):
        traverse(model, torch.zeros(1, T, 1), **{"latent": "w"} | options)


# On motion, and from the command line


@pytest.mark.parametrize(
    "name",
    [n for n, m in dvae.methods().items() if issubclass(m, LatentMethod) and n != "equations"],
)
def test_every_method_can_be_criticised(name):
    model = dvae.method(name).build({"x": 9})
    x = torch.randn(3, 6, 9)
    ranks = run(model, 3, length=6, draws=2, steps=[1, 6]).ranks
    assert ranks.shape[1] == 2 + sum(
        size * (2 if model.generative.local(latent) else 1)
        for latent, size in model.sizes.items()
        if latent in model.latents
    )
    checks = predictive_checks(model, ArrayWindows(x, 2), samples=19, progress=False)
    assert len(checks.checks) == 2 * len(STATISTICS)
    for latent in model.latents:
        assert traverse(model, x, latent, [0], steps=3, draws=2).frames.shape == (1, 3, 3, 6, 9)


def test_checks_and_traversals_of_motion_print_draw_and_write(people):
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
    document = json.loads(checks.to_json())
    assert document["data"]["fingerprint"] == windows.fingerprint
    assert set(document["checks"]["two"]["posterior"]) == set(statistics)
    figure = checks.plot()
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["real", "one", "two"]
    figure.canvas.draw()
    found = traverse(model, {"x": windows.all()["x"][:2]}, "w", steps=3)
    figure = motion.draw_traversal(found, windows)
    labels = [axes.get_title("left").split(",")[0] for axes in figure.axes]
    assert labels == [f"w[{c}]" for c in found.effect.argsort(descending=True).tolist()]
    figure.canvas.draw()


def test_names_are_no_markup():
    model = model_of_motion()
    windows = Motions(model.sample(2, T)["x"], observed=2)
    statistics = {"reach [bold]": Statistic(lambda x: x[..., 0, 0], "[m]")}
    text = str(predictive_checks({"q(z) [full]": model, "[/x]": model}, windows, statistics, progress=False))
    for name in ("q(z) [full]", "[/x]", "reach [bold] ([m])"):
        assert name in text


def test_the_command_criticises_a_run(run, tmp_path, capsys, monkeypatch):
    options = ["--simulations", "20", "--draws", "9", "--ranked-steps", "2", "--samples", "19"]
    assert main(["criticise", str(run), *options, "--figure", str(tmp_path / "figure.png")]) == 0
    printed = capsys.readouterr().out
    assert "z_75[1]" in printed
    assert "bone stretch" in printed
    document = json.loads((run / "criticism.json").read_text())
    assert document["calibration"]["simulations"] == 20
    assert list(document["predictive"]["checks"]) == ["vae"]
    for part in ("calibration", "checks"):
        assert (tmp_path / f"figure-{part}.png").read_bytes().startswith(b"\x89PNG")
    assert document["predictive"]["emission"] == "drawn"

    def fail(*_, **options):
        raise FloatingPointError(f"draw_emission={options['draw_emission']}")

    monkeypatch.setattr("dvae.cli.judging.predictive_checks", fail)
    assert main(["criticise", str(run), *options, "--no-draw-emission"]) == 1
    assert "draw_emission=False" in capsys.readouterr().err
    assert list(json.loads((run / "criticism.json").read_text())) == ["calibration"]  # and not the checks of old
    assert main(["criticise", str(run), "--samples", "18"]) == 2
    assert "--samples is 18" in capsys.readouterr().err
    assert main(["criticise", str(run), "--draws", "0"]) == 2
    assert "--draws is 0" in capsys.readouterr().err
