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
    row_label,
    training_cells,
    work,
)
from .results import DOCS, Table, refuse_unknown, write


def published() -> dict[str, dict[str, dict[str, str]]]:
    """Read the published tables by name: rows by name, cells by column."""
    tables: dict[str, dict[str, dict[str, str]]] = {}
    for name, printed in settings(str(Path(__file__).with_name("published"))).items():
        lines = (line.split("|") for line in printed["rows"].splitlines())
        columns = printed["columns"].split(",")
        tables[name] = {row.strip(): dict(zip(columns, cells.split(), strict=True)) for row, cells in lines}
    return tables


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
        return [
            *(self.views if row in self.rows else ()),
            *(view for named_row, view in self.apart.values() if named_row == row),
        ]


@dataclass(frozen=True)
class Paper:
    """A paper's tables.

    Args:
        set: name in `SETS` of the set to fit the rows on.
        rows: options of the method by row, as in `ranking.FUTURES`; the first row is the paper's method.
        columns: columns of each table of scores, by name of the table.
        changes: pairs of rows to compare.
        compared: columns of the table of changes.
        printed: rows of the paper.
        views: views of all rows; each number of given paths has its own line.
        further: views of some rows.
        large: rows that take days on a CPU; they are fitted on a GPU only, or if they are named.
    """

    set: str
    rows: Mapping[str, Mapping[str, Any]]
    columns: Mapping[str, Sequence[str]]
    changes: Sequence[tuple[str, str]]
    compared: Sequence[str]
    printed: Mapping[str, Mapping[str, str]]
    views: Sequence[View] = (View(),)
    further: Sequence[Further] = ()
    large: Sequence[str] = ()

    def views_of(self, row: str) -> list[View]:
        """Return all views of a row."""
        return list(dict.fromkeys([*self.views, *(view for each in self.further for view in each.views_of(row))]))


def read_further(
    views: Sequence[Mapping[str, Any]],
    printed: str = "",
    apart: Mapping[str, Any] = MappingProxyType({}),
    **fields: Any,
) -> Further:
    """Return further views from their table in the TOML file."""
    separate = {called: (row, View(**view)) for called, (row, view) in apart.items()}
    return Further(views=[View(**view) for view in views], printed=PUBLISHED.get(printed, {}), apart=separate, **fields)


def paper(name: str, fields: Mapping[str, Any]) -> Paper:
    """Return a paper's tables from their table in the TOML file."""
    rows = {row: {**(FUTURES | PATHS).get(row, {}), **options} for row, options in fields["rows"].items()}
    views = {
        "views": [View(**view) for view in fields["views"]],
        "further": [read_further(**each) for each in fields["further"]],
    }
    return Paper(printed=PUBLISHED[name], **{**fields, **views, "rows": rows})


PAPERS = {name: paper(name, fields) for name, fields in settings(__file__).items()}


RowsByView = Mapping[View, Mapping[str, Row]]


def scores(
    rows_by_view: RowsByView, columns: Sequence[str], published_rows: Mapping[str, Mapping[str, str]], note: str = ""
) -> Table:
    """Return a table of rows in each view, followed by published rows; references use no given paths."""
    lines = []
    views = list(rows_by_view)
    condition = "given" if views[0].given is not None else "observed" if views[0].observed else ""
    for row in dict.fromkeys(row for each in rows_by_view.values() for row in each):
        row_views = [view for view in views if row in rows_by_view[view]]
        for view in (
            row_views[:1] if condition == "given" and not rows_by_view[row_views[0]][row].trained else row_views
        ):
            entry = rows_by_view[view][row]
            has_value = entry.trained or condition != "given"
            value = [str(vars(view)[condition]) if has_value else ""] if condition else []
            lines.append(
                [row_label(row, entry), *value, *training_cells(entry), *map(cell, map(entry.estimate, columns))]
            )
    for row, cells in published_rows.items():
        if all(cells.get(column, "–") == "–" for column in columns):
            continue
        name, _, printed = row.rpartition(", ") if condition else (row, "", "")
        value = [printed] if condition else []
        lines.append([f"*{name}*", *value, "", "", *(cells.get(column, "–") for column in columns)])
    return Table(["", *([condition] if condition else []), *TRAINED, *columns], lines, note)


