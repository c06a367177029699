"""Writes the table of docs/bounds.md: what three estimators of the evidence give where it is known."""

from pathlib import Path

import torch
import tyro

import dvae

from .pages import DOCS, code, write

GUIDES = {
    "blind": "q(z_t | z_{t-1})",
    "mean-field": "q(z_t | x_{1:T})",
    "filtering": "q(z_t | z_{t-1}, x_t)",
    "exact": "q(z_t | z_{t-1}, x_{t:T})",
}


HEADER = """| guide | ELBO (exact) | IWAE | FIVO, resampled below .25 K | below .5 K | always |
|---|---|---|---|---|---|
"""


def row(name: str, inference: str, steps: int, sequences: int, particles: int, fitting: int) -> str:
    """Evidence minus each bound, for the best guide of the factorization."""
    model = dvae.twin("p(z_t | z_{t-1}) p(x_t | z_t)", inference, {"z": 1, "x": 1}, steps, scale=0.5)
    oracle = dvae.Oracle(model, steps)
    oracle.fit_guide(fitting)
    torch.manual_seed(0)
    x = model.sample(sequences, steps)["x"]
    with torch.no_grad():
        evidence = oracle.evidence(x)
        exact = (evidence - oracle.bound(x)).mean()
    bounds = [dvae.importance_bound(model, x, particles).bound]
    bounds += [dvae.particle_bound(model, x, particles, resample_below=share).bound for share in (0.25, 0.5, 1.0)]
    gaps = [evidence - bound for bound in bounds]
    cells = [f"{gap.mean():.2f} ± {gap.std() / sequences**0.5:.2f}" for gap in gaps]
    return f"| {code(inference)}, {name} | {exact:.2f} | {' | '.join(cells)} |"


def main(
    page: Path = DOCS / "bounds.md", steps: int = 100, sequences: int = 200, particles: int = 16, fitting: int = 300
) -> None:
    """Write the table.

    Args:
        page: where.
        steps: of a sequence.
        sequences: over which is averaged.
        particles: of IWAE and FIVO.
        fitting: steps of the guide to its best.
    """
    rows = [row(name, inference, steps, sequences, particles, fitting) for name, inference in GUIDES.items()]
    write(page, HEADER + "\n".join(rows) + "\n")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
