"""Several processes: together they equal one process with all batches, and they stop together."""

import os
import signal
import socket
import subprocess
import sys
from itertools import product
from pathlib import Path

import pytest
import torch
from stopping import At

from dvae.data.sequences import Sequences
from dvae.inference.training import processes
from dvae.inference.training.checkpoints import Run
from dvae.inference.training.fit import fit
from dvae.inference.training.options import Training
from dvae.inference.training.processes import LostProcess, average_gradients, launch, seed_of
from dvae.inference.training.svi import SVI
from dvae.networks import Dense
from dvae.program.model import DynamicalVAE

OPTIONS = {"steps": 12, "batch_size": 4, "validate_every": 4, "accelerator": "cpu", "progress": False}
EQUATIONS = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)"


def model(*equations):
    torch.manual_seed(0)
    sizes = {"z": 2, "x": 3} if equations[-1] else {"x": 3}
    return DynamicalVAE(*equations, sizes, network=Dense(widths=(4,))).double()


def walks(n):
    x = torch.randn(n, 4, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64).cumsum(1)
    return {"x": x, "lengths": torch.arange(n) % 3 + 2}


def stepped(batches):
    """Take a step on each batch with a model that draws nothing; return weights and terms."""
    svi = SVI(model("p(x_t | x_{t-1})", None), **OPTIONS, weight_decay=0.1)
    svi.init()
    for batch in batches:
        svi.step(batch)
    scores = [svi.evaluate(Sequences(walks(n))) for n in (9, 1)]  # with one sequence, one of the two processes has none
    return svi.model.state_dict(), scores


def fitted(out, **options):
    """Return the weights of a run in several processes, or its error."""
    try:
        fit_result = fit(model(*EQUATIONS), walks(12), walks(6), out=out, **OPTIONS | options)
        return {"how": (fit_result.status, fit_result.step), "weights": fit_result.model.state_dict()}
    except LostProcess as error:
        return {"how": str(error)}


# ------------------------------------------------------------------------------------------------ what two processes do


def joint(rank, out):
    rows = slice(0, 4) if rank == 0 else slice(4, 9)
    return stepped([{name: value[rows] for name, value in walks(9).items()}] * 3)


def some_gradients(rank, out):
    """One process has a gradient for the second of three parameters, none has one for the third."""
    parameters = [torch.nn.Parameter(torch.ones(2)) for _ in range(3)]
    parameters[0].grad = torch.full((2,), 1.0 + rank)
    parameters[1].grad = torch.ones(2) if rank else None
    loss, share, flags = average_gradients(
        launch(Training()), parameters, torch.tensor(2.0 - rank), torch.tensor(1.0 + 2 * rank), (bool(rank), False)
    )
    return [p.grad for p in parameters], loss, share, (flags > 0).tolist()


def whole(rank, out):
    return fitted(out / "whole")


def killed(rank, out):
    return fitted(out / "run", callbacks=[At(7, lambda _: os.kill(os.getpid(), signal.SIGKILL))] if rank else ())


def resumed(rank, out):
    return fitted(out / "run", resume=True)


def stopped(rank, out):
    return fitted(out / "stopped", callbacks=[At(6, lambda state: setattr(state, "stop", True))] if rank else ())


def play(out, *names):
    """Call each of these functions in two forked processes with the environment of torchrun."""
    launch(Training())  # which imports fabric
    for name in names:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        started = []
        for rank in range(2):
            if not (child := os.fork()):
                environment = {
                    "RANK": rank,
                    "LOCAL_RANK": rank,
                    "WORLD_SIZE": 2,
                    "LOCAL_WORLD_SIZE": 2,
                    "MASTER_PORT": port,
                }
                os.environ |= {key: str(value) for key, value in environment.items()}
                os.environ |= {"MASTER_ADDR": "127.0.0.1", "TORCHELASTIC_RUN_ID": "none"}
                torch.save(globals()[name](rank, Path(out)), f"{out}/{name}-{rank}.pt")
                os._exit(0)
            started.append(child)
        os.waitpid(started[0], 0)
        if name == "killed":
            os.kill(started[1], signal.SIGKILL)
        os.waitpid(started[1], 0)


