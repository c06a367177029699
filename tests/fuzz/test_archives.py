"""Untrusted motion archives are read correctly, or are an error of one sentence."""

import pickle
import pickletools
import struct
import tracemalloc
import warnings
import zipfile

import numpy as np
import pytest
from hypothesis import strategies as st

from dvae.motion import WALKER, Clip, MotionSet, is_forecasts, read_motion, read_paths, save
from dvae.motion.files.arrays import read_arrays
from dvae.motion.geometry.skeleton import is_name

from .engine import Isolated, fuzz, limited

SHARE = 15


def clips(count=3, frames=5, dtype=np.float32):
    random = np.random.default_rng(0)
    return [random.uniform(-0.8, 0.8, (frames, 17, 3)).astype(dtype) for _ in range(count)]


def nested(arrays):
    return {"train": {"walk 1": arrays[0], "sit": arrays[1]}, "test": {"walk 1": arrays[2]}}


# ------------------------------------------------------------------------------------------------ writing archives


def npy(content, header=None, version=b"\x01\x00"):
    text = header if header is not None else "{'descr': '|O', 'fortran_order': False, 'shape': (), }"
    text = text.encode("latin1")
    size = struct.pack("<H" if version == b"\x01\x00" else "<I", len(text))
    return b"\x93NUMPY" + version + size + text + content


def npz(path, members, **options):
    with warnings.catch_warnings(), zipfile.ZipFile(path, "w", **options) as file:
        warnings.simplefilter("ignore")  # two members of one name
        for name, content in members:
            file.writestr(name, content)
    return path


def pickled(path, content, **options):
    return npz(path, [("positions_3d.npy", npy(content))], **options)


def python2(content):
    """Return the pickle of nested dictionaries of arrays by Python 2 and its numpy, where texts are bytes."""

    def text(value):
        return b"T" + struct.pack("<i", len(value)) + value

    def array(values):
        header = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
        shape = b"(" + b"".join(b"\x8a\x04" + struct.pack("<i", n) for n in values.shape) + b"t"
        dtype = b"cnumpy\ndtype\n" + text(values.dtype.str[1:].encode()) + b"K\x00K\x01\x87R"
        dtype += b"(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
        return header + b"(K\x01" + shape + dtype + b"\x89" + text(values.tobytes()) + b"tb"

    def dictionary(values):
        return b"}(" + b"".join(text(k.encode()) + write(v) for k, v in values.items()) + b"u"

    def write(value):
        return dictionary(value) if isinstance(value, dict) else array(value)

    return b"\x80\x02" + write(content) + b"."


LAYOUTS = {
    "C": lambda a: a,
    "Fortran": np.asfortranarray,
    "transposed": lambda a: np.ascontiguousarray(a.transpose(1, 0, 2)).transpose(1, 0, 2),
    "big-endian": lambda a: a.astype(">f4"),
    "double": lambda a: a.astype(np.float64),
    "half": lambda a: a.astype(np.float16),
    "every second frame": lambda a: np.repeat(a, 2, axis=0)[::2],
}


@pytest.mark.parametrize(("layout", "protocol"), [(layout, n % 6) for n, layout in enumerate(LAYOUTS)])
def test_pickled_dictionaries_of_arrays_are_read(tmp_path, protocol, layout):
    arrays = [LAYOUTS[layout](array) for array in clips()]
    for content in (nested(arrays), np.array(nested(arrays), dtype=object)):
        path = pickled(tmp_path / "a.npz", pickle.dumps(content, protocol), compression=zipfile.ZIP_DEFLATED)
        archive = read_motion(path, skeleton=WALKER)
        assert [clip.key for clip in archive] == [("train", "walk 1"), ("train", "sit"), ("test", "walk 1")]
        for clip, array in zip(archive, arrays, strict=True):
            np.testing.assert_array_equal(clip.positions, array.astype(np.float32))
            assert clip.positions.flags.writeable


def test_pickled_dictionaries_of_python_2_are_read(tmp_path):
    arrays = clips()
    archive = read_motion(pickled(tmp_path / "a.npz", python2(nested(arrays))), skeleton=WALKER)
    for clip, array in zip(archive, arrays, strict=True):
        np.testing.assert_array_equal(clip.positions, array)
    header = "{'descr': '<f4', 'fortran_order': False, 'shape': (5L, 17L, 3L), }"
    npz(tmp_path / "b.npz", [("walk.npy", npy(arrays[0].tobytes(), header))])
    np.testing.assert_array_equal(read_motion(tmp_path / "b.npz", skeleton=WALKER).clips[0].positions, arrays[0])


