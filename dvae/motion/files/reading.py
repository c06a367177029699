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
from ..scoring.matching import RIGID, JointSubset
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

BENDS = "rotations are left out, because a joint moves relative to its parent"
REST_POSES = "rotations are left out, because rest poses differ"

LIKE = 1.6
"""Maximum ratio of body sizes in one folder; below 2.54, to detect inches among centimetres."""


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
    | `.txt` | exponential maps as in the CMU benchmark, or of Human3.6M |
    | `.c3d` | markers |
    | `.csv` | one clip in metres, columns such as LWrist_x, LWrist_y, LWrist_z; needs a skeleton |
    | `.npz` | AMASS: one clip, members `poses`, `trans`, `mocap_framerate` |
    | `.npz` | VideoPose3D's archive: the member `positions_3d` |
    | `.npz` | any other: an array (F, J, 3) in metres for each clip under "split/clip"; needs a skeleton |

    Folders are read recursively, without following links. The name of a clip is the name of its file; its split is the
    subfolder, or "all". A key of an npz without a slash also belongs to the split "all".

    The skeleton of people.npz is read from people.npz.skeleton.json, or else from skeleton.json in the same folder.
    Labels are read from people.npz.labels.csv, or else from labels.csv, which has one row per clip with the columns
    split, clip and any labels. VideoPose3D's archives of Human3.6M and HumanEva-I need no skeleton file; they are
    recognised by their subjects and joints.

    Units and axes are read from the file. If the file does not state them, they are chosen so that a person has a
    plausible size and the head is above the feet. `MotionSet.interpretation` describes the result.

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
        fps: true frames per second, if the file states a wrong rate; `MotionSet.resample` changes the frame rate.
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
        indices = [joint for joint in joints or () if isinstance(joint, int)] if onto is None else []
        motion = read_archive(path, skeleton, labels, skip_bad, indices or None, metres, up, fps, missing)
        return motion if indices or (joints is None and onto is None) else select_joints(motion, joints, onto)
    samples = sampled(files, skip_bad)
    overrides = metres is not None, up is not None
    reader = FileReader(infer_world(samples, metres, up), *overrides, fps, skeleton, joints, onto, missing=missing)
    collected = Collected(path.stem)
    clips, unread, size = [], [], 0
    for file in files:
        try:
            clip, skeleton_of_clip, notes = reader(file, samples.pop(str(file.path), None))
            if reason := collected.add(file.path, clip, skeleton_of_clip, notes):
                raise ValueError(reason)
        except ValueError as error:
            if not skip_bad:
                raise
            unread.append((file.split, file.name, str(error)))
            continue
        size += clip.positions.nbytes + (0 if clip.rotations is None else clip.rotations.nbytes)
        if size > LARGEST:
            raise ValueError(
                f"{path}: it has more than {LARGEST:,} bytes of motion, reached at {file.path}; lower the frame rate "
                "with `dvae data convert --fps`, or read its folders one by one"
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
        return _with_labels([File("all", path.stem, path)], companion(path, LABELS), labels)
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
                    raise ValueError(f"{path}: it has more than {MOST_FILES:,} files; read its folders one by one")
    present = {suffix: files for suffix, files in kinds.items() if files}
    certain = [suffix for suffix in present if suffix not in (".csv", ".txt")]  # many csv and txt files are not motion
    if len(certain) > 1:
        counts = " and ".join(f"{len(present[suffix])} {suffix[1:]}" for suffix in certain)
        raise ValueError(f"{path}: it has {counts} files; put each format into a folder of its own")
    if not present:
        raise FileNotFoundError(f"{path}: no file in it is one of {', '.join(READERS)}")
    return _with_labels(present[next(iter(present))], path / LABELS, labels)


def _with_labels(files: list[File], default: Path, labels: str | Path | None) -> list[File]:
    """Return the files with their labels."""
    for file in files:
        check_key((file.split, file.name), file.path)
    labels_by_key = read_labels(default, labels)
    return [
        replace(file, labels=labels_by_key.get((file.split, file.name), labels_by_key.get((None, file.name), {})))
        for file in files
    ]


def sampled(files: Sequence[File], skip_bad: bool = False) -> dict[str, Recording]:
    """Read some recordings of a folder, evenly spaced from its first file to its last."""
    recordings, first_error = {}, None
    for index in sorted({round(position) for position in np.linspace(0, len(files) - 1, min(SAMPLE, len(files)))}):
        try:
            recordings[str(files[index].path)] = files[index].read()
        except ValueError as error:
            if not skip_bad:
                raise
            first_error = error
    if first_error is not None and not recordings:
        raise first_error
    return recordings


@dataclass(frozen=True)
class FileReader:
    """Converter of files with one recording to clips with their skeletons, the same for all files of a folder.

    Args:
        world: units and axes of the files.
        given: whether the unit of `world` overrides the unit in a file.
        up: whether the up axis of `world` overrides the up axis in a file.
        fps, skeleton, joints, onto: same as in `read_motion`.
        output_fps: frames per second of the result; default: the rate of the file.
        missing: whether joints may be missing.
    """

    world: World
    given: bool = False
    up: bool = False
    fps: float | None = None
    skeleton: Skeleton | None = None
    joints: Sequence[int | str] | Mapping[str, str] | None = None
    onto: Skeleton | None = None
    output_fps: float | None = None
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
        normalised = to_world(recording, world)
        if normalised.up != self.world.up:
            normalised = rotate_up(normalised, self.world.up)
        fps = self.fps or normalised.fps
        if fps is None:
            raise ValueError("it does not state its frames per second; pass fps=")
        skeleton = self.skeleton or normalised.skeleton
        if skeleton and skeleton.joints != len(normalised.names):
            raise ValueError(
                f"it has {len(normalised.names)} joints, but its skeleton {skeleton.name!r} has {skeleton.joints}"
            )
        if skeleton:
            same_tree = list(skeleton.parents) == list(normalised.parents)
            normalised = replace(normalised, names=skeleton.names, parents=skeleton.parents)
            normalised = normalised if same_tree else replace(normalised, rotations=None, offsets=None)
        empty = Clip(file.split, file.name, np.empty((0, 0, 3)), file.labels)
        clip, tree = clip_of(normalised, empty, fps, skeleton, self.joints, self.onto)
        if self.output_fps and self.output_fps != fps:
            clip, tree = clip.resample(fps / self.output_fps), replace(tree, fps=float(self.output_fps))
        if reason := defect(clip, tree, self.missing):
            raise ValueError(reason)
        notes = [*recording.notes, *([BENDS] if normalised.rotations is not None and clip.rotations is None else [])]
        notes += (
            [warning] if (warning := orientation_warning(normalised.names, normalised.positions, self.world.up)) else []
        )
        return clip, tree, notes


def clip_of(
    recording: Recording,
    clip: Clip,
    fps: float,
    skeleton: Skeleton | None,
    joints: Sequence[int | str] | Mapping[str, str] | None,
    onto: Skeleton | None,
) -> tuple[Clip, Skeleton]:
    """Return the clip of a recording in metres, and its skeleton.

    Args:
        recording: recording in metres.
        clip: clip that gives the name, split and labels.
        fps: frames per second.
        skeleton: skeleton of the recording, if known.
        joints, onto: same as in `read_motion`.
    """
    recording = select_recording_joints(recording, joints, onto)
    skeleton = onto or (skeleton if joints is None else None)
    left, right = (skeleton.left, skeleton.right) if skeleton else sides(recording.names)
    positions, rotations = recording.positions.astype(np.float32), None
    rest: tuple[float, ...] = ()
    if recording.rotations is not None and recording.offsets is not None:
        rotations, rest = recording.rotations.astype(np.float32), tuple(recording.offsets.flatten().tolist())
    tree = tuple(recording.names), tuple(recording.parents), left, right
    clip_tree = Skeleton(*tree, recording.up or "y", float(fps), skeleton.name if skeleton else clip.name, rest=rest)
    labels = {**recording.labels, **clip.labels}
    return replace(clip, positions=positions, labels=labels, rotations=rotations), clip_tree


def select_recording_joints(
    recording: Recording, joints: Sequence[int | str] | Mapping[str, str] | None, onto: Skeleton | None
) -> Recording:
    """Return a recording in metres with some of its joints, or with the joints and the up axis of a known skeleton."""
    if joints is None and onto is None:
        return recording if recording.loose <= RIGID else replace(recording, rotations=None, offsets=None)
    names, parents = recording.names, recording.parents
    if onto is None:
        subset = JointSubset.of(names, parents, joints or ())
    else:
        subset = JointSubset.onto(names, onto, joints if isinstance(joints, Mapping) else None)
    positions, rotations, offsets = subset.motion(parents, recording.positions, recording.rotations)
    selected = replace(
        recording, names=subset.names, parents=subset.parents, positions=positions, rotations=rotations, offsets=offsets
    )
    return rotate_up(selected, onto.up) if onto is not None and onto.up != recording.up else selected


def rotate_up(recording: Recording, up: str) -> Recording:
    """Return a recording rotated by 90 degrees about x, so that `up` (y or z) becomes the up axis."""
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # y to z
    return replace(rotate_recording(recording, turn if up == "z" else turn.T), up=up)


class Collected:
    """Record of the clips of a folder, added one at a time, which must have the same joints and frames per second.

    Args:
        name: name of the folder.
    """

    def __init__(self, name: str):
        self._name, self._first = name, Path()
        self._skeleton: Skeleton | None = None
        self._bones, self._same_rest, self._extents = np.zeros(0), True, [0.0]
        self._notes: dict[str, list[Path]] = {}

    def add(self, path: Path, clip: Clip, skeleton: Skeleton, notes: Sequence[str] = ()) -> str | None:
        """Add a clip, or return the reason why it does not match the earlier ones."""
        bones = skeleton.bone_lengths(fullest(clip.positions)[0].astype(np.float64))
        extent = float(np.median(extents(clip.positions).max(1)))
        if self._skeleton is None:
            self._first, self._skeleton, self._bones, self._extents = path, skeleton, bones, [extent]
            self._note(path, notes)
            return None
        first = self._skeleton
        if set(first.names) != set(skeleton.names):
            missing = [name for name in first.names if name not in skeleton.names]
            additional = [name for name in skeleton.names if name not in first.names]
            differences = [
                f"{verb} {', '.join(names[:8])}"
                for verb, names in (("does not have", missing), ("has", additional))
                if names
            ]
            return (
                f"{path}: {' and '.join(differences)}, unlike {self._first}; select common joints with onto= "
                "(`dvae data convert --onto`) or joints="
            )
        if first.names != skeleton.names or (first.parents != skeleton.parents and clip.rotations is not None):
            return f"{path}: its joints have another order or tree than in {self._first}; give onto="
        if first.fps != skeleton.fps:
            return (
                f"{path}: {skeleton.fps:g} frames per second, {self._first} has {first.fps:g}; give fps= if their "
                "headers are wrong, or resample with `dvae data convert --fps`"
            )
        is_known = np.isfinite(bones + self._bones)  # known in both
        size = bones[is_known].sum() / max(self._bones[is_known].sum(), 1e-9)
        if is_known.any() and not 1 / LIKE < size < LIKE:
            return (
                f"{path}: its body is {size:.2g} times as large as in {self._first}; if it is in "
                "another unit, give its own (`dvae data convert --units FILE=UNIT`, `metres=` in Python)"
            )
        other, rest = np.array(first.rest), np.array(skeleton.rest)
        self._same_rest &= other.shape == rest.shape and not (np.abs(other - rest) > SAME).any()
        self._extents.append(extent)
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
        return replace(self._skeleton, name=name, rest=self._skeleton.rest if self._same_rest else ())

    def motion(self, clips: Sequence[Clip], **known: Any) -> MotionSet:
        """Return the clips as one set, without rotations if the rest poses differ."""
        clips = clips if self.skeleton.rest else [replace(clip, rotations=None) for clip in clips]
        return MotionSet(clips, self.skeleton, self._name, copy=False, **known)

    def interpretation(self, world: World) -> str:
        """Return a description of how the files were interpreted."""
        sentences = [f"{world}, a person of {np.median(self._extents):.2f} m"]
        if not self._same_rest and BENDS not in self._notes:
            sentences.append(REST_POSES)
        for note, paths in self._notes.items():
            several = f" in {len(paths)} of {len(self._extents)} files, the first {paths[0].name}"
            sentences.append(note + several * (len(self._extents) > 1))
        return "; ".join(sentences)


def joined_motion(sets: Sequence[tuple[Path, MotionSet]], name: str) -> MotionSet:
    """Return the clips of several files, each with its path, as one set.

    Raises:
        ValueError: their joints, frames per second, axes or sizes differ, or two clips have the same split and name.
    """
    collected, clips = Collected(name), []
    skipped: list[tuple[str, str, str]] = []
    paths: dict[tuple[str, str], Path] = {}
    first, up = sets[0][0], sets[0][1].skeleton.up
    for path, motion in sets:
        if motion.skeleton.up != up:
            raise ValueError(
                f"{path}: its up axis is {motion.skeleton.up}, but {up} in {first}; give onto= "
                "(`dvae data convert --onto`)"
            )
        skipped += motion.skipped
        for clip in motion:
            if reason := collected.add(path, clip, motion.skeleton):
                raise ValueError(reason)
            if (earlier := paths.setdefault(clip.key, path)) != path:
                raise ValueError(
                    f"the clip {'/'.join(clip.key)} occurs twice, in {earlier} and {path}; start names of clips with "
                    "the name of their archive or folder (`dvae data convert --prefix`), or rename these"
                )
            clips.append(clip)
    return collected.motion(clips, skipped=skipped, missing=any(motion.missing for _, motion in sets))


def select_joints(
    motion: MotionSet, joints: Sequence[int | str] | Mapping[str, str] | None = None, onto: Skeleton | None = None
) -> MotionSet:
    """Return clips with some of their joints, or with the joints of a known skeleton, as in `read_motion`."""
    skeleton, collected, clips = motion.skeleton, Collected(motion.name), []
    offsets = skeleton.offsets.numpy() if skeleton.rest else None
    for clip in motion:
        rotations = clip.rotations if skeleton.rest else None
        recording = Recording(skeleton.names, skeleton.parents, clip.positions, rotations, offsets, up=skeleton.up)
        selected, clip_skeleton = clip_of(recording, clip, skeleton.fps, skeleton, joints, onto)
        if reason := collected.add(Path("/".join(clip.key)), selected, clip_skeleton):
            raise ValueError(f"{motion.name}: {reason}")
        clips.append(selected)
    return collected.motion(clips, skipped=motion.skipped, interpretation=motion.interpretation, missing=motion.missing)
