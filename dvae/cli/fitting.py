"""Commands that fit: fit, resume, sweep. Their options are the fields of methods and of `Training`."""

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
from ..inference.training.processes import restartable
from ..inference.training.recipe import Trainable
from ..inference.training.schedules import Schedule
from ..inference.training.trackers import TensorBoard
from ..models import registry
from ..models.method import LatentMethod
from ..models.motion.trajectories import TrajectoryMethod
from ..models.registry import judges, methods
from ..motion.data.dataset import SIMULATED
from ..motion.data.protocols import Representation
from ..motion.segments.dataset import Segmentation
from ..options import Amount, Frames, Share
from ..runs import directory as runs
from ..runs.grid import Grid
from ..runs.kinds import DATA
from ..runs.sweep import sweep as sweep_methods
from ..tables.dataset import PanelData
from .console import ERROR, OUT, Missing, UsageError, arguments, at_least
from .help import EXPERT, Expert
from .tables import ColumnOptions, is_table


def options_of(name: str, kind: type[Any], *aside: str, common: Collection[str] | None = None) -> Any:
    """A dataclass of the options of another that can be written as words, but those that are left aside.

    Options are None where they are not given, and flags False.

    Args:
        name: of the class.
        kind: whose options.
        aside: names of options.
        common: names of the options that `--help` shows; all by default.
    """
    hints = get_type_hints(kind, include_extras=True)
    found, schedules = [], {*get_args(Schedule)}
    for option in fields(kind):
        hint = hints[option.name]
        if schedules & {*get_args(hint)}:
            hint = reduce(or_, [part for part in get_args(hint) if part not in schedules])
        given: Any = Annotated[bool, tyro.conf.FlagCreatePairsOff] if hint is bool else hint | None
        shown = given if common is None or option.name in common else Annotated[given, EXPERT]
        found.append((option.name, shown, False if hint is bool else None))
    kept = [option for option in found if option[0] not in aside]
    return make_dataclass(name, kept, frozen=True, namespace={"__doc__": kind.__doc__})


if TYPE_CHECKING:
    MethodChoice = Trainable
    ProtocolName = str
    SweptMethod = str
    MethodOptions = Any
    TrainingOptions = Any
    SweepOptions = Any
else:
    KNOWN = {**methods(), **judges()}
    MethodChoice = tyro.extras.subcommand_type_from_defaults(
        {name: kind() for name, kind in KNOWN.items()},
        descriptions={name: kind.source for name, kind in KNOWN.items()},
        prefix_names=False,
    )
    ProtocolName = tyro.extras.literal_type_from_choices(motion.PROTOCOLS)
    SweptMethod = tyro.extras.literal_type_from_choices([name for name in methods() if name != "equations"])
    MethodOptions = options_of("MethodOptions", LatentMethod, "latent")
    COMMON = ("steps", "batch_size", "learning_rate", "patience", "seed", "accelerator")
    TrainingOptions = options_of("TrainingOptions", Training, "self_feeding", "progress", common=COMMON)
    SweepOptions = options_of("SweepOptions", Training, "self_feeding", "progress", "seed", "devices", common=COMMON)