def test_names_may_be_numpy_strings_and_empty_clips_are_an_error(tmp_path):
    content = {np.str_("train"): {np.str_("walk"): clips()[0]}}
    for protocol in range(6):
        path = pickled(tmp_path / "a.npz", pickle.dumps(content, protocol))
        assert read_motion(path, skeleton=WALKER).clips[0].key == ("train", "walk")
        empty = {"train": {"walk": clips()[0][:0]}}
        with pytest.raises(ValueError, match="train/walk has no frames"):
            read_motion(pickled(tmp_path / "a.npz", pickle.dumps(empty, protocol)), skeleton=WALKER)


@pytest.mark.parametrize(
    "value",
    [
        np.arange(6).reshape(2, 3),
        np.array("text"),
        np.array(["a", "bcd"]),
        np.zeros((0, 3)),
        np.float32(3),
        np.array([True]),
    ],
)
@pytest.mark.parametrize("order", "CF")
def test_plain_arrays_are_read_unchanged(tmp_path, value, order):
    value = np.asarray(value, order=order)
    for swapped in (value, value.astype(value.dtype.newbyteorder(">"))):
        np.savez(tmp_path / "a.npz", value=swapped)
        array = read_arrays(tmp_path / "a.npz")["value"]
        assert array.dtype == swapped.dtype
        np.testing.assert_array_equal(array, value)


# ------------------------------------------------------------------------------------------------ known attacks

G = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R"  # an array, to be filled
F4 = b"cnumpy\ndtype\n\x8c\x02f4\x89\x88\x87R(K\x03\x8c\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
OBJECT = b"cnumpy\ndtype\n\x8c\x02O8\x89\x88\x87R(K\x03\x8c\x01|NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK?tb"


def pickle_of_clip(clip):
    """A pickle of one clip."""
    return b"\x80\x04}\x8c\x05train}\x8c\x04walk" + clip + b"ss."


def doublings(count):
    """Return a tuple of two tuples of two tuples ..., whose hash takes 2^count steps."""
    return b")" + b"2\x86" * count


def dtype_state(state):
    return G + b"(K\x01K\x05\x85cnumpy\ndtype\n\x8c\x02f4\x89\x88\x87R" + state + b"b\x89C\x14" + bytes(20) + b"tb"


def array_with(shape, dtype, content, fortran=b"\x89"):
    return G + b"(K\x01" + shape + dtype + fortran + content + b"tb"


WORD = b"\x8a\x08" + struct.pack("<q", 2**62)  # the number 2^62
LONG_TEXT = b"X" + struct.pack("<I", 10**6) + b"a" * 10**6 + b"\x94"  # in the memo at 0
LONG_LIST = b"](" + b"K\x01" * 10**5 + b"e\x94"

