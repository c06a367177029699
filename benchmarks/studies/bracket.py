"""Write tables that divide the gap between evidence and ELBO into its causes.

One table covers guides of a model with known evidence, the other covers runs. `--kept` is the folder of the brackets of
runs, which are computed only once.
"""

from pathlib import Path
from typing import Any

import torch
import tyro

import dvae
from dvae.inference.diagnostics.bracket import format_estimate

from .bounds import GUIDES, fit_best_guide
from .results import Table, loaded, write

SETTINGS: dict[str, Any] = {"particles": 32, "temperatures": 20, "chains": 4}


def known_row(name: str, inference: str, steps: int, count: int, fitting: int) -> list[str]:
    """Return the parts of the gap and the width of the bracket, for the best guide and data from the model."""
    model, oracle = fit_best_guide(inference, steps, 300)
    x = model.sample(count, steps)["x"]
    bracket = dvae.bracket(model, x, **SETTINGS, fitting=fitting)
    evidence = oracle.evidence(x)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(bracket.seed))
    off = torch.as_tensor(bracket.bounds["real"]["AIS"]) - evidence[order]
    gap, width = bracket.gap(), bracket.gap("simulated")["unknown"]
    parts = [format_estimate(gap[part]) for part in ("amortisation", "missing edges", "family")]
    error = f"{off.mean():.3f} ± {off.std() / count**0.5:.3f}"
    return [
        f"`{inference}`, {name}",
        f"{(evidence - oracle.bound(x)).mean():.2f}",
        *parts,
        error,
        format_estimate(width),
    ]


def load_or_compute(run: Path, folder: Path, count: int, fitting: int, reach: int) -> dvae.Bracket:
    """Compute the bracket of some test windows of a run, or load the stored one."""
    path = folder / f"{run.name}.json"
    if not path.is_file():
        trained = loaded(run)
        windows = trained.data.windows("test")
        dvae.bracket(trained.model, windows, **SETTINGS, count=count, fitting=fitting, reach=reach).save(path)
    return dvae.Bracket.load(path)


def row(name: str, bracket: dvae.Bracket) -> list[str]:
    """Return the row of a run."""
    real, simulated = bracket.gap("real"), bracket.gap("simulated")
    above = [
        bracket.estimate(bound, "ELBO") if bound in bracket.bounds["real"] else None
        for bound in ("IWAE", "FIVO", "AIS")
    ]
    parts = [real.get(part) for part in ("amortisation", "missing edges", "family")]
    cells = ["–" if each is None else format_estimate(each) for each in (*above, *parts, simulated["unknown"])]
    return [f"{name}, `{bracket.equations['inference']}`", *cells]


def main(
    runs: tyro.conf.Positional[tuple[Path, ...]],
    kept: Path,
    results: Path | None = None,
    count: int = 16,
    fitting: int = 150,
    reach: int = 8,
    steps: int = 100,
) -> None:
    """Write the tables.

    Args:
        runs: run directories.
        kept: folder of the brackets.
        results: folder of the tables, such as benchmarks/results; None prints them.
        count: number of windows of each run, and of sequences of the known model.
        fitting: number of training steps of semi-amortized guides.
        reach: largest number of steps between latents in the linear terms of semi-amortized guides.
        steps: length of the sequences of the known model.
    """
    torch.set_num_threads(1)
    kept.mkdir(parents=True, exist_ok=True)
    parts = ["amortisation", "missing edges", "family"]
    rows = [known_row(name, inference, steps, count, fitting) for name, inference in GUIDES.items()]
    write(results, {"bounds/parts": Table(["", "evidence - ELBO", *parts, "AIS - evidence", "upper - AIS"], rows)})
    rows = [row(run.name, load_or_compute(run, kept, count, fitting, reach)) for run in runs]
    columns = ["", "IWAE", "FIVO", "AIS", *parts, "upper - AIS, simulated"]
    write(results, {"bounds/runs": Table(columns, rows)})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
