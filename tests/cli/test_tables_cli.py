"""The command line on a raw table."""

import json
import re
from dataclasses import fields

import numpy as np
import pytest

import dvae
from dvae import motion
from dvae.cli import main
from dvae.cli.fitting import DataOptions
from dvae.cli.tables import is_table
from dvae.inference.training.options import Training
from dvae.models.registry import methods, metric_models
from dvae.tables import Cut, PanelData

pd = pytest.importorskip("pandas")

SMALL = ["--steps", "2", "--batch-size", "4", "--validate-every", "2"]
LATENT = ["--latent", "2", "--warm-up", "1"]
OPTIONS = ["--columns", "riders:count:people", "temp:real:°C", "--covariates", "plan", "--past", "weather"]
OPTIONS += ["--attributes", "height", "--id", "station", "--time", "day"]
OPTIONS += ["--observed", "5", "--horizon", "3", "--split", "sequence"]


OF_MOTION = re.compile(r".*\b(?:clips?|frames?)\b.*")


def frame(t=20, future=0):
    """Return six stations with missing values; the future has values of known covariates only."""
    rng = np.random.default_rng(0)
    parts = []
    for n in range(6):
        count = t + future
        columns = {"riders": rng.poisson(4, count), "temp": rng.normal(20, 5, count), "plan": rng.normal(size=count)}
        part = pd.DataFrame(columns).astype(float)
        part.iloc[3:6, n % 2] = np.nan
        part.iloc[t:, :2] = np.nan
        part["weather"] = np.where(rng.random(count) < 0.5, "rain", "sun")
        days = pd.date_range("2024-01-01", periods=count)
        parts.append(part.assign(station=f"s{n}", day=days.strftime("%Y-%m-%d"), height=rng.normal()))
    return pd.concat(parts, ignore_index=True)


def failure(capsys, *arguments, code=1):
    """Return the error message of a failing command."""
    assert main([str(each) for each in arguments]) == code
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert "looks like a bug" not in error
    return " ".join(error.split())


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    path = tmp_path_factory.mktemp("table") / "riders.csv"
    frame().to_csv(path, index=False)
    return path


@pytest.fixture(scope="module")
def table_runs(table, tmp_path_factory):
    """Return a folder with runs of two methods; tests do not write to their weights."""
    out = tmp_path_factory.mktemp("tabled")
    for name in ("vae", "autoregressive"):
        options = LATENT if name == "vae" else []
        assert main(["fit", name, "--out", str(out / name), "--data", str(table), *SMALL, *options, *OPTIONS]) == 0
    return out


def test_options_of_data_and_methods_have_distinct_names():
    data = {field.name for field in fields(DataOptions)}
    assert not data & {field.name for field in fields(Training)}
    for name, kind in {**methods(), **metric_models()}.items():
        assert not data & {field.name for field in fields(kind)}, name


def test_info_proposes_a_schema_that_is_read_afterwards(table, capsys, tmp_path):
    path = tmp_path / "riders.csv"
    path.write_bytes(table.read_bytes())
    assert main(["data", "info", str(path)]) == 0
    output = capsys.readouterr().out
    assert "6 sequences of 20 steps" in output
    assert 'id = ["station"]' in output
    assert "test windows of 6 + 2 steps" in output
    schema = tmp_path / "riders.toml"
    assert main(["data", "info", str(path), "--out", str(schema)]) == 0
    assert "edit it" in capsys.readouterr().err
    assert main(["data", "info", str(path), "--columns", "temp", "--time", "day", "--na-values", "-999", "?"]) == 0
    proposed = capsys.readouterr().out
    assert 'na_values = ["-999", "?"]' in proposed
    assert "riders" not in proposed.partition("a schema")[2].partition("columns")[2]
    assert "options of columns are for tables" in failure(capsys, "data", "info", "simulated", "--id", "s", code=2)
    assert schema.read_text() in output
    schema.write_text(schema.read_text().replace('family = "count"', 'family = "overdispersed"'))
    assert main(["data", "info", str(path)]) == 0
    assert "overdispersed" in capsys.readouterr().out
    schema.write_text(schema.read_text().replace('family = "overdispersed"', 'unt = "people"'))
    assert (
        "riders.toml is not a valid schema of a table: column 'riders' has an entry 'unt' (did you mean 'unit'?)"
        in failure(capsys, "data", "info", path)
    )
    assert "--out writes the schema of one table" in failure(
        capsys, "data", "info", table, table, "--out", schema, code=2
    )


