"""The commands that score forecasts of other software."""

import numpy as np
import pytest

import dvae
from dvae import motion
from dvae.cli import main

pd = pytest.importorskip("pandas")

CUT = ["--id", "station", "--time", "day", "--observed", "6", "--horizon", "3", "--split", "sequence"]
FIT = ["--steps", "2", "--batch-size", "4", "--validate-every", "2", "--latent", "2", "--warm-up", "1"]


def failure(capsys, *arguments, code=1):
    """Return the error message of a failing command."""
    assert main([str(each) for each in arguments]) == code
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert "looks like a bug" not in error
    return " ".join(error.split())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a table, a run, and its forecasts."""
    folder = tmp_path_factory.mktemp("external")
    rng = np.random.default_rng(0)
    columns = {"station": np.arange(12).repeat(24), "day": np.tile(np.arange(24), 12)}
    columns |= {"riders": rng.poisson(5, 288), "warmth": rng.normal(size=288)}
    pd.DataFrame(columns).to_csv(folder / "riders.csv", index=False)
    assert main(["fit", "vae", "--data", str(folder / "riders.csv"), "--out", str(folder / "run"), *FIT, *CUT]) == 0
    for suffix in (".npz", ".csv"):
        options = ["--samples", "40", "--out", str(folder / f"own{suffix}")]
        assert main(["forecast", str(folder / "run"), *options]) == 0
    return folder


def data(folder):
    return ["--data", folder / "riders.csv", *CUT]


def evaluated(*arguments):
    assert main([str(each) for each in ("evaluate", *arguments)]) == 0


def test_what_forecast_writes_is_scored_with_and_without_the_run(capsys, folder, tmp_path):
    forecasts = ["--forecasts", folder / "own.npz"]
    evaluated(folder / "run", *forecasts, "--samples", "40")
    assert "forecasts of own were given" in " ".join(capsys.readouterr().out.split())
    beside = dvae.Evaluation.load(folder / "run" / "evaluation-with-own.json")
    assert [*beside.rows][-2:] == ["own", "vae"]
    evaluated(*forecasts, *data(folder), "--out", tmp_path / "alone.json")
    alone = dvae.Evaluation.load(tmp_path / "alone.json")
    assert alone.data["fingerprint"] == beside.data["fingerprint"]
    assert alone["own"]["CRPS"] == beside["own"]["CRPS"]
    assert {*alone.rows} == {*beside.rows} - {"vae"}
    assert alone["own"]["CRPS"].mean == pytest.approx(beside["vae"]["CRPS"].mean, rel=0.2)  # other draws


def test_an_outsider_forecasts_exported_windows(capsys, folder, tmp_path):
    out = tmp_path / "windows.npz"
    assert main(["data", "windows", *map(str, data(folder)), "--out", str(out)]) == 0
    assert "windows of 6 observed steps of 2 columns; forecast 3" in " ".join(capsys.readouterr().err.split())
    with np.load(out) as arrays:
        keys = {name: arrays[name] for name in ("split", "sequence", "start", "columns")}
        samples = arrays["observed"][None, :, -1:].repeat(20, 0).repeat(int(arrays["horizon"]), 2)
    np.savez(tmp_path / "flat.npz", samples=samples, **keys)
    np.save(tmp_path / "plain.npy", samples[:1])
    np.save(tmp_path / "turned.npy", samples.swapaxes(0, 1))
    record = ["--out", tmp_path / "scores.json"]
    evaluated("--forecasts", tmp_path / "flat.npz", tmp_path / "plain.npy", *data(folder), *record)
    scores = dvae.Evaluation.load(tmp_path / "scores.json")
    assert scores["flat"]["CRPS"].mean == pytest.approx(scores["plain"]["CRPS"].mean)
    evaluated("--forecasts", tmp_path / "turned.npy", "--axes", "nktd", *data(folder), *record)
    assert dvae.Evaluation.load(tmp_path / "scores.json")["turned"]["CRPS"] == scores["flat"]["CRPS"]
    few = {name: values[2:5] for name, values in keys.items() if name != "columns"}
    np.savez(tmp_path / "few.npz", samples=samples[:, 2:5], **few)
    assert "are missing, such as [('test'," in failure(
        capsys, "evaluate", "--forecasts", tmp_path / "few.npz", *data(folder)
    )
    train = ["data", "windows", *map(str, data(folder)), "--out", str(out), "--part", "train"]
    assert main(train) == 0
    with np.load(out) as arrays:
        assert arrays["future"].shape == (len(arrays["start"]), 3, 2)


def test_wrong_arguments_are_refused(capsys, folder, tmp_path):
    own, turned = folder / "own.npz", tmp_path / "own.npy"
    np.save(turned, np.zeros((2, 3)))
    for arguments, message, code in (
        (["--forecasts", folder / "own.csv", *data(folder)], "means and quantiles, which do not determine", 2),
        (["--forecasts", own, turned, *data(folder)], "give files with different names", 2),
        (["--forecasts", turned, *data(folder)], "samples have shape (2, 3), expected (K, N, T, D)", 2),
        (["--forecasts", turned, "--axes", "kx", *data(folder)], "axes are 'kx'", 2),
        (["--forecasts", tmp_path / "absent.npz", *data(folder)], "absent.npz: no such file", 2),
        (["--forecasts", own], "--forecasts needs --data, or runs", 2),
        (["--forecasts", own, *data(folder), "--unit", "mm"], "--unit and --given-root are for motion", 2),
        (["--forecasts", own, *data(folder), "--windows-of", "dlow"], "--windows-of is for motion", 2),
        (["--forecasts", own, "--data", "simulated"], "'own' has", 1),
        (["--forecasts", own, *data(folder), "--root", "travel"], "--root is for motion", 2),
        ([folder / "run", "--forecasts", own, "--root", "travel"], "the runs define the windows", 2),
        (["--forecasts", own, "--data", "simulated", "--stride", "2"], "--stride is for tables", 2),
        ([folder / "run", "--forecasts", own, "--observed", "4"], "the runs define the windows", 2),
        ([folder / "run", "--axes", "kntd"], "need --forecasts", 2),
        ([], "give at least one run directory", 2),
        ([folder / "run", "--forecasts", own, "--measure", "codes"], "not for another --measure", 2),
    ):
        assert message in failure(capsys, "evaluate", *arguments, code=code), arguments
    (tmp_path / "vae.npz").write_bytes(own.read_bytes())
    clash = [folder / "run", "--forecasts", tmp_path / "vae.npz"]
    assert "both named vae" in failure(capsys, "evaluate", *clash, code=2)
    assert "end the name in .npz" in failure(capsys, "data", "windows", "--out", tmp_path / "a.csv", code=2)


def test_forecasts_of_motion_are_scored_in_public_layouts(capsys, tmp_path):
    people, out = tmp_path / "people.npz", tmp_path / "windows.npz"
    motion.save(people, motion.simulate(clips=8, frames=90, test=0.4))
    assert main(["data", "windows", "--data", str(people), "--protocol", "simulated", "--out", str(out)]) == 0
    with np.load(out) as arrays:
        keys = {name: arrays[name] for name in ("split", "sequence", "start")}
        assert arrays["columns"][:2].tolist() == ["RHip_x", "RHip_y"]
        samples = arrays["observed"][None, :, -1:].repeat(3, 0).repeat(60, 2)
    np.savez(tmp_path / "metres.npz", samples=samples, **keys)
    count = samples.shape[1]
    np.savez(tmp_path / "mm.npz", samples=1000 * samples.swapaxes(0, 1).reshape(count, 3, 60, 1, 16, 3), **keys)
    common, record = ["--data", people, "--protocol", "simulated"], ["--out", tmp_path / "scores.json"]
    evaluated("--forecasts", tmp_path / "metres.npz", *common, *record)
    scores = dvae.Evaluation.load(tmp_path / "scores.json")
    assert scores["metres"]["ADE"] == scores["zero velocity"]["ADE"]
    evaluated("--forecasts", tmp_path / "mm.npz", "--axes", "nkt1jc", "--unit", "mm", *common, *record)
    other = dvae.Evaluation.load(tmp_path / "scores.json")["mm"]["ADE"].mean
    assert other == pytest.approx(scores["metres"]["ADE"].mean, rel=1e-6)
    evaluated("--forecasts", tmp_path / "metres.npz", *common, "--windows-of", "dlow", *record)
    fewer = dvae.Evaluation.load(tmp_path / "scores.json")
    assert fewer.data["windows"] < count
    assert fewer["metres"]["ADE"] == fewer["zero velocity"]["ADE"]
    assert "windows of dlow" in " ".join(capsys.readouterr().out.split())


def test_windows_that_keep_the_root_are_scored_without_a_run(tmp_path):
    people, out = tmp_path / "people.npz", tmp_path / "windows.npz"
    motion.save(people, motion.simulate(clips=8, frames=90, test=0.4))
    options = ["--data", people, "--protocol", "simulated", "--root", "travel"]
    assert main([str(each) for each in ("data", "windows", *options, "--out", out)]) == 0
    with np.load(out) as arrays:
        keys = {name: arrays[name] for name in ("split", "sequence", "start", "columns")}
        samples = arrays["observed"][None, :, -1:].repeat(3, 0).repeat(60, 2)
    np.savez(tmp_path / "still.npz", samples=samples, **keys)
    evaluated("--forecasts", tmp_path / "still.npz", *options, "--out", tmp_path / "scores.json")
    scores = dvae.Evaluation.load(tmp_path / "scores.json")
    assert samples.shape[-1] == 3 * motion.WALKER.joints
    assert scores["still"]["ADE"] == scores["zero velocity"]["ADE"]