ATTACKS = {
    "dtype with fields at an address": pickle_of_clip(dtype_state(b"(K\x03\x8c\x01|N\x8c\x01a\x85}K\x08K\x08K\x10t")),
    "dtype with a subarray": pickle_of_clip(dtype_state(b"(K\x03\x8c\x01|\x8c\x02f8K\x08\x85\x86NNK\x40K\x01K\x00t")),
    "dtype of text with an object as its field": pickle_of_clip(
        G
        + b"(K\x01K\x01\x85cnumpy\ndtype\n\x8c\x02S8\x89\x88\x87R(K\x03\x8c\x01|N\x8c\x01a\x85}\x8c\x01a"
        + OBJECT
        + b"K\x00\x86sK\x08K\x01K\x3ftb\x89]Natb"
    ),
    "dtype of numbers that are counted as objects": pickle_of_clip(
        G
        + b"(K\x01K\x03\x85cnumpy\ndtype\n\x8c\x02i8\x89\x88\x87R(K\x03\x8c\x01<NNNJ\xff\xff\xff\xff"
        + b"J\xff\xff\xff\xffK\x3ftb\x89]("
        + (b"\x8a\x08" + b"A" * 8) * 3
        + b"etb"
    ),
    "dtype of another size": pickle_of_clip(dtype_state(b"(K\x03\x8c\x01<NNNJ\x00\x00\x00\x40K\x01K\x00t")),
    "dtype whose numbers are objects": pickle_of_clip(dtype_state(b"(K\x03\x8c\x01|NNNK\x08K\x08K\x3ft")),
    "dtype whose fields are text": pickle_of_clip(
        dtype_state(b"(K\x03\x8c\x01<\x8c\x01aNNJ\xff\xff\xff\xffK\x01K\x00t")
    ),
    "dtype of numbers": pickle_of_clip(dtype_state(b"(K\x03K\x01NNNK\x04K\x04K\x00t")),
    "dtype of fields": pickle_of_clip(G + b"cnumpy\ndtype\n(\x8c\x01a\x8c\x02f4\x86l\x85R"),
    "objects of too short a list": pickle_of_clip(array_with(b"M\x00\x10\x85", OBJECT, b"]N\x61")),
    "objects of bytes": pickle_of_clip(array_with(b"K\x01\x85", OBJECT, b"C\x08" + b"A" * 8)),
    "objects without a list": pickle_of_clip(array_with(b"K\x02\x85", OBJECT, b"N")),
    "objects from a buffer": pickle_of_clip(
        b"cnumpy.core.numeric\n_frombuffer\n(C\x08AAAAAAAA" + OBJECT + b"K\x01\x85\x8c\x01CtR"
    ),
    "object from a scalar": pickle_of_clip(b"cnumpy.core.multiarray\nscalar\n" + OBJECT + b"C\x08AAAAAAAA\x86R"),
    "bytes too few": pickle_of_clip(array_with(b"M\x00\x10K\x11K\x03\x87", F4, b"C\x10" + bytes(16))),
    "a negative length": pickle_of_clip(
        array_with(b"J\xfe\xff\xff\xffJ\xfe\xff\xff\xff\x86", F4, b"C\x10" + bytes(16))
    ),
    "lengths that overflow": pickle_of_clip(array_with(WORD + b"K\x04\x86", F4, b"C\x00")),
    "places that hold nothing": pickle_of_clip(array_with(WORD + b"K\x00\x86", F4, b"C\x00")),
    "a shape of arrays": pickle_of_clip(array_with(G + b"\x85", F4, b"C\x00")),
    "a shape that is no tuple": pickle_of_clip(array_with(b"K\x04", F4, b"C\x10" + bytes(16))),
    "content that is an array": pickle_of_clip(array_with(b"K\x04\x85", F4, G)),
    "a state twice": pickle_of_clip(
        array_with(b"K\x01\x85", F4, b"C\x04abcd") + b"(K\x01K\x01\x85" + F4 + b"\x89C\x04abcdtb"
    ),
    "no state": pickle_of_clip(G),
    "array as its own state": pickle_of_clip(G + b"\x94h\x00b"),
    "LONG_BINPUT at 2^29": b"\x80\x04}r\x00\x00\x00\x20.",
    "PUT at 10^30": b"}p" + b"1" + b"0" * 30 + b"\n.",
    "PUT at minus one": b"}p-1\n.",
    "forty doublings as a key": b"\x80\x04}" + doublings(40) + b"Ns.",
    "forty doublings as a split": b"\x80\x04}\x8c\x01a" + doublings(40) + b"s.",
    "forty doublings as a shape": pickle_of_clip(array_with(doublings(40), F4, b"C\x00")),
    "forty doublings as a dtype": pickle_of_clip(b"cnumpy\ndtype\n" + doublings(40) + b"\x85R"),
    "forty doublings as a codec": pickle_of_clip(b"c_codecs\nencode\n\x8c\x01a" + doublings(40) + b"\x86R"),
    "forty doublings as arguments": pickle_of_clip(b"c_codecs\nencode\n" + doublings(40) + b"R"),
    "forty doublings as a state": pickle_of_clip(G + doublings(40) + b"b"),
    "forty doublings as a function": pickle_of_clip(doublings(40) + b")R"),
    "forty doublings as an order": pickle_of_clip(
        b"cnumpy.core.numeric\n_frombuffer\n(C\x04abcd" + F4 + b"K\x01\x85" + doublings(40) + b"tR"
    ),
    "tuples in tuples in tuples": b"\x80\x04)" + b"\x85" * 500_000 + b".",
    "arrays in arrays in arrays": b"\x80\x04"
    + (G + b"(K\x01)" + OBJECT + b"\x89](") * 2000
    + b"N"
    + b"etb" * 2000
    + b".",
    "dictionaries in dictionaries": b"\x80\x04" + b"}\x8c\x01a" * 200_000 + b"N" + b"s" * 200_000 + b".",
    "a dictionary in itself": b"\x80\x04}\x94\x8c\x01ah\x00s.",
    "a number of 2^24 bits": b"\x80\x04\x8b" + struct.pack("<i", 2**21) + b"\x7f" * 2**21 + b".",
    "a number of negative size": b"\x80\x04\x8b\xff\xff\xff\xff.",
    "a number of 10^6 digits": b"L" + b"7" * 10**6 + b"L\n.",
    "bytes of 2^60": b"\x80\x04\x8e" + struct.pack("<Q", 2**60) + b".",
    "bytes of 2^31": b"\x80\x04B\x00\x00\x00\x80.",
    "text of 2^63": b"\x80\x04\x8d" + struct.pack("<Q", 2**63) + b".",
    "a billion instructions": b"\x80\x04" + b"N" * (2**21) + b".",
    "marks": b"\x80\x04" + b"(" * 10**6 + b".",
    "dictionaries without end": b"\x80\x04" + b"}" * (2**20 - 2) + b".",
    "text encoded again and again": b"\x80\x04"
    + LONG_TEXT
    + b"c_codecs\nencode\n\x94h\x00\x8c\x06latin1\x86\x94"
    + b"h\x01h\x02R" * 10**5
    + b".",
    "text as a number again and again": b"\x80\x04"
    + LONG_TEXT
    + b"cnumpy.core.multiarray\nscalar\n\x94cnumpy\ndtype\n\x8c\x08S1000000\x85R\x94h\x02h\x00\x86\x94"
    + b"h\x01h\x03R" * 10**5
    + b".",
    "a long key again and again": b"\x80\x04" + LONG_TEXT + b"}(" + b"h\x00N" * 10**5 + b"u.",
    "a long list as objects again and again": b"\x80\x04"
    + LONG_LIST
    + b"0]("
    + (G + b"(K\x01J\xa0\x86\x01\x00\x85" + OBJECT + b"\x89h\x00tb") * 5000
    + b"e.",
    "a long tuple as arguments": b"\x80\x04(" + b"N" * 10**5 + b"t\x94" + b"c_codecs\nencode\nh\x00R" * 1000 + b".",
    "one array as clip after clip": b"\x80\x04}\x8c\x05train}(\x8c\x01a"
    + array_with(b"M\x10\x27K\x11K\x03\x87", F4, b"B" + struct.pack("<I", 10_000 * 204) + bytes(10_000 * 204))
    + b"\x94"
    + b"".join(b"\x8c\x04%04dh\x00" % n for n in range(2000))
    + b"us.",
    "two words of one text": b"\x80\x04\x8c\x03a.b\x8c\x01c\x93.",
    "a name that is none": b"\x80\x04NN\x93.",
    "an extension": b"\x80\x04\x82\x01.",
    "a persistent id": b"Pabc\n.",
    "an object out of the file": b"\x80\x05\x97.",
    "a new object": b"\x80\x04cnumpy\nndarray\n)\x81.",
    "an array called as a class": b"\x80\x04cnumpy\nndarray\nK\x05\x85R.",
    "builtins": b"\x80\x04cbuiltins\ngetattr\n.",
    "attributes of what is allowed": b"\x80\x04\x8c\x05numpy\x8c\x10ndarray.__reduce__\x93.",
    "no stop": b"\x80\x04}",
    "nothing on the stack": b"\x80\x04.",
    "pops of nothing": b"\x80\x040.",
    "an odd dictionary": b"\x80\x04(\x8c\x01ad.",
    "terminal commands": b"\x80\x04c\x1b[2J\x07\nx\n.",
    "half a letter": b"\x80\x04}X\x03\x00\x00\x00\xed\xa0\x80Ns.",
    "more after the end": pickle.dumps(nested(clips())) + b"more",
}

