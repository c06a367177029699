"""Writes the tables of docs/results/gsps.md: `python docs/gsps.py runs/full full.json no-diversity.json ...`.

The page says how the runs were fitted and scored, each by `dvae evaluate RUN --out NAME.json` on the same windows; the
first run is that of the full method, whose control is measured here. The tables stand between two marks; the text
around them is written by hand.
"""

import sys
from dataclasses import replace
from pathlib import Path

import torch
from family import BEGIN, END, table

import dvae
from dvae.inference.metrics import average_pairwise_distance

PAGE = Path(__file__).parent / "results" / "gsps.md"
METRICS = ("APD", "ADE", "FDE", "MMADE", "MMFDE", "energy score", "pose NLL", "bone-length error")


def scores(evaluation: dvae.Evaluation) -> str:
    """Methods down, metrics across."""
    rows = [[name, *(str(evaluation[name].get(metric, "–")) for metric in METRICS)] for name in evaluation.rows]
    return table(["", *METRICS], rows)


def differences(evaluation: dvae.Evaluation, full: str) -> str:
    """What each other run has more than the full method, paired."""
    others = [name for name, row in evaluation.rows.items() if name != full and row.samples > 1]
    rows = [[name, *(str(evaluation.difference(name, full, metric)) for metric in METRICS[:-1])] for name in others]
    return table([f"minus {full}", *METRICS[:-1]], rows)


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


def _same(evaluation: dvae.Evaluation) -> tuple[object, ...]:
    return evaluation.data, evaluation.samples, evaluation.seed, evaluation.pose_prior


if __name__ == "__main__":
    run, *files = sys.argv[1:]
    found = {Path(file).stem: dvae.Evaluation.load(file) for file in files}
    first = next(iter(found.values()))
    if any(_same(each) != _same(first) for each in found.values()):
        sys.exit("these evaluations differ in windows, samples, seed or pose prior")
    references = {name: row for name, row in first.rows.items() if name != "gsps"}
    rows = references | {name.replace("-", " "): each.rows["gsps"] for name, each in found.items()}
    evaluation = replace(first, rows=rows)
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    after = rest.split(END)[1]
    written = "\n".join([scores(evaluation), differences(evaluation, Path(files[0]).stem), control(run)])
    PAGE.write_text(before + BEGIN + "\n" + written + "\n" + END + after, encoding="utf-8")
