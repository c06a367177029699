"""Bodies with a surface: skinning follows joints, the default person is plausible, invalid body files are errors."""

from collections import Counter

import numpy as np
import pytest
import torch

from dvae.motion.bodies import SHAPE, Body, enclosed_volume, human, read_body, vertex_error
from dvae.motion.geometry import kinematics, rotations

B, T = 3, 4
PERSON = human().double()


def poses(body=PERSON, spread=0.7):
    """Draw shapes (B, S), rotations (B, T, J, 3, 3) and translations (B, T, 3)."""
    vectors = spread * torch.randn(B, T, body.joints, 3, dtype=torch.float64)
    shape = torch.randn(B, body.parameters_of_shape, dtype=torch.float64)
    return shape, rotations.to_matrix(vectors, "vector"), torch.randn(B, T, 3, dtype=torch.float64)


def edges(faces):
    """Return the directed edges of triangles."""
    return Counter(map(tuple, torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()))


def parts(body):
    """Return the faces of each connected part."""
    part = torch.arange(len(body.template))
    while True:
        least = part[body.faces].amin(1)
        spread = part.scatter_reduce(0, body.faces.flatten(), least.repeat_interleave(3), "amin")
        if torch.equal(spread, part):
            return [body.faces[part[body.faces[:, 0]] == one] for one in part.unique()]
        part = spread


# ------------------------------------------------------------------------------------------------------- the person


def test_every_part_of_the_person_is_a_closed_surface_for_all_shapes():
    """Each edge belongs to two triangles with opposite directions, and each part has a positive volume."""
    assert len(parts(PERSON)) == 11  # trunk, head, nose; legs, feet, arms and thumbs
    for faces in parts(PERSON):
        directed_edges = edges(faces)
        assert set(directed_edges.values()) == {1}
        assert {(end, start) for start, end in directed_edges} == set(directed_edges)
        corners = torch.cartesian_prod(*[torch.tensor([-3.0, 3.0], dtype=torch.float64)] * len(SHAPE))
        assert (enclosed_volume(PERSON.at_rest(corners)[0], faces) > 0).all()


@pytest.mark.parametrize(
    ("name", "ends"),
    [
        ("legs", ("L_Hip", "L_Ankle")),
        ("arms", ("R_Shoulder", "R_Wrist")),
        ("torso", ("Pelvis", "Neck")),
        ("shoulders", ("L_Shoulder", "R_Shoulder")),
        ("hips", ("L_Hip", "R_Hip")),
    ],
)
def test_only_its_parameter_and_size_change_a_length(name, ends):
    start, end = (PERSON.names.index(joint) for joint in ends)
    joints = PERSON.at_rest(torch.eye(len(SHAPE)).double())[1] - PERSON.at_rest(torch.zeros(8).double())[1]
    changed_lengths = (joints[:, end] - joints[:, start]).norm(dim=-1) > 1e-6
    assert {SHAPE[k] for k in changed_lengths.nonzero()} == {"size", name}


# --------------------------------------------------------------------------------------------------------- skinning


def test_joints_are_those_of_forward_kinematics():
    shape, joint_rotations, translation = poses()
    pivots = PERSON.at_rest(shape)[1]
    offsets = pivots - pivots[:, [max(parent, 0) for parent in PERSON.parents]]
    expected, _ = kinematics.forward(
        PERSON.parents, joint_rotations, offsets[:, None], pivots[:, None, 0] + translation
    )
    torch.testing.assert_close(PERSON(shape, joint_rotations, translation)[1], expected)


def test_a_surface_is_the_weighted_sum_of_rigid_ones():
    """Compare the matrix product with the formula for each vertex and joint."""
    shape, joint_rotations, translation = poses()
    resting, pivots = PERSON.at_rest(shape)
    vertices, joints = PERSON(shape, joint_rotations, translation)
    world = kinematics.forward(PERSON.parents, joint_rotations, torch.zeros(22, 3).double(), translation)[1]
    expected = torch.zeros_like(vertices)
    for joint in range(PERSON.joints):
        rigid = (resting - pivots[:, joint, None])[:, None] @ world[:, :, joint].mT + joints[:, :, joint, None]
        expected += PERSON.weights[:, joint, None] * rigid
    torch.testing.assert_close(vertices, expected)


def test_a_distant_translation_keeps_the_surface():
    """The error is the rounding of large coordinates, 2^-24 of them; a sum of weights of 1 - 1e-7 stretches nothing."""
    body, (shape, joint_rotations, translation) = human(), (tensor.float() for tensor in poses())
    near, far = (body(shape, joint_rotations, translation + move)[0] for move in (0, 1024))
    torch.testing.assert_close(far - 1024, near, atol=3 * 1024 / 2**24, rtol=0)


