"""Motion files of every format, and folders of them: one set of clips in metres, with notes."""

import io
import os
import re
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from dvae.motion import (
    HUMAN36M,
    PROTOCOLS,
    WALKER,
    Clip,
    MotionData,
    MotionSet,
    read_motion,
    save,
    simulate,
    write_motion,
)
from dvae.motion.files.recording import Recording
from dvae.motion.files.world import infer_world, to_world

FORMATS = {"npz": "all.npz", "bvh": "folder", "csv": "folder", "amass": "folder"}


@pytest.fixture(scope="module")
def people():
    return simulate(clips=3, frames=40, seed=1)


@pytest.fixture
def bvh(people, tmp_path):
    """A folder of three clips."""
    write_motion(tmp_path / "bvh", people, "bvh")
    return tmp_path / "bvh"


def printed(motion):
    console = Console(file=io.StringIO(), width=200)
    console.print(motion.info())
    return console.file.getvalue()


@pytest.mark.parametrize("format", FORMATS)
def test_written_motion_is_read_back(people, format, tmp_path):
    # Files of positions: 0.1 mm. Files of rotations have mean bone lengths, but people differ
    one = MotionSet(people.clips[:1], people.skeleton)
    write_motion(tmp_path / FORMATS[format], one, format)
    motion_set = read_motion(tmp_path / FORMATS[format], onto=WALKER if format != "npz" else None)
    assert (motion_set.skeleton.names, motion_set.skeleton.parents, motion_set.skeleton.fps) == (
        WALKER.names,
        WALKER.parents,
        30,
    )
    assert (motion_set.skeleton.left, motion_set.skeleton.up) == (WALKER.left, "y")
    assert [clip.key for clip in motion_set] == [clip.key for clip in one]
    within = {"npz": 0, "csv": 1e-6, "bvh": 1e-2, "amass": 3e-2}[format]  # inverse kinematics is within a centimetre
    if format == "amass":  # SMPL's pelvis differs by a constant
        assert read_motion(tmp_path / FORMATS[format]).skeleton.joints == 22
    np.testing.assert_allclose(motion_set.clips[0].positions, one.clips[0].positions, atol=within)


@pytest.mark.parametrize("up", ["y", "z"])
def test_rigid_motion_is_the_same_in_bvh_to_a_tenth_of_a_millimetre(people, up, tmp_path):
    """A written body is rigid; read and written again it is unchanged, for each up axis."""
    write_motion(tmp_path / "a", MotionSet(people.clips[:1], people.skeleton), "bvh")
    rigid = read_motion(tmp_path / "a", onto=replace(WALKER, up=up))
    assert rigid.clips[0].rotations is not None
    write_motion(tmp_path / "b", rigid, "bvh")
    again = read_motion(tmp_path / "b", onto=replace(WALKER, up=up))
    np.testing.assert_allclose(again.clips[0].positions, rigid.clips[0].positions, atol=1e-4)
    assert again.skeleton.up == up
    npz = save(tmp_path / "c.npz", rigid) or read_motion(tmp_path / "c.npz")
    np.testing.assert_array_equal(npz.clips[0].rotations, rigid.clips[0].rotations)
    assert npz.fingerprint() == rigid.fingerprint()


def placed(text, joint, moving):
    """Return a BVH file whose position channels place a joint, with another OFFSET."""
    head, rows = text.split("Frame Time: 0.03333333\n")
    before, after = head.split(f"JOINT {joint}\n")
    columns = sum(int(line.split()[1]) for line in before.splitlines() if "CHANNELS" in line)
    offset, after = re.search(r"OFFSET (.*)", after)[1].split(), re.sub("OFFSET .*", "OFFSET 0 0 0", after, count=1)
    after = after.replace("CHANNELS 3 ", "CHANNELS 6 Xposition Yposition Zposition ", 1)
    frames = []
    for frame, row in enumerate(rows.splitlines()):
        now = [str(float(value) + moving * (frame % 2)) for value in offset]
        frames.append(" ".join([*row.split()[:columns], *now, *row.split()[columns:]]))
    return f"{before}JOINT {joint}\n{after}Frame Time: 0.03333333\n" + "\n".join(frames) + "\n"


