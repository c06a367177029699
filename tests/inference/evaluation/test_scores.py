"""Scores as functions, and the protocols of data and models: what is asked for, who has it, who is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

import dvae
from dvae import motion
from dvae.data.sequences import ArrayWindows, Fingerprinted, HeldOutWindows, Listed, Sequences, Source, sequences
from dvae.inference.evaluation.evaluate import evaluate
from dvae.inference.evaluation.references import last_value
from dvae.inference.evaluation.scores import (
    ENERGY,
    Measure,
    clip_means,
    means_of_those_that_count,
    paired,
    proper,
)
from dvae.motion.judges.pose_prior import PosePriorModel
from dvae.program.protocols import Forecasting, Program


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
    assert result.rows["last value"].clip_means["place"] == (1, 4, 7)
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


def test_notes_bases_and_true_futures_come_with_a_score():
    note = {"note": "read it so", "basis": {"judge": "abc"}, "truth": "what happened"}
    measures = replace(ENERGY, **note), Measure("b", paired(lambda x, y: x.mean((-1, -2, -3)) * 0), **note)
    result, _ = still(ArrayWindows(draw(4, 3, 1), 2), *measures)
    assert list(result.rows) == ["what happened", "last value"]
    assert result["what happened"]["energy score"].mean == 0
    assert (result.notes, result.basis) == (["read it so"], {"judge": "abc"})
    assert dvae.Evaluation.from_json(result.to_json()).to_json() == result.to_json()


def test_without_more_said_scores_are_proper_and_of_any_arrays():
    windows = ArrayWindows(draw(4, 5, 2), 3)
    result = evaluate({}, windows, progress=False)
    assert list(result.metrics) == [measure.name for measure in proper(windows)]
    assert result["last value"]["CRPS"].mean == pytest.approx((windows.x[:, 3:] - windows.x[:, 2:3]).abs().mean())
    model = dvae.DynamicalVAE("p(z_t) p(x_t | z_t)", "q(z_t | x_t)", {"z": 1, "x": 2}).double()
    compared = dvae.compare({"a": model}, windows, particles=2, samples=3, contrasts=0, progress=False)
    assert compared.shown == {"energy score": "", "CRPS": ""}
    assert "CRPS ↓" in str(compared)


def test_what_is_no_score_or_no_model_is_refused():
    windows = ArrayWindows(draw(4, 5, 2), 3)
    with pytest.raises(ValueError, match="two are called energy score"):
        still(windows, ENERGY, ENERGY)
    with pytest.raises(TypeError, match="'a' is a Linear, not a model that forecasts"):
        evaluate({"a": nn.Linear(1, 1)}, windows)
    with pytest.raises(TypeError, match=r"scores of motion need windows of dvae\.motion.* not ArrayWindows"):
        evaluate({}, windows, scores=motion.scores)


# Protocols


@pytest.fixture(scope="module")
def people():
    return motion.windows(motion.simulate(clips=10, frames=40, test=0.4), motion.PROTOCOLS["simulated"], "test", 20)


def test_data_have_what_their_protocols_say(people):
    memory = Sequences({"x": draw(3, 4, 2)})
    drawn = motion.WithPseudoTruths(people, motion.PseudoTruths(people))
    found = {
        type(each).__name__: [isinstance(each, kind) for kind in (Source, Listed, Fingerprinted, HeldOutWindows)]
        for each in (memory, people, drawn, ArrayWindows(memory.batch["x"], 2), np.zeros(3))
    }
    assert found == {
        "Sequences": [True, False, False, False],
        "Windows": [True, True, True, True],
        "WithPseudoTruths": [True, False, True, False],
        "ArrayWindows": [False, True, True, True],
        "ndarray": [False, True, False, False],  # which is taken for an array before it is asked
    }
    assert len(sequences(people)) == len(people)
    with pytest.raises(TypeError, match="got WithPseudoTruths"):
        sequences(drawn)


def test_models_have_what_their_protocols_say(people):
    small = dvae.method("srnn", latent=1, width=2).build({"x": people.size})
    density = PosePriorModel(people.skeleton)
    for model, *kinds in ((small, True, True), (density, True, False), (nn.GRU(1, 1), False, False)):
        assert [isinstance(model, kind) for kind in (Program, Forecasting)] == kinds, type(model)
    assert (small.per, small.likelihood) == ("frame", True)
