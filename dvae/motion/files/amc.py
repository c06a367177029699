"""ASF/AMC, Acclaim's skeletons and motions, and the text files of exponential maps of two benchmarks.

A bone of an ASF file has a direction, a length and its own axes. The rows of an AMC file rotate it about these axes, by
C M C^-1 relative to its parent. C is the matrix of its axes, and M the rotation in the row, with the first angle
applied first. Here a joint is at the start of its bone and has the name of the bone. An additional joint is at the end
of each bone without children.

If the file contains `length 0.45`, a unit is 1 / 0.45 inch (frequently asked questions of mocap.cs.cmu.edu).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import pi
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..geometry.rotations import from_matrix, to_matrix
from ..geometry.skeleton import HUMAN36M_ANGLES
from .recording import END, Recording, check_joints, check_size, numbers, read_lines

INCH = 0.0254
FPS = 120.0
"""Frames per second of CMU's recordings, which the files do not contain."""


Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Bone:
    """One bone: name of its parent, vector from start to end in the unit of the file, own axes (3, 3), rotation axes.

    The rotation axes are letters in the order of the channels, such as "zx".
    """

    parent: str
    vector: Vector
    axes: Tensor
    axis_order: str


def joints_of(bones: Mapping[str, Bone]) -> tuple[list[str], list[int], np.ndarray]:
    """Return names, parents and offsets (J, 3) of joints: starts of bones and ends of childless bones, depth first."""
    below: dict[str, list[str]] = {"root": []}
    for name, bone in bones.items():
        below[name] = []
        below[bone.parent].append(name)
    names: list[str] = []
    parents, offsets = [], []
    waiting: list[tuple[str, int, Vector]] = [("root", -1, (0.0, 0.0, 0.0))]
    while waiting:
        name, parent, offset = waiting.pop()
        index = len(names)
        names.append(name)
        parents.append(parent)
        offsets.append(offset)
        if name in below:
            vector = bones[name].vector if name in bones else (0.0, 0.0, 0.0)
            waiting += [(child, index, vector) for child in reversed(below[name] or [name + END])]
    return names, parents, np.array(offsets)


