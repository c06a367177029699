"""Write tables and a picture of what edges are worth, on surrogates and fitted."""

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
"""How much of the level each of them shows."""
KEEPS, MOVES, NOISE, STEPS = 0.95, 0.3, 0.5, 20


def surrogates(names: tuple[str, ...], steps: int, seeds: int) -> Table:
    """What each edge of some models is worth."""
    models = {name: FAMILY[name][0] for name in names}
    costs = {name: dvae.model_edge_costs(model, steps=steps, seeds=seeds) for name, model in models.items()}
    rows = [(n, f"`{models[n]}`", f"`{edge}`", spread(cost)) for n in names for edge, cost in costs[n].items()]
    return Table(["", "model", "edge", "cost of leaving it out"], rows)


def sensors(path: Path, sequences: int = 600) -> dvae.tables.PanelData:
    """Sensors a of one moving level, z_t = KEEPS z_{t-1} + MOVES e and x_t = a z_t + NOISE e; kept in a file."""
    if not path.exists():
        random = np.random.default_rng(0)
        level = random.standard_normal((sequences, 1)) * MOVES / np.sqrt(1 - KEEPS**2)
        levels = [level := KEEPS * level + MOVES * random.standard_normal(level.shape) for _ in range(STEPS)]
        noise = NOISE * random.standard_normal((sequences, STEPS, len(SENSORS)))
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, x=np.stack(levels, 1) * SENSORS + noise)
    return dvae.tables.PanelData.open(path, cut=dvae.tables.Cut(observed=15, horizon=5, split="sequence"))


def exact(edge: AblatedEdge, found: dvae.Ablation) -> float:
    """Return the exact cost of leaving out an edge, at the weights that generate the data, in nats a step."""
    if edge.kind == "p":
        moves = MOVES**2 / (1 - KEEPS**2) * KEEPS ** np.abs(np.subtract.outer(range(STEPS), range(STEPS)))
        covariance = np.kron(moves, np.outer(SENSORS, SENSORS)) + NOISE**2 * np.eye(STEPS * len(SENSORS))
        size = len(SENSORS) if edge.child == "z" else 1  # of the blocks that are independent without it
        blocks = [covariance[k : k + size, k : k + size] for k in range(0, len(covariance), size)]
        return (sum(np.linalg.slogdet(b)[1] for b in blocks) - np.linalg.slogdet(covariance)[1]) / 2 / STEPS
    less = found.inference.without(edge.child, edge.parent)
    model = dvae.linear_gaussian_surrogate(found.generative, less, {"z": 1, "x": len(SENSORS)}, STEPS)
    with torch.no_grad():
        z, x = model.generator["z"], model.generator["x"]
        z.network.bias.zero_(), x.network.bias.zero_()
        z.network.weights["z"].fill_(KEEPS)  # of those at t-1, as others are masked
        x.network.weights["z"][..., 0] = torch.tensor(SENSORS)
        z.head.log_scale.fill_(np.log(MOVES))[0] = np.log(MOVES / np.sqrt(1 - KEEPS**2))
        x.head.log_scale.fill_(np.log(NOISE))
    return dvae.Oracle(model, STEPS).fit_guide() / STEPS


def fitted(found: dvae.Ablation) -> Table:
    """All costs of each edge."""
    lines = []
    for edge in found.edges:
        costs, estimate = torch.tensor(found.costs[edge.run]), found.differences[edge.run]
        low, high = map(number, estimate.interval())
        cells = [spread(costs), str(estimate), f"{low} to {high}", number(found.p_values[edge.run])]
        lines.append([f"`{edge.name}`", edge.of, *cells, f"{exact(edge, found):.3f}"])
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
        runs: directory of the fits, which are continued where they stopped.
        results: folder of the tables, such as benchmarks/results; None prints them.
        steps: of the sequences on surrogates.
        seeds: surrogates of random weights.
        fitting: steps of a fit.
        jobs: fits at a time.
    """
    write(results, {"ablation/surrogates": surrogates(NAMES, steps, seeds)})
    generative, inference = LEVEL
    method = dvae.method("equations", generative=generative, inference=inference, latent=1, width=16, warm_up=100)
    data = sensors(runs / "sensors.npz")
    on_surrogates = {"sizes": {"z": 1, "x": len(SENSORS)}, "steps": steps, "surrogates": seeds}
    found = dvae.ablate(method, data, runs, (0, 1, 2), {**TRAINING, "steps": fitting}, jobs, **on_surrogates)
    found.save(runs / "edges.json")
    write(results, {"ablation/fitted": fitted(found)})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
