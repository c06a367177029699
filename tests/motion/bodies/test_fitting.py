"""Fitting a body to motion: estimated shapes, limb directions without twist, retargeting, AMASS files and errors."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch

from dvae.motion import Clip, MotionSet, Skeleton, read_motion, simulate
from dvae.motion.bodies import SHAPE, Body, betas, fit_to_body, fitting, human, retarget, shapes_of
from dvae.motion.files.reading import select_joints
from dvae.motion.geometry import rotations
from dvae.motion.naming import sides
from dvae.motion.scoring.matching import parts

PERSON = human()
OWN = parts(PERSON.names)
LIMBS = [
    (f"{side} {start}", f"{side} {end}")
    for side in "lr"
    for start, end in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
]


def shapes(people, spread=1.0):
    """Draw shapes (N, 8) with average girth, because joints do not determine it."""
    parameters = spread * torch.randn(people, len(SHAPE), dtype=torch.float64).clamp(-2, 2)
    parameters[:, SHAPE.index("girth")] = 0
    return parameters


def places(motion, part):
    """Return the positions (F, 3) of a joint in all frames."""
    joint = parts(motion.skeleton.names)[part]
    return torch.from_numpy(np.concatenate([clip.positions[:, joint] for clip in motion])).double()


def bone(motion, start, end):
    return torch.nn.functional.normalize(places(motion, end) - places(motion, start), dim=-1)


def joints_of(motion, shape):
    """Return the body's joints (F, 22, 3) in all frames from rotations, translations and shapes."""
    joints = []
    for clip, clip_shape in zip(motion, shape.float(), strict=True):
        joint_rotations = rotations.to_matrix(torch.from_numpy(clip.rotations), "quaternion")
        translation = torch.from_numpy(clip.positions[:, 0]) - PERSON.at_rest(clip_shape)[1][0]
        joints.append(PERSON(clip_shape, joint_rotations, translation)[1])
    return torch.cat(joints)


def positions(motion):
    return torch.from_numpy(np.concatenate([clip.positions for clip in motion]))


@pytest.fixture(scope="module")
def walkers():
    return simulate(clips=6, frames=91, seed=3)


@pytest.fixture(scope="module")
def on_body(walkers):
    return fit_to_body(walkers, PERSON)


