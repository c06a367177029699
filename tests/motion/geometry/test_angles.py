from dataclasses import replace

import pytest
import torch

from dvae.motion import (
    HUMAN36M,
    HUMANEVA,
    WALKER,
    AngleLimits,
    Skeleton,
    estimate_angle_limits,
)
from dvae.motion.geometry.angles import angle_names, cosines
from dvae.motion.geometry.parts import body_parts

# A person facing +z with y up and left towards +x, arms hanging, legs straight, metres.
STANDING = {
    "Pelvis": (0, 0, 0),
    "RHip": (-0.1, 0, 0),
    "RKnee": (-0.1, -0.4, 0),
    "RFoot": (-0.1, -0.8, 0),
    "LHip": (0.1, 0, 0),
    "LKnee": (0.1, -0.4, 0),
    "LFoot": (0.1, -0.8, 0),
    "Spine": (0, 0.2, 0),
    "Thorax": (0, 0.4, 0),
    "Neck": (0, 0.5, 0),
    "Head": (0, 0.6, 0.1),
    "LShoulder": (0.2, 0.4, 0),
    "LElbow": (0.2, 0.1, 0),
    "LWrist": (0.2, -0.2, 0),
    "RShoulder": (-0.2, 0.4, 0),
    "RElbow": (-0.2, 0.1, 0),
    "RWrist": (-0.2, -0.2, 0),
}
# The same for the skeletons with ankles, toes and Spine, Chest, Neck.
UPRIGHT = {
    **{name: at for name, at in STANDING.items() if name not in ("LFoot", "RFoot", "Thorax", "Neck", "Head")},
    **{"LAnkle": (0.1, -0.8, 0), "LToe": (0.1, -0.8, 0.1), "RAnkle": (-0.1, -0.8, 0), "RToe": (-0.1, -0.8, 0.1)},
    **{
        "Chest": (0, 0.3, 0),
        "Neck": (0, 0.4, 0),
        "UpperNeck": (0, 0.5, 0),
        "Head": (0, 0.6, 0),
        "HeadTop": (0, 0.7, 0),
    },
    **{"LClavicle": (0.05, 0.4, 0), "RClavicle": (-0.05, 0.4, 0)},
}
TREES = {
    "cmu21": "Pelvis LHip LKnee LAnkle LToe RHip RKnee RAnkle RToe Spine Chest Neck UpperNeck Head HeadTop LShoulder "
    "LElbow LWrist RShoulder RElbow RWrist",
    "bandai21": "Pelvis LHip LKnee LAnkle LToe RHip RKnee RAnkle RToe Spine Chest Neck Head LClavicle LShoulder LElbow "
    "LWrist RClavicle RShoulder RElbow RWrist",
}
SKELETONS = {s.name: s for s in (HUMAN36M, WALKER, HUMANEVA)} | {
    name: Skeleton(
        tuple(joints.split()), (-1, *[0] * (len(joints.split()) - 1)), name=name
    )  # angles do not depend on parents
    for name, joints in TREES.items()
}
every_skeleton = pytest.mark.parametrize("skeleton", SKELETONS.values(), ids=list(SKELETONS))


def pose(skeleton, base=STANDING, **moved):
    """Return (D,) without the root."""
    places = base | moved
    return torch.tensor([places[name] for name in skeleton.names[1:]], dtype=torch.float64).flatten()


def angles(poses, skeleton):
    """Return the cosines by name, left first."""
    values = cosines(poses, skeleton)
    names = angle_names(skeleton)
    return {name: [values[i].item() for i, other in enumerate(names) if other == name] for name in names}


def random_poses(skeleton, *shape):
    return torch.randn(*shape, 3 * (skeleton.joints - 1), dtype=torch.float64)


def swapped_sides(skeleton):
    """Return for each joint the joint of the other side."""
    other = {"L": "R", "R": "L"}
    return [skeleton.names.index(other.get(name[0], name[0]) + name[1:]) for name in skeleton.names]


