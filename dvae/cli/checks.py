"""Commands that check runs: check calibration, posterior, gap, coverage and edges."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from .. import files, motion
from ..factorization.inversion import FAITHFUL
from ..inference.diagnostics.bracket import bracket
from ..inference.diagnostics.calibration import calibrate
from ..inference.diagnostics.checks import predictive_checks
from ..inference.diagnostics.reference_posterior import reference_posterior
from ..inference.diagnostics.stein import stein_discrepancy
from ..inference.evaluation.conformal import conformal_bands
from ..models import registry
from ..models.family.equations import Equations
from ..models.method import LatentMethod
from ..models.motion.trajectories import TrajectoryModel
from ..runs import directory as runs
from ..runs.ablation import ablate, as_equations
from . import loading, tables
from .assessment import save_and_print
from .console import (
    ERROR,
    Missing,
    UsageError,
    arguments,
    at_least,
    check_figure,
    check_files,
)
from .fitting import DataOptions, MethodOptions, SweepOptions, given_options, options_of
from .help import Expert
from .loading import ON_CPU, Use

if TYPE_CHECKING:
    EquationOptions = Any
else:
    SHARED = [option.name for option in fields(LatentMethod)]
    EquationOptions = options_of("EquationOptions", Equations, "generative", "inference", *SHARED)


def calibration(
    run: Annotated[Path, tyro.conf.Positional],
    data: str | None = None,
    missing: Expert[Missing] = False,
    use: Use = ON_CPU,
    simulations: int = 200,
    draws: Expert[int] = 99,
    ranked_steps: Expert[int] = 4,
    samples: int = 20,
    draw_emission: Expert[bool] = True,
    seed: int = 0,
    batch_size: Expert[int] = 32,
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Run simulation-based calibration of a run's guide, and predictive checks on the test windows.

    Prints both tables, and writes each to calibration.json in the run, or to --out, as soon as it is computed.

    Args:
        run: the run directory.
        data: where the data are now, if the path in the run is no longer valid; or other data with the same variables.
        simulations: number of sequences drawn from the model, as long as its windows.
        draws: number of draws from the guide for each simulation.
        ranked_steps: number of time steps, evenly spaced, at which local latents are ranked.
        samples: number of replicates of each test window, at least 19.
        draw_emission: whether replicates are draws of x, or means without emission noise. Methods that follow given
            paths (trajevae, cvae-rnn, motion-infilling) always return means.
        seed: seed of the draws.
        batch_size: number of windows replicated at once.
        out: file to write instead of calibration.json in the run.
        figure: save the figures, with -calibration and -checks added to this name.
    """
    at_least(1, simulations=simulations, draws=draws, ranked_steps=ranked_steps, batch_size=batch_size)
    at_least(19, samples=samples)
    check_files(out, figure, ".json")
    loaded, data_set = loading.forecaster(run, data, missing, use)
    model, windows = loaded.model, loading.windows_to_test(loaded, data_set, whole_sequences=False)
    steps = np.unique(np.linspace(1, windows.length, ranked_steps + 1)[1:].round().astype(int)).tolist()
    document: dict[str, Any] = {}
    path = out or run / f"{loading.record('calibration', loaded, data_set)}.json"
    if model.context:
        context = ", ".join(model.context)
        ERROR.print(f"no calibration: {loaded.method.name} conditions on {context}, which cannot be simulated")
    elif not model.latents:
        ERROR.print(f"no calibration: {loaded.method.name} has no latents, and so no guide")
    else:
        ranks = calibrate(model, windows.length, simulations, draws, steps=steps, seed=seed)
        _add(document, "calibration", ranks, path, figure, "calibration")
    checks = predictive_checks(
        {loaded.method.name: model},
        windows,
        motion.statistics(windows) if loaded.config.kind == "motion" else None,
        samples=samples,
        draw_emission=draw_emission and not isinstance(model, TrajectoryModel),
        seed=seed,
        batch_size=batch_size,
    )
    _add(document, "predictive", checks, path, figure, "checks")


