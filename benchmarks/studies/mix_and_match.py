"""Fits and scores what docs/results/mix_and_match.md compares, how noise enters a forecast, and writes its tables.

Every run has a directory under `--runs`, and measured.json in it: the script goes on where it was stopped, skips what
is there, and two of it may work on other seeds at once (`--seeds 0`, `--seeds 1 2`). Tables are of what is there.
"""

from __future__ import annotations

import itertools
import json
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch.distributions import Normal

import dvae
from dvae import motion
from dvae.inference.bounds.probe import Redrawn
from dvae.inference.evaluation.estimates import Crossed, Estimate
from dvae.inference.evaluation.held import reproducibly
from dvae.inference.evaluation.record import plain
from dvae.inference.evaluation.result import canvas
from dvae.inference.evaluation.scores import Measure
from dvae.inference.training.checkpoints import LAST, load_weights
from dvae.models.motion.codes import CodeDiversity, code_diversity
from dvae.motion.geometry.euler import COUNTS, TIMES, euler_errors
from dvae.motion.judges.quality import STILL, RealOrMade, quality
from dvae.program.batch import rows

from .engine import folder, said
from .pages import DOCS, table, write

NAMED: dict[str, dict[str, Any]] = {
    "mix": {},
    "concatenate": {"noise": "concatenate"},
    "add": {"noise": "add"},
    "step": {"noise": "step", "scale": 0.1},
    "mix, velocity": {"velocity": True},
    "no noise": {"alpha": 0.0},
    "no noise, velocity": {"alpha": 0.0, "velocity": True},
}
"""What is compared on all data. "mix" has alpha = 1/2, and a curriculum over half of the steps."""
ALPHAS = (0.1, 0.3, 0.5, 0.7, 0.9)
TUNING = "bandai2-tuning"
OPTIONS: dict[str, Any] = {"width": 128, "scale": 0.01}
"""Of all runs, chosen on the tuning protocol; others are those of the method."""
TRAINING: dict[str, Any] = {"batch_size": 32, "learning_rate": 2e-3, "decay": 0.5}
JUDGED: dict[str, Any] = {"width": 64}
JUDGE: dict[str, Any] = {"optimizer": "adam", "learning_rate": 2e-3, "momentum": 0.0, "batch_size": 128}
PROBE, NOTHING = {"z": Normal(50.0, 50**0.5)}, {"z": Normal(0.0, 1e-6)}
SCORES = ("APD", "ADE", "FDE", "jerk")
OURS, PROBED, UNSAID = "ours", "probed", "unsaid"
FITTED, MEASURED, HEARD = "fitted.json", "measured.json", "heard.json"
BODY = (
    *("hip", "abdomen", "chest", "neck", "head"),
    *(side + joint for side in "lr" for joint in ("Collar", "Shldr", "ForeArm", "Hand")),
    *(side + joint for side in "lr" for joint in ("Buttock", "Thigh", "Shin", "Foot", "FootEnd")),
)
"""Joints of cgspeed's conversion of CMU's recordings, without eyes and fingers."""


@dataclass(frozen=True)
class Budget:
    """What a run may cost.

    Args:
        steps: of training.
        every: test windows of bandai2, each so many-th.
        samples: futures of each.
        examples: windows of each kind that a judge of quality is fitted to.
        judged: steps of its optimiser.
        observations: whose codes are watched.
        futures: of "mix, velocity", the most of whose errors of angles the best is taken; of others it is the samples.
        thinned: of these windows each so many-th has errors of angles.
    """

    steps: int = 1000
    every: int = 10
    samples: int = 50
    examples: int = 4000
    judged: int = 400
    observations: int = 50
    futures: int = 500
    thinned: int = 4


def swept(alpha: float, curriculum: bool) -> str:
    """The name of a case of the sweep over alpha."""
    return f"alpha {alpha:g}" if curriculum else f"alpha {alpha:g}, no curriculum"


