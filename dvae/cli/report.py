"""The command `report`, which writes all results of some runs to one page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro
from markupsafe import Markup

from .. import files
from ..inference.evaluation.result import error_message, progress_bar
from ..inference.training.checkpoints import CheckpointError
from ..motion.drawing.player import SCRIPT, STYLE, controls, stage
from ..motion.drawing.plot import make_scene
from ..runs import directory as runs
from ..runs.ablation import Ablation
from ..runs.report import Section, document, missing_part, sections
from ..runs.report.page import picture, side_by_side
from ..tables.windows import PanelWindows
from . import loading
from .assessment import Control
from .assessment import evaluate as evaluate_runs
from .console import ERROR, Missing, UsageError, at_least, check_files
from .futures import draw_futures
from .loading import ON_CPU, Use

OF_DIRECTORIES = (
    sections.overview,
    sections.evaluated,
    sections.equations,
    sections.graphs,
    sections.curves,
    sections.calibration,
    sections.bracketed,
    sections.reference_posteriors,
    sections.prediction_bands,
)
"""Sections that need no data."""
QUANTILES = 100
"""Minimum number of draws for the 95 % intervals that are shown."""
COLUMNS = 4
"""Maximum number of table columns whose futures are shown."""


def report(
    run: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path,
    evaluate: bool = False,
    windows: int = 6,
    samples: int = 10,
    bound_windows: int = 64,
    particles: int = 64,
    seed: int = 0,
    edges: Path | None = None,
    data: str | None = None,
    missing: Missing = False,
    use: Use = ON_CPU,
) -> None:
    """Write all results of some runs to one page: equations, graphs, curves, scores, bounds, latents and futures.

    The page is a single file that any browser shows without a network, with several runs side by side. If a result is
    missing, such as scores or a calibration, the page shows the command that computes it.

    Args:
        run: run directories, fitted on the same data under the same protocol.
        out: html file to write.
        evaluate: score the runs first, as `dvae evaluate` does; otherwise the page shows existing scores.
        windows: number of test windows, evenly spaced, whose futures are shown; 0 omits the futures.
        samples: number of futures of each window; at least 100 for a table, whose quantiles are shown.
        bound_windows: number of test windows, evenly spaced, for bounds, KL and latents.
        particles: number of particles of the IWAE bound.
        seed: seed of the draws.
        edges: file written by `dvae check edges`, whose table and drawing are shown too.
        data: where the data are now, if the path in the runs is no longer valid; or other data with the same variables.
    """
    at_least(0, windows=windows)
    at_least(1, samples=samples, bound_windows=bound_windows, particles=particles)
    check_files(out, None, ".html", ".htm")
    ablation = None if edges is None else _ablation(edges)
    loaded = loading.with_equal_windows(run, data, use=use)
    of_table = loaded[0].config.kind == "panel"
    if evaluate:
        evaluate_runs(run, Control(), data=data, missing=missing, use=use, seed=seed)
    by_name = dict(zip(loading.names(loaded), loaded, strict=True))

    with progress_bar(True) as bar:
        page_sections = [make(by_name) for make in bar.track(OF_DIRECTORIES, description="run directories")]
    page_sections += [] if ablation is None else [sections.edges(ablation)]
    try:
        data_set = loading.data_of(data, *loaded, missing=missing)
        test: Any = data_set.windows("test")
    except CheckpointError as error:
        text = f"Bounds, latents and futures need the data. {error_message(error)}; give their path with --data."
        page_sections.insert(1, Section("Latents and futures", before=missing_part(text)))
    else:
        selected = sections.SelectedWindows(test, bound_windows)
        page_sections += [
            sections.weighed(by_name, selected, particles, seed),
            sections.posteriors(by_name, selected, seed),
        ]
        futures = _fans if of_table else _futures
        page_sections[1:1] = [futures(by_name, test, windows, samples, seed)] if windows else []
    player = () if of_table else ([SCRIPT], STYLE)
    text = document("Report: " + ", ".join(by_name), page_sections, *player)
    with files.atomic_write(out) as file:
        file.write(text.encode(errors="replace"))
    ERROR.print(f"wrote {out}: {', '.join(by_name)}, {len(text) / 1e6:.1f} MB")


def _ablation(path: Path) -> Ablation:
    try:
        return Ablation.from_json(files.read(path, sections.LARGEST, links=True).decode())
    except ValueError as error:
        raise UsageError(f"--edges {path}: {error_message(error)}") from error


def _fans(by_name: Mapping[str, Any], windows: PanelWindows, count: int, samples: int, seed: int) -> Section:
    """Return the section of a few windows with their true futures and the forecast intervals of each run."""
    if windows.length is None:
        text = "These runs were fitted on whole sequences. To see futures, fit with --observed and --horizon."
        return Section("Futures", before=missing_part(text))
    selected = windows.subset(sections.SelectedWindows(windows, count).chosen)

    def cell(run: runs.Loaded) -> Markup:
        forecasts = selected.forecast(run.model, max(samples, QUANTILES), seed)
        figures = ((forecasts.plot(index, most=COLUMNS), key) for index, key in enumerate(forecasts.keys))
        return side_by_side(
            *(picture(figure, f"forecasts of {name} from step {step}") for figure, (name, step) in figures)
        )

    caption = (
        "Grey: observed. Black: true future. Blue: median, and intervals of 50, 80 and 95 % of the forecasts; for "
        "binary values, their share."
    )
    return Section("Futures", sections.cells(by_name, cell, "futures"), caption)


def _futures(by_name: Mapping[str, Any], windows: Any, count: int, samples: int, seed: int) -> Section:
    """Return the section of a few windows with their true futures and the forecasts of each run, as skeletons."""
    selected = sections.SelectedWindows(windows, count)

    def cell(run: runs.Loaded) -> Markup:
        futures = draw_futures(run, windows, selected.chosen, samples, seed)
        names = [str(k + 1) for k in range(samples)]
        motions = futures.observed, futures.forecasts.swapaxes(0, 1), futures.truth
        return stage([make_scene(futures.skeleton, *each, names=names) for each in zip(*motions, strict=True)])

    caption = (
        f"Without colour: observed. Green: true future. Other colours: {samples} futures, each from one draw of the "
        "latents. Models with latents show the mean of the emission, without its noise."
    )
    titles = [f"{split}/{clip} from frame {start}" for split, clip, start in selected.keys]
    return Section("Futures", sections.cells(by_name, cell, "futures"), caption, controls(titles))
