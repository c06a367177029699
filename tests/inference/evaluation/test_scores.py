"""Scores as functions, and the protocols of data and models: what is asked for, who has it, who is refused."""

import pytest
import torch

from dvae.data.sequences import ArrayWindows
from dvae.inference.evaluation.evaluate import evaluate
from dvae.inference.evaluation.references import last_value
from dvae.inference.evaluation.scores import Measure, clip_means, means_of_those_that_count


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def still(windows, *measures, **options):
    result = evaluate({}, windows, scores=lambda _: measures, progress=False, **options)
    return result, result["last value"]


def test_a_score_is_a_function_of_forecasts_truth_past_and_places():
    x = draw(9, 6, 2)
    windows = ArrayWindows(x, 4, clips=list("aaabbbccc"))
    seen = []

    def function(forecasts, truth, past, index):
        seen.append(index)
        assert torch.equal(truth, x[index, 4:])
        assert torch.equal(past["x"], x[index, :4])
        assert torch.equal(forecasts[:, 0], last_value(past["x"], 2)[0])
        return index.double()

    result, scores = still(windows, Measure("place", function, "windows", ""), batch_size=4)
    assert torch.equal(torch.cat(seen), torch.arange(9))
    assert scores["place"].mean == pytest.approx(4)
    assert result.rows["last value"].clip_means["place"].tolist() == [1, 4, 7]
    assert result.metrics["place"].unit == "windows"
    assert "place (windows)" in str(result)


def test_a_score_may_be_of_the_whole_set_and_say_nothing_of_some_clips():
    windows = ArrayWindows(draw(6, 3, 1), 2, clips=list("aabbcc"))

    def most(values, clips):
        assert values.shape == (6, 2)
        return [float(values.max())] * (int(clips.max()) + 1)

    whole = Measure("most", lambda f, *_: torch.stack([f[:, 0, 0, 0], f[:, 0, 0, 0]], 1), pool=most)
    some = Measure("some", lambda f, t, p, index: torch.where(index < 2, torch.nan, 1.0 * index), partial=True)
    _, scores = still(windows, whole, some)
    assert scores["most"].mean == pytest.approx(windows.x[:, 1].max().item())
    assert scores["some"].mean == pytest.approx((2 + 3 + 4 + 5) / 4)
    assert scores["some"].freedom == 1


def test_windows_that_do_not_count_leave_the_mean_and_not_their_clip():
    values = torch.tensor([1.0, torch.nan, 3.0, torch.nan, torch.nan, 8.0])
    clips = torch.tensor([0, 0, 1, 2, 2, 3])
    of_clips = torch.tensor(means_of_those_that_count(values, clips))
    assert float(of_clips @ (clips.bincount() / 6.0)) == pytest.approx(4.0)  # (1 + 3 + 8) / 3
    assert of_clips[2] == pytest.approx(4.0)  # says nothing, moves nothing
    whole = torch.arange(6.0)
    assert means_of_those_that_count(whole, clips) == pytest.approx(list(clip_means(whole, clips)))


# Protocols
