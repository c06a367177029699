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
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, make_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import numpy as np
import torch
import tyro
from joblib import parallel_config
from rich.console import Console
from rich.table import Table

from . import motion
from .graph import audit
from .inference.checkpoints import Run
from .inference.compare import compare as compare_models
from .inference.criticism import Calibration, PredictiveChecks, calibrate, predictive_checks
from .inference.evaluate import evaluate as evaluate_models
from .inference.fit import Fit, Interrupted, Training
from .inference.trackers import TensorBoard
from .models import method as method_by_name
from .models import methods, runs
from .models.method import Method
from .models.sweep import ENDED
from .models.sweep import Interrupted as SweepInterrupted
from .models.sweep import sweep as sweep_methods

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    MethodChoice = Method
    ProtocolName = str
    SweptMethod = str
    MethodOptions = Any
else:
    SweptMethod = tyro.extras.literal_type_from_choices(
        [name for name, kind in methods().items() if "generative" not in {option.name for option in fields(kind)}]
    )
    MethodOptions = make_dataclass(
        "MethodOptions",
        [(o.name, get_type_hints(Method)[o.name] | None, None) for o in fields(Method) if o.name != "latent"],
        frozen=True,
        namespace={"__doc__": Method.__doc__},
    )
    ProtocolName = tyro.extras.literal_type_from_choices(motion.PROTOCOLS)
    MethodChoice = tyro.extras.subcommand_type_from_defaults(
        {name: kind() for name, kind in methods().items()},
        descriptions={name: kind.source for name, kind in methods().items()},
        prefix_names=False,
    )

# Both keep to the width of the terminal; a file or a pipe gets lines as long as they need to be.
OUT = Console(width=None if sys.stdout.isatty() else 200)
ERROR = Console(stderr=True, soft_wrap=True, highlight=False)


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
        generative, inference = kind.generative, kind.inference
    if not generative or not inference:
        raise UsageError("give the name of a method, or both --generative and --inference")
    with _arguments():
        found = audit(generative, inference)
    OUT.print(f"{found.generative}\n{found.inference}", highlight=False, markup=False, soft_wrap=True)
    OUT.print(found.table())
    OUT.print(found.verdict)
    if out is not None:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(2 * (0.85 * steps + 1.6), 4.2), layout="constrained")
        model, guide = figure.subplots(1, 2)
        found.generative.draw(steps, ax=model).set_title("model")
        title = "guide" if found.exact else "guide (dashed: what the exact posterior also reads)"
        found.draw(steps, ax=guide).set_title(title)
        _save_figure(figure, out)


