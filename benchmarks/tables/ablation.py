"""Writes the tables and the picture of docs/ablation.md: what arrows are worth, on twins and on simulated people."""

from pathlib import Path

import torch
import tyro

import dvae
from dvae.inference.estimates import number

from .audits import FAMILY, spread
from .pages import DOCS, code, write

NAMES = ("DKF", "SRNN", "DSAE")
TRAINING = {"batch_size": 16, "validate_every": 100}


def twins(names: tuple[str, ...], steps: int, seeds: int) -> str:
    """What each arrow of some models is worth."""
    lines = ["| | model | arrow | price of leaving it out |", "|---|---|---|---|"]
    for name in names:
        model = FAMILY[name][0]
        for arrow, price in dvae.model_arrow_prices(model, steps=steps, seeds=seeds).items():
            lines.append(f"| {name} | {code(model)} | {code(arrow)} | {spread(price)} |")
    return "\n".join(lines) + "\n"


def fitted(found: dvae.Ablation) -> str:
    """Both prices of each arrow."""
    lines = [
        "| arrow | of | on twins, nats a sequence | fitted, nats a frame | 95 % | p |",
        "|---|---|---|---|---|---|",
    ]
    for arrow in found.arrows:
        costs, estimate = torch.tensor(found.prices[arrow.run]), found.differences[arrow.run]
        low, high = map(number, estimate.interval())
        p = number(found.p_values[arrow.run])
        lines.append(f"| {code(arrow.name)} | {arrow.of} | {spread(costs)} | {estimate} | {low} to {high} | {p} |")
    return "\n".join(lines) + "\n"


def main(
    runs: Path,
    page: Path = DOCS / "ablation.md",
    picture: Path = DOCS / "img" / "ablation.png",
    steps: int = 5,
    seeds: int = 5,
    fitting: int = 600,
    jobs: int = 2,
) -> None:
    """Write the tables and the picture.

    Args:
        runs: directory of the fits, which are continued where they stopped.
        page: where the tables go.
        picture: where the drawing goes.
        steps: of the sequences on twins.
        seeds: twins of random weights.
        fitting: steps of a fit.
        jobs: fits at a time.
    """
    write(page, twins(NAMES, steps, seeds), name="twins")
    method = dvae.method("srnn", latent=4, width=32, warm_up=100)
    training = {**TRAINING, "steps": fitting}
    found = dvae.ablate(
        method, dvae.motion.MotionData.open(), runs, (0, 1, 2), training, jobs, steps=steps, twins=seeds
    )
    found.save(runs / "ablation.json")
    write(page, fitted(found), name="fitted")
    found.plot().savefig(picture, dpi=100)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
