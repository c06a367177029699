"""Untrusted skeletons, labels and paths are read correctly, or are an error of one sentence."""

import csv
import json
import os
import sys

import numpy as np
import pytest
from hypothesis import strategies as st

from dvae.motion import HUMAN36M, WALKER, Clip, MotionSet, Skeleton, read_motion, read_paths, save
from dvae.motion.files.arrays import _read_columns
from dvae.motion.geometry.skeleton import is_name

from .engine import Isolated, fuzz, limited

OF_SKELETONS, OF_TABLES = 8, 7

VALID = {
    "name": "person",
    "joint_names": ["hip", "knee", "foot", "hand"],
    "parents": [-1, 0, 1, 0],
    "joints_left": [1],
    "joints_right": [3],
    "units": "m",
    "up_axis": "y",
    "fps": 30,
    "bone_lengths_m": [0, 0.4, 0.4, 0.5],
}


def skeleton(path, **changes):
    """Write a skeleton file with some values replaced."""
    path.write_text(json.dumps({**VALID, **changes}))
    return path


def error_message(reader, path):
    """Return the error of a reader for a file, or None."""
    try:
        reader(path)
    except (ValueError, FileNotFoundError) as error:
        message = str(error)
        assert path.name in message, f"{message!r} does not name the file"
        assert len(message) < 1500, f"{len(message)} characters"
        assert is_name(message), f"{message!r} has control characters"
        return message
    return None


