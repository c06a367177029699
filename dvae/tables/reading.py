"""Files of tables: CSV, Parquet, npz and npy, with a schema file next to them.

An npy file, or a folder of npy files, is memory-mapped and may be larger than memory. Other files are read completely.

The schema of `riders.csv` is `riders.toml`, or `schema.toml` in the same folder. It describes the columns
(`dvae.tables.columns`) and how sequences are split and cut:

    [cut]
    observed = 48
    horizon = 24
    split = "time"
"""

from __future__ import annotations

import codecs
import csv
import os
import re
import textwrap
import warnings
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, fields
from functools import partial
from io import BytesIO, StringIO, TextIOWrapper
from itertools import islice, takewhile
from pathlib import Path
from typing import Any

import numpy as np

from .. import files
from ..data.npy import NpyError, mapped, npz_arrays
from ..distributions.family import FAMILIES
from ..options import nearest
from .column_inference import ColumnHints
from .columns import MOST, Columns, layout, parsed
from .domains import DOMAINS, domain
from .numerals import decimal_sign, may_be_thousands
from .panel import SPLITS, Panel, Series, plain_columns
from .protocol import Cut

SEPARATORS = {".csv": ",;\t|", ".tsv": "\t"}
"""Possible separators, the most likely first; spreadsheets use the separator of their locale."""
DECLARED = re.compile(rb'"?sep=([,;:|\t ])"?\r?\n', re.IGNORECASE)
"""A first line that declares the separator."""
BLANK = re.compile(rb"\n[ \t]*\r?\n|\r\r(?!\n)")
SUFFIXES = (*SEPARATORS, ".parquet", ".npz")
LARGEST = 2 * 10**9
"""Maximum bytes of a file, and of its content."""
MOST_FILES = 100_000
LARGEST_SCHEMA = 10**6
LARGEST_HEADER = 2**20