@pytest.mark.filterwarnings("always:columns left out of the proposed schema")
def test_guesses_about_dates_units_and_row_numbers_are_reported(tmp_path, capfd):
    path, days = tmp_path / "shops.csv", pd.date_range("2024-01-01", periods=12)
    shops = pd.DataFrame({"date": np.tile(days.strftime("%d/%m/%y"), 16), "sold": np.arange(16.0 * 12)})
    shops = shops.assign(
        shop=np.repeat([f"s{n}" for n in range(16)], 12), price=[f"{n}.25 €" for n in range(len(shops))]
    )
    shops.to_csv(path)  # with the index as a column
    assert main(["data", "info", str(path)]) == 0
    out, error = (" ".join(each.split()) for each in capfd.readouterr())
    assert "16 sequences of 12 steps" in out
    assert "note: each value of shop is read as a separate sequence" in out
    assert "write them as 2024-12-31" in error
    assert "remove '€')" in error
    assert "'Unnamed: 0' (row numbers" in error
    assert "Exception ignored" not in error


def test_a_raw_table_is_fitted_evaluated_forecast_and_imputed(table, capsys, tmp_path):
    path, run = tmp_path / "riders.csv", tmp_path / "run"
    path.write_bytes(table.read_bytes())
    assert main(["data", "info", str(path)]) == 0
    assert main(["fit", "dkf", "--out", str(run), "--data", str(path), *SMALL, *LATENT, "--hide", "0.2"]) == 0
    assert f"dvae evaluate {run}" in capsys.readouterr().out
    assert main(["evaluate", str(run), "--samples", "3", "--figure", str(tmp_path / "scores.png")]) == 0
    output = capsys.readouterr().out
    assert "CRPS, riders" in output
    assert "not in this table" in output
    assert "ELBO" in output
    assert not OF_MOTION.findall(output)
    assert dvae.Evaluation.load(run / "evaluation.json").rows
    out, fans = tmp_path / "futures.csv", tmp_path / "fans.png"
    assert main(["forecast", str(run), "--out", str(out), "--figure", str(fans)]) == 0
    assert fans.read_bytes().startswith(b"\x89PNG")
    table = pd.read_csv(out)
    assert {"sequence", "step", "time", "ahead", "column", "mean", "q025", "q500", "q975", "truth"} <= {*table.columns}
    assert {*table["column"]} == {"riders", "temp", "plan", "weather=rain", "weather=sun"}
    assert main(["impute", str(run), "--out", str(tmp_path / "filled.csv"), "--particles", "3"]) == 0
    assert len(pd.read_csv(tmp_path / "filled.csv")) == 6 * 3


def test_quantiles_equal_those_of_draws_with_the_same_seed(table_runs, table, tmp_path):
    few = ["--seed", "3", "--samples", "39", "--horizon", "2"]
    for name in ("a.csv", "a.npz"):
        assert main(["forecast", str(table_runs / "vae"), "--out", str(tmp_path / name), *few]) == 0
    rows = pd.read_csv(table).assign(step=lambda each: each.groupby("station").cumcount())
    table = pd.read_csv(tmp_path / "a.csv")
    with np.load(tmp_path / "a.npz") as file:
        draws, truth = file["draws"].reshape(39, -1), file["truth"].ravel()
        assert file["draws"].shape[2] == file["truth"].shape[1] == 2
        assert file["past"].shape[1] == file["times"].shape[1] - 2 == 5
        assert set(file["sequence"]) == set(table["sequence"])
    for level in (0.025, 0.5, 0.9):
        expected = np.quantile(draws, level, axis=0, method="weibull")
        np.testing.assert_allclose(table[f"q{1000 * level:03.0f}"], expected, rtol=1e-14)
    np.testing.assert_allclose(table["mean"], draws.mean(0), rtol=1e-14)
    np.testing.assert_allclose(table["truth"], truth, rtol=1e-14)
    assert table["truth"].isna().any()
    rows = rows.set_index(["station", "step"])
    for _, row in table.iterrows():
        observed = rows.loc[(row["sequence"], row["step"])]
        assert row["time"] == observed["day"]
        np.testing.assert_allclose(row["truth"], observed[row["column"]], rtol=1e-6)


