"""Segments as time-stamped frames, and conversion back to motion."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline

from dvae.motion import MotionSet, TimedFrames, reference_cycles, simulate
from dvae.motion.geometry import kinematics, rotations
from dvae.motion.geometry.skeleton import rotate_about_up
from dvae.motion.segments.frames import HEADING, OFFSETS, _cubic, resting_offsets


@pytest.fixture(scope="module")
def people():
    return simulate(clips=6, frames=91, seed=3).with_rotations()


def largest(motion, restored):
    """Return the largest joint error in metres between equally long clips."""
    assert [clip.frames for clip in motion] == [clip.frames for clip in restored]
    return max(np.linalg.norm(a.positions - b.positions, axis=-1).max() for a, b in zip(motion, restored, strict=True))


@pytest.mark.parametrize("frames", [2, 3, 31, 91])
def test_motion_and_rotations_are_recovered_within_two_millimetres(people, frames):
    some = replace(people, clips=[clip.between(0, frames) for clip in people])
    view = TimedFrames.of(some)
    batch = view.to(some)
    back = view.back(batch)
    assert largest(some, back) < 2e-3
    for clip, offsets in zip(back, batch[OFFSETS], strict=True):
        matrices = rotations.to_matrix(torch.from_numpy(clip.rotations), "quaternion")
        root = torch.from_numpy(clip.positions[:, people.skeleton.root])
        positions, _ = kinematics.forward(people.skeleton.parents, matrices, offsets, root)
        np.testing.assert_allclose(positions.numpy(), clip.positions, atol=1e-5)


@pytest.mark.parametrize("frames", [2, 3, 4, 40])
def test_interpolation_in_time_equals_a_cubic_spline(frames):
    rng = np.random.default_rng(frames)
    times, values = np.cumsum(rng.uniform(0.5, 2, frames)), rng.normal(size=(frames, 7))
    sampled_times = np.sort(rng.uniform(times[0], times[-1], 100))
    np.testing.assert_allclose(
        _cubic(times, sampled_times).numpy() @ values, CubicSpline(times, values)(sampled_times), atol=1e-10
    )
    np.testing.assert_allclose(_cubic(times, times), np.eye(frames), atol=1e-12)


@pytest.mark.parametrize("warped", [False, True])
def test_a_batch_of_segments_equals_the_single_segments(people, warped):
    clips = [clip.between(0, frames) for clip, frames in zip(people, (40, 31, 40, 2, 31, 40), strict=True)]
    some = replace(people, clips=clips[:3] + clips[4:] if warped else clips)
    references = reference_cycles(simulate(clips=16, frames=150, seed=1).with_rotations()) if warped else ()
    view = TimedFrames.of(some, references=references)
    together, separate = view.to(some), [view.to(replace(some, clips=[clip])) for clip in some]
    for name, value in together.items():
        torch.testing.assert_close(value, torch.cat([each[name] for each in separate]), atol=1e-6, rtol=0)
    torch.testing.assert_close(resting_offsets(some).float(), together[OFFSETS], atol=0, rtol=0)


def test_only_the_heading_of_the_first_frame_is_removed(people):
    view = TimedFrames.of(people)
    batch = view.to(people)
    angles, shift = torch.linspace(-3, 3, len(people)), np.float32([1.0, 0.2, -2.0])
    rotated = []
    for clip, angle in zip(people, angles, strict=True):
        positions = rotate_about_up(torch.from_numpy(clip.positions), angle.expand(91, 1), "y").numpy() + shift
        rotated.append(replace(clip, positions=positions, rotations=None))
    again = view.to(MotionSet(rotated, people.skeleton).with_rotations())
    torch.testing.assert_close(again["x"], batch["x"], atol=1e-4, rtol=0)
    differences = again[HEADING] - batch[HEADING] - angles
    torch.testing.assert_close(torch.cos(differences), torch.ones(len(people)))
    faced = view.back({"x": batch["x"], OFFSETS: batch[OFFSETS]})
    assert people.skeleton.heading(torch.from_numpy(faced.clips[0].positions[0])).abs() < 1e-3


def test_scaled_deviations_are_one_and_warped_time_is_recovered(people):
    view = TimedFrames.of(people, scaling="deviation")
    matrices = view.to(people)["x"][..., view.parts["rotations"]].flatten(0, 1)
    torch.testing.assert_close(matrices.mean(0), torch.zeros(view.size - 4), atol=1e-3, rtol=0)
    moving = torch.tensor(view.deviation) > 1e-3
    assert moving.sum() > 50
    torch.testing.assert_close(matrices.std(0, correction=0)[moving], torch.ones(int(moving.sum())), atol=1e-3, rtol=0)
    assert largest(people, view.back(view.to(people))) < 2e-3

    references = reference_cycles(simulate(clips=16, frames=150, seed=1).with_rotations())
    some = replace(people, clips=[clip.between(0, 31) for clip in people])
    warped = TimedFrames.of(some, references=references)
    batch = warped.to(some)
    pace = batch["x"][:, 1:, -1] * warped.seconds  # 1 at uniform times
    assert pace.min() >= 0.5 - 1e-4
    assert pace.max() <= 2 + 1e-4
    assert pace.std() > 0.1
    torch.testing.assert_close(warped.lasts(batch["x"]), torch.ones(len(some)))
    assert largest(some, warped.back(batch)) < 2e-3


def test_invalid_segments_are_errors(people):
    view, skeleton = TimedFrames.of(people), people.skeleton
    bare = MotionSet([replace(clip, rotations=None) for clip in people], skeleton)
    stranger = replace(people, skeleton=replace(skeleton, names=tuple(map(str, range(17)))))
    incomplete = torch.zeros(1, 100, 76).index_put((torch.tensor(0),) * 3, torch.tensor(torch.nan))
    for call, message in (
        (lambda: view.to(bare), r"train/person_0000 has no rotations of joints; MotionSet.with_rotations"),
        (lambda: view.to(replace(people, clips=[people.clips[0].between(4, 5)])), "has 1 frame, expected at least 2"),
        (lambda: view.to(stranger), "on_common_joints maps two sources to one tree"),
        (lambda: view.back({"x": torch.zeros(1, 99, 76)}), r"expected \(..., 100, 76\)"),
        (lambda: view.back({"x": incomplete}), "x has 1 NaN or infinite values; all must be finite"),
        (lambda: TimedFrames(replace(skeleton, rest=())), "has no rest pose"),
        (lambda: TimedFrames(replace(skeleton, left=(), right=())), "has no left and right joints"),
        (lambda: TimedFrames(skeleton, mean=(0.0,)), "expected 6 for each of 12 joints"),
        (lambda: TimedFrames(skeleton, frames=1), "frames must be at least 2, got 1"),
        (lambda: TimedFrames.of(people, scaling="centred"), "expected 'identity' or 'deviation'"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_independently_bending_bones_of_a_joint_get_their_own_joints(people):
    bent = [clip.positions.copy() for clip in people]
    skeleton = people.skeleton
    spine, upper = skeleton.names.index("Spine"), ("Spine", "Thorax", "Neck", "Head")
    duplicated = [
        j for j, name in enumerate(skeleton.names) if name in upper or name[1:] in ("Shoulder", "Elbow", "Wrist")
    ]
    for positions in bent:
        angle = torch.linspace(-0.5, 0.5, 91)[:, None].expand(91, len(duplicated))
        pelvis = positions[:, :1]
        ahead = torch.from_numpy(positions[:, duplicated] - pelvis)[..., [1, 2, 0]]  # about x
        positions[:, duplicated] = rotate_about_up(ahead, angle, "z")[..., [2, 0, 1]].numpy() + pelvis
    clips = [replace(clip, positions=x, rotations=None) for clip, x in zip(people, bent, strict=True)]
    motion = MotionSet(clips, replace(skeleton, rest=()))
    loose = motion.with_extra_joints()
    assert loose.skeleton.names == (*skeleton.names, "Pelvis-Spine")
    assert loose.skeleton.parents[spine] == 17
    assert loose.skeleton.heading(torch.from_numpy(loose.clips[0].positions)).equal(
        motion.skeleton.heading(torch.from_numpy(motion.clips[0].positions))
    )
    bent, straight = motion.with_rotations(), loose.with_rotations()
    views = [TimedFrames.of(each) for each in (bent, straight)]
    off = [largest(each, view.back(view.to(each))) for each, view in zip((bent, straight), views, strict=True)]
    assert off[1] < 2e-3 < 0.02 < off[0]
    with pytest.raises(ValueError, match="has rotations; joints can only be added to complete poses"):
        people.with_extra_joints()
