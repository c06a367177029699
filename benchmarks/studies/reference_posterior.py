"""Write tables on reference posteriors: guides of a surrogate, power, a neural model."""

from collections.abc import Callable
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import torch
import tyro

import dvae

from . import bounds
from .results import Table, write

LENGTH = 6
"""Length of the training sequences of neural models."""
GUIDES = {name: bounds.GUIDES[name] for name in ("exact", "mean-field", "filtering")}


def root_mean_square(values: np.ndarray) -> float:
    """Return the root mean square of all values except NaN."""
    return float(np.sqrt(np.nanmean(values**2)))


def diagnostic_cells(model: dvae.DynamicalVAE, x: torch.Tensor, **nuts: int) -> list[str]:
    """Return the cells of both diagnostics of a guide."""
    posterior = dvae.reference_posterior(model, x, progress=False, **nuts)
    tested = dvae.stein_discrepancy(model, x, progress=False)
    steps = posterior.pairs["z, between steps"]
    least, most = np.nanmin(posterior.ratio), np.nanmax(posterior.ratio)
    reference, guide = (root_mean_square(part.correlation[:, steps]) for part in (posterior.reference, posterior.guide))
    fared = posterior.sampling
    return [
        *([] if fared is None else [f"{np.nanmax(fared.rhat):.3f}, {np.nanmin(fared.effective):.0f}"]),
        f"{root_mean_square(posterior.bias):.2f} ± {root_mean_square(posterior.bias_error):.2f}",
        f"{np.exp(np.log(posterior.ratio).mean()):.2f} ({least:.2f} to {most:.2f})",
        f"{reference:.2f}",
        f"{guide:.2f}",
        f"{(tested.p_values <= 0.05).sum()} of {len(tested.sequences)}",
        f"{tested.p_value:.2g}",
    ]


COLUMNS = ["bias (rms)", "deviation ratio", "correlations", "the guide’s", "detected by KSD at 5 %", "p, together"]


def normal(oracle: dvae.Oracle, wrong: str) -> Callable[..., None]:
    """Return the posterior as a guide: exact, uncorrelated, or with z_T given the rest too narrow by a third."""

    def guide(batch: Any) -> None:
        mean, covariance = oracle.posterior(batch)
        root = torch.linalg.cholesky(covariance)
        if wrong == "correlations":
            root = torch.linalg.inv(covariance).diagonal().rsqrt().diag()
        if wrong == "a deviation":
            root[-1, -1] *= 2 / 3
        z = mean + torch.randn(mean.shape).to(mean) @ root.T
        with pyro.plate("sequences", len(z)):
            pyro.sample("z", dist.Delta(z[..., None], event_dim=2))

    return guide


def power(steps: int, sequences: int) -> list[str]:
    """Return the share of sequences with a detected error of the guide, by kind of error."""
    model = dvae.linear_gaussian_surrogate(
        bounds.MODEL, GUIDES["exact"], {"z": 1, "x": 1}, steps, scale=0.9
    ).requires_grad_(False)
    torch.manual_seed(0)
    x, cells = model.sample(sequences, steps)["x"], [str(steps)]
    for wrong, draws in (("", 500), ("correlations", 100), ("correlations", 500), ("a deviation", 500)):
        guide = normal(dvae.Oracle(model, steps), wrong)
        test = dvae.stein_discrepancy(model, x, guide=guide, draws=draws, bootstrap=200, progress=False)
        cells.append(f"{(test.p_values <= 0.05).mean():.0%}")
    return [*cells, f"{test.p_value:.2g}"]


def neural(inference: str, x: torch.Tensor, fitting: int) -> dvae.DynamicalVAE:
    """Fit a small model to sequences."""
    torch.manual_seed(0)
    model = dvae.DynamicalVAE(bounds.MODEL, inference, {"z": 2, "x": 4}, dvae.networks.Recurrent(16))
    dvae.fit(model, dvae.ArrayWindows(x, observed=LENGTH - 1), steps=fitting, progress=False)
    return model


def main(
    results: Path | None = None,
    steps: int = 8,
    sequences: int = 10,
    powers: int = 40,
    fitting: int = 1000,
    draws: int = 400,
) -> None:
    """Write the tables.

    Args:
        results: folder of the tables, such as benchmarks/results; None prints them.
        steps: length of the sequences of the surrogate.
        sequences: number of sequences in the first table.
        powers: number of sequences in the table of power.
        fitting: number of training steps of the neural models.
        draws: number of draws and of warm-up steps of each NUTS chain.
    """
    rows = []
    for name, text in GUIDES.items():
        model, _ = bounds.fit_best_guide(text, steps, 300, scale=0.9)
        rows.append([f"`{text}`, {name}", *diagnostic_cells(model, model.sample(sequences, steps)["x"])])
    write(results, {"criticism/reference": Table(["best guide", *COLUMNS], rows)})
    guides = ["the posterior, 500 draws", "mean-field, 100 draws", "500 draws", "z_T too narrow, 500 draws"]
    head = ["T", *guides, f"{powers} of these together (p)"]
    write(results, {"criticism/power": Table(head, [power(each, powers) for each in (4, 16, 64, 256)])})
    torch.manual_seed(1)
    phase, speed = 6.3 * torch.rand(400, 1), 0.3 + 0.4 * torch.rand(400, 1)
    angle = phase + speed * torch.arange(LENGTH)
    x = torch.stack([angle.sin(), angle.cos(), angle.sin() * angle.cos(), angle.cos().abs()], -1)
    x = x + 0.3 * torch.randn_like(x)
    rows = []
    for name in ("exact", "mean-field"):
        model = neural(GUIDES[name], x[:320], fitting)
        start = process_time()
        cells = diagnostic_cells(model, x[320:322], draws=draws, warmup=draws)
        elapsed = process_time() - start
        bound = dvae.SequenceELBO(num_particles=20).terms(model, x[320:]).bound
        bound_text = f"{bound.mean():.2f} ± {bound.std() / len(bound) ** 0.5:.2f}"
        rows.append([f"`{GUIDES[name]}`, {name}", bound_text, *cells, f"{elapsed:.0f} s"])
    write(results, {"criticism/fitted": Table(["fitted guide", "bound", "R-hat, draws", *COLUMNS, "CPU"], rows)})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