def posterior(
    run: Annotated[Path, tyro.conf.Positional],
    data: str | None = None,
    missing: Expert[Missing] = False,
    use: Use = ON_CPU,
    windows: int = 3,
    frames: int | None = None,
    draws: int = 1000,
    chains: int = 4,
    warmup: Expert[int] = 500,
    stein_draws: Expert[int] = 500,
    seed: int = 0,
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Compare a run's guide with the posterior of the latents of some test windows.

    First computes the kernel Stein discrepancy of the guide, which is quick. Then computes means, deviations and
    correlations of the guide and of NUTS, which takes minutes for each window: begin with few --frames. Prints both
    tables, and writes each to posterior.json in the run, or to --out, as soon as it is computed.

    Args:
        run: the run directory.
        data: where the data are now, if the path in the run is no longer valid; or other data with the same variables.
        windows: number of test windows, evenly spaced.
        frames: number of steps of a window, from its first one, whose latents are inferred; all by default.
        draws: number of draws of each NUTS chain.
        chains: number of chains for each window.
        warmup: number of warm-up draws of each chain.
        stein_draws: number of draws from the guide for the kernel Stein discrepancy.
        seed: seed of the draws.
        out: file to write instead of posterior.json in the run.
        figure: save the figures, with -stein and -posterior added to this name.
    """
    at_least(1, windows=windows, frames=frames, warmup=warmup)
    at_least(2, chains=chains, stein_draws=stein_draws)
    at_least(4, draws=draws)
    check_files(out, figure, ".json")
    loaded, data_set = loading.forecaster(run, data, missing, use)
    batch = data_set.windows("test").all()
    indices = np.unique(np.linspace(0, len(batch["x"]) - 1, windows).round().astype(int))
    selected = batch.map(lambda value: value[indices, :frames] if value.dim() == 3 else value[indices])
    if selected.lengths is not None and frames is not None:
        selected["lengths"] = selected.lengths.clamp(max=frames)
    document: dict[str, Any] = {"windows": indices.tolist(), "frames": frames}
    path = out or run / f"{loading.record('posterior', loaded, data_set)}.json"
    stein = stein_discrepancy(loaded.model, selected, draws=stein_draws, seed=seed)
    _add(document, "stein", stein, path, figure, "stein")
    ERROR.print(f"drawing from the posterior of {len(indices)} windows by NUTS, which can take minutes for each")
    reference = reference_posterior(loaded.model, selected, draws=draws, chains=chains, warmup=warmup, seed=seed)
    _add(document, "posterior", reference, path, figure, "posterior")


def _add(document: dict[str, Any], part: str, result: Any, path: Path, figure: Path | None, suffix: str) -> None:
    """Add a part to a document, write it, and print the part."""
    document[part] = result.document()
    with files.atomic_write(path) as file:
        file.write((json.dumps(document, indent=1, allow_nan=False) + "\n").encode())
    ERROR.print(f"wrote {path}: {part}")
    save_and_print(result, [], figure and figure.with_stem(f"{figure.stem}-{suffix}"))


def gap(
    run: Annotated[Path, tyro.conf.Positional],
    data: str | None = None,
    missing: Expert[Missing] = False,
    use: Use = ON_CPU,
    count: int = 32,
    particles: int = 64,
    temperatures: int = 50,
    chains: Expert[int] = 8,
    fitting: Expert[int] = 300,
    reach: Expert[int | None] = None,
    seed: int = 0,
    batch_size: Expert[int] = 32,
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Bound a run's evidence from both sides, and decompose the gap of its ELBO: amortisation, dependencies, family.

    Prints bounds of some test windows and of as many windows simulated from the model, and the parts of the gap.
    Writes them to gap.json in the run, or to --out.

    Args:
        run: the run directory.
        data: where the data are now, if the path in the run is no longer valid; or other data with the same variables.
        count: number of test windows, drawn at random; the time is proportional to it.
        particles: number of particles of the IWAE and FIVO bounds, and number of draws that ELBOs average.
        temperatures: number of temperatures of annealed importance sampling; more give closer bounds.
        chains: number of chains of annealed importance sampling for each window.
        fitting: number of optimiser steps that fit a separate guide to each window; 0 omits the parts of the gap.
        reach: largest distance in steps of linear dependencies between local latents in these guides; no limit by
            default.
        seed: seed of the draws.
        batch_size: number of windows processed at once.
        out: file to write instead of gap.json in the run.
        figure: save all bounds on one axis.
    """
    at_least(1, count=count, particles=particles, temperatures=temperatures, chains=chains, batch_size=batch_size)
    at_least(0, fitting=fitting, reach=reach)
    check_files(out, figure, ".json")
    loaded, data_set = loading.forecaster(run, data, missing, use)
    result = bracket(
        loaded.model,
        loading.windows_to_test(loaded, data_set),
        count=count,
        particles=particles,
        temperatures=temperatures,
        chains=chains,
        fitting=fitting,
        reach=reach,
        seed=seed,
        batch_size=batch_size,
    )
    save_and_print(result, [out or run / f"{loading.record('gap', loaded, data_set)}.json"], figure)


def coverage(
    run: Annotated[tuple[Path, ...], tyro.conf.Positional],
    data: str | None = None,
    missing: Expert[Missing] = False,
    use: Use = ON_CPU,
    level: float = 0.9,
    label: str | None = None,
    values: tuple[str, ...] = (),
    samples: int = 50,
    seed: int = 0,
    batch_size: Expert[int] = 32,
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Widen a run's forecasts to bands that contain whole futures with a given probability, and test them.

    Calibrates on the validation windows, which also selected the weights, and tests on the test windows. With --label
    style --values feminine it calibrates on the test clips of these styles and tests on the others. With runs of a
    backtest it calibrates on the windows between their cutoffs and tests on those after the last one. Prints the
    factors and the coverage before and after. Writes coverage.json and coverage-test.json in the last run, or to --out.
    `dvae.PredictionBands.load` reads the first, and its `apply` returns the band of forecasts.

    Args:
        run: the run directory; or runs of one method at several cutoffs, such as backtest/cutoff-*/srnn-seed0.
        data: where the data are now, if the path in the run is no longer valid; or other data with the same variables.
        level: share of futures that bands contain.
        label: label of test clips that divides them into those for calibration and those for the test.
        values: label values whose clips are used for calibration; the other clips are used for the test.
        samples: number of forecasts of each window.
        seed: seed of the draws.
        batch_size: number of windows forecast at once.
        out: file to write instead of coverage.json in the run.
        figure: save the factors over the horizon.
    """
    at_least(1, samples=samples, batch_size=batch_size)
    check_files(out, figure, ".json")
    if bool(values) != (label is not None):
        raise UsageError("--label and --values select the test clips for calibration; give both")
    if not run:
        raise UsageError("give at least one run directory")
    loaded_runs = [loading.forecaster(each, data, missing, use) for each in run]
    loaded, data_set = min(loaded_runs, key=lambda pair: _test_steps(pair[0]))
    if len(loaded_runs) > 1:
        calibration_models, calibration_windows = _between_cutoffs(loaded_runs, label)
        test_windows = data_set.windows("test")
    else:
        calibration_models = loaded.model
        calibration_windows, test_windows = _calibration_and_test(loaded, data_set, label, values)
    bands = conformal_bands(
        calibration_models, calibration_windows, level, samples=samples, seed=seed, batch_size=batch_size
    )
    path = out or loaded.path / f"{loading.record('coverage', loaded, data_set)}.json"
    save_and_print(bands, [path], figure)
    save_and_print(
        bands.coverage({loaded.method.name: loaded.model}, test_windows), [path.with_stem(f"{path.stem}-test")], None
    )


def _test_steps(run: runs.Loaded) -> int:
    """Return the number of steps after the cutoff of a run; 0 if it has no cutoff."""
    return run.schema.cut.test_steps if run.config.kind == "panel" else 0


def _between_cutoffs(loaded_runs: Sequence[tuple[runs.Loaded, Any]], label: str | None) -> tuple[list[Any], list[Any]]:
    """Return models, and for each the windows between its cutoff and the next one.

    Windows with futures that end after the last cutoff are left out, since the test contains these steps.

    Raises:
        UsageError: the runs are not of one method and seed at several cutoffs of a table, or there is no such window.
    """
    ordered = sorted(loaded_runs, key=lambda pair: _test_steps(pair[0]), reverse=True)
    steps = [_test_steps(run) for run, _ in ordered]
    fits = {(run.method.name, run.config.training.seed, data.fingerprint) for run, data in ordered}
    if label is not None or len(fits) > 1 or len({*steps, 0}) <= len(steps):
        raise UsageError(
            "several runs calibrate bands over cutoffs of a table; give runs of one method and seed, each at another "
            "cutoff, such as backtest/cutoff-*/srnn-seed0, without --label"
        )
    origin, models, windows = ordered[-1][1].windows("test").origins[:, 0].min(), [], []
    for (run, data), now, following in zip(ordered, steps, steps[1:], strict=False):
        between = data.following(now - following)
        if places := (between.origins[:, 1] <= origin).nonzero().flatten().tolist():
            models.append(run.model)
            windows.append(between.subset(places))
    if not windows:
        raise UsageError("no future after an earlier cutoff ends by the last cutoff; give runs at earlier cutoffs")
    return models, windows


def _calibration_and_test(run: runs.Loaded, data_set: Any, label: str | None, values: Sequence[str]) -> Any:
    """Return the windows for calibration and for the test.

    Raises:
        UsageError: the label divides no test clips.
    """
    if run.config.kind == "panel":
        if label is not None:
            raise UsageError(f"--label is for motion, and {run.path} was fitted on a table; leave it out")
        return [tables.windows(run, data_set, split) for split in ("validation", "test")]
    if label is None:
        return [data_set.windows(split) for split in ("validation", "test")]
    clips, motion_set = data_set.windows("test").clips, data_set.motion
    label_values = {clip.labels.get(label, "") for clip in clips}
    if unknown := sorted({*values} - label_values):
        raise UsageError(f"no test clip has {label} {', '.join(unknown)}; there are {', '.join(sorted(label_values))}")
    test = motion.MotionSet(clips, motion_set.skeleton, data_set.path, missing=motion_set.missing)
    others = tuple(sorted(label_values - {*values}))
    if not others:
        raise UsageError(
            f"--values {' '.join(values)} selects all test clips; leave out at least one {label} for the test"
        )
    return [
        motion.windows(test, replace(data_set.protocol, split_by=label, train=(), test=part), "test")
        for part in (tuple(values), others)
    ]


def edges(
    method: Annotated[str | None, tyro.conf.Positional] = None,
    *,
    model: MethodOptions,
    networks: EquationOptions,
    training: SweepOptions,
    source: DataOptions,
    generative: str | None = None,
    inference: str | None = None,
    latent: int | None = None,
    out: Path | None = None,
    seeds: tuple[int, ...] = (0, 1, 2),
    jobs: int = 2,
    bound_particles: Expert[int] = 64,
    surrogate_steps: Expert[int] = 5,
    surrogates: Expert[int] = 5,
    figure: Path | None = None,
) -> None:
    """Leave out every edge of a model and its guide in turn, and report the cost of each in nats.

    Without --out, costs are computed on linear-Gaussian surrogates only. With --out, every reduced pair of equations is
    also fitted to data, with networks of one kind, and compared on the test windows. The table is written to edges.json
    there. The same command continues after an interruption and keeps finished runs.

    Args:
        method: name of a method, unless --generative is given.
        model: options of all models, in place of the method's.
        networks: options of the networks of every factor.
        training: options of the runs.
        source: data to fit to.
        generative: equation of the model, such as "p(z_t | z_{t-1}) p(x_t | z_t)".
        inference: equation of the guide, such as "q(z_t | z_{t-1}, x_{t:T})"; by default "faithful", a guide with all
            dependencies of the posterior, derived anew for every reduced model; "" for a model without latents.
        latent: size of the latents.
        out: directory of the run directories, such as whole-seed0 and model-without-z_t-1-to-z_t-seed0.
        seeds: seeds of initial weights, batches and draws, one run for each.
        jobs: number of runs in parallel.
        bound_particles: number of particles of the IWAE bound.
        surrogate_steps: time steps of the linear-Gaussian surrogates.
        surrogates: number of random linear-Gaussian surrogates.
        figure: save model and guide of one step, with the width of each edge proportional to its cost.
    """
    at_least(1, jobs=jobs, bound_particles=bound_particles, surrogate_steps=surrogate_steps, surrogates=surrogates)
    check_figure(figure, "figure")
    if (method is None) == (generative is None):
        raise UsageError("give the name of a method, or --generative, with --inference for your own guide")
    if method is not None and inference is not None:
        raise UsageError(
            f"--inference is the guide for --generative, but {method} has its own guide; leave --inference out"
        )
    training_values = [value for value in vars(training).values() if value not in (None, False)]
    if out is None and (training_values or source != DataOptions()):
        raise UsageError("fits need a directory for their runs: give --out DIR")
    if out is not None and (out.is_file() or not seeds):
        raise UsageError(f"give at least one seed, and a directory for the runs: --out {out} --seeds {seeds}")
    with arguments():
        guide = FAITHFUL if inference is None else inference
        base = registry.method(method) if method else Equations(generative=generative or "", inference=guide)
        overrides = {**vars(model), **vars(networks), "latent": latent}
        changes = {name: value for name, value in overrides.items() if value is not None}
        replace(as_equations(base), **changes).check()
        training_options = given_options(training)
    data_set = None if out is None else source.open(base)
    full = replace(as_equations(base, None if data_set is None else data_set.schema), **changes)
    settings: dict[str, Any] = {"steps": surrogate_steps, "surrogates": surrogates, "bound_particles": bound_particles}
    result = ablate(full, data_set, out, seeds, training_options, jobs, **settings)
    save_and_print(result, [] if out is None else [out / "edges.json"], figure)
