"""Untrusted tables and schemas are read correctly, or are an error of one sentence."""

import io
import os
import zipfile
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

from dvae.tables.columns import Columns
from dvae.tables.dataset import PanelData
from dvae.tables.reading import read_schema, written_schema

from .engine import Isolated, fuzz, limited

OF_TABLES, OF_SCHEMAS = 6, 3

NUMERALS = ["0", "1", "2.5", "-3", "1e308", "1e-308", "9" * 400, "inf", "nan", "1_000", "0x10", "1,5", " 1 ", "1j"]
TEXTS = [
    "",
    "NA",
    "None",
    "true",
    "False",
    "rain",
    "é",
    '"',
    '""',
    '"a,b"',
    "'",
    "a\nb",
    "\0",
    "\x1b[2J",
    "\ud7ff",
    "#",
]
DATES = [
    "2024-01-01",
    "2024-02-30",
    "2024-01-01T00:00+01:00",
    "1500-01-01",
    "99999-01-01",
    "12:30",
    "1/2/2024",
    "13/2/24",
]
CELLS = st.sampled_from([*NUMERALS, *TEXTS, *DATES])
NAMES = st.sampled_from(
    ["id", "station", "time", "date", "year", "step", "x", "y", "y:count", "", "Unnamed: 0", "a.1", "a", "é", " ", '"']
)
ENDS = st.sampled_from(["\n", "\r\n", "\r", "\n\n", ",\n"])
NUMBERS = st.sampled_from(["<f8", ">f8", "<f2", "<i8", "|u1", "|b1", "<c16", "|O", "<U3", "<M8[s]", "|V5", "<f16"])


@st.composite
def separated(draw):
    """Draw a CSV of a few cells, perhaps damaged."""
    names = draw(st.lists(NAMES, min_size=1, max_size=5))
    columns = [draw(st.lists(CELLS, min_size=1, max_size=3)) for _ in names]
    count = draw(st.integers(0, 30))
    rows = [[draw(st.sampled_from(cells)) for cells in columns] for _ in range(min(count, 8))]
    rows += [[str(n // 4), *map(str, np.arange(len(names) - 1) * n)] for n in range(count - 8)]
    end, separator = draw(ENDS), draw(st.sampled_from([",", ",", ",", ";", "\t"]))
    text = end.join(separator.join(row) for row in [names, *rows]).encode("utf-8", "surrogatepass")
    return draw(damaged(text)), draw(st.sampled_from([".csv", ".csv", ".tsv", ".npz", ".parquet"]))


@st.composite
def damaged(draw, content):
    """Draw the content, unchanged, with some bytes replaced, or truncated."""
    if draw(st.integers(0, 3)):
        return content
    content = bytearray(content)
    for place, byte in draw(st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=3)), max_size=2)):
        place %= len(content) + 1
        content[place : place + len(byte)] = byte
    if draw(st.integers(0, 4)) == 0 and content:
        del content[draw(st.integers(0, len(content) - 1)) :]
    return bytes(content)


@st.composite
def arrays(draw):
    """Draw an npz with a random header."""
    shape = draw(st.lists(st.sampled_from([0, 1, 2, 3, 12, 40, 5000, 10**6, 10**12, -1, 2**63]), max_size=4))
    fields = {"descr": draw(NUMBERS), "fortran_order": draw(st.booleans()), "shape": tuple(shape)}
    header = draw(damaged(repr(fields).ljust(117).encode() + b"\n"))
    size = min(int(np.prod([min(abs(n), 100) for n in shape], dtype=float)), 4000)
    values = np.random.default_rng(len(header)).integers(0, 5, size).astype("<f8").tobytes()
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", draw(st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]))) as archive:
        for name in draw(st.lists(st.sampled_from(["x", "lengths", "y"]), min_size=1, max_size=2, unique=True)):
            magic = b"\x93NUMPY" + bytes(draw(st.sampled_from([(1, 0), (1, 0), (2, 0), (3, 0), (9, 9)])))
            archive.writestr(f"{name}.npy", magic + len(header).to_bytes(2, "little") + header + values)
    return draw(damaged(content.getvalue())), ".npz"


def check_sentence(error: Exception):
    assert 0 < len(str(error)) < 2000


def read(example, directory: Path):
    """Open a table, and check that its schema survives writing."""
    content, suffix = example
    path = directory / f"a{suffix}"
    path.write_bytes(content)
    try:
        data = PanelData.open(path)
        reopened = PanelData.reopen(data.recorded(), data.schema)
        assert reopened.fingerprint == data.fingerprint
        batch = data.windows("train").all()
        assert all(value.isfinite().all() for value in batch.values())
        columns, cut = read_schema(written_schema(data.panel.columns, data.protocol))
        assert (columns, cut) == (data.panel.columns, data.protocol)
    except (ValueError, OSError) as error:
        check_sentence(error)
    finally:
        os.unlink(path)


@limited(OF_TABLES)
def test_tables_are_read_or_an_error(tmp_path):
    with Isolated(read, tmp_path) as isolated:
        fuzz(isolated, st.one_of(separated(), arrays()), seconds=OF_TABLES)


ENTRIES = ["id", "time", "columns", "cut", "role", "family", "classes", "observed", "a", "'a'", '"b.c"', "known", "'u'"]
SIGNS = ["=", "=", "=", "[", "]", "[[", "]]", "{", "}", ",", ".", "\n", "\n", " ", "#", '"""', "'''", "\\", "\0", "é"]
WORDS = st.sampled_from([*ENTRIES, *SIGNS, "1", "-1", "1e400", "nan", "true", "2024-01-01"])
VALID = """id = ["station"]
time = "date"
[columns.riders]
family = "count"
unit = "people"
[columns."weather.now"]
role = "past"
family = "category"
classes = ["clear", "rain"]
[cut]
observed = 4
horizon = 2
split = "time"
"""


@st.composite
def schemas(draw):
    """Draw a schema of a few words, or a valid one with some words inserted."""
    words = draw(st.lists(WORDS, max_size=12))
    if not draw(st.integers(0, 3)):
        return draw(st.sampled_from(["", " "])).join(words)
    place = draw(st.integers(0, len(VALID)))
    return VALID[:place] + "".join(words[:2]) + VALID[draw(st.integers(place, min(len(VALID), place + 9))) :]


def check_schema(text, directory: Path):
    """Read a schema, and check that it survives writing."""
    try:
        columns, cut = read_schema(text)
    except (ValueError, TypeError) as error:  # values of another type; the reader of files adds the name
        check_sentence(error)
        return
    if columns is not None:
        assert Columns.from_toml(columns.to_toml()) == columns
        if cut is not None:
            assert read_schema(written_schema(columns, cut)) == (columns, cut)


@limited(OF_SCHEMAS)
def test_schemas_are_read_or_an_error(tmp_path):
    with Isolated(check_schema, tmp_path) as isolated:
        fuzz(isolated, schemas(), seconds=OF_SCHEMAS)
