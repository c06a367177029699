"""Speed of TrajeVAE at its size for Human3.6M: `python benchmarks/trajevae.py`, or `make bench`.

    step      a training step (32 windows of 1 + 100 frames; forward, backward, Adam), in units of one
              2048 x 2048 x 2048 float32 product timed beside it. The public implementation takes 48.
    sampling  50 motions of one pose and its paths, in the same unit; the public implementation 11
    bend      5 motions of 100 frames bent to the path of a wrist, in seconds, once

Motion is simulated, on the same tree of joints. The first two are the least of several times, in turns with products.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import replace

import torch
from speed import report, seconds, start, training_step

import dvae
from dvae import motion

TARGETS = {"step": ("at most", 48.0), "sampling": ("at most", 5.0)}


def main() -> None:
    start(__doc__)

    protocol = replace(motion.PROTOCOLS["simulated-trajectories"], predicted=100)
    windows = motion.windows(motion.simulate(), protocol, "train")
    method = dvae.method("trajevae")
    method = method.filled(method.preset(motion.HUMAN36M))
    model = method.build(windows).train()
    source, generator = method.train(windows).batches, torch.Generator().manual_seed(0)
    elbo, objective, square = dvae.SequenceELBO(), method.train(windows).objective, torch.randn(2048, 2048)
    step = training_step(model, lambda: objective(elbo.terms(model, source.sample(32, generator)), 0))
    batch = {name: value[:1] for name, value in windows.given(["RFoot", "LFoot"]).all().items()}
    past = {"x": batch["x"][:, :1], "y": batch["y"]}
    sampling = lambda: model.forecast(past, 100, 50)  # noqa: E731
    product, *times = seconds(lambda: square @ square, step, sampling, repeat=3)
    found = dict(zip(("step", "sampling"), (each / product for each in times), strict=True))

    positions = windows.positions(batch["x"])[0].numpy()
    path = {"LWrist": positions[1:, windows.skeleton.find("LWrist")]}
    begun = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the model is not fitted, and stretches bones
        model.complete(positions[0], path, samples=5, exact=True)
    found["bend"] = time.perf_counter() - begun
    report(found, TARGETS)


if __name__ == "__main__":
    main()
