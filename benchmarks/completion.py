"""Speed of completion by a latent of the paper's size: `python -m benchmarks.bench completion`.

    whole      100 segments from one start each, with 16 markers in 5 frames: one by one over in one batch
    starts     the same from four starts each, the default
    descent    the same, for steps of Adam only
    curvature  the same, for the part that is computed once, mainly the posterior's curvature

A single segment spends most time on starting operations, a batch on the operations themselves. The decoder is not
fitted, which does not change the time. One segment represents all in the one-by-one timing.
"""

from __future__ import annotations

from itertools import cycle, islice

import torch

import dvae
from dvae import motion
from dvae.models.motion.motion_latent import MotionLatent
from dvae.motion import bodies
from dvae.motion.segments.completion import complete, simulate_observations
from dvae.motion.segments.embodied import Segments

from .speed import stopwatch, to_device

MANY, STEPS = 100, 101
TARGETS = {
    "whole": ("at least", 20.0),
    "descent": ("at least", 20.0),
    "starts": ("at least", None),
    "curvature": ("at least", None),
}


def rows(device: torch.device) -> dict[str, float]:
    people = bodies.fit_to_body(motion.simulate(clips=4, frames=90, seed=1), bodies.human())
    segments = Segments(motion.gait_cycles(people))
    model, batch = MotionLatent().build(segments).eval(), segments.all()
    rows = list(islice(cycle(range(len(segments))), MANY))
    x, shape = batch["x"][rows], batch["beta"][rows]
    observations = to_device(simulate_observations(model, x, shape, "markers", frames=range(0, 100, 20)), device)
    model.to(device)

    clock = stopwatch()

    def seconds(descent: dvae.Descent, end: int) -> float:
        start = clock()
        complete(model, {name: value[:end] for name, value in observations.items()}, descent=descent)
        return clock() - start

    descents = {steps: dvae.Descent(steps=steps, starts=1, candidates=1, newton=0) for steps in (1, STEPS)}
    descents |= {"whole": dvae.Descent(starts=1), "starts": dvae.Descent()}
    # the sides alternate, so that other processes affect both
    rounds = [
        {(name, end): seconds(each, end) for name, each in descents.items() for end in (1, MANY)} for _ in range(3)
    ]
    least = {key: min(times[key] for times in rounds) for key in rounds[0]}
    steps = {end: least[STEPS, end] - least[1, end] for end in (1, MANY)}
    ratios = {
        **{name: MANY * least[name, 1] / least[name, MANY] for name in ("whole", "starts")},
        "descent": MANY * steps[1] / steps[MANY],
        "curvature": MANY * least[1, 1] / least[1, MANY],
    }
    return ratios
