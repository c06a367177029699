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
    clip_index,
    prepare_windows,
    seeded_evaluation,
)
from dvae.inference.evaluation.references import References
from dvae.inference.evaluation.scores import clip_means, over_horizon
from dvae.motion.data.dataset import MotionData

from .results import Table, write

STYLES = ("active", "elderly", "exhausted", "feminine", "youthful")
SRNN = Training(steps=1500, batch_size=32, learning_rate=3e-3, decay=0.5, validate_every=500, progress=False)
LEVEL, SAMPLES, EVERY = 0.9, 50, 60
COLUMNS = ("held, each number", "held, each frame", "held, whole future", "splits", "least", "largest")
TUNING = ("active", "elderly", "exhausted")
"""The training styles of the protocol bandai2-tuning."""


@dataclass(frozen=True)
class Scored:
    """Distances of the futures of two unseen styles from a forecaster's.

    Args:
        far: by region, (N, ...).
        places: (N,), the clip of every window.
        styles: of every window.
    """

    far: Mapping[str, torch.Tensor]
    places: torch.Tensor
    styles: np.ndarray

    @classmethod
    def of(cls, windows: motion.Windows, parts: Iterator[tuple[torch.Tensor, torch.Tensor]], spread: Any) -> Scored:
        """From forecasts (B, K, H, D) and true futures."""
        apart = torch.cat(
            [standardised(drawn, true, drawn.std(1) if spread is None else spread) for drawn, true in parts]
        )
        far = {region: largest_by_region(torch.cat(apart), region) for region in REGIONS}
        return cls(far, clip_index(windows.keys), np.array(windows.labels("style")))

    def held(self, region: str, kept: np.ndarray, judged: np.ndarray) -> float:
        """The share of windows of a judged clip that is in prediction bands calibrated on others."""
        ours, theirs = (self.places[windows].unique(return_inverse=True)[1] for windows in (kept, judged))
        factor = quantile(self.far[region][kept], ours, LEVEL)
        inside = (self.far[region][judged] <= factor).double().mean((1, 2))
        return float(np.mean(clip_means(inside, theirs)))


def across(scored: Scored) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Each style calibrates once, and the other one tests."""
    for style in np.unique(scored.styles):
        yield scored.styles == style, scored.styles != style


def within(scored: Scored, times: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Random halves of the clips of both styles."""
    random, clips = np.random.default_rng(0), int(scored.places.max()) + 1
    for _ in range(times):
        half = np.isin(scored.places.numpy(), random.permutation(clips)[: clips // 2])
        yield half, ~half


def row(name: str, found: Sequence[Mapping[str, float]]) -> list[str]:
    """Means over splits with their standard deviation, and the extremes of whole futures."""
    shares = {region: np.array([each[region] for each in found]) for region in REGIONS}
    cells = [f"{each.mean():.1%} ± {each.std(ddof=1):.1%}" for each in shares.values()]
    return [name, *cells, str(len(found)), f"{shares['future'].min():.1%}", f"{shares['future'].max():.1%}"]


def futures(
    held: EvaluationWindows, model: Any, training: motion.Windows
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Forecasts and true futures, batch by batch, of a model or a reference."""
    starts = [slice(start, start + 32) for start in range(0, len(held.keys), 32)]
    if isinstance(model, str):
        count, forecaster = References(held, SAMPLES, training=training)[model]
        yield from ((forecasts_of(model, forecaster, count, held, part), held.futures[part]) for part in starts)
        return
    forecaster = forecaster_of(model, held, SAMPLES, {"draw_emission": True})
    with seeded_evaluation(model, 0):
        for part in starts:
            yield forecasts_of("srnn", forecaster, SAMPLES, held, part), held.futures[part]


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
    found: dict[str, list[dict[str, float]]] = {}
    for styles in sorted(itertools.combinations(STYLES, 3), key=lambda each: each != TUNING)[:models]:
        unseen = tuple(style for style in STYLES if style not in styles)
        protocol = replace(motion.PROTOCOLS["bandai2-tuning"], name="bandai2-styles", split_by="style")
        opened = MotionData.open(str(data), replace(protocol, train=styles, test=unseen))
        out = runs / "-".join(styles)
        if not out.exists():
            dvae.fit(dvae.method("srnn", scheduled_sampling=1.0), opened, out=out, **vars(SRNN))
        apart = replace(opened.protocol, train_stride=EVERY, test_stride=EVERY)
        windows, training = (motion.windows(opened.motion, apart, split) for split in ("test", "train+validation"))
        model = dvae.load(out, data).model
        residual = torch.cat(
            [true - drawn.mean(1) for drawn, true in futures(prepare_windows(training), "zero velocity", training)]
        )
        rows = {
            "SRNN": (model, None),
            "nearest neighbours": ("nearest neighbours", None),
            "zero velocity": ("zero velocity", residual.square().mean(0).sqrt()),
        }
        for name, (forecaster, spread) in rows.items():
            scored = Scored.of(windows, futures(prepare_windows(windows), forecaster, training), spread)
            for how, splits in (("another style", across(scored)), ("other clips", within(scored, halves))):
                shares = [{region: scored.held(region, *split) for region in REGIONS} for split in splits]
                found.setdefault(f"{name}, calibrated on {how}", []).extend(shares)
        if styles == TUNING:
            write(results, first(model, opened, apart))
    splits = [row(name, each) for name, each in sorted(found.items())]
    write(results, {"calibration/splits": Table(["", *COLUMNS], splits)})


def first(model: Any, opened: MotionData, apart: motion.Protocol) -> dict[str, Table]:
    """Return the tables of one split: calibrated on half of the clips of group B, judged on the other half."""
    group = replace(apart, split_by="split", train=(), test=("calibration", "judged"))
    clips = [clip for clip in opened.motion if clip.labels["style"] in apart.test]
    kept = {clip.key for place, clip in enumerate(clips) if place % 2}
    halves = []
    for odd in (True, False):
        own = motion.MotionSet([clip for clip in clips if (clip.key in kept) == odd], opened.motion.skeleton, "half")
        halves.append(motion.windows(own, replace(group, test=tuple(own.splits)), "test"))
    bands = dvae.conformal_bands(model, halves[0], LEVEL, samples=SAMPLES, progress=False)
    judged = bands.coverage(model, halves[1], progress=False)["model"]
    lines = [
        [
            region,
            *(str(judged[f"{what} 90 %, {region}"]) for what in ("raw", "width raw", "calibrated", "width calibrated")),
        ]
        for region in REGIONS
    ]
    covered = Table(["held at once", "said", "width said (m)", "conformal", "width conformal (m)"], lines)
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
