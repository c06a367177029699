"""How soon the command line answers, beside `import torch`: `python benchmarks/startup.py`.

Times are the least of several starts, the sides alternating. Each row says whether its target was met; one that was
missed makes the exit status 1.
"""

import subprocess
import sys
import time

TORCH = ("-c", "import torch")
ROWS = {
    "dvae --help": (("-m", "dvae.cli", "--help"), 1.3),
    "an unknown command": (("-m", "dvae.cli", "fitt"), 1.3),
    "dvae list": (("-m", "dvae.cli", "list"), 2.5),
    "dvae fit vae --help": (("-m", "dvae.cli", "fit", "vae", "--help"), 2.5),
    "import dvae": (("-c", "import dvae"), 0.3),
}


def seconds(*arguments: str) -> float:
    start = time.perf_counter()
    subprocess.run([sys.executable, *arguments], capture_output=True, check=False)
    return time.perf_counter() - start


def main() -> int:
    least = dict.fromkeys(["torch", *ROWS], float("inf"))
    for _ in range(5):
        least["torch"] = min(least["torch"], seconds(*TORCH))
        for name, (arguments, _target) in ROWS.items():
            least[name] = min(least[name], seconds(*arguments))
    missed = 0
    for name, (_, target) in ROWS.items():
        ratio = least[name] / least["torch"]
        missed += ratio > target
        print(
            f"{name:22} {ratio:5.2f} x import torch, target at most {target}: {'missed' if ratio > target else 'met'}"
        )
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
