"""Write a table of TrajeVAE's priors with their fit to the posteriors.

The table gives the root-mean-square distance of posterior draws of z from the prior's mean, in units of the prior's
deviation. A value of 1 means that the prior is as wide as the posteriors. Below 1 the prior is too wide, above 1 too
narrow. The effect is measured with the same decoder and other distributions of z: the prior with scaled deviations, or
with the mean, the deviation, or both, of the posteriors of all training windows together, number by number.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
import tyro
from torch import Tensor

from dvae import motion
from dvae.models.motion.trajectories import FIRST, GIVEN
from dvae.program.batch import CHUNK, rows

from .ranking import JOINTS
from .results import Table, loaded, write
from .tuning import mean_scores, selection_windows

SCORES = ("APD", "energy score")
DISTRIBUTIONS: dict[str, tuple[float, tuple[str, ...]]] = {
    "prior": (1.0, ()),
    "prior × 2": (2.0, ()),
    "common mean": (1.0, ("mean",)),
    "common deviation": (1.0, ("deviation",)),
    "common both": (1.0, ("mean", "deviation")),
}
"""By column: factor of the prior's deviations, and moments that come from all posteriors together."""
BETWEEN = (0.05, 0.95)
"""Quantiles over the numbers of z."""
Distribution = tuple[Tensor, Tensor]


@torch.no_grad()
def distribution(model: Any, factor: Any, windows: Any) -> Distribution:
    """Return means and deviations (N, T, D) of z under the guide or the prior, for the coefficients in use."""
    moments: list[Distribution] = []
    batch = windows.all()
    for start in range(0, len(batch["x"]), CHUNK):
        data = model.read(rows(batch, slice(start, start + CHUNK)))
        mean, deviation = factor(data, len(data[FIRST]), data[GIVEN].shape[1])
        steps = slice(model.method.components or None)
        moments.append((mean[:, steps], deviation[:, steps]))
    means, deviations = map(torch.cat, zip(*moments, strict=True))
    return means, deviations


def rms(values: Tensor) -> float:
    """Return the root mean square of all values."""
    return float(values.square().mean().sqrt())


def pooled(posterior: Distribution) -> Distribution:
    """Return the mean and deviation (T, D) of the mixture of the posteriors of all windows."""
    mean, deviation = posterior
    return mean.mean(0), (mean.var(0, correction=0) + deviation.square().mean(0)).sqrt()


def with_common(
    prior: Callable[..., Distribution], common: Distribution, parts: tuple[str, ...]
) -> Callable[..., Distribution]:
    """Return a prior with the mean, the deviation or both, as named in `what`, replaced by `common`."""
    mean, deviation = common

    def changed(*arguments: Any, **options: Any) -> Distribution:
        loc, scale = (values.clone() for values in prior(*arguments, **options))
        if "mean" in parts:
            loc[:, : len(mean)] = mean
        if "deviation" in parts:
            scale[:, : len(mean)] = deviation
        return loc, scale

    return changed


def table_scores(windows: Any) -> Any:
    """Return the scores of the table."""
    return [each for each in motion.scores(windows) if each.name in SCORES]


def rows_of_run(path: Path, counts: tuple[int, ...]) -> Iterator[list[str]]:
    """Yield the rows of a run, one for each number of given paths."""
    run = loaded(path)
    if run.method.name != "trajevae":
        sys.exit(f"{path} is a run of {run.method.name}; give one of trajevae")
    model, test, train = run.model.eval(), selection_windows(run.data), run.data.windows("train")
    guide, prior = model.encoder["z"], model.generator["z"]
    for count in counts:
        windows = test.given(JOINTS[:count])
        (mean, deviation), (prior_mean, prior_deviation) = (
            distribution(model, each, windows) for each in (guide, prior)
        )
        off = torch.hypot(mean - prior_mean, deviation) / prior_deviation
        low, high = off.square().mean(0).sqrt().quantile(torch.tensor(BETWEEN)).tolist()
        widths = [rms(mean - mean.mean(0)), rms(deviation), rms(prior_mean - prior_mean.mean(0)), rms(prior_deviation)]
        common = pooled(distribution(model, guide, train.given(JOINTS[:count])))
        cells = []
        for scale, parts in DISTRIBUTIONS.values():
            with patch.object(prior, "forward", with_common(prior.forward, common, parts)):
                means = mean_scores(model, windows, table_scores, options={"temperature": scale})
            cells.append([f"{means[name]:.2f}" for name in SCORES])
        spreads = [*(f"{value:.2f}" for value in widths), f"{rms(off):.2f} ({low:.2f}, {high:.2f})"]
        yield [path.name, str(count), *spreads, *(each for values in zip(*cells, strict=True) for each in values)]


def main(
    runs: tyro.conf.Positional[tuple[Path, ...]],
    results: Path | None = None,
    counts: tuple[int, ...] = (0, 4),
) -> None:
    """Write the table.

    Args:
        runs: run directories of `benchmarks.studies.tuning`.
        results: folder of the tables, such as benchmarks/results; None prints them.
        counts: numbers of joints with given paths.
    """
    widths = ["posterior means", "posterior", "prior means", "prior", "z in units of the prior"]
    header = ["", "given", *widths, *(f"{score}, {name}" for score in SCORES for name in DISTRIBUTIONS)]
    write(results, {"trajevae/priors": Table(header, [line for run in runs for line in rows_of_run(run, counts)])})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
