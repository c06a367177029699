"""Speed of TrajeVAE at its size for Human3.6M: `python -m benchmarks.bench trajevae`.

    step      a training step (32 windows of 1 + 100 frames; forward, backward, Adam), over its matrix products
    sampling  50 motions of one pose and its paths, over their matrix products
    bend      seconds of bending 5 motions of 100 frames to the path of a wrist, once

Motion is simulated, on the same tree of joints. Times are the shortest of several, alternating with the products.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import torch

import dvae
from dvae import motion

from .speed import fed_step, over_products, stopwatch

TARGETS = {"bend": ("under", None)}


def rows(device: torch.device) -> dict[str, float]:
    protocol = replace(motion.PROTOCOLS["simulated-trajectories"], predicted=100)
    windows = motion.windows(motion.simulate(), protocol, "train")
    method = dvae.method("trajevae")
    method = method.with_presets(method.preset(motion.HUMAN36M))
    model = method.build(windows).to(device).train()
    step, _ = fed_step(method, model, windows, 32, device)
    batch = {name: value[:1].to(device) for name, value in windows.given(["RFoot", "LFoot"]).all().items()}
    past = {"x": batch["x"][:, :1], "y": batch["y"]}
    sampling = lambda: model.forecast(past, 100, 50)  # noqa: E731
    numbers = dict(zip(("step", "sampling"), over_products(step, sampling), strict=True))

    positions = windows.positions(batch["x"].cpu())[0].numpy()
    path = {"LWrist": positions[1:, windows.skeleton.find("LWrist")]}
    clock = stopwatch()
    start = clock()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the model is not fitted, and stretches bones
        model.complete(positions[0], path, samples=5, exact=True)
    numbers["bend"] = clock() - start
    return numbers
