"""Evaluation: all rows on the same windows, honest standard errors, records that say what was measured."""

import json
import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from dvae import motion
from dvae.data.sequences import ArrayWindows
from dvae.inference.bounds.elbo import SequenceELBO
from dvae.inference.evaluation import metrics
from dvae.inference.evaluation.evaluate import evaluate
from dvae.inference.evaluation.evaluation import Evaluation, Row, Score
from dvae.inference.evaluation.references import last_value, nearest_neighbours
from dvae.inference.evaluation.scores import proper
from dvae.motion.scoring import metrics as errors
from dvae.motion.scoring.metrics import multimodal_truths
from dvae.program.model import DynamicalVAE

OBSERVED, FRAMES, SIZE = 4, 9, 3


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def array_windows(count=12, clips=None, **options):
    clips = [f"clip_{i // 3}" for i in range(count)] if clips is None else clips
    return ArrayWindows(draw(count, FRAMES, SIZE).cumsum(1), OBSERVED, clips=clips, **options)


@pytest.fixture(scope="module")
def model():
    with torch.random.fork_rng():
        torch.manual_seed(1)
        return DynamicalVAE(
            "p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-1}, x_{1:T})", {"z": 2, "x": SIZE}
        ).double()


class Forecaster(nn.Module):
    """A model that forecasts what it is told, and has no uncertainty to speak of."""

    likelihood = True
    generative = SimpleNamespace(text="p(x_t)")
    inference = SimpleNamespace(text="q(z)")

    def __init__(self, forecast):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1, dtype=torch.float64))
        self.told = forecast

    def forecast(self, batch, horizon, samples, *, draw_emission=False):
        return {"x": self.told(batch["x"], horizon, samples)}


def run(model, windows, **options):
    return evaluate(model, windows, **({"scores": motion.displacements, "samples": 5, "progress": False} | options))


def free_running(forecaster, windows, **options):
    """Scores of a forecaster that has no bound."""

    def no_bound(self, model, batch):
        return SimpleNamespace(per_frame=torch.zeros(len(batch["x"])), kl={}, frames=FRAMES)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SequenceELBO, "terms", no_bound)
        return run(forecaster, windows, **options)["model"]


# Reference rows


def test_zero_velocity_repeats_the_last_pose():
    observed = draw(2, 4, 3)
    forecast = last_value(observed, 5)
    assert forecast.shape == (1, 2, 5, 3)
    assert (forecast == observed[:, -1:]).all()


def test_neighbours_of_training_windows_are_themselves_first_and_then_farther():
    training = draw(30, 9, 3)
    futures = nearest_neighbours(training[:7, :4], training, samples=30)
    assert futures.shape == (30, 7, 5, 3)
    assert torch.equal(futures[0], training[:7, 4:])
    last = {tuple(future.flatten().tolist()): pose for future, pose in zip(training[:, 4:], training[:, 3])}
    distances = torch.stack(
        [(last[tuple(future.flatten().tolist())] - training[2, 3]).norm() for future in futures[:, 2]]
    )
    assert (distances.diff() >= 0).all()


def test_neighbours_are_the_same_wherever_the_origin_is():
    """In steps that float32 holds at a thousand metres from the origin."""
    training = (64 * draw(60, 9, 3)).round().float() / 64
    here, there = (nearest_neighbours(x[:40, :4], x, samples=1) for x in (training, training + 1024))
    assert torch.equal(there, here + 1024)


@pytest.mark.parametrize(
    ("training", "message"),
    [
        (draw(9, 9, 2), r"must be \(N, T, 3\)"),
        (draw(9, 4, 3), "above the 4 observed"),
        (draw(4, 9, 3), "5 neighbours were asked of 4"),
    ],
)
def test_training_windows_that_do_not_fit_are_refused(training, message):
    with pytest.raises(ValueError, match=message):
        nearest_neighbours(draw(2, 4, 3), training, samples=5)


# One evaluation


def test_scores_are_the_metrics_of_the_forecasts_and_the_bound_per_frame(model):
    windows = array_windows()
    result = run({"dkf": model}, windows, batch_size=12, training_windows=array_windows(20), seed=3)
    assert list(result.rows) == ["last value", "nearest neighbours", "dkf"]
    assert [row.samples for row in result.rows.values()] == [1, 5, 5]
    x = windows.all()["x"]
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(3)
        forecasts = model.forecast({"x": x[:, :OBSERVED]}, FRAMES - OBSERVED, 5, draw_emission=False)["x"].movedim(0, 1)
        torch.manual_seed(3)
        bound = SequenceELBO().terms(model, {"x": x}).bound / FRAMES
    ade = errors.average_displacement_error(forecasts, x[:, OBSERVED:])
    assert result["dkf"]["ADE"].mean == pytest.approx(ade.mean().item())
    assert result["dkf"]["ELBO"].mean == pytest.approx(bound.mean().item())
    assert {"KL z", "ELBO"} <= result["dkf"].keys()
    assert not {"KL z", "ELBO"} & result["last value"].keys()


