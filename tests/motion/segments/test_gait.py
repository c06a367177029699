"""Gait cycles: found for either foot, with bounded length and overlap."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch

from dvae.motion import Clip, Cycles, MotionSet, Skeleton, gait_cycles, reference_cycles, simulate
from dvae.motion.geometry import kinematics, rotations
from dvae.motion.segments.gait import _deviations, find_cycles, on_common_joints

SKELETON = simulate(clips=4, frames=60).with_rotations().skeleton


def walk(seconds=5.0, period=1.0, swing=0.4, fps=30.0, start=0.0, name="walk"):
    """Return a walk whose left thigh is furthest forward at the start and after each period, the right one between."""
    time = torch.arange(round(seconds * fps) + 1, dtype=torch.float64) / fps
    phase = 2 * torch.pi * time / period + start
    vectors = torch.zeros(len(time), SKELETON.joints, 3, dtype=torch.float64)
    for side, side_phase in (("L", phase), ("R", phase + torch.pi)):
        vectors[:, SKELETON.names.index(f"{side}Hip"), 0] = -swing * side_phase.cos()
        vectors[:, SKELETON.names.index(f"{side}Knee"), 0] = swing * (1 - side_phase.sin())
    matrices = rotations.to_matrix(vectors, "vector")
    root = torch.stack([0 * time, 1 + 0 * time, time], -1)
    positions, _ = kinematics.forward(SKELETON.parents, matrices, SKELETON.offsets, root)
    quaternions = rotations.from_matrix(matrices, "quaternion").numpy()
    return Clip("train", name, positions.numpy(), {"content": "walk"}, rotations=quaternions)


def of(*clips, fps=30.0):
    return MotionSet(clips, replace(SKELETON, fps=fps), "people")


@pytest.mark.parametrize("period", [0.7, 1.6])
def test_a_walk_is_cut_into_cycles_of_its_period_for_either_foot(period):
    people = of(walk(period=period, seconds=5 * period))
    left, right = reference_cycles(people)
    assert (left.side, right.side) == ("left", "right")
    assert left.seconds == pytest.approx(period, abs=1 / 30 + 1e-9)
    cycles = find_cycles(people.clips[0], people.skeleton, (left, right), Cycles())
    for side, first, many in (("left", 0.0, 5), ("right", 0.5, 4)):
        side_cycles = [cycle for cycle in cycles if cycle.side == side]
        assert len(side_cycles) == many
        starts = np.array([cycle.first for cycle in side_cycles])
        np.testing.assert_allclose(starts, 30 * period * (first + np.arange(many)), atol=2)
        np.testing.assert_allclose([cycle.last - cycle.first for cycle in side_cycles], 30 * period, atol=2)
        assert max(cycle.cost for cycle in side_cycles) < 0.05


def test_standing_and_moving_one_leg_give_no_cycles():
    references = reference_cycles(of(walk()))
    still = walk(swing=0.0)
    assert not find_cycles(still, SKELETON, references, Cycles())
    assert not find_cycles(walk(seconds=0.6), SKELETON, references, Cycles())  # half a cycle
    lame = walk().rotations.copy()
    lame[:, [SKELETON.names.index(f"{side}Hip") for side in "LR"]] = (1.0, 0, 0, 0)
    assert not find_cycles(replace(walk(), rotations=lame), SKELETON, references, Cycles())
    with pytest.raises(ValueError, match=r"people has no gait cycle of 0.3 to 3 s whose hips are within 0.25 rad"):
        gait_cycles(of(still), references)
    with pytest.raises(
        ValueError,
        match=r"no clip of people is a regular walk, with thighs that swing by at least 0.2 rad.* references=",
    ):
        reference_cycles(of(still))


@pytest.mark.parametrize(("shortest", "longest", "share"), [(0.3, 3.0, 0.1), (0.8, 1.5, 0.0), (0.3, 0.9, 0.5)])
def test_cycles_respect_limits_of_length_and_overlap(shortest, longest, share):
    people = simulate(clips=6, frames=150, seed=1).with_rotations()
    references = reference_cycles(people)
    limits = Cycles(threshold=0.4, shortest=shortest, longest=longest, overlap=share)
    for clip in people:
        cycles = find_cycles(clip, people.skeleton, references, limits)
        assert all(shortest * 30 - 1e-6 <= cycle.last - cycle.first <= longest * 30 + 1e-6 for cycle in cycles)
        for side in ("left", "right"):
            for one, other in combinations([cycle for cycle in cycles if cycle.side == side], 2):
                shared = min(one.last, other.last) - max(one.first, other.first)
                assert shared <= share * min(one.last - one.first, other.last - other.first)


def test_the_frame_rate_changes_no_cycles():
    people = of(walk(fps=120.0), fps=120.0)
    references = reference_cycles(people)
    assert [len(reference.hips) for reference in references] == pytest.approx([31, 31], abs=1)
    starts = [cycle.first / 120 for cycle in find_cycles(people.clips[0], people.skeleton, references, Cycles())]
    np.testing.assert_allclose(starts, np.arange(9) / 2, atol=2 / 30)


def test_cycles_are_clips_with_their_source():
    people = of(walk(), replace(walk(period=1.2, name="later"), split="test"))
    segments = gait_cycles(people, cycles=Cycles(threshold=0.1))
    assert segments.splits == ["train", "test"]
    for segment in segments:
        assert segment.labels["content"] == "walk"
        source = people[segment.split, segment.labels["source"]]
        start = int(segment.labels["start"])
        np.testing.assert_array_equal(segment.positions, source.positions[start : start + segment.frames])
        np.testing.assert_array_equal(segment.rotations, source.rotations[start : start + segment.frames])
        assert float(segment.labels["cost"]) < 0.1
    assert {segment.labels["cycle"] for segment in segments} == {"left", "right"}


def test_reference_cycles_are_typical_training_cycles():
    odd = walk(swing=0.7, name="odd")
    people = of(walk(), walk(start=1.0, name="second"), odd, replace(walk(swing=0.9, name="held out"), split="test"))
    assert {reference.source for reference in reference_cycles(people)} <= {("train", "walk"), ("train", "second")}


def test_motion_that_cannot_be_cut_is_an_error():
    people = of(walk())
    references, clip = reference_cycles(people), people.clips[0]
    assert not find_cycles(clip.between(0, 1), SKELETON, references, Cycles())
    armless = Skeleton(("Root", "LHip", "RHip"), (-1, 0, 0), (1,), (2,), rest=(0, 0, 0, 0.1, 0, 0, -0.1, 0, 0))
    bare = MotionSet([replace(clip, rotations=None)], SKELETON)
    for call, message in (
        (lambda: find_cycles(clip, replace(SKELETON, rest=()), references, Cycles()), "has no rest pose"),
        (lambda: find_cycles(clip, replace(SKELETON, left=()), references, Cycles()), "has no left and right joints"),
        (
            lambda: find_cycles(clip, armless, references, Cycles()),
            "has no joint below LHip, so leg swings cannot be measured",
        ),
        (
            lambda: gait_cycles(bare, references),
            r"clip train/walk has no rotations of joints; MotionSet.with_rotations",
        ),
        (
            lambda: gait_cycles(people, references, Cycles(rate=25.0)),
            "a reference has 30 frames a second, but `cycles` compares at 25",
        ),
        (lambda: Cycles(shortest=2.0, longest=1.0), "`shortest` must be at most `longest`"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_two_sources_share_a_tree_and_keep_their_rest_poses(real):
    bandai, cmu = real("bandai/bandai2.npz"), real("cmu/cmu8.npz")
    bandai = MotionSet([clip for clip in bandai if clip.labels["content"] == "walk"][::40], bandai.skeleton, "bandai")
    cmu = MotionSet([clip for clip in cmu if clip.labels["content"] == "walking"][::4], cmu.skeleton, "cmu")
    first, second = on_common_joints(bandai, cmu)
    assert (first.skeleton.names, first.skeleton.parents) == (second.skeleton.names, second.skeleton.parents)
    assert first.skeleton.rest != second.skeleton.rest
    assert [clip.key for clip in second] == [clip.key for clip in cmu]
    for motion, source in ((first, bandai), (second, cmu)):
        shared = [name for name in motion.skeleton.names if name in source.skeleton.names]
        assert len(shared) == 19
        source_joints, motion_joints = (
            [each.names.index(name) for name in shared] for each in (source.skeleton, motion.skeleton)
        )
        np.testing.assert_array_equal(
            motion.clips[0].positions[:, motion_joints], source.clips[0].positions[:, source_joints]
        )
        assert len(gait_cycles(motion)) > 4 * len(motion) / 2


def test_deviations_of_an_angle_equal_their_definition():
    angle = np.random.default_rng(0).normal(3, 1, 20)
    deviations = _deviations(angle, 6)
    for start, count in ((0, 1), (0, 6), (7, 4), (14, 6)):
        assert deviations[start, count - 1] == pytest.approx(angle[start : start + count].std(), abs=1e-7)
    assert (deviations[15, 5:] == 0).all()
