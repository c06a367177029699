"""Commands that use runs compute the same on a simulated GPU as on the CPU."""

import json

import numpy as np
import pytest
import torch

import dvae
from dvae.cli import main
from dvae.motion.data.dataset import MotionData
from dvae.testing.device import Tape, move, on_device


@pytest.fixture(scope="module")
def fitted(people, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "srnn"
    training = dvae.Training(steps=2, batch_size=4, progress=False)
    dvae.fit(dvae.method("srnn", latent=2, width=8, warm_up=1), MotionData.open(people), out=out, **vars(training))
    return out


COMMANDS = {
    "evaluate": (
        "evaluate RUN --samples 2 --batch-size 1 --bound-particles 2 --log-score-particles 2 --cuda-graph",
        "json",
    ),
    "compare": ("compare RUN --samples 2 --particles 2 --contrasts 4", "json"),
    "forecast": ("forecast RUN --samples 2", "npz"),
    "posterior": ("check posterior RUN --windows 1 --frames 3 --warmup 4 --draws 4", "json"),
}


def contents(path):
    """Return the arrays and numbers of a file by name."""
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            return {name: arrays[name] for name in arrays.files if arrays[name].dtype.kind == "f"}
    return json.loads(path.read_text())


@pytest.mark.filterwarnings("ignore:forecasts run without a CUDA graph")
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_computes_the_same_on_a_gpu(name, fitted, tmp_path, monkeypatch):
    command, suffix = COMMANDS[name]
    words = command.replace("RUN", str(fitted)).split()
    assert main([*words, "--out", str(tmp_path / f"cpu.{suffix}")]) == 0
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.nn.Module, "to", lambda module, _: move(module))
    replays, replay = [], Tape.replay
    monkeypatch.setattr(Tape, "replay", lambda tape: replays.append(replay(tape)))
    with on_device() as traffic:
        assert main([*words, "--accelerator", "cuda", "--out", str(tmp_path / f"gpu.{suffix}")]) == 0
        assert traffic.reads
    assert bool(replays) == ("--cuda-graph" in words)
    assert_equal(*(contents(tmp_path / f"{device}.{suffix}") for device in ("cpu", "gpu")))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_runs_on_a_gpu(name, fitted, tmp_path):
    command, suffix = COMMANDS[name]
    words = command.replace("RUN", str(fitted)).split()
    assert main([*words, "--accelerator", "cuda", "--out", str(tmp_path / f"gpu.{suffix}")]) == 0


def assert_equal(one, other):
    """Compare nested values; numbers may differ by the rounding of another order of operations."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_equal(one[key], other[key])
    elif isinstance(one, list):
        for each, another in zip(one, other, strict=True):
            assert_equal(each, another)
    elif isinstance(one, float | np.ndarray):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)
    else:
        assert one == other


def test_a_missing_gpu_is_an_error(fitted, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(["forecast", str(fitted), "--accelerator", "cuda", "--out", str(tmp_path / "f.npz")]) == 2
    assert "--accelerator cuda: torch finds no GPU" in capsys.readouterr().err
