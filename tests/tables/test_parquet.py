"""Parquet files, if pyarrow is installed: read like CSV, and an error if too large for memory."""

import datetime
import io
from decimal import Decimal

import numpy as np
import pytest

from dvae.cli import main
from dvae.tables import Panel, reading
from dvae.tables.columns import MOST
from dvae.tables.reading import read_frame, read_panel

pd = pytest.importorskip("pandas")
pa = pytest.importorskip("pyarrow", reason="pyarrow, which reads Parquet, is not installed")
parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow, which reads Parquet, is not installed")


def put(path, columns, **options):
    parquet.write_table(columns if isinstance(columns, pa.Table) else pa.table(columns), path, **options)
    return path


def test_every_type_of_column_is_read_as_from_csv(tmp_path):
    days = [datetime.date(2024, 1, 1) + datetime.timedelta(n) for n in range(30)]
    columns = {
        "day": days,
        "price": [Decimal(n) / 4 for n in range(30)],
        "riders": [None, *range(29)],
        "open": [True, None, False] * 10,
        "sky": ["clear", "rain", None] * 10,
        "half": pa.array(np.arange(-15, 15, dtype=np.float16) / 8),
        "kind": pa.array(["a", "b"] * 15).dictionary_encode(),
        "seen": pa.array([[1, 2]] * 30),
    }
    with pytest.warns(UserWarning, match="columns of lists or records are left out: seen"):
        from_parquet = read_panel(put(tmp_path / "a.parquet", columns))
    frame = pd.DataFrame({name: list(map(str, days)) if name == "day" else values for name, values in columns.items()})
    frame = frame.drop(columns="seen").assign(kind=["a", "b"] * 15, half=np.arange(-15, 15, dtype=np.float16) / 8)
    frame.to_csv(tmp_path / "a.csv", index=False)
    from_csv = read_panel(tmp_path / "a.csv")
    assert from_parquet.columns == from_csv.columns
    np.testing.assert_allclose(from_parquet.series[0].values, from_csv.series[0].values, rtol=1e-6)
    np.testing.assert_array_equal(from_parquet.series[0].times, from_csv.series[0].times)


@pytest.mark.parametrize("convert", [str, pd.Timestamp])
def test_a_named_index_is_a_column(tmp_path, convert):
    days = [convert(f"2024-01-{n:02}") for n in range(1, 31)]
    frame = pd.DataFrame({"riders": np.arange(30.0) + 0.5}, index=pd.Index(days, name="day"))
    frame.to_parquet(tmp_path / "a.parquet")
    panel = read_panel(tmp_path / "a.parquet")
    assert panel.columns.time == "day"
    np.testing.assert_array_equal(panel.series[0].times, Panel.of(frame.reset_index()).series[0].times)
    frame.reset_index(drop=True)[5:].to_parquet(tmp_path / "b.parquet")
    assert read_frame(tmp_path / "b.parquet").columns.tolist() == ["riders"]
    frame.set_axis(np.roll(range(30), 3)).to_parquet(tmp_path / "c.parquet")
    assert read_frame(tmp_path / "c.parquet").columns.tolist() == ["riders"]


BOMBS = {
    "numbers that repeat": {"x": pa.array(np.zeros(10**6))},
    "texts that repeat": {"x": pa.array(["long" * 1000] * 10**4)},
    "zipped": {"x": pa.array([bytes(10**4)] * 200)},
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_small_file_that_is_large_in_memory_is_an_error(tmp_path, monkeypatch, name):
    path = put(tmp_path / "a.parquet", BOMBS[name], compression="zstd", use_dictionary=name != "zipped")
    assert path.stat().st_size < 20_000
    read_frame(path)
    monkeypatch.setattr(reading, "LARGEST", 10**6)
    with pytest.raises(ValueError, match=r"a.parquet cannot be read as PARQUET: it holds \d+ bytes; at most 1000000"):
        read_frame(path)


def test_too_many_columns_and_other_content_are_an_error(tmp_path):
    (tmp_path / "b.parquet").write_bytes(b"PAR1 is none")
    with pytest.raises(ValueError, match=r"b.parquet cannot be read as PARQUET"):
        read_frame(tmp_path / "b.parquet")
    path = put(tmp_path / "a.parquet", {f"x{n}": [1.0] for n in range(MOST + 1)})
    with pytest.raises(ValueError, match=f"it has {MOST + 1} columns; at most {MOST} are read"):
        read_frame(path)


def test_corrupted_files_are_read_or_an_error(tmp_path):
    rng, buffer, n_errors = np.random.default_rng(0), io.BytesIO(), 0
    put(buffer, {"day": list(range(40)), "y": rng.normal(size=40), "sky": ["clear", "rain"] * 20}, compression="zstd")
    content = buffer.getvalue()
    for _ in range(200):
        changed = bytearray(content)
        for index in rng.integers(4, len(content) - 4, rng.integers(1, 4)):
            changed[index] = rng.integers(256)
        (tmp_path / "a.parquet").write_bytes(changed)
        try:
            read_panel(tmp_path / "a.parquet")
        except ValueError:
            n_errors += 1
    assert 0 < n_errors < 200


def test_the_command_line_reads_and_writes_parquet(tmp_path, capsys):
    rng = np.random.default_rng(0)
    frame = pd.DataFrame({"station": np.repeat(list("abcdef"), 20), "day": np.tile(np.arange(20), 6)})
    frame = frame.assign(y=pd.Series(rng.normal(size=120)).mask(rng.random(120) < 0.1))
    path, run = tmp_path / "a.parquet", str(tmp_path / "run")
    frame.to_parquet(path)
    assert main(["data", "info", str(path)]) == 0
    assert "6 sequences of 20 steps" in capsys.readouterr().out
    cut = ["--observed", "5", "--horizon", "3", "--split", "sequence", "--steps", "1"]
    assert main(["fit", "autoregressive", "--data", str(path), "--out", run, *cut]) == 0
    for command, count in (("forecast", 6 * 3), ("impute", frame.y.isna().sum())):
        for end in ("parquet", "csv"):
            assert main([command, run, "--out", str(tmp_path / f"{command}.{end}")]) == 0
        from_parquet, from_csv = (reader(tmp_path / f"{command}.{end}") for reader, end in READERS)
        assert len(from_parquet) >= count
        assert from_parquet.columns.tolist() == from_csv.columns.tolist()
        np.testing.assert_allclose(from_parquet["q500"], from_csv["q500"], rtol=1e-6)


READERS = ((pd.read_parquet, "parquet"), (pd.read_csv, "csv"))
