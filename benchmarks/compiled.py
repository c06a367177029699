"""What compiling gains, by method: `python -m benchmarks.bench compiled`; some ten minutes.

    METHOD, step        a step (forward, backward) of which `--compile` has compiled what is marked, over one as it is
    METHOD, warm-up     what the first such step takes more, in steps
    METHOD, difference  the largest relative one of the loss and of the gradient, as a vector, in hundred-thousandths
    METHOD, networks    a step whose networks are compiled in place, as nothing of ours does, over one as it is
    start               seconds until torch has compiled a first trifle, once in a process

Of methods without `step` nothing is compiled, as nothing in them gains. What is compiled is kept by torch on the disk,
so that a second process takes less; here nothing is there before. A warm-up is in the time of the processor, of
compilers too, which run one by one.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from typing import Any
from unittest import mock

import torch
from torch import Tensor, nn

import dvae
from dvae import motion
from dvae.compiled import compiling, require_compiler
from dvae.models.motion.gsps import PRESETS
from dvae.models.motion.motion_latent import MotionLatent
from dvae.motion import bodies
from dvae.motion.segments.embodied import Segments
from dvae.networks.attention import Layer
from dvae.networks.cosine import TransformerLayer
from dvae.networks.graphconv import _Convolution
from dvae.networks.graphs import FrameConvolution, NodeFeatures

from .speed import BATCH, FAMILY, SIZE, STEPS, moved, seconds

NETWORKS = (_Convolution, Layer, NodeFeatures, FrameConvolution, TransformerLayer, nn.Sequential)
"""What is compiled of networks: the largest of these parts, without those within them."""
GAIN = ("gsps, human36m", "gsps", "hit-dvae", "mix-and-match", "motion-latent")
TARGETS = {
    "start": ("under", None),
    **{f"{name}, step": ("at most", 1.0) for name in GAIN},
    **{f"{name}, difference": ("under", 1.0) for name in GAIN},
    **{f"{name}, warm-up": ("under", None) for name in GAIN},
    **{f"{name}, networks": ("under", None) for name in (*GAIN, "trajevae", "srnn", "storn", "kvae")},
}
Loss = Callable[[], Tensor]


def of(method: Any, data: Any, device: torch.device, size: int = 16, **program: Any) -> tuple[nn.Module, Loss]:
    """A model of a method and the loss of one batch by the last stage of its recipe."""
    model, recipe = method.build(data).train(), method.train(data)
    recipe.prepare(model)
    batch = moved(recipe.batches.sample(size, torch.Generator().manual_seed(0)), device)
    objective, bound = recipe.objective, dvae.SequenceELBO()
    program |= {"draws": objective.draws} if objective.draws else {}
    return model.to(device), lambda: objective(bound.terms(model, batch, **program), 1000)


def windows(**protocol: Any) -> Any:
    return motion.windows(motion.simulate(), replace(motion.PROTOCOLS["simulated"], **protocol), "train")


def members(device: torch.device) -> Mapping[str, Callable[[], tuple[nn.Module, Loss]]]:
    """Models at their presets, with their losses, by name."""

    def gsps(preset: str, **protocol: Any) -> tuple[nn.Module, Loss]:
        data = windows(**protocol)
        return of(dvae.method("gsps", **PRESETS[preset]).suited(data), data, device)

    def suited(name: str, size: int, data: Any, **program: Any) -> tuple[nn.Module, Loss]:
        return of(dvae.method(name).suited(data), data, device, size, **program)

    def trajevae() -> tuple[nn.Module, Loss]:
        protocol = replace(motion.PROTOCOLS["simulated-trajectories"], predicted=100)
        method = dvae.method("trajevae")
        data = motion.windows(motion.simulate(), protocol, "train")
        return of(method.filled(method.preset(motion.HUMAN36M)), data, device, 32)

    def motion_latent() -> tuple[nn.Module, Loss]:
        people = bodies.fitted(motion.simulate(clips=4, frames=90, seed=1), bodies.human())
        return of(MotionLatent(), Segments(motion.gait_cycles(people)), device, 32)

    def family(name: str) -> tuple[nn.Module, Loss]:
        x = torch.randn(BATCH, STEPS, SIZE, device=device)
        model = dvae.method(name, **FAMILY[name]).build({"x": SIZE}).to(device).train()
        bound, evidence = dvae.SequenceELBO(), dvae.Evidence()
        return model, lambda: evidence(bound.terms(model, x), 0)

    return {
        "gsps, human36m": lambda: gsps("human36m", observed=25, predicted=100),
        "gsps": lambda: gsps(""),
        "hit-dvae": lambda: suited("hit-dvae", 16, windows()),
        "mix-and-match": lambda: suited("mix-and-match", 32, windows(representation="quaternion"), self_feeding=1.0),
        "motion-latent": motion_latent,
        "trajevae": trajevae,
        **{name: lambda name=name: family(name) for name in ("srnn", "storn", "kvae")},
    }


def spent() -> float:
    """Seconds of the processor so far, of this process and of those that it has waited for."""
    return sum(os.times()[:4])


def parts(module: nn.Module) -> list[nn.Module]:
    """The parts of networks that are compiled."""
    if isinstance(module, NETWORKS):
        return [module]
    return [part for child in module.children() for part in parts(child)]


def compared(model: nn.Module, loss: Loss) -> dict[str, float]:
    """The rows of a method, but for its name."""
    kept = {name: value.clone() for name, value in model.state_dict().items()}
    weights = [parameter for parameter in model.parameters() if parameter.requires_grad]
    chosen = parts(model)

    def step(marked: bool = False, networks: bool = False) -> tuple[Tensor, Tensor]:
        for part, form in zip(chosen, forms, strict=True):
            part._compiled_call_impl = form if networks else None
        torch.manual_seed(0)
        model.zero_grad()
        with compiling() if marked else nullcontext() as found:
            value = loss()
            value.backward()
        used.update(found.used if found else ())
        return value.detach(), torch.cat([w.grad.flatten() for w in weights if w.grad is not None])

    used, forms = set[str](), [None] * len(chosen)
    plain = step()
    model.load_state_dict(kept)  # statistics of batches have moved
    begun = spent()
    ours = step(marked=True)
    first = spent() - begun
    difference = max(float((one - other).norm() / other.norm()) for one, other in zip(ours, plain, strict=True))
    if difference > 1e-5:
        raise AssertionError(f"compiled, a step of {type(model).__name__} differs by {difference:.1e}, more than 1e-5")
    for part in chosen:
        part.compile(dynamic=False)
    forms = [part._compiled_call_impl for part in chosen]
    ways = [step, lambda: step(networks=True), *([lambda: step(marked=True)] if used else [])]
    times = seconds(*ways, repeat=5)
    found = {"networks": times[1] / times[0]} if chosen else {}
    if used:
        warm_up = (first - times[2]) / times[0]
        found = {"step": times[2] / times[0], "warm-up": warm_up, "difference": 1e5 * difference} | found
    return found


def rows(device: torch.device) -> dict[str, float]:
    import torch._inductor.config as inductor

    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch.dict(os.environ, {"TORCHINDUCTOR_CACHE_DIR": folder}),
        inductor.patch(compile_threads=1, fallback_random=True),
    ):
        begun = spent()
        require_compiler(device)
        found = {"start": spent() - begun}
        for name, build in members(device).items():
            torch.compiler.reset()  # of one code there are eight forms at most
            found |= {f"{name}, {row}": value for row, value in compared(*build()).items()}
    return found
