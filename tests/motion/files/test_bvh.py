"""BVH files: read as animation programs do, written, and errors for damaged files."""

import re

import numpy as np
import pytest

from dvae.motion.files.bvh import read_bvh, write_bvh

SMALL = """HIERARCHY
ROOT hip
{
  OFFSET 1 2 3
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT a knee
  {
    OFFSET 0 -10 0
    CHANNELS 4 Xrotation Xposition Yposition Zposition
    End Site
    {
      OFFSET 0 -5 0
    }
  }
  JOINT arm
  {
    OFFSET 3 0 0
    CHANNELS 2 Yrotation Zrotation
    End Site
    {
      OFFSET 1 0 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0333333
0 0 0 0 0 0   0 0 -10 0    0 0
5 6 7 90 0 0  90 1 -11 2   90 90
"""


def turn(axis, degrees):
    """Return rotation matrices (F, 3, 3) about one axis."""
    cos, sin = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    first, second = {"X": (1, 2), "Y": (2, 0), "Z": (0, 1)}[axis]
    matrices = np.eye(3)[None].repeat(len(cos), 0)
    matrices[:, first, first], matrices[:, second, second] = cos, cos
    matrices[:, first, second], matrices[:, second, first] = -sin, sin
    return matrices


def played(text):
    """Return positions (F, J, 3) by the definition of the format, token by token."""
    head, _, frames = text.partition("MOTION")
    words, values = head.split(), np.array(frames.split()[5:], float)
    joints, above, place = [], [], 1
    while place < len(words):
        word = words[place]
        if word in ("ROOT", "JOINT", "End"):
            joints.append({"parent": above[-1] if above else None, "channels": []})
        elif word == "{":
            above.append(len(joints) - 1)
        elif word == "}":
            above.pop()
        elif word == "OFFSET":
            joints[above[-1]]["offset"] = np.array(words[place + 1 : place + 4], float)
        elif word == "CHANNELS":
            joints[above[-1]]["channels"] = words[place + 2 : place + 2 + int(words[place + 1])]
        place += 1
    values = values.reshape(-1, sum(len(joint["channels"]) for joint in joints))
    column = 0
    for joint in joints:
        position, rotated = joint["offset"][None].repeat(len(values), 0), np.eye(3)[None].repeat(len(values), 0)
        for channel in joint["channels"]:
            if channel.endswith("position"):
                position[:, "XYZ".index(channel[0])] = values[:, column]
            else:
                rotated = rotated @ turn(channel[0], values[:, column])
            column += 1
        parent = None if joint["parent"] is None else joints[joint["parent"]]
        joint["at"] = position if parent is None else parent["at"] + np.einsum("fij,fj->fi", parent["turned"], position)
        joint["turned"] = rotated if parent is None else parent["turned"] @ rotated
    return np.stack([joint["at"] for joint in joints], 1)


@pytest.fixture(params=["small", "bvh/indian_13.bvh"])
def sample(request, shared, tmp_path):
    if request.param != "small":
        return shared(f"cmu_raw/{request.param}")
    (tmp_path / "small.bvh").write_text(SMALL.replace("a knee", "knee"))
    return tmp_path / "small.bvh"


def test_samples_are_read_as_the_format_says(sample):
    recording = read_bvh(sample)
    np.testing.assert_allclose(recording.positions, played(sample.read_text()), atol=1e-9)
    assert recording.rotations.shape == (*recording.positions.shape[:2], 4)
    if sample.name == "small.bvh":
        assert (recording.names, recording.fps) == (["hip", "knee", "kneeEnd", "arm", "armEnd"], 30)


def test_samples_are_written_and_read_back_to_a_tenth_of_a_millimetre(shared, tmp_path):
    recording = read_bvh(shared("cmu_raw/bvh/indian_13.bvh"))  # in centimetres
    rest, root = recording.offsets / 100, recording.positions[:, 0] / 100
    write_bvh(tmp_path / "a.bvh", recording.names, recording.parents, rest, recording.rotations, root, recording.fps)
    again = read_bvh(tmp_path / "a.bvh")
    assert (again.names, again.parents, again.fps) == (recording.names, recording.parents, recording.fps)
    np.testing.assert_allclose(again.positions, recording.positions, atol=1e-3)