BROKEN = {
    "no object": ([1, 2], "expected JSON with joint_names and parents"),
    "nothing": (None, "expected JSON with joint_names and parents"),
    "no names": ({"parents": [-1]}, "joint_names is missing"),
    "no parents": ({"joint_names": ["a"]}, "parents is missing, found joint_names"),
    "names as text": ({"joint_names": "abcd"}, "names is 'abcd', expected a list of text"),
    "names as an object": ({"joint_names": {"a": 1}}, "expected a list of text"),
    "names as numbers": ({"joint_names": [1, 2, 3, 4]}, "names has 1 at place 0, expected text"),
    "names in lists": ({"joint_names": [["a"], "b", "c", "d"]}, "names has .* at place 0, expected text"),
    "names repeat": ({"joint_names": ["a", "b", "a", "b"]}, "joint names repeat: a, b"),
    "names of control characters": ({"joint_names": ["a", "b", "\x1b[2J", "d"]}, "expected text that can be printed"),
    "names of half a letter": ({"joint_names": ["a", "b", "\ud800", "d"]}, "expected text that can be printed"),
    "too few names": ({"joint_names": ["a", "b"]}, "2 names but 4 parents|2 names"),
    "parents as text": ({"parents": "abcd"}, "parents is 'abcd', expected a list of whole numbers"),
    "parents as a number": ({"parents": 3}, "parents is 3, expected a list"),
    "parents as fractions": ({"parents": [-1, 0, 1.5, 0]}, "parents has 1.5 at place 2, expected whole numbers"),
    "parents null": ({"parents": [None, 0, 1, 0]}, "parents has None at place 0"),
    "parents true": ({"parents": [-1, 0, True, 0]}, "parents has True at place 2"),
    "a parent out of range": ({"parents": [-1, 0, 1, 4]}, "the parent of hand is joint 4"),
    "a parent of many digits": ({"parents": [-1, 0, 1, 10**4000]}, "the parent of hand is joint 1000.*000,"),
    "two roots": ({"parents": [-1, 0, 1, -1]}, "expected one root .* found hip, hand"),
    "no root": ({"parents": [1, 0, 1, 0]}, "expected one root .* found none"),
    "a cycle": ({"parents": [-1, 2, 1, 0]}, "knee is in a cycle"),
    "left as a number": ({"joints_left": 1}, "left is 1, expected a list of whole numbers"),
    "left as names": ({"joints_left": ["knee"]}, "left has 'knee' at place 0, expected whole numbers"),
    "left null": ({"joints_left": None}, "left is None"),
    "right out of range": ({"joints_right": [4]}, r"right names joints \[4\] of 4"),
    "right below range": ({"joints_right": [-1]}, r"right names joints \[-1\] of 4"),
    "one joint on both sides": ({"joints_right": [1]}, "left and right name knee twice"),
    "fps as text": ({"fps": "30"}, "'30' frames per second"),
    "fps null": ({"fps": None}, "None frames per second"),
    "fps true": ({"fps": True}, "True frames per second"),
    "fps NaN": ({"fps": float("nan")}, "nan frames per second"),
    "fps infinite": ({"fps": float("inf")}, "inf frames per second"),
    "fps of many digits": ({"fps": 10**400}, "1000.* frames per second"),
    "up as a number": ({"up_axis": 1}, "up axis is 1"),
    "up as a list": ({"up_axis": ["y"]}, "up axis is .* expected 'y' or 'z'"),
    "up along x": ({"up_axis": "x"}, "up axis is 'x', expected 'y' or 'z'"),
    "a name that is a list": ({"name": ["a"]}, r"skeleton \['a'\]: its name"),
    "lengths as a number": ({"bone_lengths_m": 3}, "bone_lengths_m is 3, expected a list of numbers"),
    "lengths as text": ({"bone_lengths_m": ["a", 0, 0, 0]}, "bone_lengths_m has 'a' at place 0"),
    "too few lengths": ({"bone_lengths_m": [0, 1]}, "bone_lengths_m has 2 entries, expected one for each of 4 joints"),
    "negative lengths": ({"bone_lengths_m": [0, 1, -1, 1]}, "a bone is -1 m long"),
    "lengths NaN": ({"bone_lengths_m": [0, 1, float("nan"), 1]}, "a bone is nan m long"),
    "forty thousand joints": (
        {"joint_names": [f"j{n}" for n in range(40_000)], "parents": [n - 1 for n in range(40_000)]},
        "40,000 joints, expected at most 1,000",
    ),
    "forty thousand names of one": ({"joint_names": ["a"] * 40_000, "parents": [0] * 40_000}, "40,000 joints"),
    "a thousand names of one": ({"joint_names": ["a"] * 1000, "parents": [0] * 1000}, "joint names repeat: a$"),
    "a thousand roots": (
        {"joint_names": [f"{n}" for n in range(999)], "parents": [-1] * 999},
        r"found 0, 1, .*\.\.\.$",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_an_invalid_skeleton_is_an_error_that_names_the_file(tmp_path, case):
    changes, message = BROKEN[case]
    path = tmp_path / "a.npz.skeleton.json"
    if isinstance(changes, dict) and not case.startswith("no "):
        changes = (
            {**VALID, **changes} if "joint" in case or "lengths" in case else {**VALID, "bone_lengths_m": [], **changes}
        )
        if len(changes["joint_names"]) > 4:
            changes["bone_lengths_m"] = []
    elif case == "no root":
        changes = {**VALID, **changes}
    path.write_text(json.dumps(changes))
    with pytest.raises(ValueError, match=message):
        Skeleton.from_json(path)
    assert error_message(Skeleton.from_json, path)
    save(tmp_path / "a.npz", MotionSet([Clip("a", "b", np.random.default_rng(0).uniform(-1, 1, (3, 17, 3)))], WALKER))
    path.write_text(json.dumps(changes))
    assert error_message(lambda _: read_motion(tmp_path / "a.npz"), path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "expected JSON"),
        (b"\xff\xfe{", "is not text"),
        (b"{", "expected JSON"),
        (b"[" * 10**6, "nested too deeply"),
        (b'{"a":' * 10**6, "nested too deeply"),
        (b"7" * 10**5, "digits"),
        (b'{"fps": 1' + b"0" * 10**5 + b"}", "digits"),
        (b" " * (2**24 + 1), "at most 16777216 are allowed"),
        (b'"' + b"a" * 10**6 + b'"', "expected JSON with joint_names"),
    ],
    ids=["empty", "utf-16", "cut", "lists", "objects", "digits", "fps", "large", "text"],
)
def test_files_without_json_are_an_error_that_names_them(tmp_path, content, message):
    path = tmp_path / "skeleton.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"skeleton\.json:? .*{message}"):
        Skeleton.from_json(path)
    assert error_message(Skeleton.from_json, path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes with names")
@pytest.mark.timeout(30)
@pytest.mark.parametrize("reader", [Skeleton.from_json, read_paths, read_motion])
def test_a_pipe_is_an_error_at_once(tmp_path, reader):
    for name in ("pipe.csv", "pipe.npz"):
        os.mkfifo(tmp_path / name)
        with pytest.raises((FileNotFoundError, ValueError), match=name):
            reader(tmp_path / name)


def test_a_long_chain_of_joints_is_a_skeleton(tmp_path):
    names = [f"joint {n}" for n in range(1000)]
    chain = Skeleton(tuple(names), (-1, *range(999)))
    assert chain.order == list(range(1000))
    chain.to_json(tmp_path / "chain.json")
    assert Skeleton.from_json(tmp_path / "chain.json") == Skeleton(chain.names, chain.parents, name="")


def test_the_order_sorts_joints_by_depth_and_index():
    assert HUMAN36M.order == sorted(range(17), key=lambda j: (depth(HUMAN36M, j), j))


def depth(tree, joint):
    return 0 if tree.parents[joint] == -1 else 1 + depth(tree, tree.parents[joint])


# ------------------------------------------------------------------------------------------------ csv files

AXES = [f"{joint}_{axis}" for joint in ("LWrist", "RWrist") for axis in "xyz"]
PATHS = "\n".join([",".join(AXES), "1,2,3,4,5,6", "", "1,2,,nan,5,-6e-1"]) + "\n"
LABELS = "split,clip,style\ntrain,walk,happy\ntrain,sit,\n"


def labels(path):
    archive = path.with_name("motion.npz")
    if not archive.exists():
        positions = np.random.default_rng(0).uniform(-0.8, 0.8, (3, 17, 3)).astype(np.float32)
        np.savez(archive, **{"train/walk": positions, "train/sit": positions})
    return read_motion(archive, WALKER, labels=path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\xff\xfe", "is not text"),
        (b"split,clip,style\ntrain,walk\n", "row 2 has 2 cells, expected 3"),
        (b"split,clip,style\ntrain,walk,a,b\n", "row 2 has 4 cells, expected 3"),
        (b"split,clip,style,style\ntrain,walk,a,b\n", "column 'style' occurs twice"),
        (b"split,clip\ntrain,walk\n" + b"a" * 200_000 + b",b\n", "row 3 is not a row of a csv file .*field larger"),
        (b'split,clip\n"train,walk\n' + b"a\n" * 100_000, "field larger"),
        (b"", "expected a column named clip"),
    ],
)
def test_invalid_files_of_labels_are_an_error(tmp_path, content, message):
    (tmp_path / "labels.csv").write_bytes(content)
    with pytest.raises(ValueError, match=rf"labels\.csv: .*{message}"):
        labels(tmp_path / "labels.csv")


