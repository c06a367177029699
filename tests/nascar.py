"""The simulated race track of Linderman et al. (2017, arXiv 1610.08466), and how often `rslds` finds its states.

cd tests && python -m nascar        fit three data sets with the defaults and print the share of correct states
"""

import math

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor
from torch.nn.functional import one_hot

import dvae

LAP = 128
"""Steps of a lap."""


def track(size: int = 10) -> dvae.DynamicalVAE:
    """Return the true model: half-turns around (2, 0) and (-2, 0), a straight to the right and a faster one back.

    The emission of x (`size` numbers) is random, with orthonormal columns and a noise of 0.1.
    """
    model = dvae.method("rslds").build({"x": size})
    states, dynamics, emission = (model.generator[name] for name in ("k", "z", "x"))
    angles = torch.tensor([math.pi / 24, math.pi / 48, 0.0, 0.0])
    turn = torch.matrix_exp(angles[:, None, None] * torch.tensor([[0.0, 1.0], [-1.0, 0.0]]))
    centre = torch.tensor([[2.0, 0.0], [-2.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    straight = torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.1, 0.0], [-0.25, 0.0]])
    values = {
        states.head.out.weight: torch.tensor([[100.0, 0.0], [-100.0, 0.0], [0.0, 10.0], [0.0, -10.0]]),
        states.head.out.bias: torch.tensor([-200.0, -200.0, 0.0, 0.0]),
        dynamics.network.transition: turn,
        dynamics.network.offset: straight + centre - (turn @ centre[..., None])[..., 0],
        dynamics.network.first: torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.0, 1.0], [0.0, -1.0]]),
        dynamics.network.whitening: torch.eye(2) * math.log(100),
        emission.head.out.weight: torch.linalg.qr(torch.randn(size, 2))[0],
        emission.head.log_scale: torch.full((size,), math.log(0.1)),
    }
    with torch.no_grad():
        for parameter, value in values.items():
            parameter[..., -value.shape[-1] :] = value  # z_{t-1} follows k_{t-1}, which has no effect
        states.head.out.weight[:, :4] = 0
    return model


def simulate(sequences: int, steps: int, seed: int) -> tuple[dvae.DynamicalVAE, Tensor, Tensor]:
    """Return a true model, x (N, T, D) and the states (N, T); sequences start anywhere on the track."""
    torch.manual_seed(seed)
    model = track()
    draws = model.sample(sequences, steps + LAP)
    window = torch.randint(LAP, (sequences, 1)) + torch.arange(steps)
    x, states = (draws[name][torch.arange(sequences)[:, None], window] for name in ("x", "k"))
    return model, x, states.argmax(-1)


def accuracy(model: dvae.DynamicalVAE, x: Tensor, states: Tensor) -> float:
    """Return the share of steps whose most probable state is true, after the best one-to-one renaming of states."""
    inferred = one_hot(model.states(x, 8)["k"].mean(0).argmax(-1), 4).flatten(0, 1)
    counts = inferred.mT @ one_hot(states, 4).flatten(0, 1)
    return float(counts[linear_sum_assignment(-counts)].sum() / counts.sum())


def main() -> None:
    """Print the seed, the share of correct held-out states and the IWAE bound of each fit."""
    for seed in range(3):
        _, x, states = simulate(70, 200, seed)
        model = dvae.fit(dvae.method("rslds"), x[:40], x[40:50], seed=seed, progress=False).model
        bound = dvae.iwae_bound(model, x[50:], 64).bound.mean() / x.shape[1]
        print(f"seed {seed}: {accuracy(model, x[50:], states[50:]):.3f} correct, {bound:.3f} nats a step", flush=True)


if __name__ == "__main__":
    main()
