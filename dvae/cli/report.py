"""The command that puts what is known of runs on one page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro
from markupsafe import Markup

from .. import files
from ..inference.evaluation.result import progress_bar, reason
from ..inference.training.checkpoints import CheckpointError
from ..motion.drawing.player import SCRIPT, player
from ..motion.drawing.plot import staged
from ..runs import directory as runs
from ..runs.ablation import Ablation
from ..runs.report import Section, document, lacking, sections
from ..runs.report.page import beside, picture
from ..tables.windows import PanelWindows
from . import opening
from .console import ERROR, Failed, Missing, UsageError, at_least, check_files
from .futures import draw_futures
from .judging import Control
from .judging import evaluate as evaluate_runs

OF_DIRECTORIES = (
    sections.overview,
    sections.equations,
    sections.graphs,
    sections.curves,
    sections.evaluated,
    sections.calibration,
    sections.bracketed,
    sections.yardsticks,
    sections.tubes,
)
"""What needs no data."""
QUANTILES = 100
"""Draws of which intervals of 95 % are shown."""
COLUMNS = 4
"""Of a table whose futures are shown."""


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
    failed: Failed = False,
) -> None:
    """One page of what is known of runs: equations, graphs, curves, scores, bounds, latents, and futures.

    The page is one file that any browser shows, without a network. Several runs stand side by side. What a run lacks,
    such as scores or a calibration, is said there with the command that makes it.

    Args:
        run: run directories, fitted on the same data under the same protocol.
        out: the html file to write.
        evaluate: score the runs first, as `dvae evaluate` does; without it, scores are those that it has left.
        windows: test windows whose futures are shown, evenly spread; 0 leaves them out.
        samples: futures of each; of a table, of which quantiles are shown, at least 100.
        bound_windows: test windows, evenly spread, of which bounds, KL and latents are shown.
        particles: of the importance-weighted bound.
        seed: of the draws.
        edges: the file of `dvae check edges`, whose table and drawing are shown too.
        data: where the data lie now, if the path in the runs no longer leads there; or other data of the same joints.
    """
    at_least(0, windows=windows)
    at_least(1, samples=samples, bound_windows=bound_windows, particles=particles)
    check_files(out, None, ".html", ".htm")
    ablated = None if edges is None else _ablation(edges)
    loaded = opening.alike(run, data, failed=failed)
    of_table = loaded[0].config.kind == "panel"
    if evaluate:
        evaluate_runs(run, Control(), data=data, missing=missing, failed=failed, seed=seed)
    named = dict(zip(opening.names(loaded), loaded, strict=True))

    with progress_bar(True) as bar:
        shown = [make(named) for make in bar.track(OF_DIRECTORIES, description="run directories")]
    shown += [] if ablated is None else [sections.arrows(ablated)]
    try:
        opened = opening.data_of(data, *loaded, missing=missing)
        test: Any = opened.windows("test")
    except CheckpointError as error:
        text = f"Bounds, latents and futures need the data. {reason(error)}; say where they are with --data."
        shown.append(Section("Latents and futures", before=lacking(text)))
    else:
        few = sections.Few(test, bound_windows)
        shown += [sections.weighed(named, few, particles, seed), sections.posteriors(named, few, seed)]
        futures = _fans if of_table else _futures
        shown += [futures(named, test, windows, samples, seed)] if windows else []
    text = document("Report: " + ", ".join(named), shown, [] if of_table else [SCRIPT])
    with files.written(out) as file:
        file.write(text.encode(errors="replace"))
    ERROR.print(f"wrote {out}: {', '.join(named)}, {len(text) / 1e6:.1f} MB")


def _ablation(path: Path) -> Ablation:
    try:
        return Ablation.from_json(files.read(path, sections.LARGEST, links=True).decode())
    except ValueError as error:
        raise UsageError(f"--edges {path}: {reason(error)}") from error


def _fans(named: Mapping[str, Any], windows: PanelWindows, count: int, samples: int, seed: int) -> Section:
    """A few windows with what happened and the intervals of what each run forecasts."""
    if windows.length is None:
        text = "These runs are of whole sequences. To see futures, fit with --observed and --horizon."
        return Section("Futures", before=lacking(text))
    few = windows.some(sections.Few(windows, count).chosen)

    def cell(run: runs.Loaded) -> Markup:
        found = few.forecast(run.model, max(samples, QUANTILES), seed)
        shown = ((found.plot(place, most=COLUMNS), key) for place, key in enumerate(found.keys))
        return beside(*(picture(figure, f"forecasts of {name} from step {step}") for figure, (name, step) in shown))

    about = "Grey: observed. Black: what happened. Blue: median, and intervals of 50, 80 and 95 % of the forecasts."
    return Section("Futures", sections.cells(named, cell, "futures"), about)


def _futures(named: Mapping[str, Any], windows: Any, count: int, samples: int, seed: int) -> Section:
    """A few windows with what happened and what each run forecasts, as moving skeletons."""
    few = sections.Few(windows, count)

    def cell(run: runs.Loaded) -> Markup:
        found = draw_futures(run, windows, few.chosen, samples, seed)
        names = [str(k + 1) for k in range(samples)]
        scenes = {
            f"{split}/{clip} from frame {start}": staged(
                found.skeleton, found.observed[n], found.forecasts[:, n], found.truth[n], names=names
            )
            for n, (split, clip, start) in enumerate(found.keys)
        }
        return player(scenes)

    about = (
        f"Black: observed. Green: what happened. In colour: {samples} futures, each from a draw of the latents, "
        "and without the noise of the emission where there are latents. To turn the people, drag them, or press the "
        "arrow keys."
    )
    return Section("Futures", sections.cells(named, cell, "futures"), about)
