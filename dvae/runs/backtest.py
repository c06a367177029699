"""Backtests: methods are fitted before each of several cutoffs, and forecast the windows that follow it.

A cutoff divides a table by time (`Cut.test` as a number of steps). The scores of all cutoffs are pooled, as in the
rolling-origin evaluation of Tashman (2000). A sequence that occurs at several cutoffs is one cluster of the errors.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typing_extensions import override

from ..inference.evaluation.evaluate import evaluate
from ..inference.evaluation.evaluation import Evaluation
from ..inference.evaluation.record import MODELS, Dims
from ..inference.evaluation.result import PlainConsole, Table
from ..inference.evaluation.scores import pseudo_values
from ..inference.training.options import Training
from ..models.method import Method
from ..options import Count, nearest, require
from .directory import load
from .sweep import require_ended, sweep


@dataclass(frozen=True, eq=False, repr=False)
class Backtest(Evaluation):
    """Scores pooled over several cutoffs; errors are clustered by sequence, so a sequence is one cluster.

    A pooled score is the mean over all windows of all cutoffs. Scores that are not means over windows, such as a
    variance of the PIT, are averaged over the cutoffs, weighted by numbers of windows.

    Attributes:
        cutoffs: names of the cutoffs, in the order of time: the time of the first step to forecast, or the number of
            steps to the end.
        windows: number of windows (cutoffs, C) of each cluster.
        by_cutoff: `{method: {score: (cutoffs, C)}}`, as `Row.cluster_means`, NaN for a cluster without windows.

    Example:
        >>> dvae.Backtest.__mro__[1].__name__  # results of dvae.backtest are evaluations
        'Evaluation'
    """

    cutoffs: list[str] = field(default_factory=list)
    windows: Annotated[np.ndarray, Dims("cutoff", "cluster", kind=int)] = field(default_factory=lambda: np.ones((0, 0)))
    by_cutoff: Annotated[
        dict[str, Annotated[dict[str, np.ndarray], Dims("cutoff", "cluster", name="{} by cutoff")]], MODELS
    ] = field(default_factory=dict)

    def at(self, cutoff: str) -> Evaluation:
        """Return the evaluation of a single cutoff, without histograms.

        Args:
            cutoff: name of the cutoff, one of `cutoffs`.

        Raises:
            KeyError: if there is no such cutoff.
        """
        if cutoff not in self.cutoffs:
            raise KeyError(f"no cutoff {cutoff!r}; there are {', '.join(self.cutoffs)}")
        place = self.cutoffs.index(cutoff)
        kept = self.windows[place] > 0
        rows = {
            method: replace(
                self.rows[method],
                histograms={},
                counts={},
                cluster_means={n: v[place, kept] for n, v in scores.items()},
            )
            for method, scores in self.by_cutoff.items()
        }
        clusters = dict(zip(np.array([*self.clusters])[kept].tolist(), self.windows[place, kept].tolist(), strict=True))
        title = [*self.data.get("title", []), cutoff]
        data = {**self.data, "windows": int(self.windows[place].sum()), "title": title}
        values = {each.name: getattr(self, each.name) for each in fields(Evaluation)}
        return Evaluation(**{**values, "rows": rows, "clusters": clusters, "data": data})

    def cutoff_table(self, metric: str = "CRPS") -> Table:
        """Return a table of one score, with a line for each cutoff and a column for each method.

        Args:
            metric: name of the score.

        Raises:
            ValueError: no method has this score.
        """
        if metric not in self.metrics:
            names = ", ".join(self.metrics)
            raise ValueError(f"no score {metric!r}{nearest(metric, self.metrics)}; the scores are {names}")
        table = Table(title=f"{metric} by first step of the forecasts")
        for name in ("", *self.rows):
            table.add_column(name, justify="right" if name else "left")
        for cutoff in self.cutoffs:
            scores = self.at(cutoff)
            table.add_row(cutoff, *(str(scores[method].get(metric, "–")) for method in self.rows))
        return table

    @override
    def labels(self) -> dict[str, Sequence[str]]:
        return {**super().labels(), "cutoff": [*self.cutoffs]}

    @override
    def check(self) -> None:
        super().check()
        if self.extents["cutoff"] != {len(self.cutoffs)}:
            raise ValueError(f"`cutoffs` lists {len(self.cutoffs)} cutoffs, but arrays have {self.extents['cutoff']}")


def backtest(
    methods: Mapping[str, Method] | Sequence[Method],
    data: Any,
    cutoffs: int = 4,
    out: str | os.PathLike[str] | None = None,
    seeds: Sequence[int] = (0,),
    training: Training | Mapping[str, Any] | None = None,
    jobs: int = 1,
    *,
    step: int | None = None,
    refit: bool = True,
    progress: bool = True,
    **options: Any,
) -> Backtest:
    """Fit methods before each of several cutoffs, and score their forecasts after it.

    The last cutoff is `step` steps before the end of the data, the one before twice as many, and so on. Sequences with
    dates share the times of the cutoffs (`Cut.test`). At a cutoff, methods are fitted on the steps before it; the last
    of these, the share `validation` of the cut, select the weights. Test windows begin at the cutoff and before the
    next one. With `out`, the same call continues an interrupted backtest and keeps finished runs.

    Args:
        methods: methods with their options; a mapping also gives their names.
        data: `dvae.tables.PanelData` that are cut into windows with `observed` and `horizon` steps.
        cutoffs: number of cutoffs.
        out: directory for the runs, such as cutoff-1/srnn-seed0; by default they are deleted.
        seeds: seeds of the fits of each method. Several give one row for each, such as srnn-seed0.
        training: all training options, or those that replace each method's defaults.
        jobs: number of fits in parallel.
        step: number of steps between cutoffs, at least the horizon, which is the default.
        refit: whether to fit at every cutoff, or only at the first one. References always use all steps before a
            cutoff.
        progress: whether to show progress.
        **options: arguments of `evaluate`, such as samples=100.

    Returns:
        The pooled evaluation; its `at` and `cutoff_table` have the scores of each cutoff.

    Raises:
        ValueError: the data are whole sequences, or a cutoff leaves no windows for training, validation or test; as in
            `sweep` and `evaluate`.
        RuntimeError: a run failed; the same call retries it.
        SweepInterrupted: after Ctrl-C or SIGTERM.

    Example:
        >>> walks = torch.randn(6, 40, 1).cumsum(1).numpy()
        >>> data = dvae.tables.PanelData.of(walks, cut=dvae.tables.Cut(observed=6, horizon=3, split="time"))
        >>> method = dvae.method("autoregressive", width=4)
        >>> result = dvae.backtest([method], data, cutoffs=2, training={"steps": 2}, samples=5, progress=False)
        >>> result.cutoffs
        ['6 steps to the end', '3 steps to the end']
    """
    step = data.protocol.horizon or 1 if step is None else step
    require(Count, cutoffs=cutoffs, step=step)
    if step < (data.protocol.horizon or 1):
        raise ValueError(
            f"step is {step} and the horizon {data.protocol.horizon}; step must be at least the horizon, since the "
            "last cutoff is this number of steps before the end"
        )
    if not isinstance(training, Training):
        training = {"progress": progress, **(training or {})}
    console = PlainConsole(stderr=True, quiet=not progress)
    models: dict[str, Any] = {}
    evaluations: dict[str, Evaluation] = {}
    with tempfile.TemporaryDirectory() if out is None else nullcontext(out) as folder:
        known: Any = None
        for number in range(cutoffs):
            before = data.before(step * (cutoffs - number))
            name = before.cutoff
            console.print(f"cutoff {number + 1} of {cutoffs}: {name}", highlight=False)
            if refit or known is None:
                known = before
                results = sweep(methods, known, Path(folder) / f"cutoff-{number + 1}", seeds, training, jobs)
                require_ended(results)
                loaded = [load(result.path) for result in results]
                suffix = "" if len(seeds) > 1 else f"-seed{seeds[0]}"
                names = [run.path.name.removesuffix(suffix) for run in loaded]
                models = {name: run.model for name, run in zip(names, loaded, strict=True)}
                configs = {name: run.method.config() for name, run in zip(names, loaded, strict=True)}
            windows = replace(before, schema=replace(known.schema, cut=before.protocol)).following(step)
            evaluations[name] = evaluate(
                models,
                windows,
                training_windows=before.windows("train+validation"),
                configs=configs,
                progress=progress,
                **options,
            )
            if windows.skipped:
                evaluations[name].notes.append(f"cutoff {name} leaves out {windows.too_short}")
    return pool(evaluations, "at every cutoff" if refit else "at the first cutoff")


def pool(evaluations: Mapping[str, Evaluation], fitted: str) -> Backtest:
    """Return the evaluation pooled over cutoffs.

    Args:
        evaluations: evaluation of the same methods at each cutoff, in the order of time.
        fitted: when the methods were fitted, for a note.
    """
    first, *_ = results = list(evaluations.values())
    names = list(dict.fromkeys(name for each in results for name in each.clusters))
    place = {name: number for number, name in enumerate(names)}
    windows = np.array([[each.clusters.get(name, 0) for name in names] for each in results])

    def stack(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """Return values (cutoffs, C, ...) of the scores that all cutoffs have, NaN for a cluster without windows."""
        stacked = {}
        for name in [name for name in parts[0] if all(name in part for part in parts)]:
            stacked[name] = np.full((*windows.shape, *parts[0][name].shape[1:]), np.nan)
            for values, part, each in zip(stacked[name], parts, results, strict=True):
                values[[place[cluster] for cluster in each.clusters]] = part[name]
        return stacked

    def pooled(values: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """Return the values (C, ...) of clusters over all cutoffs (see `pseudo_values`).

        Args:
            values: values (cutoffs, C, ...) at each cutoff.
            counts: numbers of windows with a score (cutoffs, C).
        """
        known, values, counts = ~np.isnan(values), np.nan_to_num(values), np.nan_to_num(counts)
        all_windows, counts = (each.reshape(*windows.shape, *[1] * (values.ndim - 2)) for each in (windows, counts))
        all_windows, counts = all_windows * known, counts * known
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = (all_windows * values).sum(1, keepdims=True) / all_windows.sum(1, keepdims=True)
            share = counts.sum(1, keepdims=True) / all_windows.sum(1, keepdims=True)
        sums = np.where(counts > 0, share * all_windows * (values - ratio) + ratio * counts, 0.0).sum(0)
        return pseudo_values(sums, counts.sum(0), windows.sum(0))

    rows, by_cutoff = {}, {}
    for method in [name for name in first.rows if all(name in each.rows for each in results)]:
        of_method = [each.rows[method] for each in results]
        by_cutoff[method] = stack([row.cluster_means for row in of_method])
        histograms = stack([row.histograms for row in of_method])
        partial = {name for row in of_method for name in row.counts}
        counts = stack(
            [
                {name: row.counts.get(name, np.array([*each.clusters.values()])) for name in partial}
                for row, each in zip(of_method, results, strict=True)
            ]
        )
        means, shares = (
            {name: pooled(values, counts.get(name, windows)) for name, values in each.items()}
            for each in (by_cutoff[method], histograms)
        )
        totals = {name: np.nansum(each, 0).astype(int) for name, each in counts.items()}
        rows[method] = replace(of_method[0], cluster_means=means, histograms=shares, counts=totals)
    fingerprint = hashlib.sha256("".join(each.data["fingerprint"] for each in results).encode()).hexdigest()
    note = f"{len(results)} cutoffs, fitted {fitted}; first steps of the forecasts: {', '.join(evaluations)}"
    pooled_evaluation = replace(
        first,
        rows=rows,
        clusters=dict(zip(names, windows.sum(0).tolist(), strict=True)),
        data={**first.data, "windows": int(windows.sum()), "fingerprint": fingerprint},
        notes=[note, *dict.fromkeys(line for each in results for line in each.notes)],
    )
    return Backtest(**vars(pooled_evaluation), cutoffs=[*evaluations], windows=windows, by_cutoff=by_cutoff)
