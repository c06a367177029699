"""Scores of tables: in the common unit of the columns, or of scaled values if units differ."""

import numpy as np
import pytest
import torch

import dvae
from dvae.inference.evaluation import metrics
from dvae.inference.evaluation.scores import proper
from dvae.tables import Column, Columns, Cut, PanelData, panel_scores

UNITS = {"shared": ("m", "m"), "mixed": ("people", "°C"), "unsaid": ("", "")}


def table(units, factor=1.0, columns=2, mean=0.0):
    """Two columns; the second is scaled by `factor` and shifted by `mean`."""
    x = np.random.default_rng(0).normal(5, 2, (8, 12, 2)) * [1.0, factor] + [0.0, mean]
    specs = tuple(Column(name, unit=unit) for name, unit in zip("ab", units, strict=True))
    return PanelData.of(x[..., :columns], Columns(specs[:columns]), Cut(6, 3)).windows("test")


def scores_of(windows):
    """Return forecasts whose scaled values do not depend on units, the truth and the scores."""
    torch.manual_seed(0)
    truth = windows.all()["x"][:, 6:]
    scales = torch.tensor(windows.description["scales"]).float()
    forecasts = truth[:, None] + scales * torch.randn(len(truth), 50, 3, truth.shape[-1])
    past = {"x": windows.all()["x"][:, :6]}
    measures = {m.name: m for m in panel_scores(windows)}
    return (
        forecasts,
        truth,
        {n: m.function(forecasts, truth, past, torch.arange(len(truth))) for n, m in measures.items()},
    )


@pytest.mark.parametrize("units", ["mixed", "unsaid"])
def test_scores_of_columns_with_different_units_do_not_depend_on_the_units(units):
    windows = table(UNITS[units])
    forecasts, truth, first = scores_of(windows)
    *_, second = scores_of(table(UNITS[units], factor=1000.0, mean=1e9))
    for name in ("energy score", "variogram score", "CRPS", "width 90 %"):
        torch.testing.assert_close(first[name], second[name], rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(second["CRPS, b"], 1000 * first["CRPS, b"], rtol=1e-3, atol=1e-4)
    scales = torch.tensor(windows.description["scales"])
    torch.testing.assert_close(first["energy score"], metrics.energy_score(forecasts / scales, truth / scales))
    measure_units = {measure.name: measure.unit for measure in panel_scores(windows)}
    assert (measure_units["energy score"], measure_units["CRPS"], measure_units["width 90 %"]) == ("scales",) * 3
    assert (measure_units["CRPS, a"], measure_units["coverage 50 %"]) == (UNITS[units][0], "share")
    assert "divide each column by its scale" in proper(windows)[0].note


def test_scores_of_columns_with_one_unit_are_in_that_unit():
    windows = table(UNITS["shared"])
    forecasts, truth, scores = scores_of(windows)
    torch.testing.assert_close(scores["energy score"], metrics.energy_score(forecasts, truth))
    assert {measure.unit for measure in proper(windows)} == {"m"}


def dependent(windows):
    """An autoregressive model of two columns."""
    torch.manual_seed(0)
    return dvae.method("autoregressive", width=4).build(windows.schema).eval()


def test_statistics_of_columns_with_different_units_do_not_depend_on_the_units():
    first, second = (
        dvae.predictive_checks(dependent(windows), windows, samples=19, progress=False)
        for windows in (table(UNITS["mixed"]), table(UNITS["mixed"], factor=1024.0))
    )
    for key, check in first.checks.items():
        np.testing.assert_allclose(second[key].real, check.real, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(second[key].replicated, check.replicated, rtol=1e-4, atol=1e-4)
    units = {name: check.unit for (_, _, name), check in first.checks.items()}
    assert [units[name] for name in ("mean", "scale", "roughness", "smallest", "largest")] == ["scales"] * 5
    assert (units["correlation length"], units["lag-1 correlation"], units["zeros"]) == ("steps", "", "share")
    assert "statistics over all columns divide each column by its scale" in " ".join(str(first).split())


def test_a_model_without_latents_has_no_posterior_checks():
    windows = table(UNITS["shared"])
    latent = dvae.method("vae", latent=2, warm_up=1).build(windows.schema).eval()
    both = {"plain": dependent(windows), "latent": latent}
    checks = dvae.predictive_checks(both, windows, samples=19, progress=False)
    programs = {(model, program) for model, program, _ in checks.checks}
    assert programs == {("plain", "forecast"), ("latent", "forecast"), ("latent", "posterior")}
    assert "posterior: free-running given latents" in str(checks)
    figure = checks.plot()
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["real", "plain", "latent"]


def test_a_single_column_has_no_variogram_score():
    windows = table(("m", "m"), columns=1)
    assert [measure.name for measure in proper(windows)] == ["energy score", "CRPS"]
    assert [measure.name for measure in proper(dvae.ArrayWindows(torch.zeros(3, 4, 1), 2))] == ["energy score", "CRPS"]
    assert len(proper(dvae.ArrayWindows(torch.zeros(3, 4, 2), 2))) == 3


def test_a_comparison_has_the_scores_of_an_evaluation():
    windows = table(UNITS["mixed"])
    model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2})
    options = {"scores": panel_scores, "samples": 39, "draw_emission": True, "progress": False}
    scores = dvae.evaluate({"model": model}, windows, **options)
    comparison = dvae.compare({"model": model}, windows, particles=2, contrasts=0, **options)
    free_running = {name: metric for name, metric in scores.metrics.items() if metric.program == "free-running"}
    assert comparison.shown == {name: metric.unit for name, metric in free_running.items()}
    assert {name: scores["model"][name].mean for name in free_running} == {
        name: comparison["model"][name].mean for name in free_running
    }
    reloaded = type(comparison).from_json(comparison.to_json())
    for text in (str(comparison), str(reloaded)):
        assert "coverage 80 % (share)" in text
        assert "CRPS, a ↓ (people)" in text
        assert "windows of 2 sequences" in text
