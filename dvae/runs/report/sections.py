"""Sections of a report for any sequences, from the files of run directories and from held-out windows.

If a result is missing or damaged, the section shows a message, with the command that computes it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from markupsafe import Markup
from torch import Tensor

from ... import files
from ...data.batch import Batch
from ...data.sequences import HeldOutWindows
from ...factorization.graph import audit
from ...inference.diagnostics.bracket import Bracket
from ...inference.diagnostics.calibration import Calibration
from ...inference.diagnostics.checks import PredictiveChecks
from ...inference.diagnostics.reference_posterior import ReferencePosterior
from ...inference.diagnostics.stein import SteinDiscrepancy
from ...inference.evaluation.compare import compare
from ...inference.evaluation.comparison import KHAT, Comparison
from ...inference.evaluation.conformal import PredictionBands
from ...inference.evaluation.evaluation import Evaluation
from ...inference.evaluation.evaluation_windows import seeded_evaluation
from ...inference.evaluation.record import plain
from ...inference.evaluation.result import Table, error_message, literal_text, new_figure, progress_bar
from ...inference.training.checkpoints import CheckpointError, Run
from ...inference.training.fit import Fit
from ...inference.training.trackers import JSONLines
from ...options import flat
from ...program.batch import repeat
from ...program.protocols import Program
from ..ablation import Ablation
from ..directory import Loaded, in_command
from .page import Section, command, missing_part, paragraph, picture, side_by_side, tabulated

Runs = Mapping[str, Loaded]
"""Runs by name."""

LARGEST = 2**24
"""Maximum size in bytes of a result file that is shown."""

PANEL = 3.0, 2.2
"""Width and height of a small picture in inches; one fits the width of a phone, and two fit half a page."""

MOST = 24
"""Maximum number of pictures of one kind."""

STEPS = 4
"""Number of time steps of a graph."""

GRAPH = 0.75
"""Scale of a graph, at which two fit side by side."""

DRAWS = 8
"""Number of draws from the guide for each window."""

COORDINATES = 3
"""Maximum number of plotted coordinates of a latent."""


@dataclass(frozen=True)
class SelectedWindows:
    """Evenly spaced selection of held-out windows.

    Args:
        windows: all windows.
        most: maximum number of selected windows.
    """

    windows: HeldOutWindows
    most: int

    @property
    def chosen(self) -> list[int]:
        """Indices of the selected windows."""
        count = len(self.windows.keys)
        return np.unique(np.linspace(0, count - 1, min(self.most, count)).round().astype(int)).tolist()  # type: ignore[no-any-return]

    @property
    def protocol(self) -> Any:
        """Protocol of the windows."""
        return self.windows.protocol

    @property
    def keys(self) -> list[tuple[str, str, int]]:
        """(split, clip, first frame) of each selected window."""
        return [self.windows.keys[n] for n in self.chosen]

    @property
    def fingerprint(self) -> str:
        """Fingerprint of all windows."""
        return self.windows.fingerprint

    @property
    def description(self) -> Mapping[str, Any]:
        """Description of the windows."""
        return self.windows.description

    def all(self) -> Batch:
        """Return the selected windows, one in each row."""
        return Batch(self.windows.all()).rows(self.chosen)


# ------------------------------------------------------------------------------- sections from files of run directories


def overview(runs: Runs) -> Section:
    """Return the section with facts about the runs, a column for each run."""
    columns = {name: _facts(run) for name, run in runs.items()}
    table = Table()
    for name in ("", *columns):
        table.add_column(name)
    for fact in dict.fromkeys(fact for facts in columns.values() for fact in facts):
        table.add_row(fact, *(facts.get(fact, "–") for facts in columns.values()))
    return Section("Runs" if len(runs) > 1 else "Run", before=tabulated(table))


def equations(runs: Runs) -> Section:
    """Return the section with the two factorizations, their source, and the options."""

    def cell(run: Loaded) -> Markup:
        pair = (run.model.generative, run.model.inference)
        lines = [
            Markup('<p class="equation">{}</p>').format(Markup(part._repr_html_())) for part in pair if part.factors
        ]
        options = Table()
        for column in ("option", "value"):
            options.add_column(column)
        for name, value in list(flat(run.method.config()))[:200]:
            options.add_row(name, str(value)[:200])
        details = Markup("<details><summary>options</summary>{}</details>").format(tabulated(options))
        return Markup().join([*lines, paragraph(run.method.source), details])

    return Section("Equations", cells(runs, cell))


def graphs(runs: Runs) -> Section:
    """Return the section with both unrolled graphs, and the dependencies that the guide ignores."""

    def cell(run: Loaded) -> Markup:
        model = run.model
        generative = _graph_picture(model.generative.draw(STEPS, observed=model.observed), "model")
        if not model.inference.factors:
            reason = "All latents are summed out" if model.summed else "Nothing is latent"
            exact = "a lower bound of the density of x" if model.bounded else "the log evidence"
            return generative + paragraph(f"{reason}: there is no guide, and the bound is {exact}.")
        findings = audit(model.generative, model.inference, observed=model.observed, summed=model.summed)
        return (
            side_by_side(generative, _graph_picture(findings.draw(STEPS), "guide"))
            + paragraph(findings.verdict)
            + tabulated(findings.table())
        )

    explanation = (
        "Latents are open, data shaded. Dashed red: dependencies of the exact posterior that the guide ignores. "
        "Dotted: dependencies that are not needed."
    )
    return Section("Graph and audit", cells(runs, cell), explanation)


def curves(runs: Runs) -> Section:
    """Return the section with every term of the loss over the training steps."""

    def cell(run: Loaded) -> Markup:
        fit = _fit(run)
        if not fit.history:
            return missing_part("The run has no log.jsonl, which training writes; copy the whole run directory.")
        names = {name for row in fit.history for name in row}
        order = ("bound", "loss", "log_likelihood/", "kl/", "energy/")
        selected = [name for start in order for name in sorted(names) if name.startswith(start)]
        remainder = paragraph(f"And {len(selected) - MOST} more terms.") if len(selected) > MOST else ""
        return side_by_side(*(_curve(fit, name) for name in selected[:MOST])) + remainder

    explanation = "Grey: training batches. Blue: validation. Dotted: step of the best weights."
    return Section("Learning curves", cells(runs, cell), explanation)


def evaluated(runs: Runs) -> Section:
    """Return the section with scores on test windows, next to the reference rows."""

    def cell(run: Loaded) -> Markup:
        if (evaluation := _evaluation(run)) is None:
            return _missing(run, "evaluation.json", "scores", "evaluate")
        notice = Markup("The run has changed since it was scored; score it again with {}.").format(
            _command(run, "evaluate")
        )
        has_pit = any("PIT" in row.histograms for row in evaluation.rows.values())
        calibration_plot = picture(evaluation.plot_calibration(), "calibration of forecasts") if has_pit else ""
        return (
            tabulated(evaluation.table([*evaluation.scores]))
            + calibration_plot
            + (missing_part(notice) if _row(run, evaluation) is None else "")
        )

    return Section(
        "Scores",
        cells(runs, cell),
        "Scores of forecasts and bounds on test windows. Arrows show which direction is better.",
    )


def calibration(runs: Runs) -> Section:
    """Return the section with simulation-based calibration of the guide, and predictive checks."""

    def cell(run: Loaded) -> Markup:
        if (text := _record(run, "calibration.json")) is None:
            return _missing(run, "calibration.json", "calibration and no predictive checks", "check calibration")
        document, parts = json.loads(text), []
        if "calibration" in document:
            result = Calibration.of(document["calibration"])
            parts += [picture(result.plot(), result.verdict), tabulated(result.table())]
        else:
            parts += [
                paragraph("The guide was not calibrated, because the model has no latents or conditions on data.")
            ]
        if "predictive" in document:
            checks = PredictiveChecks.of(document["predictive"])
            parts += [picture(checks.plot(), "statistics of real and of replicated windows"), tabulated(checks.table())]
        return Markup().join(parts)

    explanation = (
        "Does the guide match the posterior on data simulated from the model, and do replicates match real windows?"
    )
    return Section("Calibration and predictive checks", cells(runs, cell), explanation)


def bracketed(runs: Runs) -> Section:
    """Return the section with bounds of the evidence from both sides, and the decomposed gap of the ELBO."""

    def cell(run: Loaded) -> Markup:
        if (text := _record(run, "gap.json")) is None:
            return _missing(run, "gap.json", "bounds from both sides", "check gap")
        bracket = Bracket.from_json(text)
        return picture(bracket.plot(), "bounds of the evidence from both sides") + tabulated(bracket.table())

    explanation = (
        "Distance of the evidence from the ELBO that was trained, and the part that a better guide would recover."
    )
    return Section("Evidence from both sides", cells(runs, cell), explanation)


def reference_posteriors(runs: Runs) -> Section:
    """Return the section that compares the guide with reference posteriors of some windows."""

    def cell(run: Loaded) -> Markup:
        if (text := _record(run, "posterior.json")) is None:
            return _missing(run, "posterior.json", "reference posteriors", "check posterior")
        document, parts = json.loads(text), Markup()
        kinds: dict[str, type[SteinDiscrepancy | ReferencePosterior]]
        kinds = {"stein": SteinDiscrepancy, "posterior": ReferencePosterior}
        for name in [name for name in kinds if name in document]:
            result = kinds[name].of(document[name])
            parts += picture(result.plot(), result.verdict) + tabulated(result.table())
        return parts

    explanation = "The guide compared with the posterior of the latents of some test windows."
    return Section("Guide and posterior", cells(runs, cell), explanation)


def prediction_bands(runs: Runs) -> Section:
    """Return the section with the factors of the prediction bands, and their coverage on test windows."""

    def cell(run: Loaded) -> Markup:
        if (text := _record(run, "coverage.json")) is None:
            return _missing(run, "coverage.json", "prediction bands around forecasts", "check coverage")
        bands, test_record = PredictionBands.from_json(text), _record(run, "coverage-test.json")
        content = picture(bands.plot(), "factors over the horizon") + tabulated(bands.table())
        if test_record is None:
            return content
        evaluation = Evaluation.from_json(test_record)
        for name in [name for name, metric in evaluation.metrics.items() if metric.program == "teacher-forced"]:
            del evaluation.metrics[name]  # other sections show them
            for row in evaluation.rows.values():
                row.cluster_means.pop(name, None)
        return content + tabulated(evaluation.table())

    explanation = (
        "Factors by which forecasts are widened to reach the given coverage, and the coverage on other windows."
    )
    return Section("Prediction bands around forecasts", cells(runs, cell), explanation)


def edges(ablation: Ablation) -> Section:
    """Return the section with the cost of every edge of a model and its guide."""
    plot = picture(ablation.plot(), "model and guide of one step, edges as thick as their cost")
    return Section("Cost of every edge", before=plot + tabulated(ablation.table()))


# ------------------------------------------------------------------------------------------ sections that need windows


def weighed(runs: Runs, windows: HeldOutWindows, particles: int = 64, seed: int = 0) -> Section:
    """Return the section with bounds and their errors, the KL of every latent over time, and Pareto k-hat.

    The table omits the ELBO and the KL if all runs have scores, which contain both, of all test windows.
    """
    likely = {name: run.model for name, run in runs.items() if run.model.likelihood}
    settings: dict[str, Any] = {"particles": particles, "contrasts": 0, "samples": 0, "seed": seed}
    title = "Bounds, KL over time, k-hat"
    try:
        comparison = compare(likely, windows, **settings) if likely else None
    except (ArithmeticError, RuntimeError, TypeError, ValueError) as error:
        return Section(title, before=missing_part(f"The bounds cannot be computed: {error_message(error)[:500]}"))

    def cell(name: str) -> Markup:
        if comparison is None or name not in comparison.rows:
            return missing_part(
                "The model has no likelihood: its data have no density, so there is no bound and no KL."
            )
        return _evidence(comparison, name)

    particles = comparison.particles if comparison else particles  # 1 if a model has a bound in place of a density
    explanation = f"Of {len(windows.keys)} test windows, evenly spread, with K = {particles} particles each."
    omitted = ["seeds", *(["ELBO", "KL"] if all(_has_elbo(runs[name]) for name in likely) else [])]
    table = tabulated(comparison.table(), omitted) if comparison else ""
    return Section(title, {name: cell(name) for name in runs}, explanation, table)


def posteriors(runs: Runs, windows: HeldOutWindows, seed: int = 0) -> Section:
    """Return the section with densities of the latents under the guide, and in free-running draws of the model."""
    explanation = (
        "Grey: the prior, in free-running draws of the model. Line: the posterior, drawn from the guide for "
        f"{len(windows.keys)} test windows. Both are over all windows and steps, for the coordinates of each latent "
        "whose posterior mean varies most."
    )
    return Section("Posterior against prior", cells(runs, partial(_latents, windows=windows, seed=seed)), explanation)


def _evidence(comparison: Comparison, name: str) -> Markup:
    """Return pictures of the KL of every latent over time and of the Pareto k-hat, for one model."""
    row, parts = comparison.rows[name], []
    for latent, steps in list(row.kl_steps.items())[:MOST]:
        figure, axes = _panel(f"KL of {latent}", "step", "nats a step")
        axes.plot(range(1, steps.shape[-1] + 1), steps.mean(0), linewidth=1.3)
        axes.set_ylim(bottom=min(0.0, float(steps.min())))
        parts.append(picture(figure, f"KL of {latent} over time"))
    khat = row.bounds["k-hat"].ravel()
    khat = khat[~np.isnan(khat)]
    if len(khat):
        right = max(1.0, min(3.0, float(khat.max())))
        beyond = f", {(khat > right).mean():.0%} beyond {right:g}" if (khat > right).any() else ""
        figure, axes = _panel(f"Pareto k-hat{beyond}", f"k-hat (unreliable above {KHAT})", "share of windows")
        axes.ecdf(np.minimum(khat, right + 1))  # `ecdf` cannot draw infinity
        axes.axvline(KHAT, color="grey", linewidth=0.8, linestyle="--")
        axes.set(xlim=(min(0.0, float(khat.min())), right), ylim=(0, 1.02))
        parts.append(picture(figure, "share of windows below a k-hat"))
    return side_by_side(*parts)


@torch.no_grad()
def _latents(run: Loaded, windows: HeldOutWindows, seed: int) -> Markup:
    model = run.model
    if not model.latents:
        return paragraph("Nothing is latent.")
    with seeded_evaluation(model, seed):
        batch = windows.all()
        data = model.read(batch)
        size, length = (data["x"] if "x" in data else batch["x"]).shape[:2]
        inferred = model.guide(repeat(data, DRAWS))
        context = {name: value for name, value in data.items() if name in model.context}
        free = model.sample(size, length, context or None)
    parts = []
    for latent in model.latents:
        posterior = inferred[latent].unflatten(0, (DRAWS, size)).double().cpu()
        variances = posterior.mean(0).flatten(0, -2).var(0, correction=0)
        for coordinate in variances.argsort(descending=True, stable=True)[:COORDINATES].tolist():
            values = (free[latent].double().cpu()[..., coordinate], posterior[..., coordinate])
            parts.append(_densities(f"{latent}[{coordinate}]", *values))
    return side_by_side(*parts)


def _densities(name: str, prior: Tensor, posterior: Tensor) -> Markup:
    figure, axes = _panel(name, "", "density")
    values = [part.flatten().numpy() for part in (prior, posterior)]
    low, high = np.quantile(np.concatenate([np.quantile(part, (0.002, 0.998)) for part in values]), (0, 1))
    edges = np.linspace(low, high if high > low else low + 1, 51)
    for part, style in zip(values, ({"fill": True, "color": "0.82"}, {"color": "C0", "linewidth": 1.3}), strict=True):
        heights = np.histogram(part.clip(low, high), edges, density=True)[0]
        axes.stairs(heights, edges, **style)
    axes.set_yticks([])
    return picture(figure, f"densities of {name} under prior and posterior")


# ------------------------------------------------------------------------------------------------------------ pieces


def cells(runs: Runs, make: Callable[[Loaded], Markup], doing: str = "") -> dict[str, Markup]:
    """Return the content of a section for each run, or the error message if it fails.

    Args:
        runs: runs by name.
        make: function from a run to its content.
        doing: text of a progress bar; "" for no bar.
    """
    contents = {}
    with progress_bar(bool(doing)) as bar:
        for name, run in bar.track(runs.items(), description=doing):
            try:
                contents[name] = make(run)
            except Exception as error:  # files of an untrusted run may raise any error
                contents[name] = missing_part(
                    f"This cannot be shown: {error_message(error)[:500] or type(error).__name__}"
                )
    return contents


def _missing(run: Loaded, file: str, results: str, name: str) -> Markup:
    return missing_part(
        Markup("The run has no {}, so there are no {}. Compute them with {}.").format(
            file, results, _command(run, name)
        )
    )


def _command(run: Loaded, name: str) -> Markup:
    return command("dvae", *name.split(), in_command(run.path))


def _record(run: Loaded, name: str) -> str | None:
    """Return the text of a result file in a run directory; None if it does not exist."""
    try:
        return files.read(run.path / name, LARGEST).decode()
    except FileNotFoundError:
        return None


def _evaluation(run: Loaded) -> Evaluation | None:
    text = _record(run, "evaluation.json")
    return None if text is None else Evaluation.from_json(text)


def _row(run: Loaded, evaluation: Evaluation) -> str | None:
    """Return the name of the evaluation's row that has the current config of a run; None without such a row."""
    config = plain(Run(run.path).config)
    return next((name for name, row in evaluation.rows.items() if row.config == config), None)


