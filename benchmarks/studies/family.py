"""Write tables of comparisons; comparisons of other models on the same windows are joined."""

from collections.abc import Callable
from functools import reduce
from pathlib import Path

import tyro

import dvae

from .engine import format_mean
from .results import Table, ordered, tabled, write

DIGITS = {"ADE": 3, "FDE": 3, "MMADE": 3, "MMFDE": 3, "APD": 2, "energy score": 2}
ARROWS = {"ADE": " ↓", "FDE": " ↓", "MMADE": " ↓", "MMFDE": " ↓", "energy score": " ↓"}


def tables(comparison: dvae.Comparison, suffix: str = "") -> dict[str, Table]:
    """Return the teacher-forced scores in the order of the ranking, then free-running ones by energy score, if any."""
    best, *_ = ranking = comparison.ranking

    def latents(name: str) -> str:
        units, scores = comparison.rows[name].active_units, comparison[name]
        return "; ".join(
            f"{z} {scores[f'KL {z}'].mean:.2f}, {units[z].mean():.3g}" for z in comparison.rows[name].latents
        )

    forced: dict[str, Callable[[str], str]] = {
        "IWAE bound": lambda name: format_mean(comparison[name]["IWAE bound"], 2),
        "difference to the best": lambda name: format_mean(
            None if name == best else comparison.difference(name, best), 2
        ),
        "ELBO": lambda name: f"{comparison[name]['ELBO'].mean:.2f}",
        "k-hat > 0.7": lambda name: (
            f"{100 * comparison.rows[name].unreliable:.0f} %" if comparison.particles > 1 else "–"
        ),
        "KL in nats a frame, active units": latents,
    }
    free = {
        score + ARROWS.get(score, ""): lambda name, score=score, digits=digits: format_mean(
            comparison[name][score], digits
        )
        for score, digits in DIGITS.items()
    }
    windows = f"Teacher-forced, nats a frame ({len(comparison.keys)} windows); K = {comparison.particles}."
    result = {f"family/teacher-forced{suffix}": tabled({name: name for name in ranking}, forced, note=windows)}
    if all("energy score" in comparison[name] for name in ranking):
        order = ordered({name: name for name in ranking}, lambda name: comparison[name]["energy score"].mean)
        draws = f"Free-running, {comparison.samples} forecasts a window, metres."
        result[f"family/free-running{suffix}"] = tabled(order, free, note=draws)
    return result


def main(files: tyro.conf.Positional[tuple[Path, ...]], results: Path | None = None, suffix: str = "") -> None:
    """Write the tables.

    Args:
        files: files written by `dvae compare --out`.
        results: folder of the tables, such as benchmarks/results; None prints them.
        suffix: end of the names of the tables.
    """
    write(results, tables(reduce(dvae.Comparison.join, map(dvae.Comparison.load, files)), suffix))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
