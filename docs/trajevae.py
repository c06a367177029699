"""Writes the tables of docs/results/trajevae.md: `python docs/trajevae.py full-0.json full-1.json cvae-rnn-0.json ...`.

The page says how the runs were fitted and scored, each by `dvae evaluate RUN --joints … --out NAME-K.json` for K given
joints, on the same windows. The tables stand between two marks; the text around them is written by hand.
"""

import sys
from pathlib import Path

from evaluations import write
from family import table

import dvae

PAGE = Path(__file__).parent / "results" / "trajevae.md"
METRICS = ("APD", "ADE", "FDE", "MMADE", "MMFDE", "path error", "global ADE", "bone-length error")


def read(files: list[str]) -> dict[str, dict[int, dvae.Evaluation]]:
    """Name to the number of given joints to the evaluation."""
    found: dict[str, dict[int, dvae.Evaluation]] = {}
    for file in files:
        evaluation = dvae.Evaluation.load(file)
        found.setdefault(Path(file).stem.rpartition("-")[0], {})[len(evaluation.data.get("given", []))] = evaluation
    every = [each for by_count in found.values() for each in by_count.values()]
    if any(_same(each) != _same(every[0]) for each in every):
        sys.exit("these evaluations differ in clips, protocol, samples, seed or options")
    return found


def _same(evaluation: dvae.Evaluation) -> tuple[object, ...]:
    return evaluation.clips, evaluation.protocol, evaluation.samples, evaluation.seed, evaluation.options


def scores(found: dict[str, dict[int, dvae.Evaluation]]) -> str:
    """Runs and numbers of given joints down, metrics across; references once."""
    rows = []
    first = next(iter(next(iter(found.values())).values()))
    for name, row in first.rows.items():
        if not row.config:
            rows.append([name, "", *(str(first[name].get(metric, "–")) for metric in METRICS)])
    for name, by_count in found.items():
        for count, evaluation in sorted(by_count.items()):
            (own,) = (method for method, row in evaluation.rows.items() if row.config)
            rows.append([name, str(count), *(str(evaluation[own].get(metric, "–")) for metric in METRICS)])
    return table(["", "given", *METRICS], rows)


def steps(found: dict[str, dict[int, dvae.Evaluation]], metrics: tuple[str, ...] = ("APD", "ADE")) -> str:
    """What each further given joint changes, paired."""
    rows = []
    for name, by_count in found.items():
        for count in sorted(by_count)[1:]:
            if count - 1 not in by_count:
                continue
            more, fewer = by_count[count], by_count[count - 1]
            ours = [next(method for method, row in each.rows.items() if row.config) for each in (more, fewer)]
            joined = dvae.Evaluation(
                **{**vars(more), "rows": {"more": more.rows[ours[0]], "fewer": fewer.rows[ours[1]]}}
            )
            added = ", ".join(set(more.data["given"]) - set(fewer.data.get("given", [])))
            rows.append(
                [
                    name,
                    f"{count - 1} to {count} ({added})",
                    *(str(joined.difference("more", "fewer", m)) for m in metrics),
                ]
            )
    return table(["", "given", *metrics], rows)


if __name__ == "__main__":
    evaluations = read(sys.argv[1:])
    write(PAGE, scores(evaluations), steps(evaluations))
