"""Backtests: windows and fits of each cutoff, pooled scores and their errors, interruption and the command."""

import re
import shutil
import signal
from dataclasses import replace

import matplotlib
import numpy as np
import pytest
import torch

import dvae
from dvae.cli import main
from dvae.inference.evaluation.estimates import clustered_variance, linearised
from dvae.inference.evaluation.evaluation import Evaluation, Row
from dvae.inference.evaluation.scores import Metric, means_of_those_that_count
from dvae.runs.backtest import Backtest, backtest, pool
from dvae.runs.sweep import SweepInterrupted
from dvae.tables import Cut, PanelData

matplotlib.use("Agg")
pd = pytest.importorskip("pandas")

SMALL = {"steps": 2, "batch_size": 4, "validate_every": 2}
METHODS = {"auto": dvae.method("autoregressive", width=4)}


@pytest.fixture(scope="module")
def frame():
    """Return five daily series of 60 steps; the third ends 10 days earlier, and the second has missing values."""
    random, parts = np.random.default_rng(0), []
    for n in range(5):
        days = pd.date_range("2020-01-01", periods=50 if n == 2 else 60)
        values = random.normal(size=len(days)).cumsum()
        values[3:5] = np.nan if n == 1 else values[3:5]
        parts.append(pd.DataFrame({"shop": f"s{n}", "day": days, "y": values}))
    return pd.concat(parts, ignore_index=True)


@pytest.fixture(scope="module")
def data(frame):
    return PanelData.of(frame, dvae.tables.ColumnHints(("y",), id=("shop",), time="day"), Cut(6, 3, split="time"))


def run(data, *arguments, **options):
    scores = {"scores": dvae.tables.panel_scores, "samples": 20, "progress": False}
    return backtest(METHODS, data, *arguments, training=SMALL, **scores, **options)


@pytest.fixture(scope="module")
def result(data, tmp_path_factory):
    return run(data, 3, tmp_path_factory.mktemp("backtest"), step=6)


def test_scores_are_pooled_over_cutoffs_and_clustered_by_sequence(result):
    assert result.cutoffs == ["2020-02-12", "2020-02-18", "2020-02-24"]
    # futures of three steps begin at a cutoff and three days later; the third series ends on 2020-02-19
    names = [f"test/s{n}" for n in range(5)]
    assert [dict(zip(result.clusters, row, strict=True)) for row in result.windows.tolist()] == [
        dict(zip(names, counts, strict=True)) for counts in ([2, 2, 2, 2, 2], [2, 2, 0, 2, 2], [2, 2, 0, 2, 2])
    ]
    for method in result.rows:
        singles = [result.at(cutoff)[method]["CRPS"].mean for cutoff in result.cutoffs]
        weights = result.windows.sum(1)
        assert result[method]["CRPS"].mean == pytest.approx(np.average(singles, weights=weights))
        by_series = np.nansum(result.windows * result.by_cutoff[method]["CRPS"], 0) / result.windows.sum(0)
        _, deviations = linearised(by_series, result.windows.sum(0))
        assert result[method]["CRPS"].standard_error == pytest.approx(np.sqrt(clustered_variance(deviations)))
        assert result[method]["CRPS"].freedom == 4
    assert result.difference("auto", "last value", "CRPS").standard_error > 0
    shorter = [note for note in result.notes if "leaves out 1 sequences with fewer than 9 steps" in note]
    assert [note.split()[1] for note in shorter] == ["2020-02-18", "2020-02-24"]
    assert result.plot()._repr_png_().startswith(b"\x89PNG")
    assert result.plot_calibration()._repr_png_().startswith(b"\x89PNG")
    with pytest.raises(KeyError, match="no cutoff '2020-02-13'; there are 2020-02-12"):
        result.at("2020-02-13")


def test_a_score_that_some_windows_lack_is_the_mean_of_the_others():
    known = np.array([[[1, 1], [1, 0]], [[0, 1], [0, 0]], [[1, 1], [1, 1]]], bool)  # cutoffs, sequences, windows
    values = np.random.default_rng(0).normal(size=known.shape)
    clusters, evaluations = torch.tensor([0, 0, 1, 1]), {}
    for number, (scores, present) in enumerate(zip(values, known, strict=True)):
        of_windows = torch.tensor(np.where(present, scores, np.nan)).flatten()
        means = np.array(means_of_those_that_count(of_windows, clusters))
        row = Row(5, {"CRPS": means}, counts={"CRPS": present.sum(1)})
        metrics, extents = {"CRPS": Metric(partial=True)}, {"test/a": 2, "test/b": 2}
        options = {"data": {"fingerprint": "f"}, "protocol": {}, "samples": 5, "emission": "drawn"}
        evaluations[str(number)] = Evaluation({"m": row}, metrics, extents, bound_particles=0, seed=0, **options)
    score = pool(evaluations, "at every cutoff")["m"]["CRPS"]
    assert score.mean == pytest.approx(values[known].mean())
    deviations = ((values - score.mean) * known).sum((0, 2)) / known.sum()
    assert score.standard_error == pytest.approx(np.sqrt(clustered_variance(deviations)))


