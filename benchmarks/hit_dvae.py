"""Speed of HiT-DVAE at the paper's widths and 15 + 60 frames: `python -m benchmarks.bench hit_dvae`.

    cache       speed-up by caches for 50 futures of 60 frames of one window, over attending to the whole prefix anew
    growth      cost of a frame among 300 over the cost among 60; at most proportional to the frames
    frame       generation of a frame at the preset for small sets, 50 futures of one window, over its matrix products
    seconds     time of 50 futures of 60 frames for each of 100 windows
    samples     memory of 1,024 futures of 8 windows over the memory of 512, which fill two chunks
    evaluation  50 futures of a few windows at that preset, with all motion scores and the bound, without reference
                rows, over the matrix products. "evaluation, seconds" extrapolates to the 1,834 windows of bandai2's
                test set
    step        a training step (16 windows, K motions each; forward, backward, Adam) in which the model reads its own
                output, over one with true frames. "exact": step by step; "gradient": with gradients back in time;
                "two passes": two parallel passes
    draws       a training step with true frames at K = 50, the paper's number of motions, over one at K = 10: time, and
                "draws, memory", the peak of its tensors

Motion is simulated. Times are the shortest of several; the two sides of a ratio alternate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

import dvae
from dvae import motion
from dvae.program.rollout import ScheduledSampling

from .speed import TensorMemory, fed_step, over_products, seconds, stopwatch

TARGETS = {
    "frame": ("at most", 1.5),
    "step, exact": ("at most", 1.2),
    "cache": ("at least", 10.0),
    "growth": ("under", 5.0),
    "seconds": ("under", 30.0),
    "evaluation, seconds": ("under", 90.0),
    "samples": ("under", 1.1),
    "step, seconds": ("under", None),
}
WINDOWS = 1834


@torch.no_grad()
def without_caches(model: dvae.DynamicalVAE, past: Tensor, horizon: int, samples: int) -> Tensor:
    """Return futures as `forecast` does, but evaluate each conditional over the whole prefix at every step."""
    x = past.repeat(samples, 1, 1)
    latents = model.guide(x)
    z, w = latents["z"], latents["w"]
    for _ in range(horizon):
        x, z = (torch.cat([v, v.new_zeros(len(v), 1, v.shape[2])], 1) for v in (x, z))
        parents = {"x": x, "z": z, "w": w}
        loc, scale = (p[:, -1] for p in model.generator["z"](parents, len(x), x.shape[1]))
        z[:, -1] = torch.addcmul(loc, scale, torch.randn_like(loc))
        x[:, -1] = model.generator["x"](parents, len(x), x.shape[1])[0][:, -1]
    return x


def rows(device: torch.device) -> dict[str, float]:
    windows = motion.windows(motion.simulate(), motion.PROTOCOLS["simulated"], "train")
    method = dvae.method("hit-dvae", pose_prior=0.0, decoder=256).resolve_defaults(windows)  # the paper's width
    model = method.build(windows)
    method.train(windows).prepare(model)
    model.to(device)
    past = model.turned(windows.all()["x"][:100, : windows.protocol.observed].to(device))
    numbers: dict[str, float] = {}

    model.eval()
    one = past[:1]
    cached, anew, long = seconds(
        lambda: model.forecast(one, 60, 50, draw_emission=False),
        lambda: without_caches(model, one, 60, 50),
        lambda: model.forecast(one, 300, 50, draw_emission=False),
        repeat=3,
    )
    small = dvae.method("hit-dvae", pose_prior=0.0).build(windows).to(device).eval()
    generation = lambda: small.forecast(one, 60, 50, draw_emission=False)  # noqa: E731
    (numbers["frame"],) = over_products(generation)
    numbers["cache"] = anew / cached
    numbers["growth"] = (long - cached) / (300 - 60) / (cached / 60)
    clock = stopwatch()
    start = clock()
    for part in past.split(20):
        model.forecast(part, 60, 50, draw_emission=False)
    numbers["seconds"] = clock() - start

    def peak_memory(samples: int) -> int:
        with TensorMemory() as memory:
            futures = small.forecast(past[:8], 60, samples, draw_emission=False)
        return memory.peak - sum(value.untyped_storage().nbytes() for value in futures.values())

    numbers["samples"] = peak_memory(1024) / peak_memory(512)

    def evaluation(clips: int, batch_size: int) -> tuple[Callable[[], object], int]:
        """Return an evaluation of the test split of so many clips, and its number of windows."""
        test = motion.windows(motion.simulate(clips), motion.PROTOCOLS["simulated"], "test")
        options = {"scores": motion.scores, "batch_size": batch_size, "references": False, "progress": False}
        return lambda: dvae.evaluate(small, test, **options), len(test)

    few, _ = evaluation(10, batch_size=6)  # few windows, because products of as many shapes as frames are stored
    (numbers["evaluation"],) = over_products(few)
    more, count = evaluation(64, batch_size=64)
    numbers["evaluation, seconds"] = seconds(more, repeat=1)[0] / count * WINDOWS

    model.train()
    draws = method.train(windows).objective.draws

    def step(feeding: ScheduledSampling | None) -> Callable[[], None]:
        sampled = None if feeding is None else replace(feeding, start=windows.protocol.observed)
        return fed_step(method, model, windows, 16, device, draws=draws, scheduled_sampling=sampled)[0]

    kinds = {
        "exact": ScheduledSampling(1.0, gradient=False),
        "gradient": ScheduledSampling(1.0),
        "two passes": ScheduledSampling(1.0, passes=2, gradient=False),
    }
    forced, *sampled = seconds(step(None), *(step(feeding) for feeding in kinds.values()), repeat=3)
    numbers |= {f"step, {kind}": each / forced for kind, each in zip(kinds, sampled, strict=True)}
    numbers["step, seconds"] = forced

    def drawn(samples: int) -> Callable[[], None]:
        return fed_step(replace(method, samples=samples), model, windows, 16, device, draws={"w": samples})[0]

    def peak_of_step(step: Callable[[], None]) -> int:
        with TensorMemory() as memory:
            step()
        return memory.peak

    few_motions, many_motions = drawn(10), drawn(50)
    few_seconds, many_seconds = seconds(few_motions, many_motions, repeat=3)
    numbers["draws"] = many_seconds / few_seconds
    numbers["draws, memory"] = peak_of_step(many_motions) / peak_of_step(few_motions)

    return numbers
