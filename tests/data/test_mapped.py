"""Memory-mapped arrays: the same results as in memory, little memory, and no trust in headers."""

import errno
import hashlib
import os
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import dvae
from benchmarks.speed import TensorMemory
from dvae import motion
from dvae.cli import main
from dvae.cli.tables import is_table
from dvae.data import npy
from dvae.data.blocks import ColumnSummary, hash_list, hash_values, row_blocks
from dvae.data.npy import is_mapped, mapped
from dvae.data.sequences import Sequences, sequences
from dvae.tables import Column, Columns, Cut, Panel, PanelData, Series

CUT = Cut(6, 4, split="time")
GENERATIVE, INFERENCE = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)"


def walks(shape=(300, 3), dtype=np.float32, missing=0.0, seed=0):
    rng = np.random.default_rng(seed)
    values = (20 * rng.normal(size=shape)).astype(dtype)
    if missing:
        values[rng.random(shape) < missing] = np.nan
    return values


def saved(path, values):
    np.save(path, values)
    return path


def assert_same(actual, expected):
    actual, expected = actual.leaves(), expected.leaves()
    assert actual.keys() == expected.keys()
    for name, value in actual.items():
        assert value.dtype == expected[name].dtype
        assert torch.equal(value, expected[name]), name


def assert_windows_are_the_same(actual, expected):
    """Check keys, fingerprints, and sampled, listed and batched windows, bit for bit."""
    assert actual.keys == expected.keys
    assert actual.fingerprint == expected.fingerprint
    assert_same(actual.all(), expected.all())
    for size in (1, 7):
        assert_same(*(each.sample(size, torch.Generator().manual_seed(size)) for each in (actual, expected)))
    for one, other in zip(actual.batches(4), Sequences(expected.all()).batches(4), strict=True):
        assert_same(one, other)


# Values -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<i2"])
def test_windows_of_a_mapped_table_equal_those_in_memory(tmp_path, dtype):
    values = walks(dtype=dtype)
    mapped_data, data = PanelData.open(saved(tmp_path / "walks.npy", values), cut=CUT), PanelData.of(values, cut=CUT)
    (one,) = mapped_data.panel
    assert is_mapped(one.values)
    assert one.values.dtype == values.dtype
    data = replace(data, panel=replace(data.panel, series=[replace(data.panel.series[0], name="walks")]))
    assert mapped_data.fingerprint == data.fingerprint
    assert mapped_data.schema == data.schema
    for split in ("train", "validation", "test"):
        assert_windows_are_the_same(mapped_data.windows(split), data.windows(split))