SWEEP: dict[str, dict[str, Any]] = {
    swept(alpha, curriculum): {"alpha": alpha, **({} if curriculum else {"curriculum": 0.0})}
    for curriculum in (True, False)
    for alpha in ALPHAS
}
SWEEP |= {
    f"{name}, scale 0.03": {**SWEEP[name], "scale": 0.03}
    for name in (swept(ALPHAS[-1], True), swept(ALPHAS[-1], False))
}
WEIGHTS = {
    f"{way}, scale {scale:g}": {**NAMED[way], "scale": scale}
    for way, scales in {"mix": (0.03, 0.1, 0.3), "concatenate": (0.03, 0.1, 0.3), "step": (0.01, 0.3, 1.0)}.items()
    for scale in scales
}
"""What the weight of the KL does, 2 scale^2 / D beside mean squared errors of D numbers."""
SCHEDULES = {
    "mix, KL almost free": {"scale": 0.001},
    "mix, no annealing": {"annealing": 0.0},
    "mix, no curriculum": {"curriculum": 0.0},
    "mix, true poses": {"feeding": 0.0},
    "mix, no schedule": {"annealing": 0.0, "curriculum": 0.0, "feeding": 0.0},
}
"""What it is that moves the codes of "mix" in training: the KL, or one of three schedules."""


@dataclass(frozen=True)
class Section:
    """What the page compares with one another.

    Args:
        protocol: of the windows.
        cases: name to options.
        share: of the steps of training.
    """

    protocol: str
    cases: Mapping[str, Mapping[str, Any]]
    share: float = 1.0

    def steps(self, budget: Budget) -> int:
        """Of a run."""
        return max(round(self.share * budget.steps), 1)


RAW = "cmu-bvh"
SECTIONS = {
    TUNING: Section(TUNING, NAMED),
    "bandai2-by-style": Section("bandai2-by-style", NAMED),
    RAW: Section(RAW, NAMED, 0.5),
    "alpha": Section(TUNING, SWEEP, 0.5),
    "weight of the KL": Section(TUNING, WEIGHTS),
    "schedules": Section(TUNING, SCHEDULES),
}


def recorded(path: Path) -> motion.MotionSet:
    """Turns as files have them: clips of BVH at 30 frames a second, of each the last third for test.

    The rest pose that they start in, and the frames that settle out of it, are left out. Headers give all clips 120
    frames a second, which is twice too many for salsa_10 (see the notes of the data).
    """
    people = [
        motion.read_motion(file, joints=BODY, fps=60 if file.stem == "salsa_10" else None).resampled(30)
        for file in sorted(path.rglob("*.bvh"))
    ]
    if not people:
        sys.exit(f"there is no .bvh file in {path}")
    clips = [clip.between(3, clip.frames) for each in people for clip in each]
    return replace(people[0], clips=clips, name=RAW).divided(1 / 3, 75)


def windows(name: str, data: Path | None, raw: Path | None, every: int) -> dict[str, motion.Windows]:
    """Training and test windows under a protocol; none where there are no data."""
    if name == RAW:
        cut = replace(motion.PROTOCOLS["cmu8"], name=name, train_stride=1, test_stride=2)
    else:
        cut = motion.PROTOCOLS[name]
        cut = replace(cut, test_stride=every * cut.test_stride)
    file = raw if name == RAW else data
    if file is None:
        return {}
    people = recorded(file) if name == RAW else motion.read_motion(file)
    cut = replace(cut, representation="quaternion")
    return {split: motion.windows(people, cut, split) for split in ("train", "test")}


def method_of(options: Mapping[str, Any]) -> Any:
    """The method of a case."""
    return dvae.method("mix-and-match", **{**OPTIONS, **options})


