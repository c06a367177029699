"""Joints matched by the meaning of their names, and motion reduced to fewer joints."""

import numpy as np
import pytest
import torch

from dvae.motion import HUMAN36M, HUMANEVA, WALKER, Skeleton, simulate
from dvae.motion.files.smpl import JOINTS
from dvae.motion.geometry.kinematics import forward
from dvae.motion.geometry.rotations import to_matrix
from dvae.motion.naming import sides
from dvae.motion.scoring.matching import JointSubset, match, parts

SIDED = ("{}Hip", "{}Knee", "{}Foot", "{}Shoulder", "{}Elbow", "{}Wrist")
DIALECTS = {  # words for SIDED, words for the trunk from pelvis to head, and templates around them
    "mixamo": ("UpLeg Leg Foot Arm ForeArm Hand", "Hips Spine Spine2 Neck Head", "mixamorig:Left{}", "mixamorig:{}"),
    "bandai": ("UpperLeg LowerLeg Foot UpperArm LowerArm Hand", "Hips Spine Chest Neck Head", "{}_L", "{}"),
    "daz": ("Thigh Shin Foot Shldr ForeArm Hand", "hip abdomen chest neck head", "l{}", "{}"),
    "acclaim": ("femur tibia foot humerus radius hand", "root upperback thorax lowerneck head", "l{}", "{}"),
    "smpl": ("Hip Knee Ankle Shoulder Elbow Wrist", "Pelvis Spine1 Spine3 Neck Head", "L_{}", "{}"),
    "biped": ("Thigh Calf Foot UpperArm Forearm Hand", "Pelvis Spine Spine2 Neck Head", "Bip01 L {}", "Bip01 {}"),
    "blender": ("thigh shin foot upper_arm forearm hand", "hips spine chest neck head", "{}.L", "{}"),
}
OTHERS = {  # joints with similar names that the walker does not have
    "mixamo": ["mixamorig:LeftShoulder", "mixamorig:RightShoulder", "mixamorig:LeftToeBase", "mixamorig:Spine1"],
    "bandai": ["Shoulder_L", "Shoulder_R", "Toes_L"],
    "daz": ["lCollar", "rCollar", "lButtock", "rButtock", "lThumb1"],
    "acclaim": ["lhipjoint", "rhipjoint", "lowerback", "lclavicle", "lwrist", "rwrist", "lfingers"],
    "smpl": ["L_Foot", "R_Foot", "L_Collar", "R_Collar", "Spine2"],
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_joints_are_matched_in_every_dialect(dialect):
    sided, middle, around, template = DIALECTS[dialect]
    translated = dict(
        zip(("Pelvis", "Spine", "Thorax", "Neck", "Head"), map(template.format, middle.split()), strict=True)
    )
    right = around.replace("Left", "Right").replace("L", "R") if "L" in around else around.replace("l", "r", 1)
    for side, pattern in (("L", around), ("R", right)):
        translated |= {key.format(side): pattern.format(word) for key, word in zip(SIDED, sided.split(), strict=True)}
    assert set(translated) == set(WALKER.names)
    names = [*OTHERS.get(dialect, []), *translated.values()]  # others first, to test independence of the order
    assert [names[joint] for joint in match(names, WALKER)] == [translated[name] for name in WALKER.names]
    assert sides([*translated.values()]) == sides([*translated])
    assert len(sides([*translated])[0]) == len(SIDED)
    skeleton = Skeleton(tuple(translated.values()), tuple(range(-1, len(translated) - 1)))
    for key, word in zip(SIDED, sided.split(), strict=True):
        assert skeleton.find(f"left_{word}") == skeleton.names.index(translated[key.format("L")])


def test_sides_are_inferred_from_names():
    assert sides(["Hips", "LeftArm", "RightArm", "left", "Lowerback"]) == ((1,), (2,))
    assert sides(["a", "lArm", "rArm", "leg_L", "leg_R"]) == ((1, 3), (2, 4))
    assert sides(["ThighL", "ThighR", "UpperLeftArm", "UpperRightArm", "a.l.1", "a.r.1"]) == ((0, 2, 4), (1, 3, 5))


@pytest.mark.parametrize("skeleton", [WALKER, HUMAN36M, HUMANEVA])
def test_each_part_is_one_joint_and_a_skeleton_matches_itself(skeleton):
    assert match(skeleton.names, skeleton) == list(range(skeleton.joints))
    joints = parts(skeleton.names)
    assert len(set(joints.values())) == len(joints) == skeleton.joints
    assert len(parts(JOINTS)) == 21  # except one joint of the back


def test_unnamed_end_joints_are_named_by_their_bones():
    names = [name for name in WALKER.names if name not in ("LWrist", "RFoot", "Head")]
    joints = match([*names, "LElbowEnd", "RKneeEnd", "NeckEnd"], WALKER)
    assert [joints[WALKER.find(name)] for name in ("LWrist", "RFoot", "Head")] == [14, 15, 16]


def test_unmatched_joints_are_listed_and_can_be_given():
    names = ["Paw" if name == "LWrist" else name for name in WALKER.names]
    with pytest.raises(ValueError, match=r"no joint matches LWrist of skeleton 'walker'; there are .*Paw"):
        match(names, WALKER)
    assert match(names, WALKER, {"Paw": "LWrist"}) == list(range(17))
    for corrections, message in (({"Pfote": "LWrist"}, "no joint 'Pfote'"), ({"Paw": "Wrist"}, "has no joint 'Wrist'")):
        with pytest.raises(ValueError, match=message):
            match(names, WALKER, corrections)


def test_the_parent_of_a_kept_joint_is_its_nearest_kept_ancestor():
    reduction = JointSubset.of(WALKER.names, WALKER.parents, ["Pelvis", "LFoot", "LHip", "Head"])
    assert reduction.parents == (-1, 2, 0, 0)
    renamed = JointSubset.of(WALKER.names, WALKER.parents, {"Pelvis": "hips", "Head": "top"})
    assert (renamed.names, renamed.parents) == (("hips", "top"), (-1, 0))
    assert JointSubset.of(WALKER.names, WALKER.parents, [3, 0]).names == ("RFoot", "Pelvis")
    for wrong, message in (
        (["LFoot", "RFoot"], "now there are the roots LFoot, RFoot"),
        (["Leg"], "no joint 'Leg'"),
        ([0, 0], "is not one of the 17 joints, or is selected twice"),
    ):
        with pytest.raises(ValueError, match=message):
            JointSubset.of(WALKER.names, WALKER.parents, wrong)


def test_rotations_of_kept_joints_give_the_same_motion_or_are_dropped():
    people = simulate(1, 40).with_rotations()
    clip, double = people.clips[0], people.skeleton
    # with only the thighs, nothing bends at the pelvis
    reduction = JointSubset.of(
        double.names, double.parents, [n for n in double.names if n not in ("LWrist", "Head", "RFoot")]
    )
    places, quaternions, offsets = reduction.motion(double.parents, clip.positions.astype(float), clip.rotations)
    root = torch.from_numpy(places[:, 0])
    positions, _ = forward(
        reduction.parents, to_matrix(torch.from_numpy(quaternions), "quaternion"), torch.from_numpy(offsets), root
    )
    np.testing.assert_allclose(positions.numpy(), places, atol=1e-3)
    bent = JointSubset.of(double.names, double.parents, [n for n in double.names if n not in ("LKnee", "RKnee")])
    assert bent.motion(double.parents, clip.positions.astype(float), clip.rotations)[1:] == (None, None)
