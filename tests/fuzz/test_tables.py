"""Skeletons, labels and paths that somebody else made: read right, or refused in a sentence."""

import csv
import json
import os
import sys

import numpy as np
import pytest
from hypothesis import strategies as st

from dvae.motion import WALKER, Clip, MotionSet, Skeleton, read_motion, read_paths, save
from dvae.motion.files.plain import _read_columns
from dvae.motion.geometry.skeleton import is_name

from .damage import edited, edits
from .engine import Isolated, fuzz, limited

OF_SKELETONS, OF_TABLES = 4, 3

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


def told(read, path):
    """What is said of a file that cannot be read; None if it can."""
    try:
        read(path)
    except (ValueError, FileNotFoundError) as error:
        sentence = str(error)
        assert path.name in sentence, f"{sentence!r} does not name the file"
        assert len(sentence) < 1500, f"{len(sentence)} characters"
        assert is_name(sentence), f"{sentence!r} has control characters"
        return sentence
    return None


BROKEN = {
    "no object": ([1, 2], "expected JSON with joint_names and parents"),
    "nothing": (None, "expected JSON with joint_names and parents"),
    "no parents": ({"joint_names": ["a"]}, "lacks parents, found joint_names"),
    "names repeat": ({"joint_names": ["a", "b", "a", "b"]}, "joint names repeat: a, b"),
    "names of control characters": ({"joint_names": ["a", "b", "\x1b[2J", "d"]}, "expected text that can be printed"),
    "parents as a number": ({"parents": 3}, "parents is 3, expected a list"),
    "parents true": ({"parents": [-1, 0, True, 0]}, "parents has True at place 2"),
    "a parent of many digits": ({"parents": [-1, 0, 1, 10**4000]}, "the parent of hand is joint 1000.*000,"),
    "two roots": ({"parents": [-1, 0, 1, -1]}, "expected one root .* found hip, hand"),
    "a cycle": ({"parents": [-1, 2, 1, 0]}, "knee hangs on a cycle"),
    "left as names": ({"joints_left": ["knee"]}, "left has 'knee' at place 0, expected whole numbers"),
    "right out of range": ({"joints_right": [4]}, r"right names joints \[4\] of 4"),
    "fps NaN": ({"fps": float("nan")}, "nan frames per second"),
    "fps of many digits": ({"fps": 10**400}, "1000.* frames per second"),
    "up along x": ({"up_axis": "x"}, "up axis is 'x', expected 'y' or 'z'"),
    "lengths as text": ({"bone_lengths_m": ["a", 0, 0, 0]}, "bone_lengths_m has 'a' at place 0"),
    "negative lengths": ({"bone_lengths_m": [0, 1, -1, 1]}, "a bone is -1 m long"),
    "forty thousand joints": (
        {"joint_names": [f"j{n}" for n in range(40_000)], "parents": [n - 1 for n in range(40_000)]},
        "40,000 joints, expected at most 1,000",
    ),
    "a thousand names of one": ({"joint_names": ["a"] * 1000, "parents": [0] * 1000}, "joint names repeat: a$"),
}


