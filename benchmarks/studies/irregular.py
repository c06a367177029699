"""Fits a linear SDE to utterances whole and with half of their frames dropped, for docs/results/irregular.md.

Every run has a directory under `--runs`, and a file of scores in it for each part that was scored: the script goes on
where it was stopped, and skips what is there. Options are chosen with `--part validation`, seed 0; `--part test` scores
the runs of three seeds.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro

import dvae
from dvae import distributions
from dvae.data.sequences import gaps
from dvae.data.units import Coordinate
from dvae.inference.evaluation.estimates import Crossed
from dvae.inference.training.checkpoints import load_weights
from dvae.networks import Dense, LinearSDE, LinearSDEGuide, Recurrent
from dvae.networks.base import share_modules
from dvae.tables.domains import domain

from . import engine
from .domains import said
from .pages import DOCS, table, write

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
TRAINING: dict[str, Any] = {
    "batch_size": 64,
    "learning_rate": 3e-3,
    "decay": 0.2,
    "validate_every": 50,
}

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
    return {"x": x, "d": gaps(times, lengths), "lengths": lengths}


def frames(batch: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Those of a batch, (N, D)."""
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


def run(fitted_on: str, latent: int, seed: int, out: Path, part: str) -> None:
    """Fits and scores what is not there yet."""
    file = out / f"{part}.json"
    if file.exists():
        return
    train, validation = (batch_of(utterances(each), KEPT[fitted_on], seed) for each in ("train", "validation"))
    torch.manual_seed(seed)
    model = built(train, latent)
    if (out / "fitted.json").exists():
        load_weights(model, out)
        seconds = json.loads((out / "fitted.json").read_text())["seconds"]
    else:
        how = {"steps": STEPS[latent], "seed": seed, **TRAINING}
        seconds = engine.fitted(model, train, validation, out=out, **how)
        (out / "fitted.json").write_text(json.dumps({"seconds": seconds}))
    found: dict[str, Any] = {"seconds": seconds}
    torch.manual_seed(seed)
    for judged_on, share in KEPT.items():
        batch = batch_of(utterances(part), share, JUDGED)
        bound = dvae.particle_bound(model, batch, particles=PARTICLES).bound.double()
        found[judged_on] = {"steps": batch["lengths"].tolist(), "scores": (bound / batch["lengths"]).tolist()}
    file.write_text(json.dumps(found))
    print(f"{out} {part}: {', '.join(f'{name} {mean(found[name]):.3f}' for name in KEPT)}", flush=True)


def mean(scores: Mapping[str, Any]) -> float:
    """A frame."""
    return float(np.average(scores["scores"], weights=scores["steps"]))


def apart(part: str) -> dict[str, float]:
    """The density of frames of a part under the normal of training frames, each apart from the others."""
    known = torch.from_numpy(np.concatenate(utterances("train")))
    law = torch.distributions.MultivariateNormal(known.mean(0), known.T.cov())
    return {
        judged_on: float(law.log_prob(frames(batch_of(utterances(part), share, JUDGED)).double()).mean())
        for judged_on, share in KEPT.items()
    }


def tabled(runs: Path, part: str) -> str:
    """What was scored on a part, and what dropping frames from training costs."""
    found = {
        name: [json.loads(f.read_text()) for f in sorted(runs.glob(f"{name}-[0-9]*/{part}.json"))] for name in KEPT
    }
    lines, crossed = [], {}
    for fitted_on, read in found.items():
        for judged_on in KEPT if read else ():
            scores = np.array([each[judged_on]["scores"] for each in read])
            crossed[fitted_on, judged_on] = Crossed.of(scores, np.array(read[0][judged_on]["steps"], float))
    free = apart(part)
    for judged_on in KEPT:
        for fitted_on in KEPT:
            if (fitted_on, judged_on) not in crossed:
                continue
            own, whole = crossed[fitted_on, judged_on], crossed.get(("whole", judged_on))
            line = [f"{fitted_on}, judged on {judged_on}", said(own.estimate())]
            if fitted_on == "whole" or whole is None:
                line += ["–"] * 3
            else:
                less = own.estimate(whole)
                line += [said(less), f"{100 * less.mean / abs(whole.mean):.1f} %"]
                line += [f"{100 * less.mean / (whole.mean - free[judged_on]):.1f} %"]
            lines.append(line)
        lines.append([f"frames apart, judged on {judged_on}", f"{free[judged_on]:.3f}", "–", "–", "–"])
    header = [
        f"fitted on …, {part}",
        "nats a frame",
        "minus fitted on whole",
        "of its bound",
        "of its gain over frames apart",
    ]
    return table(header, lines)


def main(
    runs: Path = Path("runs/irregular"),
    page: Path | None = DOCS / "results" / "irregular.md",
    part: Literal["validation", "test"] = "validation",
    seeds: tuple[int, ...] = (0,),
    latents: tuple[int, ...] = (8, 16),
) -> None:
    """Fit, score, and write the table.

    Args:
        runs: where runs are kept.
        page: where the table stands; None prints it.
        part: that is scored, and of which the table is.
        seeds: of the runs to fit; none for the tables alone.
        latents: sizes of their latent.
    """
    torch.set_num_threads(1)
    for latent, seed, fitted_on in itertools.product(latents, seeds, KEPT):
        run(fitted_on, latent, seed, runs / str(latent) / f"{fitted_on}-{seed}", part)
    found = []
    for latent in STEPS:
        if (runs / str(latent)).exists():
            found += [f"Latent of {latent} numbers, {STEPS[latent]} steps:\n", tabled(runs / str(latent), part)]
    write(page, *found)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
