"""Fit and score models on real data other than motion, and write their tables.

Each run has a directory under `--runs`, with a file of scores for each scored part. An interrupted script continues and
skips existing files, and two processes may work on other domains, cases or seeds at once. Options are chosen with
`--part validation`, seed 0; `--part test` scores the runs of three seeds. Tables show the available files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from torch import Tensor

import dvae
from dvae.inference.evaluation.scores import CRPS, ENERGY, LEVELS, Measure, coverage_at
from dvae.tables.dataset import PanelData
from dvae.tables.domains import speech
from dvae.tables.encoding import PanelSchema
from dvae.tables.protocol import Cut

from .engine import OURS, Row, cell, fit_or_load, measure, read, scores_of, settings
from .results import Table, ordered, tabled, write

FORECASTS = 100
BASELINE = "autoregressive"
AT_ONCE, PARTICLES_AT_ONCE = 2**14, 2**17
"""Largest number of steps in a batch, with padding, and of steps times particles in memory."""
BOUND, ELBO, FIVO, SDR, KHAT = "IWAE bound", "ELBO", "FIVO", "SI-SDR", "k-hat"
UNFILTERED = ("rvae-noncausal",)
"""Methods without a particle filter, because their observations depend on later latents."""
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
"""SI-SDR in Girin et al. 2021, on different speech data at 16 kHz."""
SHOWN = ("CRPS", "energy score", "coverage 50 %", "coverage 80 %", "coverage 90 %", "coverage 95 %")


@dataclass(frozen=True)
class Section:
    """Settings of the comparison on one domain.

    Args:
        cases: method name to its `options` and its `training` options; one method has no latents.
        training: training options of all runs.
        forecast: observed and predicted steps.
        cut: windows for training and validation; bounds use whole sequences.
        unit: name of a step.
        season: period of the seasonal reference, in steps.
        particles: number of particles of the bounds.
    """

    cases: Mapping[str, Mapping[str, Any]]
    training: Mapping[str, Any]
    forecast: Cut
    cut: Cut = field(default_factory=Cut)
    unit: str = "step"
    season: int | None = None
    particles: int = 100


def section(options: Mapping[str, Any]) -> Section:
    """Return the settings of one domain from the TOML file."""
    return Section(**{**options, **{name: Cut(**options[name]) for name in ("forecast", "cut") if name in options}})


SECTIONS = {name: section(options) for name, options in settings(__file__).items()}


@dataclass(frozen=True)
class Data:
    """A domain, for training and for scores.

    Args:
        name: name of the domain.
    """

    name: str

    @cached_property
    def training(self) -> PanelData:
        """Data with the cut of the section."""
        return PanelData.open(self.name, cut=SECTIONS[self.name].cut)

    def cut(self, cut: Cut) -> PanelData:
        """Return the data with another cut."""
        panel = self.training.panel
        return PanelData(self.name, panel, PanelSchema.from_data(panel, cut))

    @cached_property
    def whole(self) -> PanelData:
        """Data with whole sequences, unless the domain is split by time."""
        return self.training if SECTIONS[self.name].cut.split == "time" else self.cut(Cut())

    @cached_property
    def sounds(self) -> dict[str, np.ndarray]:
        """Speech signals by name."""
        return speech.recordings()


class SimilarLengths:
    """Draw batches of sequences with similar lengths, to reduce padding; all sequences are equally likely."""

    def __init__(self, windows: Any):
        self.windows, self.batch = windows, windows.all()

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the sequences."""
        fingerprint: str = self.windows.fingerprint
        return fingerprint

    def sample(self, batch_size: int, generator: torch.Generator) -> dict[str, Any]:
        """Draw neighbours in the order of the lengths, perturbed by about 20 %."""
        lengths = self.batch["lengths"]
        order = (lengths.log() + 0.2 * torch.randn(len(lengths), generator=generator)).argsort()
        start = int(torch.randint(1 - batch_size, len(order), (), generator=generator))
        return trim_padding(self.batch, order[max(start, 0) : start + batch_size])


def trim_padding(batch: Mapping[str, Any], some: Tensor) -> dict[str, Any]:
    """Return rows of a batch, without the steps that are padding in all of them."""
    part = dict(batch.map(lambda value: value[some]))
    longest = int(part["lengths"].max()) if "lengths" in part else None
    return {name: value[:, :longest] if value.dim() == 3 else value for name, value in part.items()}


def split_by_length(batch: Mapping[str, Any]) -> Iterator[tuple[Tensor, dict[str, Any]]]:
    """Yield the row indices and the rows of parts of a batch, shortest first."""
    x = batch["x"]
    lengths = batch.get("lengths", torch.full((len(x),), x.shape[1]))
    order, start = lengths.argsort(), 0
    while start < len(order):
        stop = start + 1
        while stop < len(order) and (stop + 1 - start) * int(lengths[order[stop]]) <= AT_ONCE:
            stop += 1
        yield order[start:stop], trim_padding(batch, order[start:stop])
        start = stop


