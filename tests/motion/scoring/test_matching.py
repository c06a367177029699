"""Joints by what their names mean, and motion on fewer of them."""

import numpy as np
import pytest
import torch

from dvae.motion import HUMAN36M, HUMANEVA, WALKER, Skeleton, simulate
from dvae.motion.files.smpl import JOINTS
from dvae.motion.geometry.kinematics import forward
from dvae.motion.geometry.rotations import to_matrix
from dvae.motion.naming import sides
from dvae.motion.scoring.matching import Kept, match, parts

SIDED = ("{}Hip", "{}Knee", "{}Foot", "{}Shoulder", "{}Elbow", "{}Wrist")
DIALECTS = {  # the words of SIDED, those of the trunk from pelvis to head, and what surrounds them
    "mixamo": ("UpLeg Leg Foot Arm ForeArm Hand", "Hips Spine Spine2 Neck Head", "mixamorig:Left{}", "mixamorig:{}"),
    "bandai": ("UpperLeg LowerLeg Foot UpperArm LowerArm Hand", "Hips Spine Chest Neck Head", "{}_L", "{}"),
    "daz": ("Thigh Shin Foot Shldr ForeArm Hand", "hip abdomen chest neck head", "l{}", "{}"),
    "acclaim": ("femur tibia foot humerus radius hand", "root upperback thorax lowerneck head", "l{}", "{}"),
    "smpl": ("Hip Knee Ankle Shoulder Elbow Wrist", "Pelvis Spine1 Spine3 Neck Head", "L_{}", "{}"),
    "biped": ("Thigh Calf Foot UpperArm Forearm Hand", "Pelvis Spine Spine2 Neck Head", "Bip01 L {}", "Bip01 {}"),
    "blender": ("thigh shin foot upper_arm forearm hand", "hips spine chest neck head", "{}.L", "{}"),
}
OTHERS = {  # joints that are none of the walker's, though their names are like some
    "mixamo": ["mixamorig:LeftShoulder", "mixamorig:RightShoulder", "mixamorig:LeftToeBase", "mixamorig:Spine1"],
    "bandai": ["Shoulder_L", "Shoulder_R", "Toes_L"],
    "daz": ["lCollar", "rCollar", "lButtock", "rButtock", "lThumb1"],
    "acclaim": ["lhipjoint", "rhipjoint", "lowerback", "lclavicle", "lwrist", "rwrist", "lfingers"],
    "smpl": ["L_Foot", "R_Foot", "L_Collar", "R_Collar", "Spine2"],
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_names_mean_the_same_in_every_dialect(dialect):
    sided, middle, around, alone = DIALECTS[dialect]
    there = dict(zip(("Pelvis", "Spine", "Thorax", "Neck", "Head"), map(alone.format, middle.split()), strict=True))
    right = around.replace("Left", "Right").replace("L", "R") if "L" in around else around.replace("l", "r", 1)
    for side, pattern in (("L", around), ("R", right)):
        there |= {ours.format(side): pattern.format(word) for ours, word in zip(SIDED, sided.split(), strict=True)}
    assert set(there) == set(WALKER.names)
    names = [*OTHERS.get(dialect, []), *there.values()]  # others first, so that order decides nothing
    assert [names[joint] for joint in match(names, WALKER)] == [there[name] for name in WALKER.names]
    assert sides([*there.values()]) == sides([*there])
    assert len(sides([*there])[0]) == len(SIDED)
    skeleton = Skeleton(tuple(there.values()), tuple(range(-1, len(there) - 1)))
    for ours, word in zip(SIDED, sided.split(), strict=True):
        assert skeleton.find(f"left_{word}") == skeleton.names.index(there[ours.format("L")])


def test_sides_are_what_names_differ_in():
    assert sides(["Hips", "LeftArm", "RightArm", "left", "Lowerback"]) == ((1,), (2,))
    assert sides(["a", "lArm", "rArm", "leg_L", "leg_R"]) == ((1, 3), (2, 4))
    assert sides(["ThighL", "ThighR", "UpperLeftArm", "UpperRightArm", "a.l.1", "a.r.1"]) == ((0, 2, 4), (1, 3, 5))


@pytest.mark.parametrize("skeleton", [WALKER, HUMAN36M, HUMANEVA])
def test_a_part_is_one_joint_and_a_skeleton_is_itself(skeleton):
    assert match(skeleton.names, skeleton) == list(range(skeleton.joints))
    found = parts(skeleton.names)
    assert len(set(found.values())) == len(found) == skeleton.joints
    assert len(parts(JOINTS)) == 21  # all but one of the back


def test_ends_that_files_do_not_name_are_what_bones_lead_to():
    names = [name for name in WALKER.names if name not in ("LWrist", "RFoot", "Head")]
    joints = match([*names, "LElbowEnd", "RKneeEnd", "NeckEnd"], WALKER)
    assert [joints[WALKER.find(name)] for name in ("LWrist", "RFoot", "Head")] == [14, 15, 16]


def test_what_is_not_found_is_listed_and_can_be_told():
    names = ["Paw" if name == "LWrist" else name for name in WALKER.names]
    with pytest.raises(ValueError, match=r"no joint matches LWrist of skeleton 'walker'; there are .*Paw"):
        match(names, WALKER)
    assert match(names, WALKER, {"Paw": "LWrist"}) == list(range(17))
    for told, message in (({"Pfote": "LWrist"}, "no joint 'Pfote'"), ({"Paw": "Wrist"}, "has no joint 'Wrist'")):
        with pytest.raises(ValueError, match=message):
            match(names, WALKER, told)


def test_kept_joints_hang_from_the_nearest_kept_ancestor():
    kept = Kept.of(WALKER.names, WALKER.parents, ["Pelvis", "LFoot", "LHip", "Head"])
    assert kept.parents == (-1, 2, 0, 0)
    renamed = Kept.of(WALKER.names, WALKER.parents, {"Pelvis": "hips", "Head": "top"})
    assert (renamed.names, renamed.parents) == (("hips", "top"), (-1, 0))
    assert Kept.of(WALKER.names, WALKER.parents, [3, 0]).names == ("RFoot", "Pelvis")
    for wrong, message in (
        (["LFoot", "RFoot"], "their roots are LFoot, RFoot"),
        (["Leg"], "no joint 'Leg'"),
        ([0, 0], "is not one of 17, or occurs twice"),
    ):
        with pytest.raises(ValueError, match=message):
            Kept.of(WALKER.names, WALKER.parents, wrong)


def test_rotations_of_kept_joints_make_the_same_motion_or_there_are_none():
    people = simulate(1, 40).with_rotations()
    clip, double = people.clips[0], people.skeleton
    # the thighs alone bend nothing where they are joined to the pelvis
    kept = Kept.of(double.names, double.parents, [n for n in double.names if n not in ("LWrist", "Head", "RFoot")])
    places, turns, offsets = kept.motion(double.parents, clip.positions.astype(float), clip.rotations)
    root = torch.from_numpy(places[:, 0])
    made, _ = forward(kept.parents, to_matrix(torch.from_numpy(turns), "quaternion"), torch.from_numpy(offsets), root)
    np.testing.assert_allclose(made.numpy(), places, atol=1e-3)
    bent = Kept.of(double.names, double.parents, [n for n in double.names if n not in ("LKnee", "RKnee")])
    assert bent.motion(double.parents, clip.positions.astype(float), clip.rotations)[1:] == (None, None)
