"""Untrusted recordings of every format are read correctly, or are an error of one sentence."""

import io
import shutil
import struct
import zipfile

import numpy as np
import pytest
import roma  # noqa: F401, its import creates folders, which is not allowed later
from c3d import write_c3d
from hypothesis import strategies as st

from dvae.motion import MotionSet, read_motion, simulate, write_motion
from dvae.motion.files.amc import SUBJECT_02
from dvae.motion.geometry.skeleton import is_name

from .engine import Isolated, fuzz, limited
from .test_tables import edited

SHARE = 3
MUTATIONS = 100
"""Minimum number for each format."""


def bvh(folder):
    people = simulate(1, 3).with_rotations()
    write_motion(folder / "a.bvh", people)


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
    write_motion(folder / "a.csv", MotionSet(simulate(1, 3).clips, simulate(1, 3).skeleton))


def amass(folder):
    write_motion(folder / "a.npz", MotionSet(simulate(1, 3).clips, simulate(1, 3).skeleton), "amass")


def c3d(folder):
    places = [[(0, 0, 1700, 0), (10, 0, 900, 0), (0, 20, 10, 0)]] * 4
    write_c3d(folder / "a.c3d", ["HEAD", "HIP", "FOOT"], np.add(places, [[[n, 0, 0, 0]] for n in range(4)]))


SAMPLES = {"bvh": (bvh, "a.bvh"), "amc": (amc, "a.amc"), "asf": (amc, "a.asf"), "expmap": (expmap, "a.txt")}
SAMPLES |= {"csv": (csv, "a.csv"), "amass": (amass, "a.npz"), "c3d": (c3d, "a.c3d")}


def small(format, folder):
    """Write a sample to a folder; return the file to mutate and the file to read."""
    make, name = SAMPLES[format]
    make(folder)
    return folder / name, folder / ("a.amc" if format == "asf" else name)


@pytest.mark.parametrize("format", SAMPLES)
def test_unchanged_recordings_are_read(format, tmp_path):
    _, path = small(format, tmp_path)
    assert read_motion(path).clips[0].frames == (4 if format == "c3d" else 2 if format == "expmap" else 3)


def read_changed(example, directory):
    content, original, path = example
    for file in (directory / original).parent.iterdir():
        (directory / "now").mkdir(exist_ok=True)
        shutil.copyfile(file, directory / "now" / file.name)
    target = directory / "now" / path
    target.with_name(original.name).write_bytes(content)
    sentence = ""
    try:
        read_motion(target)
    except (ValueError, FileNotFoundError) as error:  # any other exception is a bug
        sentence = str(error)
    assert not sentence or str(target.parent) in sentence, f"{sentence!r} does not name the file"
    assert len(sentence) < 2500, f"{len(sentence)} characters"
    assert is_name(sentence[:1000]), f"{sentence!r} has control characters"


@pytest.fixture(scope="module")
def isolated(tmp_path_factory):
    with Isolated(read_changed, tmp_path_factory.mktemp("recordings")) as process:
        yield process


WORDS = [
    b"0",
    b"-1",
    b"1e308",
    b"1e-320",
    b"nan",
    b"inf",
    b"9" * 30,
    b"}",
    b"{",
    b"\n",
    b" ",
    b"\0",
    b"\xff\xfe",
    b"JOINT x\n",
]


def mutations(content, random):
    """Return the content with bytes changed, cut or repeated, words replaced, or the end removed."""
    text = content.split(b" ")
    kind = random.integers(6)
    if kind == 0:
        changed_bytes = bytearray(content)
        for _ in range(random.integers(1, 8)):
            changed_bytes[random.integers(len(changed_bytes))] = random.integers(256)
        return bytes(changed_bytes)
    if kind == 1:
        return content[: random.integers(len(content))]
    if kind == 2:
        start, end = sorted(random.integers(len(content), size=2))
        return content[:start] + content[end:]
    if kind == 3:
        start, end = sorted(random.integers(len(content), size=2))
        return content[:end] + content[start:end] * int(random.integers(1, 4)) + content[end:]
    for _ in range(random.integers(1, 4)):
        text[random.integers(len(text))] = WORDS[random.integers(len(WORDS))]
    return b" ".join(text)


def zipped(content, random):
    """Return an npz with one changed member: its bytes, or the values, shape or type of its array."""
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        members = {name: file.read(name) for name in file.namelist()}
    names = [name for name in members if name not in ("betas.npy", "gender.npy")]
    name = names[random.integers(len(names))]
    kind = random.integers(8)
    if kind == 0:
        members[name] = mutations(members[name], random)
    elif kind == 1:
        members[name] = members[names[random.integers(len(names))]]
    elif kind == 2:
        members[f"{name[:-4]}{random.integers(9)}.npy"] = members.pop(name)
    else:
        array, new = np.load(io.BytesIO(members[name])).copy(), io.BytesIO()
        if kind < 6:
            values = [np.nan, np.inf, -1e308, 1e-320, 1e6, -1.0, 0.0, np.pi]
            selected = random.random(array.shape) < (1 if array.ndim == 0 else random.random())
            array = np.where(selected, values[random.integers(len(values))], array)
        elif kind == 6:
            array = array.astype(["i8", "f2", "f4", "U3", "?", "c16", "S2"][random.integers(7)])
        else:
            shapes = [array[:1], array[..., :1], array[None], array.ravel(), array.T] if array.ndim else [array[None]]
            array = shapes[random.integers(len(shapes))]
        np.save(new, array)
        members[name] = new.getvalue()
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        for name, member in members.items():
            file.writestr(name, member)
    return archive.getvalue()