def test_labels_with_a_byte_order_mark_and_quotes_are_read(tmp_path):
    text = '\ufeffsplit,clip,style\n\ntrain,walk,"a, ""b"""\n'
    (tmp_path / "labels.csv").write_text(text, encoding="utf-8")
    assert labels(tmp_path / "labels.csv")["train", "walk"].labels["style"] == 'a, "b"'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a_x,a_y,a_z\n1,2,inf\n", "the path of a has inf in frame 0"),
        (b"a_x,a_y,a_z\n1,2,3\n1,-1e39,3\n", r"the path of a has -1e\+39 in frame 1; expected metres"),
        (b"a_x,a_y,a_z\n1,2,1e999\n", "the path of a has inf"),
        (b"a_x,a_y,a_z\n1,2," + b"1" * 200_000 + b"\n", "field larger"),
        (b"a_x,a_y,a_z\n1,2,\x00\n", "is not a number|is not a row"),
        (b'a_x,a_y,a_z\n1,2,"3\n', "is not a number|is not a row"),
        (b"\xffa_x,a_y,a_z\n1,2,3\n", "is not text"),
        (b"x" * 100_000 + b",a_y,a_z\n1,2,3\n", "expected a header of columns|column 1 is .* expected a name"),
    ],
)
def test_invalid_files_of_paths_are_an_error(tmp_path, content, message):
    (tmp_path / "paths.csv").write_bytes(content)
    with pytest.raises(ValueError, match=rf"paths\.csv: .*({message})"):
        read_paths(tmp_path / "paths.csv")
    assert error_message(read_paths, tmp_path / "paths.csv")


@pytest.mark.parametrize("value", [np.inf, 1e300, -np.inf])
def test_paths_of_an_archive_are_finite_in_float32(tmp_path, value):
    path = np.zeros((4, 3))
    path[1] = np.nan
    np.savez(tmp_path / "paths.npz", LWrist=path)
    read_paths(tmp_path / "paths.npz")
    path[2, 1] = value
    np.savez(tmp_path / "paths.npz", LWrist=path)
    with pytest.raises(ValueError, match=r"paths\.npz: the path of LWrist has .* in frame 2"):
        read_paths(tmp_path / "paths.npz")


