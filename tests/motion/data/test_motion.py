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

import dvae
from dvae.motion import (
    HUMAN36M,
    HUMAN36M_KEPT,
    HUMANEVA,
    PROTOCOLS,
    WALKER,
    Clip,
    MotionSet,
    Protocol,
    Skeleton,
    read_motion,
    rotate_about_up,
    save,
    simulate,
    windows,
)

TINY = Protocol("tiny", observed=3, predicted=4, fps=30, train_stride=2, test_stride=3, validation=0.25)


def people(frames=(20, 12, 30, 9, 25, 7, 6), split="train", seed=0):
    """Return clips of the given lengths whose positions encode (clip, frame, joint, axis)."""
    random = np.random.default_rng(seed)
    shapes = [(F, WALKER.joints, 3) for F in frames]
    return [Clip(split, f"clip_{i}", random.uniform(-0.8, 0.8, s)) for i, s in enumerate(shapes)]


def motion(**kwargs):
    return MotionSet([*people(**kwargs), *people((15, 8), "test", 1)], WALKER, "people")


def archive(path, content, name="positions_3d"):
    """Write an npz whose member is a pickle, by hand in numpy's format (protocol 3)."""
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

    def test_human36m_has_the_skeleton_of_the_papers(self):
        assert (HUMAN36M.joints, HUMANEVA.joints, len(HUMAN36M_KEPT)) == (17, 15, 17)
        dropped = {4, 5, 9, 10, 11, 16, 20, 21, 22, 23, 24, 28, 29, 30, 31}
        assert set(HUMAN36M_KEPT) == set(range(32)) - dropped

    @pytest.mark.parametrize(
        ("fields", "message"),
        [
            ({"names": ("a", "a"), "parents": (-1, 0)}, "names repeat: a"),
            ({"names": ("a", "b"), "parents": (-1,)}, "2 names but 1 parents"),
            ({"names": ("a", "b"), "parents": (-1, -1)}, "one root .* found a, b"),
            ({"names": ("a", "b", "c"), "parents": (-1, 2, 1)}, "cycle"),
            ({"names": ("a", "b"), "parents": (-1, 7)}, "parent of b is joint 7"),
            ({"names": ("a", "b"), "parents": (-1, 0), "left": (5,)}, r"left names joints \[5\]"),
            ({"names": ("a",), "parents": (-1,), "up": "x"}, "up axis is 'x'"),
            ({"names": ("a",), "parents": (-1,), "fps": 0}, "0 frames per second"),
        ],
    )
    def test_an_invalid_skeleton_is_an_error(self, fields, message):
        with pytest.raises(ValueError, match=message):
            Skeleton(**fields)

    def test_an_invalid_skeleton_file_is_an_error(self, tmp_path):
        (tmp_path / "s.json").write_text('{"joints": 3}')
        with pytest.raises(ValueError, match="expected JSON with joint_names and parents"):
            Skeleton.from_json(tmp_path / "s.json")


def damaged(change):
    positions = people((10,))[0].positions.astype(np.float32)
    return Clip("train", "walk", change(positions.copy()))


def with_nan(positions):
    positions[4, 2, 1] = np.nan
    return positions


BAD = [
    (with_nan, "train/walk has NaN .* 1 joint positions in 1 of 10 frames, first RKnee at frame 4"),
    (lambda p: p[:, :12], "train/walk has 12 joints, but the skeleton 'walker' has 17"),
    (lambda p: p[..., :2], r"train/walk has shape \(10, 17, 2\), expected \(frames, joints, 3\)"),
    (lambda p: p[:0], "train/walk has no frames"),
    (lambda p: p * 1000, r"train/walk shows a person of 1\d{3} m .* millimetres"),
    (lambda p: p * 0.01, "train/walk shows a person of 0.01.* another unit"),
    (lambda p: p.astype(object), "train/walk has dtype object"),
]


