"""Fit and score the methods of three papers with their ablations, and write tables next to the papers' numbers.

Runs are in the folders of `benchmarks.studies.ranking`, which fits the methods themselves. Options and training are the
presets', except for the changes that name a row. Ablations have fewer steps than the presets; their tables include the
full method with as few steps. Scores are stored, and an interrupted script continues. Without `--data` nothing is
fitted. Published numbers are from other data.

Sources: Bie et al., 2022, arXiv 2204.01565, tables 1 to 3 and 5; Mao, Liu and Salzmann, 2021, arXiv 2108.08422,
tables 1 to 3; Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351, tables 1 and 3 to 6, and figure 6. Its table 2 is
the list of predictors in GSPS's tables, on Human3.6M.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure

from dvae.inference.evaluation.result import new_figure, styled

from .engine import Row, cell, settings
from .ranking import (
    FUTURES,
    JOINTS,
    LEVEL,
    NEIGHBOURS,
    PATHS,
    SCORES,
    TRAINED,
    Accelerator,
    View,
    entries,
    titled,
    trained,
    work,
)
from .results import DOCS, Table, refuse_unknown, write


def published() -> dict[str, dict[str, dict[str, str]]]:
    """Tables of the papers by name: rows by their names, cells by columns."""
    found: dict[str, dict[str, dict[str, str]]] = {}
    for name, printed in settings(str(Path(__file__).with_name("published"))).items():
        lines = (line.split("|") for line in printed["rows"].splitlines())
        columns = printed["columns"].split(",")
        found[name] = {row.strip(): dict(zip(columns, cells.split(), strict=True)) for row, cells in lines}
    return found


PUBLISHED = published()


@dataclass(frozen=True)
class Further:
    """Views of some rows, with a table of their own.

    Args:
        name: name of the table.
        caption: note of the table.
        views: views of the rows.
        rows: names of the paper's rows.
        columns: scores of the table; empty for all columns of the paper.
        printed: rows of the paper.
        apart: rows with a separate view, as row and view by label.
    """

    name: str
    caption: str
    views: Sequence[View]
    rows: Sequence[str]
    columns: Sequence[str] = ()
    printed: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    apart: Mapping[str, tuple[str, View]] = field(default_factory=dict)

    def views_of(self, row: str) -> list[View]:
        """Return the views of a row in this table."""
        return [*(self.views if row in self.rows else ()), *(view for own, view in self.apart.values() if own == row)]


@dataclass(frozen=True)
class Paper:
    """A paper's tables.

    Args:
        set: of `SETS`, on which rows are fitted.
        rows: to options of the method, as of `ranking.FUTURES`; the first is the paper's own.
        columns: of each table of scores, by its name.
        changes: rows, each with the one that it is compared with.
        compared: columns of the table of changes.
        printed: rows of the paper.
        views: of all rows; those with paths have a line for each.
        further: views of some rows.
    """

    set: str
    rows: Mapping[str, Mapping[str, Any]]
    columns: Mapping[str, Sequence[str]]
    changes: Sequence[tuple[str, str]]
    compared: Sequence[str]
    printed: Mapping[str, Mapping[str, str]]
    views: Sequence[View] = (View(),)
    further: Sequence[Further] = ()

    def views_of(self, row: str) -> list[View]:
        """Return all views of a row."""
        return list(dict.fromkeys([*self.views, *(view for each in self.further for view in each.views_of(row))]))


def further(
    views: Sequence[Mapping[str, Any]], printed: str = "", apart: Mapping[str, Any] = MappingProxyType({}), **told: Any
) -> Further:
    """Views of some rows, as the file has them."""
    own = {called: (row, View(**view)) for called, (row, view) in apart.items()}
    return Further(views=[View(**view) for view in views], printed=PUBLISHED.get(printed, {}), apart=own, **told)


def paper(name: str, told: Mapping[str, Any]) -> Paper:
    """A paper's tables, as the file has them."""
    rows = {row: {**(FUTURES | PATHS).get(row, {}), **options} for row, options in told["rows"].items()}
    own = {"views": [View(**view) for view in told["views"]], "further": [further(**each) for each in told["further"]]}
    return Paper(printed=PUBLISHED[name], **{**told, **own, "rows": rows})


PAPERS = {name: paper(name, told) for name, told in settings(__file__).items()}


Found = Mapping[View, Mapping[str, Row]]


def scores(found: Found, columns: Sequence[str], beside: Mapping[str, Mapping[str, str]], note: str = "") -> Table:
    """Return a table of rows in each view, followed by published rows; references use no given paths."""
    lines = []
    views = list(found)
    what = "given" if views[0].given is not None else "observed" if views[0].observed else ""
    for row in dict.fromkeys(row for each in found.values() for row in each):
        seen = [view for view in views if row in found[view]]
        for view in seen[:1] if what == "given" and not found[seen[0]][row].trained else seen:
            entry = found[view][row]
            told = [str(vars(view)[what]) if entry.trained or what != "given" else ""] if what else []
            lines.append([titled(row, entry), *told, *trained(entry), *map(cell, map(entry.estimate, columns))])
    for row, cells in beside.items():
        if all(cells.get(column, "–") == "–" for column in columns):
            continue
        name, _, given = row.rpartition(", ") if what else (row, "", "")
        lines.append([f"*{name}*", *([given] if what else []), "", "", *(cells.get(column, "–") for column in columns)])
    return Table(["", *([what] if what else []), *TRAINED, *columns], lines, note)


