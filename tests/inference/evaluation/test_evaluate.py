"""Evaluation: all rows on the same windows, correct standard errors, complete records."""

import dataclasses
import json
import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from torch import nn

from dvae import motion
from dvae.data.sequences import ArrayWindows
from dvae.inference.bounds.elbo import SequenceELBO
from dvae.inference.evaluation.evaluate import evaluate
from dvae.inference.evaluation.evaluation import Evaluation, Score
from dvae.inference.evaluation.references import last_value
from dvae.inference.evaluation.scores import Measure, cluster_means, means_of_those_that_count
from dvae.motion.scoring import metrics as errors
from dvae.motion.scoring.metrics import multimodal_truths
from dvae.program.model import DynamicalVAE

OBSERVED, FRAMES, SIZE = 4, 9, 3


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def array_windows(count=12, clips=None, **options):
    clips = [f"clip_{i // 3}" for i in range(count)] if clips is None else clips
    return ArrayWindows(draw(count, FRAMES, SIZE).cumsum(1), OBSERVED, groups=clips, **options)


@pytest.fixture(scope="module")
def model():
    pair = "p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-1}, x_{1:T})"
    with torch.random.fork_rng():
        torch.manual_seed(1)
        return DynamicalVAE(*pair, {"z": 2, "x": SIZE}).double()


class Forecaster(nn.Module):
    """A model that forecasts by a function and has no uncertainty."""

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
    """Return the scores of a forecaster without a bound."""

    def no_bound(self, model, batch):
        return SimpleNamespace(per_step=torch.zeros(len(batch["x"])), kl={}, n_steps=FRAMES)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SequenceELBO, "terms", no_bound)
        return run(forecaster, windows, **options)["model"]


# One evaluation


def test_scores_are_the_metrics_of_the_forecasts_and_the_bound_per_step(model):
    windows = array_windows()
    result = run({"dkf": model}, windows, batch_size=12, training_windows=array_windows(20), seed=3)
    assert list(result.rows) == ["last value", "mean", "climatology", "nearest neighbours", "dkf"]
    assert [row.samples for row in result.rows.values()] == [1, 1, 5, 5, 5]
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


def test_evaluation_changes_neither_mode_nor_random_state(model):
    model.train()
    state = torch.get_rng_state()
    run(model, array_windows())
    assert model.training
    assert torch.equal(torch.get_rng_state(), state)


def test_a_perfect_forecast_has_error_zero_also_for_multimodal_truth():
    windows = array_windows()
    truth = iter(windows.all()["x"][:, OBSERVED:].split(5))
    perfect = Forecaster(lambda x, horizon, samples: next(truth).expand(samples, -1, -1, -1))
    displacements = partial(motion.displacements, threshold=1e-9)
    scores = free_running(perfect, windows, batch_size=5, scores=displacements)
    for name in ("ADE", "FDE", "MMADE", "MMFDE", "ADEm", "MMFDEm", "energy score", "variogram score", "APD"):
        assert scores[name].mean == pytest.approx(0, abs=1e-6), name


def test_multimodal_errors_average_over_all_windows_with_the_same_pose():
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
    """Return windows of two frames with these last observed poses."""
    return ArrayWindows(torch.stack([poses, poses], 1), 1, **options)


def test_similar_windows_lie_strictly_below_the_threshold_and_include_the_window():
    windows = in_poses(torch.tensor([[0.0, 0.0], [0.5, 0.0], [0.25, 0.0], [9.0, 9.0]]))
    assert [truths.tolist() for truths in multimodal_truths(windows)] == [[0, 2], [1, 2], [0, 1, 2], [3]]
    assert [truths.tolist() for truths in multimodal_truths(windows, itself=False)] == [[2], [2], [0, 1], []]
    assert [truths.tolist() for truths in multimodal_truths(windows, 0.6)] == [[0, 1, 2], [0, 1, 2], [0, 1, 2], [3]]


# Standard errors


def evaluation(values, clips):
    """Evaluate zero velocity on windows whose final errors are `values`, of the given clips."""
    x = torch.zeros(len(values), 2, 1, dtype=torch.float64)
    x[:, 1, 0] = torch.as_tensor(values)
    return run({}, ArrayWindows(x, 1, groups=clips))


def test_independent_windows_have_the_standard_error_of_a_mean():
    values = draw(30).abs()
    score = evaluation(values, None)["last value"]["FDE"]
    assert score.mean == pytest.approx(values.mean().item())
    assert score.standard_error == pytest.approx((values.std() / math.sqrt(30)).item())


def test_copies_of_windows_in_a_clip_change_no_standard_error():
    values = draw(10).abs()
    once = evaluation(values, [str(i) for i in range(10)])["last value"]["FDE"]
    thrice = evaluation(values.repeat(3), [str(i) for i in range(10)] * 3)["last value"]["FDE"]
    assert thrice.mean == pytest.approx(once.mean)
    assert thrice.standard_error == pytest.approx(once.standard_error)


