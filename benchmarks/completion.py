"""Speed of completion at the sizes of the paper's latent: `python benchmarks/completion.py`, or `make bench`.

    descent    steps of Adam for 100 segments, of which 16 markers are seen in 5 frames: one by one over in one batch
    curvature  the same of what comes once, above all the posterior's curvature

Of one segment most time goes into starting operations, of many into the operations themselves. The decoder is not
fitted, which changes no time; a segment stands for all of those that are completed one by one.
"""

from __future__ import annotations

import time
from itertools import cycle, islice

from speed import report, start

import dvae
from dvae import motion
from dvae.models.motion_latent import MotionLatent
from dvae.motion import bodies
from dvae.motion.completion import complete, glimpsed
from dvae.motion.embodied import Segments

MANY, STEPS = 100, 101
TARGETS = {"descent": ("at least", 20.0)}


def main() -> None:
    start(__doc__)
    people = bodies.fitted(motion.simulate(clips=4, frames=90, seed=1), bodies.human())
    segments = Segments(motion.gait_cycles(people))
    model, batch = MotionLatent().build(segments).eval(), segments.all()
    rows = list(islice(cycle(range(len(segments))), MANY))
    x, shape = batch["x"][rows], batch["beta"][rows]
    seen = glimpsed(model, x, shape, "markers", frames=range(0, 100, 20))

    def seconds(steps: int, end: int) -> float:
        begun = time.perf_counter()
        descent = dvae.Descent(steps=steps, starts=1, candidates=1, newton=0)
        complete(model, {name: value[:end] for name, value in seen.items()}, descent=descent)
        return time.perf_counter() - begun

    times = {end: [min(seconds(steps, end) for _ in range(3)) for steps in (1, STEPS)] for end in (1, MANY)}
    descents = {end: after - before for end, (before, after) in times.items()}
    found = {"descent": MANY * descents[1] / descents[MANY], "curvature": MANY * times[1][0] / times[MANY][0]}
    report(found, TARGETS)


if __name__ == "__main__":
    main()
