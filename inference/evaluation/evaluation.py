"""Evaluations: scores of several methods on the same windows, with the settings of the measurement."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from rich.text import Text
from typing_extensions import override

from ...data.sequences import axis_names
from ...options import nearest
from ..diagnostics.calibration import envelope
from .estimates import clustered_variance, decimals, effective_number, linearised, student_interval
from .record import MODELS, Dims
from .result import Result, Table, new_figure, styled
from .scores import Metric

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SKILL = Metric("", "free-running", "higher")
HEADLINES = ("CRPS", "energy score")
"""Proper scores that skill is computed from; the first one that an evaluation has is used."""
FIRST = ("skill", *HEADLINES, "coverage 90 %", "width 90 %")
"""Scores that a table shows, with the next ones, if it has columns for some only."""
ARROWS = {"lower": " ↓", "higher": " ↑", "": ""}
"""Arrow for each direction that is better."""
COLUMNS = 5
"""Largest number of columns of a table. More methods are in rows, and then only these scores are shown by default."""
_MOST_RANKS = 10_000  # the envelope of so many ranks takes a second


@dataclass(frozen=True)
class Score:
    """Mean over windows, or score of the whole set, with its standard error, clustered (NaN for one cluster).

    Args:
        mean: mean over windows.
        standard_error: standard error of the mean.
        freedom: degrees of freedom of the error, the number of clusters minus one.
    """

    mean: float
    standard_error: float
    freedom: float = field(default=math.nan, compare=False)

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return the confidence interval of the mean by Student's t; NaN if the error is unknown."""
        return student_interval(self.mean, self.standard_error, self.freedom, level)

    def __str__(self) -> str:
        if math.isnan(self.mean):
            return "–"
        places = decimals(self.mean, self.standard_error)
        error = f" ± {self.standard_error:.{places}f}" if self.standard_error > 0 else ""
        return f"{self.mean:.{places}f}{error}"