def test_wrong_suffixes_of_output_files_are_errors(table_runs, run, tmp_path, capsys):
    out = ["--out", tmp_path / "f.xlsx"]
    for command in ("forecast", "impute"):
        error = failure(capsys, command, table_runs / "vae", *out, code=2)
        assert error.endswith("end the name in .csv or .parquet or .npz")
    assert failure(capsys, "forecast", run, *out, code=2).endswith("in .npz or .bvh, or use no suffix for a folder")
    assert failure(capsys, "impute", run, *out, code=2).endswith("end the name in .npz")


def test_the_number_of_draws_suffices_for_the_quantiles(table_runs, tmp_path, capsys):
    for command in ("forecast", "impute"):
        run = [command, str(table_runs / "autoregressive"), "--out"]
        assert main([*run, str(tmp_path / "a.npz")]) == 0
        with np.load(tmp_path / "a.npz") as file:
            assert len(file["draws" if command == "forecast" else "filled"]) == 100
        assert main([*run, str(tmp_path / "a.npz"), "--samples", "9"]) == 0
        assert "left out" not in capsys.readouterr().err
        assert main([*run, str(tmp_path / "a.csv"), "--samples", "9"]) == 0
        note = "left out at --samples 9 (draws needed in brackets): q025 (39), q050 (19), q950 (19), q975 (39)"
        assert note in " ".join(capsys.readouterr().err.split())
        columns = [name for name in pd.read_csv(tmp_path / "a.csv") if name.startswith("q")]
        assert columns == ["q100", "q250", "q500", "q750", "q900"]
    out = ["--out", str(tmp_path / "a.npz"), "--figure", str(tmp_path / "a.png"), "--samples", "19"]
    assert main(["forecast", str(table_runs / "autoregressive"), *out]) == 0
    assert "left out at --samples 19 (draws needed in brackets): the interval of 95 % (39)" in " ".join(
        capsys.readouterr().err.split()
    )


def test_a_report_shows_forecast_fans_of_a_table(table_runs, tmp_path):
    page = tmp_path / "a.html"
    few = ["--windows", "1", "--particles", "2", "--bound-windows", "2"]
    assert main(["report", str(table_runs / "autoregressive"), "--out", str(page), *few]) == 0
    text = page.read_text()
    assert "cannot be shown" not in text
    assert "<script>" not in text
    assert text.count('alt="forecasts of s') == 1
    assert "windows of 2 sequences" in text


def test_a_report_of_whole_sequences_has_no_futures(table, tmp_path, capsys):
    run, page = str(tmp_path / "run"), tmp_path / "a.html"
    data = PanelData.open(str(table), cut=Cut())
    training = dvae.Training(steps=2, batch_size=4, validate_every=2)
    fit = dvae.fit(dvae.method("vae", latent=2, warm_up=1), data, out=run, **vars(training))
    assert re.fullmatch(r"best bound -\d+\.\d+ nats a step at training step 2", fit.best)
    assert main(["report", run, "--out", str(page), "--particles", "2", "--bound-windows", "2"]) == 0
    text = page.read_text()
    assert "cannot be shown" not in text
    assert "These runs were fitted on whole sequences. To see futures, fit with --observed and --horizon." in text
    assert "IWAE bound" in text
    compared = ["compare", run, "--particles", "2", "--contrasts", "0", "--out", str(tmp_path / "a.json")]
    assert main(compared) == 0
    assert "no forecasts: whole sequences have no future" in capsys.readouterr().out
    assert json.loads((tmp_path / "a.json").read_text())["attributes"]["samples"] == 0
    error = failure(capsys, "evaluate", run, code=2)
    assert "fit with --observed and --horizon to forecast, or compare bounds with `dvae compare`" in error
    assert "--stride is for windows" in failure(capsys, *compared, "--stride", "2", code=2)


