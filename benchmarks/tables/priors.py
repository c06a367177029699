"""Writes the table of TrajeVAE's priors of docs/results/trajevae.md: how they fit the posteriors, and other scales.

A prior covers the posteriors where z, drawn from that of a window, is as far from the prior's mean as a draw of the
prior is: one, in units of the prior's deviation, root mean square. Below it the prior is too wide, above it too narrow.
What that does is told by the same decoder with other priors: the model's own with its deviations multiplied, and a
normal law of the mean and the variance, for each number of z, of the posteriors of all training windows.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
import tyro
from torch import Tensor
from torch.nn import functional

import dvae
from dvae import motion
from dvae.models.trajectories import FIRST, GIVEN
from dvae.program.batch import CHUNK, rows

from .pages import DOCS, loaded, table, write
from .ranking import JOINTS
from .tuning import SAMPLES, seen

SCALES = (0.5, 1.0, 2.0)
"""Of the prior's deviations."""
SCORES = ("APD", "energy score")
Law = tuple[Tensor, Tensor]


@torch.no_grad()
def laws(model: Any, windows: Any) -> tuple[Law, Law]:
    """Means and deviations of z, (N, T, D), by the guide and by the prior; of the coefficients that are read."""
    found: list[list[Tensor]] = []
    batch = windows.all()
    for start in range(0, len(batch["x"]), CHUNK):
        data = model.read(rows(batch, slice(start, start + CHUNK)))
        size, length = len(data[FIRST]), data[GIVEN].shape[1]
        each = [*model.encoder["z"](data, size, length), *model.generator["z"](data, size, length)]
        found.append([values[:, : model.method.components or None] for values in each])
    mean, deviation, prior_mean, prior_deviation = (torch.cat(values) for values in zip(*found, strict=True))
    return (mean, deviation), (prior_mean, prior_deviation)


def rms(values: Tensor) -> float:
    """Over all."""
    return float(values.square().mean().sqrt())


def fitted(posterior: Law) -> Callable[..., Law]:
    """A prior that is the same for all windows: what the posteriors of some are together, each number by itself."""
    mean, deviation = posterior
    center, spread = mean.mean(0), (mean.var(0, correction=0) + deviation.square().mean(0)).sqrt()

    def prior(parents: Mapping[str, Tensor], batch: int, length: int, *unread: Any) -> Law:
        later = (0, 0, 0, length - len(center))  # coefficients that nothing reads are N(0, 1)
        loc, scale = functional.pad(center, later), functional.pad(spread, later, value=1.0)
        return loc.expand(batch, -1, -1), scale.expand(batch, -1, -1)

    return prior


def scored(model: Any, windows: Any, scale: float) -> list[float]:
    """Of draws of the prior with its deviations multiplied."""

    def scores(windows: Any) -> Any:
        return [each for each in motion.scores(windows) if each.name in SCORES]

    told = {"references": False, "progress": False, "options": {"temperature": scale}}
    found = dvae.evaluate(model, windows, scores=scores, samples=SAMPLES, **told)["model"]
    return [found[name].mean for name in SCORES]


def lines(path: Path, counts: tuple[int, ...]) -> Iterator[list[str]]:
    """Of a run, by how many paths are given."""
    run = loaded(path)
    if run.method.name != "trajevae":
        sys.exit(f"{path} is a run of {run.method.name}; give one of trajevae")
    model, judged, trained = run.model.eval(), seen(run.data), run.data.windows("train")
    for count in counts:
        windows = judged.given(JOINTS[:count])
        (mean, deviation), (prior_mean, prior_deviation) = laws(model, windows)
        off = torch.hypot(mean - prior_mean, deviation) / prior_deviation
        widths = [rms(mean - mean.mean(0)), rms(deviation), rms(prior_mean - prior_mean.mean(0)), rms(prior_deviation)]
        cells = [scored(model, windows, scale) for scale in SCALES]
        posterior, _ = laws(model, trained.given(JOINTS[:count]))
        with patch.object(model.generator["z"], "forward", fitted(posterior)):
            cells.append(scored(model, windows, 1.0))
        told = [f"{value:.2f}" for value in (*widths, rms(off))]
        yield [path.name, str(count), *told, *(f"{each:.2f}" for values in zip(*cells, strict=True) for each in values)]


def main(
    runs: tyro.conf.Positional[tuple[Path, ...]],
    page: Path | None = DOCS / "results" / "trajevae.md",
    counts: tuple[int, ...] = (0, 4),
) -> None:
    """Write the table.

    Args:
        runs: run directories of `benchmarks.tables.tuning`.
        page: where; with None it is printed.
        counts: of joints whose paths are given.
    """
    widths = ["posterior means", "posterior", "prior means", "prior", "z in units of the prior"]
    ways = [*(f"prior × {scale:g}" for scale in SCALES), "fitted"]
    header = ["", "given", *widths, *(f"{score}, {way}" for score in SCORES for way in ways)]
    write(page, table(header, [line for run in runs for line in lines(run, counts)]), name="priors")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