def _fit(run: Loaded) -> Fit:
    """Return the stored result of the training."""
    state, history = Run(run.path).state, JSONLines(run.path / "log.jsonl").read()
    per = run.model.per if isinstance(run.model, Program) else Fit.per
    record = state["step"], state["best_step"], state["best_bound"], state["status"]
    return Fit(history, *record, run.path, per, last_value=state.get("last_value"))


def _facts(run: Loaded) -> dict[str, str]:
    state, training, sizes = Run(run.path).state, run.config.training, run.model.sizes
    parameters = sum(parameter.numel() for parameter in run.model.parameters())
    try:
        best = _fit(run).best
    except CheckpointError:  # the section of curves reports the error
        best = ""
    return {
        "method": run.method.name,
        "run": str(run.path),
        "data": str(run.config.data.path),
        "latents": ", ".join(f"{name} {sizes[name]}" for name in run.model.latents) or "none",
        "parameters": f"{parameters:,}",
        "training": f"{state['status']} at step {state['step']} of {training.steps}, seed {training.seed}",
        "validation": best or "–",
    }


def _has_elbo(run: Loaded) -> bool:
    with suppress(Exception):  # the section of scores reports the error
        evaluation = _evaluation(run)
        return evaluation is not None and "ELBO" in evaluation.metrics
    return False


