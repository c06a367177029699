"""Fit and score models that differ in their noise, and write their tables.

Each run has a directory under `--runs`, with measured.json. An interrupted script continues and skips existing files,
and two processes may work on other seeds at once (`--seeds 0`, `--seeds 1 2`). Tables show the available files.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch.distributions import Normal

import dvae
from dvae import motion
from dvae.inference.bounds.probe import RedrawnModel
from dvae.inference.evaluation.evaluation_windows import seeded_evaluation
from dvae.inference.evaluation.record import plain
from dvae.inference.evaluation.result import new_figure, styled
from dvae.inference.evaluation.scores import Measure
from dvae.models.motion.codes import CodeDiversity, code_diversity
from dvae.motion.geometry.euler import COUNTS, TIMES, euler_errors
from dvae.motion.metric_models.quality import STILL, RealOrGenerated, quality

from .engine import OURS, Row, budget, fit_or_load, folder, measure, read, scores_of, settings, spread
from .results import DOCS, Table, tabled, write

OPTIONS: dict[str, Any] = {"width": 128, "scale": 0.01}
"""Options of all runs, selected with the tuning protocol; others have their defaults."""
TRAINING: dict[str, Any] = {"batch_size": 32, "learning_rate": 2e-3, "decay": 0.5}
STEPS, SAMPLES, EVERY, THINNED = 1000, 50, 10, 4
"""Training steps, futures, stride over test windows, and further stride for errors of angles."""
CHECKPOINTS = 500
"""Largest number of steps between two checkpoints."""
FUTURES = 500
"""Largest number of futures for the best error of angles of "mix, velocity"; SAMPLES for others."""
WATCHED = 50
"""Number of observations for the diversity of codes."""
METRIC_MODEL_OPTIONS: dict[str, Any] = {"width": 64}
METRIC_MODEL: dict[str, Any] = {"optimizer": "adam", "learning_rate": 2e-3, "momentum": 0.0, "batch_size": 128}
METRIC_MODEL |= {"examples": 4000, "steps": 400}
PROBE, NOTHING = {"z": Normal(50.0, 50**0.5)}, {"z": Normal(0.0, 1e-6)}
SCORES = ("APD", "ADE", "FDE", "jerk")
PROBED, INDICES_ONLY = "probed", "unsaid"
BODY = (
    *("hip", "abdomen", "chest", "neck", "head"),
    *(side + joint for side in "lr" for joint in ("Collar", "Shldr", "ForeArm", "Hand")),
    *(side + joint for side in "lr" for joint in ("Buttock", "Thigh", "Shin", "Foot", "FootEnd")),
)
"""Joints of cgspeed's conversion of CMU's recordings, without eyes and fingers."""


@dataclass(frozen=True)
class Section:
    """Cases that are compared with one another.

    Args:
        protocol: name of the window protocol.
        cases: options by name of the case.
        share: fraction of the training steps.
        options: options of all cases, in place of `OPTIONS`.
        training: options of training, in place of `TRAINING`.
        steps: training steps of a run, in place of the fraction.
        longer: numbers of steps of longer runs, fitted one after the other while no case reaches `until`.
        until: quality in per cent, mean over seeds, that ends the section.
    """

    protocol: str
    cases: Mapping[str, Mapping[str, Any]]
    share: float = 1.0
    options: Mapping[str, Any] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)
    steps: int = 0
    longer: Sequence[int] = ()
    until: float = 50.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "steps", self.steps or round(self.share * STEPS))


CASES = settings(__file__)
SECTIONS = {
    name: Section(**{"protocol": name, **each, "cases": CASES[each["cases"]]})
    for name, each in CASES["sections"].items()
}
NAMED, TUNING, RAW = CASES["ways"], "bandai2-tuning", "cmu-bvh"


def recorded(path: Path) -> motion.MotionSet:
    """Read the rotations of BVH clips at 30 frames a second; the last third of each clip is for test.

    Clips start after the rest pose and the frames next to it. Headers state 120 frames a second for all clips, which is
    twice the true rate of salsa_10 (see the notes of the data).
    """
    people = [
        motion.read_motion(file, joints=BODY, fps=60 if file.stem == "salsa_10" else None).resample(30)
        for file in sorted(path.rglob("*.bvh"))
    ]
    if not people:
        sys.exit(f"there is no .bvh file in {path}")
    clips = [clip.between(3, clip.frames) for each in people for clip in each]
    return replace(people[0], clips=clips, name=RAW).assign_splits(1 / 3, 75)


def data_of(protocol: str, file: Path) -> motion.MotionData:
    """Read motion as quaternions under a protocol."""
    if protocol == RAW:
        people, cut = recorded(file), replace(motion.PROTOCOLS["cmu8"], name=RAW, train_stride=1, test_stride=2)
    else:
        people, cut = motion.read_motion(file), motion.PROTOCOLS[protocol]
        cut = replace(cut, test_stride=EVERY * cut.test_stride)
    return motion.MotionData(str(file), people, replace(cut, representation="quaternion"))


def some_scores(windows: Any) -> list[Measure]:
    """Return the motion scores that the tables show."""
    return [measure for measure in motion.scores(windows) if measure.name in SCORES]


def measured(section: Section, data: motion.MotionData, case: str, seed: int, out: Path) -> dict[str, Any]:
    """Fit a case and score it by clip; runs of "mix" also score zero velocity."""
    steps, method = section.steps, dvae.method("mix-and-match", **{**OPTIONS, **section.options, **section.cases[case]})
    train, test = data.windows("train"), data.windows("test")
    fewer = test.with_protocol(replace(test.protocol, test_stride=THINNED * test.protocol.test_stride))
    some = torch.linspace(0, len(test) - 1, min(WATCHED, len(test))).long()
    past = test.all().past(test.protocol.observed).rows(some)
    watch = CodeDiversity(past, every=max(steps // 15, 1))
    every = min(max(steps // 3, 1), CHECKPOINTS)  # an interrupted run continues from the last checkpoint
    training = {**TRAINING, **section.training, "steps": steps, "validate_every": every, "callbacks": [watch]}
    fit = fit_or_load(method, data, train, out=out, seed=seed, **training)
    model, (watched, diversity) = fit.model.eval(), fit.series("codes/diversity")
    late = [row["kl/z"] for row in fit.history if "kl/z" in row and row["step"] > 0.9 * steps]

    noise, full = bool(method.alpha), case in NAMED
    options = {"seed": seed, "progress": False}
    forecasts = {**options, "scores": some_scores, "batch_size": 64}
    samples = SAMPLES if noise else 1
    models = {OURS: model, **({PROBED: RedrawnModel(model, PROBE)} if noise and full else {})}
    evaluation = dvae.evaluate(models, test, samples=samples, **forecasts)
    quality_options = {
        "method": RealOrGenerated(**METRIC_MODEL_OPTIONS),
        "seeds": (seed,),
        "references": case == "mix",
        **options,
        **METRIC_MODEL,
    }
    qualities = quality({OURS: model}, train, test, **quality_options)
    futures = {
        name: {score: row[score][0] for score in row}
        | {score: evaluation.rows[name].cluster_means[score] for score in SCORES}
        for name, row in qualities.rows.items()
    }
    measurement: dict[str, Any] = {
        "seconds": fit.processor_seconds,
        "steps": watched,
        "codes": {"diversity": diversity, "deviation": fit.series("codes/deviation")[1]},
        "KL": float(np.mean(late)) if late else None,
        "futures": scores_of(evaluation.clusters, futures),
        "jerk": next(note for note in evaluation.notes if note.startswith("jerk")),
        PROBED: evaluation.ratio(PROBED, OURS, "APD").mean if PROBED in models else None,
    }
    if full:
        counts = [count for count in COUNTS if count <= (FUTURES if case == "mix, velocity" else samples)]
        angles = euler_errors({OURS: model}, fewer, counts=counts, **options)
        measurement["angles"] = scores_of(
            angles.clusters, {name: plain(angles.rows[name].cluster_means) for name in futures}
        )
    if method.noise == "mix" and noise:
        # Ratios of diversity. Codes: indices drawn once over all drawn. Futures: z at 0, so that only indices differ,
        # over all drawn.
        with seeded_evaluation(model, seed):
            all_drawn, once = (code_diversity(model, batch).mean() for batch in (past, model.read(past)))
        indices_only = dvae.evaluate(
            {OURS: model, INDICES_ONLY: RedrawnModel(model, NOTHING)}, fewer, samples=SAMPLES, **forecasts
        )
        measurement |= {
            "latent": float(once / all_drawn),
            "indices": indices_only.ratio(INDICES_ONLY, OURS, "APD").mean,
        }
    return measurement


# Tables


def percentages(row: Row) -> str:
    """Format the interval of the quality, clipped to 0 and 100 %."""
    low, high = np.clip(row.estimate("quality").interval(), 0, 100)
    return "–" if np.isnan(low) else f"{low:.1f} to {high:.1f}"


def codes(statistic: Callable[[Any], float]) -> Callable[[Row], str]:
    """Return a column with a statistic of the diversity of codes over training."""
    return lambda row: spread([statistic(run["codes"]["diversity"]) for run in row.runs])


SCORED: dict[str, Callable[[Row], str]] = {
    "quality (%)": lambda row: row.format_score("quality"),
    "95 %": percentages,
    "taken for real (%)": lambda row: row.format_score("taken for real"),
    "APD (m)": lambda row: row.format_score("APD", 3),
    "ADE (m)": lambda row: row.format_score("ADE", 3),
    "FDE (m)": lambda row: row.format_score("FDE", 3),
    "jerk (m/s³)": lambda row: row.format_score("jerk"),
}
NOISE_COLUMNS: dict[str, Callable[[Row], str]] = {
    "codes, first": codes(itemgetter(0)),
    "greatest": codes(max),
    "least": codes(min),
    "last": codes(itemgetter(-1)),
    "indices held": lambda row: row.numbers("latent"),
    "KL (nats/frame)": lambda row: row.numbers("KL"),
    "APD, z probed": lambda row: row.numbers(PROBED),
    "APD, z at 0": lambda row: row.numbers("indices"),
}
"""Columns that show whether the decoder uses the noise."""


def rows_with_noise(rows: Mapping[str, Row]) -> dict[str, Row]:
    """Return the rows of methods with noise."""
    return {name: row for name, row in rows.items() if row.name == OURS and row.runs[0]["codes"]["diversity"][-1] > 0}


def angles(rows: Mapping[str, Row]) -> Table:
    """Return a table of errors of angles by row, number of futures and time."""
    lines = []
    for name, row in rows.items():
        for count in {"mix, velocity": COUNTS, STILL: (1,)}.get(name, (1, 50)):
            cells = [row.of("angles").format_score(f"{time:g} ms, best of {count}", 2) for time in TIMES]
            lines += [[name, str(count), *cells]] if "–" not in cells else []
    return Table(["", "best of", *(f"{time:g} ms" for time in TIMES)], lines)


def tables(name: str, rows: Mapping[str, Row], steps: int) -> dict[str, Table]:
    """Return the tables of a section, whose runs have so many steps."""
    first = next(iter(rows.values())).runs[0]
    clips, costs = first["futures"]["weights"], budget(rows.values(), steps)
    note = f"{sum(clips)} windows of {len(clips)} clips; {first['jerk']}. {costs}"
    futures = {case: row.of("futures") for case, row in rows.items()}
    named_tables = {
        "futures": tabled(futures, SCORED, note=note),
        "noise": tabled(rows_with_noise(rows), NOISE_COLUMNS),
    }
    named_tables |= {"angles": angles(rows)} if "angles" in first else {}
    return {f"mix_and_match/{folder(name)}-{kind}": table for kind, table in named_tables.items()}


@styled
def draw(cases: Mapping[str, Row], sweep: Mapping[str, Row], file: Path) -> None:
    """Draw the diversity of codes over training, one panel for each method, and quality against diversity."""
    ways = {name: row.of("futures") for name, row in rows_with_noise(cases).items()}
    rows = math.ceil((len(ways) + 1) / 3)
    figure = new_figure(7, 2.2 * rows + 0.6)
    panels = list(figure.subplots(rows, 3, squeeze=False).flat)
    for panel in panels[len(ways) + 1 :]:
        panel.set_axis_off()
    last = panels[len(ways)]
    for panel, (name, way) in zip(panels, ways.items(), strict=False):
        for run in way.runs:
            mean, deviation = (np.array(run["codes"][key]) for key in ("diversity", "deviation"))
            (line,) = panel.plot(run["steps"], mean)
            panel.fill_between(
                run["steps"], mean - deviation, mean + deviation, color=line.get_color(), alpha=0.15, lw=0
            )
        panel.set_ylim(0)
        panel.set_title(f"{name}: codes")
        panel.set_xlabel("step")

    def point(row: Row) -> tuple[float, float]:
        return row.estimate("APD").mean, row.estimate("quality").mean

    for place, label in enumerate(("curriculum", "no curriculum")):
        end = f", {label}" * place
        names = {case.removesuffix(end): case for case in sweep if case.count(",") == place and case.endswith(end)}
        points = {alpha.split()[1]: point(sweep[case].of("futures")) for alpha, case in names.items()}
        if points:
            last.plot(*zip(*points.values(), strict=True), marker="o", markersize=4, label=f"alpha, {label}")
            for alpha, where in points.items():
                last.annotate(alpha, where, xytext=(3, 3), textcoords="offset points")
    for place, (name, way) in enumerate(ways.items(), 2):
        last.plot(*point(way), marker="s", linestyle="", color=f"C{place}", label=name)
    last.set_ylim(0)
    last.set_xlabel("APD (m)")
    last.set_title("quality (%)")
    figure.legend(*last.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.savefig(file, dpi=200)


def main(
    data: Path | None = None,
    raw: Path | None = None,
    runs: Path = Path("runs/mix-and-match"),
    results: Path | None = None,
    picture: Path = DOCS / "img" / "mix_and_match.png",
    sections: tuple[str, ...] = tuple(name for name, section in SECTIONS.items() if not section.longer),
    cases: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (0, 1, 2),
    steps: int | None = None,
) -> None:
    """Fit, score, and write the tables.

    Args:
        data: motion file with file groups (bandai2.npz); without it, its protocols are not fitted.
        raw: folder of CMU's BVH files; without it, its protocol is not fitted.
        runs: folder of the runs.
        results: folder of the tables, such as benchmarks/results; None prints them.
        picture: figure of codes over training, and of quality against diversity.
        sections: sections to fit; by default all without longer runs, which need a GPU.
        cases: names of cases to fit; all cases of a section if empty.
        seeds: seeds of the runs to fit.
        steps: other number of training steps of the sections to fit, which the names of runs and tables then contain.
    """
    torch.set_num_threads(1)
    all_sections: dict[str, Section] = {}
    for name, section in SECTIONS.items():
        file = raw if section.protocol == RAW else data
        is_chosen = name in sections
        for length in dict.fromkeys([steps or section.steps, section.steps, *section.longer]):
            title = name if length == section.steps else f"{name}, {length} steps"
            all_sections[title] = replace(section, steps=length)
            if is_chosen and file is not None:
                run = partial(measured, all_sections[title], data_of(section.protocol, file))
                measure(runs / folder(title), cases or section.cases, seeds, run)
                rows = read(runs / folder(title), section.cases).values()
                best = max(row.of("futures").by_seed("quality").mean() for row in rows)
                is_chosen = not steps and best < section.until
    stored = {name: read(runs / folder(name), section.cases) for name, section in all_sections.items()}
    rows_by_section = {
        name: ({STILL: replace(rows["mix"], name=STILL)} if "mix" in rows else {}) | rows
        for name, rows in stored.items()
    }
    for name, rows in rows_by_section.items():
        if rows:
            write(results, tables(name, rows, all_sections[name].steps))
    if rows_by_section[TUNING]:
        draw(rows_by_section[TUNING], rows_by_section["alpha"], picture)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