class TestMotionSet:
    @pytest.mark.parametrize(("change", "message"), BAD)
    def test_an_invalid_clip_is_an_error_with_its_name(self, change, message):
        with pytest.raises(ValueError, match=message):
            MotionSet([damaged(change)], WALKER)

    def test_invalid_clips_can_be_skipped_and_are_counted(self):
        clips = [*people(), *(replace(damaged(c), name=f"bad_{i}") for i, (c, _) in enumerate(BAD))]
        valid = MotionSet(clips, WALKER, skip_bad=True)
        assert len(valid) == len(people())
        assert [name for _, name, _ in valid.skipped] == [f"bad_{i}" for i in range(len(BAD))]
        assert valid.summary()[0]["skipped"] == len(BAD)
        with pytest.raises(ValueError, match="no clips; 1 were skipped, the first: clip train/walk has NaN"):
            MotionSet([damaged(with_nan)], WALKER, skip_bad=True)

    def test_names_may_repeat_between_splits_but_not_within_one(self):
        here, there = people((9,)), people((9,), "test", 1)
        both = MotionSet([*here, *there], WALKER)
        np.testing.assert_array_equal(both["test", "clip_0"].positions, there[0].positions.astype(np.float32))
        with pytest.raises(ValueError, match="train/clip_0 occurs twice"):
            MotionSet([*here, *here], WALKER)
        with pytest.raises(KeyError, match="keys are"):
            both["clip_0"]

    def test_a_set_does_not_share_memory_with_its_source(self):
        clips = people()
        motion_set = MotionSet(clips, WALKER)
        before = motion_set.fingerprint()
        clips[0].positions[:] = 0
        assert motion_set.fingerprint() == before

    def test_every_part_of_the_content_changes_the_fingerprint(self):
        original = motion()
        first, *rest = original.clips
        positions = first.positions.copy()
        positions[3, 4, 1] += 1e-5
        others = [
            MotionSet([replace(first, positions=positions), *rest], WALKER),
            MotionSet([replace(first, name="other"), *rest], WALKER),
            MotionSet([replace(first, split="test2"), *rest], WALKER),
            MotionSet(rest, WALKER),
            MotionSet(original.clips, HUMAN36M),
        ]
        prints = [m.fingerprint() for m in (original, *others)]
        assert len(set(prints)) == len(prints)
        assert motion().fingerprint() == original.fingerprint()


class Evil:
    def __reduce__(self):
        return os.system, ("touch pwned",)


class TestArchive:
    def nested(self):
        clips = motion()
        return {s: {c.name: c.positions for c in clips if c.split == s} for s in clips.splits}

    @pytest.mark.parametrize(
        ("hostile", "function"),
        [
            (Evil(), r"refused (posix|nt)\.system"),
            (np.array(["2020"], dtype="datetime64[D]"), r"refused an array of datetime64"),
            ([1.0], "clip test/walk is a list, expected a numpy array"),
        ],
        ids=["system", "dtype", "list"],
    )
    def test_hostile_pickles_are_errors_and_never_run(self, tmp_path, monkeypatch, hostile, function):
        monkeypatch.chdir(tmp_path)
        path = archive(tmp_path / "a.npz", pickle.dumps({**self.nested(), "test": {"walk": hostile}}, 2))
        with pytest.raises(ValueError, match=rf"a\.npz: (positions_3d: )?{function}"):
            read_motion(path, skeleton=WALKER)
        assert not (tmp_path / "pwned").exists()

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (pickle.dumps([1, 2]), "not a dictionary of dictionaries"),
            (pickle.dumps({"train": {}}), "no clips"),
            (pickle.dumps({"a": 1})[:-3], "damaged pickle"),
            (b"\x80\x04\x8e" + (2**60).to_bytes(8, "little"), "damaged pickle"),
        ],
    )
    def test_other_contents_are_errors(self, tmp_path, content, message):
        with pytest.raises(ValueError, match=message):
            read_motion(archive(tmp_path / "a.npz", content), skeleton=WALKER)

    def test_a_pickle_outside_positions_3d_is_an_error_before_reading(self, tmp_path):
        path = archive(tmp_path / "a.npz", pickle.dumps(Evil()), name="train/walk")
        with pytest.raises(ValueError, match="train/walk: contains pickled objects"):
            read_motion(path, skeleton=WALKER)


class TestPlain:
    @pytest.mark.parametrize("original", [lambda: simulate(5, 20), motion], ids=["labelled", "bare"])
    def test_save_and_load_round_trip(self, tmp_path, original):
        save(tmp_path / "new" / "set.npz", original())
        loaded = read_motion(tmp_path / "new" / "set.npz")
        assert loaded.fingerprint() == original().fingerprint()
        assert loaded.skeleton == original().skeleton
        for old, new in zip(original(), loaded, strict=True):
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

    @pytest.mark.parametrize("name", ["a.npz", "a.npz.labels.csv"])
    def test_a_full_disk_keeps_the_old_file_and_is_an_error_with_its_name(self, name, tmp_path, monkeypatch):
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

    def test_a_highly_compressible_file_is_read(self, tmp_path):
        frames = 80 * 10**6 // (WALKER.joints * 3 * 4)  # packs to less than a hundredth
        rest = np.repeat(people()[0].positions[:1].astype(np.float32), frames, 0)
        save(tmp_path / "a.npz", MotionSet([Clip("train", "rest", rest)], WALKER))
        assert read_motion(tmp_path / "a.npz").clips[0].positions.shape == rest.shape

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

    def test_labels_are_found_by_split_and_clip(self, tmp_path):
        save(tmp_path / "a.npz", motion())
        with (tmp_path / "mine.csv").open("w", newline="") as file:
            rows = [("clip", "split", "mood"), ("clip_0", "test", "glad"), ("clip_0", "train", "sad")]
            csv.writer(file).writerows(rows)
        loaded = read_motion(tmp_path / "a.npz", labels=tmp_path / "mine.csv")
        assert loaded["train", "clip_0"].labels["mood"] == "sad"
        assert loaded["test", "clip_0"].labels["mood"] == "glad"
        assert loaded["test", "clip_1"].labels == {}
        for text, message in (
            ("clip,split\nother,train\n", r"no row has the split and clip of a clip of .*a.npz"),
            ("name\n", "named clip"),
        ):
            (tmp_path / "mine.csv").write_text(text)
            with pytest.raises(ValueError, match=message):
                read_motion(tmp_path / "a.npz", labels=tmp_path / "mine.csv")


