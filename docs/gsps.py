"""Writes the tables of docs/results/gsps.md: `python docs/gsps.py runs/full full.json no-diversity.json ...`.

The page says how the runs were fitted and scored, each by `dvae evaluate RUN --out NAME.json` on the same windows; the
first run is that of the full method, whose control is measured here. The tables stand between two marks; the text
around them is written by hand.
"""

import sys
from pathlib import Path

import torch
from evaluations import differences, joined, scores, write
from family import table

import dvae
from dvae.inference.metrics import average_pairwise_distance

PAGE = Path(__file__).parent / "results" / "gsps.md"
METRICS = ("APD", "ADE", "FDE", "MMADE", "MMFDE", "energy score", "pose NLL", "bone-length error")


@torch.no_grad()
def control(path: str, samples: int = 50) -> str:
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


if __name__ == "__main__":
    run, *files = sys.argv[1:]
    evaluation = joined(files)
    first = next(name for name, row in evaluation.rows.items() if row.config)
    write(PAGE, scores(evaluation, METRICS), differences(evaluation, first, METRICS[:-1]), control(run))
