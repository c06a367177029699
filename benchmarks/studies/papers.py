"""Fits and scores the methods of three papers with their ablations, and writes the papers' tables with these beside.

What is fitted stands in the folders of `benchmarks.studies.ranking`, which fits the methods themselves; options and
training are those of the presets but for what a row is called after. Ablations have fewer steps than the presets, and
stand beside the full method with as few. Scores are kept, and the script goes on where it was stopped, as there;
without `--data` nothing is fitted. Printed numbers are of other data.

Sources: Bie et al., 2022, arXiv 2204.01565, tables 1 to 3 and 5; Mao, Liu and Salzmann, 2021, arXiv 2108.08422,
tables 1 to 3; Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351, tables 1 and 3 to 6, and figure 6 (table 2 is the
list of predictors that GSPS's has, on Human3.6M).
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure

from dvae.inference.evaluation.result import canvas

from .pages import DOCS, refuse_unknown, table, write
from .ranking import (
    FUTURES,
    GROUPED,
    JOINTS,
    LEVEL,
    NEIGHBOURS,
    PARTED,
    PATHS,
    SCORES,
    TRAINED,
    Accelerator,
    Entry,
    View,
    cell,
    entries,
    titled,
    trained,
    work,
)

ERRORS = ("ADE", "FDE", "MMADE", "MMFDE", "ADEm", "FDEm", "MMADEm", "MMFDEm")
REAL = ("APDE", "CMD", "limb stretch", "limb jitter", "pose NLL")


def published() -> dict[str, dict[str, dict[str, str]]]:
    """Tables of the papers by name: rows by their names, cells by columns."""
    told = tomllib.loads(Path(__file__).with_name("published.toml").read_text(encoding="utf-8"))
    found: dict[str, dict[str, dict[str, str]]] = {}
    for name, printed in told.items():
        lines = (line.split("|") for line in printed["rows"].splitlines())
        columns = printed["columns"].split(",")
        found[name] = {row.strip(): dict(zip(columns, cells.split(), strict=True)) for row, cells in lines}
    return found


PUBLISHED = published()


@dataclass(frozen=True)
class Further:
    """Views of some rows, with a table of their own.

    Args:
        caption: what it is of.
        views: the views.
        rows: of the paper's.
        columns: of that table; none for those of all its tables.
        printed: rows of the paper.
        apart: by what they are called there, rows that have a view of their own, and the view.
    """

    caption: str
    views: Sequence[View]
    rows: Sequence[str]
    columns: Sequence[str] = ()
    printed: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    apart: Mapping[str, tuple[str, View]] = field(default_factory=dict)

    def views_of(self, row: str) -> list[View]:
        """In which a row is scored for that table."""
        return [*(self.views if row in self.rows else ()), *(view for own, view in self.apart.values() if own == row)]


@dataclass(frozen=True)
class Paper:
    """A paper's tables.

    Args:
        set: of `SETS`, on which rows are fitted.
        rows: to options of the method, as of `ranking.FUTURES`; the first is the paper's own.
        columns: of each table of scores.
        changes: rows, each with the one that it is compared with.
        compared: columns of the table of changes.
        printed: rows of the paper.
        views: of all rows; those with paths have a line for each.
        further: views of some rows.
    """

    set: str
    rows: Mapping[str, Mapping[str, Any]]
    columns: Sequence[Sequence[str]]
    changes: Sequence[tuple[str, str]]
    compared: Sequence[str]
    printed: Mapping[str, Mapping[str, str]]
    views: Sequence[View] = (View(),)
    further: Sequence[Further] = ()

    def views_of(self, row: str) -> list[View]:
        """In which a row is scored."""
        return list(dict.fromkeys([*self.views, *(view for each in self.further for view in each.views_of(row))]))


HIT, COPYING = "hit-dvae", {"nearest": False, "residual": 0.0}
SHORT: dict[str, dict[str, dict[str, Any]]] = {
    "hit-dvae": {"1,200 steps": {"method": "hit-dvae", "steps": 1200}},
    "gsps": {"3,000 steps": {"method": "gsps", "steps": 3000}},
    "trajevae": {"6,000 steps": {"method": "trajevae", "steps": 6000}},
}
"""What ablations are beside: as long as what was tuned."""
WITHOUT: dict[str, dict[str, Any]] = {
    "no scheduled sampling": {"self_feeding": 0.0},
    "no attention": {"attention": False},
    "no w": {"static": 0},
    "neither": {"attention": False, "static": 0},
    "no copies": COPYING,
    "no copies, no attention": {**COPYING, "attention": False},
    "observed frames fed": {"feed_observed": True},
    "KL weights read literally": {"kl_local": 0.0067, "kl_static": 0.1},
}
"""Ablations of HiT-DVAE: the paper's, then ours."""
TERMS: dict[str, dict[str, Any]] = {
    "no pose prior": {"pose_prior": 0.0},
    "no angles": {"angles": 0.0},
    "no diversity": {"diversity": (0.0,)},
    "no reconstruction": {"reconstruction": 0.0},
    "no multimodal": {"multimodal": 0.0},
    "diversity 2 and 4": {"diversity": (2.0, 4.0)},
    "20 coefficients": {"coefficients": 20},
}
"""Of GSPS's loss, each left out by itself; and what else was asked."""
BASELINES = ("erd", "aclstm", "pose-knows", "mt-vae", "rhp", "bom", "bom-parts", "gmvae", "dsf", "dlow")
LOWER = "dlow, lower held"
FULL, WHOLE, TIME, STANDARD = "trajevae", "whole poses", "in time", "standard prior"
AGAIN = "trajevae, again"
"""Seed 0 of the full method, and 1 and 2 on another processor: their first runs were lost before all was scored."""
SIMPLER: dict[str, dict[str, Any]] = {
    WHOLE: {"complement": False},
    TIME: {"complement": False, "cosine": False, "latent": 8},
    STANDARD: {"complement": False, "cosine": False, "latent": 8, "learned_prior": False, "beta": 0.1},
}
"""TrajeVAE without what it adds, one after the other; latents of all have 480 numbers."""
EXCHANGES: dict[str, dict[str, Any]] = {
    "Another's pose, whose joints are within 1 cm, and the paths' motion as the truth": {},
    "Own poses, of the same windows": {"own": True},
    "Another's pose, and its motion as the truth, as in the public code": {"truth": "pose"},
}
ANOTHERS = PUBLISHED["trajevae, another's pose"]
PAPERS = {
    "hit-dvae": Paper(
        "bandai2-by-style",
        {
            HIT: {},
            **SHORT[HIT],
            **{name: {**SHORT[HIT]["1,200 steps"], **options} for name, options in WITHOUT.items()},
            **{row: FUTURES[row] for row in ("gsps", "dlow", "srnn")},
        },
        (("ACC content", "FID content", "APD", "energy score", *REAL), ERRORS),
        [
            *((name, "1,200 steps") for name in WITHOUT),
            ("no copies, no attention", "no copies"),
            *((name, HIT) for name in ("1,200 steps", "neither", "gsps", "dlow", "srnn")),
        ],
        ("ACC content", "FID content", "APD", "APDE", "energy score", *ERRORS[:4], "ADEm", "limb jitter"),
        PUBLISHED["hit-dvae"],
        further=(
            Further("Other lengths of what is observed, in frames", (View(observed=5), View(observed=30)), (HIT,)),
            Further(
                "Contents in groups, by a judge of their own",
                (View(judges="content+group"),),
                (HIT, "gsps", "dlow"),
                (*GROUPED, "ACC content", "FID content"),
                PUBLISHED["hit-dvae, groups"],
            ),
        ),
    ),
    "gsps": Paper(
        "bandai2-by-style",
        {
            "gsps": {},
            **SHORT["gsps"],
            **{name: {**SHORT["gsps"]["3,000 steps"], **options} for name, options in TERMS.items()},
            **{row: FUTURES[row] for row in BASELINES},
            LOWER: {"method": "dlow", "held": ("lower",)},
        },
        (("APD", "energy score", *ERRORS[:4], *REAL),),
        [(name, "3,000 steps") for name in TERMS],
        ("APD", "energy score", *ERRORS[:4], "pose NLL"),
        PUBLISHED["gsps"],
        further=(
            Further(
                "How far futures are apart, by parts of the body",
                (View(parts="free"),),
                ("gsps", "bom-parts", "dlow"),
                ("APD", *PARTED),
            ),
            Further(
                "The same where the lower body is held",
                (View(parts="held"),),
                ("gsps", "bom-parts"),
                ("APD", *PARTED),
                PUBLISHED["gsps, parts"],
                {
                    LOWER: (LOWER, View(parts="free")),  # has learned to hold it
                    "dlow, 50 of 1,000": ("dlow", View(parts="nearest")),
                },
            ),
        ),
    ),
    "trajevae": Paper(
        "bandai2-trajectories",
        {
            FULL: {},
            AGAIN: {"method": FULL},
            **SHORT[FULL],
            **{name: {**SHORT[FULL]["6,000 steps"], **options} for name, options in SIMPLER.items()},
            "cvae-rnn": {},
            "motion-infilling": PATHS["motion-infilling"],
        },
        (("APD", "energy score", *ERRORS[:4], "path error", "global ADE", *REAL[:4]),),
        [("6,000 steps", WHOLE), (WHOLE, TIME), (TIME, STANDARD), (FULL, "cvae-rnn")],
        ("ADE", "FDE", "MMFDE", "path error", "global ADE", "energy score", "APD"),
        PUBLISHED["trajevae"],
        tuple(map(View, range(5))),
        (
            Further("More paths", tuple(map(View, (6, 8, 10, 13, 16, 19, 21))), (AGAIN,)),
            Further(
                "One motion, at the mean of the prior",
                tuple(View(count, single=True) for count in range(5)),
                (AGAIN, "6,000 steps", WHOLE, TIME, STANDARD),
                printed=PUBLISHED["trajevae, one motion"],
            ),
            *(
                Further(
                    caption,
                    tuple(View(count, exchanged=0.01, **how) for count in range(1, 5)),
                    (AGAIN,),
                    printed={} if how else ANOTHERS,
                )
                for caption, how in EXCHANGES.items()
            ),
        ),
    ),
}
"""By the pages of docs/results on which their tables stand."""


