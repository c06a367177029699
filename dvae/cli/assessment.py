"""Commands that score runs: evaluate and compare."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro

from .. import files, motion
from ..inference.evaluation.compare import compare as compare_models
from ..inference.evaluation.ensemble import Ensemble
from ..inference.evaluation.evaluate import evaluate as evaluate_models
from ..inference.evaluation.external import ForecastSamples, read_samples, windows_to_forecast
from ..inference.evaluation.scores import Scores
from ..inference.training.checkpoints import CheckpointError, Run
from ..locking import seeded
from ..models.motion.codes import code_scores
from ..models.motion.trajectories import TrajectoryModel
from ..motion.data.protocols import RootMotion
from ..motion.geometry.euler import euler_errors
from ..motion.metric_models.pose_prior import PosePriorModel
from ..motion.metric_models.quality import RealOrGenerated, quality
from ..motion.scoring.by_action import action_windows, errors_by_action
from ..motion.scoring.published import Paper, Root, Unit
from ..runs import directory as runs
from . import loading
from .console import ERROR, OUT, Missing, UsageError, arguments, at_least, check_files, note, save_figure
from .fitting import CutOptions, DataOptions, ProtocolName
from .futures import joint_names
from .help import Expert
from .loading import ON_CPU, Device, Use

MOST_REMEMBERED = 2**32
"""Maximum size in bytes of the training windows that references load; memory-mapped data may be larger."""
AS_STORED = CutOptions()
"""No options: data are read and cut as in the runs."""
OBSERVATIONS = 50
"""Number of observations for the diversity of codes, as in the paper of Mix-and-Match."""


@dataclass(frozen=True)
class Control:
    """Paths given to methods that take trajectories (trajevae, cvae-rnn, moglow-paths, motion-infilling).

    Args:
        joints: joints whose paths are given to the runs.
        exchange: start each window with the pose of another window, whose given joints are at most this many metres
            away (0.01 in the paper).
        temperature: scale factor of the latents; 0 for the motion at the mean of the prior.
    """

    joints: tuple[str, ...] | None = None
    exchange: float | None = None
    temperature: float | None = None

    def windows(self, windows: motion.Windows, loaded_runs: Sequence[runs.Loaded]) -> Any:
        """Return the windows with the given paths and exchanged poses.

        Raises:
            UsageError: a run is of another method.
        """
        if self == Control():
            return windows
        for run in loaded_runs:
            if not isinstance(run.model, TrajectoryModel):
                raise UsageError(
                    f"--joints, --exchange and --temperature are for methods that take trajectories; {run.path} is a "
                    f"run of {run.method.name}"
                )
        conditioned = windows.given(joint_names(self.joints or ()))
        return conditioned if self.exchange is None else motion.ExchangedWindows(conditioned, self.exchange)

    def __str__(self) -> str:
        parts = ["", *joint_names(self.joints or ())]
        parts += [] if self.exchange is None else [f"exchanged-{self.exchange:g}"]
        return "-".join(parts if self.temperature is None else [*parts, f"temperature-{self.temperature:g}"])


@dataclass(frozen=True)
class Angles:
    """Options of --measure angles.

    Args:
        inverse: estimate rotations from positions, for runs that predict positions.
        actions: score the eight windows of each action of Human3.6M's benchmark, and print errors by action.
    """

    inverse: Expert[bool] = False
    actions: bool = False


@dataclass(frozen=True)
class Quality:
    """Options of --measure quality; the defaults are the paper's (Mix-and-Match).

    Args:
        quality_width: units of the classifier that distinguishes real from generated motion.
        quality_examples: number of training windows of each kind.
        quality_steps: number of training steps.
        quality_seeds: number of classifiers of each run.
    """

    quality_width: Expert[int] = 1024
    quality_examples: Expert[int] = 25_000
    quality_steps: Expert[int] = 5000
    quality_seeds: Expert[int] = 3


@dataclass(frozen=True)
class External:
    """Forecasts of other software.

    Args:
        forecasts: files of samples (npz, npy or CSV), each a row named after its file; `dvae data windows` writes the
            windows to forecast. Without runs, --data and the options of `dvae fit` for it define the windows.
        protocol: without runs: protocol that cuts windows of motion; by default the protocol of the skeleton.
        axes: a letter for each axis of the samples in npz and npy files: k samples, n windows, t steps, d columns, or j
            joints and c coordinates; 1 for an axis of size 1. By default kntd or kntjc.
        unit: for motion: unit of the forecasts.
        root: without runs: the treatment of the root in the windows, as in `dvae fit`.
        given_root: for forecasts with a moving root, under a protocol that removes it: subtract it from the other
            joints, or ignore it if they are already relative to it.
    """

    forecasts: tuple[Path, ...] = ()
    protocol: ProtocolName | None = None
    axes: Expert[str] = ""
    unit: Expert[Unit] = "m"
    root: Expert[RootMotion | None] = None
    given_root: Expert[Root | None] = None

    def check(self) -> None:
        """Raise a `UsageError` if two files have the same name, one is absent, or options for files have no file."""
        if len({path.stem for path in self.forecasts}) < len(self.forecasts):
            raise UsageError(f"--forecasts {' '.join(map(str, self.forecasts))}: give files with different names")
        if absent := [str(path) for path in self.forecasts if not path.is_file()]:
            raise UsageError(f"--forecasts {' '.join(absent)}: no such file")
        if not self.forecasts and self != External():
            raise UsageError("--protocol, --root, --axes, --unit and --given-root need --forecasts; leave them out")

    def read(self, windows: Any, every: Any) -> dict[str, ForecastSamples]:
        """Return the forecasts by name; windows that are in `every` only are left out."""
        read = {path.stem: read_samples(path, windows.protocol.observed, self.axes) for path in self.forecasts}
        read = {name: each.within(every.keys, windows.keys) for name, each in read.items()}
        if isinstance(windows, motion.Windows):
            return {
                name: motion.frames_of(each, windows, unit=self.unit, root=self.given_root)
                for name, each in read.items()
            }
        if self.unit != "m" or self.given_root:
            raise UsageError("--unit and --given-root are for motion; leave them out")
        return read


def evaluate(
    run: Annotated[tuple[Path, ...], tyro.conf.Positional],
    control: Control,
    external: External = External(),
    source: Expert[CutOptions] = AS_STORED,
    angles: Angles = Angles(),
    realism: Quality = Quality(),
    data: str | None = None,
    measure: Literal["forecasts", "quality", "angles", "codes"] = "forecasts",
    missing: Expert[Missing] = False,
    use: Use = ON_CPU,
    samples: int = 50,
    bound_particles: int = 0,
    log_score_particles: Expert[int] = 0,
    pose_prior: Path | None = None,
    classifier: tuple[Path, ...] = (),
    several_futures: bool = False,
    windows_of: Expert[Paper | None] = None,
    ensembles: bool = False,
    seed: int = 0,
    batch_size: Expert[int] = 32,
    cuda_graph: Expert[bool] = False,
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Score runs, or forecasts of other software, on test windows, next to references such as the last value.

    For runs of motion-latent, scores the reconstruction of test segments, next to principal components of equal
    dimension. Options for forecasts do not apply to them.

    Prints the table, and writes it with all settings to evaluation.json in each run, or to --out. With given joints or
    forecasts, chosen windows, other data or another measure, the file name says so. Nearest neighbours require the
    training data of the runs.

    Args:
        run: run directories, fitted on the same data under the same protocol.
        external: forecasts of other software.
        control: joints whose true paths are given to methods that take trajectories.
        angles: options of --measure angles.
        realism: options of --measure quality, whose defaults take hours on a CPU.
        source: without runs: how the data are read and cut, as in `dvae fit`.
        data: where the data are now, if the path in the runs is no longer valid; or other data with the same variables;
            or, without runs, the data.
        measure: scores of forecasts; or, for motion, their quality (how hard they are to distinguish from real motion),
            errors of their Euler angles (best of 1 and of K), or the diversity of the codes of mix-and-match.
        samples: number K of forecasts of each window.
        bound_particles: number of particles of the IWAE bound; 0 omits it.
        log_score_particles: number of particles of the log density of the future under the forecasts; 0 omits it.
        pose_prior: run of the method pose-prior, which scores the poses of the forecasts.
        classifier: runs of action-classifiers with different labels, which score the actions in the forecasts.
        several_futures: score only windows whose last observed pose is shared by another window, as GSPS's tables do.
            Without it, all windows are scored, as in DLow's.
        windows_of: score the windows of Human3.6M that the public code of a paper scores.
        ensembles: add a row for the equal-weight mixture of runs that differ only in their seed.
        seed: seed of the draws.
        batch_size: number of windows forecast at once.
        cuda_graph: with --accelerator cuda, replay forecasts and bounds as CUDA graphs.
        out: file to write instead of evaluation.json in each run.
        figure: save the scores as dots with error bars, or as box plots for segments.
    """
    at_least(1, samples=samples, batch_size=batch_size)
    at_least(0, bound_particles=bound_particles, log_score_particles=log_score_particles)
    check_files(out, figure, ".json")
    if several_futures and control.exchange is not None:
        raise UsageError("--several-futures needs multimodal futures, which exchanged poses do not have; leave one out")
    external.check()
    if not run and (cuda_graph or (use != ON_CPU and pose_prior is None)):
        raise UsageError("--failed, --accelerator and --cuda-graph are for runs; leave them out")
    is_of_segments = bool(run) and loading.kind_of(run, data) == "segments"
    if external.forecasts and (measure != "forecasts" or is_of_segments):
        raise UsageError("--forecasts is for scores of forecasts, not for another --measure or for segments")
    if run and (external.protocol or external.root or source != AS_STORED):
        raise UsageError("the runs define the windows; leave --protocol, --root and options for reading the data out")
    options = samples, log_score_particles, pose_prior, classifier, control, missing, use
    scoring = ForecastScoring(*options, several_futures, windows_of, ensembles, cuda_graph)
    chosen = [name for name, options in (("angles", angles), ("quality", realism)) if options != type(options)()]
    if wrong := next((name for name in chosen if name != measure), None):
        raise UsageError(f"options of --measure {wrong} do not apply to --measure {measure}; leave them out")
    if measure != "forecasts":
        if bound_particles or scoring != replace(ForecastScoring(samples), missing=missing, use=use):
            raise UsageError(
                f"--bound-particles, --log-score-particles, --pose-prior, --classifier, --joints, --exchange, "
                f"--temperature, --several-futures and --cuda-graph do not apply to --measure {measure}; leave them out"
            )
        if measure == "quality" and samples != ForecastScoring.samples:
            raise UsageError("--samples does not apply to --measure quality, which draws one future; leave it out")
        if figure is not None and measure != "angles":
            raise UsageError(f"--measure {measure} has no figure; leave --figure out")
        _measure(measure, run, data, scoring, angles, realism, out, figure, seed=seed, batch_size=batch_size)
        return
    score: Any = _segments if is_of_segments else partial(_forecasts, external=external, source=source)
    result, record = score(run, data, scoring, bound_particles=bound_particles, seed=seed, batch_size=batch_size)
    save_and_print(result, [each / f"{record}.json" for each in run] if out is None else [out], figure)


