"""Segments as time-stamped frames, and back to motion."""

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


def largest(motion, made):
    """Metres that a joint is off, of equally long clips."""
    assert [clip.frames for clip in motion] == [clip.frames for clip in made]
    return max(np.linalg.norm(a.positions - b.positions, axis=-1).max() for a, b in zip(motion, made, strict=True))


@pytest.mark.parametrize("frames", [2, 3, 31, 91])
def test_motion_comes_back_within_two_millimetres_and_its_turns_agree_with_it(people, frames):
    some = replace(people, clips=[clip.between(0, frames) for clip in people])
    view = TimedFrames.of(some)
    seen = view.to(some)
    back = view.back(seen)
    assert largest(some, back) < 2e-3
    for clip, offsets in zip(back, seen[OFFSETS], strict=True):
        turns = rotations.to_matrix(torch.from_numpy(clip.rotations), "quaternion")
        root = torch.from_numpy(clip.positions[:, people.skeleton.root])
        made, _ = kinematics.forward(people.skeleton.parents, turns, offsets, root)
        np.testing.assert_allclose(made.numpy(), clip.positions, atol=1e-5)


@pytest.mark.parametrize("frames", [2, 3, 4, 40])
def test_the_way_from_times_to_others_is_that_of_a_cubic_spline(frames):
    rng = np.random.default_rng(frames)
    times, values = np.cumsum(rng.uniform(0.5, 2, frames)), rng.normal(size=(frames, 7))
    at = np.sort(rng.uniform(times[0], times[-1], 100))
    np.testing.assert_allclose(_cubic(times, at).numpy() @ values, CubicSpline(times, values)(at), atol=1e-10)
    np.testing.assert_allclose(_cubic(times, times), np.eye(frames), atol=1e-12)


@pytest.mark.parametrize("warped", [False, True])
def test_segments_together_are_seen_as_each_alone(people, warped):
    clips = [clip.between(0, frames) for clip, frames in zip(people, (40, 31, 40, 2, 31, 40), strict=True)]
    some = replace(people, clips=clips[:3] + clips[4:] if warped else clips)
    references = reference_cycles(simulate(clips=16, frames=150, seed=1).with_rotations()) if warped else ()
    view = TimedFrames.of(some, references=references)
    together, alone = view.to(some), [view.to(replace(some, clips=[clip])) for clip in some]
    for name, value in together.items():
        torch.testing.assert_close(value, torch.cat([each[name] for each in alone]), atol=1e-6, rtol=0)
    torch.testing.assert_close(resting_offsets(some).float(), together[OFFSETS], atol=0, rtol=0)


def test_the_heading_alone_is_taken_from_the_first_frame(people):
    view = TimedFrames.of(people)
    seen = view.to(people)
    angles, shift = torch.linspace(-3, 3, len(people)), np.float32([1.0, 0.2, -2.0])
    turned = []
    for clip, angle in zip(people, angles, strict=True):
        positions = rotate_about_up(torch.from_numpy(clip.positions), angle.expand(91, 1), "y").numpy() + shift
        turned.append(replace(clip, positions=positions, rotations=None))
    again = view.to(MotionSet(turned, people.skeleton).with_rotations())
    torch.testing.assert_close(again["x"], seen["x"], atol=1e-4, rtol=0)
    apart = again[HEADING] - seen[HEADING] - angles
    torch.testing.assert_close(torch.cos(apart), torch.ones(len(people)))
    faced = view.back({"x": seen["x"], OFFSETS: seen[OFFSETS]})
    assert people.skeleton.heading(torch.from_numpy(faced.clips[0].positions[0])).abs() < 1e-3


def test_deviations_are_one_and_warped_time_comes_back(people):
    view = TimedFrames.of(people, scaling="deviation")
    turns = view.to(people)["x"][..., view.parts["rotations"]].flatten(0, 1)
    torch.testing.assert_close(turns.mean(0), torch.zeros(view.size - 4), atol=1e-3, rtol=0)
    moving = torch.tensor(view.deviation) > 1e-3
    assert moving.sum() > 50
    torch.testing.assert_close(turns.std(0, correction=0)[moving], torch.ones(int(moving.sum())), atol=1e-3, rtol=0)
    assert largest(people, view.back(view.to(people))) < 2e-3

    references = reference_cycles(simulate(clips=16, frames=150, seed=1).with_rotations())
    some = replace(people, clips=[clip.between(0, 31) for clip in people])
    warped = TimedFrames.of(some, references=references)
    seen = warped.to(some)
    pace = seen["x"][:, 1:, -1] * warped.seconds  # 1 where time is even
    assert pace.min() >= 0.5 - 1e-4
    assert pace.max() <= 2 + 1e-4
    assert pace.std() > 0.1
    torch.testing.assert_close(warped.lasts(seen["x"]), torch.ones(len(some)))
    assert largest(some, warped.back(seen)) < 2e-3


def test_what_is_no_segment_is_refused(people):
    view, skeleton = TimedFrames.of(people), people.skeleton
    bare = MotionSet([replace(clip, rotations=None) for clip in people], skeleton)
    stranger = replace(people, skeleton=replace(skeleton, names=tuple(map(str, range(17)))))
    lost = torch.zeros(1, 100, 76).index_put((torch.tensor(0),) * 3, torch.tensor(torch.nan))
    for call, message in (
        (lambda: view.to(bare), r"train/person_0000 has no rotations of joints; MotionSet.with_rotations"),
        (lambda: view.to(replace(people, clips=[people.clips[0].between(4, 5)])), "has 1 frame, expected at least 2"),
        (lambda: view.to(stranger), "on_common_joints maps two sources to one tree"),
        (lambda: view.back({"x": torch.zeros(1, 99, 76)}), r"expected \(..., 100, 76\)"),
        (lambda: view.back({"x": lost}), "1 of the numbers of frames are NaN or infinite"),
        (lambda: TimedFrames(replace(skeleton, rest=())), "has no rest pose"),
        (lambda: TimedFrames(replace(skeleton, left=(), right=())), "has no left and right joints"),
        (lambda: TimedFrames(skeleton, mean=(0.0,)), "expected 6 for each of 12 joints"),
        (lambda: TimedFrames(skeleton, frames=1), "frames must be at least 2, got 1"),
        (lambda: TimedFrames.of(people, scaling="centred"), "expected 'identity' or 'deviation'"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_bones_that_leave_one_joint_and_bend_get_joints_of_their_own(people):
    bent = [clip.positions.copy() for clip in people]
    skeleton = people.skeleton
    spine, upper = skeleton.names.index("Spine"), ("Spine", "Thorax", "Neck", "Head")
    moved = [j for j, name in enumerate(skeleton.names) if name in upper or name[1:] in ("Shoulder", "Elbow", "Wrist")]
    for positions in bent:
        angle = torch.linspace(-0.5, 0.5, 91)[:, None].expand(91, len(moved))
        pelvis = positions[:, :1]
        ahead = torch.from_numpy(positions[:, moved] - pelvis)[..., [1, 2, 0]]  # about x
        positions[:, moved] = rotate_about_up(ahead, angle, "z")[..., [2, 0, 1]].numpy() + pelvis
    clips = [replace(clip, positions=x, rotations=None) for clip, x in zip(people, bent, strict=True)]
    motion = MotionSet(clips, replace(skeleton, rest=()))
    loose = motion.loosened()
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
        people.loosened()