@pytest.fixture(scope="module")
def recorded(real):
    """Return clips of a source, and the same clips on the body."""

    def clips_and_fit(file):
        motion = real(file)
        some = replace(motion, clips=motion.clips[:: -(-len(motion) // 8)])
        return some, fit_to_body(some, PERSON)

    return clips_and_fit


# ------------------------------------------------------------------------------------------------------------ shapes


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_offsets_determine_the_shape(dtype):
    expected = shapes(50).to(dtype)
    estimated = PERSON.shape_of(PERSON.offsets(expected))
    assert estimated.dtype == dtype
    torch.testing.assert_close(estimated, expected, atol=3e-5 if dtype == torch.float32 else 1e-9, rtol=0)


def test_clips_are_fitted_independently_of_each_other(walkers, monkeypatch):
    cut = [replace(part, name=f"{clip.name}-{n}") for clip in walkers for n, part in enumerate((clip, clip))]
    shape = shapes(6).repeat_interleave(torch.tensor([1, 3, 2, 2, 3, 1]), dim=0)
    monkeypatch.setattr(fitting, "AT_ONCE", 250)  # blocks that begin and end within the clips of a body
    together = fit_to_body(replace(walkers, clips=cut), PERSON, shape)
    for clip, clip_shape, fitted_clip in zip(cut, shape, together, strict=True):
        (separate,) = fit_to_body(replace(walkers, clips=[clip]), PERSON, clip_shape)
        np.testing.assert_allclose(fitted_clip.positions, separate.positions, atol=1e-6)
        np.testing.assert_allclose(fitted_clip.rotations, separate.rotations, atol=1e-6)


# ------------------------------------------------------------------------------------------------------------- turns


def person_in_motion(shape, joint_rotations, translation=None, fps=30.0, up="y"):
    """Return motion (N, T) of the person as a set without a rest pose."""
    translation = torch.zeros(*joint_rotations.shape[:2], 3) if translation is None else translation
    joints = PERSON(shape.float(), joint_rotations.float(), translation.float())[1].numpy()
    skeleton = Skeleton(PERSON.names, PERSON.parents, *sides(PERSON.names), up, fps)
    return MotionSet([Clip("all", f"{n}", clip) for n, clip in enumerate(joints)], skeleton)


def test_motion_of_the_person_with_a_straight_spine_is_recovered():
    """Joints do not determine the rotations of end joints and spines, and the twist of limbs."""
    shape, vectors = shapes(4), 0.8 * torch.randn(4, 30, 22, 3)
    vectors[:, :, [3, 6, 9]] = 0
    motion = person_in_motion(shape, rotations.to_matrix(vectors, "vector"), torch.randn(4, 30, 3))
    recovered = fit_to_body(motion, PERSON, shape)
    torch.testing.assert_close(positions(recovered), positions(motion), atol=1e-5, rtol=0)
    torch.testing.assert_close(shapes_of(recovered, PERSON), shape, atol=1e-5, rtol=0)


@pytest.mark.parametrize("file", ["bandai/bandai2.npz", "simulated"])
def test_limbs_and_trunks_keep_their_directions(recorded, walkers, on_body, file):
    motion, on_person = (walkers, on_body) if file == "simulated" else recorded(file)
    for start, end in LIMBS:
        torch.testing.assert_close(bone(on_person, start, end), bone(motion, start, end), atol=1e-4, rtol=0)
    for part in ("hip", "shoulder"):
        left, right = f"l {part}", f"r {part}"
        cosine = (bone(on_person, left, right) * bone(motion, left, right)).sum(-1)
        assert cosine.min() > np.cos(0.3)


@pytest.mark.parametrize("file", ["cmu/cmu8.npz", "simulated"])
def test_knees_and_elbows_bend_the_right_way(recorded, on_body, file):
    """Knees bend backwards from the thigh, elbows forwards from the upper arm, within 45 degrees."""
    on_person = on_body if file == "simulated" else recorded(file)[1]
    joint_rotations = torch.cat(
        [rotations.to_matrix(torch.from_numpy(clip.rotations), "quaternion") for clip in on_person]
    )
    for part, hinge in (("knee", (1.0, 0, 0)), ("elbow", (0.0, -1, 0))):
        for side, mirror in (("l", 1), ("r", -1)):
            joint = OWN[f"{side} {part}"]
            vectors = rotations.from_matrix(joint_rotations[:, joint], "vector").double()
            along = vectors @ torch.tensor([hinge[0], mirror * hinge[1], mirror * hinge[2]]).double()
            bent = vectors.norm(dim=-1) > 0.5
            assert (along / vectors.norm(dim=-1))[bent].min() > 0.7


def test_the_fit_is_the_same_for_every_up_axis(walkers, on_body):
    stood = [replace(clip, positions=clip.positions[..., [0, 2, 1]] * np.float32([1, -1, 1])) for clip in walkers]
    again = fit_to_body(MotionSet(stood, replace(walkers.skeleton, up="z")), PERSON)
    assert again.skeleton.up == "y"
    torch.testing.assert_close(positions(again), positions(on_body), atol=1e-5, rtol=0)


# -------------------------------------------------------------------------------------------------------- retargeting


def test_retargeting_keeps_rotations_and_speed_in_leg_lengths(on_body):
    original, other = shapes_of(on_body, PERSON), shapes(len(on_body), 2)
    moving = retarget(on_body, PERSON, other)
    torch.testing.assert_close(shapes_of(moving, PERSON), other, atol=1e-5, rtol=0)
    torch.testing.assert_close(joints_of(moving, other), positions(moving), atol=5e-6, rtol=0)
    legs = []
    for shape in (original, other):
        vertices, joints = PERSON.at_rest(shape.float())
        legs.append((joints[:, 0, 1] - vertices[..., 1].amin(-1)).numpy())
    for clip, source, leg, before in zip(moving, on_body, legs[1], legs[0], strict=True):
        np.testing.assert_allclose(clip.rotations, source.rotations, atol=1e-6)
        speeds = [np.diff(each.positions[:, 0], axis=0) / length for each, length in ((clip, leg), (source, before))]
        np.testing.assert_allclose(*speeds, atol=1e-5)


def test_a_retargeted_standing_body_stays_on_the_floor():
    shape, other = shapes(6), shapes(6, 2)
    unturned = torch.eye(3).expand(6, 3, 22, 3, 3)
    low = -PERSON.at_rest(shape.float())[0][..., 1].amin(-1)
    rise = torch.stack([torch.zeros(6), low, torch.zeros(6)], -1)[:, None].expand(6, 3, 3)
    standing = fit_to_body(person_in_motion(shape, unturned, rise), PERSON, shape)
    retargeted = retarget(standing, PERSON, other)
    places = torch.from_numpy(np.stack([clip.positions[:, 0] for clip in retargeted]))
    soles = PERSON(other.float(), unturned, places)[0][..., 1].amin(-1)
    torch.testing.assert_close(soles, torch.zeros(6, 3), atol=1e-5, rtol=0)


# -------------------------------------------------------------------------------------------------------------- AMASS


def test_amass_files_contain_rotations_and_betas(tmp_path):
    """Use the layout of AMASS: 52 joints as rotation vectors, z up, sixteen betas, no bone lengths."""
    shape, random = shapes(2), np.random.default_rng(0)
    recordings = []
    for n in range(2):
        poses, trans = 0.4 * random.standard_normal((7, 156)), random.standard_normal((7, 3))
        recordings.append((poses, trans))
        metadata = {"betas": np.concatenate([shape[n].numpy(), np.ones(8)]), "mocap_framerate": np.array(60.0)}
        np.savez(tmp_path / f"{n}.npz", poses=poses, trans=trans, gender=np.array("female"), **metadata)
    motion = read_motion(tmp_path)
    torch.testing.assert_close(betas(motion), shape)
    on_person = fit_to_body(motion, PERSON, betas(motion))
    torch.testing.assert_close(shapes_of(on_person, PERSON), shape, atol=1e-5, rtol=0)
    exact, lying = deepcopy(PERSON).double(), torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).double()  # z to y
    for clip, clip_shape, (poses, trans) in zip(on_person, shape, recordings, strict=True):
        joint_rotations = rotations.to_matrix(torch.from_numpy(poses[:, :66]).unflatten(-1, (-1, 3)), "vector")
        expected = exact(clip_shape, joint_rotations, torch.from_numpy(trans))[1] @ lying.T
        np.testing.assert_allclose(clip.positions, expected, atol=1e-5)
    assert fit_to_body(motion, PERSON).skeleton.names == PERSON.names


# -------------------------------------------------------------------------------------------------------------- errors


def test_motion_that_does_not_fit_a_body_is_an_error(walkers, on_body):
    with pytest.raises(ValueError, match="has no betas, expected 8"):
        betas(walkers)
    armless = select_joints(walkers, [name for name in walkers.skeleton.names if "Wrist" not in name])
    with pytest.raises(ValueError, match="has no l wrist, r wrist"):
        fit_to_body(armless, PERSON)
    hidden = walkers.clips[0].positions.copy()
    hidden[3, 5] = np.nan
    gaps = MotionSet([replace(walkers.clips[0], positions=hidden)], walkers.skeleton, missing=True)
    with pytest.raises(ValueError, match="has missing joints"):
        fit_to_body(gaps, PERSON)
    with pytest.raises(ValueError, match=r"expected \(8,\) for all clips or \(6, 8\)"):
        retarget(on_body, PERSON, torch.zeros(5, 8))
    with pytest.raises(ValueError, match="convert it with dvae"):
        shapes_of(walkers.with_rotations(), PERSON)
    tensors = [getattr(PERSON, name) for name in ("template", "shapes", "regressor", "weights", "faces")]
    with pytest.raises(ValueError, match="the body has no pelvis"):
        fit_to_body(walkers, Body([f"joint {n}" for n in range(22)], PERSON.parents, *tensors))
