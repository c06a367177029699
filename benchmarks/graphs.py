"""Training steps on a GPU, replayed as CUDA graphs, as ratios within one run: `python -m benchmarks.bench graphs`.

    METHOD           a step without a graph over a step with one, 32 windows in a batch
    METHOD, B 512    a replayed step on 512 windows over one on 32

Members of the family have the layer sizes of the public implementation and sequences of 125 steps. Methods for motion
have their default sizes, and windows of the protocol `simulated`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

import dvae
from dvae import motion

from .speed import BATCH, FAMILY, SIZE, STEPS, seconds

LARGE = 512
MOTION = ("hit-dvae", "gsps", "cvae", "mt-vae")
TARGETS = {
    **dict.fromkeys(MOTION, ("at least", 5.0)),
    **{f"{name}, B {LARGE}": ("at most", 1.3) for name in (*FAMILY, *MOTION)},
}


def step_of(model: Any, batch: Any, cuda_graph: bool, device: torch.device, **options: Any) -> Callable[[], object]:
    """Return a step of `SVI` on a batch; a replayed one has its graph."""
    svi = dvae.SVI(model, accelerator=device.type, progress=False, cuda_graph=cuda_graph, **options)
    svi.init()
    for _ in range(5):
        svi.step(batch)
    if cuda_graph and not (svi.captured and svi.captured.graphs):
        raise RuntimeError(f"the step has no graph: {svi.captured and svi.captured.obstacles}")
    return lambda: svi.step(batch)


def ratios(name: str, device: torch.device, task: Callable[[int], tuple[Any, Any, dict[str, Any]]]) -> dict[str, float]:
    """Return the rows of a method, from a function of a batch's size to model, batch and options of the fit."""
    actions = []
    for size, cuda_graph in ((BATCH, False), (BATCH, True), (LARGE, True)):
        model, batch, options = task(size)
        actions.append(step_of(model, batch, cuda_graph, device, **options))
    plain, replayed, large = seconds(*actions)
    return {name: plain / replayed, f"{name}, B {LARGE}": large / replayed}


def rows(device: torch.device) -> dict[str, float]:
    def member(name: str, size: int) -> tuple[Any, Any, dict[str, Any]]:
        return dvae.method(name, **FAMILY[name]).build({"x": SIZE}), torch.randn(size, STEPS, SIZE), {"steps": 100}

    windows = motion.windows(motion.simulate(clips=60), motion.PROTOCOLS["simulated"], "train")

    def of_motion(name: str, size: int) -> tuple[Any, Any, dict[str, Any]]:
        method = dvae.method(name, **({"pose_prior": 0.0} if name in ("hit-dvae", "gsps") else {}))
        method = method.resolve_defaults(windows)
        recipe, model = method.train(windows, None, 100), method.build(windows)
        recipe.prepare(model)
        batch = recipe.batches.sample(size, torch.Generator().manual_seed(0))
        return model, batch, {"stages": recipe.stages, "steps": 100}

    numbers: dict[str, float] = {}
    for names, task in ((FAMILY, member), (MOTION, of_motion)):
        for name in names:
            numbers |= ratios(name, device, lambda size, name=name, task=task: task(name, size))  # type: ignore[misc]
    return numbers