def test_differences_are_paired(model):
    result = run({"a": model, "b": model}, array_windows())
    assert result.difference("a", "b", "ADE") == Score(0, 0)
    paired = result.difference("a", "last value", "ADE")
    assert paired.mean == pytest.approx(result["a"]["ADE"].mean - result["last value"]["ADE"].mean)
    with pytest.raises(KeyError, match="score"):
        result.difference("a", "last value", "ELBO")
    with pytest.raises(KeyError, match="method"):
        result["c"]


# Records


def test_the_record_is_complete_and_is_read_back_from_json(model, tmp_path):
    windows = array_windows()
    result = run({"dkf": model}, windows, configs={"dkf": {"width": 8}}, bound_particles=3, seed=5)
    result.save(tmp_path / "evaluation.json")
    again = Evaluation.load(tmp_path / "evaluation.json")
    sizes = {"windows": 12, "steps": FRAMES, "coordinates": SIZE}
    assert again.data == {"fingerprint": windows.fingerprint, "axis_names": ["group", "step"], **sizes}
    assert again.to_json() == result.to_json()
    assert (again.samples, again.seed, again.bound_particles) == (5, 5, 3)
    assert again.protocol == {"observed": OBSERVED}
    single_truths = sum(len(truths) == 1 for truths in multimodal_truths(windows))
    assert again.basis == {"multimodal": {"threshold": 0.5, "itself": True, "alone": single_truths}}
    assert f"{single_truths} of 12 have no other" in str(result)
    assert again.rows["dkf"].config == {"width": 8}
    assert again.rows["dkf"].equations["generative"] == model.generative.text
    assert (again.metrics["ELBO"].program, again.metrics["ELBO"].unit) == ("teacher-forced", "nats/step")
    scores = json.loads(result.to_json())["summary"]["dkf"]
    assert scores["ELBO"]["mean"] == result["dkf"]["ELBO"].mean
    assert scores["k-hat"]["mean"] is None  # three particles have no tail
    np.testing.assert_array_equal(again.dataset["ADE"].sel(model="dkf"), again.rows["dkf"].cluster_means["ADE"])
    document = result.document()
    for damage in ({"clips": {}}, {"metrics": {}}):
        with pytest.raises(ValueError, match="not written by Evaluation"):
            Evaluation.of({**document, "attributes": document["attributes"] | damage})


def test_table_and_plot_show_every_method_and_metric(model):
    result = run({"dkf": model}, array_windows())
    text = str(result)
    for part in ("last value", "dkf", "K = 5", "K = 1", "teacher-forced", "KL z", "±", "12 windows of 4 groups"):
        assert part in text
    assert str(result["dkf"]["ADE"]) in text
    panels = [axes.get_title() for axes in result.plot().axes if axes.axison]
    edges = {"lower": " ↓", "higher": " ↑", "": ""}
    better = [edges[metric.better] for metric in result.metrics.values()]
    assert [title.split(" (")[0] for title in panels] == [n + b for n, b in zip(result.metrics, better, strict=True)]
    assert all(title.split(" (")[0] in text for title in panels)
    assert len([axes for axes in result.plot(["ADE", "FDE"]).axes if axes.axison]) == 2


def test_a_table_of_some_metrics_has_no_other_rows(model):
    result = run({"dkf": model}, array_windows())
    assert result.table(["FDE", "ADE", "KL z"]).row_count == 5  # and a row for each program
    assert result.table(["ADE"]).row_count == 2
    noted = replace(result, notes=["ADE: of this score", "scales: of all scores"])
    assert "ADE: of this score" in str(noted.table(["ADE"]).caption)
    caption = str(noted.table(["FDE"]).caption)
    assert "ADE: of this score" not in caption
    assert "scales: of all scores" in caption
    with pytest.raises(KeyError, match=r"no method has a score 'ADF'.*did you mean"):
        result.table(["ADF"])


def test_more_than_five_methods_with_few_metrics_are_rows(model):
    result = run({"dkf": model}, array_windows())
    many = replace(result, rows={f"dkf {n}": result.rows["dkf"] for n in range(6)})
    table = many.table(["ADE", "KL z"])
    assert [str(column.header) for column in table.columns] == ["", "ADE ↓\nm", "KL z\nnats/step\nteacher-forced"]
    assert table.row_count == 6
    assert [*map(str, table.columns[1].cells)] == [str(result["dkf"]["ADE"])] * 6


