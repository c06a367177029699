"""Rotations in every form, and forward and inverse kinematics."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dvae.motion import WALKER, MotionSet, Skeleton, simulate
from dvae.motion.geometry import kinematics, rotations

EULER = ["euler-" + "".join(axes) for axes in itertools.product("xyz", repeat=3) if axes[0] != axes[1] != axes[2]]
FORMS = [*rotations.SIZES, *EULER]
each_form = pytest.mark.parametrize("form", FORMS)


def turns(angle, count=200):
    """Return rotations (N, 3, 3) by an angle about random axes."""
    axes = torch.nn.functional.normalize(torch.randn(count, 3, dtype=torch.float64), dim=-1)
    return torch.from_numpy(Rotation.from_rotvec(angle * axes.numpy()).as_matrix())


@each_form
def test_every_form_gives_the_rotation_back(form):
    for angle in (0.0, 1e-9, 1e-4, 0.5, 2.0, torch.pi - 1e-6, torch.pi):
        matrices = turns(angle)
        values = rotations.from_matrix(matrices, form)
        assert values.shape == (200, rotations.size(form))
        torch.testing.assert_close(rotations.to_matrix(values, form), matrices, atol=1e-6, rtol=0)


@each_form
def test_forms_equal_those_of_scipy(form):
    matrices = turns(1.3)
    reference = Rotation.from_matrix(matrices.numpy())
    values = rotations.from_matrix(matrices, form)
    if form.startswith("euler"):
        expected = Rotation.from_euler(form[-3:].upper(), values.numpy()).as_matrix()
        torch.testing.assert_close(torch.from_numpy(expected), matrices)
    elif form == "quaternion":
        expected = torch.from_numpy(reference.as_quat(scalar_first=True))
        torch.testing.assert_close(values * values[:, :1].sign(), expected * expected[:, :1].sign())
    elif form == "vector":
        torch.testing.assert_close(values, torch.from_numpy(reference.as_rotvec()))
    else:
        columns = matrices.transpose(1, 2) if form == "6d" else matrices
        torch.testing.assert_close(values, columns.flatten(1)[:, : rotations.size(form)])


@pytest.mark.parametrize(
    ("form", "angle"),
    [*zip([*rotations.SIZES, "euler-xyx", "euler-zyx"], [1e-9, 1.0, 2.5, 0.0, torch.pi - 1e-3, 1.0], strict=False)],
)
def test_gradients_equal_finite_differences(form, angle):
    if form.startswith("euler") and form[-1] == form[-3]:
        angle = max(angle, 1.0)  # close to this angle, the first and third axes coincide
    axes = torch.nn.functional.normalize(torch.tensor([[1.0, 2, 3], [-2, 1, 1]]).double(), dim=-1)
    vectors = (angle * axes).requires_grad_()
    values = rotations.from_matrix(rotations.to_matrix(vectors.detach(), "vector"), form).requires_grad_()
    torch.autograd.gradcheck(lambda v: rotations.to_matrix(v, form), values)
    torch.autograd.gradcheck(lambda v: rotations.from_matrix(rotations.to_matrix(v, "vector"), form), vectors)


@pytest.mark.parametrize("form", ["quaternion", "vector", "6d"])
@pytest.mark.parametrize("angle", [0.0, torch.pi])
def test_gradients_are_right_at_no_turn_and_at_half_a_turn(form, angle):
    values = rotations.from_matrix(torch.diag(torch.tensor([1.0, -1.0, -1.0] if angle else [1.0] * 3).double()), form)
    if form == "vector":  # both vectors of half a turn are valid; the differentiated one is written out
        values = torch.tensor([angle, 0, 0], dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda v: rotations.to_matrix(v, form), values.requires_grad_(), eps=1e-5, atol=1e-6, rtol=0
    )


@pytest.mark.parametrize(
    ("form", "values"),
    [("quaternion", [0.0] * 4), ("6d", [0.0] * 6), ("6d", [1.0, 2, 3, -2, -4, -6]), ("6d", [1e-30] * 6)],
)
def test_degenerate_numbers_are_read_as_a_rotation(form, values):
    numbers = torch.tensor(values, requires_grad=True)
    matrix = rotations.to_matrix(numbers, form)
    torch.testing.assert_close(matrix @ matrix.mT, torch.eye(3))
    torch.testing.assert_close(torch.linalg.det(matrix), torch.ones(()))
    if not any(values):
        assert torch.equal(matrix, torch.eye(3))
    (gradient,) = torch.autograd.grad((matrix * torch.randn(3, 3)).sum(), numbers)
    assert gradient.abs().max() < 10


def test_continuous_quaternions_are_the_same_rotations():
    angle = torch.linspace(0, 8 * torch.pi, 100, dtype=torch.float64)
    vectors = torch.stack([torch.stack([angle, 0 * angle, 0 * angle], -1), torch.randn(3).double().expand(100, 3)], 1)
    quaternions = rotations.from_matrix(rotations.to_matrix(vectors, "vector"), "quaternion")
    quaternions = quaternions * torch.where(torch.rand(100, 2, 1) < 0.5, -1.0, 1.0)
    continuous = rotations.continuous(quaternions)
    assert (continuous[1:] * continuous[:-1]).sum(-1).min() > 0.9
    torch.testing.assert_close(continuous[0], quaternions[0])
    torch.testing.assert_close(
        rotations.to_matrix(continuous, "quaternion"), rotations.to_matrix(quaternions, "quaternion")
    )
    torch.testing.assert_close(rotations.continuous(quaternions.transpose(0, 1), dim=1), continuous.transpose(0, 1))
    assert rotations.continuous(quaternions[:1]).shape == (1, 2, 4)


@pytest.mark.parametrize("n_turns", [1.0, 3.3])
def test_rotation_vectors_continue_beyond_half_a_turn(n_turns):
    axis = torch.nn.functional.normalize(torch.randn(5, 3, dtype=torch.float64), dim=-1)
    angle = torch.pi * torch.arange(0.25, 2 * n_turns, 0.125, dtype=torch.float64)  # including full turns
    expected = angle[:, None, None] * axis
    vectors = rotations.in_time(rotations.to_matrix(expected, "vector"), "vector")
    torch.testing.assert_close(vectors, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: rotations.size("euler-abc"), "unknown form of rotations 'euler-abc'"),
        (lambda: rotations.from_matrix(torch.eye(3), "euler-xxy"), "cannot represent every rotation"),
        (lambda: rotations.to_matrix(torch.zeros(2, 5), "6d"), "6d has 6 numbers .* the shape \\(2, 5\\)"),
        (lambda: rotations.from_matrix(torch.zeros(2, 9), "6d"), "expected matrices"),
    ],
)
def test_an_invalid_rotation_is_an_error(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def random_pose(frames=7):
    offsets = torch.randn(WALKER.joints, 3, dtype=torch.float64)
    local = turns(1.0, frames * WALKER.joints).unflatten(0, (frames, WALKER.joints))
    return offsets, local, torch.randn(frames, 3, dtype=torch.float64)


def test_forward_kinematics_is_a_product_along_every_chain():
    offsets, local, root = random_pose()
    positions, world = kinematics.forward(WALKER.parents, local, offsets, root)
    for frame, joint in itertools.product(range(7), range(WALKER.joints)):
        place, ancestor = torch.zeros(3, dtype=torch.float64), joint
        turn = local[frame, joint]
        while WALKER.parents[ancestor] >= 0:  # a point in the frame of a joint, seen from its parent's
            place, ancestor = (
                local[frame, WALKER.parents[ancestor]] @ (offsets[ancestor] + place),
                WALKER.parents[ancestor],
            )
            turn = local[frame, ancestor] @ turn
        torch.testing.assert_close(positions[frame, joint], root[frame] + place)
        torch.testing.assert_close(world[frame, joint], turn)


def test_inverse_kinematics_recovers_rigid_bodies_without_twist():
    offsets, local, root = random_pose()
    positions, _ = kinematics.forward(WALKER.parents, local, offsets, root)
    recovered = kinematics.inverse(WALKER, positions, offsets)
    again, _ = kinematics.forward(WALKER.parents, recovered, offsets, root)
    torch.testing.assert_close(again, positions, atol=1e-5, rtol=0)
    torch.testing.assert_close(recovered @ recovered.transpose(-1, -2), torch.eye(3).double().expand_as(recovered))
    rounded = kinematics.inverse(WALKER, positions.float(), offsets.float()).double()
    torch.testing.assert_close(
        rounded, kinematics.inverse(WALKER, positions.float().double(), offsets), atol=1e-4, rtol=0
    )
    knee, foot = WALKER.find("RKnee"), WALKER.find("RFoot")
    axis = rotations.from_matrix(recovered[:, knee], "vector")
    torch.testing.assert_close((axis * offsets[foot]).sum(-1), torch.zeros(7).double(), atol=1e-5, rtol=0)
    torch.testing.assert_close(recovered[:, foot], torch.eye(3).double().expand(7, 3, 3))


CHAIN = Skeleton(("hip", "knee", "foot"), (-1, 0, 1))


@pytest.mark.parametrize(("aside", "dtype"), [(0.0, torch.float32), (1e-12, torch.float64), (1e-3, torch.float32)])
def test_a_reversed_bone_is_rotated_by_half_a_turn(aside, dtype):
    offsets = torch.tensor([[0.0, 0, 0], [0, 1, 0], [0.6, 0.8, 0]], dtype=dtype)
    positions = -offsets.cumsum(0)[None]
    positions[0, 1, 2] += aside
    recovered = kinematics.inverse(CHAIN, positions.requires_grad_(), offsets)
    again, _ = kinematics.forward(CHAIN.parents, recovered, offsets, positions[:, 0])
    torch.testing.assert_close(again, positions, atol=2e-3 if dtype is torch.float32 else 1e-6, rtol=0)
    torch.testing.assert_close(recovered @ recovered.mT, torch.eye(3, dtype=dtype).expand_as(recovered))
    (gradient,) = torch.autograd.grad((recovered * torch.randn_like(recovered)).sum(), positions)
    assert gradient.isfinite().all()


def test_a_joint_with_a_bone_of_length_zero_is_not_rotated():
    offsets = torch.tensor([[0.0, 0, 0], [0, 1, 0], [0, 1, 0]], dtype=torch.float64)
    positions = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [1, 0, 0]]], dtype=torch.float64, requires_grad=True)
    recovered = kinematics.inverse(CHAIN, positions, offsets)
    torch.testing.assert_close(recovered[0, 1], torch.eye(3, dtype=torch.float64))
    (gradient,) = torch.autograd.grad((recovered * torch.randn_like(recovered)).sum(), positions)
    assert gradient.abs().max() < 10


def test_inverse_kinematics_has_a_gradient():
    offsets, local, root = random_pose(1)
    positions, _ = kinematics.forward(WALKER.parents, local, offsets, root)
    positions = positions + 0.1 * torch.randn_like(positions)  # which no such body has
    positions.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: kinematics.inverse(WALKER, x, offsets), positions, fast_mode=True)


def test_inferred_rotations_reproduce_the_positions(tmp_path):
    people = simulate(clips=3, frames=20, seed=1)
    assert people.clips[0].rotations is None
    with pytest.raises(ValueError, match="no rest pose"):
        people.skeleton.offsets
    with_rotations = people.with_rotations()
    assert with_rotations.with_rotations() is with_rotations
    assert with_rotations.fingerprint() != people.fingerprint()
    one = MotionSet(people.clips[:1], people.skeleton).with_rotations()
    (clip,), body = one, one.skeleton
    matrices = rotations.to_matrix(torch.from_numpy(clip.rotations), "quaternion").double()
    root = torch.from_numpy(clip.positions[:, body.root]).double()
    again, _ = kinematics.forward(body.parents, matrices, body.offsets, root)
    torch.testing.assert_close(again, torch.from_numpy(clip.positions).double(), atol=1e-2, rtol=0)
    body.to_json(tmp_path / "skeleton.json")
    assert Skeleton.from_json(tmp_path / "skeleton.json") == body
    for change, message in (
        (lambda matrices: matrices[:, :-1], r"rotations \(20, 16, 4\), expected quaternions \(20, 17, 4\)"),
        (lambda matrices: 2 * matrices, "not unit quaternions"),
    ):
        with pytest.raises(ValueError, match=message):
            MotionSet([replace(clip, rotations=change(clip.rotations))], body)
    for rest, message in (
        ((0.0, 1.0), "has 2 numbers, expected 3 for each of 17"),
        ((np.nan,) * 51, "a joint is nan m"),
    ):
        with pytest.raises(ValueError, match=message):
            replace(WALKER, rest=rest)
