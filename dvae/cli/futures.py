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
from ..inference.training.checkpoints import Run
from ..models.motion.trajectories import TrajectoryModel
from ..motion.data.dataset import SIMULATED
from ..motion.files.writing import format_of
from ..options import nearest
from ..runs import directory as runs
from ..turns import seeded
from . import tables
from .console import ERROR, OUT, Failed, Missing, UsageError, at_least, check_files, save_figure
from .help import Expert
from .opening import data_of, forecaster, kind_of, load_run
from .segments import Recovery

SAMPLES = 10
"""Futures and fillings of motion where nobody says how many."""
EMISSIONS = {"drawn": "draws of the emission", "mean": "means of the emission", "": "draws or means of the emission"}
"""What the emission of futures is called."""


@dataclass(frozen=True)
class Paths:
    """Paths to follow, for methods that take trajectories (trajevae, cvae-rnn, motion-infilling).

    Args:
        joints: joints that follow their own paths in the window.
        paths: file of paths: an npz of one array (frames, 3) for each joint, or a csv with columns such as LWrist_x,
            LWrist_y, LWrist_z and one row for each frame, in metres from the pelvis of the first pose; empty or nan
            where a path is not known.
        window: number of the window whose first pose motions start from, from 0; by default the one that moves most.
        exact: put the given joints on their paths with bones at their lengths, by optimising the motions' latents and
            then their poses; not for motion-infilling, which has no latents.
        temperature: factor of the scale of the latents; 0 for the motion of the prior's mean.
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
    failed: Expert[Failed] = False,
    figure: Path | None = None,
    beyond: bool = False,
) -> None:
    """Forecast the test windows, or those of one clip or sequence, many times each.

    Of a table, a CSV or Parquet file gets a row for each window, step and column, with mean and quantiles, and an npz
    the draws; --figure draws their fans.

    Of motion, an npz holds, in metres, `forecasts` (samples, windows, horizon, joints, 3), `observed` and `truth`
    (windows, frames, joints, 3), NaN where a joint was missing, `split`, `clip` and `start` of each window, the
    skeleton, and `emission`: whether futures are "drawn" or "mean". `dvae animate` plays it, and
    `dvae.motion.Forecasts.load` reads it. A name that ends in .bvh gets the first future of the window that moves most;
    a name without an ending is a new folder with a BVH file for every window and future. BVH files hold the observed
    frames and then the future, at the place of the clip if the protocol keeps the root's path.

    With --joints or --paths, motions start at the first pose of one window and follow these paths.

    Args:
        run: the run directory.
        out: the file or folder to write.
        along: paths of joints.
        clip: name of a clip, or split/name where the name is not unique; of a table, of a sequence; of any split.
        horizon: frames to forecast; by default those of the protocol.
        samples: number of forecasts of each window; by default 10, and 100 of a table, whose quantiles are written.
        fix: parts of the body, such as lower, or static latents, that all forecasts of a window share.
        draw_emission: of motion: futures with the noise of the emission, or its means given draws of the latents. By
            default draws in an npz, and means in BVH, unless the model has no latents.
        seed: seed of the draws.
        data: where the data are now, if the path in the run is no longer valid; or other data of the same joints.
        figure: save a figure of the first window's futures.
        beyond: of a table: forecast what comes after its last row with a target, from later rows with known covariates.
    """
    at_least(1, samples=samples, horizon=horizon)
    at_least(0, window=along.window)
    check_files(out, figure)
    loaded, opened = forecaster(run, data, missing, failed)
    if loaded.config.kind == "panel":
        of_motion = {"fix": bool(fix), "missing": missing, "draw-emission": draw_emission is not None}
        of_motion |= {name: value != getattr(Paths, name) for name, value in vars(along).items()}
        if given := [name for name, is_given in of_motion.items() if is_given]:
            raise UsageError(f"--{given[0]} is about motion, and {run} is of a table")
        tables.forecast(loaded, opened, out, clip, horizon, samples, seed, figure, beyond)
        return
    if beyond:
        raise UsageError(f"--beyond is about tables, and {run} is of motion")
    windows, samples = windows_of(opened, clip), samples or SAMPLES
    if along != Paths():
        check_files(out, figure, ".npz")
        if horizon or fix or draw_emission is not None:
            raise UsageError("--horizon, --fix and --draw-emission do not apply to motion along --joints or --paths")
        _completed(loaded, windows, along, samples, seed, out, figure)
        return
    suffix = out.suffix.lower()
    check_files(out, figure, ".npz", ".bvh", "")
    chosen: Sequence[int] = range(len(windows))
    if suffix == ".bvh":
        chosen = [_liveliest(windows.positions(windows.all().mask_to_nan()).numpy(), None)]
    if draw_emission is None and suffix == ".npz":
        draw_emission = loaded.model.is_drawn()
    futures = draw_futures(loaded, windows, chosen, samples, seed, horizon, fix, draw_emission)
    after, protocol = "", windows.protocol
    if suffix == ".npz":
        futures.save(out)
    else:
        played = futures.window(0, 1) if suffix else futures
        motion.write_motion(
            out, (played if protocol.root == "drop" else _in_world(played, windows, chosen)).motion(), "bvh"
        )
        after = f", after {futures.observed.shape[1]} observed frames"
    frames = futures.forecasts.shape[2]
    said = f"the first of {samples} futures" if suffix == ".bvh" else f"{samples} futures"
    dropped = f"; relative to the root: the protocol {protocol.name} removes the root's path"
    ERROR.print(
        f"wrote {out}: {said} of {frames} frames for each of {len(chosen)} windows{after}, "
        f"{EMISSIONS[futures.emission]}{dropped if protocol.root == 'drop' else ''}"
    )
    _save_futures(futures, figure)


def _completed(
    loaded: runs.Loaded, windows: motion.Windows, paths: Paths, samples: int, seed: int, out: Path, figure: Path | None
) -> None:
    """Draw motions along given paths, from the first pose of one window, and write them."""
    if not isinstance(loaded.model, TrajectoryModel):
        raise UsageError(f"{loaded.path} holds {loaded.method.name}, which takes no paths; fit a trajevae or cvae-rnn")
    if paths.exact and not (paths.joints or paths.paths):
        raise UsageError("--exact requires paths; give them by --joints or --paths")
    positions = windows.positions(windows.all().mask_to_nan()).numpy()
    chosen = _liveliest(positions, paths.window)
    pose, truth = positions[chosen, 0], positions[chosen, 1:]
    given = _told(joint_names(paths.joints), truth, paths.paths, windows.skeleton)
    how: dict[str, Any] = {"exact": paths.exact, "temperature": paths.temperature, "progress": True}
    with seeded(seed):
        done = loaded.model.complete(pose, given, None if given else len(truth), samples, **how)
    before_and_after = pose[None, None], truth[None, : done.positions.shape[1]]
    motions = motion.Forecasts(
        windows.skeleton, [windows.keys[chosen]], done.positions[:, None], *before_and_after, "mean"
    )
    motions.save(out)
    ERROR.print(f"wrote {out}: window {chosen}, {_title(motions)}")
    _save_futures(motions, figure, given)
    OUT.print(str(done))


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
    failed: Expert[Failed] = False,
) -> None:
    """Draw what is missing: joints of motion, entries of a table, or whole segments from parts of them.

    Of motion, the npz of --out holds, in metres, `filled` (samples, windows, frames, joints, 3), `observed` (windows,
    frames, joints), `spread`, the mean distance of the samples of a joint from their mean; `split`, `clip` and `start`
    of each window, the skeleton, and `emission`: whether fillings are "drawn" or "mean". --filled is the motion itself,
    in the world, with the missing joints of these windows filled once.

    Of a motion-latent run, segments are recovered with their timing and bodies, either known ones (--from NAME --seen
    markers), to see how well that works, or from a --file: an npz of `times` (K,) in seconds or `frames` (K,) of 100,
    and some of `surfaces` (K, vertices, 3), `points` (K, any, 3) and `markers` (K, 16, 3) in metres, NaN where nothing
    was seen; `beta` (S,) where the body is known; or (B, K, ...) of several segments. Prints duration and distance with
    intervals, the distance from what was seen and, where known, from the truth. --out is an npz of the most probable
    segments and posterior draws; of one segment also .html or .bvh; a name without an ending is a folder of BVH files.

    Args:
        run: the run directory.
        recovery: options for motion-latent.
        out: the file to write.
        filled: of motion: file of the filled motion, an npz of all clips, BVH or csv of one; a name without an ending
            is a folder of BVH files.
        clip: name of a clip, or split/name where the name is not unique; of any split, filled as one window.
        samples: number of fillings of each window; by default 10, 100 of a table, and 5 of segments.
        particles: of a table: number of draws for each filling, of which one is resampled by its weight.
        draw_emission: of motion: fill with the noise of the emission, or with its means given draws of the latents. By
            default draws in --out, and means in --filled, unless the model has no latents.
        seed: seed of the draws.
        data: where the data are now, if the path in the run is no longer valid; or other data of the same joints.
    """
    kind = kind_of([run], data)
    at_least(1, particles=particles)
    at_least(0 if kind == "segments" else 1, samples=samples)
    check_files(out, None)
    options = {"filled": filled, "clip": clip, "draw-emission": draw_emission}
    given = [name for name, value in options.items() if value is not None]
    if kind == "segments":
        if given or particles > 1 or missing:
            raise UsageError(f"--{[*given, 'particles' if particles > 1 else 'missing'][0]} is not for segments")
        recovery.run(run, out, 5 if samples is None else samples, seed, data, failed)
        return
    if recovery != Recovery():
        raise UsageError(f"--from, --file and --seen are for runs of motion-latent, and {run} is not one")
    loaded, opened = forecaster(run, data, missing, failed)
    if kind == "panel":
        if out is None or given:
            raise UsageError("of a table, impute writes draws to --out FILE.csv, .parquet or .npz")
        tables.impute(loaded, opened, out, samples, particles, seed)
        return
    samples = samples or SAMPLES
    if particles > 1:
        raise UsageError("--particles chooses among fillings of tables; leave it out for motion")
    check_files(out, None, ".npz")
    if out is None and filled is None:
        raise UsageError("impute writes files; say which, by --out or --filled")
    form = None if filled is None else format_of(filled, None if filled.suffix else "bvh")
    windows, model = windows_of(opened, clip, whole=clip is not None), loaded.model
    if filled is not None and filled.suffix and form != "npz" and len(windows.clips) > 1:
        raise UsageError(
            f"--filled {filled} holds one clip, of {len(windows.clips)}; say which by --clip, or end it in .npz"
        )
    if out is not None:
        found = _fillings(model, windows, samples, seed, model.is_drawn() if draw_emission is None else draw_emission)
        seen = found.observed
        found.save(out)
        spread = 1000 * found.spread[~seen].mean() if not seen.all() else 0.0
        ERROR.print(
            f"wrote {out}: {samples} fillings of each of {len(windows)} windows, which lacked {1 - seen.mean():.1%} of "
            f"their joints; they spread by {spread:.0f} mm, {EMISSIONS[found.emission]}"
        )
    if filled is not None:
        drawn = model.is_drawn(means=True) if draw_emission is None else draw_emission
        found = _fillings(model, windows, 1, seed, drawn)
        whole = windows.filled(torch.from_numpy(found.filled[0]))
        motion.write_motion(filled, whole, form)
        left = sum(int(np.isnan(each.positions).any(-1).sum()) for each in whole)
        ERROR.print(
            f"wrote {filled}: {len(whole)} clips"
            + (f"; {left} joints are missing in frames of no window" if left else "")
        )


def _fillings(model: Any, windows: motion.Windows, samples: int, seed: int, drawn: bool) -> motion.Imputed:
    """Motion with its missing joints filled in."""
    listed, parts = windows.all(), []
    with seeded(seed):
        for some in torch.arange(len(windows)).split(64):
            made = model.impute(listed.rows(some), samples, draw=drawn)["x"]
            parts.append(windows.positions(made).numpy())
    seen = windows.skeleton.with_root(listed.mask().unflatten(-1, (-1, 3)), True)[..., 0].numpy()
    emission = "drawn" if drawn else "mean"
    return motion.Imputed(windows.skeleton, windows.keys, np.concatenate(parts, 1), seen, emission)


def _told(joints: Sequence[str], truth: Any, paths: Path | None, skeleton: motion.Skeleton) -> dict[str, Any]:
    """Paths by joint: the true ones of some joints, and those of a file, of other joints."""
    given = {joint: truth[:, skeleton.find(joint)] for joint in joints}
    drawn = {} if paths is None else motion.read_paths(paths)
    if twice := set(map(skeleton.find, given)) & set(map(skeleton.find, drawn)):
        names = ", ".join(skeleton.names[joint] for joint in twice)
        raise UsageError(f"{names} is named by --joints, and {paths} has a path of it; say which by leaving one out")
    return given | drawn


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
    failed: Expert[Failed] = False,
    every: Expert[int | None] = None,
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
        data: where a run's data lie now, if its path no longer leads there; or other data of the same joints.
        every: frames from one that is shown to the next; by default about 25 a second are shown.
        figure: save a figure of the futures, too.
    """
    at_least(1, samples=samples, every=every)
    at_least(0, window=window)
    check_files(out, figure, ".html", ".htm")
    if Path(source).is_dir():
        if not Run(source).exists:
            raise ValueError(
                f"{source} is a folder, and is no run directory; name a run, or one motion file, such as "
                f"{source}/FILE.bvh"
            )
        loaded = load_run(Path(source), data, failed=failed)
        windows = windows_of(data_of(data, loaded, missing=missing), clip)
        chosen = _liveliest(windows.positions(windows.all().mask_to_nan()).numpy(), window)
        futures = draw_futures(loaded, windows, [chosen], samples or 5, seed, fix=fix)
    elif fix:
        raise UsageError(f"--fix is about the futures that a run draws; {source} is no run directory")
    elif data is not None:
        raise UsageError(f"--data tells where the data of a run lie; {source} is no run directory")
    elif source != SIMULATED and motion.is_forecasts(source):
        chosen, futures = _stored(source, clip, window, samples)
    elif window is not None or samples is not None or figure is not None:
        raise UsageError(f"--window, --samples and --figure are about futures; {source} has none")
    else:
        _play_clip(source, clip, missing, every, out)
        return
    now = futures.observed[0], futures.forecasts[:, 0], futures.truth[0]
    _play(out, futures.skeleton, *now, fixed=_alike(futures), every=every, title=_title(futures))
    ERROR.print(f"wrote {out}: window {chosen}, {_title(futures)}")
    _save_futures(futures, figure)


