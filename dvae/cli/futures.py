"""Commands that use runs: forecast, impute, animate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro

from .. import motion
from ..data.sequences import Sequences
from ..inference.evaluation.result import new_figure, styled
from ..inference.training.checkpoints import Run
from ..locking import seeded
from ..models.motion.trajectories import TrajectoryModel
from ..motion.data.dataset import SIMULATED
from ..motion.files.writing import format_of
from ..options import nearest
from ..runs import directory as runs
from . import tables
from .console import ERROR, OUT, Missing, UsageError, at_least, check_files, save_figure
from .help import Expert
from .loading import ON_CPU, Use, data_of, forecaster, kind_of, load_run
from .segments import Recovery

SAMPLES = 10
"""Default number of futures and fillings of motion."""
EMISSIONS = {"drawn": "draws of the emission", "mean": "means of the emission", "": "draws or means of the emission"}
"""Descriptions of the emission of futures."""


@dataclass(frozen=True)
class Paths:
    """Paths to follow, for methods that take trajectories (trajevae, cvae-rnn, moglow-paths, motion-infilling).

    Args:
        joints: joints that follow their true paths in the window.
        paths: file of paths: an npz with an array (frames, 3) for each joint, or a csv with columns such as LWrist_x,
            LWrist_y, LWrist_z and one row for each frame. Units are metres, relative to the pelvis of the first pose;
            unknown positions are empty or nan.
        window: number of the window whose first pose starts the motions, from 0; by default the one that moves most.
        exact: place the given joints exactly on their paths and keep bone lengths, by optimising latents and then
            poses; not for motion-infilling, which has no latents.
        temperature: scale factor of the latents; 0 for the motion at the mean of the prior.
    """

    joints: tuple[str, ...] = ()
    paths: Path | None = None
    window: Expert[int | None] = None
    exact: Expert[bool] = False
    temperature: Expert[float] = 1.0


def forecast(
    run: Annotated[Path, tyro.conf.Positional],
    out: Path,
    along: Paths,
    clip: str | None = None,
    horizon: int | None = None,
    samples: int | None = None,
    fix: Expert[tuple[str, ...]] = (),
    draw_emission: Expert[bool | None] = None,
    seed: int = 0,
    data: str | None = None,
    missing: Expert[Missing] = False,
    use: Use = ON_CPU,
    figure: Path | None = None,
    beyond: bool = False,
    blend: int = 0,
) -> None:
    """Forecast the test windows, or those of one clip or sequence, many times each.

    For a table, a CSV or Parquet file contains mean and quantiles, one row for each window, step and column. An npz
    contains the draws. --figure plots prediction intervals.

    For motion, an npz contains, in metres, `forecasts` (samples, windows, horizon, joints, 3), `observed` and `truth`
    (windows, frames, joints, 3). Missing joints are NaN. It also contains `split`, `clip` and `start` of each window,
    the skeleton, and `emission`, which is "drawn" or "mean". `dvae animate` plays it, and `dvae.motion.Forecasts.load`
    reads it. `largest_steps` are the largest distances of a joint from the last observed frame to the next one, in
    futures and in the truth, and `blend` is the number of blended frames.

    A .bvh file contains the first future of the window that moves most. A name without a suffix is a new folder with a
    BVH file for every window and future. BVH files contain the observed frames and then the future, at the place of the
    clip if the protocol keeps the root's path (`dvae fit --root travel`).

    With --joints or --paths, motions start at the first pose of one window and follow these paths.

    Args:
        run: run directory.
        out: file or folder to write.
        along: paths of joints.
        clip: name of a clip, or of a sequence of a table, of any split; split/name if the name is not unique.
        horizon: number of frames to forecast; by default the horizon of the protocol.
        samples: number of forecasts of each window; by default 10, and 100 for a table, whose quantiles are written.
        fix: parts of the body, such as lower, or static latents, that all forecasts of a window share.
        draw_emission: for motion: include the noise of the emission, or return its means given draws of the latents.
            By default an npz has draws and BVH has means, unless the model has no latents.
        seed: seed of the draws.
        data: where the data are now, if the path in the run is no longer valid; or other data with the same variables.
        figure: save a figure of the first window's futures.
        beyond: for a table: forecast the steps after its last row with a target, using covariates of later rows.
        blend: for motion: number of first frames that pass from the observed motion to the future, without a jump at
            the seam. Do not score blended forecasts.
    """
    at_least(0, blend=blend)
    at_least(1, samples=samples, horizon=horizon)
    at_least(0, window=along.window)
    check_files(out, figure)
    loaded, data_set = forecaster(run, data, missing, use)
    if loaded.config.kind == "panel":
        of_motion = {"fix": bool(fix), "missing": missing, "draw-emission": draw_emission is not None}
        of_motion["blend"] = blend > 0
        of_motion |= {name: value != getattr(Paths, name) for name, value in vars(along).items()}
        if inapplicable := [name for name, is_given in of_motion.items() if is_given]:
            raise UsageError(f"--{inapplicable[0]} is for motion, and {run} was fitted on a table; leave it out")
        tables.forecast(loaded, data_set, out, clip, horizon, samples, seed, figure, beyond)
        return
    if beyond:
        raise UsageError(f"--beyond is for tables, and {run} was fitted on motion; leave it out")
    windows, samples = windows_of(data_set, clip), samples or SAMPLES
    if along != Paths():
        check_files(out, figure, ".npz")
        if horizon or fix or draw_emission is not None or blend:
            raise UsageError(
                "--horizon, --fix, --draw-emission and --blend do not apply to motion along --joints or --paths"
            )
        _follow_paths(loaded, windows, along, samples, seed, out, figure)
        return
    suffix = out.suffix.lower()
    check_files(out, figure, ".npz", ".bvh", "")
    selected: Sequence[int] = range(len(windows))
    if suffix == ".bvh":
        selected = [_fastest_window(windows.positions(windows.all().mask_to_nan()).numpy(), None)]
    if draw_emission is None and suffix == ".npz":
        draw_emission = loaded.model.is_drawn()
    futures = draw_futures(loaded, windows, selected, samples, seed, horizon, fix, draw_emission)
    context, protocol = "", windows.protocol
    blended = futures.blended(blend) if blend else futures
    written, unblended = (each.window(0, 1) if suffix == ".bvh" else each for each in (blended, futures))
    if suffix == ".npz":
        written.save(out)
    else:
        motion.write_motion(
            out, (written if protocol.root == "drop" else _in_world(written, windows, selected)).motion(), "bvh"
        )
        context = f", after {futures.observed.shape[1]} observed frames"
    frames = futures.forecasts.shape[2]
    description = f"the first of {samples} futures" if suffix == ".bvh" else f"{samples} futures"
    dropped = f"; relative to the root: the protocol {protocol.name} removes the root's path"
    ERROR.print(
        f"wrote {out}: {description} of {frames} frames for each of {len(selected)} windows{context}, "
        f"{EMISSIONS[futures.emission]}{_blended(written)}{dropped if protocol.root == 'drop' else ''}"
    )
    ERROR.print(f"largest step of a joint to the first future frame: {_steps(written, unblended, 1)}")
    if blend:  # with the step after them, which has the jump if they are few
        ERROR.print(
            f"largest step of a joint in and after {blend} blended frames: {_steps(written, unblended, blend + 1)}"
        )
    if protocol.root != "drop":
        ERROR.print(_travel(written))
    _save_futures(blended, figure)


def _steps(futures: motion.Forecasts, unblended: motion.Forecasts, frames: int) -> str:
    """Return the largest step of a joint in the first frames, before and after blending, and in the true motion."""
    (step, true_step), earlier = futures.largest_steps(frames), unblended.largest_steps(frames)[0]
    note = f" ({1000 * earlier:.0f} mm before blending)" if futures.blend else ""
    return f"{1000 * step:.0f} mm{note}, in the true motion {1000 * true_step:.0f} mm"


def _travel(futures: motion.Forecasts) -> str:
    """Return how far and how fast the root moves over the ground in futures, and in the true motion."""
    skeleton, frames, descriptions = futures.skeleton, futures.truth.shape[1], []
    level = [axis for axis in range(3) if axis != skeleton.vertical]
    for frames_after in (futures.forecasts[:, :, :frames], futures.truth[None]):
        path = np.insert(frames_after, 0, futures.observed[:, -1], 2)[..., skeleton.root, level]
        path = path[np.isfinite(path).all((2, 3))]
        distance = np.linalg.norm(path[:, -1] - path[:, 0], axis=-1)
        speed = skeleton.fps * np.linalg.norm(np.diff(path, axis=1), axis=-1)
        means = (each.mean() if len(path) else np.nan for each in (distance, speed))
        descriptions.append("{:.2f} m at {:.2f} m/s".format(*means))
    future, true = descriptions
    return f"the root travels {future}, in the true motion {true} (means over {frames} frames)"


def _follow_paths(
    run: runs.Loaded, windows: motion.Windows, paths: Paths, samples: int, seed: int, out: Path, figure: Path | None
) -> None:
    """Draw motions along given paths, from the first pose of one window, and write them."""
    if not isinstance(run.model, TrajectoryModel):
        raise UsageError(f"{run.path} is a fitted {run.method.name}, which takes no paths; fit a trajevae or cvae-rnn")
    if paths.exact and not (paths.joints or paths.paths):
        raise UsageError("--exact requires paths; give them with --joints or --paths")
    positions = windows.positions(windows.all().mask_to_nan()).numpy()
    index = _fastest_window(positions, paths.window)
    pose, truth = positions[index, 0], positions[index, 1:]
    path_by_joint = _given_paths(joint_names(paths.joints), truth, paths.paths, windows.skeleton)
    options: dict[str, Any] = {"exact": paths.exact, "temperature": paths.temperature, "progress": True}
    with seeded(seed):
        completion = run.model.complete(pose, path_by_joint, None if path_by_joint else len(truth), samples, **options)
    before_and_after = pose[None, None], truth[None, : completion.positions.shape[1]]
    emission = "drawn" if run.model.is_drawn() else "mean"
    motions = motion.Forecasts(
        windows.skeleton, [windows.keys[index]], completion.positions[:, None], *before_and_after, emission
    )
    motions.save(out)
    ERROR.print(f"wrote {out}: window {index}, {_title(motions)}")
    _save_futures(motions, figure, path_by_joint)
    OUT.print(str(completion))


def impute(
    run: Annotated[Path, tyro.conf.Positional],
    recovery: Recovery,
    out: Path | None = None,
    filled: Path | None = None,
    clip: str | None = None,
    samples: int | None = None,
    particles: Expert[int] = 1,
    draw_emission: Expert[bool | None] = None,
    seed: int = 0,
    data: str | None = None,
    missing: Expert[Missing] = False,
    use: Use = ON_CPU,
) -> None:
    """Draw missing values: joints of motion, entries of a table, or whole segments from parts of them.

    For motion, the npz of --out contains, in metres, `filled` (samples, windows, frames, joints, 3), `observed`
    (windows, frames, joints), and `spread`, the mean distance of the samples of a joint from their mean. It also
    contains `split`, `clip` and `start` of each window, the skeleton, and `emission`, which is "drawn" or "mean".
    --filled writes the motion itself, in world coordinates, with one filling of the missing joints of these windows.

    For a motion-latent run, recovers segments with their timing and bodies. `--from NAME --seen markers` tests this on
    known segments. --file reads observations: an npz of `times` (K,) in seconds or `frames` (K,) of 100, and any of
    `surfaces` (K, vertices, 3), `points` (K, any, 3) and `markers` (K, any, 3) in metres. Missing observations are NaN.
    The file contains `beta` (S,) if the body is known. Several segments have arrays (B, K, ...). Prints duration and
    distance with intervals, and the distance from the observations and, if known, from the truth. --out writes an npz
    of the most probable segments and posterior draws, or .html or .bvh for a single segment. A name without a suffix is
    a folder of BVH files.

    Args:
        run: run directory.
        recovery: options for motion-latent.
        out: file to write.
        filled: for motion: file of the filled motion, an npz of all clips, or BVH or csv of one clip; a name without a
            suffix is a folder of BVH files.
        clip: name of a clip of any split, filled as one window; split/name if the name is not unique.
        samples: number of fillings of each window; by default 10, 100 for a table, and 5 for segments.
        particles: for a table: number of draws for each filling, one of them resampled by weight.
        draw_emission: for motion: include the noise of the emission, or fill with its means given draws of the latents.
            By default --out has draws and --filled has means, unless the model has no latents.
        seed: seed of the draws.
        data: where the data are now, if the path in the run is no longer valid; or other data with the same variables.
    """
    kind = kind_of([run], data)
    at_least(1, particles=particles)
    at_least(0 if kind == "segments" else 1, samples=samples)
    check_files(out, None)
    options = {"filled": filled, "clip": clip, "draw-emission": draw_emission}
    inapplicable = [name for name, value in options.items() if value is not None]
    if kind == "segments":
        if inapplicable or particles > 1 or missing:
            raise UsageError(f"--{[*inapplicable, 'particles' if particles > 1 else 'missing'][0]} is not for segments")
        recovery.run(run, out, 5 if samples is None else samples, seed, data, use)
        return
    if recovery != Recovery():
        raise UsageError(f"--from, --file and --seen are for runs of motion-latent, and {run} is not one")
    loaded, data_set = forecaster(run, data, missing, use)
    if kind == "panel":
        if out is None or inapplicable:
            raise UsageError("for a table, impute writes draws to --out FILE.csv, .parquet or .npz")
        tables.impute(loaded, data_set, out, samples, particles, seed)
        return
    samples = samples or SAMPLES
    if particles > 1:
        raise UsageError("--particles applies to tables only; leave it out for motion")
    check_files(out, None, ".npz")
    if out is None and filled is None:
        raise UsageError("impute writes a file; name it with --out or --filled")
    file_format = None if filled is None else format_of(filled, None if filled.suffix else "bvh")
    windows, model = windows_of(data_set, clip, whole_clip=clip is not None), loaded.model
    if filled is not None and filled.suffix and file_format != "npz" and len(windows.clips) > 1:
        raise UsageError(
            f"--filled {filled} can contain one of {len(windows.clips)} clips; name it with --clip, or end the file in "
            ".npz"
        )
    if out is not None:
        imputed = _fillings(model, windows, samples, seed, model.is_drawn() if draw_emission is None else draw_emission)
        observed = imputed.observed
        imputed.save(out)
        spread = 1000 * imputed.spread[~observed].mean() if not observed.all() else 0.0
        ERROR.print(
            f"wrote {out}: {samples} fillings of each of {len(windows)} windows, in which {1 - observed.mean():.1%} of "
            f"the joints were missing; spread {spread:.0f} mm, {EMISSIONS[imputed.emission]}"
        )
    if filled is not None:
        is_drawn = model.is_drawn(means=True) if draw_emission is None else draw_emission
        imputed = _fillings(model, windows, 1, seed, is_drawn)
        clips = windows.fill_missing(torch.from_numpy(imputed.filled[0]))
        motion.write_motion(filled, clips, file_format)
        n_missing = sum(int(np.isnan(each.positions).any(-1).sum()) for each in clips)
        ERROR.print(
            f"wrote {filled}: {len(clips)} clips"
            + (f"; {n_missing} joints are missing in frames outside all windows" if n_missing else "")
        )


def _fillings(model: Any, windows: motion.Windows, samples: int, seed: int, is_drawn: bool) -> motion.Imputed:
    """Return motion with its missing joints filled in."""
    batch, parts = windows.all(), []
    with seeded(seed):
        for indices in torch.arange(len(windows)).split(64):
            values = model.impute(batch.rows(indices), samples, draw=is_drawn)["x"]
            parts.append(windows.positions(values.cpu()).numpy())
    observed = windows.skeleton.with_root(batch.mask().unflatten(-1, (-1, 3)), True)[..., 0].numpy()
    emission = "drawn" if is_drawn else "mean"
    return motion.Imputed(windows.skeleton, windows.keys, np.concatenate(parts, 1), observed, emission)


def _given_paths(joints: Sequence[str], truth: Any, paths: Path | None, skeleton: motion.Skeleton) -> dict[str, Any]:
    """Return the true paths of some joints, and the paths in a file for others, by joint.

    Raises:
        UsageError: a joint has both.
    """
    true_paths = {joint: truth[:, skeleton.find(joint)] for joint in joints}
    from_file = {} if paths is None else motion.read_paths(paths)
    if repeated := set(map(skeleton.find, true_paths)) & set(map(skeleton.find, from_file)):
        names = ", ".join(skeleton.names[joint] for joint in repeated)
        raise UsageError(f"{names}: both --joints and {paths} give a path; leave one out")
    return true_paths | from_file


def animate(
    source: Annotated[str, tyro.conf.Positional],
    out: Path,
    clip: str | None = None,
    window: int | None = None,
    samples: int | None = None,
    fix: Expert[tuple[str, ...]] = (),
    seed: int = 0,
    data: str | None = None,
    missing: Expert[Missing] = False,
    use: Use = ON_CPU,
    every: Expert[int | None] = None,
    figure: Path | None = None,
) -> None:
    """Play forecasts next to the true future, or a clip, as moving skeletons.

    The page is a single file that any browser shows without a network. Skeletons play, and turn with the mouse, a
    finger or the arrow keys.

    Args:
        source: run directory, file written by `dvae forecast`, motion file, or "simulated".
        out: html file to write.
        clip: name of a clip, or split/name if the name is not unique. Without it, futures are of any test window, and a
            motion file shows its first clip.
        window: number of the window of futures, from 0; by default the one that moves most.
        samples: number of futures side by side; by default 5, or all in the file if fewer.
        fix: parts of the body, such as lower, or static latents, that all futures of a run share.
        seed: seed of the draws of a run.
        data: where the data of a run are now, if its path is no longer valid; or other data with the same variables.
        every: show every n-th frame; by default about 25 frames per second are shown.
        figure: also save a figure of the futures.
    """
    at_least(1, samples=samples, every=every)
    at_least(0, window=window)
    check_files(out, figure, ".html", ".htm")
    if Path(source).is_dir():
        if not Run(source).exists:
            raise ValueError(
                f"{source} is a folder but not a run directory; name a run, or a motion file such as {source}/FILE.bvh"
            )
        loaded = load_run(Path(source), data, use=use)
        windows = windows_of(data_of(data, loaded, missing=missing), clip)
        index = _fastest_window(windows.positions(windows.all().mask_to_nan()).numpy(), window)
        futures = draw_futures(loaded, windows, [index], samples or 5, seed, fix=fix)
    elif fix:
        raise UsageError(f"--fix is for futures drawn from a run; {source} is not a run directory; leave it out")
    elif data is not None:
        raise UsageError(f"--data is the path of the data of a run; {source} is not a run directory; leave it out")
    elif use != ON_CPU:
        raise UsageError(f"--failed and --accelerator are for runs; {source} is not a run directory; leave them out")
    elif source != SIMULATED and motion.is_forecasts(source):
        index, futures = _load_window(source, clip, window, samples)
    elif window is not None or samples is not None or figure is not None:
        raise UsageError(f"--window, --samples and --figure are for futures; {source} has none; leave them out")
    else:
        _play_clip(source, clip, missing, every, out)
        return
    frames = futures.observed[0], futures.forecasts[:, 0], futures.truth[0]
    _play(out, futures.skeleton, *frames, fixed=_fixed_joints(futures), every=every, title=_title(futures))
    ERROR.print(f"wrote {out}: window {index}, {_title(futures)}")
    _save_futures(futures, figure)


def _load_window(
    source: str, clip: str | None, window: int | None, samples: int | None
) -> tuple[int, motion.Forecasts]:
    """Return the index and the forecasts of one window of a clip in a file of forecasts."""
    stored = motion.Forecasts.load(source)
    indices = [n for n, key in enumerate(stored.keys) if clip in (None, key[1], f"{key[0]}/{key[1]}")]
    if not indices:
        raise ValueError(f"{source} has no window of a clip {clip!r}; name one of its clips")
    if samples is not None and samples > len(stored.forecasts):
        raise UsageError(f"--samples {samples}: {source} has only {len(stored.forecasts)} futures of each window")
    index = _fastest_window(np.concatenate([stored.observed, stored.truth], 1)[indices], window)
    return index, stored.window(indices[index], samples or 5)


def _play_clip(source: str, name: str | None, missing: bool, every: int | None, out: Path) -> None:
    clips = motion.simulate() if source == SIMULATED else motion.read_motion(source, missing=missing)
    clip = clips.clips[0] if name is None else _clip(clips, name)
    _play(out, clips.skeleton, clip.positions, every=every, title="/".join(clip.key))
    ERROR.print(f"wrote {out}: {'/'.join(clip.key)}, {clip.frames} frames")


def _play(out: Path, *motions: Any, **options: Any) -> None:
    from ..motion.drawing.player import animate

    animate(*motions, **options).save(out)


def joint_names(texts: Sequence[str]) -> list[str]:
    """Return names of joints that are separated by commas or blanks."""
    return [name for text in texts for name in text.replace(",", " ").split()]


def _clip(clips: motion.MotionSet, name: str) -> motion.Clip:
    matches = [clip for clip in clips if name in (clip.name, f"{clip.split}/{clip.name}")]
    if not matches:
        suggestion = nearest(
            name, [candidate for clip in clips for candidate in (clip.name, f"{clip.split}/{clip.name}")]
        )
        raise ValueError(f"no clip {name!r}{suggestion} in {clips.name}; `dvae data info` lists the clips")
    if len(matches) > 1:
        keys = " or ".join("/".join(clip.key) for clip in matches)
        raise ValueError(f"{name!r} is the name of {len(matches)} clips; give {keys}")
    return matches[0]


def windows_of(data_set: Any, clip: str | None, whole_clip: bool = False) -> motion.Windows:
    """Return the test windows of data.

    Args:
        data_set: data of a run, or other data.
        clip: name of a clip of any split, whose windows are returned instead.
        whole_clip: whether to return the whole clip as one window.
    """
    if clip is None:
        return data_set.windows("test")  # type: ignore[no-any-return]
    selected, motion_set = _clip(data_set.motion, clip), data_set.motion
    subset = motion.MotionSet([selected], motion_set.skeleton, data_set.path, missing=motion_set.missing)
    protocol = replace(data_set.protocol, split_by="split", test=tuple(subset.splits), train=())
    return motion.windows(subset, protocol, "test", selected.frames if whole_clip else None)


def draw_futures(
    run: runs.Loaded,
    windows: motion.Windows,
    indices: Sequence[int],
    samples: int,
    seed: int,
    horizon: int | None = None,
    fix: Sequence[str] = (),
    draw_emission: bool | None = None,
) -> motion.Forecasts:
    """Return futures of the chosen windows, by default with means of the emission if the model has latents.

    All futures of a window share one draw of the parts or latents in `fix`.

    Raises:
        UsageError: `fix` names something that the model cannot fix.
    """
    model = run.model
    is_drawn = model.is_drawn(means=True) if draw_emission is None else draw_emission
    free = {*(model.view.parts or ()), *(name for name in model.latents if not model.generative.local(name))}
    if unknown := [name for name in fix if name not in free]:
        raise UsageError(
            f"--fix {' '.join(unknown)}: {run.path} has "
            + (f"{', '.join(sorted(free))} to fix" if free else "nothing to fix, no parts and no static latents")
        )
    observed, horizon = run.schema.protocol.observed, horizon or run.schema.protocol.predicted
    keys = windows.keys
    batch = windows.all().rows(list(indices))
    past, future = batch.past(observed), batch.mask_to_nan()[:, observed:][:, :horizon]
    with seeded(seed):
        n_frames = max(horizon, run.schema.protocol.predicted) if fix else horizon  # a part is fixed at all frames
        parts = []
        for past_part in Sequences(past).batches(64):
            shared = model.forecast(past_part, n_frames, 1, draw_emission=is_drawn) if fix else {}
            fixed = {"fix": {name: shared[name][0] for name in fix}} if fix else {}
            values = model.forecast(past_part, n_frames, samples, draw_emission=is_drawn, **fixed)["x"][:, :, :horizon]
            parts.append(windows.positions(values.cpu()).numpy())
            del values  # with many samples, the largest object here
    observed_frames, truth = (windows.positions(x).numpy() for x in (past.mask_to_nan(), future))
    forecasts, emission = np.concatenate(parts, axis=1), "drawn" if is_drawn else "mean"
    return motion.Forecasts(windows.skeleton, [keys[n] for n in indices], forecasts, observed_frames, truth, emission)


def _in_world(futures: motion.Forecasts, windows: motion.Windows, indices: Sequence[int]) -> motion.Forecasts:
    """Return futures in world coordinates, with the position, height and heading of their clips."""
    names = ("forecasts", "observed", "truth")
    arrays: dict[str, Any] = {
        n: windows.to_world(torch.from_numpy(getattr(futures, n)), list(indices)).numpy() for n in names
    }
    return replace(futures, **arrays)


def _fixed_joints(futures: motion.Forecasts) -> list[int]:
    """Return the joints, except the root, that are identical in all futures of the first window, if it has several."""
    sampled = futures.forecasts[:, 0]
    alike = (sampled == sampled[:1]).all((0, 1, 3)) & (len(sampled) > 1)
    return [joint for joint in np.flatnonzero(alike).tolist() if joint != futures.skeleton.root]


def _fastest_window(positions: np.ndarray, window: int | None) -> int:
    """Return the given window, or the window of `positions` (N, T, J, 3) with the fastest joints.

    Raises:
        UsageError: there are fewer windows.
    """
    if window is None:
        speeds = np.ma.masked_invalid(np.linalg.norm(np.diff(positions, axis=1), axis=-1))
        return int(speeds.mean((1, 2)).filled(0.0).argmax())
    if window >= len(positions):
        raise UsageError(f"--window is {window}; it must be from 0 to {len(positions) - 1}")
    return window


def _title(futures: motion.Forecasts) -> str:
    split, clip, start = futures.keys[0]
    count = len(futures.forecasts)
    return f"{split}/{clip} from frame {start}: {count} futures, {EMISSIONS[futures.emission]}{_blended(futures)}"


def _blended(futures: motion.Forecasts) -> str:
    """Return a label of blended futures, "" for others."""
    return f", first {futures.blend} frames blended with the observed ones" if futures.blend else ""


@styled
def _save_futures(futures: motion.Forecasts, path: Path | None, paths: Mapping[str, Any] | None = None) -> None:
    """Save a figure of the first window's futures and of the given paths, if `path` is not None."""
    if path is None:
        return
    from ..motion.drawing.plot import futures as draw

    drawing = new_figure(7, 2.2)
    window = futures.observed[0], futures.forecasts[:, 0], futures.truth[0]
    axes = draw(futures.skeleton, *window, ax=drawing.subplots(), paths=paths)
    axes.set_title(_title(futures), parse_math=False)
    save_figure(drawing, path)
