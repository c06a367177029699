"""Files of tables are read, or are an error of one sentence before they take time or memory."""

import io
import os
import resource
import sys
import zipfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from dvae.tables import Column, Columns, Panel, reading
from dvae.tables.columns import MOST
from dvae.tables.dataset import PanelData
from dvae.tables.numerals import read_numbers
from dvae.tables.protocol import Cut
from dvae.tables.reading import read_frame, read_panel, schema_beside

pd = pytest.importorskip("pandas")


def put(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def rows(seed=0):
    rng = np.random.default_rng(seed)
    frame = pd.DataFrame(
        {"day": np.tile(np.arange(30), 5), "riders": rng.poisson(4, 150), "temp": rng.normal(size=150)}
    )
    return frame.assign(station=np.repeat(list("abcde"), 30))


def test_all_newlines_and_quotes_of_csv_are_read(tmp_path):
    for content in ("a,b\r1,2\r3,4\r", "a,b\n1,2,\n3,4,\n", "\n\na,b\n\n1,2\n3,4", '"a","b"\n"1","2"\n3,4\n'):
        frame = read_frame(put(tmp_path / "a.csv", content))
        assert frame.to_dict("list") == {"a": ["1", "3"], "b": ["2", "4"]}
        assert read_frame(put(tmp_path / "A.TSV", content.replace(",", "\t"))).equals(frame)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("a\tb\n1\t2\n3\t4\n", {"a": [1, 3], "b": [2, 4]}),
        ("a;b\n1,5;x\n-3,25;y,z\n", {"a": [1.5, -3.25], "b": ["x", "y,z"]}),
        ("a;b\n1,125;2\n2,250;3,5\n", {"a": [1.125, 2.25], "b": [2, 3.5]}),
        ("a;b\n1.5;x\n2;y\n", {"a": [1.5, 2], "b": ["x", "y"]}),
        ('"a, of b";c\n1;2\n', {"a, of b": [1], "c": [2]}),
        ("a,b\n1;5,x\n", {"a": ["1;5"], "b": ["x"]}),
        ("# a, b; c\na,b\n1,2\n", {"a": [1], "b": [2]}),
        ("sep=;\na,x;b\n1,5;2\n", {"a,x": [1.5], "b": [2]}),
    ],
    ids=["tab", "comma", "three decimals", "point", "in a name", "in a value", "comment", "sep="],
)
def test_separators_decimal_signs_and_encodings_of_csv_are_inferred(tmp_path, content, expected):
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        frame = read_frame(put(tmp_path / "a.csv", content.encode(encoding)))
        assert [*frame] == [*expected]
        for name, values in expected.items():
            numbers = read_numbers(frame[name], hint=frame.attrs.get("decimal", "."))
            np.testing.assert_array_equal(numbers.values if numbers.is_numeric else frame[name], values)


def test_oddities_of_a_file_cause_a_warning(tmp_path):
    with pytest.warns(UserWarning, match="several columns named x; the further ones are read as x.1"):
        assert [*read_frame(put(tmp_path / "a.csv", "t,x,x\n1,2,3\n"))] == ["t", "x", "x.1"]
    assert len(read_frame(put(tmp_path / "b.csv", "t,,\n1,2,3\n")).columns) == 3
    with pytest.warns(UserWarning, match="header: 1, the first in line 7, 1 of 2"):
        assert read_frame(put(tmp_path / "c.csv", 'sep=;\n# of a\na;b\n\n1;2\n"3\n"\n')).iloc[-1].isna().any()
    if not find_spec("pyarrow"):
        with pytest.raises(ValueError, match=r"a.parquet is Parquet, which needs pyarrow: pip install"):
            read_frame(put(tmp_path / "a.parquet", b"PAR1"))


