"""Fits and scores what docs/results/motion_latent_4d.md compares, latent spaces of gait cycles, and writes its tables.

Every run has a directory under `--runs`, and measured.json in it: the script goes on where it was stopped, skips what
is there, and two of it may work on other cases or seeds at once. Tables and pictures are of what is there.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

import dvae
from dvae import motion
from dvae.inference.evaluation.estimates import Crossed, Estimate
from dvae.inference.evaluation.held import clip_places
from dvae.inference.evaluation.record import plain
from dvae.inference.evaluation.result import canvas
from dvae.inference.evaluation.scores import clip_means
from dvae.motion.segments.dataset import SegmentData
from dvae.motion.segments.embodied import Segments
from dvae.motion.segments.interpolation import falls, interpolate
from dvae.motion.segments.reconstruction import reconstruct_segments
from dvae.runs.directory import Config

from .engine import fitted, folder, interval, said
from .pages import DOCS, table, write

TUNING, HELD = "tuning", "held out"
SAME, OTHER = "same source", "other source"
GROUPS = {"A": "train", "B": "test"}
"""Of bandai2: what trains and what judges where options are chosen, whatever the file's own split."""
TRAINING: dict[str, Any] = {"batch_size": 64, "validate_every": 250}
PAIRS, STEPS = 200, 9
"""Of walks and runs that are interpolated, and the steps of each, both ends included."""
FALLS = ("falls", "falls where the run is shorter")
OURS, MEASURED = "ours", "measured.json"
ERROR, DURATION = "vertex error", "duration error"


@dataclass(frozen=True)
class Case:
    """One way to make a latent space.

    Args:
        method: options of motion-latent.
        data: of segments.
    """

    method: Mapping[str, Any] = field(default_factory=dict)
    data: Mapping[str, Any] = field(default_factory=dict)


FULL, FIRST, SHAPED = "both phases", "first phase alone", "guide with beta"
NAMED = {FULL: Case(), FIRST: Case({"finish": 0.0}), SHAPED: Case({"shaped": True})}
WAYS = {
    "second phase alone": Case({"finish": 1.0}),
    "weights of 1": Case({"pace": 0.0}),
    "turns scaled": Case(data={"scaling": "deviation"}),
    "time warped": Case(data={"warped": True}),
    "own bodies": Case(data={"bodies": 0.0}),
    "two layers": Case({"widths": (512, 256)}),
    "three layers": Case({"widths": (1024, 512, 256)}),
}
SIZES = {f"z of {size}": Case({"latent": size}) for size in (16, 32, 128)}
WEIGHTS = {f"KL {weight:g}": Case({"kl": weight}) for weight in (0.001, 0.1, 1.0)}
SECTIONS = {TUNING: NAMED | WAYS | SIZES | WEIGHTS, HELD: NAMED}
SWEPT = {"numbers of z": {16: "z of 16", 32: "z of 32", 64: FULL, 128: "z of 128"}}
SWEPT["weight of the KL"] = {0.001: "KL 0.001", 0.01: FULL, 0.1: "KL 0.1", 1: "KL 1"}
"""What figure 3 of the paper varies, and the cases that have it."""


@cache
def segments(section: str, file: Path, **options: Any) -> SegmentData:
    """Gait cycles of bandai2 under the file's own split by take, or to choose options by."""
    people = motion.read_motion(file)
    if section == TUNING:
        groups = ((clip, GROUPS.get(clip.labels["file_group"])) for clip in people)
        people = replace(people, clips=[replace(clip, split=split) for clip, split in groups if split])
    return SegmentData(str(file), people, **options)


def elsewhere(file: Path, timed: motion.TimedFrames) -> Segments:
    """All gait cycles of a source that nothing was learned from."""
    return Segments(SegmentData.open(file).segments, timed)


def measured(model: Any, tests: Mapping[str, Segments], training: Segments, seed: int) -> dict[str, Any]:
    """Scores of a model by test set, row and take; and how walks become runs."""
    found: dict[str, Any] = {}
    for name, test in tests.items():
        scored = reconstruct_segments({OURS: model}, test, training, bound_particles=20, seed=seed, progress=False)
        places = clip_places([(split, take, 0) for split, _, take in scored.segments])
        rows = {
            row: {score: clip_means(torch.from_numpy(values), places) for score, values in scores.items()}
            for row, scores in scored.rows.items()
        }
        errors = {row: scores[ERROR] for row, scores in scored.rows.items()}
        found[name] = {"rows": rows, "takes": places.bincount().tolist(), "errors": errors}
    return {"scores": found, "interpolation": interpolated(model, next(iter(tests.values())), seed)}


