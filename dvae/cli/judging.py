"""Commands that judge runs: evaluate, criticise, reference, tubes, compare, bracket."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from .. import files, motion
from ..data.sequences import each as of_each
from ..inference.diagnostics.bracket import bracket as bracketed
from ..inference.diagnostics.calibration import calibrate
from ..inference.diagnostics.checks import predictive_checks
from ..inference.diagnostics.stein import stein_discrepancy
from ..inference.diagnostics.yardstick import reference_posterior
from ..inference.evaluation.compare import compare as compare_models
from ..inference.evaluation.conformal import conformal
from ..inference.evaluation.evaluate import evaluate as evaluate_models
from ..inference.training.checkpoints import CheckpointError, Run
from ..models.motion.trajectories import TrajectoryModel
from ..motion.judges.pose_prior import PosePriorModel
from ..runs import directory as runs
from ..tables.scoring import panel_scores
from . import opening, tables
from .console import ERROR, OUT, Failed, Missing, UsageError, at_least, check_files, note, save_figure
from .futures import joint_names

MOST_REMEMBERED = 2**32
"""Bytes of training windows that references hold at once; of mapped data there may be more."""


@dataclass(frozen=True)
class Control:
    """What methods that take trajectories (trajevae, cvae-rnn, motion-infilling) are told.

    Args:
        joints: joints whose paths are given to the runs.
        exchange: begin each window with the pose of another one, whose given joints are so many metres from its own at
            most (in the paper .01).
        temperature: of the latents' scale; 0 for motion at the mean of the prior.
    """

    joints: tuple[str, ...] | None = None
    exchange: float | None = None
    temperature: float | None = None

    def windows(self, windows: motion.Windows, loaded: Sequence[runs.Loaded]) -> Any:
        """The windows as the runs are given them."""
        if self == Control():
            return windows
        for each in loaded:
            if not isinstance(each.model, TrajectoryModel):
                raise UsageError(
                    f"--joints, --exchange and --temperature are for methods that take trajectories; {each.path} holds "
                    f"{each.method.name}"
                )
        given = windows.given(joint_names(self.joints or ()))
        return given if self.exchange is None else motion.Exchanged(given, self.exchange)

    def __str__(self) -> str:
        parts = ["", *joint_names(self.joints or ())]
        parts += [] if self.exchange is None else [f"exchanged-{self.exchange:g}"]
        return "-".join(parts if self.temperature is None else [*parts, f"temperature-{self.temperature:g}"])


def evaluate(
    run: Annotated[tuple[Path, ...], tyro.conf.Positional],
    control: Control,
    data: str | None = None,
    missing: Missing = False,
    failed: Failed = False,
    samples: int = 50,
    bound_particles: int = 0,
    log_score_particles: int = 0,
    pose_prior: Path | None = None,
    classifier: tuple[Path, ...] = (),
    seed: int = 0,
    batch_size: int = 32,
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Score runs on the test windows of their protocol, beside zero velocity and nearest neighbours.

    Runs of motion-latent: how near test segments come back, beside principal components of equal dimensions. Options
    about forecasts are not for them.

    Prints the table, and writes it with all that it rests on to evaluation.json in each run, or to --out. With given
    joints or other data, the name of the file says which; nearest neighbours are those in the runs' own data alone.

    Args:
        run: run directories, fitted on the same data under the same protocol.
        control: what methods that take trajectories are told.
        data: where the data lie now, if the path in the runs no longer leads there; or other data of the same joints.
        samples: forecasts of each window, K.
        bound_particles: particles of the importance-weighted bound; 0 leaves it out.
        log_score_particles: particles of the log density of the future under the forecasts; 0 leaves it out.
        pose_prior: run of a pose-prior, by which to score the poses of the forecasts.
        classifier: runs of action-classifiers of different labels, by which to score what the forecasts show.
        seed: of the draws.
        batch_size: windows forecast at once.
        out: file to write instead of evaluation.json in each run.
        figure: save the scores as dots with error bars, or as boxes of segments.
    """
    at_least(1, samples=samples, batch_size=batch_size)
    at_least(0, bound_particles=bound_particles, log_score_particles=log_score_particles)
    check_files(out, figure, ".json")
    how = Judged(samples, log_score_particles, pose_prior, classifier, control, missing, failed)
    score = SCORERS.get(opening.kind_of(run, data), _forecasts)
    result, record = score(run, data, how, bound_particles=bound_particles, seed=seed, batch_size=batch_size)
    _keep(result, [each / f"{record}.json" for each in run] if out is None else [out], figure)


