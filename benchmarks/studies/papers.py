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


def printed(columns: str, text: str) -> dict[str, dict[str, str]]:
    """A table of a paper: rows by their names, cells by columns."""
    lines = (line.split("|") for line in text.strip().splitlines())
    return {name.strip(): dict(zip(columns.split(","), cells.split(), strict=True)) for name, cells in lines}


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
ANOTHERS = printed(
    "APD,ADE,FDE",
    """
    Human3.6M: TrajeVAE, 1 | 5.373 .370 .476
    Human3.6M: TrajeVAE, 2 | 5.400 .362 .472
    Human3.6M: TrajeVAE, 3 | 5.096 .375 .491
    Human3.6M: TrajeVAE, 4 | 4.175 .332 .433
    """,
)
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
        printed(
            "ACC content,FID content,APD,ADE,FDE,MMADE,MMFDE,ADEm,FDEm,MMADEm,MMFDEm",
            """
            HumanEva-I: real motion | .883 – – – – – – – – – –
            HumanEva-I: DLow | .527 3.472 4.853 .248 .262 .361 .337 .577 .717 .646 .753
            HumanEva-I: GSPS | .516 1.604 5.825 .233 .244 .343 .311 .686 .794 .735 .825
            HumanEva-I: HiT-DVAE | .726 .089 4.721 .282 .261 .335 .290 .579 .665 .610 .683
            HumanEva-I: no scheduled sampling | .696 .359 4.777 .314 .300 .358 .315 .596 .708 .624 .727
            HumanEva-I: no attention | .729 .264 3.921 .265 .243 .348 .295 .510 .604 .569 .650
            HumanEva-I: no w | .740 .306 4.244 .287 .263 .360 .303 .535 .662 .591 .689
            HumanEva-I: neither | .765 1.262 .023 .538 .621 .594 .660 .538 .622 .595 .662
            Human3.6M: real motion | .855 – – – – – – – – – –
            Human3.6M: DLow | .659 1.412 11.741 .425 .518 .495 .531 .896 1.284 .948 1.289
            Human3.6M: GSPS | .650 2.030 14.757 .389 .496 .476 .525 1.013 1.372 1.065 1.381
            Human3.6M: HiT-DVAE | .700 1.708 8.942 .472 .505 .497 .514 .804 1.034 .812 1.028
            Human3.6M: no scheduled sampling | .650 1.751 10.339 .477 .513 .501 .519 .867 1.108 .877 1.101
            Human3.6M: no attention | .705 1.475 7.189 .537 .569 .555 .567 .805 1.060 .826 1.056
            Human3.6M: no w | .711 1.565 6.249 .528 .582 .557 .590 .735 .942 .753 .942
            Human3.6M: neither | .642 .659 2.688 .752 .892 .787 .896 .897 1.184 .934 1.186
            """,
        ),
        further=(
            Further("Other lengths of what is observed, in frames", (View(observed=5), View(observed=30)), (HIT,)),
            Further(
                "Contents in groups, by a judge of their own",
                (View(judges="content+group"),),
                (HIT, "gsps", "dlow"),
                (*GROUPED, "ACC content", "FID content"),
                printed(
                    "ACC group,FID group,ACC content,FID content",
                    """
                    Human3.6M: real motion | .855 – .481 –
                    Human3.6M: DLow | .659 1.412 .227 1.566
                    Human3.6M: GSPS | .650 2.030 .222 1.915
                    Human3.6M: HiT-DVAE | .700 1.708 .281 1.466
                    """,
                ),
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
        printed(
            "APD,ADE,FDE,MMADE,MMFDE,pose NLL",
            """
            Human3.6M: ERD | 0 .722 .969 .776 .995 –
            Human3.6M: acLSTM | 0 .789 1.126 .849 1.139 –
            Human3.6M: Pose-Knows | 6.723 .461 .560 .522 .569 –
            Human3.6M: MT-VAE | .403 .457 .595 .716 .883 –
            Human3.6M: HP-GAN | 7.214 .858 .867 .847 .858 –
            Human3.6M: BoM | 6.265 .448 .533 .514 .544 –
            Human3.6M: GMVAE | 6.769 .461 .555 .524 .566 –
            Human3.6M: DeLiGAN | 6.509 .483 .534 .520 .545 –
            Human3.6M: DSF | 9.330 .493 .592 .550 .599 –
            Human3.6M: DLow | 11.741 .425 .518 .495 .531 –
            Human3.6M: GSPS | 14.757 .389 .496 .476 .525 74.872
            Human3.6M: no pose prior | 15.257 .389 .497 .477 .527 251.186
            Human3.6M: no angles | 19.608 .397 .534 .506 .575 97.774
            Human3.6M: no diversity | 6.318 .370 .488 .478 .529 64.731
            Human3.6M: no reconstruction | 20.030 .479 .562 .513 .569 89.726
            Human3.6M: no multimodal | 18.079 .394 .538 .520 .587 91.977
            HumanEva-I: ERD | 0 .382 .461 .521 .595 –
            HumanEva-I: acLSTM | 0 .429 .541 .530 .608 –
            HumanEva-I: Pose-Knows | 2.308 .269 .296 .384 .375 –
            HumanEva-I: MT-VAE | .021 .345 .403 .518 .577 –
            HumanEva-I: HP-GAN | 1.139 .772 .749 .776 .769 –
            HumanEva-I: BoM | 2.846 .271 .279 .373 .351 –
            HumanEva-I: GMVAE | 2.443 .305 .345 .408 .410 –
            HumanEva-I: DeLiGAN | 2.177 .306 .322 .385 .371 –
            HumanEva-I: DSF | 4.538 .273 .290 .364 .340 –
            HumanEva-I: DLow | 4.855 .251 .268 .362 .339 –
            HumanEva-I: GSPS | 5.826 .233 .244 .343 .331 103.306
            HumanEva-I: no pose prior | 7.574 .245 .293 .416 .430 363.847
            HumanEva-I: no angles | 6.569 .235 .276 .406 .410 119.673
            HumanEva-I: no diversity | 2.048 .214 .259 .384 .398 75.375
            HumanEva-I: no reconstruction | 6.778 .567 .625 .606 .633 109.777
            HumanEva-I: no multimodal | 6.474 .234 .283 .415 .421 113.630
            """,
        ),
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
                printed(
                    ",".join(PARTED),
                    """
                    Human3.6M: BoM with parts | 0 4.408
                    Human3.6M: DLow, lower held | 1.071 12.741
                    Human3.6M: DLow, 50 of 1,000 | .780 7.280
                    Human3.6M: GSPS | 0 13.150
                    HumanEva-I: BoM with parts | 0 1.319
                    HumanEva-I: DLow, lower held | .937 4.671
                    HumanEva-I: DLow, 50 of 1,000 | .571 1.821
                    HumanEva-I: GSPS | 0 5.096
                    """,
                ),
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
        printed(
            "APD,ADE,FDE,MMADE,MMFDE",
            """
            Human3.6M: TrajeVAE, 0 | 8.462 .518 .678 .596 .703
            Human3.6M: TrajeVAE, 1 | 6.641 .463 .602 .581 .672
            Human3.6M: TrajeVAE, 2 | 6.334 .450 .581 .581 .668
            Human3.6M: TrajeVAE, 3 | 5.037 .375 .488 .579 .664
            Human3.6M: TrajeVAE, 4 | 4.069 .325 .428 .584 .674
            Human3.6M: + masked poses, 0 | 8.936 .539 .724 .616 .748
            Human3.6M: + masked poses, 1 | 6.803 .472 .623 .594 .695
            Human3.6M: + masked poses, 2 | 6.286 .448 .587 .587 .681
            Human3.6M: + masked poses, 3 | 4.861 .361 .474 .585 .674
            Human3.6M: + masked poses, 4 | 3.857 .312 .412 .594 .689
            Human3.6M: + cosine transform, 0 | 9.483 .560 .742 .634 .762
            Human3.6M: + cosine transform, 1 | 7.014 .487 .637 .602 .703
            Human3.6M: + cosine transform, 2 | 6.561 .465 .604 .594 .688
            Human3.6M: + cosine transform, 3 | 5.367 .389 .503 .590 .681
            Human3.6M: + cosine transform, 4 | 4.524 .338 .443 .595 .692
            Human3.6M: + learned prior, 0 | 1.860 .502 .694 .611 .740
            Human3.6M: + learned prior, 1 | 1.749 .448 .622 .618 .753
            Human3.6M: + learned prior, 2 | 1.719 .418 .577 .616 .750
            Human3.6M: + learned prior, 3 | 1.725 .327 .449 .632 .767
            Human3.6M: + learned prior, 4 | 1.720 .281 .385 .646 .783
            Human3.6M: standard prior, 0 | 1.237 .525 .749 .634 .801
            Human3.6M: standard prior, 1 | 1.220 .481 .695 .640 .811
            Human3.6M: standard prior, 2 | 1.217 .466 .672 .642 .812
            Human3.6M: standard prior, 3 | 1.248 .376 .549 .639 .802
            Human3.6M: standard prior, 4 | 1.261 .339 .498 .641 .805
            Human3.6M: CVAE-RNN, 0 | 9.579 .611 .723 .639 .724
            Human3.6M: CVAE-RNN, 1 | 9.498 .603 .733 .647 .753
            Human3.6M: CVAE-RNN, 2 | 9.496 .588 .714 .642 .745
            Human3.6M: CVAE-RNN, 3 | 9.309 .516 .626 .614 .699
            Human3.6M: CVAE-RNN, 4 | 9.242 .459 .560 .602 .679
            Human3.6M: MoGlow, 0 | 1.786 .548 .776 .626 .803
            Human3.6M: MoGlow, 1 | 1.813 .546 .773 .625 .801
            Human3.6M: MoGlow, 2 | 1.861 .544 .768 .623 .797
            Human3.6M: MoGlow, 3 | 1.844 .540 .766 .623 .798
            Human3.6M: MoGlow, 4 | 1.858 .530 .750 .619 .790
            Human3.6M: MotionGAN, 0 | 0 1.174 1.274 1.174 1.270
            Human3.6M: MotionGAN, 1 | 0 .936 1.120 .958 1.147
            Human3.6M: MotionGAN, 2 | 0 .904 1.131 .953 1.185
            Human3.6M: MotionGAN, 3 | 0 .812 1.063 .948 1.220
            Human3.6M: MotionGAN, 4 | 0 .675 .919 .932 1.226
            Human3.6M: Motion Infilling, 0 | 0 1.203 1.209 1.197 1.207
            Human3.6M: Motion Infilling, 1 | 0 >10⁴ >10⁴ >10⁴ >10⁴
            Human3.6M: Motion Infilling, 2 | 0 >10⁴ >10⁴ >10⁴ >10⁴
            Human3.6M: Motion Infilling, 3 | 0 22.727 76.233 22.801 76.326
            Human3.6M: Motion Infilling, 4 | 0 1.067 1.220 1.258 1.468
            """,
        ),
        tuple(map(View, range(5))),
        (
            Further("More paths", tuple(map(View, (6, 8, 10, 13, 16, 19, 21))), (AGAIN,)),
            Further(
                "One motion, at the mean of the prior",
                tuple(View(count, single=True) for count in range(5)),
                (AGAIN, "6,000 steps", WHOLE, TIME, STANDARD),
                printed=printed(
                    "ADE,FDE",
                    """
                    Human3.6M: DLow, – | 1.126 1.652
                    Human3.6M: TrajeVAE, 0 | .529 .779
                    Human3.6M: TrajeVAE, 1 | .491 .735
                    Human3.6M: TrajeVAE, 2 | .477 .710
                    Human3.6M: TrajeVAE, 3 | .396 .593
                    Human3.6M: TrajeVAE, 4 | .345 .522
                    """,
                ),
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
