"""Futures whose first frames continue the observed motion, and the steps of joints at the seam."""

from dataclasses import replace

import numpy as np
import pytest

from dvae import motion
from dvae.cli import main
from dvae.cli.futures import _travel

OBSERVED, HORIZON = 8, 30


@pytest.fixture(scope="module")
def futures():
    """Return futures that jump: the true future and another clip, in float64."""
    clips = motion.simulate(clips=4, frames=OBSERVED + HORIZON, seed=5).clips
    first, second, *others = (clip.positions.astype(np.float64) for clip in clips)
    observed, truth = (np.stack([first[part], second[part]]) for part in (slice(OBSERVED), slice(OBSERVED, None)))
    forecasts = np.stack([truth, np.stack([other[OBSERVED:] for other in others])])
    return motion.Forecasts(motion.WALKER, [("test", "a", 0), ("test", "b", 0)], forecasts, observed, truth)


def test_the_first_frame_follows_at_constant_velocity_and_later_frames_are_kept(futures):
    blended = futures.blended(10)
    body, last, before = motion.WALKER, futures.observed[:, -1], futures.observed[:, -2]
    first, expected = blended.forecasts[:, :, 0], 2 * last - before
    np.testing.assert_allclose(first[..., body.root, :], np.stack([expected[:, body.root]] * 2), atol=1e-12)
    parents, children = map(list, zip(*body.edges, strict=True))
    bones, expected_bones = (x[..., children, :] - x[..., parents, :] for x in (first, expected))
    cosines = (bones * expected_bones).sum(-1) / (
        np.linalg.norm(bones, axis=-1) * np.linalg.norm(expected_bones, axis=-1)
    )
    np.testing.assert_allclose(cosines, 1, atol=1e-9)
    np.testing.assert_allclose(body.bone_lengths(first), np.stack([body.bone_lengths(last)] * 2), rtol=1e-9)
    np.testing.assert_array_equal(blended.forecasts[:, :, 10:], futures.forecasts[:, :, 10:])
    np.testing.assert_array_equal(blended.observed, futures.observed)
    assert blended.window(1, 1).blend == blended.blend == 10


def test_blending_removes_the_jump_and_keeps_lengths_of_bones(futures):
    (step, true), (blended_step, same) = futures.largest_steps(), futures.blended(10).largest_steps()
    assert step > 5 * true
    assert blended_step < 1.2 * true == 1.2 * same
    lengths = motion.WALKER.bone_lengths(futures.blended(10).forecasts)
    ends = motion.WALKER.bone_lengths(np.stack([np.stack([futures.observed[:, -1]] * 2), futures.forecasts[:, :, 0]]))
    assert (lengths >= ends.min(0)[:, :, None] - 1e-6).all()
    assert (lengths <= ends.max(0)[:, :, None] + 1e-6).all()


def test_a_future_that_continues_at_constant_velocity_is_not_changed(futures):
    observed = np.repeat(futures.observed[:, :1], OBSERVED, 1)
    steps = 0.02 * np.arange(OBSERVED + HORIZON)[:, None, None] * [1.0, 0.0, 0.5]
    moving = np.repeat(futures.observed[:, :1], OBSERVED + HORIZON, 1) + steps
    continued = replace(futures, observed=observed + steps[:OBSERVED], forecasts=moving[None, :, OBSERVED:])
    np.testing.assert_allclose(continued.blended(12).forecasts, continued.forecasts, atol=1e-7)
    assert continued.largest_steps(5)[0] == pytest.approx(0.02 * 1.25**0.5)
    faster = replace(continued, skeleton=replace(motion.WALKER, fps=50.0))  # 30 steps of 22.4 mm, at 50 Hz
    assert "travels 0.67 m at 1.12 m/s" in _travel(faster)


def test_missing_joints_start_as_in_the_future(futures):
    observed = futures.observed.copy()
    observed[:, -1, 3] = np.nan
    blended = replace(futures, observed=observed).blended(5)
    assert np.isfinite(blended.forecasts).all()
    nowhere = replace(futures, observed=np.full_like(observed, np.nan))
    np.testing.assert_allclose(nowhere.blended(5).forecasts, futures.forecasts, atol=1e-6)
    assert np.isnan(nowhere.largest_steps()).all()


def test_a_single_observed_frame_is_continued_at_rest(futures):
    blended = replace(futures, observed=futures.observed[:, -1:]).blended(4)
    assert blended.largest_steps()[0] < 1e-9


def test_blended_futures_are_marked_in_their_file(futures, tmp_path):
    futures.blended(3).save(tmp_path / "a.npz")
    loaded = motion.Forecasts.load(tmp_path / "a.npz")
    assert loaded.blend == 3
    names = [[clip.name for clip in each.motion()] for each in (loaded, futures)]
    assert names[0] == [f"{name}-blended" for name in names[1]]
    with np.load(tmp_path / "a.npz") as file:
        np.testing.assert_allclose(file["largest_steps"], loaded.largest_steps())
    for frames, forecasts in ((0, futures), (HORIZON + 1, futures), (3, loaded)):
        with pytest.raises(ValueError, match=f"cannot blend {frames} frames: expected 1 to {HORIZON}"):
            forecasts.blended(frames)


def test_the_command_blends_only_if_asked(run, tmp_path, capsys):
    command = ["forecast", str(run), "--samples", "2", "--out"]
    assert main([*command, str(tmp_path / "a.npz")]) == 0
    assert "before blending" not in capsys.readouterr().err
    assert main([*command, str(tmp_path / "b.npz"), "--blend", "5"]) == 0
    notes = " ".join(capsys.readouterr().err.split())
    plain, blended = (motion.Forecasts.load(tmp_path / name) for name in ("a.npz", "b.npz"))
    assert (plain.blend, blended.blend) == (0, 5)
    np.testing.assert_array_equal(blended.forecasts[:, :, 5:], plain.forecasts[:, :, 5:])
    steps = f"{1000 * blended.largest_steps()[0]:.0f} mm ({1000 * plain.largest_steps()[0]:.0f} mm before blending)"
    assert f"first future frame: {steps}, in the true motion" in notes
    later, before = (1000 * each.largest_steps(6)[0] for each in (blended, plain))  # with the step after the blend
    assert f"in and after 5 blended frames: {later:.0f} mm ({before:.0f} mm before blending)" in notes
    assert main([*command, str(tmp_path / "d.npz"), "--blend", "1"]) == 0
    later = 1000 * motion.Forecasts.load(tmp_path / "d.npz").largest_steps(2)[0]
    assert f"in and after 1 blended frames: {later:.0f} mm" in " ".join(capsys.readouterr().err.split())
    assert main(["evaluate", str(run), "--forecasts", str(tmp_path / "a.npz")]) == 0
    assert main(["evaluate", str(run), "--forecasts", str(tmp_path / "b.npz")]) == 2
    assert "its first 5 steps are blended" in " ".join(capsys.readouterr().err.split())
    assert main([*command, str(tmp_path / "c.npz"), "--blend", "61"]) == 1
    assert "expected 1 to 60 frames" in " ".join(capsys.readouterr().err.split())
