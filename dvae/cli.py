"""The command line: list and show methods, fit and resume runs, evaluate, compare and criticise them, look into data.

Exit codes: 0 done, 1 failed, 2 wrong arguments, 130 after Ctrl-C, 143 after SIGTERM. A fit that a signal
stopped can be resumed.
"""

from __future__ import annotations

import json
import sys
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, make_dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import torch
import tyro
from joblib import parallel_config

from . import files, motion
from .graph import audit
from .inference.calibration import Calibration, calibrate
from .inference.checkpoints import Run
from .inference.checks import PredictiveChecks, predictive_checks
from .inference.compare import compare as compare_models
from .inference.evaluate import evaluate as evaluate_models
from .inference.fit import Fit, Interrupted
from .inference.recipe import Trainable
from .inference.result import Plain, Table
from .inference.svi import reason
from .inference.trackers import TensorBoard
from .inference.training import Training
from .models.method import LatentMethod
from .models.registry import judges, methods
from .models.registry import method as method_by_name
from .models.trajectories import TrajectoryMethod, TrajectoryModel
from .motion.dataset import SIMULATED, MotionData
from .motion.judges.pose_prior import PosePriorModel
from .notation import Factorization
from .options import flat, nearest
from .runs import directory as runs
from .runs.sweep import ENDED, SweepInterrupted
from .runs.sweep import sweep as sweep_methods

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    MethodChoice = Trainable
    ProtocolName = str
    SweptMethod = str
    MethodOptions = Any
else:
    FAMILY_OPTIONS = {option.name for option in fields(LatentMethod)} - {"latent"}
    SweptMethod = tyro.extras.literal_type_from_choices([name for name in methods() if name != "equations"])
    MethodOptions = make_dataclass(
        "MethodOptions",
        [
            (o.name, get_type_hints(LatentMethod)[o.name] | None, None)
            for o in fields(LatentMethod)
            if o.name != "latent"
        ],
        frozen=True,
        namespace={"__doc__": LatentMethod.__doc__},
    )
    ProtocolName = tyro.extras.literal_type_from_choices(motion.PROTOCOLS)
    MethodChoice = tyro.extras.subcommand_type_from_defaults(
        {name: kind() for name, kind in {**methods(), **judges()}.items()},
        descriptions={name: kind.source for name, kind in {**methods(), **judges()}.items()},
        prefix_names=False,
    )

# Both keep to the width of the terminal; a file or a pipe gets lines as long as they need to be.
OUT = Plain(width=None if sys.stdout.isatty() else 200)
ERROR = Plain(stderr=True, soft_wrap=True, highlight=False)


class UsageError(ValueError):
    """Arguments that do not fit together."""


app = tyro.extras.SubcommandApp()
data_app = tyro.extras.SubcommandApp()


@app.command(name="list")
def list_methods() -> None:
    """List the methods: their equations and where they come from."""
    table = Table(show_lines=True)
    for column in ("method", "equations", "source"):
        table.add_column(column)
    for name, kind in methods().items():
        equations = (
            "--generative and --inference" if _asks_for_equations(kind) else f"{kind.generative}\n{kind.inference}"
        )
        table.add_row(name, equations, kind.source)
    OUT.print(table, highlight=False)


@app.command
def show(
    method: Annotated[str | None, tyro.conf.Positional] = None,
    generative: str | None = None,
    inference: str | None = None,
    steps: int = 4,
    out: Path | None = None,
) -> None:
    """Show two equations: the joint distributions, the audit of the guide, and the graph.

    Args:
        method: name of a method, or give two equations instead.
        generative: the model, such as "p(z_t | z_{t-1}) p(x_t | z_t)".
        inference: the guide, such as "q(z_t | z_{t-1}, x_{t:T})".
        steps: time steps in the figure.
        out: save the unrolled graphs of model and guide to this file (png, pdf, svg).
    """
    _at_least(1, steps=steps)
    _check_figure(out, "out")
    if method is not None and (generative or inference):
        raise UsageError("give the name of a method or two equations, not both")
    if method is not None:
        with _arguments():
            kind = method_by_name(method)
        if _asks_for_equations(kind):
            raise UsageError(f"{method} has no equations of its own; give --generative and --inference")
        pair = kind.equations()
        observed = [name for name in pair[0].variables if name not in pair[1].variables]
    elif generative and inference:
        with _arguments():
            pair = Factorization.parse(generative), Factorization.parse(inference)
        observed = ["x"]
    else:
        raise UsageError("give the name of a method, or both --generative and --inference")
    with _arguments():
        found = audit(*pair, observed=observed)
    OUT.print(str(found.generative), highlight=False, markup=False, soft_wrap=True)
    if found.inference.factors:
        OUT.print(str(found.inference), highlight=False, markup=False, soft_wrap=True)
        OUT.print(found.table())
        OUT.print(found.verdict)
    else:
        OUT.print("nothing is latent: there is no guide, and the bound is the log evidence")
    if out is not None:
        from matplotlib.figure import Figure

        graphs = 2 if found.inference.factors else 1
        figure = Figure(figsize=(graphs * (0.85 * steps + 1.6), 4.2 if graphs == 2 else 1.6), layout="constrained")
        model, *guide = figure.subplots(1, graphs, squeeze=False)[0]
        found.generative.draw(steps, ax=model, observed=observed).set_title("model")
        for axes in guide:
            title = "guide" if found.exact else "guide (dashed: what the exact posterior also reads)"
            found.draw(steps, ax=axes).set_title(title)
        _save_figure(figure, out)


