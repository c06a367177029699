"""Speed of Mix-and-Match at the preset for small sets and 15 + 60 frames: `python -m benchmarks.bench mix_and_match`.

    feeding    a training step (32 windows of quaternions; forward, backward, Adam) in which the decoder reads its own
               poses, over one with true poses, which uses torch's loop
    step       seconds of the first

Motion is simulated. Times are the shortest of several; the two sides of a ratio alternate.
"""

from __future__ import annotations

from dataclasses import replace

import torch

import dvae
from dvae import motion

from .speed import seconds, to_device, training_step

TARGETS = {"feeding": ("at most", 1.75), "step": ("under", None)}


def rows(device: torch.device) -> dict[str, float]:
    protocol = replace(motion.PROTOCOLS["simulated"], representation="quaternion")
    windows = motion.windows(motion.simulate(), protocol, "train")
    method = dvae.method("mix-and-match").resolve_defaults(windows)
    model = method.build(windows).to(device)
    objective, bound = method.train(windows).objective, dvae.SequenceELBO()
    batch = to_device(windows.sample(32, torch.Generator().manual_seed(0)), device)
    own_poses, true_poses = seconds(
        *(
            training_step(model, lambda p=p: objective(bound.terms(model, batch, scheduled_sampling=p), 1000))
            for p in (1.0, 0.0)
        ),
        repeat=5,
    )
    return {"feeding": own_poses / true_poses, "step": own_poses}
