"""Write a table of models with states that are summed out, on data with switching dynamics.

Next to the bounds is the estimate of a bootstrap particle filter over states and latents of the fitted model, which
uses neither its guide nor the sums.
"""

import math
from collections.abc import Mapping
from pathlib import Path

import torch
import tyro
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor
from torch.nn.functional import one_hot

import dvae
from dvae.networks import Dense, Recurrent

from .results import Table, write

CHAIN, LATENT = "p(k_t | k_{t-1})", "q(z_t | z_{t-1}, x_{1:T})"
MODELS: dict[str, tuple[str, str, dict[str, int]]] = {
    "no states": ("p(z_t | z_{t-1}) p(x_t | z_t)", LATENT, {"z": 2}),
    "no states, wider": ("p(z_t | z_{t-1}) p(x_t | z_t)", LATENT, {"z": 4}),
    "8 states alone": (f"{CHAIN} p(x_t | k_t)", "", {"k": dvae.Discrete(8)}),
    "8 states, x's past": (f"{CHAIN} p(x_t | k_t, x_{{t-1}})", "", {"k": dvae.Discrete(8)}),
    **{
        f"{states} states": (
            f"{CHAIN} p(z_t | z_{{t-1}}, k_t) p(x_t | z_t)",
            LATENT,
            {"k": dvae.Discrete(states), "z": 2},
        )
        for states in (2, 3, 4)
    },
}


def switching(sequences: int, steps: int) -> tuple[Tensor, Tensor]:
    """Simulate points on a circle that switch between a slow and a fast rotation, every 20 steps on average.

    Returns:
        x (N, T, 2), and the state (N, T): 0 is slow, 1 is fast.
    """
    state = (torch.rand(sequences) < 0.5).long()
    place, points, states = torch.randn(sequences, 2), [], []
    for _ in range(steps):
        state = torch.where(torch.rand(sequences) < 0.05, 1 - state, state)
        angle = torch.tensor([0.1, 0.7])[state]
        turn = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], 1).unflatten(1, (2, 2))
        place = 0.99 * (turn @ place[..., None])[..., 0] + 0.1 * torch.randn(sequences, 2)
        points.append(place + 0.2 * torch.randn(sequences, 2))
        states.append(state)
    return torch.stack(points, 1), torch.stack(states, 1)


@torch.no_grad()
def filtered(model: dvae.DynamicalVAE, x: Tensor, particles: int) -> Tensor:
    """Return the log of a bootstrap particle filter's estimate of p(x), (B,); the model is the proposal."""
    size, steps, _ = x.shape
    names = [name for block in model.generative.blocks for name in block.names if name not in model.observed]
    last: dict[str, Tensor] = {n: torch.zeros(size * particles, model.sizes[n]) for n in (*names, "x")}
    total = torch.zeros(size)
    for t in range(steps):
        now: dict[str, Tensor] = {}
        for name in names:
            now[name] = _law(model, name, last, now, t == 0).sample()
        now["x"] = x[:, t].repeat_interleave(particles, 0)
        logs = _law(model, "x", last, now, t == 0).log_prob(now["x"]).unflatten(0, (size, particles))
        total += logs.logsumexp(1) - math.log(particles)
        ancestors = torch.multinomial(logs.softmax(1), particles, replacement=True)
        rows = (ancestors + particles * torch.arange(size)[:, None]).flatten()
        last = {name: value[rows] for name, value in now.items()}
    return total


def _law(
    model: dvae.DynamicalVAE, name: str, last: Mapping[str, Tensor], now: Mapping[str, Tensor], first: bool
) -> TorchDistribution:
    """Return the conditional distribution of a variable at one step, given the step before if there is one."""
    conditional = model.generator[name]
    pairs = {p: torch.stack([last[p], now.get(p, last[p])], 1) for p in conditional.parents}
    given = {p: value[:, 1:] if first else value for p, value in pairs.items()}
    parameters = conditional(given, len(last["x"]), 2 - first)
    return conditional.head.joint(tuple(p[:, -1] for p in parameters))


def state_accuracy(model: dvae.DynamicalVAE, x: Tensor, states: Tensor) -> str:
    """Return the share of steps with the correct state, after naming each state by its most frequent true state."""
    if "k" not in model.summed:
        return "–"
    inferred = model.states(x, 8)["k"].mean(0).argmax(-1)
    counts = torch.einsum("btk,bts->ks", one_hot(inferred, model.sizes["k"]).float(), one_hot(states, 2).float())
    return f"{counts.amax(1).sum() / counts.sum():.2f}"


def row(
    name: str, train: Tensor, test: tuple[Tensor, Tensor], fitting: int, particles: int, filtering: int
) -> list[str]:
    """Fit a model and return its row."""
    generative, inference, sizes = MODELS[name]
    torch.manual_seed(0)
    networks = {"p": Dense((32,)), "default": Recurrent(32)}
    model = dvae.DynamicalVAE(generative, inference, {**sizes, "x": 2}, networks)
    validation = len(train) // 8
    dvae.fit(
        model, train[validation:], train[:validation], steps=fitting, batch_size=64, learning_rate=3e-3, progress=False
    )
    x, states = test
    per = x.shape[1]
    with torch.no_grad():
        elbo = dvae.SequenceELBO(8).terms(model, x).bound / per
    weighted = dvae.iwae_bound(model, x, particles).bound / per
    few = x[:filtering]
    gap = dvae.iwae_bound(model, few, particles).bound / per - filtered(model, few, 10_000) / per
    cells = [f"{value.mean():.3f} ± {value.std() / len(value) ** 0.5:.3f}" for value in (elbo, weighted, gap)]
    return [f"{name}, `{generative}`", *cells, state_accuracy(model, x, states)]


def main(
    results: Path | None = None, steps: int = 50, fitting: int = 2000, particles: int = 64, filtering: int = 16
) -> None:
    """Write the table.

    Args:
        results: folder of the tables, such as benchmarks/results; None prints them.
        steps: length of a sequence.
        fitting: number of training steps.
        particles: number of particles of the IWAE bound.
        filtering: number of test sequences for the filter with 10,000 particles.
    """
    torch.manual_seed(1)
    train, _ = switching(1024, steps)
    test = switching(200, steps)
    header = ["model", "ELBO", f"IWAE, K = {particles}", "IWAE minus the filter's", "correct states"]
    rows = [row(name, train, test, fitting, particles, filtering) for name in MODELS]
    write(results, {"discrete/models": Table(header, rows)})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