def windows(
    source: DataOptions, out: Path, part: Literal["train", "validation", "test", "train+validation"] = "test"
) -> None:
    """Write the windows that `dvae evaluate --forecasts` scores, so that other software can forecast them.

    The npz contains `observed` (windows, steps, columns), NaN where missing; the keys `split`, `sequence` and `start`
    of the windows, which a file of forecasts contains too; `horizon`, the number of steps to forecast; and the names of
    the `columns`. Training and validation windows also have their `future`.

    Args:
        source: data, and how they are cut.
        out: npz file to write.
        part: part of the data.
    """
    check_files(out, None, ".npz")
    arrays = windows_to_forecast(source.open_at(source.data).windows(part), whole=part != "test")
    with files.atomic_write(out) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    count, observed, size = arrays["observed"].shape
    ERROR.print(
        f"wrote {out}: {count} windows of {observed} observed steps of {size} columns; forecast {arrays['horizon']}"
    )


OF_MOTION = ("pose_prior", "classifier", "control", "missing", "several_futures", "windows_of")
"""Options of `evaluate` for motion only."""


@dataclass(frozen=True)
class ForecastScoring:
    """Options of `evaluate` for forecasts only."""

    samples: int = 50
    log_score_particles: int = 0
    pose_prior: Path | None = None
    classifier: tuple[Path, ...] = ()
    control: Control = Control()
    missing: bool = False
    use: Use = ON_CPU
    several_futures: bool = False
    windows_of: Paper | None = None
    ensembles: bool = False
    cuda_graph: bool = False