def read_frame(path: str | os.PathLike[str]) -> Any:
    """Read a CSV, TSV, Parquet or npz file as a pandas frame; cells of CSV and TSV are text, empty ones missing.

    An npz contains an array (N, T, D), or (T, D) for one sequence, and optionally "lengths" (N,). The array is named
    "x", or it is the only one besides "lengths". Its columns are x0, x1, …, "sequence" and "step".

    Raises:
        FileNotFoundError: if the file does not exist.
        ValueError: if the file is not a table, or exceeds a limit.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{file} is not a table; tables end in {', '.join(SUFFIXES)}")
    content = files.read(file, LARGEST, links=True)
    if suffix == ".npz":
        return _read_npz(file, content)
    try:
        return _read_parquet(content) if suffix == ".parquet" else _read_text(content, SEPARATORS[suffix])
    except ImportError as error:
        raise ValueError(f"{file} is Parquet, which needs pyarrow: pip install 'pyro-dvae[parquet]'") from error
    except Exception as error:  # parsers raise many types
        raise ValueError(f"{file} cannot be read as {suffix[1:].upper()}: {str(error)[:300]}") from error


def _read_text(content: bytes, separators: str) -> Any:
    """Read a CSV as a frame of text, to be parsed once roles are known; rows longer than the header raise an error."""
    import pandas as pd

    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        content = content.decode("utf-16").encode()
    full_content = content = content.removeprefix(codecs.BOM_UTF8)
    if declared := DECLARED.match(content):  # as spreadsheets write it
        separators, content = declared[1].decode(), content[declared.end() :]
    head = content[:LARGEST_HEADER].decode("utf-8", "replace")
    separator = max(separators, key=lambda candidate: len(_header(head, candidate)))
    if max(map(len, _rows(head, separator)), default=0) > MOST:
        raise ValueError(f"it has more than {MOST} columns; remove some")
    if b"\0" in content:
        raise ValueError("it has null bytes, which are not text; save it as CSV in UTF-8")
    read_csv = partial(pd.read_csv, sep=separator, index_col=False, dtype=str, keep_default_na=False, na_values=[""])
    with warnings.catch_warnings():
        warnings.simplefilter("error", pd.errors.ParserWarning)
        try:
            frame = read_csv(BytesIO(content), skiprows=_comments(content))
        except (pd.errors.ParserWarning, pd.errors.ParserError) as error:
            raise ValueError(_longer_row(full_content, separator) or str(error).strip()) from error
        except UnicodeDecodeError as error:
            try:
                content.decode()
            except UnicodeDecodeError as position:
                line = content.count(b"\n", 0, position.start) + 1
                raise ValueError(
                    f"line {line} is not UTF-8, but perhaps Latin-1; save it as UTF-8, as a spreadsheet can, or "
                    "`iconv -f latin1 -t utf-8`"
                ) from error
            raise
    header = _header(head, separator)
    if repeated := [name for name in dict.fromkeys(header) if name and header.count(name) > 1]:
        renamed = [name for name in frame.columns if name not in header and not name.startswith("Unnamed: ")]
        warnings.warn(
            f"the header has several columns named {', '.join(repeated)}; the further ones are read as "
            f"{', '.join(renamed)}",
            stacklevel=5,
        )
    if separator != ",":
        frame.attrs["decimal"] = decimal_sign(frame)
    elif any(may_be_thousands(frame[name]) for name in frame) and decimal_sign(frame) != ".":
        frame.attrs["decimal"] = ""
    if len(frame) and frame.iloc[:, -1].isna().any():
        _warn_of_shorter_rows(full_content, separator)
    return _without_empty_end(frame, content)


def _cells(content: bytes, separator: str) -> Iterator[tuple[int, int]]:
    """Yield the last line number and the number of cells of each row, from the header on."""
    lines = TextIOWrapper(BytesIO(content), "utf-8", "replace", newline="")
    declared = DECLARED.match(content)
    first = bool(declared) + _comments(content[declared.end() if declared else 0 :])
    rows = csv.reader(islice(lines, first, None), delimiter=separator)
    with suppress(csv.Error):  # a cell is too long
        yield from ((first + rows.line_num, len(row)) for row in rows if len(row) > 1 or "".join(row).strip())


def _longer_row(content: bytes, separator: str) -> str:
    """Return an error message for the first row with more cells than the header; "" if none has."""
    rows = _cells(content, separator)
    first, width = next(rows, (0, 0))
    return next(
        (
            f"line {line} has {size} cells and the header in line {first} has {width}; correct the line, quote a cell "
            f"that holds {separator!r}, or, if lines above the header describe the data, begin them with #"
            for line, size in rows
            if size > width
        ),
        "",
    )


def _warn_of_shorter_rows(content: bytes, separator: str) -> None:
    """Warn of rows with fewer cells than the header."""
    rows = _cells(content, separator)
    _, width = next(rows, (0, 0))
    short = [(line, size) for line, size in rows if size < width]
    if short:
        line, size = short[0]
        warnings.warn(
            f"rows with fewer cells than the header: {len(short)}, the first in line {line}, {size} of {width}; their "
            "last cells are read as missing",
            stacklevel=5,
        )


def _without_empty_end(frame: Any, content: bytes) -> Any:
    """Drop empty rows at the end, as spreadsheets write them, and warn of skipped lines."""
    if frame.shape[1] == 1 and BLANK.search(content.strip()):
        warnings.warn(
            "empty lines between the values of a single column are skipped; write NaN where a value is missing",
            stacklevel=5,
        )
    nonempty = np.flatnonzero(frame.notna().any(axis=1))
    end = int(nonempty[-1]) + 1 if len(nonempty) else 0
    if end and end < len(frame):
        warnings.warn(f"{len(frame) - end} empty rows at the end are left out", stacklevel=5)
        frame = frame.iloc[:end]
    return frame


def _rows(head: str, separator: str) -> Iterator[list[str]]:
    return csv.reader(StringIO(head, newline=None), delimiter=separator)


def _header(head: str, separator: str) -> list[str]:
    """Return the first row that is neither empty nor a comment."""
    with suppress(csv.Error):  # an unterminated field, with a wrong separator
        return next((row for row in _rows(head, separator) if row and not row[0].lstrip().startswith("#")), [])
    return []


def _comments(content: bytes) -> int:
    """Return the number of lines before the header that start with #."""
    lines = iter(content[:LARGEST_SCHEMA].splitlines())
    return sum(1 for _ in takewhile(lambda line: line.lstrip().startswith(b"#"), lines))