@pytest.mark.parametrize("families", [("real",) * 3, ("correlated",) * 3, ("category", "positive", "real")], ids=str)
def test_missing_values_of_a_mapped_table_equal_those_in_memory(tmp_path, families):
    values = walks((4, 80, 3), missing=0.1)
    values[0, 70:] = np.nan
    values[..., 0] = np.where(families[0] == "category", np.abs(values[..., 0]) % 4 // 1, values[..., 0])
    values[..., 1] = np.abs(values[..., 1]) if families[1] == "positive" else values[..., 1]
    classes = {"category": ("a", "b", "c", "d")}
    columns = Columns(tuple(Column(name, "target", f, "", classes.get(f, ())) for name, f in zip("xyz", families)))
    mapped_data = PanelData.of(np.load(saved(tmp_path / "walks.npy", values), mmap_mode="r"), columns, CUT)
    data = PanelData.of(values, columns, CUT)
    assert all(is_mapped(one.values) for one in mapped_data.panel)
    assert mapped_data.schema == data.schema
    assert [mapped_data.panel.present(one) for one in mapped_data.panel] == [
        data.panel.present(one) for one in data.panel
    ]
    assert mapped_data.panel.missing
    for split in ("train", "test"):
        assert "mask" in mapped_data.windows(split).all()
        assert_windows_are_the_same(mapped_data.windows(split), data.windows(split))
    assert_same(mapped_data.whole().all(), data.whole().all())


@pytest.mark.parametrize("kind", ["heading", "missing", "given", "turns"])
def test_windows_of_mapped_motion_equal_those_in_memory(tmp_path, monkeypatch, kind):
    people = motion.simulate(clips=6, frames=85, seed=1)
    people = motion.occlude(people, share=0.2, length=15) if kind == "missing" else people
    people = people.with_rotations() if kind == "turns" else people
    protocol = replace(motion.PROTOCOLS["simulated"], heading=kind == "heading", rotate=kind == "turns")
    protocol = replace(protocol, representation="6d" if kind == "turns" else "positions")
    monkeypatch.setattr("dvae.motion.files.archive.MAPPED", 10_000)
    motion.save(tmp_path / "people.npz", people)
    mapped_people = motion.read_motion(tmp_path / "people.npz", missing=people.missing)
    assert all(is_mapped(clip.positions) and not clip.positions.flags.writeable for clip in mapped_people)
    assert all(clip.rotations is None or is_mapped(clip.rotations) for clip in mapped_people)
    assert mapped_people.fingerprint() == people.fingerprint()
    assert mapped_people.info()
    for split in ("train", "validation", "test"):
        mapped_windows, windows = (motion.windows(each, protocol, split) for each in (mapped_people, people))
        if kind == "given":
            mapped_windows, windows = mapped_windows.given(0.5), windows.given(0.5)
        assert_windows_are_the_same(mapped_windows, windows)
        if kind == "missing":
            fingerprints = [
                each.fill_missing(each.positions(each.all()["x"])).fingerprint() for each in (mapped_windows, windows)
            ]
            assert fingerprints[0] == fingerprints[1]
    assert torch.equal(mapped_windows.poses(), windows.poses())
    assert all(is_mapped(clip.positions) for clip in mapped_people.assign_splits())


def test_mapped_arrays_are_valid_sequences(tmp_path):
    values = walks((9, 5, 2))
    x = np.load(saved(tmp_path / "x.npy", values), mmap_mode="r")
    from_mapped, from_memory = sequences(x), sequences(values)
    assert_same(*(each.sample(4, torch.Generator().manual_seed(0)) for each in (from_mapped, from_memory)))
    assert from_mapped.batch["x"].data_ptr() == x.ctypes.data
    assert dvae.ArrayWindows(x, 3).fingerprint == dvae.ArrayWindows(values, 3).fingerprint
    assert_same(dvae.ArrayWindows(x, 3).all(), dvae.ArrayWindows(values, 3).all())
    with pytest.raises(ValueError, match=r"x has shape \(300, 3\).*windows of a long one are dvae.tables.PanelData"):
        sequences(walks())


def test_values_that_are_not_finite_are_an_error_in_every_block(monkeypatch):
    monkeypatch.setattr("dvae.data.blocks.NUMBERS", 20)
    values = torch.from_numpy(walks((9, 5, 2)))
    values[4, 2, 1], values[7, 0, 0] = torch.nan, torch.inf
    with pytest.raises(ValueError, match=r"x is NaN or infinite in 2 entries, the first in sequence 4;"):
        Sequences({"x": values})
    with pytest.raises(ValueError, match=r"x is NaN or infinite in 1 entries, the first in sequence 7;"):
        Sequences({"x": values, "lengths": torch.tensor([2] * 9)})
    Sequences({"x": values, "mask": values.isfinite()})
    people = motion.simulate(clips=1, frames=30)
    people.clips[0].positions[7:9, 3] = np.nan
    with pytest.raises(ValueError, match=r"2 joint positions in 2 of 30 frames, first \w+ at frame 7;"):
        motion.MotionSet(people, people.skeleton)
    series = [Series("a", walks((12, 2))), Series("b", walks((10, 2)))]
    series[1].values[3, 1] = np.inf
    with pytest.raises(ValueError, match=r"sequence 'b' of panel has inf in row 3 of column 'x1'"):
        Panel(series, Columns((Column("x0"), Column("x1"))))


def test_validation_in_batches_equals_validation_at_once():
    panel = PanelData.of(walks((200, 2), missing=0.1), cut=CUT)
    train, validation = panel.windows("train"), panel.windows("validation")

    def bound(held_out):
        torch.manual_seed(0)
        model = dvae.DynamicalVAE(GENERATIVE, INFERENCE, {"z": 1, "x": 2}, dvae.networks.Dense((4,)))
        fit = dvae.fit(model, train, held_out, steps=2, batch_size=4, validate_every=1, progress=False)
        return fit.series("validation/bound")

    assert bound(validation) == bound(validation.all())


# Statistics and hashes in blocks ------------------------------------------------------------------------------------


@settings(max_examples=30)
@given(st.lists(st.integers(1, 40), min_size=1, max_size=6), st.integers(1, 60), st.booleans())
def test_statistics_in_blocks_equal_those_of_all_rows(lengths, numbers, has_gaps):
    arrays = [1e4 + walks((n, 3), np.float64, 0.3 * has_gaps, seed=n) for n in lengths]
    rows = np.concatenate(arrays)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dvae.data.blocks.NUMBERS", numbers)
        np.testing.assert_array_equal(np.concatenate(list(row_blocks(arrays))), rows)
        summary = ColumnSummary.of(row_blocks(arrays))
    np.testing.assert_array_equal(summary.count, (~np.isnan(rows)).sum(0))
    has_values = summary.count > 0
    if has_values.any():
        functions = {"mean": np.nanmean, "variance": np.nanvar, "least": np.nanmin, "largest": np.nanmax}
        for name, function in functions.items():
            scale = 1e4 if name == "mean" else 400
            np.testing.assert_allclose(
                getattr(summary, name)[has_values], function(rows[:, has_values], 0), rtol=1e-12, atol=1e-12 * scale
            )


@pytest.mark.parametrize("count", [0, 4096, 4097])
def test_hashes_in_blocks_equal_hashes_at_once(monkeypatch, count):
    items = [("train", f"clip {n}", n) for n in range(count)]
    digest = hashlib.sha256()
    hash_list(digest, iter(items))
    assert digest.digest() == hashlib.sha256(repr(items).encode()).digest()
    monkeypatch.setattr("dvae.data.blocks.NUMBERS", 1000)
    for values in (walks((count, 3)), walks((3, count)).T):
        digest = hashlib.sha256()
        hash_values(digest, values, "<f8")
        assert digest.digest() == hashlib.sha256(values.astype("<f8").tobytes()).digest()


# Memory -------------------------------------------------------------------------------------------------------------


def peak_memory(action, path):
    """Return the peak bytes of arrays and tensors during an action on a file."""
    tracemalloc.start()
    try:
        with TensorMemory() as tensors:
            action(path)
        return tracemalloc.get_traced_memory()[1] + tensors.peak
    finally:
        tracemalloc.stop()


def test_a_fit_takes_no_memory_for_mapped_frames(tmp_path):
    """In memory, a table takes twice the size of the file."""
    short, long = (saved(tmp_path / f"{frames}.npy", walks((frames, 64))) for frames in (2_000, 20_000))

    def fit(path):
        data = PanelData.open(path, cut=Cut(25, 100, split="time"))
        model = dvae.DynamicalVAE(GENERATIVE, INFERENCE, {"z": 1, "x": 64}, dvae.networks.Dense((4,)))
        model.standardise("x").fit(np.load(path, mmap_mode="r"))
        windows = data.windows("train"), data.windows("validation")
        dvae.fit(model, *windows, steps=1, batch_size=8, progress=False, out=path.with_suffix(""))

    fit(short)  # imports modules, which take memory too
    short.with_suffix("").rename(tmp_path / "first")
    peaks = [peak_memory(fit, path) for path in (short, long)]
    assert peaks[1] - peaks[0] < long.stat().st_size / 10
    assert peak_memory(lambda path: PanelData.of(np.load(path), cut=CUT), long) > 2 * long.stat().st_size


def test_windows_of_mapped_motion_take_no_memory(tmp_path, monkeypatch):
    (walk,) = motion.simulate(clips=1, frames=1000)
    monkeypatch.setattr("dvae.motion.files.archive.MAPPED", 10_000)

    def sample(path):
        data = motion.MotionData.open(path)
        windows = data.windows("train")
        windows.sample(32, torch.Generator())
        return windows.fingerprint, data.fingerprint

    peaks = {}
    for count in (2, 4, 40):
        clips = [replace(walk, name=f"walk {n}", split="train", truth={}) for n in range(count)]
        path = tmp_path / f"{count}.npz"
        motion.save(path, motion.MotionSet(clips, motion.WALKER, copy=False))
        peaks[count] = peak_memory(sample, path)
    assert peaks[40] - peaks[4] < path.stat().st_size / 10


# Damaged and hostile files ------------------------------------------------------------------------------------------


def npy_of(header, content=b"", version=1):
    length = 2 if version == 1 else 4
    return b"\x93NUMPY" + bytes([version, 0]) + len(header).to_bytes(length, "little") + header.encode() + content


def header_of(descr="'<f4'", order="False", shape="(2, 3)"):
    return f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not an npy file"),
        (b"PK\x03\x04 an archive", "not an npy file"),
        (npy_of(header_of(), b"\0" * 24, version=3), "not an npy file of version 1 or 2"),
        (npy_of(header_of(), b"\0" * 23), r"shape .2, 3. of float32, but holds 23 bytes instead of 24"),
        (npy_of(header_of(shape="(1000000000000, 48)"), b"\0" * 24), "holds 24 bytes"),
        (npy_of(header_of(shape="(99999999999999999999, 3)")), "damaged: its shape"),
        (npy_of(header_of(shape="(-2, 3)"), b"\0" * 24), "not a plain array"),
        (npy_of(header_of(shape="(0, 3)")), "so it contains no numbers"),
        (npy_of(header_of(shape=f"({'1, ' * 40})"), b"\0" * 4), "declares shape"),
        (npy_of(header_of(shape="(__import__('os').abort(), 3)")), "not a plain array"),
        (npy_of(header_of("'|O'"), b"\0" * 48), "holds object, expected real numbers"),
        (npy_of(header_of("'<U4'"), b"\0" * 96), "holds <U4, expected real numbers"),
        (npy_of(header_of("[('x', '<f4')]"), b"\0" * 24), "not a plain array"),
        (npy_of(header_of(order="True"), b"\0" * 24), "Fortran order"),
        (npy_of(header_of() + " " * 10_000, b"\0" * 24), "not a plain array"),
        (npy_of("{" * 4000), "not a plain array"),
    ],
)
def test_hostile_headers_are_an_error(tmp_path, content, message):
    path = tmp_path / "hostile.npy"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"hostile\.npy .*{message}"):
        mapped(path)
    with pytest.raises(ValueError, match="hostile"):
        PanelData.open(path)


