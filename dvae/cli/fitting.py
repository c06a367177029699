"""Commands that fit models: fit, resume and sweep. Their options are the fields of methods and of `Training`."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, fields, make_dataclass
from functools import reduce
from operator import or_
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_type_hints

import tyro
from joblib import parallel_config

from .. import motion
from ..inference.training.checkpoints import Run
from ..inference.training.fit import Fit, Interrupted
from ..inference.training.fit import fit as fit_method
from ..inference.training.options import Accelerator, Training
from ..inference.training.processes import is_restartable
from ..inference.training.recipe import Trainable
from ..inference.training.schedules import Schedule
from ..inference.training.trackers import TensorBoard
from ..models import registry
from ..models.method import LatentMethod
from ..models.motion.trajectories import TrajectoryMethod
from ..models.registry import methods, metric_models
from ..motion.data.dataset import SIMULATED
from ..motion.data.protocols import Representation, RootMotion
from ..motion.segments.dataset import Segmentation
from ..options import Amount, Frames, Share
from ..program.model import DynamicalVAE
from ..runs import directory as runs
from ..runs.grid import Grid
from ..runs.kinds import DATA
from ..runs.sweep import sweep as sweep_methods
from ..tables.dataset import PanelData
from .console import ERROR, OUT, Missing, UsageError, arguments, at_least
from .help import EXPERT, Expert
from .tables import ColumnOptions, is_table


def options_of(name: str, kind: type[Any], *aside: str, common: Collection[str] | None = None) -> Any:
    """Return a dataclass with the fields of another one that can be given on a command line.

    An option that is not given is None, or False for a flag.

    Args:
        name: name of the new class.
        kind: dataclass with the options.
        aside: names of fields of `kind` to omit.
        common: names of the options that `--help` shows; all by default.
    """
    hints = get_type_hints(kind)  # without ranges, which `kind` checks with a clearer error
    options, schedules = [], {*get_args(Schedule)}
    for option in fields(kind):
        hint = hints[option.name]
        if schedules & {*get_args(hint)}:
            hint = reduce(or_, [part for part in get_args(hint) if part not in schedules])
        mark = tyro.conf.FlagCreatePairsOff if hint is bool else tyro.conf.DisallowNone
        optional: Any = Annotated[bool if hint is bool else hint | None, mark]
        annotated = optional if common is None or option.name in common else Annotated[optional, EXPERT]
        options.append((option.name, annotated, False if hint is bool else None))
    kept = [option for option in options if option[0] not in aside]
    return make_dataclass(name, kept, frozen=True, namespace={"__doc__": kind.__doc__})


if TYPE_CHECKING:
    MethodChoice = Trainable
    ProtocolName = str
    SweptMethod = str
    MethodOptions = Any
    TrainingOptions = Any
    SweepOptions = Any
else:
    KNOWN = {**methods(), **metric_models()}
    MethodChoice = tyro.extras.subcommand_type_from_defaults(
        {name: kind() for name, kind in KNOWN.items()},
        descriptions={name: kind.source for name, kind in KNOWN.items()},
        prefix_names=False,
    )
    ProtocolName = tyro.extras.literal_type_from_choices(motion.PROTOCOLS)
    SweptMethod = tyro.extras.literal_type_from_choices([name for name in methods() if name != "equations"])
    MethodOptions = options_of("MethodOptions", LatentMethod, "latent")
    COMMON = ("steps", "batch_size", "learning_rate", "select", "patience", "seed", "accelerator")
    TrainingOptions = options_of("TrainingOptions", Training, "scheduled_sampling", "progress", common=COMMON)
    SweepOptions = options_of(
        "SweepOptions", Training, "scheduled_sampling", "progress", "seed", "devices", common=COMMON
    )


@dataclass(frozen=True)
class CutOptions(ColumnOptions):
    """How data are read and cut into windows.

    Args:
        skip_bad: leave out clips that cannot be used, instead of refusing the file.
        observed: for a table: number of observed steps before a forecast.
        horizon: for a table: number of steps to forecast.
        stride: for a table: steps from one test window to the next.
        split: for a table: divide sequences, time or groups into training, validation and test.
        validation: for a table: share of the data for validation, which selects the weights.
        test: for a table: share of the data for the test, or number of last steps of a split by time.
        season: for a table: period in steps, which the seasonal reference forecast repeats.
    """

    skip_bad: Expert[bool] = False
    observed: int | None = None
    horizon: int | None = None
    stride: Expert[int | None] = None
    split: Literal["sequence", "time", "group"] | None = None
    validation: Expert[Share | None] = None
    test: Expert[Frames | Share | None] = None
    season: Frames | None = None

    def open_at(self, path: str, kind: str = "windows", user: str = "the data are", **further: Any) -> Any:
        """Open data.

        Args:
            path: path of the data.
            kind: kind of the data; "windows" for motion or a table.
            user: subject of errors, such as "srnn is fitted on".
            further: further options of motion, which are None or False if not given.

        Raises:
            UsageError: an option is for another kind of data.
        """
        given = {option: value for option, value in vars(self).items() if value != getattr(type(self), option)}
        given = {name: value for name, value in given.items() if name != "data"}
        given |= {name: value for name, value in further.items() if value}
        table_options = [option for option in OF_KINDS["panel"] if option in given]
        if kind == "windows":
            kind = "panel" if is_table(path) or table_options else "motion"
            if kind == "panel" and path == SIMULATED:
                raise UsageError(f"--{table_options[0]} is for tables; give the path of a table with --data")
        for other, options in OF_KINDS.items():
            if other != kind and (inapplicable := (given.keys() & {*options}) - {*OF_KINDS[kind]}):
                raise UsageError(
                    f"--{min(inapplicable).replace('_', '-')} is for {DATA_NAMES[other]}, and {user} {DATA_NAMES[kind]}"
                )
        columns = {field.name for field in fields(ColumnOptions)}
        given = {name: value for name, value in given.items() if name not in columns} | self.given()
        with arguments() if kind == "panel" else nullcontext():  # the columns of a table are arguments
            data_set = DATA[kind].open(path, **given)
        if isinstance(data_set, PanelData | motion.MotionData | motion.SegmentData):
            for description in data_set.parts().values():
                ERROR.print(description, markup=False)
        if isinstance(data_set, PanelData):
            warnings.filterwarnings("ignore", "training leaves out")  # the lines above list the omitted parts
        return data_set


@dataclass(frozen=True)
class DataOptions(CutOptions):
    """Data to fit to: motion, or a table.

    Args:
        data: motion file or folder of motion files, or "simulated"; or a table: CSV, TSV, Parquet or npz; or an npy
            file or folder of npy files, which may be larger than memory.
        protocol: protocol that cuts windows; by default the protocol of the skeleton.
        representation: input of the model: positions of joints, or rotations of joints in this form, which keep the
            lengths of bones.
        root: drop the root of every frame, keep it relative to the first frame, or model its travel: velocities and
            poses relative to its heading, which forecasts add up.
        cut: for motion-latent: use gait cycles as segments, or whole clips of 0.3 to 3 seconds.
        scaling: for motion-latent: encode rotations relative to the identity, or relative to their mean in units of
            their standard deviation.
        warped: for motion-latent: align segments in time with the most typical gait cycles.
        bodies: for motion-latent: standard deviation of the body shapes drawn for training segments; 0 keeps the
            recorded bodies.
        body: for motion-latent: model file of SMPL, SMPL-H or SMPL-X, npz; by default the bundled person. Files of
            AMASS keep their rotations and betas on it.
        betas: for motion-latent: number of shape parameters of the body in a file.
        hold_out: for motion-latent: folders of the data that are the test data, such as SFU TotalCapture.
    """

    data: str = SIMULATED
    protocol: ProtocolName | None = None
    representation: Expert[Representation] = "positions"
    root: RootMotion | None = None
    missing: Missing = False
    cut: Expert[Segmentation] = "gait"
    scaling: Expert[Literal["identity", "deviation"]] = "identity"
    warped: Expert[bool] = False
    bodies: Expert[Amount] = 1.0
    body: Path | None = None
    betas: Expert[int] = 8
    hold_out: tuple[str, ...] = ()

    def open(self, *methods: Trainable) -> Any:
        """Open the data on which methods are fitted.

        Raises:
            UsageError: the methods are fitted on different kinds of data, or an option is for another kind of data.
        """
        kinds = {method.fitted_on: method.name for method in methods}
        if len(kinds) > 1:
            descriptions = " and ".join(f"{name} on {DATA_NAMES.get(kind, kind)}" for kind, name in kinds.items())
            raise UsageError(
                f"these methods are fitted on different kinds of data, {descriptions}; give methods of one kind"
            )
        ((kind, name),) = kinds.items()
        return self.open_at(self.data, kind, f"{name} is fitted on")


OF_KINDS = {
    "motion": ("protocol", "representation", "root", "missing", "skip_bad"),
    "segments": ("cut", "scaling", "warped", "bodies", "body", "betas", "hold_out", "skip_bad"),
    "panel": (
        *(field.name for field in fields(ColumnOptions)),
        *("observed", "horizon", "stride", "split", "validation", "test", "season"),
    ),
}
"""Options by kind of data."""
DATA_NAMES = {"windows": "windows", "motion": "motion", "segments": "segments of motion", "panel": "a table"}


def fit(
    method: MethodChoice,
    out: Path,
    training: TrainingOptions,
    source: DataOptions,
    tensorboard: bool = False,
) -> None:
    """Fit a method, or your own equations, to motion or to a table.

    Args:
        method: method to fit.
        out: run directory.
        training: options of the run; `dvae show METHOD` prints the defaults of a method.
        source: data to fit to.
        tensorboard: also write TensorBoard files to the run directory.
    """
    if out.is_file():
        raise UsageError(f"--out {out} is a file; name a directory for the run")
    if Run(out).exists and is_restartable():
        ERROR.print(f"{out} contains a run; continuing it")
        return resume(out, tensorboard=tensorboard)
    if Run(out).exists:
        raise ValueError(f"{out} already contains a run; {runs.advice(out)}; or choose another directory")
    with arguments():
        method.check()  # before reading the data, so wrong equations and options fail early
        options = given_options(training)
    data_set = source.open(method)
    with _resume_hint():
        _report(fit_method(method, data_set, out=out, trackers=[TensorBoard(out)] if tensorboard else [], **options))


def resume(
    run: Annotated[Path, tyro.conf.Positional],
    data: str | None = None,
    steps: int | None = None,
    learning_rate: float | None = None,
    accelerator: Accelerator | None = None,
    tensorboard: bool = False,
) -> None:
    """Continue a run from its last checkpoint.

    If `steps` extends the run, the schedules of learning rate and scheduled sampling stretch to the new length.

    Args:
        run: run directory.
        data: where the data are now, if the path in the run is no longer valid.
        steps: total number of optimiser steps, to extend the run.
        learning_rate: step size of the optimiser from this checkpoint on.
        accelerator: device to continue on, such as a CPU after a GPU.
        tensorboard: also write TensorBoard files to the run directory.
    """
    values = {"steps": steps, "learning_rate": learning_rate, "accelerator": accelerator}
    options: dict[str, Any] = {name: value for name, value in values.items() if value is not None}
    with arguments():
        Training(**options)
    with _resume_hint():
        _report(runs.resume(run, data, [TensorBoard(run)] if tensorboard else [], progress=True, **options))


def sweep(
    method: Annotated[tuple[SweptMethod, ...], tyro.conf.Positional],
    out: Path,
    model: MethodOptions,
    training: SweepOptions,
    source: DataOptions,
    grid: Path | None = None,
    seeds: tuple[int, ...] | None = None,
    latent: tuple[int, ...] = (),
    jobs: int = 2,
    scheduler: str | None = None,
) -> None:
    """Fit methods with several seeds and sizes, several runs in parallel, each on one thread.

    The same command continues an interrupted sweep and keeps finished runs.

    Args:
        method: names of methods, unless --grid is given.
        out: directory for the run directories, such as srnn-seed0, or srnn-z8-seed0 if sizes differ.
        model: options of all methods, in place of their defaults.
        training: options of the runs; `dvae show METHOD` prints the defaults of each method.
        source: data to fit to.
        grid: TOML file of named equations and methods, each with its options and their values; see
            docs/how-to/sweeps_and_studies.md.
        seeds: seeds of initial weights, batches and draws, one run for each; by default the seeds of the grid, or 0, 1
            and 2.
        latent: sizes of z, one run for each.
        jobs: number of runs in parallel.
        scheduler: address of a dask scheduler, such as tcp://host:8786, whose workers replace --jobs.
    """
    if bool(method) == bool(grid) or seeds == ():
        raise UsageError("give either methods or --grid, and at least one seed")
    if grid is not None and latent:
        raise UsageError("--latent is for methods given by name; in a grid, write each.latent = [8, 16]")
    at_least(1, jobs=jobs)
    if out.is_file():
        raise UsageError(f"--out {out} is a file; name a directory for the runs")
    given = {name: value for name, value in vars(model).items() if value is not None}
    with arguments():
        options = given_options(training)
        models: Any
        if grid is None:
            sizes: list[dict[str, int]] = [{"latent": size} for size in latent] or [{}]
            models = fitted = [registry.method(name, **given, **size) for name in method for size in sizes]
            for instance in fitted:
                instance.check()
        else:
            parsed_grid = Grid.read(grid, given)
            models, seeds, options = (
                parsed_grid.methods,
                seeds or parsed_grid.seeds,
                {**parsed_grid.training, **options},
            )
            fitted = [*parsed_grid.methods.values()]
            Training(**options)
    data_set = source.open(*fitted)
    with nullcontext() if scheduler is None else _cluster(scheduler):
        results = sweep_methods(models, data_set, out, seeds or (0, 1, 2), options, jobs)
    if failed := [result for result in results if result.status == "failed"]:
        raise RuntimeError(
            f"{len(failed)} of {len(results)} runs failed; the same command retries them\n"
            + "\n".join(map(str, failed))
        )
    then = f"score them with: dvae evaluate {runs.in_command(out)}/*"
    if fitted[0].fitted_on == "windows":
        then += f"; if all have a bound, compare them with: dvae compare {runs.in_command(out)}/*"
    OUT.print(f"all {len(results)} runs have ended; {then}", soft_wrap=True)


def given_options(training: Any) -> dict[str, Any]:
    """Return the training options that are given, after checking each."""
    given = {name: value for name, value in vars(training).items() if value is not None and value is not False}
    Training(**given)
    return given


@contextmanager
def _resume_hint() -> Iterator[None]:
    """Add the command that resumes the run to the message of an interrupted fit."""
    try:
        yield
    except Interrupted as stop:
        if stop.fit.run is None:  # a fit of a part, such as a pose prior, stores no run
            raise
        command = f"dvae resume {runs.in_command(stop.fit.run)}"
        stop.args = (f"interrupted after step {stop.fit.step}; resume with: {command}",)
        raise


@contextmanager
def _cluster(scheduler: str) -> Iterator[None]:
    """Run joblib on the workers of a dask scheduler within the block."""
    try:
        from distributed import Client
    except ImportError as error:
        raise UsageError("--scheduler needs dask: pip install 'pyro-dvae[dask]'") from error
    with Client(scheduler) as client, parallel_config(backend="dask", client=client):
        yield


def _report(result: Fit) -> None:
    duration = f"{result.processor_seconds:.0f} s of processor time"
    summary = ", ".join(filter(None, [f"{result.status} at step {result.step}", duration, result.best]))
    OUT.print(summary, highlight=False, soft_wrap=True)
    assert result.run is not None
    method = Run(result.run).config["method"]
    if method.get("units") not in (None, "columns"):
        OUT.print(f"targets are in the units {method['units']!r} (--units)", highlight=False)
    can_forecast = not isinstance(result.model, DynamicalVAE) or result.model.can_forecast
    use = _use(method["method"], result.run) if can_forecast else _compare(result.run)
    OUT.print(use, highlight=False, soft_wrap=True)


def _compare(run: Path) -> str:
    return f"the model has no forecasts; compare its bound with: dvae compare {runs.in_command(run)} --no-forecasts"


def _use(name: str, path: Path) -> str:
    """Return the commands to use next with a fitted run."""
    run = runs.in_command(path)
    if name in metric_models():
        target = "the poses of forecasts" if name == "pose-prior" else "forecasts"
        option = "--pose-prior" if name == "pose-prior" else "--classifier"
        return f"score {target} with: dvae evaluate RUN {option} {run}"
    advice = f"score it with: dvae evaluate {run}"
    if Run(path).config["data"].get("kind") == "panel":
        command = f"dvae forecast {run} --out FILE.csv --figure FILE.png"
        return f"{advice}\nforecast its test windows with: {command}\nand the future with: {command} --beyond"
    if methods()[name].fitted_on == "segments":
        return f"{advice}\nrecover a segment from a part of it with: dvae impute {run} --from CLIP --seen surfaces"
    if issubclass(methods()[name], TrajectoryMethod):
        return f"{advice} --joints JOINT …\nmove it with: dvae forecast {run} --joints JOINT … --out FILE.npz"
    return advice
