"""The script of the domains page, on little data: it resumes, and its tables contain the finished runs."""

import json

import numpy as np
import pytest
import torch

from benchmarks.studies import domains, engine
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
def page(tmp_path, monkeypatch):
    monkeypatch.setattr(torch, "set_num_threads", lambda number: None)  # the script sets one thread
    monkeypatch.setitem(tables.domains.DOMAINS, "tiny", tables.domains.DOMAINS["chorales"])
    monkeypatch.setattr(reading, "domain", lambda name: panel())
    section = domains.Section(CASES, SMALL, Cut(4, 2), unit="day", particles=5)
    monkeypatch.setattr(domains, "SECTIONS", {"tiny": section})
    monkeypatch.setattr(domains, "FORECASTS", 40)
    path = tmp_path / "page.md"
    path.write_text("Before.\n<!-- tables -->\n<!-- end of tables -->\nAfter.\n")
    return path


def test_the_domains_page_contains_the_finished_runs(page, tmp_path, capsys):
    runs = tmp_path / "runs"
    domains.main(("tiny",), runs, page, "validation", seeds=(0, 1))
    text = page.read_text()
    for text_part in ("Before.\n", "### Tiny, validation", "2 sequences, 31 steps; 2 seeds", "nats a day"):
        assert text_part in text
    assert text.count("| dkf |") == 1
    modified = {path: path.stat().st_mtime_ns for path in runs.rglob("*")}
    capsys.readouterr()
    domains.main(("tiny",), runs, page, "validation", seeds=(0, 1))
    assert {path: path.stat().st_mtime_ns for path in runs.rglob("*")} == modified
    assert page.read_text() == text
    assert not capsys.readouterr().out
    for case, has_references in (
        ("dkf", False),
        (domains.BASELINE, True),
    ):  # the file of the baseline has the references
        domains.main(("tiny",), runs, page, "test", (case,))
        assert "3 sequences, 54 steps; 1 seeds" in page.read_text()
        assert page.read_text().count("| dkf |") == 2
        assert ("climatology" in page.read_text()) == has_references


def test_bounds_are_per_step_with_standard_errors_over_sequences(page, tmp_path):
    domains.main(("tiny",), tmp_path, page, "validation", (domains.BASELINE,), (0, 1))
    folders = [tmp_path / "tiny" / f"{domains.BASELINE}-{seed}" for seed in (0, 1)]
    stored = [json.loads((folder / "validation.json").read_text())["bounds"] for folder in folders]
    steps = np.array([15.0, 16.0])
    assert stored[0]["weights"] == steps.tolist()
    bounds = np.array([run_bounds["rows"][engine.OURS][domains.BOUND] for run_bounds in stored])
    expected = TwoWayErrors.of(bounds, steps).estimate()
    results = engine.read(tmp_path / "tiny", [domains.BASELINE], "validation.json")[domains.BASELINE]
    assert results.of("bounds").estimate(domains.BOUND) == expected
    assert expected.mean == pytest.approx((bounds * steps).sum() / 62)
    assert domains.said(results, "bounds", domains.BOUND) == str(expected)
