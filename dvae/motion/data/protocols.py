"""Protocols: how motion is cut into windows, and which windows are for training, validation and test.

Sources of the presets: DLow (Yuan and Kitani 2020) and GSPS (Mao, Liu and Salzmann 2021) for Human3.6M and HumanEva-I,
TrajeVAE (Kania et al. 2021), and the READMEs of the data for bandai2 and cmu8. `h36m-angles` is for Human3.6M's
exponential maps at 25 fps: frames of Mix-and-Match (Aliakbarian et al. 2020), subjects of Martinez et al. 2017.

Decisions where papers and code differ:

* A window may start at every frame from 0 to F - T *inclusive*. The public code of DLow and GSPS draws and lists starts
  below F - T, so it never uses a clip's last frame and drops clips of exactly T frames.
* Validation clips are every k-th training clip in file order. Whole clips are chosen because the windows of a clip
  overlap. They are chosen before clips that are too short are dropped, so they are the same for every window length. In
  bandai2, neighbouring takes are near copies, and the style of every validation take also occurs in training.
  Validation scores there cannot replace test scores.
* Baselines that memorise the training data (nearest neighbours) should use all of it, the split "train+validation".
"""

from __future__ import annotations

import hashlib
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import asdict, astuple, dataclass, field, replace
from math import pi
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from ...data.batch import Batch
from ...data.blocks import blocks, cut_windows, hash_list, hash_values
from ...data.schema import Schema, SchemaError
from ...data.sequences import interpolate_missing, tensor_of
from ...data.views import View
from ...options import Amount, Frames, Range, check, nearest, tuples
from ..geometry.rotations import continuous, from_matrix, to_matrix
from ..geometry.skeleton import Skeleton, rotate_about_up
from ..geometry.views import ROTATIONS, Rotations, Travel
from .actions import ACTION, GROUP, human36m_label
from .clips import Clip, MotionSet

Representation = Literal["positions", "6d", "quaternion", "vector"]
"""Input of the models: positions of joints, or rotations in a form of `dvae.motion.geometry.rotations`."""
RootMotion = Literal["drop", "relative", "travel"]
"""What windows keep of the root, as in `Protocol`."""


@dataclass(frozen=True)
class Protocol:
    """How windows are cut, represented and split.

    Args:
        name: name in results.
        observed, predicted: number of observed and of predicted frames; a window contains both.
        fps: frames per second that the motion must have.
        train_stride, test_stride: frames between the starts of successive windows, where windows are listed and not
            drawn, for training and for test.
        root: "drop": every frame is relative to its own pelvis, which is then removed, D = 3 (J - 1). "relative": all
            frames are relative to one position, the first observed pelvis of the window. Global motion is then kept,
            and D = 3 J. "travel": the same windows, but models see velocities of the root and poses relative to its
            heading (`dvae.motion.geometry.views.Travel`), so forecasts continue the path.
        multimodal_threshold: distance in metres. If the last observed poses of test windows are closer than this, the
            futures of all these windows are possible futures of each.
        split_by: "split", or the label that assigns clips to splits.
        train, test: values of `split_by` for training and test.
        validation: fraction of the training clips held out for validation.
        sampling: distribution of training windows. "clip": uniform clip, uniform start. "length": uniform over all
            windows. "subject": uniform split of the archive (a subject, in Human3.6M), then clip, then start.
        heading: rotate every window about the up axis so that the heading of its last observed frame is zero.
        rotate: rotate every window that `Windows.sample` draws about the up axis by a uniform random angle.
        representation: input of the models: positions, or joint rotations in one of the forms of
            `dvae.motion.geometry.rotations`. Windows and scores use positions in either case.

    Raises:
        ValueError: a number of frames or a stride is below 1, both heading and rotate are set, or root is "travel" with
            a single observed frame, which has no velocity.
    """

    name: str
    observed: Frames
    predicted: Frames
    fps: Annotated[float, Range(0.001, 100_000)]
    train_stride: Frames
    test_stride: Frames
    root: RootMotion = "drop"
    multimodal_threshold: Amount = 0.5
    split_by: str = "split"
    train: tuple[str, ...] = ("train",)
    test: tuple[str, ...] = ("test",)
    validation: Annotated[float, Range(0, 1, below=True)] = 0.1
    sampling: Literal["clip", "length", "subject"] = "clip"
    heading: bool = False
    rotate: bool = False
    representation: Representation = "positions"

    def __post_init__(self) -> None:
        try:
            check(self)
        except (TypeError, ValueError) as error:
            raise type(error)(f"protocol {self.name}: {error}") from None
        if self.heading and self.rotate:
            raise ValueError(
                f"protocol {self.name}: `heading` fixes the direction that `rotate` draws at random; set only one"
            )

        if self.root == "travel" and self.observed < 2:
            raise ValueError(
                f"protocol {self.name}: root='travel' needs the velocity of the last observed frame, so at least 2 "
                "observed frames, got 1; choose another protocol, or root='relative'"
            )

    @property
    def length(self) -> int:
        """Number of frames T in a window."""
        return self.observed + self.predicted


