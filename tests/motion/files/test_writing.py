"""Motion written for other programs, and `dvae data convert`."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from dvae.cli import main
from dvae.motion import (
    HUMAN36M,
    WALKER,
    Clip,
    MotionSet,
    Protocol,
    Skeleton,
    read_motion,
    save,
    simulate,
    windows,
    write_motion,
)
from dvae.motion.files.arrays import read_arrays
from dvae.motion.files.smpl import JOINTS


@pytest.fixture(scope="module")
def walkers():
    return simulate(clips=3, frames=12, seed=2)


@pytest.fixture(scope="module")
def recordings(walkers, tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    write_motion(folder, walkers, "bvh")
    return folder


def test_formats_and_names_that_do_not_fit_are_errors(walkers, tmp_path):
    for path, format, message in (
        ("a.bvh", None, "stores one clip per file, but there are 3"),
        ("a", None, "the format is unknown.*--format"),
        ("a.csv", "bvh", "the format is unknown"),
        ("a", "npz", "end its name in .npz"),
    ):
        with pytest.raises(ValueError, match=message):
            write_motion(tmp_path / path, walkers, format)
    for split, name in (("..", "a"), ("/etc", "a"), ("a", "../../b")):
        outside = MotionSet([replace(walkers.clips[0], split=split, name=name)], WALKER)
        with pytest.raises(ValueError, match="leads out of the folder"):
            write_motion(tmp_path / "inner", outside, "csv")
    assert not list(tmp_path.rglob("*.csv"))


@pytest.mark.filterwarnings("default:bvh has rotations")
def test_joints_that_rotations_move_are_named(walkers, tmp_path, capsys):
    """A pelvis that is not rigid has no rotation that fits all its bones."""
    bent = walkers.clips[1].positions.copy()
    hips = [WALKER.names.index(name) for name in ("LHip", "RHip")]
    bent[:, hips, 0] += 0.1 * np.sin(np.arange(len(bent)))[:, None]
    motion = MotionSet([walkers.clips[0], replace(walkers.clips[1], positions=bent)], WALKER)
    message = r"move joints of 1 of 2 clips by more than 1 cm, and those of '\S+' by up to \d+\.\d cm; write npz or csv"
    with pytest.warns(UserWarning, match=f"bvh has rotations .* {message}"):
        write_motion(tmp_path / "bvh", motion, "bvh")
    write_motion(tmp_path / "csv", motion, "csv")
    assert main(["data", "convert", str(tmp_path / "csv"), "--out", str(tmp_path / "again"), "--format", "bvh"]) == 0
    assert re.search(message, " ".join(capsys.readouterr().err.split()))
    written = read_motion(tmp_path / "bvh", metres=0.01).clips[1].positions
    assert np.linalg.norm(written - bent, axis=-1).max() > 0.01


def test_extra_joints_keep_the_positions_of_bones_that_share_a_joint(tmp_path):
    angle = np.linspace(1, 2, 12)
    positions = np.zeros((12, 3, 3))
    positions[:, 1, 0], positions[:, 2, 0], positions[:, 2, 1] = 1, np.cos(angle), np.sin(angle)
    motion = MotionSet([Clip("test", "a", positions)], Skeleton(("root", "a", "b"), (-1, 0, 0)))
    with pytest.warns(UserWarning, match=r"MotionSet.with_extra_joints adds joints for them$"):
        write_motion(tmp_path / "bent", motion, "bvh")
    write_motion(tmp_path / "extra", motion.with_extra_joints(), "bvh")


def test_amass_files_have_the_members_that_readers_expect(walkers, tmp_path):
    (path,) = write_motion(tmp_path / "a.npz", MotionSet(walkers.clips[:1], WALKER), "amass")
    arrays = read_arrays(path)
    assert arrays["poses"].shape == (12, 156)
    assert arrays["trans"].shape == (12, 3)
    assert arrays["mocap_framerate"] == 30
    assert not arrays["betas"].any()
    assert not arrays["poses"][:, 3 * len(JOINTS) :].any()
    heights = walkers.clips[0].positions[:, 0, 1]
    np.testing.assert_allclose(arrays["trans"][:, 2], heights, atol=1e-6)  # z up


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_converted_folder_equals_the_folder_as_read(jobs, recordings, tmp_path, capsys):
    options = ["--fps", "15", "--onto", "human36m", "--jobs", str(jobs)]
    assert main(["data", "convert", str(recordings), "--out", str(tmp_path / "a.npz"), *options]) == 0
    assert "3 clips; read as unit centimetres" in capsys.readouterr().err
    converted, expected = read_motion(tmp_path / "a.npz"), read_motion(recordings, onto=HUMAN36M).resample(15)
    assert [clip.key for clip in converted] == [clip.key for clip in expected]
    for clip in expected:
        np.testing.assert_array_equal(converted[clip.key].positions, clip.positions)
    assert (converted.skeleton.name, converted.skeleton.up, converted.skeleton.fps) == ("human36m", "z", 15)


@pytest.mark.slow
def test_relative_paths_start_from_the_directory_of_the_call(walkers, tmp_path, monkeypatch):
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        write_motion("recordings", walkers, "bvh")
        assert main(["data", "convert", "recordings", "--out", "out", "--format", "bvh", "--jobs", "2"]) == 0
        assert len([*(tmp_path / name / "out").rglob("*.bvh")]) == 3


@pytest.mark.parametrize("format", ["npz", "bvh", "csv", "amass"])
def test_labels_are_written_with_the_clips(format, walkers, tmp_path):
    moods = [
        replace(clip, labels={"mood": name}) for clip, name in zip(walkers, ("sad, or so", "glad", ""), strict=True)
    ]
    sad = MotionSet(moods, WALKER)
    moods_by_clip = {clip.key: clip.labels["mood"] for clip in sad}

    def read_moods(path):
        return {clip.key: clip.labels["mood"] for clip in read_motion(path)}

    out = "a.npz" if format == "npz" else "a"
    write_motion(tmp_path / "out" / out, sad, format)
    assert read_moods(tmp_path / "out" / out) == moods_by_clip
    save(tmp_path / "npz" / "b.npz", sad)
    for number, source in enumerate((tmp_path / "out" / out, tmp_path / "npz" / "b.npz")):
        target = tmp_path / str(number) / out
        assert main(["data", "convert", str(source), "--out", str(target), "--format", format, "--jobs", "1"]) == 0
        assert read_moods(target) == moods_by_clip
    if format == "csv":
        both = [str(tmp_path / "out" / "a" / split) for split in ("train", "test")]
        (tmp_path / "out" / "a" / "train" / "labels.csv").write_text("clip,mood\nperson_0001,wild\n")
        assert main(["data", "convert", *both, "--out", str(tmp_path / "both.npz"), "--jobs", "1"]) == 0
        joined = read_motion(tmp_path / "both.npz")
        assert joined["train", "person_0001"].labels["mood"] == "wild"


@pytest.mark.parametrize("older", [False, True], ids=["own files", "files of the folder"])
def test_archives_of_one_folder_keep_their_skeletons_and_labels(older, walkers, tmp_path):
    save(tmp_path / "a.npz", MotionSet([replace(clip, labels={"mood": "glad"}) for clip in walkers], WALKER))
    if older:  # as earlier versions wrote them
        for name in ("skeleton.json", "labels.csv"):
            (tmp_path / f"a.npz.{name}").rename(tmp_path / name)
    save(tmp_path / "c.npz", MotionSet([replace(walkers.clips[0], labels={})], replace(WALKER, fps=60.0)))
    first, other = (read_motion(tmp_path / name) for name in ("a.npz", "c.npz"))
    assert (first.skeleton, other.skeleton.fps) == (WALKER, 60)
    assert [each.clips[0].labels.get("mood") for each in (first, other)] == ["glad", None]
    save(tmp_path / "a.npz", MotionSet([replace(clip, labels={}) for clip in walkers], WALKER))
    assert read_motion(tmp_path / "a.npz").clips[0].labels.get("mood") is None


def test_an_archive_with_another_skeleton_is_an_error(walkers, tmp_path):
    save(tmp_path / "a.npz", walkers)
    arm = Skeleton(("shoulder", "elbow"), (-1, 0))
    arm.to_json(tmp_path / "skeleton.json")
    assert read_motion(tmp_path / "a.npz").skeleton == WALKER
    (tmp_path / "a.npz.skeleton.json").unlink()
    with pytest.raises(ValueError, match=r"a\.npz has 17 joints and .*skeleton\.json has 2"):
        read_motion(tmp_path / "a.npz")


def test_an_error_leaves_no_files_and_skipped_clips_are_not_written(recordings, walkers, tmp_path, capsys):
    shutil.copytree(recordings, tmp_path / "in")
    stranger = tmp_path / "in" / "train" / "stranger.bvh"
    text = (tmp_path / "in" / "train" / "person_0000.bvh").read_text()
    stranger.write_text(text.replace("JOINT LShoulder", "JOINT Wing"))
    command = [
        "data",
        "convert",
        str(tmp_path / "in"),
        "--out",
        str(tmp_path / "out"),
        "--format",
        "csv",
        "--jobs",
        "1",
    ]
    assert main(command) == 1
    assert "has Wing" in capsys.readouterr().err
    assert not list((tmp_path / "out").rglob("*"))
    assert main([*command, "--skip-bad"]) == 0
    assert "3 clips" in capsys.readouterr().err
    files = sorted(path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*.csv"))
    assert files == ["labels.csv", "test/person_0002.csv", "train/person_0000.csv", "train/person_0001.csv"]
    for wrong in (
        ["convert", command[2]],
        ["info", *command[2:]],
        ["get", "cmu2", *command[3:5]],
        [*command[1:], "--url", "x"],
    ):
        assert main(["data", *wrong]) == 2


@pytest.mark.filterwarnings("default:bvh has rotations")  # limbs of forecasts change their lengths
def test_forecasts_of_a_run_are_written_as_bvh(run, tmp_path, capsys):
    assert main(["forecast", str(run), "--out", str(tmp_path / "one.bvh"), "--samples", "2"]) == 0
    notes = " ".join(capsys.readouterr().err.split())
    assert "move joints of 1 of 1 clips by more than 1 cm" in notes
    assert "the first of 2 futures of 60 frames for each of 1 windows, after 15 observed frames" in notes
    assert "relative to the root: the protocol simulated removes the root's path" in notes
    motion_set = read_motion(
        tmp_path / "one.bvh", onto=WALKER, metres=0.01
    )  # a barely fitted model is no plausible person
    assert motion_set.clips[0].frames == 75


def test_archives_of_clips_are_joined(walkers, tmp_path, capsys):
    folder, out = tmp_path / "in", str(tmp_path / "all.npz")
    folder.mkdir()
    paths = [folder / f"{clip.name}.npz" for clip in walkers]
    for path, clip in zip(paths, walkers, strict=True):
        save(path, replace(walkers, clips=[clip]))
    assert main(["data", "info", str(folder)]) == 1
    assert f"dvae data convert {folder}/*.npz --out ALL.npz" in " ".join(capsys.readouterr().err.split())
    assert main(["data", "convert", *map(str, paths), "--out", out]) == 0
    assert read_motion(out).fingerprint() == walkers.fingerprint()
    for other, message in (
        (paths[0], "is given twice"),
        (folder / "z.npz", "its up axis is z, but y in"),
    ):
        save(folder / "z.npz", MotionSet([walkers.clips[0]], replace(WALKER, up="z")))
        assert main(["data", "convert", str(paths[0]), str(other), "--out", out]) == 1
        assert message in " ".join(capsys.readouterr().err.split())


def test_files_with_their_own_units_are_merged(walkers, tmp_path, capsys):
    first, second = (replace(walkers, clips=[clip]) for clip in walkers.clips[:2])
    write_motion(tmp_path / "a.bvh", first)
    save(tmp_path / "b.npz", second)
    with np.load(tmp_path / "b.npz") as file:
        inches = {name: file[name] / np.float32(0.0254) for name in file.files}
    np.savez(tmp_path / "b.npz", **inches)
    paths = [str(tmp_path / name) for name in ("a.bvh", "b.npz")]
    command = ["data", "convert", *paths, "--out", str(tmp_path / "all.npz")]

    def notes(*options, code=0):
        assert main([*command, *options]) == code
        return " ".join(capsys.readouterr().err.split())

    assert "--units" in notes(code=1)  # inches are no plausible metres
    wrong = notes("--units", f"{paths[1]}=0.015", code=1)
    assert f"{paths[1]}: its body is" in wrong
    assert f"as large as in {paths[0]}" in wrong
    stated = notes("--units", f"{paths[1]}=in")
    assert f"{paths[0]}: unit centimetres (0.01 m)" in stated
    assert f"{paths[1]}: unit as given (0.0254 m)" in stated
    merged = read_motion(tmp_path / "all.npz")
    assert [clip.key for clip in merged] == [("all", "a"), second.clips[0].key]
    np.testing.assert_allclose(merged.clips[0].positions, first.clips[0].positions, atol=1e-4)
    np.testing.assert_allclose(merged.clips[1].positions, second.clips[0].positions, atol=1e-5)
    assert "the length of a unit in metres, such as 0.01 for centimetres, got -1" in notes(
        "--units", f"{paths[1]}=-1", code=1
    )
    write_motion(tmp_path / "c.npz", first, "amass")
    assert main(["data", "convert", paths[0], str(tmp_path / "c.npz"), *command[4:]]) == 1
    error = " ".join(capsys.readouterr().err.split())
    assert f"{paths[0]} seems to have the unit centimetres (0.01 m), {tmp_path / 'c.npz'} as the file says" in error
    assert "--units FILE=0.01" in error
    for option, message in (("c.npz=cm", "c.npz is not among the files"), (f"{paths[0]}=ell", "expected FILE=m")):
        assert message in notes("--units", option, code=2)
    assert "give each file one unit" in notes("--units", f"{paths[0]}=m", f"{paths[0]}=cm", code=2)
    write_motion(tmp_path / "d.bvh", second)  # with another rest pose
    assert main(["data", "convert", paths[0], str(tmp_path / "d.bvh"), *command[4:], "--units", f"{paths[0]}=cm"]) == 0
    assert "rotations are left out, because rest poses differ" in " ".join(capsys.readouterr().err.split())
    assert read_motion(tmp_path / "all.npz").clips[0].rotations is None


def test_clips_of_the_same_name_get_a_prefix(walkers, recordings, tmp_path, capsys):
    (tmp_path / "b").mkdir()
    for path in ("a.npz", "c.npz", "b/c.npz"):
        save(tmp_path / path, walkers)
    sources, out = [str(tmp_path / path) for path in ("a.npz", "c.npz", "b/c.npz")], str(tmp_path / "all.npz")
    command = ["data", "convert", *sources, "--out", out]
    assert main(command) == 1
    error = " ".join(capsys.readouterr().err.split())
    assert f"occurs twice, in {sources[0]} and {sources[1]}" in error
    assert "--prefix" in error
    assert main([*command, "--prefix"]) == 0
    names = {clip.name.removesuffix(f"-{walkers.clips[0].name}") for clip in read_motion(out)}
    assert {"a", tmp_path.name, "b"} <= names
    shutil.copytree(recordings, tmp_path / "d" / recordings.name)
    folders = [str(recordings), str(tmp_path / "d" / recordings.name)]
    assert main(["data", "convert", *folders, "--out", out]) == 1
    assert "--prefix" in capsys.readouterr().err
    assert main(["data", "convert", *folders, "--out", out, "--prefix"]) == 0
    assert {clip.split for clip in read_motion(out)} == {"train", "test"}
    assert any(clip.name.startswith("d-") for clip in read_motion(out))


def test_merged_clips_keep_their_splits(walkers, recordings, tmp_path, capsys):
    archive, out = tmp_path / "pa.npz", tmp_path / "all.npz"
    save(archive, walkers)
    for options in (["--prefix"], ["--prefix", "--units", f"{recordings}/=cm", f"{tmp_path}/./pa.npz=m"]):
        sources = [str(archive), f"{recordings}/"]
        assert main(["data", "convert", *sources, "--out", str(out), *options]) == 0
        merged = read_motion(out)
        assert {clip.split for clip in merged} == {"train", "test"}
        assert {clip.name.split("-")[0] for clip in merged} == {"pa", recordings.name}
        protocol = Protocol("short", 2, 3, 30, train_stride=1, test_stride=1)
        used = [clip for split in ("train+validation", "test") for clip in windows(merged, protocol, split).clips]
        assert len(used) == len(merged) == 2 * len(walkers)
    capsys.readouterr()
    assert main(["data", "convert", str(archive), str(archive), "--out", str(out), "--prefix"]) == 1
    assert "pa.npz is given twice; give each file or folder once" in " ".join(capsys.readouterr().err.split())


def test_files_with_other_rates_or_joints_are_merged_only_on_request(walkers, tmp_path, capsys):
    first, second = (replace(walkers, clips=[clip]) for clip in walkers.clips[:2])
    save(tmp_path / "a.npz", first)
    save(tmp_path / "b.npz", second.resample(15))
    paths = [str(tmp_path / name) for name in ("a.npz", "b.npz")]
    command = ["data", "convert", *paths, "--out", str(tmp_path / "all.npz")]
    assert main(command) == 1
    error = " ".join(capsys.readouterr().err.split())
    assert f"{paths[1]}: 15 frames per second, {paths[0]} has 30" in error
    assert main([*command, "--fps", "15"]) == 0
    assert read_motion(tmp_path / "all.npz").skeleton.fps == 15
    renamed = replace(WALKER, names=("Wing" if name == "LWrist" else name for name in WALKER.names))
    save(tmp_path / "b.npz", MotionSet(second.clips, renamed))
    capsys.readouterr()
    assert main(command) == 1
    error = " ".join(capsys.readouterr().err.split())
    assert f"{paths[1]}: does not have LWrist and has Wing, unlike {paths[0]}" in error
    assert "--onto" in error