@dataclass(frozen=True)
class DataOptions(ColumnOptions):
    """Data to fit to: motion, or a table.

    Args:
        data: a motion file or a folder of them, or "simulated"; or a table: CSV, TSV, Parquet or npz; or an npy file or
            a folder of them, which may be larger than memory.
        skip_bad: leave out clips that cannot be used instead of refusing the file.
        protocol: how windows are cut, by default as suits the skeleton.
        representation: what the model sees: positions; or turns of joints in this form, and bones then keep their
            lengths.
        cut: of motion-latent: segments are gait cycles, or clips as they are, where they last 0.3 to 3 seconds.
        scaling: of motion-latent: of turns, less no turn, or less their mean and by their deviation.
        warped: of motion-latent: time goes along the most typical gait cycles, instead of evenly.
        bodies: of motion-latent: deviation of shapes of bodies that are drawn for training segments; 0 for their own.
        observed: of a table: steps that a forecast is given.
        horizon: of a table: steps to forecast.
        stride: of a table: steps from one test window to the next.
        split: of a table: what is divided into training, validation and test.
        validation: of a table: share by which weights are chosen.
        test: of a table: share to be judged on.
        season: of a table: its period in steps, which a reference repeats.
    """

    data: str = SIMULATED
    skip_bad: Expert[bool] = False
    protocol: ProtocolName | None = None
    representation: Expert[Representation] = "positions"
    missing: Missing = False
    cut: Expert[Segmentation] = "gait"
    scaling: Expert[Literal["identity", "deviation"]] = "identity"
    warped: Expert[bool] = False
    bodies: Expert[Amount] = 1.0
    observed: int | None = None
    horizon: int | None = None
    stride: Expert[int | None] = None
    split: Literal["sequence", "time", "group"] | None = None
    validation: Expert[Share | None] = None
    test: Expert[Share | None] = None
    season: Frames | None = None

    def open(self, *methods: Trainable) -> Any:
        """The data on which methods are fitted, of one kind.

        Raises:
            UsageError: they are of several, or an option is of another kind than that of the methods.
        """
        kinds = {method.fitted_on: method.name for method in methods}
        if len(kinds) > 1:
            said = " and ".join(f"{name} on {SAID.get(kind, kind)}" for kind, name in kinds.items())
            raise UsageError(f"methods are fitted on data of their kind, {said}; give those of one kind")
        ((kind, name),) = kinds.items()
        given = {option: value for option, value in vars(self).items() if value != getattr(DataOptions, option)}
        told = [option for option in OF_KINDS["panel"] if option in given]
        if kind == "windows":
            kind = "panel" if is_table(self.data) or told else "motion"
            if kind == "panel" and self.data == SIMULATED:
                raise UsageError(f"--{told[0]} is about tables; name one by --data")
        for other, options in OF_KINDS.items():
            if other != kind and (strange := (given.keys() & {*options}) - {*OF_KINDS[kind]}):
                raise UsageError(
                    f"--{min(strange).replace('_', '-')} is about {SAID[other]}, and {name} is fitted on {SAID[kind]}"
                )
        columns = {field.name for field in fields(ColumnOptions)}
        given = {name: value for name, value in given.items() if name not in columns} | self.given()
        with arguments() if kind == "panel" else nullcontext():  # of which columns are arguments
            opened = DATA[kind].open(given.pop("data", SIMULATED), **given)
        if isinstance(opened, PanelData | motion.MotionData):
            for said in opened.parts().values():
                ERROR.print(said, markup=False)
        if isinstance(opened, PanelData):
            warnings.filterwarnings("ignore", "training leaves out")  # which the lines above list
        return opened


OF_KINDS = {
    "motion": ("protocol", "representation", "missing", "skip_bad"),
    "segments": ("cut", "scaling", "warped", "bodies", "skip_bad"),
    "panel": (
        *(field.name for field in fields(ColumnOptions)),
        *("observed", "horizon", "stride", "split", "validation", "test", "season"),
    ),
}
"""Options by the kind of data that has them."""
SAID = {"windows": "windows", "motion": "motion", "segments": "segments of motion", "panel": "a table"}


def fit(
    method: MethodChoice,
    out: Path,
    training: TrainingOptions,
    source: DataOptions,
    tensorboard: bool = False,
) -> None:
    """Fit a method, or equations of your own, to motion or to a table.

    Args:
        method: what to fit.
        out: the run directory.
        training: options of the run; what is not given is the method's own, see `dvae show METHOD`.
        source: the motion data.
        tensorboard: write TensorBoard files to the run directory too.
    """
    if out.is_file():
        raise UsageError(f"--out {out} is a file; name a directory for the run")
    if Run(out).exists and restartable():
        ERROR.print(f"{out} holds a run, which goes on")
        return resume(out, tensorboard=tensorboard)
    if Run(out).exists:
        raise ValueError(f"{out} already holds a run; {runs.advice(out)}; or choose another directory")
    with arguments():
        method.check()  # wrong equations and options are found before the data are read
        how = given_options(training)
    opened = source.open(method)
    with _reported():
        _report(fit_method(method, opened, out=out, trackers=[TensorBoard(out)] if tensorboard else [], **how))