def test_a_sequence_is_selected_by_name(table_runs, tmp_path, capsys):
    run, out = table_runs / "autoregressive", tmp_path / "a.csv"
    assert main(["forecast", str(run), "--out", str(out), "--clip", "s4"]) == 0
    assert {*pd.read_csv(out)["sequence"]} == {"s4"}
    assert "no sequence 's44' (did you mean 's4'?)" in failure(capsys, "forecast", run, "--out", out, "--clip", "s44")


def test_forecasts_beyond_the_end_of_the_table(table_runs, table, tmp_path, capsys):
    run, out = table_runs / "vae", tmp_path / "a.csv"
    error = failure(capsys, "forecast", run, "--out", out, "--beyond")
    assert "a forecast of 3 steps needs future values of plan, but sequence 's0' has 0 rows after" in error
    longer = tmp_path / "longer.csv"
    frame(future=3).to_csv(longer, index=False)
    assert main(["forecast", str(run), "--out", str(out), "--beyond", "--data", str(longer)]) == 0
    forecasts = pd.read_csv(out)
    assert len(forecasts) == 6 * 3 * 2
    assert {*forecasts["step"]} == {20, 21, 22}
    assert {*forecasts["time"]} == {"2024-01-21", "2024-01-22", "2024-01-23"}
    assert forecasts["truth"].isna().all()


@pytest.mark.filterwarnings("default:forecasts selected the weights of vae, autoregressive")
def test_runs_are_compared_criticised_resumed_and_swept(table_runs, table, tmp_path, capsys):
    both = [str(table_runs / name) for name in ("vae", "autoregressive")]
    few = ["--particles", "2", "--samples", "2", "--contrasts", "0", "--stride", "4"]
    assert main(["compare", *both, *few, "--out", str(tmp_path / "a.json")]) == 0
    assert {*dvae.Comparison.load(tmp_path / "a.json").rows} == {"vae", "autoregressive"}
    assert main(["check", "calibration", both[1], "--samples", "19"]) == 0
    captured = capsys.readouterr()
    assert "no calibration" in captured.err
    assert "windows of 2 sequences" in captured.out
    assert "correlation length (steps)" in captured.out
    assert "largest (scales)" in captured.out
    assert "inferred from the whole window" not in captured.out
    assert not OF_MOTION.findall(captured.out)
    assert main(["resume", both[0], "--steps", "3"]) == 0
    out = str(tmp_path / "sweep")
    data = ["--data", str(table), *SMALL, *OPTIONS]
    assert main(["sweep", "autoregressive", "--out", out, "--seeds", "0", "1", *data]) == 0
    swept = [f"{out}/autoregressive-seed{seed}" for seed in range(2)]
    mixed = ["evaluate", *swept, "--ensembles", "--samples", "4", "--out", str(tmp_path / "mixed.json")]
    assert main(mixed) == 0
    rows = dvae.Evaluation.load(tmp_path / "mixed.json").rows
    assert "autoregressive, mixture of 2 seeds" in rows
    assert {row.samples for name, row in rows.items() if name.startswith("autoregressive")} == {4}
    assert "needs runs that differ only in their seed" in failure(capsys, "evaluate", *both, "--ensembles", code=2)
    assert dvae.load(tmp_path / "sweep" / "autoregressive-seed0").schema.cut.horizon == 3
    assert "which is of a table" in failure(capsys, "animate", both[0], "--out", tmp_path / "a.html")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--columns", "ridrs"], "no column 'ridrs' (did you mean 'riders'?)"),
        (["--columns", "riders:cout"], "family 'cout' (did you mean 'count'?)"),
        (["--columns", "temp:count"], "the family 'count' requires whole numbers from 0"),
        (["--observed", "500", "--horizon", "3"], "no training window of 500 + 3 steps"),
        (["--test", "1.5"], "test is 1.5"),
        (["--split", "group"], "no column of riders has the role group; name one"),
        (["--skip-bad"], "--skip-bad is for motion, and vae is fitted on a table"),
        (["--protocol", "cmu8"], "--protocol is for motion, and vae is fitted on a table"),
    ],
)
def test_arguments_that_do_not_fit_the_table_exit_with_2(table, tmp_path, capsys, arguments, message):
    assert message in failure(capsys, "fit", "vae", "--out", tmp_path / "run", "--data", table, *arguments, code=2)
    assert not (tmp_path / "run").exists()


