"""Write tables of estimates of the evidence for models with known evidence."""

from pathlib import Path

import torch
import tyro

import dvae

from .results import Table, write

MODEL = "p(z_t | z_{t-1}) p(x_t | z_t)"
GUIDES = {
    "blind": "q(z_t | z_{t-1})",
    "mean-field": "q(z_t | x_{1:T})",
    "filtering": "q(z_t | z_{t-1}, x_t)",
    "exact": "q(z_t | z_{t-1}, x_{t:T})",
}


TEMPERATURES = (10, 30, 100)


def fit_best_guide(
    inference: str, steps: int, fitting: int, scale: float = 0.5
) -> tuple[dvae.DynamicalVAE, dvae.Oracle]:
    """Fit the best guide of a factorization; return the model and its oracle."""
    model = dvae.linear_gaussian_surrogate(MODEL, inference, {"z": 1, "x": 1}, steps, scale=scale)
    oracle = dvae.Oracle(model, steps)
    oracle.fit_guide(fitting)
    torch.manual_seed(0)
    return model.requires_grad_(False), oracle


def annealed(name: str, inference: str, steps: int, sequences: int, particles: int, fitting: int) -> list[str]:
    """Return a row of lower and upper bounds minus the evidence."""
    model, oracle = fit_best_guide(inference, steps, fitting)
    samples = model.sample(sequences, steps)
    evidence = oracle.evidence(samples["x"])
    cells = []
    for temperatures in TEMPERATURES:
        for start in (None, {"z": samples["z"]}):
            gap = dvae.annealed_bound(model, samples["x"], temperatures, particles, latents=start).bound - evidence
            cells.append(f"{gap.mean():.3f} ± {gap.std() / sequences**0.5:.3f}")
    return [f"`{inference}`, {name}", *cells]


def row(name: str, inference: str, steps: int, sequences: int, particles: int, fitting: int) -> list[str]:
    """Return a row of the evidence minus each bound, for the best guide of the factorization."""
    model, oracle = fit_best_guide(inference, steps, fitting)
    x = model.sample(sequences, steps)["x"]
    evidence = oracle.evidence(x)
    exact = (evidence - oracle.bound(x)).mean()
    bounds = [dvae.iwae_bound(model, x, particles).bound]
    bounds += [dvae.fivo_bound(model, x, particles, resample_below=share).bound for share in (0.25, 0.5, 1.0)]
    gaps = [evidence - bound for bound in bounds]
    cells = [f"{gap.mean():.2f} ± {gap.std() / sequences**0.5:.2f}" for gap in gaps]
    return [f"`{inference}`, {name}", f"{exact:.2f}", *cells]


def main(
    results: Path | None = None,
    steps: int = 100,
    sequences: int = 200,
    particles: int = 16,
    fitting: int = 300,
    sides: int = 50,
) -> None:
    """Write the tables.

    Args:
        results: folder of the tables, such as benchmarks/results; None prints them.
        steps: length of a sequence.
        sequences: number of sequences.
        particles: number of particles of IWAE and FIVO.
        fitting: number of training steps of the guide.
        sides: number of sequences in the table of bounds from both sides.
    """
    head = ("guide", "ELBO (exact)", "IWAE", "FIVO, resampled below .25 K", "below .5 K", "always")
    estimates = Table(head, [row(*guide, steps, sequences, particles, fitting) for guide in GUIDES.items()])
    columns = ["guide"] + [f"{side}, L = {number}" for number in TEMPERATURES for side in ("lower", "upper")]
    rows = [annealed(*guide, steps, sides, particles, fitting) for guide in GUIDES.items()]
    write(results, {"bounds/estimates": estimates, "bounds/sides": Table(columns, rows)})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