def interpolated(model: Any, test: Segments, seed: int) -> dict[str, Any]:
    """Pairs of a walk and a run, drawn at random, that begin with the same foot."""
    kinds = [(labels["content"], labels["cycle"]) for labels in test.labels]
    generator = np.random.default_rng(seed)
    ends = []
    for side in ("left", "right"):
        own = [np.flatnonzero([kind == (content, side) for kind in kinds]) for content in ("walk", "run")]
        ends.append(np.stack([generator.choice(those, PAIRS // 2) for those in own]))
    first, second = (test.all().rows(some) for some in np.concatenate(ends, 1))
    found = interpolate(model, first, second, STEPS)
    lasts = [test.timed.lasts(batch["x"]) for batch in (first, second)]
    falling, shorter = falls(found.durations), (lasts[1] < lasts[0]).to(found.durations.device)
    kept = {"durations": found.durations, "displacements": found.displacements, "local": found.local_pose}
    return {
        **dict(zip(FALLS, (falling.double().mean().item(), falling[shorter].double().mean().item()), strict=True)),
        "shorter": shorter.double().mean().item(),
        **{name: values.double().mean(0).tolist() for name, values in kept.items()},
    }


def run(section: str, case: str, seed: int, out: Path, file: Path, other: Path | None, steps: int) -> None:
    """Fits and measures what is not there yet."""
    if (out / MEASURED).exists():
        return
    chosen = SECTIONS[section][case]
    data = segments(section, file, **chosen.data)
    method = dvae.method("motion-latent", **chosen.method)
    training = dvae.Training(steps=steps, seed=seed, progress=False, **TRAINING)
    config = Config(method, data.schema, data.kind, data.recorded(), training).written()
    torch.manual_seed(seed)
    model = method.build(data.schema)
    recipe = method.train(data.windows("train"), data.windows("validation"), steps)
    seconds = fitted(model, recipe, out=out, config=config, steps=steps, seed=seed, **TRAINING)
    tests = {SAME: data.windows("test")}
    if other is not None and section == HELD:
        tests[OTHER] = elsewhere(other, data.timed)
    found = measured(model.eval(), tests, data.windows("train"), seed)
    (out / MEASURED).write_text(json.dumps(plain({"seconds": seconds, "steps": steps, **found})))
    print(f"{out}: measured", flush=True)


@dataclass(frozen=True)
class Read:
    """The runs of one case over seeds, or what principal components score beside them."""

    runs: list[dict[str, Any]]
    row: str = OURS

    @classmethod
    def all(cls, path: Path, cases: Iterable[str]) -> dict[str, Read]:
        """Those that are there, by name, and what is linear beside the first of one size."""
        found: dict[str, Read] = {}
        linear: dict[str, Read] = {}
        for case in cases:
            files = sorted(path.glob(f"{folder(case)}-[0-9]*/{MEASURED}"))
            if files:
                found[case] = cls([json.loads(file.read_text()) for file in files])
                (row,) = found[case].scores(SAME)["rows"].keys() - {OURS}
                linear.setdefault(row, cls(found[case].runs, row))
        return found | linear

    def scores(self, test: str) -> dict[str, Any]:
        """Of the first seed."""
        found: dict[str, Any] = self.runs[0]["scores"][test]
        return found

    def crossed(self, test: str, score: str) -> Crossed:
        """By seeds and takes."""
        means = np.array([run["scores"][test]["rows"][self.row][score] for run in self.runs])
        return Crossed.of(means, np.array(self.scores(test)["takes"]))

    def estimate(self, test: str, score: str) -> Estimate | None:
        """Mean over segments and seeds, with errors over takes and seeds; nothing of what it does not have."""
        return self.crossed(test, score).estimate() if score in self.scores(test)["rows"][self.row] else None

    def said(self, test: str, score: str, digits: int = 1) -> str:
        """Mean, and its errors over takes and over seeds."""
        return said(self.estimate(test, score), digits)

    def errors(self, test: str) -> np.ndarray:
        """Vertex errors of all segments and seeds, in millimetres."""
        return np.concatenate([run["scores"][test]["errors"][self.row] for run in self.runs])

    def falling(self, name: str) -> str:
        """Share of pairs whose durations fall at each step, of each seed."""
        return ", ".join(f"{run['interpolation'][name]:.2f}" for run in self.runs) if self.row == OURS else "–"


def scored(cases: Mapping[str, Read], test: str) -> str:
    """Cases down, scores across; walks and runs are of the first test set alone."""
    falls = FALLS if test == SAME else ()
    header = ["", "vertex error (mm)", "95 %", "median (mm)", "duration error (ms)", "ELBO (nats/frame)", *falls]
    lines = []
    for name, case in cases.items():
        found = case.estimate(test, ERROR)
        median = f"{np.median(case.errors(test)):.1f}"
        lines.append([name, case.said(test, ERROR), interval(found), median, case.said(test, DURATION)])
        lines[-1] += [case.said(test, "ELBO"), *map(case.falling, falls)]
    return table(header, lines)


def against(cases: Mapping[str, Read], test: str) -> str:
    """Paired differences of vertex errors that should be below zero, with their intervals."""
    linear = next(name for name in cases if cases[name].row != OURS)
    lines = []
    for first, second in ((FULL, FIRST), (FULL, linear), (FIRST, linear), (SHAPED, FULL)):
        if {first, second} <= cases.keys():
            estimate = cases[first].crossed(test, ERROR).estimate(cases[second].crossed(test, ERROR))
            lines.append([f"{first} minus {second}", f"{estimate.mean:.1f}", interval(estimate)])
    return table(["", "vertex error (mm)", "95 %"], lines)


def draw(held: Mapping[str, Read], tuned: Mapping[str, Read], file: Path) -> None:
    """Boxes by Tukey of both test sets and of what is varied; and how long steps from walks to runs last."""
    tests = list(next(iter(held.values())).runs[0]["scores"]) if held else []
    figure = canvas(3.2 * (len(tests) + len(SWEPT) + 1), 3.4)
    panels = iter(figure.subplots(1, len(tests) + len(SWEPT) + 1))

    def boxes(title: str, rows: Mapping[str, np.ndarray]) -> None:
        panel = next(panels)
        panel.boxplot(list(rows.values()), widths=0.6, flierprops={"markersize": 1.5})
        panel.set_xticks(range(1, len(rows) + 1), list(rows), fontsize=7)
        panel.set_ylim(0)
        panel.set_title(title, fontsize=9)
        panel.grid(axis="y", alpha=0.3)

    for test in tests:
        rows = {name.replace(" ", "\n"): case.errors(test) for name, case in held.items() if name != SHAPED}
        boxes(f"{test}: vertex error (mm)", rows)
    for title, names in SWEPT.items():
        there = {str(value): tuned[name].errors(SAME) for value, name in names.items() if name in tuned}
        boxes(f"{title}, {TUNING} (mm)", there)
    panel = next(panels)
    for number, run in enumerate(held[FULL].runs if FULL in held else []):
        durations = run["interpolation"]["durations"]
        panel.plot(np.linspace(0, 1, len(durations)), durations, marker="o", markersize=3, label=f"seed {number}")
    panel.set_title("walk to run: seconds", fontsize=9)
    panel.legend(fontsize=7, frameon=False)
    figure.savefig(file, dpi=110)


def main(
    data: Path | None = None,
    other: Path | None = None,
    runs: Path = Path("runs/motion-latent"),
    page: Path = DOCS / "results" / "motion_latent_4d.md",
    picture: Path = DOCS / "img" / "motion_latent_4d.png",
    sections: tuple[str, ...] = tuple(SECTIONS),
    cases: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (0, 1, 2),
    steps: int = 2000,
) -> None:
    """Fit, score, and write the tables.

    Args:
        data: motion file with file groups (bandai2.npz); where it lacks, nothing is fitted.
        other: of the source that nothing is learned from (cmu8.npz).
        runs: where runs are kept.
        page: where the tables stand.
        picture: of vertex errors, and of how long segments between walks and runs last.
        sections: to fit.
        cases: to fit, by name; all of a section where none is named.
        seeds: of the runs to fit.
        steps: of training.
    """
    torch.set_num_threads(1)
    for seed, section in itertools.product(seeds, sections if data else ()):
        for case in cases or SECTIONS[section]:
            run(section, case, seed, runs / folder(section) / f"{folder(case)}-{seed}", data, other, steps)
    there = {name: Read.all(runs / folder(name), cases) for name, cases in SECTIONS.items()}
    parts = []
    for name, read in ((name, read) for name, read in there.items() if read):
        first = next(iter(read.values())).runs[0]
        seconds = [run["seconds"] or np.nan for case in read.values() for run in case.runs]
        for test, found in first["scores"].items():
            count, takes = sum(found["takes"]), len(found["takes"])
            said = f"{count} segments of {takes} takes. {first['steps']} steps of training, {np.nanmin(seconds):.0f} "
            said += f"to {np.nanmax(seconds):.0f} s of processor time."
            parts += [f"## {name.capitalize()}, {test}\n", f"{said}\n", scored(read, test), against(read, test)]
    write(page, *parts)
    draw(there[HELD], there[TUNING], picture)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
