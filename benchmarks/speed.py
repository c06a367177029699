"""Speed of the engine and of the family, as ratios within one run: `python -m benchmarks.bench speed`.

    program   the Pyro training step of an SRNN over the same computation written by hand in torch
    chain     an SRNN training step with a plain loop over z_{t-1} over the fused one
    mixed     an SRNN training step with `bf16-mixed` over one in float32
    cache     generation with the prefix recomputed at every step over generation with caches, Attention
    linear    seconds of a training step over T, Recurrent: the exponent of a power law
    segments  segments seen as time-stamped frames over forward kinematics of as many poses, on one core
    filter    a Kalman chain of 10,000 steps in blocks over step by step; filter-step: with its gradients
    stream    an update of an online filter with K particles over one step of its networks, without anything else: DKF,
              SRNN, VRNN, whose guide proposes, and exact filters of an HMM and of a linear-Gaussian model; memory: the
              process's peak in 10,000 steps of a stream over its peak in the first 1,000
    VARIANT   a training step (forward, backward, Adam) at the layer sizes of the public implementation over the
              forward and backward passes of its LSTM layers

Times are the shortest of several repetitions. The two sides of a ratio alternate, to reduce the influence of other
processes. With one thread, times are processor times. On a GPU, each timing ends with a synchronisation.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any
from unittest import mock

import torch
from torch import Tensor, nn
from torch.multiprocessing.reductions import StorageWeakRef
from torch.nn import functional
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import dvae
from dvae import distributions, motion, networks
from dvae.data.batch import Batch
from dvae.distributions import scan
from dvae.distributions.chain import gaussian_chain
from dvae.distributions.kalman import LinearGaussianChain
from dvae.networks.loop import shift

BATCH, STEPS, SIZE = 32, 125, 48
STREAMS = [(name, particles) for name in ("dkf", "srnn", "vrnn") for particles in (100, 1000)]
STREAMS += [("hmm", 1), ("linear-gaussian", 1)]
TARGETS = {
    **{f"stream-{name}-{particles}": ("at most", 3.0) for name, particles in STREAMS},
    "program": ("at most", 1.15),
    "chain": ("at least", 1.0),
    "cache": ("at least", 8.0),
    "linear": ("under", 1.1),  # 1 is linear; timings are exact to a few percent
    "segments": ("at most", 3.0),
    "filter": ("at most", 0.1),
    "filter-step": ("at most", 0.1),
    "stream-memory": ("under", 1.02),
    "srnn": ("at most", 1.6),
    "dsae": ("at most", 1.35),
    "storn": ("at most", 1.35),
}
FAMILY = {
    "vrnn": {"latent": 10},
    "srnn": {"latent": 10},
    "dkf": {"latent": 10},
    "rvae-causal": {"latent": 10},
    "rvae-noncausal": {"latent": 10},
    "dsae": {"latent": 10, "static": 10},
    "storn": {"latent": 10},
    "kvae": {"latent": 4, "auxiliary": 8, "components": 3},
}


def seconds(*actions: Callable[[], object], repeat: int = 15) -> list[float]:
    """Return the shortest time of each action; actions alternate."""
    clock = stopwatch()
    best = [math.inf] * len(actions)
    for action in actions:
        action()
    for _ in range(repeat):
        for i, action in enumerate(actions):
            start = clock()
            action()
            best[i] = min(best[i], clock() - start)
    return best


def stopwatch() -> Callable[[], float]:
    """Return a clock in seconds: processor time for one thread, otherwise wall time; a GPU is synchronised first."""
    if not torch.cuda.is_initialized():
        return time.process_time if torch.get_num_threads() == 1 else time.perf_counter

    def clock() -> float:
        torch.cuda.synchronize()
        return time.perf_counter()

    return clock


def to_device(batch: Any, device: torch.device) -> Any:
    """Move a batch to a device."""
    return Batch(batch).map(lambda value: value.to(device))


def layers(model: nn.Module, x: Tensor) -> Callable[[], None]:
    """Return the forward and backward passes of a model's LSTM layers, on random inputs of the size of x (B, T, D)."""
    lstms = [module for module in model.modules() if isinstance(module, nn.LSTM)]
    options: Any = {"device": x.device, "requires_grad": True}
    inputs = [torch.randn(*x.shape[:2], layer.input_size, **options) for layer in lstms]

    def run() -> None:
        for layer, value in zip(lstms, inputs, strict=True):
            layer(value)[0].sum().backward()

    return run