def test_scores_depend_on_the_seed_and_not_on_the_company(model):
    windows = array_windows()
    alone, again = run({"a": model}, windows, references=False), run({"b": model, "a": model}, windows)
    assert alone.rows["a"] == again.rows["a"] == again.rows["b"]
    assert run({"a": model}, windows, seed=1).rows["a"] != alone.rows["a"]


def test_evaluation_leaves_mode_and_random_state_alone(model):
    model.train()
    state = torch.get_rng_state()
    run(model, array_windows())
    assert model.training
    assert torch.equal(torch.get_rng_state(), state)


def test_forecasts_are_means_by_default_for_scores_of_motion_and_else_draws(model):
    mean, drawn = (run(model, array_windows(), draw_emission=value) for value in (False, True))
    assert (mean.emission, drawn.emission) == ("mean", "drawn")
    assert drawn["model"]["APD"].mean > mean["model"]["APD"].mean
    assert run(model, array_windows()).rows == mean.rows
    draws, of_means = (run(model, array_windows(), scores=proper, draw_emission=how) for how in (None, False))
    assert draws.emission == "drawn"
    assert draws["model"]["CRPS"].mean != of_means["model"]["CRPS"].mean
    assert ["means" in " ".join(each.notes) for each in (mean, drawn, draws, of_means)] == [False, False, False, True]


def test_importance_bound_is_above_the_elbo_and_its_diagnosis_beside_it(model):
    row = run(model, array_windows(), bound_particles=50)["model"]
    assert row["importance bound"].mean > row["ELBO"].mean
    assert math.isfinite(row["k-hat"].mean)


def test_a_perfect_forecast_has_no_error_and_a_lone_window_keeps_its_own_truth():
    windows = array_windows()
    truth = iter(windows.all()["x"][:, OBSERVED:].split(5))
    perfect = Forecaster(lambda x, horizon, samples: next(truth).expand(samples, -1, -1, -1))
    alone = partial(motion.displacements, threshold=1e-9)
    scores = free_running(perfect, windows, batch_size=5, scores=alone)
    for name in ("ADE", "FDE", "MMADE", "MMFDE", "ADEm", "MMFDEm", "energy score", "variogram score", "APD"):
        assert scores[name].mean == pytest.approx(0, abs=1e-6), name


def test_multimodal_errors_average_over_every_window_in_the_same_pose():
    x = draw(6, FRAMES, SIZE)
    x[:3, OBSERVED - 1] = x[0, OBSERVED - 1]
    windows = ArrayWindows(x, OBSERVED)
    still = run({}, windows, scores=partial(motion.displacements, threshold=1e-6))["last value"]
    forecast = last_value(x[:, :OBSERVED], FRAMES - OBSERVED)[0]
    errors = (forecast[:, None] - x[None, :, OBSERVED:]).norm(dim=-1).mean(-1)
    expected = (3 * errors[:3, :3].mean() + errors.diagonal()[3:].sum()) / 6
    assert still["MMADE"].mean == pytest.approx(expected.item(), abs=1e-6)


# Multimodal ground truth


def in_poses(poses, **options):
    """Windows of two frames whose last observed poses these are."""
    return ArrayWindows(torch.stack([poses, poses], 1), 1, **options)


def test_like_windows_are_strictly_below_the_threshold_and_include_the_window_itself():
    windows = in_poses(torch.tensor([[0.0, 0.0], [0.5, 0.0], [0.25, 0.0], [9.0, 9.0]]))
    assert [found.tolist() for found in multimodal_truths(windows)] == [[0, 2], [1, 2], [0, 1, 2], [3]]
    assert [found.tolist() for found in multimodal_truths(windows, itself=False)] == [[2], [2], [0, 1], []]
    assert [found.tolist() for found in multimodal_truths(windows, 0.6)] == [[0, 1, 2], [0, 1, 2], [0, 1, 2], [3]]