@settings(max_examples=50)
@given(st.integers(0, 130), st.integers(0, 255), st.integers(0, 20))
def test_a_damaged_file_is_an_error_of_one_sentence_or_numbers(tmp_path_factory, index, byte, n_cut):
    path = tmp_path_factory.mktemp("damage") / "a.npy"
    content = bytearray(saved(path, walks((7, 3))).read_bytes())
    content[index] = byte
    path.write_bytes(content[: len(content) - n_cut])
    try:
        array = mapped(path)
    except ValueError as error:
        message = str(error)
    else:
        assert array.nbytes <= path.stat().st_size
        message = f"{path}: {array.tobytes()!r}"  # reads every byte
    assert message.startswith(str(path))


def test_links_are_followed_only_if_given_as_the_path(tmp_path):
    inside, outside = tmp_path / "walks", saved(tmp_path / "secret.npy", walks())
    inside.mkdir()
    (inside / "a.npy").symlink_to(outside)
    with pytest.raises(ValueError, match=r"a\.npy is a link, which could lead to any file"):
        PanelData.open(inside)
    assert len(PanelData.open(inside / "a.npy").panel.series[0]) == 300
    os.mkfifo(tmp_path / "pipe.npy")
    with pytest.raises(ValueError, match="must be a plain file, not a directory, a FIFO"):
        PanelData.open(tmp_path / "pipe.npy")


