"""Films of moving skeletons, GIF or MP4: `dvae.motion.drawing.plot.animate` for slides and messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image
from PIL.GifImagePlugin import getdata, getheader

from ... import files
from .plot import ELEVATION, FIXED, MARGIN, PAST, Scene, staged

SIZE = 960, 480
"""The largest width and the usual height of a film, in pixels."""

COLOURS = 128
"""Of a GIF."""

_DPI = 100
_BLOCK = 16  # pixels: what coders of video cut pictures into


def save_film(path: str | PathLike[str], skeleton: Any, *motions: Any, title: str = "", **options: Any) -> None:
    """Write moving skeletons as a GIF that repeats, or as an MP4 (H.264), at the motion's own speed.

    Args:
        path: ends in .gif or .mp4.
        skeleton, *motions, **options: as `animate` takes them.
        title: above the people.

    Raises:
        ValueError: what `animate` refuses, or the end of the name is another.
        ModuleNotFoundError: an MP4, without the package imageio-ffmpeg.
    """
    writers = {".gif": _write_gif, ".mp4": _write_mp4}
    if (ending := Path(path).suffix.lower()) not in writers:
        raise ValueError(f"{path}: a film is a gif or an mp4; end its name in .gif or .mp4")
    stage = staged(skeleton, *motions, **options)
    with TemporaryDirectory() as folder:  # coders write to a path of their own
        film = Path(folder) / f"film{ending}"
        writers[ending](film, partial(_pictures, stage, title), stage)
        with files.written(path) as file:
            file.write(film.read_bytes())


def _pictures(stage: Scene, title: str, frames: range) -> Iterator[Image.Image]:
    """Frames as whoever stands `ELEVATION` above the people sees them from afar; each is drawn when it is asked for."""
    motion = _flat(stage.motion + stage.places[:, None, None])
    edges = np.array(stage.skeleton.edges)
    fixed = [[child in stage.shared(k) for child in edges[:, 1]] for k in range(len(motion))]
    ahead = [[FIXED if alike else colour for alike in row] for row, colour in zip(fixed, stage.colours, strict=True)]
    widths = [3.0 if alike else 2.0 for row in fixed for alike in row]

    low, high = (find(motion, (0, 1, 2)) + side * MARGIN for find, side in ((np.nanmin, -1), (np.nanmax, 1)))
    high[1] += MARGIN  # for names
    wide, tall = high - low
    width = min(SIZE[0], max(SIZE[1] * wide / tall, SIZE[1] / 2))
    pixels = [_BLOCK * round(size / _BLOCK) for size in (width, max(width * tall / wide, SIZE[1] / 4) + 60)]
    figure = Figure(figsize=(pixels[0] / _DPI, pixels[1] / _DPI), dpi=_DPI)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1 - 48 / pixels[1]))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set_axis_off()
    for name, place, person in zip(stage.names, _flat(stage.places), motion, strict=True):
        top = np.nanmax(person[..., 1]) + MARGIN / 3
        axes.text(place[0], top, name, ha="center", fontsize=9, parse_math=False)
    figure.text(0.5, 1 - 8 / pixels[1], title, ha="center", va="top", fontsize=10, parse_math=False)
    time = figure.text(0.5, 1 - 28 / pixels[1], "", ha="center", va="top", fontsize=9)
    bones = LineCollection([], linewidths=widths, capstyle="round")
    axes.add_collection(bones, autolim=False)
    for frame in frames:
        bones.set_segments(list(motion[:, frame][:, edges].reshape(-1, 2, 2)))
        bones.set_color(PAST if frame <= stage.now else [colour for row in ahead for colour in row])
        time.set_text(f"{stage.seconds(frame):+.2f} s")
        canvas.draw()
        yield Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


def _flat(points: np.ndarray) -> np.ndarray:
    """Points (..., 3) on the plane of a picture (..., 2)."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([x, z * np.cos(ELEVATION) + y * np.sin(ELEVATION)], -1)


def _write_gif(path: Path, pictures: Callable[[range], Iterator[Image.Image]], stage: Scene) -> None:
    """A GIF counts in hundredths of a second: where a frame has no whole number, they are shared out.

    Frame by frame, since Pillow's own writer holds them all: of each, what differs from the one before.
    """
    (last,) = pictures(stage.shown[-1:])
    palette = last.quantize(COLOURS)  # the future has all the colours
    ends = np.round(stage.milliseconds / 10 * np.arange(len(stage.shown) + 1)).astype(int)
    before: Image.Image | None = None
    with path.open("wb") as file:
        for picture, hundredths in zip(pictures(stage.shown), np.diff(ends).tolist(), strict=True):
            frame = picture.quantize(palette=palette, dither=Image.Dither.NONE)
            if before is None:
                file.writelines(getheader(frame, info={"loop": 0})[0])
                box = (0, 0, *frame.size)
            else:
                changed = Image.fromarray(np.asarray(frame) != np.asarray(before))
                box = changed.getbbox() or (0, 0, 1, 1)
            file.writelines(getdata(frame.crop(box), box[:2], duration=10 * hundredths))
            before = frame
        file.write(b";")


def _write_mp4(path: Path, pictures: Callable[[range], Iterator[Image.Image]], stage: Scene) -> None:
    from imageio_ffmpeg import write_frames

    drawn = pictures(stage.shown)
    first = next(drawn)
    writer = write_frames(str(path), first.size, fps=1000 / stage.milliseconds, macro_block_size=_BLOCK)
    writer.send(None)
    try:
        for picture in chain([first], drawn):
            writer.send(picture.tobytes())
    finally:
        writer.close()