@dataclass(frozen=True)
class Judged:
    """What only forecasts are judged by; see `evaluate`."""

    samples: int = 50
    log_score_particles: int = 0
    pose_prior: Path | None = None
    classifier: tuple[Path, ...] = ()
    control: Control = Control()
    missing: bool = False
    failed: bool = False


def _forecasts(paths: Sequence[Path], data: str | None, how: Judged, **settings: Any) -> tuple[Any, str]:
    """Scores of forecasts of test windows, and what to call them."""
    loaded = opening.alike(paths, data, failed=how.failed)
    opened = opening.data_of(data, *loaded, missing=how.missing)
    called, windows = dict(zip(opening.names(loaded), loaded, strict=True)), opened.windows("test")
    given = how.control.windows(windows, loaded)
    classifiers = _classifiers(how, data, loaded[0])
    prior = _pose_prior(how, data, windows.skeleton)
    own, temperature = opening.own(loaded[0], opened), how.control.temperature
    result = evaluate_models(
        {name: each.model for name, each in called.items()},
        given,
        scores=partial(motion.scores, pose_prior=prior, classifiers=classifiers),
        samples=how.samples,
        log_score_particles=how.log_score_particles,
        training_windows=_remembered(opened) if own else None,
        configs={name: Run(each.path).config for name, each in called.items()},
        options={} if temperature is None else {"temperature": temperature},
        **settings,
    )
    return result, f"{opening.record('evaluation', loaded[0], opened)}{how.control}"


def _remembered(opened: Any) -> Any:
    """Training windows for the references that know them, where memory is to hold so many."""
    windows = opened.windows("train+validation")
    size = 4 * len(windows) * windows.length * windows.schema.sizes["x"]
    if size <= MOST_REMEMBERED:
        return windows
    note(
        f"no references that know training windows, of which {len(windows):,} would take {size / 2**30:.1f} GB; in "
        "Python, dvae.evaluate takes others as training_windows"
    )
    return None


def _segments(paths: Sequence[Path], data: str | None, how: Judged, **settings: Any) -> tuple[Any, str]:
    """How near test segments come back, and what to call that."""
    if odd := [name for name, value in vars(how).items() if name != "failed" and value != getattr(Judged, name)]:
        options = "--joints, --exchange and --temperature are" if odd[0] == "control" else f"--{odd[0]} is"
        raise UsageError(f"{options.replace('_', '-')} about forecasts, and {paths[0]} makes whole segments")
    loaded = opening.alike(paths, data, "segments", how.failed)
    opened = opening.data_of(data, *loaded)
    called = dict(zip(opening.names(loaded), loaded, strict=True))
    try:
        own = opened if opening.own(loaded[0], opened) else replace(loaded[0], where=None).data
        training = own.windows("train")
    except CheckpointError as error:
        note(f"no principal components, which are of training segments: {error}")
        training = None
    result = motion.reconstruct_segments(
        {name: each.model for name, each in called.items()},
        opened.windows("test"),
        training,
        configs={name: Run(each.path).config for name, each in called.items()},
        **settings,
    )
    return result, opening.record("evaluation", loaded[0], opened)


def _tables(paths: Sequence[Path], data: str | None, how: Judged, **settings: Any) -> tuple[Any, str]:
    """Scores of forecasts of a table's test windows, and what to call them."""
    odd = [
        name
        for name in ("pose_prior", "classifier", "control", "missing")
        if getattr(how, name) != getattr(Judged, name)
    ]
    if odd:
        raise UsageError(f"--{odd[0].replace('_', '-')} is about motion, and {paths[0]} is of a table")
    loaded = opening.alike(paths, data, "panel", how.failed)
    opened = opening.data_of(data, *loaded)
    called = dict(zip(opening.names(loaded), loaded, strict=True))
    result = evaluate_models(
        {name: each.model for name, each in called.items()},
        tables.windows(loaded[0], opened),
        scores=panel_scores,
        samples=how.samples,
        log_score_particles=how.log_score_particles,
        training_windows=_remembered(opened) if opening.own(loaded[0], opened) else None,
        configs={name: Run(each.path).config for name, each in called.items()},
        **settings,
    )
    return result, opening.record("evaluation", loaded[0], opened)


