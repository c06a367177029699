"""Fits and scores what docs/results/domains.md compares on real data of other kinds than motion, and writes its tables.

Every run has a directory under `--runs`, and a file of scores in it for each part that was scored: the script goes on
where it was stopped, skips what is there, and two of it may work on other domains, cases or seeds at once. Options are
chosen with `--part validation`, seed 0; `--part test` scores the runs of three seeds. Tables are of what is there.
"""

from __future__ import annotations

import itertools
import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from torch import Tensor

import dvae
from dvae.inference.evaluation.estimates import Crossed, Estimate
from dvae.inference.evaluation.evaluation import Row
from dvae.inference.evaluation.scores import CRPS, ENERGY, LEVELS, Measure, coverage_at
from dvae.inference.evaluation.uncertainty import decimals
from dvae.options import tuples
from dvae.runs.directory import Config
from dvae.tables.dataset import PanelData
from dvae.tables.domains import speech
from dvae.tables.encoding import PanelSchema
from dvae.tables.protocol import Cut

from . import engine
from .pages import DOCS, table, write

FORECASTS = 100
PARTS = ("validation", "test")
BASELINE = "autoregressive"
AT_ONCE, HELD = 2**14, 2**17
"""Steps of sequences, padding included, to score at once, and to hold times particles."""
BOUND, ELBO, FIVO, SDR, KHAT = "importance bound", "ELBO", "FIVO", "SI-SDR", "k-hat"
FORECAST = "forecasts.json"
UNFILTERED = ("rvae-noncausal",)
"""Whose observations read latents after them, so that no filter can run."""
REVIEW = {
    "srnn": 11.0,
    "vrnn": 10.0,
    "dkf": 9.3,
    "dsae": 9.2,
    "rvae-causal": 9.0,
    "rvae-noncausal": 8.9,
    "storn": 6.9,
    "vae": 5.3,
}
"""SI-SDR of Girin et al. 2021, of other speech, at 16 kHz."""
SHOWN = ("CRPS", "energy score", "coverage 50 %", "coverage 80 %", "coverage 90 %", "coverage 95 %")


@dataclass(frozen=True)
class Case:
    """One model.

    Args:
        options: of the method that it is named after.
        training: of the run, beside those of the section.
    """

    options: Mapping[str, Any] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Section:
    """What is compared on one domain.

    Args:
        cases: method to model; the one without latents is among them.
        training: of all runs.
        forecast: of which steps, from which.
        cut: of the sequences, for training and its validations; bounds are of whole sequences.
        unit: of a step.
        season: of the reference that repeats.
        particles: of bounds.
    """

    cases: Mapping[str, Case]
    training: Mapping[str, Any]
    forecast: Cut
    cut: Cut = field(default_factory=Cut)
    unit: str = "step"
    season: int | None = None
    particles: int = 100


def sections(file: Path) -> dict[str, Section]:
    """What is compared, by domain, from a file of TOML."""
    found = {}
    for name, told in tomllib.loads(file.read_text(encoding="utf-8")).items():
        cases = {
            case: Case(tuples(each["options"]), each.get("training", {})) for case, each in told.pop("cases").items()
        }
        cuts = {which: Cut(**told.pop(which)) for which in ("forecast", "cut") if which in told}
        found[name] = Section(cases, **cuts, **told)
    return found


SECTIONS = sections(Path(__file__).with_suffix(".toml"))


@dataclass(frozen=True)
class Data:
    """A domain, for training and for scores.

    Args:
        name: of the domain.
    """

    name: str

    @cached_property
    def training(self) -> PanelData:
        """Cut as its section says."""
        return PanelData.open(self.name, cut=SECTIONS[self.name].cut)

    def cut(self, cut: Cut) -> PanelData:
        """Cut otherwise."""
        panel = self.training.panel
        return PanelData(self.name, panel, PanelSchema.under(panel, cut))

    @cached_property
    def whole(self) -> PanelData:
        """Whole sequences, if it is not divided by time."""
        return self.training if SECTIONS[self.name].cut.split == "time" else self.cut(Cut())

    @cached_property
    def sounds(self) -> dict[str, np.ndarray]:
        """Signals of speech, by name."""
        return speech.recordings()


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
    part = dict(batch.map(lambda value: value[some]))
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