def _forecasts(
    paths: Sequence[Path],
    data: str | None,
    scoring: ForecastScoring,
    external: External,
    source: CutOptions,
    **settings: Any,
) -> tuple[Any, str]:
    """Score forecasts of test windows; return the scores and the name of their file."""
    loaded: list[runs.Loaded] = []
    if paths or not external.forecasts:
        loaded = loading.with_equal_windows(paths, data, use=scoring.use)
        data_set = loading.data_of(data, *loaded, missing=scoring.missing)
        windows = loading.windows_to_test(loaded[0], data_set, whole_sequences=False)
    elif data is None or scoring.classifier:
        raise UsageError("--forecasts needs --data, or runs; and --classifier needs runs")
    else:
        data_set = source.open_at(data, protocol=external.protocol, root=external.root, missing=scoring.missing)
        windows = data_set.windows("test")
    every = windows
    if data_set.kind == "motion":
        windows = motion.published_windows(windows, scoring.windows_of) if scoring.windows_of else windows
        windows = motion.several_futures(windows) if scoring.several_futures else windows
    with arguments():
        given = external.read(windows, every)
    temperature = scoring.control.temperature
    scores: Scores = loading.SCORES[data_set.kind]
    if data_set.kind == "motion":
        classifiers = _classifiers(scoring, data, loaded[0]) if loaded else {}
        scores = partial(
            motion.scores, pose_prior=_pose_prior(scoring, data, windows.skeleton), classifiers=classifiers
        )
        windows = scoring.control.windows(windows, loaded)
    elif inapplicable := [name for name in OF_MOTION if getattr(scoring, name) != getattr(ForecastScoring, name)]:
        raise UsageError(
            f"--{inapplicable[0].replace('_', '-')} is for motion, and {data_set.path} is a table; leave it out"
        )
    models = {name: run.model for name, run in zip(loading.names(loaded), loaded, strict=True)}
    models |= _mixtures(loaded) if scoring.ensembles else {}
    if clash := models.keys() & given.keys():
        raise UsageError(f"a run and a file of forecasts are both named {min(clash)}; rename the file")
    is_known = not loaded or loading.is_training_data(loaded[0], data_set)
    result = evaluate_models(
        {**given, **models},
        windows,
        scores=scores,
        samples=scoring.samples,
        log_score_particles=scoring.log_score_particles,
        cuda_graph=scoring.cuda_graph,
        training_windows=_reference_windows(data_set) if is_known else None,
        configs={name: Run(run.path).config for name, run in zip(loading.names(loaded), loaded, strict=True)},
        options={} if temperature is None else {"temperature": temperature},
        **settings,
    )
    record = loading.record("evaluation", loaded[0], data_set) if loaded else "evaluation"
    subset = f"-{scoring.windows_of}" * bool(scoring.windows_of) + "-several-futures" * scoring.several_futures
    return result, f"{record}{scoring.control}{subset}{''.join(f'-with-{name}' for name in given)}"


