"""Files of markers in the C3D format."""

import struct

import numpy as np


def write_c3d(path, labels, places, **lists):
    """Write a header, parameters and frames of markers (F, M, 4): x, y, z in mm, and a residual below 0 if unseen.

    `lists` are further text parameters, such as the names of points that are angles.
    """
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
        parameter(b"DESCRIPTIONS", -1, [1, min(markers, 255)], b" " * min(markers, 255)),
    ]
    chunks = [labels[n : n + 255] for n in range(0, markers, 255)]
    lists |= {f"LABELS{n if n > 1 else ''}": chunk for n, chunk in enumerate(chunks, 1)}
    for name, texts in lists.items():
        width = max(map(len, texts))
        content = b"".join(text.encode().ljust(width) for text in texts)
        parameters.append(parameter(name.encode(), -1, [width, len(texts)], content))
    content = group + b"".join(parameters) + b"\0\0"
    blocks = -(-(len(content) + 4) // 512)
    block = struct.pack("<4B", 1, 0x50, blocks, 0x54) + content
    head = struct.pack("<BB5HfHHf", 2, 0x50, markers, 0, 1, frames, 0, -1.0, 2 + blocks, 0, 100.0)
    data = np.asarray(places, "<f4").tobytes()
    path.write_bytes(head.ljust(512, b"\0") + block.ljust(512 * blocks, b"\0") + data.ljust(512, b"\0"))