def test_options_for_another_kind_of_data_are_errors(people, table_runs, tmp_path, capsys):
    out = ["--out", tmp_path / "run"]
    segments = failure(capsys, "fit", "motion-latent", *out, "--data", people, "--columns", "a", code=2)
    assert "--columns is for a table, and motion-latent is fitted on segments of motion" in segments
    for option in ("--observed", "--test"):
        error = failure(capsys, "fit", "vae", *out, option, "0", code=2)
        assert f"{option} is for tables; give the path of a table with --data" in error
    assert "people.npz cannot be read as npz: it holds" in failure(
        capsys, "fit", "vae", *out, "--data", people, "--horizon", "3", code=2
    )
    for option in (["--joints", "LWrist"], ["--pose-prior", "a"], ["--missing"]):
        assert "is for motion" in failure(capsys, "evaluate", table_runs / "vae", *option, code=2)
    assert "--fix is for motion" in failure(capsys, "forecast", table_runs / "vae", *out, "--fix", "lower", code=2)
    options = [*out, "--data", next(table_runs.parent.glob("table*/riders.csv")), "--steps", "1"]
    for name in ("gsps", "pose-prior"):
        error = failure(capsys, "fit", name, *options)
        assert "needs the description of poses, but was given panel, which has none; take a method for any" in error
    error = failure(capsys, "fit", "srnn", *options, "--residual", "1")
    assert "has no location to which the previous value can be added; leave residual at 0" in error
    assert not (tmp_path / "run" / "config.json").exists()


def test_motion_files_are_not_tables(people, run, tmp_path, capsys):
    assert not is_table(str(people))
    error = failure(capsys, "forecast", run, "--out", tmp_path / "a.npz", "--beyond", code=2)
    assert "--beyond is for tables" in error
    clip = motion.simulate(clips=1, frames=60).clips[0]
    path = tmp_path / "alone" / "motion.npz"
    path.parent.mkdir()
    motion.save(path, motion.MotionSet([clip], motion.WALKER))
    with np.load(path) as file:
        assert len(file.files) == 1
    assert not is_table(str(path))
    assert main(["data", "info", str(path)]) == 0
    assert "17 joints" in capsys.readouterr().out
    motion.write_motion(tmp_path / "walk.csv", motion.MotionSet([clip], motion.WALKER), "csv")
    assert not is_table(str(tmp_path / "walk.csv"))
    np.savez(tmp_path / "archive.npz", positions_3d=np.array({}, object))
    assert not is_table(str(tmp_path / "archive.npz"))
    (tmp_path / "broken.npz").write_bytes(b"PK")
    assert not is_table(str(tmp_path / "broken.npz"))
    assert not is_table(str(tmp_path))


def test_tables_are_recognized(table, tmp_path):
    np.savez(tmp_path / "a.npz", x=np.zeros((2, 3, 1)), lengths=np.array([3, 3]))
    np.savez(tmp_path / "b.npz", anything=np.zeros((3, 1)))
    (tmp_path / "wind.csv").write_text("day,wind_x,wind_y\n1,2,3\n")
    for path in (table, tmp_path / "a.npz", tmp_path / "b.npz", tmp_path / "wind.csv", tmp_path / "no.parquet"):
        assert is_table(str(path))
    (tmp_path / "joint.csv").write_text("hip_x,hip_y,hip_z\n1,2,3\n")
    assert not is_table(str(tmp_path / "joint.csv"))
    (tmp_path / "joint.toml").write_text("[columns.hip_x]")
    assert is_table(str(tmp_path / "joint.csv"))


def test_control_characters_in_names_are_escaped(tmp_path, capsys):
    path = tmp_path / "a.csv"
    path.write_text("day,\x1b[2Jy,[red]z\n" + "".join(f"{n},{n % 3}.5,{n % 2}.25\n" for n in range(40)))
    assert main(["data", "info", str(path)]) == 0
    captured = capsys.readouterr()
    assert "\x1b" not in captured.out + captured.err
    assert "[red]z" in captured.out
    fit = ["fit", "vae", "--out", tmp_path / "r", "--data", path, "--columns", "\x1b[2J"]
    assert "\x1b" not in failure(capsys, *fit, code=2)
