"""Untrusted run directories: links, special files, oversized files and values out of range are errors."""

import errno
import json
import math
import os
import signal
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import numpy as np
import pyro
import pytest
import torch
from safetensors.torch import load_file, save

import dvae
from dvae import files, motion
from dvae.cli import main
from dvae.inference.evaluation.result import error_message
from dvae.inference.training import trackers
from dvae.inference.training.checkpoints import (
    BEST,
    CONFIG,
    LAST,
    OPTIMISER,
    STATE,
    CheckpointError,
    Run,
    at_most,
)
from dvae.inference.training.trackers import JSONLines
from dvae.motion.data.dataset import MotionData
from dvae.options import Range
from dvae.runs import directory as runs
from dvae.runs.sweep import sweep

ROOT = Path(__file__).parents[2]
METHOD = dvae.method("vrnn", latent=2, width=4, embed=(4,), embed_latent=(4,), warm_up=1)
TRAINING = dvae.Training(steps=4, batch_size=2, validate_every=2, log_every=1, progress=False)


@pytest.fixture(scope="module")
def fitted(people, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "fitted"
    dvae.fit(METHOD, MotionData.open(people), out=out, **vars(TRAINING))
    return out


@pytest.fixture
def canary(tmp_path):
    path = tmp_path / "mine.txt"
    path.write_text("of value")
    yield path
    assert path.read_text() == "of value"


def failure(capsys, *arguments, code=1):
    """Return the error message of a failing command."""
    capsys.readouterr()
    assert main([str(each) for each in arguments]) == code
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert "looks like a bug" not in error
    return " ".join(error.split())


def change(run, file, *keys, value):
    """Set one value of a JSON file of a run."""
    content = json.loads((run / file).read_text())
    inner = content
    for key in keys[:-1]:
        inner = inner[key]
    inner[keys[-1]] = value
    (run / file).write_text(json.dumps(content))


def recommit(run, name, content):
    """Replace a file of a checkpoint together with its fingerprint, as an attacker would."""
    Run(run).commit(json.loads((run / STATE).read_text()), {name: content})


# Links, FIFOs, sizes --------------------

WRITTEN = (".lock", f"{CONFIG}.new", f"{LAST}.new", f"{OPTIMISER}.new", f"{STATE}.new", f"{BEST}.new", "log.jsonl.new")
READ = (CONFIG, STATE, BEST, LAST, OPTIMISER, "log.jsonl")


@pytest.mark.parametrize("name", WRITTEN)
def test_links_are_never_written_through(run, canary, name):
    (run / name).unlink(missing_ok=True)
    (run / name).symlink_to(canary)
    if name == ".lock":
        with pytest.raises(CheckpointError, match=r"\.lock is a link"):
            runs.resume(run, steps=6, progress=False)
        (run / name).unlink()
        os.link(canary, run / name)
    if name in (f"{OPTIMISER}.new", f"{LAST}.new", f"{BEST}.new"):  # these are read first
        with pytest.raises(CheckpointError, match="is a link"):
            runs.resume(run, steps=6, progress=False)
    else:
        assert runs.resume(run, steps=6, progress=False).step == 6


@pytest.mark.parametrize("names", [["evaluation.json", "scores.png"], ["calibration.json"]])
def test_results_replace_links(run, canary, names):
    for name in names:
        (run / name).symlink_to(canary)
    if "calibration.json" in names:
        few = ("--simulations", "20", "--draws", "19", "--ranked-steps", "1", "--samples", "19")
        assert main(["check", "calibration", str(run), *few]) == 0
    else:
        assert main(["evaluate", str(run), "--samples", "1", "--figure", str(run / "scores.png")]) == 0
    for name in names:
        assert not (run / name).is_symlink()
        assert (run / name).stat().st_size > 100


@pytest.mark.parametrize("name", READ)
@pytest.mark.parametrize("kind", ["link", "device", "fifo", "directory"])
def test_special_files_are_errors(run, canary, name, kind):
    path = run / name
    path.unlink()
    if kind == "directory":
        path.mkdir()
    elif kind == "fifo":
        os.mkfifo(path)
    else:
        path.symlink_to(canary if kind == "link" else "/dev/zero")
    with pytest.raises(CheckpointError, match=f"{path} (is a link|must be a plain file)"):
        runs.resume(run, steps=6, progress=False)
    if name in (CONFIG, STATE, BEST):
        with pytest.raises(CheckpointError, match=f"{path} (is a link|must be a plain file)"):
            dvae.load(run)


@pytest.mark.parametrize("path", [None, 3, b"run"])
def test_a_run_must_be_a_path(path):
    with pytest.raises(TypeError, match=f"a run must be the path of a folder that fit wrote, got {path!r}"):
        dvae.load(path)


def test_the_directory_that_the_user_names_may_be_a_link(run, tmp_path):
    (tmp_path / "latest").symlink_to(run)
    assert runs.resume(tmp_path / "latest", steps=5, progress=False).step == 5


def test_a_fit_in_memory_equals_a_run_with_the_same_seed(fitted, people):
    expected, before = dvae.load(fitted).model, torch.random.get_rng_state()
    fit = dvae.fit(METHOD, MotionData.open(people), **vars(TRAINING))
    assert torch.equal(torch.random.get_rng_state(), before)
    assert not fit.model.training
    assert fit.run is None
    for name, value in expected.state_dict().items():
        assert torch.equal(value, fit.model.state_dict()[name]), name


def test_a_link_as_run_directory_of_a_sweep_is_an_error(fitted, people, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "vrnn-seed0").symlink_to(elsewhere)
    with pytest.raises(ValueError, match="vrnn-seed0 is a link"):
        sweep([METHOD], MotionData.open(people), tmp_path / "out", [0], TRAINING, jobs=1)
    assert not list(elsewhere.iterdir())


@pytest.mark.parametrize("name", READ)
def test_an_oversized_file_is_an_error_before_reading(run, name, monkeypatch):
    with (run / name).open("r+b") as file:
        file.truncate(2**40)  # takes no space
    monkeypatch.setattr(trackers, "LARGEST_LOG", 2**20)
    with pytest.raises(CheckpointError, match=f"{name} has {2**40} bytes|asks for|bytes of weights"):
        runs.resume(run, steps=6, progress=False)


def test_a_state_with_a_foreign_file_is_an_error(run, canary):
    change(run, STATE, "fingerprints", "../mine.txt", value="0" * 64)
    with pytest.raises(CheckpointError, match=r"a fingerprint of '../mine.txt', which is not a file of a checkpoint"):
        Run(run).commit(json.loads((run / STATE).read_text()), {})


# Values --------------------


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        (("method", "width"), 20_000, "width is 20000; it must be at least 1 and at most 16384"),
        (("method", "width"), -3, "width is -3; it must be at least 1"),
        (("method", "width"), 10**400, "width is .*; it must be at least"),
        (("method", "hidden"), [8] * 100_000, "hidden has 100000 entries; it must have 64 at most"),
        (("method", "hidden"), [8, "8"], r"hidden\[1\] is .*; it must be a whole number"),
        (("method", "residual"), float("nan"), "residual is nan; it must be"),
        (("method", "emission"), "fixd", r"unknown emission .*did you mean .*fixed"),
        (("method", "latent"), 4096, "describes a model that is larger than its weights|weights of another model"),
        (("training", "devices"), 40, "devices is 40; it must be at least 1 and at most 32"),
        (("training", "steps"), True, "steps is True; it must be a whole number"),
        (("training", "batch_size"), 10**6, "batch_size is 1000000; it must be at least 1 and at most 16384"),
        (("training", "precision"), "8", "unknown precision '8'"),
        (("training", "learning_rate"), {"schedule": "Constant", "value": -1}, "learning_rate is -1"),
        (
            ("training", "learning_rate"),
            {"schedule": "Linear", "start": 0, "end": float("inf"), "steps": 3},
            "end is inf",
        ),
        (("schema", "length"), 10**12, "length is 1000000000000; it must be"),
        (
            ("schema",),
            {"kind": "sequences", "sizes": {"x": 48}},
            "of kind 'motion' require a schema of kind 'poses', got 'sequences'",
        ),
        (("schema", "protocol", "fps"), 0, "fps is 0; it must be at least 0.001"),
        (("schema", "protocol", "observed"), 10**9, "observed is 1000000000; it must be"),
        (
            ("method",),
            {"method": "equations", "generative": "p(z_t | z_{t-99999999:t-1}) p(x_t | z_t)"},
            "99999999 steps",
        ),
        (("data", "skip_bad"), "yes", "skip_bad is 'yes'; it must be true or false"),
        (("data", "path"), ["people.npz"], "path is .*; it must be of type str"),
    ],
)
def test_a_config_out_of_range_is_an_error_with_file_and_key(run, keys, value, message):
    change(run, CONFIG, *keys, value=value)
    with pytest.raises(CheckpointError, match=message) as error:
        dvae.load(run)
    assert str(run) in str(error.value)
    assert len(str(error.value)) < 2000