HEAD, FRAMES = SMALL.replace("a knee", "knee").split("Frame Time")


@pytest.mark.parametrize(
    "head",
    [
        re.sub(r"\s*\n\s*{", "{", HEAD),
        re.sub(r"\s*}", "}", HEAD),
        "\n".join(HEAD.split()) + "\n",
        HEAD.lower(),
    ],
    ids=["brace at the name", "brace after a number", "a line each", "lower case"],
)
def test_line_breaks_are_irrelevant(head, tmp_path):
    (tmp_path / "a.bvh").write_text(SMALL.replace("a knee", "knee"))
    (tmp_path / "b.bvh").write_text(f"{head}Frame Time{FRAMES}")
    usual, other = read_bvh(tmp_path / "a.bvh"), read_bvh(tmp_path / "b.bvh")
    assert (other.names, other.parents, other.fps) == (usual.names, usual.parents, usual.fps)
    np.testing.assert_array_equal(other.positions, usual.positions)


def test_written_files_have_the_layout_that_animation_programs_import(tmp_path):
    (tmp_path / "a.bvh").write_text(SMALL.replace("a knee", "knee"))
    recording = read_bvh(tmp_path / "a.bvh")
    write_bvh(
        tmp_path / "b.bvh",
        recording.names,
        recording.parents,
        recording.offsets,
        recording.rotations,
        recording.positions[:, 0],
        25.0,
    )
    lines = [line.strip() for line in (tmp_path / "b.bvh").read_text().splitlines()]
    assert lines[:4] == ["HIERARCHY", "ROOT hip", "{", "OFFSET 0.000000 0.000000 0.000000"]
    assert lines[4] == "CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation"
    assert lines.count("CHANNELS 3 Zrotation Yrotation Xrotation") == 4
    assert (lines.count("End Site"), lines.count("{"), lines.count("}")) == (2, 7, 7)
    motion = lines.index("MOTION")
    assert lines[motion + 1 : motion + 3] == ["Frames: 2", "Frame Time: 0.04000000"]
    assert [len(line.split()) for line in lines[motion + 3 :]] == [18, 18]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("MOTION", "", "line 26 is 'Frames: 2'"),
        ("Frames: 2", "Frames: 200", "expected 200 frames of 12 channels"),
        ("0.0333333", "0", "a frame time above 0"),
        ("OFFSET 3 0 0", "OFFSET 3 0", "expected three numbers"),
        ("OFFSET 3 0 0", "OFFSET 3 0 inf", "line 17: 'inf' is not a number"),
        ("CHANNELS 2 ", "CHANNELS 3 ", "expected the number of channels"),
        ("CHANNELS 2 Yrotation", "CHANNELS 2 Zrotation", "each once"),
        ("5 6 7 90", "5 6 90", "expected 2 frames"),
        ("JOINT arm", "JOINT hip", "another joint 'hip'"),
        ("JOINT arm\n  {", "JOINT arm", "line 16"),
        ("HIERARCHY", "<html>", "expected ROOT"),
    ],
)
def test_a_damaged_file_is_an_error_with_its_line(old, new, message, tmp_path):
    path = tmp_path / "a.bvh"
    path.write_text(SMALL.replace(old, new, 1))
    with pytest.raises(ValueError, match=message) as error:
        read_bvh(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("seconds", "fps"),
    [
        *(("0.0333", 30), ("0.033333", 30), ("0.0083333", 120), ("1", 1), ("2.5", 0.4), ("0.0123", 1 / 0.0123)),
        *(("0.016683", 60 / 1.001), ("0.0333666", 30 / 1.001), ("0.041708", 24 / 1.001)),
    ],
)
def test_a_rate_has_the_digits_of_its_frame_time(tmp_path, seconds, fps):
    text = re.sub(r"Frame Time:.*", f"Frame Time: {seconds}", SMALL.replace("a knee", "knee"))
    (tmp_path / "a.bvh").write_text(text)
    assert read_bvh(tmp_path / "a.bvh").fps == pytest.approx(fps, rel=1e-9)
