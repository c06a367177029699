"""Startup time of the command line over `import torch`: `python -m benchmarks.bench startup`.

Times are the shortest of several starts; the sides alternate.
"""

import subprocess
import sys
import time

import torch

TORCH = ("-c", "import torch")
COMMANDS = {
    "dvae --help": ("-m", "dvae.cli", "--help"),
    "an unknown command": ("-m", "dvae.cli", "fitt"),
    "dvae list": ("-m", "dvae.cli", "list"),
    "dvae fit vae --help": ("-m", "dvae.cli", "fit", "vae", "--help"),
    "import dvae": ("-c", "import dvae"),
}
TARGETS = {
    "dvae --help": ("at most", 1.3),
    "an unknown command": ("at most", 1.3),
    "dvae list": ("at most", 1.3),
    "dvae fit vae --help": ("at most", 2.5),
    "import dvae": ("at most", 0.3),
}


def seconds(*arguments: str) -> float:
    start = time.perf_counter()
    subprocess.run([sys.executable, *arguments], capture_output=True, check=False)
    return time.perf_counter() - start


def rows(_: torch.device) -> dict[str, float]:
    least = dict.fromkeys(["torch", *COMMANDS], float("inf"))
    for _ in range(5):
        for name, arguments in {"torch": TORCH, **COMMANDS}.items():
            least[name] = min(least[name], seconds(*arguments))
    return {name: least[name] / least["torch"] for name in COMMANDS}
