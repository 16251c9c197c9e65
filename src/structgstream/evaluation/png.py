# SPDX-License-Identifier: Apache-2.0
"""Writes PNG files with the standard library only, so that pictures need no optional package."""

import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from structgstream.atomic_files import atomic_write

SIGNATURE = b"\x89PNG\r\n\x1a\n"
RGB, FILTER_UP = 2, 2


def png_bytes(picture: NDArray[np.uint8]) -> bytes:
    """``picture`` ``[H, W, 3]`` as a PNG file: 8-bit sRGB, every row as its difference from the one above."""
    height, width, _ = picture.shape
    rows = picture.reshape(height, width * 3)
    above = np.concatenate([np.zeros_like(rows[:1]), rows[:-1]])
    lines = np.empty((height, 1 + width * 3), np.uint8)
    lines[:, 0] = FILTER_UP
    lines[:, 1:] = rows - above  # modulo 256, as the format defines
    header = struct.pack(">IIBBBBB", width, height, 8, RGB, 0, 0, 0)
    parts = (
        (b"IHDR", header),
        (b"sRGB", b"\0"),
        (b"IDAT", zlib.compress(lines.tobytes(), 6)),
        (b"IEND", b""),
    )
    return SIGNATURE + b"".join(_chunk(kind, body) for kind, body in parts)


def write_png(path: Path, picture: NDArray[np.uint8]) -> None:
    """Writes ``picture`` ``[H, W, 3]`` atomically; creates the folder if it is missing.

    Raises:
        StorageError: the file cannot be written.
    """
    atomic_write(path, png_bytes(picture), called="The picture", new_folder=True, sync=False)


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