class Products(TorchDispatchMode):
    """Record the matrix products within this mode, including backward passes; `run` repeats the same shapes.

    Attention's kernel counts as a whole: two products and the operations between them.
    """

    ATTENTION = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu
    KINDS = (torch.ops.aten.mm, torch.ops.aten.addmm, torch.ops.aten.bmm, torch.ops.aten.baddbmm, ATTENTION)

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[Any, list[Any], dict[str, Any]]] = []
        self.made: dict[Any, Tensor] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func.overloadpacket in self.KINDS:
            arguments = [
                self.like(value) if isinstance(value, Tensor) else value for value in (*args, *kwargs.values())
            ]
            keywords = {
                name: value for name, value in zip(kwargs, arguments[len(args) :], strict=True) if name != "out"
            }
            self.calls.append((func.overloadpacket.default, arguments[: len(args)], keywords))
        return func(*args, **kwargs)

    def like(self, value: Tensor) -> Tensor:
        """Return a tensor with the shape and layout of a value; equal layouts share one."""
        key = tuple(value.shape), tuple(value.stride()), value.dtype
        if key not in self.made:
            self.made[key] = value.new_empty_strided(*key[:2]).fill_(0.5)
        return self.made[key]

    @torch.no_grad()
    def run(self) -> None:
        for func, args, kwargs in self.calls:
            func(*args, **kwargs)


class TensorMemory(TorchDispatchMode):
    """Record in `peak` the largest number of bytes in tensors created within this mode."""

    def __init__(self) -> None:
        super().__init__()
        self.alive: dict[StorageWeakRef, int] = {}
        self.peak = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        inputs, outputs = (
            {StorageWeakRef(one.untyped_storage()): one for one in tree_leaves(tree) if isinstance(one, Tensor)}
            for tree in ((args, kwargs), out)
        )
        self.alive |= {ref: outputs[ref].untyped_storage().nbytes() for ref in outputs.keys() - inputs.keys()}
        self.alive = {ref: size for ref, size in self.alive.items() if not ref.expired()}
        self.peak = max(self.peak, sum(self.alive.values()))
        return out


def products(action: Callable[[], object]) -> Callable[[], None]:
    """Return an action that repeats the matrix products of an action."""
    with Products() as noted:
        action()
    return noted.run


def over_products(*actions: Callable[[], object], repeat: int = 3) -> list[float]:
    """Return the time of each action divided by the time of its matrix products."""
    times = seconds(*(each for action in actions for each in (action, products(action))), repeat=repeat)
    return [total / products_only for total, products_only in zip(times[::2], times[1::2], strict=True)]


def step_of(model: Any, x: Tensor) -> Callable[[], None]:
    """Return a training step on the ELBO."""
    elbo, evidence = dvae.SequenceELBO(), dvae.Evidence()
    return training_step(model, lambda: evidence(elbo.terms(model, x), 0))


def fed_step(method: Any, model: Any, windows: Any, size: int, device: torch.device, **program: Any) -> Any:
    """Return a training step of a method on a batch of windows, and the function that draws batches."""
    recipe, elbo, generator = method.train(windows), dvae.SequenceELBO(), torch.Generator().manual_seed(0)
    draw = lambda: to_device(recipe.batches.sample(size, generator), device)  # noqa: E731
    return training_step(model, lambda: recipe.objective(elbo.terms(model, draw(), **program), 0)), draw


def training_step(model: nn.Module, loss: Callable[[], Tensor]) -> Callable[[], None]:
    optimizer = torch.optim.Adam(model.parameters(), fused=True)

    def step() -> None:
        optimizer.zero_grad()
        loss().backward()
        optimizer.step()

    return step


class ByHand(nn.Module):
    """The SRNN of `models/family/srnn.py` in plain torch, with only the operations of one training step."""

    def __init__(self, x: int, z: int, width: int = 64):
        super().__init__()
        self.x_past, self.x_future = nn.Linear(x, width), nn.Linear(width + x, width)
        self.past, self.future = (nn.LSTM(width, width, batch_first=True) for _ in range(2))
        self.prior, self.prior_out = nn.Linear(width + z, 32), nn.Linear(32, 2 * z)
        self.guide, self.guide_out = nn.Linear(width + z, 32), nn.Linear(32, 2 * z)
        self.decoder, self.decoder_out = nn.Linear(width + z, 64), nn.Linear(64, x)
        self.log_scale = nn.Parameter(torch.full((x,), -2.0))
        self.z = z

    def forward(self, x: Tensor) -> Tensor:
        h = self.past(torch.tanh(self.x_past(shift(x, -1))))[0]
        g = self.future(torch.tanh(self.x_future(torch.cat([h, x], -1))).flip(1))[0].flip(1)
        fixed, recurrent = self.guide.weight.split([h.shape[-1], self.z], dim=1)
        base = functional.linear(g, fixed, self.guide.bias)
        noise = torch.randn(x.shape[1], x.shape[0], self.z, device=x.device)
        layers = [(recurrent, None), (self.guide_out.weight, self.guide_out.bias)]
        z, loc, scale, _ = gaussian_chain(base.transpose(0, 1), noise, layers, min_scale=1e-3)
        z, loc, scale = (v.transpose(0, 1) for v in (z, loc, scale))
        before, raw = self.prior_out(torch.tanh(self.prior(torch.cat([h, shift(z, -1)], -1)))).chunk(2, -1)
        prior_scale = functional.softplus(raw) + 1e-3
        ratio, distance = (scale / prior_scale) ** 2, ((loc - before) / prior_scale) ** 2
        kl = 0.5 * (ratio + distance - 1 - ratio.log()).sum()
        mean = self.decoder_out(torch.tanh(self.decoder(torch.cat([h, z], -1))))
        deviation = self.log_scale.exp()
        log_likelihood = -(((x - mean) ** 2) / (2 * deviation**2) + deviation.log() + 0.5 * math.log(2 * math.pi)).sum()
        return (kl - log_likelihood) / x.shape[:2].numel()


