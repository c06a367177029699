"""Training steps of other implementations over ours, at equal sizes and shapes: `python -m benchmarks.bench peers`.

    NAME, public          the code of Girin et al., https://github.com/XiaoyuBIE1994/DVAE, with its layer sizes for
                          motion and its loss, which has joint errors in place of our density; the environment variable
                          DVAE_PUBLIC_CODE names a clone of it
    NAME, public, limit   a step of the public code over its LSTM layers and matrix products alone, which both codes
                          have: the largest possible ratio without faster layers
    NAME, jax             the same model and loss as ours in JAX, with `lax.scan`, the whole step jitted; needs the
                          package jax, on a GPU `jax[cuda]`
    ..., graph            on a GPU: our step is replayed as a CUDA graph
    ..., kernel           on a GPU: as `graph`, with the Triton kernel in our chain over time

A step is loss, backward pass and Adam; ours is a step of `SVI`. Before the JAX code is timed, its loss is compared with
ours for equal parameters and noise. On a GPU, JAX multiplies matrices in TF32, and torch in float32. Without clone or
package, these rows are left out.
"""

from __future__ import annotations

import configparser
import importlib.util
import math
import os
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch import Tensor, nn

import dvae
from dvae.distributions import chain

from .graphs import step_of
from .speed import BATCH, FAMILY, SIZE, STEPS, layers, products, seconds, training_step

URL = "https://github.com/XiaoyuBIE1994/DVAE"
LATENT = 10
PUBLIC = {name: name.replace("-", "") for name in FAMILY if name != "kvae"}
"""Names of the public configurations, without separators; the KVAE is trained in three stages there."""
MARKOV = ("srnn", "dkf")
CHAINS = (*MARKOV, "vrnn", "rvae-causal", "rvae-noncausal")
LIMITED = ("storn", "dsae")
TARGETS: dict[str, tuple[str, float | None]] = {f"{name}, public": ("at least", None) for name in PUBLIC}
TARGETS |= {f"{name}, public": ("at least", 1.35) for name in LIMITED}
TARGETS |= {f"{name}, public, limit": ("over", None) for name in LIMITED}
TARGETS |= {f"{name}, jax": ("at least", None) for name in MARKOV}
for kind in ("graph", "kernel"):
    TARGETS |= {f"{name}, public, {kind}": ("at least", 10.0 if name in CHAINS else 2.0) for name in PUBLIC}
    TARGETS |= {f"{name}, jax, {kind}": ("at least", 1.5) for name in MARKOV}