def test_position_channels_give_the_offset_of_a_joint(people, tmp_path):
    (path,) = write_motion(tmp_path / "a.bvh", MotionSet(people.clips[:1], people.skeleton))
    original, text = read_motion(path), path.read_text()
    path.write_text(placed(text, "LKnee", 0))
    motion_set = read_motion(path)
    np.testing.assert_allclose(motion_set.clips[0].positions, original.clips[0].positions, atol=1e-6)
    np.testing.assert_allclose(motion_set.skeleton.offsets, original.skeleton.offsets, atol=1e-6)
    path.write_text(placed(text, "LKnee", 1.0))  # 1 cm along each axis, in every second frame
    motion_set = read_motion(path)
    assert (motion_set.clips[0].rotations, motion_set.skeleton.rest) == (None, ())
    assert "rotations are left out, because a joint moves relative to its parent" in motion_set.interpretation
    path.write_text(placed(text, "LKnee", 0.01))
    assert read_motion(path).clips[0].rotations is not None


def test_skeletons_survive_bvh(people, tmp_path):
    """Names, tree and end joints survive, so that a model of one reads the other."""
    motion_set = read_motion(*write_motion(tmp_path / "a.bvh", MotionSet(people.clips[:1], WALKER)))
    assert (motion_set.skeleton.names, motion_set.skeleton.parents) == (WALKER.names, WALKER.parents)
    names = [{"RKnee": "R Knee", "RFoot": "R_Knee", "Spine": "R{Knee"}.get(name, name) for name in WALKER.names]
    alike = MotionSet(people.clips[:1], replace(WALKER, names=names))
    loaded_names = read_motion(*write_motion(tmp_path / "b.bvh", alike)).skeleton.names
    assert loaded_names == tuple(
        {"RKnee": "R_Knee", "RFoot": "R_Knee_", "Spine": "R_Knee__"}.get(name, name) for name in WALKER.names
    )


@pytest.mark.data
@pytest.mark.parametrize(
    ("file", "joints", "note"),
    [
        ("bvh/indian_13.bvh", 57, "centimetres"),
        ("expmap/test_running_1.txt", 38, "as the file says"),
    ],
)
def test_samples_are_people_of_a_plausible_size(file, joints, note, shared, real):
    motion_set = read_motion(shared(f"cmu_raw/{file}"))
    assert (motion_set.skeleton.joints, motion_set.skeleton.up, len(motion_set)) == (joints, "y", 1)
    assert note in motion_set.interpretation
    assert motion_set.interpretation in printed(motion_set)
    assert len(motion_set.skeleton.left) == len(motion_set.skeleton.right) > 0
    assert read_motion(shared(f"cmu_raw/{file}"), onto=WALKER).skeleton.names == WALKER.names
    if not file.endswith("bvh"):
        onto = read_motion(shared(f"cmu_raw/{file}"), onto=real("cmu/cmu8.npz").skeleton).resample(30)
        expected = real("cmu/cmu8.npz")["test", "running_1"].positions
        np.testing.assert_allclose(onto.clips[0].positions, expected, atol=1e-4)