def program(x: Tensor) -> float:
    """Return the time of a Pyro step over a hand-written step."""
    model = dvae.method("srnn", latent=10).build({"x": SIZE}).to(x.device)
    by_hand = ByHand(SIZE, 10).to(x.device)
    a, b = seconds(step_of(model, x), training_step(by_hand, lambda: by_hand(x)))
    return a / b


def chain(x: Tensor) -> float:
    """Return the time of an SRNN step with a plain loop over the fused chain."""
    model = dvae.method("srnn", latent=10).build({"x": SIZE}).to(x.device)
    plain = copy.deepcopy(model)
    plain.encoder["z"].chain = lambda *_: None
    a, b = seconds(step_of(plain, x), step_of(model, x))
    return a / b


def mixed(x: Tensor) -> float:
    """Return the time of an SRNN step with autocast to bfloat16 over one in float32."""
    model = dvae.method("srnn", latent=10).build({"x": SIZE}).to(x.device)
    elbo, evidence = dvae.SequenceELBO(), dvae.Evidence()

    def loss() -> Tensor:
        with torch.autocast(x.device.type, torch.bfloat16):
            return evidence(elbo.terms(model, x), 0)

    a, b = seconds(training_step(model, loss), step_of(model, x))
    return a / b


def cache(device: torch.device, length: int = 100, samples: int = 50) -> float:
    """Return the time of free-running generation without caches over the time with caches."""
    model = dvae.method("hit-dvae", pose_width=8).build({"x": SIZE}).to(device).eval()
    parts = model.generator

    @torch.no_grad()
    def recomputing() -> None:
        w = torch.randn(samples, model.sizes["w"], device=device)
        values = {name: torch.zeros(samples, 0, model.sizes[name], device=device) for name in ("z", "x")}
        for t in range(length):
            for name in ("z", "x"):
                parents = {"w": w} | {k: functional.pad(v, (0, 0, 0, t + 1 - v.shape[1])) for k, v in values.items()}
                loc, scale = (p[:, t] for p in parts[name](parents, samples, t + 1))
                value = loc + scale * torch.randn_like(loc)
                values[name] = torch.cat([values[name], value[:, None]], dim=1)

    a, b = seconds(recomputing, lambda: model.sample(samples, length), repeat=3)
    return a / b


def linear(device: torch.device) -> float:
    """Return the exponent of T in the time of a training step."""
    model = dvae.method("srnn").build({"x": SIZE}).to(device)
    lengths = [125, 250, 500, 1000]
    steps = [step_of(model, torch.randn(8, length, SIZE, device=device)) for length in lengths]
    times = seconds(*steps, repeat=5)
    return math.log(times[-1] / times[0]) / math.log(lengths[-1] / lengths[0])