def measured(model: Any, case: str, data: Data, part: str, seed: int) -> dict[str, Any]:
    """Scores of every sequence, bounds in nats of all of it, and how many steps it has."""
    windows, particles = data.whole.windows(part), SECTIONS[data.name].particles
    batch = windows.all()
    count, steps = len(batch["x"]), batch["x"].shape[1]
    lengths = batch.get("lengths", torch.full((count,), steps))
    names = [BOUND, ELBO, KHAT, *(f"KL {latent}" for latent in model.latents)]
    scores = {name: torch.zeros(count, dtype=torch.float64) for name in names}
    if data.name == "speech":
        scores[SDR] = torch.zeros(count, dtype=torch.float64)
    elif case not in UNFILTERED and model.latents:
        scores[FIVO] = torch.zeros(count, dtype=torch.float64)
    torch.manual_seed(seed)
    keys = windows.keys
    for rows, some in pieces(batch):
        bound = dvae.importance_bound(model, some, particles=particles, chunk=HELD // some["x"].shape[1])
        with torch.no_grad():
            terms = dvae.SequenceELBO(num_particles=10 if model.latents else 1).terms(model, some)
        scores[BOUND][rows], scores[KHAT][rows] = bound.bound.double(), bound.khat.double()
        scores[ELBO][rows] = terms.bound.double()
        for latent in model.latents:
            scores[f"KL {latent}"][rows] = terms.kl[latent].double()
        if FIVO in scores:
            scores[FIVO][rows] = dvae.particle_bound(model, some, particles, chunk=AT_ONCE).bound.double()
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


def fitted(section: Section, data: Data, case: str, seed: int, out: Path) -> Any:
    """The model of a case, fitted if it is not there yet, and the seconds that this took."""
    chosen, file = section.cases[case], out / "fitted.json"
    if not file.exists():
        options = {**section.training, **chosen.training}
        method = dvae.method(case, **{"self_feeding": 0.0, **chosen.options})
        training = dvae.Training(seed=seed, progress=False, **options)
        torch.manual_seed(seed)
        model = method.build(data.training.schema)
        windows = data.training.windows("train")
        source = Alike(windows) if "lengths" in windows.all() else windows
        recipe = method.train(source, data.training.windows("validation"), training.steps)
        kept = Config(method, data.training.schema, data.training.kind, data.training.recorded(), training).written()
        seconds = engine.fitted(model, recipe, out=out, config=kept, seed=seed, **options)
        file.write_text(json.dumps({"seconds": seconds}))
    return dvae.load(out).model, json.loads(file.read_text())["seconds"]


def shown(windows: Any) -> list[Measure]:
    """Those of the page, in the unit of the data."""
    return [CRPS, ENERGY, *map(coverage_at, LEVELS)]


def forecasts(section: Section, case: str, seed: int, model: Any, data: Data) -> dvae.Evaluation:
    """Of test windows; the references stand beside the first run of the model without latents."""
    windows = data.cut(section.forecast).windows
    return dvae.evaluate(
        {case: model},
        windows("test"),
        scores=shown,
        samples=FORECASTS,
        seed=seed,
        draw_emission=True,
        references=case == BASELINE and seed == 0,
        training_windows=windows("train"),
        season=section.season,
        progress=False,
    )


def run(name: str, case: str, seed: int, out: Path, data: Data, part: str) -> None:
    """Fits and scores what is not there yet."""
    file, section = out / f"{part}.json", SECTIONS[name]
    if file.exists():
        return
    model, seconds = fitted(section, data, case, seed, out)
    weights = sum(parameter.numel() for parameter in model.parameters())
    found = {"seconds": seconds, "parameters": weights, **measured(model, case, data, part, seed)}
    if part == "test":
        forecasts(section, case, seed, model, data).save(out / FORECAST)
    file.write_text(json.dumps(found))
    steps = sum(found["steps"])
    said = ", ".join(f"{score} {np.nansum(found['scores'][score]) / steps:.3f}" for score in (BOUND, ELBO))
    print(f"{out} {part}: {said}", flush=True)


@dataclass(frozen=True)
class Read:
    """Scores of one case over seeds.

    Args:
        runs: what `measured` found, and how long fits took.
        forecasts: rows of evaluations, each of one run, and the windows of every sequence.
    """

    runs: list[dict[str, Any]]
    forecasts: list[Row] = field(default_factory=list)
    windows: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, case: str, folders: Sequence[Path], part: str) -> Read:
        """From the directories of its runs."""
        runs = [json.loads((folder / f"{part}.json").read_text()) for folder in folders]
        if part != "test":
            return cls(runs)
        evaluations = [dvae.Evaluation.load(folder / FORECAST) for folder in folders]
        return cls(runs, [own.rows[case] for own in evaluations], np.array(list(evaluations[0].clips.values())))

    @cached_property
    def clips(self) -> tuple[np.ndarray, np.ndarray]:
        """Of every row the place of its sequence, which windows share, and the steps of every sequence."""
        _, places = np.unique(self.runs[0]["clips"], return_inverse=True)
        return places, np.bincount(places, self.runs[0]["steps"])

    def crossed(self, score: str) -> Crossed:
        """Of a score a step, by seeds and sequences; SI-SDR is of a sequence, and scores of forecasts of a window."""
        if score in SHOWN:
            return Crossed.of(np.array([row.clip_means[score] for row in self.forecasts]), self.windows)
        places, steps = self.clips
        values = np.array([run["scores"][score] for run in self.runs], float)
        if score == SDR:
            return Crossed.of(values, np.ones(values.shape[1]))
        sums = np.stack([np.bincount(places, own) for own in values])
        return Crossed.of(sums / steps, steps)

    def said(self, score: str, other: Read | None = None) -> str:
        """A score, or the paired difference to that of another case; "–" where there is none."""
        if not all(score in (*own.runs[0]["scores"], *SHOWN) for own in (self, other or self)):
            return "–"
        return said(self.crossed(score).estimate(None if other is None else other.crossed(score)))

    @property
    def latents(self) -> list[str]:
        """Names of the KL terms."""
        return [score for score in self.runs[0]["scores"] if score.startswith("KL ")]

    @property
    def seconds(self) -> str:
        """Of processor time, the mean fit."""
        found = [run["seconds"] for run in self.runs if run["seconds"]]
        return f"{np.mean(found):.0f}" if found else "–"

    def unreliable(self) -> str:
        """Share of sequences whose k-hat is above 0.7; few particles have none."""
        khat = np.array([run["scores"][KHAT] for run in self.runs], float)
        return f"{100 * float((khat > 0.7).mean()):.0f} %" if self.latents and np.isfinite(khat).all() else "–"