def test_gradients_are_right():
    shape, joint_rotations, translation = poses()
    arguments = (shape[:2], rotations.from_matrix(joint_rotations[:2, :2], "6d"), translation[:2, :2])

    def surface(shape, numbers, translation):
        return PERSON(shape, rotations.to_matrix(numbers, "6d"), translation)

    assert torch.autograd.gradcheck(surface, [tensor.requires_grad_() for tensor in arguments], fast_mode=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_at_the_rest_pose_with_zero_error(dtype):
    body = human().to(dtype)
    arguments = [torch.zeros(2, 8), torch.eye(3).repeat(2, T, 22, 1, 1), torch.zeros(2, T, 3)]
    arguments = [tensor.to(dtype).requires_grad_() for tensor in arguments]
    vertices, _ = body(*arguments)
    assert vertices.dtype == dtype
    vertex_error(vertices, vertices.detach()).sum().backward(retain_graph=True)
    assert all(tensor.grad.isfinite().all() for tensor in arguments)
    (enclosed_volume(vertices, body.faces) + vertices.square().mean((-2, -1))).sum().backward()
    assert all(tensor.grad.isfinite().all() and tensor.grad.any() for tensor in arguments)


def test_a_model_does_not_save_its_body():
    assert not torch.nn.Sequential(human()).state_dict()


def test_mismatched_sizes_are_errors():
    shape, joint_rotations, translation = poses()
    with pytest.raises(ValueError, match=r"rotations \(..., T, 22, 3, 3\)"):
        PERSON(shape, joint_rotations[:, :, :20], translation)
    with pytest.raises(ValueError, match=r"translation"):
        PERSON(shape[:2], joint_rotations, translation)
    with pytest.raises(ValueError, match=r"expected \(..., 8\)"):
        PERSON(shape[:, :7], joint_rotations, translation)
    with pytest.raises(ValueError, match="regressor has shape"):
        Body(PERSON.names, PERSON.parents, PERSON.template, PERSON.shapes, PERSON.weights, PERSON.weights, PERSON.faces)


# --------------------------------------------------------------------------------------------------------- measures


def test_the_volume_and_vertex_error_of_a_moved_cube():
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 2.0])] * 3)
    squares = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = torch.tensor([[a, *rest] for a, b, c, d in squares for rest in ((b, c), (c, d))])
    assert enclosed_volume(corners, faces) == 8
    for moved in (torch.tensor([5.0, -7.0, 3.0]), torch.tensor(100.0)):
        torch.testing.assert_close(enclosed_volume(corners + moved, faces), torch.tensor(8.0))
    frames = corners.repeat(2, 3, 1, 1)  # two sequences of three frames
    translated = frames.clone()
    translated[0, 0] += torch.tensor([0.3, 0.4, 0.0])
    torch.testing.assert_close(vertex_error(translated, frames), torch.tensor([0.5 / 3, 0.0]))
    with pytest.raises(ValueError, match="of one shape"):
        vertex_error(translated, frames[:1])


# ------------------------------------------------------------------------------------------------------------ files


def arrays(body):
    """Return the members of a body file as `smplx` names them."""
    tree = np.array([body.parents, range(body.joints)]).astype(np.uint32)  # the root's parent is 2**32 - 1
    members = {"v_template": body.template, "shapedirs": body.shapes, "J_regressor": body.regressor}
    return {name: tensor.numpy() for name, tensor in {**members, "weights": body.weights, "f": body.faces}.items()} | {
        "kintree_table": tree
    }


def write_body(path, body):
    np.savez(path, **arrays(body))


def test_a_body_in_the_layout_of_smplx_is_read_unchanged(tmp_path):
    person = human()
    write_body(tmp_path / "body.npz", person)
    body = read_body(tmp_path / "body.npz")
    assert (body.names, body.parents) == (person.names, person.parents)
    for name, tensor in person.named_buffers():
        torch.testing.assert_close(getattr(body, name), tensor, atol=0, rtol=0)
    assert read_body(tmp_path / "body.npz", shapes=3).shapes.equal(person.shapes[..., :3])


