"""Write tables that divide the gap between evidence and ELBO into its causes.

They cover guides of a model with known evidence, and runs. Brackets of runs are stored in `KEPT` by the name of the
run and are not computed again.
"""

from pathlib import Path
from typing import Any

import torch
import tyro

import dvae
from dvae.inference.diagnostics.bracket import format_estimate

from .bounds import GUIDES, fitted
from .results import Table, loaded, write

SETTINGS: dict[str, Any] = {"particles": 32, "temperatures": 20, "chains": 4}


def known(name: str, inference: str, steps: int, count: int, fitting: int) -> list[str]:
    """Of the best guide of a factorization, at data from the model: parts of the gap, and how wide the bracket is."""
    model, oracle = fitted(inference, steps, 300)
    x = model.sample(count, steps)["x"]
    found = dvae.bracket(model, x, **SETTINGS, fitting=fitting)
    evidence = oracle.evidence(x)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(found.seed))
    off = torch.as_tensor(found.bounds["real"]["AIS"]) - evidence[order]
    gap, width = found.gap(), found.gap("simulated")["unknown"]
    parts = [format_estimate(gap[part]) for part in ("amortisation", "missing edges", "family")]
    error = f"{off.mean():.3f} ± {off.std() / count**0.5:.3f}"
    return [
        f"`{inference}`, {name}",
        f"{(evidence - oracle.bound(x)).mean():.2f}",
        *parts,
        error,
        format_estimate(width),
    ]


def bracketed(run: Path, kept: Path, count: int, fitting: int, reach: int) -> dvae.Bracket:
    """Of some test windows of a run."""
    path = kept / f"{run.name}.json"
    if not path.is_file():
        trained = loaded(run)
        windows = trained.data.windows("test")
        dvae.bracket(trained.model, windows, **SETTINGS, count=count, fitting=fitting, reach=reach).save(path)
    return dvae.Bracket.load(path)


def row(name: str, found: dvae.Bracket) -> list[str]:
    """Of the table of runs."""
    real, simulated = found.gap("real"), found.gap("simulated")
    above = [
        found.estimate(bound, "ELBO") if bound in found.bounds["real"] else None for bound in ("IWAE", "FIVO", "AIS")
    ]
    parts = [real.get(part) for part in ("amortisation", "missing edges", "family")]
    cells = ["–" if each is None else format_estimate(each) for each in (*above, *parts, simulated["unknown"])]
    return [f"{name}, `{found.equations['inference']}`", *cells]


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
        runs: directories.
        kept: directory of brackets.
        results: folder of the tables, such as benchmarks/results; None prints them.
        count: windows of each run, and sequences of the known model.
        fitting: steps of semi-amortized guides.
        reach: steps between latents of runs that semi-amortized guides read linearly, at most.
        steps: of a sequence of the known model.
    """
    torch.set_num_threads(1)
    kept.mkdir(parents=True, exist_ok=True)
    parts = ["amortisation", "missing edges", "family"]
    rows = [known(name, inference, steps, count, fitting) for name, inference in GUIDES.items()]
    write(results, {"bounds/parts": Table(["", "evidence - ELBO", *parts, "AIS - evidence", "upper - AIS"], rows)})
    rows = [row(run.name, bracketed(run, kept, count, fitting, reach)) for run in runs]
    columns = ["", "IWAE", "FIVO", "AIS", *parts, "upper - AIS, simulated"]
    write(results, {"bounds/runs": Table(columns, rows)})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