@pytest.mark.parametrize("format", SAMPLES)
def test_changed_recordings_are_read_or_an_error(format, isolated, tmp_path):
    target, path = small(format, tmp_path)
    content, random = target.read_bytes(), np.random.default_rng(0)
    for number in range(MUTATIONS):
        change = zipped if format == "amass" and number % 5 else mutations
        isolated((change(content, random), target, path.name))


def test_most_changed_archives_reach_the_reader_of_their_arrays(tmp_path):
    target, path = small("amass", tmp_path)
    content, random, messages = target.read_bytes(), np.random.default_rng(0), []
    for _ in range(100):
        target.write_bytes(zipped(content, random))
        try:
            read_motion(path)
        except ValueError as error:
            messages.append(str(error))
    assert len(messages) > 30
    assert sum("damaged" in sentence or "npy" in sentence for sentence in messages) < len(messages) / 3


edits = st.lists(
    st.tuples(
        st.floats(0, 1, exclude_max=True), st.integers(0, 12), st.one_of(st.binary(max_size=3), st.sampled_from(WORDS))
    ),
    min_size=1,
    max_size=4,
)


@limited(SHARE)
def test_edited_recordings_are_read_or_an_error(isolated, tmp_path):
    samples = {}
    for format in SAMPLES:
        (tmp_path / format).mkdir()
        target, path = small(format, tmp_path / format)
        samples[format] = target.read_bytes(), target, path.name
    examples = st.tuples(st.sampled_from(list(samples)), edits)
    fuzz(
        lambda example: isolated((edited(samples[example[0]][0], example[1]), *samples[example[0]][1:])),
        examples,
        SHARE,
    )


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"Frames: 3", b"Frames: 999999999999"),
        (b"Frames: 3", b"Frames: 1e300"),
        (b"OFFSET 0.0", b"OFFSET " + b"9" * 10**6),
        (b"JOINT LHip", b"JOINT x\n{\n" * 5000),
        (b"CHANNELS 6", b"CHANNELS " + b"9" * 10**5),
    ],
    ids=["frames", "fewer frames", "digits", "joints", "channels"],
)
def test_declared_sizes_take_no_memory(old, new, isolated, tmp_path):
    target, path = small("bvh", tmp_path)
    content = target.read_bytes()
    assert old in content
    isolated((content.replace(old, new, 1), target, path.name))
    target.write_bytes(content.replace(old, new, 1))
    with pytest.raises(ValueError, match=r"a\.bvh"):
        read_motion(target)


def test_many_parameters_are_read_in_linear_time(isolated, tmp_path):
    """Eight megabytes of parameters would take a minute in quadratic time."""
    target, path = small("c3d", tmp_path)
    content = target.read_bytes()
    parameter = struct.pack("<bb", 1, 1) + b"A" + struct.pack("<h", 8) + struct.pack("<bBBB", -1, 2, 1, 1) + b"x\0"
    first = content.index(b"\x04\x01USED")
    for blocks in (0, 1, 255):
        head = content[:514] + bytes([blocks]) + content[515:first]
        isolated((head + parameter * (2**23 // len(parameter)) + content[first:], target, path.name))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("poses", np.zeros((3, 65)), r"poses have shape \(3, 65\) and trans \(3, 3\), expected"),
        ("poses", np.zeros((2, 156)), r"poses have shape \(2, 156\)"),
        ("poses", np.zeros(3), "expected"),
        ("poses", np.full((3, 66), np.nan), "poses has dtype float64, or NaN"),
        ("poses", np.full((3, 66), "a"), "poses has dtype <U1"),
        ("poses", np.full((3, 66), 1e30), "expected metres, radians or a rate"),
        ("trans", np.zeros((0, 3)), r"trans \(0, 3\)"),
        ("trans", np.full((3, 3), np.inf), "trans has dtype"),
        ("offsets", np.zeros((3, 3)), r"offsets have shape \(3, 3\), expected \(22, 3\)"),
        ("offsets", np.zeros((22, 3)), "a person of"),
        ("mocap_framerate", np.zeros(()), "mocap_framerate must be a positive number"),
        ("mocap_framerate", np.array([30, 30]), "mocap_framerate must be a positive number"),
        ("mocap_framerate", np.array("30"), "mocap_framerate has dtype <U2"),
    ],
)
def test_arrays_that_are_no_motion_are_an_error(name, value, message, tmp_path):
    path, _ = small("amass", tmp_path)
    arrays = {**np.load(path), name: value}
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match=rf"a\.npz: .*{message}"):
        read_motion(path)


def test_an_npz_without_motion_in_a_folder_is_an_error(tmp_path):
    _, path = small("amass", tmp_path)
    np.savez(path.parent / "z.npz", weights=np.zeros(3))
    with pytest.raises(ValueError, match=r"z\.npz: it contains weights, expected AMASS's poses and trans"):
        read_motion(path.parent)
