"""Read motion files of any supported format, or folders of them, as one set of clips in metres."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..data.clips import Clip, MotionSet, defect, extents, fullest
from ..geometry.skeleton import Skeleton
from ..naming import sides
from ..scoring.matching import RIGID, Kept
from .amc import read_amc, read_expmap
from .archive import LARGEST, holds
from .arrays import LABELS, check_key, companion, read_archive, read_labels, read_table
from .bvh import read_bvh
from .markers import read_c3d
from .recording import Recording
from .smpl import read_amass
from .world import World, infer_world, orientation_warning, rotate_recording, to_world

READERS: dict[str, Callable[[Path], Recording]] = {
    ".bvh": read_bvh,
    ".amc": read_amc,
    ".c3d": read_c3d,
    ".npz": read_amass,
    ".csv": read_table,
    ".txt": read_expmap,
}
"""Readers by file name ending, in the order of preference within a folder."""

MOST_FILES = 100_000
SAMPLE = 9
"""Number of files of a folder that determine its unit and axes."""

SAME = 1e-3
"""Tolerance in metres within which two files have the same rest pose."""

BENDS = "rotations are left out, as a joint moves against the one that it hangs from"

LIKE = 1.6
"""Maximum ratio of body sizes in one folder; smaller than 2.54, so that it detects inches among centimetres."""


@dataclass(frozen=True)
class File:
    """A file with one recording, and the split, name and labels of its clip."""

    split: str
    name: str
    path: Path
    labels: Mapping[str, str] = field(default_factory=dict)

    def read(self) -> Recording:
        """Return the content; error messages contain the path."""
        return READERS[self.path.suffix.lower()](self.path)


def read_motion(
    path: str | Path,
    skeleton: Skeleton | None = None,
    labels: str | Path | None = None,
    skip_bad: bool = False,
    joints: Sequence[int | str] | Mapping[str, str] | None = None,
    onto: Skeleton | None = None,
    metres: float | None = None,
    up: str | None = None,
    fps: float | None = None,
    missing: bool = False,
) -> MotionSet:
    """Read a motion file, or a folder of files with one format and one skeleton.

    | file | |
    |---|---|
    | `.bvh` | |
    | `.amc` | with its `.asf` in the same folder |
    | `.txt` | exponential maps as in the CMU benchmark |
    | `.c3d` | markers |
    | `.csv` | one clip in metres, columns such as LWrist_x, LWrist_y, LWrist_z; with a skeleton |
    | `.npz` | AMASS: one clip, members `poses`, `trans`, `mocap_framerate` |
    | `.npz` | VideoPose3D's archive: the member `positions_3d` |
    | `.npz` | any other: an array (F, J, 3) in metres for each clip under "split/clip"; with a skeleton |

    Folders are read recursively, without following links. The name of a clip is the name of its file; its split is the
    subfolder, or "all". A key of an npz without a slash also belongs to the split "all".

    The skeleton of people.npz is read from people.npz.skeleton.json, or else from skeleton.json in the same folder.
    Labels are read from people.npz.labels.csv, or else from labels.csv, which has one row per clip with the columns
    split, clip and any labels. VideoPose3D's archives of Human3.6M and HumanEva-I need no skeleton file; they are
    recognised by their subjects and joints.

    Units and axes are read from the file, or else inferred: a person has a plausible size, and the head is above the
    feet. `MotionSet.said` describes the result.

    Args:
        path: file or folder.
        skeleton: overrides the skeleton of the file.
        labels: a csv file, instead of the default one.
        skip_bad: leave out clips with NaN, wrong joints or units instead of raising; they are listed in `skipped`.
        joints: joints to keep, by index or name; or a mapping from names to new names. The parent of each joint is its
            nearest kept ancestor. Rotations are kept if all bones between kept joints are rigid.
        onto: a known skeleton, such as `WALKER`, whose joints are matched by name; `joints` may override the matching,
            {"name in the file": "name in the skeleton"}.
        metres: length of the file's unit in metres, instead of the inferred one.
        up: up axis of the file, "y" or "z", instead of the inferred one.
        fps: true frames per second, if the file is wrong; `MotionSet.resampled` changes the frame rate.
        missing: keep clips in which joints are missing (NaN) in some frames.

    Returns:
        The clips in file order, in metres.

    Raises:
        FileNotFoundError: the file does not exist, or the folder has no motion files.
        ValueError: the file is damaged, its pickle contains anything but data, a clip is unusable, the files of a
            folder differ in joints or frames per second, or the skeleton is unknown. The message contains the reason.
    """
    path = Path(path)
    files = find_files(path, labels)
    if not files:
        places = [joint for joint in joints or () if isinstance(joint, int)] if onto is None else []
        found = read_archive(path, skeleton, labels, skip_bad, places or None, metres, up, fps, missing)
        return found if places or (joints is None and onto is None) else select_joints(found, joints, onto)
    some = sampled(files, skip_bad)
    given = metres is not None, up is not None
    reader = FileReader(infer_world(some, metres, up), *given, fps, skeleton, joints, onto, missing=missing)
    collected = Collected(path.stem)
    clips, unread, size = [], [], 0
    for file in files:
        try:
            clip, own, notes = reader(file, some.pop(str(file.path), None))
            if reason := collected.add(file.path, clip, own, notes):
                raise ValueError(reason)
        except ValueError as error:
            if not skip_bad:
                raise
            unread.append((file.split, file.name, str(error)))
            continue
        size += clip.positions.nbytes + (0 if clip.rotations is None else clip.rotations.nbytes)
        if size > LARGEST:
            raise ValueError(
                f"{path}: it has more than {LARGEST:,} bytes of motion, up to {file.path}; `dvae data convert --fps` "
                "makes it smaller, or give its folders one by one"
            )
        clips.append(clip)
    if not clips:
        raise ValueError(f"{path}: none of its files can be read; the first: {unread[0][2]}")
    return collected.motion(
        clips, skip_bad=skip_bad, skipped=unread, interpretation=collected.interpretation(reader.world), missing=missing
    )


def find_files(path: Path, labels: str | Path | None = None) -> list[File]:
    """Return files with one recording each: the path itself, or the files of a folder; empty for an archive of clips.

    Raises:
        FileNotFoundError: the file does not exist, or the folder has no motion files.
        ValueError: the format is unknown, a folder has files of several formats, or a file name is not valid for a
            clip.
    """
    if not path.is_dir():
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file")
        suffix = path.suffix.lower()
        if suffix not in READERS and not zipfile.is_zipfile(path):
            raise ValueError(
                f"{path}: motion is read from files that end in {', '.join(READERS)}, or from folders of them, and "
                "tables from .csv, .tsv, .parquet, .npz and .npy; export it as one of these"
            )
        if suffix not in READERS or (suffix == ".npz" and not holds(path, "poses", "trans")):
            return []
        return _known([File("all", path.stem, path)], companion(path, LABELS), labels)
    kinds: dict[str, list[File]] = {suffix: [] for suffix in READERS}
    count = 0
    for folder, inner, names in os.walk(path, followlinks=False):
        inner.sort()
        split = Path(folder).relative_to(path).as_posix()
        for name in sorted(names):
            file = Path(folder, name)
            suffix = file.suffix.lower()
            labelling = name == LABELS or name.endswith(f".npz.{LABELS}")
            if suffix in kinds and not name.startswith(".") and not labelling and not file.is_symlink():
                kinds[suffix].append(File("all" if split == "." else split, file.stem, file))
                count += 1
                if count > MOST_FILES:
                    raise ValueError(f"{path}: it has more than {MOST_FILES:,} files; give its folders one by one")
    there = {suffix: files for suffix, files in kinds.items() if files}
    sure = [suffix for suffix in there if suffix not in (".csv", ".txt")]  # many csv and txt files are not motion
    if len(sure) > 1:
        counts = " and ".join(f"{len(there[suffix])} {suffix[1:]}" for suffix in sure)
        raise ValueError(f"{path}: it has {counts} files; put each kind into a folder of its own")
    if not there:
        raise FileNotFoundError(f"{path}: no file in it is one of {', '.join(READERS)}")
    return _known(there[next(iter(there))], path / LABELS, labels)


def _known(files: list[File], beside: Path, labels: str | Path | None) -> list[File]:
    """Return the files with their labels."""
    for file in files:
        check_key((file.split, file.name), file.path)
    known = read_labels(beside, labels)
    return [
        replace(file, labels=known.get((file.split, file.name), known.get((None, file.name), {}))) for file in files
    ]


def sampled(files: Sequence[File], skip_bad: bool = False) -> dict[str, Recording]:
    """Read some recordings of a folder, evenly spaced from its first file to its last."""
    found, wrong = {}, None
    for place in sorted({round(at) for at in np.linspace(0, len(files) - 1, min(SAMPLE, len(files)))}):
        try:
            found[str(files[place].path)] = files[place].read()
        except ValueError as error:
            if not skip_bad:
                raise
            wrong = error
    if wrong is not None and not found:
        raise wrong
    return found


@dataclass(frozen=True)
class FileReader:
    """Convert files with one recording to clips with their skeletons, in the same way for all files of a folder.

    Args:
        world: units and axes of the files.
        given, up: whether the unit, and the up axis, of `world` override those in a file.
        fps, skeleton, joints, onto: same as in `read_motion`.
        resampled: frames per second of the result; default: the rate of the file.
        missing: whether joints may be missing.
    """

    world: World
    given: bool = False
    up: bool = False
    fps: float | None = None
    skeleton: Skeleton | None = None
    joints: Sequence[int | str] | Mapping[str, str] | None = None
    onto: Skeleton | None = None
    resampled: float | None = None
    missing: bool = False

    def __call__(self, file: File, recording: Recording | None = None) -> tuple[Clip, Skeleton, list[str]]:
        """Return the clip, its own skeleton, and notes about it.

        Args:
            file: file to read.
            recording: its content, if it was already read.

        Raises:
            ValueError: the file cannot be used; the message contains the path.
        """
        recording = recording or file.read()
        try:
            return self._clip(file, recording)
        except ValueError as error:
            raise error if str(file.path) in str(error) else ValueError(f"{file.path}: {error}") from error

    def _clip(self, file: File, recording: Recording) -> tuple[Clip, Skeleton, list[str]]:
        world = self.world
        if recording.metres is not None and not self.given:
            world = replace(world, unit="as the file says", metres=recording.metres)
        if recording.up is not None and not self.up:
            world = replace(world, axis=recording.up, upwards=True)
        settled = to_world(recording, world)
        if settled.up != self.world.up:
            settled = rotate_up(settled, self.world.up)
        fps = self.fps or settled.fps
        if fps is None:
            raise ValueError("it does not state its frames per second; give fps=")
        known = self.skeleton or settled.skeleton
        if known and known.joints != len(settled.names):
            raise ValueError(f"it has {len(settled.names)} joints, skeleton {known.name!r} has {known.joints}")
        if known:
            alike = list(known.parents) == list(settled.parents)
            settled = replace(settled, names=known.names, parents=known.parents)
            settled = settled if alike else replace(settled, rotations=None, offsets=None)
        empty = Clip(file.split, file.name, np.empty((0, 0, 3)), file.labels)
        clip, own = clip_of(settled, empty, fps, known, self.joints, self.onto)
        if self.resampled and self.resampled != fps:
            clip, own = clip.resampled(fps / self.resampled), replace(own, fps=float(self.resampled))
        if reason := defect(clip, own, self.missing):
            raise ValueError(reason)
        notes = [*recording.notes, *([BENDS] if settled.rotations is not None and clip.rotations is None else [])]
        notes += [lying] if (lying := orientation_warning(settled.names, settled.positions, self.world.up)) else []
        return clip, own, notes


def clip_of(
    recording: Recording,
    clip: Clip,
    fps: float,
    known: Skeleton | None,
    joints: Sequence[int | str] | Mapping[str, str] | None,
    onto: Skeleton | None,
) -> tuple[Clip, Skeleton]:
    """Return the clip of a recording in metres, and its skeleton.

    Args:
        recording: recording in metres.
        clip: name, split and labels of the clip.
        fps: frames per second.
        known: skeleton of the recording, if known.
        joints, onto: same as in `read_motion`.
    """
    recording = select_recording_joints(recording, joints, onto)
    known = onto or (known if joints is None else None)
    left, right = (known.left, known.right) if known else sides(recording.names)
    positions, rotations = recording.positions.astype(np.float32), None
    rest: tuple[float, ...] = ()
    if recording.rotations is not None and recording.offsets is not None:
        rotations, rest = recording.rotations.astype(np.float32), tuple(recording.offsets.flatten().tolist())
    tree = tuple(recording.names), tuple(recording.parents), left, right
    own = Skeleton(*tree, recording.up or "y", float(fps), known.name if known else clip.name, rest=rest)
    labels = {**recording.labels, **clip.labels}
    return replace(clip, positions=positions, labels=labels, rotations=rotations), own


def select_recording_joints(
    recording: Recording, joints: Sequence[int | str] | Mapping[str, str] | None, onto: Skeleton | None
) -> Recording:
    """Return a recording in metres with some of its joints, or with the joints and the up axis of a known skeleton."""
    if joints is None and onto is None:
        return recording if recording.loose <= RIGID else replace(recording, rotations=None, offsets=None)
    names, parents = recording.names, recording.parents
    if onto is None:
        found = Kept.of(names, parents, joints or ())
    else:
        found = Kept.onto(names, onto, joints if isinstance(joints, Mapping) else None)
    positions, rotations, offsets = found.motion(parents, recording.positions, recording.rotations)
    made = replace(
        recording, names=found.names, parents=found.parents, positions=positions, rotations=rotations, offsets=offsets
    )
    return rotate_up(made, onto.up) if onto is not None and onto.up != recording.up else made


def rotate_up(recording: Recording, up: str) -> Recording:
    """Return a recording rotated about x so that the other axis is up."""
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # y to z
    return replace(rotate_recording(recording, turn if up == "z" else turn.T), up=up)


class Collected:
    """Check that the clips of a folder belong together, one clip at a time: same joints and frames per second.

    Args:
        name: name of the folder.
    """

    def __init__(self, name: str):
        self._name, self._first = name, Path()
        self._skeleton: Skeleton | None = None
        self._bones, self._alike, self._extents = np.zeros(0), True, [0.0]
        self._notes: dict[str, list[Path]] = {}

    def add(self, path: Path, clip: Clip, skeleton: Skeleton, notes: Sequence[str] = ()) -> str | None:
        """Add a clip, or return the reason why it does not match the earlier ones."""
        bones = skeleton.bone_lengths(fullest(clip.positions)[0].astype(np.float64))
        own = float(np.median(extents(clip.positions).max(1)))
        if self._skeleton is None:
            self._first, self._skeleton, self._bones, self._extents = path, skeleton, bones, [own]
            self._note(path, notes)
            return None
        first = self._skeleton
        if set(first.names) != set(skeleton.names):
            lacking = [name for name in first.names if name not in skeleton.names]
            strange = [name for name in skeleton.names if name not in first.names]
            said = [f"{verb} {', '.join(names[:8])}" for verb, names in (("lacks", lacking), ("has", strange)) if names]
            return f"{path}: {' and '.join(said)}, other than {self._first}; joints= or onto= takes what they share"
        if first.names != skeleton.names or (first.parents != skeleton.parents and clip.rotations is not None):
            return f"{path}: its joints have another order or tree than in {self._first}; give onto="
        if first.fps != skeleton.fps:
            return (
                f"{path}: {skeleton.fps:g} frames per second, {self._first} has {first.fps:g}; give fps= if their "
                "headers are wrong, or resample with `dvae data convert --fps`"
            )
        there = np.isfinite(bones + self._bones)  # known in both
        size = bones[there].sum() / max(self._bones[there].sum(), 1e-9)
        if there.any() and not 1 / LIKE < size < LIKE:
            return (
                f"{path}: its body is {size:.2g} times as large as in {self._first}; if it is in "
                "another unit, read it separately with metres="
            )
        other, rest = np.array(first.rest), np.array(skeleton.rest)
        self._alike &= other.shape == rest.shape and not (np.abs(other - rest) > SAME).any()
        self._extents.append(own)
        self._note(path, notes)
        return None

    def _note(self, path: Path, notes: Sequence[str]) -> None:
        for note in notes:
            self._notes.setdefault(note, []).append(path)

    @property
    def skeleton(self) -> Skeleton:
        """The common skeleton, without a rest pose if the rest poses differ."""
        assert self._skeleton is not None
        single = len(self._extents) == 1
        name = self._skeleton.name if single or self._skeleton.name != self._first.stem else self._name
        return replace(self._skeleton, name=name, rest=self._skeleton.rest if self._alike else ())

    def motion(self, clips: Sequence[Clip], **known: Any) -> MotionSet:
        """Return the clips as one set, without rotations if the rest poses differ."""
        clips = clips if self.skeleton.rest else [replace(clip, rotations=None) for clip in clips]
        return MotionSet(clips, self.skeleton, self._name, copy=False, **known)

    def interpretation(self, world: World) -> str:
        """Return a description of how the files were interpreted."""
        found = [f"{world}, a person of {np.median(self._extents):.2f} m"]
        if not self._alike and BENDS not in self._notes:
            found.append("rotations are left out, as rest poses differ")
        for note, paths in self._notes.items():
            several = f" in {len(paths)} of {len(self._extents)} files, the first {paths[0].name}"
            found.append(note + several * (len(self._extents) > 1))
        return "; ".join(found)


def joined_motion(sets: Sequence[tuple[Path, MotionSet]], name: str) -> MotionSet:
    """Return the clips of several files, each with its path, as one set.

    Raises:
        ValueError: their joints, frames per second, axes or sizes differ, or two clips have the same split and name.
    """
    collected, clips = Collected(name), []
    skipped: list[tuple[str, str, str]] = []
    first, up = sets[0][0], sets[0][1].skeleton.up
    for path, motion in sets:
        if motion.skeleton.up != up:
            raise ValueError(f"{path}: {motion.skeleton.up} is up, and {up} in {first}; give onto=")
        skipped += motion.skipped
        for clip in motion:
            if reason := collected.add(path, clip, motion.skeleton):
                raise ValueError(reason)
            clips.append(clip)
    return collected.motion(clips, skipped=skipped, missing=any(motion.missing for _, motion in sets))


def select_joints(
    motion: MotionSet, joints: Sequence[int | str] | Mapping[str, str] | None = None, onto: Skeleton | None = None
) -> MotionSet:
    """Return clips with some of their joints, or with the joints of a known skeleton, as in `read_motion`."""
    skeleton, collected, clips = motion.skeleton, Collected(motion.name), []
    offsets = skeleton.offsets.numpy() if skeleton.rest else None
    for clip in motion:
        turns = clip.rotations if skeleton.rest else None
        whole = Recording(skeleton.names, skeleton.parents, clip.positions, turns, offsets, up=skeleton.up)
        made, own = clip_of(whole, clip, skeleton.fps, skeleton, joints, onto)
        if reason := collected.add(Path("/".join(clip.key)), made, own):
            raise ValueError(f"{motion.name}: {reason}")
        clips.append(made)
    return collected.motion(clips, skipped=motion.skipped, interpretation=motion.interpretation, missing=motion.missing)