@pytest.mark.parametrize("key", ["steps", "seed", "devices"])
def test_a_missing_option_of_a_run_has_its_default(run, capsys, key):
    config = json.loads((run / CONFIG).read_text())
    del config["training"][key]
    (run / CONFIG).write_text(json.dumps(config))
    fast = ["--no-forecasts", "--particles", "2", "--contrasts", "0", "--stride", "60"]
    assert main(["compare", str(run), *fast]) == 0, capsys.readouterr().err


def test_nesting_is_bounded(run):
    for depth in (40, 100_000):
        (run / CONFIG).write_text('{"a": ' * depth + "1" + "}" * depth)
        with pytest.raises(CheckpointError, match=r"config.json is damaged, it (is nested deeper|is not JSON)"):
            Run(run).config


def test_every_option_of_a_method_is_type_checked():
    for kind in dvae.methods().values():
        for name in vars(kind()):
            with pytest.raises((TypeError, ValueError), match=f"{name} .*(must be|known:)"):
                kind(**{name: object()})


def test_a_range_contains_its_values_and_prints_its_ends():
    for low, high, above, below in ((0, 1, False, False), (1, 5, True, False), (1, 5, False, True)):
        allowed = Range(low, high, above, below)
        assert (low in allowed, high in allowed) == (not above, not below)
        assert not any(value in allowed for value in (low - 1, high + 1, float("nan"), float("inf")))
        assert str(low) in str(allowed)
        assert str(high) in str(allowed)