@settings(max_examples=10)
@given(st.integers(1, 700), st.integers(0, 99), st.booleans())
def test_likeness_of_windows_is_symmetric_in_every_block(count, seed, itself):
    found = multimodal_truths(in_poses(draw(count, 2, seed=seed)), 0.4, itself)
    pairs = {(i, j) for i, others in enumerate(found) for j in others.tolist()}
    assert len(found) == count
    assert all((j, i) in pairs for i, j in pairs)
    assert sum(i == j for i, j in pairs) == (count if itself else 0)


def test_multimodal_truths_are_those_of_all_pairs():
    windows = in_poses(draw(40, 3))
    poses = windows.all()["x"][:, 0]
    expected = [[j for j in range(40) if (poses[i] - poses[j]).norm() < 0.9] for i in range(40)]
    assert [found.tolist() for found in multimodal_truths(windows, 0.9)] == expected


def test_a_threshold_is_a_distance():
    with pytest.raises(ValueError, match="must be positive, but is 0"):
        multimodal_truths(array_windows(), 0)


# Standard errors


def evaluation(values, clips):
    """Zero velocity on windows whose final error is `values`, of the given clips."""
    x = torch.zeros(len(values), 2, 1, dtype=torch.float64)
    x[:, 1, 0] = torch.as_tensor(values)
    return run({}, ArrayWindows(x, 1, clips=clips))


def test_independent_windows_have_the_standard_error_of_a_mean():
    values = draw(30).abs()
    score = evaluation(values, None)["last value"]["FDE"]
    assert score.mean == pytest.approx(values.mean().item())
    assert score.standard_error == pytest.approx((values.std() / math.sqrt(30)).item())


def test_copies_of_windows_in_a_clip_add_no_certainty():
    values = draw(10).abs()
    once = evaluation(values, [str(i) for i in range(10)])["last value"]["FDE"]
    thrice = evaluation(values.repeat(3), [str(i) for i in range(10)] * 3)["last value"]["FDE"]
    assert thrice.mean == pytest.approx(once.mean)
    assert thrice.standard_error == pytest.approx(once.standard_error)


def test_the_mean_is_over_windows_where_clips_differ_in_number():
    score = evaluation([1.0, 1.0, 1.0, 5.0], ["a", "a", "a", "b"])["last value"]["FDE"]
    assert score.mean == pytest.approx(2)


def test_clustered_error_is_the_spread_of_the_mean_where_windows_of_a_clip_agree():
    # 40 clips of 1 to 9 windows that share its value: repetitions tell the error of the mean.
    random = np.random.default_rng(0)
    clips = {str(clip): int(count) for clip, count in enumerate(random.integers(1, 10, 40))}
    record = evaluation([1.0], None)
    scores = [
        replace(record, clips=clips, rows={"a": Row(1, {"FDE": tuple(values)})})["a"]["FDE"]
        for values in 1 + random.random((2000, 40))
    ]
    spread = np.std([score.mean for score in scores])
    assert np.mean([score.standard_error for score in scores]) == pytest.approx(spread, rel=0.1)


def test_one_clip_has_no_standard_error():
    assert math.isnan(evaluation([1.0, 2.0], ["a", "a"])["last value"]["FDE"].standard_error)


def test_differences_are_paired(model):
    result = run({"a": model, "b": model}, array_windows())
    assert result.difference("a", "b", "ADE") == Score(0, 0)
    paired = result.difference("a", "last value", "ADE")
    assert paired.mean == pytest.approx(result["a"]["ADE"].mean - result["last value"]["ADE"].mean)
    with pytest.raises(KeyError, match="'last value' has no score 'ELBO'"):
        result.difference("a", "last value", "ELBO")
    with pytest.raises(KeyError, match=r"no method 'c' .* it has last value, a, b"):
        result["c"]


def test_the_error_of_a_ratio_is_its_spread_over_other_clips(model):
    random = np.random.default_rng(0)
    clips = {str(clip): int(count) for clip, count in enumerate(random.integers(1, 5, 60))}
    record = replace(evaluation([1.0], None), clips=clips)

    def ratio():
        under = 1 + random.random(60)
        over = 3 * under * (1 + 0.5 * random.random(60))
        rows = {"a": Row(1, {"FDE": tuple(over)}), "b": Row(1, {"FDE": tuple(under)})}
        weights = np.array(list(clips.values()))
        found = replace(record, rows=rows).ratio("a", "b", "FDE")
        assert found.mean == pytest.approx((over * weights).sum() / (under * weights).sum())
        return found

    found = [ratio() for _ in range(1000)]
    spread = np.std([each.mean for each in found])
    assert np.mean([each.standard_error for each in found]) == pytest.approx(spread, rel=0.1)
    rows = {"a": Row(1, {"FDE": (2.0,) * 60}), "b": Row(1, {"FDE": (0.0,) * 60})}
    assert replace(record, rows=rows).ratio("a", "a", "FDE") == Score(1, 0)
    with pytest.raises(ValueError, match="the mean FDE of b is 0"):
        replace(record, rows=rows).ratio("a", "b", "FDE")


