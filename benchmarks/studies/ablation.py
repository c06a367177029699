"""Write tables of the cost of leaving out edges, on surrogates and in fitted models."""

from pathlib import Path

import numpy as np
import torch
import tyro

import dvae
from dvae.inference.evaluation.estimates import number
from dvae.runs.ablation import AblatedEdge

from .audits import FAMILY, spread
from .results import Table, write

NAMES = ("DKF", "SRNN", "DSAE")
LEVEL = ("p(z_t | z_{t-1}) p(x_t | z_t)", "faithful")
TRAINING = {"batch_size": 32, "validate_every": 100, "learning_rate": 3e-3}
SENSORS = (1.0, 0.7, 0.5)
"""Weight of the level in each sensor."""
KEEPS, MOVES, NOISE, STEPS = 0.95, 0.3, 0.5, 20


def surrogates(names: tuple[str, ...], steps: int, seeds: int) -> Table:
    """Return a table of the cost of leaving out each edge of some models."""
    models = {name: FAMILY[name][0] for name in names}
    costs = {name: dvae.model_edge_costs(model, steps=steps, seeds=seeds) for name, model in models.items()}
    rows = [(n, f"`{models[n]}`", f"`{edge}`", spread(cost)) for n in names for edge, cost in costs[n].items()]
    return Table(["", "model", "edge", "cost of leaving it out"], rows)


def sensors(path: Path, sequences: int = 600) -> dvae.tables.PanelData:
    """Simulate sensors a of a level, z_t = KEEPS z_{t-1} + MOVES e and x_t = a z_t + NOISE e, or read their file."""
    if not path.exists():
        random = np.random.default_rng(0)
        level = random.standard_normal((sequences, 1)) * MOVES / np.sqrt(1 - KEEPS**2)
        levels = [level := KEEPS * level + MOVES * random.standard_normal(level.shape) for _ in range(STEPS)]
        noise = NOISE * random.standard_normal((sequences, STEPS, len(SENSORS)))
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, x=np.stack(levels, 1) * SENSORS + noise)
    return dvae.tables.PanelData.open(path, cut=dvae.tables.Cut(observed=15, horizon=5, split="sequence"))


def exact(edge: AblatedEdge, ablation: dvae.Ablation) -> float:
    """Return the exact cost of leaving out an edge, at the weights that generate the data, in nats a step."""
    if edge.kind == "p":
        moves = MOVES**2 / (1 - KEEPS**2) * KEEPS ** np.abs(np.subtract.outer(range(STEPS), range(STEPS)))
        covariance = np.kron(moves, np.outer(SENSORS, SENSORS)) + NOISE**2 * np.eye(STEPS * len(SENSORS))
        size = len(SENSORS) if edge.child == "z" else 1  # size of the blocks that are independent without the edge
        blocks = [covariance[k : k + size, k : k + size] for k in range(0, len(covariance), size)]
        return (sum(np.linalg.slogdet(b)[1] for b in blocks) - np.linalg.slogdet(covariance)[1]) / 2 / STEPS
    less = ablation.inference.without(edge.child, edge.parent)
    model = dvae.linear_gaussian_surrogate(ablation.generative, less, {"z": 1, "x": len(SENSORS)}, STEPS)
    with torch.no_grad():
        z, x = model.generator["z"], model.generator["x"]
        z.network.bias.zero_(), x.network.bias.zero_()
        z.network.weights["z"].fill_(KEEPS)  # weights of t-1; the others are masked
        x.network.weights["z"][..., 0] = torch.tensor(SENSORS)
        z.head.log_scale.fill_(np.log(MOVES))[0] = np.log(MOVES / np.sqrt(1 - KEEPS**2))
        x.head.log_scale.fill_(np.log(NOISE))
    return dvae.Oracle(model, STEPS).fit_guide() / STEPS


def edge_table(ablation: dvae.Ablation) -> Table:
    """Return a table of the costs of each edge."""
    lines = []
    for edge in ablation.edges:
        costs, estimate = torch.tensor(ablation.costs[edge.run]), ablation.differences[edge.run]
        low, high = map(number, estimate.interval())
        cells = [spread(costs), str(estimate), f"{low} to {high}", number(ablation.p_values[edge.run])]
        lines.append([f"`{edge.name}`", edge.of, *cells, f"{exact(edge, ablation):.3f}"])
    head = ("edge", "of", "on surrogates, nats a sequence", "fitted, nats a step", "95 %", "p", "exact, nats a step")
    return Table(head, lines)


def main(
    runs: Path,
    results: Path | None = None,
    steps: int = 5,
    seeds: int = 5,
    fitting: int = 500,
    jobs: int = 2,
) -> None:
    """Write the tables.

    Args:
        runs: directory of the fits; interrupted fits continue.
        results: folder of the tables, such as benchmarks/results; None prints them.
        steps: length of the sequences of surrogates.
        seeds: number of surrogates with random weights.
        fitting: number of training steps.
        jobs: number of fits at the same time.
    """
    write(results, {"ablation/surrogates": surrogates(NAMES, steps, seeds)})
    generative, inference = LEVEL
    method = dvae.method("equations", generative=generative, inference=inference, latent=1, width=16, warm_up=100)
    data = sensors(runs / "sensors.npz")
    on_surrogates = {"sizes": {"z": 1, "x": len(SENSORS)}, "steps": steps, "surrogates": seeds}
    ablation = dvae.ablate(method, data, runs, (0, 1, 2), {**TRAINING, "steps": fitting}, jobs, **on_surrogates)
    ablation.save(runs / "edges.json")
    write(results, {"ablation/fitted": edge_table(ablation)})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