HEADERS = {
    "nested": "(" * 3000 + ")" * 3000,
    "an expression": "{'descr': '<f4', 'fortran_order': False, 'shape': (9**9**9,), }",
    "negative": "{'descr': '<f4', 'fortran_order': False, 'shape': (-5, 17, 3), }",
    "minus signs": "{'descr': '<f4', 'fortran_order': False, 'shape': (" + "-" * 3000 + "5,), }",
    "fields": "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (5, 17, 3), }",
    "too large": "{'descr': '<f4', 'fortran_order': False, 'shape': (5, 17, 3), }" + " " * 60000,
    "an overflow": "{'descr': '<f4', 'fortran_order': False, 'shape': (4611686018427387904, 4), }",
    "many places that hold nothing": "{'descr': '<f4', 'fortran_order': False, 'shape': (4611686018427387, 0), }",
    "text without letters": "{'descr': '<U0', 'fortran_order': False, 'shape': (4611686018427387,), }",
    "a letter of 2^31": "{'descr': '<U2147483647', 'fortran_order': False, 'shape': (0,), }",
    "sixty-five dimensions": "{'descr': '<f4', 'fortran_order': False, 'shape': (" + "1, " * 65 + "), }",
    "a key twice": "{'descr': '<f4', 'descr': '<f4', 'fortran_order': False}",
    "a number too long": "{'descr': '<f4', 'fortran_order': False, 'shape': (" + "9" * 4000 + ",), }",
    "times": "{'descr': '<M8[D]', 'fortran_order': False, 'shape': (5,), }",
    "void": "{'descr': '|V20', 'fortran_order': False, 'shape': (51,), }",
    "complex": "{'descr': '<c8', 'fortran_order': False, 'shape': (5,), }",
    "two lengths in one": "{'descr': '<f4', 'fortran_order': False, 'shape': (5 1, 17, 3), }",
    "nothing": "",
    "spaces": "{" + " " * 4000 + "}",
    "quotes": "{'descr': '" + "\\'" * 1000 + "', 'fortran_order': False, 'shape': (), }",
}