def segments() -> float:
    """Return the time of framing segments of 0.7 to 1.6 s over forward kinematics of as many poses, on one core."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    people = motion.simulate(clips=200, frames=50, seed=1).with_rotations()
    some = replace(people, clips=[clip.between(0, 20 + 3 * (n % 10)) for n, clip in enumerate(people)])
    view = motion.TimedFrames.of(some)
    rotations, places = view.poses(view.to(some)["x"].double())
    parents, offsets = people.skeleton.parents, people.skeleton.offsets
    a, b = seconds(
        lambda: view.to(some), lambda: motion.geometry.kinematics.forward(parents, rotations, offsets, places), repeat=5
    )
    torch.set_num_threads(threads)
    return a / b


def filters(device: torch.device, steps: int = 10_000, batch: int = 1, size: int = 4) -> tuple[float, float]:
    """Return the time of a Kalman chain in blocks over step by step: forward, and with gradients."""
    options: Any = {"device": device, "requires_grad": True}
    emission, one = 0.3 * torch.randn(steps, batch, 2 * size, size, device=device), torch.eye(size, device=device)
    chain = LinearGaussianChain(
        transition=torch.normal(0.95 * one.expand(steps - 1, batch, size, size), 0.05).requires_grad_(),
        offset=torch.randn(steps - 1, batch, size, **options),
        noise=0.08 * one,
        mean=torch.zeros(batch, size, device=device),
        covariance=20 * one.expand(batch, size, size),
        information=(emission.mT @ emission / 0.03).requires_grad_(),
        potential=torch.randn(steps, batch, size, **options),
    )

    @torch.no_grad()
    def forward(widest: int) -> None:
        with mock.patch.object(scan, "WIDE", widest):
            _ = replace(chain).predicted

    def backward(widest: int) -> None:
        with mock.patch.object(scan, "WIDE", widest):
            mean, covariance = replace(chain).predicted
            (mean.sum() + covariance.sum()).backward()

    each = [seconds(lambda f=f: f(scan.WIDE), lambda f=f: f(0), repeat=5) for f in (forward, backward)]
    return each[0][0] / each[0][1], each[1][0] / each[1][1]


def update(name: str, particles: int, x: Tensor) -> float:
    """Return the time of an update of an online filter over one step of its networks, for all particles.

    Args:
        name: name of a method, or of a model with an exact filter, "hmm" or "linear-gaussian".
        particles: number of particles; 1 for an exact filter.
        x: data (B, D) of a step.
    """
    if name in FAMILY:
        model = dvae.method(name, **FAMILY[name]).build({"x": x.shape[1]})
    elif name == "hmm":
        sizes = {"k": dvae.Discrete(5), "x": x.shape[1]}
        model = dvae.DynamicalVAE("p(k_t | k_{t-1}) p(x_t | x_{t-1}, k_t)", "", sizes)
    else:
        sizes, network = {"z": 4, "x": x.shape[1]}, networks.Dense(())
        pair = "p(z_t | z_{t-1}) p(x_t | z_t)", None
        model = dvae.DynamicalVAE(*pair, sizes, network, distributions.FixedNormal(0.5))
    model = model.to(x.device).eval()
    stream = model.filter(x[:, None].expand(-1, 4, -1), particles if name in FAMILY else None, seed=0)
    engine, values = stream.engine, {"x": x[:, None], "z": x[:, None, :4]}

    @torch.no_grad()
    def step() -> None:
        if name == "linear-gaussian":
            for part in model.generator.values():
                part(values, len(x), 1)
            return
        for each in (*engine.guide.values(), *engine.prior.values()):
            each.step(engine.position, engine.data | engine.paths)

    a, b = seconds(lambda: stream.update(x), step, repeat=200)
    return a / b


def stream_memory(steps: int = 10_000) -> float:
    """Return the most memory that the process used in a stream of many steps, over the first 1,000."""
    import resource  # not on Windows

    model = dvae.method("vrnn", **FAMILY["vrnn"]).build({"x": 2}).eval()
    stream = model.filter(torch.randn(1, 1, 2), 20, lag=5, seed=0)
    peaks = []
    for count in (1000, steps - 1000):
        for _ in range(count):
            stream.update(torch.randn(1, 2))
        peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return peaks[1] / peaks[0]


def member(name: str, x: Tensor) -> float:
    """Return the time of a training step of a variant over its LSTM layers."""
    model = dvae.method(name, **FAMILY[name]).build({"x": SIZE}).to(x.device)
    step, lstm_time = seconds(step_of(model, x), layers(model, x))
    return step / lstm_time


def rows(device: torch.device) -> dict[str, Callable[[], float | dict[str, float]]]:
    x = torch.randn(BATCH, STEPS, SIZE, device=device)
    parts: dict[str, Callable[[], float | dict[str, float]]] = {
        "program": lambda: program(x),
        "chain": lambda: chain(x),
        "mixed": lambda: mixed(x),
        "cache": lambda: cache(device),
        "linear": lambda: linear(device),
    }
    if device.type == "cpu":
        parts |= {"segments": segments, "stream-memory": stream_memory}
    parts["filter"] = lambda: dict(zip(("filter", "filter-step"), filters(device), strict=True))
    for name, particles in STREAMS:
        parts[f"stream-{name}-{particles}"] = partial(update, name, particles, x[:1, 0])
    return parts | {name: partial(member, name, x) for name in FAMILY}
