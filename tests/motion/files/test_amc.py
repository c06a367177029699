"""ASF/AMC files and exponential maps: the same motion as in the archive of positions."""

from dataclasses import replace

import numpy as np
import pytest

from dvae.motion import read_motion
from dvae.motion.files.amc import read_amc, read_expmap
from dvae.motion.geometry.skeleton import HUMAN36M_ANGLES

LEGS = [f"{side}{bone}" for side in "lr" for bone in ("femur", "tibia", "foot", "toes")]
ARMS = [f"{side}{bone}" for side in "lr" for bone in ("humerus", "radius", "hand")]
JOINTS = ["root", *LEGS, "upperback", "thorax", "lowerneck", "upperneck", "head", "headEnd", *ARMS]
"""Where the joints of the archive stand, in its order."""

ASF = """:version 1.10
:units
  length 1
  angle deg
:root
  order TX TY TZ RX RY RZ
  axis XYZ
:bonedata
  begin
    id 1
    name thigh
    direction 0 -1 0
    length 4
    axis 0 0 90 XYZ
    dof rx
  end
  begin
    name shin
    direction 0 -1 0
    length 3
    axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root thigh
    thigh shin
  end
"""
AMC = ":FULLY-SPECIFIED\n:DEGREES\n1\nroot 0 0 0 0 0 0\nthigh 0\n2\nroot 1 2 3 0 90 0\nthigh 90\n"


def projected(recording):
    return recording.metres * recording.positions[:, [recording.names.index(joint) for joint in JOINTS]]


@pytest.mark.parametrize(
    ("reader", "file", "key"),
    [
        (read_amc, "asfamc/02_01.amc", ("train", "walking_1")),
        (read_expmap, "expmap/train_walking_extra_22.txt", ("train", "walking_extra_22")),  # half a turn, facing away
    ],
)
def test_motion_equals_the_archive_to_a_tenth_of_a_millimetre(reader, file, key, shared, real):
    positions = real("cmu/cmu8.npz")[key].positions
    recording = reader(shared(f"cmu_raw/{file}"))
    assert (recording.fps, recording.up) == (120, "y")
    every_fourth = projected(recording)[::4]
    assert every_fourth.shape == positions.shape
    np.testing.assert_allclose(every_fourth, positions, atol=1e-4)


def test_a_bone_rotates_about_its_own_axes_together_with_its_children(tmp_path):
    (tmp_path / "a.asf").write_text(ASF)
    (tmp_path / "a_1.amc").write_text(AMC)
    recording = read_amc(tmp_path / "a_1.amc")
    assert recording.names == ["root", "thigh", "shin", "shinEnd"]
    assert recording.metres == 0.0254
    np.testing.assert_allclose(recording.positions[0], [[0, 0, 0], [0, 0, 0], [0, -4, 0], [0, -7, 0]], atol=1e-9)
    # its x axis is the world's y; a bone along it is not moved by its own 90 degrees, but by the root's
    np.testing.assert_allclose(recording.positions[1], [[1, 2, 3], [1, 2, 3], [1, -2, 3], [1, -5, 3]], atol=1e-9)
    (tmp_path / "a.asf").write_text(ASF.replace("0 0 90 XYZ", "0 0 0 XYZ"))
    recording = read_amc(tmp_path / "a_1.amc")  # -y about x to -z, and that about y to -x
    np.testing.assert_allclose(recording.positions[1], [[1, 2, 3], [1, 2, 3], [-3, 2, 3], [-6, 2, 3]], atol=1e-9)
    (tmp_path / "r.amc").write_text(AMC.replace("DEGREES", "RADIANS").replace("90", str(np.pi / 2)))
    np.testing.assert_allclose(read_amc(tmp_path / "r.amc").positions, recording.positions, atol=1e-9)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("asf", ":bonedata", ":nothing", "no :bonedata"),
        ("asf", "root thigh", "head thigh", "the parent of 'thigh' is 'head'"),
        ("asf", "length 4", "length four", "length of thigh: 'four' is not a number"),
        ("asf", "direction 0 -1 0", "direction 0 -1", "direction of thigh has 2 numbers"),
        ("asf", "direction 0 -1 0\n", "", "line 15 ends a bone without"),
        ("asf", "dof rx", "dof rx tx", "a dof of rx, ry and rz"),
        ("asf", "order TX", "order RX", "expected TX, TY, TZ, RX, RY and RZ"),
        ("amc", "thigh 90", "thigh 90 1", "line 8 is 'thigh 90 1'"),
        ("amc", "thigh 90", "", "frame 2 has no row for the bone thigh"),
    ],
)
def test_a_damaged_file_is_an_error_with_its_line(file, old, new, message, tmp_path):
    texts = {"asf": ASF, "amc": AMC}
    texts[file] = texts[file].replace(old, new, 1)
    for name, text in texts.items():
        (tmp_path / f"a.{name}").write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        read_amc(tmp_path / "a.amc")
    assert str(tmp_path / f"a.{file}") in str(error.value)


