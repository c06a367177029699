"""The metric model of quality: at guessing where nobody can tell, never wrong where everybody can, and reproducible."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from dvae import motion
from dvae.motion.metric_models.quality import QualityScores, RealOrGenerated, quality

SHORT = replace(motion.PROTOCOLS["simulated"], observed=4, predicted=6, test_stride=5)


class Makes(nn.Module):
    """A model of nothing but futures."""

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
    """Copies the future of whoever began so."""
    x = torch.cat([each.all(1)["x"] for each in windows.values()])

    def futures(past, horizon):
        return x[torch.cdist(past.flatten(1), x[:, : past.shape[1]].flatten(1)).argmin(1), past.shape[1] :]

    return futures


def judged(models, people, **options):
    fit = {"examples": 300, "steps": 120, "seeds": (0, 1), "learning_rate": 0.2, "batch_size": 64}
    options = {"references": False, **fit, **options}
    models = {name: Makes(futures) for name, futures in models.items()}
    common = {"method": RealOrGenerated(16), "progress": False, "accelerator": "cpu"}
    return quality(models, people["train"], people["test"], **common, **options)


def test_noise_is_told_and_noise_half_the_time_is_told_then(people):
    copied = remembering(people)

    def half(x, horizon):
        return torch.where(torch.rand(len(x), 1, 1) < 0.5, noise(x, horizon), copied(x, horizon))

    found = judged({"noise": noise, "half of each": half}, people)
    assert list(found.rows) == ["noise", "half of each"]
    assert found["noise"]["quality"].mean < 8
    # who makes noise half the time can be told then, and then alone: at best with an accuracy of (1 + 1 / 2) / 2
    mixed = found["half of each"]
    assert 25 - 4 * mixed["quality"].sequences < mixed["quality"].mean < 40
    assert 25 < mixed["taken for real"].mean < 75
    worse = found.difference("noise", "half of each")
    assert worse.mean == pytest.approx(found["noise"]["quality"].mean - found["half of each"]["quality"].mean)
    assert worse.interval(error="sequences")[1] < 0


def test_true_futures_leave_the_judge_at_guessing_whatever_it_has_learned(people):
    found = judged({"copied": remembering(people)}, people, steps=5)["copied"]
    assert found["quality"].mean == pytest.approx(50)  # the same windows twice: half of the answers are wrong
    assert found["quality"].sequences == pytest.approx(0)


def test_zero_velocity_is_judged_beside_them(people):
    found = judged({"mine": lambda x, horizon: x[:, -1:].expand(-1, horizon, -1)}, people, references=True, steps=2)
    assert list(found.rows) == ["mine", "zero velocity"]
    assert found["mine"] == found["zero velocity"]


def test_other_draws_of_real_motion_leave_the_judge_at_guessing():
    """Where every frame is a draw of its own, futures drawn anew are as real as the true ones."""
    clips = motion.simulate(clips=30, frames=40, test=0.5)
    generator = np.random.default_rng(0)
    made = [replace(clip, positions=generator.normal(0, 0.2, clip.positions.shape).astype("f4")) for clip in clips]
    windows = motion.MotionSet(made, clips.skeleton, "noise")
    windows = {split: motion.windows(windows, SHORT, split) for split in ("train", "test")}

    def again(x, horizon):
        joints, pelvis = torch.randn(len(x), horizon, 16, 3), torch.randn(len(x), horizon, 1, 3)
        return 0.2 * (joints - pelvis).flatten(-2)

    found = judged({"again": again}, windows, steps=40)["again"]["quality"]
    assert abs(found.mean - 50) < 4 * found.sequences
    assert found.sequences > 0


def test_who_faces_where_and_where_the_pelvis_is_tell_nobody_apart(people):
    metric_model, fixed = (RealOrGenerated(32, heading=each).build(people["train"]).double() for each in (True, False))
    skeleton, x = people["train"].skeleton, people["test"].all()["x"][:5].double()
    turned = motion.rotate_about_up(x.unflatten(-1, (-1, 3)), torch.rand(5, 1, 1).double(), skeleton.up)
    moved = skeleton.with_root(turned) + torch.randn(5, 10, 1, 3).double()
    for other in (turned, moved):
        torch.testing.assert_close(metric_model.logits(other.flatten(-2)), metric_model.logits(x))
    assert metric_model.logits(x).std() > 0
    assert (fixed.logits(turned.flatten(-2)) != fixed.logits(x)).all()
    with pytest.raises(ValueError, match="frames have 5 numbers; expected 51 for the skeleton 'walker', or 48"):
        metric_model.logits(x[..., :5])


def test_the_same_seeds_give_the_same_scores_which_are_kept(people, tmp_path):
    state = torch.get_rng_state()
    first, other = (judged({"noise": noise}, people, steps=4, seeds=seeds) for seeds in ((3, 4), (3, 5)))
    assert torch.equal(torch.get_rng_state(), state)
    assert np.array_equal(first.rows["noise"]["quality"][0], other.rows["noise"]["quality"][0])
    assert not np.array_equal(first.rows["noise"]["quality"][1], other.rows["noise"]["quality"][1])
    first.save(tmp_path / "found.json")
    read = QualityScores.load(tmp_path / "found.json")
    assert str(read) == str(first)
    assert read["noise"] == first["noise"]
    assert read.record["training"]["momentum"] == 0.9
    one = judged({"noise": noise}, people, steps=2, seeds=(0,))["noise"]["quality"]
    assert math.isnan(one.total)
    assert not math.isnan(one.sequences)


def test_what_it_refuses(people):
    other = motion.windows(motion.simulate(clips=8, frames=40, test=0.5), replace(SHORT, observed=5), "test")
    lacking = motion.windows(motion.occlude(motion.simulate(8, 40, test=0.5), 0.2, 5.0), SHORT, "test")
    for options, message in (
        ({"people": {**people, "test": other}}, "training and test windows differ in skeleton or frames"),
        ({"people": {**people, "test": lacking}}, "these have missing joints; fill the gaps"),
        ({"seeds": ()}, "at least one example and one seed"),
        ({"models": {"zero velocity": noise}, "references": True}, "must not have the name of a reference row: zero"),
    ):
        with pytest.raises(ValueError, match=message):
            judged(**{"models": {"noise": noise}, "people": people, **options})
    with pytest.raises(FloatingPointError, match="the forecast of broken is not finite"):
        judged({"broken": lambda x, horizon: noise(x, horizon) / 0}, people)
    with pytest.raises(
        ValueError, match="a metric model of quality needs the description of poses, but was given sequences"
    ):
        RealOrGenerated().build({"x": 48})

    with pytest.raises(KeyError, match=r"no model 'nois' here \(did you mean 'noise'\?\)"):
        judged({"noise": noise}, people, steps=1)["nois"]
