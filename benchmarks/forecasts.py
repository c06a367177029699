"""Quality on real motion: `python benchmarks/forecasts.py`, or `make bench`; about 15 minutes a file on one core.

Fits hit-dvae on bandai2 (by style) and on cmu8, as `dvae fit` does, and asks of its forecasts on the test windows

    ADE, FDE      best of 50, below those of zero velocity
    KL            of every latent above 0.1 nats a frame: nothing has collapsed
    300 frames    finite; the length of every bone within 15 %, on average over frames, of the skeleton's; the mean
                  speed of the last second at least half that of real motion

A file that is not there is left out. The exit code is 1 where something is missed.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import torch

import dvae
from dvae.motion.data.dataset import MotionData
from dvae.runs import directory as runs

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
FILES = (DATA / "bandai" / "bandai2.npz", DATA / "cmu" / "cmu8.npz")


def scores(file: Path, steps: int, batch_size: int) -> dict[str, tuple[float, str, bool]]:
    """Name to value, what is asked of it, and whether it holds."""
    data = MotionData.open(file)
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        training = dvae.Training(steps=steps, batch_size=batch_size, decay=0.5, validate_every=max(steps // 12, 1))
        dvae.fit(dvae.method("hit-dvae", loss="evidence"), data, out=Path(folder) / "run", **vars(training))
        model = runs.load(Path(folder) / "run").model
        minutes = (time.perf_counter() - start) / 60
    test = data.windows("test")
    training = data.windows("train+validation")
    evaluation = dvae.evaluate(model, test, scores=dvae.motion.scores, batch_size=64, training_windows=training)
    print(evaluation)
    ours, still = evaluation["model"], evaluation["zero velocity"]
    rows = {"minutes": (minutes, "at most 15", minutes <= 15)}
    for name in ("ADE", "FDE"):
        limit = still[name].mean
        rows[name] = (ours[name].mean, f"below {limit:.3f}", ours[name].mean < limit)
    rows |= {n: (ours[n].mean, "above 0.1", ours[n].mean > 0.1) for n in evaluation.metrics if n.startswith("KL")}
    return rows | long_run(model, test)


def long_run(
    model: dvae.DynamicalVAE, test: dvae.motion.Windows, windows: int = 100
) -> dict[str, tuple[float, str, bool]]:
    """What 300 free-running frames look like."""
    x = test.all()["x"]
    x = x[:: max(1, len(x) // windows)]
    torch.manual_seed(0)
    futures = model.forecast({"x": x[:, : test.protocol.observed]}, horizon=300, samples=2, draw_emission=False)["x"]
    real, ours = test.positions(x), test.positions(futures)
    bones, true = test.skeleton.bone_lengths(ours), test.skeleton.bone_lengths(real).mean((0, 1))
    error = (bones / true - 1).abs().mean((0, 1, 2))
    second = round(test.protocol.fps)
    speed = [p.diff(dim=-3).norm(dim=-1).mean().item() for p in (ours[:, :, -second:], real)]
    finite = bool(torch.isfinite(futures).all())
    return {
        "300 frames finite": (float(finite), "1", finite),
        "worst bone": (error.max().item(), "at most 0.15", error.max().item() <= 0.15),
        "mean bone": (error.mean().item(), "at most 0.15", error.mean().item() <= 0.15),
        "speed at the end / real": (speed[0] / speed[1], "at least 0.5", speed[0] >= 0.5 * speed[1]),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, default=FILES)
    parser.add_argument("--steps", type=int, default=2400)
    parser.add_argument("--batch-size", type=int, default=32)
    options = parser.parse_args()
    missed = False
    for file in options.files:
        if not file.exists():
            print(f"{file.name}: not there, left out")
            continue
        for name, (value, target, holds) in scores(file, options.steps, options.batch_size).items():
            print(f"{file.stem:8s} {name:24s} {value:8.3f}   {target:16s} {'ok' if holds else 'MISSED'}", flush=True)
            missed |= not holds
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