def fitted(
    options: Mapping[str, Any], windows: Mapping[str, motion.Windows], seed: int, out: Path, budget: Budget
) -> tuple[Any, dict[str, Any]]:
    """A model, fitted, or gone on with where it was stopped; and what was seen on the way."""
    method = method_of(options)
    torch.manual_seed(seed)
    model = method.build(windows["train"])
    watch = CodeDiversity(observations(windows["test"], budget), every=max(budget.steps // 15, 1))
    start = time.process_time()
    result = dvae.fit(
        model,
        method.train(windows["train"], None, budget.steps),
        out=out,
        resume=(out / "state.json").exists(),
        seed=seed,
        callbacks=[watch],
        progress=False,
        validate_every=max(budget.steps // 3, 1),
        config=method.config(),
        **TRAINING,
    )
    if (out / FITTED).exists():
        return model.eval(), json.loads((out / FITTED).read_text())
    steps, diversity = result.series("codes/diversity")
    late = [row["kl/z"] for row in result.history if "kl/z" in row and row["step"] > 0.9 * budget.steps]
    seen = {
        "seconds": time.process_time() - start,
        "steps": steps,
        "codes": {"diversity": diversity, "deviation": result.series("codes/deviation")[1]},
        "KL": float(np.mean(late)) if late else None,
    }
    (out / FITTED).write_text(json.dumps(seen))
    return model.eval(), seen


def some_scores(held: Any) -> list[Measure]:
    """Those of motion that the tables have."""
    return [measure for measure in motion.scores(held) if measure.name in SCORES]


def measured(case: str, model: Any, windows: Mapping[str, motion.Windows], seed: int, budget: Budget) -> dict[str, Any]:
    """Scores of a run by clip, and in the runs of "mix" those of zero velocity."""
    test, noise, full = windows["test"], not case.startswith("no noise"), case in NAMED
    models = {OURS: model, **({PROBED: Redrawn(model, PROBE)} if noise and full else {})}
    options: dict[str, Any] = {"seed": seed, "progress": False}
    samples = budget.samples if noise else 1
    scored = dvae.evaluate(models, test, scores=some_scores, samples=samples, batch_size=64, **options)
    judged = quality(
        {OURS: model},
        windows["train"],
        test,
        method=RealOrMade(**JUDGED),
        examples=budget.examples,
        steps=budget.judged,
        seeds=(seed,),
        references=case == "mix",
        **options,
        **JUDGE,
    )
    most = budget.futures if case == "mix, velocity" else samples
    counts = [count for count in COUNTS if count <= most]
    fewer = test.with_protocol(replace(test.protocol, test_stride=budget.thinned * test.protocol.test_stride))
    angles = euler_errors({OURS: model}, fewer, counts=counts, **options) if full else None
    futures = {
        name: {
            **{score: row[score][0].tolist() for score in row},
            **{score: scored.rows[name].clip_means[score].tolist() for score in SCORES},
        }
        for name, row in judged.rows.items()
    }
    return {
        "futures": {**futures, "clips": scored.clips},
        "angles": {**{name: plain(angles.rows[name].clip_means) for name in futures}, "clips": angles.clips}
        if angles
        else None,
        "jerk": next(note for note in scored.notes if note.startswith("jerk")),
        PROBED: scored.ratio(PROBED, OURS, "APD").mean if PROBED in models else None,
    }


def heard(model: Any, windows: Mapping[str, motion.Windows], seed: int, budget: Budget) -> dict[str, float]:
    """What z and what the drawn indices make of it, where both differ from draw to draw.

    "latent" is the diversity of codes with indices drawn once, in units of that with all drawn, and "indices" that of
    futures with z at 0, whose indices alone differ, likewise.
    """
    test = windows["test"]
    past = observations(test, budget)
    with reproducibly(model, seed):
        drawn, once = (code_diversity(model, batch).mean() for batch in (past, model.read(past)))
    fewer = test.with_protocol(replace(test.protocol, test_stride=budget.thinned * test.protocol.test_stride))
    models = {OURS: model, UNSAID: Redrawn(model, NOTHING)}
    found = dvae.evaluate(
        models, fewer, scores=some_scores, samples=budget.samples, batch_size=64, seed=seed, progress=False
    )
    return {"latent": float(once / drawn), "indices": found.ratio(UNSAID, OURS, "APD").mean}


def observations(test: motion.Windows, budget: Budget) -> Any:
    """The pasts of some windows, evenly over all of them."""
    some = torch.linspace(0, len(test) - 1, min(budget.observations, len(test))).long()
    return rows(test.all().past(test.protocol.observed), some)


def run(
    cases: Mapping[str, Mapping[str, Any]],
    windows: Mapping[str, motion.Windows],
    seeds: Sequence[int],
    path: Path,
    budget: Budget,
) -> None:
    """Fits and measures what is not there yet."""
    for seed, (case, options) in itertools.product(seeds, cases.items()):
        out = path / f"{folder(case)}-{seed}"
        if not (out / MEASURED).exists():
            model, seen = fitted(options, windows, seed, out, budget)
            found = {**seen, **measured(case, model, windows, seed, budget)}
            (out / MEASURED).write_text(json.dumps(found))
            print(f"{out}: fitted in {seen['seconds']:.0f} s of processor time", flush=True)
        method = method_of(options)
        if method.noise == "mix" and method.alpha and not (out / HEARD).exists():
            model = method.build(windows["train"])
            load_weights(model, out / LAST)
            (out / HEARD).write_text(json.dumps(heard(model.eval(), windows, seed, budget)))


def measurements(out: Path) -> dict[str, Any]:
    """Of a run."""
    beside = out / HEARD
    return json.loads((out / MEASURED).read_text()) | (json.loads(beside.read_text()) if beside.exists() else {})


@dataclass(frozen=True)
class Case:
    """The runs of one way over seeds, or what a reference scores beside them."""

    runs: list[dict[str, Any]]
    row: str = OURS

    @classmethod
    def read(cls, path: Path, cases: Iterable[str]) -> dict[str, Case]:
        """Those that are there, by name, behind zero velocity."""
        found = {
            case: [measurements(file.parent) for file in sorted(path.glob(f"{folder(case)}-[0-9]*/{MEASURED}"))]
            for case in cases
        }
        read = {case: cls(runs) for case, runs in found.items() if runs}
        return {**({STILL: cls(found["mix"], STILL)} if found.get("mix") else {}), **read}

    def estimate(self, score: str) -> Estimate:
        """Mean over clips and seeds."""
        part = "angles" if "ms" in score else "futures"
        weights = np.array(list(self.runs[0][part]["clips"].values()))
        return Crossed.of(np.array([run[part][self.row][score] for run in self.runs]), weights).estimate()

    def said(self, score: str, digits: int = 3) -> str:
        """Mean, and its errors over clips and over seeds."""
        return said(self.estimate(score), digits)

    def interval(self, score: str) -> str:
        """Of 95 %, within what percentages can be."""
        low, high = np.clip(self.estimate(score).interval(), 0, 100)
        return "–" if np.isnan(low) else f"{low:.1f} to {high:.1f}"

    def number(self, name: str) -> str:
        """One number of a run."""
        values = [run.get(name) for run in self.runs]
        return "–" if None in values else spread(values)

    def codes(self, of: Callable[[Sequence[float]], float]) -> str:
        """One number of how diverse codes were over training."""
        return spread([of(run["codes"]["diversity"]) for run in self.runs])


def spread(values: Sequence[float]) -> str:
    """Their mean, the least and the greatest."""
    return f"{np.mean(values):.2f} ({min(values):.2f}, {max(values):.2f})"


def scored(cases: Mapping[str, Case]) -> str:
    """Ways down, scores of futures across."""
    header = ["", "quality (%)", "95 %", "taken for real (%)", "APD (m)", "ADE (m)", "FDE (m)", "jerk (m/s³)"]
    lines = [
        [
            name,
            case.said("quality", 1),
            case.interval("quality"),
            case.said("taken for real", 1),
            *(case.said(score) for score in ("APD", "ADE", "FDE")),
            case.said("jerk", 1),
        ]
        for name, case in cases.items()
    ]
    return table(header, lines)


def listening(cases: Mapping[str, Case]) -> str:
    """Ways that have noise down; across, what tells whether it is heard."""
    header = ["", "codes, first", "greatest", "least", "last", "indices held", "KL (nats/frame)"]
    header += ["APD, z probed", "APD, z at 0"]
    lines = [
        [
            name,
            *(case.codes(of) for of in (itemgetter(0), max, min, itemgetter(-1))),
            case.number("latent"),
            *(case.number(name) for name in ("KL", PROBED, "indices")),
        ]
        for name, case in cases.items()
        if case.row == OURS and any(run["codes"]["diversity"][-1] for run in case.runs)
    ]
    return table(header, lines)


def angles(cases: Mapping[str, Case]) -> str:
    """Ways and numbers of futures down, times across."""
    lines = []
    for name, case in cases.items():
        counts = {"mix, velocity": COUNTS, STILL: (1,)}.get(name, (1, 50))
        for count in counts:
            if all(f"{TIMES[0]:g} ms, best of {count}" in run["angles"][case.row] for run in case.runs):
                cells = [case.said(f"{time:g} ms, best of {count}", 2) for time in TIMES]
                lines.append([name, str(count), *cells])
    return table(["", "best of", *(f"{time:g} ms" for time in TIMES)], lines)


def draw(cases: Mapping[str, Case], alphas: Mapping[str, Case], file: Path) -> None:
    """Codes over training, one panel for each way; and quality against diversity."""
    ways = {name: case for name, case in cases.items() if name in NAMED and case.runs[0]["codes"]["diversity"][-1] > 0}
    figure = canvas(14, 3)
    *panels, last = figure.subplots(1, len(ways) + 1)
    for panel, (name, case) in zip(panels, ways.items(), strict=True):
        for run in case.runs:
            mean, spread = (np.array(run["codes"][key]) for key in ("diversity", "deviation"))
            (line,) = panel.plot(run["steps"], mean)
            panel.fill_between(run["steps"], mean - spread, mean + spread, color=line.get_color(), alpha=0.15, lw=0)
        panel.set_ylim(0)
        panel.set_title(f"{name}: codes", fontsize=9)
        panel.set_xlabel("step")
    for place, (label, curriculum) in enumerate((("curriculum", True), ("no curriculum", False))):
        found = {alpha: alphas[name] for alpha in ALPHAS if (name := swept(alpha, curriculum)) in alphas}
        points = [(case.estimate("APD").mean, case.estimate("quality").mean) for case in found.values()]
        if points:
            last.plot(*zip(*points, strict=True), marker="o", markersize=4, color=f"C{place}", label=f"alpha, {label}")
            for alpha, point in zip(found, points, strict=True):
                last.annotate(f"{alpha:g}", point, fontsize=7, xytext=(3, 3), textcoords="offset points")
    for place, name in enumerate(ways):
        point = ways[name].estimate("APD").mean, ways[name].estimate("quality").mean
        last.plot(*point, marker="s", linestyle="", color=f"C{place + 2}", label=name)
    last.set_ylim(0)
    last.set_xlabel("APD (m)")
    last.set_title("quality (%)", fontsize=9)
    figure.legend(*last.get_legend_handles_labels(), loc="outside right center", fontsize=7, frameon=False)
    figure.savefig(file, dpi=110)


def main(
    data: Path | None = None,
    raw: Path | None = None,
    runs: Path = Path("runs/mix-and-match"),
    page: Path = DOCS / "results" / "mix_and_match.md",
    picture: Path = DOCS / "img" / "mix_and_match.png",
    sections: tuple[str, ...] = tuple(SECTIONS),
    cases: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (0, 1, 2),
    budget: Budget = Budget(),
) -> None:
    """Fit, score, and write the tables.

    Args:
        data: motion file with file groups (bandai2.npz); where it lacks, nothing is fitted for its protocols.
        raw: folder of BVH files of CMU's recordings; likewise.
        runs: where runs are kept.
        page: where the tables stand.
        picture: of codes over training, and of quality against diversity.
        sections: of the page, to fit.
        cases: to fit, by name; all of a section where none is named.
        seeds: of the runs to fit.
        budget: what a run may cost.
    """
    torch.set_num_threads(1)
    for name, section in ((name, SECTIONS[name]) for name in sections):
        if found := windows(section.protocol, data, raw, budget.every):
            chosen = {case: section.cases[case] for case in cases or section.cases}
            run(chosen, found, seeds, runs / folder(name), replace(budget, steps=section.steps(budget)))
    parts = []
    there = {name: Case.read(runs / folder(name), section.cases) for name, section in SECTIONS.items()}
    for name, read in ((name, read) for name, read in there.items() if read):
        first = next(iter(read.values())).runs[0]
        held, seconds = first["futures"]["clips"], [run["seconds"] for case in read.values() for run in case.runs]
        said = (
            f"{sum(held.values())} windows of {len(held)} clips; {first['jerk']}. {SECTIONS[name].steps(budget)} steps "
        )
        said += f"of training, {min(seconds):.0f} to {max(seconds):.0f} s of processor time."
        parts += [
            f"## {name}\n",
            f"{said}\n",
            scored(read),
            listening(read),
            *([angles(read)] if first["angles"] else []),
        ]
    write(page, *parts)
    if there[TUNING]:
        draw(there[TUNING], there["alpha"], picture)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
