"""Sweeps: a run equals a separate fit on every backend, and an interrupted sweep is resumed."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from typing import ClassVar

import pytest
import torch
from joblib import parallel_config

import dvae
from dvae import motion
from dvae.cli import main
from dvae.motion.data.dataset import MotionData
from dvae.motion.metric_models.action_classifier import ActionClassifier
from dvae.runs import sweep as sweeps
from dvae.runs.sweep import Outcome, SweepInterrupted, sweep

TRAINING = dvae.Training(steps=6, batch_size=4, validate_every=3)
VAE = dvae.method("vae", latent=3, warm_up=4)
SMALL = ["--batch-size", "4", "--warm-up", "4", "--latent", "3", "--validate-every", "20"]


@pytest.fixture(scope="module")
def data(people):
    return MotionData.open(people)


@pytest.fixture(scope="module")
def swept(data, tmp_path_factory):
    """Return a sweep over processes: its directory and results."""
    out = tmp_path_factory.mktemp("runs") / "swept"
    methods = [VAE, replace(VAE, latent=2)]
    return out, methods, sweep(methods, data, out, seeds=(0, 1), training=TRAINING)


@pytest.fixture
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def weights(run):
    return [(run / name).read_bytes() for name in ("best.safetensors", "last.safetensors")]


def written(out):
    return {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}


def printed(capsys):
    return capsys.readouterr().err.splitlines()


@pytest.mark.slow
def test_a_run_of_a_sweep_equals_a_separate_fit_bit_for_bit(swept, data, tmp_path, one_thread):
    out, methods, results = swept
    assert [result.path.name for result in results] == ["vae-z3-seed0", "vae-z2-seed0", "vae-z3-seed1", "vae-z2-seed1"]
    for result in results:
        single = dvae.fit(
            result.method, data, out=tmp_path / result.path.name, **vars(replace(TRAINING, seed=result.seed))
        )
        assert weights(result.path) == weights(single.run)
        assert (result.status, result.step, result.best_bound) == ("finished", 6, single.best_bound)
        assert result.path.parent == out
        assert result.seconds > 0
    assert [result.method for result in results] == methods * 2
    assert len({result.best_bound for result in results}) == 4
    assert {path.name for path in out.iterdir()} == {result.path.name for result in results}  # no lease remains
    assert dvae.load(results[0].path).method == replace(VAE, units="columns")


def test_finished_runs_are_not_repeated(swept, data, capsys):
    out, methods, results = swept
    before = written(out)
    again = sweep(methods, data, out, seeds=(0, 1), training=replace(TRAINING, accelerator="cpu"))  # or elsewhere
    assert written(out) == before
    assert again == [replace(result, seconds=0.0) for result in results]
    assert printed(capsys) == [str(result) for result in again]
    assert "vae-z3-seed0 finished at step 6 by an earlier sweep, best bound" in str(again[0])


def test_the_log_may_change_between_sweeps_but_scheduled_sampling_belongs_to_methods(swept, data):
    out, methods, results = swept
    again = sweep(methods, data, out, seeds=(0, 1), training=replace(TRAINING, log_every=2))
    assert again == [replace(result, seconds=0.0) for result in results]
    with pytest.raises(ValueError, match="scheduled_sampling is an option of methods"):
        sweep(methods, data, out, seeds=(0, 1), training=replace(TRAINING, scheduled_sampling=0.5))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m, d, t: (replace(m, warm_up=3), d, t), "its warm_up is 4, the sweep's 3"),
        (lambda m, d, t: (m, d, replace(t, steps=7)), "its steps is 6, the sweep's 7; use the same options"),
        (lambda m, d, t: (m, replace(d, protocol=replace(d.protocol, observed=14)), t), r"protocol\.observed is 15"),
        (lambda m, d, t: (m, replace(d, motion=motion.simulate(14, 90, seed=2)), t), "its data's fingerprint is"),
    ],
)
def test_a_run_with_other_options_is_an_error_before_any_work(swept, data, change, message):
    out, _, _ = swept
    before = written(out)
    method, other, training = change(VAE, data, TRAINING)
    with pytest.raises(ValueError, match=f"vae-z3-seed0 contains a run with other options.*{message}"):
        sweep({"new": VAE, "vae-z3": method}, other, out, seeds=[0], training=training)
    assert written(out) == before


def test_wrong_arguments_are_errors(data, tmp_path):
    for methods, seeds, message in (
        ([], [0], "at least one method"),
        ([VAE], [], "at least one method and one seed"),
        ([VAE], [0, 0], r"without duplicates, got seeds \[0, 0\]"),
        ([VAE, VAE], [0], "vae is given twice"),
        ({"a/b": VAE}, [0], "cannot name a directory"),
    ):
        with pytest.raises(ValueError, match=message):
            sweep(methods, data, tmp_path / "out", seeds, TRAINING)
    for jobs in (0, None, 2.0, "4"):
        with pytest.raises((TypeError, ValueError), match=f"jobs is {jobs!r}"):
            sweep([VAE], data, tmp_path / "out", [0], TRAINING, jobs)
    with pytest.raises(ValueError, match="devices is 2"):
        sweep([VAE], data, tmp_path / "out", [0], replace(TRAINING, devices=2))
    equations = [dvae.method("equations", generative=f"p(z_t) p(x_t | {z})") for z in ("z_t", "z_{<=t}")]
    with pytest.raises(ValueError, match="name the methods: sweep"):
        sweep(equations, data, tmp_path / "out", [0], TRAINING)
    (tmp_path / "vae-seed0").touch()
    with pytest.raises(ValueError, match="is a file, not a run directory"):
        sweep([VAE], data, tmp_path, [0], TRAINING)
    assert not (tmp_path / "out").exists()


class Breaks(RuntimeError):
    def __init__(self, first, second):  # with two arguments it cannot be unpickled
        super().__init__(f"{first} {second}")


@dataclass(frozen=True)
class Broken(type(VAE)):
    name: ClassVar[str] = "broken"

    def objective(self):
        raise Breaks("no", "objective")


def test_a_failed_run_is_reported_and_the_others_continue(data, tmp_path, capsys):
    broken, finished = sweep([Broken(), VAE], data, tmp_path, [0], TRAINING, jobs=1)
    assert (broken.status, broken.error, finished.status) == ("failed", "Breaks: no objective", "finished")
    assert "broken-seed0 failed: Breaks: no objective" in printed(capsys)


def test_the_command_fails_if_a_run_does(people, tmp_path, capsys):
    command = ["sweep", "vae", "--data", str(people), "--out", str(tmp_path), "--steps", "5", "--seeds", "0", "1"]
    assert main([*command, "--jobs", "1", "--learning-rate", "1e30", *SMALL]) == 1
    *_, first, second, third = printed(capsys)
    assert "2 of 2 runs failed" in first
    assert "vae-seed0 failed: NonFiniteError: step" in second
    assert "vae-seed1 failed" in third


def test_a_warning_of_several_runs_is_shown_once(data, tmp_path):
    with pytest.warns(UserWarning, match="shortened to 2") as warnings:
        sweep([replace(VAE, warm_up=50)], data, tmp_path, [0, 1], replace(TRAINING, steps=2))
    assert len(warnings) == 1


def test_wrong_arguments_exit_with_2_before_any_work(tmp_path, capsys):
    out = ["--out", str(tmp_path / "runs")]
    for arguments, message in (
        (["sweep", *out], "either methods or --grid, and at least one seed"),
        (["sweep", "vae", "--seeds", *out], "either methods or --grid, and at least one seed"),
        (["sweep", "vae", "--jobs", "0", *out], "--jobs is 0"),
        (["sweep", "vae", "--latent", "0", *out], "latent is 0"),
        (["sweep", "vae", "--steps", "0", *out], "steps is 0"),
        (["sweep", "hitdvae", *out], "hit-dvae"),
    ):
        assert main(arguments) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_on_a_terminal_a_table_shows_the_runs(data, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "100")
    sweep([VAE], data, tmp_path, [0, 1], replace(TRAINING, log_every=1), jobs=1)
    error = capsys.readouterr().err
    assert "bound (nats a frame)" in error
    assert "2 of 2 runs ended, 0 waiting" in error
    assert "vae-seed1 finished at step 6" in error


def test_the_table_is_read_from_the_logs(tmp_path):
    run = tmp_path / "vae-seed0"
    run.mkdir()
    file = run / "log.jsonl"
    file.write_text('{"step": 80, "bound": 0}\n')  # from an earlier sweep
    log = sweeps._Log(run, 100)
    assert not log.look()
    file.with_name("new").write_text('{"step": 40, "bound": 0}\n{"step": 50, "validation/bound": 2.5}\n{"step": 6')
    file.with_name("new").replace(file)
    assert log.look()
    assert (log.step, log.bound) == (50, 2.5)
    with file.open("a") as more:
        more.write('0, "validation/bound": 2.0, "validation/scheduled_sampling/bound": 1.5}\n')
    assert not log.look()
    assert (log.step, log.bound) == (60, 1.5)  # as for the choice of the best weights
    damaged = ["{", "[]", "7", '{"bound": 1}', '{"step": "7"}', "[" * 100_000, '{"step": 7, "validation/bound": 1%s}']
    with file.open("a") as more:
        more.write("\n".join(damaged) % ("0" * 400) + '\n\xff\n{"step": 70}\n')
    assert not log.look()  # damaged lines are skipped and do not end the thread
    assert (log.step, log.bound) == (70, 1.5)


def test_the_joblib_backend_of_the_caller_is_used(swept, data, tmp_path, monkeypatch):
    out, _, _ = swept
    with parallel_config(backend="threading"):
        results = sweep([VAE], data, tmp_path, seeds=(0, 1), training=TRAINING)
    assert [weights(each.path) for each in results] == [weights(out / f"vae-z3-seed{seed}") for seed in (0, 1)]


SMALL_GSPS = {
    "width": 4,
    "coefficients": 2,
    "blocks": 1,
    "draws": (2, 2),
    "latent": 2,
    "angles": 0.0,
    "pose_prior": 0.0,
}


@pytest.mark.parametrize(
    ("method", "best"),
    [
        (dvae.method("gsps", **SMALL_GSPS), "lowest validation loss"),  # the skeleton determines its other options
        (
            ActionClassifier(label="activity", hidden=4, layers=1, features=3),
            "best bound",
        ),  # the clips determine its classes
    ],
    ids=["gsps", "action-classifier"],
)
def test_a_method_with_options_from_the_data_is_resumed(data, tmp_path, method, best):
    first, again = (sweep([method], data, tmp_path, [0], TRAINING, jobs=1) for _ in range(2))
    assert [outcome.status for outcome in (*first, *again)] == ["finished"] * 2
    assert again[0].seconds == 0
    assert first[0].best == again[0].best
    assert first[0].best.startswith(best)  # according to the objective


def test_a_signal_interrupts_a_sweep_with_one_job(data, tmp_path):
    @dataclass(frozen=True)
    class Stopped(type(VAE)):
        name: ClassVar[str] = "stopped"

        def objective(self):
            signal.raise_signal(signal.SIGTERM)
            return super().objective()

    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(SweepInterrupted, match="interrupted with 1 of 4 runs finished") as stop:
        sweep([VAE, Stopped(latent=3, warm_up=4)], data, tmp_path, [0, 1], TRAINING, jobs=1)
    assert stop.value.signal == signal.SIGTERM
    assert [result.path.name for result in stop.value.results] == ["vae-seed0"]
    assert not list(tmp_path.glob(".*"))
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers


def wait_for(condition, process, seconds=120):
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    assert condition(), f"nothing after {seconds} s"


def alive(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def states(out):
    return {path.parent.name: json.loads(path.read_text()) for path in out.glob("*/state.json")}


@pytest.mark.slow
def test_a_sweep_stopped_by_ctrl_c_is_resumed(people, tmp_path, capsys):
    """The signal goes to all processes, as from a terminal: all end, and runs resume from checkpoints."""
    arguments = ["sweep", "vae", "vrnn", "--seeds", "0", "1", "--data", str(people), "--out", str(tmp_path)]
    command = [sys.executable, "-m", "dvae", *arguments, "--steps", "30", *SMALL]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        wait_for(lambda: any(state["status"] == "finished" for state in states(tmp_path).values()), process)
        os.killpg(process.pid, signal.SIGINT)
        error = process.communicate(timeout=60)[1]
        deadline = time.monotonic() + 20
        while alive(process.pid) and time.monotonic() < deadline:
            time.sleep(0.02)
        assert not alive(process.pid)
    finally:
        if alive(process.pid):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    assert process.returncode == 130, error
    assert "of 4 runs finished; start the same sweep again to continue" in error.splitlines()[-1], error
    assert "Traceback" not in error
    assert "vae-seed0 starts" in error.splitlines()
    stopped = states(tmp_path)
    assert {state["status"] for state in stopped.values()} <= {"finished", "running", "interrupted"}
    finished = [name for name, state in stopped.items() if state["status"] == "finished"]
    assert 0 < len(finished) < 4
    before = written(tmp_path)
    assert main([*arguments, "--steps", "30", *SMALL]) == 0
    lines = printed(capsys)
    for name, state in stopped.items():
        if name in finished:
            assert all(written(tmp_path / name)[path] == mtime for path, mtime in before.items() if name in path.parts)
        elif state["step"]:
            assert f"{name} continues after step {state['step']}" in lines
    ended = states(tmp_path)
    assert [(state["status"], state["step"]) for state in ended.values()] == [("finished", 30)] * 4


@pytest.mark.slow
def test_runs_on_a_dask_cluster_equal_local_runs(swept, data, people, tmp_path, capsys):
    distributed = pytest.importorskip("distributed")
    out, _, _ = swept
    options = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster:
        with distributed.Client(cluster), parallel_config(backend="dask"):
            results = sweep([VAE], data, tmp_path / "python", seeds=(0, 1), training=TRAINING)
        assert [result.status for result in results] == ["finished"] * 2
        assert [weights(each.path) for each in results] == [weights(out / f"vae-z3-seed{seed}") for seed in (0, 1)]
        command = ["sweep", "vae", "--data", str(people), "--out", str(tmp_path / "command"), "--seeds", "0"]
        assert main([*command, "--steps", "5", *SMALL, "--scheduler", cluster.scheduler_address]) == 0
    assert "vae-seed0 starts" in printed(capsys)
    assert states(tmp_path / "command")["vae-seed0"]["status"] == "finished"


def test_a_result_prints_as_one_line(tmp_path):
    result = Outcome(tmp_path / "vae-seed0", VAE, 0, "stopped early", 300, -1.25, "the best", 61.4)
    assert str(result) == "vae-seed0 stopped early at step 300 in 0:01:01, the best"
