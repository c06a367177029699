"""Writes the tables of docs/results/gsps.md from evaluations.

The page says how the runs were fitted and scored, each by `dvae evaluate RUN --out NAME.json` on the same windows; the
control that the full method has over parts is measured here.
"""

from pathlib import Path

import torch
import tyro

import dvae
from dvae.inference.metrics import average_pairwise_distance

from .pages import DOCS, differences, joined, scores, table, write

METRICS = ("APD", "ADE", "FDE", "MMADE", "MMFDE", "energy score", "pose NLL", "bone-length error")


@torch.no_grad()
def control(path: Path, samples: int) -> str:
    """Diversity of the parts, in free futures and with one draw of the lower body held."""
    run = dvae.load(path)
    past = run.data.windows("test").all()["x"][:, : run.data.protocol.observed]
    found: dict[str, list[torch.Tensor]] = {}
    torch.manual_seed(0)
    for part in past.split(64):
        free = run.model.forecast(part, run.data.protocol.predicted, samples)
        held = run.model.forecast(part, run.data.protocol.predicted, samples, fix={"lower": free["lower"][0]})
        for kind, futures in (("free", free), ("lower held", held)):
            for name in ("lower", "upper"):
                diversity = average_pairwise_distance(futures[name].movedim(0, 1))
                found.setdefault(f"{kind}/{name}", []).append(diversity)
    means = {name: torch.cat(values).mean().item() for name, values in found.items()}
    rows = [
        [kind, *(f"{means[f'{kind}/{name}']:.3f}" for name in ("lower", "upper"))] for kind in ("free", "lower held")
    ]
    return table(["", "APD lower", "APD upper"], rows)


def main(
    run: tyro.conf.Positional[Path],
    files: tyro.conf.Positional[tuple[Path, ...]],
    page: Path = DOCS / "results" / "gsps.md",
    samples: int = 50,
) -> None:
    """Write the tables.

    Args:
        run: the directory of the full method's.
        files: what `dvae evaluate RUN --out` wrote, of that run first.
        page: where.
        samples: futures of a window whose control is measured.
    """
    evaluation, first = joined(files)
    write(page, scores(evaluation, METRICS), differences(evaluation, first, METRICS[:-1]), control(run, samples))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
