"""Motion on a body: whose it is, limbs point where they did, nothing is twisted, and it travels through frames."""

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
    """Of people (N, 8) whose girth is average, as joints do not tell it."""
    found = spread * torch.randn(people, len(SHAPE), dtype=torch.float64).clamp(-2, 2)
    found[:, SHAPE.index("girth")] = 0
    return found


def places(motion, part):
    """Of all frames, (F, 3)."""
    joint = parts(motion.skeleton.names)[part]
    return torch.from_numpy(np.concatenate([clip.positions[:, joint] for clip in motion])).double()


def bone(motion, start, end):
    return torch.nn.functional.normalize(places(motion, end) - places(motion, start), dim=-1)


def joints_of(motion, shape):
    """Of all frames, the body's joints (F, 22, 3) from turns, places and shapes."""
    found = []
    for clip, own in zip(motion, shape.float(), strict=True):
        turns = rotations.to_matrix(torch.from_numpy(clip.rotations), "quaternion")
        translation = torch.from_numpy(clip.positions[:, 0]) - PERSON.at_rest(own)[1][0]
        found.append(PERSON(own, turns, translation)[1])
    return torch.cat(found)


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
    """Some clips of a source, and the same on the body."""

    def read(file):
        motion = real(file)
        some = replace(motion, clips=motion.clips[:: -(-len(motion) // 8)])
        return some, fit_to_body(some, PERSON)

    return read


# ------------------------------------------------------------------------------------------------------------ shapes


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_offsets_tell_the_shape(dtype):
    expected = shapes(50).to(dtype)
    found = PERSON.shape_of(PERSON.offsets(expected))
    assert found.dtype == dtype
    torch.testing.assert_close(found, expected, atol=3e-5 if dtype == torch.float32 else 1e-9, rtol=0)


def test_clips_together_are_put_onto_the_body_as_each_alone(walkers, monkeypatch):
    cut = [replace(part, name=f"{clip.name}-{n}") for clip in walkers for n, part in enumerate((clip, clip))]
    shape = shapes(6).repeat_interleave(torch.tensor([1, 3, 2, 2, 3, 1]), dim=0)
    monkeypatch.setattr(fitting, "AT_ONCE", 250)  # blocks that begin and end amid clips of one body
    together = fit_to_body(replace(walkers, clips=cut), PERSON, shape)
    for clip, own, found in zip(cut, shape, together, strict=True):
        (alone,) = fit_to_body(replace(walkers, clips=[clip]), PERSON, own)
        np.testing.assert_allclose(found.positions, alone.positions, atol=1e-6)
        np.testing.assert_allclose(found.rotations, alone.rotations, atol=1e-6)


# ------------------------------------------------------------------------------------------------------------- turns


def moved(shape, turns, translation=None, fps=30.0, up="y"):
    """The person in motion (N, T) as a set without a rest pose."""
    translation = torch.zeros(*turns.shape[:2], 3) if translation is None else translation
    joints = PERSON(shape.float(), turns.float(), translation.float())[1].numpy()
    skeleton = Skeleton(PERSON.names, PERSON.parents, *sides(PERSON.names), up, fps)
    return MotionSet([Clip("all", f"{n}", clip) for n, clip in enumerate(joints)], skeleton)


def test_the_person_in_motion_is_found_where_the_spine_does_not_bend():
    """Every turn but of ends and of spines is seen by joints; of limbs, these do not tell the turn about themselves."""
    shape, vectors = shapes(4), 0.8 * torch.randn(4, 30, 22, 3)
    vectors[:, :, [3, 6, 9]] = 0
    motion = moved(shape, rotations.to_matrix(vectors, "vector"), torch.randn(4, 30, 3))
    found = fit_to_body(motion, PERSON, shape)
    torch.testing.assert_close(positions(found), positions(motion), atol=1e-5, rtol=0)
    torch.testing.assert_close(shapes_of(found, PERSON), shape, atol=1e-5, rtol=0)


@pytest.mark.parametrize("file", ["bandai/bandai2.npz", "simulated"])
def test_limbs_point_where_they_did_and_trunks_face_there(recorded, walkers, on_body, file):
    motion, found = (walkers, on_body) if file == "simulated" else recorded(file)
    for start, end in LIMBS:
        torch.testing.assert_close(bone(found, start, end), bone(motion, start, end), atol=1e-4, rtol=0)
    for part in ("hip", "shoulder"):
        left, right = f"l {part}", f"r {part}"
        cosine = (bone(found, left, right) * bone(motion, left, right)).sum(-1)
        assert cosine.min() > np.cos(0.3)


@pytest.mark.parametrize("file", ["cmu/cmu8.npz", "simulated"])
def test_nothing_is_twisted(recorded, on_body, file):
    """Seen from the thigh, knees bend backwards, and seen from the upper arm, elbows forwards, within 45 degrees."""
    found = on_body if file == "simulated" else recorded(file)[1]
    turns = torch.cat([rotations.to_matrix(torch.from_numpy(clip.rotations), "quaternion") for clip in found])
    for part, hinge in (("knee", (1.0, 0, 0)), ("elbow", (0.0, -1, 0))):
        for side, mirror in (("l", 1), ("r", -1)):
            joint = OWN[f"{side} {part}"]
            vectors = rotations.from_matrix(turns[:, joint], "vector").double()
            along = vectors @ torch.tensor([hinge[0], mirror * hinge[1], mirror * hinge[2]]).double()
            bent = vectors.norm(dim=-1) > 0.5
            assert (along / vectors.norm(dim=-1))[bent].min() > 0.7


def test_it_does_not_matter_which_axis_is_up(walkers, on_body):
    stood = [replace(clip, positions=clip.positions[..., [0, 2, 1]] * np.float32([1, -1, 1])) for clip in walkers]
    again = fit_to_body(MotionSet(stood, replace(walkers.skeleton, up="z")), PERSON)
    assert again.skeleton.up == "y"
    torch.testing.assert_close(positions(again), positions(on_body), atol=1e-5, rtol=0)


# -------------------------------------------------------------------------------------------------------- retargeting


def test_other_bodies_make_the_same_turns_at_the_same_speed_in_legs(on_body):
    own, other = shapes_of(on_body, PERSON), shapes(len(on_body), 2)
    moving = retarget(on_body, PERSON, other)
    torch.testing.assert_close(shapes_of(moving, PERSON), other, atol=1e-5, rtol=0)
    torch.testing.assert_close(joints_of(moving, other), positions(moving), atol=5e-6, rtol=0)
    legs = []
    for shape in (own, other):
        vertices, joints = PERSON.at_rest(shape.float())
        legs.append((joints[:, 0, 1] - vertices[..., 1].amin(-1)).numpy())
    for clip, source, leg, before in zip(moving, on_body, legs[1], legs[0], strict=True):
        np.testing.assert_allclose(clip.rotations, source.rotations, atol=1e-6)
        speeds = [np.diff(each.positions[:, 0], axis=0) / length for each, length in ((clip, leg), (source, before))]
        np.testing.assert_allclose(*speeds, atol=1e-5)


def test_whoever_stands_stays_on_the_floor():
    shape, other = shapes(6), shapes(6, 2)
    unturned = torch.eye(3).expand(6, 3, 22, 3, 3)
    low = -PERSON.at_rest(shape.float())[0][..., 1].amin(-1)
    rise = torch.stack([torch.zeros(6), low, torch.zeros(6)], -1)[:, None].expand(6, 3, 3)
    standing = fit_to_body(moved(shape, unturned, rise), PERSON, shape)
    made = retarget(standing, PERSON, other)
    places = torch.from_numpy(np.stack([clip.positions[:, 0] for clip in made]))
    soles = PERSON(other.float(), unturned, places)[0][..., 1].amin(-1)
    torch.testing.assert_close(soles, torch.zeros(6, 3), atol=1e-5, rtol=0)


# -------------------------------------------------------------------------------------------------------------- AMASS


def test_files_of_amass_bring_turns_and_betas(tmp_path):
    """As AMASS has them: 52 joints as vectors, z up, sixteen betas, and no lengths of bones."""
    shape, random = shapes(2), np.random.default_rng(0)
    written = []
    for n in range(2):
        poses, trans = 0.4 * random.standard_normal((7, 156)), random.standard_normal((7, 3))
        written.append((poses, trans))
        beside = {"betas": np.concatenate([shape[n].numpy(), np.ones(8)]), "mocap_framerate": np.array(60.0)}
        np.savez(tmp_path / f"{n}.npz", poses=poses, trans=trans, gender=np.array("female"), **beside)
    motion = read_motion(tmp_path)
    torch.testing.assert_close(betas(motion), shape)
    found = fit_to_body(motion, PERSON, betas(motion))
    torch.testing.assert_close(shapes_of(found, PERSON), shape, atol=1e-5, rtol=0)
    exact, lying = deepcopy(PERSON).double(), torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).double()  # z to y
    for clip, own, (poses, trans) in zip(found, shape, written, strict=True):
        turns = rotations.to_matrix(torch.from_numpy(poses[:, :66]).unflatten(-1, (-1, 3)), "vector")
        expected = exact(own, turns, torch.from_numpy(trans))[1] @ lying.T
        np.testing.assert_allclose(clip.positions, expected, atol=1e-5)
    assert fit_to_body(motion, PERSON).skeleton.names == PERSON.names


# ------------------------------------------------------------------------------------------------------ what is refused


def test_what_cannot_be_put_onto_a_body_is_refused(walkers, on_body):
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
    with pytest.raises(ValueError, match=r"expected \(8,\) or \(6, 8\)"):
        retarget(on_body, PERSON, torch.zeros(5, 8))
    with pytest.raises(ValueError, match="fit_to_body converts it"):
        shapes_of(walkers.with_rotations(), PERSON)
    tensors = [getattr(PERSON, name) for name in ("template", "shapes", "regressor", "weights", "faces")]
    with pytest.raises(ValueError, match="the body has no pelvis"):
        fit_to_body(walkers, Body([f"joint {n}" for n in range(22)], PERSON.parents, *tensors))
