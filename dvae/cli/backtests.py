"""Command that fits methods to a table before several cutoffs and scores their forecasts: backtest."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import tyro

from ..models import registry
from ..runs.backtest import backtest as backtest_methods
from . import loading
from .assessment import save_and_print
from .console import OUT, UsageError, arguments, at_least, check_figure
from .fitting import DataOptions, MethodOptions, SweepOptions, SweptMethod, given_options
from .help import Expert


def backtest(
    method: Annotated[tuple[SweptMethod, ...], tyro.conf.Positional],
    out: Path,
    model: MethodOptions,
    training: SweepOptions,
    source: DataOptions,
    cutoffs: int = 4,
    step: int | None = None,
    refit: bool = True,
    seeds: tuple[int, ...] = (0,),
    latent: int | None = None,
    jobs: int = 2,
    samples: int = 50,
    seed: Expert[int] = 0,
    score: str = "CRPS",
    figure: Path | None = None,
) -> None:
    """Fit methods to a table before each of several cutoffs, and score their forecasts after it.

    Prints the pooled scores, with errors clustered by sequence, and one score at each cutoff. Writes backtest.json to
    the directory. The same command continues after an interruption and keeps finished runs.

    Args:
        method: names of methods.
        out: directory for the runs, such as cutoff-1/srnn-seed0.
        model: options of all methods, in place of their defaults.
        training: options of the runs; `dvae show METHOD` prints the defaults of each method.
        source: table to fit to; it is divided by time, without regard to --split and --test.
        cutoffs: number of cutoffs.
        step: steps from one cutoff to the next, and from the last one to the end; at least the horizon, the default.
        refit: fit again at every cutoff; otherwise the fits at the first cutoff make all forecasts.
        seeds: seeds of initial weights, batches and draws, one run for each.
        latent: size of z.
        jobs: number of runs in parallel.
        samples: number of forecasts of each window.
        seed: seed of the forecasts.
        score: score to print for each cutoff.
        figure: save the pooled scores.
    """
    at_least(1, cutoffs=cutoffs, step=step, jobs=jobs, samples=samples)
    check_figure(figure, "figure")
    if not method or not seeds or out.is_file():
        raise UsageError("give at least one method and one seed, and a directory for the runs: --out DIR")
    given = {name: value for name, value in {**vars(model), "latent": latent}.items() if value is not None}
    with arguments():
        options = given_options(training)
        methods = [registry.method(name, **given) for name in method]
        for each in methods:
            each.check()
    data_set = source.open(*methods)
    if data_set.kind != "panel":
        raise UsageError(f"a backtest is of a table, and {source.data} is none; name a table with --data")
    scored: dict[str, Any] = {"scores": loading.SCORES["panel"], "samples": samples, "seed": seed}
    result = backtest_methods(methods, data_set, cutoffs, out, seeds, options, jobs, step=step, refit=refit, **scored)
    save_and_print(result, [out / "backtest.json"], figure)
    OUT.print(result.cutoff_table(score))