def said(estimate: Estimate) -> str:
    """Mean, and its errors over sequences and over seeds, those that there are."""
    errors = [error for error in (estimate.sequences, estimate.seeds) if not np.isnan(error)]
    places = decimals(estimate.mean, *errors)
    return " ± ".join(f"{value:.{places}f}" for value in (estimate.mean, *errors))


def bounds(cases: Mapping[str, Read], section: Section) -> str:
    """Cases down, best first, bounds across."""
    order = sorted(cases, key=lambda name: -cases[name].crossed(BOUND).mean)
    header = [
        "",
        f"nats a {section.unit}, K = {section.particles}",
        f"minus {BASELINE}",
        "ELBO",
        FIVO,
        "KL",
        "k-hat > 0.7",
    ]
    header += ["weights", "s a fit"]
    rows = []
    for name in order:
        case = cases[name]
        less = "–" if name == BASELINE or BASELINE not in cases else case.said(BOUND, cases[BASELINE])
        row = [name, case.said(BOUND), less, *(case.said(score) for score in (ELBO, FIVO))]
        row += [", ".join(f"{case.crossed(score).mean:.2f}" for score in case.latents) or "–", case.unreliable()]
        rows.append([*row, f"{case.runs[0]['parameters']:,}", case.seconds])
    return table(header, rows)


