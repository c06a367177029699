"""The study of missing entries, on a small table: its scores, its simple row, and its results."""

import numpy as np
import pytest
import torch

from benchmarks.studies import imputation, results
from dvae.tables import Column, Columns, Cut, Panel, PanelData, Series

TRAINING = {"steps": 2, "batch_size": 4, "validate_every": 2}
CASES = {"srnn": {"options": {"latent": 2, "width": 4, "warm_up": 1, "hide": 0.2}}}


def table():
    random = np.random.default_rng(0)
    values = np.exp(random.normal(0, 1, (6, 40, 1)).cumsum(1) / 3)
    values[:, ::9] = np.nan
    return PanelData.of(
        Panel([Series(f"s{n}", x) for n, x in enumerate(values)], Columns((Column("a", family="log-normal"),)), "tiny"),
        cut=Cut(6, 2, split="time"),
    )


@pytest.fixture
def out(tmp_path, monkeypatch):
    data = table()
    monkeypatch.setattr(torch, "set_num_threads", lambda number: None)  # the script sets one thread
    monkeypatch.setattr(imputation, "load", lambda name: data)
    monkeypatch.setattr(imputation, "DRAWS", 10)
    monkeypatch.setattr(imputation, "SECTIONS", {"tiny": {"training": TRAINING, "cases": CASES}})
    yield tmp_path
    for function in (imputation.hidden_entries, imputation.units):
        function.cache_clear()


def test_the_scores_are_those_of_hidden_entries_alone():
    truth = torch.tensor([[[0.0], [9.0]], [[1.0], [9.0]]]).double()
    hidden = torch.tensor([[[True], [False]], [[True], [False]]])
    draws = torch.tensor([[0.0], [2.0]]).expand(2, 2)[:, :, None, None].expand(2, 2, 2, 1).double()
    found = imputation.scores(draws, truth, hidden, ["a", "b"])
    assert found["CRPS"] == pytest.approx([0.0, 0.0])  # mean distance 1 to the draws, minus half their distance 2
    assert found[imputation.COVERAGE] == [0.0, 1.0]
    assert imputation.scores(draws, truth, hidden, ["a", "a"])[imputation.COVERAGE] == [0.5]


def test_hidden_values_do_not_change_what_is_filled_in(out, monkeypatch):
    batch, hidden, _ = imputation.hidden_entries("tiny", "test")
    assert not (hidden & batch["mask"]).any()
    assert 0.1 < hidden.double().mean() < 0.3
    filled = imputation.interpolated("tiny", "test")
    truth, mask, _, sequences = imputation.truth_of("tiny", "test")
    changed = torch.where(hidden, truth + 100, truth)
    train = imputation.truth_of("tiny", "train")
    parts = {"test": (changed, mask, hidden, sequences), "train": train}
    monkeypatch.setattr(imputation, "truth_of", lambda name, part: parts[part])
    assert torch.equal(imputation.interpolated("tiny", "test"), filled)


def test_the_study_resumes_and_compares_with_interpolation(out, monkeypatch):
    options = {"names": ("tiny",), "runs": out / "runs", "results": out / "results", "part": "test"}
    imputation.main(**options, seeds=(0, 1))
    written = results.read("tables/imputation", out / "results")
    assert written.header == ["", "tiny, CRPS", "tiny, coverage 90 %"]
    assert {row[0] for row in written.rows} == {"srnn", imputation.LINEAR}
    assert "2 seeds" in written.note

    def refuse(*_, **__):
        raise AssertionError("a finished run was fitted again")

    monkeypatch.setattr(imputation, "run", refuse)
    imputation.main(**options, seeds=(0, 1))
