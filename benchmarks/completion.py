"""Speed of completion at the sizes of the paper's latent: `python benchmarks/completion.py`, or `make bench`.

    markers   100 segments of which 16 markers are seen in 5 of 100 frames, completed one by one over all in one batch
    start     the same of surfaces in the first quarter of a second at 30 a second

Of one segment most time goes into reading the decoder's weights and into starting operations, of many into poses. The
decoder is not fitted, which changes no time. Some of the segments stand for all of those that are completed one by one.
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

MANY, SOME, STEPS = 100, 3, 20
TARGETS = {"markers": ("at least", 20.0)}
CASES = {
    "markers": ("markers", {"frames": range(0, 100, 20)}),
    "start": ("surfaces", {"seconds": 0.25}),
}


def main() -> None:
    start(__doc__)
    people = bodies.fitted(motion.simulate(clips=4, frames=90, seed=1), bodies.human())
    segments = Segments(motion.gait_cycles(people))
    model, batch = MotionLatent().build(segments).eval(), segments.all()
    rows = list(islice(cycle(range(len(segments))), MANY))
    x, shape = batch["x"][rows], batch["beta"][rows]
    found = {}
    for name, (kind, options) in CASES.items():
        seen = glimpsed(model, x, shape, kind, **options)
        descent = dvae.Descent(steps=STEPS, starts=1, candidates=1, newton=0)

        def seconds(first: int, end: int, seen: dict = seen, descent: dvae.Descent = descent) -> float:
            begun = time.perf_counter()
            complete(model, {name: value[first:end] for name, value in seen.items()}, descent=descent)
            return time.perf_counter() - begun

        alone = [seconds(n, n + 1) for n in range(SOME)]
        together = seconds(0, MANY)
        alone += [seconds(n, n + 1) for n in range(SOME)]
        found[name] = MANY * min(alone) / together
    report(found, TARGETS)


if __name__ == "__main__":
    main()