def error_messages(path, directory=None):
    """Return the errors of all readers for a file."""
    messages = []
    readers = {"load": lambda p: read_motion(p, skeleton=WALKER), "arrays": read_arrays, "paths": read_paths}
    for name, reader in readers.items():
        try:
            reader(path)
        except (ValueError, OSError) as error:
            message = str(error)
            assert path.stem in message, f"{name}: {message!r} does not name the file"
            assert len(message) < 1500, f"{name}: {len(message)} characters"
            assert is_name(message), f"{name}: {message!r} has control characters"
            messages.append(message)
        except RuntimeError as error:
            raise AssertionError(f"{name}: {error!r}") from error
    is_forecasts(path)
    return messages


def must_be_refused(path, directory):
    assert len(error_messages(path)) == 3


@pytest.fixture(scope="module")
def isolated(tmp_path_factory):
    with Isolated(must_be_refused, tmp_path_factory.mktemp("attacks")) as isolated:
        yield isolated


@pytest.mark.parametrize("attack", ATTACKS)
def test_hostile_pickles_are_an_error_within_time_and_memory_limits(isolated, tmp_path, attack):
    isolated(pickled(tmp_path / "attack.npz", ATTACKS[attack], compression=zipfile.ZIP_DEFLATED))


@pytest.mark.parametrize("header", HEADERS)
def test_hostile_headers_are_an_error_within_time_and_memory_limits(isolated, tmp_path, header):
    version = b"\x01\x00" if len(HEADERS[header]) < 60000 else b"\x02\x00"
    content = npy(clips()[0].tobytes(), HEADERS[header], version)
    isolated(npz(tmp_path / "attack.npz", [("train/walk.npy", content)]))
    isolated(npz(tmp_path / "attack.npz", [("positions_3d.npy", content)]))


def test_compressed_encrypted_and_repeated_members_are_an_error(tmp_path):
    plain = npy(clips()[0].tobytes(), "{'descr': '<f4', 'fortran_order': False, 'shape': (5, 17, 3), }")
    for method, name in ((zipfile.ZIP_BZIP2, "bzip2"), (zipfile.ZIP_LZMA, "LZMA")):
        path = npz(tmp_path / "a.npz", [("train/walk.npy", plain)], compression=method)
        with pytest.raises(ValueError, match=rf"a\.npz: train/walk is compressed by {name}, expected deflate"):
            read_motion(path, skeleton=WALKER)
    path = npz(tmp_path / "a.npz", [("walk.npy", plain), ("walk.npy", plain)])
    with pytest.raises(ValueError, match=r"a\.npz: walk occurs twice"):
        read_arrays(path)
    content = bytearray(npz(tmp_path / "a.npz", [("walk.npy", plain)]).read_bytes())
    for signature, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        content[content.index(signature) + offset] |= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.npz: walk is encrypted"):
        read_motion(path, skeleton=WALKER)