def read_asf(path: str | Path) -> tuple[dict[str, Bone], float, bool, str]:
    """Return the bones, the unit in metres, whether angles are in degrees, and the channels of the root.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is not ASF, or damaged.
    """
    path = Path(path)
    sections: dict[str, dict[str, list[str]]] = {}
    parent_of: dict[str, str] = {}
    section = ""
    bone: dict[str, list[str]] = {}
    settings: dict[str, list[str]] = {}
    for number, line in enumerate(read_lines(path), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        if words[0].startswith(":"):
            section, bone = words[0].lower(), {}
        elif section in (":units", ":root"):
            settings[words[0].lower()] = words[1:]
        elif section == ":bonedata":
            if words[0] == "begin":
                bone = {}
            elif words[0] == "end":
                if not {"name", "direction", "length"} <= bone.keys() or not bone["name"]:
                    raise ValueError(f"{path}: line {number} ends a bone without name, direction and length")
                sections[bone["name"][0]] = bone
                check_joints(path, 2 * len(sections))
            else:
                bone[words[0].lower()] = words[1:]
        elif section == ":hierarchy" and words[0] not in ("begin", "end"):
            parent_of |= dict.fromkeys(words[1:], words[0])
    if not sections:
        raise ValueError(f"{path}: not an ASF file: it has no :bonedata")
    degrees = settings.get("angle", ["deg"])[:1] != ["rad"]

    def values(words: Sequence[str], count: int, label: str) -> np.ndarray:
        values_read = numbers(" ".join(words[:count]), f"{path}: {label}")
        if len(values_read) != count:
            raise ValueError(f"{path}: {label} has {len(values_read)} numbers, expected {count}")
        return values_read

    bones = {}
    for name in _bones_in_order(path, parent_of):
        if name not in sections:
            raise ValueError(f"{path}: the hierarchy has {name[:60]!r}, which :bonedata does not define")
        bone = sections[name]
        length = values(bone["length"], 1, f"length of {name}")[0]
        direction = length * values(bone["direction"], 3, f"direction of {name}")
        axis = bone.get("axis", ["0", "0", "0", "XYZ"])
        angles, order = values(axis, 3, f"axis of {name}"), "".join(axis[3:4]).lower() or "xyz"
        free_axes = "".join(
            channel[1].lower() for channel in bone.get("dof", []) if channel.lower() in ("rx", "ry", "rz")
        )
        if len(free_axes) != len(bone.get("dof", [])) or sorted(order) != ["x", "y", "z"]:
            raise ValueError(
                f"{path}: {name} has axis order {order!r} and dof {bone.get('dof')}; expected an order such as "
                "xyz, and a dof of rx, ry and rz"
            )
        axes = _rotation(torch.from_numpy(np.deg2rad(angles) if degrees else angles), order)
        bones[name] = Bone(parent_of[name], tuple(direction.tolist()), axes, free_axes)
    unit = values(settings.get("length", ["1"]), 1, "length")[0]
    if not 1e-6 < unit < 1e6:
        raise ValueError(f"{path}: length is {unit:g}, expected a positive number of units per inch")
    order = " ".join(settings.get("order", ["TX", "TY", "TZ", "RX", "RY", "RZ"])).lower()
    if sorted(order.split()) != ["rx", "ry", "rz", "tx", "ty", "tz"]:
        raise ValueError(f"{path}: the root's order is {order[:60]!r}, expected TX, TY, TZ, RX, RY and RZ, once each")
    return bones, INCH / unit, degrees, order


def read_amc(path: str | Path) -> Recording:
    """Read an AMC file.

    Its skeleton is the ASF file in the same folder whose name begins the AMC file's name (02.asf of 02_01.amc), or the
    only ASF file there.

    Raises:
        FileNotFoundError: the file does not exist, or its folder has no matching ASF file.
        ValueError: the file is not AMC, is damaged, or does not match the skeleton; the message contains the frame or
            line.
    """
    path = Path(path)
    skeleton = _skeleton_of(path)
    bones, metres, degrees, order = read_asf(skeleton)
    names, parents, offsets = joints_of(bones)
    columns = {"root": 6} | {name: len(bone.axis_order) for name, bone in bones.items() if bone.axis_order}
    values: dict[str, list[str]] = {name: [] for name in columns}
    frames = 0
    for number, line in enumerate(read_lines(path), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        if words[0].startswith(":"):
            degrees = {":degrees": True, ":radians": False}.get(words[0].lower(), degrees)
        elif len(words) == 1 and words[0].isdecimal():
            short = [name for name, rows in values.items() if len(rows) != frames * columns[name]]
            if short:
                raise ValueError(f"{path}: frame {frames} has no row for the bone {short[0]} of {skeleton}")
            frames += 1
            check_size(path, frames, len(names))
        elif len(words) - 1 != columns.get(words[0]) or len(values[words[0]]) != (frames - 1) * columns[words[0]]:
            raise ValueError(
                f"{path}: line {number} is {line.strip()[:60]!r}, expected one row per frame for each bone "
                f"of {skeleton}, with one number per channel of the bone"
            )
        else:
            values[words[0]] += words[1:]
    angles_of = {}
    for name, count in columns.items():
        if not frames or len(values[name]) != frames * count:
            raise ValueError(f"{path}: frame {frames} has no row for the bone {name} of {skeleton}")
        angles_of[name] = torch.from_numpy(numbers(" ".join(values[name]), f"{path}: {name}").reshape(frames, count))
    channels = order.split()
    root = angles_of["root"]
    root_position = root[:, [channels.index(f"t{axis}") for axis in "xyz"]]
    turning = [column for column, channel in enumerate(channels) if channel[0] == "r"]
    rotations = torch.eye(3, dtype=torch.float64).repeat(frames, len(names), 1, 1)

    def radians(angles: Tensor) -> Tensor:
        return torch.deg2rad(angles) if degrees else angles

    rotations[:, 0] = _rotation(radians(root[:, turning]), "".join(channels[column][1] for column in turning))
    for name, bone in bones.items():
        if bone.axis_order:
            rotations[:, names.index(name)] = (
                bone.axes @ _rotation(radians(angles_of[name]), bone.axis_order) @ bone.axes.mT
            )
    places = torch.from_numpy(offsets).repeat(frames, 1, 1)
    places[:, 0] = root_position
    return Recording.turned(names, parents, places, rotations, fps=FPS, metres=metres, up="y")


SUBJECT_02 = {
    "lhipjoint": ("root", 1.65674, -1.80282, 0.62477),
    "rhipjoint": ("root", -1.6107, -1.80282, 0.62476),
    "lowerback": ("root", 0.01961, 2.0545, -0.14112),
    "lfemur": ("lhipjoint", 2.5972, -7.13576, 0),
    "ltibia": ("lfemur", 2.49236, -6.8477, 0),
    "lfoot": ("ltibia", 0.19704, -0.54136, 2.14581),
    "ltoes": ("lfoot", 0, 0, 1.11249),
    "rfemur": ("rhipjoint", -2.59502, -7.12977, 0),
    "rtibia": ("rfemur", -2.4678, -6.78024, 0),
    "rfoot": ("rtibia", -0.23024, -0.63258, 2.13368),
    "rtoes": ("rfoot", 0, 0, 1.11569),
    "upperback": ("lowerback", 0.01021, 2.06436, -0.05921),
    "thorax": ("upperback", 0.00151, 2.06805, 0.00804),
    "lowerneck": ("thorax", 0.00713, 1.56711, 0.14968),
    "lclavicle": ("thorax", 3.54205, 0.90436, -0.17364),
    "rclavicle": ("thorax", -3.49802, 0.75994, -0.32616),
    "upperneck": ("lowerneck", 0.03429, 1.56041, -0.10006),
    "head": ("upperneck", 0.01305, 1.6256, -0.05265),
    "lhumerus": ("lclavicle", 4.86513, 0, 0),
    "lradius": ("lhumerus", 3.35554, 0, 0),
    "lwrist": ("lradius", 1.67777, 0, 0),
    "lhand": ("lwrist", 0.66117, 0, 0),
    "lthumb": ("lwrist", 0.5412, 0, 0.5412),
    "lfingers": ("lhand", 0.53306, 0, 0),
    "rhumerus": ("rclavicle", -5.02649, 0, 0),
    "rradius": ("rhumerus", -3.36431, 0, 0),
    "rwrist": ("rradius", -1.68216, 0, 0),
    "rhand": ("rwrist", -0.73041, 0, 0),
    "rthumb": ("rwrist", -0.59786, 0, 0.59786),
    "rfingers": ("rhand", -0.58887, 0, 0),
}
"""Parents and vectors of the bones of CMU's subject 02 in 1 / .45 inch; the benchmark uses it for all people."""


def read_expmap(path: str | Path) -> Recording:
    """Read exponential maps: rows of 117 numbers (the CMU benchmark) or of 99 (Human3.6M), one for each frame.

    A row has a position and the rotation vectors of the root and of the joints, for row vectors, so their sign is
    reversed here.

    CMU: the first row is a rest pose, not a frame, and is left out. The root rotation in the file composes the angles
    of the AMC file in the wrong order (z x y instead of z y x). This tilts people who face away from +z. The angles are
    extracted and composed again in the right order.

    Human3.6M: the files of Jain et al., 2016, arXiv 1511.05298 (h3.6m.zip), such as S5/walking_1.txt, at 50 Hz. The
    first six numbers are the movement of the root since the last frame, in its own axes. They are added up from the
    origin and from an upright pose. All subjects have the bones of `HUMAN36M_ANGLES`. The name of the file without its
    number is the label "action".

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file has another format, or is damaged.
    """
    path = Path(path)
    lines = [line for line in read_lines(path) if line.strip()]
    is_human36m = bool(lines) and len(lines[0].replace(",", " ").split()) == 3 + 3 * HUMAN36M_ANGLES.joints
    values = numbers(" ".join(lines).replace(",", " "), str(path))
    return _human36m(path, values) if is_human36m else _cmu(path, values)


def _cmu(path: Path, values: np.ndarray) -> Recording:
    """Return the recording in a file of the CMU benchmark."""
    bones = {name: Bone(parent, (x, y, z), torch.eye(3), "") for name, (parent, x, y, z) in SUBJECT_02.items()}
    names, parents, offsets = joints_of(bones)
    rows, remainder = divmod(len(values), 3 + 3 * len(names))
    if remainder or rows < 2:
        raise ValueError(
            f"{path}: got {len(values):,} numbers, expected rows of {3 + 3 * HUMAN36M_ANGLES.joints} (Human3.6M), or "
            f"two or more rows of {3 + 3 * len(names)}, first a rest pose (CMU)"
        )
    check_size(path, rows, len(names))
    vectors = torch.from_numpy(values).reshape(rows, -1, 3)[1:]
    rotations = to_matrix(-vectors[:, 1:], "vector")
    z, x, y = from_matrix(rotations[:, 0], "euler-zxy").unbind(-1)
    # of the two equivalent triples of angles, AMC files use the one with a small middle angle y
    is_other = y.abs() > pi / 2
    z, x, y = torch.where(is_other, pi + z, z), torch.where(is_other, pi - x, x), torch.where(is_other, pi + y, y)
    rotations[:, 0] = to_matrix(torch.stack([z, y, x], -1), "euler-zyx")
    places = torch.from_numpy(offsets).repeat(rows - 1, 1, 1)
    places[:, 0] = vectors[:, 0]
    return Recording.turned(names, parents, places, rotations, fps=FPS, metres=INCH / 0.45, up="y")


def _human36m(path: Path, values: np.ndarray) -> Recording:
    """Return the recording in a file of Human3.6M's exponential maps."""
    skeleton = HUMAN36M_ANGLES
    rows, remainder = divmod(len(values), 3 + 3 * skeleton.joints)
    if remainder:
        raise ValueError(
            f"{path}: got {len(values):,} numbers, expected rows of {3 + 3 * skeleton.joints} as in its first line"
        )
    check_size(path, rows, skeleton.joints)
    vectors = torch.from_numpy(values).reshape(rows, -1, 3)
    rotations = to_matrix(-vectors[:, 1:], "vector")
    places = (1000 * skeleton.offsets.to(vectors)).repeat(rows, 1, 1)
    turn, place = torch.eye(3).to(vectors), torch.zeros(3).to(vectors)
    for row, movement in enumerate(vectors[:, 0]):
        place = place + turn @ movement
        turn = turn @ rotations[row, 0]
        places[row, 0], rotations[row, 0] = place, turn
    action = path.stem.rpartition("_")[0]
    recording = Recording.turned(
        skeleton.names, skeleton.parents, places, rotations, fps=skeleton.fps, metres=0.001, up=skeleton.up
    )
    return replace(recording, skeleton=skeleton, labels={"action": action} if action else {})


def _rotation(angles: Tensor, axes: str) -> Tensor:
    """Return rotations (..., 3, 3) about fixed axes in this order, by angles (..., n) in radians."""
    return to_matrix(angles.flip(-1), f"euler-{axes[::-1]}")


def _bones_in_order(path: Path, parent_of: Mapping[str, str]) -> Iterator[str]:
    """Yield the bones in the order of the file.

    Raises:
        ValueError: a bone does not descend from the root.
    """
    reached = {"root"}
    for name, parent in parent_of.items():
        if parent not in reached:
            raise ValueError(
                f"{path}: the parent of {name[:60]!r} is {parent[:60]!r}, which is not in the hierarchy before it"
            )
        reached.add(name)
        yield name


def _skeleton_of(path: Path) -> Path:
    candidates = sorted(path.parent.glob("*.asf"))
    matching = [file for file in candidates if path.stem.startswith(file.stem)]
    if len(matching or candidates) != 1:
        raise FileNotFoundError(
            f"{path}: cannot choose its skeleton among {len(matching or candidates)} ASF files in the folder; expected "
            "one whose name begins the name of the AMC file, such as 02.asf for 02_01.amc"
        )
    return (matching or candidates)[0]
