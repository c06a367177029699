"""Write tables of missing dependencies of guides, their cost, and guides without missing dependencies."""

from collections.abc import Sequence
from pathlib import Path

import torch
import tyro

import dvae
from dvae.inference.evaluation.estimates import number

from .engine import settings
from .results import Table, write

FAMILY: dict[str, tuple[str, str]] = settings(__file__)
DERIVED = ("DKF", "SRNN", "DSAE", "HiT-DVAE", "two layers")
"""Models in the tables of derived guides and of edge costs."""


def spread(cost: torch.Tensor) -> str:
    """Format the mean, minimum and maximum over random models."""
    mean, least, largest = (number(float(value)) for value in (cost.mean(), cost.min(), cost.max()))
    return f"{mean} ({least} to {largest})"


def derived(names: Sequence[str]) -> Table:
    """Return a table of the guides of some models without missing dependencies, with their cost."""
    rows = [(name, f"`{guide}`", *rest) for name in names for guide, *rest in dvae.alternatives(FAMILY[name][0]).rows]
    return Table(["", "guide", "order", "edges", "sequential", "sampled KL"], rows)


def edge_rows(names: Sequence[str], steps: int, seeds: int) -> Table:
    """Return a table of the cost of leaving out each edge of the derived guide."""
    costs = {name: dvae.edge_costs(FAMILY[name][0], steps=steps, seeds=seeds) for name in names}
    rows = [(name, f"`{edge}`", spread(cost)) for name, each in costs.items() for edge, cost in each.items()]
    return Table(["", "edge", "cost of leaving it out"], rows)


def row(name: str, generative: str, inference: str, steps: int, seeds: int) -> list[str]:
    """Return the row of a model and its guide."""
    audit = dvae.audit(generative, inference)
    missing, redundant = (
        ", ".join(f"`{term}`" for terms in terms_by_variable.values() for term in terms) or "–"
        for terms_by_variable in (audit.missing, audit.redundant)
    )
    sizes = dict.fromkeys((*audit.generative.variables,), 1)
    cost = dvae.kl_gap(generative, inference, sizes, steps=steps, seeds=seeds)
    return [name, f"`{generative}`", f"`{inference}`", missing, redundant, spread(cost)]


def main(results: Path | None = None, steps: int = 5, seeds: int = 5) -> None:
    """Write the tables.

    Args:
        results: folder of the tables, such as benchmarks/results; None prints them.
        steps: length of the sequences.
        seeds: number of models with random weights.
    """
    rows = [row(name, *equations, steps, seeds) for name, equations in FAMILY.items()]
    guides = Table(["", "model", "guide", "missing", "redundant", "cost"], rows)
    names = [name for name in DERIVED if name in FAMILY]
    edges = edge_rows(names, steps, seeds)
    write(results, {"audits/guides": guides, "audits/derived": derived(names), "audits/edges": edges})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