def test_a_mapped_file_is_read_only_and_survives_its_replacement(tmp_path):
    array = mapped(saved(tmp_path / "a.npy", walks()))
    with pytest.raises(ValueError, match="read-only"):
        array[0] = 1
    os.replace(saved(tmp_path / "b.npy", walks(seed=1)), tmp_path / "a.npy")
    np.testing.assert_array_equal(array, walks())


def test_too_many_open_files_are_an_error_that_says_so(tmp_path, monkeypatch):
    def none_left(*_):
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(npy.np, "memmap", none_left)
    with pytest.raises(
        OSError, match=r"the limit of open files is reached, .* \(ulimit -n\), or write fewer, longer files.*a\.npy"
    ):
        mapped(saved(tmp_path / "a.npy", walks()))


def stored(path, **arrays):
    np.savez(path, **arrays)
    motion.WALKER.to_json(path.with_name("skeleton.json"))
    return path


def test_only_a_mapped_archive_may_be_larger_than_memory(tmp_path, monkeypatch):
    positions = motion.simulate(clips=1, frames=30).clips[0].positions
    monkeypatch.setattr("dvae.motion.files.archive.MAPPED", 0)
    monkeypatch.setattr("dvae.motion.files.archive.LARGEST", 3 * positions.nbytes)
    monkeypatch.setattr("dvae.motion.files.arrays.LARGEST", 3 * positions.nbytes)
    single = stored(tmp_path / "a.npz", **{f"train/{n}": positions for n in range(5)})
    assert len(motion.read_motion(single)) == 5
    with pytest.raises(ValueError, match=r"it has more than [\d,]+ bytes of motion that cannot be memory-mapped"):
        motion.read_motion(single, metres=1.0)
    double = stored(tmp_path / "b.npz", **{f"train/{n}": positions.astype(np.float64) for n in range(5)})
    with pytest.raises(ValueError, match="it would unpack to"):
        motion.read_motion(double)
    np.savez_compressed(tmp_path / "c.npz", **{f"train/{n}": positions for n in range(5)})
    with pytest.raises(ValueError, match="it would unpack to"):
        motion.read_motion(tmp_path / "c.npz")


