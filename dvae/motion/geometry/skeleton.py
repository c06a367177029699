"""Skeletons: the joints, the tree that connects them, and the up axis.

Positions are in metres, (..., joints, 3), right-handed: with y up, a person facing +z has their left side towards +x.
The presets are Human3.6M (17 of its 32 joints) and HumanEva-I (15 joints) as motion prediction papers use them (Mao,
Liu and Salzmann 2021, GSPS).
"""

from __future__ import annotations

import difflib
import io
import json
import reprlib
import unicodedata
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from math import hypot, nan, pi
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TextIO

import networkx as nx
import torch
from torch import Tensor

from ... import files
from ...constants import indices
from ..naming import readings

MOST_JOINTS = 1000
"""Maximum number of joints. A mocap suit has two hundred markers; matrices here grow with the square of the number."""

MOST_TEXT = 2**24
"""Maximum size of a text file in bytes."""


@contextmanager
def text_of(path: Path, most: int = MOST_TEXT) -> Iterator[TextIO]:
    """Open a text file, to be read within the context.

    Args:
        path: path of the file, which may be a link.
        most: maximum size in bytes.

    Raises:
        OSError: the file does not exist.
        ValueError: the file has more than `most` bytes, or is not UTF-8.
    """
    try:
        yield io.TextIOWrapper(io.BytesIO(files.read(path, most, links=True)), encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: is not text ({error}); save it as UTF-8") from error


def brief(value: Any) -> str:
    """Return a value as text, shortened if it is long, deeply nested or a very large number."""
    try:
        return reprlib.repr(value)
    except ValueError:  # more digits than Python converts
        return f"a number of {value.bit_length()} bits" if isinstance(value, int) else type(value).__name__


def is_name(text: str) -> bool:
    """Return whether a text is valid as a name: at most 1000 characters, no control characters, no surrogates."""
    return len(text) <= 1000 and not any(unicodedata.category(letter) in ("Cc", "Cs") for letter in text)


def _join_names(names: Sequence[str]) -> str:
    return ", ".join([*(name if len(name) < 100 else brief(name) for name in names[:8]), *["..."][: len(names) > 8]])


def _is(value: Any, kind: type) -> bool:
    return isinstance(value, kind) and not isinstance(value, bool)


def _values(items: Any, kind: type, label: str, expected: str) -> tuple[Any, ...]:
    """Return the values of a list as a tuple, after checking that each is of type `kind`.

    Args:
        items: values.
        kind: type of each value.
        label: name of the list in error messages.
        expected: description of the type in error messages.

    Raises:
        ValueError: `items` is no list, or an entry has another type.
    """
    if isinstance(items, str | bytes | Mapping) or not isinstance(items, Iterable):
        raise ValueError(f"{label} is {brief(items)}, expected a list of {expected}")
    values = tuple(items)
    for index, value in enumerate(values):
        if not _is(value, kind):
            raise ValueError(f"{label} has {brief(value)} at place {index}, expected {expected}")
        if isinstance(value, str) and not is_name(value):
            raise ValueError(f"{label} has {brief(value)} at place {index}, expected text that can be printed")
    return tuple(map(int, values)) if kind is Integral else values


FIELDS = {
    "name": "name",
    "names": "joint_names",
    "parents": "parents",
    "left": "joints_left",
    "right": "joints_right",
    "up": "up_axis",
    "fps": "fps",
}
"""Fields of a skeleton, and their names in files."""


@dataclass(frozen=True)
class Skeleton:
    """A tree of joints.

    Args:
        names: joint names, all different.
        parents: index of each joint's parent, -1 for the root; in any order.
        left, right: indices of the joints on the body's left and right side.
        up: vertical axis, "y" or "z".
        fps: frames per second of the motion recorded on this skeleton.
        name: name of the skeleton.
        lengths: reference bone lengths in metres, in the order of `edges`; empty if they differ between people.
        rest: flattened offsets (J, 3) of each joint from its parent in the rest pose, in metres, zero for the root;
            empty if the motion has no rotations.

    Raises:
        ValueError: the joints do not form one tree, names repeat, or a side contains an unknown joint.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    left: tuple[int, ...] = ()
    right: tuple[int, ...] = ()
    up: str = "y"
    fps: float = 30.0
    name: str = ""
    lengths: tuple[float, ...] = ()
    rest: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        label = f"skeleton {brief(self.name)}"
        if not isinstance(self.name, str) or not is_name(self.name):
            raise ValueError(f"{label}: its name is not text that can be printed")
        for field, kind, expected in (
            ("names", str, "text"),
            ("parents", Integral, "whole numbers"),
            ("left", Integral, "whole numbers"),
            ("right", Integral, "whole numbers"),
            ("lengths", Real, "numbers"),
            ("rest", Real, "numbers"),
        ):
            object.__setattr__(self, field, _values(getattr(self, field), kind, f"{label}: {field}", expected))
        joints = len(self.names)
        if joints > MOST_JOINTS:
            raise ValueError(f"{label}: {joints:,} joints, expected at most {MOST_JOINTS:,}")
        if len(self.parents) != joints:
            raise ValueError(f"{label}: {joints} names but {len(self.parents)} parents, expected equal numbers")
        if repeated := sorted(name for name, count in Counter(self.names).items() if count > 1):
            raise ValueError(f"{label}: joint names repeat: {_join_names(repeated)}")
        roots = [self.names[j] for j, parent in enumerate(self.parents) if parent == -1]
        if len(roots) != 1:
            raise ValueError(f"{label}: expected one root (parent -1), found {_join_names(roots) or 'none'}")
        for joint, parent in enumerate(self.parents):
            if not -1 <= parent < joints:
                raise ValueError(
                    f"{label}: the parent of {self.names[joint]} is joint {brief(parent)}, "
                    f"but joints go from 0 to {joints - 1}"
                )
        if cyclic := set(range(joints)) - set(self.order):
            raise ValueError(f"{label}: {self.names[min(cyclic)]} is in a cycle of joints, expected a tree")
        for side in ("left", "right"):
            unknown = [j for j in getattr(self, side) if not 0 <= j < joints]
            if unknown:
                raise ValueError(
                    f"{label}: {side} names joints {brief(unknown)} of {joints}, expected indices 0 to {joints - 1}"
                )
        if repeated_joints := [j for j, count in Counter(self.left + self.right).items() if count > 1]:
            raise ValueError(
                f"{label}: left and right name {self.names[repeated_joints[0]]} twice, expected each joint once at most"
            )
        if not isinstance(self.up, str) or self.up not in ("y", "z"):
            raise ValueError(f"{label}: up axis is {brief(self.up)}, expected 'y' or 'z'")
        if not _is(self.fps, Real) or not 0 < self.fps < 1e6:
            raise ValueError(f"{label}: {brief(self.fps)} frames per second, expected a number above 0 and below 1e6")
        if self.lengths and len(self.lengths) != joints - 1:
            raise ValueError(f"{label}: {len(self.lengths)} bone lengths for {joints - 1} bones, expected one per bone")
        if invalid := [length for length in self.lengths if not 0 <= length < 1e6]:
            raise ValueError(f"{label}: a bone is {brief(invalid[0])} m long, expected 0 to 1e6 m")
        if self.rest and len(self.rest) != 3 * joints:
            raise ValueError(
                f"{label}: the rest pose has {len(self.rest)} numbers, expected 3 for each of {joints} joints"
            )
        if invalid := [offset for offset in self.rest if not abs(offset) < 1e6]:
            raise ValueError(
                f"{label}: in the rest pose a joint is {brief(invalid[0])} m from its parent along an axis, expected "
                "less than 1e6 m"
            )

    @property
    def joints(self) -> int:
        """Number of joints J."""
        return len(self.names)

    @property
    def root(self) -> int:
        """Index of the root joint, the pelvis."""
        return self.parents.index(-1)

    def find(self, joint: str) -> int:
        """Return the index of a joint by its name, or by another spelling such as left_wrist for LWrist.

        Args:
            joint: name of the joint.

        Raises:
            ValueError: no joint, or more than one joint, has this name; the message suggests the most similar name.
        """
        joint = str(joint)
        if joint in self.names:
            return self.names.index(joint)
        matches = [index for index, name in enumerate(self.names) if {*readings(name)} & {*readings(joint)}]
        if len(matches) == 1:
            return matches[0]
        names = ["".join(readings(name)[0]) for name in self.names]
        close = difflib.get_close_matches("".join(readings(joint)[0]), names, n=1)
        hint = f" (did you mean {self.names[names.index(close[0])]!r}?)" if close else ""
        raise ValueError(f"no joint {joint!r}{hint}; skeleton {self.name!r} has {', '.join(self.names)}")

    @property
    def edges(self) -> list[tuple[int, int]]:
        """The bones as index pairs (parent, child), in the order of the children."""
        return [(parent, joint) for joint, parent in enumerate(self.parents) if parent != -1]

    @property
    def order(self) -> list[int]:
        """Indices of the joints in breadth-first order, so that parents precede their children."""
        tree = nx.DiGraph(self.edges)
        tree.add_node(self.root)
        return [joint for generation in nx.bfs_layers(tree, self.root) for joint in sorted(generation)]

    @property
    def offsets(self) -> Tensor:
        """The rest pose: offset (J, 3) of each joint from its parent in metres, zero for the root, in float64.

        Raises:
            ValueError: the skeleton has no rest pose.
        """
        if not self.rest:
            raise ValueError(
                f"skeleton {self.name!r} has no rest pose, so its rotations are not defined; "
                "MotionSet.with_rotations() computes both"
            )
        return torch.tensor(self.rest, dtype=torch.float64).reshape(-1, 3)

    @property
    def vertical(self) -> int:
        """Index of the up axis among the three coordinates."""
        return "xyz".index(self.up)

    def without_root(self, joints: Tensor) -> Tensor:
        """Return joints (..., J, 3) without the root, (..., J - 1, 3).

        Args:
            joints: values (..., J, 3).
        """
        return torch.cat([joints[..., : self.root, :], joints[..., self.root + 1 :, :]], -2)

    def with_root(self, joints: Tensor, value: float = 0.0) -> Tensor:
        """Return joints (..., J, 3); if the root is missing, insert it with the given value in all coordinates.

        Args:
            joints: values (..., J, 3) or (..., J - 1, 3).
            value: coordinates of an inserted root.
        """
        if joints.shape[-2] == self.joints:
            return joints
        root = torch.full_like(joints[..., :1, :], value)
        return torch.cat([joints[..., : self.root, :], root, joints[..., self.root :, :]], -2)

    def bone_lengths(self, positions: Any) -> Any:
        """Return bone lengths (..., J - 1) in the order of `edges`, in the unit of the positions.

        Args:
            positions: array or tensor (..., J, 3) of joint positions.

        Raises:
            ValueError: the positions have another shape.
        """
        if positions.shape[-2:] != (self.joints, 3):
            raise ValueError(
                f"positions have shape {tuple(positions.shape)}, expected (..., {self.joints}, 3) for "
                f"skeleton {self.name!r}"
            )
        parents, children = ([edge[end] for edge in self.edges] for end in (0, 1))
        if isinstance(positions, Tensor):
            ends = [positions.index_select(-2, indices(joints, positions)) for joints in (children, parents)]
        else:
            ends = [positions[..., joints, :] for joints in (children, parents)]
        return ((ends[0] - ends[1]) ** 2).sum(-1) ** 0.5

    def limbs(self, poses: Tensor) -> Tensor:
        """Return vectors (..., J - 1, 3) from parent to child in metres, in the order of `edges`.

        Args:
            poses: (..., D), concatenated joint positions in metres: D = 3 J, or D = 3 (J - 1) if the root is at the
                origin and left out.

        Raises:
            ValueError: D has another value.
        """
        incidence = differences(self, tuple(self.edges), poses.shape[-1], poses.dtype, poses.device)
        with torch.autocast(poses.device.type, enabled=False):  # differences of positions need full precision
            bones: Tensor = (poses @ incidence).unflatten(-1, (-1, 3))
        return bones

    def ends(self, limbs: Tensor) -> Tensor:
        """Return the end points of chained limbs with the root at the origin; the inverse of `limbs`.

        Args:
            limbs: (..., J - 1, 3) vectors from parent to child, in the order of `edges`.

        Returns:
            Poses (..., 3 (J - 1)), without the root.
        """
        chains = _chains(self, limbs.dtype, limbs.device)
        with torch.autocast(limbs.device.type, enabled=False):
            poses: Tensor = limbs.flatten(-2) @ chains
        return poses

    def directions(self, poses: Tensor) -> Tensor:
        """Return unit vectors along the limbs (..., 3 (J - 1)) of poses (..., D); zero for a limb of length zero.

        Args:
            poses: poses (..., D) in metres.

        Raises:
            ValueError: D is not valid for `limbs`.
        """
        limbs = self.limbs(poses)
        return (limbs * inverse_lengths(limbs)[..., None]).flatten(-2)

    @property
    def sides(self) -> tuple[list[int], list[int]]:
        """Indices of the joints where the left and the right limbs leave the trunk: hips and shoulders.

        A joint at the place of its parent, such as lhipjoint of CMU's files, counts as the trunk, if bone lengths or a
        rest pose are known.

        Raises:
            ValueError: the skeleton does not define left and right.
        """
        left, right = _leaving(self, self.left), _leaving(self, self.right)
        if not left or not right:
            raise ValueError(
                f"skeleton {self.name!r} has no left and right joints, so it has no heading; give `left` and `right`"
            )
        return left, right

    def heading(self, positions: Tensor) -> Tensor:
        """Return the angle about the up axis, in radians, of the direction that a person faces.

        The left-right axis is the sum over the left joints of `sides` minus the sum over the right joints. At heading
        zero, the left side points towards +x, so the person faces +z if y is up, and -y if z is up.

        Args:
            positions: (..., J, 3); joints of `sides` that are NaN are ignored.

        Returns:
            Angles (...,), NaN if all joints of a side are NaN, or if both sides are at one place.
            `rotate_about_up(positions, -heading[..., None], up)` rotates every pose to heading zero.

        Raises:
            ValueError: the skeleton does not define left and right.
        """
        plane = [(self.vertical + 1) % 3, (self.vertical + 2) % 3]
        level = positions.index_select(-1, indices(plane, positions))
        left, right = (self._side(level.index_select(-2, indices(side, level))) for side in self.sides)
        across = left - right
        towards_x = 0.0 if plane[0] == 0 else pi / 2
        angle = torch.atan2(across[..., 1], across[..., 0]) - towards_x
        return angle.masked_fill((across.abs() < SHORTEST).all(-1), nan)

    def heading_near(self, positions: Tensor, frame: int) -> Tensor:
        """Return the `heading` at a frame of motion with missing joints; 0 if no frame up to it has a heading.

        The heading comes from the frame with the most `sides`, at least one left and one right; of several such frames,
        from the last one. Later frames are not used, so a window that is rotated for a forecast reveals nothing about
        its future.

        Args:
            positions: (..., T, J, 3), NaN where a joint was not observed.
            frame: index of the frame.

        Returns:
            Angles (...,) in radians.
        """
        positions = positions[..., : frame + 1, :, :]
        time = torch.arange(positions.shape[-3], device=positions.device)
        level = positions[..., self.vertical - 1].isfinite()
        left, right = (level.index_select(-1, indices(side, level)).sum(-1) for side in self.sides)
        best_frame = torch.where((left > 0) & (right > 0), time + len(time) * (left + right), -1).argmax(-1)
        pose = positions.take_along_dim(best_frame[..., None, None, None], -3).squeeze(-3)
        return self.heading(pose).nan_to_num(0.0)

    @staticmethod
    def _side(places: Tensor) -> Tensor:
        """Return the sum (..., 2) of positions (..., n, 2), where NaN positions count as the mean of the others."""
        is_known = places.isfinite().all(-1, keepdim=True)
        total: Tensor = torch.where(is_known, places, 0.0).sum(-2) * (is_known.shape[-2] / is_known.sum(-2))
        return total

    @classmethod
    def from_json(cls, path: str | Path) -> Skeleton:
        """Read a skeleton file in the format of `to_json`.

        Args:
            path: path of the file.

        Returns:
            The skeleton.

        Raises:
            FileNotFoundError: the file does not exist.
            ValueError: the file is not a JSON object, has no joint_names or parents, or does not describe a skeleton.
        """
        path = Path(path)
        try:
            with text_of(path) as text:
                fields = json.load(text)
        except RecursionError as error:
            raise ValueError(f"{path}: expected JSON with joint_names and parents (it is nested too deeply)") from error
        except json.JSONDecodeError as error:
            raise ValueError(f"{path}: expected JSON with joint_names and parents ({error})") from error
        except ValueError as error:  # a number with more digits than Python reads
            raise error if str(path) in str(error) else ValueError(f"{path}: {error}") from error
        missing = [key for key in ("joint_names", "parents") if not isinstance(fields, dict) or key not in fields]
        if missing:
            contents = _join_names(list(fields)) if isinstance(fields, dict) else brief(fields)
            raise ValueError(
                f"{path}: expected JSON with joint_names and parents; {missing[0]} is missing, found {contents}"
            )
        try:
            parents = _values(fields["parents"], Integral, "parents", "whole numbers")
            lengths = _values(fields.get("bone_lengths_m", ()), Real, "bone_lengths_m", "numbers")
            if lengths and len(lengths) != len(parents):
                raise ValueError(
                    f"bone_lengths_m has {len(lengths)} entries, expected one for each of {len(parents)} joints"
                )
            known_fields = {field: fields[key] for field, key in FIELDS.items() if key in fields}
            # the file has one entry per joint, zero for the root
            bones = tuple(length for length, parent in zip(lengths, parents, strict=bool(lengths)) if parent != -1)
            rest = fields.get("rest_m", ())
            arguments = {"name": path.absolute().parent.name, **known_fields}
            return cls(**{**arguments, "parents": parents, "lengths": bones, "rest": rest})
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    def to_json(self, path: str | Path) -> None:
        """Write the skeleton as a readable JSON file; an existing file is replaced only after a complete write.

        Args:
            path: path of the file.
        """
        fields = {**{key: getattr(self, field) for field, key in FIELDS.items()}, "units": "m"}
        if self.lengths:
            lengths = iter(self.lengths)
            fields["bone_lengths_m"] = [0.0 if parent == -1 else next(lengths) for parent in self.parents]
        if self.rest:
            fields["rest_m"] = self.rest
        with files.atomic_write(path) as file:
            file.write((json.dumps(fields, indent=2) + "\n").encode())


SHORTEST = 1e-6
"""Length in metres below which a vector has no direction."""


@lru_cache(maxsize=64)
def _leaving(skeleton: Skeleton, side: tuple[int, ...]) -> list[int]:
    """Return the first joints of a side, below those that are at the place of their parents."""
    norms = dict(zip([child for _, child in skeleton.edges], skeleton.lengths, strict=False))
    if skeleton.rest:
        norms = {joint: hypot(*skeleton.rest[3 * joint : 3 * joint + 3]) for joint in side}
    leaving, pending = [], [joint for joint in side if skeleton.parents[joint] not in side]
    while pending:
        joint = pending.pop(0)
        below = [child for child in side if skeleton.parents[child] == joint]
        if norms.get(joint, 1.0) < SHORTEST and below:
            pending = [*below, *pending]
        else:
            leaving.append(joint)
    return leaving


def inverse_lengths(vectors: Tensor, dim: int = -1) -> Tensor:
    """Return the inverse lengths of vectors along a dimension.

    For vectors shorter than `SHORTEST`, they are zero and have no gradient.
    """
    squares = vectors.square().sum(dim)  # linalg.vector_norm is ten times slower over three numbers
    return squares.clamp_min(SHORTEST**2).rsqrt().masked_fill(squares < SHORTEST**2, 0)


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # the cached result must support gradients, even if the first call is in inference mode
def differences(
    skeleton: Skeleton, pairs: tuple[tuple[int, int], ...], size: int, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Return the matrix (D, 3 P) that maps poses (..., D) to the vectors between the joints of P pairs.

    The vectors are concatenated: x, y and z of the first pair, then of the second. One matrix product is ten times as
    fast as gathering both ends and subtracting (measured: 200,000 poses of 48 numbers, forward and backward).

    Args:
        skeleton: skeleton of the poses.
        pairs: indices (from, to) of the joints of each pair.
        size: D.
        dtype, device: dtype and device of the matrix, which is cached and shared.

    Raises:
        ValueError: D is neither 3 J nor 3 (J - 1), which means that the root is at the origin and left out.
    """
    joints = skeleton.joints
    if size not in (3 * joints, 3 * (joints - 1)):
        raise ValueError(
            f"poses have {size} numbers, expected {3 * joints} ({joints} joints of skeleton {skeleton.name!r}) or "
            f"{3 * (joints - 1)} (without the root)"
        )
    incidence = torch.zeros(joints, len(pairs), dtype=dtype, device=device)
    for pair, (start, end) in enumerate(pairs):
        incidence[start, pair] -= 1
        incidence[end, pair] += 1
    if size < 3 * joints:
        incidence = torch.cat([incidence[: skeleton.root], incidence[skeleton.root + 1 :]])
    return torch.kron(incidence, torch.eye(3, dtype=dtype, device=device))


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def _chains(skeleton: Skeleton, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the inverse (D, D) of `differences` for all bones: a joint is the sum of the bones from the root to it."""
    bones = differences(skeleton, tuple(skeleton.edges), 3 * (skeleton.joints - 1), torch.float64, torch.device("cpu"))
    chains: Tensor = torch.linalg.inv(bones).round().to(device, dtype)
    return chains


def rotate_about_up(positions: Tensor, angle: Tensor, up: str) -> Tensor:
    """Return positions (..., 3) rotated about the up axis.

    Args:
        positions: (..., 3).
        angle: angles in radians, which broadcast against (...); positive is counterclockwise seen from above.
        up: up axis, "y" or "z".
    """
    vertical = "xyz".index(up)
    first, second = (vertical + 1) % 3, (vertical + 2) % 3
    cos, sin = torch.cos(angle), torch.sin(angle)
    rotated = positions.clone()
    rotated[..., first] = cos * positions[..., first] - sin * positions[..., second]
    rotated[..., second] = sin * positions[..., first] + cos * positions[..., second]
    return rotated


# fmt: off
HUMAN36M = Skeleton(
    names=(
        "Pelvis", "RHip", "RKnee", "RFoot", "LHip", "LKnee", "LFoot", "Spine", "Thorax", "Neck", "Head", "LShoulder",
        "LElbow", "LWrist", "RShoulder", "RElbow", "RWrist",
    ),
    parents=(-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 9, 8, 11, 12, 8, 14, 15),
    left=(4, 5, 6, 11, 12, 13),
    right=(1, 2, 3, 14, 15, 16),
    up="z",
    fps=50.0,
    name="human36m",
)
# fmt: on
"""The 17 joints of Human3.6M that papers use, as in VideoPose3D's archive: z up, 50 Hz."""

HUMAN36M_KEPT = (0, 1, 2, 3, 6, 7, 8, 12, 13, 14, 15, 17, 18, 19, 25, 26, 27)
"""Indices of the joints of `HUMAN36M` among the 32 joints of that archive; `read_motion` selects these joints."""

# fmt: off
HUMAN36M_ANGLES = Skeleton(
    names=(
        "Pelvis", "RHip", "RKnee", "RFoot", "RToe", "RToeEnd", "LHip", "LKnee", "LFoot", "LToe", "LToeEnd",
        "Waist", "Spine", "Thorax", "Neck", "Head",
        "LClavicle", "LShoulder", "LElbow", "LWrist", "LThumb", "LThumbEnd", "LHand", "LHandEnd",
        "RClavicle", "RShoulder", "RElbow", "RWrist", "RThumb", "RThumbEnd", "RHand", "RHandEnd",
    ),
    parents=(
        -1, 0, 1, 2, 3, 4, 0, 6, 7, 8, 9, 0, 11, 12, 13, 14, 12, 16, 17, 18, 19, 20, 19, 22, 12, 24, 25, 26, 27, 28,
        27, 30,
    ),
    left=(6, 7, 8, 9, 10, 16, 17, 18, 19, 20, 21, 22, 23),
    right=(1, 2, 3, 4, 5, 24, 25, 26, 27, 28, 29, 30, 31),
    up="y",
    fps=50.0,
    name="human36m-angles",
    rest=(
        0, 0, 0, -0.132948591, 0, 0, 0, -0.442894612, 0, 0, -0.454206447, 0, 0, 0, 0.162767078, 0, 0, 0.074999437,
        0.132948826, 0, 0, 0, -0.442894413, 0, 0, -0.45420659, 0, 0, 0, 0.162767426, 0, 0, 0.074999948,
        0, 0.0001, 0, 0, 0.233383263, 0, 0, 0.257077681, 0, 0, 0.121134938, 0, 0, 0.115002227, 0,
        0, 0.257077681, 0, 0, 0.151034226, 0, 0, 0.278882773, 0, 0, 0.251733451, 0, 0, 0, 0, 0, 0, 0.099999627,
        0, 0.100000188, 0, 0, 0, 0,
        0, 0.257077681, 0, 0, 0.151031437, 0, 0, 0.278892924, 0, 0, 0.25172868, 0, 0, 0, 0, 0, 0, 0.099999888,
        0, 0.137499922, 0, 0, 0, 0,
    ),
)
# fmt: on
"""The 32 joints of Human3.6M's exponential maps, with the bones that Martinez, Black and Romero, 2017, arXiv
1705.02445, use for all subjects: y up, 50 Hz. Bones of length 0 end at the same place as they start."""

# fmt: off
HUMANEVA = Skeleton(
    names=(
        "Pelvis", "Thorax", "LShoulder", "LElbow", "LWrist", "RShoulder", "RElbow", "RWrist", "LHip", "LKnee",
        "LAnkle", "RHip", "RKnee", "RAnkle", "Head",
    ),
    parents=(-1, 0, 1, 2, 3, 1, 5, 6, 0, 8, 9, 0, 11, 12, 1),
    left=(2, 3, 4, 8, 9, 10),
    right=(5, 6, 7, 11, 12, 13),
    up="z",
    fps=60.0,
    name="humaneva",
)
# fmt: on
"""HumanEva-I's 15 joints: z up, 60 Hz."""

WALKER = Skeleton(HUMAN36M.names, HUMAN36M.parents, HUMAN36M.left, HUMAN36M.right, "y", 30.0, "walker")
"""The skeleton of `simulate`: the joints of `HUMAN36M`, with y up, 30 Hz."""