def test_hands_without_rotations_move_with_the_wrist(tmp_path):
    """As in SMPL-H: more joints without rotations, numbers in float64, other members pickled."""
    members = arrays(human())
    wrist, vertices = human().names.index("L_Wrist"), len(members["v_template"])
    finger = np.flatnonzero(members["weights"][:, wrist] > 0.9)
    extra = np.zeros((vertices, 3))
    extra[finger, :2] = members["weights"][finger, wrist, None] * [0.5, 0.25]
    members["weights"][finger, wrist] *= 0.25
    members["weights"] = np.concatenate([members["weights"], extra], 1).astype(np.float64)
    members["J_regressor"] = np.concatenate([members["J_regressor"], members["J_regressor"][-3:]]).astype(np.float64)
    tree = np.concatenate([members["kintree_table"], [[wrist, 22, 15], [22, 23, 24]]], 1).astype(np.uint32)
    members |= {"kintree_table": tree, "f": members["f"].astype(np.uint32), "part2num": np.array({"hand": 1})}
    members["shapedirs"] = np.asfortranarray(np.concatenate([members["shapedirs"]] * 2, -1).astype(np.float64))
    np.savez(tmp_path / "hands.npz", **members)
    body = read_body(tmp_path / "hands.npz")
    assert body.joints == 22
    for name, tensor in human().named_buffers():
        torch.testing.assert_close(getattr(body, name), tensor)


@pytest.mark.parametrize(("columns", "most"), [(20, 10), (400, 300)])
def test_expressions_of_smplx_are_not_shape_parameters(tmp_path, columns, most):
    members, extra = arrays(human()), 55 - 22
    for name, axis in (("weights", 1), ("J_regressor", 0)):
        members[name] = np.concatenate(
            [members[name], np.zeros_like(members[name].take(range(1), axis).repeat(extra, axis))], axis
        )
    members["J_regressor"][22:, 0] = 1
    members["kintree_table"] = np.concatenate([members["kintree_table"], [[15] * extra, [*range(22, 55)]]], 1)
    members["shapedirs"] = np.zeros((len(members["v_template"]), 3, columns), np.float32)
    np.savez(tmp_path / "body.npz", **members)
    assert read_body(tmp_path / "body.npz", most).parameters_of_shape == most
    with pytest.raises(ValueError, match=f"it has {most} shape parameters, so `shapes` must be from 1 to {most}"):
        read_body(tmp_path / "body.npz", most + 1)


def changed(name, change):
    return lambda members: members.update({name: change(members[name])})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda members: members.pop("weights"), "it has no weights"),
        (changed("v_template", lambda a: a + np.float32(np.nan)), "v_template has values that are NaN"),
        (changed("shapedirs", lambda a: 1e30 * a), "above 1000"),
        (changed("shapedirs", lambda a: a[..., :2]), "2 shape parameters, so `shapes` must be from 1 to 2, got 8"),
        (changed("f", lambda a: a - 1), "refers to an index that does not exist"),
        (changed("f", lambda a: a.astype(float)), "expected whole numbers"),
        (changed("weights", lambda a: 2 * a), "each row of weights must sum to 1"),
        (
            changed("weights", lambda a: a + np.float32(0.1) * (np.eye(22)[0] - np.eye(22)[1])),
            "at least 0, but the small",
        ),
        (changed("J_regressor", lambda a: np.array({"sparse": 1})), "pickled objects"),
        (changed("kintree_table", lambda a: a[:, ::-1]), "kintree_table is not SMPL's joint tree"),
        (changed("kintree_table", lambda a: a[:, :5]), "expected whole numbers"),
    ],
)
def test_files_that_are_no_body_are_errors(tmp_path, change, message):
    members = arrays(human())
    change(members)
    np.savez(tmp_path / "wrong.npz", **members)
    with pytest.raises(ValueError, match=message) as error:
        read_body(tmp_path / "wrong.npz")
    assert "wrong.npz" in str(error.value)


@pytest.mark.parametrize(
    ("limit", "most", "message"),
    [("LARGEST", 100, "a body has at most 100"), ("MOST_VERTICES", 1000, "1,486 vertices; a body has at most 1,000")],
)
def test_a_file_larger_than_any_body_is_an_error(tmp_path, monkeypatch, limit, most, message):
    write_body(tmp_path / "body.npz", human())
    monkeypatch.setattr(f"dvae.motion.bodies.smplx.{limit}", most)
    with pytest.raises(ValueError, match=message):
        read_body(tmp_path / "body.npz")


@pytest.mark.parametrize("most", [0, 16], ids=["many parameters", "few parameters"])
def test_the_squared_error_equals_that_of_vertices_without_computing_them(monkeypatch, most):
    monkeypatch.setattr("dvae.motion.bodies.skinning.MOST_PAIRS", most)
    shape, *first = poses()
    _, *second = poses()
    difference = PERSON(shape, *first)[0] - PERSON(shape, *second)[0]
    torch.testing.assert_close(PERSON.squared_error(shape, first, second), difference.square().sum(-1).mean(-1))
    assert (PERSON.squared_error(shape, first, first) == 0).all()