def test_a_model_larger_than_its_weights_is_an_error():
    with at_most(2**12, "this"):
        torch.nn.Linear(64, 16)
    with (
        pytest.raises(CheckpointError, match="this describes a model that is larger than its weights"),
        at_most(2, "this"),
    ):
        [torch.nn.Linear(4096, 4096) for _ in range(2)]
    torch.nn.Linear(4096, 4097)


def weights_with(run, name, make):
    tensors = load_file(run / LAST)
    first = next(key for key, value in tensors.items() if value.ndim == 2)
    tensors[first] = make(tensors[first])
    recommit(run, name, save(tensors))
    return first


@pytest.mark.parametrize("name", [BEST, LAST])
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda value: torch.full_like(value, float("nan")), "has entries that are NaN or infinite"),
        (lambda value: value / 0, "has entries that are NaN or infinite"),
        (lambda value: value.long(), r"is torch.int64, the model's is torch.float32"),
        (lambda value: value.to(torch.complex64), r"is torch.complex64, the model's is|no safetensors file"),
        (lambda value: value[:1], "holds the weights of another model"),
    ],
)
def test_weights_with_wrong_types_shapes_or_values_are_errors(run, name, make, message):
    first = weights_with(run, name, make)
    with pytest.raises(CheckpointError, match=message) as error:
        runs.resume(run, steps=6, progress=False)
    assert f"{run / name}" in str(error.value)
    assert first in str(error.value)


def damage(name, value):
    return lambda content: content.update({name: value(content[name])})