def _read_parquet(content: bytes) -> Any:
    """Return a Parquet file as a frame, with its flat columns and, if named, the index that pandas stored."""
    import pyarrow
    from pyarrow import compute, parquet

    types = pyarrow.types
    file = parquet.ParquetFile(BytesIO(content))
    rows, columns = file.metadata.num_rows, file.metadata.num_columns
    if columns > MOST:
        raise ValueError(f"it has {columns} columns; at most {MOST} are read")
    sizes = [file.metadata.row_group(n).total_byte_size for n in range(file.metadata.num_row_groups)]
    _refuse_large(max(sum(sizes), 8 * rows * columns))  # repeated values are compressed
    flat = [field for field in file.schema_arrow if not types.is_nested(field.type)]
    if nested := [field.name for field in file.schema_arrow if types.is_nested(field.type)]:
        warnings.warn(f"columns of lists or records are left out: {', '.join(nested)}", stacklevel=2)
    text_columns = [field.name for field in flat if types.is_string(field.type) or types.is_large_string(field.type)]
    names = [field.name for field in flat if not re.fullmatch(r"__index_level_\d+__", field.name)]
    table = parquet.ParquetFile(BytesIO(content), read_dictionary=text_columns).read(names, use_threads=False)
    table.validate(full=True)  # checks that texts are valid
    for index, field in enumerate(table.schema):
        column = table.column(index)
        if types.is_dictionary(field.type) and types.is_string(field.type.value_type):
            lengths = (compute.take(compute.binary_length(chunk.dictionary), chunk.indices) for chunk in column.chunks)
            _refuse_large(sum(compute.sum(chunk).as_py() or 0 for chunk in lengths))
        if field.name in text_columns:
            table = table.set_column(index, field.name, column.cast(field.type.value_type))
        elif types.is_decimal(field.type):
            table = table.set_column(index, field.name, column.cast(pyarrow.float64()))
    return table.to_pandas(ignore_metadata=True)


def _refuse_large(size: int) -> None:
    if size > LARGEST:
        raise ValueError(f"it holds {size} bytes; at most {LARGEST} are read")


def _read_npz(path: Path, content: bytes) -> Any:
    """Return an npz as a frame."""
    import pandas as pd

    try:
        arrays = npz_arrays(BytesIO(content), LARGEST, ("x", "lengths"))
    except NpyError as error:
        raise ValueError(f"{path} {error}") from error
    name = next((name for name in ("x", *arrays) if name in arrays and name != "lengths"), None)
    if name is None:
        raise ValueError(f"{path} must have an array 'x', or a single array")
    values = arrays[name]
    if values.ndim not in (2, 3) or values.dtype.kind not in "fiub" or not values.size:
        raise ValueError(
            f"{name!r} of {path} is {values.dtype} {values.shape}; expected numbers (sequences, steps, columns)"
        )
    _refuse_large(8 * values.size)
    values = values if values.ndim == 3 else values[None]
    if values.shape[2] > MOST:
        raise ValueError(f"{name!r} of {path} has {values.shape[2]} columns; at most {MOST} are read")
    longest = values.shape[1]
    lengths = arrays.get("lengths", np.full(len(values), longest))
    is_integer = lengths.shape == (len(values),) and lengths.dtype.kind in "iu"
    if not is_integer or not ((lengths >= 1) & (lengths <= longest)).all():
        raise ValueError(f"'lengths' of {path} are {lengths.shape}; expected whole numbers (N,) from 1 to {longest}")
    valid = np.arange(longest) < lengths[:, None]
    frame = pd.DataFrame(values[valid].astype(np.float64), columns=[f"x{n}" for n in range(values.shape[2])])
    sequence, step = np.nonzero(valid)
    return frame.assign(sequence=sequence, step=step)


def read_panel(path: str | os.PathLike[str], columns: Columns | ColumnHints | None = None) -> Panel:
    """Return the sequences of a file, or of a data set of `dvae.tables.domains`.

    Args:
        path: path of a file or of a folder of npy files, or name of a data set.
        columns: a schema, or roles given by the user; the rest is inferred.

    Raises:
        FileNotFoundError: if the file does not exist.
        ValueError: if the file is not a table or does not have the columns.
    """
    name = os.fspath(path)
    if is_domain(name):
        panel = domain(name)
        if columns not in (None, ColumnHints(), panel.columns):
            raise ValueError(f"{name} has fixed columns, {', '.join(panel.columns.names[:10])}, …; give no others")
        return panel
    if is_of_arrays(path):
        return _read_mapped(Path(path), columns)
    return Panel.of(read_frame(path), columns, Path(path).stem)