# Records


def test_the_record_says_what_was_measured_and_comes_back_from_json(model, tmp_path):
    windows = array_windows()
    result = run({"dkf": model}, windows, configs={"dkf": {"width": 8}}, bound_particles=3, seed=5)
    result.save(tmp_path / "evaluation.json")
    assert Evaluation.load(tmp_path / "evaluation.json").to_json() == result.to_json()
    document = json.loads(result.to_json())
    assert document["data"] == {
        "fingerprint": windows.fingerprint,
        "windows": 12,
        "frames": FRAMES,
        "coordinates": SIZE,
    }
    assert (document["samples"], document["seed"], document["bound_particles"]) == (5, 5, 3)
    assert document["protocol"] == {"observed": OBSERVED}
    alone = sum(len(found) == 1 for found in multimodal_truths(windows))
    assert document["basis"] == {"multimodal": {"threshold": 0.5, "itself": True, "alone": alone}}
    assert f"{alone} of 12 have no other" in str(result)
    row = document["rows"]["dkf"]
    assert row["config"] == {"width": 8}
    assert row["equations"]["generative"] == model.generative.text
    assert row["scores"]["ADE"]["program"] == "free-running"
    assert row["scores"]["ELBO"]["program"] == "teacher-forced"
    assert row["scores"]["ELBO"]["unit"] == "nats/frame"
    assert row["scores"]["k-hat"]["mean"] is None  # three particles have no tail


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"rows": {"a": {}}}', '{"rows": {}, "unknown": 1}'])
def test_other_documents_are_not_evaluations(text):
    with pytest.raises(ValueError, match="not an evaluation"):
        Evaluation.from_json(text)


def test_the_fingerprint_follows_the_data():
    x = draw(2, 5, 3)
    assert ArrayWindows(x, 2).fingerprint == ArrayWindows(x.numpy(), 2).fingerprint
    assert ArrayWindows(x, 2).fingerprint != ArrayWindows(x + 1e-9, 2).fingerprint
    assert ArrayWindows(x, 2).fingerprint != ArrayWindows(x.reshape(2, 3, 5), 2).fingerprint


def test_table_and_plot_show_every_method_and_metric(model):
    result = run({"dkf": model}, array_windows())
    text = str(result)
    for part in (
        "last value",
        "dkf",
        "K = 5",
        "K = 1",
        "teacher-forced",
        "KL z",
        "±",
        "12 windows of 4 clips",
    ):
        assert part in text
    assert str(result["dkf"]["ADE"]) in text
    panels = [axes.get_title() for axes in result.plot().axes if axes.axison]
    arrows = {"lower": " ↓", "higher": " ↑", "": ""}
    better = [arrows[metric.better] for metric in result.metrics.values()]
    assert [title.split(" (")[0] for title in panels] == [n + b for n, b in zip(result.metrics, better, strict=True)]
    assert all(title.split(" (")[0] in text for title in panels)
    assert len([axes for axes in result.plot(["ADE", "FDE"]).axes if axes.axison]) == 2


@pytest.mark.parametrize(
    ("score", "text"),
    [
        (Score(0.49331, 0.0192), "0.493 ± 0.019"),
        (Score(0.00542, 0.00042), "0.0054 ± 0.0004"),
        (Score(0.0, 0.0), "0.000"),
        (Score(1.25, math.nan), "1.250"),
        (Score(math.nan, math.nan), "–"),
        (Score(999.12345, 9.98765), "999.123 ± 9.988"),
        (Score(2181.7243, 411.0123), "2181.7 ± 411.0"),
        (Score(-12345.678, math.nan), "-12345.7"),
        (Score(1234567.891, 12345.678), "1234568 ± 12346"),
    ],
)
def test_scores_print_as_in_the_papers(score, text):
    assert str(score) == text


# Refusals


def nan_at_the_second_window(x, horizon, samples):
    forecast = last_value(x, horizon).repeat(samples, 1, 1, 1)
    forecast[0, 1, 2, 0] = math.nan
    return forecast


