"""Scores of tables: in the unit of the columns where they share one, and of numbers without unit where they do not."""

import numpy as np
import pytest
import torch

import dvae
from dvae.inference import metrics
from dvae.inference.scores import proper
from dvae.tables import Column, Columns, Cut, PanelData, panel_scores

UNITS = {"shared": ("m", "m"), "mixed": ("people", "°C"), "unsaid": ("", "")}


def table(units, factor=1.0, columns=2):
    """Two columns, the second so many times as large."""
    x = np.random.default_rng(0).normal(5, 2, (8, 12, 2)) * [1.0, factor]
    told = tuple(Column(name, unit=unit) for name, unit in zip("ab", units, strict=True))
    return PanelData.of(x[..., :columns], Columns(told[:columns]), Cut(6, 3)).windows("test")


def of(windows):
    """Scores of forecasts that are the same in the scales of the columns."""
    torch.manual_seed(0)
    truth = windows.all()["x"][:, 6:]
    scales = torch.tensor(windows.description["scales"]).float()
    forecasts = truth[:, None] + scales * torch.randn(len(truth), 50, 3, truth.shape[-1])
    past = {"x": windows.all()["x"][:, :6]}
    found = {m.name: m for m in panel_scores(windows)}
    return forecasts, truth, {n: m.function(forecasts, truth, past, torch.arange(len(truth))) for n, m in found.items()}


@pytest.mark.parametrize("which", ["mixed", "unsaid"])
def test_a_score_of_columns_that_share_no_unit_does_not_depend_on_their_units(which):
    windows = table(UNITS[which])
    forecasts, truth, first = of(windows)
    *_, second = of(table(UNITS[which], factor=1000.0))
    for name in ("energy score", "variogram score", "CRPS", "width 90 %"):
        torch.testing.assert_close(first[name], second[name], rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(second["CRPS, b"], 1000 * first["CRPS, b"], rtol=1e-3, atol=1e-4)
    scales = torch.tensor(windows.description["scales"])
    torch.testing.assert_close(first["energy score"], metrics.energy_score(forecasts / scales, truth / scales))
    units = {measure.name: measure.unit for measure in panel_scores(windows)}
    assert (units["energy score"], units["CRPS"], units["width 90 %"]) == ("scales",) * 3
    assert (units["CRPS, a"], units["coverage 50 %"]) == (UNITS[which][0], "share")
    assert "in the scales of their columns" in proper(windows)[0].note


def test_a_score_of_columns_that_share_a_unit_is_in_it():
    windows = table(UNITS["shared"])
    forecasts, truth, found = of(windows)
    torch.testing.assert_close(found["energy score"], metrics.energy_score(forecasts, truth))
    assert {measure.unit for measure in proper(windows)} == {"m"}


def test_one_column_has_no_dependence_to_score():
    windows = table(("m", "m"), columns=1)
    assert [measure.name for measure in proper(windows)] == ["energy score", "CRPS"]
    assert [measure.name for measure in proper(dvae.ArrayWindows(torch.zeros(3, 4, 1), 2))] == ["energy score", "CRPS"]
    assert len(proper(dvae.ArrayWindows(torch.zeros(3, 4, 2), 2))) == 3


def test_a_comparison_has_the_scores_of_an_evaluation():
    windows = table(UNITS["mixed"])
    model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2})
    how = {"scores": panel_scores, "samples": 39, "draw_emission": True, "progress": False}
    scores = dvae.evaluate({"model": model}, windows, **how)
    found = dvae.compare({"model": model}, windows, particles=2, contrasts=0, **how)
    free = {name: metric for name, metric in scores.metrics.items() if metric.program == "free-running"}
    assert found.shown == {name: metric.unit for name, metric in free.items()}
    assert {name: scores["model"][name].mean for name in free} == {name: found["model"][name].mean for name in free}
    again = type(found).from_json(found.to_json())
    for text in (str(found), str(again)):
        assert "coverage 80 % (share)" in text
        assert "CRPS, a ↓ (people)" in text
        assert "windows of 2 sequences" in text
