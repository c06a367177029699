"""Files of markers, written by the letter of the C3D format."""

import struct

import numpy as np


def write_c3d(path, labels, places):
    """A header, a group of parameters, and frames of markers: (F, M, 4), x, y, z in mm and below 0 if unseen."""
    frames, markers, _ = np.shape(places)

    def parameter(name, kind, sizes, content):
        body = struct.pack("<bB", kind, len(sizes)) + bytes(sizes) + content + b"\0"
        return struct.pack("<bb", len(name), 1) + name + struct.pack("<h", len(body) + 2) + body

    group = struct.pack("<bb", 5, -1) + b"POINT" + struct.pack("<h", 3) + b"\0"
    parameters = [
        parameter(b"USED", 2, [], struct.pack("<h", markers)),
        parameter(b"FRAMES", 2, [], struct.pack("<h", frames)),
        parameter(b"SCALE", 4, [], struct.pack("<f", -1.0)),
        parameter(b"RATE", 4, [], struct.pack("<f", 100.0)),
        parameter(b"DATA_START", 2, [], struct.pack("<h", 3)),
        parameter(b"UNITS", -1, [2, 1], b"mm"),
        parameter(b"LABELS", -1, [4, markers], b"".join(label.encode().ljust(4) for label in labels)),
        parameter(b"DESCRIPTIONS", -1, [1, markers], b" " * markers),
    ]
    block = b"\x01\x50\x01\x54" + group + b"".join(parameters) + b"\0\0"
    head = struct.pack("<BB5HfHHf", 2, 0x50, markers, 0, 1, frames, 0, -1.0, 3, 0, 100.0)
    data = np.asarray(places, "<f4").tobytes()
    path.write_bytes(head.ljust(512, b"\0") + block.ljust(512, b"\0") + data.ljust(512, b"\0"))