def _stored(source: str, clip: str | None, window: int | None, samples: int | None) -> tuple[int, motion.Forecasts]:
    """A window of a file of forecasts, and which of those of the clip it is."""
    stored = motion.Forecasts.load(source)
    known = [n for n, key in enumerate(stored.keys) if clip in (None, key[1], f"{key[0]}/{key[1]}")]
    if not known:
        raise ValueError(f"{source} has no window of a clip {clip!r}")
    if samples is not None and samples > len(stored.forecasts):
        raise UsageError(f"--samples {samples}: {source} has {len(stored.forecasts)} of each window")
    chosen = _liveliest(np.concatenate([stored.observed, stored.truth], 1)[known], window)
    return chosen, stored.window(known[chosen], samples or 5)


def _play_clip(source: str, name: str | None, missing: bool, every: int | None, out: Path) -> None:
    clips = motion.simulate() if source == SIMULATED else motion.read_motion(source, missing=missing)
    clip = clips.clips[0] if name is None else _clip(clips, name)
    _play(out, clips.skeleton, clip.positions, every=every, title="/".join(clip.key))
    ERROR.print(f"wrote {out}: {'/'.join(clip.key)}, {clip.frames} frames")


def _play(out: Path, *motions: Any, **options: Any) -> None:
    from ..motion.drawing.player import animate

    animate(*motions, **options).save(out)


