"""Commands that score runs: evaluate and compare."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro

from .. import motion
from ..inference.evaluation.compare import compare as compare_models
from ..inference.evaluation.evaluate import evaluate as evaluate_models
from ..inference.evaluation.scores import Scores
from ..inference.training.checkpoints import CheckpointError, Run
from ..models.motion.trajectories import TrajectoryModel
from ..motion.judges.pose_prior import PosePriorModel
from ..runs import directory as runs
from . import opening
from .console import ERROR, OUT, Failed, Missing, UsageError, at_least, check_files, note, save_figure
from .futures import joint_names
from .help import Expert

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
    missing: Expert[Missing] = False,
    failed: Expert[Failed] = False,
    samples: int = 50,
    bound_particles: int = 0,
    log_score_particles: Expert[int] = 0,
    pose_prior: Path | None = None,
    classifier: tuple[Path, ...] = (),
    seed: int = 0,
    batch_size: Expert[int] = 32,
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
    score = _segments if opening.kind_of(run, data) == "segments" else _forecasts
    result, record = score(run, data, how, bound_particles=bound_particles, seed=seed, batch_size=batch_size)
    keep(result, [each / f"{record}.json" for each in run] if out is None else [out], figure)


OF_MOTION = ("pose_prior", "classifier", "control", "missing")
"""Options of `evaluate` that are about motion."""


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
    """Score forecasts of test windows; return the scores and the name of their file."""
    loaded = opening.alike(paths, data, failed=how.failed)
    opened = opening.data_of(data, *loaded, missing=how.missing)
    windows = opening.windows_to_test(loaded[0], opened, whole=False)
    temperature = how.control.temperature
    scores: Scores = opening.SCORES[loaded[0].config.kind]
    if loaded[0].config.kind == "motion":
        classifiers = _classifiers(how, data, loaded[0])
        scores = partial(motion.scores, pose_prior=_pose_prior(how, data, windows.skeleton), classifiers=classifiers)
        windows = how.control.windows(windows, loaded)
    elif odd := [name for name in OF_MOTION if getattr(how, name) != getattr(Judged, name)]:
        raise UsageError(f"--{odd[0].replace('_', '-')} is about motion, and {paths[0]} is of a table")
    result = evaluate_models(
        {name: each.model for name, each in zip(opening.names(loaded), loaded, strict=True)},
        windows,
        scores=scores,
        samples=how.samples,
        log_score_particles=how.log_score_particles,
        training_windows=_remembered(opened) if opening.own(loaded[0], opened) else None,
        configs={name: Run(each.path).config for name, each in zip(opening.names(loaded), loaded, strict=True)},
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
    loaded = opening.alike(paths, data, ("segments",), how.failed)
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


def keep(result: Any, paths: Sequence[Path], figure: Path | None) -> None:
    """Write a result to files, and then print it, as the output may be closed or full."""
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
    particles: int = 64,
    estimates: Expert[int] = 1,
    filter_particles: Expert[int] = 0,
    contrasts: Expert[int] = 128,
    samples: int = 50,
    forecasts: bool = True,
    draw_emission: Expert[bool | None] = None,
    stride: Expert[int | None] = None,
    seed: int = 0,
    batch_size: Expert[int] = 32,
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
    loaded = opening.alike(run, data, failed=True)
    opened = opening.data_of(data, *loaded, missing=missing)
    if stopped := [str(each.path) for each in loaded if each.unfinished]:
        raise ValueError(
            f"{', '.join(stopped)} is no whole fit, and cannot be compared; leave it out, or "
            + "; ".join(runs.advice(path) for path in stopped)
        )
    windows = opening.windows_to_test(loaded[0], opened, stride)
    shown = opening.rows(loaded)
    result = compare_models(
        {name: [each.model for each in row] for name, row in shown.items()},
        windows,
        scores=opening.SCORES[loaded[0].config.kind],
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
    keep(result, [] if out is None else [out], figure)


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
