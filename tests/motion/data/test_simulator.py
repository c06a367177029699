import numpy as np
import pytest
import torch

from dvae.motion import WALKER, simulate
from dvae.motion.data.simulator import ACTIVITIES
from dvae.motion.drawing.plot import futures

FEET = [WALKER.names.index(name) for name in ("LFoot", "RFoot")]


@pytest.fixture(scope="module")
def people():
    return simulate(40, 150, seed=3)


@pytest.fixture(scope="module")
def positions(people):
    return np.stack([clip.positions for clip in people]).astype(np.float64)


def test_bones_are_rigid_within_a_clip_and_differ_between_people(people, positions):
    lengths = WALKER.bone_lengths(positions)
    assert np.ptp(lengths, axis=1).max() < 1e-5
    assert lengths.mean(1).std(0).min() > 0.005
    true_lengths = np.stack([clip.truth["bone_lengths"] for clip in people])
    np.testing.assert_allclose(lengths, np.repeat(true_lengths[:, None], 150, axis=1), atol=1e-5)


def test_feet_stay_on_the_floor_and_do_not_slide(positions):
    feet = positions[:, :, FEET]
    assert feet[..., 1].min() > 0
    lower = feet[..., 1].min(axis=2)
    assert np.abs(lower - 0.08).max() < 0.07
    speed = np.linalg.norm(np.diff(feet[..., [0, 2]], axis=1), axis=-1) * WALKER.fps
    standing = feet[:, 1:, :, 1].argmin(axis=2)[..., None]
    assert np.median(np.take_along_axis(speed, standing, axis=2)) < 0.1


def test_wavers_raise_the_hand_given_in_the_truth(people, positions):
    above = positions[:, :, [WALKER.names.index(j) for j in ("LWrist", "RWrist")], 1]
    above = above - positions[:, :, [WALKER.names.index("Neck")], 1]
    weights = np.stack([clip.truth["weights"] for clip in people])
    for name, raised in (
        *(("wave-left", (True, False)), ("wave-right", (False, True))),
        *(("wave-both", (True, True)), ("walk", (False, False)), ("stand", (False, False))),
    ):
        frames = weights[..., ACTIVITIES.index(name)] > 0.999
        assert frames.any()
        np.testing.assert_array_equal((above[frames] > 0).mean(0) > 0.5, raised)
        assert ((above[frames] > 0) == raised).mean() > 0.95


class TestFigures:
    @pytest.mark.parametrize(("K", "past_frames", "H", "last"), [(1, 1, 1, "+0.03 s"), (5, 15, 60, "+2.0 s")])
    def test_futures_draw_past_samples_and_truth(self, positions, K, past_frames, H, last):
        past, future = positions[:K, :past_frames], positions[:K, past_frames : past_frames + H]
        ax = futures(WALKER, past[0], torch.from_numpy(future), future[0], frames=4)
        ax.figure.canvas.draw()
        frames = min(2, past_frames) + 2 * min(4, H)
        assert len(ax.collections) == frames
        key = [text.get_text() for text in ax.get_legend().get_texts()]
        assert key == ["observed", "what happened", f"{K} sample{'s' * (K > 1)}"]
        assert ax.get_xticklabels()[-1].get_text() == last

    def test_given_paths_are_drawn_as_crosses(self, positions):
        samples, wrist = positions[:1, 5:65], WALKER.find("LWrist")
        path = samples[0, :, wrist].copy()
        ax = futures(WALKER, positions[1, :5], samples, frames=3, paths={"left_wrist": path})
        bone = next(b for b, (_, child) in enumerate(WALKER.edges) if child == wrist)
        for crosses, line in zip(ax.collections[2:4], ax.lines[:2], strict=True):
            np.testing.assert_allclose(line.get_xydata()[0], crosses.get_segments()[bone][1])
        with pytest.raises(ValueError, match=r"the path of LWrist has shape .*, expected \(60, 3\)"):
            futures(WALKER, positions[1, :5], samples, paths={"LWrist": path[:9]})
