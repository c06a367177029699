"""The study of public tables, on a small table: it resumes, and its results contain the finished runs."""

import numpy as np
import pytest
import torch

from benchmarks.studies import results, tables
from dvae.tables import Column, Columns, Cut, Panel, PanelData, Series

TRAINING = {"steps": 2, "batch_size": 4, "validate_every": 2, "select": "forecast"}
CASES = {
    tables.REFERENCES: {"options": {"width": 4, "units": "series"}},
    "srnn": {"options": {"latent": 2, "width": 4, "warm_up": 1, "units": "changes"}, "training": {"steps": 1}},
}


@pytest.fixture
def out(tmp_path, monkeypatch):
    random = np.random.default_rng(0)
    series = [Series(f"s{n}", random.normal(10 * n, 1, (40, 1)).cumsum(0)) for n in range(5)]
    data = PanelData.of(Panel(series, Columns((Column("a"),)), "tiny"), cut=Cut(6, 2, split="time"))
    monkeypatch.setattr(torch, "set_num_threads", lambda number: None)  # the script sets one thread
    monkeypatch.setattr(tables, "load", lambda name: data)
    monkeypatch.setattr(tables, "FORECASTS", 10)
    monkeypatch.setattr(tables, "SECTIONS", {"tiny": {"training": TRAINING, "chosen": "srnn", "cases": CASES}})
    return tmp_path


def test_the_study_resumes_and_compares_with_the_best_simple_forecast(out, monkeypatch):
    options = {"names": ("tiny",), "runs": out / "runs", "results": out / "results", "part": "test"}
    tables.main(**options, seeds=(0, 1))
    detail = results.read("tables/tiny", out / "results")
    names = [name for name, *_ in detail.rows]
    assert {"srnn", tables.REFERENCES, "last value", "drift", "AR", "climatology by series"} <= {*names}
    scores = [float(row[1].split(" ± ")[0]) for row in detail.rows]
    assert scores == sorted(scores)
    summary = results.read("tables/summary", out / "results")
    ((name, best, chosen, skill, _),) = summary.rows
    simple = [row for row in names if row not in CASES]
    assert (name, best, chosen) == ("tiny", simple[0], "srnn")
    crps = dict(zip(names, scores, strict=True))
    assert float(skill.split(" ± ")[0]) == pytest.approx(1 - crps["srnn"] / crps[best], abs=0.01)

    def refuse(*_, **__):
        raise AssertionError("a finished run was fitted again")

    monkeypatch.setattr(tables, "run", refuse)
    tables.main(**options, seeds=(0, 1))