@app.command(help="Fit a method, or equations of your own, to motion data.")
def fit(
    method: MethodChoice,
    out: Path,
    data: str = SIMULATED,
    protocol: ProtocolName | None = None,
    skip_bad: bool = False,
    steps: int = Training.steps,
    batch_size: int = Training.batch_size,
    learning_rate: float = 1e-3,
    decay: float = 0.5,
    optimizer: Literal["adam", "adamw", "sgd"] = Training.optimizer,
    validate_every: int = Training.validate_every,
    patience: int | None = Training.patience,
    seed: int = Training.seed,
    accelerator: Literal["auto", "cpu", "cuda", "mps"] = "auto",
    devices: int = Training.devices,
    precision: Literal["32-true", "64-true", "bf16-mixed", "bf16-true"] = Training.precision,
    tensorboard: bool = False,
) -> None:
    """Fit a method, or equations of your own, to motion data.

    Options may stand before or after the method; `dvae fit METHOD --help` lists those of a method.

    Args:
        method: what to fit.
        out: the run directory.
        data: a motion file, or "simulated".
        protocol: how windows are cut, by default as suits the skeleton.
        skip_bad: leave out clips that cannot be used instead of refusing the file.
        steps: optimiser steps.
        batch_size: windows in a batch.
        learning_rate: step size of the optimiser.
        decay: last share of the run over which the learning rate falls linearly to 0.
        optimizer: which optimiser.
        validate_every: steps from one validation and checkpoint to the next.
        patience: validations without a better bound after which to stop.
        seed: of initial weights, batches and draws.
        accelerator: where to compute.
        devices: number of devices.
        precision: of the computation.
        tensorboard: write TensorBoard files to the run directory too.
    """
    if out.is_file():
        raise UsageError(f"--out {out} is a file; name a directory for the run")
    if Run(out).exists:
        raise ValueError(f"{out} already holds a run; continue it with: dvae resume {out}, or choose another directory")
    with _arguments():
        method.check()  # wrong equations and options are found before the data are read
        training = Training(
            steps=steps,
            batch_size=batch_size,
            learning_rate=learning_rate,
            decay=decay,
            optimizer=optimizer,
            validate_every=validate_every,
            patience=patience,
            seed=seed,
            accelerator=accelerator,
            devices=devices,
            precision=precision,
        )
    opened = MotionData.open(data, protocol, skip_bad)
    _report(runs.fit_run(method, opened, out, training, trackers=[TensorBoard(out)] if tensorboard else []))


@app.command
def resume(
    run: Annotated[Path, tyro.conf.Positional],
    data: str | None = None,
    steps: int | None = None,
    learning_rate: float | None = None,
    tensorboard: bool = False,
) -> None:
    """Continue a run from its last checkpoint.

    The learning rate falls, and self-feeding rises, over the same shares of the run when it is made longer.

    Args:
        run: the run directory.
        data: where the data lie now, if the path in the run no longer leads there.
        steps: optimiser steps in all, to make the run longer.
        learning_rate: step size of the optimiser from here on.
        tensorboard: write TensorBoard files to the run directory too.
    """
    given = {"steps": steps, "learning_rate": learning_rate}
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    with _arguments():
        Training(**options)
    _report(runs.resume(run, data, [TensorBoard(run)] if tensorboard else [], progress=True, **options))


@app.command(help="Fit methods with several seeds and sizes, several runs at a time.")
def sweep(
    method: Annotated[tuple[SweptMethod, ...], tyro.conf.Positional],
    out: Path,
    options: MethodOptions,
    seeds: tuple[int, ...] = (0, 1, 2),
    latent: tuple[int, ...] = (),
    data: str = SIMULATED,
    protocol: ProtocolName | None = None,
    skip_bad: bool = False,
    steps: int = Training.steps,
    batch_size: int = Training.batch_size,
    learning_rate: float = 1e-3,
    decay: float = 0.5,
    optimizer: Literal["adam", "adamw", "sgd"] = Training.optimizer,
    validate_every: int = Training.validate_every,
    patience: int | None = Training.patience,
    accelerator: Literal["auto", "cpu", "cuda", "mps"] = "auto",
    precision: Literal["32-true", "64-true", "bf16-mixed", "bf16-true"] = Training.precision,
    jobs: int = 2,
    scheduler: str | None = None,
) -> None:
    """Fit methods with several seeds and sizes, several runs at a time, each on one thread.

    The same command continues a sweep that was stopped: finished runs are left as they are.

    Args:
        method: names of methods.
        out: directory of the run directories, such as srnn-seed0, or srnn-z8-seed0 where sizes differ.
        options: of all methods, in place of their defaults.
        seeds: of initial weights, batches and draws; a run for each.
        latent: sizes of z; a run for each.
        data: a motion file, or "simulated".
        protocol: how windows are cut, by default as suits the skeleton.
        skip_bad: leave out clips that cannot be used instead of refusing the file.
        steps: optimiser steps.
        batch_size: windows in a batch.
        learning_rate: step size of the optimiser.
        decay: last share of the run over which the learning rate falls linearly to 0.
        optimizer: which optimiser.
        validate_every: steps from one validation and checkpoint to the next.
        patience: validations without a better bound after which to stop a run.
        accelerator: where to compute.
        precision: of the computation.
        jobs: runs at a time.
        scheduler: address of a dask scheduler, such as tcp://host:8786, whose workers fit the runs in place of --jobs.
    """
    if not method or not seeds:
        raise UsageError("give at least one method and one seed")
    _at_least(1, jobs=jobs)
    if out.is_file():
        raise UsageError(f"--out {out} is a file; name a directory for the runs")
    given = {name: value for name, value in vars(options).items() if value is not None}
    with _arguments():
        sizes: list[dict[str, int]] = [{"latent": size} for size in latent] or [{}]
        chosen = [method_by_name(name, **given, **size) for name in method for size in sizes]
        for each in chosen:
            each.check()
        training = Training(
            steps=steps,
            batch_size=batch_size,
            learning_rate=learning_rate,
            decay=decay,
            optimizer=optimizer,
            validate_every=validate_every,
            patience=patience,
            accelerator=accelerator,
            precision=precision,
        )
    opened = MotionData.open(data, protocol, skip_bad)
    with _cluster(scheduler):
        results = sweep_methods(chosen, opened, out, seeds, training, jobs)
    if failed := [result for result in results if result.status == "failed"]:
        raise RuntimeError(
            f"{len(failed)} of {len(results)} runs failed, the same command tries them again\n"
            + "\n".join(map(str, failed))
        )
    how = "compare" if all(each.selects == "bound" for each in chosen) else "evaluate"
    OUT.print(f"all {len(results)} runs have ended; {how} them with: dvae {how} {out}/*", soft_wrap=True)