def joint_names(given: Sequence[str]) -> list[str]:
    """Names of joints, with commas or blanks between them."""
    return [name for text in given for name in text.replace(",", " ").split()]


def _clip(clips: motion.MotionSet, name: str) -> motion.Clip:
    found = [clip for clip in clips if name in (clip.name, f"{clip.split}/{clip.name}")]
    if not found:
        meant = nearest(name, [known for clip in clips for known in (clip.name, f"{clip.split}/{clip.name}")])
        raise ValueError(f"no clip {name!r}{meant} in {clips.name}; `dvae data info` tells what is there")
    if len(found) > 1:
        keys = " or ".join("/".join(clip.key) for clip in found)
        raise ValueError(f"{name!r} is the name of {len(found)} clips; say {keys}")
    return found[0]


def windows_of(opened: Any, clip: str | None, whole: bool = False) -> motion.Windows:
    """The test windows of data, or all windows of one clip, of any split; or one window of the whole clip."""
    if clip is None:
        return opened.windows("test")  # type: ignore[no-any-return]
    found, own = _clip(opened.motion, clip), opened.motion
    chosen = motion.MotionSet([found], own.skeleton, opened.path, missing=own.missing)
    anywhere = replace(opened.protocol, split_by="split", test=tuple(chosen.splits), train=())
    return motion.windows(chosen, anywhere, "test", found.frames if whole else None)