def measured(model: Any, case: str, data: Data, part: str, seed: int) -> dict[str, Any]:
    """Return scores by sequence: bounds in nats a step, and for speech the SI-SDR of the resynthesis."""
    windows, particles = data.whole.windows(part), SECTIONS[data.name].particles
    batch = windows.all()
    count, steps = len(batch["x"]), batch["x"].shape[1]
    lengths = batch.get("lengths", torch.full((count,), steps))
    names = [BOUND, ELBO, KHAT, *(f"KL {latent}" for latent in model.latents)]
    names += [FIVO] if data.name != "speech" and case not in UNFILTERED and model.latents else []
    scores = {name: torch.zeros(count, dtype=torch.float64) for name in names}
    sound, clips = np.zeros(count), [key[1] for key in windows.keys]
    torch.manual_seed(seed)
    for rows, some in split_by_length(batch):
        bound = dvae.iwae_bound(model, some, particles=particles, chunk=PARTICLES_AT_ONCE // some["x"].shape[1])
        with torch.no_grad():
            terms = dvae.SequenceELBO(num_particles=10 if model.latents else 1).terms(model, some)
        values_by_name = {BOUND: bound.bound, KHAT: bound.khat, ELBO: terms.bound}
        values_by_name |= {f"KL {latent}": terms.kl[latent] for latent in model.latents}
        if FIVO in scores:
            values_by_name[FIVO] = dvae.fivo_bound(model, some, particles, chunk=AT_ONCE).bound
        for name, values in values_by_name.items():
            scores[name][rows] = values.double() / (1 if name == KHAT else lengths[rows])
        if data.name == "speech":
            reconstructed = model.reconstruct(some, samples=1)["x"][0].double().numpy()
            for row, frames in zip(rows.tolist(), reconstructed, strict=True):
                truth = data.sounds[clips[row]]
                sound[row] = speech.si_sdr(truth, speech.resynthesised(frames[: int(lengths[row])], truth))
    alike = {"clips": clips, "weights": [1] * count, "rows": {OURS: {SDR: sound.tolist()}}}
    bounds = {"clips": clips, "weights": lengths.tolist(), "rows": {OURS: {n: s.tolist() for n, s in scores.items()}}}
    return {"bounds": bounds, **({"sound": alike} if data.name == "speech" else {})}


def forecast_scores(windows: Any) -> list[Measure]:
    """Return the scores of the tables, in the unit of the data."""
    return [CRPS, ENERGY, *map(coverage_at, LEVELS)]


def forecasts(case: str, seed: int, model: Any, data: Data) -> dict[str, Any]:
    """Return the scores of test windows, with references for the first run of the model without latents."""
    section = SECTIONS[data.name]
    windows = data.cut(section.forecast).windows
    options: dict[str, Any] = {"samples": FORECASTS, "seed": seed, "draw_emission": True, "progress": False}
    options |= {"references": case == BASELINE and seed == 0, "season": section.season}
    evaluation = dvae.evaluate(
        {OURS: model}, windows("test"), scores=forecast_scores, training_windows=windows("train"), **options
    )
    return scores_of(evaluation.clusters, {name: row.cluster_means for name, row in evaluation.rows.items()})


def run(data: Data, part: str, case: str, seed: int, out: Path) -> dict[str, Any]:
    """Fit and score a case."""
    section, training_data = SECTIONS[data.name], data.training
    options = section.cases[case]
    method = dvae.method(case, **{"scheduled_sampling": 0.0, **options["options"]})
    training = {**section.training, **options.get("training", {})}
    windows, validation = training_data.windows("train"), training_data.windows("validation")
    source = SimilarLengths(windows) if "lengths" in windows.all() else windows
    fit = fit_or_load(method, training_data, source, validation, out=out, seed=seed, **training)
    model = fit.model.eval()
    weights = sum(parameter.numel() for parameter in model.parameters())
    measurement = {"seconds": fit.processor_seconds, "parameters": weights, **measured(model, case, data, part, seed)}
    return measurement | ({"forecasts": forecasts(case, seed, model, data)} if part == "test" else {})


def score_cell(row: Row, part: str, score: str, other: Row | None = None) -> str:
    """Return a cell with a score or its paired difference to another case."""
    return cell(row.of(part).estimate(score, None if other is None else other.of(part)))


def mean(row: Row, part: str, score: str) -> float:
    """Return the mean of a score, used to sort rows."""
    estimate = row.of(part).estimate(score)
    assert estimate is not None
    return estimate.mean


def latents(row: Row) -> list[str]:
    """Return the names of the KL terms."""
    return [score for score in row.runs[0]["bounds"]["rows"][OURS] if score.startswith("KL ")]


def unreliable(row: Row) -> str:
    """Return the share of sequences with a k-hat above 0.7; too few particles give no k-hat."""
    khat = row.of("bounds").values(KHAT)
    return f"{100 * float((khat > 0.7).mean()):.0f} %" if latents(row) and np.isfinite(khat).all() else "–"


def bounds(cases: Mapping[str, Row], section: Section, note: str) -> Table:
    """Return a table of bounds by case, best first."""
    baseline = cases.get(BASELINE)
    columns: dict[str, Callable[[Row], str]] = {
        f"nats a {section.unit}, K = {section.particles}": lambda row: score_cell(row, "bounds", BOUND),
        f"minus {BASELINE}": lambda row: "–" if baseline in (None, row) else score_cell(row, "bounds", BOUND, baseline),
        "ELBO": lambda row: score_cell(row, "bounds", ELBO),
        FIVO: lambda row: score_cell(row, "bounds", FIVO),
        "KL": lambda row: ", ".join(f"{mean(row, 'bounds', score):.2f}" for score in latents(row)) or "–",
        "k-hat > 0.7": unreliable,
        "weights": lambda row: f"{row.runs[0]['parameters']:,}",
        "s a fit": lambda row: f"{np.mean([run['seconds'] for run in row.runs]):.0f}",
    }
    return tabled(ordered(cases, lambda row: -mean(row, "bounds", BOUND)), columns, note=note)


def forecast_table(cases: Mapping[str, Row], note: str) -> Table:
    """Return a table of forecast scores by case and reference, best CRPS first; only draws have intervals."""
    first = [run for row in cases.values() for run in row.runs if len(run["forecasts"]["rows"]) > 1]
    references = {name: Row(first, name, trained=False) for run in first for name in run["forecasts"]["rows"]}
    rows = {**cases, **{name: row for name, row in references.items() if name != OURS}}
    columns = {score: partial(score_cell, part="forecasts", score=score) for score in SHOWN}
    return tabled(ordered(rows, lambda row: mean(row, "forecasts", "CRPS")), columns, note=note)


def sound(cases: Mapping[str, Row]) -> Table:
    """Return a table of the SI-SDR of resynthesis by case, best first."""
    order = ordered(cases, lambda row: -mean(row, "sound", SDR))
    lines = [
        [name, score_cell(row, "sound", SDR), f"{REVIEW[name]:.1f}"] for name, row in order.items() if latents(row)
    ]
    return Table(["", "SI-SDR, dB", "the review's, of other speech"], lines, "Resynthesis from the posterior.")


def tables(runs: Path, part: str) -> dict[str, Table]:
    """Return the tables of the scores on a part."""
    available = {}
    for name, section in SECTIONS.items():
        cases = read(runs / name, section.cases, f"{part}.json")
        if not cases:
            continue
        first, cut = next(iter(cases.values())).runs, section.forecast
        scores, minutes = first[0]["bounds"], sum(run["seconds"] for row in cases.values() for run in row.runs) / 60
        size = f"{len({*scores['clips']})} sequences, {sum(scores['weights'])} steps"
        note = f"{part.capitalize()}: {size}; {len(first)} seeds; "
        note += f"all fits took {minutes:.0f} minutes of processor time."
        available[f"domains/{name}-bounds"] = bounds(cases, section, note)
        if "sound" in first[0]:
            available[f"domains/{name}-sound"] = sound(cases)
        if "forecasts" in first[0]:
            note = f"Forecasts of {cut.horizon} steps from {cut.observed}, {FORECASTS} draws."
            available[f"domains/{name}-forecasts"] = forecast_table(cases, note)
    return available


def main(
    domains: tuple[str, ...] = ("chorales",),
    runs: Path = Path("runs/domains"),
    results: Path | None = None,
    part: Literal["validation", "test"] = "validation",
    cases: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (0,),
) -> None:
    """Fit, score, and write the tables.

    Args:
        domains: names of domains to fit; empty to write the tables only.
        runs: folder of the runs.
        results: folder of the tables, such as benchmarks/results; None prints them.
        part: split to score and to show in the tables.
        cases: names of cases to fit; all cases of a domain if empty.
        seeds: seeds of the runs to fit.
    """
    torch.set_num_threads(1)
    for name in domains:
        measure(runs / name, cases or SECTIONS[name].cases, seeds, partial(run, Data(name), part), f"{part}.json")
    write(results, tables(runs, part))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
