"""Recordings that somebody else made, of every format: read right, or refused in a sentence, whatever is in them."""

import io
import shutil
import struct

import numpy as np
import pytest
import roma  # noqa: F401, it makes folders as it is imported, which what is watched must not
from c3d import write_c3d
from hypothesis import strategies as st

from dvae.motion import read_motion, simulate, write_motion
from dvae.motion.files.amc import SUBJECT_02
from dvae.motion.geometry.skeleton import is_name

from .damage import array_changes, changed, edited, edits
from .engine import Isolated, fuzz, limited

SHARE = 4
WORDS = [b"0", b"-1", b"1e308", b"1e-320", b"nan", b"inf", b"9" * 30, b"}", b"{", b"\n", b" ", b"\0", b"JOINT x\n"]


def bvh(folder):
    write_motion(folder / "a.bvh", simulate(1, 3).with_rotations())


def amc(folder):
    bones = [f"begin\nid {i}\nname b{i}\ndirection 0 1 0\nlength 5\naxis 0 0 9 XYZ\ndof rx ry\nend\n" for i in range(6)]
    tree = "".join(f"{'b' + str(i - 1) if i else 'root'} b{i}\n" for i in range(6))
    head = ":version 1.10\n:units\nlength 0.45\nangle deg\n:root\norder TX TY TZ RX RY RZ\naxis XYZ\n:bonedata\n"
    (folder / "a.asf").write_text(f"{head}{''.join(bones)}:hierarchy\nbegin\n{tree}end\n")
    frames = [f"{n}\nroot 0 1 {n} 2 3 4\n" + "".join(f"b{i} {n} 9\n" for i in range(6)) for n in range(1, 4)]
    (folder / "a.amc").write_text(":FULLY-SPECIFIED\n:DEGREES\n" + "".join(frames))


def expmap(folder):
    row = ",".join(f"{0.1 * (n % 7):.3f}" for n in range(3 + 3 * (len(SUBJECT_02) + 8)))
    (folder / "a.txt").write_text(f"{row}\n" * 3)


def csv(folder):
    write_motion(folder / "a.csv", simulate(1, 3))


def amass(folder):
    write_motion(folder / "a.npz", simulate(1, 3), "amass")


def c3d(folder):
    places = [[(0, 0, 1700, 0), (10, 0, 900, 0), (0, 20, 10, 0)]] * 4
    write_c3d(folder / "a.c3d", ["HEAD", "HIP", "FOOT"], np.add(places, [[[n, 0, 0, 0]] for n in range(4)]))


SAMPLES = {"bvh": (bvh, "a.bvh"), "amc": (amc, "a.amc"), "asf": (amc, "a.asf"), "expmap": (expmap, "a.txt")}
SAMPLES |= {"csv": (csv, "a.csv"), "amass": (amass, "a.npz"), "c3d": (c3d, "a.c3d")}


def small(format, folder):
    """A sample in a folder of its own, what of it is mutated, and what is read."""
    make, name = SAMPLES[format]
    make(folder)
    return folder / name, folder / ("a.amc" if format == "asf" else name)


@pytest.mark.parametrize("format", SAMPLES)
def test_what_was_not_changed_is_read(format, tmp_path):
    _, path = small(format, tmp_path)
    assert read_motion(path).clips[0].frames == (4 if format == "c3d" else 2 if format == "expmap" else 3)


def read_changed(example, directory):
    content, original, path = example
    for file in original.parent.iterdir():
        (directory / "now").mkdir(exist_ok=True)
        shutil.copyfile(file, directory / "now" / file.name)
    where = directory / "now" / path
    where.with_name(original.name).write_bytes(content)
    sentence = ""
    try:
        read_motion(where)
    except (ValueError, FileNotFoundError) as error:  # nothing else
        sentence = str(error)
    assert not sentence or str(where.parent) in sentence, f"{sentence!r} does not name the file"
    assert len(sentence) < 2500, f"{len(sentence)} characters"
    assert is_name(sentence[:1000]), f"{sentence!r} has control characters"


