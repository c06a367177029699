"""Fits and scores what docs/results/domains.md compares on real data of other kinds than motion, and writes its tables.

Every run has a directory under `--runs`, and a file of scores in it for each part that was scored: the script goes on
where it was stopped, skips what is there, and two of it may work on other domains, cases or seeds at once. Options are
chosen with `--part validation`, seed 0; `--part test` scores the runs of three seeds. Tables are of what is there.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from torch import Tensor
from typing_extensions import override

import dvae
from dvae.data import each
from dvae.inference.checkpoints import Run, load_weights
from dvae.inference.comparison import Crossed, Estimate
from dvae.runs.directory import Config
from dvae.tables.dataset import PanelData
from dvae.tables.domains import domain, speech
from dvae.tables.encoding import PanelSchema
from dvae.tables.protocol import Cut
from dvae.units import Units

from .pages import DOCS, table, write

PARTICLES = 100
PARTS = ("validation", "test")
BASELINE = "autoregressive"
AT_ONCE, HELD = 2**14, 2**17
"""Steps of sequences, padding included, to score at once, and to hold times particles."""
BOUND, ELBO, SDR, KHAT = "importance bound", "ELBO", "SI-SDR", "k-hat"


@dataclass(frozen=True)
class Case:
    """One model.

    Args:
        method: its name.
        options: of the method.
        training: of the run, beside those of the section.
    """

    method: str
    options: Mapping[str, Any] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Section:
    """What is compared on one domain.

    Args:
        cases: name to model; the one without latents is among them.
        training: of all runs.
        cut: of the sequences, for training and its validations; scores are of whole sequences.
        unit: of a step.
    """

    cases: Mapping[str, Case]
    training: Mapping[str, Any]
    cut: Cut = field(default_factory=Cut)
    unit: str = "step"


PLAIN: dict[str, Any] = {"embed": 0, "hidden": ()}
"""Nothing between recurrent states and what is made of them: on few chorales a perceptron there learns late, and by
heart."""
CHORALES = Section(
    {
        BASELINE: Case(
            BASELINE, {"width": 128, **PLAIN}, {"steps": 1000, "learning_rate": 5e-3, "decay": 0.5, "weight_decay": 0.1}
        ),
        "dkf": Case(
            "dkf",
            {"latent": 32, "width": 128, **PLAIN, "embed_latent": (), "decoder": (200,), "warm_up": 1500},
            {"steps": 5500, "decay": 0.6, "weight_decay": 0.03},
        ),
        "srnn": Case(
            "srnn",
            {"latent": 32, "width": 32, **PLAIN, "decoder": (128,), "warm_up": 600},
            {"steps": 1200, "decay": 0.7, "weight_decay": 0.2},
        ),
    },
    {"batch_size": 16, "learning_rate": 6e-3, "validate_every": 50, "optimizer": "adamw"},
    unit="quarter note",
)
SIZE: dict[str, Any] = {"latent": 16, "warm_up": 300}
SPEECH = Section(
    {
        BASELINE: Case(BASELINE, {"width": 128, "hidden": ()}),
        "vae": Case("vae", {**SIZE, "hidden": (128, 64)}),
        "dkf": Case("dkf", {**SIZE, "width": 128, **PLAIN, "embed_latent": (), "decoder": (128,)}),
        "srnn": Case("srnn", {**SIZE, "width": 128, "embed": 128, "hidden": (64,), "decoder": (128,)}),
        "rvae-causal": Case("rvae-causal", {**SIZE, "width": 128}),
        "rvae-noncausal": Case("rvae-noncausal", {**SIZE, "width": 128}),
    },
    {"steps": 1500, "batch_size": 32, "learning_rate": 3e-3, "decay": 0.5, "validate_every": 250},
    Cut(observed=32, horizon=32),
    "frame",
)
SERIES: dict[str, Any] = {"batch_size": 32, "learning_rate": 2e-3, "decay": 0.5, "validate_every": 100}
SECTIONS = {
    "chorales": CHORALES,
    "speech": SPEECH,
    "japanese-vowels": Section(
        {
            BASELINE: Case(BASELINE, {"width": 64}),
            "dkf": Case("dkf", {"latent": 16, "width": 64}),
            "srnn": Case("srnn", {"latent": 16, "width": 64}),
        },
        {**SERIES, "steps": 1500},
    ),
    "basic-motions": Section(
        {
            BASELINE: Case(BASELINE, {"width": 64}),
            "dkf": Case("dkf", {"latent": 8, "width": 64}),
            "srnn": Case("srnn", {"latent": 8, "width": 64}),
        },
        {**SERIES, "steps": 1000, "batch_size": 16},
    ),
    "macrodata": Section(
        {
            BASELINE: Case(BASELINE, {"width": 16, "hidden": (16,)}),
            "dkf": Case("dkf", {"latent": 4, "width": 16}),
            "srnn": Case("srnn", {"latent": 4, "width": 16}),
        },
        {**SERIES, "steps": 600},
        Cut(observed=16, horizon=8, split="time"),
        "quarter",
    ),
}


@dataclass(frozen=True, eq=False)
class Data:
    """A domain, for training and for scores.

    Args:
        name: of the domain.
        options: of what loads it.
    """

    name: str
    options: Mapping[str, Any]

    @cached_property
    def training(self) -> PanelData:
        """Cut as its section says."""
        return PanelData.of(domain(self.name, **self.options), cut=SECTIONS[self.name].cut, name=self.name)

    @cached_property
    def whole(self) -> PanelData:
        """Whole sequences, if it is not divided by time."""
        cut = SECTIONS[self.name].cut
        if cut.split == "time":
            return self.training
        panel = self.training.panel
        return PanelData(self.name, panel, PanelSchema.under(panel, Cut()))

    @cached_property
    def sounds(self) -> dict[str, np.ndarray]:
        """Signals of speech, by name."""
        return speech.recordings(**self.options)


class Alike:
    """Sequences of like lengths in a batch, so that little of it is padding; all are as likely."""

    def __init__(self, windows: Any):
        self.windows, self.batch = windows, windows.all()

    @property
    def fingerprint(self) -> str:
        """Of the sequences."""
        found: str = self.windows.fingerprint
        return found

    def sample(self, batch_size: int, generator: torch.Generator) -> dict[str, Any]:
        """A batch of neighbours in an order of lengths that chance has disturbed by a fifth."""
        lengths = self.batch["lengths"]
        order = (lengths.log() + 0.2 * torch.randn(len(lengths), generator=generator)).argsort()
        start = int(torch.randint(1 - batch_size, len(order), (), generator=generator))
        return trimmed(self.batch, order[max(start, 0) : start + batch_size])


def trimmed(batch: Mapping[str, Any], some: Tensor) -> dict[str, Any]:
    """Rows of a batch, without what is padding in all of them."""
    part = dict(each(batch, lambda value: value[some]))
    longest = int(part["lengths"].max()) if "lengths" in part else None
    return {name: value[:, :longest] if value.dim() == 3 else value for name, value in part.items()}


def pieces(batch: Mapping[str, Any]) -> Iterator[tuple[Tensor, dict[str, Any]]]:
    """Rows of a batch, shortest first, and they themselves."""
    x = batch["x"]
    lengths = batch.get("lengths", torch.full((len(x),), x.shape[1]))
    order, start = lengths.argsort(), 0
    while start < len(order):
        stop = start + 1
        while stop < len(order) and (stop + 1 - start) * int(lengths[order[stop]]) <= AT_ONCE:
            stop += 1
        yield order[start:stop], trimmed(batch, order[start:stop])
        start = stop


def measured(model: Any, data: Data, part: str, seed: int) -> dict[str, Any]:
    """Scores of every sequence, bounds in nats of all of it, and how many steps it has."""
    windows = data.whole.windows(part)
    batch = windows.all()
    count, steps = len(batch["x"]), batch["x"].shape[1]
    lengths = batch.get("lengths", torch.full((count,), steps))
    names = [BOUND, ELBO, KHAT, *(f"KL {latent}" for latent in model.latents)]
    scores = {name: torch.zeros(count, dtype=torch.float64) for name in names}
    if data.name == "speech":
        scores[SDR] = torch.zeros(count, dtype=torch.float64)
    torch.manual_seed(seed)
    keys = windows.keys
    for rows, some in pieces(batch):
        bound = dvae.importance_bound(model, some, particles=PARTICLES, chunk=HELD // some["x"].shape[1])
        with torch.no_grad():
            terms = dvae.SequenceELBO(num_particles=10 if model.latents else 1).terms(model, some)
        scores[BOUND][rows], scores[KHAT][rows] = bound.bound.double(), bound.khat.double()
        scores[ELBO][rows] = terms.bound.double()
        for latent in model.latents:
            scores[f"KL {latent}"][rows] = terms.kl[latent].double()
        if SDR in scores:
            made = model.reconstruct(some, samples=1)["x"][0].double().numpy()
            for row, own in zip(rows.tolist(), made, strict=True):
                sound = data.sounds[keys[row][1]]
                scores[SDR][row] = speech.si_sdr(sound, speech.resynthesised(own[: int(lengths[row])], sound))
    return {
        "steps": lengths.tolist(),
        "clips": [key[1] for key in keys],
        "scores": {name: own.tolist() for name, own in scores.items()},
    }


class Decibels(Units):
    """Units in which networks read the logarithm of a power, and make the power as they would."""

    level: Tensor
    spread: Tensor

    def __init__(self, power: Tensor):
        super().__init__(power.shape[-1], columns=True)
        self.set([0.0] * power.shape[-1], power.mean(0).tolist())
        self.register_buffer("level", power.log().mean(0))
        self.register_buffer("spread", power.log().std(0).mean())

    @override
    def forward(self, values: Tensor) -> Tensor:
        return (values.clamp(min=speech.FLOOR).log() - self.level) / self.spread


def built(method: Any, data: PanelData) -> Any:
    """The model of a method, whose networks read zeros and ones without mean and unit, and powers in decibels.

    Most keys are rarely down, so that a network that reads them as they are sees next to nothing: it learns late, and
    latents are given up before it has. Of a power, which goes over ten orders of magnitude, it sees the peaks alone.
    """
    model = method.build(data.schema)
    families = {column.family for column in data.panel.columns.targets}
    if not families & {"binary", "power"}:
        return model
    train = torch.cat([torch.as_tensor(one.values).float() for one in data.panel if one.split == "train"])
    model.standardise("x").fit(train)
    if families == {"power"}:
        model.units["x"] = Decibels(train)
        for conditional in (*model.generator.values(), *model.encoder.values()):
            conditional.units["x"] = model.units["x"]
    return model


def run(name: str, case: str, seed: int, out: Path, data: Data, part: str) -> None:
    """Fits and scores what is not there yet."""
    file = out / f"{part}.json"
    if file.exists():
        return
    section, chosen = SECTIONS[name], SECTIONS[name].cases[case]
    options = {**section.training, **chosen.training}
    method, training = dvae.method(chosen.method, **chosen.options), dvae.Training(seed=seed, progress=False, **options)
    schema = data.training.schema
    torch.manual_seed(seed)
    model = built(method, data.training)
    start, resumed = time.process_time(), Run(out).exists
    if (out / "fitted.json").exists():
        load_weights(model, out)
        seconds = json.loads((out / "fitted.json").read_text())["seconds"]
    else:
        windows = data.training.windows("train")
        source = Alike(windows) if "lengths" in windows.all() else windows
        recipe = method.train(source, data.training.windows("validation"), training.steps)
        config = Config(method, schema, data.training.kind, data.training.recorded(), training).written()
        recipe.fit(model, out=out, resume=resumed, config=config, **vars(training))
        seconds = None if resumed else time.process_time() - start  # of a run that was not stopped
        (out / "fitted.json").write_text(json.dumps({"seconds": seconds}))
    weights = sum(p.numel() for p in model.parameters())
    found = {"seconds": seconds, "parameters": weights, **measured(model.eval(), data, part, seed)}
    file.write_text(json.dumps(found))
    steps = sum(found["steps"])
    said = ", ".join(f"{score} {np.nansum(found['scores'][score]) / steps:.3f}" for score in (BOUND, ELBO))
    print(f"{out} {part}: {said}", flush=True)


@dataclass(frozen=True)
class Read:
    """Scores of one case over seeds."""

    runs: list[dict[str, Any]]

    @cached_property
    def clips(self) -> tuple[np.ndarray, np.ndarray]:
        """Of every row the place of its sequence, which windows share, and the steps of every sequence."""
        _, places = np.unique(self.runs[0]["clips"], return_inverse=True)
        return places, np.bincount(places, self.runs[0]["steps"])

    def crossed(self, score: str) -> Crossed:
        """Of a score a step, by seeds and sequences; SI-SDR is of a sequence."""
        places, steps = self.clips
        values = np.array([run["scores"][score] for run in self.runs], float)
        if score == SDR:
            return Crossed.of(values, np.ones(values.shape[1]))
        sums = np.stack([np.bincount(places, own) for own in values])
        return Crossed.of(sums / steps, steps)

    def __contains__(self, score: str) -> bool:
        return score in self.runs[0]["scores"]

    def unreliable(self) -> float:
        """Share of sequences whose k-hat is above 0.7."""
        khat = np.array([run["scores"][KHAT] for run in self.runs], float)
        return float((khat > 0.7).mean())


def said(estimate: Estimate, digits: int = 3) -> str:
    """Mean, and its errors over sequences and over seeds."""
    values = (estimate.mean, estimate.sequences, estimate.seeds)
    return " ± ".join("–" if np.isnan(value) else f"{value:.{digits}f}" for value in values)


def scored(cases: Mapping[str, Read], unit: str) -> str:
    """Cases down, best first, scores across."""
    order = sorted(cases, key=lambda name: -cases[name].crossed(BOUND).mean)
    sounding = any(SDR in case for case in cases.values())
    header = ["", f"nats a {unit}, K = {PARTICLES}", f"minus {BASELINE}", "ELBO", "KL", "k-hat > 0.7", "weights"]
    lines = []
    for name in order:
        case = cases[name]
        latents = [score for score in case.runs[0]["scores"] if score.startswith("KL ")]
        less = "–"
        if name != BASELINE and BASELINE in cases:
            less = said(case.crossed(BOUND).estimate(cases[BASELINE].crossed(BOUND)))
        line = [name, said(case.crossed(BOUND).estimate()), less, said(case.crossed(ELBO).estimate())]
        line += [", ".join(f"{case.crossed(score).mean:.2f}" for score in latents) or "–"]
        line += [f"{100 * case.unreliable():.0f} %" if latents else "–", f"{case.runs[0]['parameters']:,}"]
        line += [said(case.crossed(SDR).estimate(), 2)] if sounding else []
        lines.append(line)
    return table([*header, "SI-SDR, dB"] if sounding else header, lines)


def tables(runs: Path, part: str) -> list[str]:
    """Of what was scored on a part."""
    parts = []
    for name, section in SECTIONS.items():
        found = {case: sorted((runs / name).glob(f"{case}-[0-9]*/{part}.json")) for case in section.cases}
        cases = {case: Read([json.loads(file.read_text()) for file in files]) for case, files in found.items() if files}
        if not cases:
            continue
        first = next(iter(cases.values())).runs[0]
        seconds = [run["seconds"] or np.nan for case in cases.values() for run in case.runs]
        intro = f"{len(set(first['clips']))} sequences, {sum(first['steps'])} steps. "
        intro += f"Fits took {np.nanmin(seconds):.0f} to {np.nanmax(seconds):.0f} s of processor time.\n"
        parts += [f"## {name.capitalize()}, {part}\n", intro, scored(cases, section.unit)]
    return parts


def main(
    domains: tuple[str, ...] = ("chorales",),
    runs: Path = Path("runs/domains"),
    page: Path | None = DOCS / "results" / "domains.md",
    part: Literal["validation", "test"] = "validation",
    cases: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (0,),
    sounds: Path = speech.PLACE,
) -> None:
    """Fit, score, and write the tables.

    Args:
        domains: to fit, by name; none for tables alone.
        runs: where runs are kept.
        page: where the tables stand; None prints them.
        part: that is scored, and of which the tables are.
        cases: to fit, by name; all of a domain where none is named.
        seeds: of the runs to fit.
        sounds: folder of the prompts.
    """
    torch.set_num_threads(1)
    for name in domains:
        data = Data(name, {"folder": sounds} if name == "speech" else {})
        for seed, case in itertools.product(seeds, cases or SECTIONS[name].cases):
            run(name, case, seed, runs / name / f"{case}-{seed}", data, part)
    found = tables(runs, part)
    if page is None:
        print("\n".join(found))
    else:
        write(page, *found)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