def test_a_damaged_member_is_an_error_that_names_it(tmp_path):
    save(tmp_path / "a.npz", MotionSet([Clip("train", "walk", clips()[0])], WALKER))
    content = bytearray((tmp_path / "a.npz").read_bytes())
    for offset in (100, 300):
        damaged = content.copy()
        damaged[offset] ^= 0xFF
        (tmp_path / "a.npz").write_bytes(damaged)
        with pytest.raises(ValueError, match=r"a\.npz: train/walk: (damaged|declares|no npy)"):
            read_motion(tmp_path / "a.npz", skeleton=WALKER)


def test_positions_beyond_float32_are_an_error_that_names_the_clip(tmp_path):
    positions = clips(1, dtype=np.float64)[0]
    positions[2, 3] = 1e300
    with pytest.raises(ValueError, match=r"clip train/walk has NaN or infinite .* first RFoot at frame 2"):
        MotionSet([Clip("train", "walk", positions)], WALKER)
    np.savez(tmp_path / "a.npz", **{"train/walk": positions, "train/sit": clips(1)[0]})
    with pytest.raises(ValueError, match=r"a: clip train/walk has NaN or infinite"):
        read_motion(tmp_path / "a.npz", skeleton=WALKER)
    clips_read = read_motion(tmp_path / "a.npz", skeleton=WALKER, skip_bad=True)
    assert [clip.name for clip in clips_read] == ["sit"]
    assert clips_read.skipped[0][:2] == ("train", "walk")


# ------------------------------------------------------------------------------------------------ memory


@pytest.mark.parametrize("kind", ["plain", "deflated", "pickled"])
def test_reading_takes_little_more_memory_than_the_data(tmp_path, kind):
    arrays = {f"train/{n}": clips(1, frames=4_000)[0] for n in range(8)}
    size = sum(array.nbytes for array in arrays.values())
    if kind == "pickled":
        content = {"train": {name[6:]: array for name, array in arrays.items()}}
        np.savez(tmp_path / "a.npz", positions_3d=np.array(content, dtype=object))
    else:
        arrays = {"train/whole": np.concatenate(list(arrays.values()))}
        (np.savez if kind == "plain" else np.savez_compressed)(tmp_path / "a.npz", **arrays)
    tracemalloc.start()
    try:
        read_motion(tmp_path / "a.npz", skeleton=WALKER)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 1.5 * size + 2**21, f"{peak / size:.2f} times the data"


def test_a_zip_bomb_is_not_unpacked(isolated, tmp_path):
    path = tmp_path / "a.npz"
    frames = 2**27 // 204
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({frames}, 17, 3), }}"
    content = npy(bytes(frames * 204), header)
    npz(path, [("train/walk.npy", content)], compression=zipfile.ZIP_DEFLATED)
    with pytest.raises(
        ValueError, match=r"a\.npz: it would unpack to 134,[\d,]+ bytes; at most 67,108,864 are allowed"
    ):
        read_motion(path, skeleton=WALKER)
    forged = bytearray(path.read_bytes())
    for signature, offset in ((b"PK\x03\x04", 22), (b"PK\x01\x02", 24)):  # the declared size
        position = forged.rindex(signature) + offset
        forged[position : position + 4] = struct.pack("<I", 500)
    path.write_bytes(forged)
    isolated(path)


# ------------------------------------------------------------------------------------------------ random ones


def bases():
    """Return valid pickles for archives by name."""
    content = nested(clips(3, 2))
    pickles = {f"protocol {n}": pickle.dumps(content, n) for n in range(6)}
    pickles["objects"] = pickle.dumps(np.array(content, dtype=object), 3)
    pickles["layouts"] = pickle.dumps({"a": {k: make(clips(1, 2)[0]) for k, make in LAYOUTS.items()}}, 5)
    pickles["python 2"] = python2(content)
    return pickles


BASES = bases()
SNIPPETS = sorted(
    {b"N", b"(", b")", b"]", b"}", b"0", b"1", b"2", b"\x94", b"h\x00", b"h\x03", b"R", b"b", b"s", b"u", b"e", b"\x85"}
    | {b"\x86", b"\x87", b"t", b"d", b"l", b"a", b".", b"\x93", b"\x81", b"\x88", b"K\x05", b"J\xff\xff\xff\xff", WORD}
    | {G, F4, OBJECT, b"\x8c\x01a", b"C\x04abcd", doublings(30), b"cnumpy\ndtype\n", b"cos\nsystem\n", b"\x8c\x02O8"}
)
TEXTS = sorted({*HEADERS.values(), "{'descr': '<f4', 'fortran_order': True, 'shape': (2, 17, 3), }"})