def test_each_cutoff_equals_an_evaluation_of_its_own_fit(result, data):
    """The model, its units and the references know only the steps before the cutoff."""
    before = data.before(12)
    assert before.cutoff == "2020-02-18"
    fit = dvae.fit(METHODS["auto"], before, **SMALL, progress=False)
    expected = dvae.evaluate(
        {"auto": fit.model},
        before.following(6),
        samples=20,
        training_windows=before.windows("train+validation"),
        progress=False,
    )
    single = result.at("2020-02-18")
    assert expected.clusters == single.clusters
    for name, row in expected.rows.items():
        for score, values in row.cluster_means.items():
            np.testing.assert_allclose(single.rows[name].cluster_means[score], values, rtol=1e-5)


def test_later_data_change_no_earlier_cutoff(result, frame, data):
    last = frame.assign(y=frame["y"].where(frame["day"] < "2020-02-24", 1e3))
    changed = run(data.with_data(last), 3, step=6)
    for method in ("auto", "climatology"):
        for place, same in enumerate((True, True, False)):
            values, others = (each.by_cutoff[method]["CRPS"][place] for each in (result, changed))
            assert np.allclose(values, others, equal_nan=True) == same


def test_a_single_fit_makes_all_forecasts(result, data, tmp_path):
    single = run(data, 3, tmp_path, step=6, refit=False)
    assert [path.name for path in tmp_path.iterdir()] == ["cutoff-1"]
    rows = {name: (single.by_cutoff[name]["CRPS"], result.by_cutoff[name]["CRPS"]) for name in result.rows}
    np.testing.assert_allclose(rows["auto"][0][0], rows["auto"][1][0], rtol=1e-5)
    assert not np.allclose(rows["auto"][0][1], rows["auto"][1][1], equal_nan=True)
    for name in {*rows} - {"auto"}:  # references use all steps before each cutoff
        np.testing.assert_allclose(*rows[name])
    assert "fitted at the first cutoff" in str(single)


def test_a_step_below_the_horizon_and_an_unknown_score_are_refused(result, data, tmp_path):
    with pytest.raises(ValueError, match="step is 2 and the horizon 3; step must be at least the horizon"):
        run(data, 3, tmp_path, step=2)
    assert not [*tmp_path.iterdir()]
    with pytest.raises(ValueError, match=r"no score 'CRSP' \(did you mean 'CRPS'\?\); the scores are"):
        result.cutoff_table("CRSP")


def test_it_is_read_back_from_json(result):
    again = Backtest.from_json(result.to_json())
    assert (str(again), again.to_json()) == (str(result), result.to_json())
    assert str(again.at("2020-02-24")) == str(result.at("2020-02-24"))
    dataset = result.dataset
    assert dataset["CRPS by cutoff"].dims == ("model", "cutoff", "cluster")
    assert dataset["cutoff"].values.tolist() == result.cutoffs
    with pytest.raises(ValueError, match="lists 2 cutoffs"):
        replace(result, cutoffs=result.cutoffs[:2]).check()


def test_an_interrupted_backtest_continues(result, data, tmp_path, monkeypatch):
    from dvae.runs import backtest as module

    original, calls = module.sweep, []

    def sweep(*arguments):
        calls.append(arguments[2].name)
        if len(calls) == 2:
            raise SweepInterrupted([], 1, signal.SIGINT)
        return original(*arguments)

    monkeypatch.setattr(module, "sweep", sweep)
    with pytest.raises(SweepInterrupted, match="start the same sweep again"):
        run(data, 3, tmp_path, step=6)
    first = tmp_path / "cutoff-1" / "auto-seed0" / "log.jsonl"
    before = first.stat().st_mtime_ns
    again = run(data, 3, tmp_path, step=6)
    assert first.stat().st_mtime_ns == before
    assert calls == ["cutoff-1", "cutoff-2", "cutoff-1", "cutoff-2", "cutoff-3"]
    assert again.by_cutoff["auto"]["CRPS"] == pytest.approx(result.by_cutoff["auto"]["CRPS"], nan_ok=True, rel=1e-5)