def of_forecasts(cases: Mapping[str, Read], references: Mapping[str, Row]) -> str:
    """Cases and references down, the best CRPS first, scores of forecasts across; only draws have intervals."""
    windows = next(iter(cases.values())).windows
    found = {**cases, **{name: Read([{"scores": {}}], [row], windows) for name, row in references.items()}}
    order = sorted(found, key=lambda name: found[name].crossed("CRPS").mean)
    rows = []
    for name in order:
        there = [score for score in SHOWN if score in found[name].forecasts[0].clip_means]
        rows.append([name, *(found[name].said(score) if score in there else "–" for score in SHOWN)])
    return table(["", *SHOWN], rows)


def sound(cases: Mapping[str, Read]) -> str:
    """Cases by how well their resynthesis sounds."""
    order = sorted(cases, key=lambda name: -cases[name].crossed(SDR).mean)
    rows = [[name, cases[name].said(SDR), f"{REVIEW[name]:.1f}"] for name in order if cases[name].latents]
    return table(["", "SI-SDR, dB", "the review's, of other speech"], rows)


def tables(runs: Path, part: str) -> list[str]:
    """Of what was scored on a part."""
    parts = []
    for name, section in SECTIONS.items():
        found = {case: sorted((runs / name).glob(f"{case}-[0-9]*/{part}.json")) for case in section.cases}
        cases = {case: Read.of(case, [file.parent for file in files], part) for case, files in found.items() if files}
        if not cases:
            continue
        first = next(iter(cases.values()))
        seconds = sum(run["seconds"] or 0 for case in cases.values() for run in case.runs)
        parts += [f"### {name.capitalize()}, {part}\n"]
        parts += [
            f"{len(first.clips[1])} sequences, {sum(first.clips[1]):.0f} steps; {len(first.runs)} seeds; all fits took "
            f"{seconds / 60:.0f} minutes of processor time.\n"
        ]
        parts += [bounds(cases, section)]
        if SDR in first.runs[0]["scores"]:
            parts += ["Resynthesis from the posterior:\n", sound(cases)]
        if first.forecasts:
            cut, told = section.forecast, runs / name / f"{BASELINE}-0" / FORECAST
            rows = dvae.Evaluation.load(told).rows if told.exists() else {}
            references = {name: row for name, row in rows.items() if name != BASELINE}
            parts += [f"Forecasts of {cut.horizon} steps from {cut.observed}, {FORECASTS} draws:\n"]
            parts += [of_forecasts(cases, references)]
    return parts


def main(
    domains: tuple[str, ...] = ("chorales",),
    runs: Path = Path("runs/domains"),
    page: Path | None = DOCS / "results" / "domains.md",
    part: Literal["validation", "test"] = "validation",
    cases: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (0,),
) -> None:
    """Fit, score, and write the tables.

    Args:
        domains: to fit, by name; none for tables alone.
        runs: where runs are kept.
        page: where the tables stand; None prints them.
        part: that is scored, and of which the tables are.
        cases: to fit, by name; all of a domain where none is named.
        seeds: of the runs to fit.
    """
    torch.set_num_threads(1)
    for name in domains:
        data = Data(name)
        for seed, case in itertools.product(seeds, cases or SECTIONS[name].cases):
            run(name, case, seed, runs / name / f"{case}-{seed}", data, part)
    found = tables(runs, part)
    write(page, *found)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