places = st.floats(0, 1, exclude_max=True)
byte_mutations = st.one_of(
    st.tuples(st.just("flip"), places, st.integers(1, 255)),
    st.tuples(st.just("write"), places, st.binary(max_size=8)),
    st.tuples(st.just("cut"), places, st.integers(1, 40)),
    st.tuples(st.just("truncate"), places, st.just(0)),
    st.tuples(st.just("repeat"), places, st.integers(1, 300)),
    st.tuples(st.just("write at the end"), places, st.binary(min_size=1, max_size=8)),
)
opcode_mutations = st.one_of(
    st.tuples(st.just("drop"), places, st.just(0)),
    st.tuples(st.just("twice"), places, st.integers(1, 3)),
    st.tuples(st.just("insert"), places, st.integers(0, len(SNIPPETS) - 1)),
    st.tuples(st.just("swap"), places, places),
    st.tuples(st.just("argument"), places, st.binary(min_size=1, max_size=4)),
)
archives = st.tuples(
    st.sampled_from([*BASES, "plain"]),
    st.lists(opcode_mutations, max_size=4),  # mutations of the pickle
    st.lists(byte_mutations, max_size=2),  # mutations of the member
    st.none() | st.sampled_from(TEXTS),  # header of the member
    st.lists(byte_mutations, max_size=3),  # mutations of the file
    st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]),
)


def mutate_bytes(content, mutations):
    content = bytearray(content)
    for kind, place, value in mutations:
        start = int(place * len(content))
        if kind == "flip" and content:
            content[start] ^= value
        elif kind == "write":
            content[start : start + len(value)] = value
        elif kind == "cut":
            del content[start : start + value]
        elif kind == "truncate":
            del content[start:]
        elif kind == "repeat":
            content[start:start] = content[start : start + value]
        elif kind == "write at the end":  # the directory of a zip is at its end
            start = max(0, len(content) - 1 - int(place * 120))
            content[start : start + len(value)] = value
    return bytes(content)


def mutate_opcodes(content, mutations):
    starts = [place for _, _, place in pickletools.genops(content)]
    chunks = [content[a:b] for a, b in zip(starts, [*starts[1:], len(content)], strict=True)]
    for kind, place, value in mutations:
        start = int(place * len(chunks))
        if kind == "drop":
            del chunks[start : start + 1]
        elif kind == "twice":
            chunks[start:start] = chunks[start : start + value]
        elif kind == "insert":
            chunks.insert(start, SNIPPETS[value])
        elif kind == "swap":
            other = int(value * len(chunks))
            chunks[start], chunks[other] = chunks[other], chunks[start]
        elif kind == "argument":
            chunks[start] = chunks[start][:1] + value + chunks[start][1 + len(value) :]
    return b"".join(chunks)


def read_mutated(example, directory):
    base, opcodes, member, header, file, method = example
    path = directory / "mutated.npz"
    if base == "plain":
        save(path, MotionSet([Clip("train", "walk", clips(1)[0])], WALKER))
        (directory / "mutated.npz.skeleton.json").unlink()
        if header is not None:
            npz(
                path, [("train/walk.npy", mutate_bytes(npy(clips(1)[0].tobytes(), header), member))], compression=method
            )
    else:
        content = mutate_opcodes(BASES[base], opcodes)
        npz(path, [("positions_3d.npy", mutate_bytes(npy(content, header), member))], compression=method)
    path.write_bytes(mutate_bytes(path.read_bytes(), file))
    error_messages(path)
    if sorted(p.name for p in directory.iterdir()) != ["mutated.npz"]:
        raise AssertionError("reading left something behind")


def test_archives_without_mutations_are_valid(tmp_path):
    for base in [*BASES, "plain"]:
        read_mutated((base, [], [], None, [], zipfile.ZIP_DEFLATED), tmp_path)
        assert len(read_motion(tmp_path / "mutated.npz", skeleton=WALKER)) > 0


@limited(SHARE)
def test_mutated_archives_are_read_or_an_error(tmp_path):
    with Isolated(read_mutated, tmp_path) as isolated:
        fuzz(isolated, archives, SHARE)
