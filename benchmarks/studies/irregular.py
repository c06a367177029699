"""Fit a linear SDE to utterances, whole and with half of their frames dropped.

Each run has a directory under `--runs`, with a file of scores for each scored part. An interrupted script continues and
skips existing files. Options are chosen with `--part validation`, seed 0; `--part test` scores the runs of three seeds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro

import dvae
from dvae import distributions
from dvae.data.sequences import time_since_previous
from dvae.data.units import Coordinate
from dvae.inference.training.checkpoints import Run
from dvae.networks import Dense, LinearSDE, LinearSDEGuide, Recurrent
from dvae.networks.base import share_modules
from dvae.tables.domains import domain

from .engine import OURS, cell, measure, read
from .results import Table, write

PARTICLES = 100
KEPT = {"whole": 1.0, "halves": 0.5}
"""Share of the frames that remain in a sequence."""
TEST_SEED = 2026
"""Seed of the halves for scores, the same for all runs."""
STEPS = {8: 1000, 16: 1500}
"""Training steps by size of the latent."""
SIZE: dict[str, Any] = {"width": 64, "decoder": (64,)}
TIMES = (1.0, 30.0)
"""Range of the time constants of the prior, in frames."""
TRAINING: dict[str, Any] = {"batch_size": 64, "learning_rate": 3e-3, "decay": 0.2, "validate_every": 50}

Utterances = Sequence[np.ndarray]


def utterances(part: str) -> list[np.ndarray]:
    """Return the frames (T, D) of each utterance of a split."""
    return [one.values for one in domain("japanese-vowels").series if one.split == part]


def batch_of(sequences: Utterances, share: float, seed: int) -> dict[str, torch.Tensor]:
    """Return a batch with a share of the frames of each sequence, at least two, and the times between them."""
    random = np.random.default_rng(seed)
    frame_indices = [np.sort(random.permutation(len(x))[: max(round(share * len(x)), 2)]) for x in sequences]
    lengths = torch.tensor([len(places) for places in frame_indices])
    x = torch.zeros(len(frame_indices), int(lengths.max()), sequences[0].shape[1])
    times = torch.zeros(x.shape[:2])
    for row, (one, places) in enumerate(zip(sequences, frame_indices, strict=True)):
        x[row, : len(places)] = torch.from_numpy(one[places])
        times[row, : len(places)] = torch.from_numpy(places)
    return {"x": x, "d": time_since_previous(times, lengths), "lengths": lengths}


def frames(batch: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Return the valid frames of a batch, (N, D)."""
    return batch["x"][torch.arange(batch["x"].shape[1]) < batch["lengths"][:, None]]


def built(train: Mapping[str, torch.Tensor], latent: int) -> dvae.DynamicalVAE:
    """Build the linear SDE with its guide, in units of the training frames."""
    width, decoder = SIZE["width"], SIZE["decoder"]
    model = dvae.DynamicalVAE(
        "p(z_t | z_{t-1}, d_t) p(x_t | z_t)",
        "q(z_t | z_{t-1}, x_{1:T}, d_{1:T})",
        {"z": latent, "x": train["x"].shape[-1], "d": 1},
        {
            "p(z)": LinearSDE(TIMES),
            "p(x)": Dense(decoder),
            "q(z)": LinearSDEGuide(Recurrent(width, hidden=(width,)), TIMES),
        },
        {
            "p(z)": distributions.Triangular(),
            "p(x)": distributions.FixedNormal(0.5, learned=True),
            "q(z)": distributions.Triangular(),
        },
    )
    share_modules([model.generator["z"].network, model.encoder["z"].network], "equation")
    train_frames = frames(train)
    means, scales = train_frames.mean(0).tolist(), train_frames.std(0).tolist()
    model.standardise("x", [Coordinate(mean, scale, mean) for mean, scale in zip(means, scales, strict=True)])
    return model


def run(latent: int, part: str, fitted_on: str, seed: int, out: Path) -> dict[str, Any]:
    """Fit and score a model."""
    train, validation = (batch_of(utterances(each), KEPT[fitted_on], seed) for each in ("train", "validation"))
    torch.manual_seed(seed)
    model, options = built(train, latent), {"steps": STEPS[latent], "seed": seed, "resume": Run(out).exists, **TRAINING}
    fit = dvae.fit(model, train, validation, out=out, progress=False, **options)
    torch.manual_seed(seed)
    measurement: dict[str, Any] = {"seconds": fit.processor_seconds}
    for tested_on, share in KEPT.items():
        batch = batch_of(utterances(part), share, TEST_SEED)
        bound = dvae.fivo_bound(model, batch, particles=PARTICLES).bound.double() / batch["lengths"]
        weights, rows = batch["lengths"].tolist(), {OURS: {"bound": bound.tolist()}}
        measurement[tested_on] = {"clips": [*range(len(weights))], "weights": weights, "rows": rows}
    return measurement


def independent_density(part: str) -> dict[str, float]:
    """Return the mean log density of independent frames under a normal fitted to the training frames."""
    train_frames = torch.from_numpy(np.concatenate(utterances("train")))
    distribution = torch.distributions.MultivariateNormal(train_frames.mean(0), train_frames.T.cov())
    return {
        tested_on: float(distribution.log_prob(frames(batch_of(utterances(part), share, TEST_SEED)).double()).mean())
        for tested_on, share in KEPT.items()
    }


def table(runs: Path, part: str, note: str) -> Table:
    """Return a table of the bounds on a part, and of the cost of dropping training frames."""
    stored_rows, free, lines = read(runs, KEPT, f"{part}.json"), independent_density(part), []
    for tested_on in KEPT:
        rows = {fitted_on: row.of(tested_on) for fitted_on, row in stored_rows.items()}
        for fitted_on, row in rows.items():
            line, costs = [f"{fitted_on}, tested on {tested_on}", cell(row.estimate("bound"))], ["–"] * 3
            if fitted_on != "whole" and "whole" in rows:
                less, reference = row.estimate("bound", rows["whole"]), rows["whole"].estimate("bound").mean
                shares = less.mean / abs(reference), less.mean / (reference - free[tested_on])
                costs = [cell(less), *(f"{100 * share:.1f} %" for share in shares)]
            lines.append([*line, *costs])
        lines.append([f"independent frames, tested on {tested_on}", f"{free[tested_on]:.3f}", "–", "–", "–"])
    header = [f"fitted on …, {part}", "nats a frame", "minus fitted on whole"]
    return Table([*header, "of its bound", "of its gain over independent frames"], lines, note)


def main(
    runs: Path = Path("runs/irregular"),
    results: Path | None = None,
    part: Literal["validation", "test"] = "validation",
    seeds: tuple[int, ...] = (0,),
    latents: tuple[int, ...] = (8, 16),
) -> None:
    """Fit, score, and write the table.

    Args:
        runs: folder of the runs.
        results: folder of the tables, such as benchmarks/results; None prints them.
        part: split to score and to show in the table.
        seeds: seeds of the runs to fit; empty to write the tables only.
        latents: sizes of the latent.
    """
    torch.set_num_threads(1)
    for latent in latents:
        measure(runs / str(latent), KEPT, seeds, partial(run, latent, part), f"{part}.json")
    folders = {latent: runs / str(latent) for latent in STEPS if (runs / str(latent)).exists()}
    notes = {latent: f"Latent of {latent} numbers, {STEPS[latent]} steps." for latent in folders}
    write(
        results,
        {f"irregular/latent-{latent}": table(folder, part, notes[latent]) for latent, folder in folders.items()},
    )


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
