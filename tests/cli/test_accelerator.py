"""Commands that use runs compute the same on a simulated GPU as on the CPU."""

import json

import numpy as np
import pytest
import torch

import dvae
from dvae.cli import main
from dvae.testing.device import Tape, move, on_device


@pytest.fixture(scope="module")
def words(people, tmp_path_factory):
    """Return the words of `COMMANDS` in capitals: run directories, and the name of a segment."""
    folder = tmp_path_factory.mktemp("runs")
    table = folder / "table.csv"
    table.write_text("series,t,y\n" + "".join(f"{s},{t},{(3 * s + t) % 7}\n" for s in range(12) for t in range(12)))
    of_table = ["--data", table, "--id", "series", "--time", "t", "--observed", 4, "--horizon", 2, "--columns", "y"]
    fits = {
        "RUN": ["srnn", "--latent", 2, "--width", 8, "--warm-up", 1, "--data", people],
        "PRIOR": ["pose-prior", "--layers", 1, "--data", people],
        "SEGMENTS": ["motion-latent", "--latent", 2, "--widths", 8, "--data", people],
        "TABLE": ["vrnn", "--latent", 2, "--warm-up", 1, "--width", 8, *of_table],
    }
    for name, options in fits.items():
        options += ["--steps", 2, "--batch-size", 4, "--accelerator", "cpu", "--out", folder / name]
        assert main(["fit", *map(str, options)]) == 0
    (clip,) = dvae.load(folder / "SEGMENTS").data.windows("test").motion.clips[:1]
    return {name: str(folder / name) for name in fits} | {"CLIP": "/".join(clip.key)}


COMMANDS = {
    "evaluate": (
        "evaluate RUN --samples 2 --batch-size 1 --bound-particles 2 --log-score-particles 2 --cuda-graph",
        "json",
    ),
    "compare": ("compare RUN --samples 2 --particles 2 --contrasts 4", "json"),
    "forecast": ("forecast RUN --samples 2", "npz"),
    "posterior": ("check posterior RUN --windows 1 --frames 3 --warmup 4 --draws 4", "json"),
    "pose prior": ("evaluate RUN --samples 2 --pose-prior PRIOR", "json"),
    "table": ("evaluate TABLE --samples 3", "json"),
    "segments": ("impute SEGMENTS --from CLIP --seen points --points 5 --starts 1 --steps 2 --samples 1", "npz"),
}


def contents(path):
    """Return the arrays and numbers of a file by name."""
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            return {name: arrays[name] for name in arrays.files if arrays[name].dtype.kind == "f"}
    return json.loads(path.read_text())


@pytest.mark.filterwarnings("ignore:.* is evaluated without CUDA graphs")
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_computes_the_same_on_a_gpu(name, words, tmp_path, monkeypatch):
    command, suffix = COMMANDS[name]
    command = [words.get(word, word) for word in command.split()]
    assert main([*command, "--out", str(tmp_path / f"cpu.{suffix}")]) == 0
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.accelerator, "current_accelerator", lambda *_, **__: None)  # optimisers query its stream
    monkeypatch.setattr(torch.nn.Module, "to", lambda module, _: move(module))
    replays, replay = [], Tape.replay
    monkeypatch.setattr(Tape, "replay", lambda tape: replays.append(replay(tape)))
    with on_device() as traffic:
        assert main([*command, "--accelerator", "cuda", "--out", str(tmp_path / f"gpu.{suffix}")]) == 0
        assert traffic.reads
    assert bool(replays) == ("--cuda-graph" in command)
    assert_equal(*(contents(tmp_path / f"{device}.{suffix}") for device in ("cpu", "gpu")))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_runs_on_a_gpu(name, words, tmp_path):
    command, suffix = COMMANDS[name]
    command = [words.get(word, word) for word in command.split()]
    assert main([*command, "--accelerator", "cuda", "--out", str(tmp_path / f"gpu.{suffix}")]) == 0


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


def test_a_missing_gpu_is_an_error(words, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(["forecast", words["RUN"], "--accelerator", "auto", "--out", str(tmp_path / "f.npz")]) == 0
    assert main(["forecast", words["RUN"], "--accelerator", "cuda", "--out", str(tmp_path / "f.npz")]) == 2
    assert "--accelerator cuda: torch finds no GPU" in capsys.readouterr().err
    (tmp_path / "f.csv").write_text("")
    for command in (f"evaluate --forecasts {tmp_path / 'f.csv'} --data simulated", "animate simulated --out f.html"):
        assert main([*command.split(), "--accelerator", "cuda"]) == 2
        assert "for runs" in capsys.readouterr().err
