"""C3D, the markers of optical motion capture (The C3D File Format, Motion Lab Systems 2021); only positions are read.

Existing readers in C and C++ crash the whole process on a damaged file. This reader raises an error.
"""

from __future__ import annotations

import itertools
import struct
from math import prod
from pathlib import Path

import numpy as np
import scipy

from ... import files
from .recording import MOST_TEXT, Recording, check_joints, check_size

MOST_DISTANCES = 2**23
"""Maximum number of distances used to find a tree: a hundred markers in 800 frames."""

METRES = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254, "inch": 0.0254, "ft": 0.3048}
_BLOCK, _MOST_BLOCKS = 512, 255  # bytes of a block, and maximum number of parameter blocks, which is stored in one byte
_OUTPUTS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "REACTIONS", "SCALARS")
"""Parameters of the group POINT that list points computed by a body model; these points are not positions."""
_ORDERS = {84: "<", 86: ">"}  # byte orders of Intel and MIPS; the DEC format (85) dates from the 1980s


def read_c3d(path: str | Path) -> Recording:
    """Read the labelled markers of a C3D file, and connect them by a tree.

    Markers have no skeleton. The tree is the minimum spanning tree over the variation of all pairwise distances, rooted
    at the central marker, so that neighbours are at nearly constant distance. A marker was not observed, and is NaN, if
    its residual is negative, or if its position and residual are exactly zero. Points without a name are left out. So
    are points that the file lists as angles, forces, moments, powers, reactions or scalars. The notes of the recording
    name all of these points.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is not C3D, is damaged, or has no markers.
    """
    path = Path(path)
    if not path.is_file():  # excludes pipes, which might never end
        raise FileNotFoundError(f"{path}: no such file")
    content = files.read(path, MOST_TEXT, links=True)
    if len(content) < _BLOCK or not content[0] or content[1] != 0x50:
        raise ValueError(f"{path}: not a C3D file: its first byte must be a block number above 0, its second byte 80")
    try:
        parameters, order = _parameters(content)
        markers, analog, first, last = struct.unpack_from(f"{order}4H", content, 2)
        scale, start = struct.unpack_from(f"{order}fH", content, 12)
        fps = struct.unpack_from(f"{order}f", content, 20)[0]
    except (struct.error, IndexError, KeyError, UnicodeDecodeError):
        raise ValueError(f"{path}: damaged: its parameters end early or are not valid") from None
    check_joints(path, markers)
    kind = np.dtype(f"{order}f4" if scale < 0 else f"{order}i2")
    row = 4 * markers + analog
    room = max(len(content) - _BLOCK * (start - 1), 0) // (kind.itemsize * row) if row and start else 0
    frames = room if last == 0xFFFF else last - first + 1  # the number of frames exceeds two bytes
    if not 0 < frames <= room or not markers:
        raise ValueError(
            f"{path}: its header has {markers} markers in {frames} frames, but its data have {room} frames"
        )
    check_size(path, frames, markers)
    unit = "".join(parameters.get("UNITS", [])[:1]).lower()
    if unit not in METRES or not 0 < fps < 1e6 or not np.isfinite(scale):
        raise ValueError(
            f"{path}: unit {unit[:40]!r}, rate {fps:g} Hz, scale {scale:g}; expected a unit of {', '.join(METRES)}, "
            "a positive rate and a finite scale"
        )
    numbers = np.frombuffer(content, kind, frames * row, _BLOCK * (start - 1)).reshape(frames, row)
    if last == 0xFFFF:  # zeros may fill the last block
        padding = numbers[frames - (_BLOCK - 1) // (kind.itemsize * row) :]
        frames -= int(np.logical_and.accumulate((padding == 0).all(1)[::-1]).sum())
        numbers = numbers[:frames]
    values = numbers[:, : 4 * markers].reshape(frames, markers, 4).astype(np.float64)
    places: np.ndarray = values[..., :3] * (1 if scale < 0 else scale)
    zero = np.asarray((values == 0).all(-1))
    places[(values[..., 3] < 0) | zero | ~(np.abs(places) < 1e9).all(-1)] = np.nan
    names = _numbered(parameters, "LABELS")[:markers]
    group_names = {name.upper() for name in _numbered(parameters, "TYPE_GROUPS")} - {"LABELS"}
    groups = {*_OUTPUTS, *(name for name in group_names if "MARKER" not in name and not name.endswith("_UNITS"))}
    outputs = {name for group in groups for name in _numbered(parameters, group)}
    named_points = [n for n, name in enumerate(names) if name and name[0] != "*"]
    is_observed = np.asarray(np.isfinite(places).all(2).any(0))
    marker_columns = [n for n in named_points if names[n] not in outputs and is_observed[n]]
    if not marker_columns:
        raise ValueError(f"{path}: it has no named markers with observations")
    left_out = {
        "computed by a model of the body": [names[n] for n in named_points if names[n] in outputs],
        "never observed": [names[n] for n in named_points if names[n] not in outputs and not is_observed[n]],
        "without a name": [f"point {n + 1}" for n in sorted({*range(markers)} - {*named_points}) if is_observed[n]],
    }
    notes = [
        f"{len(points)} points {reason} are left out ({_join_names(points)})"
        for reason, points in left_out.items()
        if points
    ]
    if (count := int(zero[:, marker_columns].sum())) > 0:
        notes.append(f"{count:,} positions that are exactly 0, 0, 0 with residual 0 are read as missing")
    for n in marker_columns:
        if (name := names[n]) in names[:n]:
            names[n] = next(new for number in itertools.count(2) if (new := f"{name}_{number}") not in names)
            notes.append(f"another marker {name} is read as {names[n]}")
    order_of, parents = tree(places[:, marker_columns])
    ordered = [marker_columns[index] for index in order_of]
    ordered_names = [names[n] for n in ordered]
    return Recording(ordered_names, parents, places[:, ordered], fps=fps, metres=METRES[unit], notes=notes)


def _numbered(parameters: dict[str, list[str]], name: str) -> list[str]:
    """Return the texts of a parameter and of its continuations, such as LABELS2; each has at most 255 entries."""
    parts = itertools.takewhile(parameters.__contains__, (f"{name}{n if n > 1 else ''}" for n in itertools.count(1)))
    return [text for part in parts for text in parameters[part]]


def _join_names(names: list[str]) -> str:
    return ", ".join(names[:6]) + ", …" * (len(names) > 6)


def _parameters(content: bytes) -> tuple[dict[str, list[str]], str]:
    """Return the texts of the group POINT by name, and the byte order."""
    start = _BLOCK * (content[0] - 1)
    content = content[start : start + _BLOCK * _MOST_BLOCKS]
    content = content[: _BLOCK * content[2] or None]  # some programs write 0
    order, position, point = _ORDERS[content[3]], 4, None
    texts_by_group: dict[int, dict[str, list[str]]] = {}
    while position < len(content) and content[position]:
        size, group = struct.unpack_from("bb", content, position)
        name = content[position + 2 : position + 2 + abs(size)].decode("latin1").strip().upper()
        start_of_content = position + 2 + abs(size)
        offset = struct.unpack_from(f"{order}H", content, start_of_content)[0]
        if group < 0:
            point = -group if name == "POINT" else point
        elif struct.unpack_from("b", content, start_of_content + 2)[0] == -1:  # a text parameter
            sizes = list(content[start_of_content + 4 : start_of_content + 4 + content[start_of_content + 3]])
            width = sizes[0] if sizes else 1
            begin = start_of_content + 4 + len(sizes)
            text = content[begin : begin + width * prod(sizes[1:])].decode("latin1")
            texts = [text[n : n + width].strip(" \0") for n in range(0, len(text), max(width, 1))]
            texts_by_group.setdefault(group, {})[name] = texts
        if not offset:
            break
        position = start_of_content + offset
    return texts_by_group[point or 0], order


def tree(places: np.ndarray) -> tuple[list[int], list[int]]:
    """Return the markers in breadth-first order, and the index of each parent in that order, -1 for the first.

    Args:
        places: (F, M, 3), NaN where a marker was not observed.
    """
    subset = places[:: -(-len(places) * places.shape[1] ** 2 // MOST_DISTANCES)]
    pairs = np.stack(
        [np.linalg.norm(subset - subset[:, marker, None], axis=-1) for marker in range(subset.shape[1])], 1
    )
    is_known = np.isfinite(pairs)
    count = np.maximum(is_known.sum(0), 1)
    mean = np.where(is_known, pairs, 0).sum(0) / count
    spread = np.sqrt(np.square(np.where(is_known, pairs - mean, 0)).sum(0) / count)
    is_unknown = is_known.sum(0) < 2
    mean, spread = np.where(is_unknown, mean.max() + 1, mean), np.where(is_unknown, spread.max() + 1, spread)
    weights = spread + 1e-3 * mean + 1e-12  # prefers near markers on the same bone; csgraph ignores edges of weight 0
    np.fill_diagonal(weights, 0)
    middle = int(mean.sum(1).argmin())
    graphs = scipy.sparse.csgraph
    order, above = graphs.breadth_first_order(graphs.minimum_spanning_tree(weights), middle, directed=False)
    position_of = {int(marker): position for position, marker in enumerate(order)}
    return order.tolist(), [position_of.get(int(above[marker]), -1) for marker in order]
