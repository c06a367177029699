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
"""Share of the frames of a sequence."""
JUDGED = 2026
"""Seed of the halves that runs are judged on, which are the same for all."""
STEPS = {8: 1000, 16: 1500}
"""Of training, by the size of the latent."""
SIZE: dict[str, Any] = {"width": 64, "decoder": (64,)}
TIMES = (1.0, 30.0)
"""Frames, over which the prior forgets."""
TRAINING: dict[str, Any] = {"batch_size": 64, "learning_rate": 3e-3, "decay": 0.2, "validate_every": 50}

Utterances = Sequence[np.ndarray]


def utterances(part: str) -> list[np.ndarray]:
    """Frames (T, D) of the utterances of a part."""
    return [one.values for one in domain("japanese-vowels").series if one.split == part]


def batch_of(sequences: Utterances, share: float, seed: int) -> dict[str, torch.Tensor]:
    """A batch of a share of the frames of each sequence, at least two, with the gaps between them."""
    random = np.random.default_rng(seed)
    kept = [np.sort(random.permutation(len(x))[: max(round(share * len(x)), 2)]) for x in sequences]
    lengths = torch.tensor([len(places) for places in kept])
    x = torch.zeros(len(kept), int(lengths.max()), sequences[0].shape[1])
    times = torch.zeros(x.shape[:2])
    for row, (one, places) in enumerate(zip(sequences, kept, strict=True)):
        x[row, : len(places)] = torch.from_numpy(one[places])
        times[row, : len(places)] = torch.from_numpy(places)
    return {"x": x, "d": time_since_previous(times, lengths), "lengths": lengths}


def frames(batch: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Return the valid frames of a batch, (N, D)."""
    return batch["x"][torch.arange(batch["x"].shape[1]) < batch["lengths"][:, None]]


def built(train: Mapping[str, torch.Tensor], latent: int) -> dvae.DynamicalVAE:
    """The linear SDE with its own guide, in units of the frames that it is trained on."""
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
    known = frames(train)
    means, scales = known.mean(0).tolist(), known.std(0).tolist()
    model.standardise("x", [Coordinate(mean, scale, mean) for mean, scale in zip(means, scales, strict=True)])
    return model


def run(latent: int, part: str, fitted_on: str, seed: int, out: Path) -> dict[str, Any]:
    """Fits and scores a model."""
    train, validation = (batch_of(utterances(each), KEPT[fitted_on], seed) for each in ("train", "validation"))
    torch.manual_seed(seed)
    model, how = built(train, latent), {"steps": STEPS[latent], "seed": seed, "resume": Run(out).exists, **TRAINING}
    fit = dvae.fit(model, train, validation, out=out, progress=False, **how)
    torch.manual_seed(seed)
    found: dict[str, Any] = {"seconds": fit.processor_seconds}
    for judged_on, share in KEPT.items():
        batch = batch_of(utterances(part), share, JUDGED)
        bound = dvae.fivo_bound(model, batch, particles=PARTICLES).bound.double() / batch["lengths"]
        weights, rows = batch["lengths"].tolist(), {OURS: {"bound": bound.tolist()}}
        found[judged_on] = {"clips": [*range(len(weights))], "weights": weights, "rows": rows}
    return found


def apart(part: str) -> dict[str, float]:
    """The density of frames of a part under the normal of training frames, each apart from the others."""
    known = torch.from_numpy(np.concatenate(utterances("train")))
    distribution = torch.distributions.MultivariateNormal(known.mean(0), known.T.cov())
    return {
        judged_on: float(distribution.log_prob(frames(batch_of(utterances(part), share, JUDGED)).double()).mean())
        for judged_on, share in KEPT.items()
    }


def table(runs: Path, part: str, note: str) -> Table:
    """Return a table of the bounds on a part, and of the cost of dropping training frames."""
    found, free, lines = read(runs, KEPT, f"{part}.json"), apart(part), []
    for judged_on in KEPT:
        rows = {fitted_on: row.of(judged_on) for fitted_on, row in found.items()}
        for fitted_on, row in rows.items():
            line, costs = [f"{fitted_on}, tested on {judged_on}", cell(row.estimate("bound"))], ["–"] * 3
            if fitted_on != "whole" and "whole" in rows:
                less, whole = row.estimate("bound", rows["whole"]), rows["whole"].estimate("bound").mean
                shares = less.mean / abs(whole), less.mean / (whole - free[judged_on])
                costs = [cell(less), *(f"{100 * share:.1f} %" for share in shares)]
            lines.append([*line, *costs])
        lines.append([f"independent frames, tested on {judged_on}", f"{free[judged_on]:.3f}", "–", "–", "–"])
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
    found = {latent: runs / str(latent) for latent in STEPS if (runs / str(latent)).exists()}
    notes = {latent: f"Latent of {latent} numbers, {STEPS[latent]} steps." for latent in found}
    write(results, {f"irregular/latent-{latent}": table(own, part, notes[latent]) for latent, own in found.items()})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
