"""BVH (Biovision hierarchy): a tree of joints with offsets and channels, then one row of numbers per frame.

Files are read in the same way as animation programs read them. Rotations are about the joint's own axes, in the order
of its channels. Position channels, which any joint may have, replace the joint's offset. End sites become joints, named
after their parents; end sites without length are dropped. Many existing files have errors, such as one row more than
announced; these files are accepted.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from ...files import atomic_write
from ..geometry.rotations import from_matrix, to_matrix
from .recording import END, Recording, check_joints, check_size, numbers, read_lines

_WORD = re.compile(r"[{}]|[^\s{}]+")
_KEYWORDS = {"ROOT", "JOINT", "END", "OFFSET", "CHANNELS", "MOTION", "{", "}"}
_AXES = ("xposition", "yposition", "zposition", "xrotation", "yrotation", "zrotation")


@dataclass
class _Joint:
    name: str
    parent: int
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    channels: list[int] = field(default_factory=list)  # indices into _AXES
    ends: bool = False


def read_bvh(path: str | Path) -> Recording:
    """Read a BVH file.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is not BVH, or damaged; the message contains the line.
    """
    path = Path(path)
    lines = read_lines(path)
    joints, line = _hierarchy(path, lines)
    frames, seconds, line = _header(path, lines, line)
    channels = sum(len(joint.channels) for joint in joints)
    values = numbers(" ".join(lines[line:]), f"{path}: the frames from line {line + 1}")
    rows, remainder = divmod(len(values), channels) if channels else (0, 0)
    if remainder or abs(rows - frames) > 1 or not rows:
        raise ValueError(
            f"{path}: its motion has {len(values):,} numbers, expected {frames:,} frames of {channels} channels each"
        )
    check_size(path, rows, len(joints))
    values = values.reshape(rows, channels)
    offsets = torch.empty(rows, len(joints), 3, dtype=torch.float64)
    rotations = torch.eye(3, dtype=torch.float64).repeat(rows, len(joints), 1, 1)
    orders: dict[str, list[tuple[int, list[int]]]] = {}
    first = 0
    for index, joint in enumerate(joints):
        offsets[:, index] = torch.from_numpy(joint.offset)
        for channel, axis in enumerate(joint.channels, first):
            if axis < 3:
                offsets[:, index, axis] = torch.from_numpy(values[:, channel])
        turning = [(channel, axis - 3) for channel, axis in enumerate(joint.channels, first) if axis >= 3]
        order = "".join("xyz"[axis] for _, axis in turning)
        orders.setdefault(order, []).append((index, [channel for channel, _ in turning]))
        first += len(joint.channels)
    for order, channels_of in orders.items():
        if order:
            indices, columns = [index for index, _ in channels_of], [columns for _, columns in channels_of]
            angles = torch.from_numpy(np.deg2rad(values[:, columns]))
            rotations[:, indices] = to_matrix(angles, f"euler-{order}")
    names, parents = [joint.name for joint in joints], [joint.parent for joint in joints]
    return Recording.turned(names, parents, offsets, rotations, fps=_rate(seconds))


def _rate(seconds: float) -> float:
    """Return frames per second: an integer, or 1000/1001 of one, whose period has the digits of these seconds."""
    unit, rate = 10.0 ** -len(f"{seconds:.12f}".rstrip("0").partition(".")[2]), 1 / seconds
    candidates = (float(round(rate)), round(1.001 * rate) / 1.001)
    error = min(unit, 1.1e-3 * seconds)
    return next((each for each in candidates if each and abs(1 / each - seconds) <= error), rate)


def write_bvh(
    path: str | Path,
    names: list[str],
    parents: list[int],
    offsets: np.ndarray,
    rotations: np.ndarray,
    root: np.ndarray,
    fps: float,
    order: str = "zyx",
) -> None:
    """Write a BVH file in centimetres, the usual unit of animation programs.

    An existing file is replaced only after a complete write. A joint without children gets an end site of length zero,
    because importers require one.

    Args:
        names, parents: joint names and indices of their parents, the root first.
        offsets: (J, 3), rest pose in metres.
        rotations: (F, J, 4), local quaternions w x y z.
        root: (F, 3), position of the root in metres.
        fps: frames per second.
        order: order of the rotation axes.

    Raises:
        ValueError: a name contains white space or a brace, or names repeat.
    """
    for name in names:
        if not name or any(letter.isspace() or letter in "{}" for letter in name):
            raise ValueError(
                f"{path}: a joint name in a BVH file has no white space or braces, got {name!r}; rename it"
            )
        if names.count(name) > 1:
            raise ValueError(f"{path}: {names.count(name)} joints are named {name!r}, expected different names")
    children: list[list[int]] = [[] for _ in names]
    for joint, parent in enumerate(parents):
        if parent >= 0:
            children[parent].append(joint)
    lines, turning = ["HIERARCHY"], []
    axis_names = " ".join(f"{axis.upper()}rotation" for axis in order)

    waiting = [(parents.index(-1), 0)]
    while waiting:
        joint, depth = waiting.pop()
        tab = "\t" * depth
        if joint < 0:
            lines.append(f"{tab}}}")
            continue
        offset = " ".join(f"{100 * value:.6f}" for value in (offsets[joint] if depth else np.zeros(3)))
        turning.append(joint)
        lines += [f"{tab}{'JOINT' if depth else 'ROOT'} {names[joint]}", f"{tab}{{", f"{tab}\tOFFSET {offset}"]
        lines.append(f"{tab}\tCHANNELS {'3 ' if depth else '6 Xposition Yposition Zposition '}{axis_names}")
        if not children[joint]:
            lines += [f"{tab}\t{line}" for line in ("End Site", "{", "\tOFFSET 0.000000 0.000000 0.000000", "}")]
        waiting += [(-1, depth), *((child, depth + 1) for child in reversed(children[joint]))]
    angles = from_matrix(to_matrix(torch.from_numpy(rotations).double(), "quaternion"), f"euler-{order}").numpy()
    rows = np.concatenate([100 * root, np.rad2deg(angles[:, turning]).reshape(len(root), -1)], 1)
    lines += ["MOTION", f"Frames: {len(rows)}", f"Frame Time: {1 / fps:.8f}"]
    with atomic_write(path) as file:
        file.write(("\n".join(lines) + "\n").encode())
        np.savetxt(file, rows, fmt="%.6f")


def _hierarchy(path: Path, lines: list[str]) -> tuple[list[_Joint], int]:
    """Return the joints, parents first, and the index of the line with MOTION; remove this word from `lines`.

    Words may be split over lines arbitrarily, except that the name of a joint, which may have several words, is on one
    line.
    """
    joints: list[_Joint] = []
    open_: list[int] = []  # joints with open braces, the innermost last
    awaits_brace = False  # a joint was named, and its opening brace must follow
    words = ((word, number) for number, line in enumerate(lines, 1) for word in _WORD.findall(line))
    ahead = next(words, None)

    def error(number: int, expected: str) -> ValueError:
        return ValueError(f"{path}: line {number} is {lines[number - 1].strip()[:60]!r}, expected {expected}")

    def following(belongs: Callable[[str, int], bool]) -> list[str]:
        """Return the next words that belong to the current keyword."""
        nonlocal ahead
        following_words = []
        while ahead is not None and belongs(*ahead):
            following_words.append(ahead[0])
            ahead = next(words, None)
        return following_words

    while ahead is not None:
        (word, number), ahead = ahead, next(words, None)
        kind = word.upper()
        if kind == "HIERARCHY" and not joints:
            continue
        if kind == "MOTION":
            if open_ or awaits_brace or not joints:
                raise error(number, "MOTION only after a complete hierarchy")
            lines[number - 1] = lines[number - 1][lines[number - 1].upper().rindex(kind) + len(kind) :]
            return joints, number - 1
        if kind in ("ROOT", "JOINT", "END"):
            if awaits_brace or (kind == "ROOT") == bool(joints) or (kind != "ROOT" and not open_):
                raise error(number, "one ROOT, and JOINT or End Site within its braces")
            line = number if ahead is None else ahead[1]  # line of the name
            label = " ".join(following(lambda word, at: at == line and word != "{"))  # noqa: B023
            parent = open_[-1] if open_ else -1
            name = label if kind != "END" else joints[parent].name + END
            if any(joint.name == name for joint in joints):
                same = sum(joint.name.startswith(name) for joint in joints)
                if kind != "END":
                    raise error(number, f"a unique name; there is another joint {name!r}")
                name += str(same + 1)
            joints.append(_Joint(name, parent, ends=kind == "END"))
            check_joints(path, len(joints))
            awaits_brace = True
        elif kind == "{":
            if not awaits_brace:
                raise error(number, "ROOT, JOINT or End Site before a brace")
            open_.append(len(joints) - 1)
            awaits_brace = False
        elif kind == "}":
            if not open_ or awaits_brace:
                raise error(number, "a closing brace only after its opening brace")
            closed = joints[open_.pop()]
            if closed.ends and closed is joints[-1] and not (closed.offset.any() or closed.channels):
                joints.pop()  # the end coincides with its parent
        elif kind == "OFFSET" and open_ and not awaits_brace:
            offset = numbers(" ".join(following(_is_value)), f"{path}: line {number}")
            if len(offset) != 3:
                raise error(number, "three numbers")
            joints[open_[-1]].offset = offset
        elif kind == "CHANNELS" and open_ and not awaits_brace:
            count, *channels = [word.lower() for word in following(_is_value)] or [""]
            unknown = [channel for channel in channels if channel not in _AXES]
            if unknown or not count.isdecimal() or len(channels) != len(set(channels)) or str(len(channels)) != count:
                raise error(number, "the number of channels, then as many names from Xposition to Zrotation, each once")
            joints[open_[-1]].channels = [_AXES.index(channel) for channel in channels]
        else:
            raise error(number, "ROOT, JOINT, End Site, OFFSET, CHANNELS, MOTION or a brace")
    raise ValueError(f"{path}: not a BVH file: it has no line MOTION")


def _is_value(word: str, _: int) -> bool:
    return word.upper() not in _KEYWORDS


def _header(path: Path, lines: list[str], line: int) -> tuple[int, float, int]:
    """Return the number of frames, the frame time in seconds, and the line where the frames begin."""
    values: list[float] = []
    for expected in ("frames:", "frame time:"):
        text = ""
        while line < len(lines) and len(text) <= len(expected):
            text = " ".join((text + " " + lines[line].lower()).split())
            line += 1
        number_text = text.removeprefix(expected) if text.startswith(expected) else ""
        numbers_read = numbers(number_text, f"{path}: line {line}")
        if len(numbers_read) != 1:
            raise ValueError(f"{path}: line {line} is {text[:60]!r}, expected {expected.capitalize()} and a number")
        values.append(numbers_read[0])
    frames, seconds = values
    if frames != int(frames) or frames < 1 or not 1e-6 < seconds < 1e3:
        raise ValueError(
            f"{path}: it declares {frames:g} frames of {seconds:g} s; expected a whole number and a frame time above 0"
        )
    return int(frames), seconds, line