SCORERS = {"motion": _forecasts, "segments": _segments, "panel": _tables}
"""What `evaluate` does with runs, by the kind of their data."""


def _keep(result: Any, paths: Sequence[Path], figure: Path | None) -> None:
    """Write a result to files, and then print it, as the output may be closed or full."""
    for path in paths:
        result.save(path)
        ERROR.print(f"wrote {path}")
    if figure is not None:
        save_figure(result.plot(), figure)
        if "PIT" in {name for row in getattr(result, "rows", {}).values() for name in getattr(row, "histograms", {})}:
            save_figure(result.plot_calibration(), figure.with_stem(f"{figure.stem}-calibration"))
    OUT.print(result.table())


def criticise(
    run: Annotated[Path, tyro.conf.Positional],
    data: str | None = None,
    missing: Missing = False,
    failed: Failed = False,
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
        data: where the data lie now, if the path in the run no longer leads there; or other data of the same joints.
        simulations: sequences drawn from the model, as long as its windows.
        draws: from the guide for each simulation.
        ranked_steps: time steps, evenly spread, at which local latents are ranked.
        samples: replicates of each test window, at least 19.
        draw_emission: replicate draws of x, or its means, which lack the emission's noise: motion as it is shown. Of
            trajevae, cvae-rnn and motion-infilling always means, as their emission is a weight of the loss.
        seed: of the draws.
        batch_size: windows replicated at once.
        out: file to write instead of criticism.json in the run.
        figure: save the figures, with -calibration and -checks added to this name.
    """
    at_least(1, simulations=simulations, draws=draws, ranked_steps=ranked_steps, batch_size=batch_size)
    at_least(19, samples=samples)
    check_files(out, figure, ".json")
    kind = opening.kind_of([run], data)
    loaded = opening.load_run(run, data, kind if kind == "panel" else "motion", failed)
    opened, model = opening.data_of(data, loaded, missing=missing), loaded.model
    windows: Any = tables.windows(loaded, opened) if kind == "panel" else opened.windows("test")
    steps = np.unique(np.linspace(1, windows.length, ranked_steps + 1)[1:].round().astype(int)).tolist()
    document: dict[str, Any] = {}
    path = out or run / f"{opening.record('criticism', loaded, opened)}.json"
    if model.context:
        ERROR.print(
            f"no calibration: sequences are simulated from nothing, but {loaded.method.name} is given "
            f"{', '.join(model.context)}"
        )
    elif not model.latents:
        ERROR.print(f"no calibration: {loaded.method.name} has no latents, and so no guide")
    else:
        calibration = calibrate(model, windows.length, simulations, draws, steps=steps, seed=seed)
        _add(document, "calibration", calibration, path, figure, "calibration")
    checks = predictive_checks(
        {loaded.method.name: model},
        windows,
        None if kind == "panel" else motion.statistics(windows),
        samples=samples,
        draw_emission=draw_emission and not isinstance(model, TrajectoryModel),
        seed=seed,
        batch_size=batch_size,
    )
    _add(document, "predictive", checks, path, figure, "checks")


def reference(
    run: Annotated[Path, tyro.conf.Positional],
    data: str | None = None,
    missing: Missing = False,
    failed: Failed = False,
    windows: int = 3,
    frames: int | None = None,
    draws: int = 1000,
    chains: int = 4,
    warmup: int = 500,
    stein_draws: int = 500,
    seed: int = 0,
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Put what a run's guide says of latents beside their posterior, on some test windows.

    First the kernel Stein discrepancy, which takes moments, then means, deviations and correlations beside those by
    NUTS, which take minutes for each window: begin with a few frames. Prints the tables, and writes them to
    reference.json in the run, or to --out, each as soon as it is there.

    Args:
        run: the run directory.
        data: where the data lie now, if the path in the run no longer leads there; or other data of the same joints.
        windows: test windows, evenly spread.
        frames: of a window, from its first one, of which latents are inferred; all by default.
        draws: of each chain of NUTS.
        chains: of each window.
        warmup: draws of each chain before.
        stein_draws: from the guide for the kernel Stein discrepancy.
        seed: of the draws.
        out: file to write instead of reference.json in the run.
        figure: save the figures, with -stein and -reference added to this name.
    """
    at_least(1, windows=windows, frames=frames, warmup=warmup)
    at_least(2, chains=chains, stein_draws=stein_draws)
    at_least(4, draws=draws)
    check_files(out, figure, ".json")
    kind = opening.kind_of([run], data)
    loaded = opening.load_run(run, data, kind if kind == "panel" else "motion", failed)
    opened = opening.data_of(data, loaded, missing=missing)
    batch = opened.windows("test").all()
    some = np.unique(np.linspace(0, len(batch["x"]) - 1, windows).round().astype(int))
    kept = of_each(batch, lambda value: value[some, :frames] if value.dim() == 3 else value[some])
    if "lengths" in kept and frames is not None:
        kept = {**kept, "lengths": kept["lengths"].clamp(max=frames)}
    document: dict[str, Any] = {"windows": some.tolist(), "frames": frames}
    path = out or run / f"{opening.record('reference', loaded, opened)}.json"
    found = stein_discrepancy(loaded.model, kept, draws=stein_draws, seed=seed)
    _add(document, "stein", found, path, figure, "stein")
    beside = reference_posterior(loaded.model, kept, draws=draws, chains=chains, warmup=warmup, seed=seed)
    _add(document, "reference", beside, path, figure, "reference")


def _add(document: dict[str, Any], part: str, result: Any, path: Path, figure: Path | None, drawn: str) -> None:
    """Write what there is of the criticism, and print its new part."""
    document[part] = result.document()
    with files.written(path) as file:
        file.write((json.dumps(document, indent=1, allow_nan=False) + "\n").encode())
    ERROR.print(f"wrote {path}: {part}")
    _keep(result, [], figure and figure.with_stem(f"{figure.stem}-{drawn}"))


def tubes(
    run: Annotated[Path, tyro.conf.Positional],
    data: str | None = None,
    missing: Missing = False,
    failed: Failed = False,
    level: float = 0.9,
    label: str | None = None,
    values: tuple[str, ...] = (),
    samples: int = 50,
    seed: int = 0,
    batch_size: int = 32,
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Widen a run's forecasts to tubes that hold the future as often as they say, and judge them on other windows.

    Calibrated on the run's validation windows, which are of what it was fitted on and chose the weights that were
    kept, and judged on its test windows; or, by --label style --values feminine, on the test clips of some styles, and
    judged on the others. Prints the factors and how often futures are held before and after, and writes tubes.json and
    tubes-coverage.json in the run, or beside --out: `dvae.Tubes.load` reads the first, and its `tube` goes around
    forecasts.

    Args:
        run: the run directory.
        data: where the data lie now, if the path in the run no longer leads there; or other data of the same joints.
        level: share of futures to be held.
        label: of test clips, by whose values they are for calibration.
        values: of the label, of the clips that calibrate.
        samples: forecasts of each window.
        seed: of the draws.
        batch_size: windows forecast at once.
        out: file to write instead of tubes.json in the run.
        figure: save the factors over the horizon.
    """
    at_least(1, samples=samples, batch_size=batch_size)
    check_files(out, figure, ".json")
    if bool(values) != (label is not None):
        raise UsageError("--label and --values tell together which test clips calibrate")
    kind = opening.kind_of([run], data)
    loaded = opening.load_run(run, data, kind if kind == "panel" else "motion", failed)
    opened = opening.data_of(data, loaded, missing=missing)
    kept, judged = _kept_and_judged(kind, loaded, opened, label, values)
    found = conformal(loaded.model, kept, level, samples=samples, seed=seed, batch_size=batch_size)
    path = out or run / f"{opening.record('tubes', loaded, opened)}.json"
    _keep(found, [path], figure)
    _keep(found.coverage({loaded.method.name: loaded.model}, judged), [path.with_stem(f"{path.stem}-coverage")], None)


def _kept_and_judged(kind: str, loaded: runs.Loaded, opened: Any, label: str | None, values: Sequence[str]) -> Any:
    """Windows to calibrate on, and to judge on."""
    if kind == "panel":
        if label is not None:
            raise UsageError(f"--label is of clips of motion, and {loaded.path} is of a table")
        return [tables.windows(loaded, opened, split) for split in ("validation", "test")]
    if label is None:
        return [opened.windows(split) for split in ("validation", "test")]
    clips, whole = opened.windows("test").clips, opened.motion
    found = {clip.labels.get(label, "") for clip in clips}
    if unknown := sorted({*values} - found):
        raise UsageError(f"no test clip has {label} {', '.join(unknown)}; there are {', '.join(sorted(found))}")
    test = motion.MotionSet(clips, whole.skeleton, opened.path, missing=whole.missing)
    others = tuple(sorted(found - {*values}))
    if not others:
        raise UsageError(f"all test clips would calibrate, of {label} {', '.join(values)}; leave some to judge on")
    return [
        motion.windows(test, replace(opened.protocol, split_by=label, train=(), test=part), "test")
        for part in (tuple(values), others)
    ]


def compare(
    run: Annotated[tuple[Path, ...], tyro.conf.Positional],
    data: str | None = None,
    missing: Missing = False,
    particles: int = 64,
    estimates: int = 1,
    filter_particles: int = 0,
    contrasts: int = 128,
    samples: int = 50,
    forecasts: bool = True,
    draw_emission: bool | None = None,
    stride: int | None = None,
    seed: int = 0,
    batch_size: int = 32,
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Compare runs on the test windows of their protocol. Runs that differ in the seed only are seeds of one row.

    All must have ended: one that was stopped is no whole fit. Of whole sequences of a table bounds are compared alone.

    Args:
        run: run directories, fitted on the same data under the same protocol.
        data: where the data lie now, if the path in the runs no longer leads there; or other data of the same joints.
        particles: of the importance-weighted bound, K.
        estimates: independent estimates of that bound; 25 or more for arviz, 1 otherwise.
        filter_particles: of the particle filter's bound (FIVO) beside that one; 0 leaves it out.
        contrasts: windows among which the information of latents is measured; 0 leaves it out.
        samples: forecasts of each window.
        forecasts: score forecasts too, which takes longest.
        draw_emission: forecast draws of x, or its means; by default draws of a table, and of motion means, for which
            its scores are published, unless data are discrete or nothing is latent.
        stride: frames between the starts of test windows, in place of the protocol's: more is faster.
        seed: of the draws.
        batch_size: windows scored at once.
        out: file to write the comparison to, as JSON.
        figure: save bounds, differences, k-hat, and KL over time.
    """
    at_least(1, particles=particles, estimates=estimates, samples=samples, batch_size=batch_size, stride=stride)
    at_least(0, contrasts=contrasts, filter_particles=filter_particles)
    check_files(out, figure, ".json")
    kind = opening.kind_of(run, data)
    loaded = opening.alike(run, data, kind if kind == "panel" else "motion", failed=True)
    opened = opening.data_of(data, *loaded, missing=missing)
    if stopped := [str(each.path) for each in loaded if each.unfinished]:
        raise ValueError(
            f"{', '.join(stopped)} is no whole fit, and cannot be compared; leave it out, or "
            + "; ".join(runs.advice(path) for path in stopped)
        )
    windows, judged = _compared(loaded[0], opened, stride)
    shown = opening.rows(loaded)
    result = compare_models(
        {name: [each.model for each in row] for name, row in shown.items()},
        windows,
        scores=judged,
        particles=particles,
        estimates=estimates,
        filter_particles=filter_particles,
        contrasts=contrasts,
        samples=samples if forecasts else 0,
        draw_emission=draw_emission,
        seed=seed,
        batch_size=batch_size,
        configs={name: opening.config_without_seed(row[0]) for name, row in shown.items()},
    )
    _keep(result, [] if out is None else [out], figure)


def bracket(
    run: Annotated[Path, tyro.conf.Positional],
    data: str | None = None,
    missing: Missing = False,
    failed: Failed = False,
    count: int = 32,
    particles: int = 64,
    temperatures: int = 50,
    chains: int = 8,
    fitting: int = 300,
    reach: int | None = None,
    seed: int = 0,
    batch_size: int = 32,
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """A run's evidence between two bounds, and where its ELBO loses what it lacks: amortisation, arrows, family.

    Prints bounds of some test windows and of as many that are simulated from the model, and the parts of the gap, and
    writes them to bracket.json in the run, or to --out.

    Args:
        run: the run directory.
        data: where the data lie now, if the path in the run no longer leads there; or other data of the same joints.
        count: test windows, drawn at random; time grows with them.
        particles: of IWAE and FIVO, and draws over which ELBOs are averaged.
        temperatures: of annealed importance sampling, L: the more, the narrower the bracket.
        chains: of each window.
        fitting: steps of the guides of single windows; 0 leaves the parts of the gap out.
        reach: steps between latents up to which these guides read them linearly; by default all that arrows allow.
        seed: of the draws.
        batch_size: windows at once.
        out: file to write instead of bracket.json in the run.
        figure: save all bounds on one axis.
    """
    at_least(1, count=count, particles=particles, temperatures=temperatures, chains=chains, batch_size=batch_size)
    at_least(0, fitting=fitting, reach=reach)
    check_files(out, figure, ".json")
    kind = opening.kind_of([run], data)
    loaded = opening.load_run(run, data, kind if kind == "panel" else "motion", failed)
    opened = opening.data_of(data, loaded, missing=missing)
    windows, _ = _compared(loaded, opened, None)
    result = bracketed(
        loaded.model,
        windows,
        count=count,
        particles=particles,
        temperatures=temperatures,
        chains=chains,
        fitting=fitting,
        reach=reach,
        seed=seed,
        batch_size=batch_size,
    )
    _keep(result, [out or run / f"{opening.record('bracket', loaded, opened)}.json"], figure)


def _compared(first: runs.Loaded, opened: Any, stride: int | None) -> tuple[Any, Any]:
    """Test windows, so far apart, and what forecasts of them are scored by."""
    if first.config.kind == "panel" and opened.schema.cut.length is None:
        if stride is not None:
            raise UsageError(f"--stride is between windows, and {first.path} was fitted on whole sequences")
        return opened.windows("test"), panel_scores
    if first.config.kind == "panel":
        return tables.windows(first, opened, stride=stride), panel_scores
    protocol = opened.protocol if stride is None else replace(opened.protocol, test_stride=stride)
    return motion.windows(opened.motion, protocol, "test"), motion.scores


def _pose_prior(how: Judged, data: str | None, skeleton: motion.Skeleton) -> Any:
    """The pose prior of a run, for poses of a skeleton; None where there is none."""
    if (path := how.pose_prior) is None:
        return None
    model = opening.load(path, data, how.failed).model
    if not isinstance(model, PosePriorModel) or model.skeleton != skeleton:
        raise UsageError(f"--pose-prior {path} is no run of a pose-prior of the skeleton {skeleton.name!r}")
    return model


def _classifiers(how: Judged, data: str | None, judged: runs.Loaded) -> dict[str, Any]:
    """The action classifiers of runs by their label, fitted on what the judged run was."""
    found: dict[str, Any] = {}
    for path in how.classifier:
        loaded = opening.load(path, data, how.failed)
        if loaded.method.name != "action-classifier":
            raise UsageError(f"--classifier {path} is a fitted {loaded.method.name}, no action-classifier")
        if loaded.model.label in found:
            raise UsageError(f"--classifier {path} is the second of the label {loaded.model.label!r}; give one of them")
        if not loaded.alike(judged):
            there, here = (f"{run.config.data.path}, {run.schema.protocol.name}" for run in (loaded, judged))
            raise UsageError(
                f"--classifier {path} was fitted on other data or under another protocol ({there}) than the runs "
                f"({here}); it may have seen test clips"
            )
        found[loaded.model.label] = loaded.model
    return found
