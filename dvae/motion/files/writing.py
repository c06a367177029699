"""Write motion in all supported formats, as one file or as a folder with one file per clip."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ... import files
from ...data.sequences import tensor_of
from ...inference.evaluation.result import progress_bar
from ..data.clips import Clip, MotionSet, extents
from ..geometry.kinematics import forward
from ..geometry.rotations import to_matrix
from ..geometry.skeleton import Skeleton, brief
from .arrays import LABELS, SKELETON, own_companion, save, save_clips, write_labels, write_table
from .bvh import write_bvh
from .reading import REST_POSES, Collected, File, FileReader, find_files, joined_motion, read_motion, rotate_up, sampled
from .recording import Recording
from .smpl import write_amass
from .world import infer_world

DEVIATION = 0.01
"""Largest distance in metres by which rotations may move a joint without a warning."""
FORMATS = {"npz": ".npz", "bvh": ".bvh", "csv": ".csv", "amass": ".npz"}
"""Formats and their file name endings. Only `npz` stores many clips in one file."""


def format_of(path: str | Path, format: str | None = None) -> str:
    """Return the output format of a path: the given one, or the one of the file name ending.

    Raises:
        ValueError: the format is unknown, or it contradicts the ending.
    """
    suffix = Path(path).suffix.lower()
    if format is None:
        format = suffix.removeprefix(".")
    if format not in FORMATS or suffix not in ("", FORMATS[format]):
        raise ValueError(
            f"{path}: the format is unknown or contradicts the ending. The formats are {', '.join(FORMATS)}: end the "
            f"name in one of {', '.join(dict.fromkeys(FORMATS.values()))}, or give the format of the files in a folder "
            "(`--format` of `dvae data convert`, `format=` in Python)"
        )
    if format == "npz" and not suffix:
        raise ValueError(f"{path}: an npz holds all clips in one file; end its name in .npz")
    return format


def write_motion(path: str | Path, motion: MotionSet, format: str | None = None) -> list[Path]:
    """Write motion for other programs: as npz, BVH, csv or in AMASS's layout.

    BVH uses centimetres and y up, and one rigid body per clip. Missing rotations are estimated by
    `MotionSet.with_rotations`, and bones have their mean lengths in the clip. A folder also gets labels.csv if clips
    have labels. If one clip cannot be written, nothing is written.

    Args:
        path: a file; or a folder (a path without ending), which gets one file "split/clip" per clip.
        motion: clips; exactly one if the format stores one clip per file and the path is a file.
        format: one of `FORMATS`; default: the ending of the file name.

    Returns:
        The files that were written.

    Raises:
        ValueError: the format is unknown, a file for one clip would get several, a clip name leads out of the folder,
            or joints are missing in a format of rotations.
        OSError: a file cannot be written.

    Warns:
        UserWarning: rotations and bones of constant length place a joint more than a centimetre from its position.
    """
    path, format = Path(path), format_of(path, format)
    if format == "npz":
        save(path, motion)
        return [path]
    if path.suffix and len(motion) > 1:
        raise ValueError(
            f"{path}: {format} stores one clip per file, but there are {len(motion)}; give a folder (without an "
            "ending) and the format"
        )
    with _staged(path) as stage:
        moved = {
            "/".join(clip.key): write_clip(_path_of(stage, clip, format), replace(motion, clips=[clip]), format)
            for clip in motion
        }
        if not path.suffix:
            write_labels(stage / LABELS, motion, path / LABELS)
    if note := _note_of_deviations(moved, format):
        warnings.warn(note, stacklevel=2)
    return [_path_of(path, clip, format) for clip in motion]


@contextmanager
def _staged(out: Path) -> Iterator[Path]:
    """Yield a temporary path for a file or folder; its files are moved to their final place once all are complete."""
    folder = out.parent if out.suffix else out
    with files.create_folder(folder):
        files.remove_leftovers(folder)
        with TemporaryDirectory(prefix=files.temporary(), dir=folder, ignore_cleanup_errors=True) as name:
            stage = Path(name)
            with files.with_path(folder, stage):
                yield stage / out.name if out.suffix else stage
                for file in [file for file in stage.rglob("*") if file.is_file()]:
                    target = folder / file.relative_to(stage)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    file.replace(target)


def write_clip(path: Path, motion: MotionSet, format: str) -> float:
    """Write a set with one clip, with rotations if the format has them.

    Returns:
        Largest distance in metres between a joint and its place by rotations and bones; 0 in a format of positions.
    """
    clip, skeleton = motion.clips[0], motion.skeleton
    if format == "csv":
        write_table(path, skeleton.names, clip.positions)
        skeleton.to_json(own_companion(path, SKELETON))
        return 0.0
    if np.isnan(clip.positions).any():
        raise ValueError(
            f"clip {brief('/'.join(clip.key))} has missing joints, which {format} cannot represent; fill them in first "
            "(`dvae impute RUN --filled FILE`), or write npz or csv, where they are NaN"
        )
    rotated = motion.with_rotations()
    clip, skeleton = rotated.clips[0], rotated.skeleton
    rotations, positions = to_matrix(tensor_of(clip.rotations).double(), "quaternion"), tensor_of(clip.positions)
    placed, _ = forward(skeleton.parents, rotations, skeleton.offsets.double(), positions[:, skeleton.root].double())
    moved = float((placed - positions).norm(dim=-1).max())
    if format == "amass":
        write_amass(path, clip, skeleton)
        return moved
    recording = Recording(skeleton.names, skeleton.parents, clip.positions, clip.rotations, up=skeleton.up)
    if skeleton.up != "y":  # animation programs expect y up
        recording = rotate_up(recording, "y")
    assert recording.rotations is not None
    names: list[str] = []
    for name in skeleton.names:
        cleaned = re.sub(r"[\s{}]+", "_", name)
        names.append(cleaned + "_" * next(n for n in count() if cleaned + "_" * n not in names))
    root = recording.positions[:, skeleton.root]
    offsets = skeleton.offsets.numpy()
    write_bvh(path, names, list(skeleton.parents), offsets, recording.rotations, root, skeleton.fps)
    return moved


def _note_of_deviations(moved: Mapping[str, float], format: str) -> str:
    """Return a sentence about the clip that a format of rotations changes most; "" if it changes none by a centimetre.

    Args:
        moved: largest distance in metres by clip.
        format: format of the files.
    """
    clip = max(moved, key=moved.__getitem__)
    n_moved = sum(distance > DEVIATION for distance in moved.values())
    if not n_moved:
        return ""
    return (
        f"{format} has rotations and bones of constant length, which move joints of {n_moved} of {len(moved)} clips by "
        f"more than {100 * DEVIATION:.0f} cm, and those of {brief(clip)} by up to {100 * moved[clip]:.1f} cm; write "
        "npz or csv, which have positions; if bones of constant length share a joint and move against each other, "
        "MotionSet.with_extra_joints adds joints for them"
    )


def _path_of(path: Path, clip: Clip, format: str) -> Path:
    """Return the file of a clip: the path itself, or a file in this folder."""
    if path.suffix:
        return path
    inner = Path("" if clip.split == "all" else clip.split, clip.name + FORMATS[format])
    if inner.is_absolute() or ".." in inner.parts or Path(clip.name).name != clip.name:
        raise ValueError(f"clip {brief('/'.join(clip.key))}: its name leads out of the folder {path}; rename the clip")
    return path / inner


def convert(
    sources: list[Path],
    out: Path,
    format: str | None = None,
    fps: float | None = None,
    onto: Skeleton | None = None,
    jobs: int = -1,
    metres: float | None = None,
    up: str | None = None,
    recorded: float | None = None,
    skip_bad: bool = False,
    missing: bool = False,
    units: Mapping[Path, float] | None = None,
    prefix: bool = False,
) -> str:
    """Convert the motion of files or folders, clip by clip, on several cores.

    Args:
        sources: files and folders, as for `read_motion`.
        out: file or folder, as for `write_motion`.
        format: output format.
        fps: output frames per second; default: the rate of the files.
        onto: known skeleton to convert to.
        jobs: number of processes; -1 for one per core.
        metres, up: same as in `read_motion`.
        recorded: true frames per second of the files, if the files state a wrong rate.
        skip_bad: leave out unusable clips.
        missing: keep clips in which joints are missing (NaN) in some frames.
        units: metres per unit of some sources; `metres` is for the others.
        prefix: start the names of clips with the name of their archive or folder; for recordings, and for sources with
            equal names, with the name of the folder that contains them.

    Returns:
        A summary in words, with the unit of each source.

    Raises:
        FileNotFoundError, ValueError, OSError: same as `read_motion` and `write_motion`.
    """
    from joblib import Parallel, delayed

    format = format_of(out, format)
    if twice := [source for n, source in enumerate(sources) if source in sources[:n]]:
        raise ValueError(f"{twice[0]} is given twice; give each file or folder once")
    files_of_sources = [_files_of(source, len(sources) > 1) for source in sources]
    files = list(chain.from_iterable(files_of_sources))
    if units or prefix or not all(files_of_sources):
        options: Any = {"up": up, "fps": recorded, "missing": missing, "skip_bad": skip_bad, "onto": onto}
        motions: list[tuple[Path, MotionSet]] = []
        notes = []
        for source, inner in zip(sources, files_of_sources, strict=True):
            unit = (units or {}).get(source, metres)
            motion = read_motion(source, metres=unit, **options)
            motion = motion if fps is None or fps == motion.skeleton.fps else motion.resample(fps)
            size = float(np.median([np.median(extents(clip.positions).max(1)) for clip in motion]))
            assumed = f"unit {'metres' if unit is None else 'as given'} ({unit or 1:.4g} m), a person of {size:.2f} m"
            notes.append(f"{source}: " + "; ".join(filter(None, [assumed * (not inner), motion.interpretation])))
            motions.append((source, _renamed(motion, source, sources, prefix, archive=not inner)))
        motion = motions[0][1] if len(motions) == 1 else joined_motion(motions, out.stem)
        had_rotations = any(clip.rotations is not None for _, each in motions for clip in each)
        if had_rotations and motion.clips[0].rotations is None:
            notes.append(REST_POSES)
        paths = write_motion(out, motion, format)
        return f"{len(motion)} clips in {len(paths)} files; {len(motion.skipped)} skipped; {'; '.join(notes)}"
    if out.suffix and format != "npz" and len(files) > 1:
        raise ValueError(f"{out}: {format} stores one clip per file, but there are {len(files)}; give a folder")
    keys = [(file.split, file.name) for file in files]
    if len(set(keys)) < len(keys):
        repeated = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"two files have the clip name {'/'.join(repeated)}; pass --prefix")
    world = infer_world(sampled(files, skip_bad), metres, up)
    reader = FileReader(world, metres is not None, up is not None, recorded, onto=onto, output_fps=fps, missing=missing)
    collected, skipped = Collected(out.stem), []

    moved = {}

    def clips(stage: Path) -> Iterator[Clip]:
        work = Parallel(n_jobs=jobs, return_as="generator", pre_dispatch="2*n_jobs", batch_size=1)
        here = None if jobs == 1 else Path.cwd()
        results = work(delayed(_convert_file)(reader, file, stage, format, skip_bad, here) for file in files)
        with closing(results), progress_bar(True) as bar:
            for file, result in bar.track(zip(files, results, strict=True), len(files), description="clips"):
                reason = result if isinstance(result, str) else collected.add(file.path, *result[:3])
                if reason and not skip_bad:
                    raise ValueError(reason)
                if reason:
                    skipped.append(reason)
                    if not isinstance(result, str) and format != "npz":
                        path = _path_of(stage, result[0], format)
                        path.unlink()
                        own_companion(path, SKELETON).unlink(missing_ok=True)
                else:
                    moved["/".join(result[0].key)] = result[3]
                    yield result[0]
        if len(skipped) == len(files):
            raise ValueError(f"none of the files can be read; the first: {skipped[0]}")

    if format == "npz":
        save_clips(out, clips(out), lambda: collected.skeleton)
    else:
        with _staged(out) as stage:
            written_clips = list(clips(stage))
            if not out.suffix:
                write_labels(stage / LABELS, written_clips, out / LABELS)
    if deviations := _note_of_deviations(moved, format):
        warnings.warn(deviations, stacklevel=2)
    note = f"; {len(skipped)} skipped, the first: {skipped[0]}" if skipped else ""
    return f"{len(files) - len(skipped)} clips; read as {collected.interpretation(world)}{note}"


def _files_of(source: Path, several: bool) -> list[File]:
    """Return the files of a source; with several sources, files of a folder without splits get its name as split."""
    files = find_files(source)
    return [replace(file, split=_split(file.split, source, several)) for file in files]


def _split(split: str, source: Path, several: bool) -> str:
    return _name(source) if several and split == "all" and source.is_dir() else split


def _name(source: Path) -> str:
    """Return the name of a folder, or of a file without its ending."""
    return _absolute(source).name if source.is_dir() else source.stem


def _absolute(path: Path) -> Path:
    """Return the absolute path without `..`."""
    return Path(os.path.abspath(path))


def _renamed(motion: MotionSet, source: Path, sources: Sequence[Path], prefix: bool, archive: bool) -> MotionSet:
    """Return clips in the splits of `_files_of`, whose names may have a prefix."""
    unique = (archive or source.is_dir()) and [*map(_name, sources)].count(_name(source)) == 1
    start = f"{_name(source) if unique else _absolute(source).parent.name}-" * prefix
    clips = [
        replace(clip, name=start + clip.name, split=_split(clip.split, source, len(sources) > 1)) for clip in motion
    ]
    options: Any = {"skipped": motion.skipped, "interpretation": motion.interpretation, "missing": motion.missing}
    return MotionSet(clips, motion.skeleton, motion.name, copy=False, **options)


def _convert_file(
    reader: FileReader, file: File, out: Path, format: str, skip_bad: bool, directory: Path | None
) -> tuple[Clip, Skeleton, list[str], float] | str:
    """Read one file, and write its clip unless all clips go into one npz.

    Returns:
        Clip (its fullest frame if it was written), skeleton, notes and the result of `write_clip`; or the reason why
        the file cannot be used.
    """
    if directory:  # where relative paths start; a process may be left from a call in another directory
        os.chdir(directory)
    try:
        clip, skeleton, notes = reader(file)
        if format == "npz":
            return clip, skeleton, notes, 0.0
        motion = MotionSet([clip], skeleton, copy=False, missing=reader.missing)
        moved = write_clip(_path_of(out, clip, format), motion, format)
        fullest = int(np.isnan(clip.positions).any(2).sum(1).argmin())
        return clip.between(fullest, fullest + 1), skeleton, notes, moved
    except ValueError as error:
        if not skip_bad:
            raise
        return str(error)
