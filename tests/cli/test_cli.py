"""The command line: results, errors and signals."""

import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch

import dvae
from dvae import motion
from dvae.cli import main
from dvae.cli.app import exit_code
from dvae.inference.diagnostics.reference_posterior import ReferencePosterior
from dvae.inference.diagnostics.stein import SteinDiscrepancy
from dvae.motion.data.dataset import MotionData
from dvae.runs import directory as runs

SMALL = ["--batch-size", "4", "--warm-up", "4", "--latent", "3", "--validate-every", "5"]
EQUATIONS = ["--generative", "p(z_t | z_{t-1}) p(x_t | z_t)", "--inference", "q(z_t | x_{t:T}, z_{t-1})"]


def failure(capsys, *arguments, code=1):
    """Return the error message of a failing command."""
    assert main(list(arguments)) == code
    error = capsys.readouterr().err
    assert "Traceback" not in error
    return error


def write_human36m(folder, frames=340):
    """Write exponential maps in the layout of h3.6m.zip."""
    random, time = np.random.default_rng(0), np.arange(frames)[:, None] / 50
    for name in ("S1/walking", "S5/eating", "S5/walking"):
        for number in (1, 2):
            file = folder / f"{name}_{number}.txt"
            file.parent.mkdir(parents=True, exist_ok=True)
            rows = np.zeros((frames, 99))
            rows[1:, 2] = 20.0  # mm per frame
            rows[:, 6:15] = 0.3 * np.sin(2 * np.pi * (time * random.random(9) + random.random(9)))
            np.savetxt(file, rows, fmt="%.7f", delimiter=",")


def test_the_route_of_mix_and_match_from_human36m_to_its_measures(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_human36m(tmp_path / "dataset")
    assert main(["data", "convert", "dataset", "--out", "h36m.npz", "--fps", "25"]) == 0
    options = "--kl 1 --width 4 --steps 2 --batch-size 4 --out run"
    assert main(f"fit mix-and-match --data h36m.npz --representation quaternion {options}".split()) == 0
    assert dvae.load("run").schema.protocol.name == "h36m-angles"
    capsys.readouterr()
    assert main(["evaluate", "run", "--measure", "angles", "--actions", "--samples", "2"]) == 0
    output = capsys.readouterr().out
    assert "1000 ms, best of 2" in output
    assert all(f"│ {row} " in output for row in ("eating", "walking", "mean"))
    quick = "--quality-width 4 --quality-examples 6 --quality-steps 2 --quality-seeds 1"
    for measure, column in ((f"quality {quick}", "taken for real"), ("codes --samples 3", "untrained")):
        assert main(f"evaluate run --measure {measure}".split()) == 0
        assert column in " ".join(capsys.readouterr().out.split())
    assert {path.name for path in Path("run").glob("*.json")} >= {"angles-by-action.json", "quality.json", "codes.json"}
    for arguments, message in (
        ("quality --samples 2", "--samples does not apply to --measure quality"),
        ("quality --actions", "options of --measure angles do not apply to --measure quality"),
        ("codes --figure a.png", "has no figure"),
        ("codes --bound-particles 2", "do not apply to --measure codes"),
    ):
        assert message in " ".join(failure(capsys, *f"evaluate run --measure {arguments}".split(), code=2).split())


def test_every_method_is_listed_with_its_equations(capsys):
    assert main(["list"]) == 0
    output = capsys.readouterr().out
    for name, kind in dvae.methods().items():
        assert name in output
        assert kind.source.split(",")[0] in output
        texts = [*dvae.methods().texts(name, "generative", "inference"), kind.source]
        assert texts == [*((None, None) if name == "equations" else (kind.generative, kind.inference)), kind.source]


def test_methods_are_listed_without_importing_them():
    program = "import sys; from dvae.cli import main; main(['list']); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, check=False).returncode == 0


def test_show_prints_the_audit_and_draws_the_graph(capsys, tmp_path):
    def show(*arguments):
        assert main(["show", *arguments]) == 0
        return capsys.readouterr().out

    output = show("hit-dvae", "--out", str(tmp_path / "graph.png"))
    assert "∏_t p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)" in output
    assert "z_{<t}" in next(line for line in output.splitlines() if "q(z_t" in line and "│" in line)
    assert "not exact" in output
    assert (tmp_path / "graph.png").read_bytes().startswith(b"\x89PNG")
    assert "exact: the guide reads everything" in show(*EQUATIONS)
    assert "q(z_t | z_{t-1}, x_{>=t})" in show(*EQUATIONS[:2])
    assert "│ z_{<=t-2} │" in show("rslds")  # its states are summed out
    assert "the model has no latents" in show("--generative", "p(x_t | x_{<t})", "--inference", "")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("show", "--generative, with --inference"),
        ("show srnn --generative p(x_t)", "not both"),
        ("fit", "dvae fit --help"),
        ("data get", "dvae data get --help"),
        ("sweep --step 4", "--step is not an option of dvae sweep (did you mean '--steps'"),
        ("fit vae --optimizer adm --out run", "did you mean 'adam'"),
        ("fit vae --learning-rate -1 --out run", "learning_rate is -1.0; it must be finite and at least 0"),
        ("fit vae --decay 1.5 --out run", "decay is 1.5; it must be between 0 and 1"),
        ("fit vae --latent 0 --out run", "latent is 0"),
        ("fit vae --batch-size 0 --out run", "batch_size is 0"),
        ("fit vae --accelerator abacus --out run", "abacus"),
        ("fit vae --out FILE", "is a file; name a directory"),
        ("resume RUN --steps 0", "steps is 0"),
        ("evaluate RUN --samples 0", "--samples is 0; it must be at least 1"),
        ("compare RUN --samples 0", "--samples must be at least 1, got 0; use --no-forecasts"),
        ("evaluate RUN --bound-particles -1", "--bound-particles is -1; it must be at least 0"),
        ("evaluate RUN --out .", "--out . is a directory; name a file"),
        ("evaluate RUN --figure scores.xyz", "--figure scores.xyz: the suffix selects the format, one of"),
        ("evaluate", "at least one run"),
        ("evaluate RUN RUN", "named twice"),
        ("show srnn --out graph", "--out graph: the suffix selects the format"),
    ],
)
def test_wrong_arguments_exit_with_2_before_any_work(capsys, tmp_path, monkeypatch, people, fitted, arguments, message):
    monkeypatch.chdir(tmp_path)
    error = failure(capsys, *arguments.replace("RUN", str(fitted)).replace("FILE", str(people)).split(), code=2)
    assert message in " ".join(error.replace("│", " ").split())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("arguments", [["show", "vae", "--out", "graph.png"], ["list"], ["fit", "--help"]])