MEAN, SQUARE, STEP = (f"optimizer/0/{key}" for key in ("exp_avg", "exp_avg_sq", "step"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content.clear(), "random has no generator and no torch"),
        (lambda content: content.update(mine=torch.ones(1)), "'mine' does not belong to optimizer, random, objective"),
        (
            lambda content: content.update({"optimizer/99/step": torch.ones(1)}),
            "'optimizer/99/step' does not belong to a parameter",
        ),
        (
            lambda content: content.update({"optimizer/00/step": torch.ones(1)}),
            "'optimizer/00/step' does not belong to a parameter",
        ),
        (lambda content: content.pop(MEAN), "optimizer/0 has no exp_avg"),
        (damage(MEAN, lambda value: value[:1]), f"'{MEAN}' is not in the optimiser's format"),
        (damage(MEAN, lambda value: value / 0), f"'{MEAN}' is not"),
        (damage(SQUARE, lambda value: value - 1), f"'{SQUARE}' is not"),
        (damage(MEAN, lambda value: value.long()), f"'{MEAN}' is not"),
        (damage(STEP, lambda value: -value), f"'{STEP}' is not"),
        (damage(STEP, lambda value: 1e9 * value), f"'{STEP}' is not"),
        (lambda content: content.pop("random/torch"), "random has no torch"),
        (damage("random/torch", lambda value: value[:, :8].clone()), "'random/torch' is no"),
        (damage("random/generator", lambda value: value.float()), "'random/generator' is no"),
        (lambda content: content["random/generator"].fill_(255), "mt19937"),
    ],
)
def test_an_impossible_optimizer_state_is_an_error_with_its_key(run, change, message):
    content = Run(run).optimiser_state()
    change(content)
    recommit(run, OPTIMISER, save(content))
    with pytest.raises(CheckpointError, match=message) as error:
        runs.resume(run, steps=6, progress=False)
    assert str(run / OPTIMISER) in str(error.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("step", -1),
        ("step", True),
        ("best_bound", float("nan")),
        ("waited", -1),
        ("status", "fine"),
        ("best_step", 1.5),
    ],
)
def test_a_state_out_of_range_is_an_error_for_every_command(run, capsys, key, value):
    change(run, STATE, key, value=value)
    for command in (("resume", run), ("evaluate", run), ("forecast", run, "--out", run / "f.npz")):
        assert f"{run / STATE} is damaged: {key} missing or not" in failure(capsys, *command)


@pytest.mark.parametrize("line", ["3", "[]", "{}", '{"step": "one"}', '{"step": 1, "loss": "low"}', '{"step"', "\0"])
def test_a_damaged_log_is_an_error_with_its_line(run, line):
    path = run / "log.jsonl"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], line, *lines[1:]]) + "\n")
    with pytest.raises(CheckpointError, match=f"{path} is damaged: line 2 is not a row of numbers with a step"):
        runs.resume(run, steps=6, progress=False)


