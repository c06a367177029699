"""Writes the tables of docs/results/trajevae.md from evaluations.

The page says how the runs were fitted, and scored together: `dvae evaluate RUN ... --joints ... --out FILE` for each
number of given joints, for motion at the prior's mean as well, and from other windows' poses. A file is known by what
it holds, whatever its name.
"""

import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import tyro

import dvae

from .pages import DOCS, table, write

METRICS = ("APD", "ADE", "FDE", "MMADE", "MMFDE", "path error", "global ADE", "bone-length error")
SINGLE = ("ADE", "FDE", "path error", "global ADE")
STEPS = (
    ("+ learned prior", "in-time", "standard-prior"),
    ("+ cosine transform", "whole-poses", "in-time"),
    ("+ masked poses", "full", "whole-poses"),
    ("over CVAE-RNN", "full", "cvae-rnn"),
)
"""What is compared: a change, and the runs with it and without it."""

Counts = dict[int, dvae.Evaluation]


def read(files: Sequence[Path]) -> tuple[Counts, Counts, Counts]:
    """Number of given joints to the evaluation: of draws, of means and from other windows' poses."""
    groups: dict[str, Counts] = defaultdict(dict)
    for file in files:
        found = dvae.Evaluation.load(file)
        kind = "exchanged" if found.data.get("exchanged") else "means" if found.options else "draws"
        groups[kind][len(found.data.get("given", []))] = found
    for kind, each in groups.items():
        same = {
            (kind == "exchanged" or str(e.clips), str((e.protocol, e.samples, e.seed, e.options)))
            for e in each.values()
        }
        if len(same) > 1:
            sys.exit(f"evaluations of {kind} differ in clips, protocol, samples, seed or options")
    draws, means, exchanged = (dict(sorted(groups[kind].items())) for kind in ("draws", "means", "exchanged"))
    return draws, means, exchanged


def fitted(evaluation: dvae.Evaluation) -> list[str]:
    """Names of the rows that are runs."""
    return [name for name, row in evaluation.rows.items() if row.config]


def scores(found: Counts, metrics: Sequence[str], references: bool = True) -> str:
    """Runs and numbers of given joints down, metrics across; references, which know no paths, once."""
    rows = []
    for name in {name: None for each in found.values() for name in each.rows}:
        run = name in {n for each in found.values() for n in fitted(each)}
        have = {count: each for count, each in found.items() if name in each.rows}
        if run or references:
            for count, each in list(have.items())[: None if run else 1]:
                values = (str(each[name].get(metric, "–")) for metric in metrics)
                rows.append([name, str(count) if run else "", *values])
    return table(["", "given", *metrics], rows)


def more_joints(found: Counts, metrics: Sequence[str] = ("ADE", "APD")) -> str:
    """What each further given joint changes, paired."""
    counts = [(before, count) for before, count in zip(found, list(found)[1:], strict=False) if count == before + 1]
    rows = []
    for name in fitted(next(iter(found.values()))):
        for metric in metrics:
            cells = []
            for before, count in counts:
                more, fewer = found[count], found[before]
                rows_of = {"more": more.rows[name], "fewer": fewer.rows[name]}
                cells.append(str(dvae.Evaluation(**{**vars(more), "rows": rows_of}).difference(*rows_of, metric)))
            rows.append([name, metric, *cells])
    joints = [(set(found[c].data["given"]) - set(found[b].data["given"])).pop() for b, c in counts]
    return table(["", "", *(f"{b} to {c}: {joint}" for (b, c), joint in zip(counts, joints, strict=True))], rows)


def changes(found: Counts, metrics: Sequence[str] = ("ADE", "APD")) -> str:
    """What each change does, paired, by the number of given joints."""
    rows = [
        [change, metric, *(str(each.difference(having, lacking, metric)) for each in found.values())]
        for change, having, lacking in STEPS
        for metric in metrics
    ]
    return table(["", "", *(f"{count} given" for count in found)], rows)


def main(files: tyro.conf.Positional[tuple[Path, ...]], page: Path = DOCS / "results" / "trajevae.md") -> None:
    """Write the tables.

    Args:
        files: what `dvae evaluate --out` wrote.
        page: where.
    """
    draws, means, exchanged = read(files)
    write(
        page,
        scores(draws, METRICS),
        more_joints(draws),
        changes(draws),
        scores(means, SINGLE, references=False),
        scores(exchanged, METRICS, references=False),
    )


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
