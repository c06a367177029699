"""Quality on real motion: `python benchmarks/forecasts.py`; about 15 minutes a file on one core.

Fits hit-dvae on bandai2 (by style) and on cmu8, as `dvae fit` does, and checks its forecasts on the test windows:

    ADE, FDE      best of 50, below the errors of zero velocity
    KL            every latent above 0.1 nats a frame, so that no latent has collapsed
    300 frames    finite; the length of every bone within 15 % of the skeleton's, on average over frames; the mean
                  speed of the last second at least half the speed of real motion

Missing files are skipped. The exit code is 1 if a check fails.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch
import tyro

import dvae
from dvae.motion.data.dataset import MotionData

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
WINDOWS = 100
FILES = (DATA / "bandai" / "bandai2.npz", DATA / "cmu" / "cmu8.npz")


def rows(file: Path, steps: int, batch_size: int) -> Iterator[tuple[str, float, str, float]]:
    """Yield the name of each row, its value, the side of its bound and the bound."""
    data = MotionData.open(file)
    with tempfile.TemporaryDirectory() as folder:
        start, out = time.perf_counter(), Path(folder) / "run"
        training = {"steps": steps, "batch_size": batch_size, "decay": 0.5, "validate_every": max(steps // 12, 1)}
        dvae.fit(dvae.method("hit-dvae", loss="evidence"), data, out=out, **training)
        model = dvae.load(out).model
        yield "minutes", (time.perf_counter() - start) / 60, "at most", 15.0
    test, training_windows = data.windows("test"), data.windows("train+validation")
    evaluation = dvae.evaluate(model, test, scores=dvae.motion.scores, batch_size=64, training_windows=training_windows)
    print(evaluation)
    scores, baseline = evaluation["model"], evaluation["zero velocity"]
    yield from ((name, scores[name].mean, "at most", baseline[name].mean) for name in ("ADE", "FDE"))
    yield from ((name, scores[name].mean, "at least", 0.1) for name in evaluation.metrics if name.startswith("KL"))

    x = test.all()["x"]
    x = x[:: max(1, len(x) // WINDOWS)]
    torch.manual_seed(0)
    futures = model.forecast({"x": x[:, : test.protocol.observed]}, horizon=300, samples=2, draw_emission=False)["x"]
    real, generated = test.positions(x), test.positions(futures)
    bones, true = test.skeleton.bone_lengths(generated), test.skeleton.bone_lengths(real).mean((0, 1))
    error, second = (bones / true - 1).abs().mean((0, 1, 2)), round(test.protocol.fps)
    end, moving = (p.diff(dim=-3).norm(dim=-1).mean().item() for p in (generated[:, :, -second:], real))
    yield "300 frames finite", float(torch.isfinite(futures).all()), "at least", 1.0
    yield "worst bone", error.max().item(), "at most", 0.15
    yield "mean bone", error.mean().item(), "at most", 0.15
    yield "speed at the end / real", end / moving, "at least", 0.5


def main(files: tyro.conf.Positional[tuple[Path, ...]] = FILES, steps: int = 2400, batch_size: int = 32) -> int:
    """Fit and score.

    Args:
        files: motion files.
        steps: number of training steps.
        batch_size: number of windows in a batch.
    """
    missed = False
    for file in files:
        if not file.exists():
            print(f"{file.name}: not found, skipped")
            continue
        for name, value, side, bound in rows(file, steps, batch_size):
            holds = value <= bound if side == "at most" else value >= bound
            print(
                f"{file.stem:8s} {name:24s} {value:8.3f}   {side} {bound:.3f} {'ok' if holds else 'MISSED'}", flush=True
            )
            missed |= not holds
    return int(missed)


if __name__ == "__main__":
    sys.exit(tyro.cli(main, description=__doc__))