def changes(found: Found, paper: Paper) -> Table:
    """Return a table of paired differences; columns are scores, or views if there are several."""

    def change(view: View, pair: tuple[str, str], column: str) -> str:
        having, lacking = (found[view].get(row) for row in pair)
        change = having.estimate(column, lacking) if having is not None and lacking is not None else None
        return "–" if change is None else str(change)

    note = "What each change does, paired."
    pairs = [pair for pair in paper.changes if all(pair[0] in each for each in found.values())]
    if len(found) == 1:
        (view,) = found
        lines = [[*pair, *(change(view, pair, column) for column in paper.compared)] for pair in pairs]
        return Table(["", "minus", *paper.compared], lines, note)
    lines = [
        [*pair, column, *(change(view, pair, column) for view in found)] for pair in pairs for column in paper.compared
    ]
    return Table(["", "minus", "score", *(f"{view.given} given" for view in found)], lines, note)


def more_joints(found: Found, paper: Paper) -> Table:
    """What each further path changes, paired."""
    views, lines = list(found), []
    for row in paper.rows:
        if all(row in each for each in found.values()):
            steps = [(found[more][row], found[fewer][row]) for more, fewer in zip(views[1:], views, strict=False)]
            for column in paper.compared:
                crossed = (more.crossed(column, fewer) for more, fewer in steps)
                lines.append([row, column, *(cell(each and each.estimate()) for each in crossed)])
    header = [f"{JOINTS[view.given]} too" for view in views[:-1] if view.given is not None]
    return Table(["", "score", *header], lines, "What each further path does, paired.")


PATHED = ("ADE", "FDE", "energy score")
"""Scores that are drawn by the number of paths."""


@styled
def drawn(found: Found, paper: Paper) -> Figure:
    """Scores by how many paths are given, of the seeds that have all, with intervals over clips, and these seeds."""
    figure = new_figure(7, 2.9)
    for panel, column in zip(figure.subplots(1, len(PATHED)), PATHED, strict=True):
        for row in (NEIGHBOURS, *paper.rows):
            own = {view.given: rows[row] for view, rows in found.items() if row in rows}
            common = min((len(entry.runs) for entry in own.values()), default=0)
            seen = {given: replace(each, runs=each.runs[:common]).estimate(column) for given, each in own.items()}
            scores = {given: score for given, score in seen.items() if score is not None}
            means = [score.mean for score in scores.values()]
            if row == NEIGHBOURS:
                panel.axhline(means[0], color="0.5", lw=1, ls="--", label=row)
            elif scores:
                errors = ("sequences" if math.isnan(score.total) else "total" for score in scores.values())
                ends = [score.interval(LEVEL, error) for score, error in zip(scores.values(), errors, strict=True)]
                panel.errorbar([*scores], means, abs(np.transpose(ends) - means), marker="o", markersize=4, label=row)
        panel.set_xlabel("paths given")
        panel.set_title(f"{column} (m)")
    figure.legend(*panel.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def main(
    runs: tyro.conf.Positional[Path],
    data: Path | None = None,
    papers: tuple[str, ...] = tuple(PAPERS),
    rows: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (0, 1, 2),
    samples: int = 50,
    stored: Path = SCORES,
    accelerator: Accelerator = "cpu",
    results: Path | None = None,
    pictures: Path = DOCS / "img",
) -> None:
    """Fit and score missing results, and write the tables.

    Args:
        runs: folder of the run directories.
        data: the folder with bandai/ and cmu/; without it nothing is fitted.
        papers: names of papers.
        rows: names of rows to fit; all rows of a paper if empty.
        seeds: seeds of each row.
        samples: number of futures of each window.
        stored: folder of scores and metric models.
        accelerator: device for training and forecasts, as in `benchmarks.studies.ranking`.
        results: folder of the tables, such as benchmarks/results; None prints them.
        pictures: folder of the pictures, drawn only with results.
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
        tables = {key: scores(found, columns, paper.printed) for key, columns in paper.columns.items()}
        tables["changes"] = changes(found, paper)
        if len(found) > 1:
            tables["further-paths"] = more_joints(found, paper)
            if results is not None:
                more = (view for each in paper.further for view in each.views if view == View(view.given))
                seen = {view: entries(stored, paper.set, view, paper.rows) for view in more}
                drawn(found | seen, paper).savefig(pictures / f"{name}.png", dpi=200)
        for each in paper.further:
            seen = {view: rows for view in each.views if (rows := entries(stored, paper.set, view, each.rows))}
            for called, (row, view) in each.apart.items():
                if own := entries(stored, paper.set, view, [row]).get(row):
                    seen |= {view: seen.get(view, {}) | {called: own}}
            for key, columns in ({"": each.columns} if each.columns else paper.columns).items() if seen else ():
                tables[f"{each.name}-{key}".strip("-")] = scores(seen, columns, each.printed, each.caption)
        folder = name.replace("-", "_")
        write(results, {f"{folder}/{key}": table for key, table in tables.items() if table.rows})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
