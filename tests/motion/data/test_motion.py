import csv
import errno
import io
import os
import pickle
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from dvae.motion import (
    HUMAN36M,
    HUMAN36M_KEPT,
    HUMANEVA,
    PROTOCOLS,
    WALKER,
    Clip,
    Forecasts,
    MotionSet,
    Protocol,
    Skeleton,
    occlude,
    read_motion,
    rotate_about_up,
    save,
    simulate,
    windows,
)

TINY = Protocol("tiny", observed=3, predicted=4, fps=30, train_stride=2, test_stride=3, validation=0.25)


def people(frames=(20, 12, 30, 9, 25, 7, 6), split="train", seed=0):
    """Clips of the given lengths whose positions tell (clip, frame, joint, axis) apart."""
    random = np.random.default_rng(seed)
    shapes = [(F, WALKER.joints, 3) for F in frames]
    return [Clip(split, f"clip_{i}", random.uniform(-0.8, 0.8, s)) for i, s in enumerate(shapes)]


def motion(**kwargs):
    return MotionSet([*people(**kwargs), *people((15, 8), "test", 1)], WALKER, "people")


def archive(path, content, name="positions_3d"):
    """An npz whose member is a pickle, written by hand as numpy writes it (protocol 3)."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "|O", "fortran_order": False, "shape": ()})
    stream.write(content)
    with zipfile.ZipFile(path, "w") as file:
        file.writestr(f"{name}.npy", stream.getvalue())
    return path


class TestSkeleton:
    @pytest.mark.parametrize("skeleton", [HUMAN36M, HUMANEVA, WALKER], ids=lambda s: s.name)
    def test_presets_are_trees_with_two_equal_sides(self, skeleton):
        assert len(skeleton.edges) == skeleton.joints - 1
        assert len(skeleton.left) == len(skeleton.right)
        for left, right in zip(skeleton.left, skeleton.right, strict=True):
            assert skeleton.names[left][1:] == skeleton.names[right][1:]
        assert [skeleton.order.index(p) < skeleton.order.index(c) for p, c in skeleton.edges].count(False) == 0

    def test_human36m_is_the_tree_of_the_papers(self):
        assert (HUMAN36M.joints, HUMANEVA.joints, len(HUMAN36M_KEPT)) == (17, 15, 17)
        dropped = {4, 5, 9, 10, 11, 16, 20, 21, 22, 23, 24, 28, 29, 30, 31}
        assert set(HUMAN36M_KEPT) == set(range(32)) - dropped

    @pytest.mark.parametrize(
        ("fields", "message"),
        [
            ({"names": ("a", "a"), "parents": (-1, 0)}, "names repeat: a"),
            ({"names": ("a", "b"), "parents": (-1,)}, "2 names but 1 parents"),
            ({"names": ("a", "b"), "parents": (-1, -1)}, "one root .* found a, b"),
            ({"names": ("a", "b"), "parents": (1, 0)}, "one root .* found none"),
            ({"names": ("a", "b", "c"), "parents": (-1, 2, 1)}, "cycle"),
            ({"names": ("a", "b"), "parents": (-1, 7)}, "parent of b is joint 7"),
            ({"names": ("a", "b"), "parents": (-1, 0), "left": (5,)}, r"left names joints \[5\]"),
            ({"names": ("a",), "parents": (-1,), "up": "x"}, "up axis is 'x'"),
            ({"names": ("a",), "parents": (-1,), "fps": 0}, "0 frames per second"),
        ],
    )
    def test_what_is_no_skeleton_is_refused(self, fields, message):
        with pytest.raises(ValueError, match=message):
            Skeleton(**fields)

    def test_json_round_trip_with_the_root_anywhere(self, tmp_path):
        skeleton = Skeleton(("hand", "arm", "root"), (1, 2, -1), (0,), (), "z", 25.0, "arm", (0.2, 0.3))
        skeleton.to_json(tmp_path / "skeleton.json")
        assert Skeleton.from_json(tmp_path / "skeleton.json") == skeleton

    def test_a_file_that_is_no_skeleton_is_an_error(self, tmp_path):
        (tmp_path / "s.json").write_text('{"joints": 3}')
        with pytest.raises(ValueError, match="expected JSON with joint_names and parents"):
            Skeleton.from_json(tmp_path / "s.json")

    def test_bone_lengths_of_numpy_and_torch_agree(self):
        positions = people()[0].positions
        np.testing.assert_allclose(
            WALKER.bone_lengths(torch.from_numpy(positions)).numpy(),
            WALKER.bone_lengths(positions),
            rtol=1e-12,
        )
        with pytest.raises(ValueError, match=r"expected \(..., 17, 3\)"):
            WALKER.bone_lengths(positions[:, :5])

    @settings(deadline=None)
    @given(angle=st.floats(-3.1, 3.1), up=st.sampled_from("yz"), seed=st.integers(0, 1000))
    def test_heading_follows_a_rotation_and_bones_do_not_notice(self, angle, up, seed):
        skeleton = replace(WALKER, up=up)
        pose = torch.from_numpy(np.random.default_rng(seed).normal(size=(skeleton.joints, 3)))
        turned = rotate_about_up(pose, torch.tensor(angle, dtype=torch.float64), up)
        change = skeleton.heading(turned) - skeleton.heading(pose) - angle
        torch.testing.assert_close(torch.cos(change), torch.ones_like(change))
        torch.testing.assert_close(skeleton.bone_lengths(turned), skeleton.bone_lengths(pose))
        torch.testing.assert_close(turned[:, skeleton.vertical], pose[:, skeleton.vertical])

    @pytest.mark.parametrize("up", ["y", "z"])
    def test_heading_zero_has_the_left_side_towards_x(self, up):
        skeleton = replace(WALKER, up=up)
        pose = torch.zeros(skeleton.joints, 3)
        pose[list(skeleton.left), 0], pose[list(skeleton.right), 0] = 0.2, -0.2
        torch.testing.assert_close(skeleton.heading(pose), torch.tensor(0.0))

    def test_a_skeleton_without_sides_has_no_heading(self):
        with pytest.raises(ValueError, match="no left and right"):
            Skeleton(("a", "b"), (-1, 0)).heading(torch.zeros(2, 3))


def damaged(change):
    positions = people((10,))[0].positions.astype(np.float32)
    return Clip("train", "walk", change(positions.copy()))


def with_nan(positions):
    positions[4, 2, 1] = np.nan
    return positions


BAD = [
    (with_nan, "train/walk has NaN .* 1 joint positions in 1 of 10 frames, first RKnee at frame 4"),
    (lambda p: p[:, :12], "train/walk has 12 joints, skeleton 'walker' has 17"),
    (lambda p: p[..., :2], r"train/walk has shape \(10, 17, 2\), expected \(frames, joints, 3\)"),
    (lambda p: p[0], r"train/walk has shape \(17, 3\)"),
    (lambda p: p[:0], "train/walk has no frames"),
    (lambda p: p * 1000, r"train/walk shows a person of 1\d{3} m .* millimetres"),
    (lambda p: p * 100, r"train/walk shows a person of 1\d\d\.?\d* m .* centimetres"),
    (lambda p: p * 0.01, "train/walk shows a person of 0.01.* another unit"),
    (lambda p: p.astype(object), "train/walk holds object"),
]


class TestMotionSet:
    @pytest.mark.parametrize(("change", "message"), BAD)
    def test_bad_clips_are_refused_by_name_and_number(self, change, message):
        with pytest.raises(ValueError, match=message):
            MotionSet([damaged(change)], WALKER)

    def test_bad_clips_can_be_dropped_and_are_counted(self):
        clips = [*people(), *(replace(damaged(c), name=f"bad_{i}") for i, (c, _) in enumerate(BAD))]
        kept = MotionSet(clips, WALKER, skip_bad=True)
        assert len(kept) == len(people())
        assert [name for _, name, _ in kept.skipped] == [f"bad_{i}" for i in range(len(BAD))]
        assert kept.summary()[0]["skipped"] == len(BAD)
        with pytest.raises(ValueError, match="no clips; 1 were skipped, the first: clip train/walk has NaN"):
            MotionSet([damaged(with_nan)], WALKER, skip_bad=True)

    def test_what_was_dropped_stays_said_whatever_becomes_of_the_others(self, tmp_path):
        save(tmp_path / "a.npz", simulate(4, 30))
        arrays = dict(np.load(tmp_path / "a.npz"))
        arrays["train/person_0001"][5, 3] = np.nan
        np.savez(tmp_path / "a.npz", **arrays)
        kept = read_motion(tmp_path / "a.npz", skip_bad=True)
        assert [name for _, name, _ in kept.skipped] == ["person_0001"]
        onto = read_motion(tmp_path / "a.npz", skip_bad=True, onto=HUMAN36M)
        for other in (kept.resampled(15), kept.with_rotations(), kept.divided(), onto, occlude(kept)):
            assert list(other.skipped) == list(kept.skipped)
        again = MotionSet([*kept, damaged(with_nan)], WALKER, skip_bad=True, skipped=kept.skipped)
        assert [name for _, name, _ in again.skipped] == ["person_0001", "walk"]

    def test_a_lying_person_is_a_person(self):
        lying = simulate(1, 30).clips[0].positions[..., [1, 2, 0]]  # what was height is now along x
        MotionSet([Clip("train", "asleep", lying)], WALKER)

    def test_names_may_repeat_between_splits_but_not_within_one(self):
        here, there = people((9,)), people((9,), "test", 1)
        both = MotionSet([*here, *there], WALKER)
        np.testing.assert_array_equal(both["test", "clip_0"].positions, there[0].positions.astype(np.float32))
        with pytest.raises(ValueError, match="train/clip_0 is there twice"):
            MotionSet([*here, *here], WALKER)
        with pytest.raises(KeyError, match="keys are"):
            both["clip_0"]

    def test_fingerprint_sees_every_part_of_the_content(self):
        original = motion()
        first, *rest = original.clips
        changed = first.positions.copy()
        changed[3, 4, 1] += 1e-5
        others = [
            MotionSet([replace(first, positions=changed), *rest], WALKER),
            MotionSet([replace(first, name="other"), *rest], WALKER),
            MotionSet([replace(first, split="test2"), *rest], WALKER),
            MotionSet(rest, WALKER),
            MotionSet(original.clips, HUMAN36M),
        ]
        prints = [m.fingerprint() for m in (original, *others)]
        assert len(set(prints)) == len(prints)
        assert motion().fingerprint() == original.fingerprint()

    def test_a_set_does_not_share_memory_with_its_source(self):
        clips = people()
        made = MotionSet(clips, WALKER)
        before = made.fingerprint()
        clips[0].positions[:] = 0
        assert made.fingerprint() == before

    def test_summary_and_info_tell_the_numbers(self):
        rows = motion().summary()
        assert [(r["split"], r["clips"], r["frames"], r["shortest"], r["longest"]) for r in rows] == [
            ("train", 7, 109, 6, 30),
            ("test", 2, 23, 8, 15),
        ]
        console = Console(file=io.StringIO(), width=100)
        console.print(simulate(8, 40).info())
        text = console.file.getvalue()
        assert "17 joints" in text
        assert "vary by at most 0.00%" in text


class Evil:
    def __reduce__(self):
        return os.system, ("touch pwned",)


class Evaluates:
    def __reduce__(self):
        return eval, ("1 + 1",)


class Allocates:
    def __reduce__(self):
        return np.ndarray(0).__reduce__()[0], (np.ndarray, (2**50,), b"b")


class OtherCodec:
    def __reduce__(self):
        import codecs

        return codecs.encode, ("x", "zlib")


class TestArchive:
    def nested(self):
        clips = motion()
        return {s: {c.name: c.positions for c in clips if c.split == s} for s in clips.splits}

    @pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
    def test_every_pickle_protocol_is_read(self, tmp_path, protocol):
        content = pickle.dumps(np.array(self.nested(), dtype=object), protocol)
        read = read_motion(archive(tmp_path / "a.npz", content), skeleton=WALKER)
        assert read.fingerprint() == motion().fingerprint()

    def test_what_numpy_writes_is_read_under_old_and_new_module_names(self, tmp_path):
        np.savez_compressed(tmp_path / "a.npz", positions_3d=np.array(self.nested(), dtype=object))
        assert read_motion(tmp_path / "a.npz", skeleton=WALKER).fingerprint() == motion().fingerprint()
        content = pickle.dumps(np.array(self.nested(), dtype=object), 2)
        other = (b"numpy.core", b"numpy._core")[b"numpy.core" in content]
        here = b"numpy._core" if other == b"numpy.core" else b"numpy.core"
        swapped = read_motion(archive(tmp_path / "b.npz", content.replace(here, other)), skeleton=WALKER)
        assert swapped.fingerprint() == motion().fingerprint()

    @pytest.mark.parametrize("protocol", [0, 2, 4])
    @pytest.mark.parametrize(
        ("hostile", "named"),
        [
            (Evil(), r"refused (posix|nt)\.system"),
            (Evaluates(), r"refused (builtins|__builtin__)\.eval"),
            (Path("x"), r"refused (pathlib|_reconstructor|copy_reg|copyreg)"),
            (Allocates(), r"refused an array declared with shape \(1125899906842624,\)"),
            (OtherCodec(), "refused the codec zlib"),
            (np.array(["2020"], dtype="datetime64[D]"), r"refused an array of datetime64"),
        ],
        ids=["system", "eval", "object", "allocation", "codec", "dtype"],
    )
    def test_hostile_pickles_are_refused_by_name_and_not_run(self, tmp_path, monkeypatch, hostile, named, protocol):
        monkeypatch.chdir(tmp_path)
        nested = {**self.nested(), "test": {"walk": hostile}}
        path = archive(tmp_path / "a.npz", pickle.dumps(nested, protocol))
        with pytest.raises(ValueError, match=rf"a\.npz: positions_3d: {named}"):
            read_motion(path, skeleton=WALKER)
        assert not (tmp_path / "pwned").exists()

    def test_a_pickle_outside_positions_3d_is_refused_unread(self, tmp_path):
        path = archive(tmp_path / "a.npz", pickle.dumps(Evil()), name="train/walk")
        with pytest.raises(ValueError, match="train/walk: holds pickled objects"):
            read_motion(path, skeleton=WALKER)

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (pickle.dumps([1, 2]), "no dictionary of dictionaries"),
            (pickle.dumps({"train": [1]}), "no dictionary of dictionaries"),
            (pickle.dumps({"train": {"walk": [1.0]}}), "clip train/walk is a list, expected a numpy array"),
            (pickle.dumps({"train": {}}), "no clips"),
            (pickle.dumps({"a": 1})[:-3], "damaged pickle"),
            (b"", "damaged pickle"),
            (b"\x80\x04\x8e" + (2**60).to_bytes(8, "little"), "damaged pickle"),
        ],
    )
    def test_other_contents_are_explained(self, tmp_path, content, message):
        with pytest.raises(ValueError, match=message):
            read_motion(archive(tmp_path / "a.npz", content), skeleton=WALKER)

    @settings(max_examples=60, deadline=None)
    @given(place=st.floats(0, 1), cut=st.booleans())
    def test_damage_anywhere_gives_one_sentence_or_the_same_data(self, tmp_path_factory, place, cut):
        path = tmp_path_factory.mktemp("damage") / "a.npz"
        np.savez_compressed(path, positions_3d=np.array(self.nested(), dtype=object))
        content = bytearray(path.read_bytes())
        at = min(int(place * len(content)), len(content) - 1)
        content[at] ^= 0xFF
        path.write_bytes(content[:at] if cut else content)
        try:
            read = read_motion(path, skeleton=WALKER)
        except ValueError as refused:
            sentence = str(refused)
        else:  # bytes such as a time stamp mean nothing here
            assert read.fingerprint() == motion().fingerprint()
            return
        assert "a.npz: " in sentence

    def test_a_missing_file_and_a_file_of_another_kind(self, tmp_path):
        with pytest.raises(FileNotFoundError, match="no such file"):
            read_motion(tmp_path / "nothing.npz")
        (tmp_path / "text.npz").write_text("hello")
        with pytest.raises(ValueError, match="not an npz archive"):
            read_motion(tmp_path / "text.npz", skeleton=WALKER)


class TestPlain:
    @pytest.mark.parametrize("made", [lambda: simulate(5, 20), motion], ids=["labelled", "bare"])
    def test_save_and_load_round_trip(self, tmp_path, made):
        save(tmp_path / "new" / "set.npz", made())
        read = read_motion(tmp_path / "new" / "set.npz")
        assert read.fingerprint() == made().fingerprint()
        assert read.skeleton == made().skeleton
        for old, new in zip(made(), read, strict=True):
            assert {**new.labels, **old.labels} == new.labels

    def test_links_are_replaced_and_not_followed(self, tmp_path):
        victim = tmp_path / "mine.txt"
        victim.write_text("mine")
        links = [tmp_path / name for name in ("a.npz", "a.npz.skeleton.json", "a.npz.labels.csv")]
        for link in links:
            link.symlink_to(victim)
        save(links[0], simulate(5, 20))
        assert victim.read_text() == "mine"
        assert not any(link.is_symlink() for link in links)
        assert read_motion(links[0]).fingerprint() == simulate(5, 20).fingerprint()

    @pytest.mark.parametrize("name", ["a.npz", "a.npz.skeleton.json", "a.npz.labels.csv"])
    def test_a_full_disk_leaves_the_older_file_and_is_named(self, name, tmp_path, monkeypatch):
        save(tmp_path / "a.npz", simulate(5, 20))
        old = (tmp_path / name).read_bytes()
        replace_file = os.replace

        def full(new, path):
            if Path(path).name == name:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            replace_file(new, path)

        monkeypatch.setattr(os, "replace", full)
        with pytest.raises(OSError, match=f"No space left on device: '{tmp_path / name}'"):
            save(tmp_path / "a.npz", simulate(5, 21))
        assert (tmp_path / name).read_bytes() == old
        assert len(list(tmp_path.iterdir())) == 3

    def test_a_body_at_rest_is_read_again(self, tmp_path):
        frames = 80 * 10**6 // (WALKER.joints * 3 * 4)  # packs to less than a hundredth
        rest = np.repeat(people()[0].positions[:1].astype(np.float32), frames, 0)
        save(tmp_path / "a.npz", MotionSet([Clip("train", "rest", rest)], WALKER))
        assert read_motion(tmp_path / "a.npz").clips[0].positions.shape == rest.shape

    def test_a_forecast_of_a_body_at_rest_is_read_again(self, tmp_path):
        future = np.zeros((80 * 10**6 // (10 * WALKER.joints * 3 * 4), 1, 10, WALKER.joints, 3), np.float32)
        Forecasts(WALKER, [("test", "rest", 0)], future, future[0], future[0]).save(tmp_path / "a.npz")
        assert Forecasts.load(tmp_path / "a.npz").forecasts.shape == future.shape
        Forecasts(WALKER, [("test", "rest", 0)], future[:9], future[0], future[0]).save(tmp_path / "a.npz")
        assert (tmp_path / "a.npz").stat().st_size < future[:9].nbytes  # compressed where that is read

    def test_fortran_order_other_numbers_and_keys_without_a_split(self, tmp_path):
        positions = people((9,))[0].positions
        np.savez(tmp_path / "a.npz", walk=np.asfortranarray(positions), **{"S1/Walking 1": positions})
        read = read_motion(tmp_path / "a.npz", skeleton=WALKER)
        assert [clip.key for clip in read] == [("all", "walk"), ("S1", "Walking 1")]
        for clip in read:
            np.testing.assert_array_equal(clip.positions, positions.astype(np.float32))

    def test_splits_may_have_slashes_and_clip_names_may_not(self, tmp_path):
        save(tmp_path / "a.npz", MotionSet(people((9,), "Train/S1"), WALKER))
        assert read_motion(tmp_path / "a.npz").clips[0].key == ("Train/S1", "clip_0")
        with pytest.raises(ValueError, match="'S1/walk' has a slash"):
            save(tmp_path / "a.npz", MotionSet([replace(people()[0], name="S1/walk")], WALKER))

    def test_a_declared_shape_is_not_believed(self, tmp_path):
        stream = io.BytesIO()
        header = {"descr": "<f4", "fortran_order": False, "shape": (10**12, 17, 3)}
        np.lib.format.write_array_header_1_0(stream, header)
        with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
            file.writestr("train/walk.npy", stream.getvalue() + bytes(100))
        with pytest.raises(ValueError, match=r"train/walk: declares shape \(1000000000000, 17, 3\)"):
            read_motion(tmp_path / "a.npz", skeleton=WALKER)

    def test_without_a_skeleton_the_error_says_what_to_write(self, tmp_path):
        np.savez(tmp_path / "a.npz", walk=people()[0].positions)
        with pytest.raises(ValueError, match=r'skeleton\.json into its folder \(\{"joint_names"'):
            read_motion(tmp_path / "a.npz")

    def test_labels_are_found_by_split_and_clip(self, tmp_path):
        save(tmp_path / "a.npz", motion())
        with (tmp_path / "mine.csv").open("w", newline="") as file:
            rows = [("clip", "split", "mood"), ("clip_0", "test", "glad"), ("clip_0", "train", "sad")]
            csv.writer(file).writerows(rows)
        read = read_motion(tmp_path / "a.npz", labels=tmp_path / "mine.csv")
        assert read["train", "clip_0"].labels["mood"] == "sad"
        assert read["test", "clip_0"].labels["mood"] == "glad"
        assert read["test", "clip_1"].labels == {}
        (tmp_path / "mine.csv").write_text("clip,split\nother,train\n")
        with pytest.raises(ValueError, match=r"no row names a clip of .*a.npz"):
            read_motion(tmp_path / "a.npz", labels=tmp_path / "mine.csv")
        (tmp_path / "mine.csv").write_text("name\nother\n")
        with pytest.raises(ValueError, match="expected a column named clip"):
            read_motion(tmp_path / "a.npz", labels=tmp_path / "mine.csv")

    def test_skip_bad_drops_what_load_refuses(self, tmp_path):
        good, bad = people((9,))[0].positions, damaged(with_nan).positions
        np.savez(tmp_path / "a.npz", **{"train/good": good, "train/bad": bad})
        with pytest.raises(ValueError, match="train/bad has NaN"):
            read_motion(tmp_path / "a.npz", skeleton=WALKER)
        read = read_motion(tmp_path / "a.npz", skeleton=WALKER, skip_bad=True)
        assert [clip.name for clip in read] == ["good"]
        assert read.skipped[0][:2] == ("train", "bad")

    def test_the_joints_of_a_larger_file_can_be_chosen(self, tmp_path):
        full = np.random.default_rng(0).uniform(-0.8, 0.8, (9, 32, 3)).astype(np.float32)
        np.savez(tmp_path / "a.npz", **{"S1/Walking": full})
        read = read_motion(tmp_path / "a.npz", skeleton=HUMAN36M, joints=HUMAN36M_KEPT)
        np.testing.assert_array_equal(read.clips[0].positions, full[:, list(HUMAN36M_KEPT)])

    def test_the_known_archives_need_no_skeleton(self, tmp_path):
        random = np.random.default_rng(0)
        wide, narrow = (random.uniform(-0.8, 0.8, (9, joints, 3)).astype(np.float32) for joints in (32, 15))
        for name, nested in (
            ("h36m", {"S1": {"Walking": wide}, "S11": {"Eating 1": wide}}),
            ("humaneva", {"Train/S1": {"Jog 1": narrow}, "Validate/S3": {"Box 1": narrow}}),
            ("stranger", {"S1": {"Walking": narrow}}),
        ):
            np.savez(tmp_path / f"{name}.npz", positions_3d=np.array(nested, dtype=object))
        human36m, humaneva = read_motion(tmp_path / "h36m.npz"), read_motion(tmp_path / "humaneva.npz")
        assert (human36m.skeleton, humaneva.skeleton) == (HUMAN36M, HUMANEVA)
        np.testing.assert_array_equal(human36m.clips[0].positions, wide[:, list(HUMAN36M_KEPT)])
        np.testing.assert_array_equal(humaneva.clips[1].positions, narrow)
        with pytest.raises(ValueError, match=r"skeleton\.json into its folder"):
            read_motion(tmp_path / "stranger.npz")

    def test_what_a_file_unpacks_to_is_limited_as_a_whole(self, tmp_path, monkeypatch):
        positions = people((9,))[0].positions
        np.savez_compressed(tmp_path / "a.npz", **{f"train/{i}": positions for i in range(4)})
        monkeypatch.setattr("dvae.motion.files.archive.LARGEST", 2 * positions.nbytes)
        with pytest.raises(ValueError, match=r"a\.npz: it would unpack to [\d,]+ bytes, at most 7,344 are read"):
            read_motion(tmp_path / "a.npz", skeleton=WALKER)


class TestWindows:
    def expected(self, protocol, key, length=None):
        """One window, straight from the definition."""
        split, name, start = key
        window = motion()[split, name].positions[start : start + (length or protocol.length)]
        if protocol.root == "drop":
            return (window - window[:, :1])[:, 1:].reshape(len(window), -1)
        return (window - window[:1, :1]).reshape(len(window), -1)

    @pytest.mark.parametrize("root", ["drop", "relative"])
    @pytest.mark.parametrize("length", [None, 5, 12])
    def test_listed_windows_are_the_definition(self, root, length):
        protocol = replace(TINY, root=root)
        listed = windows(motion(), protocol, "train+validation", length)
        T = length or 7
        keys = [("train", c.name, s) for c in people() for s in range(0, c.frames - T + 1, 2)]
        assert listed.keys == keys
        assert len(listed) == len(keys)
        assert listed.skipped == [("train", c.name, c.frames) for c in people() if c.frames < T]
        x = listed.all()["x"]
        assert x.shape == (len(keys), T, listed.size)
        for window, key in zip(x, keys, strict=True):
            np.testing.assert_array_equal(window.numpy(), self.expected(protocol, key, length))

    def test_a_clip_of_exactly_one_window_is_used_to_its_last_frame(self):
        only = windows(MotionSet(people((7,)), WALKER), replace(TINY, validation=0.0), "train")
        assert only.keys == [("train", "clip_0", 0)]
        assert torch.isfinite(only.sample(4, torch.Generator().manual_seed(0))["x"]).all()

    def test_positions_put_the_root_back(self):
        for root in ("drop", "relative"):
            cut = windows(motion(), replace(TINY, root=root), "test")
            placed = cut.positions(cut.all()["x"])
            assert placed.shape == (len(cut), 7, 17, 3)
            assert (placed[:, 0, 0] == 0).all()
            truth = np.stack([WALKER.bone_lengths(motion()[s, n].positions[t : t + 7]) for s, n, t in cut.keys])
            np.testing.assert_allclose(WALKER.bone_lengths(placed).numpy(), truth, atol=1e-6)
        with pytest.raises(ValueError, match="frames have 50 numbers, expected 51"):
            cut.positions(torch.zeros(3, 50))

    def test_the_root_need_not_be_the_first_joint(self):
        skeleton = Skeleton(("a", "root", "b"), (1, -1, 1), (0,), (2,))
        positions = np.random.default_rng(0).uniform(-0.8, 0.8, (9, 3, 3)).astype(np.float32)
        cut = windows(MotionSet([Clip("test", "c", positions)], skeleton), TINY, "test")
        placed = cut.positions(cut.all()["x"])[0].numpy()
        np.testing.assert_array_equal(placed, positions[:7] - positions[:7, 1:2])

    def test_drawn_windows_are_windows_and_only_the_generator_decides(self):
        cut = windows(motion(), TINY, "train")
        every = {w.numpy().tobytes() for w in cut.all(stride=1)["x"]}
        torch.manual_seed(0)
        first = cut.sample(3000, torch.Generator().manual_seed(5))["x"]
        torch.manual_seed(1)
        again = cut.sample(3000, torch.Generator().manual_seed(5))["x"]
        assert torch.equal(first, again)
        assert first.dtype == torch.float32
        assert {w.numpy().tobytes() for w in first} == every

    @pytest.mark.parametrize("sampling", ["clip", "length", "subject"])
    def test_windows_are_drawn_in_the_stated_proportions(self, sampling):
        clips = [*people((57, 7), "S1"), *people((27,), "S2", 1)]
        starts = np.array([51, 1, 21])
        share = {"clip": [1 / 3] * 3, "length": starts / 73, "subject": [1 / 4, 1 / 4, 1 / 2]}[sampling]
        protocol = replace(TINY, train=("S1", "S2"), sampling=sampling, validation=0.0)
        cut = windows(MotionSet(clips, WALKER), protocol, "train")
        index = {w.numpy().tobytes(): key[:2] for w, key in zip(cut.all(1)["x"], cut.index(1), strict=True)}
        drawn = [index[w.numpy().tobytes()] for w in cut.sample(8000, torch.Generator().manual_seed(0))["x"]]
        counts = np.array([drawn.count(clip.key) for clip in clips])
        error = np.sqrt(np.array(share) * (1 - np.array(share)) / 8000)
        assert (np.abs(counts / 8000 - share) < 4 * error).all()

    @pytest.mark.parametrize("up", ["y", "z"])
    @pytest.mark.parametrize("root", ["drop", "relative"])
    def test_heading_turns_windows_as_a_whole(self, up, root):
        turned = MotionSet(motion().clips, replace(WALKER, up=up))
        plain, faced = (windows(turned, replace(TINY, root=root, heading=h), "test") for h in (False, True))
        before, after = (cut.positions(cut.all()["x"].double()) for cut in (plain, faced))
        heading = turned.skeleton.heading
        torch.testing.assert_close(heading(after[:, 2]).abs(), torch.zeros(len(after)).double(), atol=1e-5, rtol=0)
        angle = -heading(before[:, 2])[:, None, None]
        torch.testing.assert_close(rotate_about_up(before, angle, up), after, atol=1e-6, rtol=0)

    def test_random_rotation_turns_drawn_windows_and_not_listed_ones(self):
        plain = windows(motion(), TINY, "train")
        turning = windows(motion(), replace(TINY, rotate=True), "train")
        assert torch.equal(plain.all()["x"], turning.all()["x"])
        straight, turned = (cut.sample(200, torch.Generator().manual_seed(2))["x"] for cut in (plain, turning))
        lengths = [WALKER.bone_lengths(plain.positions(x)) for x in (straight, turned)]
        torch.testing.assert_close(*lengths, atol=1e-5, rtol=1e-5)
        headings = [WALKER.heading(plain.positions(x)[:, 0].double()) for x in (straight, turned)]
        angles = headings[1] - headings[0]
        assert torch.hypot(torch.cos(angles).mean(), torch.sin(angles).mean()) < 4 / 200**0.5

    def test_validation_clips_are_training_clips_and_nothing_is_lost_or_shared(self):
        parts = {s: windows(motion(), TINY, s) for s in ("train", "validation", "test", "train+validation")}
        names = {s: {(*c.key,) for c in w.clips} | {k[:2] for k in w.skipped} for s, w in parts.items()}
        assert not names["train"] & names["validation"]
        assert names["train"] | names["validation"] == names["train+validation"]
        assert len(names["validation"]) == 2  # a quarter of seven clips
        assert names["test"] == {("test", "clip_0"), ("test", "clip_1")}
        longer = windows(motion(), TINY, "validation", 10)
        assert {c.key for c in longer.clips} | {k[:2] for k in longer.skipped} == names["validation"]

    def test_splitting_by_a_label_takes_clips_of_every_split(self):
        clips = [replace(c, labels={"style": "AB"[i % 2]}) for i, c in enumerate(motion().clips)]
        protocol = replace(TINY, split_by="style", train=("A",), test=("B",))
        labelled = MotionSet(clips, WALKER)
        test = windows(labelled, protocol, "test")
        assert {c.labels["style"] for c in test.clips} == {"B"}
        assert test.labels("style") == ["B"] * len(test)
        assert {c.split for c in test.clips} == {"train", "test"}
        with pytest.raises(ValueError, match="label 'style', which clip train/clip_0 lacks"):
            windows(motion(), protocol, "test")
        with pytest.raises(KeyError, match="no label 'mood'; there are style"):
            test.labels("mood")

    def test_fingerprints_tell_data_protocol_and_split_apart(self):
        cuts = [
            windows(motion(), TINY, "train"),
            windows(motion(), TINY, "test"),
            windows(motion(), TINY, "train", 6),
            windows(motion(), replace(TINY, train_stride=3), "train"),
            windows(motion(seed=3), TINY, "train"),
        ]
        assert len({cut.fingerprint for cut in cuts}) == len(cuts)
        assert windows(motion(), TINY, "train").fingerprint == cuts[0].fingerprint

    def test_what_cannot_be_cut_is_explained(self):
        with pytest.raises(ValueError, match=r"no window of 99 frames: \d clips, the longest of 30 frames"):
            windows(motion(), TINY, "train", 99)
        with pytest.raises(ValueError, match="counts frames at 50 a second, 'people' has 30"):
            windows(motion(), PROTOCOLS["h36m"], "train")
        with pytest.raises(ValueError, match=r"did you mean 'test'\?\): expected train, validation, test"):
            windows(motion(), TINY, "tests")
        with pytest.raises(ValueError, match=r"unknown protocol 'h36' \(did you mean 'h36m'"):
            windows(motion(), "h36", "train")
        with pytest.raises(ValueError, match="wants split S1 for training and S2 for test; 'people' has train, test"):
            windows(motion(), replace(TINY, train=("S1",), test=("S2",)), "train")
        with pytest.raises(ValueError, match="stride is -1"):
            windows(motion(), TINY, "test").all(-1)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"observed": 0}, "observed is 0"),
            ({"test_stride": 0}, "test_stride is 0"),
            ({"root": "keep"}, "unknown root 'keep'; known: drop, relative"),
            ({"sampling": "uniform"}, "unknown sampling 'uniform'; known: clip, length, subject"),
            ({"validation": 1.0}, "validation is 1.0"),
            ({"heading": True, "rotate": True}, "choose one"),
        ],
    )
    def test_impossible_protocols_are_refused(self, change, message):
        with pytest.raises(ValueError, match=message):
            replace(TINY, **change)

    def test_presets_are_those_of_the_papers(self):
        found = {name: (p.observed, p.predicted, p.fps) for name, p in PROTOCOLS.items()}
        assert found["h36m"] == (25, 100, 50)
        assert found["humaneva"] == (15, 60, 60)
        assert found["trajevae"] == (1, 100, 50)
        assert found["bandai2-by-style"] == found["cmu8"] == found["simulated"] == (15, 60, 30)


@pytest.fixture
def bandai(real):
    return real("bandai/bandai2.npz")


@pytest.fixture
def cmu(real):
    return real("cmu/cmu8.npz")


class TestRealData:
    pytestmark = pytest.mark.data

    def test_counts_are_those_of_the_readme(self, bandai, cmu):
        rows = [(r["split"], r["clips"], r["frames"], r["minutes"]) for m in (cmu, bandai) for r in m.summary()]
        assert rows == [
            ("train", 72, 13_451, 7.5),
            ("test", 24, 3_528, 2.0),
            ("train", 1_172, 154_491, 85.8),
            ("test", 299, 40_544, 22.5),
        ]
        assert cmu["train", "walking_1"].frames != cmu["test", "walking_1"].frames
        assert cmu["test", "walking_1"].labels["source_file"].startswith("test/")

    def test_bones_are_as_long_as_the_skeleton_says(self, bandai, cmu):
        for data in (bandai, cmu):
            lengths = data.skeleton.bone_lengths(data.clips[0].positions.astype(np.float64)).mean(0)
            np.testing.assert_allclose(lengths, data.skeleton.lengths, atol=1e-3)

    @pytest.mark.parametrize(
        ("name", "zero_velocity", "neighbours"),
        [
            ("bandai2-by-style", (0.493, 0.641), (0.285, 0.260)),
            ("bandai2-by-take", (0.441, 0.518), (0.126, 0.110)),
            ("cmu8", (0.755, 0.906), (0.503, 0.457)),
        ],
    )
    def test_windows_give_the_reference_figures_of_the_readme(self, request, name, zero_velocity, neighbours):
        data = request.getfixturevalue(name.partition("-")[0].rstrip("28"))
        protocol = PROTOCOLS[name]
        test = windows(data, protocol, "test").all()["x"]
        train = windows(data, protocol, "train+validation").all()["x"]
        past, future = test[:, :15], test[:, 15:]
        still = torch.linalg.vector_norm(future - past[:, -1:], dim=-1)
        assert [round(e.mean().item(), 3) for e in (still, still[:, -1])] == list(zero_velocity)

        step = max(1, len(test) // 150)  # part of the windows: the full figure takes seconds
        nearest = torch.cdist(past[::step, -1], train[:, 14]).topk(50, largest=False).indices
        errors = torch.stack(
            [torch.linalg.vector_norm(train[i, 15:] - y, dim=-1) for i, y in zip(nearest, future[::step], strict=True)]
        )
        best = torch.stack([errors.mean(-1).amin(1), errors[..., -1].amin(1)])
        spread = best.std(1) / best.shape[1] ** 0.5
        assert ((best.mean(1) - torch.tensor(neighbours)).abs() < 3 * spread).all()


def test_what_a_set_says_of_itself_is_short():
    """In a notebook or a traceback, and without the numbers."""
    people = simulate(clips=2, frames=40)
    assert (
        repr(people)
        == f"MotionSet({people.name}: 2 clips, 80 frames of {people.skeleton.joints} joints at 30 a second)"
    )
    clip = people.with_rotations().clips[0]
    assert repr(clip) == f"Clip({clip.split}/{clip.name}: 40 frames of {people.skeleton.joints} joints, with rotations)"
