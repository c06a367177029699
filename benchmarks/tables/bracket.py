"""Writes the table of docs/bounds.md of where runs lose what their ELBO lacks of the evidence.

Brackets lie in `KEPT` by the name of their run; those that are there are not computed anew.
"""

from pathlib import Path

import torch
import tyro

import dvae
from dvae.inference.bracket import told
from dvae.inference.estimates import Estimate

from .pages import DOCS, code, table, write


def bracketed(run: Path, kept: Path, count: int, fitting: int, reach: int) -> dvae.Bracket:
    """Of some test windows of a run."""
    path = kept / f"{run.name}.json"
    if not path.is_file():
        loaded = dvae.load(run)
        settings = {"particles": 32, "temperatures": 20, "chains": 4, "fitting": fitting, "reach": reach}
        found = dvae.bracket(loaded.model, loaded.data.windows("test"), count=count, **settings)
        found.save(path)
    return dvae.Bracket.load(path)


def row(name: str, found: dvae.Bracket) -> list[str]:
    """Of a table."""
    real, simulated = found.gap("real"), found.gap("simulated")

    def cell(estimate: Estimate | None) -> str:
        return "–" if estimate is None else told(estimate)

    fivo = found.estimate("FIVO", "ELBO") if "FIVO" in found.bounds["real"] else None
    whole = [found.estimate("AIS", "ELBO"), found.estimate("IWAE", "ELBO"), fivo]
    parts = [real.get(part) for part in ("amortisation", "missing arrows", "family")]
    return [name, code(found.equations["inference"]), *map(cell, (*whole, *parts, simulated["unknown"]))]


def main(
    runs: tyro.conf.Positional[tuple[Path, ...]],
    kept: Path,
    page: Path | None = DOCS / "bounds.md",
    count: int = 16,
    fitting: int = 100,
    reach: int = 8,
) -> None:
    """Write the table.

    Args:
        runs: directories.
        kept: directory of brackets.
        page: where.
        count: windows of each.
        fitting: steps of local guides.
        reach: steps between latents that these read linearly, at most.
    """
    torch.set_num_threads(1)
    kept.mkdir(parents=True, exist_ok=True)
    found = {run.name: bracketed(run, kept, count, fitting, reach) for run in runs}
    columns = ["", "guide", "AIS", "IWAE", "FIVO", "amortisation", "missing arrows", "family", "bracket, simulated"]
    write(page, table(columns, [row(name, each) for name, each in found.items()]), name="bracket")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