def draw_futures(
    loaded: runs.Loaded,
    windows: motion.Windows,
    chosen: Sequence[int],
    samples: int,
    seed: int,
    horizon: int | None = None,
    fix: Sequence[str] = (),
    draw_emission: bool | None = None,
) -> motion.Forecasts:
    """Futures of some of the windows; those of a window share one draw of what is fixed. To be shown, by default."""
    model = loaded.model
    drawn = model.is_drawn(means=True) if draw_emission is None else draw_emission
    free = {*(model.view.parts or ()), *(name for name in model.latents if not model.generative.local(name))}
    if unknown := [name for name in fix if name not in free]:
        raise UsageError(
            f"--fix {' '.join(unknown)}: {loaded.path} has "
            + (f"{', '.join(sorted(free))} to fix" if free else "nothing to fix, no parts and no static latents")
        )
    observed, horizon = loaded.schema.protocol.observed, horizon or loaded.schema.protocol.predicted
    keys = windows.keys
    some = windows.all().rows(list(chosen))
    past, future = some.past(observed), some.mask_to_nan()[:, observed:][:, :horizon]
    with seeded(seed):
        whole = max(horizon, loaded.schema.protocol.predicted) if fix else horizon  # parts are fixed as a whole
        parts = []
        for given in Sequences(past).batches(64):
            once = model.forecast(given, whole, 1, draw_emission=drawn) if fix else {}
            held = {"fix": {name: once[name][0] for name in fix}} if fix else {}
            made = model.forecast(given, whole, samples, draw_emission=drawn, **held)["x"][:, :, :horizon]
            parts.append(windows.positions(made).numpy())
            del made  # with many samples the largest thing here
    observed_frames, truth = (windows.positions(x).numpy() for x in (past.mask_to_nan(), future))
    forecasts, emission = np.concatenate(parts, axis=1), "drawn" if drawn else "mean"
    return motion.Forecasts(windows.skeleton, [keys[n] for n in chosen], forecasts, observed_frames, truth, emission)


