"""Startup time of the command line over `import torch`: `python -m benchmarks.bench startup`.

Times are the shortest of several starts; the sides alternate. The rows "first step" are the seconds of one start of
`dvae fit srnn --steps 1` on simulated people, with validation and checkpoint; with a CUDA graph, of five steps.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial

import torch

TORCH = ("-c", "import torch")
COMMANDS = {
    "dvae --help": ("-m", "dvae", "--help"),
    "an unknown command": ("-m", "dvae", "fitt"),
    "dvae list": ("-m", "dvae", "list"),
    "dvae fit vae --help": ("-m", "dvae", "fit", "vae", "--help"),
    "import dvae": ("-c", "import dvae"),
}
TARGETS = {
    "dvae --help": ("at most", 1.3),
    "an unknown command": ("at most", 1.3),
    "dvae list": ("at most", 1.3),
    "dvae fit vae --help": ("at most", 2.5),
    "import dvae": ("at most", 0.3),
    "first step on a CPU": ("under", None),
    "first step on a GPU": ("under", 10.0),
    "first step with a CUDA graph": ("under", 10.0),
}


def seconds(*arguments: str) -> float:
    start = time.perf_counter()
    subprocess.run([sys.executable, *arguments], capture_output=True, check=False)
    return time.perf_counter() - start


def first_step(*options: str) -> float:
    """Return the seconds of a fit in a new process.

    Raises:
        RuntimeError: the fit fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        command = [sys.executable, "-m", "dvae", "fit", "srnn", "--out", f"{folder}/run", *options]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        duration = time.perf_counter() - start
    if result.returncode:
        raise RuntimeError(result.stderr)
    return duration


def commands() -> dict[str, float]:
    """Return the time of each command over `import torch`."""
    least = dict.fromkeys(["torch", *COMMANDS], float("inf"))
    for _ in range(5):
        for name, arguments in {"torch": TORCH, **COMMANDS}.items():
            least[name] = min(least[name], seconds(*arguments))
    return {name: least[name] / least["torch"] for name in COMMANDS}


def rows(device: torch.device) -> dict[str, Callable[[], float | dict[str, float]]]:
    fit = partial(first_step, "--accelerator", device.type, "--steps")
    if device.type == "cpu":
        return {"commands": commands, "first step on a CPU": partial(fit, "1")}
    return {
        "first step on a GPU": partial(fit, "1"),
        "first step with a CUDA graph": partial(fit, "5", "--cuda-graph"),
    }