@app.command(help="Fit a method, or equations of your own, to motion data.")
def fit(
    method: MethodChoice,
    out: Path,
    data: str = runs.SIMULATED,
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
        method.build({"x": 1})  # wrong equations and options are found before the data are read
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
    opened = runs.Data.open(data, protocol, skip_bad)
    _report(runs.fit(method, opened, out, training, trackers=[TensorBoard(out)] if tensorboard else []))


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
    data: str = runs.SIMULATED,
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
            each.build({"x": 1})
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
    opened = runs.Data.open(data, protocol, skip_bad)
    with _cluster(scheduler):
        results = sweep_methods(chosen, opened, out, seeds, training, jobs)
    if failed := [result for result in results if result.status == "failed"]:
        raise RuntimeError(
            f"{len(failed)} of {len(results)} runs failed, the same command tries them again\n"
            + "\n".join(map(str, failed))
        )
    OUT.print(f"all {len(results)} runs have ended; compare them with: dvae compare {out}/*", soft_wrap=True)


@app.command(help="Score runs on test windows.")
def evaluate(
    run: Annotated[tuple[Path, ...], tyro.conf.Positional],
    data: str | None = None,
    samples: int = 50,
    bound_particles: int = 0,
    seed: int = 0,
    batch_size: int = 32,
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Score runs on the test windows of their protocol, beside zero velocity and nearest neighbours.

    Prints the table, and writes it with all that it rests on to evaluation.json in each run, or to --out.

    Args:
        run: run directories, fitted on the same data under the same protocol.
        data: where the data lie now, if the path in the runs no longer leads there.
        samples: forecasts of each window, K.
        bound_particles: particles of the importance-weighted bound; 0 leaves it out.
        seed: of the draws.
        batch_size: windows forecast at once.
        out: file to write instead of evaluation.json in each run.
        figure: save the scores as dots with error bars.
    """
    if not run:
        raise UsageError("give at least one run directory")
    _at_least(1, samples=samples, batch_size=batch_size)
    _at_least(0, bound_particles=bound_particles)
    _check_file(out, "out")
    _check_figure(figure, "figure")
    loaded, windows = _on_the_same_windows(run, data)
    _note_unfinished(loaded)
    names = _names(loaded)
    result = evaluate_models(
        {name: each.model for name, each in zip(names, loaded, strict=True)},
        windows,
        samples=samples,
        seed=seed,
        batch_size=batch_size,
        bound_particles=bound_particles,
        training_windows=loaded[0].data.windows("train+validation"),
        configs={name: Run(each.path).config for name, each in zip(names, loaded, strict=True)},
    )
    OUT.print(result.table())
    for path in [out] if out is not None else [each.path / "evaluation.json" for each in loaded]:
        path.parent.mkdir(parents=True, exist_ok=True)
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
        draw_emission: replicate draws of x, or its means, which lack the emission's noise: motion as it is shown.
        seed: of the draws.
        batch_size: windows replicated at once.
        out: file to write instead of criticism.json in the run.
        figure: save the figures, with -calibration and -checks added to this name.
    """
    _at_least(1, simulations=simulations, draws=draws, ranked_steps=ranked_steps, batch_size=batch_size)
    _at_least(19, samples=samples)
    _check_file(out, "out")
    _check_figure(figure, "figure")
    loaded = runs.load(run, data)
    _note_unfinished([loaded])
    windows = loaded.data.windows("test")
    steps = np.unique(np.linspace(1, windows.length, ranked_steps + 1)[1:].round().astype(int)).tolist()
    out = out or run / "criticism.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    document = {}

    def keep(part: str, result: Calibration | PredictiveChecks, figure_part: str) -> None:
        OUT.print(result.table())
        document[part] = result.document()
        out.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        ERROR.print(f"wrote {out}: {part}")
        if figure is not None:
            _save_figure(result.plot(), figure.with_stem(f"{figure.stem}-{figure_part}"))

    calibration = calibrate(loaded.model, windows.length, simulations, draws, steps=steps, seed=seed)
    keep("calibration", calibration, "calibration")
    checks = predictive_checks(
        {loaded.method.name: loaded.model},
        windows,
        samples=samples,
        draw_emission=draw_emission,
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
    _check_file(out, "out")
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
        out.parent.mkdir(parents=True, exist_ok=True)
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
    seed: int = 0,
    data: str | None = None,
    figure: Path | None = None,
) -> None:
    """Forecast the test windows, or those of one clip, many times each.

    The npz holds, in metres, `forecasts` (samples, windows, horizon, joints, 3), `observed` and `truth`
    (windows, frames, joints, 3), and `split`, `clip` and `start` of each window.

    Args:
        run: the run directory.
        out: the npz file to write.
        clip: name of a clip, or split/name where the name is not unique; of any split.
        horizon: frames to forecast; by default those of the protocol.
        samples: forecasts of each window.
        seed: of the draws.
        data: where the data lie now, if the path in the run no longer leads there.
        figure: save a figure of the first window's futures.
    """
    _at_least(1, samples=samples, horizon=horizon)
    _check_file(out, "out")
    _check_figure(figure, "figure")
    loaded = runs.load(run, data)
    protocol = loaded.data.protocol
    if clip is None:
        windows = loaded.data.windows("test")
    else:
        chosen = motion.MotionSet([_clip(loaded.data.motion, clip)], loaded.data.motion.skeleton, loaded.data.path)
        anywhere = replace(protocol, split_by="split", test=tuple(chosen.splits), train=())
        windows = motion.windows(chosen, anywhere, "test")
    x = windows.all()["x"]
    past, future = x[:, : protocol.observed], x[:, protocol.observed :]
    horizon = horizon or protocol.predicted
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        parts = [loaded.model.forecast({"x": part}, horizon, samples)["x"] for part in past.split(64)]
    forecasts = windows.positions(torch.cat(parts, dim=1))
    observed, truth = windows.positions(past), windows.positions(future[:, :horizon])
    split, name, start = zip(*windows.keys, strict=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    with out.open("wb") as file:  # an open file: numpy would append .npz to a name
        np.savez_compressed(
            file,
            forecasts=forecasts.numpy(),
            observed=observed.numpy(),
            truth=truth.numpy(),
            split=np.array(split),
            clip=np.array(name),
            start=np.array(start),
        )
    ERROR.print(f"wrote {out}: {samples} futures of {horizon} frames for each of {len(x)} windows")
    if figure is not None:
        from matplotlib.figure import Figure

        from .motion.plot import futures

        known = truth[0] if truth.shape[1] == horizon else None
        drawing = Figure(figsize=(9, 2.6), layout="constrained")
        axes = futures(windows.skeleton, observed[0], forecasts[:, 0], known, ax=drawing.subplots())
        axes.set_title(f"{split[0]}/{name[0]} from frame {start[0]}: {samples} futures", fontsize=9)
        _save_figure(drawing, figure)


@data_app.command(name="info")
def data_info(
    file: Annotated[str, tyro.conf.Positional] = runs.SIMULATED,
    skip_bad: bool = False,
) -> None:
    """Say what a motion file holds: splits, clips, skeleton, how rigid its bones are, labels.

    Args:
        file: an npz file, or "simulated".
        skip_bad: leave out clips that cannot be used, and list them, instead of refusing the file.
    """
    clips = motion.simulate() if file == runs.SIMULATED else motion.load(file, skip_bad=skip_bad)
    OUT.print(clips.info())


app.command(data_app, name="data", help="Look into motion files.")


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
        app.cli(
            prog="dvae",
            description="Dynamical variational autoencoders from their factorizations. "
            "With --debug, a failure shows its traceback.",
            args=given,
            config=(tyro.conf.CascadeSubcommandArgs, tyro.conf.OmitArgPrefixes),
        )
        return 0
    except SystemExit as stop:  # tyro, after --help or wrong arguments
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
        ERROR.print("[bold red]error:[/bold red] ", end="")
        ERROR.print((str(error) or type(error).__name__) + hint, markup=False)
        return 2 if isinstance(error, UsageError) else 1


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


def _at_least(smallest: int, **options: int | None) -> None:
    for name, value in options.items():
        if value is not None and value < smallest:
            raise UsageError(f"--{name.replace('_', '-')} is {value}; it must be at least {smallest}")


def _check_file(path: Path | None, option: str) -> None:
    """Refuse, before any work, a path that cannot become a file."""
    if path is not None and path.is_dir():
        raise UsageError(f"--{option} {path} is a directory; name a file")


def _check_figure(path: Path | None, option: str) -> None:
    """Refuse, before any work, a path that cannot become a figure."""
    _check_file(path, option)
    if path is not None:
        from matplotlib.backend_bases import FigureCanvasBase

        known = FigureCanvasBase.get_supported_filetypes()
        if path.suffix.lower().removeprefix(".") not in known:
            raise UsageError(f"--{option} {path}: the end of the name is the format, one of {', '.join(sorted(known))}")


def _asks_for_equations(kind: Method | type[Method]) -> bool:
    """Whether the equations of a method are options of it."""
    return "generative" in {option.name for option in fields(kind)}


def _report(result: Fit) -> None:
    best = (
        ""
        if result.best_bound is None
        else f", best bound {result.best_bound:.3f} nats a frame at step {result.best_step}"
    )
    OUT.print(f"{result.status} at step {result.step}{best}", highlight=False, soft_wrap=True)
    OUT.print(f"score it with: dvae evaluate {result.run}", highlight=False, soft_wrap=True)


def _on_the_same_windows(paths: Sequence[Path], data: str | None) -> tuple[list[runs.Loaded], motion.Windows]:
    """Runs, which hold the data of the first, and their test windows, which must be the same."""
    twice, count = Counter(map(str, paths)).most_common(1)[0]
    if count > 1:
        raise UsageError(f"a run is named twice: {twice}")
    first = runs.load(paths[0], data)
    windows, loaded = first.data.windows("test"), [first]
    for path in paths[1:]:
        other = runs.load(path, data)
        if other.data.windows("test").fingerprint != windows.fingerprint:
            raise ValueError(
                f"{other.path} has other test windows ({other.data.path}, {other.data.protocol.name}) than "
                f"{first.path} ({first.data.path}, {first.data.protocol.name}); give runs of the same data and protocol"
            )
        loaded.append(replace(other, data=first.data))
    return loaded, windows


def _rows(loaded: Sequence[runs.Loaded]) -> dict[str, list[runs.Loaded]]:
    """Runs by row: those that differ in the training seed only together, under the method and what tells rows apart."""
    rows: dict[str, list[runs.Loaded]] = {}
    seeds: dict[tuple[str, int], Path] = {}
    for run in loaded:
        key = json.dumps(_config_without_seed(run), sort_keys=True)
        seed = Run(run.path).config["training"]["seed"]
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
    return dict(_flat({"method": config["method"], "training": training}))


def _unfinished(loaded: Sequence[runs.Loaded]) -> list[str]:
    """A sentence on every run that has not ended."""
    sentences = []
    for run in loaded:
        state, steps = Run(run.path).state, Run(run.path).config["training"]["steps"]
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


def _flat(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every option of a nested configuration, named with dots."""
    for key, value in config.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _names(loaded: Sequence[runs.Loaded]) -> list[str]:
    """Names of methods, of run directories where methods repeat, and whole paths where these repeat too."""
    candidates = ([run.method.name for run in loaded], [run.path.name for run in loaded])
    paths = [str(run.path) for run in loaded]
    return next((names for names in candidates if len(set(names)) == len(names)), paths)


def _clip(clips: motion.MotionSet, name: str) -> motion.Clip:
    found = [clip for clip in clips if name in (clip.name, f"{clip.split}/{clip.name}")]
    if not found:
        raise ValueError(f"no clip {name!r} in {clips.name}; `dvae data info` tells what is there")
    if len(found) > 1:
        keys = " or ".join("/".join(clip.key) for clip in found)
        raise ValueError(f"{name!r} is the name of {len(found)} clips; say {keys}")
    return found[0]


def _save_figure(figure: Figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    ERROR.print(f"wrote {path}")


if __name__ == "__main__":
    sys.exit(main())
