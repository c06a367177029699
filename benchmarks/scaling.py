"""Scaling of a fit with processes and sizes, as ratios within one run: `python -m benchmarks.bench scaling`.

    METHOD, two processes     windows a second of two processes over one, with the same batch in each
    METHOD, two alone         the same without communication: the limit of the machine
    METHOD, exchange          share of a step's processor time spent on exchanging gradients
    METHOD over T, K, B, D    exponents of power laws: a training step over frames, particles, windows in a batch and
                              numbers in a frame
    METHOD over clips         the same over the clips of the training set, with the draw of the batch
    METHOD, held-out clips    the same for the bound of the test clips

Processes that wait for one another are timed by the wall clock, and need two free cores. The sides alternate, a few
steps at a time, and the shortest turn of each counts. Exponents are of processor time.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from unittest import mock

import torch
from torch import Tensor

import dvae
from dvae import motion
from dvae.inference.training import processes

from .speed import seconds

SIZE, FRAMES = 48, 75
METHODS = {"srnn": 32, "hit-dvae": 16}
"""Windows in a batch."""
TARGETS = {
    **{f"{name}, two processes": ("at least", 1.9) for name in METHODS},
    **{f"{name}, two alone": ("over", None) for name in METHODS},
    **{f"{name}, exchange": ("under", None) for name in METHODS},
    **{f"srnn over {what}": ("under", 1.1) for what in "TKBD"},  # 1 is linear
    **{f"hit-dvae over {what}": ("under", 1.1) for what in "KBD"},
    "hit-dvae over T": ("under", 2.0),  # it attends to every frame before
    "srnn over clips": ("under", 0.1),
    "srnn, held-out clips": ("under", 1.1),
}
OPTIONS = {"steps": 10**6, "accelerator": "cpu", "progress": False}


def start_svi(name: str, size: int = SIZE, **options: int) -> dvae.SVI:
    torch.manual_seed(0)
    svi = dvae.SVI(dvae.method(name).build({"x": size}), **OPTIONS | options)
    svi.init()
    return svi


# ------------------------------------------------------------------------------------------------ two processes


def worker(name: str, turns: int = 25, steps: int = 4) -> None:
    """Measure a method in each of two processes; the first process prints the rows."""
    with mock.patch.dict(os.environ):
        del os.environ["TORCHELASTIC_RUN_ID"]
        single_process = start_svi(name)
    two_processes, exchange_time, average = start_svi(name), [0.0], processes.average_gradients
    fabric, x = two_processes.fabric, torch.randn(METHODS[name], FRAMES, SIZE)

    def timed(*arguments: object) -> tuple[Tensor, Tensor | float, Tensor]:
        start = time.process_time()
        try:
            return average(*arguments)  # type: ignore[arg-type]
        finally:
            exchange_time[0] += time.process_time() - start

    def turn(svi: dvae.SVI) -> tuple[float, float]:
        """Return wall seconds until both processes finish, and processor seconds."""
        processes.wait(fabric)
        start, busy = time.perf_counter(), time.process_time()
        for _ in range(steps):
            svi.step(x)
        busy = time.process_time() - busy
        last = torch.tensor([0.0, 0.0])
        last[fabric.global_rank] = time.perf_counter() - start
        return processes.sum_over_processes(fabric, last).max().item(), busy

    def one() -> float:
        processes.wait(fabric)
        start = time.perf_counter()
        for _ in range(steps if fabric.global_rank == 0 else 0):
            single_process.step(x)
        return time.perf_counter() - start

    def exchange() -> float:
        exchange_time[0] = 0.0
        _, busy = turn(two_processes)
        return exchange_time[0] / busy

    with mock.patch.object(processes, "average_gradients", timed):
        times = [(one(), turn(two_processes)[0], turn(single_process)[0], exchange()) for _ in range(turns)][2:]
    if fabric.global_rank == 0:
        single, both, uncoupled, share = (min(each) for each in zip(*times, strict=True))
        rows = {"two processes": 2 * single / both, "two alone": 2 * single / uncoupled, "exchange": share}
        print(json.dumps({f"{name}, {row}": value for row, value in rows.items()}))


def two(name: str) -> dict[str, float]:
    """Return the rows of a method in two processes."""
    command = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", __spec__.name, name]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    result = subprocess.run([sys.executable, *command], env=environment, capture_output=True, text=True, check=False)
    if result.returncode:
        raise RuntimeError(result.stderr)
    return dict(json.loads(result.stdout))


# ------------------------------------------------------------------------------------------------ sizes


def exponent(sizes: Sequence[int], action: Callable[[int], Callable[[], object]], repeat: int = 5) -> float:
    """Return the exponent of the size in the shortest time of the actions."""
    times = seconds(*map(action, sizes), repeat=repeat)
    return math.log(times[-1] / times[0]) / math.log(sizes[-1] / sizes[0])


def sizes(name: str) -> dict[str, float]:
    """Return the exponents of a method's training step."""

    def step(batch: int = 8, frames: int = FRAMES, size: int = SIZE, particles: int = 1) -> Callable[[], object]:
        svi, x = start_svi(name, size, particles=particles), torch.randn(batch, frames, size)
        return lambda: svi.step(x)

    return {
        f"{name} over T": exponent([100, 200, 400], lambda n: step(frames=n)),
        f"{name} over K": exponent([1, 2, 4, 8], lambda n: step(particles=n)),
        f"{name} over B": exponent([8, 16, 32, 64], lambda n: step(batch=n)),
        f"{name} over D": exponent([24, 48, 96, 192], lambda n: step(size=n)),
    }


def clips(name: str) -> dict[str, float]:
    """Return the exponents of a training step and of a validation over the number of clips."""
    svi = start_svi(name)

    def windows(count: int, split: str) -> motion.Windows:
        return motion.windows(motion.simulate(clips=count), motion.PROTOCOLS["simulated"], split)

    def step(count: int) -> Callable[[], object]:
        train = windows(count, "train")
        return lambda: svi.step(train.sample(32, svi.generator))

    def validation(count: int) -> Callable[[], object]:
        held_out = windows(count, "test").all()
        return lambda: svi.evaluate(held_out)

    return {
        f"{name} over clips": exponent([50, 400], step, repeat=20),
        f"{name}, held-out clips": exponent([50, 400], validation),
    }


def rows(_: torch.device) -> dict[str, float]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    numbers = {row: value for name in METHODS for row, value in (two(name) | sizes(name)).items()} | clips("srnn")
    torch.set_num_threads(threads)
    return numbers


if __name__ == "__main__":
    torch.set_num_threads(1)
    worker(sys.argv[1])