@pytest.mark.parametrize(("scale", "turn"), [(1.0, "z"), (100.0, "-y"), (1000.0, "x"), (1 / 0.0254, "-z"), (1.0, "y")])
def test_units_and_axes_are_inferred_from_the_person(people, scale, turn):
    matrices = {"y": np.eye(3), "z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]], "-y": np.diag([-1.0, -1, 1])}
    matrices |= {"x": [[0, 1, 0], [0, 0, 1], [1, 0, 0]], "-z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]]}
    positions = people.clips[0].positions.astype(float)
    recording = Recording(WALKER.names, WALKER.parents, scale * positions @ np.array(matrices[turn], float).T, fps=30)
    world = infer_world({"a": recording})
    assert world.metres == pytest.approx(1 / scale)
    settled = to_world(recording, world)
    assert settled.up == ("z" if turn == "z" else "y")
    vertical = 2 if turn == "z" else 1
    heights = positions[..., 1]
    np.testing.assert_allclose(settled.positions[..., vertical], heights, atol=1e-6)
    bones = [np.linalg.det(places[0, [1, 4, 8]] - places[0, 0]) for places in (settled.positions, positions)]
    np.testing.assert_allclose(*bones, atol=1e-9)  # the negative for a mirrored person


def test_given_units_override_inferred_ones(bvh, people):
    motion_set = read_motion(bvh, metres=0.005, fps=60)
    assert "as given (0.005 m)" in motion_set.interpretation
    assert motion_set.skeleton.fps == 60
    np.testing.assert_allclose(2 * motion_set.clips[0].positions, read_motion(bvh).clips[0].positions, rtol=1e-5)
    assert read_motion(bvh, up="z").skeleton.up == "z"
    for wrong, message in (({"metres": 1}, r"shows a person of 1\d\d"), ({"up": "x"}, "must be .y. or .z., got .x.")):
        with pytest.raises(ValueError, match=message):
            read_motion(bvh, **wrong)
    assert read_motion(bvh / "train" / "person_0000.bvh").splits == ["all"]


def scaled(path, factor):
    """Return a BVH file of a larger or smaller body."""

    def larger(line):
        return " ".join(["OFFSET", *(str(factor * float(value)) for value in line[0].split()[1:])])

    path.write_text(re.sub("OFFSET .*", larger, path.read_text()))


def test_an_implausible_unit_is_an_error_and_differing_units_are_reported(bvh):
    scaled(bvh / "train" / "person_0001.bvh", 1 / 2.54)
    with pytest.raises(ValueError, match=r"unit centimetres .*person_0001.* inches|unit inches .*, .* centimetres"):
        read_motion(bvh)
    with pytest.raises(ValueError, match=r"person_0001\.bvh: its body is 0\.\d+ times as large as in"):
        read_motion(bvh, metres=0.01)
    scaled(bvh / "train" / "person_0000.bvh", 7)
    with pytest.raises(ValueError, match=r"0\.bvh: the body is about .* tall .* pass the length"):
        read_motion(bvh / "train" / "person_0000.bvh")


def test_lying_people_are_reported_and_files_with_an_up_axis_are_rotated(people, tmp_path):
    tilted = [replace(clip, positions=clip.positions[..., [2, 0, 1]]) for clip in people]  # z up
    save(tmp_path / "a.npz", MotionSet(tilted, WALKER))
    motion_set = read_motion(tmp_path / "a.npz")
    assert motion_set.interpretation == "heads are above feet along z, but y is assumed to be up in 3 of 3 clips"
    assert motion_set.interpretation in printed(motion_set).replace("\n", " ")
    assert read_motion(tmp_path / "a.npz", up="z").interpretation == ""
    for name, up, clip in (("a", "y", people.clips[0]), ("b", "y", people.clips[1]), ("c", "z", tilted[2])):
        upright = MotionSet([replace(clip, name=name, split="all")], replace(WALKER, up=up))
        write_motion(tmp_path / "mixed" / name / "a.csv", upright)
    motion_set = read_motion(tmp_path / "mixed")
    assert (motion_set.skeleton.up, motion_set.interpretation.count("heads")) == ("y", 0)
    for clip, original in zip(motion_set, people, strict=True):
        np.testing.assert_allclose(clip.positions[..., 1], original.positions[..., 1], atol=1e-6)
    with_up = read_motion(tmp_path / "mixed", up="y")
    assert (
        "heads are above feet along z, but y is assumed to be up in 1 of 3 files, the first a.csv"
        in with_up.interpretation
    )


def test_a_folder_is_read_recursively_without_links(bvh, tmp_path):
    (bvh / "train" / "deep").mkdir()
    (bvh / "train" / "person_0000.bvh").rename(bvh / "train" / "deep" / "walk 1.BVH")
    (bvh / "README.txt").write_text("not motion")
    (bvh / ".hidden.bvh").write_text("not motion")
    (bvh / "link.bvh").symlink_to(bvh / "train" / "person_0001.bvh")
    (tmp_path / "other").mkdir()
    (bvh / "linked").symlink_to(tmp_path / "other")
    write_motion(tmp_path / "other", read_motion(bvh), "bvh")
    (bvh / "labels.csv").write_text("split,clip,mood\ntrain/deep,walk 1,happy\n")
    motion_set = read_motion(bvh)
    assert sorted(clip.key for clip in motion_set) == [
        ("test", "person_0002"),
        ("train", "person_0001"),
        ("train/deep", "walk 1"),
    ]
    assert motion_set["train/deep", "walk 1"].labels["mood"] == "happy"
    assert motion_set.skeleton.name == "bvh"


def test_a_file_unlike_the_others_of_its_folder_is_named(bvh, tmp_path):
    stranger = bvh / "train" / "stranger.bvh"
    text = (bvh / "train" / "person_0000.bvh").read_text()
    for old, new, message in (
        ("JOINT LShoulder", "JOINT Wing", r"stranger\.bvh: does not have LShoulder and has Wing, unlike .*person_0002"),
        ("Frame Time: 0.03333333", "Frame Time: 0.01", r"stranger\.bvh: 100 frames per second, .* has 30"),
        ("MOTION", "", r"stranger\.bvh"),
    ):
        stranger.write_text(text.replace(old, new))
        with pytest.raises(ValueError, match=message):
            read_motion(bvh)
        assert [name for _, name, _ in read_motion(bvh, skip_bad=True).skipped] == ["stranger"]
    (bvh / "a.amc").write_text("")
    with pytest.raises(ValueError, match="4 bvh and 1 amc files"):
        read_motion(bvh)
    (tmp_path / "nothing").mkdir()
    with pytest.raises(FileNotFoundError, match="no file in it is one of"):
        read_motion(tmp_path / "nothing")
    (tmp_path / "a.trc").write_text("PathFileType\t4\t(X/Y/Z)\ta.trc\n")
    with pytest.raises(ValueError, match=r"a\.trc: motion is read from files that end in \.bvh, .*\.c3d"):
        read_motion(tmp_path / "a.trc")


def test_a_table_has_the_joints_of_its_skeleton(people, tmp_path):
    write_motion(tmp_path / "a.csv", MotionSet(people.clips[:1], people.skeleton))
    skeleton = tmp_path / "a.csv.skeleton.json"
    skeleton.write_text(skeleton.read_text().replace("RFoot", "RPaw"))
    with pytest.raises(ValueError, match=r"a\.csv: the joints in its columns differ from .*: RFoot, RPaw"):
        read_motion(tmp_path / "a.csv")
    skeleton.unlink()
    with pytest.raises(ValueError, match=r"a\.csv: which skeleton"):
        read_motion(tmp_path / "a.csv")


@pytest.mark.parametrize("kind", ["npz", "bvh"])
def test_joints_are_selected_by_index_or_name_and_renamed(kind, people, tmp_path):
    write_motion(tmp_path / "a.npz", people)
    write_motion(tmp_path / "b", MotionSet(people.clips[:1], people.skeleton), "bvh")
    path = tmp_path / ("a.npz" if kind == "npz" else "b")
    complete = read_motion(path)
    some = read_motion(path, joints=["Pelvis", "LHip", "LKnee"])
    np.testing.assert_array_equal(
        some.clips[0].positions,
        complete.clips[0].positions[:, [complete.skeleton.find(n) for n in some.skeleton.names]],
    )
    assert some.skeleton.parents == (-1, 0, 1)
    renamed = read_motion(path, joints={"Pelvis": "hips", "LKnee": "left_knee", "RKnee": "right_knee"})
    assert renamed.skeleton.names == ("hips", "left_knee", "right_knee")
    assert (renamed.skeleton.left, renamed.skeleton.right) == ((1,), (2,))
    onto = read_motion(path, onto=HUMAN36M)
    assert (onto.skeleton.name, onto.skeleton.up, onto.skeleton.fps) == ("human36m", "z", 30)


def test_motion_is_resampled_by_selection_or_interpolation(people):
    turning = people.with_rotations()
    clip = turning.clips[0]
    half = turning.resample(15)
    np.testing.assert_array_equal(half.clips[0].positions, clip.positions[::2])
    np.testing.assert_array_equal(half.clips[0].rotations, clip.rotations[::2])
    assert half.skeleton.fps == 15
    double, between = turning.resample(60), (clip.positions[1:] + clip.positions[:-1]) / 2
    np.testing.assert_allclose(double.clips[0].positions[::2], clip.positions, atol=1e-6)
    np.testing.assert_allclose(double.clips[0].positions[1::2], between, atol=1e-6)
    middle = clip.rotations[1:] + clip.rotations[:-1]  # half way on an arc
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    np.testing.assert_allclose(double.clips[0].rotations[1::2], middle, atol=1e-6)
    for wrong in (0, float("nan")):
        with pytest.raises(ValueError, match="frames per second"):
            people.resample(wrong)


def test_recordings_without_splits_are_divided(people):
    single = MotionSet([Clip("all", "walk", people.clips[0].positions)], WALKER)
    parts = single.assign_splits(0.25, 10)
    assert [(clip.key, clip.frames) for clip in parts] == [
        (("train", "walk"), 20),
        (("train", "walk-1"), 10),
        (("test", "walk"), 10),
    ]
    np.testing.assert_array_equal(np.concatenate([clip.positions for clip in parts]), single.clips[0].positions)
    both = MotionSet([Clip("a/b", "x", people.clips[0].positions), Clip("c", "x", people.clips[1].positions)], WALKER)

    assert [clip.key for clip in both.assign_splits(0.5, 30)] == [
        ("train", "a-b-x"),
        ("test", "c-x"),
    ]  # too short for parts
    assert [clip.split for clip in single.assign_splits(0.5, 30)] == ["train"]
    with pytest.raises(ValueError, match="`test` must be a fraction above 0 and below 1, got 1"):
        single.assign_splits(1)


def test_a_single_recording_has_windows_of_every_split(tmp_path):
    people = simulate(1, 500)
    write_motion(tmp_path / "own.bvh", MotionSet([replace(people.clips[0], split="all")], people.skeleton))
    data = MotionData.open(tmp_path / "own.bvh")
    assert (data.protocol.observed, data.protocol.predicted, data.protocol.fps) == (15, 60, 30)
    assert all(len(data.windows(split)) for split in ("train", "validation", "test"))
    again = MotionData.reopen(data.recorded(), data.schema)
    assert (again.protocol, again.fingerprint) == (data.protocol, data.fingerprint)


@pytest.mark.parametrize("representation", ["positions", "6d"])
def test_other_data_are_mapped_to_the_skeleton_of_a_run(representation, tmp_path):
    protocol = replace(PROTOCOLS["simulated"], representation=representation)
    people, others = simulate(3, 100, seed=1), simulate(2, 100, seed=2)
    write_motion(tmp_path / "a.npz", people)
    data = MotionData.open(tmp_path / "a.npz", protocol)
    names = [f"mixamorig:{name.replace('L', 'Left', 1)}" if name[0] == "L" else name for name in WALKER.names]
    write_motion(tmp_path / "b", MotionSet(others.clips, replace(WALKER, names=names)), "bvh")
    reopened = MotionData.reopen(data.recorded(), data.schema, tmp_path / "b")
    assert (reopened.schema, reopened.onto) == (data.schema, True)
    for clip in others:
        assert np.linalg.norm(reopened.motion[clip.key].positions - clip.positions, axis=-1).max() < 0.01
    again = MotionData.reopen(data.recorded(), data.schema, tmp_path / "a.npz")
    assert (again.fingerprint, again.onto) == (data.fingerprint, False)
    write_motion(tmp_path / "c", MotionSet(others.clips, replace(WALKER, names=[*names[:-1], "Paw"])), "bvh")
    strange = MotionData.reopen(data.recorded(), data.schema, tmp_path / "c")
    assert (strange.schema == data.schema, strange.onto) == (False, False)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes with names")
def test_pipes_in_a_folder_are_errors_without_waiting(bvh):
    os.mkfifo(bvh / "train" / "a.bvh")
    with pytest.raises(ValueError, match=r"a\.bvh must be a plain file, not .* a FIFO"):
        read_motion(bvh)