def _graph_picture(axes: Any, title: str) -> Markup:
    """Return a graph as a picture, and close its figure."""
    axes.set_title(title)
    axes.figure.set_size_inches(GRAPH * axes.figure.get_size_inches())
    try:
        return picture(axes.figure, f"graph of the {title}")
    finally:
        plt.close(axes.figure)


def _panel(title: str, x: str, y: str) -> tuple[Any, Any]:
    figure = new_figure(*PANEL)
    axes = figure.subplots()
    literal_text([axes.set_title(title, fontsize=10), axes.set_xlabel(x, fontsize=8), axes.set_ylabel(y, fontsize=8)])
    axes.tick_params(which="both", labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _curve(fit: Fit, name: str) -> Markup:
    kind, _, variable = name.partition("/")
    label = {"log_likelihood": "log p", "kl": "KL", "energy": ""}.get(kind, kind)
    unit = f"a {fit.per}" if kind in ("loss", "energy") else f"nats a {fit.per}"
    figure, axes = _panel(f"{label} {variable}".strip(), "step", unit)
    values = []
    for series, style in (
        (name, {"color": "0.7"}),
        (f"validation/{name}", {"color": "C0", "marker": ".", "markersize": 4}),
    ):
        steps, series_values = fit.series(series)
        axes.plot(steps, series_values, linewidth=1.1, **style)
        values += [value for value in series_values if math.isfinite(value)]
    if values:  # the first steps may be so far off that all others would look equal
        low, high = np.quantile(values, (0.02, 0.98))
        axes.set_ylim(low - 0.1 * (high - low or 1), high + 0.1 * (high - low or 1))
        if kind == "energy" and min(values) > 0:
            axes.set(yscale="log", ylim=(min(values) / 1.2, max(values) * 1.2))
    if fit.best_step is not None:
        axes.axvline(fit.best_step, color="0.3", linestyle=":", linewidth=1)
    return picture(figure, f"{name} over the steps of the training")
