"""Writes the tables of docs/results/family.md from comparisons.

The page says how a comparison is made; several of other models on the same windows are joined.
"""

from functools import reduce
from pathlib import Path

import tyro

import dvae
from dvae.inference.evaluation.estimates import Estimate

from .pages import DOCS, table, write


def with_errors(estimate: Estimate, decimals: int) -> str:
    """Mean ± over sequences ± over seeds."""
    return " ± ".join(f"{v:.{decimals}f}" for v in (estimate.mean, estimate.sequences, estimate.seeds))


def tables(comparison: dvae.Comparison) -> list[str]:
    """Teacher-forced scores in the order of the ranking, then free-running ones in that of the energy score."""
    ranking = comparison.ranking
    forced, free = [], []
    for name in ranking:
        row, scores = comparison.rows[name], comparison[name]
        difference = comparison.difference(name, ranking[0])
        latents = [
            f"{latent} {scores[f'KL {latent}'].mean:.2f}, {row.active_units[latent].mean():.3g}"
            for latent in row.latents
        ]
        forced.append(
            [
                name,
                with_errors(scores["importance bound"], 2),
                "–" if name == ranking[0] else with_errors(difference, 2),
                f"{scores['ELBO'].mean:.2f}",
                f"{100 * row.unreliable:.0f} %",
                "; ".join(latents),
            ]
        )
    for name in sorted(ranking, key=lambda name: comparison[name]["energy score"].mean):
        scores = comparison[name]
        metrics = {"ADE": 3, "FDE": 3, "MMADE": 3, "MMFDE": 3, "APD": 2, "energy score": 2}
        free.append([name, *(with_errors(scores[metric], decimals) for metric, decimals in metrics.items())])
    bound = f"importance bound, K = {comparison.particles}"
    latents = "KL in nats a frame, active units"
    return [
        f"Teacher-forced, nats a frame ({len(comparison.keys)} windows):\n",
        table(["", bound, "difference to the best", "ELBO", "k-hat > 0.7", latents], forced),
        f"Free-running, {comparison.samples} forecasts a window, metres:\n",
        table(["", "ADE ↓", "FDE ↓", "MMADE ↓", "MMFDE ↓", "APD", "energy score ↓"], free),
    ]


def main(files: tyro.conf.Positional[tuple[Path, ...]], page: Path = DOCS / "results" / "family.md") -> None:
    """Write the tables.

    Args:
        files: what `dvae compare --out` wrote.
        page: where.
    """
    write(page, *tables(reduce(dvae.Comparison.join, map(dvae.Comparison.load, files))))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