def test_several_seeds_have_a_row_each_and_bands_pool_the_cutoffs(data, tmp_path):
    result = run(data, 4, tmp_path, seeds=(0, 1), references=False)
    assert [*result.rows] == ["auto-seed0", "auto-seed1"]
    assert result.windows.sum(1).tolist() == [4, 4, 4, 4]  # steps of one horizon
    assert len(result.clusters) == 4
    models = [dvae.load(tmp_path / f"cutoff-{n}" / "auto-seed0").model for n in range(1, 5)]
    windows = [data.before(steps).following(3) for steps in (12, 9, 6, 3)]
    with pytest.raises(ValueError, match=r"need at least 9 origins .* got 4; .* at most 80 %"):
        dvae.conformal_bands(models, windows, progress=False)
    bands = dvae.conformal_bands(models, windows, 0.75, samples=20, progress=False)
    assert (bands.clusters, bands.data["windows"]) == (4, 16)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cutoffs": 0}, "cutoffs is 0"),
        ({"step": 0}, "step is 0"),
        ({"cutoffs": 30}, "has no training window"),
    ],
)
def test_impossible_cutoffs_are_errors(options, message, data):
    with pytest.raises(ValueError, match=message):
        run(data, **options)
    with pytest.raises(ValueError, match='split="time" needs windows'):
        run(data.recut(observed=None, horizon=None, split="sequence"))


# -------------------------------------------------------------------------------------------------------- the command


def test_a_backtest_by_the_command_line(frame, tmp_path, capsys):
    table, out = tmp_path / "shops.csv", tmp_path / "runs"
    frame.to_csv(table, index=False)
    command = ["backtest", "autoregressive", "--data", str(table), "--out", str(out), "--cutoffs", "2", "--step", "6"]
    command += ["--observed", "6", "--horizon", "3", "--jobs", "1", "--samples", "20"]
    command += ["--steps", "2", "--batch-size", "4", "--figure", str(tmp_path / "scores.png")]
    assert main(command) == 0
    output = capsys.readouterr()
    assert "2 cutoffs, fitted at every cutoff" in output.out
    assert re.search(r"2020-02-18 .* ± ", output.out)
    assert "cutoff 2 of 2: 2020-02-24" in output.err
    stored = Backtest.load(out / "backtest.json")
    assert stored["autoregressive"]["coverage 90 %"].mean >= 0
    assert (tmp_path / "scores.png").stat().st_size > 0
    assert main(["evaluate", str(out / "cutoff-2" / "autoregressive-seed0"), "--samples", "5"]) == 0
    before = {path: path.stat().st_mtime_ns for path in out.glob("cutoff-1/*/*")}
    shutil.rmtree(out / "cutoff-2")
    assert main(command) == 0
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert Backtest.load(out / "backtest.json").to_json() == stored.to_json()


def test_bands_are_calibrated_between_cutoffs_by_the_command_line(frame, data, tmp_path, capsys):
    table = tmp_path / "shops.csv"
    frame.to_csv(table, index=False)
    paths = {steps: tmp_path / f"before-{steps}" for steps in (3, 9, 12, 7)}
    for steps, path in paths.items():
        options = ["--split", "time", "--test", str(steps), "--observed", "6", "--horizon", "3", "--steps", "2"]
        assert main(["fit", "autoregressive", "--data", str(table), "--out", str(path), *options]) == 0
    command = ["check", "coverage", *map(str, paths.values())]
    assert main([*command, "--samples", "20", "--level", "0.75"]) == 0
    assert "which adapt over the origins" in " ".join(capsys.readouterr().out.split())
    bands = dvae.PredictionBands.load(paths[3] / "coverage.json")
    # The window that begins 4 steps before the end would reveal the steps after the last cutoff.
    windows = [data.before(steps).following(horizon) for steps, horizon in ((12, 3), (9, 2), (7, 1))]
    models = [dvae.load(paths[steps]).model for steps in (12, 9, 7)]
    expected = dvae.conformal_bands(models, windows, 0.75, samples=20, progress=False)
    assert (bands.clusters, bands.data["windows"]) == (3, 12)  # the third series has ended
    assert bands.factors["number"] == pytest.approx(expected.factors["number"], rel=1e-4)
    assert dvae.Evaluation.load(paths[3] / "coverage-test.json").data["windows"] == 4
    for wrong in ([str(paths[9])], ["--label", "shop", "--values", "s1"]):  # a cutoff twice, and labels
        assert main([*command, *wrong]) == 2
        assert "each at another cutoff" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["srnn", "--cutoffs", "0"], "--cutoffs is 0"),
        ([], "give at least one method"),
        (["srnm"], "did you mean 'srnn'?"),
        (["srnn"], "a backtest is of a table"),
    ],
)
def test_wrong_arguments_exit_with_2(arguments, message, tmp_path, capsys):
    assert main(["backtest", *arguments, "--out", str(tmp_path / "runs")]) == 2
    assert message in capsys.readouterr().err