@dataclass(frozen=True, eq=False)
class Row:
    """Scores of one method by cluster.

    Args:
        samples: K, number of forecasts of each window.
        cluster_means: `{score: (C,)}`, the values of `Measure.pool`.
        equations: generative and inference factorization of a model.
        config: configuration of the method.
        histograms: `{histogram: (C, bins)}`, shares of the bins.
        counts: `{score: (C,)}`, numbers of windows with a score, for scores that some windows lack.
    """

    samples: int
    cluster_means: Annotated[dict[str, np.ndarray], Dims("cluster", name="{}")]
    equations: dict[str, str] = field(default_factory=dict)
    config: dict[str, Any] = field(default_factory=dict)
    histograms: Annotated[dict[str, np.ndarray], Dims("cluster", "bin", name="histogram of {}")] = field(
        default_factory=dict
    )
    counts: Annotated[dict[str, np.ndarray], Dims("cluster", name="windows with {}", kind=int)] = field(
        default_factory=dict
    )

    @property
    def is_reference(self) -> bool:
        """Whether this row is neither a model nor forecasts that the user gave."""
        return not (self.equations or self.config)


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation(Result):
    """Scores of several methods on the same windows, with the settings of the measurement.

    Indexing returns the scores of a method: `evaluation["srnn"]["CRPS"].mean`.

    Attributes:
        rows: `{method: Row}`.
        metrics: metric of each score that at least one method has, in the order of the table.
        clusters: `{"split/cluster": number of its windows}`, in the order of `Row.cluster_means`.
        data: fingerprint, number of windows, steps and coordinates of a window, and the windows' description.
        protocol: fields of the windows' protocol.
        samples: K, number of forecasts requested from every method.
        emission: "mean" or "drawn": whether forecasts were means of p(x_t | ...) or draws from it; "drawn or mean" if
            discrete models were drawn and others not; "given" if there are only forecasts of other software.
        bound_particles: number of particles of the IWAE bound, 0 if it was not computed.
        seed: seed of every method's draws.
        log_score_particles: number of particles of the log score, 0 if it was not computed.
        basis: inputs of scores by name, such as the weights of a metric model or a ground truth.
        notes: lines below the table on how to read scores.
        options: further arguments of the models' `forecast`.

    Example:
        >>> model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2})
        >>> windows = dvae.ArrayWindows(torch.randn(6, 8, 2), observed=4)
        >>> scores = dvae.evaluate(model, windows, samples=5, progress=False)
        >>> list(scores.rows), scores.difference("model", "last value", "CRPS").mean < 0
        (['last value', 'model'], True)
    """

    rows: Annotated[dict[str, Row], MODELS]
    metrics: dict[str, Metric]
    clusters: dict[str, int]
    data: dict[str, Any]
    protocol: dict[str, Any]
    samples: int
    emission: str
    bound_particles: int
    seed: int
    log_score_particles: int = 0
    basis: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    options: dict[str, Any] = field(default_factory=dict)

    def __getitem__(self, method: str) -> dict[str, Score]:
        return {name: self._score(name, means) for name, means in self._row(method).cluster_means.items()}

    def difference(self, first: str, second: str, metric: str) -> Score:
        """Return the mean paired difference of two methods in a metric, first minus second, with its standard error.

        Args:
            first, second: names of the methods.
            metric: name of the score, such as "CRPS".

        Raises:
            KeyError: when a method was not evaluated, or one of the two has no such metric.
        """
        values, other = self._both(first, second, metric)
        return self._score(metric, values - other)

    def ratio(self, first: str, second: str, metric: str) -> Score:
        """Return the ratio of two methods' means in a metric, first divided by second, with its linearised error.

        Args:
            first, second: names of the methods.
            metric: name of the score, such as "APD".

        Raises:
            KeyError: as `difference`.
            ValueError: when the second mean is 0.
        """
        values, other = self._both(first, second, metric)
        numerator, denominator = (self._score(metric, means).mean for means in (values, other))
        if not denominator:
            raise ValueError(f"the mean {metric} of {second} is 0, so the ratio is undefined; use difference")
        return self._score(metric, numerator / denominator + (values - numerator / denominator * other) / denominator)

    @property
    def headline(self) -> str | None:
        """Proper score that skill is computed from: CRPS, or else the energy score; None if there is neither."""
        return next((name for name in HEADLINES if name in self.metrics), None)

    @property
    def best_reference(self) -> str | None:
        """Reference row with the lowest headline score; None without one.

        Reference rows with a score of 0 are true futures, and are not considered.
        """
        if self.headline is None:
            return None
        scores = {name: self[name].get(self.headline) for name, row in self.rows.items() if row.is_reference}
        means = {name: score.mean for name, score in scores.items() if score is not None and score.mean > 0}
        return min(means, key=means.__getitem__, default=None)

    @property
    def scores(self) -> dict[str, Metric]:
        """Scores that a table may show: skill, if there is a reference row, and all metrics."""
        return ({} if self.best_reference is None else {"skill": SKILL}) | self.metrics

    def skill(self, method: str) -> Score:
        """Return 1 - score / score of the best reference row in the headline score, with its paired linearised error.

        Args:
            method: name of a method.

        Raises:
            KeyError: when the method was not evaluated or has no headline score, or there is no reference row.
        """
        if self.headline is None or self.best_reference is None:
            raise KeyError("skill needs a reference row and one of the scores CRPS and energy score")
        if method == self.best_reference:
            return Score(0.0, 0.0)
        ratio = self.ratio(method, self.best_reference, self.headline)
        return Score(1 - ratio.mean, ratio.standard_error, ratio.freedom)

    @property
    def verdicts(self) -> list[str]:
        """Sentences on the models that do not beat the best reference row by two standard errors."""
        sentences, best, score = list[str](), self.best_reference, self.headline
        if best is None or score is None:
            return []
        for name in [name for name, row in self.rows.items() if not row.is_reference and score in row.cluster_means]:
            skill, values = self.skill(name), f"{score} {self[name][score]} against {self[best][score]}"
            if skill.mean < -2 * skill.standard_error:
                sentences.append(f"{name} is worse than {best} ({values})")
            elif not skill.mean > 2 * skill.standard_error:  # or the error is unknown
                reason = "its error is unknown" if len(self.clusters) == 1 else "within two standard errors"
                sentences.append(f"{name} is not shown to be better than {best} ({values}; skill {skill}, {reason})")
        return sentences

    def _both(self, first: str, second: str, metric: str) -> list[np.ndarray]:
        """Return the values of two methods by cluster."""
        means = []
        for method in (first, second):
            row = self._row(method)
            if metric not in row.cluster_means:
                suggestion = nearest(metric, row.cluster_means)
                raise KeyError(f"{method!r} has no score {metric!r}{suggestion}; it has {', '.join(row.cluster_means)}")
            means.append(row.cluster_means[metric])
        return means

    @override
    def table(self, metrics: Sequence[str] | None = None) -> Table:
        """Return a table of mean ± standard error: metrics in rows, methods in columns, by kind of score.

        The first is "skill" (`skill`), if there is a reference row. If there are more than five methods, methods are in
        rows.

        Args:
            metrics: names of the metrics to include, in any order; default: all, or five if methods are in rows.

        Raises:
            KeyError: when no method has a metric.
        """
        known, omitted, in_rows = self.scores, list[str](), len(self.rows) > COLUMNS
        for name in metrics or ():
            if name not in known:
                raise KeyError(f"no method has a score {name!r}{nearest(name, known)}")
        if metrics is None and in_rows:
            order = [name for name in dict.fromkeys([*FIRST, *known]) if name in known]
            metrics, omitted = order[:COLUMNS], order[COLUMNS:]
        table = Table(title=self._title(), caption=self._caption(metrics, omitted))
        table.add_column("", no_wrap=True)  # on a narrow terminal numbers wrap, and names do not
        scores = {method: self[method] for method in self.rows}
        selected = {name: metric for name, metric in known.items() if metrics is None or name in metrics}
        if "skill" in selected:
            scores = {
                method: row | ({"skill": self.skill(method)} if self.headline in row else {})
                for method, row in scores.items()
            }
        by_program = {
            program: {name: metric for name, metric in selected.items() if metric.program == program}
            for program in ("free-running", "teacher-forced")
        }
        if in_rows:
            ordered = [*by_program["free-running"], *by_program["teacher-forced"]]
            for name in ordered:
                metric = selected[name]
                lines = (
                    name + ARROWS[metric.better],
                    metric.unit,
                    "" if metric.program == "free-running" else metric.program,
                )
                table.add_column("\n".join(filter(None, lines)), justify="right")
            for method, row in scores.items():
                values = (str(row[name]) if name in row else "–" for name in ordered)
                table.add_row(f"{method}, K = {self.rows[method].samples}", *values)
            return table
        for method, evaluated in self.rows.items():
            table.add_column(f"{method}\nK = {evaluated.samples}", justify="right")
        for program, of_program in by_program.items():
            if of_program:
                table.add_section()
                table.add_row(Text(program, "bold"))
            for name, metric in of_program.items():
                unit = f" ({metric.unit})" if metric.unit else ""
                values = (str(row[name]) if name in row else "–" for row in scores.values())
                table.add_row(Text.assemble(name + ARROWS[metric.better], (unit, "dim")), *values)
        return table

    @styled
    def plot(self, metrics: Sequence[str] | None = None) -> Figure:
        """Draw one panel per metric, with a dot and a bar of one standard error per method.

        Args:
            metrics: names of the metrics to draw; all by default.

        Returns:
            A matplotlib figure.
        """
        names = list(self.metrics if metrics is None else metrics)
        columns = min(3, len(names))
        rows = math.ceil(len(names) / columns)
        height = 0.7 + 0.22 * len(self.rows)
        figure = new_figure(2 + 2.2 * columns, height * rows)
        panels = list(figure.subplots(rows, columns, sharey=True, squeeze=False).flat)
        scores = {method: self[method] for method in self.rows}
        for panel, name in zip(panels, names, strict=False):
            for place, row in enumerate(scores.values()):
                if name in row:
                    error = np.nan_to_num(row[name].standard_error)
                    panel.errorbar(row[name].mean, place, xerr=error, fmt="o", markersize=4, color=f"C{place}")
            metric = self.metrics[name]
            unit = f" ({metric.unit})" if metric.unit else ""
            panel.set_title(name + ARROWS[metric.better] + unit, parse_math=False)
            panel.set_yticks(range(len(scores)), list(scores), parse_math=False)
            panel.set_ylim(len(scores) - 0.5, -0.5)
            panel.locator_params(axis="x", nbins=4)  # more ticks would overlap if values agree in many digits
            panel.grid(axis="x", alpha=0.3)
        for panel in panels[len(names) :]:
            panel.set_axis_off()
        return figure

    def departure(self, method: str, histogram: str = "PIT", alpha: float = 0.05) -> tuple[np.ndarray, ...]:
        """Return the difference between a method's PIT distribution and uniform, with a simultaneous band.

        The band is the exact envelope of independent uniform ranks (`calibration.envelope`). Ranks of one cluster
        depend on each other, so the envelope is for their effective number, estimated from their spread over clusters
        (`estimates.effective_number`). It is an approximation, unless each cluster contributes a single number. A curve
        that leaves the band at any point indicates that forecasts are not calibrated.

        Args:
            method: name of the method.
            histogram: name of its histogram.
            alpha: probability that the curve of calibrated forecasts leaves the band.

        Returns:
            Points between bins, the share of the PIT below each minus the point itself, and the lower and upper end of
            the band, `(bins - 1,)` each; the band is NaN for one cluster.

        Raises:
            KeyError: when the method or histogram does not exist.
        """
        shares = self._histogram(method, histogram).cumsum(1)[:, :-1].T
        points = np.arange(1, len(shares) + 1) / (len(shares) + 1)
        below, deviations = linearised(shares, np.array(list(self.clusters.values())))
        if len(self.clusters) == 1:
            return points, below - points, points * np.nan, points * np.nan
        n_values = (self.data["steps"] - self.protocol["observed"]) * self.data["coordinates"]
        numbers = self.data["windows"] * self.basis.get(histogram, {}).get("numbers", n_values)
        n_effective = effective_number(points, deviations, min(numbers, _MOST_RANKS))
        _, low, high = envelope(n_effective, len(points), alpha)
        return points, below - points, low - points, high - points

    @styled
    def plot_calibration(self, histogram: str = "PIT") -> Figure:
        """Draw the PIT histogram of each method, and below it the `departure` of its distribution from uniform.

        The band of the histogram is two standard errors of each bin. The band of the curve contains the whole curve
        with 95 % probability if forecasts are calibrated. Methods without a histogram, such as point forecasts, are
        omitted.

        Args:
            histogram: name of a histogram of values between 0 and 1, such as "PIT".

        Returns:
            A matplotlib figure.

        Raises:
            KeyError: when no method has the histogram.
        """
        methods = [method for method, row in self.rows.items() if histogram in row.histograms]
        if not methods:
            raise KeyError(f"no method has a histogram {histogram!r}; evaluate with scores=calibrated")
        columns = min(3, len(methods))
        rows = math.ceil(len(methods) / columns)
        figure = new_figure(0.8 + 2.4 * columns, 0.5 + 3.2 * rows)
        panels = figure.subplots(2 * rows, columns, squeeze=False, sharex=True, sharey="row")
        for panel in panels[-2:, len(methods) - columns * rows :].flat if len(methods) < columns * rows else ():
            panel.set_axis_off()
        for place, method in enumerate(methods):
            row, column = divmod(place, columns)
            top, bottom = panels[2 * row : 2 * row + 2, column]
            self._draw(top, method, histogram)
            top.set_title(textwrap.fill(f"{method}, K = {self.rows[method].samples}", 26), parse_math=False)
            points, difference, low, high = self.departure(method, histogram)
            bottom.fill_between(points, low, high, color="0.88", step="mid", linewidth=0)
            bottom.plot(points, difference, color="C0")
            bottom.axhline(0, color="0.4", linewidth=0.8)
            top.set_ylim(bottom=0)
            bottom.tick_params(labelbottom=True)
        for top, bottom in panels[:, 0].reshape(rows, 2):
            top.set_ylabel(f"{histogram}\n/ uniform", parse_math=False)
            bottom.set_ylabel("ECDF\n− uniform")
        figure.suptitle(self._title(), parse_math=False)
        figure.supxlabel(f"{histogram} of the true future among the forecasts", parse_math=False)
        return figure

    @styled
    def plot_horizon(self) -> Figure:
        """Draw PIT histograms at some steps of the future, and coverage over these steps, for each method.

        Bands are two standard errors, clustered. The scores come from `scores.over_horizon`.

        Returns:
            A matplotlib figure.

        Raises:
            KeyError: when no method has a histogram of a single step.
        """
        _, step = axis_names(self.data)

        def by_step(score: str, names: Iterable[str]) -> dict[int, str]:
            """Return the names of a score by step."""
            matches = (re.fullmatch(rf"{re.escape(score)}, {re.escape(step)} (\d+)", name) for name in names)
            return {int(each[1]): each[0] for each in matches if each}

        by_method = {method: by_step("PIT", row.histograms) for method, row in self.rows.items()}
        by_method = {method: histograms for method, histograms in by_method.items() if histograms}
        if not by_method:
            raise KeyError("this evaluation has no PIT histograms of single steps; evaluate with scores=over_horizon")
        columns = max(map(len, by_method.values())) + 1
        figure = new_figure(1 + 1.5 * columns, 0.9 + 1.7 * len(by_method))
        panels = figure.subplots(len(by_method), columns, squeeze=False)
        for (*histogram_panels, coverage_panel), (method, histograms) in zip(panels, by_method.items(), strict=True):
            for panel, (place, name) in zip(histogram_panels, histograms.items(), strict=True):
                self._draw(panel, method, name)
                panel.sharey(histogram_panels[0])
                panel.set_title(f"{step} {place}")
                panel.set_xlabel("PIT")
                panel.set_xticks([0, 1])
            histogram_panels[0].set_ylim(bottom=0)
            histogram_panels[0].set_ylabel(f"{textwrap.fill(method, 18)}\nPIT / uniform", parse_math=False)
            scores = self[method]
            for order, level in enumerate((50, 80, 90)):
                covered = {place: scores[name] for place, name in by_step(f"coverage {level} %", scores).items()}
                means, errors = (
                    np.array([getattr(each, attribute) for each in covered.values()])
                    for attribute in ("mean", "standard_error")
                )
                coverage_panel.fill_between(
                    [*covered], means - 2 * errors, means + 2 * errors, color=f"C{order}", alpha=0.2, linewidth=0
                )
                coverage_panel.plot([*covered], means, color=f"C{order}")
                coverage_panel.axhline(level / 100, color=f"C{order}", linewidth=0.8, linestyle=":")
            coverage_panel.set_ylim(0, 1)
            coverage_panel.set_title("coverage")
            coverage_panel.set_xlabel(step, parse_math=False)
        figure.suptitle(self._title(), parse_math=False)
        return figure

    def _draw(self, panel: Axes, method: str, histogram: str) -> None:
        """Draw a histogram relative to uniform, with two standard errors of each bin."""
        cluster_shares = self.rows[method].histograms[histogram].T
        bins, valid = len(cluster_shares), ~np.isnan(cluster_shares[0])
        shares, deviations = linearised(cluster_shares[:, valid], np.array(list(self.clusters.values()))[valid])
        errors = np.array([math.sqrt(clustered_variance(each)) for each in deviations])
        edges = np.linspace(0, 1, bins + 1)
        low, high = (bins * (shares + reach * errors) for reach in (-2, 2))
        panel.stairs(high, edges, baseline=low, fill=True, color="0.88")
        panel.stairs(bins * shares, edges, color="C0")
        panel.axhline(1, color="0.4", linewidth=0.8)

    @override
    def summary(self) -> dict[str, Any]:
        """Return means and standard errors by method and score."""
        return {method: {name: vars(score) for name, score in self[method].items()} for method in self.rows}

    @override
    def labels(self) -> dict[str, Sequence[str]]:
        return {"cluster": [*self.clusters]}

    @override
    def check(self) -> None:
        if self.extents.get("cluster", {len(self.clusters)}) != {len(self.clusters)}:
            raise ValueError(
                f"`clusters` lists {len(self.clusters)} clusters, but arrays have {self.extents['cluster']}"
            )
        if unknown := {name for row in self.rows.values() for name in row.cluster_means} - self.metrics.keys():
            raise ValueError(f"metrics has no entry for {', '.join(sorted(unknown))}")

    def _histogram(self, method: str, name: str) -> np.ndarray:
        histograms = self._row(method).histograms
        if name not in histograms:
            has = ", ".join(histograms) or "none"
            raise KeyError(f"{method!r} has no histogram {name!r}{nearest(name, histograms)}; it has {has}")
        return histograms[name]

    def _row(self, method: str) -> Row:
        if method not in self.rows:
            raise KeyError(
                f"no method {method!r} in this evaluation{nearest(method, self.rows)}; it has {', '.join(self.rows)}"
            )
        return self.rows[method]

    def _score(self, metric: str, cluster_means: np.ndarray) -> Score:
        valid = ~np.isnan(cluster_means) if self.metrics[metric].partial else np.ones(len(cluster_means), bool)
        if not valid.any():
            return Score(math.nan, math.nan, 0)
        mean, deviations = linearised(cluster_means[valid], np.array(list(self.clusters.values()))[valid])
        return Score(float(mean), math.sqrt(clustered_variance(deviations)), len(deviations) - 1)

    def _caption(self, metrics: Sequence[str] | None, omitted: Sequence[str]) -> str:
        """Return how errors were computed, and the notes, except those that begin with a metric not in the table."""

        def describes(note: str, names: Iterable[str]) -> bool:
            subject = re.split(r"[: ]", note, maxsplit=1)[0]
            return any(name.startswith(subject) for name in names)

        others = self.metrics.keys() - set(self.metrics if metrics is None else metrics)
        notes = [note for note in self.notes if not describes(note, others) or describes(note, metrics or ())]
        freedom = f"{len(self.clusters) - 1} degrees of freedom"
        cluster, _ = axis_names(self.data)
        error = f"mean ± standard error over windows, clustered by {cluster} ({freedom}); K: forecasts of each window"
        shown = self.scores.keys() if metrics is None else {*metrics}
        lines = [error]
        if "skill" in shown:
            lines.append(
                f"skill: 1 - {self.headline} / {self.headline} of {self.best_reference}, the best reference row"
            )
        lines += [*(self.verdicts if {"skill", self.headline} & shown else ()), *notes]
        return "\n".join([*lines, f"not in this table: {'; '.join(omitted)}"] if omitted else lines)

    def _title(self) -> str:
        name = str(self.protocol.get("name", ""))
        parts = [name, f"{self.data['windows']} windows of {len(self.clusters)} {axis_names(self.data)[0]}s"]
        parts += self.data.get("title", [])
        parts += [f"{name} {value}" for name, value in self.options.items()]
        kind = "forecasts" if self.emission == "given" else "emission"
        parts += [f"{self.emission} {kind}", f"seed {self.seed}", f"data {self.data['fingerprint'][:12]}"]
        return " · ".join(part for part in parts if part)