def is_of_arrays(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is an npy file or a folder."""
    return Path(path).suffix.lower() == ".npy" or Path(path).is_dir()


def _read_mapped(path: Path, columns: Columns | ColumnHints | None) -> Panel:
    """Return the sequences of npy files with shape (steps, columns) or (sequences, steps, columns).

    Sequences of a folder have the names of their files. The file train.npy and files in the subfolder train belong to
    that split; other splits work alike.
    """
    entries = [("", path.stem, path)]
    if path.is_dir():
        tables = (file for file in _files(path) if file.suffix.lower() in (".npy", *SUFFIXES))
        files_in = sorted(islice(tables, MOST_FILES + 1))
        if others := [file for file in files_in if file.suffix.lower() != ".npy"]:
            raise ValueError(
                f"{path} holds {others[0].relative_to(path)} in addition to npy files; a folder must have npy files "
                "only, so convert it to npy, or move it elsewhere"
            )
        if not 0 < len(files_in) <= MOST_FILES:
            count = f"more than {MOST_FILES:,}" if files_in else "none"
            raise ValueError(f"{path} must have npy files, from 1 to {MOST_FILES:,}; it has {count}")
        names = [file.relative_to(path).with_suffix("").as_posix() for file in files_in]
        splits = (name.partition("/")[0] for name in names)
        entries = list(zip((split if split in SPLITS else "" for split in splits), names, files_in, strict=True))
    series = []
    for split, name, file in entries:
        values = mapped(file, links=file is path)
        if values.ndim not in (2, 3) or values.shape[-1] > MOST:
            raise ValueError(
                f"{file} has shape {values.shape}; expected (steps, columns), or (sequences, steps, columns), of at "
                f"most {MOST} columns{'; a single one is (steps, 1)' if values.ndim == 1 else ''}"
            )
        parts = [(name, values)] if values.ndim == 2 else [(f"{name}/{n}", array) for n, array in enumerate(values)]
        series += [Series(label, array, split=split) for label, array in parts]
    return Panel(series, plain_columns(columns, series[0].values.shape[1]), path.stem)


def _files(root: Path) -> Iterator[Path]:
    return (Path(folder, name) for folder, _, names in os.walk(root) for name in names)


def is_domain(name: str) -> bool:
    """Return whether a path is a name of `dvae.tables.domains` and not an existing file."""
    return name in DOMAINS and not Path(name).exists()


def schema_beside(path: str | os.PathLike[str]) -> tuple[Columns | ColumnHints | None, Cut | None]:
    """Return columns and cut of the schema file next to a file, as in `read_schema`; (None, None) without a file.

    Raises:
        ValueError: if the schema is invalid; the message names its file.
    """
    table = Path(path)
    inside = [table / "schema.toml"] if table.is_dir() else []
    for file in (*inside, table.with_suffix(".toml"), table.parent / "schema.toml"):
        if file.is_file():
            try:
                return read_schema(files.read(file, LARGEST_SCHEMA, links=True).decode())
            except (UnicodeDecodeError, ValueError, TypeError) as error:
                raise ValueError(f"{file} is not a valid schema of a table: {error}") from error
    return None, None


def read_schema(text: str) -> tuple[Columns | ColumnHints | None, Cut | None]:
    """Return columns (`ColumnHints` if the schema does not list them all) and cut; None for a missing part."""
    entries = parsed(text)
    cut = entries.pop("cut", None)
    if cut is not None:
        if not isinstance(cut, dict):
            raise ValueError(f"cut is {cut!r:.100}; expected a table, [cut]")
        allowed = [field.name for field in fields(Cut)]
        for name in cut:
            if name not in allowed:
                raise ValueError(
                    f"[cut] has an entry {name!r}{nearest(name, allowed)}; known entries: {', '.join(allowed)}"
                )
    columns = (
        Columns.from_config(entries) if "columns" in entries else ColumnHints(**layout(entries)) if entries else None
    )
    return columns, None if cut is None else Cut(**cut)


def written_schema(columns: Columns, cut: Cut) -> str:
    """Return a schema as an editable TOML file."""
    comments = [
        "# role: target (default; modelled), known (covariate, known in the future), past (covariate, known up to the",
        "# present) or static (one value per sequence)",
        *textwrap.wrap(
            f"family of a target: {', '.join(FAMILIES)}; of other columns: real, category",
            width=110,
            initial_indent="# ",
            subsequent_indent="# ",
        ),
    ]
    entries = {name: value for name, value in asdict(cut).items() if value != getattr(Cut, name)}
    lines = [
        "[cut]",
        f'split = "{entries.pop("split", cut.split)}"',
        *(f"{name} = {value}" for name, value in entries.items()),
    ]
    return "\n".join([*comments, "", columns.to_toml()]) + "\n" + "\n".join(lines) + "\n"