def test_a_log_with_too_many_rows_is_an_error_at_the_first_excess_row(tmp_path, monkeypatch):
    path = tmp_path / "log.jsonl"
    row = b'{"step": 1}\n'
    path.write_bytes(row * trackers.MOST_ROWS)
    assert len(JSONLines(path).read()) == trackers.MOST_ROWS
    path.write_bytes(row * trackers.MOST_ROWS + b"no row\n")  # is not read
    with pytest.raises(CheckpointError, match=f"{path} has more than 200,000 rows; remove some, or move the file"):
        JSONLines(path).read()
    path.write_bytes(row * (2**25 // len(row) + 1))
    monkeypatch.setattr(trackers, "row_of", lambda line: pytest.fail("a row is made"))
    with pytest.raises(CheckpointError, match=f"{path} has .* bytes, but at most 33554432 are allowed; move it"):
        JSONLines(path).read()


def test_a_nonfinite_forecast_is_an_error_with_its_clip(run, capsys):
    huge = {name: value * 0 + 3e38 for name, value in load_file(run / BEST).items()}
    recommit(run, BEST, save(huge))
    out = run / "futures.npz"
    assert "of clip 'person_" in failure(capsys, "forecast", run, "--out", out)
    assert "of 'person_" in failure(capsys, "evaluate", run)
    assert not out.exists()


def test_nonfinite_futures_are_errors():
    walks = motion.simulate(clips=2, frames=30)
    joints = walks.skeleton.joints
    arrays = [np.zeros((3, 2, 4, joints, 3)), np.zeros((2, 5, joints, 3)), np.zeros((2, 4, joints, 3))]
    for n, array in enumerate(arrays):
        arrays[n] = array.copy()
        arrays[n][..., 1, 2, 3, 1] = np.inf if n else np.nan  # NaN is a joint that was not observed
        with pytest.raises(FloatingPointError, match=r"clip 'b' \(test\) from frame 7 on are NaN"):
            motion.Forecasts(walks.skeleton, [("test", "a", 0), ("test", "b", 7)], *arrays)
        arrays[n] = array


# A full disk --------------------


def test_a_full_disk_is_an_error_with_the_file(run, tmp_path, monkeypatch, capsys):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with (
        pytest.raises(OSError, match=f"No space left on device.*{tmp_path}/new/a.txt"),
        files.atomic_write(tmp_path / "new" / "a.txt"),
    ):
        full()
    walks, new = motion.simulate(clips=2, frames=30), tmp_path / "new"
    with monkeypatch.context() as patch:
        patch.setattr(files.os, "fsync", full)
        assert f"No space left on device: '{run / CONFIG}'" in failure(capsys, "resume", run, "--steps", "6")
        with pytest.raises(OSError, match=f"No space left on device: '{new / CONFIG}'"), Run(new).locked():
            Run(new).write_config({})
    with monkeypatch.context() as patch:
        patch.setattr(files.os, "replace", full)
        with pytest.raises(OSError, match=f"No space left on device: '{new}/train/person_0000.csv'"):
            motion.write_motion(new, walks, "csv")
    assert list(tmp_path.iterdir()) == [run]
    log = JSONLines(run / "log.jsonl")
    log.start(4)
    log._file.close()
    with open("/dev/full", "wb", buffering=0) as log._file, pytest.raises(OSError, match=r"log\.jsonl"):
        log.log(5, {"loss": 1.0})


def test_temporary_files_of_killed_processes_are_removed_by_the_next(tmp_path, monkeypatch):
    dead = subprocess.Popen(["true"])
    dead.wait()
    live = tmp_path / f"{files.temporary()}a"
    monkeypatch.setattr(files.os, "getpid", lambda: dead.pid)
    stale = [tmp_path / f"{files.temporary()}{name}" for name in "abcd"]
    monkeypatch.undo()
    for path in (live, *stale[1:]):
        path.touch()
    stale[0].mkdir()
    (stale[0] / "walk.csv").touch()
    with files.atomic_write(tmp_path / "a.txt"):
        pass
    assert {path.name for path in tmp_path.iterdir()} == {live.name, "a.txt"}


def test_partial_checkpoints_of_killed_processes_are_removed_by_the_next(run):
    (run / f"{BEST}.new").write_bytes(b"cut off")
    Run(run).commit(Run(run).state, {})
    assert not list(run.glob("*.new"))


# The command line --------------------


def test_resuming_to_fewer_steps_than_taken_is_an_error(run, capsys):
    error = failure(capsys, "resume", run, "--steps", "2")
    assert f"steps is 2, but {run} has taken 4 steps already" in error
    assert "at least 4" in error
    assert main(["resume", str(run), "--steps", "4"]) == 0


@pytest.mark.parametrize(
    ("arguments", "suggestion"),
    [
        ("fitt", "unknown command 'fitt' (did you mean 'fit'?)"),
        ("fit srn --out x", "'srn' is unknown (did you mean 'srnn'?)"),
        ("fit --steps 3 --out x hitdvae", "'hitdvae' is unknown (did you mean 'hit-dvae'?)"),
        ("fit vae --out x --protocol cmu", "--protocol 'cmu' is unknown (did you mean 'cmu8'?)"),
        ("fit vae --emission nrmal --out x", "--emission 'nrmal' is unknown (did you mean 'normal'?)"),
        ("sweep vae srn --out x", "'srn' is unknown (did you mean 'srnn'?)"),
        ("data inf", "did you mean 'data info'?"),
    ],
)
def test_a_misspelled_name_gets_a_suggestion(capsys, arguments, suggestion):
    assert suggestion in failure(capsys, *arguments.split(), code=2)


def test_an_unrelated_name_gets_no_suggestion(capsys):
    assert "did you mean" not in failure(capsys, "fit", "qqqqqq", "--out", "x", code=2)


@pytest.mark.parametrize(
    ("arguments", "end"),
    [
        ("forecast RUN --out f.txt", ".npz"),
        ("forecast RUN --out f.json", ".npz"),
        ("evaluate RUN --out scores.csv", ".json"),
        ("check calibration RUN --out f.npz", ".json"),
        ("compare RUN --out f.txt", ".json"),
        ("animate RUN --out f.png", ".html"),
    ],
)
def test_a_wrong_suffix_of_an_output_file_is_an_error(fitted, capsys, tmp_path, monkeypatch, arguments, end):
    monkeypatch.chdir(tmp_path)
    assert f"end the name in {end}" in failure(capsys, *arguments.replace("RUN", str(fitted)).split(), code=2)
    assert not list(tmp_path.iterdir())


def test_error_messages_omit_pyros_table_of_shapes():
    model = dvae.DynamicalVAE("p(z_t | z_{t-1}, c_t) p(x_t | z_t)", "q(z_t | x_t)", {"z": 1, "x": 2, "c": 1})
    for act in (dvae.SequenceELBO().terms, partial(dvae.fit, steps=1, progress=False)):
        with pytest.raises(ValueError, match="reads c") as error:
            act(model, {"x": torch.zeros(2, 3, 2)})
        assert "Trace Shapes:" not in str(error.value)

    def program():
        pyro.sample("x", pyro.distributions.Normal(torch.zeros(2), -torch.ones(2)))

    with pytest.raises(ValueError) as error:
        pyro.poutine.trace(program).get_trace()
    assert "Trace Shapes:" in str(error.value)
    assert "parameter scale" in error_message(error.value)
    assert "Trace Shapes:" not in error_message(error.value)


PROGRAM = str(ROOT / "dvae" / "command" / "__init__.py")


def python(*arguments, path=ROOT):
    environment = os.environ | {"PYTHONPATH": str(path), "OMP_NUM_THREADS": "1"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen([sys.executable, *arguments], env=environment, text=True, **pipes)


@pytest.mark.parametrize("source", ["", "def main(): pass\ndef command(given):\n    "], ids=["dvae.cli", "its command"])
def test_ctrl_c_while_importing_prints_no_traceback(tmp_path, source):
    (tmp_path / "dvae").mkdir()
    (tmp_path / "dvae" / "__init__.py").write_text("")
    (tmp_path / "dvae" / "cli.py").write_text(f"{source}import time; print('importing', flush=True); time.sleep(60)\n")
    program = python(PROGRAM, "list", path=tmp_path)
    assert program.stdout.readline() == "importing\n"
    program.send_signal(signal.SIGINT)
    _, error = program.communicate(timeout=60)
    assert (program.returncode, error) == (130, "interrupted\n")


def test_python_without_docstrings_is_an_error():
    program = python("-OO", PROGRAM, "list")
    _, error = program.communicate(timeout=120)
    assert program.returncode == 1
    assert error.startswith("error: dvae needs Pyro, which needs docstrings: run python without -OO")
    assert "Traceback" not in error


def test_a_run_of_arrays_names_how_to_load_its_weights(tmp_path):
    model = dvae.method("vae").build({"x": 2})
    dvae.fit(model, torch.randn(6, 4, 2), steps=2, out=tmp_path / "run", progress=False)
    with pytest.raises(CheckpointError, match=r"which a run does not store; build the model .* by dvae.load_weights"):
        dvae.load(tmp_path / "run")
    again = dvae.method("vae").build({"x": 2})
    dvae.load_weights(again, tmp_path / "run")
    for one, other in zip(model.parameters(), again.parameters(), strict=True):
        assert torch.equal(one, other)


# Threads --------------------


def test_fits_in_threads_equal_fits_in_sequence(people, fitted, tmp_path):
    """Two fits and a forecast in threads give the same results as in sequence."""
    data = MotionData.open(people)
    model, x = dvae.load(fitted).model, data.windows("test").all()["x"][:2, :15]

    def forecast():
        torch.manual_seed(0)
        return model.forecast({"x": x}, 4, 2)["x"]

    results, errors = {}, []

    def work(name, action):
        try:
            results[name] = action()
        except BaseException as error:
            errors.append(error)

    actions = {
        name: lambda name=name: dvae.fit(METHOD, data, out=tmp_path / name, **vars(TRAINING)) for name in ("a", "b")
    }
    actions["forecast"] = lambda: model.forecast({"x": x}, 4, 2)["x"].shape
    threads = [threading.Thread(target=work, args=each) for each in actions.items()]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    assert results["forecast"] == forecast().shape
    for name in ("a", "b"):
        assert (tmp_path / name / LAST).read_bytes() == (fitted / LAST).read_bytes()


def test_previously_valid_options_stay_valid():
    """Old configs may have an infinite gradient clip, and layers as wide as large machines allow."""
    assert dvae.Training(gradient_clip=math.inf).gradient_clip is None
    assert dvae.method("vae", hidden=(8192,)).hidden == (8192,)
    with pytest.raises(ValueError, match=r"unknown accelerator 'tpu' .*known: auto, cpu"):
        dvae.Training(accelerator="tpu")