def _in_world(futures: motion.Forecasts, windows: motion.Windows, chosen: Sequence[int]) -> motion.Forecasts:
    """Futures of some of the windows, at the place and height and in the direction that their clips have."""
    names = ("forecasts", "observed", "truth")
    placed: dict[str, Any] = {
        n: windows.to_world(torch.from_numpy(getattr(futures, n)), list(chosen)).numpy() for n in names
    }
    return replace(futures, **placed)


def _alike(futures: motion.Forecasts) -> list[int]:
    """The joints but the root that move alike in all futures of the first window, where there are several."""
    sampled = futures.forecasts[:, 0]
    alike = (sampled == sampled[:1]).all((0, 1, 3)) & (len(sampled) > 1)
    return [joint for joint in np.flatnonzero(alike).tolist() if joint != futures.skeleton.root]


def _liveliest(positions: np.ndarray, window: int | None) -> int:
    """The window that was asked for, or the one of (N, T, J, 3) whose joints move fastest."""
    if window is None:
        speeds = np.ma.masked_invalid(np.linalg.norm(np.diff(positions, axis=1), axis=-1))
        return int(speeds.mean((1, 2)).filled(0.0).argmax())
    if window >= len(positions):
        raise UsageError(f"--window {window}: they go from 0 to {len(positions) - 1}")
    return window


def _title(futures: motion.Forecasts) -> str:
    split, clip, start = futures.keys[0]
    return f"{split}/{clip} from frame {start}: {len(futures.forecasts)} futures, {EMISSIONS[futures.emission]}"


def _save_futures(futures: motion.Forecasts, path: Path | None, paths: Mapping[str, Any] | None = None) -> None:
    """A figure of the first window's futures, and of the paths that joints were given, if it is asked for."""
    if path is None:
        return
    from matplotlib.figure import Figure

    from ..motion.drawing.plot import futures as draw

    drawing = Figure(figsize=(9, 2.6), layout="constrained")
    window = futures.observed[0], futures.forecasts[:, 0], futures.truth[0]
    axes = draw(futures.skeleton, *window, ax=drawing.subplots(), paths=paths)
    axes.set_title(_title(futures), fontsize=9, parse_math=False)
    save_figure(drawing, path)