@app.command(help="Score runs on test windows.")
def evaluate(
    run: Annotated[tuple[Path, ...], tyro.conf.Positional],
    data: str | None = None,
    samples: int = 50,
    bound_particles: int = 0,
    log_score_particles: int = 0,
    pose_prior: Path | None = None,
    classifier: tuple[Path, ...] = (),
    joints: tuple[str, ...] | None = None,
    exchange: float | None = None,
    temperature: float | None = None,
    seed: int = 0,
    batch_size: int = 32,
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Score runs on the test windows of their protocol, beside zero velocity and nearest neighbours.

    Prints the table, and writes it with all that it rests on to evaluation.json in each run, or to --out. With given
    joints, the name of the file says which.

    Args:
        run: run directories, fitted on the same data under the same protocol.
        data: where the data lie now, if the path in the runs no longer leads there.
        samples: forecasts of each window, K.
        bound_particles: particles of the importance-weighted bound; 0 leaves it out.
        log_score_particles: particles of the log density of the future under the forecasts; 0 leaves it out.
        pose_prior: run of a pose-prior, by which to score the poses of the forecasts.
        classifier: runs of action-classifiers of different labels, by which to score what the forecasts show.
        joints: joints whose paths are given to the runs, for methods that take some (trajevae, cvae-rnn).
        exchange: begin each window with the pose of another one, whose given joints are so many metres from its own at
            most (in the paper .01).
        temperature: of the latents' scale, for such methods; 0 for motion at the mean of the prior.
        seed: of the draws.
        batch_size: windows forecast at once.
        out: file to write instead of evaluation.json in each run.
        figure: save the scores as dots with error bars.
    """
    if not run:
        raise UsageError("give at least one run directory")
    _at_least(1, samples=samples, batch_size=batch_size)
    _at_least(0, bound_particles=bound_particles, log_score_particles=log_score_particles)
    _check_file(out, "out", ".json")
    _check_figure(figure, "figure")
    loaded, windows = _on_the_same_windows(run, data)
    _note_unfinished(loaded)
    names = _names(loaded)
    given = None if (joints, exchange, temperature) == (None, None, None) else _joints(joints or ())
    for each in loaded:
        if given is not None and not isinstance(each.model, TrajectoryModel):
            raise UsageError(
                f"--joints, --exchange and --temperature are for methods that take trajectories; {each.path} holds "
                f"{each.method.name}"
            )
    classifiers = _classifiers(classifier, data, windows)
    prior = None if pose_prior is None else _pose_prior(pose_prior, data, windows.skeleton)
    if given is not None:
        windows = windows.given(given)
    result = evaluate_models(
        {name: each.model for name, each in zip(names, loaded, strict=True)},
        windows if exchange is None else motion.Exchanged(windows, exchange),
        scores=partial(motion.scores, pose_prior=prior, classifiers=classifiers),
        samples=samples,
        seed=seed,
        batch_size=batch_size,
        bound_particles=bound_particles,
        log_score_particles=log_score_particles,
        training_windows=loaded[0].data.windows("train+validation"),
        configs={name: Run(each.path).config for name, each in zip(names, loaded, strict=True)},
        options={} if temperature is None else {"temperature": temperature},
    )
    OUT.print(result.table())
    kind = "-".join(["evaluation", *(given or ()), *([f"exchanged-{exchange:g}"] if exchange is not None else ())])
    kind += "" if temperature is None else f"-temperature-{temperature:g}"
    for path in [out] if out is not None else [each.path / f"{kind}.json" for each in loaded]:
        result.save(path)
        ERROR.print(f"wrote {path}")
    if figure is not None:
        _save_figure(result.plot(), figure)


@app.command(help="Is a run's guide calibrated, and do its motions look like real ones?")
def criticise(
    run: Annotated[Path, tyro.conf.Positional],
    data: str | None = None,
    simulations: int = 200,
    draws: int = 99,
    ranked_steps: int = 4,
    samples: int = 20,
    draw_emission: bool = True,
    seed: int = 0,
    batch_size: int = 32,
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Simulation-based calibration of a run's guide, and predictive checks on the test windows.

    Prints both tables, and writes them with all that they rest on to criticism.json in the run, or to --out. Each is
    written as soon as it is there.

    Args:
        run: the run directory.
        data: where the data lie now, if the path in the run no longer leads there.
        simulations: sequences drawn from the model, as long as its windows.
        draws: from the guide for each simulation.
        ranked_steps: time steps, evenly spread, at which local latents are ranked.
        samples: replicates of each test window, at least 19.
        draw_emission: replicate draws of x, or its means, which lack the emission's noise: motion as it is shown. Of
            trajevae and cvae-rnn always means, as their emission is a weight of the loss.
        seed: of the draws.
        batch_size: windows replicated at once.
        out: file to write instead of criticism.json in the run.
        figure: save the figures, with -calibration and -checks added to this name.
    """
    _at_least(1, simulations=simulations, draws=draws, ranked_steps=ranked_steps, batch_size=batch_size)
    _at_least(19, samples=samples)
    _check_file(out, "out", ".json")
    _check_figure(figure, "figure")
    loaded = _load(run, data)
    _note_unfinished([loaded])
    windows = loaded.data.windows("test")
    steps = np.unique(np.linspace(1, windows.length, ranked_steps + 1)[1:].round().astype(int)).tolist()
    out = out or run / "criticism.json"
    document = {}

    def keep(part: str, result: Calibration | PredictiveChecks, figure_part: str) -> None:
        OUT.print(result.table())
        document[part] = result.document()
        with files.written(out) as file:
            file.write((json.dumps(document, indent=1, allow_nan=False) + "\n").encode())
        ERROR.print(f"wrote {out}: {part}")
        if figure is not None:
            _save_figure(result.plot(), figure.with_stem(f"{figure.stem}-{figure_part}"))

    if loaded.model.context:
        ERROR.print(
            f"no calibration: sequences are simulated from nothing, but {loaded.method.name} starts from a pose"
        )
    else:
        calibration = calibrate(loaded.model, windows.length, simulations, draws, steps=steps, seed=seed)
        keep("calibration", calibration, "calibration")
    checks = predictive_checks(
        {loaded.method.name: loaded.model},
        windows,
        motion.statistics(windows),
        samples=samples,
        draw_emission=draw_emission and not isinstance(loaded.model, TrajectoryModel),
        seed=seed,
        batch_size=batch_size,
    )
    keep("predictive", checks, "checks")


@app.command(help="Compare runs on test windows: bounds, paired differences with their errors, use of latents.")
def compare(
    run: Annotated[tuple[Path, ...], tyro.conf.Positional],
    data: str | None = None,
    particles: int = 64,
    estimates: int = 1,
    contrasts: int = 128,
    samples: int = 50,
    forecasts: bool = True,
    draw_emission: bool = False,
    stride: int | None = None,
    seed: int = 0,
    batch_size: int = 32,
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Compare runs on the test windows of their protocol. Runs that differ in the seed only are seeds of one row.

    All must have ended: one that was stopped is no whole fit.

    Args:
        run: run directories, fitted on the same data under the same protocol.
        data: where the data lie now, if the path in the runs no longer leads there.
        particles: of the importance-weighted bound, K.
        estimates: independent estimates of that bound; 25 or more for arviz, 1 otherwise.
        contrasts: windows among which the information of latents is measured; 0 leaves it out.
        samples: forecasts of each window.
        forecasts: score forecasts too, which takes longest.
        draw_emission: forecast draws of x instead of its means.
        stride: frames between the starts of test windows, in place of the protocol's: more is faster.
        seed: of the draws.
        batch_size: windows scored at once.
        out: file to write the comparison to, as JSON.
        figure: save bounds, differences, k-hat, and KL over time.
    """
    if not run:
        raise UsageError("give at least one run directory")
    _at_least(1, particles=particles, estimates=estimates, samples=samples, batch_size=batch_size, stride=stride)
    _at_least(0, contrasts=contrasts)
    _check_file(out, "out", ".json")
    _check_figure(figure, "figure")
    loaded, windows = _on_the_same_windows(run, data)
    if unfinished := _unfinished(loaded):
        raise ValueError("\n".join(unfinished))
    if stride is not None:
        first = loaded[0].data
        windows = motion.windows(first.motion, replace(first.protocol, test_stride=stride), "test")
    rows = _rows(loaded)
    result = compare_models(
        {name: [each.model for each in row] for name, row in rows.items()},
        windows,
        scores=motion.scores,
        particles=particles,
        estimates=estimates,
        contrasts=contrasts,
        samples=samples if forecasts else 0,
        draw_emission=draw_emission,
        seed=seed,
        batch_size=batch_size,
        configs={name: _config_without_seed(row[0]) for name, row in rows.items()},
    )
    OUT.print(result.table())
    if out is not None:
        result.save(out)
        ERROR.print(f"wrote {out}")
    if figure is not None:
        _save_figure(result.plot(), figure)


@app.command(help="Forecast the test windows, or those of one clip, many times each.")
def forecast(
    run: Annotated[Path, tyro.conf.Positional],
    out: Path,
    clip: str | None = None,
    horizon: int | None = None,
    samples: int = 10,
    fix: tuple[str, ...] = (),
    seed: int = 0,
    data: str | None = None,
    figure: Path | None = None,
) -> None:
    """Forecast the test windows, or those of one clip, many times each.

    The npz holds, in metres, `forecasts` (samples, windows, horizon, joints, 3), `observed` and `truth`
    (windows, frames, joints, 3), `split`, `clip` and `start` of each window, and the skeleton. `dvae animate` plays
    it, `dvae.motion.Forecasts.load` reads it.

    Args:
        run: the run directory.
        out: the npz file to write.
        clip: name of a clip, or split/name where the name is not unique; of any split.
        horizon: frames to forecast; by default those of the protocol.
        samples: forecasts of each window.
        fix: parts of the body, such as lower, or static latents, of which all forecasts of a window share one draw.
        seed: of the draws.
        data: where the data lie now, if the path in the run no longer leads there.
        figure: save a figure of the first window's futures.
    """
    _at_least(1, samples=samples, horizon=horizon)
    _check_file(out, "out", ".npz")
    _check_figure(figure, "figure")
    loaded = _load(run, data)
    windows = _windows_of(loaded, clip)
    futures = _forecasts(loaded, windows, range(len(windows)), samples, seed, horizon, fix)
    futures.save(out)
    frames = futures.forecasts.shape[2]
    ERROR.print(f"wrote {out}: {samples} futures of {frames} frames for each of {len(windows)} windows")
    if figure is not None:
        _save_futures(futures, figure)


@app.command(help="Complete motion along paths of some joints, from a clip or from a file.")
def complete(
    run: Annotated[Path, tyro.conf.Positional],
    out: Path,
    joints: tuple[str, ...] = (),
    paths: Path | None = None,
    clip: str | None = None,
    window: int | None = None,
    samples: int = 5,
    exact: bool = False,
    temperature: float = 1.0,
    seed: int = 0,
    data: str | None = None,
    figure: Path | None = None,
) -> None:
    """Complete motion along paths of some joints, from a clip or from a file.

    The motions start at the first pose of a window, and follow its own `--joints`, or the paths of a file. That is an
    npz of one array (frames, 3) for each joint, or a csv with a header such as LWrist_x,LWrist_y,LWrist_z and one row
    for each frame: metres, with the pelvis of the first pose at the origin; empty or nan where a path is not known.
    What is written is what `dvae forecast` writes.

    Args:
        run: the run directory of a trajevae or cvae-rnn.
        out: the npz file to write.
        joints: joints whose way in the window is given.
        paths: file of other paths.
        clip: name of a clip, or split/name where the name is not unique; by default any test window.
        window: which of its windows, from 0; by default the one that moves most.
        samples: motions.
        exact: have the given joints on their paths, with bones at their lengths, by moving the motions' latents and, by
            what that leaves, their poses.
        temperature: of the latents' scale; 0 for the motion of the prior's mean.
        seed: of the draws.
        data: where the data lie now, if the path in the run no longer leads there.
        figure: save a figure of the motions; crosses are the given paths.
    """
    _at_least(1, samples=samples)
    _at_least(0, window=window)
    _check_file(out, "out", ".npz")
    _check_figure(figure, "figure")
    loaded = _load(run, data)
    if not isinstance(loaded.model, TrajectoryModel):
        raise UsageError(f"{run} holds {loaded.method.name}, which takes no paths; fit a trajevae or cvae-rnn")
    if exact and not (joints or paths):
        raise UsageError("--exact has motions follow paths; say which, by --joints or --paths")
    windows = _windows_of(loaded, clip)
    positions = windows.positions(windows.all()["x"]).numpy()
    chosen = _liveliest(positions, window)
    pose, truth = positions[chosen, 0], positions[chosen, 1:]
    given = {joint: truth[:, windows.skeleton.find(joint)] for joint in _joints(joints)}
    if paths is not None:
        drawn = motion.read_paths(paths)
        if twice := {windows.skeleton.find(joint) for joint in given} & {
            windows.skeleton.find(joint) for joint in drawn
        }:
            names = ", ".join(windows.skeleton.names[joint] for joint in twice)
            raise UsageError(
                f"{names} is named by --joints, and {paths} has a path of it; say which by leaving one out"
            )
        given |= drawn
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        done = loaded.model.complete(
            pose,
            given,
            None if given else len(truth),
            samples,
            exact=exact,
            temperature=temperature,
            progress=True,
        )
    truth = truth[: done.positions.shape[1]]
    motions = motion.Forecasts(
        windows.skeleton, [windows.keys[chosen]], done.positions[:, None], pose[None, None], truth[None]
    )
    motions.save(out)
    OUT.print(str(done))
    ERROR.print(f"wrote {out}: window {chosen}, {_title(motions)}")
    if figure is not None:
        _save_futures(motions, figure, given)


@app.command(help="Play forecasts beside what happened, or a clip, as moving skeletons.")
def animate(
    source: Annotated[str, tyro.conf.Positional],
    out: Path,
    clip: str | None = None,
    window: int | None = None,
    samples: int | None = None,
    fix: tuple[str, ...] = (),
    seed: int = 0,
    data: str | None = None,
    every: int | None = None,
    figure: Path | None = None,
) -> None:
    """Play forecasts beside what happened, or a clip, as moving skeletons.

    The page is one file that any browser shows, without a network: to play, to scrub, to turn with the mouse.

    Args:
        source: a run directory, a file that `dvae forecast` wrote, a motion file, or "simulated".
        out: the html file to write.
        clip: name of a clip, or split/name where the name is not unique. Without it, futures are those of any test
            window, and a motion file shows its first clip.
        window: which of the windows of futures, from 0; by default the one that moves most.
        samples: futures side by side; by default 5, or as many as the file has.
        fix: parts of the body, such as lower, or static latents, of which all of a run's futures share one draw.
        seed: of a run's draws.
        data: where a run's data lie now, if the path in the run no longer leads there.
        every: frames from one that is shown to the next; by default about 25 a second are shown.
        figure: save a figure of the futures, too.
    """
    from .motion.plot import animate as animation
    from .motion.plot import save_html

    _at_least(1, samples=samples, every=every)
    _at_least(0, window=window)
    _check_file(out, "out", ".html", ".htm")
    _check_figure(figure, "figure")
    if Path(source).is_dir():
        loaded = _load(Path(source), data)
        windows = _windows_of(loaded, clip)
        chosen = _liveliest(windows.positions(windows.all()["x"]).numpy(), window)
        futures = _forecasts(loaded, windows, [chosen], samples or 5, seed, fix=fix)
    elif fix:
        raise UsageError(f"--fix is about the futures that a run draws; {source} is no run directory")
    elif data is not None:
        raise UsageError(f"--data tells where the data of a run lie; {source} is no run directory")
    elif source != SIMULATED and motion.is_forecasts(source):
        stored = motion.Forecasts.load(source)
        known = [n for n, key in enumerate(stored.keys) if clip in (None, key[1], f"{key[0]}/{key[1]}")]
        if not known:
            raise ValueError(f"{source} has no window of a clip {clip!r}")
        if samples is not None and samples > len(stored.forecasts):
            raise UsageError(f"--samples {samples}: {source} has {len(stored.forecasts)} of each window")
        chosen = _liveliest(np.concatenate([stored.observed, stored.truth], 1)[known], window)
        futures = stored.window(known[chosen], samples or 5)
    elif window is not None or samples is not None or figure is not None:
        raise UsageError(f"--window, --samples and --figure are about futures; {source} has none")
    else:
        clips = motion.simulate() if source == SIMULATED else motion.read_motion(source)
        shown = clips.clips[0] if clip is None else _clip(clips, clip)
        save_html(animation(clips.skeleton, shown.positions, every=every, title="/".join(shown.key)), out)
        ERROR.print(f"wrote {out}: {'/'.join(shown.key)}, {shown.frames} frames")
        return
    page = animation(
        futures.skeleton,
        futures.observed[0],
        futures.forecasts[:, 0],
        futures.truth[0],
        fixed=_alike(futures),
        every=every,
        title=_title(futures),
    )
    save_html(page, out)
    ERROR.print(f"wrote {out}: window {chosen}, {_title(futures)}")
    if figure is not None:
        _save_futures(futures, figure)


@data_app.command(name="info")
def data_info(
    file: Annotated[str, tyro.conf.Positional] = SIMULATED,
    skip_bad: bool = False,
) -> None:
    """Say what a motion file holds: splits, clips, skeleton, how rigid its bones are, labels.

    Args:
        file: an npz file, or "simulated".
        skip_bad: leave out clips that cannot be used, and list them, instead of refusing the file.
    """
    clips = motion.simulate() if file == SIMULATED else motion.read_motion(file, skip_bad=skip_bad)
    OUT.print(clips.info())


app.command(data_app, name="data", help="Look into motion files.")

COMMANDS: dict[str, Any] = {
    "list": list_methods,
    "show": show,
    "fit": fit,
    "resume": resume,
    "sweep": sweep,
    "evaluate": evaluate,
    "criticise": criticise,
    "compare": compare,
    "forecast": forecast,
    "complete": complete,
    "animate": animate,
    "data": data_info,
}
DATA_COMMANDS = {"info": data_info}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        arguments: those of the process by default.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in given
    given = [argument for argument in given if argument != "--debug"]
    warnings.showwarning = _note
    try:
        if given and not given[0].startswith("-") and given[0] not in COMMANDS:
            raise UsageError(f"unknown command {given[0]!r}{nearest(given[0], COMMANDS)}; known: {', '.join(COMMANDS)}")
        app.cli(
            prog="dvae",
            description="Dynamical variational autoencoders from their factorizations. "
            "With --debug, a failure shows its traceback.",
            args=given,
            config=(tyro.conf.CascadeSubcommandArgs, tyro.conf.OmitArgPrefixes),
        )
        return 0
    except SystemExit as stop:  # tyro, after --help or wrong arguments
        if stop.code:
            for meant in _meant(given):
                ERROR.print(meant, markup=False)
        return stop.code if isinstance(stop.code, int) else 2
    except Interrupted as stop:
        ERROR.print(f"interrupted after step {stop.fit.step}; resume with: dvae resume {stop.fit.run}")
        return 128 + stop.signal
    except SweepInterrupted as stop:
        ERROR.print(str(stop))
        return 128 + stop.signal
    except KeyboardInterrupt:
        ERROR.print("interrupted")
        return 130
    except Exception as error:
        if debug:
            traceback.print_exc()
        expected = isinstance(error, ValueError | OSError | RuntimeError | FloatingPointError)
        hint = "" if expected or debug else " (this looks like a bug: --debug shows the traceback)"
        ERROR.print("error: ", style="bold red", end="")
        ERROR.print((reason(error) or type(error).__name__) + hint)
        return 2 if isinstance(error, UsageError) else 1


def _meant(given: Sequence[str]) -> Iterator[str]:
    """Sentences on names that are none, but near to one: of methods, of commands, and the choices of options."""
    command, *rest = given or [""]
    loose = [
        word
        for before, word in zip(["", *rest[:-1]], rest, strict=True)
        if not word.startswith("-") and (command == "sweep" or not before.startswith("-"))
    ]
    names = {"fit": list(methods()), "data": list(DATA_COMMANDS)}.get(command, [])
    for word in loose[:1] if not set(names) & set(rest) else []:
        if meant := nearest(word, names):
            yield f"{word!r} is unknown{meant}"
    hints = [get_type_hints(COMMANDS[command])] if command in COMMANDS else []
    hints += [get_type_hints(kind) for kind in methods().values()] if command in ("fit", "sweep") else []
    choices = {name: _choices(hint) for each in reversed(hints) for name, hint in each.items() if _choices(hint)}
    if command == "sweep":
        loose = [word for word in loose if word not in choices["method"]]
    for option, word in pairwise(rest):
        known = choices.get(option.removeprefix("--").replace("-", "_"), []) if option.startswith("--") else []
        if known and word not in known and (meant := nearest(word, known)):
            yield f"{option} {word!r} is unknown{meant}"
    for word in loose if command == "sweep" else []:
        if meant := nearest(word, choices["method"]):
            yield f"{word!r} is unknown{meant}"


def _choices(hint: Any) -> list[str]:
    """The names that a type allows, wherever in it they are."""
    if get_origin(hint) is Literal:
        return [name for name in get_args(hint) if isinstance(name, str)]
    return [name for part in get_args(hint) for name in _choices(part)]


def _note(message: Warning | str, *_: object, **__: object) -> None:
    """A warning as a user of the command line reads it, without the place in the code."""
    ERROR.print(f"note: {message}", markup=False)


@contextmanager
def _arguments() -> Iterator[None]:
    """What is refused within it is an argument."""
    try:
        yield
    except ValueError as error:
        raise UsageError(str(error)) from error


@contextmanager
def _cluster(scheduler: str | None) -> Iterator[None]:
    """Within it, joblib runs on the workers of a dask scheduler, if there is one."""
    if scheduler is None:
        yield
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise UsageError("--scheduler needs dask: pip install 'pyro-dvae[dask]'") from error
    with Client(scheduler) as client, parallel_config(backend="dask", client=client):
        yield


def _joints(given: Sequence[str]) -> list[str]:
    """Names of joints, with commas or blanks between them."""
    return [name for text in given for name in text.replace(",", " ").split()]


def _at_least(smallest: int, **options: int | None) -> None:
    for name, value in options.items():
        if value is not None and value < smallest:
            raise UsageError(f"--{name.replace('_', '-')} is {value}; it must be at least {smallest}")


def _check_file(path: Path | None, option: str, *suffixes: str) -> None:
    """Refuse, before any work, a path that cannot become a file, or whose name ends as that of another kind of file."""
    if path is not None and path.is_dir():
        raise UsageError(f"--{option} {path} is a directory; name a file")
    if path is not None and path.suffix.lower() not in (suffixes or (path.suffix.lower(),)):
        raise UsageError(f"--{option} {path}: what is written is {suffixes[0][1:]}; end its name in {suffixes[0]}")


def _check_figure(path: Path | None, option: str) -> None:
    """Refuse, before any work, a path that cannot become a figure."""
    _check_file(path, option)
    if path is not None:
        from matplotlib.backend_bases import FigureCanvasBase

        known = FigureCanvasBase.get_supported_filetypes()
        if path.suffix.lower().removeprefix(".") not in known:
            raise UsageError(f"--{option} {path}: the end of the name is the format, one of {', '.join(sorted(known))}")


def _asks_for_equations(kind: Any) -> bool:
    """Whether the equations of a method are options of it."""
    return "generative" in {option.name for option in fields(kind)}


def _report(result: Fit) -> None:
    found = ", ".join(filter(None, [f"{result.status} at step {result.step}", result.best]))
    OUT.print(found, highlight=False, soft_wrap=True)
    assert result.run is not None
    OUT.print(_use(Run(result.run).config["method"]["method"], result.run), highlight=False, soft_wrap=True)


def _use(name: str, run: Path) -> str:
    """What to do with a fitted run."""
    if name in judges():
        what = "the poses of forecasts" if name == "pose-prior" else "forecasts"
        option = "--pose-prior" if name == "pose-prior" else "--classifier"
        return f"score {what} with: dvae evaluate RUN {option} {run}"
    if issubclass(methods()[name], TrajectoryMethod):
        joints = f"{run} --joints JOINT …"
        return f"score it with: dvae evaluate {joints}, move it with: dvae complete {joints}"
    return f"score it with: dvae evaluate {run}"


def _pose_prior(path: Path, data: str | None, skeleton: motion.Skeleton) -> Any:
    """The pose prior of a run, for poses of a skeleton."""
    model = runs.load(path, data).model
    if not isinstance(model, PosePriorModel) or model.skeleton != skeleton:
        raise UsageError(f"--pose-prior {path} is no run of a pose-prior of the skeleton {skeleton.name!r}")
    return model


def _classifiers(paths: Sequence[Path], data: str | None, windows: motion.Windows) -> dict[str, Any]:
    """The action classifiers of runs by their label, fitted under the protocol of the windows."""
    found: dict[str, Any] = {}
    for path in paths:
        loaded = runs.load(path, data)
        if loaded.method.name != "action-classifier":
            raise UsageError(f"--classifier {path} is a fitted {loaded.method.name}, no action-classifier")
        if loaded.model.label in found:
            raise UsageError(f"--classifier {path} is the second of the label {loaded.model.label!r}; give one of them")
        if loaded.data.windows("test").fingerprint != windows.fingerprint:
            where = loaded.config.data.path
            raise UsageError(
                f"--classifier {path} was fitted on other data or under another protocol ({where}, "
                f"{loaded.schema.protocol.name}) than the runs ({windows.protocol.name}); it may have seen test clips"
            )
        _note_unfinished([loaded])
        found[loaded.model.label] = loaded.model
    return found


def _load(path: Path, data: str | None) -> runs.Loaded:
    """A run of a method that forecasts."""
    loaded = runs.load(path, data)
    if loaded.method.name in judges():
        raise ValueError(
            f"{path} is a fitted {loaded.method.name}, which forecasts nothing; its bounds are in {path / 'log.jsonl'}"
        )
    return loaded


def _on_the_same_windows(paths: Sequence[Path], data: str | None) -> tuple[list[runs.Loaded], motion.Windows]:
    """Runs, which hold the data of the first, and their test windows, which must be the same."""
    twice, count = Counter(map(str, paths)).most_common(1)[0]
    if count > 1:
        raise UsageError(f"a run is named twice: {twice}")
    first = _load(paths[0], data)
    windows, loaded = first.data.windows("test"), [first]
    for path in paths[1:]:
        other = _load(path, data)
        if not other.share(first):
            there, here = (f"{run.config.data.path}, {run.schema.protocol.name}" for run in (other, first))
            raise ValueError(
                f"{other.path} has other test windows ({there}) than {first.path} ({here}); give runs of the same data "
                "and protocol"
            )
        loaded.append(other)
    return loaded, windows


def _rows(loaded: Sequence[runs.Loaded]) -> dict[str, list[runs.Loaded]]:
    """Runs by row: those that differ in the training seed only together, under the method and what tells rows apart."""
    rows: dict[str, list[runs.Loaded]] = {}
    seeds: dict[tuple[str, int], Path] = {}
    for run in loaded:
        key = json.dumps(_config_without_seed(run), sort_keys=True)
        seed = runs.read_config(run.path).training.seed
        if (key, seed) in seeds:
            raise UsageError(f"{run.path} and {seeds[key, seed]} are the same fit with the same seed; give one of them")
        seeds[key, seed] = run.path
        rows.setdefault(key, []).append(run)
    firsts = [row[0] for row in rows.values()]
    names = [first.method.name for first in firsts]
    for name in [name for name, count in Counter(names).items() if count > 1]:
        places = [place for place, other in enumerate(names) if other == name]
        for place, said in zip(places, _apart([firsts[place] for place in places]), strict=True):
            names[place] = f"{name} ({said})"
    return dict(zip(names, rows.values(), strict=True))


def _apart(loaded: Sequence[runs.Loaded]) -> list[str]:
    """What tells runs of one method apart: options, or else the names of their directories, or else whole paths."""
    options = [_options(run) for run in loaded]
    keys = dict.fromkeys(key for own in options for key in own)
    differing = [key for key in keys if len({str(own.get(key)) for own in options}) > 1]
    said = [", ".join(f"{key.partition('.')[2]} {own[key]}" for key in differing if key in own) for own in options]
    candidates = (said, [run.path.absolute().name for run in loaded], [str(run.path) for run in loaded])
    return next(texts for texts in candidates if all(texts) and len(set(texts)) == len(texts))


def _options(run: runs.Loaded) -> dict[str, Any]:
    """The options of method and training that were chosen; the training's self-feeding follows from the method's."""
    config = _config_without_seed(run)
    training = {key: value for key, value in config["training"].items() if key != "self_feeding"}
    return dict(flat({"method": config["method"], "training": training}))


def _unfinished(loaded: Sequence[runs.Loaded]) -> list[str]:
    """A sentence on every run that has not ended."""
    sentences = []
    for run in loaded:
        state, steps = Run(run.path).state, runs.read_config(run.path).training.steps
        if (status := state["status"]) not in ENDED:
            where = f"{status} at step {state['step']} of {steps}"
            sentences.append(f"{run.path} has not ended ({where}); dvae resume {run.path} goes on")
    return sentences


def _note_unfinished(loaded: Sequence[runs.Loaded]) -> None:
    for sentence in _unfinished(loaded):
        ERROR.print(f"note: {sentence}", markup=False)


def _config_without_seed(run: runs.Loaded) -> dict[str, Any]:
    """What was run, without the seed and what bears on no result."""
    config = Run(run.path).config
    aside = {"seed", "progress", "log_every"}
    training = {key: value for key, value in config["training"].items() if key not in aside}
    return {**config, "training": training, "data": {k: v for k, v in config["data"].items() if k != "path"}}


def _names(loaded: Sequence[runs.Loaded]) -> list[str]:
    """Names of methods, of run directories where methods repeat, and whole paths where these repeat too."""
    candidates = ([run.method.name for run in loaded], [run.path.name for run in loaded])
    paths = [str(run.path) for run in loaded]
    return next((names for names in candidates if len(set(names)) == len(names)), paths)


def _clip(clips: motion.MotionSet, name: str) -> motion.Clip:
    found = [clip for clip in clips if name in (clip.name, f"{clip.split}/{clip.name}")]
    if not found:
        meant = nearest(name, [known for clip in clips for known in (clip.name, f"{clip.split}/{clip.name}")])
        raise ValueError(f"no clip {name!r}{meant} in {clips.name}; `dvae data info` tells what is there")
    if len(found) > 1:
        keys = " or ".join("/".join(clip.key) for clip in found)
        raise ValueError(f"{name!r} is the name of {len(found)} clips; say {keys}")
    return found[0]


def _windows_of(loaded: runs.Loaded, clip: str | None) -> motion.Windows:
    """The test windows of a run's data, or all windows of one clip, of any split."""
    if clip is None:
        found: motion.Windows = loaded.data.windows("test")
        return found
    chosen = motion.MotionSet([_clip(loaded.data.motion, clip)], loaded.data.motion.skeleton, loaded.config.data.path)
    anywhere = replace(loaded.schema.protocol, split_by="split", test=tuple(chosen.splits), train=())
    return motion.windows(chosen, anywhere, "test")


def _forecasts(
    loaded: runs.Loaded,
    windows: motion.Windows,
    chosen: Sequence[int],
    samples: int,
    seed: int,
    horizon: int | None = None,
    fix: Sequence[str] = (),
) -> motion.Forecasts:
    """Futures of some of the windows; those of a window share one draw of what is fixed."""
    free = {*getattr(loaded.model, "parts", ()), *_statics(loaded.model)}
    if unknown := [name for name in fix if name not in free]:
        raise UsageError(
            f"--fix {' '.join(unknown)}: {loaded.path} has "
            + (f"{', '.join(sorted(free))} to fix" if free else "nothing to fix, no parts and no static latents")
        )
    observed, horizon = loaded.schema.protocol.observed, horizon or loaded.schema.protocol.predicted
    x, keys = windows.all()["x"][list(chosen)], windows.keys
    past, future = x[:, :observed], x[:, observed:][:, :horizon]
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        whole = max(horizon, loaded.schema.protocol.predicted) if fix else horizon  # parts are fixed as a whole
        parts = []
        for part in past.split(64):
            once = loaded.model.forecast({"x": part}, whole, 1) if fix else {}
            held = {"fix": {name: once[name][0] for name in fix}} if fix else {}
            made = loaded.model.forecast({"x": part}, whole, samples, **held)["x"][:, :, :horizon]
            parts.append(windows.positions(made).numpy())
            del made  # with many samples the largest thing here
    positions = [np.concatenate(parts, axis=1), *(windows.positions(frames).numpy() for frames in (past, future))]
    return motion.Forecasts(windows.skeleton, [keys[n] for n in chosen], *positions)


def _statics(model: Any) -> list[str]:
    return [name for name in model.latents if not model.generative.local(name)]


def _alike(futures: motion.Forecasts) -> list[int]:
    """The joints but the root that move alike in all futures of the first window, where there are several."""
    sampled = futures.forecasts[:, 0]
    alike = (sampled == sampled[:1]).all((0, 1, 3)) & (len(sampled) > 1)
    return [joint for joint in np.flatnonzero(alike).tolist() if joint != futures.skeleton.root]


def _liveliest(positions: np.ndarray, window: int | None) -> int:
    """The window that was asked for, or the one of (N, T, J, 3) whose joints move fastest."""
    if window is None:
        return int(np.linalg.norm(np.diff(positions, axis=1), axis=-1).mean((1, 2)).argmax())
    if window >= len(positions):
        raise UsageError(f"--window {window}: they go from 0 to {len(positions) - 1}")
    return window


def _title(futures: motion.Forecasts) -> str:
    split, clip, start = futures.keys[0]
    return f"{split}/{clip} from frame {start}: {len(futures.forecasts)} futures"


def _save_futures(futures: motion.Forecasts, path: Path, paths: Mapping[str, Any] | None = None) -> None:
    """A figure of the first window's futures, and of the paths that joints were given."""
    from matplotlib.figure import Figure

    from .motion.plot import futures as draw

    drawing = Figure(figsize=(9, 2.6), layout="constrained")
    window = futures.observed[0], futures.forecasts[:, 0], futures.truth[0]
    axes = draw(futures.skeleton, *window, ax=drawing.subplots(), paths=paths)
    axes.set_title(_title(futures), fontsize=9, parse_math=False)
    _save_figure(drawing, path)


def _save_figure(figure: Figure, path: Path) -> None:
    with files.written(path) as file:
        figure.savefig(file, format=path.suffix.lower().removeprefix("."), dpi=150)
    ERROR.print(f"wrote {path}")


if __name__ == "__main__":
    sys.exit(main())