@pytest.mark.parametrize("what", BROKEN)
def test_what_is_no_skeleton_is_told_in_a_sentence_that_names_the_file(tmp_path, what):
    changes, message = BROKEN[what]
    path = tmp_path / "a.npz.skeleton.json"
    save(tmp_path / "a.npz", MotionSet([Clip("a", "b", np.random.default_rng(0).uniform(-1, 1, (3, 17, 3)))], WALKER))
    if isinstance(changes, dict) and not what.startswith("no "):
        lengths = {} if len(changes.get("joint_names", "four")) <= 4 else {"bone_lengths_m": []}
        changes = {**VALID, **lengths, **changes}
    path.write_text(json.dumps(changes))
    with pytest.raises(ValueError, match=message):
        Skeleton.from_json(path)
    assert told(Skeleton.from_json, path)
    assert told(lambda _: read_motion(tmp_path / "a.npz"), path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "expected JSON"),
        (b"\xff\xfe{", "is no text"),
        (b"{", "expected JSON"),
        (b'{"a":' * 10**6, "nested too deeply"),
        (b'{"fps": 1' + b"0" * 10**5 + b"}", "digits"),
        (b" " * (2**24 + 1), "can rightly have 16777216 at most"),
    ],
    ids=["empty", "utf-16", "cut", "objects", "fps", "large"],
)
def test_files_that_are_no_json_are_told_too(tmp_path, content, message):
    path = tmp_path / "skeleton.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"skeleton\.json:? .*{message}"):
        Skeleton.from_json(path)
    assert told(Skeleton.from_json, path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes with names")
@pytest.mark.timeout(30)
@pytest.mark.parametrize("read", [Skeleton.from_json, read_paths, read_motion])
def test_what_is_no_file_is_not_waited_for(tmp_path, read):
    for name in ("pipe.csv", "pipe.npz"):
        os.mkfifo(tmp_path / name)
        with pytest.raises((FileNotFoundError, ValueError), match=name):
            read(tmp_path / name)


# ------------------------------------------------------------------------------------------------ csv files

AXES = [f"{joint}_{axis}" for joint in ("LWrist", "RWrist") for axis in "xyz"]
PATHS = "\n".join([",".join(AXES), "1,2,3,4,5,6", "", "1,2,,nan,5,-6e-1"]) + "\n"
LABELS = "split,clip,style\ntrain,walk,happy\ntrain,sit,\n"


def labels(path):
    archive = path.with_name("motion.npz")
    if not archive.exists():
        there = np.random.default_rng(0).uniform(-0.8, 0.8, (3, 17, 3)).astype(np.float32)
        np.savez(archive, **{"train/walk": there, "train/sit": there})
    return read_motion(archive, WALKER, labels=path)


@pytest.mark.parametrize(
    ("read", "content", "message"),
    [
        (labels, b"split,clip,style\ntrain,walk\n", "row 2 has 2 cells, the header 3"),
        (labels, b"split,clip,style,style\ntrain,walk,a,b\n", "column 'style' is there twice"),
        (
            labels,
            b"split,clip\ntrain,walk\n" + b"a" * 200_000 + b",b\n",
            "row 3 is no row of a csv .*field larger",
        ),
        (labels, b"", "expected a column named clip"),
        (read_paths, b"a_x,a_y,a_z\n1,2,inf\n", "the path of a has inf in frame 0"),
        (read_paths, b"a_x,a_y,a_z\n1,2,3\n1,-1e39,3\n", r"the path of a has -1e\+39 in frame 1; expected metres"),
        (read_paths, b"a_x,a_y,a_z\n1,2," + b"1" * 200_000 + b"\n", "field larger"),
        (read_paths, b"a_x,a_y,a_z\n1,2,\x00\n", "is no number|is no row"),
        (read_paths, b"\xffa_x,a_y,a_z\n1,2,3\n", "is no text"),
        (
            read_paths,
            b"x" * 100_000 + b",a_y,a_z\n1,2,3\n",
            "a header of columns|column 1 is .* expected a name",
        ),
    ],
)
def test_labels_and_paths_that_are_none_are_told(tmp_path, read, content, message):
    (tmp_path / "a.csv").write_bytes(content)
    with pytest.raises(ValueError, match=rf"a\.csv: .*({message})"):
        read(tmp_path / "a.csv")
    assert told(read, tmp_path / "a.csv")


def test_labels_are_read_with_a_mark_of_their_encoding_and_quotes(tmp_path):
    text = '\ufeffsplit,clip,style\n\ntrain,walk,"a, ""b"""\n'
    (tmp_path / "labels.csv").write_text(text, encoding="utf-8")
    assert labels(tmp_path / "labels.csv")["train", "walk"].labels["style"] == 'a, "b"'


def write_path(path, columns, rows, blank=0):
    header = ",".join(f"j{n}_{axis}" for n in range(columns // 3) for axis in "xyz")
    row = ",".join(["1"] * columns)
    path.write_text("\n".join([header, *[row] * rows, *[""] * blank, row]) + "\n")
    return path


def lines_executed(function):
    """Count the lines of Python that a call executes, which is the same on every machine."""
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


@pytest.mark.parametrize("size", [(300, 1, 0), (3, 200, 0), (3, 1, 200)])
def test_work_grows_in_proportion_to_a_file_of_paths(tmp_path, size):
    path, (columns, rows, blank) = tmp_path / "paths.csv", size
    larger = (2 * columns, rows, blank) if columns > 3 else (columns, 2 * rows, 2 * blank)
    work = [lines_executed(lambda each=each: read_paths(write_path(path, *each))) for each in (size, larger)]
    assert work[1] < 2.1 * work[0]
    if blank:  # which counts as numbers of every column
        with pytest.raises(ValueError, match="it has more than 600 numbers"):
            _read_columns(path, 600)


# ------------------------------------------------------------------------------------------------ random ones

values = st.recursive(
    st.sampled_from([None, True, 2**31, 2**63, 10**400, -(10**30), "y", "z", "hip", "\ud800", "\x1b[2J", "[/x]"])
    | st.integers(-3, 6)
    | st.integers()
    | st.floats()
    | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)
lists_of_joints = st.lists(st.integers(-2, 6) | values, max_size=6)
changes = st.dictionaries(st.sampled_from([*VALID, "other"]), values | lists_of_joints, max_size=3)


def read_skeleton(example, directory):
    changes, removed, edits = example
    path = directory / "skeleton.json"
    fields = {key: value for key, value in {**VALID, **changes}.items() if key not in removed}
    path.write_bytes(edited(json.dumps(fields).encode(), edits))
    if told(Skeleton.from_json, path) is None:
        read = Skeleton.from_json(path)
        assert sorted(read.order) == list(range(read.joints))
        assert len(read.edges) == read.joints - 1
        read.to_json(directory / "again.json")
        assert Skeleton.from_json(directory / "again.json") == read
        assert read.find(read.names[0]) == 0
        hash(read)


@limited(OF_SKELETONS)
def test_changed_skeletons_are_read_or_refused(tmp_path):
    examples = st.tuples(changes, st.sets(st.sampled_from(list(VALID)), max_size=1), edits())
    fuzz(Isolated(read_skeleton, tmp_path), examples, OF_SKELETONS)


cells = st.sampled_from(["1", "-2.5", "", "nan", "inf", "1e300", "1_0", "x", '"', "\x00", "\r", "٣", "walk", "train"])
rows = st.lists(st.lists(cells, max_size=7), max_size=4)


def read_table(example, directory):
    kind, rows, edits = example
    base = PATHS if kind == "paths" else LABELS
    path = directory / f"{kind}.csv"
    with path.open("w", newline="", encoding="utf-8", errors="surrogatepass") as file:
        file.write(base)
        csv.writer(file).writerows(rows)
    path.write_bytes(edited(path.read_bytes(), edits))
    told(read_paths if kind == "paths" else labels, path)


@limited(OF_TABLES)
def test_changed_tables_are_read_or_refused(tmp_path):
    examples = st.tuples(st.sampled_from(["paths", "labels"]), rows, edits())
    fuzz(Isolated(read_table, tmp_path), examples, OF_TABLES)
