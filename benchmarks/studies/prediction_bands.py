"""Fit SRNNs to some styles of bandai2, and write tables of prediction bands on unseen styles.

A model is fitted to three of the five styles of groups A and B; the other two calibrate and test. The test group C is
not used. Existing runs are not fitted again.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

import dvae
from dvae import Training, motion
from dvae.inference.evaluation.conformal import REGIONS, largest_by_region, quantile, standardised
from dvae.inference.evaluation.evaluate import forecaster_of, forecasts_of
from dvae.inference.evaluation.evaluation_windows import (
    EvaluationWindows,
    cluster_index,
    prepare_windows,
    seeded_evaluation,
)
from dvae.inference.evaluation.references import References
from dvae.inference.evaluation.scores import cluster_means, over_horizon
from dvae.motion.data.dataset import MotionData

from .results import Table, write

STYLES = ("active", "elderly", "exhausted", "feminine", "youthful")
SRNN = Training(steps=1500, batch_size=32, learning_rate=3e-3, decay=0.5, validate_every=500, progress=False)
LEVEL, SAMPLES, EVERY = 0.9, 50, 60
COLUMNS = ("held, each number", "held, each frame", "held, whole future", "splits", "least", "largest")
TUNING = ("active", "elderly", "exhausted")
"""The training styles of the protocol bandai2-tuning."""


@dataclass(frozen=True)
class ForecastDistances:
    """Distances of the true futures of two unseen styles from forecasts.

    Args:
        distances: distances (N, ...) by region.
        places: index (N,) of the clip of each window.
        styles: style of each window.
    """

    distances: Mapping[str, torch.Tensor]
    places: torch.Tensor
    styles: np.ndarray

    @classmethod
    def of(
        cls, windows: motion.Windows, parts: Iterator[tuple[torch.Tensor, torch.Tensor]], spread: Any
    ) -> ForecastDistances:
        """Return the distances of batches of forecasts (B, K, H, D) and true futures."""
        distances = torch.cat(
            [standardised(forecasts, true, forecasts.std(1) if spread is None else spread) for forecasts, true in parts]
        )
        by_region = {region: largest_by_region(torch.cat(distances), region) for region in REGIONS}
        return cls(by_region, cluster_index(windows.keys), np.array(windows.labels("style")))

    def coverage(self, region: str, calibration: np.ndarray, test: np.ndarray) -> float:
        """Return the mean share over test clips of windows inside the bands of the calibration windows."""
        clips, test_clips = (self.places[windows].unique(return_inverse=True)[1] for windows in (calibration, test))
        factor = quantile(self.distances[region][calibration], clips, LEVEL)
        inside = (self.distances[region][test] <= factor).double().mean((1, 2))
        return float(np.mean(cluster_means(inside, test_clips)))


def splits_by_style(distances: ForecastDistances) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield masks of calibration and test windows: each style calibrates once, the other tests."""
    for style in np.unique(distances.styles):
        yield distances.styles == style, distances.styles != style