@pytest.mark.parametrize("damage", ["place", "signature", "end"])
def test_a_damaged_archive_is_not_mapped(tmp_path, monkeypatch, damage):
    """If a member is not at its declared offset, the ordinary reader raises the error."""
    path = stored(tmp_path / "a.npz", **{"train/walk": motion.simulate(clips=1, frames=30).clips[0].positions})
    monkeypatch.setattr("dvae.motion.files.archive.MAPPED", 0)
    content = bytearray(path.read_bytes())
    central = content.index(b"PK\x01\x02")
    if damage == "place":
        content[central + 42 : central + 46] = (2**31).to_bytes(4, "little")
    elif damage == "end":
        del content[1000:central]
    else:
        content[:4] = b"????"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.npz: "):
        motion.read_motion(path)


# The command line ---------------------------------------------------------------------------------------------------


def test_a_folder_of_arrays_is_a_table_with_splits_from_its_paths(tmp_path):
    folder = tmp_path / "walks"
    for name in ("train/a", "train/b/c", "validation", "test/a"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        np.save(folder / f"{name}.npy", walks((30, 2), seed=len(name)))
    (folder / "README.txt").write_text("of two joints")
    assert is_table(str(folder))
    assert is_table(str(folder / "test" / "a.npy"))
    data = PanelData.open(folder, cut=Cut(6, 4))
    splits = {one.name: one.split for one in data.panel}
    assert splits == {"test/a": "test", "train/a": "train", "train/b/c": "train", "validation": "validation"}
    (folder / "schema.toml").write_text("[cut]\nobserved = 5\nhorizon = 5\n[columns.east]\n[columns.north]\n")
    assert PanelData.open(folder).schema.columns.names == ["east", "north"]
    assert PanelData.open(folder).protocol.name == "5 + 5 steps"
    (folder / "walk.bvh").touch()
    assert not is_table(str(folder))
    (folder / "test" / "c.csv").write_text("1,2")
    with pytest.raises(
        ValueError, match=r"walks holds test.c.csv in addition to npy files; .* convert it to npy, or move it"
    ):
        PanelData.open(folder)
    (tmp_path / "none").mkdir()
    with pytest.raises(ValueError, match="none must have npy files, from 1 to 100,000; it has none"):
        PanelData.open(tmp_path / "none")


def test_the_command_line_fits_a_mapped_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    saved(tmp_path / "walks.npy", walks((400, 2)))
    cut_as = ["--observed", "6", "--horizon", "4", "--split", "time"]
    assert main(["data", "info", "walks.npy"]) == 0
    method = ["vae", "--latent", "2", "--warm-up", "1"]
    assert main(["fit", *method, "--data", "walks.npy", *cut_as, "--out", "run", "--steps", "2"]) == 0
    assert main(["resume", "run", "--steps", "3"]) == 0
    monkeypatch.setattr("dvae.cli.assessment.MOST_REMEMBERED", 100)
    assert main(["evaluate", "run", "--samples", "2"]) == 0
    warning = " ".join(capsys.readouterr().err.split())
    assert "training windows, evenly spaced" in warning
    saved(tmp_path / "walks.npy", walks((400, 2), seed=1))
    assert main(["resume", "run", "--steps", "4"]) == 1
    assert "has changed since run was fitted on it" in " ".join(capsys.readouterr().err.split())