def write_path(path, columns, rows, blank=0):
    header = ",".join(f"j{n}_{axis}" for n in range(columns // 3) for axis in "xyz")
    row = ",".join(["1"] * columns)
    path.write_text("\n".join([header, *[row] * rows, *[""] * blank, row]) + "\n")
    return path


def lines_executed(function):
    """Return the number of Python lines that a call executes, which is equal on all machines."""
    count = 0

    def trace(frame, event, argument):
        nonlocal count
        count += event == "line"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        function()
    finally:
        sys.settrace(before)
    return count


@pytest.mark.parametrize("size", [(300, 1, 0), (3, 200, 0), (3, 1, 200), (60, 60, 0)])
def test_work_is_linear_in_the_size_of_a_file_of_paths(tmp_path, size):
    path, (columns, rows, blank) = tmp_path / "paths.csv", size
    larger = (2 * columns, rows, blank) if columns > 3 else (columns, 2 * rows, 2 * blank)
    work = [lines_executed(lambda each=each: read_paths(write_path(path, *each))) for each in (size, larger)]
    assert work[1] < 2.1 * work[0]


def test_empty_rows_count_in_the_limit_of_numbers(tmp_path):
    path = write_path(tmp_path / "paths.csv", 60, 2, 100)
    with pytest.raises(ValueError, match="it has more than 6,000 numbers"):
        _read_columns(path, 6000)
    assert len(_read_columns(path, 6300)) == 20


# ------------------------------------------------------------------------------------------------ random ones

values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-3, 6)
    | st.integers()
    | st.sampled_from([2**31, 2**63, 10**400, -(10**30)])
    | st.floats()
    | st.text(max_size=4)
    | st.sampled_from(["y", "z", "hip", "\ud800", "\x1b[2J", "[/x]"]),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)
lists_of_joints = st.lists(st.integers(-2, 6) | values, max_size=6)
changes = st.dictionaries(st.sampled_from([*VALID, "other"]), values | lists_of_joints, max_size=3)
edits = st.lists(
    st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 3), st.binary(max_size=3)),
    max_size=3,
)


def edited(content, changes):
    """Return the content with some bytes removed and others inserted."""
    for place, cut, inserted in changes:
        start = int(place * len(content))
        content = content[:start] + inserted + content[start + cut :]
    return content


def read_skeleton(example, directory):
    changes, removed, edits = example
    path = directory / "skeleton.json"
    fields = {key: value for key, value in {**VALID, **changes}.items() if key not in removed}
    path.write_bytes(edited(json.dumps(fields).encode(), edits))
    if error_message(Skeleton.from_json, path) is None:
        skeleton_read = Skeleton.from_json(path)
        assert sorted(skeleton_read.order) == list(range(skeleton_read.joints))
        assert len(skeleton_read.edges) == skeleton_read.joints - 1
        skeleton_read.to_json(directory / "again.json")
        assert Skeleton.from_json(directory / "again.json") == skeleton_read
        assert skeleton_read.find(skeleton_read.names[0]) == 0
        hash(skeleton_read)


@limited(OF_SKELETONS)
def test_changed_skeletons_are_read_or_an_error(tmp_path):
    examples = st.tuples(changes, st.sets(st.sampled_from(list(VALID)), max_size=1), edits)
    with Isolated(read_skeleton, tmp_path) as isolated:
        fuzz(isolated, examples, OF_SKELETONS)


def read_table(example, directory):
    kind, rows, edits = example
    base = PATHS if kind == "paths" else LABELS
    path = directory / f"{kind}.csv"
    with path.open("w", newline="", encoding="utf-8", errors="surrogatepass") as file:
        file.write(base)
        csv.writer(file).writerows(rows)
    path.write_bytes(edited(path.read_bytes(), edits))
    error_message(read_paths if kind == "paths" else labels, path)


cells = st.sampled_from(["1", "-2.5", "", "nan", "inf", "1e300", "1_0", "x", '"', "\x00", "\r", "٣", "walk", "train"])
rows = st.lists(st.lists(cells, max_size=7), max_size=4)


@limited(OF_TABLES)
def test_changed_tables_are_read_or_an_error(tmp_path):
    examples = st.tuples(st.sampled_from(["paths", "labels"]), rows, edits)
    with Isolated(read_table, tmp_path) as isolated:
        fuzz(isolated, examples, OF_TABLES)