def test_a_closed_pipe_still_writes_the_files(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as unread, monkeypatch.context() as patched:
        patched.setattr(sys, "stdout", unread)
        code = main(arguments)
    assert code == 128 + signal.SIGPIPE
    assert not [name for name in arguments if name.endswith(".png") and not (tmp_path / name).exists()]


def test_a_closed_standard_output_is_no_error(tmp_path):
    program = f"from dvae.cli.console import OUT; OUT.print('a'); print(open({str(tmp_path / 'a')!r}, 'w').fileno())"
    started = subprocess.run(["sh", "-c", '"$0" "$@" >&-', sys.executable, "-c", program], capture_output=True)
    assert (started.returncode, started.stderr) == (0, b"")
    assert (tmp_path / "a").read_bytes() == b""


def test_all_options_of_equations_are_listed(capsys):
    assert main(["fit", "equations", "--help-all"]) == 0
    assert "--latents" in capsys.readouterr().out


def test_version_is_printed(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"dvae {dvae.__version__}\n"


def test_an_invalid_motion_file_is_an_error(capsys, tmp_path, people):
    class Hostile:
        def __reduce__(self):
            return os.system, ("true",)

    hostile, text, metres = (tmp_path / f"{name}.npz" for name in ("hostile", "text", "metres"))
    np.savez(hostile, positions_3d=np.array(Hostile(), dtype=object))
    text.write_text("not a zip archive")
    shutil.copy(people.with_name("people.npz.skeleton.json"), tmp_path / "skeleton.json")
    np.savez(metres, **{"train/a": 1000 * np.load(people)["train/person_0000"]})
    assert "no such file" in failure(capsys, "data", "info", str(tmp_path / "nowhere.npz"))
    assert "system" in failure(capsys, "data", "info", str(hostile))
    assert str(text) in failure(capsys, "data", "info", str(text))
    assert "millimetres" in failure(capsys, "data", "info", str(metres))
    assert "no clips; 1 were skipped" in failure(capsys, "data", "info", str(metres), "--skip-bad")


def test_the_human36m_archive_needs_no_skeleton(capsys, tmp_path):
    walks = motion.simulate(clips=14, frames=140, seed=3)
    subjects = [f"S{i}" for i in (1, 5, 6, 7, 8, 9, 11)]
    nested = {subject: {} for subject in subjects}
    for i, walk in enumerate(walks):
        full = np.zeros((140, 32, 3), np.float32)
        full[:, list(motion.HUMAN36M_KEPT)] = walk.positions[..., [2, 0, 1]]  # z up
        nested[subjects[i % 7]][f"Walking {i // 7}"] = full
    path = str(tmp_path / "data_3d_h36m.npz")
    np.savez_compressed(path, positions_3d=np.array(nested, dtype=object))
    assert main(["data", "info", path]) == 0
    assert "human36m: 17 joints, z up" in capsys.readouterr().out
    run = str(tmp_path / "run")
    assert main(["fit", "vae", "--data", path, "--protocol", "h36m", "--out", run, "--steps", "4", *SMALL]) == 0
    fitted_run = dvae.load(run)
    assert fitted_run.model.sizes["x"] == 48
    assert {clip.split for clip in fitted_run.data.windows("test").clips} == {"S9", "S11"}


def test_an_evaluation_is_printed_and_stored_with_its_data_and_config(capsys, run, people):
    assert main(["evaluate", str(run), "--samples", "3", "--figure", str(run / "scores.png")]) == 0
    output = capsys.readouterr().out
    for word in ("zero velocity", "nearest neighbours", "ADE", "ELBO", "vae"):
        assert word in output
    evaluation = dvae.Evaluation.load(run / "evaluation.json")
    assert evaluation.samples == 3
    assert evaluation.rows["vae"].config["data"]["path"] == str(people)
    assert evaluation.data["fingerprint"] == dvae.load(run).data.windows("test").fingerprint
    assert (run / "scores.png").exists()


def test_only_windows_with_several_futures_are_evaluated_on_request(capsys, run, tracker, people, tmp_path):
    walks = motion.read_motion(people)
    first = next(clip for clip in walks if clip.split == "test")
    motion.save(tmp_path / "twins.npz", motion.MotionSet([*walks, replace(first, name="twin")], walks.skeleton))
    arguments = ["evaluate", str(run), "--data", str(tmp_path / "twins.npz"), "--samples", "2", "--several-futures"]
    assert main(arguments) == 0
    (out,) = run.glob("evaluation-*several-futures.json")
    evaluation = dvae.Evaluation.load(out)
    assert {*evaluation.clusters} == {f"test/{first.name}", "test/twin"}
    assert evaluation.data["windows"] == 4
    assert "4 of 8 windows, those with several" in capsys.readouterr().out.replace("\n", "")
    assert "none of the 6 windows" in failure(capsys, "evaluate", str(run), "--several-futures")
    exchange = ["--several-futures", "--joints", "RFoot", "--exchange", "2"]
    assert "exchanged poses do not have" in failure(capsys, "evaluate", str(tracker), *exchange, code=2)


def test_evaluating_runs_on_different_windows_is_an_error(capsys, run, people, tmp_path):
    other = tmp_path / "other"
    motion.save(tmp_path / "few.npz", motion.simulate(clips=12, frames=90, seed=2))
    data = str(tmp_path / "few.npz")
    assert main(["fit", "vae", "--data", data, "--out", str(other), "--steps", "5", *SMALL]) == 0
    capsys.readouterr()
    assert "other test windows" in failure(capsys, "evaluate", str(run), str(other))


def test_forecasts_continue_the_observed_frames(capsys, run, tmp_path):
    out = tmp_path / "futures.npz"
    assert main(["forecast", str(run), "--out", str(out), "--samples", "2", "--figure", f"{out}.png"]) == 0
    windows = dvae.load(run).data.windows("test")
    with np.load(out) as file:
        assert file["forecasts"].shape == (2, len(windows), 60, 17, 3)
        assert file["observed"].shape == (len(windows), 15, 17, 3)
        keys = zip(file["split"].tolist(), file["clip"].tolist(), file["start"].tolist(), strict=True)
        assert list(keys) == windows.keys
        truth = windows.positions(windows.all()["x"][:, 15:])
        np.testing.assert_array_equal(file["truth"], truth.numpy())
    assert main(["forecast", str(run), "--out", str(out), "--clip", "person_0000", "--horizon", "80"]) == 0
    with np.load(out) as file:
        assert file["forecasts"].shape[::2] == (10, 80, 3)
        assert set(file["split"]) == {"train"}
    assert "no clip 'nobody'" in failure(capsys, "forecast", str(run), "--out", str(out), "--clip", "nobody")


def test_a_diffusion_of_all_frames_has_a_bound_and_no_forecasts(people, tmp_path, capsys):
    run = str(tmp_path / "run")
    equations = ["--generative", "p(x_{1:T})", "--inference", "", "--emission", "diffusion", "--width", "8"]
    assert main(["fit", "equations", *equations, "--data", str(people), "--out", run, "--steps", "2", *SMALL[:2]]) == 0
    assert f"the model has no forecasts; compare its bound with: dvae compare {run} --no-forecasts" in (
        " ".join(capsys.readouterr().out.split())
    )
    assert "so the model cannot forecast" in failure(capsys, "evaluate", run)
    assert main(["compare", run, "--no-forecasts", "--out", str(tmp_path / "bounds.json")]) == 0


def test_custom_equations_are_fitted_and_loaded(people, tmp_path):
    out = tmp_path / "own"
    options = ["--latents", "z", "2", "--network", "dense", "--steps", "5", *SMALL]
    assert main(["fit", "equations", *EQUATIONS, *options, "--data", str(people), "--out", str(out)]) == 2
    options[options.index("dense")] = "recurrent"  # the dense network cannot read x_{t:T}
    assert main(["fit", "equations", *EQUATIONS, *options, "--data", str(people), "--out", str(out)]) == 0
    fitted_run = dvae.load(out)
    assert fitted_run.model.sizes == {"z": 2, "x": 48}
    assert str(fitted_run.model.inference) == str(dvae.Factorization.parse(EQUATIONS[3]))


@pytest.fixture(scope="module")
def tracker(people, tmp_path_factory):
    """A run of a method that follows paths."""
    out = tmp_path_factory.mktemp("runs") / "tracker"
    small = ["--latent", "4", "--width", "8", "--feedforward", "8", "--layers", "1", "--batch-size", "4"]
    options = ["--data", str(people), "--protocol", "simulated-trajectories", "--out", str(out)]
    assert main(["fit", "trajevae", *options, "--steps", "6", "--validate-every", "3", *small]) == 0
    return out


@pytest.mark.filterwarnings("ignore:only .* of the bones")  # a barely fitted model
def test_motion_is_completed_along_the_paths_of_a_clip_or_a_file(capsys, tracker, tmp_path):
    out, figure = tmp_path / "walk.npz", tmp_path / "walk.png"
    run = ["forecast", str(tracker), "--clip", "person_0003"]

    def complete(*options):
        assert main([*run, "--out", str(out), *options]) == 0
        return motion.Forecasts.load(out)

    joints = ["--joints", "left_wrist, RFoot", "--samples", "2"]
    forecasts = complete(*joints, "--figure", str(figure))
    assert "LWrist: off its path by" in capsys.readouterr().out
    assert figure.exists()
    assert forecasts.forecasts.shape == (2, 1, 60, 17, 3)
    assert forecasts.observed.shape == (1, 1, 17, 3)
    assert forecasts.keys[0][1] == "person_0003"
    assert np.array_equal(complete(*joints).forecasts, forecasts.forecasts)
    still = complete(*joints, "--temperature", "0").forecasts
    assert np.array_equal(still[0], still[1])
    assert not np.array_equal(complete(*joints, "--window", "0").truth, complete(*joints, "--window", "1").truth)
    hand = forecasts.truth[0, :30, 13]
    rows = ["LWrist_x,LWrist_y,LWrist_z", *(f"{x},{y},{z}" for x, y, z in hand), ",,"]
    (tmp_path / "hand.csv").write_text("\n".join(rows))
    np.savez(tmp_path / "hand.npz", LWrist=np.concatenate([hand, np.full((1, 3), np.nan)]))
    for kind in ("csv", "npz"):
        completed = complete("--paths", str(tmp_path / f"hand.{kind}"), "--samples", "1", "--exact").forecasts
        assert completed.shape == (1, 1, 31, 17, 3)
        assert np.abs(completed[0, 0, :30, 13] - hand).max() < 1e-4
    error = failure(
        capsys, *run, "--out", str(out), "--joints", "LWrist", "--paths", str(tmp_path / "hand.csv"), code=2
    )
    assert "LWrist: both --joints and" in error


def test_an_evaluation_conditions_on_paths(capsys, tracker, fitted, tmp_path):
    out = ["--samples", "2", "--out", str(tmp_path / "scores.json")]
    assert main(["evaluate", str(tracker), "--joints", "RFoot,LFoot", "--temperature", "0", *out]) == 0
    evaluation = dvae.Evaluation.load(tmp_path / "scores.json")
    assert evaluation.data["given"] == ["RFoot", "LFoot"]
    assert evaluation["trajevae"]["path error"].mean > 0
    assert evaluation["trajevae"]["APD"].mean == 0
    assert "no joint 'RPaw'" in failure(capsys, "evaluate", str(tracker), "--joints", "RPaw", *out)
    error = failure(capsys, "evaluate", str(fitted), "--joints", "RFoot", *out, code=2)
    assert "are for methods that take trajectories" in error
    error = failure(capsys, "evaluate", str(tracker), "--exchange", ".01", *out)
    assert "1 observed frames and no given joints" in error
    assert main(["evaluate", str(tracker), "--joints", "RFoot", "--samples", "2", "--exchange", "2"]) == 0
    assert dvae.Evaluation.load(tracker / "evaluation-RFoot-exchanged-2.json").data["exchanged"]["threshold"] == 2


def test_models_that_start_from_a_pose_have_predictive_checks_only(capsys, tracker, tmp_path):
    out = tmp_path / "calibration.json"
    assert main(["check", "calibration", str(tracker), "--samples", "19", "--out", str(out)]) == 0
    assert "no calibration" in capsys.readouterr().err
    document = json.loads(out.read_text())
    assert list(document) == ["predictive"]
    assert document["predictive"]["attributes"]["emission"] == "mean"


def test_impossible_completions_are_errors(capsys, tracker, fitted, people, tmp_path):
    out = ["--out", str(tmp_path / "walk.npz")]
    along = ["--joints", "LWrist"]
    assert "which takes no paths" in failure(capsys, "forecast", str(fitted), *out, *along, code=2)
    assert "with --joints or --paths" in failure(capsys, "forecast", str(tracker), *out, "--exact", code=2)
    assert "no joint 'tail'" in failure(capsys, "forecast", str(tracker), *out, "--joints", "tail")
    assert "none.csv" in failure(capsys, "forecast", str(tracker), *out, "--paths", str(tmp_path / "none.csv"))
    error = failure(capsys, "fit", "trajevae", "--data", str(people), "--out", str(tmp_path / "run"), "--steps", "2")
    assert "observed=1, such as" in error
    assert "simulated-trajectories" in error


def log(run):
    return [row for row in map(json.loads, (run / "log.jsonl").read_text().splitlines()) if "learning_rate" in row]


@pytest.mark.filterwarnings("ignore:.*it is shortened to:UserWarning")
def test_resuming_with_more_steps_rescales_the_schedules(people, tmp_path):
    """The learning rate falls over the second half of all steps, scheduled sampling rises over the first half."""
    out, options = tmp_path / "run", ["--width", "8", "--scheduled-sampling", "0.5", *SMALL]
    fit = ["fit", "vrnn", "--data", str(people), "--out", str(out), "--learning-rate", "0.01", "--tensorboard"]
    assert main([*fit, "--steps", "20", *options]) == 0
    assert [row["learning_rate"] for row in log(out)] == pytest.approx([0.01, 0.001])
    assert len(list(out.glob("events.*"))) == 1
    assert main(["resume", str(out), "--steps", "60", "--tensorboard"]) == 0
    assert len(list(out.glob("events.*"))) == 2
    rates = [row["learning_rate"] for row in log(out)]
    assert rates[2:] == pytest.approx([0.01, 0.01 * 21 / 30, 0.01 * 11 / 30, 0.01 / 30])
    feeding = dvae.load(out).method.train({}, steps=60).feeding
    assert [row["scheduled_sampling"] for row in log(out)][2:] == pytest.approx(
        [feeding(s - 1) for s in (30, 40, 50, 60)]
    )
    assert main(["resume", str(out), "--steps", "70", "--learning-rate", "0.02"]) == 0
    assert log(out)[-1]["learning_rate"] == pytest.approx(0.02 / 35)


def test_a_run_fitted_on_a_gpu_resumes_without_one(people, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    out = tmp_path / "run"
    assert main(["fit", "vae", "--data", str(people), "--out", str(out), "--steps", "4", *SMALL]) == 0
    config = out / "config.json"
    config.write_text(config.read_text().replace('"accelerator": "auto"', '"accelerator": "cuda"'))
    assert "'auto' uses an available one" in failure(capsys, "resume", str(out), "--steps", "5")
    assert main(["resume", str(out), "--steps", "5", "--accelerator", "auto"]) == 0


def test_only_the_first_process_prints_and_each_reports_its_errors(capsys, monkeypatch):
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert main(["list"]) == 0
    assert capsys.readouterr() == ("", "")
    assert "unknown command" in failure(capsys, "lst", code=2)
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    monkeypatch.setenv("RANK", "0")
    assert main(["list"]) == 0
    assert "srnn" in capsys.readouterr().out


def test_a_command_restarted_by_torchrun_resumes_its_run(people, tmp_path, capsys, monkeypatch):
    environment = {
        "TORCHELASTIC_RUN_ID": "none",
        "TORCHELASTIC_MAX_RESTARTS": "1",
        "WORLD_SIZE": "1",
        "LOCAL_WORLD_SIZE": "1",
    }
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    arguments = ["fit", "vae", "--data", str(people), "--out", str(tmp_path / "run"), "--steps", "5", *SMALL]
    assert main(arguments) == 0
    assert main(arguments) == 0
    assert "contains a run; continuing it" in capsys.readouterr().err
    monkeypatch.setenv("TORCHELASTIC_MAX_RESTARTS", "0")
    assert "already contains a run" in failure(capsys, *arguments)
    assert "start it without torchrun" in failure(capsys, "sweep", "vae", "--out", str(tmp_path / "runs"))


def test_a_method_with_a_custom_objective_resumes(people, tmp_path, monkeypatch):
    steps = []

    @dataclass(frozen=True)
    class Plain(type(dvae.method("vae"))):
        name: ClassVar[str] = "plain"

        def objective(self):
            return lambda terms, step: (steps.append(step), -terms.bound.sum() / terms.n_steps.sum())[1]

    methods = {**dvae.methods(), "plain": Plain}
    monkeypatch.setattr("dvae.models.registry.methods", lambda: methods)
    training = dvae.Training(steps=3, batch_size=4, progress=False)
    dvae.fit(Plain(latent=3), MotionData.open(people), out=tmp_path / "run", **vars(training))
    runs.resume(tmp_path / "run", steps=5)
    assert steps == [0, 1, 2, 3, 4]


def test_scheduled_sampling_is_an_option_of_the_method(people, tmp_path):
    with pytest.raises(ValueError, match=r"pass it to the method: dvae\.method\(…, scheduled_sampling=…\)"):
        dvae.fit(
            dvae.method("vrnn"),
            MotionData.open(people),
            out=tmp_path / "run",
            **vars(dvae.Training(scheduled_sampling=0.5)),
        )


def test_existing_and_missing_runs_are_errors(capsys, run, people, tmp_path):
    again = ["fit", "vae", "--data", str(people), "--out", str(run)]
    assert f"with: dvae resume {run}; or" in failure(capsys, *again)
    state = json.loads((run / "state.json").read_text())
    (run / "state.json").write_text(json.dumps({**state, "status": "failed"}))
    assert f"dvae resume {run} --learning-rate 0.0001; or" in failure(capsys, *again)
    assert "is not a run directory" in failure(capsys, "resume", str(tmp_path / "none"))
    assert "is not a run directory" in failure(capsys, "evaluate", str(tmp_path))


def test_a_damaged_run_is_an_error(capsys, run):
    weights = run / "best.safetensors"
    good = weights.read_bytes()
    weights.write_bytes(good[:-1] + bytes([good[-1] ^ 1]))
    assert "is damaged or from another run" in failure(capsys, "evaluate", str(run))
    weights.write_bytes(good)
    (run / "last.state.safetensors").write_bytes(pickle.dumps(os.getcwd))
    assert "is damaged or from another run" in failure(capsys, "resume", str(run))
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps({**config, "method": {**config["method"], "latent": 4}}))
    assert "weights of another model" in failure(capsys, "evaluate", str(run))
    (run / "config.json").write_text(json.dumps({"method": config["method"]}))
    assert "does not describe method, schema, data and training" in failure(capsys, "evaluate", str(run))
    (run / "config.json").write_text("{")
    assert "not JSON" in failure(capsys, "evaluate", str(run))


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        ([], []),
        (["format"], 3),
        (["method"], "vae"),
        (["method", "latent"], "wide"),
        (["data", "fingerprint"], None),
        (["schema", "protocol", "unknown"], 3),
        (["training", "learning_rate"], {"schedule": "Falling"}),
    ],
)
def test_a_config_with_wrong_types_is_an_error(capsys, run, keys, value):
    config = content = json.loads((run / "config.json").read_text())
    for key in keys[:-1]:
        content = content[key]
    if keys:
        content[keys[-1]] = value
    (run / "config.json").write_text(json.dumps(config if keys else value))
    error = failure(capsys, "resume", str(run), "--steps", "12")
    assert "config.json" in error or "is a run of format 3, and this version of dvae reads format 2" in error
    assert "looks like a bug" not in error


