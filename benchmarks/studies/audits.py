"""Write tables of what guides miss, what that costs, and of guides that miss nothing."""

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
"""Whose guides are derived, and their edges priced."""


def spread(cost: torch.Tensor) -> str:
    """Mean, least and largest over random models."""
    mean, least, largest = (number(float(value)) for value in (cost.mean(), cost.min(), cost.max()))
    return f"{mean} ({least} to {largest})"


def derived(names: Sequence[str]) -> Table:
    """Return a table of the guides of some models without missing dependencies, with their cost."""
    rows = [(name, f"`{guide}`", *rest) for name in names for guide, *rest in dvae.alternatives(FAMILY[name][0]).rows]
    return Table(["", "guide", "drawn", "edges", "looped", "KL by draws"], rows)


def edge_rows(names: Sequence[str], steps: int, seeds: int) -> Table:
    """Return a table of the cost of leaving out each edge of the derived guide."""
    costs = {name: dvae.edge_costs(FAMILY[name][0], steps=steps, seeds=seeds) for name in names}
    rows = [(name, f"`{edge}`", spread(cost)) for name, each in costs.items() for edge, cost in each.items()]
    return Table(["", "edge", "cost of leaving it out"], rows)


def row(name: str, generative: str, inference: str, steps: int, seeds: int) -> list[str]:
    """A line of the table."""
    audit = dvae.audit(generative, inference)
    missing, redundant = (
        ", ".join(f"`{term}`" for terms in found.values() for term in terms) or "–"
        for found in (audit.missing, audit.redundant)
    )
    sizes = dict.fromkeys((*audit.generative.variables,), 1)
    cost = dvae.kl_gap(generative, inference, sizes, steps=steps, seeds=seeds)
    return [name, f"`{generative}`", f"`{inference}`", missing, redundant, spread(cost)]


def main(results: Path | None = None, steps: int = 5, seeds: int = 5) -> None:
    """Write the tables.

    Args:
        results: folder of the tables, such as benchmarks/results; None prints them.
        steps: of the sequences whose cost is computed.
        seeds: models of random weights.
    """
    rows = [row(name, *equations, steps, seeds) for name, equations in FAMILY.items()]
    guides = Table(["", "model", "guide", "missing", "redundant", "cost"], rows)
    names = [name for name in DERIVED if name in FAMILY]
    edges = edge_rows(names, steps, seeds)
    write(results, {"audits/guides": guides, "audits/derived": derived(names), "audits/edges": edges})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