def load(path: Path) -> Any:
    """Return a Python file of the clone as a module; its package has the name of ours, so it cannot be imported."""
    spec = importlib.util.spec_from_file_location(f"public_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise FileNotFoundError(path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def public(name: str, x: Tensor, code: Path) -> tuple[nn.Module, Callable[[], object]]:
    """Return a model of the public code and a training step on x (B, T, D)."""
    (file,) = (
        path
        for path in (code / "config" / "motion").glob("cfg_*.ini")
        if re.sub("[-_]|cfg", "", path.stem).lower() == PUBLIC[name]
    )
    config = configparser.ConfigParser()
    config.read(file)
    config["Network"].update({"x_dim": str(x.shape[2]), "z_dim": str(LATENT)})
    kind = config["Network"]["name"]
    module, losses = load(code / "dvae" / "model" / f"{kind.lower()}.py"), load(code / "dvae" / "utils" / "loss.py")
    model = getattr(module, f"build_{kind}")(config, str(x.device))
    x = x.transpose(0, 1).contiguous()

    def loss() -> Tensor:
        total = losses.loss_MPJPE(x, model(x))
        for latent in ("z", "v") if kind == "DSAE" else ("z",):
            moments = (getattr(model, f"{latent}_{each}") for each in ("mean", "logvar", "mean_p", "logvar_p"))
            total = total + losses.loss_KLD(*moments)
        return total / x.shape[:2].numel()

    return model, training_step(model, loss)


def limit(name: str, x: Tensor, code: Path) -> float:
    """Return the time of a step of the public code over the time of its LSTM layers and matrix products."""
    model, step = public(name, x, code)
    whole, lstms, others = seconds(step, layers(model, x.transpose(0, 1)), products(step))
    return whole / (lstms + others)


class Jax:
    """The SRNN and the DKF of `dvae.models.family` in JAX; parameters have the names and shapes of ours.

    Args:
        name: name of the model.
        model: our model.
        device: device of our model; JAX must compute on it.

    Raises:
        RuntimeError: JAX computes on another device.
    """

    def __init__(self, name: str, model: nn.Module, device: torch.device) -> None:
        if torch.get_num_threads() == 1:
            os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
        import jax

        if (backend := jax.default_backend()) != ("gpu" if device.type == "cuda" else device.type):
            raise RuntimeError(f"JAX computes on {backend}, but torch on {device}; a GPU needs the package jax[cuda]")
        self.jax, self.np, self.lax = jax, jax.numpy, jax.lax
        self.terms = {"srnn": self.srnn, "dkf": self.dkf}[name]
        self.parameters = {key: self.array(value) for key, value in model.named_parameters()}

    def array(self, value: Tensor) -> Any:
        """Return a tensor as an array of JAX."""
        return self.np.asarray(value.detach().cpu().numpy())

    def dense(self, p: Mapping[str, Any], name: str, value: Any) -> Any:
        """Return a dense layer of a value."""
        return value @ p[f"{name}.weight"].T + p[f"{name}.bias"]

    def lstm(self, p: Mapping[str, Any], name: str, value: Any) -> Any:
        """Return the states (T, B, W) of an LSTM behind a dense layer, for inputs (T, B, D)."""
        layer = f"{name}.layers.0"
        value = self.np.tanh(self.dense(p, f"{name}.embed.0", value))
        known = value @ p[f"{layer}.weight_ih_l0"].T + p[f"{layer}.bias_ih_l0"] + p[f"{layer}.bias_hh_l0"]
        weight, sigmoid, tanh = p[f"{layer}.weight_hh_l0"], self.jax.nn.sigmoid, self.np.tanh

        def step(carried: Any, known: Any) -> Any:
            h, c = carried
            i, f, g, o = self.np.split(known + h @ weight.T, 4, axis=-1)
            c = sigmoid(f) * c + sigmoid(i) * tanh(g)
            h = sigmoid(o) * tanh(c)
            return (h, c), h

        start = self.np.zeros((value.shape[1], weight.shape[1]))
        return self.lax.scan(step, (start, start), known)[1]

    def normal(self, p: Mapping[str, Any], name: str, features: Any) -> Any:
        """Return location and scale of a normal distribution."""
        loc, raw = self.np.split(self.dense(p, f"{name}.head.out", features), 2, axis=-1)
        return loc, self.jax.nn.softplus(raw) + 1e-3

    def previous(self, value: Any) -> Any:
        """Return the values of the previous steps, zero at the first."""
        return self.np.concatenate([self.np.zeros_like(value[:1]), value[:-1]])

    def srnn(self, p: Mapping[str, Any], x: Any, noise: Any) -> tuple[Any, Any, Any]:
        """Return moments of the guide and of the prior, and the mean of x."""
        join, first, tanh = self.np.concatenate, "network.join.first", self.np.tanh
        h = self.lstm(p, "generator.z.network.memories.0", self.previous(x))
        g = self.lstm(p, "encoder.z.network.memories.0", join([h, x], -1)[::-1])[::-1]

        def step(z: Any, known: Any) -> Any:
            g, e = known
            loc, scale = self.normal(p, "encoder.z", tanh(self.dense(p, f"encoder.z.{first}", join([g, z], -1))))
            z = loc + scale * e
            return z, (z, loc, scale)

        z, *guide = self.lax.scan(step, self.np.zeros_like(noise[0]), (g, noise))[1]
        prior = tanh(self.dense(p, f"generator.z.{first}", join([h, self.previous(z)], -1)))
        features = tanh(self.dense(p, f"generator.x.{first}", join([h, z], -1)))
        return guide, self.normal(p, "generator.z", prior), self.dense(p, "generator.x.head.out", features)

    def dkf(self, p: Mapping[str, Any], x: Any, noise: Any) -> tuple[Any, Any, Any]:
        """Return moments of the guide and of the prior, and the mean of x."""
        network, tanh, nn = "encoder.z.network", self.np.tanh, self.jax.nn
        g = self.lstm(p, f"{network}.memories.0", x[::-1])[::-1]

        def step(z: Any, known: Any) -> Any:
            g, e, is_later = known
            f = tanh(self.dense(p, f"{network}.extractors.z.0", z))
            f = is_later * tanh(self.dense(p, f"{network}.extractors.z.2", f))
            loc, scale = self.normal(p, "encoder.z", tanh(self.dense(p, f"{network}.join.first", 0.5 * (g + f))))
            z = loc + scale * e
            return z, (z, loc, scale)

        z, *guide = self.lax.scan(step, self.np.zeros_like(noise[0]), (g, noise, self.np.arange(len(noise)) > 0))[1]
        network, previous = "generator.z.network", self.previous(z)
        outputs = [
            self.dense(p, f"{network}.{each}.2", nn.relu(self.dense(p, f"{network}.{each}.0", previous)))
            for each in ("gate", "proposal")
        ]
        gate, proposal = nn.sigmoid(outputs[0]), outputs[1]
        mean = (1 - gate) * self.dense(p, f"{network}.linear", previous) + gate * proposal
        variance = nn.softplus(self.dense(p, "generator.z.head.variance", nn.relu(proposal)))
        features = tanh(self.dense(p, "generator.x.network.join.first", z))
        features = tanh(self.dense(p, "generator.x.network.join.rest.2", features))
        return guide, (mean, self.np.sqrt(variance + 1e-6)), self.dense(p, "generator.x.head.out", features)

    def loss(self, p: Mapping[str, Any], x: Any, noise: Any) -> Any:
        """Return the negative ELBO in nats per frame, for x (T, B, D) and noise (T, B, Z)."""
        (loc, scale), (prior_loc, prior_scale), mean = self.terms(p, x, noise)
        ratio, distance = (scale / prior_scale) ** 2, ((loc - prior_loc) / prior_scale) ** 2
        kl = 0.5 * (ratio + distance - 1 - self.np.log(ratio)).sum()
        log_scale = p["generator.x.head.log_scale"]
        log_likelihood = -(
            0.5 * ((x - mean) / self.np.exp(log_scale)) ** 2 + log_scale + 0.5 * math.log(2 * math.pi)
        ).sum()
        return (kl - log_likelihood) / (x.shape[0] * x.shape[1])

    def step(self, x: Tensor) -> Callable[[], object]:
        """Return a training step on x (B, T, D)."""
        jax, np = self.jax, self.np
        data = self.array(x.transpose(0, 1))

        def update(state: Any, key: Any) -> Any:
            p, first, second, t = state
            noise = jax.random.normal(key, (*data.shape[:2], LATENT))
            loss, gradient = jax.value_and_grad(self.loss)(p, data, noise)
            t = t + 1
            first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, first, gradient)
            second = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g * g, second, gradient)
            p = jax.tree.map(
                lambda p, m, v: p - 1e-3 * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8), p, first, second
            )
            return (p, first, second, t), jax.random.split(key)[0], loss

        jitted = jax.jit(update, donate_argnums=0)
        zeros = lambda: jax.tree.map(np.zeros_like, self.parameters)  # noqa: E731
        state = [(jax.tree.map(np.array, self.parameters), zeros(), zeros(), np.zeros(())), jax.random.key(0)]

        def step() -> None:
            *state[:], loss = jitted(*state)
            loss.block_until_ready()

        return step


