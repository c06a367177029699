"""C3D files as ezc3d writes them, and the tree of markers."""

import struct

import numpy as np
import pytest
from c3d import write_c3d

from dvae.motion import read_motion
from dvae.motion.files.markers import read_c3d, tree


def test_unseen_markers_are_missing_values(tmp_path):
    names, places = ["HEAD", "HIP", "LFT", "RFT"], standing(7)[..., :3]
    unseen = np.zeros((7, 4), bool)
    unseen[2:5, 0], unseen[6, 3] = True, True
    write_c3d(tmp_path / "a.c3d", names, np.concatenate([places, -unseen[..., None].astype(float)], 2))
    with pytest.raises(ValueError, match=r"has NaN.*missing=True \(--missing\) keeps the clip"):
        read_motion(tmp_path / "a.c3d")
    motion_set = read_motion(tmp_path / "a.c3d", missing=True)
    order = [names.index(name) for name in motion_set.skeleton.names]
    expected = np.where(unseen[..., None], np.nan, places / 1000)[:, order]
    np.testing.assert_allclose(motion_set.clips[0].positions, expected, atol=1e-6)


def standing(frames, *more):
    """Return four markers of a standing person, and points (x, y, z) relative to them: (F, M, 4) in mm."""
    rest = np.array([[0, 0, 1700.0], [0, 0, 900], [100, 0, 10], [-100, 0, 10], *more])
    places = rest + np.random.default_rng(0).normal(0, 5, (frames, len(rest), 3))
    return np.concatenate([places, np.ones((frames, len(rest), 1))], 2)


def test_points_computed_by_a_body_model_are_no_joints(tmp_path):
    names = ["HEAD", "HIP", "LFT", "RFT"]
    lists = {"ANGLES": ["LKneeAngle"], "ANGLES2": ["RKneeAngle"], "POWERS": ["LKneePower"], "EXTRA": ["Spare"]}
    outputs = [name for texts in lists.values() for name in texts]
    places = standing(7, *[(30, 5, 0)] * len(outputs))
    write_c3d(tmp_path / "a.c3d", names + outputs, places, **lists, TYPE_GROUPS=["ANGLES", "EXTRA", "EXTRA_UNITS"])
    motion_set = read_motion(tmp_path / "a.c3d")
    assert sorted(motion_set.skeleton.names) == names
    assert (
        "4 points computed by a model of the body are left out (LKneeAngle, RKneeAngle, LKneePower, Spare)"
        in motion_set.interpretation
    )


def test_omitted_and_renamed_points_are_reported(tmp_path):
    names = ["HEAD", "HIP", "LFT", "LFT", "LFT_2", "GONE", "*8"]
    places = standing(7, (0, 50, 1000), (0, 0, 0), (50, 50, 1000), (0, 90, 900))
    places[:, 5] = 0
    places[2:5, 0] = 0
    places[3, 1, :3] = 0  # its residual marks it as measured
    write_c3d(tmp_path / "a.c3d", names, places)
    recording = read_c3d(tmp_path / "a.c3d")
    assert sorted(recording.names) == ["HEAD", "HIP", "LFT", "LFT_2", "LFT_3"]
    np.testing.assert_allclose(recording.positions[:, recording.names.index("LFT_3")], places[:, 3, :3], rtol=1e-6)
    assert recording.notes == [
        "1 points never observed are left out (GONE)",
        "2 points without a name are left out (point 7, point 8)",
        "3 positions that are exactly 0, 0, 0 with residual 0 are read as missing",
        "another marker LFT is read as LFT_3",
    ]
    assert np.isnan(recording.positions).any(2).sum(0)[recording.names.index("HEAD")] == 3
    assert np.isfinite(recording.positions[:, recording.names.index("HIP")]).all()


def test_parents_of_markers_move_rigidly_with_them():
    random = np.random.default_rng(0)
    bodies = [random.normal(0, 0.3, (1, 4, 3)) for _ in range(2)]  # two rigid bodies that move independently
    places = np.concatenate([body + random.normal(0, 1, (50, 1, 3)).cumsum(0) for body in bodies], 1)
    places[3:9, 2] = np.nan
    order, parents = tree(places)
    assert sorted(order) == list(range(8))
    assert parents[0] == -1
    assert all(parent < place for place, parent in enumerate(parents))
    crossing = [(order[parent] < 4) != (joint < 4) for joint, parent in zip(order, parents, strict=True) if parent >= 0]
    assert sum(crossing) == 1


@pytest.mark.parametrize("frames", [65_535, 66_000])
def test_zeros_that_fill_the_last_block_are_no_frames(tmp_path, frames):
    """A header with 65,535 as its last frame may have more; this size of a frame leaves half a block."""
    write_c3d(tmp_path / "a.c3d", ["HEAD", "HIP"], standing(15)[:, :2])
    content = bytearray((tmp_path / "a.c3d").read_bytes())
    content[8:10] = b"\xff\xff"
    first = 512 * (struct.unpack_from("<H", content, 16)[0] - 1)
    data = np.tile(standing(15)[:, :2], (frames // 15 + 1, 1, 1))[:frames].astype("<f4").tobytes()
    (tmp_path / "a.c3d").write_bytes(content[:first] + data + bytes(-len(data) % 512))
    assert read_c3d(tmp_path / "a.c3d").positions.shape == (frames, 2, 3)