def splits_by_clip(distances: ForecastDistances, times: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield masks of the windows of random halves of the clips of both styles."""
    random, clips = np.random.default_rng(0), int(distances.places.max()) + 1
    for _ in range(times):
        half = np.isin(distances.places.numpy(), random.permutation(clips)[: clips // 2])
        yield half, ~half


def row(name: str, shares_by_split: Sequence[Mapping[str, float]]) -> list[str]:
    """Return a row of means and deviations over splits, with minimum and maximum for whole futures."""
    shares = {region: np.array([each[region] for each in shares_by_split]) for region in REGIONS}
    cells = [f"{each.mean():.1%} ± {each.std(ddof=1):.1%}" for each in shares.values()]
    return [name, *cells, str(len(shares_by_split)), f"{shares['future'].min():.1%}", f"{shares['future'].max():.1%}"]


def futures(
    windows: EvaluationWindows, model: Any, training: motion.Windows
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Yield batches of forecasts and true futures of a model or a reference."""
    starts = [slice(start, start + 32) for start in range(0, len(windows.keys), 32)]
    if isinstance(model, str):
        count, forecaster = References(windows, SAMPLES, training=training)[model]
        yield from ((forecasts_of(model, forecaster, count, windows, part), windows.futures[part]) for part in starts)
        return
    forecaster = forecaster_of(model, windows, SAMPLES, {"draw_emission": True})
    with seeded_evaluation(model, 0):
        for part in starts:
            yield forecasts_of("srnn", forecaster, SAMPLES, windows, part), windows.futures[part]


def main(runs: Path, data: Path, results: Path | None = None, models: int = 10, halves: int = 20) -> None:
    """Write the tables.

    Args:
        runs: folder of the runs.
        data: bandai2.npz.
        results: folder of the tables, such as benchmarks/results; None prints them.
        models: number of choices of training styles, at most ten; bandai2-tuning's comes first.
        halves: number of random halves of the clips for each choice.
    """
    torch.set_num_threads(1)
    shares_by_row: dict[str, list[dict[str, float]]] = {}
    for styles in sorted(itertools.combinations(STYLES, 3), key=lambda each: each != TUNING)[:models]:
        unseen = tuple(style for style in STYLES if style not in styles)
        protocol = replace(motion.PROTOCOLS["bandai2-tuning"], name="bandai2-styles", split_by="style")
        dataset = MotionData.open(str(data), replace(protocol, train=styles, test=unseen))
        out = runs / "-".join(styles)
        if not out.exists():
            dvae.fit(dvae.method("srnn", scheduled_sampling=1.0), dataset, out=out, **vars(SRNN))
        thinned = replace(dataset.protocol, train_stride=EVERY, test_stride=EVERY)
        windows, training = (motion.windows(dataset.motion, thinned, split) for split in ("test", "train+validation"))
        model = dvae.load(out, data).model
        residual = torch.cat(
            [
                true - forecasts.mean(1)
                for forecasts, true in futures(prepare_windows(training), "zero velocity", training)
            ]
        )
        rows = {
            "SRNN": (model, None),
            "nearest neighbours": ("nearest neighbours", None),
            "zero velocity": ("zero velocity", residual.square().mean(0).sqrt()),
        }
        for name, (forecaster, spread) in rows.items():
            distances = ForecastDistances.of(windows, futures(prepare_windows(windows), forecaster, training), spread)
            for calibration, splits in (
                ("another style", splits_by_style(distances)),
                ("other clips", splits_by_clip(distances, halves)),
            ):
                shares = [{region: distances.coverage(region, *split) for region in REGIONS} for split in splits]
                shares_by_row.setdefault(f"{name}, calibrated on {calibration}", []).extend(shares)
        if styles == TUNING:
            write(results, tables_of_split(model, dataset, thinned))
    splits = [row(name, each) for name, each in sorted(shares_by_row.items())]
    write(results, {"calibration/splits": Table(["", *COLUMNS], splits)})


def tables_of_split(model: Any, dataset: MotionData, thinned: motion.Protocol) -> dict[str, Table]:
    """Return the tables of one split: half of the clips of group B calibrate, the other half tests."""
    group = replace(thinned, split_by="split", train=(), test=("calibration", "judged"))
    clips = [clip for clip in dataset.motion if clip.labels["style"] in thinned.test]
    odd_clips = {clip.key for place, clip in enumerate(clips) if place % 2}
    halves = []
    for odd in (True, False):
        own = motion.MotionSet(
            [clip for clip in clips if (clip.key in odd_clips) == odd], dataset.motion.skeleton, "half"
        )
        halves.append(motion.windows(own, replace(group, test=tuple(own.splits)), "test"))
    bands = dvae.conformal_bands(model, halves[0], LEVEL, samples=SAMPLES, progress=False)
    coverages = bands.coverage(model, halves[1], progress=False)["model"]
    lines = [
        [
            region,
            *(
                str(coverages[f"{column} 90 %, {region}"])
                for column in ("raw", "width raw", "calibrated", "width calibrated")
            ),
        ]
        for region in REGIONS
    ]
    covered = Table(["region", "raw", "width raw (m)", "calibrated", "width calibrated (m)"], lines)
    scores = dvae.evaluate(
        model, halves[1], scores=over_horizon, samples=SAMPLES, draw_emission=True, references=False, progress=False
    )["model"]
    frames = [int(name.split()[-1]) for name in scores if name.startswith("coverage 90 %, frame")]
    lines = [
        [f"{level} %", *(str(scores[f"coverage {level} %, frame {frame}"]) for frame in frames)]
        for level in (50, 80, 90)
    ]
    horizon = Table(["coverage at frame", *map(str, frames)], lines)
    return {"calibration/bands": covered, "calibration/horizon": horizon}


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