class TestCosines:
    @pytest.mark.parametrize("name", TREES)
    def test_of_an_upright_person_with_ankles_and_toes(self, name):
        skeleton = SKELETONS[name]
        bent = {"LAnkle": (0.1, -0.4, -0.4), "LToe": (0.1, -0.5, -0.4)}
        arm = {"RElbow": (-0.2, 0.4, 0.3), "RWrist": (-0.2, 0.7, 0.3)}
        cosines = angles(pose(skeleton, UPRIGHT, **bent, **arm), skeleton)
        assert cosines["Shank2Thigh"] == pytest.approx([0, 1])
        assert cosines["Shank2ThighPlane"] == pytest.approx([1, 0])
        assert cosines["Foot2Shank"] == pytest.approx([0, 0])
        assert cosines["Foot2ThighPlane"] == pytest.approx([0, -1])
        assert cosines["Thigh2Spine"] == pytest.approx([-1, -1])
        assert cosines["Arm2Trunk"] == pytest.approx([-1, 0])
        assert cosines["Arm2ChestPlane"] == pytest.approx([0, 1])  # forwards
        assert cosines["Forearm2Arm"] == pytest.approx([1, 0])
        assert [cosines[name][0] for name in ("Trunk2Pelvis", "Shoulders2Hips", "Head2Trunk")] == pytest.approx([1] * 3)
        thigh = angles(pose(skeleton, UPRIGHT, LKnee=(0.1, 0, 0.4), RKnee=(-0.5, 0, 0)), skeleton)
        assert thigh["Thigh2HipPlane"] == pytest.approx([1, 0])  # forwards
        assert thigh["Thigh2Hips"] == pytest.approx([0, 1])  # outwards

    def test_of_humaneva(self):
        """Write out the definitions by indices without the root."""
        poses = random_poses(HUMANEVA, 5)
        v = poses.unflatten(-1, (-1, 3)).unbind(-2)
        cross, cos = torch.linalg.cross, torch.nn.functional.cosine_similarity
        expected = {
            "LHip2RHip": [cos(v[7], v[10])],
            "Neck2HipPlane": [cos(cross(v[7], v[10]), v[0])],
            "Head2Neck": [cos(v[13] - v[0], v[0])],
            "Shoulder2Shoulder": [cos(v[1] - v[0], v[4] - v[0])],
            "ShoulderPlane2HipPlane": [cos(cross(v[7] - v[0], v[10] - v[0]), cross(v[1], v[4]))],
            "Shoulder2Neck": [cos(v[1] - v[0], v[0]), cos(v[4] - v[0], v[0])],
            "Leg2HipPlane": [cos(cross(v[7], v[10]), v[8] - v[7]), cos(cross(v[7], v[10]), v[11] - v[10])],
            "Foot2LegPlane": [
                cos(cross(v[7] - v[10], v[8] - v[7]), v[9] - v[8]),
                cos(cross(v[7] - v[10], v[11] - v[10]), v[12] - v[11]),
            ],
            "ForeArm2ShoulderPlane": [
                cos(cross(v[2] - v[1], v[1] - v[0]), v[3] - v[2]),
                cos(cross(v[4] - v[0], v[5] - v[4]), v[6] - v[5]),
            ],
        }
        self.compare(cosines(poses, HUMANEVA), angle_names(HUMANEVA), expected)

    def test_of_human36m(self):
        poses = random_poses(HUMAN36M, 50)
        v = poses.unflatten(-1, (-1, 3)).unbind(-2)
        cross, cos = torch.linalg.cross, torch.nn.functional.cosine_similarity
        hips = cross(v[7] - v[0], v[7] - v[3])
        left, right = cross(v[4] - v[3], v[3]), cross(v[0], v[1] - v[0])
        signs = (v[3] * cross(v[6], left)).sum(-1), (v[0] * cross(right, v[6])).sum(-1)
        ranges = cos(left, v[6]), cos(right, v[6])
        expected = {
            "Spine2Hip": [cos(v[3], v[6]), cos(v[0], v[6])],
            "Leg2HipPlane": [
                cos(cross(v[3], v[4] - v[3]), v[5] - v[4]),
                cos(cross(v[1] - v[0], v[0]), v[2] - v[1]),
            ],
            "Shoulder2Hip": [cos(v[10] - v[7], v[3]), cos(v[13] - v[7], v[0])],
            "Leg2ShoulderPlane": [cos(cross(v[13], v[10]), v[4]), cos(cross(v[13], v[10]), v[1])],
            "Shoulder2Shoulder": [cos(v[13] - v[7], v[10] - v[7])],
            "Neck2Spine": [cos(v[7] - v[6], v[6])],
            "Spine2HipPlane1": [c.where(s < 0, torch.nan) for c, s in zip(ranges, signs, strict=True)],
            "Spine2HipPlane2": [c.where(s >= 0, torch.nan) for c, s in zip(ranges, signs, strict=True)],
            "ShoulderPlane2HipPlane": [cos(hips, cross(v[10], v[13]))],
            "Head2Neck": [cos(v[7] - v[6], v[8] - v[7])],
            "Head2HeadTop": [cos(v[9] - v[8], v[8] - v[7])],
            "HeadVerticalPlane2HipPlane": [cos(cross(cross(v[9] - v[8], v[8] - v[7]), v[9] - v[7]), hips)],
            "Shoulder2Neck": [cos(v[10] - v[7], v[6] - v[7]), cos(v[13] - v[7], v[6] - v[7])],
        }
        self.compare(cosines(poses, HUMAN36M), angle_names(HUMAN36M), expected)

    def compare(self, cosines, names, expected):
        assert set(names) == set(expected)
        for name, columns in expected.items():
            same = [i for i, other in enumerate(names) if other == name]
            torch.testing.assert_close(cosines[..., same], torch.stack(columns, -1), equal_nan=True)

    @every_skeleton
    def test_rotation_scale_and_joint_order_change_nothing(self, skeleton):
        poses = random_poses(skeleton, 7)
        expected = cosines(poses, skeleton)
        turn, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))
        turn = turn * torch.linalg.det(turn)
        joints = poses.unflatten(-1, (-1, 3))
        torch.testing.assert_close(cosines((1.7 * joints @ turn).flatten(-2), skeleton), expected, equal_nan=True)
        with_root = torch.cat([torch.zeros_like(joints[:, :1]), joints], 1) + torch.randn(3)
        torch.testing.assert_close(cosines(with_root.flatten(-2), skeleton), expected, equal_nan=True)

    @every_skeleton
    def test_a_mirrored_person_has_the_angles_of_the_other_side(self, skeleton):
        joints = torch.cat([torch.zeros(9, 1, 3), torch.randn(9, skeleton.joints - 1, 3)], 1).double()
        mirrored = (joints * torch.tensor([-1, 1, 1]))[:, swapped_sides(skeleton)]
        first, second = (cosines(x.flatten(-2), skeleton) for x in (joints, mirrored))
        names = angle_names(skeleton)
        for name in names:
            same = [i for i, other in enumerate(names) if other == name]
            torch.testing.assert_close(second[:, same], first[:, same[::-1]], equal_nan=True)

    @every_skeleton
    def test_a_limb_of_length_zero_keeps_the_other_gradients(self, skeleton):
        poses = random_poses(skeleton, 2).requires_grad_()
        knee, hip = (skeleton.names.index(name) for name in ("LKnee", "LHip"))
        joints = list(poses.unflatten(-1, (-1, 3)).unbind(-2))
        joints[knee - 1] = joints[hip - 1]
        values = cosines(torch.cat(joints, -1), skeleton).nan_to_num()
        (gradient,) = torch.autograd.grad(values.sum(), poses)
        assert gradient.isfinite().all()
        assert gradient.any(0).sum() > gradient.shape[1] / 2

    @pytest.mark.parametrize("skeleton", [HUMAN36M, SKELETONS["cmu21"]], ids=["human36m", "cmu21"])
    def test_gradients(self, skeleton):
        poses = random_poses(skeleton, 3).requires_grad_()
        assert torch.autograd.gradcheck(lambda x: cosines(x, skeleton).nan_to_num(), poses)

    def test_skeletons_without_angles_and_other_sizes_are_errors(self):
        stick = Skeleton(("a", "b"), (-1, 0), name="stick")
        with pytest.raises(ValueError, match=r"defined for the skeletons human36m, .* not for 'stick'"):
            cosines(torch.zeros(3), stick)
        with pytest.raises(ValueError, match="skeleton 'cmu21' has no joint"):
            cosines(torch.zeros(3), Skeleton(("a", "b"), (-1, 0), name="cmu21"))
        with pytest.raises(ValueError, match=r"50 numbers, expected 51 .* or 48"):
            cosines(torch.zeros(50), WALKER)