Found = Mapping[View, Mapping[str, Entry]]


def scores(found: Found, columns: Sequence[str], beside: Mapping[str, Mapping[str, str]]) -> str:
    """Rows, in each view, and what is printed beside them; references know no paths."""
    lines = []
    views = list(found)
    what = "given" if views[0].given is not None else "observed" if views[0].observed else ""
    for row in dict.fromkeys(row for each in found.values() for row in each):
        seen = [view for view in views if row in found[view]]
        for view in seen[:1] if what == "given" and not found[seen[0]][row].fitted else seen:
            entry = found[view][row]
            means = [None if crossed is None else crossed.estimate() for crossed in map(entry.crossed, columns)]
            told = [str(vars(view)[what]) if entry.fitted or what != "given" else ""] if what else []
            lines.append([titled(row, entry), *told, *trained(entry), *map(cell, means)])
    for row, cells in beside.items():
        if all(cells.get(column, "–") == "–" for column in columns):
            continue
        name, _, given = row.rpartition(", ") if what else (row, "", "")
        lines.append([f"*{name}*", *([given] if what else []), "", "", *(cells.get(column, "–") for column in columns)])
    return table(["", *([what] if what else []), *TRAINED, *columns], lines)


def changes(found: Found, paper: Paper) -> str:
    """What each change does, paired: columns across, or, where there are several views, these."""

    def change(view: View, pair: tuple[str, str], column: str) -> str:
        having, lacking = (found[view][row].crossed(column) if row in found[view] else None for row in pair)
        return "–" if having is None or lacking is None else str(having.estimate(lacking))

    pairs = [pair for pair in paper.changes if all(pair[0] in each for each in found.values())]
    if len(found) == 1:
        (view,) = found
        lines = [[*pair, *(change(view, pair, column) for column in paper.compared)] for pair in pairs]
        return table(["", "minus", *paper.compared], lines)
    lines = [
        [*pair, column, *(change(view, pair, column) for view in found)] for pair in pairs for column in paper.compared
    ]
    return table(["", "minus", "", *(f"{view.given} given" for view in found)], lines)