def _mixtures(loaded: Sequence[runs.Loaded]) -> dict[str, Ensemble]:
    """Return the mixtures of runs that differ only in their seed, by the name of their row.

    Raises:
        UsageError: no run differs from another one only in its seed.
    """
    several = {name: [each.model for each in row] for name, row in loading.rows(loaded).items() if len(row) > 1}
    if not several:
        raise UsageError("--ensembles needs runs that differ only in their seed; each row has one seed")
    return {f"{name}, mixture of {len(row)} seeds": Ensemble(row) for name, row in several.items()}


def _measure(
    measure: str,
    paths: Sequence[Path],
    data: str | None,
    scoring: ForecastScoring,
    angles: Angles,
    realism: Quality,
    out: Path | None,
    figure: Path | None,
    seed: int,
    batch_size: int,
) -> None:
    """Measure the quality, the Euler angles or the codes of runs on motion; print and write the result."""
    if (kind := loading.kind_of(paths, data)) != "motion":
        raise UsageError(f"--measure {measure} is for forecasts of motion, and {paths[0]} was fitted on {kind}")
    loaded = loading.with_equal_windows(paths, data, ("motion",), scoring.use)
    data_set = loading.data_of(data, *loaded, missing=scoring.missing)
    models = {name: run.model for name, run in zip(loading.names(loaded), loaded, strict=True)}
    windows: Any = loading.windows_to_test(loaded[0], data_set, whole_sequences=False)
    result: Any
    tables: list[Any] = []
    if measure == "quality":
        if not loading.is_training_data(loaded[0], data_set):
            raise UsageError(
                "--measure quality needs the training windows of the runs; leave out --data with other data"
            )
        at_least(1, **vars(realism))
        result = quality(
            models,
            data_set.windows("train"),
            windows,
            method=RealOrGenerated(realism.quality_width),
            examples=realism.quality_examples,
            steps=realism.quality_steps,
            seeds=range(realism.quality_seeds),
            seed=seed,
        )
    elif measure == "angles":
        windows = action_windows(windows) if angles.actions else windows
        counts = sorted({1, scoring.samples})
        result = euler_errors(models, windows, counts=counts, inverse=angles.inverse, seed=seed, batch_size=batch_size)
        if angles.actions:
            tables = [
                errors_by_action(result, windows, name, count)
                for name, row in result.rows.items()
                for count in (counts if row.samples > 1 else [1])
            ]
    else:
        rows = torch.linspace(0, len(windows) - 1, min(OBSERVATIONS, len(windows))).long()
        untrained = {}
        for name, run in zip(models, loaded, strict=True):
            with seeded(run.config.training.seed):
                untrained[name] = run.method.build(run.schema).to(loading.device_of(scoring.use))
        past = windows.all().past(windows.protocol.observed).rows(rows)
        result = code_scores(models, past, scoring.samples, seed, untrained)
    record = f"{loading.record(measure, loaded[0], data_set)}{'-by-action' * angles.actions}.json"
    save_and_print(result, [path / record for path in paths] if out is None else [out], figure)
    for table in tables:
        OUT.print(table)


