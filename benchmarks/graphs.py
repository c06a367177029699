"""Training steps on a GPU, replayed as CUDA graphs, as ratios within one run: `python -m benchmarks.bench graphs`.

    METHOD                 a step without a graph over a step with one, 32 windows in a batch
    METHOD, B 512          a replayed step on 512 windows over one on 32
    METHOD, over a core    windows a second of the replayed step on 512 windows over those of one core of this machine,
                           which has 32 windows in a batch

Members of the family have the layer sizes of the public implementation and sequences of 125 steps. Methods for motion
have their default sizes, and windows of the protocol `simulated`. Their probability of scheduled sampling is constant:
the value at the last step of the recipe's schedule.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch

import dvae
from dvae import motion
from dvae.inference.training.schedules import schedule

from .speed import BATCH, FAMILY, SIZE, STEPS, seconds

LARGE = 512
MOTION = ("hit-dvae", "gsps", "cvae", "mt-vae")
TARGETS = {
    **dict.fromkeys(MOTION, ("at least", 5.0)),
    **{f"{name}, B {LARGE}": ("at most", 1.3) for name in (*FAMILY, *MOTION)},
    **{f"{name}, over a core": ("at least", 10.0) for name in (*FAMILY, *MOTION)},
}
CPU = torch.device("cpu")


def step_of(model: Any, batch: Any, cuda_graph: bool, device: torch.device, **options: Any) -> Callable[[], object]:
    """Return a step of `SVI` on a batch; a replayed one has its graph.

    Raises:
        RuntimeError: the step has no graph.
    """
    svi = dvae.SVI(model, accelerator=device.type, progress=False, cuda_graph=cuda_graph, **options)
    svi.init()
    for _ in range(5 if cuda_graph else 1):
        svi.step(batch)
    if cuda_graph and not (svi.captured and svi.captured.graphs):
        places = {place for each in svi.captured.obstacles.values() for place in each} if svi.captured else ()
        raise RuntimeError(f"the step has no graph: {', '.join(sorted(places)) or 'see the warning of the fit'}")
    return lambda: svi.step(batch)


def ratios(device: torch.device, name: str, task: Callable[[str, int], tuple[Any, Any, Any]]) -> dict[str, float]:
    """Return the rows of a method, from a function of name and batch size to model, batch and options of the fit."""

    def step(size: int, cuda_graph: bool, device: torch.device = device) -> Callable[[], object]:
        model, batch, options = task(name, size)
        return step_of(model, batch, cuda_graph, device, **options)

    plain, replayed, large = seconds(step(BATCH, False), step(BATCH, True), step(LARGE, True))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    (core,) = seconds(step(BATCH, False, CPU), repeat=2)
    torch.set_num_threads(threads)
    over_a_core = (LARGE / large) / (BATCH / core)
    return {name: plain / replayed, f"{name}, B {LARGE}": large / replayed, f"{name}, over a core": over_a_core}


def rows(device: torch.device) -> dict[str, Callable[[], dict[str, float]]]:
    def member(name: str, size: int) -> tuple[Any, Any, dict[str, Any]]:
        return dvae.method(name, **FAMILY[name]).build({"x": SIZE}), torch.randn(size, STEPS, SIZE), {"steps": 100}

    windows = motion.windows(motion.simulate(clips=60), motion.PROTOCOLS["simulated"], "train")

    def of_motion(name: str, size: int) -> tuple[Any, Any, dict[str, Any]]:
        method = dvae.method(name, **({"pose_prior": 0.0} if name in ("hit-dvae", "gsps") else {}))
        method = method.resolve_defaults(windows)
        recipe, model = method.train(windows, None, 100), method.build(windows)
        recipe.prepare(model)
        batch = recipe.batches.sample(size, torch.Generator().manual_seed(0))
        options = {"stages": recipe.stages, "steps": 100, "scheduled_sampling": schedule(recipe.feeding)(99)}
        return model, batch, options

    tasks = dict.fromkeys(FAMILY, member) | dict.fromkeys(MOTION, of_motion)
    return {name: partial(ratios, device, name, task) for name, task in tasks.items()}