def more_joints(found: Found, paper: Paper) -> str:
    """What each further path changes, paired."""
    views, lines = list(found), []
    for row in paper.rows:
        if all(row in each for each in found.values()):
            steps = [(found[more][row], found[fewer][row]) for more, fewer in zip(views[1:], views, strict=False)]
            for column in paper.compared:
                crossed = (more.crossed(column, fewer) for more, fewer in steps)
                lines.append([row, column, *(cell(each and each.estimate()) for each in crossed)])
    header = [f"{JOINTS[view.given]} too" for view in views[:-1] if view.given is not None]
    return table(["", "", *header], lines)


PATHED = ("ADE", "FDE", "energy score")
"""Scores that are drawn by the number of paths."""


def drawn(found: Found, paper: Paper) -> Figure:
    """Scores by how many paths are given, of the seeds that have all, with intervals over clips, and these seeds."""
    figure = canvas(11, 3)
    for panel, column in zip(figure.subplots(1, len(PATHED)), PATHED, strict=True):
        for row in (NEIGHBOURS, *paper.rows):
            own = {view.given: rows[row] for view, rows in found.items() if row in rows}
            common = min((len(entry.seeds) for entry in own.values()), default=0)
            seen = {given: replace(entry, seeds=entry.seeds[:common]).crossed(column) for given, entry in own.items()}
            scores = {given: crossed.estimate() for given, crossed in seen.items() if crossed is not None}
            means = [score.mean for score in scores.values()]
            if row == NEIGHBOURS:
                panel.axhline(means[0], color="0.5", lw=1, ls="--", label=row)
            elif scores:
                errors = ("sequences" if math.isnan(score.total) else "total" for score in scores.values())
                ends = [score.interval(LEVEL, error) for score, error in zip(scores.values(), errors, strict=True)]
                panel.errorbar([*scores], means, abs(np.transpose(ends) - means), marker="o", markersize=4, label=row)
        panel.set_xlabel("paths given")
        panel.set_title(f"{column} (m)", fontsize=9)
    figure.legend(*panel.get_legend_handles_labels(), loc="outside right center", fontsize=8, frameon=False)
    return figure