_HUMAN36M: dict[str, Any] = {"train": ("S1", "S5", "S6", "S7", "S8"), "test": ("S9", "S11"), "sampling": "subject"}
_STYLES: dict[str, Any] = {"split_by": "file_group", "train": ("A", "B"), "test": ("C",)}
_TRAJECTORIES: dict[str, Any] = {"root": "relative", "rotate": True}

PROTOCOLS = {
    protocol.name: protocol
    for protocol in (
        Protocol("h36m", 25, 100, 50, train_stride=20, test_stride=25, **_HUMAN36M),
        Protocol(
            "h36m-angles",
            *(16, 60, 25),
            train_stride=10,
            test_stride=25,
            train=("S1", "S6", "S7", "S8", "S9", "S11"),
            test=("S5",),
        ),
        Protocol(
            "humaneva",
            *(15, 60, 60),
            train_stride=15,
            test_stride=15,
            train=("Train/S1", "Train/S2", "Train/S3"),
            test=("Validate/S1", "Validate/S2", "Validate/S3"),
            sampling="subject",
        ),
        Protocol("trajevae", 1, 100, 50, train_stride=25, test_stride=25, **_TRAJECTORIES, **_HUMAN36M),
        Protocol("bandai2-by-style", 15, 60, 30, train_stride=5, test_stride=15, **_STYLES),
        Protocol(
            "bandai2-tuning", 15, 60, 30, train_stride=5, test_stride=15, **{**_STYLES, "train": ("A",), "test": ("B",)}
        ),
        Protocol("bandai2-trajectories", 1, 60, 30, train_stride=5, test_stride=15, **_TRAJECTORIES, **_STYLES),
        Protocol("bandai2-by-take", 15, 60, 30, train_stride=5, test_stride=15),
        Protocol("cmu8", 15, 60, 30, train_stride=5, test_stride=15),
        Protocol("cmu8-trajectories", 1, 60, 30, train_stride=5, test_stride=15, **_TRAJECTORIES),
        Protocol("simulated", 15, 60, 30, train_stride=5, test_stride=15),
        Protocol("simulated-trajectories", 1, 60, 30, train_stride=5, test_stride=15, **_TRAJECTORIES),
    )
}
"""The presets by name.

In `bandai2-by-style`, all clips of groups A and B are for training and all clips of C for testing, whatever the
file's own split. This split reproduces the reference values of the data's README. Options are chosen on
`bandai2-tuning`, which uses groups A and B only, so that group C stays unseen."""


def named_protocol(name: str) -> Protocol:
    """Return a preset protocol.

    Raises:
        ValueError: the name is unknown; the message suggests the nearest known one.
    """
    if name not in PROTOCOLS:
        raise ValueError(f"unknown protocol {name!r}{nearest(name, PROTOCOLS)}; known: {', '.join(PROTOCOLS)}")
    return PROTOCOLS[name]


