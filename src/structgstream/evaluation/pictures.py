# SPDX-License-Identifier: Apache-2.0
"""Comparison pictures of a result: truth, rendering, and their difference; PNG files without optional packages."""

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.atomic_files import atomic_write
from structgstream.evaluation.metrics import Mask, Picture
from structgstream.figure import figure_of, save_figure

SIGNATURE = b"\x89PNG\r\n\x1a\n"
RGB, FILTER_UP = 2, 2


def png_bytes(picture: Picture) -> bytes:
    """``picture`` ``[H, W, 3]`` as a PNG file: 8-bit sRGB, every row as its difference from the one above."""
    height, width, _ = picture.shape
    rows = picture.reshape(height, width * 3)
    above = np.concatenate([np.zeros_like(rows[:1]), rows[:-1]])
    lines = np.empty((height, 1 + width * 3), np.uint8)
    lines[:, 0] = FILTER_UP
    lines[:, 1:] = rows - above  # modulo 256, as the format defines
    header = struct.pack(">IIBBBBB", width, height, 8, RGB, 0, 0, 0)
    parts = ((b"IHDR", header), (b"sRGB", b"\0"), (b"IDAT", zlib.compress(lines.tobytes(), 6)), (b"IEND", b""))
    return SIGNATURE + b"".join(_chunk(kind, body) for kind, body in parts)


def write_png(path: Path, picture: Picture) -> None:
    """Writes ``picture`` ``[H, W, 3]`` atomically; creates the folder if it is missing. Raises StorageError if the file
    cannot be written."""
    atomic_write(path, png_bytes(picture), called="The picture", new_folder=True, sync=False)


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


DIFFERENCE_GAIN = 4
GAP, MARGIN, LABEL = 4, 12, 26  # pixels
LARGEST_TILE = 400  # pixels across


def difference(picture: Picture, truth: Picture) -> Picture:
    """Four times the absolute difference of two pictures ``[H, W, 3]``, clamped: black where they agree."""
    error = np.abs(picture.astype(np.int16) - truth.astype(np.int16))
    return np.minimum(error * DIFFERENCE_GAIN, 255).astype(np.uint8)


def side_by_side(truth: Picture, picture: Picture) -> Picture:
    """Truth, rendering, their difference times four, left to right with white gaps: ``[H, 3 W + 8, 3]``."""
    gap = np.full((truth.shape[0], GAP, 3), 255, np.uint8)
    return np.concatenate([truth, gap, picture, gap, difference(picture, truth)], axis=1)


def block_means(picture: Picture, factor: int) -> Picture:
    """``picture`` ``[H, W, 3]`` reduced by a whole factor, by area mean, rounded.

    Rows and columns at the end that do not fill a pixel are left out.
    """
    if factor == 1:
        return picture
    height, width = picture.shape[0] // factor, picture.shape[1] // factor
    blocks = picture[: height * factor, : width * factor].reshape(height, factor, width, factor, 3)
    total = np.zeros((height, width, 3), np.uint32)
    for row in range(factor):  # many times faster than sums over so short axes
        for column in range(factor):
            total += blocks[:, row, :, column]
    return ((total + factor**2 // 2) // factor**2).astype(np.uint8)


def block_mask(mask: Mask, factor: int) -> Mask:
    """``mask`` ``[H, W]`` reduced as in :func:`block_means`: a pixel counts if all its source pixels count."""
    height, width = mask.shape[0] // factor, mask.shape[1] // factor
    blocks = mask[: height * factor, : width * factor].reshape(height, factor, width, factor)
    return np.logical_and.reduce(blocks, axis=(1, 3))


def thumbnail(picture: Picture) -> Picture:
    """``picture`` reduced by block means, by a whole factor, to at most :data:`LARGEST_TILE` pixels across."""
    return block_means(picture, -(-picture.shape[1] // LARGEST_TILE))


def spread_indices(count: int, columns: int) -> list[int]:
    """At most ``columns`` frame numbers below ``count``, evenly spread, including the first and the last."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(columns, count))})


def contact_sheet(path: Path, pictures: Mapping[str, Mapping[int, tuple[Picture, Picture]]], *, title: str) -> None:
    """One picture file for a whole result: a column per frame, three rows per camera.

    The rows are truth, rendering, and their difference times four.

    Args:
        pictures: camera name to frame number to ``(truth, rendering)``, each ``[H, W, 3]`` uint8.

    Raises:
        MissingExtraError: matplotlib, which writes the labels, is not installed.
    """
    side = 110  # for the row labels
    bands = {name: _tiles(cells) for name, cells in pictures.items()}
    columns = sorted({index for cells in pictures.values() for index in cells})
    heights = {name: next(iter(tiles.values()))[0].shape[0] for name, tiles in bands.items()}
    tile_width = max(next(iter(tiles.values()))[0].shape[1] for tiles in bands.values())
    width = side + len(columns) * (tile_width + GAP) + MARGIN
    height = 2 * LABEL + MARGIN + sum(3 * (h + GAP) + LABEL // 2 for h in heights.values())
    figure = figure_of(width / 100, height / 100, dpi=100, layout=None)

    def label(x: float, y: float, text: str, **style: Any) -> None:
        figure.text(x / width, 1 - y / height, text, va="center", **style)

    label(MARGIN, MARGIN + 6, title, fontsize=10, weight="bold", color="#222")
    for number, index in enumerate(columns):
        x = side + number * (tile_width + GAP) + tile_width / 2
        label(x, 2 * LABEL - 8, f"frame {index}", ha="center", fontsize=9, color="#444")
    top = 2 * LABEL
    for name, tiles in bands.items():
        for row, caption in enumerate((f"camera {name}\ntruth", "rendering", f"difference x{DIFFERENCE_GAIN}")):
            label(side - 6, top + heights[name] / 2, caption, ha="right", fontsize=8, color="#444")
            for index, cell in tiles.items():
                number = columns.index(index)
                x, y = side + number * (tile_width + GAP), height - top - cell[row].shape[0]
                # figimage puts pixels on pixels; an axes would resample them.
                figure.figimage(cell[row], x, y, origin="upper")
            top += heights[name] + GAP
        top += LABEL // 2
    save_figure(figure, path)


def _tiles(cells: Mapping[int, tuple[Picture, Picture]]) -> Mapping[int, tuple[Picture, Picture, Picture]]:
    """The three pictures of each frame, by its number."""
    return {
        index: (thumbnail(truth), thumbnail(picture), thumbnail(difference(picture, truth)))
        for index, (truth, picture) in sorted(cells.items())
    }
