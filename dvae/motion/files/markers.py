"""C3D, the markers of optical motion capture, read by ezc3d (Michaud and Begon 2021); the extra `c3d` installs it."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from .recording import Recording, check_joints, check_size

MOST_DISTANCES = 2**23
"""From which a tree is found: of a hundred markers, in 800 frames."""

METRES = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254, "inch": 0.0254, "ft": 0.3048}


def read_c3d(path: str | Path) -> Recording:
    """Read the labelled markers of a C3D file, and the tree that holds them best together.

    Markers have no skeleton. Here one hangs from another where their distance hardly changes: the minimum spanning tree
    over the spread of all distances, from the marker in the middle. A marker that is not seen is NaN.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is none, or damaged; or has no markers.
        RuntimeError: ezc3d is not installed.
    """
    path = Path(path)
    _check(path)
    try:
        import ezc3d
    except ImportError:
        raise RuntimeError(f"{path}: markers are read by ezc3d; pip install 'pyro-dvae[c3d]'") from None
    try:
        found = ezc3d.c3d(str(path))
        points, said = found["data"]["points"], found["parameters"]["POINT"]
        names = [str(name).strip() for name in said["LABELS"]["value"]]
        unit, fps = str(said["UNITS"]["value"][0]).strip().lower(), float(said["RATE"]["value"][0])
    except (RuntimeError, ValueError, KeyError, IndexError, TypeError, OSError, OverflowError, MemoryError) as error:
        raise ValueError(f"{path}: damaged, or no C3D file ({str(error)[:200]!r})") from None
    if unit not in METRES or not 0 < fps < 1e6:
        raise ValueError(f"{path}: markers in {unit[:40]!r} at {fps:g} Hz, expected one of {', '.join(METRES)}")
    named = [place for place, name in enumerate(names[: points.shape[1]]) if name and not name.startswith("*")]
    named = [place for place in named if names[place] not in names[:place]]
    places = np.ascontiguousarray(points[:3, named].transpose(2, 1, 0))
    seen = np.isfinite(places).all(-1).any(0)
    named, places = [place for place, is_seen in zip(named, seen, strict=True) if is_seen], places[:, seen]
    if not named or not len(places):
        raise ValueError(f"{path}: it has no markers with names that are seen")
    order, parents = tree(places)
    labels = [names[named[place]] for place in order]
    return Recording(labels, parents, places[:, order], fps=fps, metres=METRES[unit])


def tree(places: np.ndarray) -> tuple[list[int], list[int]]:
    """Markers, each after the one that it hangs from, and the places of these in that order; -1 for the first.

    Args:
        places: (F, M, 3), NaN where one is not seen.
    """
    some = places[:: -(-len(places) * places.shape[1] ** 2 // MOST_DISTANCES)]
    pairs = np.stack([np.linalg.norm(some - some[:, marker, None], axis=-1) for marker in range(some.shape[1])], 1)
    known = np.isfinite(pairs)
    count = np.maximum(known.sum(0), 1)
    mean = np.where(known, pairs, 0).sum(0) / count
    spread = np.sqrt(np.square(np.where(known, pairs - mean, 0)).sum(0) / count)
    never = known.sum(0) < 2
    mean, spread = np.where(never, mean.max() + 1, mean), np.where(never, spread.max() + 1, spread)
    weights = spread + 1e-3 * mean + 1e-12  # of markers on one bone the nearest; none is 0, which would be no edge
    np.fill_diagonal(weights, 0)
    middle = int(mean.sum(1).argmin())
    order, above = breadth_first_order(minimum_spanning_tree(weights), middle, directed=False)
    at = {int(marker): place for place, marker in enumerate(order)}
    return order.tolist(), [at.get(int(above[marker]), -1) for marker in order]


def _check(path: Path) -> None:
    """Refuses, before a library in C++ opens it, what is no C3D file or announces more than it holds."""
    if not path.is_file():  # nor a pipe, which would never end
        raise FileNotFoundError(f"{path}: no such file")
    with path.open("rb") as file:
        head = file.read(512)
    if len(head) < 512 or head[1] != 0x50:
        raise ValueError(f"{path}: no C3D file: its second byte is not 80")
    processor = 0
    with path.open("rb") as file:
        file.seek(512 * max(head[0] - 1, 0))
        block = file.read(4)
        processor = block[3] if len(block) == 4 else 0
    if processor not in (84, 85, 86):
        raise ValueError(f"{path}: damaged: its parameters are not in block {head[0]}")
    order = ">" if processor == 86 else "<"
    points, analogs, first, last = struct.unpack(f"{order}4H", head[2:10])
    check_joints(path, points)
    frames = last - first + 1  # of more than 65,535, this is what fits
    if frames < 1 or not points:
        raise ValueError(f"{path}: {points} markers in {frames} frames are no recording")
    check_size(path, frames, points)
    size, needed = path.stat().st_size, frames * (8 * points + 2 * analogs)
    if needed > size:
        raise ValueError(f"{path}: it announces {needed:,} bytes of markers and has {size:,}")
