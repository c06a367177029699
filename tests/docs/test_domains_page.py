"""The study of other data, on little data: it resumes, and its tables contain the finished runs."""

import json

import numpy as np
import pytest
import torch

from benchmarks.studies import domains, engine, results
from dvae import tables
from dvae.inference.evaluation.estimates import TwoWayErrors
from dvae.tables import Column, Columns, Panel, Series, reading
from dvae.tables.protocol import Cut

CASES = {
    domains.BASELINE: {"options": {"width": 4, "hidden": ()}},
    "dkf": {"options": {"latent": 2, "width": 4, "warm_up": 1}},
}
SMALL = {"steps": 2, "batch_size": 4, "validate_every": 2}


def panel():
    rng = np.random.default_rng(0)
    parts = ["train"] * 6 + ["validation"] * 2 + ["test"] * 3
    columns = Columns((Column("a", family="power"), Column("b", family="count")))
    series = [
        Series(f"s{n}", np.stack([rng.gamma(1, 1, 9 + n), rng.poisson(3, 9 + n)], 1), split=part)
        for n, part in enumerate(parts)
    ]
    return Panel(series, columns, "tiny")


@pytest.fixture
def out(tmp_path, monkeypatch):
    monkeypatch.setattr(torch, "set_num_threads", lambda number: None)  # the script sets one thread
    monkeypatch.setitem(tables.domains.DOMAINS, "tiny", tables.domains.DOMAINS["chorales"])
    monkeypatch.setattr(reading, "domain", lambda name: panel())
    section = domains.Section(CASES, SMALL, Cut(4, 2), unit="day", particles=5)
    monkeypatch.setattr(domains, "SECTIONS", {"tiny": section})
    monkeypatch.setattr(domains, "FORECASTS", 40)
    return tmp_path / "results"


def test_the_tables_contain_the_finished_runs(out, tmp_path, capsys):
    runs = tmp_path / "runs"
    domains.main(("tiny",), runs, out, "validation", seeds=(0, 1))
    bounds = results.read("domains/tiny-bounds", out)
    assert bounds.note.startswith("Validation: 2 sequences, 31 steps; 2 seeds")
    assert bounds.header[1].startswith("nats a day")
    assert {row[0] for row in bounds.rows} == {"dkf", domains.BASELINE}
    modified = {path: path.stat().st_mtime_ns for path in runs.rglob("*")}
    capsys.readouterr()
    domains.main(("tiny",), runs, out, "validation", seeds=(0, 1))
    assert {path: path.stat().st_mtime_ns for path in runs.rglob("*")} == modified
    assert results.read("domains/tiny-bounds", out) == bounds
    assert not capsys.readouterr().out
    for case, has_references in (
        ("dkf", False),
        (domains.BASELINE, True),
    ):  # the file of the baseline has the references
        domains.main(("tiny",), runs, out, "test", (case,))
        assert results.read("domains/tiny-bounds", out).note.startswith("Test: 3 sequences, 54 steps; 1 seeds")
        names = {row[0] for row in results.read("domains/tiny-forecasts", out).rows}
        assert "dkf" in names
        assert ("climatology" in names) == has_references


def test_bounds_are_per_step_with_standard_errors_over_sequences(out, tmp_path):
    domains.main(("tiny",), tmp_path, out, "validation", (domains.BASELINE,), (0, 1))
    folders = [tmp_path / "tiny" / f"{domains.BASELINE}-{seed}" for seed in (0, 1)]
    stored = [json.loads((folder / "validation.json").read_text())["bounds"] for folder in folders]
    steps = np.array([15.0, 16.0])
    assert stored[0]["weights"] == steps.tolist()
    bounds = np.array([run_bounds["rows"][engine.OURS][domains.BOUND] for run_bounds in stored])
    expected = TwoWayErrors.of(bounds, steps).estimate()
    rows = engine.read(tmp_path / "tiny", [domains.BASELINE], "validation.json")[domains.BASELINE]
    assert rows.of("bounds").estimate(domains.BOUND) == expected
    assert expected.mean == pytest.approx((bounds * steps).sum() / 62)
    assert domains.score_cell(rows, "bounds", domains.BOUND) == str(expected)