@pytest.fixture(scope="module")
def of_two(tmp_path_factory):
    """Return the results of each function in both processes."""
    if not torch.distributed.is_available():
        pytest.skip("this torch is built without torch.distributed")
    out = tmp_path_factory.mktemp("processes")
    names = ["joint", "some_gradients", "whole", "killed", "resumed", "stopped"]
    here = Path(__file__).parent
    paths = os.pathsep.join(map(str, (here.parents[2], here.parents[1], here)))
    script = "import sys, test_processes; test_processes.play(*sys.argv[1:])"
    process = subprocess.run(
        [sys.executable, "-c", script, str(out), *names],
        env=os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert process.returncode == 0, process.stderr

    def results(name):
        return [torch.load(file) for rank in (0, 1) if (file := out / f"{name}-{rank}.pt").exists()]

    return results, out


pytestmark = pytest.mark.slow


# ------------------------------------------------------------------------------------------------ distributions


def test_processes_equal_one_process_with_all_batches(of_two):
    """Test also batches with different numbers of frames, and validation split among processes."""
    expected = stepped([walks(9)] * 3)
    first, second = of_two[0]("joint")
    torch.testing.assert_close(first, second, rtol=0, atol=0)
    torch.testing.assert_close(first, expected, rtol=1e-10, atol=1e-10)


def test_a_parameter_without_a_gradient_in_every_process_has_none(of_two):
    for rank, ((both, one, none), loss, share, flags) in enumerate(of_two[0]("some_gradients")):
        assert none is None
        torch.testing.assert_close(both, torch.full((2,), (1 + 3 * 2) / 4))
        torch.testing.assert_close(one, torch.full((2,), 3 / 4))
        assert (float(loss), float(share)) == ((2 + 3 * 1) / 4, (1 + 2 * rank) / 4)
        assert flags == [True, False]


def test_processes_draw_differently_and_keep_equal_weights(of_two):
    first, second = (result["weights"] for result in of_two[0]("whole"))
    assert all(torch.equal(first[name], second[name]) for name in first)
    state = Run(of_two[1] / "whole").optimiser_state()
    for name in ("random/generator", "random/torch"):
        assert not torch.equal(*state[name])


def test_a_killed_process_stops_the_others_and_loses_only_steps_since_the_checkpoint(of_two):
    results, out = of_two
    (reason,) = [result["how"] for result in results("killed")]
    assert "another process of this run has ended" in reason
    for name in ("log.jsonl", "best.safetensors", "last.safetensors"):
        assert (out / "run" / name).read_bytes() == (out / "whole" / name).read_bytes()


def test_a_stop_request_to_one_process_stops_all(of_two):
    assert [result["how"] for result in of_two[0]("stopped")] == [
        ("stopped early", 7)
    ] * 2  # the flag is in the message of the next step


def test_random_streams_differ_by_process_and_seed():
    assert [seed_of(seed, 0) for seed in (-1, 0, 7)] == [-1, 0, 7]
    assert len({seed_of(seed, rank) for seed, rank in product(range(-20, 20), range(20))}) == 800


def test_an_impossible_launch_is_an_error(monkeypatch):
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    with pytest.raises(ValueError, match="accelerator"):
        processes.launch(Training(accelerator="mps"))
    monkeypatch.setattr("sys.argv", ["-c"])
    with pytest.raises(ValueError, match="program"):
        processes.launch(Training(accelerator="cpu", devices=2))


def test_torchrun_sets_the_number_of_processes(monkeypatch):
    assert processes._count_processes(2) == (2, 1)
    for name, value in {"TORCHELASTIC_RUN_ID": "none", "LOCAL_WORLD_SIZE": "2", "WORLD_SIZE": "6"}.items():
        monkeypatch.setenv(name, value)
    assert processes._count_processes(1) == processes._count_processes(2) == (2, 3)
    with pytest.raises(ValueError, match="processes on this host"):
        processes._count_processes(4)
