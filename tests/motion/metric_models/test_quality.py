"""The quality score: chance level for true futures, no errors for noise, and reproducible results."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from dvae import motion
from dvae.motion.metric_models.quality import QualityScores, RealOrGenerated, quality

SHORT = replace(motion.PROTOCOLS["simulated"], observed=4, predicted=6, test_stride=5)


class FutureModel(nn.Module):
    """A model that only returns futures."""

    def __init__(self, futures):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(()))
        self.futures = futures

    def forecast(self, batch, horizon, samples=1, **options):
        assert options == {"draw_emission": False}
        return {"x": self.futures(batch["x"], horizon).expand(samples, -1, -1, -1)}


def noise(x, horizon):
    return torch.randn(len(x), horizon, x.shape[2])


@pytest.fixture(scope="module")
def people():
    clips = motion.simulate(clips=40, frames=40, test=0.5)
    return {split: motion.windows(clips, SHORT, split) for split in ("train", "test")}


def remembering(windows):
    """Return a function that copies the future of the nearest past."""
    x = torch.cat([each.all(1)["x"] for each in windows.values()])

    def futures(past, horizon):
        return x[torch.cdist(past.flatten(1), x[:, : past.shape[1]].flatten(1)).argmin(1), past.shape[1] :]

    return futures


def quality_scores(models, people, **options):
    fit = {"examples": 300, "steps": 120, "seeds": (0, 1), "learning_rate": 0.2, "batch_size": 64}
    options = {"references": False, **fit, **options}
    models = {name: FutureModel(futures) for name, futures in models.items()}
    common = {"method": RealOrGenerated(16), "progress": False, "accelerator": "cpu"}
    return quality(models, people["train"], people["test"], **common, **options)


def test_noise_is_detected_always_and_half_noise_half_the_time(people):
    copied = remembering(people)

    def half(x, horizon):
        return torch.where(torch.rand(len(x), 1, 1) < 0.5, noise(x, horizon), copied(x, horizon))

    result = quality_scores({"noise": noise, "half of each": half}, people)
    assert list(result.rows) == ["noise", "half of each"]
    assert result["noise"]["quality"].mean < 8
    # only the noise half of the futures is detectable: the best accuracy is (1 + 1 / 2) / 2
    half_noise = result["half of each"]
    assert 25 - 4 * half_noise["quality"].sequences < half_noise["quality"].mean < 40
    assert 25 < half_noise["taken for real"].mean < 75
    worse = result.difference("noise", "half of each")
    assert worse.mean == pytest.approx(result["noise"]["quality"].mean - result["half of each"]["quality"].mean)
    assert worse.interval(error="sequences")[1] < 0


def test_true_futures_score_at_chance_level(people):
    result = quality_scores({"copied": remembering(people)}, people, steps=5)["copied"]
    assert result["quality"].mean == pytest.approx(
        50
    )  # the same windows as true and forecast: half of the answers are wrong
    assert result["quality"].sequences == pytest.approx(0)


def test_zero_velocity_is_a_reference_row(people):
    result = quality_scores(
        {"mine": lambda x, horizon: x[:, -1:].expand(-1, horizon, -1)}, people, references=True, steps=2
    )
    assert list(result.rows) == ["mine", "zero velocity"]
    assert result["mine"] == result["zero velocity"]


@pytest.mark.parametrize(("level", "is_noted"), [(2.5, False), (50.0, True)])
def test_a_table_notes_classifiers_that_do_not_recognise_zero_velocity(people, level, is_noted):
    result = quality_scores(
        {"mine": lambda x, horizon: x[:, -1:].expand(-1, horizon, -1)}, people, references=True, steps=1
    )
    for scores in result.rows.values():
        scores["quality"][:] = level
    assert ("hardly recognise zero velocity" in str(result.table().caption)) == is_noted


def test_new_samples_of_real_motion_score_at_chance_level():
    """If frames are independent, new samples of the future are as real as the true ones."""
    clips = motion.simulate(clips=30, frames=40, test=0.5)
    generator = np.random.default_rng(0)
    independent = [
        replace(clip, positions=generator.normal(0, 0.2, clip.positions.shape).astype("f4")) for clip in clips
    ]
    windows = motion.MotionSet(independent, clips.skeleton, "noise")
    windows = {split: motion.windows(windows, SHORT, split) for split in ("train", "test")}

    def again(x, horizon):
        joints, pelvis = torch.randn(len(x), horizon, 16, 3), torch.randn(len(x), horizon, 1, 3)
        return 0.2 * (joints - pelvis).flatten(-2)

    score = quality_scores({"again": again}, windows, steps=40)["again"]["quality"]
    assert abs(score.mean - 50) < 4 * score.sequences
    assert score.sequences > 0


def test_heading_and_root_position_change_no_score(people):
    metric_model, fixed = (RealOrGenerated(32, heading=each).build(people["train"]).double() for each in (True, False))
    skeleton, x = people["train"].skeleton, people["test"].all()["x"][:5].double()
    rotated = motion.rotate_about_up(x.unflatten(-1, (-1, 3)), torch.rand(5, 1, 1).double(), skeleton.up)
    translated = skeleton.with_root(rotated) + torch.randn(5, 10, 1, 3).double()
    for other in (rotated, translated):
        torch.testing.assert_close(metric_model.logits(other.flatten(-2)), metric_model.logits(x))
    assert metric_model.logits(x).std() > 0
    assert (fixed.logits(rotated.flatten(-2)) != fixed.logits(x)).all()
    with pytest.raises(ValueError, match="frames have 5 numbers; expected 51 for the skeleton 'walker', or 48"):
        metric_model.logits(x[..., :5])


def test_the_same_seeds_give_the_same_scores_and_scores_are_stored(people, tmp_path):
    state = torch.get_rng_state()
    first, other = (quality_scores({"noise": noise}, people, steps=4, seeds=seeds) for seeds in ((3, 4), (3, 5)))
    assert torch.equal(torch.get_rng_state(), state)
    assert np.array_equal(first.rows["noise"]["quality"][0], other.rows["noise"]["quality"][0])
    assert not np.array_equal(first.rows["noise"]["quality"][1], other.rows["noise"]["quality"][1])
    first.save(tmp_path / "found.json")
    loaded = QualityScores.load(tmp_path / "found.json")
    assert str(loaded) == str(first)
    assert loaded["noise"] == first["noise"]
    assert loaded.record["training"]["momentum"] == 0.9
    one = quality_scores({"noise": noise}, people, steps=2, seeds=(0,))["noise"]["quality"]
    assert math.isnan(one.total)
    assert not math.isnan(one.sequences)


def test_wrong_arguments_are_errors(people):
    other = motion.windows(motion.simulate(clips=8, frames=40, test=0.5), replace(SHORT, observed=5), "test")
    incomplete = motion.windows(motion.occlude(motion.simulate(8, 40, test=0.5), 0.2, 5.0), SHORT, "test")
    for options, message in (
        ({"people": {**people, "test": other}}, "training and test windows differ in skeleton or frames"),
        ({"people": {**people, "test": incomplete}}, "these have missing joints; fill them in"),
        ({"seeds": ()}, "at least one example and one seed"),
        ({"models": {"zero velocity": noise}, "references": True}, "the name 'zero velocity' is reserved"),
    ):
        with pytest.raises(ValueError, match=message):
            quality_scores(**{"models": {"noise": noise}, "people": people, **options})
    with pytest.raises(FloatingPointError, match="the forecast of broken is not finite"):
        quality_scores({"broken": lambda x, horizon: noise(x, horizon) / 0}, people)
    with pytest.raises(
        ValueError, match="a metric model of quality needs the description of poses, but was given sequences"
    ):
        RealOrGenerated().build({"x": 48})

    with pytest.raises(KeyError, match=r"no model 'nois' in these scores \(did you mean 'noise'\?\)"):
        quality_scores({"noise": noise}, people, steps=1)["nois"]