def test_moved_data_are_found_and_changed_data_are_an_error(capsys, people, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("people.npz", "people.npz.skeleton.json", "people.npz.labels.csv"):
        shutil.copy(people.with_name(name), tmp_path)
    assert main(["fit", "vae", "--data", "people.npz", "--out", "run", "--steps", "5", *SMALL]) == 0
    assert json.loads(Path("run/config.json").read_text())["data"]["path"] == "people.npz"
    Path("elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    capsys.readouterr()
    assert main(["evaluate", "../run", "--data", "../people.npz", "--samples", "2"]) == 0
    motion.save(tmp_path / "people.npz", motion.simulate(clips=14, frames=90, seed=5))
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    assert "has changed since run was fitted" in failure(capsys, "evaluate", "run")


def test_a_run_works_without_its_training_data(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate(("own", "other")):
        motion.save(tmp_path / name / "people.npz", motion.simulate(clips=14, frames=90, seed=seed))
    for name in ("run", "second"):
        fit = ["fit", "vae", "--data", "own/people.npz", "--out", name, "--seed", str(len(name))]
        assert main([*fit, "--steps", "4", *SMALL]) == 0
    shutil.rmtree("own")
    other = ["--data", "other/people.npz"]
    assert dvae.load("run").model.sizes["x"] == 48
    capsys.readouterr()
    for command in ("forecast run --out f.npz", "evaluate run", "compare run", "resume run --steps 6"):
        assert "or other data (--data)" in failure(capsys, *command.split())
    assert "own/people.npz does not exist" in failure(capsys, "resume", "run", "--data", "own/people.npz")
    assert "has changed since" in failure(capsys, "resume", "run", *other)
    for command in (
        "forecast run --out f.npz --samples 2",
        "evaluate run second --samples 2",
        "compare run second --samples 2 --particles 4 --contrasts 0 --filter-particles 2",
        "check calibration run --simulations 20 --draws 9 --samples 19",
        "animate run --out f.html",
    ):
        capsys.readouterr()
        assert main([*command.split(), *other]) == 0
        assert "note: other/people.npz is not the data that run was fitted on" in capsys.readouterr().err
    windows = MotionData.open("other/people.npz").windows("test")
    assert motion.Forecasts.load("f.npz").keys == windows.keys
    evaluation = dvae.Evaluation.load("run/evaluation-people.json")
    assert evaluation.data["fingerprint"] == windows.fingerprint
    assert set(evaluation.rows) == {"zero velocity", "run", "second"}  # nearest neighbours need the training data


def test_a_guide_is_compared_with_its_posterior(capsys, run, tmp_path):
    """Few draws do not converge, and latents are inferred from the frames only."""
    few = ["--windows", "2", "--frames", "2", "--draws", "4", "--chains", "2", "--warmup", "1", "--stein-draws", "9"]
    assert main(["check", "posterior", str(run), *few, "--figure", str(tmp_path / "a.png")]) == 0
    document = json.loads((run / "posterior.json").read_text())
    reference = ReferencePosterior.of(document["posterior"])
    assert reference.shapes == {"z": (2, 3)}
    assert reference.sequences == (0, 1)
    assert len(document["windows"]) == 2
    assert SteinDiscrepancy.of(document["stein"]).numbers.tolist() == [6, 6]
    assert "did not converge" in capsys.readouterr().out
    assert {path.name for path in tmp_path.glob("*.png")} == {"a-stein.png", "a-posterior.png"}


def test_data_with_other_joints_are_errors_unless_they_match(capsys, run, tmp_path):
    clips = motion.simulate(clips=14, frames=90, seed=1)
    skeleton = replace(clips.skeleton, name="stranger", fps=60.0)
    motion.save(tmp_path / "far" / "people.npz", motion.MotionSet(list(clips), skeleton, "people"))
    error = failure(capsys, "evaluate", str(run), "--data", str(tmp_path / "far" / "people.npz"))
    assert f"people.npz do not match the run {run}: " in error
    assert "skeleton.name is 'stranger', not 'walker'" in error
    assert "skeleton.fps is 60.0, not 30.0" in error
    other = motion.simulate(clips=8, frames=90, seed=5)
    motion.write_motion(tmp_path / "bvh", other, "bvh")  # other names for the joints of the run
    command = [
        "forecast",
        str(run),
        "--data",
        str(tmp_path / "bvh"),
        "--out",
        str(tmp_path / "f.npz"),
        "--samples",
        "1",
    ]
    assert main(command) == 0
    assert "its joints are matched with those of" in capsys.readouterr().err


def test_debug_prints_the_traceback(capsys, tmp_path):
    assert main(["data", "info", str(tmp_path / "nowhere.npz"), "--debug"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_ctrl_c_leaves_a_run_that_resumes(people, tmp_path):
    run = tmp_path / "run"
    command = [sys.executable, "-m", "dvae", "fit", "vae", "--data", str(people), "--out", str(run)]
    process = subprocess.Popen(
        [*command, "--steps", "100000", *SMALL], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        deadline = time.monotonic() + 120
        log = run / "log.jsonl"
        while not (log.exists() and log.read_text()) and time.monotonic() < deadline:
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        error = process.communicate(timeout=60)[1]
    finally:
        process.kill()
    assert process.returncode == 130
    assert f"resume with: dvae resume {run}" in error
    assert "Traceback" not in error
    stopped = json.loads((run / "state.json").read_text())
    assert stopped["status"] == "interrupted"
    assert main(["resume", str(run), "--steps", str(stopped["step"] + 5)]) == 0
    assert json.loads((run / "state.json").read_text())["step"] == stopped["step"] + 5


def test_a_second_ctrl_c_changes_no_exit_code():
    before = signal.getsignal(signal.SIGINT)
    try:
        assert exit_code(lambda: signal.raise_signal(signal.SIGINT)) == 130
        signal.raise_signal(signal.SIGINT)
        assert exit_code(lambda: 3) == 3
    finally:
        signal.signal(signal.SIGINT, before)


def test_scores_are_equal_for_every_format_and_representation(people, tmp_path, capsys):
    """Models of positions, fitted to npz, and of rotations, fitted to BVH, have equal scores on both files."""
    folder, npz, options = tmp_path / "bvh", tmp_path / "all.npz", ["--samples", "3"]
    motion.write_motion(folder, motion.read_motion(people), "bvh")
    motion.save(npz, motion.read_motion(folder))
    runs = [str(tmp_path / form) for form in ("positions", "6d")]
    for data, run, form in zip((npz, folder), runs, ("positions", "6d"), strict=True):
        fit = ["fit", "srnn", "--data", str(data), "--representation", form, "--steps", "5", *SMALL]
        assert main([*fit, "--out", run]) == 0

    def table(*arguments):
        out = tmp_path / "evaluation.json"
        assert main(["evaluate", *arguments, *options, "--out", str(out)]) == 0
        return dvae.Evaluation.load(out)

    forms = table(*runs, "--data", str(npz))
    assert any("bounds of 6d: densities of joint rotations" in note for note in forms.notes)
    for run in runs:
        name = Path(run).name
        for other in (table(run, "--data", str(npz)), table(run, "--data", str(folder))):
            assert {score: value.mean for score, value in other["srnn"].items()} == pytest.approx(
                {score: value.mean for score, value in forms[name].items()}, rel=1e-4, abs=1e-6
            )
    capsys.readouterr()
    assert "bounds are comparable only as densities of the same" in failure(
        capsys, "compare", *runs, "--data", str(npz)
    )
    page, futures = tmp_path / "page.html", str(tmp_path / "f.npz")
    assert main(["report", *runs, "--data", str(npz), "--windows", "1", "--out", str(page)]) == 0
    assert page.read_text(encoding="utf-8").count("<canvas") == 2
    assert main(["forecast", runs[1], "--samples", "2", "--horizon", "4", "--out", futures]) == 0
    forecasts = motion.Forecasts.load(futures)
    lengths = forecasts.skeleton.bone_lengths(forecasts.forecasts)  # constant
    np.testing.assert_allclose(lengths, lengths[:1, :, :1].repeat(2, 0).repeat(4, 2), atol=1e-5)
    other = ["fit", "gsps", "--data", str(people), "--representation", "6d", "--out", str(tmp_path / "other")]
    assert "gsps reads positions of joints" in failure(capsys, *other, "--steps", "2")


def test_prediction_bands_are_calibrated_on_validation_windows_or_labelled_clips(capsys, tmp_path):
    clips = motion.simulate(clips=30, frames=90, seed=1)
    styled = [replace(clip, labels={"style": "ab"[n % 2]}) for n, clip in enumerate(clips)]
    styled[0] = replace(styled[0].between(0, 60), split="test", name="short")
    motion.save(tmp_path / "people.npz", motion.MotionSet(styled, clips.skeleton, clips.name))
    run = tmp_path / "run"
    assert main(["fit", "vae", "--data", str(tmp_path / "people.npz"), "--out", str(run), "--steps", "5", *SMALL]) == 0
    assert "too short for one: short" in capsys.readouterr().err
    assert main(["check", "coverage", str(run), "--samples", "4", "--level", ".5"]) == 0
    data = dvae.load(run).data
    assert dvae.PredictionBands.load(run / "coverage.json").clusters == len(data.windows("validation").clips)
    options = [
        "--label",
        "style",
        "--values",
        "a",
        "--out",
        str(tmp_path / "a.json"),
        "--figure",
        str(tmp_path / "a.png"),
    ]
    assert main(["check", "coverage", str(run), "--samples", "4", "--level", ".5", *options]) == 0
    assert "calibrated 50 %, future" in capsys.readouterr().out
    test = data.windows("test").clips
    assert dvae.PredictionBands.load(tmp_path / "a.json").clusters == sum(clip.labels["style"] == "a" for clip in test)
    assert (tmp_path / "a.png").stat().st_size
    for arguments, message in (
        (["--label", "style"], "select the test clips for calibration; give both"),
        (["--label", "style", "--values", "c"], "no test clip has style c; there are a, b"),
        (["--label", "style", "--values", "a", "b"], "selects all test clips"),
        (["--level", ".9"], "90 % need at least 9 clips"),
    ):
        assert main(["check", "coverage", str(run), "--samples", "4", *arguments])
        assert message in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(("path", "text"), [("runs/a", "runs/a"), ("ru n", "'ru n'"), ("-r", "./-r")])
def test_paths_in_commands_are_quoted(path, text):
    assert runs.in_command(Path(path)) == text