def jax_step(name: str, x: Tensor) -> Callable[[], object]:
    """Return a training step of the JAX code on x (B, T, D), after a comparison of its loss with ours.

    Raises:
        ValueError: the losses differ.
    """
    model = dvae.method(name, **FAMILY[name]).build({"x": SIZE})
    few = 0.1 * x[:4].cpu()  # so small that the divergence counts
    code, drawn, original = Jax(name, model, x.device), list[Tensor](), chain.GaussianChain.apply

    def draw(noise: Tensor, *others: Any) -> Any:
        drawn.append(noise)
        return original(noise, *others)

    with mock.patch.object(chain.GaussianChain, "apply", draw), torch.no_grad():
        ours = dvae.Evidence()(dvae.SequenceELBO().terms(model, few), 0).item()
    with code.jax.default_matmul_precision("highest"):
        theirs = float(code.loss(code.parameters, code.array(few.transpose(0, 1)), code.array(drawn[0])))
    if not math.isclose(theirs, ours, rel_tol=1e-5):
        raise ValueError(f"the loss of the JAX code is {theirs}, ours is {ours}")
    return code.step(x)


def ratio(name: str, other: Callable[[str, Tensor], Callable[[], object]], x: Tensor, kernel: str | None) -> float:
    """Return the time of another step over the time of ours."""
    model = dvae.method(name, **FAMILY[name]).build({"x": SIZE})
    with mock.patch.object(chain, "KERNEL", kernel):
        theirs, ours = seconds(other(name, x), step_of(model, x, x.is_cuda, x.device, steps=10**6))
    return theirs / ours


def rows(device: torch.device) -> dict[str, Callable[[], float]]:
    x, code = torch.randn(BATCH, STEPS, SIZE, device=device), os.environ.get("DVAE_PUBLIC_CODE")
    peers: dict[str, tuple[Any, Any]] = {
        "public": (PUBLIC, lambda name, x: public(name, x, Path(code or ""))[1]),
        "jax": (MARKOV, jax_step),
    }
    if code and not (Path(code) / "config" / "motion").is_dir():
        raise ValueError(f"DVAE_PUBLIC_CODE is {code!r}, which has no folder config/motion; name a clone of {URL}")
    if not code:
        print("  NAME, public is left out: DVAE_PUBLIC_CODE must name a clone of the public code", flush=True)
        del peers["public"]
    if not importlib.util.find_spec("jax"):
        print("  NAME, jax is left out: it needs the package jax", flush=True)
        del peers["jax"]
    limits = {
        f"{name}, public, limit": partial(limit, name, x, Path(code)) for name in LIMITED if code and not x.is_cuda
    }
    kinds = {", graph": None, ", kernel": "cuda"} if device.type == "cuda" else {"": None}
    return limits | {
        f"{name}, {peer}{kind}": partial(ratio, name, step, x, kernel)
        for kind, kernel in kinds.items()
        for peer, (names, step) in peers.items()
        for name in names
        if kernel is None or name in CHAINS
    }
