"""Motion files and pages: `python -m benchmarks.bench files`; a minute or two on two cores.

gain          speed-up of all cores over one, per core, for resampling and writing 300 BVH clips of 2,400 frames
GB held       memory of all processes together meanwhile (Linux only); does not depend on the number of clips
MB of a page  for a run with 50 futures of 6 windows
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch

from dvae import motion
from dvae.cli import main as dvae

CLIPS, FRAMES = 300, 2400
TARGETS = {"gain": ("at least", 0.6), "GB held": ("at most", 2.0), "MB of a page": ("at most", 5.0)}
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def used_memory(process: int) -> int:
    """Return the memory of a process and its children in bytes; shared memory counts once."""
    children = [
        int(child) for task in Path(f"/proc/{process}/task").iterdir() for child in _read(task / "children").split()
    ]
    pss = next(
        (line for line in _read(f"/proc/{process}/smaps_rollup").splitlines() if line.startswith("Pss:")), "Pss: 0"
    )
    return 1024 * int(pss.split()[1]) + sum(map(used_memory, children))


def _read(path: str | Path) -> str:
    try:
        return Path(path).read_text()
    except OSError:  # the process has ended
        return ""


def converting(folder: Path) -> dict[str, float]:
    clips = folder / "clips"
    [first] = motion.write_motion(clips, motion.simulate(1, FRAMES), "bvh")
    for number in range(1, CLIPS):
        shutil.copy(first, first.with_name(f"copy_{number:04}.bvh"))
    seconds, most = {}, 0
    for jobs in (1, CORES):
        start = time.perf_counter()
        with ThreadPoolExecutor(1) as pool:
            options = ["--out", str(folder / f"out{jobs}"), "--format", "bvh", "--fps", "20", "--jobs", str(jobs)]
            conversion = pool.submit(dvae, ["data", "convert", str(clips), *options])
            while not conversion.done():
                if Path("/proc/self/smaps_rollup").exists():
                    most = max(most, used_memory(os.getpid()))
                time.sleep(0.2)
        if conversion.result():
            raise SystemExit("the clips were not converted")
        seconds[jobs] = time.perf_counter() - start
    return {"gain": seconds[1] / seconds[CORES] / CORES, "GB held": most / 1e9}


def page(folder: Path) -> dict[str, float]:
    run, out = str(folder / "run"), folder / "page.html"
    options = ["--steps", "10", "--latent", "4", "--warm-up", "5", "--validate-every", "5"]
    if dvae(["fit", "srnn", *options, "--out", run]) or dvae(["report", run, "--samples", "50", "--out", str(out)]):
        raise SystemExit("`dvae fit` or `dvae report` failed, so that no page was written; see its output above")
    return {"MB of a page": out.stat().st_size / 1e6}


def rows(_: torch.device) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        return converting(Path(folder)) | page(Path(folder))