def test_the_skeleton_has_the_name_of_the_recording_or_its_subject(tmp_path):
    (tmp_path / "02_01.amc").write_text(AMC)
    with pytest.raises(FileNotFoundError, match="cannot choose its skeleton"):
        read_amc(tmp_path / "02_01.amc")
    for name in ("01.asf", "02.asf"):
        (tmp_path / name).write_text(ASF if name == "02.asf" else "")
    assert len(read_amc(tmp_path / "02_01.amc").positions) == 2


def human36m_rows(frames=6, seed=0):
    """Return rows of 99 numbers. As in Human3.6M, joints without children are not rotated."""
    random = np.random.default_rng(seed)
    rows = random.normal(size=(frames, 33, 3)) * np.array([30, 0.1, *[0.4] * 31])[:, None]
    rows[:, [1 + joint for joint in range(32) if joint not in HUMAN36M_ANGLES.parents]] = 0
    return rows.reshape(frames, 99)


def row_matrix(vector):
    """Return the rotation matrix of a vector by Rodrigues' formula."""
    angle = np.linalg.norm(vector)
    x, y, z = vector / (angle or 1)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def test_human36m_is_placed_as_by_the_public_code(tmp_path):
    """Matrices of the public code act on rows; a root's movement is in its own axes of the frame before."""
    (tmp_path / "S5").mkdir()
    rows = human36m_rows()
    np.savetxt(tmp_path / "S5" / "walking_1.txt", rows, delimiter=",")
    turn, place = np.eye(3), np.zeros(3)
    positions = []
    for row in rows.reshape(len(rows), 33, 3):
        place = place + turn.T @ row[0]
        turn = row_matrix(row[1]) @ turn
        joints, turns = [place / 1000], [turn]
        for joint, parent in list(enumerate(HUMAN36M_ANGLES.parents))[1:]:
            joints.append(HUMAN36M_ANGLES.offsets[joint].numpy() @ turns[parent] + joints[parent])
            turns.append(row_matrix(row[1 + joint]) @ turns[parent])
        positions.append(joints)
    recording = read_expmap(tmp_path / "S5" / "walking_1.txt")
    assert (recording.fps, recording.up, recording.labels) == (50, "y", {"action": "walking"})
    np.testing.assert_allclose(recording.metres * recording.positions, positions, atol=1e-9)
    people = read_motion(tmp_path)
    assert replace(people.skeleton, rest=HUMAN36M_ANGLES.rest) == HUMAN36M_ANGLES
    np.testing.assert_allclose(people.skeleton.rest, HUMAN36M_ANGLES.rest, atol=1e-12)
    assert people.clips[0].key == ("S5", "walking_1")
    assert people.clips[0].labels["action"] == "walking"
    halved = people.resample(25)
    np.testing.assert_array_equal(halved.clips[0].rotations, people.clips[0].rotations[::2])


def test_a_human36m_file_with_a_short_row_is_an_error(tmp_path):
    np.savetxt(tmp_path / "a.txt", human36m_rows(), delimiter=",")
    with (tmp_path / "a.txt").open("a") as file:
        file.write("1,2,3\n")
    with pytest.raises(ValueError, match="got 597 numbers, expected rows of 99"):
        read_expmap(tmp_path / "a.txt")


@pytest.mark.parametrize("text", ["", "0 " * 117, "0 " * 233 + "nan"])
def test_invalid_exponential_maps_are_errors(text, tmp_path):
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(ValueError, match=r"two or more rows of 117|not a number"):
        read_expmap(tmp_path / "a.txt")