def resume(
    run: Annotated[Path, tyro.conf.Positional],
    data: str | None = None,
    steps: int | None = None,
    learning_rate: float | None = None,
    accelerator: Accelerator | None = None,
    tensorboard: bool = False,
) -> None:
    """Continue a run from its last checkpoint.

    The learning rate falls, and self-feeding rises, over the same shares of the run when it is made longer.

    Args:
        run: the run directory.
        data: where the data lie now, if the path in the run no longer leads there.
        steps: optimiser steps in all, to make the run longer.
        learning_rate: step size of the optimiser from here on.
        accelerator: where it goes on, such as on a processor after a GPU.
        tensorboard: write TensorBoard files to the run directory too.
    """
    given = {"steps": steps, "learning_rate": learning_rate, "accelerator": accelerator}
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    with arguments():
        Training(**options)
    with _reported():
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
    """Fit methods with several seeds and sizes, several runs at a time, each on one thread.

    The same command continues a sweep that was stopped: finished runs are left as they are.

    Args:
        method: names of methods; none where a grid says what to fit.
        out: directory of the run directories, such as srnn-seed0, or srnn-z8-seed0 where sizes differ.
        model: options of all methods, in place of their defaults.
        training: options of the runs; what is not given is each method's own, see `dvae show METHOD`.
        source: the data.
        grid: TOML file of named equations and methods, each with its options and their values; see docs/sweeps.md.
        seeds: of initial weights, batches and draws, a run for each; by default the grid's, or 0, 1 and 2.
        latent: sizes of z; a run for each.
        jobs: runs at a time.
        scheduler: address of a dask scheduler, such as tcp://host:8786, whose workers fit the runs in place of --jobs.
    """
    if bool(method) == bool(grid) or seeds == ():
        raise UsageError("give at least one method and one seed, or no method and --grid")
    if grid is not None and latent:
        raise UsageError("--latent is of methods that are named; in a grid write each.latent = [8, 16]")
    at_least(1, jobs=jobs)
    if out.is_file():
        raise UsageError(f"--out {out} is a file; name a directory for the runs")
    given = {name: value for name, value in vars(model).items() if value is not None}
    with arguments():
        how = given_options(training)
        chosen: Any
        if grid is None:
            sizes: list[dict[str, int]] = [{"latent": size} for size in latent] or [{}]
            chosen = fitted = [registry.method(name, **given, **size) for name in method for size in sizes]
            for each in fitted:
                each.check()
        else:
            told = Grid.read(grid, given)
            chosen, seeds, how = told.methods, seeds or told.seeds, {**told.training, **how}
            fitted = [*told.methods.values()]
            Training(**how)
    opened = source.open(*fitted)
    with nullcontext() if scheduler is None else _cluster(scheduler):
        results = sweep_methods(chosen, opened, out, seeds or (0, 1, 2), how, jobs)
    if failed := [result for result in results if result.status == "failed"]:
        raise RuntimeError(
            f"{len(failed)} of {len(results)} runs failed, the same command tries them again\n"
            + "\n".join(map(str, failed))
        )
    then = f"score them with: dvae evaluate {out}/*"
    if fitted[0].fitted_on == "windows":
        then += f", and bounds, where all have one: dvae compare {out}/*"
    OUT.print(f"all {len(results)} runs have ended; {then}", soft_wrap=True)


def given_options(training: Any) -> dict[str, Any]:
    """The options of training that are given, each of which may be."""
    given = {name: value for name, value in vars(training).items() if value is not None and value is not False}
    Training(**given)
    return given


@contextmanager
def _reported() -> Iterator[None]:
    """Within it, an interrupted fit says how the command line goes on."""
    try:
        yield
    except Interrupted as stop:
        stop.args = (f"interrupted after step {stop.fit.step}; resume with: dvae resume {stop.fit.run}",)
        raise


@contextmanager
def _cluster(scheduler: str) -> Iterator[None]:
    """Within it, joblib runs on the workers of a dask scheduler."""
    try:
        from distributed import Client
    except ImportError as error:
        raise UsageError("--scheduler needs dask: pip install 'pyro-dvae[dask]'") from error
    with Client(scheduler) as client, parallel_config(backend="dask", client=client):
        yield


def _report(result: Fit) -> None:
    took = f"{result.processor_seconds:.0f} s of processor time"
    found = ", ".join(filter(None, [f"{result.status} at step {result.step}", result.best, took]))
    OUT.print(found, highlight=False, soft_wrap=True)
    assert result.run is not None
    OUT.print(_use(Run(result.run).config["method"]["method"], result.run), highlight=False, soft_wrap=True)


def _use(name: str, run: Path) -> str:
    """What to do with a fitted run."""
    if name in judges():
        what = "the poses of forecasts" if name == "pose-prior" else "forecasts"
        option = "--pose-prior" if name == "pose-prior" else "--classifier"
        return f"score {what} with: dvae evaluate RUN {option} {run}"
    scored = f"score it with: dvae evaluate {run}"
    if Run(run).config["data"].get("kind") == "panel":
        return f"{scored}, forecast with: dvae forecast {run} --out FILE.csv --figure FILE.png"
    if methods()[name].fitted_on == "segments":
        return f"{scored}, recover a segment from a part of it with: dvae impute {run} --from CLIP --seen markers"
    if issubclass(methods()[name], TrajectoryMethod):
        return f"{scored} --joints JOINT …, move it with: dvae forecast {run} --joints JOINT … --out FILE.npz"
    return scored