def captioned(caption: str, made: str) -> str:
    """A table below what it is of; nothing where it has no rows."""
    return f"*{caption}:*\n\n{made}" if made.count("\n") > 2 else ""


def main(
    runs: tyro.conf.Positional[Path],
    data: Path | None = None,
    papers: tuple[str, ...] = tuple(PAPERS),
    rows: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (0, 1, 2),
    samples: int = 50,
    stored: Path = SCORES,
    accelerator: Accelerator = "cpu",
    pages: Path | None = None,
    pictures: Path = DOCS / "img",
) -> None:
    """Fit and score what is missing, and write the tables.

    Args:
        runs: where run directories lie.
        data: the folder with bandai/ and cmu/; without it nothing is fitted.
        papers: which.
        rows: of these alone; all of a paper where none is named.
        seeds: of every row.
        samples: futures of a window.
        stored: the folder of scores and judges.
        accelerator: on which to train and to forecast, as of `benchmarks.studies.ranking`.
        pages: the folder of the pages; without one tables are printed.
        pictures: the folder of the pictures, which are drawn with the pages.
    """
    refuse_unknown("paper", papers, PAPERS)
    refuse_unknown("row", rows, (row for name in papers for row in PAPERS[name].rows))
    for name in papers:
        paper = PAPERS[name]
        if data is not None:
            fitted = {row: options for row, options in paper.rows.items() if not rows or row in rows}
            views = {row: paper.views_of(row) for row in fitted}
            work(data, runs, stored, paper.set, fitted, views, seeds, samples, accelerator)
        found = {view: entries(stored, paper.set, view, paper.rows) for view in paper.views}
        tables = [scores(found, columns, paper.printed) for columns in paper.columns]
        tables.append(captioned("What each change does, paired", changes(found, paper)))
        if len(found) > 1:
            tables.append(captioned("What each further path does, paired", more_joints(found, paper)))
            if pages is not None:
                more = (view for each in paper.further for view in each.views if view == View(view.given))
                seen = {view: entries(stored, paper.set, view, paper.rows) for view in more}
                drawn(found | seen, paper).savefig(pictures / f"{name}.png", dpi=110)
        for each in paper.further:
            seen = {view: rows for view in each.views if (rows := entries(stored, paper.set, view, each.rows))}
            for called, (row, view) in each.apart.items():
                if own := entries(stored, paper.set, view, [row]).get(row):
                    seen |= {view: seen.get(view, {}) | {called: own}}
            for columns in ([each.columns] if each.columns else paper.columns) if seen else []:
                tables.append(captioned(each.caption, scores(seen, columns, each.printed)))
        write(None if pages is None else pages / f"{name.replace('-', '_')}.md", *filter(None, tables), name="rows")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