class TestWindows:
    def expected(self, protocol, key, length=None):
        """Return one window by the definition."""
        split, name, start = key
        window = motion()[split, name].positions[start : start + (length or protocol.length)]
        if protocol.root == "drop":
            return (window - window[:, :1])[:, 1:].reshape(len(window), -1)
        return (window - window[:1, :1]).reshape(len(window), -1)

    @pytest.mark.parametrize(("root", "length"), [("drop", None), ("relative", 5), ("drop", 12)])
    def test_listed_windows_equal_the_definition(self, root, length):
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

    def test_positions_restore_the_root(self):
        for root in ("drop", "relative"):
            cut = windows(motion(), replace(TINY, root=root), "test")
            positions = cut.positions(cut.all()["x"])
            assert positions.shape == (len(cut), 7, 17, 3)
            assert (positions[:, 0, 0] == 0).all()
            truth = np.stack([WALKER.bone_lengths(motion()[s, n].positions[t : t + 7]) for s, n, t in cut.keys])
            np.testing.assert_allclose(WALKER.bone_lengths(positions).numpy(), truth, atol=1e-6)
        with pytest.raises(ValueError, match="frames have 50 numbers, expected 51"):
            cut.positions(torch.zeros(3, 50))

    def test_the_root_need_not_be_the_first_joint(self):
        skeleton = Skeleton(("a", "root", "b"), (1, -1, 1), (0,), (2,))
        positions = np.random.default_rng(0).uniform(-0.8, 0.8, (9, 3, 3)).astype(np.float32)
        cut = windows(MotionSet([Clip("test", "c", positions)], skeleton), TINY, "test")
        restored = cut.positions(cut.all()["x"])[0].numpy()
        np.testing.assert_array_equal(restored, positions[:7] - positions[:7, 1:2])

    def test_sampled_windows_are_windows_and_depend_on_the_generator_only(self):
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
        indices = [index[w.numpy().tobytes()] for w in cut.sample(8000, torch.Generator().manual_seed(0))["x"]]
        counts = np.array([indices.count(clip.key) for clip in clips])
        error = np.sqrt(np.array(share) * (1 - np.array(share)) / 8000)
        assert (np.abs(counts / 8000 - share) < 4 * error).all()

    @pytest.mark.parametrize(("up", "root"), [("y", "drop"), ("z", "relative")])
    def test_heading_rotates_whole_windows(self, up, root):
        rotated_up = MotionSet(motion().clips, replace(WALKER, up=up))
        plain, faced = (windows(rotated_up, replace(TINY, root=root, heading=h), "test") for h in (False, True))
        before, after = (cut.positions(cut.all()["x"].double()) for cut in (plain, faced))
        heading = rotated_up.skeleton.heading
        torch.testing.assert_close(heading(after[:, 2]).abs(), torch.zeros(len(after)).double(), atol=1e-5, rtol=0)
        angle = -heading(before[:, 2])[:, None, None]
        torch.testing.assert_close(rotate_about_up(before, angle, up), after, atol=1e-6, rtol=0)

    def test_random_rotation_applies_to_sampled_windows_only(self):
        plain = windows(motion(), TINY, "train")
        turning = windows(motion(), replace(TINY, rotate=True), "train")
        assert torch.equal(plain.all()["x"], turning.all()["x"])
        straight, rotated = (cut.sample(200, torch.Generator().manual_seed(2))["x"] for cut in (plain, turning))
        lengths = [WALKER.bone_lengths(plain.positions(x)) for x in (straight, rotated)]
        torch.testing.assert_close(*lengths, atol=1e-5, rtol=1e-5)
        headings = [WALKER.heading(plain.positions(x)[:, 0].double()) for x in (straight, rotated)]
        angles = headings[1] - headings[0]
        assert torch.hypot(torch.cos(angles).mean(), torch.sin(angles).mean()) < 4 / 200**0.5

    def test_validation_and_training_partition_the_training_clips(self):
        parts = {s: windows(motion(), TINY, s) for s in ("train", "validation", "test", "train+validation")}
        names = {s: {(*c.key,) for c in w.clips} | {k[:2] for k in w.skipped} for s, w in parts.items()}
        assert not names["train"] & names["validation"]
        assert names["train"] | names["validation"] == names["train+validation"]
        assert len(names["validation"]) == 2  # a quarter of seven clips
        assert names["test"] == {("test", "clip_0"), ("test", "clip_1")}
        longer = windows(motion(), TINY, "validation", 10)
        assert {c.key for c in longer.clips} | {k[:2] for k in longer.skipped} == names["validation"]

    def test_splitting_by_a_label_uses_clips_of_every_split(self):
        clips = [replace(c, labels={"style": "AB"[i % 2]}) for i, c in enumerate(motion().clips)]
        protocol = replace(TINY, split_by="style", train=("A",), test=("B",))
        labelled = MotionSet(clips, WALKER)
        test = windows(labelled, protocol, "test")
        assert {c.labels["style"] for c in test.clips} == {"B"}
        assert test.labels("style") == ["B"] * len(test)
        assert {c.split for c in test.clips} == {"train", "test"}
        with pytest.raises(ValueError, match="label 'style', but clip train/clip_0 does not have it"):
            windows(motion(), protocol, "test")
        with pytest.raises(KeyError, match="no clip has the label 'mood'; the labels are style"):
            test.labels("mood")

    def test_clips_in_other_splits_are_left_out_with_a_warning(self):
        clips = [replace(clip, split="walks/train") if n < 2 else clip for n, clip in enumerate(motion())]
        message = rf"2 of {len(clips)} clips of .* are not used: .* uses the splits train, test, not walks/train$"
        with pytest.warns(UserWarning, match=message):
            windows(MotionSet(clips, WALKER), TINY, "test")

    def test_windows_that_cannot_be_cut_are_errors(self):
        others = replace(TINY, train=("S1",), test=("S2",))
        for protocol, split, length, message in (
            (TINY, "train", 99, r"no window of 99 frames: \d clips, the longest of 30 frames"),
            (PROTOCOLS["h36m"], "train", None, "needs 50 frames per second, but 'people' has 30"),
            (TINY, "tests", None, r"did you mean 'test'\?\): expected train, validation, test"),
            ("h36", "train", None, r"unknown protocol 'h36' \(did you mean 'h36m'"),
            (others, "train", None, "needs split S1 for training and S2 for test; 'people' has train, test"),
        ):
            with pytest.raises(ValueError, match=message):
                windows(motion(), protocol, split, length)
        for change, message in (
            ({"observed": 0}, "observed is 0"),
            ({"heading": True, "rotate": True}, "set only one"),
            ({"sampling": "uniform"}, "unknown sampling 'uniform'; known: clip, length, subject"),
        ):
            with pytest.raises(ValueError, match=message):
                replace(TINY, **change)
        with pytest.raises(ValueError, match="stride is -1"):
            windows(motion(), TINY, "test").all(-1)

    def test_windows_may_start_at_chosen_frames(self):
        all_windows = windows(motion(), TINY, "train")
        keys = [("train", "clip_4", 7), ("train", "clip_0", 2), ("train", "clip_4", 7)]
        chosen = all_windows.at(keys)
        assert chosen.keys == keys
        assert len(chosen) == 3
        every = dict(zip(all_windows.index(1), all_windows.all(1)["x"], strict=True))
        torch.testing.assert_close(chosen.all()["x"], torch.stack([every[key] for key in keys]), rtol=0, atol=0)
        assert chosen.fingerprint != all_windows.fingerprint
        for wrong, message in (
            ([], "is empty"),
            ([("train", "clip_9", 0)], "no clip train/clip_9"),
            ([("train", "clip_0", 14)], "starts at frame 14, expected 0 to 13"),
        ):
            with pytest.raises(ValueError, match=message):
                all_windows.at(wrong)

    def test_preset_protocols_match_the_papers(self):
        values = {name: (p.observed, p.predicted, p.fps) for name, p in PROTOCOLS.items()}
        assert values["h36m"] == (25, 100, 50)
        assert values["h36m-angles"] == (16, 60, 25)
        assert values["humaneva"] == (15, 60, 60)
        assert values["trajevae"] == (1, 100, 50)
        assert values["bandai2-by-style"] == values["cmu8"] == values["simulated"] == (15, 60, 30)


def test_parts_of_data_with_another_frame_rate_are_an_error():
    data = dvae.motion.MotionData("people", simulate(clips=4, frames=20), PROTOCOLS["h36m"])
    with pytest.raises(ValueError, match=r"needs 50 frames per second, .*`dvae data convert FILE --fps 50"):
        data.parts()
