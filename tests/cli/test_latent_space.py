"""The command line on segments: fit, resume, evaluate and impute with a latent space of 4D motion."""

import json
import shutil

import numpy as np
import pytest

import dvae
from dvae import motion
from dvae.cli import main
from dvae.motion.segments.completion import simulate_observations
from dvae.motion.segments.reconstruction import Reconstruction
from dvae.motion.segments.recovery import read_seen

SMALL = ["motion-latent", "--latent", "3", "--widths", "16", "8", "--batch-size", "4", "--cut", "clips"]


def failure(capsys, *arguments, code=1):
    """Return the error message of a failing command."""
    assert main([*map(str, arguments)]) == code
    error = " ".join(capsys.readouterr().err.split())
    assert "looks like a bug" not in error
    return error


def change(run, keys, value):
    """Set one value of a run's config."""
    config = content = json.loads((run / "config.json").read_text())
    for key in keys[:-1]:
        content = content[key]
    content[keys[-1]] = value
    (run / "config.json").write_text(json.dumps(config))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with two files of people, and a run fitted to the first; tests do not write to it."""
    path = tmp_path_factory.mktemp("segments")
    for seed, name in enumerate(("own", "other")):
        motion.save(path / name / "people.npz", motion.simulate(clips=8, frames=50, seed=seed))
    fit = ["fit", *SMALL, "--data", path / "own" / "people.npz", "--out", path / "run", "--steps", "5"]
    assert main([*map(str, fit)]) == 0
    return path


@pytest.fixture
def run(folder, tmp_path):
    return shutil.copytree(folder / "run", tmp_path / "run")


def test_a_fit_prints_the_next_command_and_resumes(capsys, folder, tmp_path):
    data, out = folder / "own" / "people.npz", tmp_path / "run"
    assert main(["fit", *SMALL, "--data", str(data), "--out", str(out), "--steps", "4", "--scaling", "deviation"]) == 0
    assert f"dvae evaluate {out}" in capsys.readouterr().out
    config = json.loads((out / "config.json").read_text())
    assert (config["data"]["cut"], config["schema"]["kind"]) == ("clips", "segments")
    assert len(config["schema"]["timed"]["deviation"]) == 102
    assert main(["resume", str(out), "--steps", "5"]) == 0
    assert len(dvae.load(out).data.windows("test")) == 2
    motion.save(tmp_path / "people.npz", motion.simulate(clips=8, frames=50, seed=7))
    assert "has changed since" in failure(capsys, "resume", out, "--data", tmp_path / "people.npz", "--steps", "6")


def test_segments_are_scored_with_principal_components_also_on_other_data(capsys, folder, run, tmp_path):
    second = shutil.copytree(run, tmp_path / "second")
    change(second, ("training", "seed"), 1)
    figure = tmp_path / "boxes.png"
    assert main(["evaluate", str(run), str(second), "--figure", str(figure), "--bound-particles", "2"]) == 0
    output = capsys.readouterr().out
    assert all(word in output for word in ("vertex error", "duration error", "ELBO", "PCA of 11"))
    result = Reconstruction.load(run / "evaluation.json")
    assert list(result.rows) == ["run", "PCA of 11", "second"]
    assert result.configs["run"]["data"]["path"] == str(folder / "own" / "people.npz")
    assert figure.exists()

    other = ["--data", str(folder / "other" / "people.npz")]
    assert main(["evaluate", str(run), *other]) == 0
    assert "people.npz is not the data that" in capsys.readouterr().err
    assert "PCA of 11" in Reconstruction.load(run / "evaluation-people.json").rows
    change(second, ("data", "path"), "gone.npz")
    assert main(["evaluate", str(second), *other]) == 0
    assert "omitted principal components" in capsys.readouterr().err
    assert list(Reconstruction.load(second / "evaluation-people.json").rows) == ["motion-latent"]


BRIEF = ["--steps", "3", "--starts", "2", "--candidates", "2", "--newton", "0"]


def impute(capsys, folder, *arguments):
    """Return the table and notes that `dvae impute` prints for the run."""
    assert main(["impute", str(folder / "run"), *map(str, arguments), *BRIEF]) == 0
    captured = capsys.readouterr()
    return " ".join(captured.out.split()), " ".join(captured.err.split())


def test_segments_are_recovered_from_partial_observations(capsys, folder, tmp_path):
    one = ["--from", "person_0001", "--seen", "markers", "--seconds", ".25", "--gaps", ".2", "--samples", "2"]
    one += ["--marker", ".01"]
    table, notes = impute(capsys, folder, *one, "--out", tmp_path / "a.npz")
    for word in ("duration", "markers", "vertex", "left", "behind", "k-hat", "train/person_0001"):
        assert word in table
    assert "1 of 1 segments not converged" in notes
    assert "; try --marker 0." in notes
    assert "train/person_0001, the most probable and 2 draws of each" in notes
    clips = motion.read_motion(tmp_path / "a.npz")
    assert [clip.name for clip in clips] == [f"person_0001-{end}" for end in ("found", "draw-01", "draw-02")]
    again, _ = impute(capsys, folder, *one, "--out", tmp_path / "a.html")
    assert again == table  # the same seed
    page = (tmp_path / "a.html").read_text()
    assert all(name in page for name in ("truth", "most probable", "draw 2"))
    one = ["--from", "person_0001", "--seen", "points", "--frames", "3", "--points", "5", "--known-body"]
    impute(capsys, folder, *one, "--no-aggregate", "--out", tmp_path / "a.bvh")
    assert len(motion.read_motion(tmp_path / "a.bvh")) == 1
    several = ["--from", "person_0001", "test/person_0007", "--seen", "markers", "--frames", "3"]
    table, notes = impute(capsys, folder, *several, "--samples", "0", "--out", tmp_path / "b.npz")
    assert "train/person_0001" in table
    assert "test/person_0007" in table
    assert notes.endswith("train/person_0001, test/person_0007, the most probable")
    assert len(motion.read_motion(tmp_path / "b.npz")) == 2


@pytest.fixture(scope="module")
def loaded_run(folder):
    return dvae.load(folder / "run")


def observations(run, **options):
    """Return observed body markers in two segments of the run, as arrays of a file."""
    truth = run.data.windows("test").all()
    return {
        name: value.numpy()
        for name, value in simulate_observations(run.model, *truth.values(), "markers", **options).items()
    }


def test_observations_in_a_file_need_no_training_data(capsys, folder, loaded_run, tmp_path):
    """Test one and several segments; equal numbers give equal results for every source."""
    without_data = shutil.copytree(folder, tmp_path / "moved")
    change(without_data / "run", ("data", "path"), "gone.npz")
    observed = observations(loaded_run, fps=10.0)
    np.savez(tmp_path / "both.npz", **observed)
    np.savez(tmp_path / "one.npz", **{name: value[0] for name, value in observed.items()})
    table, notes = impute(capsys, without_data, "--file", tmp_path / "both.npz")
    assert "the search starts from this prior only" in notes
    assert "seen/segment-00" in table
    assert "seen/segment-01" in table
    assert "vertex" not in table
    table, notes = impute(capsys, folder, "--file", tmp_path / "one.npz", "--out", tmp_path / "one.html")
    assert "no known segments" not in notes
    assert "&#34;truth&#34;" not in (tmp_path / "one.html").read_text()
    names = [clip.name for clip in dvae.load(folder / "run").data.windows("test").motion]
    expected, _ = impute(capsys, folder, "--from", f"test/{names[0]}", "--seen", "markers", "--fps", "10")
    assert table.split("seen/segment-00 │ ")[1].split(" │ ")[0] in expected


def test_markers_can_be_on_any_vertices(capsys, folder, loaded_run, tmp_path):
    np.savez(tmp_path / "seen.npz", **observations(loaded_run, fps=10.0, markers=(0, 5, 9)))
    name = loaded_run.data.windows("test").motion.clips[0].name
    on = ["--marker-vertices", 0, 5, 9]
    table, _ = impute(capsys, folder, "--file", tmp_path / "seen.npz", *on)
    simulated, _ = impute(capsys, folder, "--from", f"test/{name}", "--seen", "markers", "--fps", "10", *on)
    assert table.split("seen/segment-00 │ ")[1].split(" │ ")[0] in simulated
    wrong = ["impute", str(folder / "run"), "--file", str(tmp_path / "seen.npz")]
    assert "expected (2, " in failure(capsys, *wrong)
    error = failure(capsys, *wrong, "--marker-vertices", "0", "x", code=2)
    assert "Error parsing --marker-vertices" in error
    assert "is not an option" not in error
    assert "marker vertex 999999 does not exist" in failure(capsys, *wrong, "--marker-vertices", "0", "5", "999999")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda arrays: {**arrays, "marker": arrays["markers"]},
            "'marker' is not an observation .did you mean 'markers'",
        ),
        (lambda arrays: {**arrays, "markers": arrays["markers"][:, :, :5]}, r"expected \(2, \d+, 16, 3\)"),
        (
            lambda arrays: {**arrays, "markers": np.nan * arrays["markers"]},
            "segment 0 of 2, counted from 0, has only NaN instead of observations.*remove it",
        ),
        (
            lambda arrays: {**arrays, "markers": 1000 * arrays["markers"]},
            "markers has a coordinate of .* expected metres",
        ),
        (lambda arrays: {**arrays, "markers": arrays["markers"].astype("U8")}, "markers is <U8 .* expected numbers"),
        (lambda arrays: {**arrays, "markers": arrays["markers"].astype(object)}, "pickled objects"),
        (lambda arrays: {**arrays, "times": 1000 * arrays["times"]}, "times go from 0 to .* expected seconds"),
        (lambda arrays: {"markers": arrays["markers"]}, "with their moments"),
        (lambda arrays: {}, "surfaces, points or markers|npz"),
        (
            lambda arrays: {**arrays, "times": np.zeros((2, 1001)), "markers": np.zeros((2, 1001, 16, 3))},
            "at most 1000",
        ),
        (lambda arrays: {**arrays, "points": np.zeros((2, 1, 2**17 + 1, 3))}, "at most 131,072 points per segment"),
    ],
)
def test_files_of_impossible_observations_are_errors(loaded_run, tmp_path, change, message):
    path = tmp_path / "seen.npz"
    np.savez_compressed(path, **change(observations(loaded_run, fps=5.0)))
    with pytest.raises(ValueError, match=f"seen.npz: (.*{message})"):
        read_seen(path, loaded_run.model)


@pytest.mark.parametrize("command", ["forecast RUN --out f.npz", "check calibration RUN", "animate RUN --out f.html"])
def test_forecast_commands_suggest_the_right_command(capsys, folder, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    error = failure(capsys, *command.replace("RUN", str(folder / "run")).split())
    assert "is a fitted motion-latent, which generates whole segments and has no forecasts; use dvae evaluate" in error
    assert "impute" in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("fit motion-latent --protocol cmu8 --out new", "--protocol is for motion, and motion-latent is fitted on"),
        ("fit vae --cut clips --out new", "--cut is for segments of motion, and vae is fitted on motion"),
        ("fit motion-latent --cut clip --out new", "did you mean 'clips'"),
        (
            "sweep motion-latent vae --out new",
            "motion-latent on segments of motion and vae on windows; give methods of",
        ),
        ("impute FITTED --from a", "are for runs of motion-latent"),
        ("evaluate RUN --samples 3", "--samples is for forecasts"),
        ("evaluate RUN FITTED", "on several kinds of data"),
        ("impute RUN", "--from NAME --seen KIND for segments of the run, or --file"),
        ("impute RUN --from person_0001", "--from requires --seen surfaces, points or markers"),
        ("impute RUN --file b.npz --seen points", "--file contains all observations"),
        ("impute RUN --from a --seen markers --frames 3 --fps 10", "--frames is for unknown times"),
        ("impute RUN --from person_0001 --seen markers --frames 101", "segments of this run have 100"),
        ("impute RUN --from person_0001 --seen markers --points 9", "--points is for --seen points"),
        ("impute RUN --from person_0001 --seen points --marker-vertices 3", "--marker-vertices is for markers, but"),
        ("impute RUN --from a --seen markers --samples 101", "--samples is 101; it must be at most 100"),
        ("impute RUN --from person_0001 person_0001 --seen markers", "names a segment twice"),
        ("impute RUN --from person_0001 person_0002 --seen markers --out a.html", "can show one of 2 segments"),
        ("impute RUN --from a --seen markers --out a.gif", "end the name in .npz or .html or"),
    ],
)
def test_wrong_arguments_exit_with_2(capsys, folder, fitted, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    command = arguments.replace("RUN", str(folder / "run")).replace("FITTED", str(fitted)).split()
    assert message in failure(capsys, *command, code=2)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        (("data", "cut"), "steps", "unknown cut 'steps'"),
        (("data", "kind"), "motion", "require a schema of kind 'poses', got 'segments'"),
        (("schema", "timed", "frames"), 16384, "is larger than its weights"),
        (("schema", "timed", "skeleton", "names"), ["a"], "skeleton|names|parents"),
    ],
)
def test_a_config_out_of_range_is_an_error(run, keys, value, message):
    change(run, keys, value)
    with pytest.raises(dvae.inference.training.checkpoints.CheckpointError, match=message):
        dvae.load(run)


def test_segments_are_generated_from_the_prior(capsys, folder, tmp_path):
    run, page = str(folder / "run"), tmp_path / "a.html"
    assert main(["generate", run, "--samples", "6", "--shown", "2", "--out", str(page)]) == 0
    output = capsys.readouterr().out
    assert all(word in output for word in ("N(0, I)", "fitted normal", "real", "sliding", "APD", "plausible", "KL"))
    assert all(name in page.read_text() for name in ("from N(0, I), 2", "real"))
    fixed = ["--seconds", "2", "--tolerance", "2", "--beta", *["0.5"] * 8, "--samples", "3"]
    assert main(["generate", run, *fixed, "--out", str(tmp_path / "a.npz")]) == 0
    assert [clip.name for clip in motion.read_motion(tmp_path / "a.npz")] == [f"sample-0{n}" for n in range(3)]
    assert "--beta has 1 numbers, expected 8" in failure(capsys, "generate", run, "--beta", "1", code=2)
    assert "real segments last 9 ± 0.05 s" in failure(capsys, "generate", run, "--seconds", "9", code=2)