def test_an_npz_contains_sequences(tmp_path):
    x = np.arange(24.0).reshape(2, 4, 3)
    np.savez(tmp_path / "a.npz", x=x, other=np.zeros(3))
    panel = read_panel(tmp_path / "a.npz")
    np.testing.assert_array_equal([one.values for one in panel], x)
    assert panel.columns.id == ("sequence",)
    np.savez(tmp_path / "b.npz", anything=x[0].astype(">i2"))
    (one,) = read_panel(tmp_path / "b.npz")
    np.testing.assert_array_equal(one.values, x[0])  # no column with the number of the sequence
    np.savez(tmp_path / "c.npz", x=x, lengths=np.array([2, 4]))
    panel = read_panel(tmp_path / "c.npz")
    for one, values, length in zip(panel, x, (2, 4), strict=True):
        np.testing.assert_array_equal(one.values, values[:length])


def npz(**arrays):
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return content.getvalue()


def forged(shape, dtype="'<f8'", data=bytes(48)):
    """Return an npz file with a forged header."""
    header = f"{{'descr': {dtype}, 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode() + b"\n"
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("x.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data)
    return content.getvalue()


WIDE = ",".join(map(str, range(10**6)))


HOSTILE = {
    "empty": ("a.csv", b"", "No columns"),
    "header": ("a.csv", "a,b\n", None),
    "zeros": ("a.csv", b"a,b\n1,\0\n", "null bytes, which are not text"),
    "latin": ("a.csv", b"a,b\n1,2\n1,\xe9\n", "line 3 is not UTF-8, but perhaps Latin-1; save it as UTF-8"),
    "half of UTF-16": ("a.csv", b"\xff\xfea\0,\0b", "truncated data"),
    "long row": ("a.csv", "a,b\n1,2\n1,2,3\n", "line 3 has 3 cells and the header in line 1 has 2; correct"),
    "quote": ("a.csv", 'a,"b\n1,2\n', "EOF inside string"),
    "wide": ("a.csv", WIDE, f"more than {MOST} columns"),
    "wide row": ("a.csv", "a,b\n" + WIDE, f"more than {MOST} columns"),
    "wide row at the end": ("a.csv", "a,b\n" + "1,2\n" * 300_000 + WIDE, "line 300002 has 1000000 cells"),
    "one field": ("a.csv", "a,b\n1," + "x" * 10**7, "field larger"),
    "no zip": ("a.npz", b"abc", "not a zip file"),
    "no array": ("a.npz", npz(), "it holds ..; expected arrays x, lengths"),
    "other arrays": ("a.npz", npz(a=np.zeros(2), b=np.zeros(2)), "it holds .'a', 'b'.; expected arrays x, lengths"),
    "pickle": ("a.npz", npz(x=np.array([{}], object)), "Python objects"),
    "texts": ("a.npz", npz(x=np.array([["a"]])), "expected numbers"),
    "no rows": ("a.npz", npz(x=np.zeros((0, 3))), "expected numbers"),
    "wide array": ("a.npz", npz(x=np.zeros((2, MOST + 1))), f"at most {MOST} are read"),
    "lengths": ("a.npz", npz(x=np.zeros((2, 3, 1)), lengths=np.array([1, 4])), "whole numbers .N,. from 1 to 3"),
    "bomb": ("a.npz", forged("(300, 1000, 1000)", "'|i1'"), "declares shape .300, 1000, 1000. of int8, but holds 48"),
    "forged": ("a.npz", forged("(10, 10000000000, 2)"), "declares shape"),
    "forged a little": ("a.npz", forged("(3, 10000000, 2)"), "declares shape"),
    "forged objects": ("a.npz", forged("(2, 3)", "[('a', '<f8'), ('b', 'O')]"), "not a plain array"),
    "another kind": ("a.txt", b"a,b\n1,2\n", "is not a table; tables end in .csv, .tsv, .parquet, .npz"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_files_are_an_error_that_takes_little_memory(tmp_path, kind):
    name, content, message = HOSTILE[kind]
    path = put(tmp_path / name, content)
    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if message is None:
        assert not len(read_frame(path))
    else:
        with pytest.raises(ValueError, match=message) as error:
            read_frame(path)
        assert str(path) in str(error.value)
        assert len(str(error.value)) < 500
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - size
    assert grown * (1 if sys.platform == "darwin" else 1024) < 600e6


def test_a_pipe_or_folder_is_an_error_at_once(tmp_path):
    os.mkfifo(tmp_path / "a.csv")
    (tmp_path / "b.csv").mkdir()
    for name in ("a.csv", "b.csv"):
        with pytest.raises(ValueError, match=f"{name} must be a plain file"):
            read_frame(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        read_frame(tmp_path / "c.csv")
    put(tmp_path / "d.csv", "a\n1\n")
    (tmp_path / "e.csv").symlink_to(tmp_path / "d.csv")  # as the user typed it
    assert len(read_frame(tmp_path / "e.csv")) == 1
    os.mkfifo(tmp_path / "d.toml")
    assert schema_beside(tmp_path / "d.csv") == (None, None)


def test_the_schema_of_a_file_has_its_name_or_is_in_its_folder(tmp_path):
    path = tmp_path / "riders.csv"
    rows().to_csv(path, index=False)
    assert schema_beside(path) == (None, None)
    put(tmp_path / "schema.toml", "[columns.temp]")
    assert schema_beside(path) == (Columns((Column("temp"),)), None)
    put(tmp_path / "riders.toml", "id = 'station'\ntime = 'day'\n[columns.riders]\n[cut]\nobserved = 3\nhorizon = 2")
    columns = Columns((Column("riders"),), ("station",), "day")
    assert schema_beside(path) == (columns, Cut(3, 2))
    data = PanelData.open(path)
    assert (data.panel.columns, data.protocol) == (columns, Cut(3, 2))
    assert PanelData.open(path, horizon=1, split="time").protocol == Cut(3, 1, split="time")
    narrowed = PanelData.open(path, ["temp"])
    assert narrowed.panel.columns.names == ["temp"]
    assert narrowed.panel.columns.id == ("station",)
    for content in ("[columns.temp", "famly = 3", b"\xff", "[cut]\nobserved = 'a'\nhorizon = 2"):
        put(tmp_path / "riders.toml", content)
        with pytest.raises(ValueError, match=r"riders.toml is not a valid schema of a table: "):
            schema_beside(path)
    put(tmp_path / "riders.toml", "#" * (10**6 + 1))
    with pytest.raises(ValueError, match=r"riders.toml has 1000001 bytes"):
        schema_beside(path)


def test_data_are_reopened_from_the_record_of_a_run(tmp_path, monkeypatch):
    rows().to_csv(tmp_path / "riders.csv", index=False)
    monkeypatch.chdir(tmp_path)
    data = PanelData.open("riders.csv", ["riders"], past=("temp",), observed=4, horizon=2)
    reopened = PanelData.reopen(data.recorded(), data.schema)
    assert reopened.fingerprint == data.fingerprint == data.recorded().fingerprint
    assert data.recorded().path == "riders.csv"
    assert Path(data.location) == tmp_path / "riders.csv"
    assert reopened.windows("test").fingerprint == data.windows("test").fingerprint
    rows(1).to_csv(tmp_path / "other.csv", index=False)
    other = PanelData.reopen(data.recorded(), data.schema, "other.csv")
    assert other.schema == data.schema
    assert other.fingerprint != data.fingerprint


def test_a_domain_is_read_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    frame = pd.DataFrame({"a": np.arange(40.0)})
    monkeypatch.setitem(reading.DOMAINS, "own", reading.DOMAINS["chorales"])
    monkeypatch.setattr(reading, "domain", lambda name: Panel.of(frame, ["a"], name))
    assert read_panel("own").name == "own"
    assert PanelData.open("own").location == "own"  # in any working directory
    with pytest.raises(ValueError, match="own has fixed columns, a"):
        read_panel("own", Columns((Column("b"),)))
