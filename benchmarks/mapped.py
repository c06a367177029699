"""Training on 10^7 frames on disk over fewer in memory: `python -m benchmarks.bench mapped`; minutes, 2.5 GB of disk.

memory          peak anonymous memory (Linux only) of `dvae fit` on 10^7 frames of 48 numbers, over 10^5
memory, motion  the same for 17 joints: an archive of 100 clips over one of as many shorter clips in memory
a step          processor time of drawing a batch and a training step, mapped over in memory: SRNN, B 32, T 125
a draw          the same for drawing the batch only

All commands end with a validation, on a tenth of the frames. Files were just written, so that most of them are in the
system's cache. Without the cache, a draw waits for the disk, and processor time does not include that wait.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import dvae
from dvae import motion
from dvae.motion.files.arrays import save_clips
from dvae.tables import Cut, PanelData

from .speed import seconds

FRAMES, FEW, SIZE, BATCH = 10**7, 10**5, 48, 32
CUT = Cut(observed=25, horizon=100, split="time")
TARGETS = {"memory": ("at most", 1.1), "memory, motion": ("at most", 1.1), "a step": ("at most", 1.05)}


def blocks(frames: int, size: int = FEW) -> Iterator[np.ndarray]:
    """Yield frames of smooth numbers in blocks."""
    rng = np.random.default_rng(0)
    for _ in range(frames // size):
        yield np.cumsum(rng.standard_normal((size, SIZE), np.float32), 0) / 100


def write_frames(path: Path, frames: int) -> Path:
    """Write an npy file of frames."""
    with path.open("wb") as file:
        header = {"descr": "<f4", "fortran_order": False, "shape": (frames, SIZE)}
        np.lib.format.write_array_header_1_0(file, header)
        for block in blocks(frames):
            block.tofile(file)
    return path


def write_walks(path: Path, frames: int) -> Path:
    """Write an archive of 100 clips with so many frames in all, in its own folder."""
    path.parent.mkdir()
    [walk] = motion.simulate(1, FEW, seed=0)
    length = frames // 100
    place = np.arange(length) % FEW
    clips = (
        replace(walk, split="train", name=f"walk {n}", positions=walk.positions[place], truth={}) for n in range(100)
    )
    save_clips(path, clips, lambda: motion.WALKER)
    return path


def anonymous(process: int) -> int:
    """Return the anonymous memory of a process in bytes; 0 if the process has ended."""
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("RssAnon:")), 0)


def peak_memory(data: Path, *options: str) -> int:
    """Return the peak anonymous memory of a fit to a file, in bytes."""
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "dvae", "fit", "srnn", "--data", str(data), "--out", f"{out}/run"]
        command += ["--steps", "20", "--batch-size", str(BATCH), *options]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        peak = 0
        while process.poll() is None:
            peak = max(peak, anonymous(process.pid))
            time.sleep(0.01)
        assert process.stderr is not None
        if process.returncode:
            raise SystemExit(f"the fit to {data} failed: {process.stderr.read()}")
    return peak


def steps(path: Path, frames: int = FRAMES // 10) -> dict[str, float]:
    """Return the processor time of training steps and draws, mapped over in memory."""
    mapped = PanelData.open(path, cut=CUT)
    in_memory = PanelData.of(np.array(mapped.panel.series[0].values[:frames]), cut=CUT)
    sources = [data.windows("train") for data in (mapped, in_memory)]
    model = dvae.method("srnn").build(in_memory.schema)
    svi = dvae.SVI(model, progress=False)
    svi.init()
    generator = torch.Generator().manual_seed(0)
    training_steps = seconds(*(lambda s=s: svi.step(s.sample(BATCH, generator)) for s in sources), repeat=50)
    draws = seconds(*(lambda s=s: s.sample(BATCH, generator) for s in sources), repeat=200)
    return {"a step": training_steps[0] / training_steps[1], "a draw": draws[0] / draws[1]}


def rows(_: torch.device) -> dict[str, float]:
    cut = ["--observed", str(CUT.observed), "--horizon", str(CUT.horizon), "--split", CUT.split]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if shutil.disk_usage(folder).free < 2.5e9:
            raise SystemExit(f"{folder} has less than 2.5 GB of free space; set TMPDIR to a folder with more")
        many, few = write_frames(folder / "many.npy", FRAMES), write_frames(folder / "few.npy", FEW)
        ratios = {"memory": peak_memory(many, *cut) / peak_memory(few, *cut), **steps(many)}
        many.unlink()
        walks = [peak_memory(write_walks(folder / str(frames) / "walks.npz", frames)) for frames in (FRAMES, FEW)]
    return ratios | {"memory, motion": walks[0] / walks[1]}
