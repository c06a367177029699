"""Motion files and pages: `python benchmarks/files.py`, or `make bench`; a minute or two on two cores.

    converting    300 BVH clips of 2,400 frames resampled and written again: on all cores over one alone, a clip at a
                  time; and the memory of all processes together (Linux tells), which is no matter of how many clips
    a page        of a run with 50 futures of 6 windows: its size

The exit code is 1 where something is missed.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from dvae import motion
from dvae.cli import main as dvae

CLIPS, FRAMES = 300, 2400
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def held(process: int) -> int:
    """Bytes that a process and those below it hold; what several share is counted once."""
    below = [
        int(child) for task in Path(f"/proc/{process}/task").iterdir() for child in _read(task / "children").split()
    ]
    own = next(
        (line for line in _read(f"/proc/{process}/smaps_rollup").splitlines() if line.startswith("Pss:")), "Pss: 0"
    )
    return 1024 * int(own.split()[1]) + sum(map(held, below))


def _read(path: str | Path) -> str:
    try:
        return Path(path).read_text()
    except OSError:  # it has ended meanwhile
        return ""


def converting(folder: Path) -> dict[str, tuple[float, str, bool]]:
    """Name to value, what is asked of it, and whether it holds."""
    clips = folder / "clips"
    [first] = motion.write_motion(clips, motion.simulate(1, FRAMES), "bvh")
    for number in range(1, CLIPS):
        shutil.copy(first, first.with_name(f"copy_{number:04}.bvh"))
    seconds, most = {}, 0
    for jobs in (1, CORES):
        start = time.perf_counter()
        with ThreadPoolExecutor(1) as pool:
            options = ["--out", str(folder / f"out{jobs}"), "--format", "bvh", "--fps", "20", "--jobs", str(jobs)]
            done = pool.submit(dvae, ["data", "convert", str(clips), *options])
            while not done.done():
                if Path("/proc/self/smaps_rollup").exists():
                    most = max(most, held(os.getpid()))
                time.sleep(0.2)
        if done.result():
            raise SystemExit("the clips were not converted")
        seconds[jobs] = time.perf_counter() - start
    gain = seconds[1] / seconds[CORES]
    return {
        f"converting on {CORES} cores over one": (
            gain,
            f"at least {0.6 * CORES:.1f}",
            CORES == 1 or gain > 0.6 * CORES,
        ),
        "GB held meanwhile": (most / 1e9, "at most 2", most < 2e9),
    }


def page(folder: Path) -> dict[str, tuple[float, str, bool]]:
    """The same of a report."""
    run, out = str(folder / "run"), folder / "page.html"
    options = ["--steps", "10", "--latent", "4", "--warm-up", "5", "--validate-every", "5"]
    if dvae(["fit", "srnn", *options, "--out", run]) or dvae(["report", run, "--samples", "50", "--out", str(out)]):
        raise SystemExit("there is no page")
    size = out.stat().st_size / 1e6
    return {"MB of a page of 6 windows with 50 futures": (size, "at most 5", size < 5)}


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        found = converting(Path(folder)) | page(Path(folder))
    for name, (value, asked, holds) in found.items():
        print(f"{name:45} {value:6.2f}  {asked}: {'met' if holds else 'missed'}")
    return int(not all(holds for _, _, holds in found.values()))


if __name__ == "__main__":
    sys.exit(main())