def changes(rows_by_view: RowsByView, paper: Paper) -> Table:
    """Return a table of paired differences; columns are scores, or views if there are several."""

    def change(view: View, pair: tuple[str, str], column: str) -> str:
        with_change, without_change = (rows_by_view[view].get(row) for row in pair)
        if with_change is None or without_change is None:
            return "–"
        change = with_change.estimate(column, without_change)
        return "–" if change is None else str(change)

    note = "What each change does, paired."
    pairs = [pair for pair in paper.changes if all(pair[0] in each for each in rows_by_view.values())]
    if len(rows_by_view) == 1:
        (view,) = rows_by_view
        lines = [[*pair, *(change(view, pair, column) for column in paper.compared)] for pair in pairs]
        return Table(["", "minus", *paper.compared], lines, note)
    lines = [
        [*pair, column, *(change(view, pair, column) for view in rows_by_view)]
        for pair in pairs
        for column in paper.compared
    ]
    return Table(["", "minus", "score", *(f"{view.given} given" for view in rows_by_view)], lines, note)


def more_joints(rows_by_view: RowsByView, paper: Paper) -> Table:
    """Return a table of paired differences for each additional path."""
    views, lines = list(rows_by_view), []
    for row in paper.rows:
        if all(row in each for each in rows_by_view.values()):
            steps = [
                (rows_by_view[more][row], rows_by_view[fewer][row])
                for more, fewer in zip(views[1:], views, strict=False)
            ]
            for column in paper.compared:
                differences = (more.two_way_errors(column, fewer) for more, fewer in steps)
                lines.append([row, column, *(cell(each and each.estimate()) for each in differences)])
    header = [f"{JOINTS[view.given]} too" for view in views[:-1] if view.given is not None]
    return Table(["", "score", *header], lines, "What each further path does, paired.")


PATHED = ("ADE", "FDE", "energy score")
"""Scores in the picture, by number of paths."""


@styled
def draw_scores(rows_by_view: RowsByView, paper: Paper) -> Figure:
    """Draw scores by number of given paths of rows with as many steps as the first, over the seeds with all numbers.

    Intervals are over clips and seeds.
    """
    figure, (first, *_) = new_figure(7, 2.9), paper.rows.values()
    drawn = [row for row, options in paper.rows.items() if options.get("steps") == first.get("steps")]
    for panel, column in zip(figure.subplots(1, len(PATHED)), PATHED, strict=True):
        for row in (NEIGHBOURS, *drawn):
            entries_by_count = {view.given: rows[row] for view, rows in rows_by_view.items() if row in rows}
            common = min((len(entry.runs) for entry in entries_by_count.values()), default=0)
            estimates = {
                count: replace(each, runs=each.runs[:common]).estimate(column)
                for count, each in entries_by_count.items()
            }
            scores = {count: score for count, score in estimates.items() if score is not None}
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
            default = [row for row in paper.rows if accelerator == "cuda" or row not in paper.large]
            selected = {row: options for row, options in paper.rows.items() if row in (rows or default)}
            views = {row: paper.views_of(row) for row in selected}
            work(data, runs, stored, paper.set, selected, views, seeds, samples, accelerator)
        rows_by_view = {view: entries(stored, paper.set, view, paper.rows) for view in paper.views}
        tables = {key: scores(rows_by_view, columns, paper.printed) for key, columns in paper.columns.items()}
        tables["changes"] = changes(rows_by_view, paper)
        if len(rows_by_view) > 1:
            tables["further-paths"] = more_joints(rows_by_view, paper)
            if results is not None:
                more = (view for each in paper.further for view in each.views if view == View(view.given))
                more_rows = {view: entries(stored, paper.set, view, paper.rows) for view in more}
                draw_scores(rows_by_view | more_rows, paper).savefig(pictures / f"{name}.png", dpi=200)
        for each in paper.further:
            more_rows = {view: rows for view in each.views if (rows := entries(stored, paper.set, view, each.rows))}
            for called, (row, view) in each.apart.items():
                if own := entries(stored, paper.set, view, [row]).get(row):
                    more_rows |= {view: more_rows.get(view, {}) | {called: own}}
            for key, columns in ({"": each.columns} if each.columns else paper.columns).items() if more_rows else ():
                tables[f"{each.name}-{key}".strip("-")] = scores(more_rows, columns, each.printed, each.caption)
        folder = name.replace("-", "_")
        write(results, {f"{folder}/{key}": table for key, table in tables.items() if table.rows})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