class TestLimits:
    def test_are_the_extremes_of_both_sides_together(self):
        poses = random_poses(HUMANEVA, 3, 20)
        limits = estimate_angle_limits(poses, HUMANEVA)
        values = cosines(poses, HUMANEVA).flatten(0, 1)
        left, right = (i for i, name in enumerate(limits.names) if name == "Leg2HipPlane")
        for column in (left, right):
            assert limits.low[column] == values[:, [left, right]].min()
            assert limits.high[column] == values[:, [left, right]].max()

    def test_invalid_input_is_an_error(self):
        with pytest.raises(ValueError, match=r"below \.5, got 0\.5"):
            estimate_angle_limits(pose(WALKER), WALKER, quantile=0.5)
        with pytest.raises(ValueError, match="at least one"):
            estimate_angle_limits(torch.zeros(0, 48), WALKER)
        with pytest.raises(ValueError, match="wrong limits: b"):
            AngleLimits(("a", "b"), torch.tensor([0.0, 1.0]), torch.tensor([0.0, torch.nan]))


def test_a_skeleton_with_the_joints_of_a_known_one_has_its_angles_and_parts():
    own = replace(WALKER, name="recorded")
    assert angle_names(own) == angle_names(WALKER)
    assert body_parts(own, ("lower", "upper")) == body_parts(WALKER, ("lower", "upper"))
    poses = random_poses(WALKER, 3)
    torch.testing.assert_close(cosines(poses, own), cosines(poses, WALKER), equal_nan=True)
    other = replace(own, names=tuple("Back" if name == "Spine" else name for name in own.names))
    with pytest.raises(ValueError, match="not for 'recorded'; use angles=0"):
        angle_names(other)
    with pytest.raises(ValueError, match=r"has no part or joint 'right_leg'; .* define a part by its joints"):
        body_parts(other, ("lower", "upper"))


@pytest.mark.parametrize("known", ["lengths", "rest"])
def test_joints_at_the_place_of_their_parents_define_no_sides(known):
    """CMU's files have lhipjoint and rhipjoint at the root."""
    names = ("root", "lhipjoint", "lfemur", "rhipjoint", "rfemur")
    rest = torch.tensor([[0, 0, 0], [0, 0, 0], [0.1, -0.1, 0], [0, 0, 0], [-0.1, -0.1, 0]])
    options = {"rest": tuple(rest.flatten().tolist())} if known == "rest" else {"lengths": (0.0, 0.14, 0.0, 0.14)}
    skeleton = Skeleton(names, (-1, 0, 1, 0, 3), left=(1, 2), right=(3, 4), **options)
    assert skeleton.sides == ([2], [4])
    assert skeleton.heading(rest) == pytest.approx(0.0, abs=1e-6)
    turned = rest[:, [2, 1, 0]] * torch.tensor([1.0, 1.0, -1.0])  # faces +x
    assert skeleton.heading(turned) == pytest.approx(torch.pi / 2, abs=1e-6)
    unknown = Skeleton(names, (-1, 0, 1, 0, 3), left=(1, 2), right=(3, 4))
    assert unknown.heading(rest).isnan()