def test_forecasts_that_are_not_finite_are_an_error_naming_method_and_window():
    windows = array_windows(clips=[f"clip_{i}" for i in range(12)])
    with pytest.raises(FloatingPointError, match=r"forecast of wild is not finite .* frame 0 of clip 'clip_1'"):
        run({"wild": Forecaster(nan_at_the_second_window)}, windows)


def test_forecasts_of_another_shape_are_an_error_naming_both():
    short = Forecaster(lambda x, horizon, samples: last_value(x, horizon - 1).expand(samples, -1, -1, -1))
    with pytest.raises(ValueError, match=r"forecasts of model must be .* \(5, 12, 5, 3\), not \(5, 12, 4, 3\)"):
        run(short, array_windows())


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: run({}, array_windows(), samples=0), "samples is 0; it must be at least 1"),
        (
            lambda: run({"last value": Forecaster(None)}, array_windows()),
            "name of a reference row: last value",
        ),
        (lambda: ArrayWindows(draw(3, 4, 2), 4), "observed is 4 of 4 steps of x, which leaves none to predict"),
        (lambda: ArrayWindows(draw(3, 4, 2), "2"), "observed is '2'; it must be a whole number"),
        (lambda: run({}, array_windows(), scores="motion"), "scores is 'motion'; expected a function of the windows"),
        (lambda: ArrayWindows(draw(3, 4, 2), 0), "observed is 0; it must be at least 1"),
        (lambda: ArrayWindows(draw(3, 4), 2), r"must be \(N, T, D\)"),
        (lambda: ArrayWindows(draw(3, 4, 2), 2, clips=["a"]), "3 windows need as many clip names, not 1"),
    ],
)
def test_what_cannot_be_evaluated_is_refused(call, message):
    with pytest.raises((TypeError, ValueError), match=message):
        call()


def test_ragged_windows_are_refused():
    windows = array_windows()
    ragged = Mock(windows, all=lambda: {**windows.all(), "lengths": torch.ones(12)})
    with pytest.raises(ValueError, match="windows of one length, but these have lengths"):
        run({}, ragged)


# Motion


@pytest.fixture(scope="module")
def people():
    protocol = motion.PROTOCOLS["simulated"]
    clips = motion.simulate(clips=10, frames=90, test=0.4)
    return motion.windows(clips, protocol, "test"), motion.windows(clips, protocol, "train+validation")


def test_bone_lengths_tell_stretched_people(people):
    test, training = people
    tall = Forecaster(lambda x, horizon, samples: 1.1 * last_value(x, horizon).expand(samples, -1, -1, -1))
    assert free_running(tall, test, scores=motion.scores)["bone-length error"].mean == pytest.approx(0.1, abs=1e-3)
    result = run({}, test, scores=motion.scores, training_windows=training, samples=2)
    assert result["zero velocity"]["bone-length error"].mean < 1e-3
    assert result.data["joints"] == list(test.skeleton.names)
    assert result.protocol["name"] == "simulated"
    assert result.clips == {f"test/{clip.name}": 2 for clip in test.clips}


@pytest.mark.data
@pytest.mark.parametrize(
    ("file", "protocol", "still", "neighbours"),
    [
        ("bandai/bandai2.npz", "bandai2-by-style", (0.493, 0.641), (0.285, 0.260, 2.92)),
        ("cmu/cmu8.npz", "cmu8", (0.755, 0.906), (0.503, 0.457, 5.60)),
    ],
)
def test_reference_rows_of_real_data_are_those_published_with_it(real, file, protocol, still, neighbours):
    clips = real(file)
    test = motion.windows(clips, motion.PROTOCOLS[protocol], "test")
    x = test.all()["x"]
    training = motion.windows(clips, motion.PROTOCOLS[protocol], "train+validation").all()["x"]
    observed, futures = x[:, : test.protocol.observed], x[:, test.protocol.observed :]
    ade, fde = errors.average_displacement_error, errors.final_displacement_error
    point = last_value(observed, futures.shape[1]).movedim(0, 1)
    assert [score(point, futures).mean().item() for score in (ade, fde)] == pytest.approx(still, abs=6e-4)
    many = nearest_neighbours(observed, training, 50).movedim(0, 1)
    scores = [ade(many, futures), fde(many, futures), metrics.average_pairwise_distance(many)]
    assert [score.mean().item() for score in scores] == pytest.approx(neighbours, abs=5e-3)