def _reference_windows(data_set: Any) -> Any:
    """Return training windows for the references that use them; None if they exceed `MOST_REMEMBERED`."""
    windows = data_set.windows("train+validation")
    size = 4 * len(windows) * windows.length * windows.schema.sizes["x"]
    if size <= MOST_REMEMBERED:
        return windows
    if hasattr(windows, "subset"):
        chosen = range(0, len(windows), -(-size // MOST_REMEMBERED))
        note(f"references use {len(chosen):,} of {len(windows):,} training windows, evenly spaced")
        return windows.subset(chosen)
    note(
        f"omitted references that use training windows: {len(windows):,} windows would take {size / 2**30:.1f} GB; in "
        "Python, pass fewer to dvae.evaluate as training_windows"
    )
    return None


def _segments(paths: Sequence[Path], data: str | None, scoring: ForecastScoring, **settings: Any) -> tuple[Any, str]:
    """Score the reconstruction of test segments; return the scores and the name of their file."""
    if inapplicable := [
        name for name, value in vars(scoring).items() if name != "use" and value != getattr(ForecastScoring, name)
    ]:
        option = inapplicable[0]
        options = "--joints, --exchange and --temperature are" if option == "control" else f"--{option} is"
        raise UsageError(
            f"{options.replace('_', '-')} for forecasts, but {paths[0]} generates whole segments; leave them out"
        )
    loaded = loading.with_equal_windows(paths, data, ("segments",), scoring.use)
    data_set = loading.data_of(data, *loaded)
    by_name = dict(zip(loading.names(loaded), loaded, strict=True))
    try:
        own_data = data_set if loading.is_training_data(loaded[0], data_set) else replace(loaded[0], where=None).data
        training = own_data.windows("train")
    except CheckpointError as error:
        note(f"omitted principal components, which need the training segments: {error}")
        training = None
    result = motion.reconstruct_segments(
        {name: run.model for name, run in by_name.items()},
        data_set.windows("test"),
        training,
        configs={name: Run(run.path).config for name, run in by_name.items()},
        **settings,
    )
    return result, loading.record("evaluation", loaded[0], data_set)


def save_and_print(result: Any, paths: Sequence[Path], figure: Path | None) -> None:
    """Write a result to files, and only then print it, because the output may be closed or full."""
    for path in paths:
        result.save(path)
        ERROR.print(f"wrote {path}")
    if figure is not None:
        save_figure(result.plot(), figure)
        if "PIT" in {name for row in getattr(result, "rows", {}).values() for name in getattr(row, "histograms", {})}:
            save_figure(result.plot_calibration(), figure.with_stem(f"{figure.stem}-calibration"))
    OUT.print(result.table())


def compare(
    run: Annotated[tuple[Path, ...], tyro.conf.Positional],
    data: str | None = None,
    missing: Expert[Missing] = False,
    particles: int = 100,
    estimates: Expert[int] = 1,
    filter_particles: Expert[int] = 0,
    leave_future_out: tuple[int, int] | None = None,
    ensembles: bool = False,
    contrasts: Expert[int] = 128,
    samples: int = 50,
    forecasts: bool = True,
    draw_emission: Expert[bool | None] = None,
    stride: Expert[int | None] = None,
    seed: int = 0,
    batch_size: Expert[int] = 32,
    accelerator: Expert[Device] = "cpu",
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Compare runs on the test windows of their protocol.

    Runs that differ only in the seed share one row of the table. All runs must have finished. For whole sequences of a
    table, only bounds are compared.

    Args:
        run: run directories, fitted on the same data under the same protocol.
        data: where the data are now, if the path in the runs is no longer valid; or other data with the same variables.
        particles: number K of particles of the IWAE bound.
        estimates: number of independent estimates of the IWAE bound; `to_arviz` of the result needs at least 25.
        filter_particles: number of particles of the FIVO bound; 0 omits it.
        leave_future_out: L and M: also compare the log densities of M steps given all earlier ones, from L observed
            steps on.
        ensembles: add a row for the equal-weight mixture of the seeds of each row with several seeds.
        contrasts: number of windows for the mutual information of latents and data; 0 omits it.
        samples: number of forecasts of each window.
        forecasts: also score forecasts, which takes longest.
        draw_emission: whether forecasts are draws of x or means of its emission distribution. By default means
            for motion, as in published scores, and draws for a table. Discrete data and models without latents are
            always drawn by default.
        stride: frames between the starts of test windows, in place of the protocol's; a larger stride is faster.
        seed: seed of the draws.
        batch_size: number of windows scored at once.
        accelerator: device that computes: cpu, cuda or gpu, or auto for a GPU if there is one.
        out: JSON file for the comparison.
        figure: save bounds, differences, k-hat, and KL over time.
    """
    if samples == 0:
        raise UsageError("--samples must be at least 1, got 0; use --no-forecasts to compare without forecasts")
    at_least(1, particles=particles, estimates=estimates, samples=samples, batch_size=batch_size, stride=stride)
    at_least(0, contrasts=contrasts, filter_particles=filter_particles)
    check_files(out, figure, ".json")
    loaded = loading.with_equal_windows(run, data, use=Use(failed=True, accelerator=accelerator))
    data_set = loading.data_of(data, *loaded, missing=missing)
    if unfinished := [str(each.path) for each in loaded if each.unfinished]:
        raise ValueError(
            f"{', '.join(unfinished)} did not finish and cannot be compared; leave it out, or "
            + "; ".join(runs.advice(path) for path in unfinished)
        )
    windows = loading.windows_to_test(loaded[0], data_set, stride)
    rows = loading.rows(loaded)
    models: dict[str, Any] = {name: [each.model for each in row] for name, row in rows.items()}
    models |= _mixtures(loaded) if ensembles else {}
    if by_forecast := [name for name, row in rows.items() if any(r.config.training.select == "forecast" for r in row)]:
        warnings.warn(
            f"forecasts selected the weights of {', '.join(by_forecast)}, so their bounds may be below the best; fit "
            "with --select bound to compare bounds",
            stacklevel=2,
        )
    result = compare_models(
        models,
        windows,
        scores=loading.SCORES[loaded[0].config.kind],
        particles=particles,
        estimates=estimates,
        filter_particles=filter_particles,
        leave_future_out=leave_future_out,
        contrasts=contrasts,
        samples=samples if forecasts else 0,
        draw_emission=draw_emission,
        seed=seed,
        batch_size=batch_size,
        configs={name: loading.config_without_seed(row[0]) for name, row in rows.items()},
    )
    save_and_print(result, [] if out is None else [out], figure)


def _pose_prior(scoring: ForecastScoring, data: str | None, skeleton: motion.Skeleton) -> Any:
    """Return the pose prior of a run for a skeleton; None if no run is given.

    Raises:
        UsageError: the run is not a pose prior of this skeleton.
    """
    if (path := scoring.pose_prior) is None:
        return None
    model = loading.load(path, data, scoring.use).model
    if not isinstance(model, PosePriorModel) or model.skeleton != skeleton:
        raise UsageError(f"--pose-prior {path} is not a run of a pose-prior for the skeleton {skeleton.name!r}")
    return model


def _classifiers(scoring: ForecastScoring, data: str | None, scored_run: runs.Loaded) -> dict[str, Any]:
    """Return the action classifiers of runs by label.

    Raises:
        UsageError: a run is not an action classifier, repeats a label, or was fitted on other data than `scored_run`.
    """
    classifiers: dict[str, Any] = {}
    for path in scoring.classifier:
        loaded = loading.load(path, data, scoring.use)
        if loaded.method.name != "action-classifier":
            raise UsageError(f"--classifier {path} is a fitted {loaded.method.name}, not an action-classifier")
        if loaded.model.label in classifiers:
            raise UsageError(
                f"--classifier {path} is a second classifier of the label {loaded.model.label!r}; give one per label"
            )
        if not loaded.alike(scored_run):
            source, other = (f"{run.config.data.path}, {run.schema.protocol.name}" for run in (loaded, scored_run))
            raise UsageError(
                f"--classifier {path} was fitted on other data or under another protocol ({source}) than the runs "
                f"({other}); it may have seen test clips"
            )
        classifiers[loaded.model.label] = loaded.model
    return classifiers