@limited(SHARE)
def test_damaged_files_are_read_or_refused(tmp_path):
    there = {}
    for format in SAMPLES:
        (tmp_path / format).mkdir()
        original, path = small(format, tmp_path / format)
        there[format] = original.read_bytes(), original, path.name
    arrays, check = dict(np.load(tmp_path / "amass" / "a.npz")), Isolated(read_changed, tmp_path)

    def damage(example):
        format, of_arrays, of_bytes = example
        content, *rest = there[format]
        if of_arrays:
            file = io.BytesIO()
            np.savez(file, **changed(arrays, of_arrays))
            content = file.getvalue()
        check((edited(content, of_bytes), *rest))

    lengths = st.sampled_from([0, 1, 2, 3, 22, 66, 100])
    with_arrays = st.tuples(st.just("amass"), array_changes(sorted(arrays), lengths), edits(most=1))
    fuzz(damage, st.tuples(st.sampled_from(sorted(SAMPLES)), st.just(()), edits(WORDS, 4)) | with_arrays, SHARE)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"Frames: 3", b"Frames: 999999999999"),
        (b"OFFSET 0.0", b"OFFSET " + b"9" * 10**6),
        (b"JOINT LHip", b"JOINT x\n{\n" * 5000),
    ],
    ids=["frames", "digits", "joints"],
)
def test_what_is_announced_takes_no_memory(old, new, tmp_path):
    original, path = small("bvh", tmp_path)
    content = original.read_bytes()
    assert old in content
    Isolated(read_changed, tmp_path)((content.replace(old, new, 1), original, path.name))
    original.write_bytes(content.replace(old, new, 1))
    with pytest.raises(ValueError, match=r"a\.bvh"):
        read_motion(original)


def test_parameters_without_end_take_no_time(tmp_path):
    """Eight megabytes of them: time that grows with their square would be a minute."""
    original, path = small("c3d", tmp_path)
    content = original.read_bytes()
    one = struct.pack("<bb", 1, 1) + b"A" + struct.pack("<h", 8) + struct.pack("<bBBB", -1, 2, 1, 1) + b"x\0"
    first = content.index(b"\x04\x01USED")
    for blocks in (0, 1, 255):
        head = content[:514] + bytes([blocks]) + content[515:first]
        changed = head + one * (2**23 // len(one)) + content[first:]
        Isolated(read_changed, tmp_path)((changed, original, path.name))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("poses", np.zeros((3, 65)), r"poses \(3, 65\), trans \(3, 3\), expected"),
        ("poses", np.full((3, 66), np.nan), "poses holds float64, expected numbers, none NaN"),
        ("poses", np.full((3, 66), "a"), "poses holds <U1"),
        ("poses", np.full((3, 66), 1e30), "no metre, radian or rate"),
        ("offsets", np.zeros((3, 3)), r"offsets \(3, 3\), expected \(22, 3\)"),
        ("offsets", np.zeros((22, 3)), "a person of"),
        ("mocap_framerate", np.array([30, 30]), "needs mocap_framerate"),
        ("mocap_framerate", np.array("30"), "mocap_framerate holds"),
    ],
)
def test_arrays_that_are_no_motion_are_refused(name, value, message, tmp_path):
    path, _ = small("amass", tmp_path)
    arrays = {**np.load(path), name: value}
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match=rf"a\.npz: .*{message}"):
        read_motion(path)


def test_another_npz_in_a_folder_of_motion_is_named_as_what_it_is(tmp_path):
    _, path = small("amass", tmp_path)
    np.savez(path.parent / "z.npz", weights=np.zeros(3))
    with pytest.raises(ValueError, match=r"z\.npz: it holds weights, expected AMASS's poses and trans"):
        read_motion(path.parent)