@pytest.mark.parametrize(
    ("score", "text"),
    [
        (Score(0.49331, 0.0192), "0.493 ± 0.019"),
        (Score(math.nan, math.nan), "–"),
        (Score(2181.7243, 411.0123), "2181.7 ± 411.0"),
    ],
)
def test_scores_print_as_in_the_papers(score, text):
    assert str(score) == text


# Refusals


def nan_at_the_second_window(x, horizon, samples):
    forecast = last_value(x, horizon).repeat(samples, 1, 1, 1)
    forecast[0, 1, 2, 0] = math.nan
    return forecast


def test_a_nonfinite_forecast_is_an_error_with_method_and_window():
    windows = array_windows(clips=[f"clip_{i}" for i in range(12)])
    with pytest.raises(FloatingPointError, match="forecast"):
        run({"wild": Forecaster(nan_at_the_second_window)}, windows)


def test_ragged_windows_are_an_error():
    windows = array_windows()
    ragged = Mock(windows, all=lambda: {**windows.all(), "lengths": torch.ones(12)})
    with pytest.raises(ValueError, match="windows"):
        run({}, ragged)


# Scores as functions


def still(windows, *measures, **options):
    result = evaluate({}, windows, scores=lambda _: measures, progress=False, **options)
    return result, result["last value"]


def test_a_score_gets_forecasts_truth_past_and_indices():
    x = draw(9, 6, 2)
    windows = ArrayWindows(x, 4, groups=list("aaabbbccc"))
    calls = []

    def function(forecasts, truth, past, index):
        calls.append(index)
        assert torch.equal(truth, x[index, 4:])
        assert torch.equal(past["x"], x[index, :4])
        assert torch.equal(forecasts[:, 0], last_value(past["x"], 2)[0])
        return index.double()

    result, scores = still(windows, Measure("place", function, "windows", ""), batch_size=4)
    assert torch.equal(torch.cat(calls), torch.arange(9))
    assert scores["place"].mean == pytest.approx(4)
    assert result.rows["last value"].cluster_means["place"].tolist() == [1, 4, 7]
    assert result.metrics["place"].unit == "windows"
    assert "place (windows)" in str(result)


def test_a_score_of_the_whole_set_may_skip_clips():
    windows = ArrayWindows(draw(6, 3, 1), 2, groups=list("aabbcc"))

    def most(values, clips):
        assert values.shape == (6, 2)
        return [float(values.max())] * (int(clips.max()) + 1)

    whole_set = Measure("most", lambda f, *_: torch.stack([f[:, 0, 0, 0], f[:, 0, 0, 0]], 1), pool=most)
    some = Measure("some", lambda f, t, p, index: torch.where(index < 2, torch.nan, 1.0 * index), partial=True)
    _, scores = still(windows, whole_set, some)
    assert scores["most"].mean == pytest.approx(windows.x[:, 1].max().item())
    assert scores["some"].mean == pytest.approx((2 + 3 + 4 + 5) / 4)
    assert scores["some"].freedom == 1


def test_windows_with_nan_scores_leave_the_mean():
    values = torch.tensor([1.0, torch.nan, 3.0, torch.nan, torch.nan, 8.0])
    clips = torch.tensor([0, 0, 1, 2, 2, 3])
    of_clips = torch.tensor(means_of_those_that_count(values, clips))
    assert of_clips[2].isnan()  # it has no window with a score
    assert float(of_clips[[0, 1, 3]] @ (clips.bincount()[[0, 1, 3]] / 4.0)) == pytest.approx(4.0)  # (1 + 3 + 8) / 3


@pytest.mark.parametrize(("known", "freedom"), [(1, 0), (2, 1), (4, 3)])
def test_clips_without_a_score_do_not_reduce_its_error(known, freedom):
    windows = ArrayWindows(torch.randn(8, 3, 1), 2, groups=list("aabbccdd"))
    score = Measure("place", lambda f, t, p, index: torch.where(index < 2 * known, 1.0 * index, torch.nan))
    measure = replace(score, pool=means_of_those_that_count, partial=True)
    _, scores = still(windows, measure)
    means = np.arange(known) * 2 + 0.5
    error = means.std(ddof=1) / known**0.5 if known > 1 else np.nan
    np.testing.assert_allclose(dataclasses.astuple(scores["place"]), (means.mean(), error, freedom))


def test_a_measure_that_no_window_has_is_unknown():
    windows = ArrayWindows(torch.randn(4, 3, 1), 2)
    _, scores = still(windows, Measure("none", lambda f, t, p, index: torch.nan * index, partial=True))
    assert np.isnan(scores["none"].mean)


def test_a_score_that_all_windows_have_is_their_mean():
    clips = torch.tensor([0, 0, 1, 2, 2, 3])
    score_values = torch.arange(6.0)
    assert means_of_those_that_count(score_values, clips) == pytest.approx(list(cluster_means(score_values, clips)))