@dataclass(frozen=True)
class Poses(Schema):
    """The schema of windows of motion, x (B, T, D) in metres.

    Args:
        skeleton: skeleton of the poses.
        protocol: protocol that cuts the windows.
    """

    kind: ClassVar[str] = "poses"
    per: ClassVar[str] = "frame"

    skeleton: Skeleton = field(kw_only=True)
    protocol: Protocol = field(kw_only=True)

    @classmethod
    def from_data(cls, protocol: Protocol, skeleton: Skeleton, length: int | None = None) -> Self:
        """Return the schema of windows that a protocol cuts, optionally with another length.

        Args:
            protocol: protocol that cuts the windows.
            skeleton: skeleton of the clips.
            length: number of frames T; None for the length of the protocol.
        """
        view = cls._view(protocol, skeleton)
        size = view.size if isinstance(view, Rotations | Travel) else 3 * (skeleton.joints - (protocol.root == "drop"))
        return cls({"x": size}, length or protocol.length, protocol.observed, skeleton=skeleton, protocol=protocol)

    @classmethod
    @override
    def of(cls, data: Any, who: str = "this method", representation: str = "positions") -> Self:
        """Return the schema of data, and check the representation that a model reads.

        Args:
            data: windows, data or another object with a schema.
            who: name of the reader, for errors.
            representation: representation that the model reads.

        Raises:
            SchemaError: the data have no schema of poses, or another representation.
        """
        schema = super().of(data, who)
        if (actual := schema.representation) != representation:
            form, root = schema.protocol.representation, schema.protocol.root
            advice = [f"whose representation is {representation} (--representation)"] * (form != representation)
            advice += ["whose root is not 'travel' (--root)"] * (root == "travel")
            raise SchemaError(
                f"{who} reads {_describe(representation)}, but under this protocol models see {_describe(actual)}; "
                f"choose a protocol {' and '.join(advice)}"
            )
        return schema

    @property
    def representation(self) -> str:
        """Input of the models: the protocol's representation, after "travel and " if models see the root's travel."""
        return "travel and " * (self.protocol.root == "travel") + self.protocol.representation

    @staticmethod
    def _view(protocol: Protocol, skeleton: Skeleton) -> View:
        if protocol.root == "travel":
            return Travel(skeleton, protocol.representation)
        if protocol.representation == "positions":
            return View()
        return Rotations(skeleton, protocol.representation, protocol.root == "relative")

    @property
    @override
    def preset(self) -> str:
        """The name of the skeleton."""
        return self.skeleton.name

    @property
    @override
    def view(self) -> View:
        return self._view(self.protocol, self.skeleton)

    @property
    @override
    def together(self) -> Sequence[int]:
        """Label of the joint of each coordinate of a window; models that do not read positions need all joints."""
        return [n // 3 for n in range(self.windows.size("x"))]

    @property
    @override
    def windows(self) -> Poses:
        root: RootMotion = "drop" if self.protocol.root == "drop" else "relative"
        protocol = replace(self.protocol, representation="positions", root=root)
        return self.from_data(protocol, replace(self.skeleton, rest=()), self.length)

    @property
    def frames(self) -> int:
        """Number of frames T in a window."""
        return self.length or self.protocol.length

    def config(self) -> dict[str, Any]:
        """Return the schema as JSON types; `from_config` reads it."""
        return {"skeleton": asdict(self.skeleton), "protocol": asdict(self.protocol), "length": self.length}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Return the schema from the result of `config`.

        Args:
            config: dictionary that `config` returned.
        """
        return cls.from_data(Protocol(**tuples(config["protocol"])), Skeleton(**config["skeleton"]), config["length"])


def _describe(representation: str) -> str:
    form = representation.removeprefix("travel and ")
    travel = "the travel of the root and " * (form != representation)
    return travel + ("positions of joints" if form == "positions" else f"rotations of joints as {form}")


def check_rate(motion: MotionSet, protocol: Protocol) -> None:
    """Check that motion has the frame rate of a protocol.

    Raises:
        ValueError: it has another.
    """
    if motion.skeleton.fps != protocol.fps:
        raise ValueError(
            f"protocol {protocol.name} needs {protocol.fps:g} frames per second, but {motion.name!r} has "
            f"{motion.skeleton.fps:g}; resample it (`dvae data convert FILE --fps {protocol.fps:g} --out NEW`, or "
            "`MotionSet.resample` in Python), or choose another protocol"
        )


def windows(motion: MotionSet, protocol: Protocol | str, split: str, length: int | None = None) -> Windows:
    """Return the windows of a split.

    Args:
        motion: clips.
        protocol: protocol that cuts them, or the name of one of `PROTOCOLS`.
        split: "train", "validation", "test", or "train+validation".
        length: frames in a window; default: the protocol's observed + predicted.

    Raises:
        ValueError: motion and protocol have different frame rates, the split has no clip, no clip is long enough, or a
            clip has no label although the protocol splits by it.
    """
    if isinstance(protocol, str):
        protocol = named_protocol(protocol)
    check_rate(motion, protocol)
    parts = _divide(motion, protocol)
    unknown = [name for name in split.split("+") if name not in parts]
    if unknown:
        raise ValueError(
            f"no split {unknown[0]!r}{nearest(unknown[0], parts)}: expected train, validation, test or train+validation"
        )
    keys = {clip.key for name in split.split("+") for clip in parts[name]}
    return Windows([clip for clip in motion if clip.key in keys], motion, protocol, split, length or protocol.length)


def _divide(motion: MotionSet, protocol: Protocol) -> dict[str, list[Clip]]:
    def value(clip: Clip) -> str:
        if protocol.split_by == "split":
            return clip.split
        if protocol.split_by not in clip.labels:
            raise ValueError(
                f"protocol {protocol.name} splits by the label {protocol.split_by!r}, but clip "
                f"{'/'.join(clip.key)} does not have it: is labels.csv next to the file?"
            )
        return clip.labels[protocol.split_by]

    values = [(clip, value(clip)) for clip in motion]
    train = [clip for clip, group in values if group in protocol.train]
    test = [clip for clip, group in values if group in protocol.test]
    if not train and not test:
        groups = ", ".join(dict.fromkeys(group for _, group in values))
        raise ValueError(
            f"protocol {protocol.name} needs {protocol.split_by} {'/'.join(protocol.train)} for training and "
            f"{'/'.join(protocol.test)} for test; {motion.name!r} has {groups}"
        )
    unused = [group for _, group in values if group not in (*protocol.train, *protocol.test)]
    if unused and protocol.split_by == "split":
        warnings.warn(
            f"{len(unused)} of {len(values)} clips of {motion.name!r} are not used: protocol {protocol.name} uses the "
            f"splits {', '.join((*protocol.train, *protocol.test))}, not {', '.join(dict.fromkeys(unused)):.300}",
            stacklevel=3,
        )
    validation = held_out(len(train), protocol.validation)
    return {
        "train": [clip for i, clip in enumerate(train) if i not in validation],
        "validation": [clip for i, clip in enumerate(train) if i in validation],
        "test": test,
    }


def held_out(count: int, part: float) -> set[int]:
    """Return the indices of the clips held out for validation.

    The clips are divided into as many blocks as there are clips to hold out. The middle clip of each block is held out.
    """
    blocks = round(count * part)
    if part and count > 1:
        blocks = max(blocks, 1)
    return {int((block + 0.5) * count / blocks) for block in range(blocks)}


class Windows:
    """Windows of T frames cut from clips, as tensors (…, T, D) in metres.

    Created by `windows`. `sample` draws windows, `all` lists windows at a fixed stride, and `batches` yields them in
    batches. Clips are not copied and may be memory-mapped: windows are made relative to their root, and rotated, when
    they are cut.

    Attributes:
        protocol: protocol that cuts the windows.
        skeleton: skeleton of the poses.
        split: split of the windows.
        length: number of frames T in a window.
        missing: whether joints may be missing.
        clips: clips that are long enough.
        skipped: (split, clip, frames) of clips that are too short.

    Raises:
        ValueError: `length` is too short, or no clip is long enough.
    """

    def __init__(self, clips: list[Clip], motion: MotionSet, protocol: Protocol, split: str, length: int) -> None:
        if length < 1 or (protocol.heading and length < protocol.observed):
            raise ValueError(
                f"`length` must be at least {protocol.observed if protocol.heading else 1} frames, got {length}"
            )
        source = motion if protocol.representation == "positions" else motion.with_rotations()
        self.protocol, self.skeleton, self.split, self.length = protocol, source.skeleton, split, length
        self.missing, self._rest = motion.missing, motion.skeleton.rest
        self.clips = [clip for clip in clips if clip.frames >= length]
        self.skipped = [(*clip.key, clip.frames) for clip in clips if clip.frames < length]
        if not self.clips:
            longest = max((clip.frames for clip in clips), default=0)
            raise ValueError(
                f"{split} split of {motion.name!r} has no window of {length} frames: {len(clips)} clips, "
                f"the longest of {longest} frames"
            )
        if protocol.heading:
            self.skeleton.heading(torch.zeros(self.skeleton.joints, 3))  # raises early without left and right

        self._frames = [clip.positions for clip in self.clips]
        self._rotations: list[Any] | None = None
        if protocol.representation != "positions":
            self._rotations = [source[clip.key].rotations for clip in self.clips]
        frames = torch.tensor([clip.frames for clip in self.clips])
        self._first = frames.cumsum(0) - frames
        self._classes: dict[str, Tensor] = {}  # variable -> class of every clip
        self._named: set[str] = set()  # labels that follow from the names of clips
        if motion.skeleton.name == "human36m":
            self._named = {ACTION, GROUP} - {label for clip in motion for label in clip.labels}
        self._given: Tensor | float | None = None  # set by `given`
        self._listed: tuple[Tensor, Tensor] | None = None  # set by `at`
        self._reason = ""
        self._starts = frames - length + 1
        if self.missing:
            is_known = (np.isfinite(block).all(-1) for frames in self._frames for block in blocks(frames))
            is_usable = (joints[:, self.skeleton.root] & (joints.sum(-1) > 1) for joints in is_known)
            before = np.concatenate([[False], *is_usable]).cumsum(dtype=np.int32)
            self._usable_before = torch.from_numpy(before)  # number of usable frames before each frame
            if not len(self):
                raise ValueError(
                    f"{split} split of {motion.name!r} has no usable window: the root and another joint must be "
                    "observed together in at least one observed and one predicted frame"
                )
        self._weights = self._draw_weights().cumsum(0)

    def _draw_weights(self) -> Tensor:
        if self.protocol.sampling == "length":
            return self._starts.double()
        if self.protocol.sampling == "clip":
            return torch.ones(len(self.clips), dtype=torch.float64)
        clips_of = Counter(clip.split for clip in self.clips)
        return torch.tensor([1 / clips_of[clip.split] for clip in self.clips], dtype=torch.float64)

    @property
    def stride(self) -> int:
        """Frames between the starts of the windows in `keys`; validation windows use the stride of test windows."""
        return self.protocol.train_stride if self.split.startswith("train") else self.protocol.test_stride

    @property
    def keys(self) -> list[tuple[str, str, int]]:
        """(split, clip, first frame) of the windows that `all()` lists."""
        return self.index(self.stride)

    def index(self, stride: int) -> list[tuple[str, str, int]]:
        """Return (split, clip, first frame) of the windows that `all(stride)` lists.

        Args:
            stride: frames between the starts of windows.
        """
        return list(self._keys(stride))

    def __len__(self) -> int:
        return len(self._list(self.stride)[0])

    def __repr__(self) -> str:
        return (
            f"Windows({self.protocol.name} {self.split}: {len(self)} of {self.length} frames from "
            f"{len(self.clips)} clips, {len(self.skipped)} too short)"
        )

    @property
    def schema(self) -> Poses:
        """Schema of these windows."""
        return Poses.from_data(self.protocol, self.skeleton, self.length)

    @property
    def size(self) -> int:
        """Number of values per frame, D = 3 J, or 3 (J - 1) without the root."""
        return 3 * len(self.joints)

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Draw windows with replacement, as the protocol's `sampling` defines: {"x": (B, T, D)} float32.

        If joints may be missing, the batch also contains "mask", as in `all`. The same generator state gives the same
        windows.

        Args:
            batch_size: B, number of windows.
            generator: random generator on the CPU.

        Returns:
            {"x": (B, T, D)}, and "mask" if joints may be missing.
        """
        if self._listed is not None:
            raise ValueError("windows at chosen frames are for evaluation; draw from all windows")
        clip_draws, start_draws, angle_draws = torch.rand(3, batch_size, dtype=torch.float64, generator=generator)
        clips = torch.searchsorted(self._weights, clip_draws * self._weights[-1], right=True)
        starts = (start_draws * self._starts[clips]).long()
        x = self._cut(clips, starts)
        if self.protocol.rotate:
            joints = x.unflatten(-1, (-1, 3))
            angle = (2 * pi * angle_draws).float()[:, None, None]
            x = rotate_about_up(joints, angle, self.skeleton.up).flatten(-2)
        batch = self._batch(x, clips, generator)
        if self._rotations is not None:
            batch["view_inputs"] = {
                ROTATIONS: self._cut_rotations(clips, starts, angle if self.protocol.rotate else None)
            }
        return batch

    def all(self, stride: int | None = None) -> Batch:
        """Return the windows that start at multiples of `stride`, in the order of `keys`: {"x": (N, T, D)} float32.

        If joints may be missing, the batch also contains "mask" (N, T, D), which is False where a value is missing; x
        is 0 there. Poses are relative to the root, so a whole frame is missing if its root is. With root="relative", a
        missing root affects other joints only if it is missing throughout the window. Only windows that have observed
        values in both the observed and the predicted frames are listed.

        Args:
            stride: frames between the starts of windows; None for the stride of the protocol.
        """
        return self._cut_batch(*self._list(stride or self.stride), torch.Generator().manual_seed(0))

    def batches(self, batch_size: int) -> Iterator[Batch]:
        """Yield the windows that `all()` lists, in batches of `batch_size`.

        Args:
            batch_size: largest number of windows in a batch.
        """
        clips, starts = self._list(self.stride)
        generator = torch.Generator().manual_seed(0)
        for rows in torch.arange(len(clips)).split(batch_size):
            yield self._cut_batch(clips[rows], starts[rows], generator)

    def _cut_batch(self, clips: Tensor, starts: Tensor, generator: torch.Generator) -> Batch:
        x = torch.empty(len(clips), self.length, self.size)
        for block in torch.arange(len(clips)).split(512):  # in blocks: limits peak memory to little more than one copy
            x[block] = self._cut(clips[block], starts[block])
        batch = self._batch(x, clips, generator)
        if self._rotations is not None:
            batch["view_inputs"] = {ROTATIONS: self._cut_rotations(clips, starts)}
        return batch

    def at(self, keys: Sequence[tuple[str, str, int]], reason: str = "") -> Windows:
        """Return windows that start at given frames instead of at every stride, for evaluation.

        Args:
            keys: (split, clip, first frame) of each window, in any order; a window may be given twice.
            reason: which windows these are, for titles of tables.

        Raises:
            ValueError: no window is given, a clip is unknown or too short, or a window begins or ends outside it.
        """
        indices = {clip.key: index for index, clip in enumerate(self.clips)}
        for split, clip, start in keys:
            if (split, clip) not in indices:
                raise ValueError(f"no clip {split}/{clip} of at least {self.length} frames in {self}")
            if not 0 <= start < (count := int(self._starts[indices[split, clip]])):
                raise ValueError(f"a window of {split}/{clip} starts at frame {start}, expected 0 to {count - 1}")
        if not keys:
            raise ValueError("`keys` is empty; give at least one window")
        windows = copy(self)
        clips = torch.tensor([indices[split, clip] for split, clip, _ in keys])
        windows._listed, windows._reason = (clips, torch.tensor([start for *_, start in keys])), reason
        return windows

    def poses(self) -> Tensor:
        """Return every frame of the clips once, (N, D) float32, represented like the first frame of a window.

        Frames with missing joints are left out.
        """
        parts = (tensor_of(block) for frames in self._frames for block in blocks(frames))
        poses = torch.cat([self._represent(part[:, None], 0)[:, 0] for part in parts])
        return poses[poses.isfinite().all(-1)] if self.missing else poses

    @property
    def label_names(self) -> list[str]:
        """Sorted names of the labels of the clips."""
        return sorted(self._named.union(*(clip.labels for clip in self.clips)))

    def clip_labels(self, name: str) -> list[str | None]:
        """Return the label of every clip; None if it has none.

        The labels "action" and "group" of Human3.6M follow from the names of its clips, unless the file has them
        (`dvae.motion.data.actions`).

        Args:
            name: name of the label, such as "action".

        Raises:
            ValueError: the name of a clip of Human3.6M is not an action.
        """
        return [human36m_label(clip, name) if name in self._named else clip.labels.get(name) for clip in self.clips]

    def labels(self, name: str) -> list[str]:
        """Return the label of every listed window's clip, as `clip_labels`; an empty string if the clip has none.

        Args:
            name: name of the label, such as "action".

        Raises:
            KeyError: no clip has such a label.
            ValueError: the name of a clip of Human3.6M is not an action.
        """
        if name not in self.label_names:
            raise KeyError(f"no clip has the label {name!r}; the labels are {', '.join(self.label_names) or 'none'}")
        labels = self.clip_labels(name)
        return [labels[c] or "" for c in self._list(self.stride)[0].tolist()]

    def classified(self, variable: str, label: str, classes: Sequence[str]) -> Windows:
        """Return these windows with classes in their batches: {variable: (B,)} int64, indices of `classes`.

        Args:
            variable: name in batches.
            label: name of the clip label that gives the class.
            classes: possible values of the label.

        Raises:
            ValueError: a clip does not have the label, or its value is not one of the classes.
        """
        labels = self.clip_labels(label)
        for clip, value in zip(self.clips, labels, strict=True):
            if value not in classes:
                has = "has no label" if value is None else f"has {value!r} for"
                raise ValueError(
                    f"clip {'/'.join(clip.key)} ({self.split}) {has} {label!r}, expected one of {', '.join(classes)}: "
                    "is labels.csv next to the file, does it list every clip, and do training clips have every class?"
                )
        windows = copy(self)
        indices = [classes.index(value) for value in labels]
        windows._classes = {**self._classes, variable: torch.tensor(indices)}
        return windows

    def positions(self, x: Tensor) -> Tensor:
        """Return joint positions (..., T, J, 3) of frames (..., T, D), for drawings and bone lengths.

        A dropped root is added at the origin.

        Args:
            x: frames (..., T, D).

        Raises:
            ValueError: D does not match the skeleton.
        """
        if x.shape[-1] != self.size:
            raise ValueError(
                f"frames have {x.shape[-1]} numbers, expected {self.size} for {self.skeleton.joints} joints "
                f"and root={self.protocol.root!r}"
            )
        return self.skeleton.with_root(x.unflatten(-1, (-1, 3)))

    def fill_missing(self, positions: Tensor) -> MotionSet:
        """Return the original clips, with missing joints filled from the listed windows.

        Windows are moved and rotated back to the place where they were cut. A missing root is interpolated linearly. If
        several windows cover a missing joint, the first one fills it; joints that no window covers stay missing.

        Args:
            positions: (N, T, J, 3) of complete windows, in the format of `positions`.
        """
        clips, starts = self._list(self.stride)
        frames = (self._first[clips] + starts)[:, None] + torch.arange(self.length)
        positions_of_clips = torch.from_numpy(np.concatenate(self._frames))
        for rows, filled in zip(frames, self.to_world(positions), strict=True):
            positions_of_clips[rows] = torch.where(
                positions_of_clips[rows].isfinite(), positions_of_clips[rows], filled.to(positions_of_clips)
            )
        by_clip = positions_of_clips.split([clip.frames for clip in self.clips])
        filled_clips = [
            replace(clip, positions=positions_of_clip.numpy())
            for clip, positions_of_clip in zip(self.clips, by_clip, strict=True)
        ]
        return MotionSet(filled_clips, self.skeleton, missing=bool(positions_of_clips.isnan().any()))

    def to_world(self, positions: Tensor, indices: Sequence[int] | slice = slice(None)) -> Tensor:
        """Return positions (..., N, T, J, 3) of listed windows in the coordinates of their clips.

        Args:
            positions: result of `positions`. If the protocol drops the root, all T frames of each window; otherwise any
                number of frames.
            indices: indices of the N windows in `keys`; default: all.
        """
        clips, starts = (values[indices] for values in self._list(self.stride))
        joints, root = cut_windows(self._frames, clips, starts, self.length), self.skeleton.root
        if self.protocol.heading:
            heading = self.skeleton.heading_near(joints, self.protocol.observed - 1)[:, None, None]
            positions = rotate_about_up(positions, heading, self.skeleton.up)
        roots = joints[:, :, root : root + 1]
        is_known = roots.isfinite()
        if self.protocol.root == "drop":
            return positions + interpolate_missing(roots.flatten(2), is_known.flatten(2))[:, :, None]
        return positions + roots.take_along_dim(is_known.all(-1).byte().argmax(1, keepdim=True)[..., None], 1)

    def given(self, joints: Sequence[str] | float) -> Windows:
        """Return these windows with trajectories in their batches: {"y": (B, T, D)}, x at given joints, 0 elsewhere.

        Args:
            joints: names of the given joints, as in `Skeleton.find`; or the probability that a joint is given in a
                whole window, drawn independently for each window and joint. `all` uses the same draws every time.

        Raises:
            ValueError: a joint is unknown, the protocol drops it, or the probability is not in [0, 1].
        """
        windows = copy(self)
        if isinstance(joints, float | int):
            if not 0 <= joints <= 1:
                raise ValueError(f"the probability that joints are given must be between 0 and 1, got {joints}")
            windows._given = float(joints)
            return windows
        if isinstance(joints, str):
            raise ValueError(f"joints must be a list of names, such as [{joints!r}]")
        names = {self.skeleton.names[self.skeleton.find(joint)] for joint in joints}
        if dropped := names - set(self.joints):
            raise ValueError(
                f"the joint {dropped.pop()} cannot be given, because the protocol {self.protocol.name} drops the root; "
                "choose other joints, or a protocol with root='relative'"
            )
        windows._given = torch.tensor([float(name in names) for name in self.joints])
        return windows

    @property
    def joints(self) -> list[str]:
        """Names of the joints in a frame: all joints, without the root if the protocol drops it."""
        names, root = self.skeleton.names, self.skeleton.root
        return [name for j, name in enumerate(names) if self.protocol.root != "drop" or j != root]

    @property
    def columns(self) -> list[str]:
        """Names of the D numbers of a frame, such as Head_x."""
        return [f"{joint}_{axis}" for joint in self.joints for axis in "xyz"]

    @property
    def given_joints(self) -> tuple[str, ...] | None:
        """Names of the joints whose trajectories are in the batches; None if they differ between windows."""
        if not isinstance(self._given, Tensor):
            return None
        return tuple(name for name, is_given in zip(self.joints, self._given.tolist(), strict=True) if is_given)

    references: ClassVar = {"zero velocity": "last value", "nearest neighbours": "nearest neighbours"}
    """Reference forecasts, by their names in motion papers (`inference.evaluation.references`)."""

    @property
    def description(self) -> dict[str, Any]:
        """Names of all joints and of the joints whose paths are given, for the record of an evaluation."""
        description: dict[str, Any] = {
            "joints": list(self.skeleton.names),
            "title": [],
            "axis_names": ["clip", "frame"],
        }
        if (given := self.given_joints) is not None:
            description |= {"given": list(given), "title": [f"given {', '.join(given) or 'no paths'}"]}
        if self._reason:
            description["title"] = [*description["title"], self._reason]
        return description

    def with_protocol(self, protocol: Protocol) -> Windows:
        """Return these windows, cut by another protocol that splits clips and counts frames in the same way.

        Args:
            protocol: the other protocol.
        """
        windows = copy(self)
        windows.protocol = protocol
        return windows

    def _batch(self, x: Tensor, clips: Tensor, generator: torch.Generator) -> Batch:
        """Return the batch of windows, with classes, mask and trajectories."""
        mask_of_x, x = x.isfinite(), x.nan_to_num(0.0)
        batch = Batch({"x": x, **{variable: classes[clips] for variable, classes in self._classes.items()}})
        if self.missing:
            batch["mask"] = mask_of_x
        if self._given is not None:
            mask = self._given
            if not isinstance(mask, Tensor):
                mask = (torch.rand(len(x), self.size // 3, generator=generator) < mask).float()
            mask = mask.repeat_interleave(3, dim=-1)
            batch["y"] = x * (mask if mask.dim() == 1 else mask[:, None])
        return batch

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the protocol, the skeleton, the keys of the listed windows and the data that are read."""
        protocol = astuple(self.protocol)  # omits `representation` for positions: keeps older fingerprints valid
        protocol = protocol if self._rotations is not None else protocol[:-1]
        digest = hashlib.sha256(repr((protocol, self.split, self.length)).encode())
        names, parents, up = self.skeleton.names, self.skeleton.parents, self.skeleton.up
        digest.update(f"({names!r}, {parents!r}, {up!r}, ".encode())
        hash_list(digest, self._keys(self.stride))
        digest.update(b")")
        for frames in self._frames:
            hash_values(digest, frames, "<f4")
        if self._rotations is not None and self._rest:  # only rotations from files: estimates differ between machines
            digest.update(repr(self._rest).encode())
            for clip in self.clips:
                if clip.rotations is not None:
                    hash_values(digest, clip.rotations, "<f4")
        for variable, classes in self._classes.items():
            digest.update(repr((variable, classes.tolist())).encode())
        if self._given is not None:
            given = self._given.tolist() if isinstance(self._given, Tensor) else self._given
            digest.update(repr(("given", given)).encode())
        return digest.hexdigest()

    def _keys(self, stride: int) -> Iterator[tuple[str, str, int]]:
        """Yield the keys of the listed windows one at a time, because there may be as many as frames."""
        if self._listed is not None:
            clips, starts = (values.tolist() for values in self._list(stride))
            yield from ((*self.clips[clip].key, start) for clip, start in zip(clips, starts, strict=True))
            return
        for clip, first, count in zip(self.clips, self._first.tolist(), self._starts.tolist(), strict=True):
            for starts in torch.arange(0, count, _at_least_one(stride)).split(4096):
                kept_starts = starts[self._has_usable_frames(first + starts)] if self.missing else starts
                yield from ((*clip.key, start) for start in kept_starts.tolist())

    def _list(self, stride: int) -> tuple[Tensor, Tensor]:
        """Return the clip index and first frame of every listed window."""
        stride = _at_least_one(stride)
        if self._listed is not None:
            if stride != self.stride:
                raise ValueError(f"windows at chosen frames have no other stride than {self.stride}, got {stride}")
            return self._listed
        counts = (self._starts + stride - 1) // stride
        clips = torch.repeat_interleave(counts)
        starts = stride * (torch.arange(len(clips)) - (counts.cumsum(0) - counts)[clips])
        if self.missing:
            is_usable = self._has_usable_frames(self._first[clips] + starts)
            clips, starts = clips[is_usable], starts[is_usable]
        return clips, starts

    def _has_usable_frames(self, first: Tensor) -> Tensor:
        """Return whether windows have usable frames in both parts; `first` counts frames over all clips."""
        before, now, after = (
            self._usable_before[first + n] for n in (0, min(self.protocol.observed, self.length), self.length)
        )
        return (before < now) & ((now < after) | (self.length <= self.protocol.observed))

    def _cut(self, clips: Tensor, starts: Tensor) -> Tensor:
        """Return copied windows (B, T, D) in the protocol's representation, for clips (B,) and first frames (B,)."""
        return self._represent(cut_windows(self._frames, clips, starts, self.length), self.protocol.observed - 1)

    def _represent(self, joints: Tensor, now: int) -> Tensor:
        """Return frames (B, T, D) of joints (B, T, J, 3); if headings are fixed, frame `now` has heading zero."""
        root = self.skeleton.root
        if self.protocol.heading:
            heading = self.skeleton.heading_near(joints, now)[:, None, None]
        if self.protocol.root == "drop":
            joints = self.skeleton.without_root(joints - joints[:, :, root : root + 1])
        else:
            origin = joints[:, :, root].isfinite().all(-1).byte().argmax(1)  # the first frame with an observed root
            joints = joints - joints[:, :, root : root + 1].take_along_dim(origin[:, None, None, None], 1)
        if self.protocol.heading:
            joints = rotate_about_up(joints, -heading, self.skeleton.up)
        return joints.flatten(-2)

    def _cut_rotations(self, clips: Tensor, starts: Tensor, angle: Tensor | None = None) -> Tensor:
        """Return rotations (B, T, 4 J) of the joints in windows; the root is rotated together with its window."""
        assert self._rotations is not None
        rotations, root = cut_windows(self._rotations, clips, starts, self.length), self.skeleton.root
        if self.protocol.heading:
            angle = -self.skeleton.heading(
                cut_windows(self._frames, clips, starts + self.protocol.observed - 1, 1)[:, 0]
            )
        if angle is not None:
            axes = rotate_about_up(torch.eye(3).expand(len(rotations), 3, 3), angle.reshape(-1, 1), self.skeleton.up).mT
            world = to_matrix(rotations[:, :, root], "quaternion")
            rotations[:, :, root] = continuous(from_matrix(axes[:, None] @ world, "quaternion"), dim=1)
        return rotations.flatten(-2)


def _at_least_one(stride: int) -> int:
    if stride < 1:
        raise ValueError(f"stride is {stride}, expected 1 or more")
    return stride
